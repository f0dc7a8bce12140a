"""A rig with the safety layer in front: limits, watchdog, emergency stop, and a halt at every exit.

The devices keep their Protocols and refuse what is unsafe. A rig in real time has a watchdog thread. In the simulation
time passes only inside calls, so each call runs the watchdog, and a long call is split where the watchdog is due.
"""

import atexit
import dataclasses
import logging
import math
from collections.abc import Callable
from types import TracebackType

from cotarget.config import RigConfig, SafetyConfig
from cotarget.errors import ConfigError, DeviceError, StaleFrameError
from cotarget.files import HeldSignals
from cotarget.rig import (
    Board,
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
from cotarget.safety.signals import end_politely
from cotarget.safety.stop_file import refuse_if_stopped
from cotarget.safety.watchdog import Guard, Watcher

log = logging.getLogger(__name__)

# A frame cannot be from the future; this tolerance allows for a configured latency that is too long [s].
FUTURE_S = 0.05
# A loaded unit may take longer than its speed and acceleration give, by this factor.
SLOWNESS = 1.5
FINE = 1e-9  # rounding error of an angle [rad]


class SafeHead:
    """A head that keeps the soft limits and the speed cap, and does not move while stopped."""

    def __init__(self, head: PanTilt, limits: PanTiltLimits, guard: Guard) -> None:
        self._head, self._limits, self._guard = head, limits, guard

    @property
    def limits(self) -> PanTiltLimits:
        """Soft limits, within the device's own."""
        return self._limits

    def state(self) -> PanTiltState:
        """Return the head's state now."""
        self._guard.on_call()
        state = self._head.state()
        self._guard.saw(state, self._limits.step)
        return state

    def move(self, pan: float, tilt: float, speed: Speed | None = None, wait: bool = False) -> tuple[float, float]:
        """Command both axes [rad], clipped to the soft limits; return what was really commanded.

        Raises:
            EmergencyStopError: the head is stopped.
            DeviceError: an angle is not a number, a speed is not above zero, or the device failed or left the limits.
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
                self._guard.refuse_if_stopped()  # the halt made the device fail
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
        """Stop both axes at once."""
        self._guard.halt()

    def _patience(self, goal: tuple[float, float], speed: float) -> float:
        """Estimate how long the device may wait for the head to arrive [s]."""
        acceleration = self._limits.acceleration
        if math.isinf(speed):
            return 0.0  # only a simulated head has infinite speed, and its wait is not watched
        state = self._head.state()
        way = max(abs(goal[0] - state.pan), abs(goal[1] - state.tilt))
        peak = min(speed, math.sqrt(way * acceleration))
        from_rest = way / peak + peak / acceleration if way > 0 else 0.0
        # A head that turns the other way must brake first, and then come back.
        return SLOWNESS * (from_rest + (2 * self._limits.speed / acceleration if state.moving else 0.0))


def _inside(angle: float, bounds: tuple[float, float], limits: PanTiltLimits) -> bool:
    """Return whether an angle is within bounds, with a tolerance of one step; nan is not."""
    slack = limits.step + FINE
    return bounds[0] - slack <= angle <= bounds[1] + slack


class SafeCamera:
    """A camera that refuses frames that are too old to act on, or from the future."""

    def __init__(self, camera: Camera, clock: Clock, guard: Guard, max_age_s: float, name: str) -> None:
        self._camera, self._clock, self._guard = camera, clock, guard
        self._max_age_s, self._name = max_age_s, name
        self._newest = -math.inf

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self._camera.size

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Wait for the newest frame; with ``newer_than`` [s] for one exposed after that time.

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
        """Check a frame that was read at ``now`` [s]; one newer than all before is a sign of life.

        Raises:
            StaleFrameError: the frame is from the future.
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
    """The zoom camera with checked frames. An emergency stop leaves the lens alone: it moves inside the camera."""

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
        """Wait for the newest frame; with ``newer_than`` [s] for one exposed after that time.

        Raises:
            StaleFrameError: no new frame came, or the newest is too old to act on.
        """
        return self._stream.read(newer_than, timeout)

    def zoom(self, focal_px: float) -> float:
        """Start the lens moving; return the focal length [px] that it will really reach."""
        return self._camera.zoom(focal_px)

    def state(self) -> ZoomState:
        """Return the lens's state now."""
        return self._camera.state()

    def capture(self) -> Frame:
        """Take a full still. It may be old when it arrives, because it is large, but not older than the request.

        Raises:
            StaleFrameError: the still is older than the request.
        """
        asked = self._clock.now()
        frame = self._camera.capture()
        if not frame.t >= asked - FUTURE_S:
            raise StaleFrameError(f"the still is from {asked - frame.t:.2f} s before it was asked for (zoom camera)")
        self._stream.accept(frame, self._clock.now())
        return frame


class SafeClock:
    """A simulation's clock that runs the watchdog when it is due during a sleep."""

    def __init__(self, clock: Clock, guard: Guard) -> None:
        self._clock, self._guard = clock, guard

    def now(self) -> float:
        """Return the time on the rig's clock [s]."""
        return self._clock.now()

    def sleep_until(self, t: float) -> None:
        """Sleep until the clock shows ``t`` [s]."""
        deadline = self._guard.deadline()
        if deadline is not None and deadline < t:
            self._clock.sleep_until(deadline)
            self._guard.watch()
        self._clock.sleep_until(t)


# Soft limits and speed cap

ROUNDING = 1e-9  # in steps; keeps a limit of whole steps whole after its conversion from degrees


def soft_limits(device: PanTiltLimits, config: SafetyConfig) -> PanTiltLimits:
    """Combine the device's limits with the configured ones; the tighter ones hold.

    Raises:
        ConfigError: no angle is left.
    """
    return dataclasses.replace(
        device,
        pan=_within(config.pan_deg, device.pan, device.step, "safety.pan_deg"),
        tilt=_within(config.tilt_deg, device.tilt, device.step, "safety.tilt_deg"),
        speed=device.speed if config.speed_deg_s is None else min(device.speed, math.radians(config.speed_deg_s)),
    )


def clipped(pan: float, tilt: float, limits: PanTiltLimits) -> tuple[float, float]:
    """Clip angles to the limits; with steps to the outermost step inside them, so that rounding cannot lead outside.

    Raises:
        DeviceError: an angle is not a number.
    """
    if math.isnan(pan) or math.isnan(tilt):
        raise DeviceError(f"the head cannot go to pan {pan}, tilt {tilt}")
    return _clip(pan, limits.pan, limits.step), _clip(tilt, limits.tilt, limits.step)


def _within(
    soft_deg: tuple[float, float] | None, device: tuple[float, float], step: float, name: str
) -> tuple[float, float]:
    """Intersect soft limits [degrees] with the device's [rad].

    Raises:
        ConfigError: nothing is left.
    """
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
    """Return the outermost steps inside the limits; the limits themselves for a head without steps."""
    if step > 0:
        return math.ceil(limits[0] / step - ROUNDING) * step, math.floor(limits[1] / step + ROUNDING) * step
    return limits


# The guarded rig


class SafeRig:
    """A rig whose head keeps the limits, is watched, and can be stopped; closing it halts the head first.

    A rig whose attribute ``real_time`` is true is watched by a thread; its head must accept a halt from any thread at
    any time. Time of any other rig passes only inside calls, and each call runs the watchdog.
    """

    def __init__(self, rig: Rig, config: SafetyConfig) -> None:
        """Take over a rig and guard it; if that fails, the rig is closed.

        Raises:
            ConfigError: the soft limits leave nothing of the device's range.
            EmergencyStopError: a stop file exists.
        """
        self._rig = rig
        self.config: RigConfig | None = getattr(rig, "config", None)  # the configuration that the rig was opened from
        self._closed = False
        self._watcher: Watcher | None = None
        self._undo_signals: Callable[[], None] = lambda: None
        try:
            refuse_if_stopped(config.stop_file)
            real_time = bool(getattr(rig, "real_time", False))
            self._guard = Guard(rig.head, rig.clock, config, threaded=real_time)
            self.head: PanTilt = SafeHead(rig.head, soft_limits(rig.head.limits, config), self._guard)

            def guarded(camera: Camera, name: str) -> SafeCamera:
                return SafeCamera(camera, rig.clock, self._guard, config.max_frame_age_s, name)

            self.fixed: Camera = guarded(rig.fixed, "fixed")
            self.zoom: ZoomCamera = SafeZoomCamera(rig.zoom, guarded(rig.zoom, "zoom"), rig.clock)
            self.clock: Clock = rig.clock if real_time else SafeClock(rig.clock, self._guard)
            self.board: Board = rig.board
            atexit.register(self.close)  # for a rig that the program does not close
            if real_time:
                self._undo_signals = end_politely(self._guard.halt)
                self._watcher = Watcher(self._guard)
        except BaseException:
            self._leave()
            rig.close()
            raise

    def stop(self, reason: str) -> None:
        """Emergency stop: halt the head, and refuse every move until `clear`; may be called from any thread."""
        self._guard.stop(reason)

    def clear(self) -> str | None:
        """End the emergency stop, which only an operator may decide; return its reason.

        Raises:
            EmergencyStopError: a stop file exists.
        """
        return self._guard.clear()

    @property
    def stopped(self) -> str | None:
        """Reason of the emergency stop; None if there is none."""
        return self._guard.reason

    def close(self) -> None:
        """Halt the head, then close the rig; signals are deferred until that is done.

        Raises:
            Exception: as the device raised it when it could not be halted, or closed.
        """
        self._close(deliver=True)

    def __enter__(self) -> "SafeRig":
        """Return the rig itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Halt, then close; a failure does not hide the error that led here."""
        if error is None:
            self.close()
            return
        log.info("halting the head: %s", kind.__name__ if kind else error)
        try:
            self._close(deliver=isinstance(error, Exception))  # after Ctrl-C a second one adds nothing
        except Exception as failure:
            self._tell(failure)

    def _tell(self, failure: BaseException) -> None:
        """Log why the rig could not be closed, unless that is logged already."""
        if str(failure) == self._guard.told:
            log.error("the head could not be halted to the end")
        else:
            log.error("the rig could not be closed: %s", failure)

    def _close(self, deliver: bool) -> None:
        if self._closed:
            return
        held = HeldSignals()
        interrupt: BaseException | None = None
        while True:
            try:
                held.hold()
                break
            except (KeyboardInterrupt, SystemExit) as error:  # a signal just before the deferral
                interrupt = error
        errors: list[BaseException] = []
        self._closed = True
        for act in (self._guard.shut, held.let_hurry, self._leave, self._rig.close):
            try:
                act()
            except BaseException as error:
                errors.append(error)
        held.restore()
        for failure in errors[1:]:
            log.info("while the rig was closed: %s", failure)
        if deliver and errors and (interrupt is not None or held.pending):
            self._tell(errors[0])  # the signal that ends the program now hides this error
        if deliver and interrupt is not None:
            raise interrupt
        if deliver:
            held.deliver()
        if errors:
            raise next((e for e in errors if not isinstance(e, Exception)), errors[0])

    def _leave(self) -> None:
        """Remove this layer's threads, signal handlers and exit hook."""
        if self._watcher is not None:
            self._watcher.close()
            self._guard.close()
        self._undo_signals()
        atexit.unregister(self.close)
