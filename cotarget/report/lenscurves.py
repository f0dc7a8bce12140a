"""The zoom lens over its focal lengths, with the standard deviation of every curve."""

from dataclasses import dataclass

import numpy as np

from cotarget.calibration.model import Calibration
from cotarget.calibration.parameters import EVERY_BLOCK, POSE_PARAMETERS, parameter_names, stepped
from cotarget.calibration.uncertainty import STEP, model_of
from cotarget.camera import ZoomLens
from cotarget.geometry import Array

POINTS = 61
# What is drawn: true over nominal focal length, principal point [px], the image's distortion, the pupil [mm].
CURVES = ("ratio_x", "ratio_y", "cx", "cy", "kappa1", "pupil_mm")


@dataclass(frozen=True, eq=False)
class LensCurves:
    """Curves over the nominal focal length.

    Attributes:
        nominal_px: where they are evaluated, (n,) [px].
        stops_px: the stops' own nominal focal lengths [px].
        values: by the names of `CURVES`, (n,) each.
        sigmas: likewise; empty without a covariance.
        at_stops: the values at the stops themselves.
    """

    nominal_px: Array
    stops_px: tuple[float, ...]
    values: dict[str, Array]
    sigmas: dict[str, Array]
    at_stops: dict[str, Array]


def lens_curves(calibration: Calibration) -> LensCurves:
    """Evaluate the zoom lens between its stops.

    Standard deviations are by linear propagation of the covariance, and of what is in doubt between stops.
    """
    lens = calibration.zoom
    nominal = np.geomspace(lens.nominal_px[0], lens.nominal_px[-1], POINTS)
    return LensCurves(
        nominal,
        lens.nominal_px,
        dict(zip(CURVES, _evaluate(lens, nominal), strict=True)),
        _sigmas(calibration, nominal),
        dict(zip(CURVES, _evaluate(lens, np.array(lens.nominal_px)), strict=True)),
    )


def _evaluate(lens: ZoomLens, nominal_px: Array) -> Array:
    """All curves, (6, n)."""
    rows = []
    for nominal in nominal_px:
        here = lens.at(float(nominal))
        (fx, fy), (cx, cy) = here.focal_px, here.center_px
        kappa1 = here.distortion[0] * (lens.nominal_px[0] / nominal) ** 2
        rows.append([fx / nominal, fy / nominal, cx, cy, kappa1, 1000 * lens.pupil_at(float(nominal))])
    return np.array(rows).T


def _sigmas(calibration: Calibration, nominal_px: Array) -> dict[str, Array]:
    covariance = calibration.covariance
    if covariance is None:
        return {}
    model = model_of(calibration)
    known = parameter_names(EVERY_BLOCK, model.stops)
    own = [i for i, name in enumerate(covariance.parameters) if name.startswith("zoom[")]
    columns = []
    for i in own:
        step = np.zeros(len(known))
        step[known.index(covariance.parameters[i])] = STEP
        ends = [stepped(model, s, np.empty((0, POSE_PARAMETERS)), EVERY_BLOCK).zoom for s in (step, -step)]
        plus, minus = (_evaluate(lens, nominal_px) for lens in ends if lens is not None)
        columns.append((plus - minus) / (2 * STEP))
    J = np.array(columns)  # (parameters, 6, n)
    variance = np.einsum("pcn,pq,qcn->cn", J, covariance.matrix[np.ix_(own, own)], J)
    sigmas = dict(zip(CURVES, np.sqrt(np.maximum(variance, 0.0)), strict=True))
    doubt = np.array([calibration.zoom.center_doubt_px(float(n)) for n in nominal_px])
    return sigmas | {name: np.hypot(sigmas[name], doubt[:, i]) for i, name in enumerate(("cx", "cy"))}
