"""Simulated devices behind the Protocols of `cotarget.rig`.

Each device knows what its real counterpart knows, and no ground truth. Time is the rig's clock; a blocking call
advances it.
"""

import math
from collections.abc import Callable
from typing import NoReturn

from cotarget.config import RigConfig, SimCamera, SimEffects, SimHead, SimZoomCamera
from cotarget.errors import DeviceError, StaleFrameError
from cotarget.geometry import RigidTransform
from cotarget.rig import (
    AxisLimits,
    CameraSpec,
    Clock,
    Frame,
    HeadSpec,
    Image,
    PanTiltLimits,
    PanTiltState,
    RigSpec,
    Speed,
    ZoomSpec,
    ZoomState,
    to_step,
)
from cotarget.sim.motion import Axis, HeadDrive, LensDrive

# Frame times are multiples of the frame period. This part of a period [1] absorbs their rounding.
ROUNDING = 1e-6
# Number of images that a camera caches: a frame that is read twice is rendered once.
KEPT_FRAMES = 2


def _closed(*_: object) -> NoReturn:
    """Refuse access to the world of a closed rig; devices hold this in place of the world, so that it can be freed."""
    raise DeviceError("the simulated rig is closed; open it again")


class SimClock:
    """Simulated time that only a blocking call advances."""

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """Give the seconds since the world began."""
        return self._now

    def sleep_until(self, t: float) -> None:
        """Advance the time to t [s] without waiting in real time."""
        self._now = max(self._now, t)


class SimStream:
    """Camera with a constant frame rate and a latency.

    Args:
        camera: the camera's configuration.
        effects: switches of the simulated effects.
        clock: the rig's clock.
        expose: gives the image of frame number k, exposed at time t [s].
    """

    def __init__(
        self, camera: SimCamera, effects: SimEffects, clock: Clock, expose: Callable[[int, float], Image]
    ) -> None:
        self._camera, self._clock, self._expose = camera, clock, expose
        # An exposure ends half its length after the frame's time, so that no frame arrives earlier.
        half = camera.exposure_s / 2 if effects.blur else 0.0
        self._latency = max(camera.latency_s if effects.latency else 0.0, half)
        self._kept: dict[int, Frame] = {}

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self._camera.size

    def leave(self) -> None:
        """Release the world; no frame can be exposed afterwards."""
        self._expose = _closed

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Wait for the newest frame, or with ``newer_than`` [s] for a frame exposed after that time.

        Raises:
            StaleFrameError: no such frame arrived within ``timeout`` [s].
            DeviceError: the rig is closed.
        """
        now, rate = self._clock.now(), self._camera.rate_hz
        index = max(math.floor((now - self._latency) * rate + ROUNDING), 0)
        if newer_than is not None:
            index = max(index, math.floor(newer_than * rate + ROUNDING) + 1)
        arrival = index / rate + self._latency
        if arrival - now > timeout:
            self._clock.sleep_until(now + timeout)
            which = "frame" if newer_than is None else f"frame newer than {newer_than:.3f} s"
            raise StaleFrameError(f"no {which} within {timeout:g} s; the camera is {self._latency:g} s late")
        self._clock.sleep_until(arrival)
        if index not in self._kept:
            frame = Frame(self._expose(index, index / rate), index / rate)
            frame.image.flags.writeable = False
            self._kept = dict([*list(self._kept.items())[1 - KEPT_FRAMES :], (index, frame)])
        return self._kept[index]


class SimZoomStream(SimStream):
    """Camera with a stepping zoom lens.

    Args:
        camera: the camera's configuration.
        effects: switches of the simulated effects.
        clock: the rig's clock.
        expose: gives the image of frame number k, exposed at time t [s].
        drive: the lens's positions and motion.
        delay: time from a command to the start of motion [s].
    """

    def __init__(
        self,
        camera: SimZoomCamera,
        effects: SimEffects,
        clock: Clock,
        expose: Callable[[int, float], Image],
        drive: LensDrive,
        delay: float,
    ) -> None:
        super().__init__(camera, effects, clock, expose)
        self._drive, self._delay = drive, delay
        self._rests = 0.0

    @property
    def still_size(self) -> tuple[int, int]:
        """Size of a still, that of the stream [px]."""
        return self.size

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest nominal focal length [px]."""
        return self._drive.shortest_px, self._drive.longest_px

    def zoom(self, focal_px: float) -> float:
        """Start the lens moving; return the focal length [px] of the position that it will stop at.

        Raises:
            DeviceError: the focal length is not positive and finite.
        """
        if not focal_px > 0 or math.isinf(focal_px):
            raise DeviceError(f"the lens cannot go to a focal length of {focal_px} px")
        position = self._drive.position_for(focal_px)
        self._rests = self._drive.axis.command(self._clock.now() + self._delay, position)
        return self._drive.focal_of(position)

    def state(self) -> ZoomState:
        """Give the lens's current focal length and whether it moves."""
        now = self._clock.now()
        return ZoomState(self._drive.focal_at(now), now < self._rests, now)

    def capture(self) -> Frame:
        """Give the next frame exposed from now on; this camera has no separate stills."""
        return self.read(newer_than=self._clock.now())


def lens_drive(camera: SimZoomCamera, effects: SimEffects) -> LensDrive:
    """Make the drive of the configured zoom lens."""
    shortest, longest = (focal / camera.pitch_mm for focal in camera.focal_mm)
    # The lens's acceleration is not modelled: with this value it reaches full speed within a step.
    speed = camera.lens_speed if effects.lens else math.inf
    return LensDrive(shortest, longest, camera.lens_steps - 1, effects.lens, Axis(speed, speed * speed))


def head_drive(head: SimHead, effects: SimEffects) -> HeadDrive:
    """Make the axes of the configured pan-tilt unit."""
    speed = math.radians(head.speed_deg_s) if effects.profile else math.inf
    acceleration = math.radians(head.accel_deg_s2) if effects.profile else math.inf
    play = math.radians(head.backlash_deg) if effects.backlash else 0.0
    return HeadDrive(Axis(speed, acceleration, play), Axis(speed, acceleration, play))


def rig_spec(config: RigConfig) -> RigSpec:
    """Describe the configured simulated rig."""
    fixed, zoom, head, effects = config.sim.fixed, config.sim.zoom, config.sim.head, config.sim.effects
    axes, lens = head_drive(head, effects), lens_drive(zoom, effects)
    step = math.radians(head.step_deg) if effects.steps else 0.0
    pan, tilt = (
        AxisLimits((math.radians(low), math.radians(high)), axis.speed, axis.acceleration, step)
        for (low, high), axis in ((head.pan_deg, axes.pan), (head.tilt_deg, axes.tilt))
    )
    delay_s = head.command_delay_s if effects.command_delay else 0.0
    latency_s = (fixed.latency_s, zoom.latency_s) if effects.latency else (0.0, 0.0)
    return RigSpec(
        fixed=CameraSpec(fixed.size, fixed.rate_hz, latency_s[0]),
        zoom=ZoomSpec(
            size=zoom.size,
            rate_hz=zoom.rate_hz,
            latency_s=latency_s[1],
            focal_range=(lens.shortest_px, lens.longest_px),
            pitch_mm=zoom.pitch_mm,
            still_size=zoom.size,
            delay_s=delay_s,  # the lens starts after the head's command delay
        ),
        head=HeadSpec(PanTiltLimits(pan, tilt), delay_s),
        targets=config.sim.targets,
    )


class SimPanTilt:
    """Pan-tilt unit with command delay, trapezoidal profiles, steps, limits and backlash."""

    def __init__(self, spec: HeadSpec, clock: Clock, drive: HeadDrive) -> None:
        self._clock, self._drive = clock, drive
        self.limits, self._delay = spec.limits, spec.delay_s
        self._rests = 0.0

    def state(self) -> PanTiltState:
        """Give the angles that the unit's step counters show now; backlash is not visible in them."""
        now = self._clock.now()
        pan = to_step(self._drive.pan.motor(now)[0], self.limits.pan.step)
        tilt = to_step(self._drive.tilt.motor(now)[0], self.limits.tilt.step)
        return PanTiltState(pan, tilt, now < self._rests, now)

    def move(self, pan: float, tilt: float, speed: Speed | None = None, wait: bool = False) -> tuple[float, float]:
        """Command both axes [rad]; return the angles commanded after clipping and rounding to steps.

        Raises:
            DeviceError: an angle is not finite.
        """
        pan, tilt = self.limits.clip(pan, tilt)
        speeds = self.limits.capped(speed)
        pan, tilt = to_step(pan, self.limits.pan.step), to_step(tilt, self.limits.tilt.step)
        t = self._clock.now() + self._delay
        self._rests = max(self._drive.pan.command(t, pan, speeds[0]), self._drive.tilt.command(t, tilt, speeds[1]))
        if wait:
            self._clock.sleep_until(self._rests)
        return pan, tilt

    def halt(self) -> None:
        """Brake both axes after the command delay."""
        t = self._clock.now() + self._delay
        self._rests = max(self._drive.pan.halt(t), self._drive.tilt.halt(t))


class SimBoard:
    """Calibration board that is at once where it is requested.

    Args:
        place: sets the board's pose from now on, and whether it swings there.
    """

    patience = 0.0

    def __init__(self, place: Callable[[RigidTransform | None, bool], None]) -> None:
        self._place = place

    def present(self, T_fixed_board: RigidTransform | None) -> None:
        """Put the board at a pose in the true fixed camera's frame from now on; None removes it."""
        self._place(T_fixed_board, False)

    def leave(self) -> None:
        """Release the world; the board cannot be placed afterwards."""
        self._place = _closed

    def swing(self, T_fixed_board: RigidTransform) -> None:
        """Swing the board about a pose from now on."""
        self._place(T_fixed_board, True)
