"""Commands that show, demonstrate and inspect: view, demo, detect, doctor."""

import argparse
import dataclasses
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING, Any

from cotarget.cli.common import (
    check_outputs,
    previous_kept,
    print_json,
    progress_bar,
    rig_files,
    scores_of,
    warn_shortfall,
    warn_unscored,
)
from cotarget.errors import ConfigError, naming
from cotarget.files import STDOUT

if TYPE_CHECKING:
    from pathlib import Path

    from cotarget.calibration import Calibration
    from cotarget.config import RigConfig, TargetProfile
    from cotarget.rig import Rig
    from cotarget.sim.truth import Truth
    from cotarget.sim.viewer.scene import Snapshot
    from cotarget.sim.world import SimWorld
    from cotarget.track_metrics import Criterion


PORT = 8080  # port of the page
TARGETS = ("person", "bird")  # targets of the scene without --rig and --target


def view_command(options: argparse.Namespace) -> None:
    """Run `cotarget view`: show the simulated scene, with the pipeline at work where a target is named."""
    from cotarget.calibration import Calibration
    from cotarget.evaluation import true_calibration
    from cotarget.pipeline import check_run
    from cotarget.sim.world import SimWorld

    if options.port is not None and not options.browser:
        raise ConfigError("--port: needs --browser, which serves a page at that port")
    if options.calibration is not None and options.target is None:
        raise ConfigError("--calibration: needs --target NAME, the target to follow")
    config = _config(options)
    calibration = None if options.calibration is None else Calibration.load(options.calibration)
    opened = window_opener(options)  # called first, because making the world takes a while
    with closing(SimWorld(config)) as world, closing(opened(world.truth())) as window:
        if options.target is not None:
            calibration = calibration or true_calibration(world)
            files, target = (options.calibration or "calibration", options.rig or ""), config.target(options.target)
            check_run(calibration, world.rig.spec, target, options.target, insist=options.insist, files=files)
        print(f"{window.where} shows the scene; Ctrl-C ends it", file=sys.stderr, flush=True)
        try:
            seconds = math.inf if options.seconds is None else options.seconds
            watch(_snapshots(options, config, world, calibration), window, time.monotonic, time.sleep, seconds)
        except KeyboardInterrupt:
            print("", file=sys.stderr)


def watch(
    snapshots: "Iterator[Snapshot]",
    window: Any,
    now: Callable[[], float],
    sleep: Callable[[float], None],
    seconds: float = math.inf,
) -> None:
    """Show snapshots no faster than in real time, until they end, the window is closed, or the wall clock's time is up.

    The wall clock starts at the time of the first snapshot.
    """
    ahead, end = math.inf, None  # lead of the rig's clock over the wall clock, and the wall clock's end
    for snapshot in snapshots:
        window.show(snapshot)
        end = now() + seconds - snapshot.t if end is None else end
        if not window.is_open():
            return
        ahead = min(ahead, snapshot.t - now())  # a slow machine does not catch up afterwards
        if (wait := snapshot.t - ahead - now()) > 0:
            sleep(wait)
        if now() >= end:
            return


def _config(options: argparse.Namespace) -> "RigConfig":
    """Load or make the configuration of the rig to view."""
    from cotarget.backends import load_config
    from cotarget.config import RigConfig
    from cotarget.demo import SCENES, sim_config

    if options.rig is None:
        if options.target is not None:
            with naming("--target"):  # an unknown one is refused before the long work
                RigConfig().target(options.target)
        targets = TARGETS if options.target is None else (options.target,)
        return sim_config(SCENES.get(targets[0].rstrip("0123456789"), "outdoor"), targets, 0)
    config = load_config(options.rig)
    if config.backend != "sim":
        raise ConfigError(f"{options.rig}: backend is '{config.backend}'; what is viewed is a simulated rig")
    if options.target is not None:
        with naming("--target"):
            config.target(options.target)
    return config


def window_opener(options: argparse.Namespace) -> "Callable[[Truth], Any]":
    """Return the function that opens a window on a world's truth; refuse a missing display and a port in use."""
    if options.browser:
        from cotarget.sim.viewer.browser import BrowserWindow, listen

        return partial(BrowserWindow, listener=listen(PORT if options.port is None else options.port))
    from cotarget.sim.viewer.desktop import DesktopWindow, check_display

    check_display()
    return DesktopWindow


def _snapshots(
    options: argparse.Namespace, config: "RigConfig", world: "SimWorld", calibration: "Calibration | None"
) -> "Iterator[Snapshot]":
    """Yield snapshots of the pipeline following a target, or of the rig at rest without a calibration."""
    from cotarget.safety.safe_rig import guard

    with guard(world.rig, config.safety) as rig:
        if calibration is None:
            yield from _at_rest(rig, world.truth())
        else:
            yield from _followed(options, config, calibration, world, rig)


def _at_rest(rig: "Rig", truth: "Truth") -> "Iterator[Snapshot]":
    from cotarget.sim.viewer.scene import Snapshot, frusta_of

    fixed = rig.fixed.read()
    while True:
        t = rig.clock.now()
        pictures = {"fixed": fixed.image, "zoom": rig.zoom.read().image}
        yield Snapshot(t, f"t = {t:.1f} s", pictures, frusta_of(truth, t))  # type: ignore[arg-type]
        fixed = rig.fixed.read(newer_than=fixed.t)


def _followed(
    options: argparse.Namespace, config: "RigConfig", calibration: "Calibration", world: "SimWorld", rig: "Rig"
) -> "Iterator[Snapshot]":
    from cotarget.drawing import draw_wide, draw_zoom
    from cotarget.pipeline import run_steps
    from cotarget.sim.viewer.scene import Snapshot, frusta_of

    truth, name = world.truth(), options.target
    for step in run_steps(rig, calibration, config.target(name)):
        depths = {} if step.aim is None else {"zoom": step.aim.range}
        caption = f"t = {step.t:.1f} s   {name}: {step.state}"
        pictures = {"fixed": draw_wide(step), "zoom": draw_zoom(step)}
        yield Snapshot(step.t, caption, pictures, frusta_of(truth, step.t, depths))  # type: ignore[arg-type]


def demo_command(options: argparse.Namespace) -> None:
    """Run `cotarget demo`: calibrate a simulated rig and follow a book, a person and a bird."""
    from cotarget.demo import run_demo, summary

    with progress_bar() as progress, previous_kept(options.out / "calibration.json"):
        metrics = run_demo(options.out, options.seed, progress)
    print(summary(metrics))
    print(f"pictures, video and metrics.json are in {options.out} ({metrics['wall_s']:.0f} s)")


def detect_command(options: argparse.Namespace) -> None:
    """Run `cotarget detect`: run the fixed camera's detector and tracker on a video, or on a folder of videos."""
    from cotarget.backends import load_config
    from cotarget.config import RigConfig
    from cotarget.detect_video import labels_of_film, run_on_film
    from cotarget.track_metrics import Criterion, read_tracks

    config = RigConfig() if options.rig is None else load_config(options.rig)
    with naming("--target"):
        target = config.target(options.target)
    if options.detector is not None:
        target = dataclasses.replace(target, detector=options.detector)
    criterion = Criterion(options.iou, options.small_px)
    if options.labels is None and criterion != Criterion():
        raise ConfigError("--iou, --small-px: compare tracks with --labels, which are missing")
    inputs = rig_files(options.rig, config)
    if options.film.is_dir():
        _detect_in_folder(options, target, criterion, inputs)
        return
    if options.sheet is not None:
        raise ConfigError(f"--sheet: shows the mistakes in a folder of videos, and {options.film} is none")
    if options.csv == STDOUT and options.labels is not None:
        raise ConfigError("--labels: scores the table of --csv; name its file, not -")
    table = None if options.csv == STDOUT else options.csv
    check_outputs([table, options.video], [options.film, options.labels, *inputs])
    labels = None if options.labels is None else labels_of_film(options.film, options.labels)
    with progress_bar() as progress:
        found = run_on_film(options.film, target, options.csv, options.video, progress, keep=True)
    whole = found.shortfall is None
    if labels and whole and min(labels) > found.last_frame:
        raise ConfigError(
            f"{options.labels}: no labelled frame is in the film, whose last one is {found.last_frame}; give the "
            "labels of this film, with frames from 0"
        )
    tracks = [] if labels is None else read_tracks(options.csv)
    frames = found.last_frame + 1
    scores = scores_of(options.labels, tracks, labels, found.rate_hz, frames, whole=whole, criterion=criterion)
    print_json(dataclasses.asdict(found) | scores, options.csv)
    warn_shortfall(options.film, found.shortfall)


def _detect_in_folder(
    options: argparse.Namespace, target: "TargetProfile", criterion: "Criterion", inputs: "list[Path | None]"
) -> None:
    """Score the videos of a folder by the labels of another; ``inputs`` are other files that are read."""
    from cotarget.detect_video import labelled_films, run_on_folder
    from cotarget.track_metrics import read_labels

    if options.video is not None:
        raise ConfigError("--video: draws the tracks of one video, not of a folder")
    if options.labels is None:
        raise ConfigError(f"--labels: missing; {options.film} is a folder, whose videos are scored by labels")
    if not options.labels.is_dir():
        raise ConfigError(f"--labels: {options.labels} is no folder; give one with a file of labels for each video")
    if options.csv == STDOUT or not options.csv.is_dir():
        raise ConfigError(f"--csv: {options.csv} is no folder; give an existing one for the tables of the videos")
    films = labelled_films(options.film, options.labels)
    tables = [options.csv / f"{film.stem}.csv" for film, _ in films]
    check_outputs([*tables, options.sheet], [*inputs, *(path for pair in films for path in pair)])
    if options.sheet is not None and options.sheet.suffix.lower() != ".png":
        raise ConfigError(f"--sheet: {options.sheet}: a PNG is written; name a .png")
    with progress_bar() as progress:
        found = run_on_folder(films, target, options.csv, options.sheet, criterion, progress)
    if not (found["pooled"]["films"] or any(one["shortfall"] for one in found["films"].values())):
        raise ConfigError(
            f"{options.labels}: no labelled frame is in any of the films; give the labels of these films, with frames "
            "from 0"
        )
    print_json(found)
    for film, file in films:
        one, labelled = found["films"][film.stem], len(read_labels(file))
        warn_shortfall(film, one["shortfall"])
        whole = one["shortfall"] is None
        beyond, scored = one["labels_beyond_end"], one["labelled_frames"]
        warn_unscored(file, beyond, scored, labelled, one["last_frame"], whole=whole)


WORDS = {True: "ok     ", None: "unknown", False: "MISSING"}  # of the doctor's findings


def doctor_command(options: argparse.Namespace) -> int:
    """Run `cotarget doctor`: check the installation and print fixes; return the exit status."""
    from cotarget.doctor import examine

    config = None
    if options.rig is not None:
        from cotarget.backends import load_config

        config = load_config(options.rig)
    findings = examine(config) if options.rig is None else examine(config, options.rig)
    for finding in findings:
        print(f"{WORDS[finding.ok]}  {finding.name}: {finding.text}")
        if finding.fix:
            print(f"         fix: {finding.fix}")
    return 1 if any(finding.ok is False for finding in findings) else 0
