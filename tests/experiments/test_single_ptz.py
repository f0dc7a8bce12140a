"""A lone pan-tilt-zoom camera: where it looks, what it expects, and that it finds what it lost."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cotarget.config import DEFAULT_TARGETS
from cotarget.detection import Detections
from cotarget.evaluation import TruthDetector, TruthNoise, true_calibration
from cotarget.sim.truth import Outlines
from cotarget.sim.world import SimWorld
from experiments.following import single_ptz
from experiments.following.lone_camera import COAST_S, SEARCH_S, Course, LoneCamera, Sighting, scan_of

BOOK = DEFAULT_TARGETS["book"]
STEP = 0.04
SCAN_POSES = 4  # two rows of two views that are as wide as the wide one, turned and aside


def test_a_course_leads_by_its_velocity():
    course = Course(BOOK, 0.5)
    assert not course.known
    side = BOOK.size / 10
    for i in range(25):
        t = i * STEP
        course.saw(Sighting(t, 0.2 * t, 0.1 - 0.1 * t, (side, side / 2), False), 700.0)
    (pan, tilt), variances = course.at(1.2)
    assert (pan, tilt) == pytest.approx((0.24, -0.02), abs=2e-3)
    assert course.rates == pytest.approx((0.2, -0.1), abs=5e-3)
    assert (course.size, course.range) == (side, pytest.approx(10.0))
    assert min(variances) > 0
    assert course.at(2.0)[1][0] > 10 * variances[0]
    course.saw(Sighting(9.0, 1.0, 0.0, (side, side / 2), False), 700.0)  # after that long, begun anew
    assert course.at(9.0)[0] == pytest.approx((1.0, 0.0))


@pytest.fixture
def world():
    with (w := SimWorld(single_ptz.config_of("book", 0), rendered=())).rig:
        yield w


@pytest.mark.parametrize("size", [(640, 480), (1280, 960), (320, 240)])
def test_a_scan_sees_all_that_the_wide_camera_does(size):
    config = single_ptz.config_of("book", 0)
    scale = size[0] / config.sim.fixed.size[0]
    focal_px = tuple(scale * focal for focal in config.sim.fixed.focal_px)
    fixed = replace(config.sim.fixed, size=size, focal_px=focal_px, center_px=tuple((side - 1) / 2 for side in size))
    world = SimWorld(replace(config, sim=replace(config.sim, fixed=fixed)), rendered=())
    calibration = true_calibration(world)
    poses = np.array(scan_of(world.rig, calibration))
    rim = np.array([[u, v] for u in (0.0, 0.5, 1.0) for v in (0.0, 0.5, 1.0)]) * (np.array(size) - 1.0)
    far = calibration.fixed.ray(rim) * 1000.0  # where the cameras' offset does not count
    x = calibration.zoom_head.T_base_fixed.apply(far)
    pans, tilts = np.arctan2(x[:, 0], x[:, 2]), np.arctan2(-x[:, 1], np.hypot(x[:, 0], x[:, 2]))
    f = calibration.zoom_head.lens.stops[0].focal_px[0]
    across, down = math.atan(320 / f), math.atan(240 / f)
    for pan, tilt in zip(pans, tilts, strict=True):
        near = (np.abs(poses[:, 0] - pan) < across) & (np.abs(poses[:, 1] - tilt) < down)
        assert near.any(), np.degrees([pan, tilt])
    assert len(poses) == SCAN_POSES  # and no more than that


class Blind:
    """Finds the book as the truth has it, until a time; then nothing."""

    def __init__(self, truth, until):
        self._finder, self._until = TruthDetector(truth, 0, TruthNoise(0.0, 0.0, 0.0), camera="zoom"), until

    def detect(self, frame, held=()):
        return self._finder.detect(frame) if frame.t < self._until else Detections([])


def looked(world, until, seconds):
    """Where a camera's head was sent that sees its book until a time, by what it was doing; and its focal lengths."""
    truth, calibration = world.truth(), true_calibration(world)
    detector = Blind(Outlines(truth), until)
    delay = world.rig.spec.head.delay_s
    field = scan_of(world.rig, calibration)
    camera = LoneCamera(world.rig, truth, calibration, BOOK, detector, delay, 0.5, field)
    sent, move = [], world.rig.head.move
    world.rig.head.move = lambda pan, tilt, speed=None: sent.append((pan, tilt)) or move(pan, tilt, speed)
    modes = [(frame.t, camera.mode, truth.lens("zoom", frame.t).focal_px[0]) for frame in camera.run(seconds)]
    return modes, sent, field


def test_without_detections_the_camera_scans_the_field_repeatedly(world):
    modes, sent, field = looked(world, 0.0, 8.0)
    assert {mode for _, mode, _ in modes} == {"scanning"}
    assert sorted(sent[: len(field)]) == sorted(field)
    assert sent[len(field) : 2 * len(field)] == sent[: len(field)]


def test_after_losing_its_target_the_camera_zooms_out_searches_and_scans(world):
    lost = 3.0
    modes, sent, field = looked(world, lost, lost + SEARCH_S + 2.0)
    by_time = {t: mode for t, mode, _ in modes}
    assert {mode for t, mode in by_time.items() if t < lost} == {"waiting", "following"}
    assert {mode for t, mode in by_time.items() if 0.5 < t < lost} == {"following"}
    after = [mode for t, mode in by_time.items() if lost + COAST_S < t < lost + SEARCH_S - STEP]
    assert set(after) == {"searching"}
    assert modes[-1][1] == "scanning"
    assert set(sent) & set(field)
    close = max(focal for t, _, focal in modes if t < lost)
    assert close > 3 * modes[-1][2]
