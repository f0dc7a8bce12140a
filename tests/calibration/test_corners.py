"""Corners: found to a fraction of a pixel, and numbered by the board and not by the image."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from cotarget.board import board_points, draw_board
from cotarget.calibration.corners import another_board, find_corners, guess_corners
from cotarget.config import BoardConfig
from cotarget.geometry import RigidTransform, Rotation
from experiments.calibration.synthetic.rig import Truth
from tests.support.synthetic_rig import draw, pixel_rays

BOARD = BoardConfig()
PHOTOS = Path(__file__).parents[3] / "shared" / "data" / "opencv_stereo"
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


MORE = ((7, 4), (8, 5), (9, 4), (10, 7), (9, 8))
LARGER = [(6, 5), *(pytest.param(it, marks=pytest.mark.slow) for it in MORE)]


@pytest.mark.parametrize("corners", LARGER)
def test_part_of_a_larger_board_is_refused(corners):
    """OpenCV's finders do report the inner part of one, which would be numbered differently in every picture."""
    board = BoardConfig(corners=corners)
    pictures = [
        seen_from(Rotation.from_euler("xyz", angles, degrees=True))[0] for angles in ([20, 10, 5], [0, -25, 80])
    ]
    for picture in (*pictures, draw_board(BOARD, 30)):
        assert find_corners(picture, board) is None
        assert guess_corners(picture) == (9, 6)


@pytest.mark.parametrize("image", [
    np.full((480, 640, 3), 128, np.uint8),
    np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8),
], ids=["grey", "noise"])  # fmt: skip
def test_image_without_a_board_gives_none(image):
    assert find_corners(image, BOARD) is None
    assert guess_corners(image) is None


@pytest.mark.parametrize("kind", ["chessboard", "charuco"])
def test_second_board_in_an_image_is_noticed(kind):
    board = BoardConfig(kind)
    one = draw_board(board, 30)
    two = np.concatenate([one, cv2.rotate(one, cv2.ROTATE_180)], axis=1)
    corners = find_corners(one, board)
    assert not another_board(one, board, corners)
    assert another_board(two, board, corners)
    assert another_board(two, board, corners + np.array([one.shape[1], 0]))


STILL_PX = (3264, 2448)  # a still of 8 MP
STILL_TOLERANCE_PX = 0.3  # the picture is drawn without antialiasing across the squares' edges


def still_with_board(outline_px):
    """A still of 8 MP: grass-like texture, a board at four corners, and a tiny picture of a board beside it."""
    width, height = STILL_PX
    rng = np.random.default_rng(3)
    coarse = cv2.resize(rng.normal(128, 50, (height // 12, width // 12)), STILL_PX, interpolation=cv2.INTER_CUBIC)
    still = np.clip(coarse + rng.normal(0, 12, (height, width)), 0, 255).astype(np.uint8)
    tiny = draw_board(BOARD, 20)[..., 0]
    still[100 : 100 + tiny.shape[0], 100 : 100 + tiny.shape[1]] = tiny
    drawn = draw_board(BOARD, 150)[..., 0]
    outer = np.array([[0, 0], [drawn.shape[1], 0], drawn.shape[::-1], [0, drawn.shape[0]]], np.float32) - 0.5
    H = cv2.getPerspectiveTransform(outer, np.array(outline_px, np.float32))
    seen = cv2.warpPerspective(np.full_like(drawn, 255), H, STILL_PX) > 0
    still = np.where(seen, cv2.warpPerspective(drawn, H, STILL_PX, flags=cv2.INTER_AREA), still)
    points = board_points(BOARD)[:, :2] / BOARD.square * 150 + 299.5
    return still, cv2.perspectiveTransform(points[None], H)[0]


@pytest.mark.parametrize(
    "outline_px",
    [((900, 500), (2700, 650), (2650, 1900), (950, 2000)), ((2900, 2300), (1100, 2200), (1000, 900), (2800, 1000))],
)
def test_board_in_a_large_still_is_found_beside_clutter(outline_px):
    still, truth = still_with_board(outline_px)
    corners = find_corners(still, BOARD)
    assert corners is not None
    assert np.abs(corners - truth).max() < STILL_TOLERANCE_PX
    assert not another_board(still, BOARD, corners)


def test_a_board_too_small_for_the_reduced_still_is_found_at_full_size():
    still = np.full(STILL_PX[::-1], 128, np.uint8)
    tiny = draw_board(BOARD, 12)[..., 0]
    still[1000 : 1000 + tiny.shape[0], 2000 : 2000 + tiny.shape[1]] = tiny
    corners = find_corners(still, BOARD, thorough=False)
    assert corners is not None
    assert np.abs(corners[0] - (2000 + 23.5, 1000 + 23.5)).max() < STILL_TOLERANCE_PX


@pytest.mark.skipif(not PHOTOS.is_dir(), reason=f"the real stereo photos are not at {PHOTOS}")
@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.slow), 6])
def test_boards_in_real_photos_are_found_and_no_others(every):
    """Its outer squares are cut short, and a screen behind it shows two small boards in some."""
    guesses = []
    for path in sorted(PHOTOS.glob("left*.jpg"))[::every]:
        image = cv2.imread(str(path))
        corners = find_corners(image, BOARD)
        assert corners is not None
        assert not another_board(image, BOARD, corners)
        assert find_corners(image, BoardConfig(corners=(6, 5))) is None
        guesses.append(guess_corners(image))
    assert set(guesses) <= {(9, 6), None}
    assert guesses.count((9, 6)) >= 0.6 * len(guesses)
