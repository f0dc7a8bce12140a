"""`cotarget/Follow-v1`: Follow with actions, features and rewards from which a policy can be learnt."""

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import gymnasium
import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import RigConfig, Waypoint
from cotarget.control.head import HeadCommand, HeadController
from cotarget.control.policy import (
    TASK_FEATURES,
    Numbers,
    Situation,
    ahead_s,
    moved_aim,
    rates_of,
    task_features,
    zoomed,
)
from cotarget.env.aiming import AimSolver
from cotarget.env.common import (
    DETECTOR_NOISE,
    IMAGE_SIZE,
    RIG_FEATURES,
    Command,
    Kind,
    Vector,
    box,
    one_of,
)
from cotarget.env.follow import Follow
from cotarget.env.rewards import Reward, closeness_of
from cotarget.env.variation import Randomization
from cotarget.env.version1 import GAMMA, Version1
from cotarget.evaluation import TruthNoise
from cotarget.metrics import Closeup
from cotarget.rig import Rig
from cotarget.schema import Size
from cotarget.sim.targets.random_paths import LONE, SECONDS, lone_path

Action = Literal["absolute", "rates", "residual"]
ACTIONS: tuple[Action, ...] = get_args(Action)


class FollowV1(Version1[Any, Vector], Follow):
    """Hold a target in the close-up, with actions and features on the scale of the task.

    World, target, noise, episodes and `info` are those of `Follow`. Different are:

    Action: `Box(-1, 1, (3,))`. With "rates" a unit of pan or tilt turns the head by half the close-up's width a frame,
    at most at the head's speed, and a unit of zoom changes the focal length by 10 % a frame. With "residual" the action
    moves the aim, by half-widths and 10 %, and a proportional controller follows the moved aim. "absolute" is as in
    `Follow`.

    Observation: with "tracks" a `Box` of TASK_FEATURES (`cotarget.control.policy`): the aim less the state when a
    command given now takes effect. With "images" a `Dict` of `wide`, `closeup` and `rig` as in `Follow`, and with
    "both" that and `tracks`.

    Reward: "yield" as in `Follow`; "dense" the closeness of the newest zoom frame, 0 to 1, of the target's offset in
    half-widths and its size ratio; "shaped" the yield plus gamma times the closeness after the step less that before.
    Each less `wear` times the way from the command before to the new one, in half-widths and steps of 10 % of the focal
    length.

    `info` has `potential` besides, the closeness.

    Attributes:
        action: what actions mean.
    """

    _kinds = ("tracks", "images", "both")

    def __init__(
        self,
        target: str = "bird",
        action: Action = "rates",
        reward: Reward = "dense",
        observation: Kind = "tracks",
        gamma: float = GAMMA,
        wear: float = 0.0,
        randomize: Randomization | bool | None = None,
        rig: RigConfig | Path | str | None = None,
        calibration: Calibration | Path | str | None = None,
        seconds: float = SECONDS,
        image_size: Size = IMAGE_SIZE,
        noise: TruthNoise = DETECTOR_NOISE,
        render_mode: str | None = None,
    ) -> None:
        """Create the environment; its world is made at the first reset.

        Args:
            target: book, person or bird, or a target with a path in the rig's `[sim.paths]`.
            action: "absolute", "rates" or "residual".
            reward: "yield", "dense" or "shaped".
            observation: "tracks", "images" or "both".
            gamma: discount of the learner, for the reward "shaped".
            wear: cost of a unit of commanded motion.
            randomize: ranges of what differs between episodes; True for the usual ones.
            rig: as in `Follow`; a path that its `[sim.paths]` gives the target counts.
            calibration: calibration that features and policies use, or its file; the true one by default.
            seconds: length of an episode, at most 20 [s].
            image_size: (width, height) of the pictures, 8 to 4096 each [px].
            noise: noise of the detections.
            render_mode: "rgb_array", or None for no `render`.

        Raises:
            ConfigError: an argument is invalid.
        """
        self.action = one_of("action", action, ACTIONS)
        self._set_up(reward, gamma, wear, randomize)
        super().__init__(target, observation, rig, calibration, seconds, image_size, noise, render_mode)

    def _space(self) -> gymnasium.Space[Any]:
        tracks = box(TASK_FEATURES.values())
        if self._observation == "tracks":
            return tracks
        pictures = {**self._picture_spaces(), "rig": box(RIG_FEATURES.values())}
        return gymnasium.spaces.Dict(pictures if self._observation == "images" else {**pictures, "tracks": tracks})

    def _own_paths(self) -> Mapping[str, tuple[Waypoint, ...]]:
        return self.config.sim.paths

    def _targets(self) -> Collection[str]:
        return list(dict.fromkeys([*LONE, *self.config.sim.paths]))

    def path(self, seed: int) -> tuple[Waypoint, ...]:
        """Give the target's path in a world of a seed: the rig's own, or a random one."""
        own = self._own_paths()
        return own[self.name] if self.name in own else lone_path(self.name, seed)[self.name]

    def _path(self, seed: int) -> Mapping[str, tuple[Waypoint, ...]]:
        return {self.name: self.path(seed)}

    def _start(self, rig: Rig) -> None:
        super()._start(rig)
        calibration = self.calibration.for_streams(rig.fixed.size, rig.zoom.size)
        self._solver = AimSolver(calibration, self.target, rig.zoom.focal_range)
        self._head, self._interval = HeadController(rig.head.limits), 1 / rig.spec.fixed.rate_hz
        self._focal = math.log(rig.zoom.state().focal_px)  # logarithm of the last command, before rounding to positions
        self._potential = 0.0

    def _command(self, action: Vector) -> Command:
        rig, self._commanded_before = self.episode.rig, self._commanded
        effect_t = rig.clock.now() + rig.spec.head.delay_s
        pan, tilt, focal_px = self.units.command(action)
        if self.action == "absolute":
            pan, tilt = rig.head.move(pan, tilt)
            self._head.head.add_command(effect_t, HeadCommand(pan, tilt, None))
        else:
            rates: Numbers = moved_aim(self._features, action) if self.action == "residual" else np.asarray(action)
            command = self._head.turn(effect_t, self._turn_rates(rates), ahead_s(rig.head.limits, self._interval))
            pan, tilt = rig.head.move(command.pan, command.tilt, command.speed)
            focal_px = math.exp(zoomed(rates, self._focal, *rig.zoom.focal_range))
        self._focal = math.log(focal_px)
        return pan, tilt, rig.zoom.zoom(focal_px)

    def _turn_rates(self, action: Numbers) -> tuple[float, float]:
        """Rates of pan and tilt that an action stands for [rad/s]."""
        pan, tilt = rates_of(action, self._situation.half_width, self._interval).tolist()
        return pan, tilt

    def _judge(self) -> Closeup:
        judged = super()._judge()
        self._before, self._potential = self._potential, closeness_of(judged)
        return judged

    def _reward(self, judged: Closeup, is_new: bool) -> float:
        return self._paid(super()._reward(judged, is_new), self._commanded_before, self._commanded)

    def _observe(self) -> Any:
        self._features = self._task_features()
        if self._observation == "tracks":
            return self._features
        rig = super()._observe()
        return rig if self._observation == "images" else {**rig, "tracks": self._features}

    def _task_features(self) -> Vector:
        """Compute the TASK_FEATURES of the newest frame."""
        rig, track = self.episode.rig, self._track
        effect_t = rig.clock.now() + rig.spec.head.delay_s
        self._head.head.add_report(rig.head.state())
        motion, focal = np.array(self._head.head.motion_at(effect_t)), math.log(rig.zoom.state().focal_px)
        half_width = self._solver.half_width(np.array(focal))
        commanded = np.array(math.log(self._commanded[2]))
        self._situation = Situation(motion[:, 0], motion[:, 1], commanded, np.array(focal), half_width, self._interval)
        if track is None:
            nowhere = np.zeros(3)
            return task_features(nowhere, nowhere, nowhere, np.array(0.0), np.array(0.0), self._situation)
        lead = np.array([effect_t - track.t, effect_t - track.t + self._interval])
        pixel = track.center_px[:, None] + track.velocity_px[:, None] * lead
        length = self._solver.length_px(track.size_px, np.array(track.larger_side_px))
        aim, then = np.moveaxis(self._solver.solve(pixel, length[None], track.center_px[:, None]), -1, 0)
        command = np.array(self.units.numbers(aim[0], aim[1], math.exp(aim[2])))
        unseen_s = np.array(track.missed * self._interval)
        return task_features(aim, then, command, np.array(1.0), unseen_s, self._situation)

    def _info(self, judged: Closeup) -> dict[str, Any]:
        return {**super()._info(judged), "potential": self._potential}
