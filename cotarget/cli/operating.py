"""What an operator does with a rig: point it, measure its latencies, stop it and clear the stop, reset the head."""

import argparse
import math
import re
import sys
import tomllib
from pathlib import Path

from cotarget.cli.arguments import (
    check_board_is_told,
    check_outputs,
    check_within,
    previous_kept,
    print_json,
    rig_files,
)
from cotarget.errors import CalibrationError, ConfigError

CONSENT = "yes"
# The line of a file that is not TOML any more which still says what file stops the head.
STOP_FILE_LINE = r"""^[^#\n]*\bstop_file[ \t]*=[ \t]*(["'])([^"'\n]+)\1"""
ENOUGH_DIGITS = 4  # of a latency in seconds
# What is found is within so much of the truth; less than zero by more is no latency [s].
ACCURACY_S = 0.01


def latency(options: argparse.Namespace) -> None:
    """Cotarget latency."""
    from cotarget.calibration import load_calibration
    from cotarget.config import load_config
    from cotarget.latency import measure_fixed, measure_head
    from cotarget.lenslatency import measure_lens
    from cotarget.rig import open_rig
    from cotarget.safety import SafeRig, refuse_if_stopped

    config = load_config(options.rig)
    refuse_if_stopped(config.safety.stop_file)
    if config.backend == "replay":
        raise ConfigError(f"{options.rig}: backend is 'replay'; a recording's latencies cannot be measured any more")
    calibration = None if options.calibration is None else load_calibration(options.calibration)
    if calibration is not None:  # refused now, and not when the head has been wiggled
        calibration.hand_eye()
        calibration.for_streams(*config.stream_sizes)
        check_board_is_told(options.rig, config)
    tables = config.sim if config.backend == "sim" else config.hardware
    where = "sim" if config.backend == "sim" else "hardware"
    with SafeRig(open_rig(config), config.safety) as rig:
        head = measure_head(rig)
        found = {
            f"{where}.zoom.latency_s": tables.zoom.latency_s + head.zoom.seconds,
            f"{where}.head.command_delay_s": head.command,
        }
        agreement = {"zoom": head.zoom.agreement}
        if config.backend == "hardware":  # a simulated lens is as late as its head
            found["hardware.zoom.command_delay_s"] = measure_lens(rig, head.zoom.seconds).command
        if calibration is not None:
            fixed, _ = measure_fixed(rig, calibration, config.board)
            # Against the zoom camera, whose own frames are dated too late by what was just found.
            found[f"{where}.fixed.latency_s"] = tables.fixed.latency_s + fixed.seconds + head.zoom.seconds
            agreement["fixed"] = fixed.agreement
    if calibration is None:
        print("the fixed camera's latency needs --calibration, to look at a board with both cameras", file=sys.stderr)
    rounded = {name: None if math.isnan(value) else _plausible(name, value) for name, value in found.items()}
    print_json({"measured": rounded, "agreement": agreement})


def _plausible(name: str, seconds: float) -> float:
    """A latency as it is written into rig.toml.

    Raises:
        CalibrationError: nothing comes before its cause.
    """
    if seconds < -ACCURACY_S:
        raise CalibrationError(
            f"{name}: {1000 * seconds:.0f} ms was measured, which is implausible: see that the picture has structure "
            "and that nothing else moves in it, and measure again"
        )
    return max(round(seconds, ENOUGH_DIGITS), 0.0)


def point(options: argparse.Namespace) -> None:
    """Cotarget point."""
    from cotarget.calibration.captures import write_image
    from cotarget.calibration.standing import wait_for_lens
    from cotarget.config import load_config
    from cotarget.rig import open_rig
    from cotarget.safety import SafeRig, refuse_if_stopped

    config = load_config(options.rig)
    refuse_if_stopped(config.safety.stop_file)
    shots = {} if options.pictures is None else {name: options.pictures / f"{name}.png" for name in ("fixed", "zoom")}
    check_outputs(shots.values(), rig_files(options.rig, config))
    if config.backend == "replay":
        raise ConfigError(f"{options.rig}: backend is 'replay'; a recording's head and lens cannot be sent anywhere")
    with SafeRig(open_rig(config), config.safety) as rig:
        limits = rig.head.limits
        for option, angle, bounds in (
            ("--pan-deg", options.pan_deg, limits.pan),
            ("--tilt-deg", options.tilt_deg, limits.tilt),
        ):
            if angle is not None:
                low, high = map(math.degrees, bounds)
                check_within(option, angle, (low, high), "the head's {} degrees", math.degrees(limits.step))
        if options.focal_mm is not None:
            shortest, longest = (focal * config.pitch_mm for focal in rig.zoom.focal_range)
            check_within("--focal-mm", options.focal_mm, (shortest, longest), "the lens's {} mm")
            rig.zoom.zoom(options.focal_mm / config.pitch_mm)
        now = rig.head.state()
        pan, tilt = (
            here if wanted is None else math.radians(wanted)
            for wanted, here in ((options.pan_deg, now.pan), (options.tilt_deg, now.tilt))
        )
        rig.head.move(pan, tilt, wait=True)
        wait_for_lens(rig)
        head, lens = rig.head.state(), rig.zoom.state()
        for name, path in shots.items():
            frame = rig.fixed.read(newer_than=head.t) if name == "fixed" else rig.zoom.capture()
            with previous_kept(path):
                write_image(path, frame.image)
    print_json(
        {
            "pan_deg": math.degrees(head.pan),
            "tilt_deg": math.degrees(head.tilt),
            "focal_mm": lens.focal_px * config.pitch_mm,
            "pictures": {name: str(path) for name, path in shots.items()},
        }
    )


def stop(options: argparse.Namespace) -> None:
    """Cotarget stop."""
    from cotarget.safety import write_stop_file

    path = _stop_file(options.rig)
    write_stop_file(path, options.reason)
    print(f"stopped: no head that watches {path} moves until cotarget clear")


def clear(options: argparse.Namespace) -> None:
    """Cotarget clear."""
    from cotarget.safety import clear_stop_file

    path = _stop_file(options.rig)
    reason = clear_stop_file(path)
    print(f"{path}: there was no stop" if reason is None else f"cleared: {reason}")


def reset_head(options: argparse.Namespace) -> None:
    """Cotarget reset-head."""
    from cotarget.config import load_config
    from cotarget.hardware.clock import MonotonicClock
    from cotarget.hardware.d46lost import LostPosition
    from cotarget.hardware.d46reset import reset
    from cotarget.safety import StopLook, end_politely, refuse_if_stopped

    config = load_config(options.rig)
    head = config.hardware.head
    if config.backend != "hardware" or not head.port:
        raise ConfigError(f'{options.rig}: names no pan-tilt unit; backend = "hardware" and [hardware.head] port do')
    refuse_if_stopped(config.safety.stop_file)
    if not options.yes:
        print("The head will turn through its whole range. Are camera and cables clear of it? [yes/no]", flush=True)
        if _answer().strip().lower() != CONSENT:
            raise ConfigError("not reset; it needs the answer yes, or --yes")
    look, undo = StopLook(config.safety.stop_file), end_politely()
    try:
        lost = LostPosition(head.port, config.safety.stop_file)
        unit = reset(head, MonotonicClock(), lost, stopped=look.reason)
    finally:
        undo()
        look.close()
    pan, tilt = (f"{axis.lowest} to {axis.highest}" for axis in (unit.pan, unit.tilt))
    print(f"reset: {unit.version}: pan {pan}, tilt {tilt} steps")


def _answer() -> str:
    """What somebody types; nothing where nobody is there."""
    try:
        return sys.stdin.readline() if sys.stdin is not None else ""
    except (OSError, ValueError):  # a terminal that has gone, a file that is closed, no text
        return ""


def _stop_file(rig: Path) -> Path:
    """The stop file that a rig.toml names; nothing else that is wrong with it may keep anybody from stopping.

    Raises:
        ConfigError: it names none.
    """
    by_hand = "the rig's stop file itself can be made and removed by hand"
    try:
        text = rig.read_bytes().decode("utf-8-sig", "replace")
    except OSError as error:
        raise ConfigError(f"{rig}: {error.strerror}; {by_hand}") from None
    try:
        safety = tomllib.loads(text).get("safety")
        path = safety.get("stop_file") if isinstance(safety, dict) else None
    except tomllib.TOMLDecodeError as error:
        lines = re.findall(STOP_FILE_LINE, text, re.MULTILINE)
        if len(lines) != 1:
            raise ConfigError(f"{rig}: is not TOML: {error}; {by_hand}") from None
        path = lines[0][1]
    if not isinstance(path, str) or Path(path).name in ("", ".."):
        raise ConfigError(f'{rig}: has no stop file; give one: [safety] stop_file = "stop"')
    return rig.parent / path
