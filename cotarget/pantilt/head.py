"""A head's own geometry, and where it brings its camera: forward kinematics."""

import math
from dataclasses import dataclass

import numpy as np

from cotarget.geometry import Array, RigidTransform, Rotation, angle_between, rot_y


@dataclass(frozen=True)
class HeadGeometry:
    """How a real head departs from two axes that cross at a right angle and encoders that count truly.

    Attributes:
        axis_offset: dz, from the pan axis to the tilt axis along the base's z at pan = 0 [m].
        squareness: eps, how far the tilt axis leans from X towards Y [rad].
        pan_scale: true turn over the turn that the head reports.
        tilt_scale: likewise.
        pan_zero: true pan where the head reports 0 [rad].
        tilt_zero: likewise.
    """

    axis_offset: float = 0.0
    squareness: float = 0.0
    pan_scale: float = 1.0
    tilt_scale: float = 1.0
    pan_zero: float = 0.0
    tilt_zero: float = 0.0

    @property
    def tilt_axis(self) -> Array:
        """The tilt axis at pan = 0: cos(eps) X + sin(eps) Y, (3,)."""
        return np.array([np.cos(self.squareness), np.sin(self.squareness), 0.0])

    def true_angles(self, pan: Array | float, tilt: Array | float) -> tuple[Array, Array]:
        """The axes' true angles [rad] where the head reports these."""
        return (
            self.pan_scale * np.asarray(pan, float) + self.pan_zero,
            self.tilt_scale * np.asarray(tilt, float) + self.tilt_zero,
        )

    def reported_angles(self, pan: Array, tilt: Array) -> tuple[Array, Array]:
        """What the head reports at true angles [rad]."""
        return (pan - self.pan_zero) / self.pan_scale, (tilt - self.tilt_zero) / self.tilt_scale


IDEAL_HEAD = HeadGeometry()


def base_head(pan: float, tilt: float, head: HeadGeometry = IDEAL_HEAD) -> RigidTransform:
    """Forward kinematics T_base_head, the paper's P (Eq. 8); the identity at true pan = tilt = 0.

    Args:
        pan: as the head reports it, positive turns the camera right [rad].
        tilt: likewise, positive turns the camera up [rad].
        head: the unit's own geometry.
    """
    true_pan, true_tilt = (float(angle) for angle in head.true_angles(pan, tilt))
    offset = RigidTransform.from_translation([0.0, 0.0, head.axis_offset])
    tilting = RigidTransform.from_rotation(Rotation.from_rotvec(head.tilt_axis * true_tilt))
    return RigidTransform.from_rotation(rot_y(true_pan)) * offset * tilting * offset.inv()


def towards(x_base: Array) -> tuple[float, float]:
    """Pan and tilt of an ideal head whose own z then points at a target; where a camera is on it does not count.

    Args:
        x_base: the target in the base's frame [m], (3,).
    """
    x, y, z = x_base
    return math.atan2(x, z), math.atan2(-y, math.hypot(x, z))


def zoom_fixed(
    pan: float,
    tilt: float,
    T_head_zoom: RigidTransform,
    T_zoom0_fixed: RigidTransform,
    head: HeadGeometry = IDEAL_HEAD,
) -> RigidTransform:
    """Where the fixed camera is seen from the moved zoom camera: T_zoom_fixed (Eq. 2).

    Args:
        pan: the pan axis's angle [rad].
        tilt: the tilt axis's [rad].
        T_head_zoom: the paper's T.
        T_zoom0_fixed: the paper's Gamma.
        head: the unit's own geometry.
    """
    return T_head_zoom.inv() * base_head(pan, tilt, head).inv() * T_head_zoom * T_zoom0_fixed


def miss(
    pan: Array,
    tilt: Array,
    x_base: Array,
    T_head_zoom: RigidTransform,
    head: HeadGeometry = IDEAL_HEAD,
    ray: Array | tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Array:
    """Angle between the zoom camera's ray and the target, as seen from the moved camera [rad].

    Args:
        pan: [rad], (...).
        tilt: [rad], (...).
        x_base: targets in the base's frame [m], (..., 3).
        T_head_zoom: the zoom camera's place on the head.
        head: the unit's own geometry.
        ray: the ray, (3,) or (..., 3).
    """
    pan, tilt = head.true_angles(pan, tilt)
    shape = np.broadcast_shapes(np.shape(pan), np.shape(tilt), np.shape(x_base)[:-1])
    dz = np.array([0.0, 0.0, head.axis_offset])
    pans = Rotation.from_rotvec(np.multiply.outer(np.broadcast_to(pan, shape).ravel(), [0.0, 1.0, 0.0]))
    tilts = Rotation.from_rotvec(np.multiply.outer(np.broadcast_to(tilt, shape).ravel(), head.tilt_axis))
    points = np.array(np.broadcast_to(x_base, (*shape, 3))).reshape(-1, 3)
    x_head = tilts.inv().apply(pans.inv().apply(points) - dz) + dz
    x_zoom = T_head_zoom.inv().apply(x_head).reshape(*shape, 3)
    return angle_between(x_zoom, np.broadcast_to(np.asarray(ray, float), x_zoom.shape))
