"""The normal equations of all corners: views added up block by block, boards and head turns eliminated.

A view depends on its own board's pose and on no other: eliminating the poses first (Schur's complement) makes a step of
150 views take a twentieth of a second, where a dense factorisation takes one or two, and leaves the shared parameters'
normal matrix. Where a head does not stand quite where it says, all corners of a view are off together. Such a jitter is
two more unknowns a view, its true pan and tilt, which are eliminated likewise, held near the reported ones by their own
standard deviation.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cotarget.calibration.parameters import POSE_PARAMETERS, Block, RigModel, difference, parameter_names
from cotarget.calibration.reprojection import Batch, Prediction, predict
from cotarget.calibration.robust import (
    HUBER_SIGMAS,
    coordinate_variance,
    huber_cost,
    huber_weights,
    robust_sigma,
)
from cotarget.geometry import Array

SMALLEST_DAMPING = 1e-12
TURNS = 2  # pan and tilt


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known before the corners speak: parameters near a reference's, with standard deviations by name."""

    reference: RigModel
    sigmas: Mapping[str, float]


# Which parameters a batch speaks of (k,), and J^T W J for each of its views (v, m, m).
Gram = tuple[npt.NDArray[np.intp], Array]


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations in blocks: shared (n, n), shared by board (B, n, 6), board (B, 6, 6), gradients, squares."""

    shared: Array
    mixed: Array
    boards: Array
    shared_gradient: Array
    board_gradient: Array
    squares: float


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A model's residuals, batch by batch, and those left when every view's pan and tilt gave way (v, N, 2)."""

    model: RigModel
    predictions: list[Prediction]
    residuals: list[Array]
    after: list[Array]
    given: float  # sum of the squares of how far pan and tilt gave way [rad^2]
    finite: bool
    sigma: float


@dataclass(frozen=True, eq=False)
class Problem:
    """What does not change during a fit: the views, sorted by lens, what is free, what is known, and the jitter."""

    batches: list[Batch]
    points: Array
    free: tuple[Block, ...]
    prior: Prior | None
    jitter: float

    def at(self, model: RigModel) -> Evaluation:
        """Predict every view."""
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
                Q = masked(p.by_turn, batch).reshape(len(r), -1, TURNS)
                QT = Q.swapaxes(1, 2)
                turned = -np.linalg.solve(QT @ Q + penalty * np.eye(TURNS), QT @ r.reshape(len(r), -1, 1))
                after.append(r + (Q @ turned).reshape(r.shape))
                given += float(np.sum(turned**2))
            sigma = robust_sigma(self._seen(after))
        return Evaluation(model, predictions, residuals, after, given, finite, sigma)

    def cost(self, here: Evaluation, scale: float) -> float:
        """Huber's cost, of the residuals and of what is known before."""
        if not here.finite:
            return np.inf
        cost = sum(huber_cost(r, scale) for r in here.after)
        variance = (scale / HUBER_SIGMAS) ** 2
        if self.jitter:
            cost += variance / self.jitter**2 * here.given
        if self.prior is not None:
            off, information = self._known(here.model, variance)
            cost += float(off @ (information * off))
        return cost

    def variance(self, here: Evaluation) -> float | None:
        """See `Fit.variance`."""
        n = len(parameter_names(self.free, here.model.stops))
        parameters = float(n + POSE_PARAMETERS * len(here.model.boards))
        if self.jitter:
            penalty = (here.sigma / self.jitter) ** 2
            for batch, p in zip(self.batches, here.predictions, strict=True):
                if p.by_turn is not None:
                    Q = masked(p.by_turn, batch).reshape(len(batch.rows), -1, TURNS)
                    QTQ = Q.swapaxes(1, 2) @ Q
                    parameters += float(
                        np.trace(np.linalg.solve(QTQ + penalty * np.eye(TURNS), QTQ), axis1=1, axis2=2).sum()
                    )
        return coordinate_variance(self._seen(here.after), parameters)

    def equations(self, here: Evaluation, scale: float | None) -> Equations:
        """Normal equations with Huber's weights; without a scale, of plain squares."""
        sigma = here.sigma
        return self.assembled(
            here, self.grams(here, scale), (sigma / self.jitter) ** 2 if self.jitter else np.inf, sigma**2
        )

    def grams(self, here: Evaluation, scale: float | None) -> list[Gram]:
        """Every batch's columns, and J^T W J of J = (shared, board, turn, residual) for each of its views."""
        found = []
        for batch, p, r, after in zip(self.batches, here.predictions, here.residuals, here.after, strict=True):
            turn = [p.by_turn] if p.by_turn is not None else []
            J = np.concatenate([p.by_shared, p.by_board, *turn, r[..., None]], axis=-1)
            J = masked(J, batch)
            if scale is not None:
                J = J * np.sqrt(huber_weights(after, scale))[..., None, None]
            J = J.reshape(len(J), -1, J.shape[-1])
            found.append((p.columns, J.swapaxes(1, 2) @ J))
        return found

    def assembled(
        self, here: Evaluation, grams: list[Gram], penalty: float, variance: float | None = None
    ) -> Equations:
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
            gram = full if batch.stop is None else without_turns(full, penalty)
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
        return Equations(shared, mixed, board, shared_gradient, board_gradient, squares)

    def _known(self, model: RigModel, variance: float) -> tuple[Array, Array]:
        """How far the free parameters are from the prior's, and its weight in px^2 against a coordinate's, (n,)."""
        assert self.prior is not None
        names = parameter_names(self.free, model.stops)
        sigmas = np.array([self.prior.sigmas.get(name, np.inf) for name in names])
        return difference(model, self.prior.reference, self.free), variance / sigmas**2

    def _seen(self, residuals: list[Array]) -> Array:
        """The residuals of the corners that are seen, (n, 2)."""
        return np.concatenate([r[batch.seen] for batch, r in zip(self.batches, residuals, strict=True)])


def masked(J: Array, batch: Batch) -> Array:
    """Derivatives (v, N, 2, k) with those of unseen corners cleared."""
    return np.where(batch.seen[..., None, None], J, 0.0)


def without_turns(gram: Array, penalty: float) -> Array:
    """Eliminate each view's own pan and tilt, the two columns before the last."""
    k = gram.shape[-1] - 1 - TURNS
    kept = [*range(k), gram.shape[-1] - 1]
    rest = gram[:, kept][:, :, kept]
    if np.isinf(penalty):
        return rest
    through = gram[:, kept][:, :, k : k + TURNS]
    own = gram[:, k : k + TURNS, k : k + TURNS] + penalty * np.eye(TURNS)
    return rest - through @ np.linalg.solve(own, through.swapaxes(1, 2))


def reduced(equations: Equations, damping: float) -> tuple[Array, Array, Array]:
    """Eliminate the boards: reduced matrix (n, n) and gradient (n,), and the boards' inverses (B, 6, 6)."""
    e = equations
    inverse = np.asarray(np.linalg.inv(e.boards + damped(e.boards, damping)), dtype=float)
    through = e.mixed @ inverse
    matrix = e.shared + damped(e.shared, damping) - (through @ e.mixed.swapaxes(1, 2)).sum(0)
    return matrix, e.shared_gradient - np.einsum("bij,bj->i", through, e.board_gradient), inverse


def solved_step(equations: Equations, damping: float) -> tuple[Array, Array]:
    """A damped step of the shared parameters (n,) and of the boards (B, 6)."""
    matrix, gradient, inverse = reduced(equations, damping)
    shared = np.asarray(np.linalg.solve(matrix, -gradient), dtype=float)
    right = equations.board_gradient + np.einsum("bij,i->bj", equations.mixed, shared)
    return shared, -np.einsum("bij,bj->bi", inverse, right)


def damped(blocks: Array, damping: float) -> Array:
    """The diagonal to add to one or many square blocks; never quite zero, so that a free direction stands still."""
    diagonal = np.diagonal(blocks, axis1=-2, axis2=-1)
    return np.eye(blocks.shape[-1]) * (diagonal * damping + SMALLEST_DAMPING)[..., None]


def robust_scale(here: Evaluation) -> float:
    """Beyond which a corner's residual counts linearly [px]."""
    return HUBER_SIGMAS * here.sigma
