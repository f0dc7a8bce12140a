"""Track detections over frames: association, and the life cycle of tracks.

Detections are assigned to tracks by the Hungarian method, inside a gate on the Mahalanobis distance of place and size.
Each track is filtered by `cotarget.tracking.track`. The source of the numbers: docs/design-notes.md.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from scipy.optimize import linear_sum_assignment

from cotarget.geometry import Array, intersection_areas
from cotarget.rig import Detection
from cotarget.tracking.track import (
    CUT,
    LARGEST_AREA_RATIO,
    LiveTrack,
    Track,
    TrackingSettings,
    center_variance,
    least_likely,
    missing,
    tracking_settings,
)

__all__ = ["Track", "Tracker", "TrackingSettings", "tracking_settings"]
# Cost of pairs that must not be matched; no assignment inside the gate reaches it.
IMPOSSIBLE = 1e6
# What is covered by a confirmed track's box, enlarged by this factor, belongs to it: a shoe, a rotor.
NEAR = 1.5

# States (u, v, du, dv), (4,) [px, px/s], and their covariances, (4, 4), by the ids of tracks.
Expected = Mapping[int, tuple[Array, Array]]


class Tracker:
    """Turn each frame's detections into tracks with ids that are never reused.

    Attributes:
        tracks: all tracks after the last update; confirmed ones first, then by age.
    """

    def __init__(self, settings: TrackingSettings | None = None, image_size: tuple[int, int] | None = None) -> None:
        """Create a tracker without tracks.

        Args:
            settings: settings of filters and life cycle.
            image_size: (width, height) [px]; with it, a track ends when it leaves the image, and the settings are
                scaled to its width.
        """
        settings = settings or TrackingSettings()
        self._settings = settings if image_size is None else settings.scaled(image_size[0])
        self._image_size = image_size
        self._tracks: list[LiveTrack] = []
        self.tracks: list[Track] = []
        self._next_id = 1
        self._t: float | None = None
        self._shift: Array = np.zeros(2)  # of the scene in the last frame [px]
        self._interval = self._settings.lose_s  # between the last two frames [s]

    def update(
        self,
        detections: Sequence[Detection],
        t: float,
        shift: Array | None = None,
        *,
        cut: bool = False,
        expected: Expected = MappingProxyType({}),
    ) -> list[Track]:
        """Update the tracks with one frame's detections.

        Args:
            detections: detections, best first. Of more than `most_detections`, those next to confirmed tracks are used,
                then the best.
            t: exposure time of the frame [s]. A frame that is not newer than the last one is ignored; after a clock
                that jumped back by more than a track lives, tracking restarts.
            shift: shift of the scene in the image since the first frame (du, dv) [px], (2,); None for a camera that
                stands. Tracks move with the scene.
            cut: whether the frame shows another scene than the one before. Tracks that are not found again end soon.
            expected: predictions at ``t`` by a better filter than the tracks' own. Out of sight, a confirmed track has
                the predicted state. It lives for as long as a detection there would rather be its target than a new
                object, at most for as long as it was seen.

        Returns:
            All tracks at ``t``; confirmed ones first, then by age.
        """
        if self._t is not None and t <= self._t:
            if self._t - t <= self._settings.lose_s:
                return self.tracks
            self._tracks.clear()
        self._begin(t, expected)
        self._follow_scene(self._shift if shift is None else shift, cut)
        detections = self._most_useful(detections)
        matches: dict[int, int] = {}
        merged: dict[int, int] = {}
        if self._tracks and detections:
            pairs = _Pairs(self._tracks, detections, self._image_size)
            matches = _assign(pairs)
            merged = _merged(pairs, matches)
        taken = set(matches.values())
        for i, state in enumerate(self._tracks):
            if i in merged:
                state.correct_shared(detections[merged[i]])
            elif i in matches:
                state.correct(detections[matches[i]])
            else:
                state.missed += 1
        self._tracks = [s for s in self._tracks if not s.is_over(self._image_size)]
        least = self._settings.start_score
        self._start_tracks([each for j, each in enumerate(detections) if j not in taken and each.score >= least], t)
        states = (state.track() for state in self._tracks)
        self.tracks = sorted(states, key=lambda track: (not track.confirmed, track.id))
        return self.tracks

    def _begin(self, t: float, expected: Expected) -> None:
        """Predict all tracks to a frame's time and end those that did not survive a gap between frames.

        The search area grows with the gap, until any detection would match. The time between the last two frames is no
        such gap, even for a track that lives no longer.
        """
        for state in self._tracks:
            state.predict(t)
            state.expected = bool(state.number in expected and state.missed and state.confirmed)
            if state.expected:
                state.expect(*expected[state.number])
        self._tracks = [
            state for state in self._tracks if state.expected or t - state.seen <= state.timeout_s + self._interval
        ]
        if self._t is not None and t > self._t:
            self._interval = t - self._t
        self._t = t

    def _follow_scene(self, shift: Array, cut: bool) -> None:
        """Move all tracks by what the scene has moved since the last frame."""
        by, self._shift = shift - self._shift, shift
        for state in self._tracks:
            state.move(by)
            state.after_cut |= cut

    def _most_useful(self, detections: Sequence[Detection]) -> Sequence[Detection]:
        """Select at most `most_detections` detections, in their order."""
        most = self._settings.most_detections
        if len(detections) <= most:
            return detections
        distance = np.full(len(detections), np.inf)
        confirmed = [state for state in self._tracks if state.confirmed]
        if confirmed:
            pairs = _Pairs(confirmed, detections, self._image_size)
            explained = pairs.possible | (pairs.covered > self._settings.covered)
            distance = np.where(explained, pairs.distance, np.inf).min(axis=0)
        return [detections[j] for j in sorted(np.argsort(distance, kind="stable")[:most].tolist())]

    def _start_tracks(self, detections: Sequence[Detection], t: float) -> None:
        """Start a track at each detection that covers no existing one, but for much smaller ones just found."""
        if not detections:
            return
        covered = self._settings.covered
        at, size = _boxes_of(self._tracks)
        center, extent = _boxes(detections)
        shared = intersection_areas(at, size, center, extent)
        found = np.array([not (state.missed or state.shared) for state in self._tracks], dtype=bool)
        on = shared > covered * _area(size)[:, None]
        other = found[:, None] & (LARGEST_AREA_RATIO * _area(size)[:, None] < _area(extent))
        free = np.all(~on | other, axis=0)
        confirmed = [state for state in self._tracks if state.confirmed]
        wholes = np.array([state.whole for state in confirmed]).reshape(-1, 2)
        near = intersection_areas(_boxes_of(confirmed)[0], NEAR * wholes, center, extent)
        free &= np.all(near <= covered * _area(extent), axis=0)
        covers = intersection_areas(center, extent, center, extent) > covered * _area(extent)[:, None]
        for j, detection in enumerate(detections):
            if free[j]:  # detections that cover this new track are no further target
                free &= ~covers[j]
                new = LiveTrack(self._next_id, detection, t, self._settings, self._image_size)
                self._tracks.append(new)
                self._next_id += 1


class _Pairs:
    """Comparison of every track with every detection, as arrays (tracks, detections).

    Attributes:
        distance: squared distance of place (Mahalanobis) and of size, in variances.
        log_volume: logarithm of the determinant of the innovation covariance.
        covered: part of the track's box that the detection covers, 0 to 1.
        area_ratio: area of the detection over that of the track.
        settings: settings of the tracker.
        confirmed: whether each track is confirmed.
        possible: whether each detection may belong to each track.
    """

    def __init__(
        self,
        states: Sequence[LiveTrack],
        detections: Sequence[Detection],
        image_size: tuple[int, int] | None,
    ) -> None:
        """Compare tracks and detections, at least one of each; new objects need the image's (width, height) [px]."""
        self.confirmed = [state.confirmed for state in states]
        (at, size), (center, extent) = _boxes_of(states), _boxes(detections)
        spread = np.array([state.center_variance for state in states])[:, None]
        cut = np.array([detection.clipped for detection in detections], dtype=bool)
        lacks = missing(size[:, None], extent)
        self.settings = settings = states[0].settings
        spread = spread + center_variance(settings, extent, np.where(cut, CUT, settings.noise_of_size)[:, None], lacks)
        own, other = _area(size)[:, None], _area(extent)
        resized = np.log(other / own) / 2 / settings.size_sigma
        # A clipped box may be larger than it shows, and a track last seen clipped is of unknown size.
        known = np.array([[not state.detection.clipped] for state in states])
        resized = np.where(cut, np.where(known, np.maximum(resized, 0.0), 0.0), resized)
        off = (center - at[:, None]) ** 2 / spread
        self.distance: Array = off[..., 0] + off[..., 1] + resized**2
        self.log_volume: Array = np.log(_area(spread))
        shared = intersection_areas(at, size, center, extent)
        self.covered: Array = shared / own
        self.area_ratio: Array = other / own
        overlap = shared / (own + other - shared)
        weak = np.array([detection.score < settings.start_score for detection in detections], dtype=bool)
        clutter = np.where(weak, float(np.count_nonzero(weak)), 0.0)
        new_object = self.distance + self.log_volume > _least_likely(states, image_size, clutter)
        new_object |= weak & ~np.array(self.confirmed)[:, None]
        # A target whose box merged with another still overlaps its track.
        self.possible = ((self.distance <= settings.gate) & ~new_object) | (overlap > settings.overlap_enough)
        self.possible &= ~known | (self.area_ratio < LARGEST_AREA_RATIO)  # a clipped box has an unknown area


def _least_likely(states: Sequence[LiveTrack], image_size: tuple[int, int] | None, clutter: Array) -> Array:
    """Largest distance plus log volume at which a detection is no new object, (tracks, detections).

    A track that the last frame detected has no such limit, but for detections too weak to begin a track, of which there
    are some everywhere.

    Args:
        states: tracks.
        image_size: (width, height) [px].
        clutter: number of weak detections in this frame for a weak one, and 0 for the others, (detections,).
    """
    if image_size is None:
        return np.full((len(states), len(clutter)), np.inf)
    hidden_s = np.array([[state.t - state.seen if state.missed else 0.0] for state in states])
    return least_likely(states[0].settings, hidden_s, image_size, clutter)


def _boxes_of(states: Sequence[LiveTrack]) -> tuple[Array, Array]:
    """Centres and sizes of tracks [px], (n, 2) each."""
    at, size = [state.center for state in states], [state.size for state in states]
    return np.array(at).reshape(-1, 2), np.array(size).reshape(-1, 2)


def _boxes(detections: Sequence[Detection]) -> tuple[Array, Array]:
    """Centres and sizes of detections [px], (n, 2) each."""
    center, size = [each.center_px for each in detections], [each.size_px for each in detections]
    return np.array(center).reshape(-1, 2), np.array(size).reshape(-1, 2)


def _area(sides: Array) -> Array:
    """Area or product of two sides, (..., 2) to (...)."""
    return np.asarray(sides[..., 0] * sides[..., 1])


def _assign(pairs: _Pairs) -> dict[int, int]:
    """Match tracks to detections one to one: {index of the track: index of the detection}.

    Confirmed tracks are matched first: a coasting track knows its target's place badly, and a new track begun there
    meanwhile knows it well, yet the detection is the old target, found again.
    """
    cost = np.where(pairs.possible, pairs.distance + pairs.log_volume, IMPOSSIBLE)
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


def _merged(pairs: _Pairs, matches: dict[int, int]) -> dict[int, int]:
    """Find detections that cover two or more confirmed tracks: {index of the track: index of the detection}."""

    def is_free(track: int, box: int) -> bool:
        """Whether a track has no match but this box, or only a piece of its target."""
        match = matches.get(track, box)
        return match == box or bool(pairs.area_ratio[track, match] < pairs.settings.covered)

    merged: dict[int, int] = {}
    if sum(pairs.confirmed) < 2:
        return merged
    members = (pairs.covered > pairs.settings.covered) & (pairs.area_ratio < LARGEST_AREA_RATIO)
    inside = members & np.array(pairs.confirmed)[:, None]
    for j in np.flatnonzero(np.count_nonzero(inside, axis=0) > 1):
        covered = [i for i in np.flatnonzero(inside[:, j]).tolist() if is_free(i, int(j))]
        if len(covered) > 1:
            merged |= dict.fromkeys(covered, int(j))
    return merged
