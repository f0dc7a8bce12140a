"""Run the pipeline again on a recording of follow --record: `cotarget replay run1 --check`."""

import argparse
import dataclasses
import math
import sys
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from typing import TYPE_CHECKING

from cotarget.cli.common import add_file, check_outputs, print_json, rig_files, scores_of
from cotarget.cli.pipeline_run import (
    RunInputs,
    Selection,
    add_outputs,
    add_selection,
    output_files,
    run_observed,
    warn_if_unseen,
)

if TYPE_CHECKING:
    from cotarget.pipeline import Run, Step
    from cotarget.rig import Rig
    from cotarget.track_metrics import Tracked


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_file(parser, "recording", "folder of the recording", "DIR")
    add_selection(parser, "as in the recorded run")
    about = "end with status 1 if the commands differ from the recorded ones"
    parser.add_argument("--check", action="store_true", help=about)
    about = "score the tracks by these labels: a csv as for detect, whose frame is the image number in DIR/fixed"
    add_file(parser, "--labels", about)
    add_outputs(parser)
    about = "write one page with both films, tracks, states and plots, which a browser opens from disk (.html)"
    add_file(parser, "--html", about)


def run(options: argparse.Namespace) -> int:
    """Run the pipeline on a recording and compare its commands; return the exit status."""
    from cotarget.backends import open_recording
    from cotarget.calibration import Calibration
    from cotarget.control.policy import OnnxPolicy
    from cotarget.page.run_file import RunFile
    from cotarget.pipeline import FollowSettings
    from cotarget.recording.replay import Replay
    from cotarget.safety.safe_rig import guard
    from cotarget.track_metrics import read_labels

    recording = open_recording(options.recording)
    for note in recording.notes:
        print(f"{options.recording}: {note}", file=sys.stderr)
    calibration = Calibration.load(recording.calibration)
    config, name, rate_hz = recording.config, recording.target, recording.spec.fixed.rate_hz
    check_outputs([*output_files(options), options.html], [*rig_files(None, config), options.recording, options.labels])
    labels = None if options.labels is None else read_labels(options.labels)
    played, seen = Replay(recording), TracksByImage(recording.pictures)
    selection = Selection(options, recording.spec.fixed.size, recording.selector_table)

    def opened() -> "Rig":
        return guard(played.rig, config.safety)

    def operated(rig: "Rig", run: "Run") -> "Iterator[Step]":
        return run.follow(orders=played.orders)

    settings = None if recording.policy is None else FollowSettings(policy=OnnxPolicy(recording.policy))
    run = RunInputs(
        opened, config, calibration, name, rate_hz, selection, math.inf, recording.steps, played, settings=settings
    )
    if recording.orders:
        run = dataclasses.replace(run, operated=operated)
    with RunFile(options.html, recording) if options.html else nullcontext() as page:
        result = run_observed(run, options, seen, *([] if page is None else [page]))
    if result.interrupt is not None:
        raise result.interrupt
    warn_if_unseen("replay", run, result.counts)
    frames = max(recording.pictures.values(), default=-1) + 1
    scores = scores_of(options.labels, seen.tracks, labels, rate_hz, frames)
    differences = played.differences
    print_json(result.table | {"differences": dataclasses.asdict(differences)} | scores, options.csv)
    if not differences.same:
        print(f"cotarget replay: {differences}", file=sys.stderr)
    return 1 if options.check and not differences.same else 0


class TracksByImage:
    """The reported tracks of a replay within the image, with the numbers of the recorded images by exposure time."""

    warning = ""

    def __init__(self, numbers: Mapping[float, int]) -> None:
        self._numbers = numbers
        self.tracks: list[Tracked] = []

    def see(self, step: "Step") -> None:
        """Collect the tracks of a step."""
        from cotarget.geometry import within_image
        from cotarget.track_metrics import Tracked

        frame = self._numbers[step.fixed.t]
        height, width = step.fixed.image.shape[:2]
        self.tracks += [
            Tracked(*within_image(each.center_px, each.whole_px, (width, height)), frame, step.fixed.t, each.id)
            for each in step.tracks
            if each.reported
        ]
