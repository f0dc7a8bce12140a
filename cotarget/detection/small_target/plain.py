"""Find large regions that stand out before a plain background, each as a whole, with its wings and rotors.

The background is the median over half the image's width, in a small image: what covers less than half of that is not in
it. A region is what differs from it by more than the usual difference.
"""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.detection.base import pieces
from cotarget.detection.small_target.contrast import OUTLINE, SmallTarget
from cotarget.rig import Image

Box = tuple[int, int, int, int]  # left, top, width and height [px]
# Number of halvings of the image in which regions are found, and pixels along a pixel of that of the background.
FINE, COARSE_PX = 1, 8
# Least larger side of a region, in parts of the image's width.
LEAST_PART = 40 / 640
# Side of the median's window, in parts of the image's width.
WINDOW_PART = 0.5
# Least difference from the background: in usual differences, and in grey levels.
TIMES, LEAST_LEVELS = 4.0, 3.0
# Least difference of a region's parts, over its largest one. If anything beside it differs by more, it is no whole: a
# person's coat before a wall has legs and head beside it.
FAINTEST = 0.15
# Least difference from its own surroundings of what reaches farther from a region than its blurred edge, over the
# region's largest difference: rotors; and the width of that edge [px].
FAINT, BLUR_PX = 0.06, 3
# Gap that is closed within a region, in pixels of the image in which they are found.
GAP_PX = 5
# Pixels, about, in which a region and its surroundings are sampled.
SAMPLES = 1000


def find_wholes(levels: Sequence[Image], times: int) -> list[SmallTarget]:
    """Find the regions of an image (H, W) that stand out before a plain background.

    Args:
        levels: the image and its halvings.
        times: factor from its pixels to those of the regions.
    """
    if len(levels) <= FINE:
        return []
    grey, fine, unit = levels[0], levels[FINE], 2**FINE
    height, width = grey.shape
    coarse = (max(1, width // COARSE_PX), max(1, height // COARSE_PX))
    small = cv2.resize(grey, coarse, interpolation=cv2.INTER_AREA)
    side = 2 * round(WINDOW_PART * small.shape[1] / 2) + 1
    ground = cv2.resize(cv2.blur(cv2.medianBlur(small, side), (5, 5)), fine.shape[::-1], interpolation=cv2.INTER_LINEAR)
    sharp = cv2.absdiff(fine, ground)
    off = cv2.blur(sharp, (3, 3))
    below = np.cumsum(cv2.calcHist([off], [0], None, [256], [0, 256]))  # a seventh of the time of np.median
    usual = max(float(np.searchsorted(below, off.size / 2)), LEAST_LEVELS / TIMES)
    mask = cv2.compare(off, TIMES * usual, cv2.CMP_GT)
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((GAP_PX, GAP_PX), np.uint8))
    found = []
    for x, y, w, h in pieces(np.asarray(mask, dtype=np.uint8), (1, 1)):
        if unit * max(w, h) < LEAST_PART * width:
            continue
        contrast = float(sharp[y : y + h, x : x + w].max())
        body = sharp[y : y + h, x : x + w] > max(TIMES * usual, FAINTEST * contrast)
        dx, dy, w, h = cv2.boundingRect(body.astype(np.uint8))
        x, y = x + dx, y + dy
        if unit * max(w, h) < LEAST_PART * width or (w, h) == mask.shape[::-1]:  # nothing is beside the whole image
            continue
        margin = max(2, max(w, h) // 4)
        left, top = max(0, x - margin), max(0, y - margin)
        ring = off[top : y + h + margin, left : x + w + margin].copy()
        ring[max(0, y - 2) - top : y + 2 - top + h, max(0, x - 2) - left : x + 2 - left + w] = 0
        beside = float(ring.max(initial=0))
        if beside > FAINTEST * contrast:
            continue
        around = float(ground[y : y + h, x : x + w].mean())
        box = _outline(grey, (unit * x, unit * y, unit * w, unit * h), unit, contrast)
        x, y, w, h = (times * side for side in box)
        found.append(SmallTarget((x, y), (w, h), contrast, contrast / usual, around, beside, whole=True))
    return found


def _outline(grey: Image, box: Box, unit: int, contrast: float) -> Box:
    """Outline a region of a ``contrast`` [grey levels] before its own surroundings.

    Blurred rotors and wing tips are as faint as the clouds of the whole image, and not as those nearby. They are part
    of the region where they reach farther than a blurred edge. The result is the box of a region without an end nearby,
    or cut by the image's border, because half of its surroundings are not seen.
    """
    x, y, w, h = box
    height, width = grey.shape
    if min(x, y) < unit or x + w > width - unit or y + h > height - unit:
        return box
    reach = max(w, h) // 2
    left, top = max(0, x - reach), max(0, y - reach)
    window = grey[top : y + h + reach, left : x + w + reach]
    inside = x - left, y - top, w, h
    plane, usual = _surroundings(window, inside, reach / 2)
    off = cv2.absdiff(window, plane)
    least = unit * max(TIMES * usual, LEAST_LEVELS)
    masks = (cv2.compare(off, max(least, part * contrast), cv2.CMP_GT) for part in (OUTLINE, FAINT))
    core, whole = (_edges(mask, inside) for mask in masks)
    if core is None or whole is None:
        return box
    x0, y0, x1, y1 = np.add(np.where(np.abs(whole - core) > BLUR_PX, whole, core), (left, top) * 2).tolist()
    bottom, right = np.add((top, left), window.shape)
    if 0 < x0 == left or 0 < y0 == top or x1 == right < width or y1 == bottom < height:
        return box
    return x0, y0, x1 - x0, y1 - y0


def _surroundings(window: Image, box: Box, near: float) -> tuple[Image, float]:
    """Fit a plane of grey levels to what is farther than ``near`` [px] from a box; return it and the usual difference.

    A box that leaves hardly anything beside it has no usual difference, but inf.
    """
    x, y, w, h = box
    step = max(1, round(math.sqrt(window.size / SAMPLES)))
    v, u = (n.ravel() for n in np.mgrid[: window.shape[0] : step, : window.shape[1] : step])
    beside = (np.abs(u - x - w / 2) > w / 2 + near) | (np.abs(v - y - h / 2) > h / 2 + near)
    if np.count_nonzero(beside) < SAMPLES / 10:
        return window, math.inf
    v, u = v[beside], u[beside]
    places, levels = np.stack([u, v, np.ones(len(u))], axis=1), window[v, u].astype(float)
    for _ in range(2):  # the second time without what stands out
        fit = np.linalg.lstsq(places, levels, rcond=None)[0]
        off = np.abs(places @ fit - levels)
        usual = float(np.median(off))
        plain = off <= max(TIMES * usual, LEAST_LEVELS)
        places, levels = places[plain], levels[plain]
    rows, columns = (np.arange(n, dtype=np.float32) for n in window.shape)
    a, b, c = fit.astype(np.float32)
    return np.asarray(cv2.convertScaleAbs(a * columns + (b * rows + c)[:, None]), dtype=np.uint8), usual


def _edges(mask: Image, box: Box) -> npt.NDArray[np.int_] | None:
    """Left, top, right and bottom of the components of a mask that are mostly in a box or hold most of it, (4,).

    None if there is none.
    """
    low, size = np.split(np.reshape(pieces(mask, (1, 1)), (-1, 4)), 2, axis=1)
    high, begin, end = low + size, np.array(box[:2]), np.add(box[:2], box[2:])
    shared = np.maximum(np.minimum(high, end) - np.maximum(low, begin), 0).prod(axis=1)
    own = 2 * shared > np.minimum(size.prod(axis=1), (end - begin).prod())
    return np.concatenate([low[own].min(axis=0), high[own].max(axis=0)]) if own.any() else None
