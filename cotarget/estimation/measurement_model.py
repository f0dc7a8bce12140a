"""Predict what the zoom camera sees of a target, with derivatives, and hold the estimate of a target at one time.

The geometry is that of `cotarget.pantilt` (Eq. 2), in tangents without distortion. It handles one point at a time in
floats instead of arrays, because it runs for every frame: that takes less than a tenth of the time.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import TargetProfile
from cotarget.estimation.motion_model import (
    LOG_APPARENT,
    LOG_DEPTH,
    LOG_SIZE,
    OF_SIZE,
    PAN,
    SEEN,
    STATES,
    TAN_X,
    TAN_Y,
    TILT,
    VEL_X,
    VEL_Y,
    VEL_Z,
    VELOCITY,
    MotionSettings,
)
from cotarget.geometry import Array
from cotarget.pantilt import HeadGeometry
from cotarget.rig_geometry import FixedCamera
from cotarget.targeting import WantedSize


@dataclass(frozen=True)
class Pose:
    """Pan, tilt and focal length of the zoom camera at one time.

    Attributes:
        pan: pan as the head reports it [rad].
        tilt: tilt as the head reports it [rad].
        nominal_px: nominal focal length, as the lens reports it [px].
        speed: speed of the head over both axes together [rad/s].
        sigma: standard deviation that the head reports of either angle [rad].
    """

    pan: float
    tilt: float
    nominal_px: float
    speed: float = 0.0
    sigma: float = 0.0


@dataclass(frozen=True)
class SightLine:
    """Linear map from a target's direction to the zoom camera's frame, at one pose of the head.

    A target at (x, y, 1) Z in the fixed camera's frame, with the tangents x and y, is seen along
    d = view (x, y, 1, 1 / Z) (Eq. 2).

    Attributes:
        view: rotation from the fixed to the zoom camera's frame, and the fixed camera's position in it [m], (3, 4).
        by_pan: derivative of view by the reported pan, (3, 4).
        by_tilt: derivative of view by the reported tilt, (3, 4).
    """

    view: Array
    by_pan: Array
    by_tilt: Array

    def project(self, x: Array) -> tuple[Array, Array, Array]:
        """Predict where a target in a given state appears.

        Args:
            x: state, see `cotarget.estimation.motion_model`, (13,).

        Returns:
            Tangents in the zoom camera's frame, head bias included, (2,); their derivatives by the components `SEEN`,
            (2, 5); and d, whose third coordinate is the ratio of the depths in the zoom and the fixed camera, (3,).
        """
        nearness = math.exp(-x[LOG_DEPTH])
        p = np.array([x[TAN_X], x[TAN_Y], 1.0, nearness])
        pan, tilt = self.by_pan @ p, self.by_tilt @ p
        d = self.view @ p + pan * x[PAN] + tilt * x[TILT]
        tangent = d[:2] / d[2]
        by = np.array([self.view[:, 0], self.view[:, 1], -nearness * self.view[:, 3], pan, tilt]).T
        return tangent, (by[:2] - tangent[:, None] * by[2]) / d[2], d


class SightLines:
    """Compute the zoom camera's sight line at any pan, tilt and focal length of one rig."""

    def __init__(self, calibration: Calibration) -> None:
        """Extract from the calibration what does not depend on pan, tilt and focal length.

        Raises:
            CalibrationError: the calibration has no T.
        """
        self._calibration = calibration
        head = calibration.zoom_head
        self._head: HeadGeometry = head.axes
        self._fixed = head.T_base_fixed.as_matrix()[:3]  # rotation and translation side by side, (3, 4)
        self._hand_t = np.asarray(head.hand_eye().translation)
        self._hand_z = head.hand_eye().rotation.as_matrix()[:, 2]
        self._unhand = head.hand_eye().rotation.as_matrix().T
        self._dz = np.array([0.0, 0.0, head.axes.axis_offset])
        x, y, z = head.axes.tilt_axis
        across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])  # cross product with the tilt axis
        self._across = self._unhand @ across
        self._across_twice = self._across @ across

    def at(self, pan: float, tilt: float, nominal_px: float) -> SightLine:
        """Compute the sight line at reported pan and tilt [rad] and nominal focal length [px]."""
        head = self._head
        true_pan = head.pan_scale * pan + head.pan_zero
        true_tilt = head.tilt_scale * tilt + head.tilt_zero
        hand_t = self._hand_t + self._hand_z * self._calibration.zoom_head.lens.pupil_at(nominal_px)
        c, s = math.cos(true_pan), math.sin(true_pan)
        unpan = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
        unpan_slope = np.array([[-s, 0.0, -c], [0.0, 0.0, 0.0], [c, 0.0, -s]]) * head.pan_scale
        # x_zoom = unhand (untilt (unpan x_base - dz) + dz - hand_t), from Eqs. 2 and 6
        c, s = math.cos(true_tilt), math.sin(true_tilt)
        after_pan = self._unhand - s * self._across + (1 - c) * self._across_twice  # unhand untilt, Rodrigues' formula
        turn = head.tilt_scale * (s * self._across_twice - c * self._across)
        panned = unpan @ self._fixed
        panned[:, 3] -= self._dz
        view = after_pan @ panned
        view[:, 3] += self._unhand @ (self._dz - hand_t)
        return SightLine(view, after_pan @ unpan_slope @ self._fixed, turn @ panned)


def rate(x: Array) -> Array:
    """Rates of both tangents and of the depth's logarithm in a state, (3,) [1/s]."""
    return np.asarray(x[VELOCITY] - x[VEL_Z] * np.array([x[TAN_X], x[TAN_Y], 0.0]))


_SEEN_TWICE = np.ix_(SEEN, SEEN)


@dataclass(frozen=True)
class Appearance:
    """Predicted appearance of a target in the zoom image.

    Attributes:
        offset_px: offset from the image's centre, right and down, (2,) [px].
        covariance: covariance of the offset [px^2], (2, 2).
        size_px: apparent size of the target's known dimension [px].
        size_sigma: standard deviation of that size, relative.
        focal_px: true focal lengths (fx, fy), (2,) [px].
        sides: width and height of its box in the zoom image, relative to that size.
        rate_px: velocity of the offset while the head stands, (2,) [px/s].
    """

    offset_px: Array
    covariance: Array
    size_px: float
    size_sigma: float
    focal_px: Array
    sides: tuple[float, float] = (1.0, 1.0)
    rate_px: Array | float = 0.0

    @property
    def sigma_px(self) -> Array:
        """Standard deviations of the offset, (2,) [px]."""
        return np.sqrt(np.diag(self.covariance))

    @cached_property
    def offset(self) -> Array:
        """Offset from the image's centre, right and down, (2,) [tangent]."""
        return self.offset_px / self.focal_px

    @cached_property
    def variance(self) -> Array:
        """Variances of the offset, (2,) [tangent^2]."""
        return np.diag(self.covariance) / (self.focal_px * self.focal_px)

    @cached_property
    def half(self) -> Array:
        """Half of the width and height, (2,) [tangent]."""
        return 0.5 * self.size_px / self.focal_px * np.array(self.sides)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimate of one target at one time.

    Attributes:
        t: time of the estimate [s].
        measured_t: time of the newest measurement before it [s].
        state: state, see `cotarget.estimation.motion_model`, (13,).
        state_covariance: covariance of the state, (13, 13).
        motion: motion of the target, with the priors of its size and of the head's bias.
        target: target profile.
        calibration: calibration of the rig.
        sight_lines: sight lines of that calibration.
    """

    t: float
    measured_t: float
    state: Array
    state_covariance: Array
    motion: MotionSettings
    target: TargetProfile
    calibration: Calibration
    sight_lines: SightLines

    @property
    def x_fixed(self) -> Array:
        """Position in the fixed camera's frame [m], (3,)."""
        a, b, log_depth = self.state[:3]
        return math.exp(log_depth) * np.array([a, b, 1.0])

    @property
    def depth(self) -> float:
        """Depth along the fixed camera's optical axis [m]."""
        return math.exp(self.state[LOG_DEPTH])

    @property
    def bias(self) -> tuple[float, float]:
        """Pointing bias (pan, tilt), to subtract from the solved angles before they are commanded [rad]."""
        return float(self.state[PAN]), float(self.state[TILT])

    @property
    def size(self) -> float:
        """Estimated true size of the target [m]."""
        return self.target.size * math.exp(self.state[LOG_SIZE])

    @property
    def size_deviation(self) -> float:
        """Deviation of the true size from the nominal one, in prior standard deviations."""
        return float(self.state[LOG_SIZE]) / self.motion.size_sigma

    @property
    def bias_deviation(self) -> float:
        """Magnitude of the head's bias, in prior standard deviations; above 4, calibrate again."""
        return math.hypot(*self.bias) / self.motion.bias_sigma

    @property
    def wanted_size(self) -> WantedSize:
        """Wanted size of the target for `aim`, from its present apparent size, foreshortened or not."""
        apparent = self.target.size * math.exp(self.state[LOG_SIZE] + self.state[LOG_APPARENT])
        return WantedSize(apparent, self.target.wanted_px, self.target.is_vertical())

    def in_fixed(self, camera: FixedCamera) -> tuple[Array, Array] | None:
        """Predict place and velocity in the fixed image.

        Args:
            camera: the fixed camera, as it is turned now.

        Returns:
            (u, v, du, dv), (4,) [px, px/s], and their covariance, (4, 4); None if no pixel shows the target.
        """
        x, pixel = self.state, camera.project(self.x_fixed)
        found = camera.tangents(pixel)
        if found is None:
            return None
        by_tangent = np.linalg.inv(found[1])
        H = np.zeros((4, STATES))
        H[[0, 1], [TAN_X, TAN_Y]] = H[[2, 3], [VEL_X, VEL_Y]] = 1.0
        H[[2, 3], [TAN_X, TAN_Y]] = -x[VEL_Z]
        H[[2, 3], VEL_Z] = -x[[TAN_X, TAN_Y]]
        H = np.kron(np.eye(2), by_tangent) @ H
        return np.concatenate([pixel, by_tangent @ rate(x)[:2]]), H @ self.state_covariance @ H.T

    def appearance(self, pan: float, tilt: float, nominal_px: float, shape: float = 1.0) -> Appearance | None:
        """Predict where and how large the target appears in the zoom image, head bias included.

        Args:
            pan: reported pan [rad].
            tilt: reported tilt [rad].
            nominal_px: nominal focal length [px].
            shape: width over height of the target's box in the fixed image.

        Returns:
            The appearance; None if the target is behind the zoom camera.
        """
        tangent, J, x_zoom = self.sight_lines.at(pan, tilt, nominal_px).project(self.state)
        if x_zoom[2] <= 0:
            return None
        head, target = self.calibration.zoom_head, self.target
        lens = head.lens.at(nominal_px)
        focal = np.array(lens.focal_px)
        x, P = self.state, self.state_covariance
        sides = target.sides(shape, head.fixed_roll(float(x[TAN_X]), float(x[TAN_Y])))
        (a, b), (c, d) = J[:, :2].tolist()
        scale = math.sqrt(abs(a * d - b * c))
        turn = ((a / scale, b / scale), (c / scale, d / scale))  # from the fixed to the zoom image
        J = focal[:, None] * J
        size = math.exp(x[LOG_SIZE] + x[LOG_APPARENT] - x[LOG_DEPTH]) * target.size / x_zoom[2]
        return Appearance(
            # Distortion is neglected; near the image's centre, where the target should be, it is small.
            offset_px=focal * tangent + np.array(lens.center_px) - lens.image_center_px,
            covariance=J @ P[_SEEN_TWICE] @ J.T,
            size_px=size * head.focal_along(focal.tolist(), vertical=target.is_vertical()),
            size_sigma=math.sqrt(max(float(OF_SIZE @ P @ OF_SIZE), 0.0)),
            focal_px=focal,
            sides=target.turned(sides, turn),
            rate_px=J[:, :3] @ rate(x),
        )
