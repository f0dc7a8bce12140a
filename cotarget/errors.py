"""Define cotarget's exceptions; each message is one line that names what is wrong."""

import shlex
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


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


@contextmanager
def naming(where: object) -> Iterator[None]:
    """Put the name of a file or an option, if there is one, in front of the message of a wrong file or argument."""
    try:
        yield
    except (ConfigError, CalibrationError) as error:
        raise type(error)(f"{where}: {error}" if where else str(error)) from None


def choices(names: Iterable[str]) -> str:
    """Format the valid choices for the end of an error message."""
    return ", ".join(sorted(names)) or "none"


def pip_install(*arguments: str) -> str:
    """Return the command that installs packages into the Python in use, which needs no active environment."""
    return shlex.join([sys.executable, "-m", "pip", "install", *arguments])


def install_extra(extra: str) -> str:
    """Return the command that installs what an extra needs, from a clone as from a wheel: no index has cotarget."""
    from importlib.metadata import requires

    parts = (each.partition(";") for each in requires("cotarget") or [])
    return pip_install(*(need.strip() for need, _, marker in parts if marker.strip() == f"extra == '{extra}'"))
