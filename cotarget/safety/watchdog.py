"""The watchdog of a rig: decide whether the head may move, and halt it when it may not.

Devices, the watchdog's thread (`Watcher`) and the operator call `Watchdog`, each from another thread. Its lock is never
held during a call of a device, so that a hanging device cannot keep another thread from halting the head. `StopLook`
reads the stop file on its own thread for the same reason: a file system may hang.
"""

import contextlib
import logging
import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace

from cotarget.config import SafetyConfig
from cotarget.errors import DeviceError, EmergencyStopError
from cotarget.rig import Clock, PanTilt, PanTiltLimits, PanTiltState
from cotarget.safety.signals import is_main_thread
from cotarget.safety.stop_file import StopLook, stop_reason, stopped_by_file

log = logging.getLogger(__name__)

HALT_TRIES = 2  # when the rig is closed; the driver limits the time of each
AT_GOAL = math.radians(0.1)  # a head that rests within this and its tolerance of its goal has arrived [rad]
OUTSIDE = math.radians(0.5)  # a head farther beyond its soft limits has left them; a servo's overshoot is less [rad]


@dataclass(frozen=True, eq=False)
class Motion:
    """A command to the head that is under way.

    Attributes:
        goal: pan and tilt [rad].
        t: time before it was sent, on the rig's clock [s]; an older state says nothing of it.
        halts: number of halts before the command.
        patience_s: how long the device itself may wait for the head to arrive [s]; 0 if it does not wait.
        on_its_way: whether the device's call has not yet returned.
    """

    goal: tuple[float, float]
    t: float
    halts: int
    patience_s: float
    on_its_way: bool = True


class Watchdog:
    """Watchdog and emergency stop of a head.

    The head may be moving from a command until a halt, until the device has waited for its arrival, or until a state
    shows it at rest at the goal. In that time there must be a sign of life every ``watchdog_s``: a command, or a frame
    newer than all before.

    Args:
        head: the device.
        clock: the rig's clock.
        config: watchdog time and stop file.
        threaded: whether a thread calls `watch`; otherwise each call on the rig does.

    Attributes:
        logged: why the head could not be halted, as already logged; empty if it could.
        in_main_thread: whether the main thread opened the rig, or gave the last command.
    """

    def __init__(self, head: PanTilt, clock: Clock, config: SafetyConfig, *, threaded: bool) -> None:
        self.threaded, self.logged, self.in_main_thread = threaded, "", is_main_thread()
        self._is_inside: bool | None = None  # whether the last state was within the soft limits
        self._head, self._clock = head, clock
        self._timeout_s = config.watchdog_s
        self._stop_file = config.stop_file and config.stop_file.absolute()  # the program may change its directory
        self._look = StopLook(self._stop_file)  # unused without a watching thread: time passes only inside calls then
        self._lock = threading.RLock()  # reentrant: a signal handler may call stop() anywhere
        self._motion: Motion | None = None
        self._called_t = -math.inf  # when the device's last call began or ended; an older state says nothing new [s]
        self._alive_at = -math.inf
        self._halts = 0
        self._owed: str | None = None  # why a halt failed that must be repeated
        self._stopped: str | None = None  # reason of an emergency stop by this process
        self._stopped_by_file: str | None = None
        self._shut = False

    def begin(self, goal: tuple[float, float], patience_s: float = 0.0) -> Motion:
        """Register a command before it is sent.

        Raises:
            EmergencyStopError: the head is stopped.
            DeviceError: the rig is closed, or a halt that must be repeated fails again.
        """
        if not self.threaded:
            self.watch()
        elif (self._stopped_by_file is None and self._look.is_clear()) or not self._heed_stop_file():
            self._halt_if_owed()
        with self._lock:
            halts = self._halts  # read first: a signal handler may stop the head in between
            self.refuse_if_stopped()
            if self._shut:
                raise DeviceError("the rig is closed, so the head does not move any more")
            if self._owed is not None:
                raise DeviceError(f"the head does not move before it could be halted: {self._owed}")
            self._alive_at = self._called_t = self._clock.now()
            self._motion = Motion(goal, self._alive_at, halts, patience_s)
            self.in_main_thread = is_main_thread()
            return self._motion

    def end(self, motion: Motion, arrived: bool) -> bool:
        """Register that the device's call has returned, and whether the head has arrived.

        Returns:
            Whether the head was halted during the call; it is halted again.
        """
        with self._lock:
            interrupted = self._halts != motion.halts
            self._alive_at = self._called_t = self._clock.now()
            if self._motion is motion and not interrupted:
                self._is_inside = arrived or self._is_inside  # a goal lies within the soft limits
                self._motion = None if arrived else replace(motion, patience_s=0.0, on_its_way=False)
        if interrupted:
            self._halt()  # the command may have reached the unit after the halt
        return interrupted

    def alive(self, now: float) -> None:
        """Register a sign of life at ``now`` [s]: a frame newer than all before."""
        self._alive_at = now

    def on_call(self) -> None:
        """Run the watchdog, if no thread does."""
        if not self.threaded:
            self.watch()

    def saw(self, state: PanTiltState, limits: PanTiltLimits) -> None:
        """Register a state: rest at the goal ends the motion, and a position beyond the soft limits stops the head."""
        self._check_inside(state, limits)
        with self._lock:
            motion = self._motion
            if motion is None or motion.on_its_way or state.moving or state.t < motion.t:
                return
            offs = (abs(state.pan - motion.goal[0]), abs(state.tilt - motion.goal[1]))
            if all(off <= axis.tolerance + AT_GOAL for off, axis in zip(offs, limits.axes, strict=True)):
                self._motion = None

    def _check_inside(self, state: PanTiltState, limits: PanTiltLimits) -> None:
        """Stop a head that was within the soft limits and is not any more; warn of one that is outside of them."""
        if state.t < self._called_t:
            return
        angles = zip((state.pan, state.tilt), limits.axes, strict=True)
        was_inside, self._is_inside = (
            self._is_inside,
            all(axis.beyond(q) <= axis.tolerance + OUTSIDE for q, axis in angles),
        )
        if self._is_inside or was_inside is False:
            return
        place = f"pan {math.degrees(state.pan):.1f}, tilt {math.degrees(state.tilt):.1f} degrees"
        if was_inside:
            self.stop(f"the head left its soft limits: it is at {place}")
        else:
            log.warning("the head stands beyond its soft limits, at %s", place)

    def deadline(self) -> float | None:
        """Return when the head is halted without a sign of life, on the rig's clock [s]; None while it rests."""
        with self._lock:
            return None if self._motion is None else self._alive_at + self._motion.patience_s + self._timeout_s

    def pause(self, longest: float) -> float:
        """Return how long `watch` need not be called [s], at most ``longest``."""
        deadline = self.deadline()
        if deadline is None or self._owed is not None:
            return longest
        return min(max(deadline - self._clock.now(), 0.0), longest)

    def watch(self) -> None:
        """Halt the head for an overdue sign of life, a stop file, or a halt that failed before."""
        # First the check without a file system; the file's answer is awaited until that check is due again at the most.
        tried = self._halt_if_overdue()
        if not (self._heed_stop_file(self.pause(math.inf)) or tried):
            self._halt_if_owed()

    def _halt_if_overdue(self) -> bool:
        """Halt the head if no sign of life came in time; return whether that was so."""
        if self._motion is None or self._owed is not None:
            return False
        # In this order: a clock that runs forward shows no time before the last sign of life that was read before it,
        # and a sign of life that comes meanwhile counts.
        alive_at, now, deadline = self._alive_at, self._clock.now(), self.deadline()
        if deadline is None or alive_at <= now < deadline:
            return False
        if now < alive_at:
            reason = f"the rig's clock ran backwards by {alive_at - now:.3g} s"
        else:
            reason = f"neither a fresh frame nor a command for {now - alive_at:.2g} s"
        log.warning("halting the head: %s", reason)
        self._halt()
        return True

    def halt(self) -> None:
        """Halt the head; if the device fails, the watchdog tries again.

        Raises:
            Exception: as the device raised it.
        """
        with self._lock:
            motion, self._halts = self._motion, self._halts + 1
        try:
            self._head.halt()
        except Exception as error:
            with self._lock:
                self._owed = str(error)
            raise
        self._rests(motion)

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Let no command of another thread begin in the block."""
        with self._lock:
            yield

    def refuse(self, reason: str) -> None:
        """Refuse moves until `clear`."""
        with self._lock:
            self._stopped = reason

    def stop(self, reason: str) -> None:
        """Halt the head, and refuse moves until `clear`."""
        self.refuse(reason)  # first, so that no command follows the halt
        log.warning("emergency stop: %s", reason)
        self._halt()

    def clear(self) -> str | None:
        """End this process's emergency stop; return its reason.

        Raises:
            EmergencyStopError: a stop file exists.
        """
        if (there := self._stop_file_says()) is not None:
            raise stopped_by_file(self._stop_file, there)
        with self._lock:
            reason, self._stopped, self._stopped_by_file = self._stopped, None, None
        return reason

    @property
    def reason(self) -> str | None:
        """Why the head is stopped; None if it is not."""
        return self._stopped if self._stopped is not None else self._stop_file_says()

    def refuse_if_stopped(self) -> None:
        """Raise while the head is stopped, by the last answer about the stop file.

        Raises:
            EmergencyStopError: the head is stopped; the message has the reason, and how to clear it.
        """
        if self._stopped is not None:
            raise EmergencyStopError(f"emergency stop: {self._stopped}; the head moves again after clear()")
        if self._stopped_by_file is not None:
            raise stopped_by_file(self._stop_file, self._stopped_by_file)

    def shut(self) -> None:
        """Halt the head for good, before the rig is closed.

        Raises:
            Exception: as the device raised it at the last of `HALT_TRIES` tries.
        """
        with self._lock:
            self._shut, self._halts = True, self._halts + 1
        for left in reversed(range(HALT_TRIES)):
            try:
                self._head.halt()
                break
            except Exception:  # whatever closes the rig reports it
                if not left:
                    raise
        with self._lock:
            self._motion = self._owed = None

    def close(self) -> None:
        """End the thread that reads the stop file."""
        self._look.close()

    def _halt(self) -> None:
        """Halt the head; log the first failure of the device, after which the watchdog tries again."""
        first = self._owed is None
        try:
            self.halt()
        except Exception as error:
            if first and not self._shut:
                self.logged = str(error)
                log.error("the head could not be halted and will be halted again: %s", error)

    def _rests(self, motion: Motion | None) -> None:
        """Register a successful halt; a command sent after ``motion`` stays under watch."""
        with self._lock:
            late, self._owed = self._owed is not None, None
            if self._motion is motion:
                self._motion = None
        if late:
            log.warning("the head is halted now")

    def _stop_file_says(self, longest: float | None = None) -> str | None:
        """Read why the stop file stops the head; None if it does not. See `StopLook.reason`."""
        return self._look.reason(longest) if self.threaded else stop_reason(self._stop_file)

    def _heed_stop_file(self, longest: float | None = None) -> bool:
        """Read the stop file, and halt the head for a new one; return whether there is a new one."""
        reason = self._stop_file_says(longest)
        with self._lock:
            new = reason is not None and self._stopped_by_file is None
            self._stopped_by_file = reason
        if new:
            log.warning("emergency stop: %s", reason)
            self._halt()
        return new

    def _halt_if_owed(self) -> None:
        """Repeat a halt that failed."""
        if self._owed is not None:
            self._halt()


POLL_S = 0.05  # period of reading the stop file, and of repeating a failed halt [s]
JOIN_S = 3.5  # time limit for the thread to end [s]: longer than a halt takes, 3 s with a usual time to brake


class Watcher:
    """Thread of a rig in real time that calls `Watchdog.watch` when a sign of life is due, and every `POLL_S`."""

    def __init__(self, watchdog: Watchdog) -> None:
        self._watchdog = watchdog
        self._leave = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cotarget-watchdog", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._leave.set()
        if self._thread is not threading.current_thread():
            self._thread.join(JOIN_S)
            if self._thread.is_alive():
                log.warning("the watchdog still waits for the head to answer a halt")

    def _run(self) -> None:
        pause = 0.0
        while not self._leave.wait(pause):
            try:
                self._watchdog.watch()
                pause = self._watchdog.pause(POLL_S)
            except Exception as error:  # such as a failing clock: without a watchdog nothing may move
                pause = POLL_S
                if self._watchdog.reason is None:
                    self._watchdog.stop(f"the watchdog failed: {error}")
