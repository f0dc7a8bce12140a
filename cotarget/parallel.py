"""Run a few long jobs side by side, each in its own process, because an OpenGL context belongs to one thread."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from cotarget.errors import CotargetError

Result = TypeVar("Result")
Report = Callable[[int, int], None]
ORPHANED = 1  # exit status of a process whose parent has ended


def run_side_by_side(
    job: Callable[..., Result],
    arguments: Sequence[tuple[Any, ...]],
    report: Report,
) -> list[Result]:
    """Run ``job(*arguments[i], report)`` for every i at the same time.

    Args:
        job: a function at the top level of a module; it reports its progress by report(done, total).
        arguments: arguments of each run; they and the results are pickled.
        report: called with (done, total) over all jobs.

    Returns:
        The results, in the order of the arguments.

    Raises:
        CotargetError: a job raised it, or a job's process died; the other jobs are ended. Other errors of a job are
            raised as they are.
    """
    context = multiprocessing.get_context("spawn")  # a forked process would share the parent's OpenGL context
    processes, pipes = [], []
    results: dict[int, Result] = {}
    progress = dict.fromkeys(range(len(arguments)), (0, 1))
    try:
        for given in arguments:
            ours, theirs = context.Pipe(duplex=False)
            process = context.Process(target=_work, args=(job, given, theirs), daemon=True)
            with interrupts_kept_from_children():
                process.start()
            theirs.close()
            processes.append(process)
            pipes.append(ours)
        while len(results) < len(arguments):
            for pipe in wait([p for i, p in enumerate(pipes) if i not in results]):
                index = pipes.index(pipe)  # type: ignore[arg-type]
                try:
                    kind, value = pipes[index].recv()
                except EOFError:
                    processes[index].join()
                    status = processes[index].exitcode
                    raise CotargetError(f"a job ended before it was done (exit status {status})") from None
                if kind == "error":
                    raise value
                if kind == "done":
                    results[index] = value
                else:
                    progress[index] = value
                    report(sum(p[0] for p in progress.values()), sum(p[1] for p in progress.values()))
    finally:
        for process in processes:
            process.terminate()
            process.join()
    return [results[i] for i in range(len(arguments))]


def _work(job: Callable[..., Any], given: tuple[Any, ...], pipe: Connection) -> None:
    """Run the job in this process; send its progress and its result."""
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its jobs itself

    def report(done: int, total: int) -> None:
        pipe.send(("progress", (done, total)))

    try:
        pipe.send(("done", job(*given, report)))
    except Exception as error:
        pipe.send(("error", error))


@contextlib.contextmanager
def interrupts_kept_from_children() -> Iterator[None]:
    """Let processes started in this block ignore Ctrl-C, which reaches all of them; their parent ends them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def end_with_parent(*then: Callable[[], Any]) -> None:
    """End this process as soon as its parent has ended in any way; call it first.

    Args:
        then: functions to call after that, for process pools that take only one initializer.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_after, args=(parent.sentinel,), name="end with parent", daemon=True).start()
    for each in then:
        each()


def _end_after(parent: int) -> None:
    wait([parent])
    os._exit(ORPHANED)  # without cleaning up, because the job may be in any state
