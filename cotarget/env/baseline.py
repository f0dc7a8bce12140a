"""The project's own pipeline as policies of the environments, to compare others with.

Policies are called with an observation and give an action. These do not read the observation: they look at what it is
made from. Of the truth they know no more than that, and the environment's calibration of its rig, which is exact by
default.
"""

import math
from collections.abc import Iterator
from typing import Any

import gymnasium

from cotarget.env.arguments import name_of
from cotarget.env.base import Episode
from cotarget.env.desk import Desk
from cotarget.env.follow import Follow
from cotarget.env.schedule import Schedule
from cotarget.env.units import Vector
from cotarget.errors import ConfigError
from cotarget.loop import FollowSettings, Step, follow
from cotarget.policies import POLICIES
from cotarget.rig import Frame


class PipelinePolicy:
    """`cotarget.loop.follow` as a policy of `cotarget/Follow-v0`, by the wide view alone."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        """Begin.

        Args:
            env: to act in, wrapped or not.

        Raises:
            ConfigError: it is another environment.
        """
        if not isinstance(env.unwrapped, Follow):
            raise ConfigError(f"env: the pipeline is a policy of cotarget/Follow-v0, and not of {env.unwrapped}")
        self._env = env.unwrapped
        self._episode: Episode | None = None
        self._seen: Frame | None = None

    def __call__(self, observation: object) -> Vector:
        """What the pipeline commands after the newest frames; asked again before the next step, the same."""
        env = self._env
        if env.episode is not self._episode:
            self._episode, self._desk = env.episode, Desk(env)
            settings = FollowSettings.of(env.config, closed_loop=False)
            self._steps: Iterator[Step] = follow(
                self._desk, env.calibration, env.target, self._desk, seconds=math.inf, settings=settings
            )
        if env.wide is not self._seen:
            next(self._steps)
            self._seen, self._action = env.wide, env.units.action(self._desk.command())
        return self._action


class SchedulingPolicy:
    """One of `cotarget.policies` as a policy of `cotarget/Schedule-v0`."""

    def __init__(self, env: gymnasium.Env[Any, Any], policy: str = "most-served") -> None:
        """Begin.

        Args:
            env: to act in, wrapped or not.
            policy: its name.

        Raises:
            ConfigError: it is another environment, or there is no such policy.
        """
        if not isinstance(env.unwrapped, Schedule):
            raise ConfigError(f"env: policies choose in cotarget/Schedule-v0, and not in {env.unwrapped}")
        self._env, self._make = env.unwrapped, POLICIES[name_of("policy", policy, POLICIES)]
        self._episode: Episode | None = None

    def __call__(self, observation: object) -> int:
        """The number of the slot of whom the policy looks at; the first where it looks at nobody."""
        env = self._env
        if env.episode is not self._episode:
            self._episode, self._policy = env.episode, self._make()
        return env.slot_of(self._policy.select(env.candidates, env.head, env.limits))
