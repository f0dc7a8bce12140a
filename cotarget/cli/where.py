"""Say where head and lens are, without moving them; JSON on stdout: `cotarget where`."""

import argparse
import math

from cotarget.cli.common import add_rig, open_named, print_json
from cotarget.errors import ConfigError


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_rig(parser)


def run(options: argparse.Namespace) -> None:
    """Print pan, tilt and focal length, and whether something moves; a stopped rig may be asked too."""
    from cotarget.backends import load_config

    config = load_config(options.rig)
    if config.backend == "replay":
        raise ConfigError(f"{options.rig}: backend is 'replay'; a recording's head and lens are nowhere")
    with open_named(options.rig, config, guarded=False) as rig:
        head, lens = rig.head.state(), rig.zoom.state()
    print_json(
        {
            "pan_deg": math.degrees(head.pan),
            "tilt_deg": math.degrees(head.tilt),
            "focal_mm": lens.focal_px * rig.spec.zoom.pitch_mm,
            "moving": head.moving or lens.moving,
        }
    )
