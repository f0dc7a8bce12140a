"""Run the seeds of experiments on Dask, and keep their rows as CSV.

An experiment is a module in a folder of `experiments/`, or in `benchmarks/`, that defines SETTINGS, a `Settings`, and
`one(settings, seed)`, the rows of a seed. Rows are flat dictionaries of numbers, texts and truth values that depend on
settings and seed alone. `Experiment` lists what else the module may define. Its name is the file's.

    DIR/NAME/settings.json    experiment and settings
    DIR/NAME/rows/000007.csv  rows of one seed, which is not run again while this file is there
    DIR/NAME/seeds.csv        each run of a seed: times, images, code, machine, and why it failed
    DIR/NAME/000007.txt       traceback of a seed that failed
"""

import contextlib
import csv
import dataclasses
import functools
import hashlib
import importlib
import io
import json
import logging
import multiprocessing
import os
import platform
import re
import resource
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from annotated_types import Ge

from cotarget.errors import ConfigError, CotargetError, install_extra
from cotarget.files import assets_dir, write_atomically
from cotarget.parallel import end_with_parent, interrupts_kept_from_children
from experiments.tables import Row as Row
from experiments.tables import spread_columns

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROOT = Path(__file__).parents[1]
FOLDERS = ("experiments/calibration", "experiments/wire", "experiments/following", "experiments/paper", "benchmarks")
PACKAGES = ("numpy", "scipy", "mujoco", "opencv-python-headless", "matplotlib", "gymnasium", "av")
# Linear algebra and Mesa's renderer read these when they start.
LINEAR_ALGEBRA = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
ONE_THREAD = dict.fromkeys((*LINEAR_ALGEBRA, "LP_NUM_THREADS"), "1")
TALLY = "COTARGET_TALLY"  # file to which each rendered image adds a byte; see `cotarget.sim.render.opengl`
SHARED = "COTARGET_SHARED"  # folder of what the local workers of a run share; see `experiments.following.own_rig`
ANSWER_S = 10.0  # timeout of the scheduler's answer [s]
QUIET = logging.CRITICAL + 10  # Dask's log is silent, because each failure is reported in one line
DIED = "its process died; is there memory enough?"

Count = Annotated[int, Ge(1)]


@dataclass(frozen=True)
class Settings:
    """Settings of an experiment: the number of seeds, and the first one."""

    seeds: Count = 100
    seed_base: Annotated[int, Ge(0)] = 0

    @property
    def numbers(self) -> Sequence[int]:
        """The seeds."""
        return range(self.seed_base, self.seed_base + self.seeds)


@dataclass(frozen=True)
class Pictured:
    """Rows of a seed with pictures for the report, PNGs by name, from which no figure is made."""

    rows: list[Row]
    pictures: Mapping[str, bytes]


def pictured(given: list[Row] | Pictured) -> Pictured:
    """Give what `one` returned with its pictures, if any."""
    return given if isinstance(given, Pictured) else Pictured(given, {})


@dataclass(frozen=True)
class Experiment:
    """An experiment, from the names that its module defines.

    Attributes:
        name: name of the module's file.
        purpose: first line of the module's docstring.
        settings: SETTINGS, of the reported run.
        quick: QUICK, settings of the quick run; two seeds by default.
        one: `one(settings, seed)` gives the rows of a seed, in any process.
        summarise: `summarise(rows)` gives the figures, nested by name; by default median, least and largest of each
            column of numbers.
        missed: `missed(summary)` lists the figures that miss their goal; the command then fails.
        bounded: `bounded(summary)` gives the figures as the file of bounds names them.
        describe: `describe(settings, summary)` formats the figures; by default as tables.
        plot: `plot(rows, figure)` draws the rows; its docstring is the caption.
        jobs: `jobs(settings)` gives the numbers for `one`, where these are not the seeds.
        needs: `needs(settings)` says what is lacking, such as data; empty if nothing.
        alone: ALONE, whether times are measured, so that nothing else may run.
        cost_s: COST_S, approximate time of one seed [s]; the longest begin first.
    """

    name: str
    purpose: str
    settings: Any
    quick: Any
    one: Callable[[Any, int], list[Row] | Pictured]
    summarise: Callable[[Sequence[Row]], Mapping[str, Any]]
    missed: Callable[[Mapping[str, Any]], Sequence[str]] | None = None
    bounded: Callable[[Mapping[str, Any]], Mapping[str, Any]] = lambda summary: summary
    describe: Callable[[Any, Mapping[str, Any]], str] | None = None
    plot: "Callable[[Sequence[Row], Figure], None] | None" = None
    jobs: Callable[[Any], Sequence[int]] = lambda settings: settings.numbers
    needs: Callable[[Any], str] = lambda settings: ""
    alone: bool = False
    cost_s: float = 1.0


FUNCTIONS = ("one", "summarise", "missed", "bounded", "describe", "plot", "jobs", "needs")
CONSTANTS = ("SETTINGS", "QUICK", "ALONE", "COST_S")
Known = Mapping[str, Callable[[], Experiment]]


def experiment_of(module: ModuleType) -> Experiment:
    """Make an experiment of a module.

    Raises:
        TypeError: SETTINGS are no settings, or there is no `one`.
    """
    found = vars(module)
    if not isinstance(found["SETTINGS"], Settings):
        raise TypeError(f"SETTINGS are of a subclass of Settings, not {found['SETTINGS']!r}")
    if "one" not in found:
        raise TypeError("it has no function one(settings, seed)")
    parts = {name: found[name] for name in FUNCTIONS if name in found}
    parts |= {name.lower(): found[name] for name in CONSTANTS if name in found}
    parts.setdefault("quick", dataclasses.replace(parts["settings"], seeds=min(parts["settings"].seeds, 2)))
    parts.setdefault("summarise", spread_columns)
    return Experiment(module.__name__.rpartition(".")[2], (module.__doc__ or "").partition("\n")[0], **parts)


def known_experiments() -> Known:
    """Find all experiments by name: the modules that set SETTINGS; each is loaded when its function is called."""
    paths = [path for folder in FOLDERS for path in sorted((ROOT / folder).glob("*.py"))]
    return {
        path.stem: functools.partial(_load, ".".join(path.relative_to(ROOT).with_suffix("").parts))
        for path in paths
        if re.search(r"^SETTINGS\b.* = ", path.read_text(encoding="utf-8"), re.MULTILINE)
    }


def _load(module: str) -> Experiment:
    """Import an experiment.

    Raises:
        ConfigError: the module cannot be imported, or is no experiment.
    """
    file = f"{module.replace('.', '/')}.py"
    try:
        return experiment_of(importlib.import_module(module))
    except Exception as error:
        text = " ".join(str(error).split())
        raise ConfigError(f"{file}: is no experiment: {type(error).__name__}: {text}") from error


@dataclass(frozen=True)
class Case:
    """Experiment with given settings."""

    experiment: Experiment  # the experiment
    settings: Any  # its settings
    folder: Path  # folder of its results
    changes: tuple[str, ...] = ()  # changed settings, as typed
    quick: bool = False  # whether it is a quick run, which is too short for the experiment's goals

    @property
    def title(self) -> str:
        """Name of the experiment with its changed settings."""
        return ", ".join([self.experiment.name, *self.changes])

    @property
    def numbers(self) -> Sequence[int]:
        """Numbers that the experiment is run with, usually its seeds."""
        return self.experiment.jobs(self.settings)


# Rows on disk


@dataclass(frozen=True)
class Done:
    """Result of one seed, with what it took."""

    rows: Sequence[Row] = ()
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    seconds: float = 0.0
    cpu_s: float = 0.0
    renders: int = 0
    version: str = ""
    host: str = ""
    failed: str = ""
    traceback: str = ""


LOGGED = ("seconds", "cpu_s", "renders", "version", "host", "failed")  # columns of seeds.csv besides the seed


def identity(case: Case) -> bytes:
    """Give the experiment and the settings that its rows depend on, as settings.json has them."""
    settings = {key: value for key, value in dataclasses.asdict(case.settings).items() if key != "seeds"}
    found = {"experiment": case.experiment.name, "settings": settings}
    return (json.dumps(found, indent=2, default=str) + "\n").encode()


def missing(case: Case, mine: str = "") -> list[int]:
    """Give the numbers that have no rows; earlier rows must be of this version of the code, if one is given.

    Raises:
        ConfigError: the folder has rows of other settings or of other code.
    """
    path = case.folder / "settings.json"
    if path.exists() and path.read_bytes() != identity(case):
        raise ConfigError(
            f"{path}: is of other settings; ask as before (--quick, --seed-base, --set), take another folder with "
            "--out, or start over with --fresh"
        )
    for other in {row["version"] for row in log_of(case).values()} - {mine} if mine else ():
        raise ConfigError(
            f"{case.folder}: is of cotarget {other}, this is {mine}; take another folder with --out, start over with "
            "--fresh, or keep it with --any-code"
        )
    return [number for number in case.numbers if not rows_file(case, number).exists()]


def rows_file(case: Case, number: int) -> Path:
    """Name the file of a seed's rows."""
    return case.folder / "rows" / f"{number:06d}.csv"


def log_of(case: Case) -> dict[int, Row]:
    """Read the last run of each seed from seeds.csv."""
    path, wanted = case.folder / "seeds.csv", set(case.numbers)
    return {row["seed"]: row for row in (read_rows(path) if path.exists() else ()) if row["seed"] in wanted}


def keep(case: Case, number: int, done: Done) -> None:
    """Write the result of a seed; its rows appear in one step.

    Raises:
        ConfigError: a file cannot be written.
    """
    (case.folder / "rows").mkdir(parents=True, exist_ok=True)
    if not (case.folder / "settings.json").exists():
        write_atomically(case.folder / "settings.json", identity(case))
    error, log = case.folder / f"{number:06d}.txt", case.folder / "seeds.csv"
    line = csv_of([{"seed": number} | {key: getattr(done, key) for key in LOGGED}])
    with log.open("ab") as file:  # in one write, so that a killed run leaves no part of a line
        file.write(line if file.tell() == 0 else line.partition(b"\r\n")[2])
    if done.failed:
        write_atomically(error, done.traceback.encode())
        return
    error.unlink(missing_ok=True)
    for name, png in done.pictures.items():
        write_atomically(case.folder / f"{name}.png", png)
    write_atomically(rows_file(case, number), csv_of(done.rows))  # last: a seed that has rows is in the log


def forget(case: Case) -> None:
    """Delete a case's results."""
    for pattern in ("settings.json", "seeds.csv", "rows/[0-9]*.csv", "[0-9]*.txt"):
        for path in case.folder.glob(pattern):
            path.unlink()


def csv_of(rows: Iterable[Row]) -> bytes:
    """Format rows as CSV, from which `read_rows` gives the same values; None is empty.

    Raises:
        TypeError: a value is no number, text or truth value.
    """
    kept, text = list(rows), io.StringIO(newline="")
    writer = csv.DictWriter(text, list(dict.fromkeys(key for row in kept for key in row)))
    writer.writeheader()
    writer.writerows({key: _cell(value) for key, value in row.items()} for row in kept)
    return text.getvalue().encode()


def read_rows(path: Path) -> list[Row]:
    """Read rows that `csv_of` has formatted."""
    with path.open(encoding="utf-8", newline="") as file:
        return [{key: _value(cell) for key, cell in row.items()} for row in csv.DictReader(file)]


def _cell(value: Any) -> Any:
    value = value.item() if isinstance(value, np.generic) else value
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"a row holds a {type(value).__name__}, which is no number, text or truth value")


def _value(cell: str | None) -> Any:
    if not cell:
        return None
    if cell in ("True", "False"):
        return cell == "True"
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return kind(cell)
    return cell


@functools.cache
def code_version() -> str:
    """Give the package's version with hashes of the code and of the libraries' versions.

    Of scenes and targets only the MJCF files count: a program that counts makes meshes and textures.
    """
    code, libraries = hashlib.sha256(), hashlib.sha256(json.dumps(libraries_used()).encode())
    for folder in (ROOT / "cotarget", ROOT / "experiments", ROOT / "benchmarks", assets_dir()):
        for path in sorted(path for kind in ("*.py", "*.xml") for path in folder.rglob(kind)):
            code.update(path.relative_to(folder.parent).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return f"{version('cotarget')}+{code.hexdigest()[:8]}.{libraries.hexdigest()[:8]}"


def libraries_used() -> dict[str, str]:
    """Give the versions of Python and of the libraries that figures depend on."""
    found = {name.partition("-")[0]: version(name) for name in ("cotarget", *PACKAGES)}
    return {"python": platform.python_version(), **found}


@functools.cache
def versions() -> dict[str, str]:
    """Give the versions of Python, the libraries and OpenGL's renderer, which is empty without OpenGL."""
    with contextlib.suppress(Exception):  # experiments without pictures run without OpenGL, which raises anything
        from cotarget.sim.render.opengl import mujoco

        context = mujoco.GLContext(8, 8)
        try:
            context.make_current()
            gl = importlib.import_module("OpenGL.GL")
            found = ", ".join(gl.glGetString(name).decode() for name in (gl.GL_RENDERER, gl.GL_VERSION))
            return libraries_used() | {"opengl": found}
        finally:
            context.free()
    return libraries_used() | {"opengl": ""}


# Running


@dataclass(frozen=True)
class Job:
    """One seed of a case."""

    case: Case
    number: int


Run = Callable[[Sequence[Job]], Iterator[tuple[Job, Done]]]
One = Callable[[Any, int], list[Row] | Pictured]


def perform(one: One, settings: Any, number: int) -> Done:
    """Run a seed in this process; an error becomes part of the result."""
    began, cpu_s, given, failed, where = time.perf_counter(), _cpu_s(), Pictured([], {}), "", ""
    with tempfile.NamedTemporaryFile(prefix="cotarget-tally-") as tally:
        os.environ[TALLY] = tally.name
        try:
            given = pictured(one(settings, number))
            csv_of(given.rows)  # refuses what no table holds
        except Exception as error:
            text = " ".join(str(error).split())
            failed = text if isinstance(error, CotargetError) else f"{type(error).__name__}: {text}".rstrip(": ")
            where = traceback.format_exc()
        finally:
            del os.environ[TALLY]
        renders = os.fstat(tally.fileno()).st_size
    took = (time.perf_counter() - began, _cpu_s() - cpu_s, renders)
    return Done(given.rows, given.pictures, *took, code_version(), platform.node(), failed, where)


def _cpu_s() -> float:
    """Give the processor time of this process and of child processes that it has waited for [s]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _on_one_thread(one: One, settings: Any, number: int) -> Done:
    """Run a seed on one thread, because more of them slow each other down, and sum in another order."""
    import cv2

    for name, value in ONE_THREAD.items():
        os.environ.setdefault(name, value)
    cv2.setNumThreads(1)
    return perform(one, settings, number)


@contextlib.contextmanager
def on_dask(processes: int, scheduler: str | None) -> Iterator[Run]:
    """Open a Dask cluster, and give a function that runs jobs on it; a job whose worker dies is tried once more.

    The cluster has that many processes on this machine, or belongs to a scheduler, such as tcp://10.0.0.1:8786.

    Raises:
        ConfigError: Dask is not installed, no scheduler answers, or it lacks workers of one thread each.
    """
    try:
        import dask
        import distributed
    except ImportError as error:
        raise ConfigError(
            f"{error.name} is not installed; the extra experiments has it: {install_extra('experiments')}"
        ) from None
    logging.getLogger("distributed").setLevel(QUIET)
    with contextlib.ExitStack() as stack:
        if scheduler is None:
            # A worker has one job at a time, so that its death concerns this job alone.
            rules = {"distributed.scheduler.worker-saturation": 1.0, "distributed.scheduler.allowed-failures": 1}
            stack.enter_context(dask.config.set(rules))
            shared = stack.enter_context(tempfile.TemporaryDirectory(prefix="cotarget-shared-"))
            with interrupts_kept_from_children():
                cluster = distributed.LocalCluster(
                    n_workers=processes, threads_per_worker=1, processes=True, host="127.0.0.1", memory_limit=0,
                    dashboard_address="127.0.0.1:0", silence_logs=QUIET, env=ONE_THREAD | {SHARED: shared},
                )  # fmt: skip
            client = stack.enter_context(distributed.Client(stack.enter_context(cluster)))
        else:
            try:
                client = stack.enter_context(distributed.Client(scheduler, timeout=ANSWER_S))
            except (OSError, ValueError, TypeError) as error:
                raise ConfigError(f"no Dask scheduler answers at {scheduler}: {error}".splitlines()[0]) from None
        threads = client.nthreads()
        if not threads or max(threads.values()) > 1:
            raise ConfigError(f"{scheduler}: start workers of one thread each, by dask worker ADDRESS --nthreads 1")

        def run(jobs: Sequence[Job]) -> Iterator[tuple[Job, Done]]:
            submit = functools.partial(client.submit, _on_one_thread, pure=False)
            futures = {
                submit(job.case.experiment.one, job.case.settings, job.number, priority=-i): job
                for i, job in enumerate(jobs)
            }
            for future in distributed.as_completed(list(futures)):
                try:
                    done = future.result()
                except CancelledError:
                    raise CotargetError("the Dask scheduler is gone") from None
                except Exception as error:  # the worker died, or lacks the code
                    why = DIED if isinstance(error, distributed.KilledWorker) else f"{type(error).__name__}: {error}"
                    done = Done(version=code_version(), failed=why)
                future.release()  # or Dask would run the seed again where its worker dies later
                yield futures.pop(future), done

        yield run


def alone(jobs: Sequence[Job]) -> Iterator[tuple[Job, Done]]:
    """Run jobs one after the other, each in a process of its own, which may use any number of threads."""
    context = multiprocessing.get_context("spawn")  # a forked process would share the parent's OpenGL
    for job in jobs:
        with ProcessPoolExecutor(1, context, end_with_parent) as pool:
            with interrupts_kept_from_children():
                future = pool.submit(perform, job.case.experiment.one, job.case.settings, job.number)
            try:
                done = future.result()
            except BrokenProcessPool:
                done = Done(version=code_version(), failed=DIED)
            except BaseException:  # the run ends
                for process in multiprocessing.active_children():
                    process.terminate()
                raise
        yield job, done
