"""Speed of the simulated rig: against mujoco.Renderer on the same frames, by effect, and against real time.

A step is the loop's access to the rig at 25 Hz without detection: a frame of each camera, the states of head and lens,
and a command to each. The compared ways take turns within one run, because a machine's speed drifts; figures are
medians over the steps.

1. Image effects off: a step, and mujoco.Renderer drawing the same two frames of the same world, with the same size,
   antialiasing, focal length and pose, the poses being prepared.
2. Each image effect alone, and all of them, against none. Blur is that of 1/100 s under a turning head. The same with
   all of them, and all but clutter, at 640x480 and 1920x1080, with the processor's time of all threads.
3. Seconds of simulated time per second of the whole pipeline following a bird, as in `experiments.following.hold`: both
   cameras rendered with all effects; and nothing rendered, with detections from ground truth. For the latter, the time
   of the simulation alone is given too.
"""

import contextlib
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt, Le

from benchmarks.plain_renderer import PlainRenderer
from cotarget.calibration import Calibration
from cotarget.config import RigConfig
from cotarget.evaluation import TruthDetector
from cotarget.pipeline import FollowSettings, Step
from cotarget.sim.targets.random_paths import SECONDS
from cotarget.sim.truth import Truth
from cotarget.sim.world import SimWorld
from experiments.engine import Count, Row
from experiments.following.field import FieldSettings, calibrated, hold_config, watched, watched_in
from experiments.tables import outside

IMAGE_EFFECTS = ("noise", "jpeg", "distortion", "blur", "clutter")
TARGET = "bird"
TURN, TURN_S = 0.15, 1.5  # amplitude [rad] and period [s] of the head's swing
ZOOMED = 3.0  # factor on the shortest focal length
SETTLED_S = 1.0  # time before anything is timed; the lens has arrived then
RENDERER, LOOP, ALL = "mujoco.Renderer", "loop", "all of them"
# Timed cases of size and image effects; clutter changes all of the fixed camera's picture from frame to frame.
SIZED: Mapping[str, tuple[tuple[int, int], tuple[str, ...]]] = {
    f"{size[0]}x{size[1]}{words}": (size, tuple(name for name in IMAGE_EFFECTS if name not in without))
    for size in ((640, 480), (1920, 1080))
    for words, without in (("", ()), (", no clutter", ("clutter",)))
}
# Goals: least and largest value.
WANTED: Mapping[str, tuple[float, float]] = {
    "loop_over_renderer": (0.0, 1.15),
    "real_time_rendered": (0.5, math.inf),
    "real_time_unrendered": (20.0, math.inf),
}


@dataclass(frozen=True)
class SimSpeedSettings(FieldSettings):
    """Settings: timed steps per world, and lengths of the runs."""

    seeds: Count = 1
    steps: Count = 60  # timed steps of each world
    # Timing starts after SETTLED_S, and the paths last longer by that.
    seconds: Annotated[float, Gt(0), Le(SECONDS)] = SECONDS  # length of the run without pictures [s]
    seconds_rendered: Annotated[float, Gt(0), Le(SECONDS)] = 6.0  # length of the run with pictures [s]


def one(settings: SimSpeedSettings, seed: int) -> list[Row]:
    """Time all cases once; give a row per step."""
    rows = _beside_renderer(settings, seed) + _beside_none(settings, seed) + _sized(settings, seed)
    for what, steps in (
        ("rendered", held(calibrated(settings), settings.seconds_rendered, seed)),
        ("unrendered", held_unrendered(calibrated(settings), settings.seconds, seed)),
    ):
        rows.append({"seed": seed, "what": what, "factor": real_time_factor(steps)})
    rows.append({"seed": seed, "what": "simulation alone", "ms": _alone(settings, seed)})
    return rows


def config_with(seed: int, on: Sequence[str], size: tuple[int, int] = (640, 480)) -> RigConfig:
    """Configure the bird to follow with these image effects only; other effects are unchanged."""
    config = hold_config(TARGET, seed)
    effects = replace(config.sim.effects, **{name: name in on for name in IMAGE_EFFECTS})
    fixed, zoom = config.sim.fixed, config.sim.zoom
    fixed = replace(fixed, size=size, **fixed.fitted(size, None))
    zoom = replace(zoom, size=size, **zoom.fitted(size, None))
    return replace(config, sim=replace(config.sim, effects=effects, fixed=fixed, zoom=zoom))


class Stepper:
    """The loop's access to a rig, without detection."""

    def __init__(self, config: RigConfig) -> None:
        self.world = SimWorld(config)
        rig = self.world.rig
        rig.zoom.zoom(ZOOMED * rig.zoom.focal_range[0])
        rig.clock.sleep_until(SETTLED_S)
        self.t = SETTLED_S - config.sim.fixed.latency_s

    def step(self) -> float:
        """Do one step; give the time taken [s]."""
        rig = self.world.rig
        began = time.perf_counter()
        self.t = rig.fixed.read(newer_than=self.t).t
        rig.zoom.read()
        rig.head.state()
        rig.zoom.state()
        swing = TURN * math.sin(2 * math.pi * rig.clock.now() / TURN_S)
        rig.head.move(swing, 0.3 * swing)
        rig.zoom.zoom(ZOOMED * rig.zoom.focal_range[0])
        return time.perf_counter() - began


def _beside_renderer(settings: SimSpeedSettings, seed: int) -> list[Row]:
    """Time steps without image effects, and mujoco.Renderer on their frames, in turns."""
    stepper = Stepper(config_with(seed, ()))
    plain = PlainRenderer(stepper.world)
    rows = []
    with stepper.world.rig:
        for i in range(settings.steps + 1):
            loop = stepper.step()
            renderer = plain.draw(stepper.t)
            if i:  # the first step fills caches
                rows += [
                    {"seed": seed, "what": LOOP, "step": i, "ms": 1e3 * loop},
                    {"seed": seed, "what": RENDERER, "step": i, "ms": 1e3 * renderer},
                ]
    plain.close()
    return rows


def _beside_none(settings: SimSpeedSettings, seed: int) -> list[Row]:
    """Time steps with each image effect alone, with all of them and with none, in turns."""
    ways = {**{name: (name,) for name in IMAGE_EFFECTS}, ALL: IMAGE_EFFECTS}
    without, steppers = Stepper(config_with(seed, ())), {what: Stepper(config_with(seed, ways[what])) for what in ways}
    rows: dict[str, list[Row]] = {what: [] for what in ways}
    with contextlib.ExitStack() as stack:
        for each in (without, *steppers.values()):
            stack.enter_context(each.world.rig)
        for i in range(settings.steps + 1):
            bare = without.step()
            for what, stepper in steppers.items():
                row = {"seed": seed, "what": what, "step": i, "ms": 1e3 * stepper.step(), "without_ms": 1e3 * bare}
                rows[what] += [row] if i else []
    return [row for mine in rows.values() for row in mine]


def _sized(settings: SimSpeedSettings, seed: int) -> list[Row]:
    """Time the steps of `SIZED`, in real time and in the processor's."""
    rows = []
    for what, (size, effects) in SIZED.items():
        stepper = Stepper(config_with(seed, effects, size))
        with stepper.world.rig:
            stepper.step()  # the first step fills caches
            for i in range(settings.steps):
                began = time.process_time()
                ms = 1e3 * stepper.step()
                cpu_ms = 1e3 * (time.process_time() - began)
                rows.append({"seed": seed, "what": what, "step": i, "ms": ms, "cpu_ms": cpu_ms})
    return rows


def held(calibration: Calibration, seconds: float, seed: int) -> Iterator[tuple[Step, Truth]]:
    """Follow the bird with both cameras rendered, for some seconds after SETTLED_S."""
    config = hold_config(TARGET, seed)
    return watched(calibration, config, config.target(TARGET), SETTLED_S + seconds)


def held_unrendered(calibration: Calibration, seconds: float, seed: int) -> Iterator[tuple[Step, Truth]]:
    """Follow the bird with nothing rendered, and so without correction from the zoom view."""
    config = hold_config(TARGET, seed)
    world = SimWorld(config, rendered=())
    settings = FollowSettings(closed_loop=False)
    detector = TruthDetector(world.truth(), seed)
    return watched_in(world, detector, calibration, config.target(TARGET), SETTLED_S + seconds, settings)


def real_time_factor(steps: Iterable[tuple[Step, Any]]) -> float:
    """Give simulated over real time of a run, from its first Step later than SETTLED_S on."""
    began = start = end = math.nan
    for step, _ in steps:
        end = step.t
        if math.isnan(start) and end >= SETTLED_S:
            start, began = end, time.perf_counter()
    return (end - start) / (time.perf_counter() - began)


def _alone(settings: SimSpeedSettings, seed: int) -> float:
    """Time the simulation alone in a step without rendering: rig calls, poses, one box of ground truth [ms]."""
    config = hold_config(TARGET, seed)
    world = SimWorld(config, rendered=())
    truth: Truth = world.truth()
    took = []
    with world.rig as rig:
        t = 0.0
        for i in range(10 * settings.steps):
            began = time.perf_counter()
            t = rig.fixed.read(newer_than=t).t
            truth.box(TARGET, "fixed", t)
            rig.head.state()
            rig.zoom.read()
            rig.zoom.state()
            rig.head.move(0.1 * math.sin(i), 0.0)
            took.append(time.perf_counter() - began)
    return 1e3 * float(np.median(took))


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Give medians over the steps of all seeds."""

    def of(what: str, key: str = "ms") -> Any:
        return np.array([row[key] for row in rows if row["what"] == what], dtype=float)

    shares = {
        name: {
            "ms": float(np.median(of(name))),
            "without_ms": float(np.median(of(name, "without_ms"))),
            "more_ms": float(np.median(of(name) - of(name, "without_ms"))),
        }
        for name in (*IMAGE_EFFECTS, ALL)
    }
    sizes = {
        what: {"ms": float(np.median(of(what))), "cpu_ms": float(np.median(of(what, "cpu_ms")))}
        for what in SIZED
        if len(of(what))  # rows of 0.1.0 have none
    }
    return {
        "loop_ms": float(np.median(of(LOOP))),
        "renderer_ms": float(np.median(of(RENDERER))),
        "loop_over_renderer": float(np.median(of(LOOP) / of(RENDERER))),
        "effects": shares,
        **({"sizes": sizes} if sizes else {}),
        "real_time_rendered": float(np.median(of("rendered", "factor"))),
        "real_time_unrendered": float(np.median(of("unrendered", "factor"))),
        "simulation_alone_ms": float(np.median(of("simulation alone"))),
    }


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the figures that miss their goal."""
    return outside(summary, WANTED)


SETTINGS = SimSpeedSettings()
QUICK = replace(SETTINGS, seeds=1, steps=2, seconds_rendered=0.4, seconds=2.0, calibrated=False)
ALONE = True
COST_S = 160.0
