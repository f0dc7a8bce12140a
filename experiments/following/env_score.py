"""Scores of the project's pipeline and of random actions in the environments.

In `cotarget/Follow-v0` the score is the fraction of an episode's frames with a good close-up: reward over steps. In
`cotarget/Schedule-v0` it is an episode's reward, and the number of the five targets that were served. Random actions
are drawn independently; a slot is drawn among those that are not empty.

    python -m experiments.following.env_score [--seeds 5] [--seed-base 0] [--processes P] [--quick] [--out DIR]
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np
from matplotlib.figure import Figure

from cotarget.control.selection import POLICIES
from cotarget.env import FOLLOW, SCHEDULE, PipelinePolicy, SchedulingPolicy
from cotarget.sim.targets.random_paths import GROUPED, LONE, SECONDS
from experiments.engine.checks import check_above, check_ways
from experiments.engine.harness import Experiment, Row, Settings, seeds_of
from experiments.engine.spread import bars, mean_of
from experiments.engine.texts import table

CHANCE, PIPELINE = "chance", "pipeline"
SERVED = ", served"  # suffix of a figure's name: number of targets served, beside the reward
Policy = Callable[[Any], Any]


@dataclass(frozen=True)
class ScoreSettings(Settings):
    """Settings: length of an episode.

    Attributes:
        seconds: length of an episode [s].
    """

    seeds: int = 5
    seconds: float = SECONDS

    def __post_init__(self) -> None:
        """Refuse values that the environments refuse."""
        super().__post_init__()
        check_above(0, self, "seconds")
        check_ways(self, "seconds")


def one(shared: None, settings: ScoreSettings, seed: int) -> list[Row]:
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
    """Run an episode; give its reward, its steps, and the targets served where the environment reports them."""
    observation, info = env.reset(seed=seed)
    reward, steps, over = 0.0, 0, False
    while not over:
        observation, earned, _, over, info = env.step(policy(observation))
        reward, steps = reward + float(earned), steps + 1
    return {"reward": reward, "steps": steps, "served": info.get("served", np.nan)}


def figures_of(rows: Sequence[Row]) -> dict[str, dict[str, list[float]]]:
    """Collect values by figure and policy: reward per step of Follow; reward and targets served of Schedule."""
    found: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        name, follows = f"{row['env']} {row['of']}", row["env"] == FOLLOW
        told = {name: row["reward"] / row["steps"]} if follows else {name: row["reward"], name + SERVED: row["served"]}
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


def describe(settings: ScoreSettings, summary: Mapping[str, Any]) -> str:
    """Format a table per environment."""
    texts = [f"means with standard errors of {seeds_of(settings)}, {settings.seconds:g} s each"]
    for env in (FOLLOW, SCHEDULE):
        own = {name: found for name, found in summary.items() if name.startswith(env)}
        lines = (
            [name.removeprefix(env).strip(), *("{mean:.3g} +- {error:.2g}".format(**each) for each in found.values())]
            for name, found in own.items()
        )
        texts.append(table((env, *next(iter(own.values()))), lines))
    return "\n\n".join(texts)


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Each policy a bar: means with standard errors, a point a seed."""
    found = figures_of(rows)
    panels = {
        (FOLLOW, "reward a step"): [name for name in found if name.startswith(FOLLOW)],
        (SCHEDULE, "reward"): [name for name in found if name.startswith(SCHEDULE) and not name.endswith(SERVED)],
        (SCHEDULE, "targets served"): [name for name in found if name.endswith(SERVED)],
    }
    figure.set_size_inches(12, 4.2)
    for ax, ((env, label), names) in zip(figure.subplots(1, len(panels)), panels.items(), strict=True):
        policies = list(found[names[0]])
        for i, policy in enumerate(policies):
            at = [place + 0.8 * (i - (len(policies) - 1) / 2) / len(policies) for place in range(len(names))]
            bars(ax, at, [found[name][policy] for name in names], 0.7 / len(policies), label=policy)
        targets = [name.removeprefix(env).removesuffix(SERVED).strip() for name in names]
        ax.set(title=env, ylabel=label, xticks=range(len(names)), xticklabels=targets)
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=2, frameon=False)


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
    bounded=bounded,
)
if __name__ == "__main__":
    sys.exit(EXPERIMENT.main())
