"""The parameters that explain the corners best: one least-squares problem that serves every step.

The steps of a calibration differ in which blocks are free. The solver is Levenberg and Marquardt's and not scipy's
least_squares, because a view depends on its own board's pose and on no other: eliminating the poses first (Schur's
complement) makes a step of 150 views take a twentieth of a second, where a dense factorisation takes one or two, and
leaves the shared parameters' normal matrix.

Where a head does not stand quite where it says, all corners of a view are off together. Such a jitter is two more
unknowns a view, its true pan and tilt, which are eliminated likewise, held near the reported ones by their own
standard deviation; `estimate_jitter` finds how large that is from the corners themselves.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar

from cotarget.calibration.model import View
from cotarget.calibration.reprojection import (
    POSE_PARAMETERS,
    Batch,
    Block,
    Prediction,
    RigModel,
    batches_of,
    difference,
    parameter_names,
    predict,
    stepped,
)
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
RELATIVE_ROUNDING = 1e-10  # of a normal matrix whose boards were eliminated by subtraction
# Jitter is looked for between these [rad], and believed when its likelihood is this many times that of none:
# exp(2.71 / 2), which chance exceeds once in twenty times (a half chi-square at its border).
JITTER_RANGE = (1e-7, 0.1)
JITTER_EVIDENCE = 2.71
JITTER_ROUNDS = 3
TURN_ROUNDS = 6
TURNS = 2  # pan and tilt


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known before the corners speak: parameters near a reference's, with standard deviations by name."""

    reference: RigModel
    sigmas: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Fit:
    """The outcome of a fit.

    Attributes:
        model: the best parameters.
        free: the blocks that were free.
        residuals: predicted minus observed, of each view's points (V, N, 2) [px]; nan where a corner is not seen.
        left: the same when every view's pan and tilt has given way to the jitter assumed.
        normal: normal matrix of the free blocks, the boards' poses and any jitter eliminated; its inverse times the
            variance of a coordinate is the parameters' covariance.
        variance: of a coordinate [px^2]; None where there are not more coordinates than parameters.
        jitter: the standard deviation of the head's angles that was assumed [rad].
        views: what was fitted.
    """

    model: RigModel
    free: tuple[Block, ...]
    residuals: Array
    left: Array
    normal: Array
    variance: float | None
    jitter: float
    views: tuple[View, ...]

    @property
    def rms_px(self) -> float:
        """Root mean square distance per point."""
        return rms(self.residuals)


def rms(residuals: Array) -> float:
    """OpenCV's rms: root of the mean squared distance per point of residuals (..., 2) [px]; nan points do not count."""
    squared = np.sum(residuals**2, axis=-1)
    seen = np.isfinite(squared)
    return float(np.sqrt(squared[seen].mean())) if seen.any() else 0.0


def fit(
    model: RigModel,
    views: Sequence[View],
    points: Array,
    free: Collection[Block],
    *,
    prior: Prior | None = None,
    jitter: float = 0.0,
) -> Fit:
    """Find the most likely parameters; the boards' poses are always free.

    Args:
        model: where to start.
        views: with the corners of all points each, nan where not seen.
        points: the board's corners in its frame [m], (N, 3).
        free: which blocks may change besides the boards' poses.
        prior: what is known of the parameters before.
        jitter: standard deviation of the head's true angles about the reported ones, of every view anew [rad].

    Raises:
        CalibrationError: there is nothing to fit, or the corners cannot be explained at all.
    """
    if not views:
        raise CalibrationError("no views of the board to fit")
    model = replace(model, boards={number: model.boards[number] for number in sorted({v.board for v in views})})
    problem = _Problem(batches_of(model, views), points, tuple(free), prior, jitter)
    here = problem.at(model)
    damping = DAMPING
    for _ in range(STEPS):
        scale = _robust_scale(here)
        equations = problem.equations(here, scale)
        cost = problem.cost(here, scale)
        while damping < DAMPING_LIMIT:
            trial = problem.at(stepped(here.model, *_solve(equations, damping), free))
            trial_cost = problem.cost(trial, scale)
            if np.isfinite(trial_cost) and trial_cost <= cost:
                break
            damping *= 10
        else:
            break
        here, damping = trial, damping / 10
        if cost - trial_cost <= CONVERGED * cost:
            break
    if not here.finite:
        raise CalibrationError("the corners cannot be explained by this rig: a board comes out behind a camera")
    residuals, left = (np.full((len(views), len(points), 2), np.nan) for _ in range(2))
    for batch, r, after in zip(problem.batches, here.residuals, here.after, strict=True):
        residuals[batch.rows] = np.where(batch.seen[..., None], r, np.nan)
        left[batch.rows] = np.where(batch.seen[..., None], after, np.nan)
    variance = problem.variance(here)
    normal = _reduced(problem.equations(here, None), 0.0)[0]
    return Fit(here.model, problem.free, residuals, left, normal, variance, jitter, tuple(views))


def information(model: RigModel, views: Sequence[View], points: Array, free: Collection[Block]) -> Array:
    """What views would tell of the free parameters, whatever their corners: the normal matrix without the boards.

    Args:
        model: with the boards of the views.
        views: planned or taken; only which corners are seen matters.
        points: the board's corners in its frame [m], (N, 3).
        free: the blocks.

    Returns:
        (n, n), in the order of `parameter_names` [1/px^2].
    """
    model = replace(model, boards={number: model.boards[number] for number in sorted({v.board for v in views})})
    problem = _Problem(batches_of(model, views), points, tuple(free), None, 0.0)
    return _reduced(problem.equations(problem.at(model), None), 0.0)[0]


def estimate_jitter(found: Fit, points: Array, prior: Prior | None = None) -> float:
    """Estimate how far the head's angles scatter about the reported ones, by restricted maximum likelihood.

    With the corners' own variance profiled out, the likelihood of a jitter needs only the normal equations of the fit
    without one (Patterson and Thompson 1971; Harville 1977).

    Args:
        found: a fit without jitter.
        points: the board's corners in its frame [m], (N, 3).
        prior: that of the fit.

    Returns:
        Standard deviation of each axis [rad]; 0 where the corners do not speak for any.
    """
    jitter = 0.0
    for _ in range(JITTER_ROUNDS):  # the first weights take what is jitter for wrong corners
        jitter = _one_estimate(found, points, prior, jitter)
    return jitter


def head_turns(found: Fit, points: Array) -> Array:
    """By how much every zoom view's own pan and tilt would have to differ for its corners to fit best, (V, 2) [rad].

    nan for the fixed camera's views; the boards and everything else stay where the fit has put them.
    """
    problem = _Problem(batches_of(found.model, found.views), points, (), None, 0.0)
    here = problem.at(found.model)
    turns = np.full((len(found.views), TURNS), np.nan)
    for batch, p, r in zip(problem.batches, here.predictions, here.residuals, strict=True):
        if p.by_turn is None:
            continue
        Q, after = _masked(p.by_turn, batch), r
        for _ in range(TURN_ROUNDS):  # wrong corners are not to turn a view
            weighted = Q * _weights(after, _robust_scale(here))[..., None, None]
            own = np.einsum("vnik,vnil->vkl", weighted, Q)
            turn = -np.linalg.solve(
                own + _damped(own, RELATIVE_ROUNDING), np.einsum("vnik,vni->vk", weighted, r)[..., None]
            )[..., 0]
            after = r + np.einsum("vnik,vk->vni", Q, turn)
        turns[batch.rows] = turn
    return turns


def _one_estimate(found: Fit, points: Array, prior: Prior | None, before: float) -> float:
    """One round of `estimate_jitter`, with corners weighted as a jitter estimated before leaves them."""
    problem = _Problem(batches_of(found.model, found.views), points, found.free, prior, before)
    here = problem.at(found.model)
    grams = problem.grams(here, _robust_scale(here))
    if found.variance is None or not any(batch.stop is not None for batch in problem.batches):
        return 0.0
    coordinates = 2 * sum(int(batch.seen.sum()) for batch in problem.batches)
    freedom = coordinates - len(found.normal) - POSE_PARAMETERS * len(found.model.boards)

    def profiled(ratio: float) -> tuple[float, Array, Array]:
        """Squares left, and the reduced matrix and the boards' inverses, at jitter^2 = ratio * variance."""
        equations = problem.assembled(here, grams, 1 / ratio if ratio else np.inf)
        matrix, gradient, inverse = _reduced(equations, 0.0)
        matrix = matrix + _damped(matrix, RELATIVE_ROUNDING)  # where a direction is open, it stands still
        left = equations.squares - gradient @ np.linalg.solve(matrix, gradient)
        left -= np.einsum("bi,bij,bj->", equations.board_gradient, inverse, equations.board_gradient)
        return max(float(left), SMALLEST_SIGMA_PX**2), matrix, inverse

    def minus_twice_log_likelihood(ratio: float) -> float:
        left, matrix, inverse = profiled(ratio)
        spread = float(np.linalg.slogdet(matrix)[1] - np.linalg.slogdet(inverse)[1].sum())
        turns = slice(-1 - TURNS, -1)
        for batch, (_, gram) in zip(problem.batches, grams, strict=True):
            if batch.stop is not None:
                spread += float(np.linalg.slogdet(np.eye(TURNS) + ratio * gram[:, turns, turns])[1].sum())
        return float(freedom * np.log(left) + spread)

    lowest, highest = (float(2 * np.log(sigma) - np.log(found.variance)) for sigma in JITTER_RANGE)
    best = minimize_scalar(lambda x: minus_twice_log_likelihood(np.exp(x)), bounds=(lowest, highest), method="bounded")
    if minus_twice_log_likelihood(0.0) - best.fun < JITTER_EVIDENCE:
        return 0.0
    return float(np.sqrt(np.exp(best.x) * profiled(np.exp(best.x))[0] / freedom))


def coordinate_variance(residuals: Array, parameters: float) -> float | None:
    """Estimate what variance of one coordinate, times the inverse normal matrix, gives the parameters' covariance.

    It is that of Huber's estimate (Huber 1981, Eq. 7.6.10): mean |psi|^2 / 2 over the squared mean slope of psi, where
    psi is a residual cut to the robust scale; for Gaussian noise 1 % more than the noise's own variance.

    Args:
        residuals: of the optimum, (n, 2) [px].
        parameters: how many were fitted, the boards' poses included; they take up as many coordinates.

    Returns:
        [px^2]; None where there are not more coordinates than parameters.
    """
    freedom = residuals.size - parameters
    if freedom <= 0:
        return None
    scale = HUBER_SIGMAS * robust_sigma(residuals)
    weights = _weights(residuals, scale)
    psi2 = np.sum((weights[..., None] * residuals) ** 2, axis=-1)
    slope = np.where(weights < 1, weights / 2, 1.0)  # beyond the scale psi only turns: one direction of the two
    return float(np.mean(psi2) / 2 / np.mean(slope) ** 2 * residuals.size / freedom)


def robust_sigma(residuals: Array) -> float:
    """Standard deviation of a coordinate of residuals (n, 2), told by the median length [px]."""
    return max(float(np.median(np.linalg.norm(residuals, axis=-1))) * MEDIAN_TO_SIGMA, SMALLEST_SIGMA_PX)


# Which parameters a batch speaks of (k,), and J^T W J for each of its views (v, m, m).
Gram = tuple[npt.NDArray[np.intp], Array]


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations in blocks: shared (n, n), shared by board (B, n, 6), board (B, 6, 6), gradients, squares."""

    shared: Array
    mixed: Array
    boards: Array
    shared_gradient: Array
    board_gradient: Array
    squares: float


@dataclass(frozen=True, eq=False)
class _Evaluation:
    """A model's residuals, batch by batch, and those left when every view's pan and tilt gave way (v, N, 2)."""

    model: RigModel
    predictions: list[Prediction]
    residuals: list[Array]
    after: list[Array]
    given: float  # sum of the squares of how far pan and tilt gave way [rad^2]
    finite: bool
    sigma: float


@dataclass(frozen=True, eq=False)
class _Problem:
    """What does not change during a fit."""

    batches: list[Batch]
    points: Array
    free: tuple[Block, ...]
    prior: Prior | None
    jitter: float

    def at(self, model: RigModel) -> _Evaluation:
        predictions = [predict(model, batch, self.points, self.free) for batch in self.batches]
        residuals = [
            np.where(batch.seen[..., None], p.pixels - batch.observed, 0.0)
            for batch, p in zip(self.batches, predictions, strict=True)
        ]
        finite = all(np.isfinite(r).all() for r in residuals)
        sigma = robust_sigma(self._seen(residuals)) if finite else np.nan
        after, given = residuals, 0.0
        if self.jitter and finite:
            penalty = (sigma / self.jitter) ** 2
            after = []
            for batch, p, r in zip(self.batches, predictions, residuals, strict=True):
                if p.by_turn is None:
                    after.append(r)
                    continue
                Q = _masked(p.by_turn, batch).reshape(len(r), -1, TURNS)
                QT = Q.swapaxes(1, 2)
                turned = -np.linalg.solve(QT @ Q + penalty * np.eye(TURNS), QT @ r.reshape(len(r), -1, 1))
                after.append(r + (Q @ turned).reshape(r.shape))
                given += float(np.sum(turned**2))
            sigma = robust_sigma(self._seen(after))
        return _Evaluation(model, predictions, residuals, after, given, finite, sigma)

    def cost(self, here: _Evaluation, scale: float) -> float:
        """Huber's cost, of the residuals and of what is known before."""
        if not here.finite:
            return np.inf
        cost = sum(_cost(r, scale) for r in here.after)
        variance = (scale / HUBER_SIGMAS) ** 2
        if self.jitter:
            cost += variance / self.jitter**2 * here.given
        if self.prior is not None:
            off, information = self._known(here.model, variance)
            cost += float(off @ (information * off))
        return cost

    def variance(self, here: _Evaluation) -> float | None:
        """See `Fit.variance`."""
        n = len(parameter_names(self.free, here.model.stops))
        parameters = float(n + POSE_PARAMETERS * len(here.model.boards))
        if self.jitter:
            penalty = (here.sigma / self.jitter) ** 2
            for batch, p in zip(self.batches, here.predictions, strict=True):
                if p.by_turn is not None:
                    Q = _masked(p.by_turn, batch).reshape(len(batch.rows), -1, TURNS)
                    QTQ = Q.swapaxes(1, 2) @ Q
                    parameters += float(
                        np.trace(np.linalg.solve(QTQ + penalty * np.eye(TURNS), QTQ), axis1=1, axis2=2).sum()
                    )
        return coordinate_variance(self._seen(here.after), parameters)

    def equations(self, here: _Evaluation, scale: float | None) -> _Equations:
        """Normal equations with Huber's weights; without a scale, of plain squares."""
        sigma = here.sigma
        return self.assembled(
            here, self.grams(here, scale), (sigma / self.jitter) ** 2 if self.jitter else np.inf, sigma**2
        )

    def grams(self, here: _Evaluation, scale: float | None) -> list[Gram]:
        """Every batch's columns, and J^T W J of J = (shared, board, turn, residual) for each of its views."""
        found = []
        for batch, p, r, after in zip(self.batches, here.predictions, here.residuals, here.after, strict=True):
            turn = [p.by_turn] if p.by_turn is not None else []
            J = np.concatenate([p.by_shared, p.by_board, *turn, r[..., None]], axis=-1)
            J = _masked(J, batch)
            if scale is not None:
                J = J * np.sqrt(_weights(after, scale))[..., None, None]
            J = J.reshape(len(J), -1, J.shape[-1])
            found.append((p.columns, J.swapaxes(1, 2) @ J))
        return found

    def assembled(
        self, here: _Evaluation, grams: list[Gram], penalty: float, variance: float | None = None
    ) -> _Equations:
        """Add up all views, their turns eliminated, and what is known before.

        Args:
            here: where the views were predicted.
            grams: of every batch.
            penalty: variance of a coordinate over that of a turn; infinite where the head is exact.
            variance: of a coordinate, to weigh the prior [px^2]; the evaluation's own where it is not given.
        """
        boards = len(here.model.boards)
        n = len(parameter_names(self.free, here.model.stops))
        shared, shared_gradient, squares = np.zeros((n, n)), np.zeros(n), 0.0
        mixed = np.zeros((boards, n, POSE_PARAMETERS))
        board = np.zeros((boards, POSE_PARAMETERS, POSE_PARAMETERS))
        board_gradient = np.zeros((boards, POSE_PARAMETERS))
        for batch, (columns, full) in zip(self.batches, grams, strict=True):
            gram = full if batch.stop is None else _without_turns(full, penalty)
            k = len(columns)
            b = slice(k, k + POSE_PARAMETERS)
            shared[np.ix_(columns, columns)] += gram[:, :k, :k].sum(0)
            shared_gradient[columns] += gram[:, :k, -1].sum(0)
            mine = np.zeros((boards, k, POSE_PARAMETERS))
            np.add.at(mine, batch.owners, gram[:, :k, b])
            mixed[:, columns] += mine
            np.add.at(board, batch.owners, gram[:, b, b])
            np.add.at(board_gradient, batch.owners, gram[:, b, -1])
            squares += float(gram[:, -1, -1].sum())
        if self.prior is not None:
            off, information = self._known(here.model, here.sigma**2 if variance is None else variance)
            shared += np.diag(information)
            shared_gradient += information * off
            squares += float(off @ (information * off))
        return _Equations(shared, mixed, board, shared_gradient, board_gradient, squares)

    def _known(self, model: RigModel, variance: float) -> tuple[Array, Array]:
        """How far the free parameters are from the prior's, and its weight in px^2 against a coordinate's, (n,)."""
        assert self.prior is not None
        names = parameter_names(self.free, model.stops)
        sigmas = np.array([self.prior.sigmas.get(name, np.inf) for name in names])
        return difference(model, self.prior.reference, self.free), variance / sigmas**2

    def _seen(self, residuals: list[Array]) -> Array:
        """The residuals of the corners that are seen, (n, 2)."""
        return np.concatenate([r[batch.seen] for batch, r in zip(self.batches, residuals, strict=True)])


def _masked(J: Array, batch: Batch) -> Array:
    """Derivatives (v, N, 2, k) with those of unseen corners cleared."""
    return np.where(batch.seen[..., None, None], J, 0.0)


def _without_turns(gram: Array, penalty: float) -> Array:
    """Eliminate each view's own pan and tilt, the two columns before the last."""
    k = gram.shape[-1] - 1 - TURNS
    kept = [*range(k), gram.shape[-1] - 1]
    rest = gram[:, kept][:, :, kept]
    if np.isinf(penalty):
        return rest
    through = gram[:, kept][:, :, k : k + TURNS]
    own = gram[:, k : k + TURNS, k : k + TURNS] + penalty * np.eye(TURNS)
    return rest - through @ np.linalg.solve(own, through.swapaxes(1, 2))


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


def _robust_scale(here: _Evaluation) -> float:
    return HUBER_SIGMAS * here.sigma


def _weights(residuals: Array, scale: float) -> Array:
    """Huber's weight of every point."""
    return scale / np.maximum(np.linalg.norm(residuals, axis=-1), scale)


def _cost(residuals: Array, scale: float) -> float:
    """Huber's cost."""
    lengths = np.linalg.norm(residuals, axis=-1)
    return float(np.sum(np.where(lengths <= scale, lengths**2, scale * (2 * lengths - scale))))
