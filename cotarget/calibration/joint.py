"""The joint method: one fit of everything over the corners of all images.

1. A start that assumes nothing of how the cameras are mounted: each camera by itself at the shortest focal length, T
   from the motions of head and camera, Gamma from every placement that both cameras see, whatever the head's pose.
2. One fit of both cameras, Gamma, T and the head's geometry from all views at the shortest focal length.
3. The zoom lens's stops one after the other, each beginning where the one before ended; then everything together.
4. Views for which the head stood elsewhere than it says, and single corners that are wrong, are left out; the head's
   jitter is estimated; and the fixed camera's k3, where the corners ask for it.
5. The uncertainty counts what is held and may be wrong all the same, k3 and the encoders' scales; what captures kept
   out of the fit say widens it where they disagree with it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cotarget.calibration.bundle import Fit, fit
from cotarget.calibration.considered import with_considered
from cotarget.calibration.heldout import cross_validate
from cotarget.calibration.jitter import estimate_jitter, head_turns
from cotarget.calibration.model import DEFAULT_OPTIONS, CameraName, Options, Rejected, Residuals, View
from cotarget.calibration.normal import Prior
from cotarget.calibration.observability import limits_of_use, name_directions, weak_directions
from cotarget.calibration.parameters import ALL_BLOCKS, Block, RigModel, parameter_names, stop_of
from cotarget.calibration.placing import place_boards
from cotarget.calibration.robust import MEDIAN_TO_SIGMA, rms, robust_sigma
from cotarget.calibration.sequential import Solution, Steps, both_cameras, check_pairs, stereo
from cotarget.calibration.start import at_home, of_both, pairs_at_home, rough_gamma, rough_hand
from cotarget.calibration.stops import check_stops, fit_stop, lens_prior, with_stop
from cotarget.calibration.uncertainty import covariance_of
from cotarget.errors import CalibrationError
from cotarget.geometry import Array

# A corner further off than this many standard deviations, and than the floor, is wrong: of Gaussian ones, one in
# 65 million is.
WRONG_SIGMAS, WRONG_FLOOR_PX = 6.0, 0.5
WRONG_SHARE = 0.3  # a view with more wrong corners than this is left out as a whole
NO_PLACE = "its board is seen by neither camera at the shortest focal length, so that nothing tells where it is"
# A view is left out when the head would have to stand this many times further than usual from where it says, and by
# more than the floor: backlash and sag of usual heads.
ELSEWHERE_SIGMAS, ELSEWHERE_FLOOR = 6.0, np.radians(0.05)
JITTER_ROUNDS, SETTLED = 5, 0.03  # the jitter found and the parameters depend on each other
LARGEST_JITTER = np.radians(1.5)
FEWEST_STOP_VIEWS, FEWEST_STOP_PLACEMENTS = 3, 2  # of a stop of the zoom lens
# A board of one metre, glued to a sheet of something, is flat to some millimetres (as a share of its length).
WARP_SHARE = 0.004
# The fixed camera's k3 is found too where it is this many standard deviations from 0, by chance of one lens in sixteen
# thousand; below that it is doubted (`considered`).
K3_SIGMAS, K3_WIDE = 4.0, 1.0
# A lens that asks for k3 is not of this model, and departs from it further where no board was seen: the uncertainty is
# widened by this, which covers rational and fisheye lenses whose nearest fit is 0.2 px off (experiments.mismatch).
K3_WIDENED = 1.4
# Held where they are not found, and doubted where the corners speak against that.
CONSIDERED: tuple[Block, ...] = ("k3", "scale")
# Encoders, where they are asked for: gears are cut to a thousandth or two, zeros are found to half a degree.
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
    """Calibrate a rig by one fit of everything.

    Args:
        views: of both cameras, those of the zoom camera at any of its stops.
        points: the board's corners in its frame [m], (N, 3).
        sizes: (width, height) of both cameras [px].
        nominal_px: the stops' focal lengths by the device's own account, increasing; empty where it told none.
        options: what is asked beyond the defaults.

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
        model = replace(model, hand=rough_hand(model, steps.views, points, insist=options.insist))
    model = replace(model, gamma=rough_gamma(model, of_both(steps.views), points))
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
    if "k3" in with_k3.free:  # what such a lens does to corners is not the corners' fault
        prior = k3_prior
        again = fit(with_k3.model, everything.views, points, with_k3.free, prior=prior)
        result, wrong, left_out = _cleaned(again, points, prior)
    rejected += left_out
    check_pairs(steps, rms(result.residuals))
    if not options.insist and (text := undetermined(result)):
        raise CalibrationError(text)
    covariance = covariance_of(result)
    held_out = None
    widened = K3_WIDENED if "k3" in result.free else 1.0
    if covariance is not None:
        if options.folds:
            held_out = cross_validate(result, points, prior, options.folds)
            widened = max(widened, 1.0 if held_out is None else held_out.widened)
        held = [block for block in CONSIDERED if block not in result.free and (block != "scale" or steps.has_head)]
        usual = Prior(prior.reference, {**prior.sigmas, "fixed.k3": K3_WIDE, **ENCODER_SIGMAS})
        covariance = with_considered(covariance, result, points, held, usual)
        covariance = replace(covariance, matrix=covariance.matrix * widened**2)
    return Solution(
        model=result.model,
        residuals=_residuals(steps, result, points, rejected, wrong),
        views=result.views,
        has_head=steps.has_head,
        covariance=covariance,
        jitter=result.jitter * widened,
        held_out=held_out,
    )


def undetermined(found: Fit) -> str:
    """What a fit leaves undetermined, in words with what to add; empty where nothing is."""
    names = parameter_names(found.free, found.model.stops)
    focal = found.model.focal_px
    return name_directions(names, weak_directions(found.normal, names, found.variance or 0.0, focal), focal)


def _known(model: RigModel, start: RigModel, blocks: Sequence[Block], options: Options, warp_sigma: float) -> Prior:
    """What is known before the corners speak: of the board, the zoom lens, encoders, and what is insisted on.

    Who insists holds T, Gamma and the head's geometry near the start, as loosely as they are of any use: directions
    that the corners determine do not notice, and the others get an uncertainty that says so.
    """
    reference, sigmas = replace(start, zoom=model.zoom), dict.fromkeys(("board.warp_x", "board.warp_y"), warp_sigma)
    if model.stops > 1:
        lens = lens_prior(model)
        reference, sigmas = replace(reference, zoom=lens.reference.zoom), {**sigmas, **lens.sigmas}
    if options.insist:
        names = [
            name for name in parameter_names(blocks, model.stops) if not name.startswith(("fixed.", "zoom[", "board."))
        ]
        sigmas |= dict(zip(names, limits_of_use(names).tolist(), strict=True))
    if "scale" in blocks:
        sigmas |= ENCODER_SIGMAS
    return Prior(reference, sigmas)


def _all_stops(
    found: Fit, views: Sequence[View], points: Array, nominal_px: Sequence[float]
) -> tuple[RigModel, list[View], list[Rejected]]:
    """Add the stops in their order, each fitted by itself; the model then, all views of it, and what is left out."""
    model, used, rejected = found.model, list(found.views), []
    for number, nominal in enumerate(nominal_px[1:], start=1):
        assert model.zoom is not None
        at_stop = [v for v in views if v.camera == "zoom" and stop_of(nominal_px, v) == number]
        here = [v for v in at_stop if v.board in model.boards]
        rejected += [Rejected(v.name, NO_PLACE) for v in at_stop if v.board not in model.boards]
        if len(here) < FEWEST_STOP_VIEWS or len({view.board for view in here}) < FEWEST_STOP_PLACEMENTS:
            rejected += [
                Rejected(v.name, f"{len(here)} views at {nominal:.0f} px are too few for a zoom stop") for v in here
            ]
            continue
        seen_too = {view.board for view in here}
        with_fixed = [view for view in used if view.camera == "fixed" and view.board in seen_too]
        start = replace(model, zoom=with_stop(model.zoom, nominal))
        model = fit_stop(start, start.stops - 1, [*with_fixed, *here], points)
        used += here
    return model, used, rejected


def _cleaned(found: Fit, points: Array, prior: Prior) -> tuple[Fit, int, list[Rejected]]:
    """Leave out what is wrong, and tell the head's jitter; how many single corners went, and which views."""
    found, elsewhere = _without_heads_elsewhere(found, points, prior)
    found, wrong, spoilt = _without_wrong_corners(found, points, prior)
    return found, wrong, [*elsewhere, *spoilt]


def _without_heads_elsewhere(found: Fit, points: Array, prior: Prior) -> tuple[Fit, list[Rejected]]:
    """Leave out the views for which the head did not stand where it said: far more than for others."""
    if "hand" not in found.free:
        return found, []
    off = np.linalg.norm(head_turns(found, points), axis=-1)
    turned = np.isfinite(off)
    limit = max(ELSEWHERE_SIGMAS * float(np.median(off[turned])) * MEDIAN_TO_SIGMA, ELSEWHERE_FLOOR)
    elsewhere = turned & (np.where(turned, off, 0.0) > limit)
    if not elsewhere.any():
        return found, []
    rejected = [
        Rejected(view.name, f"the head stood {np.degrees(angle):.2f} degrees from where it says")
        for view, angle, out in zip(found.views, off, elsewhere, strict=True)
        if out
    ]
    kept = [view for view, out in zip(found.views, elsewhere, strict=True) if not out]
    return fit(found.model, kept, points, found.free, prior=prior), rejected


def _without_wrong_corners(found: Fit, points: Array, prior: Prior) -> tuple[Fit, int, list[Rejected]]:
    """Leave out the corners that nothing explains, and tell the head's jitter; the fit then, and how many they were."""
    found = _with_jitter(found, points, prior)
    lengths = np.linalg.norm(found.left, axis=-1)
    seen = np.isfinite(lengths)
    limit = max(WRONG_SIGMAS * robust_sigma(found.left[seen]), WRONG_FLOOR_PX)
    wrong = seen & (np.where(seen, lengths, 0.0) > limit)
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
    if found.jitter:  # views and corners that were off look like jitter
        again = _with_jitter(again, points, prior)
    return again, count, rejected


def _with_jitter(found: Fit, points: Array, prior: Prior) -> Fit:
    """The fit with the head's jitter, as it and the parameters settle together.

    Raises:
        CalibrationError: it is so large that no head has it.
    """
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
    """Free the fixed camera's k3 as well, if the corners speak for it, and by as much as they do.

    Its prior is what its own estimate lets expect of such a lens (empirical Bayes): k3^2 less its variance. So a k3
    that noise explains stays 0, a large one is free, and one between is drawn towards 0.
    """
    free: tuple[Block, ...] = (*found.free, "k3")

    def fitted(start: Fit, sigma: float) -> tuple[Fit, Prior]:
        known = Prior(prior.reference, {**prior.sigmas, "fixed.k3": sigma})
        return fit(start.model, start.views, points, free, prior=known, jitter=found.jitter), known

    freely, _ = fitted(found, K3_WIDE)
    covariance = covariance_of(freely)
    if covariance is None or freely.model.fixed is None:
        return found, prior
    k3, sigma = freely.model.fixed.distortion[4], covariance.sigma("fixed.k3")
    return fitted(freely, float(np.sqrt(k3**2 - sigma**2))) if abs(k3) > K3_SIGMAS * sigma else (found, prior)


def _residuals(steps: Steps, result: Fit, points: Array, rejected: Sequence[Rejected], wrong: int) -> Residuals:
    """The figures of each part by itself, as everybody states them, and those of the whole."""
    pairs = pairs_at_home(result.views)
    zoom = np.array([view.camera == "zoom" for view in result.views])
    return Residuals(
        fixed_rms_px=steps.fixed_fit.rms_px,
        zoom_rms_px=steps.zoom_fit.rms_px,
        stereo_rms_px=stereo(steps.model, pairs, points).rms_px if pairs else None,
        handeye_rms_px=rms(result.residuals[zoom]) if steps.has_head else None,
        fixed_views=int(np.count_nonzero(~zoom)),
        zoom_views=int(np.count_nonzero(zoom)),
        pairs=len({view.board for view in pairs}),
        outliers=wrong,
        rejected=tuple(rejected),
    )
