"""What the boxes of the last seconds tell: a target's usual size, its largest, and how far it has come."""

import math
import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from cotarget.geometry import Array

# The larger side over a wing beat is that of which this part is smaller: the maximum, but deaf to one frame in ten that
# is wrong.
BEAT_PART = 0.9
# Where a target was and is, is the median of so many boxes, at most this part of all: an outline flickers.
ENDS, END_PART = 3, 1 / 3
# A way of which one step makes up more than this part was not gone but jumped: to another thing's outline.
LARGEST_STEP = 2 / 3
# A step that is no longer than this is no jump: an outline is of whole pixels, and flickers [px].
LEAST_JUMP_PX = 3.0
# An edge this near to the image's border may lie beyond it [px].
BORDER_PX = 0.5


Edges = tuple[float, float]


class SizeHistory:
    """The sizes of the last boxes.

    Attributes:
        size: usual width and height [px], (2,).
        larger_side: larger side over the last wing beats [px].
    """

    def __init__(self, size_s: float, beat_s: float) -> None:
        """Begin with no box.

        Args:
            size_s: over so long the usual size is taken [s].
            beat_s: over so long the larger side [s].
        """
        self._size_s, self._beat_s = size_s, beat_s
        self._boxes: deque[_Sides] = deque()
        self.size: Array = np.zeros(2)
        self.larger_side = 0.0

    def note(self, t: float, width: float, height: float, clipped: bool) -> None:
        """Remember a box, and work out the sizes anew.

        Args:
            t: when it was seen [s].
            width: of the box [px].
            height: of the box [px].
            clipped: whether the image's border cuts it.
        """
        boxes = self._boxes
        boxes.append(_Sides(t, width, height, clipped))
        while boxes[0].t < t - max(self._size_s, self._beat_s):
            boxes.popleft()
        # The border makes boxes smaller: those that it did not cut count, or else the largest of those it did.
        recent = [box for box in boxes if box.t >= t - self._size_s]
        whole = [box for box in recent if not box.clipped]
        middle = statistics.median if whole else max
        sides = [box.width for box in whole or recent], [box.height for box in whole or recent]
        self.size = np.array([middle(each) for each in sides])
        recent = [box for box in boxes if box.t >= t - self._beat_s]
        beat = [box for box in recent if not box.clipped] or recent
        self.larger_side = _quantile([max(box.width, box.height) for box in beat], BEAT_PART)


@dataclass(frozen=True, slots=True)
class _Sides:
    """Width and height of a box at a time [s], and whether the image's border cut it."""

    t: float
    width: float
    height: float
    clipped: bool


class Trail:
    """The way that the last boxes have come."""

    def __init__(self, span_s: float, image_size: tuple[int, int] | None = None) -> None:
        """Begin with no box.

        Args:
            span_s: how far back it goes [s].
            image_size: (width, height) [px]; with it a box that its border cuts tells its way by its other edges.
        """
        self._span_s = span_s
        self._extents = image_size or (None, None)
        self._boxes: deque[_Place] = deque()

    def note(self, t: float, center: tuple[float, float], size: tuple[float, float], clipped: bool) -> None:
        """Remember a box.

        Args:
            t: when it was seen [s].
            center: its middle (u, v) [px].
            size: its width and height [px].
            clipped: whether the image's border cuts it.
        """
        across, down = (_edges(*of, clipped) for of in zip(center, size, self._extents, strict=True))
        step = _way([self._boxes[-1].edges], [(across, down)]) if self._boxes else 0.0
        self._boxes.append(_Place(t, (across, down), step))
        while self._boxes[0].t < t - self._span_s:
            self._boxes.popleft()

    def travel(self) -> float:
        """How far the target has come, edge by edge [px]; 0 where it jumped there.

        A thing that comes has both its edges come the same way. A cloud or a shadow that drifts slowly behind others
        grows, shrinks and falls apart, and takes its middle with it; an edge or two stay.
        """
        edges = [box.edges for box in self._boxes]
        count = max(1, min(ENDS, int(END_PART * len(edges))))
        way = _way(edges[:count], edges[-count:])
        longest = max((box.step for box in islice(self._boxes, 1, None)), default=0.0)
        return way if longest <= max(LARGEST_STEP * way, LEAST_JUMP_PX) else 0.0


@dataclass(frozen=True, slots=True)
class _Place:
    """A box's edges along u and v at a time [s], and how long the step was that led there [px]."""

    t: float
    edges: tuple[Edges, Edges]
    step: float


def _edges(center: float, size: float, extent: int | None, clipped: bool) -> Edges:
    """Where a box begins and ends along one axis [px]; nan for an edge beyond the border of an image so wide."""
    low, high = center - size / 2, center + size / 2
    if not clipped or extent is None:
        return low, high
    return low if low > BORDER_PX else math.nan, high if high < extent - 1 - BORDER_PX else math.nan


def _way(before: Sequence[tuple[Edges, Edges]], after: Sequence[tuple[Edges, Edges]]) -> float:
    """How far both edges of some boxes have moved the same way [px]; one alone where the other was not seen."""
    return math.hypot(*(_shift([box[i] for box in before], [box[i] for box in after]) for i in range(2)))


def _shift(before: Sequence[Edges], after: Sequence[Edges]) -> float:
    """That along one axis."""
    moved = []
    for i in range(2):
        was = [edges[i] for edges in before if not math.isnan(edges[i])]
        now = [edges[i] for edges in after if not math.isnan(edges[i])]
        if was and now:
            moved.append(statistics.median(now) - statistics.median(was))
    if not moved or min(moved) < 0 < max(moved):
        return 0.0
    return min(map(abs, moved))


def _quantile(values: Sequence[float], part: float) -> float:
    """The value of which a part of others is smaller, linearly between two; numpy's takes forty times as long."""
    ordered = sorted(values)
    at = part * (len(ordered) - 1)
    low = int(at)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (at - low) * (ordered[high] - ordered[low])
