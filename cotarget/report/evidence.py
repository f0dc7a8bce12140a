"""What the stored corners say: residuals, where they were seen, how far away the boards were and how they were held."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cotarget.calibration.boards import board_points
from cotarget.calibration.bundle import Fit, fit
from cotarget.calibration.method import tells_pose
from cotarget.calibration.model import Calibration, CameraName, View
from cotarget.calibration.parameters import stop_of
from cotarget.calibration.placing import place_boards
from cotarget.calibration.reprojection import predict_pixels
from cotarget.calibration.robust import robust_sigma
from cotarget.calibration.uncertainty import model_of
from cotarget.errors import CalibrationError
from cotarget.geometry import Array

log = logging.getLogger(__name__)

CAMERAS: tuple[CameraName, ...] = ("fixed", "zoom")
CELLS = (16, 12)  # across and down an image, in which residuals are averaged
FEWEST_IN_CELL = 5  # corners, below which an average says nothing
BEYOND_CHANCE = 3.0  # standard deviations of an average of two coordinates, which chance exceeds at one cell in 90
SHAPE_CHI2 = 16.3  # chi-square of three, which chance exceeds once in a thousand
WRONG_SHARE = 0.1  # of a board's corners
POINT_STEP = 1e-5  # [m]; pixels change by their derivatives, to rounding
COVER = (10, 8)  # cells in which corners are counted, as the capture plan does
# How the thirds of an image are called.
ROWS, COLUMNS = ("upper", "", "lower"), ("left", "", "right")


@dataclass(frozen=True, eq=False)
class Corners:
    """All corners that one camera saw.

    Attributes:
        size: (width, height) of its image [px].
        seen_px: where they were seen, (n, 2).
        residuals: predicted minus seen [px], (n, 2); what the head's jitter explains is taken out.
    """

    size: tuple[int, int]
    seen_px: Array
    residuals: Array

    @property
    def sigma(self) -> float:
        """Standard deviation of a coordinate of the residuals, told by their median [px]."""
        return robust_sigma(self.residuals) if len(self.residuals) else 0.0


@dataclass(frozen=True, eq=False)
class Cells:
    """Residuals averaged over the cells of an image; nan where a cell has too few.

    Attributes:
        middles: of the corners in the cell [px], (cells, 2).
        means: [px], (cells, 2).
        beyond_chance: which averages are larger than noise alone makes them, (cells,).
    """

    middles: Array
    means: Array
    beyond_chance: npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class BoardShape:
    """How the board departs from what everybody believes, told by the residuals.

    Attributes:
        offsets: of every corner, right, down and out of the board [m], (N, 3); 0 where it is hardly seen.
        beyond_chance: which are larger than noise alone makes them, (N,).
    """

    offsets: Array
    beyond_chance: npt.NDArray[np.bool_]

    @property
    def wrong(self) -> bool:
        """Whether so many corners are off that the board is not what it is believed to be."""
        return bool(self.beyond_chance.mean() > WRONG_SHARE)

    @property
    def within(self) -> float:
        """Rms offset within the board [m]."""
        return float(np.sqrt(np.mean(np.sum(self.offsets[:, :2] ** 2, axis=1))))

    @property
    def out(self) -> float:
        """Rms offset out of the board [m]."""
        return float(np.std(self.offsets[:, 2]))


@dataclass(frozen=True, eq=False)
class Evidence:
    """Everything told by the corners.

    Attributes:
        views: those that were used.
        corners: of both cameras.
        distances: of the boards' middles from the fixed camera, one a placement [m].
        leanings: by which boards were turned from facing the fixed camera [rad].
        per_stop: how many views each stop of the zoom lens has.
        shape: of the board.
    """

    views: tuple[View, ...]
    corners: dict[CameraName, Corners]
    distances: Array
    leanings: Array
    per_stop: tuple[int, ...]
    shape: BoardShape


def gather(calibration: Calibration) -> Evidence | None:
    """Fit the boards' poses, and nothing else, to the stored corners; None where a calibration stores none.

    Views whose corners do not tell a pose are left out: of those in a fit, too many may have been wrong.

    Raises:
        CalibrationError: the stored corners do not belong to this calibration.
    """
    if calibration.board is None:
        return None
    points = board_points(calibration.board)
    views = tuple(view for view in calibration.views if tells_pose(view, points))
    for view in calibration.views:
        if view not in views:
            log.warning("%s: not in the report: its corners are too few, or all on one line", view.name)
    if not views:
        return None
    try:
        model = place_boards(model_of(calibration), views, points)
        found = fit(model, views, points, (), jitter=calibration.jitter)
    except np.linalg.LinAlgError:
        raise CalibrationError("the stored corners do not tell where their boards were") from None
    boards = list(found.model.boards.values())
    middles = np.array([T.apply(points.mean(axis=0)) for T in boards])
    normals = np.array([T.rotation.as_matrix()[:, 2] for T in boards])
    distances = np.linalg.norm(middles, axis=-1)
    facing = np.abs(np.sum(normals * middles, axis=-1)) / distances
    stops = [stop_of(calibration.zoom.nominal_px, view) for view in views if view.camera == "zoom"]
    return Evidence(
        views=views,
        corners={name: _corners(calibration, found, name) for name in CAMERAS},
        distances=distances,
        leanings=np.arccos(np.clip(facing, 0.0, 1.0)),
        per_stop=tuple(np.bincount(stops, minlength=len(calibration.zoom.stops)).tolist()),
        shape=_shape(found, points),
    )


def _corners(calibration: Calibration, found: Fit, name: CameraName) -> Corners:
    mine = [i for i, view in enumerate(found.views) if view.camera == name]
    seen = [found.views[i].seen for i in mine]
    size = calibration.fixed.size if name == "fixed" else calibration.zoom.size
    at = [found.views[i].corners_px[s] for i, s in zip(mine, seen, strict=True)]
    off = [found.left[i][s] for i, s in zip(mine, seen, strict=True)]
    return Corners(size, np.concatenate([np.empty((0, 2)), *at]), np.concatenate([np.empty((0, 2)), *off]))


def _shape(found: Fit, points: Array) -> BoardShape:
    """Fit an offset to every corner of the board, of what the boards' poses left; it is that or less.

    With residuals r = predicted - seen and their derivatives J by the corner's place, the offset is -J^+ r, and
    r^T J J^+ r over the variance is chi-square of three where there is only noise.
    """
    seen = np.isfinite(found.left[..., 0])
    ends = [[predict_pixels(found.model, found.views, points + d) for d in (e, -e)] for e in POINT_STEP * np.eye(3)]
    J = np.stack([(plus - minus) / (2 * POINT_STEP) for plus, minus in ends], axis=-1)  # (views, N, 2, 3)
    J, r = np.where(seen[..., None, None], J, 0.0), np.where(seen[..., None], found.left, 0.0)
    normal, gradient = np.einsum("vnki,vnkj->nij", J, J), np.einsum("vnki,vnk->ni", J, r)
    offsets, beyond = np.zeros((len(points), 3)), np.zeros(len(points), dtype=bool)
    enough = np.count_nonzero(seen, axis=0) >= FEWEST_IN_CELL
    variance = robust_sigma(found.left[seen]) ** 2
    for i in np.flatnonzero(enough):
        offsets[i] = -np.linalg.pinv(normal[i]) @ gradient[i]
        beyond[i] = -offsets[i] @ gradient[i] > SHAPE_CHI2 * variance
    return BoardShape(offsets, beyond)


def averaged(corners: Corners) -> Cells:
    """Average the residuals over cells: a pattern that remains is what the lens's model leaves out."""
    owner = _cell(corners, CELLS)
    cells = CELLS[0] * CELLS[1]
    number = np.bincount(owner, minlength=cells)
    with np.errstate(invalid="ignore"):
        middles, means = (
            np.stack([np.bincount(owner, values[:, k], cells) / number for k in range(2)], axis=-1)
            for values in (corners.seen_px, corners.residuals)
        )
    means[number < FEWEST_IN_CELL] = np.nan
    limit = BEYOND_CHANCE * corners.sigma / np.sqrt(np.maximum(number, 1))
    with np.errstate(invalid="ignore"):
        return Cells(middles, means, np.linalg.norm(means, axis=-1) > limit)


def counts(corners: Corners, cells: tuple[int, int] = COVER) -> Array:
    """How many corners were seen in each cell of the image, (down, across)."""
    found = np.bincount(_cell(corners, cells), minlength=cells[0] * cells[1])
    return found.reshape(cells[1], cells[0]).astype(float)


def _cell(corners: Corners, cells: tuple[int, int]) -> npt.NDArray[np.intp]:
    """Number of the cell that each corner is in, row by row."""
    at = ((corners.seen_px + 0.5) / np.array(corners.size) * np.array(cells)).astype(np.intp)
    across, down = np.clip(at, 0, np.array(cells) - 1).T
    return np.asarray(down * cells[0] + across)


def empty_places(corners: Corners) -> list[str]:
    """Name the corners and edges of the image where no board was seen in any of the outermost cells nearby."""
    seen = counts(corners) > 0
    down, across = np.indices(seen.shape)
    rim = (down == 0) | (down == seen.shape[0] - 1) | (across == 0) | (across == seen.shape[1] - 1)
    third_down, third_across = down * 3 // seen.shape[0], across * 3 // seen.shape[1]
    found = []
    for i, row in enumerate(ROWS):
        for j, column in enumerate(COLUMNS):
            here = rim & (third_down == i) & (third_across == j)
            if here.any() and not (seen & here).any():
                found.append(f"{row} {column} corner" if row and column else f"{row or column} edge")
    return found


def share_beyond(residuals: Array, sigma: float, times: float = 3.0) -> float:
    """Share of coordinates beyond so many standard deviations; of Gaussian ones, 0.27 % are beyond three."""
    return float(np.mean(np.abs(residuals) > times * sigma)) if residuals.size else 0.0


def head_poses(views: Sequence[View]) -> Array:
    """Pan and tilt of the zoom camera's views, (n, 2) [rad]."""
    return np.array([(view.pan, view.tilt) for view in views if view.camera == "zoom"]).reshape(-1, 2)
