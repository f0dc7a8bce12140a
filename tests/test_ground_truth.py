"""The truth with noise, which stands in for detector and finder."""

import math

import numpy as np
import pytest

from cotarget.errors import ConfigError
from cotarget.evaluation import TruthDetector, TruthNoise, counted
from cotarget.rig import Frame
from cotarget.sim.targets.random_paths import SECONDS
from cotarget.sim.world import SimWorld
from experiments.following.field import five_targets_config, hold_config

STEP = 0.04
TIMES = np.arange(0.0, SECONDS + STEP / 2, STEP)


def test_the_truth_detector_has_the_errors_of_its_noise():
    noise = TruthNoise(center_px=0.7, size=0.1, miss=0.2)
    with (w := SimWorld(hold_config("bird", 3), rendered=())).rig:
        truth, image = w.truth(), np.zeros((480, 640, 3), np.uint8)
        detector, again = (TruthDetector(truth, 5, noise) for _ in range(2))
        offs, sides, missed = [], [], 0
        for t in TIMES:
            low, high = truth.box("bird", "fixed", t)
            found = detector.detect(Frame(image, t)).boxes
            if t < 2:
                later = again.detect(Frame(image, t)).boxes  # whatever was asked before
                assert [d.center_px.tolist() for d in later] == [d.center_px.tolist() for d in found]
            if not found:
                missed += 1
                continue
            (one,) = found
            offs.append(one.center_px - (low + high) / 2)
            sides.append(one.size_px / (high - low) - 1)
            assert not one.clipped
        assert missed / len(TIMES) == pytest.approx(0.2, abs=0.06)  # the standard deviation over 500 frames is 2 %
        assert np.std(offs, axis=0) == pytest.approx([0.7, 0.7], rel=0.15)
        assert np.std(sides, axis=0) == pytest.approx([0.1, 0.1], rel=0.15)
        exact = TruthDetector(truth, 5, TruthNoise(0.0, 0.0, 0.0)).detect(Frame(image, 1.0)).boxes[0]
        low, high = truth.box("bird", "fixed", 1.0)
        assert exact.center_px == pytest.approx((low + high) / 2)
        assert exact.size_px == pytest.approx(high - low)


def test_the_truth_detector_clips_boxes_at_the_border():
    with (w := SimWorld(five_targets_config(0), rendered=())).rig:
        detector = TruthDetector(w.truth(), 0, TruthNoise(0.0, 0.0, 0.0))
        image = np.zeros((480, 640, 3), np.uint8)
        assert detector.detect(Frame(image, 0.0)).boxes == []  # no target is there yet
        found = [d for t in TIMES[::5] for d in detector.detect(Frame(image, t)).boxes]
        assert any(d.clipped for d in found)
        for d in found:
            assert (d.center_px - d.size_px / 2 >= -0.5 - 1e-9).all()
            assert (d.center_px + d.size_px / 2 <= [639.5 + 1e-9, 479.5 + 1e-9]).all()


def test_the_random_numbers_of_a_time_do_not_depend_on_the_order_of_requests():
    def draw(at, t):
        rng = at(t)
        return (*rng.normal(size=3).tolist(), rng.integers(9), rng.random())  # half a number may be left over

    times = [0.0, 1e-6, 2e-6, 0.04, 19.96]  # of neighbouring microseconds none has another's further numbers
    at, again = counted(7), counted(7)
    drawn = {t: draw(at, t) for t in times}
    assert {t: draw(again, t) for t in reversed(times)} == {t: drawn[t] for t in reversed(times)}
    drawn |= {("another seed", t): draw(counted(8), t) for t in times}
    values = [value for each in drawn.values() for value in (*each[:3], each[4])]
    assert len(set(values)) == len(values)


def test_impossible_noise_is_refused():
    with pytest.raises(ConfigError, match=r"noise.miss: 1.5 is not within 0 to 1"):
        TruthNoise(miss=1.5)
    for bad in (-0.1, math.nan, math.inf, "much"):
        with pytest.raises(ConfigError, match=r"noise.size: .* is not a number from 0 on"):
            TruthNoise(size=bad)
