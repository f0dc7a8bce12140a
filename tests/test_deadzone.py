"""The dead zone on the simulated unit's own axes: how often it is commanded, and how far off the target stands."""

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from cotarget.deadzone import Steering, SteeringSettings, axis_at
from cotarget.estimation import SpatialFilter
from cotarget.rig import PanTiltLimits
from cotarget.sim.motion import Axis
from cotarget.targeting import Reach, aim
from experiments.synthetic import SIZE
from tests.moving_targets import RATE, Flight, show

STEP = math.radians(0.0514286)
LIMITS = PanTiltLimits((-2.8, 2.8), (-0.8, 0.5), math.radians(149), math.radians(206), STEP)
LATENCY, DELAY = 0.12, 0.08  # from light to frame, and from command to motion [s]
SECONDS = 8.0
NOMINAL = {"book": 160 * 10 / 0.234, "person": 300 * 10 / 1.75}  # for the size wanted at 10 m


@dataclass
class Head:
    """The simulated unit's two axes behind their command delay, and what was asked of them."""

    axes: tuple = field(default_factory=lambda: tuple(Axis(LIMITS.speed, LIMITS.acceleration) for _ in range(2)))
    goals: list = field(default_factory=list)

    def move(self, t, pan, tilt, speed):
        goal = tuple(round(q / STEP) * STEP for q in (pan, tilt))
        if not self.goals or goal != self.goals[-1]:
            self.goals.append(goal)
        for axis, q in zip(self.axes, goal, strict=True):
            axis.command(t + DELAY, q, speed)

    def at(self, t):
        return tuple(axis.motor(t)[0] for axis in self.axes)

    def reversals(self):
        changes = np.diff(self.goals, axis=0)
        return sum(np.count_nonzero(np.diff(np.sign(a[a != 0]))) for a in changes.T)


def follow(name, seed, steering):
    """Follow one target; gives commands and reversals a minute, and misses in % of the close-up's width."""
    flight, head = Flight(name, seed, SECONDS), Head()
    estimator = SpatialFilter(flight.calibration, flight.target)
    for axis, q in zip(head.axes, flight.aimed(0.0), strict=True):
        axis.command(-10.0, q)
    waiting, misses = [], []
    field_angle = SIZE[0] / NOMINAL[name]
    for t in flight.times:
        waiting.append((t + LATENCY, t, flight.wide(t), flight.zoom(t, head.at(t), NOMINAL[name])))
        while waiting and waiting[0][0] <= t:
            _, seen_t, seen, view = waiting.pop(0)
            if seen is not None:
                estimator.see_wide(seen, seen_t)
            if view is not None:
                show(estimator, view)
        effect = t + DELAY
        estimates = [estimator.at(s) for s in (effect, effect + 1 / RATE)]
        if estimates[0] is None:
            continue
        reach = Reach(LIMITS.pan, LIMITS.tilt, (667.0, 8000.0), head.at(t), STEP)
        aims = [aim(flight.calibration, e.x_fixed, reach, nominal_px=NOMINAL[name]) for e in estimates]
        (wanted, after) = ((a.pan - e.bias[0], a.tilt - e.bias[1]) for a, e in zip(aims, estimates, strict=True))
        rates = tuple((b - a) * RATE for a, b in zip(wanted, after, strict=True))
        if steering is None:
            # The unit brakes to rest at its goal, which therefore lies its stopping distance ahead.
            goals = [q + r * abs(r) / (2 * LIMITS.acceleration) for q, r in zip(after, rates, strict=True)]
            head.move(t, *goals, None)
        else:
            command = steering.decide(effect, 1 / RATE, head.at(t), wanted, rates, field_angle)
            if command is not None:
                head.move(t, command.pan, command.tilt, command.speed)
        if t > 1.5:
            x = flight.truth.in_zoom(flight.path(t), *head.at(t))
            misses.append(100 * np.hypot(*x[:2] / x[2]) * NOMINAL[name] / SIZE[0])
    return len(head.goals) * 60 / SECONDS, head.reversals() * 60 / SECONDS, np.array(misses)


# Offsets are to stay within a tenth, commands and reversals to be halved, as asked.
SAME_OFFSET = 1.1
HALF = 0.5
FRAME = 1 / RATE


@pytest.mark.parametrize("name", ["book", "person"])
def test_half_the_commands_and_reversals_at_the_same_offset(name):
    every = [follow(name, seed, None) for seed in range(2)]
    spared = [follow(name, seed, Steering(LIMITS)) for seed in range(2)]
    for i in (0, 1):
        assert sum(run[i] for run in spared) <= HALF * sum(run[i] for run in every)
    offset, before = (np.median(np.concatenate([run[2] for run in runs])) for runs in (spared, every))
    assert offset <= SAME_OFFSET * before


def test_a_target_that_stands_in_the_zone_moves_nothing():
    steering, width = Steering(LIMITS), 0.1
    zone = SteeringSettings().zone * width

    def decide(t, now, wanted):
        return steering.decide(t, FRAME, (now, 0.0), (wanted, 0.0), (0.0, 0.0), width)

    first = decide(0.0, 0.0, 0.05)
    assert (first.pan, first.tilt, first.speed) == (0.05, 0.0, None)
    # On its way, and there: the same place, give or take what is less than the zone, needs no further command.
    assert all(decide(i * FRAME, 0.05, 0.05 + 0.9 * zone * (-1) ** i) is None for i in range(1, 50))
    assert decide(3.0, 0.05, 0.05 + 1.2 * zone).pan == 0.05 + 1.2 * zone
    steering.forget()
    assert decide(3.04, 0.05, 0.05) is not None


def test_a_target_far_away_is_chased_at_full_speed():
    steering = Steering(LIMITS)
    command = steering.decide(0.0, FRAME, (0.0, 0.0), (0.5, 0.0), (0.4, 0.0), 0.1)
    assert command.speed is None
    # One frame on, and as far as the unit brakes from that rate.
    assert command.pan == pytest.approx(0.5 + 0.4 * FRAME + 0.4**2 / (2 * LIMITS.acceleration))
    assert steering.where(10.0, (0.0, 0.0)) == pytest.approx((command.pan, command.tilt))


@pytest.mark.parametrize("goal", [0.4, -0.4, 0.01, 0.0])
@pytest.mark.parametrize("speed", [math.inf, 1.5, 0.2])
@pytest.mark.parametrize("v", [0.0, 0.5, -0.8])
def test_an_axis_moves_as_the_simulated_unit(goal, speed, v):
    limit = min(speed, LIMITS.speed)
    axis = Axis(LIMITS.speed, LIMITS.acceleration)
    axis._segments = [(-math.inf, -v * 100, 0.0, 0.0), (-100.0, -v * 100, v, 0.0)]
    axis.command(0.0, goal, limit)
    for seconds in (0.0, 0.03, 0.1, 0.3, 1.0, 4.0):
        assert axis_at(seconds, 0.0, v, goal, limit, LIMITS.acceleration) == pytest.approx(
            axis.motor(seconds), abs=1e-9
        )
