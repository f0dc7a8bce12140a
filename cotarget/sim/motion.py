"""Motion in time: trapezoidal speed profiles that can be replaced on the fly, backlash, and the lens's positions."""

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field

# A segment of constant acceleration: it starts at `t` with position `x`, speed `v` and acceleration `a`.
Segment = tuple[float, float, float, float]


def trapezoid(t: float, x: float, v: float, goal: float, speed: float, acceleration: float) -> list[Segment]:
    """Plan the fastest move from (x, v) at time t to rest at ``goal``.

    Args:
        t: start [s].
        x: position then.
        v: speed then; a motion in the wrong direction, or too fast to stop in time, is braked first.
        goal: where to rest.
        speed: highest speed; infinite means a jump.
        acceleration: of speeding up and of braking.

    Returns:
        Segments of constant acceleration in order of time; the last one rests at ``goal``.
    """
    if math.isinf(speed) or math.isinf(acceleration):
        return [(t, goal, 0.0, 0.0)]
    segments: list[Segment] = []

    def run(duration: float, a: float) -> None:
        nonlocal t, x, v
        if duration > 0:
            segments.append((t, x, v, a))
            t, x, v = t + duration, x + v * duration + a * duration**2 / 2, v + a * duration

    stop = x + v * abs(v) / (2 * acceleration)  # where braking at once would end
    way = math.copysign(1.0, goal - stop)
    if v * way < 0:  # wrong way, or past the point of stopping in time: brake, then set out from rest
        run(abs(v) / acceleration, math.copysign(acceleration, -v))
        v = 0.0
        way = math.copysign(1.0, goal - x)
    if abs(v) > speed:  # a lower limit came with the new command
        run((abs(v) - speed) / acceleration, -way * acceleration)
    remaining = way * (goal - x)
    peak = min(speed, math.sqrt(max(acceleration * remaining + v * v / 2, 0.0)))
    run((peak - abs(v)) / acceleration, way * acceleration)
    if peak == speed:
        run((way * (goal - x) - peak**2 / (2 * acceleration)) / peak, 0.0)
    run(abs(v) / acceleration, -way * acceleration)
    segments.append((t, goal, 0.0, 0.0))
    return segments


@dataclass
class Axis:
    """One axis with a history, so that its position is known at every time up to the newest command's effect.

    Attributes:
        speed: highest speed.
        acceleration: of every move.
        backlash: play; the driven side follows within half of it.
    """

    speed: float
    acceleration: float
    backlash: float = 0.0
    position: float = 0.0
    _segments: list[Segment] = field(default_factory=list)
    _before: float = 0.0  # the driven side where the history begins

    def __post_init__(self) -> None:
        self._segments = [(-math.inf, self.position, 0.0, 0.0)]
        self._before = self.position

    @property
    def goal(self) -> float:
        """Where it will come to rest."""
        return self._segments[-1][1]

    def command(self, t: float, goal: float, speed: float | None = None) -> float:
        """Replace the motion from time t on; return when it will rest [s]."""
        x, v = self.motor(t)
        kept = self._segments[: bisect_left(self._segments, (t,))]
        highest = self.speed if speed is None else min(speed, self.speed)
        self._segments = kept + trapezoid(t, x, v, goal, highest, self.acceleration)
        return self._segments[-1][0]

    def halt(self, t: float) -> float:
        """Brake from time t on as hard as the acceleration allows; return when it will rest [s]."""
        x, v = self.motor(t)
        if math.isinf(self.acceleration):
            return self.command(t, x)
        return self.command(t, x + v * abs(v) / (2 * self.acceleration))

    def forget(self, t: float) -> None:
        """Drop the history before time t, after which alone the axis can be asked then."""
        first = max(i for i, segment in enumerate(self._segments) if segment[0] <= t)
        if first:
            self._before = self.driven(self._segments[first][0])
            self._segments = self._segments[first:]

    def motor(self, t: float) -> tuple[float, float]:
        """Position and speed of the driving side at time t."""
        return _at(self._segments, t)

    def driven(self, t: float) -> float:
        """Position of the driven side at time t: the motor's, behind the play (a hysteresis)."""
        segments = self._segments  # replaced as a whole, maybe by another thread
        if self.backlash == 0.0:
            return _at(segments, t)[0]
        half = self.backlash / 2
        y = self._before
        for i, (start, _, v, a) in enumerate(segments):
            if start > t:
                break
            end = min(t, segments[i + 1][0] if i + 1 < len(segments) else t)
            turns = start - v / a if a else math.nan  # the motor's turning point within this segment
            for when in (turns, end):
                if start < when <= end:
                    x = _at(segments, when)[0]
                    y = min(max(y, x - half), x + half)
        return y


def _at(segments: list[Segment], t: float) -> tuple[float, float]:
    """Position and speed at time t."""
    start, x, v, a = segments[bisect_right(segments, (t, math.inf)) - 1]
    if v == 0.0 and a == 0.0:
        return x, 0.0
    dt = t - start
    return x + v * dt + a * dt * dt / 2, v + a * dt


@dataclass(frozen=True)
class HeadDrive:
    """The two axes of a pan-tilt unit; the device commands them, the world looks where they really are."""

    pan: Axis
    tilt: Axis

    def angles_at(self, t: float) -> tuple[float, float]:
        """Pan and tilt of the platform itself [rad] at a time up to now, behind any play."""
        return self.pan.driven(t), self.tilt.driven(t)


@dataclass(frozen=True)
class LensDrive:
    """A zoom lens whose positions are evenly spaced in the logarithm of the focal length.

    Attributes:
        shortest_px: nominal focal length at the first position [px].
        longest_px: at the last position [px].
        last: number of the last position, counted from 0.
        stepping: whether it only stops at whole positions.
        axis: its motion, in positions.
    """

    shortest_px: float
    longest_px: float
    last: int
    stepping: bool
    axis: Axis

    def position_for(self, focal_px: float) -> float:
        """The position that it can stop at whose focal length is nearest."""
        position = min(max(math.log(focal_px / self.shortest_px) / self._log_step, 0.0), float(self.last))
        return float(round(position)) if self.stepping else position

    def focal_of(self, position: float) -> float:
        """Nominal focal length at a position [px]."""
        return self.shortest_px * math.exp(position * self._log_step)

    def focal_at(self, t: float) -> float:
        """Nominal focal length at a time up to now [px]."""
        return self.focal_of(self.axis.motor(t)[0])

    @property
    def _log_step(self) -> float:
        return math.log(self.longest_px / self.shortest_px) / self.last
