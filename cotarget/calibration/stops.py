"""The zoom lens's stops: from the shortest focal length on, each is looked for where the one before lets expect it.

At long focal lengths the zoom camera sees a part of a board that stands far enough for the fixed camera to see it
whole. Where its corners should be follows from the fixed camera's view, the head and a guess of the lens, so that they
can be told apart; and each stop, once seen, makes a good guess of the next.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cotarget.calibration.boards import find_corners
from cotarget.calibration.bundle import fit
from cotarget.calibration.model import View
from cotarget.calibration.normal import Prior
from cotarget.calibration.parameters import RigModel
from cotarget.calibration.partial import find_near
from cotarget.calibration.reprojection import predict_pixels
from cotarget.camera import ZoomLens, distortion_growth
from cotarget.config import BoardConfig
from cotarget.errors import CalibrationError
from cotarget.geometry import Array
from cotarget.rig import Image

FINE = 1e-9  # rounding of a logarithm
SAME_FOCAL = 0.008  # relative; a step of a usual lens changes the focal length by 0.02
# What is known of a lens before it is seen: its pupil moves by some decimetres over the range; and distortion, measured
# in the image, stays within several times of what lenses have. Boards all over the image know either far better.
PUPIL_SIGMA = 0.2  # [m]
BENT_SIGMAS = {"k1": (0.5, 2), "k2": (1.0, 4), "p1": (0.05, 1), "p2": (0.05, 1)}  # and the power of the focal length
INSIDE_PX = 2.0  # a corner predicted this far inside the image is expected to be seen
# A stop is found by where the one before lets expect the board's corners. What that one leaves open, a principal point
# that is taken for a turn of the camera, grows with the focal length: in three sessions of eight placements, rendered
# without multisampling, a stop 12 times as far was lost in two, 3.5 times as far in one, 2.3 times in none.
LARGEST_LEAP = 2.5
FEWEST_CORNERS = 6  # of a board seen in part, that tell how a lens magnifies and where its axis is


def spread_stops(shortest_px: float, longest_px: float, count: int) -> list[float]:
    """Nominal focal lengths evenly spread in their logarithm [px]; the shortest alone for a lens that does not zoom."""
    if longest_px <= shortest_px * (1 + SAME_FOCAL) or count < 2:
        return [shortest_px]
    return [float(f) for f in np.geomspace(shortest_px, longest_px, count)]


def fewest_stops(shortest_px: float, longest_px: float) -> int:
    """How many stops it takes, evenly spread in their logarithm, to get surely from one to the next."""
    return 1 + math.ceil(math.log(longest_px / shortest_px) / math.log(LARGEST_LEAP) - FINE)


def stops_of(views: Sequence[View]) -> list[float]:
    """The nominal focal lengths at which the zoom camera was, increasing [px]; empty where no device told one."""
    stops: list[float] = []
    for focal in sorted({view.focal_px for view in views if view.camera == "zoom" and view.focal_px is not None}):
        if not stops or focal > stops[-1] * (1 + SAME_FOCAL):
            stops.append(focal)
    return stops


def same_focal(view: View, nominal_px: float) -> bool:
    """Whether a view was taken at a nominal focal length [px]."""
    return view.focal_px is not None and abs(view.focal_px / nominal_px - 1) <= SAME_FOCAL


def with_stop(lens: ZoomLens, nominal_px: float) -> ZoomLens:
    """A lens with one more stop beyond its last, guessed: ratio and centre go on as they went, the rest stays."""
    last = lens.stops[-1]
    magnified = nominal_px / lens.nominal_px[-1]
    k1, k2, p1, p2, k3 = (float(k) for k in np.array(last.distortion) * distortion_growth(magnified))
    distortion = (k1, k2, p1, p2, k3)
    focal, center = np.array(last.focal_px) * magnified, np.array(last.center_px)
    if len(lens.stops) > 1:
        before = lens.stops[-2]
        onward = np.log(magnified) / np.log(lens.nominal_px[-1] / lens.nominal_px[-2])
        ratio, earlier = (
            np.array(stop.focal_px) / nominal
            for stop, nominal in zip((last, before), lens.nominal_px[:-3:-1], strict=True)
        )
        focal = focal * (ratio / earlier) ** onward
        center = center + onward * (center - np.array(before.center_px))
    else:
        distortion = (0.0,) * 5  # one stop does not tell how the image's distortion goes on
    guess = replace(
        last,
        focal_px=(float(focal[0]), float(focal[1])),
        center_px=(float(center[0]), float(center[1])),
        distortion=distortion,
    )
    return ZoomLens((*lens.nominal_px, nominal_px), (*lens.stops, guess), (*lens.pupil, lens.pupil[-1]))


def lens_prior(model: RigModel) -> Prior:
    """What is known of a zoom lens beyond its first stop before it is seen; see `PUPIL_SIGMA` and `BENT_SIGMAS`."""
    assert model.zoom is not None
    sigmas: dict[str, float] = {}
    stops = []
    for i, (stop, nominal) in enumerate(zip(model.zoom.stops, model.zoom.nominal_px, strict=True)):
        m = nominal / model.zoom.nominal_px[0]
        stops.append(replace(stop, distortion=(0.0,) * 5) if i else stop)
        if i:
            sigmas[f"zoom[{i}].pupil"] = PUPIL_SIGMA
            sigmas |= {f"zoom[{i}].{name}": sigma * m**power for name, (sigma, power) in BENT_SIGMAS.items()}
    still = ZoomLens(model.zoom.nominal_px, tuple(stops))
    return Prior(replace(model, zoom=still), sigmas)


def fit_stop(model: RigModel, number: int, views: Sequence[View], points: Array) -> RigModel:
    """Fit one stop alone to views at it, the boards where they are, everything else as it is.

    Args:
        model: with the boards of the views' placements.
        number: of the stop.
        views: of the zoom camera at that stop, and of the fixed camera of the same placements.
        points: the board's corners in its frame [m], (N, 3).
    """
    known = lens_prior(model)
    own = f"zoom[{number}]."  # nothing is to draw the other stops, which have no views here
    prior = Prior(known.reference, {name: sigma for name, sigma in known.sigmas.items() if name.startswith(own)})
    found = fit(model, views, points, ("zoom", "pupil"), prior=prior)
    return replace(found.model, boards=model.boards)


def expected_corners(model: RigModel, view: View, points: Array) -> Array:
    """Where the corners of a view's board should be, (N, 2) [px]; nan behind the camera.

    Args:
        model: with the board's place, and a stop at the view's focal length.
        view: its corners do not matter.
        points: the board's corners in its frame [m], (N, 3).
    """
    return predict_pixels(model, [view], points)[0]


def expected_inside(expected_px: Array, size: tuple[int, int]) -> Array:
    """Which corners are expected in the image, (N,)."""
    with np.errstate(invalid="ignore"):
        low = (expected_px >= INSIDE_PX).all(axis=-1)
        return np.asarray(low & (expected_px <= np.array(size) - 1 - INSIDE_PX).all(axis=-1))


def find_expected(image: Image, board: BoardConfig, expected_px: Array) -> Array | None:
    """Find a board, whole or in part, that is expected at (N, 2) [px]; None where it is not surely there."""
    inside = expected_inside(expected_px, (image.shape[1], image.shape[0]))
    found = None
    if inside.all():
        found = find_corners(image, board, thorough=False)
    if found is None and np.count_nonzero(inside) >= FEWEST_CORNERS:
        found = find_near(image, board, expected_px)
    if found is not None and np.count_nonzero(np.isfinite(found[:, 0])) < FEWEST_CORNERS:
        return None
    return found


def check_stops(model: RigModel) -> None:
    """Refuse a lens whose true focal length does not grow with the nominal one.

    Raises:
        CalibrationError: two stops contradict each other.
    """
    assert model.zoom is not None
    focal = [stop.focal_px[0] for stop in model.zoom.stops]
    for i, (a, b) in enumerate(itertools.pairwise(focal)):
        if b <= a:
            n = model.zoom.nominal_px
            raise CalibrationError(
                f"zoom lens: the true focal length comes out as {a:.0f} px at {n[i]:.0f} px and {b:.0f} px at "
                f"{n[i + 1]:.0f} px by the device's account; check that the lens stood still and was where it said"
            )
