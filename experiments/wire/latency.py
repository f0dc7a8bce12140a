"""Latencies measured by `cotarget latency` over the wire, against their true values.

A camera frame's true latency is its arrival time minus the exposure time of its picture. A thread polls the emulator
for the exposure and publication times of each camera's newest picture; a frame shows the newest picture that was
published when it arrived, because the wire adds far less than a period. A command's true delay is the time until its
last byte was on the wire, plus the configured delay.
"""

import bisect
import math
import threading
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cotarget.latency import measure_fixed, measure_head
from cotarget.rig import Speed
from cotarget.safety.safe_rig import guard
from experiments.engine import Row
from experiments.wire.command import ORDER, Notes, TimedCamera, TimedHead, Turn, open_tapped
from experiments.wire.polls import BYTES_S
from experiments.wire.process import EmulatedRig
from experiments.wire.rig import Tap, exact_calibration, load

LOOK_S = 0.01  # polling interval of the newest exposures [s]
CAMERAS = ("fixed", "zoom")


@dataclass
class Exposures:
    """Exposures of one camera: when each picture was published and exposed, in order [s]."""

    published: list[float] = field(default_factory=list)
    exposed: list[float] = field(default_factory=list)

    def add(self, exposed: float, published: float) -> None:
        """Add the newest exposure."""
        if not self.published or published > self.published[-1]:
            self.published.append(published)
            self.exposed.append(exposed)

    def before(self, arrived: float) -> float:
        """Give the newest exposure that was visible at a time [s]; nan if none was."""
        found = bisect.bisect_right(self.published, arrived)
        return self.exposed[found - 1] if found else math.nan


class Watcher:
    """Polls an emulator for exposures, on its own connection and thread; a context manager."""

    def __init__(self, emulated: EmulatedRig) -> None:
        self._emulated = emulated
        self.exposures = {name: Exposures() for name in CAMERAS}
        self._leave = threading.Event()
        self._thread = threading.Thread(target=self._run, name="exposures", daemon=True)

    def __enter__(self) -> "Watcher":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._leave.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._leave.wait(LOOK_S):
            for name, moments in self._emulated.truth()["pictures"].items():
                if moments is not None:
                    self.exposures[name].add(*moments)


class NotedHead(TimedHead):
    """Head that records each move as a separate turn."""

    def move(self, pan: float, tilt: float, speed: Speed | None = None, wait: bool = False) -> tuple[float, float]:
        """Command the head."""
        now = self._notes.clock.now()
        self._notes.turns.append(Turn(now, now))
        return super().move(pan, tilt, speed, wait)


def run(folder: Path, head_seconds: float, board_seconds: float) -> list[Row]:
    """Measure all latencies; give a row for each camera and for the head's commands."""
    with EmulatedRig(folder / "latency", {"sim": {"scene": "outdoor"}}) as emulated, Watcher(emulated) as watcher:
        config = emulated.config()
        taps: list[Tap] = []
        with guard(open_tapped(config, taps), config.safety) as rig:
            notes = Notes(rig.clock, 0.0)
            seen = {name: Notes(rig.clock, getattr(rig.spec, name).latency_s) for name in CAMERAS}
            devices: dict[str, Any] = {name: TimedCamera(getattr(rig, name), seen[name]) for name in CAMERAS}
            noted = replace(rig, **devices, head=NotedHead(rig.head, notes))
            found = measure_head(noted, head_seconds)
            orders = true_command_delays(notes, taps[0], emulated.sim.sim.head.command_delay_s)
            calibration = exact_calibration(emulated.sim)
            swing = measure_fixed(noted, calibration, config.board, board_seconds)
        truth = {
            **{name: true_latencies(seen[name], watcher.exposures[name]) for name in CAMERAS},
            "command": orders,
        }
    measured = {
        "fixed": rig.spec.fixed.latency_s + swing.seconds + found.zoom.seconds,
        "zoom": rig.spec.zoom.latency_s + found.zoom.seconds,
        "command": found.command,
    }
    return [
        {
            "figure": "latency",
            "what": name,
            "measured_s": value,
            "truth_s": float(np.nanmedian(truth[name])),
            "truth_spread_s": float(np.nanpercentile(truth[name], 95) - np.nanpercentile(truth[name], 5)),
            "samples": len(truth[name]),
            "load": load(),
        }
        for name, value in measured.items()
    ]


def true_latencies(notes: Notes, exposures: Exposures) -> list[float]:
    """Give the true time from exposure to arrival of each frame of a camera [s]."""
    return [t - exposures.before(t) for t in sorted({turn.arrived for turn in notes.turns})]


def true_command_delays(notes: Notes, tap: Tap, delay_s: float) -> list[float]:
    """Give the true time from each move's call to the motion of its pan [s]."""
    pans = [(t, len(data)) for t, data in tap.written if ORDER.fullmatch(data) and data.startswith(b"PP")]
    found = []
    for turn in notes.turns:
        sent = next(((t, size) for t, size in pans if t >= turn.read), None)
        if sent is not None:
            found.append(sent[0] + sent[1] / BYTES_S + delay_s - turn.read)
    return found
