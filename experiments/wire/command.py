"""Time from a frame's arrival to the first byte of the resulting command, in its parts, through an emulated rig.

The pipeline runs unchanged. Devices and a detector that record their calls, and a tap on the serial port, give the
times.
"""

import bisect
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cotarget.backends import open_rig
from cotarget.config import RigConfig
from cotarget.detection import Detections, make_detector
from cotarget.drivers.clock import MonotonicClock
from cotarget.pipeline import follow
from cotarget.rig import Clock, Frame, Rig, Speed
from cotarget.safety.safe_rig import guard
from experiments.engine import Row
from experiments.wire.process import EmulatedRig
from experiments.wire.rig import Tap, exact_calibration, load, tapped

SCENES = {"book": "indoor", "person": "outdoor"}
ORDER = re.compile(rb"[PT][PS]-?\d+ ")  # first bytes of a move; queries have no number


@dataclass
class Turn:
    """Times of the events in one turn of the loop [s]; None where one did not occur."""

    arrived: float
    read: float
    detecting: float | None = None
    detected: float | None = None
    called: float | None = None


@dataclass
class Notes:
    """All turns so far."""

    clock: Clock
    latency_s: float
    turns: list[Turn] = field(default_factory=list)


class Noted:
    """Device or detector with calls that are noted; all else is its own."""

    def __init__(self, device: Any, notes: Notes) -> None:
        self._device, self._notes = device, notes

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device, name)


class TimedCamera(Noted):
    """Camera that records when a frame arrived and when it was returned."""

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Read a frame from the camera."""
        frame: Frame = self._device.read(newer_than, timeout)
        self._notes.turns.append(Turn(frame.t + self._notes.latency_s, self._notes.clock.now()))
        return frame


class TimedHead(Noted):
    """Head that records when a move is commanded."""

    def move(self, pan: float, tilt: float, speed: Speed | None = None, wait: bool = False) -> tuple[float, float]:
        """Command the head."""
        self._notes.turns[-1].called = self._notes.clock.now()
        return self._device.move(pan, tilt, speed, wait)


class TimedDetector(Noted):
    """Detector that records when a frame is searched."""

    def detect(self, frame: Frame, held: object = ()) -> Detections:
        """Run the detector."""
        turn, clock = self._notes.turns[-1], self._notes.clock
        turn.detecting = clock.now()
        found: Detections = self._device.detect(frame, held)
        turn.detected = clock.now()
        return found


def run(folder: Path, targets: tuple[str, ...], seconds: float) -> list[Row]:
    """Follow targets and give a row per command that was sent."""
    rows = []
    for name in targets:
        tables = {"sim": {"scene": SCENES[name], "targets": [name]}}
        with EmulatedRig(folder / f"command_{name}", tables) as emulated:
            rows += [{"figure": "command", "target": name, **row} for row in _follow(emulated, name, seconds)]
    return rows


def _follow(emulated: EmulatedRig, name: str, seconds: float) -> list[Row]:
    config = emulated.config()
    taps: list[Tap] = []
    with guard(open_tapped(config, taps), config.safety) as rig:
        notes = Notes(rig.clock, rig.spec.fixed.latency_s)
        target = config.target(name)
        detector: Any = TimedDetector(make_detector(target, rig.spec.fixed.rate_hz), notes)
        devices: dict[str, Any] = {"fixed": TimedCamera(rig.fixed, notes), "head": TimedHead(rig.head, notes)}
        timed = replace(rig, **devices)
        for _ in follow(timed, exact_calibration(emulated.sim), target, detector, seconds=seconds):
            pass
    return [row | {"load": load()} for row in parts_of(notes.turns, taps[0])]


def open_tapped(config: RigConfig, taps: list[Tap]) -> Rig:
    """Open a rig, not guarded, with a tap on the line to its head."""
    with tapped(MonotonicClock()) as found:
        rig = open_rig(config, guarded=False)
    taps += found
    return rig


def parts_of(turns: list[Turn], tap: Tap) -> list[Row]:
    """Give the parts of each turn whose command reached the wire before the next one was given."""
    orders = [t for t, data in tap.written if ORDER.fullmatch(data)]
    calls = [turn for turn in turns if turn.called is not None]
    rows = []
    for turn, after in zip(calls, [*calls[1:], None], strict=True):
        assert turn.called is not None
        assert turn.detecting is not None
        assert turn.detected is not None
        next_order = bisect.bisect_left(orders, turn.called)
        # Nothing is sent where the head is already on its way to that pose.
        if next_order == len(orders) or (after is not None and orders[next_order] >= (after.called or 0.0)):
            continue
        first_byte = orders[next_order]
        detection = turn.detected - turn.detecting
        rows.append(
            {
                "t_s": turn.arrived - turns[0].arrived,
                "in_hand_s": turn.read - turn.arrived,
                "detection_s": detection,
                "aiming_s": turn.called - turn.detected + turn.detecting - turn.read,
                "line_s": first_byte - turn.called,
                "total_s": first_byte - turn.arrived,
                "beyond_s": first_byte - turn.arrived - detection,
            }
        )
    return rows
