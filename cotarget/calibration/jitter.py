"""Estimate the head's jitter, and by how much it stands elsewhere than it reports in each view."""

import numpy as np
from scipy.optimize import minimize_scalar

from cotarget.calibration.bundle import (
    POSE_PARAMETERS,
    SMALLEST_SIGMA_PX,
    TURNS,
    Fit,
    Prior,
    Problem,
    batches_of,
    damped,
    huber_weights,
    masked,
    reduced,
    robust_scale,
)
from cotarget.geometry import Array

# Range of the search [rad], and twice the log-likelihood ratio from which jitter is accepted: chance exceeds it once in
# twenty times (a half chi-square at its border).
JITTER_RANGE = (1e-7, 0.1)
JITTER_EVIDENCE = 2.71
TURN_ROUNDS = 6
RELATIVE_ROUNDING = 1e-10  # rounding of a normal matrix after the boards' poses are eliminated by subtraction


def estimate_jitter(found: Fit, points: Array, prior: Prior | None = None) -> float:
    """Estimate the head's jitter [rad] by restricted maximum likelihood; 0 where the corners give no evidence of it.

    With the variance of the corners profiled out, the likelihood of a jitter needs only the normal equations of the fit
    without jitter (Patterson and Thompson 1971; Harville 1977). Jitter that the fit has assumed affects only the
    weights of its corners.
    """
    problem = Problem(batches_of(found.model, found.views), points, found.free, prior, found.jitter)
    if found.variance is None or not any(batch.stop is not None for batch in problem.batches):
        return 0.0
    here = problem.at(found.model)
    grams = problem.grams(here, robust_scale(here))
    coordinates = 2 * sum(int(batch.seen.sum()) for batch in problem.batches)
    freedom = coordinates - len(found.normal) - POSE_PARAMETERS * len(found.model.boards)

    def profiled(ratio: float) -> tuple[float, Array, Array]:
        """Compute the squares at the optimum, the reduced matrix and the boards' inverses at jitter^2 / variance."""
        equations = problem.assembled(here, grams, 1 / ratio if ratio else np.inf)
        matrix, gradient, inverse = reduced(equations, 0.0)
        matrix = matrix + damped(matrix, RELATIVE_ROUNDING)  # so that an undetermined direction does not move
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


def head_turns(found: Fit, points: Array) -> Array:
    """Estimate by how much each zoom view's true pan and tilt differ from the reported ones, (V, 2) [rad].

    All else stays as fitted. Views of the fixed camera have nan.
    """
    problem = Problem(batches_of(found.model, found.views), points, (), None, 0.0)
    here = problem.at(found.model)
    turns = np.full((len(found.views), TURNS), np.nan)
    for batch, p, r in zip(problem.batches, here.predictions, here.residuals, strict=True):
        if p.by_turn is None:
            continue
        Q, after = masked(p.by_turn, batch), r
        for _ in range(TURN_ROUNDS):  # reweighted, so that wrong corners do not turn a view
            weighted = Q * huber_weights(after, robust_scale(here))[..., None, None]
            own = np.einsum("vnik,vnil->vkl", weighted, Q)
            turn = -np.linalg.solve(
                own + damped(own, RELATIVE_ROUNDING), np.einsum("vnik,vni->vk", weighted, r)[..., None]
            )[..., 0]
            after = r + np.einsum("vnik,vk->vni", Q, turn)
        turns[batch.rows] = turn
    return turns
