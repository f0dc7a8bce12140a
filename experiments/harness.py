"""What all experiments share: seeds spread over processes, a table, and the files of a run.

An experiment is a module with a dataclass of settings, `run(settings) -> rows`, `summarise(rows)` and, where there is
something to see, `plot(rows, figure)`. Rows are flat dictionaries; everything reported is made from them alone.

    python -m experiments.NAME [--seeds N] [--seed-base B] [--processes P] [--quick] [--out DIR]
"""

import argparse
import csv
import dataclasses
import functools
import json
import math
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Generic, NoReturn, TypeVar

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tqdm import tqdm

import cotarget
from cotarget.cli.arguments import count, not_negative
from cotarget.errors import ConfigError
from cotarget.geometry import Array
from cotarget.parallel import end_with_parent

Row = dict[str, Any]
Job = TypeVar("Job")
# Threads of linear algebra and of rendering: a process each is faster.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS")
EXPECTED = Path(__file__).parent / "expected"
USAGE, INTERRUPTED = 2, 130  # argparse's own exit status, and a shell's for Ctrl-C


class Parser(argparse.ArgumentParser):
    """A parser whose mistakes end in one line."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, without the usage in front of it."""
        self.exit(USAGE, f"{self.prog}: {message}; see {self.prog} --help\n")


@dataclass(frozen=True)
class Settings:
    """How many seeds, from which on, and over how many processes."""

    seeds: int = 100
    seed_base: int = 0
    processes: int = 1


def seeds_of(settings: Settings) -> str:
    """Which seeds, in words."""
    return f"seeds {settings.seed_base} to {settings.seed_base + settings.seeds - 1}"


S = TypeVar("S", bound=Settings)


@dataclass(frozen=True)
class Experiment(Generic[S]):
    """What an experiment consists of.

    Attributes:
        name: of its module.
        purpose: one line, for --help.
        settings: as it is reported.
        quick: the same with less of everything.
        run: gives the rows.
        summarise: gives the figures, from the rows alone; nan where nothing was measured.
        describe: gives settings and figures as a text to print.
        plot: draws the rows.
        missed: names the figures that are not what is wanted; the command fails where there is one.
    """

    name: str
    purpose: str
    settings: S
    quick: S
    run: Callable[[S], list[Row]]
    summarise: Callable[[Sequence[Row]], Mapping[str, Any]]
    describe: Callable[[S, Mapping[str, Any]], str]
    plot: Callable[[Sequence[Row], Figure], None] | None = None
    missed: Callable[[Mapping[str, Any]], Sequence[str]] | None = None

    def main(self, arguments: Sequence[str] | None = None) -> int:
        """The command: run, print the figures, and write the files where asked to."""
        parser = Parser(prog=f"python -m experiments.{self.name}", description=self.purpose)
        seeds, processes = self.settings.seeds, os.cpu_count() or 1
        parser.add_argument("--seeds", type=count, metavar="N", help=f"how many ({seeds}; {self.quick.seeds} if quick)")
        parser.add_argument("--seed-base", type=not_negative, default=0, metavar="B", help="the first seed (0)")
        parser.add_argument(
            "--processes",
            type=count,
            default=processes,
            metavar="P",
            help=f"jobs at a time, but one where time is measured ({processes})",
        )
        parser.add_argument("--quick", action="store_true", help=f"a look only: {_less(self.settings, self.quick)}")
        files = "result.json and rows.csv" if self.plot is None else "result.json, rows.csv and figure.png"
        parser.add_argument("--out", type=Path, metavar="DIR", help=f"write {files} there")
        given = parser.parse_args(arguments)
        settings = self.quick if given.quick else self.settings
        settings = dataclasses.replace(settings, seed_base=given.seed_base, processes=given.processes)
        if given.seeds is not None:
            settings = dataclasses.replace(settings, seeds=given.seeds)
        return self.report(settings, given.out)

    def report(self, settings: S, out: Path | None) -> int:
        """Run with these settings, print the figures, and write the files where there is a folder for them.

        Returns:
            The exit status: 1 where a figure is missed or the folder cannot be written to, 130 on Ctrl-C.
        """
        try:
            if out is not None:
                check_folder(out)
            rows = self.run(settings)
            summary = self.summarise(rows)
            print(self.describe(settings, summary))
            if out is not None:
                self.write(out, settings, rows, summary)
        except ConfigError as error:
            print(f"experiments.{self.name}: {error}", file=sys.stderr)
            return 1
        except KeyboardInterrupt:
            print(f"experiments.{self.name}: interrupted", file=sys.stderr)
            return INTERRUPTED
        return 1 if self.missed is not None and self.missed(summary) else 0

    def write(self, out: Path, settings: S, rows: Sequence[Row], summary: Mapping[str, Any]) -> None:
        """Write result.json, rows.csv and, where there is a plot, figure.png."""
        out.mkdir(parents=True, exist_ok=True)
        result = {
            "experiment": self.name,
            "settings": dataclasses.asdict(settings),
            "versions": {
                "cotarget": cotarget.__version__,
                "opencv": cv2.__version__,
                **{name: version(name) for name in ("numpy", "scipy")},
            },
            "summary": summary,
        }
        (out / "result.json").write_text(json.dumps(_plain(result), indent=2) + "\n", encoding="utf-8")
        with (out / "rows.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, fieldnames=list(dict.fromkeys(key for row in rows for key in row)))
            writer.writeheader()
            writer.writerows(rows)
        if self.plot is not None:
            figure = Figure(figsize=(8, 4.5), layout="constrained")
            FigureCanvasAgg(figure)
            self.plot(rows, figure)
            figure.savefig(out / "figure.png", dpi=110)


def check_folder(out: Path) -> None:
    """Refuse a folder for results that cannot be made or written to, before the work and not after it.

    Raises:
        ConfigError: it, or what it would be in, is a file or may not be written to.
    """
    there = next(path for path in (out.absolute(), *out.absolute().parents) if os.path.lexists(path))
    if not there.is_dir():
        raise ConfigError(f"--out: {there} is no folder; name one that is, or that can be made")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(f"--out: {there} may not be written to; name another folder")


def _less(settings: Settings, quick: Settings) -> str:
    """What a quick run has other than the whole one, for --help."""
    parts = {field.name: getattr(quick, field.name) for field in dataclasses.fields(quick)}
    other = {name: value for name, value in parts.items() if value != getattr(settings, name)}
    texts = (f"{name} {' '.join(map(str, v)) if isinstance(v, tuple) else v}" for name, v in other.items())
    return ", ".join(texts).replace("%", "%%") or "the same"


def over_seeds(one: Callable[[S, int], list[Row]], settings: S) -> list[Row]:
    """All rows of ``one(settings, seed)``, in the order of the seeds; see `spread`."""
    seeds = range(settings.seed_base, settings.seed_base + settings.seeds)
    return [row for rows in spread(functools.partial(one, settings), seeds, settings.processes) for row in rows]


def spread(work: Callable[[Job], list[Row]], jobs: Iterable[Job], processes: int) -> Iterator[list[Row]]:
    """Do each job, in as many processes; what comes out has the jobs' order.

    Args:
        work: a function at the top of a module, or a partial one of it.
        jobs: its arguments, one each.
        processes: 1 for this one.
    """
    jobs = list(jobs)
    before = set(multiprocessing.active_children())
    progress = functools.partial(tqdm, total=len(jobs), disable=None, leave=False)
    if processes == 1 or len(jobs) == 1:
        yield from progress(map(work, jobs))
        return
    context = multiprocessing.get_context("spawn")
    begin = (functools.partial(cv2.setNumThreads, 1),)
    with (
        _one_thread_each(),
        ProcessPoolExecutor(min(processes, len(jobs)), context, initializer=end_with_parent, initargs=begin) as pool,
    ):
        try:
            with _interrupts_ignored():
                futures = [pool.submit(work, job) for job in jobs]
            yield from progress(future.result() for future in futures)
        except BaseException:  # whatever ends this ends them; nobody waits for what they were at
            for process in set(multiprocessing.active_children()) - before:
                process.terminate()
            raise


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Processes started meanwhile leave Ctrl-C, which a terminal sends to all, to this one."""
    if threading.current_thread() is not threading.main_thread():  # which alone may say so
        yield
        return
    kept = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, kept)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started meanwhile have linear algebra on one thread: it reads the environment when it is loaded."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def rms(values: Iterable[float] | Array) -> float:
    """Root mean square; nan values do not count."""
    squared = np.square(np.array(list(values), dtype=float))
    return float(np.sqrt(np.nanmean(squared))) if np.isfinite(squared).any() else math.nan


def table(head: Sequence[str], lines: Iterable[Sequence[Any]]) -> str:
    """A table as text: the first column to the left, numbers to the right with three significant digits or more."""
    cells = [list(head), *([_text(cell) for cell in line] for line in lines)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(head))]
    return "\n".join(
        "  ".join(cell.rjust(w) if i else cell.ljust(w) for i, (cell, w) in enumerate(zip(line, widths, strict=True)))
        for line in cells
    )


def _text(value: Any) -> str:
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:#.3g}" if abs(value) < 100 else f"{value:.0f}"
    return str(value)


def _plain(value: Any) -> Any:
    """As JSON has it: null where nothing was measured."""
    if isinstance(value, Mapping):
        return {str(key): _plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value
