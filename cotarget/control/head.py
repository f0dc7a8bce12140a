"""How the head follows: at the target's own speed, left alone as long as that keeps the target near the middle.

A unit comes to rest at every goal. One that is told a moving target's next place in every frame speeds up and brakes
between two frames, and smears the picture; it also follows every error of the estimate. Here the goal lies a little
ahead and the speed is the target's own, corrected for how far the head is off; then the head is left alone
while that keeps the target in the dead zone. A target that stands is centred to a step, and then left alone too.

Compared on simulated walks, 0.2 s late (median offset in % of the width; how far the picture smears within 1/100 s,
median and 90th percentile in px; commands and reversals a minute, of 1500 frames):

- full speed to where the target will be, in every frame: 2.0, 1.3 and 2.3 px, 1460 and 910;
- its speed, in every frame: 2.1, 0.8 and 1.4 px, 1470 and 1090.

And by the whole pipeline with detections from the truth, half a pixel of noise, corrected from the zoom view, five
walks of 20 s (median offset in % of the width, commands and reversals a minute):

- told anew in every frame: 1.18, 1500 and 480;
- a zone of 1.5 % that is left and entered along both axes together, nothing said of the way back: 1.6, 820 and 290;
- a zone of 1 %, each axis by itself, and left alone on its way back: 1.18, 570 and 215.

With rendered pictures, which leave less noise and more that lasts, four walks of 8 s are 1.03, 1.07, 1.06 and 1.19
times as far off as without a zone at 0.6, 0.7, 0.8 and 1 %, with 0.45, 0.41, 0.38 and 0.35 of the commands.

An axis along which the target moves slowly counts as standing: who walks bobs at each step, by 5 px and up to 60 px/s.
Where it counts so only up to half that speed, the head nods at every step, 2 cycles a second, and is farther off.

Each axis has a goal and a speed of its own. With one speed for both the slower one has to speed up and brake within
every frame, and a bird's picture smears by a third more.

What the head does: where each axis is and how fast, by the commands that it got, corrected by what it reports.

A report is late, and coarse by a step; a command is known before it takes effect. So between its commands the unit is
taken to do what it was told, as a trapezoid of speed, until a report says otherwise: a halt, a unit that is slower than
it says, a command from somebody else.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from cotarget.rig import Angles, PanTiltLimits, PanTiltState, Speed, to_step

Motion = tuple[tuple[float, float], tuple[float, float]]  # position and speed of pan, and of tilt [rad, rad/s]
# A report agrees that is off by no more than so many steps and by what the axis turns in this time [s].
STEPS_OFF, TIMES_OFF_S = 2.0, 0.01
MODEL_STEP_S = 1e-6  # of an angle, for a head without steps [rad]
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
        coarse = max(STEPS_OFF * self._limits.step, MODEL_STEP_S)
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


LEAST_SPEED = 1e-3  # a command needs one above zero [rad/s]
FRAMES_AHEAD = 1.5  # a goal lies no nearer than that, so that a head of slow cameras does not stop between frames
# A target that stands is not centred better along either axis than this part of the zone, however fine the head's steps
# are, and than this part of a step: rounding leaves up to half of one, and with no more a head would go to and fro.
FINE, FINE_STEPS = 0.1, 0.6
# From afar an axis is on its way there if it will be so many times nearer.
NEARER = 0.2
# Of what an axis that is slow, while the other turns, is told to lead by, so much is left out: with all of it the head
# nods with the noise of the speed, without any it lags behind whoever goes slightly aslant.
LEAD_SIGMAS = 0.5
# While a target is carried elsewhere no axis turns back for less than so many standard deviations of where it will be.
TURN_SIGMAS = 0.5


@dataclass(frozen=True)
class HeadSettings:
    """How the head is spared.

    Attributes:
        zone: the head is left alone while the target stays so near to the middle, as a part of the image's width; or
            within a step of the head, where that is more.
        deadband: whether it is left alone at all; without that it is told anew with every frame.
        ahead_s: how far ahead a goal lies [s], and no less than a frame and a half. So long a head goes on that nobody
            commands any more: 0.3 s follow no better, and then it stands too late after a fault.
        catch_s: what the head is off is made good in about this time [s]; shorter is nearer, longer is steadier.
        far: from so many zones on it hurries, because that is no noise any more ...
        hurry_s: ... and makes it good in about this time [s].
        still: a target slower than this many zones a second stands.
        slow: along an axis on which it is slower than this many it stands too, while it moves along the other.
        back_s: an axis that will have the target in the zone again after so long is left alone meanwhile [s].
        rest_s: one that stands in the zone is centred no sooner than so long after the last command [s].
    """

    zone: float = 0.007
    deadband: bool = True
    ahead_s: float = 0.2
    catch_s: float = 0.15
    far: float = 13.0
    hurry_s: float = 0.1
    still: float = 10.5
    slow: float = 21.0
    back_s: float = 0.16
    rest_s: float = 1.0


@dataclass(frozen=True)
class _Way:
    """Where the head shall be, as far as that is worth following.

    Attributes:
        wanted: when a command given now takes effect [rad].
        rates: how fast that changes [rad/s]; 0 for an axis that is slow.
        slow: of each axis, whether it hardly turns.
        still: whether the target stands.
    """

    wanted: Angles
    rates: Angles
    slow: tuple[bool, bool]
    still: bool

    def after(self, seconds: float) -> Angles:
        """Where it shall be so much later [rad]."""
        return self.wanted[0] + seconds * self.rates[0], self.wanted[1] + seconds * self.rates[1]


class HeadController:
    """Decides from frame to frame whether the head gets a new command."""

    def __init__(self, limits: PanTiltLimits, settings: HeadSettings = HeadSettings()) -> None:
        """Begin without a command.

        Args:
            limits: of the unit.
            settings: how it is spared.
        """
        self._limits = limits
        self._settings = settings
        self.head = HeadModel(limits)
        self._turning = (0.0, 0.0)  # the sign of each goal's last change

    def decide(
        self,
        effect_t: float,
        interval_s: float,
        wanted: Angles,
        rates: Angles,
        field: float,
        lead_s: float = 0.0,
        goal_sigmas: Angles = (0.0, 0.0),
    ) -> HeadCommand | None:
        """Decide on the head.

        Args:
            effect_t: when a command given now sets the head in motion [s].
            interval_s: until the next chance to command it [s].
            wanted: where it should be at ``effect_t``, pan and tilt [rad].
            rates: how fast that changes [rad/s].
            field: the angle of the image's width [rad].
            lead_s: from when the target was measured last to ``effect_t`` [s]; one that stands is still there.
            goal_sigmas: of a target that is carried elsewhere, standard deviations of pan and tilt ``ahead_s`` later
            [rad].

        Returns:
            None where it is best left alone.
        """
        zone = max(self._settings.zone * field, self._limits.step)
        way = self._damped(wanted, rates, zone, lead_s)
        resting = self._axes_at_rest(effect_t, interval_s, way, zone) if self._settings.deadband else [False, False]
        if self._settings.deadband and self._may_hold(effect_t, interval_s, way, zone, resting):
            return None
        off = _apart(way.wanted, self._at(effect_t), wanted[1])
        if math.isinf(self._limits.acceleration):  # it jumps: to the middle of the target's way until the next chance
            command = HeadCommand(*way.after(interval_s / 2), None)
        elif way.still and off > zone:
            command = HeadCommand(*way.wanted, None)
        else:
            catch_s = self._settings.hurry_s if off > self._settings.far * zone else self._settings.catch_s
            command = self._along(effect_t, interval_s, way, catch_s)
            if self._settings.deadband and not way.still:
                command = self._held(command, way, resting, goal_sigmas)
        command = self._within(command)
        self._note_turns(command)
        self.head.obeys(effect_t, command)
        return command

    def _damped(self, wanted: Angles, rates: Angles, zone: float, lead_s: float) -> _Way:
        """The target's way, without the speed of what stands: that is mostly noise, and a guess ahead of it too."""
        limit = self._settings.slow * zone
        slow = tuple(abs(rate) * scale <= limit for rate, scale in zip(rates, _scales(wanted[1]), strict=True))
        still = _apart(rates, (0.0, 0.0), wanted[1]) <= self._settings.still * zone
        back_s = lead_s if still else LEAD_SIGMAS * lead_s
        pan, tilt = (q - back_s * rate if at_rest else q for q, rate, at_rest in zip(wanted, rates, slow, strict=True))
        pan_rate, tilt_rate = (0.0 if at_rest else rate for rate, at_rest in zip(rates, slow, strict=True))
        return _Way((pan, tilt), (pan_rate, tilt_rate), (slow[0], slow[1]), still)

    def _may_hold(self, effect_t: float, interval_s: float, way: _Way, zone: float, resting: Sequence[bool]) -> bool:
        """Whether the last command will do until the next chance; `resting` tells of which axis it does."""
        command = self.head.command
        if command is None:
            return False
        off_goal = _apart(way.wanted, (command.pan, command.tilt), way.wanted[1])
        off_then = _apart(way.after(interval_s), self._at(effect_t + interval_s), way.wanted[1])
        # There, or on the way to the right place; a head that ran past it while it followed would come back at a crawl.
        if way.still and off_goal <= zone and (command.speed is None or off_then <= zone):
            fine = max(FINE_STEPS * self._limits.step, FINE * zone)
            there = zip(way.after(interval_s), self._at(effect_t + interval_s), strict=True)
            centred = all(abs(q - to_step(x, self._limits.step)) <= fine for q, x in there)
            return centred or effect_t - self.head.commanded_t < self._settings.rest_s
        return all(resting)

    def _axes_at_rest(self, effect_t: float, interval_s: float, way: _Way, zone: float) -> list[bool]:
        """Of each axis, whether its last goal and speed will do until the next chance.

        That is so where the target stays in the zone, and where the axis is on its way there already: told anew in
        every frame it would follow every error of the estimate.
        """
        settings = self._settings
        times = (0.0, interval_s, settings.back_s)
        now, then, back = (
            [abs(q - x) for q, x in zip(way.after(s), self._at(effect_t + s), strict=True)] for s in times
        )
        resting = []
        for i, scale in enumerate(_scales(way.wanted[1])):
            most = zone / scale
            returns = then[i] < now[i] and back[i] <= max(most, NEARER * now[i])
            resting.append(then[i] <= most or returns)
        return resting

    def _at(self, t: float) -> Angles:
        """Where the head is at a time [s] if it is left alone [rad]."""
        (pan, _), (tilt, _) = self.head.at(t)
        return pan, tilt

    def _along(self, effect_t: float, interval_s: float, way: _Way, catch_s: float) -> HeadCommand:
        """A goal ahead of each axis, and the target's speed, faster where it is behind."""
        limits = self._limits
        ahead = max(self._settings.ahead_s, FRAMES_AHEAD * interval_s)
        goals, speeds = [], []
        for w, r, x in zip(way.wanted, way.rates, self._at(effect_t), strict=True):
            v = r + (w - x) / catch_s
            v = math.copysign(min(abs(v), limits.speed), v)
            # Behind, it goes to where the target will be; before it, it slows down until that has caught up.
            start, rate = (w, r) if v * (w - x) > 0 else (x, v)
            goals.append(start + rate * ahead + rate * abs(rate) / (2 * limits.acceleration))  # there it is told anew
            speeds.append(max(abs(v), LEAST_SPEED))
        return HeadCommand(goals[0], goals[1], (speeds[0], speeds[1]))

    def _held(self, command: HeadCommand, way: _Way, resting: Sequence[bool], goal_sigmas: Angles) -> HeadCommand:
        """The same, but an axis that is slow and near enough keeps its goal and its speed.

        Whoever walks by stays at one height. Where the tilt is told anew as often as the pan has to be, it goes up and
        down with every error of the estimate. What is carried elsewhere is as doubtful along both axes.
        """
        last = self.head.command
        if last is None:
            return command
        olds, news = self._axes(last), self._axes(command)
        kept = []
        for i in range(2):
            turn = news[i][0] - olds[i][0]
            back = turn * self._turning[i] < 0 and abs(turn) <= TURN_SIGMAS * goal_sigmas[i]
            kept.append(olds[i] if back or (way.slow[i] and resting[i]) else news[i])
        (pan, pan_speed), (tilt, tilt_speed) = kept
        return HeadCommand(pan, tilt, (pan_speed, tilt_speed))

    def _note_turns(self, command: HeadCommand) -> None:
        """Note which way each goal has changed last."""
        last = self.head.command
        if last is not None:
            turns = command.pan - last.pan, command.tilt - last.tilt
            pan, tilt = (math.copysign(1.0, new) if new else old for new, old in zip(turns, self._turning, strict=True))
            self._turning = pan, tilt

    def _axes(self, command: HeadCommand) -> Motion:
        """Goal and speed of each axis."""
        pan, tilt = self._limits.capped(command.speed)
        return (command.pan, pan), (command.tilt, tilt)

    def _within(self, command: HeadCommand) -> HeadCommand:
        """The same within the limits."""
        pan, tilt = (
            min(max(q, low), high)
            for q, (low, high) in ((command.pan, self._limits.pan), (command.tilt, self._limits.tilt))
        )
        return HeadCommand(pan, tilt, command.speed)


def _scales(tilt: float) -> Angles:
    """What a radian of pan, and of tilt, is on the sphere at that tilt."""
    return math.cos(tilt), 1.0


def _apart(a: Angles, b: Angles, tilt: float) -> float:
    """The angle between two directions that are near to each other, at that tilt [rad]."""
    return math.hypot((a[0] - b[0]) * math.cos(tilt), a[1] - b[1])
