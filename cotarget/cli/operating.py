"""What an operator does with a rig: measure its latencies, stop it and clear the stop, reset the head."""

import argparse
import json
import math
import sys
from pathlib import Path

from cotarget.errors import ConfigError

CONSENT = "yes"
ENOUGH_DIGITS = 4  # of a latency in seconds


def latency(options: argparse.Namespace) -> None:
    """Cotarget latency."""
    from cotarget.calibration import load_calibration
    from cotarget.config import load_config
    from cotarget.latency import measure_fixed, measure_head
    from cotarget.rig import open_rig
    from cotarget.safety import SafeRig

    config = load_config(options.rig)
    calibration = None if options.calibration is None else load_calibration(options.calibration)
    tables = config.sim if config.backend == "sim" else config.hardware
    where = "sim" if config.backend == "sim" else "hardware"
    with SafeRig(open_rig(config), config.safety) as rig:
        head = measure_head(rig)
        found = {
            f"{where}.zoom.latency_s": tables.zoom.latency_s + head.zoom.seconds,
            f"{where}.head.command_delay_s": head.command,
        }
        agreement = {"zoom": head.zoom.agreement}
        if calibration is not None:
            fixed, _ = measure_fixed(rig, calibration, config.board)
            # Against the zoom camera, whose own frames are dated too late by what was just found.
            found[f"{where}.fixed.latency_s"] = tables.fixed.latency_s + fixed.seconds + head.zoom.seconds
            agreement["fixed"] = fixed.agreement
    if calibration is None:
        print("the fixed camera's latency needs --calibration, to look at a board with both cameras", file=sys.stderr)
    rounded = {name: None if math.isnan(value) else round(value, ENOUGH_DIGITS) for name, value in found.items()}
    print(json.dumps({"measured": rounded, "agreement": agreement}, indent=2))


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
    from cotarget.hardware.d46unit import reset
    from cotarget.safety import refuse_if_stopped

    config = load_config(options.rig)
    head = config.hardware.head
    if config.backend != "hardware" or not head.port:
        raise ConfigError(f'{options.rig}: names no pan-tilt unit; backend = "hardware" and [hardware.head] port do')
    refuse_if_stopped(config.safety.stop_file)
    if not options.yes:
        print(
            "The head will turn through its whole range. Are camera and cables clear of it? [yes/no] ",
            end="",
            flush=True,
        )
        if sys.stdin.readline().strip().lower() != CONSENT:
            raise ConfigError("not reset; it needs the answer yes, or --yes")
    unit = reset(head, MonotonicClock())
    print(f"reset: {unit}")


def _stop_file(rig: Path) -> Path:
    from cotarget.config import load_config

    path = load_config(rig).safety.stop_file
    if path is None:
        raise ConfigError(f'{rig}: has no stop file; give one: [safety] stop_file = "stop"')
    return path
