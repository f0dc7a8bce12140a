"""Keeps a second program from a rig that one already has, before either would blame the devices for the other.

Remembers from one program to the next that the position of a PTU-D46 may be lost.

A unit that hit a limit, stalled or was switched off goes on counting from a wrong position, and nothing that it says
later tells: its limits, and the soft ones inside them, are off by what was lost. So a file says it until the unit has
found its limits anew. It lies beside the rig's stop file, or else in the user's state folder, and it concerns every
head there, so that a unit which comes back at another port, as adapters do, is not trusted either.
"""

import contextlib
import errno
import hashlib
import logging
import os
import re
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

from cotarget.drivers.serial_line import InUseError
from cotarget.errors import DeviceError

log = logging.getLogger(__name__)
SUFFIX = ".position-lost"
STATE_HOME, STATE_HOME_DEFAULT = "XDG_STATE_HOME", "~/.local/state"  # by the XDG base directory specification
WITHOUT_STOP_FILE = Path("cotarget") / "head"  # below that
NO_REASON = "the position of a pan-tilt unit may be lost; see that it is free, then run cotarget reset-head"
LONGEST_NAME, LONGEST_REASON = 100, 500  # characters of a port's name in a file's, and of a reason that is shown


class PositionLostError(DeviceError):
    """Where the unit is nobody knows, whatever it says, until it was reset."""

    def __init__(self, name: str, what: str) -> None:
        super().__init__(f"the pan-tilt unit at {name} {what}; see that it is free, then run cotarget reset-head")


class PositionLostMarker:
    """What is remembered of the unit at a port.

    Args:
        port: the unit's.
        stop_file: of the rig; None where it has none.
    """

    def __init__(self, port: str, stop_file: Path | None) -> None:
        beside = _state_home() / WITHOUT_STOP_FILE if stop_file is None else stop_file
        self._folder, self._begin = beside.parent, f"{beside.name}."
        name = re.sub(r"[^A-Za-z0-9.]+", "-", port).strip("-")[-LONGEST_NAME:]
        self.file = self._folder / f"{self._begin}{name}{SUFFIX}"

    def refuse(self) -> None:
        """Raise while the position of any unit that this rig may have is not to be trusted.

        Raises:
            DeviceError: with the reason, and what ends it.
        """
        try:
            files = sorted(self._folder.iterdir())
        except (FileNotFoundError, NotADirectoryError):
            return
        except OSError as error:
            raise DeviceError(
                f"{self._folder}: cannot be read, where it would say that the head's position is lost: {error.strerror}"
            ) from None
        for file in files:
            if file.name.startswith(self._begin) and file.name.endswith(SUFFIX):
                raise DeviceError(f"{_reason(file)} (or, where no unit is at that port any more, remove {file})")

    def note(self, reason: str) -> None:
        """Remember it; where that fails the log says so."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self.file.write_text(f"{reason}\n", encoding="utf-8")
        except OSError as error:
            log.error("%s: cannot be written (%s), so that nobody will remember: %s", self.file, error.strerror, reason)

    def forget(self) -> None:
        """The unit was reset.

        Raises:
            DeviceError: the file cannot be removed.
        """
        try:
            self.file.unlink(missing_ok=True)
        except NotADirectoryError:
            return
        except OSError as error:
            raise DeviceError(f"{self.file}: cannot be removed, though the unit was reset: {error.strerror}") from None


def _state_home() -> Path:
    return Path(os.environ.get(STATE_HOME) or STATE_HOME_DEFAULT).expanduser()


def _reason(file: Path) -> str:
    """What a file says, as one line."""
    try:
        said = file.read_text(encoding="utf-8", errors="replace")
    except OSError:
        said = ""
    return "".join(c if c.isprintable() else " " for c in said.strip())[:LONGEST_REASON] or NO_REASON


@contextlib.contextmanager
def rig_lock(port: str) -> Iterator[None]:
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
