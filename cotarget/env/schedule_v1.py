"""`cotarget/Schedule-v1`: Schedule with rewards from which a policy can be learnt, and with the ways of the head."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cotarget.calibration import Calibration
from cotarget.config import RigConfig
from cotarget.control.selection import Candidate, travel_s
from cotarget.env.common import DETECTOR_NOISE, IMAGE_SIZE, Kind
from cotarget.env.rewards import Reward, closeness_of
from cotarget.env.schedule import CANDIDATE_FEATURES, SERVED_REWARD, Schedule, is_served
from cotarget.env.variation import Randomization
from cotarget.env.version1 import GAMMA, Version1
from cotarget.evaluation import TruthNoise, closeup_of
from cotarget.pipeline import Step
from cotarget.schema import Size
from cotarget.sim.targets.random_paths import SECONDS

LONGEST_TRAVEL_S = 4.0
SLOT_FEATURES = {**CANDIDATE_FEATURES, "travel_s": (0.0, LONGEST_TRAVEL_S)}  # the head's way to where it is now


class ScheduleV1(Version1[dict[str, Any], int], Schedule):
    """Choose which of five targets to follow, with rewards to learn from.

    World, targets, noise, episodes, actions and `info` are those of `Schedule`. Different are:

    Observation: a slot has `travel_s` besides, the time that the head takes to turn to where the target is now [s],
    (8, 11). "both" includes the pictures; there is no observation without `tracks`, to which the slots belong.

    Reward: "yield" as in `Schedule`; "dense" the largest closeness, as in `cotarget.env.FollowV1`, of the targets that
    were not served before the newest zoom frame; "shaped" the yield plus gamma times that closeness after the step less
    that before. Each less `wear` times the way of the pipeline's command, as in `cotarget.env.FollowV1`.

    `info` has `potential` besides, that closeness.
    """

    _kinds = ("tracks", "both")
    _features = SLOT_FEATURES

    def __init__(
        self,
        kind: str = "person",
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
        served_reward: float = SERVED_REWARD,
        render_mode: str | None = None,
    ) -> None:
        """Create the environment; its world is made at the first reset.

        Args:
            kind: kind of the targets, person or bird.
            reward: "yield", "dense" or "shaped".
            observation: "tracks", or "both" to include the pictures of both cameras.
            gamma: discount of the learner, for the reward "shaped".
            wear: cost of a unit of commanded motion.
            randomize: ranges of what differs between episodes; True for the usual ones.
            rig: as in `cotarget.env.Follow`.
            calibration: calibration for the pipeline, or its file; the true one by default.
            seconds: length of an episode, at most 20 [s].
            image_size: (width, height) of the pictures, 8 to 4096 each [px].
            noise: noise of the detections.
            served_reward: reward for each served target, of the yield.
            render_mode: "rgb_array", or None for no `render`.

        Raises:
            ConfigError: an argument is invalid.
        """
        self._set_up(reward, gamma, wear, randomize)
        super().__init__(kind, observation, rig, calibration, seconds, image_size, noise, served_reward, render_mode)

    def _good(self) -> dict[str, bool]:
        judged = {
            name: closeup_of(self.episode.outlines, name, self.target, self._step.zoom.t) for name in self._good_s
        }
        waiting = [closeness_of(judged[name]) for name, seconds in self._good_s.items() if not is_served(seconds)]
        self._before, self._potential = self._potential, max(waiting, default=0.0)
        return {name: closeup.good for name, closeup in judged.items()}

    def _reward(self, before: Step, good: Mapping[str, bool]) -> float:
        return self._paid(super()._reward(before, good), before.commanded, self._step.commanded)

    def _candidate_numbers(self, candidate: Candidate | None) -> list[float]:
        numbers = super()._candidate_numbers(candidate)
        if candidate is None:
            return numbers
        pan, tilt = (candidate.at - self.head).tolist()
        return [*numbers, travel_s((pan, tilt), self.limits)]

    def _info(self, good: dict[str, bool]) -> dict[str, Any]:
        return {**super()._info(good), "potential": self._potential}
