"""Analysis of a calibration for its report: lens curves, predicted pointing error, and evidence from the corners.

- `lens_curves`: the zoom lens over its focal range, with standard deviations.
- `pointing`, `contributions`: the predicted pointing error over the fixed image, and its parts by group of parameters.
- `gather`: residuals of the stored corners, coverage, distances and tilts of the boards, and the board's shape.
"""

import itertools
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cotarget.board import board_points
from cotarget.calibration.bundle import Fit, fit, nudged, predict_pixels, robust_sigma
from cotarget.calibration.calibrate import determines_pose
from cotarget.calibration.file import Calibration
from cotarget.calibration.initialization import place_boards
from cotarget.calibration.model import CAMERAS, CameraName, Covariance, View
from cotarget.calibration.observability import limits_of_use, name_directions
from cotarget.calibration.planning import GRID
from cotarget.calibration.uncertainty import STEP, miss_derivatives, model_of, predicted_pointing
from cotarget.camera import ZoomLens
from cotarget.errors import CalibrationError
from cotarget.geometry import Array

log = logging.getLogger(__name__)

# The zoom lens over its focal range

POINTS = 61
# True over nominal focal length along u and v, principal point [px], distortion k1 of the image, pupil [mm].
CURVES = ("ratio_x", "ratio_y", "cx", "cy", "kappa1", "pupil_mm")


@dataclass(frozen=True, eq=False)
class LensCurves:
    """Parameters of the zoom lens as curves over the nominal focal length, by the names of `CURVES`."""

    nominal_px: Array  # nominal focal lengths of the curves, (n,) [px]
    stops_px: tuple[float, ...]  # nominal focal lengths of the zoom samples [px]
    values: dict[str, Array]  # values of each curve, (n,)
    sigmas: dict[str, Array]  # standard deviations of each curve, (n,); empty without a covariance
    at_stops: dict[str, Array]  # values at the zoom samples


def lens_curves(calibration: Calibration) -> LensCurves:
    """Evaluate the zoom lens over its focal range, with the covariance's and the interpolation's uncertainty."""
    lens = calibration.zoom_head.lens
    nominal = np.geomspace(lens.nominal_px[0], lens.nominal_px[-1], POINTS)
    return LensCurves(
        nominal,
        lens.nominal_px,
        dict(zip(CURVES, _evaluate(lens, nominal), strict=True)),
        _sigmas(calibration, nominal),
        dict(zip(CURVES, _evaluate(lens, np.array(lens.nominal_px)), strict=True)),
    )


def _evaluate(lens: ZoomLens, nominal_px: Array) -> Array:
    """Evaluate all curves of a lens, (6, n)."""
    rows = []
    for nominal in nominal_px:
        here = lens.at(float(nominal))
        (fx, fy), (cx, cy) = here.focal_px, here.center_px
        kappa1 = here.distortion[0] * (lens.nominal_px[0] / nominal) ** 2
        rows.append([fx / nominal, fy / nominal, cx, cy, kappa1, 1000 * lens.pupil_at(float(nominal))])
    return np.array(rows).T


def _sigmas(calibration: Calibration, nominal_px: Array) -> dict[str, Array]:
    covariance = calibration.covariance
    if covariance is None:
        return {}
    model = model_of(calibration)
    own = [i for i, name in enumerate(covariance.parameters) if name.startswith("zoom[")]
    columns = []
    for i in own:
        ends = (nudged(model, covariance.parameters[i], step).head.lens for step in (STEP, -STEP))
        plus, minus = (_evaluate(lens, nominal_px) for lens in ends)
        columns.append((plus - minus) / (2 * STEP))
    J = np.array(columns)  # (parameters, 6, n)
    variance = np.einsum("pcn,pq,qcn->cn", J, covariance.matrix[np.ix_(own, own)], J)
    sigmas = dict(zip(CURVES, np.sqrt(np.maximum(variance, 0.0)), strict=True))
    doubt = np.array([calibration.zoom_head.lens.center_doubt_px(float(n)) for n in nominal_px])
    return sigmas | {name: np.hypot(sigmas[name], doubt[:, i]) for i, name in enumerate(("cx", "cy"))}


# Predicted pointing error

DEPTHS = (4.0, 30.0)  # depths of targets, nearest and farthest [m]
POINTING_CELLS = (9, 7)  # cells across and down the fixed image, at whose middles pointing is predicted
DEPTH_STEPS = 5
FARTHER = 1.1  # longest focal length of the lens over the longest calibrated, above which the report mentions it
MORE_PLACEMENTS = 10  # further placements whose effect the report states
BETWEEN_STOPS = 4  # focal lengths between all zoom samples together, at least one in each gap
# Groups of parameters in the order of the page: name, and prefixes of the parameters' names.
GROUPS = (
    ("the fixed camera's lens", ("fixed.",)),
    ("the zoom lens's pupil", ("zoom.pupil",)),
    ("the zoom camera's lens", ("zoom.",)),
    ("the offset between the cameras", ("T_zoom0_fixed.",)),
    ("the zoom camera's place on the head", ("T_head_zoom.",)),
    ("the encoders", ("head.pan_", "head.tilt_")),
    ("the head's axes", ("head.",)),
    ("the board's bend", ("board.",)),
)
JITTER_GROUP = "the head's jitter"


@dataclass(frozen=True)
class AtFocal:
    """Predicted pointing error at one focal length, rms over the fixed image and the depths."""

    nominal_px: float  # nominal focal length [px]
    focal_px: float  # true focal length, the mean of both directions [px]
    rms: float  # predicted pointing error [rad]

    @property
    def rms_px(self) -> float:
        """Predicted pointing error in the zoom image, near its middle [px]."""
        return float(np.tan(self.rms)) * self.focal_px


def sample_pixels(calibration: Calibration) -> Array:
    """List the middles of cells all over the fixed image, (n, 2) [px]."""
    sides = zip(POINTING_CELLS, calibration.fixed.size, strict=True)
    across, down = ((np.arange(n) + 0.5) / n * side - 0.5 for n, side in sides)
    return np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)


def sample_depths(count: int = DEPTH_STEPS) -> Array:
    """List depths from the nearest to the farthest target, evenly over their logarithm [m]."""
    return np.geomspace(*DEPTHS, count)


def sigma_of(calibration: Calibration, name: str) -> float | None:
    """Look up the standard deviation of a parameter; None where the calibration has none."""
    covariance = calibration.covariance
    return covariance.sigma(name) if covariance is not None and name in covariance.parameters else None


def uncalibrated_px(calibration: Calibration) -> float | None:
    """Find the longest nominal focal length [px] of a lens that is not calibrated so far; None if it is, or unknown."""
    match calibration.provenance.get("focal_range_px"):
        case [_, int() | float() as longest] if longest > calibration.zoom_head.lens.nominal_px[-1] * FARTHER:
            return longest
    return None


def can_point(calibration: Calibration) -> bool:
    """Check whether pointing can be predicted: the calibration has T and a covariance."""
    return calibration.zoom_head.T_head_zoom is not None and calibration.covariance is not None


def pointing(calibration: Calibration, nominal_px: Sequence[float] | None = None) -> tuple[AtFocal, ...]:
    """Predict the pointing error at nominal focal lengths [px]; None for those of all zoom samples.

    Each is nan where the head reaches no target; there are none where nothing can be predicted.
    """
    nominals = calibration.zoom_head.lens.nominal_px if nominal_px is None else nominal_px
    if not can_point(calibration) or not nominals:
        return ()
    focals = [float(np.mean(calibration.zoom_head.lens.at(nominal).focal_px)) for nominal in nominals]
    return tuple(itertools.starmap(AtFocal, zip(nominals, focals, _over_the_view(calibration, nominals), strict=True)))


def placements(calibration: Calibration) -> int:
    """Count the placements of the board that are stored with a calibration."""
    return len({view.board for view in calibration.views})


def what_stays(calibration: Calibration, at: AtFocal) -> float:
    """Compute the error that more placements do not reduce [rad]: jitter, and the doubt between zoom samples."""
    exact = Covariance((), np.empty((0, 0)))
    return _over_the_view(replace(calibration, covariance=exact), [at.nominal_px])[0]


def with_more_placements(calibration: Calibration, at: AtFocal, more: int = MORE_PLACEMENTS) -> float:
    """Predict the pointing error after ``more`` placements of the same kind [rad].

    The part from the parameters' covariance is taken as proportional to 1 / placements.
    """
    here, stays2 = placements(calibration), what_stays(calibration, at) ** 2
    return float(np.sqrt(stays2 + max(at.rms**2 - stays2, 0.0) * here / (here + more)))


def between_stops(calibration: Calibration) -> list[float]:
    """List nominal focal lengths between the zoom samples, where the lens is interpolated [px]."""
    stops = calibration.zoom_head.lens.nominal_px
    each = max(1, BETWEEN_STOPS // max(len(stops) - 1, 1))
    return [float(n) for a, b in itertools.pairwise(stops) for n in np.geomspace(a, b, each + 2)[1:-1]]


def _over_the_view(calibration: Calibration, nominal_px: Sequence[float]) -> list[float]:
    """Compute the rms of the predicted error over all pixels and depths within reach [rad], at each focal length."""
    pixels, depths, nominals = sample_pixels(calibration), sample_depths(), np.array(nominal_px)
    errors = predicted_pointing(calibration, pixels, depths[:, None], nominal_px=nominals[:, None, None])
    reached = [each[np.isfinite(each)] for each in errors]
    return [float(np.sqrt(np.mean(each**2))) if len(each) else np.nan for each in reached]


def corner_errors(calibration: Calibration, nominal_px: float) -> tuple[float, dict[str, float]]:
    """Predict the pointing error in the middle of the fixed image, and by name in its corners within reach [rad].

    Each is the rms over `sample_depths`.
    """
    right, bottom = np.array(calibration.fixed.size) - 1.0
    places = {"upper left": (0.0, 0.0), "upper right": (right, 0.0), "lower left": (0.0, bottom)}
    places |= {"lower right": (right, bottom)}
    pixels = np.array([calibration.fixed.lens.image_center_px, *places.values()])
    errors = predicted_pointing(calibration, pixels[None], sample_depths()[:, None], nominal_px=nominal_px)
    middle, *rms = np.sqrt(np.mean(errors**2, axis=0)).tolist()
    return middle, {name: error for name, error in zip(places, rms, strict=True) if np.isfinite(error)}


def group_of(parameter: str) -> str:
    """Find the group that a parameter belongs to."""
    owner, _, kind = parameter.rpartition(".")
    plain = f"{owner.partition('[')[0]}.{kind}"
    return next((name for name, begins in GROUPS if plain.startswith(begins)), parameter)


def contributions(calibration: Calibration) -> dict[str, float]:
    """Compute the rms error at the longest focal length if each group were known [rad], the most important first.

    A group known exactly leaves the conditional covariance of the others.
    """
    covariance = calibration.covariance
    if not can_point(calibration) or covariance is None:
        return {}
    pixels, depths = sample_pixels(calibration), sample_depths()
    by_parameter, by_turn = miss_derivatives(
        model_of(calibration),
        covariance.parameters,
        np.tile(pixels, (len(depths), 1)),
        np.repeat(depths, len(pixels)),
        calibration.zoom_head.lens.nominal_px[-1],
    )
    reached = np.isfinite(by_parameter).all(axis=(1, 2))
    if not reached.any():
        return {}
    J, turned = by_parameter[reached], by_turn[reached]
    weights = np.einsum("nik,nil->kl", J, J) / len(J)  # the mean of trace(J C J^T) is the sum of weights * C
    turns = float(np.sum(turned**2)) / len(J)

    def rms(matrix: Array, jitter: float) -> float:
        return float(np.sqrt(max(np.sum(weights * matrix) + jitter**2 * turns, 0.0)))

    groups = [group_of(name) for name in covariance.parameters]
    left = {}
    for group in dict.fromkeys(groups):
        known = np.array(groups) == group
        left[group] = rms(given(covariance, known).matrix, calibration.jitter)
    if calibration.jitter:
        left[JITTER_GROUP] = rms(covariance.matrix, 0.0)
    return dict(sorted(left.items(), key=lambda item: item[1]))


def given(covariance: Covariance, known: npt.NDArray[np.bool_]) -> Covariance:
    """Compute the conditional covariance given that some parameters, (n,) booleans, are known exactly."""
    C = covariance.matrix
    scale = np.sqrt(np.maximum(np.diagonal(C), np.finfo(float).tiny))
    R = C / np.outer(scale, scale)
    rest = ~known
    left = np.zeros_like(R)
    through = R[np.ix_(rest, known)]
    left[np.ix_(rest, rest)] = R[np.ix_(rest, rest)] - through @ np.linalg.pinv(R[np.ix_(known, known)]) @ through.T
    return Covariance(covariance.parameters, left * np.outer(scale, scale))


def left_open(calibration: Calibration) -> str:
    """Describe what the covariance leaves undetermined, and what to add; empty where all is determined.

    The widening by the held-out check is taken out, because it stands for a wrong model, which no views correct.
    """
    covariance, held_out = calibration.covariance, calibration.held_out
    if covariance is None or not covariance.matrix.any():
        return ""
    lenses = model_of(calibration).lenses
    limits = limits_of_use(covariance.parameters, lenses)
    widened = 1.0 if held_out is None else held_out.widened
    # Divided by the limits, because eigenvalues of a matrix of mixed units are lost by rounding, as are those of its
    # inverse.
    values, vectors = np.linalg.eigh(covariance.matrix / np.outer(limits, limits))
    weak = (vectors[:, values > widened**2] * limits[:, None]).T
    return name_directions(covariance.parameters, weak, lenses)


# Evidence from the stored corners

TITLES = {"fixed": "fixed camera", "zoom": "zoom camera"}
CELLS = (16, 12)  # cells across and down an image, in which residuals are averaged
FEWEST_IN_CELL = 5  # fewest corners of an average
BEYOND_CHANCE = 3.0  # standard deviations of a cell's average, which chance exceeds in one cell of 90
SHAPE_CHI2 = 16.3  # 99.9 % of a chi-square with three degrees of freedom
WRONG_SHARE = 0.1  # share of a board's corners that are off, above which the board is wrong
POINT_STEP = 1e-5  # step of a corner for derivatives [m]
# Names of the thirds of an image.
ROWS, COLUMNS = ("upper", "", "lower"), ("left", "", "right")


@dataclass(frozen=True, eq=False)
class Corners:
    """All corners that one camera saw."""

    size: tuple[int, int]  # image size (width, height) [px]
    seen_px: Array  # corners in the image, (n, 2) [px]
    residuals: Array  # predicted minus seen, (n, 2) [px], after each view's pan and tilt are fitted within the jitter

    @property
    def sigma(self) -> float:
        """Robust standard deviation of a coordinate of the residuals [px]."""
        return robust_sigma(self.residuals) if len(self.residuals) else 0.0


@dataclass(frozen=True, eq=False)
class Cells:
    """Residuals averaged over the cells of an image; nan where a cell has too few."""

    middles: Array  # mean of the corners in each cell, (cells, 2) [px]
    means: Array  # mean of their residuals, (cells, 2) [px]
    beyond_chance: npt.NDArray[np.bool_]  # True for means larger than noise explains, (cells,)


@dataclass(frozen=True, eq=False)
class BoardShape:
    """Deviation of the board's corners from their nominal positions, estimated from the residuals."""

    # offset of every corner along x, y and z of the board [m], (N, 3); 0 for a corner that is hardly seen
    offsets: Array
    beyond_chance: npt.NDArray[np.bool_]  # True for offsets larger than noise explains, (N,)

    @property
    def wrong(self) -> bool:
        """True if more than `WRONG_SHARE` of the corners are off."""
        return bool(self.beyond_chance.mean() > WRONG_SHARE)

    @property
    def within(self) -> float:
        """Rms offset within the board's plane [m]."""
        return float(np.sqrt(np.mean(np.sum(self.offsets[:, :2] ** 2, axis=1))))

    @property
    def out(self) -> float:
        """Standard deviation of the offsets out of the board's plane [m]."""
        return float(np.std(self.offsets[:, 2]))


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence from the stored corners."""

    views: tuple[View, ...]  # views used
    corners: dict[CameraName, Corners]  # corners of both cameras
    distances: Array  # distance of each placement's middle from the fixed camera [m]
    leanings: Array  # angle of each placement from facing the fixed camera [rad]
    per_stop: tuple[int, ...]  # number of views at each zoom sample
    shape: BoardShape  # deviation of the board's corners


def gather(calibration: Calibration) -> Evidence | None:
    """Fit the boards' poses alone to the stored corners; None where a calibration stores none.

    Views whose corners do not determine a pose are left out: too many of their corners may have been rejected.
    """
    if calibration.board is None:
        return None
    points = board_points(calibration.board)
    views = tuple(view for view in calibration.views if determines_pose(view, points))
    for view in calibration.views:
        if view not in views:
            log.warning("%s: not in the report: its corners are too few, or all on one line", view.name)
    if not views:
        return None
    try:
        model = place_boards(model_of(calibration), views, points)
        found = fit(model, views, points, (), jitter=calibration.jitter)
    except np.linalg.LinAlgError:
        raise CalibrationError("the stored corners do not determine the boards' poses") from None
    boards = list(found.model.boards.values())
    middles = np.array([T.apply(points.mean(axis=0)) for T in boards])
    normals = np.array([T.rotation.as_matrix()[:, 2] for T in boards])
    distances = np.linalg.norm(middles, axis=-1)
    facing = np.abs(np.sum(normals * middles, axis=-1)) / distances
    stops = [model.stop_of(view) or 0 for view in views if view.camera == "zoom"]
    return Evidence(
        views=views,
        corners={name: _corners(calibration, found, name) for name in CAMERAS},
        distances=distances,
        leanings=np.arccos(np.clip(facing, 0.0, 1.0)),
        per_stop=tuple(np.bincount(stops, minlength=len(calibration.zoom_head.lens.stops)).tolist()),
        shape=_shape(found, points),
    )


def _corners(calibration: Calibration, found: Fit, name: CameraName) -> Corners:
    mine = [i for i, view in enumerate(found.views) if view.camera == name]
    seen = [found.views[i].seen for i in mine]
    size = calibration.fixed.size if name == "fixed" else calibration.zoom_head.lens.size
    at = [found.views[i].corners_px[s] for i, s in zip(mine, seen, strict=True)]
    off = [found.adjusted[i][s] for i, s in zip(mine, seen, strict=True)]
    return Corners(size, np.concatenate([np.empty((0, 2)), *at]), np.concatenate([np.empty((0, 2)), *off]))


def _shape(found: Fit, points: Array) -> BoardShape:
    """Fit an offset of every corner of the board to the residuals, with the boards' poses held.

    With residuals r = predicted - seen and their derivatives J by the corner's position, the offset is -J^+ r. With
    noise alone, r^T J J^+ r over the variance is a chi-square with three degrees of freedom.
    """
    seen = np.isfinite(found.adjusted[..., 0])
    ends = [[predict_pixels(found.model, found.views, points + d) for d in (e, -e)] for e in POINT_STEP * np.eye(3)]
    J = np.stack([(plus - minus) / (2 * POINT_STEP) for plus, minus in ends], axis=-1)  # (views, N, 2, 3)
    J, r = np.where(seen[..., None, None], J, 0.0), np.where(seen[..., None], found.adjusted, 0.0)
    normal, gradient = np.einsum("vnki,vnkj->nij", J, J), np.einsum("vnki,vnk->ni", J, r)
    offsets, beyond = np.zeros((len(points), 3)), np.zeros(len(points), dtype=bool)
    enough = np.count_nonzero(seen, axis=0) >= FEWEST_IN_CELL
    variance = robust_sigma(found.adjusted[seen]) ** 2
    for i in np.flatnonzero(enough):
        offsets[i] = -np.linalg.pinv(normal[i]) @ gradient[i]
        beyond[i] = -offsets[i] @ gradient[i] > SHAPE_CHI2 * variance
    return BoardShape(offsets, beyond)


def averaged(corners: Corners) -> Cells:
    """Average the residuals over cells, to show patterns that the lens's model leaves out."""
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


def counts(corners: Corners, cells: tuple[int, int] = GRID) -> Array:
    """Count the corners in each cell of the image, (down, across)."""
    found = np.bincount(_cell(corners, cells), minlength=cells[0] * cells[1])
    return found.reshape(cells[1], cells[0]).astype(float)


def _cell(corners: Corners, cells: tuple[int, int]) -> npt.NDArray[np.intp]:
    """Compute the index of each corner's cell, row by row, (n,)."""
    at = ((corners.seen_px + 0.5) / np.array(corners.size) * np.array(cells)).astype(np.intp)
    across, down = np.clip(at, 0, np.array(cells) - 1).T
    return np.asarray(down * cells[0] + across)


def empty_places(corners: Corners) -> list[str]:
    """Name the corners and edges of the image whose outermost cells show no board."""
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


@dataclass(frozen=True, eq=False)
class Analysis:
    """Figures of a calibration, on which its verdict, its advice and its page are based."""

    at: tuple[AtFocal, ...]  # `pointing` at the zoom samples
    between: tuple[AtFocal, ...]  # `pointing` between them
    parts: dict[str, float]  # `contributions`
    evidence: Evidence | None  # from the stored corners


def analyse(calibration: Calibration) -> Analysis:
    """Compute the figures of a calibration."""
    between = pointing(calibration, between_stops(calibration))
    return Analysis(pointing(calibration), between, contributions(calibration), gather(calibration))


def head_poses(views: Sequence[View]) -> Array:
    """List pan and tilt of the zoom views, (n, 2) [rad]."""
    return np.array([(view.pan, view.tilt) for view in views if view.camera == "zoom"]).reshape(-1, 2)
