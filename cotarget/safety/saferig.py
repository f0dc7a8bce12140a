"""A rig with the safety layer in front; it halts on every way out."""

import atexit
import logging
from collections.abc import Callable
from types import TracebackType

from cotarget.config import SafetyConfig
from cotarget.heldsignals import HeldSignals
from cotarget.rig import Board, Camera, Clock, PanTilt, Rig, ZoomCamera
from cotarget.safety.devices import SafeCamera, SafeClock, SafeHead, SafeZoomCamera
from cotarget.safety.guard import Guard
from cotarget.safety.limits import soft_limits
from cotarget.safety.signals import end_politely
from cotarget.safety.stopfile import refuse_if_stopped
from cotarget.safety.watcher import Watcher

log = logging.getLogger(__name__)


class SafeRig:
    """A rig whose head keeps the limits, is watched, and can be stopped; closing it halts the head first.

    A rig that has an attribute ``real_time`` that is true is watched by a thread; its head must let itself be halted
    from any thread at any time. Every other rig's time passes inside calls alone, and each call watches.
    """

    def __init__(self, rig: Rig, config: SafetyConfig) -> None:
        """Put the layer in front of a rig, which belongs to it from now on and is closed if that fails.

        Raises:
            ConfigError: the soft limits leave nothing of the device's range.
            EmergencyStopError: there is a stop file.
        """
        self._rig = rig
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
            atexit.register(self.close)  # for a rig that nobody closes
            if real_time:
                self._undo_signals = end_politely(self._guard.halt)
                self._watcher = Watcher(self._guard)
        except BaseException:
            self._leave()
            rig.close()
            raise

    def stop(self, reason: str) -> None:
        """Emergency stop: halt the head, and refuse every move until `clear`; from any thread."""
        self._guard.stop(reason)

    def clear(self) -> str | None:
        """End the emergency stop, which only an operator may decide; return its reason.

        Raises:
            EmergencyStopError: there still is a stop file.
        """
        return self._guard.clear()

    @property
    def stopped(self) -> str | None:
        """The reason of the emergency stop; None if there is none."""
        return self._guard.reason

    def close(self) -> None:
        """Halt the head, then close the rig; a signal meanwhile acts only after that.

        Raises:
            Exception: whatever the device raised when it could not be halted, or closed.
        """
        self._close(deliver=True)

    def __enter__(self) -> "SafeRig":
        """Give the rig itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Halt, then close; a failure of that does not hide the error that led here."""
        if error is None:
            self.close()
            return
        log.info("halting the head: %s", kind.__name__ if kind else error)
        try:
            self._close(deliver=isinstance(error, Exception))  # a second Ctrl-C says no more than the first
        except Exception as failure:
            self._tell(failure)

    def _tell(self, failure: BaseException) -> None:
        """Say why the rig could not be closed, unless that was said before."""
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
            except (KeyboardInterrupt, SystemExit) as error:  # just before the signals were held
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
            self._tell(errors[0])  # what ends the program now tells nothing of it
        if deliver and interrupt is not None:
            raise interrupt
        if deliver:
            held.deliver()
        if errors:
            raise next((e for e in errors if not isinstance(e, Exception)), errors[0])

    def _leave(self) -> None:
        """End what this layer has going in the process."""
        if self._watcher is not None:
            self._watcher.close()
            self._guard.close()
        self._undo_signals()
        atexit.unregister(self.close)
