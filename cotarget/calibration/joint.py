"""Joint calibration: one fit of all parameters over the corners of all images.

1. Start: each camera by itself at the shortest focal length, T from the motions of head and camera, Gamma from every
   placement that both cameras see at any head pose. Nothing is assumed of how the cameras are mounted.
2. One fit of both cameras, Gamma, T and the head's geometry to all views at the shortest focal length.
3. The zoom samples one after the other, each predicted from the one before; then one fit of everything.
4. Views for which the head stood elsewhere than it reported, and single wrong corners, are left out. The head's jitter
   is estimated, and the fixed camera's k3 where it is significant.
5. Covariance: parameters held in the fit (k3, encoder scales) are considered; captures kept out of the fit widen it
   where they are missed by more than predicted.

At long focal lengths the zoom image shows only a part of a board that stands far enough for the fixed camera to see it
whole. The corners are numbered by a prediction from the fixed camera's view, the head's pose and the lens.
Measurements: docs/design-notes.md.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from cotarget.board import board_points
from cotarget.calibration.bundle import (
    ALL_BLOCKS,
    MEDIAN_TO_SIGMA,
    POSE_PARAMETERS,
    SMALLEST_SIGMA_PX,
    TURNS,
    Block,
    Fit,
    Prior,
    Problem,
    batches_of,
    damped,
    fit,
    huber_weights,
    masked,
    parameter_names,
    predict_pixels,
    reduced,
    rms,
    robust_scale,
    robust_sigma,
)
from cotarget.calibration.corners import find_corners, find_near
from cotarget.calibration.initialization import (
    Steps,
    at_home,
    both_cameras,
    check_pairs,
    of_both,
    pairs_at_home,
    place_boards,
    rough_gamma,
    rough_hand,
    stereo,
)
from cotarget.calibration.model import (
    DEFAULT_OPTIONS,
    BundleModel,
    CameraName,
    Covariance,
    HeldOut,
    Options,
    Rejected,
    Residuals,
    Solution,
    View,
    stop_of,
)
from cotarget.calibration.observability import limits_of_use, name_directions, weak_directions
from cotarget.calibration.uncertainty import covariance_of, cross_validate, with_consider_covariance
from cotarget.camera import Intrinsics, ZoomLens, distortion_growth
from cotarget.config import BoardConfig
from cotarget.errors import CalibrationError
from cotarget.geometry import Array
from cotarget.rig import Image

# The head's jitter

# Range of the search [rad], and twice the log-likelihood ratio from which jitter is accepted: chance exceeds it once in
# twenty times (a half chi-square at its border).
JITTER_RANGE = (1e-7, 0.1)
JITTER_EVIDENCE = 2.71
TURN_ROUNDS = 6
RELATIVE_ROUNDING = 1e-10  # rounding of a normal matrix after the boards' poses are eliminated by subtraction


def estimate_jitter(found: Fit, points: Array, prior: Prior | None = None) -> float:
    """Estimate the head's jitter [rad] by restricted maximum likelihood; 0 where the corners give no evidence of it.

    With the variance of the corners profiled out, the likelihood of a jitter needs only the normal equations of the fit
    without jitter (Patterson and Thompson 1971; Harville 1977). Jitter that the fit has assumed affects only the
    weights of its corners.
    """
    problem = Problem(batches_of(found.model, found.views), points, found.free, prior, found.jitter)
    if found.variance is None or not any(batch.stop is not None for batch in problem.batches):
        return 0.0
    here = problem.at(found.model)
    grams = problem.grams(here, robust_scale(here))
    coordinates = 2 * sum(int(batch.seen.sum()) for batch in problem.batches)
    freedom = coordinates - len(found.normal) - POSE_PARAMETERS * len(found.model.boards)

    def profiled(ratio: float) -> tuple[float, Array, Array]:
        """Compute the squares at the optimum, the reduced matrix and the boards' inverses at jitter^2 / variance."""
        equations = problem.assembled(here, grams, 1 / ratio if ratio else np.inf)
        matrix, gradient, inverse = reduced(equations, 0.0)
        matrix = matrix + damped(matrix, RELATIVE_ROUNDING)  # so that an undetermined direction does not move
        left = equations.squares - gradient @ np.linalg.solve(matrix, gradient)
        left -= np.einsum("bi,bij,bj->", equations.board_gradient, inverse, equations.board_gradient)
        return max(float(left), SMALLEST_SIGMA_PX**2), matrix, inverse

    def minus_twice_log_likelihood(ratio: float) -> float:
        left, matrix, inverse = profiled(ratio)
        spread = float(np.linalg.slogdet(matrix)[1] - np.linalg.slogdet(inverse)[1].sum())
        turns = slice(-1 - TURNS, -1)
        for batch, (_, gram) in zip(problem.batches, grams, strict=True):
            if batch.stop is not None:
                spread += float(np.linalg.slogdet(np.eye(TURNS) + ratio * gram[:, turns, turns])[1].sum())
        return float(freedom * np.log(left) + spread)

    lowest, highest = (float(2 * np.log(sigma) - np.log(found.variance)) for sigma in JITTER_RANGE)
    best = minimize_scalar(lambda x: minus_twice_log_likelihood(np.exp(x)), bounds=(lowest, highest), method="bounded")
    if minus_twice_log_likelihood(0.0) - best.fun < JITTER_EVIDENCE:
        return 0.0
    return float(np.sqrt(np.exp(best.x) * profiled(np.exp(best.x))[0] / freedom))


def head_turns(found: Fit, points: Array) -> Array:
    """Estimate by how much each zoom view's true pan and tilt differ from the reported ones, (V, 2) [rad].

    All else stays as fitted. Views of the fixed camera have nan.
    """
    problem = Problem(batches_of(found.model, found.views), points, (), None, 0.0)
    here = problem.at(found.model)
    turns = np.full((len(found.views), TURNS), np.nan)
    for batch, p, r in zip(problem.batches, here.predictions, here.residuals, strict=True):
        if p.by_turn is None:
            continue
        Q, after = masked(p.by_turn, batch), r
        for _ in range(TURN_ROUNDS):  # reweighted, so that wrong corners do not turn a view
            weighted = Q * huber_weights(after, robust_scale(here))[..., None, None]
            own = np.einsum("vnik,vnil->vkl", weighted, Q)
            turn = -np.linalg.solve(
                own + damped(own, RELATIVE_ROUNDING), np.einsum("vnik,vni->vk", weighted, r)[..., None]
            )[..., 0]
            after = r + np.einsum("vnik,vk->vni", Q, turn)
        turns[batch.rows] = turn
    return turns


# Zoom samples

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


# The method

# A corner beyond this many standard deviations and beyond the floor is wrong. Chance makes one Gaussian corner in 65
# million so.
WRONG_SIGMAS, WRONG_FLOOR_PX = 6.0, 0.5
WRONG_SHARE = 0.3  # a view with a larger share of wrong corners is left out as a whole
NO_PLACE = "its board is seen by neither camera at the shortest focal length, so that its pose is unknown"
# A view is left out when the head stands this many times farther from the reported angles than usual, and by more than
# the floor [rad], which allows for the backlash and sag of usual heads.
WRONG_HEAD_SIGMAS, WRONG_HEAD_FLOOR = 6.0, np.radians(0.05)
JITTER_ROUNDS, SETTLED = 5, 0.03  # rounds of jitter and parameters in turn; relative change at which they end
LARGEST_JITTER = np.radians(1.5)
FEWEST_STOP_VIEWS, FEWEST_STOP_PLACEMENTS = 3, 2  # fewest views and placements of a zoom sample
# Prior of the board's warp over its length: a board of one metre, glued to a sheet, is flat to some millimetres.
WARP_SHARE = 0.004
# k3 of the fixed camera is freed where it is this many standard deviations from 0, which chance does for one lens in
# sixteen thousand; below that it is considered (`with_consider_covariance`). K3_WIDE is its prior's sigma until then.
K3_SIGMAS, K3_WIDE = 4.0, 1.0
# A lens that needs k3 does not follow this model, and departs from it more where no board was seen. This factor on the
# standard deviations covers rational and fisheye lenses whose nearest fit is 0.2 px off
# (experiments.calibration.mismatch).
K3_WIDENED = 1.4
# Blocks that are held unless they are freed, and considered in the covariance.
CONSIDERED: tuple[Block, ...] = ("k3", "scale")
# Prior of the encoders: gears are cut to a thousandth or two, and zeros are found to half a degree.
ENCODER_SIGMAS = {
    "head.pan_scale": 0.002,
    "head.tilt_scale": 0.002,
    "head.pan_zero": np.radians(0.5),
    "head.tilt_zero": np.radians(0.5),
}


def joint(
    views: Sequence[View],
    points: Array,
    sizes: Mapping[CameraName, tuple[int, int]],
    nominal_px: Sequence[float] = (),
    options: Options = DEFAULT_OPTIONS,
) -> Solution:
    """Calibrate a rig by one fit of all parameters.

    The zoom samples' nominal focal lengths [px] increase; there are none where the lens reports none.

    Raises:
        CalibrationError: the views do not determine the rig; the message says what is missing.
    """
    shortest = [view for view in views if view.camera == "fixed" or stop_of(nominal_px, view) == 0]
    steps = both_cameras(shortest, points, sizes, nominal_px[0] if nominal_px else None)
    if not of_both(steps.views):
        raise CalibrationError("no placement of the board is seen by both cameras; turn the head so that both see it")
    if not steps.has_head and any(view.camera == "zoom" and not at_home(view) for view in views):
        raise CalibrationError("the head moved only at other focal lengths than the shortest; turn it there as well")
    model = steps.model
    if steps.has_head:
        model = model.with_zoom_head(T_head_zoom=rough_hand(model, steps.views, points, regularize=options.regularize))
    model = model.with_zoom_head(T_zoom0_fixed=rough_gamma(model, of_both(steps.views), points))
    used, rejected = list(steps.views), list(steps.rejected)
    blocks = tuple(block for block in ALL_BLOCKS if steps.has_head or block not in ("hand", "head"))
    warp_sigma = WARP_SHARE * float(np.ptp(points, axis=0).max())
    ties: tuple[Block, ...] = ("gamma", "hand") if steps.has_head else ("gamma",)
    if options.encoders and steps.has_head:
        blocks = (*blocks, "scale", "zero")
    start = model
    prior = _known(model, start, blocks, options, warp_sigma)
    model = fit(place_boards(model, used, points), used, points, ties, prior=prior).model
    result = fit(model, used, points, blocks, prior=prior)
    if len(nominal_px) > 1:
        model, used, more = _all_stops(result, views, points, nominal_px)
        rejected += more
        prior = _known(model, start, blocks, options, warp_sigma)
        result = fit(model, used, points, blocks, prior=prior)
        check_stops(result.model)
    everything = result
    result, wrong, left_out = _cleaned(everything, points, prior)
    with_k3, k3_prior = _with_k3_where_needed(result, points, prior)
    if "k3" in with_k3.free:  # corners that k3 explains are not wrong, so all are judged again
        prior = k3_prior
        again = fit(with_k3.model, everything.views, points, with_k3.free, prior=prior)
        result, wrong, left_out = _cleaned(again, points, prior)
    rejected += left_out
    check_pairs(steps, rms(result.residuals))
    names, lenses = parameter_names(result.free, result.model.stops), result.model.lenses
    open_ = weak_directions(result.normal, names, result.variance or 0.0, lenses)
    if not options.regularize and len(open_):
        raise CalibrationError(name_directions(names, open_, lenses))
    covariance, held_out, widened = _uncertainty(result, points, prior, options)
    return Solution(
        model=result.model,
        residuals=_residuals(steps, result, points, rejected, wrong),
        views=result.views,
        has_head=steps.has_head,
        covariance=covariance,
        jitter=result.jitter * widened,
        held_out=held_out,
    )


def _uncertainty(
    found: Fit, points: Array, prior: Prior, options: Options
) -> tuple[Covariance | None, HeldOut | None, float]:
    """Compute the covariance of a fit with consider parameters, the held-out check, and the widening by both."""
    widened = K3_WIDENED if "k3" in found.free else 1.0
    covariance = covariance_of(found)
    if covariance is None:
        return None, None, widened
    held_out = cross_validate(found, points, prior, options.folds) if options.folds else None
    widened = max(widened, 1.0 if held_out is None else held_out.widened)
    held = [block for block in CONSIDERED if block not in found.free and (block != "scale" or "hand" in found.free)]
    usual = Prior(prior.reference, {**prior.sigmas, "fixed.k3": K3_WIDE, **ENCODER_SIGMAS})
    covariance = with_consider_covariance(covariance, found, points, held, usual)
    return replace(covariance, matrix=covariance.matrix * widened**2), held_out, widened


def _known(
    model: BundleModel, start: BundleModel, blocks: Sequence[Block], options: Options, warp_sigma: float
) -> Prior:
    """Make the prior of the board's warp, the zoom lens, the encoders, and of T, Gamma and head if regularized.

    The prior of T, Gamma and the head's geometry is at the start, with `limits_of_use` as standard deviations. It does
    not change directions that the corners determine, and it bounds the uncertainty of the others.
    """
    sigmas = dict.fromkeys(("board.warp_x", "board.warp_y"), warp_sigma)
    known = model
    if model.stops > 1:
        lens = lens_prior(model)
        known, sigmas = lens.reference, {**sigmas, **lens.sigmas}
    reference = start.with_zoom_head(lens=known.head.lens)
    if options.regularize:
        names = [
            name for name in parameter_names(blocks, model.stops) if not name.startswith(("fixed.", "zoom[", "board."))
        ]
        sigmas |= dict(zip(names, limits_of_use(names).tolist(), strict=True))
    if "scale" in blocks:
        sigmas |= ENCODER_SIGMAS
    return Prior(reference, sigmas)


def _all_stops(
    found: Fit, views: Sequence[View], points: Array, nominal_px: Sequence[float]
) -> tuple[BundleModel, list[View], list[Rejected]]:
    """Add the zoom samples beyond the first, each fitted by itself; return also the views used and left out."""
    model, used, rejected = found.model, list(found.views), []
    for number, nominal in enumerate(nominal_px[1:], start=1):
        at_stop = [v for v in views if v.camera == "zoom" and stop_of(nominal_px, v) == number]
        here = [v for v in at_stop if v.board in model.boards]
        rejected += [Rejected(v.name, NO_PLACE) for v in at_stop if v.board not in model.boards]
        if len(here) < FEWEST_STOP_VIEWS or len({view.board for view in here}) < FEWEST_STOP_PLACEMENTS:
            rejected += [
                Rejected(v.name, f"{len(here)} views at {nominal:.0f} px are too few for a zoom sample") for v in here
            ]
            continue
        seen_too = {view.board for view in here}
        with_fixed = [view for view in used if view.camera == "fixed" and view.board in seen_too]
        start = model.with_zoom_head(lens=with_stop(model.head.lens, nominal))
        model = fit_stop(start, start.stops - 1, [*with_fixed, *here], points)
        used += here
    return model, used, rejected


def _cleaned(found: Fit, points: Array, prior: Prior) -> tuple[Fit, int, list[Rejected]]:
    """Leave out views with a wrong head pose and wrong corners, and estimate the head's jitter.

    Returns the fit of the rest, the number of single corners left out, and the views left out.
    """
    found, by_head = _without_wrong_heads(found, points, prior)
    found, wrong, by_corners = _without_wrong_corners(found, points, prior)
    return found, wrong, [*by_head, *by_corners]


def _without_wrong_heads(found: Fit, points: Array, prior: Prior) -> tuple[Fit, list[Rejected]]:
    """Leave out views for which the head stood much farther from the reported angles than for others."""
    if "hand" not in found.free:
        return found, []
    off = np.linalg.norm(head_turns(found, points), axis=-1)
    limit = max(WRONG_HEAD_SIGMAS * float(np.nanmedian(off)) * MEDIAN_TO_SIGMA, WRONG_HEAD_FLOOR)
    kept, rejected = [], []
    for view, angle in zip(found.views, off, strict=True):
        if angle > limit:
            rejected.append(Rejected(view.name, f"the head stood {np.degrees(angle):.2f} degrees off its report"))
        else:
            kept.append(view)
    return (fit(found.model, kept, points, found.free, prior=prior) if rejected else found), rejected


def _without_wrong_corners(found: Fit, points: Array, prior: Prior) -> tuple[Fit, int, list[Rejected]]:
    """Leave out corners with far too large residuals, and estimate the head's jitter; returns as `_cleaned`."""
    found = _with_jitter(found, points, prior)
    lengths = np.linalg.norm(found.adjusted, axis=-1)  # nan for corners that are not seen
    limit = max(WRONG_SIGMAS * robust_sigma(found.adjusted[np.isfinite(lengths)]), WRONG_FLOOR_PX)
    wrong = lengths > limit
    if not wrong.any():
        return found, 0, []
    views, rejected, count = [], [], 0
    for view, bad in zip(found.views, wrong, strict=True):
        share = bad.sum() / view.seen.sum()
        if share > WRONG_SHARE:
            rejected.append(Rejected(view.name, f"{bad.sum()} of its {view.seen.sum()} corners are {limit:.1f} px off"))
            continue
        count += int(bad.sum())
        views.append(replace(view, corners_px=np.where(bad[:, None], np.nan, view.corners_px)) if bad.any() else view)
    again = fit(found.model, views, points, found.free, prior=prior, jitter=found.jitter)
    if found.jitter:  # the corners now left out looked like jitter before
        again = _with_jitter(again, points, prior)
    return again, count, rejected


def _with_jitter(found: Fit, points: Array, prior: Prior) -> Fit:
    """Estimate the head's jitter and fit again with it, in turn until both settle."""
    if "hand" not in found.free:
        return found
    for _ in range(JITTER_ROUNDS):
        jitter = estimate_jitter(found, points, prior)
        if jitter > LARGEST_JITTER:
            raise CalibrationError(
                f"the head misses what it reports by {np.degrees(jitter):.1f} degrees in each axis; check that pan and "
                "tilt are not exchanged, that every image has its own angles, and that boards stood still"
            )
        if abs(jitter - found.jitter) <= SETTLED * jitter:
            break
        found = fit(found.model, found.views, points, found.free, prior=prior, jitter=jitter)
    return found


def _with_k3_where_needed(found: Fit, points: Array, prior: Prior) -> tuple[Fit, Prior]:
    """Free the fixed camera's k3 where its estimate is significant (`K3_SIGMAS`); return the fit and its prior.

    The variance of its prior is k3^2 less the estimate's variance (empirical Bayes), so that a smaller k3 is drawn
    towards 0.
    """
    free: tuple[Block, ...] = (*found.free, "k3")

    def fitted(start: Fit, sigma: float) -> tuple[Fit, Prior]:
        known = Prior(prior.reference, {**prior.sigmas, "fixed.k3": sigma})
        return fit(start.model, start.views, points, free, prior=known, jitter=found.jitter), known

    freely, _ = fitted(found, K3_WIDE)
    covariance = covariance_of(freely)
    if covariance is None:
        return found, prior
    k3, sigma = freely.model.fixed.lens.distortion[4], covariance.sigma("fixed.k3")
    return fitted(freely, float(np.sqrt(k3**2 - sigma**2))) if abs(k3) > K3_SIGMAS * sigma else (found, prior)


def _residuals(steps: Steps, result: Fit, points: Array, rejected: Sequence[Rejected], wrong: int) -> Residuals:
    """Compute the rms of each part fitted by itself, as is customary, and that of the joint fit."""
    pairs = pairs_at_home(result.views)
    stereo_px = stereo(steps.model, pairs, points).rms_px if pairs else None
    handeye_px = rms(result.residuals[[view.camera == "zoom" for view in result.views]])
    return steps.residuals(result.views, rejected, stereo_px=stereo_px, handeye_px=handeye_px, outliers=wrong)
