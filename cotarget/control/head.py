"""Steer the pan-tilt head at the target's own speed, and hold it while the target stays in the deadband.

A pan-tilt unit comes to rest at every goal. Commanded to a moving target's next place in every frame, it would speed up
and brake between frames, smear the image, and follow every error of the estimate. Here each axis gets a goal a little
ahead and the target's own speed, corrected for its error; the head is then left alone while that keeps the target in
the deadband. A standing target is centred to a step and then left alone too.

`HeadModel` predicts where the head is between its late and coarse reports: each axis moves with a trapezoidal speed
profile to its commanded goal, until a report contradicts it.

The comparisons behind speed, deadband and slow axes: docs/design-notes.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from cotarget.rig import Angles, PanTiltLimits, PanTiltState, Speed, to_step

Motion = tuple[tuple[float, float], tuple[float, float]]  # position and speed of pan and of tilt [rad, rad/s]
MODEL_STEP = 1e-6  # tolerance for a head without steps [rad]


@dataclass(frozen=True)
class HeadSettings:
    """Settings of the head controller and of its model of the head.

    Attributes:
        zone: half-width of the deadband as a part of the image's width; at least one step of the head.
        deadband: whether there is a deadband; without it, the head gets a command in every frame.
        ahead_s: how far ahead a goal lies [s]. The head goes on for that long when
            commands stop: with 0.3 s it follows no better and stops too late after a fault.
        catch_s: time in which an error of the head is corrected; shorter follows closer, longer is steadier [s].
        far: error in deadbands from which the head hurries, because it is no noise any more.
        hurry_s: time in which a far error is corrected [s].
        slow: speed along one axis, in deadbands a second, below which the target stands along that axis; below half of
            it along both together, the target stands.
        back_s: an axis that brings the target back into the deadband within this time is left alone [s].
        rest_s: least time after the last command before a standing target in the deadband is centred again [s].
        frames_ahead: least lead of a goal in frames, so that the head does not stop between frames of a slow camera.
        fine: part of the deadband to which a standing target is centred ...
        fine_steps: ... but to no less than this part of a step: rounding leaves up to half a step, and without the
            margin the head would go to and fro.
        nearer: a distant axis approaches its goal if it will be within this part of its present distance.
        slow_lead: part of the lead removed from an axis that is slow while the other turns. With the whole lead the
            head nods with the noise of the speed, without any it lags behind a target that moves slightly aslant.
        steps_off: a report agrees with the model of the head within this many steps and the slack of its axes ...
        time_off_s: ... plus the angle that the axis turns in this time [s].
    """

    zone: float = 0.007
    deadband: bool = True
    ahead_s: float = 0.2
    catch_s: float = 0.15
    far: float = 13.0
    hurry_s: float = 0.1
    slow: float = 21.0
    back_s: float = 0.16
    rest_s: float = 1.0
    frames_ahead: float = 1.5
    fine: float = 0.1
    fine_steps: float = 0.6
    nearer: float = 0.2
    slow_lead: float = 0.5
    steps_off: float = 2.0
    time_off_s: float = 0.01


@dataclass(frozen=True)
class HeadCommand:
    """Goal of the head [rad] and speed limits of its axes [rad/s]; a speed of None is full speed."""

    pan: float
    tilt: float
    speed: Speed | None


@dataclass(frozen=True)
class _Plan:
    """Start of a motion: time, position and speed of both axes, and the command; without one the axes stay."""

    t: float
    motion: Motion
    command: HeadCommand | None


class HeadModel:
    """Predict the head's position from commands and reports."""

    def __init__(self, limits: PanTiltLimits, settings: HeadSettings = HeadSettings()) -> None:
        """Create a model; it needs a first report before it is queried.

        Args:
            limits: limits of the pan-tilt unit.
            settings: when a report agrees with the model.
        """
        self._limits, self._settings = limits, settings
        self._plans: list[_Plan] = []
        self._last: PanTiltState | None = None

    @property
    def command(self) -> HeadCommand | None:
        """Last command, unless a report showed that the head has given it up."""
        return self._plans[-1].command if self._plans else None

    @property
    def commanded_t(self) -> float:
        """Time at which the last command takes effect [s]."""
        return self._plans[-1].t if self._plans else -math.inf

    def add_command(self, t: float, command: HeadCommand) -> None:
        """Add a command that takes effect at time t [s]."""
        self._plans.append(_Plan(t, self.motion_at(t), command))

    def add_report(self, state: PanTiltState) -> None:
        """Correct the model with a report of the head."""
        while len(self._plans) > 1 and self._plans[1].t <= state.t:
            self._plans.pop(0)
        if not self._plans or not self._is_near(state, self._at(self._plans[0], state.t)):
            self._begin_anew(state)
        self._last = state

    def motion_at(self, t: float) -> Motion:
        """Predict position and speed of both axes at time t [s]."""
        plan = next((plan for plan in reversed(self._plans) if plan.t <= t), self._plans[0])
        return self._at(plan, t)

    def _is_near(self, state: PanTiltState, motion: Motion) -> bool:
        """Whether a report agrees with a predicted position."""
        settings, reported = self._settings, (state.pan, state.tilt)
        return all(
            abs(q - x) <= max(settings.steps_off * axis.step + axis.slack, MODEL_STEP) + settings.time_off_s * abs(v)
            for q, (x, v), axis in zip(reported, motion, self._limits.axes, strict=True)
        )

    def _begin_anew(self, state: PanTiltState) -> None:
        """Restart the model from a report; keep the commands, unless the head stands elsewhere."""
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
                self._plans.append(replace(plan, motion=self.motion_at(plan.t)))

    def _speeds(self, state: PanTiltState) -> Angles:
        """Speeds of both axes from the last two reports [rad/s]; 0 at rest, and after the first report."""
        last = self._last
        if last is None or not state.moving or state.t <= last.t:
            return 0.0, 0.0
        ways = (state.pan - last.pan, state.tilt - last.tilt)
        pan, tilt = (
            min(max(way / (state.t - last.t), -axis.speed), axis.speed)
            for way, axis in zip(ways, self._limits.axes, strict=True)
        )
        return pan, tilt

    def _at(self, plan: _Plan, t: float) -> Motion:
        """Predict position and speed of both axes under one plan at time t [s]."""
        limits, command, (pan, tilt) = self._limits, plan.command, plan.motion
        seconds = max(t - plan.t, 0.0)
        if command is None:
            return pan, tilt
        pan_speed, tilt_speed = limits.capped(command.speed)
        return (
            axis_at(seconds, *pan, command.pan, pan_speed, limits.pan.assumed_acceleration),
            axis_at(seconds, *tilt, command.tilt, tilt_speed, limits.tilt.assumed_acceleration),
        )


def axis_at(seconds: float, x: float, v: float, goal: float, speed: float, acceleration: float) -> tuple[float, float]:
    """Position and speed of an axis on its fastest way to rest at a goal.

    Args:
        seconds: time after the start [s].
        x: start position [rad].
        v: start speed [rad/s].
        goal: position of rest [rad].
        speed: highest speed [rad/s]; if infinite, the axis jumps.
        acceleration: acceleration and deceleration [rad/s^2]; if infinite, the axis is at once at full speed.
    """
    if math.isinf(speed):
        return (goal if seconds >= 0 else x), 0.0
    if math.isinf(acceleration):
        way = min(speed * max(seconds, 0.0), abs(goal - x))
        turns = math.copysign(1.0, goal - x)
        return (x + turns * way, turns * speed) if way < abs(goal - x) else (goal, 0.0)
    stop = x + v * abs(v) / (2 * acceleration)
    side = math.copysign(1.0, goal - stop)
    phases: list[tuple[float, float]] = []  # duration and acceleration
    at, rate = x, v
    if rate * side < 0:  # moving away, or too fast to stop in time: brake first
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


LEAST_SPEED = 1e-3  # least commanded speed, because a command needs one above zero [rad/s]


@dataclass(frozen=True)
class _Reference:
    """Wanted motion of the head, after damping.

    Attributes:
        wanted: wanted pan and tilt when a command given now takes effect [rad].
        rates: rates of these [rad/s]; 0 for a slow axis.
        slow: whether each axis is slow.
        still: whether the target stands.
    """

    wanted: Angles
    rates: Angles
    slow: tuple[bool, bool]
    still: bool

    def after(self, seconds: float) -> Angles:
        """Wanted pan and tilt after a time [rad]."""
        return self.wanted[0] + seconds * self.rates[0], self.wanted[1] + seconds * self.rates[1]


class HeadController:
    """Decide from frame to frame whether the head gets a new command."""

    def __init__(self, limits: PanTiltLimits, settings: HeadSettings = HeadSettings()) -> None:
        """Create a controller without a command.

        Args:
            limits: limits of the pan-tilt unit.
            settings: settings of the controller.
        """
        self._limits = limits
        self._settings = settings
        self.head = HeadModel(limits, settings)

    def decide(
        self,
        effect_t: float,
        interval_s: float,
        wanted: Angles,
        rates: Angles,
        field: float,
        lead: Angles = (0.0, 0.0),
        lead_s: float = 0.0,
    ) -> HeadCommand | None:
        """Decide on a command for the head.

        Args:
            effect_t: time at which a command given now takes effect [s].
            interval_s: time until the next command can be given [s].
            wanted: wanted pan and tilt at ``effect_t`` [rad].
            rates: rates of these [rad/s].
            field: horizontal angle of view [rad].
            lead: way of ``wanted`` from the last measurement to ``effect_t`` [rad]; a head does not lead a target that
                stands.
            lead_s: time of that way [s]; an axis that is slow while the other turns does not lead by all of it.

        Returns:
            The command; None if the head is best left alone.
        """
        zone = max(self._settings.zone * field, *(axis.step for axis in self._limits.axes))
        reference = self._damped(wanted, rates, zone, lead, lead_s)
        resting = (
            self._axes_at_rest(effect_t, interval_s, reference, zone) if self._settings.deadband else [False, False]
        )
        if self._settings.deadband and self._may_hold(effect_t, interval_s, reference, zone, resting):
            return None
        off = _angle_between(reference.wanted, self._at(effect_t), wanted[1])
        if math.isinf(min(axis.speed for axis in self._limits.axes)):  # it jumps: halfway to the next command
            command = HeadCommand(*reference.after(interval_s / 2), None)
        elif reference.still and off > zone:
            command = HeadCommand(*reference.wanted, None)
        else:
            catch_s = self._settings.hurry_s if off > self._settings.far * zone else self._settings.catch_s
            command = self._follow_reference(effect_t, interval_s, reference, catch_s)
            if self._settings.deadband and not reference.still:
                command = self._hold_slow_axes(command, reference, resting)
        command = self._clipped(command)
        self.head.add_command(effect_t, command)
        return command

    def turn(self, effect_t: float, rates: Angles, ahead_s: float) -> HeadCommand:
        """Turn each axis at a given rate for a time, then let it brake; an axis without a rate brakes now.

        Args:
            effect_t: time at which a command given now takes effect [s].
            rates: rates of pan and tilt [rad/s].
            ahead_s: for how long the axes turn [s].
        """
        goals, speeds = [], []
        for (x, v), rate, axis in zip(self.head.motion_at(effect_t), rates, self._limits.axes, strict=True):
            turns = math.copysign(min(abs(rate), axis.speed), rate) if rate else v
            goals.append(x + (turns * ahead_s if rate else 0.0) + turns * abs(turns) / (2 * axis.assumed_acceleration))
            speeds.append(max(abs(turns), LEAST_SPEED))
        command = self._clipped(HeadCommand(goals[0], goals[1], (speeds[0], speeds[1])))
        self.head.add_command(effect_t, command)
        return command

    def _damped(self, wanted: Angles, rates: Angles, zone: float, lead: Angles, lead_s: float) -> _Reference:
        """Remove speed and lead from slow axes, where they are mostly noise."""
        limit = self._settings.slow * zone
        slow = tuple(abs(rate) * scale <= limit for rate, scale in zip(rates, _scales(wanted[1]), strict=True))
        still = _angle_between(rates, (0.0, 0.0), wanted[1]) <= limit / 2
        left_out = lead if still else [self._settings.slow_lead * lead_s * rate for rate in rates]
        pan, tilt = (q - way if at_rest else q for q, way, at_rest in zip(wanted, left_out, slow, strict=True))
        pan_rate, tilt_rate = (0.0 if at_rest else rate for rate, at_rest in zip(rates, slow, strict=True))
        return _Reference((pan, tilt), (pan_rate, tilt_rate), (slow[0], slow[1]), still)

    def _may_hold(
        self, effect_t: float, interval_s: float, reference: _Reference, zone: float, resting: Sequence[bool]
    ) -> bool:
        """Whether the last command suffices until the next one; `resting` says for which axis it does."""
        command = self.head.command
        if command is None:
            return False
        off_goal = _angle_between(reference.wanted, (command.pan, command.tilt), reference.wanted[1])
        off_then = _angle_between(reference.after(interval_s), self._at(effect_t + interval_s), reference.wanted[1])
        # At rest in place, or on the way there; an axis that overran its goal while following would return too slowly.
        if reference.still and off_goal <= zone and (command.speed is None or off_then <= zone):
            there = zip(reference.after(interval_s), self._at(effect_t + interval_s), self._limits.axes, strict=True)
            centred = all(
                abs(q - to_step(x, axis.step)) <= max(self._settings.fine_steps * axis.step, self._settings.fine * zone)
                for q, x, axis in there
            )
            return centred or effect_t - self.head.commanded_t < self._settings.rest_s
        return all(resting)

    def _axes_at_rest(self, effect_t: float, interval_s: float, reference: _Reference, zone: float) -> list[bool]:
        """For each axis, whether its last goal and speed suffice until the next command.

        They do if the target stays in the deadband, or if the axis is on its way there already. A new command in every
        frame would follow every error of the estimate.
        """
        times = (0.0, interval_s, self._settings.back_s)
        now, then, back = (
            [abs(q - x) for q, x in zip(reference.after(s), self._at(effect_t + s), strict=True)] for s in times
        )
        resting = []
        for i, scale in enumerate(_scales(reference.wanted[1])):
            most = zone / scale
            returns = then[i] < now[i] and back[i] <= max(most, self._settings.nearer * now[i])
            resting.append(then[i] <= most or returns)
        return resting

    def _at(self, t: float) -> Angles:
        """Predicted pan and tilt at time t without a new command [rad]."""
        (pan, _), (tilt, _) = self.head.motion_at(t)
        return pan, tilt

    def _follow_reference(
        self, effect_t: float, interval_s: float, reference: _Reference, catch_s: float
    ) -> HeadCommand:
        """Set a goal ahead of each axis, and the target's speed, corrected for the axis's error."""
        ahead = max(self._settings.ahead_s, self._settings.frames_ahead * interval_s)
        goals, speeds = [], []
        there = zip(reference.wanted, reference.rates, self._at(effect_t), self._limits.axes, strict=True)
        for w, r, x, axis in there:
            v = r + (w - x) / catch_s
            v = math.copysign(min(abs(v), axis.speed), v)
            # Behind the target, an axis goes to where it will be; ahead of it, an axis slows down until it catches up.
            start, rate = (w, r) if v * (w - x) > 0 else (x, v)
            goals.append(start + rate * ahead + rate * abs(rate) / (2 * axis.assumed_acceleration))  # and brakes
            speeds.append(max(abs(v), LEAST_SPEED))
        return HeadCommand(goals[0], goals[1], (speeds[0], speeds[1]))

    def _hold_slow_axes(self, command: HeadCommand, reference: _Reference, resting: Sequence[bool]) -> HeadCommand:
        """Keep the last goal and speed of an axis that is slow and near enough.

        A person who walks by stays at one height. If tilt were commanded as often as pan has to be, it would go up and
        down with every error of the estimate.
        """
        last = self.head.command
        if last is None:
            return command
        kept = [
            old if slow and rests else new
            for old, new, slow, rests in zip(
                self._axes(last), self._axes(command), reference.slow, resting, strict=True
            )
        ]
        (pan, pan_speed), (tilt, tilt_speed) = kept
        return HeadCommand(pan, tilt, (pan_speed, tilt_speed))

    def _axes(self, command: HeadCommand) -> Motion:
        """Goal and speed of each axis of a command."""
        pan, tilt = self._limits.capped(command.speed)
        return (command.pan, pan), (command.tilt, tilt)

    def _clipped(self, command: HeadCommand) -> HeadCommand:
        """Clip a command to the limits of pan and tilt."""
        pan, tilt = (
            min(max(q, axis.range[0]), axis.range[1])
            for q, axis in zip((command.pan, command.tilt), self._limits.axes, strict=True)
        )
        return HeadCommand(pan, tilt, command.speed)


def _scales(tilt: float) -> Angles:
    """Arc length on the sphere per radian of pan and of tilt, at a given tilt."""
    return math.cos(tilt), 1.0


def _angle_between(a: Angles, b: Angles, tilt: float) -> float:
    """Angle between two nearby directions, at a given tilt [rad]."""
    return math.hypot((a[0] - b[0]) * math.cos(tilt), a[1] - b[1])
