"""Whether what is at a place has changed, in the scene's own frame: a wing beats, a bird moves on; a sign does neither.

The place is compared with what was there some tenths of a second ago, shifted by what the camera did meanwhile. What
differs is stated as a part of the target's own contrast, so that it does not depend on the light.
"""

import math
from collections import deque

import cv2
import numpy as np

from cotarget.geometry import Array
from cotarget.rig import Image

# How long ago the place is looked at [s]: a wing beat differs after the shortest, a hovering bird after the longest.
AGES_S = (0.07, 0.17, 0.5, 1.0)
# A frame may be this much older or younger than the age asked for, as a part of it.
AGE_TOLERANCE = 0.5
# No more frames are kept than one in this time [s].
SPACING_S = 0.03
# A camera that stands is known to a pixel: the best likeness within so many is taken [px]. One that turned shows depth
# and its own distortion too, by this part of the way; but what lies farther than the last is a target that moved [px].
SEARCH_PX, SEARCH_PART, MOST_SEARCH_PX = 1, 0.05, 4
# What is compared reaches so far beyond the target's box [px].
MARGIN_PX = 2
# A coded and quantised picture differs by so much where nothing happens [grey levels].
LEAST_NOISE = 1.0
# Every so many pixels' difference to the last frame tells the noise.
NOISE_STRIDE = 8
# The median of a normal distribution's absolute values is this part of its standard deviation.
MEDIAN_OF_NORMAL = 0.6745


class History:
    """The last second's pictures, with where the camera had shifted to."""

    def __init__(self) -> None:
        """Begin with none."""
        self._kept: deque[tuple[float, Image, Array]] = deque()
        self._last: Image | None = None
        self.noise = LEAST_NOISE

    @property
    def span(self) -> float:
        """How far back it goes [s]."""
        return self._kept[-1][0] - self._kept[0][0] if self._kept else 0.0

    def add(self, t: float, grey: Image, shift: Array) -> bool:
        """Keep a picture; a clock that jumped back or far ahead begins anew.

        Returns:
            Whether it is another picture than the last.
        """
        if self._kept and not 0 < t - self._kept[-1][0] <= (1 + AGE_TOLERANCE) * AGES_S[-1]:
            self._kept.clear()
        if self._last is not None:
            a, b = (image[::NOISE_STRIDE, ::NOISE_STRIDE] for image in (self._last, grey))
            difference = cv2.absdiff(a, b)
            if not difference.any() and np.array_equal(self._last, grey):
                return False
            # One deviation of a difference of two, but for what moves: the mean of the usual ones, because a median of
            # whole levels is coarse. Of noise of 1 to 8 levels it tells 1.2 to 7.8; thresholds were chosen with that.
            usual = difference[difference <= 2 * float(np.median(difference)) + 2]
            self.noise = max(LEAST_NOISE, float(usual.mean()) / MEDIAN_OF_NORMAL / np.sqrt(2.0))
        self._last = grey
        if not self._kept or t - self._kept[-1][0] >= SPACING_S:
            self._kept.append((t, grey, shift))
            while t - self._kept[0][0] > (1 + AGE_TOLERANCE) * AGES_S[-1]:
                self._kept.popleft()
        return True

    def clear(self) -> None:
        """Forget all of it: the scene is another."""
        self._kept.clear()

    def references(self, t: float) -> list[tuple[Image, Array] | None]:
        """The picture nearest to each of the ages, with its shift; None where there is none of about that age."""
        found: list[tuple[Image, Array] | None] = []
        for age in AGES_S:
            best = min(self._kept, key=lambda kept: abs(t - kept[0] - age), default=None)
            near = best is not None and abs(t - best[0] - age) <= AGE_TOLERANCE * age
            found.append((best[1], best[2]) if best is not None and near else None)
        return found


def change(
    grey: Image,
    low: tuple[int, int],
    size: tuple[int, int],
    around: float,
    shift: Array,
    noise: float,
    before: tuple[Image, Array],
) -> float:
    """What of a target was not there before, as a part of its own contrast: 0 for nothing, 1 for all of it.

    Args:
        grey: (H, W) picture.
        low: the target's box's first column and row [px].
        size: its width and height [px].
        around: grey level of its surroundings.
        shift: of the camera now, (2,) [px].
        noise: standard deviation of the pictures' noise [grey levels].
        before: the earlier picture and the camera's shift then.

    Returns:
        0 where the place was not in view: a border that comes into view is no target.
    """
    earlier, shift_then = before
    left, top = max(0, low[0] - MARGIN_PX), max(0, low[1] - MARGIN_PX)
    patch = grey[top : low[1] + size[1] + MARGIN_PX, left : low[0] + size[0] + MARGIN_PX]
    h, w = patch.shape
    du, dv = (float(x) for x in shift_then - shift)
    # getRectSubPix's centre of a patch of n pixels from column x is x + (n - 1) / 2.
    u, v = left + (w - 1) / 2 + du, top + (h - 1) / 2 + dv
    if not ((w - 1) / 2 <= u + 0.5 and u - 0.5 <= grey.shape[1] - (w + 1) / 2):
        return 0.0
    if not ((h - 1) / 2 <= v + 0.5 and v - 0.5 <= grey.shape[0] - (h + 1) / 2):
        return 0.0
    search = min(MOST_SEARCH_PX, SEARCH_PX + round(SEARCH_PART * math.hypot(du, dv)))
    then = cv2.getRectSubPix(earlier, (w + 2 * search, h + 2 * search), (u, v))
    now = patch.astype(np.float32)
    brightened = then + np.float32(_level(patch) - _level(then))  # a light that flickers changes nothing
    squared = float(cv2.matchTemplate(brightened, now, cv2.TM_SQDIFF).min())
    excess = max(0.0, squared - 2 * noise**2 * w * h)
    energy = float(np.sum(np.square(now - np.float32(around)))) + noise**2 * w * h
    return excess / energy


def _level(patch: Image) -> float:
    """Mean grey level of a patch's rim, which is what surrounds the target."""
    return (cv2.mean(patch[0])[0] + cv2.mean(patch[-1])[0] + cv2.mean(patch[:, :1])[0] + cv2.mean(patch[:, -1:])[0]) / 4
