"""A run of the pipeline with its table, film, summary and warnings, as follow and replay have it.

Observers see every step of a run and warn at its end: `Selection`, `Reasons`, `StepCounts` and `LensAtItsEnd`.
"""

import argparse
import dataclasses
import math
import re
import statistics
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from cotarget.cli.common import add_file, number, whole
from cotarget.errors import ConfigError, choices
from cotarget.files import STDOUT, CsvFile
from cotarget.parallel import progress_bar

if TYPE_CHECKING:
    from cotarget.calibration import Calibration
    from cotarget.config import RigConfig, TargetProfile
    from cotarget.pipeline import FollowSettings, Run, Step
    from cotarget.recording.replay import Replay
    from cotarget.rig import Rig


def add_outputs(parser: argparse.ArgumentParser) -> None:
    """Add the options of a run's table and video."""
    add_file(parser, "--csv", "write one line a step; -: to stdout")
    add_file(parser, "--video", "write a side-by-side video (.mp4)")


def output_files(options: argparse.Namespace) -> list[Path | None]:
    """List the files that a run writes; a table may go to stdout instead."""
    return [None if options.csv == STDOUT else options.csv, options.video]


# A run and its result


@dataclasses.dataclass(frozen=True)
class RunInputs:
    """Inputs of a run of the pipeline.

    Attributes:
        open_rig: opens the guarded rig.
        config: configuration of the rig.
        calibration: its calibration.
        name: name of the target.
        rate_hz: frame rate of the fixed camera [Hz].
        selection: selects among several targets.
        seconds: duration [s]; infinite until Ctrl-C, or until a recording ends.
        expected: number of steps; None if it is unknown.
        replay: the recording that is replayed; None for a rig.
        operated: yields the steps of a run that an operator gives orders; None for a run without one.
        settings: settings of the run; the usual ones by default.
    """

    open_rig: "Callable[[], Rig]"
    config: "RigConfig"
    calibration: "Calibration"
    name: str
    rate_hz: float
    selection: "Selection"
    seconds: float
    expected: int | None
    replay: "Replay | None" = None
    operated: "Callable[[Rig, Run], Iterator[Step]] | None" = None
    settings: "FollowSettings | None" = None


@dataclasses.dataclass(frozen=True)
class Result:
    """Result of a run.

    Attributes:
        counts: counts of its steps.
        table: what is printed as JSON.
        interrupt: the Ctrl-C that cut the run short.
    """

    counts: "StepCounts"
    table: dict[str, Any]
    interrupt: KeyboardInterrupt | None


class Observer(Protocol):
    """Observer of a run's steps."""

    def see(self, step: "Step") -> None:
        """Take notice of a step."""

    @property
    def warning(self) -> str:
        """One line on what was wrong in the run; empty if nothing was."""


def run_observed(run: RunInputs, options: argparse.Namespace, *more: Observer) -> Result:
    """Follow a target with progress, table and film.

    However the run ends, the head is halted before the files are completed. Ctrl-C is the usual end of a run whose
    length is unknown.
    """
    from cotarget.detection import make_detector
    from cotarget.drawing import side_by_side
    from cotarget.pipeline import Run
    from cotarget.recording.recorder import COLUMNS, step_row
    from cotarget.recording.replay import until_end
    from cotarget.safety.signals import deferred_signals
    from cotarget.video import FilmWriter

    target = run.config.target(run.name)
    detector = make_detector(target, run.rate_hz)
    counts, reasons = StepCounts(), Reasons()
    observers: tuple[Observer, ...] = (run.selection, reasons, counts, LensAtItsEnd(run.name, target), *more)
    epoch: datetime | None = None
    interrupt: KeyboardInterrupt | None = None
    try:
        with (
            CsvFile(options.csv, COLUMNS, keep=True) if options.csv else nullcontext() as table,
            FilmWriter(options.video, run.rate_hz, keep=True) if options.video else nullcontext() as film,
            progress_bar() as progress,
            run.open_rig() as rig,
        ):
            if run.config.backend == "hardware" and run.replay is None:
                epoch = datetime.now(UTC) - timedelta(seconds=rig.clock.now())
            if film is not None:
                film.epoch = epoch

            def steps() -> "Iterator[Step]":  # a recording may end before the first step
                selector = run.selection.selector
                made = Run(rig, run.calibration, target, detector, selector=selector, settings=run.settings)
                yield from made.follow(run.seconds) if run.operated is None else run.operated(rig, made)

            try:
                for step in until_end(steps(), run.replay):
                    with deferred_signals():  # table, counts and film have the same steps
                        if table is not None:
                            table.write(step_row(step, epoch))
                        for observer in observers:
                            observer.see(step)
                        if film is not None:
                            film.write(side_by_side(step, run.name, step.fixed.t - counts.first_t), step.fixed.t)
                    progress(step.index + 1, run.expected, f"following: {run.name}: {step.state}")
            except KeyboardInterrupt:
                if run.expected is not None or not counts.steps:
                    raise
    except KeyboardInterrupt as end:
        if not counts.steps:
            raise
        interrupt = end
    for line in filter(None, (observer.warning for observer in observers)):
        print(f"cotarget {options.command}: {line}", file=sys.stderr)
    return Result(counts, _summary(counts, reasons, epoch), interrupt)


def _summary(counts: "StepCounts", reasons: "Reasons", epoch: datetime | None) -> dict[str, Any]:
    """Make the table that a run prints; ``epoch`` is the wall clock's time at the rig's zero, if there is one."""
    from cotarget.recording.recorder import utc_text

    return {
        "steps": counts.steps,
        "skipped": counts.skipped,
        "states": counts.states,
        "reasons": reasons.table,
        "started": None if epoch is None or not counts.steps else utc_text(epoch, counts.first_t),
    }


# What a detector needs to find a target.
NEEDED = {
    "auto": "what --target names has to move or stand out",
    "colour": "what --target names has to look like its template",
    "motion": "what --target names has to move",
    "mog2": "what --target names has to move",
    "speck": "what --target names has to move or beat its wings",
    "onnx": "what --target names has to be of network.classes, with a score of network.least_score",
}


def warn_if_unseen(command: str, run: RunInputs, counts: "StepCounts") -> None:
    """Print a hint if no target was detected in the whole run."""
    if not counts.only_searched or run.selection.warning:
        return
    if command == "replay":
        why = "the recording has none, or is too short for one to be believed"
    else:
        detector = run.config.target(run.name).detector
        why = f"{NEEDED.get(detector, 'what --target names has to be')} in the fixed camera's view"
    print(
        f"cotarget {command}: no {run.name} was seen in {counts.steps} frames; {why}; --video FILE shows that view (an "
        "emulated rig has the targets of its [sim] targets)",
        file=sys.stderr,
    )


# Observers

NEVER_CONFIRMED, NOTHING_FOLLOWED = 3, 4  # exit statuses of `follow`
# A reason that is usual for a moment is reported from this share and this number of the steps on,
MOST, MANY = 0.5, 25
# and any other reason from this share and this number on.
SOME, FEW = 0.05, 5


class StepCounts:
    """Counts of a run's steps.

    Attributes:
        states: number of steps in each state; the states of a run with an operator are there once they come.
        skipped: number of the fixed camera's frames that the run did not work on.
        confirmed: number of steps in which the zoom camera showed the followed target.
        first_t: time of the first step's frame [s]; nan before it.
    """

    def __init__(self) -> None:
        from cotarget.pipeline import OPERATED, State

        self.states: dict[str, int] = {state: 0 for state in State if state not in OPERATED}
        self.skipped = self.confirmed = 0
        self.first_t = math.nan

    def see(self, step: "Step") -> None:
        """Count a step."""
        from cotarget.pipeline import State

        if not self.steps:
            self.first_t = step.fixed.t
        self.states[step.state] = self.states.get(step.state, 0) + 1
        self.skipped += step.skipped
        self.confirmed += step.found is not None and step.state is not State.UNCONFIRMED

    @property
    def steps(self) -> int:
        """Number of steps."""
        return sum(self.states.values())

    @property
    def only_searched(self) -> bool:
        """Whether there were steps, and no target in any of them."""
        return 0 < self.steps == self.states["searching"]

    @property
    def exit_status(self) -> int:
        """Exit status of `follow`: 0 if a target was followed and, where there was time for it, confirmed."""
        if not any(self.states[name] for name in ("following", "coasting", "unconfirmed")):
            return NOTHING_FOLLOWED
        # A wrong match in a few frames confirms nothing; a target hidden from the zoom camera for a while was confirmed
        # before or after.
        return NEVER_CONFIRMED if self.states["unconfirmed"] > self.confirmed else 0

    @property
    def warning(self) -> str:
        """One line if many frames were skipped."""
        frames = self.steps + self.skipped
        if self.skipped < max(FEW, SOME * frames):
            return ""
        return f"{self.skipped} of {frames} frames of the fixed camera were skipped: the machine or the line is slow"


class LensAtItsEnd:
    """Steps in which the lens's range did not allow the wanted size."""

    def __init__(self, name: str, target: "TargetProfile") -> None:
        self._name, self._target = name, target
        self._steps = 0
        self._shown_px: list[float] = []

    def see(self, step: "Step") -> None:
        """Count a step with an aim, and the size at which it shows the target."""
        from cotarget.config import GOOD_SIZE

        if step.aim is None:
            return
        self._steps += 1
        shown_px = step.aim.focal_px * self._target.size / step.aim.range
        if step.aim.limited and not GOOD_SIZE[0] <= shown_px / self._target.wanted_px <= GOOD_SIZE[1]:
            self._shown_px.append(shown_px)

    @property
    def warning(self) -> str:
        """One line if the lens was at its end in most steps with an aim."""
        count = len(self._shown_px)
        if count < max(MANY, MOST * self._steps):
            return ""
        return (
            f"in {count} of {self._steps} frames the lens was at its end and could show the {self._name} only "
            f"{statistics.median(self._shown_px):.0f} px large, and not {self._target.wanted_px:g}"
        )


# Reasons of the steps

# A number, or an address or a path, whose numbers are a part of its name.
NUMBER = re.compile(r"(?P<name>\b[a-z]+:[^\s;]+|(?<!\w)/[^\s;]+)|-?\d+(\.\d+)?(e-?\d+)?")
ANY = "#"  # in place of a number
EITHER = re.compile(rf"(\w[^;]*{ANY}) or \1")  # one and two solutions count as one reason
# Prefixes of reasons that every good run has for a moment: the lens waits, or the target is hidden or not yet there.
USUAL = (
    "zoom: ",
    "nothing is detected",
    "what is detected is not confirmed yet",
    "out of sight",
    "looked for",
    "the head waits: where it is by now",
    "no track ",  # reported by `Selection`
    "track ",
)
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
        """Count the reasons of a step, but for those of an operator."""
        from cotarget.pipeline import OPERATED

        if step.state in OPERATED:
            return
        latest = [part for part in step.reason.split("; ") if part]
        parts = {EITHER.sub(r"\1", NUMBER.sub(lambda found: found["name"] or ANY, part)): part for part in latest}
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
        """One line with the reasons that held in too many frames, the most frequent first."""
        wrong = [(count, name) for name, count in self._counts.most_common() if self._is_wrong(name, count)]
        lines = [f"{count} of {self._steps} frames: {IN_WORDS.get(name, self._latest[name])}" for count, name in wrong]
        return " ".join("; ".join(lines).split())  # a device's message may have several lines

    def _is_wrong(self, name: str, count: int) -> bool:
        """Whether a reason held in too many frames."""
        if name.startswith(USUAL):
            return self._later[name] >= max(MANY, MOST * self._later_steps)
        return count >= max(FEW, SOME * self._steps)


# Selection of the target

# Names of `cotarget.control.selection`, which --help must not import; the paper's policy is the first.
POLICIES = ("first-come", "nearest-deadline", "most-served")


LEARNT = ".onnx"  # ending of a learnt policy's file


class PolicyNames(tuple[str, ...]):
    """Names of policies; files of learnt policies are valid too."""

    def __contains__(self, given: object) -> bool:
        return super().__contains__(given) or str(given).endswith(LEARNT)


def add_selection(parser: argparse.ArgumentParser, default: str = POLICIES[0], *, learnt: bool = False) -> None:
    """Add the options that select the target to follow; the help names the default.

    Args:
        parser: parser of the command.
        default: what holds without an option.
        learnt: whether the file of a learnt policy may stand for a policy.
    """
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--policy",
        choices=PolicyNames(POLICIES) if learnt else POLICIES,
        help="choice among several targets: the first until it disappears, the one that leaves first, or the order "
        f"that gives most of them a good close-up ({default})"
        + ("; or FILE.onnx, a learnt policy, which drives head and lens after the first" if learnt else ""),
    )
    which.add_argument(
        "--click",
        type=number,
        nargs=2,
        metavar=("U", "V"),
        help="follow only the target at this pixel of the fixed image: the first confirmed track at or near it",
    )
    which.add_argument(
        "--track", type=whole(1), metavar="N", help="follow only the track with this id, as in video and table"
    )


class Selection:
    """Selector of the target by --policy, --click or --track, which warns if no track ever matched.

    Attributes:
        selector: selects the track to follow.
    """

    def __init__(
        self, options: argparse.Namespace, size: tuple[int, int], recorded: Mapping[str, Any] | None = None
    ) -> None:
        """Make the selector of the options, or of the recorded run where none is given; `size` is the fixed image's.

        Raises:
            ConfigError: the click is outside the fixed camera's image, or a recording's policy is unknown.
        """
        from cotarget.control.selection import POLICIES as MAKERS
        from cotarget.control.selection import make_selector

        given = {"policy": options.policy, "click": options.click, "track": options.track}
        given = {name: value for name, value in given.items() if value is not None}
        table, prefix = (given, "--") if given else (recorded or {}, "the recorded ")
        self._expected = ""
        if "click" in table:
            u, v = table["click"]
            if not (-0.5 <= u <= size[0] - 0.5 and -0.5 <= v <= size[1] - 0.5):
                raise ConfigError(
                    f"{prefix}click: ({u:g}, {v:g}) is not in the fixed camera's {size[0]}x{size[1]} image"
                )
            self._expected = f"{prefix}click: no track came near ({u:g}, {v:g})"
        elif "track" in table:
            self._expected = f"{prefix}track: there was no track {table['track']}"
        elif (policy := table.get("policy", POLICIES[0])) not in MAKERS:
            raise ConfigError(f"the recorded policy '{policy}' is unknown; give --policy, one of: {choices(MAKERS)}")
        self._seen: set[int] = set()
        self._followed = False
        self.selector = make_selector(table)

    def see(self, step: "Step") -> None:
        """Note a step's confirmed tracks, and whether a target was followed."""
        self._followed = self._followed or step.target is not None
        self._seen |= {track.id for track in step.tracks if track.confirmed}

    @property
    def warning(self) -> str:
        """One line if there were tracks, and none of them matched the click or number."""
        if self._followed or not self._expected or not self._seen:
            return ""
        return f"{self._expected}; the tracks were: {choices(map(str, self._seen))}"
