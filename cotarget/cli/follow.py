"""Follow a target with a calibrated rig: `cotarget follow --record run1`."""

import argparse
import math
from contextlib import ExitStack, closing, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
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
from cotarget.cli.page_run import PageRun, Recordings, add_page, check_page, demo_config, is_demo
from cotarget.cli.pipeline_run import (
    LEARNT,
    RunInputs,
    Selection,
    StepCounts,
    add_outputs,
    add_selection,
    output_files,
    run_observed,
    warn_if_unseen,
)
from cotarget.errors import ConfigError, choices, naming

if TYPE_CHECKING:
    from cotarget.config import RigConfig
    from cotarget.pipeline import FollowSettings
    from cotarget.rig import Rig, RigSpec

CALIBRATION = "calibration.json"  # beside rig.toml


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_rig(parser)
    about = "calibration.json (that of [follow] in rig.toml, or beside rig.toml)"
    add_file(parser, "--calibration", about)
    about = "a target of rig.toml (that of [follow], or the only one of a simulated scene)"
    parser.add_argument("--target", metavar="NAME", help=about)
    add_selection(parser, learnt=True)
    parser.add_argument("--seconds", type=duration, metavar="S", help="duration [s] (until Ctrl-C)")
    add_outputs(parser)
    add_file(parser, "--record", "record everything, for cotarget replay", "DIR")
    add_page(parser)
    add_insist(parser)


def epilog() -> str:
    """Return what --help says of the exit statuses."""
    return (
        "exit status: 0 the target was followed; 1 an error; 2 a wrong option; 3 the zoom camera mostly did not show "
        "the target; 4 no target was followed; 130 Ctrl-C ended a run with --seconds"
    )


def run(options: argparse.Namespace) -> int:
    """Follow a target with the rig, and record it on request; return the exit status."""
    check_page(options)
    with ExitStack() as opened_first:
        return _run(options, opened_first)


def _run(options: argparse.Namespace, opened_first: ExitStack) -> int:
    """Follow; what is opened before the rig is closed with the stack."""
    from cotarget.backends import describe, load_config
    from cotarget.calibration import Calibration
    from cotarget.pipeline import Run, check_run
    from cotarget.recording.recorder import Recorder
    from cotarget.safety.safe_rig import guard
    from cotarget.safety.stop_file import refuse_if_stopped

    demo = is_demo(options)
    config = demo_config(options) if demo else load_config(options.rig)
    refuse_if_stopped(config.safety.stop_file)
    spec = describe(config)
    name = options.target or config.follow.target or _only_target(spec, config)
    with naming("--target"):
        target = config.target(name)  # an unknown one is refused before the long work
    page = PageRun(options, config, spec) if options.page else None
    if page is not None:
        opened_first.callback(page.close)
    made = _demo_rig(config, opened_first) if demo else None
    file = options.calibration or config.follow.calibration or options.rig.parent / CALIBRATION
    rig_there, file = (None, file) if made is None else made
    calibration = Calibration.load(file)
    check_outputs(output_files(options), [*rig_files(options.rig, config), file], options.record)
    check_run(calibration, spec, target, name, insist=options.insist, files=(file, options.rig))
    settings = _settings(options)
    selection, rate_hz = Selection(options, spec.fixed.size), spec.fixed.rate_hz
    seconds = math.inf if options.seconds is None else options.seconds

    def make_recorder(folder: Path) -> Recorder:
        return Recorder(
            folder, config, file, name, selection.selector, None if settings.policy is None else settings.policy.path
        )

    def make_run(rig: "Rig") -> Run:
        return Run(rig, calibration, target, selector=Selection(options, spec.fixed.size).selector, settings=settings)

    records = None if page is None else opened_first.enter_context(Recordings(options.record, make_recorder))
    with make_recorder(options.record) if options.record and page is None else nullcontext() as recorder:

        def opened() -> "Rig":
            rig = open_named(options.rig, config, guarded=False) if rig_there is None else rig_there
            if page is None or records is None:
                return guard(recorder.wrap(rig) if recorder else rig, config.safety)
            return records.with_refusals(guard(records.wrap(rig), page.safety))

        expected = None if math.isinf(seconds) else math.ceil(seconds * rate_hz)
        operated = None if page is None or records is None else page.operated(records, make_run, seconds)
        run = RunInputs(
            opened,
            config,
            calibration,
            name,
            rate_hz,
            selection,
            seconds,
            expected,
            operated=operated,
            settings=settings,
        )
        counts = _follow(run, options)
    return counts.exit_status if page is None else 0


def _follow(run: RunInputs, options: argparse.Namespace) -> StepCounts:
    """Follow, and print the summary; an interrupt is raised after it."""
    result = run_observed(run, options)
    if result.interrupt is None:  # a run cut short may not have had the time to see anything
        warn_if_unseen("follow", run, result.counts)
    print_json(result.table, options.csv)
    if result.interrupt is not None:
        raise result.interrupt
    return result.counts


def _settings(options: argparse.Namespace) -> "FollowSettings":
    """Make the settings with the learnt policy that --policy names, if it does; the first target is then followed."""
    from cotarget.control.policy import OnnxPolicy
    from cotarget.pipeline import FollowSettings

    if options.policy is None or not options.policy.endswith(LEARNT):
        return FollowSettings()
    file, options.policy = Path(options.policy), None
    with naming("--policy"):
        return FollowSettings(policy=OnnxPolicy(file))


def _demo_rig(config: "RigConfig", opened_first: ExitStack) -> "tuple[Rig, Path]":
    """Open the simulated rig of a configuration; write its true calibration to a file."""
    from cotarget.evaluation import true_calibration
    from cotarget.sim.world import SimWorld

    folder = Path(opened_first.enter_context(TemporaryDirectory(prefix="cotarget-")))
    world = opened_first.enter_context(closing(SimWorld(config)))
    true_calibration(world).save(folder / CALIBRATION)
    return world.rig, folder / CALIBRATION


def _only_target(spec: "RigSpec", config: "RigConfig") -> str:
    """Return the target of a simulated scene that has one."""
    if spec.targets is None or len(spec.targets) != 1:
        names = choices(spec.targets or config.targets)
        raise ConfigError(f"--target: missing; give one of: {names}; or in rig.toml: [follow] target")
    return spec.targets[0]
