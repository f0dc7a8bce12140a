"""Local processes that run the jobs of a sweep, with one thread each (`experiments.engine.cluster` uses Dask).

An engine yields each job's number and result as it completes, in any order. Linear algebra, OpenCV and rendering each
use one thread, because with a job per core more threads slow each other down, and sums over threads vary in their last
digits.
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
Results = Generator[tuple[int, Any], None, None]  # numbers and results of jobs; `Died` for a dead process
Engine = Callable[[Callable[[Any], Any], Sequence[Any], int], Results]  # called with (work, jobs, number of processes)
# Read when linear algebra is loaded, when Mesa's software renderer starts, and when a simulated world is opened.
LINEAR_ALGEBRA = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
ONE_THREAD = dict.fromkeys((*LINEAR_ALGEBRA, "LP_NUM_THREADS"), "1") | {"COTARGET_AHEAD": "0"}


class Died:
    """Result of a job whose process died without an exception."""


def here(work: Callable[[Job], Any], jobs: Sequence[Job], processes: int = 1) -> Results:
    """Run jobs one after the other in this process, with as many threads as each uses; yield number and result.

    Args:
        work: function of a job.
        jobs: arguments of the calls, one each.
        processes: ignored.
    """
    del processes
    yield from enumerate(map(work, jobs))


def in_processes(work: Callable[[Job], Any], jobs: Sequence[Job], processes: int) -> Results:
    """Run jobs in several processes of this machine, in their order; yield number and result as each completes.

    A process that dies (out of memory, for example) loses its own job only, and another process replaces it. All
    processes end with this one, however it ends.

    Args:
        work: a function at module level, or a partial of one.
        jobs: arguments of the calls, one each.
        processes: number of processes.

    Raises:
        Exception: an exception of a job.
    """
    return _in_pools(work, jobs, processes, _begin, one_thread_each)


def in_turn(work: Callable[[Job], Any], jobs: Sequence[Job], processes: int = 1) -> Results:
    """Run jobs one after the other in another process, which may use any number of threads and child processes.

    Args:
        work: a function at module level, or a partial of one.
        jobs: arguments of the calls, one each.
        processes: ignored.

    Raises:
        Exception: an exception of a job.
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
    """Run jobs in pools of one process each, so that a dead process identifies its job."""
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
                    except BrokenProcessPool:  # the process died after its last job
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
    """Set up a worker: it ends with its parent, ignores Ctrl-C, and has one thread for OpenCV."""
    _begin_any()
    cv2.setNumThreads(1)


def _begin_in_turn() -> None:
    """Set up a worker as `_begin` does, with any number of threads; SIGTERM ends its child processes too."""
    _begin_any()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))


def _begin_any() -> None:
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Before a job loads its experiment; imported late because `experiments.engine.results` needs this module.
    importlib.import_module("experiments.engine.results").code_version()


@contextlib.contextmanager
def _ended_early() -> Iterator[None]:
    """Terminate the processes started inside the block if it ends by an exception."""
    before = set(multiprocessing.active_children())
    try:
        yield
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
        raise


@contextlib.contextmanager
def one_thread_each() -> Iterator[None]:
    """Set the environment so that processes started inside the block use one thread."""
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
