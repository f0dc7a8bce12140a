"""What is printed on a calibration board: one pattern for paper, pictures, finders and the simulation.

A chessboard's squares are black and white in turn, the first one, diagonally outside the first inner corner, black.
A ChArUco board is the same chessboard with a marker in each white square, the numbers counting along the rows.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.config import BoardConfig
from cotarget.errors import ConfigError

# Another dictionary than that of the targets' markers (4x4, 50), so that neither is ever taken for the other.
DICTIONARY = cv2.aruco.DICT_5X5_250
MARKER_CELLS = 7  # of a side: five of code, and a black one to each side
MARKER_SHARE = 0.7  # of a square's side; the rest is white around it
CELLS_PER_SQUARE = 20  # so that both the markers' cells and the white around them are whole: 2 and 3

Cells = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Tile:
    """A rectangle of one colour, from (x0, y0) to (x1, y1), in squares from the board's first outer corner."""

    x0: float
    y0: float
    x1: float
    y1: float
    dark: bool


def marker_dictionary() -> "cv2.aruco.Dictionary":
    """The markers of a ChArUco board."""
    return cv2.aruco.getPredefinedDictionary(DICTIONARY)


def check_markers(board: BoardConfig) -> None:
    """Refuse a ChArUco board of more squares than there are markers.

    Raises:
        ConfigError: it has too many.
    """
    (columns, rows), most = board.corners, len(marker_dictionary().bytesList)
    if (columns + 1) * (rows + 1) // 2 > most:
        raise ConfigError(f"board.corners: {columns}x{rows} needs more than the {most} markers that there are")


def cells(board: BoardConfig) -> Cells:
    """Which cells are dark, row by row: a chessboard's squares, or 20 x 20 in each square of a ChArUco board.

    Raises:
        ConfigError: a ChArUco board has more squares than there are markers.
    """
    columns, rows = (n + 1 for n in board.corners)
    v, u = np.mgrid[:rows, :columns]
    dark = (u + v) % 2 == 0
    if board.kind == "chessboard":
        return dark
    check_markers(board)
    n, side = CELLS_PER_SQUARE, round(MARKER_SHARE * CELLS_PER_SQUARE)
    first = (n - side) // 2
    fine = np.kron(dark, np.ones((n, n), bool))
    dictionary = marker_dictionary()
    for number, (row, column) in enumerate(np.argwhere(~dark)):
        marker = dictionary.generateImageMarker(number, MARKER_CELLS) == 0
        top, left = row * n + first, column * n + first
        fine[top : top + side, left : left + side] = np.kron(marker, np.ones((side // MARKER_CELLS,) * 2, bool))
    return fine


def tiles(board: BoardConfig) -> list[Tile]:
    """Cover the board with rectangles of one colour each, none over another, and few of them."""
    dark = cells(board)
    per_square = dark.shape[0] // (board.corners[1] + 1)
    left = np.ones(dark.shape, dtype=bool)
    found = []
    for row, column in np.ndindex(dark.shape):
        if not left[row, column]:
            continue
        same = left & (dark == dark[row, column])
        right = column + _run(same[row, column:])
        bottom = row + _run(same[row:, column:right].all(axis=1))
        left[row:bottom, column:right] = False
        x0, y0, x1, y1 = (edge / per_square for edge in (column, row, right, bottom))
        found.append(Tile(x0, y0, x1, y1, bool(dark[row, column])))
    return found


def _run(same: Cells) -> int:
    """How many of the first are True."""
    return len(same) if same.all() else int(np.argmin(same))
