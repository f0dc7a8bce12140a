"""Targets that come near and stay, so that the image border clips their box and no size measures their depth."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cotarget.config import DEFAULT_TARGETS
from cotarget.detection import Detections
from cotarget.estimation import TargetFilter, filter_settings
from cotarget.pipeline import State, follow
from cotarget.rig import Detection
from experiments.calibration.synthetic.rig import SIZE, Truth
from tests.support.formula_rig import CALIBRATION, FIXED, FormulaRig
from tests.support.moving_targets import calibration_of
from tests.support.rigs import rig_of

RATE = 15.0
LAST = np.array(SIZE) - 0.5  # right and lower edge of the image [px]
# Depth at the start and at the stop [m], and width over height; each target is clipped where it stops.
WAYS = {"person": (8.0, 2.0, 0.26), "bird": (9.0, 0.6, 1.0), "book": (3.0, 0.2, 0.7)}
SIDE_PX = 1.0  # noise of each edge
ROUNDING = 1e-9


class Approach:
    """Target that approaches at a constant speed and stops, and the detector of its part inside the image."""

    mask = None

    def __init__(self, name, speed, waits_s=1.0):
        self.target = DEFAULT_TARGETS[name]
        self.speed, self.waits_s = speed, waits_s
        self.start, self.stop, self.ratio = WAYS[name]
        self.rng = np.random.default_rng(0)

    def path(self, t):
        z = max(self.start - self.speed * max(t - self.waits_s, 0.0), self.stop)
        aside = 0.6 * math.sin(2 * t) if t < self.waits_s else 0.0  # so that it is confirmed as moving
        return np.array([0.05 * self.start + aside, 0.02 * self.start, z])

    def box(self, lens, t):
        x = self.path(t)
        height = self.target.size / (self.ratio if self.target.dimension == "width" else 1.0)
        half = np.array([lens.fx * height * self.ratio, lens.fy * height]) / x[2] / 2
        middle = lens.project(x[None])[0]
        low, high = middle - half, middle + half
        cut = (low <= -0.5) | (high >= LAST)
        noise = self.rng.normal(0.0, SIDE_PX, (2, 2))
        low, high = np.maximum(low + noise[0], -0.5), np.minimum(high + noise[1], LAST)
        return Detection((low + high) / 2, high - low, 1.0, bool(cut.any()))

    def detect(self, frame, held=()):
        return Detections([self.box(FIXED, frame.t)])


@pytest.mark.parametrize("speed", [0.5, 1.4, 3.0, 10.0])
@pytest.mark.parametrize("name", WAYS)
def test_the_depth_of_a_target_clipped_for_a_minute_stays_bounded(name, speed):
    lens, way = Truth().fixed, Approach(name, speed)
    estimator = TargetFilter(calibration_of(Truth()), way.target)
    arrived = way.waits_s + (way.start - way.stop) / speed
    depths, sigmas = [], []
    for t in np.arange(0.0, arrived + 60.0, 1 / RATE):
        box = way.box(lens, t)
        estimator.add_fixed(box, t)
        found = estimator.estimate(t + 0.1)
        assert np.isfinite(found.state).all()
        sigma = np.sqrt(np.diag(found.state_covariance))
        assert np.linalg.eigvalsh(found.state_covariance / np.outer(sigma, sigma)).min() > 0
        if t > arrived:
            assert box.clipped
            depths.append(found.depth)
            sigmas.append(sigma[2])
    side = way.box(lens, arrived + 60.0).size_px[0 if way.target.dimension == "width" else 1]
    farthest = lens.fy * way.target.size / side  # if the visible part were all of it
    late = depths[len(depths) // 6 :]
    assert 0.5 * way.target.size - ROUNDING < min(depths)
    if name != "bird":  # the same box of a bird with folded wings is 40 % nearer
        assert max(late) < 1.1 * farthest
    assert max(late) < 1.5 * min(late)  # the target stands
    assert max(sigmas) < 1.5 + ROUNDING  # a factor of five


USUAL_SPEED = 0.1  # relative; one frame's noise and correction leave 4 %


@pytest.mark.parametrize("name", WAYS)
def test_an_unmeasured_velocity_along_the_axis_returns_to_its_prior(name):
    """The target is clipped for five seconds."""
    calibration, target = calibration_of(Truth()), DEFAULT_TARGETS[name]
    estimator = TargetFilter(calibration, target)
    box = Detection(np.array(calibration.fixed.lens.image_center_px), np.array([60.0, 80.0]), 1.0)
    for i in range(100):
        estimator.add_fixed(box if i < 25 else replace(box, clipped=True), i / RATE)
    found = estimator.estimate(99 / RATE)
    speed = filter_settings(target).motion.speed
    assert found.depth * math.sqrt(found.state_covariance[5, 5]) == pytest.approx(speed, rel=USUAL_SPEED)


def test_a_clipped_box_is_an_upper_bound_of_the_depth():
    calibration, person = calibration_of(Truth()), DEFAULT_TARGETS["person"]
    middle = np.array(calibration.fixed.lens.image_center_px)
    whole = Detection(middle, np.array([31.0, 120.0]), 1.0)
    found = {}
    for part in (0.3, 0.9, 1.0, 1.4):
        estimator = TargetFilter(calibration, person)
        for i in range(40):
            cut = replace(whole, size_px=whole.size_px * part, clipped=True)
            estimator.add_fixed(whole if i < 10 else cut, i / RATE)
        found[part] = estimator.estimate(39 / RATE).depth
    depth = Truth().fixed.fy * person.size / 120.0
    assert found[0.3] == pytest.approx(depth, rel=0.01)
    assert found[0.9] == found[0.3]
    assert 0.9 * depth / 1.4 < found[1.4] < 1.01 * depth / 1.4  # its measured approach goes on for a little
    estimator = TargetFilter(calibration, person)
    estimator.add_fixed(replace(whole, size_px=whole.size_px / 3, clipped=True), 0.0)
    assert estimator.estimate(0.0).state_covariance[2, 2] > 0.9**2  # alone, it measures next to nothing
    estimator.add_fixed(whole, 1 / RATE)
    found = estimator.estimate(1 / RATE)
    assert abs(math.log(found.depth / depth)) < 4 * math.sqrt(found.state_covariance[2, 2]) < 0.5


def test_the_centre_of_a_clipped_box_is_uncertain_by_half_its_sides():
    calibration, size = calibration_of(Truth()), np.array([31.0, 120.0])
    estimator = TargetFilter(calibration, DEFAULT_TARGETS["person"])
    estimator.add_fixed(Detection(np.array(calibration.fixed.lens.image_center_px), size, 1.0, clipped=True), 0.0)
    sigma = np.sqrt(np.diag(estimator.estimate(0.0).state_covariance)[:2])
    np.testing.assert_allclose(sigma * [Truth().fixed.fx, Truth().fixed.fy], size / 2, rtol=0.05)


def test_a_target_that_flies_at_the_camera_keeps_a_positive_depth():
    calibration = calibration_of(Truth())
    estimator, near = TargetFilter(calibration, DEFAULT_TARGETS["bird"]), calibration.fixed.lens.image_center_px
    for i in range(30):  # from 30 m to 1 m in two seconds
        estimator.add_fixed(Detection(near, np.array([550.0, 100.0]) / (30.0 - i), 1.0), i / RATE)
    assert 0.1 < estimator.estimate(30 / RATE).depth < 5.0
    assert estimator.estimate(4.0).depth > 0


SEEN = State.FOLLOWING, State.UNCONFIRMED  # the formula rig's zoom images show nothing


@pytest.mark.slow
@pytest.mark.parametrize("speed", [1.0, 1.4])
def test_the_head_stands_still_for_a_person_who_stands_close(speed):
    way, rig = Approach("person", speed, waits_s=3.0), FormulaRig()
    poses = []
    for step in follow(rig_of(rig), CALIBRATION, way.target, way, seconds=25.0):
        poses.append((step.t, *rig.pose(rig.t)))
        assert step.state in (*SEEN, State.SEARCHING)
    t, pan, tilt = np.array(poses).T
    assert step.state in SEEN
    cut = t > way.waits_s + (way.start - 2.6) / speed  # nearer than 2.6 m its feet are out of view
    for angle in (pan, tilt):
        assert np.ptp(angle[cut]) < math.radians(12)
        assert np.ptp(angle[t > 18.0]) < math.radians(2)
