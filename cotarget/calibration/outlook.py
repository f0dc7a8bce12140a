"""What a capture session knows so far, in the terms that count: the predicted pointing error; and what more buys."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cotarget.calibration.bundle import Fit, information
from cotarget.calibration.model import View, unseen
from cotarget.calibration.parameters import Block, RigModel, parameter_names
from cotarget.calibration.uncertainty import miss_derivatives
from cotarget.geometry import Array, RigidTransform

# Pointing is judged for targets on a grid over the wide view at these depths [m], in squares of the board: a board of
# 0.1 m is for scenes of 4 to 30 m.
DEPTHS_SQUARES = (40.0, 110.0, 300.0)
GRID = (5, 4)
BORDER = 0.02  # of the image, that the grid keeps clear


@dataclass(frozen=True, eq=False)
class Outlook:
    """What is known of the parameters, and how pointing depends on them.

    Attributes:
        model: fitted so far.
        free: its blocks.
        normal: what is known, (n, n) [1/px^2].
        variance: of a coordinate [px^2].
        pointing: mean over targets of J^T J, with J how the miss changes with the parameters, (n, n).
    """

    model: RigModel
    free: tuple[Block, ...]
    normal: Array
    variance: float
    pointing: Array

    def error(self, more: Array | float = 0.0) -> float:
        """Predicted rms pointing error when so much more is known (n, n) [rad]; infinite where something is open."""
        total = self.normal + more
        scale = np.sqrt(np.diagonal(total))
        if not (scale > 0).all():
            return np.inf
        try:
            spread = np.linalg.solve(total / np.outer(scale, scale), self.pointing / np.outer(scale, scale))
        except np.linalg.LinAlgError:
            return np.inf
        squared = float(np.trace(spread)) * self.variance
        return float(np.sqrt(squared)) if squared > 0 else np.inf

    def with_views(self, views: Sequence[View], boards: dict[int, RigidTransform], points: Array) -> "Outlook":
        """The outlook after views of more placements."""
        return replace(self, normal=self.normal + self.worth(views, boards, points))

    def worth(self, views: Sequence[View], boards: dict[int, RigidTransform], points: Array) -> Array:
        """What views of placements would add to what is known, (n, n)."""
        return information(replace(self.model, boards=boards), views, points, self.free)


def outlook_of(found: Fit, square: float) -> Outlook | None:
    """The outlook after a fit of everything at the shortest focal length.

    Args:
        found: with Gamma, T and both cameras free.
        square: of the board [m], which tells how far targets are.

    Returns:
        None where there are too few corners for it, or targets cannot be reached.
    """
    model = found.model
    if found.variance is None or model.fixed is None or model.zoom is None:
        return None
    size = np.array(model.fixed.size, dtype=float) - 1
    u, v, z = np.meshgrid(*(np.linspace(BORDER, 1 - BORDER, n) for n in GRID), DEPTHS_SQUARES)
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1) * size
    names = parameter_names(found.free, model.stops)
    J, _ = miss_derivatives(model, names, pixels, z.ravel() * square, model.zoom.nominal_px[0])
    reached = np.isfinite(J).all(axis=(1, 2))
    if not reached.any():
        return None
    J = J[reached].reshape(-1, len(names))
    pointing = J.T @ J / np.count_nonzero(reached)
    return Outlook(model, found.free, found.normal, found.variance, pointing)


def planned_views(board: int, turns: Sequence[tuple[float, float]], corners: int) -> list[View]:
    """The views that a placement seen by the fixed camera and from head poses will be, all corners seen."""
    seen = np.zeros_like(unseen(corners))
    return [View("fixed", seen, board), *(View("zoom", seen, board, pan, tilt) for pan, tilt in turns)]
