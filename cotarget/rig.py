"""Define the rig that the pipeline sees: frames, detections, device states, limits, and the Protocols of the devices.

A rig is the MuJoCo simulation, real devices, or a recording; the pipeline cannot distinguish them. Every blocking call
advances the rig's own clock, which is simulated time in the simulation.
"""

import json
import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from cotarget.errors import ConfigError, DeviceError
from cotarget.geometry import Array, RigidTransform

if TYPE_CHECKING:
    from cotarget.config import RigConfig


Image = npt.NDArray[np.uint8]
Angles = tuple[float, float]  # pan and tilt [rad]
Speed = float | tuple[float, float]  # one speed for both axes of a head, or one each for pan and tilt [rad/s]

READ_TIMEOUT_S = 1.0  # longest wait for a camera's next frame [s]
# A frame cannot be from the future; this tolerance allows for a configured latency that is too long [s].
FUTURE_S = 0.05


@dataclass(frozen=True)
class Frame:
    """One image with its time.

    Attributes:
        image: (H, W, 3) BGR.
        t: middle of the exposure [s].
        repeated: whether its camera is known to repeat the image before, with a new time.
        number: how many frames had come from its camera, this one and refused ones included; None if nobody counts.
    """

    image: Image
    t: float
    repeated: bool = False
    number: int | None = None


@dataclass(frozen=True)
class Detection:
    """One target detected in one frame.

    Attributes:
        center_px: centre of the box (u, v), (2,).
        size_px: width and height of the box, (2,).
        score: confidence of the detector, 0 to 1.
        clipped: whether the image's border cuts the box, so that its size is only a lower bound.
    """

    center_px: Array
    size_px: Array
    score: float
    clipped: bool = False


@dataclass(frozen=True)
class ZoomState:
    """State that the lens reports: nominal focal length [px], whether it moves, and the time of this state [s]."""

    focal_px: float
    moving: bool
    t: float


@dataclass(frozen=True)
class PanTiltState:
    """State that the head reports.

    Attributes:
        pan: angle [rad].
        tilt: angle [rad].
        moving: whether it moves; true until the head is known to stand.
        t: time of this state [s].
        sigma: standard deviation of either angle, beyond that of a step [rad].
    """

    pan: float
    tilt: float
    moving: bool
    t: float
    sigma: float = 0.0


def to_step(angle: float, step: float) -> float:
    """Round an angle [rad] to the nearest step of an axis [rad]; a step of 0 is continuous."""
    return round(angle / step) * step if step else angle


# Time to come to rest if the acceleration is unknown [s]: after a stop, domes were seen to turn on for up to 1.1 s.
USUAL_BRAKING_S = 2.0
STEP_ROUNDING = 1e-9  # in steps; keeps a limit of whole steps whole after its conversion from degrees


@dataclass(frozen=True)
class AxisLimits:
    """Limits of one axis of a head.

    Attributes:
        range: lowest and highest angle [rad].
        speed: highest speed [rad/s]; inf for an axis that jumps.
        acceleration: [rad/s^2]; None if unknown.
        step: resolution [rad]; 0 for a continuous axis.
        slack: angle by which the axis may rest off its goal, as a servo does [rad].
    """

    range: tuple[float, float]
    speed: float
    acceleration: float | None = None
    step: float = 0.0
    slack: float = 0.0

    @property
    def tolerance(self) -> float:
        """Angle by which an axis that has arrived may be off its goal [rad]."""
        return self.step + self.slack

    @property
    def assumed_acceleration(self) -> float:
        """Acceleration for predictions [rad/s^2]: inf, so full speed at once, if it is unknown."""
        return math.inf if self.acceleration is None else self.acceleration

    @property
    def braking_s(self) -> float:
        """Time to come to rest from the highest speed [s]; a usual one if the acceleration is unknown."""
        if math.isinf(self.speed):
            return 0.0
        return USUAL_BRAKING_S if self.acceleration is None else self.speed / self.acceleration

    def travel_s(self, way: float) -> float:
        """Travel time from rest to rest over an angle [rad] at full speed [s]."""
        way, acceleration = abs(way), self.assumed_acceleration
        if math.isinf(acceleration):  # full speed at once, or a jump
            return way / self.speed
        if way * acceleration <= self.speed**2:  # it does not reach full speed
            return 2 * math.sqrt(way / acceleration)
        return way / self.speed + self.speed / acceleration

    def beyond(self, angle: float) -> float:
        """Angle by which an angle is outside of the range, negative inside of it [rad]; nan for nan."""
        return max(self.range[0] - angle, angle - self.range[1])

    def outermost(self) -> tuple[float, float]:
        """Outermost steps inside the range [rad]; its ends for an axis without steps."""
        low, high = self.range
        if not self.step > 0:
            return low, high
        first, last = math.ceil(low / self.step - STEP_ROUNDING), math.floor(high / self.step + STEP_ROUNDING)
        return first * self.step, last * self.step

    def clip(self, angle: float) -> float:
        """Clip an angle [rad] to the outermost steps inside the range, so that rounding cannot lead outside."""
        low, high = self.outermost()
        return min(max(angle, low), high)


@dataclass(frozen=True)
class PanTiltLimits:
    """Limits of the axes of a pan-tilt unit."""

    pan: AxisLimits
    tilt: AxisLimits

    @property
    def axes(self) -> tuple[AxisLimits, AxisLimits]:
        """Limits of pan and of tilt."""
        return self.pan, self.tilt

    def capped(self, speed: Speed | None) -> tuple[float, float]:
        """Limit the speeds of pan and tilt to the highest [rad/s]; None stands for the highest.

        Raises:
            DeviceError: a speed is not above zero.
        """
        capped = []
        pair = speed if isinstance(speed, tuple) else (speed, speed)
        for each, axis in zip(pair, (self.pan, self.tilt), strict=True):
            if each is not None and not each > 0:
                raise DeviceError(f"the head cannot move at a speed of {each} rad/s")
            capped.append(axis.speed if each is None else min(each, axis.speed))
        return capped[0], capped[1]

    def clip(self, pan: float, tilt: float) -> tuple[float, float]:
        """Clip angles [rad] as `AxisLimits.clip` does.

        Raises:
            DeviceError: an angle is not finite.
        """
        if not (math.isfinite(pan) and math.isfinite(tilt)):
            raise DeviceError(f"the head cannot go to pan {pan}, tilt {tilt}")
        return self.pan.clip(pan), self.tilt.clip(tilt)

    def allow(self, pan: npt.ArrayLike, tilt: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Whether angles [rad] are within the limits; nan is not."""
        within = [
            (np.asarray(angles, dtype=float) >= axis.range[0]) & (np.asarray(angles, dtype=float) <= axis.range[1])
            for angles, axis in zip((pan, tilt), self.axes, strict=True)
        ]
        return np.asarray(within[0] & within[1])


def refuse_outside(state: PanTiltState, limits: PanTiltLimits, axes: Sequence[str] = ("pan", "tilt")) -> None:
    """Refuse a head that stands beyond its limits, where each command would move these axes.

    Raises:
        DeviceError: an axis is beyond its limits by more than its tolerance.
    """
    for name in axes:
        angle, axis = getattr(state, name), getattr(limits, name)
        if not axis.beyond(angle) <= axis.tolerance:
            low, high = map(math.degrees, axis.range)
            raise DeviceError(
                f"the head stands at {name} {math.degrees(angle):.1f} degrees, beyond the limits of "
                f"{low:.1f} to {high:.1f}, and would move inside; if it may, do so first "
                f"by cotarget point --rig RIG --{name}-deg {min(max(math.degrees(angle), low), high):.1f}"
            )


@dataclass(frozen=True)
class CameraSpec:
    """Properties of a camera, known without opening it.

    Attributes:
        size: (width, height) of its stream [px].
        rate_hz: frames per second.
        latency_s: time from light to frame [s].
    """

    size: tuple[int, int]
    rate_hz: float
    latency_s: float


@dataclass(frozen=True)
class ZoomSpec(CameraSpec):
    """Properties of a zoom camera, known without opening it.

    Attributes:
        focal_range: shortest and longest nominal focal length [px].
        still_size: (width, height) of full stills [px]; that of the stream if the device has no separate stills.
        delay_s: time from a command to the start of the lens's motion [s].
        pitch_mm: nominal size of a pixel of the stream [mm]; None if unknown, and with it the lens's millimetres.
    """

    focal_range: tuple[float, float]
    still_size: tuple[int, int]
    delay_s: float
    pitch_mm: float | None = None


@dataclass(frozen=True)
class HeadSpec:
    """Properties of a head.

    Attributes:
        limits: of its axes.
        delay_s: time from a command to the start of motion [s].
        zoomed_speeds: (nominal focal length [px], highest speed from there on [rad/s]), by increasing focal length, of
            a head that turns the slower the longer its lens; empty for others.
    """

    limits: PanTiltLimits
    delay_s: float
    zoomed_speeds: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class UnitSpec:
    """Properties of a zoom camera and a head in one housing, known without opening them."""

    zoom: ZoomSpec
    head: HeadSpec


@dataclass(frozen=True)
class RigSpec:
    """Properties of a rig, known without opening it.

    Attributes:
        fixed: the fixed camera.
        zoom: the zoom camera.
        head: the head.
        real_time: whether time passes without calls; a simulation's passes only inside them.
        targets: names of the targets in a simulated scene; None where others may come into view.
    """

    fixed: CameraSpec
    zoom: ZoomSpec
    head: HeadSpec
    real_time: bool = False
    targets: tuple[str, ...] | None = None


def check_shown(spec: RigSpec, target: str) -> None:
    """Refuse to follow a target that the simulated scene does not contain.

    Raises:
        ConfigError: the scene lacks the target; the message says how to add it.
    """
    if spec.targets is not None and target not in spec.targets:
        names = json.dumps([*spec.targets, target])
        raise ConfigError(f"the simulated scene has no {target}; add it: [sim] targets = {names}")


class Camera(Protocol):
    """A camera that streams frames."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""

    def read(self, newer_than: float | None = None, timeout: float = READ_TIMEOUT_S) -> Frame:
        """Wait for the newest frame; with ``newer_than`` [s], for one exposed after that time.

        Raises:
            StaleFrameError: no such frame arrived within ``timeout`` [s].
        """


class ZoomCamera(Camera, Protocol):
    """A camera with a zoom lens. Focal lengths are nominal, in pixels of its stream."""

    @property
    def still_size(self) -> tuple[int, int]:
        """(width, height) of full stills [px]; that of the stream if the device has no separate stills."""

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest nominal focal length [px]."""

    def zoom(self, focal_px: float) -> float:
        """Start the lens moving and return at once the focal length that it will really reach [px]."""

    def state(self) -> ZoomState:
        """Return the lens's state now."""

    def capture(self) -> Frame:
        """Take a full still if the device has one; otherwise read the next frame."""


class PanTilt(Protocol):
    """A two-axis pan-tilt head."""

    @property
    def limits(self) -> PanTiltLimits:
        """Limits of the unit."""

    def state(self) -> PanTiltState:
        """Return the head's state now."""

    def move(self, pan: float, tilt: float, speed: Speed | None = None, wait: bool = False) -> tuple[float, float]:
        """Command both axes [rad]; return what was commanded after clipping and rounding to steps.

        Each axis moves by itself, no faster than its ``speed``, and comes to rest at its goal.
        """

    def halt(self) -> None:
        """Stop at once; the head must stay stopped even if the program ends next."""


@dataclass(frozen=True)
class Unit:
    """An open zoom camera and head in one housing, with one connection; `close` halts the head and releases both."""

    zoom: ZoomCamera
    head: PanTilt
    close: Callable[[], None]


class Clock(Protocol):
    """The rig's clock."""

    def now(self) -> float:
        """Time on the rig's clock [s]."""

    def sleep_until(self, t: float) -> None:
        """Wait until the clock shows ``t`` [s]."""


class Board(Protocol):
    """A person or device that holds a calibration board at requested poses."""

    @property
    def patience(self) -> float:
        """Longest time until the board is still at the requested pose [s]; 0 if it is there at once."""

    def present(self, T_fixed_board: RigidTransform | None) -> None:
        """Request the board at a pose (of its first corner's frame), or no board; the result is not reported."""

    def swing(self, T_fixed_board: RigidTransform) -> None:
        """Request the board to swing to and fro along its x axis about a pose, until the next request."""


class Guard(Protocol):
    """The safety layer of a guarded rig."""

    def stop(self, reason: str) -> None:
        """Halt the head, and refuse every move until `clear`; may be called from any thread."""

    def clear(self) -> str | None:
        """End the emergency stop; return its reason."""

    @property
    def stopped(self) -> str | None:
        """Reason of the emergency stop; None if there is none."""

    def close_after(self, error: BaseException) -> None:
        """Halt the head, then release the devices; a failure does not hide the error that led here."""


@dataclass(frozen=True, eq=False)
class Rig(AbstractContextManager["Rig", None]):
    """Two cameras, a head, a clock and a board. A context manager that halts, then closes.

    A rig with other devices is made by `dataclasses.replace`; closing either closes both.

    Attributes:
        fixed: the fixed camera.
        zoom: the zoom camera on the head.
        head: the pan-tilt head.
        clock: the rig's clock.
        board: the calibration board's holder.
        spec: properties of the devices.
        release: halts the head and releases the devices; may be called again.
        config: the configuration that the rig was opened from; None if it was made in another way.
        guard: the safety layer, see `cotarget.safety.safe_rig.guard`; None for a rig without one.
        missing: devices that rig.toml does not configure, of "fixed", "zoom" and "head"; using one is a ConfigError.
    """

    fixed: Camera
    zoom: ZoomCamera
    head: PanTilt
    clock: Clock
    board: Board
    spec: RigSpec
    release: Callable[[], None]
    config: "RigConfig | None" = None
    guard: Guard | None = None
    missing: frozenset[str] = frozenset()

    def stop(self, reason: str) -> None:
        """Emergency stop: halt the head, and refuse every move until `clear`; may be called from any thread.

        Raises:
            DeviceError: the rig has no safety layer, so the head was halted and may be moved again.
        """
        if self.guard is None:
            self.head.halt()
            raise DeviceError(f"the head was halted, but nothing keeps it from moving again: {UNGUARDED} ({reason})")
        self.guard.stop(reason)

    def clear(self) -> str | None:
        """End the emergency stop, which only an operator may decide; return its reason, None if there was none.

        Raises:
            EmergencyStopError: a stop file exists.
        """
        return None if self.guard is None else self.guard.clear()

    @property
    def stopped(self) -> str | None:
        """Reason of the emergency stop; None if there is none."""
        return None if self.guard is None else self.guard.stopped

    def close(self) -> None:
        """Halt the head, then release the devices; may be called again.

        Raises:
            Exception: as the device raised it when it could not be halted or closed.
        """
        self.release()

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Halt, then close."""
        if self.guard is None or error is None:
            self.release()
        else:
            self.guard.close_after(error)


UNGUARDED = "the rig is not guarded; open it by cotarget.open_rig, or guard it by cotarget.safety.safe_rig.guard"


def opened_from(rig: Rig) -> "RigConfig":
    """Return the configuration that a rig was opened from.

    Raises:
        ConfigError: the rig was made in another way and has none.
    """
    if rig.config is None:
        raise ConfigError(
            "the rig has no configuration: open it by cotarget.open_rig, or pass the board, or the target's table, a "
            "detector and settings"
        )
    return rig.config
