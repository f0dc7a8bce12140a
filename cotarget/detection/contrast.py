"""Specks: what stands out from its own surroundings, at several scales, in one picture.

A speck's mean differs from the mean of the ring around it by several standard deviations of that ring. Foliage, waves
and roofs have a ring as rough as themselves; a pole or the edge of a cloud runs through its own ring (the constant
false alarm rate detector of radar, Rohling 1983, in two dimensions).
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from cotarget.geometry import Array
from cotarget.rig import Image

# Side of the square that is a speck's middle at the finest scale [px]; each further scale doubles all of these.
INNER_PX = 3
# Inner and outer side of the ring, in pixels of a picture of half the size: 14 and 22 px. The speck lies inside.
GUARD_HALF_PX, OUTER_HALF_PX = 7, 11
# Scales, from specks of up to 12 px to those of up to 100: those of 60 need the surroundings of the last one.
SCALES = 4
# From this scale on a ring is so large that the gradient of a sky counts: 90 px.
SLOPING_SCALE = 2
# A ring counts as at least this rough [grey levels]: a codec smooths a sky's noise away, not its steps.
LEAST_ROUGHNESS = 1.5
# The speck's outline is where its contrast has fallen to this part.
OUTLINE = 0.33


@dataclass(frozen=True)
class Speck:
    """What stands out.

    Attributes:
        low: its box's first column and row [px].
        size: its width and height [px].
        contrast: what its middle is brighter than its surroundings [grey levels]; negative where darker.
        signal: that, in standard deviations of the surroundings, positive.
        around: mean grey level of the surroundings.
    """

    low: tuple[int, int]
    size: tuple[int, int]
    contrast: float
    signal: float
    around: float


def find_specks(grey: Image, threshold: float, most: int) -> list[Speck]:
    """Find what stands out at any scale, what does so most first; each thing once.

    Args:
        grey: (H, W) picture.
        threshold: least contrast, in standard deviations of the surroundings.
        most: how many to look at, the best first; bounds the time that a hundred specks take.
    """
    found: list[Speck] = []
    level = grey
    for scale in range(SCALES):
        if min(level.shape) < 2 * OUTER_HALF_PX:
            break
        half = cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        for u, v, signal, around in _peaks(level, half, scale >= SLOPING_SCALE, threshold, most):
            speck = _outline(grey, (u, v), scale, signal, around)
            if speck is not None:
                found.append(speck)
        level = half
    found.sort(key=lambda speck: -speck.signal)
    kept: list[Speck] = []
    for speck in found:
        if not any(share(speck, other) for other in kept):
            kept.append(speck)
    return kept[:most]


def _peaks(
    level: Image, half: Image, sloping: bool, threshold: float, most: int
) -> list[tuple[int, int, float, float]]:
    """Where one scale's picture stands out: (u, v) there, contrast in deviations, and the ring's mean; best first."""
    mean, deviation = _ring(half, sloping)
    margin = deviation * np.float32(threshold)
    size = (level.shape[1], level.shape[0])
    # In bytes: three times as quick, and half a grey level is little beside `threshold` deviations.
    low = cv2.resize(cv2.subtract(mean, margin, dtype=cv2.CV_8U), size)
    high = cv2.resize(cv2.add(mean, margin, dtype=cv2.CV_8U), size)
    middle = cv2.boxFilter(level, -1, (INNER_PX, INNER_PX))
    mask = cv2.bitwise_not(cv2.inRange(middle, low, high))
    peaks = []
    for contour in cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]:
        x, y, w, h = cv2.boundingRect(contour)
        if max(w, h) > 2 * GUARD_HALF_PX:  # it reaches into its own ring: a matter for the next scale
            continue
        there = (slice(y, y + h), slice(x, x + w))
        off = np.maximum(cv2.subtract(low[there], middle[there]), cv2.subtract(middle[there], high[there]))
        j, i = np.unravel_index(int(np.argmax(off)), off.shape)
        u, v = x + int(i), y + int(j)
        at = (min(v // 2, half.shape[0] - 1), min(u // 2, half.shape[1] - 1))
        around, rough = float(mean[at]), float(deviation[at])
        peaks.append((u, v, abs(float(middle[v, u]) - around) / rough, around))
    peaks.sort(key=lambda peak: -peak[2])
    return peaks[:most]


def _ring(half: Image, sloping: bool) -> tuple[Array, Array]:
    """Mean over the ring around each pixel, and the standard deviation from it or from a plane.

    Args:
        half: the picture.
        sloping: whether a plane, because the ring is so large that a sky's gradient matters.
    """
    total = _box_sum(half, cv2.boxFilter)
    squares = _box_sum(half, cv2.sqrBoxFilter)
    count = np.float32(OUTER_HALF_PX**2 - GUARD_HALF_PX**2)
    mean = total / count
    variance = squares / count - mean * mean
    if not sloping:
        return mean, cv2.sqrt(np.maximum(variance, np.float32(LEAST_ROUGHNESS**2)))
    # The slope along each axis is the ring's first moment over that of the axis itself.
    moment = np.float32((_axis_moment(OUTER_HALF_PX) - _axis_moment(GUARD_HALF_PX)) * count)
    for k in (0, 1):
        first = _first_moment(half, OUTER_HALF_PX, k)
        cv2.subtract(first, _first_moment(half, GUARD_HALF_PX, k), first)
        variance -= first * first / moment
    return mean, cv2.sqrt(np.maximum(variance, np.float32(LEAST_ROUGHNESS**2)))


def _box_sum(half: Image, box: Callable[..., Array]) -> Array:
    """Sum over the ring, of the picture or of its squares."""
    total = box(half, cv2.CV_32F, (OUTER_HALF_PX,) * 2, normalize=False)
    return cv2.subtract(total, box(half, cv2.CV_32F, (GUARD_HALF_PX,) * 2, normalize=False), total)


def _axis_moment(side: int) -> float:
    """Sum of the squared distances from the middle column, over a square."""
    return side * float(np.sum(np.square(np.arange(side) - side // 2)))


def _first_moment(half: Image, side: int, axis: int) -> Array:
    """Sum of the picture times the distance from the middle along an axis (0: columns), over a square."""
    kernels = [np.ones(side, np.float32)] * 2
    kernels[axis] = np.arange(side, dtype=np.float32) - side // 2
    return np.asarray(cv2.sepFilter2D(half, cv2.CV_32F, kernels[0], kernels[1]))


def _outline(grey: Image, peak: tuple[int, int], scale: int, signal: float, around: float) -> Speck | None:
    """Box a speck in the whole picture; None where it has no outline within its ring.

    Args:
        grey: (H, W) picture.
        peak: where it stands out most, in pixels of its scale's picture.
        scale: doublings.
        signal: its contrast in deviations of its surroundings.
        around: their mean.
    """
    factor = 2**scale
    u, v = (factor * x + factor // 2 for x in peak)
    reach = factor * GUARD_HALF_PX
    left, top = max(0, u - reach), max(0, v - reach)
    window = grey[top : v + reach + 1, left : u + reach + 1].astype(np.float32) - np.float32(around)
    near = window[max(0, v - top - factor) : v - top + factor + 1, max(0, u - left - factor) : u - left + factor + 1]
    contrast = float(near.flat[int(np.argmax(np.abs(near)))])
    inside = (window > OUTLINE * contrast) if contrast > 0 else (window < OUTLINE * contrast)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(inside.astype(np.uint8))
    j, i = np.unravel_index(int(np.argmax(np.abs(near))), near.shape)
    label = labels[max(0, v - top - factor) + int(j), max(0, u - left - factor) + int(i)]
    x, y, w, h = (int(n) for n in stats[label][:4])
    cut = (x == 0 and left > 0, y == 0 and top > 0, x + w == window.shape[1] and left + x + w < grey.shape[1])
    if label == 0 or any(cut) or (y + h == window.shape[0] and top + y + h < grey.shape[0]):
        return None  # it goes on beyond its ring: a pole, or a matter for the next scale
    return Speck((left + x, top + y), (w, h), contrast, signal, around)


def share(one: Speck, other: Speck) -> bool:
    """Whether the boxes of two specks share a pixel."""
    return all(a < b + n and b < a + m for a, m, b, n in zip(one.low, one.size, other.low, other.size, strict=True))
