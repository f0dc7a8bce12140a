"""The joint method: one fit of everything over the corners of all images.

1. A start that assumes nothing of how the cameras are mounted: each camera by itself at the shortest focal length, T
   from the motions of head and camera, Gamma from every placement that both cameras see, whatever the head's pose.
2. One fit of both cameras, Gamma, T and the head's geometry from all views at the shortest focal length.
3. The zoom lens's stops one after the other, each beginning where the one before ended; then everything together.
4. Single corners that are wrong are left out; the head's jitter is estimated; what captures kept out of the fit say
   widens the uncertainty where they disagree with it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cotarget.calibration.bundle import Fit, Prior, estimate_jitter, fit, rms, robust_sigma
from cotarget.calibration.heldout import cross_validate
from cotarget.calibration.model import DEFAULT_OPTIONS, CameraName, Options, Rejected, Residuals, View
from cotarget.calibration.placing import place_boards
from cotarget.calibration.reprojection import (
    ALL_BLOCKS,
    Block,
)
from cotarget.calibration.sequential import Solution, Steps, both_cameras, stereo
from cotarget.calibration.start import of_both, pairs_at_home, rough_gamma, rough_hand
from cotarget.calibration.stops import check_stops, fit_last_stop, lens_prior, with_stop
from cotarget.calibration.uncertainty import covariance_of
from cotarget.errors import CalibrationError
from cotarget.geometry import Array

# A corner further off than this many standard deviations, and than the floor, is wrong: of Gaussian ones, one in
# 65 million is.
WRONG_SIGMAS, WRONG_FLOOR_PX = 6.0, 0.5
WRONG_SHARE = 0.3  # a view with more wrong corners than this is left out as a whole
FEWEST_STOP_VIEWS, FEWEST_STOP_PLACEMENTS = 3, 2  # of a stop of the zoom lens
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
    shortest = [view for view in views if view.camera == "fixed" or _stop_of(nominal_px, view) == 0]
    steps = both_cameras(shortest, points, sizes, nominal_px[0] if nominal_px else None)
    if not of_both(steps.views):
        raise CalibrationError("no placement of the board is seen by both cameras; turn the head so that both see it")
    model = steps.model
    if steps.has_head:
        model = replace(model, hand=rough_hand(model, steps.views, points))
    model = replace(model, gamma=rough_gamma(model, of_both(steps.views), points))
    used = steps.views
    blocks = tuple(block for block in ALL_BLOCKS if steps.has_head or block not in ("hand", "head"))
    ties: tuple[Block, ...] = ("gamma", "hand") if steps.has_head else ("gamma",)
    model = fit(place_boards(model, used, points), used, points, ties).model
    result = fit(model, used, points, blocks)
    prior, rejected = None, list(steps.rejected)
    if len(nominal_px) > 1:
        result, more, prior = _all_stops(result, views, points, nominal_px, blocks)
        rejected += more
    if options.encoders and steps.has_head:
        blocks = (*blocks, "scale", "zero")
        sigmas = {**(prior.sigmas if prior else {}), **ENCODER_SIGMAS}
        prior = Prior(prior.reference if prior else result.model, sigmas)
        result = fit(result.model, result.views, points, blocks, prior=prior)
    result, wrong, more = _without_wrong_corners(result, points, prior)
    rejected += more
    covariance = covariance_of(result)
    held_out = None
    if covariance is not None and options.folds:
        held_out = cross_validate(result, points, prior, options.folds)
        if held_out is not None and held_out.widened > 1:
            covariance = replace(covariance, matrix=covariance.matrix * held_out.widened**2)
    widened = held_out.widened if held_out is not None else 1.0
    return Solution(
        model=result.model,
        residuals=_residuals(steps, result, points, rejected, wrong),
        views=result.views,
        has_head=steps.has_head,
        covariance=covariance,
        jitter=result.jitter * widened,
        held_out=held_out,
    )


def _all_stops(
    found: Fit, views: Sequence[View], points: Array, nominal_px: Sequence[float], blocks: Sequence[Block]
) -> tuple[Fit, list[Rejected], Prior]:
    """Add the stops in their order, then fit everything together."""
    model, used, rejected = found.model, list(found.views), []
    for number, nominal in enumerate(nominal_px[1:], start=1):
        assert model.zoom is not None
        here = [
            v for v in views if v.camera == "zoom" and _stop_of(nominal_px, v) == number and v.board in model.boards
        ]
        if len(here) < FEWEST_STOP_VIEWS or len({view.board for view in here}) < FEWEST_STOP_PLACEMENTS:
            rejected += [
                Rejected(v.name, f"{len(here)} views at {nominal:.0f} px are too few for a zoom stop") for v in here
            ]
            continue
        seen_too = {view.board for view in here}
        with_fixed = [view for view in used if view.camera == "fixed" and view.board in seen_too]
        start = replace(model, zoom=with_stop(model.zoom, nominal))
        model = fit_last_stop(start, [*with_fixed, *here], points)
        used += here
    prior = lens_prior(model)
    result = fit(model, used, points, blocks, prior=prior)
    check_stops(result.model)
    return result, rejected, prior


def _stop_of(nominal_px: Sequence[float], view: View) -> int:
    """The stop of a view among all that were visited."""
    if not nominal_px:
        return 0
    return int(np.argmin(np.abs(np.log(np.array(nominal_px) / (view.focal_px or nominal_px[0])))))


def _without_wrong_corners(found: Fit, points: Array, prior: Prior | None) -> tuple[Fit, int, list[Rejected]]:
    """Leave out the corners that nothing explains, and tell the head's jitter; the fit then, and how many they were."""
    jitter = estimate_jitter(found, points, prior)
    if jitter:
        found = fit(found.model, found.views, points, found.free, prior=prior, jitter=jitter)
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
    again = fit(found.model, views, points, found.free, prior=prior, jitter=jitter)
    if rejected and jitter:  # whole views that were off look like jitter
        again = fit(again.model, views, points, found.free, prior=prior)
        jitter = estimate_jitter(again, points, prior)
        again = fit(again.model, views, points, found.free, prior=prior, jitter=jitter) if jitter else again
    return again, count, rejected


def _residuals(steps: Steps, result: Fit, points: Array, rejected: Sequence[Rejected], wrong: int) -> Residuals:
    """The figures of each part by itself, as everybody states them, and those of the whole."""
    pairs = pairs_at_home(steps.views)
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
