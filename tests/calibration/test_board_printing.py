"""A printed board: its size on paper, and that the finder reads it as the board it is."""

import re

import cv2
import numpy as np
import pytest

from cotarget.board import board_points, print_board
from cotarget.calibration.corners import find_corners
from cotarget.config import BoardConfig
from cotarget.errors import ConfigError
from tests.support.full_disk import SAID, full_disk

BOARD = BoardConfig(corners=(7, 4), square=0.02)
PIXELS_PER_SQUARE = 0.02 / 0.0254 * 300
CORNER_PX = 0.2  # 0.02 mm on paper: edges within a pixel are drawn in few levels, and the finder errs too


def test_pdf_of_a_board_has_its_true_size(tmp_path):
    """8 x 5 squares of 20 mm with a square of border: 200 x 140 mm, in points of 1/72 inch."""
    assert print_board(tmp_path / "board.pdf", BOARD) == pytest.approx((0.2, 0.14))
    box = re.search(rb"/MediaBox \[ *([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+)", (tmp_path / "board.pdf").read_bytes())
    points = [float(v) for v in box.groups()]
    assert points == pytest.approx([0, 0, 200 / 25.4 * 72, 140 / 25.4 * 72], abs=0.01)


@pytest.mark.parametrize("board", [BOARD, BoardConfig("charuco", (6, 4), 0.02)], ids=lambda board: board.kind)
def test_png_of_a_board_is_found_at_its_true_size(tmp_path, board):
    print_board(tmp_path / "board.png", board)
    corners = find_corners(cv2.imread(str(tmp_path / "board.png")), board)
    expected = board_points(board)[:, :2] / board.square * PIXELS_PER_SQUARE
    # Where the page begins is cut to whole pixels; how far the corners are apart is not.
    np.testing.assert_allclose(corners - corners[0], expected, atol=CORNER_PX)
    np.testing.assert_allclose(corners[0], 2 * PIXELS_PER_SQUARE - 0.5, atol=1.0)
    assert [p.name for p in tmp_path.iterdir()] == ["board.png"]


@pytest.mark.parametrize(("name", "board", "said"), [
    ("board.doc", BOARD, "board.doc"),
    ("board.pdf", BoardConfig(corners=(6, 6)), "board.corners"),
    ("board.pdf", BoardConfig(corners=(9, 6), square=25.0), "metres"),
])  # fmt: skip
def test_print_board_refuses_unknown_formats_and_impossible_boards(tmp_path, name, board, said):
    with pytest.raises(ConfigError, match=re.escape(said)):
        print_board(tmp_path / name, board)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".pdf", ".svg", ".png"])
@pytest.mark.parametrize("room", [0, 4096])
def test_full_disk_leaves_no_partial_file(tmp_path, suffix, room):
    path = tmp_path / f"board{suffix}"
    with full_disk(room), pytest.raises(ConfigError, match=re.escape(f"{path}: cannot be written: {SAID}")):
        print_board(path, BoardConfig(corners=(9, 6), square=0.025))
    assert not list(tmp_path.iterdir())
