"""Hand-eye calibration: X = T_hand_camera from motions of the hand and of the camera, A_i X = X B_i (Eqs. 3, 4).

`park_martin` solves X in closed form. `solve_hand_eye_from_motions` and `solve_hand_eye` start there and find the
maximum-likelihood X, with its covariance and a verdict on what the motions determine. They serve a robot arm as well as
a pan-tilt head, whose hand turns without shifting and whose X is the paper's T. A rig's calibration only starts here:
the T that it saves is solved by `cotarget.calibration.bundle.fit`, from all corners at once.

These two are weighted least squares on SE(3) with estimated weights. The six residuals of a motion or pose fall into
groups (rotation and translation, or finer), each with its own standard deviation. It is estimated from the group's
residuals and its degrees of freedom less those that the parameters take (restricted maximum likelihood of a
variance-component model; Helmert 1907). A first fit with Huber's weights and medians finds gross errors; the second is
plain least squares without them.

F. C. Park and B. J. Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group", IEEE Transactions on
Robotics and Automation 10(5), 1994. Measurements: docs/design-notes.md.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cotarget.calibration.observability import (
    PARALLEL_SHARE,
    SMALLEST_TURN,
    Observability,
    judge_motions,
    spectrum,
)
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform, Rotation

# Assumed standard deviations while there are too few residuals to estimate them; only their ratio counts.
NOMINAL_ROTATION = 1e-3  # [rad]
NOMINAL_POSITION = 1e-3  # [m]
NOMINAL = np.repeat([NOMINAL_ROTATION, NOMINAL_POSITION], 3)
ENOUGH = 7  # independent motions from which each group's standard deviation is estimated and gross errors are searched
FEW = 4  # independent motions from which the standard deviations of rotation and translation are estimated
SMALLEST_SIGMA = 1e-9  # [rad] and [m]; exact data are rounded to less
SMALLEST_RATIO = 1e-3  # smallest standard deviation of a group over that of all, so that no group takes all the weight
MEDIAN_TO_SIGMA = 1.4826  # standard deviation over the median absolute value of a Gaussian variable
HUBER_SIGMAS = 4.0  # length of six whitened residuals from which Huber's weight falls; 1 % of Gaussian ones are longer
# Length of six whitened residuals beyond which a motion or pose is a gross error. Medians of a few poses may be half
# the true deviation, and Gaussian lengths exceed 4.5 once in a thousand times.
GROSS_SIGMAS = 9.0
ROUNDS = 200
CONVERGED = 1e-5  # length of the last step, in standard deviations
ROUGHLY = 0.03  # length of the last step while gross errors are searched, in standard deviations
LONGEST_TURN = 0.5  # largest turn in one step [rad], as far as linearising holds
# Directions with a smaller eigenvalue of `spectrum` are known far too badly and do not move during the search.
HOPELESS = 0.03
ROTATION_AND_TRANSLATION = (0, 0, 0, 1, 1, 1)
E3 = np.array([0.0, 0.0, 1.0])
# With k degrees of freedom left, an estimated variance widens the parameters' distribution to Student's, whose variance
# is larger by k / (k - 2).
STUDENT = 2.0
# Standard deviations of the prior, with mean zero, that `regularize` gives to undetermined directions.
REGULARIZED_ROTATION = 1.0  # [rad]
REGULARIZED_POSITION = 1.0  # [m]
PRIOR = 1 / np.repeat([REGULARIZED_ROTATION, REGULARIZED_POSITION], 3) ** 2


@dataclass(frozen=True, eq=False)
class HandEyeProblem:
    """Residuals of n motions or poses as functions of stacked transforms, of which X is the first."""

    # From the transforms: residuals (n, 6), rotation [rad] before translation [m], and their derivatives by a step
    # (w, d) of every transform, (n, 6, 6 * transforms).
    residuals: Callable[[RigidTransform], tuple[Array, Array]]
    groups: tuple[int, ...]  # number of the group of each of the six residuals, from 0
    # From the transforms, the residuals' standard deviations (6,) and the number of motions or poses used: the diagonal
    # of the normal matrix of X that noise alone would show, (6,), see `spectrum`.
    noise: Callable[[RigidTransform, Array, int], Array]
    independent: int  # number of independent motions
    share: float = 1.0  # independent motions over all motions; the weight of each


@dataclass(frozen=True, eq=False)
class MotionFit:
    """Optimum of a hand-eye problem."""

    transforms: RigidTransform  # stacked transforms, X first
    residuals: Array  # residuals at the optimum, (n, 6) [rad and m]
    normal: Array  # normal matrix of X with the other transforms eliminated, in inverse variances, (6, 6)
    noise: Array  # diagonal of the part of it that noise alone would show, (6,)
    used: npt.NDArray[np.bool_]  # False for gross errors, (n,)
    covariance: Array  # covariance of X, (6, 6), with the prior of the free directions where X is regularized


def motion_problem(A: RigidTransform, B: RigidTransform, independent: int) -> HandEyeProblem:
    """Pose the problem A X = X B of stacked motions, with rotation and translation as one group each."""
    R_A, one = A.rotation.as_matrix(), np.eye(3)
    share = independent / len(A)

    def residuals(transforms: RigidTransform) -> tuple[Array, Array]:
        X = transforms[0]
        R = X.rotation
        turned = R.apply(B.translation)
        rotation = (A.rotation.inv() * R * B.rotation * R.inv()).as_rotvec()
        r = np.concatenate([rotation, A.apply(X.translation) - turned - X.translation], axis=1)
        J = np.zeros((len(r), 6, 6))
        J[:, :3, :3] = R_A.swapaxes(1, 2) - one  # A^-1 exp(w) = exp(A^-1 w) A^-1
        J[:, 3:, :3] = _cross(turned)
        J[:, 3:, 3:] = R_A - one
        return r, J

    def noise(transforms: RigidTransform, sigma: Array, count: int) -> Array:
        # An error e of R_A adds [e]x to all blocks, and one of t_B adds [R e]x to the lower left one. Weighted with the
        # inverse variances, each adds 2 to the diagonal.
        return count * np.repeat([4.0, 2.0 * (sigma[0] / sigma[3]) ** 2], 3)

    return HandEyeProblem(residuals, ROTATION_AND_TRANSLATION, noise, independent, share)


def pose_problem(
    T_base_hand: RigidTransform, T_camera_board: RigidTransform, owners: npt.NDArray[np.intp]
) -> HandEyeProblem:
    """Pose the problem T_camera_board = X^-1 T_base_hand^-1 Z, with Z = T_base_board of each placement.

    Residuals are in the camera's frame, turned so that z is the line of sight to the board. The poses are stacked; each
    belongs to the placement of index ``owners``, (n,).
    """
    look = _turn_to_z(T_camera_board.translation)
    hand_inv = T_base_hand.inv()
    n, boards = len(owners), int(owners.max()) + 1
    rows = np.arange(n)

    def residuals(transforms: RigidTransform) -> tuple[Array, Array]:
        X, Z = transforms[0], transforms[1 + owners]
        predicted = X.inv() * hand_inv * Z
        by_d = -(look * X.rotation.inv()).as_matrix()
        by_z = -by_d @ hand_inv.rotation.as_matrix()
        rotation = look.apply((predicted.rotation * T_camera_board.rotation.inv()).as_rotvec())
        r = np.concatenate([rotation, look.apply(predicted.translation - T_camera_board.translation)], axis=1)
        J = np.zeros((n, 6, 1 + boards, 6))
        J[:, :3, 0, :3] = by_d
        J[:, 3:, 0, :3] = -by_d @ _cross(X.rotation.apply(predicted.translation))
        J[:, 3:, 0, 3:] = by_d
        J[rows, :3, 1 + owners, :3] = by_z
        J[rows, 3:, 1 + owners, 3:] = by_z
        return r, J.reshape(n, 6, -1)

    def noise(transforms: RigidTransform, sigma: Array, count: int) -> Array:
        # An error e of the hand's rotation adds [e]x to the blocks of rotation by w and of translation by d, and
        # [e x q]x to the block of translation by w, with q the vector from hand to board. The residuals across the line
        # of sight, with |q| as a lever, bound e.
        q = transforms[1 + owners].translation - T_base_hand.translation
        lever = float(np.sqrt(np.mean(np.sum(q**2, axis=1))))
        rotation, translation = min(sigma[:3]), min(sigma[3:])
        e = min(rotation, sigma[3] / max(lever, SMALLEST_SIGMA))
        by_w = (e / rotation) ** 2 + (e * lever / translation) ** 2
        return 2.0 * count * np.repeat([by_w, (e / translation) ** 2], 3)

    return HandEyeProblem(residuals, (0, 0, 1, 2, 2, 3), noise, n - boards)


def _turn_to_z(directions: Array) -> Rotation:
    """Compute the smallest rotations that bring vectors (n, 3) onto +z or -z."""
    sign = np.where(directions[:, 2:] < 0, -1.0, 1.0)
    half = directions * sign / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), SMALLEST_SIGMA) + E3
    half /= np.linalg.norm(half, axis=1, keepdims=True)  # half a turn about it takes the direction to z
    return Rotation.from_rotvec(np.pi * E3) * Rotation.from_rotvec(np.pi * half)


def _cross(v: Array) -> Array:
    """Make the cross product matrices [v]x of vectors (n, 3): (n, 3, 3)."""
    x, y, z = v.T
    o = np.zeros_like(x)
    return np.stack([np.stack(row, axis=-1) for row in ([o, -z, y], [z, o, -x], [-y, x, o])], axis=-2)


def fit_motions(problem: HandEyeProblem, start: RigidTransform) -> MotionFit:
    """Find the most likely transforms without gross errors; undetermined directions keep the search's last value."""
    used = np.ones(len(problem.residuals(start)[0]), dtype=bool)
    state = start
    if problem.independent >= ENOUGH:
        state, sigma, _ = _descend(problem, start, used, robust=True)
        used = np.linalg.norm(problem.residuals(state)[0] / sigma, axis=1) <= GROSS_SIGMAS
    state, _, taken = _descend(problem, state, used)
    return _result(problem, state, taken, used)


def regularized(problem: HandEyeProblem, found: MotionFit) -> MotionFit:
    """Fit again, with the undetermined directions of X where its rotation and translation are smallest; see `PRIOR`."""
    free = int(np.sum(spectrum(found.normal, found.noise)[0] < 1))
    state, _, taken = _descend(problem, found.transforms, found.used, free=free)
    return _result(problem, state, taken, found.used, free)


def _stepped(transforms: RigidTransform, step: Array) -> RigidTransform:
    """Apply a step (6 * transforms,) to every transform: R <- exp(w) R, t <- t + d."""
    step = step.reshape(-1, 6)
    return RigidTransform.from_components(
        transforms.translation + step[:, 3:], Rotation.from_rotvec(step[:, :3]) * transforms.rotation
    )


def _descend(
    problem: HandEyeProblem, state: RigidTransform, used: npt.NDArray[np.bool_], *, robust: bool = False, free: int = 0
) -> tuple[RigidTransform, Array, Array]:
    """Iterate Gauss-Newton steps to the optimum.

    Returns the transforms, the standard deviations of the six residuals, and the degrees of freedom that the parameters
    take from each.
    """
    freedom = np.full(6, float(len(state)))  # taken from each of the six residuals
    for _ in range(ROUNDS):
        r, J = problem.residuals(state)
        sigma = _sigmas(problem, r[used], freedom / problem.share, robust=robust)
        weights = problem.share * used[:, None] / sigma**2
        if robust:
            length = np.linalg.norm(r / sigma, axis=1)
            weights = weights * (HUBER_SIGMAS / np.maximum(length, HUBER_SIGMAS))[:, None]
        WJ = weights[..., None] * J
        N, g = np.einsum("nij,nik->jk", WJ, J), np.einsum("nij,ni->j", WJ, r)
        Nx, gx, through = _eliminated(N, g)
        inverse, prior_step = _inverse(problem, state, Nx, sigma, int(used.sum()), free)
        x_step = prior_step - inverse @ gx
        step = np.concatenate([x_step, -through[:, :6] @ x_step - through[:, 6]])
        freedom = _taken(WJ, J, inverse, through[:, :6], N)
        turn = float(np.abs(step.reshape(-1, 6)[:, :3]).max())
        state = _stepped(state, step * min(1.0, LONGEST_TURN / max(turn, LONGEST_TURN)))
        if step @ N @ step < (ROUGHLY if robust else CONVERGED) ** 2 and (not free or np.abs(x_step).max() < CONVERGED):
            break
    return state, sigma, freedom / problem.share


def _eliminated(N: Array, g: Array) -> tuple[Array, Array, Array]:
    """Eliminate all transforms but X: its normal matrix (6, 6) and gradient (6,), and Nzz^-1 (Nzx, gz), (p - 6, 7)."""
    if len(N) == 6:
        return N, g, np.empty((0, 7))
    through = np.asarray(np.linalg.solve(N[6:, 6:], np.column_stack([N[6:, :6], g[6:]])), dtype=float)
    return N[:6, :6] - N[:6, 6:] @ through[:, :6], g[:6] - N[:6, 6:] @ through[:, 6], through


def _inverse(
    problem: HandEyeProblem, state: RigidTransform, Nx: Array, sigma: Array, count: int, free: int
) -> tuple[Array, Array]:
    """Invert the normal matrix of X in the known directions, and compute the prior's step (6,) in the free ones."""
    values, V = spectrum(Nx, problem.share * problem.noise(state, sigma, count))
    known = np.arange(6) >= free if free else values > HOPELESS
    inverse = (V[:, known] / np.maximum(values[known], HOPELESS)) @ V[:, known].T
    # The prior moves X along the free directions only, so that the motions alone determine the others.
    F, P, X = V[:, :free], np.diag(PRIOR), state[0]
    small = np.concatenate([X.rotation.as_rotvec(), X.translation])
    return inverse, -F @ np.linalg.solve(F.T @ P @ F, F.T @ P @ small)


def _taken(WJ: Array, J: Array, inverse: Array, through: Array, N: Array) -> Array:
    """Count the degrees of freedom that the parameters take from each of the six residuals: trace of the hat matrix."""
    reduced = J[..., :6] - J[..., 6:] @ through
    W_reduced = WJ[..., :6] - WJ[..., 6:] @ through
    taken = np.einsum("nij,jk,nik->i", W_reduced, inverse, reduced)
    if len(N) > 6:
        taken = taken + np.einsum("nij,jk,nik->i", WJ[..., 6:], np.linalg.inv(N[6:, 6:]), J[..., 6:])
    return taken


def _sigmas(problem: HandEyeProblem, r: Array, taken: Array, *, robust: bool, lost: float = 0.0) -> Array:
    """Estimate the standard deviation of each of the six residuals, the same within a group, (6,)."""
    in_nominal = r / NOMINAL
    left = 6 * len(r) - taken.sum() - lost
    if robust:
        every = MEDIAN_TO_SIGMA * float(np.median(np.abs(in_nominal))) * np.sqrt(r.size / max(left, 1.0))
    else:
        every = float(np.sqrt(np.sum(in_nominal**2) / left)) if left >= 1 else 1.0
    every = max(every, SMALLEST_SIGMA / NOMINAL_ROTATION)
    if problem.independent < FEW:
        return every * NOMINAL
    sigma = np.empty(6)
    groups = np.array(problem.groups if problem.independent >= ENOUGH else ROTATION_AND_TRANSLATION)
    for group in np.unique(groups):
        mine = groups == group
        left = max(len(r) * mine.sum() - taken[mine].sum() - lost, 1.0)
        if robust:
            value = MEDIAN_TO_SIGMA * float(np.median(np.abs(r[:, mine]))) * np.sqrt(r[:, mine].size / left)
        else:
            value = float(np.sqrt(np.sum(r[:, mine] ** 2) / left))
        sigma[mine] = np.maximum(value, SMALLEST_RATIO * every * NOMINAL[mine])
    return np.maximum(sigma, SMALLEST_SIGMA)


def _result(
    problem: HandEyeProblem, state: RigidTransform, taken: Array, used: npt.NDArray[np.bool_], free: int = 0
) -> MotionFit:
    r, J = problem.residuals(state)
    sigma = _sigmas(problem, r[used], taken, robust=False, lost=STUDENT)
    J = J[used] / sigma[:, None]
    Nx, _, _ = _eliminated(problem.share * np.einsum("nij,nik->jk", J, J), np.zeros(J.shape[2]))
    noise = problem.share * problem.noise(state, sigma, int(used.sum()))
    return MotionFit(state, r, Nx, noise, used, _covariance(Nx, noise, free))


def _covariance(Nx: Array, noise: Array, free: int) -> Array:
    """Invert the normal matrix of X, with the prior's information in the free directions in place of noise."""
    values, V = spectrum(Nx, noise)
    inner = np.diag(np.where(np.arange(6) < free, 0.0, np.maximum(values, 0.0)))  # V^T Nx V
    if free:
        inner += V.T @ np.diag(PRIOR) @ V
    scale = 1 / np.sqrt(np.maximum(np.diagonal(inner), np.finfo(float).tiny))
    V = V * scale
    covariance = V @ np.linalg.pinv(inner * np.outer(scale, scale), hermitian=True) @ V.T
    return (covariance + covariance.T) / 2


# The solvers

# A motion turns hand and camera by the same angle. Noise of 0.2 px in the corners of a board 3 m away changes it by 0.1
# to 0.3 degrees; a difference above this tolerance and share of the angle has another cause.
ANGLE_TOLERANCE = np.radians(2.0)
ANGLE_SHARE = 0.1
# Below this share of the largest singular value, noise alone may mirror the least determined direction.
WEAK_SHARE = 0.01
# For a start, a second axis counts from a hundredth of the first one's singular value (the share is squared).
START_SHARE = 1e-4
START_ROUNDS = 4
START_MEDIANS = 3.0  # one Gaussian motion in eighty is further off
UNTURNED = 1e-6  # [rad]; a smaller rotation is rounding
# In `_turned_by_shifts` the cosine and sine of a turn come out of linear equations, with length 1 where translations
# determine the turn, and 0 where they do not.
HALF = 0.5


@dataclass(frozen=True, eq=False)
class HandEye:
    """Result of a hand-eye calibration.

    Attributes:
        X: T_hand_camera.
        covariance: covariance of the error (w, d) of X, exp(w) R and t + d, (6, 6) [rad and m]; as in `Covariance`.
        rotation_rms: root mean square of the residual angle, per motion or per pose [rad].
        translation_rms: root mean square of the residual distance, per motion or per pose [m].
        verdict: what the motions determine.
        rejected: indices of the motions or poses that were left out as gross errors.
        boards: T_base_board of each placement, in the order of their numbers; empty for motions.
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
    """Make the motions of head and camera between all pairs of views of one placement (Eq. 3).

    Returns A, T_head_head' = T_base_head^-1 T_base_head', and B, T_zoom_zoom' = T_zoom_board T_zoom_board'^-1.
    """
    pairs = list(itertools.combinations(range(len(poses_base_head)), 2))
    return (
        [poses_base_head[i].inv() * poses_base_head[j] for i, j in pairs],
        [poses_zoom_board[i] * poses_zoom_board[j].inv() for i, j in pairs],
    )


def park_martin(head_motions: Sequence[RigidTransform], camera_motions: Sequence[RigidTransform]) -> RigidTransform:
    """Solve A_i T = T B_i for T, the paper's T_head_zoom, in closed form (Eqs. 3, 4).

    A head that counts pan or tilt the other way needs no treatment: it is the same head with its frame turned by half a
    turn. T absorbs that, and the calibration points equally well.

    Raises:
        CalibrationError: the motions are too few, all about one axis, or contradict each other.
    """
    alpha, beta = _rotvecs(head_motions), _rotvecs(camera_motions)
    _check_axes(alpha)
    _check_angles(alpha, beta)
    R = _park_martin_rotation(alpha, beta)
    _check_axes_agree(alpha, beta @ R.T)
    A, B = RigidTransform.concatenate(list(head_motions)), RigidTransform.concatenate(list(camera_motions))
    return RigidTransform.from_components(_translation(R, A, B), Rotation.from_matrix(R))


def solve_hand_eye_from_motions(
    A: Sequence[RigidTransform],
    B: Sequence[RigidTransform],
    *,
    independent: int | None = None,
    regularize: bool = False,
) -> HandEye:
    """Find the most likely X of A_i X = X B_i, with its covariance.

    Least squares, from Park and Martin's X, on the rotation of A_i^-1 X B_i X^-1 and on the difference of translation
    between A_i X and X B_i, each weighted by its standard deviation. From four independent motions on, these standard
    deviations are estimated separately. From seven on, gross errors are left out.

    The covariance assumes independent motions. Motions that share poses are not independent: all pairs of n poses hold
    the information of n - 1 motions, so pass ``independent=n - 1``. If the poses are known, `solve_hand_eye` is more
    accurate.

    Args:
        A: motions of the hand, T_hand_hand', two or more; see `motions`.
        B: motions of the camera, T_camera_camera', as many.
        independent: number of independent motions; None for all.
        regularize: True to get an X even where the motions leave some of it undetermined. Its rotation and translation
            are then the smallest that explain the motions, and its undetermined directions have standard deviations of
            `REGULARIZED_ROTATION` and `REGULARIZED_POSITION`.

    Raises:
        CalibrationError: the motions contradict each other, or leave X undetermined; the message says what to add.
    """
    if len(A) < 2 or len(A) != len(B):
        raise CalibrationError(f"hand-eye: {len(A)} and {len(B)} motions; it takes two or more, as many of each")
    a, b = _together(A), _together(B)
    problem = motion_problem(a, b, len(A) if independent is None else independent)
    X = RigidTransform.concatenate([_start(a, b)])
    return _solved(problem, X, a, None, regularize)


def solve_hand_eye(
    T_base_hand: Sequence[RigidTransform],
    T_camera_board: Sequence[RigidTransform],
    *,
    placements: Sequence[int] | None = None,
    middle: Sequence[float] | Array = (0.0, 0.0, 0.0),
    regularize: bool = False,
) -> HandEye:
    """Find the most likely X and board poses from T_base_hand X T_camera_board = T_base_board, with their covariance.

    Residuals are taken in the camera's frame, separately along the line of sight and across it, because a camera
    measures ten times better across than along. From eight poses of one placement on, four standard deviations are
    estimated: of rotation about the line of sight and about axes across it, and of shift along and across.

    The covariance is consistent while the camera's noise dominates. Noise of the hand's rotation moves board and view
    together, which the four groups do not model: where it dominates, 90 % ellipsoids hold X in some 70 % of cases.

    For a camera that stands still and a board in the hand, pass the inverse of T_base_hand; X is then T_base_camera.

    Args:
        T_base_hand: pose of the hand for each view, a list of three or more scipy RigidTransforms [m].
        T_camera_board: pose of the board in the camera's frame for each view (not its inverse).
        placements: number of the board's placement for each view; None for one placement.
        middle: middle of the board's points in its frame [m], (3,), which the camera measures best. It matters for a
            board whose origin is a corner.
        regularize: see `solve_hand_eye_from_motions`.

    Raises:
        CalibrationError: the poses contradict each other, or leave X undetermined; the message says what to add.
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
    result = _solved(pose_problem(hands, seen, owners), start, A, turns_base, regularize)
    return replace(result, boards=tuple(board * to_middle.inv() for board in result.boards))


def _together(transforms: Sequence[RigidTransform]) -> RigidTransform:
    """Stack transforms into one scipy RigidTransform, and refuse other items."""
    try:
        return RigidTransform.concatenate(list(transforms))
    except TypeError:
        raise CalibrationError(
            "hand-eye: poses and motions are scipy's RigidTransform; "
            "RigidTransform.from_matrix makes them of 4x4 matrices"
        ) from None


def _solved(
    problem: HandEyeProblem, start: RigidTransform, moved: RigidTransform, turns_base: Array | None, regularize: bool
) -> HandEye:
    """Fit a problem, judge what is determined, and refuse or regularize what is not."""
    found = fit_motions(problem, start)
    verdict = judge_motions(found.normal, found.noise, moved, turns_base)
    if not verdict.determined:
        if not regularize:
            raise CalibrationError(f"hand-eye: {verdict.text}")
        found = regularized(problem, found)
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
    """Find a first X in closed form, even where the motions leave some of it undetermined."""
    alpha, beta = A.rotation.as_rotvec(), B.rotation.as_rotvec()
    _check_angles(alpha, beta)
    good = _angles_off(alpha, beta) <= ANGLE_TOLERANCE
    A, B, alpha, beta = A[good], B[good], alpha[good], beta[good]
    if np.linalg.norm(alpha, axis=1).max() < UNTURNED:  # pure shifts, t_A = R t_B, or no motion at all
        R = _rotation_between(A.translation, B.translation)
    else:
        R = _rotation_between(alpha, beta)
        for _ in range(START_ROUNDS):  # without motions far off, so that gross errors do not bias R
            off = np.linalg.norm(alpha - beta @ R.T, axis=1)
            near = off <= START_MEDIANS * np.median(off) + UNTURNED
            R = _rotation_between(alpha[near], beta[near])
        _check_axes_agree(alpha, beta @ R.T)
        _, s, Vt = np.linalg.svd(alpha, full_matrices=False)
        if len(s) < 2 or s[1] ** 2 <= START_SHARE * s[0] ** 2:
            R = _turned_by_shifts(Vt[0], R, A, B)
    return RigidTransform.from_components(_translation(R, A, B), Rotation.from_matrix(R))


def _rotation_between(a: Array, b: Array) -> Array:
    """Find R with a_i = R b_i, (3, 3); the smallest R where the vectors have only one direction, or none."""
    U, s, Vt = np.linalg.svd(b.T @ a)
    if s[0] == 0:
        return np.eye(3)
    if s[1] <= START_SHARE * s[0]:
        return np.asarray(Rotation.align_vectors(Vt[:1], U[:, :1].T)[0].as_matrix())
    return _park_martin_rotation(a, b)


def _turned_by_shifts(axis: Array, R: Array, A: RigidTransform, B: RigidTransform) -> Array:
    """Find the turn of R about the only axis of all rotations from the translations; R itself where they leave it open.

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
    """Solve (R_A - I) t = R t_B - t_A over all motions; the shortest t where some of it is undetermined."""
    left = A.rotation.as_matrix() - np.eye(3)
    right = B.translation @ R.T - A.translation
    return np.asarray(np.linalg.lstsq(left.reshape(-1, 3), right.ravel(), rcond=None)[0], dtype=float)


def _rotvecs(motions: Sequence[RigidTransform]) -> Array:
    return np.array([motion.rotation.as_rotvec() for motion in motions]).reshape(-1, 3)


def _park_martin_rotation(alpha: Array, beta: Array) -> Array:
    """Find R with alpha_i = R beta_i by least squares, (3, 3) (Park and Martin 1994)."""
    # R = (M^T M)^(-1/2) M^T with M = sum_i beta_i alpha_i^T, which is V U^T for M = U S V^T.
    U, s, Vt = np.linalg.svd(beta.T @ alpha)
    R = Vt.T @ U.T
    if np.linalg.det(R) < 0:
        if s[2] > WEAK_SHARE * s[0]:
            raise CalibrationError(
                "hand-eye: the answer is a reflection (determinant -1): the head's angles and the camera's motions "
                "contradict each other; check that pan and tilt are not exchanged"
            )
        Vt[2] = -Vt[2]  # two axes determine a rotation; noise has mirrored the third direction
        R = Vt.T @ U.T
    return R


def _check_axes(alpha: Array) -> None:
    """Refuse motions about fewer than two axes, and name the missing one."""
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
    """Refuse motions whose angles differ: A_i and B_i are the same motion in two frames and turn by the same angle."""
    head, camera = np.linalg.norm(alpha, axis=1), np.linalg.norm(beta, axis=1)
    off = np.abs(head - camera)
    if np.median(_angles_off(alpha, beta)) > ANGLE_TOLERANCE:
        i = int(np.argsort(off)[len(off) // 2])
        raise CalibrationError(
            f"hand-eye: the head reports a turn of {np.degrees(head[i]):.1f} degrees where the zoom camera turned by "
            f"{np.degrees(camera[i]):.1f}; check the head's units, that the camera is fastened to it, and that "
            "the board is flat"
        )


def _angles_off(alpha: Array, beta: Array) -> Array:
    """Compute the difference of the angles of head and camera beyond the tolerated share [rad], (n,)."""
    head, camera = np.linalg.norm(alpha, axis=1), np.linalg.norm(beta, axis=1)
    return np.abs(head - camera) - ANGLE_SHARE * head


def _check_axes_agree(alpha: Array, beta_in_head: Array) -> None:
    """Refuse motions whose axes still differ once the camera's are turned into the head's frame."""
    off = np.linalg.norm(alpha - beta_in_head, axis=1)
    if np.median(off - ANGLE_SHARE * np.linalg.norm(alpha, axis=1)) > ANGLE_TOLERANCE:
        raise CalibrationError(
            f"hand-eye: no T explains the motions: {np.degrees(np.median(off)):.1f} degrees remain between the head's "
            "and the camera's; check that pan and tilt are not exchanged, and that the boards stood still"
        )
