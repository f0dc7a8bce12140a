"""Handle signals that end or suspend the process, so that the head is halted first."""

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType

from cotarget.files import ENDING

log = logging.getLogger(__name__)

# Signals that suspend the process with its watchdog: Ctrl-Z, and use of a terminal that another program has.
FREEZING = tuple(getattr(signal, name) for name in ("SIGTSTP", "SIGTTIN", "SIGTTOU") if hasattr(signal, name))
SHELL_STATUS = 128  # a shell's exit status for a signal is this plus its number


def end_politely(halt: Callable[[], None] | None = None) -> Callable[[], None]:
    """Install signal handlers that halt the head before the process ends or is suspended.

    A signal that would end the process raises SystemExit, so that ``with`` blocks are left. A signal that would suspend
    it does so once the head is halted, and not at all if the halt fails; resumed, the program goes on as after any
    halt. Handlers that the program has set stay.

    Args:
        halt: halts the head, callable from a signal handler; if None, the suspending signals end the process too.

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
