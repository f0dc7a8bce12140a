"""Follow a target with a calibrated rig: `cotarget follow --record run1`."""

import argparse
import math
from contextlib import nullcontext
from typing import TYPE_CHECKING

from cotarget.cli.common import (
    add_file,
    add_insist,
    add_rig,
    check_outputs,
    duration,
    open_named,
    print_json,
    rig_files,
)
from cotarget.cli.pipeline_run import (
    Run,
    Selection,
    add_outputs,
    add_selection,
    output_files,
    run_observed,
    warn_if_unseen,
)
from cotarget.errors import naming

if TYPE_CHECKING:
    from cotarget.rig import Rig


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_rig(parser)
    add_file(parser, "--calibration", "calibration.json", required=True)
    parser.add_argument("--target", required=True, metavar="NAME", help="a target of rig.toml")
    add_selection(parser)
    parser.add_argument("--seconds", type=duration, metavar="S", help="duration [s] (until Ctrl-C)")
    add_outputs(parser)
    add_file(parser, "--record", "record everything, for cotarget replay", "DIR")
    add_insist(parser)


def epilog() -> str:
    """Return what --help says of the exit statuses."""
    return (
        "exit status: 0 the target was followed; 1 an error; 2 a wrong option; 3 the zoom camera mostly did not show "
        "the target; 4 no target was followed; 130 Ctrl-C ended a run with --seconds"
    )


def run(options: argparse.Namespace) -> int:
    """Follow a target with the rig, and record it on request; return the exit status."""
    from cotarget.backends import describe, load_config
    from cotarget.calibration import Calibration
    from cotarget.pipeline import check_run
    from cotarget.recording.recorder import Recorder
    from cotarget.safety.safe_rig import guard
    from cotarget.safety.stop_file import refuse_if_stopped

    config = load_config(options.rig)
    refuse_if_stopped(config.safety.stop_file)
    with naming("--target"):
        target = config.target(options.target)  # an unknown one is refused before the long work
    spec, calibration = describe(config), Calibration.load(options.calibration)
    files = options.calibration, options.rig
    check_outputs(output_files(options), [*rig_files(options.rig, config), options.calibration], options.record)
    check_run(calibration, spec, target, options.target, insist=options.insist, files=files)
    selection, rate_hz = Selection(options, spec.fixed.size), spec.fixed.rate_hz
    seconds = math.inf if options.seconds is None else options.seconds
    with (
        Recorder(options.record, config, options.calibration, options.target, selection.selector)
        if options.record
        else nullcontext() as recorder
    ):

        def opened() -> "Rig":
            rig = open_named(options.rig, config, guarded=False)
            return guard(recorder.wrap(rig) if recorder else rig, config.safety)

        expected = None if math.isinf(seconds) else math.ceil(seconds * rate_hz)
        run = Run(opened, config, calibration, options.target, rate_hz, selection, seconds, expected)
        result = run_observed(run, options)
        if result.interrupt is None:  # a run cut short may not have had the time to see anything
            warn_if_unseen("follow", run, result.counts)
        print_json(result.table, options.csv)
        if result.interrupt is not None:
            raise result.interrupt
    return result.counts.exit_status
