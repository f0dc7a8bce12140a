"""Run all experiments, or those named, on local processes or a Dask cluster; a repeated command resumes the run.

python -m experiments [NAME ...] [--quick] [--out DIR] [--seeds N] [--seed-base B] [--set NAME.KEY=VALUE] [--list]
"""

import argparse
import contextlib
import functools
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from cotarget.cli.common import not_negative, positive_int, progress_bar
from cotarget.cli.main import Parser
from cotarget.errors import ConfigError, CotargetError
from cotarget.report.text import count as number_of
from experiments.engine.arguments import check_folder
from experiments.engine.bounds import EXPECTED, tighten
from experiments.engine.cases import Case, Known, choose, known_experiments
from experiments.engine.cluster import check_cluster, on_dask
from experiments.engine.harness import INTERRUPTED, TERMINATED
from experiments.engine.outcome import Outcome, conclude
from experiments.engine.report import Run, duration, used, write_report
from experiments.engine.results import code_version, taken
from experiments.engine.runner import Sweep, forget
from experiments.engine.sessions import sessions
from experiments.engine.workers import Engine, in_processes

PROGRAM = "python -m experiments"
OUT, OUT_QUICK = Path("experiments-out"), Path("experiments-out-quick")
LINES = 12  # failed jobs listed on stderr; the report lists all


def main(arguments: Sequence[str] | None = None, known: Known | None = None, expected: Path = EXPECTED) -> int:
    """Run the command.

    Args:
        arguments: command-line arguments.
        known: known experiments by name.
        expected: folder of the bounds.

    Returns:
        Exit status: 1 if a job failed, a bound is broken or a figure misses its goal (not for a quick run), else 0.
    """
    typed = sys.argv[1:] if arguments is None else list(arguments)
    known = known_experiments() if known is None else known
    given = _parser().parse_args(typed)
    try:
        with _polite_ends():
            return _list(known) if given.list else _run(given, typed, known, expected)
    except CotargetError as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{PROGRAM}: interrupted", file=sys.stderr)
        return INTERRUPTED
    except OSError as error:
        where = "" if error.filename is None else f"{error.filename}: "
        print(f"{PROGRAM}: {where}{error.strerror or error}", file=sys.stderr)
        return 1


@contextlib.contextmanager
def _polite_ends() -> Iterator[None]:
    """Turn SIGTERM into an exit that also ends the child processes."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread may set signal handlers
        yield
        return
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog=PROGRAM, description=(__doc__ or "").splitlines()[0])
    processes = os.cpu_count() or 1
    parser.add_argument("names", nargs="*", metavar="NAME", help="which ones; all by default")
    parser.add_argument("--list", action="store_true", help="tell which there are")
    parser.add_argument("--quick", action="store_true", help="less of each, as its own --help says")
    parser.add_argument("--out", type=Path, metavar="DIR", help=f"results and report ({OUT}, or {OUT_QUICK} if quick)")
    parser.add_argument("--seeds", type=positive_int, metavar="N", help="of each; its own number by default")
    parser.add_argument("--seed-base", type=not_negative, metavar="B", help="the first seed (0)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME.KEY=VALUE",
        help="change a setting; given more than once with the same key, each value is a case of its own",
    )
    parser.add_argument(
        "--processes",
        type=positive_int,
        default=processes,
        metavar="P",
        help=f"jobs at a time, but one where time is measured ({processes})",
    )
    parser.add_argument(
        "--backend",
        choices=("processes", "dask"),
        default="processes",
        help="who does the jobs: processes of this machine, or a Dask cluster",
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="of the Dask cluster, such as tcp://10.0.0.1:8786; one of this machine"
    )
    parser.add_argument("--fresh", action="store_true", help="forget what is in the folder of these experiments")
    parser.add_argument("--any-code", action="store_true", help="keep results that other code or libraries gave")
    parser.add_argument("--report", action="store_true", help="do nothing but report what is there")
    parser.add_argument("--update-expected", action="store_true", help="tighten the bounds in experiments/expected")
    return parser


def _list(known: Known) -> int:
    width = max(map(len, known))
    for name, load in known.items():
        print(f"{name:{width}}  {load().purpose}")
    return 0


def _run(given: argparse.Namespace, typed: Sequence[str], known: Known, expected: Path) -> int:
    engine, what, check = _engine(given)
    folder: Path = given.out or (OUT_QUICK if given.quick else OUT)
    check_folder(folder)
    chosen = choose(
        known, given.names, quick=given.quick, seeds=given.seeds, seed_base=given.seed_base, changes=given.set
    )
    if given.report and given.fresh:
        raise ConfigError("--report reports what is there, which --fresh would forget: say one of them")
    if given.report and not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder; --out names one with results")
    if given.update_expected and not all(case.has_bounds for case in chosen):
        raise ConfigError("the bounds are of quick runs as they are: --update-expected goes with --quick alone")
    cases, skipped = _split(chosen, named=bool(given.names))
    if given.report and not any((folder / case.folder).is_dir() for case in cases):
        raise ConfigError(f"{folder}: holds no results of what is asked for; --out names the folder that does")
    if given.report:  # the report lists results of other code and does not refuse them
        sweep = Sweep(cases, folder, any_code=True)
    else:
        with taken(folder):
            if given.fresh:
                check()
                forget(cases, folder)
            sweep = Sweep(cases, folder, given.processes, given.any_code)
            if status := _do(sweep, engine, what, given.fresh):
                return status
    outcomes = [
        conclude(case, records, folder / case.folder, expected, shared)
        for case, records, shared in zip(cases, sweep.records, sweep.shared, strict=True)
    ]
    _tell(outcomes, skipped)
    if given.update_expected:
        _update(outcomes, expected)
    page, mine = folder / "report.html", {case.folder for case in cases}
    took = [part for each in sessions(folder) if (part := each.of(mine)).cases]
    does = [word for word in typed if not (word.startswith("--r") and "--report".startswith(word))]
    is_all = not (given.names or given.seeds or given.set)
    command = shlex.join([*PROGRAM.split(), *does])
    run = Run(outcomes, skipped, took, command, is_all and not given.quick, is_all and given.quick)
    write_report(page, run)
    print(f"\nin all: {used(run)}\n{page}")
    return 0 if all(outcome.ok for outcome in outcomes) else 1


def _engine(given: argparse.Namespace) -> tuple[Engine, str, Callable[[], None]]:
    """Give the engine that runs the jobs, its description, and a check that it is ready."""
    if given.backend == "dask":
        where = "a Dask cluster" if given.scheduler else f"a Dask cluster on this machine, {given.processes} at most"
        told = {"scheduler": given.scheduler, "version": code_version(), "any_libraries": given.any_code}
        check = functools.partial(check_cluster, given.processes, **told)
        return functools.partial(on_dask, **told), where, check
    if given.scheduler is not None:
        raise ConfigError("--scheduler goes with --backend dask")
    return in_processes, number_of(given.processes, "process", "processes"), lambda: None


def _split(chosen: Sequence[Case], *, named: bool) -> tuple[list[Case], dict[str, str]]:
    """Split cases into those that can run and the reasons of the others; a named experiment must be able to run."""
    lacks = {case.title: "" if (needs := case.experiment.needs) is None else needs(case.settings) for case in chosen}
    skipped = {title: lack for title, lack in lacks.items() if lack}
    if named and skipped:
        title, lack = next(iter(skipped.items()))
        raise ConfigError(f"{title} {lack}")
    return [case for case in chosen if case.title not in skipped], skipped


def _do(sweep: Sweep, engine: Engine, what: str, fresh: bool) -> int:
    """Run the missing jobs; give the exit status of an interrupted run, else 0."""
    try:
        with progress_bar() as show:
            sweep.run(engine, show, what)
        return 0
    except CotargetError as error:
        why, status = str(error), 1
    except KeyboardInterrupt:
        why, status = "interrupted", INTERRUPTED
    except SystemExit:
        why, status = "ended", TERMINATED
    if sweep.done:
        same = f"the same command{' without --fresh' if fresh else ''} goes on"
        why += f"; {sweep.done} of {sweep.total} jobs are done and kept in {sweep.folder}, and {same}"
    print(f"{PROGRAM}: {why}", file=sys.stderr)
    return status


def _tell(outcomes: Sequence[Outcome], skipped: dict[str, str]) -> None:
    """Print the figures of each case, and the errors on stderr."""
    for outcome in outcomes:
        print(f"\n{outcome.case.title} ({duration(sum(outcome.seconds))})")
        if outcome.text:
            print(outcome.text)
        remarks = [outcome.broken] if outcome.broken else []
        remarks += [f"{outcome.undone} jobs are not done yet"] if outcome.undone else []
        remarks += [f"done by cotarget {each}, this is {code_version()}" for each in outcome.other_code]
        remarks += [f"missed: {name}" for name in outcome.missed or ()]
        remarks += [f"worse than its bound: {b.name}, {b.reached} is not {b.text}" for b in outcome.worse]
        print(*remarks, sep="\n", end="\n" if remarks else "")
    for title, lack in skipped.items():
        print(f"\n{title}\nnot run: {lack}")
    failed = [(o.case.title, number, record.failed) for o in outcomes for number, record in o.failed.items()]
    for title, number, why in failed[:LINES]:
        print(f"{PROGRAM}: {title}, seed {number} failed: {why}", file=sys.stderr)
    if len(failed) > LINES:
        print(f"{PROGRAM}: and {len(failed) - LINES} more failed", file=sys.stderr)


def _update(outcomes: Sequence[Outcome], expected: Path) -> None:
    changed: list[Any] = []
    for outcome in outcomes:
        if outcome.summary is not None and not (outcome.failed or outcome.undone or outcome.other_code):
            changed += tighten(outcome.case.experiment, outcome.summary, expected)
    print("\nbounds that are tighter now:" if changed else "\nno bound is tighter now", *changed, sep="\n")
