"""Corners: found to a fraction of a pixel, and numbered by the board and not by the image."""

import cv2
import numpy as np
import pytest

from cotarget.calibration.boards import board_points, check_board, draw_board, find_corners
from cotarget.config import BoardConfig
from cotarget.errors import ConfigError
from cotarget.geometry import RigidTransform, Rotation
from experiments.synthetic import Truth
from tests.synthetic_rig import draw, pixel_rays

BOARD = BoardConfig()
CORNER_TOLERANCE_PX = 0.15  # the drawing blurs edges only roughly; a mistake of numbering is ten pixels and more
LENS = Truth().fixed
RAYS = pixel_rays(LENS)


def seen_from(turn: Rotation, depth: float = 3.0):
    """The board's image at a pose, and where its corners really are."""
    points = board_points(BOARD)
    T = RigidTransform.from_components(np.array([0.0, 0.0, depth]) - turn.apply(points.mean(axis=0)), turn)
    return draw(LENS, T.as_matrix(), BOARD, RAYS).astype(np.uint8), LENS.project(T.apply(points))


@pytest.mark.parametrize("roll", [0, 45, 90, 135, 180, 225, 270, 315])
def test_corners_are_numbered_by_the_colours_whatever_the_roll(roll):
    turn = Rotation.from_euler("xyz", [20.0, 10.0, 0.0], degrees=True) * Rotation.from_euler("z", roll, degrees=True)
    image, truth = seen_from(turn)
    corners = find_corners(image, BOARD)
    assert corners is not None
    assert np.abs(corners - truth).max() < CORNER_TOLERANCE_PX


@pytest.mark.parametrize("corners", [(9, 6), (6, 9), (4, 3)])
def test_the_drawn_board_starts_at_its_first_corner_with_a_black_square(corners):
    board = BoardConfig(corners=corners)
    image = draw_board(board, 40)
    assert image.shape == (40 * (corners[1] + 3), 40 * (corners[0] + 3), 3)
    assert image[60, 60, 0] == 0  # the square diagonally outside the first corner
    found = find_corners(image, board)
    expected = board_points(board)[:, :2] / board.square * 40 + 79.5  # the first corner lies between pixels 79 and 80
    assert found is not None
    assert np.abs(found - expected).max() < CORNER_TOLERANCE_PX


def test_the_upside_down_picture_is_numbered_backwards():
    image = draw_board(BOARD, 30)
    corners, turned = find_corners(image, BOARD), find_corners(cv2.rotate(image, cv2.ROTATE_180), BOARD)
    size = np.array(image.shape[1::-1])
    assert np.abs((size - 1 - turned) - corners).max() < CORNER_TOLERANCE_PX


def test_no_board_is_none():
    assert find_corners(np.full((480, 640, 3), 128, np.uint8), BOARD) is None


@pytest.mark.parametrize("corners", [(8, 6), (9, 7)])
def test_a_board_that_looks_the_same_upside_down_is_refused(corners):
    with pytest.raises(ConfigError, match="upside down"):
        check_board(BoardConfig(corners=corners))
