"""Read, check and open the rig that a rig.toml describes; the only module that imports backends."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from cotarget.errors import ConfigError
from cotarget.rig import Rig, RigSpec

if TYPE_CHECKING:
    from cotarget.config import RigConfig
    from cotarget.recording.format import Recording


def load_config(path: Path | str, text: str | None = None) -> "RigConfig":
    """Read rig.toml and check all of it.

    Args:
        path: path of the file; relative paths in it are relative to its folder.
        text: text of the file; by default it is read.

    Raises:
        ConfigError: the file is missing or malformed, has an unknown key or an impossible value, or names devices and
            no backend.
    """
    from cotarget.config import config_of, read_text, tables_of

    path = Path(path)
    text = read_text(path) if text is None else text
    config = config_of(text, path)
    try:
        check(config)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    if any(vars(config.hardware).values()) and "backend" not in tables_of(text, path):  # a simulation would answer
        raise ConfigError(f'{path}: backend: is missing; devices are opened by backend = "hardware" above all tables')
    return config


def check(config: "RigConfig") -> None:
    """Check the simulated world, and [hardware] by its drivers, without opening anything.

    Raises:
        ConfigError: a value is refused; the message names the key.
    """
    from cotarget.drivers.rig import check_hardware
    from cotarget.sim.check import check_sim

    check_sim(config.sim)
    check_hardware(config.hardware)
    if config.backend == "replay":
        _recording_of(config)
    else:
        _check_times(config)


def _check_times(config: "RigConfig") -> None:
    """Refuse timeouts of the safety layer that would end every run."""
    spec, safety = _described(config), config.safety
    if safety.watchdog_s * spec.fixed.rate_hz <= 1:
        raise ConfigError(
            f"safety.watchdog_s: {safety.watchdog_s:g} s would halt the head between any two frames of the fixed "
            f"camera, which has {spec.fixed.rate_hz:g} a second"
        )
    zoom = "ptz" if config.backend == "hardware" and config.hardware.ptz else "zoom"
    for name, camera in (("fixed", spec.fixed), (zoom, spec.zoom)):
        if camera.latency_s >= safety.max_frame_age_s:
            raise ConfigError(
                f"{config.backend}.{name}.latency_s: {camera.latency_s:g} s makes every frame older than "
                f"safety.max_frame_age_s, {safety.max_frame_age_s:g} s"
            )


def open_rig(
    config: "RigConfig | Path | str", guarded: bool = True, *, file: Path | None = None, partial: bool = False
) -> Rig:
    """Open a rig with the safety layer in front of it: limits, watchdog and stop file.

    Args:
        config: a configuration, or the path of a rig.toml.
        guarded: whether the safety layer is in front; without it, a caller can put a recorder between the two and call
            `cotarget.safety.safe_rig.guard` itself.
        file: the rig.toml that a configuration is from; no second program may open its real devices.
        partial: whether real devices that are not configured may be missing, see `Rig.missing`.

    Raises:
        ConfigError: the configuration is malformed, or lacks a key that the rig needs.
        DeviceError: a device could not be opened.
        EmergencyStopError: the stop file exists.
    """
    from cotarget.safety.safe_rig import guard

    if isinstance(config, str | Path):
        file = Path(config)
        config = load_config(file)
    rig = OPENERS[config.backend](config, file, partial)
    return guard(rig, config.safety) if guarded else rig


def _open_simulation(config: "RigConfig", file: Path | None, partial: bool) -> Rig:
    from cotarget.sim.world import SimWorld

    return SimWorld(config).rig


def _open_hardware(config: "RigConfig", file: Path | None, partial: bool) -> Rig:
    from cotarget.drivers.rig import open_hardware

    return open_hardware(config, file, partial)


def _open_replay(config: "RigConfig", file: Path | None, partial: bool) -> Rig:
    from cotarget.recording.replay import Replay

    return Replay(open_recording(_recording_of(config))).rig


# Functions that open a backend's rig without the safety layer; arguments: configuration, rig.toml, whether devices may
# be missing.
OPENERS: dict[str, Callable[["RigConfig", Path | None, bool], Rig]] = {
    "sim": _open_simulation,
    "hardware": _open_hardware,
    "replay": _open_replay,
}


def open_recording(directory: Path) -> "Recording":
    """Read the complete part of a recording; images must exist, but are not read.

    Raises:
        ConfigError: the folder is no recording, has another schema, or has nothing that can be replayed.
    """
    from cotarget.recording.format import read_recording

    return read_recording(directory, _described)


def _recording_of(config: "RigConfig") -> Path:
    if config.recording is None:
        raise ConfigError("recording: is missing; backend 'replay' needs the folder of a recording")
    return config.recording


def describe(config: "RigConfig") -> RigSpec:
    """Describe the configured rig without opening a device: sizes, rates, delays, and limits within the soft ones.

    Raises:
        ConfigError: the soft limits leave nothing of the head's range, or a recording cannot be read.
    """
    from cotarget.safety.safe_rig import soft_limits

    spec = _described(config)
    return replace(spec, head=replace(spec.head, limits=soft_limits(spec.head.limits, config.safety)))


def _described(config: "RigConfig") -> RigSpec:
    """Describe the configured rig within its own limits."""
    match config.backend:
        case "sim":
            from cotarget.sim.devices import rig_spec

            return rig_spec(config)
        case "hardware":
            from cotarget.drivers.rig import rig_spec

            return rig_spec(config)
        case "replay":
            from cotarget.recording.format import read_spec

            return read_spec(_recording_of(config), _described)
