"""Command-line interface: `cotarget COMMAND`."""

from cotarget.cli.main import main

__all__ = ["main"]
