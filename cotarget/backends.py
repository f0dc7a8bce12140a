"""Open the rig that a configuration describes; the only module that imports backends."""

from typing import TYPE_CHECKING

from cotarget.errors import ConfigError
from cotarget.rig import Rig

if TYPE_CHECKING:
    from cotarget.config import RigConfig


def open_rig(config: "RigConfig") -> Rig:
    """Open the rig that a configuration describes; the only place that imports a backend.

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
