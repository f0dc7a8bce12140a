"""Report on all experiments: one self-contained HTML page with every picture, figure and bound."""

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cotarget.files import write_whole
from cotarget.report import page as page_module
from cotarget.report.figures import Plot
from cotarget.report.page import STYLE
from cotarget.report.text import Table, count, digits, listed
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
    anchored = [(f"case-{i}", outcome) for i, outcome in enumerate(run.outcomes)]
    links = [(anchor, outcome.case.title) for anchor, outcome in anchored]
    compared = list(_comparisons(run.outcomes))
    sections = [
        page_module.section("summary", "All at a glance", _summary(run)),
        *(page_module.section(anchor, outcome.case.title, _case(outcome)) for anchor, outcome in anchored),
        *([page_module.section("compared", "Settings compared", compared)] if compared else []),
        page_module.section("times", "Times", _times(run)),
        page_module.section("made", "How this was made", _made(run)),
    ]
    more = [("compared", "settings compared")] if compared else []
    links += [*more, ("times", "times"), ("made", "how this was made")]
    head = page_module.header("The experiments of cotarget", [run.command]) + "\n" + _verdict(run)
    body = "\n".join([head, page_module.contents(links), *sections])
    page = page_module.document("The experiments of cotarget", STYLE.read_text(encoding="utf-8"), body)
    write_whole(path, page.encode())


def _verdict(run: Run) -> str:
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
        return page_module.verdict("bad", "Something is wrong", f"{ran}: {'; '.join(wrong)}.")
    if short:
        return page_module.verdict("care", "Some figures are not what is wanted", f"{ran}: {listed(short)}.")
    if not run.outcomes:
        return page_module.verdict("unknown", "Nothing was run", "There is nothing to tell.")
    return page_module.verdict("good", "All as it should be", f"{ran}; none failed, no bound is broken.")


def _summary(run: Run) -> Iterator[str]:
    header = ("experiment", "wanted figures", "bounds", "jobs", "failed", "time of all jobs")
    rows = tuple(
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
    yield page_module.table(Table("", header, rows))
    if any(outcome.case.quick and outcome.missed for outcome in run.outcomes):
        yield page_module.paragraph("A quick run is too short for what is wanted; it is held to its bounds.", "note")
    if run.skipped:
        yield page_module.table(Table("Not run", ("experiment", "why"), tuple(run.skipped.items())))


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


def _case(outcome: Outcome) -> Iterator[str]:
    case = outcome.case
    yield page_module.paragraph(case.experiment.purpose)
    if outcome.broken:
        yield page_module.paragraph(outcome.broken[:1].upper() + outcome.broken[1:] + ".")
    if outcome.text:
        yield page_module.preformatted(outcome.text)
    for name, png in outcome.pictures.items():
        caption = f"{name}.png, of seed {outcome.pictured}"
        yield page_module.figure(Plot(name, png, None, f"{case.experiment.name}: {caption}", caption))
    if outcome.picture is not None:
        name = case.experiment.name
        yield page_module.figure(Plot(name, outcome.picture, None, f"{name}: {outcome.caption}", outcome.caption))
    if outcome.missed is not None:
        lost = outcome.missed
        yield page_module.subheading("Wanted figures")
        yield page_module.bullets(lost) if lost else page_module.paragraph("All are met.")
    if outcome.bounds:
        yield page_module.subheading("Bounds")
        rows = tuple(
            (bound.name, bound.text, _figure(bound.reached), "yes" if bound.kept else "NO") for bound in outcome.bounds
        )
        note = f"The best that was reached before; what is up to {WORSE:g} times as bad is kept."
        yield page_module.table(Table("", ("figure", "bound", "reached", "kept"), rows, note))
    if outcome.failed:
        yield page_module.subheading("Failed jobs")
        why = tuple((str(number), record.failed) for number, record in outcome.failed.items())
        yield page_module.table(Table("", ("seed", "why"), why, "The next run tries them again."))
        tracebacks = {record.traceback: number for number, record in reversed(outcome.failed.items())}
        for text, number in reversed(tracebacks.items()):
            if text:
                yield page_module.folded(f"Traceback of seed {number}", page_module.preformatted(text))
    told = {key: value for key, value in dataclasses.asdict(case.settings).items() if key != "processes"}
    settings = tuple((key, json.dumps(plain(value))) for key, value in told.items())
    done_by = sorted({record.version for record in outcome.records.values()})
    facts = (*settings, ("done by cotarget", listed(done_by)))
    yield page_module.folded("Settings and versions", page_module.table(Table("", ("setting", "value"), facts)))
    if outcome.summary is not None:
        figures = tuple((" / ".join(trail), json.dumps(value)) for trail, value in leaves(plain(outcome.summary)))
        yield page_module.folded("Every figure", page_module.table(Table("", ("figure", "value"), figures)))


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _comparisons(outcomes: Sequence[Outcome]) -> Iterator[str]:
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
        yield page_module.table(Table(name, header, rows))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _times(run: Run) -> Iterator[str]:
    yield page_module.paragraph(f"In all: {used(run)}.")
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
    yield page_module.table(Table("", header, tuple(rows), note))
    sessions = tuple(
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
    yield page_module.table(Table("Sessions", heads, sessions, note))


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


def _made(run: Run) -> Iterator[str]:
    yield page_module.preformatted(run.command)
    made: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for each in run.sessions:
        facts = {**each.versions, "cotarget": each.cotarget, "machine": each.machine}
        made.setdefault(tuple(facts.items()), []).append(each.began)
    for rows, began in made.items():
        yield page_module.table(
            Table(f"Of the {count(len(began), 'session')} begun {listed(began)}", ("what", "value"), rows)
        )


def duration(seconds: float) -> str:
    """Format a time: 0.21 s, 34 s, 5 min 10 s, 2 h 3 min."""
    if seconds < MINUTE_S:
        return f"{digits(seconds)} s"
    if seconds < HOUR_S:
        minutes, rest = divmod(round(seconds), 60)
        return f"{minutes} min {rest} s"
    hours, rest = divmod(round(seconds / MINUTE_S), 60)
    return f"{hours} h {rest} min"
