"""Opens a recording as a rig: the same cameras, lens, head and clock again, without the devices.

What is commanded moves nothing: it is compared with what was commanded then, and the head goes where it went.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TypeVar

import cv2
import numpy as np

from cotarget.errors import DeviceError, StaleFrameError
from cotarget.geometry import RigidTransform
from cotarget.recordformat import Event, move_args
from cotarget.recordreader import Recording, open_recording
from cotarget.replaytape import Differences, RecordingEndedError, Tape, time_of
from cotarget.rig import (
    Board,
    Camera,
    Clock,
    Frame,
    Image,
    PanTilt,
    PanTiltLimits,
    PanTiltState,
    Speed,
    ZoomCamera,
    ZoomState,
)

__all__ = ["Differences", "Recording", "RecordingEndedError", "ReplayRig", "open_recording", "until_end"]

T = TypeVar("T")


def until_end(steps: Iterable[T]) -> Iterator[T]:
    """Pass on what a run on a `ReplayRig` yields, until the recording ends."""
    with suppress(RecordingEndedError):
        yield from steps


class _Camera:
    """What both cameras share: frames from files, the same object for the same frame."""

    def __init__(self, tape: Tape, directory: Path, size: tuple[int, int]) -> None:
        self._tape, self._directory, self._size = tape, directory, size
        self._newest: tuple[str, Image] | None = None

    @property
    def size(self) -> tuple[int, int]:
        return self._size

    def _frame(self, event: Event, name: str | None) -> Frame:
        if name is None:
            image: Image = np.zeros((self._size[1], self._size[0], 3), np.uint8)
        elif self._newest is not None and self._newest[0] == name:
            image = self._newest[1]
        else:
            read = cv2.imread(str(self._directory / name), cv2.IMREAD_COLOR)
            if read is None:
                raise DeviceError(f"{self._directory / name}: is damaged, so the replay ends here")
            image = np.asarray(read, dtype=np.uint8)
            image.flags.writeable = False
            self._newest = (name, image)
        return Frame(image, time_of(event))


class _FixedCamera(_Camera):
    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        event = self._tape.next_frame(newer_than, timeout)
        return self._frame(event, event.image)


class _ZoomCamera(_Camera):
    def __init__(self, tape: Tape, recording: Recording) -> None:
        super().__init__(tape, recording.directory, recording.facts.zoom_size)
        self._facts = recording.facts
        self._frames = [e for e in recording.events if e.call == "zoom.read" and e.error is None]
        self._kept = [e for e in self._frames if e.image is not None]
        states = [e for e in recording.events if e.call == "zoom.state" and e.error is None]
        self._states = _Track(states)

    @property
    def still_size(self) -> tuple[int, int]:
        return self._facts.still_size

    @property
    def focal_range(self) -> tuple[float, float]:
        return self._facts.focal_range

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        event = self._tape.answer("zoom.read")
        if event is None or (newer_than is not None and time_of(event) <= newer_than):
            event = self._by_time(newer_than, timeout)
        return self._frame(event, event.image or self._stand_in(event))

    def capture(self) -> Frame:
        event = self._tape.answer("zoom.capture") or self._by_time(None, 1.0)
        return self._frame(event, event.image or self._stand_in(event))

    def zoom(self, focal_px: float) -> float:
        recorded = self._tape.take("zoom.zoom")
        self._tape.compare("zoom.zoom", recorded, (focal_px,))
        if recorded is not None:
            self._tape.play(recorded)
            if recorded.args == (focal_px,):
                return float(recorded.result[0] or 0.0)
        if not 0 < focal_px < math.inf:
            raise DeviceError(f"the lens cannot go to a focal length of {focal_px} px")
        return min(max(focal_px, self.focal_range[0]), self.focal_range[1])

    def state(self) -> ZoomState:
        event = self._tape.answer("zoom.state")
        if event is None:
            (focal,), moving = self._states.at(self._tape.now, "lens")
            return ZoomState(focal, moving, self._tape.now)
        then = event.result
        return ZoomState(float(then[0] or 0.0), bool(then[1]), float(then[2] or 0.0))

    def _by_time(self, newer_than: float | None, timeout: float) -> Event:
        """The newest frame that had been read by now, or the first that was within ``timeout``."""
        fresh = [e for e in self._frames if newer_than is None or time_of(e) > newer_than]
        if before := [e for e in fresh if e.at <= self._tape.now]:
            return before[-1]
        if fresh and fresh[0].at <= self._tape.now + timeout:
            self._tape.pass_to(fresh[0].at)
            return fresh[0]
        self._tape.pass_to(self._tape.now + timeout)
        raise StaleFrameError(f"no frame of the zoom camera within {timeout:g} s")

    def _stand_in(self, event: Event) -> str | None:
        """The image of the last frame before that has one."""
        before = [e.image for e in self._kept if e.at <= event.at]
        return before[-1] if before else None


class _Head:
    def __init__(self, tape: Tape, recording: Recording) -> None:
        self._tape, self._limits = tape, recording.facts.limits
        self._states = _Track([e for e in recording.events if e.call == "head.state" and e.error is None])

    @property
    def limits(self) -> PanTiltLimits:
        return self._limits

    def state(self) -> PanTiltState:
        event = self._tape.answer("head.state")
        if event is None:
            (pan, tilt), moving = self._states.at(self._tape.now, "head")
            return PanTiltState(pan, tilt, moving, self._tape.now)
        then = event.result
        return PanTiltState(float(then[0] or 0.0), float(then[1] or 0.0), bool(then[2]), float(then[3] or 0.0))

    def move(self, pan: float, tilt: float, speed: Speed | None = None, wait: bool = False) -> tuple[float, float]:
        recorded = self._tape.take("head.move")
        args = move_args(pan, tilt, speed, wait)
        self._tape.compare("head.move", recorded, args)
        if recorded is not None:
            self._tape.play(recorded)
            if recorded.args == args:
                return float(recorded.result[0] or 0.0), float(recorded.result[1] or 0.0)
        if not (math.isfinite(pan) and math.isfinite(tilt)):
            raise DeviceError(f"the head cannot go to pan {pan}, tilt {tilt}")
        return self._possible(pan, self._limits.pan), self._possible(tilt, self._limits.tilt)

    def halt(self) -> None:
        self._tape.answer("head.halt")

    def _possible(self, angle: float, limits: tuple[float, float]) -> float:
        step = self._limits.step
        low, high = limits
        if step <= 0:
            return min(max(angle, low), high)
        return min(max(round(angle / step), math.ceil(low / step)), math.floor(high / step)) * step


class _Clock:
    def __init__(self, tape: Tape) -> None:
        self._tape = tape

    def now(self) -> float:
        event = self._tape.answer("clock.now")
        return self._tape.now if event is None else float(event.result[0] or 0.0)

    def sleep_until(self, t: float) -> None:
        if self._tape.answer("clock.sleep_until") is None and not self._tape.is_aside:
            self._tape.pass_to(t)


class _Board:
    patience = 0.0

    def present(self, T_fixed_board: RigidTransform | None) -> None:
        """Nothing to do: whatever was wished for is in the pictures."""

    def swing(self, T_fixed_board: RigidTransform) -> None:
        """Nothing to do."""


class _Track:
    """States of a device over time: numbers, whether it moved, and the time, as they were recorded."""

    def __init__(self, events: Sequence[Event]) -> None:
        rows = np.array([[float(value or 0.0) for value in e.result] for e in events], dtype=float)
        self._rows = rows[np.argsort(rows[:, -1], kind="stable")] if len(rows) else rows

    def at(self, t: float, device: str) -> tuple[list[float], bool]:
        """The numbers at a time [s], between two states on the straight line, and whether it moved."""
        if not len(self._rows):
            raise DeviceError(f"the recording holds no state of the {device}")
        times = self._rows[:, -1]
        before = max(int(np.searchsorted(times, t, side="right")) - 1, 0)
        values = [float(np.interp(t, times, column)) for column in self._rows[:, :-2].T]
        return values, bool(self._rows[before, -2])


class ReplayRig:
    """A recording as a rig; see `cotarget.replaytape` for what it answers. Wrap it as the recorded rig was wrapped."""

    def __init__(self, recording: Recording) -> None:
        self._tape = Tape(recording)
        self.real_time = recording.facts.real_time
        self.fixed: Camera = _FixedCamera(self._tape, recording.directory, recording.facts.fixed_size)
        self.zoom: ZoomCamera = _ZoomCamera(self._tape, recording)
        self.head: PanTilt = _Head(self._tape, recording)
        self.clock: Clock = _Clock(self._tape)
        self.board: Board = _Board()

    @property
    def differences(self) -> Differences:
        """Between the commands so far and those recorded."""
        return self._tape.differences

    def close(self) -> None:
        """Nothing to release."""

    def __enter__(self) -> "ReplayRig":
        """Give the rig itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()
