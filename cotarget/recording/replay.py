"""Replay a recording as a rig: the same cameras, lens, head and clock, without the devices.

A run that makes the recorded calls in the recorded order gets exactly the recorded results, and so behaves the same to
the last bit. A run that differs still gets the fixed camera's frames in order; every other call is matched with the
recorded calls between the same two frames, and a call without a match is answered by the time on the recording's clock.

Commands move nothing: they are compared with the recorded ones (`Differences`), and the head is where it was recorded.
"""

import math
import threading
from bisect import bisect_left
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import cv2
import numpy as np

import cotarget.errors
from cotarget.errors import CotargetError, DeviceError, StaleFrameError
from cotarget.geometry import RigidTransform
from cotarget.recording.format import COMPLETE, Event, Recording, argument_numbers, is_same
from cotarget.rig import Frame, Image, PanTiltLimits, PanTiltState, Rig, Speed, ZoomState, to_step

if TYPE_CHECKING:
    from cotarget.control.orders import Order

COMMANDS = ("head.move", "zoom.zoom", "head.halt")


class RecordingEndedError(CotargetError):
    """The recording ends here; every replay ends with this error."""


@dataclass(frozen=True)
class Differences:
    """Comparison of a replay's commands with the recorded ones.

    Attributes:
        moves: number of compared moves of the head.
        moves_differing: number of them that differ.
        largest_deg: largest difference of pan or tilt [degrees].
        zooms: number of compared commands to the lens.
        zooms_differing: number of them that differ.
        largest_px: largest difference of focal length [px].
        missing: recorded commands without a match between the same two frames.
        extra: moves of head and lens without a recorded match.
        frames: number of the fixed camera's frames, up to the newest.
        frames_differing: number of them that are followed by another, a missing or an extra command.
        first_frame: image number of the first such frame; None if there is none.
        first_s: its time since the beginning of the recording [s].
    """

    moves: int = 0
    moves_differing: int = 0
    largest_deg: float = 0.0
    zooms: int = 0
    zooms_differing: int = 0
    largest_px: float = 0.0
    missing: int = 0
    extra: int = 0
    frames: int = 0
    frames_differing: int = 0
    first_frame: int | None = None
    first_s: float | None = None

    @property
    def same(self) -> bool:
        """Whether the replay's commands are exactly the recorded ones."""
        return not (self.moves_differing or self.zooms_differing or self.missing or self.extra)

    def __str__(self) -> str:
        """Describe the comparison in one line."""
        if self.same:
            return f"all {self.moves + self.zooms} commands as recorded"
        since = "" if self.first_frame is None else f", from frame {self.first_frame} ({self.first_s:.2f} s) on"
        return (
            f"the commands of {self.frames_differing} of {self.frames} frames differ from those recorded{since}: "
            f"{self.moves_differing} of {self.moves} moves differ, by {self.largest_deg:.3g} degrees at most; "
            f"{self.zooms_differing} of {self.zooms} focal lengths, by {self.largest_px:.3g} px at most; "
            f"{self.missing} commands missing, {self.extra} more"
        )


class _Span:
    """Recorded calls from one frame of the fixed camera to the next, in a queue for each kind of call.

    A reading of the clock is replayed only between the same two other calls. So a run that reads the clock more or less
    often than the recorded one has the right time again at its next other call.
    """

    def __init__(self) -> None:
        self._waiting: dict[str, deque[tuple[int, Event]]] = defaultdict(deque)
        self._size = 0
        self._progress = 0  # place after the furthest other call that was replayed

    def add(self, event: Event) -> None:
        """Append a call."""
        self._waiting[event.call].append((self._size, event))
        self._size += event.call != "clock.now"

    def take(self, call: str) -> Event | None:
        """Take the next event of a call; None if there is none, or a clock reading is not due yet."""
        waiting, looks = self._waiting[call], self._waiting["clock.now"]
        if not waiting or (call == "clock.now" and waiting[0][0] > self._progress):
            return None
        place, event = waiting.popleft()
        if call != "clock.now":
            self._progress = max(self._progress, place + 1)
            while looks and looks[0][0] <= place:
                looks.popleft()
        return event

    def left(self, call: str) -> int:
        """Return how many events of a call were not taken."""
        return len(self._waiting[call])

    def forget(self, call: str) -> None:
        """Drop all events of a call."""
        self._waiting[call].clear()


class Replay:
    """A recording during its replay.

    Attributes:
        now: the replay's clock [s].
        differences: of the commands so far; recorded commands after the newest frame do not count as missing yet.
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._spans, self._frames = _spans_and_frames(recording.events)
        self._orders = deque(_orders_by_span(recording))
        self._differing: set[int] = set()  # places of the frames whose commands differ
        self._first: int | None = None  # the first of them
        self._broke_off = not recording.truncated and recording.ending != COMPLETE
        self._index = 0
        self._ended = False
        self._thread = threading.get_ident()
        self.differences = Differences()
        self.now = recording.events[0].at if recording.events else 0.0

    @cached_property
    def rig(self) -> Rig:
        """The recording as a rig."""
        recording = self._recording
        return Rig(
            fixed=_FixedCamera(self, recording.directory, recording.spec.fixed.size),
            zoom=_ZoomCamera(self, recording),
            head=_Head(self, recording),
            clock=_Clock(self),
            board=_Board(),
            spec=recording.spec,
            release=lambda: None,
            config=recording.config,
        )

    @property
    def is_aside(self) -> bool:
        """Whether another thread than the run's calls, such as the watchdog's; it is answered by time."""
        return threading.get_ident() != self._thread

    @property
    def breaks_off(self) -> bool:
        """Whether an error ended the run after the newest frame, so that later calls are unknown."""
        return self._broke_off and self._index == len(self._spans) - 1

    def was_ended_by(self, error: CotargetError) -> bool:
        """Whether this error ended the recorded run too, after the same frame."""
        ending = self._recording.ending
        return self.breaks_off and str(error) in (ending, ending.partition(": ")[2])

    def orders(self) -> "list[Order]":
        """Return the operator's orders that came with the newest frame, or with one that was left out before it."""
        found = []
        while self._orders and self._orders[0][0] <= self._index:
            found.append(self._orders.popleft()[1])
        return found

    def take(self, call: str) -> Event | None:
        """Take the recorded event of a call between the same two frames; None if there is none.

        Raises:
            RecordingEndedError: the run was ended by an error before such a call.
        """
        if self.is_aside:
            return None
        span = self._spans[self._index]
        event = span.take(call)
        if event is None and self.breaks_off and not span.left(call) and not self._ended and call not in COMMANDS:
            raise self._end()
        return event

    def refusal(self) -> Event | None:
        """Take the event of a move that the safety layer refused between the same two frames; None if there is none."""
        return None if self.is_aside else self._spans[self._index].take("head.refused")

    def play(self, event: Event) -> Event:
        """Advance the clock to an event, and raise its error if it has one.

        Raises:
            CotargetError: as recorded.
        """
        self.pass_to(event.at)
        if event.error is not None:
            raise _recorded_error(*event.error, event.error_class)
        return event

    def answer(self, call: str) -> Event | None:
        """Take an event and play it; None if there is none."""
        event = self.take(call)
        return None if event is None else self.play(event)

    def next_frame(self, newer_than: float | None, timeout: float) -> Event:
        """Return the next frame of the fixed camera; the newest at this time if the replay has fallen behind.

        Raises:
            RecordingEndedError: there are no more frames.
            StaleFrameError: no such frame came within ``timeout``.
            CotargetError: as recorded.
        """
        for index in range(self._index + 1, len(self._spans)):
            frame, following = self._frames[index - 1], self._frames[index : index + 1]
            overtaken = bool(following) and following[0].at < self.now
            too_old = newer_than is not None and frame.error is None and frame.numbers[0] <= newer_than
            if frame.error is not None or not (overtaken or too_old):
                break
        else:
            self._miss(range(self._index, len(self._spans)))
            raise self._end()
        if frame.args != (newer_than, timeout) and frame.at > self.now + timeout:
            self.now += timeout
            raise StaleFrameError(f"no frame within {timeout:g} s")
        self._miss(range(self._index, index))
        self._index = index
        self.differences = replace(self.differences, frames=index)
        return self.play(frame)

    def compare(self, call: str, recorded: Event | None, args: Sequence[float | bool | None]) -> None:
        """Count a command and its difference from the recorded one."""
        if self.is_aside:
            return
        counts = self.differences
        if recorded is None:
            if not (self._ended or self.breaks_off):
                self.differences = replace(counts, extra=counts.extra + 1)
                self._note(self._index)
            return
        differs = tuple(args) != recorded.args
        axes = 2 if call == "head.move" else 1
        pairs = zip(recorded.args[:axes], args[:axes], strict=True)
        off = max(abs(float(now or 0.0) - float(then or 0.0)) for then, now in pairs)
        if call == "head.move":
            self.differences = replace(
                counts,
                moves=counts.moves + 1,
                moves_differing=counts.moves_differing + differs,
                largest_deg=max(counts.largest_deg, math.degrees(off)),
            )
        else:
            self.differences = replace(
                counts,
                zooms=counts.zooms + 1,
                zooms_differing=counts.zooms_differing + differs,
                largest_px=max(counts.largest_px, off),
            )
        if differs:
            self._note(self._index)

    def pass_to(self, t: float) -> None:
        """Advance the clock to ``t`` [s], unless it is later already."""
        self.now = max(self.now, t)

    def _miss(self, over: range) -> None:
        """Count untaken commands of past spans as missing; halts of the last span come only when the rig closes."""
        for index in over:
            span = self._spans[index]
            due = COMMANDS[:-1] if span is self._spans[-1] else COMMANDS
            missing = sum(span.left(call) for call in due)
            for call in due:
                span.forget(call)
            if missing:
                self.differences = replace(self.differences, missing=self.differences.missing + missing)
                self._note(index)

    def _note(self, index: int) -> None:
        """Count the frame at the start of a span as differing; calls before the first frame count for the first."""
        place = max(index - 1, 0)
        self._differing.add(place)
        found = replace(self.differences, frames_differing=len(self._differing))
        if self._frames and (self._first is None or place < self._first):
            self._first = place
            frame, number = self._frames[place], sum(each.image is not None for each in self._frames[:place])
            if frame.image is not None:
                number = int(Path(frame.image).stem)
            found = replace(found, first_frame=number, first_s=frame.at - self._recording.events[0].at)
        self.differences = found

    def _end(self) -> RecordingEndedError:
        self._ended = True
        return RecordingEndedError(f"{self._recording.directory}: the recording ends here, at {self.now:.2f} s")


def _spans_and_frames(events: Sequence[Event]) -> tuple[list[_Span], list[Event]]:
    """Return the spans between frames, the first before any, and the frames; calls of other threads are left out."""
    spans, frames = [_Span()], []
    for event in events:
        if event.aside:
            continue
        if event.call == "fixed.read":
            spans.append(_Span())
            frames.append(event)
        else:
            spans[-1].add(event)
    return spans, frames


def _orders_by_span(recording: Recording) -> "list[tuple[int, Order]]":
    """Return the operator's orders, each with the place of its span."""
    reads = [i for i, event in enumerate(recording.events) if event.call == "fixed.read" and not event.aside]
    return [(bisect_left(reads, place), order) for place, order in recording.orders]


def _recorded_error(name: str, message: str, error_class: str) -> CotargetError:
    """Make the recorded exception by its nearest class in `cotarget.errors`, or a DeviceError."""
    kind = getattr(cotarget.errors, error_class or name, None)
    if isinstance(kind, type) and issubclass(kind, CotargetError):
        return kind(message)
    return DeviceError(f"{name}: {message}")


T = TypeVar("T")


def until_end(steps: Iterable[T], replay: Replay | None = None) -> Iterator[T]:
    """Yield the steps of a run on a replayed rig until the recording ends.

    With ``replay``, the error that ended the recorded run ends this one without being raised.
    """
    try:
        yield from steps
    except RecordingEndedError:
        pass
    except CotargetError as error:
        if replay is None or not replay.was_ended_by(error):
            raise


class _Camera:
    """Common part of both cameras: frames from files, with the same image object for the same file."""

    def __init__(self, replay: Replay, directory: Path, size: tuple[int, int]) -> None:
        self._replay, self._directory, self._size = replay, directory, size
        self._newest: tuple[str, Image] | None = None
        self._last: Frame | None = None  # by its exposure time

    @property
    def size(self) -> tuple[int, int]:
        return self._size

    def _frame(self, event: Event, name: str | None) -> Frame:
        if name is None:
            image: Image = np.zeros((self._size[1], self._size[0], 3), np.uint8)
        elif self._newest is not None and self._newest[0] == name:
            image = self._newest[1]
        else:
            read = cv2.imread(str(self._directory / name), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
            if read is None:
                raise DeviceError(f"{self._directory / name}: is damaged, so the replay ends here")
            image = np.asarray(read, dtype=np.uint8)
            image.flags.writeable = False
            self._newest = (name, image)
        last, repeated = self._last, event.repeated
        if repeated is None:
            repeated = last is not None and is_same(image, last.image)
        frame = Frame(image, event.numbers[0], repeated, event.number)
        if last is None or frame.t > last.t:
            self._last = frame
        return frame


class _FixedCamera(_Camera):
    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        event = self._replay.next_frame(newer_than, timeout)
        return self._frame(event, event.image)


class _ZoomCamera(_Camera):
    def __init__(self, replay: Replay, recording: Recording) -> None:
        super().__init__(replay, recording.directory, recording.spec.zoom.size)
        self._spec = recording.spec.zoom
        self._frames = [e for e in recording.events if e.call == "zoom.read" and e.error is None]
        self._kept = [e for e in self._frames if e.image is not None]
        states = [e.numbers for e in recording.events if e.call == "zoom.state" and e.error is None]
        self._states = _StateHistory(states)

    @property
    def still_size(self) -> tuple[int, int]:
        return self._spec.still_size

    @property
    def focal_range(self) -> tuple[float, float]:
        return self._spec.focal_range

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        event = self._replay.answer("zoom.read")
        if event is None or (newer_than is not None and event.numbers[0] <= newer_than):
            event = self._by_time(newer_than, timeout)
        return self._frame(event, event.image or self._stand_in(event))

    def capture(self) -> Frame:
        event = self._replay.answer("zoom.capture") or self._by_time(None, 1.0)
        return self._frame(event, event.image or self._stand_in(event))

    def zoom(self, focal_px: float) -> float:
        recorded = self._replay.take("zoom.zoom")
        self._replay.compare("zoom.zoom", recorded, (focal_px,))
        if recorded is not None:
            self._replay.play(recorded)
            if recorded.args == (focal_px,):
                return recorded.numbers[0]
        if not 0 < focal_px < math.inf:
            raise DeviceError(f"the lens cannot go to a focal length of {focal_px} px")
        return min(max(focal_px, self.focal_range[0]), self.focal_range[1])

    def state(self) -> ZoomState:
        event = self._replay.answer("zoom.state")
        if event is None:
            (focal,), moving = self._states.at(self._replay.now, "lens")
            return ZoomState(focal, moving, self._replay.now)
        focal, moves, t = event.numbers
        return ZoomState(focal, bool(moves), t)

    def _by_time(self, newer_than: float | None, timeout: float) -> Event:
        """Return the newest frame read by now, or the first one within ``timeout``."""
        fresh = [e for e in self._frames if newer_than is None or e.numbers[0] > newer_than]
        if before := [e for e in fresh if e.at <= self._replay.now]:
            return before[-1]
        if fresh and fresh[0].at <= self._replay.now + timeout:
            self._replay.pass_to(fresh[0].at)
            return fresh[0]
        self._replay.pass_to(self._replay.now + timeout)
        raise StaleFrameError(f"no frame of the zoom camera within {timeout:g} s")

    def _stand_in(self, event: Event) -> str | None:
        """Return the image of the last earlier frame that has one."""
        before = [e.image for e in self._kept if e.at <= event.at]
        return before[-1] if before else None


class _Head:
    def __init__(self, replay: Replay, recording: Recording) -> None:
        self._replay, self._limits = replay, recording.spec.head.limits
        states = [e.numbers for e in recording.events if e.call == "head.state" and e.error is None]
        self._states = _StateHistory([numbers[:4] for numbers in states])

    @property
    def limits(self) -> PanTiltLimits:
        return self._limits

    def state(self) -> PanTiltState:
        event = self._replay.answer("head.state")
        if event is None:
            (pan, tilt), moving = self._states.at(self._replay.now, "head")
            return PanTiltState(pan, tilt, moving, self._replay.now)
        pan, tilt, moves, t, *sigma = event.numbers
        return PanTiltState(pan, tilt, bool(moves), t, *sigma)

    def move(self, pan: float, tilt: float, speed: Speed | None = None, wait: bool = False) -> tuple[float, float]:
        refused, recorded = self._replay.refusal(), self._replay.take("head.move")
        args = argument_numbers("head.move", (pan, tilt, speed, wait))
        if refused is not None:
            if recorded is not None:  # the stop came while the device moved
                self._replay.compare("head.move", recorded, args)
            self._replay.take("head.halt")  # with which the safety layer answers a new stop
            self._replay.play(refused)
        self._replay.compare("head.move", recorded, args)
        if recorded is not None:
            self._replay.play(recorded)
            if recorded.args == args:
                return recorded.numbers[0], recorded.numbers[1]
        if not (math.isfinite(pan) and math.isfinite(tilt)):
            raise DeviceError(f"the head cannot go to pan {pan}, tilt {tilt}")
        pan, tilt = (
            to_step(axis.clip(angle), axis.step) for angle, axis in zip((pan, tilt), self._limits.axes, strict=True)
        )
        return pan, tilt

    def halt(self) -> None:
        try:
            self._replay.answer("head.halt")
        except CotargetError:
            if not self._replay.breaks_off:  # a halt that failed when the recorded rig was closed leaves nothing moving
                raise


class _Clock:
    def __init__(self, replay: Replay) -> None:
        self._replay = replay

    def now(self) -> float:
        event = self._replay.answer("clock.now")
        return self._replay.now if event is None else event.numbers[0]

    def sleep_until(self, t: float) -> None:
        if self._replay.answer("clock.sleep_until") is None and not self._replay.is_aside:
            self._replay.pass_to(t)


class _Board:
    patience = 0.0

    def present(self, T_fixed_board: RigidTransform | None) -> None:
        """Do nothing: the board is in the recorded images."""

    def swing(self, T_fixed_board: RigidTransform) -> None:
        """Do nothing: the board is in the recorded images."""


class _StateHistory:
    """Recorded states of a device: numbers, whether it moved, and the time."""

    def __init__(self, states: Sequence[Sequence[float]]) -> None:
        rows = np.array(states, dtype=float)
        self._rows = rows[np.argsort(rows[:, -1], kind="stable")] if len(rows) else rows

    def at(self, t: float, device: str) -> tuple[list[float], bool]:
        """Interpolate the numbers linearly at a time [s]; return them and whether the device moved."""
        if not len(self._rows):
            raise DeviceError(f"the recording holds no state of the {device}")
        times = self._rows[:, -1]
        before = max(int(np.searchsorted(times, t, side="right")) - 1, 0)
        values = [float(np.interp(t, times, column)) for column in self._rows[:, :-2].T]
        return values, bool(self._rows[before, -2])
