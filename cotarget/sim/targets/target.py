"""Simulated targets: what a kind of target is, and a target's pose, joint angles and true size at any time.

A scene may have several targets of one kind: ``bird2`` is a second bird. Each kind is a module beside this one, listed
in `cotarget.sim.targets.KINDS`; its model is in sim_assets/targets. A user's own model is a kind too.
"""

import importlib
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path as FilePath

import numpy as np

from cotarget.config import Waypoint, known_targets, split_name
from cotarget.errors import ConfigError
from cotarget.geometry import Array, Rotation
from cotarget.sim.targets import KINDS
from cotarget.sim.targets.attitude import Axes, heading
from cotarget.sim.targets.paths import Path, waypoint_path

MARKERS_OF_A_KIND = 5  # textures of different markers, after which the ids repeat
RANDOM = 3  # random stream of the targets, separate from the world's others
SCATTER_SIGMA = 0.5  # standard deviation over the range of a kind's size: it is two of them
# Position of the body [m], (3,); axes of the body in the world; joint angles [rad] by name.
Stance = tuple[list[float], Axes, Mapping[str, float]]


@dataclass(frozen=True)
class TargetKind:
    """One kind of target.

    Attributes:
        name: also the name of the body in the model.
        stance: gives the stance of a target at a time [s] and a phase of its limb cycle [rad].
        path: draws the kind's path in a scene, given by its name; None where each target needs waypoints. Any scene but
            the built-in ones has the indoor paths of book and person and the outdoor path of the bird.
        limbs: gives the joint angles [rad] by name at a phase of the limb cycle [rad].
        beat: gives the phase of a target's limb cycle at a time [s], which may grow without limit [rad].
        beat_s: period of the limb cycle [s]; 0 for a rigid target.
        scatter: largest relative deviation of the true size from the model's.
        marker: id in DICT_4X4_50 of the marker on the first target of the kind; None for no marker.
        marker_step: from the id of one target of the kind to the next one's; 0 if all have the same marker.
        own: file of a user's own model; the others are in sim_assets/targets.
    """

    name: str
    stance: Callable[["Target", float, float], Stance]
    path: Callable[[str, np.random.Generator], Path] | None
    limbs: Callable[[float], Mapping[str, float]] = lambda beat: {}
    beat: Callable[["Target", float], float] = lambda target, t: target.phase
    beat_s: float = 0.0
    scatter: float = 0.0
    marker: int | None = None
    marker_step: int = 0
    own: FilePath | None = None


@dataclass(frozen=True)
class TargetPose:
    """Pose of a target in the world: position of its body [m], rotation, and joint angles [rad] by name."""

    position: Array
    rotation: Rotation
    joints: Mapping[str, float]


@dataclass(frozen=True)
class Target:
    """One target of the simulated world.

    Attributes:
        name: kind of the target, with a number from the second of its kind on.
        kind: what it is.
        size: true size over the model's size.
        path: path through the world.
        phase: phase of the limb cycle at the start [rad].
        own_way: whether the path is the kind's own, and no waypoints.
    """

    name: str
    kind: TargetKind
    size: float
    path: Path = field(repr=False)
    phase: float = 0.0
    own_way: bool = False

    @property
    def body(self) -> str:
        """Name of the target's body in the compiled world."""
        return f"{self.name}/{self.kind.name}"

    def pose(self, t: float) -> TargetPose:
        """Give pose and joint angles at time ``t`` [s]."""
        position, axes, joints = self.kind.stance(self, t, self.kind.beat(self, t))
        return TargetPose(np.array(position), Rotation.from_matrix(np.transpose(axes), assume_valid=True), joints)


def own_kind(name: str, model: FilePath) -> TargetKind:
    """Make the kind of a user's own model, which is rigid, turns as it moves and has the model's size."""

    def stance(target: Target, t: float, beat: float) -> Stance:
        position, velocity, _ = target.path.motion(t)
        return position, heading(position, velocity), {}

    return TargetKind(name, stance, None, own=model)


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
        name: one of KINDS or a user's own, with a number from 2 on for a further one of its kind.
        scene: name or path of the scene.
        rng: source of the small differences between runs; the same seed gives the same path.
        scatter: whether the true size differs from the nominal size.
        waypoints: [t, x, y, z] of the body's centre in the world [s, m], in place of the kind's own path.
        own: file of a user's own model, which needs waypoints.

    Raises:
        ConfigError: an unknown target.
    """
    kind = kind_of(name) if own is None else own_kind(split_name(name)[0], own)
    # Drawn also where it is not used, so that no switch changes the path.
    size = _draw_size(kind, rng, scatter)  # the generator's first number
    phase = float(rng.uniform(0.0, 2 * np.pi))
    if waypoints is not None:
        return Target(name, kind, size, waypoint_path(waypoints), phase)
    assert kind.path is not None  # a configuration is refused whose own targets have no waypoints
    return Target(name, kind, size, kind.path(scene, rng), phase, own_way=True)


def target_rng(seed: int, name: str) -> np.random.Generator:
    """Make the random generator of one target, independent of the scene's other targets."""
    return np.random.default_rng((seed, RANDOM, zlib.crc32(name.encode())))


def true_size(name: str, seed: int) -> float:
    """Give the true size over the nominal size that a world of that seed gives a target."""
    return _draw_size(kind_of(name), target_rng(seed, name), scatter=True)


def _draw_size(kind: TargetKind, rng: np.random.Generator, scatter: bool) -> float:
    return 1.0 + kind.scatter * SCATTER_SIGMA * float(np.clip(rng.standard_normal(), -2.0, 2.0)) * scatter


@lru_cache(maxsize=256)
def kind_of(name: str) -> TargetKind:
    """Find the kind of a target by its name: that of ``bird`` for ``bird`` and for ``bird2``.

    Raises:
        ConfigError: an unknown target.
    """
    kind, _ = split_name(name)
    if kind not in KINDS:
        raise ConfigError(f"unknown target '{name}'; {known_targets()}")
    found: TargetKind = importlib.import_module(f"cotarget.sim.targets.{kind}").KIND
    return found


def marker_of(name: str) -> int | None:
    """Give the marker on a target, an id in DICT_4X4_50; None for a kind without markers.

    Raises:
        ConfigError: an unknown target.
    """
    kind = kind_of(name)
    index = (split_name(name)[1] - 1) % MARKERS_OF_A_KIND
    return None if kind.marker is None else kind.marker + kind.marker_step * index
