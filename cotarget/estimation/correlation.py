"""Correlate a weighted colour template with an image, with subpixel maxima; the image may end inside the template.

The weights say how much each sample of the template counts; samples outside the image count nothing (Padfield, *Masked
object registration in the Fourier domain*, 2012, with weights in place of the template's mask).
"""

import math

import cv2
import numpy as np

from cotarget.geometry import Array

Samples = np.ndarray  # float32, (H, W) or (H, W, 3)
# Noise variance of one sample, all three colours together. It keeps a flat patch from correlating with every other flat
# patch. Where 10 grey levels are one unit, a sensor's noise of 2 levels in each colour leaves about as much.
NOISE_VARIANCE = 0.1


def correlate(
    image: Samples, inside: Samples | None, template: Samples, weight: Samples
) -> tuple[np.ndarray, np.ndarray]:
    """Correlate a weighted template with an image at every place.

    Args:
        image: image, (H, W, 3) float32; any values where it is not valid.
        inside: 1 where the image is valid and 0 elsewhere, (H, W) float32; None if all of it is valid.
        template: template, (h, w, 3) float32.
        weight: weight of each sample of the template, 0 to 1, (h, w) float32.

    Returns:
        For each place of the template's top-left sample, (H - h + 1, W - w + 1) each: the normalised correlation, -1 to
        1, and the part of the template's weight inside the image, 0 to 1.
    """
    mean = np.einsum("ij,ijk->k", weight, template) / weight.sum()
    template = template - mean.astype(np.float32)
    image = image - mean.astype(np.float32)
    weighted = template * weight[..., None]
    squared = np.einsum("ijk,ijk->ij", weighted, template)
    if inside is None:
        n: np.ndarray | np.float32 = weight.sum()
        template_sums: list[np.ndarray | np.float32] = [np.float32(0.0)] * 3
        template_variance: np.ndarray | np.float32 = squared.sum()
    else:
        image = image * inside[..., None]
        n = np.maximum(_slide(inside, weight), np.finfo(np.float32).eps)
        template_sums = [_slide(inside, plane) for plane in cv2.split(weighted)]
        template_variance = _slide(inside, squared)
    covariance = _slide(image, weighted)
    variance = _slide(np.einsum("ijk,ijk->ij", image, image), weight)
    for plane, template_sum in zip(cv2.split(image), template_sums, strict=True):
        image_sum = _slide(plane, weight)
        covariance = covariance - image_sum * template_sum / n
        variance = variance - image_sum**2 / n
        template_variance = template_variance - template_sum**2 / n
    noise = NOISE_VARIANCE * n
    score = covariance / np.sqrt((np.maximum(template_variance, 0.0) + noise) * (np.maximum(variance, 0.0) + noise))
    return score, np.broadcast_to(n / weight.sum(), score.shape)


def summit(score: np.ndarray, at: tuple[int, int]) -> Array | None:
    """Locate a maximum to a part of a sample, by a parabola along each axis.

    Args:
        score: values, (H, W).
        at: row and column of the maximum or of a neighbour.

    Returns:
        The maximum (u, v), (2,); None if there is none, or if it lies on the border.
    """
    y, x = at
    low_y, low_x = max(y - 1, 0), max(x - 1, 0)
    around = score[low_y : y + 2, low_x : x + 2]
    dy, dx = np.unravel_index(int(np.argmax(around)), around.shape)
    y, x = low_y + int(dy), low_x + int(dx)
    if not (0 < y < score.shape[0] - 1 and 0 < x < score.shape[1] - 1):
        return None
    if score[y - 1 : y + 2, x - 1 : x + 2].max() > score[y, x]:
        return None
    before = np.array([score[y, x - 1], score[y - 1, x]], dtype=float)
    after = np.array([score[y, x + 1], score[y + 1, x]], dtype=float)
    curvature = np.maximum(2 * float(score[y, x]) - before - after, np.finfo(float).eps)
    return np.array([x, y]) + 0.5 * (after - before) / curvature


def resample(image: np.ndarray, A: Array, size: tuple[int, int]) -> tuple[Samples, Samples | None]:
    """Resample an image on another grid, with averages where that grid is coarser.

    Args:
        image: image, (H, W) or (H, W, 3).
        A: affine map from the new grid's samples (u, v) to the image's pixels, (2, 3).
        size: (width, height) of the new grid.

    Returns:
        The samples, extended beyond the image by its border pixels; and where they are inside the image, (height,
        width) of 0 and 1, or None if all are.
    """
    corners = np.array([[0.0, 0.0], [size[0] - 1, 0.0], [size[0] - 1, size[1] - 1], [0.0, size[1] - 1]])
    seen = corners @ A[:, :2].T + A[:, 2]
    limit = np.array(image.shape[1::-1])
    pitch = float(np.sqrt(abs(np.linalg.det(A[:, :2]))))
    factor = 2 ** max(0, round(math.log2(pitch)))  # halving is far faster than other reductions
    low = np.clip(np.floor(seen.min(axis=0) - 2 * factor).astype(int), 0, limit - 1)
    high = np.clip(np.ceil(seen.max(axis=0) + 2 * factor).astype(int) + 1, low + 1, limit)
    part = image[low[1] : high[1], low[0] : high[0]]
    for _ in range(round(math.log2(factor))):
        part = _halved(part)
    M = A.copy()  # from the new grid to the reduced image, whose pixel i covers `factor` pixels
    M[:, 2] -= low
    M = M / factor
    M[:, 2] += 0.5 / factor - 0.5
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    samples = cv2.warpAffine(part, M, size, flags=flags, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    if (seen >= -0.5).all() and (seen <= limit - 0.5).all():
        return samples, None
    u, v = np.meshgrid(np.arange(size[0], dtype=np.float32), np.arange(size[1], dtype=np.float32))
    x, y = (A[i, 0] * u + A[i, 1] * v + A[i, 2] for i in range(2))
    within = (x >= -0.5) & (x <= limit[0] - 0.5) & (y >= -0.5) & (y <= limit[1] - 0.5)
    return samples, within.astype(np.float32)


def _halved(image: np.ndarray) -> np.ndarray:
    """Halve an image by means of 2 x 2 pixels; an odd last row or column is dropped, a single one is kept."""
    height, width = image.shape[:2]
    half = max(width // 2, 1), max(height // 2, 1)
    even = image[: max(height // 2 * 2, 1), : max(width // 2 * 2, 1)]
    return cv2.resize(even, half, interpolation=cv2.INTER_AREA)


def _slide(image: Samples, kernel: Samples) -> np.ndarray:
    """Correlate without normalisation, summed over the colours."""
    return cv2.matchTemplate(image, np.ascontiguousarray(kernel, dtype=np.float32), cv2.TM_CCORR)
