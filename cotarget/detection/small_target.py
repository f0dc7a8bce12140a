"""Small targets, moving or hovering: what stands out from its surroundings and changes, in a camera that may shake.

Movement alone cannot find a bird that hovers, and contrast alone finds every sign and chimney too. Here both must
come together, in one number: the contrast in standard deviations of the surroundings, times the part of it that
was not there before, in units of what the air, the codec and the camera's shake change of a thing that stands.

In front of foliage, or beside the edge of a roof, a bird does not stand out; but what it does to the picture stands
out from what the wind does there. So where the camera stands, the difference from all earlier pictures is searched for
specks as well: in the simulated field that finds the bird in 99 % of the frames in which its contrast finds half. Of a
plain bird that flies slowly it finds the front alone; where contrast finds the whole of it, that is the box.

How far the wide view has shifted since it was first looked at: shake, a nudge, a slow pan (ego-motion).

Whether what is at a place has changed, in the scene's own frame: a wing beats, a bird moves on; a sign does neither.

The place is compared with what was there some tenths of a second ago, shifted by what the camera did meanwhile. What
differs is stated as a part of the target's own contrast, so that it does not depend on the light.

Specks: what stands out from its own surroundings, at several scales, in one picture.

A speck's mean differs from the mean of the ring around it by several standard deviations of that ring. Foliage, waves
and roofs have a ring as rough as themselves; a pole or the edge of a cloud runs through its own ring (the constant
false alarm rate detector of radar, Rohling 1983, in two dimensions).
"""

import functools
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from cotarget.detection.base import Detection, box_detection, check_size
from cotarget.geometry import Array
from cotarget.rig import Frame, Image

# Corners are sought and followed in a picture of half the size; a whole one gives no better shift at twice the cost.
SCALE = 2
# How many corners are followed, how far apart they lie [px of the half picture], and how strong the weakest is beside
# the strongest.
CORNERS, APART_PX, WEAKEST = 60, 6, 0.02
# Least eigenvalue of a corner, as cv2.cornerMinEigenVal has it: noise of 5 grey levels makes as much. In a picture of
# nothing but sky the strongest corners are the target and what the codec leaves.
LEAST_CORNER = 3e-4
CORNER_BLOCK = 3
# With fewer corners than this the median is no measurement, and the camera is taken to stand.
FEWEST = 8
# When fewer than this part of many corners is found again, the film was cut or the camera was put elsewhere.
FOUND_AGAIN = 0.3
# Corners are sought anew after so many frames: some drift off, some were on a target.
RENEW_FRAMES = 15
# Window in which a corner is followed, and levels of its pyramid: up to 20 px a frame of the whole picture.
WINDOW_PX, LEVELS = (11, 11), 2
# Corners that disagree by more than this (median absolute deviation) show another scene, not a shift [px].
DISAGREEMENT_PX = 2.0


class CameraMotion:
    """Follows corners of the picture from frame to frame (Lucas and Kanade); their median is the camera's doing.

    Only the shift is estimated: the shake and the slow turns of a fixed camera hardly rotate its picture, and what
    is left is small beside a target.

    Attributes:
        jumped: whether the last frame was of another scene than the one before.
    """

    def __init__(self) -> None:
        """Begin at no shift."""
        self._last: Image | None = None
        self._corners: Image | None = None
        self._age = 0
        self._shift = np.zeros(2)
        self.jumped = False

    def update(self, grey: Image) -> Array:
        """Take the next frame into account.

        Args:
            grey: (H, W) picture.

        Returns:
            Where a point of the first frame's scene is now, less where it was then (du, dv) [px], (2,).
        """
        size = (max(1, grey.shape[1] // SCALE), max(1, grey.shape[0] // SCALE))
        half = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        if self._last is not None:
            self._shift = self._shift + SCALE * self._step(self._last, half)
        self._last = half
        return self._shift

    def _step(self, before: Image, after: Image) -> Array:
        """The shift between two frames [px of the half picture]."""
        self.jumped = False
        self._age += 1
        if self._corners is None or self._age >= RENEW_FRAMES or len(self._corners) < FEWEST:
            self._corners = _corners(before)
            self._age = 0
        if self._corners is None or len(self._corners) < FEWEST:
            return np.zeros(2)
        moved, found, _ = cv2.calcOpticalFlowPyrLK(
            before, after, self._corners, None, winSize=WINDOW_PX, maxLevel=LEVELS
        )
        kept = found.ravel() > 0
        flow = (moved - self._corners).reshape(-1, 2)[kept]
        shift = np.median(flow, axis=0) if len(flow) else np.zeros(2)
        if kept.mean() < FOUND_AGAIN or np.median(np.abs(flow - shift)) > DISAGREEMENT_PX / SCALE:
            self.jumped = True
            self._corners = None
            return np.zeros(2)
        self._corners = moved[kept]
        return np.asarray(shift, dtype=float)


def _corners(picture: Image) -> Image | None:
    """Corners that are no noise, (n, 1, 2); None where there is none."""
    corners = cv2.goodFeaturesToTrack(picture, CORNERS, WEAKEST, APART_PX, blockSize=CORNER_BLOCK)
    if corners is None:
        return None
    u, v = corners.reshape(-1, 2).astype(int).T
    return np.asarray(corners[cv2.cornerMinEigenVal(picture, CORNER_BLOCK)[v, u] >= LEAST_CORNER])


# --- change ---

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


# --- contrast ---

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
class SmallTarget:
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


def find_small_targets(grey: Image, threshold: float, most: int) -> list[SmallTarget]:
    """Find what stands out at any scale, what does so most first; each thing once.

    Args:
        grey: (H, W) picture.
        threshold: least contrast, in standard deviations of the surroundings.
        most: how many to look at, the best first; bounds the time that a hundred specks take.
    """
    found: list[SmallTarget] = []
    level = grey
    for scale in range(SCALES):
        if min(level.shape) < 2 * OUTER_HALF_PX:
            break
        half = cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        for u, v, signal, around in _peaks(level, half, scale >= SLOPING_SCALE, threshold, most):
            target = _outline(grey, (u, v), scale, signal, around)
            if target is not None:
                found.append(target)
        level = half
    found.sort(key=lambda target: -target.signal)
    kept: list[SmallTarget] = []
    for target in found:
        if not any(share(target, other) for other in kept):
            kept.append(target)
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


def _outline(grey: Image, peak: tuple[int, int], scale: int, signal: float, around: float) -> SmallTarget | None:
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
    return SmallTarget((left + x, top + y), (w, h), contrast, signal, around)


def share(one: SmallTarget, other: SmallTarget) -> bool:
    """Whether the boxes of two specks share a pixel."""
    return all(a < b + n and b < a + m for a, m, b, n in zip(one.low, one.size, other.low, other.size, strict=True))


# Least contrast, in standard deviations of the surroundings.
LEAST_SIGNAL = 4.5
# So many specks are looked at in a frame, those that stand out most first; it bounds the time of a frame.
MOST_TARGETS = 40
# What is found to have changed of things that stand, nine times in ten less, after each of AGES_S; measured on films of
# the collection that tests/detection/test_real_clips.py names, each seen through air and a codec.
STANDING_CHANGE = (0.05, 0.08, 0.15, 0.20)
# Added to a change before its logarithm is taken: less than this cannot be measured.
LEAST_CHANGE = 0.02
# A speck's score is the logistic function of SLOPE ln(signal x change / EVEN): 0.5 at EVEN. Both fitted to 13 labelled
# films of that collection, a target and something else taken to be equally likely.
SLOPE, EVEN = 3.4, 18.0
# A signal beyond this only says that there is something; it does not make up for a lack of change.
CLEAR_SIGNAL = 20.0
# Specks below this score are not worth telling; a target that stays quiet for a moment is above it.
LEAST_SCORE = 0.02
# From this score on a speck is more likely a target than not.
BELIEVED_SCORE = 0.5
# A speck of which so much was not there at one of AGES_S has come from elsewhere as a whole; of a sign before which a
# bird flies it is a tenth.
ARRIVED = 0.5
# A change since long ago counts at most e to this times as much as the one since a moment ago: what has appeared and
# stands (a cloud uncovers the sun, a door opens) has changed once; a target goes on changing.
MOST_RISE = 1.5
# Least signal of what differs from all earlier pictures, and the one at which its score is 0.5: on the simulated field,
# foliage that sways is above the latter once in six frames, anywhere; a bird before it in nineteen of twenty.
LEAST_DIFFERENCE, EVEN_DIFFERENCE = 7.0, 12.0
# From so many of the AGES_S there must be a picture.
FEWEST_EARLIER = 3
# Pictures are compared as they are where the camera shifted by less between them [px].
STANDING_PX = 0.5
# What usually differs nearby, because a branch sways there, is no news: so many times its mean, with this weight of the
# newest picture and over so many pixels, is taken from the difference.
USUAL_TIMES, USUAL_GAIN, SWAY_PX = 3.0, 0.02, 5
# What the border cuts has half of its surroundings outside, so that a swaying twig looks as if it stood alone: it may
# carry on a track, not begin one.
MOST_CLIPPED_SCORE = 0.45
# Nothing is told before the history goes back so far [s].
WARM_UP_S = AGES_S[1]


class SmallTargetDetector:
    """Finds small targets by contrast and change, and says how sure it is of each."""

    def __init__(self) -> None:
        """Begin with no history."""
        self._camera = CameraMotion()
        self._history = History()
        self._usual: Image | None = None  # float32: the mean of what differs from earlier pictures
        self._shape: tuple[int, ...] | None = None
        self.mask: Image | None = None

    def detect(self, frame: Frame) -> list[Detection]:
        """Find what stands out and changes, the surest first.

        A frame that repeats the last one tells nothing, and nothing is found in it.

        Raises:
            CotargetError: the image's size changed.
        """
        check_size(self._shape, frame.image)
        self._shape = frame.image.shape
        grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        shift = self._camera.update(grey)
        if self._camera.jumped:
            self._history.clear()
        references = self._history.references(frame.t)
        fresh = self._history.add(frame.t, grey, shift)
        self.mask = np.zeros(grey.shape, np.uint8)
        if not fresh or self._history.span < WARM_UP_S:
            return []
        found: list[tuple[SmallTarget, Detection]] = []
        arrived: list[tuple[SmallTarget, Detection]] = []
        for target in find_small_targets(grey, LEAST_SIGNAL, MOST_TARGETS):
            changes = [
                change(grey, target.low, target.size, target.around, shift, self._history.noise, before)
                if before is not None
                else np.nan
                for before in references
            ]
            detection = box_detection(*target.low, *target.size, small_target_score(target.signal, changes), grey.shape)
            if detection.clipped:
                detection = replace(detection, score=min(detection.score, MOST_CLIPPED_SCORE))
            if detection.score >= LEAST_SCORE:
                found.append((target, detection))
            if detection.score >= BELIEVED_SCORE and np.nanmax(changes) >= ARRIVED:
                arrived.append((target, detection))
        differing = self._differing(grey, shift, references)
        found = _best_of(found + [_as_a_whole(pair, arrived) for pair in differing])
        for target, detection in reversed(found):
            (x, y), (w, h) = target.low, target.size
            self.mask[y : y + h, x : x + w] = round(255 * detection.score)
        return [detection for _, detection in found]

    def _differing(
        self, grey: Image, shift: Array, references: list[tuple[Image, Array] | None]
    ) -> list[tuple[SmallTarget, Detection]]:
        """Specks in what differs from all earlier pictures, where there are enough of them and the camera stood."""
        earlier = [kept for kept in references if kept is not None]
        if len(earlier) < FEWEST_EARLIER or any(np.abs(then - shift).max() > STANDING_PX for _, then in earlier):
            self._usual = None
            return []
        difference = functools.reduce(cv2.min, (cv2.absdiff(grey, picture) for picture, _ in earlier))
        if self._usual is None:
            self._usual = np.zeros(grey.shape, np.float32)
        nearby = cv2.dilate(self._usual, np.ones((SWAY_PX, SWAY_PX), np.uint8))
        cv2.accumulateWeighted(difference, self._usual, USUAL_GAIN)
        unusual = cv2.subtract(difference, nearby * np.float32(USUAL_TIMES), dtype=cv2.CV_8U)
        found = []
        for target in find_small_targets(unusual, LEAST_DIFFERENCE, MOST_TARGETS):
            score = float(1 / (1 + (target.signal / EVEN_DIFFERENCE) ** -SLOPE)) if target.contrast > 0 else 0.0
            detection = box_detection(*target.low, *target.size, score, grey.shape)
            if detection.clipped:
                detection = replace(detection, score=min(score, MOST_CLIPPED_SCORE))
            if detection.score >= LEAST_SCORE:
                found.append((target, detection))
        return found


def _as_a_whole(
    differing: tuple[SmallTarget, Detection], arrived: list[tuple[SmallTarget, Detection]]
) -> tuple[SmallTarget, Detection]:
    """What differs from earlier pictures, with the box of the speck that has arrived there and that it is a part of.

    Of a plain target that moves by less than its own length within AGES_S[0] only the front differs. Its contrast shows
    all of it. A thing that stands behind a target differs, but has not arrived.
    """
    target, detection = differing
    around = [pair for pair in arrived if share(pair[0], target)]
    if len(around) != 1 or math.prod(around[0][0].size) <= math.prod(target.size):
        return differing
    whole, box = around[0]
    return whole, replace(box, score=max(box.score, detection.score))


def _best_of(found: list[tuple[SmallTarget, Detection]]) -> list[tuple[SmallTarget, Detection]]:
    """Of those that share a pixel the surest; the surest first."""
    kept: list[tuple[SmallTarget, Detection]] = []
    for target, detection in sorted(found, key=lambda pair: -pair[1].score):
        if not any(share(target, other) for other, _ in kept):
            kept.append((target, detection))
    return kept


def small_target_score(signal: float, changes: list[float]) -> float:
    """How sure it is that a speck is a target and not a thing that stands, 0 to 1.

    Args:
        signal: its contrast in standard deviations of its surroundings.
        changes: what has changed of it since each of AGES_S, nan where that is not known.
    """
    ratios = [
        np.log((c + LEAST_CHANGE) / (usual + LEAST_CHANGE))
        for c, usual in zip(changes, STANDING_CHANGE, strict=True)
        if np.isfinite(c)
    ]
    if not ratios:
        return 0.0
    ratios = [min(ratio, ratios[0] + MOST_RISE) for ratio in ratios]
    return float(1 / (1 + np.exp(-SLOPE * (np.log(min(signal, CLEAR_SIGNAL) / EVEN) + np.mean(ratios)))))
