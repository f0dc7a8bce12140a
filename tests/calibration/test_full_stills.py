"""A rig that looks by full stills: the same lens and the same time, in larger pixels."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest

from cotarget.calibration.session import with_stills
from cotarget.errors import StaleFrameError
from cotarget.rig import Frame, ZoomState
from tests.support.rigs import rig_of

FACTOR = 10.2  # 3264 over 320: the PowerShot S5 IS
EXPOSED_AFTER = 0.3  # from asking for a still to its exposure [s]


@dataclass
class FakeClock:
    t: float = 100.0
    slept: list = field(default_factory=list)

    def now(self):
        return self.t

    def sleep_until(self, t):
        self.slept.append(t)
        self.t = max(self.t, t)


class FakeCamera:
    """A viewfinder of 320x240 and stills of another size; its focal lengths are of the viewfinder's pixels."""

    size, focal_range = (320, 240), (334.0, 4013.0)

    def __init__(self, clock, still_size):
        self.clock, self.still_size = clock, still_size
        self.sent = []

    def read(self, newer_than=None, timeout=1.0):
        raise AssertionError("the viewfinder was asked")

    def zoom(self, focal_px):
        self.sent.append(focal_px)
        return focal_px + 1.0

    def state(self):
        return ZoomState(500.0, True, 7.0)

    def capture(self):
        self.clock.t += EXPOSED_AFTER
        return Frame(np.zeros((*self.still_size[::-1], 3), np.uint8), self.clock.t)


@pytest.fixture
def rig():
    clock = FakeClock()
    zoom = FakeCamera(clock, (3264, 2448))
    return rig_of(SimpleNamespace(fixed=object(), zoom=zoom, head=object(), clock=clock, board=object()))


def test_a_rig_whose_stills_are_its_stream_stays_what_it_is(rig):
    rig.zoom.still_size = (320, 240)
    assert with_stills(rig) is rig


def test_everything_else_is_the_rig_s_own(rig):
    closed = []
    rig = replace(rig, release=lambda: closed.append(True))
    stills = with_stills(rig)
    assert (stills.fixed, stills.head, stills.clock, stills.board) == (rig.fixed, rig.head, rig.clock, rig.board)
    with stills as entered:
        assert entered is stills
        assert not closed
    assert closed == [True]


def test_focal_lengths_are_in_the_still_s_pixels(rig):
    stills = with_stills(rig)
    zoom, spec = stills.zoom, stills.spec.zoom
    assert (spec.size, spec.focal_range) == (zoom.size, zoom.focal_range)
    assert zoom.size == zoom.still_size == (3264, 2448)
    assert zoom.focal_range == pytest.approx((334.0 * FACTOR, 4013.0 * FACTOR))
    assert zoom.zoom(6800.0) == pytest.approx(6800.0 + FACTOR)  # the lens really reaches one pixel more
    assert rig.zoom.sent == pytest.approx([6800.0 / FACTOR])
    assert zoom.state() == ZoomState(pytest.approx(500.0 * FACTOR), True, 7.0)


def test_every_frame_is_a_still(rig):
    zoom = with_stills(rig).zoom
    for frame in (zoom.read(), zoom.capture(), zoom.read(newer_than=0.0)):
        assert frame.image.shape == (2448, 3264, 3)


def test_a_still_is_taken_after_the_time_that_is_asked_for(rig):
    """As when a head has just stopped, and its vibrations are to be over."""
    zoom = with_stills(rig).zoom
    frame = zoom.read(newer_than=100.5, timeout=5.0)
    assert frame.t == pytest.approx(100.5 + EXPOSED_AFTER)
    assert rig.clock.slept == [100.5]


def test_nobody_waits_for_ever(rig):
    with pytest.raises(StaleFrameError, match=r"a still is wanted of 9\.00 s from now, and within 5 s"):
        with_stills(rig).zoom.read(newer_than=109.0, timeout=5.0)
    assert rig.clock.t == 100.0
