"""What the pipeline sees of a rig: frames, four small device Protocols and a clock.

A rig is the MuJoCo simulation, real devices, or a recording; the pipeline cannot tell which. Every blocking call
advances the rig's own clock, which is simulated time in the simulation.
"""

from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from cotarget.errors import ConfigError, DeviceError
from cotarget.geometry import RigidTransform

if TYPE_CHECKING:
    from cotarget.config import RigConfig


Image = npt.NDArray[np.uint8]
Angles = tuple[float, float]  # pan and tilt [rad]
Speed = float | tuple[float, float]  # of both axes of a head, or of pan and tilt each [rad/s]


@dataclass(frozen=True)
class Frame:
    """One image and when its light fell: ``image`` (H, W, 3) BGR, ``t`` the middle of the exposure [s]."""

    image: Image
    t: float


@dataclass(frozen=True)
class ZoomState:
    """The lens as its device tells it: nominal focal length [px], whether it moves, and when that was [s]."""

    focal_px: float
    moving: bool
    t: float


@dataclass(frozen=True)
class PanTiltState:
    """The head as its device tells it: angles [rad], whether it moves, and when that was [s]."""

    pan: float
    tilt: float
    moving: bool
    t: float


def to_step(angle: float, step: float) -> float:
    """Where an axis stands that is sent to an angle [rad]: the nearest of its steps [rad]; 0 for a continuous one."""
    return round(angle / step) * step if step else angle


@dataclass(frozen=True)
class PanTiltLimits:
    """What a pan-tilt unit can do.

    Attributes:
        pan: lowest and highest pan [rad].
        tilt: lowest and highest tilt [rad].
        speed: highest speed of either axis [rad/s].
        acceleration: of either axis [rad/s^2].
        step: resolution of either axis [rad]; 0 for a continuous head.
    """

    pan: tuple[float, float]
    tilt: tuple[float, float]
    speed: float
    acceleration: float
    step: float

    def capped(self, speed: Speed | None) -> tuple[float, float]:
        """The speeds of pan and tilt to ask for [rad/s]: never above the highest, which is meant by None.

        Raises:
            DeviceError: a speed is not above zero.
        """
        both = speed if isinstance(speed, tuple) else (speed, speed)
        for each in both:
            if each is not None and not each > 0:
                raise DeviceError(f"the head cannot move at a speed of {each} rad/s")
        pan, tilt = (self.speed if each is None else min(each, self.speed) for each in both)
        return pan, tilt

    def allow(self, pan: npt.ArrayLike, tilt: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Whether angles [rad] are within the limits; nan is not."""
        pan, tilt = np.asarray(pan, dtype=float), np.asarray(tilt, dtype=float)
        return np.asarray((pan >= self.pan[0]) & (pan <= self.pan[1]) & (tilt >= self.tilt[0]) & (tilt <= self.tilt[1]))


class Camera(Protocol):
    """A camera that streams."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Wait for the newest frame; with ``newer_than`` [s] for one exposed after that time.

        Raises:
            StaleFrameError: no such frame arrived within ``timeout`` [s].
        """


class ZoomCamera(Camera, Protocol):
    """A camera whose focal length can be commanded. Focal lengths are the device's nominal pixels of its stream."""

    @property
    def still_size(self) -> tuple[int, int]:
        """(width, height) of full stills [px]; that of the stream, where the device has no separate stills."""

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest focal length [px]."""

    def zoom(self, focal_px: float) -> float:
        """Start the lens moving and return at once the focal length [px] that it will really reach."""

    def state(self) -> ZoomState:
        """Tell the lens's state now."""

    def capture(self) -> Frame:
        """Take a full still, where the device has one; otherwise the next frame."""


class PanTilt(Protocol):
    """A two-axis head."""

    @property
    def limits(self) -> PanTiltLimits:
        """What the unit can do."""

    def state(self) -> PanTiltState:
        """Tell the head's state now."""

    def move(self, pan: float, tilt: float, speed: Speed | None = None, wait: bool = False) -> tuple[float, float]:
        """Command both axes [rad]; return what was commanded after clipping and rounding to steps.

        Each axis goes on its own way, no faster than its ``speed``, and comes to rest at its goal.
        """

    def halt(self) -> None:
        """Stop at once; safe even if the program dies next."""


class Clock(Protocol):
    """The rig's time."""

    def now(self) -> float:
        """Seconds on the rig's clock."""

    def sleep_until(self, t: float) -> None:
        """Return when the clock shows ``t`` [s]."""


class Board(Protocol):
    """Somebody, or something, that can hold a calibration board."""

    @property
    def patience(self) -> float:
        """How long it may take until the board is held still where it was wished [s]; 0 where it is there at once."""

    def present(self, T_fixed_board: RigidTransform | None) -> None:
        """Wish for the board at a pose (its first corner's frame), or for no board; nobody is told the result."""

    def swing(self, T_fixed_board: RigidTransform) -> None:
        """Wish for the board to be swung to and fro along its x axis about a pose, until the next wish."""


class Rig(Protocol):
    """The whole: two cameras, a head, a clock and a board. A context manager that halts, then closes."""

    @property
    def fixed(self) -> Camera:
        """The stationary wide camera."""

    @property
    def zoom(self) -> ZoomCamera:
        """The zoom camera on the pan-tilt unit."""

    @property
    def head(self) -> PanTilt:
        """The pan-tilt unit."""

    @property
    def clock(self) -> Clock:
        """The rig's time."""

    @property
    def board(self) -> Board:
        """The calibration board's holder."""

    def close(self) -> None:
        """Halt the head and release the devices."""

    def __enter__(self) -> "Rig":
        """Give the rig itself."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Halt, then close."""


def opened_from(rig: Rig) -> "RigConfig":
    """The configuration that a rig was opened from, its attribute ``config``.

    Raises:
        ConfigError: the rig was made in another way and has none.
    """
    config: RigConfig | None = getattr(rig, "config", None)
    if config is None:
        raise ConfigError(f"a {type(rig).__name__} has no configuration; pass target, detector and settings yourself")
    return config
