"""What the [sim] tables of rig.toml must not say: values of the right type that make no sense."""

import itertools
import math
from collections.abc import Iterable

import numpy as np

from cotarget.camera import Intrinsics
from cotarget.errors import ConfigError, choices
from cotarget.simconfig import TARGETS, SimCamera, SimConfig, SimZoomCamera, split_name

# The curves of the zoom lens are checked at this many focal lengths.
CHECKED_FOCALS = 33
# Farther than any lens is long: an entrance pupil that moves so far was given in millimetres [m].
FARTHEST_PUPIL = 1.0
# Beyond these it is another unit that was meant: of millimetres, degrees, frames a second and grey levels.
MOST_AXIS_OFFSET_MM, MOST_SQUARENESS_DEG, MOST_RATE_HZ, MOST_NOISE = 1000.0, 45.0, 1000.0, 255.0
MODEL_SUFFIXES = (".obj", ".stl", ".xml")  # of what a target of one's own is made of


def check_sim(sim: SimConfig) -> None:
    """Refuse a simulated world that cannot be.

    Raises:
        ConfigError: with the key.
    """
    check_numbers(sim)
    for name, camera in (("fixed", sim.fixed), ("zoom", sim.zoom)):
        _check_center(f"sim.{name}", camera)
        _check_frame_time(f"sim.{name}", camera)
        _check_lens(f"sim.{name}", camera)
    if sim.effects.optics:
        _check_optics(sim.zoom)
    for name, waypoints in sim.paths.items():
        if len(waypoints) < 2 or any(b[0] <= a[0] for a, b in itertools.pairwise(waypoints)):
            raise ConfigError(f"sim.paths.{name}: needs two or more waypoints [t, x, y, z] with increasing t")
    _check_models(sim)
    _check_targets(sim)
    for name in sim.targets:
        if split_name(name)[0] in sim.models and name not in sim.paths:
            raise ConfigError(
                f"sim.targets: a {name} of your own needs a way: [sim.paths] {name} = [[t, x, y, z], ...]"
            )


def check_numbers(sim: SimConfig) -> None:
    """Refuse what no rig can be, simulated or of a recording: sizes, rates and limits.

    Raises:
        ConfigError: with the key.
    """
    positive: dict[str, tuple[float, ...]] = {
        "sim.zoom.pitch_mm": (sim.zoom.pitch_mm,),
        "sim.zoom.lens_speed": (sim.zoom.lens_speed,),
        "sim.head.speed_deg_s": (sim.head.speed_deg_s,),
        "sim.head.accel_deg_s2": (sim.head.accel_deg_s2,),
    }
    not_negative: dict[str, tuple[float, ...]] = {
        "sim.seed": (sim.seed,),
        "sim.head.step_deg": (sim.head.step_deg,),
        "sim.head.command_delay_s": (sim.head.command_delay_s,),
        "sim.head.backlash_deg": (sim.head.backlash_deg,),
    }
    for name, camera in (("fixed", sim.fixed), ("zoom", sim.zoom)):
        positive[f"sim.{name}.size"] = camera.size
        positive[f"sim.{name}.focal_px"] = camera.focal_px
        positive[f"sim.{name}.rate_hz"] = (camera.rate_hz,)
        not_negative[f"sim.{name}.noise"] = (camera.noise,)
        not_negative[f"sim.{name}.latency_s"] = (camera.latency_s,)
        not_negative[f"sim.{name}.exposure_s"] = (camera.exposure_s,)
        if not 1 <= camera.jpeg_quality <= 100:
            raise ConfigError(f"sim.{name}.jpeg_quality: {camera.jpeg_quality} is not within 1 to 100")
    for where, values in positive.items():
        if min(values) <= 0:
            raise ConfigError(f"{where}: {min(values):g} is not greater than zero")
    for where, values in not_negative.items():
        if min(values) < 0:
            raise ConfigError(f"{where}: {min(values):g} is negative")
    at_most: dict[str, tuple[float, float]] = {
        "sim.head.axis_offset_mm": (abs(sim.head.axis_offset_mm), MOST_AXIS_OFFSET_MM),
        "sim.head.squareness_deg": (abs(sim.head.squareness_deg), MOST_SQUARENESS_DEG),
        "sim.fixed.rate_hz": (sim.fixed.rate_hz, MOST_RATE_HZ),
        "sim.zoom.rate_hz": (sim.zoom.rate_hz, MOST_RATE_HZ),
        "sim.fixed.noise": (sim.fixed.noise, MOST_NOISE),
        "sim.zoom.noise": (sim.zoom.noise, MOST_NOISE),
    }
    for where, (value, most) in at_most.items():
        if value > most:
            raise ConfigError(f"{where}: {value:g} is more than {most:g}")
    ranges = {
        "sim.head.pan_deg": sim.head.pan_deg,
        "sim.head.tilt_deg": sim.head.tilt_deg,
        "sim.zoom.focal_mm": sim.zoom.focal_mm,
    }
    for where, limits in ranges.items():
        if limits[0] >= limits[1]:
            raise ConfigError(f"{where}: {list(limits)} is not [lowest, highest]")
    if sim.zoom.focal_mm[0] <= 0:
        raise ConfigError(f"sim.zoom.focal_mm: {sim.zoom.focal_mm[0]:g} is not greater than zero")
    if sim.zoom.lens_steps < 2:
        raise ConfigError(f"sim.zoom.lens_steps: {sim.zoom.lens_steps} is fewer than 2")


def told_targets(own: Iterable[str] = ()) -> str:
    """Which targets the simulation has, with those of [sim.models], for messages."""
    return (
        f"the simulation has: {choices([*TARGETS, *own])}, and further ones with a number, as 'bird2'; others need a "
        "model: [sim.models]"
    )


def _check_models(sim: SimConfig) -> None:
    """Refuse models of targets that the simulation has, and files that can be none."""
    for name, path in sim.models.items():
        if name in TARGETS:
            raise ConfigError(f"sim.models.{name}: the simulation has a {name} of its own; give yours another name")
        if split_name(name)[1] > 1:
            raise ConfigError(f"sim.models.{name}: a model is of a kind; give its name without the number")
        if path.suffix not in MODEL_SUFFIXES:
            raise ConfigError(f"sim.models.{name}: {path} is not one of: {choices(MODEL_SUFFIXES)}")


def _check_targets(sim: SimConfig) -> None:
    """Refuse targets of which there is no model, and two of a name."""
    for where, names in (("sim.targets", sim.targets), ("sim.paths", tuple(sim.paths))):
        for at, name in enumerate(names):
            if split_name(name)[0] not in (*TARGETS, *sim.models):
                raise ConfigError(f"{where}: unknown target '{name}'; {told_targets(sim.models)}")
            if name in names[:at]:
                kind = split_name(name)[0]
                free = next(f"{kind}{number}" for number in itertools.count(2) if f"{kind}{number}" not in names)
                raise ConfigError(f"{where}: '{name}' is named twice; a further one has a number, as '{free}'")


def _check_frame_time(where: str, camera: SimCamera) -> None:
    """Refuse an exposure that does not end before the next begins."""
    if camera.rate_hz > 0 and camera.exposure_s * camera.rate_hz > 1:
        raise ConfigError(
            f"{where}.exposure_s: {camera.exposure_s:g} s is longer than the {1 / camera.rate_hz:g} s from one frame "
            f"to the next, of which {camera.rate_hz:g} come a second"
        )


def _check_center(where: str, camera: SimCamera) -> None:
    """Refuse a principal point outside of the picture, as one that was meant for a larger picture."""
    (u, v), (width, height) = camera.center_px, camera.size
    if min(camera.size) > 0 and not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
        raise ConfigError(
            f"{where}.center_px: ({u:g}, {v:g}) is not in the {width}x{height} image; give one near its middle, or none"
        )


def _sees_nothing(lens: Intrinsics) -> bool:
    """Whether part of the image has no ray."""
    w, h = lens.size
    rim = np.array([(u, v) for u in np.linspace(-1, w, 9) for v in np.linspace(-1, h, 9)])
    return not np.isfinite(lens.ray(rim)).all()


def _check_lens(where: str, camera: SimCamera) -> None:
    """Refuse a lens through which part of the image sees nothing."""
    if min(*camera.size, *camera.focal_px) <= 0:
        return  # said elsewhere
    if _sees_nothing(Intrinsics(camera.size, camera.focal_px, camera.center_px, camera.distortion)):
        raise ConfigError(
            f"{where}.distortion: {list(camera.distortion)} folds back inside the image, so that parts of it see "
            "nothing; give a weaker distortion, a longer focal_px or a smaller size"
        )


def _check_optics(zoom: SimZoomCamera) -> None:
    """Refuse a zoom lens whose curves no real lens follows."""
    shortest_mm, longest_mm = zoom.focal_mm
    before = 0.0
    for magnification in np.geomspace(1.0, longest_mm / shortest_mm, CHECKED_FOCALS).tolist():
        optics, at = zoom.optics_at(magnification), f"at {magnification:.3g} times the shortest focal length"
        focal = optics.focal_px[0]
        if not before < focal < math.inf:
            raise ConfigError(f"sim.zoom.focal_curve: the true focal length does not grow with the nominal one {at}")
        before = focal
        drift = np.abs(np.subtract(optics.center_px, zoom.center_px))
        if not (drift < zoom.size).all():
            raise ConfigError(f"sim.zoom.center_drift_px: moves the centre by the whole image or more {at}")
        if not abs(optics.pupil) < FARTHEST_PUPIL:
            raise ConfigError(f"sim.zoom.pupil: {optics.pupil:g} m {at} is {FARTHEST_PUPIL:g} m or more; give metres")
        lens = Intrinsics(zoom.size, optics.focal_px, optics.center_px, optics.distortion)
        if not np.isfinite(optics.distortion).all() or _sees_nothing(lens):
            raise ConfigError(
                f"sim.zoom.distortion_drift: the distortion folds back inside the image {at}, so that parts of it see "
                "nothing; give smaller coefficients"
            )
