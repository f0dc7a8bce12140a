"""Keeps a second program from a rig that one already has, before either would blame the devices for the other."""

import contextlib
import errno
import hashlib
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

from cotarget.hardware.serialport import InUseError


@contextlib.contextmanager
def claimed(port: str) -> Iterator[None]:
    """Have the rig whose pan-tilt unit is at a port to oneself; the claim ends with the process, however that ends.

    It is a name that Linux lets one socket of a machine have at a time. Elsewhere, and among containers, the ports and
    cameras themselves have to refuse a second program.

    Raises:
        InUseError: another program has it.
    """
    url = "://" in port
    if not sys.platform.startswith("linux") or not (url or Path(port).exists()):
        yield  # a port that is not there is nobody's
        return
    address = port if url else str(Path(port).resolve())
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as name:
        try:
            name.bind(f"\0cotarget rig {hashlib.sha256(address.encode()).hexdigest()}")
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                there = f"the rig with the pan-tilt unit at {port}"
                raise InUseError(f"another program has {there}; end it first") from None
        yield
