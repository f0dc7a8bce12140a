"""Move head and lens to given values, and take a picture with each camera: `cotarget point --pan-deg 10`."""

import argparse
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from cotarget.cli.common import (
    add_file,
    add_rig,
    check_outputs,
    check_within,
    focal_px_of,
    number,
    open_named,
    positive,
    previous_kept,
    print_json,
    rig_files,
)
from cotarget.cli.where import position
from cotarget.errors import ConfigError, DeviceError

if TYPE_CHECKING:
    from cotarget.rig import Rig


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_rig(parser)
    parser.add_argument("--pan-deg", type=number, metavar="A", help="pan, positive to the right (unchanged)")
    parser.add_argument("--tilt-deg", type=number, metavar="A", help="tilt, positive up (unchanged)")
    lens = parser.add_mutually_exclusive_group()
    lens.add_argument("--focal-mm", type=positive, metavar="F", help="focal length [mm] (unchanged)")
    lens.add_argument("--focal-px", type=positive, metavar="F", help="nominal focal length [px] (unchanged)")
    about = "write fixed.png and zoom.png to this folder; earlier ones are kept under other names"
    add_file(parser, "--pictures", about, "DIR")


def run(options: argparse.Namespace) -> None:
    """Move head and lens, and write a picture of each camera on request."""
    from cotarget.backends import load_config
    from cotarget.calibration.captures import write_image
    from cotarget.calibration.recorder import wait_for_head, wait_for_lens
    from cotarget.safety.stop_file import refuse_if_stopped

    config = load_config(options.rig)
    refuse_if_stopped(config.safety.stop_file)
    shots = {} if options.pictures is None else {name: options.pictures / f"{name}.png" for name in ("fixed", "zoom")}
    check_outputs(shots.values(), rig_files(options.rig, config))
    if config.backend == "replay":
        raise ConfigError(f"{options.rig}: backend is 'replay'; a recording's head and lens cannot be sent anywhere")
    asked = {"pan": options.pan_deg, "tilt": options.tilt_deg}
    with open_named(options.rig, config, partial=True) as rig:
        if moves := any(angle is not None for angle in asked.values()):
            goal = _goal(rig, asked)
        if options.focal_mm is not None or options.focal_px is not None:
            rig.zoom.state()  # there is a lens
            focal_px = options.focal_px
            if focal_px is None:
                focal_px = focal_px_of(options.focal_mm, rig.spec.zoom.pitch_mm, rig.zoom.focal_range)
            else:
                check_within("--focal-px", focal_px, rig.zoom.focal_range, "the lens's {} px")
            rig.zoom.zoom(focal_px)
        if moves:
            now = rig.head.state()
            goal = rig.head.move(*goal, wait=True)
            if not wait_for_head(rig, goal, max(abs(goal[0] - now.pan), abs(goal[1] - now.tilt)))[1]:
                raise DeviceError(
                    "the head does not stand where it was sent: see that nothing is in its way and that its driver "
                    "reports where it is"
                )
        if "zoom" not in rig.missing:
            wait_for_lens(rig)
        said, shots = position(rig), {name: path for name, path in shots.items() if name not in rig.missing}
        stands_t = rig.clock.now() if "head" in rig.missing else rig.head.state().t
        for name, path in shots.items():
            frame = rig.fixed.read(newer_than=stands_t) if name == "fixed" else rig.zoom.capture()
            with previous_kept(path):
                write_image(path, frame.image)
    print_json(said | {"pictures": {name: str(path) for name, path in shots.items()}})


def _goal(rig: "Rig", asked: Mapping[str, float | None]) -> tuple[float, float]:
    """Return pan and tilt to command [rad]; an axis that is not asked for is sent to where it stands.

    Args:
        rig: the rig.
        asked: the angles asked for [degrees].

    Raises:
        ConfigError: an angle is beyond the head's limits.
        DeviceError: an axis that is not asked for stands beyond them.
    """
    from cotarget.rig import refuse_outside

    now, goal = rig.head.state(), []
    refuse_outside(now, rig.head.limits, [axis for axis, angle in asked.items() if angle is None])
    for (name, angle), axis in zip(asked.items(), rig.head.limits.axes, strict=True):
        if angle is not None:
            low, high = map(math.degrees, axis.range)
            check_within(f"--{name}-deg", angle, (low, high), "the head's {} degrees", math.degrees(axis.step))
        goal.append(getattr(now, name) if angle is None else math.radians(angle))
    return goal[0], goal[1]
