"""Detect what moves or stands out, from 3 px to half the image's width, of any kind.

Two parts search each image. `SmallTargetFinder` finds by contrast and change, and outlines what stands before a
plain background to the pixel. `LargeTargetFinder`, on an image of reduced size, finds large targets of many colours,
such as people, as a whole. `fuse` makes one list of both.

The score of a small target falls where something like it is seen most of the time: a twig, a swinging tape. The
background is not learnt where the tracker follows a target, so a target that stops is found for HELD_S. Measurements:
docs/design-notes.md.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.detection.background import WIDE, WIDEST_PX, LargeTargetFinder
from cotarget.detection.base import LASTING_S, QUIET_PART, Detections, SizeCheck, Tracks, halvings
from cotarget.detection.exposure import Exposure
from cotarget.detection.small_target import WEIGHTS, SmallTarget, SmallTargetFinder, Weights
from cotarget.geometry import Array, intersection_areas
from cotarget.rig import Detection, Frame, Image

# In parts of the image's width: most that a camera shakes, more is a pan; and shift at which the background is learnt
# again, because too much of it is out of view.
SHAKE_PART, VIEW_PART = 3 / 640, 0.1
# Targets and tracks are alike if their larger sides differ by less than this factor. A small target that one follows
# is no part of a large one whose area is larger by more than the square, but a bird before a cloud.
SIDE_RATIO = 2.0
# Time for which the background under a confirmed track is not learnt, from when the track last moved by its size [s].
HELD_S = 60.0
# Margin around what is held: in parts of its size, and in parts of the image's width.
HELD_MARGIN, HELD_PART = 0.2, 2 / 640
# Logarithm of width over height: standard deviation of targets about the expected one, as persons who walk have, and of
# anything about a square; and part of the targets that may have any shape, such as a person who lies.
SHAPE_SIGMA, OTHER_SIGMA, OTHER_PART = 0.5, 1.0, 0.2
# Clutter: number of cells along the image's width, memory [s], and what halves a target's odds: the usual score at its
# place, and the sum of the scores of others of its size, as of raindrops.
CELLS, CLUTTER_S, CLUTTER_EVEN, CROWD_EVEN = 80, 10.0, 0.03, 3.0


class AutoDetector:
    """Detect small targets by contrast and change, and large ones by a background model."""

    def __init__(
        self,
        rate_hz: float,
        weights: Weights = WEIGHTS,
        shape: float | None = None,
        *,
        least_part: float = 0.0,
        background: bool = True,
    ) -> None:
        """Start without history and background.

        Args:
            rate_hz: nominal frame rate [Hz].
            weights: of the score of small targets, see `cotarget.detection.small_target.score`.
            shape: expected width over height of the target's box; None if it is unknown.
            least_part: least larger side of a target, in parts of the image's width.
            background: whether to find large targets by a background model, and not only before a plain background.
        """
        self._shape, self._least_part, self._with_background = shape, least_part, background
        self._small_finder = SmallTargetFinder(weights)
        self._large_finder = LargeTargetFinder(rate_hz, upright=shape is not None and shape < WIDE)
        self._size = SizeCheck()
        self._clutter = Clutter()
        self._exposure = Exposure()
        self._apart: list[Detection] = []  # small targets that are no part of a large one, best first
        self._large: Detections | None = None  # large targets, found last
        self._begun = np.zeros(2)  # the camera's shift when the background was begun [px]
        self._shifts: deque[tuple[float, Array]] = deque()  # the camera's shift in the last frames [px]
        self._moved: dict[int, tuple[float, Array]] = {}  # when a track last moved by its size, and where to
        self._tracks: Tracks = ()  # confirmed tracks
        self._held: list[tuple[Array, Array]] = []  # centre and size of each place whose background is not learnt

    def detect(self, frame: Frame, held: Tracks = ()) -> Detections:
        """Detect the targets; none in a frame that repeats the last one.

        Raises:
            CotargetError: the image's size changed.
        """
        self._size.check(frame.image)
        width = frame.image.shape[1]
        images = halvings(frame.image, WIDEST_PX)
        # On the last but one, which is 480 to 960 px wide; the whole image takes up to a quarter of the detection.
        exposure = self._exposure.measure(images[max(len(images) - 2, 0)], frame.t)
        self._hold(held, width)
        targets, contrast = self._small_finder.find(frame, exposure)
        shift_px = self._register(frame.t, width)
        boxes: list[Detection] = []
        if not self._small_finder.repeated:  # a repeated frame says nothing of where targets usually are
            boxes = self._boxes(frame, images, exposure, targets, contrast.boxes, shift_px)
        make_mask = contrast.make_mask
        if shift_px is not None and self._large is not None:
            make_mask = partial(_mask, self._large, self._apart)
        return Detections(boxes, make_mask, self._small_finder.shift, self._small_finder.camera.jumped)

    def _boxes(
        self,
        frame: Frame,
        images: Sequence[Image],
        exposure: float,
        targets: Sequence[SmallTarget],
        boxes: Sequence[Detection],
        shift_px: Array | None,
    ) -> list[Detection]:
        """Weigh the small targets of a frame, and add the large ones if the background's shift is given, best first."""
        width = frame.image.shape[1]
        found = small = self._clutter.weigh(boxes, frame.t, width, self._held)
        like = partial(likeness, shape=self._shape)
        if shift_px is not None and self._with_background:
            self._large = self._large_finder.find(frame, self._held, shift_px, exposure, images)
            outlined = [target.whole for target in targets]
            followed = self._are_followed(small, frame.t, width)
            found = fuse(small, outlined, followed, self._large.boxes, like)
        found = [each for each in found if each.size_px.max() >= self._least_part * width]
        self._apart = [each for each in found if any(each is one for one in small)]
        weighed = [replace(each, score=like(each) * each.score) for each in found]
        return sorted(weighed, key=lambda each: -each.score)

    def _register(self, t: float, width: int) -> Array | None:
        """Return the shift since the background was begun (2,) [px]; None unless the camera has stood for LASTING_S."""
        shift = self._small_finder.shift
        self._shifts.append((t, shift))
        while not 0 <= t - self._shifts[0][0] <= LASTING_S:
            self._shifts.popleft()
        off = shift - self._begun
        if self._small_finder.camera.jumped or np.abs(off).max() > VIEW_PART * width:
            self._begun, off = shift, np.zeros(2)
            self._large_finder.forget()
            self._clutter.forget()
        off = off if np.abs(off).max() > QUIET_PART * width else np.zeros(2)
        steady = all(np.abs(shift - before).max() <= SHAKE_PART * width for _, before in self._shifts)
        return off if steady else None

    def _are_followed(self, small: Sequence[Detection], t: float, width: int) -> list[bool]:
        """Whether a confirmed track of its size, predicted at time ``t`` [s], follows each small target."""
        margin = 2 * HELD_PART * width
        places = [
            (track.center_px + (t - track.t) * track.velocity_px, track.size_px + margin) for track in self._tracks
        ]
        near = _within(small, places)
        return list(np.any(near & _alike(small, self._tracks), axis=1).tolist())

    def _hold(self, tracks: Tracks, width: int) -> None:
        """Do not learn the background under the confirmed ones of the last image's tracks."""
        margin = HELD_PART * width
        moved: dict[int, tuple[float, Array]] = {}
        self._held = []
        self._tracks = [track for track in tracks if track.confirmed]
        for track in self._tracks:
            since, place = self._moved.get(track.id, (track.t, track.center_px))
            if np.abs(track.center_px - place).max() > track.size_px.max() + margin:
                since, place = track.t, track.center_px
            moved[track.id] = since, place
            if track.t - since <= HELD_S:
                self._held.append((track.center_px, (1 + 2 * HELD_MARGIN) * track.size_px + 2 * margin))
        self._moved = moved


def _mask(background: Detections, apart: Sequence[Detection]) -> Image:
    """Give the foreground of the background model, and boxes of small targets elsewhere by their score."""
    large = np.asarray(background.mask)
    boxes = np.zeros_like(large)
    for each in reversed(apart):
        first = np.rint(each.center_px - (each.size_px - 1) / 2).astype(int)
        last = np.rint(each.center_px + (each.size_px - 1) / 2).astype(int)
        cv2.rectangle(boxes, first.tolist(), last.tolist(), round(255 * each.score), cv2.FILLED)
    return np.asarray(cv2.max(boxes, large), dtype=np.uint8)


def _alike(some: Sequence[Detection], others: Sequence[Detection] | Tracks) -> npt.NDArray[np.bool_]:
    """Whether the larger sides of each pair differ by less than SIDE_RATIO, (some, others)."""
    sides = [np.log([each.size_px.max() for each in group]) for group in (some, others)]
    return np.asarray(np.abs(np.subtract.outer(*sides)) < np.log(SIDE_RATIO))


class Clutter:
    """Mean score of small targets at each place, as a clutter map of radar: high where a twig sways."""

    def __init__(self) -> None:
        """Start without memory."""
        self._usual: Array | None = None
        self._t = 0.0

    def forget(self) -> None:
        """Drop what was learnt, after the camera has moved."""
        self._usual = None

    def weigh(
        self, found: Sequence[Detection], t: float, width: int, held: Sequence[tuple[Array, Array]]
    ) -> list[Detection]:
        """Lower the scores of targets where one usually is, or many are alike, and remember this image.

        Args:
            found: small targets.
            t: time of the image [s].
            width: width of the image [px].
            held: centre and size of places that are no clutter, because a track is followed there [px].

        Returns:
            The targets, in their order.
        """
        if self._usual is None:
            self._usual, self._t = np.zeros((2 * CELLS, CELLS)), t
        is_free = ~np.any(_within(found, held), axis=1)
        scores = is_free * [each.score for each in found]
        crowds = _alike(found, found) @ scores - scores
        places = np.reshape([each.center_px for each in found], (-1, 2)) * CELLS / width
        u, v = np.clip(places, 0, (CELLS - 1, 2 * CELLS - 1)).astype(int).T
        even = scores / (1 + self._usual[v, u] / CLUTTER_EVEN + crowds / CROWD_EVEN)
        now = np.zeros_like(self._usual)
        np.maximum.at(now, (v, u), scores)
        cv2.accumulateWeighted(cv2.dilate(now, None), self._usual, np.clip((t - self._t) / CLUTTER_S, 0.0, 1.0))
        self._t = t
        lowered = (even / (even + 1 - scores)).tolist()
        return [
            replace(each, score=score) if free else each
            for each, score, free in zip(found, lowered, is_free.tolist(), strict=True)
        ]


def fuse(
    small: Sequence[Detection],
    outlined: Sequence[bool],
    followed: Sequence[bool],
    large: Sequence[Detection],
    like: Callable[[Detection], float],
) -> list[Detection]:
    """Make one list of small and large targets, best first.

    A large target is not listed where contrast outlines it better: before a plain background, or much larger, as an
    aeroplane whose front alone has changed; but not where that is less like the target, as a person with a shadow is.
    Otherwise the small targets in a large one, such as head and shoes, are parts of it, unless a track has followed one
    of them for itself.

    Args:
        small: targets found by contrast.
        outlined: whether each of these stands before a plain background.
        followed: whether a confirmed track of its size follows it.
        large: targets found by the background model.
        like: how like the target a box is.
    """
    found = list(small)
    for whole in large:
        same = [
            (each, plain)
            for each, plain in zip(small, outlined, strict=True)
            if _mostly_covered(whole, each) and like(each) >= like(whole)
        ]
        if any(plain or not _mostly_covered(each, whole) for each, plain in same):
            continue
        inside = [each for each, plain in zip(small, outlined, strict=True) if plain and _mostly_covered(each, whole)]
        if any(SIDE_RATIO**2 * each.size_px.prod() > whole.size_px.prod() for each in inside):
            continue  # the rest of it is the place that the target has left
        parts = [
            each
            for each, own in zip(small, followed, strict=True)
            if (_mostly_covered(each, whole) or _mostly_covered(whole, each))
            and not (own and SIDE_RATIO**2 * each.size_px.prod() < whole.size_px.prod())
        ]
        found = [each for each in found if not any(each is part for part in parts)]
        found.append(replace(whole, score=max([whole.score, *(part.score for part in parts)])))
    return sorted(found, key=lambda each: -each.score)


def likeness(found: Detection, shape: float | None) -> float:
    """Likelihood ratio of a detection's shape for the target, at most 1; 1 if either is not known.

    Args:
        found: the detection.
        shape: expected width over height of a target's box.
    """
    if shape is None or found.clipped:
        return 1.0
    observed = math.log(found.size_px[0] / found.size_px[1])
    of_target = _normal(observed - math.log(shape), SHAPE_SIGMA) / _normal(observed, OTHER_SIGMA)
    return min(1.0, OTHER_PART + (1 - OTHER_PART) * of_target)


def _normal(off: float, sigma: float) -> float:
    """Density of a normal distribution, up to a constant factor."""
    return math.exp(-((off / sigma) ** 2) / 2) / sigma


def _within(found: Sequence[Detection], places: Sequence[tuple[Array, Array]]) -> npt.NDArray[np.bool_]:
    """Whether the centre of each target is in each place, given by centre and size [px], (n, m)."""
    at = np.reshape([each.center_px for each in found], (-1, 1, 2))
    center, size = (np.reshape([place[i] for place in places], (-1, 2)) for i in (0, 1))
    return np.asarray((np.abs(at - center) < size / 2).all(axis=2))


def _mostly_covered(one: Detection, other: Detection) -> bool:
    """Whether another detection covers more than half of one's box."""
    shared = intersection_areas(one.center_px[None], one.size_px[None], other.center_px[None], other.size_px[None])
    return bool(2 * shared[0, 0] > one.size_px.prod())
