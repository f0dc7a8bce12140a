"""A chessboard of which the image shows only a part, its corners told apart by a prediction.

At long focal lengths the zoom camera sees a part of any board that the fixed camera can read. The squares' colours
alone do not say which part; but where every corner should be is known to a fraction of a square by then.
"""

import cv2
import numpy as np

from cotarget.calibration.charuco import find_charuco
from cotarget.calibration.gridsearch import (
    PIXEL_SCALE,
    PLAIN,
    Found,
    design,
    goes_on,
    grid_of,
    homography,
    search,
)
from cotarget.config import BoardConfig
from cotarget.geometry import Array
from cotarget.rig import Image

# A mean offset beyond this share of a square is refused, long before it could be that of the next square; so is a
# scale, shear or turn beyond this, as the largest element of a matrix less 1 (predictions are up to 3 % off).
FARTHEST_SHARE = 0.35
LARGEST_STRETCH = 0.1
# Of the corners that must be in the image, so many are found on a board that is numbered as predicted.
SMALLEST_SHARE = 0.85


def find_near(image: Image, board: BoardConfig, predicted_px: Array) -> Array | None:
    """Find the corners of a chessboard that may be seen in part, near where they are predicted.

    Args:
        image: (H, W, 3) BGR, or grey (H, W).
        board: a chessboard.
        predicted_px: where each corner should be, row by row, (columns * rows, 2) [px]: off by less than a third of a
            square, by nearly the same at all corners. May be nan, or outside the image.

    Returns:
        Corners row by row, (columns * rows, 2) [px], nan where none is seen; None where fewer than six are, or where
        what is seen is not surely the board as it was predicted.
    """
    grey = np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    if board.kind == "charuco":  # its markers number it better than any prediction
        return find_charuco(grey, board)
    grid, predicted = grid_of(board), np.asarray(predicted_px, dtype=float).reshape(-1, 2)
    found = search(grey, grid, predicted, PLAIN)
    if found is None or not _as_predicted(grey, grid, predicted, found):
        return None
    return found.rounded()


def _as_predicted(grey: Image, grid: Array, predicted: Array, found: Found) -> bool:
    """Whether the corners seen are surely numbered as predicted.

    Two squares or one diagonal off, the colours are the same. But where one of the board's edges is in view, either a
    row or column is then missing, sought beyond the edge, or there is one more than there should be.
    """
    seen, expected = found.seen, found.expected
    lines = [np.unique(grid[seen, axis]) for axis in (0, 1)]
    if min(len(line) for line in lines) < 2:
        return False
    if any(len(np.unique(grid[expected, axis])) > len(lines[axis]) for axis in (0, 1)):  # a whole line is missing
        return False
    if np.count_nonzero(seen) < SMALLEST_SHARE * np.count_nonzero(expected):
        return False
    offset = found.corners_px[seen] - predicted[seen]
    slopes = np.linalg.lstsq(design(predicted[seen], curved=False), offset, rcond=None)[0][1:] / PIXEL_SCALE
    if np.hypot(*offset.mean(axis=0)) > FARTHEST_SHARE * found.spacing or np.abs(slopes).max() > LARGEST_STRETCH:
        return False
    H = homography(grid[seen], found.corners_px[seen])
    return H is not None and not goes_on(grey, grid, seen, H)
