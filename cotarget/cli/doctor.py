"""Check versions, rendering and devices, and print the command that fixes what is missing: `cotarget doctor`."""

import argparse

from cotarget.cli.common import add_file

WORDS = {True: "ok     ", None: "unknown", False: "MISSING"}  # of the doctor's findings


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_file(parser, "--rig", "rig.toml: check its devices too, without moving them")


def run(options: argparse.Namespace) -> int:
    """Check the installation and print fixes; return the exit status."""
    from cotarget.doctor import examine

    config = None
    if options.rig is not None:
        from cotarget.backends import load_config

        config = load_config(options.rig)
    findings = examine(config) if options.rig is None else examine(config, options.rig)
    for finding in findings:
        print(f"{WORDS[finding.ok]}  {finding.name}: {finding.text}")
        if finding.fix:
            print(f"         fix: {finding.fix}")
    return 1 if any(finding.ok is False for finding in findings) else 0
