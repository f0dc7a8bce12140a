"""How uncertain a calibration is: the covariance of its parameters, and what that leaves of error in pointing.

The covariance speaks of the corners' noise, and of a head that does not stand quite where it says; of parameters that
are held, by `cotarget.calibration.considered`. What else a model leaves out is noticed by captures kept out of the fit
(`cotarget.calibration.heldout`), which widen it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cotarget.calibration.bundle import Fit
from cotarget.calibration.model import Calibration, Covariance
from cotarget.calibration.parameters import EVERY_BLOCK, POSE_PARAMETERS, RigModel, parameter_names, stepped
from cotarget.calibration.reprojection import base_heads
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform
from cotarget.pantilt import solve

# Central differences err by the square of this times the third derivative, which is of the order of the first [px, m,
# rad]; rounding stays at 1e-11.
STEP = 1e-5
# Smallest eigenvalue of the normal matrix, scaled to a unit diagonal, that rounding cannot have made.
SMALLEST_EIGENVALUE = 1e-13
LENS_BLOCKS = ("zoom", "pupil")  # the zoom lens's: of the targets they change nothing, only where it looks


def covariance_of(result: Fit) -> Covariance | None:
    """Give the covariance of a fit's free parameters, the boards' poses left out by marginalising them.

    Args:
        result: of `fit`, at its optimum.

    Returns:
        The inverse of the normal matrix times the variance of a coordinate; None where the views leave a direction of
        the parameters open, or are no more than the parameters.
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
    nominal_px: float | None = None,
) -> Array:
    """Predict the rms angle by which the line of sight misses a target, see `line_of_sight_covariance` [rad], (...)."""
    covariance = line_of_sight_covariance(calibration, pixel, depth, pan_tilt=pan_tilt, nominal_px=nominal_px)
    return np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))


def line_of_sight_covariance(
    calibration: Calibration,
    pixel: Array,
    depth: Array | float,
    *,
    pan_tilt: tuple[Array | float, Array | float] | None = None,
    nominal_px: float | None = None,
) -> Array:
    """Predict the covariance of the miss between the zoom camera's line of sight and a target.

    With parameters p, the target is at x(p) = depth ray_fixed(pixel; p), the head at q = (pan, tilt) shows it in the
    direction a(p, q) of T_zoom_fixed(q; p) x(p) (Eq. 2), and the line of sight, through the middle of the zoom image,
    is d(p). The head is sent to the q that makes a = d by the parameters found, p0. There it stays, while the true
    parameters p0 + e put the target at m = E^T (a(p0 + e, q) - d(p0 + e)), E being the two directions across d. To
    first order m = J e with J = dm/dp at fixed q, so that cov(m) = J cov(e) J^T; how q was solved does not matter.
    The head's jitter, where there is any, adds what a turn of that size moves, and the zoom lens what its stops leave
    in doubt between and beyond them.

    Args:
        calibration: with a covariance and a T.
        pixel: of the target in the fixed view, known exactly, (..., 2) [px].
        depth: along the fixed camera's axis, known exactly [m], (...).
        pan_tilt: where the head is sent [rad], (...) each; by default the exact solution that faces forward.
        nominal_px: the zoom camera's nominal focal length [px]; the shortest calibrated one by default.

    Returns:
        Covariance along right and down in the zoom image [rad^2], (..., 2, 2); nan where the target cannot be reached.

    Raises:
        CalibrationError: the calibration has no covariance, or an unusable one, or no T.
    """
    calibration.hand_eye()
    covariance = calibration.covariance
    if covariance is None:
        raise CalibrationError("this calibration has no covariance; calibrate again, by the joint method")
    model = model_of(calibration)
    known = parameter_names(EVERY_BLOCK, model.stops)
    if unknown := [name for name in covariance.parameters if name not in known]:
        raise CalibrationError(f"covariance.parameters: '{unknown[0]}' is no parameter; they are: {', '.join(known)}")
    nominal = calibration.zoom.nominal_px[0] if nominal_px is None else nominal_px
    depth = np.asarray(depth, dtype=float)
    shape = np.broadcast_shapes(np.shape(pixel)[:-1], depth.shape)
    pixels = np.array(np.broadcast_to(pixel, (*shape, 2)), dtype=float).reshape(-1, 2)
    depths = np.array(np.broadcast_to(depth, shape)).ravel()
    turned = None
    if pan_tilt is not None:
        pan, tilt = (np.array(np.broadcast_to(angle, shape), dtype=float).ravel() for angle in pan_tilt)
        turned = pan, tilt
    by_parameter, by_turn = miss_derivatives(model, covariance.parameters, pixels, depths, nominal, turned)
    found = by_parameter @ covariance.matrix @ by_parameter.swapaxes(-1, -2)
    found = found + calibration.jitter**2 * by_turn @ by_turn.swapaxes(-1, -2)
    doubt = calibration.zoom.center_doubt_px(nominal) / np.array(calibration.zoom.at(nominal).focal_px)
    return np.asarray(found + np.diag(doubt**2)).reshape(*shape, 2, 2)


def miss_derivatives(
    model: RigModel,
    parameters: Sequence[str],
    pixels: Array,
    depths: Array,
    nominal_px: float,
    pan_tilt: tuple[Array, Array] | None = None,
) -> tuple[Array, Array]:
    """How the miss m of `line_of_sight_covariance` changes with parameters, and with the head's pan and tilt.

    Args:
        model: the rig.
        parameters: names, k of them.
        pixels: of targets in the fixed view, (n, 2) [px].
        depths: of these along the fixed camera's axis [m], (n,).
        nominal_px: the zoom camera's nominal focal length [px].
        pan_tilt: where the head is [rad], (n,) each; by default the exact solution that faces forward.

    Returns:
        Derivatives (n, 2, k) and (n, 2, 2); nan for targets that cannot be reached.
    """
    assert model.fixed is not None
    assert model.zoom is not None
    if pan_tilt is None:
        lens = model.zoom.at(nominal_px)
        x_base = (model.hand * model.gamma).apply(model.fixed.ray(pixels) * depths[:, None])
        hand = model.hand * model.zoom.to_pupil(nominal_px)
        found = solve(x_base, hand, model.head, lens.ray(lens.image_center_px))
        pan_tilt = found.pan[:, 0], found.tilt[:, 0]
    pan, tilt = pan_tilt
    across = _across(_line_of_sight(model, nominal_px))
    model = replace(model, boards={})
    x_zoom = _moved_targets(model, pixels, depths, pan, tilt)

    def miss(at: RigModel, x_zoom: Array) -> Array:
        return (_directions(at, x_zoom, nominal_px) - _line_of_sight(at, nominal_px)) @ across

    names = {block: parameter_names((block,), model.stops) for block in EVERY_BLOCK}
    block_of = {name: block for block, own in names.items() for name in own}

    def beside(name: str, step: float) -> Array:
        block = block_of[name]
        steps = step * np.array([name == other for other in names[block]], dtype=float)
        at = stepped(model, steps, np.empty((0, POSE_PARAMETERS)), (block,))
        return miss(at, x_zoom if block in LENS_BLOCKS else _moved_targets(at, pixels, depths, pan, tilt))

    def turned(pan_step: float, tilt_step: float) -> Array:
        return miss(model, _moved_targets(model, pixels, depths, pan + pan_step, tilt + tilt_step))

    by_parameter = [(beside(name, STEP) - beside(name, -STEP)) / (2 * STEP) for name in parameters]
    by_turn = [(turned(*step) - turned(*-step)) / (2 * STEP) for step in STEP * np.eye(2)]
    return np.stack(by_parameter, axis=-1), np.stack(by_turn, axis=-1)


def model_of(calibration: Calibration) -> RigModel:
    """A calibration as the fit sees it, without boards; T is the identity where there was no head."""
    hand = calibration.T_head_zoom
    return RigModel(
        boards={},
        fixed=calibration.fixed,
        zoom=calibration.zoom,
        gamma=calibration.T_zoom0_fixed,
        hand=RigidTransform.identity() if hand is None else hand,
        head=calibration.head,
        warp=calibration.board_warp,
    )


def _moved_targets(model: RigModel, pixels: Array, depths: Array, pan: Array, tilt: Array) -> Array:
    """The targets in the moved zoom camera's frame, as it is at the first stop [m], (n, 3) (Eq. 2)."""
    assert model.fixed is not None
    x_base = (model.hand * model.gamma).apply(model.fixed.ray(pixels) * depths[:, None])
    R, t, _ = base_heads(model.head, pan, tilt)
    return model.hand.inv().apply(np.einsum("vji,vj->vi", R, x_base - t))


def _directions(model: RigModel, x_zoom: Array, nominal_px: float) -> Array:
    """Unit vectors from the zoom camera's pupil at a nominal focal length to `_moved_targets`, (n, 3)."""
    assert model.zoom is not None
    return _unit(x_zoom - np.array([0.0, 0.0, model.zoom.pupil_at(nominal_px)]))


def _line_of_sight(model: RigModel, nominal_px: float) -> Array:
    """Unit vector through the middle of the zoom image at a nominal focal length, (3,)."""
    assert model.zoom is not None
    lens = model.zoom.at(nominal_px)
    return _unit(lens.ray(lens.image_center_px))


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _across(d: Array) -> Array:
    """Right and down across a direction near +z, as columns (3, 2)."""
    right = _unit(np.cross([0.0, 1.0, 0.0], d))
    return np.stack([right, np.cross(d, right)], axis=-1)
