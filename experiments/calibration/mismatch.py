"""Rigs with effects that the model lacks: how far off they point, and whether the calibration detects it.

The default rig is used with 20 boards of 9 x 6 corners at 2.5 to 8 m, four head poses each, and corners of 0.1 px. Each
case adds one effect without a parameter in the model. The pointing error is measured with the same imperfect head, on
targets over the fixed view at 4 to 30 m in turn, with exact pixel and distance (not depth, because a lens of another
model has no defined axis). The goal is an error within twice the predicted one, or a refusal.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cotarget.board import board_points
from cotarget.calibration import View, calibrate_views, predicted_pointing
from cotarget.config import BoardConfig
from cotarget.errors import CalibrationError
from cotarget.geometry import Array
from cotarget.schema import Positive
from experiments.calibration.synthetic.aims import draw_targets, misses
from experiments.calibration.synthetic.rig import LONGEST_PX, SIZES, Lens, Truth, with_lever_shifted
from experiments.calibration.synthetic.views import Boards, Looks, Placing, spread_views
from experiments.engine import Count, Row, Settings
from experiments.tables import grouped, rms

BOARD = BoardConfig()
POINTS = board_points(BOARD)
RIG = Truth()
WITHIN = 2.0  # largest ratio to the predicted error
WRONG_SHARE, WRONG_PX = 0.01, (5.0, 50.0)  # fraction of wrong corners, and their error
SLIPPED = (0.0012, -0.0012, 0.0011)  # 2 mm [m]
Change = Callable[[list[View], np.random.Generator], list[View]]


def as_they_are(views: list[View], _: np.random.Generator) -> list[View]:
    """Leave the views unchanged."""
    return views


def angles_late(views: list[View], _: np.random.Generator) -> list[View]:
    """Give every zoom view the angles of the one before."""
    zoom = [view for view in views if view.camera == "zoom"]
    late = {id(now): (before.pan, before.tilt) for before, now in zip(zoom[:1] + zoom[:-1], zoom, strict=True)}
    return [
        replace(view, pan=late[id(view)][0], tilt=late[id(view)][1]) if view.camera == "zoom" else view
        for view in views
    ]


def wrong_corners(views: list[View], rng: np.random.Generator) -> list[View]:
    """Move some corners to wrong positions."""

    def spoilt(corners_px: Array) -> Array:
        wrong = rng.random(len(corners_px)) < WRONG_SHARE
        angle, length = rng.uniform(0, 2 * np.pi, len(corners_px)), rng.uniform(*WRONG_PX, len(corners_px))
        off = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * length[:, None]
        return corners_px + np.where(wrong[:, None], off, 0.0)

    return [replace(view, corners_px=spoilt(view.corners_px)) for view in views]


def bent(sagitta: float) -> Array:
    """Give the points of a board bent about its shorter axis, with its middle this far in front [m]."""
    across = POINTS[:, 0] - POINTS[:, 0].mean()
    z = sagitta * ((across / across.max()) ** 2 - 1)
    return POINTS + z[:, None] * np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Case:
    """Rig and changes in one case."""

    truth: Truth = RIG  # the rig
    shape: Array | None = None  # true corners of the board [m], (N, 3)
    change: Change = as_they_are  # change of the views
    after: Truth | None = None  # the rig from the middle of the session on


def _fixed(*distortion: float, fisheye: bool = False) -> Case:
    return Case(replace(RIG, fixed=Lens(686.0, 684.0, 325.0, 239.0, distortion, fisheye)))


def _zoom(*distortion: float, fisheye: bool = False) -> Case:
    return Case(replace(RIG, zoom=Lens(692.0, 693.0, 326.0, 235.0, distortion, fisheye)))


# Distances of these lenses from the model's nearest lens: docs/design-notes.md (Experiments).
CASES: Mapping[str, Case] = {
    "as modelled": Case(),
    "fixed lens rational, mild": _fixed(0.5, 0, 0, 0, 0, 1.0, 0.3, 0),
    "fixed lens rational, strong": _fixed(-0.2, 0.3, 0, 0, 0, 0.3, 0, 0.5),
    "fixed lens thin prism": _fixed(-0.2, 0, 0, 0, 0, 0, 0, 0, 0.003, 0.002, -0.002, 0.001),
    "fixed lens fisheye": _fixed(0, 0, 0, 0, fisheye=True),
    "fixed lens fisheye, strong": _fixed(-0.15, 0.1, 0, 0, fisheye=True),
    "zoom lens rational, mild": _zoom(0.5, 0, 0, 0, 0, 1.0, 0.3, 0),
    "zoom lens rational, strong": _zoom(-0.2, 0.3, 0, 0, 0, 0.3, 0, 0.5),
    "zoom lens fisheye": _zoom(0, 0, 0, 0, fisheye=True),
    "sag 0.05 deg": Case(replace(RIG, sag=np.radians(0.05))),
    "encoder scales 0.2 %": Case(replace(RIG, pan_scale=1.002, tilt_scale=0.998)),
    "backlash 0.05 deg": Case(replace(RIG, play=np.radians(0.05))),
    "backlash 0.1 deg": Case(replace(RIG, play=np.radians(0.1))),
    "jitter 0.02 deg": Case(replace(RIG, jitter=np.radians(0.02))),
    "lever gives 2 mm in 30 deg of tilt": Case(replace(RIG, give=(0.0, 0.0, 0.002 / np.radians(30)))),
    "lever slips 2 mm midway": Case(after=with_lever_shifted(RIG, SLIPPED)),
    "board bent 1 mm": Case(shape=bent(0.001)),
    "board bent 2 mm": Case(shape=bent(0.002)),
    "angles one view late": Case(change=angles_late),
    "1 % wrong corners": Case(change=wrong_corners),
}
QUICK_CASES = ("as modelled", "fixed lens thin prism", "backlash 0.1 deg", "angles one view late", "1 % wrong corners")


@dataclass(frozen=True)
class MismatchSettings(Settings):
    """Settings: boards, head poses per board, targets, noise of corners [px], and cases."""

    seeds: Count = 4
    boards: Boards = 20
    looks: Looks = 4
    noise_px: Positive = 0.1
    targets: Count = 100
    cases: tuple[str, ...] = tuple(CASES)


def one(settings: MismatchSettings, seed: int) -> list[Row]:
    """Calibrate every case once; give a row per case."""
    return [_row(settings, seed, case) for case in settings.cases]


def _row(settings: MismatchSettings, seed: int, name: str) -> Row:
    case = CASES[name]
    placing = Placing(boards=settings.boards, looks=settings.looks)

    def views_of(truth: Truth) -> list[View]:
        return spread_views(truth, POINTS, np.random.default_rng((seed, 5)), settings.noise_px, placing, case.shape)

    views, truth = views_of(case.truth), case.truth
    if case.after is not None:
        truth = case.after
        half = settings.boards // 2
        views = [v for v in views if v.board < half] + [v for v in views_of(truth) if v.board >= half]
    row = {"seed": seed, "case": name, "refused": ""}
    try:
        calibration = calibrate_views(case.change(views, np.random.default_rng((seed, 6))), BOARD, SIZES)
    except CalibrationError as error:
        return row | {"refused": str(error)}
    rng = np.random.default_rng((seed, 7))
    pixels, depths = draw_targets(rng, settings.targets)
    off = misses(calibration, truth, pixels, depths, rng, by_distance=True)
    expected = predicted_pointing(calibration, pixels, depths)
    held_out = calibration.held_out
    assert held_out is not None
    assert calibration.residuals is not None
    return row | {
        "measured_px": LONGEST_PX * rms(off),
        "predicted_px": LONGEST_PX * rms(expected),
        "ratio": rms(off) / rms(expected),
        "widened": held_out.widened,
        "held_out_measured_px": held_out.measured_px,
        "held_out_predicted_px": held_out.predicted_px,
        "jitter_deg": float(np.degrees(calibration.jitter)),
        "outliers": calibration.residuals.outliers,
        "views_rejected": len(calibration.residuals.rejected),
    }


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Give rms values, ratios and refusals by case."""
    found: dict[str, dict[str, Any]] = {}
    for case, mine in grouped(rows, "case").items():
        told = [row for row in mine if not row["refused"]]

        def of(key: str, reduce: Callable[[Any], Any] = rms, told: Sequence[Row] = told) -> float:
            return float(reduce([row[key] for row in told])) if told else float("nan")

        found[case] = {
            "measured_px": of("measured_px"),
            "predicted_px": of("predicted_px"),
            "ratio": of("ratio", np.median),
            "ratio_worst": of("ratio", max),
            "held_out_measured_px": of("held_out_measured_px"),
            "held_out_predicted_px": of("held_out_predicted_px"),
            "widened": of("widened", np.median),
            "jitter_deg": of("jitter_deg", np.median),
            "refused": len(mine) - len(told),
            "good": float(np.mean([bool(row["refused"]) or row["ratio"] <= WITHIN for row in mine])),
            "why_refused": sorted({row["refused"] for row in mine if row["refused"]}),
        }
    return found


SETTINGS = MismatchSettings()
QUICK = replace(SETTINGS, seeds=1, boards=15, looks=3, targets=30, cases=QUICK_CASES)
COST_S = 40.0
