"""Say where head and lens are, without moving them; JSON on stdout: `cotarget where`."""

import argparse
import math
from typing import TYPE_CHECKING, Any

from cotarget.cli.common import add_rig, open_named, print_json
from cotarget.errors import ConfigError

if TYPE_CHECKING:
    from cotarget.rig import Rig


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_rig(parser)


def run(options: argparse.Namespace) -> None:
    """Print pan, tilt and focal length, and whether something moves; a stopped rig may be asked too."""
    from cotarget.backends import load_config

    config = load_config(options.rig)
    if config.backend == "replay":
        raise ConfigError(f"{options.rig}: backend is 'replay'; a recording's head and lens are nowhere")
    with open_named(options.rig, config, guarded=False, partial=True) as rig:
        print_json(position(rig, is_moving=True))


def position(rig: "Rig", *, is_moving: bool = False) -> dict[str, Any]:
    """Say where head and lens are, null for one that is missing; and whether something moves, if that is asked for."""
    head = None if "head" in rig.missing else rig.head.state()
    lens = None if "zoom" in rig.missing else rig.zoom.state()
    pitch_mm = rig.spec.zoom.pitch_mm
    said = {
        "pan_deg": head and math.degrees(head.pan),
        "tilt_deg": head and math.degrees(head.tilt),
        "focal_mm": None if lens is None or pitch_mm is None else lens.focal_px * pitch_mm,
        "focal_px": lens and lens.focal_px,
    }
    return said | ({"moving": any(each is not None and each.moving for each in (head, lens))} if is_moving else {})
