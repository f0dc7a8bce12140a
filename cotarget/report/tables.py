"""The parameters of a calibration with their uncertainty, and its key figures, as rows of text."""

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cotarget.calibration.model import Calibration
from cotarget.calibration.parameters import LENS_NAMES
from cotarget.camera import Intrinsics
from cotarget.geometry import RigidTransform
from cotarget.pantilt import IDEAL_HEAD
from cotarget.report.pointing import sigma_of
from cotarget.report.wording import count, digits, value_and_sigma

LENS_WORDS = {
    "fx": ("focal length across", "px"),
    "fy": ("focal length down", "px"),
    "cx": ("principal point, u", "px"),
    "cy": ("principal point, v", "px"),
    "k1": ("radial distortion k1", ""),
    "k2": ("radial distortion k2", ""),
    "p1": ("tangential distortion p1", ""),
    "p2": ("tangential distortion p2", ""),
}
HEAD_WORDS = {  # words, factor to the unit shown, unit
    "axis_offset": ("offset of the axes", 1000.0, "mm"),
    "squareness": ("axes off the right angle", 180 / np.pi, "degrees"),
    "pan_scale": ("scale of pan", 1.0, ""),
    "tilt_scale": ("scale of tilt", 1.0, ""),
    "pan_zero": ("zero of pan", 180 / np.pi, "degrees"),
    "tilt_zero": ("zero of tilt", 180 / np.pi, "degrees"),
}
STRONG = 0.95  # a correlation worth a word
MOST_CORRELATIONS = 8
STOP = re.compile(r"\[\d+\]")


@dataclass(frozen=True)
class Table:
    """A table of text, with what is to be known of it."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


def parameter_tables(calibration: Calibration) -> list[Table]:
    """All parameters, value ± one standard deviation, in groups."""
    header = ("parameter", "value ± σ", "unit")
    fixed = Table("Fixed camera", header, tuple(_lens(calibration, calibration.fixed, "fixed")), _about_k3(calibration))
    tables = [fixed, *_zoom(calibration)]
    tables.append(_pose_table(calibration, "Offset between the cameras", "T_zoom0_fixed", calibration.T_zoom0_fixed))
    if calibration.T_head_zoom is not None:
        title = "Place of the zoom camera on the head"
        tables.append(_pose_table(calibration, title, "T_head_zoom", calibration.T_head_zoom))
        tables.append(Table("Pan-tilt head", header, tuple(_head(calibration))))
    if calibration.board is not None:
        rows = zip(("x", "y"), calibration.board_warp, strict=True)
        tables.append(Table("Board", header, tuple(_bend(calibration, axis, value) for axis, value in rows)))
    return tables


def _bend(calibration: Calibration, axis: str, value: float) -> tuple[str, ...]:
    sigma = sigma_of(calibration, f"board.warp_{axis}")
    return f"bulge of its middle along {axis}", value_and_sigma(1000 * value, sigma and 1000 * sigma), "mm"


def _held(lens: Intrinsics) -> str:
    return f"k3 is held at {digits(lens.distortion[4], 3)}." if lens.distortion[4] else "k3 is held at 0."


def _about_k3(calibration: Calibration) -> str:
    k3, sigma = calibration.fixed.distortion[4], sigma_of(calibration, "fixed.k3")
    if sigma is None:
        return _held(calibration.fixed)
    if not k3:
        return f"k3 is held at 0; the corners lean to one of {digits(sigma, 1)}, a doubt that is counted everywhere."
    return f"The corners ask for k3: it is {value_and_sigma(k3, sigma)}. Beyond the boards such a lens is less certain."


def _numbers(lens: Intrinsics) -> dict[str, float]:
    return dict(zip(LENS_NAMES, (*lens.focal_px, *lens.center_px, *lens.distortion), strict=False))


def _lens(calibration: Calibration, lens: Intrinsics, owner: str) -> Iterator[tuple[str, ...]]:
    for name, value in _numbers(lens).items():
        words, unit = LENS_WORDS[name]
        yield words, value_and_sigma(value, sigma_of(calibration, f"{owner}.{name}")), unit


def _zoom(calibration: Calibration) -> list[Table]:
    lens = calibration.zoom
    if len(lens.stops) == 1:
        title = f"Zoom camera (nominal focal length {lens.nominal_px[0]:.0f} px)"
        rows = tuple(_lens(calibration, lens.stops[0], "zoom[0]"))
        return [Table(title, ("parameter", "value ± σ", "unit"), rows, _held(lens.stops[0]))]
    lengths, bent = [], []
    for i, (nominal, stop, pupil) in enumerate(zip(lens.nominal_px, lens.stops, lens.pupil, strict=True)):
        cells = {
            name: value_and_sigma(value, sigma_of(calibration, f"zoom[{i}].{name}"))
            for name, value in _numbers(stop).items()
        }
        sigma = sigma_of(calibration, f"zoom[{i}].pupil")
        moved = "0" if i == 0 else value_and_sigma(1000 * pupil, None if sigma is None else 1000 * sigma)
        first = f"{nominal:.0f}"
        lengths.append((first, cells["fx"], cells["fy"], cells["cx"], cells["cy"], moved))
        bent.append((first, *(cells[name] for name in ("k1", "k2", "p1", "p2"))))
    return [
        Table("Zoom camera", ("nominal px", "fx [px]", "fy [px]", "cx [px]", "cy [px]", "pupil [mm]"), tuple(lengths)),
        Table(
            "Zoom camera's distortion",
            ("nominal px", "k1", "k2", "p1", "p2"),
            tuple(bent),
            "In units of the focal length: the same bend in the image has a k1 that grows with its square.",
        ),
    ]


def _pose_table(calibration: Calibration, title: str, name: str, T: RigidTransform) -> Table:
    rows = []
    for axis, value in zip("xyz", 1000 * T.translation, strict=True):
        sigma = sigma_of(calibration, f"{name}.t{axis}")
        rows.append((f"position {axis}", value_and_sigma(value, sigma and 1000 * sigma), "mm"))
    for axis, value in zip("xyz", T.rotation.as_rotvec(degrees=True), strict=True):
        sigma = sigma_of(calibration, f"{name}.r{axis}")
        rows.append((f"rotation vector {axis}", value_and_sigma(value, sigma and np.degrees(sigma)), "degrees"))
    length = 1000 * float(np.linalg.norm(T.translation))
    rows.append(("distance", value_and_sigma(length, _length_sigma_mm(calibration, name, T)), "mm"))
    note = "The uncertainty of the rotation is that of a turn about the axes of the frame that the transform leads to."
    return Table(f"{title} ({name})", ("parameter", "value ± σ", "unit"), tuple(rows), note)


def _length_sigma_mm(calibration: Calibration, name: str, T: RigidTransform) -> float | None:
    covariance, length = calibration.covariance, np.linalg.norm(T.translation)
    names = [f"{name}.t{axis}" for axis in "xyz"]
    if covariance is None or not length or any(n not in covariance.parameters for n in names):
        return None
    where = [covariance.parameters.index(n) for n in names]
    along = T.translation / length
    return float(1000 * np.sqrt(along @ covariance.matrix[np.ix_(where, where)] @ along))


def _head(calibration: Calibration) -> Iterator[tuple[str, ...]]:
    for name, (words, factor, unit) in HEAD_WORDS.items():
        value, sigma = getattr(calibration.head, name), sigma_of(calibration, f"head.{name}")
        if sigma is None and name.startswith(("pan", "tilt")) and value == getattr(IDEAL_HEAD, name):
            continue
        yield words, value_and_sigma(factor * value, sigma and factor * sigma), unit
    yield "jitter of each axis", digits(float(np.degrees(calibration.jitter))), "degrees"


def correlations(calibration: Calibration) -> list[str]:
    """The strongest correlations between parameters, in words."""
    covariance = calibration.covariance
    if covariance is None:
        return []
    scale = np.sqrt(np.diagonal(covariance.matrix))
    with np.errstate(invalid="ignore", divide="ignore"):
        R = covariance.matrix / np.outer(scale, scale)
    pairs = [
        (float(R[i, j]), covariance.parameters[i], covariance.parameters[j])
        for i, j in zip(*np.triu_indices(len(scale), 1), strict=True)
        if abs(R[i, j]) > STRONG
    ]
    pairs.sort(key=lambda pair: -abs(pair[0]))
    # Of the same two parameters of several stops, the strongest speaks for all.
    kinds = {tuple(STOP.sub("[]", name) for name in pair[1:]): pair for pair in reversed(pairs)}
    strongest = sorted(kinds.values(), key=lambda pair: -abs(pair[0]))[:MOST_CORRELATIONS]
    return [f"{a} with {b}: {r:+.4f}" for r, a, b in strongest]


def key_figures(calibration: Calibration) -> list[tuple[str, str]]:
    """Name and value of what is asked first."""
    found: list[tuple[str, str]] = []
    board, residuals, held_out = calibration.board, calibration.residuals, calibration.held_out
    if board is not None:
        columns, rows = board.corners
        side = digits(1000 * board.square, 4)
        found.append(("Board", f"{board.kind}, {columns} × {rows} inner corners, squares of {side} mm"))
    if calibration.views:
        found.append(("Placements", str(len({view.board for view in calibration.views}))))
    if residuals is not None:
        used = f"{residuals.fixed_views} of the fixed camera, {residuals.zoom_views} of the zoom camera"
        found.append(("Views used", used))
        found.append(("Placements seen by both at home", str(residuals.pairs)))
        not_used = f"{count(len(residuals.rejected), 'image')}, {count(residuals.outliers, 'single corner')}"
        found.append(("Not used", not_used))
        parts = {
            "Rms, fixed camera alone": residuals.fixed_rms_px,
            "Rms, zoom camera alone": residuals.zoom_rms_px,
            "Rms, both cameras at home": residuals.stereo_rms_px,
            "Rms, zoom camera through the head": residuals.handeye_rms_px,
        }
        found += [(name, f"{digits(value, 3)} px") for name, value in parts.items() if value is not None]
    if held_out is not None:
        against = f"{digits(held_out.measured_px)} px measured, {digits(held_out.predicted_px)} px predicted"
        found.append(("Kept out of the fit", against))
    jitter = f"{digits(float(np.degrees(calibration.jitter)))} degrees an axis" if calibration.jitter else "none found"
    found.append(("Head's jitter", jitter))
    for name, camera in (("fixed", calibration.fixed), ("zoom", calibration.zoom.stops[0])):
        across = 2 * np.degrees(np.arctan(camera.size[0] / 2 / camera.focal_px[0]))
        found.append((f"Image, {name} camera", f"{camera.size[0]} × {camera.size[1]} px, about {across:.0f}° across"))
    if calibration.pitch_mm is not None:
        found.append(("Pixel of the zoom camera", f"{digits(1000 * calibration.pitch_mm, 3)} µm"))
    names = {"method": "Method", "when": "Made", "cotarget": "Version of cotarget"}
    found += [(word, str(calibration.provenance[key])) for key, word in names.items() if key in calibration.provenance]
    return found


def provenance(calibration: Calibration) -> Table:
    """Everything that the calibration tells of where it comes from."""
    rows = tuple((str(key), str(value)) for key, value in calibration.provenance.items())
    return Table("", ("what", "value"), rows)
