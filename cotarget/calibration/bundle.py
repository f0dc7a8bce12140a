"""The parameters that explain the corners best: one least-squares problem that serves every step.

The steps of a calibration differ in which blocks are free. The solver is Levenberg and Marquardt's and not scipy's
least_squares, because of the structure that `cotarget.calibration.normal` makes use of.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cotarget.calibration.model import View
from cotarget.calibration.normal import Prior, Problem, reduced, robust_scale, solved_step
from cotarget.calibration.parameters import Block, RigModel, stepped
from cotarget.calibration.reprojection import batches_of
from cotarget.calibration.robust import rms
from cotarget.errors import CalibrationError
from cotarget.geometry import Array

STEPS = 60
CONVERGED = 1e-10  # relative fall of the cost at which the solver stops
DAMPING = 1e-4  # first, relative to the diagonal of the normal equations
DAMPING_LIMIT = 1e10


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
    problem = Problem(batches_of(model, views), points, tuple(free), prior, jitter)
    here = problem.at(model)
    damping = DAMPING
    for _ in range(STEPS):
        scale = robust_scale(here)
        equations = problem.equations(here, scale)
        cost = problem.cost(here, scale)
        while damping < DAMPING_LIMIT:
            trial = problem.at(stepped(here.model, *solved_step(equations, damping), free))
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
    normal = reduced(problem.equations(here, None), 0.0)[0]
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
    problem = Problem(batches_of(model, views), points, tuple(free), None, 0.0)
    return reduced(problem.equations(problem.at(model), None), 0.0)[0]
