"""The state of one target and how it moves in time: a manoeuvring point, in units of its own depth.

The state is x = (a, b, l, w, c, k, g, pan, tilt), 13 numbers: the tangents a = X/Z and b = Y/Z and the logarithm l of
the depth Z in the fixed camera's frame; velocity w and acceleration c, each divided by the depth (3 + 3); the logarithm
k of the true size over the told one, a constant; the logarithm g of the apparent size over the true one, which attitude
and limbs change; and the head's pointing bias [rad], the true angle less the reported one. The wide view measures a and
b and the size l - k - g, all linearly, and in the motion the depth itself nowhere appears: it only scales the noise. So
bearings can never pretend to have told the depth, whatever the linearisation does (Stallard's modified spherical
coordinates, 1987, in tangents).

The acceleration decays as Singer's (1970), c' = -c / tau + white noise.

What is assumed of a target and of the rig before anything is measured, for each kind of target.

Accelerations and time constants were chosen on simulated tracks, by the error of the prediction 0.2 and 0.6 s ahead as
long as its covariance stayed honest; `cotarget.estimation` says against what.
"""

import functools
import math
from dataclasses import dataclass, field, replace

import numpy as np

from cotarget.calibration import Calibration, predicted_pointing
from cotarget.config import TargetConfig
from cotarget.geometry import Array

# What the head's rounding, its play and the middle of a box leave of bias, whatever the calibration says [rad].
LEAST_BIAS = 5e-4
# The bias of a rig whose calibration does not say how good it is: 0.04 degrees [rad].
USUAL_BIAS = 7e-4
# Nearer than this many of its own sizes a target spans more than a right angle: it fills the view of any lens that the
# fixed camera is likely to have, and no pointing at it helps.
NEAREST_SIZES = 0.5
USUAL_DEPTH = 15.0  # [m]; a target whose size is not seen, at first


@dataclass(frozen=True)
class Jump:
    """How a target moves that was found elsewhere than it could be: a hand carries it, or it was mistaken.

    Attributes:
        speed: standard deviation, across the line of sight, of its velocity when it is found [m/s]
        acceleration: ... and of its acceleration [m/s^2], then and ...
        seconds: ... for so long: whoever carries it speeds up and brakes [s].
        by_hand_s: how long an acceleration lasts meanwhile of what is carried by hand [s]; None of what goes by itself,
            of which they last as long as always.
    """

    speed: float = 3.0
    acceleration: float = 10.0
    seconds: float = 1.5
    by_hand_s: float | None = None


@dataclass(frozen=True)
class MotionSettings:
    """How a target moves, and how slowly what is unknown about it and the head changes.

    Attributes:
        acceleration: standard deviation of the acceleration along each axis [m/s^2].
        manoeuvre_s: how long an acceleration lasts [s]; much less than between frames makes the velocity a random
            walk ("constant velocity"), much more the acceleration constant.
        speed: standard deviation of the velocity along each axis [m/s].
        size_sigma: of the true size over the told one, relative; constant for one target.
        attitude_mean: of the logarithm of the apparent size over the true one; negative where it is foreshortened.
        attitude_sigma: its standard deviation.
        attitude_s: how long an attitude lasts [s].
        bias_sigma: of the head's pan and tilt each [rad].
        bias_s: how long such a bias lasts [s].
        nearest: no target is nearer to the fixed camera than this, along its axis [m].
        jump: how it moves when it was found elsewhere than it could be.
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
        """The time constant of a velocity that its own acceleration then holds at the speed above [s]."""
        return self.speed**2 / (self.acceleration**2 * self.manoeuvre_s) + self.manoeuvre_s


@dataclass(frozen=True)
class EstimationSettings:
    """How a target moves, how well it is measured, and what is done about measurements that do not fit.

    Attributes:
        motion: how it moves.
        noise_px: standard deviation of the middle of a box in the wide view that does not depend on its size [px].
        noise_of_size: the part that does, as a fraction of the box's side (limbs and wings that move).
        noise_s: how long an error of that middle lasts [s].
        size_noise: standard deviation of a box's side, relative.
        size_noise_px: the part that does not depend on its size [px].
        size_s: how long an error of the side lasts [s]; half a wing beat or step.
        unsized_s: how long a velocity along the axis lasts while the wide view shows a piece of the target only [s]:
            long enough for a moment behind a post; whoever fills the view has mostly stopped.
        head_sigma: of the angles that the head reports for a frame [rad]; rounding of 0.05 degrees leaves that.
        gate: largest squared innovation, in variances, of a middle; 99.9 % of a chi-square with two degrees of freedom.
        jump_gate: beyond this it is either wrong or elsewhere: ten standard deviations. Between the two it counts less.
        size_gate: likewise of a size; 99.7 % with one.
        misses: so many measurements beyond jump_gate on end are believed.
        zoom_misses: likewise in the zoom view, while the wide view has no surprise: then size or head is doubted.
        consistent_nis: a mean surprise below which the wide view counts as having none.
        mean_innovation_gain: weight of the newest innovation in the zoom view in their mean, in standard deviations.
        most_mean_innovation: largest such mean; beyond it size and head are doubted too. Of white noise it is 0.23 for
        each axis.
        depth_sigma: of the depth's logarithm, before a size is seen.
        depth_inflation: what is added to it where the target has jumped, or looks of quite another size.
        size_inflation: what is added to the sigma of size and depth together, where the zoom view contradicts them.
        bias_inflation: what is then added to the sigma of the head's bias [rad].
        nis_gain: weight of the newest measurement in the mean surprise.
        most_noise_scale: most by which surprise multiplies the acceleration's variance.
        history_s: how late a measurement may come after the newest one [s].
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
        """By what the acceleration's variance is larger than usual where it was found elsewhere."""
        return max(1.0, (self.motion.jump.acceleration / self.motion.acceleration) ** 2)

    @functools.cached_property
    def jump_motion(self) -> MotionSettings:
        """How it moves when it was found elsewhere, the larger acceleration aside."""
        by_hand_s = self.motion.jump.by_hand_s
        return self.motion if by_hand_s is None else replace(self.motion, manoeuvre_s=by_hand_s)


# A hand that reaches somewhere speeds up and brakes within a second or so.
HAND = Jump(acceleration=5.0, seconds=1.25, by_hand_s=0.15)
BOOK = EstimationSettings(
    MotionSettings(0.5, 0.5, 0.7, 0.01, attitude_sigma=0.01, attitude_s=2.0, jump=HAND),
    noise_px=0.2,
    noise_of_size=0.01,
    noise_s=0.0,
    size_noise=0.01,
    size_noise_px=0.3,
    misses=2,
)
PERSON = EstimationSettings(MotionSettings(0.8, 0.7, 1.2, 0.04))
# The larger side of a bird's box is anything from its body's length to its wingspan.
BIRD = EstimationSettings(
    MotionSettings(6.5, 2.5, 7.0, 0.075, attitude_mean=-0.35, attitude_sigma=0.3, attitude_s=1.0),
    noise_of_size=0.06,
    noise_s=0.1,  # half a wing beat
    size_noise=0.1,
    size_s=0.06,  # a quarter of a wing beat
)
# How a target moves that is told to stand (but for being carried elsewhere), walk or fly.
KINDS = {"standing": BOOK, "walking": PERSON, "flying": BIRD}


def estimation_settings_for(target: TargetConfig, calibration: Calibration | None = None) -> EstimationSettings:
    """Choose the settings for a target's kind; a calibration that knows its own error gives the head's bias.

    How well it is measured, and in what attitudes it shows itself, follows from its detector and dimension; how it
    moves does too, unless that is told.

    Args:
        target: the target.
        calibration: of the rig.
    """
    settings = PERSON
    if target.detector == "colour":
        settings = BOOK
    elif target.dimension == "wingspan":
        settings = BIRD
    told = settings.motion if target.motion is None else KINDS[target.motion].motion
    motion = replace(
        settings.motion,
        acceleration=told.acceleration,
        manoeuvre_s=told.manoeuvre_s,
        speed=told.speed,
        jump=told.jump,
        nearest=NEAREST_SIZES * target.size,
    )
    settings = replace(settings, motion=motion)
    if calibration is None or calibration.covariance is None:
        return settings
    middle = calibration.fixed.image_center_px
    sigma = float(predicted_pointing(calibration, middle, USUAL_DEPTH)) / math.sqrt(2)  # of one axis
    if not np.isfinite(sigma):
        return settings
    return replace(settings, motion=replace(settings.motion, bias_sigma=math.hypot(LEAST_BIAS, sigma)))


STATES = 13
MOVING = 9  # the first of them move; the rest drift
A, B, L, K, G, PAN, TILT = 0, 1, 2, 9, 10, 11, 12
W, C = slice(3, 6), slice(6, 9)
SEEN = [A, B, L, PAN, TILT]  # what the zoom view depends on
# A target comes no nearer in one prediction than this part of its depth, whatever its velocity is thought to be.
NEAREST = 0.2
# Below this part of the acceleration's time constant, Singer's noise is that of white jerk to better than 2 %, while
# its closed form loses its digits.
SHORT = 0.03
_UNIT = np.eye(MOVING)
MOST_UNCERTAINTY = 0.5  # of the logarithm's variance
# However long nothing is measured, no more is doubted than this, in standard deviations: that it is anywhere in view, a
# factor of some five in the depth, three in size and attitude, and six degrees of the head.
MOST_SIGMA = np.array([3.0, 3.0, 1.5, *[1e2] * 3, *[1e3] * 3, 1.0, 1.0, 0.1, 0.1])
_MOST_VARIANCE = MOST_SIGMA**2
CACHED = 1024  # spans of time; frames come at regular ones


@dataclass(frozen=True)
class Span:
    """What depends on the span of time alone.

    Attributes:
        linear: the motion before it is divided by the new depth, (13, 13).
        noise: of position, velocity and acceleration for a unit variance of the acceleration, (9, 9).
        drift: variances that size and bias gain, (13, 13).
        dt: the span [s].
        reach: what an acceleration adds to the position [s^2].
    """

    linear: Array
    noise: Array
    drift: Array
    dt: float
    reach: float


@functools.lru_cache(maxsize=CACHED)
def span_of(dt: float, motion: MotionSettings) -> Span:
    """Work out a span of time ``dt`` > 0 [s]."""
    tau = motion.manoeuvre_s
    rho = math.exp(-dt / tau)
    gain = -tau * math.expm1(-dt / tau)
    reach = tau * (dt - gain)
    # A depth that is not measured must not run away: its velocity fades, so that it keeps within the target's speed.
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
    """Covariance of (position, velocity, acceleration) after ``dt`` for a unit variance of the acceleration, (3, 3)."""
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
        P: its covariance, (13, 13).
        dt: how far ahead [s].
        motion: how the target moves.
        noise_scale: by what the acceleration's variance is larger than usual.
    """
    if dt <= 0:
        return x, P
    span = span_of(dt, motion)
    closer = 1 + float(x[5]) * dt + float(x[8]) * span.reach  # the new depth over the old one
    ratio = max(closer, NEAREST, min(motion.nearest * math.exp(-x[L]), 1.0))
    y = span.linear @ x
    log_depth = float(x[L]) + math.log(ratio)
    y[:MOVING] /= ratio
    y[L] = log_depth
    y[G] += motion.attitude_mean * (1 - span.linear[G, G])
    if closer < ratio:  # it would be nearer than it can be: it has stopped
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
    # Noise of the position along the axis scales all that is divided by the depth.
    N = _UNIT.copy()
    N[:, L] -= y[:MOVING]
    N[L, L] = 1.0
    # The mean of 1 / depth^2 over all depths that it may have: an uncertain depth makes the noise larger.
    sigma = motion.acceleration * math.exp(min(P[L, L], MOST_UNCERTAINTY) - log_depth)
    P[:MOVING, :MOVING] += N @ span.noise @ N.T * (noise_scale * sigma * sigma)
    return y, _bounded(P)


def _bounded(P: Array) -> Array:
    """Scale what is doubted more than it may be; correlations stay, and with them that it is a covariance."""
    variances = P.diagonal()
    if (variances <= _MOST_VARIANCE).all():
        return P
    scale = np.sqrt(np.minimum(1.0, _MOST_VARIANCE / variances))
    return P * np.outer(scale, scale)
