"""Serial ports by pyserial: list and open them, and name in one line why a port cannot be opened."""

import errno
from typing import Protocol

from cotarget.errors import ConfigError, DeviceError

SLICE_S = 0.01  # timeout of one read; a longer wait checks its deadline with this period [s]
WRITE_S = 0.5  # a line that takes no bytes for this time is dead [s]


class InUseError(DeviceError):
    """Another program uses the device."""


class NoPermissionError(DeviceError):
    """This user has no permission to use the device."""


class Port(Protocol):
    """The part of pyserial's ports that the drivers use."""

    @property
    def in_waiting(self) -> int:
        """Number of bytes that can be read without waiting."""

    def read(self, size: int = 1, /) -> bytes:
        """Read bytes, waiting until the port's own timeout."""

    def write(self, data: bytes, /) -> int | None:
        """Send bytes."""

    def close(self) -> None:
        """Release the port."""


def ports() -> list[tuple[str, str]]:
    """List this machine's serial ports: name and description of each.

    Raises:
        DeviceError: pyserial is missing.
    """
    try:
        from serial.tools import list_ports
    except ImportError as error:
        raise _no_pyserial(error) from error
    return [(port.device, port.description) for port in list_ports.comports()]


def open_port(name: str, baud: int) -> Port:
    """Open a port by pyserial's name or URL of it.

    Raises:
        ConfigError: the name is empty.
        DeviceError: the port cannot be opened.
    """
    if not name:
        raise ConfigError("hardware.head.port: names no port, such as /dev/ttyUSB0 or socket://host:4000")
    try:
        import serial
    except ImportError as error:
        raise _no_pyserial(error) from error
    url = "://" in name
    try:
        # Exclusive: two programs on one port would read each other's answers.
        return serial.serial_for_url(
            name, baudrate=baud, timeout=SLICE_S, write_timeout=WRITE_S, exclusive=None if url else True
        )
    except Exception as error:  # pyserial's handlers of URLs raise exceptions of many types
        raise _why_not(name, error) from error


def _no_pyserial(error: ImportError) -> DeviceError:
    return DeviceError(f"pyserial cannot be imported ({error}); pip install --force-reinstall pyserial")


def _why_not(name: str, error: Exception) -> DeviceError:
    """Make the error for a port that cannot be opened, with a remedy."""
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
