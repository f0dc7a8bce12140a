"""Plan a capture session: the next board placement and the head poses, by coverage and predicted accuracy.

Plans need only a rough model of the rig. They are requests: the fit uses what is then seen. The predicted accuracy is
the rms pointing error that the views so far let expect, and by how much planned views would reduce it.
Measurements: docs/design-notes.md.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from cotarget.board import board_outline, board_points
from cotarget.calibration.bundle import Block, Fit, information, parameter_names
from cotarget.calibration.model import BundleModel, View, unseen
from cotarget.calibration.uncertainty import miss_derivatives
from cotarget.camera import Intrinsics
from cotarget.config import BoardConfig
from cotarget.errors import UnreachableError
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.pantilt import base_heads, nearest, solve
from cotarget.rig import PanTiltLimits
from cotarget.rig_geometry import ZoomHead

# Predicted accuracy

# The pointing error is predicted for targets on a grid over the fixed image, at these depths in squares of the board:
# squares of 0.1 m are for scenes of 4 to 30 m.
DEPTHS_SQUARES = (40.0, 110.0, 300.0)
ACCURACY_GRID = (5, 4)
BORDER = 0.02  # border that the grid keeps clear, as a share of the image


@dataclass(frozen=True, eq=False)
class PredictedAccuracy:
    """Normal matrix of the parameters so far, and the dependence of the pointing error on them."""

    model: BundleModel
    free: tuple[Block, ...]
    normal: Array  # normal matrix of the parameters, (n, n) [1/px^2]
    variance: float  # variance of a corner coordinate [px^2]
    pointing: Array  # mean over targets of J^T J, with J the derivative of the pointing error by the parameters, (n, n)

    def error(self, more: Array | float = 0.0) -> float:
        """Predict the rms pointing error [rad] with the normal matrix of further views; infinite if undetermined."""
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

    def with_views(
        self, views: Sequence[View], boards: dict[int, RigidTransform], points: Array
    ) -> "PredictedAccuracy":
        """Return the predicted accuracy after views of further placements."""
        return replace(self, normal=self.normal + self.worth(views, boards, points))

    def worth(self, views: Sequence[View], boards: dict[int, RigidTransform], points: Array) -> Array:
        """Compute the normal matrix that views of placements would add, (n, n)."""
        return information(replace(self.model, boards=boards), views, points, self.free)


def predict_accuracy(found: Fit, square: float) -> PredictedAccuracy | None:
    """Predict the accuracy of pointing after a fit of both cameras, Gamma and T at the shortest focal length.

    The side of the board's squares [m] scales the targets' depths. None where there are too few corners, or no target
    is within reach.
    """
    model = found.model
    if found.variance is None:
        return None
    size = np.array(model.fixed.size, dtype=float) - 1
    u, v, z = np.meshgrid(*(np.linspace(BORDER, 1 - BORDER, n) for n in ACCURACY_GRID), DEPTHS_SQUARES)
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1) * size
    names = parameter_names(found.free, model.stops)
    J, _ = miss_derivatives(model, names, pixels, z.ravel() * square, model.head.lens.nominal_px[0])
    reached = np.isfinite(J).all(axis=(1, 2))
    if not reached.any():
        return None
    J = J[reached].reshape(-1, len(names))
    pointing = J.T @ J / np.count_nonzero(reached)
    return PredictedAccuracy(model, found.free, found.normal, found.variance, pointing)


def planned_views(board: int, turns: Sequence[tuple[float, float]], corners: int) -> list[View]:
    """Make the views that a placement will give, from the fixed camera and from head poses, all corners seen."""
    seen = np.zeros_like(unseen(corners))
    return [View("fixed", seen, board), *(View("zoom", seen, board, pan, tilt) for pan, tilt in turns)]


# Placements and head poses

# Distances [m] for squares of 0.1 m and a focal length of 1.07 image widths. Nearer, the board fills the image and
# moves out of it at every turn; farther, squares of 8 px and less are not found. Markers are read to half that
# distance, and a ChArUco board that is seen in part counts.
NEAR_FAR = {"chessboard": (2.5, 8.0), "charuco": (1.7, 4.0)}
REFERENCE_SQUARE = 0.1  # [m]
REFERENCE_FOCAL = 1.07  # in image widths
MOST_TILTED, LEAST_TILTED = np.radians(40.0), np.radians(8.0)  # from facing the camera; beyond, squares get too thin
MOST_ROLLED = np.radians(25.0)
GOLDEN = 0.6180339887  # golden ratio: any number of its multiples, modulo 1, is spread evenly over 0..1
GRID = (10, 8)  # cells across and down an image in which corners are counted
HIDDEN_REACH = 0.12  # distance from a missed board within which others are not expected, over the image's width
SAME_DEPTH = 0.9  # depth over that of a missed board below which a board is expected all the same
CANDIDATES = 150  # candidate placements; the choice hardly improves with more
POSES = 120  # candidate head poses for a placement
SMALLEST_SPACING_PX = {"chessboard": 7.0, "charuco": 14.0}  # mean over the board, along its thinner direction


Missed = tuple[Array, float]  # middle in the image [px], (2,), and depth [m] of a board that a camera did not see


@dataclass(eq=False)
class Coverage:
    """Corners seen in each cell of one camera's image, and boards that the camera did not see."""

    size: tuple[int, int]  # image size (width, height) [px]
    counts: Array = field(default_factory=lambda: np.zeros(GRID))  # number of corners in every cell, `GRID`
    # boards that were not seen, such as one behind a wall or below a floor; boards there at that depth or farther will
    # not be seen either
    misses: list[Missed] = field(default_factory=list)

    def add(self, corners_px: Array) -> None:
        """Count corners (N, 2) [px]; nan does not count."""
        np.add.at(self.counts, self._cells(corners_px[np.isfinite(corners_px[:, 0])]), 1)

    def gain(self, corners_px: Array) -> float:
        """Compute the gain of further corners (N, 2) [px]; one in a cell with n others counts about 1 / (1 + n)."""
        new = np.zeros(GRID)
        np.add.at(new, self._cells(corners_px), 1)
        return float(np.sum(np.log1p(self.counts + new) - np.log1p(self.counts)))

    def hidden(self, middles_px: Array, depth: float) -> npt.NDArray[np.bool_]:
        """Check which boards with their middles at pixels (K, 2), at a depth [m], are likely hidden, (K,)."""
        near = np.zeros(len(middles_px), dtype=bool)
        for middle, missed in self.misses:
            if depth >= SAME_DEPTH * missed:
                near |= np.linalg.norm(middles_px - middle, axis=-1) < HIDDEN_REACH * self.size[0]
        return near

    def _cells(self, corners_px: Array) -> tuple[npt.NDArray[np.intp], ...]:
        cells = (corners_px / np.array(self.size) * np.array(GRID)).astype(np.intp)
        return tuple(np.clip(cells, 0, np.array(GRID) - 1).T)


def board_body(board: BoardConfig) -> Array:
    """List the board's four outer corners, then its inner ones [m], (4 + N, 3)."""
    return np.concatenate([board_outline(board), board_points(board)])


def visible(
    lens: Intrinsics, x_camera: Array, board: BoardConfig, margin_px: float
) -> tuple[npt.NDArray[np.bool_], Array]:
    """Check which of many board poses show the whole board, facing the camera and large enough for the finders.

    The poses are given as `board_body` in the camera's frame [m], (K, 4 + N, 3). Returns True for visible boards, (K,),
    and the inner corners (K, N, 2) [px].
    """
    columns, rows = board.corners
    px = lens.project(x_camera)
    with np.errstate(invalid="ignore"):
        inside = (px >= margin_px) & (px <= np.array(lens.size) - 1 - margin_px)  # false where a pixel is nan
        grid = px[:, 4:].reshape(-1, rows, columns, 2)
        across = np.linalg.norm(grid[:, :, -1] - grid[:, :, 0], axis=-1).min(axis=1) / (columns - 1)
        down = np.linalg.norm(grid[:, -1] - grid[:, 0], axis=-1).min(axis=1) / (rows - 1)
        large = np.minimum(across, down) >= SMALLEST_SPACING_PX[board.kind]
    right, below = x_camera[:, 1] - x_camera[:, 0], x_camera[:, 3] - x_camera[:, 0]
    facing = np.sum(np.cross(right, below) * x_camera[:, 0], axis=-1) > 0
    return inside.all(axis=(1, 2)) & large & facing, px[:, 4:]


def facing_board(board: BoardConfig, x_fixed: Array, turn: Rotation) -> RigidTransform:
    """Make T_fixed_board with the board's middle at ``x_fixed`` [m], (3,), turned from facing the camera."""
    middle = board_points(board).mean(axis=0)
    return RigidTransform.from_components(x_fixed - turn.apply(middle), turn)


def distance(board: BoardConfig, lens: Intrinsics, share: float) -> float:
    """Compute a board's distance [m], from the nearest (share 0) to the farthest (share 1) for board and camera."""
    scale = board.square / REFERENCE_SQUARE * (lens.focal_px[0] / lens.size[0]) / REFERENCE_FOCAL
    near, far = NEAR_FAR[board.kind]
    return float(scale * near * (far / near) ** share)


def plan_placements(
    model: BundleModel,
    board: BoardConfig,
    coverage: dict[str, Coverage],
    shares: Sequence[float],
    rng: np.random.Generator,
    *,
    shared: bool,
    margin_px: float,
    accept: Callable[[RigidTransform], bool] | None = None,
) -> list[RigidTransform]:
    """Choose a board placement for each distance: of random candidates, the one that adds most to the coverage.

    The distances are shares of the way from near to far; those at which no candidate is visible have no placement. The
    whole board is in the fixed image, less a margin; if ``shared`` in the zoom image at home too. A model without zoom
    camera counts the fixed camera alone.
    """
    fixed, head = model.fixed, model.zoom_head
    chosen = []
    for share in shares:
        pixels = rng.uniform(size=(CANDIDATES, 2)) * (np.array(fixed.size) - 1)
        turns = random_turns(CANDIDATES, rng)
        middle = board_points(board).mean(axis=0)
        x = fixed.ray(pixels) * distance(board, fixed.lens, share)
        if head is not None:
            turns = _between(x, head.T_zoom0_fixed.inv().translation) * turns
        R = turns.as_matrix()
        t = x - R @ middle
        x_fixed = board_body(board) @ R.swapaxes(1, 2) + t[:, None]
        good, seen = visible(fixed.lens, x_fixed, board, margin_px)
        good &= ~coverage["fixed"].hidden(pixels, distance(board, fixed.lens, share))
        if head is not None:
            x_zoom0 = head.T_zoom0_fixed.apply(x_fixed.reshape(-1, 3)).reshape(x_fixed.shape)
            in_zoom, seen_zoom = visible(head.lens.stops[0], x_zoom0, board, margin_px)
            good = np.logical_and(good, in_zoom) if shared else good
        gains: list[tuple[float, int]] = []
        for k in np.flatnonzero(good):
            gain = coverage["fixed"].gain(seen[k])
            if head is not None and in_zoom[k]:
                gain += coverage["zoom"].gain(seen_zoom[k])
            gains.append((gain, int(k)))
        for _, candidate in sorted(gains, reverse=True):
            place = RigidTransform.from_components(t[candidate], turns[candidate])
            if accept is None or accept(place):
                chosen.append(place)
                break
    return chosen


def where_in(lens: Intrinsics, board: BoardConfig, T_fixed_board: RigidTransform) -> tuple[Array, float]:
    """Project a board's middle into the fixed image, (2,) [px], and compute its depth [m]."""
    x = T_fixed_board.apply(board_points(board).mean(axis=0))
    return lens.project(x), float(x[2])


def preferred_share(number: int) -> float:
    """Compute a placement's share of the way from near to far; successive numbers are spread evenly."""
    return (number * GOLDEN) % 1.0


def _between(x_fixed: Array, center_fixed: Array) -> Rotation:
    """Compute half the turn from the fixed camera's line of sight to the zoom camera's, for points (n, 3)."""
    here = x_fixed / np.linalg.norm(x_fixed, axis=-1, keepdims=True)
    there = x_fixed - center_fixed
    there = there / np.linalg.norm(there, axis=-1, keepdims=True)
    axis = np.cross(here, there)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, np.sum(here * there, axis=-1, keepdims=True))
    with np.errstate(invalid="ignore", divide="ignore"):
        return Rotation.from_rotvec(np.where(sine > 0, axis / sine * angle / 2, 0.0))


def plan_poses(
    model: BundleModel,
    T_fixed_board: RigidTransform,
    board: BoardConfig,
    coverage: Coverage,
    limits: PanTiltLimits,
    count: int,
    rng: np.random.Generator,
    margin_px: float,
) -> list[tuple[float, float]]:
    """Choose up to ``count`` pans and tilts [rad] that bring a board to parts of the zoom image with few corners."""
    head, lens = model.head, model.head.lens.stops[0]
    middle = (head.T_base_fixed * T_fixed_board).apply(board_points(board).mean(axis=0))
    ray = lens.ray(lens.image_center_px)
    try:
        centred = nearest(solve(middle, head.hand_eye(), head.axes, ray), limits.pan.range, limits.tilt.range)
    except UnreachableError:
        return []
    reach = np.arctan(np.hypot(*lens.size) / 2 / lens.focal_px[0])
    pan = float(centred.pan) + rng.uniform(-reach, reach, POSES)
    tilt = float(centred.tilt) + rng.uniform(-reach, reach, POSES)
    allowed = limits.allow(pan, tilt)
    pan, tilt = pan[allowed], tilt[allowed]
    x_base = (head.T_base_fixed * T_fixed_board).apply(board_body(board))
    good, seen = visible(lens, in_zoom(head, head.hand_eye(), x_base, pan, tilt), board, margin_px)
    candidates = [int(k) for k in np.flatnonzero(good)]
    chosen: list[tuple[float, float]] = []
    planned = Coverage(coverage.size, coverage.counts.copy())
    while candidates and len(chosen) < count:
        k = max(candidates, key=lambda k: planned.gain(seen[k]))
        candidates.remove(k)
        planned.add(seen[k])
        chosen.append((float(pan[k]), float(tilt[k])))
    return chosen


def in_zoom(head: ZoomHead, T_head_zoom: RigidTransform, x_base: Array, pan: Array, tilt: Array) -> Array:
    """Map points of the base's frame (N, 3) into the zoom camera's at many head poses (K,), (K, N, 3)."""
    R, t, _ = base_heads(head.axes, pan, tilt)
    x_head = (x_base - t[:, None]) @ R
    return T_head_zoom.inv().apply(x_head.reshape(-1, 3)).reshape(x_head.shape)


def seen_at_home(model: BundleModel, T_fixed_board: RigidTransform, board: BoardConfig) -> bool:
    """Check whether the zoom camera should see a board at pan = tilt = 0."""
    x_zoom = (model.head.T_zoom0_fixed * T_fixed_board).apply(board_body(board))
    return bool(visible(model.head.lens.stops[0], x_zoom[None], board, 0.0)[0][0])


def random_turns(count: int, rng: np.random.Generator) -> Rotation:
    """Draw random turns of boards from facing the camera: tilted in any direction, and a little rolled."""
    direction = rng.uniform(-np.pi, np.pi, count)
    tilted = rng.uniform(LEAST_TILTED, MOST_TILTED, count)
    rolled = rng.uniform(-MOST_ROLLED, MOST_ROLLED, count)
    still = np.zeros(count)
    tilt = Rotation.from_rotvec(np.stack([tilted * np.cos(direction), tilted * np.sin(direction), still], axis=-1))
    return tilt * Rotation.from_rotvec(np.stack([still, still, rolled], axis=-1))
