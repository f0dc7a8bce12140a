"""Report on experiments: figures from rows, beside goals and bounds, on one HTML page.

`experiments/expected/NAME.json` holds bounds of the quick run's figures, under the summary's names. Each has one or
more of

    at_most, at_least   best value reached; a value up to WORSE times as bad passes
    within              pair of limits, which never changes

with null for a number that is not known yet. A number alone means at_most. Bounds only tighten.
"""

import base64
import functools
import inspect
import io
import json
import math
import operator
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cotarget.errors import ConfigError
from cotarget.files import write_atomically
from cotarget.report.page import render
from experiments.engine import Case, Experiment, Row, code_version, csv_of, log_of, read_rows, rows_file, versions
from experiments.tables import as_text, leaves, plain

EXPECTED = Path(__file__).parent / "expected"
WORSE = 1.10  # factor; other versions of the libraries round and render differently by about as much
DIGITS = 4  # significant digits of a bound
FIGURE = "figure"  # name of the plot's file
KINDS = ("at_most", "at_least", "within")
Trail = tuple[str, ...]


@dataclass(frozen=True)
class Bound:
    """Figure with one of its bounds."""

    name: str  # path of the figure in the summary
    kind: str  # at_most, at_least or within
    bound: float | tuple[float, float] | None  # best value reached before, or a pair of limits; None before the first
    reached: float | None  # value of this run; None where it was not measured
    trail: Trail = ()  # where the bound is in its file

    def __str__(self) -> str:
        limits = self.bound if isinstance(self.bound, tuple) else (math.nan if self.bound is None else self.bound,)
        reached = "not among the figures" if self.reached is None else self.reached
        return f"{self.name}: {reached}, {self.kind.replace('_', ' ')} {' to '.join(f'{v:.4g}' for v in limits)}"

    @property
    def kept(self) -> bool:
        """Whether the figure is within its bound."""
        if self.reached is None or self.bound is None:
            return self.reached is not None
        if isinstance(self.bound, tuple):
            return self.bound[0] <= self.reached <= self.bound[1]
        worst = (self.bound * WORSE, self.bound / WORSE)  # for negative bounds the order is reversed
        return self.reached <= max(worst) if self.kind == "at_most" else self.reached >= min(worst)

    @property
    def tighter(self) -> float | None:
        """New value of the bound; None where it stays."""
        if self.reached is None or isinstance(self.bound, tuple):
            return None
        rounded = float(f"{self.reached:.{DIGITS}g}")
        better = self.bound is None or (rounded < self.bound if self.kind == "at_most" else rounded > self.bound)
        return rounded if better else None


def compare(name: str, figures: Mapping[str, Any], folder: Path = EXPECTED) -> list[Bound]:
    """List an experiment's figures that have bounds, with these; empty without a file.

    Raises:
        ConfigError: the file cannot be read.
    """
    path = folder / f"{name}.json"
    reached_by = dict(leaves(plain(figures)))
    found: list[Bound] = []
    for trail, limit in leaves(_bounds_in(path)):
        kind, of = (trail[-1], trail[:-1]) if trail and trail[-1] in KINDS else (KINDS[0], trail)
        pair = kind == "within" and isinstance(limit, list) and len(limit) == 2
        if not all(isinstance(each, int | float) for each in (limit if pair else () if limit is None else (limit,))):
            raise ConfigError(f"{path}: {' / '.join(trail)}: {limit!r} is no bound")
        reached = reached_by.get(of)
        value = float(reached) if isinstance(reached, int | float) and not isinstance(reached, bool) else None
        found.append(Bound(" / ".join(of), kind, tuple(limit) if pair else limit, value, trail))
    return found


def _bounds_in(path: Path) -> dict[str, Any]:
    try:
        tree: dict[str, Any] = json.loads(path.read_bytes()) if path.exists() else {}
    except ValueError as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    return tree


@dataclass(frozen=True)
class Outcome:
    """Figures of a case that was run in full or in part."""

    case: Case  # the case
    seeds: Mapping[int, Row]  # the last run of each seed, by number
    summary: Mapping[str, Any] | None = None  # its figures; None where there are none
    text: str = "no seed has given any rows"  # its figures as text, or why there are none
    missed: Sequence[str] | None = None  # figures that miss their goal; None where the experiment has no goals
    bounds: Sequence[Bound] = ()  # figures with their bounds; only for the quick settings
    broken: bool = True  # whether there are no figures or no plot

    @property
    def failed(self) -> dict[int, str]:
        """Reasons of failed seeds, by number."""
        return {number: str(row["failed"]) for number, row in sorted(self.seeds.items()) if row["failed"]}

    @property
    def remarks(self) -> list[str]:
        """What is wrong with the figures or to be known of them."""
        undone = len(self.case.numbers) - len(self.seeds)
        others = {row["version"] for row in self.seeds.values()} - {code_version()}
        return [
            *([f"{undone} seeds are not done yet"] if undone else []),
            *(f"done by cotarget {other}, this is {code_version()}" for other in sorted(others)),
            *(f"missed: {text}" for text in self.missed or ()),
            *(f"worse than its bound: {bound}" for bound in self.bounds if not bound.kept),
        ]

    @property
    def ok(self) -> bool:
        """Whether all seeds ran and no bound is broken; nor a goal missed, for which a quick run is too short."""
        undone = len(self.case.numbers) - len(self.seeds)
        lost = self.missed and not self.case.quick
        return not (self.broken or self.failed or undone or lost) and all(bound.kept for bound in self.bounds)


def conclude(case: Case, expected: Path = EXPECTED) -> Outcome:
    """Compute a case's figures from its rows; write result.json, rows.csv and the plot.

    Raises:
        ConfigError: a file of bounds cannot be read.
    """
    seeds, files = log_of(case), [rows_file(case, number) for number in sorted(case.numbers)]
    rows = [row for path in files if path.exists() for row in read_rows(path)]
    if not rows:
        return Outcome(case, seeds)
    experiment = case.experiment
    try:
        summary = experiment.summarise(rows)
        text = as_text(summary) if experiment.describe is None else experiment.describe(case.settings, summary)
        missed = None if experiment.missed is None else experiment.missed(summary)
        if experiment.plot is not None:
            write_atomically(case.folder / f"{FIGURE}.png", draw(experiment, rows))
    except Exception as error:  # an incomplete run may lack rows that the figures need
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(last.filename).name}, line {last.lineno}"
        return Outcome(case, seeds, text=f"the rows give no figures: {type(error).__name__}: {error} ({where})")
    told = json.loads((case.folder / "settings.json").read_bytes())
    told["settings"]["seeds"] = case.settings.seeds
    result = plain(told | {"versions": versions(), "summary": summary})
    write_atomically(case.folder / "result.json", (json.dumps(result, indent=2) + "\n").encode())
    write_atomically(case.folder / "rows.csv", csv_of(rows))
    bounds = (
        compare(experiment.name, experiment.bounded(summary), expected) if case.settings == experiment.quick else []
    )
    return Outcome(case, seeds, summary, text, missed, bounds, broken=False)


def draw(experiment: Experiment, rows: Sequence[Row]) -> bytes:
    """Draw an experiment's plot as a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure, png = Figure(figsize=(8, 4.5), layout="constrained"), io.BytesIO()
    FigureCanvasAgg(figure)
    assert experiment.plot is not None
    experiment.plot(rows, figure)
    figure.savefig(png, format="png", dpi=110)
    return png.getvalue()


def tighten(outcomes: Sequence[Outcome], folder: Path = EXPECTED) -> Iterator[str]:
    """Write the values that are better than their bounds, but no times, because machines differ; name each change."""
    for outcome in outcomes:
        experiment = outcome.case.experiment
        if outcome.summary is None or outcome.failed or experiment.alone:
            continue
        path = folder / f"{experiment.name}.json"
        bounds, tree = compare(experiment.name, experiment.bounded(outcome.summary), folder), _bounds_in(path)
        better = [bound for bound in bounds if bound.tighter is not None]
        for bound in better:
            functools.reduce(operator.getitem, bound.trail[:-1], tree)[bound.trail[-1]] = bound.tighter
            yield f"{experiment.name}: {bound} -> {bound.tighter:g}"
        if better:
            write_atomically(path, (json.dumps(tree, indent=2) + "\n").encode())


def write_report(folder: Path, outcomes: Sequence[Outcome], skipped: Mapping[str, str], command: str) -> Path:
    """Write report.html, which needs no other file; give its path.

    ``skipped`` has the reasons of the experiments that were not run; ``command`` repeats the run.

    Raises:
        ConfigError: the page cannot be written.
    """
    wrong = [outcome.case.title for outcome in outcomes if not outcome.ok]
    text = f"{len(wrong)} of {len(outcomes)} experiments failed{': ' if wrong else '.'}{', '.join(wrong)}"
    page = render(
        "report.html",
        Path(__file__).parent,
        heading="The experiments of cotarget",
        about=[command],
        verdict={"level": "bad" if wrong else "good", "text": text},
        label="Failed" if wrong else "Passed",
        overview=_html([_line(outcome) for outcome in outcomes]),
        skipped=_html([{"not run": title, "why": why} for title, why in skipped.items()]),
        cases=[_case(outcome) for outcome in outcomes],
        compared=list(_comparisons(outcomes)),
        command=command,
    )
    write_atomically(folder / "report.html", page.encode())
    return folder / "report.html"


def _html(rows: Sequence[Mapping[str, Any]]) -> str:
    import pandas as pd

    return pd.DataFrame(list(rows)).to_html(index=False, border=0, justify="left") if rows else ""


def _line(outcome: Outcome) -> Row:
    """Give what the overview says of a case."""
    taken = [row["seconds"] for row in outcome.seeds.values()]
    broken = [bound for bound in outcome.bounds if not bound.kept]
    return {
        "experiment": outcome.case.title,
        "goals": "none" if outcome.missed is None else f"{len(outcome.missed)} missed",
        "bounds": f"{len(broken)} of {len(outcome.bounds)} broken",
        "seeds": f"{len(outcome.seeds)} of {len(outcome.case.numbers)}",
        "failed": len(outcome.failed),
        "all seeds [s]": round(sum(taken), 1),
        "longest [s]": round(max(taken, default=0.0), 1),
        "processor [s]": round(sum(row["cpu_s"] for row in outcome.seeds.values()), 1),
        "images": sum(row["renders"] for row in outcome.seeds.values()),
    }


def _case(outcome: Outcome) -> dict[str, Any]:
    """Give what the page says of one case."""
    case = outcome.case
    pictures = [path for path in sorted(case.folder.glob("*.png")) if path.stem != FIGURE or case.experiment.plot]
    tracebacks = {number: case.folder / f"{number:06d}.txt" for number in outcome.failed}
    return {
        "title": case.title,
        "purpose": case.experiment.purpose,
        "text": outcome.text,
        "remarks": outcome.remarks,
        "pictures": [(path.stem, base64.b64encode(path.read_bytes()).decode()) for path in pictures],
        "caption": (inspect.getdoc(case.experiment.plot) or "").partition("\n")[0],
        "bounds": [str(bound) for bound in outcome.bounds],
        "failed": outcome.failed,
        "tracebacks": {number: path.read_text() for number, path in tracebacks.items() if path.exists()},
        "settings": str(case.settings),
        "versions": sorted({row["version"] for row in outcome.seeds.values()}),
    }


def _comparisons(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Make a table for each experiment that was run with several settings, with its figures side by side."""
    for name in dict.fromkeys(outcome.case.experiment.name for outcome in outcomes):
        mine = [each for each in outcomes if each.case.experiment.name == name and each.summary is not None]
        if len(mine) > 1:
            rows: dict[Trail, Row] = {}
            for each in mine:
                for trail, value in leaves(plain(each.summary)):
                    rows.setdefault(trail, {"": f"{name}: {' / '.join(trail)}"})[", ".join(each.case.changes)] = value
            yield _html(list(rows.values()))
