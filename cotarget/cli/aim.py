"""Solve pan, tilt, focal length of a pixel: `cotarget aim --calibration calibration.json --pixel 500 200 --depth 9`."""

import argparse
import math
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING

from cotarget.cli.common import add_file, add_insist, focal_px_of, load_plausible, positive, print_json
from cotarget.errors import ConfigError, naming

if TYPE_CHECKING:
    from cotarget.calibration import Calibration
    from cotarget.config import RigConfig, TargetProfile
    from cotarget.targeting import Aim


LEAST_SEEN_PX = 1.0  # size of a target in the fixed image that no detector finds; it was given in millimetres


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_file(parser, "--calibration", "calibration.json", required=True)
    about = "pixel of the fixed image"
    parser.add_argument("--pixel", type=float, nargs=2, required=True, metavar=("U", "V"), help=about)
    how_far = parser.add_mutually_exclusive_group(required=True)
    how_far.add_argument("--depth", type=positive, metavar="M", help="depth along the fixed camera's axis [m]")
    about = "size of the target of --target in the fixed image [px]"
    how_far.add_argument("--size-px", type=positive, metavar="S", help=about)
    parser.add_argument("--target", metavar="NAME", help="a target of rig.toml, for its size and its wanted size")
    how_close = parser.add_mutually_exclusive_group()
    about = "wanted size in the close-up (the target's) [px]"
    how_close.add_argument("--wanted-px", type=positive, metavar="N", help=about)
    how_close.add_argument("--focal-mm", type=positive, metavar="F", help="focal length to use [mm]")
    add_file(parser, "--rig", "rig.toml, for limits and targets (the default rig)")
    ways = ("exact", "paper-table", "paper-example")  # compared by `python -m experiments shortcut`
    parser.add_argument("--ik", choices=ways, default="exact", help=argparse.SUPPRESS)
    add_insist(parser)


def run(options: argparse.Namespace) -> None:
    """Print pan, tilt and focal length for one pixel of the fixed camera."""
    import numpy as np

    from cotarget.backends import describe, load_config
    from cotarget.config import RigConfig
    from cotarget.targeting import Reach, WantedSize, aim, error_budget, point_at

    config = RigConfig() if options.rig is None else load_config(options.rig)
    if config.backend == "replay":
        raise ConfigError(f"{options.rig}: backend is 'replay'; give the rig.toml of the rig that was recorded")
    spec = describe(config)
    calibration = load_plausible(options.calibration, None if options.rig is None else spec, insist=options.insist)
    if options.rig is not None:
        calibration = calibration.for_streams(spec.fixed.size, spec.zoom.size)
    target = _target(options, config, calibration)
    pixel, size = np.array(options.pixel), calibration.fixed.size
    if not (np.all(pixel >= -0.5) and np.all(pixel <= np.array(size) - 0.5)):
        raise ConfigError(
            f"--pixel: ({pixel[0]:g}, {pixel[1]:g}) is not in the fixed camera's {size[0]}x{size[1]} image"
        )
    depth = options.depth if target is None or options.size_px is None else _depth(options, target, calibration)
    pitch_mm = calibration.pitch_mm or spec.zoom.pitch_mm
    shortest, longest = spec.zoom.focal_range
    if options.rig is None:  # without a rig.toml, the calibration gives the shortest focal length
        shortest = calibration.zoom_head.lens.nominal_px[0]
    limits = spec.head.limits
    steps = (limits.pan.step, limits.tilt.step)
    reach = Reach(limits.pan.range, limits.tilt.range, (shortest, max(shortest, longest)), steps=steps)
    wanted, nominal = None, None
    if target is not None and options.focal_mm is None:
        wanted = WantedSize(target.size, options.wanted_px or target.wanted_px, target.is_vertical())
    if options.focal_mm is not None:
        nominal = focal_px_of(options.focal_mm, pitch_mm, reach.focal_px)
    point = point_at(calibration, pixel, depth)
    found = aim(calibration, point, reach, wanted_size=wanted, nominal_px=nominal, method=options.ik)
    # The error budget holds for the exact inverse; the shortcut's additional error is not modelled.
    budget = error_budget(calibration, pixel, found, reach, size_px=options.size_px) if options.ik == "exact" else None
    is_calibrated = _check_focal_length(calibration, found)
    targets = config.targets if target is None else {options.target: target}
    is_plausible = _check_depth(options, calibration, found, targets)
    print_json(
        {
            "pan_deg": math.degrees(found.pan),
            "tilt_deg": math.degrees(found.tilt),
            "focal_px": found.focal_px,
            "focal_mm": pitch_mm and found.nominal_px * pitch_mm,
            "focal_limited": found.limited,
            "focal_calibrated": is_calibrated,
            "depth_m": found.depth,
            "depth_plausible": is_plausible,
            "range_m": found.range,
            "predicted_error_deg": budget and {name: math.degrees(part) for name, part in budget.items()},
            "predicted_error_px": budget and math.tan(budget["total"]) * found.focal_px,
        }
    )


def _check_focal_length(calibration: "Calibration", found: "Aim") -> bool:
    """Whether an aim's focal length is among those calibrated; warn if not."""
    from cotarget.calibration.zoom_samples import SAME_FOCAL

    nominal_px = calibration.zoom_head.lens.nominal_px
    shortest, longest = nominal_px[0], nominal_px[-1]
    if shortest * (1 - SAME_FOCAL) <= found.nominal_px <= longest * (1 + SAME_FOCAL):
        return True
    _warn(
        f"a nominal focal length of {found.nominal_px:.0f} px is outside the calibrated ones, {shortest:.0f} to "
        f"{longest:.0f} px: the aim is extrapolated"
    )
    return False


def _check_depth(
    options: argparse.Namespace, calibration: "Calibration", found: "Aim", targets: Mapping[str, "TargetProfile"]
) -> bool:
    """Whether one of the targets fits into the fixed view at an aim's depth, and is seen there; warn if none does.

    Raises:
        ConfigError: the depth of --depth is so large that the fixed camera shows none of the targets.
    """
    (width, height), (fx, fy) = calibration.fixed.size, calibration.fixed.lens.focal_px
    nearest, name = min(
        (target.size * (fy / height if target.is_vertical() else fx / width), name) for name, target in targets.items()
    )
    if found.depth < nearest:
        _warn(f"the {name} fits into the fixed view only from {nearest:.2g} m on; is {found.depth:g} m meant?")
        return False
    largest_px, name = max((fx * target.size / found.depth, name) for name, target in targets.items())
    if largest_px >= LEAST_SEEN_PX:
        return True
    if options.depth is not None and not options.insist:
        raise ConfigError(
            f"--depth: at {options.depth:g} m the {name} is {largest_px:.2g} px large in the fixed image; is "
            f"{options.depth / 1000:g} m meant? --insist aims there all the same"
        )
    return False


def _target(options: argparse.Namespace, config: "RigConfig", calibration: "Calibration") -> "TargetProfile | None":
    """Look up the target of --target, and check the options that need it."""
    from cotarget.targeting import size_implausibility

    if options.target is None:
        if options.size_px is not None:
            raise ConfigError("--size-px needs --target NAME, whose true size gives the depth")
        if options.wanted_px is not None:
            raise ConfigError("--wanted-px needs --target NAME, whose true size gives the focal length")
        return None
    with naming("--target"):
        target = config.target(options.target)
    if not options.insist and (text := size_implausibility(target, options.target)):
        raise ConfigError(f"{options.rig}: {text}; --insist takes it all the same")
    where, wanted_px, size = "--wanted-px", options.wanted_px, calibration.zoom_head.lens.size
    if wanted_px is None and options.focal_mm is None and not options.insist:
        where, wanted_px = f"--wanted-px: missing, and targets.{options.target}.wanted_px", target.wanted_px
    if wanted_px is not None and wanted_px > calibration.zoom_head.room_px(size, vertical=target.is_vertical()):
        raise ConfigError(f"{where}: {wanted_px:g} px do not fit into the zoom camera's {size[0]}x{size[1]} image")
    return target


def _depth(options: argparse.Namespace, target: "TargetProfile", calibration: "Calibration") -> float:
    """Compute the depth at which the target has the size of --size-px [m]."""
    import numpy as np

    from cotarget.targeting import depth_of

    depth = depth_of(calibration, target, options.size_px, np.array(options.pixel))
    if not math.isfinite(depth):
        width, height = calibration.fixed.size
        raise ConfigError(
            f"--size-px: {options.size_px:g} px is no size that a {options.target} of {target.size:g} m has in the "
            f"fixed camera's {width}x{height} image"
        )
    return depth


def _warn(text: str) -> None:
    print(f"cotarget aim: {text}", file=sys.stderr)
