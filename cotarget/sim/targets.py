"""The simulated targets: where a book, a person or a bird is at a time, how its joints stand, and how large it is.

There may be several of a kind: ``bird2`` is a second bird. The ways that they take are in `cotarget.sim.paths`, the
models in sim_assets/targets.
"""

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from cotarget.errors import ConfigError
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.sim.paths import MOUNT, Path, bird_path, book_path, person_path, waypoint_path
from cotarget.simchecks import told_targets
from cotarget.simconfig import TARGETS, Waypoint, split_name

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

# The markers that they carry, ids in DICT_4X4_50: those of the first of a kind, and what is added for each further one;
# the models' textures are drawn for five of a kind, after which the ids repeat. All books carry the same.
MARKERS = {"book": 1, "person": 2, "bird": 3}
MARKER_STEP, MARKERS_OF_A_KIND = 10, 5
RANDOM = 3  # the stream of random numbers of the targets, apart from the world's others
PERSON_HEIGHT = 1.75  # of the model [m]
SCATTER = {"book": 0.0, "person": 0.04, "bird": 0.15}  # of the true sizes, relative; all within this
SCATTER_SIGMA = 0.5  # the range above is two standard deviations
GRAVITY = 9.81  # [m/s^2]
STANDING = 1e-9  # [m/s]
FLAT = np.array([1.0, 1.0, 0.0])  # of the way of whoever walks upright, the part along the ground

STRIDE = 1.44  # length of two steps of a walking person 1.75 m tall [m]
WALK_SPEED = 1.5  # [m/s]
WING_BEAT_HZ = 4.0
WING_SWING = np.radians(35.0)  # amplitude of the inner wing
OUTER_SWING, OUTER_LAG = np.radians(24.0), np.radians(70.0)  # of the outer wing against the inner one


@dataclass(frozen=True)
class TargetPose:
    """Where a target is in the world: its body's position [m], its rotation, and each joint's angle [rad] by name."""

    position: Array
    rotation: Rotation
    joints: Mapping[str, float]

    @property
    def T_world_target(self) -> RigidTransform:
        """The body's pose."""
        return RigidTransform.from_components(self.position, self.rotation)


@dataclass(frozen=True)
class Target:
    """One target of the simulated world.

    Attributes:
        name: its kind, and a number where it is not the first of its kind.
        asset: file in sim_assets/targets.
        beat_s: period of its limbs' motion [s]; 0 for a rigid target.
        size: true size over the model's.
        path: where it goes.
        phase: where in its limbs' motion it starts [rad].
        grounded: whether its height follows from its size, because it stands on the ground.
    """

    name: str
    asset: str
    beat_s: float
    size: float
    path: Path = field(repr=False)
    phase: float = 0.0
    grounded: bool = False

    @property
    def kind(self) -> str:
        """One of TARGETS; also the name of the model's body."""
        return kind_of(self.name)

    @property
    def body(self) -> str:
        """The name of its body in the compiled world."""
        return f"{self.name}/{self.kind}"

    def pose(self, t: float) -> TargetPose:
        """Tell pose and joints at time ``t`` [s]."""
        if self.kind == "book":
            position = self.path.position(t)
            return TargetPose(position, _face_mount(position, t, self.phase), {})
        if self.kind == "person":
            step = self.phase + 2 * np.pi * self.path.travelled(t) / (STRIDE * self.size)
            velocity = self.path.velocity(t)
            joints, bob = _walk(step, min(math.hypot(*velocity.tolist()) / WALK_SPEED, 1.0))
            position = self.path.position(t)
            rotation = Rotation.from_matrix(_heading(position, velocity * FLAT), assume_valid=True)
            position[2] += bob * self.size + (0.5 * PERSON_HEIGHT * self.size if self.grounded else 0.0)
            return TargetPose(position, rotation, joints)
        position = self.path.position(t)
        axes = _bank(_heading(position, self.path.velocity(t)), self.path.acceleration(t))
        rotation = Rotation.from_matrix(axes, assume_valid=True)
        return TargetPose(position, rotation, _flap(self.phase + 2 * np.pi * WING_BEAT_HZ * t))


def make_target(
    name: str, scene: str, rng: np.random.Generator, scatter: bool, waypoints: Sequence[Waypoint] | None = None
) -> Target:
    """Make one target.

    Args:
        name: one of TARGETS, with a number from 2 on for a further one of its kind.
        scene: name or path of the scene; any but the built-in ones has the book and the person as indoors and the
            bird as outdoors.
        rng: source of the small differences between one run and the next; same seed, same path.
        scatter: whether the true size differs from what the pipeline is told.
        waypoints: [t, x, y, z] of the body's centre in the world [s, m] to go through instead.

    Raises:
        ConfigError: no such target, or waypoints that do not advance in time.
    """
    kind = kind_of(name)
    # Drawn whether used or not, so that no switch changes the path.
    size = draw_size(name, rng, scatter)
    phase = float(rng.uniform(0.0, 2 * np.pi))
    make = {"book": book_path, "person": person_path, "bird": bird_path}[kind]
    path = make(scene, rng) if waypoints is None else waypoint_path(waypoints, f"sim.paths.{name}")
    beat_s = {"book": 0.0, "person": STRIDE / WALK_SPEED, "bird": 1 / WING_BEAT_HZ}[kind]
    grounded = kind == "person" and waypoints is None
    return Target(name, f"{kind}.xml", beat_s, size, path, phase, grounded)


def target_rng(seed: int, name: str) -> np.random.Generator:
    """The random numbers of one target, whatever else is in the scene."""
    return np.random.default_rng((seed, RANDOM, zlib.crc32(name.encode())))


def draw_size(name: str, rng: np.random.Generator, scatter: bool) -> float:
    """Draw a target's true size over what the pipeline is told; the first number that its rng gives."""
    return 1.0 + SCATTER[kind_of(name)] * SCATTER_SIGMA * float(np.clip(rng.standard_normal(), -2.0, 2.0)) * scatter


def kind_of(name: str) -> str:
    """The kind of a target by its name: ``bird`` of ``bird`` and of ``bird2``.

    Raises:
        ConfigError: no such target.
    """
    return TARGETS[_place_of(name)[0]]


def marker_of(name: str) -> int:
    """The marker that a target carries, an id in DICT_4X4_50.

    Raises:
        ConfigError: no such target.
    """
    kind, number = _place_of(name)
    marker = MARKERS[TARGETS[kind]]
    return marker if kind == 0 else marker + MARKER_STEP * ((number - 1) % MARKERS_OF_A_KIND)


@lru_cache(maxsize=256)
def _place_of(name: str) -> tuple[int, int]:
    """Index of a target's kind in TARGETS, and its number among its kind, from 1 on."""
    kind, number = split_name(name)
    if kind not in TARGETS:
        raise ConfigError(f"unknown target '{name}'; {told_targets()}")
    return TARGETS.index(kind), number


def change_marker(spec: "mujoco.MjSpec", name: str) -> None:
    """Give a target's model the marker of that name; do it before attaching."""
    kind, number = _place_of(name)
    if kind and (number - 1) % MARKERS_OF_A_KIND:
        spec.texture(f"{TARGETS[kind]}_marker").file = f"{TARGETS[kind]}_marker_{marker_of(name)}.png"


def scale_spec(spec: "mujoco.MjSpec", factor: float) -> None:
    """Make every length of a target's model ``factor`` times as large; do it before attaching."""
    for mesh in spec.meshes:
        mesh.scale = np.asarray(mesh.scale) * factor
    for geom in spec.geoms:
        geom.size = np.asarray(geom.size) * factor
        geom.pos = np.asarray(geom.pos) * factor
        geom.fromto = np.asarray(geom.fromto) * factor  # nan where it is not used
    for element in [*spec.bodies[1:], *spec.sites, *spec.joints]:
        element.pos = np.asarray(element.pos) * factor


# ---------------------------------------------------------------- attitude and gait


def _heading(position: Array, velocity: Array) -> Array:
    """Turn x along the way, z as far up as that allows; whoever stands still faces the camera. Columns, (3, 3)."""
    x, y, z = velocity.tolist()
    if math.hypot(x, y, z) < STANDING:
        x, y, z = (MOUNT - position).tolist()
        z = 0.0
    if math.hypot(x, y) < STANDING * math.hypot(x, y, z):
        y -= 1e-6 * math.hypot(x, y, z)  # straight up or down: towards the camera, if anywhere
    ahead, whole = math.hypot(x, y), math.hypot(x, y, z)
    forward, left = (x / whole, y / whole, z / whole), (-y / ahead, x / ahead, 0.0)
    up = (-forward[2] * left[1], forward[2] * left[0], forward[0] * left[1] - forward[1] * left[0])
    return np.array([forward, left, up]).T


def _face_mount(position: Array, t: float, phase: float) -> Rotation:
    """Turn the book's cover to the camera, swinging a few degrees."""
    x, y, z = MOUNT - position
    yaw = np.arctan2(y, x) + np.radians(7.0) * np.sin(0.55 * t + phase)
    pitch = -np.arctan2(z, np.hypot(x, y)) + np.radians(4.0) * np.sin(0.40 * t + 2.0 * phase)
    roll = np.radians(4.0) * np.sin(0.31 * t + 3.0 * phase)
    return Rotation.from_euler("ZYX", [yaw, pitch, roll])


def _bank(upright: Array, acceleration: Array) -> Array:
    """Lean the bird into its turn, as far as the turn's acceleration asks for; columns, (3, 3)."""
    lateral = float(acceleration @ upright[:, 1])
    whole = math.hypot(lateral, GRAVITY)
    c, s = GRAVITY / whole, lateral / whole
    forward, left, up = upright.T
    return np.array([forward, c * left - s * up, s * left + c * up]).T


def _walk(step: float, pace: float) -> tuple[dict[str, float], float]:
    """Swing limbs at a phase of the stride; ``pace`` from 0, standing, to 1.

    Returns:
        Joint angles [rad], and how far the hips rise or sink [m].
    """
    joints = {}
    for side, phase in (("left", step), ("right", step + np.pi)):
        swing = 0.5 - 0.5 * np.cos(phase + 0.5 * np.pi)  # 1 while the leg comes forward
        joints[f"hip_{side}"] = pace * (0.06 + 0.42 * np.sin(phase))
        joints[f"knee_{side}"] = pace * (0.08 + 0.85 * swing**2 * (0.5 + 0.5 * np.cos(phase + 0.2)))
        joints[f"shoulder_{side}"] = pace * -0.40 * np.sin(phase) + 0.02
        joints[f"elbow_{side}"] = 0.15 + pace * (0.25 - 0.18 * np.sin(phase))
    return joints, pace * (-0.028 + 0.018 * np.cos(2 * step))


def _flap(beat: float) -> dict[str, float]:
    """Beat the wings; the outer part follows late."""
    inner = 0.10 + WING_SWING * np.sin(beat)
    outer = -0.06 + OUTER_SWING * np.sin(beat - OUTER_LAG)
    return {
        "wing_inner_left": inner,
        "wing_inner_right": inner,
        "wing_outer_left": outer,
        "wing_outer_right": outer,
    }
