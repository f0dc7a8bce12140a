"""Runs all experiments that need no photos, one after the other.

python -m experiments [--quick] [--out DIR]
"""

import argparse
import importlib
import sys
from pathlib import Path

EXPERIMENTS = (
    *("hand_eye", "chain", "random_rigs", "mismatch", "honesty", "speed", "pointing", "zoom_range", "wire"),
    *("hold", "first_shot", "delay", "five_targets", "dead_zone", "sim_speed", "env_score", "env_speed"),
)


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m experiments", description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few seeds of each only")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write each one's files into a folder of its own there")
    given = parser.parse_args()
    for name in EXPERIMENTS:
        arguments = ["--quick"] if given.quick else []
        if given.out is not None:
            arguments += ["--out", str(given.out / name)]
        print(f"\n{name}")
        importlib.import_module(f"experiments.{name}").EXPERIMENT.main(arguments)
    return 0


if __name__ == "__main__":
    sys.exit(main())
