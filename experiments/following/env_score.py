"""Scores of the project's pipeline and of random actions in the environments.

In `cotarget/Follow-v0` the score is the fraction of an episode's frames with a good close-up: reward over steps. In
`cotarget/Schedule-v0` it is an episode's reward, and the number of the five targets that were served. Random actions
are drawn independently; a slot is drawn among those that are not empty.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import gymnasium
import numpy as np
from annotated_types import Gt, Le

from cotarget.control.selection import POLICIES
from cotarget.env import FOLLOW, SCHEDULE, PipelinePolicy, SchedulingPolicy
from cotarget.metrics import CENTRED
from cotarget.sim.targets.random_paths import GROUPED, LONE, SECONDS
from experiments.engine import Count, Row, Settings
from experiments.tables import mean_of

CHANCE, PIPELINE = "chance", "pipeline"
SERVED = ", served"  # suffix of a figure's name: number of targets served, beside the reward
ALSO_CENTRED = ", centred"  # the same: fraction of the frames with a good close-up whose target is centred
Policy = Callable[[Any], Any]


@dataclass(frozen=True)
class ScoreSettings(Settings):
    """Settings: length of an episode."""

    seeds: Count = 5
    seconds: Annotated[float, Gt(0), Le(SECONDS)] = SECONDS  # length of an episode [s]


def one(settings: ScoreSettings, seed: int) -> list[Row]:
    """Run all episodes of a seed; give a row per episode."""
    rows = []
    for target in LONE:
        env = gymnasium.make(FOLLOW, target=target, seconds=settings.seconds)
        alone: dict[str, Policy] = {PIPELINE: PipelinePolicy(env), CHANCE: chance(env, seed)}
        for name, policy in alone.items():
            rows.append({"env": FOLLOW, "of": target, "policy": name, "seed": seed, **episode(env, policy, seed)})
        env.close()
    for kind in GROUPED:
        env = gymnasium.make(SCHEDULE, kind=kind, seconds=settings.seconds)
        policies: dict[str, Policy] = {name: SchedulingPolicy(env, name) for name in POLICIES}
        for name, policy in {**policies, CHANCE: chance(env, seed)}.items():
            rows.append({"env": SCHEDULE, "of": kind, "policy": name, "seed": seed, **episode(env, policy, seed)})
        env.close()
    return rows


def chance(env: gymnasium.Env[Any, Any], seed: int) -> Policy:
    """Make a policy of random actions, the same for the same seed."""
    env.action_space.seed(seed)

    def act(observation: Any) -> Any:
        if not isinstance(env.action_space, gymnasium.spaces.Discrete):
            return env.action_space.sample()
        there = (observation["tracks"][:, 0] > 0).astype(np.int8)
        return env.action_space.sample(there)

    return act


def episode(env: gymnasium.Env[Any, Any], policy: Policy, seed: int) -> dict[str, float]:
    """Run an episode; give its reward, its steps, the centred ones of them, and the targets served.

    What the environment does not report is nan.
    """
    observation, info = env.reset(seed=seed)
    reward, centred, steps, over = 0.0, 0.0, 0, False
    width: int = env.unwrapped.config.sim.zoom.size[0]  # type: ignore[attr-defined]
    while not over:
        observation, earned, _, over, info = env.step(policy(observation))
        reward, steps = reward + float(earned), steps + 1
        centred += float(earned) * (info.get("offset_px", np.nan) <= CENTRED * width)
    return {"reward": reward, "steps": steps, "centred": centred, "served": info.get("served", np.nan)}


def figures_of(rows: Sequence[Row]) -> dict[str, dict[str, list[float]]]:
    """Collect values by figure and policy: reward per step of Follow; reward and targets served of Schedule."""
    found: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        name, follows = f"{row['env']} {row['of']}", row["env"] == FOLLOW
        told = {name: row["reward"], name + SERVED: row["served"]}
        if follows:
            told = {name: row["reward"] / row["steps"]}
            told |= {name + ALSO_CENTRED: row["centred"] / row["steps"]} if "centred" in row else {}
        for figure, value in told.items():
            found.setdefault(figure, {}).setdefault(row["policy"], []).append(value)
    return found


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """Give means of the figures over the seeds, with standard errors."""
    return {
        name: {policy: dict(zip(("mean", "error"), mean_of(values), strict=True)) for policy, values in found.items()}
        for name, found in figures_of(rows).items()
    }


def bounded(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Give the means."""
    return {name: {policy: each["mean"] for policy, each in found.items()} for name, found in summary.items()}


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List where random actions score as well as the best of the project's policies."""
    means = bounded(summary)
    return [name for name, found in means.items() if found[CHANCE] >= max(v for k, v in found.items() if k != CHANCE)]


SETTINGS = ScoreSettings()
QUICK = replace(SETTINGS, seeds=1, seconds=8.0)
COST_S = 60.0
