"""The zoom camera's optics over its range: intrinsics and entrance pupil at every focal length."""

import bisect
import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from cotarget.camera.intrinsics import Intrinsics
from cotarget.errors import ConfigError
from cotarget.geometry import Array, RigidTransform

# By how much a zoom lens's optical axis wanders for every doubling of its focal length, as a share of the image's
# width: that of consumer cameras comes to some 10 to 30 px of 640 over a tenfold range.
WANDER = 5.0 / 640.0
FEW_STOPS = 4  # from here on a spline through them is smooth enough to judge itself by
CENTER = slice(2, 4)  # of what a lens interpolates
NOMINAL_STEPS = 20  # the ratio of true to nominal focal length changes so little that four or five do


@dataclass(frozen=True)
class ZoomLens:
    """The zoom camera's optics over its whole range.

    The device tells its focal length in nominal pixels; calibration says what that means at some stops. Between them
    a cubic spline over the logarithm of the nominal focal length passes through what was calibrated: ratios of true to
    nominal focal length, principal point, distortion as it appears in the image, and entrance pupil. Beyond them the
    last stop's values hold. A lens with one stop is magnified without any other change.

    Attributes:
        nominal_px: the device's own focal length at each stop [px], increasing, (n,).
        stops: the calibrated intrinsics at each stop, n of them.
        pupil: how far the entrance pupil has moved forward along the optical axis since the first stop [m], n of
            them, the first one 0; where it is left out, it does not move.
    """

    nominal_px: tuple[float, ...]
    stops: tuple[Intrinsics, ...]
    pupil: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.pupil:
            object.__setattr__(self, "pupil", (0.0,) * len(self.stops))
        if not self.stops or not len(self.stops) == len(self.nominal_px) == len(self.pupil):
            raise ConfigError("a zoom lens needs one nominal focal length and one pupil for each calibrated stop")
        if self.pupil[0] != 0:
            raise ConfigError("a zoom lens's pupil is counted from the first stop, where it must be 0")
        if any(b <= a for a, b in itertools.pairwise(self.nominal_px)):
            raise ConfigError("the zoom stops' nominal focal lengths must increase")

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self.stops[0].size

    def at(self, nominal_px: float) -> Intrinsics:
        """The intrinsics when the device says its focal length is ``nominal_px``."""
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

    def to_pupil(self, nominal_px: float) -> RigidTransform:
        """The camera's frame at a focal length, seen from that at the first stop: moved forward by `pupil_at`."""
        return RigidTransform.from_translation([0.0, 0.0, self.pupil_at(nominal_px)])

    def pupil_at(self, nominal_px: float) -> float:
        """How far the entrance pupil has moved forward since the first stop [m]."""
        return 0.0 if len(self.stops) == 1 else float(self._values(nominal_px)[-1])

    def center_doubt_px(self, nominal_px: float) -> Array:
        """How far off the principal point may be for want of stops, one standard deviation, (2,) [px].

        Between stops, what two interpolants differ by: the spline used, and the one with straight ends. Beyond them,
        and between a few, as much as a usual zoom lens's axis wanders on the way from the stops.
        """
        away = np.abs(np.log2(nominal_px / np.array(self.nominal_px)))
        inside = self.nominal_px[0] <= nominal_px <= self.nominal_px[-1]
        if not inside:
            return np.full(2, WANDER * self.size[0] * float(away.min()))
        if len(self.stops) < FEW_STOPS:
            near, far = np.sort(away)[:2] if len(self.stops) > 1 else (0.0, 1.0)
            return np.full(2, WANDER * self.size[0] * float(near * far / (near + far)))
        x = math.log(nominal_px)
        straight = CubicSpline(self._curve.x, self._curve(self._curve.x), bc_type="natural")
        return np.abs(straight(x) - self._curve(x))[CENTER]

    def nominal_for(self, focal_px: float) -> float:
        """What to tell the device so that the true horizontal focal length is ``focal_px`` [px]."""
        if len(self.stops) == 1:
            return focal_px * self.nominal_px[0] / self.stops[0].focal_px[0]
        nominal, best = focal_px, math.inf
        for _ in range(NOMINAL_STEPS):  # Newton's, in the logarithm
            i, x = self._piece(nominal)
            a, b, c, d = self._ratios[i]
            off = ((a * x + b) * x + c) * x + d + math.log(nominal / focal_px)
            if abs(off) >= best:  # only rounding is left
                break
            inside = self.nominal_px[0] < nominal < self.nominal_px[-1]
            best, nominal = abs(off), nominal * math.exp(-off / (1 + ((3 * a * x + 2 * b) * x + c) * inside))
        return nominal

    def resized(self, size: tuple[int, int]) -> "ZoomLens":
        """The same lens when its stream is scaled to another size; its nominal focal lengths are scaled with it.

        Raises:
            ConfigError: the aspect ratio is another one.
        """
        factor = size[0] / self.size[0]
        nominal, stops = tuple(n * factor for n in self.nominal_px), tuple(s.resized(size) for s in self.stops)
        return ZoomLens(nominal, stops, self.pupil)

    def _values(self, nominal_px: float) -> Array:
        """Log ratios (2), centre (2), the image's distortion (5) and pupil (1) at a nominal focal length."""
        i, x = self._piece(nominal_px)
        a, b, c, d = self._pieces[i]
        return np.asarray(((a * x + b) * x + c) * x + d)

    def _piece(self, nominal_px: float) -> tuple[int, float]:
        """Between which stops a nominal focal length is, and the logarithm of what it is over the shorter one's."""
        inside = min(max(nominal_px, self.nominal_px[0]), self.nominal_px[-1])
        i = max(bisect.bisect_left(self.nominal_px, inside) - 1, 0)
        return i, math.log(inside / self.nominal_px[i])

    @cached_property
    def _pieces(self) -> Array:
        """The spline's polynomials from stop to stop, highest power first, (n - 1, 4, 10); scipy's call is slow."""
        return np.ascontiguousarray(np.moveaxis(self._curve.c, 1, 0))

    @cached_property
    def _ratios(self) -> list[list[float]]:
        """Of these, those of the logarithm of true over nominal horizontal focal length."""
        return self._pieces[:, :, 0].tolist()

    @cached_property
    def _curve(self) -> CubicSpline:
        nominal = np.array(self.nominal_px)
        m = nominal / nominal[0]
        rows = [
            [
                *np.log(np.array(stop.focal_px) / n),
                *stop.center_px,
                *(np.array(stop.distortion) / distortion_growth(g)),
                pupil,
            ]
            for stop, n, g, pupil in zip(self.stops, nominal, m, self.pupil, strict=True)
        ]
        return CubicSpline(np.log(nominal), np.array(rows))


def distortion_growth(magnified: float) -> Array:
    """By what (k1, k2, p1, p2, k3) grow with the focal length for the image to be bent the same, (5,)."""
    return np.array([magnified**2, magnified**4, magnified, magnified, magnified**6])
