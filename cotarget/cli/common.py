"""What the commands share: arguments and outputs that are checked before the work, progress, and results in JSON.

Which of several targets a command follows: by a policy, by a click into the wide view, or by a track's number.

Why the loop did what it did: how often each reason was, and which of them a user should hear of.
"""

import argparse
import contextlib
import itertools
import json
import math
import os
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cotarget.errors import ConfigError, choices
from cotarget.files import behind_link

if TYPE_CHECKING:
    from cotarget.config import RigConfig
    from cotarget.control.selection import Policy, TargetChoice
    from cotarget.pipeline import Step


# Those of `cotarget.control.selection`, which --help does not import; the paper's first.
POLICIES = ("first-come", "nearest-deadline", "most-served")


def add_choice(parser: argparse.ArgumentParser, default: str = POLICIES[0]) -> None:
    """Give a command its options for whom to follow, and say what it does without."""
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


def check_shown(config: "RigConfig", name: str, rig: Path) -> None:
    """Refuse to follow what a simulated scene does not show.

    Args:
        config: of the rig.
        name: of the target, one of the configuration's.
        rig: the configuration's file.

    Raises:
        ConfigError: it is not there, with what would be right.
    """
    from cotarget.config import TARGETS, known_targets, split_name

    if config.backend != "sim" or name in config.sim.targets:
        return
    own = config.sim.models
    if split_name(name)[0] not in (*TARGETS, *own):
        raise ConfigError(
            f"--target: a simulated {name} cannot be, whatever [targets.{name}] says; {known_targets(own)}"
        )
    raise ConfigError(
        f"{rig}: the simulated scene has no {name}; add it: [sim] targets = {json.dumps([*config.sim.targets, name])}"
    )


class Choice:
    """Whom the options ask for, and whether it was ever there.

    Attributes:
        target_choice: in words that a recording keeps.
        policy: makes what decides.
    """

    def __init__(
        self, options: argparse.Namespace, size: tuple[int, int], recorded: "TargetChoice | None" = None
    ) -> None:
        """Read the options.

        Args:
            options: with those of `add_choice`.
            size: (width, height) of the wide view [px].
            recorded: whom a recorded run followed, for where no option says anything else.

        Raises:
            ConfigError: the click is not in the wide view, or a recording's policy is unknown.
        """
        from cotarget.control.selection import POLICIES as MAKERS
        from cotarget.control.selection import Chosen

        self._wish = ""
        self._seen: set[int] = set()
        self._followed = False
        self.policy: Callable[[], Policy]
        self.target_choice = _choice_of(options, recorded)
        if self.target_choice.click is not None:
            u, v = self.target_choice.click
            said = "the recorded click" if options.click is None else "--click"
            if not (-0.5 <= u <= size[0] - 0.5 and -0.5 <= v <= size[1] - 0.5):
                raise ConfigError(f"{said}: ({u:g}, {v:g}) is not in the wide view's {size[0]}x{size[1]} image")
            self.policy = partial(Chosen, pixel=(u, v), width_px=size[0])
            self._wish = f"{said}: no track came near ({u:g}, {v:g})"
        elif self.target_choice.track is not None:
            self.policy = partial(Chosen, number=self.target_choice.track)
            said = "the recorded track" if options.track is None else "--track"
            self._wish = f"{said}: there was no track {self.target_choice.track}"
        elif self.target_choice.policy is not None and self.target_choice.policy in MAKERS:
            self.policy = MAKERS[self.target_choice.policy]
        else:
            raise ConfigError(
                f"the recorded policy '{self.target_choice.policy}' is unknown; "
                f"give --policy, one of: {choices(MAKERS)}"
            )

    def see(self, step: "Step") -> None:
        """Take note of a Step."""
        self._followed = self._followed or step.target is not None
        self._seen |= {track.id for track in step.tracks if track.confirmed}

    @property
    def unmet(self) -> str:
        """Says that a click or a number meant none of the tracks; empty where it did, and where there was no track."""
        if self._followed or not self._wish or not self._seen:
            return ""
        return f"{self._wish}; the tracks were: {choices(map(str, self._seen))}"


def _choice_of(options: argparse.Namespace, recorded: "TargetChoice | None") -> "TargetChoice":
    """What the options say; else what was recorded; else the first policy, by its name, in case that changes."""
    from cotarget.control.selection import ANY_TARGET, TargetChoice

    if options.click is not None:
        return TargetChoice(click=(options.click[0], options.click[1]))
    if options.track is not None or options.policy is not None:
        return TargetChoice(options.policy, None, options.track)
    return TargetChoice(POLICIES[0]) if recorded in (None, ANY_TARGET) else recorded


# --- reasons ---

NUMBER = re.compile(r"-?\d+(\.\d+)?(e-?\d+)?")
ANY = "#"  # stands for a number
EITHER = re.compile(rf"(\w[^;]*{ANY}) or \1")  # one solution or two make one reason
# How the reasons begin that every good run has for a moment: a lens that waits, a target that is hidden or not yet
# there. Only where they are for most of the frames after the first sighting is something wrong.
USUAL = (
    "zoom: ",
    "nothing is detected",
    "what is detected is not believed yet",
    "out of sight",
    "looked for",
    "the head waits: where it is by now",
    "no track ",  # told by the option that asks for it
    "track ",
)
MOST, MANY = 0.5, 25  # share of those frames, and the fewest frames, from which these are told
SOME, FEW = 0.05, 5  # and of all frames, from which every other reason is
IN_WORDS = {
    "zoom: unsure": "zoom: unsure, so the lens stays wider than wanted: where the target is, is not known well enough, "
    "or the head is too slow for it"
}


class Reasons:
    """Counts the reasons of a run's Steps, whose numbers do not matter: 0.5 s and 0.6 s are one reason."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._later: Counter[str] = Counter()  # those after the first sighting
        self._latest: dict[str, str] = {}
        self._steps = self._later_steps = 0

    def see(self, step: "Step") -> None:
        """Count a Step's reasons."""
        parts = {folded(part): part for part in step.reason.split("; ") if part}
        self._steps += 1
        self._counts.update(parts.keys())
        if self._later_steps or step.target is not None:
            self._later_steps += 1
            self._later.update(parts.keys())
        self._latest |= parts

    @property
    def table(self) -> dict[str, int]:
        """In how many frames each reason was, the most frequent first."""
        return dict(self._counts.most_common())

    @property
    def warning(self) -> str:
        """What went wrong for how many frames, the most frequent first, with the latest numbers; empty if nothing."""
        wrong = [(count, name) for name, count in self._counts.most_common() if self._is_wrong(name, count)]
        told = [f"{count} of {self._steps} frames: {IN_WORDS.get(name, self._latest[name])}" for count, name in wrong]
        return " ".join("; ".join(told).split())  # one line, whatever a device says

    def _is_wrong(self, name: str, count: int) -> bool:
        """Whether a reason was there for too many frames."""
        if name.startswith(USUAL):
            return self._later[name] >= max(MANY, MOST * self._later_steps)
        return count >= max(FEW, SOME * self._steps)


def folded(reason: str) -> str:
    """A reason with its numbers taken out."""
    return EITHER.sub(r"\1", NUMBER.sub(ANY, reason))


REMARK_S = 30.0  # between lines of progress where stderr is no terminal [s]


@contextmanager
def progress_bar(now: Callable[[], float] = time.monotonic) -> Iterator[Any]:
    """A progress bar on stderr, or a line now and then where that is no terminal.

    Args:
        now: tells the time [s].

    Yields:
        What is to be called with (what, done, of how much).
    """
    if not sys.stderr.isatty():
        yield _remarks(now)
        return
    from tqdm import tqdm

    with tqdm(total=None, leave=False, bar_format="{desc} |{bar:30}| {percentage:3.0f}% {elapsed}") as bar:

        def show(text: str, done: int, total: int) -> None:
            bar.total, bar.n = total, done
            bar.set_description_str(text)

        yield show


def _remarks(now: Callable[[], float]) -> Callable[[str, int, int], None]:
    """Progress for a file: a line at most every half a minute, so that short work says nothing."""
    begin = last = now()

    def remark(text: str, done: int, total: int) -> None:
        nonlocal last
        if (t := now()) - last < REMARK_S:
            return
        last = t
        with contextlib.suppress(OSError):  # whoever read along may have gone; the work goes on
            print(f"{text} ({100 * done / max(total, 1):.0f} %, {t - begin:.0f} s)", file=sys.stderr, flush=True)

    return remark


def print_json(table: Any) -> None:
    """Print a result on stdout."""
    print(json.dumps(_positive_zeros(table), indent=2))


def _positive_zeros(value: Any) -> Any:
    """The same values, but for zeros, which have no sign to people."""
    if isinstance(value, dict):
        return {key: _positive_zeros(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_positive_zeros(item) for item in value]
    return value + 0.0 if isinstance(value, float) else value  # -0.0 + 0.0 is 0.0


@contextmanager
def nothing() -> Iterator[None]:
    """Stands where another command would have something to close."""
    yield None


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[Path | None], folder: Path | None = None) -> None:
    """Refuse a result that cannot be written, or that would destroy an input, before the long work and not after it.

    Args:
        outputs: files to write.
        inputs: files that are read, and folders of which nothing may be changed.
        folder: a new one to write, in which no output may be.

    Raises:
        ConfigError: for the first one, in one line.
    """
    taken = {_real(path) for path in inputs if path is not None}
    if folder is not None:
        _refuse_taken(folder, taken)
        taken.add(_real(folder))
    for path in outputs:
        if path is None:
            continue
        if path.is_dir():
            raise ConfigError(f"{path}: is a folder; name the file to write")
        if path.exists() and not path.is_file():
            raise ConfigError(f"{path}: is a device or a pipe, not a file; name the file to write")
        if _is_said_to(path):
            raise ConfigError(f"{path}: is where this command's own words go; name another file to write")
        if (goal := behind_link(path)).is_symlink():
            raise ConfigError(f"{path}: is a link to itself; name the file to write")
        if not goal.absolute().parent.is_dir():
            raise ConfigError(f"{path}: its folder does not exist; create it first")
        _refuse_taken(path, taken)
        taken.add(_real(path))


def rig_files(rig: Path | None, config: "RigConfig") -> list[Path | None]:
    """Files and folders that a rig is opened with, none of which may be a result too: rig.toml, and what it names."""
    scene = Path(config.sim.scene)
    templates = [target.template for target in config.targets.values()]
    own = scene if scene.is_file() else None
    return [rig, config.safety.stop_file, config.recording, own, *config.sim.models.values(), *templates]


def check_board_is_told(rig: Path, config: "RigConfig") -> None:
    """Refuse real cameras before a board of which the file does not say how large its squares are.

    All lengths of a calibration are multiples of that, so that nothing else would ever show that it is wrong.

    Raises:
        ConfigError: it does not.
    """
    from cotarget.config import read_tables

    told = read_tables(rig).get("board", {})
    if config.backend == "hardware" and "square" not in told:
        raise ConfigError(
            f"{rig}: does not say how large the squares of your board are; measure ten of them, and say so in metres: "
            "[board] square = 0.025"
        )


def _real(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _refuse_taken(path: Path, taken: Iterable[Path]) -> None:
    """Refuse what is one of these files, or in one of these folders."""
    for each in taken:
        if _real(path) == each:
            raise ConfigError(f"{path}: is read or written for something else too; give another name for the result")
        if _real(path).is_relative_to(each):
            raise ConfigError(f"{path}: is in {each}, which is read or written as a whole; name a file outside of it")


def _is_said_to(path: Path) -> bool:
    """Whether a file is where stdout or stderr goes."""
    with contextlib.suppress(OSError):
        file = path.stat()
        return any(os.path.samestat(file, os.fstat(stream)) for stream in (1, 2))
    return False


@contextmanager
def previous_kept(path: Path) -> Iterator[None]:
    """Keep what an earlier run wrote under a name that says so, while the block writes another; and say where it is.

    Both are whole at every moment. Where the block fails, everything is as it was before.

    Raises:
        CalibrationError: the earlier one cannot be kept.
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
    """Give a file another name beside its own; None where there is no such file."""
    from cotarget.files import write_atomically

    if not path.exists():
        return None
    numbered = (path.with_name(f"{path.stem}.previous-{n}{path.suffix}") for n in itertools.count(1))
    kept = next(name for name in numbered if not os.path.lexists(name))
    try:
        os.link(path, kept)
    except OSError:  # not every file system has second names
        write_atomically(kept, path.read_bytes())
    return kept


def check_within(option: str, value: float, bounds: tuple[float, float], of: str, slack: float = 0.0) -> None:
    """Refuse a value beyond what a device can do, but for some slack, in the same words for every option.

    Args:
        option: as it is typed.
        value: as it was typed.
        bounds: lowest and highest, in the option's unit.
        of: what the bounds are of, and their unit, with `{}` where they stand.
        slack: by which a value may be beyond, as bounds are printed rounded.
    """
    low, high = bounds
    if not low - slack <= value <= high + slack:
        raise ConfigError(f"{option}: {value:g} is beyond {of.format(f'{low:g} to {high:g}')}")


def number(text: str) -> float:
    """Read an argument that is a finite number."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number") from None
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is not a finite number")
    return value


def positive(text: str) -> float:
    """Read an argument greater than zero."""
    value = number(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{text} is not greater than zero")
    return value


def not_negative(text: str) -> int:
    """Read a whole number from 0."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0")
    return int(text)


def count(text: str) -> int:
    """Read a whole number from 1."""
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 1")
    return int(text)


def port(text: str) -> int:
    """Read a TCP port; 0 is any."""
    if not (text.isdecimal() and int(text) < 65536):
        raise argparse.ArgumentTypeError(f"'{text}' is not a port, 0 to 65535")
    return int(text)


def corners(text: str) -> tuple[int, int]:
    """Read a board's inner corners, such as 9x6."""
    columns, _, rows = text.partition("x")
    if not (columns.isdecimal() and rows.isdecimal() and int(columns) >= 3 and int(rows) >= 3):
        raise argparse.ArgumentTypeError(f"'{text}' is not like 9x6 (inner corners: columns x rows, 3 at least)")
    return int(columns), int(rows)
