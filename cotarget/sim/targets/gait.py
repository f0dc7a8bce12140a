"""Attitude of the targets' bodies, and joint angles of their limbs over a wing beat or a stride.

Mostly in floats, which for a few numbers is several times as fast as numpy.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from cotarget.geometry import Array
from cotarget.sim.targets.paths import MOUNT

GRAVITY = 9.81  # [m/s^2]
STANDING = 1e-9  # [m/s]
TURNS, NODS = np.radians(7.0), np.radians(4.0)  # swing of a book in yaw, and in pitch and roll [rad]
STRIDE = 1.44  # length of two steps of a walking person 1.75 m tall [m]
WALK_SPEED = 1.5  # [m/s]
WING_BEAT_HZ = 4.0
WING_SWING = np.radians(35.0)  # amplitude of the inner wing
OUTER_SWING, OUTER_LAG = np.radians(24.0), np.radians(70.0)  # amplitude and lag of the outer wing against the inner one
Vector = tuple[float, float, float]
Axes = tuple[Vector, Vector, Vector]  # world coordinates of forward, left and up


def limbs(kind: str, beat: float) -> Mapping[str, float]:
    """Give the joint angles [rad] by name of a flying bird or a walking person at a phase of the limb cycle [rad]."""
    return flap(beat) if kind == "bird" else walk(beat, 1.0)[0] if kind == "person" else {}


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


def face_mount(position: Array | Sequence[float], t: float, phase: float) -> tuple[float, float, float]:
    """Give yaw, pitch and roll that turn the book's cover to the fixed camera, with a swing of some degrees [rad]."""
    x, y, z = MOUNT - position
    yaw = np.arctan2(y, x) + TURNS * np.sin(0.55 * t + phase)
    pitch = -np.arctan2(z, np.hypot(x, y)) + NODS * np.sin(0.40 * t + 2.0 * phase)
    roll = NODS * np.sin(0.31 * t + 3.0 * phase)
    return yaw, pitch, roll


def turned(yaw: float, pitch: float, roll: float) -> Axes:
    """Compute the axes of a body rotated about z, then about its own y and x [rad]."""
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(angle), math.sin(angle)) for angle in (yaw, pitch, roll))
    forward = cy * cp, sy * cp, -sp
    left = cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr
    return forward, left, (cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr)


def bank(upright: Axes, acceleration: Sequence[float]) -> Axes:
    """Roll the bird into its turn, as the turn's lateral acceleration requires."""
    forward, left, up = upright
    lateral = float(np.dot(acceleration, left))
    whole = math.hypot(lateral, GRAVITY)
    c, s = GRAVITY / whole, lateral / whole
    (lx, ly, lz), (ux, uy, uz) = left, up
    return (
        forward,
        (c * lx - s * ux, c * ly - s * uy, c * lz - s * uz),
        (s * lx + c * ux, s * ly + c * uy, s * lz + c * uz),
    )


def walk(step: float, pace: float) -> tuple[dict[str, float], float]:
    """Give the joint angles of a stride at a phase; ``pace`` goes from 0 (standing) to 1 (walking speed).

    Returns:
        Joint angles [rad], and vertical offset of the hips [m].
    """
    joints = {}
    for side, phase in (("left", step), ("right", step + np.pi)):
        swing = 0.5 - 0.5 * np.cos(phase + 0.5 * np.pi)  # 1 while the leg swings forward
        joints[f"hip_{side}"] = pace * (0.06 + 0.42 * np.sin(phase))
        joints[f"knee_{side}"] = pace * (0.08 + 0.85 * swing**2 * (0.5 + 0.5 * np.cos(phase + 0.2)))
        joints[f"shoulder_{side}"] = pace * -0.40 * np.sin(phase) + 0.02
        joints[f"elbow_{side}"] = 0.15 + pace * (0.25 - 0.18 * np.sin(phase))
    return joints, pace * (-0.028 + 0.018 * np.cos(2 * step))


def flap(beat: float) -> dict[str, float]:
    """Give the wings' joint angles at a phase of the beat; the outer wing lags."""
    inner = 0.10 + WING_SWING * np.sin(beat)
    outer = -0.06 + OUTER_SWING * np.sin(beat - OUTER_LAG)
    return {
        "wing_inner_left": inner,
        "wing_inner_right": inner,
        "wing_outer_left": outer,
        "wing_outer_right": outer,
    }
