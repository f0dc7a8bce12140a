"""Corner detection: find a board's inner corners in an image to subpixel accuracy, and number them.

The board's frame has its origin at the first inner corner, x along the columns, y along the rows, and z into the board,
away from the viewer. The square diagonally outside the first corner is black.

- `find_corners` finds a whole chessboard. It searches a large image at a fraction of its size and refines the corners
  at full size. With one odd and one even count of corners, the colours alone show which way up it is.
- `find_charuco` finds a ChArUco board, whole or in part. Its markers number the corners.
- `find_near` finds a part of a chessboard, as the zoom camera sees it at long focal lengths. The colours alone do not
  show which part, so the corners are numbered by a prediction that is good to a fraction of a square.

Here ``grey`` is an image (H, W), ``grid`` the column and row of every corner on the board, (N, 2), and ``H`` a
homography from squares of the board to pixels. Measurements: docs/design-notes.md.
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

# Search of a grid's corners near their predictions

Mask = npt.NDArray[np.bool_]
# Half window of cornerSubPix over the smallest corner spacing. The customary 11 px reach into the next corners of small
# boards and more than double the residuals on real photos.
WINDOW_SHARE = 0.35
SMALLEST_WINDOW_PX = 2  # with a smaller half window, cornerSubPix has too few pixels to fit
# Stop when corners move by less than a thousandth of a pixel, ten times below the noise of the best corners.
SUBPIX_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 0.001)
# Corners are rounded to a ten-thousandth of a pixel, a hundred times below their noise, to keep files short.
CORNER_DECIMALS = 4
# Even and odd squares of a chessboard differ by at least this many grey levels.
SMALLEST_CONTRAST = 8.0
BEYOND_SHARE = 0.4  # contrast over the board's usual one from which a point beyond its edge is another corner
FEWEST_CORNERS = 6
FEWEST_AFFINE = 4  # in the first round, whose larger window leaves out corners near the image's edge
SMALLEST_SPACING_PX = 10.0  # below, the four squares around a corner blur into each other
# Largest half window once corners are nearly known [px]. A larger one adds no accuracy and loses corners near the
# image's edge.
LARGEST_WINDOW_PX = 10
ROUNDS = 4  # rounds of prediction and search; two or three are usual
CAPTURE_SHARE = 0.06  # distance from an affine map in the first round, in squares, within which corners agree
# Distance from a smooth map beyond which a point is no corner: in pixels and in squares, whichever is larger. Where few
# corners leave the map affine, this allows for what perspective and the lens bend.
OFF_MAP_PX, OFF_MAP_SHARE = 1.0, 0.01
CURVED_CORNERS = 16  # number of corners from which the map includes perspective and radial distortion
TRIMMINGS = 10  # rounds of leaving out the worst corners
PIXEL_SCALE = 1000.0  # divisor of pixels in the map's fit, so that the columns are of similar size


@dataclass(frozen=True)
class Look:
    """Distances at which corners are examined, in squares."""

    window: float  # half window of cornerSubPix
    inside: float  # distance from the corner along both axes at which the colours of the four squares are compared
    near: float  # smaller distance at which they are compared again
    sharpness: float  # smallest contrast at ``near`` over that at ``inside``; below it the image is too blurred


# Refuses a blur of 7 px (one standard deviation) with squares of 70 px.
PLAIN = Look(window=WINDOW_SHARE, inside=0.3, near=0.1, sharpness=0.4)
# Squares of a whole board may be as small as 7 px, with little contrast left near the corners.
SMALL = Look(window=WINDOW_SHARE, inside=0.3, near=0.3, sharpness=0.0)


@dataclass(frozen=True, eq=False)
class FoundCorners:
    """Result of a search for corners."""

    corners_px: Array  # points found, (N, 2) [px]; nan where nothing was found
    seen: Mask  # True for points that are corners of the grid, (N,)
    expected: Mask  # True for corners that were well inside the image and should have been seen, (N,)
    spacing: float  # smallest distance of neighbouring corners in the image [px]

    def rounded(self) -> Array:
        """Return the corners that are seen, rounded, (N, 2) [px]; nan for the others."""
        return np.where(self.seen[:, None], np.round(self.corners_px, CORNER_DECIMALS), np.nan)


def search_near(grey: Image, grid: Array, predicted: Array, look: Look) -> FoundCorners | None:
    """Search for corners near predictions (N, 2) [px], correct these, and repeat; None where too few are found."""
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
        # An affine map predicts well enough for the next search, and extrapolates safely.
        start, half = mapped(predicted, found, seen, curved=False), min(half, LARGEST_WINDOW_PX)
    return FoundCorners(found, seen, expected, spacing)


def grid_of(board: BoardConfig) -> Array:
    """List the column and row of every corner, row by row, (N, 2)."""
    columns, rows = board.corners
    v, u = np.mgrid[:rows, :columns].astype(float)
    return np.stack([u, v], axis=-1).reshape(-1, 2)


def homography(grid: Array, pixels: Array) -> Array | None:
    """Fit a homography to the finite pixels (n, 2) by least squares; None where there are fewer than six."""
    finite = np.isfinite(pixels).all(axis=1)
    if np.count_nonzero(finite) < FEWEST_CORNERS:
        return None
    H, _ = cv2.findHomography(grid[finite], pixels[finite])
    return None if H is None or not np.isfinite(H).all() else np.asarray(H)


def through(H: Array, grid: Array) -> Array:
    """Map points on the board (..., 2) [squares] to pixels by a homography."""
    x = grid @ H[:, :2].T + H[:, 2]
    with np.errstate(all="ignore"):
        return np.where(x[..., 2:] > 0, x[..., :2] / x[..., 2:], np.nan)


def spacing_px(grey: Image, grid: Array, H: Array) -> float:
    """Compute the smallest distance of neighbouring corners within the image [px]; nan where there are none."""
    places = through(H, grid)
    here = inside(grey, places, 0)
    if not here.any():
        return float("nan")
    steps = [through(H, grid[here] + step) - places[here] for step in np.eye(2)]
    return float(np.linalg.norm(steps, axis=-1).min())


def inside(grey: Image, pixels: Array, margin: float) -> Mask:
    """Check which pixels (N, 2) are inside the image by a margin [px], (N,); False for nan."""
    limit = np.array(grey.shape[::-1]) - 1 - margin
    return np.asarray(((pixels >= margin) & (pixels <= limit)).all(axis=-1))


def refined(grey: Image, start: Array, which: Mask, half: int) -> Array:
    """Move the selected corners to the saddle points in their windows, (N, 2) [px]; nan for the others.

    A point that leaves its window stays where it was; `are_corners` rejects it.
    """
    found = np.full(start.shape, np.nan)
    if which.any():
        begin = start[which].astype(np.float32).reshape(-1, 1, 2)
        found[which] = cv2.cornerSubPix(grey, begin, (half, half), (-1, -1), SUBPIX_CRITERIA).reshape(-1, 2)
    return found


def are_corners(grey: Image, pixels: Array, grid: Array, H: Array, look: Look) -> Mask:
    """Check which pixels (N, 2) show sharp corners of the board, by `contrast`, (N,)."""
    well_inside, near = (contrast(grey, pixels, grid, H, share) for share in (look.inside, look.near))
    with np.errstate(invalid="ignore"):
        return np.asarray((well_inside > SMALLEST_CONTRAST) & (near > look.sharpness * well_inside))


def contrast(grey: Image, pixels: Array, grid: Array, H: Array, share: float) -> Array:
    """Compute the contrast between the two bright and the two dark squares around candidate corners (N, 2) [px].

    It is the level of the darker bright square less that of the brighter dark one, (N,), nan for nan pixels. The
    squares are sampled at a share of a square from the corner along both axes.
    """
    diagonals = np.array([[-1, -1], [1, 1], [1, -1], [-1, 1]])  # dark, dark, bright, bright around the first corner
    arms = through(H, grid[:, None] + share * diagonals) - through(H, grid)[:, None]
    at = (np.nan_to_num(pixels)[:, None] + np.nan_to_num(arms)).astype(np.float32)
    smooth = cv2.boxFilter(grey, cv2.CV_32F, (3, 3))
    levels = cv2.remap(smooth, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    levels = np.where((grid.sum(axis=1) % 2 == 0)[:, None], levels, -levels)
    return np.where(np.isfinite(pixels).all(axis=1), levels[:, 2:].min(axis=1) - levels[:, :2].max(axis=1), np.nan)


def goes_on(grey: Image, grid: Array, seen: Mask, H: Array) -> bool:
    """Check whether corners continue beyond an edge of the board, which then is another part, or of a larger board."""
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
    """Check which corners are off their predictions by one smooth map, (N,); none where there is no such map."""
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
    """Fit a smooth map from predicted to found corners over those kept, and map all predictions, (N, 2) [px]."""
    middle = predicted[kept].mean(axis=0)
    columns = design(predicted - middle, curved=curved)
    coefficients = np.linalg.lstsq(columns[kept], found[kept] - predicted[kept], rcond=None)[0]
    return np.asarray(predicted + columns @ coefficients)


def design(pixels: Array, *, curved: bool) -> Array:
    """Make the design matrix of an affine map, or of one with perspective and radial distortion."""
    u, v = pixels.T / PIXEL_SCALE
    r2 = u * u + v * v
    columns = [np.ones_like(u), u, v] + ([u * u, u * v, v * v, u * r2, v * r2] if curved else [])
    return np.stack(columns, axis=1)


# ChArUco boards

GAP = (1 - MARKER_SHARE) / 2  # white between a corner and the marker, in squares
# The window ends at the markers: with 0.35 squares corners are off by 0.15 to 0.23 px, with this by 0.1 px.
BETWEEN_MARKERS = Look(window=GAP, inside=0.8 * GAP, near=0.8 * GAP, sharpness=0.0)
# Enlarged by 2, small markers are read twice as far away, in four times the time.
ENLARGED = (1, 2)
ENOUGH = 0.5  # share of the board's corners from which the enlarged image is not tried
# Cells of small markers are mostly edges, so more of their margin is ignored than the usual 0.13; the code corrects two
# bits.
IGNORED_MARGIN, CORRECTION = 0.3, 1.0


def find_charuco(grey: Image, board: BoardConfig, *, thorough: bool = True) -> Array | None:
    """Find the corners of a ChArUco board, whole or in part; see `find_corners`."""
    grid = grid_of(board)
    rough = _by_markers(grey, board, thorough)
    read = np.asarray(np.isfinite(rough).all(axis=1))
    if np.count_nonzero(read) < FEWEST_AFFINE:
        return None
    H = homography(grid, rough)
    if H is None:
        return None
    # Corners without two readable markers beside them are searched where the others predict them.
    straight = through(H, grid)
    elsewhere = mapped(straight, rough, read, curved=bool(np.count_nonzero(read) >= CURVED_CORNERS))
    found = search_near(grey, grid, np.where(read[:, None], rough, elsewhere), BETWEEN_MARKERS)
    if found is None or any(len(np.unique(grid[found.seen, axis])) < 2 for axis in (0, 1)):
        return None
    return found.rounded()


def _by_markers(grey: Image, board: BoardConfig, thorough: bool) -> Array:
    """Find rough corners beside two markers that are read, (N, 2) [px]; nan for the others."""
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


# Chessboards seen in part

# Largest mean offset from the prediction, in squares, far below the distance of the next square; and largest scale,
# shear or turn, as an element of the affine map less 1. Predictions are up to 3 % off.
FARTHEST_SHARE = 0.35
LARGEST_STRETCH = 0.1
# Smallest share of the expected corners that are found on a board numbered as predicted.
SMALLEST_SHARE = 0.85


def find_near(image: Image, board: BoardConfig, predicted_px: Array) -> Array | None:
    """Find the corners of a board seen in part, near their predictions.

    A prediction is off by less than a third of a square, and by nearly the same at all corners. It may be nan, or
    outside the image.

    Returns:
        Corners row by row, (columns * rows, 2) [px], nan for those not seen; None where fewer than six are seen, or
        where they are not surely numbered as predicted.
    """
    grey, grid = _grey(image), grid_of(board)
    if board.kind == "charuco":  # the markers number the corners better than any prediction
        return find_charuco(grey, board)
    found = search_near(grey, grid, predicted_px, PLAIN)
    if found is None or not _as_predicted(grey, grid, predicted_px, found):
        return None
    return found.rounded()


def _grey(image: Image) -> Image:
    return np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def _as_predicted(grey: Image, grid: Array, predicted: Array, found: FoundCorners) -> bool:
    """Check whether the corners seen are surely numbered as predicted.

    A shift by two squares or one diagonal has the same colours. But where an edge of the board is in the image, a
    shifted numbering either misses a whole row or column, or leaves one beyond the edge.
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


# Whole boards

FILLABLE_PX = (-10000.0, 10000.0)  # OpenCV fills no polygons with corners much farther out
LARGEST_BEND = 0.4  # largest distance of a corner from the image of a plane, in squares; a lens bends real ones by 0.3
# Longer side of the image in which a chessboard is searched first. In the texture of a larger image the finders see
# boards that are not there, and take 10 to 20 times as long.
LARGEST_SEARCHED_PX = 1280
SMALLEST_RIGHT = 0.7  # smallest share of corners with the right colours around, in any row or column


def find_corners(image: Image, board: BoardConfig, *, thorough: bool = True) -> Array | None:
    """Find the inner corners of a board: all of a chessboard, or those of a ChArUco board that are seen.

    Args:
        image: image, (H, W, 3) BGR, or grey (H, W).
        board: the board; a chessboard must have one odd and one even count of corners.
        thorough: True to try every finder. The first alone finds nearly all boards; to try all where there is no board
            takes ten times as long.

    Returns:
        Corners from the board's first, row by row, (columns * rows, 2) [px]; None where no whole chessboard is seen.
        Corners of a ChArUco board that are not seen are nan; None where fewer than six are seen, or all in one line.
    """
    grey = _grey(image)
    if board.kind == "charuco":
        return find_charuco(grey, board, thorough=thorough)
    for level in _pyramid(grey):
        for find in FINDERS if thorough else FINDERS[:1]:
            found = find(level, board.corners)
            if found is None:
                continue
            numbered = _number(level, found, board.corners)
            if numbered is not None and _is_whole(level, numbered, board):
                factor = np.array(grey.shape[::-1]) / level.shape[::-1]
                start = numbered if level is grey else (numbered + 0.5) * factor - 0.5
                half = max(SMALLEST_WINDOW_PX, round(WINDOW_SHARE * smallest_spacing(start, board.corners)))
                return np.round(refined(grey, start, np.ones(len(start), dtype=bool), half), CORNER_DECIMALS)
    return None


def _pyramid(grey: Image) -> list[Image]:
    """Halve an image until its longer side is at most `LARGEST_SEARCHED_PX`; the smallest image comes first."""
    levels = [grey]
    while max(levels[0].shape) > LARGEST_SEARCHED_PX:
        height, width = levels[0].shape
        levels.insert(0, cv2.resize(levels[0], (width // 2, height // 2), interpolation=cv2.INTER_AREA))
    return levels


def another_board(image: Image, board: BoardConfig, corners_px: Array) -> bool:
    """Check whether an image shows a second board of the same kind and size, by the fastest finder alone."""
    grey = _grey(image).copy()
    H = homography(grid_of(board), corners_px)
    if H is None:
        return False
    outline = through(H, board_outline(board)[:, :2] / board.square)
    if not np.isfinite(outline).all():
        return False
    cv2.fillConvexPoly(grey, np.round(np.clip(outline, *FILLABLE_PX)).astype(np.int32), float(np.median(grey)))
    searched = _pyramid(grey)[0] if board.kind == "chessboard" else grey
    return find_corners(searched, board, thorough=False) is not None


def guess_corners(image: Image) -> tuple[int, int] | None:
    """Guess the inner corners of any chessboard in an image, the larger count first; None where none is surely seen."""
    grey = _pyramid(_grey(image))[0]
    ok, _, layout = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), cv2.CALIB_CB_LARGER)
    if not ok:
        return None
    rows, columns = sorted(layout.shape)
    found = FINDERS[0](grey, (columns, rows))
    numbered = None if found is None else _number(grey, found, (columns, rows))
    board = BoardConfig(corners=(columns, rows))
    return (columns, rows) if numbered is not None and _is_whole(grey, numbered, board) else None


def smallest_spacing(corners_px: Array, corners: Sequence[int]) -> float:
    """Compute the smallest distance between neighbouring corners that are seen [px]; nan where no neighbours are."""
    grid = corners_px.reshape(corners[1], corners[0], 2)
    distances = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1) for axis in (0, 1)]
    return float(np.fmin.reduce(np.concatenate(distances, axis=None)))


def _number(grey: Image, corners_px: Array, corners: tuple[int, int]) -> Array | None:
    """Reorder corners so that the first is the board's, by handedness and then by the squares' colours."""
    columns, rows = corners
    grid = corners_px.reshape(rows, columns, 2)
    along, down = grid[:, -1].mean(0) - grid[:, 0].mean(0), grid[-1].mean(0) - grid[0].mean(0)
    if along[0] * down[1] - along[1] * down[0] < 0:  # from the front of the board, x turns clockwise into y
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
    """Check whether corners are those of the whole board: finders also report part of a larger one, or one more row."""
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


def _sector_based(flags: int) -> "BoardFinder":
    def find(grey: Image, corners: tuple[int, int]) -> Array | None:
        ok, found = cv2.findChessboardCornersSB(grey, corners, flags=flags)
        return np.asarray(found, dtype=float).reshape(-1, 2) if ok else None  # (N, 1, 2) in OpenCV 4, (N, 2) in 5

    return find


def _quadrangles(grey: Image, corners: tuple[int, int]) -> Array | None:
    # Without CALIB_CB_FAST_CHECK, which finds nothing when squares are small.
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE
    ok, found = cv2.findChessboardCorners(grey, corners, flags=flags)
    return np.asarray(found, dtype=float).reshape(-1, 2) if ok else None


# Finders accurate to about a pixel, the fastest first (20, 25, 100 ms and up at 640x480). What one misses, another
# often sees.
BoardFinder = Callable[[Image, tuple[int, int]], Array | None]
FINDERS: tuple[BoardFinder, ...] = (
    _sector_based(0),
    _sector_based(cv2.CALIB_CB_NORMALIZE_IMAGE),
    _sector_based(cv2.CALIB_CB_ACCURACY),
    _quadrangles,
)
