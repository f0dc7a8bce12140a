"""What is known of every track in 3D, and what both cameras show of the one that is followed.

Each track of the wide view has a filter of its own; the one followed is besides looked for in the zoom view, which
triangulates its depth and shows any error of head or calibration.

Where head and lens were when a frame was exposed, which is earlier than the newest that their devices have told.
"""

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import TargetConfig
from cotarget.control.selection import Candidate, leaves_in
from cotarget.control.zoom import is_seen_well, shape_of
from cotarget.detection import Detection
from cotarget.estimation import Appearance, Estimate, TargetFilter, estimation_settings_for
from cotarget.estimation.motion_model import PAN, TILT, K, L
from cotarget.estimation.zoom_matching import LATEST_S, CloseupFinder, Expected, Finder, ZoomMeasurement
from cotarget.geometry import Array
from cotarget.pantilt import towards
from cotarget.rig import Frame, Image, PanTiltState, ZoomState
from cotarget.tracking.track import Track, missing, room_inside

REMEMBERED_S = 2.0  # more than any latency [s]
# A cubic through the two states before a time and the two after it: the head's acceleration is constant for longer than
# states are apart. Where that changes, it is off by 0.024 degrees for states 40 ms apart, a straight line by 0.041.
POINTS = 4
# States are kept no nearer together than this [s]: through two that are, a cubic shows their rounding many times over.
SPACING_S = 0.01


@dataclass(frozen=True)
class Pose:
    """Head and lens at one time.

    Attributes:
        pan: [rad].
        tilt: [rad].
        nominal_px: what the lens told [px].
        speed: of the head, both axes together [rad/s].
    """

    pan: float
    tilt: float
    nominal_px: float
    speed: float


class StateHistory:
    """The latest states of head and lens, each with its own time."""

    def __init__(self) -> None:
        self._heads: deque[tuple[float, ...]] = deque()
        self._lenses: deque[tuple[float, ...]] = deque()

    def add(self, head: PanTiltState, lens: ZoomState) -> None:
        """Remember what both devices say now; one that says the time of before is ignored."""
        _append(self._heads, (head.t, head.pan, head.tilt))
        _append(self._lenses, (lens.t, math.log(lens.focal_px)))

    def at(self, t: float) -> Pose | None:
        """Head and lens at a time [s]; None for one that is not between states remembered."""
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
    """The states nearest to a time, at most `POINTS`, as rows."""
    after = bisect_right(kept, t, key=lambda state: state[0])
    first = min(max(after - POINTS // 2, 0), max(len(kept) - POINTS, 0))
    return np.array([kept[i] for i in range(first, min(first + POINTS, len(kept)))])


def _cubic(times: Array, t: float) -> tuple[Array, Array]:
    """Weights of values at those times for the value at t and for its derivative there (Lagrange), (n,) each."""
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


# Of more tracks than these only the first have a filter; there is no telling a hundred moving things apart.
MOST_FILTERS = 12
# The time of a frame, of the head's state and of the lens's are known to each other this well [s].
TIME_SIGMA_S = 2e-3
# A size or a head's bias that is this many times what was assumed is no chance; a right one comes to 1 or 2.
WRONG = 4.0
# Whoever is in both views and yet not found in the zoom view for so long is not where he is thought to be [s]. A bird
# that is where it should be was missed for 0.8 s at most, a person or a book for a frame or two.
UNFOUND_S = 1.5
# Then he is looked for as far around as this leaves: standard deviations of size and depth together, and of the head's
# bias [rad]. A size told twice too large is 0.7.
INFLATED_SIZE, INFLATED_BIAS = 0.4, 5e-3
# A find so near to where it was expected, in standard deviations, is no surprise.
NEAR = 3.0
# So long after the wide view has shown it a target may have gone elsewhere [s].
JUST_SEEN_S = 0.2
# Of more zoom frames than these the oldest wait no longer for the wide view of their time.
MOST_WAITING = 30
MakeFinder = Callable[[Calibration, TargetConfig], Finder]


class TargetFusion:
    """The filters of all tracks, from one frame to the next.

    Args:
        calibration: of the rig, for the streams in use.
        target: what is followed.
        size: (width, height) of the wide view [px].
        closed_loop: whether the target is looked for in the zoom view too.
        finder: makes what looks for it there, anew for each target that is followed.
    """

    def __init__(
        self,
        calibration: Calibration,
        target: TargetConfig,
        size: tuple[int, int],
        *,
        closed_loop: bool = True,
        finder: MakeFinder = CloseupFinder,
    ) -> None:
        self._calibration, self._target, self._size = calibration, target, size
        self._closed_loop, self._make_finder = closed_loop, finder
        self._assumed = estimation_settings_for(target, calibration)
        self._filters: dict[int, TargetFilter] = {}
        self._seen_s: dict[int, float] = {}
        self._unlikely: set[int] = set()
        self._followed: int | None = None
        self._zoom_t = math.inf
        self._unfound_s = 0.0
        self._finder = finder(calibration, target)
        self._waiting: deque[Frame] = deque(maxlen=MOST_WAITING)  # zoom frames without a wide view of their time
        self._apart_s = 0.0  # by which the newest zoom frame was newer than the newest wide one
        self._to_base = calibration.T_base_fixed
        self.states = StateHistory()

    def update_fixed(
        self, frame: Frame, tracks: Sequence[Track], mask: Image | None, favoured: Collection[int] = ()
    ) -> None:
        """Take a frame of the wide view into account.

        Args:
            frame: the frame.
            tracks: after it, the eldest first.
            mask: the detector's foreground, (H, W).
            favoured: numbers of tracks that have a filter before others.
        """

        def last(track: Track) -> tuple[bool, ...]:
            return (
                track.id != self._followed,
                track.id not in favoured,
                not track.confirmed,
                track.id not in self._filters,  # or else who is known would be forgotten for somebody new
            )

        known = sorted(tracks, key=last)[:MOST_FILTERS]
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
            if track.shared:  # it is inside of what covers others too, and the finder would learn those
                inside = Detection(track.center_px, np.zeros(2), track.score, clipped=True)  # this frame shows no size
                room = room_inside(box.size_px, track.size_px)
                found.update_fixed(inside, frame.t, sigma_px=np.hypot(room, track.size_px / 2))
                continue
            lacks = missing(track.size_px, box.size_px)
            if lacks.any() and isinstance(box, Detection):  # a piece of it, which tells no size and its middle badly
                sigma_px = np.hypot(lacks, box.size_px) / 2
                found.update_fixed(replace(box, clipped=True), frame.t, sigma_px=sigma_px)
                continue
            if track.id == self._followed and isinstance(box, Detection):
                sight = self._finder.update_fixed(frame, box, mask)
                if sight is not None:  # the very point that both views show
                    box, sigma_px = replace(box, center_px=sight.body_px), sight.body_sigma_px
            size_px = track.larger_side_px if self._target.dimension == "wingspan" else None
            found.update_fixed(box, frame.t, sigma_px=sigma_px, size_px=size_px)

    def update_zoom(self, frame: Frame | None, wide_t: float) -> ZoomMeasurement | None:
        """Look for the followed target in the zoom view, and take it into account where it is found.

        A frame that is newer than the wide view waits until that has shown the target at about its time.

        Args:
            frame: of the zoom view; None where there is no new one.
            wide_t: when the newest wide frame was exposed [s].
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
        done_t = (
            wide_t - LATEST_S if due is None else due.t
        )  # what is older was not seen then, or will not be looked at
        while self._waiting and self._waiting[0].t <= done_t:
            self._waiting.popleft()
        return None if due is None else self._look_close(due)

    def _look_close(self, frame: Frame) -> ZoomMeasurement | None:
        """Look for the followed target in a frame of whose time the wide view has shown it."""
        assert self._followed is not None, "who asks has looked"
        pose, estimate = self.states.at(frame.t), self.estimate(self._followed, frame.t)
        if pose is None or estimate is None:
            return None
        if _contradicted(estimate):
            self._unlikely.add(self._followed)
        else:
            self._unlikely.discard(self._followed)
        seen = estimate.appearance(pose.pan, pose.tilt, pose.nominal_px)
        if seen is None:
            return None
        # The wrong size, or a wrong calibration, has it looked for beside where it is, and never be found.
        inflated = _inflated(estimate).appearance(pose.pan, pose.tilt, pose.nominal_px) if self._overdue else None
        pan, tilt = pose.pan + estimate.bias[0], pose.tilt + estimate.bias[1]
        covariance = (seen if inflated is None else inflated).covariance
        found = self._finder.find(frame, Expected(estimate.x_fixed, covariance, pan, tilt, pose.nominal_px))
        self._count_unfound(frame, found, seen, estimate)
        if found is not None:
            self._filters[self._followed].update_zoom(
                found.center_px,
                # Both views show the same point, but wings and limbs move it: with its own error alone, each of their
                # beats would be the target's.
                np.hypot(found.sigma_px, found.body_sigma_px),
                pose.pan,
                pose.tilt,
                pose.nominal_px,
                frame.t,
                head_sigma=math.hypot(self._assumed.head_sigma, pose.speed * TIME_SIGMA_S),
            )
        return found

    @property
    def _overdue(self) -> bool:
        """Whether the zoom view should have shown the target long since."""
        return self._unfound_s > UNFOUND_S

    def _count_unfound(self, frame: Frame, found: ZoomMeasurement | None, seen: Appearance, estimate: Estimate) -> None:
        """Note for how long the target was not where the zoom view should show it."""
        passed, self._zoom_t = min(max(frame.t - self._zoom_t, 0.0), JUST_SEEN_S), frame.t
        size = np.array(frame.image.shape[1::-1])
        if found is not None:
            off = found.center_px - (size - 1) / 2 - seen.offset_px
            spread = seen.covariance + np.diag(np.square(found.sigma_px) + np.square(found.body_sigma_px))
            if float(off @ np.linalg.solve(spread, off)) <= NEAR**2:
                self._unfound_s = 0.0
                return
        wholly = np.all(np.abs(seen.offset_px) + seen.size_px / 2 <= size / 2)
        if wholly and frame.t - estimate.measured_t <= JUST_SEEN_S:
            self._unfound_s += passed

    def warnings(self, number: int, t: float) -> list[str]:
        """What speaks against what was told of a target, or against the calibration, in words.

        Args:
            number: of the track that is followed.
            t: the time [s].
        """
        estimate = self.estimate(number, t)
        if estimate is None:
            return []
        found = []
        if wrong := _contradicted(estimate):
            found.append(f"the told size or the calibration seems wrong: {', '.join(wrong)}")
        if number == self._followed and abs(self._apart_s) > LATEST_S:
            later = "zoom" if self._apart_s < 0 else "wide"
            found.append(f"the views are too far apart in time: the {later} one comes {abs(self._apart_s):.2f} s later")
        elif number == self._followed and self._overdue:
            found.append(
                f"for {self._unfound_s:.1f} s not found where the zoom view should show it: it is hidden there, or the "
                "told size or the calibration is wrong"
            )
        return found

    def follow(self, number: int | None) -> None:
        """Look for another track in the zoom view from now on."""
        if number != self._followed:
            self._followed, self._unfound_s = number, 0.0
            self._finder = self._make_finder(self._calibration, self._target)

    def count_seen_well(self, track: Track, seconds: float, longest_px: float) -> None:
        """Note whether a track was well in the close-up, by where head and lens have told that they were at its time.

        Args:
            track: as the newest wide frame has it.
            seconds: for how long [s] it counts.
            longest_px: longest focal length, as the lens tells it [px].
        """
        pose, estimate = self.states.at(track.t), self.estimate(track.id, track.t)
        if pose is None or estimate is None or track.t - estimate.measured_t > JUST_SEEN_S:
            return
        if is_seen_well(estimate, pose.pan, pose.tilt, pose.nominal_px, longest_px, shape=shape_of(track)):
            self._seen_s[track.id] = self._seen_s.get(track.id, 0.0) + seconds

    def estimate(self, number: int, t: float) -> Estimate | None:
        """A track at a time [s]; None where it is not known."""
        found = self._filters.get(number)
        return None if found is None else found.at(t)

    def candidates(self, tracks: Sequence[Track], t: float) -> list[Candidate]:
        """What a policy chooses from, at a time [s]: the confirmed tracks."""
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
        """Pan and tilt of a target as seen from the head, (2,) [rad], the zoom camera's place on it aside."""
        estimate = known.at(t + later)
        assert estimate is not None, "what is known at a time is known later"
        return np.array(towards(self._to_base.apply(estimate.x_fixed)))


def _contradicted(estimate: Estimate) -> list[str]:
    """What both views together make other than it was told or calibrated, in words."""
    wrong = []
    if abs(estimate.size_deviation) > WRONG:
        wrong.append(f"both views make it {estimate.size:.2g} m and not {estimate.target.size:.2g} m")
    if estimate.bias_deviation > WRONG:
        wrong.append(f"the head points {math.degrees(math.hypot(*estimate.bias)):.2g} degrees beside")
    return wrong


def _inflated(estimate: Estimate) -> Estimate:
    """The same estimate, as if size and head were hardly known: their ratio to the depth is what the wide view sees."""
    P = estimate.state_covariance.copy()
    P[np.ix_([L, K], [L, K])] += INFLATED_SIZE**2
    P[[PAN, TILT], [PAN, TILT]] += INFLATED_BIAS**2
    return replace(estimate, state_covariance=P)
