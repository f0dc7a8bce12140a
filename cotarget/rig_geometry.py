"""Geometry of a calibrated rig: the fixed camera, and the zoom camera on its pan-tilt head.

A fit estimates these classes, a calibration file holds them, and aiming, tracking and evaluation use them. For the
frames see `cotarget.geometry`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cotarget.camera import Intrinsics, ZoomLens
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.pantilt import IDEAL_HEAD, HeadGeometry, base_head, zoom_fixed


@dataclass(frozen=True)
class FixedCamera:
    """A calibrated fixed camera, whose frame is "fixed".

    Attributes:
        lens: intrinsics.
        turn: rotation vector (x, y) by which it has been turned since it was calibrated [rad]. The frame "fixed" stays
            where it was, because the head's base is calibrated against it.
    """

    lens: Intrinsics
    turn: tuple[float, float] = (0.0, 0.0)

    @property
    def size(self) -> tuple[int, int]:
        """Image size (width, height) [px]."""
        return self.lens.size

    def ray(self, pixel: Array) -> Array:
        """Compute the rays of pixels (..., 2) with z = 1, (..., 3); see `Intrinsics.ray`."""
        return self.lens.ray(pixel)

    def project(self, x_fixed: Array) -> Array:
        """Project points (..., 3) [m] into the image, (..., 2) [px]; see `Intrinsics.project`."""
        return self.lens.project(x_fixed @ self._turned if self.turn != (0.0, 0.0) else x_fixed)

    def resized(self, size: tuple[int, int]) -> "FixedCamera":
        """Return the same camera for a stream scaled to another size (width, height) [px]."""
        return replace(self, lens=self.lens.resized(size))

    def turned(self, shift_px: Array) -> "FixedCamera":
        """Return the camera as it has been turned if its scene has shifted in the image by (du, dv) [px]."""
        (du, dv), (fx, fy) = np.asarray(shift_px).tolist(), self.lens.focal_px
        return replace(self, turn=(math.atan2(dv, fy), -math.atan2(du, fx)))

    def tangents(self, pixel: Array) -> tuple[Array, Array] | None:
        """Compute the tangents of a pixel in the frame "fixed", and their derivative; see `Intrinsics.tangents`."""
        found = self.lens.tangents(pixel)
        if found is None or self.turn == (0.0, 0.0):
            return found
        (x, y), J = found
        R = self._turned
        ray = R @ (x, y, 1.0)
        tangent = ray[:2] / ray[2]
        return tangent, (R[:2, :2] - np.outer(tangent, R[2, :2])) / ray[2] @ J

    @cached_property
    def _turned(self) -> Array:
        """Rotation from the turned camera's frame to the frame "fixed", (3, 3)."""
        return np.asarray(Rotation.from_rotvec([*self.turn, 0.0]).as_matrix())


@dataclass(frozen=True, eq=False)
class ZoomHead:
    """A calibrated zoom camera on its pan-tilt head.

    Attributes:
        lens: optics of the zoom camera over its focal range.
        T_zoom0_fixed: the paper's Gamma, at the shortest focal length.
        T_head_zoom: the paper's T, at the shortest focal length; None where no head was calibrated.
        axes: geometry of the head's axes.
    """

    lens: ZoomLens
    T_zoom0_fixed: RigidTransform
    T_head_zoom: RigidTransform | None
    axes: HeadGeometry = IDEAL_HEAD

    def hand_eye(self, nominal_px: float | None = None) -> RigidTransform:
        """Return T_head_zoom at a focal length, and refuse a calibration without it.

        Args:
            nominal_px: nominal focal length whose entrance pupil is the origin [px]; None for the shortest one.

        Raises:
            CalibrationError: no head was calibrated.
        """
        if self.T_head_zoom is None:
            raise CalibrationError("this calibration has no T_head_zoom; calibrate on a rig, whose head moves")
        if nominal_px is None:
            return self.T_head_zoom
        return self.T_head_zoom * RigidTransform.from_translation([0.0, 0.0, self.lens.pupil_at(nominal_px)])

    @cached_property
    def T_base_fixed(self) -> RigidTransform:
        """Transform from the fixed camera to the base, T_head_zoom T_zoom0_fixed (Eq. 6)."""
        return self.hand_eye() * self.T_zoom0_fixed

    @cached_property
    def _base_fixed(self) -> Array:
        """Rotation and translation of T_base_fixed side by side, (3, 4)."""
        return self.T_base_fixed.as_matrix()[:3]

    @cached_property
    def _T_zoom_head(self) -> RigidTransform:
        return self.hand_eye().inv()

    def in_base(self, x_fixed: Array) -> Array:
        """Map a point (3,) [m] from the fixed camera's frame to the base's (Eq. 6), three times as fast as scipy."""
        x, y, z = x_fixed
        return np.asarray(self._base_fixed @ np.array((x, y, z, 1.0)))

    @cached_property
    def pan_axis_fixed(self) -> tuple[float, float, float]:
        """Direction of the pan axis, downwards, in the fixed camera's frame, (3,)."""
        right, down, ahead = self._base_fixed[1, :3].tolist()
        return right, down, ahead

    def fixed_roll(self, x: float, y: float) -> float:
        """Compute the angle from the fixed image's v axis to the pan axis, as it appears at tangents x, y [rad].

        It is within a quarter turn, because no target's size tells up from down.
        """
        right, down, ahead = self.pan_axis_fixed
        return _within_quarter(right - x * ahead, down - y * ahead)

    @cached_property
    def zoom_roll(self) -> float:
        """Angle from the zoom image's v axis to the pan axis, as it appears in its centre, within a quarter turn [rad].

        It changes with the tilt by less than the zoom camera leans against the head.
        """
        right, down, _ = self.hand_eye().rotation.as_matrix()[1].tolist()
        return _within_quarter(right, down)

    def focal_along(self, focal_px: Sequence[float], *, vertical: bool) -> float:
        """Compute the zoom camera's focal length along or across the pan axis [px], from those along u and v."""
        fx, fy = focal_px
        c, s = math.cos(self.zoom_roll), math.sin(self.zoom_roll)
        return math.hypot(fx * s, fy * c) if vertical else math.hypot(fx * c, fy * s)

    def room_px(self, size: tuple[int, int], *, vertical: bool) -> float:
        """Compute the longest line along or across the pan axis in a zoom image of a size (width, height) [px]."""
        c, s = abs(math.cos(self.zoom_roll)), abs(math.sin(self.zoom_roll))
        across, down = (s, c) if vertical else (c, s)
        return min(side / part if part > 0 else math.inf for side, part in zip(size, (across, down), strict=True))

    def T_fixed_zoom(self, pan: float, tilt: float) -> RigidTransform:
        """Compute the zoom camera's pose, at the shortest focal length and reported pan and tilt [rad] (Eq. 2)."""
        return zoom_fixed(pan, tilt, self.hand_eye(), self.T_zoom0_fixed, self.axes).inv()

    def project(self, x_fixed: Array, pan: float, tilt: float, nominal_px: float) -> Array:
        """Project points of the fixed camera's frame into the zoom image (Eq. 2).

        Args:
            x_fixed: points [m], (..., 3).
            pan: reported pan [rad].
            tilt: reported tilt [rad].
            nominal_px: nominal focal length [px].

        Returns:
            Pixels, (..., 2); nan behind the camera.
        """
        x_head = base_head(pan, tilt, self.axes).inv().apply(self.T_base_fixed.apply(x_fixed))
        pupil = np.array([0.0, 0.0, self.lens.pupil_at(nominal_px)])
        return self.lens.at(nominal_px).project(self._T_zoom_head.apply(x_head) - pupil)

    def resized(self, size: tuple[int, int]) -> "ZoomHead":
        """Return the same camera and head for a stream scaled to another size (width, height) [px]."""
        return replace(self, lens=self.lens.resized(size))


def _within_quarter(right: float, down: float) -> float:
    """Compute the angle from the v axis to a line, given by a direction in the image, within a quarter turn [rad]."""
    return math.atan2(right, down) if down >= 0 else math.atan2(-right, -down)
