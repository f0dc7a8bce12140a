"""Find large regions that stand out before a plain background, each as a whole, with its wings and rotors.

The background is the median over half the image's width, in a small image: what covers less than half of that is not in
it. A region is what differs from it by more than the usual difference.
"""

import cv2
import numpy as np

from cotarget.detection.small_target.contrast import SmallTarget
from cotarget.rig import Image

# Image in which the background is found, in which regions are found, and the least larger side of a region, in parts of
# the image's width.
COARSE_PART, FINE_PART, LEAST_PART = 8 / 640, 2 / 640, 40 / 640
# Side of the median's window, and most that a region covers, in parts of the image's width.
WINDOW_PART, MOST_PART = 0.5, 0.8
# Least difference from the background: in usual differences, and in grey levels.
TIMES, LEAST_LEVELS = 4.0, 3.0
# Least difference of a region's parts, over its largest one. If anything beside it differs by more, it is no whole: a
# person's coat before a wall has legs and head beside it.
FAINTEST = 0.15
# Gap that is closed within a region, in pixels of the image in which they are found.
GAP_PX = 5


def find_wholes(grey: Image, times: int) -> list[SmallTarget]:
    """Find the regions of an image (H, W) that stand out before a plain background.

    Args:
        grey: the image.
        times: factor from its pixels to those of the regions.
    """
    height, width = grey.shape
    unit = max(1, round(FINE_PART * width))
    coarse = max(1, round(COARSE_PART * width))
    fine, small = (
        cv2.resize(grey, (max(1, width // side), max(1, height // side)), interpolation=cv2.INTER_AREA)
        for side in (unit, coarse)
    )
    side = 2 * round(WINDOW_PART * small.shape[1] / 2) + 1
    ground = cv2.resize(cv2.blur(cv2.medianBlur(small, side), (5, 5)), fine.shape[::-1], interpolation=cv2.INTER_LINEAR)
    sharp = cv2.absdiff(fine, ground)
    off = cv2.blur(sharp, (3, 3))
    below = np.cumsum(cv2.calcHist([off], [0], None, [256], [0, 256]))  # a seventh of the time of np.median
    usual = max(float(np.searchsorted(below, off.size / 2)), LEAST_LEVELS / TIMES)
    mask = cv2.compare(off, TIMES * usual, cv2.CMP_GT)
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((GAP_PX, GAP_PX), np.uint8))
    found = []
    for contour in cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]:
        x, y, w, h = cv2.boundingRect(contour)
        if unit * max(w, h) < LEAST_PART * width:
            continue
        contrast = float(sharp[y : y + h, x : x + w].max())
        body = sharp[y : y + h, x : x + w] > max(TIMES * usual, FAINTEST * contrast)
        dx, dy, w, h = cv2.boundingRect(body.astype(np.uint8))
        x, y = x + dx, y + dy
        if not LEAST_PART * width <= unit * max(w, h) <= MOST_PART * width:
            continue
        margin = max(2, max(w, h) // 4)
        left, top = max(0, x - margin), max(0, y - margin)
        ring = off[top : y + h + margin, left : x + w + margin].copy()
        ring[max(0, y - 2) - top : y + 2 - top + h, max(0, x - 2) - left : x + 2 - left + w] = 0
        beside = float(ring.max(initial=0))
        if beside > FAINTEST * contrast:
            continue
        around = float(ground[y : y + h, x : x + w].mean())
        low, size = _outline(grey, ground, (x, y, w, h), unit, max(unit * TIMES * usual, FAINTEST * contrast))
        low, size = (times * low[0], times * low[1]), (times * size[0], times * size[1])
        found.append(SmallTarget(low, size, contrast, contrast / usual, around, beside, whole=True))
    return found


def _outline(
    grey: Image, ground: Image, box: tuple[int, int, int, int], unit: int, least: float
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Find low and size of a region in full resolution from its box in an image reduced by a factor ``unit`` [px]."""
    x, y, w, h = box
    before = cv2.resize(ground[y : y + h, x : x + w], None, fx=unit, fy=unit, interpolation=cv2.INTER_LINEAR)
    now = grey[unit * y : unit * (y + h), unit * x : unit * (x + w)]
    dx, dy, w, h = cv2.boundingRect(cv2.compare(cv2.absdiff(now, before), least, cv2.CMP_GT))
    return (unit * x + dx, unit * y + dy), (w, h)
