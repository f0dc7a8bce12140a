"""Commands that run the pipeline or inspect the installation: demo, follow, replay, detect, view, doctor."""

import argparse
import dataclasses
import itertools
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cotarget.cli.common import (
    LensAtItsEnd,
    Reasons,
    Selection,
    SkippedFrames,
    check_outputs,
    load_plausible,
    nothing,
    open_named,
    print_json,
    progress_bar,
    rig_files,
    target_of,
)
from cotarget.errors import ConfigError
from cotarget.files import STDOUT

if TYPE_CHECKING:
    from cotarget.calibration import Calibration
    from cotarget.config import RigConfig, TargetProfile
    from cotarget.metrics import Label, Tracked
    from cotarget.pipeline import State, Step
    from cotarget.recording.replay import Replay
    from cotarget.rig import Rig
    from cotarget.sim.truth import Truth
    from cotarget.sim.viewer.scene import Snapshot
    from cotarget.sim.world import SimWorld


PORT = 8080  # port of the page
LOOKED_AT = ("person", "bird")  # targets of the scene without --rig and --target


def view(options: argparse.Namespace) -> None:
    """Run `cotarget view`: show the simulated scene, with the pipeline at work where a target is named."""
    from cotarget.calibration import load_calibration
    from cotarget.sim.world import SimWorld

    if options.port is not None and not options.browser:
        raise ConfigError("--port: is of the page that --browser serves; give both")
    if options.calibration is not None and options.target is None:
        raise ConfigError("--calibration: is for following a target; name it: --target NAME")
    config = _config(options)
    calibration = None if options.calibration is None else load_calibration(options.calibration)
    opened = _opener(options)  # called first, because making the world takes a while
    world = SimWorld(config)
    with closing(world), closing(opened(world.truth())) as window:
        print(f"{window.where} shows the scene; Ctrl-C ends it", file=sys.stderr, flush=True)
        try:
            watch(_sights(options, config, world, calibration), window, time.monotonic, time.sleep)
        except KeyboardInterrupt:
            print("", file=sys.stderr)


def watch(sights: "Iterator[Snapshot]", window: Any, now: Callable[[], float], sleep: Callable[[float], None]) -> None:
    """Show snapshots in real time at most, until they end or the window is closed.

    Args:
        sights: snapshots in order of time.
        window: window that shows them.
        now: gives the wall-clock time [s].
        sleep: waits for a duration [s].
    """
    ahead = math.inf  # lead of the rig's clock over the wall clock
    for sight in sights:
        window.show(sight)
        if not window.is_open():
            return
        ahead = min(ahead, sight.t - now())  # a slow machine does not catch up afterwards
        if (wait := sight.t - ahead - now()) > 0:
            sleep(wait)


def _config(options: argparse.Namespace) -> "RigConfig":
    """Load or make the configuration of the rig to view."""
    from cotarget.backends import load_config
    from cotarget.config import RigConfig
    from cotarget.demo import SCENES, sim_config

    if options.rig is None:
        if options.target is not None:
            target_of(RigConfig(), options.target)  # refuse an unknown target before the long work
        targets = LOOKED_AT if options.target is None else (options.target,)
        return sim_config(SCENES.get(targets[0].rstrip("0123456789"), "outdoor"), targets, 0)
    config = load_config(options.rig)
    if config.backend != "sim":
        raise ConfigError(f"{options.rig}: backend is '{config.backend}'; what is viewed is a simulated rig")
    if options.target is not None:
        target_of(config, options.target)
        _check_shown(config, options)
    return config


def _check_shown(config: "RigConfig", options: argparse.Namespace) -> None:
    """Refuse to follow a target that the simulated scene does not contain; name the file."""
    from cotarget.config import check_shown

    try:
        check_shown(config, options.target)
    except ConfigError as error:
        raise ConfigError(f"{options.rig}: {error}") from None


def _opener(options: argparse.Namespace) -> "Callable[[Truth], Any]":
    """Give the function that opens a window on a world's truth.

    Raises:
        DeviceError: there is no display, no web viewer, or the port is in use.
    """
    if options.browser:
        from cotarget.sim.viewer.browser import BrowserWindow, listen

        return partial(BrowserWindow, listener=listen(PORT if options.port is None else options.port))
    from cotarget.sim.viewer.desktop import DesktopWindow, check_display

    check_display()
    return DesktopWindow


def _sights(
    options: argparse.Namespace, config: "RigConfig", world: "SimWorld", calibration: "Calibration | None"
) -> "Iterator[Snapshot]":
    """Give the snapshots: of the pipeline following a target, or of the rig at rest without one."""
    from cotarget.evaluation import true_calibration
    from cotarget.safety.safe_rig import guard

    seconds = math.inf if options.seconds is None else options.seconds
    with guard(world.rig, config.safety) as rig:
        if options.target is None:
            yield from _at_rest(rig, world.truth(), seconds)
        else:
            yield from _followed(options.target, config, calibration or true_calibration(world), world, rig, seconds)


def _at_rest(rig: "Rig", truth: "Truth", seconds: float) -> "Iterator[Snapshot]":
    from cotarget.sim.viewer.scene import Snapshot, frusta_of

    fixed = rig.fixed.read()
    for _ in itertools.count():
        t = rig.clock.now()
        pictures = {"fixed": fixed.image, "zoom": rig.zoom.read().image}
        yield Snapshot(t, f"t = {t:.1f} s", pictures, frusta_of(truth, t))  # type: ignore[arg-type]
        if t >= seconds:
            return
        fixed = rig.fixed.read(newer_than=fixed.t)


def _followed(
    name: str, config: "RigConfig", calibration: "Calibration", world: "SimWorld", rig: "Rig", seconds: float
) -> "Iterator[Snapshot]":
    from cotarget.drawing import draw_wide, draw_zoom
    from cotarget.pipeline import follow
    from cotarget.sim.viewer.scene import Snapshot, frusta_of

    truth = world.truth()
    target = config.target(name)
    for step in follow(rig, calibration, target, seconds=seconds):
        depths = {} if step.aim is None else {"zoom": step.aim.range}
        caption = f"t = {step.t:.1f} s   {name}: {step.state}"
        pictures = {"fixed": draw_wide(step), "zoom": draw_zoom(step)}
        yield Snapshot(step.t, caption, pictures, frusta_of(truth, step.t, depths))  # type: ignore[arg-type]


def demo(options: argparse.Namespace) -> None:
    """Run `cotarget demo`: calibrate a simulated rig and follow a book, a person and a bird."""
    from cotarget.demo import run_demo, summary

    with progress_bar() as progress:
        metrics = run_demo(options.out, options.seed, progress)
    print(summary(metrics))
    print(f"pictures, video and metrics.json are in {options.out} ({metrics['wall_s']:.0f} s)")


NEVER_CONFIRMED, NOBODY_FOLLOWED = 3, 4  # exit statuses of `follow`


def follow(options: argparse.Namespace) -> int:
    """Run `cotarget follow`: follow a target with the rig, and record it on request; return the exit status."""
    from cotarget.backends import describe, load_config
    from cotarget.recording.recorder import Recorder
    from cotarget.safety.safe_rig import guard
    from cotarget.safety.stop_file import refuse_if_stopped
    from cotarget.targeting import target_implausibility

    config = load_config(options.rig)
    refuse_if_stopped(config.safety.stop_file)
    target = target_of(config, options.target)  # refuse an unknown target before the long work
    spec = describe(config)
    calibration = load_plausible(options.calibration, spec, insist=options.insist)
    _check_shown(config, options)
    check_outputs(_files(options), [*rig_files(options.rig, config), options.calibration], options.record)
    if not options.insist and (text := target_implausibility(target, calibration, spec, options.target)):
        raise ConfigError(f"{options.rig}: {text}; --insist follows it all the same")
    selection = Selection(options, spec.fixed.size)
    with (
        Recorder(options.record, config, options.calibration, options.target, selection.selector)
        if options.record
        else nothing() as recorder
    ):

        def opened() -> "Rig":
            rig = open_named(options.rig, config, guarded=False)
            return guard(recorder.wrap(rig) if recorder else rig, config.safety)

        run = _follow(
            opened, calibration, config, spec.fixed.rate_hz, options, options.target, selection, options.seconds
        )
        if run.interrupted is None:  # a run cut short may not have had the time to see anything
            _tell_if_nothing_was_seen("follow", options.target, target, run.counts["states"], selection)
        print_json(run.counts, options.csv)
        if run.interrupted is not None:
            raise run.interrupted
    return exit_status(run.counts["states"], run.confirmed)


def _files(options: argparse.Namespace) -> list[Path | None]:
    """List the files that a run writes; a table may go to stdout instead."""
    return [None if options.csv == STDOUT else options.csv, options.video]


def replay(options: argparse.Namespace) -> int:
    """Run `cotarget replay`: run the pipeline on a recording and compare its commands; return the exit status."""
    from cotarget.backends import open_recording
    from cotarget.calibration import load_calibration
    from cotarget.metrics import Tracked, read_labels
    from cotarget.recording.replay import Replay
    from cotarget.safety.safe_rig import guard

    recording = open_recording(options.recording)
    for note in recording.notes:
        print(f"{options.recording}: {note}", file=sys.stderr)
    calibration = load_calibration(recording.calibration)
    inputs = [*rig_files(None, recording.config), options.recording, options.labels]
    check_outputs(_files(options), inputs)
    labels = None if options.labels is None else read_labels(options.labels)
    pictures, tracks = recording.pictures, list[Tracked]()

    def see(step: "Step") -> None:
        number = pictures[step.fixed.t]
        tracks.extend(Tracked(number, step.fixed.t, each.id, each.center_px) for each in step.tracks if each.confirmed)

    played, rate_hz = Replay(recording), recording.spec.fixed.rate_hz
    selection = Selection(options, recording.spec.fixed.size, recording.selector_table)
    config, name, steps = recording.config, recording.target, recording.steps

    def opened() -> "Rig":
        return guard(played.rig, config.safety)

    run = _follow(opened, calibration, config, rate_hz, options, name, selection, None, steps, see, played)
    if run.interrupted is not None:
        raise run.interrupted
    _tell_if_nothing_was_seen("replay", name, config.target(name), run.counts["states"], selection)
    scores = _scores(options, tracks, labels, rate_hz, max(pictures.values(), default=-1) + 1)
    differences = played.differences
    print_json(run.counts | {"differences": dataclasses.asdict(differences)} | scores, options.csv)
    if not differences.same:
        print(f"cotarget replay: {differences}", file=sys.stderr)
    return 1 if options.check and not differences.same else 0


@dataclasses.dataclass(frozen=True)
class _Run:
    """Result of following.

    Attributes:
        counts: what is printed as JSON.
        confirmed: number of frames in which the zoom camera showed the followed target.
        interrupted: the Ctrl-C that cut the run short.
    """

    counts: dict[str, Any]
    confirmed: int
    interrupted: KeyboardInterrupt | None = None


def exit_status(states: "Mapping[State, int]", confirmed: int) -> int:
    """Exit status of `follow`: 0 for a target that was followed and, where there was time for it, confirmed.

    Args:
        states: number of frames in each state.
        confirmed: number of frames in which the zoom camera showed the followed target.
    """
    from cotarget.pipeline import State

    if not any(states[each] for each in (State.FOLLOWING, State.COASTING, State.UNCONFIRMED)):
        return NOBODY_FOLLOWED
    # A wrong match in a few frames confirms nothing; a target hidden from the zoom camera for a while was confirmed
    # before or after.
    return NEVER_CONFIRMED if states[State.UNCONFIRMED] > confirmed else 0


def _follow(
    opened: "Callable[[], Rig]",
    calibration: "Calibration",
    config: "RigConfig",
    rate_hz: float,
    options: argparse.Namespace,
    name: str,
    selection: Selection,
    seconds: float | None,
    frames: int | None = None,
    see: "Callable[[Step], None]" = lambda _: None,
    replay: "Replay | None" = None,
) -> _Run:
    """Follow a target with progress and outputs.

    However it ends, the head is halted first. The files are completed afterwards, with the steps up to then. A run
    without a length, in seconds or frames, ends by Ctrl-C.
    """
    from cotarget.detection import make_detector
    from cotarget.drawing import side_by_side
    from cotarget.pipeline import State, follow
    from cotarget.recording.recorder import StepTable, utc_text
    from cotarget.recording.replay import until_end
    from cotarget.video import FilmWriter

    target = config.target(name)
    detector = make_detector(target, rate_hz)
    states: dict[str, int] = dict.fromkeys(State, 0)
    confirmed, reasons, skipped, lens = 0, Reasons(), SkippedFrames(), LensAtItsEnd(name, target)
    limit = math.inf if seconds is None else seconds
    expected = frames if math.isinf(limit) else math.ceil(limit * rate_hz)
    is_live, first_t, epoch = config.backend == "hardware" and frames is None, None, None
    interrupted: KeyboardInterrupt | None = None
    try:
        with (
            StepTable(options.csv, keep=True) as table,
            FilmWriter(options.video, rate_hz, keep=True) if options.video else nothing() as film,
            progress_bar() as progress,
            opened() as rig,
        ):
            epoch = datetime.now(UTC) - timedelta(seconds=rig.clock.now()) if is_live else None
            table.epoch = epoch
            if film is not None:
                film.epoch = epoch
            try:
                # `follow` has checked calibration and target; a recorded run is replayed with whatever it had.
                selector = selection.selector
                followed = follow(rig, calibration, target, detector, selector=selector, seconds=limit, insist=True)
                for step in until_end(followed, replay):
                    table.write(step)
                    for each in (selection, reasons, skipped, lens):
                        each.see(step)
                    see(step)
                    first_t = step.fixed.t if first_t is None else first_t
                    states[step.state] += 1
                    confirmed += step.found is not None and step.state is not State.UNCONFIRMED
                    if film is not None:
                        film.write(side_by_side(step, name, step.fixed.t - first_t), step.fixed.t)
                    progress(f"following: {name}: {step.state}", step.index + 1, expected)
            except KeyboardInterrupt:
                if expected is not None or first_t is None:
                    raise
    except KeyboardInterrupt as end:
        if first_t is None:
            raise
        interrupted = end
    for line in filter(None, (selection.unmet, reasons.warning, skipped.warning, lens.warning)):
        print(f"cotarget {options.command}: {line}", file=sys.stderr)
    counts = {
        "steps": sum(states.values()),
        "skipped": skipped.count,
        "states": states,
        "reasons": reasons.table,
        "started": None if epoch is None or first_t is None else utc_text(epoch, first_t),
    }
    return _Run(counts, confirmed, interrupted)


# What a detector needs to find a target.
NEEDED = {
    "colour": "what --target names has to look like its template",
    "motion": "what --target names has to move",
    "mog2": "what --target names has to move",
    "speck": "what --target names has to move",
}


def _tell_if_nothing_was_seen(
    command: str, name: str, target: "TargetProfile", states: dict[str, int], selection: Selection
) -> None:
    """Print a hint where no target was detected in the whole run."""
    from cotarget.pipeline import State

    steps = sum(states.values())
    if steps and states[State.SEARCHING] == steps and not selection.unmet:
        why = {"replay": "the recording has none, or is too short for one to be believed"}.get(
            command, f"{NEEDED.get(target.detector, 'what --target names has to be')} in the fixed camera's view"
        )
        print(
            f"cotarget {command}: no {name} was seen in {steps} frames; {why}; --video FILE shows that view (an "
            "emulated rig has who is in its [sim] targets)",
            file=sys.stderr,
        )


def detect(options: argparse.Namespace) -> None:
    """Run `cotarget detect`: run the fixed camera's detector and tracker on a video."""
    from cotarget.backends import load_config
    from cotarget.config import RigConfig
    from cotarget.detect_video import run_on_film
    from cotarget.metrics import read_labels, read_tracks

    config = RigConfig() if options.rig is None else load_config(options.rig)
    target = target_of(config, options.target)
    if options.csv == STDOUT and options.labels is not None:
        raise ConfigError("--labels: scores the table of --csv; name its file, not -")
    if options.film.is_dir():
        raise ConfigError(f"{options.film}: is a directory; give a film")
    inputs = [options.film, options.labels, *rig_files(options.rig, config)]
    check_outputs(_files(options), inputs)
    labels = None if options.labels is None else read_labels(options.labels)
    with progress_bar() as progress:
        found = run_on_film(
            options.film,
            target,
            options.csv,
            options.video,
            lambda done, total: progress(f"detecting: {options.target}", done, total or done),
            keep=True,
        )
    whole = found.shortfall is None
    if labels and whole and min(labels) > found.last_frame:
        raise ConfigError(
            f"{options.labels}: no labelled frame is in the film, whose last one is {found.last_frame}; give the "
            "labels of this film, with frames from 0"
        )
    tracks = [] if labels is None else read_tracks(options.csv)
    scores = _scores(options, tracks, labels, found.rate_hz, found.last_frame + 1, whole=whole)
    print_json(dataclasses.asdict(found) | scores, options.csv)
    if not whole:
        print(f"{options.film}: is not whole: {found.shortfall}; the results are of what there is", file=sys.stderr)


def _scores(
    options: argparse.Namespace,
    tracks: "Iterable[Tracked]",
    labels: "Mapping[int, Sequence[Label]] | None",
    rate_hz: float,
    frames: int,
    *,
    whole: bool = True,
) -> dict[str, Any]:
    """Score tracks against labels; empty without labels."""
    from cotarget.metrics import score_tracks

    if labels is None:
        return {}
    score = score_tracks(tracks, labels, rate_hz, frames)
    if score.labels_beyond_end:
        print(
            f"{options.labels}: {score.labels_beyond_end} of {len(labels)} labelled frames are beyond the last one, "
            f"{frames - 1}, and are not counted{'; are the labels of another film?' if whole else ''}",
            file=sys.stderr,
        )
    return dataclasses.asdict(score)


def doctor(options: argparse.Namespace) -> int:
    """Run `cotarget doctor`: check the installation and print fixes; return the exit status."""
    from cotarget.doctor import examine

    config = None
    if options.rig is not None:
        from cotarget.backends import load_config

        config = load_config(options.rig)
    findings = examine(config) if options.rig is None else examine(config, options.rig)
    for finding in findings:
        print(f"{'ok     ' if finding.ok else 'MISSING'}  {finding.name}: {finding.text}")
        if finding.fix:
            print(f"         fix: {finding.fix}")
    return 0 if all(finding.ok for finding in findings) else 1
