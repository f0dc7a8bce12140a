"""Train a policy by PPO in the batch, and write it as an ONNX file.

`python -m experiments.learning.train --target bird --out bird.onnx` trains from scratch with the dense reward and the
action "rates". `--start clone` begins with a clone of the proportional controller, and `--action residual` learns what
is added to the aim. The curve is printed as CSV: seconds, steps, and the share of good close-ups of the episodes that
ended last, with the noise of exploration. The same seed gives the same curve, on a busy machine as well.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from cotarget.control.policy import TASK_FEATURES, proportional
from cotarget.env.batch import FollowBatch
from cotarget.errors import ConfigError
from experiments.learning.onnx_policy import write_policy
from experiments.learning.vec_env import BatchVecEnv

NUM_ENVS = 256
STEPS = 6_000_000  # three minutes of one quiet core
CLIP = 10.0  # of normalised features
PPO_SETTINGS: dict[str, Any] = {
    "n_steps": 64,
    "batch_size": 4096,
    "n_epochs": 6,
    "gamma": 0.95,
    "gae_lambda": 0.9,
    "learning_rate": lambda left: 7e-4 * max(left, 0.05),  # of the part of the steps that is left
}
CLONE_STEPS, CLONE_ROUNDS, CLONE_BATCH = 250, 1500, 4096
RESIDUAL_GAIN = 0.01  # of the last layer, so that a residual begins near 0


class Curve(BaseCallback):  # type: ignore[misc]
    """Print the curve."""

    def __init__(self, env: BatchVecEnv) -> None:
        """Begin the time now."""
        super().__init__()
        self._env, self._began = env, time.perf_counter()
        print("seconds,steps,good,action_std", flush=True)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        episodes = self.num_timesteps / self._env.num_envs / self._env.batch.frames
        before = (self.num_timesteps - self._env.num_envs * self.model.n_steps) / self._env.num_envs
        if int(episodes) > int(before / self._env.batch.frames):
            spread = float(torch.exp(self.model.policy.log_std.detach()).mean())
            seconds = time.perf_counter() - self._began
            print(f"{seconds:.0f},{self.num_timesteps},{np.mean(self._env.good):.4f},{spread:.3f}", flush=True)


def clone(model: Any, env: VecNormalize, rng: np.random.Generator) -> None:
    """Fit the policy to the proportional controller on its own states, with noise on the actions."""
    seen, wanted, observation = [], [], env.reset()
    for _ in range(CLONE_STEPS):
        features = env.get_original_obs()
        action = proportional(features)
        seen.append(observation)
        wanted.append(action)
        noisy = np.clip(action + 0.2 * rng.standard_normal(action.shape), -1.0, 1.0)
        observation, *_ = env.step(noisy)
    inputs, targets = (torch.as_tensor(np.concatenate(each), dtype=torch.float32) for each in (seen, wanted))
    optimizer = torch.optim.Adam(model.policy.parameters(), lr=1e-3)
    for _ in range(CLONE_ROUNDS):
        chosen = torch.as_tensor(rng.integers(len(inputs), size=CLONE_BATCH))
        loss = ((model.policy.get_distribution(inputs[chosen]).mode() - targets[chosen]) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    print(f"# cloned {len(inputs)} actions to an rms error of {loss.item() ** 0.5:.3f}", flush=True)


def export(model: Any, env: VecNormalize, path: Path, action: str) -> None:
    """Write the policy's mean as an ONNX file."""
    policy = model.policy
    linear = [part for part in policy.mlp_extractor.policy_net if isinstance(part, torch.nn.Linear)]
    layers = [(part.weight.detach().numpy(), part.bias.detach().numpy()) for part in [*linear, policy.action_net]]
    scale = 1 / np.sqrt(env.obs_rms.var + env.epsilon)
    write_policy(path, layers, env.obs_rms.mean, scale, env.clip_obs, action)


def main() -> None:
    """Train and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--target", default="bird", help="book, person, bird, or one of the rig's own")
    parser.add_argument("--rig", type=Path, help="a rig.toml; without, the environment's own rig")
    parser.add_argument("--action", default="rates", choices=("rates", "residual"))
    parser.add_argument("--reward", default="dense", choices=("dense", "shaped", "yield"))
    parser.add_argument("--wear", type=float, default=0.0, help="cost of a unit of commanded motion")
    parser.add_argument("--start", default="scratch", choices=("scratch", "clone"))
    parser.add_argument("--randomize", action="store_true", help="vary delays, noise, lens and calibration")
    parser.add_argument("--steps", type=int, default=STEPS, help="of all environments together")
    parser.add_argument("--log-std-init", type=float, default=-1.0, help="logarithm of the exploration's deviation")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("policy.onnx"))
    options = parser.parse_args()
    if options.start == "clone" and options.action == "residual":
        parser.error("--start clone: the clone has the action 'rates'; a residual begins at the aim by itself")
    torch.set_num_threads(1)
    given: dict[str, Any] = {
        name: getattr(options, name) for name in ("target", "action", "reward", "wear", "randomize", "rig")
    }
    try:
        batch = FollowBatch(NUM_ENVS, gamma=PPO_SETTINGS["gamma"], **given)
    except ConfigError as error:
        parser.error(str(error))
    env = BatchVecEnv(batch)
    normalized = VecNormalize(env, norm_reward=False, clip_obs=CLIP)
    network = {"net_arch": [64, 64], "log_std_init": options.log_std_init}
    model = PPO("MlpPolicy", normalized, seed=options.seed, device="cpu", policy_kwargs=network, **PPO_SETTINGS)
    curve = Curve(env)
    if options.action == "residual":
        with torch.no_grad():
            model.policy.action_net.weight.mul_(RESIDUAL_GAIN)
    if options.start == "clone":
        clone(model, normalized, np.random.default_rng(options.seed))
    model.learn(options.steps, callback=curve)
    export(model, normalized, options.out, options.action)
    print(f"# wrote {options.out}: {len(TASK_FEATURES)} features to 3 numbers")


if __name__ == "__main__":
    main()
