"""Pattern and geometry of the calibration board: chessboard or ChArUco.

The corner finders, the printed board and the simulation use this one definition. The squares of a chessboard alternate,
and the first one, diagonally outside the first inner corner, is black. A ChArUco board is the same chessboard with a
marker in each white square, numbered along the rows.
"""

import io
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.config import BoardConfig, check_corners
from cotarget.errors import ConfigError, choices
from cotarget.files import write_atomically
from cotarget.geometry import Array
from cotarget.rig import Image

METRES_PER_INCH = 0.0254
MARGIN = 1.0  # width of the white border, in squares; the corner finder needs about half a square
DOTS_PER_INCH = 300
SUFFIXES = (".pdf", ".png", ".svg")
# Largest side of a page [m]. A larger one is a mistake of units, and its PNG would not fit into memory.
LARGEST = 5.0


def print_board(path: Path, board: BoardConfig) -> tuple[float, float]:
    """Write a board to scale for printing, as PDF, SVG, or PNG with 300 dots per inch.

    The PNG carries its resolution.

    Args:
        path: file to write; its suffix chooses the format.
        board: the board's kind, inner corners and side of a square.

    Returns:
        Width and height of the page, white border included [m].

    Raises:
        ConfigError: the suffix is unknown, `check_board` refuses the board, the page is larger than 5 m, or the file
            cannot be written.
    """
    # Imported here: every command imports this module, and only this function needs matplotlib.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"{path}: cannot be drawn as '{path.suffix}'; the formats are: {choices(SUFFIXES)}")
    check_board(board)
    columns, rows = (n + 1 for n in board.corners)
    width, height = ((n + 2 * MARGIN) * board.square for n in (columns, rows))
    if max(width, height) > LARGEST:
        raise ConfigError(
            f"a board of {width:g} x {height:g} m is larger than {LARGEST:g} m; squares are given in metres"
        )
    figure = Figure(figsize=(width / METRES_PER_INCH, height / METRES_PER_INCH), dpi=DOTS_PER_INCH)
    FigureCanvasAgg(figure)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set(xlim=(-MARGIN, columns + MARGIN), ylim=(rows + MARGIN, -MARGIN))
    ax.axis("off")
    for tile in tiles(board):
        if tile.dark:
            size = tile.x1 - tile.x0, tile.y1 - tile.y0
            ax.add_patch(Rectangle((tile.x0, tile.y0), *size, color="black", linewidth=0, snap=False))
    label = (
        f"{board.kind}, {board.corners[0]} x {board.corners[1]} inner corners, squares of {1000 * board.square:g} mm: "
        "print at 100 %"
    )
    ax.text(columns / 2, rows + MARGIN / 2, label, ha="center", va="center", fontsize=board.square * 300)
    page = io.BytesIO()  # on a full disk matplotlib fails to close a PDF with errors of its own
    figure.savefig(page, format=path.suffix.lower().removeprefix("."), dpi=DOTS_PER_INCH)
    write_atomically(path, page.getvalue())
    return width, height


def check_board(board: BoardConfig) -> None:
    """Refuse a board that looks the same upside down, or that needs more markers than the dictionary holds."""
    check_corners(board)
    if board.kind == "charuco":
        check_markers(board)


def board_points(board: BoardConfig) -> Array:
    """Compute the inner corners in the board's frame [m], row by row, (columns * rows, 3)."""
    columns, rows = board.corners
    v, u = np.mgrid[:rows, :columns]
    return np.stack([u, v, np.zeros_like(u)], axis=-1).reshape(-1, 3) * board.square


def board_outline(board: BoardConfig, squares: float = 1.0) -> Array:
    """Compute the four corners of a rectangle ``squares`` squares outside the inner corners [m], (4, 3)."""
    columns, rows = board.corners
    low, right, bottom = -squares, columns - 1 + squares, rows - 1 + squares
    return np.array([[low, low, 0], [right, low, 0], [right, bottom, 0], [low, bottom, 0]]) * board.square


def draw_board(board: BoardConfig, square_px: int, margin_px: int | None = None) -> Image:
    """Draw the board as an image, for printing or as a texture.

    Args:
        board: a board of (columns + 1) x (rows + 1) squares.
        square_px: side of a square [px].
        margin_px: white margin [px], which corner finders need; None for the side of a square.

    Returns:
        A black and white BGR image, (H, W, 3).
    """
    check_board(board)
    dark = cells(board)
    width, height = (square_px * (n + 1) for n in board.corners)
    # Sampled at the middle of each pixel: where a cell is not a whole number of pixels, edges are at most half a pixel
    # off.
    rows, columns = (
        ((np.arange(size) + 0.5) * count / size).astype(int)
        for size, count in ((height, dark.shape[0]), (width, dark.shape[1]))
    )
    margin = square_px if margin_px is None else margin_px
    picture = np.pad(np.where(dark[np.ix_(rows, columns)], 0, 255).astype(np.uint8), margin, constant_values=255)
    return np.repeat(picture[:, :, None], 3, axis=2)


# The targets' markers use another dictionary (4x4, 50), so that neither kind is mistaken for the other.
DICTIONARY = cv2.aruco.DICT_5X5_250
MARKER_CELLS = 7  # cells along a marker's side: five of code, and a black one at each end
MARKER_SHARE = 0.7  # side of a marker over the side of a square; the rest is white
CELLS_PER_SQUARE = 20  # with 20, a marker's cell is 2 and the white around the marker 3 cells wide
Cells = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Tile:
    """Rectangle of one colour from (x0, y0) to (x1, y1), in squares from the board's first outer corner."""

    x0: float
    y0: float
    x1: float
    y1: float
    dark: bool


def marker_dictionary() -> "cv2.aruco.Dictionary":
    """Return the ArUco dictionary of the ChArUco board's markers."""
    return cv2.aruco.getPredefinedDictionary(DICTIONARY)


def check_markers(board: BoardConfig) -> None:
    """Refuse a ChArUco board that needs more markers than the dictionary holds."""
    (columns, rows), most = board.corners, len(marker_dictionary().bytesList)
    if (columns + 1) * (rows + 1) // 2 > most:
        raise ConfigError(f"board.corners: {columns}x{rows} needs more than the {most} markers that there are")


def cells(board: BoardConfig) -> Cells:
    """Compute which cells of a board are dark, row by row.

    A cell is a square of a chessboard; each square of a ChArUco board has 20 x 20 cells.
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
    """Cover the board with few rectangles of one colour each that do not overlap."""
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
    """Count the leading True values."""
    return len(same) if same.all() else int(np.argmin(same))
