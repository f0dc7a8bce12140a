"""Interpolated states of head and lens against the head's trapezoidal profile."""

import math

import numpy as np
import pytest

from cotarget.fusion import REMEMBERED_S, StateHistory
from cotarget.rig import PanTiltState, ZoomState
from cotarget.sim.motion import trapezoid

RATE_S = 0.04
OFF_DEG = 0.024  # largest error of the cubic, where the acceleration changes between two states


def filled(pan, until=1.2, lens=lambda t: 1000.0, phase=0.0):
    history = StateHistory()
    for t in np.arange(-0.2 + phase, until, RATE_S):
        history.add(PanTiltState(pan(t), -pan(t), True, t), ZoomState(lens(t), True, t))
    return history


def profile(goal_deg):
    segments = trapezoid(0.1, 0.0, 0.0, goal_deg, 149.0, 206.0)

    def pan(t):
        begun = [s for s in segments if s[0] <= t]
        if not begun:
            return 0.0
        start, x, v, a = begun[-1]
        return math.radians(x + v * (t - start) + a * (t - start) ** 2 / 2)

    return pan


@pytest.mark.parametrize("phase", [0.0, 0.013, 0.031])
def test_pan_tilt_and_speed_are_interpolated_along_a_move(phase):
    pan = profile(20.0)
    history = filled(pan, phase=phase)
    for t in np.arange(0.0, 0.95, 0.005):
        found = history.interpolate(t)
        assert math.degrees(abs(found.pan - pan(t))) < OFF_DEG
        assert found.tilt == -found.pan
    # It is fastest half way, after sqrt(20 / 206) s: 206 times that, on both axes.
    fastest = history.interpolate(0.1 + math.sqrt(20 / 206))
    assert math.degrees(fastest.speed) == pytest.approx(math.sqrt(2) * 206 * math.sqrt(20 / 206), rel=0.1)
    assert history.interpolate(0.99).speed == pytest.approx(0.0, abs=1e-9)


def test_the_logarithm_of_the_focal_length_is_interpolated_linearly():
    history = filled(lambda t: 0.0, lens=lambda t: 1000.0 * math.exp(t))
    assert history.interpolate(0.513).nominal_px == pytest.approx(1000.0 * math.exp(0.513))


def test_only_times_between_two_kept_states_have_a_pose():
    history = StateHistory()
    assert history.interpolate(0.0) is None
    history.add(PanTiltState(0.1, 0.2, False, 5.0), ZoomState(700.0, False, 5.0))
    assert (history.interpolate(5.0).pan, history.interpolate(5.0).speed) == (0.1, 0.0)
    assert history.interpolate(5.01) is None
    history.add(PanTiltState(0.2, 0.2, False, 5.1), ZoomState(700.0, False, 5.1))
    assert history.interpolate(5.05).pan == pytest.approx(0.15)
    history.add(PanTiltState(0.9, 0.9, False, 5.1), ZoomState(900.0, False, 5.1))  # the same state once more
    assert history.interpolate(5.05).pan == pytest.approx(0.15)
    history.add(PanTiltState(0.2, 0.2, False, 5.1 + REMEMBERED_S), ZoomState(700.0, False, 5.1 + REMEMBERED_S))
    assert history.interpolate(5.05) is None


@pytest.mark.parametrize("apart", [1e-4, 1e-3, 2e-3])
def test_states_in_close_pairs_do_not_multiply_their_rounding(apart):
    step, rate = math.radians(0.0514286), math.radians(30.0)
    history = StateHistory()
    for k in range(40):
        for t in (k * RATE_S, k * RATE_S + apart):
            pan = round(rate * t / step) * step
            history.add(PanTiltState(pan, 0.0, True, t), ZoomState(1000.0, False, t))
    times = np.arange(0.5, 1.4, 0.003)
    off = [history.interpolate(t).pan - rate * t for t in times]
    assert np.sqrt(np.mean(np.square(off))) < 0.5 * step
    assert history.interpolate(39 * RATE_S + apart) is not None  # the newest state is kept
