"""Offer the pipeline as policies of the environments, as a baseline for others.

A policy is called with an observation and returns an action. These policies ignore the observation and read the frames
and detections behind it. Of the ground truth they know no more than that, and the environment's calibration, which is
exact by default.

An environment's action has no speed, but the pipeline turns the head at the target's speed. So each step commands the
goal at which the head, at full speed, is by the next step where the pipeline's own command would have it.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import gymnasium
from scipy.optimize import brentq

from cotarget.control.head import HeadCommand, HeadModel, axis_at
from cotarget.control.selection import POLICIES
from cotarget.detection import Detections
from cotarget.env.common import Command, Episode, Vector, one_of
from cotarget.env.follow import Follow
from cotarget.env.follow_v1 import FollowV1
from cotarget.env.schedule import Schedule
from cotarget.errors import ConfigError
from cotarget.pipeline import FollowSettings, Step, follow
from cotarget.rig import AxisLimits, Frame, PanTiltLimits, PanTiltState, Speed

NEAR = 1e-6  # tolerance of an angle [rad]


class EnvironmentRig:
    """A rig and a detector for `cotarget.pipeline.follow` that read an environment's last step.

    Attributes:
        rig: the rig; the environment owns its devices.
    """

    def __init__(self, env: Follow) -> None:
        """Wrap an environment that was reset.

        Args:
            env: the environment; its episode provides the rig.
        """
        rig = env.episode.rig
        self._env, self._interval = env, 1 / rig.spec.fixed.rate_hz
        self._head, self._zoom = EnvironmentHead(rig.head.limits, rig.head.state), EnvironmentLens(env)
        fixed = EnvironmentCamera(lambda: env.wide, rig.fixed.size)
        self.rig = replace(rig, fixed=fixed, zoom=self._zoom, head=self._head, release=lambda: None)
        self._model = HeadModel(rig.head.limits)

    def detect(self, frame: Frame, held: object = ()) -> Detections:
        """Return the detections of the newest frame."""
        return self._env.detections

    def command(self) -> Command:
        """Compute the command that carries out the pipeline's requests."""
        state, request = self._head.state(), self._head.request
        self._model.add_report(state)
        if request is None:
            return *self._head.limits.clip(state.pan, state.tilt), self._zoom.request
        pan, tilt = request.pan, request.tilt
        effect = self.rig.clock.now() + self.rig.spec.head.delay_s
        if request.speed is not None:
            speeds = self._head.limits.capped(request.speed)
            axes = zip(self._model.motion_at(effect), (pan, tilt), speeds, self._head.limits.axes, strict=True)
            pan, tilt = (self._hurried(x, v, goal, speed, axis) for (x, v), goal, speed, axis in axes)
            pan, tilt = self._head.limits.clip(pan, tilt)
        self._model.add_command(effect, HeadCommand(pan, tilt, None))
        return pan, tilt, self._zoom.request

    def _hurried(self, x: float, v: float, goal: float, speed: float, axis: AxisLimits) -> float:
        """Find the goal that at full speed brings an axis as far by the next step as a slower command would [rad].

        Args:
            x: position [rad].
            v: speed [rad/s].
            goal: goal of the slower command [rad].
            speed: speed of the slower command [rad/s].
            axis: limits of the axis.
        """
        interval, acceleration = self._interval, axis.assumed_acceleration
        there, _ = axis_at(interval, x, v, goal, speed, acceleration)

        def beyond(end: float) -> float:
            return axis_at(interval, x, v, end, axis.speed, acceleration)[0] - there

        far = abs(goal - x) + v * v / acceleration + axis.speed * interval
        if beyond(x - far) >= 0 or beyond(x + far) <= 0:
            return goal
        return float(brentq(beyond, x - far, x + far, xtol=NEAR))


class EnvironmentCamera:
    """A camera whose newest frame is that of the environment."""

    def __init__(self, newest: Callable[[], Frame], size: tuple[int, int]) -> None:
        self._newest, self.size = newest, size

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Return the newest frame."""
        return self._newest()


class EnvironmentLens(EnvironmentCamera):
    """The zoom camera; its lens moves only with the environment's next step."""

    def __init__(self, env: Follow) -> None:
        lens = env.episode.rig.zoom
        super().__init__(lambda: env.closeup, lens.size)
        self.still_size, self.focal_range, self.state = lens.still_size, lens.focal_range, lens.state
        self.request = lens.state().focal_px

    def zoom(self, focal_px: float) -> float:
        """Store the requested focal length [px], within the lens's range."""
        shortest, longest = self.focal_range
        self.request = min(max(focal_px, shortest), longest)
        return self.request

    def capture(self) -> Frame:
        """Return the newest frame."""
        return self.read()


class EnvironmentHead:
    """The head; it moves only with the environment's next step."""

    def __init__(self, limits: PanTiltLimits, state: Callable[[], PanTiltState]) -> None:
        self.limits, self.state = limits, state
        self.request: HeadCommand | None = None

    def move(self, pan: float, tilt: float, speed: Speed | None = None, wait: bool = False) -> tuple[float, float]:
        """Store the requested command, within the limits."""
        pan, tilt = self.limits.clip(pan, tilt)
        self.request = HeadCommand(pan, tilt, speed)
        return pan, tilt

    def halt(self) -> None:
        """Drop the requested command."""
        self.request = None


class PipelinePolicy:
    """Use `cotarget.pipeline.follow` as a policy of Follow, with the fixed camera alone and with absolute actions."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        """Create the policy.

        Args:
            env: environment to act in, wrapped or not.

        Raises:
            ConfigError: it is another environment.
        """
        if not isinstance(env.unwrapped, Follow):
            raise ConfigError(f"env: the pipeline is a policy of cotarget/Follow-v0, and not of {env.unwrapped}")
        if isinstance(env.unwrapped, FollowV1) and env.unwrapped.action != "absolute":
            raise ConfigError(f"env: the pipeline's actions are 'absolute', and not '{env.unwrapped.action}'")
        self._env = env.unwrapped
        self._episode: Episode | None = None
        self._seen: Frame | None = None

    def __call__(self, observation: object) -> Vector:
        """Return the pipeline's command after the newest frames; the same one until the next step."""
        env = self._env
        if env.episode is not self._episode:
            self._episode, self._rig = env.episode, EnvironmentRig(env)
            settings = FollowSettings(closed_loop=False)
            self._steps: Iterator[Step] = follow(
                self._rig.rig, env.calibration, env.target, self._rig, seconds=math.inf, settings=settings
            )
        if env.wide is not self._seen:
            next(self._steps)
            self._seen, self._action = env.wide, env.units.action(self._rig.command())
        return self._action


class SchedulingPolicy:
    """Use a policy of `cotarget.control.selection` in `cotarget/Schedule-v0`."""

    def __init__(self, env: gymnasium.Env[Any, Any], policy: str = "most-served") -> None:
        """Create the policy.

        Args:
            env: environment to act in, wrapped or not.
            policy: name of the policy.

        Raises:
            ConfigError: it is another environment, or there is no such policy.
        """
        if not isinstance(env.unwrapped, Schedule):
            raise ConfigError(f"env: policies choose in cotarget/Schedule-v0, and not in {env.unwrapped}")
        self._env, self._make = env.unwrapped, POLICIES[one_of("policy", policy, POLICIES)]
        self._episode: Episode | None = None

    def __call__(self, observation: object) -> int:
        """Return the slot of the track that the policy selects; the first slot if it selects none."""
        env = self._env
        if env.episode is not self._episode:
            self._episode, self._selector = env.episode, self._make()
        return env.slot_of(self._selector.select(env.candidates, env.head, env.limits))
