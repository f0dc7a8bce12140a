"""Optics of the simulated zoom lens at each of its focal lengths."""

import math
from dataclasses import dataclass

from cotarget.config import Center, Curve, Distortion, Focal, SimZoomCamera


@dataclass(frozen=True)
class ZoomOptics:
    """Optics of a zoom lens at one focal length; ``pupil`` is the forward movement of its entrance pupil [m]."""

    focal_px: Focal
    center_px: Center
    distortion: Distortion
    pupil: float


def optics_at(lens: SimZoomCamera, magnification: float) -> ZoomOptics:
    """Compute the optics at a nominal focal length, given as a multiple of the shortest."""
    s = math.log(magnification) / math.log(lens.focal_mm[1] / lens.focal_mm[0])
    gain = magnification * (1 + _along(lens.focal_curve, s))
    (fx, fy), (cx, cy), (k1, k2, p1, p2, k3) = lens.focal_px, lens.center_px, lens.distortion
    du, dv = (_along(curve, s) for curve in lens.center_drift_px)
    # Tangents within the image shrink as the focal length grows. Coefficients that grow with its powers keep the
    # image's distortion.
    squared = gain * gain
    k1 = (k1 + _along(lens.distortion_drift, s)) * squared
    return ZoomOptics(
        focal_px=(fx * gain, fy * gain),
        center_px=(cx + du, cy + dv),
        distortion=(k1, k2 * squared * squared, p1 * gain, p2 * gain, k3 * squared * squared * squared),
        pupil=_along(lens.pupil, s),
    )


def _along(curve: Curve, s: float) -> float:
    """Evaluate a curve by Horner's rule."""
    value = 0.0
    for coefficient in reversed(curve):
        value = (value + coefficient) * s
    return value
