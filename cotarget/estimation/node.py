"""The filter's whole memory after a measurement: state, covariance, and how surprising the last ones were."""

import math
from dataclasses import dataclass, replace

import numpy as np

from cotarget.estimation.motion import L
from cotarget.estimation.settings import Jump
from cotarget.geometry import Array

FARTHEST = 1e5  # [m]; nothing is seen from farther away


@dataclass(frozen=True)
class Node:
    """One point in time of a filter.

    Attributes:
        t: [s].
        x: state, see `cotarget.estimation.motion`, (13,).
        P: its covariance, (13, 13).
        surprise: squared innovation over what was expected, averaged over the last measurements of the middle.
        boost: by what the acceleration's variance is larger than usual.
        missed_wide: how many measurements in the wide view were turned away on end.
        missed_zoom: likewise in the zoom view.
        missed_size: likewise of the size.
        size_t: when the size was last measured [s].
        lean: innovation in the zoom view over its standard deviation, averaged over the last second or so, (2,).
        wide_t: when the wide view last corrected the middle [s]; a start, at first or elsewhere, is no correction.
        moved_t: when it was last found elsewhere than it could be [s].
    """

    t: float
    x: Array
    P: Array
    surprise: float = 1.0
    boost: float = 1.0
    missed_wide: int = 0
    missed_zoom: int = 0
    missed_size: int = 0
    size_t: float = -math.inf
    wide_t: float = -math.inf
    moved_t: float = -math.inf
    lean: tuple[float, float] = (0.0, 0.0)

    def jumped(self, jump: Jump) -> bool:
        """Whether it was found elsewhere so lately that it may be on its way still."""
        return self.t < self.moved_t + jump.seconds


def sound(node: Node, nearest: float) -> Node | None:
    """The same with a depth that can be and a covariance that is symmetric; None where it tells nothing any more.

    Args:
        node: after a measurement.
        nearest: no target is nearer than this [m].
    """
    x, P = node.x.copy(), (node.P + node.P.T) / 2
    if not (np.isfinite(x).all() and np.isfinite(P).all() and (P.diagonal() > 0).all()):
        return None
    x[L] = min(max(x[L], math.log(nearest)), math.log(FARTHEST))
    return replace(node, x=x, P=P)
