"""Run the fixed camera's detector and tracker on a video: `cotarget detect film.mp4 --target bird --csv tracks.csv`."""

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from cotarget.cli.common import (
    add_file,
    check_outputs,
    length,
    print_json,
    ratio,
    rig_files,
    scores_of,
    warn_shortfall,
    warn_unscored,
)
from cotarget.errors import ConfigError, naming
from cotarget.files import STDOUT
from cotarget.parallel import progress_bar

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cotarget.config import Polygon, TargetProfile
    from cotarget.track_metrics import Criterion


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_file(parser, "film", "video to search, or with --labels a folder of videos", "VIDEO")
    about = "a target of rig.toml, or one of book, person, bird"
    parser.add_argument("--target", required=True, metavar="NAME", help=about)
    about = "search with this detector (that of the target)"
    parser.add_argument("--detector", choices=("auto", "mog2", "motion", "speck"), help=about)
    about = (
        "write one line per reported track and frame, to stdout with -: u_px and v_px are the centre of the box, "
        "which ends at the image's border; the score is 0 where the box is only predicted; for a folder of videos, an "
        "existing folder for their tables"
    )
    add_file(parser, "--csv", about, required=True)
    add_file(parser, "--video", "write the video with the tracks drawn (.mp4)", "OUT")
    add_file(parser, "--rig", "rig.toml, for targets of your own")
    about = (
        "detect nothing in the regions of this file: TOML with ignored = [[[u, v], [u, v], [u, v]], ...], polygons of "
        "three or more points in parts of the picture from 0 to 1; or a rig.toml, with its [follow] ignored"
    )
    add_file(parser, "--ignore", about)
    about = (
        "score the tracks by these boxes: a csv with frame,x_px,y_px,width_px,height_px, all from 0; x and y are of "
        "the box's top-left pixel; or ground truth of the MOT-challenge; a file without boxes for a video without "
        "targets; for a folder of videos, a folder"
    )
    add_file(parser, "--labels", about)
    add_file(parser, "--sheet", "write a picture of the longest misses and false tracks in a folder of videos", "PNG")
    about = "least intersection over union of a track on a label above --small-px (0.5)"
    parser.add_argument("--iou", type=ratio, default=0.5, metavar="R", help=about)
    about = "judge labels up to this larger side by the centres: at most that side apart (24)"
    parser.add_argument("--small-px", type=length, default=24.0, metavar="N", help=about)


def run(options: argparse.Namespace) -> None:
    """Search a video, or the videos of a folder, and print a summary."""
    from cotarget.backends import load_config
    from cotarget.config import RigConfig, read_ignored
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
    ignored = () if options.ignore is None else read_ignored(options.ignore)
    inputs = [*rig_files(options.rig, config), options.ignore]
    if options.film.is_dir():
        _detect_in_folder(options, target, criterion, inputs, ignored)
        return
    if options.sheet is not None:
        raise ConfigError(f"--sheet: shows the mistakes in a folder of videos, and {options.film} is none")
    if options.csv == STDOUT and options.labels is not None:
        raise ConfigError("--labels: scores the table of --csv; name its file, not -")
    table = None if options.csv == STDOUT else options.csv
    check_outputs([table, options.video], [options.film, options.labels, *inputs])
    labels = None if options.labels is None else labels_of_film(options.film, options.labels)
    with progress_bar() as progress:
        found = run_on_film(options.film, target, options.csv, options.video, progress, keep=True, ignored=ignored)
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
    options: argparse.Namespace,
    target: "TargetProfile",
    criterion: "Criterion",
    inputs: list[Path | None],
    ignored: "Sequence[Polygon]",
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
        found = run_on_folder(films, target, options.csv, options.sheet, criterion, progress, ignored)
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
