"""Zoom lenses that are driven by position: focal length of a position, and estimated position during a motion."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class LensPositions:
    """Focal lengths of a zoom lens's positions.

    Attributes:
        knots: (position, focal length [mm]), both increasing; the logarithm of the focal length is interpolated.
        positions: positions to which the lens can be sent, increasing and within the knots.
        pitch_mm: size of a pixel of the stream [mm]; 1 for focal lengths of knots in pixels.
    """

    knots: tuple[tuple[float, float], ...]
    positions: Sequence[float]
    pitch_mm: float = 1.0

    def focal_at(self, position: float) -> float:
        """Return the nominal focal length [px] at a position; beyond the knots that of the nearest one."""
        at, mm = zip(*self.knots, strict=True)
        return float(np.exp(np.interp(position, at, np.log(mm)))) / self.pitch_mm

    def position_for(self, focal_px: float) -> float:
        """Return the position [1] nearest to a nominal focal length [px], of those that the lens can be sent to."""
        at, mm = zip(*self.knots, strict=True)
        exact = np.interp(np.log(focal_px * self.pitch_mm), np.log(mm), at)
        above = bisect_left(self.positions, exact)
        return min(self.positions[max(above - 1, 0) : above + 1], key=lambda position: abs(position - exact))

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest nominal focal length [px] of the positions."""
        return self.focal_at(self.positions[0]), self.focal_at(self.positions[-1])


@dataclass(frozen=True)
class LensMotion:
    """Estimated motion of a lens at constant speed, for devices that do not report its position.

    Attributes:
        start: position at the start.
        goal: position at the end.
        t: start time [s].
        speed: [positions/s].
        before: motion until the start; None for a lens that stood.
    """

    start: float
    goal: float
    t: float
    speed: float
    before: "LensMotion | None" = None

    def position(self, t: float) -> float:
        """Return the position at a time [s]."""
        if t < self.t:
            return self.start if self.before is None else self.before.position(t)
        way = self.speed * (t - self.t)
        return (
            self.goal if way >= abs(self.goal - self.start) else self.start + np.copysign(way, self.goal - self.start)
        )

    @property
    def arrives(self) -> float:
        """Time at which the lens arrives at its goal [s]."""
        return self.t + abs(self.goal - self.start) / self.speed

    def toward(self, goal: float, t: float) -> "LensMotion":
        """Return the motion to another goal that starts at a time [s]."""
        return LensMotion(self.position(t), goal, t, self.speed, replace(self, before=None))
