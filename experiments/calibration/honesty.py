"""Consistency of a calibration's covariance: how many 90 % ellipses contain the truth.

There are 12 boards of 9 x 6 corners at 2.5 to 8 m, four head poses each, and corners of 0.1 px; the rigs are the
default one and one with a wide baseline, toed in and rolled. Each seed draws its own boards, poses and noise. No
captures are held out, because they could only widen the ellipses. The measured and the predicted pointing error are
given for the same targets.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from cotarget.board import board_points
from cotarget.calibration import Calibration, Options, calibrate_views, predicted_pointing
from cotarget.calibration.bundle import ALL_BLOCKS, parameter_names
from cotarget.config import BoardConfig
from cotarget.schema import Positive
from experiments.calibration.synthetic.aims import draw_targets, misses
from experiments.calibration.synthetic.rig import LONGEST_PX, SIZES, Truth, other_rig
from experiments.calibration.synthetic.views import Boards, Looks, Placing, spread_views
from experiments.engine import Count, Row, Settings
from experiments.tables import grouped, rms

BOARD = BoardConfig()
RIGS = {"default rig": Truth(), "toed-in rig": other_rig()}
LEVEL = 0.9
GROUPS = {
    "T": tuple(n for n in parameter_names(ALL_BLOCKS) if n.startswith("T_head_zoom")),
    "Gamma": tuple(n for n in parameter_names(ALL_BLOCKS) if n.startswith("T_zoom0_fixed")),
    "wide focal length": ("fixed.fx", "fixed.fy"),
    "zoom focal length": ("zoom[0].fx", "zoom[0].fy"),
    "everything": parameter_names(ALL_BLOCKS),
}


@dataclass(frozen=True)
class HonestySettings(Settings):
    """Settings: boards, head poses per board, targets, and noise of corners [px]."""

    seeds: Count = 60
    boards: Boards = 12
    looks: Looks = 4
    noise_px: Positive = 0.1
    targets: Count = 20


def one(settings: HonestySettings, seed: int) -> list[Row]:
    """Calibrate both rigs once; give a row per rig."""
    return [_row(settings, seed, rig) for rig in RIGS]


def _row(settings: HonestySettings, seed: int, rig: str) -> Row:
    truth = RIGS[rig]
    placing = Placing(boards=settings.boards, looks=settings.looks)
    rng = np.random.default_rng((seed, 8))
    views = spread_views(truth, board_points(BOARD), rng, settings.noise_px, placing)
    calibration = calibrate_views(views, BOARD, SIZES, options=Options(folds=0))
    targets = draw_targets(np.random.default_rng((seed, 9)), settings.targets)
    return {
        "seed": seed,
        "rig": rig,
        **{name: inside(calibration, truth, parameters, LEVEL) for name, parameters in GROUPS.items()},
        "measured_px": LONGEST_PX * rms(misses(calibration, truth, *targets)),
        "predicted_px": LONGEST_PX * rms(predicted_pointing(calibration, *targets)),
        "jitter_deg": float(np.degrees(calibration.jitter)),
    }


def inside(calibration: Calibration, truth: Truth, names: Sequence[str], level: float) -> bool:
    """Check that the truth is within the ellipsoid of a level of these parameters."""
    covariance, error = calibration.covariance, error_of(calibration, truth)
    assert covariance is not None
    rows = [covariance.parameters.index(name) for name in names]
    e = np.array([error[name] for name in names])
    return bool(e @ np.linalg.solve(covariance.matrix[np.ix_(rows, rows)], e) < chi2.ppf(level, len(rows)))


def error_of(calibration: Calibration, truth: Truth) -> dict[str, float]:
    """Compute truth minus estimate by name; for a transform, the rotation exp(w) in front of R and the shift of t."""
    pairs = [
        ("fixed", truth.fixed, calibration.fixed.lens),
        ("zoom[0]", truth.zoom, calibration.zoom_head.lens.stops[0]),
    ]
    error = {
        f"{camera}.{name}": a - b
        for camera, true, lens in pairs
        for name, a, b in zip(
            ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
            (true.fx, true.fy, true.cx, true.cy, *true.distortion[:4]),
            (*lens.focal_px, *lens.center_px, *lens.distortion[:4]),
            strict=True,
        )
    }
    transforms = [
        ("T_zoom0_fixed", truth.gamma, calibration.zoom_head.T_zoom0_fixed),
        ("T_head_zoom", truth.hand, calibration.zoom_head.hand_eye()),
    ]
    for transform, true_T, found in transforms:
        turn, shift = (true_T.rotation * found.rotation.inv()).as_rotvec(), true_T.translation - found.translation
        error |= {
            f"{transform}.{k}": float(v)
            for k, v in zip(("rx", "ry", "rz", "tx", "ty", "tz"), (*turn, *shift), strict=True)
        }
    error["head.axis_offset"] = truth.dz - calibration.zoom_head.axes.axis_offset
    error["head.squareness"] = truth.eps - calibration.zoom_head.axes.squareness
    error |= {f"board.warp_{axis}": -warp for axis, warp in zip("xy", calibration.board_warp, strict=True)}
    return error


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give fractions of ellipses that contain the truth, and rms pointing errors."""
    return {
        rig: {
            **{name: float(np.mean([row[name] for row in mine])) for name in GROUPS},
            "measured_px": rms(row["measured_px"] for row in mine),
            "predicted_px": rms(row["predicted_px"] for row in mine),
            "measured_over_predicted": rms(r["measured_px"] for r in mine) / rms(r["predicted_px"] for r in mine),
            "jittered": float(np.mean([row["jitter_deg"] > 0 for row in mine])),
        }
        for rig, mine in grouped(rows, "rig").items()
    }


SETTINGS = HonestySettings()
QUICK = replace(SETTINGS, seeds=2, boards=8)
COST_S = 5.0
