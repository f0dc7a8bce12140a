"""Estimate by how much the fixed camera's stamps are late, from a moving target that both cameras show.

Stamps that are late by s show the target where it was s ago, so the zoom camera sees it ahead by s times its velocity.
A wrong depth moves it along the baseline alone, and a wrong angle of the head moves it whichever way it goes. A Kalman
filter tells these apart: across the baseline at once, along it by how the velocity changes. Of a target that goes along
the baseline at a constant speed the offset stays unknown. Measurements: docs/design-notes.md.
"""

import math
from collections.abc import Sequence

import numpy as np

from cotarget.estimation.motion_model import CENTER_GATE, GATE, LOG_DEPTH, STATES, MotionSettings
from cotarget.estimation.target_filter import Observation, variance_factor
from cotarget.geometry import Array

# Prior standard deviations: of the offset, that of cameras on a network [s]; of the depth's logarithm by a size that
# may be wrong by a factor.
OFFSET_SIGMA_S, DEPTH_SIGMA = 0.1, 1.0
DRIFT_S = 5e-4  # standard deviation of the offset's change in a second [s]: clocks drift by less, delays by more
# Least offset that is corrected, and largest change of the correction from frame to frame [s]: a quarter of a frame's
# time, so that frames stay in their order.
LEAST_S, SLEW_S = 0.01, 0.01
# The target's way in the fixed image is a parabola for this long before and after a zoom frame [s]: a running or flying
# target turns in a second.
SPAN_S = 0.2
FEWEST = 5  # observations from which the parabola and its error are found
OFFSET, DEPTH = 0, 1  # components of the state; the others are the head's biases in pan and tilt


class ClockOffset:
    """Kalman filter of the clocks' offset, the error of the depth's logarithm by the size, and the head's biases.

    Attributes:
        corrected_s: what is subtracted from the fixed camera's stamps [s].
    """

    def __init__(self, motion: MotionSettings) -> None:
        """Start without measurements, with the motion of the targets."""
        self._speed = motion.speed
        bias, attitude = motion.bias_sigma, motion.attitude_sigma
        self._x, self._P = np.zeros(4), np.diag(np.square([OFFSET_SIGMA_S, DEPTH_SIGMA, bias, bias]))
        gained = [DRIFT_S**2, 2 * attitude**2 / motion.attitude_s, *[2 * bias**2 / motion.bias_s] * 2]
        self._gained = np.diag(gained)  # variances in a second
        self._t = -math.inf  # of the last zoom frame [s]
        self.corrected_s = 0.0
        self._restarted_s = 0.0  # correction when the target filter last restarted [s]

    @property
    def late_s(self) -> float:
        """By how much the fixed camera's stamps are late [s]; early below 0."""
        return float(self._x[OFFSET])

    @property
    def sigma_s(self) -> float:
        """Standard deviation of that [s]."""
        return math.sqrt(float(self._P[OFFSET, OFFSET]))

    @property
    def uncorrected_s(self) -> float:
        """Part of the offset that is not corrected, beyond one standard deviation [s].

        It is corrected once it is sure, and step by step.
        """
        return max(abs(self.late_s - self.corrected_s) - self.sigma_s, 0.0)

    def forget_target(self) -> None:
        """Go on with another target, whose size is unknown; the clocks stay."""
        self._x[DEPTH] = 0.0
        self._P[DEPTH] = self._P[:, DEPTH] = 0.0
        self._P[DEPTH, DEPTH] = DEPTH_SIGMA**2

    def correct(self) -> float:
        """Move the correction of the stamps towards the offset, for the next frame; return it [s].

        An offset counts if it is larger than three standard deviations.
        """
        goal_s = self.late_s if abs(self.late_s) > max(3 * self.sigma_s, LEAST_S) else 0.0
        self.corrected_s += min(max(goal_s - self.corrected_s, -SLEW_S), SLEW_S)
        return self.corrected_s

    def restarts_filter(self) -> bool:
        """Whether the correction has reached another value, so that the target filter has to restart; true once."""
        is_new = abs(self.corrected_s - self._restarted_s) > 2 * LEAST_S and self.uncorrected_s == 0
        if is_new:
            self._restarted_s = self.corrected_s
        return is_new

    def add(self, observed: Sequence[Observation]) -> None:
        """Add the new zoom frames of a target that the fixed camera shows before and after.

        Args:
            observed: the target's observations by both cameras, in the order of time; those that were added are
                ignored.
        """
        fixed = [each for each in observed if each.sight is None and each.log_depth is not None and not each.bound]
        for each in observed:
            if each.sight is not None and fixed and self._t < each.t <= fixed[-1].t - SPAN_S:
                self._add(each, [other for other in fixed if abs(other.t - each.t) <= SPAN_S])

    def _add(self, zoom: Observation, fixed: Sequence[Observation]) -> None:
        """Add a zoom frame and the observations in the fixed image around its time."""
        interval, self._t = zoom.t - self._t, zoom.t
        self._P += self._gained * (interval if math.isfinite(interval) else 0.0)
        if len(fixed) < FEWEST:
            return
        # Tangents and logarithm of the depth as parabolas; their error is what they leave.
        values = np.array([[*each.tangent, each.log_depth] for each in fixed])
        powers = np.vander([each.t - zoom.t for each in fixed], 3, increasing=True)
        inverse = np.linalg.inv(powers.T @ powers)
        (place, rate, _) = inverse @ powers.T @ values
        left = values - powers @ (inverse @ powers.T @ values)
        if self._shows_a_part(values[:, 2], float(rate[2]), left[:, 2], fixed):
            return
        variance = np.sum(left[:, :2] ** 2, axis=0) / (len(fixed) - FEWEST + 2)
        if np.sum(rate[:2] ** 2) <= CENTER_GATE * inverse[1, 1] * variance.sum():  # it may stand
            return
        x = np.zeros(STATES)
        x[:LOG_DEPTH], x[LOG_DEPTH] = place[:2], values[:, 2].mean()
        assert zoom.sight is not None
        predicted, J, d = zoom.sight.project(x)
        if d[2] <= 0:
            return
        H = np.column_stack([J[:, :3] @ rate, J[:, 2:]])
        R = zoom.R + (J[:, :2] * variance * inverse[0, 0]) @ J[:, :2].T
        S = H @ self._P @ H.T + R * variance_factor(interval, SPAN_S)
        # The observations' times are corrected already.
        innovation = zoom.tangent - predicted - H @ self._x + H[:, OFFSET] * self.corrected_s
        if innovation @ np.linalg.solve(S, innovation) > CENTER_GATE:  # something else
            return
        gain = self._P @ H.T @ np.linalg.inv(S)
        self._x = self._x + gain @ innovation
        self._P = self._P - gain @ H @ self._P

    def _shows_a_part(self, logs: Array, rate: float, left: Array, fixed: Sequence[Observation]) -> bool:
        """Whether a target goes behind something or comes out: what is seen of it then moves otherwise than it does.

        Its size changes faster than by its fastest approach, or not as a parabola, by three standard deviations.

        Args:
            logs: logarithms of the depth by the size, (n,).
            rate: their change in a second at the zoom frame's time.
            left: what a parabola leaves of them, (n,).
            fixed: the observations.
        """
        sigma = min(each.log_depth_sigma for each in fixed)  # of a whole box
        fastest = self._speed * math.exp(-float(logs.mean()))
        return rate * rate > GATE * fastest**2 or bool((left**2 > GATE * sigma**2).any())
