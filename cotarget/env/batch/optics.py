"""The zoom camera of many rigs: its optics at any lens position, and where it shows their targets."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cotarget.config import GOOD_SIZE, TargetProfile
from cotarget.geometry import Array
from cotarget.metrics import WHOLLY_VISIBLE
from cotarget.rig_geometry import ZoomHead
from cotarget.sim.world import SimWorld

NODES_PER_POSITION = 4  # of the table of optics, per position of the lens
NEAREST_M = 0.05  # least depth of a target that is imaged
FOCAL, CENTER, DISTORTION, PUPIL = slice(0, 2), slice(2, 4), slice(4, 9), 9  # columns of the table


class Closeups(NamedTuple):
    """Truth of the targets in the zoom frames of n rigs, (n,) each.

    Attributes:
        good: whether the whole target is visible at about the wanted size.
        off: distance of its centre from the image's in half-widths; infinite behind the camera.
        size_ratio: size over the wanted size; 0 behind the camera.
    """

    good: npt.NDArray[np.bool_]
    off: Array
    size_ratio: Array


class ZoomCameras:
    """The zoom cameras of many equal rigs."""

    def __init__(self, world: SimWorld, head: ZoomHead, target: TargetProfile) -> None:
        """Tabulate the optics.

        Args:
            world: a world of the rig.
            head: the true geometry of the zoom camera and its head.
            target: the target's profile.
        """
        drive, self._target = world.lens_drive, target
        nodes = np.linspace(0.0, drive.last, drive.last * NODES_PER_POSITION + 1)
        lenses = [world.zoom_lens_for(drive.focal_of(node)) for node in nodes.tolist()]
        self._table = np.array(
            [[*lens.focal_px, *lens.center_px, *lens.distortion, lens.pupil] for lens in lenses], dtype=float
        )
        self._bent = bool(self._table[:, DISTORTION].any())
        self._size, self._longest_px, self._axes = lenses[0].size, lenses[-1].focal_px[0], head.axes
        self._T_zoom_head = head.hand_eye().inv().as_matrix()[:3]

    def closeups(self, pan_tilt: Array, position: Array, x_base: Array, extent: Array, size: Array) -> Closeups:
        """Judge the close-ups of targets.

        Args:
            pan_tilt: true pan and tilt [rad], (2, n).
            position: positions of the lenses, (n,).
            x_base: centres of the targets in the base's frame [m], (n, 3).
            extent: their boxes, see `cotarget.env.batch.appearance.Appearance`, (n, 4).
            size: their wanted dimension in tangents, (n,).
        """
        place = np.clip(position * NODES_PER_POSITION, 0.0, len(self._table) - 1.001)
        node = place.astype(int)
        optics = (self._table[node] + (place - node)[:, None] * (self._table[node + 1] - self._table[node])).T
        fx, fy = optics[FOCAL]
        x, y, z = self._in_zoom(pan_tilt, x_base.T, optics[PUPIL])
        ahead = z > NEAREST_M
        z = np.where(ahead, z, 1.0)
        x, y = x / z, y / z
        if self._bent:
            x, y = _bend(x, y, optics[DISTORTION])
        (cx, cy), (width, height) = optics[CENTER], self._size
        u, v = fx * x + cx, fy * y + cy
        left, top, right, bottom = extent.T
        across, down = _inside(u + fx * left, u + fx * right, width), _inside(v + fy * top, v + fy * bottom, height)
        size_px = size * (fy if self._target.is_vertical() else fx)
        ratio = size_px / np.minimum(self._target.wanted_px, size_px * self._longest_px / fx)
        inside = (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)
        good = ahead & inside & (across * down >= WHOLLY_VISIBLE) & (ratio >= GOOD_SIZE[0]) & (ratio <= GOOD_SIZE[1])
        off = np.hypot(u - (width - 1) / 2, v - (height - 1) / 2) * (2 / width)
        return Closeups(good, np.where(ahead, off, math.inf), np.where(ahead, ratio, 0.0))

    def _in_zoom(self, pan_tilt: Array, x_base: Array, pupil: Array) -> tuple[Array, Array, Array]:
        """Map points (3, n) of the base's frame to the zoom cameras' (Eq. 5, inverted)."""
        (c, c_tilt), (s, s_tilt) = np.cos(pan_tilt), np.sin(pan_tilt)
        dz, cos_eps, sin_eps = self._axes.axis_offset, math.cos(self._axes.squareness), math.sin(self._axes.squareness)
        x, y, z = c * x_base[0] - s * x_base[2], x_base[1], s * x_base[0] + c * x_base[2] - dz
        along = (1 - c_tilt) * (cos_eps * x + sin_eps * y)  # turn by -tilt about the tilt axis (Rodrigues)
        x_head = (
            c_tilt * x - s_tilt * sin_eps * z + along * cos_eps,
            c_tilt * y + s_tilt * cos_eps * z + along * sin_eps,
            c_tilt * z - s_tilt * (cos_eps * y - sin_eps * x) + dz,
        )
        R = self._T_zoom_head
        right, below, depth = (
            R[i, 0] * x_head[0] + R[i, 1] * x_head[1] + R[i, 2] * x_head[2] + R[i, 3] for i in range(3)
        )
        return right, below, depth - pupil


def _inside(low: Array, high: Array, extent: int) -> Array:
    """Part of intervals that lies inside an image's side."""
    shown = np.minimum(high, extent - 0.5) - np.maximum(low, -0.5)
    return np.maximum(shown, 0.0) / np.maximum(high - low, 1e-9)


def _bend(x: Array, y: Array, distortion: Array) -> tuple[Array, Array]:
    """Distort tangents as `cotarget.sim.render.optics.TrueLens` does; beyond 45 degrees by the distortion there."""
    k1, k2, p1, p2, k3 = distortion
    r2 = np.minimum(x * x + y * y, 1.0)
    gain = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * gain + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
