"""rig.toml, read into frozen dataclasses; unknown keys are refused with the valid ones named.

Values keep the units of the file, because people edit it: metres and degrees, millimetres where a name says so.
Defaults are the rig that the project's figures are stated for.
"""

import dataclasses
import itertools
import math
import tomllib
import types
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cotarget.assets import assets_dir
from cotarget.camera import Intrinsics
from cotarget.errors import ConfigError, choices
from cotarget.geometry import RigidTransform, pose
from cotarget.tables import build, expect_table

Pair = tuple[float, float]
Size = tuple[int, int]
Distortion = tuple[float, float, float, float, float]
Waypoint = tuple[float, float, float, float]


@dataclass(frozen=True)
class SimCamera:
    """The simulated fixed camera: true intrinsics, sensor and link.

    Attributes:
        size: (width, height) [px].
        focal_px: true (fx, fy) [px].
        center_px: true principal point [px].
        distortion: true (k1, k2, p1, p2, k3).
        noise: standard deviation of the sensor's noise [grey levels].
        rate_hz: frames a second.
        latency_s: from light to frame [s].
        exposure_s: how long light is gathered [s]; what moves meanwhile is blurred, and rendering takes four times
            as long. 0 for an instant.
        jpeg_quality: 1 to 100.
    """

    size: Size = (640, 480)
    focal_px: Pair = (686.0, 684.0)
    center_px: Pair = (325.0, 239.0)
    distortion: Distortion = (-0.2, 0.0, 0.0, 0.0, 0.0)
    noise: float = 2.0
    rate_hz: float = 25.0
    latency_s: float = 0.06
    exposure_s: float = 0.0
    jpeg_quality: int = 90


@dataclass(frozen=True)
class SimZoomCamera(SimCamera):
    """The simulated zoom camera; ``focal_px`` is the truth at the shortest focal length.

    Attributes:
        focal_mm: shortest and longest focal length as the maker states them [mm].
        pitch_mm: size of a pixel as the maker states it [mm]; focal_mm / pitch_mm is what the device tells.
        lens_steps: number of positions from shortest to longest, evenly spaced in the logarithm.
        lens_speed: positions a second.
    """

    focal_px: Pair = (692.0, 693.0)
    center_px: Pair = (326.0, 235.0)
    distortion: Distortion = (-0.1, 0.0, 0.0, 0.0, 0.0)
    focal_mm: Pair = (6.0, 72.0)
    pitch_mm: float = 0.009
    lens_steps: int = 129
    lens_speed: float = 129.0


@dataclass(frozen=True)
class SimHead:
    """The simulated pan-tilt unit; defaults are a stock PTU-D46-17.5 with the geometry of a real, imperfect one.

    Attributes:
        step_deg: resolution [degrees].
        pan_deg: lowest and highest pan [degrees].
        tilt_deg: lowest and highest tilt [degrees].
        speed_deg_s: highest speed [degrees/s].
        accel_deg_s2: acceleration [degrees/s^2].
        command_delay_s: from command to motion [s].
        axis_offset_mm: distance between the axes along the pan frame's z, dz [mm].
        squareness_deg: departure of the axes from a right angle, eps [degrees].
        backlash_deg: play of each axis [degrees].
    """

    step_deg: float = 0.0514286
    pan_deg: Pair = (-158.9, 158.9)
    tilt_deg: Pair = (-46.6, 31.1)
    speed_deg_s: float = 149.0
    accel_deg_s2: float = 206.0
    command_delay_s: float = 0.04
    axis_offset_mm: float = 5.0
    squareness_deg: float = 0.1
    backlash_deg: float = 0.0


@dataclass(frozen=True)
class SimEffects:
    """One switch for each way in which the simulation departs from the textbook; ``all = false`` clears them.

    Attributes:
        noise: sensor noise.
        jpeg: compression.
        distortion: lens distortion of both cameras.
        latency: light to frame.
        blur: motion during the exposure.
        command_delay: command to motion.
        profile: finite speed and acceleration of the head.
        steps: the head's resolution.
        axes: axis offset and non-squareness.
        backlash: play.
        lens: positions and travel time of the zoom lens.
        scatter: true sizes differ from what the pipeline is told.
        shadows: cast shadows (costs two to four times the rendering).
        multisampling: antialiasing with 4 samples.
    """

    noise: bool = True
    jpeg: bool = True
    distortion: bool = True
    latency: bool = True
    blur: bool = True
    command_delay: bool = True
    profile: bool = True
    steps: bool = True
    axes: bool = True
    backlash: bool = True
    lens: bool = True
    scatter: bool = True
    shadows: bool = False
    multisampling: bool = True


# Offsets of the kind the paper's rig had: 0.4 m beside each other, a few degrees apart, the camera bolted to the
# unit with a lever of some ten centimetres.
DEFAULT_GAMMA = pose([-0.40, 0.03, 0.06], [0.8, -1.9, 0.6])
DEFAULT_T = pose([0.02, -0.08, 0.05], [0.7, -1.4, 0.5])


@dataclass(frozen=True)
class SimConfig:
    """The simulated world.

    Attributes:
        scene: a scene of sim_assets, or a path to an MJCF file.
        seed: of everything random.
        targets: which targets are in the scene.
        T_zoom0_fixed: the true Gamma.
        T_head_zoom: the true T.
        fixed: the wide camera.
        zoom: the zoom camera.
        head: the pan-tilt unit.
        effects: switches.
        paths: for a target of that name, waypoints [t, x, y, z] (seconds, metres in the world) of a smooth path
            that replaces the built-in one.
    """

    scene: str = "outdoor"
    seed: int = 0
    targets: tuple[str, ...] = ()
    T_zoom0_fixed: RigidTransform = DEFAULT_GAMMA
    T_head_zoom: RigidTransform = DEFAULT_T
    fixed: SimCamera = SimCamera()
    zoom: SimZoomCamera = SimZoomCamera()
    head: SimHead = SimHead()
    effects: SimEffects = SimEffects()
    paths: Mapping[str, tuple[Waypoint, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class BoardConfig:
    """The calibration board: inner corners (columns, rows) and the side of a square [m]."""

    kind: Literal["chessboard"] = "chessboard"
    corners: Size = (9, 6)
    square: float = 0.1


@dataclass(frozen=True)
class TargetConfig:
    """What the pipeline is told of a target.

    Attributes:
        size: its true size [m].
        dimension: which of its dimensions that is.
        wanted_px: how large that dimension shall be in the close-up [px].
        detector: how it is found in the wide view.
        template: picture of the target, cut to its outline, for one that is found by its colour; a relative path is
            relative to rig.toml.
    """

    size: float
    dimension: Literal["width", "height", "wingspan"]
    wanted_px: float
    detector: Literal["colour", "motion"]
    template: Path | None = None


DEFAULT_TARGETS: Mapping[str, TargetConfig] = types.MappingProxyType(
    {
        "book": TargetConfig(0.234, "width", 160.0, "colour", assets_dir() / "textures" / "book_front.png"),
        "person": TargetConfig(1.75, "height", 300.0, "motion"),
        "bird": TargetConfig(0.8, "wingspan", 160.0, "motion"),
    }
)


@dataclass(frozen=True)
class SafetyConfig:
    """Soft limits inside the device's own.

    Attributes:
        pan_deg: lowest and highest pan [degrees]; None for the device's.
        tilt_deg: lowest and highest tilt [degrees]; None for the device's.
        speed_deg_s: speed cap [degrees/s]; None for the device's.
        max_frame_age_s: a frame older than this is not acted on [s].
    """

    pan_deg: Pair | None = None
    tilt_deg: Pair | None = None
    speed_deg_s: float | None = None
    max_frame_age_s: float = 1.0


@dataclass(frozen=True)
class RigConfig:
    """The whole of rig.toml."""

    backend: Literal["sim"] = "sim"
    sim: SimConfig = field(default_factory=SimConfig)
    board: BoardConfig = field(default_factory=BoardConfig)
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    targets: Mapping[str, TargetConfig] = field(default_factory=lambda: DEFAULT_TARGETS)

    @property
    def head_limits(self) -> tuple[Pair, Pair]:
        """Pan and tilt limits [rad]: the device's, and the soft ones where they are tighter."""
        head, soft = self.sim.head, self.safety
        pan = _overlap(head.pan_deg, soft.pan_deg, "safety.pan_deg")
        tilt = _overlap(head.tilt_deg, soft.tilt_deg, "safety.tilt_deg")
        return (math.radians(pan[0]), math.radians(pan[1])), (math.radians(tilt[0]), math.radians(tilt[1]))

    @property
    def head_step(self) -> float:
        """The head's resolution [rad]; 0 for a continuous one."""
        return math.radians(self.sim.head.step_deg) if self.sim.effects.steps else 0.0

    @property
    def focal_range_px(self) -> Pair:
        """The zoom camera's shortest and longest nominal focal length [px]."""
        shortest, longest = (focal / self.sim.zoom.pitch_mm for focal in self.sim.zoom.focal_mm)
        return shortest, longest

    @property
    def command_delay_s(self) -> float:
        """From a command to the start of motion, as far as it is known [s]."""
        return self.sim.head.command_delay_s if self.sim.effects.command_delay else 0.0

    def target(self, name: str) -> TargetConfig:
        """Look a target up by name.

        Raises:
            ConfigError: no such target.
        """
        try:
            return self.targets[name]
        except KeyError:
            raise ConfigError(f"unknown target '{name}'; the targets are: {choices(self.targets)}") from None


def load_config(path: Path) -> RigConfig:
    """Read rig.toml.

    Raises:
        ConfigError: the file is missing, malformed, or says something unknown or impossible.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; give the path of a rig.toml") from None
    except IsADirectoryError:
        raise ConfigError(f"{path}: is a directory; give the path of a rig.toml") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: is not TOML: {error}") from None
    try:
        config = parse_config(table)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    beside = {  # an absolute template stays what it is
        name: dataclasses.replace(target, template=target.template and path.parent / target.template)
        for name, target in config.targets.items()
    }
    return dataclasses.replace(config, targets=beside)


def parse_config(table: Mapping[str, Any]) -> RigConfig:
    """Build the configuration from TOML's tables; what is not said keeps its default.

    Raises:
        ConfigError: an unknown key or an impossible value.
    """
    table = dict(table)
    targets = dict(DEFAULT_TARGETS)
    given = table.pop("targets", {})
    expect_table(given, "targets")
    for name, values in given.items():
        targets[name] = build(TargetConfig, values, f"targets.{name}", base=targets.get(name))
    sim_table = table.get("sim")
    if isinstance(sim_table, Mapping) and isinstance(sim_table.get("effects"), Mapping):
        table["sim"] = {**sim_table, "effects": _expand_all(dict(sim_table["effects"]))}
    config = dataclasses.replace(build(RigConfig, table, ""), targets=targets)
    _check(config)
    return config


def _expand_all(effects: dict[str, Any]) -> dict[str, Any]:
    """Let ``all`` set every switch that is not named."""
    every = effects.pop("all", None)
    if every is None:
        return effects
    if not isinstance(every, bool):
        raise ConfigError(f"sim.effects.all: {every!r} is not true or false")
    return {f.name: every for f in dataclasses.fields(SimEffects)} | effects


def _check_lens(where: str, camera: SimCamera) -> None:
    """Refuse a lens through which part of the image sees nothing."""
    (w, h), focal = camera.size, camera.focal_px
    if min(*camera.size, *focal) <= 0:
        return  # said elsewhere
    rim = np.array([(u, v) for u in np.linspace(-1, w, 9) for v in np.linspace(-1, h, 9)])
    lens = Intrinsics(camera.size, focal, camera.center_px, camera.distortion)
    if not np.isfinite(lens.ray(rim)).all():
        raise ConfigError(
            f"{where}.distortion: {list(camera.distortion)} folds back inside the image, so that parts of it see "
            "nothing; give a weaker distortion, a longer focal_px or a smaller size"
        )


def _overlap(own: Pair, soft: Pair | None, where: str) -> Pair:
    both = own if soft is None else (max(own[0], soft[0]), min(own[1], soft[1]))
    if both[0] >= both[1]:
        raise ConfigError(f"{where}: {list(soft or own)} leaves nothing of the device's own range {list(own)}")
    return both


def _check(config: RigConfig) -> None:
    """Refuse values of the right type that make no sense."""
    sim = config.sim
    positive: dict[str, tuple[float, ...]] = {
        "board.square": (config.board.square,),
        "safety.max_frame_age_s": (config.safety.max_frame_age_s,),
        "sim.zoom.pitch_mm": (sim.zoom.pitch_mm,),
        "sim.zoom.lens_speed": (sim.zoom.lens_speed,),
        "sim.head.speed_deg_s": (sim.head.speed_deg_s,),
        "sim.head.accel_deg_s2": (sim.head.accel_deg_s2,),
    }
    not_negative: dict[str, tuple[float, ...]] = {
        "sim.seed": (sim.seed,),
        "sim.head.step_deg": (sim.head.step_deg,),
        "sim.head.command_delay_s": (sim.head.command_delay_s,),
        "sim.head.backlash_deg": (sim.head.backlash_deg,),
    }
    for name, camera in (("fixed", sim.fixed), ("zoom", sim.zoom)):
        positive[f"sim.{name}.size"] = camera.size
        positive[f"sim.{name}.focal_px"] = camera.focal_px
        positive[f"sim.{name}.rate_hz"] = (camera.rate_hz,)
        not_negative[f"sim.{name}.noise"] = (camera.noise,)
        not_negative[f"sim.{name}.latency_s"] = (camera.latency_s,)
        not_negative[f"sim.{name}.exposure_s"] = (camera.exposure_s,)
        if not 1 <= camera.jpeg_quality <= 100:
            raise ConfigError(f"sim.{name}.jpeg_quality: {camera.jpeg_quality} is not within 1 to 100")
        _check_lens(f"sim.{name}", camera)
    for name, target in config.targets.items():
        positive[f"targets.{name}.size"] = (target.size,)
        positive[f"targets.{name}.wanted_px"] = (target.wanted_px,)
    for where, values in positive.items():
        if min(values) <= 0:
            raise ConfigError(f"{where}: {min(values):g} is not greater than zero")
    for where, values in not_negative.items():
        if min(values) < 0:
            raise ConfigError(f"{where}: {min(values):g} is negative")
    ranges = {
        "sim.head.pan_deg": sim.head.pan_deg,
        "sim.head.tilt_deg": sim.head.tilt_deg,
        "sim.zoom.focal_mm": sim.zoom.focal_mm,
        "safety.pan_deg": config.safety.pan_deg,
        "safety.tilt_deg": config.safety.tilt_deg,
    }
    for where, limits in ranges.items():
        if limits is not None and limits[0] >= limits[1]:
            raise ConfigError(f"{where}: {list(limits)} is not [lowest, highest]")
    if sim.zoom.focal_mm[0] <= 0:
        raise ConfigError(f"sim.zoom.focal_mm: {sim.zoom.focal_mm[0]:g} is not greater than zero")
    if sim.zoom.lens_steps < 2:
        raise ConfigError(f"sim.zoom.lens_steps: {sim.zoom.lens_steps} is fewer than 2")
    if config.safety.speed_deg_s is not None and config.safety.speed_deg_s <= 0:
        raise ConfigError(f"safety.speed_deg_s: {config.safety.speed_deg_s:g} is not greater than zero")
    if min(config.board.corners) < 3:
        raise ConfigError(f"board.corners: {list(config.board.corners)} has fewer than 3 corners a side")
    for name in sim.targets:
        config.target(name)
    for name, waypoints in sim.paths.items():
        if name not in config.targets:
            raise ConfigError(f"sim.paths.{name}: is no target; the targets are: {choices(config.targets)}")
        if len(waypoints) < 2 or any(b[0] <= a[0] for a, b in itertools.pairwise(waypoints)):
            raise ConfigError(f"sim.paths.{name}: needs two or more waypoints [t, x, y, z] with increasing t")
