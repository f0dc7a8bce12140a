"""Task and result of a worker; every worker imports this module, so it imports little."""

import contextlib
import functools
import json
import os
import resource
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from experiments.engine.pictured import parted
from experiments.engine.results import code_version, fingerprint
from experiments.engine.texts import in_one_line

TALLY = "COTARGET_TALLY"  # copy of the name in `cotarget.sim.render.opengl`, which many tasks do not load


@dataclass(frozen=True)
class Task:
    """Work for a worker.

    Attributes:
        case: index of the case.
        number: number of the job; None for the preparation of what the case's jobs share.
        call: gives the rows, or the shared object.
    """

    case: int
    number: int | None
    call: Callable[[], Any]


@dataclass(frozen=True)
class Done:
    """Result of a task; the fields are those of `experiments.engine.results.Record`.

    ``failed`` and ``traceback`` are set if the task failed.
    """

    seconds: float
    cpu_s: float
    version: str
    renders: int = 0
    result: Any = None
    failed: str = ""
    traceback: str = ""
    pictures: Mapping[str, bytes] = field(default_factory=dict)


def perform(task: Task) -> Done:
    """Run a task; an exception is reported in the result and not raised."""
    version = code_version()
    began, cpu_s, drawn = time.perf_counter(), _cpu_s(), _drawn()
    result, pictures, failed, where = None, dict[str, bytes](), "", ""
    with _tallied() as tally:
        try:
            result = task.call()
            if task.number is not None:
                rows, seen = parted(result)
                result, pictures = json.loads(json.dumps(rows, default=_scalar)), dict(seen)  # as read from a file
        except Exception as error:
            failed, where = in_one_line(error), traceback.format_exc()
        renders = max(round(_drawn() - drawn), tally())
    took, used = time.perf_counter() - began, _cpu_s() - cpu_s
    if (now := _fingerprint_with(len(sys.modules))) != version:  # the code was changed between two imports
        version = f"{version} and {now}"
    return Done(took, used, version, renders, result, failed, where, pictures)


@functools.cache
def _fingerprint_with(modules: int) -> str:
    """Give the fingerprint, computed again only when more modules are loaded than at the last call."""
    return fingerprint()


def _cpu_s() -> float:
    """Give the processor time of this process and of child processes that it has waited for [s]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


@contextlib.contextmanager
def _tallied() -> Iterator[Callable[[], int]]:
    """Count the pictures drawn inside the block by this process and its children; zero outside the main thread."""
    if threading.current_thread() is not threading.main_thread():  # other threads share the environment
        yield lambda: 0
        return
    with tempfile.NamedTemporaryFile(prefix="cotarget-tally-") as file:
        os.environ[TALLY] = file.name
        try:
            yield lambda: os.fstat(file.fileno()).st_size
        finally:
            del os.environ[TALLY]


def _drawn() -> float:
    """Give the number of pictures that MuJoCo has drawn in this process; zero where MuJoCo is not loaded."""
    opengl = sys.modules.get("cotarget.sim.render.opengl")
    return 0 if opengl is None else opengl.Canvas.drawn


def _scalar(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a row holds a {type(value).__name__}, which is no number, text or truth value")
