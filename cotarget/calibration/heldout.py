"""Captures kept out of the fit and predicted: whether a calibration points as well as it says.

The placements are dealt into folds; each fold is left out once, everything else fitted again, and the fold's views of
the zoom camera are predicted from the fixed camera's view of the same board alone. That is what pointing does.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cotarget.calibration.bundle import Fit, fit
from cotarget.calibration.model import HeldOut, View
from cotarget.calibration.normal import Prior, masked
from cotarget.calibration.parameters import POSE_PARAMETERS, parameter_names, stop_of
from cotarget.calibration.reprojection import Batch, batches_of, predict
from cotarget.calibration.robust import rms
from cotarget.calibration.uncertainty import covariance_of
from cotarget.errors import CalibrationError
from cotarget.geometry import Array

# Measured and predicted agree when the mean squared, whitened miss is below 1 + this many standard deviations of it.
# The misses of a fold share the error of its fit: a placement counts as half an independent miss of two coordinates.
CHANCE_SIGMAS, SHARE = 2.0, 0.5
# Where the others predict a board no better than this, they do not determine the rig, and the miss tells nothing [px].
DETERMINED_PX = 50.0
FEWEST_VIEWS = 3  # of a zoom stop that must remain for a fold's views at it to be predicted


def cross_validate(found: Fit, points: Array, prior: Prior | None, folds: int) -> HeldOut | None:
    """Predict every placement by a fit of the others.

    Args:
        found: the fit of everything, from which the others start.
        points: the board's corners in its frame [m], (N, 3).
        prior: that of the fit.
        folds: into how many parts the placements are split.

    Returns:
        What came out; None where there are fewer placements seen by both cameras than folds, or too few views to do
        without any: then the others do not determine the rig.
    """
    both = {v.board for v in found.views if v.camera == "fixed"} & {v.board for v in found.views if v.camera == "zoom"}
    numbers = sorted(both)
    if len(numbers) < folds:
        return None
    misses: list[Array] = []
    expected: list[Array] = []
    left: list[Array] = []
    for k in range(folds):
        out = set(numbers[k::folds])
        rest = [view for view in found.views if view.board not in out]
        assert found.model.zoom is not None
        stops = found.model.zoom.nominal_px
        remaining = Counter(stop_of(stops, view) for view in rest if view.camera == "zoom")
        kept = [
            view
            for view in found.views
            if view.board in out and (view.camera == "fixed" or remaining[stop_of(stops, view)] >= FEWEST_VIEWS)
        ]
        try:
            partial = fit(found.model, rest, points, found.free, prior=prior, jitter=found.jitter)
        except CalibrationError:
            return None
        covariance = covariance_of(partial)
        if covariance is None or partial.variance is None:
            return None
        started = replace(partial, model=replace(partial.model, boards=found.model.boards))
        more_misses, more_expected = _predicted(started, covariance.matrix, kept, points)
        misses.append(more_misses)
        expected.append(more_expected)
        left.append(fit(started.model, kept, points, ()).residuals)
    miss, covariances = np.concatenate(misses), np.concatenate(expected)
    predicted_px = float(np.sqrt(np.mean(np.trace(covariances, axis1=1, axis2=2))))
    if predicted_px > DETERMINED_PX:
        return None
    whitened = np.einsum("vi,vij,vj->v", miss, np.linalg.inv(covariances), miss) / 2
    ratio2 = float(np.mean(whitened))
    by_chance = 1 + CHANCE_SIGMAS / np.sqrt(SHARE * len(numbers))
    return HeldOut(
        views=len(miss),
        measured_px=float(np.sqrt(np.mean(np.sum(miss**2, axis=-1)))),
        predicted_px=predicted_px,
        corners_rms_px=rms(np.concatenate(left)),
        ratio=float(np.sqrt(ratio2)),
        widened=float(np.sqrt(ratio2)) if ratio2 > by_chance else 1.0,
    )


def _predicted(found: Fit, covariance: Array, kept: Sequence[View], points: Array) -> tuple[Array, Array]:
    """Mean miss of each zoom view kept out, (v, 2), and its covariance, (v, 2, 2) [px], of the shortest focal length.

    With the board's pose b told by the fixed camera's corners, db = -B^+ (J dp + noise); the mean over a zoom view's
    corners then moves by M (J_z - B_z B^+ J) dp, by M B_z B^+ of the fixed view's noise, and by its own.
    """
    model, variance = found.model, found.variance
    assert variance is not None
    assert model.zoom is not None
    fixed = [view for view in kept if view.camera == "fixed"]
    zoom = [view for view in kept if view.camera == "zoom"]
    told = fit(model, fixed, points, ()).model
    boards = list(told.boards)
    n = len(parameter_names(found.free, model.stops))
    by_p, spread = (np.zeros((len(boards), POSE_PARAMETERS, width)) for width in (n, POSE_PARAMETERS))
    for batch in batches_of(told, fixed):
        p = predict(told, batch, points, found.free)
        B = masked(p.by_board, batch).reshape(len(batch.rows), -1, POSE_PARAMETERS)
        J = masked(p.by_shared, batch).reshape(len(batch.rows), B.shape[1], -1)
        inverse = np.linalg.inv(B.swapaxes(1, 2) @ B)
        spread[batch.owners] = inverse
        full = np.zeros((len(batch.rows), POSE_PARAMETERS, n))
        full[:, :, p.columns] = inverse @ B.swapaxes(1, 2) @ J
        by_p[batch.owners] = full
    misses, covariances = np.empty((len(zoom), 2)), np.empty((len(zoom), 2, 2))
    for batch in batches_of(told, zoom):
        p = predict(told, batch, points, found.free)
        G = np.zeros((len(batch.rows), 2, n))
        G[:, :, p.columns] = _mean(p.by_shared, batch)
        Bz = _mean(p.by_board, batch)
        G -= Bz @ by_p[batch.owners]
        own = np.eye(2) / batch.seen.sum(axis=1)[:, None, None]
        cov = G @ covariance @ G.swapaxes(1, 2) + variance * (Bz @ spread[batch.owners] @ Bz.swapaxes(1, 2) + own)
        if found.jitter and p.by_turn is not None:
            Q = _mean(p.by_turn, batch)
            cov = cov + found.jitter**2 * Q @ Q.swapaxes(1, 2)
        scale = model.zoom.nominal_px[0] / model.zoom.nominal_px[batch.stop or 0]
        misses[batch.rows] = _mean(p.pixels - batch.observed, batch) * scale
        covariances[batch.rows] = cov * scale**2
    return misses, covariances


def _mean(values: Array, batch: Batch) -> Array:
    """Mean over the corners seen of values (v, N, ...), (v, ...)."""
    seen = batch.seen.reshape(*batch.seen.shape, *(1,) * (values.ndim - 2))
    return np.asarray(np.sum(np.where(seen, values, 0.0), axis=1) / seen.sum(axis=1))
