"""Score policies in the single environment on held-out seeds: `python -m experiments.learning.score policy.onnx`.

The score is the share of good close-ups over all frames. Without a file, the pipeline and the proportional controller
are scored. Policies of files, the proportional controller and the pipeline meet the same episodes, so that their
difference is paired.
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

FIRST_SEED, SEEDS = 1000, 50  # held out from training, whose paths have other seeds
Policy = Callable[[Any], Any]


def score(target: str, policy: str, seeds: range, file: Path | None = None) -> list[float]:
    """Score a policy in each episode.

    Args:
        target: book, person or bird.
        policy: "pipeline", "proportional", or "file".
        seeds: seeds of the episodes.
        file: the policy's file.
    """
    learnt = None if file is None else OnnxPolicy(file)
    action = "absolute" if policy == "pipeline" else "rates" if learnt is None else learnt.action
    env = gymnasium.make(FOLLOW_V1, target=target, action=action, reward="yield")
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


def main() -> None:
    """Print scores as JSON: means and paired differences to the pipeline, with half of their 95 % intervals."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, help="policies; without, the proportional controller")
    parser.add_argument("--target", default="bird", choices=("book", "person", "bird"))
    parser.add_argument("--seeds", type=int, default=SEEDS, help=f"number of episodes, from seed {FIRST_SEED} on")
    options = parser.parse_args()
    seeds = range(FIRST_SEED, FIRST_SEED + options.seeds)
    pipeline = np.array(score(options.target, "pipeline", seeds))
    print(json.dumps({"pipeline": mean_of(pipeline)}))
    for file in options.files or [None]:
        found = np.array(score(options.target, "proportional" if file is None else "file", seeds, file))
        ahead = mean_of(found - pipeline)
        print(json.dumps({str(file or "proportional"): {**mean_of(found), "ahead": ahead}}))


def mean_of(values: np.ndarray[Any, Any]) -> dict[str, float]:
    """Mean and half its 95 % interval."""
    return {
        "mean": round(float(values.mean()), 4),
        "interval": round(1.96 * float(values.std(ddof=1)) / math.sqrt(len(values)), 4),
    }


if __name__ == "__main__":
    main()
