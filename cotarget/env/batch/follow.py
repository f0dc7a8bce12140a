"""The vector environment."""

import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv

from cotarget.calibration import Calibration
from cotarget.config import RigConfig
from cotarget.control.head import LEAST_SPEED
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
from cotarget.env.batch.appearance import Appearance, Stage
from cotarget.env.batch.motion import JUMP, Plans
from cotarget.env.batch.optics import Closeups, ZoomCameras
from cotarget.env.batch.tracks import Flags, Tracks
from cotarget.env.common import DETECTOR_NOISE, number_in, one_of, require
from cotarget.env.follow_v1 import Action, FollowV1
from cotarget.env.rewards import Reward, closeness, commanded_way, shaped
from cotarget.env.variation import LARGEST_FACTOR, Randomization, Variation
from cotarget.env.version1 import GAMMA
from cotarget.errors import ConfigError
from cotarget.evaluation import TruthNoise, true_calibration
from cotarget.geometry import Array
from cotarget.sim.devices import ROUNDING
from cotarget.sim.targets.random_paths import SECONDS
from cotarget.tracking.track import tracking_settings

PATHS = 256  # paths that are prepared; each takes some 20 ms and 50 kB
PAN_TILT, LENS = slice(0, 2), 2  # axes; that of the lens is in positions
Ints = npt.NDArray[np.intp]


class FollowBatch(VectorEnv[Any, Any, Any]):
    """`cotarget.env.FollowV1` with features, many times.

    All episodes are truncated by themselves after their seconds. With the autoreset mode "SameStep" the next ones begin
    in the same step: the observation is the first of the new episode, and `infos["final_obs"]` has the last of the old
    one where `infos["_final_obs"]` is true. With "NextStep" they begin in the next step, whose actions are ignored and
    whose rewards are 0. `infos["good"]` says whether the newest zoom frame is a good close-up.

    Paths and sizes are drawn from some that are prepared when they are first met; noise, misses and variations are new
    in each episode. The first frame of an episode is not detected.

    Attributes:
        config: the rig.
        target: profile of the target.
        single: a single environment with the same arguments.
        frames: number of steps of an episode.
    """

    def __init__(
        self,
        num_envs: int = 1,
        target: str = "bird",
        action: Action = "rates",
        reward: Reward = "dense",
        observation: str = "tracks",
        gamma: float = GAMMA,
        wear: float = 0.0,
        randomize: Randomization | bool | None = None,
        rig: RigConfig | Path | str | None = None,
        calibration: Calibration | Path | str | None = None,
        seconds: float = SECONDS,
        noise: TruthNoise = DETECTOR_NOISE,
        paths: int = PATHS,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
    ) -> None:
        """Create the environments.

        Args:
            num_envs: number of environments.
            target: as in `FollowV1`, as are those not named here.
            action: "absolute", "rates" or "residual".
            reward: "yield", "dense" or "shaped".
            observation: "tracks"; a batch renders nothing.
            gamma: discount of the learner, for the reward "shaped".
            wear: cost of a unit of commanded motion.
            randomize: ranges of what differs between episodes; paths are shifted when they are prepared.
            rig: a simulated rig or its rig.toml.
            calibration: calibration that features use, or its file; the true one by default.
            seconds: length of an episode, at most 20 [s].
            noise: noise of the detections.
            paths: number of paths that are prepared.
            autoreset_mode: gymnasium's "SameStep" or "NextStep".
            render_mode: None.

        Raises:
            ConfigError: an argument is invalid.
        """
        for name, value in (("num_envs", num_envs), ("paths", paths)):
            whole = isinstance(value, int) and number_in(value, 0, math.inf)
            require(whole, name, value, "a whole number from 1 on")
        modes = {mode.value: mode for mode in (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP)}
        mode = autoreset_mode.value if isinstance(autoreset_mode, AutoresetMode) else autoreset_mode
        self._autoreset = modes[one_of("autoreset_mode", mode, modes)]
        if observation != "tracks" or render_mode is not None:
            raise ConfigError("observation: a batch has observation='tracks' alone, and no render_mode")
        # The single environment checks the arguments.
        self.single = FollowV1(
            target, action, reward, "tracks", gamma, wear, randomize, rig, calibration, seconds, noise=noise
        )
        self.num_envs, self._noise, self.frames = num_envs, noise, self.single.frames
        self.config, self.target = self.single.config, self.single.target
        self.single_action_space, self.single_observation_space = (
            self.single.action_space,
            self.single.observation_space,
        )
        batch_space = gymnasium.vector.utils.batch_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.render_mode = None
        self.metadata = {
            "autoreset_mode": self._autoreset,
            "render_modes": [],
            "render_fps": self.config.sim.fixed.rate_hz,
        }
        self._open(float(seconds), paths)

    def _open(self, seconds: float, paths: int) -> None:
        """Prepare what all episodes share."""
        target, count = self.target, self.num_envs
        self._stage = Stage(self.config, self.single.name, seconds, target)
        world, rig = self._stage.world, self._stage.world.rig
        self._interval, self._limits, self._drive = 1 / rig.spec.fixed.rate_hz, rig.head.limits, world.lens_drive
        true = true_calibration(world)
        calibration = true if self.single.given_calibration is None else self.single.given_calibration
        calibration = calibration.for_streams(rig.fixed.size, rig.zoom.size)
        self._solver, self._scales = AimSolver(calibration, target, rig.zoom.focal_range), calibration.zoom_head.axes
        self._zoom = ZoomCameras(world, true.zoom_head, target)
        self._set_axes()
        sim, effects = self.config.sim, self.config.sim.effects
        self._latencies = [
            max(camera.latency_s if effects.latency else 0.0, camera.exposure_s / 2 if effects.blur else 0.0)
            for camera in (sim.fixed, sim.zoom)
        ]
        self._delay_s = rig.spec.head.delay_s
        settings, over_beat = tracking_settings(target).scaled(rig.fixed.size[0]), target.largest_over_time
        self._tracks = Tracks(count, settings, rig.fixed.size, self._interval, over_beat=over_beat)
        self._extent = np.array(rig.fixed.size)[:, None] - 0.5
        self._prepared: Appearance | None = None  # arrays over the paths
        self._ready, self._seeds = np.zeros(paths, bool), np.zeros(paths, int)
        self._path, self._k, self._zoom_k = np.zeros((3, count), int)
        names = ("delay", "noise", "lens", "pan_deg", "tilt_deg", "focal")
        self._varied = {name: np.full(count, getattr(Variation(), name)) for name in names}
        self._potential = np.zeros(count)

    def _set_axes(self) -> None:
        """Collect the limits of pan, tilt and lens, and put all axes at rest."""
        drive, axes, count = self._drive, self._limits.axes, self.num_envs
        ends = [axis.outermost() for axis in axes] + [(0.0, float(drive.last))]
        self._low, self._high = np.array(ends).T[:, :, None]
        self._ranges = np.array([self.single.units.pan, self.single.units.tilt]).T[:, :, None]
        self._step = np.array([axis.step for axis in axes] + [float(drive.stepping)])[:, None]
        self._divisor = np.where(self._step > 0, self._step, 1.0)
        speeds = np.array([axis.speed for axis in axes] + [drive.axis.speed])[:, None]
        self._jumps = np.isinf(speeds)
        self._speed = np.where(self._jumps, JUMP, speeds) * np.ones(count)
        self._lens_speed = self._speed[LENS].copy()
        self._acceleration = np.array([axis.assumed_acceleration for axis in axes])[:, None]
        rises = np.vstack([self._acceleration, [[math.inf]]])
        self._rises = np.where(np.isinf(rises), self._speed**2, rises)
        self._ahead = ahead_s(self._limits, self._interval)
        self._log_focal = math.log(drive.shortest_px)
        self._log_step = math.log(drive.longest_px / drive.shortest_px) / drive.last
        head, effects = self.config.sim.head, self.config.sim.effects
        self._play = math.radians(head.backlash_deg) / 2 if effects.backlash else 0.0
        self._driven, self._half_width = np.zeros((2, count)), np.zeros(count)
        # The last command, its focal length as a logarithm; and that before rounding to positions.
        self._commanded, self._focal = np.zeros((3, count)), np.full(count, self._log_focal)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in each environment.

        Args:
            seed: one seed for all environments together.
            options: values of these episodes, as in `FollowV1`, but for shifts of the path.

        Raises:
            ConfigError: an option is unknown, or several seeds are given.
        """
        require(seed is None or isinstance(seed, int), "seed", seed, "one whole number for all environments")
        super().reset(seed=seed if isinstance(seed, int) else None)
        if seed is not None or not self._seeds.any():
            self._ready[:] = False
            self._seeds = self.np_random.integers(1, 2**31, size=len(self._seeds))
        slowest = LARGEST_FACTOR if options else 1.0 + (self.single.randomize.delay if self.single.randomize else 0.0)
        in_flight_s = slowest * (max(self._latencies) + self._delay_s) + 1 / self.config.sim.zoom.rate_hz
        self._plans = Plans(math.ceil(in_flight_s / self._interval) + 3, self._rises, np.zeros((3, self.num_envs)))
        self._features = np.zeros((self.num_envs, len(TASK_FEATURES)), np.float32)
        good = self._begin(np.arange(self.num_envs), options)
        return self._features.copy(), self._infos(good)

    def step(self, actions: Numbers) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Command heads and lenses, and go to the next frame of the fixed cameras.

        Raises:
            ResetNeeded: there was no reset.
            ConfigError: the actions are not three finite numbers for each environment.
        """
        if self._prepared is None:
            raise gymnasium.error.ResetNeeded("there is no episode: call reset() first")
        try:
            given = np.asarray(actions, dtype=float)
        except (TypeError, ValueError):
            given = np.empty(0)
        fits = given.shape == (self.num_envs, 3) and bool(np.isfinite(given).all())
        require(fits, "actions", actions, f"three finite numbers for each of {self.num_envs} environments")
        if self._k[0] >= self.frames:  # all episodes are as long
            good = self._begin(np.arange(self.num_envs))
            return (
                self._features.copy(),
                np.zeros(self.num_envs),
                *np.zeros((2, self.num_envs), bool),
                self._infos(good),
            )
        self._command(given, self._now() + self._varied["delay"] * self._delay_s)
        self._k += 1
        now, zoom_before = self._now(), self._zoom_k
        self._zoom_k = self._zoom_frame(now)
        shown, present = self._plans.at(np.stack([self._zoom_k / self.config.sim.zoom.rate_hz, now]))
        self._driven = np.clip(self._driven, shown[PAN_TILT] - self._play, shown[PAN_TILT] + self._play)
        self._detect()
        seen = self._closeups(self._driven, shown[LENS], slice(None))
        reward = self._rewards(seen, self._zoom_k > zoom_before)
        if self.single.wear:
            reward = reward - self._worn
        self._features = self._observe(now, present[LENS])
        truncated = self._k >= self.frames
        infos = self._infos(seen.good)
        if truncated.any() and self._autoreset is AutoresetMode.SAME_STEP:
            infos |= {"final_obs": self._features.copy(), "_final_obs": truncated}
            self._begin(np.flatnonzero(truncated))
        return self._features.copy(), reward, np.zeros(self.num_envs, bool), truncated, infos

    def _infos(self, good: Flags) -> dict[str, Any]:
        """Infos of all environments."""
        return {"good": good, "_good": np.ones(self.num_envs, bool)}

    def _now(self) -> Array:
        """Times at which the newest fixed frames have come [s], (n,)."""
        return self._k * self._interval + self._late(0)

    def _late(self, camera: int) -> Array:
        """Latencies of the fixed (0) or the zoom cameras (1) [s], (n,)."""
        return self._varied["delay"] * self._latencies[camera]

    def _zoom_frame(self, now: Array) -> Ints:
        """Numbers of the newest zoom frames, (n,)."""
        frames = np.floor((now - self._late(1)) * self.config.sim.zoom.rate_hz + ROUNDING)
        return np.maximum(frames, 0.0).astype(int)

    def _begin(self, which: Ints, options: object = None) -> Flags:
        """Begin episodes in some environments; return whether their first zoom frames are good."""
        draw, rng = self.single.randomize, self.np_random
        if draw is not None or options is not None:
            for i in which.tolist():
                variation = (Variation() if draw is None else draw.draw(rng)).with_options(options)
                for name, values in self._varied.items():
                    values[i] = getattr(variation, name)
            self._speed[LENS] = self._varied["lens"] * self._lens_speed
            self._rises[LENS] = self._speed[LENS] ** 2
        self._path[which] = rng.integers(len(self._ready), size=len(which))
        for path in np.unique(self._path[which]).tolist():
            if not self._ready[path]:
                self._prepare(path)
        self._k[which] = 0
        self._zoom_k[which] = self._zoom_frame(self._now())[which]
        at_rest = np.zeros((3, self.num_envs))
        self._plans.restart(which, at_rest)
        self._tracks.end(np.isin(np.arange(self.num_envs), which))
        self._driven[:, which] = 0.0
        self._commanded[PAN_TILT, which] = 0.0
        self._focal[which] = self._commanded[LENS, which] = self._log_focal
        self._features[which] = 0.0  # there is no track, and nothing moves
        shortest = np.full(len(which), self._log_focal)
        self._half_width[which] = self._solver.half_width(shortest) / self._varied["focal"][which]
        seen = self._closeups(at_rest[PAN_TILT, which], at_rest[LENS, which], which)
        self._potential[which] = closeness(seen.off, seen.size_ratio)
        return seen.good

    def _prepare(self, path: int) -> None:
        """Draw a path and a size, and prepare what the cameras see of them."""
        seed = int(self._seeds[path])
        way = self.single.path(seed)
        if self.single.randomize is not None:
            way = self.single.randomize.draw(self.np_random).shifted(way)
        found = self._stage.appearance(way, seed)
        if self._prepared is None:
            self._prepared = Appearance(*(np.zeros((len(self._ready), *part.shape)) for part in found))
        for every, part in zip(self._prepared, found, strict=True):
            every[path] = part
        self._ready[path] = True

    def _command(self, action: Array, effect_t: Array) -> None:
        """Command heads and lenses; as `FollowV1` and `cotarget.control.head.HeadController.turn` do."""
        x, v = motion = self._plans.newest(effect_t)
        goal, speed = np.empty_like(x), np.array(self._speed)
        if self.single.action == "absolute":
            part = (np.clip(action.T, -1.0, 1.0) + 1) / 2
            (low, high), focal = self._ranges, self._log_focal + part[LENS] * self._log_step * self._drive.last
            goal[PAN_TILT] = low + part[PAN_TILT] * (high - low)
        else:
            rates = moved_aim(self._features, action) if self.single.action == "residual" else action
            focal = zoomed(rates, self._focal, self._drive.shortest_px, self._drive.longest_px)
            wanted = rates_of(rates, self._half_width, self._interval)
            turns = np.clip(wanted, -speed[PAN_TILT], speed[PAN_TILT])
            turns = np.where(wanted == 0, v[PAN_TILT], turns)
            brakes = turns * np.abs(turns) / (2 * self._acceleration)
            goal[PAN_TILT] = x[PAN_TILT] + np.where(wanted == 0, 0.0, turns * self._ahead) + brakes
            speed[PAN_TILT] = np.where(self._jumps[PAN_TILT], JUMP, np.maximum(np.abs(turns), LEAST_SPEED))
        self._focal = focal
        goal[LENS] = (focal - self._log_focal) / self._log_step
        goal = np.clip(goal, self._low, self._high)
        goal = np.where(self._step > 0, np.rint(goal / self._divisor) * self._step, goal)
        before, self._commanded = self._commanded, goal.copy()
        self._commanded[LENS] = self._log_focal + goal[LENS] * self._log_step
        if self.single.wear:
            self._worn = self.single.wear * commanded_way(before, self._commanded, self.config.sim.zoom.size[0])
        self._plans.command(effect_t, motion, goal, speed)

    def _detect(self) -> None:
        """Detect the targets as `cotarget.evaluation.TruthDetector` does, and track them."""
        assert self._prepared is not None
        noise, factor, rng = self._noise, self._varied["noise"], self.np_random
        box = self._prepared.box[self._path, self._k].T  # left, top, right, bottom
        low, high = np.maximum(box[:2], -0.5), np.minimum(box[2:], self._extent)
        shift, scale = rng.standard_normal((2, 2, self.num_envs))
        size = (high - low) * np.maximum(1 + factor * noise.size * scale, 0.1)
        with np.errstate(invalid="ignore"):  # behind the camera
            clipped: Flags = np.any((low > box[:2]) | (high < box[2:]), axis=0)
            detected: Flags = (size.min(axis=0) > 0) & (size.max(axis=0) >= noise.smallest_px)
        detected &= rng.random(self.num_envs) >= factor * noise.miss
        center = (low + high) / 2 + factor * noise.center_px * shift
        self._tracks.update(np.where(detected, center, 0.0), np.where(detected, size, 1.0), clipped, detected)

    def _closeups(self, pan_tilt: Array, position: Array, which: Ints | slice) -> Closeups:
        """Judge the newest zoom frames of some environments."""
        assert self._prepared is not None
        frame = self._path[which], self._zoom_k[which]
        _, x_base, extent, size = self._prepared
        return self._zoom.closeups(pan_tilt, position, x_base[frame], extent[frame], size[frame])

    def _rewards(self, seen: Closeups, is_new: Flags) -> Array:
        """Rewards of a step, (n,)."""
        before, self._potential = self._potential, closeness(seen.off, seen.size_ratio)
        if self.single.reward == "dense":
            return self._potential.copy()
        earned = (seen.good & is_new).astype(float)
        return earned if self.single.reward == "yield" else shaped(earned, self.single.gamma, before, self._potential)

    def _observe(self, now: Array, position: Array) -> Numbers:
        """Compute the features of the task.

        Args:
            now: time [s], (n,).
            position: positions of the lenses, (n,).
        """
        tracks, varied = self._tracks, self._varied
        x, v = self._plans.newest(now + varied["delay"] * self._delay_s)
        focal = self._log_focal + position * self._log_step
        self._half_width = self._solver.half_width(focal) / varied["focal"]
        lead = self._late(0) + varied["delay"] * self._delay_s + self._interval * np.array([[0.0], [1.0]])
        pixel = tracks.center_px[:, None] + tracks.velocity_px[:, None] * lead
        size = tracks.size_px()
        length = self._solver.length_px(size, size[0])
        aim = self._solver.solve(pixel, length, tracks.center_px[:, None])
        aim[0] -= np.radians(varied["pan_deg"]) / self._scales.pan_scale
        aim[1] -= np.radians(varied["tilt_deg"]) / self._scales.tilt_scale
        aim[2] -= np.log(varied["focal"])
        low, high = self._ranges
        command = np.empty_like(aim[:, 0])
        command[PAN_TILT] = 2 * (aim[PAN_TILT, 0] - low) / (high - low) - 1
        command[LENS] = 2 * (aim[LENS, 0] - self._log_focal) / (self._log_step * self._drive.last) - 1
        there = Situation(x[PAN_TILT], v[PAN_TILT], self._commanded[LENS], focal, self._half_width, self._interval)
        known = tracks.confirmed.astype(float)
        return task_features(aim[:, 0], aim[:, 1], command, known, tracks.unseen_s, there)
