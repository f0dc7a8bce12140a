"""Corners of a grid of squares, looked for near where they should be, and told from everything else."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.config import BoardConfig
from cotarget.geometry import Array
from cotarget.rig import Image

Mask = npt.NDArray[np.bool_]

# cornerSubPix looks this share of the smallest corner spacing to each side. The customary 11 px reach into the next
# corners on small boards and more than double the residuals on real photos.
WINDOW_SHARE = 0.35
SMALLEST_WINDOW_PX = 2  # below it, cornerSubPix has too few pixels to fit
# Stop when corners move less than a thousandth of a pixel, ten times below the noise of the best corners.
SUBPIX_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 0.001)
# Corners are kept to a ten-thousandth of a pixel: a hundred times below their noise, and short in a file.
CORNER_DECIMALS = 4
# Even and odd squares must differ by this many grey levels, or what was found is no chessboard.
SMALLEST_CONTRAST = 8.0
BEYOND_SHARE = 0.4  # of the board's usual contrast, which a corner beyond its edge has too, and a background has not
FEWEST_CORNERS = 6
FEWEST_AFFINE = 4  # at the first look, whose larger window leaves out those near the image's edge
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
PIXEL_SCALE = 1000.0  # pixels are divided by it where their squares are fitted, so that no column is much larger


@dataclass(frozen=True)
class Look:
    """How closely corners are looked at, in shares of a square.

    Attributes:
        window: reach of cornerSubPix to each side.
        inside: where the colours of the four squares are compared, from the corner along both axes.
        near: where they are compared again.
        sharpness: of the contrast at ``inside``, what must be left at ``near``, or the image is too blurred.
    """

    window: float
    inside: float
    near: float
    sharpness: float


# Blurred by 7 px (one standard deviation) where squares are 70 px large is too much.
PLAIN = Look(window=WINDOW_SHARE, inside=0.3, near=0.1, sharpness=0.4)
# Squares of a whole board may be as small as 7 px, and then little is left of the contrast near the corners.
SMALL = Look(window=WINDOW_SHARE, inside=0.3, near=0.3, sharpness=0.0)


@dataclass(frozen=True, eq=False)
class Found:
    """What a search came to.

    Attributes:
        corners_px: (N, 2), nan where nothing was found.
        seen: which of them are the grid's corners.
        expected: which of them were well inside the image and should have been seen.
        spacing: smallest distance of neighbours in the image [px].
    """

    corners_px: Array
    seen: Mask
    expected: Mask
    spacing: float

    def rounded(self) -> Array:
        """The corners seen, (N, 2) [px]; the others are nan."""
        return np.where(self.seen[:, None], np.round(self.corners_px, CORNER_DECIMALS), np.nan)


def search(grey: Image, grid: Array, predicted: Array, look: Look) -> Found | None:
    """Look for corners near their predictions, learn how far these are off, and look again until nothing changes.

    Args:
        grey: (H, W).
        grid: column and row of every corner, (N, 2).
        predicted: where they should be, (N, 2) [px]; nan where nobody knows.
        look: how closely to look.

    Returns:
        What was found; None where it is fewer than six corners, or they are too close together.
    """
    H = homography(grid, predicted)
    if H is None:
        return None
    spacing = spacing_px(grey, grid, H)
    if not spacing >= SMALLEST_SPACING_PX:
        return None
    start, half = predicted, max(SMALLEST_WINDOW_PX, round(look.window * spacing))
    seen: Mask = np.zeros(len(grid), dtype=bool)
    for number in range(ROUNDS):
        expected = inside(grey, start, half)
        found = refined(grey, start, expected, half)
        corners = are_corners(grey, found, grid, H, look)
        before, seen = seen, _agreeing(predicted, found, corners, spacing, rough=number == 0)
        if np.count_nonzero(seen) < (FEWEST_CORNERS if number else FEWEST_AFFINE):
            return None
        if number and np.array_equal(seen, before):
            break
        # Affine is enough to find the next ones by, and reaches safely beyond what is seen.
        start, half = mapped(predicted, found, seen, curved=False), min(half, LARGEST_WINDOW_PX)
    return Found(found, seen, expected, spacing)


def grid_of(board: BoardConfig) -> Array:
    """Column and row of every corner, (N, 2)."""
    columns, rows = board.corners
    v, u = np.mgrid[:rows, :columns].astype(float)
    return np.stack([u, v], axis=-1).reshape(-1, 2)


def homography(grid: Array, pixels: Array) -> Array | None:
    """From squares to pixels by least squares over what is finite.

    Args:
        grid: where corners are on the board [squares], (n, 2).
        pixels: where they are in the image, (n, 2) [px]; nan where one is not known.

    Returns:
        (3, 3); None where too few are known.
    """
    finite = np.isfinite(pixels).all(axis=1)
    if np.count_nonzero(finite) < FEWEST_CORNERS:
        return None
    H, _ = cv2.findHomography(grid[finite], pixels[finite])
    return None if H is None or not np.isfinite(H).all() else np.asarray(H)


def through(H: Array, grid: Array) -> Array:
    """Where squares' places (..., 2) are in the image [px]."""
    x = grid @ H[:, :2].T + H[:, 2]
    with np.errstate(all="ignore"):
        return np.where(x[..., 2:] > 0, x[..., :2] / x[..., 2:], np.nan)


def spacing_px(grey: Image, grid: Array, H: Array) -> float:
    """The smallest distance of neighbouring corners within the image [px]; nan where there are none."""
    places = through(H, grid)
    here = inside(grey, places, 0)
    if not here.any():
        return float("nan")
    steps = [through(H, grid[here] + step) - places[here] for step in np.eye(2)]
    return float(np.linalg.norm(steps, axis=-1).min())


def inside(grey: Image, pixels: Array, margin: float) -> Mask:
    """Which pixels (N, 2) are inside the image by a margin [px]; not the nan ones."""
    limit = np.array(grey.shape[::-1]) - 1 - margin
    return np.asarray(((pixels >= margin) & (pixels <= limit)).all(axis=-1))


def refined(grey: Image, start: Array, which: Mask, half: int) -> Array:
    """Move corners to the saddle points in the window around them; nan for the others.

    One that runs out of its window stays where it was, which `are_corners` tells from a corner.
    """
    found = np.full(start.shape, np.nan)
    if which.any():
        begin = start[which].astype(np.float32).reshape(-1, 1, 2)
        found[which] = cv2.cornerSubPix(grey, begin, (half, half), (-1, -1), SUBPIX_CRITERIA).reshape(-1, 2)
    return found


def are_corners(grey: Image, pixels: Array, grid: Array, H: Array, look: Look) -> Mask:
    """Whether the image shows corners of the board's there, and sharp ones; see `contrast`."""
    well_inside, near = (contrast(grey, pixels, grid, H, share) for share in (look.inside, look.near))
    with np.errstate(invalid="ignore"):
        return np.asarray((well_inside > SMALLEST_CONTRAST) & (near > look.sharpness * well_inside))


def contrast(grey: Image, pixels: Array, grid: Array, H: Array, share: float) -> Array:
    """By how much the two squares across that should be bright are brighter than the two that should be dark.

    Args:
        grey: the image.
        pixels: where corners may be, (N, 2).
        grid: column and row of the corners that should be there, (N, 2).
        H: from squares to pixels, roughly, for the size and the slant of the squares.
        share: how far from the corner it is looked, along both axes, in squares.

    Returns:
        (N,) [grey levels], from the darker bright square to the brighter dark one; nan where the pixel is.
    """
    diagonals = np.array([[-1, -1], [1, 1], [1, -1], [-1, 1]])  # dark, dark, bright, bright around the first corner
    arms = through(H, grid[:, None] + share * diagonals) - through(H, grid)[:, None]
    at = (np.nan_to_num(pixels)[:, None] + np.nan_to_num(arms)).astype(np.float32)
    smooth = cv2.boxFilter(grey, cv2.CV_32F, (3, 3))
    levels = cv2.remap(smooth, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    levels = np.where((grid.sum(axis=1) % 2 == 0)[:, None], levels, -levels)
    return np.where(np.isfinite(pixels).all(axis=1), levels[:, 2:].min(axis=1) - levels[:, :2].max(axis=1), np.nan)


def goes_on(grey: Image, grid: Array, seen: Mask, H: Array) -> bool:
    """Whether there are corners beyond an edge of the board: then this is another part of it, or of a larger one.

    Args:
        grey: the image.
        grid: column and row of the board's corners, (N, 2).
        seen: those whose contrast is taken for the board's.
        H: from squares to pixels.
    """
    usual = np.median(contrast(grey, through(H, grid[seen]), grid[seen], H, PLAIN.inside))
    last_column, last_row = grid.max(axis=0)
    u, v = np.arange(last_column + 1), np.arange(last_row + 1)
    sides = [
        np.stack(np.broadcast_arrays(across, along), axis=-1)
        for across, along in ((-1.0, v), (last_column + 1, v), (u, -1.0), (u, last_row + 1))
    ]
    for side in sides:
        places = through(H, side)
        visible = inside(grey, places, 1)
        beyond = contrast(grey, places, side, H, PLAIN.inside)[visible] > BEYOND_SHARE * usual
        if np.count_nonzero(beyond) > max(1, len(beyond) / 2):
            return True
    return False


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
        off = np.linalg.norm(found - mapped(predicted, found, kept, curved=curved), axis=1)
        worst = np.max(off, where=kept, initial=0.0)
        if worst <= tolerance:
            break
        kept &= off < max(tolerance, worst / 2)
    return kept


def mapped(predicted: Array, found: Array, kept: Mask, *, curved: bool) -> Array:
    """Where a map, fitted to the corners kept, takes all predictions, (N, 2) [px]."""
    middle = predicted[kept].mean(axis=0)
    columns = design(predicted - middle, curved=curved)
    coefficients = np.linalg.lstsq(columns[kept], found[kept] - predicted[kept], rcond=None)[0]
    return np.asarray(predicted + columns @ coefficients)


def design(pixels: Array, *, curved: bool) -> Array:
    """Columns of an affine map, or of one that is curved by perspective and by radial distortion."""
    u, v = pixels.T / PIXEL_SCALE
    r2 = u * u + v * v
    columns = [np.ones_like(u), u, v] + ([u * u, u * v, v * v, u * r2, v * r2] if curved else [])
    return np.stack(columns, axis=1)
