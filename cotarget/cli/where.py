"""Say where head and lens are, without moving them; JSON on stdout: `cotarget where`."""

import argparse
import math
from typing import TYPE_CHECKING, Any

from cotarget.cli.common import add_rig, open_named, print_json
from cotarget.errors import ConfigError

if TYPE_CHECKING:
    from cotarget.rig import PanTiltState, Rig, ZoomState


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
    print_json(position(rig, head, lens) | {"moving": head.moving or lens.moving})


def position(rig: "Rig", head: "PanTiltState", lens: "ZoomState") -> dict[str, Any]:
    """Build what is printed of where head and lens are."""
    return {
        "pan_deg": math.degrees(head.pan),
        "tilt_deg": math.degrees(head.tilt),
        "focal_mm": lens.focal_px * rig.spec.zoom.pitch_mm,
    }
