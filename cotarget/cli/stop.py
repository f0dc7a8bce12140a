"""Stop every head that watches the stop file of a rig.toml: `cotarget stop --reason "someone on the roof"`."""

import argparse

from cotarget.cli.common import add_rig


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_rig(parser)
    about = "reason, which every stopped program reports"
    parser.add_argument("--reason", default="stopped by the operator", metavar="TEXT", help=about)


def run(options: argparse.Namespace) -> None:
    """Write the stop file."""
    from cotarget.safety.stop_file import find_stop_file, write_stop_file

    path = find_stop_file(options.rig)
    # A reason that is no text must not keep the stop from being written.
    write_stop_file(path, options.reason.encode(errors="surrogateescape").decode(errors="replace"))
    print(f"stopped: no head that watches {path} moves until cotarget clear")
