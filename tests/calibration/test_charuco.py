"""A ChArUco board: one pattern for paper and simulation, numbered like OpenCV's own, and found when seen in part."""

import cv2
import numpy as np
import pytest

from cotarget.board import (
    CELLS_PER_SQUARE,
    MARKER_SHARE,
    board_points,
    cells,
    draw_board,
    marker_dictionary,
    tiles,
)
from cotarget.calibration.corners import find_corners, find_near
from cotarget.config import BoardConfig, parse_config
from cotarget.geometry import pose
from cotarget.sim.world import SimWorld

BOARD = BoardConfig("charuco", (8, 6), 0.1)  # both counts even, as no chessboard may have
POINTS = board_points(BOARD)
CORNER_TOLERANCE_PX = 0.15  # of a drawing without noise
# Noise of 2 grey levels and JPEG, squares of 23 to 34 px: usual are 0.08 to 0.09 px a coordinate.
RMS_PX, WORST_PX = 0.12, 0.6


def opencv_board(board):
    size = (board.corners[0] + 1, board.corners[1] + 1)
    return cv2.aruco.CharucoBoard(size, board.square, MARKER_SHARE * board.square, marker_dictionary())


def upright(board, square_px, begin_px):
    return board_points(board)[:, :2] / board.square * square_px + begin_px


@pytest.mark.parametrize("corners", [(8, 6), (9, 6), (3, 7)])
def test_the_pattern_is_opencvs_own(corners):
    board = BoardConfig("charuco", corners)
    size = tuple(CELLS_PER_SQUARE * (n + 1) for n in corners)
    drawn = opencv_board(board).generateImage(size) == 0
    np.testing.assert_array_equal(cells(board), drawn)
    assert np.allclose(opencv_board(board).getChessboardCorners() - board_points(board), [board.square] * 2 + [0])


@pytest.mark.parametrize("kind", ["chessboard", "charuco"])
def test_tiles_cover_the_board_once(kind):
    board = BoardConfig(kind, (4, 3))
    dark = cells(board)
    n = dark.shape[0] // 4
    count, painted = np.zeros(dark.shape, int), np.zeros(dark.shape, bool)
    for tile in tiles(board):
        x0, y0, x1, y1 = (round(n * edge) for edge in (tile.x0, tile.y0, tile.x1, tile.y1))
        count[y0:y1, x0:x1] += 1
        painted[y0:y1, x0:x1] = tile.dark
    assert (count == 1).all()
    np.testing.assert_array_equal(painted, dark)


@pytest.mark.parametrize("square_px", [40, 33])
def test_the_drawn_board_is_found_and_numbered_as_opencv_does(square_px):
    image = draw_board(BOARD, square_px)
    corners = find_corners(image, BOARD)
    np.testing.assert_allclose(corners, upright(BOARD, square_px, 2 * square_px - 0.5), atol=CORNER_TOLERANCE_PX)
    theirs, numbers, _, _ = cv2.aruco.CharucoDetector(opencv_board(BOARD)).detectBoard(image)
    assert len(numbers) == 48
    np.testing.assert_allclose(corners[numbers.ravel()], theirs.reshape(-1, 2), atol=1.0)


def test_charuco_is_found_in_part():
    image = draw_board(BOARD, 40)[:200, 150:]  # the first three rows of corners, without the first two columns
    corners = find_corners(image, BOARD).reshape(6, 8, 2)
    seen = np.isfinite(corners).all(axis=-1)
    assert seen[:3, 2:].all()
    assert not seen[4:].any()
    assert not seen[:, :1].any()
    expected = upright(BOARD, 40, 79.5).reshape(6, 8, 2) - np.array([150, 0])
    np.testing.assert_allclose(corners[seen], expected[seen], atol=CORNER_TOLERANCE_PX)
    assert find_near(image, BOARD, np.zeros((48, 2))) is not None, "the markers need no prediction"


@pytest.mark.parametrize("image", [
    np.full((480, 640), 128, np.uint8),
    draw_board(BoardConfig(), 30),
    draw_board(BOARD, 40)[:140],
    np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8),
], ids=["nothing", "a plain chessboard", "one row", "noise"])  # fmt: skip
def test_charuco_needs_more_than_one_row(image):
    assert find_corners(image, BOARD) is None


@pytest.mark.render
def test_charuco_corners_in_rendered_images_are_accurate():
    """All effects on, the board whole and reaching out of the image, up to 3 m."""
    config = parse_config({"board": {"kind": "charuco", "corners": [8, 6], "square": 0.1}})
    errors = []
    with (w := SimWorld(config)).rig as rig:
        for x, y, depth, turn in (
            (-0.4, -0.3, 2.0, (15, -20, 4)),
            (0.3, -0.2, 2.5, (-20, 10, 95)),
            (0.2, 0.3, 3.0, (0, 25, 181)),
            (0.8, 0.2, 2.0, (10, 10, 10)),
        ):
            T_fixed_board = pose([x, y, depth], turn)
            rig.board.present(T_fixed_board)
            frame = rig.fixed.read(newer_than=rig.clock.now())
            corners, truth = find_corners(frame.image, BOARD), w.truth().fixed_lens.project(T_fixed_board.apply(POINTS))
            seen = np.isfinite(corners).all(axis=1)
            inside = ((truth > 10) & (truth < np.array([629, 469]))).all(axis=1)
            assert np.count_nonzero(seen & inside) >= 0.95 * inside.sum() >= 12
            errors.append(corners[seen] - truth[seen])
    assert len(errors[-1]) < 48, "the last board reaches out of the image"
    error = np.concatenate(errors)
    assert np.sqrt(np.mean(error**2)) < RMS_PX
    assert np.abs(error).max() < WORST_PX
