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

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cotarget.calibration.bundle import (
    ALL_BLOCKS,
    MEDIAN_TO_SIGMA,
    Block,
    Fit,
    Prior,
    fit,
    parameter_names,
    rms,
    robust_sigma,
)
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
from cotarget.calibration.jitter import estimate_jitter, head_turns
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
from cotarget.calibration.zoom_samples import (
    FEWEST_STOP_PLACEMENTS,
    FEWEST_STOP_VIEWS,
    check_stops,
    fit_stop,
    lens_prior,
    with_stop,
)
from cotarget.errors import CalibrationError
from cotarget.geometry import Array

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
