"""What the moved zoom camera sees of a direction, with derivatives: in tangents, without distortion.

The same geometry as `cotarget.pantilt`, for one point at a time and with floats in place of arrays, because it is asked
for in every frame: it takes less than a tenth of their time.
"""

import math
from dataclasses import dataclass

import numpy as np

from cotarget.calibration import Calibration
from cotarget.geometry import Array
from cotarget.pantilt import HeadGeometry


@dataclass(frozen=True)
class Sight:
    """The moved zoom camera, as it sees a target at (a, b, 1) e^l: along d = turned (a, b, 1) + lever e^-l (Eq. 2).

    Attributes:
        turned: rotation from the fixed camera's frame, (3, 3).
        lever: where the fixed camera is in the zoom camera's frame [m], (3,).
        by_pan: derivative of d by the pan that the head reports, of the same form: (3, 3) and ...
        by_pan_lever: ... (3,).
        by_tilt: likewise by the tilt ...
        by_tilt_lever: ... likewise.
    """

    turned: Array
    lever: Array
    by_pan: Array
    by_pan_lever: Array
    by_tilt: Array
    by_tilt_lever: Array

    def seen(self, x: Array) -> tuple[Array, Array, Array]:
        """Where a state (13,) appears.

        Returns:
            Tangents in the zoom camera, head's bias included, (2,); their derivatives by (a, b, l, pan, tilt), (2, 5);
            and the direction d itself, whose third coordinate is the depth in the zoom camera over that in the fixed
            one, (3,).
        """
        p = np.array([x[0], x[1], 1.0])
        nearness = math.exp(-x[2])
        pan = self.by_pan @ p + self.by_pan_lever * nearness
        tilt = self.by_tilt @ p + self.by_tilt_lever * nearness
        d = self.turned @ p + self.lever * nearness + pan * x[11] + tilt * x[12]
        tangent = d[:2] / d[2]
        by = np.column_stack([self.turned[:, 0], self.turned[:, 1], -nearness * self.lever, pan, tilt])
        return tangent, (by[:2] - np.outer(tangent, by[2])) / d[2], d


class Sights:
    """Makes the Sight at any pan, tilt and focal length of one rig."""

    def __init__(self, calibration: Calibration) -> None:
        """Take from the calibration what does not change.

        Raises:
            CalibrationError: the calibration has no T.
        """
        self._calibration = calibration
        self._head: HeadGeometry = calibration.head
        T_base_fixed = calibration.hand_eye() * calibration.T_zoom0_fixed  # (6)
        self._R, self._t = T_base_fixed.rotation.as_matrix(), np.asarray(T_base_fixed.translation)
        self._hand_R = calibration.hand_eye().rotation.as_matrix()
        self._hand_t = np.asarray(calibration.hand_eye().translation)
        self._dz = np.array([0.0, 0.0, calibration.head.axis_offset])
        x, y, z = calibration.head.tilt_axis
        self._across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])  # cross product with the tilt axis

    def at(self, pan: float, tilt: float, nominal_px: float) -> Sight:
        """The Sight where the head reports pan and tilt [rad] and the lens its nominal focal length [px]."""
        head = self._head
        true_pan = head.pan_scale * pan + head.pan_zero
        true_tilt = head.tilt_scale * tilt + head.tilt_zero
        pupil = self._calibration.zoom.pupil_at(nominal_px)
        hand_t = self._hand_t + self._hand_R[:, 2] * pupil
        c, s = math.cos(true_pan), math.sin(true_pan)
        unpan = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
        unpan_slope = np.array([[-s, 0.0, -c], [0.0, 0.0, 0.0], [c, 0.0, -s]]) * head.pan_scale
        axis = self._across
        untilt = np.eye(3) - math.sin(true_tilt) * axis + (1 - math.cos(true_tilt)) * (axis @ axis)
        unhand = self._hand_R.T
        # x_zoom = unhand (untilt (unpan x_base - dz) + dz - hand_t), the inverse of Eqs. 2 and 6
        after_pan = unhand @ untilt
        R, t = unpan @ self._R, unpan @ self._t - self._dz
        turn = -head.tilt_scale * (unhand @ axis @ untilt)
        return Sight(
            turned=after_pan @ R,
            lever=after_pan @ t + unhand @ (self._dz - hand_t),
            by_pan=after_pan @ unpan_slope @ self._R,
            by_pan_lever=after_pan @ unpan_slope @ self._t,
            by_tilt=turn @ R,
            by_tilt_lever=turn @ t,
        )
