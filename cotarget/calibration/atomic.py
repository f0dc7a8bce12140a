"""Files that are either the old one or the new one, never half of one."""

import contextlib
import os
from pathlib import Path

from cotarget.errors import CalibrationError


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file's content in one step, also when the program or the power fails half-way.

    Raises:
        CalibrationError: the file cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise CalibrationError(f"{path}: cannot be written: {error.strerror}") from None
        raise
