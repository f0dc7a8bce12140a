"""Signals: none may keep the head from being halted, and none may end a program with a moving head behind it."""

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType

from cotarget.files import ENDING

log = logging.getLogger(__name__)

# Signals that would freeze the process, watchdog and all: Ctrl-Z, and use of a terminal that another program has.
FREEZING = tuple(getattr(signal, name) for name in ("SIGTSTP", "SIGTTIN", "SIGTTOU") if hasattr(signal, name))
SHELL_STATUS = 128  # a shell's exit status for a signal is this and its number


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
