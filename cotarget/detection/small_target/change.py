"""Compare a place with earlier images, in the scene's own frame."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from cotarget.detection.base import SAME_S
from cotarget.detection.exposure import OTHER_PICTURE, SAME_EXPOSURE
from cotarget.geometry import Array
from cotarget.rig import Image

# Ages of the images compared with [s]: a wing beat differs after the shortest, a hovering bird after the longest.
AGES_S = (0.07, 0.17, 0.5, 1.0)
# Relative tolerance of an image's age.
AGE_TOLERANCE = 0.5
# Search for the best match: this many pixels if the camera stands; plus this part of its shift, for parallax and
# distortion; at most this many, beyond which a target has moved [px].
SEARCH_PX, SEARCH_PART, MOST_SEARCH_PX = 1, 0.05, 4
# Margin around the target's box that is compared as well [px].
MARGIN_PX = 2
# Least noise, from coding and quantisation, where nothing happens [grey levels].
LEAST_NOISE = 1.0
# Every how many pixels the noise is sampled, from the difference to the last frame.
NOISE_STRIDE = 8


@dataclass(frozen=True)
class Reference:
    """An earlier image to compare with.

    Attributes:
        image: the image, (H, W).
        shift: shift of the scene from now to then (du, dv) [px].
        search: how far a match is searched [px].
    """

    image: Image
    shift: tuple[float, float]
    search: int


class History:
    """Images of the last second, with the camera's shift at each."""

    def __init__(self) -> None:
        """Start without images."""
        self._kept: deque[tuple[float, Image, Array, float]] = deque()
        self._last: Image | None = None
        self._exposure = self._last_exposure = 1.0  # of the last image, without flicker and with it
        self.noise = LEAST_NOISE

    @property
    def span(self) -> float:
        """Time between the oldest and the newest image [s]."""
        return self._kept[-1][0] - self._kept[0][0] if self._kept else 0.0

    def add(self, t: float, grey: Image, shift: Array, exposure: float = 1.0) -> bool:
        """Add an image; restart if its time jumped back or far ahead, and drop images of another exposure.

        Args:
            t: exposure time [s].
            grey: image, (H, W).
            shift: the camera's shift, (2,) [px].
            exposure: its brightness relative to a reference.

        Returns:
            Whether the image differs from the last one.
        """
        if self._kept and not 0 < t - self._kept[-1][0] <= (1 + AGE_TOLERANCE) * AGES_S[-1]:
            self._kept.clear()
        if self._last is not None:
            a, b = (image[::NOISE_STRIDE, ::NOISE_STRIDE] for image in (self._last, grey))
            difference = cv2.absdiff(a, b)
            if not difference.any() and np.array_equal(self._last, grey):
                return False
            # The usual differences are averaged, because their median is coarse in whole grey levels and moving things
            # must not count. True noise of 1, 2, 4 and 8 levels gives 1.1, 2.1, 4.0 and 7.3.
            usual = difference[difference <= 2 * float(np.median(difference)) + 2]
            self.noise = max(LEAST_NOISE, float(usual.mean()))
        self._last = grey
        if abs(exposure / self._last_exposure - 1) > OTHER_PICTURE:
            self._kept.clear()
        self._last_exposure = exposure
        since = t - self._kept[-1][0] if self._kept else math.inf
        self._exposure += (1 - math.exp(-since / SAME_S)) * (exposure - self._exposure)
        self._kept.append((t, grey, shift, self._exposure))
        while (
            t - self._kept[0][0] > (1 + AGE_TOLERANCE) * AGES_S[-1]
            or abs(self._kept[0][3] / self._exposure - 1) > SAME_EXPOSURE
        ):
            self._kept.popleft()
        return True

    def clear(self) -> None:
        """Drop all images, after the scene has changed."""
        self._kept.clear()

    def references(self, t: float, shift: Array) -> list[Reference | None]:
        """Return the image nearest to each of `AGES_S` before a time [s], None for an age without one.

        Args:
            t: time of the next image [s].
            shift: the camera's shift at that time, (2,) [px].
        """
        found: list[Reference | None] = []
        ages = t - np.array([kept[0] for kept in self._kept])
        for age in AGES_S:
            off = np.abs(ages - age)
            if not (off.size and off.min() <= AGE_TOLERANCE * age):
                found.append(None)
                continue
            _, image, shift_then, _ = self._kept[int(off.argmin())]
            du, dv = (shift_then - shift).tolist()
            search = min(MOST_SEARCH_PX, SEARCH_PX + round(SEARCH_PART * math.hypot(du, dv)))
            found.append(Reference(image, (du, dv), search))
        return found


def changes(
    grey: Image,
    low: tuple[int, int],
    size: tuple[int, int],
    around: float,
    noise: float,
    references: Sequence[Reference | None],
) -> list[float]:
    """Measure the part of a target's contrast that was not there before: 0 for nothing, 1 for all of it.

    It is relative to the target's own contrast, so that it does not depend on the light.

    Args:
        grey: image, (H, W).
        low: first column and row of the target's box [px].
        size: width and height of the box [px].
        around: grey level of the surroundings.
        noise: standard deviation of the image noise [grey levels].
        references: earlier images; None where there is none.

    Returns:
        The change since each; nan where there is none, and 0 if the place was not in view then, because a border that
        comes into view is no target.
    """
    left, top = max(0, low[0] - MARGIN_PX), max(0, low[1] - MARGIN_PX)
    patch = grey[top : low[1] + size[1] + MARGIN_PX, left : low[0] + size[0] + MARGIN_PX]
    h, w = patch.shape
    now = patch.astype(np.float32)
    level, variance = _level(now), noise**2 * w * h
    energy = float(np.square(now - np.float32(around)).sum()) + variance
    found = [math.nan if before is None else 0.0 for before in references]
    most = max((before.search for before in references if before is not None), default=0)
    size, patches = (w + 2 * most, h + 2 * most), []
    for age, before in enumerate(references):
        if before is None:
            continue
        x, y = left + before.shift[0], top + before.shift[1]
        if -0.5 <= x <= grey.shape[1] - w + 0.5 and -0.5 <= y <= grey.shape[0] - h + 0.5:
            # getRectSubPix takes the centre of a patch: n pixels from column x are centred at x + (n - 1) / 2.
            center, rim = (x + (w - 1) / 2, y + (h - 1) / 2), most - before.search
            then = cv2.getRectSubPix(before.image, size, center, patchType=cv2.CV_32F)
            near = then[rim : size[1] - rim, rim : size[0] - rim]
            patches.append((age, rim, then + np.float32(level - _level(near))))  # flickering light is no change
    if patches:  # all ages at once, because for small patches a call takes longer than its arithmetic
        squared = cv2.matchTemplate(cv2.hconcat([then for *_, then in patches]), now, cv2.TM_SQDIFF)
        for first, (age, rim, _) in zip(range(0, squared.shape[1], size[0]), patches, strict=True):
            end = 2 * most + 1 - rim
            least = _least(squared[rim:end, first + rim : first + end])
            found[age] = max(0.0, least - 2 * variance) / energy
    return found


def _least(values: np.ndarray) -> float:
    """Estimate the least value of a surface between its samples, with a parabola along each axis."""
    least, _, (u, v), _ = cv2.minMaxLoc(values)
    height, width = values.shape
    found = least
    if 0 < u < width - 1:
        found -= _below(least, float(values[v, u - 1]), float(values[v, u + 1]))
    if 0 < v < height - 1:
        found -= _below(least, float(values[v - 1, u]), float(values[v + 1, u]))
    return found


def _below(least: float, before: float, after: float) -> float:
    """How far the vertex of a parabola through three samples lies below the middle one, the least."""
    bend = before - 2 * least + after
    return (before - after) ** 2 / (8 * bend) if bend > 0 else 0.0


def _level(patch: np.ndarray) -> float:
    """Mean grey level of a patch's rim, which is the target's surroundings."""
    inside = patch[1:-1, 1:-1]
    rim = cv2.sumElems(patch)[0] - cv2.sumElems(inside)[0]
    return rim / (patch.size - inside.size)
