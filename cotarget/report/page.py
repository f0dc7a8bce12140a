"""HTML page of the calibration report, self-contained, with its figures in a folder beside it as well.

The functions before `write_report` make elements of HTML. All text is escaped there and nowhere else.
"""

import base64
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from pathlib import Path

import numpy as np

from cotarget.calibration.file import Calibration, check_covariance
from cotarget.errors import CalibrationError
from cotarget.report import figures
from cotarget.report.analysis import (
    CAMERAS,
    DEPTHS,
    TITLES,
    AtFocal,
    Contribution,
    Evidence,
    averaged,
    between_stops,
    contributions,
    corner_errors,
    gather,
    pointing,
    share_beyond,
)
from cotarget.report.figures import Plot
from cotarget.report.text import (
    LABELS,
    STRONG,
    TOO_CAREFUL,
    Table,
    Verdict,
    advice,
    board_in_words,
    correlations,
    count,
    digits,
    judge,
    key_figures,
    parameter_tables,
    percent,
    provenance,
)


def paragraph(text: str, kind: str = "") -> str:
    """Make a paragraph."""
    return f"<p{_class(kind)}>{escape(text)}</p>"


def section(anchor: str, title: str, parts: Iterable[str]) -> str:
    """Make a section with a heading."""
    body = "\n".join(parts)
    return f'<section id="{escape(anchor)}">\n<h2>{escape(title)}</h2>\n{body}\n</section>'


def header(title: str, about: Sequence[str]) -> str:
    """Make the page's title, with the calibration's source, method and date below."""
    return f"<header><h1>{escape(title)}</h1>{paragraph(' · '.join(about))}</header>"


def verdict(level: str, label: str, text: str) -> str:
    """Make the box with the verdict; the level is good, care, bad or unknown."""
    return f'<div class="verdict {escape(level)}" id="verdict">{paragraph(label, "label")}{paragraph(text)}</div>'


def contents(entries: Sequence[tuple[str, str]]) -> str:
    """Make links to sections, given as anchor and title."""
    links = "".join(f'<li><a href="#{escape(anchor)}">{escape(title)}</a></li>' for anchor, title in entries)
    return f"<nav><ul>{links}</ul></nav>"


def subheading(text: str) -> str:
    """Make a heading within a section."""
    return f"<h3>{escape(text)}</h3>"


def preformatted(text: str) -> str:
    """Make preformatted text, as in a terminal."""
    return f"<pre>{escape(text)}</pre>"


def bullets(items: Sequence[str], ordered: bool = False) -> str:
    """Make a list with bullets, or with numbers if ``ordered``."""
    tag = "ol" if ordered else "ul"
    return f"<{tag}>" + "".join(f"<li>{escape(item)}</li>" for item in items) + f"</{tag}>"


def definitions(pairs: Sequence[tuple[str, str]]) -> str:
    """Make a list of names and values side by side."""
    return '<dl class="figures">' + "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in pairs
    ) + "</dl>"  # fmt: skip


def table(content: Table) -> str:
    """Make a table whose first column names the rows."""
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in content.header)
    body = "".join(
        f'<tr><th scope="row">{escape(first)}</th>' + "".join(f"<td>{escape(cell)}</td>" for cell in rest) + "</tr>"
        for first, *rest in content.rows
    )
    caption = f"<caption>{escape(content.title)}</caption>" if content.title else ""
    written = f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    note = paragraph(content.note, "note") if content.note else ""
    return f'<div class="table">{written}{note}</div>'


def bars(rows: Sequence[tuple[str, float, str]], unit: str) -> str:
    """Make horizontal bars, given as name, share of the width in 0..1, and text beside."""
    body = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td class="bar"><span style="width:{100 * share:.1f}%"></span></td>'
        f"<td>{escape(text)}</td></tr>"
        for name, share, text in rows
    )
    return f'<table class="bars"><tbody>{body}</tbody></table>{paragraph(unit, "note")}'


def folded(summary: str, body: str) -> str:
    """Make a part that opens by a click."""
    return f"<details><summary>{escape(summary)}</summary>{body}</details>"


def figure(picture: Plot) -> str:
    """Make a figure with its image embedded."""
    kind, data = ("svg+xml", picture.svg) if picture.svg is not None else ("png", picture.png)
    text = base64.b64encode(data).decode("ascii")
    image = f'<img alt="{escape(picture.alt)}" src="data:image/{kind};base64,{text}">'
    return f"<figure>{image}<figcaption>{escape(picture.caption)}</figcaption></figure>"


def document(title: str, style: str, body: str) -> str:
    """Make the whole page, which loads nothing else."""
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>\n{body}\n</main>\n</body>\n"
        "</html>\n"
    )


def _class(kind: str) -> str:
    return f' class="{escape(kind)}"' if kind else ""


# The page

FOLDED_FROM = 8  # number of rejected images from which their list is folded
TWO_COLUMNS = 3  # tables with more columns take the whole width
STYLE = Path(__file__).with_name("page.css")


def write_report(path: Path, calibration: Calibration, source: str = "calibration.json") -> Verdict:
    """Write the report on a calibration: the page, and its figures into a folder beside it.

    Args:
        path: file of the page; report.html has its figures in report_pictures.
        calibration: calibration by any method; the page says what it does not hold.
        source: name of the calibration on the page.

    Returns:
        The verdict.

    Raises:
        CalibrationError: a file cannot be written, the covariance is invalid, or the stored corners do not determine
            the boards' poses.
    """
    if calibration.covariance is not None:
        check_covariance(calibration.covariance, len(calibration.zoom.stops))
    at = pointing(calibration)
    between = pointing(calibration, between_stops(calibration))
    evidence = gather(calibration)
    found = judge(calibration, at, between, evidence)
    parts = contributions(calibration)
    made = figures.draw(calibration, at, between, evidence)
    items = advice(calibration, at, between, parts, evidence)
    body = _body(calibration, source, found, at, parts, evidence, made, items)
    page = document(f"Calibration report: {source}", STYLE.read_text(encoding="utf-8"), body)
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
        raise CalibrationError(f"{where}: cannot be written: {error.strerror}") from None


def _body(
    calibration: Calibration,
    source: str,
    found: Verdict,
    at: tuple[AtFocal, ...],
    parts: tuple[Contribution, ...],
    evidence: Evidence | None,
    made: dict[str, Plot],
    items: list[str],
) -> str:
    several = len(calibration.zoom.stops) > 1
    sections = [
        ("figures", "Key figures", _key_figures(calibration)),
        ("pointing", "Predicted pointing error", _pointing(calibration, at, parts, made)),
        ("parameters", "Parameters", _parameters(calibration)),
        ("residuals", "Residuals of the corners", _residuals(calibration, evidence, made)),
        ("coverage", "Where boards were seen", _coverage(evidence, made)),
        *([("lens", "The zoom lens over its focal lengths", [figure(made["lens"])])] if several else []),
        ("heldout", "Captures kept out of the fit", _held_out(calibration)),
        ("rejected", "Images not used", _rejected(calibration)),
        ("advice", "What would make it better", _advice(items)),
    ]
    return "\n".join([_header(calibration, source, found), *(section(*each) for each in sections)])


def _key_figures(calibration: Calibration) -> Iterator[str]:
    yield definitions(key_figures(calibration))
    if calibration.provenance:
        yield folded("Versions, options and origin", table(provenance(calibration)))


def _header(calibration: Calibration, source: str, found: Verdict) -> str:
    when, method = (calibration.provenance.get(key) for key in ("when", "method"))
    about = [source, *([f"{method} method"] if method else []), *([str(when)] if when else [])]
    top = header("Calibration report", about)
    return f"{top}\n{verdict(found.level, LABELS[found.level], found.text)}"


def _pointing(
    calibration: Calibration, at: tuple[AtFocal, ...], parts: tuple[Contribution, ...], made: dict[str, Plot]
) -> Iterator[str]:
    if not at or not np.isfinite(at[-1].rms):
        yield paragraph("Nothing can be predicted: that takes a head, and a fit that tells its uncertainty.")
        return
    near, far = DEPTHS
    middle, corners = corner_errors(calibration, at[-1].nominal_px)
    worst = max(corners.values(), default=np.nan)
    yield paragraph(
        "The angle by which the zoom camera's line of sight misses a target whose pixel and depth are known exactly: "
        f"what the calibration itself leaves, one standard deviation. From {near:g} to {far:g} m and all over the wide "
        f"view it is {digits(np.degrees(at[-1].rms))} degrees (rms) at the longest focal length: "
        f"{digits(np.degrees(middle))} in the middle, {digits(np.degrees(worst))} in the worst corner."
    )
    for name in ("pointing_map", "pointing_depth", "pointing_focal"):
        if name in made:
            yield figure(made[name])
    total = at[-1].rms
    rows = [
        (part.group, 1 - part.left / total, f"{percent(1 - part.left / total)} less") for part in parts if total > 0
    ]
    yield subheading("Where it comes from")
    yield bars(
        [(name, max(share, 0.0), text) for name, share, text in rows],
        "By how much the error would fall if these were known exactly, each by itself. They need not add up, because "
        "parameters that were found together share their errors.",
    )


def _parameters(calibration: Calibration) -> Iterator[str]:
    if calibration.covariance is None:
        yield paragraph("No uncertainty is known.")
    else:
        yield paragraph("Every value with one standard deviation, σ.")
    tables = parameter_tables(calibration)
    narrow = "\n".join(table(t) for t in tables if len(t.header) <= TWO_COLUMNS)
    yield from (table(t) for t in tables if len(t.header) > TWO_COLUMNS)
    yield f'<div class="tables">{narrow}</div>'
    if strong := correlations(calibration):
        yield folded(
            f"Strongest correlations, beyond {STRONG}",
            paragraph("What such a pair does together is known much better than each by itself.") + bullets(strong),
        )


def _residuals(calibration: Calibration, evidence: Evidence | None, made: dict[str, Plot]) -> Iterator[str]:
    if evidence is None:
        yield paragraph("The calibration stores no corners, so that nothing can be checked again.")
        return
    text = "Predicted minus seen, with every board's pose fitted again to the stored corners"
    if calibration.jitter:
        text += "; what the head's jitter explains is taken out"
    yield paragraph(text + ".")
    lines = []
    for name in CAMERAS:
        corners = evidence.corners[name]
        if not len(corners.residuals):
            continue
        cells = averaged(corners)
        known, beyond = int(np.isfinite(cells.means[:, 0]).sum()), int(cells.beyond_chance.sum())
        lines.append(
            f"{TITLES[name].capitalize()}: {len(corners.residuals)} corners, standard deviation "
            f"{digits(corners.sigma)} px a coordinate; {percent(share_beyond(corners.residuals, corners.sigma))} "
            f"beyond three of them (0.3 % of Gaussian ones); {beyond} of {count(known, 'average')} larger than chance "
            "makes it (one in 90 of noise alone)."
        )
    lines.append(board_in_words(evidence.shape))
    yield bullets(lines)
    yield figure(made["residuals"])
    yield figure(made["histogram"])


def _coverage(evidence: Evidence | None, made: dict[str, Plot]) -> Iterator[str]:
    if evidence is None:
        yield paragraph("The calibration stores no corners.")
        return
    yield figure(made["coverage"])
    yield figure(made["situation"])


def _held_out(calibration: Calibration) -> Iterator[str]:
    held_out = calibration.held_out
    if held_out is None:
        yield paragraph(
            "None were kept out: this method does not, or there were too few placements that both cameras saw. What "
            "the fit says of itself is all there is."
        )
        return
    folds = calibration.provenance.get("folds")
    rounds = f"in each of {folds} rounds" if isinstance(folds, int) else "in rounds"
    yield paragraph(
        f"Some placements were left out {rounds}, everything else was fitted again, and the board's place, told by the "
        "fixed camera alone, was used to predict where the zoom camera sees it. That is what pointing does."
    )
    yield table(
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
        yield paragraph(
            f"They disagree: the miss is {digits(held_out.widened)} times what it should be, beyond chance. Something "
            "is not as the model has it. Every uncertainty on this page is widened by that factor already."
        )
    elif held_out.ratio < TOO_CAREFUL:
        yield paragraph(
            "They are predicted better than the calibration says: its uncertainty is larger than it need be, as where "
            "the errors of a few views are taken for those of all."
        )
    else:
        yield paragraph(
            "They agree within chance: the calibration is as good as it says, as far as these placements can tell."
        )


def _rejected(calibration: Calibration) -> Iterator[str]:
    rejected = calibration.residuals.rejected if calibration.residuals is not None else ()
    if not rejected:
        yield paragraph("All were used." if calibration.residuals is not None else "Not recorded.")
        return
    rows = table(Table("", ("image", "reason"), tuple((each.name, each.reason) for each in rejected)))
    yield folded(count(len(rejected), "image"), rows) if len(rejected) >= FOLDED_FROM else rows


def _advice(items: list[str]) -> Iterator[str]:
    if items:
        yield bullets(items, ordered=True)
    else:
        yield paragraph("Nothing stands out.")
