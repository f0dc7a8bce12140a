"""What a calibration predicts of its own pointing, all over the wide view, and which parameters that comes from."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cotarget.calibration.model import Calibration, Covariance
from cotarget.calibration.observability import name_directions, weak_directions
from cotarget.calibration.uncertainty import miss_derivatives, model_of, predicted_pointing
from cotarget.geometry import Array

DEPTHS = (4.0, 30.0)  # where targets are [m]
CELLS = (9, 7)  # across and down the wide view, at whose middles pointing is predicted
DEPTH_STEPS = 5
FARTHER = 1.1  # times the longest focal length calibrated, up to which a lens may go without a word
MORE_PLACEMENTS = 10  # of which people are told what they would bring
BETWEEN_STOPS = 4  # focal lengths to look at between the stops, shared out, but never fewer than one each
# Groups of parameters in the order of the page: how people call them, and how their names begin.
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
    """Pointing at one stop of the zoom lens, rms over the wide view and the depths.

    Attributes:
        nominal_px: the stop's nominal focal length [px].
        focal_px: its true one, the mean of both directions [px].
        rms: predicted angle [rad].
    """

    nominal_px: float
    focal_px: float
    rms: float

    @property
    def rms_px(self) -> float:
        """The same in the zoom image, near its middle [px]."""
        return float(np.tan(self.rms)) * self.focal_px


@dataclass(frozen=True)
class Contribution:
    """What one group of parameters adds to the error: the rms that would be left if it were known exactly [rad]."""

    group: str
    left: float


def sample_pixels(calibration: Calibration, cells: tuple[int, int] = CELLS) -> Array:
    """Middles of cells all over the wide view, (n, 2) [px]."""
    across, down = (
        (np.arange(n) + 0.5) / n * side - 0.5 for n, side in zip(cells, calibration.fixed.size, strict=True)
    )
    return np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)


def sample_depths(count: int = DEPTH_STEPS) -> Array:
    """Depths from the nearest to the farthest target, evenly over their logarithm [m]."""
    return np.geomspace(*DEPTHS, count)


def sigma_of(calibration: Calibration, name: str) -> float | None:
    """Standard deviation of a parameter; None where the calibration tells none."""
    covariance = calibration.covariance
    return covariance.sigma(name) if covariance is not None and name in covariance.parameters else None


def uncalibrated_px(calibration: Calibration) -> float | None:
    """The longest focal length of a lens that was not calibrated so far [px]; None where it was, or is not known."""
    told = calibration.provenance.get("focal_range_px")
    longest = told[-1] if isinstance(told, list) and told and isinstance(told[-1], int | float) else None
    return longest if longest is not None and longest > calibration.zoom.nominal_px[-1] * FARTHER else None


def can_point(calibration: Calibration) -> bool:
    """Whether pointing can be predicted at all."""
    return calibration.T_head_zoom is not None and calibration.covariance is not None


def pointing(calibration: Calibration, nominal_px: Sequence[float] | None = None) -> tuple[AtFocal, ...]:
    """Predict the pointing at focal lengths, by default at every stop of the zoom lens.

    Returns:
        One each; nan where the head reaches nothing; empty where nothing can be predicted.
    """
    if not can_point(calibration):
        return ()
    found = []
    for nominal in calibration.zoom.nominal_px if nominal_px is None else nominal_px:
        focal = float(np.mean(calibration.zoom.at(nominal).focal_px))
        found.append(AtFocal(nominal, focal, _over_the_view(calibration, nominal)))
    return tuple(found)


def placements(calibration: Calibration) -> int:
    """How many placements of the board are stored with a calibration."""
    return len({view.board for view in calibration.views})


def what_stays(calibration: Calibration, at: AtFocal) -> float:
    """What placements take nothing from: the head's jitter, and what the zoom lens's stops leave in doubt [rad]."""
    covariance = calibration.covariance
    assert covariance is not None
    known = replace(covariance, matrix=np.zeros_like(covariance.matrix))
    return _over_the_view(replace(calibration, covariance=known), at.nominal_px)


def with_more_placements(calibration: Calibration, at: AtFocal, more: int = MORE_PLACEMENTS) -> float:
    """What the error would be with so many more placements of the same kind [rad].

    Their part of it, the parameters' covariance, goes with 1 / placements.
    """
    here, stays2 = placements(calibration), what_stays(calibration, at) ** 2
    return float(np.sqrt(stays2 + max(at.rms**2 - stays2, 0.0) * here / (here + more)))


def between_stops(calibration: Calibration) -> list[float]:
    """Nominal focal lengths between the stops of the zoom lens, where it is only interpolated [px]."""
    stops = calibration.zoom.nominal_px
    each = max(1, BETWEEN_STOPS // max(len(stops) - 1, 1))
    return [float(n) for a, b in itertools.pairwise(stops) for n in np.geomspace(a, b, each + 2)[1:-1]]


def _over_the_view(calibration: Calibration, nominal_px: float) -> float:
    """Rms of the predicted angle over all pixels and depths that can be reached [rad]."""
    pixels, depths = sample_pixels(calibration), sample_depths()
    errors = predicted_pointing(calibration, pixels[None], depths[:, None], nominal_px=nominal_px)
    reached = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(reached**2))) if len(reached) else np.nan


def corner_errors(calibration: Calibration, nominal_px: float) -> tuple[float, dict[str, float]]:
    """Predicted angle in the middle of the wide view, and by name in its corners that can be reached [rad].

    Depths are those of `sample_depths`, rms over them.
    """
    right, bottom = np.array(calibration.fixed.size) - 1.0
    places = {"upper left": (0.0, 0.0), "upper right": (right, 0.0), "lower left": (0.0, bottom)}
    places |= {"lower right": (right, bottom)}
    pixels = np.array([calibration.fixed.image_center_px, *places.values()])
    errors = predicted_pointing(calibration, pixels[None], sample_depths()[:, None], nominal_px=nominal_px)
    middle, *rms = np.sqrt(np.mean(errors**2, axis=0)).tolist()
    return middle, {name: error for name, error in zip(places, rms, strict=True) if np.isfinite(error)}


def group_of(parameter: str) -> str:
    """The group that a parameter belongs to."""
    owner, _, kind = parameter.rpartition(".")
    plain = f"{owner.partition('[')[0]}.{kind}"
    return next((name for name, begins in GROUPS if plain.startswith(begins)), parameter)


def contributions(calibration: Calibration) -> tuple[Contribution, ...]:
    """What each group adds to the error at the longest focal length, the largest first.

    A group is taken as known exactly: what the others then leave, given it, is the conditional covariance. To clear
    its rows instead would count what it shares with the others twice.
    """
    covariance = calibration.covariance
    if not can_point(calibration) or covariance is None:
        return ()
    pixels, depths = sample_pixels(calibration), sample_depths()
    by_parameter, by_turn = miss_derivatives(
        model_of(calibration),
        covariance.parameters,
        np.tile(pixels, (len(depths), 1)),
        np.repeat(depths, len(pixels)),
        calibration.zoom.nominal_px[-1],
    )
    reached = np.isfinite(by_parameter).all(axis=(1, 2))
    if not reached.any():
        return ()
    J, turned = by_parameter[reached], by_turn[reached]
    weights = np.einsum("nik,nil->kl", J, J) / len(J)  # the mean of trace(J C J^T) is the sum of weights * C
    turns = float(np.sum(turned**2)) / len(J)

    def rms(matrix: Array, jitter: float) -> float:
        return float(np.sqrt(max(np.sum(weights * matrix) + jitter**2 * turns, 0.0)))

    found = []
    for group in dict.fromkeys(group_of(name) for name in covariance.parameters):
        known = np.array([group_of(name) == group for name in covariance.parameters])
        found.append(Contribution(group, rms(given(covariance, known).matrix, calibration.jitter)))
    if calibration.jitter:
        found.append(Contribution(JITTER_GROUP, rms(covariance.matrix, 0.0)))
    return tuple(sorted(found, key=lambda c: c.left))


def given(covariance: Covariance, known: npt.NDArray[np.bool_]) -> Covariance:
    """The covariance left when some parameters, (n,) booleans, are known exactly."""
    C = covariance.matrix
    scale = np.sqrt(np.maximum(np.diagonal(C), np.finfo(float).tiny))
    R = C / np.outer(scale, scale)
    rest = ~known
    left = np.zeros_like(R)
    through = R[np.ix_(rest, known)]
    left[np.ix_(rest, rest)] = R[np.ix_(rest, rest)] - through @ np.linalg.pinv(R[np.ix_(known, known)]) @ through.T
    return Covariance(covariance.parameters, left * np.outer(scale, scale))


def undetermined(calibration: Calibration) -> str:
    """Say what the covariance leaves undetermined, and what to add; empty where all is determined.

    What captures kept out have widened it by is taken out: that tells of a model that is wrong, and no views mend it.
    """
    covariance, held_out = calibration.covariance, calibration.held_out
    if covariance is None or not covariance.matrix.any():
        return ""
    focal = model_of(calibration).focal_px
    matrix = covariance.matrix / (1.0 if held_out is None else held_out.widened**2)
    normal = np.asarray(np.linalg.pinv(matrix, hermitian=True, rcond=np.finfo(float).tiny), dtype=float)
    return name_directions(covariance.parameters, weak_directions(normal, covariance.parameters, 1.0, focal), focal)
