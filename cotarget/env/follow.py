"""`cotarget/Follow-v0`: hold a target in the close-up, by commands of pan, tilt and focal length."""

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import RigConfig, Waypoint
from cotarget.env.common import (
    DETECTOR_NOISE,
    IMAGE_SIZE,
    LONGEST_AGE_S,
    RIG_FEATURES,
    Command,
    Kind,
    RigEnv,
    Vector,
    box,
    check_scene,
    one_of,
    rig_numbers,
    within,
)
from cotarget.evaluation import TruthNoise, closeup_of
from cotarget.metrics import Closeup
from cotarget.rig import Frame, Rig
from cotarget.schema import Size
from cotarget.sim.targets.random_paths import LONE, SECONDS, lone_path
from cotarget.tracking.track import tracking_settings
from cotarget.tracking.tracker import Tracker

# Features of the target's track, with the range of each; 0 without a track.
TRACK_FEATURES = {
    "known": (0.0, 1.0),  # whether there is a confirmed track
    "detected": (0.0, 1.0),  # whether the newest frame detected it
    "confidence": (0.0, 1.0),  # 1 / (1 + (s / d)^2): s the centre's standard deviation, d the larger side
    "u": (-1.0, 1.0),  # centre, from the left to the right edge of the fixed image
    "v": (-1.0, 1.0),  # from the top to the bottom
    "du": (-4.0, 4.0),  # rate of that [1/s]
    "dv": (-4.0, 4.0),
    "width": (0.0, 1.0),  # width of its box, as a part of the image's
    "height": (0.0, 1.0),
    "larger_side": (0.0, 1.0),  # larger side over the last wing beat, as a part of the image's width
    "unseen_s": (0.0, LONGEST_AGE_S),  # time since the last detection
}


class Follow(RigEnv[Any, Vector]):
    """Hold a target in the close-up.

    A step is a frame of the fixed camera. The world, the target's path and size, and the noise follow from the
    episode's seed. An episode is truncated after its seconds.

    Action: `Box(-1, 1, (3,))`, pan and tilt within the head's limits, and the focal length within the lens's range,
    even in its logarithm. Head and lens go there as fast as they can, after the rig's delay.

    Observation: with "tracks" a `Box` of TRACK_FEATURES and then RIG_FEATURES, from detections that are the ground
    truth with a detector's noise; with "images" a `Dict` of the pictures `wide` and `closeup`, RGB, and `rig`, the
    RIG_FEATURES.

    Reward: 1 for a step whose new zoom frame is a good close-up (`cotarget.metrics.Closeup.good`): the whole target is
    visible at 0.8 to 1.25 of the wanted size; else 0. Actions take effect after the rig's delays.

    `info` alone holds ground truth, of that zoom frame unless said otherwise: `t` and `t_closeup`, exposure times of
    the newest frames [s]; `good`; `in_frame`; `offset_px`, distance of the target from the picture's centre, or half
    the diagonal (400 px of 640x480) if it is not inside; `size_ratio`, size over the wanted size; `center_px`;
    `box_closeup` and, of the fixed frame, `box_wide`, as left, top, right, bottom [px]; `direction` from the fixed
    camera, in its own axes, a unit vector. Behind a camera, positions are infinite and the size ratio is 0.
    """

    wide: Frame  # newest frame of the fixed camera
    closeup: Frame  # newest frame of the zoom camera

    def __init__(
        self,
        target: str = "bird",
        observation: Kind = "tracks",
        rig: RigConfig | Path | str | None = None,
        calibration: Calibration | Path | str | None = None,
        seconds: float = SECONDS,
        image_size: Size = IMAGE_SIZE,
        noise: TruthNoise = DETECTOR_NOISE,
        render_mode: str | None = None,
    ) -> None:
        """Create the environment; its world is made at the first reset.

        Args:
            target: book, person or bird.
            observation: "tracks" or "images".
            rig: a simulated rig or its rig.toml; by default the default rig without noise, JPEG, distortion, blur and
                antialiasing. Its `[sim]` counts except targets, models, paths and seed; of its `[targets]`, the one of
                this name except its detector; of its `[safety]`, the ranges of pan and tilt. The targets' paths are
                made for the outdoor scene; a scene in which less than half of them is visible is refused.
            calibration: calibration that a policy may use, or its file; the true one by default.
            seconds: length of an episode, at most 20 [s].
            image_size: (width, height) of the pictures, 8 to 4096 each [px].
            noise: noise of the detections.
            render_mode: "rgb_array", or None for no `render`.

        Raises:
            ConfigError: an argument is invalid.
        """
        super().__init__(observation, rig, calibration, seconds, image_size, noise, render_mode)
        self.name = one_of("target", target, self._targets())
        if target in LONE and target not in self._own_paths():
            check_scene(self.config.sim, target, lone_path)
        self.target = self.profile_of(target)
        self._rig_space = box(RIG_FEATURES.values())
        self._track_space = box([*TRACK_FEATURES.values(), *RIG_FEATURES.values()])
        self.action_space = box([(-1.0, 1.0)] * 3)  # type: ignore[assignment]
        self.observation_space = self._space()

    def _space(self) -> gymnasium.Space[Any]:
        """Space of the observations."""
        if self._observation == "tracks":
            return self._track_space
        return gymnasium.spaces.Dict({**self._picture_spaces(), "rig": self._rig_space})

    def _own_paths(self) -> Mapping[str, tuple[Waypoint, ...]]:
        """Paths of the rig's configuration that count."""
        return {}

    def _targets(self) -> Collection[str]:
        """Names of the targets that can be followed."""
        return LONE

    @property
    def times(self) -> tuple[float, float]:
        """Exposure times of the newest frames of the fixed and the zoom camera [s]."""
        return self.wide.t, self.closeup.t

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode: a new one each time, the same one after the same seed."""
        seed = self._begin(seed, options)
        self._start(self._open(self._path(seed), seed).rig)
        self._detect()
        judged = self._judge()
        return self._observe(), self._info(judged)

    def step(self, action: Vector) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Command head and lens, and wait for the next frame of the fixed camera."""
        rig = self.episode.rig
        self._commanded = self._command(action)
        before = self.closeup.t
        self.wide, self.closeup = rig.fixed.read(newer_than=self.wide.t), rig.zoom.read()
        self._index += 1
        self._detect()
        judged = self._judge()
        reward = self._reward(judged, self.closeup.t > before)
        return self._observe(), reward, False, self._index >= self.frames, self._info(judged)

    def _start(self, rig: Rig) -> None:
        """Start tracking and read the first frames of an episode's rig."""
        self._tracker = Tracker(tracking_settings(self.target), rig.fixed.size)
        self._index = 0
        state = rig.head.state()
        self._commanded = state.pan, state.tilt, rig.zoom.state().focal_px
        self.wide = rig.fixed.read()
        self.closeup = rig.zoom.read()

    def _path(self, seed: int) -> Mapping[str, tuple[Waypoint, ...]]:
        """Draw the target's path, by its name."""
        return lone_path(self.name, seed)

    def _command(self, action: Vector) -> Command:
        """Command head and lens; return what was commanded after rounding to steps."""
        rig, (pan, tilt, focal_px) = self.episode.rig, self.units.command(action)
        return *rig.head.move(pan, tilt), rig.zoom.zoom(focal_px)

    def _reward(self, judged: Closeup, is_new: bool) -> float:
        """Reward of a step by the newest zoom frame, which may be that of the step before."""
        return float(judged.good and is_new)

    def _detect(self) -> None:
        """Detect and track in the newest frame of the fixed camera."""
        self.detections = self.episode.detector.detect(self.wide)
        tracks = self._tracker.update(self.detections.boxes, self.wide.t)
        self._track = tracks[0] if tracks and tracks[0].confirmed else None

    def _judge(self) -> Closeup:
        """Ground truth of the target in the newest zoom frame."""
        return closeup_of(self.episode.outlines, self.name, self.target, self.closeup.t)

    def _observe(self) -> Any:
        rig = self.episode.rig
        now = rig.clock.now()
        ages = now - self.wide.t, now - self.closeup.t
        numbers = rig_numbers(
            self.units, rig.head.state(), rig.zoom.state(), self._commanded, ages, self._index / self.frames
        )
        if self._observation != "tracks":
            return {**self._pictures(), "rig": within(numbers, self._rig_space)}
        return within([*self._track_numbers(), *numbers], self._track_space)

    def _track_numbers(self) -> list[float]:
        """Compute the TRACK_FEATURES; zeros without a track."""
        track = self._track
        if track is None:
            return [0.0] * len(TRACK_FEATURES)
        width, height = self.config.sim.fixed.size
        (u, v), (du, dv), (across, down) = (a.tolist() for a in (track.center_px, track.velocity_px, track.size_px))
        variance = float(track.covariance[0, 0] + track.covariance[1, 1])
        return [
            1.0,
            float(track.missed == 0),
            1 / (1 + variance / max(track.larger_side_px, 1.0) ** 2),
            (2 * u + 1) / width - 1,
            (2 * v + 1) / height - 1,
            2 * du / width,
            2 * dv / height,
            across / width,
            down / height,
            track.larger_side_px / width,
            track.missed / self.config.sim.fixed.rate_hz,
        ]

    def _info(self, judged: Closeup) -> dict[str, Any]:
        """Collect the ground truth."""
        t, t_closeup = self.times
        return {
            "t": t,
            "t_closeup": t_closeup,
            "good": judged.good,
            "in_frame": judged.in_frame,
            "offset_px": judged.tpo_px,
            "size_ratio": judged.size_ratio,
            "center_px": np.full(2, np.inf) if math.isnan(judged.u_px) else np.array([judged.u_px, judged.v_px]),
            "box_closeup": self.episode.box(self.name, "zoom", t_closeup),
            "box_wide": self.episode.box(self.name, "fixed", t),
            "direction": self.episode.direction(self.name, t),
        }
