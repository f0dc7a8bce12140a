"""Report on all experiments: one self-contained HTML page with every picture, figure and bound."""

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cotarget.files import write_atomically
from cotarget.report.figures import Plot
from cotarget.report.page import render
from cotarget.report.text import Level, Table, count, digits, listed
from experiments.engine.bounds import WORSE, leaves
from experiments.engine.outcome import Outcome
from experiments.engine.sessions import Session
from experiments.engine.texts import plain

MINUTE_S, HOUR_S = 60.0, 3600.0
WANTED_MIN, WANTED_RENDERS = 60, 80_000  # budget of a full run, on two cores
WANTED_QUICK_MIN = 5  # budget of a quick run of all experiments
FEW = 8  # failed jobs listed in the summary


@dataclass(frozen=True)
class Run:
    """Content of a report.

    Attributes:
        outcomes: results of the cases.
        skipped: reasons by experiment for those that were not run.
        sessions: sessions in which the jobs were run.
        command: command that repeats the run.
        is_full: whether these are all experiments with their reported settings.
        is_quick: whether these are all experiments with their quick settings.
    """

    outcomes: Sequence[Outcome]
    skipped: Mapping[str, str]
    sessions: Sequence[Session]
    command: str
    is_full: bool = False
    is_quick: bool = False


def write_report(path: Path, run: Run) -> None:
    """Write the page.

    Raises:
        ConfigError: the page cannot be written.
    """
    label, level, text = _verdict(run)
    page = render(
        "report.html",
        Path(__file__).parent,
        heading="The experiments of cotarget",
        about=[run.command],
        verdict={"level": level, "text": text},
        label=label,
        summary=_summary(run),
        too_short=any(outcome.case.quick and outcome.missed for outcome in run.outcomes),
        skipped=Table("Not run", ("experiment", "why"), tuple(run.skipped.items())),
        cases=[{"anchor": f"case-{i}"} | _case(outcome) for i, outcome in enumerate(run.outcomes)],
        compared=list(_comparisons(run.outcomes)),
        used=used(run),
        times=_times(run),
        sessions=_sessions(run),
        command=run.command,
        made=_made(run),
    )
    write_atomically(path, page.encode())


def _verdict(run: Run) -> tuple[str, Level, str]:
    """Judge a run: label, level and text."""
    failed = sum(len(outcome.failed) for outcome in run.outcomes)
    undone = sum(outcome.undone for outcome in run.outcomes)
    parts = {
        f"{count(failed, 'job')} failed": failed,
        f"{count(undone, 'job')} not done yet": undone,
        "no figures of " + listed([o.case.title for o in run.outcomes if o.broken]): any(
            outcome.broken for outcome in run.outcomes
        ),
        "worse than a bound: " + listed([o.case.title for o in run.outcomes if o.worse]): any(
            outcome.worse for outcome in run.outcomes
        ),
    }
    wrong = [text for text, is_so in parts.items() if is_so]
    short = [outcome.case.title for outcome in run.outcomes if outcome.missed and not outcome.case.quick]
    ran = f"{count(len(run.outcomes), 'experiment')}, {count(sum(len(o.records) for o in run.outcomes), 'job')}"
    others = [outcome.case.title for outcome in run.outcomes if outcome.other_code]
    ran += f"; done by other code than this: {listed(others)}" if others else ""
    if wrong:
        return "Something is wrong", "bad", f"{ran}: {'; '.join(wrong)}."
    if short:
        return "Some figures are not what is wanted", "care", f"{ran}: {listed(short)}."
    if not run.outcomes:
        return "Nothing was run", "unknown", "There is nothing to tell."
    return "All as it should be", "good", f"{ran}; none failed, no bound is broken."


def _summary(run: Run) -> Table:
    header = ("experiment", "wanted figures", "bounds", "jobs", "failed", "time of all jobs")
    rows = (
        (
            outcome.case.title,
            outcome.broken or _wanted(outcome),
            _kept(outcome),
            f"{len(outcome.records)} of {len(outcome.case.numbers)}",
            _named(outcome.failed),
            duration(sum(outcome.seconds)),
        )
        for outcome in run.outcomes
    )
    return Table("", header, tuple(rows))


def _wanted(outcome: Outcome) -> str:
    if outcome.missed is None:
        return "none asked for"
    return f"{len(outcome.missed)} missed" if outcome.missed else "all met"


def _kept(outcome: Outcome) -> str:
    if not outcome.bounds:
        return "none yet" if outcome.case.has_bounds else "of the quick run only"
    return (
        f"{len(outcome.worse)} of {len(outcome.bounds)} broken" if outcome.worse else f"all {len(outcome.bounds)} kept"
    )


def _named(numbers: Mapping[int, Any]) -> str:
    text = ", ".join(map(str, list(numbers)[:FEW]))
    return f"{text} and {len(numbers) - FEW} more" if len(numbers) > FEW else text or "none"


def _case(outcome: Outcome) -> dict[str, Any]:
    """Compute what the page says of one experiment."""
    case, name = outcome.case, outcome.case.experiment.name
    plots = [
        Plot(picture, png, None, f"{name}: {caption}", caption)
        for picture, png in outcome.pictures.items()
        for caption in [f"{picture}.png, of seed {outcome.pictured}"]
    ]
    if outcome.picture is not None:
        plots.append(Plot(name, outcome.picture, None, f"{name}: {outcome.caption}", outcome.caption))
    bounds = (
        (bound.name, bound.text, _figure(bound.reached), "yes" if bound.kept else "NO") for bound in outcome.bounds
    )
    note = f"The best that was reached before; what is up to {WORSE:g} times as bad is kept."
    failed = ((str(number), record.failed) for number, record in outcome.failed.items())
    tracebacks = {record.traceback: number for number, record in reversed(outcome.failed.items())}
    settings = {key: value for key, value in dataclasses.asdict(case.settings).items() if key != "processes"}
    done_by = sorted({record.version for record in outcome.records.values()})
    facts = (
        *((key, json.dumps(plain(value))) for key, value in settings.items()),
        ("done by cotarget", listed(done_by)),
    )
    figures = None
    if outcome.summary is not None:
        leaf = ((" / ".join(trail), json.dumps(value)) for trail, value in leaves(plain(outcome.summary)))
        figures = Table("", ("figure", "value"), tuple(leaf))
    return {
        "title": case.title,
        "purpose": case.experiment.purpose,
        "broken": outcome.broken,
        "text": outcome.text,
        "plots": plots,
        "missed": outcome.missed,
        "bounds": Table("", ("figure", "bound", "reached", "kept"), tuple(bounds), note),
        "failed": Table("", ("seed", "why"), tuple(failed), "The next run tries them again."),
        "tracebacks": [(number, text) for text, number in reversed(tracebacks.items()) if text],
        "facts": Table("", ("setting", "value"), facts),
        "figures": figures,
    }


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _comparisons(outcomes: Sequence[Outcome]) -> Iterator[Table]:
    """Make a table for each experiment that was run with several settings, with its figures side by side."""
    for name in dict.fromkeys(outcome.case.experiment.name for outcome in outcomes):
        mine = [o for o in outcomes if o.case.experiment.name == name and o.summary is not None]
        if len(mine) < 2:
            continue
        columns = [dict(leaves(plain(outcome.summary))) for outcome in mine]
        trails = dict.fromkeys(trail for column in columns for trail, value in column.items() if _is_number(value))
        rows = tuple(
            (" / ".join(trail), *(_figure(v) if _is_number(v := column.get(trail)) else "-" for column in columns))
            for trail in trails
        )
        header = ("figure", *(", ".join(outcome.case.changes) for outcome in mine))
        yield Table(name, header, rows)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _times(run: Run) -> Table:
    header = ("experiment", "jobs", "all together", "median", "longest", "shared", "processor", "renders", "alone")
    rows = [
        (
            outcome.case.title,
            str(len(outcome.seconds)),
            duration(sum(outcome.seconds)),
            duration(float(np.median(outcome.seconds))),
            duration(max(outcome.seconds)),
            duration(outcome.shared.seconds) if outcome.shared.seconds else "",
            duration(outcome.cpu_s),
            str(outcome.renders),
            "yes" if outcome.case.experiment.alone else "no",
        )
        for outcome in run.outcomes
        if outcome.seconds
    ]
    jobs, total = sum(len(o.seconds) for o in run.outcomes), sum(sum(o.seconds) for o in run.outcomes)
    cpu_s, renders = sum(o.cpu_s for o in run.outcomes), sum(o.renders for o in run.outcomes)
    shared = duration(sum(o.shared.seconds for o in run.outcomes))
    rows.append(("all", str(jobs), duration(total), "", "", shared, duration(cpu_s), str(renders), ""))
    note = (
        "Shared is the time for what the jobs share; where several experiments share it, it stands at the first. "
        "Processor time and renders, pictures that MuJoCo drew (a part of one counts as that part), are those of jobs "
        "and of what they share, processes that these start included. Jobs done alone measure times themselves."
    )
    return Table("", header, tuple(rows), note)


def _sessions(run: Run) -> Table:
    rows = tuple(
        (
            each.began,
            each.workers,
            str(did.jobs),
            duration(each.wall_s),
            duration(did.job_s),
            duration(did.shared_s),
            str(did.renders),
            f"{(did.job_s + did.shared_s) / each.wall_s:.2f}" if each.wall_s else "",
        )
        for each, did in ((each, each.whole) for each in run.sessions)
    )
    heads = ("begun", "workers", "jobs", "took", "time of all jobs", "what they share", "renders", "at a time")
    note = (
        "Without what was forgotten or belongs to experiments that are not reported here. Of a session that was killed "
        "the last seconds are missing."
    )
    return Table("Sessions", heads, rows, note)


def used(run: Run) -> str:
    """Describe time and renders of a run, beside the budget."""
    wall_s, renders = sum(each.wall_s for each in run.sessions), sum(outcome.renders for outcome in run.outcomes)
    took, wanted = f"{duration(wall_s)} and {renders} renders", f"{WANTED_MIN} min and {WANTED_RENDERS} renders"
    if run.is_quick:
        over = wall_s > WANTED_QUICK_MIN * MINUTE_S
        return f"{took}, of {WANTED_QUICK_MIN} min that a quick run may take" + (": too much time" if over else "")
    if not run.is_full:
        return f"{took}; a full run may take {wanted}"
    beyond = {"time": wall_s > WANTED_MIN * MINUTE_S, "renders": renders > WANTED_RENDERS}
    lost = [what for what, is_over in beyond.items() if is_over]
    return f"{took}, of {wanted} that a full run may take" + (f": too much {listed(lost)}" if lost else "")


def _made(run: Run) -> list[Table]:
    """Make a table of versions and machine for each set of sessions that have the same."""
    made: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for each in run.sessions:
        facts = {**each.versions, "cotarget": each.cotarget, "machine": each.machine}
        made.setdefault(tuple(facts.items()), []).append(each.began)
    return [
        Table(f"Of the {count(len(began), 'session')} begun {listed(began)}", ("what", "value"), rows)
        for rows, began in made.items()
    ]


def duration(seconds: float) -> str:
    """Format a time: 0.21 s, 34 s, 5 min 10 s, 2 h 3 min."""
    if seconds < MINUTE_S:
        return f"{digits(seconds)} s"
    if seconds < HOUR_S:
        minutes, rest = divmod(round(seconds), 60)
        return f"{minutes} min {rest} s"
    hours, rest = divmod(round(seconds / MINUTE_S), 60)
    return f"{hours} h {rest} min"
