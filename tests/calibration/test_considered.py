"""Doubt about parameters that a fit holds: against fits that hold them elsewhere, and against the truth."""

from dataclasses import replace

import numpy as np
import pytest

from cotarget.calibration.bundle import ALL_BLOCKS, difference, fit, parameter_names
from cotarget.calibration.uncertainty import covariance_of, model_of, with_consider_covariance
from experiments.calibration.synthetic.rig import Truth
from tests.support.synthetic_calibration import POINTS, calibrated, drawn, fitted, pointing

SCALES = Truth(pan_scale=1.002, tilt_scale=0.998)
# A tenth of the scales' error, for a difference of two fits that is linear to a thousandth.
ELSEWHERE = 0.0002


@pytest.fixture(scope="module")
def calibration():
    return calibrated(drawn(SCALES))


@pytest.fixture(scope="module")
def found(calibration):
    return fitted(model_of(calibration), calibration.views)


@pytest.mark.parametrize("name", ["pan_scale", "tilt_scale"])
def test_sensitivity_to_a_held_scale_is_that_of_refits(found, name):
    covariance = with_consider_covariance(covariance_of(found), found, POINTS, ["scale"])
    i = covariance.parameters.index(f"head.{name}")
    own = len(parameter_names(ALL_BLOCKS))
    by_held = covariance.matrix[:own, i] / covariance.matrix[i, i]
    axes = replace(found.model.zoom_head.axes, **{name: 1 + ELSEWHERE})
    moved = fit(found.model.with_zoom_head(axes=axes), found.views, POINTS, ALL_BLOCKS).model
    sigmas = np.sqrt(np.diagonal(covariance_of(found).matrix))
    expected = difference(moved, found.model, ALL_BLOCKS) / ELSEWHERE
    np.testing.assert_allclose(by_held / sigmas, expected / sigmas, atol=0.01 * np.abs(expected / sigmas).max())


def test_consider_covariance_only_grows(found):
    covariance = covariance_of(found)
    grown = with_consider_covariance(covariance, found, POINTS, ["scale"])
    own = len(covariance.parameters)
    added = grown.matrix[:own, :own] - covariance.matrix
    assert grown.parameters[:own] == covariance.parameters
    assert np.linalg.eigvalsh(added)[0] > -1e-9 * np.linalg.eigvalsh(added)[-1]
    assert with_consider_covariance(covariance, found, POINTS, []) is covariance


def test_wrong_scales_widen_the_covariance_by_their_error(calibration):
    """To within what the corners know of the scales, some three ten-thousandths."""
    assert calibration.covariance.sigma("head.pan_scale") == pytest.approx(0.002, abs=0.0012)
    assert calibration.covariance.sigma("head.tilt_scale") == pytest.approx(0.002, abs=0.0012)
    assert calibration.zoom_head.axes.pan_scale == 1.0
    measured, predicted = pointing(calibration, SCALES)
    assert measured < 2 * predicted
