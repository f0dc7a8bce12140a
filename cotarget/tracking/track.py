"""Filter one track in the image: constant velocity in (u, v), with histories of size and travel.

The Kalman filter is driven by white acceleration, so frames may come at any times. Neither motion nor measurement mixes
u and v, so each coordinate has a filter of its own. They compute in floats: numpy takes ten times as long for so few
numbers, and every track has two of them in every frame. Users of the tracker see a frozen `Track`.
"""

import bisect
import math
import statistics
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np

from cotarget.config import TargetProfile
from cotarget.geometry import Array
from cotarget.rig import Detection

Covariance = tuple[float, float, float]  # of a coordinate and its velocity: variance, covariance, velocity's variance


class AxisFilter:
    """Kalman filter of one image coordinate [px] and its velocity [px/s]."""

    def __init__(self, position: float, variance: float, velocity_variance: float) -> None:
        self.position, self.velocity = position, 0.0
        self.P: Covariance = (variance, 0.0, velocity_variance)

    def predict(self, dt: float, process_noise: float) -> None:
        """Predict ``dt`` [s] ahead with white acceleration [px^2/s^3]."""
        self.position += dt * self.velocity
        self.P = self.predicted_covariance(dt, process_noise)

    def predicted_covariance(self, dt: float, process_noise: float) -> Covariance:
        """Predict the covariance over ``dt`` [s], forward or back, with white acceleration [px^2/s^3]."""
        span, (position, cross, velocity) = abs(dt), self.P
        return (
            position + dt * (2 * cross + dt * velocity) + process_noise * span**3 / 3,
            cross + dt * velocity + process_noise * dt * span / 2,
            velocity + process_noise * span,
        )

    def correct(self, measured: float, variance: float) -> None:
        """Correct with a measurement [px] and its variance [px^2]."""
        position, cross, velocity = self.P
        S = position + variance
        innovation, gain, velocity_gain = measured - self.position, position / S, cross / S
        self.position += gain * innovation
        self.velocity += velocity_gain * innovation
        self.P = position - gain * position, cross - gain * cross, velocity - velocity_gain * cross

    def correct_velocity(self, measured: float, variance: float) -> None:
        """Correct the velocity of a new filter with a measured one [px/s] and its variance [px^2/s^2]."""
        position, cross, velocity = self.P
        gain = velocity / (velocity + variance)
        self.velocity += gain * (measured - self.velocity)
        self.P = position, cross, velocity - gain * velocity


# Areas that differ by more than this factor are those of different objects, or of a part and its object: a bird and a
# cloud, a hand and its person. Each person of a group has a larger part of the group's box.
LARGEST_AREA_RATIO = 10.0


# Histories of a track's size and travel

# Window of the larger side [s]: a slow wing beat. With a longer one a bird that flies off counts as nearer than it is.
BEAT_S = 0.5
# Quantile of a side that counts as its maximum, robust against one wrong frame in ten.
BEAT_PART = 0.9
# Largest part of the travel in one step; beyond it the outline jumped to that of another thing.
LARGEST_STEP = 2 / 3
Edges = tuple[float, float]


class TrailBox(NamedTuple):
    """A box of a trail.

    Attributes:
        t: time [s].
        edges: low and high edge along u and v in the scene [px].
        step: motion since the box before [px].
        area: area [px^2]; inf for a clipped box, whose visible edges are the target's.
    """

    t: float
    edges: tuple[Edges, Edges]
    step: float
    area: float


class SizeHistory:
    """Usual and largest size of a track, from its last boxes.

    Attributes:
        size: usual width and height [px], (2,).
        larger_side: largest of the larger sides over a wing beat [px].
    """

    def __init__(self, span_s: float, trend: bool = False, kept_s: float = 0.0) -> None:
        """Create a history without boxes.

        Args:
            span_s: window of the usual size [s], at least a wing beat.
            trend: whether the newest count more where the target grows or shrinks.
            kept_s: longest window of the whole, see `whole` [s].
        """
        self._span_s, self._trend, self._kept_s = span_s, trend, max(span_s, kept_s)
        self._boxes: deque[tuple[float, tuple[float, float], bool]] = deque()  # time, size, whether it is clipped
        self.size: Array = np.zeros(2)
        self.larger_side = 0.0

    def whole(self, span_s: float) -> Array:
        """Width and height of the whole target [px], (2,): of what flies the largest in a time [s], else the usual."""
        return self.size if self._trend else self._largest(self._boxes[-1][0] - span_s)

    def _largest(self, begin: float = -math.inf) -> Array:
        """Largest width and height since a time [s], but the usual ones at least [px], (2,)."""
        sides = zip(*(size for t, size, _ in self._boxes if t >= begin), strict=True)
        return np.maximum(self.size, [_quantile(lengths, BEAT_PART) for lengths in sides])

    def forget_pieces(self) -> None:
        """Forget the newest boxes that show a piece of the target, because it has gone behind something."""
        least = PIECE * self._largest()
        while len(self._boxes) > 1 and (self._boxes[-1][1] < least).any():
            self._boxes.pop()
        self._update()

    def skip(self, seconds: float) -> None:
        """Let a time out of sight [s] make no box older."""
        self._boxes = deque((t + seconds, size, clipped) for t, size, clipped in self._boxes)

    def add(self, t: float, center: tuple[float, float], size: tuple[float, float], clipped: bool) -> None:
        """Add a box, see `Trail.add`, and update the sizes."""
        self._boxes.append((t, size, clipped))
        while self._boxes[0][0] < t - self._kept_s:
            self._boxes.popleft()
        self._update()

    def _update(self) -> None:
        """Compute the sizes from the boxes."""
        boxes = [box for box in self._boxes if box[0] >= self._boxes[-1][0] - self._span_s]
        # The border makes boxes smaller: the uncut ones count, or else the largest of the cut ones. One that is far
        # smaller than a cut one shows a part that was seen first, such as a hand.
        largest = max((math.prod(sides) for _, sides, is_cut in boxes if is_cut), default=0.0)
        whole = [box for box in boxes if not box[2] and LARGEST_AREA_RATIO * math.prod(box[1]) >= largest]
        times, sizes, _ = zip(*(whole or boxes), strict=True)
        middle = statistics.median if whole else max
        usual = _newest(sizes) if self._trend else sizes
        self.size = np.array([middle(lengths) for lengths in zip(*usual, strict=True)])
        beat = sizes[bisect.bisect_left(times, times[-1] - BEAT_S) :]
        self.larger_side = _quantile([max(sides) for sides in beat], BEAT_PART)


def _newest(boxes: Sequence[tuple[float, float]]) -> Sequence[tuple[float, float]]:
    """Of sizes in the order of time, those that are usual now: all, or the last third if the target grows or shrinks.

    It does if the newer half is beyond the older one in width and height: limbs and wings change one, to and fro.
    """
    half = len(boxes) // 2
    if half < 3:
        return boxes
    older, newer = (list(zip(*part, strict=True)) for part in (boxes[:half], boxes[half:]))  # widths, and heights
    sides = list(zip(older, map(statistics.median, newer), strict=True))
    grows, shrinks = all(now > max(was) for was, now in sides), all(now < min(was) for was, now in sides)
    return boxes[-(len(boxes) // 3) :] if grows or shrinks else boxes


class Trail:
    """Travel of a track, from its last boxes."""

    def __init__(self, span_s: float, image_size: tuple[int, int] | None = None) -> None:
        """Create a history without boxes.

        Args:
            span_s: window of the travel [s].
            image_size: (width, height) [px]; with it, only the visible edges of a clipped box count.
        """
        self._span_s = span_s
        self._extents = image_size or (None, None)
        self._boxes: list[TrailBox] = []

    def add(
        self,
        t: float,
        center: tuple[float, float],
        size: tuple[float, float],
        clipped: bool,
        shift: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Add a box, and forget whole boxes that showed only a part of the target.

        Args:
            t: time of the frame [s].
            center: centre of the box (u, v) [px].
            size: width and height of the box [px].
            clipped: whether the image's border cuts the box.
            shift: shift of the scene since the first box (du, dv) [px].
        """
        across, down = (_edges(*of, clipped) for of in zip(center, size, self._extents, shift, strict=True))
        begin, area = t - self._span_s, math.prod(size)
        self._boxes = [box for box in self._boxes if box.t >= begin and LARGEST_AREA_RATIO * box.area >= area]
        step = _common_motion([self._boxes[-1].edges], [(across, down)]) if self._boxes else 0.0
        self._boxes.append(TrailBox(t, (across, down), step, math.inf if clipped else area))

    def travel(self) -> float:
        """Compute how far the target has moved, edge by edge [px]; 0 if it jumped.

        Both edges of a moving target move the same way. A cloud or a shadow that drifts slowly behind others grows,
        shrinks and falls apart, which moves its centre, while an edge or two stay.
        """
        edges, steps = [box.edges for box in self._boxes], [box.step for box in self._boxes]
        count = max(1, min(3, len(edges) // 3))  # medians of three, because outlines flicker
        way = _common_motion(edges[:count], edges[-count:])
        longest = max(steps[1:], default=0.0)
        return way if longest <= LARGEST_STEP * way else 0.0


def _edges(center: float, size: float, extent: int | None, shift: float, clipped: bool) -> Edges:
    """Low and high edge of a box along one axis, where they were before the scene moved by ``shift`` [px].

    Of a clipped box, an edge in the outermost pixel is nan.
    """
    low, high = center - size / 2, center + size / 2
    if clipped and extent is not None:
        low, high = low if low > 0.5 else math.nan, high if high < extent - 1.5 else math.nan
    return low - shift, high - shift


def _common_motion(before: Sequence[tuple[Edges, Edges]], after: Sequence[tuple[Edges, Edges]]) -> float:
    """Length of the common motion of both edges between two groups of boxes [px]; of one edge if only that is seen.

    It is 0 of what goes back behind the border that has cut it from the first: a cloud that a tilting camera covers.
    """
    along = [_shift([box[i] for box in before], [box[i] for box in after]) for i in range(2)]
    return math.hypot(*along) if min(along) >= 0 else 0.0


def _shift(before: Sequence[Edges], after: Sequence[Edges]) -> float:
    """Common motion of both edges along one axis [px]; 0 if they move in opposite directions.

    It is negative if the border cuts one edge in the first group, and the other moves to that border.
    """
    was, now = (
        [[side for side in sides if not math.isnan(side)] for sides in zip(*g, strict=True)] for g in (before, after)
    )
    moved = [statistics.median(n) - statistics.median(w) for w, n in zip(was, now, strict=True) if w and n]
    if not moved or min(moved) < 0 < max(moved):
        return 0.0
    recedes = (not was[0] and moved[0] < 0) or (not was[1] and moved[0] > 0)
    return -abs(moved[0]) if recedes else min(map(abs, moved))


def _quantile(values: Iterable[float], part: float) -> float:
    """Quantile with linear interpolation; numpy takes forty times as long."""
    ordered = sorted(values)
    at = part * (len(ordered) - 1)
    low = int(at)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (at - low) * (ordered[high] - ordered[low])


Sides = TypeVar("Sides", Array, float)
# Error of a clipped box's centre, in parts of the box: the hidden part may be as large again.
CUT = 0.5
# A box smaller than this part of its target's usual size shows an unknown part of it.
PIECE = 0.7


# Width of the images for which the settings hold [px].
USUAL_WIDTH_PX = 640


@dataclass(frozen=True)
class TrackingSettings:
    """Settings of the image filter, of a track's life cycle and of the association.

    Attributes:
        process_noise: spectral density of the white acceleration in the image [px^2/s^3].
        noise_px: standard deviation of a detection's centre, the part independent of its size [px].
        noise_of_size: the part proportional to the box's side, from moving limbs and wings.
        speed_px: least standard deviation of a new track's speed [px/s].
        speed_sides: that deviation in larger sides of its box [1/s]: what is nearer is larger and faster.
        confirm_hits: fewest detections of a confirmed track.
        confirm_travel: least travel of a confirmed track, in larger sides of its box; 0 if it may stand still.
        least_travel: least travel of a confirmed track, in parts of the image's width.
        travel_s: window of that travel, and of the whole of what flies, of which pieces are seen for a second [s].
        confirm_score: least average score of a confirmed track, the last detections weighted most; 0 for any. With
            `confirm_travel` too, half of it is enough for a track that has travelled.
        start_score: a detection with a lower score neither begins nor prolongs a track; a confirmed one follows it for
            `lose_s`.
        score_s: time constant of the average score [s]; a new track begins at 0.
        lose_s: time without such a detection after which a confirmed track ends [s]; its age if that is less.
        drop_s: time without a detection after which an unconfirmed track ends, and any after a cut of the film [s].
        size_s: window of the size's median, some two wing beats [s].
        trend: whether the size follows a target that grows or shrinks. Wings look as if it did.
        gate: gate on the squared Mahalanobis distance of place and size, 99.9 % of a chi-square with three degrees of
            freedom.
        size_sigma: standard deviation of the logarithm of a box's side: wings, limbs and occluders make it half or
            twice as large. A twig that appears where a bird has gone behind a tree is smaller still.
        newcomers_hz: rate of new objects anywhere in the image [1/s]. A detection must more likely be the missing
            target than a new object, because after 0.8 s the gate reaches over 250 px. Real films of birds and people
            have up to 4 a second; below 1, tracks jump to other targets, and from 8 on, hidden birds are not found
            again.
        overlap_enough: overlap from which a box may belong to a track even outside the gate: the target merged with
            something else, or stopped.
        covered: a detection that covers this part of a track's predicted box explains the track, even if another has
            won it, but not if it is much larger and the track has just been found.
        most_detections: most detections of a frame that are used: snow, rain or flicker must not delay the next frame.
            Real films of birds and of a dozen people have up to 10.
    """

    process_noise: float = 6750.0
    noise_px: float = 0.4
    noise_of_size: float = 0.06
    speed_px: float = 120.0
    speed_sides: float = 3.0
    confirm_hits: int = 4
    confirm_travel: float = 0.0
    least_travel: float = 0.0
    travel_s: float = 2.0
    confirm_score: float = 0.0
    start_score: float = 0.0
    score_s: float = 0.3
    lose_s: float = 0.8
    drop_s: float = 0.13
    size_s: float = 0.6
    trend: bool = True
    gate: float = 16.3
    size_sigma: float = 0.5
    newcomers_hz: float = 2.0
    overlap_enough: float = 0.3
    covered: float = 0.5
    most_detections: int = 100

    def scaled(self, width: int) -> "TrackingSettings":
        """Scale speed and acceleration, which are those in an image of 640 px, to a larger width [px].

        The noise of a detection's centre is that of its outline, in pixels of any image.
        """
        factor = max(1.0, width / USUAL_WIDTH_PX)
        return replace(self, speed_px=factor * self.speed_px, process_noise=factor**2 * self.process_noise)


# Settings that differ from the defaults, by the target's motion model and by the detector. The centre of a box jitters
# with limbs and wings. A small target may hover, so its score decides and not its travel.
BY_MOTION: Mapping[str, Mapping[str, float]] = {
    "standing": {"noise_of_size": 0.04},
    "walking": {"noise_of_size": 0.04},
    "flying": {"noise_of_size": 0.2, "process_noise": 18750.0, "trend": False},
    "general": {},
}
AUTO: Mapping[str, float] = {"confirm_score": 0.5, "confirm_travel": 0.25, "least_travel": 0.03, "start_score": 0.05}
BY_DETECTOR: Mapping[str, Mapping[str, float]] = {
    "colour": {"noise_px": 0.2, "noise_of_size": 0.01, "newcomers_hz": 0.2},
    "auto": AUTO,
    "motion": AUTO,
    "speck": AUTO,
    "mog2": {"confirm_travel": 0.5},
}


def tracking_settings(target: TargetProfile) -> TrackingSettings:
    """Choose the tracker's settings for a target profile.

    A colour is located to a fraction of a pixel. What moves need not be the target, so tracks of `mog2` must travel
    before they are confirmed; those of `auto` have a score, or half of it and travel.
    Detections of a user's own detector are confirmed by their number alone.
    """
    by_detector = BY_DETECTOR.get(target.detector, {})
    return TrackingSettings(**{**BY_MOTION[target.motion], **by_detector})  # type: ignore[arg-type]


@dataclass(frozen=True)
class Track:
    """State of one track at time ``t``.

    Attributes:
        id: number of the track, from 1, never reused.
        t: time of this state [s].
        confirmed: whether the track is consistent enough to be followed.
        missed: frames since its last detection; 0 if the last frame had one.
        center_px: filtered centre (u, v), (2,).
        velocity_px: velocity (du, dv) [px/s], (2,).
        size_px: filtered width and height, (2,).
        whole_px: width and height with wings and rotors: of what flies the largest over a wing beat, else `size_px`.
        larger_side_px: larger side over the last wing beat [px].
        covariance: covariance of (u, v, du, dv), (4, 4).
        score: score of the last detection, 0 to 1.
        box: the last detection.
        shared: whether that detection covers other tracks too, so that it only bounds this one's place.
        seen_t: time of that detection [s].
        hidden: whether it is out of sight for longer than a track lives without an expected place.
        sure: whether its score alone makes it a target, and not only with its travel: a cloud travels too.
    """

    id: int
    t: float
    confirmed: bool
    missed: int
    center_px: Array
    velocity_px: Array
    size_px: Array
    whole_px: Array
    larger_side_px: float
    covariance: Array
    score: float
    box: Detection
    shared: bool = False
    seen_t: float = -math.inf
    hidden: bool = False
    sure: bool = True

    @property
    def reported(self) -> bool:
        """Whether it is confirmed, and seen or predicted to within its box, by one standard deviation."""
        variance = max(self.covariance[0, 0], self.covariance[1, 1])
        return self.confirmed and (not self.missed or bool(variance <= (self.size_px.max() / 2) ** 2))

    @property
    def shape(self) -> float:
        """Width over height of its usual box."""
        width, height = self.size_px.tolist()
        return float(width / height)


class LiveTrack:
    """One track while it lives: image filter, histories and life cycle."""

    def __init__(
        self,
        number: int,
        detection: Detection,
        t: float,
        settings: TrackingSettings,
        image_size: tuple[int, int] | None = None,
    ) -> None:
        self.number = number
        self.settings = settings
        self.t = self.born = self.seen = self.believed = t  # believed: by a detection of `start_score`
        self.detection, self.shared = detection, False
        self.hits = 1
        self.missed = 0
        self.confirmed = False
        self.after_cut = False  # whether the film was cut since the last detection
        self.expected = False  # whether the place in this frame is known from elsewhere
        self._image_size = image_size
        self.mean_score = 0.0
        self._sizes = SizeHistory(settings.size_s, settings.trend, settings.travel_s)
        # Travel is needed until the track is confirmed, and only if the settings ask for it.
        self._trail = Trail(settings.travel_s, image_size) if settings.confirm_travel else None
        self._shift = (0.0, 0.0)  # of the scene since the first detection [px]
        self._add_box(detection)
        self._first = self._edges(detection)
        self._whole = not detection.clipped  # whether any box was not clipped
        self._axes = self._begin(detection)

    @property
    def center(self) -> tuple[float, float]:
        """Centre (u, v) [px]."""
        u, v = self._axes
        return u.position, v.position

    @property
    def center_variance(self) -> tuple[float, float]:
        """Variances of the centre along u and v, which are uncorrelated [px^2]."""
        u, v = self._axes
        return u.P[0], v.P[0]

    @property
    def size(self) -> Array:
        """Usual width and height [px], (2,)."""
        return self._sizes.size

    @property
    def whole(self) -> Array:
        """Width and height of the whole target, of which a piece may be seen now [px], (2,)."""
        return self._sizes.whole(self.settings.travel_s)

    def predict(self, t: float) -> None:
        """Predict the track at time ``t`` [s]."""
        for axis in self._axes:
            axis.predict(t - self.t, self.settings.process_noise)
        self.t = t

    def expect(self, state: Array, covariance: Array) -> None:
        """Take over a predicted (u, v, du, dv), (4,) [px, px/s], and its covariance, (4, 4)."""
        for i, axis in enumerate(self._axes):
            axis.position, axis.velocity = float(state[i]), float(state[i + 2])
            axis.P = float(covariance[i, i]), float(covariance[i, i + 2]), float(covariance[i + 2, i + 2])
        if self.hidden:
            self._sizes.forget_pieces()

    def move(self, by: Array) -> None:
        """Move with the scene, by (du, dv) [px], because the camera has turned."""
        if not by.any():
            return
        for axis, shift in zip(self._axes, by.tolist(), strict=True):
            axis.position += shift
        (u, v), (du, dv) = self._shift, by.tolist()
        self._shift = u + du, v + dv

    def correct(self, detection: Detection) -> None:
        """Correct with a detection of this track alone."""
        if self.hidden:
            self._sizes.skip(self.t - self.seen)
        weight = 1 - math.exp(-(self.t - self.seen) / self.settings.score_s)
        self.mean_score += weight * (detection.score - self.mean_score)
        if self._whole:
            self._measure(detection.center_px.tolist(), self.variance(detection))
        else:
            self._axes = self._begin(detection)
            self._whole = not detection.clipped
        self._found(detection.score)
        self._add_box(detection)
        self.detection, self.shared = detection, False
        self.hits += 1
        if not self.confirmed:
            self.confirmed = self.hits >= self.settings.confirm_hits and self._has_evidence()
            if self.confirmed:
                self._trail = None

    def correct_shared(self, detection: Detection) -> None:
        """Correct with a detection that covers other tracks too: this track is somewhere inside it."""
        room = room_inside(detection.size_px, self.size)
        inside = np.clip(self.center, detection.center_px - room, detection.center_px + room)
        self._measure(inside.tolist(), ((self.size / 4) ** 2 + room**2).tolist())
        self._found(detection.score)
        self.detection, self.shared = detection, True

    @property
    def timeout_s(self) -> float:
        """Longest time without a detection before the track ends [s]."""
        if self.confirmed and not self.after_cut:
            return min(self.settings.lose_s, self.seen - self.born)
        return self.settings.drop_s

    def is_over(self, image_size: tuple[int, int] | None) -> bool:
        """Whether the track is dropped: no detection for too long, or outside the image."""
        if self.missed and image_size is not None:
            (u, v), (width, height) = self.center, image_size
            if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
                return True
        return self.hidden and not self._may_come_out(image_size)

    @property
    def hidden(self) -> bool:
        """Whether it has had no detection for longer than its timeout."""
        return self.t - self.believed > self.timeout_s

    def _may_come_out(self, image_size: tuple[int, int] | None) -> bool:
        """Whether a detection where the track is expected would rather be its target than a new object."""
        if not self.expected or self.after_cut or image_size is None or self.t - self.seen > self.seen - self.born:
            return False
        limit = least_likely(self.settings, self.t - self.seen, image_size)
        return bool(math.log(math.prod(self.center_variance)) < limit)

    def track(self) -> Track:
        """Give the state as a frozen `Track`."""
        u, v = self._axes
        (uu, u_cross, u_rate), (vv, v_cross, v_rate) = u.P, v.P
        return Track(
            id=self.number,
            t=self.t,
            confirmed=self.confirmed,
            missed=self.missed,
            center_px=np.array(self.center),
            velocity_px=np.array([u.velocity, v.velocity]),
            size_px=self.size.copy(),
            whole_px=self._sizes.whole(BEAT_S),
            larger_side_px=self._sizes.larger_side,
            covariance=np.array(
                [
                    [uu, 0.0, u_cross, 0.0],
                    [0.0, vv, 0.0, v_cross],
                    [u_cross, 0.0, u_rate, 0.0],
                    [0.0, v_cross, 0.0, v_rate],
                ]
            ),
            score=self.detection.score,
            box=self.detection,
            shared=self.shared,
            seen_t=self.seen,
            hidden=self.hidden,
            sure=self.mean_score >= self.settings.confirm_score,
        )

    def variance(self, detection: Detection) -> list[float]:
        """Variances of a detection's centre along u and v [px^2]; in floats, which is faster."""
        part = CUT if detection.clipped else self.settings.noise_of_size
        sides = zip(self.size.tolist(), detection.size_px.tolist(), strict=True)
        return [
            center_variance(self.settings, side, part, usual - side if side < PIECE * usual else 0.0)
            for usual, side in sides
        ]

    def _add_box(self, detection: Detection) -> None:
        """Add a box to the histories."""
        (u, v), (width, height) = detection.center_px.tolist(), detection.size_px.tolist()
        self._sizes.add(self.t, (u, v), (width, height), detection.clipped)
        if self._trail is not None:
            self._trail.add(self.t, (u, v), (width, height), detection.clipped, self._shift)

    def _begin(self, detection: Detection) -> list[AxisFilter]:
        """Make filters that begin at a box, with the velocity of the edges in view since the first box.

        The centre of a target that comes into view is unknown, and that of its clipped box moves half as fast.
        """
        settings, center, size = self.settings, detection.center_px.tolist(), detection.size_px.tolist()
        speed, dt = max(settings.speed_px, settings.speed_sides * max(size)), self.t - self.born
        axes = [AxisFilter(at, var, speed**2) for at, var in zip(center, self.variance(detection), strict=True)]
        for axis, side, first, now in zip(axes, size, self._first, self._edges(detection), strict=True):
            ways = [after - before for before, after in zip(first, now, strict=True) if not math.isnan(after - before)]
            if ways and dt > 0:
                noise = center_variance(settings, side, settings.noise_of_size, 0.0)
                axis.correct_velocity(statistics.fmean(ways) / dt, 2 * noise / dt**2)
        return axes

    def _edges(self, detection: Detection) -> list[Edges]:
        """Edges of a box along u and v in the scene, see `_edges`."""
        extents = self._image_size or (None, None)
        sides = zip(detection.center_px.tolist(), detection.size_px.tolist(), extents, self._shift, strict=True)
        return [_edges(center, size, extent, shift, detection.clipped) for center, size, extent, shift in sides]

    def _has_evidence(self) -> bool:
        """Whether the score shows a target, or the travel together with half that score."""
        least = self.settings.confirm_score
        if self._trail is None:
            return self.mean_score >= least
        return self.mean_score >= least > 0 or (self.mean_score >= least / 2 and self._has_travelled(self._trail))

    def _has_travelled(self, trail: Trail) -> bool:
        """Whether the track has travelled far enough to be confirmed."""
        least = self.settings.least_travel * (self._image_size or (0, 0))[0]
        return trail.travel() >= max(least, self.settings.confirm_travel * max(1.0, *self.size.tolist()))

    def _measure(self, center: Sequence[float], variance: Sequence[float]) -> None:
        """Correct with a measured centre [px] and its variances [px^2], (2,) each."""
        for axis, at, var in zip(self._axes, center, variance, strict=True):
            axis.correct(at, var)

    def _found(self, score: float) -> None:
        """Note that this frame has a detection with a score."""
        self.seen = self.t
        if score >= self.settings.start_score:
            self.believed = self.t
        self.missed = 0
        self.after_cut = False


def missing(usual: Array, size: Array) -> Array:
    """Missing width and height of a box that shows only a part of its target [px], (..., 2); 0 if it shows all."""
    return np.asarray(np.where(size < PIECE * usual, usual - size, 0.0))


def room_inside(around: Array, size: Array) -> Array:
    """Largest distance of a target's centre from that of a larger box around it [px], (2,)."""
    return np.maximum(0.0, (around - size) / 2)


def least_likely(
    settings: TrackingSettings, hidden_s: Array | float, image_size: tuple[int, int], clutter: Array | float = 0.0
) -> Array:
    """Largest distance plus log volume at which a detection is a hidden target and no new object.

    A target hidden for some time reappears at a rate of about once in that time, with a normal density; new objects
    appear anywhere.

    Args:
        settings: rate of new objects.
        hidden_s: time without a detection [s]; 0 for a target that is in sight, which has no limit.
        image_size: (width, height) [px].
        clutter: number of detections in the image that may be anything.
    """
    density = (settings.newcomers_hz * hidden_s + clutter) / math.prod(image_size)
    with np.errstate(divide="ignore"):
        return np.asarray(-2 * np.log(2 * math.pi * density))


def center_variance(settings: TrackingSettings, size: Sides, part: Sides, lacks: Sides) -> Sides:
    """Variance of a box's centre [px^2], (..., 2), or along one axis.

    Args:
        settings: noise of centres.
        size: size of the box [px], (..., 2).
        part: error of the centre in parts of the size, `noise_of_size` or CUT, (..., 1).
        lacks: missing size, see `missing` [px], (..., 2).
    """
    off, lost = part * size, lacks / 2
    return settings.noise_px**2 + off * off + lost * lost
