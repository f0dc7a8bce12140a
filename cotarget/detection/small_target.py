"""Detect small targets, moving or hovering, by contrast and change, with a fixed camera that may shake.

Movement alone cannot find a bird that hovers, and contrast alone finds every sign and chimney. The score multiplies
both: the contrast in standard deviations of the surroundings, and the part of it that was not there before, in units of
what air, codec and camera shake change of a thing that stands. Unless the camera pans, the difference from earlier
images is searched too, which finds a bird in front of foliage or beside a roof's edge.

- `CameraMotion` estimates the shift of the image since the first frame.
- `History` and `changes` compare a place with earlier images, in the scene's own frame.
- `find_small_targets` compares each place with the ring around it at several scales, a constant false alarm rate
  detector (Rohling 1983) in two dimensions.

In rig.toml this detector is called "speck". Measurements: docs/design-notes.md.
"""

import functools
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.detection.base import Detections, box_detection, check_size, is_clipped, moved
from cotarget.geometry import Array
from cotarget.rig import Detection, Frame, Image

if TYPE_CHECKING:
    from cotarget.tracking.track import Track

# Factor by which the image is reduced before corners are tracked; full size gives no better shift at twice the cost.
SCALE = 2
# Cells along width and height; of each, the strongest corner is tracked, so that a large target does not have most.
CORNER_CELLS = (16, 12)
# Least eigenvalue of a corner, of cv2.cornerMinEigenVal: noise of 5 grey levels reaches it. In an image of sky
# alone, the strongest corners are the target and artefacts of the codec.
LEAST_CORNER = 3e-4
CORNER_BLOCK = 3
# Fewer corners are no measurement, and the camera is taken to stand still.
FEWEST = 8
# Least standard deviation of the corners' places along one axis, over the image's side. Corners nearer together are on
# a target before a plain background, and the camera is taken to stand still. All over half an image they have 0.144.
SPREAD = 0.144
# Fewest corners, where there were too few before, that show another scene.
MANY = 24
# If less than the first part of the corners is found again, or less than the second part of these at one shift, the
# film was cut or the camera was moved. Standing corners count as the scene's from the second part on.
FOUND_AGAIN, FEWEST_ALIKE = 0.3, 0.35
# Frames after which corners are detected again, because some have drifted off and some are on a target.
RENEW_FRAMES = 15
# Window in which a corner is tracked, and pyramid levels: up to 20 px a frame of the full image.
WINDOW_PX, LEVELS = (11, 11), 2
# Largest difference of a corner's shift from the common one, along each axis [px].
AGREEMENT_PX = 2.0


class CameraMotion:
    """Estimate the camera's shake, nudges and slow turns as the shift that most corners have (Lucas and Kanade).

    Only a shift is estimated: the shake and slow turns of a fixed camera hardly rotate the image, and the remainder is
    small beside a target.

    Attributes:
        jumped: whether the last frame shows another scene than the one before.
    """

    def __init__(self) -> None:
        """Start with no shift."""
        self._last: Image | None = None
        self._corners = self._first = np.zeros((0, 1, 2), np.float32)  # now, and where each was detected
        self._before = np.zeros(2)  # shift of the image in which they were detected
        self._age = RENEW_FRAMES
        self._shift = np.zeros(2)
        self.jumped = False

    def update(self, grey: Image) -> Array:
        """Update the shift with the next frame.

        Args:
            grey: image, (H, W).

        Returns:
            Shift (du, dv) of the scene since the first frame [px], (2,).
        """
        size = (max(1, grey.shape[1] // SCALE), max(1, grey.shape[0] // SCALE))
        half = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        if self._last is not None:
            self._step(self._last, half)
        self._last = half
        return self._shift

    def _step(self, before: Image, after: Image) -> None:
        """Update the shift from one image of reduced size to the next.

        It is measured since the corners were detected and not from frame to frame: clouds, which drift by a tenth of a
        pixel a frame, are then distinguished from the scene, and their drift does not add up.
        """
        self.jumped = False
        self._age += 1
        if self._age >= RENEW_FRAMES:
            self._begin(_corners(before))
            self._age = 0
        if len(self._corners) < FEWEST or _spread(self._corners, before) < SPREAD:
            # A film that goes on in another place: where there was sky alone, there are many corners at once.
            come = _corners(after)
            self.jumped = len(self._corners) < FEWEST and len(come) >= MANY and _spread(come, after) >= SPREAD
            self._begin(come)
            return
        ahead, found, _ = cv2.calcOpticalFlowPyrLK(
            before, after, self._corners, None, winSize=WINDOW_PX, maxLevel=LEVELS
        )
        kept = found.ravel() > 0
        flow = (ahead - self._corners).reshape(-1, 2)
        alike = kept & _alike(flow, np.median(flow[kept], axis=0) if kept.any() else np.zeros(2))
        standing = kept & _alike(flow, np.zeros(2)) & ~alike
        # A large target may have more corners than the scene, but the scene extends over more of the image. So may
        # leaves or letters that stand in a shaken image, but they are few.
        fewest = FEWEST_ALIKE * kept.sum()
        farther = _spread(self._corners[standing], before) > _spread(self._corners[alike], before)
        if farther and standing.sum() >= fewest:
            alike = standing
        if kept.mean() < FOUND_AGAIN or alike.sum() < fewest:
            self.jumped, self._age = True, RENEW_FRAMES
            return
        way = (ahead - self._first).reshape(-1, 2)[alike]
        self._corners, self._first = ahead[kept], self._first[kept]
        self._shift = self._before + SCALE * np.array([_shorth(way[:, axis]) for axis in (0, 1)])

    def _begin(self, corners: npt.NDArray[np.float32]) -> None:
        """Measure the shift by these corners, from the image on that they were detected in."""
        self._corners = self._first = corners
        self._before = self._shift


def _corners(picture: Image) -> npt.NDArray[np.float32]:
    """Detect the strongest corner of each cell that is stronger than noise, (n, 1, 2)."""
    strength = cv2.cornerMinEigenVal(picture, CORNER_BLOCK)
    columns, rows = CORNER_CELLS
    height, width = -(-picture.shape[0] // rows), -(-picture.shape[1] // columns)  # of a cell
    below, beside = rows * height - picture.shape[0], columns * width - picture.shape[1]
    whole = cv2.copyMakeBorder(strength, 0, below, 0, beside, cv2.BORDER_CONSTANT)
    cells = whole.reshape(rows, height, columns, width).swapaxes(1, 2).reshape(rows, columns, -1)
    v, u = np.nonzero(cells.max(axis=2) >= LEAST_CORNER)
    down, across = np.divmod(cells.argmax(axis=2)[v, u], width)
    return np.asarray(np.stack([u * width + across, v * height + down], axis=1)[:, None], dtype=np.float32)


def _spread(corners: npt.NDArray[np.float32], picture: Image) -> float:
    """Standard deviation of corners' places over the image's side, the larger of both axes; 0 for none."""
    return float((corners.std(axis=(0, 1)) / picture.shape[::-1]).max()) if len(corners) else 0.0


def _shorth(values: Array) -> float:
    """Mean of the shortest half of values, (n,) (Andrews et al. 1972), which corners on clouds do not change."""
    ordered, half = np.sort(values), len(values) // 2
    first = int(np.argmin(ordered[half:] - ordered[: len(ordered) - half]))
    return float(ordered[first : first + half + 1].mean())


def _alike(flow: Array, shift: Array) -> npt.NDArray[np.bool_]:
    """Whether each corner's flow is that of a shift [px of the reduced image]."""
    return np.asarray((np.abs(flow - shift) <= AGREEMENT_PX / SCALE).all(axis=1))


# Change against earlier images

# Ages of the images compared with [s]: a wing beat differs after the shortest, a hovering bird after the longest.
AGES_S = (0.07, 0.17, 0.5, 1.0)
# Relative tolerance of an image's age.
AGE_TOLERANCE = 0.5
# Least time between two kept images [s].
SPACING_S = 0.03
# Search for the best match: this many pixels if the camera stands; plus this part of its shift, for parallax and
# distortion; at most this many, beyond which a target has moved [px].
SEARCH_PX, SEARCH_PART, MOST_SEARCH_PX = 1, 0.05, 4
# Margin around the target's box that is compared as well [px].
MARGIN_PX = 2
# Least noise, from coding and quantisation, where nothing happens [grey levels].
LEAST_NOISE = 1.0
# Every how many pixels the noise is sampled, from the difference to the last frame.
NOISE_STRIDE = 8
# Median of a normal distribution's absolute values over its standard deviation.
MEDIAN_OF_NORMAL = 0.6745


class History:
    """Images of the last second, with the camera's shift at each."""

    def __init__(self) -> None:
        """Start without images."""
        self._kept: deque[tuple[float, Image, Array]] = deque()
        self._last: Image | None = None
        self.noise = LEAST_NOISE

    @property
    def span(self) -> float:
        """Time between the oldest and the newest image [s]."""
        return self._kept[-1][0] - self._kept[0][0] if self._kept else 0.0

    @property
    def kept_last(self) -> bool:
        """Whether the last image was kept: it came at least SPACING_S after the one kept before."""
        return bool(self._kept) and self._kept[-1][1] is self._last

    def add(self, t: float, grey: Image, shift: Array) -> bool:
        """Add an image; restart if its time jumped back or far ahead.

        Args:
            t: exposure time [s].
            grey: image, (H, W).
            shift: the camera's shift, (2,) [px].

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
            # must not count. True noise of 1 to 8 levels gives 1.2 to 7.8; the thresholds were chosen with that.
            usual = difference[difference <= 2 * float(np.median(difference)) + 2]
            self.noise = max(LEAST_NOISE, float(usual.mean()) / MEDIAN_OF_NORMAL / np.sqrt(2.0))
        self._last = grey
        if not self._kept or t - self._kept[-1][0] >= SPACING_S:
            self._kept.append((t, grey, shift))
            while t - self._kept[0][0] > (1 + AGE_TOLERANCE) * AGES_S[-1]:
                self._kept.popleft()
        return True

    def clear(self) -> None:
        """Drop all images, after the scene has changed."""
        self._kept.clear()

    def references(self, t: float) -> list[tuple[Image, Array] | None]:
        """Return the image nearest to each of `AGES_S`, with its shift; None for an age without an image."""
        found: list[tuple[Image, Array] | None] = []
        ages = t - np.array([kept[0] for kept in self._kept])
        for age in AGES_S:
            off = np.abs(ages - age)
            near = off.size and off.min() <= AGE_TOLERANCE * age
            found.append(self._kept[int(off.argmin())][1:] if near else None)
        return found


def changes(
    grey: Image,
    low: tuple[int, int],
    size: tuple[int, int],
    around: float,
    shift: Array,
    noise: float,
    references: Sequence[tuple[Image, Array] | None],
) -> list[float]:
    """Measure the part of a target's contrast that was not there before: 0 for nothing, 1 for all of it.

    It is relative to the target's own contrast, so that it does not depend on the light.

    Args:
        grey: image, (H, W).
        low: first column and row of the target's box [px].
        size: width and height of the box [px].
        around: grey level of the surroundings.
        shift: the camera's shift now, (2,) [px].
        noise: standard deviation of the image noise [grey levels].
        references: earlier images and the camera's shift then; None where there is none.

    Returns:
        The change since each; nan where there is none, and 0 if the place was not in view then, because a border that
        comes into view is no target.
    """
    left, top = max(0, low[0] - MARGIN_PX), max(0, low[1] - MARGIN_PX)
    patch = grey[top : low[1] + size[1] + MARGIN_PX, left : low[0] + size[0] + MARGIN_PX]
    h, w = patch.shape
    now = patch.astype(np.float32)
    level = _level(now)
    energy = float(np.square(now - np.float32(around)).sum()) + noise**2 * w * h
    found = []
    for before in references:
        if before is None:
            found.append(math.nan)
            continue
        earlier, shift_then = before
        du, dv = (shift_then - shift).tolist()
        # getRectSubPix takes the centre of a patch: n pixels from column x are centred at x + (n - 1) / 2.
        u, v = left + (w - 1) / 2 + du, top + (h - 1) / 2 + dv
        if not all(
            (n - 1) / 2 <= x + 0.5 and x - 0.5 <= of - (n + 1) / 2
            for x, n, of in ((u, w, grey.shape[1]), (v, h, grey.shape[0]))
        ):
            found.append(0.0)
            continue
        search = min(MOST_SEARCH_PX, SEARCH_PX + round(SEARCH_PART * math.hypot(du, dv)))
        then = cv2.getRectSubPix(earlier, (w + 2 * search, h + 2 * search), (u, v), patchType=cv2.CV_32F)
        then += np.float32(level - _level(then))  # flickering light is no change
        squared = _least(cv2.matchTemplate(then, now, cv2.TM_SQDIFF))
        found.append(max(0.0, squared - 2 * noise**2 * w * h) / energy)
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
    return (cv2.mean(patch[0])[0] + cv2.mean(patch[-1])[0] + cv2.mean(patch[:, :1])[0] + cv2.mean(patch[:, -1:])[0]) / 4


# Contrast with the surrounding ring

# Side of the square at a target's centre at the finest scale [px]; each further scale doubles all lengths.
INNER_PX = 3
# Inner and outer side of the ring, in pixels of an image of half the size: 14 and 22 px. The target lies inside.
GUARD_HALF_PX, OUTER_HALF_PX = 7, 11
# Scales, for targets of up to 12 px to those of up to 400; in the difference, of up to 50.
SCALES, SCALES_OF_DIFFERENCE = 6, 3
# How far the largest ring of the difference reaches, and the side of a pixel of its largest scale [px].
REACH_PX, ALIGNED_PX = OUTER_HALF_PX * 2**SCALES_OF_DIFFERENCE, 2**SCALES_OF_DIFFERENCE
# First scale whose ring, 90 px, is so large that a sky's gradient counts.
SLOPING_SCALE = 2
# Least standard deviation of a ring [grey levels]: a codec smooths away a sky's noise, but not its steps.
LEAST_ROUGHNESS = 1.5
# Factor by which the roughness of the surroundings counts where targets of one or two pixels are searched, in the mean
# of 2x2 px or in an image of twice the size: leaves and grass have such spots, a sky has none.
SMALLEST_TIMES = 2.0
# How far beside a target other texture counts: in parts of its larger side, and in pixels of the texture.
BESIDE, BESIDE_PX = 2.0, 6.0
# Part of the contrast at which a target's outline lies.
OUTLINE = 0.33
# From this scale on, wings and rotors that are fainter than the body belong to the target: what stands out by this
# many standard deviations of the surroundings, brighter or darker, and by a least part of the contrast.
LARGE_SCALE, FAINT, FAINTEST = 2, 3.0, 0.05
# Window of the mean that a pixel is compared with for its texture [px]. Bright and dark parts of an aeroplane cancel in
# the mean of a coarse scale; in the sky around it there is no texture.
TEXTURE_PX = (5, 5)
# Outlines are found this many scales finer than the peak, which bounds the window's size.
WINDOW_SCALES = 3
# The lens' blur is as faint: it reaches this far around the body [px].
BLUR_PX = 2.5


@dataclass(frozen=True)
class SmallTarget:
    """A small region that stands out from its surroundings.

    Attributes:
        low: first column and row of its box [px].
        size: width and height of its box [px].
        contrast: grey level of its centre less that of the surroundings; negative if darker.
        signal: absolute contrast, in standard deviations of the surroundings.
        around: mean grey level of the surroundings.
        beside: largest texture beside it [grey levels]: little in the sky, much at a mast or a twig; inf if unknown.
        since: its change since each of `AGES_S`, nan if unknown; () if it was not compared.
    """

    low: tuple[int, int]
    size: tuple[int, int]
    contrast: float
    signal: float
    around: float
    beside: float = 0.0
    since: tuple[float, ...] = ()


def find_small_targets(
    grey: Image,
    threshold: float,
    most: int,
    *,
    finer: Sequence[Image] = (),
    scales: int = SCALES,
    of_difference: bool = False,
) -> list[SmallTarget]:
    """Find regions that stand out at any scale, without overlaps, the strongest first.

    Args:
        grey: image, (H, W).
        threshold: least contrast, in standard deviations of the surroundings.
        most: most regions returned, and most examined at each scale; bounds the computing time.
        finer: images of which ``grey`` is a halving, the finest first; outlines and boxes are in pixels of the first.
        scales: number of scales.
        of_difference: whether the image is a difference of two, in which dark regions and texture mean nothing.
    """
    levels, first = [*finer, grey], len(finer)
    texture: Image | None = None
    peaks: list[_Peak] = []
    for scale in range(first, first + scales):
        level = levels[scale]
        if min(level.shape) < 2 * OUTER_HALF_PX:
            break
        levels.append(cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
        above = levels[scale - 1] if scale == first and first else None
        sloping, finest = scale - first >= SLOPING_SCALE, scale == 0 and not of_difference
        peaks += _peaks(level, levels[-1], scale, sloping, threshold, most, above, finest)
        if scale - first > LARGE_SCALE and texture is not None:
            texture = cv2.resize(texture, level.shape[::-1], interpolation=cv2.INTER_AREA)
            peaks += _textured(texture, levels[-1], scale, threshold, most)
        elif scale - first == LARGE_SCALE and not of_difference:
            texture = fine_texture = cv2.absdiff(level, cv2.blur(level, TEXTURE_PX))
    peaks.sort(key=lambda peak: -peak.signal)
    kept: list[SmallTarget] = []
    for peak in peaks:
        at = (peak.u + 0.5) * 2**peak.scale, (peak.v + 0.5) * 2**peak.scale
        if any(_contains(target, at) for target in kept):
            continue
        large = peak.scale - first >= LARGE_SCALE
        target = _outline(levels, peak, large, of_difference)
        if target is not None and not any(share(target, other) for other in kept):
            kept.append(target)
            if len(kept) == most:
                break
    if texture is None:
        return kept
    return [replace(target, beside=_beside(fine_texture, target, 2 ** (first + LARGE_SCALE))) for target in kept]


def _contains(target: SmallTarget, at: tuple[float, float]) -> bool:
    """Whether a target's box contains a place [px]."""
    return all(low <= x < low + size for low, size, x in zip(target.low, target.size, at, strict=True))


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


@dataclass(frozen=True)
class _Peak:
    """A peak of contrast: its pixel (u, v) at a scale, its signal, and the ring's mean."""

    u: int
    v: int
    scale: int
    signal: float
    around: float


def _limits(mean: Array, deviation: Array, threshold: float, size: tuple[int, int]) -> tuple[Image, Image]:
    """Grey levels beyond which a pixel stands out, in an image of a size (width, height) [px].

    In bytes, which is three times as fast; half a grey level is little beside ``threshold`` deviations.
    """
    margin = deviation * np.float32(threshold)
    low, high = cv2.subtract(mean, margin, dtype=cv2.CV_8U), cv2.add(mean, margin, dtype=cv2.CV_8U)
    return np.asarray(cv2.resize(low, size), dtype=np.uint8), np.asarray(cv2.resize(high, size), dtype=np.uint8)


def _peaks(
    level: Image,
    half: Image,
    scale: int,
    sloping: bool,
    threshold: float,
    most: int,
    finer: Image | None = None,
    finest: bool = False,
) -> list[_Peak]:
    """Find peaks of contrast at one scale, the strongest first.

    Args:
        level: image at this scale, (H, W).
        half: the same in half the size.
        scale: number of halvings.
        sloping: whether to fit a plane to the ring.
        threshold: least contrast, in standard deviations of the surroundings.
        most: most peaks.
        finer: image of twice the size in which targets of one or two pixels are searched too; None for none.
        finest: whether these are searched in this image instead.
    """
    mean, deviation = _ring(half, sloping)
    size = (level.shape[1], level.shape[0])
    blurred = cv2.boxFilter(level, -1, (INNER_PX, INNER_PX))
    searched = [(blurred, blurred, deviation)]  # darkest and brightest around each pixel, roughness of the surroundings
    if finer is not None or finest:
        rougher = deviation * np.float32(SMALLEST_TIMES) - np.float32((SMALLEST_TIMES - 1) * LEAST_ROUGHNESS)
        if finer is None:
            # Linear interpolation halfway between pixels is the mean of 2x2 px, at a third of boxFilter's time.
            dark = bright = cv2.getRectSubPix(level, size, (size[0] / 2 - 1, size[1] / 2 - 1))
        else:
            blurred, pair = cv2.boxFilter(finer, -1, (INNER_PX, INNER_PX)), np.ones((2, 2), np.uint8)
            dark, bright = (
                cv2.resize(of(blurred, pair), size, interpolation=cv2.INTER_NEAREST) for of in (cv2.erode, cv2.dilate)
            )
        searched.append((dark, bright, rougher))
    off = np.zeros(level.shape, np.uint8)
    for dark, bright, roughness in searched:
        low, high = _limits(mean, roughness, threshold, size)
        off = cv2.max(off, cv2.max(cv2.subtract(low, dark), cv2.subtract(bright, high)))
    mask = cv2.compare(off, 0, cv2.CMP_GT)
    peaks = []
    for contour in cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]:
        x, y, w, h = cv2.boundingRect(contour)
        if max(w, h) > 2 * GUARD_HALF_PX:  # it reaches into its own ring and is left to the next scale
            continue
        _, _, _, (i, j) = cv2.minMaxLoc(off[y : y + h, x : x + w])
        u, v = x + i, y + j
        at = (min(v // 2, half.shape[0] - 1), min(u // 2, half.shape[1] - 1))
        around = float(mean[at])
        signal = max(
            max(float(bright[v, u]) - around, around - float(dark[v, u])) / float(roughness[at])
            for dark, bright, roughness in searched
        )
        peaks.append(_Peak(u, v, scale, signal, around))
    peaks.sort(key=lambda peak: -peak.signal)
    return peaks[:most]


def _textured(texture: Image, half: Image, scale: int, threshold: float, most: int) -> list[_Peak]:
    """Find peaks of texture, as `_peaks` does, with the mean of the ring in the image of half the size."""
    coarse = cv2.resize(texture, half.shape[::-1], interpolation=cv2.INTER_AREA)
    peaks = _peaks(texture, coarse, scale, False, threshold, most)
    if not peaks:
        return []
    mean, _ = _ring(half, False)
    height, width = mean.shape
    return [replace(p, around=float(mean[min(p.v // 2, height - 1), min(p.u // 2, width - 1)])) for p in peaks]


def _ring(half: Image, sloping: bool) -> tuple[Array, Array]:
    """Mean of the ring around each pixel, and the standard deviation from that mean or from a fitted plane.

    Args:
        half: image of half the size.
        sloping: whether to fit a plane, for rings so large that a sky's gradient counts.
    """
    total = _box_sum(half, cv2.boxFilter)
    squares = _box_sum(half, cv2.sqrBoxFilter)
    count = np.float32(OUTER_HALF_PX**2 - GUARD_HALF_PX**2)
    mean = total / count
    variance = squares / count - mean * mean
    if not sloping:
        return mean, cv2.sqrt(np.maximum(variance, np.float32(LEAST_ROUGHNESS**2)))
    # The slope along each axis is the ring's first moment over its second moment along that axis.
    moment = np.float32((_axis_moment(OUTER_HALF_PX) - _axis_moment(GUARD_HALF_PX)) * count)
    for k in (0, 1):
        first = _first_moment(half, OUTER_HALF_PX, k)
        cv2.subtract(first, _first_moment(half, GUARD_HALF_PX, k), first)
        variance -= first * first / moment
    return mean, cv2.sqrt(np.maximum(variance, np.float32(LEAST_ROUGHNESS**2)))


def _box_sum(half: Image, box: Callable[..., Array]) -> Array:
    """Sum of the image, or of its squares, over the ring around each pixel."""
    total = box(half, cv2.CV_32F, (OUTER_HALF_PX,) * 2, normalize=False)
    return cv2.subtract(total, box(half, cv2.CV_32F, (GUARD_HALF_PX,) * 2, normalize=False), total)


def _axis_moment(side: int) -> float:
    """Sum over a square of the squared distance from its middle column."""
    return side * float(np.sum(np.square(np.arange(side) - side // 2)))


def _first_moment(half: Image, side: int, axis: int) -> Array:
    """Sum over a square of the image times the distance from its middle along an axis (0: columns)."""
    kernels = [np.ones(side, np.float32)] * 2
    kernels[axis] = np.arange(side, dtype=np.float32) - side // 2
    return np.asarray(cv2.sepFilter2D(half, cv2.CV_32F, kernels[0], kernels[1]))


def _outline(levels: Sequence[Image], peak: _Peak, large: bool, of_difference: bool) -> SmallTarget | None:
    """Find the box of a peak, in the image of a finer scale; None if its outline leaves the ring.

    Args:
        levels: image, (H, W), and its halvings.
        peak: the peak.
        large: whether faint parts belong to the target.
        of_difference: whether the target is brighter than its surroundings in all its parts, as in a difference.
    """
    scale, around = peak.scale, peak.around
    fine = max(0, scale - WINDOW_SCALES)
    image, factor, unit = levels[fine], 2 ** (scale - fine), 2**fine
    u, v = factor * peak.u + factor // 2, factor * peak.v + factor // 2
    reach = factor * GUARD_HALF_PX
    left, top = max(0, u - reach), max(0, v - reach)
    window = image[top : v + reach + 1, left : u + reach + 1].astype(np.float32) - np.float32(around)
    near = window[max(0, v - top - factor) : v - top + factor + 1, max(0, u - left - factor) : u - left + factor + 1]
    j, i = (int(n) for n in np.unravel_index(int(np.argmax(np.abs(near))), near.shape))
    contrast = float(near[j, i])
    at = max(0, v - top - factor) + j, max(0, u - left - factor) + i
    # An aeroplane has bright and dark parts.
    inside = window * np.sign(contrast) if of_difference else np.abs(window)
    x, y, w, h = _component(inside > OUTLINE * abs(contrast), at)
    if large and not of_difference:
        part = min(OUTLINE, max(FAINT / peak.signal, FAINTEST))
        X, Y, W, H = _component(np.abs(window - _slope(window)) > part * abs(contrast), at)
        if max(x - X, y - Y, X + W - x - w, Y + H - y - h) * unit > BLUR_PX + unit:
            x, y, w, h = X, Y, W, H
    bottom, right = window.shape
    across = (x == 0 and left > 0) or (x + w == right and left + right < image.shape[1])
    down = (y == 0 and top > 0) or (y + h == bottom and top + bottom < image.shape[0])
    if across or down:
        return None  # it goes on beyond its ring: a pole, or a target for the next scale
    return SmallTarget((unit * (left + x), unit * (top + y)), (unit * w, unit * h), contrast, peak.signal, around)


def _slope(window: np.ndarray) -> np.ndarray:
    """Estimate the surroundings' slope from the window's border, zero in the middle, (h, w)."""
    down, across = (
        (_median(last) - _median(first)) * np.linspace(-0.5, 0.5, n, dtype=np.float32)
        for first, last, n in (
            (window[0], window[-1], window.shape[0]),
            (window[:, 0], window[:, -1], window.shape[1]),
        )
    )
    return down[:, None] + across


def _median(values: np.ndarray) -> float:
    """Median of a few values, (n,), eight times as fast as np.median."""
    ordered, n = np.sort(values), len(values)
    return float(ordered[(n - 1) // 2] + ordered[n // 2]) / 2


def _component(inside: np.ndarray, at: tuple[int, int]) -> tuple[int, int, int, int]:
    """Find the box of the connected component at a pixel (row, column): left, top, width and height."""
    x, y, w, h = cv2.floodFill(inside.astype(np.uint8), None, at[::-1], (2,), flags=8)[3]
    return x, y, w, h


def share(one: SmallTarget, other: SmallTarget) -> bool:
    """Whether the boxes of two regions overlap."""
    return all(a < b + n and b < a + m for a, m, b, n in zip(one.low, one.size, other.low, other.size, strict=True))


# Least contrast, in standard deviations of the surroundings.
LEAST_SIGNAL = 4.5
# Most regions examined in a frame, the strongest first; bounds the computing time.
MOST_TARGETS = 40
# Change of things that stand, after each of AGES_S, not exceeded nine times in ten; measured on films of the collection
# that tests/detection/test_real_clips.py names, each seen through air and a codec.
STANDING_CHANGE = (0.05, 0.08, 0.15, 0.20)
# Added to a change before its logarithm is taken: smaller changes cannot be measured.
LEAST_CHANGE = 0.02
# The score is the logistic function of these times the logarithms of signal, change and texture beside the target, plus
# the last. They were fitted to 41 labelled films, with target and others taken as equally likely in every film.
Weights = tuple[float, float, float, float]
WEIGHTS: Weights = (2.57, 3.14, -1.44, -3.52)
# Largest signal that counts: a stronger one does not make up for a lack of change.
CLEAR_SIGNAL = 30.0
# Steepness of the score of a region of the difference.
SLOPE = 3.4
# Least score of a detection; a target that stays quiet for a moment is above it.
LEAST_SCORE = 0.02
# Score from which a region is more likely a target than not.
BELIEVED_SCORE = 0.5
# Change from which a region has arrived as a whole; for a sign with a bird flying in front of it, it is a tenth.
ARRIVED = 0.5
# A change since long ago counts at most e to this times as much as the most recent one: what has appeared and stands (a
# cloud uncovers the sun, a door opens) has changed once; a target goes on changing.
MOST_RISE = 1.5
# Least signal in the difference from all earlier images, and the signal with a score of 0.5. In the simulated field,
# swaying foliage is above the latter once in six frames, anywhere; a bird in front of it in nineteen of twenty.
LEAST_DIFFERENCE, EVEN_DIFFERENCE = 7.0, 12.0
# Fewest of the AGES_S for which there must be an image.
FEWEST_EARLIER = 3
# Shift of the camera between two images up to which they are subtracted as they are, and up to which after they are
# registered [px].
STANDING_PX, SHAKING_PX = 0.5, 5.0
# Usual difference, such as of a swaying branch, subtracted from the difference: its factor, the weight of the newest
# image that is kept in its mean, and the width over which it spreads [px].
USUAL_TIMES, USUAL_GAIN, SWAY_PX = 3.0, 0.02, 5
# Largest score of a clipped box, which may continue a track but not begin one: half of its surroundings are outside the
# image, so a swaying twig looks isolated.
MOST_CLIPPED_SCORE = 0.45
# Images are halved until they are at most this wide [px]; targets are outlined in full resolution. Small images are
# doubled while their larger side stays within it, at most twice: a bird of one pixel then fills more of the finest
# scale, INNER_PX.
WIDEST_PX, MOST_TIMES = 960, 4
# Least contrast in an image that was doubled twice and has more noise than LEAST_ROUGHNESS: its finest scale lies
# within one pixel of the camera, so the mean does not reduce the noise.
NOISY_SIGNAL = 5.5
# Least span of the history before anything is detected: at first, when it has an image of the shortest age; and after a
# cut, whose new scene must be seen for a while [s].
WARM_UP_S, AFTER_CUT_S = 0.09, AGES_S[1]


class SmallTargetDetector:
    """Detect small targets by contrast and change, each with a score."""

    def __init__(self, least_score: float = LEAST_SCORE, weights: Weights = WEIGHTS) -> None:
        """Start without history; ``least_score`` is that of a detection."""
        self._least_score, self._weights = least_score, weights
        self.camera = CameraMotion()
        self._history = History()
        self._warm_up_s = WARM_UP_S
        self._usual: Image | None = None  # mean difference from earlier images, float32
        self.shift: Array = np.zeros(2)  # of the camera since the first frame [px], (2,)
        self._shape: tuple[int, ...] | None = None
        self.repeated = False  # whether the last frame repeats the one before

    def detect(self, frame: Frame, held: Sequence["Track"] = ()) -> Detections:
        """Detect regions that stand out and change.

        A frame that repeats the last one gives no detections.

        Raises:
            CotargetError: the image's size changed.
        """
        return self.search(frame)[1]

    def search(self, frame: Frame) -> tuple[list[SmallTarget], Detections]:
        """Detect as `detect` does; also return the region of each box, in the enlarged image of a small one."""
        check_size(self._shape, frame.image)
        self._shape = frame.image.shape
        grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        finer: list[Image] = []
        while grey.shape[1] > WIDEST_PX:
            finer.append(grey)
            grey = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        unit = 2 ** len(finer)
        shift = self.camera.update(grey)  # measured without enlargement, in which soft scenes have no corners
        self.shift = unit * shift
        grey, times = (grey, 1) if finer else _enlarged(grey)
        shift = times * shift
        if self.camera.jumped:
            self._history.clear()
            self._warm_up_s = AFTER_CUT_S
        references = self._history.references(frame.t)
        self.repeated = not self._history.add(frame.t, grey, shift)
        if self.repeated or self._history.span < self._warm_up_s:
            return [], Detections([], functools.partial(_mask, [], frame.image.shape, times))
        self._warm_up_s = WARM_UP_S
        shape = tuple(times * side for side in frame.image.shape[:2])
        found: list[tuple[SmallTarget, Detection]] = []
        arrived: list[tuple[SmallTarget, Detection]] = []
        noisy = times == MOST_TIMES and self._history.noise > LEAST_ROUGHNESS
        for target in find_small_targets(grey, NOISY_SIGNAL if noisy else LEAST_SIGNAL, MOST_TARGETS, finer=finer):
            low = target.low[0] // unit, target.low[1] // unit
            size = -(-target.size[0] // unit), -(-target.size[1] // unit)
            since = changes(grey, low, size, target.around, shift, self._history.noise, references)
            target = replace(target, since=tuple(since))
            score = small_target_score(target.signal, since, target.beside, self._weights)
            detection = _boxed(target, score, shape, times)
            if detection.score >= self._least_score:
                found.append((target, detection))
            if detection.score >= BELIEVED_SCORE and np.nanmax(since) >= ARRIVED:
                arrived.append((target, detection))
        differing = self._differing(grey, unit, times, shift, references)
        found = _best_of(found + [_as_a_whole(pair, arrived) for pair in differing])
        boxes = [detection for _, detection in found]
        return [target for target, _ in found], Detections(
            boxes, functools.partial(_mask, found, frame.image.shape, times)
        )

    def _differing(
        self, grey: Image, unit: int, times: int, shift: Array, references: list[tuple[Image, Array] | None]
    ) -> list[tuple[SmallTarget, Detection]]:
        """Find regions in the difference from all earlier images, if there are enough and the camera hardly moved.

        The difference of an image enlarged by a factor ``times`` is halved: a twig sways over more of its pixels.
        """
        earlier = [kept for kept in references if kept is not None]
        if len(earlier) < FEWEST_EARLIER or any(np.abs(then - shift).max() > times * SHAKING_PX for _, then in earlier):
            self._usual = None
            return []
        registered = (
            picture if np.abs(shift - then).max() <= STANDING_PX else moved(picture, shift - then)
            for picture, then in earlier
        )
        difference = functools.reduce(cv2.min, (cv2.absdiff(grey, picture) for picture in registered))
        pixel = unit  # side of a pixel of the difference
        if times > 1:
            pixel = 2
            difference = cv2.resize(difference, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        if self._usual is None:
            self._usual = np.zeros(difference.shape, np.float32)
        usual = cv2.dilate(cv2.convertScaleAbs(self._usual, alpha=USUAL_TIMES), np.ones((SWAY_PX, SWAY_PX), np.uint8))
        if self._history.kept_last:  # not every frame of a fast camera: it would become usual sooner
            cv2.accumulateWeighted(difference, self._usual, USUAL_GAIN)
        unusual = cv2.subtract(difference, usual)
        # A sky is zero but for the target; its surroundings are needed as well.
        least = LEAST_DIFFERENCE * LEAST_ROUGHNESS
        there = cv2.threshold(cv2.blur(unusual, (INNER_PX,) * 2), least, 255, cv2.THRESH_BINARY)[1]
        left, top, width, height = cv2.boundingRect(there)
        if not width:
            return []
        left, top, right, bottom = (left - REACH_PX, top - REACH_PX, left + width + REACH_PX, top + height + REACH_PX)
        left, top = max(0, left) // ALIGNED_PX * ALIGNED_PX, max(0, top) // ALIGNED_PX * ALIGNED_PX
        found = []
        for target in find_small_targets(
            unusual[top:bottom, left:right],
            LEAST_DIFFERENCE,
            MOST_TARGETS,
            scales=SCALES_OF_DIFFERENCE,
            of_difference=True,
        ):
            if target.contrast <= 0:
                continue
            score = float(1 / (1 + (target.signal / EVEN_DIFFERENCE) ** -SLOPE))
            (x, y), (w, h) = target.low, target.size
            target = replace(
                target, low=(pixel * (left + x), pixel * (top + y)), size=(pixel * w, pixel * h), beside=math.inf
            )
            found.append((target, _boxed(target, score, (unit * grey.shape[0], unit * grey.shape[1]), times)))
        return found


def _enlarged(grey: Image) -> tuple[Image, int]:
    """Double an image while its larger side stays within WIDEST_PX; return it and its factor."""
    times = 1
    while times < MOST_TIMES and 2 * times * max(grey.shape) <= WIDEST_PX:
        times *= 2
    if times == 1:
        return grey, times
    enlarged = cv2.resize(grey, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC)
    return np.asarray(enlarged, dtype=np.uint8), times


def _mask(found: Sequence[tuple[SmallTarget, Detection]], shape: tuple[int, ...], times: int) -> Image:
    """Draw regions of an image enlarged by a factor ``times`` into one of a shape (H, W, 3), by their scores."""
    mask = np.zeros(shape[:2], np.uint8)
    for target, detection in reversed(found):
        (x, y), (w, h) = target.low, target.size
        rows, columns = slice(y // times, -(-(y + h) // times)), slice(x // times, -(-(x + w) // times))
        mask[rows, columns] = round(255 * detection.score)
    return mask


def _boxed(target: SmallTarget, score: float, shape: tuple[int, ...], times: int) -> Detection:
    """Make a detection of a region of an image of a shape (H, W), enlarged by a factor ``times``."""
    box = box_detection(*target.low, *target.size, score, shape)
    # Interpolation spreads the camera's last pixel over ``times`` pixels.
    if is_clipped(box.center_px, box.size_px + 2 * (times - 1), shape):
        box = replace(box, score=min(score, MOST_CLIPPED_SCORE), clipped=True)
    return replace(box, center_px=(box.center_px + 0.5) / times - 0.5, size_px=box.size_px / times)


def _as_a_whole(
    differing: tuple[SmallTarget, Detection], arrived: list[tuple[SmallTarget, Detection]]
) -> tuple[SmallTarget, Detection]:
    """Replace a region of the difference by the arrived region that contains it, if there is one.

    Of a plain target that moves by less than its own length within AGES_S[0], only the front differs; its contrast
    shows all of it. A standing thing behind a target differs as well, but has not arrived.
    """
    target, detection = differing
    around = [pair for pair in arrived if share(pair[0], target)]
    if len(around) != 1 or math.prod(around[0][0].size) <= math.prod(target.size):
        return differing
    whole, box = around[0]
    return whole, replace(box, score=max(box.score, detection.score))


def _best_of(found: list[tuple[SmallTarget, Detection]]) -> list[tuple[SmallTarget, Detection]]:
    """Keep the best of regions that overlap; the best first."""
    kept: list[tuple[SmallTarget, Detection]] = []
    for target, detection in sorted(found, key=lambda pair: -pair[1].score):
        if not any(share(target, other) for other, _ in kept):
            kept.append((target, detection))
    return kept


def small_target_score(signal: float, since: Sequence[float], beside: float, weights: Weights = WEIGHTS) -> float:
    """Probability that a region is a target and not a standing thing, 0 to 1.

    Args:
        signal: contrast in standard deviations of the surroundings.
        since: change since each of AGES_S, nan if unknown.
        beside: largest texture beside the region [grey levels].
        weights: of the logarithms of signal, change and texture, and the constant.
    """
    found = evidence(signal, since, beside)
    return 0.0 if found is None else 1 / (1 + math.exp(-float(np.dot(weights, (*found, 1.0)))))


def evidence(signal: float, since: Sequence[float], beside: float) -> tuple[float, float, float] | None:
    """Logarithms of signal, change and texture; None without any change. Arguments as for `small_target_score`."""
    ratios = [
        math.log((c + LEAST_CHANGE) / (usual + LEAST_CHANGE))
        for c, usual in zip(since, STANDING_CHANGE, strict=True)
        if not math.isnan(c)
    ]
    if not ratios:
        return None
    ratios = [min(ratio, ratios[0] + MOST_RISE) for ratio in ratios]
    return math.log(min(signal, CLEAR_SIGNAL)), sum(ratios) / len(ratios), math.log1p(beside)
