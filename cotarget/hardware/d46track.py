"""Where the axes of a PTU-D46 are, from polls one after the other, and whether they turn."""

from collections import deque
from dataclasses import dataclass

from cotarget.hardware.d46 import AxisName
from cotarget.hardware.d46unit import AxisFacts

# An axis stands when it has stayed at one step for longer than the slowest speed, 31 steps/s, takes for a step [s].
STILL_S = 0.035


@dataclass(frozen=True)
class Snapshot:
    """Where the axes were at one time [steps, s]; between two polls of an axis it is taken to turn evenly."""

    pan: float
    tilt: float
    moving: bool
    t: float


class Track:
    """What is known of one axis from polls and orders."""

    def __init__(self, name: AxisName, facts: AxisFacts) -> None:
        self.name, self.facts = name, facts
        self.polls: deque[tuple[float, int]] = deque(maxlen=2)
        self.goal: int | None = None  # as last ordered, None after a halt
        self.speed: int | None = None  # the same
        self._valid = -float("inf")
        self._since: float | None = None

    @property
    def position(self) -> int:
        """The newest [steps]."""
        return self.polls[-1][1]

    def add(self, t: float, position: int) -> None:
        """Take a poll into account."""
        if t < self._valid:
            self._since = None
        elif self._since is None or position != self.position:
            self._since = t
        self.polls.append((t, position))

    def expect_motion(self, t: float) -> None:
        """Count it as turning, until polls after ``t`` [s] show that it stands."""
        self._valid, self._since = t, None

    def stands(self) -> bool:
        """Whether it has stayed at one step for long enough."""
        return self._since is not None and self.polls[-1][0] - self._since >= STILL_S

    def at(self, t: float) -> float:
        """Position at a time between the last two polls [steps]."""
        (t0, x0), (t1, x1) = self.polls[0], self.polls[-1]
        share = (t - t0) / (t1 - t0) if t1 > t0 else 1.0
        return x0 + (x1 - x0) * min(max(share, 0.0), 1.0)
