"""The thread that watches over a rig in real time, also while the program hangs."""

import logging
import threading

from cotarget.safety.guard import Guard

log = logging.getLogger(__name__)

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
