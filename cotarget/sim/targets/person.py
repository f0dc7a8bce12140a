"""The person: walks upright, at the pace of the path."""

import math
from collections.abc import Mapping

import numpy as np

from cotarget.sim.targets.attitude import heading
from cotarget.sim.targets.paths import VIEW_EDGE, Path, angles, loop_path
from cotarget.sim.targets.target import Stance, Target, TargetKind

PERSON_HEIGHT = 1.75  # height of the model [m]
STRIDE = 1.44  # length of two steps of a person of that height [m]
WALK_SPEED = 1.5  # [m/s]


def person_path(scene: str, rng: np.random.Generator) -> Path:
    """Walk in from one side at about 1.5 m/s, then along a figure of eight; z is that of the ground."""
    # The outdoor camera looks up: nearer than 13 m it does not see the feet.
    near, reach, deep = (13.4, 4.4, 2.2) if scene == "outdoor" else (8.95, 2.65, 1.0)
    side = rng.choice([-1.0, 1.0])
    a = angles() - np.pi / 4  # starts at the nearest point of the figure's first half, heading inwards
    reach, deep = reach * rng.uniform(0.94, 1.0), deep * rng.uniform(0.9, 1.05)
    figure = np.stack([-side * reach * np.sin(a), near + deep + deep * np.sin(2 * a), np.zeros_like(a)], axis=1)
    edge = (rng.uniform(2.7, 3.0), side * VIEW_EDGE * near)
    return loop_path(figure, rng.uniform(1.42, 1.55), 0.15, 0.25, 14.0, edge)


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


def limbs(step: float) -> Mapping[str, float]:
    """Give the joint angles at walking speed [rad] at a phase of the stride."""
    return walk(step, 1.0)[0]


def stance(person: Target, t: float, step: float) -> Stance:
    """Stand upright along the way, with the limbs and the hips of a phase of the stride."""
    position, velocity, _ = person.path.motion(t)
    joints, bob = walk(step, min(math.hypot(*velocity) / WALK_SPEED, 1.0))
    axes = heading(position, [*velocity[:2], 0.0 * velocity[2]])
    # The kind's own path is that of the ground below the person.
    position[2] += bob * person.size + (0.5 * PERSON_HEIGHT * person.size if person.own_way else 0.0)
    return position, axes, joints


def beat(person: Target, t: float) -> float:
    """Give the phase of the stride, which follows from the distance walked [rad]."""
    return person.phase + 2 * np.pi * person.path.travelled(t) / (STRIDE * person.size)


KIND = TargetKind(
    "person",
    stance,
    person_path,
    limbs=limbs,
    beat=beat,
    beat_s=STRIDE / WALK_SPEED,
    scatter=0.04,
    marker=2,
    marker_step=10,
)
