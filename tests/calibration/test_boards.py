"""Boards: a ChArUco is numbered as by OpenCV and found when seen in part; a printed board has its size on paper."""

import re

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
    print_board,
)
from cotarget.calibration.corners import find_corners, find_near
from cotarget.config import BoardConfig, parse_config
from cotarget.errors import ConfigError
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
    np.full((480, 640), 128, np.uint8), draw_board(BoardConfig(), 30), draw_board(BOARD, 40)[:140],
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


PRINTED = BoardConfig(corners=(7, 4), square=0.02)
PIXELS_PER_SQUARE = 0.02 / 0.0254 * 300
CORNER_PX = 0.2  # 0.02 mm on paper: edges within a pixel are drawn in few levels, and the finder errs too


def test_pdf_of_a_board_has_its_true_size(tmp_path):
    """8 x 5 squares of 20 mm with a square of border: 200 x 140 mm, in points of 1/72 inch."""
    assert print_board(tmp_path / "board.pdf", PRINTED) == pytest.approx((0.2, 0.14))
    box = re.search(rb"/MediaBox \[ *([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+)", (tmp_path / "board.pdf").read_bytes())
    points = [float(v) for v in box.groups()]
    assert points == pytest.approx([0, 0, 200 / 25.4 * 72, 140 / 25.4 * 72], abs=0.01)


@pytest.mark.parametrize("board", [PRINTED, BoardConfig("charuco", (6, 4), 0.02)], ids=lambda board: board.kind)
def test_png_of_a_board_is_found_at_its_true_size(tmp_path, board):
    print_board(tmp_path / "board.png", board)
    corners = find_corners(cv2.imread(str(tmp_path / "board.png")), board)
    expected = board_points(board)[:, :2] / board.square * PIXELS_PER_SQUARE
    # Where the page begins is cut to whole pixels; how far the corners are apart is not.
    np.testing.assert_allclose(corners - corners[0], expected, atol=CORNER_PX)
    np.testing.assert_allclose(corners[0], 2 * PIXELS_PER_SQUARE - 0.5, atol=1.0)
    assert [p.name for p in tmp_path.iterdir()] == ["board.png"]


@pytest.mark.parametrize(("name", "board", "said"), [
    ("board.doc", PRINTED, "board.doc"),
    ("board.pdf", BoardConfig(corners=(6, 6)), "board.corners"),
    ("board.pdf", BoardConfig(corners=(9, 6), square=25.0), "metres"),
])  # fmt: skip
def test_print_board_refuses_unknown_formats_and_impossible_boards(tmp_path, name, board, said):
    with pytest.raises(ConfigError, match=re.escape(said)):
        print_board(tmp_path / name, board)
    assert not list(tmp_path.iterdir())
