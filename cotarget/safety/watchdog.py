"""Knows whether the head may be moving and whether it may move, and halts it when it may not.

Devices, the watching thread and the operator all come here, each from a thread of its own. The lock is held for
bookkeeping only and never while a device is called, so that a device that hangs keeps nobody from halting the head.

Looks at the stop file on a thread of its own: a file system that hangs must keep nobody from halting the head.

The thread that watches over a rig in real time, also while the program hangs.
"""

import logging
import math
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic

from cotarget.config import SafetyConfig
from cotarget.errors import DeviceError, EmergencyStopError
from cotarget.rig import Clock, PanTilt, PanTiltState
from cotarget.safety.stop_file import stop_reason, stopped_by_file

LOOK_POLL_S = 0.05  # a look takes well below a millisecond; it is waited for in slices of this [s]
# So many slices without an answer, and nobody knows whether somebody has called for a stop. They are counted rather
# than timed, so that a machine that stood still does not count as a file that cannot be looked at.
MOST_MISSED = 6
# A look that began this lately is good enough for a command, which then waits for none: who watches halts the head for
# a file that came meanwhile [s].
RECENT_S = 2 * LOOK_POLL_S
LOOK_JOIN_S = 0.2  # for the thread to end, if it is not held by the file [s]


class StopLook:
    """Tells why the head must not move, within a time that does not depend on the file.

    Args:
        path: of the stop file; None for none, which never stops.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._changed = threading.Condition()
        self._asked = self._answered = self._missed = 0
        self._reason: str | None = None
        self._looked_at = -math.inf
        self._thread: threading.Thread | None = None
        self._closed = False

    def reason(self, longest: float | None = None) -> str | None:
        """What a look that begins now says; a file that has not answered for long counts as a stop.

        Args:
            longest: how long to wait for it, and then take the last answer [s]; None to wait for an answer.
        """
        if self._path is None or self._closed:
            return self._reason
        with self._changed:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="cotarget-stop-file", daemon=True)
                self._thread.start()
            self._asked += 1
            question = self._asked
            self._changed.notify_all()
            while True:
                wait = LOOK_POLL_S if longest is None else min(longest, LOOK_POLL_S)
                if self._changed.wait_for(lambda: self._answered >= question, wait):
                    return self._reason
                self._missed += wait == LOOK_POLL_S
                if self._missed >= MOST_MISSED:
                    return f"the stop file cannot be looked at: no answer within {MOST_MISSED * LOOK_POLL_S:g} s"
                if longest is not None:
                    return self._reason

    def is_clear(self) -> bool:
        """Whether a recent look found no stop; at once."""
        with self._changed:
            return self._path is None or (self._reason is None and monotonic() - self._looked_at <= RECENT_S)

    def close(self) -> None:
        """End the thread; one that the file holds ends when the file lets it go."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(LOOK_JOIN_S)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._asked > self._answered)
                if self._closed:
                    return
                question = self._asked
            begun = monotonic()
            try:
                reason = stop_reason(self._path)
            except Exception as error:  # who cannot look lets nothing move
                reason = f"the file cannot be read: {error}"
            with self._changed:
                self._answered, self._reason, self._missed, self._looked_at = question, reason, 0, begun
                self._changed.notify_all()


log = logging.getLogger(__name__)
HALT_TRIES = 2  # when the rig is closed; a driver's own deadlines bound each
AT_GOAL = math.radians(0.1)  # as near as this, and a step, a head that rests has arrived [rad]


@dataclass(frozen=True, eq=False)
class Motion:
    """A command to the head.

    Attributes:
        goal: pan and tilt [rad].
        halts: how many halts there had been when it was given.
        patience_s: how long the device itself may wait for the head to arrive; 0 where it does not [s].
        on_its_way: whether the device has not yet returned from it.
    """

    goal: tuple[float, float]
    halts: int
    patience_s: float
    on_its_way: bool = True


class Guard:
    """The memory of a rig's watchdog and emergency stop.

    The head may be moving from a command until a halt, until the device has waited for its arrival, or until it is
    seen to rest at the goal. Through that time there must be a sign of life every ``watchdog_s``: a command, or a
    frame newer than all before.

    Args:
        head: the device.
        clock: the rig's.
        config: how long without a sign of life, and the stop file.
        threaded: whether a thread calls `watch`. Where none does, each call on the rig has to.

    Attributes:
        told: why the head could not be halted, as the log has it already; empty where it has not.
    """

    def __init__(self, head: PanTilt, clock: Clock, config: SafetyConfig, *, threaded: bool) -> None:
        self.threaded, self.told = threaded, ""
        self._head, self._clock = head, clock
        self._timeout_s, self._stop_file = config.watchdog_s, config.stop_file
        self._look = StopLook(config.stop_file)  # idle where no thread watches: time does not pass by itself then
        self._lock = threading.RLock()  # reentrant: a signal's handler may call stop() anywhere
        self._motion: Motion | None = None
        self._alive_at = -math.inf
        self._halts = 0
        self._owed: str | None = None  # why the head has still to be halted, where that failed
        self._stopped: str | None = None  # by this process
        self._stopped_by_file: str | None = None
        self._shut = False

    def begin(self, goal: tuple[float, float], patience_s: float = 0.0) -> Motion:
        """Note that a command is about to be given.

        Raises:
            EmergencyStopError: the head is stopped.
            DeviceError: the rig is closed, or the head has still to be halted and cannot be.
        """
        if not self.threaded:
            self.watch()
        elif (self._stopped_by_file is None and self._look.is_clear()) or not self._heed_stop_file():
            self._halt_if_owed()
        with self._lock:
            halts = self._halts  # before anything is asked: a signal's handler may stop the head in between
            self.refuse_if_stopped()
            if self._shut:
                raise DeviceError("the rig is closed, so the head does not move any more")
            if self._owed is not None:
                raise DeviceError(f"the head does not move before it could be halted: {self._owed}")
            self._motion = Motion(goal, halts, patience_s)
            self._alive_at = self._clock.now()
            return self._motion

    def end(self, motion: Motion, arrived: bool) -> bool:
        """Note that the device has returned from a command, and whether the head has arrived.

        Returns:
            Whether the head was halted meanwhile. Then the command may have reached the unit after the halt, and the
            head has been halted once more.
        """
        with self._lock:
            interrupted = self._halts != motion.halts
            self._alive_at = self._clock.now()
            if self._motion is motion and not interrupted:
                self._motion = None if arrived else replace(motion, patience_s=0.0, on_its_way=False)
        if interrupted:
            self._halt()  # the command may have come behind the halt
        return interrupted

    def alive(self, now: float) -> None:
        """Note a sign of life: a frame newer than all before, read at this time [s]."""
        self._alive_at = now

    def on_call(self) -> None:
        """Watch, where no thread does."""
        if not self.threaded:
            self.watch()

    def saw(self, state: PanTiltState, step: float) -> None:
        """Note where the head says it is: one that rests at its goal needs no watching."""
        with self._lock:
            motion = self._motion
            if motion is None or motion.on_its_way or state.moving:
                return
            off = max(abs(state.pan - motion.goal[0]), abs(state.tilt - motion.goal[1]))
            if off <= step + AT_GOAL:
                self._motion = None

    def deadline(self) -> float | None:
        """When the head will be halted without a sign of life, on the rig's clock [s]; None while it rests."""
        with self._lock:
            return None if self._motion is None else self._alive_at + self._motion.patience_s + self._timeout_s

    def pause(self, longest: float) -> float:
        """How long nobody need watch [s]."""
        deadline = self.deadline()
        if deadline is None or self._owed is not None:
            return longest
        return min(max(deadline - self._clock.now(), 0.0), longest)

    def watch(self) -> None:
        """Halt the head if that is due: no sign of life, a stop file, or a halt that failed before."""
        # First what needs no file system; then its answer is waited for no longer than until that is due again.
        tried = self._halt_if_overdue()
        if not (self._heed_stop_file(self.pause(math.inf)) or tried):
            self._halt_if_owed()

    def _halt_if_overdue(self) -> bool:
        """Halt the head if there was no sign of life in time; whether that was so."""
        # In this order, a clock that goes forward shows no less than when the last sign of life was noted.
        alive_at, deadline = self._alive_at, self.deadline()
        if deadline is None or self._owed is not None:
            return False
        now = self._clock.now()
        if alive_at <= now < deadline:
            return False
        if now < alive_at:
            reason = f"the rig's clock ran backwards by {alive_at - now:.3g} s"
        else:
            reason = f"neither a fresh frame nor a command for {now - alive_at:.2g} s"
        log.warning("halting the head: %s", reason)
        self._halt()
        return True

    def halt(self) -> None:
        """Halt the head because the program says so; where the device fails, the watchdog tries again.

        Raises:
            Exception: whatever the device raised.
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

    def stop(self, reason: str) -> None:
        """Halt the head, and let it not move until `clear`."""
        with self._lock:
            self._stopped = reason  # first of all, so that no command slips in behind the halt
        log.warning("emergency stop: %s", reason)
        self._halt()

    def clear(self) -> str | None:
        """End this process's emergency stop; return its reason.

        Raises:
            EmergencyStopError: there still is a stop file.
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
        """Raise while the head is stopped, by what was last seen of the stop file.

        Raises:
            EmergencyStopError: with the reason, and how to clear it.
        """
        if self._stopped is not None:
            raise EmergencyStopError(f"emergency stop: {self._stopped}; the head moves again after clear()")
        if self._stopped_by_file is not None:
            raise stopped_by_file(self._stop_file, self._stopped_by_file)

    def shut(self) -> None:
        """Halt the head for good.

        Raises:
            Exception: whatever the device raised at the last of several tries.
        """
        with self._lock:
            self._shut, self._halts = True, self._halts + 1
        for left in reversed(range(HALT_TRIES)):
            try:
                self._head.halt()
                break
            except Exception:  # told by who closes the rig
                if not left:
                    raise
        with self._lock:
            self._motion = self._owed = None

    def close(self) -> None:
        """End the look-out for a stop file."""
        self._look.close()

    def _halt(self) -> None:
        """Halt the head; where the device fails, say so and owe it."""
        with self._lock:
            motion, self._halts = self._motion, self._halts + 1
        try:
            self._head.halt()
        except Exception as error:  # whatever it is, the head has to be halted all the same
            with self._lock:
                first, self._owed = self._owed is None, str(error)
            if first and not self._shut:
                self.told = str(error)
                log.error("the head could not be halted and will be halted again: %s", error)
            return
        self._rests(motion)

    def _rests(self, motion: Motion | None) -> None:
        """Note that a halt was obeyed; a command given meanwhile is watched on."""
        with self._lock:
            late, self._owed = self._owed is not None, None
            if self._motion is motion:
                self._motion = None
        if late:
            log.warning("the head is halted now")

    def _stop_file_says(self, longest: float | None = None) -> str | None:
        """Why the stop file stops the head; None if it does not. See `StopLook.reason`."""
        return self._look.reason(longest) if self.threaded else stop_reason(self._stop_file)

    def _heed_stop_file(self, longest: float | None = None) -> bool:
        """Look for a stop file, and halt the head for a new one; whether there is a new one."""
        reason = self._stop_file_says(longest)
        with self._lock:
            new = reason is not None and self._stopped_by_file is None
            self._stopped_by_file = reason
        if new:
            log.warning("emergency stop: %s", reason)
            self._halt()
        return new

    def _halt_if_owed(self) -> None:
        """Try again to halt a head that could not be halted."""
        if self._owed is not None:
            self._halt()


# --- watcher ---

POLL_S = 0.05  # between looks at the stop file, and between tries to halt a head that could not be halted [s]
JOIN_S = 2.0  # a halt's own deadline and some [s]


class Watcher:
    """Watches until it is closed; looks exactly when the watchdog is due, and every ``POLL_S`` anyway."""

    def __init__(self, guard: Guard) -> None:
        self._guard = guard
        self._leave = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cotarget-watchdog", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Watch no longer."""
        self._leave.set()
        if self._thread is not threading.current_thread():
            self._thread.join(JOIN_S)
            if self._thread.is_alive():
                log.warning("the watchdog still waits for the head to answer a halt")

    def _run(self) -> None:
        pause = 0.0
        while not self._leave.wait(pause):
            try:
                self._guard.watch()
                pause = self._guard.pause(POLL_S)
            except Exception as error:  # a clock that fails, say: who cannot watch lets nothing move
                pause = POLL_S
                if self._guard.reason is None:
                    self._guard.stop(f"the watchdog failed: {error}")
