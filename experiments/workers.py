"""Who does the jobs of a sweep: processes on this machine, each held to one thread, or the workers of a Dask cluster.

Either way what a job gives comes as soon as it is there, with the job's number, in whatever order. Linear algebra,
OpenCV and rendering take as many threads as there are cores, each: with a job for every core they would only get into
each other's way, and sums that threads share come out differently in their last digits.
"""

import concurrent.futures
import contextlib
import importlib
import importlib.util
import itertools
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from typing import Any, TypeVar

import cv2

from cotarget.errors import ConfigError, DeviceError

Job = TypeVar("Job")
Results = Generator[tuple[int, Any], None, None]  # numbers of jobs, and what they gave, or `Died`

# Read when linear algebra is loaded, when Mesa's software renderer starts, and when a simulated world is opened.
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "LP_NUM_THREADS": "1",
    "COTARGET_AHEAD": "0",
}
EXTRA = "cotarget[sweeps]"
ANSWER_S = 10.0  # for a scheduler to answer [s]


class Died:
    """Stands for what a job would have given whose process ended without a word."""


# ---------------------------------------------------------------- processes on this machine


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
    theirs, ours = context.Pipe(duplex=False)
    waiting = iter(list(left.items()))
    running: dict[concurrent.futures.Future[Any], int] = {}
    with (
        theirs,
        concurrent.futures.ProcessPoolExecutor(min(processes, len(left)), context, _begin, (theirs,)) as pool,
        ours,  # closed first: where jobs are still running then, their processes end at once
    ):
        while True:
            with _one_thread_each(), _interrupts_kept_from_children():
                for number, job in itertools.islice(waiting, processes - len(running)):
                    running[pool.submit(work, job)] = number
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
        pool.shutdown()  # before the pipe is closed, so that they end in good order
    return []


def _begin(alive: Connection) -> None:
    """One process begins: one thread for OpenCV, deaf to Ctrl-C, and gone when the one that started it is."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    threading.Thread(target=_end_with, args=(alive,), daemon=True).start()


def _end_with(alive: Connection) -> None:
    alive.poll(None)  # nothing is ever sent: it returns when nobody is left who could
    os._exit(1)


@contextlib.contextmanager
def _one_thread_each() -> Iterator[None]:
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
def _interrupts_kept_from_children() -> Iterator[None]:
    """Processes started meanwhile never hear Ctrl-C, which reaches all of them; the one that started them ends them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


# ---------------------------------------------------------------- a Dask cluster


def on_dask(work: Callable[[Job], Any], jobs: Sequence[Job], scheduler: str) -> Results:
    """Do jobs on a Dask cluster, begun in their order; what each gives as it comes, with its number.

    A job whose worker dies is tried by others; whose workers die again and again, that is what came of it.

    Args:
        work: a function at the top of a module that the cluster's workers find too, or a partial one of it.
        jobs: its arguments, one each.
        scheduler: its address, such as tcp://10.0.0.1:8786.

    Raises:
        ConfigError: Dask is missing, nobody answers there, or the workers are not fit for the work.
        DeviceError: the scheduler is gone.
        Exception: what a job raised.
    """
    distributed = _needed("distributed")
    try:
        client = distributed.Client(scheduler, timeout=ANSWER_S)
    except (OSError, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigError(f"no Dask scheduler answers at {scheduler}: {reason}") from None
    with client:
        _check_workers(client, scheduler)
        numbers = {
            client.submit(_held_to_one_thread, work, job, pure=False, priority=-number): number
            for number, job in enumerate(jobs)
        }
        try:
            for future in distributed.as_completed(list(numbers)):
                try:
                    result = future.result()
                except distributed.KilledWorker:
                    result = Died
                except concurrent.futures.CancelledError:
                    raise DeviceError(f"the Dask scheduler at {scheduler} is gone") from None
                yield numbers.pop(future), result
        finally:
            client.cancel(list(numbers))  # those that a worker has in hand it still finishes, for nobody


def _needed(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ConfigError(f"a Dask cluster needs {name}, which is not installed: pip install '{EXTRA}'") from None


def _check_workers(client: Any, scheduler: str) -> None:
    """Refuse workers that could not do the work, or not one job at a time each."""
    threads: dict[str, int] = client.nthreads()
    if not threads:
        raise ConfigError(f"the Dask scheduler at {scheduler} has no workers; start some with dask worker")
    for worker, count in threads.items():
        if count > 1:  # an OpenGL context belongs to one thread
            raise ConfigError(
                f"the Dask worker at {worker} has {count} threads; start workers with --nthreads 1 (and --nworkers N)"
            )
    found = client.run(lambda: bool(importlib.util.find_spec("experiments") and importlib.util.find_spec("cotarget")))
    for worker, finds in found.items():
        if not finds:
            raise ConfigError(
                f"the Dask worker at {worker} does not find the packages cotarget and experiments; start it with "
                "PYTHONPATH set to a clone of this repository"
            )


def _held_to_one_thread(work: Callable[[Job], Any], job: Job) -> Any:
    for name, value in ONE_THREAD.items():
        os.environ.setdefault(name, value)  # linear algebra is loaded already; Dask itself holds it to one thread
    cv2.setNumThreads(1)
    return work(job)
