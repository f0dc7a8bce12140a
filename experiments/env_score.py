"""What the project's own pipeline earns in the environments, and what chance earns.

In `cotarget/Follow-v0` the score is the part of an episode's frames with a good close-up, its reward over its steps; in
`cotarget/Schedule-v0` the reward of an episode, and how many of the five targets were served. Chance draws every action
anew; where it chooses a slot, one that is not empty.

    python -m experiments.env_score [--seeds 5] [--seed-base 0] [--processes P] [--quick] [--out DIR]
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np
from matplotlib.figure import Figure

from cotarget.env import FOLLOW, SCHEDULE, PipelinePolicy, SchedulingPolicy
from cotarget.policies import POLICIES
from cotarget.sim.fieldpaths import GROUPED, LONE, SECONDS
from experiments.harness import Experiment, Row, Settings, seeds_of, table

CHANCE, PIPELINE = "chance", "pipeline"
Policy = Callable[[Any], Any]


@dataclass(frozen=True)
class ScoreSettings(Settings):
    """How many seeds, and for how long.

    Attributes:
        seconds: of an episode [s].
    """

    seeds: int = 5
    seconds: float = SECONDS


def one(shared: None, settings: ScoreSettings, seed: int) -> list[Row]:
    """All episodes of a seed, a row each."""
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
    """Actions by chance, the same for the same seed."""
    env.action_space.seed(seed)

    def act(observation: Any) -> Any:
        if not isinstance(env.action_space, gymnasium.spaces.Discrete):
            return env.action_space.sample()
        there = (observation["tracks"][:, 0] > 0).astype(np.int8)
        return env.action_space.sample(there)

    return act


def episode(env: gymnasium.Env[Any, Any], policy: Policy, seed: int) -> dict[str, float]:
    """An episode's reward, its steps, and the targets served where that is told."""
    observation, info = env.reset(seed=seed)
    reward, steps, over = 0.0, 0, False
    while not over:
        observation, earned, _, over, info = env.step(policy(observation))
        reward, steps = reward + float(earned), steps + 1
    return {"reward": reward, "steps": steps, "served": info.get("served", np.nan)}


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Means over the seeds: reward a step of following; reward, and targets served, of scheduling."""
    found: dict[str, dict[str, float]] = {}
    for env, of, policy in dict.fromkeys((row["env"], row["of"], row["policy"]) for row in rows):
        own = [row for row in rows if (row["env"], row["of"], row["policy"]) == (env, of, policy)]
        each = [row["reward"] / (row["steps"] if env == FOLLOW else 1) for row in own]
        found.setdefault(f"{env} {of}", {})[policy] = float(np.mean(each))
        if env == SCHEDULE:
            found.setdefault(f"{env} {of}, served", {})[policy] = float(np.mean([row["served"] for row in own]))
    return found


def missed(summary: Mapping[str, Any]) -> list[str]:
    """Where chance earns as much as the best of the project's own."""
    return [name for name, found in summary.items() if found[CHANCE] >= max(v for k, v in found.items() if k != CHANCE)]


def describe(settings: ScoreSettings, summary: Mapping[str, Any]) -> str:
    """A table for each environment."""
    texts = [f"means of {seeds_of(settings)}, {settings.seconds:g} s each"]
    for env in (FOLLOW, SCHEDULE):
        own = {name: found for name, found in summary.items() if name.startswith(env)}
        head = (env, *next(iter(own.values())))
        texts.append(table(head, ([name.removeprefix(env).strip(), *found.values()] for name, found in own.items())))
    return "\n\n".join(texts)


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Each policy a bar."""
    found = summarise(rows)
    for ax, env in zip(figure.subplots(1, 2), (FOLLOW, SCHEDULE), strict=True):
        own = {name.removeprefix(env).strip(): each for name, each in found.items() if name.startswith(env)}
        policies = list(next(iter(own.values())))
        for i, policy in enumerate(policies):
            ax.bar(np.arange(len(own)) + 0.8 * i / len(policies), [each[policy] for each in own.values()],
                   0.7 / len(policies), label=policy)  # fmt: skip
        ax.set(title=env, ylabel="reward", xticks=range(len(own)), xticklabels=list(own))
        ax.legend(frameon=False)


SETTINGS = ScoreSettings()
EXPERIMENT = Experiment(
    "env_score",
    "What the pipeline earns in the environments, and what chance earns.",
    SETTINGS,
    replace(SETTINGS, seeds=1, seconds=8.0),
    one,
    summarise,
    describe,
    plot,
    missed,
    cost_s=60.0,
)

if __name__ == "__main__":
    sys.exit(EXPERIMENT.main())
