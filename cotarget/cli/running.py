"""The commands that run what was calibrated, and look around: demo, follow, replay, detect, doctor."""

import argparse
import dataclasses
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from cotarget.cli.arguments import check_outputs, nothing, print_json, progress_bar, rig_files
from cotarget.cli.choosing import Choice, check_shown
from cotarget.cli.reasons import Reasons
from cotarget.errors import ConfigError

if TYPE_CHECKING:
    from cotarget.calibration import Calibration
    from cotarget.config import RigConfig
    from cotarget.loop import Step
    from cotarget.metrics import Label, Tracked
    from cotarget.safety import SafeRig


def demo(options: argparse.Namespace) -> None:
    """Cotarget demo."""
    from cotarget.demo import run_demo, summary

    with progress_bar() as progress:
        metrics = run_demo(options.out, options.seed, progress)
    print(summary(metrics))
    print(f"pictures, video and metrics.json are in {options.out} ({metrics['wall_s']:.0f} s)")


def follow(options: argparse.Namespace) -> None:
    """Cotarget follow."""
    from cotarget.calibration import load_calibration
    from cotarget.config import load_config
    from cotarget.recording import Recorder
    from cotarget.rig import open_rig
    from cotarget.safety import SafeRig, refuse_if_stopped

    config = load_config(options.rig)
    refuse_if_stopped(config.safety.stop_file)
    config.target(options.target)  # refused now
    calibration = load_calibration(options.calibration)
    check_shown(config, options.target, options.rig)
    inputs = [*rig_files(options.rig, config), options.calibration]
    check_outputs([options.csv, options.video], inputs, options.record)
    choice = Choice(options, config.stream_sizes[0])
    with (
        Recorder(options.record, config, options.calibration, options.target, choice.whom)
        if options.record
        else nothing() as recorder
    ):

        def opened() -> SafeRig:
            return SafeRig(recorder.wrap(open_rig(config)) if recorder else open_rig(config), config.safety)

        states = _follow(opened, calibration, config, options, options.target, choice, options.seconds)
    _tell_if_nothing_was_seen("follow", options.target, states["states"], choice)
    print_json(states)


def replay(options: argparse.Namespace) -> int:
    """Cotarget replay."""
    from cotarget.calibration import load_calibration
    from cotarget.metrics import Tracked, read_labels
    from cotarget.replay import ReplayRig, open_recording
    from cotarget.safety import SafeRig

    recording = open_recording(options.recording)
    for note in recording.notes:
        print(f"{options.recording}: {note}", file=sys.stderr)
    calibration = load_calibration(recording.calibration)
    inputs = [*rig_files(None, recording.config), options.recording, options.labels]
    check_outputs([options.csv, options.video], inputs)
    labels = None if options.labels is None else read_labels(options.labels)
    pictures, tracks = recording.pictures, list[Tracked]()

    def see(step: "Step") -> None:
        number = pictures[step.fixed.t]
        tracks.extend(Tracked(number, step.fixed.t, each.id, each.center_px) for each in step.tracks if each.confirmed)

    played = ReplayRig(recording)
    choice = Choice(options, played.fixed.size, recording.whom)
    config, name, steps = recording.config, recording.target, recording.steps
    states = _follow(
        lambda: SafeRig(played, config.safety), calibration, config, options, name, choice, math.inf, steps, see
    )
    _tell_if_nothing_was_seen("replay", recording.target, states["states"], choice)
    scores = _scores(options, tracks, labels, config.rate_hz, max(pictures.values(), default=-1) + 1)
    differences = played.differences
    print_json(states | {"differences": dataclasses.asdict(differences)} | scores)
    if not differences.same:
        print(f"cotarget replay: {differences}", file=sys.stderr)
    return 1 if options.check and not differences.same else 0


def _follow(
    opened: "Callable[[], SafeRig]",
    calibration: "Calibration",
    config: "RigConfig",
    options: argparse.Namespace,
    name: str,
    choice: Choice,
    seconds: float,
    frames: int | None = None,
    see: "Callable[[Step], None]" = lambda _: None,
) -> dict[str, Any]:
    """Follow a target, show the progress, keep what is asked for; how many steps there were, in which states and why.

    However it ends, the head is halted first and the files are completed after that, with what there is by then.
    """
    from cotarget.detection import make_detector
    from cotarget.drawing import side_by_side
    from cotarget.loop import FollowSettings, State, follow
    from cotarget.recording import StepTable
    from cotarget.replay import until_end
    from cotarget.video import FilmWriter

    target = config.target(name)
    detector = make_detector(target, config.rate_hz)
    settings = FollowSettings.of(config, policy=choice.policy)
    states: dict[str, int] = dict.fromkeys(State, 0)
    reasons = Reasons()
    expected = math.ceil(seconds * config.rate_hz) if frames is None else frames
    with (
        StepTable(options.csv, keep=True) as table,
        FilmWriter(options.video, config.rate_hz, keep=True) if options.video else nothing() as film,
        progress_bar() as progress,
        opened() as rig,
    ):
        for step in until_end(follow(rig, calibration, target, detector, seconds=seconds, settings=settings)):
            table.write(step)
            choice.see(step)
            reasons.see(step)
            see(step)
            states[step.state] += 1
            if film is not None:
                film.write(side_by_side(step, name))
            progress(f"following: {name}: {step.state}", min(step.index + 1, expected), expected)
    for line in filter(None, (choice.unmet, reasons.warning and f"cotarget {options.command}: {reasons.warning}")):
        print(line, file=sys.stderr)
    return {"steps": sum(states.values()), "states": states, "reasons": reasons.table}


def _tell_if_nothing_was_seen(command: str, name: str, states: dict[str, int], choice: Choice) -> None:
    """Say so where there was nothing to follow all the time, and what would be right."""
    from cotarget.loop import State

    steps = sum(states.values())
    if steps and states[State.SEARCHING] == steps and not choice.unmet:
        why = {"replay": "the recording has none, or is too short for one to be believed"}.get(
            command, "what --target names has to move in the fixed camera's view"
        )
        print(
            f"cotarget {command}: no {name} was seen in {steps} frames; {why}; --video FILE shows that view (an "
            "emulated rig has who is in its [sim] targets)",
            file=sys.stderr,
        )


def detect(options: argparse.Namespace) -> None:
    """Cotarget detect."""
    from cotarget.config import RigConfig, load_config
    from cotarget.film import run_on_film
    from cotarget.metrics import read_labels, read_tracks

    config = RigConfig() if options.rig is None else load_config(options.rig)
    target = config.target(options.target)
    if options.film.is_dir():
        raise ConfigError(f"{options.film}: is a directory; give a film")
    inputs = [options.film, options.labels, *rig_files(options.rig, config)]
    check_outputs([options.csv, options.video], inputs)
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
    scores = _scores(options, read_tracks(options.csv), labels, found.rate_hz, found.last_frame + 1, whole=whole)
    print_json(dataclasses.asdict(found) | scores)
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
    """How well tracks keep to what is labelled; nothing where nobody gave labels."""
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
    """Cotarget doctor."""
    from cotarget.doctor import examine

    config = None
    if options.rig is not None:
        from cotarget.config import load_config

        config = load_config(options.rig)
    findings = examine(config)
    for finding in findings:
        print(f"{'ok     ' if finding.ok else 'MISSING'}  {finding.name}: {finding.text}")
        if finding.fix:
            print(f"         fix: {finding.fix}")
    return 0 if all(finding.ok for finding in findings) else 1
