"""Open the rig that a configuration describes; the only module that imports backends."""

from pathlib import Path
from typing import TYPE_CHECKING

from cotarget.errors import ConfigError
from cotarget.rig import Rig, RigSpec

if TYPE_CHECKING:
    from cotarget.config import RigConfig
    from cotarget.safety import SafeRig


def open_rig(config: "RigConfig | Path | str") -> "SafeRig":
    """Open a rig with the safety layer in front of it: limits, watchdog and stop file.

    Args:
        config: a configuration, or the path of a rig.toml.

    Raises:
        ConfigError: the configuration is malformed, or does not say enough of that rig.
        DeviceError: a device could not be opened.
        EmergencyStopError: the stop file exists.
    """
    from cotarget.config import load_config
    from cotarget.safety import SafeRig

    if isinstance(config, str | Path):
        config = load_config(Path(config))
    return SafeRig(open_devices(config), config.safety)


def open_devices(config: "RigConfig") -> Rig:
    """Open the same rig without the safety layer, for callers that put a recorder or a test between the two.

    Raises:
        ConfigError: the configuration does not say enough of that rig.
        DeviceError: a device could not be opened.
    """
    match config.backend:
        case "sim":
            from cotarget.sim.world import SimWorld

            return SimWorld(config).rig
        case "hardware":
            from cotarget.drivers.rig import open_hardware

            return open_hardware(config)
        case "replay":
            from cotarget.recording.format import open_recording
            from cotarget.recording.replay import ReplayRig

            if config.recording is None:
                raise ConfigError("recording: is missing; backend 'replay' needs the folder of a recording")
            return ReplayRig(open_recording(config.recording))


def describe(config: "RigConfig") -> RigSpec:
    """Describe the configured rig without opening a device: sizes, rates, delays, and limits within the soft ones.

    Raises:
        ConfigError: the soft limits leave nothing of the head's range.
    """
    from dataclasses import replace

    from cotarget.safety.safe_rig import soft_limits

    match config.backend:
        case "sim":
            from cotarget.sim.devices import rig_spec as spec_of
        case _:
            from cotarget.drivers.rig import rig_spec as spec_of
    spec = spec_of(config)
    return replace(spec, head=replace(spec.head, limits=soft_limits(spec.head.limits, config.safety)))
