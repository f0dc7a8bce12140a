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
from cotarget.estimation import Appearance, Estimate, FilterSettings, TargetFilter, filter_settings
from cotarget.estimation.motion_model import GATE, HEAD_SIGMA
from cotarget.estimation.target_filter import inflated
from cotarget.estimation.zoom_matching import CloseupFinder, Expected, Finder, MatchingSettings, ZoomMeasurement
from cotarget.geometry import Array
from cotarget.pantilt import towards
from cotarget.rig import Detection, Frame, Image, PanTiltState, ZoomState
from cotarget.tracking.track import LARGEST_AREA_RATIO, Track, missing, room_inside

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
        if not all(kept and kept[0][0] <= t <= kept[-1][0] for kept in (self._heads, self._lenses)):
            return None
        heads, lenses = _around(self._heads, t), _around(self._lenses, t)
        # Coefficients of the polynomial through the head's states, by powers of the time since t.
        powers = np.vander(heads[:, 0] - t, increasing=True)
        (pan, tilt), *higher = np.linalg.solve(powers, heads[:, 1:]).tolist()
        speed = math.hypot(*higher[0]) if higher else 0.0
        return Pose(pan, tilt, math.exp(float(np.interp(t, lenses[:, 0], lenses[:, 1]))), speed)


def _append(kept: "deque[tuple[float, ...]]", state: tuple[float, ...]) -> None:
    """Append a state with its time; replace the last one if that came too soon after the one before it."""
    if kept and state[0] <= kept[-1][0]:
        return
    if len(kept) > 1 and kept[-1][0] - kept[-2][0] < SPACING_S:
        kept.pop()
    kept.append(state)
    while kept[0][0] < state[0] - REMEMBERED_S:
        kept.popleft()


def _around(kept: "deque[tuple[float, ...]]", t: float) -> Array:
    """Return the at most `POINTS` states nearest to a time, as rows."""
    after = bisect_right(kept, t, key=lambda state: state[0])
    first = min(max(after - POINTS // 2, 0), max(len(kept) - POINTS, 0))
    return np.array([kept[i] for i in range(first, min(first + POINTS, len(kept)))])


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
            elsewhere [s]: the search is widened. After twice that time the target is unconfirmed. Measured times to
            find it: docs/design-notes.md.
        just_seen_s: longest time since the last measurement for which a target still counts as seen [s].
    """

    most_filters: int = 12
    time_sigma_s: float = 2e-3
    contradicted: float = 4.0
    unfound_s: float = 1.5
    just_seen_s: float = 0.2


@dataclass(frozen=True)
class FixedMeasurement:
    """Measurement of a track by one frame of the fixed camera, for `TargetFilter.update_fixed`.

    Attributes:
        box: bounding box; the size of a clipped one is only a lower bound.
        sigma_px: standard deviation of its centre, (2,) [px]; None for that of the settings.
        size_px: size of the known dimension [px], if it is better known than from this box alone.
    """

    box: Detection
    sigma_px: Array | None = None
    size_px: float | None = None

    @property
    def is_whole(self) -> bool:
        """Whether the box shows the whole target, and nothing else."""
        return self.sigma_px is None


def measure(track: Track, target: TargetProfile) -> FixedMeasurement:
    """Derive the measurement from a track's newest detection."""
    box = track.box
    if track.shared:  # its box covers other targets too: it bounds the place and shows no size
        inside = Detection(track.center_px, np.zeros(2), track.score, clipped=True)
        return FixedMeasurement(inside, np.hypot(room_inside(box.size_px, track.size_px), track.size_px / 2))
    lacks = missing(track.size_px, box.size_px)
    if lacks.any():  # a part of the target: no size, and a poor centre
        return FixedMeasurement(replace(box, clipped=True), np.hypot(lacks, box.size_px) / 2)
    return FixedMeasurement(box, size_px=track.larger_side_px if target.largest_over_time else None)


class ZoomSearch:
    """Search for the followed target in the zoom image.

    Attributes:
        finder: registers the target; a new one for each followed track.
        waiting: zoom frames without a fixed frame of their time, the oldest first.
        unfound_s: time for which the zoom image should have shown the target and did not [s].
        apart_s: time of the newest zoom frame less that of the newest fixed frame [s].
    """

    def __init__(
        self, make_finder: Callable[[], Finder], settings: FusionSettings, filter: FilterSettings, latest_s: float
    ) -> None:
        """Create a search without a target.

        Args:
            make_finder: makes the finder for a target.
            settings: settings of the fusion.
            filter: settings of the target filters, for the widened search.
            latest_s: largest delay of one camera's frames against the other's [s].
        """
        self._make_finder, self._settings, self._filter, self._latest_s = make_finder, settings, filter, latest_s
        self.waiting: deque[Frame] = deque()
        self._zoom_t = math.inf
        self.apart_s = 0.0
        self.start()

    def start(self) -> None:
        """Search for another target from now on."""
        self.finder, self.unfound_s = self._make_finder(), 0.0

    def add(self, frame: Frame, fixed_t: float) -> None:
        """Add a zoom frame; fixed_t is the time of the newest fixed frame [s]."""
        self.waiting.append(frame)
        while self.waiting[0].t < frame.t - self._latest_s:
            self.waiting.popleft()
        self.apart_s = frame.t - fixed_t

    def next_frame(self, fixed_t: float) -> Frame | None:
        """Return the newest zoom frame for which the fixed camera has shown the target; drop it and older ones.

        Args:
            fixed_t: time of the newest fixed frame [s]; frames older than `latest_s` before it are dropped too.
        """
        due = next((each for each in reversed(self.waiting) if self.finder.fixed_view_at(each.t) is not None), None)
        done_t = fixed_t - self._latest_s if due is None else due.t
        while self.waiting and self.waiting[0].t <= done_t:
            self.waiting.popleft()
        return due

    def find(self, frame: Frame, pose: Pose, estimate: Estimate) -> ZoomMeasurement | None:
        """Find the target in a zoom frame.

        Args:
            frame: frame of the zoom camera.
            pose: pan, tilt and focal length at its time.
            estimate: estimate of the target at its time.
        """
        seen = estimate.appearance(pose.pan, pose.tilt, pose.nominal_px)
        if seen is None:
            return None
        # With a wrong size or calibration the gate would never contain the target, so it is widened.
        searched = seen
        if self.is_overdue:
            wider = replace(estimate, state_covariance=inflated(estimate.state_covariance, self._filter))
            searched = wider.appearance(pose.pan, pose.tilt, pose.nominal_px) or seen
        pan, tilt = pose.pan + estimate.bias[0], pose.tilt + estimate.bias[1]
        found = self.finder.find(frame, Expected(estimate.x_fixed, searched.covariance, pan, tilt, pose.nominal_px))
        self._count_unfound(frame, found, seen, estimate)
        return found

    @property
    def is_overdue(self) -> bool:
        """Whether the zoom image has failed to show the target for too long."""
        return self.unfound_s > self._settings.unfound_s

    @property
    def is_unconfirmed(self) -> bool:
        """Whether the zoom image has failed to show the target even to the widened search."""
        return self.unfound_s > 2 * self._settings.unfound_s

    def _count_unfound(self, frame: Frame, found: ZoomMeasurement | None, seen: Appearance, estimate: Estimate) -> None:
        """Count the time for which the zoom image should have shown the target and did not."""
        passed, self._zoom_t = min(max(frame.t - self._zoom_t, 0.0), self._settings.just_seen_s), frame.t
        size = np.array(frame.image.shape[1::-1])
        if found is not None:
            innovation = found.center_px - (size - 1) / 2 - seen.offset_px
            S = seen.covariance + np.diag(np.square(found.sigma_px) + np.square(found.body_sigma_px))
            if float(innovation @ np.linalg.solve(S, innovation)) <= GATE:
                self.unfound_s = 0.0
                return
        is_inside = np.all(np.abs(seen.offset_px) + seen.size_px / 2 <= size / 2)
        if is_inside and frame.t - estimate.measured_t <= self._settings.just_seen_s:
            self.unfound_s += passed


class TargetFusion:
    """Fuse the measurements of both cameras into one 3D estimate per track.

    Args:
        calibration: calibration of the rig, for the streams in use.
        target: profile of the target to follow.
        size: (width, height) of the fixed camera's image [px].
        closed_loop: whether the target is also registered in the zoom image.
        finder: makes the finder for the zoom image, once for each followed track; by default `CloseupFinder`.
        filter: settings of the target filters; by default those of the target profile.
        matching: settings of the registration in the zoom image.
        settings: settings of the fusion.

    Attributes:
        states: states of head and lens by time.
        search: search for the followed target in the zoom image.
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
        self._target, self._size, self._closed_loop, self._settings = target, size, closed_loop, settings
        matching = matching or MatchingSettings()
        make_finder = finder or partial(CloseupFinder, settings=matching)
        self._latest_s = matching.latest_s
        self._filter_settings = filter or filter_settings(target, calibration)
        self._make_filter = partial(TargetFilter, calibration, target, self._filter_settings)
        self._filters: dict[int, TargetFilter] = {}  # of the most important tracks
        self._followed: int | None = None
        self._seen_well_s: dict[int, float] = {}  # time for which each track was seen well in the close-up [s]
        self._areas: dict[int, float] = {}  # area of the largest whole box of each track [px^2]
        self._unlikely: set[int] = set()  # tracks whose size or pointing contradicts the priors
        self._T_base_fixed = calibration.zoom_head.T_base_fixed
        self.states = StateHistory()
        make_finder = partial(make_finder, calibration, target)
        self.search = ZoomSearch(make_finder, settings, self._filter_settings, matching.latest_s)

    def follow(self, number: int | None) -> None:
        """Register another track in the zoom image from now on; None for no track."""
        if number != self._followed:
            self._followed = number
            self.search.start()

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
        numbers = {track.id for track in tracks}
        self._seen_well_s = {number: seconds for number, seconds in self._seen_well_s.items() if number in numbers}
        self._unlikely &= numbers
        self._areas = {number: area for number, area in self._areas.items() if number in numbers}
        kept = self._most_important(tracks, favoured)
        self._filters = {track.id: self._filters.get(track.id) or self._make_filter() for track in kept}
        for track in kept:
            if track.missed:
                continue
            if self._was_part(track):
                self._filters[track.id] = self._make_filter()
            measured = measure(track, self._target)
            if track.id == self._followed and measured.is_whole:
                fixed_view = self.search.finder.update_fixed(frame, measured.box, mask)
                if fixed_view is not None:  # the same body point that the zoom image measures
                    body = replace(measured.box, center_px=fixed_view.body_px)
                    sigma_px = fixed_view.body_sigma_px
                    if self._target.matcher == "upright":  # a box without the feet has its middle too high
                        sigma_px = np.hypot(sigma_px, [0.0, abs(body.size_px[1] - track.size_px[1]) / 2])
                    measured = replace(measured, box=body, sigma_px=sigma_px)
            self._filters[track.id].update_fixed(
                measured.box, frame.t, sigma_px=measured.sigma_px, size_px=measured.size_px
            )

    def _was_part(self, track: Track) -> bool:
        """Note the box's area; tell whether the boxes so far were of a part of the target, such as a hand."""
        area = float(track.box.size_px.prod())
        was_part = area >= LARGEST_AREA_RATIO * self._areas.get(track.id, math.inf)
        if was_part:
            del self._areas[track.id]
        if not track.box.clipped and not track.shared:
            self._areas[track.id] = max(area, self._areas.get(track.id, 0.0))
        return was_part

    def _most_important(self, tracks: Sequence[Track], favoured: Collection[int]) -> list[Track]:
        """Select the tracks that have a filter, the followed one first."""

        def last(track: Track) -> tuple[bool, ...]:
            return (
                track.id != self._followed,
                track.id not in favoured,
                not track.confirmed,
                track.id not in self._filters,  # a new track must not displace a filter in use
            )

        return sorted(tracks, key=last)[: self._settings.most_filters]

    def update_zoom(self, frame: Frame | None, fixed_t: float) -> ZoomMeasurement | None:
        """Register the followed target in the zoom image and update its filter.

        A zoom frame newer than the fixed camera's waits until the fixed camera has shown the target at about its time.

        Args:
            frame: frame of the zoom camera; None if there is no new one.
            fixed_t: exposure time of the newest fixed frame [s].
        """
        if not self._closed_loop:
            return None
        if frame is not None:
            self.search.add(frame, fixed_t)
        if self._followed is None:
            self.search.waiting.clear()
            return None
        due = self.search.next_frame(fixed_t)
        known = self._filters.get(self._followed)
        if due is None or known is None:
            return None
        pose, estimate = self.states.at(due.t), known.at(due.t)
        if pose is None or estimate is None:
            return None
        if _contradictions(estimate, self._settings):
            self._unlikely.add(self._followed)
        else:
            self._unlikely.discard(self._followed)
        found = self.search.find(due, pose, estimate)
        if found is not None:
            # Both cameras show the same point, but wings and limbs move it. With the registration's own error alone,
            # the filter would take their beats for motion of the target.
            sigma_px = np.hypot(found.sigma_px, found.body_sigma_px)
            head_sigma = math.hypot(HEAD_SIGMA, pose.speed * self._settings.time_sigma_s)
            known.update_zoom(
                found.center_px, sigma_px, pose.pan, pose.tilt, pose.nominal_px, due.t, head_sigma=head_sigma
            )
        return found

    def estimate(self, number: int, t: float) -> Estimate | None:
        """Estimate a track at time t [s]; None if it has no filter or no measurement by then."""
        known = self._filters.get(number)
        return None if known is None else known.at(t)

    def warnings(self, number: int, estimate: Estimate | None) -> list[str]:
        """Describe what contradicts the nominal size of a target or the calibration.

        Args:
            number: id of the followed track.
            estimate: estimate of it at the time of the newest fixed frame.

        Returns:
            One sentence for each contradiction; empty if there is none.
        """
        if estimate is None:
            return []
        found = []
        if wrong := _contradictions(estimate, self._settings):
            found.append(f"the nominal size or the calibration seems wrong: {', '.join(wrong)}")
        apart_s = self.search.apart_s
        if number == self._followed and abs(apart_s) > self._latest_s:
            later = "zoom" if apart_s < 0 else "fixed"
            found.append(f"the cameras are too far apart in time: the {later} one comes {abs(apart_s):.2f} s later")
        elif number == self._followed and self.search.is_overdue:
            unfound = f"for {self.search.unfound_s:.1f} s not found where the zoom camera should show it"
            found.append(f"{unfound}: it is hidden there, or the nominal size or the calibration is wrong")
        return found

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
            self._seen_well_s[track.id] = self._seen_well_s.get(track.id, 0.0) + seconds

    def candidates(self, tracks: Sequence[Track], t: float) -> list[Candidate]:
        """List the confirmed tracks that may be selected at time t [s]."""
        found = []
        for track in tracks:
            known = self._filters.get(track.id)
            if track.confirmed and known is not None and known.knows(t):
                direction = partial(self._direction, known, t)
                seen_s, likely = self._seen_well_s.get(track.id, 0.0), track.id not in self._unlikely
                found.append(Candidate(track, direction, leaves_in(track, self._size), seen_s, likely=likely))
        return found

    def _direction(self, known: TargetFilter, t: float, later: float) -> Array:
        """Pan and tilt of a target from the head, (2,) [rad]; the zoom camera's offset on the head is neglected."""
        estimate = known.at(t + later)
        assert estimate is not None, "what is known at a time is known later"
        return np.array(towards(self._T_base_fixed.apply(estimate.x_fixed)))


def _contradictions(estimate: Estimate, settings: FusionSettings) -> list[str]:
    """Describe where size and head bias, as both cameras show them, contradict their priors."""
    wrong = []
    if abs(estimate.size_deviation) > settings.contradicted:
        wrong.append(f"both views make it {estimate.size:.2g} m and not {estimate.target.size:.2g} m")
    if estimate.bias_deviation > settings.contradicted:
        wrong.append(f"the head points {math.degrees(math.hypot(*estimate.bias)):.2g} degrees beside")
    return wrong
