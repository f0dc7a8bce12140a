"""Define cotarget's exceptions; each message is one line that names what is wrong."""

from collections.abc import Iterable


class CotargetError(Exception):
    """Base of every error that cotarget raises on purpose."""


class ConfigError(CotargetError):
    """A configuration, an argument or a file is invalid."""


class MissingPackageError(CotargetError):
    """An optional package is needed and not installed."""


class CalibrationError(CotargetError):
    """The captures or a calibration cannot be used."""


class DeviceError(CotargetError):
    """A camera, the pan-tilt unit or the renderer failed."""


class StaleFrameError(DeviceError):
    """A frame came too late or is too old to act on."""


class HaltedError(DeviceError):
    """A move ended before its goal, because the head was halted or sent elsewhere; it may be commanded again."""


class EmergencyStopError(DeviceError):
    """The head is stopped until an operator clears it."""


class UnreachableError(CotargetError):
    """No pan and tilt within the limits bring the target to the wanted pixel."""


def choices(names: Iterable[str]) -> str:
    """Format the valid choices for the end of an error message."""
    return ", ".join(sorted(names)) or "none"
