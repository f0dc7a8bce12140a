"""Signals that would end the program, held back while what must not stay half done is done: a halt, a file's end."""

import signal
import threading
from types import FrameType
from typing import Any

# Signals that would end the process on the spot: a polite request, a terminal or connection that has gone, Ctrl-\.
ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGQUIT") if hasattr(signal, name))
HELD = (signal.SIGINT, *ENDING)
# So many signals end even that, once they are let: a wait for devices or disks that do not answer.
IMPATIENCE = 3


class HeldSignals:
    """Keeps Ctrl-C and SIGTERM back; they are delivered afterwards.

    Only the main thread gets signals, so elsewhere there is nothing to hold.
    """

    def __init__(self) -> None:
        self.pending: list[int] = []
        self._previous: dict[int, Any] = {}
        self._may_hurry = False

    def hold(self) -> None:
        """From now on note signals; may be called again where a signal cut it short."""
        if threading.current_thread() is not threading.main_thread():
            return
        for number in HELD:
            previous = signal.getsignal(number)
            if number not in self._previous and previous not in (None, signal.SIG_IGN, self._note):
                self._previous[number] = previous
                signal.signal(number, self._note)

    def let_hurry(self) -> None:
        """From now on enough signals end the wait, as after the head's halt."""
        self._may_hurry = True

    def restore(self) -> None:
        """Put the former handlers back."""
        while self._previous:
            number, previous = self._previous.popitem()
            if signal.getsignal(number) == self._note:
                signal.signal(number, previous)

    def deliver(self) -> None:
        """Let the signal act that was held back, if there was one."""
        if self.pending:
            signal.raise_signal(self.pending[0])

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.pending.append(number)
        if self._may_hurry and len(self.pending) >= IMPATIENCE:
            raise KeyboardInterrupt
