"""Check versions, rendering and devices, and print the command that fixes what is missing: `cotarget doctor`."""

import argparse

from cotarget.cli.common import RIG, add_file

WORDS = {True: "ok     ", None: "unknown", False: "MISSING"}  # of the doctor's findings


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_file(parser, "--rig", f"rig.toml: check its devices too, without moving them ({RIG}, where there is one)")


def run(options: argparse.Namespace) -> int:
    """Check the installation and print fixes; return the exit status."""
    from cotarget.doctor import examine

    config, rig = None, options.rig or RIG
    if options.rig is not None or RIG.exists():
        try:
            from cotarget.backends import load_config

            config = load_config(rig)
        except ImportError:  # of a package that is missing, which is one of the findings
            pass
    findings = examine(config, rig)
    for finding in findings:
        print(f"{WORDS[finding.ok]}  {finding.name}: {finding.text}")
        if finding.fix:
            print(f"         fix: {finding.fix}")
    return 1 if any(finding.ok is False for finding in findings) else 0
