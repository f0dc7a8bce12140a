"""Parameters that a fit holds, considered all the same: what their being wrong would do to those that it finds.

A fit without a parameter that matters is wrong by more than its covariance says. To free every parameter that might
matter makes every calibration worse. Between these stands the consider covariance (Schmidt 1966; Tapley, Schutz and
Born, Statistical Orbit Determination, ch. 6): the parameter stays where it is, and its doubt is carried into the
others. How large that doubt is, the corners tell: one Gauss-Newton step with the parameter free gives its estimate and
the standard deviation of that. An estimate that noise explains is no reason for doubt; any other is the doubt itself.
"""

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from cotarget.calibration.bundle import Fit
from cotarget.calibration.model import Covariance
from cotarget.calibration.normal import Prior, Problem, reduced, robust_scale
from cotarget.calibration.parameters import Block, parameter_names
from cotarget.calibration.reprojection import batches_of
from cotarget.calibration.uncertainty import covariance_of
from cotarget.geometry import Array

# Held parameters whose estimate is further from where they are held than this many standard deviations are doubted: by
# chance, one in eight. From 1 on, ellipses of the focal length held the truth in 95 of 100 rigs instead of 90.
DOUBTED_SIGMAS = 1.5


def with_considered(
    covariance: Covariance, found: Fit, points: Array, held: Collection[Block], prior: Prior | None = None
) -> Covariance:
    """Add to a fit's covariance what held parameters leave in doubt.

    Args:
        covariance: of the fit.
        found: the fit.
        points: the board's corners in its frame [m], (N, 3).
        held: blocks that were not free in it.
        prior: that of the fit, with what is known of the held ones.

    Returns:
        Of the fit's parameters and of those held ones that are doubted. With S = dp/dq, by what the parameters p come
        out wrong when a held q is, the errors (S, -1) q are added with q^2 = its estimate squared.
    """
    own = list(covariance.parameters)
    free = (*found.free, *held)
    problem = Problem(batches_of(found.model, found.views), points, free, prior, found.jitter)
    here = problem.at(found.model)
    matrix, gradient, _ = reduced(problem.equations(here, robust_scale(here)), 0.0)
    everything = covariance_of(replace(found, free=free, normal=matrix))
    if everything is None:
        return covariance  # nothing tells the held ones from the others
    names = parameter_names(free, found.model.stops)
    estimates = dict(zip(names, np.linalg.solve(matrix, -gradient), strict=True))
    doubted = [
        name for name in names if name not in own and abs(estimates[name]) > DOUBTED_SIGMAS * everything.sigma(name)
    ]
    if not doubted:
        return covariance
    p, q = ([names.index(name) for name in group] for group in (own, doubted))
    by_held = np.linalg.solve(matrix[np.ix_(p, p)], matrix[np.ix_(p, q)])
    errors = np.concatenate([by_held, -np.eye(len(q))]) * np.array([estimates[name] for name in doubted])
    grown = errors @ errors.T
    grown[: len(p), : len(p)] += covariance.matrix
    return Covariance((*own, *doubted), grown)
