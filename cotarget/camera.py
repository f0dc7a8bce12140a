"""Camera models: intrinsics with distortion, depth from a known size, and the zoom lens over its range.

Pixels are (u, v), u right and v down, and (0, 0) is the centre of the top-left pixel. Focal lengths are in pixels.
"""

import bisect
import itertools
import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Literal

import numpy as np
from scipy.interpolate import CubicSpline

from cotarget.errors import ConfigError
from cotarget.geometry import Array

# Newton's method for the inverse distortion converges quadratically: 20 steps are ample wherever an inverse exists.
UNDISTORT_STEPS = 20
# A ray is accepted when it projects back to the pixel within this normalised distance (about 1e-9 px).
UNDISTORT_TOLERANCE = 1e-12


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of a camera: pinhole with Brown-Conrady distortion (OpenCV's first five coefficients).

    Attributes:
        size: image size (width, height) [px].
        focal_px: (fx, fy) [px].
        center_px: principal point (cx, cy) [px].
        distortion: (k1, k2, p1, p2, k3), without unit.
    """

    size: tuple[int, int]
    focal_px: tuple[float, float]
    center_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def matrix(self) -> Array:
        """Camera matrix K, (3, 3)."""
        (fx, fy), (cx, cy) = self.focal_px, self.center_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def image_center_px(self) -> Array:
        """Centre of the image [px], (2,): the default wanted pixel of a target."""
        return (np.array(self.size, dtype=float) - 1.0) / 2.0

    def project(self, x_camera: Array) -> Array:
        """Project points of the camera's frame [m], (..., 3), into the image.

        Returns:
            Pixels (..., 2); nan for points behind the camera, and for points beyond the radius where the distortion
            polynomial folds back.
        """
        x_camera = np.asarray(x_camera, dtype=float)
        depth = x_camera[..., 2]
        with np.errstate(all="ignore"):
            xy = x_camera[..., :2] / depth[..., None]
            J = self._distort_jacobian(xy)
            unfolded = np.greater(J[..., 0, 0] * J[..., 1, 1], J[..., 0, 1] * J[..., 1, 0])
            valid = np.logical_and.reduce([depth > 0, unfolded, self._before_fold(xy)])
            pixels = self._distort(xy) * np.array(self.focal_px) + np.array(self.center_px)
        return np.where(valid[..., None], pixels, np.nan)

    def ray(self, pixel: Array) -> Array:
        """Compute the rays through pixels (..., 2), scaled to z = 1, so that depth times ray is the point.

        The distortion is inverted by Newton's method.

        Returns:
            Rays in the camera's frame, (..., 3); nan where no ray projects to that pixel.
        """
        pixel = np.asarray(pixel, dtype=float)
        if pixel.ndim == 1:
            found = self.tangents(pixel)
            return np.full(3, np.nan) if found is None else np.array([*found[0], 1.0])
        distorted = (pixel - np.array(self.center_px)) / np.array(self.focal_px)
        xy = distorted.copy()
        with np.errstate(all="ignore"):
            for _ in range(UNDISTORT_STEPS):
                error = self._distort(xy) - distorted
                J = self._distort_jacobian(xy)
                det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
                step_x = (J[..., 1, 1] * error[..., 0] - J[..., 0, 1] * error[..., 1]) / det
                step_y = (J[..., 0, 0] * error[..., 1] - J[..., 1, 0] * error[..., 0]) / det
                xy = xy - np.stack([step_x, step_y], axis=-1)
                if not np.any(np.abs(error) > np.finfo(float).eps):
                    break
            off = np.linalg.norm(self._distort(xy) - distorted, axis=-1)
            ok = (off <= UNDISTORT_TOLERANCE * (1 + np.linalg.norm(distorted, axis=-1))) & self._before_fold(xy)
        ray = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        return np.where(ok[..., None], ray, np.nan)

    def tangents(self, pixel: Array) -> tuple[Array, Array] | None:
        """Undistort one pixel (u, v), (2,), and differentiate the result.

        Written in floats, which takes less than a tenth of the time that `ray` takes with arrays.

        Returns:
            Tangents (x / z, y / z), (2,), and their derivative by the pixel [1/px], (2, 2); None where no ray projects
            to that pixel.
        """
        (fx, fy), (cx, cy) = self.focal_px, self.center_px
        k1, k2, p1, p2, k3 = self.distortion
        goal_x, goal_y = (float(pixel[0]) - cx) / fx, (float(pixel[1]) - cy) / fy
        x, y, best = goal_x, goal_y, math.inf
        for _ in range(UNDISTORT_STEPS):
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
            off_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - goal_x
            off_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - goal_y
            xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
            xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
            yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
            det = xx * yy - xy * xy
            off = math.hypot(off_x, off_y)
            if off <= UNDISTORT_TOLERANCE * (1 + math.hypot(goal_x, goal_y)) and off >= best / 2:  # only rounding left
                if not (det > 0 and self._before_fold(np.array([x, y]))):
                    return None
                return np.array([x, y]), np.array([[yy / fx, -xy / fy], [-xy / fx, xx / fy]]) / det
            if not (det != 0 and math.isfinite(off)):
                return None
            best = min(best, off)
            x -= (yy * off_x - xy * off_y) / det
            y -= (xx * off_y - xy * off_x) / det
        return None

    def scaled(self, focal_factor: float) -> "Intrinsics":
        """Return these intrinsics with the focal lengths multiplied by ``focal_factor``."""
        fx, fy = self.focal_px
        return replace(self, focal_px=(fx * focal_factor, fy * focal_factor))

    def resized(self, size: tuple[int, int]) -> "Intrinsics":
        """Return the intrinsics of the same camera for a stream scaled to another size (width, height) [px].

        Raises:
            ConfigError: the aspect ratio differs, so that the stream cannot be the whole image scaled.
        """
        if size == self.size:
            return self
        (w, h), (old_w, old_h) = size, self.size
        if w * old_h != h * old_w:
            raise ConfigError(
                f"the stream is {w}x{h} but was calibrated at {old_w}x{old_h}, which has another aspect ratio; "
                "set the stream to a size of the same aspect ratio, or calibrate again"
            )
        s = w / old_w
        (fx, fy), (cx, cy) = self.focal_px, self.center_px
        center = ((cx + 0.5) * s - 0.5, (cy + 0.5) * s - 0.5)  # pixel centres are whole, edges are half ones
        return replace(self, size=size, focal_px=(fx * s, fy * s), center_px=center)

    def _distort(self, xy: Array) -> Array:
        k1, k2, p1, p2, k3 = self.distortion
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=-1,
        )

    def _distort_jacobian(self, xy: Array) -> Array:
        """Compute the derivative of distorted by undistorted coordinates, (..., 2, 2)."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d(radial)/dx = slope * x
        xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
        xy_ = slope * x * y + 2 * p1 * x + 2 * p2 * y
        yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
        return np.stack([np.stack([xx, xy_], axis=-1), np.stack([xy_, yy], axis=-1)], axis=-2)

    def _before_fold(self, xy: Array) -> Array:
        """Check whether points lie inside the radius at which the radial polynomial stops growing."""
        k1, k2, _, _, k3 = self.distortion

        def growth(r2: Any) -> Any:
            """Compute the derivative of r (1 + k1 r^2 + k2 r^4 + k3 r^6) by r, given r^2."""
            return 1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3))

        r2 = xy[..., 0] * xy[..., 0] + xy[..., 1] * xy[..., 1]
        before = growth(r2) > 0
        for lowest in _roots(21 * k3, 10 * k2, 3 * k1):  # extrema: one that is not positive has the fold before it
            if lowest > 0 and growth(lowest) <= 0:
                before = before & (r2 < lowest)
        return np.asarray(before)


def _roots(a: float, b: float, c: float) -> list[float]:
    """Find the real roots of a x^2 + b x + c."""
    if a == 0:
        return [] if b == 0 else [-c / b]
    inside = b * b - 4 * a * c
    if inside < 0:
        return []
    q = -(b + math.copysign(math.sqrt(inside), b)) / 2  # avoids the difference of nearly equal numbers
    return [q / a] if q == 0 else [q / a, c / q]


def depth_from_size(intrinsics: Intrinsics, size: float, size_px: float, center_px: Array, *, vertical: bool) -> float:
    """Estimate a target's depth along the camera's axis [m] from its known size: z = f x_size / u_measured.

    The size is measured between the rays through the target's two ends, so that distortion does not change the depth.

    Args:
        intrinsics: intrinsics of the fixed camera.
        size: true size of the target [m].
        size_px: measured size in the image [px]; the depth is nan where it is not positive, or no ray reaches an end.
        center_px: centre of the target in the image (u, v) [px], (2,).
        vertical: True for a size along v (a height), False for one along u.
    """
    axis = 1 if vertical else 0
    half = np.zeros(2)
    half[axis] = size_px / 2
    ends = intrinsics.ray(np.stack([center_px - half, center_px + half]))
    across = ends[1, axis] - ends[0, axis]  # u_measured / f for a lens without distortion
    return float(size / across) if across > 0 else float("nan")


def focal_for_size(size: float, wanted_px: float, depth: float) -> float:
    """Compute the focal length [px] at which ``size`` [m] at ``depth`` [m] appears ``wanted_px`` large (Eq. 17)."""
    return wanted_px * depth / size


# Zoom lens

# Shift of a zoom lens's optical axis for every doubling of the focal length, as a share of the image's width. For
# consumer cameras it comes to some 10 to 30 px of 640 over a tenfold range.
WANDER = 5.0 / 640.0
FEW_STOPS = 4  # from this number of zoom samples on, two splines through them show how well they fix the curve
CENTER = slice(2, 4)  # columns of the principal point in `ZoomLens._values`
NOMINAL_STEPS = 20  # the ratio of true to nominal focal length changes slowly: four or five steps suffice


@dataclass(frozen=True)
class ZoomLens:
    """Optics of the zoom camera over its focal range, interpolated between calibrated zoom samples.

    The lens device reports a nominal focal length. A zoom sample holds the calibrated intrinsics at one of them.
    Between the samples a cubic spline over the logarithm of the nominal focal length interpolates the ratio of true to
    nominal focal length, the principal point, the distortion as it appears in the image, and the entrance pupil. Beyond
    them the last sample's values hold. With one sample only the focal length changes.

    Attributes:
        nominal_px: nominal focal length of each zoom sample [px], increasing, (n,).
        stops: calibrated intrinsics of each zoom sample, (n,).
        pupil: shift of the entrance pupil forward along the optical axis since the first zoom sample [m], (n,), the
            first one 0; empty for a pupil that does not move.
    """

    nominal_px: tuple[float, ...]
    stops: tuple[Intrinsics, ...]
    pupil: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.pupil:
            object.__setattr__(self, "pupil", (0.0,) * len(self.stops))
        if not self.stops or not len(self.stops) == len(self.nominal_px) == len(self.pupil):
            raise ConfigError("a zoom lens needs one nominal focal length and one pupil for each zoom sample")
        if self.pupil[0] != 0:
            raise ConfigError("a zoom lens's pupil is counted from the first stop, where it must be 0")
        if any(b <= a for a, b in itertools.pairwise(self.nominal_px)):
            raise ConfigError("the zoom samples' nominal focal lengths must increase")

    @property
    def size(self) -> tuple[int, int]:
        """Image size (width, height) [px]."""
        return self.stops[0].size

    def at(self, nominal_px: float) -> Intrinsics:
        """Interpolate the intrinsics at a nominal focal length [px]."""
        if len(self.stops) == 1:
            return self.stops[0].scaled(nominal_px / self.nominal_px[0])
        values = self._values(nominal_px)
        log_x, log_y, cx, cy = values[:4].tolist()
        k1, k2, p1, p2, k3 = (values[4:9] * distortion_growth(nominal_px / self.nominal_px[0])).tolist()
        return Intrinsics(
            size=self.size,
            focal_px=(math.exp(log_x) * nominal_px, math.exp(log_y) * nominal_px),
            center_px=(cx, cy),
            distortion=(k1, k2, p1, p2, k3),
        )

    def pupil_at(self, nominal_px: float) -> float:
        """Interpolate the entrance pupil's shift forward since the first zoom sample [m]."""
        return 0.0 if len(self.stops) == 1 else float(self._values(nominal_px)[-1])

    def center_doubt_px(self, nominal_px: float) -> Array:
        """Estimate the interpolation error of the principal point, one standard deviation [px], (2,).

        Between the samples, where there are at least `FEW_STOPS`, it is the difference of two interpolants: the spline
        in use, and the natural spline. Between fewer, and beyond the samples, it grows by `WANDER` with the distance.
        """
        away = np.abs(np.log2(nominal_px / np.array(self.nominal_px)))
        inside = self.nominal_px[0] <= nominal_px <= self.nominal_px[-1]
        if not inside:
            return np.full(2, WANDER * self.size[0] * float(away.min()))
        if len(self.stops) < FEW_STOPS:
            near, far = np.sort(away)[:2] if len(self.stops) > 1 else (0.0, 1.0)
            return np.full(2, WANDER * self.size[0] * float(near * far / (near + far)))
        centers = self._samples[:, CENTER]
        i, x = self._piece(nominal_px)
        a, b, c, d = (_spline_pieces(self.nominal_px, "natural")[i] - _spline_pieces(self.nominal_px)[i]) @ centers
        return np.abs(((a * x + b) * x + c) * x + d)

    def nominal_for(self, focal_px: float) -> float:
        """Convert a true horizontal focal length [px] to the nominal one that is sent to the lens."""
        if len(self.stops) == 1:
            return focal_px * self.nominal_px[0] / self.stops[0].focal_px[0]
        nominal, best = focal_px, math.inf
        for _ in range(NOMINAL_STEPS):  # Newton's method in the logarithm
            i, x = self._piece(nominal)
            a, b, c, d = self._ratios[i]
            off = ((a * x + b) * x + c) * x + d + math.log(nominal / focal_px)
            if abs(off) >= best:  # only rounding is left
                break
            inside = self.nominal_px[0] < nominal < self.nominal_px[-1]
            best, nominal = abs(off), nominal * math.exp(-off / (1 + ((3 * a * x + 2 * b) * x + c) * inside))
        return nominal

    def resized(self, size: tuple[int, int]) -> "ZoomLens":
        """Return the same lens for a stream scaled to another size; its nominal focal lengths scale with it."""
        factor = size[0] / self.size[0]
        nominal, stops = tuple(n * factor for n in self.nominal_px), tuple(s.resized(size) for s in self.stops)
        return ZoomLens(nominal, stops, self.pupil)

    def _values(self, nominal_px: float) -> Array:
        """Interpolate log ratios (2), principal point (2), image distortion (5) and pupil (1) at a focal length."""
        i, x = self._piece(nominal_px)
        a, b, c, d = self._pieces[i]
        return np.asarray(((a * x + b) * x + c) * x + d)

    def _piece(self, nominal_px: float) -> tuple[int, float]:
        """Find the spline's piece at a nominal focal length, and the logarithm of its ratio to the piece's start."""
        inside = min(max(nominal_px, self.nominal_px[0]), self.nominal_px[-1])
        i = max(bisect.bisect_left(self.nominal_px, inside) - 1, 0)
        return i, math.log(inside / self.nominal_px[i])

    @cached_property
    def _pieces(self) -> Array:
        """Polynomials of the spline, highest power first, (n - 1, 4, 10)."""
        return _spline_pieces(self.nominal_px) @ self._samples

    @cached_property
    def _ratios(self) -> list[list[float]]:
        """Polynomials of the logarithm of true over nominal horizontal focal length, (n - 1, 4)."""
        return self._pieces[:, :, 0].tolist()

    @cached_property
    def _samples(self) -> Array:
        """What the spline interpolates, at each zoom sample, (n, 10); see `_values`."""
        first = self.nominal_px[0]
        rows = [
            [
                *np.log(np.array(stop.focal_px) / n),
                *stop.center_px,
                *(np.array(stop.distortion) / distortion_growth(n / first)),
                pupil,
            ]
            for stop, n, pupil in zip(self.stops, self.nominal_px, self.pupil, strict=True)
        ]
        return np.array(rows)


@lru_cache(maxsize=64)
def _spline_pieces(nominal_px: tuple[float, ...], ends: Literal["not-a-knot", "natural"] = "not-a-knot") -> Array:
    """Compute the polynomials of cubic splines through unit samples, highest power first, (n - 1, 4, n).

    A spline is linear in its samples, so that one solution serves all lenses with zoom samples at the same places.
    """
    unit = CubicSpline(np.log(nominal_px), np.eye(len(nominal_px)), bc_type=ends)
    return np.ascontiguousarray(np.moveaxis(unit.c, 1, 0))


def distortion_growth(magnified: float) -> Array:
    """Compute the factors of (k1, k2, p1, p2, k3) that keep the image's distortion as the focal length grows, (5,)."""
    return np.array([magnified**2, magnified**4, magnified, magnified, magnified**6])
