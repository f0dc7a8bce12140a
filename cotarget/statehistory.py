"""Where head and lens were when a frame was exposed, which is earlier than the newest that their devices have told."""

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass

import numpy as np

from cotarget.geometry import Array
from cotarget.rig import PanTiltState, ZoomState

REMEMBERED_S = 2.0  # more than any latency [s]
# A cubic through the two states before a time and the two after it: the head's acceleration is constant for longer than
# states are apart. Where that changes, it is off by 0.024 degrees for states 40 ms apart, a straight line by 0.041.
POINTS = 4
# States are kept no nearer together than this [s]: through two that are, a cubic shows their rounding many times over.
SPACING_S = 0.01


@dataclass(frozen=True)
class Pose:
    """Head and lens at one time.

    Attributes:
        pan: [rad].
        tilt: [rad].
        nominal_px: what the lens told [px].
        speed: of the head, both axes together [rad/s].
    """

    pan: float
    tilt: float
    nominal_px: float
    speed: float


class StateHistory:
    """The latest states of head and lens, each with its own time."""

    def __init__(self) -> None:
        self._heads: deque[tuple[float, ...]] = deque()
        self._lenses: deque[tuple[float, ...]] = deque()

    def add(self, head: PanTiltState, lens: ZoomState) -> None:
        """Remember what both devices say now; one that says the time of before is ignored."""
        _append(self._heads, (head.t, head.pan, head.tilt))
        _append(self._lenses, (lens.t, math.log(lens.focal_px)))

    def at(self, t: float) -> Pose | None:
        """Head and lens at a time [s]; None for one that is not between states remembered."""
        if not (_spans(self._heads, t) and _spans(self._lenses, t)):
            return None
        near = _around(self._heads, t)
        weights, slopes = _cubic(near[:, 0], t)
        pan, tilt = weights @ near[:, 1:]
        lens = _around(self._lenses, t)
        nominal = math.exp(float(np.interp(t, lens[:, 0], lens[:, 1])))
        return Pose(float(pan), float(tilt), nominal, float(np.hypot(*(slopes @ near[:, 1:]))))


def _append(kept: "deque[tuple[float, ...]]", state: tuple[float, ...]) -> None:
    if kept and state[0] <= kept[-1][0]:
        return
    if len(kept) > 1 and kept[-1][0] - kept[-2][0] < SPACING_S:
        kept.pop()
    kept.append(state)
    while kept[0][0] < state[0] - REMEMBERED_S:
        kept.popleft()


def _spans(kept: "deque[tuple[float, ...]]", t: float) -> bool:
    return bool(kept) and kept[0][0] <= t <= kept[-1][0]


def _around(kept: "deque[tuple[float, ...]]", t: float) -> Array:
    """The states nearest to a time, at most `POINTS`, as rows."""
    after = bisect_right(kept, t, key=lambda state: state[0])
    first = min(max(after - POINTS // 2, 0), max(len(kept) - POINTS, 0))
    return np.array([kept[i] for i in range(first, min(first + POINTS, len(kept)))])


def _cubic(times: Array, t: float) -> tuple[Array, Array]:
    """Weights of values at those times for the value at t and for its derivative there (Lagrange), (n,) each."""
    n = len(times)
    weights, slopes = np.ones(n), np.zeros(n)
    for k in range(n):
        others = [j for j in range(n) if j != k]
        for j in others:
            weights[k] *= (t - times[j]) / (times[k] - times[j])
            product = 1.0 / (times[k] - times[j])
            for i in others:
                if i != j:
                    product *= (t - times[i]) / (times[k] - times[i])
            slopes[k] += product
    return weights, slopes
