"""From detections in single frames to tracks with a number, a velocity, a size and an honest uncertainty.

Every track has its own motion filter; detections are assigned to tracks by the Hungarian method inside a
Mahalanobis gate.
"""

from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from cotarget.motionfilter import Box, Measurement, TargetFilter, Track, TrackerSettings, settings_for

__all__ = ["FirstCome", "Measurement", "Track", "Tracker", "TrackerSettings", "settings_for", "size_for"]

# A cost that no assignment inside the gate reaches, so that it marks pairs that must not be matched.
IMPOSSIBLE = 1e6
# 99.9 % of a chi-square with two degrees of freedom: one true detection in a thousand is turned away.
GATE_CHI2 = 13.8
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


class FirstCome:
    """The paper's policy: follow the first confirmed target until it disappears, then the next."""

    def __init__(self) -> None:
        self._id: int | None = None

    def select(self, tracks: Iterable[Track]) -> Track | None:
        """Choose the track to follow, or None when none is confirmed."""
        confirmed = {track.id: track for track in tracks if track.confirmed}
        if self._id not in confirmed:
            self._id = min(confirmed, default=None)
        return None if self._id is None else confirmed[self._id]


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
        matches = _assign(self._tracks, detections)
        crowds = _crowds(self._tracks, detections, matches)
        taken = set(matches.values())
        for i, state in enumerate(self._tracks):
            if i in crowds:
                state.share(detections[crowds[i]])
            elif i in matches:
                state.correct(detections[matches[i]])
            else:
                state.missed += 1
        self._tracks = [s for s in self._tracks if not s.is_over(self._image_size)]
        for j, detection in enumerate(detections):
            if j not in taken and not any(_covered(s.box, detection) > COVERED for s in self._tracks):
                self._tracks.append(TargetFilter(self._next_id, detection, t, self._settings))
                self._next_id += 1
        return self.tracks


def _assign(states: Sequence[TargetFilter], detections: Sequence[Measurement]) -> dict[int, int]:
    """Match tracks to detections one to one: {index of the track: index of the detection}."""
    if not states or not detections:
        return {}
    cost = np.full((len(states), len(detections)), IMPOSSIBLE)
    for i, state in enumerate(states):
        for j, detection in enumerate(detections):
            S = state.P[:2, :2] + np.diag(state.variance(detection))
            error = detection.center_px - state.x[:2]
            distance = float(error @ np.linalg.solve(S, error))
            overlap = _overlap(state.box, detection)
            # A track that was confirmed goes first, and a box that grew into another still overlaps its track.
            if distance <= GATE_CHI2 or overlap > OVERLAP_ENOUGH:
                cost[i, j] = distance + np.log(np.linalg.det(S)) - OVERLAP_BONUS * overlap
                cost[i, j] += 0.0 if state.confirmed else OVERLAP_BONUS
    rows, columns = linear_sum_assignment(cost)
    return {int(i): int(j) for i, j in zip(rows, columns, strict=True) if cost[i, j] < IMPOSSIBLE}


def _crowds(
    states: Sequence[TargetFilter], detections: Sequence[Measurement], matches: dict[int, int]
) -> dict[int, int]:
    """Find detections that cover two or more confirmed tracks: {index of such a track: the detection}."""
    crowds: dict[int, int] = {}
    for j, detection in enumerate(detections):
        covered = [
            i
            for i, state in enumerate(states)
            if state.confirmed and matches.get(i, j) == j and _covered(state.box, detection) > COVERED
        ]
        if len(covered) > 1:
            crowds |= dict.fromkeys(covered, j)
    return crowds


def _intersection(box: Box, detection: Measurement) -> float:
    """Area that two boxes share [px^2]."""
    low = np.maximum(box[0] - box[1] / 2, detection.center_px - detection.size_px / 2)
    high = np.minimum(box[0] + box[1] / 2, detection.center_px + detection.size_px / 2)
    return float(np.prod(np.maximum(0.0, high - low)))


def _covered(box: Box, detection: Measurement) -> float:
    """The part of a box that a detection covers, 0 to 1."""
    return _intersection(box, detection) / float(np.prod(box[1]))


def _overlap(box: Box, detection: Measurement) -> float:
    """Intersection over union of two boxes, 0 to 1."""
    both = _intersection(box, detection)
    return both / (float(np.prod(box[1])) + float(np.prod(detection.size_px)) - both)
