"""Parts that the commands share: argument types, checks of inputs and outputs, JSON output."""

import argparse
import dataclasses
import itertools
import json
import math
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from cotarget.errors import ConfigError, naming
from cotarget.files import STDOUT, behind_link, write_atomically

if TYPE_CHECKING:
    from cotarget.calibration import Calibration
    from cotarget.config import RigConfig
    from cotarget.rig import Rig, RigSpec
    from cotarget.track_metrics import Criterion, Label, Tracked


def load_plausible(path: Path, spec: "RigSpec | None" = None, *, insist: bool) -> "Calibration":
    """Load a calibration; refuse one that is implausible, by itself or for a rig, unless the user insists."""
    from cotarget.calibration import Calibration
    from cotarget.calibration.plausibility import check_plausible

    calibration = Calibration.load(path)
    if spec is not None:
        with naming(path):
            calibration.for_streams(spec.fixed.size, spec.zoom.size)
    check_plausible(calibration, spec, insist=insist, where=path)
    return calibration


def open_named(path: Path, config: "RigConfig", guarded: bool = True, partial: bool = False) -> "Rig":
    """Open the rig of a rig.toml, as `open_rig` does; the message of a ConfigError names the file."""
    from cotarget.backends import open_rig

    with naming(path):
        return open_rig(config, guarded, file=path, partial=partial)


def rig_files(rig: Path | None, config: "RigConfig") -> list[Path | None]:
    """List the files and folders that opening a rig reads: rig.toml and those that it names. None may be an output."""
    scene = Path(config.sim.scene)
    targets = config.targets.values()
    templates = [target.template for target in targets]
    networks = [target.network.model for target in targets if target.network is not None]
    own = scene if scene.is_file() else None
    return [rig, config.safety.stop_file, config.recording, own, *config.sim.models.values(), *templates, *networks]


def check_board_size(rig: Path, config: "RigConfig") -> None:
    """Refuse a board whose squares were given in millimetres, and a real one whose squares have no size in rig.toml.

    All lengths of a calibration are multiples of that size, so no later check can find it wrong.
    """
    from cotarget.config import check_square, read_tables

    if config.backend == "hardware" and "square" not in read_tables(rig).get("board", {}):
        raise ConfigError(
            f"{rig}: does not say how large the squares of your board are; measure ten of them, and say so in metres: "
            "[board] square = 0.025"
        )
    check_square(config.board.square, f"{rig}: board.square")


CONSENT = "yes"


def ask(consented: bool, question: str, refusal: str, out: TextIO | None = None) -> None:
    """Ask for consent, unless --yes has given it.

    Args:
        consented: whether it has.
        question: what is asked.
        refusal: what is not done without consent.
        out: takes the question; by default stdout, which a command with results there leaves to these.

    Raises:
        ConfigError: the answer is not yes, or there is none.
    """
    if consented:
        return
    print(f"{question} [yes/no]", file=out, flush=True)
    try:
        answer = sys.stdin.readline() if sys.stdin is not None else ""
    except (OSError, ValueError):  # closed terminal, closed file, or not text
        answer = ""
    if answer.strip().lower() != CONSENT:
        raise ConfigError(f"{refusal}; it needs the answer yes, or --yes")


# Results


def print_json(table: Any, csv: Path | None = None) -> None:
    """Print a result as JSON on stdout; on stderr if stdout has the table of --csv."""
    print(json.dumps(_positive_zeros(table), indent=2), file=sys.stderr if csv == STDOUT else sys.stdout)


def _positive_zeros(value: Any) -> Any:
    """Replace negative zeros by zeros, in nested values too."""
    if isinstance(value, dict):
        return {key: _positive_zeros(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_positive_zeros(item) for item in value]
    return value + 0.0 if isinstance(value, float) else value  # -0.0 + 0.0 is 0.0


def scores_of(
    file: Path | None,
    tracks: "Iterable[Tracked]",
    labels: "Mapping[int, Sequence[Label]] | None",
    rate_hz: float,
    frames: int,
    *,
    whole: bool = True,
    criterion: "Criterion | None" = None,
) -> dict[str, Any]:
    """Score tracks against the labels of a file, by frame; empty without labels.

    ``whole`` is false for a film that ends too early, whose last labels are then no sign of another film's.
    """
    from cotarget.track_metrics import Criterion, score_tracks

    if labels is None:
        return {}
    score = score_tracks(tracks, labels, rate_hz, frames, criterion=criterion or Criterion())
    warn_unscored(file, score.labels_beyond_end, score.labelled_frames, len(labels), frames - 1, whole=whole)
    return dataclasses.asdict(score)


def warn_unscored(file: Path | None, beyond: int, scored: int, labelled: int, last: int, *, whole: bool) -> None:
    """Warn on stderr of labelled frames beyond a film's last one, or if all are among the first, which do not count."""
    from cotarget.track_metrics import LEARNING_FRAMES

    if labelled and not beyond and not scored:
        print(f"{file}: nothing is scored; all labels are in the first {LEARNING_FRAMES} frames", file=sys.stderr)
    if beyond:
        print(
            f"{file}: {beyond} of {labelled} labelled frames are beyond the last one, {last}, and are not counted"
            f"{'; are the labels of another film?' if whole else ''}",
            file=sys.stderr,
        )


def warn_shortfall(film: Path, shortfall: str | None) -> None:
    """Warn on stderr of what a film lacks, if it is not whole."""
    if shortfall is not None:
        print(f"{film}: is not whole: {shortfall}; the results are of what there is", file=sys.stderr)


# Outputs


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[Path | None], folder: Path | None = None) -> None:
    """Refuse outputs that cannot be written or would destroy an input, before the long work starts.

    Args:
        outputs: files to write.
        inputs: files that are read, and folders whose contents must not change.
        folder: new folder to write, which may not contain any output.
    """
    taken = [os.path.realpath(path) for path in inputs if path is not None]
    for path in (folder, *outputs):
        if path is None:
            continue
        if path == STDOUT:
            raise ConfigError("-: stdout takes the table of --csv alone; name a file")
        goal = Path(os.path.realpath(path))
        if any(goal.is_relative_to(each) for each in taken):
            raise ConfigError(f"{path}: is read or written for something else too, or its folder is; give another name")
        taken.append(str(goal))
        if path is folder:
            continue
        if goal.exists() and not goal.is_file():
            raise ConfigError(f"{path}: is no file, which would be replaced; name the file to write")
        try:
            tempfile.TemporaryFile(dir=goal.parent).close()
        except OSError:
            raise ConfigError(f"{path}: its folder does not exist, or cannot be written to") from None


@contextmanager
def previous_kept(path: Path) -> Iterator[None]:
    """Keep an earlier output under another name while the block writes a new one; print that name.

    Both files are complete at every moment. If the block fails, the earlier file stays and the other name is removed.
    """
    kept = _second_name(behind_link(path))
    try:
        yield
    except BaseException:
        if kept is not None:
            kept.unlink(missing_ok=True)
        raise
    if kept is not None:
        print(f"{path}: the earlier one is kept as {kept}", file=sys.stderr)


def _second_name(path: Path) -> Path | None:
    """Copy a file under another name beside its own; None where there is no such file."""
    if not path.exists():
        return None
    numbered = (path.with_name(f"{path.stem}.previous-{n}{path.suffix}") for n in itertools.count(1))
    kept = next(name for name in numbered if not os.path.lexists(name))
    write_atomically(kept, path.read_bytes())
    return kept


# Options that several commands have, and their values

RIG = Path("rig.toml")  # the default of --rig
BOARD_KINDS = ("chessboard", "charuco")


def add_file(parser: argparse.ArgumentParser, name: str, about: str, metavar: str = "FILE", **more: Any) -> None:
    """Add an option or argument that names a file or folder."""
    parser.add_argument(name, type=Path, metavar=metavar, help=about, **more)


def add_rig(parser: argparse.ArgumentParser) -> None:
    """Add --rig of a command that needs a rig."""
    add_file(parser, "--rig", f"rig.toml ({RIG})", default=RIG)


def add_insist(parser: argparse.ArgumentParser) -> None:
    """Add the option that accepts implausible values."""
    parser.add_argument("--insist", action="store_true", help="accept what is far outside of anything plausible")


def check_within(option: str, value: float, bounds: tuple[float, float], whose: str, slack: float = 0.0) -> None:
    """Refuse an option's value outside a device's limits, with some slack because the limits are printed rounded.

    ``whose`` names the device and the unit, with `{}` in place of the limits.
    """
    low, high = bounds
    if not low - slack <= value <= high + slack:
        raise ConfigError(f"{option}: {value:g} is beyond {whose.format(f'{low:g} to {high:g}')}")


def focal_px_of(focal_mm: float, pitch_mm: float | None, bounds_px: tuple[float, float]) -> float:
    """Convert the value of --focal-mm to a nominal focal length [px] within the lens's bounds [px].

    Raises:
        ConfigError: the pixel's size is unknown, or the lens does not have that focal length.
    """
    if pitch_mm is None:
        raise ConfigError("--focal-mm: the size of a pixel is not known; `cotarget point` has --focal-px")
    check_within("--focal-mm", focal_mm, (bounds_px[0] * pitch_mm, bounds_px[1] * pitch_mm), "the lens's {} mm")
    return focal_mm / pitch_mm


def number(text: str) -> float:
    """Parse a finite number."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number") from None
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is not a finite number")
    return value


def positive(text: str) -> float:
    """Parse a finite number greater than zero."""
    value = number(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{text} is not greater than zero")
    return value


def duration(text: str) -> float:
    """Parse a number of seconds greater than zero; inf for no end."""
    return math.inf if text == "inf" else positive(text)


def ratio(text: str) -> float:
    """Parse a number above zero, up to one."""
    value = positive(text)
    if value > 1:
        raise argparse.ArgumentTypeError(f"{text} is greater than one")
    return value


def length(text: str) -> float:
    """Parse a number of at least zero; inf for any length."""
    value = math.inf if text == "inf" else number(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is less than zero")
    return value


def whole(lowest: int, highest: float = math.inf) -> Callable[[str], int]:
    """Make a parser of whole numbers between two limits."""

    def parse(text: str) -> int:
        if not (text.isdecimal() and lowest <= int(text) <= highest):
            raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from {lowest}{up_to}")
        return int(text)

    up_to = "" if math.isinf(highest) else f" to {highest:g}"
    return parse


port = whole(0, 65535)  # a TCP port; 0 stands for any free one


def board_corners(text: str) -> tuple[int, int]:
    """Parse a board's inner corners, such as 9x6."""
    columns, _, rows = text.partition("x")
    if not (columns.isdecimal() and rows.isdecimal() and int(columns) >= 3 and int(rows) >= 3):
        raise argparse.ArgumentTypeError(f"'{text}' is not like 9x6 (inner corners: columns x rows, 3 at least)")
    return int(columns), int(rows)
