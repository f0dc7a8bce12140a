"""The devices of a rig as the safety layer shows them: the same Protocols, with refusals in front.

In the simulation time passes only inside calls, so each call also watches, and a long one is made in two where the
watchdog is due in between. A rig in real time has a thread for that.
"""

import math

from cotarget.errors import DeviceError, StaleFrameError
from cotarget.rig import Camera, Clock, Frame, PanTilt, PanTiltLimits, PanTiltState, Speed, ZoomCamera, ZoomState
from cotarget.safety.guard import Guard
from cotarget.safety.limits import clipped

# A frame cannot be from later than now; this much is left for a latency that is compensated too far [s].
FUTURE_S = 0.05
# A loaded unit may take this much longer than its speed and acceleration say.
SLOWNESS = 1.5
FINE = 1e-9  # rounding of an angle [rad]


class SafeHead:
    """A pan-tilt unit that cannot be sent outside the soft limits nor faster than the cap, nor move while stopped."""

    def __init__(self, head: PanTilt, limits: PanTiltLimits, guard: Guard) -> None:
        self._head, self._limits, self._guard = head, limits, guard

    @property
    def limits(self) -> PanTiltLimits:
        """The soft limits."""
        return self._limits

    def state(self) -> PanTiltState:
        """The head's state now."""
        self._guard.on_call()
        state = self._head.state()
        self._guard.saw(state, self._limits.step)
        return state

    def move(self, pan: float, tilt: float, speed: Speed | None = None, wait: bool = False) -> tuple[float, float]:
        """Command both axes [rad], clipped to the soft limits; return what was really commanded.

        Raises:
            EmergencyStopError: the head is stopped.
            DeviceError: an angle is not a number, a speed is not above zero, or the device did not obey.
        """
        pan, tilt = clipped(pan, tilt, self._limits)
        speeds = self._limits.capped(speed)
        asked: Speed | None = speeds
        if speeds[0] == speeds[1]:
            asked = None if math.isinf(speeds[0]) else speeds[0]
        motion = self._guard.begin((pan, tilt), self._patience((pan, tilt), min(speeds)) if wait else 0.0)
        try:
            said = self._head.move(pan, tilt, asked, wait)
        except BaseException as error:
            if self._guard.end(motion, arrived=False) and isinstance(error, Exception):
                self._guard.refuse_if_stopped()  # which is why the device failed
            raise
        if self._guard.end(motion, arrived=wait):
            self._guard.refuse_if_stopped()
        if not (_inside(said[0], self._limits.pan, self._limits) and _inside(said[1], self._limits.tilt, self._limits)):
            self._guard.halt()
            raise DeviceError(
                f"the head was sent to pan {math.degrees(pan):.3f}, tilt {math.degrees(tilt):.3f} degrees and says "
                f"that it goes to {math.degrees(said[0]):.3f}, {math.degrees(said[1]):.3f}, beyond the limits"
            )
        return said

    def halt(self) -> None:
        """Stop at once."""
        self._guard.halt()

    def _patience(self, goal: tuple[float, float], speed: float) -> float:
        """How long the device may wait for the head to arrive [s]."""
        acceleration = self._limits.acceleration
        if math.isinf(speed):
            return 0.0  # only a simulated head is so fast, and nobody watches its waiting
        state = self._head.state()
        way = max(abs(goal[0] - state.pan), abs(goal[1] - state.tilt))
        peak = min(speed, math.sqrt(way * acceleration))
        from_rest = way / peak + peak / acceleration if way > 0 else 0.0
        # A head that turns the other way brakes first, and makes up for it then.
        return SLOWNESS * (from_rest + (2 * self._limits.speed / acceleration if state.moving else 0.0))


def _inside(angle: float, bounds: tuple[float, float], limits: PanTiltLimits) -> bool:
    """Whether an angle is within bounds, but for a step; nan is not."""
    slack = limits.step + FINE
    return bounds[0] - slack <= angle <= bounds[1] + slack


class SafeCamera:
    """A camera whose frames are refused when they are too old to act on, or cannot be true."""

    def __init__(self, camera: Camera, clock: Clock, guard: Guard, max_age_s: float, name: str) -> None:
        self._camera, self._clock, self._guard = camera, clock, guard
        self._max_age_s, self._name = max_age_s, name
        self._newest = -math.inf

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self._camera.size

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Wait for the newest frame.

        Raises:
            StaleFrameError: no new frame came, or the newest is too old to act on.
        """
        frame = self._read(newer_than, timeout)
        now = self._clock.now()
        age = now - frame.t
        if not age <= self._max_age_s:
            raise StaleFrameError(
                f"the newest frame is {age:.2f} s old; at most {self._max_age_s:g} s is acted on ({self._name} camera)"
            )
        if newer_than is not None and not frame.t > newer_than:
            raise StaleFrameError(f"the {self._name} camera gave a frame of {frame.t:.3f} s for one after that time")
        self.accept(frame, now)
        return frame

    def accept(self, frame: Frame, now: float) -> None:
        """Take a frame that was read at this time for a sign of life if it is newer than all before.

        Raises:
            StaleFrameError: it is from later than now.
        """
        ahead = frame.t - now
        if not ahead <= FUTURE_S:
            raise StaleFrameError(
                f"the {self._name} camera's frame is from {ahead:.2f} s in the future; mind the clock"
            )
        self._guard.on_call()
        if frame.t > self._newest:
            self._newest = frame.t
            self._guard.alive(now)

    def _read(self, newer_than: float | None, timeout: float) -> Frame:
        if self._guard.threaded:
            return self._camera.read(newer_than, timeout)
        self._guard.watch()
        deadline = self._guard.deadline()
        if deadline is not None and 0 < (first := deadline - self._clock.now()) < timeout:
            try:
                return self._camera.read(newer_than, first)
            except StaleFrameError:
                self._guard.watch()
                timeout -= first
        return self._camera.read(newer_than, timeout)


class SafeZoomCamera:
    """The zoom camera. Its lens moves inside the camera and harms nobody: an emergency stop leaves it alone."""

    def __init__(self, camera: ZoomCamera, stream: SafeCamera, clock: Clock) -> None:
        self._camera, self._stream, self._clock = camera, stream, clock

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self._camera.size

    @property
    def still_size(self) -> tuple[int, int]:
        """(width, height) of full stills [px]."""
        return self._camera.still_size

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest focal length [px]."""
        return self._camera.focal_range

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Wait for the newest frame.

        Raises:
            StaleFrameError: no new frame came, or the newest is too old to act on.
        """
        return self._stream.read(newer_than, timeout)

    def zoom(self, focal_px: float) -> float:
        """Start the lens moving; return the focal length [px] that it will really reach."""
        return self._camera.zoom(focal_px)

    def state(self) -> ZoomState:
        """The lens's state now."""
        return self._camera.state()

    def capture(self) -> Frame:
        """Take a full still. It may be old when it arrives, because it is large; but not older than its request.

        Raises:
            StaleFrameError: it is.
        """
        asked = self._clock.now()
        frame = self._camera.capture()
        if not frame.t >= asked - FUTURE_S:
            raise StaleFrameError(f"the still is from {asked - frame.t:.2f} s before it was asked for (zoom camera)")
        self._stream.accept(frame, self._clock.now())
        return frame


class SafeClock:
    """The clock of a simulation, which stops on the way where the watchdog is due."""

    def __init__(self, clock: Clock, guard: Guard) -> None:
        self._clock, self._guard = clock, guard

    def now(self) -> float:
        """Seconds on the rig's clock."""
        return self._clock.now()

    def sleep_until(self, t: float) -> None:
        """Return when the clock shows ``t`` [s]."""
        deadline = self._guard.deadline()
        if deadline is not None and deadline < t:
            self._clock.sleep_until(deadline)
            self._guard.watch()
        self._clock.sleep_until(t)
