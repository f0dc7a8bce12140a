"""Smooth paths through the simulated world.

Paths are in the scene's world: z up, the fixed camera 1.6 m above the origin, looking along +y. A moving target stays
outside the fixed camera's view while the background is learnt, then enters and stays inside.
"""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from cotarget.config import Waypoint
from cotarget.geometry import Array

MOUNT = np.array([0.0, 0.0, 1.6])  # position of the fixed camera in every built-in scene [m]
VIEW_EDGE = np.tan(np.radians(25.0))  # half the width of the fixed camera's view at unit distance
PATH_SECONDS = 600.0  # length of a loop; afterwards one of its last laps is repeated [s]


@dataclass(frozen=True)
class Path:
    """Smooth path through the world.

    Attributes:
        spline: position [m] as a function of time [s].
        length: distance travelled [m] as a function of time [s].
        lap: start and end [s] of a lap that is repeated after its end; None for a path that ends.
    """

    spline: CubicSpline
    length: CubicSpline
    lap: tuple[float, float] | None = None

    def within(self, t: float) -> float:
        """Map a time to one on the spline: inside the repeated lap, or clamped to the path's ends."""
        if self.lap is not None and t > self.lap[1]:
            begin, end = self.lap
            return begin + (t - begin) % (end - begin)
        return min(max(t, self._knots[0]), self._knots[-1])

    def position(self, t: float) -> Array:
        """Give the position at time t [s], (3,) [m]."""
        return np.array(self.motion(t)[0])

    def motion(self, t: float) -> tuple[list[float], list[float], list[float]]:
        """Give position [m], velocity [m/s] and acceleration [m/s^2], (3,) each, as floats, at time t [s].

        Beyond the path's ends, the velocity is that just inside them.
        """
        at, first, last = self.within(t), self._knots[0], self._knots[-1]
        axes, s = self._piece(at)
        x = [((a * s + b) * s + c) * s + d for a, b, c, d in axes]
        acceleration = [6 * a * s + 2 * b for a, b, _, _ in axes]
        inside = 1e-3 * (last - first)
        if not first + inside <= at <= last - inside:
            axes, s = self._piece(min(max(at, first + inside), last - inside))
        return x, [(3 * a * s + 2 * b) * s + c for a, b, c, _ in axes], acceleration

    @cached_property
    def _knots(self) -> list[float]:
        return self.spline.x.tolist()

    @cached_property
    def _pieces(self) -> Array:
        """Coefficients of each cubic piece, highest power first, (pieces, 3, 4)."""
        return np.ascontiguousarray(np.transpose(self.spline.c, (1, 2, 0)))

    def _piece(self, t: float) -> tuple[list[list[float]], float]:
        """Give the cubic piece at a time on the spline, four coefficients an axis, and the time since its start."""
        i = min(bisect_right(self._knots, t) - 1, len(self._pieces) - 1)
        return self._pieces[i].tolist(), t - self._knots[i]

    def travelled(self, t: float) -> float:
        """Give the distance since the path's start at time t [s], [m]."""
        here = float(self.length(self.within(t)))
        if self.lap is None or t <= self.lap[1]:
            return here
        begin, end = self.lap
        return here + (t - begin) // (end - begin) * float(self.length(end) - self.length(begin))


def waypoint_path(waypoints: Sequence[Waypoint]) -> Path:
    """Fit a smooth path through [t, x, y, z] with increasing t, at rest at both ends."""
    table = np.array(waypoints, dtype=float)
    return _measured(CubicSpline(table[:, 0], table[:, 1:], bc_type="clamped"))


def _measured(spline: CubicSpline, lap: tuple[float, float] | None = None) -> Path:
    """Add the distance travelled to a path."""
    first, last = spline.x[0], spline.x[-1]
    t = np.linspace(first, last, max(int((last - first) / 0.05), 50))
    speed = np.linalg.norm(spline(t, 1), axis=1)
    return Path(spline, CubicSpline(t, speed).antiderivative(), lap)


def loop_path(
    loop: Array,
    speed: float,
    spacing: float,
    soften: float,
    lead_in: float = 0.0,
    edge: tuple[float, float] | None = None,
) -> Path:
    """Make a path that follows a closed line at constant speed without end, after an optional straight approach.

    Args:
        loop: closed line, first point not repeated, (N, 3) [m].
        speed: speed along the line [m/s].
        spacing: distance between the path's knots [m].
        soften: length scale over which curvature is smoothed [m].
        lead_in: length of the straight approach, tangent to the loop at its first point [m].
        edge: time [s] at which the target passes the coordinate x [m] on its approach.
    """
    count = int(PATH_SECONDS * speed / spacing)
    line = even(np.vstack([loop, loop[:1]]), spacing)[:-1]
    start = line[1] - line[-1]
    start = start / np.linalg.norm(start)
    laps = np.tile(line, (count // len(line) + 2, 1))
    straight = line[0] - start * np.arange(int(lead_in / spacing), 0, -1)[:, None] * spacing
    points = gaussian_filter1d(np.vstack([straight, laps]), soften / spacing, axis=0, mode="nearest")[:count]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    t = s / speed
    if edge is not None:
        time, x = edge
        way_in = points[: len(straight) + 1, 0]
        inward = np.sign(way_in[-1] - way_in[0])
        t = t + time - np.interp(inward * x, inward * way_in, t[: len(straight) + 1])
    # The last lap but one: smoothing and spline ends do not affect it.
    begin, end = t[-2 * len(line) - 1], t[-len(line) - 1]
    return _measured(CubicSpline(t, points), (float(begin), float(end)))


def even(points: Array, spacing: float) -> Array:
    """Resample a line at about ``spacing``, with both ends kept."""
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0.0, s[-1], round(s[-1] / spacing) + 1)
    return np.stack([np.interp(at, s, points[:, k]) for k in range(3)], axis=1)


def angles(count: int = 720) -> Array:
    """Give angles around a circle, evenly spaced from 0 [rad], (count,)."""
    return np.linspace(0.0, 2 * np.pi, count, endpoint=False)
