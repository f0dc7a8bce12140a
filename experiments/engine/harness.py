"""Definition of an experiment, its own command, and the files that it writes.

An experiment is a module with a dataclass of settings and some functions. `one(shared, settings, seed)` gives the rows
of one seed; they depend on its arguments alone, not on the process or on earlier jobs. The optional `prepare(settings)`
gives what all seeds share. `summarise(rows)` computes the figures, `describe` a text to print, `plot` a picture. Rows
are flat dictionaries of numbers, texts and truth values. Everything reported is made from rows alone, except pictures
that `one` may return beside them (`experiments.engine.pictured`).

    python -m experiments.NAME [--seeds N] [--seed-base B] [--processes P] [--quick] [--out DIR]

`python -m experiments` runs many experiments and resumes an interrupted run: `experiments.engine.runner`.
"""

import csv
import dataclasses
import functools
import io
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from cotarget.cli.common import not_negative, positive_int, progress_bar
from cotarget.cli.main import Parser
from cotarget.errors import ConfigError, CotargetError, DeviceError
from cotarget.files import write_atomically
from experiments.engine.arguments import check_folder
from experiments.engine.pictured import Pictured, parted, shown
from experiments.engine.texts import in_one_line, plain
from experiments.engine.versions import versions
from experiments.engine.workers import Died, Engine, here, in_processes

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Row = dict[str, Any]
INTERRUPTED, TERMINATED = 130, 143  # exit status after Ctrl-C and after SIGTERM
FIGURE = "figure"  # name of the plot's file


@dataclass(frozen=True)
class Settings:
    """Number of seeds, first seed and number of processes.

    Raises:
        ConfigError: no seeds, no processes, or a negative seed.
    """

    seeds: int = 100
    seed_base: int = 0
    processes: int = 1

    def __post_init__(self) -> None:
        for name, least in (("seeds", 1), ("seed_base", 0), ("processes", 1)):
            if getattr(self, name) < least:
                raise ConfigError(f"{name} = {getattr(self, name)}: at least {least} is needed")


def seeds_of(settings: Settings) -> str:
    """Describe the range of seeds."""
    return f"seeds {settings.seed_base} to {settings.seed_base + settings.seeds - 1}"


def seeds_in(settings: Settings) -> Sequence[int]:
    """Give the seeds of a run."""
    return range(settings.seed_base, settings.seed_base + settings.seeds)


S = TypeVar("S", bound=Settings)


@dataclass(frozen=True)
class Preparation:
    """Function that makes what seeds share, from a part of the settings; made once for all experiments that share it.

    Attributes:
        make: makes the shared object; a function at module level.
        arguments: gives the arguments of ``make`` from the settings; at module level too.
    """

    make: Callable[..., Any]
    arguments: Callable[[Any], tuple[Any, ...]]

    def __call__(self, settings: Any) -> Any:
        """Make the shared object."""
        return self.make(*self.arguments(settings))


@dataclass(frozen=True)
class Experiment(Generic[S]):
    """Definition of an experiment. Functions that other processes call must be at module level.

    Attributes:
        name: name of the module.
        purpose: one line for --help.
        settings: settings of the reported run.
        quick: settings of the quick run, with less of everything.
        one: gives the rows of a seed, with or without pictures, from the result of `prepare`, the settings and the
            seed.
        summarise: computes the figures from the rows; nan where nothing was measured.
        describe: formats settings and figures as a text.
        plot: draws the rows.
        missed: lists the figures that miss their goal; with any, the command fails.
        prepare: makes what all seeds share, from the settings; a `Preparation` where several experiments share it.
        jobs: gives the numbers that `one` is called with, where these are not the seeds.
        alone: whether it measures times, so that nothing else may run and it may use all cores.
        cost_s: approximate time of one seed on one core [s]; the longest are started first.
        bounded: gives the figures under the names of the file of bounds, where these are not the summary's.
        needs: describes what the experiment lacks to run with these settings; empty if nothing.
    """

    name: str
    purpose: str
    settings: S
    quick: S
    one: Callable[[Any, S, int], list[Row] | Pictured]
    summarise: Callable[[Sequence[Row]], Mapping[str, Any]]
    describe: Callable[[S, Mapping[str, Any]], str]
    plot: "Callable[[Sequence[Row], Figure], None] | None" = None
    missed: Callable[[Mapping[str, Any]], Sequence[str]] | None = None
    prepare: Callable[[S], Any] | None = None
    jobs: Callable[[S], Sequence[int]] = seeds_in
    alone: bool = False
    cost_s: float = 1.0
    bounded: Callable[[Mapping[str, Any]], Mapping[str, Any]] | None = None
    needs: Callable[[S], str] | None = None

    def main(self, arguments: Sequence[str] | None = None) -> int:
        """Run the experiment's command: run the seeds, print the figures, and write files on request."""
        parser = Parser(prog=f"python -m {self._module()}", description=self.purpose)
        seeds, processes = self.settings.seeds, os.cpu_count() or 1
        parser.add_argument(
            "--seeds", type=positive_int, metavar="N", help=f"how many ({seeds}; {self.quick.seeds} if quick)"
        )
        parser.add_argument("--seed-base", type=not_negative, default=0, metavar="B", help="the first seed (0)")
        parser.add_argument(
            "--processes",
            type=positive_int,
            default=processes,
            metavar="P",
            help=f"jobs at a time, but one where time is measured ({processes})",
        )
        parser.add_argument("--quick", action="store_true", help=f"a look only: {_less(self.settings, self.quick)}")
        files = "result.json and rows.csv" if self.plot is None else "result.json, rows.csv and pictures"
        parser.add_argument("--out", type=Path, metavar="DIR", help=f"write {files} there")
        given = parser.parse_args(arguments)
        settings = self.quick if given.quick else self.settings
        settings = dataclasses.replace(settings, seed_base=given.seed_base, processes=given.processes)
        if given.seeds is not None:
            settings = dataclasses.replace(settings, seeds=given.seeds)
        return self.report(settings, given.out, quick=given.quick)

    def _module(self) -> str:
        spec = sys.modules["__main__"].__spec__
        return spec.name if spec is not None and spec.name.endswith(f".{self.name}") else f"experiments.{self.name}"

    def report(self, settings: S, out: Path | None, *, quick: bool = False) -> int:
        """Run with these settings, print the figures, and write the files if a folder is given.

        Returns:
            Exit status: 130 on Ctrl-C; 1 if a seed failed, a figure misses its goal (not for a quick run, which is too
                short for that), something is lacking or the folder cannot be written; else 0.
        """
        failed: dict[int, str] = {}
        try:
            if out is not None:
                check_folder(out)
            rows, pictures = parted(self.run_pictured(settings, failed=failed))
            for number, why in failed.items():
                print(f"experiments.{self.name}: seed {number} failed: {why}", file=sys.stderr)
            if failed and not rows:
                return 1
            try:
                summary = self.summarise(rows)
                text, picture = self.describe(settings, summary), None if out is None else self.picture(rows)
            except Exception as error:
                if not failed:
                    raise
                raise CotargetError(f"the rows without those seeds give no figures ({error})") from error
            print(text)
            if out is not None:
                self.write(out, settings, rows, summary, picture, pictures)
        except CotargetError as error:
            print(f"experiments.{self.name}: {error}", file=sys.stderr)
            return 1
        except KeyboardInterrupt:
            print(f"experiments.{self.name}: interrupted", file=sys.stderr)
            return INTERRUPTED
        lost = not quick and self.missed is not None and self.missed(summary)
        return 1 if failed or lost else 0

    def shares(self, settings: S) -> tuple[Callable[..., Any], tuple[Any, ...]] | None:
        """Give the function that makes what all seeds share, and its arguments; None where they share nothing."""
        if isinstance(self.prepare, Preparation):
            return self.prepare.make, self.prepare.arguments(settings)
        return None if self.prepare is None else (self.prepare, (settings,))

    def run(self, settings: S, engine: Engine = in_processes) -> list[Row]:
        """Give all rows in the order of the seeds (see `run_pictured`)."""
        return self.run_pictured(settings, engine).rows

    def run_pictured(
        self, settings: S, engine: Engine = in_processes, failed: dict[int, str] | None = None
    ) -> Pictured:
        """Give all rows in the order of the seeds, and the pictures of the first seed that has any.

        Args:
            settings: settings with number of seeds and processes.
            engine: runs the jobs; jobs that measure times run in this process, one after the other.
            failed: receives the reason for each seed that fails, while the others go on; without it, the first failure
                ends the run.

        Raises:
            ConfigError: something that the experiment needs is missing.
            DeviceError: a process died.
        """
        if self.needs is not None and (lack := self.needs(settings)):
            raise ConfigError(lack)
        engine = here if self.alone else engine
        # A worker makes it too: with one thread of linear algebra, its last digits do not depend on the engine.
        shared = None if self.prepare is None else _all(engine, self.prepare, [settings], 1)[0]
        jobs = functools.partial(self.one, shared, settings)
        if failed is not None:
            jobs = functools.partial(_tried, jobs)
        numbers, found = self.jobs(settings), []
        for number, each in zip(numbers, _all(engine, jobs, numbers, settings.processes), strict=True):
            if isinstance(each, Exception) and failed is not None:
                failed[number] = in_one_line(each)
            else:
                found.append(parted(each))
        return Pictured([row for rows, _ in found for row in rows], shown(pictures for _, pictures in found))

    def write(
        self,
        out: Path,
        settings: S,
        rows: Sequence[Row],
        summary: Mapping[str, Any],
        picture: bytes | None,
        pictures: Mapping[str, bytes] = MappingProxyType({}),
    ) -> None:
        """Write result.json and rows.csv, figure.png if there is a plot, and the pictures of the jobs.

        Raises:
            ConfigError: a file cannot be written.
        """
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{out}: cannot be made: {error.strerror}") from None
        result = {
            "experiment": self.name,
            "settings": dataclasses.asdict(settings),
            "versions": versions(),
            "summary": summary,
        }
        write_atomically(out / "result.json", (json.dumps(plain(result), indent=2) + "\n").encode())
        table = io.StringIO(newline="")
        writer = csv.DictWriter(table, fieldnames=list(dict.fromkeys(key for row in rows for key in row)))
        writer.writeheader()
        writer.writerows(rows)
        write_atomically(out / "rows.csv", table.getvalue().encode())
        for name, png in {**({} if picture is None else {FIGURE: picture}), **pictures}.items():
            write_atomically(out / f"{name}.png", png)

    def picture(self, rows: Sequence[Row]) -> bytes | None:
        """Draw the plot as a PNG; None without a plot."""
        if self.plot is None:
            return None
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(8, 4.5), layout="constrained")
        FigureCanvasAgg(figure)
        self.plot(rows, figure)
        png = io.BytesIO()
        figure.savefig(png, format="png", dpi=110)
        return png.getvalue()


def _tried(one: Callable[[int], Any], number: int) -> Any:
    """Run a seed; give its rows, or the exception that it raised."""
    try:
        return one(number)
    except Exception as error:
        return error.with_traceback(None)


def _all(engine: Engine, work: Callable[[Any], Any], jobs: Sequence[Any], processes: int) -> list[Any]:
    """Run all jobs and give their results in the order of the jobs."""
    found: dict[int, Any] = {}
    with progress_bar() as show:
        for number, result in engine(work, jobs, processes):
            if result is Died:
                raise DeviceError(f"the process of job {number + 1} of {len(jobs)} died; is there memory enough?")
            found[number] = result
            show(len(found), len(jobs), f"{len(found)} of {len(jobs)} jobs")
    return [found[number] for number in sorted(found)]


def _less(settings: Settings, quick: Settings) -> str:
    """List the settings of a quick run that differ from the full one, for --help."""
    parts = {field.name: getattr(quick, field.name) for field in dataclasses.fields(quick)}
    other = {name: value for name, value in parts.items() if value != getattr(settings, name)}
    texts = (f"{name} {' '.join(map(str, v)) if isinstance(v, tuple) else v}" for name, v in other.items())
    return ", ".join(texts).replace("%", "%%") or "the same"
