"""What other threads wish of the one that owns the line to a PTU-D46, and what became of it."""

import threading
from collections import deque
from dataclasses import dataclass, field
from typing import TypeVar

from cotarget.errors import DeviceError, HaltedError

Wish = TypeVar("Wish")


class DroppedError(HaltedError):
    """A move did not come to its end because of another wish."""


class CutError(DeviceError):
    """A move did not come to its end because the line was silent, so that the head was halted."""


@dataclass(eq=False)
class Move:
    """A wish to go somewhere.

    Attributes:
        number: counts wishes; a move older than a halt is not sent any more.
        goals: of pan and tilt [steps].
        speeds: of pan and tilt [steps/s].
        wait: whether somebody waits for its end, and is told the error.
        deadline: when it should have arrived [s], once it is sent.
        cuts: how often it was set out on anew after the line was silent.
        error: why it did not arrive.
        done: set when the head has arrived, or never will.
    """

    number: int
    goals: tuple[int, int]
    speeds: tuple[int, int]
    wait: bool = False
    deadline: float | None = None
    cuts: int = 0
    error: DeviceError | None = None
    done: threading.Event = field(default_factory=threading.Event)

    def finish(self, error: DeviceError | None = None) -> None:
        """Tell whoever waits."""
        self.error = error
        self.done.set()


@dataclass(eq=False)
class Halt:
    """A wish to stop.

    Attributes:
        number: counts wishes, as a move's does.
        answered: whether the unit has said that it stops.
        done: set when it has, or will not.
    """

    number: int
    answered: bool = False
    done: threading.Event = field(default_factory=threading.Event)


def drained(queue: deque[Wish]) -> list[Wish]:
    """Take all wishes out of a queue that others go on filling."""
    return [queue.popleft() for _ in range(len(queue))]
