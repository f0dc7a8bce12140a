"""Calibration result and its file, calibration.json.

The file holds the result, its uncertainty and the corners it comes from, so that it can be checked and refitted. Keys:
schema; fixed; zoom (zoom samples, as stops); T_zoom0_fixed; T_head_zoom (or null); head; pitch_mm (or null); residuals;
covariance (or null); held_out (or null); board and board_warp [m]; provenance; views, with null for a corner that is
not seen. Lengths are metres. Angles are degrees where people read them, and radians in the views, so that a refit
starts from exactly the same numbers.

`CalibrationTable` and its parts describe the keys; `validate` checks them.
"""

import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Interval

from cotarget.calibration.bundle import EVERY_BLOCK, parameter_names
from cotarget.calibration.model import CameraName, Covariance, HeldOut, Residuals, View
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import BoardConfig, WrittenBoard
from cotarget.errors import CalibrationError, ConfigError
from cotarget.files import write_atomically
from cotarget.geometry import RigidTransform, pose_dict
from cotarget.pantilt import HeadGeometry
from cotarget.rig_geometry import FixedCamera, ZoomHead
from cotarget.schema import NotNegative, Pose, Positive, Size, model, validate

Table = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration of a rig, with the views it comes from.

    Attributes:
        fixed: fixed camera.
        zoom_head: zoom camera on its pan-tilt head.
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

    fixed: FixedCamera
    zoom_head: ZoomHead
    pitch_mm: float | None = None
    residuals: Residuals | None = None
    covariance: Covariance | None = None
    jitter: float = 0.0
    held_out: HeldOut | None = None
    board_warp: tuple[float, float] = (0.0, 0.0)
    board: BoardConfig | None = None
    views: tuple[View, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def for_streams(self, fixed_size: tuple[int, int], zoom_size: tuple[int, int]) -> "Calibration":
        """Return the calibration for streams scaled to other sizes (width, height) [px].

        Raises:
            ConfigError: the aspect ratio of a stream differs from that calibrated.
        """
        zoom = self.zoom_head.lens
        factors = {"fixed": fixed_size[0] / self.fixed.size[0], "zoom": zoom_size[0] / zoom.size[0]}
        covariance = self.covariance
        if covariance is not None:
            in_pixels = ("fx", "fy", "cx", "cy")
            covariance = covariance.scaled(
                {f"fixed.{k}": factors["fixed"] for k in in_pixels}
                | {f"zoom[{i}].{k}": factors["zoom"] for i in range(len(zoom.stops)) for k in in_pixels}
            )
        pitch_mm = self.pitch_mm and self.pitch_mm * zoom.size[0] / zoom_size[0]  # a larger pixel, where binned
        return replace(
            self,
            fixed=self.fixed.resized(fixed_size),
            zoom_head=self.zoom_head.resized(zoom_size),
            covariance=covariance,
            pitch_mm=pitch_mm,
            views=tuple(view.scaled(factors[view.camera]) for view in self.views),
        )

    @classmethod
    def load(cls, path: Path | str) -> "Calibration":
        """Read a calibration.json.

        Raises:
            CalibrationError: the file is missing, malformed or no calibration; the message names the file and the key.
        """
        path = Path(path)
        table = read_object(path, WANTED)
        if not (table.keys() & OWN_KEYS):
            raise CalibrationError(f"{path}: is no calibration; {WANTED}")
        check_schema(path, table, SCHEMA)
        try:
            return validate(CalibrationTable, table, "").calibration()
        except (ConfigError, CalibrationError) as error:
            raise CalibrationError(f"{path}: {error}") from None

    def save(self, path: Path | str) -> None:
        """Write a calibration.json atomically.

        Raises:
            ConfigError: the file cannot be written.
            CalibrationError: the calibration holds a number that is not finite.
        """
        try:
            text = json.dumps(_table(self), default=_plain, allow_nan=False)
        except ValueError as error:
            raise CalibrationError(f"{path}: not written: {error}") from None
        write_atomically(Path(path), _readable(json.loads(text)).encode())


def read_object(path: Path, wanted: str) -> Table:
    """Read a JSON object from a file."""

    def refuse(constant: str) -> None:
        raise CalibrationError(f"{path}: holds the number {constant}, which is not finite")

    try:
        text = path.read_text(encoding="utf-8")
        table = json.loads(text, parse_constant=refuse)
    except FileNotFoundError:
        raise CalibrationError(f"{path}: no such file; {wanted}") from None
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise CalibrationError(f"{path}: is not UTF-8 text; {wanted}") from None
    except (json.JSONDecodeError, RecursionError) as error:
        raise CalibrationError(f"{path}: is not JSON: {error}; {wanted}") from None
    if not isinstance(table, dict):
        raise CalibrationError(f"{path}: holds no JSON object; {wanted}")
    return table


def check_schema(path: Path, table: Table, schema: int) -> None:
    """Refuse a file of another schema version."""
    if "schema" not in table:
        raise CalibrationError(f"{path}: missing key 'schema'; this version reads schema {schema}")
    if table["schema"] != schema or isinstance(table["schema"], bool):
        raise CalibrationError(f"{path}: schema {table['schema']!r} is not {schema}, the one that this version reads")


# Tables of calibration.json

# Largest asymmetry and negative eigenvalue that rounding leaves per parameter, in a covariance scaled to a unit
# diagonal.
ROUNDING = 1e-9
# Values beyond these are mistyped: an encoder's scale is within percents of 1, and no lens is longer than a telescope's
# 1e7 px, has its axis more than ten images off the middle, or needs coefficients that large.
IMAGES_OFF = 10.0
Scale = Annotated[float, Interval(ge=0.5, le=2.0)]
FocalPx = Annotated[float, Interval(ge=1.0, le=1e7)]
Coefficient = Annotated[float, Interval(ge=-1e6, le=1e6)]
Distortion = Annotated[tuple[Coefficient, Coefficient, Coefficient, Coefficient, Coefficient], "[k1, k2, p1, p2, k3]"]


@model
class FixedTable:
    """The fixed camera."""

    size: Size
    fx: FocalPx
    fy: FocalPx
    cx: float
    cy: float
    distortion: Distortion

    def __post_init__(self) -> None:
        _check_center(self, self.size)


@model
class StopTable:
    """A zoom sample."""

    nominal_px: FocalPx
    fx: FocalPx
    fy: FocalPx
    cx: float
    cy: float
    distortion: Distortion
    pupil: float


def _check_center(lens: FixedTable | StopTable, size: tuple[int, int], where: str = "") -> None:
    """Refuse a principal point that is far off the image."""
    far = IMAGES_OFF * max(size)
    for key, value in (("cx", lens.cx), ("cy", lens.cy)):
        if not -far <= value <= far:
            raise ValueError(f"{where}{key}: {value:g} is not within {-far:g} to {far:g}")


def _intrinsics(lens: FixedTable | StopTable, size: tuple[int, int]) -> Intrinsics:
    return Intrinsics(size, (lens.fx, lens.fy), (lens.cx, lens.cy), lens.distortion)


@model
class ZoomTable:
    """The zoom lens."""

    size: Size
    stops: tuple[StopTable, ...]

    def __post_init__(self) -> None:
        if not self.stops:
            raise ValueError("stops: is empty; at least one calibrated focal length is needed")
        for i, stop in enumerate(self.stops):
            _check_center(stop, self.size, f"stops[{i}].")
        if any(b.nominal_px <= a.nominal_px for a, b in itertools.pairwise(self.stops)):
            raise ValueError("stops: the values of nominal_px do not increase")
        if self.stops[0].pupil != 0:
            raise ValueError("stops[0].pupil: is not 0, from which the others are counted")

    def lens(self) -> ZoomLens:
        """Make the zoom lens."""
        return ZoomLens(
            tuple(stop.nominal_px for stop in self.stops),
            tuple(_intrinsics(stop, self.size) for stop in self.stops),
            tuple(stop.pupil for stop in self.stops),
        )


@model
class HeadTable:
    """The head's geometry and jitter."""

    axis_offset: float
    squareness_deg: float
    pan_scale: Scale
    tilt_scale: Scale
    pan_zero_deg: float
    tilt_zero_deg: float
    jitter_deg: NotNegative

    def geometry(self) -> HeadGeometry:
        """Make the head's geometry."""
        squareness, *zeros = map(math.radians, (self.squareness_deg, self.pan_zero_deg, self.tilt_zero_deg))
        return HeadGeometry(self.axis_offset, squareness, self.pan_scale, self.tilt_scale, *zeros)


@model
class CovarianceTable:
    """The covariance."""

    parameters: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        n = len(self.parameters)
        if len(self.matrix) != n:
            raise ValueError(f"matrix: has {len(self.matrix)} values where {n} are wanted")
        for i, row in enumerate(self.matrix):
            if len(row) != n:
                raise ValueError(f"matrix[{i}]: has {len(row)} values where {n} are wanted")

    def covariance(self) -> Covariance:
        """Make the covariance."""
        n = len(self.parameters)
        return Covariance(self.parameters, np.array(self.matrix).reshape(n, n))


@model
class ViewTable:
    """A view; its corners are null where they are not seen."""

    camera: CameraName
    board: Annotated[int, Ge(0)]
    pan: float
    tilt: float
    focal_px: Positive | None
    t: float
    source: str | None
    corners_px: tuple[Annotated[tuple[float, float], "[u, v]"] | None, ...]

    @classmethod
    def of(cls, view: View) -> "ViewTable":
        """Make the table of a view."""
        return cls(**vars(view) | {"corners_px": [None if math.isnan(u) else (u, v) for u, v in view.corners_px]})

    def view(self) -> View:
        """Make the view."""
        corners_px = np.array([(np.nan, np.nan) if corner is None else corner for corner in self.corners_px])
        return View(**vars(self) | {"corners_px": corners_px})


@model
class CalibrationTable:
    """Content of calibration.json."""

    schema: int
    fixed: FixedTable
    zoom: ZoomTable
    T_zoom0_fixed: Pose
    T_head_zoom: Pose | None
    head: HeadTable
    pitch_mm: Positive | None
    residuals: Residuals | None
    covariance: CovarianceTable | None
    held_out: HeldOut | None
    board: WrittenBoard | None
    board_warp: Annotated[tuple[float, float], "[along x, along y]"]
    provenance: Mapping[str, Any]
    views: tuple[ViewTable, ...]

    def __post_init__(self) -> None:
        if self.board is None:
            if self.views:
                raise ValueError("board: is null, but there are views of one")
            return
        corners = math.prod(self.board.corners)
        for i, view in enumerate(self.views):
            if len(view.corners_px) != corners:
                raise ValueError(f"views[{i}].corners_px: has {len(view.corners_px)} values where {corners} are wanted")

    def calibration(self) -> Calibration:
        """Make the calibration."""
        if self.covariance is not None:
            check_covariance(self.covariance.covariance(), len(self.zoom.stops))
        return Calibration(
            fixed=FixedCamera(_intrinsics(self.fixed, self.fixed.size)),
            zoom_head=ZoomHead(self.zoom.lens(), self.T_zoom0_fixed, self.T_head_zoom, self.head.geometry()),
            jitter=math.radians(self.head.jitter_deg),
            pitch_mm=self.pitch_mm,
            residuals=self.residuals,
            covariance=None if self.covariance is None else self.covariance.covariance(),
            held_out=self.held_out,
            board_warp=self.board_warp,
            board=None if self.board is None else self.board.config(),
            views=tuple(view.view() for view in self.views),
            provenance=self.provenance,
        )


def check_covariance(covariance: Covariance, stops: int) -> None:
    """Refuse a matrix that is no covariance, and parameters that the rig does not have."""
    names, C = covariance.parameters, covariance.matrix
    known = parameter_names(EVERY_BLOCK, stops)
    if unknown := [name for name in names if name not in known]:
        raise CalibrationError(f"covariance.parameters: '{unknown[0]}' is no parameter; they are: {', '.join(known)}")
    if not names:
        raise CalibrationError("covariance.parameters: is empty; a method without uncertainty has null instead")
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


# Reading and writing calibration.json

SCHEMA = 2
OWN_KEYS = {"fixed", "zoom", "T_zoom0_fixed"}  # a calibration of any version has at least one of these
WANTED = "give a calibration.json, as cotarget calibrate writes it"


def _table(calibration: Calibration) -> CalibrationTable:
    """Make the content of the file."""
    zoom, covariance, degrees = calibration.zoom_head, calibration.covariance, math.degrees
    axes = zoom.axes
    lenses = zip(zoom.lens.nominal_px, zoom.lens.stops, zoom.lens.pupil, strict=True)
    return CalibrationTable(
        schema=SCHEMA,
        fixed=FixedTable(calibration.fixed.size, *_numbers(calibration.fixed.lens)),
        zoom=ZoomTable(zoom.lens.size, tuple(StopTable(px, *_numbers(lens), pupil) for px, lens, pupil in lenses)),
        T_zoom0_fixed=zoom.T_zoom0_fixed,
        T_head_zoom=zoom.T_head_zoom,
        head=HeadTable(
            axes.axis_offset,
            degrees(axes.squareness),
            axes.pan_scale,
            axes.tilt_scale,
            degrees(axes.pan_zero),
            degrees(axes.tilt_zero),
            degrees(calibration.jitter),
        ),
        pitch_mm=calibration.pitch_mm,
        residuals=calibration.residuals,
        covariance=None if covariance is None else CovarianceTable(covariance.parameters, covariance.matrix.tolist()),
        held_out=calibration.held_out,
        board=None if calibration.board is None else WrittenBoard(**vars(calibration.board)),
        board_warp=calibration.board_warp,
        provenance=calibration.provenance,
        views=tuple(map(ViewTable.of, calibration.views)),
    )


def _numbers(lens: Intrinsics) -> tuple[float, float, float, float, Any]:
    return *lens.focal_px, *lens.center_px, lens.distortion


def _plain(value: Any) -> Mapping[str, Any]:
    """Convert a pose or a table for JSON."""
    return pose_dict(value) if isinstance(value, RigidTransform) else vars(value)


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
