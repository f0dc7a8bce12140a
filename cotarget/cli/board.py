"""Write a calibration board to print, to scale: `cotarget board --out board.pdf --board 9x6 --square 0.025`."""

import argparse

from cotarget.cli.common import BOARD_KINDS, add_file, board_corners, check_outputs, positive
from cotarget.errors import ConfigError


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_file(parser, "--out", "file to write: .pdf, .svg or .png", required=True)
    about = "kind of board; charuco has markers (chessboard)"
    parser.add_argument("--kind", choices=BOARD_KINDS, default=BOARD_KINDS[0], help=about)
    parser.add_argument("--board", type=board_corners, default=(9, 6), metavar="CxR", help="inner corners (9x6)")
    parser.add_argument("--square", type=positive, default=0.025, metavar="M", help="side of a square [m] (0.025)")


def run(options: argparse.Namespace) -> None:
    """Write the board, and print what rig.toml has to say of it."""
    from cotarget.board import check_board, print_board
    from cotarget.config import BoardConfig, check_square

    check_outputs([options.out], [])
    check_square(options.square, "--square")
    made = BoardConfig(options.kind, options.board, options.square)
    try:
        check_board(made)
    except ConfigError as error:
        raise ConfigError(f"--board: {str(error).removeprefix('board.corners: ')}") from None
    width, height = print_board(options.out, made)
    print(
        f"{options.out}: {1000 * width:.1f} x {1000 * height:.1f} mm with its white border; print it at 100 %, stick it"
    )
    print("on something flat, and measure ten squares before you trust it; what rig.toml has to say of it:")
    print(f'[board]\nkind = "{options.kind}"\ncorners = {list(options.board)}\nsquare = {options.square:g}')
