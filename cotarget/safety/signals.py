"""Halt the head and complete files before a signal ends or suspends the process."""

import contextlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from types import FrameType
from typing import Any, Protocol

from cotarget.errors import ConfigError

log = logging.getLogger(__name__)

# Signals that end the process at once: a request, a closed terminal or connection, and Ctrl-\.
ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGQUIT") if hasattr(signal, name))
# Signals that suspend the process with its watchdog: Ctrl-Z, and use of a terminal that another program has.
FREEZING = tuple(getattr(signal, name) for name in ("SIGTSTP", "SIGTTIN", "SIGTTOU") if hasattr(signal, name))
SHELL_STATUS = 128  # a shell's exit status for a signal is this plus its number


class GuardedHead(Protocol):
    """A head that signal handlers halt, see `cotarget.safety.watchdog.Watchdog`."""

    in_main_thread: bool  # whether the main thread opened it, or gave its last command

    def refuse(self, reason: str) -> None:
        """Refuse moves."""

    def stop(self, reason: str) -> None:
        """Halt the head, and refuse moves."""

    def halt(self) -> None:
        """Halt the head; raises as the device does."""

    def held(self) -> contextlib.AbstractContextManager[None]:
        """Let no command begin in the block."""


class _Process:
    """The signal handlers of this process, and the heads that they halt."""

    def __init__(self) -> None:
        self.heads: list[GuardedHead] = []
        self.handled = False  # whether `handle_signals` was called
        self._undo: Callable[[], None] | None = None

    def install(self) -> None:
        """Install the handlers, unless they are installed."""
        if self._undo is None:
            ending = dict.fromkeys((signal.SIGINT, *ENDING), self._end)
            self._undo = _install(ending | dict.fromkeys(FREEZING, self._freeze))

    def remove(self, head: GuardedHead) -> None:
        """Forget a head; remove the handlers after the last one, but for those of `handle_signals`."""
        self.heads = [each for each in self.heads if each is not head]
        if self._undo is not None and not (self.heads or self.handled) and is_main_thread():
            self._undo()
            self._undo = None

    def _end(self, number: int, frame: FrameType | None) -> None:
        """Stop the heads of other threads, whose blocks the exception in the main thread does not leave; raise it.

        Where the program ends for certain, no thread moves any head any more.
        """
        reason = f"{signal.Signals(number).name} ends the program"
        others = [head for head in self.heads if not head.in_main_thread]
        for head in others if number == signal.SIGINT else self.heads:
            head.refuse(reason)  # all first, because a halt may hang
        for head in others:
            head.stop(reason)
        (signal.default_int_handler if number == signal.SIGINT else leave)(number, frame)

    def _freeze(self, number: int, frame: FrameType | None) -> None:
        with contextlib.ExitStack() as held:
            may_suspend = True
            for head in self.heads:  # all first, because a halt may hang
                held.enter_context(head.held())
            for head in self.heads:
                try:
                    head.halt()
                except Exception as error:
                    may_suspend = False
                    log.error("not suspended, because the head could not be halted: %s", error)
            if may_suspend:
                os.kill(os.getpid(), signal.SIGSTOP)


_PROCESS = _Process()


def handle_signals() -> None:
    """Install signal handlers that halt every guarded head before this process ends or is suspended.

    Call it in the main thread of a program that opens rigs in other threads; Python runs signal handlers in the main
    thread alone. A rig that is opened in the main thread does so by itself. Handlers that the program has set stay.

    Raises:
        ConfigError: this is not the main thread.
    """
    if not is_main_thread():
        raise ConfigError("handle_signals() has to be called in the main thread")
    _PROCESS.install()
    _PROCESS.handled = True


def guard_head(head: GuardedHead) -> Callable[[], None]:
    """Have the signal handlers halt a head until the returned function is called.

    A signal that would end the process raises SystemExit in the main thread, so that its ``with`` blocks are left, and
    stops the heads of other threads. One that would suspend it does so after all heads are halted, and not at all if a
    halt fails.

    Raises:
        ConfigError: this is not the main thread, and `handle_signals` was not called there.
    """
    if is_main_thread():
        _PROCESS.install()
    elif not _PROCESS.handled:
        raise ConfigError(
            "a rig in real time has to be opened in the main thread, where signals halt its head; to open it in "
            "another thread, call cotarget.handle_signals() in the main thread first"
        )
    _PROCESS.heads = [*_PROCESS.heads, head]
    return lambda: _PROCESS.remove(head)


def end_politely() -> Callable[[], None]:
    """Let signals that would end or suspend the process raise SystemExit, so that ``with`` blocks are left.

    Returns:
        A function that removes the handlers.
    """
    return _install(dict.fromkeys((*ENDING, *FREEZING), leave)) if is_main_thread() else lambda: None


def is_main_thread() -> bool:
    """Whether this is the main thread, which alone receives signals."""
    return threading.current_thread() is threading.main_thread()


def leave(number: int, frame: FrameType | None) -> None:
    """Raise SystemExit for a signal, with the exit status of a shell."""
    sys.exit(SHELL_STATUS + number)


def _install(handlers: Mapping[int, Callable[[int, FrameType | None], None]]) -> Callable[[], None]:
    """Install signal handlers where the program has set none; return a function that removes them."""
    previous = {number: signal.getsignal(number) for number in handlers}
    ours = [number for number, handler in previous.items() if handler in (signal.SIG_DFL, signal.default_int_handler)]
    for number in ours:
        signal.signal(number, handlers[number])

    def undo() -> None:
        if is_main_thread():
            for number in ours:
                if signal.getsignal(number) == handlers[number]:
                    signal.signal(number, previous[number])

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
        if not is_main_thread():
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
def deferred_signals(*, deliver: bool = True) -> Iterator[None]:
    """Defer SIGINT, SIGTERM and other ending signals in this block, and deliver the first one after it.

    `IMPATIENCE` signals end the block, if for example a pipe takes no more data. ``deliver`` is false where an error
    ends the program anyhow.
    """
    deferred = DeferredSignals()
    deferred.let_hurry()
    try:
        deferred.defer()
        yield
    finally:
        deferred.restore()
    if deliver:
        deferred.deliver()
