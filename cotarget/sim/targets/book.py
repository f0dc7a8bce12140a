"""The book: carried slowly along an ellipse, its cover turned to the fixed camera."""

from collections.abc import Sequence

import numpy as np

from cotarget.geometry import Array
from cotarget.sim.targets.attitude import turned
from cotarget.sim.targets.paths import MOUNT, Path, angles, loop_path
from cotarget.sim.targets.target import Stance, Target, TargetKind

TURNS, NODS = np.radians(7.0), np.radians(4.0)  # swing in yaw, and in pitch and roll [rad]


def book_path(scene: str, rng: np.random.Generator) -> Path:
    """Carry the book slowly along an ellipse about 10 m away, in view from the start."""
    a, phase = angles(), rng.uniform(0, 2 * np.pi)
    wide, deep, high = rng.uniform(1.2, 1.6), rng.uniform(0.3, 0.5), rng.uniform(0.25, 0.4)
    center = np.array([rng.uniform(-0.3, 0.3), rng.uniform(9.8, 10.2), rng.uniform(1.5, 1.7)])
    tilt = rng.uniform(0, 2 * np.pi)
    shape = [wide * np.cos(a + phase), deep * np.sin(a + phase), high * np.sin(a + phase + tilt)]
    return loop_path(center + np.stack(shape, axis=1), rng.uniform(0.22, 0.28), 0.05, 0.1)


def face_mount(position: Array | Sequence[float], t: float, phase: float) -> tuple[float, float, float]:
    """Give yaw, pitch and roll that turn the book's cover to the fixed camera, with a swing of some degrees [rad]."""
    x, y, z = MOUNT - position
    yaw = np.arctan2(y, x) + TURNS * np.sin(0.55 * t + phase)
    pitch = -np.arctan2(z, np.hypot(x, y)) + NODS * np.sin(0.40 * t + 2.0 * phase)
    roll = NODS * np.sin(0.31 * t + 3.0 * phase)
    return yaw, pitch, roll


def stance(book: Target, t: float, beat: float) -> Stance:
    """Turn the cover to the fixed camera."""
    position, _, _ = book.path.motion(t)
    return position, turned(*face_mount(position, t, book.phase)), {}


KIND = TargetKind("book", stance, book_path, marker=1)
