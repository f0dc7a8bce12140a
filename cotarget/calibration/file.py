"""calibration.json: readable, replaced atomically, checked when it is read, and with the corners it came from.

Keys: schema; fixed; zoom (stops over the focal length); T_zoom0_fixed; T_head_zoom (or null); head; pitch_mm (or
null); residuals; covariance (or null); held_out (or null); board and board_warp [m]; provenance; views, with null for
a corner that is not seen. Lengths are metres; angles are degrees where people read them, and radians in the views, so
that a refit starts from the very same numbers.
"""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

from cotarget.calibration import parsing
from cotarget.calibration.atomic import write_atomically
from cotarget.calibration.model import Calibration, Residuals, View
from cotarget.calibration.parsing import Table
from cotarget.calibration.reading import RESIDUAL_KEYS, parse_calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import BoardConfig
from cotarget.errors import CalibrationError, choices
from cotarget.geometry import pose_dict

SCHEMA = 2
OWN_KEYS = {"fixed", "zoom", "T_zoom0_fixed"}  # of which a calibration of any version has one
WANTED = "give a calibration.json, as cotarget calibrate writes it"
OTHERS = (
    ({"captures", "board"}, "the index of captures: cotarget calibrate --from its folder makes one of them"),
    ({"versions", "config"}, "what a capture session or a recording says of itself"),
)


def save_calibration(path: Path, calibration: Calibration) -> None:
    """Write calibration.json; the file is replaced in one step.

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
        CalibrationError: the file is missing, malformed or something else; the message names the file and the key.
    """
    table = parsing.read_json(path, WANTED)
    if not (table.keys() & OWN_KEYS):
        raise CalibrationError(f"{path}: is no calibration{_what(table)}; {WANTED}")
    parsing.check_schema(path, table, SCHEMA)
    try:
        found = parse_calibration(table)
        _refuse_unknown(table, _table(found))
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None
    return found


def _table(calibration: Calibration) -> dict[str, Any]:
    """What the file holds."""
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
    """What a file is that is no calibration, where that can be told."""
    return next((f", but {what}" for keys, what in OTHERS if table.keys() >= keys), "")


def _refuse_unknown(read: Any, written: Any, where: str = "") -> None:
    """Refuse a key that nothing is read from, which somebody may have meant to change something by.

    Args:
        read: from the file.
        written: what the same calibration would be written as.
        where: the key of both.

    Raises:
        CalibrationError: with the keys that are known there.
    """
    if isinstance(read, dict) and isinstance(written, dict):
        for key, value in read.items():
            if key not in written:
                raise CalibrationError(f"unknown key '{parsing.join(where, key)}'; valid here: {choices(written)}")
            _refuse_unknown(value, written[key], parsing.join(where, key))
    elif isinstance(read, list) and isinstance(written, list):
        for i, (a, b) in enumerate(zip(read, written, strict=False)):
            _refuse_unknown(a, b, f"{where}[{i}]")


def write_board(board: BoardConfig) -> dict[str, Any]:
    """Write the board as a JSON object."""
    return {"kind": board.kind, "corners": list(board.corners), "square": board.square}


def _readable(table: dict[str, Any]) -> str:
    """Write one line a short value and one line a view, not one line a number."""
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
