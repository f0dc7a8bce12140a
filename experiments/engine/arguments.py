"""What the experiments' commands share: mistakes in their options end before the work."""

import os
from pathlib import Path

from cotarget.errors import ConfigError


def check_folder(out: Path) -> None:
    """Refuse a folder for results that cannot be made or written to, before the work and not after it.

    Raises:
        ConfigError: it, or what it would be in, is a file or may not be written to.
    """
    there = next(path for path in (out.absolute(), *out.absolute().parents) if os.path.lexists(path))
    if not there.is_dir():
        raise ConfigError(f"--out: {there} is no folder; name one that is, or that can be made")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(f"--out: {there} may not be written to; name another folder")
