"""Experiments that take no time, for tests of what runs them; as a program, the command that does."""

import contextlib
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from experiments.engine import Count, Experiment, Pictured, Settings, perform

SIZE = 300  # of matrices that are large enough for linear algebra to share its sums among threads


@dataclass(frozen=True)
class TinySettings(Settings):
    """Where notes are left of who did what, and what the figures are made of."""

    seeds: Count = 4
    notes: str = ""
    factor: float = 1.0
    wrong: tuple[int, ...] = ()
    fatal: tuple[int, ...] = ()
    gated: tuple[int, ...] = ()
    kinds: tuple[str, ...] = ("odd", "even")


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


def one(settings, seed):
    """A number that depends on the seed, and on how sums of many numbers are formed; a picture of the first seed."""
    note(settings, f"job {seed}")
    if seed in settings.wrong and not (Path(settings.notes) / "mended").exists():
        raise ValueError(f"seed {seed}\nis wrong")
    if seed in settings.fatal:
        os._exit(3)
    if seed in settings.gated:
        (Path(settings.notes) / "gate").read_text()  # as a pipe, this waits for ever
    matrix = np.random.default_rng(seed).normal(size=(SIZE, SIZE))
    value = float(np.linalg.svd(matrix @ matrix.T, compute_uv=False)[-1])
    rows = [{"seed": seed, "value": settings.factor * seed, "sum": value, "odd": np.bool_(seed % 2), "none": None}]
    rows.append({"seed": seed, "value": float("nan")})
    return Pictured(rows, {"drawn": b"PNG"}) if seed == settings.seed_base else rows


def timed(settings, seed):
    note(settings, f"alone {seed}")
    if seed in settings.fatal:
        os._exit(3)
    return [{"seed": seed, "value": 1.0}]


def summarise(rows):
    values = [row["value"] for row in rows if row["value"] == row["value"]]
    return {"total": sum(values), "by": {"worst": max(values)}, "rows": len(rows)}


def plot(rows, figure):
    """Values of each seed."""
    figure.subplots().plot([row["seed"] for row in rows], [row["value"] for row in rows])


def missed(summary):
    return ["total: too much"] if summary["total"] > 100 else []


SETTINGS = TinySettings()
QUICK = replace(SETTINGS, seeds=2)
TINY = Experiment("tiny", "Adds up.", SETTINGS, QUICK, one, summarise, missed, plot=plot)
ALONE = replace(TINY, name="alone", purpose="Takes the time.", one=timed, alone=True, plot=None)
LACKING = replace(TINY, name="lacking", purpose="Lacks something.", needs=lambda _: "needs the moon")
KNOWN = {each.name: lambda each=each: each for each in (TINY, ALONE, LACKING)}


def here(jobs):
    """Run jobs one after the other in this process."""
    for job in jobs:
        yield job, perform(job.case.experiment.one, job.case.settings, job.number)


@contextlib.contextmanager
def here_together(processes, scheduler):
    """Stand for a cluster, whose start takes seconds."""
    yield here


if __name__ == "__main__":
    from experiments.command import main

    sys.exit(main(known=KNOWN))
