"""What a worker is told to do, and what it answers; imported by every worker, so it imports little."""

import json
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cotarget.errors import CotargetError
from experiments.pictured import parted
from experiments.results import code_version


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
    """What came of a task; `failed` and `traceback` where nothing did. See `experiments.results.Record`."""

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
    began, cpu, drawn = time.perf_counter(), time.process_time(), _drawn()
    result, pictures, failed, where = None, dict[str, bytes](), "", ""
    try:
        result = task.call()
        if task.number is not None:
            rows, seen = parted(result)
            result, pictures = json.loads(json.dumps(rows, default=_scalar)), dict(seen)  # as read from the file
    except Exception as error:
        failed, where = _in_one_line(error), traceback.format_exc()
    took, used = time.perf_counter() - began, time.process_time() - cpu
    return Done(took, used, code_version(), _drawn() - drawn, result, failed, where, pictures)


def _drawn() -> int:
    """How many pictures MuJoCo has drawn in this process, which may have no need of it."""
    opengl = sys.modules.get("cotarget.sim.opengl")
    return 0 if opengl is None else opengl.Canvas.drawn


def _scalar(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a row holds a {type(value).__name__}, which is no number, text or truth value")


def _in_one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if isinstance(error, CotargetError) else f"{type(error).__name__}: {text}".rstrip(": ")
