"""Signals: none may keep the head from being halted, and none may end a program with a moving head behind it."""

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

log = logging.getLogger(__name__)

# Signals that would end the process on the spot: a polite request, a terminal or connection that has gone, Ctrl-\.
ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGQUIT") if hasattr(signal, name))
# And those that would freeze it, watchdog and all: Ctrl-Z, and use of a terminal that another program has.
FREEZING = tuple(getattr(signal, name) for name in ("SIGTSTP", "SIGTTIN", "SIGTTOU") if hasattr(signal, name))
HELD = (signal.SIGINT, *ENDING)
SHELL_STATUS = 128  # a shell's exit status for a signal is this and its number
# So many signals, while the devices are released after the halt, end the wait for devices that do not answer.
IMPATIENCE = 3


class HeldSignals:
    """Keeps Ctrl-C and SIGTERM back while the head is halted; they are delivered afterwards.

    Only the main thread gets signals, so elsewhere there is nothing to hold.
    """

    def __init__(self) -> None:
        self.pending: list[int] = []
        self._previous: dict[int, Any] = {}
        self._halted = False

    def hold(self) -> None:
        """From now on note signals; may be called again where a signal cut it short."""
        if threading.current_thread() is not threading.main_thread():
            return
        for number in HELD:
            previous = signal.getsignal(number)
            if number not in self._previous and previous not in (None, signal.SIG_IGN, self._note):
                self._previous[number] = previous
                signal.signal(number, self._note)

    def halted(self) -> None:
        """The head is halted or cannot be; from now on enough signals end the wait for the devices."""
        self._halted = True

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
        if self._halted and len(self.pending) >= IMPATIENCE:
            raise KeyboardInterrupt


def end_politely(halt: Callable[[], None] | None = None) -> Callable[[], None]:
    """Let no signal end or freeze the process with a head that turns.

    One that would end it on the spot raises SystemExit, so that ``with`` blocks are left. One that would freeze it does
    so once the head is halted, and not at all where that fails; afterwards the program goes on as after any halt.
    Handlers that the program itself has set stay.

    Args:
        halt: halts the head, and may be called from a signal's handler; without it the signals that would freeze the
            process end it too.

    Returns:
        What undoes it.
    """
    if threading.current_thread() is not threading.main_thread():
        return lambda: None

    def leave(number: int, frame: FrameType | None) -> None:
        sys.exit(SHELL_STATUS + number)

    def freeze(number: int, frame: FrameType | None) -> None:
        assert halt is not None
        try:
            halt()
        except Exception as error:
            log.error("not suspended, because the head could not be halted: %s", error)
            return
        os.kill(os.getpid(), signal.SIGSTOP)

    handlers = dict.fromkeys(ENDING, leave) | dict.fromkeys(FREEZING, leave if halt is None else freeze)
    ours = {number: handler for number, handler in handlers.items() if signal.getsignal(number) is signal.SIG_DFL}
    for number, handler in ours.items():
        signal.signal(number, handler)

    def undo() -> None:
        if threading.current_thread() is threading.main_thread():
            for number, handler in ours.items():
                if signal.getsignal(number) is handler:
                    signal.signal(number, signal.SIG_DFL)

    return undo
