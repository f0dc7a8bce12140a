"""The contract of `cotarget.rig.Camera`: what every camera promises, the zoom camera included."""

import numpy as np
import pytest

from cotarget.errors import StaleFrameError
from cotarget.rig import FUTURE_S, Frame
from tests.support.device_ways import CAMERAS, contract

LONG_S = 20.0  # for a frame that should come at once
SHORT_S = 0.2  # for one that does not come


def frames_are_colour_images_of_the_cameras_size(camera, clock):
    frame = camera.read(timeout=LONG_S)
    width, height = camera.size
    assert isinstance(frame, Frame)
    assert frame.image.shape == (height, width, 3)
    assert frame.image.dtype == np.uint8


def frames_were_exposed_in_the_past(camera, clock):
    for _ in range(3):
        frame = camera.read(timeout=LONG_S)
        assert frame.t <= clock.now() + FUTURE_S


def no_frame_is_given_twice_with_newer_than(camera, clock):
    t = camera.read(timeout=LONG_S).t
    for _ in range(5):
        newer = camera.read(newer_than=t, timeout=LONG_S)
        assert newer.t > t
        t = newer.t


def a_frame_that_is_old_by_now_is_waited_for(camera, clock):
    camera.read(timeout=LONG_S)
    now = clock.now()
    assert camera.read(newer_than=now, timeout=LONG_S).t > now


def a_frame_that_does_not_come_in_time_is_an_error_and_takes_the_time(camera, clock):
    camera.read(timeout=LONG_S)
    begin = clock.now()
    with pytest.raises(StaleFrameError):
        camera.read(newer_than=begin + 1000.0, timeout=SHORT_S)
    assert begin + 0.9 * SHORT_S < clock.now() < begin + LONG_S
    assert camera.read(newer_than=begin, timeout=LONG_S).t > begin


@contract(
    CAMERAS,
    [
        frames_are_colour_images_of_the_cameras_size,
        frames_were_exposed_in_the_past,
        no_frame_is_given_twice_with_newer_than,
        a_frame_that_is_old_by_now_is_waited_for,
        a_frame_that_does_not_come_in_time_is_an_error_and_takes_the_time,
    ],
)
def test_camera(way, promise, tmp_path):
    way.keep(promise, tmp_path)
