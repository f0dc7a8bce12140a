"""HTML page of the calibration report, self-contained; its figures are in a folder beside it too.

The page's text and layout are `templates/calibration.html`.
"""

import tempfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from cotarget.calibration.file import Calibration
from cotarget.calibration.model import CAMERAS
from cotarget.errors import ConfigError
from cotarget.report import figures
from cotarget.report.analysis import (
    DEPTHS,
    TITLES,
    Analysis,
    Evidence,
    analyse,
    averaged,
    corner_errors,
)
from cotarget.report.figures import Plot
from cotarget.report.text import (
    LABELS,
    TOO_CAREFUL,
    Verdict,
    advice,
    board_in_words,
    count,
    digits,
    judge,
    key_figures,
    parameter_tables,
    percent,
)

FOLDED_FROM = 8  # number of rejected images from which their list is folded
TWO_COLUMNS = 3  # tables with more columns take the whole width
TEMPLATES = Path(__file__).with_name("templates")


def render(template: str, *folders: Path, **context: Any) -> str:
    """Render a page from a template in the report's folder of templates, or in one of these folders."""
    return _environment(folders).get_template(template).render(**context)


@lru_cache
def _environment(folders: tuple[Path, ...]) -> jinja2.Environment:
    """Make the environment of templates, which escapes all text."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([TEMPLATES, *folders]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "count": count,
        "degrees": lambda angle: digits(float(np.degrees(angle))),
        "digits": digits,
        "percent": percent,
    }
    return environment


def write_report(path: Path, calibration: Calibration, source: str = "calibration.json") -> Verdict:
    """Write the report on a calibration: the page, and its figures into a folder beside it.

    Args:
        path: file of the page; report.html has its figures in report_pictures.
        calibration: calibration by any method.
        source: name of the calibration on the page.

    Returns:
        The verdict.

    Raises:
        CalibrationError: the stored corners do not determine the boards' poses.
        ConfigError: a file cannot be written.
    """
    analysis = analyse(calibration)
    found = judge(calibration, analysis)
    made = figures.draw(calibration, analysis)
    used = calibration.residuals
    when, method = (calibration.provenance.get(key) for key in ("when", "method"))
    page = render(
        "calibration.html",
        heading="Calibration report",
        source=source,
        about=[source, *([f"{method} method"] if method else []), *([str(when)] if when else [])],
        verdict=found,
        label=LABELS[found.level],
        calibration=calibration,
        figures=made,
        key_figures=key_figures(calibration),
        pointing=_pointing(calibration, analysis),
        tables=parameter_tables(calibration),
        two_columns=TWO_COLUMNS,
        residuals=None if analysis.evidence is None else _residuals(analysis.evidence),
        too_careful=TOO_CAREFUL,
        rejected=[] if used is None else [(one.name, one.reason) for one in used.rejected],
        folded_from=FOLDED_FROM,
        advice=advice(calibration, analysis),
    )
    _write(path, page, made)
    return found


def _write(path: Path, page: str, made: dict[str, Plot]) -> None:
    """Write page and figures once all are made, and remove figures of an earlier report that this one lacks."""
    folder = path.with_name(f"{path.stem}_pictures")
    files = {folder / f"{name}.png": picture.png for name, picture in made.items()} | {path: page.encode()}
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}.", ignore_cleanup_errors=True) as parts:
            for file, data in files.items():
                (Path(parts) / file.name).write_bytes(data)
            folder.mkdir(exist_ok=True)
            for file in files:
                (Path(parts) / file.name).replace(file)
        for name in figures.FIGURE_NAMES:
            if name not in made:
                (folder / f"{name}.png").unlink(missing_ok=True)
    except OSError as error:
        where = folder if folder.exists() and not folder.is_dir() else path
        raise ConfigError(f"{where}: cannot be written: {error.strerror}") from None


def _pointing(calibration: Calibration, found: Analysis) -> dict[str, Any] | None:
    """Compute the page's figures of the predicted error; None where nothing can be predicted."""
    at = found.at
    if not at or not np.isfinite(at[-1].rms):
        return None
    middle, corners = corner_errors(calibration, at[-1].nominal_px)
    total = at[-1].rms
    return {
        "near": DEPTHS[0],
        "far": DEPTHS[1],
        "rms": total,
        "middle": middle,
        "worst": max(corners.values(), default=np.nan),
        "gains": [(group, 1 - left / total) for group, left in found.parts.items() if total > 0],
    }


def _residuals(evidence: Evidence) -> list[str]:
    """Describe the residuals of each camera's corners, and the board's shape that they show."""
    lines = []
    for name in CAMERAS:
        corners = evidence.corners[name]
        if not len(corners.residuals):
            continue
        cells = averaged(corners)
        known, beyond = int(np.isfinite(cells.means[:, 0]).sum()), int(cells.beyond_chance.sum())
        lines.append(
            f"{TITLES[name].capitalize()}: {len(corners.residuals)} corners, standard deviation "
            f"{digits(corners.sigma)} px a coordinate; {beyond} of {count(known, 'average')} larger than chance makes "
            "it (one in 90 of noise alone)."
        )
    return [*lines, board_in_words(evidence.shape)]
