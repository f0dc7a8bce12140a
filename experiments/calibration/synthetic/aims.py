"""Where a synthetic rig's head must point, solved numerically, and how far off a calibration sends it."""

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
    """Pixels (n, 2) all over the wide view, and depths (n,) [m], even in their logarithm."""
    drawn = [
        (rng.uniform([0, 0], np.array(SIZE) - 1.0), np.exp(rng.uniform(*np.log(np.array(depths)))))
        for _ in range(count)
    ]
    return np.array([pixel for pixel, _ in drawn]), np.array([depth for _, depth in drawn])


def aim(calibration: Calibration, x_fixed: Array) -> Array:
    """Pan and tilt that bring points to the middle of the zoom image, by the calibration; solved numerically.

    Args:
        calibration: whose word is taken for the truth.
        x_fixed: points in the fixed camera's frame [m], (3,) or (n, 3).

    Returns:
        As the head reports them [rad], (2,) or (n, 2); nan where there is no such pose.
    """
    head = calibration.head
    model = truth_of(calibration)
    lens = calibration.zoom.stops[0]
    q = aimed(model, np.atleast_2d(x_fixed), lens.ray(lens.image_center_px))
    q = (q - [head.pan_zero, head.tilt_zero]) / [head.pan_scale, head.tilt_scale]
    return q if np.ndim(x_fixed) > 1 else q[0]


def aimed(model: Truth, x_fixed: Array, ray: Array) -> Array:
    """True pan and tilt at which a ray (3,) or (n, 3) of the zoom camera meets points (n, 3) [rad], (n, 2).

    Newton's method, from where a head without levers would look; nan where there is no such pose.
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
    """Angles between where the true zoom camera looks and the true target [degrees], (count,).

    Targets lie all over the wide view; see `draw_targets` and `misses`.

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
    """Angles between where the true zoom camera looks and true targets, one after the other [rad], (n,).

    Pixel and depth are known exactly, and the head goes where it is told as well as the true one does. The camera
    looks along the true ray through the middle of its image, at its shortest focal length.

    Args:
        calibration: by which the head is sent.
        truth: the rig.
        pixels: of the targets in the wide view, (n, 2).
        depths: of the targets [m], (n,).
        rng: for the head's jitter.
        by_distance: whether the calibration is told the targets' distance in place of their depth. That serves where
            the true lens follows another model, whose axis the calibration cannot know.

    Returns:
        nan where the calibration finds no pose.
    """
    x_true = np.c_[undistorted(pixels, truth.fixed), np.ones(len(pixels))] * depths[:, None]
    x_believed = calibration.fixed.ray(pixels) * depths[:, None]
    if by_distance:
        x_believed *= np.linalg.norm(x_true, axis=1, keepdims=True) / np.linalg.norm(x_believed, axis=1, keepdims=True)
    return looking_off(truth, x_true, aim(calibration, x_believed), rng)


def looking_off(truth: Truth, x_fixed: Array, q: Array, rng: np.random.Generator | None = None) -> Array:
    """Angles between where the true zoom camera looks and points, one after the other [rad], (n,).

    Args:
        truth: the rig; its camera looks along the true ray through the middle of its image, at its shortest focal
            length.
        x_fixed: the points in the fixed camera's frame [m], (n, 3).
        q: pan and tilt told to the head for each of them [rad], (n, 2).
        rng: for the head's jitter.

    Returns:
        nan where q is.
    """
    before = np.concatenate([np.zeros((1, 2)), q[:-1]])
    stood = np.array([truth.stands(*pair, rng) for pair in zip(q, before, strict=True)])
    x = truth.in_zoom(x_fixed, stood[:, 0], stood[:, 1])
    look = np.append(middle_of(truth.zoom), 1.0)
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(x, look), axis=1), x @ look))
