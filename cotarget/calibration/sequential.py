"""Sequential calibration, step by step as in the paper's Table 1; kept for comparison.

1. Intrinsics of each camera by itself, the zoom camera at its shortest focal length.
2. Gamma = T_zoom0_fixed from the placements that both cameras see at pan = tilt = 0.
3. T = T_head_zoom from the motions of head and camera, A T = T B (Eqs. 3, 4); then a fit of T, the axis offset dz and
   the squareness eps to the corners.

Each step holds the results of earlier ones, so errors add up, and the normal matrices of the steps miss most of the
uncertainty. The method therefore gives no covariance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from cotarget.calibration.bundle import fit
from cotarget.calibration.initialization import (
    both_cameras,
    check_pairs,
    of_both,
    pairs_at_home,
    place_boards,
    rough_hand,
    stereo,
)
from cotarget.calibration.model import CameraName, Residuals, Solution, View
from cotarget.errors import CalibrationError
from cotarget.geometry import Array


def sequential(
    views: Sequence[View],
    points: Array,
    sizes: Mapping[CameraName, tuple[int, int]],
    nominal_px: float | None = None,
) -> Solution:
    """Calibrate a rig step by step.

    Args:
        views: views of both cameras, those of the zoom camera at one focal length.
        points: the board's corners in its frame [m], (N, 3).
        sizes: image sizes (width, height) of both cameras [px].
        nominal_px: nominal focal length of the zoom views [px]; None where the lens reports none.

    Raises:
        CalibrationError: the views do not determine the rig; the message says what is missing.
    """
    steps = both_cameras(views, points, sizes, nominal_px)
    pairs = pairs_at_home(steps.views)
    if not pairs:
        raise CalibrationError(
            "stereo: no placement of the board is seen by both cameras at pan = tilt = 0, which the sequential method "
            "needs; the joint method does not"
        )
    stereo_fit = stereo(steps.model, pairs, points)
    check_pairs(steps, stereo_fit.rms_px)
    assert stereo_fit.model.zoom_head is not None
    model = steps.model.with_zoom_head(T_zoom0_fixed=stereo_fit.model.zoom_head.T_zoom0_fixed)
    used, handeye_rms = of_both(steps.views), None
    if steps.has_head:
        zoom_views = [view for view in steps.views if view.camera == "zoom"]
        model = place_boards(
            model.with_zoom_head(T_head_zoom=rough_hand(model, zoom_views, points)), steps.views, points
        )
        hand_fit = fit(model, zoom_views, points, {"hand", "head"})
        model, handeye_rms = replace(model, zoom_head=hand_fit.model.zoom_head), hand_fit.rms_px
    else:
        model = place_boards(model, used, points)
    residuals = Residuals(
        fixed_rms_px=steps.fixed_fit.rms_px,
        zoom_rms_px=steps.zoom_fit.rms_px,
        stereo_rms_px=stereo_fit.rms_px,
        handeye_rms_px=handeye_rms,
        fixed_views=len([view for view in steps.views if view.camera == "fixed"]),
        zoom_views=len([view for view in steps.views if view.camera == "zoom"]),
        pairs=len({view.board for view in pairs}),
        rejected=steps.rejected,
    )
    return Solution(model, residuals, steps.views, steps.has_head)
