"""Attitude of the targets' bodies, in floats: for a few numbers they are several times as fast as numpy."""

import math
from collections.abc import Sequence

from cotarget.sim.targets.paths import MOUNT

STANDING = 1e-9  # [m/s]
Vector = tuple[float, float, float]
Axes = tuple[Vector, Vector, Vector]  # world coordinates of forward, left and up


def heading(position: Sequence[float], velocity: Sequence[float]) -> Axes:
    """Compute the axes with x along the velocity and z as far up as that allows; a target at rest faces the camera."""
    x, y, z = velocity
    if math.hypot(x, y, z) < STANDING:
        x, y, z = (MOUNT - position).tolist()
        z = 0.0
    if math.hypot(x, y) < STANDING * math.hypot(x, y, z):
        y -= 1e-6 * math.hypot(x, y, z)  # vertical motion has no heading: face the camera
    ahead, whole = math.hypot(x, y), math.hypot(x, y, z)
    forward, left = (x / whole, y / whole, z / whole), (-y / ahead, x / ahead, 0.0)
    return forward, left, (-forward[2] * left[1], forward[2] * left[0], forward[0] * left[1] - forward[1] * left[0])


def turned(yaw: float, pitch: float, roll: float) -> Axes:
    """Compute the axes of a body rotated about z, then about its own y and x [rad]."""
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(angle), math.sin(angle)) for angle in (yaw, pitch, roll))
    forward = cy * cp, sy * cp, -sp
    left = cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr
    return forward, left, (cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr)
