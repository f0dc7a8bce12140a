"""The Kalman filter of one coordinate in the image and its velocity, driven by white acceleration.

In floats: numpy takes ten times as long for so few numbers, and every track of a frame has two of these.
"""

from dataclasses import dataclass

import numpy as np

from cotarget.geometry import Array


@dataclass(frozen=True)
class Spread:
    """Covariance of a coordinate and its velocity.

    Attributes:
        at: variance of the coordinate [px^2].
        both: covariance of the two [px^2/s].
        speed: variance of the velocity [px^2/s^2].
    """

    at: float
    both: float
    speed: float

    def after(self, dt: float, noise: float) -> "Spread":
        """What it grows to over ``dt`` [s], forward or back, by white acceleration [px^2/s^3]."""
        span = abs(dt)
        return Spread(
            self.at + dt * (2 * self.both + dt * self.speed) + noise * span**3 / 3,
            self.both + dt * self.speed + noise * dt * span / 2,
            self.speed + noise * span,
        )


def covariance_of(u: Spread, v: Spread) -> Array:
    """Covariance of (u, v, du, dv), (4, 4)."""
    return np.array(
        [[u.at, 0.0, u.both, 0.0], [0.0, v.at, 0.0, v.both], [u.both, 0.0, u.speed, 0.0], [0.0, v.both, 0.0, v.speed]]
    )


class AxisFilter:
    """A coordinate [px] and its velocity [px/s]."""

    def __init__(self, at: float, variance: float, speed_variance: float) -> None:
        self.at, self.speed = at, 0.0
        self.spread = Spread(variance, 0.0, speed_variance)

    def predict(self, dt: float, noise: float) -> None:
        """Move on by ``dt`` [s] with white acceleration [px^2/s^3]."""
        self.at += dt * self.speed
        self.spread = self.spread.after(dt, noise)

    def correct(self, measured: float, variance: float) -> None:
        """Take a measurement [px] with its variance [px^2] into account."""
        P = self.spread
        S = P.at + variance
        innovation, gain, speed_gain = measured - self.at, P.at / S, P.both / S
        self.at += gain * innovation
        self.speed += speed_gain * innovation
        self.spread = Spread(P.at - gain * P.at, P.both - gain * P.both, P.speed - speed_gain * P.both)
