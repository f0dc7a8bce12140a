"""Latencies: of records whose delay is known, and of the simulation, which delays by what its config says."""

import math
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import SafetyConfig, parse_config
from cotarget.errors import CalibrationError, DeviceError
from cotarget.latency import (
    HorizontalShift,
    command_delay,
    delay_between,
    lateness,
    log_scales,
    measure_fixed,
    measure_head,
    measure_lens,
    start_of_motion,
)
from cotarget.pantilt import HeadGeometry
from cotarget.rig import AxisLimits, Frame, PanTiltState, refuse_outside
from cotarget.rig_geometry import FixedCamera, ZoomHead
from cotarget.sim.world import SimWorld
from tests.support.rigs import guarded, with_axes
from tests.support.safety_rigs import SimulatedDevices

# The figure asked for is 10 ms; the simulation is measured without a wire in between.
CLOSE = 0.003  # [s]


AXIS = AxisLimits((-1.0, 1.0), 4.0, 2.0)


def motion(t):
    """A swing that is no pure sine, so that whole periods are not alike."""
    return np.sin(2 * np.pi * t / 1.7) + 0.3 * np.sin(2 * np.pi * t / 0.9 + 1)


@pytest.mark.parametrize("delay", [-0.9, -0.02, 0.0, 0.084, 1.0])
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


def test_a_shifted_picture_tells_its_shift_also_behind_what_moves_otherwise():
    """A quarter of the picture shows something else that moves by itself, as a person who walks by does."""
    rng = np.random.default_rng(2)
    scene, other = (cv2.GaussianBlur(rng.uniform(0, 255, (240, 420, 3)).astype(np.uint8), (0, 0), 2) for _ in range(2))
    shift = HorizontalShift()
    for by, walked in ((0, 50), (3, 60), (-12, 120), (20, 180)):
        image = np.ascontiguousarray(scene[:, 50 - by : 370 - by])
        image[60:, walked : walked + 110] = other[60:, :110]
        assert shift.of(image) == pytest.approx(by, abs=0.1)


@pytest.mark.parametrize("grain_px", [1.5, 4.0, 12.0])
def test_fine_texture_of_a_large_picture_tells_its_shift(grain_px):
    """1.5 degrees of a view of 30 degrees are 96 px of 1920."""
    noise = np.random.default_rng(4).normal(0, 1, (1080, 2020)).astype(np.float32)
    scene = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), grain_px), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    shift = HorizontalShift()
    for by in (0, 43, 90):
        assert shift.of(np.repeat(scene[:, 100 - by : 2020 - by, None], 3, axis=2)) == pytest.approx(by, abs=0.5)


@pytest.mark.parametrize("side", [0, 30])
def test_a_picture_without_structure_has_no_shift(side):
    """Nor has one that shows a square alone."""
    shift, images = HorizontalShift(), np.full((2, 60, 80, 3), 128, np.uint8)
    images[0, 15 : 15 + side, 20 : 20 + side] = images[1, 15 : 15 + side, 25 : 25 + side] = 255
    assert [shift.of(image) for image in images] == [0.0, 0.0]


def test_a_command_is_dated_to_where_its_acceleration_begins():
    """At 2 rad/s^2 from 0.05 s after the command: 0.01 rad at 0.15 s, 0.04 rad at 0.25 s."""
    states = [PanTiltState(pan, 0.0, True, t) for t, pan in ((0.0, 0.0), (0.15, 0.01), (0.25, 0.04), (0.4, 0.1))]
    assert command_delay([(0.0, 0.0, 0.2)], states, AXIS) == pytest.approx(0.05)
    assert np.isnan(command_delay([(0.0, 0.0, 0.2)], states[:1], AXIS))


@pytest.mark.parametrize("tremble", [0.0, 0.002])
@pytest.mark.parametrize("stated", [0.5, 0.9, 1.1, 2.0])
def test_a_motion_that_does_not_fit_the_heads_acceleration_is_no_measurement(stated, tremble):
    """10 turns of 0.2 rad to and fro at 2 rad/s^2, each 0.05 s after its command, and reported every 20 ms.

    A servo trembles where it stands.
    """
    limits = replace(AXIS, acceleration=2.0 * stated, slack=1.5 * tremble)
    starts, states = [], []
    for turn in range(10):
        t, before, goal = turn, 0.2 * (turn % 2), 0.2 * ((turn + 1) % 2)
        starts.append((t, before, goal))
        for since in np.arange(0.0, 0.25, 0.02):
            gone = max(since - 0.05, 0.0) ** 2 or tremble * (len(states) % 2)
            states.append(PanTiltState(before + np.sign(goal - before) * gone, 0.0, True, t + since))
    if 0.8 < stated < 1.2:
        assert command_delay(starts, states, limits) == pytest.approx(0.05, abs=0.01)
        unknown = replace(limits, acceleration=None)
        assert command_delay(starts, states, unknown) == pytest.approx(0.05, abs=0.01)
    else:
        with pytest.raises(CalibrationError, match=f"{np.degrees(2.0 * stated):.0f} degrees"):
            command_delay(starts, states, limits)


class LateCamera:
    """A camera whose frames claim to be later than they are."""

    def __init__(self, camera, by):
        self._camera, self._by = camera, by

    def __getattr__(self, name):
        return getattr(self._camera, name)

    def read(self, newer_than=None, timeout=1.0):
        frame = self._camera.read(None if newer_than is None else newer_than - self._by, timeout)
        return Frame(frame.image, frame.t + self._by)


# Pictures of a quarter of the size, without what takes most of the rendering and delays nothing.
PLAIN = {"effects": dict.fromkeys(("noise", "jpeg", "blur", "multisampling"), False)}
SMALL = {"fixed": {"rate_hz": 15.0}, "zoom": {"rate_hz": 10.0, "size": [320, 240]}} | PLAIN


class FrozenCamera(LateCamera):
    """A camera that gives one image over and over, with new times."""

    def __init__(self, camera):
        super().__init__(camera, 0.0)
        self.image = camera.read().image

    def read(self, newer_than=None, timeout=1.0):
        return Frame(self.image, super().read(newer_than, timeout).t)


class StallingCamera(LateCamera):
    """A camera of a busy machine, which comes to read a frame 0.3 s late now and then."""

    def __init__(self, camera, clock):
        super().__init__(camera, 0.0)
        self.clock, self.calls = clock, 0

    def read(self, newer_than=None, timeout=1.0):
        self.calls += 1
        if self.calls % 50 == 0:
            self.clock.sleep_until(self.clock.now() + 0.3)
        return super().read(newer_than, timeout)


class WeakHead(LateCamera):
    """A head that states a third of its acceleration."""

    @property
    def limits(self):
        return with_axes(self._camera.limits, acceleration=self._camera.limits.pan.acceleration / 3)


@pytest.mark.parametrize(("times", "states", "named"), [
    (np.arange(20) / 10, np.arange(200) / 100, ""),
    (np.delete(np.arange(20) / 10, [5]), (), ""),  # one was not read in time
    (np.delete(np.arange(20) / 10, [5, 6]), (), "^frames of the zoom camera came 0.30 s apart, and not 0.10 s"),
    (np.arange(20) / 5, (), "every 0.200 s, and not every 0.100 s as hardware.zoom.rate_hz says"),
    (np.arange(200) / 50, np.repeat(np.arange(8) / 2, 25), ""),  # a head that reports seldom, as over a network
    (np.arange(20) / 10, np.delete(np.arange(200) / 100, np.s_[9:40]), "^reports of the head came 0.32 s apart, "),
])  # fmt: skip
def test_frames_and_reports_that_come_late(times, states, named):
    late = lateness(times, 10.0, states)
    assert re.search(named, late) if named else not late


@pytest.fixture(scope="module")
def world():
    world = SimWorld(parse_config({"sim": SMALL}))
    yield world
    world.rig.close()


@pytest.fixture
def outdoors():
    world = SimWorld(parse_config({"sim": {**SMALL, "scene": "outdoor"}}))
    yield world
    world.rig.close()


@pytest.mark.render
@pytest.mark.parametrize("late", [pytest.param(0.0, marks=pytest.mark.slow), 0.045])
def test_the_zoom_camera_against_the_head(world, late):
    found = measure_head(replace(world.rig, zoom=LateCamera(world.rig.zoom, late)), seconds=4.0)
    assert found.zoom.seconds == pytest.approx(late, abs=CLOSE)
    assert found.command == pytest.approx(world.config.sim.head.command_delay_s, abs=CLOSE)


def test_a_head_beyond_its_limits_is_not_moved():
    devices = SimulatedDevices()
    devices.head.move(np.radians(100), 0.0, wait=True)
    with guarded(devices, SafetyConfig(pan_deg=(-45.0, 45.0))) as rig:
        devices.head.log.clear()
        with pytest.raises(DeviceError, match="cotarget point --rig RIG --pan-deg"):
            measure_head(rig)
        assert devices.head.log == []
        servo = with_axes(rig.head.limits, slack=math.radians(60.0))
        refuse_outside(devices.head.state(), servo)  # it may rest so far off a goal at the limit


@pytest.mark.render
@pytest.mark.parametrize("broken", ["head", "zoom"])
@pytest.mark.parametrize("busy", [False, True])
def test_a_busy_machine_is_named_in_place_of_what_may_be_right(world, broken, busy):
    zoom, head = world.rig.zoom, world.rig.head
    zoom, head = (FrozenCamera(zoom), head) if broken == "zoom" else (zoom, WeakHead(head, 0.0))
    rig = replace(world.rig, zoom=StallingCamera(zoom, world.rig.clock) if busy else zoom, head=head)
    usual = "correct the head's limits" if broken == "head" else r"pan 0\.0, tilt 0\.0 degrees .* structure"
    with pytest.raises(CalibrationError, match="reports of the head came 0.3.* too busy" if busy else usual):
        measure_head(rig, seconds=4.0)


@pytest.mark.render
@pytest.mark.parametrize(
    ("pan_deg", "tilt_deg"),
    [
        pytest.param(10.0, 5.0, id="the ground below the horizon"),
        pytest.param(0.0, 28.0, id="the sky and its clouds"),
    ],
)
def test_the_head_is_measured_where_it_stands(outdoors, pan_deg, tilt_deg):
    outdoors.rig.head.move(np.radians(pan_deg), np.radians(tilt_deg), wait=True)
    found = measure_head(outdoors.rig, seconds=4.0)
    assert found.zoom.seconds == pytest.approx(0.0, abs=CLOSE)
    assert found.command == pytest.approx(outdoors.config.sim.head.command_delay_s, abs=CLOSE)
    state = outdoors.rig.head.state()
    assert np.degrees([state.pan, state.tilt]) == pytest.approx([pan_deg, tilt_deg], abs=0.06)  # a step of the head


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
    late = replace(world.rig, fixed=LateCamera(world.rig.fixed, 0.03))
    found = measure_fixed(late, calibration, world.config.board, seconds=4.0)
    assert found.seconds == pytest.approx(0.03, abs=CLOSE)
    with pytest.raises(CalibrationError, match="the fixed camera saw the swinging board in"):
        measure_fixed(late, calibration, world.config.board, seconds=1.0)


# The lens

SMALL_LENS = {"size": [320, 240], "rate_hz": 15.0}  # a quarter of the rendering
LENS_CLOSE = 0.01  # [s], with 15 frames a second


def scene():
    noise = np.random.default_rng(0).uniform(0, 255, (240, 320, 3)).astype(np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 3)


def test_a_picture_that_grows_tells_its_scale():
    wanted = np.array([0.0, 0.0, 0.06, 0.12, 0.12, 0.02])
    pictures = [cv2.warpAffine(scene(), cv2.getRotationMatrix2D((160, 120), 0, np.exp(s)), (320, 240)) for s in wanted]
    np.testing.assert_allclose(log_scales(pictures), wanted, atol=0.003)


def test_a_picture_without_structure_tells_nothing():
    assert np.isnan(log_scales([np.full((60, 80, 3), 128, np.uint8)] * 3)[1:]).all()


@pytest.mark.parametrize("began_at", [0.5, 0.52, 0.569])
def test_an_even_way_began_where_it_leads_back_to(began_at):
    times = np.arange(0.0, 1.5, 0.07)
    assert start_of_motion(times, np.clip((times - began_at) / 0.4, 0.0, 1.0)) == pytest.approx(began_at, abs=1e-6)


def test_a_way_between_two_frames_began_between_them():
    assert start_of_motion(np.array([0.0, 0.1, 0.2, 0.3]), np.array([0.0, 0.0, 1.0, 1.0])) == pytest.approx(0.15)


@pytest.mark.render
def test_delays_of_a_second():
    """As of a network camera whose stream is behind, on a head that is slow to begin."""
    with SimWorld(parse_config({"sim": {**SMALL, "head": {"command_delay_s": 0.95}}})).rig as rig:
        found = measure_head(replace(rig, zoom=LateCamera(rig.zoom, 0.9)), seconds=6.0)
    assert (found.zoom.seconds, found.command) == pytest.approx((0.9, 0.95), abs=CLOSE)


@pytest.mark.render
@pytest.mark.parametrize(("late", "delay_s"), [pytest.param(0.0, 0.12, marks=pytest.mark.slow), (0.9, 0.95)])
def test_the_simulated_lens(late, delay_s):
    config = parse_config({"sim": {"zoom": SMALL_LENS, "head": {"command_delay_s": delay_s}} | PLAIN})
    with SimWorld(config).rig as rig:
        found = measure_lens(replace(rig, zoom=LateCamera(rig.zoom, late)), late)
        assert found == pytest.approx(delay_s, abs=LENS_CLOSE)
        assert rig.zoom.state().focal_px == pytest.approx(rig.zoom.focal_range[0])


@pytest.mark.render
def test_a_picture_that_does_not_grow_is_no_measurement():
    world = SimWorld(parse_config({"sim": {"zoom": SMALL_LENS} | PLAIN}))
    with world.rig as rig, pytest.raises(CalibrationError, match=r"1\.00 times"):
        measure_lens(replace(rig, zoom=FrozenCamera(rig.zoom)))


def test_a_lens_without_zoom_is_an_error():
    config = parse_config({"sim": {"zoom": {"focal_mm": [6.0, 6.3]}, "effects": {"optics": False}}})
    with SimWorld(config, rendered=()).rig as rig, pytest.raises(CalibrationError, match=r"zooms by 1\.05 times"):
        measure_lens(rig)
