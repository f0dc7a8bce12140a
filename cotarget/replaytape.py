"""What was recorded, dealt out again: call by call as long as the run asks the same, by time where it does not.

A run that is what it was when it was recorded asks the same calls in the same order and gets the very same answers, so
it does the same to the last bit. Where it has changed, the frames of the fixed camera still come one after the other,
each with what was asked between it and the next; whatever else is asked gets what was so at that time.
"""

import math
import threading
from collections import defaultdict, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cotarget.errors
from cotarget.errors import CotargetError, DeviceError, StaleFrameError
from cotarget.recordformat import COMPLETE, Event
from cotarget.recordreader import Recording

COMMANDS = ("head.move", "zoom.zoom", "head.halt")


class RecordingEndedError(CotargetError):
    """The recording holds nothing beyond this; every replay ends with it."""


@dataclass(frozen=True)
class Differences:
    """How a replay's commands differ from those that were recorded.

    Attributes:
        moves: of the head, that were compared.
        moves_differing: of them.
        largest_deg: difference of pan or tilt between them [degrees].
        zooms: of the lens, that were compared.
        zooms_differing: of them.
        largest_px: difference of focal length between them [px].
        missing: commands that were given then and not now, between the same two frames.
        extra: moves of head and lens that were given now and not then.
        frames: of the fixed camera, up to the newest.
        frames_differing: of them, after which another command was given, or one more, or one less.
        first_frame: the picture's number of the first of those; None where there is none.
        first_s: when it came, from the beginning of the recording [s].
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
        """Whether the replay commanded exactly what was commanded then."""
        return not (self.moves_differing or self.zooms_differing or self.missing or self.extra)

    def __str__(self) -> str:
        """Say it in one line."""
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
    """What was asked from one frame of the fixed camera to the next, each kind of call in its order.

    A look at the clock was between two other calls; it is given again only there. So a run that looks more often or
    less often than the recorded one has the right time again as soon as it asks for something else.
    """

    def __init__(self) -> None:
        self._waiting: dict[str, deque[tuple[int, Event]]] = defaultdict(deque)
        self._size = 0
        self._progress = 0  # behind the furthest of the other calls that was given again

    def add(self, event: Event) -> None:
        """Append a call."""
        self._waiting[event.call].append((self._size, event))
        self._size += event.call != "clock.now"

    def take(self, call: str) -> Event | None:
        """The next event of a call, if there is one and it is its turn."""
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
        """How many events of a call were not taken."""
        return len(self._waiting[call])

    def forget(self, call: str) -> None:
        """Take all events of a call."""
        self._waiting[call].clear()


class Tape:
    """A recording that runs.

    Attributes:
        now: the replay's clock [s].
        differences: between the commands so far and those recorded; those recorded after the newest frame are not
            missed yet.
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._spans, self._frames = _cut(recording.events)
        self._differing: set[int] = set()  # places of those frames,
        self._first: int | None = None  # and the first of them
        self._broke_off = not recording.truncated and recording.ending != COMPLETE
        self._index = 0
        self._ended = False
        self._thread = threading.get_ident()
        self.differences = Differences()
        self.now = recording.events[0].at if recording.events else 0.0

    @property
    def is_aside(self) -> bool:
        """Whether another thread than the run's own asks, such as a watchdog; it has what is so at this time."""
        return threading.get_ident() != self._thread

    @property
    def _breaks_off(self) -> bool:
        """Whether the run was ended by an error after the newest frame, so that nothing is known of what followed."""
        return self._broke_off and self._index == len(self._spans) - 1

    def take(self, call: str) -> Event | None:
        """The recorded event of a call that the run asked then too, between the same two frames; else None.

        Raises:
            RecordingEndedError: the run broke off before it.
        """
        if self.is_aside:
            return None
        span = self._spans[self._index]
        event = span.take(call)
        if event is None and self._breaks_off and not span.left(call) and not self._ended and call not in COMMANDS:
            raise self._end()
        return event

    def play(self, event: Event) -> Event:
        """Let the time of an event come, and its error.

        Raises:
            CotargetError: as recorded.
        """
        self.pass_to(event.at)
        if event.error is not None:
            raise _recorded_error(*event.error)
        return event

    def answer(self, call: str) -> Event | None:
        """Take an event and play it, where there is one."""
        event = self.take(call)
        return None if event is None else self.play(event)

    def next_frame(self, newer_than: float | None, timeout: float) -> Event:
        """The next frame of the fixed camera; the newest at this time, where the replay has fallen behind.

        Args:
            newer_than: exposed after this time [s].
            timeout: how long to wait [s].

        Raises:
            RecordingEndedError: there are no more.
            DeviceError: no such frame came within ``timeout``.
            CotargetError: as recorded.
        """
        for index in range(self._index + 1, len(self._spans)):
            frame, following = self._frames[index - 1], self._frames[index : index + 1]
            overtaken = bool(following) and following[0].at < self.now
            too_old = newer_than is not None and frame.error is None and time_of(frame) <= newer_than
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
        """Count a command, and by how much it differs from the one recorded."""
        if self.is_aside:
            return
        counts = self.differences
        if recorded is None:
            if not (self._ended or self._breaks_off):
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
        """Let the clock show at least ``t`` [s]."""
        self.now = max(self.now, t)

    def _miss(self, over: range) -> None:
        """Count the commands of spans that are over; the last one's halts are not due before the rig is closed."""
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
        """Count the frame that a span begins with; what is asked before the first frame is counted to it."""
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


def time_of(frame: Event) -> float:
    """When a frame was exposed [s]."""
    return float(frame.result[0] or 0.0)


def _cut(events: Sequence[Event]) -> tuple[list[_Span], list[Event]]:
    """Spans from frame to frame, the first before any, and the frames; other threads' calls are left out."""
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


def _recorded_error(name: str, message: str) -> CotargetError:
    """The exception that was raised then; one that is not cotarget's own is a device's failure."""
    kind = getattr(cotarget.errors, name, None)
    if isinstance(kind, type) and issubclass(kind, CotargetError):
        return kind(message)
    return DeviceError(f"{name}: {message}")
