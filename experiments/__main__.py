"""Runs all experiments that need no photos, or those named, one after the other; fails where one misses a figure.

python -m experiments [NAME ...] [--quick] [--out DIR]
"""

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

from cotarget.errors import ConfigError
from experiments.harness import INTERRUPTED, Parser, check_folder

EXPERIMENTS = (
    *("hand_eye", "chain", "random_rigs", "mismatch", "honesty", "speed", "pointing", "zoom_range", "wire"),
    *("hold", "first_shot", "delay", "five_targets", "dead_zone", "sim_speed", "pipeline_speed"),
    *("env_score", "env_speed"),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    parser = Parser(prog="python -m experiments", description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"which ones (all): {', '.join(EXPERIMENTS)}")
    parser.add_argument("--quick", action="store_true", help="less of each, as its own --help says")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write each one's files into a folder of its own there")
    given = parser.parse_args(arguments)
    if unknown := [name for name in given.names if name not in EXPERIMENTS]:
        parser.error(f"there is no experiment '{unknown[0]}'; there are {', '.join(EXPERIMENTS)}")
    try:
        if given.out is not None:
            check_folder(given.out)
        return _run(given.names or EXPERIMENTS, given.quick, given.out)
    except ConfigError as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        print("experiments: interrupted", file=sys.stderr)
        return INTERRUPTED


def _run(names: Sequence[str], quick: bool, out: Path | None) -> int:
    """Run them one after the other, up to one that is interrupted; the exit status."""
    failed = []
    for name in names:
        passed_on = ["--quick"] if quick else []
        if out is not None:
            passed_on += ["--out", str(out / name)]
        print(f"\n{name}")
        module = importlib.import_module(f"experiments.{name}")
        film: Path | None = getattr(module, "FILM", None)
        if film is not None and not film.is_file():
            print(f"left out: needs {film}, which is not part of the project")
        elif (status := module.EXPERIMENT.main(passed_on)) == INTERRUPTED:
            return INTERRUPTED
        elif status:
            failed.append(name)
    if failed:
        print(f"\nnot what is wanted: {', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
