"""The report on a calibration: one HTML page that needs nothing beside it, and its pictures in a folder."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cotarget.calibration.model import Calibration
from cotarget.calibration.reading import check_covariance
from cotarget.errors import CalibrationError
from cotarget.report import markup, pictures
from cotarget.report.advice import advice, board_in_words
from cotarget.report.evidence import CAMERAS, Evidence, averaged, gather, share_beyond
from cotarget.report.figures import NAMES
from cotarget.report.markup import Picture
from cotarget.report.pointing import (
    DEPTHS,
    AtFocal,
    Contribution,
    between_stops,
    contributions,
    corner_errors,
    pointing,
)
from cotarget.report.tables import STRONG, Table, correlations, key_figures, parameter_tables, provenance
from cotarget.report.verdict import LABELS, TOO_CAREFUL, Verdict, judge
from cotarget.report.wording import count, digits, percent

FOLDED_FROM = 8  # a longer list of rejected images is folded
TWO_COLUMNS = 3  # tables with more columns take the whole width
STYLE = Path(__file__).with_name("page.css")


def write_report(path: Path, calibration: Calibration, source: str = "calibration.json") -> Verdict:
    """Write the page, which is replaced in one step, and its pictures into a folder beside it.

    Args:
        path: of the page; report.html has its pictures in report_pictures.
        calibration: of any kind; what it does not tell is left out and said.
        source: how the page calls the calibration.

    Returns:
        The verdict.

    Raises:
        CalibrationError: a file cannot be written, or the calibration contradicts itself.
    """
    if calibration.covariance is not None:
        check_covariance(calibration.covariance, len(calibration.zoom.stops))
    at = pointing(calibration)
    between = pointing(calibration, between_stops(calibration))
    evidence = gather(calibration)
    found = judge(calibration, at, between, evidence)
    parts = contributions(calibration)
    made = pictures.draw(calibration, at, between, evidence)
    items = advice(calibration, at, between, parts, evidence)
    body = _body(calibration, source, found, at, parts, evidence, made, items)
    page = markup.document(f"Calibration report: {source}", STYLE.read_text(encoding="utf-8"), body)
    _write(path, page, made)
    return found


def _write(path: Path, page: str, made: dict[str, Picture]) -> None:
    """Write page and pictures, all or nothing; pictures of an earlier report that this one does not have go."""
    folder = path.with_name(f"{path.stem}_pictures")
    files = {folder / f"{name}.png": picture.png for name, picture in made.items()} | {path: page.encode()}
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}.", ignore_cleanup_errors=True) as parts:
            for file, data in files.items():
                (Path(parts) / file.name).write_bytes(data)
            folder.mkdir(exist_ok=True)
            for file in files:
                (Path(parts) / file.name).replace(file)
        for name in pictures.NAMES:
            if name not in made:
                (folder / f"{name}.png").unlink(missing_ok=True)
    except OSError as error:
        where = folder if folder.exists() and not folder.is_dir() else path
        raise CalibrationError(f"{where}: cannot be written: {error.strerror}") from None


def _body(
    calibration: Calibration,
    source: str,
    found: Verdict,
    at: tuple[AtFocal, ...],
    parts: tuple[Contribution, ...],
    evidence: Evidence | None,
    made: dict[str, Picture],
    items: list[str],
) -> str:
    several = len(calibration.zoom.stops) > 1
    sections = [
        ("figures", "Key figures", _key_figures(calibration)),
        ("pointing", "Predicted pointing error", _pointing(calibration, at, parts, made)),
        ("parameters", "Parameters", _parameters(calibration)),
        ("residuals", "Residuals of the corners", _residuals(calibration, evidence, made)),
        ("coverage", "Where boards were seen", _coverage(evidence, made)),
        *([("lens", "The zoom lens over its focal lengths", [markup.figure(made["lens"])])] if several else []),
        ("heldout", "Captures kept out of the fit", _held_out(calibration)),
        ("rejected", "Images not used", _rejected(calibration)),
        ("advice", "What would make it better", _advice(items)),
    ]
    return "\n".join([_header(calibration, source, found), *(markup.section(*each) for each in sections)])


def _key_figures(calibration: Calibration) -> Iterator[str]:
    yield markup.definitions(key_figures(calibration))
    if calibration.provenance:
        yield markup.folded("Versions, options and origin", markup.table(provenance(calibration)))


def _header(calibration: Calibration, source: str, found: Verdict) -> str:
    when, method = (calibration.provenance.get(key) for key in ("when", "method"))
    about = [source, *([f"{method} method"] if method else []), *([str(when)] if when else [])]
    header = markup.header("Calibration report", about)
    return f"{header}\n{markup.verdict(found.level, LABELS[found.level], found.text)}"


def _pointing(
    calibration: Calibration, at: tuple[AtFocal, ...], parts: tuple[Contribution, ...], made: dict[str, Picture]
) -> Iterator[str]:
    if not at or not np.isfinite(at[-1].rms):
        yield markup.paragraph("Nothing can be predicted: that takes a head, and a fit that tells its uncertainty.")
        return
    near, far = DEPTHS
    middle, corners = corner_errors(calibration, at[-1].nominal_px)
    worst = max(corners.values(), default=np.nan)
    yield markup.paragraph(
        "The angle by which the zoom camera's line of sight misses a target whose pixel and depth are known exactly: "
        f"what the calibration itself leaves, one standard deviation. From {near:g} to {far:g} m and all over the wide "
        f"view it is {digits(np.degrees(at[-1].rms))} degrees (rms) at the longest focal length: "
        f"{digits(np.degrees(middle))} in the middle, {digits(np.degrees(worst))} in the worst corner."
    )
    for name in ("pointing_map", "pointing_depth", "pointing_focal"):
        if name in made:
            yield markup.figure(made[name])
    total = at[-1].rms
    rows = [
        (part.group, 1 - part.left / total, f"{percent(1 - part.left / total)} less") for part in parts if total > 0
    ]
    yield markup.subheading("Where it comes from")
    yield markup.bars(
        [(name, max(share, 0.0), text) for name, share, text in rows],
        "By how much the error would fall if these were known exactly, each by itself. They need not add up, because "
        "parameters that were found together share their errors.",
    )


def _parameters(calibration: Calibration) -> Iterator[str]:
    if calibration.covariance is None:
        yield markup.paragraph("No uncertainty is known.")
    else:
        yield markup.paragraph("Every value with one standard deviation, σ.")
    tables = parameter_tables(calibration)
    narrow = "\n".join(markup.table(t) for t in tables if len(t.header) <= TWO_COLUMNS)
    yield from (markup.table(t) for t in tables if len(t.header) > TWO_COLUMNS)
    yield f'<div class="tables">{narrow}</div>'
    if strong := correlations(calibration):
        yield markup.folded(
            f"Strongest correlations, beyond {STRONG}",
            markup.paragraph("What such a pair does together is known much better than each by itself.")
            + markup.bullets(strong),
        )


def _residuals(calibration: Calibration, evidence: Evidence | None, made: dict[str, Picture]) -> Iterator[str]:
    if evidence is None:
        yield markup.paragraph("The calibration stores no corners, so that nothing can be checked again.")
        return
    text = "Predicted minus seen, with every board's pose fitted again to the stored corners"
    if calibration.jitter:
        text += "; what the head's jitter explains is taken out"
    yield markup.paragraph(text + ".")
    lines = []
    for name in CAMERAS:
        corners = evidence.corners[name]
        if not len(corners.residuals):
            continue
        cells = averaged(corners)
        known, beyond = int(np.isfinite(cells.means[:, 0]).sum()), int(cells.beyond_chance.sum())
        lines.append(
            f"{NAMES[name].capitalize()}: {len(corners.residuals)} corners, standard deviation "
            f"{digits(corners.sigma)} px a coordinate; {percent(share_beyond(corners.residuals, corners.sigma))} "
            f"beyond three of them (0.3 % of Gaussian ones); {beyond} of {count(known, 'average')} larger than chance "
            "makes it (one in 90 of noise alone)."
        )
    lines.append(board_in_words(evidence.shape))
    yield markup.bullets(lines)
    yield markup.figure(made["residuals"])
    yield markup.figure(made["histogram"])


def _coverage(evidence: Evidence | None, made: dict[str, Picture]) -> Iterator[str]:
    if evidence is None:
        yield markup.paragraph("The calibration stores no corners.")
        return
    yield markup.figure(made["coverage"])
    yield markup.figure(made["situation"])


def _held_out(calibration: Calibration) -> Iterator[str]:
    held_out = calibration.held_out
    if held_out is None:
        yield markup.paragraph(
            "None were kept out: this method does not, or there were too few placements that both cameras saw. What "
            "the fit says of itself is all there is."
        )
        return
    folds = calibration.provenance.get("folds")
    rounds = f"in each of {folds} rounds" if isinstance(folds, int) else "in rounds"
    yield markup.paragraph(
        f"Some placements were left out {rounds}, everything else was fitted again, and the board's place, told by the "
        "fixed camera alone, was used to predict where the zoom camera sees it. That is what pointing does."
    )
    yield markup.table(
        Table(
            "",
            ("", "rms"),
            (
                ("distance measured", f"{digits(held_out.measured_px, 3)} px"),
                ("distance predicted", f"{digits(held_out.predicted_px, 3)} px"),
                ("single corners, their board's pose fitted", f"{digits(held_out.corners_rms_px, 3)} px"),
                ("every distance over what was predicted of it", digits(held_out.ratio, 3)),
            ),
            f"Of {count(held_out.views, 'view')} of the zoom camera, brought to the shortest focal length.",
        )
    )
    if held_out.widened > 1:
        yield markup.paragraph(
            f"They disagree: the miss is {digits(held_out.widened)} times what it should be, beyond chance. Something "
            "is not as the model has it. Every uncertainty on this page is widened by that factor already."
        )
    elif held_out.ratio < TOO_CAREFUL:
        yield markup.paragraph(
            "They are predicted better than the calibration says: its uncertainty is larger than it need be, as where "
            "the errors of a few views are taken for those of all."
        )
    else:
        yield markup.paragraph(
            "They agree within chance: the calibration is as good as it says, as far as these placements can tell."
        )


def _rejected(calibration: Calibration) -> Iterator[str]:
    rejected = calibration.residuals.rejected if calibration.residuals is not None else ()
    if not rejected:
        yield markup.paragraph("All were used." if calibration.residuals is not None else "Not recorded.")
        return
    rows = markup.table(Table("", ("image", "reason"), tuple((each.name, each.reason) for each in rejected)))
    yield markup.folded(count(len(rejected), "image"), rows) if len(rejected) >= FOLDED_FROM else rows


def _advice(items: list[str]) -> Iterator[str]:
    if items:
        yield markup.bullets(items, ordered=True)
    else:
        yield markup.paragraph("Nothing stands out.")
