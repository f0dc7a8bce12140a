"""rig.toml, read into frozen dataclasses; unknown keys are refused with the valid ones named.

Values keep the units of the file, because people edit it: metres and degrees, millimetres where a name says so.
Defaults are the rig that the project's figures are stated for.
"""

import dataclasses
import math
import tomllib
import types
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from cotarget.assets import assets_dir
from cotarget.errors import ConfigError, choices
from cotarget.hwconfig import HardwareConfig
from cotarget.rigchecks import check_config
from cotarget.simconfig import (
    Limits,
    Pair,
    SimCamera,
    SimConfig,
    SimEffects,
    SimHead,
    SimZoomCamera,
    Size,
    expand_all,
    fit_sizes,
    split_name,
)
from cotarget.tables import build, expect_table

__all__ = [
    "DEFAULT_TARGETS",
    "BoardConfig",
    "HardwareConfig",
    "RigConfig",
    "SafetyConfig",
    "SimCamera",
    "SimConfig",
    "SimEffects",
    "SimHead",
    "SimZoomCamera",
    "TargetConfig",
    "check_config",
    "config_of",
    "load_config",
    "parse_config",
    "read_tables",
    "read_text",
]

ENCODING = "utf-8-sig"  # with the byte-order mark that some editors write, or without


@dataclass(frozen=True)
class BoardConfig:
    """The calibration board: inner corners (columns, rows) and the side of a square [m]."""

    kind: Literal["chessboard", "charuco"] = "chessboard"
    corners: Annotated[tuple[int, int], "[columns, rows]"] = (9, 6)
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
        motion: how it moves: a thing that stands and is put elsewhere at times, who walks, or who flies; by default
            what is found by its colour stands, what has a wingspan flies, and all else walks.
    """

    size: float
    dimension: Literal["width", "height", "wingspan"]
    wanted_px: float
    detector: Literal["colour", "motion", "speck", "mog2"]
    template: Path | None = None
    motion: Literal["standing", "walking", "flying"] | None = None


DEFAULT_TARGETS: Mapping[str, TargetConfig] = types.MappingProxyType(
    {
        "book": TargetConfig(0.234, "width", 160.0, "colour", assets_dir() / "textures" / "book_front.png"),
        "person": TargetConfig(1.75, "height", 300.0, "motion"),
        "bird": TargetConfig(0.8, "wingspan", 160.0, "speck"),
    }
)


@dataclass(frozen=True)
class SafetyConfig:
    """Soft limits inside the device's own, and when the head is halted or does not move at all.

    Attributes:
        pan_deg: lowest and highest pan [degrees]; None for the device's.
        tilt_deg: lowest and highest tilt [degrees]; None for the device's.
        speed_deg_s: speed cap [degrees/s]; None for the device's.
        max_frame_age_s: a frame older than this is not acted on [s].
        watchdog_s: a head that may be moving is halted when for so long neither a fresh frame was read nor a command
            given [s]; its braking comes after that.
        stop_file: while this file exists, the head does not move; None for no such file.
    """

    pan_deg: Limits | None = None
    tilt_deg: Limits | None = None
    speed_deg_s: float | None = None
    max_frame_age_s: float = 1.0
    watchdog_s: float = 0.35
    stop_file: Path | None = None


@dataclass(frozen=True)
class RigConfig:
    """The whole of rig.toml.

    Attributes:
        backend: which rig it is.
        sim: the simulated one.
        hardware: the real one.
        recording: folder of the one that was recorded; a relative path is relative to rig.toml.
        board: for calibration.
        safety: soft limits.
        targets: what can be followed.
    """

    backend: Literal["sim", "hardware", "replay"] = "sim"
    sim: SimConfig = field(default_factory=SimConfig)
    hardware: HardwareConfig = field(default_factory=HardwareConfig)
    recording: Path | None = None
    board: BoardConfig = field(default_factory=BoardConfig)
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    targets: Mapping[str, TargetConfig] = field(default_factory=lambda: dict(DEFAULT_TARGETS))

    @property
    def head_limits(self) -> tuple[Pair, Pair]:
        """Pan and tilt limits [rad]: the device's, and the soft ones where they are tighter."""
        pan, tilt = self.head_limits_deg
        return (math.radians(pan[0]), math.radians(pan[1])), (math.radians(tilt[0]), math.radians(tilt[1]))

    @property
    def head_limits_deg(self) -> tuple[Pair, Pair]:
        """The same [degrees]."""
        head, soft = self.sim.head if self.backend == "sim" else self.hardware.head, self.safety
        pan = _overlap(head.pan_deg, soft.pan_deg, "safety.pan_deg")
        return pan, _overlap(head.tilt_deg, soft.tilt_deg, "safety.tilt_deg")

    @property
    def head_step(self) -> float:
        """The head's resolution [rad]; 0 for a continuous one."""
        if self.backend != "sim":
            return math.radians(self.hardware.head.step_deg)
        return math.radians(self.sim.head.step_deg) if self.sim.effects.steps else 0.0

    @property
    def focal_range_px(self) -> Pair:
        """The zoom camera's shortest and longest nominal focal length [px]."""
        if self.backend == "sim":
            shortest, longest = self.sim.zoom.focal_mm
        else:
            shortest, longest = self.hardware.zoom.lens[0][1], self.hardware.zoom.lens[-1][1]
        return shortest / self.pitch_mm, longest / self.pitch_mm

    @property
    def pitch_mm(self) -> float:
        """Size of a pixel of the zoom camera's stream [mm]."""
        return self.sim.zoom.pitch_mm if self.backend == "sim" else self.hardware.zoom.pitch_mm

    @property
    def stream_sizes(self) -> tuple[Size, Size]:
        """(width, height) of the fixed and the zoom camera's stream [px]."""
        if self.backend == "sim":
            return self.sim.fixed.size, self.sim.zoom.size
        return self.hardware.fixed.size, self.hardware.zoom.size

    @property
    def rate_hz(self) -> float:
        """Frames of the fixed camera a second."""
        return self.sim.fixed.rate_hz if self.backend == "sim" else self.hardware.fixed.rate_hz

    @property
    def command_delay_s(self) -> float:
        """From a command to the start of motion, as far as it is known [s]."""
        if self.backend != "sim":
            return self.hardware.head.command_delay_s
        return self.sim.head.command_delay_s if self.sim.effects.command_delay else 0.0

    @property
    def lens_delay_s(self) -> float:
        """From a command to the start of the lens's motion, as far as it is known [s]."""
        return self.command_delay_s if self.backend == "sim" else self.hardware.zoom.command_delay_s

    def target(self, name: str) -> TargetConfig:
        """Look a target up by name; a further one of a kind, as ``bird2``, is like the first unless it has its own.

        Raises:
            ConfigError: no such target.
        """
        found = _of_kind(self.targets, name)
        if found is None:
            raise ConfigError(f"unknown target '{name}'; the targets are: {choices(self.targets)}")
        return found


def load_config(path: Path) -> RigConfig:
    """Read rig.toml.

    Raises:
        ConfigError: the file is missing, malformed, or says something unknown or impossible.
    """
    return config_of(read_text(path), path)


def config_of(text: str, path: Path) -> RigConfig:
    """What a rig.toml says, from its text alone.

    Args:
        text: of the file, as `read_text` gives it.
        path: where it is: relative paths in it are relative to its folder, and messages name it. It is not read.

    Raises:
        ConfigError: the text is malformed, or says something unknown or impossible.
    """
    table = _tables(text, path)
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
    sim = dataclasses.replace(sim, models={name: path.parent / model for name, model in sim.models.items()})
    recording = config.recording and path.parent / config.recording
    safety = dataclasses.replace(
        config.safety, stop_file=config.safety.stop_file and path.parent / config.safety.stop_file
    )
    return dataclasses.replace(config, targets=beside, sim=sim, recording=recording, safety=safety)


def read_tables(path: Path) -> dict[str, Any]:
    """The tables of a rig.toml as it stands, unchecked.

    Raises:
        ConfigError: the file is missing or is not TOML.
    """
    return _tables(read_text(path), path)


def read_text(path: Path) -> str:
    """What stands in a rig.toml.

    Raises:
        ConfigError: the file is missing or is no text.
    """
    try:
        return path.read_text(encoding=ENCODING)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; give the path of a rig.toml") from None
    except IsADirectoryError:
        raise ConfigError(f"{path}: is a directory; give the path of a rig.toml") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is no text in UTF-8: {error.reason}; give the path of a rig.toml") from None


def _tables(text: str, path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: is not TOML: {error}") from None


def parse_config(table: Mapping[str, Any], *, recorded: bool = False) -> RigConfig:
    """Build the configuration from TOML's tables; what is not said keeps its default.

    Args:
        table: as TOML has it.
        recorded: whether it is a recording's, which opens no simulated world: one that an earlier version had is not
            refused then.

    Raises:
        ConfigError: an unknown key or an impossible value.
    """
    table = dict(table)
    targets = dict(DEFAULT_TARGETS)
    given = table.pop("targets", {})
    expect_table(given, "targets")
    for name, values in given.items():
        targets[name] = build(TargetConfig, values, f"targets.{name}", base=_of_kind(targets, name))
    sim_table = table.get("sim")
    if isinstance(sim_table, Mapping) and isinstance(sim_table.get("effects"), Mapping):
        table["sim"] = {**sim_table, "effects": expand_all(sim_table["effects"])}
    config = build(RigConfig, table, "")
    config = dataclasses.replace(config, targets=targets, sim=fit_sizes(config.sim, table.get("sim", {})))
    check_config(config, recorded)
    return config


def _of_kind(targets: Mapping[str, TargetConfig], name: str) -> TargetConfig | None:
    """The target of that name, or of the name without the number from 2 on at its end."""
    return targets.get(name) or targets.get(split_name(name)[0])


def _overlap(own: Pair, soft: Pair | None, where: str) -> Pair:
    both = own if soft is None else (max(own[0], soft[0]), min(own[1], soft[1]))
    if both[0] >= both[1]:
        raise ConfigError(f"{where}: {list(soft or own)} leaves nothing of the device's own range {list(own)}")
    return both
