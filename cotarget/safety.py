"""Wraps any Rig: soft limits inside the device's own, a speed cap, and no action on stale frames."""

import dataclasses
import logging
import math
from types import TracebackType

from cotarget.config import SafetyConfig
from cotarget.errors import ConfigError, DeviceError, StaleFrameError
from cotarget.rig import Board, Camera, Clock, Frame, PanTilt, PanTiltLimits, PanTiltState, Rig, ZoomCamera

log = logging.getLogger(__name__)


class SafeHead:
    """A pan-tilt unit that cannot be sent outside the soft limits nor faster than the cap."""

    def __init__(self, head: PanTilt, config: SafetyConfig) -> None:
        self._head = head
        device = head.limits
        speed = device.speed if config.speed_deg_s is None else min(device.speed, math.radians(config.speed_deg_s))
        self._limits = dataclasses.replace(
            device,
            pan=_within(config.pan_deg, device.pan, device.step, "safety.pan_deg"),
            tilt=_within(config.tilt_deg, device.tilt, device.step, "safety.tilt_deg"),
            speed=speed,
        )

    @property
    def limits(self) -> PanTiltLimits:
        """The soft limits."""
        return self._limits

    def state(self) -> PanTiltState:
        """The head's state now."""
        return self._head.state()

    def move(self, pan: float, tilt: float, speed: float | None = None, wait: bool = False) -> tuple[float, float]:
        """Command both axes [rad], clipped to the soft limits; return what was really commanded.

        Raises:
            DeviceError: an angle is not a number.
        """
        if math.isnan(pan) or math.isnan(tilt):
            raise DeviceError(f"the head cannot go to pan {pan}, tilt {tilt}")
        step = self._limits.step
        pan, tilt = _clip(pan, self._limits.pan, step), _clip(tilt, self._limits.tilt, step)
        capped = self._limits.speed if speed is None else min(speed, self._limits.speed)
        return self._head.move(pan, tilt, None if math.isinf(capped) else capped, wait)

    def halt(self) -> None:
        """Stop at once."""
        self._head.halt()


class SafeCamera:
    """The fixed camera, whose frames are refused when they are too old to act on."""

    def __init__(self, camera: Camera, clock: Clock, max_age_s: float) -> None:
        self._camera, self._clock, self._max_age_s = camera, clock, max_age_s

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self._camera.size

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Wait for the newest frame.

        Raises:
            StaleFrameError: no new frame came, or the newest is too old to act on.
        """
        frame = self._camera.read(newer_than, timeout)
        age = self._clock.now() - frame.t
        if age > self._max_age_s:
            raise StaleFrameError(f"the newest frame is {age:.2f} s old; at most {self._max_age_s:g} s is acted on")
        return frame


class SafeRig:
    """A rig with the safety layer in front of its head and its fixed camera; halts on every way out."""

    def __init__(self, rig: Rig, config: SafetyConfig) -> None:
        self._rig = rig
        try:
            self.head: PanTilt = SafeHead(rig.head, config)
        except BaseException:
            rig.close()
            raise
        self.fixed: Camera = SafeCamera(rig.fixed, rig.clock, config.max_frame_age_s)
        self.zoom: ZoomCamera = rig.zoom
        self.clock: Clock = rig.clock
        self.board: Board = rig.board

    def close(self) -> None:
        """Halt the head, then close the rig."""
        try:
            self.head.halt()
        finally:
            self._rig.close()

    def __enter__(self) -> "SafeRig":
        """Give the rig itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Halt, then close."""
        if error is not None:
            log.info("halting the head: %s", kind.__name__ if kind else error)
        self.close()


def _within(
    soft_deg: tuple[float, float] | None, device: tuple[float, float], step: float, name: str
) -> tuple[float, float]:
    """The tighter of both limits [rad]; soft ones that leave nothing of the device's are a mistake."""
    if soft_deg is None:
        return device
    low, high = max(math.radians(soft_deg[0]), device[0]), min(math.radians(soft_deg[1]), device[1])
    first, last = _outermost((low, high), step)
    if low >= high or first > last:
        own = [round(math.degrees(v), 1) for v in device]
        raise ConfigError(f"{name}: {list(soft_deg)} leaves nothing of the device's own range {own}")
    return low, high


def _clip(angle: float, limits: tuple[float, float], step: float) -> float:
    """Clip to the limits; with steps to the outermost step inside them, so that rounding cannot lead outside."""
    low, high = _outermost(limits, step)
    return min(max(angle, low), high)


def _outermost(limits: tuple[float, float], step: float) -> tuple[float, float]:
    """The outermost steps inside the limits; the limits themselves for a head without steps."""
    if step > 0:
        return math.ceil(limits[0] / step - 1e-9) * step, math.floor(limits[1] / step + 1e-9) * step
    return limits
