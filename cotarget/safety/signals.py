"""Halt the head and complete files before a signal ends or suspends the process."""

import contextlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

log = logging.getLogger(__name__)

# Signals that end the process at once: a request, a closed terminal or connection, and Ctrl-\.
ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGQUIT") if hasattr(signal, name))
# Signals that suspend the process with its watchdog: Ctrl-Z, and use of a terminal that another program has.
FREEZING = tuple(getattr(signal, name) for name in ("SIGTSTP", "SIGTTIN", "SIGTTOU") if hasattr(signal, name))
SHELL_STATUS = 128  # a shell's exit status for a signal is this plus its number


def end_politely(halt: Callable[[], None] | None = None) -> Callable[[], None]:
    """Install signal handlers that halt the head before the process ends or is suspended.

    A signal that would end the process raises SystemExit, so that ``with`` blocks are left. One that would suspend it
    does so after the head is halted, and not at all if the halt fails. Handlers that the program has set stay.

    Args:
        halt: halts the head, callable from a signal handler; if None, suspending signals end the process too.

    Returns:
        A function that removes the handlers.
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


IMPATIENCE = 3  # number of signals that end even a critical section that waits for a device or disk, once allowed


class DeferredSignals:
    """Defer SIGINT, SIGTERM and other ending signals during a critical section, and deliver them after it.

    Only the main thread receives signals, so in other threads there is nothing to defer.
    """

    def __init__(self) -> None:
        self.pending: list[int] = []
        self._previous: dict[int, Any] = {}
        self._may_hurry = False

    def defer(self) -> None:
        """Start to defer signals; may be called again if a signal interrupted it."""
        if threading.current_thread() is not threading.main_thread():
            return
        for number in (signal.SIGINT, *ENDING):
            previous = signal.getsignal(number)
            if number not in self._previous and previous not in (None, signal.SIG_IGN, self._note):
                self._previous[number] = previous
                signal.signal(number, self._note)

    def let_hurry(self) -> None:
        """From now on let `IMPATIENCE` signals end the critical section, for example after the head was halted."""
        self._may_hurry = True

    def restore(self) -> None:
        """Restore the previous handlers."""
        while self._previous:
            number, previous = self._previous.popitem()
            if signal.getsignal(number) == self._note:
                signal.signal(number, previous)

    def deliver(self) -> None:
        """Raise the first deferred signal, if there was one."""
        if self.pending:
            signal.raise_signal(self.pending[0])

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.pending.append(number)
        if self._may_hurry and len(self.pending) >= IMPATIENCE:
            raise KeyboardInterrupt


@contextlib.contextmanager
def deferred_signals() -> Iterator[None]:
    """Defer SIGINT, SIGTERM and other ending signals in this block, and deliver the first one after it.

    `IMPATIENCE` signals end the block, if for example a pipe takes no more data.
    """
    deferred = DeferredSignals()
    deferred.let_hurry()
    try:
        deferred.defer()
        yield
    finally:
        deferred.restore()
    deferred.deliver()
