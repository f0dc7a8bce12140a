"""Experiments that take no time, for tests of what runs them; as a program, the command that does."""

import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from experiments.engine.harness import Experiment, Preparation, Settings, seeds_of
from experiments.engine.results import code_version

SIZE = 300  # of matrices that are large enough for linear algebra to share its sums among threads


@dataclass(frozen=True)
class TinySettings(Settings):
    """Where notes are left of who did what, and what the figures are made of."""

    seeds: int = 4
    notes: str = ""
    factor: float = 1.0
    wrong: tuple[int, ...] = ()
    fatal: tuple[int, ...] = ()
    gated: tuple[int, ...] = ()


def note(settings, text):
    if settings.notes:
        with (Path(settings.notes) / "done").open("a") as file:
            file.write(f"{text} {os.getpid()}\n")


def notes(folder):
    """What was noted, without the processes."""
    path = folder / "done"
    return [line.rpartition(" ")[0] for line in path.read_text().splitlines()] if path.exists() else []


def pids(folder, what=""):
    lines = (folder / "done").read_text().splitlines()
    return {int(line.rpartition(" ")[2]) for line in lines if line.startswith(what)}


def one(shared, settings, seed):
    """A number that depends on the seed, and on how sums of many numbers are formed."""
    note(settings, f"job {seed}")
    if seed in settings.wrong and not (Path(settings.notes) / "mended").exists():
        raise ValueError(f"seed {seed}\nis wrong")
    if seed in settings.fatal:
        os._exit(3)
    if seed in settings.gated:
        (Path(settings.notes) / "gate").read_text()  # as a pipe, this waits for ever
    matrix = np.random.default_rng(seed).normal(size=(SIZE, SIZE))
    value = float(np.linalg.svd(matrix @ matrix.T, compute_uv=False)[-1])
    row = {"seed": seed, "value": settings.factor * seed, "sum": value, "shared": shared, "odd": np.bool_(seed % 2)}
    return [row, {"seed": seed, "value": float("nan")}]


def prepare(notes):
    note(TinySettings(notes=notes), "prepared")
    return "given to all"


def for_notes(settings):
    return (settings.notes,)


def knows_its_code(_):
    """Whether this process knew which code it has before it was told what to do."""
    return code_version.cache_info().currsize == 1


def prepare_in_vain(settings):
    raise OSError("nothing to\nshare")


def alone(shared, settings, seed):
    note(settings, f"alone {seed}")
    if seed in settings.fatal:
        os._exit(3)
    return [{"seed": seed, "value": 1.0}]


def summarise(rows):
    values = [row["value"] for row in rows if row["value"] == row["value"]]
    return {"total": sum(values), "by": {"worst": max(values)}, "rows": len(rows)}


def describe(settings, summary):
    return f"{seeds_of(settings)}: <total> {summary['total']:g}"


def plot(rows, figure):
    """Values of each seed."""
    figure.subplots().plot([row["seed"] for row in rows], [row["value"] for row in rows])


def missed(summary):
    return ["total: too much"] if summary["total"] > 100 else []


SETTINGS = TinySettings()
QUICK = replace(SETTINGS, seeds=2)
TINY = Experiment("tiny", "Adds up.", SETTINGS, QUICK, one, summarise, describe, plot, missed)
SHARING = replace(
    TINY, name="sharing", purpose="Shares.", prepare=Preparation(prepare, for_notes), cost_s=5.0, missed=None
)
VAIN = replace(TINY, name="vain", purpose="Cannot be prepared.", prepare=prepare_in_vain)
ALONE = replace(TINY, name="alone", purpose="Takes the time.", one=alone, alone=True, plot=None)
LACKING = replace(TINY, name="lacking", purpose="Lacks something.", needs=lambda _: "needs the moon")

KNOWN = {each.name: lambda each=each: each for each in (TINY, SHARING, VAIN, ALONE, LACKING)}

if __name__ == "__main__":
    from experiments.engine.command import main

    sys.exit(main(known=KNOWN))
