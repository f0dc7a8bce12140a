"""Speed of a sweep with two workers against one, and equality of their rows.

The same seeds of two experiments, one that fits and one that renders, are run by one worker and by two, in turns
because a machine's speed drifts, each worker with one thread. The time is that of the whole sweep with the start of its
workers. Rows must be equal number by number; seeds with different rows are counted.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cotarget.detection import make_detector
from cotarget.schema import Positive
from cotarget.sim.world import SimWorld
from experiments.calibration import chain
from experiments.engine import Case, Count, Experiment, Job, Row, Settings, csv_of, on_dask
from experiments.following.field import hold_config
from experiments.tables import grouped, spread_columns

PROCESSES = (1, 2)
WANTED = 1.9  # goal: speed of two workers over one


@dataclass(frozen=True)
class SweepSpeedSettings(Settings):
    """Settings: repetitions as seeds, jobs per sweep, rigs of a fitted job, and length of a rendered job's run [s]."""

    seeds: Count = 1
    jobs: Count = 12
    rigs: Count = 2
    seconds: Positive = 2.0


def fitted(settings: SweepSpeedSettings, number: int) -> list[Row]:
    """Run a job that fits: the chain's quick run, with some of its rigs."""
    return chain.one(replace(chain.QUICK, cases=chain.QUICK.cases[: settings.rigs]), number)


def rendered(settings: SweepSpeedSettings, number: int) -> list[Row]:
    """Run a job that renders: both cameras of the field search a person; give the detections of each frame."""
    config = hold_config("person", number)
    detector, rows = make_detector(config.target("person"), config.sim.fixed.rate_hz), []
    with SimWorld(config).rig as rig:
        t: float | None = None
        while t is None or t < settings.seconds:
            frame = rig.fixed.read(newer_than=t)
            t = frame.t
            shown, found = rig.zoom.read(), detector.detect(frame).boxes
            rows.append({"t": t, "grey": float(shown.image.mean()), "u": sum(float(one.center_px[0]) for one in found)})
    return rows


SWEEPS = {"fitted": fitted, "rendered": rendered}


def one(settings: SweepSpeedSettings, seed: int) -> list[Row]:
    """Run each sweep with each number of workers; give a row per run."""
    rows: list[Row] = []
    for sweep, job in SWEEPS.items():
        case = Case(Experiment(sweep, "", settings, settings, job, spread_columns), settings, Path())
        jobs = [Job(case, number) for number in range(seed * settings.jobs, (seed + 1) * settings.jobs)]
        first: dict[int, bytes] = {}
        for processes in PROCESSES if seed % 2 == 0 else PROCESSES[::-1]:
            began = time.perf_counter()
            with on_dask(processes, None) as run:
                found = {job.number: csv_of(done.rows) for job, done in run(jobs)}
                seconds = time.perf_counter() - began
            first = first or found
            differ = sum(first[number] != found[number] for number in first)
            rows.append({"seed": seed, "sweep": sweep, "processes": processes, "seconds": seconds, "differ": differ})
    return rows


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Give each sweep's median seconds, the speed of two workers over one, and the number of jobs with other rows."""
    found: dict[str, Any] = {}
    for sweep, mine in grouped(rows, "sweep").items():
        took = {p: np.array([row["seconds"] for row in each]) for p, each in grouped(mine, "processes").items()}
        found[sweep] = {
            **{f"{p}_s": float(np.median(took[p])) for p in PROCESSES},
            "faster": float(np.median(took[PROCESSES[0]] / took[PROCESSES[1]])),
            "rows_that_differ": sum(row["differ"] for row in mine),
        }
    return found


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the figures that miss their goal."""
    slow = [f"{sweep}: {found['faster']:.2f} times" for sweep, found in summary.items() if found["faster"] < WANTED]
    return slow + [f"{sweep}: rows differ" for sweep, found in summary.items() if found["rows_that_differ"]]


SETTINGS = SweepSpeedSettings()
QUICK = replace(SETTINGS, seeds=1, jobs=2, rigs=1, seconds=0.2)
ALONE = True
COST_S = 200.0
