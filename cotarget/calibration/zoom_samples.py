"""Extend a zoom lens by one sample at a time: predict it from those before, find its corners, and fit it."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cotarget.board import board_points
from cotarget.calibration.bundle import Prior, fit, predict_pixels
from cotarget.calibration.corners import find_corners, find_near
from cotarget.calibration.model import BundleModel, View
from cotarget.camera import Intrinsics, ZoomLens, distortion_growth
from cotarget.config import BoardConfig
from cotarget.errors import CalibrationError
from cotarget.geometry import Array
from cotarget.rig import Image

FINE = 1e-9  # rounding of a logarithm
SAME_FOCAL = 0.008  # relative; a step of a usual lens changes the focal length by 0.02
# Weak prior of a lens: its pupil moves by some decimetres over the range, and its distortion in the image stays within
# several times the usual. Boards all over the image determine both far better.
PUPIL_SIGMA = 0.2  # [m]
BENT_SIGMAS = {"k1": (0.5, 2), "k2": (1.0, 4), "p1": (0.05, 1), "p2": (0.05, 1)}  # with the power of the focal length
INSIDE_PX = 2.0  # a corner predicted this far inside the image is expected to be seen
# Largest ratio of one zoom sample's focal length to that of the one before. The errors of the prediction, such as a
# principal point mistaken for a turn of the camera, grow with it; at 3.5 one session in three lost the next sample.
LARGEST_LEAP = 2.5
FEWEST_STOP_VIEWS, FEWEST_STOP_PLACEMENTS = 3, 2  # fewest views and placements of a zoom sample
FEWEST_CORNERS = 6  # of a board seen in part: enough for a lens's magnification and axis


def spread_stops(shortest_px: float, longest_px: float, count: int) -> list[float]:
    """Spread nominal focal lengths evenly in their logarithm [px]; a lens that does not zoom has the shortest alone."""
    if longest_px <= shortest_px * (1 + SAME_FOCAL) or count < 2:
        return [shortest_px]
    return [float(f) for f in np.geomspace(shortest_px, longest_px, count)]


def fewest_stops(shortest_px: float, longest_px: float) -> int:
    """Count the zoom samples, evenly spread in the logarithm, whose ratio stays within `LARGEST_LEAP`."""
    return 1 + math.ceil(math.log(longest_px / shortest_px) / math.log(LARGEST_LEAP) - FINE)


def stops_of(views: Sequence[View]) -> list[float]:
    """List the nominal focal lengths of the zoom views, increasing [px]; empty where no view has one."""
    stops: list[float] = []
    for focal in sorted({view.focal_px for view in views if view.camera == "zoom" and view.focal_px is not None}):
        if not stops or focal > stops[-1] * (1 + SAME_FOCAL):
            stops.append(focal)
    return stops


def same_focal(view: View, nominal_px: float) -> bool:
    """Check whether a view was taken at a nominal focal length [px], within `SAME_FOCAL`."""
    return view.focal_px is not None and abs(view.focal_px / nominal_px - 1) <= SAME_FOCAL


def with_stop(lens: ZoomLens, nominal_px: float) -> ZoomLens:
    """Extrapolate a lens by one zoom sample beyond its last.

    The ratio of true to nominal focal length and the principal point continue their trend; the distortion of the image
    and the pupil stay.
    """
    last = lens.stops[-1]
    magnified = nominal_px / lens.nominal_px[-1]
    focal, center = np.array(last.focal_px) * magnified, np.array(last.center_px)
    distortion = np.zeros(5)  # one sample does not show how the image's distortion changes with the focal length
    if len(lens.stops) > 1:
        before = lens.stops[-2]
        distortion = np.array(last.distortion) * distortion_growth(magnified)
        onward = np.log(magnified) / np.log(lens.nominal_px[-1] / lens.nominal_px[-2])
        ratio, earlier = (
            np.array(stop.focal_px) / nominal
            for stop, nominal in zip((last, before), lens.nominal_px[:-3:-1], strict=True)
        )
        focal = focal * (ratio / earlier) ** onward
        center = center + onward * (center - np.array(before.center_px))
    (fx, fy), (cx, cy), (k1, k2, p1, p2, k3) = focal.tolist(), center.tolist(), distortion.tolist()
    guess = Intrinsics(last.size, (fx, fy), (cx, cy), (k1, k2, p1, p2, k3))
    return ZoomLens((*lens.nominal_px, nominal_px), (*lens.stops, guess), (*lens.pupil, lens.pupil[-1]))


def lens_prior(model: BundleModel) -> Prior:
    """Make the prior of the zoom samples beyond the first, from `PUPIL_SIGMA` and `BENT_SIGMAS`."""
    lens = model.head.lens
    sigmas: dict[str, float] = {}
    stops = []
    for i, (stop, nominal) in enumerate(zip(lens.stops, lens.nominal_px, strict=True)):
        m = nominal / lens.nominal_px[0]
        stops.append(replace(stop, distortion=(0.0,) * 5) if i else stop)
        if i:
            sigmas[f"zoom[{i}].pupil"] = PUPIL_SIGMA
            sigmas |= {f"zoom[{i}].{name}": sigma * m**power for name, (sigma, power) in BENT_SIGMAS.items()}
    return Prior(model.with_zoom_head(lens=ZoomLens(lens.nominal_px, tuple(stops))), sigmas)


def fit_stop(model: BundleModel, number: int, views: Sequence[View], points: Array) -> BundleModel:
    """Fit one zoom sample, of which the model has a first guess; every other parameter of the model is held.

    The views are those at that sample, and of the fixed camera of the same placements. The boards' poses are free
    during the fit, and are returned as they were.
    """
    known = lens_prior(model)
    own = f"zoom[{number}]."  # without a prior the other samples, which have no views here, do not move
    prior = Prior(known.reference, {name: sigma for name, sigma in known.sigmas.items() if name.startswith(own)})
    found = fit(model, views, points, ("zoom", "pupil"), prior=prior)
    return replace(found.model, boards=model.boards)


def expected_inside(expected_px: Array, size: tuple[int, int]) -> Array:
    """Check which predicted corners lie inside the image, (N,)."""
    with np.errstate(invalid="ignore"):
        low = (expected_px >= INSIDE_PX).all(axis=-1)
        return np.asarray(low & (expected_px <= np.array(size) - 1 - INSIDE_PX).all(axis=-1))


def find_expected(image: Image, view: View, model: BundleModel, board: BoardConfig) -> Array | None:
    """Find a board, whole or in part, where a model with its pose expects it; None where it is not found surely."""
    expected_px = predict_pixels(model, [view], board_points(board))[0]
    inside = expected_inside(expected_px, (image.shape[1], image.shape[0]))
    found = None
    if inside.all():
        found = find_corners(image, board, thorough=False)
    if found is None and np.count_nonzero(inside) >= FEWEST_CORNERS:
        found = find_near(image, board, expected_px)
    if found is not None and np.count_nonzero(np.isfinite(found[:, 0])) < FEWEST_CORNERS:
        return None
    return found


def check_stops(model: BundleModel) -> None:
    """Refuse a lens whose true focal length does not grow with the nominal one."""
    lens = model.head.lens
    for (n, one), (m, other) in itertools.pairwise(zip(lens.nominal_px, lens.stops, strict=True)):
        a, b = one.focal_px[0], other.focal_px[0]
        if b <= a:
            raise CalibrationError(
                f"zoom lens: the true focal length comes out as {a:.0f} px at {n:.0f} px and {b:.0f} px at {m:.0f} px "
                "as the device reports them; check that the lens stood still where it reported to be"
            )
