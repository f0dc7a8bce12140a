"""Latencies: of records whose delay is known, and of the simulation, which delays by what its config says."""

import cv2
import numpy as np
import pytest

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import parse_config
from cotarget.errors import CalibrationError
from cotarget.latency import command_delay, delay_between, measure_fixed, measure_head, picture_shifts
from cotarget.pantilt import HeadGeometry
from cotarget.rig import Frame, PanTiltState
from cotarget.rig_geometry import FixedCamera, ZoomHead

# The figure asked for is 10 ms; the simulation is measured without a wire in between.
CLOSE = 0.003  # [s]


def motion(t):
    """A swing that is no pure sine, so that whole periods are not alike."""
    return np.sin(2 * np.pi * t / 1.7) + 0.3 * np.sin(2 * np.pi * t / 0.9 + 1)


@pytest.mark.parametrize("delay", [-0.31, -0.02, 0.0, 0.084, 0.4])
def test_the_delay_between_two_records(delay):
    t = np.arange(0, 10, 0.1) + np.random.default_rng(0).uniform(0, 0.05, 100)
    t_other = np.arange(-1, 11, 0.027)
    found = delay_between(t, -30 * motion(t - delay) + 7, t_other, motion(t_other))
    assert found.seconds == pytest.approx(delay, abs=0.002)
    assert found.agreement > 0.99


def test_records_that_have_nothing_to_do_with_each_other_do_not_agree():
    rng = np.random.default_rng(1)
    t = np.arange(0, 10, 0.05)
    assert delay_between(t, rng.normal(size=len(t)), t, rng.normal(size=len(t))).agreement < 0.5
    assert delay_between(t, np.ones(len(t)), t, motion(t)).agreement == 0


def test_a_shifted_picture_tells_its_shift():
    rng = np.random.default_rng(2)
    scene = cv2.GaussianBlur(rng.uniform(0, 255, (120, 260, 3)).astype(np.uint8), (0, 0), 2)
    images = [np.ascontiguousarray(scene[:, 50 - shift : 210 - shift]) for shift in (0, 3, -12, 20)]
    np.testing.assert_allclose(picture_shifts(images), [0, 3, -12, 20], rtol=0.01, atol=0.01)


def test_a_command_is_dated_to_where_its_acceleration_begins():
    """At 2 rad/s^2 from 0.05 s after the command: 0.01 rad at 0.15 s, 0.04 rad at 0.25 s."""
    states = [PanTiltState(pan, 0.0, True, t) for t, pan in ((0.0, 0.0), (0.15, 0.01), (0.25, 0.04), (0.4, 0.1))]
    assert command_delay([(0.0, 0.0, 0.2)], states, 2.0) == pytest.approx(0.05)
    assert np.isnan(command_delay([(0.0, 0.0, 0.2)], states[:1], 2.0))


class LateCamera:
    """A camera whose frames claim to be later than they are."""

    def __init__(self, camera, by):
        self._camera, self._by = camera, by

    def __getattr__(self, name):
        return getattr(self._camera, name)

    def read(self, newer_than=None, timeout=1.0):
        frame = self._camera.read(None if newer_than is None else newer_than - self._by, timeout)
        return Frame(frame.image, frame.t + self._by)


SMALL = {"fixed": {"rate_hz": 15.0}, "zoom": {"rate_hz": 10.0, "size": [320, 240]}}


class Wrapped:
    def __init__(self, rig, **changed):
        self.fixed, self.zoom, self.head, self.clock, self.board = rig.fixed, rig.zoom, rig.head, rig.clock, rig.board
        self.__dict__.update(changed)


@pytest.fixture(scope="module")
def world():
    from cotarget.sim.world import SimWorld

    world = SimWorld(parse_config({"sim": SMALL}))
    yield world
    world.rig.close()


@pytest.fixture
def outdoors():
    from cotarget.sim.world import SimWorld

    world = SimWorld(parse_config({"sim": {**SMALL, "scene": "outdoor"}}))
    yield world
    world.rig.close()


@pytest.mark.render
@pytest.mark.parametrize("late", [pytest.param(0.0, marks=pytest.mark.slow), 0.045])
def test_the_zoom_camera_against_the_head(world, late):
    found = measure_head(Wrapped(world.rig, zoom=LateCamera(world.rig.zoom, late)), seconds=4.0)
    assert found.zoom.seconds == pytest.approx(late, abs=CLOSE)
    assert found.command == pytest.approx(world.config.sim.head.command_delay_s, abs=CLOSE)


@pytest.mark.render
def test_a_picture_that_stands_still_is_no_measurement(world):
    frame = world.rig.zoom.read()

    class Frozen(LateCamera):
        def read(self, newer_than=None, timeout=1.0):
            return Frame(frame.image, super().read(newer_than, timeout).t)

    frozen = Wrapped(world.rig, zoom=Frozen(world.rig.zoom, 0.0))
    with pytest.raises(
        CalibrationError, match=r"at pan 0\.0, tilt 0\.0 degrees does not move with the head .* the sky$"
    ):
        measure_head(frozen, seconds=4.0)


@pytest.mark.render
@pytest.mark.parametrize(
    ("pan_deg", "tilt_deg", "ends_at_deg"),
    [
        pytest.param(10.0, 5.0, (10.0, 5.0), id="the ground below the horizon"),
        pytest.param(0.0, 28.0, (0.0, 0.0), id="the sky alone, then straight ahead"),
    ],
)
def test_the_head_is_measured_where_it_stands_or_straight_ahead(outdoors, pan_deg, tilt_deg, ends_at_deg):
    outdoors.rig.head.move(np.radians(pan_deg), np.radians(tilt_deg), wait=True)
    found = measure_head(outdoors.rig, seconds=4.0)
    assert found.zoom.seconds == pytest.approx(0.0, abs=CLOSE)
    assert found.command == pytest.approx(outdoors.config.sim.head.command_delay_s, abs=CLOSE)
    state = outdoors.rig.head.state()
    assert np.degrees([state.pan, state.tilt]) == pytest.approx(ends_at_deg, abs=0.06)  # a step of the head


@pytest.mark.slow
@pytest.mark.render
def test_the_fixed_camera_against_the_zoom_camera(world):
    sim = world.config.sim
    calibration = Calibration(
        fixed=FixedCamera(Intrinsics(sim.fixed.size, sim.fixed.focal_px, sim.fixed.center_px, sim.fixed.distortion)),
        zoom_head=ZoomHead(
            ZoomLens(
                (world.rig.zoom.focal_range[0],),
                (Intrinsics(sim.zoom.size, sim.zoom.focal_px, sim.zoom.center_px, sim.zoom.distortion),),
                (0.0,),
            ),
            sim.T_zoom0_fixed,
            sim.T_head_zoom,
            HeadGeometry(),
        ),
    )
    late = Wrapped(world.rig, fixed=LateCamera(world.rig.fixed, 0.03))
    found, frames = measure_fixed(late, calibration, world.config.board, seconds=4.0)
    assert found.seconds == pytest.approx(0.03, abs=CLOSE)
    assert frames > 40
    with pytest.raises(CalibrationError, match="the fixed camera saw the swinging board in"):
        measure_fixed(late, calibration, world.config.board, seconds=1.0)
