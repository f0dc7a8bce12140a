"""What the [sim] tables of rig.toml must not say: values of the right type that make no sense."""

import itertools
import math

import numpy as np

from cotarget.camera import Intrinsics
from cotarget.errors import ConfigError
from cotarget.simconfig import SimCamera, SimConfig, SimZoomCamera

# The curves of the zoom lens are checked at this many focal lengths.
CHECKED_FOCALS = 33
# Farther than any lens is long: an entrance pupil that moves so far was given in millimetres [m].
FARTHEST_PUPIL = 1.0


def check_sim(sim: SimConfig) -> None:
    """Refuse a simulated world that cannot be.

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
        _check_lens(f"sim.{name}", camera)
    for where, values in positive.items():
        if min(values) <= 0:
            raise ConfigError(f"{where}: {min(values):g} is not greater than zero")
    for where, values in not_negative.items():
        if min(values) < 0:
            raise ConfigError(f"{where}: {min(values):g} is negative")
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
    if sim.effects.optics:
        _check_optics(sim.zoom)
    if sim.zoom.lens_steps < 2:
        raise ConfigError(f"sim.zoom.lens_steps: {sim.zoom.lens_steps} is fewer than 2")
    for name, waypoints in sim.paths.items():
        if len(waypoints) < 2 or any(b[0] <= a[0] for a, b in itertools.pairwise(waypoints)):
            raise ConfigError(f"sim.paths.{name}: needs two or more waypoints [t, x, y, z] with increasing t")


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
