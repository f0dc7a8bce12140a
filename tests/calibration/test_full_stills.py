"""A rig that looks by full stills: the same lens and the same time, in larger pixels."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cotarget.calibration.recorder import with_stills
from cotarget.errors import StaleFrameError
from cotarget.rig import Frame, ZoomState
from tests.support.rigs import rig_of
from tests.support.simulated_clock import SimClock

FACTOR = 10.2  # 3264 over 320: the PowerShot S5 IS
EXPOSED_AFTER = 0.3  # from asking for a still to its exposure [s]


class Viewfinder:
    """A camera with stills of another size than its viewfinder, in whose pixels focal lengths are."""

    size, focal_range = (320, 240), (334.0, 4013.0)

    def __init__(self, clock, still_size):
        self.clock, self.still_size, self.sent = clock, still_size, []

    def zoom(self, focal_px):
        self.sent.append(focal_px)
        return focal_px + 1.0

    def state(self):
        return ZoomState(500.0, True, 7.0)

    def capture(self):
        self.clock.sleep_until(self.clock.now() + EXPOSED_AFTER)
        return Frame(np.zeros((*self.still_size[::-1], 3), np.uint8), self.clock.now())


@pytest.fixture
def rig():
    clock = SimClock()
    zoom = Viewfinder(clock, (3264, 2448))
    return rig_of(SimpleNamespace(fixed=object(), zoom=zoom, head=object(), clock=clock, board=object()))


def test_stills_change_only_the_zoom_camera(rig):
    closed = []
    rig = replace(rig, release=lambda: closed.append(True))
    assert with_stills(replace(rig, zoom=Viewfinder(rig.clock, Viewfinder.size))).zoom.size == Viewfinder.size
    with with_stills(rig) as stills:
        assert (stills.fixed, stills.head, stills.clock, stills.board) == (rig.fixed, rig.head, rig.clock, rig.board)
        assert not closed
    assert closed == [True]


def test_focal_lengths_are_in_pixels_of_the_still(rig):
    stills = with_stills(rig)
    zoom, spec = stills.zoom, stills.spec.zoom
    assert (spec.size, spec.focal_range) == (zoom.size, zoom.focal_range)
    assert zoom.size == zoom.still_size == (3264, 2448)
    assert zoom.focal_range == pytest.approx((334.0 * FACTOR, 4013.0 * FACTOR))
    assert zoom.zoom(6800.0) == pytest.approx(6800.0 + FACTOR)  # the lens really reaches one pixel more
    assert rig.zoom.sent == pytest.approx([6800.0 / FACTOR])
    assert zoom.state() == ZoomState(pytest.approx(500.0 * FACTOR), True, 7.0)


def test_frames_are_stills_taken_after_the_wanted_time(rig):
    """As when a head has just stopped, and its vibrations are to be over."""
    zoom = with_stills(rig).zoom
    for frame in (zoom.read(), zoom.capture(), zoom.read(newer_than=0.0)):
        assert frame.image.shape == (2448, 3264, 3)
    assert zoom.read(newer_than=102.0, timeout=5.0).t == pytest.approx(102.0 + EXPOSED_AFTER)


def test_still_wanted_too_far_ahead_is_refused(rig):
    with pytest.raises(StaleFrameError):
        with_stills(rig).zoom.read(newer_than=109.0, timeout=5.0)
    assert rig.clock.now() == 100.0
