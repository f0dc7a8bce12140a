"""What both environments share: the rig, an episode's world, its frames and their pictures."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import gymnasium
import numpy as np
import numpy.typing as npt

from cotarget.calibration import Calibration
from cotarget.config import DEFAULT_TARGETS, RigConfig, TargetConfig
from cotarget.env.arguments import calibration_of, check_options, name_of, noise_of, rig_of, seconds_of, size_of
from cotarget.env.units import Units
from cotarget.geometry import Array
from cotarget.oracle import TruthDetector, TruthNoise, counted, true_calibration
from cotarget.sim.appearances import CameraName
from cotarget.sim.model import has_clutter
from cotarget.sim.outlines import Outlines
from cotarget.sim.pictures import Pictures
from cotarget.sim.world import SimWorld
from cotarget.simconfig import Size, Waypoint

Picture = npt.NDArray[np.uint8]
Observation = TypeVar("Observation")
Action = TypeVar("Action")
Kind = Literal["tracks", "images"]

KINDS: tuple[Kind, ...] = ("tracks", "images")
IMAGE_SIZE: Size = (64, 64)
DETECTOR_NOISE = TruthNoise()
RENDER_SIZE: Size = (320, 240)  # of each of the two pictures that `render` puts side by side [px]


class Episode:
    """A world from one reset to the next."""

    def __init__(self, config: RigConfig, noise: TruthNoise) -> None:
        """Build it.

        Args:
            config: the rig, and who is in its world.
            noise: of the detections.
        """
        self.config = config
        self.world = SimWorld(config, rendered=())
        self.rig, self.truth = self.world.rig, self.world.truth()
        self.outlines = Outlines(self.truth, still=not has_clutter(config.sim))
        self.detector = TruthDetector(self.outlines, config.sim.seed, noise, numbers=counted)
        fixed = self.truth.T_world_fixed
        self._eye, self._to_fixed = fixed.translation, fixed.rotation.as_matrix().T

    def direction(self, name: str, t: float) -> Array:
        """Where a target's middle truly is from the wide camera, in its frame, a unit vector, (3,)."""
        way = self._to_fixed @ (self.outlines.center(name, t) - self._eye)
        return way / math.sqrt(way @ way)


class RigEnv(gymnasium.Env[Observation, Action], Generic[Observation, Action]):
    """An environment on the simulated rig; see `Follow` and `Schedule`.

    Attributes:
        config: the rig; its targets and seed are an episode's.
        units: what actions and observations of the rig stand for.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012  as gymnasium has it

    def __init__(
        self,
        observation: Kind,
        rig: RigConfig | Path | str | None,
        calibration: Calibration | Path | str | None,
        seconds: float,
        image_size: Size,
        noise: TruthNoise,
        render_mode: str | None,
    ) -> None:
        """Check what all have in common.

        Raises:
            ConfigError: an argument makes no sense.
        """
        name_of("observation", observation, KINDS)
        if render_mode is not None:
            name_of("render_mode", render_mode, self.metadata["render_modes"])
        self.config = rig_of(rig)
        self.units = Units.of(self.config)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.config.rate_hz}
        self._calibration, self._noise = calibration_of(calibration), noise_of(noise)
        self._observation, self._size = observation, size_of(image_size)
        self._last = max(round(seconds_of(seconds) * self.config.rate_hz), 1)
        self._episode: Episode | None = None
        self._opened: dict[Size, Pictures] = {}  # of the episode

    @property
    def episode(self) -> Episode:
        """The one that runs.

        Raises:
            ResetNeeded: there is none.
        """
        if self._episode is None:
            raise gymnasium.error.ResetNeeded("there is no episode: call reset() first, and again after close()")
        return self._episode

    @property
    def calibration(self) -> Calibration:
        """The one given, or that which is exactly true of the episode's rig."""
        return true_calibration(self.episode.world) if self._calibration is None else self._calibration

    @property
    def times(self) -> tuple[float, float]:
        """When the newest frame of the wide camera was exposed, and of the zoom camera [s]."""
        raise NotImplementedError

    def told_of(self, name: str) -> TargetConfig:
        """What the pipeline is told of a target, whose detections are the truth with noise whatever its detector is."""
        return replace(self.config.target(name), detector=DEFAULT_TARGETS[name].detector)

    def render(self) -> Picture | None:
        """Both views side by side, RGB, where the render mode is "rgb_array"."""
        if self.render_mode is None:
            return None
        return np.hstack(self._look(RENDER_SIZE))

    def close(self) -> None:
        """Release everything; more than once does no harm."""
        for pictures in self._opened.values():
            pictures.close()
        self._opened.clear()
        self._end()

    def _begin(self, seed: int | None, options: Mapping[str, Any] | None) -> int:
        """End the episode before; the seed of the next one's world.

        Raises:
            ConfigError: options are given; there are none.
        """
        check_options(options)
        super().reset(seed=seed)
        return int(self.np_random.integers(2**31))

    def _open(self, paths: Mapping[str, tuple[Waypoint, ...]], seed: int) -> Episode:
        """Begin an episode with targets on these paths, drawn by what drew the one before."""
        self._end()
        sim = replace(self.config.sim, seed=seed, targets=tuple(paths), paths=paths)
        self._episode = Episode(replace(self.config, sim=sim), self._noise)
        for size, before in self._opened.items():
            self._opened[size] = self._episode.world.pictures(size, before)
        return self._episode

    def _end(self) -> None:
        """Let go of the episode, if there is one."""
        if self._episode is not None:
            self._episode.rig.close()
            self._episode = None

    def _picture_spaces(self) -> dict[str, gymnasium.Space[Any]]:
        """Of the pictures in an observation."""
        width, height = self._size
        return {name: gymnasium.spaces.Box(0, 255, (height, width, 3), np.uint8) for name in ("wide", "closeup")}

    def _pictures(self) -> dict[str, Picture]:
        """The newest, for an observation."""
        return dict(zip(("wide", "closeup"), self._look(self._size), strict=True))

    def _look(self, size: Size) -> list[Picture]:
        """Through the wide camera and through the zoom camera, RGB."""
        episode = self.episode
        if size not in self._opened:
            self._opened[size] = episode.world.pictures(size)
        pictures = self._opened[size]
        names: tuple[CameraName, ...] = ("fixed", "zoom")
        images = [pictures.take(name, t) for name, t in zip(names, self.times, strict=True)]
        return [np.ascontiguousarray(image[:, :, ::-1]) for image in images]


def corners(box: tuple[Array, Array] | None) -> Array:
    """Left, top, right and bottom of a box [px], (4,); at infinity where there is none."""
    return np.full(4, np.inf) if box is None else np.concatenate(box)
