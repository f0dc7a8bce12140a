"""The head: its dead zone, and what it is taken to do, against the simulated unit's own axes."""

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from cotarget.control.head import HeadCommand, HeadController, HeadModel, HeadSettings, axis_at
from cotarget.rig import PanTiltState
from cotarget.sim.motion import Axis
from tests.support.moving_targets import RATE
from tests.support.rigs import alike, with_axes

STEP = math.radians(0.0514286)
LIMITS = alike((-2.8, 2.8), (-0.8, 0.5), math.radians(149), math.radians(206), STEP)


FRAME = 1 / RATE


WIDTH = 0.1  # of the image [rad]; the zone is a step of the head, 0.9 mrad
ZONE = max(HeadSettings().zone * WIDTH, STEP)


def standing(limits=LIMITS, pan=0.0):
    """A head that stands, and nobody has commanded."""
    head_controller = HeadController(limits)
    head_controller.head.add_report(PanTiltState(pan, 0.0, False, -FRAME))
    return head_controller


def decide(head_controller, t, wanted, rate=0.0):
    return head_controller.decide(t, FRAME, (wanted, 0.0), (rate, 0.0), WIDTH)


def test_a_target_that_stands_is_centred_once_and_left_alone():
    head_controller = standing()
    first = decide(head_controller, 0.0, 0.05)
    assert (first.pan, first.tilt, first.speed) == (0.05, 0.0, None)
    # On its way, and there: the same place, give or take what is less than the zone, needs no further command ...
    assert all(decide(head_controller, i * FRAME, 0.05 + 0.9 * ZONE * (-1) ** i) is None for i in range(1, 25))
    # ... until it has rested for a second: then it is centred, slowly, if it is off by more than rounding leaves, seen
    # from the step at which it really stands, a third of one beside its goal.
    at = round(0.05 / STEP) * STEP
    assert 0.05 + 0.25 * STEP < at < 0.05 + 0.35 * STEP
    assert decide(head_controller, 1.04, at + 0.55 * STEP) is None
    assert decide(head_controller, 1.04, at - 0.55 * STEP) is None
    centred = decide(head_controller, 1.08, at - 0.65 * STEP)
    assert centred.pan == at - 0.65 * STEP
    assert centred.speed[0] == pytest.approx((0.05 - centred.pan) / HeadSettings().catch_s)
    assert decide(head_controller, 1.12, 0.05) is None
    # Out of the zone it is gone after at once.
    assert decide(head_controller, 1.2, 0.05 + 2 * ZONE).pan == 0.05 + 2 * ZONE


def test_a_servo_that_rests_off_its_goal_is_left_alone_too():
    head_controller = standing(with_axes(LIMITS, slack=4 * STEP))
    decide(head_controller, 0.0, 0.05)
    for i in range(25, 100):
        head_controller.head.add_report(PanTiltState(0.05 + (4 - i % 2) * STEP, 0.0, False, i * FRAME))  # it trembles
        assert decide(head_controller, i * FRAME, 0.05) is None


def test_a_moving_target_is_followed_at_its_own_speed():
    """Once it keeps up, the unit told so is left alone for as long as its goal is ahead."""
    head_controller = standing()
    rate, commands = 0.3, []
    for i in range(100):
        t = i * FRAME
        command = decide(head_controller, t, 0.5 + rate * t, rate)
        commands += [] if command is None else [(t, command)]
        if t > 1.0:
            at = head_controller.head.motion_at(t)[0][0]
            assert abs(at - 0.5 - rate * t) < 2 * ZONE
    late = [(t, command) for t, command in commands if t > 1.0]
    ahead_s = HeadSettings().ahead_s
    assert len(late) < 0.25 * 75  # of 75 frames: a new goal each 0.2 s at most, and what the first ones left over
    for t, command in late:
        assert command.speed[0] == pytest.approx(rate, rel=0.1)
        # The goal is that far ahead, and the way on which the unit brakes farther.
        ahead = 0.5 + rate * (t + ahead_s) + rate**2 / (2 * LIMITS.pan.acceleration)
        assert command.pan == pytest.approx(ahead, abs=1.5 * ZONE)


def test_each_axis_has_its_targets_speed():
    """A target that goes aslant is followed aslant, and not along one axis and then the other."""
    head_controller, rates = standing(), (0.3, -0.1)
    for i in range(60):
        t = i * FRAME
        wanted = 0.5 + rates[0] * t, 0.1 + rates[1] * t
        head_controller.decide(t, FRAME, wanted, rates, WIDTH)
    for later in (0.25, 0.5, 0.75):
        assert [speed for _, speed in head_controller.head.motion_at(t + later * FRAME)] == pytest.approx(
            rates, abs=0.03
        )


def test_an_axis_that_stands_is_left_alone_while_the_other_turns():
    """Whoever walks by at one height does not have the head nod with the noise of the estimate."""
    head_controller, rng = standing(), np.random.default_rng(0)
    tilts = []
    for i in range(100):
        t = i * FRAME
        off, rate = 0.3 * ZONE * rng.uniform(-1, 1, 2)
        command = head_controller.decide(t, FRAME, (0.5 + 0.3 * t, 0.1 + off), (0.3, rate / FRAME / 2), WIDTH)
        if command is not None and t > 1.0:
            tilts.append(command.tilt)
    assert len(tilts) > 5
    assert len(set(tilts)) == 1
    # It is sent on when it is not near any more.
    assert head_controller.decide(4.0, FRAME, (0.5 + 0.3 * 4.0, 0.1 + 2 * ZONE), (0.3, 0.0), WIDTH).tilt > tilts[-1]


def test_a_goal_is_within_the_limits():
    command = decide(standing(pan=2.7), 0.0, 2.75, 0.5)
    assert command.pan == LIMITS.pan.range[1]


def test_a_head_that_jumps_is_sent_to_the_middle_of_the_way():
    """The textbook's unit, without limits of speed and acceleration."""
    limits = alike((-2.8, 2.8), (-0.8, 0.5), math.inf, math.inf, 0.0)
    head_controller = standing(limits)
    command = decide(head_controller, 0.0, 0.5, 0.4)
    assert (command.pan, command.speed) == (0.5 + 0.4 * FRAME / 2, None)
    assert head_controller.head.motion_at(0.0)[0] == (command.pan, 0.0)


REPORT = 0.04  # from one report to the next [s]
CLOSE = 3 * STEP  # what reports by whole steps leave open


@dataclass
class Unit:
    """Two simulated axes, and the model beside them; reports are rounded to steps."""

    axes: tuple = field(
        default_factory=lambda: tuple(Axis(LIMITS.pan.speed, LIMITS.pan.acceleration) for _ in range(2))
    )
    model: HeadModel = field(default_factory=lambda: HeadModel(LIMITS))
    rests: float = -math.inf

    def move(self, t, pan, tilt, speed=None, *, told=True):
        speeds = LIMITS.capped(speed)
        self.rests = max(axis.command(t, q, v) for axis, q, v in zip(self.axes, (pan, tilt), speeds, strict=True))
        if told:
            self.model.add_command(t, HeadCommand(pan, tilt, speed))

    def halt(self, t):
        self.rests = max(axis.halt(t) for axis in self.axes)

    def report(self, t):
        pan, tilt = (round(axis.motor(t)[0] / STEP) * STEP for axis in self.axes)
        self.model.add_report(PanTiltState(pan, tilt, t < self.rests, t))

    def off(self, t):
        """How far the model is from where the unit really is at a time [rad]."""
        found = self.model.motion_at(t)
        return max(abs(x - axis.motor(t)[0]) for (x, _), axis in zip(found, self.axes, strict=True))


@pytest.fixture
def unit():
    made = Unit()
    made.report(0.0)
    return made


def test_a_head_that_obeys_is_known_between_its_reports_and_ahead_of_them(unit):
    for i, (pan, tilt, speed) in enumerate([(0.5, 0.1, None), (0.6, -0.2, (0.4, 0.2)), (-0.3, 0.0, 1.0)]):
        unit.move(0.3 * i + 0.08, pan, tilt, speed)
        for k in range(7):
            t = 0.3 * i + k * REPORT
            unit.report(t)
            assert unit.off(t + 0.02) < 1e-9
    assert unit.off(1.5) < 1e-9


def test_a_command_that_is_still_to_take_effect_is_counted_with(unit):
    unit.move(0.1, 0.5, 0.0)
    unit.report(0.04)
    assert unit.model.motion_at(0.05) == ((0.0, 0.0), (0.0, 0.0))
    assert unit.off(0.3) < 1e-9
    assert unit.model.commanded_t == 0.1


def test_a_head_that_was_halted_is_where_it_says(unit):
    unit.move(0.0, 1.0, 0.3)
    unit.report(0.2)
    unit.halt(0.25)
    for k in range(6, 20):
        unit.report(k * REPORT)
    assert unit.model.command is None, "the last command is over"
    assert unit.off(1.0) < CLOSE


def test_a_head_that_somebody_else_sends_is_followed(unit):
    unit.move(0.0, 0.2, 0.0)
    unit.report(0.1)
    unit.move(0.12, -1.0, 0.1, (0.8, 0.8), told=False)
    for k in range(4, 18):
        unit.report(k * REPORT)
    assert unit.off(17 * REPORT) < CLOSE + 0.01 * 0.8  # as much as it turns in 1/100 s agrees
    assert unit.off(17 * REPORT + 0.02) < CLOSE + 0.02 * 0.8


def test_a_head_that_turns_when_it_is_first_seen_is_caught_up_with(unit):
    """A loop that begins while the head is still on its way."""
    unit.move(0.0, 1.5, 0.0, told=False)
    late = HeadModel(LIMITS)
    unit.model = late
    for k in range(5, 9):
        unit.report(k * REPORT)
    unit.move(9 * REPORT, 0.8, 0.0)
    for k in range(9, 40):
        unit.report(k * REPORT)
    assert unit.off(40 * REPORT) < CLOSE


def test_a_head_that_arrives_early_is_not_sent_again(unit):
    unit.model.add_command(0.1, HeadCommand(0.1, 0.0, None))
    unit.model.add_report(PanTiltState(0.1, 0.0, False, 0.12))
    assert unit.model.command == HeadCommand(0.1, 0.0, None)
    assert unit.model.motion_at(0.2) == ((0.1, 0.0), (0.0, 0.0))


@pytest.mark.parametrize("goal", [0.4, -0.4, 0.01, 0.0])
@pytest.mark.parametrize("speed", [math.inf, 1.5, 0.2])
@pytest.mark.parametrize("v", [0.0, 0.5, -0.8])
def test_an_axis_moves_as_the_simulated_unit(goal, speed, v):
    limit = min(speed, LIMITS.pan.speed)
    # For 100 s at v, it comes from as far as that takes it, less what speeding up cost, and passes 0 at time 0.
    begin = -100 * v + v * abs(v) / (2 * LIMITS.pan.acceleration)
    axis = Axis(LIMITS.pan.speed, LIMITS.pan.acceleration, position=begin)
    axis.command(-100.0, begin + 200 * v, abs(v) or None)
    axis.command(0.0, goal, limit)
    for seconds in (0.0, 0.03, 0.1, 0.3, 1.0, 4.0):
        assert axis_at(seconds, 0.0, v, goal, limit, LIMITS.pan.acceleration) == pytest.approx(
            axis.motor(seconds), abs=1e-9
        )
