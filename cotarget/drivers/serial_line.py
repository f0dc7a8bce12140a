"""Serial lines by pyserial: list and open ports, exchange bytes, and name in one line why that fails.

`SerialLine` is what all protocols share: bytes to and from a port, in a bounded time. A protocol adds its messages.
"""

import contextlib
import errno
import re
import select
from typing import TYPE_CHECKING

from cotarget.drivers.link_errors import InUseError, LostError, NoPermissionError
from cotarget.errors import ConfigError, DeviceError
from cotarget.rig import Clock

if TYPE_CHECKING:
    import serial

SLICE_S = 0.01  # timeout of one read; a longer wait checks its deadline with this period [s]
WRITE_S = 0.5  # a line that takes no bytes for this time is dead [s]
BITS = 10  # per byte on the wire, 8N1
HEARD = 200  # received bytes kept for error messages


class SerialLine:
    """Bytes to and from a unit; used by one thread at a time.

    Every method but `close` raises LostError where the port failed.

    Args:
        port: an open port whose reads return empty after a short while.
        name: name of the port, for error messages.
        baud: baud rate, also of the serial line behind a terminal server.
        clock: the rig's clock.

    Attributes:
        byte_s: time of one byte on the wire [s].
        heard: the last received bytes, of any kind.
    """

    def __init__(self, port: "serial.Serial", name: str, baud: int, clock: Clock) -> None:
        self._port, self._clock = port, clock
        self.name, self.baud = name, baud
        self.byte_s = BITS / baud
        self.heard = b""

    def write(self, data: bytes) -> None:
        """Send bytes without waiting for an answer."""
        import serial

        try:
            self._port.write(data)
        except serial.SerialTimeoutException as error:
            # The time of a suspended program counts, though the bytes are sent; a line that takes more is not lost.
            if not select.select([], [self._port], [], 0)[1]:
                raise LostError(self.name, error) from error
        except OSError as error:  # pyserial's exceptions are of this kind too
            raise LostError(self.name, error) from error

    def read(self, wait: bool = True) -> bytes:
        """Read the bytes that have arrived; if there are none, wait for the first one until the port's timeout."""
        try:
            there = self._port.in_waiting
            data = self._port.read(max(there, 1)) if there or wait else b""
        except OSError as error:  # in_waiting raises the system's errors, read and write pyserial's
            raise LostError(self.name, error) from error
        self.heard = (self.heard + data)[-HEARD:]
        return data

    def read_until_quiet(self, quiet_s: float, most_s: float) -> bytes:
        """Read until ``quiet_s`` of silence or for ``most_s`` [s]."""
        start = last = self._clock.now()
        data = b""
        while (now := self._clock.now()) - last < quiet_s and now - start < most_s:
            if more := self.read():
                data, last = data + more, self._clock.now()
        return data

    def close(self) -> None:
        """Release the port."""
        # pyserial leaves a socket open if the other side closed first.
        socket = getattr(self._port, "_socket", None)
        with contextlib.suppress(OSError):
            self._port.close()
        if socket is not None:
            socket.close()


def ports() -> list[tuple[str, str]]:
    """List this machine's serial ports: name and description of each."""
    from serial.tools import list_ports

    return [(port.device, port.description) for port in list_ports.comports()]


def open_port(name: str, baud: int) -> "serial.Serial":
    """Open a port by pyserial's name or URL of it.

    Raises:
        ConfigError: the name is empty.
        DeviceError: the port cannot be opened.
    """
    if not name:
        raise ConfigError("hardware.head.port: names no port, such as /dev/ttyUSB0 or socket://host:4000")
    import serial

    url = "://" in name
    try:
        # Exclusive: two programs on one port would read each other's answers.
        return serial.serial_for_url(
            name, baudrate=baud, timeout=SLICE_S, write_timeout=WRITE_S, exclusive=None if url else True
        )
    except Exception as error:  # pyserial's handlers of URLs raise exceptions of many types
        raise _why_not(name, error) from error


def _why_not(name: str, error: Exception) -> DeviceError:
    """Make the error for a port that cannot be opened, with a remedy."""
    match getattr(error, "errno", None):
        case errno.ENOENT | errno.ENXIO | errno.ENODEV:
            there = ", ".join(sorted(device for device, _ in ports())) or "none"
            return DeviceError(f"there is no port {name} for the pan-tilt unit; serial ports here: {there}")
        case errno.EACCES | errno.EPERM:
            return NoPermissionError(
                f"no permission to use {name}; add yourself to the group that owns it, often dialout, and log in again"
            )
        case errno.EBUSY | errno.EAGAIN:
            return InUseError(f"{name} is in use by another program")
    if name.startswith("socket://"):
        if not re.fullmatch(r"socket://[^/]+:\d+", name):
            return DeviceError(f"hardware.head.port: '{name}' is no address; write socket://HOST:PORT")
        return DeviceError(f"cannot connect to the pan-tilt unit at {name}: {error}")
    return DeviceError(f"cannot open {name} as a serial port: {error}")
