"""Command-line parser and entry point of all commands.

Machine-readable output goes to stdout or to the named file. An error ends in one line on stderr and a non-zero exit
status.
"""

import argparse
import codecs
import contextlib
import io
import logging
import os
import signal
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any, NoReturn

from cotarget.cli import calibrating, following, operating, running
from cotarget.cli.common import board_corners, duration, length, number, port, positive, ratio, whole
from cotarget.cli.following import add_selection
from cotarget.errors import CotargetError
from cotarget.safety.signals import leave

USAGE = 2  # argparse's own exit status


class Parser(argparse.ArgumentParser):
    """Argument parser whose errors end in one line.

    Attributes:
        make_epilog: gives the last paragraph of --help; called only when help is printed.
    """

    make_epilog: Callable[[], str] | None = None

    def format_help(self) -> str:
        """Format the help, with the paragraph of ``make_epilog`` at its end."""
        if self.make_epilog is not None:
            self.epilog = self.make_epilog()
        return super().format_help()

    def _print_message(self, message: str, file: Any = None) -> None:
        """Print a help text or an error, which argparse does too; exit with status 1 where stdout does not take it."""
        file = file or sys.stderr
        try:
            print(message, end="", file=file, flush=True)
        except OSError as error:
            if file is sys.stdout:
                self.exit(1, "" if isinstance(error, BrokenPipeError) else f"{self.prog}: {error.strerror or error}\n")

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
KINDS = ("chessboard", "charuco")  # kinds of calibration board
# The matrices here are small: where other programs use the cores, a second thread of linear algebra makes the work up
# to 100 times slower. numpy reads the variable when it is imported; a user's OPENBLAS_NUM_THREADS takes precedence.
ONE_THREAD = ("OMP_NUM_THREADS", "1")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return its exit status."""
    os.environ.setdefault(*ONE_THREAD)
    codecs.register_error(AS_GIVEN, _encode_as_given)
    for descriptor, name in enumerate(("stdout", "stderr"), start=1):
        _prepare(descriptor, name)
    try:
        return _run(make_parser().parse_args(arguments))
    finally:
        for stream in (sys.stdout, sys.stderr):
            _drop_unwritten(stream)


def _run(options: argparse.Namespace) -> int:
    """Run the command of parsed options, and print in one line how it ended."""
    # SIGTERM and SIGHUP raise SystemExit, so that the rig halts and files are completed, as on Ctrl-C.
    for ending in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(ending) is signal.SIG_DFL:  # nohup ignores SIGHUP; keep that
            signal.signal(ending, leave)
    level = logging.INFO if options.verbose else logging.WARNING
    logging.basicConfig(level=level, format="%(message)s", handlers=[StderrHandler()])
    logging.getLogger("httpx").setLevel(logging.WARNING)  # httpx logs every request at INFO
    try:
        status = int(options.run(options) or 0)
        sys.stdout.flush()
        return status
    except CotargetError as error:
        text = str(error).replace("insist=True", "--insist")
        if getattr(options, "rig", None) is not None:  # the safety layer does not know the file's name
            text = text.replace("--rig FILE", f"--rig {options.rig}")
        _print_end(options.command, text, error)
        return 1
    except BrokenPipeError:
        return 1
    except OSError as error:  # not caught by the commands' own checks, such as a full disk
        where = "" if error.filename is None else f"{error.filename}: "
        _print_end(options.command, f"{where}{error.strerror or error}", error)
        return 1
    except KeyboardInterrupt as end:
        _print_end(options.command, "interrupted", end)
        return INTERRUPTED
    except SystemExit as end:
        if _notes(end):
            _print_end(options.command, "terminated", end)
        raise


# Standard streams

AS_GIVEN = "cotarget.as_given"  # name of `_encode_as_given` for codecs


def _encode_as_given(error: UnicodeError) -> tuple[str | bytes, int]:
    """Encode what the locale cannot: bytes of a name or an argument as they were given, others with a backslash."""
    try:
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.lookup_error("backslashreplace")(error)


class ClosedStdout(io.TextIOBase):
    """Stdout that was closed: what is printed fails, as on a full disk."""

    def write(self, text: str) -> int:
        """Refuse a text."""
        raise OSError("stdout is closed")


def _prepare(descriptor: int, name: str) -> None:
    """Let a standard stream write any name; replace a closed one, whose descriptor the next file would get."""
    stream = getattr(sys, name)
    if stream is None:
        _open_nothing(descriptor)
        setattr(sys, name, ClosedStdout() if name == "stdout" else os.fdopen(descriptor, "w", closefd=False))
    elif isinstance(stream, io.TextIOWrapper):
        stream.reconfigure(errors=AS_GIVEN)


def _drop_unwritten(stream: IO[str]) -> None:
    """Drop what a stream did not take, which would change the exit status when Python flushes it."""
    try:
        stream.flush()
    except OSError:
        with contextlib.suppress(OSError):  # without a descriptor there is nothing that Python flushes
            _open_nothing(stream.fileno())


def _open_nothing(descriptor: int) -> None:
    nothing = os.open(os.devnull, os.O_RDWR)
    if nothing != descriptor:
        os.dup2(nothing, descriptor)
        os.close(nothing)


class StderrHandler(logging.Handler):
    """Print records on what is stderr at the moment, so that a progress bar moves below them."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record."""
        with contextlib.suppress(OSError):  # the terminal may be closed
            print(self.format(record), file=sys.stderr)


def _print_end(command: str, text: str, end: BaseException) -> None:
    """Print in one line how a command ended, with the notes on the files that it was writing."""
    with contextlib.suppress(OSError):  # the terminal may be closed
        print("; ".join([f"cotarget {command}: {text}", *_notes(end)]), file=sys.stderr)


def _notes(end: BaseException) -> list[str]:
    return getattr(end, "__notes__", [])


DESCRIPTION = "A fixed camera finds a small target; a zoom camera on a pan-tilt head shows it large."
FOLLOW_STATUSES = (
    "exit status: 0 the target was followed; 1 an error; 2 a wrong option; 3 the zoom camera mostly did not show the "
    "target; 4 no target was followed; 130 Ctrl-C ended a run with --seconds"
)

Command = Callable[[str, Callable[[argparse.Namespace], int | None], str], Parser]  # adds a parser of one command


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line, with a parser for each command."""
    parser = Parser(prog="cotarget", description=DESCRIPTION)
    parser.add_argument("--version", action="version", version=f"cotarget {version('cotarget')}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=CommandParser)

    def command(name: str, run: Callable[[argparse.Namespace], int | None], summary: str) -> Parser:
        made = commands.add_parser(name, help=summary, description=summary)
        made.add_argument("-v", "--verbose", action="store_true", help="report more of what is done")
        made.set_defaults(run=run)
        return made

    for add_commands in (_add_calibration, _add_following, _add_operation, _add_inspection):
        add_commands(command)
    return parser


def _add_calibration(command: Command) -> None:
    """Add demo, calibrate and report."""
    demo = command("demo", running.demo_command, "calibrate a simulated rig and follow a book, a person and a bird")
    _add_file(demo, "--out", "where to write (demo-out)", "DIR", default=Path("demo-out"))
    demo.add_argument("--seed", type=whole(0), default=0, help="seed of everything random (0)")

    calibrate = command(
        "calibrate", calibrating.calibrate_command, "calibrate from a rig, from saved captures, or from plain photos"
    )
    source = calibrate.add_mutually_exclusive_group(required=True)
    source.add_argument("--rig", type=Path, metavar="FILE", help="rig.toml: drive that rig through a capture plan")
    source.add_argument("--from", type=Path, metavar="DIR", dest="source", help="captures taken earlier, or photos")
    about = "file to write (calibration.json); an earlier one is kept under another name"
    _add_file(calibrate, "--out", about, default=Path("calibration.json"))
    _add_file(calibrate, "--captures", "with --rig: keep the images in this folder", "DIR")
    calibrate.add_argument("--fixed", metavar="GLOB", help="photos of the fixed camera, such as 'left*.jpg'")
    calibrate.add_argument(
        "--zoom", metavar="GLOB", help="photos of the zoom camera, paired by the numbers in their names"
    )
    calibrate.add_argument("--board", type=board_corners, metavar="CxR", help="inner corners of the board, such as 9x6")
    calibrate.add_argument("--square", type=positive, metavar="M", help="side of a square [m]")
    calibrate.add_argument("--kind", choices=KINDS, help=f"kind of the board on photos ({KINDS[0]})")
    calibrate.add_argument(
        "--placements",
        type=whole(1),
        metavar="N",
        help="with --rig: number of board placements at the shortest focal length, at least 7 (30)",
    )
    calibrate.add_argument(
        "--stops",
        type=whole(1),
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

    report = command("report", calibrating.report_command, "write a page on how far a calibration can be trusted")
    _add_file(report, "calibration", "calibration.json")
    _add_file(report, "--out", "file to write (report.html)", "PAGE", default=Path("report.html"))
    _add_insist(report)


def _add_following(command: Command) -> None:
    """Add aim, follow and replay."""
    about = "solve pan, tilt and focal length for one pixel of the fixed camera; JSON on stdout"
    aim = command("aim", operating.aim_command, about)
    _add_file(aim, "--calibration", "calibration.json", required=True)
    aim.add_argument("--pixel", type=float, nargs=2, required=True, metavar=("U", "V"), help="pixel of the fixed image")
    how_far = aim.add_mutually_exclusive_group(required=True)
    how_far.add_argument("--depth", type=positive, metavar="M", help="depth along the fixed camera's axis [m]")
    how_far.add_argument(
        "--size-px", type=positive, metavar="S", help="size of the target of --target in the fixed image [px]"
    )
    aim.add_argument("--target", metavar="NAME", help="a target of rig.toml, for its size and its wanted size")
    how_close = aim.add_mutually_exclusive_group()
    how_close.add_argument(
        "--wanted-px", type=positive, metavar="N", help="wanted size in the close-up (the target's) [px]"
    )
    how_close.add_argument("--focal-mm", type=positive, metavar="F", help="focal length to use [mm]")
    _add_file(aim, "--rig", "rig.toml, for limits and targets (the default rig)")
    aim.add_argument(
        "--ik",
        choices=("exact", "paper-table", "paper-example"),
        default="exact",
        help="inverse kinematics: exact, or a reading of the paper's shortcut (exact)",
    )
    _add_insist(aim)

    follow = command("follow", following.follow_command, "follow a target with a calibrated rig")
    _add_file(follow, "--rig", "rig.toml", required=True)
    _add_file(follow, "--calibration", "calibration.json", required=True)
    follow.add_argument("--target", required=True, metavar="NAME", help="a target of rig.toml")
    add_selection(follow)
    follow.add_argument("--seconds", type=duration, metavar="S", help="duration [s] (until Ctrl-C)")
    _add_outputs(follow)
    _add_file(follow, "--record", "record everything, for cotarget replay", "DIR")
    _add_insist(follow)
    follow.epilog = FOLLOW_STATUSES

    replay = command("replay", following.replay_command, "run the pipeline again on a recording of follow --record")
    _add_file(replay, "recording", "folder of the recording", "DIR")
    add_selection(replay, "as in the recorded run")
    about = "end with status 1 if the commands differ from the recorded ones"
    replay.add_argument("--check", action="store_true", help=about)
    about = "score the tracks by these labels: a csv as for detect, whose frame is the image number in DIR/fixed"
    _add_file(replay, "--labels", about)
    _add_outputs(replay)


def _add_operation(command: Command) -> None:
    """Add the commands that operate a rig, and emulate."""
    about = "move head and lens to given values, and take a picture with each camera"
    point = command("point", operating.point_command, about)
    _add_file(point, "--rig", "rig.toml", required=True)
    point.add_argument("--pan-deg", type=number, metavar="A", help="pan, positive to the right (unchanged)")
    point.add_argument("--tilt-deg", type=number, metavar="A", help="tilt, positive up (unchanged)")
    point.add_argument("--focal-mm", type=positive, metavar="F", help="focal length [mm] (unchanged)")
    about = "write fixed.png and zoom.png to this folder; earlier ones are kept under other names"
    _add_file(point, "--pictures", about, "DIR")

    about = "measure the latencies and command delays of cameras, head and lens"
    latency = command("latency", operating.latency_command, about)
    _add_file(latency, "--rig", "rig.toml", required=True)
    about = "calibration.json; measures the fixed camera too, by a board that is swung"
    _add_file(latency, "--calibration", about)
    _add_insist(latency)

    about = "emergency stop of every rig that watches this rig.toml's stop file"
    stop = command("stop", operating.stop_command, about)
    _add_file(stop, "--rig", "rig.toml", required=True)
    about = "reason, which every stopped program reports"
    stop.add_argument("--reason", default="stopped by the operator", metavar="TEXT", help=about)

    clear = command("clear", operating.clear_command, "end an emergency stop, when it is safe to move")
    _add_file(clear, "--rig", "rig.toml", required=True)

    about = "let the pan-tilt head find its limits; it turns through its whole range"
    reset_head = command("reset-head", operating.reset_head_command, about)
    _add_file(reset_head, "--rig", "rig.toml", required=True)
    reset_head.add_argument("--yes", action="store_true", help="confirm that camera and cables are clear of it")

    about = "put a simulated rig behind the real devices' protocols, in real time"
    emulate = command("emulate", operating.emulate_command, about)
    _add_file(emulate, "--rig", "rig.toml of the simulated rig (the default rig)")
    _add_file(emulate, "--write", "rig.toml to write, which connects to it", required=True)
    emulate.add_argument("--host", default="127.0.0.1", help="address to listen at (127.0.0.1: this machine alone)")
    for name in ("head", "fixed", "zoom", "board", "control"):
        emulate.add_argument(f"--{name}", type=port, default=0, metavar="PORT", help="port to listen at (any free one)")
    emulate.add_argument("--tcp", action="store_true", help="connect the head by TCP instead of a serial port")
    emulate.add_argument("--user", default="", metavar="NAME", help="user name that the fixed camera asks for (none)")
    about = "fault to be on from the start, one of those below; the control socket switches faults later"
    emulate.add_argument("--fault", action="append", default=[], metavar="DEVICE.FAULT", help=about)
    emulate.add_argument("--seconds", type=duration, metavar="S", help="duration [s] (until Ctrl-C)")
    emulate.make_epilog = operating.fault_names


def _add_inspection(command: Command) -> None:
    """Add view, detect, board and doctor."""
    about = "show the simulated scene, both cameras' frusta and their images"
    view = command("view", running.view_command, about)
    _add_file(view, "--rig", "rig.toml of the simulated rig (the default rig)")
    view.add_argument("--target", metavar="NAME", help="follow this target of rig.toml")
    _add_file(view, "--calibration", "calibration.json (the simulation's true calibration)")
    _add_insist(view)
    view.add_argument("--browser", action="store_true", help="serve a page for a web browser on this machine")
    view.add_argument("--port", type=port, metavar="P", help=f"port of the page; 0: any free one ({running.PORT})")
    about = "duration by the clock on the wall [s] (until it is closed, or Ctrl-C)"
    view.add_argument("--seconds", type=duration, metavar="S", help=about)

    detect = command("detect", running.detect_command, "run the fixed camera's detector and tracker on any video")
    _add_file(detect, "film", "video to search, or with --labels a folder of videos", "VIDEO")
    about = "a target of rig.toml, or one of book, person, bird"
    detect.add_argument("--target", required=True, metavar="NAME", help=about)
    about = "search with this detector (that of the target)"
    detect.add_argument("--detector", choices=("auto", "mog2", "motion", "speck"), help=about)
    about = (
        "write one line per confirmed track and frame, to stdout with -: u_px and v_px are the box's centre, the score "
        "is 0 where the box is only predicted; for a folder of videos, an existing folder for their tables"
    )
    _add_file(detect, "--csv", about, required=True)
    _add_file(detect, "--video", "write the video with the tracks drawn (.mp4)", "OUT")
    _add_file(detect, "--rig", "rig.toml, for targets of your own")
    about = (
        "score the tracks by these boxes: a csv with frame,x_px,y_px,width_px,height_px, all from 0; x and y are of "
        "the box's top-left pixel; or ground truth of the MOT-challenge; for a folder of videos, a folder"
    )
    _add_file(detect, "--labels", about)
    _add_file(detect, "--sheet", "write a picture of the longest misses and false tracks in a folder of videos", "PNG")
    about = "least intersection over union of a track on a label (0.3)"
    detect.add_argument("--iou", type=ratio, default=0.3, metavar="R", help=about)
    about = (
        "judge boxes up to this side by their centres: at most the label's larger side apart, or the track's in a "
        "larger label (24)"
    )
    detect.add_argument("--small-px", type=length, default=24.0, metavar="N", help=about)

    board = command("board", calibrating.board_command, "write a calibration board to print, to scale")
    _add_file(board, "--out", "file to write: .pdf, .svg or .png", required=True)
    about = "kind of board; charuco has markers (chessboard)"
    board.add_argument("--kind", choices=KINDS, default=KINDS[0], help=about)
    board.add_argument("--board", type=board_corners, default=(9, 6), metavar="CxR", help="inner corners (9x6)")
    board.add_argument("--square", type=positive, default=0.025, metavar="M", help="side of a square [m] (0.025)")

    about = "check versions, rendering and devices, and print the command that fixes what is missing"
    doctor = command("doctor", running.doctor_command, about)
    _add_file(doctor, "--rig", "rig.toml: check its devices too, without moving them")


def _add_file(parser: Parser, name: str, about: str, metavar: str = "FILE", **more: Any) -> None:
    """Add an option or argument that names a file or folder."""
    parser.add_argument(name, type=Path, metavar=metavar, help=about, **more)


def _add_outputs(parser: Parser) -> None:
    """Add the options of a run's table and video."""
    _add_file(parser, "--csv", "write one line a step; -: to stdout")
    _add_file(parser, "--video", "write a side-by-side video (.mp4)")


def _add_insist(parser: Parser) -> None:
    """Add the option that accepts implausible values."""
    parser.add_argument("--insist", action="store_true", help="accept what is far outside of anything plausible")
