"""Transforms that explain measured poses or motions best: weighted least squares on SE(3), the weights found as well.

The six residuals of a pose or motion fall into groups (rotation and translation, or finer) that each have a standard
deviation of their own. It is estimated from the residuals, every group's degrees of freedom less those that the
parameters take up (the restricted maximum likelihood of a variance-component model; Helmert 1907). First with Huber's
weights and medians, by which gross errors are found; then without these, by least squares.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cotarget.calibration.observability import spectrum
from cotarget.geometry import Array, RigidTransform, Rotation

# Standard deviations before there are enough residuals to estimate them: what they are to each other counts.
NOMINAL_ROTATION = 1e-3  # [rad]
NOMINAL_POSITION = 1e-3  # [m]
NOMINAL = np.repeat([NOMINAL_ROTATION, NOMINAL_POSITION], 3)
ENOUGH = 7  # so many independent motions tell the groups' standard deviations apart, and gross errors from others
FEW = 4  # so many tell rotation's from translation's
SMALLEST_SIGMA = 1e-9  # [rad] and [m]; exact data are rounded to less
SMALLEST_RATIO = 1e-3  # of a group's standard deviation to all groups', so that none can take all the weight
MEDIAN_TO_SIGMA = 1.4826  # of the absolute value of a Gaussian variable
HUBER_SIGMAS = 4.0  # of the length of six residuals; 1 % of Gaussian ones are longer
# Beyond so many it is a gross error. Medians of a few poses may be half the true deviation, and Gaussian lengths of six
# exceed 4.5 once in a thousand times.
GROSS_SIGMAS = 9.0
ROUNDS = 200
CONVERGED = 1e-5  # length of the last step, in standard deviations
ROUGHLY = 0.03  # likewise, while looking for gross errors
LONGEST_TURN = 0.5  # of one step [rad]: linearising holds no further
# Directions so much worse known than is of use (see `spectrum`) are left alone while looking for the optimum.
HOPELESS = 0.03
ROTATION_AND_TRANSLATION = (0, 0, 0, 1, 1, 1)
E3 = np.array([0.0, 0.0, 1.0])
# With k degrees of freedom left, a variance that was itself estimated widens the parameters' distribution to Student's,
# whose variance is larger by k / (k - 2).
STUDENT = 2.0
# Without knowledge of a direction, `insist` takes it as zero give or take this.
INSISTED_ROTATION = 1.0  # [rad]
INSISTED_POSITION = 1.0  # [m]
PRIOR = 1 / np.repeat([INSISTED_ROTATION, INSISTED_POSITION], 3) ** 2


@dataclass(frozen=True, eq=False)
class Problem:
    """Residuals of n motions or poses as functions of stacked transforms, X being the first.

    Attributes:
        residuals: gives residuals (n, 6), rotation [rad] before translation [m], and derivatives by a step (w, d) of
            every transform, (n, 6, 6 * transforms).
        groups: for each of the six residuals the number of its group, from 0.
        noise: from the transforms, the six residuals' standard deviations and how many motions or poses are used,
            what N of X noise alone would show; see `spectrum`.
        independent: how many independent motions there are.
        share: of the motions (poses) that are, where they are not independent; information counts that much.
    """

    residuals: Callable[[RigidTransform], tuple[Array, Array]]
    groups: tuple[int, ...]
    noise: Callable[[RigidTransform, Array, int], Array]
    independent: int
    share: float = 1.0


@dataclass(frozen=True, eq=False)
class MotionFit:
    """The optimum.

    Attributes:
        transforms: stacked, X first.
        residuals: (n, 6).
        normal: of X, the other transforms eliminated, in inverse variances; (6, 6).
        noise: what of it noise alone would show, its diagonal, (6,).
        used: which motions or poses are no gross errors, (n,).
        covariance: of X, (6, 6); with insisted directions in it, where there are.
    """

    transforms: RigidTransform
    residuals: Array
    normal: Array
    noise: Array
    used: npt.NDArray[np.bool_]
    covariance: Array


def motion_problem(A: RigidTransform, B: RigidTransform, independent: int) -> Problem:
    """A X = X B: rotation and translation are a group each.

    Args:
        A: motions of the hand, stacked.
        B: motions of the camera, stacked.
        independent: how many of them are.
    """
    R_A, one = A.rotation.as_matrix(), np.eye(3)
    share = independent / len(A)

    def residuals(transforms: RigidTransform) -> tuple[Array, Array]:
        X = transforms[0]
        R = X.rotation
        turned = R.apply(B.translation)
        r = np.concatenate(
            [
                (A.rotation.inv() * R * B.rotation * R.inv()).as_rotvec(),
                A.apply(X.translation) - turned - X.translation,
            ],
            axis=1,
        )
        J = np.zeros((len(r), 6, 6))
        J[:, :3, :3] = R_A.swapaxes(1, 2) - one  # A^-1 exp(w) = exp(A^-1 w) A^-1
        J[:, 3:, :3] = _cross(turned)
        J[:, 3:, 3:] = R_A - one
        return r, J

    def noise(transforms: RigidTransform, sigma: Array, count: int) -> Array:
        # An error e of R_A adds [e]x to all blocks, one of t_B adds [R e]x below; both are weighted with their inverse
        # variances, so that each gives 2.
        return count * np.repeat([4.0, 2.0 * (sigma[0] / sigma[3]) ** 2], 3)

    return Problem(residuals, ROTATION_AND_TRANSLATION, noise, independent, share)


def pose_problem(T_base_hand: RigidTransform, T_camera_board: RigidTransform, owners: npt.NDArray[np.intp]) -> Problem:
    """T_camera_board = X^-1 T_base_hand^-1 Z, in the camera's frame turned so that z is the line of sight.

    Args:
        T_base_hand: stacked.
        T_camera_board: stacked.
        owners: which of the boards' places Z is meant, (n,), from 0.
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
        r = np.concatenate(
            [
                look.apply((predicted.rotation * T_camera_board.rotation.inv()).as_rotvec()),
                look.apply(predicted.translation - T_camera_board.translation),
            ],
            axis=1,
        )
        J = np.zeros((n, 6, 1 + boards, 6))
        J[:, :3, 0, :3] = by_d
        J[:, 3:, 0, :3] = -by_d @ _cross(X.rotation.apply(predicted.translation))
        J[:, 3:, 0, 3:] = by_d
        J[rows, :3, 1 + owners, :3] = by_z
        J[rows, 3:, 1 + owners, 3:] = by_z
        return r, J.reshape(n, 6, -1)

    def noise(transforms: RigidTransform, sigma: Array, count: int) -> Array:
        # An error e of the hand's rotation adds [e]x to the blocks of rotation by w and of translation by d, and
        # [e x q]x to that of translation by w, q being the board in the hand's axes. It is no larger than residuals
        # across the line of sight show it, with |q| as a lever.
        q = transforms[1 + owners].translation - T_base_hand.translation
        lever = float(np.sqrt(np.mean(np.sum(q**2, axis=1))))
        rotation, translation = min(sigma[:3]), min(sigma[3:])
        e = min(rotation, sigma[3] / max(lever, SMALLEST_SIGMA))
        by_w = (e / rotation) ** 2 + (e * lever / translation) ** 2
        return 2.0 * count * np.repeat([by_w, (e / translation) ** 2], 3)

    return Problem(residuals, (0, 0, 1, 2, 2, 3), noise, n - boards)


def _turn_to_z(directions: Array) -> Rotation:
    """The smallest rotations that lay vectors (n, 3) along z, either way round."""
    sign = np.where(directions[:, 2:] < 0, -1.0, 1.0)
    half = directions * sign / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), SMALLEST_SIGMA) + E3
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    return Rotation.from_rotvec(np.pi * E3) * Rotation.from_rotvec(
        np.pi * half
    )  # half a turn about half takes one to z


def _cross(v: Array) -> Array:
    """[v]x for vectors (n, 3): (n, 3, 3)."""
    x, y, z = v.T
    o = np.zeros_like(x)
    return np.stack([np.stack(row, axis=-1) for row in ([o, -z, y], [z, o, -x], [-y, x, o])], axis=-2)


def fit_motions(problem: Problem, start: RigidTransform) -> MotionFit:
    """Find the most likely transforms, gross errors left out; free directions stay where the search left them."""
    used = np.ones(len(problem.residuals(start)[0]), dtype=bool)
    state = start
    if problem.independent >= ENOUGH:
        state, sigma, _ = _descend(problem, start, used, robust=True)
        used = np.linalg.norm(problem.residuals(state)[0] / sigma, axis=1) <= GROSS_SIGMAS
    state, _, taken = _descend(problem, state, used)
    return _result(problem, state, taken, used)


def insist_on(problem: Problem, found: MotionFit) -> MotionFit:
    """Put the free directions of X where its rotation and translation are smallest; see `PRIOR`."""
    free = int(np.sum(spectrum(found.normal, found.noise)[0] < 1))
    state, _, taken = _descend(problem, found.transforms, found.used, free=free)
    return _result(problem, state, taken, found.used, free)


def stepped(transforms: RigidTransform, step: Array) -> RigidTransform:
    """R <- exp(w) R, t <- t + d for every transform; step (6 * transforms,)."""
    step = step.reshape(-1, 6)
    return RigidTransform.from_components(
        transforms.translation + step[:, 3:], Rotation.from_rotvec(step[:, :3]) * transforms.rotation
    )


def _descend(
    problem: Problem, state: RigidTransform, used: npt.NDArray[np.bool_], *, robust: bool = False, free: int = 0
) -> tuple[RigidTransform, Array, Array]:
    """Iterate Gauss and Newton's step; also gives the six residuals' standard deviations and their lost freedom."""
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
        state = stepped(state, step * min(1.0, LONGEST_TURN / max(turn, LONGEST_TURN)))
        if step @ N @ step < (ROUGHLY if robust else CONVERGED) ** 2 and (not free or np.abs(x_step).max() < CONVERGED):
            break
    return state, sigma, freedom / problem.share


def _eliminated(N: Array, g: Array) -> tuple[Array, Array, Array]:
    """Eliminate all transforms but X: its normal matrix and gradient; and Nzz^-1 (Nzx, gz), (p - 6, 7)."""
    if len(N) == 6:
        return N, g, np.empty((0, 7))
    through = np.asarray(np.linalg.solve(N[6:, 6:], np.column_stack([N[6:, :6], g[6:]])), dtype=float)
    return N[:6, :6] - N[:6, 6:] @ through[:, :6], g[:6] - N[:6, 6:] @ through[:, 6], through


def _inverse(
    problem: Problem, state: RigidTransform, Nx: Array, sigma: Array, count: int, free: int
) -> tuple[Array, Array]:
    """The covariance of X, and the step towards the smallest X that the prior asks for."""
    values, V = spectrum(Nx, problem.share * problem.noise(state, sigma, count))
    known = np.arange(6) >= free if free else values > HOPELESS
    inverse = (V[:, known] / np.maximum(values[known], HOPELESS)) @ V[:, known].T
    # Only along the free directions is X drawn, so that the others keep what the motions say.
    F, P, X = V[:, :free], np.diag(PRIOR), state[0]
    small = np.concatenate([X.rotation.as_rotvec(), X.translation])
    return inverse, -F @ np.linalg.solve(F.T @ P @ F, F.T @ P @ small)


def _taken(WJ: Array, J: Array, inverse: Array, through: Array, N: Array) -> Array:
    """How many degrees of freedom the parameters take from each of the six residuals: the hat matrix's trace, (6,)."""
    reduced = J[..., :6] - J[..., 6:] @ through
    W_reduced = WJ[..., :6] - WJ[..., 6:] @ through
    taken = np.einsum("nij,jk,nik->i", W_reduced, inverse, reduced)
    if len(N) > 6:
        taken = taken + np.einsum("nij,jk,nik->i", WJ[..., 6:], np.linalg.inv(N[6:, 6:]), J[..., 6:])
    return taken


def _sigmas(problem: Problem, r: Array, taken: Array, *, robust: bool, lost: float = 0.0) -> Array:
    """Standard deviation of each of the six residuals, one for each group; see the module's text."""
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
    problem: Problem, state: RigidTransform, taken: Array, used: npt.NDArray[np.bool_], free: int = 0
) -> MotionFit:
    r, J = problem.residuals(state)
    sigma = _sigmas(problem, r[used], taken, robust=False, lost=STUDENT)
    J = J[used] / sigma[:, None]
    Nx, _, _ = _eliminated(problem.share * np.einsum("nij,nik->jk", J, J), np.zeros(J.shape[2]))
    noise = problem.share * problem.noise(state, sigma, int(used.sum()))
    return MotionFit(state, r, Nx, noise, used, _covariance(Nx, noise, free))


def _covariance(Nx: Array, noise: Array, free: int) -> Array:
    """Invert X's normal matrix, the prior's information in place of that of the free directions, which is noise."""
    values, V = spectrum(Nx, noise)
    inner = np.diag(np.where(np.arange(6) < free, 0.0, np.maximum(values, 0.0)))  # V^T Nx V
    if free:
        inner += V.T @ np.diag(PRIOR) @ V
    scale = 1 / np.sqrt(np.maximum(np.diagonal(inner), np.finfo(float).tiny))
    V = V * scale
    covariance = V @ np.linalg.pinv(inner * np.outer(scale, scale), hermitian=True) @ V.T
    return (covariance + covariance.T) / 2
