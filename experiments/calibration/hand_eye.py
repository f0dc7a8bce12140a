"""Hand-eye calibration: T from 20 poses of one board, all else known, against the Cramer-Rao bound.

A board of 0.89 x 0.67 m is 3 m away, the head turns as far as the board stays in the image (f = 693 px), and corners
have noise of 0.2 px. Park and Martin's closed form and the weighted fit over poses get the board's pose in each view;
the joint fit uses the corners. Errors are root mean squares over the seeds; the bound is computed for each seed's own
poses.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge
from scipy.stats import chi2

from cotarget.calibration.bundle import fit
from cotarget.calibration.handeye import motions, park_martin, solve_hand_eye
from cotarget.calibration.initialization import board_pose
from cotarget.calibration.model import BundleModel, View
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.pantilt import base_head
from cotarget.rig_geometry import FixedCamera, ZoomHead
from cotarget.schema import Positive
from experiments.calibration.synthetic.rig import NOMINAL_PX, SIZE, Lens, Truth
from experiments.calibration.synthetic.views import noisy, seen_from
from experiments.engine import Row, Settings
from experiments.tables import rms

LENS = Lens(693.0, 693.0, 319.5, 239.5)
COLUMNS, ROWS, WIDTH, HEIGHT = 14, 11, 0.89, 0.67  # number of corners, and distance of the outer ones [m]
DISTANCE = 3.0  # [m]
BOARD_TURNED = (20.0, -15.0, 5.0)  # [degrees]
REACH = (np.radians(40.0), np.radians(30.0))  # more than the image allows
LEVEL = 0.9
METHODS = ("Park and Martin", "poses, weighted", "joint fit")
DRAWN = 400  # head poses drawn at a time; the first that see the board are taken
FEWEST_POSES = 3  # least number that determines T: two poses rotate the head about one axis only


@dataclass(frozen=True)
class HandEyeSettings(Settings):
    """Settings: number of poses, and noise of corners [px]."""

    poses: Annotated[int, Ge(FEWEST_POSES)] = 20
    noise_px: Positive = 0.2  # the bound is 0 without noise


def one(settings: HandEyeSettings, seed: int) -> list[Row]:
    """Draw poses and noise, solve by each method; give a row per method."""
    rng = np.random.default_rng((seed, 1))
    truth = Truth(zoom=LENS, dz=0.0, eps=0.0)
    v, u = np.mgrid[:ROWS, :COLUMNS]
    points = np.c_[u.ravel() * WIDTH / (COLUMNS - 1), v.ravel() * HEIGHT / (ROWS - 1), np.zeros(u.size)]
    middle = points.mean(axis=0)
    turned = Rotation.from_rotvec(BOARD_TURNED, degrees=True)
    x_zoom0 = RigidTransform.from_components([0.0, 0.0, DISTANCE], turned).apply(points - middle)
    x_fixed = truth.gamma.inv().apply(x_zoom0)
    poses = np.empty((0, 2))
    while len(poses) < settings.poses:
        drawn = rng.uniform(np.negative(REACH), REACH, (DRAWN, 2))
        poses = np.r_[poses, drawn[seen_from(truth, x_fixed, drawn)]]
    poses = poses[: settings.poses]
    views = [
        View("zoom", noisy(LENS.project(truth.in_zoom(x_fixed, *q)), settings.noise_px, rng), 0, q[0], q[1], NOMINAL_PX)
        for q in poses
    ]
    lens = Intrinsics(SIZE, (LENS.fx, LENS.fy), (LENS.cx, LENS.cy))
    heads = [base_head(view.pan, view.tilt) for view in views]
    seen = [board_pose(lens, view.corners_px, points) for view in views]
    closed = park_martin(*motions(heads, seen))
    weighted = solve_hand_eye(heads, seen, middle=middle)
    board = (truth.gamma.inv() * closed.inv() * heads[0] * closed) * seen[0]
    zoom_head = ZoomHead(ZoomLens((NOMINAL_PX,), (lens,)), truth.gamma, closed)
    start = BundleModel({0: board}, FixedCamera(lens), zoom_head)  # without views of the fixed camera
    joint = fit(start, views, points, {"hand"})
    inverse = np.asarray(np.linalg.inv(joint.normal), float)
    assert joint.variance is not None
    found: dict[str, tuple[RigidTransform, Array | None]] = {
        "Park and Martin": (closed, None),
        "poses, weighted": (weighted.X, weighted.covariance),
        "joint fit": (joint.model.head.hand_eye(), inverse * joint.variance),
    }
    bound = inverse * settings.noise_px**2
    return [_row(seed, method, X, covariance, bound, truth.hand) for method, (X, covariance) in found.items()]


def _row(
    seed: int, method: str, X: RigidTransform, covariance: Array | None, bound: Array, hand: RigidTransform
) -> Row:
    error = np.concatenate([(hand.rotation * X.rotation.inv()).as_rotvec(), hand.translation - X.translation])
    inside = None
    if covariance is not None:
        inside = bool(error @ np.linalg.solve(covariance, error) < chi2.ppf(LEVEL, len(error)))
    return {
        "seed": seed,
        "method": method,
        "rotation_deg": float(np.degrees(np.linalg.norm(error[:3]))),
        "translation_mm": float(1e3 * np.linalg.norm(error[3:])),
        "bound_deg": float(np.degrees(np.sqrt(np.trace(bound[:3, :3])))),
        "bound_mm": float(1e3 * np.sqrt(np.trace(bound[3:, 3:]))),
        "inside": inside,
    }


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give rms errors, their ratios to the bound, and the fraction of 90 % ellipsoids that contain the truth."""
    found = {}
    for method in METHODS:
        mine = [row for row in rows if row["method"] == method]
        rotation, translation, bound_deg, bound_mm = (
            rms(row[key] for row in mine) for key in ("rotation_deg", "translation_mm", "bound_deg", "bound_mm")
        )
        told = [row["inside"] for row in mine if row["inside"] is not None]
        found[method] = {
            "rotation_deg": rotation,
            "translation_mm": translation,
            "rotation_ratio": rotation / bound_deg,
            "translation_ratio": translation / bound_mm,
            "inside": float(np.mean(told)) if told else float("nan"),
        }
    found["Cramer-Rao"] = {"rotation_deg": bound_deg, "translation_mm": bound_mm}
    return found


SETTINGS = HandEyeSettings()
QUICK = replace(SETTINGS, seeds=5)
COST_S = 0.3
