"""What the moved zoom camera sees of a direction, with derivatives: in tangents, without distortion.

The same geometry as `cotarget.pantilt`, for one point at a time and with floats in place of arrays, because it is asked
for in every frame: it takes less than a tenth of their time.
"""

import math
from dataclasses import dataclass

import numpy as np

from cotarget.calibration import Calibration
from cotarget.estimation.motion import PAN, TILT, A, B, L
from cotarget.geometry import Array
from cotarget.pantilt import HeadGeometry


@dataclass(frozen=True)
class Sight:
    """The moved zoom camera, as it sees a target at (a, b, 1) e^l: along d = view (a, b, 1, e^-l) (Eq. 2).

    Attributes:
        view: rotation from the fixed camera's frame, and where that camera is in the zoom camera's frame [m], (3, 4).
        by_pan: its derivative by the pan that the head reports, (3, 4).
        by_tilt: likewise by the tilt.
    """

    view: Array
    by_pan: Array
    by_tilt: Array

    def seen(self, x: Array) -> tuple[Array, Array, Array]:
        """Where a state (13,) appears.

        Returns:
            Tangents in the zoom camera, head's bias included, (2,); their derivatives by (a, b, l, pan, tilt), (2, 5);
            and the direction d itself, whose third coordinate is the depth in the zoom camera over that in the fixed
            one, (3,).
        """
        nearness = math.exp(-x[L])
        p = np.array([x[A], x[B], 1.0, nearness])
        pan, tilt = self.by_pan @ p, self.by_tilt @ p
        d = self.view @ p + pan * x[PAN] + tilt * x[TILT]
        tangent = d[:2] / d[2]
        by = np.array([self.view[:, 0], self.view[:, 1], -nearness * self.view[:, 3], pan, tilt]).T
        return tangent, (by[:2] - tangent[:, None] * by[2]) / d[2], d


class Sights:
    """Makes the Sight at any pan, tilt and focal length of one rig."""

    def __init__(self, calibration: Calibration) -> None:
        """Take from the calibration what does not change.

        Raises:
            CalibrationError: the calibration has no T.
        """
        self._calibration = calibration
        self._head: HeadGeometry = calibration.head
        self._fixed = calibration.T_base_fixed.as_matrix()[:3]  # rotation and translation side by side, (3, 4)
        self._hand_t = np.asarray(calibration.hand_eye().translation)
        self._hand_z = calibration.hand_eye().rotation.as_matrix()[:, 2]
        self._unhand = calibration.hand_eye().rotation.as_matrix().T
        self._dz = np.array([0.0, 0.0, calibration.head.axis_offset])
        x, y, z = calibration.head.tilt_axis
        across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])  # cross product with the tilt axis
        self._across = self._unhand @ across
        self._across_twice = self._across @ across

    def at(self, pan: float, tilt: float, nominal_px: float) -> Sight:
        """The Sight where the head reports pan and tilt [rad] and the lens its nominal focal length [px]."""
        head = self._head
        true_pan = head.pan_scale * pan + head.pan_zero
        true_tilt = head.tilt_scale * tilt + head.tilt_zero
        hand_t = self._hand_t + self._hand_z * self._calibration.zoom.pupil_at(nominal_px)
        c, s = math.cos(true_pan), math.sin(true_pan)
        unpan = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
        unpan_slope = np.array([[-s, 0.0, -c], [0.0, 0.0, 0.0], [c, 0.0, -s]]) * head.pan_scale
        # x_zoom = unhand (untilt (unpan x_base - dz) + dz - hand_t), the inverse of Eqs. 2 and 6
        c, s = math.cos(true_tilt), math.sin(true_tilt)
        after_pan = self._unhand - s * self._across + (1 - c) * self._across_twice  # unhand untilt, after Rodrigues
        turn = head.tilt_scale * (s * self._across_twice - c * self._across)
        panned = unpan @ self._fixed
        panned[:, 3] -= self._dz
        view = after_pan @ panned
        view[:, 3] += self._unhand @ (self._dz - hand_t)
        return Sight(view, after_pan @ unpan_slope @ self._fixed, turn @ panned)
