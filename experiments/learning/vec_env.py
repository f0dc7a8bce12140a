"""The batch of cotarget/Follow-v1 as a vector environment of Stable-Baselines3.

Both reset in the step that ends an episode. Stable-Baselines3 wants the last observation of that episode in the infos,
as `terminal_observation`, and `TimeLimit.truncated` where it bootstraps.

Head and lens wait without a confirmed track, as in `cotarget follow`, which asks no policy then. Otherwise a policy
learns to turn at random before its target comes into view.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from cotarget.control.policy import TASK_FEATURES
from cotarget.env.batch import FollowBatch

KNOWN = [list(TASK_FEATURES).index("known")]


class BatchVecEnv(VecEnv):  # type: ignore[misc]
    """A `FollowBatch` for Stable-Baselines3.

    Attributes:
        batch: the batch.
        good: share of good close-ups in each environment's episode that has ended last, (n,).
    """

    def __init__(self, batch: FollowBatch) -> None:
        """Wrap a batch."""
        self.batch = batch
        super().__init__(batch.num_envs, batch.single_observation_space, batch.single_action_space)
        self._wanted_seed: int | None = None
        self._steps, self._sum = 0, np.zeros(batch.num_envs)
        self.good = np.full(batch.num_envs, np.nan)
        self._empty: list[dict[str, Any]] = [{} for _ in range(batch.num_envs)]

    def reset(self) -> Any:
        """Begin an episode in each environment."""
        observation, _ = self.batch.reset(seed=self._wanted_seed)
        self._wanted_seed = None
        self._sum[:] = 0.0
        self._known = observation[:, KNOWN]
        return observation

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the next reset."""
        self._wanted_seed = seed
        return [seed] * self.num_envs

    def step_async(self, actions: Any) -> None:
        """Store the actions."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Carry out the stored actions."""
        observation, rewards, terminated, truncated, found = self.batch.step(self._actions * self._known)
        self._known = observation[:, KNOWN]
        over = terminated | truncated
        self._sum += found["good"]
        infos = self._empty
        if over.any():
            self.good = np.where(over, self._sum / self.batch.frames, self.good)
            self._sum[over] = 0.0
            infos = list(infos)
            for i in np.flatnonzero(over).tolist():
                ends_early = bool(truncated[i] and not terminated[i])
                infos[i] = {"terminal_observation": found["final_obs"][i], "TimeLimit.truncated": ends_early}
        return observation, rewards.astype(np.float32), over, infos

    def close(self) -> None:
        """Close the batch."""
        self.batch.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Give an attribute of the batch, once for each environment."""
        return [getattr(self.batch, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: environments of a batch have no attributes of their own."""
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Refuse: environments of a batch have no methods of their own."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Environments of a batch have no wrappers."""
        return [False] * len(list(self._get_indices(indices)))
