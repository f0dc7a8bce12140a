"""Where to hold the board next and where to turn the head, so that the corners cover both images, near and far.

Plans need only a rough model of the rig. Whatever is planned is a wish: what counts is what is then seen.
"""

from dataclasses import dataclass, field

import numpy as np

from cotarget.calibration.boards import board_outline, board_points
from cotarget.calibration.reprojection import RigModel
from cotarget.camera import Intrinsics
from cotarget.config import BoardConfig
from cotarget.errors import UnreachableError
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.pantilt import base_head, nearest, solve
from cotarget.rig import PanTiltLimits

# Distances for squares of 0.1 m and a focal length of 1.07 image widths: nearer, the board fills the image and moves
# out of it at every turn; farther, squares of 8 px and less are no longer found.
NEAR, FAR = 2.5, 8.0
REFERENCE_SQUARE = 0.1  # [m]
REFERENCE_FOCAL = 1.07  # in image widths
MOST_TILTED, LEAST_TILTED = np.radians(40.0), np.radians(8.0)  # from facing the camera; beyond, squares get too thin
MOST_ROLLED = np.radians(25.0)
GOLDEN = 0.6180339887  # its multiples spread evenly over 0..1 however many there are
GRID = (10, 8)  # cells across and down an image in which corners are counted
CANDIDATES = 150  # placements tried before one is chosen; the choice hardly improves with more
POSES = 120  # head poses tried for a placement
SMALLEST_SPACING_PX = 7.0  # on average over the board, of the thinner direction


@dataclass(eq=False)
class Coverage:
    """How many corners each cell of one camera's image has seen."""

    size: tuple[int, int]
    counts: Array = field(default_factory=lambda: np.zeros(GRID))

    def add(self, corners_px: Array) -> None:
        """Count corners (N, 2) [px]."""
        np.add.at(self.counts, self._cells(corners_px), 1)

    def gain(self, corners_px: Array) -> float:
        """How much corners (N, 2) [px] would add: a corner in a cell with n others is worth 1 / (1 + n)."""
        new = np.zeros(GRID)
        np.add.at(new, self._cells(corners_px), 1)
        return float(np.sum(np.log1p(self.counts + new) - np.log1p(self.counts)))

    def _cells(self, corners_px: Array) -> tuple[Array, ...]:
        cells = (corners_px / np.array(self.size) * np.array(GRID)).astype(int)
        return tuple(np.clip(cells, 0, np.array(GRID) - 1).T)


def visible_corners(lens: Intrinsics, T_camera_board: RigidTransform, board: BoardConfig, margin_px: float) -> Array:
    """Where the corners appear, (N, 2) [px]; empty unless the whole board with its outer squares is well visible."""
    nothing = np.empty((0, 2))
    outline = T_camera_board.apply(board_outline(board))
    facing = T_camera_board.rotation.as_matrix()[:, 2] @ outline.mean(axis=0)
    if facing <= 0 or outline[:, 2].min() <= 0:
        return nothing
    px = lens.project(np.concatenate([outline, T_camera_board.apply(board_points(board))]))
    inside = (px >= margin_px) & (px <= np.array(lens.size) - 1 - margin_px)
    if not inside.all():  # also where a pixel is nan
        return nothing
    columns, rows = board.corners
    grid = px[4:].reshape(rows, columns, 2)
    across = np.linalg.norm(grid[:, -1] - grid[:, 0], axis=-1).min() / (columns - 1)
    down = np.linalg.norm(grid[-1] - grid[0], axis=-1).min() / (rows - 1)
    return px[4:] if min(across, down) >= SMALLEST_SPACING_PX else nothing


def facing_board(board: BoardConfig, x_fixed: Array, turn: Rotation) -> RigidTransform:
    """T_fixed_board with the board's middle at ``x_fixed`` [m], (3,), turned from facing the camera's axis."""
    middle = board_points(board).mean(axis=0)
    return RigidTransform.from_components(x_fixed - turn.apply(middle), turn)


def distance(board: BoardConfig, lens: Intrinsics, share: float) -> float:
    """A distance [m] from the nearest (share 0) to the farthest (share 1) for this board and camera."""
    scale = board.square / REFERENCE_SQUARE * (lens.focal_px[0] / lens.size[0]) / REFERENCE_FOCAL
    return float(scale * NEAR * (FAR / NEAR) ** share)


def plan_placement(
    model: RigModel,
    board: BoardConfig,
    coverage: dict[str, Coverage],
    number: int,
    rng: np.random.Generator,
    *,
    shared: bool,
    margin_px: float,
) -> RigidTransform | None:
    """Choose where to hold the board.

    Args:
        model: rough model of the rig; while its ``zoom`` is None, only the fixed camera is looked at.
        board: the board.
        coverage: of "fixed" and "zoom".
        number: of the placement, from which its distance follows.
        rng: random numbers.
        shared: whether the zoom camera must see it too, at pan = tilt = 0.
        margin_px: how far inside the images the board must stay.

    Returns:
        T_fixed_board, or None where no candidate is visible.
    """
    assert model.fixed is not None
    best, best_gain = None, 0.0
    size = np.array(model.fixed.size)
    for k in range(CANDIDATES):
        # The distances of successive placements are spread evenly; late candidates may have any.
        share = (number * GOLDEN) % 1.0 if k < CANDIDATES // 2 else rng.uniform()
        ray = model.fixed.ray(rng.uniform(0, 1, 2) * (size - 1))
        if best is not None and k >= CANDIDATES // 2:
            break
        T = facing_board(board, ray * distance(board, model.fixed, share), random_turn(rng))
        seen = visible_corners(model.fixed, T, board, margin_px)
        if not len(seen):
            continue
        gain = coverage["fixed"].gain(seen)
        if model.zoom is not None:
            seen = visible_corners(model.zoom, model.gamma * T, board, margin_px)
            if shared and not len(seen):
                continue
            gain += coverage["zoom"].gain(seen)
        if gain > best_gain:
            best, best_gain = T, gain
    return best


def plan_poses(
    model: RigModel,
    T_fixed_board: RigidTransform,
    board: BoardConfig,
    coverage: Coverage,
    limits: PanTiltLimits,
    count: int,
    rng: np.random.Generator,
    margin_px: float,
) -> list[tuple[float, float]]:
    """Choose head poses that move a board over the zoom image, to where few corners were yet.

    Returns:
        Up to ``count`` pairs (pan, tilt) [rad], within the limits.
    """
    assert model.zoom is not None
    lens = model.zoom
    middle = (model.hand * model.gamma * T_fixed_board).apply(board_points(board).mean(axis=0))
    ray = lens.ray(lens.image_center_px)
    try:
        centred = nearest(solve(middle, model.hand, model.head, ray), limits.pan, limits.tilt)
    except UnreachableError:
        return []
    reach = np.arctan(np.hypot(*lens.size) / 2 / lens.focal_px[0])
    spread = rng.uniform(-reach, reach, (POSES, 2))
    candidates = []
    for pan, tilt in spread + np.array([float(centred.pan), float(centred.tilt)]):
        if not (limits.pan[0] <= pan <= limits.pan[1] and limits.tilt[0] <= tilt <= limits.tilt[1]):
            continue
        P = base_head(pan, tilt, model.head)
        seen = visible_corners(
            lens, model.hand.inv() * P.inv() * model.hand * model.gamma * T_fixed_board, board, margin_px
        )
        if len(seen):
            candidates.append((float(pan), float(tilt), seen))
    chosen = []
    planned = Coverage(coverage.size, coverage.counts.copy())
    for _ in range(min(count, len(candidates))):
        pan, tilt, seen = max(candidates, key=lambda candidate: planned.gain(candidate[2]))
        planned.add(seen)
        chosen.append((pan, tilt))
    return chosen


def random_turn(rng: np.random.Generator) -> Rotation:
    """Turn a board from facing the camera: tilted in any direction, and a little rolled."""
    direction, tilted = rng.uniform(-np.pi, np.pi), rng.uniform(LEAST_TILTED, MOST_TILTED)
    tilt = Rotation.from_rotvec([tilted * np.cos(direction), tilted * np.sin(direction), 0.0])
    return tilt * Rotation.from_rotvec([0.0, 0.0, rng.uniform(-MOST_ROLLED, MOST_ROLLED)])
