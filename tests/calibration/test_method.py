"""The sequential and the joint method on corners of a known truth, and on real photos."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cotarget.calibration import calibrate_photos, calibrate_views
from cotarget.calibration.bundle import EVERY_BLOCK, batches_of, fit, parameter_names, predict, stepped
from cotarget.calibration.model import BundleModel, View
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import DEFAULT_GAMMA, DEFAULT_T, BoardConfig
from cotarget.errors import CalibrationError, ConfigError
from cotarget.geometry import pose
from cotarget.pantilt import HeadGeometry
from cotarget.rig_geometry import FixedCamera, ZoomHead
from experiments.calibration.synthetic.aims import pointing_errors
from experiments.calibration.synthetic.rig import SIZE, SIZES, Truth, other_rig
from experiments.calibration.synthetic.views import synthetic_views
from tests.support.synthetic_calibration import POINTS, calibrated

PHOTOS = Path(__file__).parents[3] / "shared" / "data" / "opencv_stereo"
PHOTO_BOARD = BoardConfig(corners=(9, 6), square=0.025)


def test_exact_corners_give_the_truth_exactly():
    truth = Truth()
    views = synthetic_views(truth, POINTS, np.random.default_rng(0), boards=8, noise_px=0.0)
    calibration = calibrated(views)
    lens = calibration.zoom_head.lens.stops[0]
    # Corners are exact to rounding; the solver stops at a relative fall of the cost of 1e-10.
    assert np.allclose([*lens.focal_px, *lens.center_px], [692, 693, 326, 235], atol=1e-3)
    assert np.allclose(calibration.zoom_head.T_zoom0_fixed.as_matrix(), truth.gamma.as_matrix(), atol=1e-6)
    assert np.allclose(calibration.zoom_head.T_head_zoom.as_matrix(), truth.hand.as_matrix(), atol=1e-6)
    assert calibration.zoom_head.axes.axis_offset == pytest.approx(truth.dz, abs=1e-6)
    assert calibration.zoom_head.axes.squareness == pytest.approx(truth.eps, abs=1e-6)


@pytest.mark.parametrize(("truth", "bounds", "refined_bounds"), [
    # Median and p95 [degrees] at 0.1 px noise from 30 boards; the refined ones are five times what is usual.
    (Truth(), (0.05, 0.10), (0.010, 0.020)),
    pytest.param(other_rig(), (0.08, 0.16), (0.010, 0.020), marks=pytest.mark.slow),
], ids=["default", "other"])  # fmt: skip
def test_calibration_from_noisy_corners_points_well(truth, bounds, refined_bounds):
    views = synthetic_views(truth, POINTS, np.random.default_rng(1))
    for method, (median, p95) in (("sequential", bounds), ("joint", refined_bounds)):
        calibration = calibrated(views, method)
        errors = pointing_errors(calibration, truth, np.random.default_rng(5), 40)
        assert np.median(errors) < median
        assert np.percentile(errors, 95) < p95
        # Two coordinates of 0.1 px noise each, less what the parameters take up.
        assert 0.12 < calibration.residuals.handeye_rms_px < 0.16


def test_the_derivatives_are_those_of_the_predictions():
    rng = np.random.default_rng(0)
    lens = Intrinsics(SIZE, (686.0, 684.0), (325.0, 239.0), (-0.2, 0.03, 0.001, -0.002, 0.01))
    boards = {i: pose(np.add(rng.normal(0, 0.3, 3), [-0.4, -0.25, 4]), rng.normal(0, 15, 3)) for i in range(2)}
    zoom = ZoomLens((667.0, 1334.0), (lens, lens.scaled(2.0)), (0.0, -0.03))
    head = HeadGeometry(0.05, 0.02, 1.01, 0.98, 0.02, -0.03)
    model = BundleModel(boards, FixedCamera(lens), ZoomHead(zoom, DEFAULT_GAMMA, DEFAULT_T, head))
    blank = np.zeros((54, 2))
    views = [
        View("fixed", blank, 0),
        View("zoom", blank, 0, 0.1, -0.2, 667.0),
        View("zoom", blank, 1, -0.3, 0.1, 667.0),
        View("zoom", blank, 1, -0.2, 0.1, 1334.0),
    ]
    count, still = len(parameter_names(EVERY_BLOCK, 2)), np.zeros((2, 6))
    h = 1e-5  # central differences err by h^2 of the third derivative, relative to the largest of a column
    batches = batches_of(model, views)
    assert [batch.stop for batch in batches] == [None, 0, 1]
    for batch in batches:

        def change(high, low, batch=batch):
            return (predict(high, batch, POINTS, ()).pixels - predict(low, batch, POINTS, ()).pixels) / (2 * h)

        found = predict(model, batch, POINTS, EVERY_BLOCK)
        by_shared = np.zeros((*found.pixels.shape, count))
        by_shared[..., found.columns] = found.by_shared
        for k in range(count):
            steps = (stepped(model, s * h * np.eye(count)[k], still, EVERY_BLOCK) for s in (1, -1))
            largest = max(1, np.abs(by_shared[..., k]).max())
            assert np.allclose(change(*steps), by_shared[..., k], atol=1e-6 * largest)
        for k in range(6):
            steps = (
                stepped(model, np.zeros(count), s * h * np.tile(np.eye(6)[k], (2, 1)), EVERY_BLOCK) for s in (1, -1)
            )
            assert np.allclose(change(*steps), found.by_board[..., k], atol=1e-6 * np.abs(found.by_board).max())
        if found.by_turn is not None:
            for k, axis in enumerate(("pan_zero", "tilt_zero")):
                heads = (replace(head, **{axis: getattr(head, axis) + s * h}) for s in (1, -1))
                high, low = (model.with_zoom_head(axes=one) for one in heads)
                assert np.allclose(change(high, low), found.by_turn[..., k], atol=1e-6 * np.abs(found.by_turn).max())


def test_gamma_comes_from_moved_head_poses_where_there_is_no_common_view_at_home():
    views = synthetic_views(Truth(), POINTS, np.random.default_rng(0), boards=20)
    moved = [view for view in views if view.camera == "fixed" or view.pan != 0]
    calibration = calibrated(moved)
    assert calibration.residuals.pairs == 0
    assert calibration.residuals.stereo_rms_px is None
    assert np.median(pointing_errors(calibration, Truth(), np.random.default_rng(5), 40)) < 0.005
    with pytest.raises(CalibrationError, match="pan = tilt = 0"):
        calibrated(moved, "sequential")
    apart = [v for v in moved if (v.camera == "fixed") == (v.board % 2 == 0)]
    with pytest.raises(CalibrationError, match="both cameras"):
        calibrated(apart)


def test_a_bent_board_is_fitted_with_its_bend():
    """Bulging by 4 mm along x and -2 mm along y, on a board of 0.8 by 0.5 m."""
    middle, half = POINTS.mean(axis=0), np.ptp(POINTS, axis=0) / 2
    u, v = ((POINTS - middle)[:, :2] / half[:2]).T
    bent = POINTS + np.outer(0.004 * (1 - u**2) - 0.002 * (1 - v**2), [0, 0, 1])
    views = synthetic_views(Truth(), POINTS, np.random.default_rng(2), boards=15, shape=bent)
    calibration = calibrated(views)
    for name, found, true in zip(("warp_x", "warp_y"), calibration.board_warp, (0.004, -0.002), strict=True):
        sigma = calibration.covariance.sigma(f"board.{name}")
        assert found == pytest.approx(true, abs=4 * sigma)
        assert sigma < 0.0005
    # A flat board's model leaves 0.01 degrees with it.
    assert np.median(pointing_errors(calibration, Truth(), np.random.default_rng(5), 40)) < 0.004


def without_a_head(turned):
    """Pairs of views of ten placements; in the first ``turned`` ones the zoom camera was turned unreported."""
    truth, rng = Truth(), np.random.default_rng(4)
    views = synthetic_views(truth, POINTS, rng, boards=30, moved=1, pan_range=0.1, tilt_range=0.1)
    pairs = []
    for board in dict.fromkeys(view.board for view in views):
        fixed, *zoomed = (view for view in views if view.board == board)
        if len(zoomed) == 2 and zoomed[0].pan == 0 and len(pairs) < 20:
            pairs += [fixed, replace(zoomed[1 if len(pairs) < 2 * turned else 0], pan=0.0, tilt=0.0)]
    assert len(pairs) == 20
    return pairs


def test_two_cameras_without_a_head_must_stand_still():
    for method, turned in (("joint", 4), ("sequential", 4)):
        with pytest.raises(CalibrationError, match="contradict each other"):
            calibrated(without_a_head(turned), method)
    found = calibrated(without_a_head(0))
    off = found.zoom_head.T_zoom0_fixed.translation - Truth().gamma.translation
    sigmas = np.array([found.covariance.sigma(f"T_zoom0_fixed.t{axis}") for axis in "xyz"])
    assert (np.abs(off) < 3 * sigmas).all()
    step_by_step = calibrated(without_a_head(0), "sequential")
    assert step_by_step.zoom_head.T_head_zoom is None
    # Two coordinates of 0.1 px noise each are 0.14 px; the intrinsics, which are held, add as much.
    assert step_by_step.residuals.stereo_rms_px < 0.28


def test_views_that_cannot_be_calibrated_are_refused():
    views = synthetic_views(Truth(), POINTS, np.random.default_rng(0), boards=3)
    with pytest.raises(CalibrationError, match="fixed camera"):
        calibrated([])
    with pytest.raises(CalibrationError, match="magic"):
        calibrated(views, "magic")
    with pytest.raises(ConfigError, match=r"board\.corners"):
        calibrate_views(views, BoardConfig(corners=(8, 6)), SIZES)
    with pytest.raises(CalibrationError, match="8x5"):
        calibrate_views(views, BoardConfig(corners=(8, 5)), SIZES)
    with pytest.raises(CalibrationError, match="no views"):
        fit(BundleModel({}, FixedCamera(Intrinsics(SIZE, (686.0, 684.0), (325.0, 239.0)))), [], POINTS, ())


@pytest.mark.skipif(not PHOTOS.is_dir(), reason=f"the real stereo photos are not at {PHOTOS}")
def test_real_photos_calibrate_to_known_residuals():
    calibration = calibrate_photos(PHOTOS, "left*.jpg", "right*.jpg", PHOTO_BOARD)
    residuals = calibration.residuals
    assert (residuals.fixed_views, residuals.zoom_views, residuals.pairs) == (13, 13, 13)
    assert residuals.rejected == ()
    # Known to be possible with these corners: 0.177, 0.182 and 0.196 px; mrcal's baseline is 83.15 mm.
    assert max(residuals.fixed_rms_px, residuals.zoom_rms_px, residuals.stereo_rms_px) < 0.20
    assert np.linalg.norm(calibration.zoom_head.T_zoom0_fixed.translation) == pytest.approx(0.08315, abs=0.0005)
    assert calibration.zoom_head.T_head_zoom is None
    assert residuals.handeye_rms_px is None
