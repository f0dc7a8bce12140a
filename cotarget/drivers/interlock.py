"""Locks of the hardware rig: one program at a time, and no motion of a head whose position may be lost.

`rig_lock` refuses a second program before either one blames the devices for the other's commands, by the head's address
and by the rig.toml.

`PositionLostMarker` stores from one program to the next that the position of a PTU-D46 may be lost. A unit that hit a
limit, stalled or was switched off goes on counting from a wrong position, and no later answer shows it: its limits, and
the soft limits inside them, are off by the loss. The marker is a file that stays until the unit has found its limits
again. One lies beside the rig's stop file and applies to every head of the rig, because a serial adapter may come back
at another port. Another in the user's state folder applies to the unit at its port, whatever rig.toml names it.
"""

import contextlib
import errno
import hashlib
import ipaddress
import logging
import re
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

from cotarget.drivers.link_errors import InUseError
from cotarget.errors import DeviceError
from cotarget.safety.stop_file import state_folder

log = logging.getLogger(__name__)
SUFFIX = ".position-lost"
WITHOUT_STOP_FILE = "head"  # in the state folder
NO_REASON = "the position of a pan-tilt unit may be lost; see that it is free, then run cotarget reset-head"
LONGEST_NAME, LONGEST_REASON = 100, 500  # port in the file's name, reason in messages [characters]


class PositionLostMarker:
    """Marker file for the lost position of the unit at a port.

    Args:
        port: port of the unit.
        stop_file: stop file of the rig; None where it has none.

    Attributes:
        file: path of the marker beside the stop file; that in the user's state folder where there is no stop file.
    """

    def __init__(self, port: str, stop_file: Path | None) -> None:
        self._has_lasting_port = not port.startswith("/dev/pts/")  # another emulator gets a pseudo-terminal's name
        lasting = [each for each in _identities(port) if not each.startswith("/")]  # another unit may get that name
        names = [re.sub(r"[^A-Za-z0-9.]+", "-", each).strip("-")[-LONGEST_NAME:] for each in (port, *lasting)]
        without = state_folder() / WITHOUT_STOP_FILE
        beside = without if stop_file is None else stop_file.absolute()
        self._folder, self._begin = beside.parent, f"{beside.name}."
        self.file = self._folder / f"{self._begin}{names[0]}{SUFFIX}"
        # Units without an address would share a name.
        self._of_port = [without.with_name(f"{without.name}.{name}{SUFFIX}") for name in dict.fromkeys(names) if name]

    def files(self) -> list[Path]:
        """List the markers for any unit of this rig, and for the unit at this port.

        Raises:
            DeviceError: the folder of markers cannot be read.
        """
        try:
            files = sorted(self._folder.iterdir())
        except (FileNotFoundError, NotADirectoryError):
            files = []
        except OSError as error:
            raise DeviceError(
                f"{self._folder}: cannot be read, where it would say that the head's position is lost: {error.strerror}"
            ) from None
        found = [file for file in files if file.name.startswith(self._begin) and file.name.endswith(SUFFIX)]
        return [*found, *(file for file in self._of_port if file.exists())]

    def refuse(self) -> None:
        """Raise if there is a marker for any unit of this rig, or for the unit at this port.

        Raises:
            DeviceError: a marker exists; the message has its reason, and the remedy.
        """
        for file in self.files():
            raise DeviceError(f"{_reason(file)} (or, where no unit is at that port any more, remove {file})")

    def note(self, reason: str) -> None:
        """Write the markers; a failure is logged."""
        for file in dict.fromkeys((self.file, *self._of_port) if self._has_lasting_port else (self.file,)):
            try:
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(f"{reason}\n", encoding="utf-8")
            except OSError as error:
                log.error(
                    "%s: cannot be written (%s), so that the next program will not know: %s",
                    file,
                    error.strerror,
                    reason,
                )

    def forget(self) -> None:
        """Remove the unit's markers after a reset.

        Raises:
            DeviceError: the file cannot be removed.
        """
        for file in (self.file, *self._of_port):
            try:
                file.unlink(missing_ok=True)
            except NotADirectoryError:
                continue
            except OSError as error:
                raise DeviceError(f"{file}: cannot be removed, though the unit was reset: {error.strerror}") from None


def _reason(file: Path) -> str:
    """Read a marker's reason as one line."""
    try:
        said = file.read_text(encoding="utf-8", errors="replace")
    except OSError:
        said = ""
    return "".join(c if c.isprintable() else " " for c in said.strip())[:LONGEST_REASON] or NO_REASON


ADDRESS_KEYS = ("port", "host", "url", "address")  # of settings that say where a device is


def addresses_of(settings: object) -> tuple[str, ...]:
    """Return the addresses in a device's settings: a serial port, HOST, HOST:PORT or a URL; the first is its own.

    They are what the keys `port`, `host`, `url` and `address` hold, and what is an address by its form: an IP address,
    a path in /dev, or a URL. A number in `port` is the port of that host. Settings may say it by a property `address`.
    """
    number = getattr(settings, "port", "")
    port = str(number) if str(number).isdigit() and int(number) else ""
    found = [] if "address" in vars(settings) else [str(getattr(settings, "address", ""))]
    for key, value in vars(settings).items():
        if not isinstance(value, str) or not value or (key == "port" and value.isdigit()):
            continue
        if (is_ip := _is_ip(value)) or key in ADDRESS_KEYS or "://" in value or value.startswith("/dev/"):
            is_host = "://" not in value and "/" not in value and key != "port"
            host = f"[{value}]" if is_ip and ":" in value else value  # version 6
            found.append(f"{host}:{port}" if is_host and port else host)
    return tuple(dict.fromkeys(filter(None, found)))


def _is_ip(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


# Ports that a URL may leave out.
DEFAULT_PORTS = (None, 80, 443)


def _identities(address: str) -> list[str]:
    """List names of a device that are equal however its address is written.

    Args:
        address: a serial port, HOST, HOST:PORT or a URL.

    Returns:
        The resolved path of a port that exists. One name for each IP address of the host, with its port and path; all
        addresses of this machine are one. Empty for a port that does not exist, which needs no name.
    """
    if "://" not in address and (address.startswith("/") or Path(address).exists()):
        return [str(Path(address).resolve())] if Path(address).exists() else []
    try:
        url = urlsplit(address if "://" in address else f"//{address}")
        host, port = url.hostname, url.port
    except ValueError:  # a URL of another form
        return [address]
    if not host:
        return []
    try:
        found = {str(each[4][0]) for each in socket.getaddrinfo(host, None)}
    except (OSError, UnicodeError):  # the device cannot be opened by this name
        found = {host}
    end = ("" if port in DEFAULT_PORTS else f":{port}") + url.path.rstrip("/") + (url.query and f"?{url.query}")
    return sorted({("localhost" if _is_own(each) else each) + end for each in found})


def _is_own(address: str) -> bool:
    """Whether an IP address is one of this machine."""
    try:
        with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM) as tried:
            tried.bind((address, 0))
    except OSError:
        return False
    return True


@contextlib.contextmanager
def rig_lock(*addresses: str, file: Path | None = None) -> Iterator[None]:
    """Lock a rig by its head and its file; the lock ends with the block, or with the process in any way.

    The lock is an abstract socket name, which Linux gives to one socket of a machine at a time. On other systems, and
    between containers, only the ports and cameras themselves refuse a second program.

    Args:
        addresses: of the pan-tilt unit: a serial port, HOST, HOST:PORT or a URL.
        file: the rig.toml; None for a rig without one.

    Raises:
        InUseError: another program, or this one, has the lock.
    """
    names = {name: f"the rig with the pan-tilt unit at {each}" for each in addresses for name in _identities(each)}
    if file is not None:
        names[f"file {file.resolve()}"] = f"the rig of {file}"
    with contextlib.ExitStack() as locks:
        for name, rig in names.items() if sys.platform.startswith("linux") else ():
            lock = locks.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
            try:
                lock.bind(f"\0cotarget rig {hashlib.sha256(name.encode()).hexdigest()}")
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    raise InUseError(f"{rig} is open already, here or in another program; end that first") from None
        yield
