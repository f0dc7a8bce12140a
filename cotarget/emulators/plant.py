"""What the emulated devices' protocols stand in front of: pictures, axes, a lens. All of it is safe from any thread.

The simulated world itself runs in `cotarget.emulators.world`; tests put ready-made pictures and their own axes here.
"""

import threading
import time
from dataclasses import dataclass
from typing import Protocol

from cotarget.rig import Image


@dataclass(frozen=True, eq=False)
class Picture:
    """One image of a camera.

    Attributes:
        image: (H, W, 3) BGR.
        index: its number, which grows.
        t: middle of the exposure on the machine's monotonic clock [s].
    """

    image: Image
    index: int
    t: float


class Feed:
    """The newest picture of a camera, published by one thread and waited for by others.

    Attributes:
        moments: when the light of the newest picture fell, and when it was published, on the machine's monotonic clock
            [s]; None before the first.
    """

    def __init__(self) -> None:
        self._picture: Picture | None = None
        self.moments: tuple[float, float] | None = None
        self._new = threading.Condition()

    def publish(self, picture: Picture) -> None:
        """Replace the newest picture."""
        with self._new:
            self._picture, self.moments = picture, (picture.t, time.monotonic())
            self._new.notify_all()

    def newest(self, after: int = -1, timeout: float = 0.0) -> Picture | None:
        """The newest picture whose index is above ``after``; None if none comes within ``timeout`` [s]."""

        def there() -> bool:
            return self._picture is not None and self._picture.index > after

        with self._new:
            return self._picture if self._new.wait_for(there, timeout) else None


class AxisPlant(Protocol):
    """The mechanics of one axis of a pan-tilt unit, in the unit's own steps."""

    def command(self, goal: int, speed: float, acceleration: float) -> None:
        """Go there from now on, whatever it did before: steps, steps/s, steps/s^2."""

    def halt(self, acceleration: float) -> None:
        """Brake from now on."""

    def position(self) -> int:
        """Where it is now, by its own count [steps]."""

    def speed(self) -> float:
        """How fast it turns now, signed [steps/s]."""

    def moving(self) -> bool:
        """Whether it turns now, or is about to."""


class LensPlant(Protocol):
    """A stepping zoom lens."""

    @property
    def last(self) -> int:
        """The number of its last position, counted from 0."""

    def command(self, position: int) -> None:
        """Go there from now on."""

    def position(self) -> int:
        """Where it is now."""

    def moving(self) -> bool:
        """Whether it moves now, or is about to."""
