"""Behaviour of `cotarget follow` at each fault of the emulators, while the head turns.

A book moves on an ellipse, so that a head that follows it never stands. A fault is switched on at a random moment, in
two ways. In the first it passes: it is switched off after a while, and the head should follow again. In the second it
is held: the head should stand, or follow where the fault allows that. The results are judged by the head's true pose
from the emulator, by the book's true direction, and by how the command ends. If the line to the head is unplugged, no
halt can reach the unit, which ends at the goal of its last command.
"""

import functools
import itertools
import math
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np

from cotarget.backends import describe
from cotarget.config import parse_config
from cotarget.emulators.emulation import FAULTS
from cotarget.geometry import Array
from cotarget.sim.targets.paths import waypoint_path
from cotarget.targeting import Reach, aim
from experiments.engine import Row
from experiments.wire.process import EmulatedRig, end
from experiments.wire.rig import MOUNT, exact_calibration, load

# The book's ellipse: x and z about the fixed camera's axis, at a distance [m], and its period [s].
ROUND, DISTANCE, HEIGHT, PERIOD_S, KNOTS = (1.2, 0.6), 6.0, 1.6, 6.0, 8
ROUNDS = 150  # number of rounds, longer than one emulator is used
PAN_DEG, TILT_DEG = (-25.0, 25.0), (-20.0, 20.0)  # soft limits, with a margin around the round as the head sees it
PASSES_S = 0.3  # duration of a fault that passes [s]
ONCE = ("head.power-cycle", "head.limit-hit")  # pass by themselves; the unit has lost its position then
TABLE_S = 0.05  # spacing of the table of the book's directions [s]
EVERY_S = 0.01  # interval of reading the truth [s]
OFF_DEG = 6.0  # a following head trails the book, at 13 degrees/s, by at most 4
STILL_DEG, REST_S = 0.03, 0.25  # a head that moves by less than the first for the second stands
FOLLOWS_S, START_S = 1.0, 30.0  # moving time of a head that follows, and timeout of its start [s]
MOMENT_S = (0.3, 2.0)  # range of the time from then to the fault [s]
WATCH_S = 2.5  # observation after a fault that passes [s]
HELD_S = 5.0  # observation of a fault that is held [s]
HANG_S = 5.0  # a command that neither follows nor ends within this hangs [s]
GIVEN_UP_S = 20.0  # and is terminated after this [s]
AFTER_S = 0.5  # observation of the head after the command has ended [s]


@dataclass
class Watch:
    """True poses of the head: times [s], pan and tilt [degrees], and angle to the book [degrees]."""

    emulated: EmulatedRig
    times: list[float] = field(default_factory=list)
    angles: list[tuple[float, float]] = field(default_factory=list)
    off: list[float] = field(default_factory=list)

    def until(self, end_s: float, process: "subprocess.Popen[str] | None" = None) -> None:
        """Record until a time on the machine's monotonic clock, or until a process has ended."""
        while time.monotonic() < end_s and (process is None or process.poll() is None):
            truth = self.emulated.truth()
            self.times.append(truth["t"])
            self.angles.append((truth["pan_deg"], truth["tilt_deg"]))
            self.off.append(float(np.hypot(*(directions(truth["world"]) - self.angles[-1]))))
            time.sleep(EVERY_S)

    def rests(self, since: float) -> list[tuple[float, float]]:
        """Give the intervals in which the head stood for `REST_S` or more [s]; the last may be unfinished."""
        t, at = np.array(self.times), np.array(self.angles)
        t, at = t[t >= since], at[t >= since]
        found, begin = [], 0
        for i in range(1, len(t) + 1):
            if i == len(t) or np.abs(at[i] - at[begin]).max() > STILL_DEG:
                if t[i - 1] - t[begin] >= REST_S:
                    found.append((float(t[begin]), float(t[i - 1])))
                begin = i
        return found

    def standing(self, since: float) -> float | None:
        """Give the time since when the head stands [s]; None if it moves."""
        rests = self.rests(since)
        return rests[-1][0] if rests and rests[-1][1] == self.times[-1] else None

    def strayed(self, since: float) -> float:
        """Give the last time at which it was off the book [s]; the given time if it never was."""
        away = [t for t, off in zip(self.times, self.off, strict=True) if t >= since and off > OFF_DEG]
        return away[-1] if away else since

    def moved(self, since: float) -> float:
        """Give the largest angle from its pose at a time [degrees]."""
        at = np.array(self.angles)[np.array(self.times) >= since]
        return float(np.abs(at - at[0]).max()) if len(at) else math.nan

    def beyond(self) -> float:
        """Give the largest excess over the soft limits [degrees]."""
        at: Array = np.array(self.angles)
        low, high = np.array([PAN_DEG, TILT_DEG]).T
        return float(np.maximum(np.maximum(low - at, at - high), 0.0).max())


class Follower:
    """Process of `cotarget follow`, started as a user starts it; a context manager that ends it."""

    def __init__(self, folder: Path, emulated: EmulatedRig) -> None:
        calibration = folder / "calibration.json"
        exact_calibration(emulated.sim).save(calibration)
        options = ["--rig", str(emulated.rig_toml()), "--calibration", str(calibration), "--seconds", "600"]
        command = [sys.executable, "-m", "cotarget.cli", "follow", "--target", "book", *options]
        self._errors: IO[str] = (folder / "follow.log").open("w+", encoding="utf-8")
        self.process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=self._errors, text=True
        )

    def said(self) -> str:
        """Text that the process wrote to stderr."""
        self._errors.seek(0)
        return self._errors.read()

    def __enter__(self) -> "Follower":
        return self

    def __exit__(self, *_: object) -> None:
        end(self.process)
        self._errors.close()


def run(folder: Path, faults: tuple[str, ...], repetitions: int, seed: int) -> list[Row]:
    """Try each fault repeatedly; give two rows per fault and repetition, one for faults that pass by themselves."""
    rng = np.random.default_rng(seed)
    jobs = [(fault, number) for number in range(repetitions) for fault in faults]
    rows: list[Row] = []
    for rig in itertools.count():
        if not jobs:
            break
        # A folder each, because the position-lost marker is stored beside the rig's files.
        files = folder / f"faults{rig}"
        with EmulatedRig(files, _tables()) as emulated:
            begun = time.monotonic()
            while jobs and time.monotonic() < begun + (ROUNDS - 20) * PERIOD_S:
                fault, number = jobs.pop(0)
                for row in _try(files, emulated, fault, rng):
                    rows.append({"figure": "faults", "fault": fault, "repetition": number, **row, "load": load()})
                if fault in ONCE:
                    break
    return rows


def all_faults() -> tuple[str, ...]:
    """List all faults of the three devices; those that end an emulator come last."""
    names = [f"{device}.{name}" for device, known in FAULTS.items() for name in known]
    return tuple(sorted(names, key=lambda name: name in ONCE))


def directions(world_s: float) -> Array:
    """Give pan and tilt that point at the book at a time of the world, (2,) [degrees]."""
    phase = np.arange(PERIOD_S / TABLE_S + 1) * TABLE_S
    return np.array([np.interp(world_s % PERIOD_S, phase, angles) for angles in _directions()])


@functools.cache
def _directions() -> Array:
    """Compute pan and tilt over one round from the path and the true calibration, (2, n) [degrees]."""
    config = parse_config(_tables())
    calibration = exact_calibration(config)
    path = waypoint_path(config.sim.paths["book"])
    spec = describe(config)
    reach = Reach(spec.head.limits.pan.range, spec.head.limits.tilt.range, spec.zoom.focal_range)
    found = []
    for t in np.arange(PERIOD_S / TABLE_S + 1) * TABLE_S:
        x, y, z = path.position(PERIOD_S + t)  # skip the first round, which starts from rest
        there = aim(calibration, np.array([x, MOUNT - z, y]), reach)
        found.append((there.pan, there.tilt))
    return np.degrees(found).T


def _tables() -> dict[str, Any]:
    turns = np.arange(ROUNDS * KNOTS + 1)
    phase = 2 * np.pi * turns / KNOTS
    x, z = ROUND[0] * np.cos(phase), HEIGHT + ROUND[1] * np.sin(phase)
    path = [
        [float(turn * PERIOD_S / KNOTS), float(a), DISTANCE, float(b)] for turn, a, b in zip(turns, x, z, strict=True)
    ]
    safety = {"pan_deg": list(PAN_DEG), "tilt_deg": list(TILT_DEG)}
    return {"sim": {"scene": "indoor", "targets": ["book"], "paths": {"book": path}}, "safety": safety}


def _try(folder: Path, emulated: EmulatedRig, fault: str, rng: np.random.Generator) -> Iterator[Row]:
    """Try the fault that passes, then the one that is held."""
    ways = ["once"] if fault in ONCE else ["passed", "held"]
    while ways:
        with Follower(folder, emulated) as follower:
            while ways and follower.process.poll() is None:
                watch = Watch(emulated)
                way = ways.pop(0)
                if not _follows(watch, follower):
                    said = follower.said()
                    failed = {"way": way, "outcome": "did not start", "traceback": int("Traceback" in said)}
                    yield failed | {"words": _last(said)}
                    break
                watch.until(time.monotonic() + rng.uniform(*MOMENT_S))
                try:
                    yield _one(watch, follower, fault, way)
                finally:
                    emulated.switch(fault, False)


def _follows(watch: Watch, follower: Follower) -> bool:
    """Wait until the head has followed for a while; give whether it did."""
    begun = time.monotonic()
    while follower.process.poll() is None and time.monotonic() < begun + START_S:
        watch.until(time.monotonic() + FOLLOWS_S, follower.process)
        if not watch.times:
            continue
        since = watch.times[-1] - FOLLOWS_S
        if watch.moved(since) > 1.0 and not watch.rests(since) and watch.strayed(since) == since:
            return True
    return False


def _one(watch: Watch, follower: Follower, fault: str, way: str) -> Row:
    """Switch a fault on, and record what happens."""
    process, emulated = follower.process, watch.emulated
    began = time.monotonic()
    emulated.switch(fault)
    over, hangs = began, False
    if way == "passed":
        watch.until(began + PASSES_S)
        over = time.monotonic()
        emulated.switch(fault, False)
        watch.until(over + WATCH_S, process)
    else:
        watch.until(began + HELD_S, process)
    since = watch.standing(began)
    if since is not None:
        watch.until(since + HANG_S, process)
        hangs = process.poll() is None and watch.standing(began) == since
        if hangs:
            watch.until(since + GIVEN_UP_S, process)
    ended = process.poll()
    ended_s = time.monotonic() - began if ended is not None else math.nan
    if ended is not None:
        watch.until(time.monotonic() + AFTER_S)
    stands = watch.standing(began)
    rests = [(since, until) for since, until in watch.rests(began) if since < over + REST_S]  # ignore later ones
    halted, recovered = math.nan, math.nan
    if stands is not None:
        outcome, halted = "ended" if ended is not None else "stands", stands - began
    else:
        outcome, recovered = "follows", max([*(until - over for _, until in rests), watch.strayed(over) - over])
        if watch.off[-1] > OFF_DEG:
            outcome, recovered = "strays", math.inf
        halted = rests[0][0] - began if rests else math.nan
    said = follower.said()
    return {
        "way": way,
        "outcome": outcome,
        "halted_s": halted,
        "recovered_s": recovered,
        "settled_s": float(np.nanmin([halted, recovered])),
        "off_deg": max(watch.off),
        "moved_deg": watch.moved(began),
        "beyond_deg": watch.beyond(),
        "ended_s": ended_s,
        "hang": int(hangs and stands is not None),
        "traceback": int("Traceback" in said),
        "status": math.nan if ended is None else ended,
        "words": _last(said),
    }


def _last(said: str) -> str:
    lines = [line for line in said.splitlines() if line.strip()]
    return lines[-1] if lines else ""
