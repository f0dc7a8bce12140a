"""What the environments of version 1 share: rewards to learn from, a cost of wear, and episodes that differ."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import RigConfig
from cotarget.env.common import Action, Command, Episode, Observation, RigEnv, number_in, one_of, require
from cotarget.env.rewards import REWARDS, Reward, commanded_way, shaped
from cotarget.env.variation import Randomization, Variation, randomization_of

GAMMA = 0.99


class Version1(RigEnv[Observation, Action]):
    """Rewards and variations of an environment; a class beside it says what its potential is.

    Attributes:
        reward: what is rewarded.
        gamma: discount of the learner.
        wear: cost of a unit of commanded motion, see `cotarget.env.rewards.commanded_way`.
        randomize: ranges of what differs between episodes; None where nothing does.
    """

    reward: Reward
    gamma: float
    wear: float
    randomize: Randomization | None
    _variation = Variation()
    _potential = _before = 0.0  # after and before the last step

    def _set_up(self, reward: str, gamma: float, wear: float, randomize: Randomization | bool | None) -> None:
        """Check the arguments of version 1.

        Raises:
            ConfigError: one is invalid.
        """
        self.reward = one_of("reward", reward, REWARDS)  # type: ignore[assignment]
        require(number_in(gamma, 0.0, 1.0), "gamma", gamma, "a number above 0 and up to 1")
        require(wear == 0 or number_in(wear, 0.0, math.inf), "wear", wear, "0 or a finite number above it")
        self.gamma, self.wear, self.randomize = float(gamma), float(wear), randomization_of(randomize)

    def _begin(self, seed: int | None, options: Mapping[str, Any] | None) -> int:
        seed = super()._begin(seed, None)
        drawn = Variation() if self.randomize is None else self.randomize.draw(self.np_random)
        self._variation = drawn.with_options(options)
        return seed

    def _made(self, config: RigConfig) -> Episode:
        varied = self._variation
        return Episode(replace(config, sim=varied.sim(config.sim)), varied.noises(self._noise))

    @property
    def calibration(self) -> Calibration:
        """The given calibration or the exact one, with the episode's error."""
        return self._variation.calibrated(super().calibration)

    def _paid(self, earned: float, before: Command, after: Command) -> float:
        """Reward of a step that earned some yield, between two commands."""
        reward = earned
        if self.reward == "dense":
            reward = self._potential
        elif self.reward == "shaped":
            reward = float(shaped(earned, self.gamma, self._before, self._potential))
        if not self.wear:
            return reward
        first, then = (np.array([pan, tilt, math.log(focal_px)]) for pan, tilt, focal_px in (before, after))
        return reward - self.wear * float(commanded_way(first, then, self.config.sim.zoom.size[0]))
