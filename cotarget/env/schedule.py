"""`cotarget/Schedule-v0`: choose which of several targets to follow; the pipeline does the rest."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import RigConfig
from cotarget.control.selection import Candidate, Rounds
from cotarget.env.common import (
    DETECTOR_NOISE,
    IMAGE_SIZE,
    RIG_FEATURES,
    Kind,
    RigEnv,
    box,
    check_scene,
    number_in,
    one_of,
    require,
    rig_numbers,
    within,
)
from cotarget.evaluation import TruthNoise, closeup_of
from cotarget.geometry import Array
from cotarget.metrics import ROUNDING_S, SERVED_S
from cotarget.pipeline import FollowSettings, Step, follow
from cotarget.rig import PanTiltLimits
from cotarget.schema import Size
from cotarget.sim.targets.random_paths import GROUPED, SECONDS, group_paths
from cotarget.tracking.track import Track

SLOTS = 8  # for tracks: five targets, and those that were lost and found again under another id
SERVED_REWARD = 5.0  # per served target: as much as as many seconds of good close-ups

# Features of a track that a policy sees (`cotarget.control.selection.Candidate`), with the range of each; 0 in an empty
# slot.
CANDIDATE_FEATURES = {
    "there": (0.0, 1.0),  # whether the slot has a track
    "followed": (0.0, 1.0),  # whether it is the followed track
    "detected": (0.0, 1.0),  # whether the newest frame detected it
    "pan": (-1.0, 1.0),  # pan that points at it, as a part of the head's range
    "tilt": (-1.0, 1.0),
    "pan_rate": (-1.0, 1.0),  # rate of that [1/s]
    "tilt_rate": (-1.0, 1.0),
    "leaves_in": (0.0, 1.0),  # time until it leaves the fixed image, as a part of the longest episode
    "seen": (0.0, 1.0),  # time well in the close-up, as a part of the time for which policies look at each
    "reachable": (0.0, 1.0),  # whether the head can point at it
}


def is_served(good_s: float) -> bool:
    """Whether a target was well in the close-up for long enough [s]."""
    return good_s >= SERVED_S - ROUNDING_S


class ActionSelector:
    """Select the track of the action in the pipeline.

    Attributes:
        candidates: candidates of the newest frame.
        number: id of the track to follow.
    """

    unmet = "no track is asked for"

    def __init__(self) -> None:
        self.candidates: Sequence[Candidate] = ()
        self.number: int | None = None

    def start(self, image_size: tuple[int, int]) -> None:
        """Do nothing: an environment makes a selector for each episode."""

    def select(self, candidates: Sequence[Candidate], head: Array, limits: PanTiltLimits) -> int | None:
        """Return the track of the action, while it is there."""
        self.candidates = tuple(candidates)
        return self.number if self.number in {candidate.id for candidate in candidates} else None

    def favours(self, track: Track) -> bool:
        """Whether a track is that of the action."""
        return track.id == self.number


class Schedule(RigEnv[dict[str, Any], int]):
    """Choose which of five targets to follow; the project's pipeline does everything else.

    A step is a frame of the fixed camera. Five persons or birds enter the fixed image, cross it and leave. Their paths
    and sizes, and the noise, follow from the episode's seed. An episode is truncated after its seconds.

    Action: `Discrete(8)`, the slot of the track to follow from the next frame on. A track keeps its slot while it is
    confirmed. With an empty slot no track is followed: the head waits and the lens zooms out. `info["action_mask"]` is
    1 for each slot with a track.

    Observation: a `Dict` of `tracks`, the CANDIDATE_FEATURES of each slot, (8, 10), all 0 in an empty one; `rig`, the
    RIG_FEATURES; and with "images" also the pictures `wide` and `closeup`, RGB. The detections are the ground truth
    with a detector's noise.

    Reward: the seconds for which each target was well in the close-up since the previous zoom frame
    (`cotarget.metrics.Closeup.good`), and `served_reward` for each target that reaches one second of that in all.

    `info` alone holds ground truth: `t` and `t_closeup`, exposure times of the newest frames [s]; for the targets
    `kind`, `kind2` to `kind5`: `good` in that zoom frame, (5,); `good_s` so far [s]; `box_closeup` and `box_wide` as
    left, top, right, bottom [px], (5, 4), infinite behind the camera; `direction` from the fixed camera, unit vectors,
    (5, 3); and the number of `served` targets.
    """

    _features: Mapping[str, tuple[float, float]] = CANDIDATE_FEATURES  # of a slot

    def __init__(
        self,
        kind: str = "person",
        observation: Kind = "tracks",
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
            observation: "tracks", or "images" to include the pictures of both cameras.
            rig: as in `cotarget.env.Follow`.
            calibration: calibration for the pipeline, or its file; the true one by default.
            seconds: length of an episode, at most 20 [s].
            image_size: (width, height) of the pictures, 8 to 4096 each [px].
            noise: noise of the detections.
            served_reward: reward for each served target.
            render_mode: "rgb_array", or None for no `render`.

        Raises:
            ConfigError: an argument is invalid.
        """
        self.kind = one_of("kind", kind, GROUPED)
        super().__init__(observation, rig, calibration, seconds, image_size, noise, render_mode)
        check_scene(self.config.sim, kind, group_paths)
        require(number_in(served_reward, -math.inf, math.inf), "served_reward", served_reward, "a finite number")
        self.target, self._served_reward = self.profile_of(kind), float(served_reward)
        self._rig_space, self._track_space = box(RIG_FEATURES.values()), box(self._features.values(), SLOTS)
        self.action_space = gymnasium.spaces.Discrete(SLOTS)  # type: ignore[assignment]  # its numbers are numpy's
        pictures = {} if observation == "tracks" else self._picture_spaces()
        self.observation_space = gymnasium.spaces.Dict(
            {"tracks": self._track_space, "rig": self._rig_space, **pictures}
        )

    @property
    def times(self) -> tuple[float, float]:
        """Exposure times of the newest frames of the fixed and the zoom camera [s]."""
        return self._step.fixed.t, self._step.zoom.t

    @property
    def candidates(self) -> Sequence[Candidate]:
        """Confirmed tracks, as a policy of the pipeline sees them."""
        return self._selector.candidates

    @property
    def head(self) -> Array:
        """Pan and tilt now, (2,) [rad]."""
        return np.array([self._step.head.pan, self._step.head.tilt])

    @property
    def limits(self) -> PanTiltLimits:
        """Limits of the head."""
        return self.episode.rig.head.limits

    def slot_of(self, number: int | None) -> int:
        """Return the slot of a track; the first slot if it has none."""
        return self._slots.index(number) if number is not None and number in self._slots else 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode: a new one each time, the same one after the same seed."""
        seed = self._begin(seed, options)
        paths = group_paths(self.kind, seed)
        episode, self._selector = self._open(paths, seed), ActionSelector()
        settings = FollowSettings(closed_loop=False)
        self._steps: Iterator[Step] = follow(
            episode.rig,
            self.calibration,
            self.target,
            episode.detector,
            selector=self._selector,
            seconds=math.inf,
            settings=settings,
        )
        self._slots: list[int | None] = [None] * SLOTS
        self._index, self._good_s = 0, dict.fromkeys(paths, 0.0)
        self._turn()
        return self._observe(), self._info(self._good())

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Follow the track of a slot and wait for the next frame of the fixed camera.

        Raises:
            ConfigError: there is no such slot, or no episode.
        """
        self.episode  # noqa: B018  raises if there is none
        require(self.action_space.contains(action), "action", action, f"the number of a slot, 0 to {SLOTS - 1}")
        self._selector.number = self._slots[action]
        before = self._step
        self._index += 1
        self._turn()
        good = self._good()
        reward = self._reward(before, good)
        return self._observe(), reward, False, self._index >= self.frames, self._info(good)

    def _reward(self, before: Step, good: Mapping[str, bool]) -> float:
        """Count the time since the zoom frame of the step before for the good targets; return the reward."""
        passed, reward = self._step.zoom.t - before.zoom.t, 0.0
        before_served = self._served()
        for name, well in good.items():
            self._good_s[name] += passed * well
            reward += passed * well
        return reward + self._served_reward * (self._served() - before_served)

    def _end(self) -> None:
        """Close the episode and its pipeline."""
        super()._end()
        self._steps = iter(())

    def _turn(self) -> None:
        """Run the pipeline for one frame, and update the slots of the tracks."""
        self._step = next(self._steps)
        numbers = [candidate.id for candidate in self.candidates]
        self._slots = [number if number in numbers else None for number in self._slots]
        for number in numbers:
            if number not in self._slots and None in self._slots:
                self._slots[self._slots.index(None)] = number

    def _good(self) -> dict[str, bool]:
        """Whether each target is well in the newest zoom frame."""
        outlines, t = self.episode.outlines, self._step.zoom.t
        return {name: closeup_of(outlines, name, self.target, t).good for name in self._good_s}

    def _served(self) -> int:
        """Number of targets that were well in the close-up for long enough."""
        return sum(map(is_served, self._good_s.values()))

    def _observe(self) -> dict[str, Any]:
        step = self._step
        ages = step.t - step.fixed.t, step.t - step.zoom.t
        numbers = rig_numbers(self.units, step.head, step.lens, step.commanded, ages, self._index / self.frames)
        candidates = {candidate.id: candidate for candidate in self.candidates}
        rows = [self._candidate_numbers(candidates.get(number or 0)) for number in self._slots]
        seen = {"tracks": within(rows, self._track_space), "rig": within(numbers, self._rig_space)}
        return seen if self._observation == "tracks" else {**seen, **self._pictures()}

    def _candidate_numbers(self, candidate: Candidate | None) -> list[float]:
        """Compute the CANDIDATE_FEATURES of a candidate; zeros for an empty slot."""
        if candidate is None:
            return [0.0] * len(self._features)
        followed = self._step.target is not None and self._step.target.id == candidate.id
        (at_pan, at_tilt), shortest_px = candidate.at.tolist(), self.units.focal_px[0]
        pan, tilt, _ = self.units.numbers(at_pan, at_tilt, shortest_px)
        ranges = [high - low for low, high in (self.units.pan, self.units.tilt)]
        rates = [2 * rate / length for rate, length in zip(candidate.rate.tolist(), ranges, strict=True)]
        return [
            1.0,
            float(followed),
            float(candidate.track.missed == 0),
            pan,
            tilt,
            *rates,
            candidate.leaves_in / SECONDS,
            candidate.seen_s / Rounds.look_s,
            float(candidate.reachable),
        ]

    def _info(self, good: dict[str, bool]) -> dict[str, Any]:
        """Collect the ground truth."""
        (t, t_closeup), episode, names = self.times, self.episode, list(good)
        return {
            "t": t,
            "t_closeup": t_closeup,
            "good": np.array(list(good.values())),
            "good_s": np.array(list(self._good_s.values())),
            "box_closeup": np.array([episode.box(name, "zoom", t_closeup) for name in names]),
            "box_wide": np.array([episode.box(name, "fixed", t) for name in names]),
            "direction": np.array([episode.direction(name, t) for name in names]),
            "served": self._served(),
            "action_mask": np.array([number is not None for number in self._slots], dtype=np.int8),
        }
