"""The exceptions that a user of cotarget may meet; each message is one line that names what is wrong."""

from collections.abc import Iterable


class CotargetError(Exception):
    """Base of every error that cotarget raises on purpose."""


class ConfigError(CotargetError):
    """A configuration or a file does not say what it should."""


class MissingPackageError(CotargetError):
    """A package that only some uses need is not installed."""


class CalibrationError(CotargetError):
    """The captures or a calibration cannot be used."""


class DeviceError(CotargetError):
    """A camera, the pan-tilt unit or the renderer did not do what was asked."""


class StaleFrameError(DeviceError):
    """A frame came too late or is too old to act on."""


class HaltedError(DeviceError):
    """A move did not come to its end because the head was halted, or sent elsewhere; it may be commanded again."""


class EmergencyStopError(DeviceError):
    """The head is stopped until an operator clears it."""


class UnreachableError(CotargetError):
    """No pan and tilt within the limits brings the target to the wanted pixel."""


def choices(names: Iterable[str]) -> str:
    """Format valid choices for the end of an error message."""
    return ", ".join(sorted(names)) or "none"
