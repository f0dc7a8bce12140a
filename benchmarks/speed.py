"""Time of the joint fit, against OpenCV's calibration of the same corners.

There are 40 views of a board by two cameras, 20 pairs with the head at home; both cameras' intrinsics and Gamma are
wanted. The ways are `calibrate_views` without held-out captures, and cv2.calibrateCamera for each camera followed by
cv2.stereoCalibrate, with fixed intrinsics and with everything free, as in the joint fit. They take turns, because a
machine's speed drifts; figures are medians over the seeds, on each way's default number of threads.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge

from cotarget.board import board_points
from cotarget.calibration import Options, View, calibrate_views
from cotarget.calibration.initialization import FEWEST_VIEWS
from cotarget.config import BoardConfig
from cotarget.schema import Positive
from experiments.calibration.synthetic.rig import SIZE, SIZES, Truth
from experiments.calibration.synthetic.views import synthetic_views
from experiments.engine import Count, Row, Settings

BOARD = BoardConfig()
POINTS = board_points(BOARD)
TRUTH = Truth()
JOINT, HELD, FREE = "joint fit", "OpenCV, intrinsics held", "OpenCV, everything free"


@dataclass(frozen=True)
class SpeedSettings(Settings):
    """Settings: pairs of views, and noise of corners [px]."""

    seeds: Count = 5
    pairs: Annotated[int, Ge(FEWEST_VIEWS)] = 20
    noise_px: Positive = 0.2


def one(settings: SpeedSettings, seed: int) -> list[Row]:
    """Time each way once; give a row per way."""
    views = synthetic_views(
        TRUTH,
        POINTS,
        np.random.default_rng((seed, 10)),
        boards=settings.pairs,
        noise_px=settings.noise_px,
        moved=0,
        pan_range=0.0,
        tilt_range=0.0,
    )
    ways: dict[str, Callable[[Sequence[View]], float]] = {
        JOINT: _joint,
        HELD: lambda views: _opencv(views, cv2.CALIB_FIX_INTRINSIC),
        FREE: lambda views: _opencv(views, cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3),
    }
    rows = []
    for way, work in ways.items():
        began = time.perf_counter()
        baseline = work(views)
        seconds = time.perf_counter() - began
        off_mm = 1e3 * (baseline - float(np.linalg.norm(TRUTH.gamma.translation)))
        rows.append({"seed": seed, "way": way, "seconds": seconds, "views": len(views), "baseline_off_mm": off_mm})
    return rows


def _joint(views: Sequence[View]) -> float:
    calibration = calibrate_views(views, BOARD, SIZES, options=Options(folds=0))
    return float(np.linalg.norm(calibration.zoom_head.T_zoom0_fixed.translation))


def _opencv(views: Sequence[View], flags: int) -> float:
    """Calibrate with OpenCV; give the baseline [m]."""
    left, right = (
        [v.corners_px.astype(np.float32) for v in views if v.camera == camera] for camera in ("fixed", "zoom")
    )
    objects = [POINTS.astype(np.float32)] * len(left)
    cameras = []
    for mine in (left, right):
        _, K, distortion, _, _ = cv2.calibrateCamera(
            objects, mine, SIZE, np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3
        )
        cameras.append((K, distortion))
    (K_l, d_l), (K_r, d_r) = cameras
    t = cv2.stereoCalibrate(objects, left, right, K_l, d_l, K_r, d_r, SIZE, flags=flags)[6]
    return float(np.linalg.norm(t))


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give median seconds, the ratio to the joint fit's, and the baseline's rms error."""
    joint = np.median([row["seconds"] for row in rows if row["way"] == JOINT])
    found = {}
    for way in (JOINT, HELD, FREE):
        mine = [row for row in rows if row["way"] == way]
        seconds = float(np.median([row["seconds"] for row in mine]))
        off = float(np.sqrt(np.mean([row["baseline_off_mm"] ** 2 for row in mine])))
        found[way] = {"seconds": seconds, "joint_over_this": float(joint / seconds), "baseline_off_mm": off}
    return found


SETTINGS = SpeedSettings()
QUICK = replace(SETTINGS, seeds=1, pairs=8)
ALONE = True
COST_S = 5.0
