"""Runs all experiments that need no photos, one after the other; fails where one of them misses a figure.

python -m experiments [--quick] [--out DIR]
"""

import argparse
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

EXPERIMENTS = (
    *("hand_eye", "chain", "random_rigs", "mismatch", "honesty", "speed", "pointing", "zoom_range", "wire"),
    *("hold", "first_shot", "delay", "five_targets", "dead_zone", "sim_speed", "pipeline_speed"),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m experiments", description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few seeds of each only")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write each one's files into a folder of its own there")
    given = parser.parse_args(arguments)
    failed = []
    for name in EXPERIMENTS:
        passed_on = ["--quick"] if given.quick else []
        if given.out is not None:
            passed_on += ["--out", str(given.out / name)]
        print(f"\n{name}")
        module = importlib.import_module(f"experiments.{name}")
        film: Path | None = getattr(module, "FILM", None)
        if film is not None and not film.is_file():
            print(f"left out: needs {film}, which is not part of the project")
        elif module.EXPERIMENT.main(passed_on):
            failed.append(name)
    if failed:
        print(f"\nnot what is wanted: {', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
