"""What a worker is told to do, and what it answers; imported by every worker, so it imports little."""

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

TALLY = "COTARGET_TALLY"  # of `cotarget.sim.render.opengl`, which many tasks have no need of


@dataclass(frozen=True)
class Task:
    """Something for a worker to do.

    Attributes:
        case: number of the case.
        number: of the job; None for what the case's jobs share.
        call: gives the rows, or what they share.
    """

    case: int
    number: int | None
    call: Callable[[], Any]


@dataclass(frozen=True)
class Done:
    """What came of a task; `failed` and `traceback` where nothing did. See `experiments.engine.results.Record`."""

    seconds: float
    cpu_s: float
    version: str
    renders: int = 0
    result: Any = None
    failed: str = ""
    traceback: str = ""
    pictures: Mapping[str, bytes] = field(default_factory=dict)


def perform(task: Task) -> Done:
    """Do a task; whatever goes wrong is told, not raised."""
    version = code_version()
    began, cpu_s, drawn = time.perf_counter(), _cpu_s(), _drawn()
    result, pictures, failed, where = None, dict[str, bytes](), "", ""
    with _tallied() as tally:
        try:
            result = task.call()
            if task.number is not None:
                rows, seen = parted(result)
                result, pictures = json.loads(json.dumps(rows, default=_scalar)), dict(seen)  # as read from the file
        except Exception as error:
            failed, where = in_one_line(error), traceback.format_exc()
        renders = max(round(_drawn() - drawn), tally())
    took, used = time.perf_counter() - began, _cpu_s() - cpu_s
    if (now := _fingerprint_with(len(sys.modules))) != version:  # what was loaded last is not what was loaded first
        version = f"{version} and {now}"
    return Done(took, used, version, renders, result, failed, where, pictures)


@functools.cache
def _fingerprint_with(modules: int) -> str:
    """The fingerprint when so many modules were loaded first: it need not be looked at again until there are more."""
    return fingerprint()


def _cpu_s() -> float:
    """Processor time of this process, and of those that it has started and waited for [s]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


@contextlib.contextmanager
def _tallied() -> Iterator[Callable[[], int]]:
    """How many pictures this process and those that it starts meanwhile have drawn since; none where it cannot tell."""
    if threading.current_thread() is not threading.main_thread():  # the environment is not this thread's alone
        yield lambda: 0
        return
    with tempfile.NamedTemporaryFile(prefix="cotarget-tally-") as file:
        os.environ[TALLY] = file.name
        try:
            yield lambda: os.fstat(file.fileno()).st_size
        finally:
            del os.environ[TALLY]


def _drawn() -> float:
    """How many pictures MuJoCo has drawn in this process, which may have no need of it."""
    opengl = sys.modules.get("cotarget.sim.render.opengl")
    return 0 if opengl is None else opengl.Canvas.drawn


def _scalar(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a row holds a {type(value).__name__}, which is no number, text or truth value")
