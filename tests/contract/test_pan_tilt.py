"""The contract of `cotarget.rig.PanTilt`: what every pan-tilt head promises."""

import math

import pytest

from cotarget.errors import DeviceError
from tests.support.device_ways import HEADS, contract, settle

AT_ONCE_S = 1.0  # a command or a halt does not wait for the head, which takes longer for its range
ROUNDING = 1e-9
SLOW = 0.5  # rad/s
FAR = 0.4  # rad


def limits_are_ascending_and_positive(head, clock):
    limits = head.limits
    assert limits.pan.range[0] < limits.pan.range[1]
    assert limits.tilt.range[0] < limits.tilt.range[1]
    assert limits.pan.speed > 0
    assert limits.pan.acceleration is None or limits.pan.acceleration > 0
    assert limits.pan.step >= 0


def move_returns_what_is_commanded_after_rounding_to_steps(head, clock):
    step = head.limits.pan.step
    pan, tilt = head.move(40.4 * step, -20.6 * step)
    assert (pan, tilt) == (pytest.approx(40 * step, abs=ROUNDING), pytest.approx(-21 * step, abs=ROUNDING))


def move_returns_what_is_commanded_after_clipping_to_the_limits(head, clock):
    limits = head.limits
    for sign, end in ((-9, 0), (9, 1)):
        commanded = head.move(sign, sign)
        assert limits.allow(*(angle * (1 - ROUNDING) for angle in commanded))
        for angle, ends in zip(commanded, (limits.pan.range, limits.tilt.range), strict=True):
            assert angle == pytest.approx(ends[end], abs=limits.pan.step)


def move_returns_at_once_and_the_head_moves_until_it_stands_there(head, clock):
    begin = clock.now()
    commanded = head.move(FAR, -FAR / 2)
    state = head.state()
    assert clock.now() < begin + AT_ONCE_S
    assert state.moving
    assert state.pan < FAR
    state = settle(head, clock)
    assert (state.pan, state.tilt) == pytest.approx(commanded, abs=ROUNDING)


def move_waits_on_request_until_the_head_stands(head, clock):
    commanded = head.move(-FAR, FAR / 2, wait=True)
    state = head.state()
    assert not state.moving
    assert (state.pan, state.tilt) == pytest.approx(commanded, abs=ROUNDING)


def no_axis_is_faster_than_commanded(head, clock):
    for speed in (SLOW, (SLOW, 2 * SLOW)):
        head.move(0.0, 0.0, wait=True)
        begin = clock.now()
        head.move(FAR, FAR / 2, speed=speed, wait=True)
        assert clock.now() - begin >= FAR / SLOW - head.limits.pan.step / SLOW


def the_newest_command_wins(head, clock):
    head.move(FAR, FAR)
    commanded = head.move(-FAR / 2, 0.0, wait=True)
    state = head.state()
    assert (state.pan, state.tilt) == pytest.approx(commanded, abs=ROUNDING)


def states_are_from_the_past_and_in_order(head, clock):
    head.move(FAR, 0.0)
    last = -math.inf
    for _ in range(5):
        state = head.state()
        assert last <= state.t <= clock.now()
        last = state.t
        clock.sleep_until(clock.now() + 0.02)


def a_halt_stops_short_of_the_goal_as_often_as_it_is_called(head, clock):
    head.halt()
    head.move(2.0, 0.0, speed=SLOW)
    while head.state().pan < 0.05:
        clock.sleep_until(clock.now() + 0.02)
    begin = clock.now()
    head.halt()
    head.halt()
    assert clock.now() < begin + AT_ONCE_S
    halted = settle(head, clock).pan
    assert 0.05 <= halted < 1.0
    clock.sleep_until(clock.now() + 0.2)
    assert head.state().pan == halted


def a_halted_head_may_be_moved_again(head, clock):
    head.move(2.0, 0.0, speed=SLOW)
    head.halt()
    commanded = head.move(-FAR, 0.0, wait=True)
    assert head.state().pan == pytest.approx(commanded[0], abs=ROUNDING)


def what_is_no_angle_or_speed_is_an_error_and_moves_nothing(head, clock):
    before = settle(head, clock)
    for pan, tilt, speed in ((math.nan, 0.0, None), (0.0, math.nan, None), (1.0, 0.0, 0.0), (1.0, 0.0, math.nan)):
        with pytest.raises(DeviceError):
            head.move(pan, tilt, speed)
    after = settle(head, clock)
    assert (after.pan, after.tilt) == (before.pan, before.tilt)


@contract(
    HEADS,
    [
        limits_are_ascending_and_positive,
        move_returns_what_is_commanded_after_rounding_to_steps,
        move_returns_what_is_commanded_after_clipping_to_the_limits,
        move_returns_at_once_and_the_head_moves_until_it_stands_there,
        move_waits_on_request_until_the_head_stands,
        no_axis_is_faster_than_commanded,
        the_newest_command_wins,
        states_are_from_the_past_and_in_order,
        a_halt_stops_short_of_the_goal_as_often_as_it_is_called,
        a_halted_head_may_be_moved_again,
        what_is_no_angle_or_speed_is_an_error_and_moves_nothing,
    ],
)
def test_pan_tilt(way, promise, tmp_path):
    way.keep(promise, tmp_path)
