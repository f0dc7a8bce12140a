"""End an emergency stop, when it is safe to move: `cotarget clear --rig rig.toml`."""

import argparse

from cotarget.cli.common import add_file


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_file(parser, "--rig", "rig.toml", required=True)


def run(options: argparse.Namespace) -> None:
    """Remove the stop file."""
    from cotarget.safety.stop_file import clear_stop_file, find_stop_file

    path = find_stop_file(options.rig)
    reason = clear_stop_file(path)
    print(f"{path}: there was no stop" if reason is None else f"cleared: {reason}")
