"""What the head is taken to do, against the simulated unit's own axes, which may be halted or sent elsewhere."""

import math
from dataclasses import dataclass, field

import pytest

from cotarget.control.head import HeadCommand, HeadModel, axis_at
from cotarget.rig import PanTiltState
from cotarget.sim.motion import Axis
from tests.support.rigs import alike

STEP = math.radians(0.0514286)
LIMITS = alike((-2.8, 2.8), (-0.8, 0.5), math.radians(149), math.radians(206), STEP)
REPORT = 0.04  # from one report to the next [s]
CLOSE = 3 * STEP  # what reports by whole steps leave open


@dataclass
class Unit:
    """Two simulated axes, and the model beside them; reports are rounded to steps."""

    axes: tuple = field(default_factory=lambda: tuple(Axis(axis.speed, axis.acceleration) for axis in LIMITS.axes))
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
