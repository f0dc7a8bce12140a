"""Opens serial ports and what stands in for them, and says in one line why one cannot be opened."""

import errno
from typing import Protocol

from cotarget.errors import ConfigError, DeviceError

SLICE_S = 0.01  # how long a read waits, so how often one that waits longer looks at its deadline
WRITE_S = 0.5  # a line that takes no bytes for so long is dead


class InUseError(DeviceError):
    """Another program has it."""


class NoPermissionError(DeviceError):
    """This user may not use it."""


class Port(Protocol):
    """What of pyserial's ports is used."""

    @property
    def in_waiting(self) -> int:
        """How many bytes can be read at once."""

    def read(self, size: int = 1, /) -> bytes:
        """Wait for bytes until the port's own timeout."""

    def write(self, data: bytes, /) -> int | None:
        """Send bytes."""

    def close(self) -> None:
        """Release the port."""


def ports() -> list[tuple[str, str]]:
    """The serial ports of this machine: each one's name and what it is.

    Raises:
        DeviceError: pyserial is missing.
    """
    try:
        from serial.tools import list_ports
    except ImportError as error:
        raise _no_pyserial(error) from error
    return [(port.device, port.description) for port in list_ports.comports()]


def open_port(name: str, baud: int) -> Port:
    """Open a port by the name or URL that pyserial knows it by.

    Raises:
        ConfigError: no port is named.
        DeviceError: it cannot be opened.
    """
    if not name:
        raise ConfigError("hardware.head.port: names no port, such as /dev/ttyUSB0 or socket://host:4000")
    try:
        import serial
    except ImportError as error:
        raise _no_pyserial(error) from error
    url = "://" in name
    try:
        # Two programs on one port would take each other's answers.
        return serial.serial_for_url(
            name, baudrate=baud, timeout=SLICE_S, write_timeout=WRITE_S, exclusive=None if url else True
        )
    except Exception as error:  # the drivers behind odd ports and URLs raise what they like
        raise _why_not(name, error) from error


def _no_pyserial(error: ImportError) -> DeviceError:
    return DeviceError(f"pyserial cannot be imported ({error}); pip install --force-reinstall pyserial")


def _why_not(name: str, error: Exception) -> DeviceError:
    """Say in one line why a port cannot be opened and what would help."""
    match getattr(error, "errno", None):
        case errno.ENOENT | errno.ENXIO | errno.ENODEV:
            there = ", ".join(sorted(device for device, _ in ports())) or "none"
            return DeviceError(f"there is no port {name} for the pan-tilt unit; serial ports here: {there}")
        case errno.EACCES | errno.EPERM:
            return NoPermissionError(
                f"no permission to use {name}; add yourself to the group that owns it, often dialout, and log in anew"
            )
        case errno.EBUSY | errno.EAGAIN:
            return InUseError(f"{name} is in use by another program")
    if name.startswith("socket://"):
        return DeviceError(f"cannot connect to the pan-tilt unit at {name}: {error}")
    return DeviceError(f"cannot open {name} as a serial port: {error}")
