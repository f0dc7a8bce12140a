"""Pan-tilt kinematics: forward, the exact inverse for any wanted pixel, and the paper's shortcut beside it.

The head turns as T_base_head = Rot(Y, pan) Trans(0, 0, dz) Rot(cos(eps) X + sin(eps) Y, tilt) Trans(0, 0, -dz); an
ideal head has dz = eps = 0. A target x_base is on the ray d of the zoom camera when some range r makes

    T_base_head(pan, tilt) T_head_zoom (r d) = x_base                                                  (Eqs. 2, 6)
"""

from dataclasses import dataclass

import numpy as np

from cotarget.geometry import RigidTransform, Rotation, rot_y

# Newton's iteration from the closed form converges quadratically; three or four steps reach rounding.
NEWTON_STEPS = 20
NEWTON_TOLERANCE = 1e-14  # relative to the target's distance; below it steps are rounding


@dataclass(frozen=True)
class HeadGeometry:
    """How a real head departs from two axes that cross at a right angle.

    Attributes:
        axis_offset: dz, from the pan axis to the tilt axis along the base's z at pan = 0 [m].
        squareness: eps, how far the tilt axis leans from X towards Y [rad].
    """

    axis_offset: float = 0.0
    squareness: float = 0.0


IDEAL_HEAD = HeadGeometry()


@dataclass(frozen=True)
class Pointing:
    """One way to bring a target onto a ray of the zoom camera: angles [rad] and range along that ray [m]."""

    pan: float
    tilt: float
    range: float


def base_head(pan: float, tilt: float, head: HeadGeometry = IDEAL_HEAD) -> RigidTransform:
    """Forward kinematics T_base_head, the paper's P (Eq. 8); the identity at pan = tilt = 0.

    Args:
        pan: positive turns the camera right [rad].
        tilt: positive turns the camera up [rad].
        head: the unit's own geometry.
    """
    axis = np.array([np.cos(head.squareness), np.sin(head.squareness), 0.0])
    offset = RigidTransform.from_translation([0.0, 0.0, head.axis_offset])
    return (
        RigidTransform.from_rotation(rot_y(pan))
        * offset
        * RigidTransform.from_rotation(Rotation.from_rotvec(axis * tilt))
        * offset.inv()
    )


def zoom_fixed(
    pan: float,
    tilt: float,
    T_head_zoom: RigidTransform,
    T_zoom0_fixed: RigidTransform,
    head: HeadGeometry = IDEAL_HEAD,
) -> RigidTransform:
    """Where the fixed camera is seen from the moved zoom camera: T_zoom_fixed (Eq. 2)."""
    return T_head_zoom.inv() * base_head(pan, tilt, head).inv() * T_head_zoom * T_zoom0_fixed
