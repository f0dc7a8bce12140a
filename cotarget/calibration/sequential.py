"""The sequential method, step by step as in the paper's Table 1; kept to be compared with.

1. Intrinsics of each camera by itself, the zoom camera at its shortest focal length.
2. Gamma = T_zoom0_fixed from the placements that both cameras see at pan = tilt = 0.
3. T = T_head_zoom from the motions of head and camera, A T = T B (Eqs. 3, 4); then T, the axis offset dz and the
   non-squareness eps refined on the corners themselves.

Each step holds fixed what earlier ones found, so that errors add up, and the steps' own normal matrices know nothing of
most of what is uncertain: the method gives no covariance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from cotarget.calibration.bundle import Fit, fit
from cotarget.calibration.model import CameraName, Covariance, HeldOut, Rejected, Residuals, View
from cotarget.calibration.parameters import RigModel
from cotarget.calibration.placing import place_boards
from cotarget.calibration.start import at_home, of_both, one_camera, pairs_at_home, rough_gamma, rough_hand
from cotarget.camera import ZoomLens
from cotarget.errors import CalibrationError
from cotarget.geometry import Array

# Pictures of two cameras that did not stand still are explained so many times worse together than each camera's alone;
# lenses and boards that are not as modelled cost less than twice.
CONTRADICTION, CONTRADICTION_FLOOR_PX = 3.0, 1.0


@dataclass(frozen=True, eq=False)
class Solution:
    """What a method found: the model (every placement's board in it), residuals, and the views it used."""

    model: RigModel
    residuals: Residuals
    views: tuple[View, ...]
    has_head: bool
    covariance: Covariance | None = None
    jitter: float = 0.0
    held_out: HeldOut | None = None


@dataclass(frozen=True, eq=False)
class Steps:
    """What the steps before a joint fit found, and their residuals."""

    model: RigModel
    fixed_fit: Fit
    zoom_fit: Fit
    views: tuple[View, ...]
    rejected: tuple[Rejected, ...]

    @property
    def has_head(self) -> bool:
        """Whether the head ever left home."""
        return any(view.camera == "zoom" and not at_home(view) for view in self.views)


def both_cameras(
    views: Sequence[View], points: Array, sizes: Mapping[CameraName, tuple[int, int]], nominal_px: float | None
) -> Steps:
    """Step 1: each camera by itself, from views of one focal length."""
    fixed, fixed_fit, fixed_views, fixed_rejected = one_camera("fixed", views, points, sizes["fixed"])
    zoom, zoom_fit, zoom_views, zoom_rejected = one_camera("zoom", views, points, sizes["zoom"])
    model = RigModel({}, fixed, ZoomLens((nominal_px or zoom.focal_px[0],), (zoom,)))
    rejected = (*fixed_rejected, *zoom_rejected)
    return Steps(model, fixed_fit, zoom_fit, (*fixed_views, *zoom_views), rejected)


def stereo(model: RigModel, pairs: Sequence[View], points: Array) -> Fit:
    """Step 2: Gamma with the intrinsics as they are, from pairs at home."""
    start = replace(model, gamma=rough_gamma(model, pairs, points))
    return fit(place_boards(start, pairs, points), pairs, points, {"gamma"})


def check_pairs(steps: Steps, together_px: float) -> None:
    """Refuse pictures of two cameras without a head that contradict each other: alone each explains its own far better.

    Args:
        steps: each camera by itself.
        together_px: rms of both with one offset between them [px].

    Raises:
        CalibrationError: they do.
    """
    alone_px = max(steps.fixed_fit.rms_px, steps.zoom_fit.rms_px)
    if not steps.has_head and together_px > max(CONTRADICTION * alone_px, CONTRADICTION_FLOOR_PX):
        raise CalibrationError(
            f"the two cameras contradict each other: no one offset between them explains the corners to better than "
            f"{together_px:.2g} px, where each camera by itself does to {alone_px:.2g} px; both must stand still from "
            "the first picture to the last, and the two of a pair must show the board in the same place"
        )


def sequential(
    views: Sequence[View],
    points: Array,
    sizes: Mapping[CameraName, tuple[int, int]],
    nominal_px: float | None = None,
) -> Solution:
    """Calibrate a rig step by step.

    Args:
        views: of both cameras, those of the zoom camera at one focal length.
        points: the board's corners in its frame [m], (N, 3).
        sizes: (width, height) of both cameras [px].
        nominal_px: that focal length by the device's own account; None where it told none.

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
    model = replace(steps.model, gamma=stereo_fit.model.gamma)
    used, handeye_rms = of_both(steps.views), None
    if steps.has_head:
        zoom_views = [view for view in steps.views if view.camera == "zoom"]
        model = place_boards(replace(model, hand=rough_hand(model, zoom_views, points)), steps.views, points)
        hand_fit = fit(model, zoom_views, points, {"hand", "head"})
        model, handeye_rms = replace(model, hand=hand_fit.model.hand, head=hand_fit.model.head), hand_fit.rms_px
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
