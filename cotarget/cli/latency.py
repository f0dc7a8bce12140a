"""Measure the latencies and command delays of cameras, head and lens: `cotarget latency`."""

import argparse
import math
import sys

from cotarget.cli.common import add_file, add_insist, add_rig, check_board_size, load_plausible, open_named, print_json
from cotarget.errors import CalibrationError, ConfigError

DIGITS = 4  # decimals of a latency [s]
# Accuracy of a measured latency [s]; a more negative one is refused.
ACCURACY_S = 0.01


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_rig(parser)
    about = "calibration.json; measures the fixed camera too, by a board that is swung"
    add_file(parser, "--calibration", about)
    add_insist(parser)


def run(options: argparse.Namespace) -> None:
    """Measure the latencies, and print them as keys of rig.toml."""
    from cotarget.backends import describe, load_config
    from cotarget.latency import measure_fixed, measure_head, measure_lens
    from cotarget.safety.stop_file import refuse_if_stopped

    config = load_config(options.rig)
    refuse_if_stopped(config.safety.stop_file)
    if config.backend == "replay":
        raise ConfigError(f"{options.rig}: backend is 'replay'; a recording's latencies cannot be measured")
    calibration = None
    if options.calibration is not None:  # refused before the head moves
        calibration = load_plausible(options.calibration, describe(config), insist=options.insist)
        calibration.zoom_head.hand_eye()
        check_board_size(options.rig, config)
    where = "sim" if config.backend == "sim" else "hardware"
    with open_named(options.rig, config, partial=True) as rig:
        head = measure_head(rig)
        found = {
            f"{where}.zoom.latency_s": rig.spec.zoom.latency_s + head.zoom.seconds,
            f"{where}.head.command_delay_s": head.command,
        }
        agreement = {"zoom": head.zoom.agreement}
        if config.backend == "hardware":  # a simulated lens has the head's command delay
            found["hardware.zoom.command_delay_s"] = measure_lens(rig, head.zoom.seconds)
        if calibration is not None:
            fixed = measure_fixed(rig, calibration, config.board)
            # Relative to the zoom camera, whose frame times contain the error found above.
            found[f"{where}.fixed.latency_s"] = rig.spec.fixed.latency_s + fixed.seconds + head.zoom.seconds
            agreement["fixed"] = fixed.agreement
    if calibration is None:
        print("the fixed camera's latency needs --calibration, to look at a board with both cameras", file=sys.stderr)
    rounded = {name: None if math.isnan(value) else _plausible(name, value, head.late) for name, value in found.items()}
    if head.late:
        print(f"cotarget latency: the values are doubtful: {head.late}", file=sys.stderr)
    print_json({"measured": rounded, "agreement": agreement})


def _plausible(name: str, seconds: float, late: str) -> float:
    """Round a latency for rig.toml; refuse one that is negative beyond the measurement's accuracy."""
    if seconds < -ACCURACY_S:
        why = late or "see that the picture has structure and that nothing else moves in it, and measure again"
        raise CalibrationError(f"{name}: {1000 * seconds:.0f} ms was measured, which is implausible: {why}")
    return max(round(seconds, DIGITS), 0.0)
