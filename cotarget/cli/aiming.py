"""The command that tells where to point for one pixel of the fixed camera: aim."""

import argparse
import math
import sys
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from cotarget.cli.arguments import check_within, print_json
from cotarget.errors import ConfigError

if TYPE_CHECKING:
    from cotarget.calibration import Calibration
    from cotarget.config import TargetConfig

SMALL_PX = 10.0  # sizes below are told with two digits, others in whole pixels


def aim(options: argparse.Namespace) -> None:
    """Cotarget aim."""
    import numpy as np

    from cotarget.calibration import load_calibration
    from cotarget.calibration.stops import SAME_FOCAL
    from cotarget.config import RigConfig, load_config
    from cotarget.targeting import Closeup, Reach, depth_of, error_budget, point_at
    from cotarget.targeting import aim as aim_at

    config = RigConfig() if options.rig is None else load_config(options.rig)
    if config.backend == "replay":
        raise ConfigError(f"{options.rig}: backend is 'replay'; give the rig.toml of the rig that was recorded")
    calibration = load_calibration(options.calibration)
    if options.rig is not None:
        calibration = calibration.for_streams(*config.stream_sizes)
    target = None if options.target is None else config.target(options.target)
    if options.size_px is not None and target is None:
        raise ConfigError("--size-px needs --target NAME, whose true size gives the depth")
    if options.wanted_px is not None and target is None:
        raise ConfigError("--wanted-px needs --target NAME, whose true size gives the focal length")
    depth = options.depth
    if target is not None and options.size_px is not None:
        depth = depth_of(calibration, target, options.size_px, np.array(options.pixel))
        if not math.isfinite(depth):
            raise ConfigError(
                f"--size-px: {options.size_px:g} px is no size that a {options.target} of {target.size:g} m has in the "
                "fixed camera's {}x{} image".format(*calibration.fixed.size)
            )
    pitch_mm = calibration.pitch_mm or config.pitch_mm
    shortest, longest = config.focal_range_px
    if options.rig is None:  # the calibration knows its own lens's shortest focal length
        shortest = calibration.zoom.nominal_px[0]
    reach = Reach(*config.head_limits, (shortest, max(shortest, longest)), step=config.head_step)
    closeup = (
        Closeup(target.size, options.wanted_px, target.dimension == "height")
        if target and options.wanted_px is not None
        else None
    )
    nominal = None if options.focal_mm is None else options.focal_mm / pitch_mm
    if nominal is not None:
        shortest, longest = (f * pitch_mm for f in reach.focal_px)
        check_within("--focal-mm", options.focal_mm, (shortest, longest), "the lens's {} mm")
    pixel = np.array(options.pixel)
    size = calibration.fixed.size
    if not (np.all(pixel >= -0.5) and np.all(pixel <= np.array(size) - 0.5)):
        raise ConfigError(
            f"--pixel: ({pixel[0]:g}, {pixel[1]:g}) is not in the fixed camera's {size[0]}x{size[1]} image"
        )
    found = aim_at(
        calibration, point_at(calibration, pixel, depth), reach, closeup=closeup, nominal_px=nominal, method=options.ik
    )
    # The budget speaks of the exact inverse; what the paper's shortcut loses beside it, nothing here knows.
    budget = error_budget(calibration, pixel, found, reach, size_px=options.size_px) if options.ik == "exact" else None
    calibrated = calibration.zoom.nominal_px
    within = calibrated[0] * (1 - SAME_FOCAL) <= found.nominal_px <= calibrated[-1] * (1 + SAME_FOCAL)
    if not within:
        print(
            f"cotarget aim: {found.nominal_px * pitch_mm:.1f} mm is beyond the focal lengths calibrated, "
            f"{calibrated[0] * pitch_mm:.1f} to {calibrated[-1] * pitch_mm:.1f} mm: the prediction only guesses there",
            file=sys.stderr,
        )
    nearest, name = min(_fits_from(calibration, config.targets if target is None else {options.target: target}))
    plausible = found.depth >= nearest
    if not plausible:
        fits = f"no target, not even the {name}, fits" if target is None else f"the {name} does not fit"
        print(
            f"cotarget aim: {fits} into the fixed view nearer than {nearest:.2g} m: is a depth of {found.depth:g} m "
            "meant?",
            file=sys.stderr,
        )
    if closeup is not None and found.limited:
        focal = calibration.zoom.at(found.nominal_px).focal_px[int(closeup.vertical)]
        shown, wanted = _pixels(focal * closeup.size / found.range), _pixels(closeup.wanted_px)
        if shown != wanted:
            print(
                f"cotarget aim: the lens shows the {options.target} {shown} px large there, and not {wanted}",
                file=sys.stderr,
            )
    print_json(
        {
            "pan_deg": math.degrees(found.pan),
            "tilt_deg": math.degrees(found.tilt),
            "focal_px": found.focal_px,
            "focal_mm": found.nominal_px * pitch_mm,
            "focal_limited": found.limited,
            "focal_calibrated": within,
            "depth_m": found.depth,
            "depth_plausible": plausible,
            "range_m": found.range,
            "predicted_error_deg": budget and {name: math.degrees(part) for name, part in budget.items()},
            "predicted_error_px": budget and math.tan(budget["total"]) * found.focal_px,
        }
    )


def _fits_from(calibration: "Calibration", targets: Mapping[str, "TargetConfig"]) -> Iterator[tuple[float, str]]:
    """From which depth on each target fits into the fixed view [m], and its name; a nearer one is hardly meant."""
    for name, target in targets.items():
        axis = 1 if target.dimension == "height" else 0
        yield calibration.fixed.focal_px[axis] * target.size / calibration.fixed.size[axis], name


def _pixels(size: float) -> str:
    """A size in an image in words: whole pixels, but for the smallest."""
    return f"{size:.2g}" if size < SMALL_PX else f"{size:.0f}"
