"""Soft limits inside the device's own, and a speed cap; pure arithmetic on angles and speeds."""

import dataclasses
import math

from cotarget.config import SafetyConfig
from cotarget.errors import ConfigError, DeviceError
from cotarget.rig import PanTiltLimits

ROUNDING = 1e-9  # of a step; limits that are a multiple of a step are one after the conversion from degrees too


def soft_limits(device: PanTiltLimits, config: SafetyConfig) -> PanTiltLimits:
    """The tighter of the device's limits and the configured ones.

    Raises:
        ConfigError: they leave nothing.
    """
    return dataclasses.replace(
        device,
        pan=_within(config.pan_deg, device.pan, device.step, "safety.pan_deg"),
        tilt=_within(config.tilt_deg, device.tilt, device.step, "safety.tilt_deg"),
        speed=device.speed if config.speed_deg_s is None else min(device.speed, math.radians(config.speed_deg_s)),
    )


def clipped(pan: float, tilt: float, limits: PanTiltLimits) -> tuple[float, float]:
    """Clip to the limits; with steps to the outermost step inside them, so that rounding cannot lead outside.

    Raises:
        DeviceError: an angle is not a number.
    """
    if math.isnan(pan) or math.isnan(tilt):
        raise DeviceError(f"the head cannot go to pan {pan}, tilt {tilt}")
    return _clip(pan, limits.pan, limits.step), _clip(tilt, limits.tilt, limits.step)


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
    low, high = _outermost(limits, step)
    return min(max(angle, low), high)


def _outermost(limits: tuple[float, float], step: float) -> tuple[float, float]:
    """The outermost steps inside the limits; the limits themselves for a head without steps."""
    if step > 0:
        return math.ceil(limits[0] / step - ROUNDING) * step, math.floor(limits[1] / step + ROUNDING) * step
    return limits
