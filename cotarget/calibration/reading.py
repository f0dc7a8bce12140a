"""Reading the parts of calibration.json: every key is there, and every value makes sense, or the error names it."""

import itertools
import math
from typing import Any

import numpy as np

from cotarget.calibration import parsing
from cotarget.calibration.model import Calibration, Covariance, HeldOut, Rejected, Residuals, View
from cotarget.calibration.parameters import EVERY_BLOCK, parameter_names
from cotarget.calibration.parsing import Table, get, join
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import BoardConfig
from cotarget.errors import CalibrationError
from cotarget.pantilt import HeadGeometry

# Rounding leaves a covariance, scaled to a unit diagonal, no less symmetric and its smallest eigenvalue no further
# below zero than this, for every parameter.
ROUNDING = 1e-9
# Beyond these a number was mistyped: an encoder's scale is within percents of 1, and no lens is longer than a
# telescope's 1e7 px, has its axis more than ten images off the middle, or needs coefficients that large.
SCALES, FOCALS_PX, IMAGES_OFF, LARGEST_COEFFICIENT = (0.5, 2.0), (1.0, 1e7), 10.0, 1e6
RESIDUAL_KEYS = (
    "fixed_rms_px",
    "zoom_rms_px",
    "stereo_rms_px",
    "handeye_rms_px",
    "fixed_views",
    "zoom_views",
    "pairs",
    "outliers",
)


def parse_calibration(table: Table) -> Calibration:
    """Read a calibration from the object that calibration.json holds.

    Raises:
        CalibrationError: with the key that is missing, or whose value makes no sense.
    """
    T_head_zoom = get(table, "T_head_zoom")
    head = parsing.as_table(get(table, "head"), "head")
    pitch = get(table, "pitch_mm")
    board = None if get(table, "board") is None else parse_board(table["board"], "board")
    views = parsing.as_list(get(table, "views"), "views")
    if views and board is None:
        raise CalibrationError("board: is null, but there are views of one")
    fixed = parsing.as_table(get(table, "fixed"), "fixed")
    warp = parsing.as_numbers(get(table, "board_warp"), "board_warp", 2)

    def angle(name: str) -> float:
        return math.radians(parsing.as_number(get(head, f"{name}_deg", "head"), f"head.{name}_deg"))

    zoom = _parse_lens(parsing.as_table(get(table, "zoom"), "zoom"))
    return Calibration(
        fixed=_parse_intrinsics(fixed, parsing.as_size(get(fixed, "size", "fixed"), "fixed.size"), "fixed"),
        zoom=zoom,
        T_zoom0_fixed=parsing.as_pose(get(table, "T_zoom0_fixed"), "T_zoom0_fixed"),
        T_head_zoom=None if T_head_zoom is None else parsing.as_pose(T_head_zoom, "T_head_zoom"),
        head=HeadGeometry(
            axis_offset=parsing.as_number(get(head, "axis_offset", "head"), "head.axis_offset"),
            squareness=angle("squareness"),
            pan_scale=_within(SCALES, get(head, "pan_scale", "head"), "head.pan_scale"),
            tilt_scale=_within(SCALES, get(head, "tilt_scale", "head"), "head.tilt_scale"),
            pan_zero=angle("pan_zero"),
            tilt_zero=angle("tilt_zero"),
        ),
        jitter=math.radians(_at_least(0, get(head, "jitter_deg", "head"), "head.jitter_deg")),
        pitch_mm=None if pitch is None else parsing.as_number(pitch, "pitch_mm", positive=True),
        residuals=_parse_residuals(get(table, "residuals")),
        covariance=_parse_covariance(get(table, "covariance"), len(zoom.stops)),
        held_out=_parse_held_out(get(table, "held_out")),
        board_warp=(warp[0], warp[1]),
        board=board,
        views=tuple(_parse_view(view, f"views[{i}]", board) for i, view in enumerate(views) if board is not None),
        provenance=parsing.as_table(get(table, "provenance"), "provenance"),
    )


def check_covariance(covariance: Covariance, stops: int) -> None:
    """Refuse a covariance that is none, or of other parameters than a rig has.

    Args:
        covariance: of a calibration.
        stops: how many its zoom lens has.

    Raises:
        CalibrationError: with the key in the file.
    """
    names, C = covariance.parameters, covariance.matrix
    known = parameter_names(EVERY_BLOCK, stops)
    if unknown := [name for name in names if name not in known]:
        raise CalibrationError(f"covariance.parameters: '{unknown[0]}' is no parameter; they are: {', '.join(known)}")
    if not names:
        raise CalibrationError("covariance.parameters: is empty; a method that tells no uncertainty has null instead")
    if twice := [name for i, name in enumerate(names) if name in names[:i]]:
        raise CalibrationError(f"covariance.parameters: '{twice[0]}' is there twice")
    variances = np.diagonal(C)
    for i in np.flatnonzero((variances < 0) | ((variances == 0) & C.any(axis=1))):
        raise CalibrationError(
            f"covariance.matrix[{i}][{i}]: {variances[i]:g} is no variance of {names[i]}; that is greater than zero"
        )
    scale = np.where(variances > 0, np.sqrt(variances), 1.0)
    with np.errstate(over="ignore"):
        R = C / scale / scale[:, None]
    rounding = ROUNDING * len(C)
    if not np.isfinite(R).all() or np.abs(R - R.T).max() > rounding or np.linalg.eigvalsh(R)[0] < -rounding:
        raise CalibrationError("covariance.matrix: is no covariance: not symmetric, or with a variance below zero")


def parse_board(value: Any, where: str) -> BoardConfig:
    """Read a board from a JSON object."""
    table = parsing.as_table(value, where)
    kind = get(table, "kind", where)
    if kind not in ("chessboard", "charuco"):
        raise CalibrationError(f"{join(where, 'kind')}: {parsing.short(kind)} is not one of: chessboard, charuco")
    return BoardConfig(
        kind=kind,
        corners=parsing.as_size(get(table, "corners", where), join(where, "corners")),
        square=parsing.as_number(get(table, "square", where), join(where, "square"), positive=True),
    )


def _parse_intrinsics(table: Table, size: tuple[int, int], where: str) -> Intrinsics:
    fx, fy = (_within(FOCALS_PX, get(table, k, where), join(where, k)) for k in ("fx", "fy"))
    far = IMAGES_OFF * max(size)
    cx, cy = (_within((-far, far), get(table, k, where), join(where, k)) for k in ("cx", "cy"))
    told = parsing.as_list(get(table, "distortion", where), join(where, "distortion"), 5)
    bounds = (-LARGEST_COEFFICIENT, LARGEST_COEFFICIENT)
    k1, k2, p1, p2, k3 = (_within(bounds, k, f"{join(where, 'distortion')}[{i}]") for i, k in enumerate(told))
    return Intrinsics(size=size, focal_px=(fx, fy), center_px=(cx, cy), distortion=(k1, k2, p1, p2, k3))


def _parse_lens(table: Table) -> ZoomLens:
    size = parsing.as_size(get(table, "size", "zoom"), "zoom.size")
    stops = parsing.as_list(get(table, "stops", "zoom"), "zoom.stops")
    if not stops:
        raise CalibrationError("zoom.stops: is empty; at least one calibrated focal length is needed")
    nominal, intrinsics, pupil = [], [], []
    for i, value in enumerate(stops):
        where = f"zoom.stops[{i}]"
        stop = parsing.as_table(value, where)
        nominal.append(_within(FOCALS_PX, get(stop, "nominal_px", where), join(where, "nominal_px")))
        intrinsics.append(_parse_intrinsics(stop, size, where))
        pupil.append(parsing.as_number(get(stop, "pupil", where), join(where, "pupil")))
    if any(b <= a for a, b in itertools.pairwise(nominal)):
        raise CalibrationError("zoom.stops: the values of nominal_px do not increase")
    if pupil[0] != 0:
        raise CalibrationError("zoom.stops[0].pupil: is not 0, from which the others are counted")
    return ZoomLens(tuple(nominal), tuple(intrinsics), tuple(pupil))


def _parse_residuals(value: Any) -> Residuals | None:
    if value is None:
        return None
    where = "residuals"
    table = parsing.as_table(value, where)
    numbers: dict[str, Any] = {}
    for key in RESIDUAL_KEYS:
        item = get(table, key, where)
        if key.endswith("_px"):
            missing = item is None and key in ("handeye_rms_px", "stereo_rms_px")
            numbers[key] = None if missing else _at_least(0, item, join(where, key))
        else:
            numbers[key] = parsing.as_whole(item, join(where, key))
    rejected = []
    for i, item in enumerate(parsing.as_list(get(table, "rejected", where), "residuals.rejected")):
        entry = parsing.as_table(item, f"residuals.rejected[{i}]")
        name, reason = (
            parsing.as_text(get(entry, k, f"residuals.rejected[{i}]"), f"residuals.rejected[{i}].{k}")
            for k in ("name", "reason")
        )
        rejected.append(Rejected(name, reason))
    return Residuals(**numbers, rejected=tuple(rejected))


def _parse_held_out(value: Any) -> HeldOut | None:
    if value is None:
        return None
    table = parsing.as_table(value, "held_out")
    lowest = {"measured_px": 0, "predicted_px": 0, "corners_rms_px": 0, "ratio": 0, "widened": 1}
    numbers = {
        name: _at_least(least, get(table, name, "held_out"), f"held_out.{name}") for name, least in lowest.items()
    }
    return HeldOut(views=parsing.as_whole(get(table, "views", "held_out"), "held_out.views"), **numbers)


def _within(bounds: tuple[float, float], value: Any, where: str) -> float:
    """Expect a number that can be; one that is to be above zero is told that first."""
    low, high = bounds
    number = parsing.as_number(value, where, positive=low > 0)
    if not low <= number <= high:
        raise CalibrationError(f"{where}: {number:g} is not between {low:g} and {high:g}")
    return number


def _at_least(lowest: int, value: Any, where: str) -> float:
    """Expect a number that is not below some lowest one."""
    number = parsing.as_number(value, where)
    if number < lowest:
        raise CalibrationError(f"{where}: {number:g} is less than {lowest}")
    return number


def _parse_covariance(value: Any, stops: int) -> Covariance | None:
    if value is None:
        return None
    table = parsing.as_table(value, "covariance")
    names = parsing.as_list(get(table, "parameters", "covariance"), "covariance.parameters")
    rows = parsing.as_list(get(table, "matrix", "covariance"), "covariance.matrix", len(names))
    matrix = [parsing.as_numbers(r, f"covariance.matrix[{i}]", len(names)) for i, r in enumerate(rows)]
    covariance = Covariance(
        parameters=tuple(parsing.as_text(n, f"covariance.parameters[{i}]") for i, n in enumerate(names)),
        matrix=np.array(matrix).reshape(len(names), len(names)),
    )
    check_covariance(covariance, stops)
    return covariance


def _parse_view(value: Any, where: str, board: BoardConfig) -> View:
    table = parsing.as_table(value, where)
    camera = get(table, "camera", where)
    if camera not in ("fixed", "zoom"):
        raise CalibrationError(f"{where}.camera: {parsing.short(camera)} is not one of: fixed, zoom")
    focal = get(table, "focal_px", where)
    source = get(table, "source", where)
    columns, rows = board.corners
    corners = parsing.as_list(get(table, "corners_px", where), f"{where}.corners_px", columns * rows)
    pan, tilt, t = (parsing.as_number(get(table, k, where), join(where, k)) for k in ("pan", "tilt", "t"))
    return View(
        camera=camera,
        corners_px=np.array(
            [
                (np.nan, np.nan) if c is None else parsing.as_numbers(c, f"{where}.corners_px[{i}]", 2)
                for i, c in enumerate(corners)
            ]
        ),
        board=parsing.as_whole(get(table, "board", where), join(where, "board")),
        pan=pan,
        tilt=tilt,
        focal_px=None if focal is None else parsing.as_number(focal, join(where, "focal_px"), positive=True),
        t=t,
        source=None if source is None else parsing.as_text(source, join(where, "source")),
    )
