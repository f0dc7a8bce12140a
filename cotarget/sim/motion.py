"""Motion of the simulated axes and the zoom lens: trapezoidal speed profiles and backlash.

A new command replaces the motion from its time on, also while an axis moves.
"""

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field

# Segment of constant acceleration: start time `t`, position `x`, speed `v` and acceleration `a`.
Segment = tuple[float, float, float, float]


def trapezoid(t: float, x: float, v: float, goal: float, speed: float, acceleration: float) -> list[Segment]:
    """Plan the fastest move from (x, v) at time t to rest at ``goal``.

    Args:
        t: start time [s].
        x: position at the start.
        v: speed at the start. If it points away from the goal, or is too high to stop there, the axis brakes first.
        goal: position at rest.
        speed: speed limit; infinite means a jump.
        acceleration: acceleration limit, also of braking.

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

    stop = x + v * abs(v) / (2 * acceleration)  # end position of braking at once
    way = math.copysign(1.0, goal - stop)
    if v * way < 0:  # moving away, or unable to stop in time: brake, then start from rest
        run(abs(v) / acceleration, math.copysign(acceleration, -v))
        v = 0.0
        way = math.copysign(1.0, goal - x)
    if abs(v) > speed:  # the new command has a lower speed limit
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
    """Axis with a history, so that its position is known at every time up to the end of the newest command.

    Attributes:
        speed: speed limit.
        acceleration: acceleration limit.
        backlash: play; the driven side lags the motor by up to half of it.
        position: position before the first command.
    """

    speed: float
    acceleration: float
    backlash: float = 0.0
    position: float = 0.0
    _segments: list[Segment] = field(default_factory=list)
    _before: float = 0.0  # position of the driven side at the start of the history

    def __post_init__(self) -> None:
        self._segments = [(-math.inf, self.position, 0.0, 0.0)]
        self._before = self.position

    def command(self, t: float, goal: float, speed: float | None = None) -> float:
        """Replace the motion from time t [s] on; return the time of rest [s]."""
        x, v = self.motor(t)
        kept = self._segments[: bisect_left(self._segments, (t,))]
        highest = self.speed if speed is None else min(speed, self.speed)
        self._segments = kept + trapezoid(t, x, v, goal, highest, self.acceleration)
        return self._segments[-1][0]

    def halt(self, t: float) -> float:
        """Brake from time t [s] on at the acceleration limit; return the time of rest [s]."""
        x, v = self.motor(t)
        if math.isinf(self.acceleration):
            return self.command(t, x)
        return self.command(t, x + v * abs(v) / (2 * self.acceleration))

    def forget(self, t: float) -> None:
        """Drop the history before time t [s]; later calls must not ask for earlier times."""
        first = max(i for i, segment in enumerate(self._segments) if segment[0] <= t)
        if first:
            self._before = self.driven(self._segments[first][0])
            self._segments = self._segments[first:]

    def motor(self, t: float) -> tuple[float, float]:
        """Give position and speed of the motor side at time t [s]."""
        return _at(self._segments, t)

    def driven(self, t: float) -> float:
        """Give the position of the driven side at time t [s]: the motor's, with hysteresis from the backlash."""
        segments = self._segments  # another thread may replace the list, but does not change it
        if self.backlash == 0.0:
            return _at(segments, t)[0]
        half = self.backlash / 2
        y = self._before
        for i, (start, _, v, a) in enumerate(segments):
            if start > t:
                break
            end = min(t, segments[i + 1][0] if i + 1 < len(segments) else t)
            turns = start - v / a if a else math.nan  # time at which the motor reverses within this segment
            for when in (turns, end):
                if start < when <= end:
                    x = _at(segments, when)[0]
                    y = min(max(y, x - half), x + half)
        return y


def _at(segments: list[Segment], t: float) -> tuple[float, float]:
    """Evaluate position and speed at time t [s]."""
    start, x, v, a = segments[bisect_right(segments, (t, math.inf)) - 1]
    if v == 0.0 and a == 0.0:
        return x, 0.0
    dt = t - start
    return x + v * dt + a * dt * dt / 2, v + a * dt


@dataclass(frozen=True)
class HeadDrive:
    """Axes of a pan-tilt unit; the device commands them, and the world reads their true angles."""

    pan: Axis
    tilt: Axis

    def angles_at(self, t: float) -> tuple[float, float]:
        """Give true pan and tilt of the platform, with backlash, at a time up to now [rad]."""
        return self.pan.driven(t), self.tilt.driven(t)


@dataclass(frozen=True)
class LensDrive:
    """Zoom lens whose positions are evenly spaced in the logarithm of the focal length.

    Attributes:
        shortest_px: nominal focal length at the first position [px].
        longest_px: nominal focal length at the last position [px].
        last: index of the last position, counted from 0.
        stepping: whether the lens stops at whole positions only.
        axis: motion of the lens, in positions.
    """

    shortest_px: float
    longest_px: float
    last: int
    stepping: bool
    axis: Axis

    def position_for(self, focal_px: float) -> float:
        """Find the reachable position whose focal length is nearest in the logarithm."""
        position = min(max(math.log(focal_px / self.shortest_px) / self._log_step, 0.0), float(self.last))
        return float(round(position)) if self.stepping else position

    def focal_of(self, position: float) -> float:
        """Give the nominal focal length at a position [px]."""
        return self.shortest_px * math.exp(position * self._log_step)

    def focal_at(self, t: float) -> float:
        """Give the nominal focal length at a time up to now [px]."""
        return self.focal_of(self.axis.motor(t)[0])

    @property
    def _log_step(self) -> float:
        return math.log(self.longest_px / self.shortest_px) / self.last
