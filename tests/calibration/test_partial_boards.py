"""A chessboard seen in part at long focal lengths, numbered by a prediction that is wrong on purpose."""

import cv2
import numpy as np
import pytest

from cotarget.board import board_points
from cotarget.calibration.corners import find_near
from cotarget.config import BoardConfig, parse_config
from cotarget.geometry import pose
from cotarget.pantilt import IDEAL_HEAD, nearest, solve
from cotarget.sim.world import SimWorld

pytestmark = pytest.mark.render
BOARD = BoardConfig()
POINTS = board_points(BOARD)
GRID = POINTS[:, :2] / BOARD.square
SIZE = np.array([640, 480])
MIDDLE = (SIZE - 1) / 2
# Each view: the board's turn about three axes [degrees], where it is [m], focal length [px], the corner looked at.
VIEWS = [
    ((5, -10, 3), (-0.8, -0.5, 8.0), 8000.0, 0),
    ((-20, 15, 40), (0.4, 0.1, 7.0), 6500.0, 53),
    ((10, 25, 100), (-0.2, -0.3, 9.0), 8000.0, 26),
    ((-15, -20, -130), (-1.2, 0.0, 8.5), 8000.0, 12),
    ((25, 0, 175), (0.6, -0.4, 7.5), 5000.0, 40),
    ((0, 30, -60), (-0.5, -0.6, 9.0), 8000.0, 45),
]
# Noise of 2 grey levels, JPEG and the renderer's 4 samples: usual are 0.065 px a coordinate.
RMS_PX, WORST_PX = 0.1, 0.5
EDGE_PX = 30  # a board's edge counts as in view when corners or their places beyond it are so far inside the image


@pytest.fixture(scope="module")
def views():
    """Images with all effects, and where all corners truly are, inside the image or not."""
    with (w := SimWorld(parse_config({}))).rig as rig:
        return [_view(w, rig, *view) for view in VIEWS]


def _view(world, rig, turn, place, focal, aim):
    T_fixed_board, sim, truth = pose(place, turn), world.config.sim, world.truth()
    rig.board.present(T_fixed_board)
    x_base = sim.T_head_zoom.apply(sim.T_zoom0_fixed.apply(T_fixed_board.apply(POINTS[aim])))
    turned = nearest(solve(x_base, sim.T_head_zoom, IDEAL_HEAD, (0.0, 0.0, 1.0)), (-2, 2), (-0.8, 0.5))
    rig.zoom.zoom(focal)
    rig.head.move(float(turned.pan), float(turned.tilt), wait=True)
    rig.clock.sleep_until(rig.clock.now() + 2.0)  # the lens travels for a second
    frame = rig.zoom.read(newer_than=rig.clock.now())
    T_zoom_board = truth.T_world_camera("zoom", frame.t).inv() * truth.T_world_fixed * T_fixed_board
    return frame.image, truth.lens("zoom", frame.t).project(T_zoom_board.apply(POINTS))


def spoiled(truth, offset=(0.0, 0.0), scale=1.0, turn_deg=0.0, bend_px=0.0):
    """A prediction that is off; ``bend_px`` is what an unknown distortion does at the image's corners."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    away = truth - MIDDLE
    radius = np.linalg.norm(away, axis=1, keepdims=True) / np.linalg.norm(MIDDLE)
    bend = bend_px * away / np.linalg.norm(MIDDLE) * np.minimum(radius, 1.5) ** 2
    return MIDDLE + scale * away @ np.array([[c, s], [-s, c]]) + np.array(offset) + bend


def places(truth, grid):
    """Where places on the board, in squares from its first corner, are in the image."""
    H, _ = cv2.findHomography(GRID, truth)
    return cv2.perspectiveTransform(grid.reshape(-1, 1, 2).astype(float), H).reshape(-1, 2)


def inside(pixels, margin):
    return ((pixels >= margin) & (pixels <= SIZE - 1 - margin)).all(axis=1)


@pytest.mark.parametrize("how", [
    {}, {"offset": (4.0, -3.0), "scale": 1.01}, {"offset": (-10.0, 11.0), "scale": 0.97, "turn_deg": 1.0},
    {"offset": (12.0, 5.0), "scale": 1.03, "turn_deg": -2.0}, {"offset": (3.0, 3.0), "bend_px": 4.0},
], ids=["true", "usual", "far", "turned", "bent"])  # fmt: skip
def test_corners_in_view_are_found_and_numbered(views, how):
    errors = []
    for image, truth in views:
        corners = find_near(image, BOARD, spoiled(truth, **how))
        assert corners is not None
        assert corners.shape == (54, 2)
        seen = np.isfinite(corners).all(axis=1)
        well_inside = inside(truth, 20)
        assert 6 <= well_inside.sum() < 54, "the board is to be seen in part"
        assert np.count_nonzero(seen & well_inside) >= 0.9 * well_inside.sum()
        assert not seen[~inside(truth, 0)].any()
        errors.append(corners[seen] - truth[seen])
    error = np.concatenate(errors)
    assert np.sqrt(np.mean(error**2)) < RMS_PX
    assert np.abs(error).max() < WORST_PX


def test_find_near_works_with_missing_predictions(views):
    image, truth = views[4]
    predicted = truth.copy()
    predicted[:9] = np.nan
    corners = find_near(image, BOARD, predicted)
    assert np.isnan(corners[:9]).all()
    assert np.isfinite(corners).all(axis=1).sum() >= 6
    assert find_near(image, BOARD, np.full((54, 2), np.nan)) is None
    assert find_near(image, BOARD, truth + 5000) is None


@pytest.mark.parametrize(
    "shift", [(1, 0), (0, 1), (-1, 0), (0, -1), (0.5, 0), (0, 0.6), (0.4, 0.4), (1, 2), (0.7, 0.2)]
)
def test_a_prediction_one_square_off_is_refused_by_the_colours(views, shift):
    for image, truth in views:
        assert find_near(image, BOARD, places(truth, GRID + np.array(shift))) is None


@pytest.mark.parametrize("shift", [(1, 1), (-1, 1), (1, -1), (-1, -1), (2, 0), (-2, 0), (0, 2), (0, -2), (2, 2)])
def test_a_prediction_two_squares_off_is_refused_where_an_edge_across_is_in_view(views, shift):
    refused = 0
    for image, truth in views:
        columns, rows = np.arange(9), np.arange(6)
        sides = [(u, rows, 0) for u in (-1, 9)] + [(columns, v, 1) for v in (-1, 6)]
        across = [
            inside(places(truth, np.stack(np.broadcast_arrays(u, v), axis=-1)), EDGE_PX).sum() >= 2 and shift[axis] != 0
            for u, v, axis in sides
        ]
        if any(across):
            assert find_near(image, BOARD, places(truth, GRID + np.array(shift))) is None
            refused += 1
    assert refused >= 2, "too few views show an edge of the board"


@pytest.mark.parametrize("spoil", [
    lambda image: cv2.GaussianBlur(image, (0, 0), 14), lambda image: cv2.blur(image, (50, 1)),
    lambda image: np.where(np.arange(640)[:, None] < 320, image, np.uint8(90)),
    lambda image: np.random.default_rng(0).integers(0, 255, image.shape, dtype=np.uint8),
    lambda image: np.full_like(image, 128),
], ids=["blurred", "moved", "half covered", "noise", "nothing"])  # fmt: skip
def test_find_near_refuses_images_without_a_board(views, spoil):
    for image, truth in views:
        corners = find_near(spoil(image), BOARD, spoiled(truth, (3.0, -2.0), 1.01))
        # Where all that is in view lies in the half that is left, it may be found, and rightly.
        assert corners is None or np.nanmax(np.abs(corners - truth)) < WORST_PX
    image, truth = views[0]
    assert find_near(spoil(image), BOARD, truth) is None
