"""The parameters that explain the corners best: one least-squares problem that serves every step.

The steps of a calibration differ in which blocks are free. The solver is Levenberg and Marquardt's and not scipy's
least_squares, because a view depends on its own board's pose and on no other: eliminating the poses first (Schur's
complement) makes a step of 150 views take a twentieth of a second, where a dense factorisation takes one or two, and
leaves the shared parameters' normal matrix.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cotarget.calibration.model import View
from cotarget.calibration.reprojection import POSE_PARAMETERS, Block, RigModel, predict, stepped
from cotarget.errors import CalibrationError
from cotarget.geometry import Array

# A point further off than this many standard deviations (from the median) counts linearly, not squared (Huber).
HUBER_SIGMAS = 3.0
MEDIAN_TO_SIGMA = 1 / 1.1774  # of the length of a 2D Gaussian vector: its median is sigma sqrt(2 ln 2)
SMALLEST_SIGMA_PX = 1e-4  # corners are rounded to this, so that exact data have no smaller scale
STEPS = 60
CONVERGED = 1e-10  # relative fall of the cost at which the solver stops
DAMPING = 1e-4  # first, relative to the diagonal of the normal equations
DAMPING_LIMIT = 1e10
SMALLEST_DAMPING = 1e-12


@dataclass(frozen=True, eq=False)
class Fit:
    """The outcome of a fit.

    Attributes:
        model: the best parameters.
        residuals: predicted minus observed, of each view's points (V, N, 2) [px].
        normal: normal matrix of the free blocks in the order of `BLOCK_WIDTHS`, the boards' poses eliminated; its
            inverse times the variance of a coordinate is the parameters' covariance.
    """

    model: RigModel
    residuals: Array
    normal: Array

    @property
    def rms_px(self) -> float:
        """Root mean square distance per point."""
        return rms(self.residuals)


def rms(residuals: Array) -> float:
    """OpenCV's rms: root of the mean squared distance per point of residuals (..., 2) [px]."""
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=-1)))) if residuals.size else 0.0


def fit(model: RigModel, views: Sequence[View], points: Array, free: Collection[Block]) -> Fit:
    """Find the most likely parameters; the boards' poses are always free.

    Args:
        model: where to start.
        views: with the corners of all points each.
        points: the board's corners in its frame [m], (N, 3).
        free: which blocks may change besides the boards' poses.

    Raises:
        CalibrationError: there is nothing to fit, or the corners cannot be explained at all.
    """
    if not views:
        raise CalibrationError("no views of the board to fit")
    model = replace(model, boards={number: model.boards[number] for number in sorted({v.board for v in views})})
    owners = [list(model.boards).index(view.board) for view in views]
    observed = np.stack([view.corners_px for view in views])

    def evaluate(at: RigModel) -> tuple[Array, Array, Array]:
        pixels, by_shared, by_board = predict(at, views, points, free)
        return pixels - observed, by_shared, by_board

    residuals, by_shared, by_board = evaluate(model)
    damping = DAMPING
    for _ in range(STEPS):
        scale = _robust_scale(residuals)
        equations = _normal_equations(residuals, by_shared, by_board, owners, _weights(residuals, scale))
        cost = _cost(residuals, scale)
        while damping < DAMPING_LIMIT:
            trial = stepped(model, *_solve(equations, damping), free)
            evaluation = evaluate(trial)
            trial_cost = _cost(evaluation[0], scale)
            if np.isfinite(trial_cost) and trial_cost <= cost:
                break
            damping *= 10
        else:
            break
        model, damping = trial, damping / 10
        residuals, by_shared, by_board = evaluation
        if cost - trial_cost <= CONVERGED * cost:
            break
    if not np.isfinite(residuals).all():
        raise CalibrationError("the corners cannot be explained by this rig: a board comes out behind a camera")
    equations = _normal_equations(residuals, by_shared, by_board, owners, np.ones(residuals.shape[:2]))
    return Fit(model, residuals, _reduced(equations, 0.0)[0])


def coordinate_variance(residuals: Array, parameters: int) -> float | None:
    """Estimate what variance of one coordinate, times the inverse normal matrix, gives the parameters' covariance.

    It is that of Huber's estimate (Huber 1981, Eq. 7.6.10): mean |psi|^2 / 2 over the squared mean slope of psi, where
    psi is a residual cut to the robust scale; for Gaussian noise 1 % more than the noise's own variance.

    Args:
        residuals: of the optimum (V, N, 2) [px].
        parameters: how many were fitted, the boards' poses included; they take up as many coordinates.

    Returns:
        [px^2]; None where there are not more coordinates than parameters.
    """
    freedom = residuals.size - parameters
    if freedom <= 0:
        return None
    scale = _robust_scale(residuals)
    weights = _weights(residuals, scale)
    psi2 = np.sum((weights[..., None] * residuals) ** 2, axis=-1)
    slope = np.where(weights < 1, weights / 2, 1.0)  # beyond the scale psi only turns: one direction of the two
    return float(np.mean(psi2) / 2 / np.mean(slope) ** 2 * residuals.size / freedom)


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations in blocks: shared (n, n), shared by board (B, n, 6), board (B, 6, 6), and gradients."""

    shared: Array
    mixed: Array
    boards: Array
    shared_gradient: Array
    board_gradient: Array


def _normal_equations(
    residuals: Array, by_shared: Array, by_board: Array, owners: Sequence[int], weights: Array
) -> _Equations:
    V = len(residuals)
    w = np.repeat(weights.reshape(V, -1), 2, axis=1)
    r = residuals.reshape(V, -1) * w
    S, B = by_shared.reshape(V, w.shape[1], -1), by_board.reshape(V, w.shape[1], -1)
    SwT = (S * w[..., None]).swapaxes(1, 2)
    BwT = (B * w[..., None]).swapaxes(1, 2)
    count, n = max(owners) + 1, S.shape[2]
    mixed = np.zeros((count, n, POSE_PARAMETERS))
    boards = np.zeros((count, POSE_PARAMETERS, POSE_PARAMETERS))
    board_gradient = np.zeros((count, POSE_PARAMETERS))
    np.add.at(mixed, owners, SwT @ B)
    np.add.at(boards, owners, BwT @ B)
    np.add.at(board_gradient, owners, (B.swapaxes(1, 2) @ r[..., None])[..., 0])
    return _Equations((SwT @ S).sum(0), mixed, boards, np.einsum("vij,vi->j", S, r), board_gradient)


def _reduced(equations: _Equations, damping: float) -> tuple[Array, Array, Array]:
    """Eliminate the boards: reduced matrix (n, n) and gradient (n,), and the boards' inverses (B, 6, 6)."""
    e = equations
    inverse = np.asarray(np.linalg.inv(e.boards + _damped(e.boards, damping)), dtype=float)
    through = e.mixed @ inverse
    matrix = e.shared + _damped(e.shared, damping) - (through @ e.mixed.swapaxes(1, 2)).sum(0)
    return matrix, e.shared_gradient - np.einsum("bij,bj->i", through, e.board_gradient), inverse


def _solve(equations: _Equations, damping: float) -> tuple[Array, Array]:
    """A damped step of the shared parameters (n,) and of the boards (B, 6)."""
    matrix, gradient, inverse = _reduced(equations, damping)
    shared = np.asarray(np.linalg.solve(matrix, -gradient), dtype=float)
    right = equations.board_gradient + np.einsum("bij,i->bj", equations.mixed, shared)
    return shared, -np.einsum("bij,bj->bi", inverse, right)


def _damped(blocks: Array, damping: float) -> Array:
    """The diagonal to add to one or many square blocks; never quite zero, so that a free direction stands still."""
    diagonal = np.diagonal(blocks, axis1=-2, axis2=-1)
    return np.eye(blocks.shape[-1]) * (diagonal * damping + SMALLEST_DAMPING)[..., None]


def _robust_scale(residuals: Array) -> float:
    lengths = np.linalg.norm(residuals, axis=-1)
    return HUBER_SIGMAS * max(float(np.median(lengths)) * MEDIAN_TO_SIGMA, SMALLEST_SIGMA_PX)


def _weights(residuals: Array, scale: float) -> Array:
    """Huber's weight of every point."""
    return scale / np.maximum(np.linalg.norm(residuals, axis=-1), scale)


def _cost(residuals: Array, scale: float) -> float:
    """Huber's cost."""
    lengths = np.linalg.norm(residuals, axis=-1)
    return float(np.sum(np.where(lengths <= scale, lengths**2, scale * (2 * lengths - scale))))
