"""Measure the latencies and command delays of cameras, head and lens: `cotarget latency`."""

import argparse
import math
import sys
from collections.abc import Callable

from cotarget.cli.common import add_file, add_insist, add_rig, check_board_size, load_plausible, open_named, print_json
from cotarget.errors import CalibrationError, ConfigError, StaleFrameError, UnreachableError

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
    one = bool(where == "hardware" and config.hardware.ptz)
    head_table, zoom_table = (f"{where}.{'ptz' if one else name}" for name in ("head", "zoom"))
    found: dict[str, float | None] = {}
    agreement: dict[str, float] = {}
    failed: list[str] = []

    def keep(name: str, measure: Callable[[], float]) -> None:
        """Keep a measured value for rig.toml; a failure is printed at the end, because the others are as good."""
        try:
            found[name] = _plausible(name, measure(), head.late)
        except (CalibrationError, StaleFrameError, UnreachableError) as error:
            found[name] = None
            failed.append(str(error) if name in str(error) else f"{name}: {error}")

    with open_named(options.rig, config, partial=calibration is None) as rig:
        head = measure_head(rig)
        agreement["zoom"] = head.zoom.agreement
        keep(f"{zoom_table}.latency_s", lambda: rig.spec.zoom.latency_s + head.zoom.seconds)
        keep(f"{head_table}.command_delay_s", lambda: head.command)
        if where == "hardware" and not one:  # otherwise the lens has the head's command delay
            keep("hardware.zoom.command_delay_s", lambda: measure_lens(rig, head.zoom.seconds))
        if calibration is not None:
            known = calibration

            def measure() -> float:
                fixed = measure_fixed(rig, known, config.board)
                agreement["fixed"] = fixed.agreement
                # Relative to the zoom camera, whose frame times contain the error found above.
                return rig.spec.fixed.latency_s + fixed.seconds + head.zoom.seconds

            keep(f"{where}.fixed.latency_s", measure)
        for name, table in (("fixed", f"{where}.fixed"), ("zoom", zoom_table)):
            of_stream = getattr(getattr(rig, name), "describe", None)
            if name not in rig.missing and of_stream is not None and (said := of_stream()):
                print(f"{table}: {said}", file=sys.stderr)
    if calibration is None:
        print("the fixed camera's latency needs --calibration, to look at a board with both cameras", file=sys.stderr)
    if head.late:
        print(f"cotarget latency: the values are doubtful: {head.late}", file=sys.stderr)
    print_json({"measured": found, "agreement": agreement})
    if failed:
        raise CalibrationError("; ".join(failed))


def _plausible(name: str, seconds: float, late: str) -> float:
    """Round a latency for rig.toml; refuse one that was not found, or is negative beyond the measurement's accuracy."""
    if math.isnan(seconds):
        raise CalibrationError(
            f"{name}: the head reports too seldom while it speeds up; state its acceleration in its driver"
        )
    if seconds < -ACCURACY_S:
        why = late or "see that the picture has structure and that nothing else moves in it, and measure again"
        raise CalibrationError(f"{name}: {1000 * seconds:.0f} ms was measured, which is implausible: {why}")
    return max(round(seconds, DIGITS), 0.0)
