"""Model a target's motion: a Singer process in coordinates divided by the target's own depth.

The state is x = (a, b, l, w, c, k, g, pan, tilt), 13 numbers:

- a = X/Z, b = Y/Z: tangents in the fixed camera's frame; l: logarithm of the depth Z;
- w, c: velocity and acceleration, each divided by the depth (3 + 3);
- k: logarithm of the true size over the nominal one, a constant;
- g: logarithm of the apparent size over the true one, which attitude and limbs change;
- pan, tilt: the head's pointing bias, the true angle less the reported one [rad].

The fixed camera measures a, b and the size l - k - g, all linearly. The depth itself appears nowhere in the motion and
only scales the noise, so bearings alone can never pretend to have measured it (modified spherical coordinates of
Stallard, 1987, in tangents). The acceleration decays after Singer (1970): c' = -c / tau + white noise.

`FilterSettings` holds what is assumed before anything is measured, for each kind of target. The comparison of
motion models and the choice of the numbers: docs/design-notes.md.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cotarget.calibration import Calibration, predicted_pointing
from cotarget.config import TargetProfile
from cotarget.geometry import Array

# Bias left by the head's rounding and play and by the centre of a box, whatever the calibration says [rad].
LEAST_BIAS = 5e-4
# Bias of a rig whose calibration does not say how good it is: 0.04 degrees [rad].
USUAL_BIAS = 7e-4
# Least depth, in sizes of the target. Nearer, it spans more than a right angle, fills the view of any likely fixed
# camera, and pointing at it is no use.
NEAREST_SIZES = 0.5
USUAL_DEPTH = 15.0  # initial depth of a target without a measured size [m]


@dataclass(frozen=True)
class Jump:
    """Motion of a target after it was found where it could not be: it was carried there, or was mistaken.

    Attributes:
        speed: standard deviation of the velocity after a jump, across the line of sight [m/s].
        acceleration: standard deviation of the acceleration after a jump, across the line of sight [m/s^2].
        seconds: how long this motion lasts; a hand that carries something speeds up and brakes meanwhile [s].
        by_hand_s: time constant of the acceleration meanwhile, of targets carried by hand [s]; None for targets that
            move by themselves, whose time constant stays.
    """

    speed: float = 3.0
    acceleration: float = 10.0
    seconds: float = 1.5
    by_hand_s: float | None = None


@dataclass(frozen=True)
class MotionSettings:
    """Motion of a target, and of the slow unknowns: size, attitude and the head's bias.

    Attributes:
        acceleration: standard deviation of the acceleration along each axis [m/s^2].
        manoeuvre_s: time constant of the acceleration [s]. Much less than a frame's time makes the velocity a random
            walk; much more makes the acceleration constant.
        speed: standard deviation of the velocity along each axis [m/s].
        size_sigma: standard deviation of k, the logarithm of the true size over the nominal one.
        attitude_mean: mean of g, the logarithm of the apparent size over the true one; negative if foreshortened.
        attitude_sigma: standard deviation of g.
        attitude_s: time constant of g [s].
        bias_sigma: standard deviation of the head's bias, in pan and tilt each [rad].
        bias_s: time constant of that bias [s].
        nearest: least depth of a target, along the fixed camera's axis [m].
        jump: motion after the target was found where it could not be.
    """

    acceleration: float
    manoeuvre_s: float
    speed: float
    size_sigma: float
    attitude_mean: float = 0.0
    attitude_sigma: float = 0.02
    attitude_s: float = 0.5
    bias_sigma: float = USUAL_BIAS
    bias_s: float = 60.0
    nearest: float = 0.1
    jump: Jump = field(default_factory=Jump)

    @property
    def fading_s(self) -> float:
        """Time constant of a velocity whose random acceleration keeps its standard deviation at `speed` [s]."""
        return self.speed**2 / (self.acceleration**2 * self.manoeuvre_s) + self.manoeuvre_s


@dataclass(frozen=True)
class FilterSettings:
    """Motion and measurement noise of a target, and the treatment of measurements that do not fit.

    Attributes:
        motion: motion of the target.
        noise_px: standard deviation of a box's centre in the fixed image, the part independent of its size [px].
        noise_of_size: the part proportional to the box's side, from moving limbs and wings.
        noise_s: how long an error of that centre lasts [s].
        size_noise: relative standard deviation of a box's side.
        size_noise_px: standard deviation of a box's side, the part independent of its size [px].
        size_s: how long an error of the side lasts, half a wing beat or step [s].
        unsized_s: time constant of the velocity along the axis while the fixed camera shows only a part of the target:
            long enough for a moment behind a post; a target that fills the view has mostly stopped [s].
        head_sigma: standard deviation of the angles reported for a frame; rounding of 0.05 degrees leaves that [rad].
        gate: gate on the NIS of a centre, 99.9 % of a chi-square with two degrees of freedom; beyond it, a measurement
            counts less.
        jump_gate: beyond this NIS, ten standard deviations, a measurement is wrong or the target is elsewhere.
        size_gate: gate on the NIS of a size, 99.7 % of a chi-square with one degree of freedom.
        misses: measurements in a row beyond their gate after which they are believed.
        zoom_misses: rejected zoom measurements in a row, while the fixed camera is consistent, after which size and
            head bias are inflated.
        consistent_nis: mean NIS below which the fixed camera counts as consistent.
        mean_innovation_gain: weight of the newest innovation in the mean innovation of the zoom camera.
        most_mean_innovation: mean innovation, in standard deviations, beyond which size and head bias are inflated;
            for white noise it is 0.23 along each axis.
        depth_sigma: standard deviation of the logarithm of the depth, before a size is measured.
        depth_inflation: standard deviation added to it after a jump, and to it and g after rejected sizes.
        size_inflation: standard deviation added to the logarithms of size and depth together, after contradictions by
            the zoom camera.
        bias_inflation: standard deviation then added to the head's bias [rad].
        nis_gain: weight of the newest measurement in the mean NIS.
        most_noise_scale: largest factor on the variance of the acceleration.
        history_s: how late a measurement may arrive after the newest one [s].
    """

    motion: MotionSettings
    noise_px: float = 0.4
    noise_of_size: float = 0.04
    noise_s: float = 0.03
    size_noise: float = 0.05
    size_noise_px: float = 1.0
    size_s: float = 0.2
    unsized_s: float = 0.5
    head_sigma: float = 3e-4
    gate: float = 13.8
    jump_gate: float = 100.0
    size_gate: float = 9.0
    misses: int = 3
    zoom_misses: int = 8
    consistent_nis: float = 2.0
    mean_innovation_gain: float = 0.1
    most_mean_innovation: float = 1.0
    depth_sigma: float = 1.0
    depth_inflation: float = 0.3
    size_inflation: float = 0.3
    bias_inflation: float = 5e-3
    nis_gain: float = 0.2
    most_noise_scale: float = 30.0
    history_s: float = 1.5

    @property
    def jump_noise_scale(self) -> float:
        """Least factor on the variance of the acceleration after a jump."""
        return max(1.0, (self.motion.jump.acceleration / self.motion.acceleration) ** 2)

    @functools.cached_property
    def jump_motion(self) -> MotionSettings:
        """Motion after a jump: time constants only, `jump_noise_scale` raises the acceleration."""
        by_hand_s = self.motion.jump.by_hand_s
        return self.motion if by_hand_s is None else replace(self.motion, manoeuvre_s=by_hand_s)


# A hand that reaches for something speeds up and brakes within about a second.
HAND = Jump(acceleration=5.0, seconds=1.25, by_hand_s=0.15)
# Motion by the target profile's `motion`. A standing target may still be carried elsewhere. The larger side of what
# flies varies from its body's length to its wingspan. Of a target of which nothing is known, motion and attitude lie
# between a walking and a flying one's.
MOTIONS = {
    "standing": MotionSettings(0.5, 0.5, 0.7, 0.01, attitude_sigma=0.01, attitude_s=2.0, jump=HAND),
    "walking": MotionSettings(0.8, 0.7, 1.2, 0.04),
    "flying": MotionSettings(6.5, 2.5, 7.0, 0.075, attitude_mean=-0.35, attitude_sigma=0.3, attitude_s=1.0),
    "general": MotionSettings(2.5, 1.0, 3.0, 0.075, attitude_sigma=0.2, attitude_s=1.0),
}
# Measurement noise that differs from the defaults, by the target profile's `matcher`. The errors of an outline last
# half a wing beat, those of its size a quarter of one.
NOISE: Mapping[str, Mapping[str, Any]] = {
    "box": {
        "noise_px": 0.2,
        "noise_of_size": 0.01,
        "noise_s": 0.0,
        "size_noise": 0.01,
        "size_noise_px": 0.3,
        "misses": 2,
    },
    "upright": {},
    "outline": {"noise_of_size": 0.06, "noise_s": 0.1, "size_noise": 0.1, "size_s": 0.06},
}


def filter_settings(target: TargetProfile, calibration: Calibration | None = None) -> FilterSettings:
    """Choose the settings for a target profile, with the head's bias from the calibration's covariance.

    Args:
        target: target profile; its motion model and its matcher decide.
        calibration: calibration of the rig; None, or one without covariance, leaves the usual bias.
    """
    motion = replace(MOTIONS[target.motion], nearest=NEAREST_SIZES * target.size)
    if calibration is not None and calibration.covariance is not None:
        middle = calibration.fixed.lens.image_center_px
        sigma = float(predicted_pointing(calibration, middle, USUAL_DEPTH)) / math.sqrt(2)  # along one axis
        if np.isfinite(sigma):
            motion = replace(motion, bias_sigma=math.hypot(LEAST_BIAS, sigma))
    return FilterSettings(motion, **NOISE[target.matcher])


STATES = 13
MOVING = 9  # position, velocity and acceleration, (a, b, l, w, c); the other four drift
A, B, L, K, G, PAN, TILT = 0, 1, 2, 9, 10, 11, 12
W, C = slice(3, 6), slice(6, 9)
SEEN = [A, B, L, PAN, TILT]  # components that a measurement in the zoom image depends on
# Least ratio of new to old depth in one prediction, whatever the velocity is.
NEAREST = 0.2
# Below this ratio of time step to time constant, Singer's noise is that of white jerk to better than 2 %, while its
# closed form loses its digits.
SHORT = 0.03
_UNIT = np.eye(MOVING)
MOST_UNCERTAINTY = 0.5  # largest variance of the logarithm of the depth that widens the noise
# Largest standard deviations, however long nothing is measured: the target is anywhere in view, its depth is known to a
# factor of some five, size and attitude to three, the head's bias to six degrees.
MOST_SIGMA = np.array([3.0, 3.0, 1.5, *[1e2] * 3, *[1e3] * 3, 1.0, 1.0, 0.1, 0.1])
_MOST_VARIANCE = MOST_SIGMA**2
CACHED = 1024  # cached time steps; frames come at regular intervals


@dataclass(frozen=True)
class Span:
    """Parts of a prediction that depend only on the time step.

    Attributes:
        linear: linear motion before the division by the new depth, (13, 13).
        noise: covariance of position, velocity and acceleration for unit variance of the acceleration, (9, 9).
        drift: variances that attitude and bias gain, (13, 13).
        dt: time step [s].
        reach: position gained per unit of acceleration [s^2].
    """

    linear: Array
    noise: Array
    drift: Array
    dt: float
    reach: float


@functools.lru_cache(maxsize=CACHED)
def span_of(dt: float, motion: MotionSettings) -> Span:
    """Compute the parts of a prediction over a time step ``dt`` > 0 [s]; cached."""
    tau = motion.manoeuvre_s
    rho = math.exp(-dt / tau)
    gain = -tau * math.expm1(-dt / tau)
    reach = tau * (dt - gain)
    # An unmeasured depth must not run away: its velocity fades, so that its variance stays at the target's speed.
    fade = math.exp(-dt / motion.fading_s)
    attitude, bias = math.exp(-dt / motion.attitude_s), math.exp(-dt / motion.bias_s)
    linear = np.diag([*[1.0] * 5, fade, *[rho] * 3, 1.0, attitude, bias, bias])
    for i in range(3):
        linear[i, 3 + i], linear[i, 6 + i], linear[3 + i, 6 + i] = dt, reach, gain
    linear[5, 8] *= fade
    growth = np.array([0.0, motion.attitude_sigma**2, motion.bias_sigma**2, motion.bias_sigma**2])
    drift = np.zeros((STATES, STATES))
    drift[range(MOVING, STATES), range(MOVING, STATES)] = growth * (1 - np.array([1.0, attitude, bias, bias]) ** 2)
    return Span(linear, np.kron(_singer(dt, tau), np.eye(3)).astype(float), drift, dt, reach)


def _singer(dt: float, tau: float) -> Array:
    """Covariance of (position, velocity, acceleration) after ``dt``, for unit variance of the acceleration, (3, 3)."""
    T = dt / tau
    if T < SHORT:
        jerk = 2 / tau
        pp, pv, pa = jerk * dt**5 / 20, jerk * dt**4 / 8, jerk * dt**3 / 6
        vv, va, aa = jerk * dt**3 / 3, jerk * dt**2 / 2, jerk * dt
    else:
        e = math.exp(-T)
        pp = tau**4 * (1 - e * e + 2 * T + 2 * T**3 / 3 - 2 * T**2 - 4 * T * e)
        pv = tau**3 * (e * e + 1 - 2 * e + 2 * T * e - 2 * T + T**2)
        pa = tau**2 * (1 - e * e - 2 * T * e)
        vv = tau**2 * (4 * e - 3 - e * e + 2 * T)
        va = tau * (e * e + 1 - 2 * e)
        aa = 1 - e * e
    return np.array([[pp, pv, pa], [pv, vv, va], [pa, va, aa]])


def propagate(x: Array, P: Array, dt: float, motion: MotionSettings, noise_scale: float = 1.0) -> tuple[Array, Array]:
    """Predict state and covariance ``dt`` >= 0 [s] ahead.

    Args:
        x: state, (13,).
        P: covariance, (13, 13).
        dt: time step [s].
        motion: motion of the target.
        noise_scale: factor on the variance of the acceleration.

    Returns:
        Predicted state (13,) and covariance (13, 13).
    """
    if dt <= 0:
        return x, P
    span = span_of(dt, motion)
    closer = 1 + float(x[5]) * dt + float(x[8]) * span.reach  # new depth over old depth
    ratio = max(closer, NEAREST, min(motion.nearest * math.exp(-x[L]), 1.0))
    y = span.linear @ x
    log_depth = float(x[L]) + math.log(ratio)
    y[:MOVING] /= ratio
    y[L] = log_depth
    y[G] += motion.attitude_mean * (1 - span.linear[G, G])
    if closer < ratio:  # nearer than possible, so the target has stopped
        y[[5, 8]] = 0.0
    F = span.linear.copy()
    F[:MOVING] /= ratio
    F[L] = 0.0
    F[L, L] = 1.0
    if closer >= ratio:
        shrink = y[:MOVING] / ratio
        shrink[L] = -1 / ratio
        F[:MOVING, 5] -= shrink * dt
        F[:MOVING, 8] -= shrink * span.reach
    P = F @ P @ F.T + span.drift
    # Position noise along the axis scales everything that is divided by the depth.
    N = _UNIT.copy()
    N[:, L] -= y[:MOVING]
    N[L, L] = 1.0
    # The mean of 1 / depth^2 over the depth's distribution: an uncertain depth makes the noise larger.
    sigma = motion.acceleration * math.exp(min(P[L, L], MOST_UNCERTAINTY) - log_depth)
    P[:MOVING, :MOVING] += N @ span.noise @ N.T * (noise_scale * sigma * sigma)
    return y, _bounded(P)


def _bounded(P: Array) -> Array:
    """Scale variances down to their limits; correlations stay, so the result is still a covariance."""
    variances = P.diagonal()
    if (variances <= _MOST_VARIANCE).all():
        return P
    scale = np.sqrt(np.minimum(1.0, _MOST_VARIANCE / variances))
    return P * np.outer(scale, scale)
