"""Refuse simulated worlds that cannot be; MuJoCo is not needed for that."""

import itertools
import math

import numpy as np

from cotarget.camera import Intrinsics
from cotarget.config import SimCamera, SimConfig, SimZoomCamera, known_targets, split_name
from cotarget.errors import ConfigError, choices
from cotarget.sim.targets import KINDS
from cotarget.sim.zoom_lens import optics_at

# Number of focal lengths at which the zoom lens's curves are checked.
CHECKED_FOCALS = 33
# Largest movement of an entrance pupil, longer than any lens; beyond it millimetres were given [m].
FARTHEST_PUPIL = 1.0
# Largest distances between the cameras, and of the zoom camera from the head's axes [m]. In millimetres, those of usual
# rigs are beyond them.
LARGEST_M = {"T_zoom0_fixed": 100.0, "T_head_zoom": 10.0}
# Largest ratio of the true to the nominal focal length, or the inverse: more than any lens's tolerance.
FARTHEST_NOMINAL = 1.25
MODEL_SUFFIXES = (".obj", ".stl", ".xml")  # files of a user's own target models


def check_sim(sim: SimConfig) -> None:
    """Refuse an impossible simulated world.

    Raises:
        ConfigError: a value is refused; the message names the key.
    """
    for name, camera in (("fixed", sim.fixed), ("zoom", sim.zoom)):
        _check_camera(f"sim.{name}", camera)
    _check_lengths(sim)
    if sim.effects.optics:
        _check_optics(sim.zoom)
    for name, waypoints in sim.paths.items():
        if len(waypoints) < 2 or any(b[0] <= a[0] for a, b in itertools.pairwise(waypoints)):
            raise ConfigError(f"sim.paths.{name}: needs two or more waypoints [t, x, y, z] with increasing t")
    _check_models(sim)
    _check_targets(sim)


def _check_lengths(sim: SimConfig) -> None:
    """Refuse poses in millimetres, and a true focal length that is not about the nominal one."""
    for key, largest in LARGEST_M.items():
        length = math.hypot(*getattr(sim, key).translation)
        if length > largest:
            raise ConfigError(f"sim.{key}.translation: {length:g} m is too large; is {length / 1000:g} m meant?")
    true_px, nominal_px = sim.zoom.focal_px[0], sim.zoom.focal_mm[0] / sim.zoom.pitch_mm
    if max(true_px / nominal_px, nominal_px / true_px) > FARTHEST_NOMINAL:
        raise ConfigError(
            f"sim.zoom.focal_px: {true_px:g} px contradict the nominal {nominal_px:.4g} px, sim.zoom.focal_mm / "
            f"pitch_mm; leave one of the three keys out, or give pitch_mm = {sim.zoom.focal_mm[0] / true_px:.4g}"
        )


def _check_models(sim: SimConfig) -> None:
    """Refuse models with the name of a built-in target, with a number, or with an unknown suffix."""
    for name, path in sim.models.items():
        if name in KINDS:
            raise ConfigError(f"sim.models.{name}: the simulation has a {name} of its own; give yours another name")
        if split_name(name)[1] > 1:
            raise ConfigError(f"sim.models.{name}: a model is of a kind; give its name without the number")
        if path.suffix not in MODEL_SUFFIXES:
            raise ConfigError(f"sim.models.{name}: {path} is not one of: {choices(MODEL_SUFFIXES)}")


def _check_targets(sim: SimConfig) -> None:
    """Refuse targets without a model or a path, and two targets of one name."""
    for where, names in (("sim.targets", sim.targets), ("sim.paths", tuple(sim.paths))):
        for at, name in enumerate(names):
            kind, _ = split_name(name)
            if kind not in (*KINDS, *sim.models):
                raise ConfigError(f"{where}: unknown target '{name}'; {known_targets(sim.models)}")
            if name in names[:at]:
                free = next(f"{kind}{number}" for number in itertools.count(2) if f"{kind}{number}" not in names)
                raise ConfigError(f"{where}: '{name}' is named twice; a further one has a number, as '{free}'")
            if kind in sim.models and name not in sim.paths:
                raise ConfigError(
                    f"{where}: a {name} of your own needs a path: [sim.paths] {name} = [[t, x, y, z], ...]"
                )


def _check_camera(where: str, camera: SimCamera) -> None:
    """Refuse a principal point outside the image, a too long exposure, and a distortion that leaves no rays."""
    (u, v), (width, height) = camera.center_px, camera.size
    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
        raise ConfigError(
            f"{where}.center_px: ({u:g}, {v:g}) is not in the {width}x{height} image; give one near its middle, or none"
        )
    if camera.exposure_s * camera.rate_hz > 1:
        raise ConfigError(
            f"{where}.exposure_s: {camera.exposure_s:g} s is longer than the {1 / camera.rate_hz:g} s from one frame "
            f"to the next, of which {camera.rate_hz:g} come a second"
        )
    if _sees_nothing(Intrinsics(camera.size, camera.focal_px, camera.center_px, camera.distortion)):
        raise ConfigError(
            f"{where}.distortion: {list(camera.distortion)} folds back inside the image, so that parts of it see "
            "nothing; give a weaker distortion, a longer focal_px or a smaller size"
        )


def _sees_nothing(lens: Intrinsics) -> bool:
    """Whether a part of the image has no ray."""
    w, h = lens.size
    rim = np.array([(u, v) for u in np.linspace(-1, w, 9) for v in np.linspace(-1, h, 9)])
    return not np.isfinite(lens.ray(rim)).all()


def _check_optics(zoom: SimZoomCamera) -> None:
    """Refuse zoom curves that no real lens follows."""
    shortest_mm, longest_mm = zoom.focal_mm
    before = 0.0
    for magnification in np.geomspace(1.0, longest_mm / shortest_mm, CHECKED_FOCALS).tolist():
        optics, at = optics_at(zoom, magnification), f"at {magnification:.3g} times the shortest focal length"
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
