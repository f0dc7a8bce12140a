"""The board: its points, its picture, and its corners in an image, numbered the same way from every side.

The board's frame: origin at the first inner corner, x along the columns, y along the rows, z into the board, away
from the viewer. The square diagonally outside the first corner is black. With one odd and one even count of corners
the opposite square is white, so that the colours alone tell a board from the same board upside down; a ChArUco board is
told by its markers, whatever the counts.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from cotarget.calibration.charuco import find_charuco
from cotarget.calibration.gridsearch import (
    CORNER_DECIMALS,
    SMALL,
    SMALLEST_CONTRAST,
    SMALLEST_WINDOW_PX,
    SUBPIX_CRITERIA,
    WINDOW_SHARE,
    are_corners,
    goes_on,
    grid_of,
    homography,
    through,
)
from cotarget.config import BoardConfig
from cotarget.geometry import Array
from cotarget.pattern import cells, check_markers
from cotarget.rig import Image
from cotarget.rigchecks import check_corners

FILLABLE_PX = (-10000.0, 10000.0)  # OpenCV paints no polygons whose corners are much farther out
LARGEST_BEND = 0.4  # of a square, of the corners from a plane's picture; a lens bends real ones by 0.3
SMALLEST_RIGHT = 0.7  # of the corners of any row or column, whose squares have the colours that they should


def check_board(board: BoardConfig) -> None:
    """Refuse a board that looks the same upside down, or has more squares than there are markers.

    Raises:
        ConfigError: there are too few or too many corners; or, of a chessboard, both counts are even or both odd.
    """
    check_corners(board)
    if board.kind == "charuco":
        check_markers(board)


def board_points(board: BoardConfig) -> Array:
    """The inner corners in the board's frame [m], row by row, (columns * rows, 3)."""
    columns, rows = board.corners
    v, u = np.mgrid[:rows, :columns]
    return np.stack([u, v, np.zeros_like(u)], axis=-1).reshape(-1, 3) * board.square


def board_outline(board: BoardConfig, squares: float = 1.0) -> Array:
    """The four outer corners of the board [m], (4, 3), ``squares`` squares outside the inner corners."""
    columns, rows = board.corners
    low, right, bottom = -squares, columns - 1 + squares, rows - 1 + squares
    return np.array([[low, low, 0], [right, low, 0], [right, bottom, 0], [low, bottom, 0]]) * board.square


def draw_board(board: BoardConfig, square_px: int, margin_px: int | None = None) -> Image:
    """Draw the board to be printed or to be used as a texture.

    Args:
        board: (columns + 1) x (rows + 1) squares are drawn.
        square_px: side of a square [px].
        margin_px: white margin [px], which finders need; a square's side where it is not given.

    Returns:
        A BGR image, (H, W, 3), black or white.
    """
    check_board(board)
    dark = cells(board)
    width, height = (square_px * (n + 1) for n in board.corners)
    # From the middle of each pixel, so that an edge is off by half a pixel at most where cells are not whole pixels.
    rows, columns = (
        ((np.arange(size) + 0.5) * count / size).astype(int)
        for size, count in ((height, dark.shape[0]), (width, dark.shape[1]))
    )
    margin = square_px if margin_px is None else margin_px
    picture = np.pad(np.where(dark[np.ix_(rows, columns)], 0, 255).astype(np.uint8), margin, constant_values=255)
    return np.repeat(picture[:, :, None], 3, axis=2)


def find_corners(image: Image, board: BoardConfig, *, thorough: bool = True) -> Array | None:
    """Find the inner corners of the board: all of a chessboard, or those that are seen of a ChArUco board.

    Args:
        image: (H, W, 3) BGR, or grey (H, W).
        board: a chessboard must have one odd and one even count of corners.
        thorough: whether to try every finder; the first alone finds nearly all boards, in a tenth of the time that
            it takes to be sure that there is none.

    Returns:
        Corners from the board's first, row by row, (columns * rows, 2) [px]; None where no whole chessboard is seen.
        Corners of a ChArUco board that are not seen are nan; None where fewer than six are, or all in one line.
    """
    grey = np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    if board.kind == "charuco":
        return find_charuco(grey, board, thorough=thorough)
    for search in SEARCHES if thorough else SEARCHES[:1]:
        found = search(grey, board.corners)
        if found is None:
            continue
        numbered = _number(grey, found, board.corners)
        if numbered is not None and _is_whole(grey, numbered, board):
            return np.round(_refine(grey, numbered, board.corners), CORNER_DECIMALS)
    return None


def another_board(image: Image, board: BoardConfig, corners_px: Array) -> bool:
    """Whether a picture shows a second board of the same kind and size, by the fastest finder alone.

    Args:
        image: (H, W, 3) BGR, or grey (H, W).
        board: the board.
        corners_px: where one was found, (columns * rows, 2) [px], nan for corners that are not seen.
    """
    grey = np.array(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    H = homography(grid_of(board), corners_px)
    if H is None:
        return False
    outline = through(H, board_outline(board)[:, :2] / board.square)
    if not np.isfinite(outline).all():
        return False
    cv2.fillConvexPoly(grey, np.round(np.clip(outline, *FILLABLE_PX)).astype(np.int32), float(np.median(grey)))
    return find_corners(grey, board, thorough=False) is not None


def guess_corners(image: Image) -> tuple[int, int] | None:
    """Guess the inner corners, columns and rows, of whatever chessboard a picture shows, for an error's message.

    Args:
        image: (H, W, 3) BGR, or grey (H, W).

    Returns:
        The larger count first; None where no chessboard is surely seen.
    """
    grey = np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    ok, _, layout = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), cv2.CALIB_CB_LARGER)
    if not ok:
        return None
    rows, columns = sorted(layout.shape)
    found = SEARCHES[0](grey, (columns, rows))
    numbered = None if found is None else _number(grey, found, (columns, rows))
    board = BoardConfig(corners=(columns, rows))
    return (columns, rows) if numbered is not None and _is_whole(grey, numbered, board) else None


def smallest_spacing(corners_px: Array, corners: Sequence[int]) -> float:
    """The smallest distance between neighbouring corners that are seen [px]; nan where no neighbours are."""
    grid = corners_px.reshape(corners[1], corners[0], 2)
    distances = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1) for axis in (0, 1)]
    return float(np.fmin.reduce(np.concatenate(distances, axis=None)))


def _number(grey: Image, corners_px: Array, corners: tuple[int, int]) -> Array | None:
    """Turn the order so that the first corner is the board's, by handedness and then by the squares' colours."""
    columns, rows = corners
    grid = corners_px.reshape(rows, columns, 2)
    along, down = grid[:, -1].mean(0) - grid[:, 0].mean(0), grid[-1].mean(0) - grid[0].mean(0)
    if along[0] * down[1] - along[1] * down[0] < 0:  # seen from its front, x turns clockwise into y
        grid = grid[:, ::-1]
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    map_u, map_v = (centres[..., i].astype(np.float32) for i in (0, 1))
    colours = cv2.remap(grey, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)
    v, u = np.mgrid[: rows - 1, : columns - 1]
    even = (u + v) % 2 == 0
    contrast = colours[~even].mean() - colours[even].mean()  # positive when the first square is dark
    if abs(contrast) < SMALLEST_CONTRAST:
        return None
    if contrast < 0:
        grid = grid[::-1, ::-1]
    return grid.reshape(-1, 2)


def _is_whole(grey: Image, corners_px: Array, board: BoardConfig) -> bool:
    """Whether corners are those of the whole board: finders also report part of a larger one, or a row too many."""
    grid = grid_of(board)
    H = homography(grid, corners_px)
    if H is None:
        return False
    off = np.linalg.norm(through(H, grid) - corners_px, axis=1)
    if not off.max() < LARGEST_BEND * smallest_spacing(corners_px, board.corners):
        return False
    columns, rows = board.corners
    right = are_corners(grey, corners_px, grid, H, SMALL).reshape(rows, columns)
    lines = (*right.mean(axis=0), *right.mean(axis=1))
    return min(lines) > SMALLEST_RIGHT and not goes_on(grey, grid, right.ravel(), H)


def _refine(grey: Image, corners_px: Array, corners: tuple[int, int]) -> Array:
    """Move the corners to the saddle points of the image."""
    half = max(SMALLEST_WINDOW_PX, round(WINDOW_SHARE * smallest_spacing(corners_px, corners)))
    start = corners_px.astype(np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(grey, start, (half, half), (-1, -1), SUBPIX_CRITERIA)
    return np.asarray(refined, dtype=float).reshape(-1, 2)


def _sector_based(flags: int) -> "Search":
    def search(grey: Image, corners: tuple[int, int]) -> Array | None:
        ok, found = cv2.findChessboardCornersSB(grey, corners, flags=flags)
        return np.asarray(found, dtype=float).reshape(-1, 2) if ok else None  # (N, 1, 2) in OpenCV 4, (N, 2) in 5

    return search


def _quadrangles(grey: Image, corners: tuple[int, int]) -> Array | None:
    # Without CALIB_CB_FAST_CHECK, which finds nothing when squares are small.
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE
    ok, found = cv2.findChessboardCorners(grey, corners, flags=flags)
    return np.asarray(found, dtype=float).reshape(-1, 2) if ok else None


# Finders to about a pixel, the fastest first; what one misses, another often sees (20, 25, 100 ms and up at 640x480).
Search = Callable[[Image, tuple[int, int]], Array | None]
SEARCHES: tuple[Search, ...] = (
    _sector_based(0),
    _sector_based(cv2.CALIB_CB_NORMALIZE_IMAGE),
    _sector_based(cv2.CALIB_CB_ACCURACY),
    _quadrangles,
)
