"""Calibrate from a rig, from saved captures, or from plain photos: `cotarget calibrate --captures captures`."""

import argparse
import contextlib
import dataclasses
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cotarget.cli.common import (
    BOARD_KINDS,
    RIG,
    add_file,
    board_corners,
    check_board_size,
    check_outputs,
    open_named,
    positive,
    previous_kept,
    print_json,
    rig_files,
    whole,
)
from cotarget.errors import CalibrationError, ConfigError
from cotarget.parallel import progress_bar

if TYPE_CHECKING:
    from cotarget.calibration import Calibration


PHOTOS = ("fixed", "zoom", "board", "square")  # options that plain photos need
LISTS = ("index.json", "session.json", "commands.jsonl")  # files beside the images of a session
SESSION = ("placements", "stops")  # options of a capture session


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    source = parser.add_mutually_exclusive_group()
    about = f"rig.toml: drive that rig through a capture plan ({RIG})"
    source.add_argument("--rig", type=Path, metavar="FILE", help=about)
    source.add_argument("--from", type=Path, metavar="DIR", dest="source", help="captures taken earlier, or photos")
    about = "file to write (calibration.json); an earlier one is kept under another name"
    add_file(parser, "--out", about, default=Path("calibration.json"))
    add_file(parser, "--captures", "with --rig: keep the images in this folder", "DIR")
    parser.add_argument("--fixed", metavar="GLOB", help="photos of the fixed camera, such as 'left*.jpg'")
    about = "photos of the zoom camera, paired by the numbers in their names"
    parser.add_argument("--zoom", metavar="GLOB", help=about)
    about = "inner corners of the board, such as 9x6"
    parser.add_argument("--board", type=board_corners, metavar="CxR", help=about)
    parser.add_argument("--square", type=positive, metavar="M", help="side of a square [m]")
    parser.add_argument("--kind", choices=BOARD_KINDS, help=f"kind of the board on photos ({BOARD_KINDS[0]})")
    about = "with --rig: number of board placements at the shortest focal length, at least 7 (30)"
    parser.add_argument("--placements", type=whole(1), metavar="N", help=about)
    about = (
        "with --rig: number of zoom samples, more where they are too far apart; 1: shortest alone, otherwise with "
        "6 more placements far away (8)"
    )
    parser.add_argument("--stops", type=whole(1), metavar="N", help=about)
    methods = ("joint", "sequential")  # compared by `python -m experiments chain`
    parser.add_argument("--method", choices=methods, default="joint", help=argparse.SUPPRESS)
    parser.add_argument("--encoders", action="store_true", help="calibrate the encoders' scales and zeros too")
    about = "go on where the motions leave something undetermined, with an uncertainty to match"
    parser.add_argument("--insist", action="store_true", help=about)


def run(options: argparse.Namespace) -> None:
    """Calibrate, write the calibration, and print a summary."""
    from cotarget import calibration as cal
    from cotarget.backends import load_config
    from cotarget.calibration.calibrate import calibrate as calibrate_rig
    from cotarget.config import BoardConfig
    from cotarget.safety.stop_file import refuse_if_stopped

    if options.source is None:
        options.rig = options.rig or RIG
    config = None if options.rig is None else load_config(options.rig)
    inputs = _photos(options) if config is None else rig_files(options.rig, config)
    check_outputs([], inputs, options.captures)
    check_outputs([options.out], [*inputs, *_lists(options.captures)])
    if config is not None and config.backend == "replay":
        raise ConfigError(f"{options.rig}: backend is 'replay'; calibrate from the captures of a session: --from DIR")
    _check_together(options)
    how = cal.Options(options.method, encoders=options.encoders, regularize=options.insist)
    with _captures_kept(options.captures), progress_bar() as bar:

        def progress(done: float, total: float | None, text: str) -> None:
            bar(done, total, f"calibrating: {text}")

        if config is not None:
            refuse_if_stopped(config.safety.stop_file)
            check_board_size(options.rig, config)
            with open_named(options.rig, config) as rig:
                found = calibrate_rig(
                    rig,
                    captures_dir=options.captures,
                    progress=progress,
                    seed=config.sim.seed,
                    options=how,
                    **{name: getattr(options, name) for name in _given(options, SESSION)},
                )
        elif options.board is not None:
            board = BoardConfig(options.kind or "chessboard", options.board, options.square)
            found = cal.calibrate_photos(
                options.source, options.fixed, options.zoom, board, options=how, progress=progress
            )
        else:
            found = cal.calibrate_captures(options.source, options=how, progress=progress)
        with previous_kept(options.out):
            found.save(options.out)
    _print_result(found, options.out)


def _print_result(found: "Calibration", path: Path) -> None:
    """Print the verdict in a sentence to a terminal, and the whole summary as JSON to anything else."""
    residuals = found.residuals
    assert residuals is not None
    if left_out := len(residuals.rejected):
        images = left_out + residuals.fixed_views + residuals.zoom_views
        print(f"not used: {left_out} of {images} images; {path} has the reasons (residuals.rejected)", file=sys.stderr)
    table = calibration_summary(found, path)
    if sys.stdout.isatty():
        print(f"{path}: {table['verdict']}")
    else:
        print_json(table)


def _lists(directory: Path | None) -> list[Path]:
    """List the files that describe a folder of captures."""
    return [] if directory is None else [directory / name for name in LISTS]


def _photos(options: argparse.Namespace) -> list[Path]:
    """List the files that are read from a folder of captures or photos; other files there may be outputs."""
    from cotarget.calibration.captures import matching, read_index

    directory, globs = options.source, [glob for glob in (options.fixed, options.zoom) if glob is not None]
    found = _lists(directory)
    with contextlib.suppress(CalibrationError):  # an unreadable file is reported when it is read
        for glob in globs:
            found += matching(directory, glob)
        if not globs:
            found += [directory / capture.source for capture in read_index(directory).captures if capture.source]
    return found


@contextlib.contextmanager
def _captures_kept(directory: Path | None) -> Iterator[None]:
    """Print, if a session fails or is interrupted, that its captures can be used."""
    index = None if directory is None else directory / "index.json"
    others = index is not None and index.exists()  # from an earlier session, which this one does not change
    try:
        yield
    except BaseException:
        if index is not None and index.exists() and not others:
            with contextlib.suppress(OSError):  # a closed terminal must not hide the error
                print(
                    f"the captures so far are in {directory}: cotarget calibrate --from {directory} fits them",
                    file=sys.stderr,
                )
        raise


def _given(options: argparse.Namespace, names: Sequence[str]) -> list[str]:
    return [name for name in names if getattr(options, name) is not None]


def _check_together(options: argparse.Namespace) -> None:
    """Refuse options of calibrate that contradict each other or have no effect."""
    from cotarget.config import check_square

    photos = _given(options, (*PHOTOS, "kind"))
    for name in ("encoders", "insist"):
        if getattr(options, name) and options.method == "sequential":
            raise ConfigError(f"--{name} goes with --method joint; the sequential method is the paper's")
    if options.rig is not None:
        if photos:
            raise ConfigError(f"--{photos[0]} goes with --from DIR; with --rig, the board is in rig.toml")
        return
    if session := _given(options, SESSION):
        raise ConfigError(f"--{session[0]} goes with --rig; it does not change saved captures")
    if options.captures is not None:
        raise ConfigError("--captures goes with --rig; saved captures are read with --from DIR alone")
    if photos:
        if missing := [name for name in PHOTOS if name not in photos]:
            raise ConfigError(f"plain photos need --{missing[0]} too: --fixed, --zoom, --board and --square")
        check_square(options.square, "--square")
        if options.encoders:
            raise ConfigError("--encoders goes with --rig or saved captures; plain photos have no head angles")
    elif not options.source.is_dir():
        raise ConfigError(f"{options.source}: no such folder; --from takes a folder of captures or photos")
    elif not (options.source / "index.json").exists():
        raise ConfigError(
            f"{options.source}: holds no index.json of captures; photos need --fixed, --zoom, --board and --square"
        )


def calibration_summary(found: "Calibration", path: Path) -> dict[str, Any]:
    """Build the output of calibrate: residuals, pointing accuracy and verdict."""
    import numpy as np

    from cotarget.report.analysis import MORE_PLACEMENTS, can_point, pointing, with_more_placements
    from cotarget.report.text import judge

    assert found.residuals is not None
    residuals = {k: v for k, v in dataclasses.asdict(found.residuals).items() if k != "rejected"}
    table = residuals | {
        "rejected": len(found.residuals.rejected),
        "baseline_m": float(np.linalg.norm(found.zoom_head.T_zoom0_fixed.translation)),
        "head_jitter_deg": math.degrees(found.jitter),
        "held_out": None if found.held_out is None else dataclasses.asdict(found.held_out),
    }
    if can_point(found):
        at = pointing(found)
        table |= {
            "predicted_error_deg": {f"{one.nominal_px:.0f} px": math.degrees(one.rms) for one in at},
            f"predicted_error_deg_with_{MORE_PLACEMENTS}_more_placements": {
                f"{one.nominal_px:.0f} px": math.degrees(with_more_placements(found, one)) for one in at
            },
        }
    return table | {"verdict": judge(found).text, "calibration": str(path)}
