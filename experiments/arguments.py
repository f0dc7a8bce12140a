"""What the experiments' commands share: mistakes end in one line, and before the work."""

import argparse
import os
from pathlib import Path
from typing import NoReturn

from cotarget.errors import ConfigError

USAGE = 2  # exit status of wrong arguments


class Parser(argparse.ArgumentParser):
    """A parser whose mistakes end in one line."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, without the usage in front of it."""
        self.exit(USAGE, f"{self.prog}: {message}; see {self.prog} --help\n")


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
