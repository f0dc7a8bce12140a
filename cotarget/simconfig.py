"""The [sim] tables of rig.toml as frozen dataclasses: the simulated world, its cameras, head and effects.

Values keep the units of the file: metres and degrees, millimetres where a name says so. Defaults are the rig that the
project's figures are stated for.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any

from cotarget.errors import ConfigError, choices
from cotarget.geometry import RigidTransform, pose

# What the numbers of a list are, for who gives something else.
Pair = tuple[float, float]
Limits = Annotated[Pair, "[lowest, highest]"]
Size = Annotated[tuple[int, int], "[width, height]"]
Focal = Annotated[Pair, "[fx, fy]"]
Center = Annotated[Pair, "[u, v]"]
Distortion = Annotated[tuple[float, float, float, float, float], "[k1, k2, p1, p2, k3]"]
Waypoint = Annotated[tuple[float, float, float, float], "[t, x, y, z]"]
# Coefficients of s, s^2, s^3 ...: a curve that is 0 at the shortest focal length.
Curve = Annotated[tuple[float, ...], "[of s, of s^2, ...]"]

TARGETS = ("book", "person", "bird")  # that the simulation has models of


@dataclass(frozen=True)
class SimCamera:
    """The simulated fixed camera: true intrinsics, sensor and link.

    Attributes:
        size: (width, height) [px].
        focal_px: true (fx, fy) [px]; where a file gives another size and not this, the field of view stays as wide.
        center_px: true principal point [px]; likewise it stays where it is beside the image's middle.
        distortion: true (k1, k2, p1, p2, k3).
        noise: standard deviation of the sensor's noise [grey levels].
        rate_hz: frames a second.
        latency_s: from light to frame [s].
        exposure_s: how long light is gathered [s]; what moves meanwhile is blurred, and rendering takes twice as
            long while the camera turns. 0 for an instant.
        jpeg_quality: 1 to 100.
    """

    size: Size = (640, 480)
    focal_px: Focal = (686.0, 684.0)
    center_px: Center = (325.0, 239.0)
    distortion: Distortion = (-0.2, 0.0, 0.0, 0.0, 0.0)
    noise: float = 2.0
    rate_hz: float = 25.0
    latency_s: float = 0.06
    exposure_s: float = 0.0
    jpeg_quality: int = 90

    def fitted(self, size: Size, focal_px: Focal | None) -> dict[str, Any]:
        """What else is other in pixels in an image of another size [px], with a focal length, or of the same view."""
        by = self._gain(size, focal_px)
        return {
            "focal_px": tuple(by * focal for focal in self.focal_px),
            "center_px": tuple(
                (new - 1) / 2 + by * (at - (old - 1) / 2)
                for at, old, new in zip(self.center_px, self.size, size, strict=True)
            ),
        }

    def _gain(self, size: Size, focal_px: Focal | None) -> float:
        """How many times as many pixels there are to an angle; more or fewer at its sides change nothing of that."""
        return size[0] / self.size[0] if focal_px is None else focal_px[0] / self.focal_px[0]


@dataclass(frozen=True)
class ZoomOptics:
    """What a zoom lens does at one focal length; ``pupil`` is how far forward its entrance pupil has moved [m]."""

    focal_px: Focal
    center_px: Center
    distortion: Distortion
    pupil: float


@dataclass(frozen=True)
class SimZoomCamera(SimCamera):
    """The simulated zoom camera; ``focal_px``, ``center_px`` and ``distortion`` hold at the shortest focal length.

    The curves are what the effect "optics" adds, over s = ln(nominal / shortest) / ln(longest / shortest) in 0..1.
    Their defaults are of the size of a 12x consumer zoom's, and bent as no cubic is.

    Attributes:
        focal_mm: shortest and longest focal length as the maker states them [mm].
        pitch_mm: size of a pixel as the maker states it [mm]; focal_mm / pitch_mm is what the device tells.
        lens_steps: number of positions from shortest to longest, evenly spaced in the logarithm.
        lens_speed: positions a second.
        focal_curve: true over nominal focal length is 1 + this times what it is at the shortest.
        center_drift_px: what the principal point's u and v have moved by [px].
        distortion_drift: what is added to k1 as it is measured in the image, in tangents at the shortest focal length.
        pupil: how far the entrance pupil has moved along the axis [m]; forward is positive.
    """

    focal_px: Focal = (692.0, 693.0)
    center_px: Center = (326.0, 235.0)
    distortion: Distortion = (-0.1, 0.0, 0.0, 0.0, 0.0)
    focal_mm: Limits = (6.0, 72.0)
    pitch_mm: float = 0.009
    lens_steps: int = 129
    lens_speed: float = 129.0
    focal_curve: Curve = (0.13, 0.14, -1.76, 2.39, -0.91)
    center_drift_px: tuple[Curve, Curve] = ((27.0, 85.0, -322.0, 268.0, -62.0), (-7.0, -4.0, -92.0, 195.0, -102.0))
    distortion_drift: Curve = (0.4, 0.04, -0.88, 0.62, -0.05)
    pupil: Curve = (0.03, 0.06, -0.9, 1.17, -0.44)

    def fitted(self, size: Size, focal_px: Focal | None) -> dict[str, Any]:
        """The same of a zoom camera: more pixels to an angle are smaller ones, as what it tells and does agree."""
        by = self._gain(size, focal_px)
        return {
            **super().fitted(size, focal_px),
            "pitch_mm": self.pitch_mm / by,
            "center_drift_px": tuple(tuple(by * c for c in curve) for curve in self.center_drift_px),
        }

    def optics_at(self, magnification: float) -> ZoomOptics:
        """What the lens does at a nominal focal length, given as a multiple of the shortest."""
        s = math.log(magnification) / math.log(self.focal_mm[1] / self.focal_mm[0])
        gain = magnification * (1 + _along(self.focal_curve, s))
        (fx, fy), (cx, cy), (k1, k2, p1, p2, k3) = self.focal_px, self.center_px, self.distortion
        du, dv = (_along(curve, s) for curve in self.center_drift_px)
        # A pixel's tangent shrinks as the focal length grows; coefficients that grow with its powers keep the image's
        # distortion.
        squared = gain * gain
        k1 = (k1 + _along(self.distortion_drift, s)) * squared
        return ZoomOptics(
            focal_px=(fx * gain, fy * gain),
            center_px=(cx + du, cy + dv),
            distortion=(k1, k2 * squared * squared, p1 * gain, p2 * gain, k3 * squared * squared * squared),
            pupil=_along(self.pupil, s),
        )


def _along(curve: Curve, s: float) -> float:
    """A curve's value, by Horner's rule."""
    value = 0.0
    for coefficient in reversed(curve):
        value = (value + coefficient) * s
    return value


@dataclass(frozen=True)
class SimHead:
    """The simulated pan-tilt unit; defaults are a stock PTU-D46-17.5 with the geometry of a real, imperfect one.

    Attributes:
        step_deg: resolution [degrees].
        pan_deg: lowest and highest pan [degrees].
        tilt_deg: lowest and highest tilt [degrees].
        speed_deg_s: highest speed [degrees/s].
        accel_deg_s2: acceleration [degrees/s^2].
        command_delay_s: from command to motion [s].
        axis_offset_mm: distance between the axes along the pan frame's z, dz [mm].
        squareness_deg: departure of the axes from a right angle, eps [degrees].
        backlash_deg: play of each axis [degrees].
    """

    step_deg: float = 0.0514286
    pan_deg: Limits = (-158.9, 158.9)
    tilt_deg: Limits = (-46.6, 31.1)
    speed_deg_s: float = 149.0
    accel_deg_s2: float = 206.0
    command_delay_s: float = 0.04
    axis_offset_mm: float = 5.0
    squareness_deg: float = 0.1
    backlash_deg: float = 0.0


@dataclass(frozen=True)
class SimEffects:
    """One switch for each way in which the simulation departs from the textbook; ``all = false`` clears them.

    Attributes:
        noise: sensor noise.
        jpeg: compression.
        distortion: lens distortion of both cameras.
        latency: light to frame.
        blur: motion during the exposure.
        command_delay: command to motion.
        profile: finite speed and acceleration of the head.
        steps: the head's resolution.
        axes: axis offset and non-squareness.
        backlash: play.
        lens: positions and travel time of the zoom lens.
        optics: what the zoom lens's optics do besides magnifying: focal curve, centre, distortion and pupil that move
            with focal length. Without it the coefficients of the distortion stay what they are, so that the image's
            distortion vanishes as the field narrows.
        scatter: true sizes differ from what the pipeline is told.
        shadows: cast shadows (costs two to four times the rendering).
        multisampling: antialiasing with 4 samples.
        clutter: outdoors foliage sways, clouds drift, shadows cross the ground and the light changes. Off by default:
            the figures of calibration and of the demo are for a world at rest.
    """

    noise: bool = True
    jpeg: bool = True
    distortion: bool = True
    latency: bool = True
    blur: bool = True
    command_delay: bool = True
    profile: bool = True
    steps: bool = True
    axes: bool = True
    backlash: bool = True
    lens: bool = True
    optics: bool = True
    scatter: bool = True
    shadows: bool = False
    multisampling: bool = True
    clutter: bool = False


# Offsets of the kind the paper's rig had: 0.4 m beside each other, a few degrees apart, the camera bolted to the
# unit with a lever of some ten centimetres.
DEFAULT_GAMMA = pose([-0.40, 0.03, 0.06], [0.8, -1.9, 0.6])
DEFAULT_T = pose([0.02, -0.08, 0.05], [0.7, -1.4, 0.5])


@dataclass(frozen=True)
class SimConfig:
    """The simulated world.

    Attributes:
        scene: a scene of sim_assets, or a path to an MJCF file.
        seed: of everything random.
        targets: which targets are in the scene.
        T_zoom0_fixed: the true Gamma.
        T_head_zoom: the true T, at the zoom lens's shortest focal length like Gamma.
        fixed: the wide camera.
        zoom: the zoom camera.
        head: the pan-tilt unit.
        effects: switches.
        models: for targets of one's own, by name: a mesh in metres (.obj, .stl), x forward and z up, or an MJCF file
            with one body; a relative path is relative to rig.toml.
        paths: for a target of that name, waypoints [t, x, y, z] (seconds, metres in the world) of a smooth path
            that replaces the built-in one.
    """

    scene: str = "outdoor"
    seed: int = 0
    targets: tuple[str, ...] = ()
    T_zoom0_fixed: RigidTransform = DEFAULT_GAMMA
    T_head_zoom: RigidTransform = DEFAULT_T
    fixed: SimCamera = SimCamera()
    zoom: SimZoomCamera = SimZoomCamera()
    head: SimHead = SimHead()
    effects: SimEffects = SimEffects()
    models: Mapping[str, Path] = field(default_factory=dict)
    paths: Mapping[str, tuple[Waypoint, ...]] = field(default_factory=dict)


# No effect of a real rig but the quality of the rendering, which `all` leaves alone.
QUALITY = ("multisampling", "shadows")
ALL = "all"


def expand_all(effects: Mapping[str, Any]) -> dict[str, Any]:
    """Let ``all`` set every switch of [sim.effects] that is not named.

    Raises:
        ConfigError: it is neither true nor false, or a key is neither a switch nor ``all``.
    """
    switches = {f.name for f in fields(SimEffects)}
    if unknown := sorted(set(effects) - switches - {ALL}):
        raise ConfigError(f"unknown key 'sim.effects.{unknown[0]}'; valid here: {choices({*switches, ALL})}")
    named = dict(effects)
    every = named.pop(ALL, None)
    if every is None:
        return named
    if not isinstance(every, bool):
        raise ConfigError(f"sim.effects.all: {every!r} is not true or false")
    return {f.name: every for f in fields(SimEffects) if f.name not in QUALITY} | named


def fit_sizes(sim: SimConfig, given: Mapping[str, Any]) -> SimConfig:
    """Let a view stay what it is where another image size was given, and go with the focal length where that was.

    Args:
        sim: as it was read.
        given: the [sim] table that it was read from; what a camera's table says stays as it is said.
    """
    cameras: dict[str, SimCamera] = {}
    for name, camera in (("fixed", sim.fixed), ("zoom", sim.zoom)):
        if min(*camera.size, *camera.focal_px) <= 0:
            continue  # refused elsewhere
        said = given.get(name, {})
        # Nothing changes where size and focal length are the default's.
        follows = type(camera)().fitted(camera.size, camera.focal_px if "focal_px" in said else None)
        cameras[name] = replace(camera, **{key: value for key, value in follows.items() if key not in said})
    return replace(sim, **cameras)  # type: ignore[arg-type]


def split_name(name: str) -> tuple[str, int]:
    """A target's kind and its number among its kind: ("bird", 1) of ``bird``, ("bird", 2) of ``bird2``."""
    number = re.search(r"(?<=\D)([2-9]|[1-9]\d+)\Z", name)
    return (name, 1) if number is None else (name[: number.start()], int(number[0]))
