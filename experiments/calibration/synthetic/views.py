"""Views of calibration boards by a synthetic rig's cameras."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
from annotated_types import Ge

from cotarget.calibration import View
from cotarget.calibration.initialization import FEWEST_VIEWS
from cotarget.geometry import Array, Rotation
from experiments.calibration.synthetic.aims import aimed
from experiments.calibration.synthetic.rig import NOMINAL_PX, SIZE, Stop, Truth, undistorted

BOARD_DEPTHS = (2.5, 8.0)  # [m]
MARGIN_PX = 40.0  # least distance of a board's centre from the border of the fixed image
# Limits of the head in use: pan and tilt [rad].
HEAD_LIMITS = ((np.radians(-158.9), np.radians(158.9)), (np.radians(-46.6), np.radians(31.1)))
TURNED = np.radians(45.0)  # largest rotation of a board from facing halfway between both cameras [rad]
CELLS = (5, 3)  # grid of the fixed view, columns and rows, over which boards are spread
CELL_STEP = 7  # step between successive cells, so that a few boards are spread too
FLATTEST = np.cos(np.radians(65.0))  # largest viewing angle at which a board is found
FARTHER = 0.03  # relative increase of the depth of a board that is not wholly visible
GOLDEN = (np.sqrt(5) - 1) / 2  # multiples of it, modulo 1, are evenly spread for any count
LOOKS_DRAWN = 80  # head poses drawn, of which those far apart are chosen
TRIES = 200  # head poses drawn per placement
PLACEMENT_TRIES = 100_000
Boards = Annotated[int, Ge(FEWEST_VIEWS)]  # as many placements as determine a camera's intrinsics
Looks = Annotated[int, Ge(2)]  # as many head poses per placement as determine the zoom camera's pose on the head


def synthetic_views(
    truth: Truth,
    points: Array,
    rng: np.random.Generator,
    boards: int = 30,
    noise_px: float = 0.1,
    moved: int = 3,
    pan_range: float = 0.5,
    tilt_range: float = 0.4,
    shape: Array | None = None,
) -> list[View]:
    """Make views of boards at random poses in the fixed view, with the head at home and moved.

    Args:
        truth: the rig.
        points: nominal corners of the board [m], (N, 3).
        rng: source of all random values.
        boards: number of placements.
        noise_px: standard deviation of a corner's coordinate.
        moved: number of head poses per placement, besides home where the zoom camera sees the board from there.
        pan_range: largest pan to either side [rad].
        tilt_range: largest tilt to either side [rad].
        shape: true corners of the board [m], (N, 3); by default the nominal ones.
    """
    views: list[View] = []
    center = points.mean(axis=0)
    true_points = points if shape is None else shape
    number, stood = 0, np.zeros(2)
    for _ in range(PLACEMENT_TRIES):
        if number == boards:
            break
        depth = np.exp(rng.uniform(*np.log(BOARD_DEPTHS)))
        uv = rng.uniform(MARGIN_PX, np.array(SIZE) - MARGIN_PX)
        ray = np.array([(uv[0] - truth.fixed.cx) / truth.fixed.fx, (uv[1] - truth.fixed.cy) / truth.fixed.fy, 1.0])
        R = Rotation.from_rotvec(np.radians(rng.uniform([-35, -35, -20], [35, 35, 20])))
        x_fixed = R.apply(true_points - center) + ray * depth
        if not truth.fixed.sees(x_fixed):
            continue
        reach = [pan_range, tilt_range]
        poses = np.concatenate([np.zeros((1, 2)), rng.uniform(np.negative(reach), reach, (TRIES, 2))])
        seen = poses[seen_from(truth, x_fixed, poses)]
        if not len(seen) or (len(seen) < 2 and moved):
            continue
        views.append(View("fixed", noisy(truth.fixed.project(x_fixed), noise_px, rng), number))
        for reported in seen[: moved + 1]:
            views.append(zoom_view(truth, x_fixed, number, reported, stood, noise_px, rng))
            stood = reported
        number += 1
    return views


@dataclass(frozen=True)
class Placing:
    """Placement of boards and head poses."""

    boards: int = 15  # number of placements, one in each cell of the fixed view in turn
    # Head poses per placement, as far apart as the zoom camera's view and the head's limits allow; home is among them
    # where the zoom camera sees the board from there.
    looks: int = 4
    depths: tuple[float, float] = BOARD_DEPTHS  # range of depths, even in the logarithm [m]


def spread_views(
    truth: Truth,
    points: Array,
    rng: np.random.Generator,
    noise_px: float,
    placing: Placing,
    shape: Array | None = None,
) -> list[View]:
    """Make views of boards over the whole fixed view, each from head poses that spread it over the zoom view.

    Arguments as for `synthetic_views`.

    Raises:
        AssertionError: there is no room for a board.
    """
    views: list[View] = []
    stood = np.zeros(2)
    for number in range(placing.boards):
        x_fixed, poses = placed(truth, points if shape is None else shape, rng, placing, number)
        views.append(View("fixed", noisy(truth.fixed.project(x_fixed), noise_px, rng), number))
        for reported in poses:
            views.append(zoom_view(truth, x_fixed, number, reported, stood, noise_px, rng))
            stood = reported
    return views


def placed(truth: Truth, points: Array, rng: np.random.Generator, placing: Placing, number: int) -> tuple[Array, Array]:
    """Place a board: its corners in the fixed camera's frame [m], (N, 3), and head poses (n, 2) [rad].

    A board too near for its cell is moved away; a cell that the zoom camera cannot see is replaced by any other.

    Raises:
        AssertionError: there is no room for the board.
    """
    centered = points - points.mean(axis=0)
    row, column = divmod(number * CELL_STEP % (CELLS[0] * CELLS[1]), CELLS[0])
    near, far = np.log(np.array(placing.depths))
    depth = near + (far - near) * (GOLDEN * number % 1)
    zoom_at = truth.gamma.inv().translation
    for i in range(PLACEMENT_TRIES // TRIES):
        cell = np.array([column, row]) + rng.uniform(0, 1, 2) if i < TRIES else rng.uniform([0, 0], CELLS)
        x = np.append(undistorted(cell / CELLS * (np.array(SIZE) - 1.0), truth.fixed), 1.0) * np.exp(depth)
        facing = _unit(_unit(x) + _unit(x - zoom_at))
        turn = Rotation.from_rotvec(rng.uniform(-1, 1, 3) * TURNED)
        x_fixed = (turn * _towards(facing)).apply(centered) + x
        normal = turn.apply(facing)
        sideways = min(normal @ _unit(x), normal @ _unit(x - zoom_at)) < FLATTEST
        if sideways or not truth.fixed.sees(x_fixed):
            depth = min(depth + FARTHER, far) if depth < far else rng.uniform(near, far)
            continue
        looking = np.concatenate([np.zeros((1, 2)), _looks(truth, x, rng)])
        low, high = np.array(HEAD_LIMITS).T
        seen = looking[((looking >= low) & (looking <= high)).all(axis=1)]
        seen = seen[seen_from(truth, x_fixed, seen)]
        if len(seen) >= placing.looks:
            return x_fixed, _apart(seen, placing.looks)
        depth = rng.uniform(near, far)
    raise AssertionError("no room for a board that both cameras see")


def _looks(truth: Truth, x_fixed: Array, rng: np.random.Generator) -> Array:
    """Draw head poses that bring a point (3,) to pixels over the whole zoom view, (n, 2)."""
    pixels = rng.uniform([0, 0], np.array(SIZE) - 1.0, (LOOKS_DRAWN, 2))
    rays = np.c_[(pixels - [truth.zoom.cx, truth.zoom.cy]) / [truth.zoom.fx, truth.zoom.fy], np.ones(LOOKS_DRAWN)]
    return aimed(truth, np.tile(x_fixed, (LOOKS_DRAWN, 1)), rays)


def _apart(poses: Array, count: int) -> Array:
    """Select poses (n, 2): the first one, then each time the one farthest from those selected."""
    taken = [0]
    while len(taken) < count:
        away = np.linalg.norm(poses[:, None] - poses[taken][None], axis=-1).min(axis=1)
        taken.append(int(np.argmax(away)))
    return poses[taken]


def _towards(direction: Array) -> Rotation:
    """Give the smallest rotation of +z to a direction (3,)."""
    return Rotation.align_vectors(direction[None], np.array([[0.0, 0.0, 1.0]]))[0]


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v))


def seen_from(truth: Truth, x_fixed: Array, poses: Array) -> npt.NDArray[np.bool_]:
    """Check for each head pose (n, 2) that the zoom camera sees all points (N, 3)."""
    x_zoom = truth.in_zoom(x_fixed, poses[:, :1], poses[:, 1:])
    inside = truth.zoom.inside(x_zoom.reshape(-1, 3)).reshape(x_zoom.shape[:2])
    return np.asarray(inside.all(axis=1))


def zoom_view(
    truth: Truth,
    x_fixed: Array,
    number: int,
    reported: Array,
    before: Array | None,
    noise_px: float,
    rng: np.random.Generator,
    stop: Stop | None = None,
) -> View:
    """Make the zoom camera's view of a board's corners (N, 3), perhaps in part, at a reported head pose.

    Poses are (2,) [rad]; without a zoom sample it is at the shortest focal length.
    """
    lens, pupil, nominal = (truth.zoom, 0.0, NOMINAL_PX) if stop is None else (stop.lens, stop.pupil, stop.nominal_px)
    x = truth.in_zoom(x_fixed, *truth.stands(reported, before, rng)) - [0.0, 0.0, pupil]
    px = noisy(lens.project(x), noise_px, rng)
    if stop is not None:
        px = np.where(lens.inside(x)[:, None], px, np.nan)
    return View("zoom", px, number, float(reported[0]), float(reported[1]), focal_px=nominal)


def noisy(corners_px: Array, noise_px: float, rng: np.random.Generator) -> Array:
    """Add Gaussian noise to corners (N, 2)."""
    return corners_px + rng.normal(0, noise_px, corners_px.shape)
