"""Calibration result and its file, calibration.json.

The file holds the result, its uncertainty and the corners it comes from, so that it can be checked and refitted. Keys:
schema; fixed; zoom (zoom samples, as stops); T_zoom0_fixed; T_head_zoom (or null); head; pitch_mm (or null); residuals;
covariance (or null); held_out (or null); board and board_warp [m]; provenance; views, with null for a corner that is
not seen. Lengths are metres. Angles are degrees where people read them, and radians in the views, so that a refit
starts from exactly the same numbers.

Reading checks every key and value. Errors of `get` and the ``as_`` functions name the key; their callers add the file.
"""

import dataclasses
import itertools
import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cotarget.calibration.bundle import EVERY_BLOCK, parameter_names
from cotarget.calibration.model import Covariance, HeldOut, Rejected, Residuals, View
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import BoardConfig
from cotarget.errors import CalibrationError, choices
from cotarget.files import write_atomically
from cotarget.geometry import Array, RigidTransform, pose, pose_dict
from cotarget.pantilt import IDEAL_HEAD, HeadGeometry

Table = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration of a rig, with the views it comes from.

    Attributes:
        fixed: intrinsics of the fixed camera.
        zoom: optics of the zoom camera over its focal range.
        T_zoom0_fixed: the paper's Gamma, at the shortest focal length.
        T_head_zoom: the paper's T, at the shortest focal length; None where no head was calibrated.
        head: geometry of the head.
        pitch_mm: pixel size of the zoom camera [mm], for focal lengths in millimetres; None if unknown.
        residuals: residuals of the fit, and what was rejected.
        covariance: covariance of the parameters; None where the method gives none.
        jitter: standard deviation of each axis's true angle about the reported one, independent at every pose [rad]. It
            also stands for errors that the model leaves out.
        held_out: result of the held-out check; None where there were too few captures, or the method has no check.
        board_warp: height of the board's middle above its edges, towards its z, by the bend along x and along y [m].
        board: the board; None for a calibration without one.
        views: views of the calibration, for checks and refits.
        provenance: versions, options, time and origin of the captures; JSON values only.
    """

    fixed: Intrinsics
    zoom: ZoomLens
    T_zoom0_fixed: RigidTransform
    T_head_zoom: RigidTransform | None
    head: HeadGeometry = IDEAL_HEAD
    pitch_mm: float | None = None
    residuals: Residuals | None = None
    covariance: Covariance | None = None
    jitter: float = 0.0
    held_out: HeldOut | None = None
    board_warp: tuple[float, float] = (0.0, 0.0)
    board: BoardConfig | None = None
    views: tuple[View, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def hand_eye(self, nominal_px: float | None = None) -> RigidTransform:
        """Return T_head_zoom at a focal length, and refuse a calibration without it.

        Args:
            nominal_px: nominal focal length whose entrance pupil is the origin [px]; None for the shortest one.

        Raises:
            CalibrationError: no head was calibrated.
        """
        if self.T_head_zoom is None:
            raise CalibrationError("this calibration has no T_head_zoom; calibrate on a rig, whose head moves")
        if nominal_px is None:
            return self.T_head_zoom
        return self.T_head_zoom * self.zoom.to_pupil(nominal_px)

    @cached_property
    def T_base_fixed(self) -> RigidTransform:
        """Transform from the fixed camera to the base, T_head_zoom T_zoom0_fixed (Eq. 6).

        Raises:
            CalibrationError: no head was calibrated.
        """
        return self.hand_eye() * self.T_zoom0_fixed

    @cached_property
    def _base_fixed(self) -> Array:
        """Rotation and translation of T_base_fixed side by side, (3, 4)."""
        return self.T_base_fixed.as_matrix()[:3]

    def in_base(self, x_fixed: Array) -> Array:
        """Map a point from the fixed camera's frame to the base's, (3,) [m] (Eq. 6).

        It takes a third of the time of scipy's transform.

        Raises:
            CalibrationError: no head was calibrated.
        """
        x, y, z = x_fixed
        return np.asarray(self._base_fixed @ np.array((x, y, z, 1.0)))

    def for_streams(self, fixed_size: tuple[int, int], zoom_size: tuple[int, int]) -> "Calibration":
        """Return the calibration for streams scaled to other sizes (width, height) [px].

        Raises:
            ConfigError: the aspect ratio of a stream differs from that calibrated.
        """
        factors = {"fixed": fixed_size[0] / self.fixed.size[0], "zoom": zoom_size[0] / self.zoom.size[0]}
        covariance = self.covariance
        if covariance is not None:
            in_pixels = ("fx", "fy", "cx", "cy")
            covariance = covariance.scaled(
                {f"fixed.{k}": factors["fixed"] for k in in_pixels}
                | {f"zoom[{i}].{k}": factors["zoom"] for i in range(len(self.zoom.stops)) for k in in_pixels}
            )
        pitch_mm = self.pitch_mm and self.pitch_mm * self.zoom.size[0] / zoom_size[0]  # a larger pixel, where binned
        return replace(
            self,
            fixed=self.fixed.resized(fixed_size),
            zoom=self.zoom.resized(zoom_size),
            covariance=covariance,
            pitch_mm=pitch_mm,
            views=tuple(view.scaled(factors[view.camera]) for view in self.views),
        )

    @classmethod
    def load(cls, path: Path | str) -> "Calibration":
        """Read a calibration.json.

        Raises:
            CalibrationError: the file is missing or malformed; the message names the file and the key.
        """
        return load_calibration(Path(path))

    def save(self, path: Path | str) -> None:
        """Write a calibration.json atomically.

        Raises:
            CalibrationError: the file cannot be written.
        """
        save_calibration(Path(path), self)


def read_json(path: Path, wanted: str) -> Table:
    """Read a JSON object from a file.

    Args:
        path: file to read.
        wanted: advice for the message, where the file holds something else.

    Raises:
        CalibrationError: the file is missing, or is not a JSON object; the message says what it is where possible.
    """

    def refuse(constant: str) -> None:
        raise CalibrationError(f"{path}: holds the number {constant}, which is not finite")

    try:
        text = path.read_text(encoding="utf-8")
        table = json.loads(text, parse_constant=refuse)
    except FileNotFoundError:
        raise CalibrationError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise CalibrationError(f"{path}: cannot be read: {reason}") from None
    except (json.JSONDecodeError, RecursionError) as error:
        what = "is empty" if not text.strip() else "is TOML" if _is_toml(text) else f"is not JSON: {error}"
        raise CalibrationError(f"{path}: {what}; {wanted}") from None
    if not isinstance(table, dict):
        raise CalibrationError(f"{path}: holds no JSON object; {wanted}")
    return table


def _is_toml(text: str) -> bool:
    try:
        return bool(tomllib.loads(text))
    except (tomllib.TOMLDecodeError, RecursionError):
        return False


def check_schema(path: Path, table: Table, schema: int) -> None:
    """Refuse a file of another schema version.

    Raises:
        CalibrationError: the file has another schema number, or none.
    """
    if "schema" not in table:
        raise CalibrationError(f"{path}: missing key 'schema'; this version reads schema {schema}")
    if table["schema"] != schema or isinstance(table["schema"], bool):
        raise CalibrationError(f"{path}: schema {table['schema']!r} is not {schema}, the one that this version reads")


def get(table: Table, key: str, where: str = "") -> Any:
    """Look a key up, and refuse a table without it."""
    if key not in table:
        raise CalibrationError(f"missing key '{join(where, key)}'; found here: {choices(table)}")
    return table[key]


def join(where: str, key: str) -> str:
    """Join a table's name and a key with a dot."""
    return f"{where}.{key}" if where else key


def as_table(value: Any, where: str) -> Table:
    """Expect a JSON object."""
    if not isinstance(value, dict):
        raise CalibrationError(f"{where}: {short(value)} is not an object")
    return value


def as_list(value: Any, where: str, length: int | None = None) -> Sequence[Any]:
    """Expect a JSON list, of the given length unless that is None."""
    if not isinstance(value, list):
        raise CalibrationError(f"{where}: {short(value)} is not a list")
    if length is not None and len(value) != length:
        raise CalibrationError(f"{where}: has {len(value)} values where {length} are wanted")
    return value


def as_number(value: Any, where: str, *, positive: bool = False) -> float:
    """Expect a finite number, greater than zero if ``positive``."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise CalibrationError(f"{where}: {short(value)} is not a finite number")
    if positive and value <= 0:
        raise CalibrationError(f"{where}: {value:g} is not greater than zero")
    return float(value)


def as_whole(value: Any, where: str, *, lowest: int = 0) -> int:
    """Expect a whole number not below ``lowest``."""
    if isinstance(value, bool) or not isinstance(value, int) or value < lowest:
        raise CalibrationError(f"{where}: {short(value)} is not a whole number from {lowest} up")
    return value


def as_text(value: Any, where: str) -> str:
    """Expect a string."""
    if not isinstance(value, str):
        raise CalibrationError(f"{where}: {short(value)} is not a text")
    return value


def as_numbers(value: Any, where: str, length: int) -> tuple[float, ...]:
    """Expect a list of finite numbers of the given length."""
    return tuple(as_number(item, f"{where}[{i}]") for i, item in enumerate(as_list(value, where, length)))


def as_size(value: Any, where: str) -> tuple[int, int]:
    """Expect a pair of positive whole numbers: (width, height) or (columns, rows)."""
    first, second = as_list(value, where, 2)
    return as_whole(first, f"{where}[0]", lowest=1), as_whole(second, f"{where}[1]", lowest=1)


def as_pose(value: Any, where: str) -> RigidTransform:
    """Expect a table of translation [m] and rotation vector [degrees]."""
    table = as_table(value, where)
    translation = as_numbers(get(table, "translation", where), join(where, "translation"), 3)
    rotvec_deg = as_numbers(get(table, "rotvec_deg", where), join(where, "rotvec_deg"), 3)
    try:
        return pose(translation, rotvec_deg)
    except ValueError as error:
        raise CalibrationError(join(where, str(error))) from None


def short(value: Any) -> str:
    """Quote a value for an error message, cut to 40 characters."""
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


# Parsing the parts of calibration.json

# Largest asymmetry and negative eigenvalue that rounding leaves per parameter, in a covariance scaled to a unit
# diagonal.
ROUNDING = 1e-9
# Values beyond these are mistyped: an encoder's scale is within percents of 1, and no lens is longer than a telescope's
# 1e7 px, has its axis more than ten images off the middle, or needs coefficients that large.
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
    """Parse a calibration from the JSON object of calibration.json.

    Raises:
        CalibrationError: a key is missing or its value is invalid; the message names the key.
    """
    T_head_zoom = get(table, "T_head_zoom")
    head = as_table(get(table, "head"), "head")
    pitch = get(table, "pitch_mm")
    board = None if get(table, "board") is None else parse_board(table["board"], "board")
    views = as_list(get(table, "views"), "views")
    if views and board is None:
        raise CalibrationError("board: is null, but there are views of one")
    fixed = as_table(get(table, "fixed"), "fixed")
    warp = as_numbers(get(table, "board_warp"), "board_warp", 2)

    def angle(name: str) -> float:
        return math.radians(as_number(get(head, f"{name}_deg", "head"), f"head.{name}_deg"))

    zoom = _parse_lens(as_table(get(table, "zoom"), "zoom"))
    return Calibration(
        fixed=_parse_intrinsics(fixed, as_size(get(fixed, "size", "fixed"), "fixed.size"), "fixed"),
        zoom=zoom,
        T_zoom0_fixed=as_pose(get(table, "T_zoom0_fixed"), "T_zoom0_fixed"),
        T_head_zoom=None if T_head_zoom is None else as_pose(T_head_zoom, "T_head_zoom"),
        head=HeadGeometry(
            axis_offset=as_number(get(head, "axis_offset", "head"), "head.axis_offset"),
            squareness=angle("squareness"),
            pan_scale=_within(SCALES, get(head, "pan_scale", "head"), "head.pan_scale"),
            tilt_scale=_within(SCALES, get(head, "tilt_scale", "head"), "head.tilt_scale"),
            pan_zero=angle("pan_zero"),
            tilt_zero=angle("tilt_zero"),
        ),
        jitter=math.radians(_at_least(0, get(head, "jitter_deg", "head"), "head.jitter_deg")),
        pitch_mm=None if pitch is None else as_number(pitch, "pitch_mm", positive=True),
        residuals=_parse_residuals(get(table, "residuals")),
        covariance=_parse_covariance(get(table, "covariance"), len(zoom.stops)),
        held_out=_parse_held_out(get(table, "held_out")),
        board_warp=(warp[0], warp[1]),
        board=board,
        views=tuple(_parse_view(view, f"views[{i}]", board) for i, view in enumerate(views) if board is not None),
        provenance=as_table(get(table, "provenance"), "provenance"),
    )


def check_covariance(covariance: Covariance, stops: int) -> None:
    """Refuse a matrix that is no covariance, and parameters that the rig does not have.

    Args:
        covariance: covariance of a calibration.
        stops: number of zoom samples of its lens.

    Raises:
        CalibrationError: the covariance is invalid; the message names the key in the file.
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
    """Parse a board from a JSON object."""
    table = as_table(value, where)
    kind = get(table, "kind", where)
    if kind not in ("chessboard", "charuco"):
        raise CalibrationError(f"{join(where, 'kind')}: {short(kind)} is not one of: chessboard, charuco")
    return BoardConfig(
        kind=kind,
        corners=as_size(get(table, "corners", where), join(where, "corners")),
        square=as_number(get(table, "square", where), join(where, "square"), positive=True),
    )


def _parse_intrinsics(table: Table, size: tuple[int, int], where: str) -> Intrinsics:
    fx, fy = (_within(FOCALS_PX, get(table, k, where), join(where, k)) for k in ("fx", "fy"))
    far = IMAGES_OFF * max(size)
    cx, cy = (_within((-far, far), get(table, k, where), join(where, k)) for k in ("cx", "cy"))
    told = as_list(get(table, "distortion", where), join(where, "distortion"), 5)
    bounds = (-LARGEST_COEFFICIENT, LARGEST_COEFFICIENT)
    k1, k2, p1, p2, k3 = (_within(bounds, k, f"{join(where, 'distortion')}[{i}]") for i, k in enumerate(told))
    return Intrinsics(size=size, focal_px=(fx, fy), center_px=(cx, cy), distortion=(k1, k2, p1, p2, k3))


def _parse_lens(table: Table) -> ZoomLens:
    size = as_size(get(table, "size", "zoom"), "zoom.size")
    stops = as_list(get(table, "stops", "zoom"), "zoom.stops")
    if not stops:
        raise CalibrationError("zoom.stops: is empty; at least one calibrated focal length is needed")
    nominal, intrinsics, pupil = [], [], []
    for i, value in enumerate(stops):
        where = f"zoom.stops[{i}]"
        stop = as_table(value, where)
        nominal.append(_within(FOCALS_PX, get(stop, "nominal_px", where), join(where, "nominal_px")))
        intrinsics.append(_parse_intrinsics(stop, size, where))
        pupil.append(as_number(get(stop, "pupil", where), join(where, "pupil")))
    if any(b <= a for a, b in itertools.pairwise(nominal)):
        raise CalibrationError("zoom.stops: the values of nominal_px do not increase")
    if pupil[0] != 0:
        raise CalibrationError("zoom.stops[0].pupil: is not 0, from which the others are counted")
    return ZoomLens(tuple(nominal), tuple(intrinsics), tuple(pupil))


def _parse_residuals(value: Any) -> Residuals | None:
    if value is None:
        return None
    where = "residuals"
    table = as_table(value, where)
    numbers: dict[str, Any] = {}
    for key in RESIDUAL_KEYS:
        item = get(table, key, where)
        if key.endswith("_px"):
            missing = item is None and key in ("handeye_rms_px", "stereo_rms_px")
            numbers[key] = None if missing else _at_least(0, item, join(where, key))
        else:
            numbers[key] = as_whole(item, join(where, key))
    rejected = []
    for i, item in enumerate(as_list(get(table, "rejected", where), "residuals.rejected")):
        entry = as_table(item, f"residuals.rejected[{i}]")
        name, reason = (
            as_text(get(entry, k, f"residuals.rejected[{i}]"), f"residuals.rejected[{i}].{k}")
            for k in ("name", "reason")
        )
        rejected.append(Rejected(name, reason))
    return Residuals(**numbers, rejected=tuple(rejected))


def _parse_held_out(value: Any) -> HeldOut | None:
    if value is None:
        return None
    table = as_table(value, "held_out")
    lowest = {"measured_px": 0, "predicted_px": 0, "corners_rms_px": 0, "ratio": 0, "widened": 1}
    numbers = {
        name: _at_least(least, get(table, name, "held_out"), f"held_out.{name}") for name, least in lowest.items()
    }
    return HeldOut(views=as_whole(get(table, "views", "held_out"), "held_out.views"), **numbers)


def _within(bounds: tuple[float, float], value: Any, where: str) -> float:
    """Expect a number within bounds; for a positive lower bound, refuse zero and less with a message of its own."""
    low, high = bounds
    number = as_number(value, where, positive=low > 0)
    if not low <= number <= high:
        raise CalibrationError(f"{where}: {number:g} is not between {low:g} and {high:g}")
    return number


def _at_least(lowest: int, value: Any, where: str) -> float:
    """Expect a number not below ``lowest``."""
    number = as_number(value, where)
    if number < lowest:
        raise CalibrationError(f"{where}: {number:g} is less than {lowest}")
    return number


def _parse_covariance(value: Any, stops: int) -> Covariance | None:
    if value is None:
        return None
    table = as_table(value, "covariance")
    names = as_list(get(table, "parameters", "covariance"), "covariance.parameters")
    rows = as_list(get(table, "matrix", "covariance"), "covariance.matrix", len(names))
    matrix = [as_numbers(r, f"covariance.matrix[{i}]", len(names)) for i, r in enumerate(rows)]
    covariance = Covariance(
        parameters=tuple(as_text(n, f"covariance.parameters[{i}]") for i, n in enumerate(names)),
        matrix=np.array(matrix).reshape(len(names), len(names)),
    )
    check_covariance(covariance, stops)
    return covariance


def _parse_view(value: Any, where: str, board: BoardConfig) -> View:
    table = as_table(value, where)
    camera = get(table, "camera", where)
    if camera not in ("fixed", "zoom"):
        raise CalibrationError(f"{where}.camera: {short(camera)} is not one of: fixed, zoom")
    focal = get(table, "focal_px", where)
    source = get(table, "source", where)
    columns, rows = board.corners
    corners = as_list(get(table, "corners_px", where), f"{where}.corners_px", columns * rows)
    pan, tilt, t = (as_number(get(table, k, where), join(where, k)) for k in ("pan", "tilt", "t"))
    return View(
        camera=camera,
        corners_px=np.array(
            [
                (np.nan, np.nan) if c is None else as_numbers(c, f"{where}.corners_px[{i}]", 2)
                for i, c in enumerate(corners)
            ]
        ),
        board=as_whole(get(table, "board", where), join(where, "board")),
        pan=pan,
        tilt=tilt,
        focal_px=None if focal is None else as_number(focal, join(where, "focal_px"), positive=True),
        t=t,
        source=None if source is None else as_text(source, join(where, "source")),
    )


# Reading and writing calibration.json

SCHEMA = 2
OWN_KEYS = {"fixed", "zoom", "T_zoom0_fixed"}  # a calibration of any version has at least one of these
WANTED = "give a calibration.json, as cotarget calibrate writes it"
OTHERS = (
    ({"captures", "board"}, "the index of captures: cotarget calibrate --from its folder makes one of them"),
    ({"versions", "config"}, "what a capture session or a recording says of itself"),
)


def save_calibration(path: Path, calibration: Calibration) -> None:
    """Write calibration.json atomically.

    Raises:
        CalibrationError: the file cannot be written, or the calibration holds a number that is not finite.
    """
    try:
        text = _readable(_table(calibration))
    except ValueError:
        raise CalibrationError(f"{path}: not written: the calibration holds a number that is not finite") from None
    write_atomically(path, text.encode())


def load_calibration(path: Path) -> Calibration:
    """Read calibration.json.

    Raises:
        CalibrationError: the file is missing, malformed or no calibration; the message names the file and the key.
    """
    table = read_json(path, WANTED)
    if not (table.keys() & OWN_KEYS):
        raise CalibrationError(f"{path}: is no calibration{_what(table)}; {WANTED}")
    check_schema(path, table, SCHEMA)
    try:
        found = parse_calibration(table)
        _refuse_unknown(table, _table(found))
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None
    return found


def _table(calibration: Calibration) -> dict[str, Any]:
    """Make the JSON object of a calibration."""
    T_head_zoom = calibration.T_head_zoom
    covariance = calibration.covariance
    return {
        "schema": SCHEMA,
        "fixed": {"size": list(calibration.fixed.size), **_write_intrinsics(calibration.fixed)},
        "zoom": {
            "size": list(calibration.zoom.size),
            "stops": [
                {"nominal_px": float(nominal), **_write_intrinsics(stop), "pupil": float(pupil)}
                for nominal, stop, pupil in zip(*_columns(calibration.zoom), strict=True)
            ],
        },
        "T_zoom0_fixed": pose_dict(calibration.T_zoom0_fixed),
        "T_head_zoom": None if T_head_zoom is None else pose_dict(T_head_zoom),
        "head": {
            "axis_offset": float(calibration.head.axis_offset),
            "squareness_deg": math.degrees(calibration.head.squareness),
            "pan_scale": float(calibration.head.pan_scale),
            "tilt_scale": float(calibration.head.tilt_scale),
            "pan_zero_deg": math.degrees(calibration.head.pan_zero),
            "tilt_zero_deg": math.degrees(calibration.head.tilt_zero),
            "jitter_deg": math.degrees(calibration.jitter),
        },
        "pitch_mm": calibration.pitch_mm,
        "residuals": None if calibration.residuals is None else _write_residuals(calibration.residuals),
        "covariance": None
        if covariance is None
        else {"parameters": list(covariance.parameters), "matrix": covariance.matrix.tolist()},
        "held_out": None if calibration.held_out is None else dataclasses.asdict(calibration.held_out),
        "board": None if calibration.board is None else write_board(calibration.board),
        "board_warp": [float(w) for w in calibration.board_warp],
        "provenance": dict(calibration.provenance),
        "views": [_write_view(view) for view in calibration.views],
    }


def _what(table: Table) -> str:
    """Describe a file that is no calibration, by its keys; empty where it is not recognised."""
    return next((f", but {what}" for keys, what in OTHERS if table.keys() >= keys), "")


def _refuse_unknown(read: Any, written: Any, where: str = "") -> None:
    """Refuse unknown keys, which would otherwise be ignored without notice.

    Args:
        read: value from the file.
        written: the same value as this version writes it.
        where: key of both.

    Raises:
        CalibrationError: a key is unknown; the message lists the valid ones.
    """
    if isinstance(read, dict) and isinstance(written, dict):
        for key, value in read.items():
            if key not in written:
                raise CalibrationError(f"unknown key '{join(where, key)}'; valid here: {choices(written)}")
            _refuse_unknown(value, written[key], join(where, key))
    elif isinstance(read, list) and isinstance(written, list):
        for i, (a, b) in enumerate(zip(read, written, strict=False)):
            _refuse_unknown(a, b, f"{where}[{i}]")


def write_board(board: BoardConfig) -> dict[str, Any]:
    """Make the JSON object of a board."""
    return {"kind": board.kind, "corners": list(board.corners), "square": board.square}


def _readable(table: dict[str, Any]) -> str:
    """Format the JSON with one line per value and one line per view, and not one line per number."""
    lines = []
    for key, value in table.items():
        if isinstance(value, list) and value:
            items = ",\n    ".join(json.dumps(item, allow_nan=False) for item in value)
            lines.append(f'  "{key}": [\n    {items}\n  ]')
        elif isinstance(value, dict) and value:
            items = ",\n    ".join(f"{json.dumps(k)}: {json.dumps(v, allow_nan=False)}" for k, v in value.items())
            lines.append(f'  "{key}": {{\n    {items}\n  }}')
        else:
            lines.append(f'  "{key}": {json.dumps(value, allow_nan=False)}')
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _columns(lens: ZoomLens) -> tuple[tuple[float, ...], tuple[Intrinsics, ...], tuple[float, ...]]:
    return lens.nominal_px, lens.stops, lens.pupil


def _write_intrinsics(camera: Intrinsics) -> dict[str, Any]:
    (fx, fy), (cx, cy) = camera.focal_px, camera.center_px
    numbers = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    return {k: float(v) for k, v in numbers.items()} | {"distortion": [float(k) for k in camera.distortion]}


def _write_residuals(residuals: Residuals) -> dict[str, Any]:
    return {
        **{name: getattr(residuals, name) for name in RESIDUAL_KEYS},
        "rejected": [{"name": r.name, "reason": r.reason} for r in residuals.rejected],
    }


def _write_view(view: View) -> dict[str, Any]:
    return {
        "camera": view.camera,
        "board": view.board,
        "pan": view.pan,
        "tilt": view.tilt,
        "focal_px": view.focal_px,
        "t": view.t,
        "source": view.source,
        "corners_px": [
            corner if seen else None for corner, seen in zip(view.corners_px.tolist(), view.seen, strict=True)
        ],
    }
