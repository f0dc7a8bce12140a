"""Covariance of a calibration, by hand and against refits; the experiment `honesty` says how true it is."""

from dataclasses import replace

import numpy as np
import pytest

from cotarget.calibration import Calibration, Covariance, line_of_sight_covariance, predicted_pointing
from cotarget.calibration.bundle import ALL_BLOCKS, Fit, coordinate_variance, difference, fit, parameter_names
from cotarget.calibration.initialization import at_home
from cotarget.calibration.model import BundleModel
from cotarget.calibration.uncertainty import covariance_of, model_of, with_consider_covariance
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.errors import CalibrationError
from cotarget.geometry import RigidTransform
from cotarget.rig_geometry import FixedCamera, ZoomHead
from cotarget.targeting import Reach, aim, error_budget, point_at
from experiments.calibration.honesty import error_of
from experiments.calibration.synthetic.rig import SIZE, Truth
from experiments.calibration.synthetic.views import synthetic_views
from tests.support.rigs import with_zoom_head
from tests.support.synthetic_calibration import POINTS, calibrated, drawn, fitted, pointing

SIGMA_PX = 0.1


def ideal(parameters, matrix):
    """Both cameras in one place that looks along +z, on a head whose axes cross there; f = 500 px."""
    lens = Intrinsics((641, 481), (500.0, 500.0), (320.0, 240.0))
    still = RigidTransform.identity()
    return Calibration(
        fixed=FixedCamera(lens),
        zoom_head=ZoomHead(ZoomLens((500.0,), (lens,)), still, still),
        covariance=Covariance(parameters, np.array(matrix, float)),
    )


WANDERED = 5 * 641 / 640


@pytest.mark.parametrize(("parameters", "matrix", "nominal", "expected"), [
    # Straight ahead at 10 m: a pixel is 1/500 rad, a metre 1/10 rad.
    (("fixed.cx",), [[4.0]], 500.0, [[(2 / 500) ** 2, 0], [0, 0]]),
    (("zoom[0].cy",), [[4.0]], 500.0, [[0, 0], [0, (2 / 500) ** 2]]),
    # At twice the only focal length calibrated, the axis may have wandered by 5 px of 640; the image has 641.
    (("zoom[0].cy",), [[4.0]], 1000.0, [[WANDERED**2 / 1000**2, 0], [0, (2**2 + WANDERED**2) / 1000**2]]),
    (("fixed.cx", "zoom[0].cx"), [[4.0, 4.0], [4.0, 4.0]], 500.0, [[0, 0], [0, 0]]),  # the same error in both cancels
    (("fixed.cx", "fixed.cy"), [[4.0, 2.0], [2.0, 1.0]], 500.0, [[4 / 500**2, 2 / 500**2], [2 / 500**2, 1 / 500**2]]),
    (("fixed.fx", "fixed.k1"), [[4.0, 0], [0, 1.0]], 500.0, [[0, 0], [0, 0]]),  # in the middle neither shows
    (("T_zoom0_fixed.tx",), [[0.01]], 500.0, [[0.0001, 0], [0, 0]]),
    (("T_zoom0_fixed.ry",), [[0.01]], 500.0, [[0.01, 0], [0, 0]]),
    (("T_zoom0_fixed.tz", "T_zoom0_fixed.rz"), [[0.01, 0], [0, 0.01]], 500.0, [[0, 0], [0, 0]]),
    (("T_head_zoom.tx", "T_head_zoom.ry"), [[0.01, 0], [0, 0.01]], 500.0, [[0, 0], [0, 0]]),  # the head has not moved
])  # fmt: skip
def test_line_of_sight_covariance_by_hand(parameters, matrix, nominal, expected):
    found = line_of_sight_covariance(ideal(parameters, matrix), np.array([320.0, 240.0]), 10.0, nominal_px=nominal)
    assert np.allclose(found, expected, rtol=1e-6, atol=1e-12)  # by differences of 1e-5


def test_worked_by_hand_where_the_head_has_turned():
    """A target 45 degrees to the right, 10 m deep: sqrt(2) 10 m away. An error of Gamma along x is seen aslant."""
    found = line_of_sight_covariance(ideal(("T_zoom0_fixed.tx",), [[0.01]]), np.array([820.0, 240.0]), 10.0)
    across = 1 / np.sqrt(2)  # of a shift along x
    assert np.allclose(found, [[0.01 * (across / (10 * np.sqrt(2))) ** 2, 0], [0, 0]], rtol=1e-6, atol=1e-12)


def test_jitter_worked_by_hand():
    """Both axes scatter by 0.02 rad: at a tilt of 45 degrees a turn of pan moves the line of sight by cos(45 deg)."""
    jittery = replace(ideal(("fixed.fx",), [[0.0]]), jitter=0.02)
    for v, share in ((240.0, 1.0), (240.0 - 500.0, 0.5)):
        found = line_of_sight_covariance(jittery, np.array([320.0, v]), 10.0)
        assert np.allclose(found, 0.02**2 * np.diag([share, 1.0]), rtol=1e-6, atol=1e-12)


def test_many_targets_at_once_and_out_of_reach():
    pixels, depths = np.array([[[320.0, 240.0], [100.0, 50.0], [600.0, 400.0]]]), np.array([[10.0, 4.0, 30.0]])
    calibration = ideal(("T_zoom0_fixed.tx", "fixed.cx", "T_head_zoom.tx"), np.diag([1e-4, 1.0, 1e-4]))
    together = predicted_pointing(calibration, pixels, depths)
    assert together.shape == (1, 3)
    alone = [float(predicted_pointing(calibration, p, z)) for p, z in zip(pixels[0], depths[0], strict=True)]
    assert np.allclose(together[0], alone, rtol=1e-9)
    zoomed = np.array([500.0, 2000.0])[:, None]
    longer = predicted_pointing(calibration, pixels[0], depths[0], nominal_px=zoomed)
    assert longer.shape == (2, 3)
    each = [predicted_pointing(calibration, pixels[0], depths[0], nominal_px=f) for f in zoomed.ravel()]
    assert np.allclose(longer, each, rtol=1e-9)
    lever = RigidTransform.from_translation([0.0, 0.5, 0.0])  # with the fixed camera where the axes cross
    calibration = with_zoom_head(calibration, T_head_zoom=lever, T_zoom0_fixed=lever.inv())
    near_and_far = predicted_pointing(calibration, pixels[0, 0], [0.1, 10.0])
    assert np.isnan(near_and_far).tolist() == [True, False]  # nearer than the lever arm


@pytest.fixture(scope="module")
def views():
    return synthetic_views(Truth(), POINTS, np.random.default_rng(3), boards=8, noise_px=SIGMA_PX)


@pytest.fixture(scope="module")
def calibration(views):
    return calibrated(views)


def test_covariance_covers_every_free_parameter(calibration):
    covariance = calibration.covariance
    assert covariance.parameters == parameter_names(ALL_BLOCKS)
    assert len(covariance.parameters) == 8 + 8 + 6 + 6 + 2 + 2
    assert not [name for name in covariance.parameters if "k3" in name]  # it is held
    assert np.linalg.eigvalsh(covariance.matrix / np.sqrt(np.multiply.outer(*2 * [np.diag(covariance.matrix)])))[0] > 0
    error = error_of(calibration, Truth())
    sigmas = np.sqrt(np.diag(covariance.matrix))
    assert max(abs(error[n]) / s for n, s in zip(covariance.parameters, sigmas, strict=True)) < 5


def test_predicted_pointing_of_a_scaled_stream_is_the_same(calibration):
    pixel = np.array([500.0, 100.0])
    half = calibration.for_streams((320, 240), (320, 240))
    assert float(predicted_pointing(half, (pixel + 0.5) / 2 - 0.5, 8.0)) == pytest.approx(
        float(predicted_pointing(calibration, pixel, 8.0)), rel=1e-5
    )


def test_error_budget_includes_the_calibration(calibration):
    pixel, reach = np.array([500.0, 100.0]), Reach((-1.5, 1.5), (-1.0, 1.0), (667.0, 7000.0), steps=(0.001, 0.001))
    found = aim(calibration, point_at(calibration, pixel, 8.0), reach, nominal_px=2000.0)
    budget = error_budget(calibration, pixel, found, reach, size_px=40.0)
    assert set(budget) == {"steps", "pixel", "size", "calibration", "total"}
    assert budget["calibration"] == pytest.approx(float(predicted_pointing(calibration, pixel, 8.0, nominal_px=2000.0)))
    assert budget["total"] ** 2 == pytest.approx(sum(v**2 for name, v in budget.items() if name != "total"))
    without = error_budget(replace(calibration, covariance=None), pixel, found, reach)
    assert set(without) == {"steps", "pixel", "total"}


def test_pointing_without_covariance_or_t_is_refused(views, calibration):
    sequential_only = calibrated(views, "sequential")
    assert sequential_only.covariance is None
    with pytest.raises(CalibrationError, match="no covariance"):
        predicted_pointing(sequential_only, np.array([320.0, 240.0]), 8.0)
    pair_only = calibrated([v for v in views if v.camera == "fixed" or at_home(v)])
    assert pair_only.covariance.parameters == parameter_names(("fixed", "zoom", "gamma", "warp"))
    with pytest.raises(CalibrationError, match="no T_head_zoom"):
        predicted_pointing(pair_only, np.array([320.0, 240.0]), 8.0)


def test_undetermined_fit_has_no_covariance():
    lens = Intrinsics(SIZE, (686.0, 684.0), (325.0, 239.0))
    model, off = BundleModel({0: RigidTransform.identity()}, FixedCamera(lens)), np.full((2, 20, 2), 0.1)

    def found(normal, variance=0.01):
        return covariance_of(Fit(model, ("fixed",), off, off, normal, variance, 0.0, ()))

    assert found(np.eye(8)) is not None
    assert found(np.ones((8, 8))) is None
    assert found(np.zeros((8, 8))) is None
    assert found(np.eye(8), None) is None
    assert coordinate_variance(off[0, :7], 14) is None  # 14 coordinates, 14 parameters


def test_the_variance_of_a_coordinate():
    """60 corners are 1 px off, 40 are off by twice Huber's scale, which is 3 / 1.1774 times the median length.

    There psi has the length of the scale, and its slope is 1/2 across the residual and 0 along it.
    """
    scale = 3 / 1.1774
    residuals = np.repeat([[1.0, 0.0], [2 * scale, 0.0]], [60, 40], axis=0)
    by_hand = (0.6 + 0.4 * scale**2) / 2 / (0.6 + 0.4 / 4) ** 2
    assert coordinate_variance(residuals, 0) == pytest.approx(by_hand, rel=1e-9)
    assert coordinate_variance(residuals, residuals.size // 2) == pytest.approx(2 * by_hand, rel=1e-9)


SCALES = Truth(pan_scale=1.002, tilt_scale=0.998)
# A tenth of the scales' error, for a difference of two fits that is linear to a thousandth.
ELSEWHERE = 0.0002


@pytest.fixture(scope="module")
def scaled():
    return calibrated(drawn(SCALES))


@pytest.fixture(scope="module")
def found(scaled):
    return fitted(model_of(scaled), scaled.views)


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


def test_wrong_scales_widen_the_covariance_by_their_error(scaled):
    """To within what the corners know of the scales, some three ten-thousandths."""
    assert scaled.covariance.sigma("head.pan_scale") == pytest.approx(0.002, abs=0.0012)
    assert scaled.covariance.sigma("head.tilt_scale") == pytest.approx(0.002, abs=0.0012)
    assert scaled.zoom_head.axes.pan_scale == 1.0
    measured, predicted = pointing(scaled, SCALES)
    assert measured < 2 * predicted
