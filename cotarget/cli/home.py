"""Send head and lens home: pan and tilt 0, and the shortest focal length: `cotarget home`."""

import argparse

from cotarget.cli.common import add_rig, open_named, print_json
from cotarget.cli.where import position
from cotarget.errors import ConfigError, DeviceError


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_rig(parser)


def run(options: argparse.Namespace) -> None:
    """Move head and lens, wait for both, and print where they are."""
    from cotarget.backends import load_config
    from cotarget.calibration.recorder import wait_for_head, wait_for_lens
    from cotarget.control.orders import HOME
    from cotarget.safety.stop_file import refuse_if_stopped

    config = load_config(options.rig)
    refuse_if_stopped(config.safety.stop_file)
    if config.backend == "replay":
        raise ConfigError(f"{options.rig}: backend is 'replay'; a recording's head and lens cannot be sent anywhere")
    with open_named(options.rig, config, partial=True) as rig:
        if "zoom" not in rig.missing:
            rig.zoom.zoom(rig.zoom.focal_range[0])
        if "head" not in rig.missing:
            now = rig.head.state()
            goal = rig.head.move(*rig.head.limits.clip(*HOME), wait=True)
            if not wait_for_head(rig, goal, max(abs(goal[0] - now.pan), abs(goal[1] - now.tilt)))[1]:
                raise DeviceError("the head does not stand at home: see that nothing is in its way")
        if "zoom" not in rig.missing:
            wait_for_lens(rig)
        print_json(position(rig))
