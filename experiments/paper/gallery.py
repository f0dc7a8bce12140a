"""Copy the pictures of the documentation from results, as JPEGs small enough for the repository.

docs/results.md states the number of seeds beside each table; hold and single_ptz have more than in a full run.

python -m experiments.paper.gallery [NAME ...] [--results experiments-out] [--out docs/pictures]
"""

import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from cotarget.cli.main import Parser
from cotarget.errors import ConfigError, CotargetError, choices
from cotarget.files import write_atomically
from experiments.command import OUT
from experiments.paper.paper_loop import WAYS, picture_name
from experiments.report import FIGURE

PROGRAM = "python -m experiments.paper.gallery"
PICTURES = Path(__file__).resolve().parents[2] / "docs" / "pictures"
WIDEST_PX = 1280
QUALITY = 85


@dataclass(frozen=True)
class Shown:
    """Picture of the documentation."""

    experiment: str  # name of the experiment that makes it
    picture: str  # name of its file among the results, without suffix
    name: str  # name of its file in docs/pictures, without suffix


SHOWN = (
    *(
        Shown(experiment, picture_name(figure, way), picture_name(figure, way))
        for experiment, figure in (("fig4_book", "fig4"), ("fig5_person", "fig5"), ("fig6_outdoors", "fig6"))
        for way in WAYS
    ),
    *(Shown(name, FIGURE, name) for name in ("hold", "delay", "five_targets", "models", "shortcut", "single_ptz")),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    parser = Parser(prog=PROGRAM, description=(__doc__ or "").splitlines()[0])
    names = tuple(dict.fromkeys(each.experiment for each in SHOWN))
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"experiments whose pictures; all of {choices(names)}")
    parser.add_argument("--results", type=Path, default=OUT, metavar="DIR", help=f"their folder ({OUT})")
    parser.add_argument("--out", type=Path, default=PICTURES, metavar="DIR", help="for the pictures")
    given = parser.parse_args(arguments)
    try:
        if unknown := sorted(set(given.names) - set(names)):
            raise ConfigError(f"'{unknown[0]}' is not one of: {choices(names)}")
        for path in gather(given.results, given.out, given.names or names):
            print(f"{path}  {path.stat().st_size // 1024} kB")
    except CotargetError as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return 1
    return 0


def gather(results: Path, out: Path, names: Collection[str]) -> list[Path]:
    """Write all pictures of some experiments that the documentation shows, and name the files; on an error, none.

    Raises:
        ConfigError: a picture is missing, cannot be read or cannot be written.
    """
    shown = [each for each in SHOWN if each.experiment in names]
    files = {out / f"{each.name}.jpg": _jpeg(results / each.experiment / f"{each.picture}.png") for each in shown}
    out.mkdir(parents=True, exist_ok=True)
    for path, data in files.items():
        write_atomically(path, data)
    return list(files)


def _jpeg(path: Path) -> bytes:
    """Convert a PNG to a JPEG no wider than a page shows.

    Raises:
        ConfigError: the file is missing or cannot be read.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; --results names the folder of their results") from None
    image = (
        cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION) if data else None
    )
    if image is None:
        raise ConfigError(f"{path} is no picture; run its experiment again, with --fresh")
    height, width = image.shape[:2]
    if width > WIDEST_PX:
        size = (WIDEST_PX, round(height * WIDEST_PX / width))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))[1].tobytes()


if __name__ == "__main__":
    sys.exit(main())
