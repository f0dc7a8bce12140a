"""What a driver of a polled pan-tilt unit provides: a `HeadLink`, and the `Requests` that it must not hold up."""

import contextlib
import queue
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

from cotarget.drivers.axes import AxisFacts, Poll
from cotarget.errors import DeviceError, HaltedError

# Requests of other threads

Request = TypeVar("Request")
Pair = tuple[float, float]  # of pan and tilt, in the unit's numbers


class DroppedError(HaltedError):
    """A move ended early because of a halt, a newer move, or the end of the driver."""


@dataclass(eq=False)
class Move:
    """A request to move both axes."""

    number: int  # sequence number of the request; a move numbered before a halt is not sent any more
    goals: Pair
    speeds: Pair
    wait: bool = False  # whether the caller waits for the end, and so receives the error
    deadline: float | None = None  # time by which the head should have arrived [s]; None until the move is sent
    rests_by: float | None = None  # time by which a head that is late at its goal should stand there [s]
    cuts: int = 0  # how often the move was sent again after the line was silent
    error: DeviceError | None = None  # why the head did not arrive
    done: threading.Event = field(default_factory=threading.Event)  # set when the head has arrived, or will not

    def finish(self, error: DeviceError | None = None) -> None:
        """End the move and wake the caller that waits."""
        self.error = error
        self.done.set()


@dataclass(eq=False)
class Halt:
    """A request to stop both axes."""

    number: int  # sequence number of the request, shared with moves
    answered: bool = False  # whether the unit acknowledged the halt
    done: threading.Event = field(default_factory=threading.Event)  # set when it has, or will not


class Requests:
    """What other threads want of the unit: the newest move wins, and a halt comes before it.

    Attributes:
        halts: halts that were not sent yet.
        moves: moves that were not sent yet; the newest wins.
        zooms: positions of the lens that were not sent yet; the newest wins.
        closing: whether no more requests will come.
        is_zooming: whether a zoom is sent, which a waiting move does not interrupt.
    """

    def __init__(self) -> None:
        self.halts: deque[Halt] = deque()
        self.moves: deque[Move] = deque()
        self.zooms: deque[float] = deque()
        self.closing = self.is_zooming = False
        self._woken: queue.SimpleQueue[None] = queue.SimpleQueue()  # whose `put` a signal handler may call

    def add(self, queued: deque[Request], request: Request) -> None:
        """Append a request to one of the queues; end a `pause`."""
        queued.append(request)
        self._woken.put(None)

    def close(self) -> None:
        """Let the loop end; no more requests will come."""
        self.closing = True
        self._woken.put(None)

    def pause(self, seconds: float) -> None:
        """Wait until a request comes, for at most a time [s]."""
        with contextlib.suppress(queue.Empty):
            self._woken.get(timeout=seconds) if seconds else self._woken.get_nowait()
            while True:  # one pause is for all that have come
                self._woken.get_nowait()

    def halt_waits(self) -> bool:
        """Whether a halt, or the end of the driver, waits: a link gives up waiting for the unit."""
        return self.closing or bool(self.halts)

    def proceed(self) -> None:
        """Raise if something more urgent than the command under way waits, and the rest of it must not be sent.

        Raises:
            DroppedError: a halt or a newer move waits.
        """
        if self.halt_waits():
            raise DroppedError("the move was halted")
        if self.moves and not self.is_zooming:
            raise DroppedError("another move took this one's place")


def drained(queued: deque[Request]) -> list[Request]:
    """Take all requests out of a queue that other threads go on filling."""
    return [queued.popleft() for _ in range(len(queued))]


# What a driver provides


class HeadLink(Protocol):
    """The protocol of an opened pan-tilt unit; `PolledHead` makes one call at a time.

    A link is a subclass, and so has the methods with a default. It repeats what may be repeated, and ends each call in
    a bounded time. Besides the errors named below every method but `close` may raise LostError where the port failed,
    SilentError where the unit does not answer any more, PositionLostError where its position may be lost, or another
    DeviceError where it cannot be used; the head is then halted and closed for good.

    Attributes:
        name: of the port, for messages.
        axes: facts of pan, of tilt, and of the lens where the unit moves it too, as reported when it was opened.
        pause_s: pause between polls [s]; 0 where the exchange itself takes the time, as on a serial line.
        answer_s: time that the unit may take for an answer, where that is long [s].
    """

    name: str
    axes: tuple[AxisFacts, ...]
    pause_s: float = 0.0
    answer_s: float = 0.0

    def poll(self, requests: Requests) -> Sequence[Poll]:
        """Ask for the position of one axis, in turn, or of several.

        Args:
            requests: where a halt waits, an answer that takes long is not waited for; then nothing is returned.

        Raises:
            CutError: the unit was halted because it was silent.
        """

    def move(self, goals: Pair, speeds: Pair, requests: Requests) -> None:
        """Send pan and tilt to positions at speeds; return when the unit has taken the command.

        Args:
            goals: within the limits of `axes`, in their numbers, and whole steps.
            speeds: within the limits of `axes`, in their numbers.
            requests: its `proceed` is called before each message but the first, also before a repeated one.

        Raises:
            RefusedError: the unit refused the command.
            CutError: the unit was halted because it was silent.
        """

    def renew(self, requests: Requests) -> None:
        """Go on with the move under way; called after each poll until the head has arrived. By default does nothing.

        For a unit that takes velocities: `move` keeps the goals, and `renew` sends the velocities that lead there.
        Raises as `move` does.
        """
        return

    def zoom(self, position: float, requests: Requests) -> None:
        """Send the lens to a position, if it is one of the `axes`. Arguments and errors are those of `move`."""
        raise DeviceError(f"the unit at {self.name} moves no lens")

    def halt(self, patience: float) -> None:
        """Stop pan and tilt; return when the unit has acknowledged it, which takes ``patience`` [s] at most.

        An axis that stands keeps its goal: a servo whose goal becomes its present position would move a little at each
        halt.
        """

    def halt_last(self, patience: float) -> None:
        """Stop both axes in whatever state unit and line are; no other command follows. By default as `halt` does."""
        self.halt(patience)

    def send_halt(self) -> None:
        """Send the halt and wait for no answer; by default as `halt` does."""
        self.halt(0.0)

    def goals(self) -> Pair | None:
        """Positions that pan and tilt were last sent to, also by another program; None if the unit cannot tell."""
        return None

    def check(self) -> None:
        """Raise PositionLostError if the unit has reported by itself that its position may be lost; by default not."""

    def close(self) -> None:
        """Release the port; never raises."""
