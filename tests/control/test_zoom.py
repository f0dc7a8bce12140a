"""How far to zoom in: chances against drawn samples, and the lens's path from one frame to the next."""

import math

import numpy as np
import pytest

from cotarget.control.zoom import ZoomController, ZoomSettings, chance_inside, longest_focal
from cotarget.estimation import Appearance, TargetFilter
from tests.support.moving_targets import APART, Flight, show

SIZE = (640, 480)
RANGE = (690.0, 8000.0)
FRAME = 0.04
# 20000 samples give a chance of 0.9 to 0.2 %; errors along both axes are counted as if they had nothing in common.
CHANCE = 0.01
EXACT = 1e-6  # relative error of a root that is found iteratively


def expected(sigma, offset=(0.0, 0.0), half=(0.01, 0.015), size_sigma=0.0):
    """A predicted target, in tangents: at a focal length of 1."""
    sides = tuple(2 * np.array(half))
    return Appearance(np.array(offset), np.eye(2) * sigma**2, 1.0, size_sigma, np.ones(2), sides)


@pytest.mark.parametrize(("sigma", "offset"), [(0.002, (0.0, 0.0)), (0.01, (0.02, -0.01)), (0.03, (0.0, 0.03))])
def test_the_chance_is_that_of_samples(sigma, offset):
    focal = 3000.0
    seen = expected(sigma, offset)
    at = np.random.default_rng(0).normal(offset, sigma, (20000, 2))
    inside = (np.abs(at) + seen.half <= np.array(SIZE) / 2 / focal).all(axis=1)
    assert chance_inside(seen, focal, SIZE) == pytest.approx(inside.mean(), abs=CHANCE)


def test_what_is_larger_than_the_image_is_never_inside():
    assert chance_inside(expected(0.0, half=(0.2, 0.1)), 2000.0, SIZE) == 0.0
    assert chance_inside(expected(0.0), 2000.0, SIZE) == 1.0
    assert chance_inside(expected(0.0, offset=(0.2, 0.0)), 2000.0, SIZE) == 0.0


def test_the_longest_focal_length_has_the_chance_asked_for():
    seen = expected(0.01, (0.005, 0.0))
    found = longest_focal(seen, 0.95, SIZE, RANGE)
    assert chance_inside(seen, found, SIZE) == pytest.approx(0.95, rel=EXACT)
    # By hand: certain and at rest in the middle, half the height over half the target's height and rim.
    sure = expected(1e-9, half=(0.01, 0.05))
    assert longest_focal(sure, 0.95, SIZE, RANGE, rim_px=4.0) == pytest.approx(236.0 / 0.05, rel=EXACT)
    assert longest_focal(expected(1.0), 0.95, SIZE, RANGE) == RANGE[0]
    assert longest_focal(expected(1e-9, half=(1e-4, 1e-4)), 0.95, SIZE, RANGE) == RANGE[1]


def test_the_lens_is_no_longer_than_the_head_can_follow():
    """At 2000 px the head turns by 0.1 rad/s at most, and at 4000 px by 0.02."""
    policy = ZoomController(RANGE, SIZE, speeds=((2000.0, 0.1), (4000.0, 0.02)))
    t, commanded, way = 0.0, RANGE[0], []
    for rate in [0.01] * 50 + [0.05] * 50 + [0.2] * 50 + [0.01] * 50:
        commanded, reason = policy.choose(expected(0.001), 6000.0, commanded, t, rate=rate)
        way.append((commanded, reason))
        t += FRAME
    assert way[49] == (6000.0, "wanted")
    assert 3600.0 < way[51][0] < 4000.0
    assert way[51][1] == "head too slow"
    assert 1800.0 < way[101][0] < 2000.0
    assert way[155][0] == way[101][0]  # the target may only have turned around
    for _ in range(400):
        commanded, reason = policy.choose(expected(0.001), 6000.0, commanded, t, rate=0.01)
        t += FRAME
    assert (commanded, reason) == (6000.0, "wanted")


def test_the_lens_at_its_end_is_as_long_as_wanted():
    assert ZoomController(RANGE, SIZE).choose(expected(0.001), 2 * RANGE[1], RANGE[1], 0.0) == (RANGE[1], "wanted")


def test_wide_while_unsure_close_when_sure_and_out_before_it_is_lost():
    policy = ZoomController(RANGE, SIZE)
    commanded, t, way = RANGE[0], 0.0, []
    for sigma in [0.3] * 10 + list(np.geomspace(0.3, 0.001, 40)) + [0.001] * 20 + list(np.geomspace(0.001, 0.2, 20)):
        commanded, reason = policy.choose(expected(sigma), 4000.0, commanded, t)
        t += FRAME
        way.append((sigma, commanded, reason))
    assert way[9][1] == RANGE[0]
    assert way[69][1] == pytest.approx(4000.0, rel=0.06)
    assert way[69][2] == "wanted"
    assert way[-1][1] < 1.1 * RANGE[0]
    # Never closer than the lower chance allows, at any step.
    assert all(c == RANGE[0] or chance_inside(expected(s), c, SIZE) >= 0.79 for s, c, _ in way)
    assert policy.choose(None, 4000.0, commanded, t) == (RANGE[0], "lost")
    assert policy.choose(None, 4000.0, 4000.0, t) == (RANGE[0], "lost")


def test_the_lens_does_not_hunt():
    """An uncertainty that goes up and down by a fifth from frame to frame, about where it begins to matter."""
    rng = np.random.default_rng(0)

    def moves(settings):
        policy, commanded, count = ZoomController(RANGE, SIZE, settings), RANGE[0], 0
        for i in range(500):
            seen = expected(0.02 * math.exp(rng.normal(0, 0.2)))
            focal_px, _ = policy.choose(seen, 4000.0 * math.exp(rng.normal(0, 0.02)), commanded, i * FRAME)
            count += focal_px != commanded
            commanded = focal_px
        return count

    nervous = moves(ZoomSettings(deadband=0.0, settle_s=0.0))
    assert moves(ZoomSettings()) < 0.15 * nervous


def test_a_target_that_comes_near_is_followed_by_zooming_out():
    policy, commanded = ZoomController(RANGE, SIZE), 4000.0
    for i, wanted in enumerate(np.geomspace(4000.0, 1500.0, 50)):
        commanded, _ = policy.choose(expected(0.002), float(wanted), commanded, i * FRAME)
        assert abs(math.log(commanded / wanted)) < 0.1


@pytest.mark.parametrize("sigma", [0.05, 0.3])
def test_after_a_zoom_out_the_lens_zooms_in_only_when_things_have_settled(sigma):
    """A lens on its way out stops where it is once that is sure enough."""
    policy = ZoomController(RANGE, SIZE)
    out, reason = policy.choose(expected(sigma), 4000.0, 4000.0, 0.0)
    assert reason == "about to be lost"
    assert policy.choose(expected(0.001), 4000.0, out, 0.05)[0] == out
    assert policy.choose(expected(0.001), 4000.0, out, 0.1, now_px=3500.0) == (3500.0, "settling")
    # Nor does it go in meanwhile, wherever it is said to be.
    assert policy.choose(expected(0.001), 4000.0, 3500.0, 0.14, now_px=3000.0)[0] == 3500.0
    assert policy.choose(expected(0.001), 4000.0, 3500.0, 0.4)[0] == 4000.0


def test_an_estimate_says_what_to_expect():
    flight = Flight("person", 0, 2.0)
    estimator = TargetFilter(flight.calibration, flight.target)
    for t in flight.times:
        estimator.add_fixed(flight.wide(t), t)
        show(estimator, flight.zoom(t + APART))
    t = flight.times[-1] + 0.2
    pan, tilt = flight.aimed(t)
    seen = estimator.estimate(t).appearance(pan, tilt, 1700.0, 0.26)
    assert np.hypot(*seen.offset) < 4 * math.sqrt(seen.variance.sum()) + 0.01
    distance = np.linalg.norm(flight.path(t) - flight.truth.gamma.inv().translation)
    np.testing.assert_allclose(seen.half, np.array([0.26, 1.0]) * flight.size / 2 / distance, rtol=0.1)
    # Where the head is 2 degrees short of it in pan, it stands that much to the right.
    short = estimator.estimate(t).appearance(pan - math.radians(2), tilt, 1700.0)
    assert short.offset[0] - seen.offset[0] == pytest.approx(math.tan(math.radians(2)), rel=0.05)
    # The farther ahead, the wider.
    focals = [
        longest_focal(estimator.estimate(t).appearance(*flight.aimed(t), 1700.0, 0.26), 0.95, SIZE, RANGE)
        for t in flight.times[-1] + np.array([0.1, 0.5, 1.0])
        if flight.path.x[-1] > t
    ]
    assert (np.diff(focals) < 0).all()
    assert estimator.estimate(t).appearance(pan + math.pi, tilt, 1700.0) is None
