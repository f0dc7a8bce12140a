"""Files that are either the old one or the new one, never half of one."""

from pathlib import Path

from cotarget.errors import CalibrationError, ConfigError
from cotarget.outputs import write_whole


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file's content in one step, also when the program or the power fails half-way.

    Raises:
        CalibrationError: the file cannot be written, or another run is writing it.
    """
    try:
        write_whole(path, data)
    except ConfigError as error:
        raise CalibrationError(str(error)) from None
