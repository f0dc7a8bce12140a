"""Find places that stand out from the ring around them, at several scales.

This is a constant false alarm rate detector (Rohling 1983) in two dimensions.
"""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from cotarget.geometry import Array
from cotarget.rig import Image

# Side of the square at a target's centre at the finest scale [px]; each further scale doubles all lengths.
INNER_PX = 3
# Inner and outer side of the ring, in pixels of an image of half the size: 14 and 22 px. The target lies inside.
GUARD_HALF_PX, OUTER_HALF_PX = 7, 11
# Scales, for targets of up to 12 px to those of up to 50. Outlines are found in images that are at most as many scales
# finer, which bounds the window's size.
SCALES = 3
# Most regions found, and most examined at each scale, the strongest first; bounds the computing time.
MOST_TARGETS = 40
# Least standard deviation of a ring [grey levels]: a codec smooths away a sky's noise, but not its steps.
LEAST_ROUGHNESS = 1.5
# Factor by which the roughness of the surroundings counts where targets of one or two pixels are searched, in the mean
# of 2x2 px or in an image of twice the size: leaves and grass have such spots, a sky has none.
SMALLEST_TIMES = 2.0
# How far beside a target other texture counts: in parts of its larger side, and in pixels of the texture.
BESIDE, BESIDE_PX = 2.0, 6.0
# Part of the contrast at which a target's outline lies.
OUTLINE = 0.33
# Window of the mean that a pixel of the coarsest scale is compared with, which measures texture [px].
TEXTURE_PX = (5, 5)


class SmallTarget(NamedTuple):
    """A small region that stands out from its surroundings.

    Attributes:
        low: first column and row of its box [px].
        size: width and height of its box [px].
        contrast: grey level of its centre less that of the surroundings; negative if darker.
        signal: absolute contrast, in standard deviations of the surroundings.
        around: mean grey level of the surroundings.
        beside: largest texture beside it [grey levels]: little in the sky, much at a mast or a twig; inf if unknown.
        since: its change since each of `AGES_S`, nan if unknown; () if it was not compared.
        whole: whether it is a whole before a plain background, and what is inside it is no target of its own.
    """

    low: tuple[int, int]
    size: tuple[int, int]
    contrast: float
    signal: float
    around: float
    beside: float = 0.0
    since: tuple[float, ...] = ()
    whole: bool = False


def pyramid(images: Sequence[Image], length: int) -> list[Image]:
    """Halve the last of some images until there are ``length``, or it has a single row or column."""
    levels = list(images)
    while len(levels) < length and min(levels[-1].shape) > 1:
        half = cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(half, dtype=np.uint8))
    return levels


def find_small_targets(
    images: Sequence[Image], threshold: float, *, first: int = 0, of_difference: bool = False
) -> list[SmallTarget]:
    """Find regions that stand out at any scale, without overlaps, the strongest first.

    Args:
        images: image, (H, W), and its halvings; outlines and boxes are in pixels of the first.
        threshold: least contrast, in standard deviations of the surroundings.
        first: number of the finest in which targets are searched.
        of_difference: whether the image is a difference of two, in which dark regions and texture mean nothing.
    """
    coarsest = first + SCALES - 1
    levels = pyramid(images, coarsest + 2)
    scales = [
        n for n, level in enumerate(levels[: coarsest + 1]) if n >= first and min(level.shape) >= 2 * OUTER_HALF_PX
    ]
    peaks = [peak for scale in scales for peak in _peaks(levels, scale, threshold, scale == first, of_difference)]
    peaks.sort(key=lambda peak: -peak.signal)
    kept: list[SmallTarget] = []
    for peak in peaks:
        at = (peak.u + 0.5) * 2**peak.scale, (peak.v + 0.5) * 2**peak.scale
        if any(_contains(target, at) for target in kept):
            continue
        target = _outline(levels, peak, of_difference)
        if target is not None and not any(share(target, other) for other in kept):
            kept.append(target)
            if len(kept) == MOST_TARGETS:
                break
    if of_difference or coarsest not in scales:  # a small image is not searched at all scales
        return kept
    texture = cv2.absdiff(levels[coarsest], cv2.blur(levels[coarsest], TEXTURE_PX))
    return [target._replace(beside=_beside(texture, target, 2**coarsest)) for target in kept]


def _contains(target: SmallTarget, at: tuple[float, float]) -> bool:
    """Whether a target's box contains a place [px]."""
    (x, y), (w, h) = target.low, target.size
    return x <= at[0] < x + w and y <= at[1] < y + h


def _beside(texture: Image, target: SmallTarget, unit: int) -> float:
    """Find the largest texture around a target but not in it; ``unit`` is the side of the texture's pixels [px]."""
    side = max(target.size) / unit
    u, v = ((low + size / 2) / unit for low, size in zip(target.low, target.size, strict=True))
    outer, inner = (0.5 + BESIDE) * side + BESIDE_PX, 0.75 * side + 2
    left, top = max(0, round(u - outer)), max(0, round(v - outer))
    window = texture[top : round(v + outer) + 1, left : round(u + outer) + 1].copy()
    x, y = max(0, round(u - inner) - left), max(0, round(v - inner) - top)
    window[y : round(v + inner) - top + 1, x : round(u + inner) - left + 1] = 0
    return float(window.max(initial=0))


class _Peak(NamedTuple):
    """A peak of contrast: its pixel (u, v) at a scale, its signal, and the ring's mean."""

    u: int
    v: int
    scale: int
    signal: float
    around: float


def _peaks(levels: Sequence[Image], scale: int, threshold: float, finest: bool, of_difference: bool) -> list[_Peak]:
    """Find peaks of contrast at one scale, the strongest first.

    Args:
        levels: image, (H, W), and its halvings.
        scale: number of halvings.
        threshold: least contrast, in standard deviations of the surroundings.
        finest: whether targets of one or two pixels are searched too, in the mean of 2x2 px or in twice the size.
        of_difference: see `find_small_targets`.
    """
    level, (mean, deviation) = levels[scale], _ring(levels[scale + 1])
    width, height = size = level.shape[1], level.shape[0]
    blurred = cv2.blur(level, (INNER_PX,) * 2)
    searched = [(blurred, blurred, deviation)]  # darkest and brightest around each pixel, roughness of the surroundings
    if finest and not of_difference:
        rougher = deviation * np.float32(SMALLEST_TIMES) - np.float32((SMALLEST_TIMES - 1) * LEAST_ROUGHNESS)
        if scale:
            finer, pair = cv2.blur(levels[scale - 1], (INNER_PX,) * 2), np.ones((2, 2), np.uint8)
            dark, bright = (
                cv2.resize(of(finer, pair), size, interpolation=cv2.INTER_NEAREST) for of in (cv2.erode, cv2.dilate)
            )
        else:
            # Linear interpolation halfway between pixels is the mean of 2x2 px, at a third of blur's time.
            dark = bright = cv2.getRectSubPix(level, size, (width / 2 - 1, height / 2 - 1))
        searched.append((dark, bright, rougher))
    beyond = []  # by how much each pixel stands out beyond the threshold
    for dark, bright, roughness in searched:
        # In bytes, which is three times as fast; half a grey level is little beside the threshold.
        margin = roughness * np.float32(threshold)
        beyond.append(cv2.subtract(bright, cv2.resize(cv2.add(mean, margin, dtype=cv2.CV_8U), size)))
        if not of_difference:
            beyond.append(cv2.subtract(cv2.resize(cv2.subtract(mean, margin, dtype=cv2.CV_8U), size), dark))
    off = functools.reduce(cv2.max, beyond)
    peaks = []
    for contour in cv2.findContours(cv2.compare(off, 0, cv2.CMP_GT), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]:
        x, y, w, h = cv2.boundingRect(contour)
        if max(w, h) > 2 * GUARD_HALF_PX:  # it reaches into its own ring and is left to the next scale
            continue
        _, _, _, (i, j) = cv2.minMaxLoc(off[y : y + h, x : x + w])
        u, v = x + i, y + j
        at = (min(v // 2, mean.shape[0] - 1), min(u // 2, mean.shape[1] - 1))
        around = float(mean[at])
        signal = max(
            max(float(bright[v, u]) - around, around - float(dark[v, u])) / float(roughness[at])
            for dark, bright, roughness in searched
        )
        peaks.append(_Peak(u, v, scale, signal, around))
    peaks.sort(key=lambda peak: -peak.signal)
    return peaks[:MOST_TARGETS]


def _ring(half: Image) -> tuple[Array, Array]:
    """Mean and deviation of the ring around each pixel of an image of half the size."""
    part = 1 / (OUTER_HALF_PX**2 - GUARD_HALF_PX**2)
    means = []
    for box in (cv2.boxFilter, cv2.sqrBoxFilter):
        outer, guard = (box(half, cv2.CV_32F, (side,) * 2, normalize=False) for side in (OUTER_HALF_PX, GUARD_HALF_PX))
        means.append(cv2.addWeighted(outer, part, guard, -part, 0.0, outer))
    mean, square = means
    variance = cv2.max(cv2.subtract(square, cv2.multiply(mean, mean), square), LEAST_ROUGHNESS**2, square)
    return mean, cv2.sqrt(variance, variance)


def _outline(levels: Sequence[Image], peak: _Peak, of_difference: bool) -> SmallTarget | None:
    """Find the box of a peak, in the image of a finer scale; None if its outline leaves the ring.

    Args:
        levels: image, (H, W), and its halvings.
        peak: the peak.
        of_difference: whether the target is brighter than its surroundings in all its parts, as in a difference.
    """
    scale, around = peak.scale, peak.around
    fine = max(0, scale - SCALES)
    image, factor, unit = levels[fine], 2 ** (scale - fine), 2**fine
    u, v = factor * peak.u + factor // 2, factor * peak.v + factor // 2
    reach = factor * GUARD_HALF_PX
    left, top = max(0, u - reach), max(0, v - reach)
    window = image[top : v + reach + 1, left : u + reach + 1]
    x, y = max(0, u - left - factor), max(0, v - top - factor)
    darkest, brightest, *places = cv2.minMaxLoc(window[y : v - top + factor + 1, x : u - left + factor + 1])
    bright = of_difference or brightest - around >= around - darkest
    contrast, (i, j) = (brightest if bright else darkest) - around, places[bright]
    # An aeroplane has bright and dark parts.
    off = OUTLINE * abs(contrast)
    least = 0 if of_difference else max(0, math.ceil(around - off))
    beside = cv2.inRange(window, least, math.floor(around + off))
    x, y, w, h = cv2.floodFill(beside, None, (x + i, y + j), (1,), flags=8)[3]
    bottom, right = window.shape
    across = (x == 0 and left > 0) or (x + w == right and left + right < image.shape[1])
    down = (y == 0 and top > 0) or (y + h == bottom and top + bottom < image.shape[0])
    if across or down:
        return None  # it goes on beyond its ring: a pole, or a target for the next scale
    return SmallTarget((unit * (left + x), unit * (top + y)), (unit * w, unit * h), contrast, peak.signal, around)


def mostly_in(part: SmallTarget, whole: SmallTarget) -> bool:
    """Whether more than half of a region's box lies in another's."""
    sides = zip(part.low, part.size, whole.low, whole.size, strict=True)
    return 2 * math.prod(max(0, min(a + n, b + m) - max(a, b)) for a, n, b, m in sides) > math.prod(part.size)


def share(one: SmallTarget, other: SmallTarget) -> bool:
    """Whether the boxes of two regions overlap."""
    (x, y), (w, h), (u, v), (m, n) = one.low, one.size, other.low, other.size
    return x < u + m and u < x + w and y < v + n and v < y + h
