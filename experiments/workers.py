"""Who does the jobs of a sweep: processes on this machine, each held to one thread; `experiments.cluster` is another.

What a job gives comes as soon as it is there, with the job's number, in whatever order. Linear algebra, OpenCV and
rendering take as many threads as there are cores, each: with a job for every core they would only get into each other's
way, and sums that threads share come out differently in their last digits.
"""

import concurrent.futures
import contextlib
import itertools
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

import cv2

from cotarget.parallel import end_with_parent

Job = TypeVar("Job")
Results = Generator[tuple[int, Any], None, None]  # numbers of jobs, and what they gave, or `Died`
Engine = Callable[[Callable[[Any], Any], Sequence[Any], int], Results]  # does (work, jobs, so many at a time)

# Read when linear algebra is loaded, when Mesa's software renderer starts, and when a simulated world is opened.
LINEAR_ALGEBRA = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
ONE_THREAD = dict.fromkeys((*LINEAR_ALGEBRA, "LP_NUM_THREADS"), "1") | {"COTARGET_AHEAD": "0"}


class Died:
    """Stands for what a job would have given whose process ended without a word."""


def here(work: Callable[[Job], Any], jobs: Sequence[Job], processes: int = 1) -> Results:
    """Do jobs one after the other in this process, on as many threads as each takes; what each gives, with its number.

    Args:
        work: a function.
        jobs: its arguments, one each.
        processes: is not heeded.
    """
    del processes
    yield from enumerate(map(work, jobs))


def in_processes(work: Callable[[Job], Any], jobs: Sequence[Job], processes: int) -> Results:
    """Do jobs in as many processes of this machine, in their order; what each gives as it comes, with its number.

    A process that dies (out of memory, say) takes nobody else's job along: those that it may have died of are tried
    once more, one at a time. All processes end with this one, however it ends.

    Args:
        work: a function at the top of a module, or a partial one of it.
        jobs: its arguments, one each.
        processes: how many.

    Raises:
        Exception: what a job raised.
    """
    left = dict(enumerate(jobs))
    while left:
        suspects = yield from _pool(work, left, processes)
        for number in suspects:
            alone = {number: left.pop(number)}
            yield from _pool(work, alone, 1)
            if alone:
                yield number, Died


def _pool(
    work: Callable[[Job], Any], left: dict[int, Job], processes: int
) -> Generator[tuple[int, Any], None, list[int]]:
    """Do jobs, which are taken from ``left`` as they are done; those in hand when a process died are returned."""
    context = multiprocessing.get_context("spawn")  # a forked process would share the parent's OpenGL
    waiting = iter(list(left.items()))
    running: dict[concurrent.futures.Future[Any], int] = {}
    with concurrent.futures.ProcessPoolExecutor(min(processes, len(left)), context, _begin) as pool, _ended_early():
        while True:
            try:
                with one_thread_each(), interrupts_kept_from_children():
                    for number, job in itertools.islice(waiting, processes - len(running)):
                        running[pool.submit(work, job)] = number
            except BrokenProcessPool:  # one has died since
                return sorted(running.values())
            if not running:
                break
            done, _ = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
            broken = []
            for future in done:
                try:
                    result = future.result()
                except BrokenProcessPool:
                    broken.append(running[future])
                    continue
                number = running.pop(future)
                del left[number]
                yield number, result
            if broken:
                return sorted(running.values())
    return []


def _begin() -> None:
    """One process begins: gone when the one that started it is, deaf to Ctrl-C, and with one thread for OpenCV."""
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)


@contextlib.contextmanager
def _ended_early() -> Iterator[None]:
    """Whatever ends this before its end ends the processes started meanwhile; nobody waits for what they are at."""
    before = set(multiprocessing.active_children())
    try:
        yield
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
        raise


@contextlib.contextmanager
def one_thread_each() -> Iterator[None]:
    """Processes started meanwhile have one thread."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def interrupts_kept_from_children() -> Iterator[None]:
    """Processes started meanwhile never hear Ctrl-C, which reaches all of them; the one that started them ends them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
