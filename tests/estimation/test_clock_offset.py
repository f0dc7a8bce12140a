"""The offset of the cameras' clocks against simulated truth, by targets that move, of wrong sizes, and that stand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from cotarget.estimation import TargetFilter, filter_settings
from cotarget.estimation.clock_offset import ClockOffset
from tests.support.moving_targets import APART, Flight, show

BIAS = (0.002, -0.001)  # of the head [rad], three standard deviations of the prior
LATE = 0.015  # error of an offset after ten seconds [s]
SURE = 0.016  # its standard deviation by then [s]
UNKNOWN = 0.03  # standard deviation while nothing tells the offset from a wrong size [s]


def estimated(flight, late_s, edge_px=0.0):
    """Follow a target with the fixed camera's stamps late by so much [s]; return the offset.

    In the fixed image, what is left of an edge is hidden [px].
    """
    target_filter = TargetFilter(flight.calibration, flight.target)
    clock = ClockOffset(filter_settings(flight.target).motion)
    for t in flight.times:
        box, view = flight.wide(t), flight.zoom(t + APART)
        if box is not None:
            left, right = box.center_px[0] + box.size_px[0] * np.array([-0.5, 0.5])
            if right < edge_px:
                continue
            hidden = np.array([max(edge_px - left, 0.0), 0.0])
            box = replace(box, center_px=box.center_px + hidden / 2, size_px=box.size_px - hidden)
            target_filter.add_fixed(box, t + late_s)
        if view is not None:
            show(target_filter, view)
        clock.add(target_filter.observations)
    return clock


@pytest.mark.parametrize("wrong", [1.0, 2.0])
@pytest.mark.parametrize(("name", "late_s"), [("bird", 0.06), ("bird", -0.1), ("person", 0.0), ("person", 0.06)])
def test_a_moving_target_shows_the_offset_though_its_size_and_the_head_are_wrong(name, late_s, wrong):
    clock = estimated(Flight(name, 300, 10.0, wrong=wrong, bias=BIAS), late_s)
    assert clock.late_s == pytest.approx(late_s, abs=LATE)
    assert clock.sigma_s < SURE


@pytest.mark.parametrize("wrong", [1.0, 2.0])
def test_a_walk_along_the_baseline_leaves_the_offset_unknown(wrong):
    """At a constant speed along it, late stamps and a wrong size look alike."""
    t = np.linspace(0.0, 5.0, 50)
    along = Flight("person", 300).truth.gamma.inv().translation  # from the fixed to the zoom camera
    way = CubicSpline(t, np.array([0.0, 0.4, 10.0]) + np.outer(1.2 * (t - 2.0), along / np.linalg.norm(along)))
    clock = estimated(Flight("person", 300, 4.0, path=way, wrong=wrong), 0.06)
    assert clock.sigma_s > UNKNOWN
    assert abs(clock.late_s - 0.06) < 3 * clock.sigma_s


def test_a_standing_target_shows_no_offset():
    still = CubicSpline([0.0, 9.0], np.full((2, 3), (0.5, 0.2, 10.0)))
    clock = estimated(Flight("book", 300, path=still), 0.06)
    assert clock.sigma_s > UNKNOWN
    assert all(clock.correct() == 0.0 for _ in range(10))


def test_stamps_are_corrected_step_by_step_and_frames_stay_in_their_order():
    clock = estimated(Flight("bird", 300, 8.0), -0.1)
    corrections, begun = zip(*((clock.correct(), clock.restarts_filter()) for _ in range(25)), strict=True)
    assert sum(begun) == 1  # the filter restarts once, when the correction is there
    assert corrections[-1] == clock.late_s
    assert np.diff(np.arange(25) / 100 - corrections).min() >= -math.ulp(1.0)  # at a hundred frames a second


def test_a_target_that_comes_out_from_behind_something_shows_no_offset():
    """What is seen of it moves more slowly than the target, as if the stamps were late."""
    t = np.linspace(0.0, 4.0, 81)
    carried = np.interp(t, [0.0, 1.2, 1.5, 2.5, 4.0], [0.0, 1.5, 1.6, 1.1, 1.1])  # to the right, then back
    way = CubicSpline(t, np.c_[carried - 0.5, np.full(len(t), 0.2), np.full(len(t), 10.0)])
    flight = Flight("book", 300, 2.4, path=way)
    edge_px = float(flight.wide(1.1).center_px[0])
    clock = estimated(flight, 0.0, edge_px)
    assert all(clock.correct() == 0.0 for _ in range(10))


def test_another_target_keeps_the_offset():
    clock = estimated(Flight("bird", 300), 0.06)
    late_s = clock.late_s
    clock.forget_target()
    assert (clock.late_s, clock.sigma_s > 0) == (late_s, True)
