"""Put the safety layer in front of a rig: limits, watchdog, emergency stop, and a halt at every exit.

The devices keep their Protocols and refuse unsafe commands and frames. A rig in real time has a watchdog thread. In the
simulation time passes only inside calls, so each call runs the watchdog, and a long one is split where that is due.
"""

import atexit
import contextlib
import logging
import math
from collections.abc import Callable
from dataclasses import replace

from cotarget.config import SafetyConfig
from cotarget.errors import ConfigError, DeviceError, StaleFrameError
from cotarget.rig import (
    FUTURE_S,
    AxisLimits,
    Camera,
    Clock,
    Frame,
    PanTilt,
    PanTiltLimits,
    PanTiltState,
    Rig,
    Speed,
    ZoomCamera,
    ZoomState,
)
from cotarget.safety.signals import DeferredSignals, guard_head
from cotarget.safety.stop_file import refuse_if_stopped
from cotarget.safety.watchdog import Watchdog, Watcher

log = logging.getLogger(__name__)

# For a waited move, without its way and braking [s]: longer than a driver's own deadline, 2 s and the command's delay
# after that, because the driver knows what a head that does not arrive means.
ARRIVAL_S = 3.5
SLOWNESS = 1.5  # factor by which a loaded unit may take longer than its speed and acceleration give
ANGLE_ROUNDING = 1e-9  # [rad]


class SafeHead:
    """A head that keeps the soft limits and the speed cap, and does not move while stopped."""

    def __init__(self, head: PanTilt, limits: PanTiltLimits, watchdog: Watchdog) -> None:
        self._head, self._limits, self._watchdog = head, limits, watchdog

    @property
    def limits(self) -> PanTiltLimits:
        """Soft limits, within the device's own."""
        return self._limits

    def state(self) -> PanTiltState:
        """Return the head's state now.

        Raises:
            DeviceError: the device failed, or reports no angles.
        """
        self._watchdog.on_call()
        state = self._head.state()
        if not (math.isfinite(state.pan) and math.isfinite(state.tilt) and 0 <= state.sigma < math.inf):
            sigma = f", with a standard deviation of {state.sigma}" if state.sigma else ""
            raise DeviceError(f"the head reports that it is at pan {state.pan}, tilt {state.tilt}{sigma}")
        self._watchdog.saw(state, self._limits)
        return state

    def move(self, pan: float, tilt: float, speed: Speed | None = None, wait: bool = False) -> tuple[float, float]:
        """Command both axes [rad], clipped to the soft limits; return what was really commanded.

        Raises:
            EmergencyStopError: the head is stopped.
            DeviceError: an angle is not finite, a speed is not above zero, or the device failed or left the limits.
        """
        pan, tilt = self._limits.clip(pan, tilt)
        speeds = self._limits.capped(speed)
        asked: Speed | None = speeds
        if speeds[0] == speeds[1]:  # a driver need not know of a speed for each axis
            asked = None if math.isinf(speeds[0]) else speeds[0]
        motion = self._watchdog.begin((pan, tilt), self._patience((pan, tilt), speeds) if wait else 0.0)
        try:
            said = self._head.move(pan, tilt, asked, wait)
        except BaseException as error:
            if self._watchdog.end(motion, arrived=False) and isinstance(error, Exception):
                self._watchdog.refuse_if_stopped()  # the halt made the device fail
            raise
        if self._watchdog.end(motion, arrived=wait):
            self._watchdog.refuse_if_stopped()
        pairs = zip(said, self._limits.axes, strict=True)
        if not all(axis.beyond(angle) <= axis.step + ANGLE_ROUNDING for angle, axis in pairs):  # nor is nan
            self._watchdog.halt()
            raise DeviceError(
                f"the head was sent to pan {math.degrees(pan):.3f}, tilt {math.degrees(tilt):.3f} degrees and says "
                f"that it goes to {math.degrees(said[0]):.3f}, {math.degrees(said[1]):.3f}, beyond the limits"
            )
        return said

    def halt(self) -> None:
        """Stop both axes at once."""
        self._watchdog.halt()

    def _patience(self, goal: tuple[float, float], speeds: tuple[float, float]) -> float:
        """Estimate how long the device may wait for the head to arrive [s]."""
        if math.isinf(min(speeds)):
            return 0.0  # only a simulated head has infinite speed, and its wait is not watched
        state, longest = self._head.state(), 0.0
        ways = (goal[0] - state.pan, goal[1] - state.tilt)
        for way, speed, axis in zip(ways, speeds, self._limits.axes, strict=True):
            # A head that turns the other way must brake first, and then come back.
            overshoot = axis.speed * axis.braking_s if state.moving else 0.0
            longest = max(longest, replace(axis, speed=speed).travel_s(abs(way) + overshoot) + 2 * axis.braking_s)
        return ARRIVAL_S + SLOWNESS * longest


class SafeCamera:
    """A camera that refuses frames that are too old to act on, or from the future."""

    def __init__(self, camera: Camera, clock: Clock, watchdog: Watchdog, max_age_s: float, name: str) -> None:
        self._camera, self._clock, self._watchdog = camera, clock, watchdog
        self._max_age_s, self._name = max_age_s, name
        self._newest = -math.inf

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self._camera.size

    def describe(self) -> str:
        """Describe the camera's stream in one line; empty where its driver does not measure it."""
        describe: Callable[[], str] | None = getattr(self._camera, "describe", None)
        return "" if describe is None else describe()

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Wait for the newest frame; with ``newer_than`` [s] for one exposed after that time.

        Raises:
            StaleFrameError: no new frame came, or the newest is too old to act on.
        """
        frame = self._read(newer_than, timeout)
        if self._clock.now() - frame.t > self._max_age_s:  # it may have waited while the program was suspended
            with contextlib.suppress(StaleFrameError):
                frame = self._read(frame.t, timeout)
        now = self._clock.now()
        age = now - frame.t
        if not age <= self._max_age_s:
            raise StaleFrameError(
                f"the newest frame is {age:.2f} s old; at most {self._max_age_s:g} s is acted on ({self._name} camera)"
            )
        if newer_than is not None and not frame.t > newer_than:
            raise StaleFrameError(f"the {self._name} camera gave a frame of {frame.t:.3f} s for one after that time")
        self._accept(frame, now)
        return frame

    def _accept(self, frame: Frame, now: float) -> None:
        """Refuse a frame from the future; one newer than all before is a sign of life at ``now`` [s].

        A frame that its camera in real time repeats is none. A replay halts where its recording did.
        """
        ahead = frame.t - now
        if not ahead <= FUTURE_S:
            raise StaleFrameError(
                f"the {self._name} camera's frame is from {ahead:.2f} s in the future; mind the clock"
            )
        self._watchdog.on_call()
        if frame.t > self._newest:
            self._newest = frame.t
            if not (frame.repeated and self._watchdog.threaded):
                self._watchdog.alive(now)

    def _read(self, newer_than: float | None, timeout: float) -> Frame:
        """Read a frame; without a watchdog thread, interrupt the wait where the watchdog is due."""
        if self._watchdog.threaded:
            return self._camera.read(newer_than, timeout)
        self._watchdog.watch()
        deadline = self._watchdog.deadline()
        if deadline is not None and 0 < (first := deadline - self._clock.now()) < timeout:
            try:
                return self._camera.read(newer_than, first)
            except StaleFrameError:
                self._watchdog.watch()
                timeout -= first
        return self._camera.read(newer_than, timeout)


class SafeZoomCamera(SafeCamera):
    """The zoom camera with checked frames. An emergency stop leaves the lens alone: it moves inside the camera."""

    def __init__(self, camera: ZoomCamera, clock: Clock, watchdog: Watchdog, max_age_s: float) -> None:
        super().__init__(camera, clock, watchdog, max_age_s, "zoom")
        self._device = camera

    @property
    def still_size(self) -> tuple[int, int]:
        """(width, height) of full stills [px]."""
        return self._device.still_size

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest focal length [px]."""
        return self._device.focal_range

    def zoom(self, focal_px: float) -> float:
        """Start the lens moving; return the focal length [px] that it will really reach.

        Raises:
            DeviceError: the focal length is not finite.
        """
        if not math.isfinite(focal_px):
            raise DeviceError(f"the lens cannot go to a focal length of {focal_px} px")
        return self._device.zoom(focal_px)

    def state(self) -> ZoomState:
        """Return the lens's state now."""
        return self._device.state()

    def number(self, focal_px: float) -> float | None:
        """Return the device's own number of a nominal focal length [px]; None where its driver has none."""
        number: Callable[[float], float] | None = getattr(self._device, "number", None)
        return None if number is None else number(focal_px)

    def capture(self) -> Frame:
        """Take a full still. It may be old when it arrives, because it is large, but not older than the request.

        Raises:
            StaleFrameError: the still is older than the request.
        """
        asked = self._clock.now()
        frame = self._device.capture()
        if not frame.t >= asked - FUTURE_S:
            raise StaleFrameError(f"the still is from {asked - frame.t:.2f} s before it was asked for (zoom camera)")
        self._accept(frame, self._clock.now())
        return frame


class SafeClock:
    """A simulation's clock that runs the watchdog when it is due during a sleep."""

    def __init__(self, clock: Clock, watchdog: Watchdog) -> None:
        self._clock, self._watchdog = clock, watchdog

    def now(self) -> float:
        """Return the time on the rig's clock [s]."""
        return self._clock.now()

    def sleep_until(self, t: float) -> None:
        """Sleep until the clock shows ``t`` [s]."""
        deadline = self._watchdog.deadline()
        if deadline is not None and deadline < t:
            self._clock.sleep_until(deadline)
            self._watchdog.watch()
        self._clock.sleep_until(t)


# Soft limits and speed cap


def soft_limits(device: PanTiltLimits, config: SafetyConfig) -> PanTiltLimits:
    """Combine the device's limits with the configured ones; the tighter ones hold.

    Raises:
        ConfigError: no angle is left, or a limit is not finite.
    """
    most = math.inf if config.speed_deg_s is None else math.radians(config.speed_deg_s)
    return PanTiltLimits(
        _tighter(device.pan, config.pan_deg, most, "pan"), _tighter(device.tilt, config.tilt_deg, most, "tilt")
    )


def _tighter(axis: AxisLimits, soft_deg: tuple[float, float] | None, speed: float, name: str) -> AxisLimits:
    """Intersect an axis's own limits with soft ones [degrees] and a speed cap [rad/s]."""
    # Nan is none of these.
    if not (
        axis.speed > 0 and axis.assumed_acceleration > 0 and 0 <= axis.step < math.inf and 0 <= axis.slack < math.inf
    ):
        raise ConfigError(
            f"the head reports for {name} a speed of {axis.speed}, an acceleration of {axis.acceleration}, a step of "
            f"{axis.step} and a slack of {axis.slack}; correct its driver"
        )
    key, own = f"safety.{name}_deg", [round(math.degrees(v), 1) for v in axis.range]
    if not axis.range[0] <= axis.range[1]:  # nor is nan
        raise ConfigError(f"{key}: the head reports a range of {own}, which is none; correct its driver")
    limits = replace(axis, speed=min(axis.speed, speed))
    if soft_deg is None:
        if not all(map(math.isfinite, axis.range)):
            raise ConfigError(f"{key}: is missing; the head reports no end of its range, {own}")
        return limits
    low, high = max(math.radians(soft_deg[0]), axis.range[0]), min(math.radians(soft_deg[1]), axis.range[1])
    limits = replace(limits, range=(low, high))
    first, last = limits.outermost()
    if low >= high or first > last:
        raise ConfigError(f"{key}: {list(soft_deg)} leaves nothing of the device's own range {own}")
    return limits


# The guarded rig


def guard(rig: Rig, config: SafetyConfig) -> Rig:
    """Put the safety layer in front of a rig: its head keeps the limits, is watched, and can be stopped.

    The head of a rig in real time must accept a halt from any thread at any time. Closing the guarded rig halts the
    head, then closes the rig behind it.

    Args:
        rig: a rig without a safety layer; it is closed if this fails, but for a rig that is guarded already.
        config: limits, times and stop file.

    Raises:
        ConfigError: the rig is guarded already, the soft limits leave nothing of the device's range, or a rig in real
            time is opened outside of the main thread, see `cotarget.safety.signals.guard_head`.
        EmergencyStopError: a stop file exists.
    """
    if rig.guard is not None:
        raise ConfigError("the rig is guarded already; open it by open_rig(..., guarded=False) to guard it here")
    behind = _Guard(rig, config)
    try:
        refuse_if_stopped(config.stop_file)
        limits = rig.head.limits if "head" in rig.missing else soft_limits(rig.head.limits, config)
        watchdog, max_age_s = behind.watchdog, config.max_frame_age_s
        guarded = replace(
            rig,
            fixed=SafeCamera(rig.fixed, rig.clock, watchdog, max_age_s, "fixed"),
            zoom=SafeZoomCamera(rig.zoom, rig.clock, watchdog, max_age_s),
            head=SafeHead(rig.head, limits, watchdog),
            clock=rig.clock if rig.spec.real_time else SafeClock(rig.clock, watchdog),
            spec=replace(rig.spec, head=replace(rig.spec.head, limits=limits)),
            release=behind.close,
            guard=behind,
        )
        behind.begin()
    except BaseException:
        behind.leave()
        behind.undo_signals()
        rig.close()
        raise
    return guarded


class _Guard:
    """Emergency stop and closing of a guarded rig, with its threads, signal handlers and exit hook."""

    def __init__(self, rig: Rig, config: SafetyConfig) -> None:
        self._rig = rig
        self.watchdog = Watchdog(rig.head, rig.clock, config, threaded=rig.spec.real_time)
        self._closed = False
        self._watcher: Watcher | None = None
        self.undo_signals: Callable[[], None] = lambda: None

    def begin(self) -> None:
        """Watch a rig in real time, and halt the head of any rig at the program's exit."""
        atexit.register(self._close_at_exit)  # for a rig that the program does not close
        if self._rig.spec.real_time:
            self.undo_signals = guard_head(self.watchdog)
            self._watcher = Watcher(self.watchdog)

    def stop(self, reason: str) -> None:
        """Halt the head, and refuse every move until `clear`; may be called from any thread."""
        self.watchdog.stop(reason)

    def clear(self) -> str | None:
        """End the emergency stop, unless a stop file exists; return its reason."""
        return self.watchdog.clear()

    @property
    def stopped(self) -> str | None:
        """Reason of the emergency stop; None if there is none."""
        return self.watchdog.reason

    def close(self) -> None:
        """Halt the head, then close the rig; signals are deferred until that is done."""
        self._close(deliver=True)

    def close_after(self, error: BaseException) -> None:
        """Halt the head, then close the rig; a failure does not hide the error that led here."""
        log.info("halting the head: %s", type(error).__name__)
        try:
            self._close(deliver=isinstance(error, Exception))  # after Ctrl-C a second one adds nothing
        except Exception as failure:
            self._report(failure, error)

    def _close_at_exit(self) -> None:
        """Halt the head, then close the rig, where Python would print an exception and ignore it."""
        try:
            self._close(deliver=False)
        except Exception as failure:
            self._report(failure)

    def _report(self, failure: BaseException, error: BaseException | None = None) -> None:
        """Log why the rig could not be closed, unless that is logged already or is the error that led here."""
        if str(failure) == self.watchdog.logged or (error is not None and str(failure) == str(error)):
            log.error("the head could not be halted, and may go on to the goal of its last command")
        else:
            log.error("the rig could not be closed: %s", failure)

    def _close(self, deliver: bool) -> None:
        if self._closed:
            return
        deferred = DeferredSignals()
        interrupt: BaseException | None = None
        while True:
            try:
                deferred.defer()
                break
            except (KeyboardInterrupt, SystemExit) as error:  # a signal just before the deferral
                interrupt = error
        errors: list[BaseException] = []
        self._closed = True
        for act in (self.watchdog.shut, deferred.let_hurry, self.leave, self._rig.close):
            try:
                act()
            except BaseException as error:
                errors.append(error)
        deferred.restore()
        self.undo_signals()  # after the deferral, which has put these handlers back
        for failure in errors[1:]:
            log.info("while the rig was closed: %s", failure)
        if deliver and errors and (interrupt is not None or deferred.pending):
            self._report(errors[0])  # the signal that ends the program now hides this error
        if deliver and interrupt is not None:
            raise interrupt
        if deliver:
            deferred.deliver()
        if errors:
            raise next((e for e in errors if not isinstance(e, Exception)), errors[0])

    def leave(self) -> None:
        """Remove this layer's threads and exit hook."""
        if self._watcher is not None:
            self._watcher.close()
            self.watchdog.close()
        atexit.unregister(self._close_at_exit)
