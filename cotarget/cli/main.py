"""Command-line parser and entry point of all commands.

Machine-readable output goes to stdout or to the named file. An error ends in one line on stderr and a non-zero exit
status.
"""

import argparse
import contextlib
import logging
import os
import signal
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

from cotarget.cli import calibrating, operating, running
from cotarget.cli.common import (
    add_insist,
    add_selection,
    corners,
    count,
    duration,
    not_negative,
    number,
    port,
    positive,
)
from cotarget.errors import CotargetError

USAGE = 2  # argparse's own exit status


class Parser(argparse.ArgumentParser):
    """Argument parser whose errors end in one line.

    Attributes:
        more: gives the last paragraph of --help; called only when help is printed.
    """

    more: Callable[[], str] | None = None

    def format_help(self) -> str:
        """Format the help, with the paragraph from ``more`` at its end."""
        if self.more is not None:
            self.epilog = self.more()
        return super().format_help()

    def error(self, message: str) -> NoReturn:
        """Exit with one line on stderr, without the usage."""
        self.exit(USAGE, f"{self.prog}: {message}; see {self.prog} --help\n")


class CommandParser(Parser):
    """Parser of one command, which rejects unknown options itself, so that the error names that command's --help."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse the arguments as argparse does, and reject unknown ones."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found, unknown


# Each command imports the heavy modules (MuJoCo, OpenCV, matplotlib) that it needs, so that --help and wrong arguments
# answer at once, and `doctor` runs where one of them is broken.
INTERRUPTED = 130  # a shell's exit status for Ctrl-C
TERMINATED = 143  # for SIGTERM
HUNG_UP = 129  # for SIGHUP, from a closed terminal or a broken connection
KINDS = ("chessboard", "charuco")  # kinds of calibration board
# The matrices here are small: a second thread of linear algebra only waits for the first, up to a hundred times longer
# than the work takes where other programs use the cores. Read when numpy is loaded; OPENBLAS_NUM_THREADS, if a user has
# set it, goes before it.
ONE_THREAD = ("OMP_NUM_THREADS", "1")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return its exit status."""
    os.environ.setdefault(*ONE_THREAD)
    parser = _parser()
    options = parser.parse_args(arguments)
    # SIGTERM and SIGHUP raise SystemExit, so that the rig halts and files are completed, as on Ctrl-C.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:  # nohup ignores SIGHUP; keep that
        signal.signal(signal.SIGHUP, lambda *_: sys.exit(HUNG_UP))
    level = logging.INFO if options.verbose else logging.WARNING
    logging.basicConfig(level=level, format="%(message)s", handlers=[StderrHandler()])
    logging.getLogger("httpx").setLevel(logging.WARNING)  # httpx logs every request at INFO
    try:
        status = int(options.run(options) or 0)
        sys.stdout.flush()
        return status
    except CotargetError as error:
        _say(options.command, str(error), error)
        return 1
    except BrokenPipeError:
        return 1
    except OSError as error:  # not caught by the commands' own checks, such as a full disk
        where = "" if error.filename is None else f"{error.filename}: "
        _say(options.command, f"{where}{error.strerror or error}", error)
        return 1
    except KeyboardInterrupt as end:
        _say(options.command, "interrupted", end)
        return INTERRUPTED
    except SystemExit as end:
        if _notes(end):
            _say(options.command, "terminated", end)
        raise


class StderrHandler(logging.Handler):
    """Print records on what is stderr at the moment, so that a progress bar moves below them."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record."""
        with contextlib.suppress(OSError):  # the terminal may be closed
            print(self.format(record), file=sys.stderr)


def _say(command: str, text: str, end: BaseException) -> None:
    """Print in one line how a command ended, with the notes on which files are unchanged."""
    with contextlib.suppress(OSError):  # the terminal may be closed
        print("; ".join([f"cotarget {command}: {text}", *_notes(end)]), file=sys.stderr)


def _notes(end: BaseException) -> list[str]:
    return getattr(end, "__notes__", [])


DESCRIPTION = "A fixed camera finds a small target; a zoom camera on a pan-tilt head shows it large."


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="cotarget", description=DESCRIPTION)
    parser.add_argument("--version", action="version", version=f"cotarget {version('cotarget')}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=CommandParser)

    def command(name: str, run: Callable[[argparse.Namespace], int | None], summary: str) -> Parser:
        made = commands.add_parser(name, help=summary, description=summary)
        made.add_argument("-v", "--verbose", action="store_true", help="report more of what is done")
        made.set_defaults(run=run)
        return made

    demo = command("demo", running.demo, "calibrate a simulated rig and follow a book, a person and a bird")
    demo.add_argument("--out", type=Path, default=Path("demo-out"), metavar="DIR", help="where to write (demo-out)")
    demo.add_argument("--seed", type=not_negative, default=0, help="seed of everything random (0)")

    calibrate = command(
        "calibrate", calibrating.calibrate, "calibrate from a rig, from saved captures, or from plain photos"
    )
    source = calibrate.add_mutually_exclusive_group(required=True)
    source.add_argument("--rig", type=Path, metavar="FILE", help="rig.toml: drive that rig through a capture plan")
    source.add_argument("--from", type=Path, metavar="DIR", dest="source", help="captures taken earlier, or photos")
    calibrate.add_argument(
        "--out",
        type=Path,
        default=Path("calibration.json"),
        metavar="FILE",
        help="file to write (calibration.json); an earlier one is kept under another name",
    )
    calibrate.add_argument("--captures", type=Path, metavar="DIR", help="with --rig: keep the images in this folder")
    calibrate.add_argument("--fixed", metavar="GLOB", help="photos of the fixed camera, such as 'left*.jpg'")
    calibrate.add_argument(
        "--zoom", metavar="GLOB", help="photos of the zoom camera, paired by the numbers in their names"
    )
    calibrate.add_argument("--board", type=corners, metavar="CxR", help="inner corners of the board, such as 9x6")
    calibrate.add_argument("--square", type=positive, metavar="M", help="side of a square [m]")
    calibrate.add_argument("--kind", choices=KINDS, help=f"kind of the board on photos ({KINDS[0]})")
    calibrate.add_argument(
        "--placements",
        type=count,
        metavar="N",
        help="with --rig: number of board placements at the shortest focal length, at least 7 (30)",
    )
    calibrate.add_argument(
        "--stops",
        type=count,
        metavar="N",
        help="with --rig: number of zoom samples, more where they are too far apart; 1: shortest alone, otherwise with "
        "6 more placements far away (8)",
    )
    calibrate.add_argument(
        "--method",
        choices=("joint", "sequential"),
        default="joint",
        help="one fit of everything, or the paper's step-by-step method (joint)",
    )
    calibrate.add_argument("--encoders", action="store_true", help="calibrate the encoders' scales and zeros too")
    calibrate.add_argument(
        "--insist",
        action="store_true",
        help="go on where the motions leave something undetermined, with an uncertainty to match",
    )

    report = command("report", calibrating.report, "write a page on how far a calibration can be trusted")
    report.add_argument("calibration", type=Path, metavar="FILE", help="calibration.json")
    report.add_argument(
        "--out", type=Path, default=Path("report.html"), metavar="PAGE", help="file to write (report.html)"
    )

    add_insist(report)

    aim = command(
        "aim",
        operating.aim,
        "solve pan, tilt and focal length for one pixel of the fixed camera; JSON on stdout",
    )
    aim.add_argument("--calibration", type=Path, required=True, metavar="FILE", help="calibration.json")
    aim.add_argument("--pixel", type=float, nargs=2, required=True, metavar=("U", "V"), help="pixel of the fixed image")
    how_far = aim.add_mutually_exclusive_group(required=True)
    how_far.add_argument("--depth", type=positive, metavar="M", help="depth along the fixed camera's axis [m]")
    how_far.add_argument(
        "--size-px", type=positive, metavar="S", help="size of the target of --target in the fixed image [px]"
    )
    aim.add_argument("--target", metavar="NAME", help="a target of rig.toml, for its size")
    how_close = aim.add_mutually_exclusive_group()
    how_close.add_argument("--wanted-px", type=positive, metavar="N", help="wanted size in the close-up [px]")
    how_close.add_argument("--focal-mm", type=positive, metavar="F", help="focal length to use [mm]")
    aim.add_argument("--rig", type=Path, metavar="FILE", help="rig.toml, for limits and targets (the default rig)")
    aim.add_argument(
        "--ik",
        choices=("exact", "paper-table", "paper-example"),
        default="exact",
        help="inverse kinematics: exact, or a reading of the paper's shortcut (exact)",
    )
    add_insist(aim)

    follow = command("follow", running.follow, "follow a target with a calibrated rig")
    follow.add_argument("--rig", type=Path, required=True, metavar="FILE", help="rig.toml")
    follow.add_argument("--calibration", type=Path, required=True, metavar="FILE", help="calibration.json")
    follow.add_argument("--target", required=True, metavar="NAME", help="a target of rig.toml")
    add_selection(follow)
    follow.add_argument("--seconds", type=duration, metavar="S", help="duration [s] (until Ctrl-C)")
    follow.add_argument("--csv", type=Path, metavar="FILE", help="write one line a step; -: to stdout")
    follow.add_argument("--video", type=Path, metavar="FILE", help="write a side-by-side video (.mp4)")
    follow.add_argument("--record", type=Path, metavar="DIR", help="record everything, for cotarget replay")
    add_insist(follow)

    replay = command("replay", running.replay, "run the pipeline again on a recording of follow --record")
    replay.add_argument("recording", type=Path, metavar="DIR", help="folder of the recording")
    add_selection(replay, "as in the recorded run")
    replay.add_argument(
        "--check",
        action="store_true",
        help="end with status 1 if the commands differ from the recorded ones",
    )
    replay.add_argument(
        "--labels",
        type=Path,
        metavar="FILE",
        help="score the tracks by these labels: a csv as for detect, whose frame is the image number in DIR/fixed",
    )
    replay.add_argument("--csv", type=Path, metavar="FILE", help="write one line a step; -: to stdout")
    replay.add_argument("--video", type=Path, metavar="FILE", help="write a side-by-side video (.mp4)")

    point = command("point", operating.point, "move head and lens to given values, and take a picture with each camera")
    point.add_argument("--rig", type=Path, required=True, metavar="FILE", help="rig.toml")
    point.add_argument("--pan-deg", type=number, metavar="A", help="pan, positive to the right (unchanged)")
    point.add_argument("--tilt-deg", type=number, metavar="A", help="tilt, positive up (unchanged)")
    point.add_argument("--focal-mm", type=positive, metavar="F", help="focal length [mm] (unchanged)")
    point.add_argument(
        "--pictures",
        type=Path,
        metavar="DIR",
        help="write fixed.png and zoom.png to this folder; earlier ones are kept under other names",
    )

    latency = command(
        "latency", operating.latency, "measure the latencies and command delays of cameras, head and lens"
    )
    latency.add_argument("--rig", type=Path, required=True, metavar="FILE", help="rig.toml")
    latency.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help="calibration.json; measures the fixed camera too, by a board that is swung",
    )
    add_insist(latency)

    stop = command("stop", operating.stop, "emergency stop of every rig that watches this rig.toml's stop file")
    stop.add_argument("--rig", type=Path, required=True, metavar="FILE", help="rig.toml")
    stop.add_argument(
        "--reason",
        default="stopped by the operator",
        metavar="TEXT",
        help="reason, which every stopped program reports",
    )

    clear = command("clear", operating.clear, "end an emergency stop, when it is safe to move")
    clear.add_argument("--rig", type=Path, required=True, metavar="FILE", help="rig.toml")

    reset_head = command(
        "reset-head", operating.reset_head, "let the pan-tilt head find its limits; it turns through its whole range"
    )
    reset_head.add_argument("--rig", type=Path, required=True, metavar="FILE", help="rig.toml")
    reset_head.add_argument("--yes", action="store_true", help="confirm that camera and cables are clear of it")

    emulate = command(
        "emulate", operating.emulate, "put a simulated rig behind the real devices' protocols, in real time"
    )
    emulate.add_argument("--rig", type=Path, metavar="FILE", help="rig.toml of the simulated rig (the default rig)")
    emulate.add_argument(
        "--write", type=Path, required=True, metavar="FILE", help="rig.toml to write, which connects to it"
    )
    emulate.add_argument("--host", default="127.0.0.1", help="address to listen at (127.0.0.1: this machine alone)")
    for name in ("head", "fixed", "zoom", "board", "control"):
        emulate.add_argument(f"--{name}", type=port, default=0, metavar="PORT", help="port to listen at (any free one)")
    emulate.add_argument("--tcp", action="store_true", help="connect the head by TCP instead of a serial port")
    emulate.add_argument("--user", default="", metavar="NAME", help="user name that the fixed camera asks for (none)")
    emulate.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="DEVICE.FAULT",
        help="fault to be on from the start, one of those below; the control socket switches faults later",
    )
    emulate.more = operating.fault_names
    emulate.add_argument("--seconds", type=duration, metavar="S", help="duration [s] (until Ctrl-C)")

    view = command("view", running.view, "show the simulated scene, both cameras' frusta and their images")
    view.add_argument("--rig", type=Path, metavar="FILE", help="rig.toml of the simulated rig (the default rig)")
    view.add_argument("--target", metavar="NAME", help="follow this target of rig.toml")
    view.add_argument(
        "--calibration", type=Path, metavar="FILE", help="calibration.json (the simulation's true calibration)"
    )
    view.add_argument("--browser", action="store_true", help="serve a page for a web browser on this machine")
    view.add_argument("--port", type=port, metavar="P", help=f"port of the page; 0: any free one ({running.PORT})")
    view.add_argument("--seconds", type=duration, metavar="S", help="duration [s] (until it is closed, or Ctrl-C)")

    detect = command("detect", running.detect, "run the fixed camera's detector and tracker on any video")
    detect.add_argument("film", type=Path, metavar="VIDEO", help="video to search")
    detect.add_argument(
        "--target", required=True, metavar="NAME", help="a target of rig.toml, or one of book, person, bird"
    )
    detect.add_argument(
        "--csv",
        type=Path,
        required=True,
        metavar="FILE",
        help="write one line per confirmed track and frame, to stdout with -: u_px and v_px are the box's centre, the "
        "score is 0 where the box is only predicted",
    )
    detect.add_argument("--video", type=Path, metavar="OUT", help="write the video with the tracks drawn (.mp4)")
    detect.add_argument("--rig", type=Path, metavar="FILE", help="rig.toml, for targets of your own")
    detect.add_argument(
        "--labels",
        type=Path,
        metavar="FILE",
        help="score the tracks by these boxes: a csv with frame,x_px,y_px,width_px,height_px, all from 0; x and y are "
        "of the box's top-left pixel",
    )

    board = command("board", calibrating.board, "write a calibration board to print, to scale")
    board.add_argument("--out", type=Path, required=True, metavar="FILE", help="file to write: .pdf, .svg or .png")
    board.add_argument(
        "--kind", choices=KINDS, default=KINDS[0], help="kind of board; charuco has markers (chessboard)"
    )
    board.add_argument("--board", type=corners, default=(9, 6), metavar="CxR", help="inner corners (9x6)")
    board.add_argument("--square", type=positive, default=0.025, metavar="M", help="side of a square [m] (0.025)")

    doctor = command(
        "doctor",
        running.doctor,
        "check versions, rendering and devices, and print the command that fixes what is missing",
    )
    doctor.add_argument("--rig", type=Path, metavar="FILE", help="rig.toml: check its devices too, without moving them")
    return parser
