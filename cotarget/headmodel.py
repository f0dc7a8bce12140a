"""What the head does: where each axis is and how fast, by the commands that it got, corrected by what it reports.

A report is late, and coarse by a step; a command is known before it takes effect. So between its commands the unit is
taken to do what it was told, as a trapezoid of speed, until a report says otherwise: a halt, a unit that is slower than
it says, a command from somebody else.
"""

import math
from dataclasses import dataclass, replace

from cotarget.rig import Angles, PanTiltLimits, PanTiltState, Speed

Motion = tuple[tuple[float, float], tuple[float, float]]  # position and speed of pan, and of tilt [rad, rad/s]

# A report agrees that is off by no more than so many steps and by what the axis turns in this time [s].
STEPS_OFF, TIMES_OFF_S = 2.0, 0.01
FINE = 1e-6  # of an angle, for a head without steps [rad]
# The speed of a head that does not do what it was told is taken from reports no farther apart than this [s].
REPORTS_S = 0.3


@dataclass(frozen=True)
class HeadCommand:
    """Where to send the head [rad], and how fast its axes [rad/s]; None for as fast as they can."""

    pan: float
    tilt: float
    speed: Speed | None


@dataclass(frozen=True)
class _Plan:
    """From when, where and how fast the axes set out, and for what; without a command they stay."""

    t: float
    motion: Motion
    command: HeadCommand | None


class HeadModel:
    """Where the head is, was lately, and will be if it is left alone."""

    def __init__(self, limits: PanTiltLimits) -> None:
        """Begin; it must be seen once before it is asked for.

        Args:
            limits: of the unit.
        """
        self._limits = limits
        self._plans: list[_Plan] = []
        self._last: PanTiltState | None = None

    @property
    def command(self) -> HeadCommand | None:
        """The last command, unless the head was seen to have given it up."""
        return self._plans[-1].command if self._plans else None

    @property
    def commanded_t(self) -> float:
        """When the last command took effect, or will [s]."""
        return self._plans[-1].t if self._plans else -math.inf

    def obeys(self, t: float, command: HeadCommand) -> None:
        """Take down a command that takes effect at a time [s]."""
        self._plans.append(_Plan(t, self.at(t), command))

    def saw(self, state: PanTiltState) -> None:
        """Take a report into account."""
        while len(self._plans) > 1 and self._plans[1].t <= state.t:
            self._plans.pop(0)
        if not self._plans or not self._is_near(state, self._at(self._plans[0], state.t)):
            self._begin_anew(state)
        self._last = state

    def at(self, t: float) -> Motion:
        """Where both axes are at a time [s], and how fast."""
        plan = next((plan for plan in reversed(self._plans) if plan.t <= t), self._plans[0])
        return self._at(plan, t)

    def _is_near(self, state: PanTiltState, motion: Motion) -> bool:
        """Whether a report agrees with where the head should be."""
        coarse = max(STEPS_OFF * self._limits.step, FINE)
        reported = state.pan, state.tilt
        return all(abs(q - x) <= coarse + TIMES_OFF_S * abs(v) for q, (x, v) in zip(reported, motion, strict=True))

    def _begin_anew(self, state: PanTiltState) -> None:
        """Believe a report; what was commanded still holds, unless the head stands elsewhere."""
        pan_rate, tilt_rate = self._speeds(state)
        motion = (state.pan, pan_rate), (state.tilt, tilt_rate)
        plans, command = self._plans, self.command
        if not state.moving:
            there = command is not None and self._is_near(state, ((command.pan, 0.0), (command.tilt, 0.0)))
            self._plans = [_Plan(state.t, motion, command if there else None)]
            return
        self._plans = [_Plan(state.t, motion, plans[0].command if plans and plans[0].t <= state.t else None)]
        for plan in plans:
            if plan.t > state.t:
                self._plans.append(replace(plan, motion=self.at(plan.t)))

    def _speeds(self, state: PanTiltState) -> Angles:
        """How fast both axes turn by the last two reports [rad/s]."""
        last, fastest = self._last, self._limits.speed
        if last is None or not state.moving or not 0 < state.t - last.t <= REPORTS_S:
            return 0.0, 0.0
        pan, tilt = (
            min(max((b - a) / (state.t - last.t), -fastest), fastest)
            for a, b in ((last.pan, state.pan), (last.tilt, state.tilt))
        )
        return pan, tilt

    def _at(self, plan: _Plan, t: float) -> Motion:
        """Where a plan leads by a time [s]."""
        limits, command, (pan, tilt) = self._limits, plan.command, plan.motion
        seconds = max(t - plan.t, 0.0)
        if command is None:
            return pan, tilt
        goals, speeds = (command.pan, command.tilt), limits.capped(command.speed)
        a, b = (
            axis_at(seconds, x, v, goal, speed, limits.acceleration)
            for (x, v), goal, speed in zip((pan, tilt), goals, speeds, strict=True)
        )
        return a, b


def axis_at(seconds: float, x: float, v: float, goal: float, speed: float, acceleration: float) -> tuple[float, float]:
    """Position and speed of an axis on its fastest way to rest at a goal.

    Args:
        seconds: after the start.
        x: where it starts.
        v: how fast it is then.
        goal: where it comes to rest.
        speed: highest speed.
        acceleration: of speeding up and of braking; where this or the speed is infinite, it jumps.
    """
    if math.isinf(speed) or math.isinf(acceleration):
        return (goal if seconds >= 0 else x), 0.0
    stop = x + v * abs(v) / (2 * acceleration)
    side = math.copysign(1.0, goal - stop)
    phases: list[tuple[float, float]] = []  # duration and acceleration
    at, rate = x, v
    if rate * side < 0:  # the wrong way, or too fast to stop in time: brake first
        phases.append((abs(rate) / acceleration, -math.copysign(acceleration, rate)))
        at, rate = stop, 0.0
        side = math.copysign(1.0, goal - at)
    forward = abs(rate)
    if forward > speed:
        phases.append(((forward - speed) / acceleration, -side * acceleration))
        at, forward = at + side * (forward**2 - speed**2) / (2 * acceleration), speed
    way = max(side * (goal - at), 0.0)
    peak = min(speed, math.sqrt(max(acceleration * way + forward**2 / 2, 0.0)))
    phases.append((max(peak - forward, 0.0) / acceleration, side * acceleration))
    level = way - (2 * peak**2 - forward**2) / (2 * acceleration)
    phases.append((max(level, 0.0) / peak if peak > 0 else 0.0, 0.0))
    phases.append((peak / acceleration, -side * acceleration))
    for duration, a in phases:
        dt = min(duration, max(seconds, 0.0))
        x, v = x + v * dt + a * dt * dt / 2, v + a * dt
        seconds -= duration
        if seconds <= 0:
            return x, v
    return goal, 0.0
