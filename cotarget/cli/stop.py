"""Stop every rig that this user has open, and the folder's: `cotarget stop --reason "someone on the roof"`."""

import argparse
import sys

from cotarget.cli.common import RIG, add_file
from cotarget.errors import ConfigError, DeviceError


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_file(parser, "--rig", f"rig.toml of the only rig to stop (every open rig of this user, and {RIG})")
    about = "reason, which every stopped program reports"
    parser.add_argument("--reason", default="stopped by the operator", metavar="TEXT", help=about)


def run(options: argparse.Namespace) -> int:
    """Write the stop files, each whatever becomes of the others; return the exit status."""
    from cotarget.safety.stop_file import find_stop_file, same_place, watched_stop_files, write_stop_file

    # A reason that is no text must not keep the stop from being written.
    reason = options.reason.encode(errors="surrogateescape").decode(errors="replace")
    watched, wrong, written = watched_stop_files(), list[str](), 0
    paths = {} if options.rig else {place: place for place in watched}
    try:
        if options.rig or RIG.exists():
            path = find_stop_file(options.rig or RIG)
            paths[same_place(path)] = path
    except ConfigError as error:
        wrong.append(str(error))
    for place, path in paths.items():
        try:
            write_stop_file(path, reason)
        except DeviceError as error:
            wrong.append(str(error))
            continue
        written += 1
        print(f"stopped: no head that watches {path} moves until cotarget clear")
        if place not in watched:
            print(f"cotarget stop: no program of this user watches {path} now", file=sys.stderr)
    if not written:
        raise DeviceError("; ".join(wrong) or f"no program of this user has a rig open, and there is no {RIG} here")
    for line in wrong:
        print(f"cotarget stop: {line}", file=sys.stderr)
    return int(written < len(paths))
