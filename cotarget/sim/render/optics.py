"""True optics of the simulated lenses: Brown-Conrady distortion, and the maps that resample a pinhole render with it.

Written independently of `cotarget.camera`, so that the simulation and the fit share no mistake.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from cotarget.geometry import Array
from cotarget.rig import Image

# A render is this much finer than the lens's image in its centre. Bilinear interpolation moves an edge by up to 0.03
# px, depending on its phase between two pixels of the render. With equal fineness that phase is the same all around the
# axis, and a fit takes it for distortion. With 1.03, all phases occur within 33 px. Measurements: docs/design-notes.md.
FINENESS = 1.03
# Margin on each side of a render, relative to its width: what half an exposure brings into view while a camera turns.
TURN_MARGIN = 0.025
# The map is computed at every fourth pixel and interpolated: a distortion of k1 = -0.2 curves by less than
# 6 |k1| r / f a pixel, so that this costs at most 0.005 px, and 0.02 px in the outermost pixels of the corners.
MAP_STRIDE = 4
REAL_ROOT = 1e-9  # largest imaginary part over absolute value of a root that is real up to rounding
KEPT_MAPS = 8  # of the lens positions in use: the fixed camera's and the zoom camera's latest
KEPT_FIELDS = 128  # fields of view are a few numbers each; a rig that is rebuilt often asks for all its focal lengths
UNDISTORT_ROUNDS = 60  # Newton's steps at most; five are usual
UNDISTORTED = 1e-14  # step of the normalised coordinates at convergence


@dataclass(frozen=True)
class TrueLens:
    """True optics of a simulated camera.

    Attributes:
        size: (width, height) [px].
        focal_px: (fx, fy) [px].
        center_px: principal point [px].
        distortion: (k1, k2, p1, p2, k3).
        pupil: position of the optical centre (entrance pupil) along z of the camera's body [m].
    """

    size: tuple[int, int]
    focal_px: tuple[float, float]
    center_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float]
    pupil: float = 0.0

    def project(self, x_camera: Array) -> Array:
        """Project points (..., 3) in the camera's frame to pixels (..., 2), not clipped to the image.

        Pixels are nan behind the camera, and beyond the angle at which the distortion folds back.
        """
        depth = np.where(x_camera[..., 2:] > 0, x_camera[..., 2:], np.nan)
        xy = x_camera[..., :2] / depth
        seen = np.hypot(xy[..., 0], xy[..., 1]) < fold(self.distortion)
        return np.where(seen[..., None], self.bend(xy) * self.focal_px + self.center_px, np.nan)

    def directions(self, pixels: Array) -> Array:
        """Undistort pixels (..., 2) to image-plane coordinates (x / z, y / z), (..., 2), by Newton's method."""
        bent = (pixels - self.center_px) / self.focal_px
        k1, k2, p1, p2, k3 = self.distortion
        xy = bent
        for _ in range(UNDISTORT_ROUNDS):
            x, y = xy[..., 0], xy[..., 1]
            r2 = x**2 + y**2
            gain, rise = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3, k1 + 2 * k2 * r2 + 3 * k3 * r2**2
            across = gain + 2 * x**2 * rise + 2 * p1 * y + 6 * p2 * x
            down = gain + 2 * y**2 * rise + 6 * p1 * y + 2 * p2 * x
            mixed = 2 * x * y * rise + 2 * p1 * x + 2 * p2 * y
            off = bent - self.bend(xy)
            u, v = off[..., 0], off[..., 1]
            step = (
                np.stack([down * u - mixed * v, across * v - mixed * u], axis=-1)
                / (across * down - mixed**2)[..., None]
            )
            xy = xy + step
            if np.abs(step).max() < UNDISTORTED:
                break
        return xy

    def bend(self, xy: Array) -> Array:
        """Distort image-plane coordinates (x / z, y / z), (..., 2)."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = xy[..., 0], xy[..., 1]
        r2 = x**2 + y**2
        gain = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        return np.stack(
            [x * gain + 2 * p1 * x * y + p2 * (3 * x**2 + y**2), y * gain + p1 * (x**2 + 3 * y**2) + 2 * p2 * x * y],
            axis=-1,
        )


@lru_cache(maxsize=KEPT_MAPS)
def fold(distortion: tuple[float, float, float, float, float]) -> float:
    """Give the tangent of the off-axis angle at which radial distortion folds back; infinite if it never does."""
    k1, k2, _, _, k3 = distortion
    if k2 == k3 == 0.0:
        return float((-3 * k1) ** -0.5) if k1 < 0 else np.inf
    # Zeros of the slope of r (1 + k1 r^2 + k2 r^4 + k3 r^6), in r^2.
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    turns = roots.real[(np.abs(roots.imag) < REAL_ROOT * np.abs(roots)) & (roots.real > 0)]
    return float(np.sqrt(turns.min())) if len(turns) else np.inf


@lru_cache(maxsize=KEPT_FIELDS)
def covering_half_field(lens: TrueLens) -> tuple[float, float]:
    """Give tangents of the half field (horizontal, vertical) of a centred pinhole view that covers the image."""
    w, h = lens.size
    u, v = np.linspace(-1, w, 41), np.linspace(-1, h, 31)
    # A lens that does not fold has its largest angles at the image's border.
    sides = [np.column_stack([u, np.full_like(u, y)]) for y in (-1, h)]
    sides += [np.column_stack([np.full_like(v, x), v]) for x in (-1, w)]
    reach = np.abs(lens.directions(np.concatenate(sides))).max(axis=0)
    return float(reach[0]), float(reach[1])


def covering_size(lenses: Sequence[TrueLens], least: tuple[int, int]) -> tuple[int, int]:
    """Give a size (width, height) [px] for the covering views of all these lenses, with a margin to turn."""
    bent = [_fine_size(lens) for lens in lenses if any(lens.distortion)]
    width, height = np.max([(least[0] + 3, least[1] + 3), *bent], axis=0).tolist()
    margin = math.ceil(TURN_MARGIN * width)
    return width + 2 * margin, height + 2 * margin


def _fine_size(lens: TrueLens) -> tuple[int, int]:
    """Give (width, height) [px] of a render that covers a lens's image, `FINENESS` times as fine in its centre."""
    half = covering_half_field(lens)
    width, height = (math.ceil(2 * half[i] * FINENESS * lens.focal_px[i] + 2) for i in range(2))
    return width, height


@dataclass(frozen=True)
class Pinhole:
    """View without distortion: size (width, height), focal length and principal point [px]."""

    size: tuple[int, int]
    focal_px: tuple[float, float]
    center_px: tuple[float, float]


def covering_view(lens: TrueLens, largest: tuple[int, int]) -> Pinhole:
    """Give the view that a distorting lens's image is resampled from, `FINENESS` times as fine if size allows."""
    half = covering_half_field(lens)
    width, height = np.minimum(_fine_size(lens), largest).tolist()
    focal = min((width / 2 - 1) / half[0], (height / 2 - 1) / half[1])
    return Pinhole((width, height), (focal, focal), ((width - 1) / 2, (height - 1) / 2))


def bend(render: Image, view: Pinhole, lens: TrueLens, homography: Array | None = None) -> Image:
    """Resample a render into the lens's image.

    Args:
        render: image of the view, or of another that ``homography`` leads to; four channels are by far the fastest.
        view: pinhole view that covers everything in the lens's image.
        lens: lens whose image is made.
        homography: maps the view's pixels to the render's, (3, 3); the identity by default.
    """
    if homography is None and view == Pinhole(lens.size, lens.focal_px, lens.center_px):
        return render
    w, h = lens.size
    coarse = _map(lens, view) if homography is None else cv2.perspectiveTransform(_map(lens, view), homography)
    places = cv2.resize(coarse, None, fx=MAP_STRIDE, fy=MAP_STRIDE, interpolation=cv2.INTER_LINEAR)
    places = places[MAP_STRIDE : MAP_STRIDE + h, MAP_STRIDE : MAP_STRIDE + w]
    return np.asarray(cv2.remap(render, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)


@lru_cache(maxsize=KEPT_MAPS)
def _map(lens: TrueLens, view: Pinhole) -> Array:
    """Give the view's pixel of the middle of each square of `MAP_STRIDE` image pixels, from one before the image on.

    Those beyond the image are extrapolated, because a lens may fold back there.
    """
    u, v = (np.arange((MAP_STRIDE - 1) / 2, n, MAP_STRIDE) for n in lens.size)
    inner = lens.directions(np.stack(np.meshgrid(u, v), axis=-1)) * view.focal_px + view.center_px
    return np.pad(inner, ((1, 2), (1, 2), (0, 0)), "reflect", reflect_type="odd").astype(np.float32)
