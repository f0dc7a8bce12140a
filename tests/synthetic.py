"""A rig made of numbers: its truth, what its cameras see of a board, and how far off a calibration of it points.

Nothing here uses the package's camera or head model: corners come from cv2.projectPoints and written-out matrices.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares

from cotarget.calibration import Calibration, View
from cotarget.geometry import RigidTransform, Rotation, pose
from cotarget.simconfig import DEFAULT_GAMMA, DEFAULT_T

SIZE = (640, 480)


@dataclass(frozen=True)
class Lens:
    """True intrinsics."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def K(self):
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def project(self, x_camera):
        px, _ = cv2.projectPoints(
            np.asarray(x_camera, float).reshape(-1, 1, 3), np.zeros(3), np.zeros(3), self.K, np.array(self.distortion)
        )
        return np.asarray(px).reshape(-1, 2)

    def sees(self, x_camera, margin=0.0):
        """Whether all points are in front of the camera, unfolded, and inside the image."""
        x_camera = np.asarray(x_camera)
        if (x_camera[:, 2] < 0.2).any() or np.abs(x_camera[:, :2] / x_camera[:, 2:]).max() > 1.2:
            return False
        px = self.project(x_camera)
        return bool((px >= margin).all() and (px <= np.array(SIZE) - 1 - margin).all())


@dataclass(frozen=True)
class Truth:
    """A whole rig, and the matrices of its head written out."""

    fixed: Lens = Lens(686.0, 684.0, 325.0, 239.0, (-0.2, 0.0, 0.0, 0.0, 0.0))
    zoom: Lens = Lens(692.0, 693.0, 326.0, 235.0, (-0.1, 0.0, 0.0, 0.0, 0.0))
    gamma: RigidTransform = DEFAULT_GAMMA
    hand: RigidTransform = DEFAULT_T
    dz: float = 0.005
    eps: float = np.radians(0.1)

    def base_head(self, pan, tilt):
        c, s = np.cos(pan), np.sin(pan)
        Y = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])
        ce, se = np.cos(self.eps), np.sin(self.eps)
        Z = np.array([[ce, -se, 0, 0], [se, ce, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        c, s = np.cos(tilt), np.sin(tilt)
        X = np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])
        D = np.eye(4)
        D[2, 3] = self.dz
        return Y @ D @ Z @ X @ Z.T @ np.linalg.inv(D)

    def zoom_fixed(self, pan, tilt):
        T = self.hand.as_matrix()
        return np.linalg.inv(T) @ np.linalg.inv(self.base_head(pan, tilt)) @ T @ self.gamma.as_matrix()

    def in_zoom(self, x_fixed, pan, tilt):
        M = self.zoom_fixed(pan, tilt)
        return x_fixed @ M[:3, :3].T + M[:3, 3]


def other_rig():
    """A wide baseline, toed in, with a long lever and a rolled camera."""
    return Truth(gamma=pose([-1.5, 0.1, -0.1], [1.0, 12.0, 5.0]), hand=pose([0.1, -0.15, 0.08], [2.0, 1.5, 5.0]))


def synthetic_views(truth, points, rng, boards=30, noise_px=0.1, moved=3, pan_range=0.5, tilt_range=0.4, far=8.0):
    """Views of boards held at random where the fixed camera sees them, home and moved."""
    views = []
    center = points.mean(axis=0)
    number = 0
    for _ in range(100000):
        if number == boards:
            break
        depth = np.exp(rng.uniform(np.log(2.5), np.log(far)))
        uv = rng.uniform([40, 40], [600, 440])
        ray = np.array([(uv[0] - truth.fixed.cx) / truth.fixed.fx, (uv[1] - truth.fixed.cy) / truth.fixed.fy, 1.0])
        R = Rotation.from_rotvec(np.radians(rng.uniform([-35, -35, -20], [35, 35, 20])))
        x_fixed = R.apply(points - center) + ray * depth
        if not truth.fixed.sees(x_fixed):
            continue
        poses = [(0.0, 0.0), *(rng.uniform([-pan_range, -tilt_range], [pan_range, tilt_range]) for _ in range(200))]
        seen = [p for p in poses if truth.zoom.sees(truth.in_zoom(x_fixed, *p))]
        if not seen or (len(seen) < 2 and moved):
            continue
        views.append(View("fixed", truth.fixed.project(x_fixed) + rng.normal(0, noise_px, (len(points), 2)), number))
        for pan, tilt in seen[: moved + 1]:
            px = truth.zoom.project(truth.in_zoom(x_fixed, pan, tilt)) + rng.normal(0, noise_px, (len(points), 2))
            views.append(View("zoom", px, number, float(pan), float(tilt), focal_px=667.0))
        number += 1
    return views


def aim(calibration, x_fixed):
    """Pan and tilt that bring a point to the middle of the zoom image, by the calibration; solved numerically."""
    hand, head = calibration.T_head_zoom, calibration.head
    model = Truth(gamma=calibration.T_zoom0_fixed, hand=hand, dz=head.axis_offset, eps=head.squareness)
    lens = calibration.zoom.stops[0]
    ray = lens.ray(lens.image_center_px)

    def off(q):
        x = model.in_zoom(x_fixed[None], *q)[0]
        return x[:2] / abs(x[2]) - ray[:2]

    x = (model.hand * model.gamma).apply(x_fixed)  # from the unit's own middle, the way to look at first
    start = [np.arctan2(x[0], x[2]), np.arctan2(-x[1], np.hypot(x[0], x[2]))]
    for nudge in ([0.0, 0.0], [0.3, 0.0], [-0.3, 0.0], [0.0, 0.3], [0.0, -0.3]):
        found = least_squares(off, np.add(start, nudge), xtol=1e-14, ftol=1e-14, gtol=1e-14)
        if found.cost < 1e-16 and model.in_zoom(x_fixed[None], *found.x)[0, 2] > 0:
            return found.x
    raise AssertionError(f"no pan and tilt found for {x_fixed}")


def undistorted(pixel, lens):
    """OpenCV's undistorted image-plane coordinates of one pixel, iterated to rounding, (2,)."""
    ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    given = np.reshape(pixel, (1, 1, 2)).astype(float), lens.K, np.array(lens.distortion), None, None
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4 has the criteria in a function of their own
        return np.ravel(cv2.undistortPointsIter(*given, ends))
    return np.ravel(cv2.undistortPoints(*given, None, ends))


def pointing_errors(calibration: Calibration, truth: Truth, rng, count=200):
    """Angles between where the true zoom camera looks and the true target [degrees], (count,).

    Targets lie 4 to 30 m away all over the wide view, their pixel and depth known exactly. The camera looks along the
    true ray through the middle of its image.
    """
    errors = []
    middle = (np.array(SIZE) - 1) / 2
    ray = cv2.undistortPoints(
        middle.reshape(1, 1, 2), truth.zoom.K, np.array(truth.zoom.distortion), None, None
    ).ravel()
    for _ in range(count):
        pixel = rng.uniform([0, 0], np.array(SIZE) - 1.0)
        depth = np.exp(rng.uniform(np.log(4), np.log(30)))
        xy = undistorted(pixel, truth.fixed)
        x_true = np.array([*xy, 1.0]) * depth
        x_believed = calibration.fixed.ray(pixel) * depth
        q = aim(calibration, x_believed)
        x = truth.in_zoom(x_true[None], *q)[0]
        look = np.array([*ray, 1.0])
        errors.append(np.degrees(np.arctan2(np.linalg.norm(np.cross(x, look)), x @ look)))
    return np.array(errors)
