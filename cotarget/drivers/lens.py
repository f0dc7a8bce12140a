"""Zoom lenses that are driven by position: which focal length a position has, and where the lens is while it moves."""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class LensTable:
    """What a zoom lens's positions mean.

    Attributes:
        knots: (position, focal length [mm]) of some positions, both increasing; between them the logarithm of the
            focal length is interpolated.
        positions: where the lens can be sent, increasing and within the knots.
        pitch_mm: size of a pixel of the stream [mm].
    """

    knots: tuple[tuple[int, float], ...]
    positions: tuple[int, ...]
    pitch_mm: float

    def focal_at(self, position: float) -> float:
        """Nominal focal length at a position [px]; beyond the knots that of the nearest one."""
        at, mm = zip(*self.knots, strict=True)
        return float(np.exp(np.interp(position, at, np.log(mm)))) / self.pitch_mm

    def position_for(self, focal_px: float) -> int:
        """The nearest position [1] to a nominal focal length [px] that the lens can be sent to."""
        at, mm = zip(*self.knots, strict=True)
        exact = np.interp(np.log(focal_px * self.pitch_mm), np.log(mm), at)
        return min(self.positions, key=lambda position: abs(position - exact))

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest nominal focal length [px] that the lens can be sent to."""
        return self.focal_at(self.positions[0]), self.focal_at(self.positions[-1])


@dataclass(frozen=True)
class LensMotion:
    """Where a lens is, by its own speed: for devices that do not tell.

    Attributes:
        start: position at the start of the motion.
        goal: position at its end.
        t: when it starts [s].
        speed: positions a second.
        before: what the lens did until then; None for a lens that stood.
    """

    start: float
    goal: float
    t: float
    speed: float
    before: "LensMotion | None" = None

    def position(self, t: float) -> float:
        """Where the lens is at a time [s]."""
        if t < self.t:
            return self.start if self.before is None else self.before.position(t)
        way = self.speed * (t - self.t)
        return (
            self.goal if way >= abs(self.goal - self.start) else self.start + np.copysign(way, self.goal - self.start)
        )

    @property
    def arrives(self) -> float:
        """When the lens stands at its goal [s]."""
        return self.t + abs(self.goal - self.start) / self.speed

    def toward(self, goal: float, t: float) -> "LensMotion":
        """The motion of a lens that heads for another goal from a time on [s]."""
        return LensMotion(self.position(t), goal, t, self.speed, replace(self, before=None))
