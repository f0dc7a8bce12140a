"""In which order targets are looked at: when each would have been seen for long enough, and what serves most."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from cotarget.geometry import Array
from cotarget.motionfilter import Track
from cotarget.rig import Angles, PanTiltLimits

# A good close-up of a second is what a target should have; some more for what the plan does not know [s].
LOOK_S = 1.2
# From a head that has arrived to a close-up that is good: the lens's travel and a frame [s].
SETTLE_S = 0.6
# An order of more targets than these is not searched whole, which takes some 3 ms for these; those that leave first
# are taken.
MOST_PLANNED = 7
# How fast a target goes round the head is taken over this time [s].
RATE_S = 0.1


@dataclass(frozen=True)
class Candidate:
    """A confirmed track, as a policy sees it; where it is, is worked out for those policies that ask.

    Attributes:
        track: in the wide view.
        where: gives pan and tilt that point at it so many seconds from now, (2,) [rad].
        leaves_in: how long until it leaves the wide view [s]; inf for one that does not.
        seen_s: how long it has been well in the close-up so far [s].
        reachable: whether the head can point at it.
        likely: whether both views together make it what was told; so does whoever was not looked at yet.
    """

    track: Track
    where: Callable[[float], Array]
    leaves_in: float = math.inf
    seen_s: float = 0.0
    reachable: bool = True
    likely: bool = True

    @property
    def id(self) -> int:
        """The track's number."""
        return self.track.id

    @cached_property
    def at(self) -> Array:
        """Pan and tilt that point at it now, (2,) [rad]."""
        return self.where(0.0)

    @cached_property
    def rate(self) -> Array:
        """How fast these change, (2,) [rad/s]."""
        return (self.where(RATE_S) - self.at) / RATE_S

    def after(self, seconds: float) -> Angles:
        """Pan and tilt that point at it so many seconds from now if it goes on like this [rad]."""
        (pan, tilt), (pan_rate, tilt_rate) = self._line
        return pan + pan_rate * seconds, tilt + tilt_rate * seconds

    @cached_property
    def _line(self) -> tuple[Angles, Angles]:
        """Where it is and how fast it goes, in plain numbers, which a plan asks for thousands of times."""
        (pan, tilt), (pan_rate, tilt_rate) = self.at.tolist(), self.rate.tolist()
        return (pan, tilt), (pan_rate, tilt_rate)


@dataclass(frozen=True)
class Outlook:
    """What an order is made from.

    Attributes:
        waiting: those not seen for long enough yet; who leaves first comes first.
        current: the number of the track followed before.
        head: pan and tilt now [rad].
        limits: the head's.
        look_s: how long each is looked at [s].
    """

    waiting: Sequence[Candidate]
    current: int | None
    head: Angles
    limits: PanTiltLimits
    look_s: float


class Plan(NamedTuple):
    """The best order: how many targets it serves, when it is over [s from now], and the number of the first."""

    served: int
    end: float
    first: int


def plan(outlook: Outlook) -> Plan:
    """The order that serves most before they leave, and is over first; if nobody can be had, who would be done first.

    Of orders of the same targets with the same one last only the one over first is gone on with: whoever sets out
    earlier from the same target is nowhere later (dynamic programming after Held and Karp 1962).
    """
    planned = outlook.waiting[:MOST_PLANNED]
    alone = [(done_in(c, outlook, outlook.head, 0.0), c) for c in planned]
    orders = {(1 << i, i): Plan(1, end, c.id) for i, (end, c) in enumerate(alone) if end <= c.leaves_in}
    best = max(orders.values(), key=_worth, default=None)
    while orders:
        longer: dict[tuple[int, int], Plan] = {}
        for (done, last), order in orders.items():
            there = planned[last].after(order.end)
            for i, candidate in enumerate(planned):
                if done >> i & 1:
                    continue
                end = done_in(candidate, outlook, there, order.end)
                if end > candidate.leaves_in:  # nobody waits for what cannot be had
                    continue
                key, found = (done | 1 << i, i), Plan(order.served + 1, end, order.first)
                if key not in longer or _worth(found) > _worth(longer[key]):
                    longer[key] = found
        orders = longer
        best = max(orders.values(), key=_worth, default=best)
    if best is None:
        end, first = min(alone, key=lambda each: (each[0], each[1].id))
        return Plan(0, end, first.id)
    return best


def _worth(order: Plan) -> tuple[int, float, int]:
    """What makes an order better than another."""
    return order.served, -order.end, -order.first


def travel_s(way: Angles, limits: PanTiltLimits) -> float:
    """How long the head takes from rest to rest over a way in pan and tilt [rad], both axes at once [s]."""
    longest = max(abs(way[0]), abs(way[1]))
    if math.isinf(limits.acceleration):  # at its speed at once, or there at once
        return longest / limits.speed
    if longest * limits.acceleration <= limits.speed**2:  # it never reaches its speed
        return 2 * math.sqrt(longest / limits.acceleration)
    return longest / limits.speed + limits.speed / limits.acceleration


def done_in(candidate: Candidate, outlook: Outlook, head: Angles, now: float) -> float:
    """When a target will have been seen for long enough if it comes next; it moves on meanwhile [s from now].

    Args:
        candidate: the target.
        outlook: gives the head's limits, and who is looked at already.
        head: pan and tilt then [rad].
        now: when it sets out [s from now].
    """
    arrival = now
    if now > 0 or candidate.id != outlook.current:  # the head is not there already
        for _ in range(2):  # the way depends on when the head arrives; the second time is right to a few hundredths
            pan, tilt = candidate.after(arrival)
            arrival = now + travel_s((pan - head[0], tilt - head[1]), outlook.limits)
        arrival += SETTLE_S
    return arrival + max(outlook.look_s - candidate.seen_s, 0.0)
