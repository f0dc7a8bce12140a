"""Results of a case: its figures as text and picture, beside its goals and bounds."""

import inspect
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiments.engine.bounds import EXPECTED, Bound, compare
from experiments.engine.cases import Case
from experiments.engine.harness import Row
from experiments.engine.pictured import shown
from experiments.engine.results import NOTHING, Record, Spent, code_version


@dataclass(frozen=True)
class Outcome:
    """Result of a case that was run in full or in part.

    Attributes:
        case: the case.
        records: results of its jobs, by number.
        summary: its figures; None where there are none.
        text: its figures as text.
        missed: figures that miss their goal; None where the experiment has no goals.
        bounds: figures with their bounds; only for the quick settings.
        picture: the plot as a PNG.
        caption: caption of the plot.
        broken: why there are no figures or no picture.
        pictures: PNGs by name, from the first job that has any.
        shared: cost of preparing what its jobs share.
    """

    case: Case
    records: Mapping[int, Record]
    summary: Mapping[str, Any] | None = None
    text: str = ""
    missed: tuple[str, ...] | None = None
    bounds: tuple[Bound, ...] = ()
    picture: bytes | None = None
    caption: str = ""
    broken: str = ""
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    shared: Spent = NOTHING

    @property
    def failed(self) -> dict[int, Record]:
        """Failed jobs by number."""
        return {number: record for number, record in sorted(self.records.items()) if record.failed}

    @property
    def pictured(self) -> int | None:
        """Number of the first job that has pictures."""
        return next((number for number, record in sorted(self.records.items()) if record.pictures), None)

    @property
    def undone(self) -> int:
        """Number of jobs that have not run."""
        return len(self.case.numbers) - len(self.records)

    @property
    def worse(self) -> tuple[Bound, ...]:
        """Figures beyond their bounds."""
        return tuple(bound for bound in self.bounds if not bound.kept)

    @property
    def seconds(self) -> list[float]:
        """Wall times of the jobs [s]."""
        return [record.seconds for record in self.records.values()]

    @property
    def cpu_s(self) -> float:
        """Processor time of the jobs and of their preparation [s]."""
        return self.shared.cpu_s + sum(record.cpu_s for record in self.records.values())

    @property
    def renders(self) -> int:
        """Number of pictures that MuJoCo drew for the jobs and their preparation."""
        return self.shared.renders + sum(record.renders for record in self.records.values())

    @property
    def other_code(self) -> tuple[str, ...]:
        """Versions of other code than this that jobs were run with."""
        return tuple(sorted({record.version for record in self.records.values()} - {code_version()}))

    @property
    def ok(self) -> bool:
        """Whether all jobs ran and no figure misses its goal or bound.

        A quick run is too short for the goals; only its bounds count.
        """
        lost = () if self.case.quick else self.missed
        return not (self.failed or self.undone or self.broken or lost or self.worse)


def conclude(
    case: Case, records: Mapping[int, Record], folder: Path, expected: Path = EXPECTED, shared: Spent = NOTHING
) -> Outcome:
    """Compute a case's figures from its rows; write result.json, rows.csv, figure.png and other pictures.

    Args:
        case: case that was run.
        records: results of its jobs.
        folder: folder for the files.
        expected: folder of the bounds.
        shared: cost of preparing what the jobs share.

    Raises:
        ConfigError: a file of bounds cannot be read.
    """
    rows = [row for _, record in sorted(records.items()) for row in record.rows or ()]
    if not rows:
        return Outcome(case, records, broken="no job has given any rows", shared=shared)
    experiment = case.experiment
    try:
        summary = experiment.summarise(rows)
        text = experiment.describe(case.settings, summary)
        missed = None if experiment.missed is None else tuple(experiment.missed(summary))
    except Exception as error:  # an incomplete run may lack rows that the figures need
        return Outcome(case, records, broken=f"the rows give no figures: {_where(error)}", shared=shared)
    picture, broken = _draw(case, rows)
    pictures = shown(record.pictures for _, record in sorted(records.items()))
    experiment.write(folder, case.settings, rows, summary, picture, pictures)
    bounds = tuple(compare(experiment, summary, expected)) if case.has_bounds else ()
    caption = (inspect.getdoc(experiment.plot) or "").partition("\n")[0]
    return Outcome(case, records, summary, text, missed, bounds, picture, caption, broken, pictures, shared)


def _draw(case: Case, rows: list[Row]) -> tuple[bytes | None, str]:
    try:
        return case.experiment.picture(rows), ""
    except Exception as error:
        return None, f"the rows cannot be drawn: {_where(error)}"


def _where(error: Exception) -> str:
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(last.filename).name}, line {last.lineno})"
