"""Text of the calibration report: verdict, advice, tables of parameters, key figures, and number formatting."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from cotarget.calibration.bundle import LENS_NAMES
from cotarget.calibration.file import Calibration
from cotarget.calibration.model import CAMERAS
from cotarget.calibration.observability import BOTH, FARTHER, NEARER, OUTWARD, TILT_BOARDS, listed
from cotarget.calibration.planning import distance
from cotarget.camera import Intrinsics
from cotarget.geometry import RigidTransform
from cotarget.pantilt import IDEAL_HEAD
from cotarget.report.analysis import (
    DEPTHS,
    JITTER_GROUP,
    MORE_PLACEMENTS,
    TITLES,
    Analysis,
    AtFocal,
    BoardShape,
    Evidence,
    analyse,
    corner_errors,
    empty_places,
    head_poses,
    left_open,
    placements,
    sigma_of,
    uncalibrated_px,
    what_stays,
    with_more_placements,
)

ACTIONS = {
    "the fixed camera's lens": f"in the fixed camera's view, {OUTWARD}, and {TILT_BOARDS}",
    "the zoom camera's lens": f"in the zoom camera's view, {OUTWARD}, and {TILT_BOARDS}",
    "the zoom lens's pupil": "show boards near and far at the long focal lengths",
    "the offset between the cameras": BOTH,
    "the zoom camera's place on the head": NEARER,
    "the head's axes": NEARER,
    "the encoders": "calibrate with --encoders, and move both pan and tilt from end to end",
    JITTER_GROUP: "look for play in the gears, cables that pull, a mount that gives way, and wait longer after a move",
}
WORTH_SAYING = 0.1  # share of the squared error from which a group is mentioned
MUCH_WORSE = 3.0  # ratio of errors from which a place or focal length is mentioned
FAR_SHARE, FEW_FAR = 0.5, 0.25  # share of the way from near to far beyond which boards are far; smallest share of these
LEAST_TURN = np.radians(10.0)  # smallest range of each axis of the head over all poses
TURNED, FEW_TURNED = np.radians(20.0), 1 / 3  # tilt that determines the focal length; smallest share of boards with it
FEWEST_AT_STOP = 6  # fewest views of a zoom sample
FEWEST_SHARED = 5  # fewest placements seen by both cameras, so that some can be kept out
MANY_WRONG = 0.01  # largest share of wrong corners


def advice(calibration: Calibration, found: Analysis) -> list[str]:
    """List what to do about a calibration, roughly the most useful first; empty where nothing stands out."""
    evidence = found.evidence
    wrong_board = evidence is not None and evidence.shape.wrong
    items = [*_missing(calibration)]
    if evidence is not None and wrong_board:
        bent = evidence.shape.out > evidence.shape.within
        mend = (
            "Mount the board on something flat and rigid" if bent else "Print the board, measure its squares both ways"
        )
        items.append(f"{mend}, and capture all images again: more of this board do not help.")
    else:
        items += _largest_parts(found)
    items += _worst_places(calibration, found)
    if evidence is not None:
        items += [*_boards(calibration, evidence), *_head_and_lens(calibration, evidence)]
        items += [] if wrong_board else _more_of_the_same(calibration, found.at)
    return items


def _missing(calibration: Calibration) -> Iterator[str]:
    """Advise on a wrong model, and on what the calibration lacks."""
    held_out = calibration.held_out
    if held_out is not None and held_out.widened > 1:
        yield (
            "Look for a board that is bent or not printed to scale, a mount that gives way, a lens that moved between "
            "captures: more captures do not help."
        )
    if open_ := left_open(calibration):
        yield f"Add what is missing: {open_}."
    if calibration.zoom_head.T_head_zoom is None:
        yield "Calibrate on a rig whose head moves: two cameras alone cannot be pointed."
    if calibration.provenance.get("method") == "sequential":
        yield "Calibrate again by the joint method, from the same captures."
    elif calibration.covariance is None:
        yield "Add placements, near and far, in both cameras, until the method gives an uncertainty."
    elif held_out is None and calibration.provenance.get("folds"):
        shared = [{v.board for v in calibration.views if v.camera == camera} for camera in CAMERAS]
        number = len(shared[0] & shared[1])
        yield (
            f"Show both cameras {FEWEST_SHARED} placements or more ({number} so far), so that some can be kept out of "
            "the fit."
        )


def _largest_parts(found: Analysis) -> Iterator[str]:
    """Advise on the groups of parameters that contribute most to the error."""
    total = found.at[-1].rms if found.at else 0.0
    for group, left in list(found.parts.items())[:2] if total > 0 else ():
        if 1 - (left / total) ** 2 > WORTH_SAYING:
            yield (
                f"Without the part of {group} the error would be {_degrees(left)} instead of {_degrees(total)} "
                f"degrees: {ACTIONS.get(group, BOTH)}."
            )


def _worst_places(calibration: Calibration, found: Analysis) -> Iterator[str]:
    """Advise where pointing is much worse than elsewhere: between zoom samples, or in a corner of the fixed image."""
    if not found.at:
        return
    worst = max(found.between, key=lambda one: one.rms, default=None)
    if worst is not None and worst.rms > MUCH_WORSE * max(stop.rms for stop in found.at):
        yield (
            f"Add a zoom sample at a nominal {worst.nominal_px:.0f} px, where the lens is only interpolated: the error "
            f"is {_degrees(worst.rms)} degrees."
        )
    middle, corners = corner_errors(calibration, found.at[-1].nominal_px)
    name, error = max(corners.items(), key=lambda item: item[1], default=("", 0.0))
    if error > MUCH_WORSE * middle:
        yield (
            f"Hold boards in the {name} corner of the fixed image, as far out as they are still seen: the error there "
            f"is {digits(error / middle)} times that in the middle."
        )


def board_in_words(shape: BoardShape) -> str:
    """Describe how far the board's corners are off their nominal positions."""
    number = int(shape.beyond_chance.sum())
    if not number:
        return "The board's corners are at their nominal positions, within noise."
    return (
        f"{number} of the board's {len(shape.beyond_chance)} corners are off by more than chance makes them: of all "
        f"corners {digits(1000 * shape.within)} mm within the board and {digits(1000 * shape.out)} mm out of it (rms)."
    )


def _boards(calibration: Calibration, evidence: Evidence) -> Iterator[str]:
    """Advise on how boards were held and seen."""
    corners = sum(len(evidence.corners[name].seen_px) for name in CAMERAS)
    if calibration.residuals is not None and calibration.residuals.outliers > MANY_WRONG * corners:
        wrong = count(calibration.residuals.outliers, "corner")
        yield f"Look for blur, glare, and a board that is not flat: {wrong} were left out as wrong."
    for name in CAMERAS:
        if places := empty_places(evidence.corners[name]):
            yield f"Hold boards where the {TITLES[name]} saw none: at the {listed(places)} of its image."
    number = len(evidence.distances)
    turned = int(np.count_nonzero(evidence.leanings >= TURNED))
    if turned < FEW_TURNED * number:
        yield f"Only {turned} of {count(number, 'placement')} were turned by 20 degrees or more: {TILT_BOARDS}."
    if calibration.zoom_head.T_head_zoom is None or calibration.board is None:
        return
    limit = distance(calibration.board, calibration.fixed.lens, FAR_SHARE)
    far = int(np.count_nonzero(evidence.distances > limit))
    if far < FEW_FAR * number:
        yield f"Only {far} of {count(number, 'placement')} are farther than {digits(limit)} m: add far ones."


def _head_and_lens(calibration: Calibration, evidence: Evidence) -> Iterator[str]:
    """Advise on head poses and focal lengths that were not covered."""
    if calibration.zoom_head.T_head_zoom is None:
        return
    lens, poses = calibration.zoom_head.lens, head_poses(evidence.views)
    for axis, turn in zip(("pan", "tilt"), np.ptp(poses, axis=0) if len(poses) else (), strict=False):
        if turn < LEAST_TURN:
            yield f"The head's {axis} changed by {digits(np.degrees(turn))} degrees in all: {NEARER}."
    for nominal, views in zip(lens.nominal_px, evidence.per_stop, strict=True):
        if views < FEWEST_AT_STOP:
            yield f"The zoom sample at {nominal:.0f} px has {count(views, 'view')}: add some, to {FEWEST_AT_STOP}."
    zooms = any(view.focal_px is not None for view in evidence.views if view.camera == "zoom")
    if zooms and len(lens.stops) == 1:
        yield "If the lens zooms, capture boards at several focal lengths."


def _more_of_the_same(calibration: Calibration, at: tuple[AtFocal, ...]) -> Iterator[str]:
    """State what more placements of the same kind would gain."""
    total = at[-1].rms if at else 0.0
    if not total > 0:
        return
    number, stays2 = placements(calibration), what_stays(calibration, at[-1]) ** 2
    half = "no number of them would halve it, because the head's jitter stays"
    if 4 * stays2 < total**2:
        more = int(np.ceil(number * ((total**2 - stays2) / (total**2 / 4 - stays2) - 1)))
        half = f"{more} more would halve it"
    yield (
        f"{MORE_PLACEMENTS} more placements of the same kind as these {number} would bring the error from "
        f"{_degrees(total)} to {_degrees(with_more_placements(calibration, at[-1]))} degrees; {half}."
    )


def _degrees(angle: float) -> str:
    return digits(float(np.degrees(angle)))


# Tables of parameters and key figures

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
HEAD_WORDS = {  # name, factor to the unit shown, unit
    "axis_offset": ("offset of the axes", 1000.0, "mm"),
    "squareness": ("axes off the right angle", 180 / np.pi, "degrees"),
    "pan_scale": ("scale of pan", 1.0, ""),
    "tilt_scale": ("scale of tilt", 1.0, ""),
    "pan_zero": ("zero of pan", 180 / np.pi, "degrees"),
    "tilt_zero": ("zero of tilt", 180 / np.pi, "degrees"),
}


@dataclass(frozen=True)
class Table:
    """Table of text with a title and a note."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


HEADER = ("parameter", "value ± σ", "unit")


def parameter_tables(calibration: Calibration) -> list[Table]:
    """Make tables of all parameters in groups, with value ± one standard deviation."""
    head = calibration.zoom_head
    fixed = _lens(calibration, calibration.fixed.lens, "fixed")
    about_k3 = _about_k3(calibration.fixed.lens, sigma_of(calibration, "fixed.k3"))
    tables = [Table("Fixed camera", HEADER, fixed, about_k3), *_zoom(calibration)]
    tables.append(_pose_table(calibration, "Offset between the cameras", "T_zoom0_fixed", head.T_zoom0_fixed))
    if head.T_head_zoom is not None:
        tables.append(_pose_table(calibration, "Place of the zoom camera on the head", "T_head_zoom", head.T_head_zoom))
        tables.append(Table("Pan-tilt head", HEADER, tuple(_head(calibration))))
    if calibration.board is not None:
        rows = [
            _row(calibration, f"board.warp_{axis}", f"bulge of its middle along {axis}", value, 1000.0, "mm")
            for axis, value in zip("xy", calibration.board_warp, strict=True)
        ]
        tables.append(Table("Board", HEADER, tuple(rows)))
    return tables


def _row(
    calibration: Calibration, name: str, words: str, value: float, factor: float = 1.0, unit: str = ""
) -> tuple[str, str, str]:
    """Make the row of a parameter, multiplied by a factor to the unit shown."""
    sigma = sigma_of(calibration, name)
    return words, value_and_sigma(factor * value, sigma and factor * sigma), unit


def _about_k3(lens: Intrinsics, sigma: float | None = None) -> str:
    k3 = lens.distortion[4]
    if k3 and sigma:
        return f"k3 is significant: {value_and_sigma(k3, sigma)}. Beyond the boards such a lens is less certain."
    suggested = f"; the corners suggest {digits(sigma, 1)}, which every uncertainty here includes" if sigma else ""
    return f"k3 is held at {digits(k3, 3)}{suggested}."


def _numbers(lens: Intrinsics) -> dict[str, float]:
    return dict(zip(LENS_NAMES, (*lens.focal_px, *lens.center_px, *lens.distortion), strict=False))


def _lens(calibration: Calibration, lens: Intrinsics, owner: str) -> tuple[tuple[str, ...], ...]:
    return tuple(
        _row(calibration, f"{owner}.{name}", words, _numbers(lens)[name], unit=unit)
        for name, (words, unit) in LENS_WORDS.items()
    )


def _zoom(calibration: Calibration) -> list[Table]:
    lens = calibration.zoom_head.lens
    if len(lens.stops) == 1:
        title = f"Zoom camera (nominal focal length {lens.nominal_px[0]:.0f} px)"
        return [Table(title, HEADER, _lens(calibration, lens.stops[0], "zoom[0]"), _about_k3(lens.stops[0]))]
    lengths, bent = [], []
    for i, (nominal, stop, pupil) in enumerate(zip(lens.nominal_px, lens.stops, lens.pupil, strict=True)):
        cells = {name: _row(calibration, f"zoom[{i}].{name}", "", value)[1] for name, value in _numbers(stop).items()}
        moved = _row(calibration, f"zoom[{i}].pupil", "", pupil, 1000.0)[1] if i else "0"
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
    places, turns = zip("xyz", T.translation, strict=True), zip("xyz", T.rotation.as_rotvec(), strict=True)
    rows = [_row(calibration, f"{name}.t{axis}", f"position {axis}", v, 1000.0, "mm") for axis, v in places]
    rows += [
        _row(calibration, f"{name}.r{axis}", f"rotation vector {axis}", v, 180 / np.pi, "degrees") for axis, v in turns
    ]
    length = 1000 * float(np.linalg.norm(T.translation))
    rows.append(("distance", value_and_sigma(length, _length_sigma_mm(calibration, name, T)), "mm"))
    note = "The uncertainty of the rotation is that of a turn about the axes of the frame that the transform leads to."
    return Table(f"{title} ({name})", HEADER, tuple(rows), note)


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
        value, parameter = getattr(calibration.zoom_head.axes, name), f"head.{name}"
        of_encoder = name.startswith(("pan", "tilt"))  # shown where it is fitted or considered
        if not of_encoder or sigma_of(calibration, parameter) or value != getattr(IDEAL_HEAD, name):
            yield _row(calibration, parameter, words, value, factor, unit)
    yield "jitter of each axis", digits(float(np.degrees(calibration.jitter))), "degrees"


def key_figures(calibration: Calibration) -> list[tuple[str, str]]:
    """List the key figures of a calibration as name and value."""
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
    for name, camera in (("fixed", calibration.fixed.lens), ("zoom", calibration.zoom_head.lens.stops[0])):
        across = 2 * np.degrees(np.arctan(camera.size[0] / 2 / camera.focal_px[0]))
        found.append((f"Image, {name} camera", f"{camera.size[0]} × {camera.size[1]} px, about {across:.0f}° across"))
    if calibration.pitch_mm is not None:
        found.append(("Pixel of the zoom camera", f"{digits(1000 * calibration.pitch_mm, 3)} µm"))
    names = {"method": "Method", "when": "Made", "cotarget": "Version of cotarget"}
    found += [(word, str(calibration.provenance[key])) for key, word in names.items() if key in calibration.provenance]
    return found


# Number formatting

MOST_DECIMALS = 9
UNCERTAINTY_DIGITS = 2  # significant digits of a standard deviation
VALUE_DIGITS = 6  # significant digits of a value without one


def digits(value: float, count: int = 2) -> str:
    """Format a number with ``count`` significant digits, without an exponent unless it is tiny: 0.0021, 12, 7200."""
    if not math.isfinite(value):
        return "unknown"
    if value == 0:
        return "0"
    decimals = _decimals(value, count)
    if decimals > MOST_DECIMALS:
        return f"{value:.{count - 1}e}"
    return f"{round(value, decimals):.{max(decimals, 0)}f}"


def _decimals(value: float, count: int) -> int:
    """Count the decimals that show ``count`` significant digits after rounding: 0.0996 becomes 0.10."""
    decimals = count - 1 - math.floor(math.log10(abs(value)))
    return count - 1 - math.floor(math.log10(abs(round(value, decimals))))


def value_and_sigma(value: float, sigma: float | None) -> str:
    """Format a value with its standard deviation, to the same decimals: 692.31 ± 0.24."""
    if sigma is None or not math.isfinite(sigma) or sigma <= 0:
        return digits(value, VALUE_DIGITS)
    shown = min(max(_decimals(sigma, UNCERTAINTY_DIGITS), 0), MOST_DECIMALS)
    return f"{value:.{shown}f} ± {digits(sigma, UNCERTAINTY_DIGITS)}"


def count(number: int, one: str) -> str:
    """Format a number of things: 1 view, 2 views."""
    return f"{number} {one if number == 1 else one + 's'}"


def percent(share: float) -> str:
    """Format a share as a percentage: 0.04 %, 3 %, 62 %."""
    if 0 < share < 0.01:
        return f"{digits(100 * share, 1)} %"
    return f"{100 * share:.0f} %"


Level = Literal["good", "care", "bad", "unknown"]
LABELS: dict[Level, str] = {
    "good": "It points, and says how well",
    "care": "It points, but read on",
    "bad": "Do not rely on it",
    "unknown": "It does not say how well it points",
}
# Ratio of the errors at two focal lengths from which the verdict names both.
ALIKE = 1.25
# Errors over the close-up's width: above the first the verdict mentions it, above the second the target is not in the
# image.
FAR_OFF, OUT_OF_SIGHT = 0.05, 0.5
# Ratio of the corners' rms to the recorded one above which the corners do not belong to the calibration; and the
# smallest recorded rms, for exact corners, which are rounded.
CONTRADICTION, RECORDED_FLOOR_PX = 3.0, 1e-3
TOO_CAREFUL = 0.6  # ratio of measured to predicted misses below which the covariance is too large, beyond chance


@dataclass(frozen=True)
class Verdict:
    """Verdict on a calibration: a sentence, and its level."""

    text: str
    level: Level


def judge(calibration: Calibration, found: Analysis | None = None) -> Verdict:
    """Judge how well a calibration points, and whether captures kept out of its fit agree."""
    if calibration.zoom_head.T_head_zoom is None:
        return Verdict(_without_head(calibration), "unknown")
    if calibration.covariance is None:
        return _without_covariance(calibration)
    mismatch = _mismatch(calibration)
    if open_ := left_open(calibration):
        return Verdict(_sentence([*mismatch, f"does not determine the rig: {open_}"]), "bad")
    found = analyse(calibration) if found is None else found
    at, evidence = found.at, found.evidence
    if evidence is not None and _contradicts(calibration, evidence):
        return Verdict("Does not explain the corners that are stored with it: it was not made from them.", "bad")
    if not np.isfinite(at[-1].rms):
        return Verdict("Reaches no point of the fixed image with the head: its geometry cannot be right.", "bad")
    width = calibration.zoom_head.lens.size[0]
    doubts, agreed, held_out = [], [], calibration.held_out
    if at[-1].rms_px > FAR_OFF * width:
        doubts.append(f"that is {percent(at[-1].rms_px / width)} of the close-up's width")
    if (longest := uncalibrated_px(calibration)) is not None:
        doubts.append(
            f"the lens goes to {longest:.0f} px and is not calibrated beyond these; to calibrate them too, {FARTHER}"
        )
    if calibration.jitter:
        doubts.append(f"the head misses what it reports by {digits(np.degrees(calibration.jitter))} degrees an axis")
    if evidence is not None and evidence.shape.wrong:
        size = digits(1000 * np.hypot(evidence.shape.within, evidence.shape.out))
        doubts.append(f"not counting that the board's corners are {size} mm off their nominal positions")
    if held_out is None:
        doubts.append("no captures were kept out of the fit to confirm it")
    elif held_out.ratio < TOO_CAREFUL:
        doubts.append(f"captures kept out of the fit miss only {digits(held_out.ratio)} times as far as that")
    elif not mismatch:
        agreed.append("captures kept out of the fit agree")
    is_bad = at[-1].rms_px > OUT_OF_SIGHT * width
    level: Level = "bad" if is_bad else "care" if mismatch or doubts else "good"
    return Verdict(_sentence([*mismatch, _how_well(at, found.between), *doubts, *agreed]), level)


def _sentence(parts: list[str]) -> str:
    text = "; ".join(parts)
    return f"{text[0].upper()}{text[1:]}."


def _contradicts(calibration: Calibration, evidence: Evidence) -> bool:
    """Check whether the stored corners have a far larger rms than was recorded."""
    r = calibration.residuals
    if r is None:
        return False
    recorded = (r.fixed_rms_px, r.zoom_rms_px, r.stereo_rms_px or 0.0, r.handeye_rms_px or 0.0, RECORDED_FLOOR_PX)
    sigma = max(corners.sigma for corners in evidence.corners.values())
    return np.sqrt(2) * sigma > CONTRADICTION * max(recorded)


def _how_well(at: tuple[AtFocal, ...], between: tuple[AtFocal, ...]) -> str:
    last = at[-1]
    which = "the longest focal length calibrated" if len(at) > 1 else "the one focal length calibrated"
    in_px = f"{digits(last.rms_px)} px at {last.focal_px:.0f} px, {which}"
    text = f"points to {digits(np.degrees(last.rms))} degrees ({in_px})"
    worst = max((*at, *between), key=lambda one: one.rms)
    if worst.rms > ALIKE * last.rms:
        where = (
            f"between its zoom samples, at {worst.focal_px:.0f} px"
            if worst in between
            else f"at {worst.focal_px:.0f} px"
        )
        text += f" and to {digits(np.degrees(worst.rms))} degrees ({digits(worst.rms_px)} px) {where}"
    near, far = DEPTHS
    return f"{text}, one standard deviation, all over the fixed image from {near:g} to {far:g} m"


def _mismatch(calibration: Calibration) -> list[str]:
    """Describe the disagreement of captures kept out of the fit, which widens every other figure, if any."""
    held_out = calibration.held_out
    if held_out is None or held_out.widened <= 1:
        return []
    factor = digits(held_out.widened)
    return [
        f"captures kept out of the fit miss {factor} times as far as was predicted, and so the uncertainty is widened"
    ]


def _without_head(calibration: Calibration) -> str:
    parts = ["cannot point, because it was made without a head", *_mismatch(calibration)]
    residuals, covariance = calibration.residuals, calibration.covariance
    if residuals is not None and residuals.stereo_rms_px is not None:
        parts.append(f"the two cameras agree on the corners to {digits(residuals.stereo_rms_px)} px")
    if covariance is not None:
        if open_ := left_open(calibration):
            parts.append(f"it does not determine the cameras either: {open_}")
        else:
            turn, shift = (
                np.sqrt(sum((sigma_of(calibration, f"T_zoom0_fixed.{kind}{axis}") or 0.0) ** 2 for axis in "xyz"))
                for kind in "rt"
            )
            parts.append(
                f"the offset between them is known to {digits(1000 * shift)} mm and {digits(np.degrees(turn))} degrees"
            )
    return _sentence(parts)


def _without_covariance(calibration: Calibration) -> Verdict:
    method = calibration.provenance.get("method")
    if method == "joint":
        return Verdict("Leaves parameters undetermined, so that it cannot say how well it points.", "bad")
    why = "the sequential method gives no uncertainty" if method == "sequential" else "it has no uncertainty"
    return Verdict(f"Does not say how well it points, because {why}.", "unknown")
