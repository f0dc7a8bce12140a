"""T_head_zoom from motions of the head and of the camera: A_i T = T B_i (Eqs. 3, 4), after Park and Martin (1994).

F. C. Park and B. J. Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group", IEEE Transactions on
Robotics and Automation 10(5), 1994.
"""

import itertools
from collections.abc import Sequence

import numpy as np

from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform, Rotation

# Axes of rotation count as one direction when the second singular value of all rotation vectors is below this share
# of the first: a head that only pans or only tilts leaves two of T's six numbers free.
PARALLEL_SHARE = 0.05
SMALLEST_TURN = np.radians(0.5)  # motions below this say more about noise than about axes
# A motion's angle is the same seen by the head and by the camera. Corners of 0.2 px on a board 3 m away turn it by
# 0.1 to 0.3 degrees; several times that, and a share of the angle, is another cause.
ANGLE_TOLERANCE = np.radians(2.0)
ANGLE_SHARE = 0.1
# The least determined direction may come out mirrored by noise alone while its singular value is below this share.
WEAK_SHARE = 0.01


def motions(
    poses_base_head: Sequence[RigidTransform], poses_zoom_board: Sequence[RigidTransform]
) -> tuple[list[RigidTransform], list[RigidTransform]]:
    """All motions between poses of the head with one board standing still.

    Args:
        poses_base_head: T_base_head of each view.
        poses_zoom_board: T_zoom_board of each view.

    Returns:
        A: T_head_head' = T_base_head^-1 T_base_head', and B: T_zoom_zoom' = T_zoom_board T_zoom_board'^-1.
    """
    pairs = list(itertools.combinations(range(len(poses_base_head)), 2))
    return (
        [poses_base_head[i].inv() * poses_base_head[j] for i, j in pairs],
        [poses_zoom_board[i] * poses_zoom_board[j].inv() for i, j in pairs],
    )


def park_martin(head_motions: Sequence[RigidTransform], camera_motions: Sequence[RigidTransform]) -> RigidTransform:
    """Solve A_i T = T B_i in closed form.

    The sign of pan or of tilt cannot be wrong: a head that counts the other way is the same head with its frame
    turned by half a turn, which T absorbs, so that such a calibration points as well as any.

    Args:
        head_motions: A_i.
        camera_motions: B_i.

    Returns:
        T_head_zoom.

    Raises:
        CalibrationError: the motions are too few, all about one axis, or contradict each other.
    """
    alpha = _rotvecs(head_motions)
    beta = _rotvecs(camera_motions)
    _check_axes(alpha)
    _check_angles(alpha, beta)
    # R = (M^T M)^(-1/2) M^T with M = sum_i beta_i alpha_i^T; with M = U S V^T that is V U^T.
    U, s, Vt = np.linalg.svd(beta.T @ alpha)
    R = Vt.T @ U.T
    if np.linalg.det(R) < 0:
        if s[2] > WEAK_SHARE * s[0]:
            raise CalibrationError(
                "hand-eye: the answer is a reflection (determinant -1): the head's angles and the camera's motions "
                "contradict each other; check that pan and tilt are not exchanged"
            )
        Vt[2] = -Vt[2]  # two axes determine a rotation; the third direction is the one that noise has turned round
        R = Vt.T @ U.T
    _check_axes_agree(alpha, beta @ R.T)
    # (R_A - I) t = R t_B - t_A, all motions at once.
    left = np.concatenate([A.rotation.as_matrix() - np.eye(3) for A in head_motions])
    right = np.concatenate(
        [R @ B.translation - A.translation for A, B in zip(head_motions, camera_motions, strict=True)]
    )
    t = np.linalg.lstsq(left, right, rcond=None)[0]
    return RigidTransform.from_components(t, Rotation.from_matrix(R))


def _rotvecs(motions: Sequence[RigidTransform]) -> Array:
    return np.array([motion.rotation.as_rotvec() for motion in motions]).reshape(-1, 3)


def _check_axes(alpha: Array) -> None:
    """Refuse motions that leave T undetermined, and say which axis is missing."""
    if not len(alpha) or np.linalg.norm(alpha, axis=1).max() < SMALLEST_TURN:
        raise CalibrationError("hand-eye: the head did not move between the views; both pan and tilt must")
    _, s, Vt = np.linalg.svd(alpha)
    if len(s) > 1 and s[1] > PARALLEL_SHARE * s[0]:
        return
    moved, missing = ("pan", "tilt") if abs(Vt[0][1]) > abs(Vt[0][0]) else ("tilt", "pan")
    raise CalibrationError(
        f"hand-eye: only {moved} moved: the shift along its axis and the turn about it stay unknown; "
        f"add views with other {missing}"
    )


def _check_angles(alpha: Array, beta: Array) -> None:
    """A_i and B_i are the same motion in two frames, so they turn by the same angle."""
    head, camera = np.linalg.norm(alpha, axis=1), np.linalg.norm(beta, axis=1)
    off = np.abs(head - camera)
    if np.median(off - ANGLE_SHARE * head) > ANGLE_TOLERANCE:
        i = int(np.argsort(off)[len(off) // 2])
        raise CalibrationError(
            f"hand-eye: the head says that it turned by {np.degrees(head[i]):.1f} degrees where the zoom camera turned "
            f"by {np.degrees(camera[i]):.1f}; check the head's units and that the camera is fastened to it"
        )


def _check_axes_agree(alpha: Array, beta_in_head: Array) -> None:
    """After the fit the axes agree as well, or no T explains the motions."""
    off = np.linalg.norm(alpha - beta_in_head, axis=1)
    if np.median(off - ANGLE_SHARE * np.linalg.norm(alpha, axis=1)) > ANGLE_TOLERANCE:
        raise CalibrationError(
            f"hand-eye: no T explains the motions: {np.degrees(np.median(off)):.1f} degrees remain between the head's "
            "and the camera's; check that pan and tilt are not exchanged, and that the boards stood still"
        )
