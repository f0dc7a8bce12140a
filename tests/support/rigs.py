"""Rigs of devices that tests make."""

from dataclasses import replace

from cotarget.config import SafetyConfig
from cotarget.rig import AxisLimits, CameraSpec, HeadSpec, PanTiltLimits, Rig, RigSpec, ZoomSpec
from cotarget.safety.safe_rig import guard

RATE_HZ, LATENCY_S, DELAY_S = 25.0, 0.06, 0.04
SIZE, FOCALS = (2, 2), (100.0, 1200.0)  # of a camera that does not say them


def alike(pan, tilt, speed, acceleration, step, slack=0.0):
    """Limits of a head whose axes differ in their ranges alone [rad]."""
    return PanTiltLimits(*(AxisLimits(each, speed, acceleration, step, slack) for each in (pan, tilt)))


def with_axes(limits, **changes):
    """The limits with fields of both axes replaced."""
    return PanTiltLimits(*(replace(axis, **changes) for axis in limits.axes))


def rig_of(devices, *, delay_s=DELAY_S, config=None) -> Rig:
    """The rig of an object that has the devices, and closes them where it can; of a rig, itself."""
    if isinstance(devices, Rig):
        return devices
    fixed, zoom, head = getattr(devices, "fixed", None), devices.zoom, devices.head
    size = getattr(zoom, "size", SIZE)
    spec = RigSpec(
        CameraSpec(getattr(fixed, "size", SIZE), RATE_HZ, LATENCY_S),
        ZoomSpec(
            size=size,
            rate_hz=RATE_HZ,
            latency_s=LATENCY_S,
            focal_range=getattr(zoom, "focal_range", FOCALS),
            pitch_mm=0.009,
            still_size=getattr(zoom, "still_size", size),
            delay_s=delay_s,
        ),
        HeadSpec(getattr(head, "limits", None), delay_s),
        getattr(devices, "real_time", False),
    )
    release = getattr(devices, "close", lambda: None)
    return Rig(fixed, zoom, head, devices.clock, getattr(devices, "board", None), spec, release, config)


def guarded(devices, safety: SafetyConfig) -> Rig:
    """The rig of such an object behind the safety layer."""
    return guard(rig_of(devices), safety)


def with_zoom_head(calibration, **changes):
    """The calibration with fields of its zoom head replaced."""
    return replace(calibration, zoom_head=replace(calibration.zoom_head, **changes))
