"""The commands. Machine-readable output goes to stdout or the named file; a mistake ends in one line on stderr."""

import argparse
import dataclasses
import json
import logging
import math
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import cotarget
from cotarget.errors import ConfigError, CotargetError

# Heavy modules (MuJoCo, OpenCV, matplotlib) are imported by the command that needs them, so that --help and
# mistakes in the arguments answer at once, and `doctor` runs where one of them is broken.

USAGE = 2  # argparse's own exit status
INTERRUPTED = 130  # a shell's exit status for Ctrl-C
TERMINATED = 143  # and for SIGTERM


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return its exit status."""
    parser = _parser()
    options = parser.parse_args(arguments)
    # A polite end is an end: the rig halts and half-written files go, as on Ctrl-C.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    logging.basicConfig(level=logging.INFO if options.verbose else logging.WARNING, format="%(message)s")
    try:
        status = int(options.run(options) or 0)
        sys.stdout.flush()
        return status
    except CotargetError as error:
        print(f"cotarget {options.command}: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        return 1
    except OSError as error:  # a full disk, a folder without permission: whatever the commands' own checks missed
        where = "" if error.filename is None else f"{error.filename}: "
        print(f"cotarget {options.command}: {where}{error.strerror or error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"cotarget {options.command}: interrupted", file=sys.stderr)
        return INTERRUPTED


class _Parser(argparse.ArgumentParser):
    """A parser whose mistakes, too, end in one line."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, without the usage in front of it."""
        self.exit(USAGE, f"{self.prog}: {message}; see {self.prog} --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="cotarget", description=cotarget.__doc__)
    parser.add_argument("--version", action="version", version=f"cotarget {cotarget.__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, run: Callable[[argparse.Namespace], int | None], summary: str) -> argparse.ArgumentParser:
        made = commands.add_parser(name, help=summary, description=summary)
        made.add_argument("-v", "--verbose", action="store_true", help="say more about what is done")
        made.set_defaults(run=run)
        return made

    demo = command("demo", _demo, "calibrate a simulated rig and follow a book, a person and a bird")
    demo.add_argument("--out", type=Path, default=Path("demo-out"), metavar="DIR", help="where to write (demo-out)")
    demo.add_argument("--seed", type=_not_negative, default=0, help="of everything random (0)")

    calibrate = command("calibrate", _calibrate, "calibrate from a rig, from saved captures, or from plain photos")
    source = calibrate.add_mutually_exclusive_group(required=True)
    source.add_argument("--rig", type=Path, metavar="FILE", help="rig.toml: drive that rig through a capture plan")
    source.add_argument("--from", type=Path, metavar="DIR", dest="source", help="captures taken earlier, or photos")
    calibrate.add_argument(
        "--out", type=Path, default=Path("calibration.json"), metavar="FILE", help="what to write (calibration.json)"
    )
    calibrate.add_argument("--captures", type=Path, metavar="DIR", help="with --rig: keep the images there")
    calibrate.add_argument("--fixed", metavar="GLOB", help="photos of the fixed camera, such as 'left*.jpg'")
    calibrate.add_argument(
        "--zoom", metavar="GLOB", help="photos of the zoom camera, paired by the numbers in the names"
    )
    calibrate.add_argument("--board", type=_corners, metavar="CxR", help="inner corners of the board, such as 9x6")
    calibrate.add_argument("--square", type=_positive, metavar="M", help="side of a square [m]")

    report = command("report", _report, "tell whether to trust a calibration, on one page with pictures")
    report.add_argument("calibration", type=Path, metavar="FILE", help="calibration.json")
    report.add_argument(
        "--out", type=Path, default=Path("report.html"), metavar="PAGE", help="what to write (report.html)"
    )

    aim = command("aim", _aim, "solve pan, tilt and focal length for one pixel of the fixed camera; JSON on stdout")
    aim.add_argument("--calibration", type=Path, required=True, metavar="FILE", help="calibration.json")
    aim.add_argument("--pixel", type=float, nargs=2, required=True, metavar=("U", "V"), help="in the fixed view [px]")
    how_far = aim.add_mutually_exclusive_group(required=True)
    how_far.add_argument("--depth", type=_positive, metavar="M", help="along the fixed camera's axis [m]")
    how_far.add_argument("--size-px", type=_positive, metavar="S", help="how large the target of --target appears [px]")
    aim.add_argument("--target", metavar="NAME", help="a target of rig.toml, for its size")
    how_close = aim.add_mutually_exclusive_group()
    how_close.add_argument("--wanted-px", type=_positive, metavar="N", help="how large it shall appear [px]")
    how_close.add_argument("--focal-mm", type=_positive, metavar="F", help="the focal length to use [mm]")
    aim.add_argument("--rig", type=Path, metavar="FILE", help="rig.toml, for limits and targets (the default rig)")
    aim.add_argument("--ik", choices=("exact", "paper-table", "paper-example"), default="exact", help="(exact)")

    follow = command("follow", _follow, "follow a target with a calibrated rig")
    follow.add_argument("--rig", type=Path, required=True, metavar="FILE", help="rig.toml")
    follow.add_argument("--calibration", type=Path, required=True, metavar="FILE", help="calibration.json")
    follow.add_argument("--target", required=True, metavar="NAME", help="a target of rig.toml")
    follow.add_argument("--seconds", type=_positive, default=20.0, metavar="S", help="for how long (20)")
    follow.add_argument("--csv", type=Path, metavar="FILE", help="write one line a step")
    follow.add_argument("--video", type=Path, metavar="FILE", help="write a side-by-side video (.mp4)")

    detect = command("detect", _detect, "run the fixed camera's detector and tracker on any film")
    detect.add_argument("film", type=Path, metavar="VIDEO")
    detect.add_argument("--target", required=True, metavar="NAME", help="a target of rig.toml")
    detect.add_argument(
        "--csv", type=Path, required=True, metavar="FILE", help="confirmed tracks, one line each a frame"
    )
    detect.add_argument("--video", type=Path, metavar="OUT", help="write the film with the tracks drawn (.mp4)")
    detect.add_argument("--rig", type=Path, metavar="FILE", help="rig.toml, for targets of your own")

    board = command("board", _board, "write a calibration board to print, to scale")
    board.add_argument("--out", type=Path, required=True, metavar="FILE", help="a .pdf, .svg or .png")
    kinds = ("chessboard", "charuco")
    board.add_argument("--kind", choices=kinds, default=kinds[0], help="charuco has markers in it (chessboard)")
    board.add_argument("--board", type=_corners, default=(9, 6), metavar="CxR", help="inner corners (9x6)")
    board.add_argument("--square", type=_positive, default=0.025, metavar="M", help="side of a square [m] (0.025)")

    command("doctor", _doctor, "versions, rendering, and for each thing that is missing the command that fixes it")
    return parser


def _demo(options: argparse.Namespace) -> None:
    from cotarget.demo import run_demo, summary

    with _progress() as progress:
        metrics = run_demo(options.out, options.seed, progress)
    print(summary(metrics))
    print(f"pictures, video and metrics.json are in {options.out} ({metrics['wall_s']:.0f} s)")


def _calibrate(options: argparse.Namespace) -> None:
    import numpy as np

    from cotarget import calibration as cal
    from cotarget.config import BoardConfig, load_config
    from cotarget.rig import open_rig
    from cotarget.safety import SafeRig

    _check_outputs([options.out], [options.rig, options.source and options.source / "index.json"])
    photos = {name: getattr(options, name) for name in ("fixed", "zoom", "board", "square")}
    given = [name for name, value in photos.items() if value is not None]
    with _progress() as progress:

        def tell(done: int, total: int, text: str) -> None:
            progress(f"calibrating: {text}", done, total)

        if options.rig is not None:
            if given:
                raise ConfigError(f"--{given[0]} goes with --from DIR; with --rig, the board is in rig.toml")
            config = load_config(options.rig)
            with SafeRig(open_rig(config), config.safety) as rig:
                found = cal.calibrate_rig(
                    rig,
                    config.board,
                    captures_dir=options.captures,
                    progress=tell,
                    pitch_mm=config.sim.zoom.pitch_mm,
                    seed=config.sim.seed,
                )
        elif options.captures is not None:
            raise ConfigError("--captures goes with --rig; saved captures are read with --from DIR alone")
        elif given:
            if missing := [name for name in photos if name not in given]:
                raise ConfigError(f"plain photos need --{missing[0]} too: --fixed, --zoom, --board and --square")
            board = BoardConfig(corners=options.board, square=options.square)
            found = cal.calibrate_photos(options.source, options.fixed, options.zoom, board, progress=tell)
        else:
            if not (options.source / "index.json").exists():
                raise ConfigError(
                    f"{options.source}: holds no index.json of captures; plain photos need --fixed, --zoom, --board "
                    "and --square"
                )
            found = cal.calibrate_captures(options.source, progress=tell)
        cal.save_calibration(options.out, found)
    residuals = found.residuals
    assert residuals is not None
    for rejected in residuals.rejected:
        print(f"not used: {rejected.name}: {rejected.reason}", file=sys.stderr)
    report = {k: v for k, v in dataclasses.asdict(residuals).items() if k != "rejected"}
    report |= {
        "rejected": len(residuals.rejected),
        "baseline_m": float(np.linalg.norm(found.T_zoom0_fixed.translation)),
        "calibration": str(options.out),
    }
    print(json.dumps(report, indent=2))


def _report(options: argparse.Namespace) -> None:
    from cotarget.calibration import load_calibration
    from cotarget.report.page import write_report

    _check_outputs([options.out], [options.calibration])
    calibration = load_calibration(options.calibration)
    print(write_report(options.out, calibration, options.calibration.name).text)
    print(f"the page is {options.out}, and its pictures are in {options.out.stem}_pictures beside it")


def _aim(options: argparse.Namespace) -> None:
    import numpy as np

    from cotarget.calibration import load_calibration
    from cotarget.config import RigConfig, load_config
    from cotarget.targeting import Closeup, Reach, aim, depth_of, error_budget, point_at

    config = RigConfig() if options.rig is None else load_config(options.rig)
    calibration = load_calibration(options.calibration)
    if options.rig is not None:
        calibration = calibration.for_streams(config.sim.fixed.size, config.sim.zoom.size)
    target = None if options.target is None else config.target(options.target)
    if options.size_px is not None and target is None:
        raise ConfigError("--size-px needs --target NAME, whose true size gives the depth")
    if options.wanted_px is not None and target is None:
        raise ConfigError("--wanted-px needs --target NAME, whose true size gives the focal length")
    depth = (
        options.depth
        if target is None or options.size_px is None
        else depth_of(calibration, target, options.size_px, np.array(options.pixel))
    )
    pitch_mm = calibration.pitch_mm or config.sim.zoom.pitch_mm
    shortest, longest = config.focal_range_px
    if options.rig is None:  # the calibration knows its own lens's shortest focal length
        shortest = calibration.zoom.nominal_px[0]
    reach = Reach(*config.head_limits, (shortest, max(shortest, longest)), step=config.head_step)
    closeup = (
        Closeup(target.size, options.wanted_px, target.dimension == "height")
        if target and options.wanted_px is not None
        else None
    )
    nominal = None if options.focal_mm is None else options.focal_mm / pitch_mm
    if nominal is not None and not reach.focal_px[0] <= nominal <= reach.focal_px[1]:
        shortest, longest = (f * pitch_mm for f in reach.focal_px)
        raise ConfigError(f"--focal-mm: {options.focal_mm:g} is beyond the lens's {shortest:g} to {longest:g} mm")
    pixel = np.array(options.pixel)
    size = calibration.fixed.size
    if not (np.all(pixel >= -0.5) and np.all(pixel <= np.array(size) - 0.5)):
        raise ConfigError(
            f"--pixel: ({pixel[0]:g}, {pixel[1]:g}) is not in the fixed camera's {size[0]}x{size[1]} image"
        )
    found = aim(
        calibration, point_at(calibration, pixel, depth), reach, closeup=closeup, nominal_px=nominal, method=options.ik
    )
    budget = error_budget(calibration, pixel, found, reach, size_px=options.size_px)
    print(
        json.dumps(
            {
                "pan_deg": math.degrees(found.pan),
                "tilt_deg": math.degrees(found.tilt),
                "focal_px": found.focal_px,
                "focal_mm": found.nominal_px * pitch_mm,
                "focal_limited": found.limited,
                "depth_m": found.depth,
                "range_m": found.range,
                "predicted_error_deg": {name: math.degrees(part) for name, part in budget.items()},
                "predicted_error_px": math.tan(budget["total"]) * found.focal_px,
            },
            indent=2,
        )
    )


def _follow(options: argparse.Namespace) -> None:
    from cotarget.calibration import load_calibration
    from cotarget.config import load_config
    from cotarget.detection import make_detector
    from cotarget.drawing import side_by_side
    from cotarget.loop import FollowSettings, State, follow
    from cotarget.recording import StepTable
    from cotarget.rig import open_rig
    from cotarget.safety import SafeRig
    from cotarget.video import FilmWriter

    config = load_config(options.rig)
    target = config.target(options.target)
    calibration = load_calibration(options.calibration)
    if config.backend == "sim" and options.target not in config.sim.targets:
        raise ConfigError(
            f"{options.rig}: the simulated scene has no {options.target}; add it: [sim] targets = "
            f"{json.dumps([*config.sim.targets, options.target])}"
        )
    detector = make_detector(target, config.sim.fixed.rate_hz)
    _check_outputs([options.csv, options.video], [options.rig, options.calibration, target.template])
    settings = FollowSettings(command_delay_s=config.command_delay_s)
    states: dict[str, int] = dict.fromkeys(State, 0)
    frames = math.ceil(options.seconds * config.sim.fixed.rate_hz)
    with (
        SafeRig(open_rig(config), config.safety) as rig,
        StepTable(options.csv) as table,
        FilmWriter(options.video, config.sim.fixed.rate_hz) if options.video else _nothing() as video,
        _progress() as progress,
    ):
        for step in follow(rig, calibration, target, detector, seconds=options.seconds, settings=settings):
            table.write(step)
            states[step.state] += 1
            if video is not None:
                video.write(side_by_side(step, options.target))
            progress(f"following: {options.target}: {step.state}", min(step.index + 1, frames), frames)
    print(json.dumps({"steps": sum(states.values()), "states": states}, indent=2))


def _detect(options: argparse.Namespace) -> None:
    from cotarget.config import RigConfig, load_config
    from cotarget.film import run_on_film

    config = RigConfig() if options.rig is None else load_config(options.rig)
    target = config.target(options.target)
    _check_outputs([options.csv, options.video], [options.film, options.rig, target.template])
    with _progress() as progress:
        found = run_on_film(
            options.film,
            target,
            options.csv,
            options.video,
            lambda done, total: progress(f"detecting: {options.target}", done, total or done),
        )
    print(json.dumps(dataclasses.asdict(found), indent=2))


def _board(options: argparse.Namespace) -> None:
    from cotarget.calibration.printing import print_board
    from cotarget.config import BoardConfig

    _check_outputs([options.out], [])
    width, height = print_board(options.out, BoardConfig(options.kind, options.board, options.square))
    print(
        f"{options.out}: {1000 * width:.1f} x {1000 * height:.1f} mm with its white border; print it at 100 %, stick it"
    )
    print("on something flat, and measure ten squares before you trust it")


def _doctor(options: argparse.Namespace) -> int:
    from cotarget.doctor import examine

    findings = examine()
    for finding in findings:
        print(f"{'ok     ' if finding.ok else 'MISSING'}  {finding.name}: {finding.text}")
        if finding.fix:
            print(f"         fix: {finding.fix}")
    return 0 if all(finding.ok for finding in findings) else 1


@contextmanager
def _progress() -> Any:
    """A progress bar on stderr when that is a terminal: call it with (what, done, of how much)."""
    from tqdm import tqdm

    with tqdm(
        total=None, disable=None, leave=False, bar_format="{desc} |{bar:30}| {percentage:3.0f}% {elapsed}"
    ) as bar:

        def show(text: str, done: int, total: int) -> None:
            if bar.disable:
                return
            bar.total, bar.n = total, done
            bar.set_description_str(text)

        yield show


@contextmanager
def _nothing() -> Any:
    yield None


def _check_outputs(outputs: Sequence[Path | None], inputs: Sequence[Path | None]) -> None:
    """Refuse a result file that cannot be written, or that is an input too, before the long work and not after it."""
    taken = {path.resolve() for path in inputs if path is not None}
    for path in outputs:
        if path is None:
            continue
        if path.is_dir():
            raise ConfigError(f"{path}: is a folder; name the file to write")
        if not path.absolute().parent.is_dir():
            raise ConfigError(f"{path}: its folder does not exist; create it first")
        if path.resolve() in taken:
            raise ConfigError(f"{path}: is read or written for something else too; give another name for the result")
        taken.add(path.resolve())


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number") from None
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text} is not greater than zero")
    return value


def _not_negative(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0")
    return int(text)


def _corners(text: str) -> tuple[int, int]:
    columns, _, rows = text.partition("x")
    if not (columns.isdecimal() and rows.isdecimal() and int(columns) >= 3 and int(rows) >= 3):
        raise argparse.ArgumentTypeError(f"'{text}' is not like 9x6 (inner corners: columns x rows, 3 at least)")
    return int(columns), int(rows)


if __name__ == "__main__":
    sys.exit(main())
