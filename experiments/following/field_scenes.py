"""The field in which targets are held: a book put elsewhere, a person walking, a bird flying, five of a kind at once.

The rig is the default one under harder conditions: 1/100 s of exposure, 120 ms from light to frame, 80 ms from command
to motion, and outdoors, with the clutter on. Paths are random by seed (`cotarget.sim.targets.random_paths`).

Accuracy runs that need no pictures open `SimWorld(config, rendered=())` and detect with
`cotarget.evaluation.TruthDetector`.
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
    """One target to hold for 20 s.

    Args:
        name: book, person or bird.
        seed: of everything random.
        scene: the scene; outdoors there is clutter.

    Raises:
        ConfigError: no such target.
    """
    return field_config(lone_path(name, seed), seed, scene)


def five_targets_config(seed: int, kind: str = "person", scene: str = SCENE) -> RigConfig:
    """Five persons or birds that cross the wide view, as `cotarget.sim.targets.random_paths.group_paths` has them.

    Args:
        seed: of everything random.
        kind: person or bird.
        scene: the scene; outdoors there is clutter.

    Raises:
        ConfigError: another kind.
    """
    return field_config(group_paths(kind, seed), seed, scene)


def field_config(paths: Mapping[str, tuple[Waypoint, ...]], seed: int, scene: str = SCENE) -> RigConfig:
    """The default rig under the field's conditions.

    Args:
        paths: of the targets, by their names; nobody is there without any.
        seed: of everything random.
        scene: the scene; outdoors there is clutter.
    """
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
