"""Solve the aims of many tracks at once, by tables of the zoom lens over its focal range.

`cotarget.targeting.aim` is exact for one target. This agrees with it within 1e-4 rad from 3 m on, a ninth of a step
of the default head, because the focal length for which the ray is taken is solved once.
"""

import math

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import TargetProfile
from cotarget.geometry import Array
from cotarget.pantilt import closed_form

NODES = 513  # of the tables, evenly spaced in the logarithm of the focal length
# Columns of the table: logarithm of the true focal length along the target's size, and of the one along the rows; the
# ray through the image's centre in the head's frame, a unit vector, and its part along the optical axis; the entrance
# pupil in the head's frame.
ALONG, ROWS, RAY, DEPTH, PUPIL = 0, 1, slice(2, 5), 5, slice(6, 9)


class AimSolver:
    """Aims at tracks of one camera with one head, for a target of known size."""

    def __init__(self, calibration: Calibration, target: TargetProfile, focal_range: tuple[float, float]) -> None:
        """Make the tables.

        Args:
            calibration: calibration for the rig's streams.
            target: profile of the target.
            focal_range: shortest and longest nominal focal length [px].
        """
        head = calibration.zoom_head
        self._lens, self._head, self._target = calibration.fixed.lens, head.axes, target
        self._bent = any(self._lens.distortion)
        self._base_fixed = head.T_base_fixed.as_matrix()[:3]
        self.focals = np.linspace(math.log(focal_range[0]), math.log(focal_range[1]), NODES)
        self._nodes_per_log = (NODES - 1) / (self.focals[-1] - self.focals[0])
        # The image axis along the size: a camera may be mounted on its side.
        on_its_side = abs(head.fixed_roll(0.0, 0.0)) > math.pi / 4
        self._axis = 1 if target.is_vertical() != on_its_side else 0
        T = head.hand_eye().as_matrix()
        rows = []
        for nominal_px in np.exp(self.focals).tolist():
            optics = head.lens.at(nominal_px)
            ray = optics.ray(optics.image_center_px)
            ray /= np.linalg.norm(ray)
            along = head.focal_along(optics.focal_px, vertical=target.is_vertical())
            pupil = T[:3, 3] + T[:3, 2] * head.lens.pupil_at(nominal_px)
            rows.append([math.log(along), math.log(optics.focal_px[0]), *T[:3, :3] @ ray, ray[2], *pupil])
        self._table = np.array(rows)
        self._lever = max(float(self._table[0, RAY] @ self._table[0, PUPIL]), 1e-3)  # along the ray [m]
        self._half_width_px = head.lens.size[0] / 2

    def half_width(self, focal: Array) -> Array:
        """Half the horizontal angle of view at the logarithm of a nominal focal length [rad]."""
        return self._half_width_px * np.exp(-self._at(focal)[..., ROWS])

    def length_px(self, size_px: Array, larger_side_px: Array) -> Array:
        """Size of the target's known dimension in the fixed image [px], (n,), by width and height (2, n)."""
        if self._target.largest_over_time:
            return larger_side_px
        return size_px[self._axis]

    def solve(self, pixel: Array, length_px: Array, at_px: Array) -> Array:
        """Solve pan, tilt [rad] and logarithm of the nominal focal length [px], (3, ...).

        Args:
            pixel: where the target will be in the fixed image [px], (2, ...).
            length_px: size of its known dimension there [px], (...).
            at_px: where that size was measured [px], (2, ...).
        """
        shift = np.zeros_like(at_px)
        shift[self._axis] = length_px / 2
        x, y = self._tangents(pixel)
        low, high = (self._tangents(end)[self._axis] for end in (at_px - shift, at_px + shift))
        depth = self._target.size / np.maximum(high - low, 1e-9)  # no box is smaller
        R = self._base_fixed
        x_base = [depth * (R[i, 0] * x + R[i, 1] * y + R[i, 2]) + R[i, 3] for i in range(3)]
        gain = math.log(self._target.wanted_px / self._target.size)
        # The range is the distance from the base less the lever arm, but for a part in a thousand.
        reach = np.sqrt(x_base[0] ** 2 + x_base[1] ** 2 + x_base[2] ** 2) - self._lever
        row = self._at(self._nominal(gain + np.log(np.maximum(reach, self._lever))))
        ray, pupil = (np.moveaxis(row[..., at], -1, 0) for at in (RAY, PUPIL))
        pan, tilt, reach = closed_form(x_base, ray, pupil, self._head)
        return np.stack([pan, tilt, self._nominal(gain + np.log(reach * row[..., DEPTH]))])

    def _nominal(self, along: Array) -> Array:
        """Logarithm of the nominal focal length for one along the size, within the lens's range."""
        return np.interp(along, self._table[:, ALONG], self.focals)

    def _at(self, focal: Array) -> Array:
        """Interpolate the table at logarithms of nominal focal lengths, (..., 9)."""
        place = np.clip((focal - self.focals[0]) * self._nodes_per_log, 0.0, NODES - 1.001)
        node = place.astype(int)
        return self._table[node] + (place - node)[..., None] * (self._table[node + 1] - self._table[node])

    def _tangents(self, pixel: Array) -> Array:
        """Undistorted x / z and y / z of pixels of the fixed image, (2, ...)."""
        if self._bent:
            return np.moveaxis(self._lens.ray(np.moveaxis(pixel, 0, -1))[..., :2], -1, 0)
        (fx, fy), (cx, cy) = self._lens.focal_px, self._lens.center_px
        return np.stack([(pixel[0] - cx) / fx, (pixel[1] - cy) / fy])
