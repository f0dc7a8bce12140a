"""One camera's intrinsics from views of the board, and the board's pose in one view (Zhang 2000, by OpenCV)."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from cotarget.calibration.bundle import Fit, fit
from cotarget.calibration.model import CameraName, View
from cotarget.calibration.parameters import RigModel
from cotarget.camera import Intrinsics
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform, Rotation

FEWEST_VIEWS = 3  # Zhang's method: two views determine a pinhole, a third the distortion
FEWEST_CORNERS = 4  # of a plane, for its pose
# OpenCV starts the fit from this many views, evenly picked: its time grows with their square.
STARTING_VIEWS = 20
# A start only: no tangential distortion nor k2, k3, which a few views near the middle do not determine.
START_FLAGS = cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_ASPECT_RATIO


def calibrate_camera(
    camera: CameraName, views: Sequence[View], points: Array, size: tuple[int, int], start: Intrinsics | None = None
) -> tuple[Intrinsics, Fit]:
    """Fit one camera's intrinsics: focal lengths, principal point, k1, k2, p1, p2; every view's pose is free.

    Args:
        camera: which one.
        views: its views, all at one focal length.
        points: the board's corners in its frame [m], (N, 3).
        size: (width, height) [px].
        start: where to start, if that is known.

    Raises:
        CalibrationError: too few views, or OpenCV finds no camera that explains them.
    """
    if len(views) < FEWEST_VIEWS:
        raise CalibrationError(
            f"{camera} camera: {len(views)} usable views of the board; at least {FEWEST_VIEWS} are needed"
        )
    lens = start or rough_intrinsics(camera, views, points, size)
    alone = [replace(view, camera="fixed", board=i) for i, view in enumerate(views)]
    boards = {i: board_pose(lens, view.corners_px, points) for i, view in enumerate(views)}
    result = fit(RigModel(boards=boards, fixed=lens), alone, points, {"fixed"})
    assert result.model.fixed is not None
    return result.model.fixed, result


def rough_intrinsics(camera: CameraName, views: Sequence[View], points: Array, size: tuple[int, int]) -> Intrinsics:
    """A camera with equal focal lengths and k1 alone, from nothing but a few views.

    Raises:
        CalibrationError: OpenCV finds no camera that explains them.
    """
    picked = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, STARTING_VIEWS).round().astype(int))]
    try:
        _, K, distortion, _, _ = cv2.calibrateCamera(
            [points[view.seen].astype(np.float32) for view in picked],
            [view.corners_px[view.seen].astype(np.float32) for view in picked],
            size,
            np.array([[1.0, 0, (size[0] - 1) / 2], [0, 1.0, (size[1] - 1) / 2], [0, 0, 1.0]]),
            np.zeros(5),
            flags=START_FLAGS,
        )
    except cv2.error:
        K = np.full((3, 3), np.nan)
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise CalibrationError(
            f"{camera} camera: no intrinsics explain its {len(views)} views; tilt the board in varying directions"
        )
    k = [float(value) for value in np.ravel(distortion)[:5]]
    return Intrinsics(
        size=size,
        focal_px=(float(K[0, 0]), float(K[1, 1])),
        center_px=(float(K[0, 2]), float(K[1, 2])),
        distortion=(k[0], k[1], k[2], k[3], k[4]),
    )


def board_pose(lens: Intrinsics, corners_px: Array, points: Array) -> RigidTransform:
    """The board's pose in a camera's frame, T_camera_board, from one view.

    Raises:
        CalibrationError: no pose explains the corners.
    """
    points, corners_px = _seen(points, corners_px)
    ok, rotvec, translation = cv2.solvePnP(
        points, corners_px, lens.matrix, np.array(lens.distortion), flags=cv2.SOLVEPNP_IPPE
    )
    if not ok or not (np.isfinite(rotvec).all() and np.isfinite(translation).all()):
        raise CalibrationError("no pose of the board explains its corners")
    rotvec, translation = cv2.solvePnPRefineLM(
        points, corners_px, lens.matrix, np.array(lens.distortion), rotvec, translation
    )
    return RigidTransform.from_components(np.ravel(translation), Rotation.from_rotvec(np.ravel(rotvec)))


def pose_candidates(lens: Intrinsics, corners_px: Array, points: Array) -> list[RigidTransform]:
    """The one or two poses of a flat board that explain its corners about equally, the better one first.

    Raises:
        CalibrationError: no pose explains the corners.
    """
    points, corners_px = _seen(points, corners_px)
    _, rotvecs, translations, _ = cv2.solvePnPGeneric(
        points, corners_px, lens.matrix, np.array(lens.distortion), flags=cv2.SOLVEPNP_IPPE
    )
    found = [
        RigidTransform.from_components(np.ravel(t), Rotation.from_rotvec(np.ravel(r)))
        for r, t in zip(rotvecs, translations, strict=True)
        if np.isfinite(r).all() and np.isfinite(t).all()
    ]
    if not found:
        raise CalibrationError("no pose of the board explains its corners")
    return found


def _seen(points: Array, corners_px: Array) -> tuple[Array, Array]:
    """The points that are seen, and where.

    Raises:
        CalibrationError: they are too few for a pose.
    """
    seen = np.isfinite(corners_px[:, 0])
    if np.count_nonzero(seen) < FEWEST_CORNERS:
        raise CalibrationError(f"{np.count_nonzero(seen)} corners of the board do not determine its pose")
    return points[seen], corners_px[seen]
