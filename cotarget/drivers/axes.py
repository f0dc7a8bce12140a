"""Axes of a polled pan-tilt-zoom unit: what they can do, and position and rest from their polls.

Positions are in the unit's own numbers: steps, counts, or degrees.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from cotarget.errors import DeviceError
from cotarget.rig import USUAL_BRAKING_S, AxisLimits

AXES = ("pan", "tilt", "the lens")
ROUNDING = 1e-9  # of the range of an axis without steps: positions nearer than that are the same


@dataclass(frozen=True, kw_only=True)
class AxisFacts:
    """What a unit says of one of its axes, in the unit's own numbers.

    Attributes:
        unit: angle of one of these numbers [rad]; 1 for the lens.
        lowest: position.
        highest: position.
        fastest: speed [1/s].
        slowest: speed [1/s].
        acceleration: [1/s^2]; None if unknown.
        step: to which positions are rounded, such as 1 where they are whole; 0 for a continuous axis.
        slack: largest distance of the reported position from the goal where the axis has arrived: 0 for a stepper, the
            control error of a servo with its trembling, or the error of the report.
        still_s: an axis stands when it has stayed in one place for this time, unless the unit says whether it moves
            [s]; longer than the slowest speed takes for a step.
        loses_steps: whether the unit counts from a wrong position after the axis was blocked, as a stepper without an
            encoder does. An axis that does not is asked where it is, and never has a lost position.
    """

    unit: float
    lowest: float
    highest: float
    fastest: float
    slowest: float = 0.0
    acceleration: float | None = None
    step: float
    slack: float = 0.0
    still_s: float = 0.3
    loses_steps: bool

    @property
    def same(self) -> float:
        """Positions that differ by no more are the same: half a step."""
        return self.step / 2 or ROUNDING * (self.highest - self.lowest)

    def is_near(self, position: float, goal: float) -> bool:
        """Whether an axis at a position has arrived at a goal, within its slack."""
        return abs(position - goal) <= self.slack + self.same

    def braking_s(self, speed: float) -> float:
        """Time [s] to come to rest from a speed [1/s]."""
        return USUAL_BRAKING_S if self.acceleration is None else speed / self.acceleration

    def goal(self, angle: float, sign: int) -> float:
        """Convert an angle [rad] to the nearest position, with rig.toml's sign of the axis."""
        position = sign * angle / self.unit
        if self.step:
            position = round(position / self.step) * self.step
        return min(max(position, self.lowest), self.highest)

    def speed(self, speed: float) -> float:
        """Convert a speed [rad/s] to one that the axis can turn at [1/s]."""
        return min(max(speed / self.unit, self.slowest), self.fastest)

    def limits(self, sign: int, speed: float) -> AxisLimits:
        """Convert the facts to limits with rig.toml's sign of the axis and a highest speed [rad/s]."""
        a, b = (sign * end * self.unit for end in (self.lowest, self.highest))
        return AxisLimits(
            range=(min(a, b), max(a, b)),
            speed=min(speed, self.fastest * self.unit),
            acceleration=None if self.acceleration is None else self.acceleration * self.unit,
            step=self.step * self.unit,
            slack=self.slack * self.unit,
        )

    def degrees(self, sign: int) -> tuple[float, float]:
        """Convert the range to degrees with rig.toml's sign of the axis: lowest, highest."""
        a, b = (sign * end * math.degrees(self.unit) for end in (self.lowest, self.highest))
        return min(a, b), max(a, b)


class Poll(NamedTuple):
    """Position of an axis, as the unit reports it.

    Attributes:
        axis: 0 for pan, 1 for tilt, 2 for the lens.
        position: in the unit's numbers.
        t: time at which the unit read it [s].
        moving: whether the unit says that the axis moves; None if it does not say, or cannot be believed.
        sigma: standard deviation of the position, beyond that of a step.
    """

    axis: int
    position: float
    t: float
    moving: bool | None = None
    sigma: float = 0.0


class AxisTrack:
    """Position and rest of one axis, from its polls."""

    def __init__(self, facts: AxisFacts) -> None:
        self.facts = facts
        self.polls: deque[Poll] = deque(maxlen=2)
        self._valid = -math.inf
        self._since: float | None = None
        self._rest = 0.0  # position at that time

    @property
    def newest(self) -> Poll:
        """The newest poll."""
        return self.polls[-1]

    def add(self, poll: Poll) -> None:
        """Add a poll.

        Raises:
            DeviceError: the position is no number, or its standard deviation is none.
        """
        if not (math.isfinite(poll.position) and 0 <= poll.sigma < math.inf):
            what = f"at {poll.position}, with a standard deviation of {poll.sigma}"
            raise DeviceError(f"{AXES[poll.axis]} is reported to be {what}; correct the driver")
        if poll.t < self._valid or poll.moving:
            self._since = None
        elif self._since is None or not self._stays(poll.position):
            self._since, self._rest = poll.t, poll.position
        self.polls.append(poll)

    def _stays(self, position: float) -> bool:
        """Whether the axis is still at rest: a trembling one reports positions up to twice its slack apart."""
        return abs(position - self._rest) <= 2 * self.facts.slack + self.facts.same

    def expect_motion(self, t: float) -> None:
        """Count the axis as moving, until polls after ``t`` [s] show that it stands."""
        self._valid, self._since = t, None

    def stands(self) -> bool:
        """Whether the axis stands: the unit says so, or it has stayed in place for as long as its facts ask for."""
        if self._since is None:
            return False
        return self.newest.moving is False or self.newest.t - self._since >= self.facts.still_s

    def interpolate(self, t: float) -> float:
        """Interpolate the position at a time [s] between the last two polls."""
        a, b = self.polls[0], self.polls[-1]
        share = (t - a.t) / (b.t - a.t) if b.t > a.t else 1.0
        return a.position + (b.position - a.position) * min(max(share, 0.0), 1.0)
