"""Simulated targets (book, person, bird): pose, joint angles and true size at any time.

A scene may have several targets of one kind: ``bird2`` is a second bird. Paths are in `cotarget.sim.targets.paths`, the
models in sim_assets/targets.
"""

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np

from cotarget.config import TARGETS, Waypoint, known_targets, split_name
from cotarget.errors import ConfigError
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.sim.targets.gait import (
    STRIDE,
    WALK_SPEED,
    WING_BEAT_HZ,
    Axes,
    bank,
    face_mount,
    flap,
    heading,
    turned,
    walk,
)
from cotarget.sim.targets.paths import MOUNT, Path, bird_path, book_path, person_path, waypoint_path

if TYPE_CHECKING:
    import mujoco


__all__ = [
    "MOUNT",
    "TARGETS",
    "Target",
    "TargetPose",
    "change_marker",
    "draw_size",
    "kind_of",
    "make_target",
    "marker_of",
    "scale_spec",
    "target_rng",
    "waypoint_path",
]
# Markers on the targets, ids in DICT_4X4_50: the first target of each kind, and the step for each further one of
# persons and birds. There are textures for five of a kind, after which the ids repeat. All books have the same marker.
MARKERS = {"book": 1, "person": 2, "bird": 3}
MARKER_STEP, MARKERS_OF_A_KIND = 10, 5
RANDOM = 3  # random stream of the targets, separate from the world's others
PERSON_HEIGHT = 1.75  # height of the model [m]
SCATTER = {"book": 0.0, "person": 0.04, "bird": 0.15}  # largest relative deviation from the nominal size
SCATTER_SIGMA = 0.5  # standard deviation over that range: it is two of them


@dataclass(frozen=True)
class TargetPose:
    """Pose of a target in the world: position of its body [m], rotation, and joint angles [rad] by name."""

    position: Array
    rotation: Rotation
    joints: Mapping[str, float]

    @property
    def T_world_target(self) -> RigidTransform:
        """Pose of the target's body."""
        return RigidTransform.from_components(self.position, self.rotation)


@dataclass(frozen=True)
class Target:
    """One target of the simulated world.

    Attributes:
        name: kind of the target, with a number from the second of its kind on.
        beat_s: period of the limb cycle [s]; 0 for a rigid target.
        size: true size over the model's size.
        path: path of the body through the world.
        phase: phase of the limb cycle at the start [rad].
        grounded: whether the target stands on the ground, so that its height follows from its size.
        own: file of a user's own model, which is rigid and has the model's size.
    """

    name: str
    beat_s: float
    size: float
    path: Path = field(repr=False)
    phase: float = 0.0
    grounded: bool = False
    own: FilePath | None = None

    @property
    def kind(self) -> str:
        """Kind of the target, one of TARGETS or a user's own; also the name of the model's body."""
        return split_name(self.name)[0]

    @property
    def body(self) -> str:
        """Name of the target's body in the compiled world."""
        return f"{self.name}/{self.kind}"

    def pose(self, t: float) -> TargetPose:
        """Give pose and joint angles at time ``t`` [s]."""
        if self.kind == "book":
            place = self.path.position(t)
            return TargetPose(place, Rotation.from_euler("ZYX", face_mount(place, t, self.phase)), {})
        position, axes, joints = self.stance(t, self.beat(t))
        return TargetPose(np.array(position), Rotation.from_matrix(np.transpose(axes), assume_valid=True), joints)

    def stance(self, t: float, beat: float) -> tuple[list[float], Axes, Mapping[str, float]]:
        """Give pose and joint angles as floats, which is faster than `pose`.

        Args:
            t: the time [s].
            beat: phase of the limb cycle at that time, from `beat` [rad].

        Returns:
            Position of the body [m], (3,); axes of the body in the world; joint angles [rad] by name.
        """
        position, velocity, acceleration = self.path.motion(t)
        kind = self.kind
        if kind == "book":
            return position, turned(*face_mount(position, t, self.phase)), {}
        if kind == "bird":
            return position, bank(heading(position, velocity), acceleration), flap(beat)
        if self.own is not None:
            return position, heading(position, velocity), {}
        joints, bob = walk(beat, min(math.hypot(*velocity) / WALK_SPEED, 1.0))
        axes = heading(position, [*velocity[:2], 0.0 * velocity[2]])  # a walking person stays upright
        position[2] += bob * self.size + (0.5 * PERSON_HEIGHT * self.size if self.grounded else 0.0)
        return position, axes, joints

    def beat(self, t: float) -> float:
        """Give the phase of the limb cycle at time ``t`` [s], which grows without limit [rad]."""
        if self.kind == "person":
            return self.phase + 2 * np.pi * self.path.travelled(t) / (STRIDE * self.size)
        return self.phase + 2 * np.pi * WING_BEAT_HZ * t


def make_target(
    name: str,
    scene: str,
    rng: np.random.Generator,
    scatter: bool,
    waypoints: Sequence[Waypoint] | None = None,
    own: FilePath | None = None,
) -> Target:
    """Make one target.

    Args:
        name: one of TARGETS, with a number from 2 on for a further one of its kind.
        scene: name or path of the scene. Any scene but the built-in ones has the indoor paths of book and person and
            the outdoor path of the bird.
        rng: source of the small differences between runs; the same seed gives the same path.
        scatter: whether the true size differs from the nominal size.
        waypoints: [t, x, y, z] of the body's centre in the world [s, m], in place of the kind's own path.
        own: file of a user's own model, which needs waypoints.

    Raises:
        ConfigError: an unknown target, or waypoints whose times do not increase.
    """
    if own is not None:
        if waypoints is None:
            raise ConfigError(f"sim.targets: a {name} of your own needs a way: [sim.paths] {name}")
        return Target(name, 0.0, 1.0, waypoint_path(waypoints, f"sim.paths.{name}"), own=own)
    kind = kind_of(name)
    # Drawn also where it is not used, so that no switch changes the path.
    size = draw_size(name, rng, scatter)
    phase = float(rng.uniform(0.0, 2 * np.pi))
    make = {"book": book_path, "person": person_path, "bird": bird_path}[kind]
    path = make(scene, rng) if waypoints is None else waypoint_path(waypoints, f"sim.paths.{name}")
    beat_s = {"book": 0.0, "person": STRIDE / WALK_SPEED, "bird": 1 / WING_BEAT_HZ}[kind]
    grounded = kind == "person" and waypoints is None
    return Target(name, beat_s, size, path, phase, grounded)


def target_rng(seed: int, name: str) -> np.random.Generator:
    """Make the random generator of one target, independent of the scene's other targets."""
    return np.random.default_rng((seed, RANDOM, zlib.crc32(name.encode())))


def draw_size(name: str, rng: np.random.Generator, scatter: bool) -> float:
    """Draw a target's true size over its nominal size; it is the first number from its generator."""
    return 1.0 + SCATTER[kind_of(name)] * SCATTER_SIGMA * float(np.clip(rng.standard_normal(), -2.0, 2.0)) * scatter


def kind_of(name: str) -> str:
    """Give the kind of a target by its name: ``bird`` for ``bird`` and for ``bird2``.

    Raises:
        ConfigError: an unknown target.
    """
    return TARGETS[_place_of(name)[0]]


def marker_of(name: str) -> int:
    """Give the marker on a target, an id in DICT_4X4_50.

    Raises:
        ConfigError: an unknown target.
    """
    kind, number = _place_of(name)
    marker = MARKERS[TARGETS[kind]]
    return marker if kind == 0 else marker + MARKER_STEP * ((number - 1) % MARKERS_OF_A_KIND)


@lru_cache(maxsize=256)
def _place_of(name: str) -> tuple[int, int]:
    """Split a name into the index of its kind in TARGETS and its number, counted from 1."""
    kind, number = split_name(name)
    if kind not in TARGETS:
        raise ConfigError(f"unknown target '{name}'; {known_targets()}")
    return TARGETS.index(kind), number


def change_marker(spec: "mujoco.MjSpec", name: str) -> None:
    """Set the marker of that name on a target's model; do it before attaching."""
    kind, number = _place_of(name)
    if kind and (number - 1) % MARKERS_OF_A_KIND:
        spec.texture(f"{TARGETS[kind]}_marker").file = f"{TARGETS[kind]}_marker_{marker_of(name)}.png"


def scale_spec(spec: "mujoco.MjSpec", factor: float) -> None:
    """Scale all lengths of a target's model by ``factor``; do it before attaching."""
    for mesh in spec.meshes:
        mesh.scale = np.asarray(mesh.scale) * factor
    for geom in spec.geoms:
        geom.size = np.asarray(geom.size) * factor
        geom.pos = np.asarray(geom.pos) * factor
        geom.fromto = np.asarray(geom.fromto) * factor  # nan where the geom has none
    for element in [*spec.bodies[1:], *spec.sites, *spec.joints]:
        element.pos = np.asarray(element.pos) * factor
