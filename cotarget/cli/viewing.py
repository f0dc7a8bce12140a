"""The command that shows the simulated scene while the pipeline works in it."""

import argparse
import itertools
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING, Any

from cotarget.cli.choosing import check_shown
from cotarget.errors import ConfigError

if TYPE_CHECKING:
    from cotarget.calibration import Calibration
    from cotarget.config import RigConfig
    from cotarget.rig import Rig
    from cotarget.sim.frusta import Sight
    from cotarget.sim.truth import Truth
    from cotarget.sim.world import SimWorld

PORT = 8080  # of the page
LOOKED_AT = ("person", "bird")  # who is there, where nobody says who


def view(options: argparse.Namespace) -> None:
    """Cotarget view."""
    from cotarget.calibration import load_calibration
    from cotarget.sim.world import SimWorld

    if options.port is not None and not options.browser:
        raise ConfigError("--port: is of the page that --browser serves; give both")
    if options.calibration is not None and options.target is None:
        raise ConfigError("--calibration: is for following a target; name it: --target NAME")
    config = _config(options)
    calibration = None if options.calibration is None else load_calibration(options.calibration)
    opened = _opener(options)  # which refuses what cannot be before the world is made, as that takes a while
    world = SimWorld(config)
    with closing(world), closing(opened(world.truth())) as window:
        print(f"{window.where} shows the scene; Ctrl-C ends it", file=sys.stderr, flush=True)
        try:
            watch(_sights(options, config, world, calibration), window, time.monotonic, time.sleep)
        except KeyboardInterrupt:
            print("", file=sys.stderr)


def watch(sights: "Iterator[Sight]", window: Any, now: Callable[[], float], sleep: Callable[[float], None]) -> None:
    """Show what happens, no quicker than it happens, until it is over or the window is closed.

    Args:
        sights: what there is to see.
        window: shows it.
        now: tells the time that people have [s].
        sleep: lets so much of it pass [s].
    """
    ahead = math.inf  # of the rig's clock before people's
    for sight in sights:
        window.show(sight)
        if not window.is_open():
            return
        ahead = min(ahead, sight.t - now())  # a machine that is slow does not hurry afterwards
        if (wait := sight.t - ahead - now()) > 0:
            sleep(wait)


def _config(options: argparse.Namespace) -> "RigConfig":
    """The rig that is viewed."""
    from cotarget.config import RigConfig, load_config
    from cotarget.demo import SCENES, sim_config

    if options.rig is None:
        if options.target is not None:
            RigConfig().target(options.target)  # refused now
        targets = LOOKED_AT if options.target is None else (options.target,)
        return sim_config(SCENES.get(targets[0].rstrip("0123456789"), "outdoor"), targets, 0)
    config = load_config(options.rig)
    if config.backend != "sim":
        raise ConfigError(f"{options.rig}: backend is '{config.backend}'; what is viewed is a simulated rig")
    if options.target is not None:
        config.target(options.target)
        check_shown(config, options.target, options.rig)
    return config


def _opener(options: argparse.Namespace) -> "Callable[[Truth], Any]":
    """What opens the window on a world's truth.

    Raises:
        DeviceError: there is no display, no web viewer, or the port is taken.
    """
    if options.browser:
        from cotarget.sim.browser import BrowserWindow, listen

        return partial(BrowserWindow, listener=listen(PORT if options.port is None else options.port))
    from cotarget.sim.desktop import DesktopWindow, check_display

    check_display()
    return DesktopWindow


def _sights(
    options: argparse.Namespace, config: "RigConfig", world: "SimWorld", calibration: "Calibration | None"
) -> "Iterator[Sight]":
    """What there is to see: the pipeline at work where there is a target, else the rig at rest."""
    from cotarget.oracle import true_calibration
    from cotarget.safety import SafeRig

    seconds = math.inf if options.seconds is None else options.seconds
    with SafeRig(world.rig, config.safety) as rig:
        if options.target is None:
            yield from _at_rest(rig, world.truth(), seconds)
        else:
            yield from _followed(options.target, config, calibration or true_calibration(world), world, rig, seconds)


def _at_rest(rig: "Rig", truth: "Truth", seconds: float) -> "Iterator[Sight]":
    from cotarget.sim.frusta import Sight, frusta_of

    fixed = rig.fixed.read()
    for _ in itertools.count():
        t = rig.clock.now()
        pictures = {"fixed": fixed.image, "zoom": rig.zoom.read().image}
        yield Sight(t, f"t = {t:.1f} s", pictures, frusta_of(truth, t))  # type: ignore[arg-type]
        if t >= seconds:
            return
        fixed = rig.fixed.read(newer_than=fixed.t)


def _followed(
    name: str, config: "RigConfig", calibration: "Calibration", world: "SimWorld", rig: "Rig", seconds: float
) -> "Iterator[Sight]":
    from cotarget.detection import make_detector
    from cotarget.drawing import draw_wide, draw_zoom
    from cotarget.loop import FollowSettings, follow
    from cotarget.sim.frusta import Sight, frusta_of

    truth = world.truth()
    target = config.target(name)
    settings = FollowSettings.of(config)
    detector = make_detector(target, config.rate_hz)
    for step in follow(rig, calibration, target, detector, seconds=seconds, settings=settings):
        depths = {} if step.aim is None else {"zoom": step.aim.range}
        caption = f"t = {step.t:.1f} s   {name}: {step.state}"
        pictures = {"fixed": draw_wide(step), "zoom": draw_zoom(step)}
        yield Sight(step.t, caption, pictures, frusta_of(truth, step.t, depths))  # type: ignore[arg-type]
