"""Which of several targets the zoom camera looks at: the paper's first-come, nearest deadline, most served, chosen.

A policy knows tracks of the wide view, what it costs to turn to each, and how long each has been seen well so far. The
two that schedule look at every target for a while and go on to the next (nearest deadline after Costello et al. 2004,
"Scheduling an active camera to observe people"); they differ where not all can be had: the nearest deadline runs after
whoever leaves first, the other plans the order that serves most.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from cotarget.geometry import Array
from cotarget.motionfilter import Track
from cotarget.rig import PanTiltLimits

# A good close-up of a second is what a target should have; some more for what the plan does not know [s].
LOOK_S = 1.2
# From a head that has arrived to a close-up that is good: the lens's travel and a frame [s].
SETTLE_S = 0.6
# An order of more targets than these is not searched whole; those that leave first are taken.
MOST_PLANNED = 7
# A click means the target in whose box it is, or one whose middle is within this part of the image's width.
CLICK_PART = 0.08


@dataclass(frozen=True)
class Candidate:
    """A confirmed track, as a policy sees it.

    Attributes:
        track: in the wide view.
        at: pan and tilt that point at it now, (2,) [rad].
        rate: how fast these change, (2,) [rad/s].
        leaves_in: how long until it leaves the wide view [s]; inf for one that does not.
        seen_s: how long it has been well in the close-up so far [s].
    """

    track: Track
    at: Array
    rate: Array
    leaves_in: float = math.inf
    seen_s: float = 0.0

    @property
    def id(self) -> int:
        """The track's number."""
        return self.track.id


class Policy(Protocol):
    """Chooses whom to follow; told everything at every frame."""

    def select(self, candidates: Sequence[Candidate], head: Array, limits: PanTiltLimits) -> int | None:
        """The number of the track to follow; None for none.

        Args:
            candidates: all confirmed tracks that the head can point at.
            head: pan and tilt now, (2,) [rad].
            limits: the head's speed and acceleration.
        """


@dataclass
class FirstCome:
    """The paper's policy: follow the first target until it disappears, then the next."""

    _id: int | None = None

    def select(self, candidates: Sequence[Candidate], head: Array, limits: PanTiltLimits) -> int | None:
        """The one followed before, if it is still there, or the eldest."""
        ids = [candidate.id for candidate in candidates]
        if self._id not in ids:
            self._id = min(ids, default=None)
        return self._id


@dataclass
class NearestDeadline:
    """Look for a while at whoever leaves first of those that can still be seen, then at the next.

    Attributes:
        look_s: how long each is looked at [s].
    """

    look_s: float = LOOK_S
    _id: int | None = None

    def select(self, candidates: Sequence[Candidate], head: Array, limits: PanTiltLimits) -> int | None:
        """The one followed before until it was seen for long enough; then the next."""
        known = {candidate.id: candidate for candidate in candidates}
        if self._id in known and known[self._id].seen_s < self.look_s:
            return self._id
        waiting = [c for c in candidates if c.seen_s < self.look_s]
        in_time = [c for c in waiting if _end(c, head, 0.0, limits, self.look_s) <= c.leaves_in]
        self._id = min(in_time or waiting, key=lambda c: (c.leaves_in, c.id)).id if waiting else _least_seen(candidates)
        return self._id


@dataclass
class MostServed:
    """Plan the order in which most targets are seen for long enough before they leave.

    Attributes:
        look_s: how long each is looked at [s].
    """

    look_s: float = LOOK_S
    _id: int | None = None

    def select(self, candidates: Sequence[Candidate], head: Array, limits: PanTiltLimits) -> int | None:
        """The first of the best order; the one followed before unless another order serves more."""
        waiting = sorted((c for c in candidates if c.seen_s < self.look_s), key=lambda c: (c.leaves_in, c.id))
        waiting = waiting[:MOST_PLANNED]
        if not waiting:
            self._id = _least_seen(candidates)
            return self._id
        plans = {c.id: self._plan(c, [o for o in waiting if o is not c], head, limits) for c in waiting}
        best = max(plans, key=lambda number: (plans[number], -number))
        if self._id not in plans or plans[best][0] > plans[self._id][0]:
            self._id = best
        return self._id

    def _plan(self, first: Candidate, others: list[Candidate], head: Array, limits: PanTiltLimits) -> tuple[int, float]:
        """How many targets the best order that begins with one serves, and minus when it is over [s]."""
        end = _end(first, head, 0.0, limits, self.look_s, here=first.id == self._id)
        served = int(end <= first.leaves_in)
        if not served:  # nobody waits for what cannot be had
            return 0, -end
        at = first.at + first.rate * end
        return self._best(others, at, end, limits, (served, -end))

    def _best(
        self, left: list[Candidate], at: Array, now: float, limits: PanTiltLimits, so_far: tuple[int, float]
    ) -> tuple[int, float]:
        """The best that can be made of those left, from where the head is then."""
        best = so_far
        for candidate in left:
            end = _end(candidate, at, now, limits, self.look_s)
            if end > candidate.leaves_in:
                continue
            rest = [other for other in left if other is not candidate]
            there = candidate.at + candidate.rate * end
            best = max(best, self._best(rest, there, end, limits, (so_far[0] + 1, -end)))
        return best


@dataclass
class Chosen:
    """Follow what the user chose, by its number or by a click into the wide view, and nothing else.

    Attributes:
        number: of the track.
        pixel: of the click (u, v).
        width_px: of the wide view; a click that far from everything, as a part of it, means nothing.
    """

    number: int | None = None
    pixel: tuple[float, float] | None = None
    width_px: float = math.inf
    _found: int | None = field(default=None, init=False)

    def select(self, candidates: Sequence[Candidate], head: Array, limits: PanTiltLimits) -> int | None:
        """The chosen one while it is there."""
        if self._found is None:
            self._found = self.number if self.pixel is None else self._clicked(candidates, self.pixel)
        return self._found if self._found in {candidate.id for candidate in candidates} else None

    def _clicked(self, candidates: Sequence[Candidate], pixel: tuple[float, float]) -> int | None:
        """The track under a click, or the nearest that is near."""
        off = {c.id: np.abs(c.track.center_px - pixel) for c in candidates}
        inside = [c.id for c in candidates if np.all(off[c.id] <= c.track.size_px / 2)]
        near = inside or [number for number, each in off.items() if np.hypot(*each) <= CLICK_PART * self.width_px]
        return min(near, key=lambda number: float(np.hypot(*off[number])), default=None)


def leaves_in(track: Track, size: tuple[int, int]) -> float:
    """How long until a track's middle leaves an image of (width, height), if it goes on like this [s]."""
    times = []
    for at, speed, side in zip(track.center_px, track.velocity_px, size, strict=True):
        if speed:
            border = side - 0.5 if speed > 0 else -0.5
            times.append((border - at) / speed)
    return float(max(min(times, default=math.inf), 0.0))


def travel_s(way: Array, limits: PanTiltLimits) -> float:
    """How long the head takes from rest to rest over a way in pan and tilt, (2,) [rad], both axes at once [s]."""
    longest = float(np.max(np.abs(way)))
    if longest * limits.acceleration <= limits.speed**2:  # it never reaches its speed
        return 2 * math.sqrt(longest / limits.acceleration)
    return longest / limits.speed + limits.speed / limits.acceleration


def _end(
    candidate: Candidate, head: Array, now: float, limits: PanTiltLimits, look_s: float, *, here: bool = False
) -> float:
    """When a target will have been seen for long enough if it comes next; it moves on meanwhile [s from now].

    Args:
        candidate: the target.
        head: where the head is then, (2,) [rad].
        now: when it sets out [s from now].
        limits: the head's.
        look_s: how long the target is to be seen.
        here: whether the head is at the target already.
    """
    arrival = now
    if not here:
        for _ in range(2):  # the way depends on when the head arrives; the second time is right to a few hundredths
            arrival = now + travel_s(candidate.at + candidate.rate * arrival - head, limits)
        arrival += SETTLE_S
    return arrival + max(look_s - candidate.seen_s, 0.0)


def _least_seen(candidates: Iterable[Candidate]) -> int | None:
    """Who was seen for the shortest time."""
    least = min(candidates, key=lambda c: (c.seen_s, c.id), default=None)
    return None if least is None else least.id
