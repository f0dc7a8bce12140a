"""The field: simulated scenes with a book that is moved, a walking person, a flying bird, or five of a kind.

The rig is the default one under harder conditions: exposure of 1/100 s, 120 ms from light to frame, 80 ms from command
to motion, outdoors, with clutter. Paths are random by seed (`cotarget.sim.targets.random_paths`).

Runs that need no pictures open `SimWorld(config, rendered=())` and detect with `cotarget.evaluation.TruthDetector`.
"""

from collections.abc import Mapping
from dataclasses import replace

from cotarget.config import RigConfig, SimConfig, Waypoint
from cotarget.sim.targets.random_paths import group_paths, lone_path

EXPOSURE_S = 0.01
LATENCY_S = 0.12  # from light to frame, both cameras
COMMAND_DELAY_S = 0.08  # from command to motion, head and lens
SCENE = "outdoor"


def hold_config(name: str, seed: int, scene: str = SCENE) -> RigConfig:
    """Configure one target, a book, person or bird, to follow for 20 s.

    Raises:
        ConfigError: an unknown target.
    """
    return field_config(lone_path(name, seed), seed, scene)


def five_targets_config(seed: int, kind: str = "person", scene: str = SCENE) -> RigConfig:
    """Configure five persons or birds that cross the fixed view (`cotarget.sim.targets.random_paths.group_paths`).

    Raises:
        ConfigError: an unknown kind.
    """
    return field_config(group_paths(kind, seed), seed, scene)


def field_config(paths: Mapping[str, tuple[Waypoint, ...]], seed: int, scene: str = SCENE) -> RigConfig:
    """Configure the default rig under the field's conditions, with targets on paths; outdoor scenes have clutter."""
    sim = SimConfig()
    sim = replace(
        sim,
        scene=scene,
        seed=seed,
        targets=tuple(paths),
        paths=paths,
        fixed=replace(sim.fixed, latency_s=LATENCY_S, exposure_s=EXPOSURE_S),
        zoom=replace(sim.zoom, latency_s=LATENCY_S, exposure_s=EXPOSURE_S),
        head=replace(sim.head, command_delay_s=COMMAND_DELAY_S),
        effects=replace(sim.effects, clutter=True),
    )
    return RigConfig(sim=sim)
