"""Puts Steps and calibrations beside a simulated world's truth, which the pipeline cannot see."""

import math

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import TargetConfig
from cotarget.errors import UnreachableError
from cotarget.geometry import Array
from cotarget.loop import Step
from cotarget.metrics import WHOLLY_VISIBLE, Row
from cotarget.sim.truth import Truth
from cotarget.targeting import Method, Reach, aim

# Pointing error is stated for targets at these depths, all over the wide view [m].
POINTING_DEPTHS = (4.0, 30.0)


def observe(step: Step, truth: Truth, name: str, target: TargetConfig) -> Row:
    """Put a Step beside the truth at its zoom frame's own time.

    Args:
        step: of the loop.
        truth: of the simulated world.
        name: of the target that is followed.
        target: gives its dimension and the size wanted.
    """
    t, center = step.zoom.t, truth.center(name, step.zoom.t)
    zoom_px, wide_px = truth.pixel("zoom", center, t), truth.pixel("fixed", center, t)
    outline, wide_outline = truth.silhouette(name, "zoom", t), truth.silhouette(name, "fixed", t)
    size = math.nan
    if outline is not None:
        width, height = outline.size_px
        sides = {"width": width, "height": height}
        size = sides[target.dimension] if target.dimension in sides else truth.largest_side_px(name, "zoom", t)
    focal = truth.lens("zoom", t).focal_px[0]
    longest = truth.zoom_lens_for(truth.focal_range[1]).focal_px[0]
    pan, tilt = truth.head_at(t)
    detected = (math.nan, math.nan) if step.target is None else tuple(step.target.predict(t))
    height_px, width_px = step.zoom.image.shape[:2]
    return Row(
        t_s=t,
        state=str(step.state),
        track=-1 if step.target is None else step.target.id,
        u_px=float(zoom_px[0]),
        v_px=float(zoom_px[1]),
        width_px=width_px,
        height_px=height_px,
        size_px=float(size),
        wanted_px=float(np.fmin(target.wanted_px, size * longest / focal)),
        visible=0.0 if outline is None else outline.visible,
        in_wide=wide_outline is not None and wide_outline.visible >= WHOLLY_VISIBLE,
        u_wide_px=float(wide_px[0]),
        v_wide_px=float(wide_px[1]),
        u_detected_px=float(detected[0]),
        v_detected_px=float(detected[1]),
        range_m=float(np.linalg.norm(center - truth.T_world_camera("zoom", t).translation)),
        depth_m=math.nan if step.aim is None else step.aim.depth,
        pan_commanded_deg=math.degrees(step.commanded[0]),
        tilt_commanded_deg=math.degrees(step.commanded[1]),
        focal_commanded_px=step.commanded[2],
        pan_deg=math.degrees(pan),
        tilt_deg=math.degrees(tilt),
        focal_px=focal,
        target=name,
    )


def pointing_errors(
    calibration: Calibration,
    truth: Truth,
    reach: Reach,
    rng: np.random.Generator,
    count: int,
    method: Method = "exact",
) -> Array:
    """Pointing error of a calibration: pixel and depth given exactly, before rounding to steps.

    Args:
        calibration: to be judged.
        truth: of the simulated world that it is of.
        reach: limits of head and lens; the shortest focal length is used.
        rng: draws the targets, evenly over the wide image and over depth.
        count: how many targets.
        method: the exact inverse, or the paper's shortcut.

    Returns:
        Angle between the line of sight and the true target for each that can be reached [rad], (n,), n <= count.
    """
    lens = truth.fixed_lens
    errors = []
    for _ in range(count):
        pixel = rng.uniform(-0.5, np.array(lens.size) - 0.5)
        depth = rng.uniform(*POINTING_DEPTHS)
        x_world = truth.T_world_fixed.apply(np.append(lens.directions(pixel), 1.0) * depth)
        try:
            found = aim(calibration, calibration.fixed.ray(pixel) * depth, reach, method=method)
        except UnreachableError:
            continue
        errors.append(truth.line_of_sight_miss(found.pan, found.tilt, found.nominal_px, x_world))
    return np.array(errors)
