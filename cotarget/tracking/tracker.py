"""From detections in single frames to tracks with a number, a velocity, a size and an honest uncertainty.

Every track has its own motion filter; detections are assigned to tracks by the Hungarian method inside a
Mahalanobis gate.
"""

import math
import statistics
from collections import deque
from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from cotarget.geometry import Array
from cotarget.tracking.track import (
    CUT,
    ImageFilter,
    Measurement,
    Track,
    TrackerSettings,
    center_variance,
    missing,
    settings_for,
)

__all__ = ["Measurement", "Track", "Tracker", "TrackerSettings", "settings_for"]
# A cost that no assignment inside the gate reaches, so that it marks pairs that must not be matched.
IMPOSSIBLE = 1e6
# 99.9 % of a chi-square with three degrees of freedom, two of place and one of size: of true detections one in a
# thousand is turned away.
GATE_CHI2 = 16.3
# Wings, limbs and what hides a part make a box half as large or twice as large as before, one standard deviation of the
# logarithm of its side. A twig that is seen a little later where a bird has gone behind a tree is smaller still.
SIZE_SIGMA = 0.5
# What is more likely something else than a target is believed less: that likelihood ratio counts, down to this score.
LEAST_SCORE = 0.01
# Objects that turn up anew somewhere in the image [1/s]: on real films of birds and of a dozen people up to 4. What
# turns up while a track misses its target must more likely be this target than one of them, as after 0.8 s a gate of
# four standard deviations reaches over 250 px. With 1 and more, tracks on these films jump to nobody else by more than
# 100 px; with 8 and more, a bird that turns while it is hidden is not found again. These films have 640x512 pixels; a
# smaller image has no more of them on each pixel.
NEWCOMERS_HZ, LEAST_AREA_PX = 2.0, 640 * 512
# A box that overlaps a track's by this much may be its target even outside the gate: it grew into something else.
OVERLAP_ENOUGH = 0.3
# What perfect overlap of the boxes is worth against the Mahalanobis distance squared.
OVERLAP_BONUS = 4.0
# A detection that covers this much of a track's predicted box explains that track, even where another has won it.
COVERED = 0.6
# Of more detections in a frame than these the rest is left out: snow, rain or flicker must not hold up the next frame.
# Real films of birds and of a dozen people have up to 10.
MOST_DETECTIONS = 100
# The usual time between frames is the median of so many; before a second frame has come it is taken for this [s].
INTERVALS, FIRST_INTERVAL_S = 5, 1.0


class Tracker:
    """Turns each frame's detections into tracks; numbers are never reused."""

    def __init__(self, settings: TrackerSettings | None = None, image_size: tuple[int, int] | None = None) -> None:
        """Begin with no tracks.

        Args:
            settings: how tracks are born, moved and dropped.
            image_size: (width, height) [px]; with it a track ends when it leaves the image.
        """
        self._settings = settings or TrackerSettings()
        self._image_size = image_size
        self._tracks: list[ImageFilter] = []
        self._next_id = 1
        self._t: float | None = None
        self._intervals = deque([FIRST_INTERVAL_S], INTERVALS)

    @property
    def tracks(self) -> list[Track]:
        """All tracks as of the last update; confirmed ones first, then by age."""
        return sorted((s.track() for s in self._tracks), key=lambda track: (not track.confirmed, track.id))

    def update(self, detections: Sequence[Measurement], t: float) -> list[Track]:
        """Take one frame's detections into account.

        Args:
            detections: what was found, best first. Of more than MOST_DETECTIONS those next to confirmed tracks are
                taken, then the best.
            t: when the frame's light fell [s]. A frame that is not newer than the last one tells nothing and is
                ignored; a clock that jumped back by more than a track lives starts everything anew.

        Returns:
            All tracks at ``t``; confirmed ones first, then by age.
        """
        if self._t is not None and t <= self._t:
            if self._t - t <= self._settings.lose_s:
                return self.tracks
            self._tracks.clear()
        self._begin(t)
        detections = self._worth(detections)
        matches: dict[int, int] = {}
        crowds: dict[int, int] = {}
        if len(self._tracks) == len(detections) == 1:
            if _belongs(self._tracks[0], detections[0], self._image_size):
                matches = {0: 0}
        elif self._tracks and detections:
            pairs = _Pairs(self._tracks, detections, self._image_size)
            matches = _assign(pairs)
            crowds = _crowds(pairs, matches)
        taken = set(matches.values())
        for i, state in enumerate(self._tracks):
            if i in crowds:
                state.share(detections[crowds[i]])
            elif i in matches:
                state.correct(detections[matches[i]])
            else:
                state.missed += 1
        self._tracks = [s for s in self._tracks if not s.is_over(self._image_size)]
        self._bear([detection for j, detection in enumerate(detections) if j not in taken], t)
        return self.tracks

    def _begin(self, t: float) -> None:
        """Move all tracks to a new frame's time, but for those that a gap between frames has outlived.

        The room in which a target is looked for grows with the gap, until whatever appears would be taken for it. The
        usual time between frames is no such gap, even where a track lives no longer.
        """
        usual = statistics.median(self._intervals)
        self._tracks = [state for state in self._tracks if t - state.seen <= state.patience_s + usual]
        for state in self._tracks:
            state.predict(t)
        if self._t is not None and t > self._t:
            self._intervals.append(t - self._t)
        self._t = t

    def _worth(self, detections: Sequence[Measurement]) -> Sequence[Measurement]:
        """The detections to be taken, in their order: no more than MOST_DETECTIONS."""
        if len(detections) <= MOST_DETECTIONS:
            return detections
        distance = np.full(len(detections), np.inf)
        confirmed = [state for state in self._tracks if state.confirmed]
        if confirmed:
            pairs = _Pairs(confirmed, detections, self._image_size)
            distance = np.where(pairs.possible | (pairs.covered > COVERED), pairs.distance, np.inf).min(axis=0)
        return [detections[j] for j in sorted(np.argsort(distance, kind="stable")[:MOST_DETECTIONS].tolist())]

    def _bear(self, detections: Sequence[Measurement], t: float) -> None:
        """Begin a track at each detection that does not cover one."""
        if not detections:
            return
        at, size = _boxes_of(self._tracks)
        center, extent = _boxes(detections)
        free = np.all(_shared(at, size, center, extent) <= COVERED * _area(size)[:, None], axis=0)
        covers = _shared(center, extent, center, extent) > COVERED * _area(extent)[:, None]
        for j, detection in enumerate(detections):
            if free[j]:  # whoever covers what is born here is no other
                free &= ~covers[j]
                self._tracks.append(ImageFilter(self._next_id, detection, t, self._settings, self._image_size))
                self._next_id += 1


class _Pairs:
    """Every track beside every detection, (tracks, detections): a hundred of each are ten thousand pairs.

    Attributes:
        distance: squared, of place (Mahalanobis) and of size, in variances; a low score counts as distance too.
        log_volume: logarithm of the determinant of the innovation's covariance.
        covered: the part of the track's box that the detection covers, 0 to 1.
        overlap: intersection over union of the boxes, 0 to 1.
        confirmed: which tracks are.
        possible: which detections may be of which track.
    """

    def __init__(
        self,
        states: Sequence[ImageFilter],
        detections: Sequence[Measurement],
        image_size: tuple[int, int] | None,
    ) -> None:
        """Compare tracks and detections, some of each; without the image's (width, height) [px] none is a newcomer."""
        self.confirmed = [state.confirmed for state in states]
        (at, size), (center, extent) = _boxes_of(states), _boxes(detections)
        spread = np.array([state.place_variance for state in states])[:, None]
        cut = np.array([detection.clipped for detection in detections], dtype=bool)
        lacks = missing(size[:, None], extent)
        settings = states[0].settings
        spread = spread + center_variance(settings, extent, np.where(cut, CUT, settings.noise_of_size)[:, None], lacks)
        own, other = _area(size)[:, None], _area(extent)
        resized = np.log(other / own) / 2 / SIZE_SIGMA
        # Of what the border cuts there is more, and of a target that it cut nobody knows how much more.
        known = np.array([[not state.detection.clipped] for state in states])
        resized = np.where(cut, np.where(known, np.maximum(resized, 0.0), 0.0), resized)
        off = (center - at[:, None]) ** 2 / spread
        self.distance: Array = off[..., 0] + off[..., 1] + resized**2
        score = np.array([min(max(detection.score, LEAST_SCORE), 0.5) for detection in detections])
        self.distance += 2 * np.log((1 - score) / score)
        self.log_volume: Array = np.log(_area(spread))
        shared = _shared(at, size, center, extent)
        self.covered: Array = shared / own
        self.overlap: Array = shared / (own + other - shared)
        # A box that grew into another still overlaps its track.
        near = (self.distance <= GATE_CHI2) & (self.distance + self.log_volume <= _least_likely(states, image_size))
        self.possible = near | (self.overlap > OVERLAP_ENOUGH)


def _least_likely(states: Sequence[ImageFilter], image_size: tuple[int, int] | None) -> Array:
    """The distance and logarithm of volume beyond which a detection is more likely a newcomer, (tracks, 1).

    One that was hidden for so long comes back at a rate of about one in as long again, with the density of a normal
    distribution; newcomers come anywhere. Of a target that the last frame had no such question is asked.
    """
    limits = np.full((len(states), 1), np.inf)
    if image_size is not None:
        density = NEWCOMERS_HZ / max(math.prod(image_size), LEAST_AREA_PX)
        for i, state in enumerate(states):
            if state.missed:
                limits[i] = -2 * math.log(2 * math.pi * density * (state.t - state.seen))
    return limits


def _boxes_of(states: Sequence[ImageFilter]) -> tuple[Array, Array]:
    """Middles and sizes of tracks [px], (n, 2) each."""
    at, size = [state.center for state in states], [state.size for state in states]
    return np.array(at).reshape(-1, 2), np.array(size).reshape(-1, 2)


def _boxes(detections: Sequence[Measurement]) -> tuple[Array, Array]:
    """Those of detections."""
    center, size = [each.center_px for each in detections], [each.size_px for each in detections]
    return np.array(center).reshape(-1, 2), np.array(size).reshape(-1, 2)


def _shared(at: Array, size: Array, center: Array, extent: Array) -> Array:
    """Area that n boxes share with m others [px^2], (n, m); middles and sizes are (n, 2) and (m, 2)."""
    low = np.maximum((at - size / 2)[:, None], center - extent / 2)
    high = np.minimum((at + size / 2)[:, None], center + extent / 2)
    return _area(np.maximum(0.0, high - low))


def _belongs(state: ImageFilter, detection: Measurement, image_size: tuple[int, int] | None) -> bool:
    """Whether a lone detection may be of a lone track, as `_Pairs` says it: mostly in a fifth of the time.

    Where the boxes overlap enough, nothing that speaks against it counts.
    """
    if _overlap(state, detection) > OVERLAP_ENOUGH:
        return True
    return bool(_Pairs([state], [detection], image_size).possible[0, 0])


def _overlap(state: ImageFilter, detection: Measurement) -> float:
    """Intersection over union of a track's predicted box and a detection's, 0 to 1."""
    shared = own = other = 1.0
    boxes = state.center, state.size.tolist(), detection.center_px.tolist(), detection.size_px.tolist()
    for at, side, center, extent in zip(*boxes, strict=True):
        low, high = max(at - side / 2, center - extent / 2), min(at + side / 2, center + extent / 2)
        shared, own, other = shared * max(0.0, high - low), own * side, other * extent
    return shared / (own + other - shared)


def _area(sides: Array) -> Array:
    """Product of the last axis's two, (..., 2) to (...)."""
    return np.asarray(sides[..., 0] * sides[..., 1])


def _assign(pairs: _Pairs) -> dict[int, int]:
    """Match tracks to detections one to one: {index of the track: index of the detection}.

    Confirmed tracks choose first: one that coasts knows badly where its target is, and a new track that was begun there
    meanwhile knows it well, yet it is the old target that was found again.
    """
    cost = np.where(pairs.possible, pairs.distance + pairs.log_volume - OVERLAP_BONUS * pairs.overlap, IMPOSSIBLE)
    matches: dict[int, int] = {}
    for confirmed in (True, False):
        group = [i for i, each in enumerate(pairs.confirmed) if each == confirmed]
        taken = set(matches.values())
        free = [j for j in range(cost.shape[1]) if j not in taken]
        if group and free:
            rows, columns = linear_sum_assignment(cost[group][:, free])
            found = ((group[i], free[j]) for i, j in zip(rows.tolist(), columns.tolist(), strict=True))
            matches |= {i: j for i, j in found if pairs.possible[i, j]}
    return matches


def _crowds(pairs: _Pairs, matches: dict[int, int]) -> dict[int, int]:
    """Find detections that cover two or more confirmed tracks: {index of such a track: the detection}."""
    crowds: dict[int, int] = {}
    if sum(pairs.confirmed) < 2:
        return crowds
    inside = (pairs.covered > COVERED) & np.array(pairs.confirmed)[:, None]
    for j in np.flatnonzero(np.count_nonzero(inside, axis=0) > 1):
        covered = [int(i) for i in np.flatnonzero(inside[:, j]) if matches.get(int(i), j) == j]
        if len(covered) > 1:
            crowds |= dict.fromkeys(covered, int(j))
    return crowds
