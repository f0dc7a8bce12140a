"""Fitting a template to a small patch: middle and size to a fraction of a pixel.

The patch is modelled as the template, scaled, slightly turned and blurred, in front of a background that is a plane:
``gain alpha template + (1 - alpha) (b0 + bu u + bv v)``. Gauss-Newton over the five numbers of the pose and the four of
the brightness (Lucas and Kanade's method with a model of the background).
"""

import cv2
import numpy as np

from cotarget.geometry import Array

# How far beyond a target's coarse box its pixels are looked at [px]: blur and subsampled chroma reach about 3 px.
MARGIN_PX = 4
# The template is prepared at this many samples a pixel of the patch, so that linear interpolation loses nothing.
OVERSAMPLING = 4
# Standard deviation of lens, pixel and coding together [px]; a wrong value blurs all edges alike and biases no size.
BLUR_PX = 1.2
# Steps of the derivative: u, v, width, height [px] and turn [rad]; small against the blur.
DERIVATIVE = np.array([0.1, 0.1, 0.1, 0.1, 0.02])
# The largest change in one iteration, likewise: the linearisation holds within the blur.
LARGEST_STEP = np.array([1.0, 1.0, 1.0, 1.0, 0.1])
ITERATIONS = 12
# Converged when no parameter changes by more [px, rad].
CONVERGED = 0.01
# A result whose sides differ from the coarse ones by more than this factor is no result.
LARGEST_CHANGE = 1.7
# A target is seldom turned by more [rad]; keeps the turn from running away where a few pixels cannot show it.
TURN_SIGMA = 0.15


def fit_template(
    template: np.ndarray, patch: np.ndarray, center: Array, size: Array
) -> tuple[Array, Array, float] | None:
    """Fit a template to a patch.

    Args:
        template: (h, w) picture of the target alone, cut to its outline.
        patch: (H, W) a small part of an image around it.
        center: coarse middle in the patch (u, v) [px], (2,).
        size: coarse width and height [px], (2,).

    Returns:
        Middle and size [px], (2,) each, of the target itself, as if it were not turned; and the part of the
        patch's variation that is explained, 0 to 1. None when the fit does not converge.
    """
    source = _prepare(template, size)
    height, width = patch.shape
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    plane = np.stack([np.ones_like(u), u / width - 0.5, v / height - 0.5], axis=-1)
    pose = np.array([*center, *size, 0.0])
    brightness = np.zeros(4)
    step = np.full(5, np.inf)
    for _ in range(ITERATIONS):
        basis = _render(source, pose, plane)
        brightness = np.linalg.lstsq(basis, patch.ravel(), rcond=None)[0]
        residual = patch.ravel() - basis @ brightness
        columns = [
            (_render(source, pose + d, plane) @ brightness - basis @ brightness) / d.sum() for d in np.diag(DERIVATIVE)
        ]
        J = np.column_stack([*columns, basis])
        # The turn's prior, in the units of the residual, is one more equation.
        noise = max(1e-6, float(np.std(residual)))
        prior = np.zeros(9)
        prior[4] = noise / TURN_SIGMA
        step = np.linalg.lstsq(np.vstack([J, prior]), np.append(residual, -prior[4] * pose[4]), rcond=None)[0][:5]
        pose = pose + np.clip(step, -LARGEST_STEP, LARGEST_STEP)
        if (pose[2:4] > size * LARGEST_CHANGE).any() or (pose[2:4] < size / LARGEST_CHANGE).any():
            return None
        if np.abs(step).max() < CONVERGED:
            break
    else:
        if np.abs(step).max() > DERIVATIVE.max():
            return None
    if (np.abs(pose[:2] - center) > size).any() or brightness[0] <= 0:
        return None
    basis = _render(source, pose, plane)
    residual = patch.ravel() - basis @ np.linalg.lstsq(basis, patch.ravel(), rcond=None)[0]
    return pose[:2], pose[2:4], float(max(0.0, 1.0 - residual.var() / max(1e-9, float(patch.var()))))


def _prepare(template: np.ndarray, size: Array) -> np.ndarray:
    """The template and its outline, blurred as in the patch, ``OVERSAMPLING`` times as fine, with a margin."""
    width, height = (max(2, round(OVERSAMPLING * float(side))) for side in size)
    small = cv2.resize(template, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    both = np.stack([small, np.ones_like(small)], axis=-1)
    margin = OVERSAMPLING * MARGIN_PX
    both = cv2.copyMakeBorder(both, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=0)
    return cv2.GaussianBlur(both, (0, 0), OVERSAMPLING * BLUR_PX)


def _render(source: np.ndarray, pose: Array, plane: np.ndarray) -> np.ndarray:
    """The four basis images of a pose, (pixels, 4): the template, and the background where it is not covered."""
    height, width = source.shape[:2]
    inner = np.array([width, height]) - 2 * OVERSAMPLING * MARGIN_PX
    c, s = np.cos(pose[4]), np.sin(pose[4])
    # From the patch's pixels to the source's: turn back about the middle, then scale.
    A = np.array([[c, s], [-s, c]]) * (inner / pose[2:4])[:, None]
    shift = (np.array([width, height]) - 1) / 2 - A @ pose[:2]
    seen = cv2.warpAffine(
        source,
        np.column_stack([A, shift]),
        (plane.shape[1], plane.shape[0]),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
    )
    basis = np.concatenate([seen[..., :1], (1 - seen[..., 1:]) * plane], axis=-1)
    return basis.reshape(-1, 4).astype(float)
