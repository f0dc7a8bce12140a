"""Pointing of a synthetic rig: the head's true pose for a target, solved numerically, and a calibration's error."""

import numpy as np

from cotarget.calibration import Calibration
from cotarget.geometry import Array
from experiments.calibration.synthetic.rig import (
    DIFFERENCE,
    NEWTON_STEPS,
    SIZE,
    SOLVED,
    Truth,
    middle_of,
    truth_of,
    undistorted,
)

TARGET_DEPTHS = (4.0, 30.0)  # [m]


def draw_targets(
    rng: np.random.Generator, count: int, depths: tuple[float, float] = TARGET_DEPTHS
) -> tuple[Array, Array]:
    """Draw pixels (n, 2) over the fixed view, and depths (n,) [m] even in their logarithm."""
    drawn = [
        (rng.uniform([0, 0], np.array(SIZE) - 1.0), np.exp(rng.uniform(*np.log(np.array(depths)))))
        for _ in range(count)
    ]
    return np.array([pixel for pixel, _ in drawn]), np.array([depth for _, depth in drawn])


def aim(calibration: Calibration, x_fixed: Array) -> Array:
    """Solve pan and tilt that centre points (n, 3) [m] in the zoom image by a calibration, numerically.

    Angles are those that the head reports [rad], (n, 2), or (2,) for one point (3,); nan where there is no such pose.
    """
    head = calibration.zoom_head.axes
    model = truth_of(calibration)
    lens = calibration.zoom_head.lens.stops[0]
    q = aimed(model, np.atleast_2d(x_fixed), lens.ray(lens.image_center_px))
    q = (q - [head.pan_zero, head.tilt_zero]) / [head.pan_scale, head.tilt_scale]
    return q if np.ndim(x_fixed) > 1 else q[0]


def aimed(model: Truth, x_fixed: Array, ray: Array) -> Array:
    """Solve the true pan and tilt at which a ray (3,) or (n, 3) of the zoom camera meets points (n, 3), (n, 2) [rad].

    Newton's method, started from the solution of a head without levers; nan where there is no such pose.
    """
    x_base = (model.hand * model.gamma).apply(x_fixed)
    look = model.hand.rotation.apply(ray)

    def off(q: Array) -> Array:
        x = model.in_zoom(x_fixed, q[:, 0], q[:, 1])
        return x[:, :2] / np.abs(x[:, 2:]) - ray[..., :2] / ray[..., 2:]

    pan = np.arctan2(x_base[:, 0], x_base[:, 2]) - np.arctan2(look[..., 0], look[..., 2])
    tilt = np.arctan2(-x_base[:, 1], np.hypot(x_base[:, 0], x_base[:, 2])) + np.arctan2(look[..., 1], look[..., 2])
    found = np.full((len(x_fixed), 2), np.nan)
    for nudge in ([0.0, 0.0], [0.3, 0.0], [-0.3, 0.0], [0.0, 0.3], [0.0, -0.3]):
        q = np.stack([pan, tilt], axis=-1) + nudge
        with np.errstate(all="ignore"):
            for _ in range(NEWTON_STEPS):
                J = [(off(q + d) - off(q - d)) / (2 * DIFFERENCE) for d in DIFFERENCE * np.eye(2)]
                (a, c), (b, d) = (j.T for j in J)
                u, v = off(q).T
                step = np.stack([d * u - b * v, a * v - c * u], axis=-1) / (a * d - b * c)[:, None]
                q = q - np.clip(step, -0.5, 0.5)
                if not (np.abs(step) > SOLVED).any():
                    break
            x = model.in_zoom(x_fixed, q[:, 0], q[:, 1])
            good = (np.abs(off(q)).max(axis=1) < SOLVED) & (x[:, 2] > 0) & np.isnan(found[:, 0])
        found[good] = q[good]
        if np.isfinite(found).all():
            break
    return (found + np.pi) % (2 * np.pi) - np.pi


def pointing_errors(calibration: Calibration, truth: Truth, rng: np.random.Generator, count: int = 200) -> Array:
    """Measure the angles between the true zoom camera's line of sight and true targets, (count,) [degrees].

    Targets are spread over the fixed view; see `draw_targets` and `misses`.

    Raises:
        AssertionError: a target cannot be reached.
    """
    errors = np.degrees(misses(calibration, truth, *draw_targets(rng, count), rng))
    assert np.isfinite(errors).all(), "no pan and tilt found for a target"
    return errors


def misses(
    calibration: Calibration,
    truth: Truth,
    pixels: Array,
    depths: Array,
    rng: np.random.Generator | None = None,
    *,
    by_distance: bool = False,
) -> Array:
    """Measure the angles between the true zoom camera's line of sight and true targets in turn, (n,) [rad].

    Pixels (n, 2) and depths (n,) [m] are known exactly, and the head executes the calibration's commands as the true
    one does, with jitter from ``rng``. With ``by_distance`` the calibration gets distances in place of depths, for true
    lenses of another model, whose axis it cannot know. An angle is nan where the calibration finds no pose.
    """
    x_true = np.c_[undistorted(pixels, truth.fixed), np.ones(len(pixels))] * depths[:, None]
    x_believed = calibration.fixed.ray(pixels) * depths[:, None]
    if by_distance:
        x_believed *= np.linalg.norm(x_true, axis=1, keepdims=True) / np.linalg.norm(x_believed, axis=1, keepdims=True)
    return looking_off(truth, x_true, aim(calibration, x_believed), rng)


def looking_off(truth: Truth, x_fixed: Array, q: Array, rng: np.random.Generator | None = None) -> Array:
    """Measure the angles between the true zoom camera's line of sight and points (n, 3) [m] in turn, (n,) [rad].

    The head is sent to each row of q (n, 2) [rad]; nan where q is nan. The line of sight is the true ray through the
    image's centre at the shortest focal length.
    """
    before = np.concatenate([np.zeros((1, 2)), q[:-1]])
    stood = np.array([truth.stands(*pair, rng) for pair in zip(q, before, strict=True)])
    x = truth.in_zoom(x_fixed, stood[:, 0], stood[:, 1])
    look = np.append(middle_of(truth.zoom), 1.0)
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(x, look), axis=1), x @ look))
