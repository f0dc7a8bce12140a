"""Open the real devices as one Rig; every exit halts the head and releases all devices."""

import contextlib
import math
import sys
from dataclasses import replace

from cotarget.config import RigConfig
from cotarget.drivers.axis import AxisCamera
from cotarget.drivers.board import make_board
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.gphoto_camera import GphotoCamera
from cotarget.drivers.interlock import rig_lock
from cotarget.drivers.ptu_d46 import D46Head
from cotarget.errors import ConfigError
from cotarget.rig import CameraSpec, HeadSpec, PanTiltLimits, Rig, RigSpec, ZoomSpec

# Python's thread switch interval [s], instead of 5 ms: a driver's thread that waits for its turn delays every command.
# Measurements: docs/design-notes.md.
SWITCH_INTERVAL = 5e-4
NEEDED = (("head", "port", "/dev/ttyUSB0"), ("fixed", "url", "http://192.168.0.90"), ("zoom", "port", "usb:"))


def rig_spec(config: RigConfig) -> RigSpec:
    """Describe the configured devices without opening them; the head's acceleration is not known before."""
    head, fixed, zoom = config.hardware.head, config.hardware.fixed, config.hardware.zoom
    limits = PanTiltLimits(
        pan=(math.radians(head.pan_deg[0]), math.radians(head.pan_deg[1])),
        tilt=(math.radians(head.tilt_deg[0]), math.radians(head.tilt_deg[1])),
        speed=math.radians(head.speed_deg_s),
        acceleration=math.inf,
        step=math.radians(head.step_deg),
    )
    return RigSpec(
        fixed=CameraSpec(fixed.size, fixed.rate_hz, fixed.latency_s),
        zoom=ZoomSpec(
            size=zoom.size,
            rate_hz=zoom.rate_hz,
            latency_s=zoom.latency_s,
            focal_range=(zoom.lens[0][1] / zoom.pitch_mm, zoom.lens[-1][1] / zoom.pitch_mm),
            pitch_mm=zoom.pitch_mm,
            still_size=zoom.still_size,
            delay_s=zoom.command_delay_s,
        ),
        head=HeadSpec(limits, head.command_delay_s),
        real_time=True,
    )


def open_hardware(config: RigConfig) -> Rig:
    """Open the devices of a configuration; the head comes last and does not move where another device is missing.

    Shortens the thread switch interval of this process (`SWITCH_INTERVAL`).

    Raises:
        ConfigError: a device is not named, or differs from the configuration.
        DeviceError: a device could not be opened, or another program uses it.
    """
    hardware = config.hardware
    for table, key, example in NEEDED:
        if not getattr(getattr(hardware, table), key):
            raise ConfigError(
                f'hardware.{table}.{key}: is missing; the hardware backend needs it, for example {key} = "{example}"'
            )
    sys.setswitchinterval(min(sys.getswitchinterval(), SWITCH_INTERVAL))
    clock = MonotonicClock()
    with contextlib.ExitStack() as opened:
        opened.enter_context(rig_lock(hardware.head.port))
        board = opened.enter_context(contextlib.closing(make_board(hardware.board)))
        fixed = opened.enter_context(contextlib.closing(AxisCamera(hardware.fixed, clock)))
        zoom = opened.enter_context(contextlib.closing(GphotoCamera(hardware.zoom, clock)))
        head = opened.enter_context(contextlib.closing(D46Head(hardware.head, clock, config.safety)))
        spec = rig_spec(config)
        reported = RigSpec(
            fixed=replace(spec.fixed, size=fixed.size),
            zoom=replace(spec.zoom, size=zoom.size, focal_range=zoom.focal_range, still_size=zoom.still_size),
            head=replace(spec.head, limits=head.limits),
            real_time=True,
        )
        return Rig(fixed, zoom, head, clock, board, reported, opened.pop_all().close, config)
