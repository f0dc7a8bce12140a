"""Where a fit starts: each camera by itself, T from motions, Gamma from every placement that both cameras see.

Whatever of a head's geometry, of the order of the views and of the cameras' places is known or not, these starts need
none of it.
"""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from cotarget.calibration.bundle import Fit
from cotarget.calibration.handeye import motions, park_martin, solve_hand_eye
from cotarget.calibration.intrinsics import board_pose, calibrate_camera
from cotarget.calibration.model import CameraName, Rejected, View
from cotarget.calibration.parameters import RigModel
from cotarget.calibration.robust import robust_sigma
from cotarget.camera import Intrinsics
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.pantilt import base_head

# A view whose typical corner is off by this many times what is usual for its camera, and above the floor, is left out;
# single wrong corners are left to the last fit.
OUTLIER_FACTOR = 4.0
OUTLIER_FLOOR_PX = 0.5
HOME_TOLERANCE = np.radians(0.01)  # the head is at home within a fifth of the smallest usual step


def at_home(view: View) -> bool:
    """Whether the head was at pan = tilt = 0."""
    return max(abs(view.pan), abs(view.tilt)) <= HOME_TOLERANCE


def one_camera(
    camera: CameraName, views: Sequence[View], points: Array, size: tuple[int, int]
) -> tuple[Intrinsics, Fit, tuple[View, ...], list[Rejected]]:
    """One camera's intrinsics from its views alone, without those that do not fit with the others.

    Raises:
        CalibrationError: too few views, or no camera explains them.
    """
    mine = tuple(view for view in views if view.camera == camera)
    lens, result = calibrate_camera(camera, mine, points, size)
    typical = np.array([robust_sigma(r[view.seen]) for r, view in zip(result.residuals, mine, strict=True)]) * 2**0.5
    limit = max(OUTLIER_FACTOR * float(np.median(typical)), OUTLIER_FLOOR_PX)
    good = tuple(view for view, value in zip(mine, typical, strict=True) if value <= limit)
    if len(good) == len(mine):
        return lens, result, mine, []
    rejected = [
        Rejected(view.name, f"its corners are {value:.2f} px off, where {limit:.2f} px is the limit")
        for view, value in zip(mine, typical, strict=True)
        if value > limit
    ]
    lens, result = calibrate_camera(camera, good, points, size, start=lens)
    return lens, result, good, rejected


def pairs_at_home(views: Sequence[View]) -> tuple[View, ...]:
    """The views of those placements that both cameras see with the head at home."""
    return of_both([view for view in views if view.camera == "fixed" or at_home(view)])


def of_both(views: Sequence[View]) -> tuple[View, ...]:
    """The views of those placements that both cameras see."""
    seen = [{view.board for view in views if view.camera == camera} for camera in ("fixed", "zoom")]
    return tuple(view for view in views if view.board in seen[0] & seen[1])


def rough_gamma(model: RigModel, views: Sequence[View], points: Array) -> RigidTransform:
    """Gamma from placements that both cameras see, whatever the head's pose: the candidate nearest to all others.

    Args:
        model: both cameras, and the hand where the head has moved.
        views: of such placements.
        points: the board's corners in its frame [m], (N, 3).
    """
    assert model.fixed is not None
    by_board: dict[int, list[View]] = defaultdict(list)
    for view in views:
        by_board[view.board].append(view)
    candidates = []
    for same in by_board.values():
        boards = [board_pose(model.fixed, v.corners_px, points) for v in same if v.camera == "fixed"]
        for view in same:
            if view.camera == "fixed":
                continue
            T_zoom_board = board_pose(model.lens_of(view), view.corners_px, points)
            head = base_head(view.pan, view.tilt, model.head)
            T_zoom0_zoom = model.hand.inv() * head * model.hand  # Eq. 2 solved for Gamma
            candidates += [T_zoom0_zoom * T_zoom_board * board.inv() for board in boards]
    return _most_central(candidates, scale=float(np.ptp(points, axis=0).max()))


def _most_central(candidates: Sequence[RigidTransform], scale: float) -> RigidTransform:
    """The transform nearest to all others: a board seen in its mirrored pose cannot pull it away."""
    t = np.array([T.translation for T in candidates])
    q = Rotation.concatenate([T.rotation for T in candidates])
    far = np.linalg.norm(t[:, None] - t[None], axis=-1) / scale
    turned = np.array([(q * one.inv()).magnitude() for one in q])
    return candidates[int(np.argmin(np.median(far + turned, axis=1)))]


def rough_hand(model: RigModel, views: Sequence[View], points: Array, *, insist: bool = False) -> RigidTransform:
    """T by Park and Martin's method from all motions within each placement.

    Args:
        model: with the zoom camera.
        views: of any placements.
        points: the board's corners in its frame [m], (N, 3).
        insist: whether to take the smallest turn and shift of what the motions leave free.

    Raises:
        CalibrationError: the motions do not determine it, or contradict each other.
    """
    A, B = head_motions(model, views, points)
    return solve_hand_eye(A, B, insist=True).X if insist else park_martin(A, B)


def head_motions(
    model: RigModel, views: Sequence[View], points: Array
) -> tuple[list[RigidTransform], list[RigidTransform]]:
    """All motions of the head and of the camera within each placement, A and B of A T = T B."""
    assert model.zoom is not None
    placements: dict[int, list[View]] = defaultdict(list)
    for view in views:
        if view.camera == "zoom":
            placements[view.board].append(view)
    A: list[RigidTransform] = []
    B: list[RigidTransform] = []
    for same in placements.values():
        heads = [base_head(view.pan, view.tilt, model.head) for view in same]
        boards = [board_pose(model.lens_of(view), view.corners_px, points) for view in same]
        for more, motion in zip((A, B), motions(heads, boards), strict=True):
            more.extend(motion)
    if not A:
        raise CalibrationError(
            "hand-eye: no placement of the board is seen by the zoom camera from two poses of the head; "
            "leave the board where it is while the head turns"
        )
    return A, B
