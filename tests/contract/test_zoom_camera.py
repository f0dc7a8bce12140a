"""The contract of `cotarget.rig.ZoomCamera`: what every zoom camera promises of its lens and its stills."""

import math

import pytest

from cotarget.errors import DeviceError
from tests.support.device_ways import ZOOM_CAMERAS, contract, settle

AT_ONCE_S = 1.0  # a command does not wait for the lens, which takes longer from end to end
ROUNDING = 1e-9


def ends_and_middle(camera):
    shortest, longest = camera.focal_range
    return shortest, math.sqrt(shortest * longest), longest


def the_range_is_ascending_and_positive(camera, clock):
    shortest, longest = camera.focal_range
    assert 0 < shortest < longest


def zoom_returns_at_once_what_the_lens_will_reach(camera, clock):
    for focal in ends_and_middle(camera):
        begin = clock.now()
        reached = camera.zoom(focal)
        assert clock.now() < begin + AT_ONCE_S
        assert settle(camera, clock).focal_px == pytest.approx(reached, rel=ROUNDING)


def what_is_beyond_the_range_is_its_end(camera, clock):
    shortest, longest = camera.focal_range
    assert camera.zoom(longest * 100) == pytest.approx(longest, rel=ROUNDING)
    assert camera.zoom(shortest / 100) == pytest.approx(shortest, rel=ROUNDING)


def what_can_be_reached_is_reached_exactly(camera, clock):
    for focal in ends_and_middle(camera):
        reached = camera.zoom(focal)
        assert camera.zoom(reached) == pytest.approx(reached, rel=ROUNDING)


def the_newest_command_wins(camera, clock):
    _, middle, longest = ends_and_middle(camera)
    camera.zoom(longest)
    reached = camera.zoom(middle)
    assert settle(camera, clock).focal_px == pytest.approx(reached, rel=ROUNDING)


def the_lens_moves_from_the_command_on_and_passes_through_its_range(camera, clock):
    shortest, _, longest = ends_and_middle(camera)
    camera.zoom(shortest)
    settle(camera, clock)
    camera.zoom(longest)
    state = camera.state()
    assert state.moving
    assert shortest * (1 - ROUNDING) <= state.focal_px < longest
    assert state.t <= clock.now()


def what_is_no_focal_length_is_an_error_and_moves_nothing(camera, clock):
    before = settle(camera, clock).focal_px
    for focal in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(DeviceError):
            camera.zoom(focal)
    assert camera.state().focal_px == before


def a_still_is_of_its_own_size_and_exposed_during_the_call(camera, clock):
    camera.read(timeout=20.0)
    begin = clock.now()
    still = camera.capture()
    width, height = camera.still_size
    assert still.image.shape == (height, width, 3)
    assert begin < still.t <= clock.now()


@contract(
    ZOOM_CAMERAS,
    [
        the_range_is_ascending_and_positive,
        zoom_returns_at_once_what_the_lens_will_reach,
        what_is_beyond_the_range_is_its_end,
        what_can_be_reached_is_reached_exactly,
        the_newest_command_wins,
        the_lens_moves_from_the_command_on_and_passes_through_its_range,
        what_is_no_focal_length_is_an_error_and_moves_nothing,
        a_still_is_of_its_own_size_and_exposed_during_the_call,
    ],
)
def test_zoom_camera(way, promise, tmp_path):
    way.keep(promise, tmp_path)
