"""The lens table of the S5 IS against hand-worked focal lengths, and the driver's own estimate of where a lens is."""

import math

import pytest

from cotarget.drivers.gphoto_camera import S5_IS_LENS
from cotarget.drivers.lens import LensMotion, LensPositions

PITCH_MM = 0.01794  # 5.74 mm of sensor on 320 px
S5_IS = LensPositions(S5_IS_LENS, tuple(range(129)), PITCH_MM)
ROUNDING = 1e-9


@pytest.mark.parametrize(("position", "mm"), S5_IS_LENS)
def test_knots_have_their_own_focal_lengths(position, mm):
    assert S5_IS.focal_at(position) * PITCH_MM == pytest.approx(mm, rel=ROUNDING)
    assert S5_IS.position_for(mm / PITCH_MM) == position


def test_between_knots_equal_steps_are_equal_ratios():
    """Halfway between 21.3 mm at 64 and 41.6 mm at 86 is their geometric mean, 29.767 mm at 75."""
    assert S5_IS.focal_at(75) * PITCH_MM == pytest.approx(math.sqrt(21.3 * 41.6), rel=ROUNDING)
    assert S5_IS.position_for(29.767 / PITCH_MM) == 75


def test_focal_lengths_go_to_the_nearest_position():
    """A third of a step more or less is still that position: in one segment that is a third of its ratio."""
    third = (12.1 / 6.4) ** (1 / 30 / 3)
    assert {S5_IS.position_for(S5_IS.focal_at(20) * factor) for factor in (third, 1 / third)} == {20}


@pytest.mark.parametrize(("focal_px", "position"), [(1e-3, 0), (300.0, 0), (1e6, 128)])
def test_beyond_the_lens_is_its_end(focal_px, position):
    assert S5_IS.position_for(focal_px) == position


def test_range_is_that_of_the_positions_that_can_be_commanded():
    assert S5_IS.focal_at(134) == S5_IS.focal_at(128)
    assert S5_IS.focal_range == pytest.approx((6.0 / PITCH_MM, 72.0 / PITCH_MM))
    coarse = LensPositions(((0, 10.0), (10, 100.0)), (2, 4, 6, 8), 0.01)
    assert coarse.focal_range == pytest.approx((10.0 * 10**0.2 / 0.01, 10.0 * 10**0.8 / 0.01))
    assert [coarse.position_for(mm / 0.01) for mm in (10.0, 10**1.45, 100.0)] == [2, 4, 8]


def test_a_lens_moves_at_its_speed_after_the_delay():
    """From 10 to 40 at 60 a second from 2.0 s on: half a second."""
    motion = LensMotion(10, 10, 0.0, 60.0).toward(40, 2.0)
    assert [motion.position(t) for t in (1.0, 2.0, 2.25, 2.5, 9.0)] == pytest.approx([10, 10, 25, 40, 40])
    assert motion.arrives == 2.5


def test_a_new_goal_in_motion_turns_the_lens_where_it_is_then():
    """At 2.25 s it is at 25 and keeps its way until 2.3 s, at 28; back to 16 takes 0.2 s more."""
    turned = LensMotion(10, 10, 0.0, 60.0).toward(40, 2.0).toward(16, 2.3)
    assert [turned.position(t) for t in (2.25, 2.3, 2.4, 2.5, 3.0)] == pytest.approx([25, 28, 22, 16, 16])
    assert turned.arrives == pytest.approx(2.5)


def test_many_commands_leave_no_chain_behind():
    motion = LensMotion(0, 0, 0.0, 60.0)
    for i in range(100):
        motion = motion.toward(i % 50, i * 0.1)
    assert motion.before is not None
    assert motion.before.before is None
