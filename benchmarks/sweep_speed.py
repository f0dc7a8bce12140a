"""Speed of a sweep with two processes against one, and equality of their rows.

The same seeds of two experiments, one that fits and one that renders, are run by one process and by two, in turns
because a machine's speed drifts, each process with one thread. The time is that of the whole sweep with the start of
its processes. Rows must be equal number by number; jobs with different rows are counted.

    python -m benchmarks.sweep_speed [--seeds 1: times] [--quick] [--out DIR]
"""

import functools
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cotarget.detection import make_detector
from cotarget.sim.world import SimWorld
from experiments.calibration import chain
from experiments.engine.harness import Experiment, Row, Settings
from experiments.engine.texts import table
from experiments.engine.workers import in_processes
from experiments.following.field_scenes import hold_config

PROCESSES = (1, 2)
WANTED = 1.8  # goal: speed of two processes over one


@dataclass(frozen=True)
class SweepSpeedSettings(Settings):
    """Settings: repetitions as seeds, jobs per sweep, and length of a rendered job's run [s]."""

    seeds: int = 1
    jobs: int = 12
    seconds: float = 2.0


def fitted(settings: SweepSpeedSettings, number: int) -> list[Row]:
    """Run a job that fits: the chain's quick run."""
    del settings
    return chain.one(None, chain.EXPERIMENT.quick, number)


def rendered(settings: SweepSpeedSettings, number: int) -> list[Row]:
    """Run a job that renders: both cameras of the field search a person; give the detections of each frame."""
    config = hold_config("person", number)
    detector, rows = make_detector(config.target("person"), config.sim.fixed.rate_hz), []
    with SimWorld(config).rig as rig:
        t: float | None = None
        while t is None or t < settings.seconds:
            frame = rig.fixed.read(newer_than=t)
            t = frame.t
            shown, found = rig.zoom.read(), detector.detect(frame)
            rows.append({"t": t, "grey": float(shown.image.mean()), "u": [float(one.center_px[0]) for one in found]})
    return rows


SWEEPS = {"fitted": fitted, "rendered": rendered}


def one(_: None, settings: SweepSpeedSettings, seed: int) -> list[Row]:
    """Run each sweep with each number of processes; give a row per run."""
    rows: list[Row] = []
    numbers = range(seed * settings.jobs, (seed + 1) * settings.jobs)
    for sweep, job in SWEEPS.items():
        first: list[str] = []
        for processes in PROCESSES if seed % 2 == 0 else PROCESSES[::-1]:
            began = time.perf_counter()
            found = dict(in_processes(functools.partial(job, settings), numbers, processes))
            seconds = time.perf_counter() - began
            told = [json.dumps(found[i]) for i in range(len(numbers))]
            first = first or told
            differ = sum(a != b for a, b in zip(first, told, strict=True))
            rows.append({"seed": seed, "sweep": sweep, "processes": processes, "seconds": seconds, "differ": differ})
    return rows


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Give each sweep's median seconds, the speed of two processes over one, and the number of jobs with other rows."""
    found: dict[str, Any] = {}
    for sweep in dict.fromkeys(row["sweep"] for row in rows):
        mine = [row for row in rows if row["sweep"] == sweep]
        took = {p: np.array([row["seconds"] for row in mine if row["processes"] == p]) for p in PROCESSES}
        found[sweep] = {
            **{f"{p}_s": float(np.median(seconds)) for p, seconds in took.items()},
            "faster": float(np.median(took[PROCESSES[0]] / took[PROCESSES[1]])),
            "rows_that_differ": sum(row["differ"] for row in mine),
        }
    return found


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the figures that miss their goal."""
    slow = [f"{sweep}: {found['faster']:.2f} times" for sweep, found in summary.items() if found["faster"] < WANTED]
    return slow + [f"{sweep}: rows differ" for sweep, found in summary.items() if found["rows_that_differ"]]


def describe(settings: SweepSpeedSettings, summary: Mapping[str, Any]) -> str:
    """Format a line per sweep."""
    lines = [
        [sweep, found["1_s"], found["2_s"], found["faster"], f">= {WANTED:g}", found["rows_that_differ"]]
        for sweep, found in summary.items()
    ]
    return f"sweeps of {settings.jobs} jobs, medians of {settings.seeds} times\n" + table(
        ("sweep", "one process [s]", "two [s]", "times as fast", "wanted", "rows that differ"), lines
    )


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Seconds of each sweep, by one process and by two."""
    ax = figure.subplots()
    for sweep in dict.fromkeys(row["sweep"] for row in rows):
        for seed in dict.fromkeys(row["seed"] for row in rows):
            mine = sorted((r["processes"], r["seconds"]) for r in rows if (r["sweep"], r["seed"]) == (sweep, seed))
            ax.plot(*zip(*mine, strict=True), "o-", label=f"{sweep}, {seed}")
    ax.set(xlabel="processes", ylabel="seconds", xticks=PROCESSES, ylim=(0, None))
    ax.legend(frameon=False)


SETTINGS = SweepSpeedSettings()
EXPERIMENT = Experiment(
    "sweep_speed",
    "What a second process is worth to a sweep, and that it changes no row.",
    SETTINGS,
    replace(SETTINGS, seeds=1, jobs=2, seconds=0.2),
    one,
    summarise,
    describe,
    plot,
    missed,
    alone=True,
    cost_s=200.0,
)
if __name__ == "__main__":
    sys.exit(EXPERIMENT.main())
