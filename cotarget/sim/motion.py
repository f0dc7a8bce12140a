"""Motion of the simulated axes and the zoom lens: trapezoidal speed profiles and backlash.

A new command replaces the motion from its time on, also while an axis moves.
"""

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass

# Segment of constant acceleration: start time `t`, position `x`, speed `v` and acceleration `a`.
Segment = tuple[float, float, float, float]
# Motion is remembered this long before the newest command [s]. A frame is exposed, and the truth of a step asked for,
# less than some seconds later.
HISTORY_S = 60.0


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


@dataclass(slots=True)
class PlannedMotion:
    """Motion from one command on, up to the start of the next plan.

    Attributes:
        t: time at which the command takes effect [s].
        segments: the motor's motion, in order of time; the first segment starts at ``t``.
        driven: position of the driven side at ``t``.
        before: the plan that this one replaced from ``t`` on; None at the start of the history.
    """

    t: float
    segments: list[Segment]
    driven: float
    before: "PlannedMotion | None"


class Axis:
    """Axis with a history, so that its position is known at every time of the last `HISTORY_S`.

    A command takes the same time and memory however long the history is. One thread may command while others read at
    times before the newest command takes effect.

    Attributes:
        speed: speed limit.
        acceleration: acceleration limit.
    """

    def __init__(self, speed: float, acceleration: float, backlash: float = 0.0, position: float = 0.0) -> None:
        """Make an axis at rest.

        Args:
            speed: speed limit.
            acceleration: acceleration limit.
            backlash: play; the driven side lags the motor by up to half of it.
            position: position before the first command.
        """
        self.speed, self.acceleration = speed, acceleration
        self._half = backlash / 2
        self._newest = PlannedMotion(-math.inf, [(-math.inf, position, 0.0, 0.0)], position, None)
        self._kept = deque([self._newest])  # oldest first; readers follow the links in place of it

    def command(self, t: float, goal: float, speed: float | None = None) -> float:
        """Replace the motion from time t [s] on; return the time of rest [s]."""
        x, v = self.motor(t)
        highest = self.speed if speed is None else min(speed, self.speed)
        segments = trapezoid(t, x, v, goal, highest, self.acceleration)
        kept = self._kept
        while kept[-1].t >= t:
            kept.pop()
        before = kept[-1]
        self._newest = PlannedMotion(t, segments, self._driven(before, t, segments[0][1]), before)
        kept.append(self._newest)
        while kept[1].t <= t - HISTORY_S:
            kept.popleft()
            kept[0].before = None
        return segments[-1][0]

    def halt(self, t: float) -> float:
        """Brake from time t [s] on at the acceleration limit; return the time of rest [s]."""
        x, v = self.motor(t)
        if math.isinf(self.acceleration):
            return self.command(t, x)
        return self.command(t, x + v * abs(v) / (2 * self.acceleration))

    def motor(self, t: float) -> tuple[float, float]:
        """Give position and speed of the motor side at time t [s].

        Raises:
            ValueError: the time is before the history.
        """
        return _at(self._plan(t).segments, t)

    def driven(self, t: float) -> float:
        """Give the position of the driven side at time t [s]: the motor's, with hysteresis from the backlash.

        Raises:
            ValueError: the time is before the history.
        """
        plan = self._plan(t)
        x = _at(plan.segments, t)[0]
        return self._driven(plan, t, x)

    def _plan(self, t: float) -> PlannedMotion:
        """Find the plan that moves the axis at time t [s]."""
        plan = self._newest
        while plan.t > t:
            if plan.before is None:
                raise ValueError(f"the motion at {t:g} s is forgotten; an axis remembers the last {HISTORY_S:g} s")
            plan = plan.before
        return plan

    def _driven(self, plan: PlannedMotion, t: float, x: float) -> float:
        """Follow the driven side through a plan to time t [s], where the motor is at ``x``."""
        half, segments, y = self._half, plan.segments, plan.driven
        if not half:
            return x
        for i, (start, *_) in enumerate(segments):
            if start > t:
                break
            end = min(t, segments[i + 1][0] if i + 1 < len(segments) else t)
            if start < end:  # the motor reverses at the end of a segment only
                at = x if end == t else _at(segments, end)[0]
                y = min(max(y, at - half), at + half)
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
