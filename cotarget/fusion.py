"""Fuse the measurements of both cameras into the 3D filters of the targets.

`TargetFusion` keeps a `Target` for each track of the fixed camera, and adds the track's boxes to its filter.
`ZoomSearch` registers the target that a head follows in its zoom image, which triangulates the depth and shows errors
of the head and of the calibration. `StateHistory` interpolates the states of head and lens to the exposure time of each
zoom frame. Measurements: docs/design-notes.md.
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
from cotarget.estimation import Appearance, Estimate, FilterSettings, TargetFilter, filter_settings
from cotarget.estimation.clock_offset import LEAST_S, ClockOffset
from cotarget.estimation.measurement_model import Pose
from cotarget.estimation.motion_model import GATE, HEAD_SIGMA
from cotarget.estimation.target_filter import inflated
from cotarget.estimation.zoom_matching import CloseupFinder, Finder, MatchingSettings, ZoomMeasurement, outline_in
from cotarget.geometry import Array
from cotarget.rig import Detection, Frame, Image, PanTiltState, ZoomState
from cotarget.targets import Target
from cotarget.tracking.track import BEAT_S, LARGEST_AREA_RATIO, SizeHistory, Track, missing, room_inside
from cotarget.tracking.tracker import Expected

REMEMBERED_S = 2.0  # longer than any latency [s]
# States for the cubic interpolation: two before a time and two after it. A straight line through the nearest two is
# off by 0.041 degrees where the head's acceleration changes, the cubic by 0.024.
POINTS = 4
# Least time between two kept states [s]: a cubic through closer ones multiplies their rounding.
SPACING_S = 0.01


class StateHistory:
    """Recent states of head and lens, each with its own time, for interpolation."""

    def __init__(self) -> None:
        self._heads: deque[tuple[float, ...]] = deque()
        self._lenses: deque[tuple[float, ...]] = deque()

    def add(self, head: PanTiltState, lens: ZoomState) -> None:
        """Add the newest states of both devices; ignore a state that is no newer than the last one."""
        _append(self._heads, (head.t, head.pan, head.tilt, head.sigma))
        _append(self._lenses, (lens.t, math.log(lens.focal_px)))

    def interpolate(self, t: float) -> Pose | None:
        """Interpolate head and lens to time t [s]; None if t is not between two kept states."""
        if not all(kept and kept[0][0] <= t <= kept[-1][0] for kept in (self._heads, self._lenses)):
            return None
        heads, lenses = _around(self._heads, t), _around(self._lenses, t)
        # Coefficients of the polynomial through the head's states, by powers of the time since t.
        powers = np.vander(heads[:, 0] - t, increasing=True)
        (pan, tilt), *higher = np.linalg.solve(powers, heads[:, 1:3]).tolist()
        speed = math.hypot(*higher[0]) if higher else 0.0
        nominal_px = math.exp(float(np.interp(t, lenses[:, 0], lenses[:, 1])))
        return Pose(pan, tilt, nominal_px, speed, float(heads[:, 3].max()))


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


class ZoomSearch:
    """Search for the followed target in one zoom camera's images.

    Attributes:
        states: states of head and lens by time.
        clock: what the fixed camera's stamps have too much.
        target: the followed target; None for none.
        finder: registers the target; a new one for each followed target.
        waiting: zoom frames without a fixed frame of their time, the oldest first.
        unfound_s: time for which the zoom image should have shown the target and did not [s].
        apart_s: time of the newest zoom frame less that of the newest fixed frame [s].
    """

    def __init__(
        self,
        calibration: Calibration,
        profile: TargetProfile,
        *,
        closed_loop: bool = True,
        finder: MakeFinder | None = None,
        filter: FilterSettings | None = None,
        matching: MatchingSettings | None = None,
        settings: FusionSettings = FusionSettings(),
    ) -> None:
        """Create a search without a target.

        Args:
            calibration: calibration of the rig, for the streams in use.
            profile: profile of the target.
            closed_loop: whether zoom images are searched at all.
            finder: makes the finder, once for each followed target; by default `CloseupFinder`.
            filter: settings of the target filters, for the widened search; by default those of the profile.
            matching: settings of the registration in the zoom image.
            settings: settings of the fusion.
        """
        matching = matching or MatchingSettings()
        self._make_finder = partial(finder or partial(CloseupFinder, settings=matching), calibration, profile)
        self._filter = filter or filter_settings(profile, calibration)
        self._settings, self._closed_loop = settings, closed_loop
        self._matching, self._sizes = matching, SizeHistory(BEAT_S)  # of the followed target's outline [tangent]
        self.states, self.clock = StateHistory(), ClockOffset(self._filter.motion)
        self.waiting: deque[Frame] = deque()
        self._zoom_t = math.inf
        self.apart_s = 0.0
        self.target: Target | None = None
        self.finder, self.unfound_s = self._make_finder(), 0.0

    def search_for(self, target: Target | None) -> None:
        """Search for another target from now on; None for none."""
        if target is not self.target:
            self.target = target
            self.clock.forget_target()
            self.finder, self.unfound_s, self._sizes = self._make_finder(), 0.0, SizeHistory(BEAT_S)

    def correct_clock(self) -> float:
        """Return what the next fixed frame's stamp has too much [s].

        With another correction the target's filter restarts from the fixed camera alone: a depth by wrong times stays.
        """
        late_s = self.clock.correct()
        if self.clock.restarts_filter() and self.target is not None and self.target.filter is not None:
            self.target.filter = self.target.filter.from_fixed()
        return late_s

    def add_frame(self, frame: Frame | None, fixed_t: float) -> ZoomMeasurement | None:
        """Find the followed target in the zoom image, and correct its 3D state by the offset found there.

        A zoom frame newer than the fixed camera's waits until the fixed camera has shown the target at about its time.

        Args:
            frame: frame of the zoom camera; None if there is no new one.
            fixed_t: exposure time of the newest fixed frame [s].
        """
        if not self._closed_loop:
            return None
        if frame is not None:
            self._keep(frame, fixed_t)
        target = self.target
        if target is None:
            self.waiting.clear()
            return None
        due = self._due(fixed_t)
        if due is None or target.filter is None:
            return None
        pose, estimate = self.states.interpolate(due.t), target.estimate(due.t)
        if pose is None or estimate is None:
            return None
        target.unlikely = bool(_contradictions(estimate, self._settings))
        seen = estimate.appearance(pose.pan, pose.tilt, pose.nominal_px)
        if seen is None:
            return None
        found = self._find(due, pose, estimate, seen)
        if found is not None:
            found, size = self._outlined(due, found, seen, estimate.target)
            # Both cameras show the same point, but wings and limbs move it. With the registration's own error alone,
            # the filter would take their beats for motion of the target.
            sigma_px = np.hypot(found.sigma_px, found.body_sigma_px)
            head_sigma = math.hypot(HEAD_SIGMA, pose.sigma, pose.speed * self._settings.time_sigma_s)
            target.filter.add_zoom(
                found.center_px,
                sigma_px,
                pose.pan,
                pose.tilt,
                pose.nominal_px,
                due.t,
                head_sigma=head_sigma,
                time_sigma_s=self.clock.uncorrected_s,
                size=size,
            )
            self.clock.add(target.filter.observations)
        return found

    def expect(self, t: float) -> Appearance | None:
        """Predict how the followed target appears in a zoom frame of time t [s]; None if that is not known."""
        estimate = None if self.target is None else self.target.estimate(t)
        pose = self.states.interpolate(t)
        return None if pose is None or estimate is None else estimate.appearance(pose.pan, pose.tilt, pose.nominal_px)

    def warnings(self, estimate: Estimate | None) -> list[str]:
        """Describe what contradicts the nominal size of the followed target or the calibration, a sentence each.

        Args:
            estimate: estimate of it at the time of the newest fixed frame.
        """
        if estimate is None:
            return []
        found = []
        if wrong := _contradictions(estimate, self._settings):
            found.append(f"the nominal size or the calibration seems wrong: {', '.join(wrong)}")
        if abs(self.clock.corrected_s) > 2 * LEAST_S:
            late = "late" if self.clock.corrected_s > 0 else "early"
            stamps = f"the fixed camera's stamps are {abs(1e3 * self.clock.corrected_s):.0f} ms {late}"
            found.append(f"{stamps} by how the target moves in both views, and are corrected")
        if abs(self.apart_s) > self._matching.latest_s:
            later = "zoom" if self.apart_s < 0 else "fixed"
            apart = f"the {later} one comes {abs(self.apart_s):.2f} s later"
            found.append(f"the cameras are too far apart in time: {apart}")
        elif self.is_overdue:
            unfound = f"for {self.unfound_s:.1f} s not found where the zoom camera should show it"
            found.append(f"{unfound}: it is hidden there, or the nominal size or the calibration is wrong")
        return found

    @property
    def is_overdue(self) -> bool:
        """Whether the zoom image has failed to show the target for too long."""
        return self.unfound_s > self._settings.unfound_s

    @property
    def is_unconfirmed(self) -> bool:
        """Whether the zoom image has failed to show the target even to the widened search."""
        return self.unfound_s > 2 * self._settings.unfound_s

    def _keep(self, frame: Frame, fixed_t: float) -> None:
        """Keep a zoom frame until it is due; fixed_t is the time of the newest fixed frame [s]."""
        self.waiting.append(frame)
        while self.waiting[0].t < frame.t - self._matching.latest_s:
            self.waiting.popleft()
        self.apart_s = frame.t - fixed_t

    def _due(self, fixed_t: float) -> Frame | None:
        """Return the newest zoom frame for which the fixed camera has shown the target; drop it and older ones.

        Args:
            fixed_t: time of the newest fixed frame [s]; frames older than `latest_s` before it are dropped too.
        """
        due = next((each for each in reversed(self.waiting) if self.finder.fixed_view_at(each.t) is not None), None)
        done_t = fixed_t - self._matching.latest_s if due is None else due.t
        while self.waiting and self.waiting[0].t <= done_t:
            self.waiting.popleft()
        return due

    def _find(self, frame: Frame, pose: Pose, estimate: Estimate, seen: Appearance) -> ZoomMeasurement | None:
        """Find the target in a zoom frame.

        Args:
            frame: frame of the zoom camera.
            pose: pan, tilt and focal length at its time.
            estimate: estimate of the target at its time.
            seen: its predicted appearance.
        """
        # With a wrong size or calibration the gate would never contain the target, so it is widened.
        searched = seen
        if self.is_overdue:
            wider = replace(estimate, state_covariance=inflated(estimate.state_covariance, self._filter))
            searched = wider.appearance(pose.pan, pose.tilt, pose.nominal_px) or seen
        true = replace(pose, pan=pose.pan + estimate.bias[0], tilt=pose.tilt + estimate.bias[1])
        head_covariance = np.diag(np.square(pose.sigma * seen.focal_px))
        late_px = self.clock.sigma_s * seen.rate_px
        covariance = searched.covariance + self._matching.least_sigma_px**2 * np.eye(2) + head_covariance
        covariance += np.outer(late_px, late_px)
        found = self.finder.find(frame, estimate.x_fixed, covariance, true)
        self._count_unfound(frame, found, replace(seen, covariance=seen.covariance + head_covariance), estimate)
        return found

    def _outlined(
        self, frame: Frame, found: ZoomMeasurement, seen: Appearance, profile: TargetProfile
    ) -> tuple[ZoomMeasurement, tuple[float, float] | None]:
        """Measure body and wingspan of a target found in a zoom frame by its outline there.

        The fixed camera shows a far bird's body, and a part of a near one before trees. A height is left to the fixed
        camera, which shows feet and shadow apart as well.

        Returns:
            The measurement; the wingspan [tangent] and its relative standard deviation, None where it is not measured.
        """
        outline = None
        if profile.largest_over_time:
            outline = outline_in(frame.image, found.center_px, seen.size_px, self._matching)
        if outline is None:
            return found, None
        width, height = (outline.size_px / seen.focal_px).tolist()
        self._sizes.add(frame.t, (0.0, 0.0), (width, height), clipped=False)
        sigma = math.hypot(1 / float(outline.size_px.max()), 1 / self._matching.fine_samples)
        return outline.refine(found), (self._sizes.larger_side, sigma)

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
    """Keep a `Target` for each track of the fixed camera, and update the filters of the most important ones.

    Args:
        calibration: calibration of the rig, for the streams in use.
        profile: profile of the targets.
        filter: settings of the target filters; by default those of the profile.
        settings: settings of the fusion.

    Attributes:
        targets: targets by id, in the order of the tracks.
        camera: the fixed camera, as the newest frame shows it to be turned.
    """

    def __init__(
        self,
        calibration: Calibration,
        profile: TargetProfile,
        filter: FilterSettings | None = None,
        settings: FusionSettings = FusionSettings(),
    ) -> None:
        self._profile, self._settings = profile, settings
        filter = filter or filter_settings(profile, calibration)
        self._make_filter = partial(TargetFilter, calibration, profile, filter)
        # Longest time in which a target is covered by what it goes behind: half of what its filter keeps [s].
        self._longest_cover_s = filter.history_s / 2
        self.targets: dict[int, Target] = {}
        self.camera = calibration.fixed
        self._lost_view = False

    def add_shift(self, shift_px: Array | None, *, cut: bool) -> None:
        """Turn the fixed camera as its scene has shifted.

        Args:
            shift_px: shift of the scene since the first frame (du, dv) [px], (2,); None if it is not measured.
            cut: whether the newest frame shows another scene than the one before; by how much it was turned is then not
                known.
        """
        self._lost_view |= cut
        turned = self.camera if shift_px is None else self.camera.turned(shift_px)
        # Clouds and foliage move the measured shift by a standard deviation of about a step of the head.
        if math.dist(turned.turn, self.camera.turn) > math.sqrt(GATE) * HEAD_SIGMA:
            self.camera = turned

    def expected(self, target: Target | None, t: float) -> Expected:
        """Predict a target in the fixed image at time t [s], by the id of its track; see `Estimate.in_fixed`."""
        estimate = None if target is None else target.estimate(t)
        found = None if estimate is None else estimate.in_fixed(self.camera)
        return {} if target is None or found is None else {target.id: found}

    def warnings(self) -> list[str]:
        """Describe how the fixed camera has been moved since the first frame, a sentence each."""
        if self._lost_view:
            return ["the fixed camera shows another scene: if it was moved, calibrate again"]
        turn = math.degrees(math.hypot(*self.camera.turn))
        return [f"the fixed camera was turned by {turn:.1g} degrees, and aims follow"] if turn else []

    def add_tracks(
        self,
        frame: Frame,
        tracks: Sequence[Track],
        mask: Image | None,
        searches: Sequence[ZoomSearch] = (),
        favoured: Collection[int] = (),
    ) -> None:
        """Update targets and filters with the tracks of one fixed-camera frame.

        Args:
            frame: frame of the fixed camera.
            tracks: tracks after that frame, the oldest first.
            mask: foreground of the detector, (H, W).
            searches: searches for the followed targets in the zoom images.
            favoured: ids of tracks that get a filter before others.
        """
        before = self.targets.values()
        self.targets = {track.id: self._target(track) for track in tracks}
        kept = self._most_important([search.target for search in searches], favoured)
        for target in before:
            if target not in kept:
                target.filter = None
        for target in kept:
            if target.filter is None:
                target.filter = self._make_filter()
            if target.track.missed:
                self._leave_out_cover(target, frame.t)
                continue
            if _was_part(target):
                target.filter = self._make_filter()
            self._measure(target, frame, mask, [search.finder for search in searches if search.target is target])

    def _target(self, track: Track) -> Target:
        """Find or make the target of a track."""
        known = self.targets.get(track.id)
        if known is None:
            return Target(track)
        known.track = track
        return known

    def _most_important(self, followed: Collection[Target | None], favoured: Collection[int]) -> list[Target]:
        """Select the targets that have a filter, the followed ones first."""

        def last(target: Target) -> tuple[bool, ...]:
            return (
                target not in followed,
                target.id not in favoured,
                not target.track.confirmed,
                target.filter is None,  # a new track must not displace a filter in use
            )

        return sorted(self.targets.values(), key=last)[: self._settings.most_filters]

    def _leave_out_cover(self, target: Target, t: float) -> None:
        """Leave out what was observed while the target went behind something, once it is behind it.

        The part that was left of it moved more slowly than the target. That began before the boxes were small enough to
        count as parts of it: as long again before.

        Args:
            target: target out of sight.
            t: time of the newest fixed frame [s].
        """
        assert target.filter is not None, "who is kept has one"
        seen_t = target.track.seen_t
        cover_s = min(2 * (seen_t - target.part_since_t), self._longest_cover_s)
        if t - seen_t > cover_s > 0:
            target.filter = target.filter.without(seen_t - cover_s, seen_t)

    def _measure(self, target: Target, frame: Frame, mask: Image | None, finders: Sequence[Finder]) -> None:
        """Add a target's newest detection to its filter.

        Of a followed target, the body point is measured that the zoom image shows too, in place of the box's centre.

        Args:
            target: target that the frame shows.
            frame: frame of the fixed camera.
            mask: foreground of the detector, (H, W).
            finders: finders of the heads that follow it.
        """
        assert target.filter is not None, "who measures has made one"
        track, box, sigma_px, size_px = target.track, target.track.box, None, None
        lacks = missing(track.size_px, box.size_px)
        if lacks.any() or missing(target.whole_px, box.size_px).any():
            target.part_since_t = min(target.part_since_t, frame.t)
        else:
            target.part_since_t, target.whole_px = math.inf, track.size_px
        if track.shared:  # its box covers other targets too: it bounds the place and shows no size
            sigma_px = np.hypot(room_inside(box.size_px, track.size_px), track.size_px / 2)
            box = Detection(track.center_px, np.zeros(2), track.score, clipped=True)
        elif lacks.any():  # a part of the target: no size, and a poor centre
            sigma_px, box = np.hypot(lacks, box.size_px) / 2, replace(box, clipped=True)
        else:
            size_px = track.larger_side_px if self._profile.largest_over_time else None
            for view in (finder.store(frame, track.box, mask) for finder in finders):
                if view is None:
                    continue
                box, sigma_px = replace(track.box, center_px=view.body_px), view.body_sigma_px
                if self._profile.matcher == "upright":  # a box without the feet has its middle too high
                    upright = np.array([math.sin(view.turn), math.cos(view.turn)])
                    sigma_px = np.hypot(sigma_px, upright * (box.size_px - track.size_px) / 2)
        target.filter.add_fixed(box, frame.t, sigma_px=sigma_px, size_px=size_px, camera=self.camera)


def _was_part(target: Target) -> bool:
    """Note the box's area; tell whether the boxes so far were of a part of the target, such as a hand."""
    box, largest = target.track.box, target.largest_area_px
    area = float(box.size_px.prod())
    was_part = largest is not None and area >= LARGEST_AREA_RATIO * largest
    if was_part:
        target.largest_area_px = None
    if not box.clipped and not target.track.shared:
        target.largest_area_px = max(area, target.largest_area_px or 0.0)
    return was_part


def _contradictions(estimate: Estimate, settings: FusionSettings) -> list[str]:
    """Describe where size and head bias, as both cameras show them, contradict their priors."""
    wrong = []
    if abs(estimate.size_deviation) > settings.contradicted:
        wrong.append(f"both views make it {estimate.size:.2g} m and not {estimate.target.size:.2g} m")
    if estimate.bias_deviation > settings.contradicted:
        wrong.append(f"the head points {math.degrees(math.hypot(*estimate.bias)):.2g} degrees beside")
    return wrong
