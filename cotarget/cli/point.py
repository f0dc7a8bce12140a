"""Move head and lens to given values, and take a picture with each camera: `cotarget point --pan-deg 10`."""

import argparse
import math

from cotarget.cli.common import (
    add_file,
    add_rig,
    check_outputs,
    check_within,
    number,
    open_named,
    positive,
    previous_kept,
    print_json,
    rig_files,
)
from cotarget.cli.where import position
from cotarget.errors import ConfigError, DeviceError


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_rig(parser)
    parser.add_argument("--pan-deg", type=number, metavar="A", help="pan, positive to the right (unchanged)")
    parser.add_argument("--tilt-deg", type=number, metavar="A", help="tilt, positive up (unchanged)")
    parser.add_argument("--focal-mm", type=positive, metavar="F", help="focal length [mm] (unchanged)")
    about = "write fixed.png and zoom.png to this folder; earlier ones are kept under other names"
    add_file(parser, "--pictures", about, "DIR")


def run(options: argparse.Namespace) -> None:
    """Move head and lens, and write a picture of each camera on request."""
    from cotarget.backends import load_config
    from cotarget.calibration.captures import write_image
    from cotarget.calibration.recorder import wait_for_head, wait_for_lens
    from cotarget.rig import refuse_outside
    from cotarget.safety.stop_file import refuse_if_stopped

    config = load_config(options.rig)
    refuse_if_stopped(config.safety.stop_file)
    shots = {} if options.pictures is None else {name: options.pictures / f"{name}.png" for name in ("fixed", "zoom")}
    check_outputs(shots.values(), rig_files(options.rig, config))
    if config.backend == "replay":
        raise ConfigError(f"{options.rig}: backend is 'replay'; a recording's head and lens cannot be sent anywhere")
    with open_named(options.rig, config) as rig:
        limits = rig.head.limits
        for option, angle, bounds in (
            ("--pan-deg", options.pan_deg, limits.pan),
            ("--tilt-deg", options.tilt_deg, limits.tilt),
        ):
            if angle is not None:
                low, high = map(math.degrees, bounds)
                check_within(option, angle, (low, high), "the head's {} degrees", math.degrees(limits.step))
        now, asked = rig.head.state(), {"pan": options.pan_deg, "tilt": options.tilt_deg}
        moves = any(angle is not None for angle in asked.values())
        if moves:
            refuse_outside(now, limits, [axis for axis, angle in asked.items() if angle is None])
        if options.focal_mm is not None:
            shortest, longest = (focal * rig.spec.zoom.pitch_mm for focal in rig.zoom.focal_range)
            check_within("--focal-mm", options.focal_mm, (shortest, longest), "the lens's {} mm")
            rig.zoom.zoom(options.focal_mm / rig.spec.zoom.pitch_mm)
        if moves:  # an axis that is not asked for is sent to where it stands
            pan, tilt = (getattr(now, axis) if angle is None else math.radians(angle) for axis, angle in asked.items())
            goal = rig.head.move(pan, tilt, wait=True)
            if not wait_for_head(rig, goal, max(abs(goal[0] - now.pan), abs(goal[1] - now.tilt)))[1]:
                raise DeviceError(
                    "the head does not stand where it was sent: see that nothing is in its way and that its driver "
                    "reports where it is"
                )
        wait_for_lens(rig)
        head, lens = rig.head.state(), rig.zoom.state()
        for name, path in shots.items():
            frame = rig.fixed.read(newer_than=head.t) if name == "fixed" else rig.zoom.capture()
            with previous_kept(path):
                write_image(path, frame.image)
    print_json(position(rig, head, lens) | {"pictures": {name: str(path) for name, path in shots.items()}})
