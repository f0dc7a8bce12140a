"""Parts that the commands share: argument types, checks of outputs, progress, JSON output.

`Selection` turns the options --policy, --click and --track into a `TargetSelector`. `Reasons` counts the reasons
in a run's steps and picks those that a user must see.
"""

import argparse
import contextlib
import itertools
import json
import math
import os
import re
import statistics
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cotarget.errors import CalibrationError, ConfigError, choices
from cotarget.files import STDOUT, behind_link, write_atomically

if TYPE_CHECKING:
    from cotarget.calibration import Calibration
    from cotarget.config import RigConfig, TargetProfile
    from cotarget.pipeline import Step
    from cotarget.rig import Rig, RigSpec


# Names of `cotarget.control.selection`, which --help does not import; the paper's first.
POLICIES = ("first-come", "nearest-deadline", "most-served")


def add_selection(parser: argparse.ArgumentParser, default: str = POLICIES[0]) -> None:
    """Add the options that select the target to follow; ``default`` is named in the help."""
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--policy",
        choices=POLICIES,
        help="choice among several targets: the first until it disappears, the one that leaves first, or the order "
        f"that gives most of them a good close-up ({default})",
    )
    which.add_argument(
        "--click",
        type=number,
        nargs=2,
        metavar=("U", "V"),
        help="follow only the target at this pixel of the fixed image: the first confirmed track at or near it",
    )
    which.add_argument(
        "--track", type=count, metavar="N", help="follow only the track with this id, as in video and table"
    )


def add_insist(parser: argparse.ArgumentParser) -> None:
    """Add the option that accepts an implausible calibration."""
    parser.add_argument("--insist", action="store_true", help="accept what is far outside of anything plausible")


def load_plausible(path: Path, spec: "RigSpec | None" = None, *, insist: bool) -> "Calibration":
    """Load a calibration and refuse an implausible one.

    Args:
        path: calibration.json.
        spec: description of the rig in use; None where there is none.
        insist: whether to accept it all the same.

    Raises:
        CalibrationError: the file is malformed or implausible; the message names the file and the key.
        ConfigError: a stream has another aspect ratio than that calibrated.
    """
    from cotarget.calibration import load_calibration
    from cotarget.calibration.plausibility import implausibility

    calibration = load_calibration(path)
    if spec is not None:
        check_streams(path, calibration, spec)
    if not insist and (text := implausibility(calibration, spec)):
        raise CalibrationError(f"{path}: {text}; --insist uses it all the same")
    return calibration


def open_named(path: Path, config: "RigConfig", guarded: bool = True) -> "Rig":
    """Open the rig of a rig.toml.

    Raises:
        ConfigError: as by `open_rig`; the message names the file.
        DeviceError: a device could not be opened.
        EmergencyStopError: the stop file exists.
    """
    from cotarget.backends import open_rig

    try:
        return open_rig(config, guarded)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def check_streams(path: Path, calibration: "Calibration", spec: "RigSpec") -> None:
    """Refuse a calibration whose streams have another aspect ratio than the rig's.

    Raises:
        ConfigError: the aspect ratio differs; the message names the calibration's file.
    """
    try:
        calibration.for_streams(spec.fixed.size, spec.zoom.size)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def target_of(config: "RigConfig", name: str) -> "TargetProfile":
    """Look up the target of --target.

    Raises:
        ConfigError: the configuration has no such target.
    """
    try:
        return config.target(name)
    except ConfigError as error:
        raise ConfigError(f"--target: {error}") from None


class Selection:
    """Selector of the target by the options, and whether a matching track ever appeared.

    Attributes:
        selector: selects the track to follow.
    """

    def __init__(
        self, options: argparse.Namespace, size: tuple[int, int], recorded: "Mapping[str, Any] | None" = None
    ) -> None:
        """Read the options.

        Args:
            options: parsed arguments with the options of `add_selection`.
            size: (width, height) of the fixed camera's image [px].
            recorded: table of the selector of a recorded run, used where no option is given.

        Raises:
            ConfigError: the click is outside the fixed camera's image, or a recording's policy is unknown.
        """
        from cotarget.control.selection import POLICIES as MAKERS
        from cotarget.control.selection import make_selector

        self._expected = ""
        self._seen: set[int] = set()
        self._followed = False
        named = _selector_table_of(options)
        is_option, table = bool(named), named or recorded or {}
        if "click" in table:
            (u, v), name = table["click"], "--click" if is_option else "the recorded click"
            if not (-0.5 <= u <= size[0] - 0.5 and -0.5 <= v <= size[1] - 0.5):
                raise ConfigError(f"{name}: ({u:g}, {v:g}) is not in the fixed camera's {size[0]}x{size[1]} image")
            self._expected = f"{name}: no track came near ({u:g}, {v:g})"
        elif "track" in table:
            name = "--track" if is_option else "the recorded track"
            self._expected = f"{name}: there was no track {table['track']}"
        elif (policy := table.get("policy", POLICIES[0])) not in MAKERS:
            raise ConfigError(f"the recorded policy '{policy}' is unknown; give --policy, one of: {choices(MAKERS)}")
        self.selector = make_selector(table)

    def see(self, step: "Step") -> None:
        """Record a step's confirmed tracks and whether a target was followed."""
        self._followed = self._followed or step.target is not None
        self._seen |= {track.id for track in step.tracks if track.confirmed}

    @property
    def unmet(self) -> str:
        """Message that no track matched the click or number; empty where one did, and where there were no tracks."""
        if self._followed or not self._expected or not self._seen:
            return ""
        return f"{self._expected}; the tracks were: {choices(map(str, self._seen))}"


def _selector_table_of(options: argparse.Namespace) -> dict[str, Any]:
    """Give the table of the selector that the options name, as a recording keeps it; empty without an option."""
    if options.click is not None:
        return {"click": [*options.click]}
    named = {"policy": options.policy, "track": options.track}
    return {name: value for name, value in named.items() if value is not None}


class SkippedFrames:
    """Count of the fixed camera's frames that a run did not work on.

    Attributes:
        count: frames that were skipped so far.
    """

    def __init__(self) -> None:
        self._steps = self.count = 0

    def see(self, step: "Step") -> None:
        """Count the frames skipped before a step."""
        self.count += step.skipped
        self._steps += 1

    @property
    def warning(self) -> str:
        """One line if many frames were skipped; empty otherwise."""
        frames = self._steps + self.count
        if self.count < max(FEW, SOME * frames):
            return ""
        return (
            f"{self.count} of {frames} frames of the fixed camera were not worked on: the machine or the line is slow"
        )


class LensAtItsEnd:
    """Count of the steps in which the lens's range kept it from the wanted size."""

    def __init__(self, name: str, target: "TargetProfile") -> None:
        """Start to count for a target of this name."""
        from cotarget.control.zoom import GOOD_SIZE

        self._name, self._target, self._good = name, target, GOOD_SIZE
        self._steps = 0
        self._shown_px: list[float] = []

    def see(self, step: "Step") -> None:
        """Count a step with an aim, and how large it shows the target."""
        if step.aim is None:
            return
        self._steps += 1
        shown_px = step.aim.focal_px * self._target.size / step.aim.range
        if step.aim.limited and not self._good[0] <= shown_px / self._target.wanted_px <= self._good[1]:
            self._shown_px.append(shown_px)

    @property
    def warning(self) -> str:
        """One line if the lens was at its end in most steps with an aim; empty otherwise."""
        count = len(self._shown_px)
        if count < max(MANY, MOST * self._steps):
            return ""
        return (
            f"in {count} of {self._steps} frames the lens was at its end and could show the {self._name} only "
            f"{statistics.median(self._shown_px):.0f} px large, and not {self._target.wanted_px:g}"
        )


# Reasons of the steps, counted over a run

NUMBER = re.compile(r"-?\d+(\.\d+)?(e-?\d+)?")
ANY = "#"  # in place of a number
EITHER = re.compile(rf"(\w[^;]*{ANY}) or \1")  # one and two solutions count as one reason
# Prefixes of reasons that every good run has for a moment: the lens waits, or the target is hidden or not yet there.
# Only where one holds in most frames after the first sighting is something wrong.
USUAL = (
    "zoom: ",
    "nothing is detected",
    "what is detected is not confirmed yet",
    "out of sight",
    "looked for",
    "the head waits: where it is by now",
    "no track ",  # reported by `Choice.unmet`
    "track ",
)
MOST, MANY = 0.5, 25  # share of those frames, and least count, from which a usual reason is reported
SOME, FEW = 0.05, 5  # share of all frames, and least count, for any other reason
IN_WORDS = {
    "zoom: unsure": "zoom: unsure, so the lens stays wider than wanted: where the target is, is not known well enough, "
    "or the head is too slow for it"
}


class Reasons:
    """Counts of the reasons in a run's steps, with numbers ignored: 0.5 s and 0.6 s are one reason."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._later: Counter[str] = Counter()  # counts after the first sighting
        self._latest: dict[str, str] = {}
        self._steps = self._later_steps = 0

    def see(self, step: "Step") -> None:
        """Count the reasons of a step."""
        parts = {folded(part): part for part in step.reason.split("; ") if part}
        self._steps += 1
        self._counts.update(parts.keys())
        if self._later_steps or step.target is not None:
            self._later_steps += 1
            self._later.update(parts.keys())
        self._latest |= parts

    @property
    def table(self) -> dict[str, int]:
        """Number of frames with each reason, the most frequent first."""
        return dict(self._counts.most_common())

    @property
    def warning(self) -> str:
        """One line with the reasons that held in too many frames, the most frequent first; empty if there are none."""
        wrong = [(count, name) for name, count in self._counts.most_common() if self._is_wrong(name, count)]
        told = [f"{count} of {self._steps} frames: {IN_WORDS.get(name, self._latest[name])}" for count, name in wrong]
        return " ".join("; ".join(told).split())  # a device's message may have several lines

    def _is_wrong(self, name: str, count: int) -> bool:
        """Check whether a reason held in too many frames."""
        if name.startswith(USUAL):
            return self._later[name] >= max(MANY, MOST * self._later_steps)
        return count >= max(FEW, SOME * self._steps)


def folded(reason: str) -> str:
    """Replace the numbers in a reason by a placeholder."""
    return EITHER.sub(r"\1", NUMBER.sub(ANY, reason))


REMARK_S = 30.0  # between lines of progress where stderr is not a terminal [s]


@contextmanager
def progress_bar(now: Callable[[], float] = time.monotonic) -> Iterator[Any]:
    """Show progress on stderr: a bar on a terminal, otherwise an occasional line.

    Args:
        now: gives the time [s].

    Yields:
        A function of (text, done, total) that updates the progress; total is None where no end is known.
    """
    if not sys.stderr.isatty():
        yield _remarks(now)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    columns = TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), TimeElapsedColumn()
    # Results go to stdout, past the bar.
    with Progress(*columns, console=Console(stderr=True), transient=True, redirect_stdout=False) as bar:
        task = bar.add_task("", total=None)

        def show(text: str, done: int, total: int | None) -> None:
            bar.update(task, description=text, completed=done if total is None else min(done, total), total=total)

        yield show


def _remarks(now: Callable[[], float]) -> Callable[[str, int, int | None], None]:
    """Print progress as lines, at most one every half a minute, so that short work prints nothing."""
    begin = last = now()

    def remark(text: str, done: int, total: int | None) -> None:
        nonlocal last
        if (t := now()) - last < REMARK_S:
            return
        last = t
        with contextlib.suppress(OSError):  # the reader of stderr may be closed; the work goes on
            part = "" if total is None else f"{100 * min(done / max(total, 1), 1):.0f} %, "
            print(f"{text} ({part}{t - begin:.0f} s)", file=sys.stderr, flush=True)

    return remark


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


@contextmanager
def nothing() -> Iterator[None]:
    """Context manager without effect, in place of an output that was not requested."""
    yield None


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[Path | None], folder: Path | None = None) -> None:
    """Refuse outputs that cannot be written or would destroy an input, before the long work starts.

    Args:
        outputs: files to write.
        inputs: files that are read, and folders whose contents must not change.
        folder: new folder to write, which may not contain any output.

    Raises:
        ConfigError: an output is refused; the message names the first one.
    """
    taken = {_real(path) for path in inputs if path is not None}
    if folder is not None:
        _refuse_taken(folder, taken)
        taken.add(_real(folder))
    for path in outputs:
        if path is None:
            continue
        if path == STDOUT:
            raise ConfigError("-: stdout takes the table of --csv alone; name a file")
        if path.is_dir():
            raise ConfigError(f"{path}: is a folder; name the file to write")
        if path.exists() and not path.is_file():
            raise ConfigError(f"{path}: is a device or a pipe, not a file; name the file to write")
        if _is_said_to(path):
            raise ConfigError(f"{path}: is where this command's own words go; name another file to write")
        if (goal := behind_link(path)).is_symlink():
            raise ConfigError(f"{path}: is a link to itself; name the file to write")
        if goal.parent.exists() and not goal.parent.is_dir():
            raise ConfigError(f"{path}: {goal.parent} is a file, not a folder; name a file in a folder")
        if not goal.absolute().parent.is_dir():
            raise ConfigError(f"{path}: its folder does not exist; create it first")
        _refuse_taken(path, taken)
        taken.add(_real(path))


def rig_files(rig: Path | None, config: "RigConfig") -> list[Path | None]:
    """List the files and folders that opening a rig reads: rig.toml and those that it names. None may be an output."""
    scene = Path(config.sim.scene)
    templates = [target.template for target in config.targets.values()]
    own = scene if scene.is_file() else None
    return [rig, config.safety.stop_file, config.recording, own, *config.sim.models.values(), *templates]


def check_board_is_told(rig: Path, config: "RigConfig") -> None:
    """Refuse a rig whose board has squares of metres, and a real one whose configuration does not give their size.

    All lengths of a calibration are multiples of that size, so that no later check can find it wrong.

    Raises:
        ConfigError: the size is missing, or in millimetres.
    """
    from cotarget.config import check_square, read_tables

    told = read_tables(rig).get("board", {})
    if config.backend == "hardware" and "square" not in told:
        raise ConfigError(
            f"{rig}: does not say how large the squares of your board are; measure ten of them, and say so in metres: "
            "[board] square = 0.025"
        )
    check_square(config.board.square, f"{rig}: board.square")


def _real(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _refuse_taken(path: Path, taken: Iterable[Path]) -> None:
    """Refuse a path that is one of these files, or is inside one of these folders."""
    for each in taken:
        if _real(path) == each:
            raise ConfigError(f"{path}: is read or written for something else too; give another name for the result")
        if _real(path).is_relative_to(each):
            raise ConfigError(f"{path}: is in {each}, which is read or written as a whole; name a file outside of it")


def _is_said_to(path: Path) -> bool:
    """Check whether a file is the destination of stdout or stderr."""
    with contextlib.suppress(OSError):
        file = path.stat()
        return any(os.path.samestat(file, os.fstat(stream)) for stream in (1, 2))
    return False


@contextmanager
def previous_kept(path: Path) -> Iterator[None]:
    """Keep an earlier output under another name while the block writes a new one; print that name.

    Both files are complete at every moment. If the block fails, the earlier file stays and the other name is removed.

    Raises:
        ConfigError: the earlier file cannot be kept.
    """
    kept = _second_name(behind_link(path))
    try:
        yield
    except BaseException:
        if kept is not None:
            kept.unlink(missing_ok=True)
        raise
    if kept is not None:
        print(f"{path}: the one of before is kept as {kept}", file=sys.stderr)


def _second_name(path: Path) -> Path | None:
    """Link a file to another name beside its own; None where there is no such file."""
    if not path.exists():
        return None
    numbered = (path.with_name(f"{path.stem}.previous-{n}{path.suffix}") for n in itertools.count(1))
    kept = next(name for name in numbered if not os.path.lexists(name))
    try:
        os.link(path, kept)
    except OSError:  # not every file system has hard links
        write_atomically(kept, path.read_bytes())
    return kept


def check_within(option: str, value: float, bounds: tuple[float, float], of: str, slack: float = 0.0) -> None:
    """Refuse a value outside a device's limits.

    Args:
        option: name of the option, for the message.
        value: value of the option.
        bounds: lowest and highest value, in the option's unit.
        of: description and unit of the bounds for the message, with `{}` in their place.
        slack: tolerance, because bounds are printed rounded.
    """
    low, high = bounds
    if not low - slack <= value <= high + slack:
        raise ConfigError(f"{option}: {value:g} is beyond {of.format(f'{low:g} to {high:g}')}")


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


def not_negative(text: str) -> int:
    """Parse a whole number of at least 0."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0")
    return int(text)


def count(text: str) -> int:
    """Parse a whole number of at least 1."""
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 1")
    return int(text)


def port(text: str) -> int:
    """Parse a TCP port; 0 stands for any free one."""
    if not (text.isdecimal() and int(text) < 65536):
        raise argparse.ArgumentTypeError(f"'{text}' is not a port, 0 to 65535")
    return int(text)


def corners(text: str) -> tuple[int, int]:
    """Parse a board's inner corners, such as 9x6."""
    columns, _, rows = text.partition("x")
    if not (columns.isdecimal() and rows.isdecimal() and int(columns) >= 3 and int(rows) >= 3):
        raise argparse.ArgumentTypeError(f"'{text}' is not like 9x6 (inner corners: columns x rows, 3 at least)")
    return int(columns), int(rows)
