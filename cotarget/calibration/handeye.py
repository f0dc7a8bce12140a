"""Hand-eye: X = T_hand_camera from motions of the hand and of the camera, A_i X = X B_i (Eqs. 3, 4).

`park_martin` gives it in closed form. `solve_hand_eye` and `solve_hand_eye_from_poses` go on from there to the most
likely X, with its covariance and with a verdict on what the motions determine; they serve a robot's arm as well as a
pan-tilt head, whose hand turns without shifting.

F. C. Park and B. J. Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group", IEEE Transactions on
Robotics and Automation 10(5), 1994.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cotarget.calibration.motionfit import Problem, fit_motions, insist_on, motion_problem, pose_problem
from cotarget.calibration.observability import (
    PARALLEL_SHARE,
    SMALLEST_TURN,
    HandMotions,
    Observability,
    judge_motions,
)
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform, Rotation

# A motion's angle is the same seen by the head and by the camera. Corners of 0.2 px on a board 3 m away turn it by
# 0.1 to 0.3 degrees; several times that, and a share of the angle, is another cause.
ANGLE_TOLERANCE = np.radians(2.0)
ANGLE_SHARE = 0.1
# The least determined direction may come out mirrored by noise alone while its singular value is below this share.
WEAK_SHARE = 0.01
# While the search only needs a start, a second axis counts that is seen at a hundredth of the first (squared).
START_SHARE = 1e-4
START_ROUNDS = 4
START_MEDIANS = 3.0  # one Gaussian motion in eighty is further off
UNTURNED = 1e-6  # [rad]; less than this is no rotation but rounding
# Cosine and sine of a turn that the translations tell come out of linear equations with length 1; with length 0 where
# they do not tell it.
HALF = 0.5


@dataclass(frozen=True, eq=False)
class HandEye:
    """X, how well it is known, and how well it explains the motions.

    Attributes:
        X: T_hand_camera.
        covariance: of an error (w, d) of X, exp(w) R and t + d, [rad] and [m], (6, 6); as in `Covariance`.
        rotation_rms: root mean square angle that remains of a motion (of a pose, where poses were given) [rad].
        translation_rms: root mean square distance that remains [m].
        verdict: what the motions determine.
        rejected: numbers of the motions (poses) that were left out as gross errors.
        boards: T_base_board of each placement, in the order of their numbers; empty where only motions were given.
    """

    X: RigidTransform
    covariance: Array
    rotation_rms: float
    translation_rms: float
    verdict: Observability
    rejected: tuple[int, ...] = ()
    boards: tuple[RigidTransform, ...] = ()


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
    R = _park_martin_rotation(alpha, beta)
    _check_axes_agree(alpha, beta @ R.T)
    A, B = RigidTransform.concatenate(list(head_motions)), RigidTransform.concatenate(list(camera_motions))
    return RigidTransform.from_components(_translation(R, A, B), Rotation.from_matrix(R))


def solve_hand_eye(
    A: Sequence[RigidTransform], B: Sequence[RigidTransform], *, independent: int | None = None, insist: bool = False
) -> HandEye:
    """Find the most likely X of A_i X = X B_i, with its covariance.

    From Park and Martin's X, by least squares on what remains of A_i^-1 X B_i X^-1 in rotation and of A_i X and X B_i
    in translation, both weighted by their own standard deviations; seven motions and more have these estimated, and
    gross errors left out. The covariance takes the motions as independent. Motions that share poses are not: all pairs
    of n poses tell no more than n - 1 of them, and `independent` says so. With poses at hand,
    `solve_hand_eye_from_poses` is more exact.

    Args:
        A: motions of the hand, T_hand_hand', two or more; see `motions`.
        B: motions of the camera, T_camera_camera', likewise.
        independent: how many of the motions are independent; all, by default.
        insist: to be given an X also where the motions leave some of it free. Its rotation and translation are then
            the smallest that explain the motions, and its free directions have standard deviations of
            `INSISTED_ROTATION` and `INSISTED_POSITION`.

    Raises:
        CalibrationError: the motions contradict each other, or leave X undetermined; in words, with what to add.
    """
    if len(A) < 2 or len(A) != len(B):
        raise CalibrationError(f"hand-eye: {len(A)} and {len(B)} motions; it takes two or more, as many of each")
    a, b = _together(A), _together(B)
    problem = motion_problem(a, b, len(A) if independent is None else independent)
    X = RigidTransform.concatenate([_start(a, b)])
    return _solved(problem, X, HandMotions(a.rotation.as_rotvec(), a.translation), insist)


def solve_hand_eye_from_poses(
    T_base_hand: Sequence[RigidTransform],
    T_camera_board: Sequence[RigidTransform],
    *,
    placements: Sequence[int] | None = None,
    middle: Sequence[float] | Array = (0.0, 0.0, 0.0),
    insist: bool = False,
) -> HandEye:
    """Find the most likely X and places of the board from poses: T_base_hand X T_camera_board = T_base_board.

    What remains is looked at in the camera's frame, along the line of sight and across it apart: a camera sees across
    ten times better than along. From eight poses on, the standard deviations of all four (rotation about the line of
    sight and about axes across it, shift along and across) are estimated. The poses' errors are independent, so that
    the covariance is honest, as long as noise is the camera's. Noise of the hand's rotation moves board and view
    together, which these four know nothing of: where it dominates, 90 % ellipsoids hold X in some 70 % of cases.

    For a camera that stands still and a board in the hand, give the inverse of T_base_hand: X is T_base_camera then.

    Args:
        T_base_hand: of each view, a list of three scipy RigidTransforms or more [m].
        T_camera_board: of each view: where the board is in the camera's frame, not the other way round.
        placements: where the board stood during each view, by number; in one place throughout, by default.
        middle: of the board's points, in its frame [m], (3,): that is the point which the camera sees best. With a
            board whose origin is a corner it makes a difference.
        insist: see `solve_hand_eye`.

    Raises:
        CalibrationError: the poses contradict each other, or leave X undetermined; in words, with what to add.
    """
    where = np.zeros(len(T_base_hand), dtype=int) if placements is None else np.asarray(placements)
    if not len(T_base_hand) == len(T_camera_board) == len(where):
        raise CalibrationError("hand-eye: as many poses of the hand as of the board, and as many placements")
    numbers, owners = np.unique(where, return_inverse=True)
    pairs = [(i, j) for i, j in itertools.combinations(range(len(where)), 2) if where[i] == where[j]]
    if len(pairs) < 2:
        raise CalibrationError("hand-eye: it takes three views of a board in one place, or two each in two places")
    hands, seen = _together(T_base_hand), _together(T_camera_board)
    to_middle = RigidTransform.from_translation(np.asarray(middle, dtype=float))
    seen = seen * to_middle
    i, j = np.array(pairs).T
    A = hands[i].inv() * hands[j]
    X = _start(A, seen[i] * seen[j].inv())
    placed = hands * X * seen
    start = RigidTransform.concatenate([X, *(placed[np.flatnonzero(owners == k)].mean() for k in range(len(numbers)))])
    turns_base = (hands[j].rotation * hands[i].rotation.inv()).as_rotvec()
    moved = HandMotions(A.rotation.as_rotvec(), A.translation, turns_base)
    result = _solved(pose_problem(hands, seen, owners), start, moved, insist)
    return replace(result, boards=tuple(board * to_middle.inv() for board in result.boards))


def _together(transforms: Sequence[RigidTransform]) -> RigidTransform:
    """Many transforms as one object of scipy's.

    Raises:
        CalibrationError: they are something else.
    """
    try:
        return RigidTransform.concatenate(list(transforms))
    except TypeError:
        raise CalibrationError(
            "hand-eye: poses and motions are scipy's RigidTransform; "
            "RigidTransform.from_matrix makes them of 4x4 matrices"
        ) from None


def _solved(problem: Problem, start: RigidTransform, moved: HandMotions, insist: bool) -> HandEye:
    """Fit, judge, and refuse or insist."""
    found = fit_motions(problem, start)
    verdict = judge_motions(found.normal, found.noise, moved)
    if not verdict.determined:
        if not insist:
            raise CalibrationError(f"hand-eye: {verdict.text}")
        found = insist_on(problem, found)
    r = found.residuals[found.used]
    rotation_rms, translation_rms = (float(np.sqrt(np.mean(np.sum(part**2, axis=1)))) for part in (r[:, :3], r[:, 3:]))
    return HandEye(
        X=found.transforms[0],
        covariance=found.covariance,
        rotation_rms=rotation_rms,
        translation_rms=translation_rms,
        verdict=verdict,
        rejected=tuple(int(i) for i in np.flatnonzero(~found.used)),
        boards=tuple(found.transforms[1:]),
    )


def _start(A: RigidTransform, B: RigidTransform) -> RigidTransform:
    """Find an X in closed form, also where the motions leave some of it free.

    Raises:
        CalibrationError: the motions contradict each other.
    """
    alpha, beta = A.rotation.as_rotvec(), B.rotation.as_rotvec()
    _check_angles(alpha, beta)
    good = _angles_off(alpha, beta) <= ANGLE_TOLERANCE
    A, B, alpha, beta = A[good], B[good], alpha[good], beta[good]
    if np.linalg.norm(alpha, axis=1).max() < UNTURNED:  # then t_A = R t_B, or nothing moved
        R = _rotation_between(A.translation, B.translation)
    else:
        R = _rotation_between(alpha, beta)
        for _ in range(START_ROUNDS):  # a few gross errors shall not draw it away
            off = np.linalg.norm(alpha - beta @ R.T, axis=1)
            near = off <= START_MEDIANS * np.median(off) + UNTURNED
            R = _rotation_between(alpha[near], beta[near])
        _check_axes_agree(alpha, beta @ R.T)
        _, s, Vt = np.linalg.svd(alpha, full_matrices=False)
        if len(s) < 2 or s[1] ** 2 <= START_SHARE * s[0] ** 2:
            R = _turned_by_shifts(Vt[0], R, A, B)
    return RigidTransform.from_components(_translation(R, A, B), Rotation.from_matrix(R))


def _rotation_between(a: Array, b: Array) -> Array:
    """R with a_i = R b_i, (3, 3); the smallest where the vectors have one direction or none."""
    U, s, Vt = np.linalg.svd(b.T @ a)
    if s[0] == 0:
        return np.eye(3)
    if s[1] <= START_SHARE * s[0]:
        return np.asarray(Rotation.align_vectors(Vt[:1], U[:, :1].T)[0].as_matrix())
    return _park_martin_rotation(a, b)


def _turned_by_shifts(axis: Array, R: Array, A: RigidTransform, B: RigidTransform) -> Array:
    """Turn R about the only axis of all rotations as the translations tell, or not at all where they do not.

    With v = R t_B, (R_A - I) t + t_A = Rot(axis, phi) v = cos(phi) v_across + sin(phi) axis x v + v_along.
    """
    v = B.translation @ R.T
    along = np.outer(v @ axis, axis)
    left = np.concatenate(
        [A.rotation.as_matrix() - np.eye(3), -np.stack([v - along, np.cross(axis, v)], axis=-1)], axis=-1
    )
    _, _, _, c, s = np.linalg.lstsq(left.reshape(-1, 5), (along - A.translation).ravel(), rcond=None)[0]
    if np.hypot(c, s) < HALF:
        return R
    return Rotation.from_rotvec(np.arctan2(s, c) * axis).as_matrix() @ R


def _translation(R: Array, A: RigidTransform, B: RigidTransform) -> Array:
    """Solve (R_A - I) t = R t_B - t_A, all motions at once; the shortest t where they leave some of it free."""
    left = A.rotation.as_matrix() - np.eye(3)
    right = B.translation @ R.T - A.translation
    return np.asarray(np.linalg.lstsq(left.reshape(-1, 3), right.ravel(), rcond=None)[0], dtype=float)


def _rotvecs(motions: Sequence[RigidTransform]) -> Array:
    return np.array([motion.rotation.as_rotvec() for motion in motions]).reshape(-1, 3)


def _park_martin_rotation(alpha: Array, beta: Array) -> Array:
    """R with alpha_i = R beta_i in the least squares' sense, (3, 3)."""
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
    return R


def _check_axes(alpha: Array) -> None:
    """Refuse motions that leave T undetermined, and say which axis is missing."""
    if not len(alpha) or np.linalg.norm(alpha, axis=1).max() < SMALLEST_TURN:
        raise CalibrationError("hand-eye: the head did not move between the views; both pan and tilt must")
    _, s, Vt = np.linalg.svd(alpha, full_matrices=False)
    if len(s) > 1 and s[1] > PARALLEL_SHARE * s[0]:
        return
    moved, missing = ("pan", "tilt") if abs(Vt[0][1]) > abs(Vt[0][0]) else ("tilt", "pan")
    raise CalibrationError(
        f"hand-eye: only {moved} moved: the position of the camera along the {moved} axis and its rotation about it "
        f"are free; add {missing}, while a board stays where it is"
    )


def _check_angles(alpha: Array, beta: Array) -> None:
    """A_i and B_i are the same motion in two frames, so they turn by the same angle."""
    head, camera = np.linalg.norm(alpha, axis=1), np.linalg.norm(beta, axis=1)
    off = np.abs(head - camera)
    if np.median(_angles_off(alpha, beta)) > ANGLE_TOLERANCE:
        i = int(np.argsort(off)[len(off) // 2])
        raise CalibrationError(
            f"hand-eye: the head says that it turned by {np.degrees(head[i]):.1f} degrees where the zoom camera turned "
            f"by {np.degrees(camera[i]):.1f}; check the head's units and that the camera is fastened to it"
        )


def _angles_off(alpha: Array, beta: Array) -> Array:
    """By how much the angles differ, beyond the share that is tolerated [rad], (n,)."""
    head, camera = np.linalg.norm(alpha, axis=1), np.linalg.norm(beta, axis=1)
    return np.abs(head - camera) - ANGLE_SHARE * head


def _check_axes_agree(alpha: Array, beta_in_head: Array) -> None:
    """After the fit the axes agree as well, or no T explains the motions."""
    off = np.linalg.norm(alpha - beta_in_head, axis=1)
    if np.median(off - ANGLE_SHARE * np.linalg.norm(alpha, axis=1)) > ANGLE_TOLERANCE:
        raise CalibrationError(
            f"hand-eye: no T explains the motions: {np.degrees(np.median(off)):.1f} degrees remain between the head's "
            "and the camera's; check that pan and tilt are not exchanged, and that the boards stood still"
        )
