"""A ChArUco board's corners: its markers say which part of it is seen, so that it may reach beyond the image."""

import cv2
import numpy as np

from cotarget.calibration.gridsearch import (
    CURVED_CORNERS,
    FEWEST_AFFINE,
    Look,
    grid_of,
    homography,
    mapped,
    search,
    through,
)
from cotarget.config import BoardConfig
from cotarget.geometry import Array
from cotarget.pattern import MARKER_SHARE, marker_dictionary
from cotarget.rig import Image

GAP = (1 - MARKER_SHARE) / 2  # white between a corner and the marker, in squares
# Nothing may reach into the markers: with a window of 0.35 corners are off by 0.15 to 0.23 px, with this by 0.1.
BETWEEN_MARKERS = Look(window=GAP, inside=0.8 * GAP, near=0.8 * GAP, sharpness=0.0)
# Small markers are read twice as far away in an image that is enlarged by 2, but in four times the time.
ENLARGED = (1, 2)
ENOUGH = 0.5  # of the board's corners, from which on a larger image is not tried
# Markers' cells are mostly edges when small: leave out more of them than the usual 0.13, and trust the code, which
# corrects two bits, to do so.
IGNORED_MARGIN, CORRECTION = 0.3, 1.0


def find_charuco(grey: Image, board: BoardConfig, *, thorough: bool = True) -> Array | None:
    """Find the corners of a ChArUco board that may be seen in part.

    Args:
        grey: (H, W).
        board: a ChArUco board.
        thorough: whether to look for small markers even where no large ones are seen.

    Returns:
        Corners row by row, (columns * rows, 2) [px], nan where none is seen; None where fewer than six are, or all are
        in one row or column.
    """
    grid = grid_of(board)
    rough = _by_markers(grey, board, thorough)
    read = np.asarray(np.isfinite(rough).all(axis=1))
    if np.count_nonzero(read) < FEWEST_AFFINE:
        return None
    H = homography(grid, rough)
    if H is None:
        return None
    # Corners without two readable markers beside them are looked for where the others say that they are.
    straight = through(H, grid)
    elsewhere = mapped(straight, rough, read, curved=bool(np.count_nonzero(read) >= CURVED_CORNERS))
    found = search(grey, grid, np.where(read[:, None], rough, elsewhere), BETWEEN_MARKERS)
    if found is None or any(len(np.unique(grid[found.seen, axis])) < 2 for axis in (0, 1)):
        return None
    return found.rounded()


def _by_markers(grey: Image, board: BoardConfig, thorough: bool) -> Array:
    """Corners beside two markers that are read, roughly, (N, 2) [px]; nan for the others."""
    columns, rows = board.corners
    parameters = cv2.aruco.DetectorParameters()
    parameters.perspectiveRemoveIgnoredMarginPerCell = IGNORED_MARGIN
    parameters.errorCorrectionRate = CORRECTION
    pattern = cv2.aruco.CharucoBoard((columns + 1, rows + 1), 1.0, MARKER_SHARE, marker_dictionary())
    detector = cv2.aruco.CharucoDetector(pattern, cv2.aruco.CharucoParameters(), parameters)
    most = np.full((columns * rows, 2), np.nan)
    for factor in ENLARGED:
        large = grey if factor == 1 else cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
        corners, numbers, _, markers = detector.detectBoard(large)
        if numbers is not None and len(numbers) > np.count_nonzero(np.isfinite(most[:, 0])):
            most = np.full((columns * rows, 2), np.nan)
            most[numbers.ravel()] = (corners.reshape(-1, 2) + 0.5) / factor - 0.5
        enough = np.count_nonzero(np.isfinite(most[:, 0])) >= ENOUGH * len(most)
        if enough or (markers is None and not thorough):
            break
    return most
