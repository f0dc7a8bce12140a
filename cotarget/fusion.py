"""Fuse fixed- and zoom-camera measurements into one 3D state per track.

Each track of the fixed camera has its own target filter. The followed track is also registered in the zoom image, which
triangulates its depth and shows errors of the head and of the calibration. `StateHistory` interpolates the states of
head and lens to the exposure time of each zoom frame. Measurements: docs/design-notes.md.
"""

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import TargetProfile
from cotarget.control.selection import Candidate, leaves_in
from cotarget.control.zoom import is_seen_well, shape_of
from cotarget.detection import Detection
from cotarget.estimation import Appearance, Estimate, FilterSettings, TargetFilter, filter_settings
from cotarget.estimation.motion_model import PAN, TILT, K, L
from cotarget.estimation.zoom_matching import CloseupFinder, Expected, Finder, MatchingSettings, ZoomMeasurement
from cotarget.geometry import Array
from cotarget.pantilt import towards
from cotarget.rig import Frame, Image, PanTiltState, ZoomState
from cotarget.tracking.track import Track, missing, room_inside

REMEMBERED_S = 2.0  # longer than any latency [s]
# States for the cubic interpolation: two before a time and two after it. A straight line through the nearest two is
# off by 0.041 degrees where the head's acceleration changes, the cubic by 0.024.
POINTS = 4
# Least time between two kept states [s]: a cubic through closer ones multiplies their rounding.
SPACING_S = 0.01


@dataclass(frozen=True)
class Pose:
    """Pan, tilt and focal length at one time.

    Attributes:
        pan: pan as the head reports it [rad].
        tilt: tilt as the head reports it [rad].
        nominal_px: nominal focal length, as the lens reports it [px].
        speed: speed of the head over both axes together [rad/s].
    """

    pan: float
    tilt: float
    nominal_px: float
    speed: float


class StateHistory:
    """Recent states of head and lens, each with its own time, for interpolation."""

    def __init__(self) -> None:
        self._heads: deque[tuple[float, ...]] = deque()
        self._lenses: deque[tuple[float, ...]] = deque()

    def add(self, head: PanTiltState, lens: ZoomState) -> None:
        """Add the newest states of both devices; ignore a state that is no newer than the last one."""
        _append(self._heads, (head.t, head.pan, head.tilt))
        _append(self._lenses, (lens.t, math.log(lens.focal_px)))

    def at(self, t: float) -> Pose | None:
        """Interpolate head and lens to time t [s]; None if t is not between two kept states."""
        if not (_spans(self._heads, t) and _spans(self._lenses, t)):
            return None
        near = _around(self._heads, t)
        weights, slopes = _cubic(near[:, 0], t)
        pan, tilt = weights @ near[:, 1:]
        lens = _around(self._lenses, t)
        nominal = math.exp(float(np.interp(t, lens[:, 0], lens[:, 1])))
        return Pose(float(pan), float(tilt), nominal, float(np.hypot(*(slopes @ near[:, 1:]))))


def _append(kept: "deque[tuple[float, ...]]", state: tuple[float, ...]) -> None:
    if kept and state[0] <= kept[-1][0]:
        return
    if len(kept) > 1 and kept[-1][0] - kept[-2][0] < SPACING_S:
        kept.pop()
    kept.append(state)
    while kept[0][0] < state[0] - REMEMBERED_S:
        kept.popleft()


def _spans(kept: "deque[tuple[float, ...]]", t: float) -> bool:
    return bool(kept) and kept[0][0] <= t <= kept[-1][0]


def _around(kept: "deque[tuple[float, ...]]", t: float) -> Array:
    """Return the at most `POINTS` states nearest to a time, as rows."""
    after = bisect_right(kept, t, key=lambda state: state[0])
    first = min(max(after - POINTS // 2, 0), max(len(kept) - POINTS, 0))
    return np.array([kept[i] for i in range(first, min(first + POINTS, len(kept)))])


def _cubic(times: Array, t: float) -> tuple[Array, Array]:
    """Weights of values at given times for the value at t and for its derivative (Lagrange), (n,) each."""
    n = len(times)
    weights, slopes = np.ones(n), np.zeros(n)
    for k in range(n):
        others = [j for j in range(n) if j != k]
        for j in others:
            weights[k] *= (t - times[j]) / (times[k] - times[j])
            product = 1.0 / (times[k] - times[j])
            for i in others:
                if i != j:
                    product *= (t - times[i]) / (times[k] - times[i])
            slopes[k] += product
    return weights, slopes


# Most zoom frames that wait for a fixed frame of their time; beyond it the oldest are dropped.
MOST_WAITING = 30
MakeFinder = Callable[[Calibration, TargetProfile], Finder]


@dataclass(frozen=True)
class FusionSettings:
    """Which tracks have a filter, and when the zoom image contradicts the estimate.

    Attributes:
        most_filters: most tracks with a filter: more than a dozen moving objects cannot be kept apart anyway.
        time_sigma_s: standard deviation of the time between a frame and the states of head and lens [s].
        contradicted: a size or head bias beyond this many prior standard deviations is taken as wrong; a right one
            comes to 1 or 2.
        unfound_s: a target that both cameras should see and that the zoom image does not show for this long is
            elsewhere [s]. A bird at the right place was missed for 0.8 s at most, a person or a book for a frame or
            two.
        unconfirmed_s: a target not shown for this long is unconfirmed, because the widened search has not found it
            either [s]. With a nominal size three times too large it was found after 2.2 s.
        inflated_size: standard deviation by which the search is widened after ``unfound_s``, of the logarithm of size
            and depth together; a nominal size twice too large is 0.7.
        inflated_bias: standard deviation by which it is widened, of the head's bias [rad].
        near: a registration within this many standard deviations of the expected place agrees with the estimate.
        just_seen_s: longest time since the last measurement for which a target still counts as seen [s].
    """

    most_filters: int = 12
    time_sigma_s: float = 2e-3
    contradicted: float = 4.0
    unfound_s: float = 1.5
    unconfirmed_s: float = 3.0
    inflated_size: float = 0.4
    inflated_bias: float = 5e-3
    near: float = 3.0
    just_seen_s: float = 0.2


class TargetFusion:
    """The target filters of all tracks, updated frame by frame.

    Args:
        calibration: calibration of the rig, for the streams in use.
        target: profile of the target to follow.
        size: (width, height) of the fixed camera's image [px].
        closed_loop: whether the target is also registered in the zoom image.
        finder: makes the finder for the zoom image, once for each followed track; by default `CloseupFinder`.
        filter: settings of the target filters; by default those of the target profile.
        matching: settings of the registration in the zoom image.
        settings: settings of the fusion.
    """

    def __init__(
        self,
        calibration: Calibration,
        target: TargetProfile,
        size: tuple[int, int],
        *,
        closed_loop: bool = True,
        finder: MakeFinder | None = None,
        filter: FilterSettings | None = None,
        matching: MatchingSettings | None = None,
        settings: FusionSettings = FusionSettings(),
    ) -> None:
        self._calibration, self._target, self._size = calibration, target, size
        self._closed_loop, self._matching = closed_loop, matching or MatchingSettings()
        self._make_finder = finder or partial(CloseupFinder, settings=self._matching)
        self._assumed, self._settings = filter or filter_settings(target, calibration), settings
        self._filters: dict[int, TargetFilter] = {}
        self._seen_s: dict[int, float] = {}
        self._unlikely: set[int] = set()
        self._followed: int | None = None
        self._zoom_t = math.inf
        self._unfound_s = 0.0
        self._finder = self._make_finder(calibration, target)
        self._waiting: deque[Frame] = deque(maxlen=MOST_WAITING)  # zoom frames without a fixed frame of their time
        self._apart_s = 0.0  # time of the newest zoom frame less that of the newest fixed frame
        self._to_base = calibration.T_base_fixed
        self.states = StateHistory()

    def update_fixed(
        self, frame: Frame, tracks: Sequence[Track], mask: Image | None, favoured: Collection[int] = ()
    ) -> None:
        """Update the filters with the tracks of one fixed-camera frame.

        Args:
            frame: frame of the fixed camera.
            tracks: tracks after that frame, the oldest first.
            mask: foreground of the detector, (H, W).
            favoured: ids of tracks that get a filter before others.
        """

        def last(track: Track) -> tuple[bool, ...]:
            return (
                track.id != self._followed,
                track.id not in favoured,
                not track.confirmed,
                track.id not in self._filters,  # a new track must not displace a filter in use
            )

        known = sorted(tracks, key=last)[: self._settings.most_filters]
        numbers = {track.id for track in known}
        self._filters = {number: each for number, each in self._filters.items() if number in numbers}
        numbers = {track.id for track in tracks}
        self._seen_s = {number: seconds for number, seconds in self._seen_s.items() if number in numbers}
        self._unlikely &= numbers
        for track in known:
            if track.missed:
                continue
            if track.id not in self._filters:
                self._filters[track.id] = TargetFilter(self._calibration, self._target, self._assumed)
            found = self._filters[track.id]
            box, sigma_px = track.box, None
            if track.shared:  # its box covers other targets too, and the finder would learn those
                inside = Detection(track.center_px, np.zeros(2), track.score, clipped=True)  # this frame shows no size
                room = room_inside(box.size_px, track.size_px)
                found.update_fixed(inside, frame.t, sigma_px=np.hypot(room, track.size_px / 2))
                continue
            lacks = missing(track.size_px, box.size_px)
            if lacks.any() and isinstance(box, Detection):  # a part of the target: no size, and a poor centre
                sigma_px = np.hypot(lacks, box.size_px) / 2
                found.update_fixed(replace(box, clipped=True), frame.t, sigma_px=sigma_px)
                continue
            if track.id == self._followed and isinstance(box, Detection):
                sight = self._finder.update_fixed(frame, box, mask)
                if sight is not None:  # the same body point that the zoom image measures
                    box, sigma_px = replace(box, center_px=sight.body_px), sight.body_sigma_px
            size_px = track.larger_side_px if self._target.largest_over_time else None
            found.update_fixed(box, frame.t, sigma_px=sigma_px, size_px=size_px)

    def update_zoom(self, frame: Frame | None, wide_t: float) -> ZoomMeasurement | None:
        """Register the followed target in the zoom image and update its filter.

        A zoom frame newer than the fixed camera's waits until the fixed camera has shown the target at about its time.

        Args:
            frame: frame of the zoom camera; None if there is no new one.
            wide_t: exposure time of the newest fixed frame [s].
        """
        if not self._closed_loop:
            return None
        if frame is not None:
            self._waiting.append(frame)
            self._apart_s = frame.t - wide_t
        if self._followed is None:
            self._waiting.clear()
            return None
        due = next((each for each in reversed(self._waiting) if self._finder.sight_at(each.t) is not None), None)
        # Older frames had no sight of the target, or are superseded.
        done_t = wide_t - self._matching.latest_s if due is None else due.t
        while self._waiting and self._waiting[0].t <= done_t:
            self._waiting.popleft()
        return None if due is None else self._look_close(due)

    def _look_close(self, frame: Frame) -> ZoomMeasurement | None:
        """Register the followed target in a zoom frame for which the fixed camera has a sight of it."""
        assert self._followed is not None, "who asks has looked"
        pose, estimate = self.states.at(frame.t), self.estimate(self._followed, frame.t)
        if pose is None or estimate is None:
            return None
        if _contradicted(estimate, self._settings):
            self._unlikely.add(self._followed)
        else:
            self._unlikely.discard(self._followed)
        seen = estimate.appearance(pose.pan, pose.tilt, pose.nominal_px)
        if seen is None:
            return None
        # With a wrong size or calibration the search would look beside the target for ever, so it is widened.
        inflated = None
        if self._overdue:
            inflated = _inflated(estimate, self._settings).appearance(pose.pan, pose.tilt, pose.nominal_px)
        pan, tilt = pose.pan + estimate.bias[0], pose.tilt + estimate.bias[1]
        covariance = (seen if inflated is None else inflated).covariance
        found = self._finder.find(frame, Expected(estimate.x_fixed, covariance, pan, tilt, pose.nominal_px))
        self._count_unfound(frame, found, seen, estimate)
        if found is not None:
            self._filters[self._followed].update_zoom(
                found.center_px,
                # Both cameras show the same point, but wings and limbs move it. With the registration's own error
                # alone, the filter would take their beats for motion of the target.
                np.hypot(found.sigma_px, found.body_sigma_px),
                pose.pan,
                pose.tilt,
                pose.nominal_px,
                frame.t,
                head_sigma=math.hypot(self._assumed.head_sigma, pose.speed * self._settings.time_sigma_s),
            )
        return found

    @property
    def _overdue(self) -> bool:
        """Whether the zoom image has failed to show the target for too long."""
        return self._unfound_s > self._settings.unfound_s

    @property
    def unconfirmed(self) -> bool:
        """Whether the zoom image has failed to show the target even to the widened search."""
        return self._unfound_s > self._settings.unconfirmed_s

    def _count_unfound(self, frame: Frame, found: ZoomMeasurement | None, seen: Appearance, estimate: Estimate) -> None:
        """Count the time for which the zoom image should have shown the target and did not."""
        passed, self._zoom_t = min(max(frame.t - self._zoom_t, 0.0), self._settings.just_seen_s), frame.t
        size = np.array(frame.image.shape[1::-1])
        if found is not None:
            off = found.center_px - (size - 1) / 2 - seen.offset_px
            spread = seen.covariance + np.diag(np.square(found.sigma_px) + np.square(found.body_sigma_px))
            if float(off @ np.linalg.solve(spread, off)) <= self._settings.near**2:
                self._unfound_s = 0.0
                return
        wholly = np.all(np.abs(seen.offset_px) + seen.size_px / 2 <= size / 2)
        if wholly and frame.t - estimate.measured_t <= self._settings.just_seen_s:
            self._unfound_s += passed

    def warnings(self, number: int, t: float) -> list[str]:
        """Describe what contradicts the nominal size of a target or the calibration.

        Args:
            number: id of the followed track.
            t: time [s].

        Returns:
            One sentence for each contradiction; empty if there is none.
        """
        estimate = self.estimate(number, t)
        if estimate is None:
            return []
        found = []
        if wrong := _contradicted(estimate, self._settings):
            found.append(f"the told size or the calibration seems wrong: {', '.join(wrong)}")
        if number == self._followed and abs(self._apart_s) > self._matching.latest_s:
            later = "zoom" if self._apart_s < 0 else "wide"
            found.append(f"the views are too far apart in time: the {later} one comes {abs(self._apart_s):.2f} s later")
        elif number == self._followed and self._overdue:
            found.append(
                f"for {self._unfound_s:.1f} s not found where the zoom view should show it: it is hidden there, or the "
                "told size or the calibration is wrong"
            )
        return found

    def follow(self, number: int | None) -> None:
        """Register another track in the zoom image from now on; None for no track."""
        if number != self._followed:
            self._followed, self._unfound_s = number, 0.0
            self._finder = self._make_finder(self._calibration, self._target)

    def count_seen_well(self, track: Track, seconds: float, longest_px: float) -> None:
        """Add to the time for which a track was seen well in the close-up, by the reported states at its time.

        Args:
            track: the track after the newest fixed frame.
            seconds: time that this frame counts for [s].
            longest_px: longest nominal focal length of the lens [px].
        """
        pose, estimate = self.states.at(track.t), self.estimate(track.id, track.t)
        if pose is None or estimate is None or track.t - estimate.measured_t > self._settings.just_seen_s:
            return
        if is_seen_well(estimate, pose.pan, pose.tilt, pose.nominal_px, longest_px, shape=shape_of(track)):
            self._seen_s[track.id] = self._seen_s.get(track.id, 0.0) + seconds

    def estimate(self, number: int, t: float) -> Estimate | None:
        """Estimate a track at time t [s]; None if it has no filter or no measurement by then."""
        found = self._filters.get(number)
        return None if found is None else found.at(t)

    def candidates(self, tracks: Sequence[Track], t: float) -> list[Candidate]:
        """List the confirmed tracks that a selection policy may choose from at time t [s]."""
        return [
            Candidate(
                track,
                partial(self._direction, self._filters[track.id], t),
                leaves_in(track, self._size),
                self._seen_s.get(track.id, 0.0),
                likely=track.id not in self._unlikely,
            )
            for track in tracks
            if track.confirmed and track.id in self._filters and self._filters[track.id].knows(t)
        ]

    def _direction(self, known: TargetFilter, t: float, later: float) -> Array:
        """Pan and tilt of a target from the head, (2,) [rad]; the zoom camera's offset on the head is neglected."""
        estimate = known.at(t + later)
        assert estimate is not None, "what is known at a time is known later"
        return np.array(towards(self._to_base.apply(estimate.x_fixed)))


def _contradicted(estimate: Estimate, settings: FusionSettings) -> list[str]:
    """Describe where size and head bias, as both cameras show them, contradict their priors."""
    wrong = []
    if abs(estimate.size_deviation) > settings.contradicted:
        wrong.append(f"both views make it {estimate.size:.2g} m and not {estimate.target.size:.2g} m")
    if estimate.bias_deviation > settings.contradicted:
        wrong.append(f"the head points {math.degrees(math.hypot(*estimate.bias)):.2g} degrees beside")
    return wrong


def _inflated(estimate: Estimate, settings: FusionSettings) -> Estimate:
    """Widen the covariance of size and head bias; the ratio of size to depth, which the fixed camera sees, stays."""
    P = estimate.state_covariance.copy()
    P[np.ix_([L, K], [L, K])] += settings.inflated_size**2
    P[[PAN, TILT], [PAN, TILT]] += settings.inflated_bias**2
    return replace(estimate, state_covariance=P)
