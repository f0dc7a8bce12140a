"""Run the jobs of a sweep on a Dask cluster: an existing one, or one on this machine."""

import concurrent.futures
import contextlib
import importlib
import importlib.util
import logging
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import cv2

from cotarget.errors import ConfigError, DeviceError
from cotarget.parallel import interrupts_kept_from_children
from experiments.engine.results import differing
from experiments.engine.workers import LINEAR_ALGEBRA, ONE_THREAD, Died, Job, Results, one_thread_each

EXTRA = "cotarget[sweeps]"
ANSWER_S = 10.0  # timeout of the scheduler's answer [s]
# Variables that OpenBLAS reads (the linear algebra of numpy's and scipy's wheels): the first one above zero holds.
HEEDED = ("OPENBLAS_NUM_THREADS", "GOTO_NUM_THREADS", "OMP_NUM_THREADS")
START_SO = "start workers with --nthreads 1 (and --nworkers N)"
WITHOUT_PACKAGES = (
    "does not find the packages cotarget and experiments; start it with PYTHONPATH set to a clone of this repository"
)
SEVERAL_THREADS = "has linear algebra on several threads"
QUIET = logging.CRITICAL + 10  # errors are reported in one line


def on_dask(
    work: Callable[[Job], Any],
    jobs: Sequence[Job],
    processes: int,
    *,
    scheduler: str | None = None,
    version: str = "",
    any_libraries: bool = False,
) -> Results:
    """Run jobs on a Dask cluster in their order; yield each job's number and result as it completes.

    A job whose worker dies is tried on other workers; if they die repeatedly, its result is `Died`. (joblib's Dask
    backend uses the same client, but waits for such a job for ever.)

    Args:
        work: a function at module level that the workers can import, or a partial of one.
        jobs: arguments of the calls, one each.
        processes: number of workers of a cluster on this machine, where no scheduler is given.
        scheduler: address of the scheduler, such as tcp://10.0.0.1:8786.
        version: version of the code that all workers must have, from `code_version`; any if empty.
        any_libraries: whether workers may have other versions of the libraries.

    Raises:
        ConfigError: Dask is missing, no scheduler answers, or a worker is unfit for the work, also one that joins
            later.
        DeviceError: the scheduler is gone.
        Exception: an exception of a job.
    """
    distributed = _needed("distributed")
    with _client(distributed, scheduler, min(processes, len(jobs))) as client:
        where = client.scheduler.address
        _check_workers(client, where, version, any_libraries)
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
                    raise DeviceError(f"the Dask scheduler at {where} is gone") from None
                except ImportError:
                    raise ConfigError(f"a Dask worker that joined {where} {WITHOUT_PACKAGES}") from None
                yield numbers.pop(future), result
        finally:
            client.cancel(list(numbers))  # workers finish the jobs that they have begun, and the results are dropped


def check_cluster(processes: int, scheduler: str | None, version: str, any_libraries: bool) -> None:
    """Refuse a cluster that cannot do the work, before any work starts (see `on_dask`).

    A cluster on this machine has this program's environment and needs no check.

    Raises:
        ConfigError: as for `on_dask`.
    """
    distributed = _needed("distributed")
    if scheduler is not None:
        with _client(distributed, scheduler, processes) as client:
            _check_workers(client, client.scheduler.address, version, any_libraries)


def _needed(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ConfigError(f"a Dask cluster needs {name}, which is not installed: pip install '{EXTRA}'") from None


@contextlib.contextmanager
def _client(distributed: Any, scheduler: str | None, processes: int) -> Iterator[Any]:
    """Open a client of the cluster at an address, or of one on this machine that ends with the client."""
    with contextlib.ExitStack() as stack:
        log = logging.getLogger("distributed.client")
        stack.callback(log.setLevel, log.level)
        log.setLevel(QUIET)
        if scheduler is None:
            with one_thread_each(), interrupts_kept_from_children():
                cluster = distributed.LocalCluster(
                    n_workers=processes,
                    threads_per_worker=1,
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0",
                    silence_logs=QUIET,
                )
            stack.enter_context(cluster)
            yield stack.enter_context(distributed.Client(cluster))
            return
        try:
            client = distributed.Client(scheduler, timeout=ANSWER_S)
        except (OSError, ValueError, TypeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ConfigError(f"no Dask scheduler answers at {scheduler}: {reason}") from None
        yield stack.enter_context(client)


def _check_workers(client: Any, scheduler: str, version: str, any_libraries: bool) -> None:
    """Refuse workers that cannot do the work, or that run more than one job at a time or several threads."""
    threads: dict[str, int] = client.nthreads()
    if not threads:
        raise ConfigError(f"the Dask scheduler at {scheduler} has no workers; start some with dask worker")
    for worker, count in threads.items():
        if count > 1:  # an OpenGL context belongs to one thread
            raise ConfigError(f"the Dask worker at {worker} has {count} threads; {START_SO}")

    def about() -> tuple[str, dict[str, str]]:  # sent by value, because the worker may lack the packages
        told = {name: os.environ.get(name, "") for name in HEEDED}
        if not (importlib.util.find_spec("experiments") and importlib.util.find_spec("cotarget")):
            return "", told
        return str(importlib.import_module("experiments.engine.results").code_version()), told

    for worker, (code, told) in client.run(about).items():
        if not code:
            raise ConfigError(f"the Dask worker at {worker} {WITHOUT_PACKAGES}")
        other = differing(code, version) if version else ""
        if other and not (any_libraries and other == "libraries"):
            keep = ", or keep the difference with --any-code" if other == "libraries" else ""
            raise ConfigError(
                f"the Dask worker at {worker} has cotarget {code}, this is {version}; give both the same {other}{keep}"
            )
        _check_linear_algebra(worker, told)


def _check_linear_algebra(worker: str, environment: Mapping[str, str]) -> None:
    """Refuse a worker whose linear algebra uses several threads.

    Args:
        worker: address of the worker.
        environment: environment variables of the worker.

    Raises:
        ConfigError: the variable that OpenBLAS obeys is not 1, or none is set, so that it uses all cores.
    """
    heeded = next((name for name in HEEDED if _number(environment.get(name, "")) > 0), None)
    if heeded is None:
        raise ConfigError(f"the Dask worker at {worker} {SEVERAL_THREADS}; start it with OMP_NUM_THREADS=1")
    if _number(environment[heeded]) != 1:
        told = f"{heeded}={environment[heeded]}"
        raise ConfigError(f"the Dask worker at {worker} {SEVERAL_THREADS}, by {told}; start it with {heeded}=1")


def _number(text: str) -> int:
    """Parse a variable as OpenBLAS does, by C's atoi: the leading number, else 0."""
    found = re.match(r"\s*[+-]?\d+", text, re.ASCII)
    return int(found[0]) if found else 0


def _held_to_one_thread(work: Callable[[Job], Any], job: Job) -> Any:
    """Run a job on one thread; check the worker first, because it may have joined after the first check.

    Raises:
        ConfigError: the worker is unfit for the work.
    """
    worker: Any = importlib.import_module("distributed").get_worker()
    if worker.state.nthreads > 1:
        raise ConfigError(f"the Dask worker at {worker.address} has {worker.state.nthreads} threads; {START_SO}")
    _check_linear_algebra(worker.address, os.environ)
    for name in ONE_THREAD.keys() - set(LINEAR_ALGEBRA):  # these concern rendering; linear algebra is loaded already
        os.environ.setdefault(name, ONE_THREAD[name])
    cv2.setNumThreads(1)
    return work(job)
