"""Base of both environments: checked arguments, units of actions, the episode's world, and its pictures."""

import math
import reprlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import gymnasium
import numpy as np
import numpy.typing as npt

from cotarget.backends import check, describe, load_config
from cotarget.calibration import Calibration
from cotarget.config import (
    DEFAULT_TARGETS,
    RigConfig,
    SimConfig,
    SimEffects,
    TargetProfile,
    Waypoint,
    check_config,
)
from cotarget.errors import ConfigError, choices
from cotarget.evaluation import TruthDetector, TruthNoise, true_calibration
from cotarget.geometry import Array
from cotarget.rig import READ_TIMEOUT_S, PanTiltState, ZoomState
from cotarget.schema import Size
from cotarget.sim.render.pictures import SizedPictures
from cotarget.sim.targets.random_paths import SECONDS, in_view
from cotarget.sim.truth import CameraName, Outlines, part_seen
from cotarget.sim.world import SimWorld

# Least and largest side of a picture: fewer pixels show nothing, and one picture of the largest size takes 50 MB.
SMALLEST_PX, LARGEST_PX = 8, 4096
# Check of a scene: seeds of the episodes tried, least part of their paths that is visible, and every how many knots.
TRIED_SEEDS, LEAST_SEEN, EVERY_KNOT = range(3), 0.5, 5
# Default rig of the environments: the default one without the effects that make pictures costly.
DEFAULT_RIG = RigConfig(
    sim=SimConfig(effects=SimEffects(noise=False, jpeg=False, distortion=False, blur=False, multisampling=False))
)


def require(ok: bool, what: str, given: object, wanted: str) -> None:
    """Refuse an argument in one line unless it is what is wanted.

    Raises:
        ConfigError: it is not.
    """
    if not ok:
        raise ConfigError(f"{what}: {' '.join(reprlib.repr(given).split())} is not {wanted}")


def one_of(what: str, given: str, known: Collection[str]) -> str:
    """Check that a name is a known one.

    Raises:
        ConfigError: it is unknown.
    """
    require(isinstance(given, str) and given in known, what, given, f"one of: {choices(known)}")
    return given


def number_in(given: object, low: float, high: float) -> bool:
    """Whether an argument is a finite number above the lowest and up to the highest value."""
    return isinstance(given, Real) and low < float(given) <= high and math.isfinite(given)


def rig_of(given: RigConfig | Path | str | None) -> RigConfig:
    """Resolve a simulated rig: a configuration, its rig.toml, or None for the default one.

    The soft limits become those of its head.

    Raises:
        ConfigError: it is no rig, not simulated, impossible, or too slow.
    """
    if isinstance(given, Path | str):
        given = load_config(Path(given))
    config = DEFAULT_RIG if given is None else given
    require(isinstance(config, RigConfig), "rig", given, "a cotarget.config.RigConfig or the path of a rig.toml")
    if config.backend != "sim":
        raise ConfigError(f"rig: its backend is '{config.backend}'; environments are on 'sim' alone")
    if given is not None:
        check_config(config)  # a configuration made in Python was not checked yet
        check(config)
        _check_waits(config.sim)
    describe(config)  # refuses soft limits that leave nothing
    head, soft = config.sim.head, config.safety
    head = replace(head, pan_deg=_both(head.pan_deg, soft.pan_deg), tilt_deg=_both(head.tilt_deg, soft.tilt_deg))
    return replace(config, sim=replace(config.sim, head=head))


def _both(own: tuple[float, float], soft: tuple[float, float] | None) -> tuple[float, float]:
    """Intersect two ranges."""
    return own if soft is None else (max(own[0], soft[0]), min(own[1], soft[1]))


def _check_waits(sim: SimConfig) -> None:
    """Refuse cameras whose frames take longer than the pipeline waits."""
    waits_s = {"fixed.rate_hz": 1 / sim.fixed.rate_hz}
    if sim.effects.latency:
        waits_s |= {"fixed.latency_s": sim.fixed.latency_s, "zoom.latency_s": sim.zoom.latency_s}
    for name, wait_s in waits_s.items():
        if wait_s > READ_TIMEOUT_S:
            raise ConfigError(
                f"rig: sim.{name}: makes a frame {wait_s:g} s late; the pipeline waits for {READ_TIMEOUT_S:g} s"
            )


def check_scene(sim: SimConfig, name: str, paths: Callable[[str, int], Mapping[str, Sequence[Waypoint]]]) -> None:
    """Refuse a scene that hides most of the targets' paths, which are made for the outdoor scene.

    Args:
        sim: simulation with the scene.
        name: name of the target.
        paths: gives the paths of an episode by name and seed.

    Raises:
        ConfigError: less than half of the paths is visible.
    """
    if sim.scene == SimConfig.scene:
        return
    ways = [way[::EVERY_KNOT] for seed in TRIED_SEEDS for way in paths(name, seed).values()]
    places = np.array([x for way in ways for t, *x in way if 0 <= t <= SECONDS])
    seen = part_seen(sim, places[in_view(places)])
    if seen < LEAST_SEEN:
        raise ConfigError(
            f"rig: in the scene '{sim.scene}' {seen:.0%} of a {name}'s paths can be seen; they are made for "
            f"'{SimConfig.scene}': fixed_mount at (0, 0, 1.6), looking along +y and 9 degrees up, over open ground"
        )


# Commands and states as numbers from -1 to 1

Vector = npt.NDArray[np.float32]
Command = tuple[float, float, float]  # pan and tilt [rad], nominal focal length [px]
LONGEST_AGE_S = 1.0  # largest age in an observation [s]


def box(ranges: Iterable[tuple[float, float]], rows: int | None = None) -> gymnasium.spaces.Box:
    """Make a space of numbers within ranges (lowest, highest), (n,), or of rows of them, (rows, n)."""
    low, high = np.array(list(ranges), dtype=np.float32).T
    if rows is not None:
        low, high = np.tile(low, (rows, 1)), np.tile(high, (rows, 1))
    return gymnasium.spaces.Box(low, high, dtype=np.float32)


def within(values: Sequence[float] | Sequence[Sequence[float]], space: gymnasium.spaces.Box) -> Vector:
    """Clip values to the ranges of a space."""
    return np.minimum(np.maximum(np.array(values, dtype=np.float32), space.low), space.high)


@dataclass(frozen=True)
class Units:
    """Ranges of head and lens, mapped to -1 to 1.

    Attributes:
        pan: lowest and highest pan [rad].
        tilt: lowest and highest tilt [rad].
        focal_px: shortest and longest nominal focal length [px]; the mapping is even in its logarithm.
    """

    pan: tuple[float, float]
    tilt: tuple[float, float]
    focal_px: tuple[float, float]

    @classmethod
    def of(cls, config: RigConfig) -> "Units":
        """Make the units of a rig, with the head's soft limits."""
        spec = describe(config)
        return cls(spec.head.limits.pan.range, spec.head.limits.tilt.range, spec.zoom.focal_range)

    def command(self, action: npt.ArrayLike) -> Command:
        """Convert an action (pan, tilt, focal length), clipped to -1 to 1, to a command.

        Raises:
            ConfigError: it is not three finite numbers.
        """
        try:
            given = np.asarray(action, dtype=float)
        except (TypeError, ValueError):
            given = np.empty(0)
        finite = given.shape == (3,) and all(map(math.isfinite, given.tolist()))
        require(finite, "action", action, "three finite numbers, of pan, tilt and focal length")
        parts = [(min(max(number, -1.0), 1.0) + 1) / 2 for number in given.tolist()]
        (low_pan, high_pan), (low_tilt, high_tilt), (short, long) = self.pan, self.tilt, self.focal_px
        return (
            low_pan + parts[0] * (high_pan - low_pan),
            low_tilt + parts[1] * (high_tilt - low_tilt),
            short * (long / short) ** parts[2],
        )

    def action(self, command: Command) -> Vector:
        """Convert a command to an action, (3,)."""
        return np.array(self.numbers(*command), dtype=np.float32)

    def numbers(self, pan: float, tilt: float, focal_px: float) -> tuple[float, float, float]:
        """Scale pan, tilt [rad] and nominal focal length [px] to numbers, -1 to 1 within the ranges."""
        (low_pan, high_pan), (low_tilt, high_tilt), (short, long) = self.pan, self.tilt, self.focal_px
        return (
            2 * (pan - low_pan) / (high_pan - low_pan) - 1,
            2 * (tilt - low_tilt) / (high_tilt - low_tilt) - 1,
            2 * math.log(focal_px / short) / math.log(long / short) - 1,
        )


# Features of a rig, with the range of each.
RIG_FEATURES = {
    "pan": (-1.0, 1.0),  # reported by the head, as in an action
    "tilt": (-1.0, 1.0),
    "focal": (-1.0, 1.0),  # reported by the lens, as in an action
    "pan_commanded": (-1.0, 1.0),  # last command, after rounding to steps
    "tilt_commanded": (-1.0, 1.0),
    "focal_commanded": (-1.0, 1.0),
    "head_moves": (0.0, 1.0),
    "lens_moves": (0.0, 1.0),
    "age_s": (0.0, LONGEST_AGE_S),  # of the fixed camera's frame
    "closeup_age_s": (0.0, LONGEST_AGE_S),  # of the zoom camera's frame
    "gone": (0.0, 1.0),  # part of the episode that has passed
}


def rig_numbers(
    units: Units, head: PanTiltState, lens: ZoomState, commanded: Command, ages_s: tuple[float, float], gone: float
) -> list[float]:
    """Compute the RIG_FEATURES.

    Args:
        units: units of the rig.
        head: state of the head.
        lens: state of the lens.
        commanded: last command.
        ages_s: ages of the newest frames of the fixed and the zoom camera [s].
        gone: part of the episode that has passed.
    """
    return [
        *units.numbers(head.pan, head.tilt, lens.focal_px),
        *units.numbers(*commanded),
        float(head.moving),
        float(lens.moving),
        *ages_s,
        gone,
    ]


Picture = npt.NDArray[np.uint8]
Observation = TypeVar("Observation")
Action = TypeVar("Action")
Kind = Literal["tracks", "images", "both"]
KINDS: tuple[Kind, ...] = ("tracks", "images")  # of the environments of version 0
IMAGE_SIZE: Size = (64, 64)
DETECTOR_NOISE = TruthNoise()
RENDER_SIZE: Size = (320, 240)  # of each of the two pictures that `render` puts side by side [px]


class Episode:
    """World, detector and ground truth of one episode."""

    def __init__(self, config: RigConfig, noise: TruthNoise) -> None:
        """Open the world.

        Args:
            config: the rig, with the targets in its world.
            noise: noise of the detections.
        """
        self.config = config
        self.world = SimWorld(config, rendered=())
        self.rig, self.truth = self.world.rig, self.world.truth()
        self.outlines = Outlines(self.truth)
        self.detector = TruthDetector(self.outlines, config.sim.seed, noise)
        fixed = self.truth.T_world_fixed
        self._eye, self._to_fixed = fixed.translation, fixed.rotation.as_matrix().T

    def direction(self, name: str, t: float) -> Array:
        """True direction of a target's centre from the fixed camera, a unit vector in its frame, (3,)."""
        way = self._to_fixed @ (self.outlines.center(name, t) - self._eye)
        return way / math.sqrt(way @ way)

    def box(self, name: str, camera: CameraName, t: float) -> Array:
        """Left, top, right and bottom of a target's box [px], (4,); infinite behind the camera."""
        box = self.outlines.box(name, camera, t)
        return np.full(4, np.inf) if box is None else np.concatenate(box)


def _is_side(given: object) -> bool:
    """Whether a picture may have a side of that length [px]."""
    return isinstance(given, int | np.integer) and bool(SMALLEST_PX <= given <= LARGEST_PX)


class RigEnv(gymnasium.Env[Observation, Action], Generic[Observation, Action]):
    """Base of the environments on the simulated rig; see `Follow` and `Schedule`.

    Attributes:
        config: the rig; each episode sets its targets and seed.
        given_calibration: the given calibration; None for the exact one of each episode's rig.
        frames: number of steps of an episode.
        units: units of actions and observations.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012  as gymnasium has it
    _kinds: Sequence[Kind] = KINDS

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
        """Check the arguments that all environments share.

        Raises:
            ConfigError: an argument is invalid.
        """
        one_of("observation", observation, self._kinds)
        if render_mode is not None:
            one_of("render_mode", render_mode, self.metadata["render_modes"])
        if isinstance(calibration, Path | str):
            calibration = Calibration.load(Path(calibration))
        own = isinstance(calibration, Calibration | None)
        require(own, "calibration", calibration, "a cotarget.calibration.Calibration or the path of one")
        lasts = f"above 0 and up to {SECONDS:g}, as long as the targets' paths"
        require(number_in(seconds, 0.0, SECONDS), "seconds", seconds, lasts)
        sides = isinstance(image_size, list | tuple) and len(image_size) == 2 and all(map(_is_side, image_size))
        wanted = f"(width, height) of {SMALLEST_PX} to {LARGEST_PX} pixels each"
        require(sides, "image_size", image_size, wanted)
        require(isinstance(noise, TruthNoise), "noise", noise, "a cotarget.evaluation.TruthNoise")
        self.config = rig_of(rig)
        self.units = Units.of(self.config)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.config.sim.fixed.rate_hz}
        self.given_calibration, self._noise, self._observation = calibration, noise, observation
        self._size = int(image_size[0]), int(image_size[1])
        self.frames = max(round(float(seconds) * self.config.sim.fixed.rate_hz), 1)
        self._episode: Episode | None = None
        self._opened: dict[Size, SizedPictures] = {}  # for the present episode

    @property
    def episode(self) -> Episode:
        """The present episode.

        Raises:
            ResetNeeded: there is none.
        """
        if self._episode is None:
            raise gymnasium.error.ResetNeeded("there is no episode: call reset() first, and again after close()")
        return self._episode

    @property
    def calibration(self) -> Calibration:
        """The given calibration, or the exact one of the episode's rig."""
        return true_calibration(self.episode.world) if self.given_calibration is None else self.given_calibration

    @property
    def times(self) -> tuple[float, float]:
        """Exposure times of the newest frames of the fixed and the zoom camera [s]."""
        raise NotImplementedError

    def profile_of(self, name: str) -> TargetProfile:
        """Target profile for the pipeline; its detector is the default one, as all detections come from the truth."""
        detector = DEFAULT_TARGETS[name].detector if name in DEFAULT_TARGETS else TargetProfile.detector
        return replace(self.config.target(name), detector=detector)

    def render(self) -> Picture | None:
        """Render both cameras side by side, RGB, if the render mode is "rgb_array"."""
        if self.render_mode is None:
            return None
        return np.hstack(self._look(RENDER_SIZE))

    def close(self) -> None:
        """Release everything; may be called again."""
        self._end()

    def _begin(self, seed: int | None, options: Mapping[str, Any] | None) -> int:
        """Seed the generator, and draw the seed of the next episode's world.

        Raises:
            ConfigError: options are given; there are none.
        """
        none = options is None or (isinstance(options, Mapping) and not options)
        require(none, "options", options, "empty: reset takes a seed only")
        super().reset(seed=seed)
        return int(self.np_random.integers(2**31))

    def _open(self, paths: Mapping[str, tuple[Waypoint, ...]], seed: int) -> Episode:
        """Open an episode with targets on given paths."""
        self._end()
        sim = replace(self.config.sim, seed=seed, targets=tuple(paths), paths=paths)
        self._episode = self._made(replace(self.config, sim=sim))
        return self._episode

    def _made(self, config: RigConfig) -> Episode:
        """Make the episode of a rig with its targets."""
        return Episode(config, self._noise)

    def _end(self) -> None:
        """Close the episode, if there is one."""
        while self._opened:
            self._opened.popitem()[1].close()
        if self._episode is not None:
            self._episode.rig.close()
            self._episode = None

    def _picture_spaces(self) -> dict[str, gymnasium.Space[Any]]:
        """Spaces of the pictures in an observation."""
        width, height = self._size
        return {name: gymnasium.spaces.Box(0, 255, (height, width, 3), np.uint8) for name in ("wide", "closeup")}

    def _pictures(self) -> dict[str, Picture]:
        """Render the pictures of an observation."""
        return dict(zip(("wide", "closeup"), self._look(self._size), strict=True))

    def _look(self, size: Size) -> list[Picture]:
        """Render the newest frames of the fixed and the zoom camera, RGB."""
        episode = self.episode
        if size not in self._opened:
            self._opened[size] = episode.world.pictures(size)
        pictures = self._opened[size]
        names: tuple[CameraName, ...] = ("fixed", "zoom")
        images = [pictures.take(name, t) for name, t in zip(names, self.times, strict=True)]
        return [np.ascontiguousarray(image[:, :, ::-1]) for image in images]
