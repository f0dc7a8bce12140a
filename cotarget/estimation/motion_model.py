"""Model a target's motion: a Singer process in coordinates divided by the target's own depth.

The state x has 13 components, which constants name:

- `TAN_X` = X/Z, `TAN_Y` = Y/Z: tangents in the fixed camera's frame; `LOG_DEPTH`: logarithm of the depth Z;
- `VELOCITY`, `ACCELERATION`: each along x, y, z and divided by the depth (3 + 3);
- `LOG_SIZE`: logarithm of the true size over the nominal one, a constant;
- `LOG_APPARENT`: logarithm of the apparent size over the true one, which attitude and limbs change;
- `PAN`, `TILT`: the head's pointing bias, the true angle less the reported one [rad].

The fixed camera measures both tangents and the size, `LOG_DEPTH` - `LOG_SIZE` - `LOG_APPARENT`, all linearly. The depth
itself appears nowhere in the motion and only scales the noise, so bearings alone can never pretend to have measured it
(modified spherical coordinates of Stallard, 1987, in tangents). The acceleration c decays after Singer (1970):
c' = -c / tau + white noise. Of what flies it also turns with the velocity v, as in a coordinated turn:
c' = -c / tau + w x c + white noise, with the turn rate w = v x c / v^2.

`FilterSettings` holds what is assumed before anything is measured, for each kind of target. The comparison of
motion models and the choice of the numbers: docs/design-notes.md.
"""

import cmath
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cotarget.calibration import Calibration, predicted_pointing
from cotarget.config import TargetProfile
from cotarget.geometry import Array

# Standard deviation of a reported angle of the head: what rounding to steps of 0.05 degrees leaves [rad].
HEAD_SIGMA = 3e-4
# Least depth, in sizes of the target. Nearer, it spans more than a right angle, and pointing at it is no use.
NEAREST_SIZES = 0.5
# Bound of the search in the zoom image, and gate on the normalised innovation squared (NIS) of a size: three standard
# deviations.
GATE = 3.0**2
# Gate on the NIS of a centre: 99.9 % of a chi-square with two degrees of freedom.
CENTER_GATE = 13.8
USUAL_DEPTH = 15.0  # initial depth of a target without a measured size [m]


@dataclass(frozen=True)
class MotionSettings:
    """Motion of a target, and of the slow unknowns: size, attitude and the head's bias.

    Attributes:
        acceleration: standard deviation of the acceleration along each axis, of a target at its usual speed [m/s^2].
        manoeuvre_s: time constant of the acceleration [s]. Much less than a frame's time makes the velocity a
            random walk; much more makes the acceleration constant, or each turn a circle.
        speed: standard deviation of the velocity along each axis [m/s].
        size_sigma: standard deviation of the logarithm of the true size over the nominal one.
        attitude_mean: mean of the logarithm of the apparent size over the true one; negative if foreshortened.
        attitude_sigma: standard deviation of that logarithm.
        attitude_s: time constant of that logarithm [s].
        bias_sigma: standard deviation of the head's bias, in pan and tilt each [rad].
        bias_s: time constant of that bias [s].
        nearest: least depth of a target, along the fixed camera's axis [m].
        turns: whether the acceleration turns with the velocity, as in a coordinated turn.
        turn_m: radius of a turn; the centripetal acceleration on it, less that of twice the usual speed, is a part of
            that deviation [m].
        slope: acceleration and velocity along the pan axis over those across it: of what walks on the ground, the slope
            of the ground.
        pan_axis: direction of the pan axis in the fixed camera's frame; None if it is not known, and all directions are
            alike.
    """

    acceleration: float
    manoeuvre_s: float
    speed: float
    size_sigma: float
    attitude_mean: float = 0.0
    attitude_sigma: float = 0.02
    attitude_s: float = 0.5
    bias_sigma: float = 7e-4
    bias_s: float = 60.0
    nearest: float = 0.1
    turns: bool = False
    turn_m: float = math.inf
    slope: float = 1.0
    pan_axis: tuple[float, float, float] | None = None

    @property
    def anisotropy(self) -> Array:
        """Covariance of acceleration and velocity over the variances across the pan axis, (3, 3)."""
        n = np.zeros(3) if self.pan_axis is None else np.array(self.pan_axis)
        return np.asarray(np.eye(3) - (1 - self.slope**2) * np.outer(n, n))

    def prior(self, depth: float) -> Array:
        """Covariance of a velocity and an acceleration that are not known, divided by the depth [m], (6, 6)."""
        return np.asarray(np.kron(np.diag([self.speed**2, self.acceleration**2]), self.anisotropy) / depth**2)

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
        noise_s: how long an error of a centre lasts [s].
        side_px: standard deviation of a box's side, the part independent of its size [px].
        side_of_size: the part proportional to the side.
        size_s: how long an error of a side lasts, half a wing beat or step [s].
        unsized_s: time constant of the velocity along the axis while the fixed camera shows only a part of the target:
            long enough for a moment behind a post; a target that fills the view has mostly stopped [s].
        depth_sigma: standard deviation of the logarithm of the depth, before a size is measured.
        jump_gate: beyond this NIS, ten standard deviations, a centre is wrong or the target is elsewhere.
        misses: rejected measurements in a row after which they are believed.
        zoom_misses: rejected zoom measurements in a row, while the fixed camera's are accepted, after which size and
            head bias are inflated.
        inflation: standard deviation added to the logarithms of depth, size and attitude that measurements contradict.
        bias_inflation: standard deviation added to the head's bias that the zoom camera contradicts [rad].
        nis_gain: weight of the newest measurement in the mean NIS, which scales the variance of the acceleration.
        most_noise_scale: largest such factor; also that on the variance of the velocity after a jump.
        history_s: how late a measurement may arrive after the newest one [s].
    """

    motion: MotionSettings
    noise_px: float = 0.4
    noise_of_size: float = 0.04
    noise_s: float = 0.03
    side_px: float = 1.0
    side_of_size: float = 0.05
    size_s: float = 0.2
    unsized_s: float = 0.5
    depth_sigma: float = 1.0
    jump_gate: float = 100.0
    misses: int = 3
    zoom_misses: int = 8
    inflation: float = 0.3
    bias_inflation: float = 5e-3
    nis_gain: float = 0.2
    most_noise_scale: float = 30.0
    history_s: float = 1.5


# Motion by the target profile's `motion`. The larger side of what flies varies from its body's length to its wingspan.
# Of a target of which nothing is known, motion and attitude lie between a walking and a flying one's.
MOTIONS = {
    "standing": MotionSettings(0.8, 0.3, 1.5, 0.01, attitude_sigma=0.01, attitude_s=2.0),
    "walking": MotionSettings(1.0, 0.5, 1.2, 0.04, turn_m=8.0, slope=0.2),
    "flying": MotionSettings(6.5, 5.0, 7.0, 0.075, attitude_mean=-0.35, attitude_sigma=0.3, attitude_s=1.0, turns=True),
    "general": MotionSettings(2.5, 1.0, 3.0, 0.075, attitude_sigma=0.2, attitude_s=1.0),
}
# Measurement noise that differs from the defaults, by the target profile's `matcher`. The errors of an outline last
# half a wing beat, those of its size a quarter of one.
NOISE: Mapping[str, Mapping[str, Any]] = {
    "box": {"noise_px": 0.2, "noise_of_size": 0.01, "noise_s": 0.0, "side_px": 0.3, "side_of_size": 0.01, "misses": 2},
    "upright": {},
    "outline": {"noise_of_size": 0.06, "noise_s": 0.1, "side_of_size": 0.1, "size_s": 0.06},
}


def filter_settings(target: TargetProfile, calibration: Calibration | None = None) -> FilterSettings:
    """Choose the settings for a target profile, with the head's bias from the calibration's covariance.

    Args:
        target: target profile; its motion model and its matcher decide.
        calibration: calibration of the rig; None, or one without covariance, leaves the usual bias.
    """
    motion = replace(MOTIONS[target.motion], nearest=NEAREST_SIZES * target.size)
    if calibration is not None and calibration.zoom_head.T_head_zoom is not None:
        motion = replace(motion, pan_axis=calibration.zoom_head.pan_axis_fixed)
    if calibration is not None and calibration.covariance is not None:
        middle = calibration.fixed.lens.image_center_px
        sigma = float(predicted_pointing(calibration, middle, USUAL_DEPTH)) / math.sqrt(2)  # along one axis
        if np.isfinite(sigma):
            motion = replace(motion, bias_sigma=math.hypot(motion.bias_sigma, sigma))
    return FilterSettings(motion, **NOISE[target.matcher])


STATES = 13
TAN_X, TAN_Y, LOG_DEPTH, VEL_X, VEL_Y, VEL_Z, ACC_X, ACC_Y, ACC_Z, LOG_SIZE, LOG_APPARENT, PAN, TILT = range(STATES)
VELOCITY, ACCELERATION, MOTION = slice(VEL_X, ACC_X), slice(ACC_X, LOG_SIZE), slice(VEL_X, LOG_SIZE)
MOVING = slice(TAN_X, LOG_SIZE)  # position, velocity and acceleration; the other four components drift
SEEN = [TAN_X, TAN_Y, LOG_DEPTH, PAN, TILT]  # components that a measurement in the zoom image depends on
OF_SIZE = np.zeros(STATES)  # derivative of a measured size by the state
OF_SIZE[[LOG_DEPTH, LOG_SIZE, LOG_APPARENT]] = 1.0, -1.0, -1.0
# Below this ratio of time step to time constant, Singer's noise is that of white jerk to better than 2 %, while its
# closed form loses its digits.
SHORT = 0.03
# Largest variance of the logarithm of the depth that widens the noise.
MOST_UNCERTAINTY = 0.5
# Largest variance of the logarithm of the depth, before and however long after it is measured: a factor of some five.
MOST_DEPTH_VARIANCE = 1.5**2
# Least turn rate: what is less is straight to 1e-7 of its way in a second [rad/s].
LEAST_TURN = 1e-3
IDENTITY = np.eye(3)


@functools.lru_cache(maxsize=1024)  # frames come at regular intervals
def transition(dt: float, motion: MotionSettings) -> tuple[Array, Array, Array, float]:
    """Compute the parts of a prediction that depend only on the time step ``dt`` > 0 [s]; cached.

    Returns:
        Linear motion before the division by the new depth, (13, 13), without the acceleration if that turns; covariance
        of position, velocity and acceleration for unit variance of the acceleration, (9, 9); variances that attitude
        and bias gain, (13, 13); what is left of the velocity along the axis.
    """
    tau = motion.manoeuvre_s
    rho = math.exp(-dt / tau)
    gain = -tau * math.expm1(-dt / tau)
    reach = tau * (dt - gain)
    # An unmeasured depth must not run away: its velocity fades, so that its variance stays at the target's speed.
    fade, attitude, bias = (math.exp(-dt / each) for each in (motion.fading_s, motion.attitude_s, motion.bias_s))
    if motion.turns:  # see `_turned`
        reach, gain, rho = 0.0, 0.0, 0.0
    linear = np.diag([*[1.0] * 6, *[rho] * 3, 1.0, attitude, bias, bias])
    for i in range(3):
        linear[i, VEL_X + i], linear[i, ACC_X + i], linear[VEL_X + i, ACC_X + i] = dt, reach, gain
    sigmas = np.zeros(STATES)
    sigmas[LOG_APPARENT:] = motion.attitude_sigma, motion.bias_sigma, motion.bias_sigma
    drift = np.diag(sigmas**2 * (1 - linear.diagonal() ** 2))
    return linear, np.kron(_singer(dt, tau), motion.anisotropy).astype(float), drift, fade


def _turned(x: Array, P: Array, dt: float, tau: float) -> tuple[Array, Array]:
    """Integrate an acceleration that decays and turns with the velocity, at a constant turn rate.

    In the plane of the turn, the acceleration is multiplied by exp((-1 / tau + i |w|) t). The velocity's variance is
    part of the mean of v^2: a target without a certain velocity has no turn.

    Args:
        x: state, (13,).
        P: its covariance, (13, 13).
        dt: time step [s].
        tau: time constant of the acceleration [s].

    Returns:
        What the acceleration adds to position and velocity, and the new acceleration, (9,); its derivatives by velocity
        and acceleration, (9, 6).
    """
    both = x[VEL_X:LOG_SIZE].reshape(2, 3)
    (vv, vc), (_, cc) = (both @ both.T).tolist()
    squared = vv + float(P[VEL_X, VEL_X] + P[VEL_Y, VEL_Y] + P[VEL_Z, VEL_Z])
    along, across, part = vc / squared, cc / squared, vv / squared  # w x c = along c - across v
    turn = max(math.sqrt(max(part * across - along * along, 0.0)), LEAST_TURN)
    pole = complex(-1 / tau, turn)
    decay = cmath.exp(pole * dt)
    gain = (decay - 1) / pole
    reach = (gain - dt) / pole
    by_gain = (dt * decay - gain) / pole  # derivatives by the pole
    by_reach = (by_gain - reach) / pole
    # Of the turn rate's square: factors of v and c in its derivatives by v and by c.
    by_v = (2 * across * (1 - 2 * part) + 4 * along * along) / squared, -2 * along / squared
    by_c = by_v[1], 2 * part / squared
    # Of the additions to position and velocity, and of the new acceleration: factors of v and c; then the factors of v
    # and c in the derivatives of these.
    factors, slopes = [], []
    for factor, slope in ((reach, by_reach), (gain, by_gain), (decay, dt * decay)):
        aside = factor.imag / turn
        factors.append((-aside * across, factor.real + aside * along))
        twice = (slope.real - aside) / (2 * turn * turn)
        of_v, of_c, a = -twice * across, twice * along - slope.imag / (2 * turn), aside / squared
        slopes.append(
            (
                (
                    (2 * a * across + of_v * by_v[0], of_v * by_v[1]),
                    (-2 * a * along + of_c * by_v[0], a + of_c * by_v[1]),
                ),
                ((of_v * by_c[0], -2 * a + of_v * by_c[1]), (a + of_c * by_c[0], of_c * by_c[1])),
            )
        )
    by_both = np.array(factors)
    J = both.T @ np.array(slopes) @ both + by_both[:, :, None, None] * IDENTITY
    return (by_both @ both).ravel(), J.transpose(0, 2, 1, 3).reshape(9, 6)


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
    linear, noise, drift, fade = transition(dt, motion)
    y, F = linear @ x, linear.copy()
    if motion.turns:
        gained, by_moving = _turned(x, P, dt, motion.manoeuvre_s)
        y[MOVING] += gained
        F[MOVING, VEL_X:LOG_SIZE] += by_moving
    y[VEL_Z] *= fade
    F[VEL_Z] *= fade
    closer = 1 + float(y[LOG_DEPTH] - x[LOG_DEPTH])  # new depth over old depth
    ratio = max(closer, min(motion.nearest * math.exp(-x[LOG_DEPTH]), 1.0))
    log_depth = float(x[LOG_DEPTH]) + math.log(ratio)
    y[MOVING] /= ratio
    y[LOG_DEPTH] = log_depth
    y[LOG_APPARENT] += motion.attitude_mean * (1 - linear[LOG_APPARENT, LOG_APPARENT])
    by_closer = F[LOG_DEPTH, VEL_X:LOG_SIZE].copy()
    F[MOVING] /= ratio
    F[LOG_DEPTH] = 0.0
    F[LOG_DEPTH, LOG_DEPTH] = 1.0
    if closer < ratio:  # nearer than possible, so the target has stopped
        y[[VEL_Z, ACC_Z]] = 0.0
    else:
        shrink = y[MOVING] / ratio
        shrink[LOG_DEPTH] = -1 / ratio
        F[MOVING, VEL_X:LOG_SIZE] -= shrink[:, None] * by_closer
    P = F @ P @ F.T + drift
    # Position noise along the axis scales everything that is divided by the depth.
    N = np.eye(LOG_SIZE)
    N[:, LOG_DEPTH] -= y[MOVING]
    N[LOG_DEPTH, LOG_DEPTH] = 1.0
    # The mean of 1 / depth^2 over the depth's distribution: an uncertain depth makes the noise larger.
    squared = math.exp(2 * x[LOG_DEPTH]) * float(x[VELOCITY] @ x[VELOCITY])  # of the speed
    turning = max(squared - (2 * motion.speed) ** 2, 0.0) / motion.turn_m
    widened = math.exp(min(P[LOG_DEPTH, LOG_DEPTH], MOST_UNCERTAINTY) - log_depth)
    sigma = math.hypot(motion.acceleration, turning) * widened
    P[MOVING, MOVING] += N @ noise @ N.T * (noise_scale * sigma * sigma)
    if P[LOG_DEPTH, LOG_DEPTH] > MOST_DEPTH_VARIANCE:  # correlations stay, so the result is still a covariance
        scale = math.sqrt(MOST_DEPTH_VARIANCE / P[LOG_DEPTH, LOG_DEPTH])
        P[LOG_DEPTH] *= scale
        P[:, LOG_DEPTH] *= scale
    return y, P
