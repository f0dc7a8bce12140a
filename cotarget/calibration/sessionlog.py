"""What a capture session leaves beside its images: what rig it was, by which versions, and what it was told to do.

session.json: schema; versions; config, the rig's whole configuration without passwords (null where none was given).
commands.jsonl: an object a line and a command, written before the next is given: t [s], when it was given; do; asked;
got. "turn" asks for pan and tilt [rad] and gets those that the head goes to; "zoom" asks for a focal length [px] and
gets the one that the lens goes to; "present" asks for the board at a pose, T_fixed_board, and gets null.
"""

import importlib.metadata
import json
import platform
from pathlib import Path
from typing import Any

from cotarget import __version__
from cotarget.calibration.atomic import write_atomically
from cotarget.config import RigConfig
from cotarget.errors import CalibrationError
from cotarget.recordformat import config_table

SCHEMA = 1
SESSION, COMMANDS = "session.json", "commands.jsonl"
VERSIONS = ("numpy", "scipy", "opencv-python-headless")  # of what found the corners and fits


def write_session(directory: Path, config: RigConfig | None) -> None:
    """Write session.json, and begin commands.jsonl.

    Raises:
        CalibrationError: a file cannot be written.
    """
    table = {
        "schema": SCHEMA,
        "versions": {"cotarget": __version__, "python": platform.python_version()}
        | {name: _version(name) for name in VERSIONS},
        "config": None if config is None else config_table(config),
    }
    write_atomically(directory / SESSION, json.dumps(table, indent=2).encode() + b"\n")
    write_atomically(directory / COMMANDS, b"")


def write_command(directory: Path, t: float, do: str, asked: Any, got: Any = None) -> None:
    """Append a command to commands.jsonl.

    Raises:
        CalibrationError: the file cannot be written.
    """
    path = directory / COMMANDS
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"t": t, "do": do, "asked": asked, "got": got}) + "\n")
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written: {error.strerror}") from None


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:  # another build of it
        return None
