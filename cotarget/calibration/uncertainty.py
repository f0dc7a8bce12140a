"""Uncertainty of a calibration: covariance of its parameters, and the pointing error that it leaves.

- `covariance_of`: the noise of the corners and the head's jitter.
- `with_consider_covariance`: parameters held in the fit that may be wrong (Schmidt 1966; Tapley, Schutz and Born,
  Statistical Orbit Determination, ch. 6).
- `cross_validate`: what else the model leaves out, by captures kept out of the fit. Each fold of the placements is left
  out once, and its zoom views are predicted from the fixed camera's view of the same board, as pointing does.
- `line_of_sight_covariance`, `predicted_pointing`: the pointing error at a pixel and depth.

Measurements: docs/design-notes.md.
"""

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np

from cotarget.calibration.bundle import (
    POSE_PARAMETERS,
    Batch,
    Block,
    Fit,
    Prior,
    Problem,
    batches_of,
    fit,
    masked,
    nudged,
    parameter_names,
    predict,
    reduced,
    rms,
    robust_scale,
)
from cotarget.calibration.file import Calibration
from cotarget.calibration.initialization import of_both
from cotarget.calibration.model import BundleModel, Covariance, HeldOut, View
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform
from cotarget.pantilt import base_heads, solve

# Consider covariance

# A held parameter is doubted if its estimate is more than this many standard deviations from the held value, which
# chance does for one in eight.
DOUBTED_SIGMAS = 1.5


def with_consider_covariance(
    covariance: Covariance, found: Fit, points: Array, held: Collection[Block], prior: Prior | None = None
) -> Covariance:
    """Add the doubt about held parameters to a fit's covariance (consider covariance, Schmidt).

    One Gauss-Newton step with the held parameters free gives their estimates and standard deviations. An estimate that
    noise explains adds nothing. Any other is taken as the parameter's error. With S = dp/dq, the sensitivity of the
    fitted parameters p to an error of a held q, the errors (S, -1) q are added to the covariance, which then contains
    these q too. The prior is that of the fit and of the held blocks.
    """
    own = list(covariance.parameters)
    free = (*found.free, *held)
    problem = Problem(batches_of(found.model, found.views), points, free, prior, found.jitter)
    here = problem.at(found.model)
    matrix, gradient, _ = reduced(problem.equations(here, robust_scale(here)), 0.0)
    everything = covariance_of(replace(found, free=free, normal=matrix))
    if everything is None:
        return covariance  # the corners cannot separate the held parameters from the others
    names = parameter_names(free, found.model.stops)
    estimates = dict(zip(names, np.linalg.solve(matrix, -gradient), strict=True))
    doubted = [
        name for name in names if name not in own and abs(estimates[name]) > DOUBTED_SIGMAS * everything.sigma(name)
    ]
    if not doubted:
        return covariance
    p, q = ([names.index(name) for name in group] for group in (own, doubted))
    by_held = np.linalg.solve(matrix[np.ix_(p, p)], matrix[np.ix_(p, q)])
    errors = np.concatenate([by_held, -np.eye(len(q))]) * np.array([estimates[name] for name in doubted])
    grown = errors @ errors.T
    grown[: len(p), : len(p)] += covariance.matrix
    return Covariance((*own, *doubted), grown)


# Held-out check

# Measured and predicted agree when the mean squared, whitened miss is below 1 + this many standard deviations of it.
# The misses of a fold share the error of its fit: a placement counts as half an independent miss of two coordinates.
CHANCE_SIGMAS, SHARE = 2.0, 0.5
# With a larger predicted miss, in widths of the zoom image, the remaining placements do not determine the rig, and the
# check means nothing.
DETERMINED = 50.0 / 640.0
FEWEST_VIEWS = 3  # views of a zoom sample that must remain for a fold's views at it to be predicted


def cross_validate(found: Fit, points: Array, prior: Prior | None, folds: int) -> HeldOut | None:
    """Predict every placement by a fit of the others (held-out check).

    The placements are split into ``folds`` parts. None where both cameras see fewer placements, or where the remaining
    placements do not determine the rig.
    """
    numbers = sorted({view.board for view in of_both(found.views)})
    if len(numbers) < folds:
        return None
    misses, expected, left = [], [], []
    stop_of = found.model.stop_of
    for k in range(folds):
        out = set(numbers[k::folds])
        rest = [view for view in found.views if view.board not in out]
        remaining = Counter(stop_of(view) for view in rest)
        kept = [
            view
            for view in found.views
            if view.board in out and (view.camera == "fixed" or remaining[stop_of(view)] >= FEWEST_VIEWS)
        ]
        try:
            partial = fit(found.model, rest, points, found.free, prior=prior, jitter=found.jitter)
            started = replace(partial, model=replace(partial.model, boards=found.model.boards))
            left.append(fit(started.model, kept, points, ()).residuals)
        except CalibrationError:  # also where a board is behind a camera by the rig of the others
            return None
        covariance = covariance_of(partial)
        if covariance is None or partial.variance is None:
            return None
        more_misses, more_expected = _predicted(started, covariance.matrix, kept, points)
        misses.append(more_misses)
        expected.append(more_expected)
    miss, covariances = np.concatenate(misses), np.concatenate(expected)
    predicted_px = float(np.sqrt(np.mean(np.trace(covariances, axis1=1, axis2=2))))
    if predicted_px > DETERMINED * found.model.head.lens.size[0]:
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
    """Compute the mean miss of each zoom view kept out, (v, 2) [px], and its covariance, (v, 2, 2) [px^2].

    Both are scaled to the shortest focal length. The board's pose b comes from the fixed camera's corners, so that
    db = -B^+ (J dp + noise). The mean M over a zoom view's corners then moves by M (J_z - B_z B^+ J) dp, by M B_z B^+
    of the fixed view's noise, and by its own noise.
    """
    model, variance = found.model, found.variance
    assert variance is not None
    fixed = [view for view in kept if view.camera == "fixed"]
    zoom = [view for view in kept if view.camera == "zoom"]
    placed = fit(model, fixed, points, ()).model
    n = len(parameter_names(found.free, model.stops))
    by_p, spread = (np.zeros((len(placed.boards), POSE_PARAMETERS, width)) for width in (n, POSE_PARAMETERS))
    for batch in batches_of(placed, fixed):
        p = predict(placed, batch, points, found.free)
        B = masked(p.by_board, batch).reshape(len(batch.rows), -1, POSE_PARAMETERS)
        J = masked(p.by_shared, batch).reshape(len(batch.rows), B.shape[1], -1)
        inverse = np.linalg.inv(B.swapaxes(1, 2) @ B)
        spread[batch.owners] = inverse
        full = np.zeros((len(batch.rows), POSE_PARAMETERS, n))
        full[:, :, p.columns] = inverse @ B.swapaxes(1, 2) @ J
        by_p[batch.owners] = full
    misses, covariances = np.empty((len(zoom), 2)), np.empty((len(zoom), 2, 2))
    for batch in batches_of(placed, zoom):
        p = predict(placed, batch, points, found.free)
        G = np.zeros((len(batch.rows), 2, n))
        G[:, :, p.columns] = _mean(p.by_shared, batch)
        Bz = _mean(p.by_board, batch)
        G -= Bz @ by_p[batch.owners]
        own = np.eye(2) / batch.seen.sum(axis=1)[:, None, None]
        cov = G @ covariance @ G.swapaxes(1, 2) + variance * (Bz @ spread[batch.owners] @ Bz.swapaxes(1, 2) + own)
        if found.jitter and p.by_turn is not None:
            Q = _mean(p.by_turn, batch)
            cov = cov + found.jitter**2 * Q @ Q.swapaxes(1, 2)
        nominal = model.head.lens.nominal_px
        scale = nominal[0] / nominal[batch.stop or 0]
        misses[batch.rows] = _mean(p.pixels - batch.observed, batch) * scale
        covariances[batch.rows] = cov * scale**2
    return misses, covariances


def _mean(values: Array, batch: Batch) -> Array:
    """Average values (v, N, ...) over the corners that are seen, (v, ...)."""
    seen = batch.seen.reshape(*batch.seen.shape, *(1,) * (values.ndim - 2))
    return np.asarray(np.sum(np.where(seen, values, 0.0), axis=1) / seen.sum(axis=1))


# Covariance of the parameters and of the line of sight

# Step of central differences [px, m, rad]. Their error is its square times the third derivative, which is of the order
# of the first; rounding stays at 1e-11.
STEP = 1e-5
# Smaller eigenvalues of the normal matrix, scaled to a unit diagonal, may be rounding.
SMALLEST_EIGENVALUE = 1e-13


def covariance_of(result: Fit) -> Covariance | None:
    """Compute the covariance of a fit's free parameters, with the boards' poses marginalised.

    It is the inverse of the normal matrix times the variance of a coordinate; None where the views leave a direction
    undetermined, or hold no more coordinates than parameters.
    """
    scale = np.sqrt(np.diagonal(result.normal))
    if result.variance is None or not (scale > 0).all():
        return None
    values, vectors = np.linalg.eigh(result.normal / np.outer(scale, scale))
    if values[0] < SMALLEST_EIGENVALUE:
        return None
    inverse = (vectors / values) @ vectors.T
    names = parameter_names(result.free, result.model.stops)
    return Covariance(names, (inverse + inverse.T) / 2 / np.outer(scale, scale) * result.variance)


def predicted_pointing(
    calibration: Calibration,
    pixel: Array,
    depth: Array | float,
    *,
    pan_tilt: tuple[Array | float, Array | float] | None = None,
    nominal_px: Array | float | None = None,
) -> Array:
    """Predict the rms pointing error [rad], (...), the root of the trace of `line_of_sight_covariance`."""
    covariance = line_of_sight_covariance(calibration, pixel, depth, pan_tilt=pan_tilt, nominal_px=nominal_px)
    return np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))


def line_of_sight_covariance(
    calibration: Calibration,
    pixel: Array,
    depth: Array | float,
    *,
    pan_tilt: tuple[Array | float, Array | float] | None = None,
    nominal_px: Array | float | None = None,
) -> Array:
    """Predict the covariance of the pointing error: the miss between the zoom camera's line of sight and a target.

    With parameters p, the target is at x(p) = depth ray_fixed(pixel; p). The head at q = (pan, tilt) shows it in the
    direction a(p, q) of T_zoom_fixed(q; p) x(p) (Eq. 2). The line of sight through the middle of the zoom image is
    d(p). The head is sent to the q that makes a = d for the calibrated parameters p0. With the true parameters p0 + e
    the target then appears at m = E^T (a(p0 + e, q) - d(p0 + e)), with E the two directions across d. To first order
    m = J e with J = dm/dp at fixed q, so that cov(m) = J cov(e) J^T; how q was solved does not matter. The head's
    jitter adds jitter^2 J_q J_q^T with J_q = dm/dq. The zoom lens adds its doubt about the principal point between and
    beyond zoom samples (`ZoomLens.center_doubt_px`).

    Args:
        calibration: calibration with a covariance and T.
        pixel: pixel of the target in the fixed image, taken as exact, (..., 2).
        depth: depth of the target along the fixed camera's axis, taken as exact [m], (...).
        pan_tilt: commanded pan and tilt [rad], (...) each; None for the exact solution that faces forward.
        nominal_px: nominal focal length of the zoom camera [px], (...); None for the shortest calibrated one.

    Returns:
        Covariance along right and down in the zoom image [rad^2], (..., 2, 2); nan where the target cannot be reached.

    Raises:
        CalibrationError: the calibration has no covariance or no T.
    """
    calibration.zoom_head.hand_eye()  # raises without T
    lens = calibration.zoom_head.lens
    covariance = calibration.covariance
    if covariance is None:
        raise CalibrationError("this calibration has no covariance; calibrate again, by the joint method")
    model = model_of(calibration)
    nominal = np.asarray(lens.nominal_px[0] if nominal_px is None else nominal_px, dtype=float)
    depth = np.asarray(depth, dtype=float)
    shape = np.broadcast_shapes(np.shape(pixel)[:-1], depth.shape, nominal.shape)
    pixels = np.array(np.broadcast_to(pixel, (*shape, 2)), dtype=float).reshape(-1, 2)
    depths, nominals = (np.array(np.broadcast_to(each, shape)).ravel() for each in (depth, nominal))
    turned = None
    if pan_tilt is not None:
        pan, tilt = (np.array(np.broadcast_to(angle, shape), dtype=float).ravel() for angle in pan_tilt)
        turned = pan, tilt
    by_parameter, by_turn = miss_derivatives(model, covariance.parameters, pixels, depths, nominals, turned)
    found = by_parameter @ covariance.matrix @ by_parameter.swapaxes(-1, -2)
    found = found + calibration.jitter**2 * by_turn @ by_turn.swapaxes(-1, -2)
    doubt = _at_each(nominals, lambda f: lens.center_doubt_px(f) / np.array(lens.at(f).focal_px))
    return np.asarray(found + doubt[:, None] ** 2 * np.eye(2)).reshape(*shape, 2, 2)


def miss_derivatives(
    model: BundleModel,
    parameters: Sequence[str],
    pixels: Array,
    depths: Array,
    nominal_px: Array | float,
    pan_tilt: tuple[Array, Array] | None = None,
) -> tuple[Array, Array]:
    """Compute the derivatives of the miss m of `line_of_sight_covariance`, by central differences.

    Returns those of n targets by the k parameters, (n, 2, k), and by pan and tilt, (n, 2, 2); nan out of reach.
    """
    nominals = np.broadcast_to(nominal_px, depths.shape)
    x_fixed = model.fixed.ray(pixels) * depths[:, None]
    if pan_tilt is None:
        pan_tilt = _pointed(model, x_fixed, nominals)
    pan, tilt = pan_tilt
    across = _at_each(nominals, lambda f: _across(_line_of_sight(model, f)))
    x_zoom = _moved_targets(model, x_fixed, pan, tilt)

    def miss(at: BundleModel, x_zoom: Array) -> Array:
        off = _directions(at, x_zoom, nominals) - _at_each(nominals, lambda f: _line_of_sight(at, f))
        return np.einsum("ni,nij->nj", off, across)

    def beside(name: str, step: float) -> Array:
        at = nudged(model, name, step)
        if name.startswith("zoom["):  # it changes the line of sight but not the targets
            return miss(at, x_zoom)
        moved = x_fixed if at.fixed is model.fixed else at.fixed.ray(pixels) * depths[:, None]
        return miss(at, _moved_targets(at, moved, pan, tilt))

    def turned(pan_step: float, tilt_step: float) -> Array:
        return miss(model, _moved_targets(model, x_fixed, pan + pan_step, tilt + tilt_step))

    by_parameter = np.empty((len(depths), 2, len(parameters)))
    for i, name in enumerate(parameters):
        by_parameter[..., i] = (beside(name, STEP) - beside(name, -STEP)) / (2 * STEP)
    by_turn = [(turned(*step) - turned(*-step)) / (2 * STEP) for step in STEP * np.eye(2)]
    return by_parameter, np.stack(by_turn, axis=-1)


def _at_each(nominals: Array, compute: Callable[[float], Array]) -> Array:
    """Compute something for each nominal focal length, (n, ...), once for equal ones."""
    if len(nominals) == 1:
        return compute(float(nominals[0]))[None]
    focals, which = np.unique(nominals, return_inverse=True)
    return np.array([compute(float(focal)) for focal in focals])[which]


def _pointed(model: BundleModel, x_fixed: Array, nominals: Array) -> tuple[Array, Array]:
    """Solve pan and tilt that show targets in the middle of the zoom image, facing forward, (n,) each [rad]."""
    head = model.head
    x_base = head.T_base_fixed.apply(x_fixed)
    angles = np.empty((2, len(nominals)))
    for nominal in np.unique(nominals):
        these = nominals == nominal
        found = solve(x_base[these], head.hand_eye(nominal), head.axes, _line_of_sight(model, nominal))
        angles[:, these] = found.pan[:, 0], found.tilt[:, 0]
    return angles[0], angles[1]


def model_of(calibration: Calibration) -> BundleModel:
    """Make the fit's model from a calibration, without boards; T is the identity where the calibration has none."""
    head = calibration.zoom_head
    if head.T_head_zoom is None:
        head = replace(head, T_head_zoom=RigidTransform.identity())
    return BundleModel({}, calibration.fixed, head, calibration.board_warp)


def _moved_targets(model: BundleModel, x_fixed: Array, pan: Array, tilt: Array) -> Array:
    """Compute the targets in the moved zoom camera's frame at the first zoom sample [m], (n, 3) (Eq. 2)."""
    head = model.head
    x_base = head.T_base_fixed.apply(x_fixed)
    R, t, _ = base_heads(head.axes, pan, tilt)
    return head.hand_eye().inv().apply(np.einsum("vji,vj->vi", R, x_base - t))


def _directions(model: BundleModel, x_zoom: Array, nominals: Array) -> Array:
    """Compute unit vectors from the pupil at nominal focal lengths (n,) to the targets of `_moved_targets`, (n, 3)."""
    zoom = model.head.lens
    return _unit(x_zoom - _at_each(nominals, lambda f: np.array([0.0, 0.0, zoom.pupil_at(f)])))


def _line_of_sight(model: BundleModel, nominal_px: float) -> Array:
    """Compute the unit vector through the middle of the zoom image at a nominal focal length, (3,)."""
    lens = model.head.lens.at(nominal_px)
    return _unit(lens.ray(lens.image_center_px))


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _across(d: Array) -> Array:
    """Compute the unit vectors right and down across a direction near +z, as columns (3, 2)."""
    right = _unit(np.cross([0.0, 1.0, 0.0], d))
    return np.stack([right, np.cross(d, right)], axis=-1)
