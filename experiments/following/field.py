"""The field: simulated scenes, their calibration, and runs judged by ground truth; shared by the experiments in it.

A book that is moved, a walking person, a flying bird, or five of a kind. The rig is the default one under harder
conditions: exposure of 1/100 s, 120 ms from light to frame, 80 ms from command to motion, outdoors, with clutter. Paths
are random by seed (`cotarget.sim.targets.random_paths`).

Runs that need no pictures open `SimWorld(config, rendered=())` and detect with `cotarget.evaluation.TruthDetector`.
"""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated

from annotated_types import Gt, Le

from cotarget.calibration import Calibration
from cotarget.config import RigConfig, SimConfig, TargetProfile, Waypoint
from cotarget.control.selection import TargetSelector
from cotarget.detection import Detector, make_detector
from cotarget.evaluation import add_row, true_calibration
from cotarget.metrics import BACKGROUND_S
from cotarget.metrics import Row as Judged
from cotarget.pipeline import FollowSettings, Step
from cotarget.safety.safe_rig import guard
from cotarget.sim.targets.random_paths import SECONDS, group_paths, lone_path
from cotarget.sim.truth import Truth
from cotarget.sim.world import SimWorld
from experiments.engine import Settings
from experiments.following.own_rig import OwnRig, RigText, calibrated_rig
from experiments.following.wide_view import WideView, open_on
from experiments.paper.paper_loop import Follow, Task, follow_as_this_project

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


@dataclass(frozen=True)
class FieldSettings(Settings):
    """Settings of runs in the field: their length, and whether the rig is calibrated."""

    # Length of each run, from the start of the clock to the end of the targets' paths [s].
    seconds: Annotated[float, Gt(BACKGROUND_S), Le(SECONDS)] = SECONDS
    calibrated: bool = True  # whether the rig is calibrated from rendered boards; otherwise it is known exactly


@dataclass(frozen=True)
class OwnRigInField(OwnRig, FieldSettings):
    """Settings of runs in the field for an experiment that accepts a user's own rig."""


def calibrated(settings: FieldSettings) -> Calibration:
    """Calibrate the settings' rig, from rendered boards or exactly."""
    rig = settings.text if isinstance(settings, OwnRig) else RigText()
    return calibrated_rig(rig, settings.seed_base) if settings.calibrated else _exact(rig, settings.seed_base)


@functools.cache
def _exact(rig: RigText, seed: int) -> Calibration:
    return true_calibration(SimWorld(rig.config("indoor", (), seed), rendered=()))


def held(
    calibration: Calibration,
    config: RigConfig,
    name: str,
    seconds: float,
    settings: FollowSettings | None = None,
    view: WideView | None = None,
) -> list[Judged]:
    """Follow a target of a simulated rig, and judge every frame; a view that is not recorded is rendered."""
    target, rows = config.target(name), list[Judged]()
    for step, truth in watched(calibration, config, target, seconds, settings, view):
        add_row(rows, step, truth, name, target)
    return rows


def watched(
    calibration: Calibration,
    config: RigConfig,
    target: TargetProfile,
    seconds: float,
    settings: FollowSettings | None = None,
    view: WideView | None = None,
    selector: TargetSelector | None = None,
) -> Iterator[tuple[Step, Truth]]:
    """Follow a target of a simulated rig, by default the first that comes; yield each Step with the ground truth."""
    settings = settings or FollowSettings()
    if view is None:
        world, detector = SimWorld(config), make_detector(target, config.sim.fixed.rate_hz)
    else:
        world, detector = open_on(view, config, closed_loop=settings.closed_loop)
    how = partial(follow_as_this_project, selector=selector)
    yield from watched_in(world, detector, calibration, target, seconds, settings, how)


def watched_in(
    world: SimWorld,
    detector: Detector,
    calibration: Calibration,
    target: TargetProfile,
    seconds: float,
    settings: FollowSettings,
    how: Follow = follow_as_this_project,
) -> Iterator[tuple[Step, Truth]]:
    """Follow a target in an open world with a given detector and loop; yield each Step with the ground truth."""
    truth = world.truth()
    with guard(world.rig, world.config.safety) as rig:
        for step in how(Task(rig, calibration, target, detector, seconds, settings)):
            yield step, truth
