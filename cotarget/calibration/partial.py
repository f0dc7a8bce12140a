"""A chessboard of which the image shows only a part, its corners told apart by a prediction.

At long focal lengths the zoom camera sees a part of any board that the fixed camera can read. The squares' colours
alone do not say which part; but where every corner should be is known to a fraction of a square by then.
"""

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.calibration.boards import CORNER_DECIMALS, SMALLEST_CONTRAST, SUBPIX_CRITERIA, WINDOW_SHARE
from cotarget.config import BoardConfig
from cotarget.geometry import Array
from cotarget.rig import Image

Mask = npt.NDArray[np.bool_]

# A mean offset beyond this share of a square is refused, long before it could be that of the next square; so is a
# scale, shear or turn beyond this, as the largest element of a matrix less 1 (predictions are up to 3 % off).
FARTHEST_SHARE = 0.35
LARGEST_STRETCH = 0.1
FEWEST_CORNERS = 6
FEWEST_AFFINE = 4  # at the first look, whose larger window leaves out those near the image's edge
# Of the corners that must be in the image, so many are found on a board that is numbered as predicted.
SMALLEST_SHARE = 0.85
SMALLEST_SPACING_PX = 10.0  # below, the four squares around a corner blur into each other
# Once corners are nearly known, a larger window adds no accuracy but loses corners near the image's edge [px].
LARGEST_WINDOW_PX = 10
ROUNDS = 4  # of predicting and looking again; two or three are usual
CAPTURE_SHARE = 0.06  # of a square, within which corners agree with an affine map at the first look
# A corner farther from a smooth map than this is another thing: [px], and of a square; the larger holds. Where few
# corners leave the map affine, it is what perspective and the lens may bend over them.
OFF_MAP_PX, OFF_MAP_SHARE = 1.0, 0.01
CURVED_CORNERS = 16  # from so many corners on, the map is curved as by perspective and a lens of unknown distortion
TRIMMINGS = 10  # of the worst corners, one share after the other
# Squares' colours are compared at these shares of a square from the corner: well inside, and near it.
QUADRANT_SHARE, NEAR_SHARE = 0.3, 0.1
# Of the contrast well inside, so much is left near the corner, or the image is too blurred: by 7 px where squares are
# 70 px large.
SMALLEST_SHARPNESS = 0.4
PIXEL_SCALE = 1000.0  # pixels are divided by it where their squares are fitted, so that no column is much larger


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
    predicted = np.asarray(predicted_px, dtype=float).reshape(-1, 2)
    grid = _grid(board)
    H = _homography(grid, predicted)
    if H is None:
        return None
    spacing = _spacing(grey, grid, H)
    if not spacing >= SMALLEST_SPACING_PX:
        return None
    start, half = predicted, round(WINDOW_SHARE * spacing)
    seen: Mask = np.zeros(len(grid), dtype=bool)
    for number in range(ROUNDS):
        inside = _inside(grey, start, half)
        found = _refined(grey, start, inside, half)
        corners = _are_corners(grey, found, grid, H)
        before, seen = seen, _agreeing(predicted, found, corners, spacing, rough=number == 0)
        if np.count_nonzero(seen) < (FEWEST_CORNERS if number else FEWEST_AFFINE):
            return None
        if number and np.array_equal(seen, before):
            break
        # Affine is enough to find the next ones by, and reaches safely beyond what is seen.
        start, half = _mapped(predicted, found, seen, curved=False), min(half, LARGEST_WINDOW_PX)
    return _checked(grey, grid, predicted, found, seen, inside, spacing)


def _checked(
    grey: Image, grid: Array, predicted: Array, found: Array, seen: Mask, expected: Mask, spacing: float
) -> Array | None:
    """The corners seen, where they are surely numbered as predicted.

    Two squares or one diagonal off, the colours are the same. But where one of the board's edges is in view, either a
    row or column is then missing, sought beyond the edge, or there is one more than there should be.
    """
    lines = [np.unique(grid[seen, axis]) for axis in (0, 1)]
    if min(len(line) for line in lines) < 2:
        return None
    if any(len(np.unique(grid[expected, axis])) > len(lines[axis]) for axis in (0, 1)):  # a whole line is missing
        return None
    if np.count_nonzero(seen) < SMALLEST_SHARE * np.count_nonzero(expected):
        return None
    offset = found[seen] - predicted[seen]
    slopes = np.linalg.lstsq(_design(predicted[seen], curved=False), offset, rcond=None)[0][1:] / PIXEL_SCALE
    if np.hypot(*offset.mean(axis=0)) > FARTHEST_SHARE * spacing or np.abs(slopes).max() > LARGEST_STRETCH:
        return None
    H = _homography(grid[seen], found[seen])
    if H is None or _goes_on(grey, grid, H):
        return None
    return np.where(seen[:, None], np.round(found, CORNER_DECIMALS), np.nan)


def _goes_on(grey: Image, grid: Array, H: Array) -> bool:
    """Whether there are corners beyond an edge of the board: then this is another part of it than was predicted."""
    last_column, last_row = grid.max(axis=0)
    u, v = np.arange(last_column + 1), np.arange(last_row + 1)
    sides = [
        np.stack(np.broadcast_arrays(across, along), axis=-1)
        for across, along in ((-1.0, v), (last_column + 1, v), (u, -1.0), (u, last_row + 1))
    ]
    for side in sides:
        places = _through(H, side)
        visible = _inside(grey, places, 1)
        beyond = _are_corners(grey, np.where(visible[:, None], places, np.nan), side, H)
        if np.count_nonzero(beyond) > max(1, np.count_nonzero(visible) / 2):
            return True
    return False


def _grid(board: BoardConfig) -> Array:
    """Column and row of every corner, (N, 2)."""
    columns, rows = board.corners
    v, u = np.mgrid[:rows, :columns].astype(float)
    return np.stack([u, v], axis=-1).reshape(-1, 2)


def _homography(grid: Array, pixels: Array) -> Array | None:
    """From squares to pixels by least squares over what is finite; None where that is too little."""
    finite = np.isfinite(pixels).all(axis=1)
    if np.count_nonzero(finite) < FEWEST_CORNERS:
        return None
    H, _ = cv2.findHomography(grid[finite], pixels[finite])
    return None if H is None or not np.isfinite(H).all() else np.asarray(H)


def _through(H: Array, grid: Array) -> Array:
    """Where squares' places (..., 2) are in the image [px]."""
    x = grid @ H[:, :2].T + H[:, 2]
    with np.errstate(all="ignore"):
        return np.where(x[..., 2:] > 0, x[..., :2] / x[..., 2:], np.nan)


def _spacing(grey: Image, grid: Array, H: Array) -> float:
    """The smallest distance of neighbouring corners within the image [px]; nan where there are none."""
    places = _through(H, grid)
    inside = _inside(grey, places, 0)
    if not inside.any():
        return float("nan")
    steps = [_through(H, grid[inside] + step) - places[inside] for step in np.eye(2)]
    return float(np.linalg.norm(steps, axis=-1).min())


def _inside(grey: Image, pixels: Array, margin: float) -> Mask:
    """Which pixels (N, 2) are inside the image by a margin [px]; not the nan ones."""
    limit = np.array(grey.shape[::-1]) - 1 - margin
    return np.asarray(((pixels >= margin) & (pixels <= limit)).all(axis=-1))


def _refined(grey: Image, start: Array, which: Mask, half: int) -> Array:
    """Move corners to the saddle points in the window around them; nan for those that did not find one."""
    found = np.full(start.shape, np.nan)
    if which.any():
        begin = start[which].astype(np.float32).reshape(-1, 1, 2)
        end = cv2.cornerSubPix(grey, begin.copy(), (half, half), (-1, -1), SUBPIX_CRITERIA)
        lost = (end == begin).all(axis=-1, keepdims=True)  # OpenCV gives back what ran out of its window
        found[which] = np.where(lost, np.nan, end).reshape(-1, 2)
    return found


def _are_corners(grey: Image, pixels: Array, grid: Array, H: Array) -> Mask:
    """Whether the image shows a corner of the board's there: two dark squares across, as its place wants, two bright.

    Args:
        grey: the image.
        pixels: where it is looked, (N, 2); nan ones are none.
        grid: column and row of the corners that should be there, (N, 2).
        H: from squares to pixels, roughly, for the size and the slant of the squares.
    """
    diagonals = np.array([[-1, -1], [1, 1], [1, -1], [-1, 1]])  # dark, dark, bright, bright around the first corner
    place = _through(H, grid)[:, None]

    def contrast(share: float) -> Array:
        arms = _through(H, grid[:, None] + share * diagonals) - place
        at = (np.nan_to_num(pixels)[:, None] + arms).astype(np.float32)
        levels = cv2.remap(smooth, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        levels = np.where((grid.sum(axis=1) % 2 == 0)[:, None], levels, 255.0 - levels)
        return levels[:, 2:].min(axis=1) - levels[:, :2].max(axis=1)

    smooth = cv2.boxFilter(grey, cv2.CV_32F, (3, 3))
    inside, near = contrast(QUADRANT_SHARE), contrast(NEAR_SHARE)
    ok = (inside > SMALLEST_CONTRAST) & (near > SMALLEST_SHARPNESS * inside)
    return np.asarray(np.isfinite(pixels).all(axis=1) & ok)


def _agreeing(predicted: Array, found: Array, corners: Mask, spacing: float, *, rough: bool) -> Mask:
    """Which corners moved from their prediction as a smooth map does; none where there is no such map."""
    which = np.flatnonzero(corners)
    kept: Mask = np.zeros(len(found), dtype=bool)
    if rough:
        if len(which) >= FEWEST_AFFINE:
            _, mask = cv2.estimateAffine2D(
                predicted[which], found[which], method=cv2.RANSAC, ransacReprojThreshold=CAPTURE_SHARE * spacing
            )
            kept[which] = mask.ravel() > 0 if mask is not None else False
        return kept
    kept[which] = True
    tolerance = max(OFF_MAP_PX, OFF_MAP_SHARE * spacing)
    for _ in range(TRIMMINGS):
        if np.count_nonzero(kept) < FEWEST_CORNERS:
            break
        curved = bool(np.count_nonzero(kept) >= CURVED_CORNERS)
        off = np.linalg.norm(found - _mapped(predicted, found, kept, curved=curved), axis=1)
        worst = np.max(off, where=kept, initial=0.0)
        if worst <= tolerance:
            break
        kept &= off < max(tolerance, worst / 2)
    return kept


def _mapped(predicted: Array, found: Array, kept: Mask, *, curved: bool) -> Array:
    """Where a map, fitted to the corners kept, takes all predictions, (N, 2) [px]."""
    middle = predicted[kept].mean(axis=0)
    design = _design(predicted - middle, curved=curved)
    coefficients = np.linalg.lstsq(design[kept], found[kept] - predicted[kept], rcond=None)[0]
    return np.asarray(predicted + design @ coefficients)


def _design(pixels: Array, *, curved: bool) -> Array:
    """Columns of an affine map, or of one that is curved by perspective and by radial distortion."""
    u, v = pixels.T / PIXEL_SCALE
    r2 = u * u + v * v
    columns = [np.ones_like(u), u, v] + ([u * u, u * v, v * v, u * r2, v * r2] if curved else [])
    return np.stack(columns, axis=1)
