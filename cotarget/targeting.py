"""Solve an aim (pan, tilt and focal length) from a pixel and a depth, or from a point, with its error budget.

These are pure functions: no device and no clock.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from cotarget.calibration import Calibration, predicted_pointing
from cotarget.calibration.plausibility import check_plausible
from cotarget.camera import depth_from_size, focal_for_size
from cotarget.config import DEFAULT_TARGETS, TargetProfile, split_name
from cotarget.errors import ConfigError, UnreachableError, choices
from cotarget.geometry import FARTHEST_M, Array
from cotarget.pantilt import Pointing, nearest, shortcut, solve
from cotarget.rig import RigSpec

Method = Literal["exact", "paper-table", "paper-example"]
METHODS: tuple[Method, ...] = get_args(Method)

# Most rounds of solving the focal length. The ray of the wanted pixel depends a little on the focal length, and the
# focal length on the range along that ray. Each round shrinks the error by the lever arm over the range times the
# wanted pixel's offset from the principal point over the shortest focal length: some 1e-4 in the image's centre, where
# three rounds suffice; 3e-2 at its border.
FOCAL_ROUNDS = 12
FOCAL_FOUND = 1e-7  # relative change of the focal length at which it is found, worth less than 1e-4 px
# Standard deviation of the error of rounding to a whole number.
ROUNDED = 1 / np.sqrt(12)


@dataclass(frozen=True)
class Reach:
    """Limits of head and lens, and where the head is.

    Attributes:
        pan: lowest and highest pan [rad].
        tilt: lowest and highest tilt [rad].
        focal_px: shortest and longest nominal focal length [px].
        now: pan and tilt of the head now [rad].
        steps: resolution of pan and of tilt [rad].
    """

    pan: tuple[float, float]
    tilt: tuple[float, float]
    focal_px: tuple[float, float]
    now: tuple[float, float] = (0.0, 0.0)
    steps: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class WantedSize:
    """Size of a target [m], its wanted size in the image [px], and whether that is a height."""

    size: float
    wanted_px: float
    vertical: bool = False


@dataclass(frozen=True)
class Aim:
    """Solved pan, tilt and focal length for a target.

    Attributes:
        pan: pan to command [rad].
        tilt: tilt to command [rad].
        focal_px: true focal length [px].
        nominal_px: nominal focal length to command [px].
        limited: whether the lens's range limits the focal length.
        x_fixed: target position [m], (3,).
        range: distance from the zoom camera to the target [m].
    """

    pan: float
    tilt: float
    focal_px: float
    nominal_px: float
    limited: bool
    x_fixed: Array
    range: float

    def __str__(self) -> str:
        """Say the angles in degrees, the focal length and the depth."""
        limited = ", the lens's limit" if self.limited else ""
        return (
            f"pan {math.degrees(self.pan):z.2f} degrees, tilt {math.degrees(self.tilt):z.2f} degrees, "
            f"focal length {self.focal_px:.0f} px{limited}, depth {self.depth:.2f} m"
        )

    @property
    def depth(self) -> float:
        """Depth along the fixed camera's optical axis [m]."""
        return float(self.x_fixed[2])


def depth_of(calibration: Calibration, target: TargetProfile, size_px: float, center_px: Array) -> float:
    """Estimate a target's depth from its apparent size: z = f x_size / u_measured.

    Args:
        calibration: calibration with the fixed camera.
        target: target profile, with its size and which dimension that is.
        size_px: measured dimension in the fixed image [px].
        center_px: centre of the target in the fixed image, (2,) [px].
    """
    lens, center = calibration.fixed.lens, np.asarray(center_px, float)
    return depth_from_size(lens, target.size, size_px, center, vertical=target.is_vertical())


# Sizes of targets [m]. Beyond them another unit was meant: a beetle has 5 mm, the largest aircraft 84 m. A person's
# height in centimetres is beyond them, and so is a ship, which insisting accepts.
SIZES_M = (1e-3, 100.0)
KIND_TIMES = 10.0  # factor beyond which a target of a known kind has a size that its kind never has


def size_implausibility(target: TargetProfile, name: str = "") -> str:
    """Describe why a target profile's size is far outside of anything plausible; empty where it is not.

    Args:
        target: the target profile.
        name: name of the target in the rig's configuration; its kind, such as that of ``bird2``, has a usual size.
    """
    where = f"targets.{name}" if name else "target"
    if not SIZES_M[0] <= target.size <= SIZES_M[1]:
        return (
            f"{where}.size: {target.size:g} m is no size of a target; sizes are in metres, and {target.size:g} cm are "
            f"{target.size / 100:g}"
        )
    usual = DEFAULT_TARGETS.get(split_name(name)[0])
    if usual is not None and usual.dimension == target.dimension:
        times = target.size / usual.size
        if max(times, 1 / times) > KIND_TIMES:
            return (
                f"{where}.size: {target.size:g} m is far from the {usual.size:g} m of a {split_name(name)[0]}; sizes "
                "are in metres"
            )
    return ""


def target_implausibility(target: TargetProfile, calibration: Calibration, spec: RigSpec, name: str = "") -> str:
    """Describe what of a target profile is implausible on a rig, see `size_implausibility`; empty where nothing is.

    Raises:
        ConfigError: a stream has another aspect ratio than that calibrated.
    """
    if text := size_implausibility(target, name):
        return text
    where = f"targets.{name}" if name else "target"
    room_px = calibration.zoom_head.room_px(spec.zoom.size, vertical=target.is_vertical())
    room_px = max(spec.zoom.size) if target.largest_over_time else room_px
    if target.wanted_px > room_px:
        width, height = spec.zoom.size
        return (
            f"{where}.wanted_px: {target.wanted_px:g} px does not fit into the zoom camera's {width}x{height} image; "
            f"give less than {room_px:.0f}"
        )
    along = 1 if target.is_vertical() else 0
    # The nearest target fills the fixed image, and the longest focal length shows it largest.
    fixed = calibration.fixed.lens.resized(spec.fixed.size)
    longest = calibration.zoom_head.lens.resized(spec.zoom.size).at(spec.zoom.focal_range[1])
    largest_px = longest.focal_px[along] * spec.fixed.size[along] / fixed.focal_px[along]
    if target.wanted_px > largest_px:
        return (
            f"{where}.wanted_px: {target.wanted_px:g} px is more than the {largest_px:.0f} px at which the longest "
            "focal length shows a target that fills the fixed image"
        )
    return ""


def point_at(calibration: Calibration, pixel: Array, depth: float) -> Array:
    """Position of a pixel at a depth, x_fixed [m], (3,).

    Raises:
        UnreachableError: no ray projects to that pixel, or the depth is not in front of the camera.
    """
    if not (np.isfinite(depth) and depth > 0):
        raise UnreachableError(f"a target at a depth of {depth:g} m is not in front of the fixed camera")
    if depth > FARTHEST_M:
        raise UnreachableError(f"a target at a depth of {depth:g} m is farther than anything on earth; give metres")
    ray = calibration.fixed.ray(np.asarray(pixel, dtype=float))
    if not np.isfinite(ray).all():
        u, v = pixel
        raise UnreachableError(f"pixel ({u:g}, {v:g}) lies outside of what the fixed camera's lens can see")
    return ray * depth


def _seen_at(calibration: Calibration, pixel: npt.ArrayLike | None, depth: float | None) -> Array:
    """The point at a pixel of the fixed camera and a depth, checked as a user gives them."""
    if pixel is None or depth is None:
        raise ConfigError("aim: give x_fixed, or pixel and depth")
    if np.shape(pixel) != (2,):
        raise ConfigError(f"aim: pixel is {pixel}; give (u, v) in the fixed camera's image")
    (u, v), (width, height) = np.asarray(pixel, dtype=float), calibration.fixed.size
    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
        raise ConfigError(f"aim: pixel ({u:g}, {v:g}) is not in the fixed camera's {width}x{height} image")
    return point_at(calibration, np.array([u, v]), depth)


def aim(
    calibration: Calibration,
    x_fixed: Array | None = None,
    reach: Reach | None = None,
    *,
    pixel: npt.ArrayLike | None = None,
    depth: float | None = None,
    wanted_size: WantedSize | None = None,
    nominal_px: float | None = None,
    method: Method = "exact",
    zoom_pixel: Array | None = None,
    insist: bool = False,
) -> Aim:
    """Solve pan, tilt and focal length for a target (Eqs. 6, 13, 16 and 17, with the exact range).

    The target is either a point, or a pixel of the fixed camera with its depth. The focal length shows the target at
    the wanted size; while it is followed, `cotarget.control.zoom.ZoomController` decides how much of that is safe.

    Args:
        calibration: calibration of the rig.
        x_fixed: target position [m], (3,).
        reach: limits, and where the head is; by default any angles, and the calibrated focal lengths.
        pixel: target in the fixed image, (2,) [px].
        depth: depth along the fixed camera's optical axis [m].
        wanted_size: wanted size of the target, which decides the focal length.
        nominal_px: nominal focal length if no size is wanted [px]; the shortest by default.
        method: the exact inverse, or the paper's shortcut in one of its two readings.
        zoom_pixel: wanted place of the target in the zoom image, (2,) [px]; its centre by default.
        insist: with a pixel, whether to accept an implausible calibration, see `check_plausible`. For a point the
            calibration is not checked, because `follow` solves one a frame.

    Raises:
        CalibrationError: the calibration has no T, or is implausible.
        ConfigError: the target is given in no way or in two, its size is not above zero, or the method is unknown.
        UnreachableError: no pan and tilt within the limits do it.
    """
    if wanted_size is not None and not (0 < wanted_size.size < math.inf and 0 < wanted_size.wanted_px < math.inf):
        raise ConfigError(
            f"aim: wanted_size is {wanted_size.size!r} m at {wanted_size.wanted_px!r} px; both have to be above zero"
        )
    if method not in METHODS:
        raise ConfigError(f"unknown method '{method}'; the methods are: {choices(METHODS)}")
    if x_fixed is None:
        x_fixed = _seen_at(calibration, pixel, depth)
        check_plausible(calibration, insist=insist)
    elif pixel is not None or depth is not None:
        raise ConfigError("aim: give x_fixed, or pixel and depth, and not both")
    head, zoom = calibration.zoom_head, calibration.zoom_head.lens
    if reach is None:
        focal_px = zoom.nominal_px
        reach = Reach((-math.pi, math.pi), (-math.pi, math.pi), (focal_px[0], focal_px[-1]))
    x_base = head.in_base(x_fixed)  # Eq. 6
    wanted = zoom.stops[0].image_center_px if zoom_pixel is None else np.asarray(zoom_pixel, dtype=float)
    if wanted_size:  # start with the distance from the base for the range
        nominal_px = zoom.nominal_for(focal_for_size(wanted_size.size, wanted_size.wanted_px, math.hypot(*x_base)))
    nominal, limited = _limit(reach.focal_px[0] if nominal_px is None else nominal_px, reach)
    lens = zoom.at(nominal)
    for _ in range(FOCAL_ROUNDS if wanted_size else 1):
        ray = lens.ray(wanted)
        if method == "exact":
            pupil = zoom.pupil_at(nominal)
            ways = solve(x_base, head.hand_eye(), head.axes, ray, pupil=pupil)
            pointing = nearest(ways, reach.pan, reach.tilt, reach.now, head.axes)
        else:
            pointing = _paper(calibration, x_fixed, method, reach)
        if wanted_size:
            z = float(pointing.range * ray[2]) / math.hypot(*ray)
            focal = focal_for_size(wanted_size.size, wanted_size.wanted_px, z)  # Eq. 17
            # This focal length is along the size, and the lens is commanded by fx.
            focal *= lens.focal_px[0] / head.focal_along(lens.focal_px, vertical=wanted_size.vertical)
            previous = nominal
            nominal, limited = _limit(zoom.nominal_for(focal), reach)
            if nominal != previous:
                lens = zoom.at(nominal)
            if abs(nominal - previous) <= FOCAL_FOUND * nominal:
                break
    return Aim(
        pan=float(pointing.pan),
        tilt=float(pointing.tilt),
        focal_px=lens.focal_px[0],
        nominal_px=nominal,
        limited=limited,
        x_fixed=np.asarray(x_fixed, dtype=float),
        range=float(pointing.range),
    )


def error_budget(
    calibration: Calibration, pixel: Array, found: Aim, reach: Reach, *, size_px: float | None = None
) -> dict[str, float]:
    """Standard deviation of the line of sight that each error source causes alone [rad].

    Args:
        calibration: calibration of the rig.
        pixel: target in the fixed image, (2,).
        found: aim at it.
        reach: resolution of the head.
        size_px: measured size from which the depth comes, if it does [px].

    Returns:
        "steps": rounding to the head's steps; "pixel": a pixel rounded to a whole one; "size", if a size was given: the
        same for the size, by way of the depth; "calibration", if it has a covariance: its own noise; and "total".
    """
    # A target just inside a limit may move beyond it, so the limits do not apply here.
    free = replace(reach, pan=(-np.inf, np.inf), tilt=(-np.inf, np.inf), now=(found.pan, found.tilt))

    def moved(du: float, dv: float, depth: float) -> float:
        x_fixed = point_at(calibration, np.add(pixel, (du, dv)), depth)
        there = aim(calibration, x_fixed, free, nominal_px=found.nominal_px)
        here = aim(calibration, found.x_fixed, free, nominal_px=found.nominal_px)
        return float(np.hypot((there.pan - here.pan) * np.cos(here.tilt), there.tilt - here.tilt))

    depth = found.depth
    parts = {
        "steps": ROUNDED * float(np.hypot(reach.steps[1], reach.steps[0] * np.cos(found.tilt))),
        "pixel": float(np.hypot(moved(ROUNDED, 0.0, depth), moved(0.0, ROUNDED, depth))),
    }
    if size_px is not None:
        parts["size"] = moved(0.0, 0.0, depth * (1 + ROUNDED / size_px))
    if calibration.covariance is not None:
        there = (found.pan, found.tilt)
        sigma = predicted_pointing(calibration, pixel, depth, pan_tilt=there, nominal_px=found.nominal_px)
        parts["calibration"] = float(sigma)
    return parts | {"total": float(np.sqrt(sum(part**2 for part in parts.values())))}


def _limit(nominal_px: float, reach: Reach) -> tuple[float, bool]:
    """Limit a focal length to the lens's range; return whether that changed it."""
    limited = min(max(nominal_px, reach.focal_px[0]), reach.focal_px[1])
    return limited, limited != nominal_px


def _paper(calibration: Calibration, x_fixed: Array, method: Method, reach: Reach) -> Pointing:
    """Solve by the paper's shortcut and choose the reachable solution."""
    reading: Literal["table", "example"] = "table" if method == "paper-table" else "example"
    head = calibration.zoom_head
    found = shortcut(x_fixed, head.T_zoom0_fixed, head.hand_eye(), reading)
    if not np.isfinite(found.pan):
        raise UnreachableError("the paper's shortcut has no solution for this point; use the exact method")
    pan, tilt = head.axes.reported_angles(np.atleast_1d(found.pan), np.atleast_1d(found.tilt))
    return nearest(Pointing(pan, tilt, np.atleast_1d(found.range)), reach.pan, reach.tilt, reach.now, head.axes)
