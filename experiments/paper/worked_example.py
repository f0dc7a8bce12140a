"""Section 4.2 of the paper, step by step, beside the numbers that it prints.

A book is found at pixel (529, 275), is assumed 10 m away, and should be 160 px wide in the close-up. Each printed
number that follows from the paper's printed inputs is computed again. The entries of its Gamma and T are lost, so that
their effect on a point cannot be computed. What survives of their results can still be checked for consistency, because
T and P are rigid motions.

The exact method is run too, with a T that gives every printed digit with the least rotation. It is one of many, because
the printed results leave T's rotation about the line of sight and its first translation open. Its results are not
compared with the paper's claims.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cotarget.camera import Intrinsics, focal_for_size
from cotarget.geometry import Array, RigidTransform, Rotation, angle_between
from cotarget.pantilt import base_head, shortcut, solve
from experiments.engine import Row, Settings

# Table 2 as (u, v); the paper lists [v, u].
FIXED = Intrinsics((640, 480), (686.0, 684.0), (325.0, 239.0))
ZOOM_SHORTEST_MM, PITCH_MM = 6.237, 0.009
# Section 4.2, in millimetres; lost numbers are nan.
PIXEL, DEPTH_MM = (529.0, 275.0), 10000.0
X_FIXED_MM = (2973.0, 519.0, 10000.0)
X_ZOOM0_MM = (811.0, 563.0, 10464.0)
X_HEAD_MM = (math.nan, 79.54, 10424.0)  # T (0, 0, 10464)
X_BASE_MM = (661.92, math.nan, 10426.0)  # T Gamma x_fixed
ANGLE_DEG = 3.08
BOOK_MM, WANTED_PX = 234.0, 160.0
ZOOM_FACTOR, LARGEST_ZOOM = 10.3, 12.0
CLOSEUP_PX = 7155.0  # focal length of the paper's close-up, at which errors are given in pixels
OFF_MM = 20.0  # least difference of both norms of a rigid motion
KNOWN = "x_fixed: y [mm]"  # does not follow from the paper's own numbers
BESIDE = ("exact", "stand-in T")  # steps without a counterpart in the paper


def jobs(settings: Settings) -> Sequence[int]:
    """Give one job, whatever the number of seeds."""
    return (settings.seed_base,)


def one(settings: Settings, seed: int) -> list[Row]:
    """Compute every step; give a row per number: printed value (nan if none), computed value, and remark."""
    return [
        {"step": step, "quantity": quantity, "unit": unit, "printed": printed, "last_digit": digit, "found": found}
        | {"difference": found - printed, "remark": remark}
        for step, quantity, unit, printed, digit, found, remark in [*_paper(), *_norms(), *_exactly()]
    ]


Line = tuple[str, str, str, float, float, float, str]  # as in `one`; the digit is the unit of the last one printed


def _paper() -> list[Line]:
    """Compute what follows from the printed inputs."""
    x, y, _ = FIXED.ray(np.array(PIXEL)) * DEPTH_MM
    y_half = float((PIXEL[1] - 239.5) / FIXED.focal_px[1] * DEPTH_MM)
    focal_px = focal_for_size(BOOK_MM, WANTED_PX, X_ZOOM0_MM[2])
    focal_mm = focal_px * PITCH_MM
    angle = math.degrees(math.atan(X_ZOOM0_MM[1] / X_ZOOM0_MM[2]))
    return [
        ("x_fixed", "x", "mm", X_FIXED_MM[0], 1.0, float(x), "cut, not rounded"),
        ("x_fixed", "y", "mm", X_FIXED_MM[1], 1.0, float(y), "disagrees with Table 2's centre of 239"),
        ("x_fixed", "y, centre 239.5", "mm", X_FIXED_MM[1], 1.0, y_half, "what the printed one needs"),
        ("angle", "atan(563 / 10464)", "deg", ANGLE_DEG, 0.01, angle, "the tilt's size if T hardly rotates"),
        ("focal", "f", "px", 7155.0, 1.0, focal_px, "Eq. 17 with the depth 10464"),
        ("focal", "f", "mm", math.nan, 0.1, focal_mm, "the printed one is lost"),
        ("focal", "zoom factor", "x", ZOOM_FACTOR, 0.1, focal_mm / ZOOM_SHORTEST_MM, f"of {LARGEST_ZOOM:g}"),
    ]


def _norms() -> list[Line]:
    """Compare |x_head| and |x_base|, which must be equal because P is a rotation."""
    base = math.hypot(X_BASE_MM[0], X_BASE_MM[2])
    head_x = X_BASE_MM[0] - X_ZOOM0_MM[0]  # for a T without rotation
    head = math.hypot(head_x, *X_HEAD_MM[1:])
    pan = math.radians(ANGLE_DEG)
    head_x_pan = (X_BASE_MM[0] - math.sin(pan) * X_HEAD_MM[2]) / math.cos(pan)  # (14) without the tilt
    head_pan = math.hypot(head_x_pan, *X_HEAD_MM[1:])
    nan, mm = math.nan, "mm"
    return [
        ("rigid", "|x_base|, at least", mm, nan, 1.0, base, "its y is lost"),
        ("rigid", "|x_head|, T hardly rotated", mm, nan, 1.0, head, "its x is lost; then it is 661.92 - 811"),
        ("rigid", "short of |x_base| by", mm, nan, 1.0, base - head, "and P must not change it"),
        ("rigid", "|x_head|, if pan is 3.08", mm, nan, 1.0, head_pan, f"then its x is {head_x_pan:.0f} mm, by (14)"),
        ("rigid", "short of |x_base| by", mm, nan, 1.0, base - head_pan, "the contradiction stays"),
    ]


def stand_in() -> RigidTransform:
    """Find the T of least rotation that gives all printed digits of x_head and x_base [mm]."""
    # T rotates (811, 563, 0), the part of x_zoom0 across the axis, to x_base - x_head, whose z is 2 mm.
    x, y, _ = X_ZOOM0_MM
    aside = math.hypot(x, y)
    angle = math.asin((X_BASE_MM[2] - X_HEAD_MM[2]) / aside)
    turn = Rotation.from_rotvec(angle * np.array([y, -x, 0.0]) / aside)
    beside = turn.apply([x, y, 0.0])
    head = np.array([X_BASE_MM[0] - beside[0], *X_HEAD_MM[1:]])
    return RigidTransform.from_components(head - turn.apply([0.0, 0.0, X_ZOOM0_MM[2]]), turn)


def _exactly() -> list[Line]:
    """Compute the exact method, and both readings of the shortcut, with the same T."""
    T, x_zoom0 = stand_in(), np.array(X_ZOOM0_MM)
    nearly = float(np.linalg.norm(x_zoom0))
    found = solve(T.apply(x_zoom0), T)
    pan, tilt, reach = (float(each[0]) for each in (found.pan, found.tilt, found.range))
    nan, asked_for = math.nan, "what the exact method asks for"
    lines: list[Line] = [
        ("exact", "range = |x_zoom0|", "mm", 10464.0, 1.0, nearly, "the depth after centring; 10510 where cut"),
        ("exact", "f at 10510 mm", "px", 7155.0, 1.0, focal_for_size(BOOK_MM, WANTED_PX, 10510.0), asked_for),
        ("stand-in T", "pan", "deg", nan, 0.01, math.degrees(pan), "exact"),
        ("stand-in T", "tilt", "deg", nan, 0.01, math.degrees(tilt), "exact; down is negative"),
        ("stand-in T", "range", "mm", 10464.0, 1.0, reach, "exact; the turned camera has moved too"),
        ("stand-in T", "f", "px", 7155.0, 1.0, focal_for_size(BOOK_MM, WANTED_PX, reach), asked_for),
    ]
    gamma = RigidTransform.from_translation(x_zoom0 - np.array(X_FIXED_MM))  # used for the depth in x_fixed only
    for words, reading in (("Table 1", "table"), ("Section 4.2", "example")):
        short = shortcut(np.array(X_FIXED_MM), gamma, T, reading)  # type: ignore[arg-type]
        off = _miss(T, x_zoom0, float(short.pan), float(short.tilt))
        lines += [
            ("shortcut", f"pan, depth of {words}", "deg", nan, 0.01, math.degrees(float(short.pan)), ""),
            ("shortcut", f"tilt, depth of {words}", "deg", nan, 0.01, math.degrees(float(short.tilt)), ""),
            ("shortcut", f"misses, depth of {words}", "px", nan, 1.0, CLOSEUP_PX * math.tan(off), "in the close-up"),
        ]
    return lines


def _miss(T: RigidTransform, x_zoom0: Array, pan: float, tilt: float) -> float:
    """Compute the angle between the zoom camera's axis, with the head at pan and tilt, and a point [rad]."""
    x_zoom = (T.inv() * base_head(pan, tilt).inv() * T).apply(x_zoom0)  # (2)
    return float(angle_between(np.array([0.0, 0.0, 1.0]), x_zoom))


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Give every number by step and quantity, and the printed ones that do not follow."""
    found: dict[str, Any] = {}
    for i, row in enumerate(rows, 1):
        key = f"{i}. {row['step']}: {row['quantity']} [{row['unit']}]"
        found[key] = {name: row[name] for name in ("printed", "found", "difference", "last_digit")}
        found[key] |= {"remark": row["remark"], "agrees": agrees(row)}
    return found


def agrees(row: Row) -> bool | None:
    """Check that a printed number is the computed one, cut or rounded to its last digit; None where none is printed."""
    if math.isnan(row["printed"]):
        return None
    return bool(abs(row["difference"]) < row["last_digit"])


def _is_beside(key: str) -> bool:
    """Check whether a figure has no counterpart in the paper."""
    return any(f". {step}: " in key for step in BESIDE)


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List numbers that follow from the paper in another way than this module states."""
    own = {key: line for key, line in summary.items() if not _is_beside(key)}
    wrong = [
        key for key, line in own.items() if line["agrees"] is not (KNOWN not in key) and line["agrees"] is not None
    ]
    short = [line["found"] for key, line in summary.items() if "short of |x_base|" in key]
    off = [line["found"] for key, line in summary.items() if ": misses" in key]
    texts = [f"{key}: {'not ' * (not own[key]['agrees'])}as printed" for key in wrong]
    if min(short) < OFF_MM:
        texts.append(f"|x_head| is only {min(short):.1f} mm short of |x_base|")
    if min(off) < 1:
        texts.append(f"the shortcut misses by only {min(off):.2f} px")
    return texts


SETTINGS = Settings(seeds=1)
COST_S = 0.1
