"""Score policies in the single environment on held-out seeds: `python -m experiments.learning.score policy.onnx`.

The score is the share of good close-ups over all frames. Without a file, the pipeline and the proportional controller
are scored. Policies of files, the proportional controller and the pipeline meet the same episodes, so that their
difference is paired. `batch` is the score in the batch, over an episode in each of 256 environments.
"""

import argparse
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from cotarget.control.policy import OnnxPolicy, proportional
from cotarget.env import FOLLOW_V1, PipelinePolicy
from cotarget.env.batch import FollowBatch
from cotarget.errors import ConfigError

BATCH = 256
FIRST_SEED, SEEDS = 1000, 50  # held out from training, whose paths have other seeds
Policy = Callable[[Any], Any]


def score(target: str, policy: str, seeds: range, file: Path | None = None, rig: Path | None = None) -> list[float]:
    """Score a policy in each episode.

    Args:
        target: book, person or bird, or one with a path in the rig's file.
        policy: "pipeline", "proportional", or "file".
        seeds: seeds of the episodes.
        file: the policy's file.
        rig: a rig.toml; None for the environment's own rig.
    """
    learnt = None if file is None else OnnxPolicy(file)
    action = "absolute" if policy == "pipeline" else "rates" if learnt is None else learnt.action
    env = gymnasium.make(FOLLOW_V1, target=target, action=action, reward="yield", rig=rig)
    act: Policy = learnt if learnt is not None else PipelinePolicy(env) if policy == "pipeline" else proportional
    scores = []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        total, steps, over = 0.0, 0, False
        while not over:
            observation, reward, _, over, _ = env.step(act(observation))
            total, steps = total + float(reward), steps + 1
        scores.append(total / steps)
    env.close()
    return scores


def batch_score(target: str, file: Path | None, seed: int, rig: Path | None = None) -> float:
    """Score a policy's file, or the proportional controller, in an episode of each environment of a batch."""
    learnt = None if file is None else OnnxPolicy(file)
    batch = FollowBatch(BATCH, target, "rates" if learnt is None else learnt.action, "yield", rig=rig)
    act: Policy = proportional if learnt is None else learnt
    observations, _ = batch.reset(seed=seed)
    total = 0.0
    for _ in range(batch.frames):
        observations, rewards, *_ = batch.step(act(observations))
        total += float(rewards.mean())
    return total / batch.frames


def main() -> None:
    """Print scores as JSON: means and paired differences to the pipeline, with half of their 95 % intervals."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, help="policies; without, the proportional controller")
    parser.add_argument("--target", default="bird", help="book, person, bird, or one of the rig's own")
    parser.add_argument("--rig", type=Path, help="a rig.toml; without, the environment's own rig")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="number of episodes, 2 at least")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED, help="seed of the first one")
    options = parser.parse_args()
    if options.seeds < 2 or options.first_seed < 0:
        parser.error("--seeds is 2 at least, and --first-seed 0 at least")
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    try:
        for file in options.files:
            OnnxPolicy(file)  # a wrong file is refused before the episodes of the pipeline
        pipeline = np.array(score(options.target, "pipeline", seeds, rig=options.rig))
        print(json.dumps({"pipeline": mean_of(pipeline)}), flush=True)
        for file in options.files or [None]:
            policy = "proportional" if file is None else "file"
            found = np.array(score(options.target, policy, seeds, file, options.rig))
            told = {**mean_of(found), "ahead": mean_of(found - pipeline)}
            told["batch"] = round(batch_score(options.target, file, options.first_seed, options.rig), 4)
            print(json.dumps({str(file or "proportional"): told}), flush=True)
    except ConfigError as error:
        parser.error(str(error))


def mean_of(values: np.ndarray[Any, Any]) -> dict[str, float]:
    """Mean and half its 95 % interval."""
    return {
        "mean": round(float(values.mean()), 4),
        "interval": round(1.96 * float(values.std(ddof=1)) / math.sqrt(len(values)), 4),
    }


if __name__ == "__main__":
    main()
