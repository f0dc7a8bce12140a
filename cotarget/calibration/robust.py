"""Robust statistics of corners: some are found wrongly, and must neither draw a fit nor swell its uncertainty."""

import numpy as np

from cotarget.geometry import Array

# A point further off than this many standard deviations (from the median) counts linearly, not squared (Huber).
HUBER_SIGMAS = 3.0
MEDIAN_TO_SIGMA = 1 / 1.1774  # of the length of a 2D Gaussian vector: its median is sigma sqrt(2 ln 2)
SMALLEST_SIGMA_PX = 1e-4  # corners are rounded to this, so that exact data have no smaller scale


def rms(residuals: Array) -> float:
    """OpenCV's rms: root of the mean squared distance per point of residuals (..., 2) [px]; nan points do not count."""
    squared = np.sum(residuals**2, axis=-1)
    seen = np.isfinite(squared)
    return float(np.sqrt(squared[seen].mean())) if seen.any() else 0.0


def robust_sigma(residuals: Array) -> float:
    """Standard deviation of a coordinate of residuals (n, 2), told by the median length [px]."""
    return max(float(np.median(np.linalg.norm(residuals, axis=-1))) * MEDIAN_TO_SIGMA, SMALLEST_SIGMA_PX)


def coordinate_variance(residuals: Array, parameters: float) -> float | None:
    """Estimate what variance of one coordinate, times the inverse normal matrix, gives the parameters' covariance.

    It is that of Huber's estimate (Huber 1981, Eq. 7.6.10): mean |psi|^2 / 2 over the squared mean slope of psi, where
    psi is a residual cut to the robust scale; for Gaussian noise 1 % more than the noise's own variance.

    Args:
        residuals: of the optimum, (n, 2) [px].
        parameters: how many were fitted, the boards' poses included; they take up as many coordinates.

    Returns:
        [px^2]; None where there are not more coordinates than parameters.
    """
    freedom = residuals.size - parameters
    if freedom <= 0:
        return None
    scale = HUBER_SIGMAS * robust_sigma(residuals)
    weights = huber_weights(residuals, scale)
    psi2 = np.sum((weights[..., None] * residuals) ** 2, axis=-1)
    slope = np.where(weights < 1, weights / 2, 1.0)  # beyond the scale psi only turns: one direction of the two
    return float(np.mean(psi2) / 2 / np.mean(slope) ** 2 * residuals.size / freedom)


def huber_weights(residuals: Array, scale: float) -> Array:
    """Huber's weight of every point."""
    return scale / np.maximum(np.linalg.norm(residuals, axis=-1), scale)


def huber_cost(residuals: Array, scale: float) -> float:
    """Huber's cost."""
    lengths = np.linalg.norm(residuals, axis=-1)
    return float(np.sum(np.where(lengths <= scale, lengths**2, scale * (2 * lengths - scale))))
