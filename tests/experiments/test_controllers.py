"""Simple controllers and the oracle, and the comparison with them."""

import dataclasses
import math

import numpy as np
import pytest

from cotarget.config import DEFAULT_TARGETS
from cotarget.evaluation import true_calibration
from cotarget.sim.world import SimWorld
from experiments.following import hold
from experiments.following.controllers import GAINS, ORACLE, OURS, SIXTY, Filter, comparison, interval, scores
from experiments.following.field import hold_config

# Mean 0.02 and standard deviation 0.01 of three: 0.02 -+ 4.303 * 0.01 / sqrt(3), with Student's t of two degrees.
THREE, LOW, HIGH = [0.01, 0.02, 0.03], -0.00484, 0.04484


def test_the_interval_of_a_paired_difference_is_students():
    found = interval(THREE)
    assert (found["median"], found["least"], found["largest"]) == pytest.approx((0.02, LOW, HIGH), abs=1e-5)
    assert all(math.isnan(value) for value in interval([0.1]).values())


def test_ahead_is_a_difference_whose_interval_is_above_nothing():
    """Of three seeds: .10, .11 and .12 better in one yield; in the other by as much as they scatter."""
    rows = [
        {
            "seed": seed,
            "way": way,
            "closeup_yield": 0.5 + better * (0.1 + 0.01 * seed),
            "centred_yield": 0.5 + better * d,
        }
        for better, way in ((1, OURS), (0, SIXTY))
        for seed, d in enumerate(THREE)
    ]
    found = comparison(rows)
    assert found[SIXTY]["closeup_yield, ahead"] == "yes"
    assert found[SIXTY]["closeup_yield, difference"]["median"] == pytest.approx(0.11)
    assert found[SIXTY]["centred_yield, ahead"] == "no"
    assert set(found[OURS]) == {"closeup_yield", "centred_yield"}


def test_the_oracle_centres_a_target_of_the_field():
    """A book; the quick run of hold has bounds for a person and a bird."""
    settings = dataclasses.replace(hold.SETTINGS, seconds=4.0, calibrated=False)
    ((way, found),) = scores(settings, hold_config("book", 3), "book", [ORACLE])
    assert way == ORACLE
    assert found.closeup_yield > 0.95
    assert found.centred_yield > 0.95
    assert found.identification is None  # its close-ups are not rendered


def test_the_filter_follows_boxes_at_constant_speed():
    """A person of 1.75 m, 10 m ahead, who walks 1.5 m/s to the right: 2 s later as far as he has come by then."""
    world = SimWorld(hold_config("person", 3), rendered=())
    calibration, person, dt = true_calibration(world), DEFAULT_TARGETS["person"], 0.04
    found = Filter(calibration, person, GAINS["walking"])
    for i in range(51):
        x = np.array([-2.0 + 1.5 * i * dt, 0.5, 10.0])
        low, high = (calibration.fixed.project(x + np.array([0, half, 0])) for half in (-0.875, 0.875))
        found.add([(calibration.fixed.project(x), np.array([40.0, high[1] - low[1]]))], dt)
    assert found.followed
    assert found.x[:3] == pytest.approx([1.0, 0.5, 10.0], abs=0.05)
    assert found.x[3:] == pytest.approx([1.5, 0, 0], abs=0.1)
    for _ in range(26):  # out of sight for more than a second
        found.add([], dt)
    assert not found.followed
