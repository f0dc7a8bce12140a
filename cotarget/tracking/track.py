"""One target's motion filter: a constant-velocity Kalman filter over (u, v, du, dv) with a history of sizes.

It is driven by white acceleration, so that frames may come at any times. To the outside it is told as a frozen
``Track``; the filter's own state stays here. Neither motion nor measurement mixes u and v: each has its own filter.

The Kalman filter of one coordinate in the image and its velocity, driven by white acceleration.

In floats: numpy takes ten times as long for so few numbers, and every track of a frame has two of these.

What the boxes of the last seconds tell: a target's usual size, its largest, and how far it has come.
"""

import math
import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Protocol, TypeVar

import numpy as np

from cotarget.config import TargetConfig
from cotarget.geometry import Array


@dataclass(frozen=True)
class Spread:
    """Covariance of a coordinate and its velocity.

    Attributes:
        at: variance of the coordinate [px^2].
        both: covariance of the two [px^2/s].
        speed: variance of the velocity [px^2/s^2].
    """

    at: float
    both: float
    speed: float

    def after(self, dt: float, noise: float) -> "Spread":
        """What it grows to over ``dt`` [s], forward or back, by white acceleration [px^2/s^3]."""
        span = abs(dt)
        return Spread(
            self.at + dt * (2 * self.both + dt * self.speed) + noise * span**3 / 3,
            self.both + dt * self.speed + noise * dt * span / 2,
            self.speed + noise * span,
        )


def covariance_of(u: Spread, v: Spread) -> Array:
    """Covariance of (u, v, du, dv), (4, 4)."""
    return np.array(
        [[u.at, 0.0, u.both, 0.0], [0.0, v.at, 0.0, v.both], [u.both, 0.0, u.speed, 0.0], [0.0, v.both, 0.0, v.speed]]
    )


class AxisFilter:
    """A coordinate [px] and its velocity [px/s]."""

    def __init__(self, at: float, variance: float, speed_variance: float) -> None:
        self.at, self.speed = at, 0.0
        self.spread = Spread(variance, 0.0, speed_variance)

    def predict(self, dt: float, noise: float) -> None:
        """Move on by ``dt`` [s] with white acceleration [px^2/s^3]."""
        self.at += dt * self.speed
        self.spread = self.spread.after(dt, noise)

    def correct(self, measured: float, variance: float) -> None:
        """Take a measurement [px] with its variance [px^2] into account."""
        P = self.spread
        S = P.at + variance
        innovation, gain, speed_gain = measured - self.at, P.at / S, P.both / S
        self.at += gain * innovation
        self.speed += speed_gain * innovation
        self.spread = Spread(P.at - gain * P.at, P.both - gain * P.both, P.speed - speed_gain * P.both)


# --- boxhistory ---

# The larger side over a wing beat is that of which this part is smaller: the maximum, but deaf to one frame in ten that
# is wrong.
BEAT_PART = 0.9
# Where a target was and is, is the median of so many boxes, at most this part of all: an outline flickers.
ENDS, END_PART = 3, 1 / 3
# A way of which one step makes up more than this part was not gone but jumped: to another thing's outline.
LARGEST_STEP = 2 / 3
# A step that is no longer than this is no jump: an outline is of whole pixels, and flickers [px].
LEAST_JUMP_PX = 3.0
# An edge this near to the image's border may lie beyond it [px].
BORDER_PX = 0.5
Edges = tuple[float, float]


class SizeHistory:
    """The sizes of the last boxes.

    Attributes:
        size: usual width and height [px], (2,).
        larger_side: larger side over the last wing beats [px].
    """

    def __init__(self, size_s: float, beat_s: float) -> None:
        """Begin with no box.

        Args:
            size_s: over so long the usual size is taken [s].
            beat_s: over so long the larger side [s].
        """
        self._size_s, self._beat_s = size_s, beat_s
        self._boxes: deque[_Sides] = deque()
        self.size: Array = np.zeros(2)
        self.larger_side = 0.0

    def note(self, t: float, width: float, height: float, clipped: bool) -> None:
        """Remember a box, and work out the sizes anew.

        Args:
            t: when it was seen [s].
            width: of the box [px].
            height: of the box [px].
            clipped: whether the image's border cuts it.
        """
        boxes = self._boxes
        boxes.append(_Sides(t, width, height, clipped))
        while boxes[0].t < t - max(self._size_s, self._beat_s):
            boxes.popleft()
        # The border makes boxes smaller: those that it did not cut count, or else the largest of those it did.
        recent = [box for box in boxes if box.t >= t - self._size_s]
        whole = [box for box in recent if not box.clipped]
        middle = statistics.median if whole else max
        sides = [box.width for box in whole or recent], [box.height for box in whole or recent]
        self.size = np.array([middle(each) for each in sides])
        recent = [box for box in boxes if box.t >= t - self._beat_s]
        beat = [box for box in recent if not box.clipped] or recent
        self.larger_side = _quantile([max(box.width, box.height) for box in beat], BEAT_PART)


@dataclass(frozen=True, slots=True)
class _Sides:
    """Width and height of a box at a time [s], and whether the image's border cut it."""

    t: float
    width: float
    height: float
    clipped: bool


class Trail:
    """The way that the last boxes have come."""

    def __init__(self, span_s: float, image_size: tuple[int, int] | None = None) -> None:
        """Begin with no box.

        Args:
            span_s: how far back it goes [s].
            image_size: (width, height) [px]; with it a box that its border cuts tells its way by its other edges.
        """
        self._span_s = span_s
        self._extents = image_size or (None, None)
        self._boxes: deque[_Place] = deque()

    def note(self, t: float, center: tuple[float, float], size: tuple[float, float], clipped: bool) -> None:
        """Remember a box.

        Args:
            t: when it was seen [s].
            center: its middle (u, v) [px].
            size: its width and height [px].
            clipped: whether the image's border cuts it.
        """
        across, down = (_edges(*of, clipped) for of in zip(center, size, self._extents, strict=True))
        step = _way([self._boxes[-1].edges], [(across, down)]) if self._boxes else 0.0
        self._boxes.append(_Place(t, (across, down), step))
        while self._boxes[0].t < t - self._span_s:
            self._boxes.popleft()

    def travel(self) -> float:
        """How far the target has come, edge by edge [px]; 0 where it jumped there.

        A thing that comes has both its edges come the same way. A cloud or a shadow that drifts slowly behind others
        grows, shrinks and falls apart, and takes its middle with it; an edge or two stay.
        """
        edges = [box.edges for box in self._boxes]
        count = max(1, min(ENDS, int(END_PART * len(edges))))
        way = _way(edges[:count], edges[-count:])
        longest = max((box.step for box in islice(self._boxes, 1, None)), default=0.0)
        return way if longest <= max(LARGEST_STEP * way, LEAST_JUMP_PX) else 0.0


@dataclass(frozen=True, slots=True)
class _Place:
    """A box's edges along u and v at a time [s], and how long the step was that led there [px]."""

    t: float
    edges: tuple[Edges, Edges]
    step: float


def _edges(center: float, size: float, extent: int | None, clipped: bool) -> Edges:
    """Where a box begins and ends along one axis [px]; nan for an edge beyond the border of an image so wide."""
    low, high = center - size / 2, center + size / 2
    if not clipped or extent is None:
        return low, high
    return low if low > BORDER_PX else math.nan, high if high < extent - 1 - BORDER_PX else math.nan


def _way(before: Sequence[tuple[Edges, Edges]], after: Sequence[tuple[Edges, Edges]]) -> float:
    """How far both edges of some boxes have moved the same way [px]; one alone where the other was not seen."""
    return math.hypot(*(_shift([box[i] for box in before], [box[i] for box in after]) for i in range(2)))


def _shift(before: Sequence[Edges], after: Sequence[Edges]) -> float:
    """That along one axis."""
    moved = []
    for i in range(2):
        was = [edges[i] for edges in before if not math.isnan(edges[i])]
        now = [edges[i] for edges in after if not math.isnan(edges[i])]
        if was and now:
            moved.append(statistics.median(now) - statistics.median(was))
    if not moved or min(moved) < 0 < max(moved):
        return 0.0
    return min(map(abs, moved))


def _quantile(values: Sequence[float], part: float) -> float:
    """The value of which a part of others is smaller, linearly between two; numpy's takes forty times as long."""
    ordered = sorted(values)
    at = part * (len(ordered) - 1)
    low = int(at)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (at - low) * (ordered[high] - ordered[low])


Sides = TypeVar("Sides", Array, float)
# The middle of a box that the image's border cuts is off by this part of it: what is hidden may be as large again.
CUT = 0.5
# A box that is smaller than this part of its target's usual one is a piece of it, which may be any.
PIECE = 0.7


class Measurement(Protocol):
    """What the tracker needs of a detection."""

    @property
    def center_px(self) -> Array:
        """Middle of the box (u, v) [px], (2,)."""

    @property
    def size_px(self) -> Array:
        """Width and height of the box [px], (2,)."""

    @property
    def score(self) -> float:
        """How sure the detector is, 0 to 1."""

    @property
    def clipped(self) -> bool:
        """Whether the image's border cuts the box."""


@dataclass(frozen=True)
class TrackerSettings:
    """How tracks are born, moved and dropped.

    Attributes:
        acceleration_px: typical acceleration in the image [px/s^2].
        manoeuvre_s: how long such an acceleration lasts [s]; acceleration_px^2 manoeuvre_s is the filter's noise.
        noise_px: standard deviation of a detection's centre that does not depend on its size [px].
        noise_of_size: the part that does, as a fraction of the box's side (limbs and wings that move).
        speed_px: standard deviation of the speed that a new target may have [px/s].
        confirm_hits: detections before a track is believed ...
        confirm_s: ... and how long it must have been followed [s] ...
        confirm_travel: ... and how far it must have come, in larger sides of its box (0: it may stand still) ...
        travel_s: ... within so long [s] ...
        confirm_score: ... and what its detections' scores must average, the last ones most (0: any will do).
        score_s: over this time they are averaged [s]; a new track begins at 0.
        doubt_score: a confirmed track ends when its average falls below this.
        lose_s: a confirmed track dies after this long without a detection [s], or after as long as it had been seen,
            where that is less.
        drop_s: one that was never confirmed, after this long [s].
        size_s: window of the size's median [s].
        beat_s: window of the largest size; some two wing beats [s].
    """

    acceleration_px: float = 150.0
    manoeuvre_s: float = 0.3
    noise_px: float = 0.4
    noise_of_size: float = 0.06
    speed_px: float = 120.0
    confirm_hits: int = 4
    confirm_s: float = 0.15
    confirm_travel: float = 0.0
    travel_s: float = 2.0
    confirm_score: float = 0.0
    score_s: float = 0.3
    doubt_score: float = 0.0
    lose_s: float = 0.8
    drop_s: float = 0.13
    size_s: float = 0.6
    beat_s: float = 0.5


def settings_for(target: TargetConfig) -> TrackerSettings:
    """Choose the tracker's settings for a target.

    A colour is found to a fraction of a pixel. What is found by its motion jitters with limbs and wings, and
    must have moved before it is believed: whoever comes straight on is, once he has gone that far aside.
    """
    detector: str = target.detector
    if detector == "colour":
        return TrackerSettings(noise_px=0.2, noise_of_size=0.01)
    if detector == "speck":  # it may hover: what tells it from a thing that stands is its score
        return TrackerSettings(acceleration_px=250.0, noise_of_size=0.2, confirm_score=0.5, doubt_score=0.2)
    if target.dimension == "wingspan":
        return TrackerSettings(acceleration_px=250.0, noise_of_size=0.2, confirm_travel=0.5)
    return TrackerSettings(confirm_travel=0.5, noise_of_size=0.04)


@dataclass(frozen=True)
class Track:
    """One target as far as it is known at time ``t``.

    Attributes:
        id: its number, from 1, never used again.
        t: the time that this state is for [s].
        confirmed: whether it has been consistent for long enough to be believed.
        missed: frames since its last detection; 0 when the last frame had it.
        center_px: filtered middle (u, v), (2,).
        velocity_px: (du, dv) [px/s], (2,).
        size_px: filtered width and height, (2,).
        larger_side_px: the larger side over the last wing beats [px].
        covariance: of (u, v, du, dv), (4, 4).
        score: of the last detection, 0 to 1.
        box: the last detection.
        shared: whether that covers other targets too, so that it tells only what this one is inside of.
    """

    id: int
    t: float
    confirmed: bool
    missed: int
    center_px: Array
    velocity_px: Array
    size_px: Array
    larger_side_px: float
    covariance: Array
    score: float
    box: Measurement
    shared: bool = False


class ImageFilter:
    """The Kalman filters and the size history of one track."""

    def __init__(
        self,
        number: int,
        detection: Measurement,
        t: float,
        settings: TrackerSettings,
        image_size: tuple[int, int] | None = None,
    ) -> None:
        self.number = number
        self.settings = settings
        self.noise = settings.acceleration_px**2 * settings.manoeuvre_s
        self.t = self.born = self.seen = t
        self.detection, self.shared = detection, False
        self.hits = 1
        self.missed = 0
        self.confirmed = False
        self.mean_score = 0.0
        self._sizes = SizeHistory(settings.size_s, settings.beat_s)
        # Of who stands, or is confirmed, nobody asks.
        self._trail = Trail(settings.travel_s, image_size) if settings.confirm_travel else None
        self._note(detection)
        self._u, self._v = (
            AxisFilter(at, variance, settings.speed_px**2)
            for at, variance in zip(detection.center_px.tolist(), self.variance(detection), strict=True)
        )

    @property
    def center(self) -> tuple[float, float]:
        """The middle (u, v) [px]."""
        return self._u.at, self._v.at

    @property
    def place_variance(self) -> tuple[float, float]:
        """Of the middle [px^2]; u and v know nothing of each other."""
        return self._u.spread.at, self._v.spread.at

    @property
    def size(self) -> Array:
        """Usual width and height [px], (2,)."""
        return self._sizes.size

    def predict(self, t: float) -> None:
        """Move the filter to time ``t`` [s]."""
        for axis in (self._u, self._v):
            axis.predict(t - self.t, self.noise)
        self.t = t

    def correct(self, detection: Measurement) -> None:
        """Take a detection of this target alone into account."""
        weight = 1 - math.exp(-(self.t - self.seen) / self.settings.score_s)
        self.mean_score += weight * (detection.score - self.mean_score)
        self._measure(detection.center_px.tolist(), self.variance(detection))
        self._note(detection)
        self.detection, self.shared = detection, False
        self.hits += 1
        if not self.confirmed:
            settings = self.settings
            self.confirmed = (
                self.hits >= settings.confirm_hits
                and self.t - self.born >= settings.confirm_s
                and self.mean_score >= settings.confirm_score
                and self._has_travelled()
            )
            if self.confirmed:
                self._trail = None

    def share(self, detection: Measurement) -> None:
        """Take a detection into account that covers other targets too: all it tells is that this one is inside."""
        room = room_inside(detection.size_px, self.size)
        inside = np.clip(self.center, detection.center_px - room, detection.center_px + room)
        self._measure(inside.tolist(), ((self.size / 4) ** 2 + room**2).tolist())
        self.detection, self.shared = detection, True

    @property
    def patience_s(self) -> float:
        """How long it lives without a detection [s]."""
        if not self.confirmed:
            return self.settings.drop_s
        return min(self.settings.lose_s, self.seen - self.born)

    def is_over(self, image_size: tuple[int, int] | None) -> bool:
        """Whether the track has been without a detection for too long, has left the image, or is not believed."""
        if self.missed and image_size is not None:
            width, height = image_size
            if not (-0.5 <= self._u.at <= width - 0.5 and -0.5 <= self._v.at <= height - 0.5):
                return True
        if self.confirmed and self.mean_score < self.settings.doubt_score:
            return True
        return self.t - self.seen > self.patience_s

    def track(self) -> Track:
        """What the outside sees."""
        return Track(
            id=self.number,
            t=self.t,
            confirmed=self.confirmed,
            missed=self.missed,
            center_px=np.array(self.center),
            velocity_px=np.array([self._u.speed, self._v.speed]),
            size_px=self.size.copy(),
            larger_side_px=self._sizes.larger_side,
            covariance=covariance_of(self._u.spread, self._v.spread),
            score=self.detection.score,
            box=self.detection,
            shared=self.shared,
        )

    def variance(self, detection: Measurement) -> list[float]:
        """Variance of a detection's centre [px^2], (2,); in floats, which is quicker."""
        part = CUT if detection.clipped else self.settings.noise_of_size
        sides = zip(self.size.tolist(), detection.size_px.tolist(), strict=True)
        return [
            center_variance(self.settings, side, part, usual - side if side < PIECE * usual else 0.0)
            for usual, side in sides
        ]

    def _note(self, detection: Measurement) -> None:
        """Remember a box."""
        (u, v), (width, height) = detection.center_px.tolist(), detection.size_px.tolist()
        self._sizes.note(self.t, width, height, detection.clipped)
        if self._trail is not None:
            self._trail.note(self.t, (u, v), (width, height), detection.clipped)

    def _has_travelled(self) -> bool:
        """Whether it has come far enough to be believed."""
        if self._trail is None:
            return True
        return self._trail.travel() >= self.settings.confirm_travel * max(1.0, *self.size.tolist())

    def _measure(self, center: Sequence[float], variance: Sequence[float]) -> None:
        """Take a measured centre [px] with its variance [px^2] into account, both (2,)."""
        for axis, at, spread in zip((self._u, self._v), center, variance, strict=True):
            axis.correct(at, spread)
        self.seen = self.t
        self.missed = 0


def missing(usual: Array, size: Array) -> Array:
    """How much of a target's usual width and height a box lacks [px], (..., 2), if it is a piece of it; else 0."""
    return np.asarray(np.where(size < PIECE * usual, usual - size, 0.0))


def room_inside(around: Array, size: Array) -> Array:
    """How far to either side of a box's middle a target of a usual size that is inside may be [px], (2,)."""
    return np.maximum(0.0, (around - size) / 2)


def center_variance(settings: TrackerSettings, size: Sides, part: Sides, lacks: Sides) -> Sides:
    """Variance of a box's middle [px^2], (..., 2), or along one axis.

    Args:
        settings: how well middles are measured.
        size: of the box [px], (..., 2).
        part: of it that the middle is off by, (..., 1): `noise_of_size`, or CUT.
        lacks: what `missing` says, (..., 2).
    """
    off, lost = part * size, lacks / 2
    return settings.noise_px**2 + off * off + lost * lost
