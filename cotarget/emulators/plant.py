"""Interfaces between the emulated devices and the simulated rig: images and their feeds, axes, a lens.

All are safe from any thread. The simulated world runs in `cotarget.emulators.world`; tests use prepared images and
their own axes.
"""

import threading
import time
from dataclasses import dataclass
from typing import Protocol

import cv2

from cotarget.rig import Image


@dataclass(frozen=True, eq=False)
class Picture:
    """One image of a camera."""

    image: Image  # (H, W, 3) BGR
    index: int  # sequence number, increasing
    t: float  # middle of the exposure on the machine's monotonic clock [s]


def encode_jpeg(image: Image, quality: int, size: tuple[int, int] | None = None) -> bytes:
    """Encode an image as JPEG, scaled to a size by averaging areas.

    Args:
        image: (H, W, 3) BGR.
        quality: 0 to 100.
        size: (width, height) [px], of any aspect ratio; None for the image's own.
    """
    if size is not None and size != image.shape[1::-1]:
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


class Feed:
    """The newest image of a camera, published by one thread and awaited by others.

    Attributes:
        moments: (middle of the exposure, time of publication) of the newest image on the machine's monotonic clock [s];
            None before the first.
    """

    def __init__(self) -> None:
        self._picture: Picture | None = None
        self.moments: tuple[float, float] | None = None
        self._new = threading.Condition()

    def publish(self, picture: Picture) -> None:
        """Replace the newest image."""
        with self._new:
            self._picture, self.moments = picture, (picture.t, time.monotonic())
            self._new.notify_all()

    def newest(self, after: int = -1, timeout: float = 0.0) -> Picture | None:
        """Wait for the newest image whose index is above ``after``; None if none comes within ``timeout`` [s]."""

        def there() -> bool:
            return self._picture is not None and self._picture.index > after

        with self._new:
            return self._picture if self._new.wait_for(there, timeout) else None


class AxisPlant(Protocol):
    """Mechanics of one axis of a pan-tilt unit, in the unit's steps."""

    def command(self, goal: int, speed: float, acceleration: float) -> None:
        """Start a move to a goal [steps], at a speed [steps/s] and an acceleration [steps/s^2], even during a move."""

    def halt(self, acceleration: float) -> None:
        """Start braking at an acceleration [steps/s^2]."""

    def position(self) -> int:
        """Return the present position [steps]."""

    def speed(self) -> float:
        """Return the present speed, signed [steps/s]."""

    def moving(self) -> bool:
        """Return whether the axis moves, or is about to."""


class LensPlant(Protocol):
    """A zoom lens with positions."""

    @property
    def last(self) -> int:
        """Number of the last position, counted from 0."""

    def command(self, position: int) -> None:
        """Start a move to a position."""

    def position(self) -> int:
        """Return the present position."""
