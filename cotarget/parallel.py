"""Runs a few long jobs side by side, each in a process of its own, because an OpenGL context belongs to one thread."""

import multiprocessing
import signal
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from cotarget.errors import CotargetError

Result = TypeVar("Result")
Report = Callable[[int, int], None]


def run_side_by_side(
    job: Callable[..., Result],
    arguments: Sequence[tuple[Any, ...]],
    report: Report,
) -> list[Result]:
    """Run ``job(*arguments[i], report)`` for every i at the same time.

    Args:
        job: a function at the top of a module; its last argument is a function to tell (done, of how much).
        arguments: of each run; they and the results are pickled.
        report: told (done, of how much) over all jobs.

    Returns:
        The results, in the order of the arguments.

    Raises:
        CotargetError: whatever a job raised, or a job that died; the others are ended then.
    """
    context = multiprocessing.get_context("spawn")  # a forked process would share the parent's OpenGL
    processes, pipes = [], []
    results: dict[int, Result] = {}
    progress = dict.fromkeys(range(len(arguments)), (0, 1))
    try:
        for given in arguments:
            ours, theirs = context.Pipe(duplex=False)
            process = context.Process(target=_work, args=(job, given, theirs), daemon=True)
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
    """One process: run the job, send its progress and its result."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its jobs itself

    def report(done: int, total: int) -> None:
        pipe.send(("progress", (done, total)))

    try:
        pipe.send(("done", job(*given, report)))
    except Exception as error:
        pipe.send(("error", error))
