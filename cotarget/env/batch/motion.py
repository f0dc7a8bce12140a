"""Motion of many axes at once: trapezoidal speed profiles and commands in flight, as in `cotarget.sim.motion`."""

from typing import Any

import numpy as np
import numpy.typing as npt

from cotarget.geometry import Array

JUMP = 1e6  # speed that stands for a jump, far beyond any axis's; its square is the acceleration


def axis_motion(s: Array, x: Array, v: Array, goal: Array, speed: Array, acceleration: Array) -> tuple[Array, Array]:
    """Position and speed of axes on their fastest way to rest at a goal; see `cotarget.sim.motion.trapezoid`.

    Args:
        s: time since the start [s]; all arrays have shapes that broadcast.
        x: position at the start.
        v: speed at the start.
        goal: position at rest.
        speed: speed limit.
        acceleration: acceleration limit.
    """
    a, half = acceleration, acceleration / 2
    forward = np.abs(v)
    turns = np.sign(v) * a  # of braking
    stop = x + v * forward / (2 * a)
    side = np.where(goal >= stop, 1.0, -1.0)
    away = v * side < 0  # moving away, or unable to stop in time: brake, then start from rest
    brakes = np.where(away, forward / a, 0.0)
    start = np.where(away, stop, x)
    forward = np.where(away, 0.0, forward)
    side = np.where(away, np.where(goal >= start, 1.0, -1.0), side)
    level = np.minimum(forward, speed)
    slows = (forward - level) / a  # the new command has a lower speed limit
    way = np.maximum(side * (goal - start) - (forward * forward - level * level) / (2 * a), 0.0)
    peak = np.minimum(speed, np.sqrt(a * way + level * level / 2))
    peak = np.maximum(peak, level)
    rises, falls = (peak - level) / a, peak / a
    glides = np.maximum(way - (2 * peak * peak - level * level) / (2 * a), 0.0) / np.maximum(peak, 1e-12)
    t = np.maximum(s, 0.0)
    s0 = np.minimum(t, brakes)
    t = t - s0
    s1 = np.minimum(t, slows)
    t = t - s1
    s2 = np.minimum(t, rises)
    t = t - s2
    s3 = np.minimum(t, glides)
    s4 = np.minimum(t - s3, falls)
    gone = forward * s1 - half * s1 * s1 + level * s2 + half * s2 * s2 + peak * (s3 + s4) - half * s4 * s4
    return x + v * s0 - turns * s0 * s0 / 2 + side * gone, v - turns * s0 + side * a * (s2 - s1 - s4)


class Plans:
    """Commands of n rigs with m axes that are in flight or under way.

    A command takes effect at its time and replaces the motion from there on.
    """

    def __init__(self, depth: int, acceleration: Array, at: Array) -> None:
        """Begin at rest.

        Args:
            depth: number of commands that are remembered.
            acceleration: of each axis, (m, n).
            at: position of each axis, (m, n).
        """
        axes, count = at.shape
        self._acceleration, self._row = acceleration, 0
        self._t = np.full((depth, count), np.inf)
        self._numbers = np.zeros((depth, 4, axes, count))  # position, speed, goal and speed limit
        self.restart(np.ones(count, bool), at)

    def restart(self, which: npt.NDArray[Any], at: Array) -> None:
        """Put some rigs, by their indices or a mask (n,), at rest at positions (m, n)."""
        self._t[:, which] = np.inf
        self._t[self._row, which] = -1e9  # before all commands
        for part, value in enumerate((at, 0.0, at, 1.0)):
            self._numbers[self._row, part][:, which] = value[:, which] if isinstance(value, np.ndarray) else value

    def newest(self, t: Array) -> tuple[Array, Array]:
        """Position and speed at times t (n,) after all commands have taken effect, (m, n) each."""
        x, v, goal, speed = self._numbers[self._row]
        return axis_motion(t - self._t[self._row], x, v, goal, speed, self._acceleration)

    def command(self, t: Array, motion: tuple[Array, Array], goal: Array, speed: Array) -> None:
        """Command goals and speed limits, (m, n) each, that take effect at times (n,), where the motion is `newest`."""
        self._row = (self._row + 1) % len(self._t)
        self._t[self._row] = t
        for part, value in enumerate((*motion, goal, speed)):
            self._numbers[self._row, part] = value

    def at(self, t: Array) -> Array:
        """Positions at times t, (..., n): (..., m, n)."""
        row = np.argmax(np.where(self._t <= t[..., None, :], self._t, -np.inf), axis=-2)
        rig = np.arange(self._t.shape[1])
        since = (t - self._t[row, rig])[..., None, :]
        x, v, goal, speed = np.moveaxis(self._numbers[row, :, :, rig], (-2, -1), (0, -2))
        return axis_motion(since, x, v, goal, speed, self._acceleration)[0]
