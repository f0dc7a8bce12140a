"""The bird: flies in rounds, banks into its turns, and beats its wings."""

import math
from collections.abc import Sequence

import numpy as np

from cotarget.sim.targets.attitude import Axes, heading
from cotarget.sim.targets.paths import VIEW_EDGE, Path, angles, even, loop_path
from cotarget.sim.targets.target import Stance, Target, TargetKind

GRAVITY = 9.81  # [m/s^2]
WING_BEAT_HZ = 4.0
WING_SWING = np.radians(35.0)  # amplitude of the inner wing
OUTER_SWING, OUTER_LAG = np.radians(24.0), np.radians(70.0)  # amplitude and lag of the outer wing against the inner one


def bird_path(scene: str, rng: np.random.Generator) -> Path:
    """Fly in from one side at about 5 m/s, then in rounds; indoors the rounds are smaller and slower.

    A round has two half circles and two straights across the view, so that the bird shows its side most of the time.
    """
    a = angles()
    side = rng.choice([-1.0, 1.0])
    if scene == "indoor":
        radius, across, near, height, rise, speed, soften = rng.uniform(2.0, 2.2), 0.8, 7.4, 2.3, 0.25, 2.9, 0.5
    else:
        radius, across, near, height, rise, speed, soften = rng.uniform(2.5, 2.8), 4.4, 19.4, 7.8, 1.6, 5.0, 0.6
    height += 0.3 * rise * rng.uniform(-1, 1)
    start, lift = rng.uniform(0, 2 * np.pi), rise * rng.uniform(0.7, 1.0)
    x = side * (radius * np.sin(a) + across * np.where(a < np.pi, 1.0, -1.0))
    y = near + radius * (1 - np.cos(a))
    flat = even(np.stack([[*x, x[0]], [*y, y[0]], np.zeros(len(a) + 1)], axis=1), 0.02)[:-1]
    flat[:, 2] = height + lift * np.sin(start + angles(len(flat)))
    speed *= rng.uniform(0.96, 1.04)
    edge = (rng.uniform(2.4, 2.8), -side * VIEW_EDGE * near)
    return loop_path(flat, speed, 0.1 * speed, soften, 8.0 * speed, edge)


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


def stance(bird: Target, t: float, beat: float) -> Stance:
    """Head along the path, banked, with the wings of a phase of the beat."""
    position, velocity, acceleration = bird.path.motion(t)
    return position, bank(heading(position, velocity), acceleration), flap(beat)


def beat(bird: Target, t: float) -> float:
    """Give the phase of the wing beat [rad]."""
    return bird.phase + 2 * np.pi * WING_BEAT_HZ * t


KIND = TargetKind(
    "bird",
    stance,
    bird_path,
    limbs=flap,
    beat=beat,
    beat_s=1 / WING_BEAT_HZ,
    scatter=0.15,
    marker=3,
    marker_step=10,
)
