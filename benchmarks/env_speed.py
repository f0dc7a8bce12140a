"""Speed of the environments against MuJoCo alone on the same model, with and without rendering.

A step of an environment is a frame of the fixed camera: commands to head and lens, the cameras' views, detection,
tracking, observation, reward, and the ground truth in `info`. MuJoCo alone simulates a frame's time in steps of the
model's own (`mj_step`, 20 of 2 ms), with prepared target poses set once a frame; with pictures, `mujoco.Renderer` then
draws both cameras at the same size, antialiasing and shadows. Both take turns within one run. The actions are recorded
from the pipeline, because a target in the close-up is the most expensive case.

`cotarget/Follow-v1` is timed alone with features, and as a batch of many environments in one process; both follow the
proportional controller, whose own time does not count.

Steps without pictures run on one thread and are timed by processor time; those with pictures are timed by the clock.
The time of a reset, which builds a world, is reported too.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Gt, Le

from benchmarks.plain_renderer import PlainRenderer
from cotarget.control.policy import proportional
from cotarget.env import Follow, FollowV1, PipelinePolicy
from cotarget.env.batch import FollowBatch
from cotarget.env.common import Vector
from cotarget.sim.render.opengl import mujoco
from cotarget.sim.targets.random_paths import SECONDS
from cotarget.sim.world import SimWorld
from experiments.engine import Count, Row, Settings
from experiments.tables import grouped

SIZE = (64, 64)
BLOCK = 25  # steps of each in turn; with single steps each would find the caches as the other left them
# Goal: least number of steps of an environment in the time of one of MuJoCo's.
WANTED = {"tracks": 0.5, "images": 0.8}
BATCHES = {256: 60_000.0, 2048: 120_000.0}  # environments of a batch, and least steps of all of them a second
BATCH_S, BATCH_PATHS = 8.0, 16  # length of a batch's episodes [s], and its paths


@dataclass(frozen=True)
class EnvSpeedSettings(Settings):
    """Settings: targets and lengths of the episodes."""

    seeds: Count = 1
    targets: tuple[str, ...] = ("book", "person", "bird")  # book, person or bird
    # Length of an episode without pictures [s].
    seconds: Annotated[float, Ge(1.0), Le(SECONDS)] = 20.0  # a block and more
    seconds_seen: Annotated[float, Gt(0), Le(SECONDS)] = 6.0  # length of an episode with pictures [s]


class Alone:
    """MuJoCo alone, on a world's model with its targets' poses."""

    def __init__(self, world: SimWorld, model: "mujoco.MjModel", times: Sequence[float]) -> None:
        """Prepare the poses at the frames' times [s]."""
        self._model, self._data = model, mujoco.MjData(model)
        self._steps = round(1 / world.config.sim.fixed.rate_hz / model.opt.timestep)
        truth = world.truth()
        poses = (truth.set_bodies(t) for t in times)
        self._poses = [(data.qpos.copy(), data.mocap_pos.copy(), data.mocap_quat.copy()) for data in poses]

    def step(self, index: int) -> None:
        """Simulate from one frame to the next."""
        data, model = self._data, self._model
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = self._poses[index]
        data.qvel[:] = 0.0
        for _ in range(self._steps):
            mujoco.mj_step(model, data)


def one(settings: EnvSpeedSettings, seed: int) -> list[Row]:
    """Time all cases once; give a row per block or step."""
    cases = (tracks, features, batches, images)
    return [row for name in settings.targets for case in cases for row in case(settings, name, seed)]


def tracks(settings: EnvSpeedSettings, name: str, seed: int) -> Iterator[Row]:
    """Time blocks of steps without pictures, and of MuJoCo's steps."""
    env = Follow(name, seconds=settings.seconds)
    actions, times, row = prepared(env, name, "tracks", seed)
    world = env.episode.world
    alone = Alone(world, world.truth().model, times)
    for first in range(0, len(actions) - BLOCK + 1, BLOCK):
        block = range(first, first + BLOCK)
        env_us = timed(time.thread_time, lambda i: env.step(actions[i]), block)
        yield row | {"env_us": env_us, "alone_us": timed(time.thread_time, alone.step, block)}
    env.close()


def features(settings: EnvSpeedSettings, name: str, seed: int) -> Iterator[Row]:
    """Time blocks of steps of Follow-v1 with features, and of MuJoCo's steps."""
    env = FollowV1(name, seconds=settings.seconds)
    began = time.perf_counter()
    observation, info = env.reset(seed=seed)
    row: Row = {"seed": seed, "target": name, "what": "features", "reset_ms": 1e3 * (time.perf_counter() - began)}
    world = env.episode.world
    for _ in range(env.frames // BLOCK):
        env_us, times = 0.0, []
        for _ in range(BLOCK):
            action = proportional(observation).astype(np.float32)
            began = time.thread_time()
            observation, _, _, _, info = env.step(action)
            env_us += 1e6 * (time.thread_time() - began) / BLOCK
            times.append(info["t"])
        alone = Alone(world, world.truth().model, times)
        yield row | {"env_us": env_us, "alone_us": timed(time.thread_time, alone.step, range(BLOCK))}
    env.close()


def batches(settings: EnvSpeedSettings, name: str, seed: int) -> Iterator[Row]:
    """Time blocks of steps of the batches, for each environment; MuJoCo alone is not timed again."""
    for count in BATCHES:
        env = FollowBatch(count, name, seconds=min(settings.seconds, BATCH_S), paths=BATCH_PATHS)
        began = time.perf_counter()
        observation, _ = env.reset(seed=seed)
        row: Row = {"seed": seed, "target": name, "what": f"batch of {count}"}
        row |= {"reset_ms": 1e3 * (time.perf_counter() - began), "alone_us": math.nan}
        for _ in range(env.frames // BLOCK):
            env_us = 0.0
            for _ in range(BLOCK):
                action = proportional(observation)
                began = time.thread_time()
                observation, *_ = env.step(action)
                env_us += 1e6 * (time.thread_time() - began) / BLOCK / count
            yield row | {"env_us": env_us}
        env.close()


def images(settings: EnvSpeedSettings, name: str, seed: int) -> Iterator[Row]:
    """Time steps with pictures, and MuJoCo's with its own renderer."""
    env = Follow(name, "images", seconds=settings.seconds_seen, image_size=SIZE)
    actions, times, row = prepared(env, name, "images", seed)
    plain = PlainRenderer(env.episode.world, SIZE)
    alone = Alone(env.episode.world, plain.model, times)
    for i in range(len(actions)):
        env_us = timed(time.perf_counter, lambda i: env.step(actions[i]), range(i, i + 1))
        stepped_us = timed(time.perf_counter, alone.step, range(i, i + 1))
        yield row | {"env_us": env_us, "alone_us": stepped_us + 1e6 * plain.draw(env.times[1])}
    plain.close()
    env.close()


def prepared(env: Follow, name: str, what: str, seed: int) -> tuple[list[Vector], list[float], Row]:
    """Record an episode and reset the environment; give actions, times, and what all rows share."""
    actions, times = held(env, seed)
    began = time.perf_counter()
    env.reset(seed=seed)
    reset_ms = 1e3 * (time.perf_counter() - began)
    return actions, times, {"seed": seed, "target": name, "what": what, "reset_ms": reset_ms}


def held(env: Follow, seed: int) -> tuple[list[Vector], list[float]]:
    """Record the pipeline's actions in an episode, and the times of the frames [s]."""
    policy, actions, times, over = PipelinePolicy(env), list[Vector](), list[float](), False
    observation, _ = env.reset(seed=seed)
    while not over:
        actions.append(policy(observation))
        observation, _, _, over, info = env.step(actions[-1])
        times.append(info["t"])
    return actions, times


def timed(clock: Callable[[], float], step: Callable[[int], object], block: Sequence[int]) -> float:
    """Give the mean time of a step in a block [us]."""
    began = clock()
    for i in block:
        step(i)
    return 1e6 * (clock() - began) / len(block)


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give medians by kind of observation and target, and the speed over MuJoCo's."""
    found = {}
    for (what, name), own in grouped(rows, "what", "target").items():
        env_us, alone_us = (float(np.median([row[key] for row in own])) for key in ("env_us", "alone_us"))
        found[f"{what}, {name}"] = {
            "steps_per_s": 1e6 / env_us,
            "alone_per_s": 1e6 / alone_us,
            "ratio": float(np.median([row["alone_us"] / row["env_us"] for row in own])),
            "reset_ms": float(np.median([row["reset_ms"] for row in own])),
        }
    return found


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the environments slower than their goal."""
    goals = {name: ("ratio", wanted) for name, wanted in WANTED.items()}
    goals |= {f"batch of {count}": ("steps_per_s", wanted) for count, wanted in BATCHES.items()}
    slow = []
    for name, found in summary.items():
        figure, wanted = goals.get(name.split(",")[0], ("ratio", -math.inf))
        if not found[figure] >= wanted:
            slow.append(name)
    return slow


SETTINGS = EnvSpeedSettings()
QUICK = replace(SETTINGS, seeds=1, targets=("bird",), seconds=4.0, seconds_seen=0.4)
ALONE = True
COST_S = 60.0
