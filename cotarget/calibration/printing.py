"""A board to print, to scale."""

import io
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from cotarget.calibration.atomic import write_atomically
from cotarget.calibration.boards import check_board
from cotarget.config import BoardConfig
from cotarget.errors import ConfigError, choices
from cotarget.pattern import tiles

METRES_PER_INCH = 0.0254
MARGIN = 1.0  # white border, in squares; the corner finder needs about half of one
DOTS_PER_INCH = 300
SUFFIXES = (".pdf", ".png", ".svg")
# A page beyond this is a mistake of units, and a PNG of it would not fit into memory [m].
LARGEST = 5.0


def print_board(path: Path, board: BoardConfig) -> tuple[float, float]:
    """Write a board to scale, as PDF, SVG, or a PNG of 300 dots an inch that carries its size.

    Args:
        path: where to; the suffix chooses the format.
        board: its inner corners and the side of a square.

    Returns:
        Width and height of the page, white border included [m].

    Raises:
        ConfigError: an unknown suffix, a board that `check_board` refuses, or one larger than 5 m.
        CalibrationError: the file cannot be written.
    """
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
    told = (
        f"{board.kind}, {board.corners[0]} x {board.corners[1]} inner corners, squares of {1000 * board.square:g} mm: "
        "print at 100 %"
    )
    ax.text(columns / 2, rows + MARGIN / 2, told, ha="center", va="center", fontsize=board.square * 300)
    page = io.BytesIO()  # matplotlib ends a PDF that a full disk cuts short in errors of its own
    figure.savefig(page, format=path.suffix.lower().removeprefix("."), dpi=DOTS_PER_INCH)
    write_atomically(path, page.getvalue())
    return width, height
