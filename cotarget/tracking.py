"""From detections in single frames to tracks with a number, a velocity, a size and an honest uncertainty.

Every track has its own motion filter; detections are assigned to tracks by the Hungarian method inside a
Mahalanobis gate.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from cotarget.geometry import Array
from cotarget.motionfilter import (
    Measurement,
    TargetFilter,
    Track,
    TrackerSettings,
    center_variance,
    missing,
    settings_for,
)

__all__ = ["Measurement", "Track", "Tracker", "TrackerSettings", "settings_for", "size_for"]

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
# A box that overlaps a track's by this much may be its target even outside the gate: it grew into something else.
OVERLAP_ENOUGH = 0.3
# What perfect overlap of the boxes is worth against the Mahalanobis distance squared.
OVERLAP_BONUS = 4.0
# A detection that covers this much of a track's predicted box explains that track, even where another has won it.
COVERED = 0.6


def size_for(track: Track, dimension: Literal["width", "height", "wingspan"]) -> float:
    """The size of a track [px] along the dimension whose true size is known."""
    if dimension == "wingspan":
        return track.larger_side_px
    return float(track.size_px[0 if dimension == "width" else 1])


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
        self._tracks: list[TargetFilter] = []
        self._next_id = 1
        self._t: float | None = None

    @property
    def tracks(self) -> list[Track]:
        """All tracks as of the last update; confirmed ones first, then by age."""
        return sorted((s.track() for s in self._tracks), key=lambda track: (not track.confirmed, track.id))

    def update(self, detections: Sequence[Measurement], t: float) -> list[Track]:
        """Take one frame's detections into account.

        Args:
            detections: what was found, best first.
            t: when the frame's light fell [s]. A frame that is not newer than the last one tells nothing and is
                ignored; a clock that jumped back by more than a track lives starts everything anew.

        Returns:
            All tracks at ``t``; confirmed ones first, then by age.
        """
        if self._t is not None and t <= self._t:
            if self._t - t <= self._settings.lose_s:
                return self.tracks
            self._tracks.clear()
        self._t = t
        for state in self._tracks:
            state.predict(t)
        matches: dict[int, int] = {}
        crowds: dict[int, int] = {}
        if len(self._tracks) == len(detections) == 1 and _overlap(self._tracks[0], detections[0]) > OVERLAP_ENOUGH:
            matches = {0: 0}  # whatever else speaks for it or against it: in a fifth of the time
        elif self._tracks and detections:
            pairs = _Pairs(self._tracks, detections)
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

    def _bear(self, detections: Sequence[Measurement], t: float) -> None:
        """Begin a track at each detection that does not cover one."""
        if not detections:
            return
        explained = (_Pairs(self._tracks, detections).covered > COVERED).any(axis=0)
        born: list[TargetFilter] = []
        for detection in (detections[int(j)] for j in np.flatnonzero(~explained)):
            if not (_Pairs(born, [detection]).covered > COVERED).any():
                born.append(TargetFilter(self._next_id, detection, t, self._settings, self._image_size))
                self._next_id += 1
        self._tracks += born


class _Pairs:
    """Every track beside every detection, (tracks, detections): a hundred of each are ten thousand pairs.

    Attributes:
        distance: squared, of place (Mahalanobis) and of size, in variances; a low score counts as distance too.
        log_volume: logarithm of the determinant of the innovation's covariance.
        covered: the part of the track's box that the detection covers, 0 to 1.
        overlap: intersection over union of the boxes, 0 to 1.
        confirmed: which tracks are.
    """

    def __init__(self, states: Sequence[TargetFilter], detections: Sequence[Measurement]) -> None:
        """Compare tracks and detections."""
        n, m = len(states), len(detections)
        self.confirmed = [state.confirmed for state in states]
        at = np.array([state.center for state in states]).reshape(n, 1, 2)
        size = np.array([state.size for state in states]).reshape(n, 1, 2)
        spread = np.array([state.place_variance for state in states]).reshape(n, 1, 2)
        center = np.array([detection.center_px for detection in detections]).reshape(1, m, 2)
        extent = np.array([detection.size_px for detection in detections]).reshape(1, m, 2)
        cut = np.array([detection.clipped for detection in detections], dtype=bool)  # its size says nothing
        if states:
            spread = spread + center_variance(states[0].settings, extent, cut[:, None], missing(size, extent))
        own, other = _area(size), _area(extent)
        resized = np.where(cut, 0.0, np.log(other / own) / 2 / SIZE_SIGMA)
        off = (center - at) ** 2 / spread
        self.distance: Array = off[..., 0] + off[..., 1] + resized**2
        score = np.array([min(max(detection.score, LEAST_SCORE), 0.5) for detection in detections])
        self.distance += 2 * np.log((1 - score) / score)
        self.log_volume: Array = np.log(_area(spread))
        low = np.maximum(at - size / 2, center - extent / 2)
        high = np.minimum(at + size / 2, center + extent / 2)
        shared = _area(np.maximum(0.0, high - low))
        self.covered: Array = shared / own
        self.overlap: Array = shared / (own + other - shared)


def _overlap(state: TargetFilter, detection: Measurement) -> float:
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
    # A box that grew into another still overlaps its track.
    possible = (pairs.distance <= GATE_CHI2) | (pairs.overlap > OVERLAP_ENOUGH)
    cost = np.where(possible, pairs.distance + pairs.log_volume - OVERLAP_BONUS * pairs.overlap, IMPOSSIBLE)
    matches: dict[int, int] = {}
    for confirmed in (True, False):
        group = [i for i, each in enumerate(pairs.confirmed) if each == confirmed]
        taken = set(matches.values())
        free = [j for j in range(cost.shape[1]) if j not in taken]
        if group and free:
            rows, columns = linear_sum_assignment(cost[group][:, free])
            found = ((group[i], free[j]) for i, j in zip(rows.tolist(), columns.tolist(), strict=True))
            matches |= {i: j for i, j in found if possible[i, j]}
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
