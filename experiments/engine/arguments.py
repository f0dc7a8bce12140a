"""Checks of command-line options that end before the work starts."""

import os
from pathlib import Path

from cotarget.errors import ConfigError


def check_folder(out: Path) -> None:
    """Refuse a results folder that cannot be made or written, before the work starts.

    Raises:
        ConfigError: the folder or one of its parents is a file, or is not writable.
    """
    there = next(path for path in (out.absolute(), *out.absolute().parents) if os.path.lexists(path))
    if not there.is_dir():
        raise ConfigError(f"--out: {there} is no folder; name one that is, or that can be made")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(f"--out: {there} may not be written to; name another folder")
