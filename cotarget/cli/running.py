"""The commands that run what was calibrated, and look around: demo, follow, replay, detect, doctor."""

import argparse
import dataclasses
import json
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cotarget.cli.arguments import check_outputs, nothing, print_json, progress_bar
from cotarget.cli.choosing import Choice
from cotarget.errors import ConfigError

if TYPE_CHECKING:
    from cotarget.calibration import Calibration
    from cotarget.config import RigConfig
    from cotarget.loop import Step
    from cotarget.metrics import Label, Tracked
    from cotarget.rig import Rig


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
    target = config.target(options.target)
    calibration = load_calibration(options.calibration)
    if config.backend == "sim" and options.target not in config.sim.targets:
        raise ConfigError(
            f"{options.rig}: the simulated scene has no {options.target}; add it: [sim] targets = "
            f"{json.dumps([*config.sim.targets, options.target])}"
        )
    check_outputs([options.csv, options.video], [options.rig, options.calibration, target.template])
    choice = Choice(options, config.stream_sizes[0])
    with (
        Recorder(options.record, config, options.calibration, options.target)
        if options.record
        else nothing() as recorder,
        SafeRig(recorder.wrap(open_rig(config)) if recorder else open_rig(config), config.safety) as rig,
    ):
        states = _follow(rig, calibration, config, options.target, choice, options.seconds, options.csv, options.video)
    _tell_if_nothing_was_seen("follow", options.target, states["states"], choice)
    print_json(states)


def replay(options: argparse.Namespace) -> None:
    """Cotarget replay."""
    from cotarget.calibration import load_calibration
    from cotarget.metrics import Tracked, read_labels
    from cotarget.replay import ReplayRig, open_recording
    from cotarget.safety import SafeRig

    recording = open_recording(options.recording)
    for note in recording.notes:
        print(f"{options.recording}: {note}", file=sys.stderr)
    calibration = load_calibration(recording.calibration)
    check_outputs([options.csv, options.video], [recording.calibration, options.labels])
    labels = None if options.labels is None else read_labels(options.labels)
    pictures, tracks = recording.pictures, list[Tracked]()

    def see(step: "Step") -> None:
        number = pictures[step.fixed.t]
        tracks.extend(Tracked(number, step.fixed.t, each.id, each.center_px) for each in step.tracks if each.confirmed)

    played = ReplayRig(recording)
    choice = Choice(options, played.fixed.size)
    with SafeRig(played, recording.config.safety) as rig:
        config, name, steps = recording.config, recording.target, recording.steps
        states = _follow(rig, calibration, config, name, choice, math.inf, options.csv, options.video, steps, see)
    _tell_if_nothing_was_seen("replay", recording.target, states["states"], choice)
    scores = _scores(tracks, labels, config.rate_hz, states["steps"])
    print_json(states | {"differences": dataclasses.asdict(played.differences)} | scores)


def _follow(
    rig: "Rig",
    calibration: "Calibration",
    config: "RigConfig",
    name: str,
    choice: Choice,
    seconds: float,
    csv: Path | None,
    video: Path | None,
    frames: int | None = None,
    see: "Callable[[Step], None]" = lambda _: None,
) -> dict[str, Any]:
    """Follow a target, show the progress, keep what is asked for; how many steps there were, and in which states."""
    from cotarget.detection import make_detector
    from cotarget.drawing import side_by_side
    from cotarget.loop import FollowSettings, State, follow
    from cotarget.recording import StepTable
    from cotarget.replay import until_end
    from cotarget.video import FilmWriter

    target = config.target(name)
    detector = make_detector(target, config.rate_hz)
    settings = FollowSettings(
        command_delay_s=config.command_delay_s, lens_delay_s=config.lens_delay_s, policy=choice.policy
    )
    states: dict[str, int] = dict.fromkeys(State, 0)
    expected = math.ceil(seconds * config.rate_hz) if frames is None else frames
    with (
        StepTable(csv) as table,
        FilmWriter(video, config.rate_hz) if video else nothing() as film,
        progress_bar() as progress,
    ):
        for step in until_end(follow(rig, calibration, target, detector, seconds=seconds, settings=settings)):
            table.write(step)
            choice.see(step)
            see(step)
            states[step.state] += 1
            if film is not None:
                film.write(side_by_side(step, name))
            progress(f"following: {name}: {step.state}", min(step.index + 1, expected), expected)
    if choice.unmet:
        print(choice.unmet, file=sys.stderr)
    return {"steps": sum(states.values()), "states": states}


def _tell_if_nothing_was_seen(command: str, name: str, states: dict[str, int], choice: Choice) -> None:
    """Say so where there was nothing to follow all the time, and what would be right."""
    from cotarget.loop import State

    steps = sum(states.values())
    if steps and states[State.SEARCHING] == steps and not choice.unmet:
        print(
            f"cotarget {command}: no {name} was seen in {steps} frames; what --target names has to move in the fixed "
            "camera's view, which --video FILE shows (an emulated rig has who is in its [sim] targets)",
            file=sys.stderr,
        )


def detect(options: argparse.Namespace) -> None:
    """Cotarget detect."""
    from cotarget.config import RigConfig, load_config
    from cotarget.film import run_on_film
    from cotarget.metrics import read_labels, read_tracks

    config = RigConfig() if options.rig is None else load_config(options.rig)
    target = config.target(options.target)
    check_outputs([options.csv, options.video], [options.film, options.rig, options.labels, target.template])
    labels = None if options.labels is None else read_labels(options.labels)
    with progress_bar() as progress:
        found = run_on_film(
            options.film,
            target,
            options.csv,
            options.video,
            lambda done, total: progress(f"detecting: {options.target}", done, total or done),
        )
    scores = _scores(read_tracks(options.csv), labels, found.rate_hz, found.frames)
    print_json(dataclasses.asdict(found) | scores)


def _scores(
    tracks: "Iterable[Tracked]", labels: "Mapping[int, Sequence[Label]] | None", rate_hz: float, frames: int
) -> dict[str, Any]:
    """How well tracks keep to what is labelled; nothing where nobody gave labels."""
    from cotarget.metrics import score_tracks

    return {} if labels is None else dataclasses.asdict(score_tracks(tracks, labels, rate_hz, frames))


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
