"""The sequential method, step by step as in the paper's Table 1, and a last refinement of everything together.

1. Intrinsics of each camera by itself, the zoom camera at its shortest focal length.
2. Gamma = T_zoom0_fixed from the placements that both cameras see at pan = tilt = 0.
3. T = T_head_zoom from the motions of head and camera, A T = T B (Eqs. 3, 4); then T, the axis offset dz and the
   non-squareness eps refined on the corners themselves.
4. Unless it is switched off: one more fit of all of these at once, from all views. It halves and more the pointing
   error, because a board that moves through the zoom image ties Gamma, T and the intrinsics together.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cotarget.calibration.bundle import Fit, fit, rms
from cotarget.calibration.handeye import motions, park_martin
from cotarget.calibration.intrinsics import board_pose, calibrate_camera
from cotarget.calibration.model import CameraName, Covariance, Rejected, Residuals, View
from cotarget.calibration.placing import place_boards
from cotarget.calibration.reprojection import Block, RigModel
from cotarget.calibration.uncertainty import covariance_of
from cotarget.camera import Intrinsics
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.pantilt import base_head

# A view whose rms is this many times the median of its camera's views, and above the floor, is left out.
OUTLIER_FACTOR = 4.0
OUTLIER_FLOOR_PX = 0.5
HOME_TOLERANCE = np.radians(0.01)  # the head is at home within a fifth of the smallest usual step


@dataclass(frozen=True, eq=False)
class Solution:
    """What the method found: the model (every placement's board in it), residuals, and the views it used.

    The covariance is the last refinement's. Without that there is none: the steps before it hold fixed what earlier
    ones found, so that their own normal matrices know nothing of most of what is uncertain.
    """

    model: RigModel
    residuals: Residuals
    views: tuple[View, ...]
    has_head: bool
    covariance: Covariance | None


def sequential(
    views: Sequence[View], points: Array, sizes: Mapping[CameraName, tuple[int, int]], *, refine: bool = True
) -> Solution:
    """Calibrate a rig step by step.

    Args:
        views: of both cameras, those of the zoom camera at one focal length.
        points: the board's corners in its frame [m], (N, 3).
        sizes: (width, height) of both cameras [px].
        refine: whether to end with the fit of everything together.

    Raises:
        CalibrationError: the views do not determine the rig; the message says what is missing.
    """
    rejected: list[Rejected] = []
    fixed, fixed_fit, fixed_views = _one_camera("fixed", views, points, sizes["fixed"], rejected)
    zoom, zoom_fit, zoom_views = _one_camera("zoom", views, points, sizes["zoom"], rejected)
    used = (*fixed_views, *zoom_views)
    pairs = _pairs(used)
    model, stereo_fit = _gamma(RigModel(boards={}, fixed=fixed, zoom=zoom), pairs, points)
    has_head = any(not at_home(view) for view in zoom_views)
    handeye_rms = None
    if has_head:
        model = replace(model, hand=_hand(model, zoom_views, points))
        model = place_boards(model, used, points)
        hand_fit = fit(model, zoom_views, points, {"hand", "head"})
        model, handeye_rms = replace(model, hand=hand_fit.model.hand, head=hand_fit.model.head), hand_fit.rms_px
    covariance = None
    if refine:
        model = model if has_head else place_boards(model, used, points)
        everything: tuple[Block, ...] = ("fixed", "zoom", "gamma", "hand", "head")
        free = everything if has_head else everything[:3]
        final = fit(model, used, points, free)
        model, covariance = final.model, covariance_of(final, free)
        handeye_rms = rms(final.residuals[len(fixed_views) :]) if has_head else None
    residuals = Residuals(
        fixed_rms_px=fixed_fit.rms_px,
        zoom_rms_px=zoom_fit.rms_px,
        stereo_rms_px=stereo_fit.rms_px,
        handeye_rms_px=handeye_rms,
        fixed_views=len(fixed_views),
        zoom_views=len(zoom_views),
        pairs=len({view.board for view in pairs}),
        rejected=tuple(rejected),
    )
    return Solution(model, residuals, used, has_head, covariance)


def at_home(view: View) -> bool:
    """Whether the head was at pan = tilt = 0."""
    return max(abs(view.pan), abs(view.tilt)) <= HOME_TOLERANCE


def _one_camera(
    camera: CameraName, views: Sequence[View], points: Array, size: tuple[int, int], rejected: list[Rejected]
) -> tuple[Intrinsics, Fit, tuple[View, ...]]:
    """Step 1 for one camera, without the views that do not fit with the others."""
    mine = tuple(view for view in views if view.camera == camera)
    lens, result = calibrate_camera(camera, mine, points, size)
    view_rms = np.sqrt(np.mean(np.sum(result.residuals**2, axis=-1), axis=-1))
    limit = max(OUTLIER_FACTOR * float(np.median(view_rms)), OUTLIER_FLOOR_PX)
    good = tuple(view for view, value in zip(mine, view_rms, strict=True) if value <= limit)
    if len(good) == len(mine):
        return lens, result, mine
    rejected += [
        Rejected(view.name, f"{value:.2f} px rms, where {limit:.2f} px is the limit")
        for view, value in zip(mine, view_rms, strict=True)
        if value > limit
    ]
    lens, result = calibrate_camera(camera, good, points, size, start=lens)
    return lens, result, good


def _pairs(views: Sequence[View]) -> tuple[View, ...]:
    """The views of those placements that both cameras see with the head at home."""
    home = [view for view in views if view.camera == "fixed" or at_home(view)]
    seen = [{view.board for view in home if view.camera == camera} for camera in ("fixed", "zoom")]
    return tuple(view for view in home if view.board in seen[0] & seen[1])


def _gamma(model: RigModel, pairs: Sequence[View], points: Array) -> tuple[RigModel, Fit]:
    """Step 2: Gamma with the intrinsics as they are."""
    if not pairs:
        raise CalibrationError("stereo: no placement of the board is seen by both cameras at pan = tilt = 0")
    assert model.fixed is not None
    assert model.zoom is not None
    by_board: dict[int, dict[str, RigidTransform]] = defaultdict(dict)
    for view in pairs:
        lens = model.fixed if view.camera == "fixed" else model.zoom
        by_board[view.board][view.camera] = board_pose(lens, view.corners_px, points)
    candidates = [poses["zoom"] * poses["fixed"].inv() for poses in by_board.values()]
    start = replace(
        model,
        gamma=_most_central(candidates, scale=float(np.ptp(points, axis=0).max())),
        boards={number: poses["fixed"] for number, poses in by_board.items()},
    )
    result = fit(start, pairs, points, {"gamma"})
    return replace(model, gamma=result.model.gamma, boards=result.model.boards), result


def _most_central(candidates: Sequence[RigidTransform], scale: float) -> RigidTransform:
    """The transform nearest to all others: a board seen in its mirrored pose cannot pull it away."""
    t = np.array([T.translation for T in candidates])
    q = Rotation.concatenate([T.rotation for T in candidates])
    far = np.linalg.norm(t[:, None] - t[None], axis=-1) / scale
    turned = np.array([(q * one.inv()).magnitude() for one in q])
    return candidates[int(np.argmin(np.median(far + turned, axis=1)))]


def _hand(model: RigModel, views: Sequence[View], points: Array) -> RigidTransform:
    """Step 3's start: Park and Martin's T from all motions within each placement."""
    assert model.zoom is not None
    placements: dict[int, list[View]] = defaultdict(list)
    for view in views:
        placements[view.board].append(view)
    A: list[RigidTransform] = []
    B: list[RigidTransform] = []
    for same in placements.values():
        heads = [base_head(view.pan, view.tilt, model.head) for view in same]
        boards = [board_pose(model.zoom, view.corners_px, points) for view in same]
        for more, motion in zip((A, B), motions(heads, boards), strict=True):
            more.extend(motion)
    return park_martin(A, B)
