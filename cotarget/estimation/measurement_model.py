"""What is known of a target at one time: position in 3D, size, and where the zoom camera would see it.

What the moved zoom camera sees of a direction, with derivatives: in tangents, without distortion.

The same geometry as `cotarget.pantilt`, for one point at a time and with floats in place of arrays, because it is asked
for in every frame: it takes less than a tenth of their time.
"""

import math
from dataclasses import dataclass

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import TargetConfig
from cotarget.estimation.motion_model import PAN, SEEN, STATES, TILT, A, B, G, K, L
from cotarget.geometry import Array
from cotarget.pantilt import HeadGeometry
from cotarget.targeting import WantedSize


@dataclass(frozen=True)
class SightLine:
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

    def at(self, pan: float, tilt: float, nominal_px: float) -> SightLine:
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
        return SightLine(view, after_pan @ unpan_slope @ self._fixed, turn @ panned)


_SEEN_TWICE = np.ix_(SEEN, SEEN)
# Derivative of the logarithm of the apparent size, k + g - l, by the state.
_BY_SIZE = np.zeros(STATES)
_BY_SIZE[[L, K, G]] = -1.0, 1.0, 1.0


@dataclass(frozen=True)
class Appearance:
    """Where a target will be in the zoom image.

    Attributes:
        offset_px: from the image's centre, right and down, (2,).
        covariance: of it [px^2], (2, 2).
        size_px: the target's known dimension as it will appear.
        size_sigma: its standard deviation, relative.
        focal_px: true focal length (fx, fy), (2,).
    """

    offset_px: Array
    covariance: Array
    size_px: float
    size_sigma: float
    focal_px: Array

    @property
    def sigma_px(self) -> Array:
        """Standard deviations of the offset, (2,) [px]."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, eq=False)
class Estimate:
    """One target at one time.

    Attributes:
        t: the time that it is for [s].
        measured_t: when the newest measurement before that was made [s].
        state: see `cotarget.estimation.motion_model`, (13,).
        state_covariance: (13, 13).
        carried: whether a hand may be carrying it elsewhere, by where it was found lately.
        size_prior: standard deviation of the true size over the told one, as it was assumed.
        bias_prior: likewise of the head's bias [rad].
        target: what was told of it.
        calibration: of the rig.
        sights: likewise, prepared.
    """

    t: float
    measured_t: float
    state: Array
    state_covariance: Array
    carried: bool
    size_prior: float
    bias_prior: float
    target: TargetConfig
    calibration: Calibration
    sights: Sights

    @property
    def x_fixed(self) -> Array:
        """Position in the fixed camera's frame [m], (3,)."""
        a, b, log_depth = self.state[:3]
        return math.exp(log_depth) * np.array([a, b, 1.0])

    @property
    def depth(self) -> float:
        """Along the fixed camera's axis [m]."""
        return math.exp(self.state[L])

    @property
    def bias(self) -> tuple[float, float]:
        """What to take from the pan and tilt that are solved for, because the head points that much too far [rad]."""
        return float(self.state[PAN]), float(self.state[TILT])

    @property
    def size(self) -> float:
        """The target's true size [m], as far as both views tell."""
        return self.target.size * math.exp(self.state[K])

    @property
    def size_deviation(self) -> float:
        """How far the true size is from the told one, in the standard deviations that were assumed; 0 is as told."""
        return float(self.state[K]) / self.size_prior

    @property
    def bias_deviation(self) -> float:
        """How far the head's bias is, in the standard deviations that were assumed; above 4, calibrate again."""
        return math.hypot(*self.bias) / self.bias_prior

    @property
    def closeup(self) -> WantedSize:
        """How large the target shall be, for `aim`: its size as it shows itself now, foreshortened or not."""
        apparent = self.target.size * math.exp(self.state[K] + self.state[G])
        return WantedSize(apparent, self.target.wanted_px, self.target.dimension == "height")

    def appearance(self, pan: float, tilt: float, nominal_px: float) -> Appearance | None:
        """Where the target appears in the zoom image, the head's bias included.

        Args:
            pan: what the head reports then [rad].
            tilt: likewise.
            nominal_px: what the lens reports then [px].

        Returns:
            None where the target is behind the camera.
        """
        tangent, J, d = self.sights.at(pan, tilt, nominal_px).seen(self.state)
        if d[2] <= 0:
            return None
        lens = self.calibration.zoom.at(nominal_px)
        focal = np.array(lens.focal_px)
        J = focal[:, None] * J
        P = self.state_covariance
        size = math.exp(self.state[K] + self.state[G] - self.state[L]) * self.target.size / d[2]
        return Appearance(
            # Straight lines from the principal point: near the centre, where it matters, distortion does not.
            offset_px=focal * tangent + np.array(lens.center_px) - lens.image_center_px,
            covariance=J @ P[_SEEN_TWICE] @ J.T,
            size_px=size * float(focal[1 if self.target.dimension == "height" else 0]),
            size_sigma=math.sqrt(max(float(_BY_SIZE @ P @ _BY_SIZE), 0.0)),
            focal_px=focal,
        )
