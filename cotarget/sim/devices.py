"""The simulated devices behind the Rig's Protocols; each knows what its real counterpart would know and no more."""

import math
from collections.abc import Callable
from types import TracebackType

from cotarget.config import SimCamera, SimEffects, SimHead, SimZoomCamera
from cotarget.errors import DeviceError, StaleFrameError
from cotarget.geometry import RigidTransform
from cotarget.rig import Frame, Image, PanTiltLimits, PanTiltState, ZoomState
from cotarget.sim.motion import Axis

# Frame times are multiples of the frame period; this much of a period [1] absorbs their rounding.
ROUNDING = 1e-6
# How many images a camera keeps: a frame asked for twice is rendered once.
KEPT_FRAMES = 2


class SimClock:
    """Simulated time, which only moves when somebody waits."""

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """Seconds since the world began."""
        return self._now

    def sleep_until(self, t: float) -> None:
        """Let the time pass; at once in real time."""
        self._now = max(self._now, t)


class SimStream:
    """A camera that exposes at a fixed rate and delivers late.

    Args:
        camera: its configuration.
        effects: switches.
        clock: the rig's clock.
        expose: gives the image of frame number k, exposed at time t.
    """

    def __init__(
        self, camera: SimCamera, effects: SimEffects, clock: SimClock, expose: Callable[[int, float], Image]
    ) -> None:
        self._camera, self._clock, self._expose = camera, clock, expose
        self._latency = camera.latency_s if effects.latency else 0.0
        self._kept: dict[int, Frame] = {}

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self._camera.size

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Wait for the newest frame; with ``newer_than`` [s] for one exposed after that time.

        Raises:
            StaleFrameError: no such frame arrived within ``timeout`` [s].
        """
        now, rate = self._clock.now(), self._camera.rate_hz
        index = max(math.floor((now - self._latency) * rate + ROUNDING), 0)
        if newer_than is not None:
            index = max(index, math.floor(newer_than * rate + ROUNDING) + 1)
        arrival = index / rate + self._latency
        if arrival - now > timeout:
            self._clock.sleep_until(now + timeout)
            raise StaleFrameError(f"no frame newer than {newer_than:.3f} s within {timeout:g} s")
        self._clock.sleep_until(arrival)
        if index not in self._kept:
            frame = Frame(self._expose(index, index / rate), index / rate)
            frame.image.flags.writeable = False
            self._kept = dict([*list(self._kept.items())[1 - KEPT_FRAMES :], (index, frame)])
        return self._kept[index]


class SimZoomStream(SimStream):
    """A camera with a stepping zoom lens."""

    def __init__(
        self,
        camera: SimZoomCamera,
        effects: SimEffects,
        clock: SimClock,
        expose: Callable[[int, float], Image],
        delay: float,
    ) -> None:
        super().__init__(camera, effects, clock, expose)
        self._shortest, self._longest = (f / camera.pitch_mm for f in camera.focal_mm)
        self._last = camera.lens_steps - 1
        self._stepping = effects.lens
        self._delay = delay
        # The lens has no run-up: an acceleration that reaches full speed within a step is fast enough to be none.
        speed = camera.lens_speed if effects.lens else math.inf
        self._axis = Axis(speed, speed * speed)
        self._rests = 0.0

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest focal length [px], as the maker states them."""
        return self._shortest, self._longest

    def zoom(self, focal_px: float) -> float:
        """Start the lens moving; return the focal length [px] of the position that it will stop at."""
        if not focal_px > 0 or math.isinf(focal_px):
            raise DeviceError(f"the lens cannot go to a focal length of {focal_px} px")
        position = min(max(math.log(focal_px / self._shortest) / self._log_step, 0.0), self._last)
        if self._stepping:
            position = round(position)
        self._rests = self._axis.command(self._clock.now() + self._delay, position)
        return self._focal(position)

    def state(self) -> ZoomState:
        """The lens's state now."""
        now = self._clock.now()
        return ZoomState(self.focal_at(now), now < self._rests, now)

    def capture(self) -> Frame:
        """This camera has no separate stills: the next frame exposed from now on."""
        return self.read(newer_than=self._clock.now())

    def focal_at(self, t: float) -> float:
        """Nominal focal length [px] at a time up to now."""
        return self._focal(self._axis.motor(t)[0])

    @property
    def _log_step(self) -> float:
        return math.log(self._longest / self._shortest) / self._last

    def _focal(self, position: float) -> float:
        return self._shortest * math.exp(position * self._log_step)


class SimPanTilt:
    """A pan-tilt unit: delayed commands, trapezoidal profiles, steps, limits and play."""

    def __init__(self, head: SimHead, effects: SimEffects, clock: SimClock) -> None:
        self._clock = clock
        self._delay = head.command_delay_s if effects.command_delay else 0.0
        speed = math.radians(head.speed_deg_s) if effects.profile else math.inf
        acceleration = math.radians(head.accel_deg_s2) if effects.profile else math.inf
        play = math.radians(head.backlash_deg) if effects.backlash else 0.0
        self._pan, self._tilt = Axis(speed, acceleration, play), Axis(speed, acceleration, play)
        self._limits = PanTiltLimits(
            pan=(math.radians(head.pan_deg[0]), math.radians(head.pan_deg[1])),
            tilt=(math.radians(head.tilt_deg[0]), math.radians(head.tilt_deg[1])),
            speed=speed,
            acceleration=acceleration,
            step=math.radians(head.step_deg) if effects.steps else 0.0,
        )
        self._rests = 0.0

    @property
    def limits(self) -> PanTiltLimits:
        """What the unit can do."""
        return self._limits

    def state(self) -> PanTiltState:
        """What the unit's own step counters say now."""
        now = self._clock.now()
        pan, tilt = (self._to_step(axis.motor(now)[0]) for axis in (self._pan, self._tilt))
        return PanTiltState(pan, tilt, now < self._rests, now)

    def move(self, pan: float, tilt: float, speed: float | None = None, wait: bool = False) -> tuple[float, float]:
        """Command both axes [rad]; return what was commanded after clipping and rounding to steps."""
        if not (math.isfinite(pan) and math.isfinite(tilt)):
            raise DeviceError(f"the head cannot go to pan {pan}, tilt {tilt}")
        if speed is not None and not speed > 0:
            raise DeviceError(f"the head cannot move at a speed of {speed} rad/s")
        pan, tilt = self._clip(pan, self._limits.pan), self._clip(tilt, self._limits.tilt)
        t = self._clock.now() + self._delay
        self._rests = max(self._pan.command(t, pan, speed), self._tilt.command(t, tilt, speed))
        if wait:
            self._clock.sleep_until(self._rests)
        return pan, tilt

    def halt(self) -> None:
        """Brake both axes."""
        t = self._clock.now() + self._delay
        self._rests = max(self._pan.halt(t), self._tilt.halt(t))

    def angles_at(self, t: float) -> tuple[float, float]:
        """Pan and tilt of the platform itself [rad] at a time up to now, behind any play."""
        return self._pan.driven(t), self._tilt.driven(t)

    def _to_step(self, angle: float) -> float:
        step = self._limits.step
        return round(angle / step) * step if step else angle

    def _clip(self, angle: float, limits: tuple[float, float]) -> float:
        step = self._limits.step
        if not step:
            return min(max(angle, limits[0]), limits[1])
        lowest, highest = math.ceil(limits[0] / step - ROUNDING), math.floor(limits[1] / step + ROUNDING)
        return min(max(round(angle / step), lowest), highest) * step


class SimBoard:
    """A board that appears wherever it is wished."""

    def __init__(self, place: Callable[[RigidTransform | None], None]) -> None:
        self._place = place

    def present(self, T_fixed_board: RigidTransform | None) -> None:
        """Put the board there, in the true fixed camera's frame, from now on; None takes it away."""
        self._place(T_fixed_board)


class SimRig:
    """The simulated rig."""

    def __init__(
        self,
        fixed: SimStream,
        zoom: SimZoomStream,
        head: SimPanTilt,
        clock: SimClock,
        board: SimBoard,
        release: Callable[[], None],
    ) -> None:
        self.fixed, self.zoom, self.head, self.clock, self.board = fixed, zoom, head, clock, board
        self._release = release

    def close(self) -> None:
        """Halt the head and release the renderer."""
        self.head.halt()
        self._release()

    def __enter__(self) -> "SimRig":
        """Give the rig itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Halt, then close."""
        self.close()
