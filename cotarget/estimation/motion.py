"""The state of one target and how it moves in time: a manoeuvring point, in units of its own depth.

The state is x = (a, b, l, w, c, k, g, pan, tilt), 13 numbers: the tangents a = X/Z and b = Y/Z and the logarithm l of
the depth Z in the fixed camera's frame; velocity w and acceleration c, each divided by the depth (3 + 3); the logarithm
k of the true size over the told one, a constant; the logarithm g of the apparent size over the true one, which attitude
and limbs change; and the head's pointing bias [rad], the true angle less the reported one. The wide view measures a and
b and the size l - k - g, all linearly, and in the motion the depth itself nowhere appears: it only scales the noise. So
bearings can never pretend to have told the depth, whatever the linearisation does (Stallard's modified spherical
coordinates, 1987, in tangents).

The acceleration decays as Singer's (1970), c' = -c / tau + white noise.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np

from cotarget.estimation.settings import MotionSettings
from cotarget.geometry import Array

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
MOST_DOUBT = 0.5  # of the logarithm's variance
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


def propagate(x: Array, P: Array, dt: float, motion: MotionSettings, boost: float = 1.0) -> tuple[Array, Array]:
    """Predict state and covariance ``dt`` >= 0 [s] ahead.

    Args:
        x: state, (13,).
        P: its covariance, (13, 13).
        dt: how far ahead [s].
        motion: how the target moves.
        boost: by what the acceleration's variance is larger than usual.
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
    sigma = motion.acceleration * math.exp(min(P[L, L], MOST_DOUBT) - log_depth)
    P[:MOVING, :MOVING] += N @ span.noise @ N.T * (boost * sigma * sigma)
    return y, _bounded(P)


def _bounded(P: Array) -> Array:
    """Scale what is doubted more than it may be; correlations stay, and with them that it is a covariance."""
    variances = P.diagonal()
    if (variances <= _MOST_VARIANCE).all():
        return P
    scale = np.sqrt(np.minimum(1.0, _MOST_VARIANCE / variances))
    return P * np.outer(scale, scale)
