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
from cotarget.simconfig import Pair, SimCamera, SimConfig, SimEffects, SimHead, SimZoomCamera, Size
from cotarget.tables import build, expect_table

__all__ = [
    "DEFAULT_TARGETS",
    "BoardConfig",
    "RigConfig",
    "SafetyConfig",
    "SimCamera",
    "SimConfig",
    "SimEffects",
    "SimHead",
    "SimZoomCamera",
    "TargetConfig",
    "load_config",
    "parse_config",
]


@dataclass(frozen=True)
class BoardConfig:
    """The calibration board: inner corners (columns, rows) and the side of a square [m]."""

    kind: Literal["chessboard", "charuco"] = "chessboard"
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
    scene = path.parent / config.sim.scene
    sim = dataclasses.replace(config.sim, scene=str(scene)) if scene.is_file() else config.sim
    return dataclasses.replace(config, targets=beside, sim=sim)


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


# The curves of the zoom lens are checked at this many focal lengths.
CHECKED_FOCALS = 33
# Farther than any lens is long: an entrance pupil that moves so far was given in millimetres [m].
FARTHEST_PUPIL = 1.0
# No effect of a real rig but the quality of the rendering, which `all` leaves alone.
QUALITY = ("multisampling", "shadows")


def _expand_all(effects: dict[str, Any]) -> dict[str, Any]:
    """Let ``all`` set every switch that is not named."""
    every = effects.pop("all", None)
    if every is None:
        return effects
    if not isinstance(every, bool):
        raise ConfigError(f"sim.effects.all: {every!r} is not true or false")
    return {f.name: every for f in dataclasses.fields(SimEffects) if f.name not in QUALITY} | effects


def _sees_nothing(lens: Intrinsics) -> bool:
    """Whether part of the image has no ray."""
    w, h = lens.size
    rim = np.array([(u, v) for u in np.linspace(-1, w, 9) for v in np.linspace(-1, h, 9)])
    return not np.isfinite(lens.ray(rim)).all()


def _check_lens(where: str, camera: SimCamera) -> None:
    """Refuse a lens through which part of the image sees nothing."""
    if min(*camera.size, *camera.focal_px) <= 0:
        return  # said elsewhere
    if _sees_nothing(Intrinsics(camera.size, camera.focal_px, camera.center_px, camera.distortion)):
        raise ConfigError(
            f"{where}.distortion: {list(camera.distortion)} folds back inside the image, so that parts of it see "
            "nothing; give a weaker distortion, a longer focal_px or a smaller size"
        )


def _check_optics(zoom: SimZoomCamera) -> None:
    """Refuse a zoom lens whose curves no real lens follows."""
    shortest_mm, longest_mm = zoom.focal_mm
    before = 0.0
    for magnification in np.geomspace(1.0, longest_mm / shortest_mm, CHECKED_FOCALS).tolist():
        optics, at = zoom.optics_at(magnification), f"at {magnification:.3g} times the shortest focal length"
        focal = optics.focal_px[0]
        if not before < focal < math.inf:
            raise ConfigError(f"sim.zoom.focal_curve: the true focal length does not grow with the nominal one {at}")
        before = focal
        drift = np.abs(np.subtract(optics.center_px, zoom.center_px))
        if not (drift < zoom.size).all():
            raise ConfigError(f"sim.zoom.center_drift_px: moves the centre by the whole image or more {at}")
        if not abs(optics.pupil) < FARTHEST_PUPIL:
            raise ConfigError(f"sim.zoom.pupil: {optics.pupil:g} m {at} is {FARTHEST_PUPIL:g} m or more; give metres")
        lens = Intrinsics(zoom.size, optics.focal_px, optics.center_px, optics.distortion)
        if not np.isfinite(optics.distortion).all() or _sees_nothing(lens):
            raise ConfigError(
                f"sim.zoom.distortion_drift: the distortion folds back inside the image {at}, so that parts of it see "
                "nothing; give smaller coefficients"
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
    if sim.effects.optics:
        _check_optics(sim.zoom)
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
