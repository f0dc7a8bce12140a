"""Run long jobs in separate processes, which end with their parent, and show their progress."""

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from cotarget.errors import CotargetError

Result = TypeVar("Result")
# Called with the amount done, the total (None if it is unknown), and a text.
Progress = Callable[[float, float | None, str], object]
PROGRESS_LINE_S = 30.0  # interval of lines of progress where stderr is not a terminal [s]
ORPHANED = 1  # exit status of a process whose parent has ended
# Parameters of glibc's mallopt: one arena for all threads, and a separate mapping for each block of at least MAPPED
# bytes, whose memory is free when the block is. The demo then needs 470 to 520 MB in place of 570.
M_MMAP_THRESHOLD, M_ARENA_MAX = -3, -8
MAPPED = 262144


@contextlib.contextmanager
def progress_bar(given: Progress | None = None, now: Callable[[], float] = time.monotonic) -> Iterator[Progress]:
    """Show progress as a user wants it; by default on stderr, by a bar on a terminal, otherwise an occasional line."""
    if given is not None or not sys.stderr.isatty():
        yield given or _progress_lines(now)
        return
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), TimeElapsedColumn()
    # Results go to stdout, past the bar.
    with Bar(*columns, console=Console(stderr=True), transient=True, redirect_stdout=False) as bar:
        task = bar.add_task("", total=None)

        def show(done: float, total: float | None, text: str) -> None:
            bar.update(task, description=text, completed=done if total is None else min(done, total), total=total)

        yield show


def _progress_lines(now: Callable[[], float]) -> Progress:
    """Make a function that writes a line half a minute after the one before; short work writes nothing."""
    begin = last = now()

    def show(done: float, total: float | None, text: str) -> None:
        nonlocal last
        if (t := now()) - last < PROGRESS_LINE_S:
            return
        last = t
        with contextlib.suppress(OSError):  # the reader of stderr may be closed; the work goes on
            part = "" if total is None else f"{100 * min(done / max(total, 1), 1):.0f} %, "
            sys.stderr.write(f"{text} ({part}{t - begin:.0f} s)\n")
            sys.stderr.flush()

    return show


def run_apart(job: Callable[..., Result], arguments: tuple[Any, ...], report: Callable[..., object]) -> Result:
    """Run ``job(*arguments, report)`` in a separate process, whose memory is free afterwards.

    Args:
        job: a function at the top level of a module.
        arguments: its arguments; they and the result are pickled.
        report: called in this process with the arguments with which the job calls its ``report``.

    Raises:
        CotargetError: the job raised it, or its process died. Other errors of the job are raised as they are.
    """
    context = multiprocessing.get_context("spawn")  # a forked process would share the parent's OpenGL context
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(job, arguments, theirs), daemon=True)
    try:
        with interrupts_kept_from_children():
            process.start()
        theirs.close()
        while True:
            try:
                kind, value = ours.recv()
            except EOFError:
                process.join()
                raise CotargetError(f"a job ended before it was done (exit status {process.exitcode})") from None
            if kind == "error":
                raise value
            if kind == "done":
                result: Result = value
                return result
            report(*value)
    finally:
        if process.pid is not None:
            process.terminate()
            process.join()
        ours.close()


def _work(job: Callable[..., Any], given: tuple[Any, ...], pipe: Connection) -> None:
    """Run the job in this process; send its progress, and its result or error."""
    end_with_parent()
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(M_ARENA_MAX, 1)
        mallopt(M_MMAP_THRESHOLD, MAPPED)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its jobs itself

    def report(*given: object) -> None:
        pipe.send(("progress", given))

    try:
        pipe.send(("done", job(*given, report)))
    except Exception as error:
        pipe.send(("error", error))


@contextlib.contextmanager
def interrupts_kept_from_children() -> Iterator[None]:
    """Let processes started in this block ignore Ctrl-C, which reaches the whole group; their parent ends them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def end_with_parent() -> None:
    """End this process as soon as its parent has ended."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_after, args=(parent.sentinel,), name="end with parent", daemon=True).start()


def _end_after(parent: int) -> None:
    wait([parent])
    os._exit(ORPHANED)  # without cleaning up, because the job may be in any state
