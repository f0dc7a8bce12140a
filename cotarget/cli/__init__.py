"""The commands: `cotarget COMMAND`."""

from cotarget.cli.main import main

__all__ = ["main"]
