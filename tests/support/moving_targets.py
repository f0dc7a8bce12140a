"""Moving targets and their measurements by a synthetic rig: boxes in the fixed image, centres in the zoom image.

The camera and head models are those of `experiments.calibration.synthetic`, independent of the package's.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import DEFAULT_TARGETS
from cotarget.pantilt import HeadGeometry
from cotarget.rig import Detection
from cotarget.rig_geometry import FixedCamera, ZoomHead
from experiments.calibration.synthetic.aims import aimed
from experiments.calibration.synthetic.rig import LONGEST_PX, NOMINAL_PX, SIZE, Truth

RATE = 25.0
APART = 0.013  # delay of the zoom camera's frames after the fixed camera's [s]
STEP = math.radians(0.0514286)
KNOTS = 0.02  # between a path's knots [s]
# Standard deviations: of a box's centre and sides, [px] and in parts of the side; of the centre in the zoom image [px].
NOISE = {"book": (0.2, 0.01), "person": (0.4, 0.04), "bird": (0.4, 0.06)}
SIDE_NOISE = {"book": (0.3, 0.01), "person": (1.0, 0.03), "bird": (1.0, 0.03)}
ZOOM_NOISE = {"book": 0.5, "person": 6.0, "bird": 4.0}
WALKING, FLYING, RADIUS = 1.5, 10.0, 10.0  # [m/s], [m/s] +- 20 %, [m]
BODY = 0.55  # of a bird seen from its side, over its wingspan
BEAT_HZ = 4.0


def calibration_of(truth, **more):
    """Return the exact calibration of a rig whose zoom lens only magnifies."""

    def intrinsics(lens):
        return Intrinsics(SIZE, (lens.fx, lens.fy), (lens.cx, lens.cy), lens.distortion)

    return Calibration(
        fixed=FixedCamera(intrinsics(truth.fixed)),
        zoom_head=ZoomHead(
            ZoomLens((NOMINAL_PX,), (intrinsics(truth.zoom),)),
            truth.gamma,
            truth.hand,
            HeadGeometry(truth.dz, truth.eps, truth.pan_scale, truth.tilt_scale),
        ),
        **more,
    )


def magnified(truth, nominal_px):
    """Return the zoom lens at a nominal focal length."""
    m = nominal_px / NOMINAL_PX
    return replace(truth.zoom, fx=truth.zoom.fx * m, fy=truth.zoom.fy * m)


def book_path(rng, seconds):
    """Stand at 10 m; half way through, move to another place within 0.8 s."""
    t = np.arange(0, seconds, KNOTS)
    here = np.array([rng.uniform(-1, 1), rng.uniform(-0.3, 0.3), rng.uniform(9, 11)])
    away = np.array([rng.choice([-1, 1]) * rng.uniform(0.5, 1), rng.uniform(-0.3, 0.3), rng.uniform(-0.7, 0.7)])
    s = np.clip((t - seconds / 2) / 0.8, 0, 1)
    return CubicSpline(t, here + (s * s * (3 - 2 * s))[:, None] * away)


def steered(rng, seconds, start, speed, sharpest, lag, keep, every):
    """Go at a constant speed towards random places, with a bounded curvature [rad/m]; return the path, (n, 2)."""
    p, heading, curvature, goal, way = np.array(start), rng.uniform(0, 2 * np.pi), 0.0, None, []
    middle, radius = keep
    for _ in np.arange(0, seconds, KNOTS):
        if goal is None or rng.random() < KNOTS / every:
            goal = p + rng.uniform(-20, 20, 2)
        if np.hypot(*(p - middle)) > radius:
            goal = middle
        turn = (np.arctan2(*(goal - p)[::-1]) - heading + np.pi) % (2 * np.pi) - np.pi
        curvature += (np.clip(turn * sharpest * 3, -sharpest, sharpest) - curvature) * KNOTS / lag
        heading += speed * curvature * KNOTS
        p = p + speed * KNOTS * np.array([np.cos(heading), np.sin(heading)])
        way.append(p)
    return np.array(way)


def person_path(rng, seconds):
    """Walk and turn, 8 to 12 m away."""
    way = steered(rng, seconds, (0.0, 10.0), WALKING, 1.0, 0.3, (np.array([0.0, 10.0]), 1.5), 3.0)
    t = np.arange(0, seconds, KNOTS)
    return CubicSpline(t, np.c_[way[:, 0], np.full(len(t), 0.6), way[:, 1]])


def bird_path(rng, seconds):
    """Fly with turns of at least 10 m radius, some 26 m away."""
    speed = FLYING * rng.uniform(0.8, 1.2)
    start = (rng.uniform(-3, 3), rng.uniform(23, 29))
    way = steered(rng, seconds, start, speed, 1 / RADIUS, 0.3, (np.array([0.0, 26.0]), 3.5), 3.0)
    t = np.arange(0, seconds, KNOTS)
    height = -3 + 1.5 * np.sin(2 * np.pi * t / rng.uniform(4, 7) + rng.uniform(0, 6))
    return CubicSpline(t, np.c_[way[:, 0], height, way[:, 1]])


PATHS = {"book": book_path, "person": person_path, "bird": bird_path}
SCATTER = {"book": 0.0, "person": 0.04, "bird": 0.15}  # of true sizes; twice the standard deviation


@dataclass(frozen=True)
class ZoomView:
    """Measurement of the target in the zoom image, and the reported state of head and lens at its time."""

    pixel: np.ndarray
    sigma_px: float
    pan: float
    tilt: float
    nominal_px: float
    t: float


class Flight:
    """One moving target and its measurements by the rig."""

    def __init__(self, name, seed, seconds=8.0, path=None, wrong=1.0, bias=(0.0, 0.0)):
        """``wrong`` is a factor on the true size; ``bias`` the true angles of the head less the reported ones [rad]."""
        self.rng = np.random.default_rng([seed, len(name)])
        self.name, self.target, self.truth, self.bias = name, DEFAULT_TARGETS[name], Truth(), np.array(bias)
        self.path = path or PATHS[name](self.rng, seconds + 1.0)
        scatter = SCATTER[name] / 2 * float(np.clip(self.rng.normal(), -2, 2))
        self.size = self.target.size * (1 + scatter) * wrong
        self.times = np.arange(0, seconds, 1 / RATE)
        self.calibration = calibration_of(self.truth)
        self._looks = {}

    def sides(self, t):
        """Return the true width and height of the target's box at unit distance [m]."""
        if self.name == "book":
            return self.size, 1.3 * self.size
        if self.name == "person":
            return 0.26 * self.size, self.size
        ahead = self.path(t, 1) / np.linalg.norm(self.path(t, 1))
        sight = self.path(t) / np.linalg.norm(self.path(t))
        wing = np.cross(ahead, [0.0, 1.0, 0.0])
        wing /= np.linalg.norm(wing)
        beat = 0.6 * np.sin(2 * np.pi * BEAT_HZ * t)
        across = np.linalg.norm(wing - sight * (wing @ sight)) * np.cos(beat)
        along = BODY * np.linalg.norm(ahead - sight * (ahead @ sight))
        return self.size * max(across, along), self.size * max(0.5 * abs(np.sin(beat)), 0.15)

    def visible(self, t):
        """Whether the target is well inside the fixed image."""
        return bool(self.truth.fixed.inside(self.path(t)[None], 15.0)[0])

    def wide(self, t):
        """Return a noisy detection in the fixed image; None outside."""
        if not self.visible(t):
            return None
        x = self.path(t)
        focal = np.array([self.truth.fixed.fx, self.truth.fixed.fy])
        sides = np.array(self.sides(t)) * focal / x[2]
        plain, part = NOISE[self.name]
        middle = self.truth.fixed.project(x[None])[0] + self.rng.normal(size=2) * np.hypot(plain, part * sides)
        plain, part = SIDE_NOISE[self.name]
        sides = np.maximum(sides + self.rng.normal(size=2) * np.hypot(plain, part * sides), 2.0)
        return Detection(middle, sides, 1.0)

    def aimed(self, t):
        """Pan and tilt at which the true zoom camera's axis meets the target [rad], (2,)."""
        if not self._looks:  # all at once, which takes no longer than one
            every = self.times + APART
            looks = aimed(self.truth, self.path(every), np.array([0.0, 0.0, 1.0]))
            self._looks = dict(zip(every, looks, strict=True))
        if t in self._looks:
            return self._looks[t]
        return aimed(self.truth, self.path(t)[None], np.array([0.0, 0.0, 1.0]))[0]

    def zoom(self, t, reported=None, nominal_px=None):
        """Return a noisy measurement in the zoom image at reported angles, or about the target; None outside."""
        x = self.path(t)
        if reported is None:
            reported = np.round((self.aimed(t) + self.rng.normal(0, 0.008, 2)) / STEP) * STEP
        pan, tilt = np.asarray(reported) + self.bias
        x_zoom = self.truth.in_zoom(x, pan, tilt)
        if nominal_px is None:
            nominal_px = min(self.target.wanted_px * x_zoom[2] / self.target.size, LONGEST_PX)
        lens = magnified(self.truth, nominal_px)
        if not lens.inside(x_zoom[None])[0]:
            return None
        pixel = lens.project(x_zoom[None])[0] + self.rng.normal(0, ZOOM_NOISE[self.name], 2)
        return ZoomView(pixel, ZOOM_NOISE[self.name], float(reported[0]), float(reported[1]), nominal_px, t)

    def miss_percent(self, x_fixed, t):
        """Return the error of an estimated position in the close-up [% of the width]."""
        at = self.truth.gamma.inv().translation
        a, b = np.asarray(x_fixed) - at, self.path(t) - at
        angle = np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)
        focal = min(self.target.wanted_px * np.linalg.norm(b) / self.target.size, LONGEST_PX)
        return 100 * np.tan(angle) * focal / SIZE[0]


def show(target_filter, view):
    """Update a filter with a measurement in the zoom image."""
    return target_filter.add_zoom(view.pixel, view.sigma_px, view.pan, view.tilt, view.nominal_px, view.t)
