"""Show the simulated scene, both cameras' frusta and their images: `cotarget view --target person --browser`."""

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING, Any

from cotarget.cli.common import add_file, add_insist, duration, port
from cotarget.errors import ConfigError, naming

if TYPE_CHECKING:
    from cotarget.calibration import Calibration
    from cotarget.config import RigConfig
    from cotarget.rig import Rig
    from cotarget.sim.truth import Truth
    from cotarget.sim.viewer.scene import Snapshot
    from cotarget.sim.world import SimWorld


PORT = 8080  # port of the page
TARGETS = ("person", "bird")  # targets of the scene without --rig and --target


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_file(parser, "--rig", "rig.toml of the simulated rig (the default rig)")
    parser.add_argument("--target", metavar="NAME", help="follow this target of rig.toml")
    add_file(parser, "--calibration", "calibration.json (the simulation's true calibration)")
    add_insist(parser)
    parser.add_argument("--browser", action="store_true", help="serve a page for a web browser on this machine")
    parser.add_argument("--port", type=port, metavar="P", help=f"port of the page; 0: any free one ({PORT})")
    about = "duration by the clock on the wall [s] (until it is closed, or Ctrl-C)"
    parser.add_argument("--seconds", type=duration, metavar="S", help=about)


def run(options: argparse.Namespace) -> None:
    """Show the rig at rest, or the pipeline at work where a target is named."""
    from cotarget.calibration import Calibration
    from cotarget.evaluation import true_calibration
    from cotarget.pipeline import check_run
    from cotarget.sim.world import SimWorld

    if options.port is not None and not options.browser:
        raise ConfigError("--port: needs --browser, which serves a page at that port")
    if options.calibration is not None and options.target is None:
        raise ConfigError("--calibration: needs --target NAME, the target to follow")
    config = _config(options)
    calibration = None if options.calibration is None else Calibration.load(options.calibration)
    opened = window_opener(options)  # called first, because making the world takes a while
    with closing(SimWorld(config)) as world, closing(opened(world.truth())) as window:
        if options.target is not None:
            calibration = calibration or true_calibration(world)
            files, target = (options.calibration or "calibration", options.rig or ""), config.target(options.target)
            check_run(calibration, world.rig.spec, target, options.target, insist=options.insist, files=files)
        print(f"{window.where} shows the scene; Ctrl-C ends it", file=sys.stderr, flush=True)
        try:
            seconds = math.inf if options.seconds is None else options.seconds
            watch(_snapshots(options, config, world, calibration), window, time.monotonic, time.sleep, seconds)
        except KeyboardInterrupt:
            print("", file=sys.stderr)


def watch(
    snapshots: "Iterator[Snapshot]",
    window: Any,
    now: Callable[[], float],
    sleep: Callable[[float], None],
    seconds: float = math.inf,
) -> None:
    """Show snapshots no faster than in real time, until they end, the window is closed, or the wall clock's time is up.

    The wall clock starts at the time of the first snapshot.
    """
    ahead, end = math.inf, None  # lead of the rig's clock over the wall clock, and the wall clock's end
    for snapshot in snapshots:
        window.show(snapshot)
        end = now() + seconds - snapshot.t if end is None else end
        if not window.is_open():
            return
        ahead = min(ahead, snapshot.t - now())  # a slow machine does not catch up afterwards
        if (wait := snapshot.t - ahead - now()) > 0:
            sleep(wait)
        if now() >= end:
            return


def _config(options: argparse.Namespace) -> "RigConfig":
    """Load or make the configuration of the rig to view."""
    from cotarget.backends import load_config
    from cotarget.config import RigConfig
    from cotarget.demo import SCENES, sim_config

    if options.rig is None:
        if options.target is not None:
            with naming("--target"):  # an unknown one is refused before the long work
                RigConfig().target(options.target)
        targets = TARGETS if options.target is None else (options.target,)
        return sim_config(SCENES.get(targets[0].rstrip("0123456789"), "outdoor"), targets, 0)
    config = load_config(options.rig)
    if config.backend != "sim":
        raise ConfigError(f"{options.rig}: backend is '{config.backend}'; what is viewed is a simulated rig")
    if options.target is not None:
        with naming("--target"):
            config.target(options.target)
    return config


def window_opener(options: argparse.Namespace) -> "Callable[[Truth], Any]":
    """Return the function that opens a window on a world's truth; refuse a missing display and a port in use."""
    if options.browser:
        from cotarget.sim.viewer.browser import BrowserWindow, listen

        return partial(BrowserWindow, listener=listen(PORT if options.port is None else options.port))
    from cotarget.sim.viewer.desktop import DesktopWindow, check_display

    check_display()
    return DesktopWindow


def _snapshots(
    options: argparse.Namespace, config: "RigConfig", world: "SimWorld", calibration: "Calibration | None"
) -> "Iterator[Snapshot]":
    """Yield snapshots of the pipeline following a target, or of the rig at rest without a calibration."""
    from cotarget.safety.safe_rig import guard

    with guard(world.rig, config.safety) as rig:
        if calibration is None:
            yield from _at_rest(rig, world.truth())
        else:
            yield from _followed(options, config, calibration, world, rig)


def _at_rest(rig: "Rig", truth: "Truth") -> "Iterator[Snapshot]":
    from cotarget.sim.viewer.scene import Snapshot, frusta_of

    fixed = rig.fixed.read()
    while True:
        t = rig.clock.now()
        pictures = {"fixed": fixed.image, "zoom": rig.zoom.read().image}
        yield Snapshot(t, f"t = {t:.1f} s", pictures, frusta_of(truth, t))  # type: ignore[arg-type]
        fixed = rig.fixed.read(newer_than=fixed.t)


def _followed(
    options: argparse.Namespace, config: "RigConfig", calibration: "Calibration", world: "SimWorld", rig: "Rig"
) -> "Iterator[Snapshot]":
    from cotarget.drawing import draw_wide, draw_zoom
    from cotarget.pipeline import Run
    from cotarget.sim.viewer.scene import Snapshot, frusta_of

    truth, name = world.truth(), options.target
    for step in Run(rig, calibration, config.target(name)).follow():
        depths = {} if step.aim is None else {"zoom": step.aim.range}
        caption = f"t = {step.t:.1f} s   {name}: {step.state}"
        pictures = {"fixed": draw_wide(step), "zoom": draw_zoom(step)}
        yield Snapshot(step.t, caption, pictures, frusta_of(truth, step.t, depths))  # type: ignore[arg-type]
