"""Local processes that do the jobs of a sweep, each held to one thread; see `experiments.engine.cluster` for Dask.

What a job gives comes as soon as it is there, with the job's number, in whatever order. Linear algebra, OpenCV and
rendering take as many threads as there are cores, each: with a job for every core they would only get into each other's
way, and sums that threads share come out differently in their last digits.
"""

import concurrent.futures
import contextlib
import importlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

import cv2

from cotarget.parallel import end_with_parent, interrupts_kept_from_children

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

    A process that dies (out of memory, say) takes nobody else's job along, and another takes its place. All processes
    end with this one, however it ends.

    Args:
        work: a function at the top of a module, or a partial one of it.
        jobs: its arguments, one each.
        processes: how many.

    Raises:
        Exception: what a job raised.
    """
    return _in_pools(work, jobs, processes, _begin, one_thread_each)


def in_turn(work: Callable[[Job], Any], jobs: Sequence[Job], processes: int = 1) -> Results:
    """Do jobs one after the other, as `in_processes` does, on as many threads and processes of its own as each takes.

    Args:
        work: a function at the top of a module, or a partial one of it.
        jobs: its arguments, one each.
        processes: is not heeded.

    Raises:
        Exception: what a job raised.
    """
    del processes
    return _in_pools(work, jobs, 1, _begin_in_turn, contextlib.nullcontext)


def _in_pools(
    work: Callable[[Job], Any],
    jobs: Sequence[Job],
    processes: int,
    begin: Callable[[], None],
    limits: Callable[[], contextlib.AbstractContextManager[None]],
) -> Results:
    """Do jobs in pools of one process each: when one dies it is known which job it had in hand."""
    context = multiprocessing.get_context("spawn")  # a forked process would share the parent's OpenGL
    waiting, running = enumerate(jobs), dict[concurrent.futures.Future[Any], tuple[int, ProcessPoolExecutor]]()
    with contextlib.ExitStack() as pools, _ended_early():

        def opened() -> ProcessPoolExecutor:
            return pools.enter_context(ProcessPoolExecutor(1, context, begin))

        idle = [opened() for _ in range(min(processes, len(jobs)))]
        while True:
            with limits(), interrupts_kept_from_children():
                for pool, (number, job) in zip(idle, waiting, strict=False):
                    try:
                        running[pool.submit(work, job)] = number, pool
                    except BrokenProcessPool:  # it has died since its last job
                        another = opened()
                        running[another.submit(work, job)] = number, another
            if not running:
                return
            idle = []
            for future in concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED).done:
                number, pool = running.pop(future)
                try:
                    result = future.result()
                except BrokenProcessPool:
                    result, pool = Died, opened()
                idle.append(pool)
                yield number, result


def _begin() -> None:
    """One process begins: gone when the one that started it is, deaf to Ctrl-C, and with one thread for OpenCV."""
    _begin_any()
    cv2.setNumThreads(1)


def _begin_in_turn() -> None:
    """As `_begin`, with as many threads as it likes; where it is ended, it ends what it has started itself."""
    _begin_any()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))


def _begin_any() -> None:
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Before any job brings its experiment along; `experiments.engine.results` needs this module.
    importlib.import_module("experiments.engine.results").code_version()


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
