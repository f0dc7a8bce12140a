"""Where a camera is, as gphoto2 must be told it, and whether it can be there."""

import difflib
import os
import re
import socket
from collections.abc import Iterable
from pathlib import Path

from cotarget.errors import ConfigError, DeviceError

# PTP/IP's own TCP port (CIPA DC-005), for commands and events alike.
NETWORK_PORT, HIGHEST_PORT = "15740", 65535
NETWORK = re.compile(r"ptpip:([^:\s]+)(?::(\d+))?(?::(\d+))?", re.ASCII)
LISTENING_S = 2.5  # as long as libgphoto2 waits
USB = re.compile(r"usb:(?:(\d+),(\d+))?", re.ASCII)


def full_port(port: str) -> str:
    """A port as gphoto2 must be told it: of network cameras the address, and both TCP ports.

    Raises:
        ConfigError: it is no port of gphoto2, or its host is unknown.
    """
    if USB.fullmatch(port):
        return port
    match = NETWORK.fullmatch(port)
    if match is None:
        raise ConfigError(f"hardware.zoom.port: '{port}' is not like usb:, usb:001,005 or ptpip:host:port:port")
    host, commands, events = match[1], match[2] or NETWORK_PORT, match[3] or match[2] or NETWORK_PORT
    if max(int(commands), int(events)) > HIGHEST_PORT:
        raise ConfigError(f"hardware.zoom.port: '{port}' has a TCP port above {HIGHEST_PORT}")
    try:
        address = socket.getaddrinfo(host, None, socket.AF_INET)[0][4][0]  # gphoto2 knows no names
    except (OSError, UnicodeError) as error:
        raise ConfigError(f"hardware.zoom.port: there is no host '{host}' in '{port}'") from error
    # Without a second port gphoto2 would take the usual one for events, whatever the first is.
    return f"ptpip:{address}:{commands}:{events}"


def check_listening(port: str) -> None:
    """Refuse a port where nobody listens, before libgphoto2 does so with lines of its own on stderr.

    Raises:
        DeviceError: nobody listens there.
    """
    _, address, commands, _ = port.split(":")
    try:
        socket.create_connection((address, int(commands)), LISTENING_S).close()
    except OSError as error:
        raise DeviceError(f"hardware.zoom.port: no camera listens at '{port}': {error.strerror or error}") from error


def check_permission(port: str) -> None:
    """Refuse a camera on USB that belongs to another user: gphoto2 would speak of a general I/O error.

    Raises:
        DeviceError: with what to do.
    """
    match = USB.fullmatch(port)
    device = Path("/dev/bus/usb", *(match.groups() if match else ()))
    if device.is_char_device() and not os.access(device, os.R_OK | os.W_OK):
        raise DeviceError(
            f"hardware.zoom.port: no permission to use {device}; add yourself to its group (ls -l {device}), "
            "or a udev rule as of libgphoto2's print-camera-list"
        )


def shortened(names: Iterable[str], wanted: str, most: int = 12) -> str:
    """Valid choices for the end of a message, those most like what was wanted first: cameras have a hundred."""
    names = sorted(set(names))
    near = [name for name in names if wanted.lower() in name.lower()]
    near += difflib.get_close_matches(wanted, names, n=most, cutoff=0.4)
    shown = list(dict.fromkeys([*near, *names]))[:most]
    more = len(names) - len(shown)
    return (", ".join(shown) or "none") + (f" and {more} more" if more else "")
