"""Command `python -m experiments`: run all experiments, or those named; a repeated command resumes the run."""

import argparse
import contextlib
import dataclasses
import difflib
import fcntl
import hashlib
import itertools
import os
import re
import shlex
import sys
import time
import tomllib
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import Any

from cotarget.cli.common import whole
from cotarget.cli.main import Parser
from cotarget.errors import ConfigError, CotargetError, choices
from cotarget.parallel import progress_bar
from cotarget.plugins import is_own
from cotarget.schema import validate
from experiments.engine import (
    FOLDERS,
    ROOT,
    Case,
    Done,
    Job,
    Known,
    Run,
    alone,
    code_version,
    forget,
    keep,
    known_experiments,
    missing,
    on_dask,
)
from experiments.report import EXPECTED, conclude, tighten, write_report

PROGRAM = "python -m experiments"
OUT, OUT_QUICK = Path("experiments-out"), Path("experiments-out-quick")
INTERRUPTED, TERMINATED = 130, 143  # exit statuses after Ctrl-C and after SIGTERM
LINES = 12  # failed seeds listed on stderr; the report lists all

Open = Callable[[int, str | None], contextlib.AbstractContextManager[Run]]


def main(
    arguments: Sequence[str] | None = None,
    known: Known | None = None,
    expected: Path = EXPECTED,
    together: Open = on_dask,
    apart: Run = alone,
) -> int:
    """Run the command.

    ``together`` opens the workers of jobs that may run at the same time; ``apart`` runs those that measure times.

    Returns:
        Exit status: 1 if a seed failed, a bound is broken or a figure misses its goal (not for a quick run), else 0.
    """
    typed = sys.argv[1:] if arguments is None else list(arguments)
    given, known = _parser().parse_args(typed), known_experiments() if known is None else known
    try:
        if given.list:
            width = max(map(len, known))
            print(*(f"{name:{width}}  {load().purpose}" for name, load in known.items()), sep="\n")
            return 0
        return _run(given, typed, known, expected, together, apart)
    except CotargetError as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{PROGRAM}: interrupted", file=sys.stderr)
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser, processes = Parser(prog=PROGRAM, description=(__doc__ or "").partition(": ")[2]), os.cpu_count() or 1
    add = parser.add_argument
    add("names", nargs="*", metavar="NAME", help="which ones; all by default")
    add("--list", action="store_true", help="print the names and purposes")
    add("--quick", action="store_true", help="less of each, against its bounds")
    add("--out", type=Path, metavar="DIR", help=f"results and report ({OUT}, or {OUT_QUICK} if quick)")
    add("--seeds", type=whole(1), metavar="N", help="of each; its own number by default")
    add("--seed-base", type=whole(0), metavar="B", help="the first seed (0)")
    add("--set", action="append", default=[], metavar="NAME.KEY=VALUE", help="change a setting; each value is a case")
    add("--processes", type=whole(1), default=processes, metavar="P", help=f"seeds at a time ({processes})")
    add("--scheduler", metavar="ADDRESS", help="of the Dask cluster, such as tcp://10.0.0.1:8786; one of this machine")
    # Both are Dask now; scripts give it.
    add("--backend", choices=("processes", "dask"), default="processes", help=argparse.SUPPRESS)
    add("--fresh", action="store_true", help="delete the results of these experiments first")
    add("--any-code", action="store_true", help="keep results that other code or libraries gave")
    add("--report", action="store_true", help="report what is there, and run nothing")
    add("--update-expected", action="store_true", help="with --quick: tighten the bounds in experiments/expected")
    return parser


def choose(known: Known, given: argparse.Namespace, folder: Path = OUT) -> list[Case]:
    """Make the cases of a run.

    ``given`` has the options ``names`` (all if empty), ``quick``, ``seeds``, ``seed_base`` and ``set``, a list of
    NAME.KEY=VALUE with TOML values. A key that is given more than once makes a case of each value, in combination with
    those of other keys.

    Raises:
        ConfigError: an unknown experiment or setting, or an invalid value.
    """
    chosen = list(dict.fromkeys(_checked(name, known) for name in given.names)) or list(known)
    texts: dict[str, dict[str, list[str]]] = {}
    for change in given.set:
        found = re.fullmatch(r"([^.=]+)\.([^=]+)=(.*)", change, re.DOTALL)
        if found is None:
            raise ConfigError(f"'{change}' is not like NAME.KEY=VALUE, such as chain.noise_px=0.1")
        name, key, text = found.groups()
        if _checked(name, known) not in chosen:
            raise ConfigError(f"'{change}': {name} is not among those to run: {choices(chosen)}")
        texts.setdefault(name, {}).setdefault(key, []).append(text)
    return [case for name in chosen for case in _cases(known, name, texts.get(name, {}), given, folder)]


def _cases(
    known: Known, name: str, texts: dict[str, list[str]], given: argparse.Namespace, folder: Path
) -> Iterator[Case]:
    """Make the cases of one experiment, one for each combination of values."""
    experiment, several = known[name](), list[Any]()
    seeds = {key: value for key in ("seeds", "seed_base") if (value := getattr(given, key)) is not None}
    base = dataclasses.replace(experiment.quick if given.quick else experiment.settings, **seeds)
    for picked in itertools.product(*([(key, text) for text in values] for key, values in texts.items())):
        settings = validate(type(base), {key: _parsed(text) for key, text in picked}, name, base=base)
        for key, _ in picked:
            _check_texts(settings, key, f"{name}.{key}")
        if settings not in several:  # the same value in another spelling is
            several.append(settings)
            changes = tuple(f"{key}={text}" for key, text in picked)
            title = ",".join([name, *changes])
            plain = re.sub(r"[^\w.=,-]+", "_", title)
            path = plain if plain == title else f"{plain}-{hashlib.sha256(title.encode()).hexdigest()[:6]}"
            yield Case(experiment, settings, folder / path, changes, given.quick)


def _checked(name: str, known: Known) -> str:
    if name in known:
        return name
    for file in (f"{folder}/{name}.py" for folder in FOLDERS):
        if (ROOT / file).is_file():
            raise ConfigError(f"{file}: is no experiment, because it sets no SETTINGS")
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
    raise ConfigError(f"unknown experiment '{name}', the nearest is '{near[0]}'; there are: {choices(known)}")


def _parsed(text: str) -> Any:
    """Parse a TOML value; anything else is a text."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _check_texts(settings: Any, key: str, where: str) -> None:
    """Refuse an empty list, and a text that is none of the default's: every seed would fail.

    Raises:
        ConfigError: the value is invalid.
    """
    usual = next(each.default for each in dataclasses.fields(settings) if each.name == key)
    if isinstance(usual, tuple) and usual:
        value = getattr(settings, key)
        wrong = [each for each in value if isinstance(each, str) and each not in usual and not is_own(each)]
        if wrong or not value:
            raise ConfigError(f"{where}: {wrong[0] if wrong else '[]'!r} is not one of: {choices(map(str, usual))}")


def _run(
    given: argparse.Namespace, typed: Sequence[str], known: Known, expected: Path, together: Open, apart: Run
) -> int:
    began = time.perf_counter()
    folder: Path = given.out or (OUT_QUICK if given.quick else OUT)
    chosen = choose(known, given, folder)
    if given.report and (given.fresh or not any((case.folder / "rows").is_dir() for case in chosen)):
        raise ConfigError(f"--report: {folder} has no results of what is asked for, or --fresh would delete them")
    if given.update_expected and not all(case.settings == case.experiment.quick for case in chosen):
        raise ConfigError("--update-expected goes with --quick alone, because bounds are of quick runs as they are")
    lacks = {case.title: lack for case in chosen if (lack := case.experiment.needs(case.settings))}
    for title, lack in lacks.items() if given.names else ():
        raise ConfigError(f"{title} {lack}")
    cases = [case for case in chosen if case.title not in lacks]
    if given.report:
        for case in cases:
            missing(case)  # refuses results of other settings
    elif status := _finish(_missing(cases, folder, given, together, apart), given, folder):
        return status
    outcomes = [conclude(case, expected) for case in cases]
    for outcome in outcomes:
        print("", outcome.case.title, outcome.text, *outcome.remarks, sep="\n")
    for title, lack in lacks.items():
        print("", title, f"not run: {lack}", sep="\n")
    failed = [f"{o.case.title}, seed {seed} failed: {why}" for o in outcomes for seed, why in o.failed.items()]
    more = [f"and {len(failed) - LINES} more failed"] if len(failed) > LINES else []
    for text in failed[:LINES] + more:
        print(f"{PROGRAM}: {text}", file=sys.stderr)
    if given.update_expected:
        print("", "bounds that are tighter now:", *tighten(outcomes, expected), sep="\n")
    does = [word for word in typed if word not in ("--report", "--fresh")]
    page = write_report(folder, outcomes, lacks, shlex.join([*PROGRAM.split(), *does]))
    print(f"\n{page}\ntook {time.perf_counter() - began:.0f} s")
    return 0 if all(outcome.ok for outcome in outcomes) else 1


def _missing(
    cases: Sequence[Case], folder: Path, given: argparse.Namespace, together: Open, apart: Run
) -> Generator[tuple[Job, Done, Sequence[Job]]]:
    """Run the seeds that have no rows, the longest first, then those that measure times; keep each at once.

    Yields:
        The job that is done, its result, and all jobs.

    Raises:
        CotargetError: the cluster fails, a worker has other code, or a result cannot be written.
    """
    with _locked(folder):
        mine = "" if given.any_code else code_version()
        jobs = [Job(case, n) for case in cases for n in (case.numbers if given.fresh else missing(case, mine))]
        jobs.sort(key=lambda job: -job.case.experiment.cost_s)
        timing = [job for job in jobs if job.case.experiment.alone]
        others = [job for job in jobs if not job.case.experiment.alone]
        with contextlib.ExitStack() as stack:
            run = stack.enter_context(together(min(given.processes, len(others)), given.scheduler)) if others else apart
            for case in cases if given.fresh else ():  # now that there are workers
                forget(case)

            def results() -> Iterator[tuple[Job, Done]]:
                yield from run(others)
                stack.close()  # the workers end before times are measured
                yield from apart(timing)

            for job, done in results():
                if mine and done.version != mine:
                    raise ConfigError(f"a worker has cotarget {done.version}, this is {mine}; give both the same")
                keep(job.case, job.number, done)
                yield job, done, jobs


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a folder of results against other runs; make it where it does not exist.

    Raises:
        ConfigError: another run holds the lock, or the folder cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / ".lock").open("w")
    except OSError as error:
        raise ConfigError(f"--out: {folder}: {error.strerror}; name a folder that can be written") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(f"{folder}: another run is writing its results there; name another with --out") from None
        yield


def _finish(results: Generator[tuple[Job, Done, Sequence[Job]]], given: argparse.Namespace, folder: Path) -> int:
    """Run all jobs and show the progress; give the exit status of a run that was broken off, else 0."""
    finished, failed, total, spent = 0, 0, 0, 0.0
    try:
        with contextlib.closing(results), progress_bar() as show:
            for job, done, jobs in results:
                finished, failed, total = finished + 1, failed + bool(done.failed), len(jobs)
                spent += job.case.experiment.cost_s
                text = f"{finished} of {total} seeds{f', {failed} failed' if failed else ''}; last {job.case.title}"
                show(spent, sum(each.case.experiment.cost_s for each in jobs), text)
        return 0
    except CotargetError as error:
        why, status = str(error), 1
    except KeyboardInterrupt:
        why, status = "interrupted", INTERRUPTED
    except SystemExit:
        why, status = "ended", TERMINATED
    if finished:
        same = f"the same command{' without --fresh' if given.fresh else ''} goes on"
        why += f"; {finished - failed} of {total} seeds are done and kept in {folder}, and {same}"
    print(f"{PROGRAM}: {why}", file=sys.stderr)
    return status
