"""The board: its points, its picture, and its corners in an image, numbered the same way from every side.

The board's frame: origin at the first inner corner, x along the columns, y along the rows, z into the board, away
from the viewer. The square diagonally outside the first corner is black. With one odd and one even count of corners
the opposite square is white, so that the colours alone tell a board from the same board upside down; a ChArUco board is
told by its markers, whatever the counts.

A ChArUco board's corners: its markers say which part of it is seen, so that it may reach beyond the image.

Corners of a grid of squares, looked for near where they should be, and told from everything else.

A chessboard of which the image shows only a part, its corners told apart by a prediction.

At long focal lengths the zoom camera sees a part of any board that the fixed camera can read. The squares' colours
alone do not say which part; but where every corner should be is known to a fraction of a square by then.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.board import MARKER_SHARE, board_outline, marker_dictionary
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
class FoundCorners:
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


def search(grey: Image, grid: Array, predicted: Array, look: Look) -> FoundCorners | None:
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
    return FoundCorners(found, seen, expected, spacing)


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


# --- charuco ---

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


# --- partial ---

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


def _as_predicted(grey: Image, grid: Array, predicted: Array, found: FoundCorners) -> bool:
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


FILLABLE_PX = (-10000.0, 10000.0)  # OpenCV paints no polygons whose corners are much farther out
LARGEST_BEND = 0.4  # of a square, of the corners from a plane's picture; a lens bends real ones by 0.3
SMALLEST_RIGHT = 0.7  # of the corners of any row or column, whose squares have the colours that they should


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
