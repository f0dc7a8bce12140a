"""Which of several targets the zoom camera looks at: the paper's first-come, nearest deadline, most served, chosen.

A policy knows tracks of the wide view, what it costs to turn to each, and how long each has been seen well so far. The
two that schedule look at every target for a while and go on to the next (nearest deadline after Costello et al. 2004,
"Scheduling an active camera to observe people"); they differ where not all can be had: the nearest deadline runs after
whoever leaves first, the other plans the order that serves most.

In which order targets are looked at: when each would have been seen for long enough, and what serves most.

Which of several targets a run follows, as a recording keeps it and the commands' options say it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple, Protocol

import numpy as np

from cotarget.geometry import Array
from cotarget.rig import Angles, PanTiltLimits
from cotarget.tracking.track import Track

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
class SelectionState:
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


def plan(state: SelectionState) -> Plan:
    """The order that serves most before they leave, and is over first; if nobody can be had, who would be done first.

    Of orders of the same targets with the same one last only the one over first is gone on with: whoever sets out
    earlier from the same target is nowhere later (dynamic programming after Held and Karp 1962).
    """
    planned = state.waiting[:MOST_PLANNED]
    alone = [(done_in(c, state, state.head, 0.0), c) for c in planned]
    orders = {(1 << i, i): Plan(1, end, c.id) for i, (end, c) in enumerate(alone) if end <= c.leaves_in}
    best = max(orders.values(), key=_worth, default=None)
    while orders:
        longer: dict[tuple[int, int], Plan] = {}
        for (done, last), order in orders.items():
            there = planned[last].after(order.end)
            for i, candidate in enumerate(planned):
                if done >> i & 1:
                    continue
                end = done_in(candidate, state, there, order.end)
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


def done_in(candidate: Candidate, state: SelectionState, head: Angles, now: float) -> float:
    """When a target will have been seen for long enough if it comes next; it moves on meanwhile [s from now].

    Args:
        candidate: the target.
        state: gives the head's limits, and who is looked at already.
        head: pan and tilt then [rad].
        now: when it sets out [s from now].
    """
    arrival = now
    if now > 0 or candidate.id != state.current:  # the head is not there already
        for _ in range(2):  # the way depends on when the head arrives; the second time is right to a few hundredths
            pan, tilt = candidate.after(arrival)
            arrival = now + travel_s((pan - head[0], tilt - head[1]), state.limits)
        arrival += SETTLE_S
    return arrival + max(state.look_s - candidate.seen_s, 0.0)


# --- whom ---


@dataclass(frozen=True)
class TargetChoice:
    """Which of several targets a run follows: one of these, or the first that comes where nothing is said.

    Attributes:
        policy: its name, of `cotarget.control.selection.POLICIES`.
        click: the target at this pixel of the wide view (u, v).
        track: the track of this number.
    """

    policy: str | None = None
    click: tuple[float, float] | None = None
    track: int | None = None


# Nothing is said.
ANY_TARGET = TargetChoice()


def choice_table(target_choice: TargetChoice) -> dict[str, Any]:
    """Write whom a run follows."""
    parts = {
        "policy": target_choice.policy,
        "click": target_choice.click and list(target_choice.click),
        "track": target_choice.track,
    }
    return {name: value for name, value in parts.items() if value is not None}


def parse_choice(table: Any) -> TargetChoice:
    """Read whom a run followed.

    Raises:
        ValueError: it is no such table.
    """
    if not isinstance(table, dict) or len(table) > 1 or not table.keys() <= {"policy", "click", "track"}:
        raise ValueError(f"{table!r} is not one of policy, click and track")
    policy, click, track = (table.get(name) for name in ("policy", "click", "track"))
    if not isinstance(policy, str | None) or not (track is None or (type(track) is int and track > 0)):
        raise ValueError(f"{table!r} is no policy's name or track's number")
    if click is None:
        return TargetChoice(policy, None, track)
    if not (isinstance(click, list) and len(click) == 2 and all(type(x) in (int, float) for x in click)):
        raise ValueError(f"click {click!r} is no pixel")
    return TargetChoice(click=(float(click[0]), float(click[1])))


# A click means the target in whose box it is, or one whose middle is within this part of the image's width.
CLICK_PART = 0.08
# Whoever was chosen and lost is looked for so long [s]: a person behind a tree or a car, a bird behind a roof. A track
# that begins meanwhile is taken for the same target if it is no more than so many times as large or as small and no
# farther than so many of its sizes, and this part of the way gone meanwhile, from where the old one would be.
RETURNS_S, RETURN_SIZES, RETURN_TIMES, RETURN_PART = 3.0, 2.0, 2.0, 0.5


class Policy(Protocol):
    """Chooses whom to follow; told everything at every frame."""

    def select(self, candidates: Sequence[Candidate], head: Array, limits: PanTiltLimits) -> int | None:
        """The number of the track to follow; None for none.

        Args:
            candidates: all confirmed tracks.
            head: pan and tilt now, (2,) [rad].
            limits: the head's speed and acceleration.
        """

    def favours(self, track: Track) -> bool:
        """Whether a track must be among the candidates, even where there are more than can be."""

    @property
    def unmet(self) -> str:
        """What was asked for and is not there, in words; empty where it is there, or where anybody will do."""


def _eligible(candidates: Sequence[Candidate]) -> Sequence[Candidate]:
    """Those that the head can point at; where it can point at none, all of them, so that it is said why.

    Of these the likely ones, such as no cloud that was taken for a person; where none is, all, as size or calibration
    may be wrong.
    """
    reachable = [candidate for candidate in candidates if candidate.reachable] or candidates
    return [candidate for candidate in reachable if candidate.likely] or reachable


@dataclass
class FirstCome:
    """The paper's policy: follow the first target until it disappears, then the next."""

    _id: int | None = None
    unmet = ""

    def favours(self, track: Track) -> bool:
        """No: whoever came first has the lowest number, and is a candidate as long as it is there."""
        return False

    def select(self, candidates: Sequence[Candidate], head: Array, limits: PanTiltLimits) -> int | None:
        """The one followed before, if it is still there, can be reached and is likely, or else the eldest that is."""
        ids = [candidate.id for candidate in _eligible(candidates)]
        if self._id not in ids:
            self._id = min(ids, default=None)
        return self._id


LONGEST_LOOKS = 2.5  # the longest that somebody is kept who is not seen, in looks


@dataclass
class Rounds:
    """Look at every target for a while and go on to the next; once all were seen, at whoever was seen least.

    Turning away costs the way, and the time until the lens has settled again: whoever turned before that would see
    nobody. So each is kept for SETTLE_S unless it is gone or was seen for long enough; and once all were, for a look
    more, and until it has been seen longer than another by a whole look or that takes too long: it may be hidden from
    the zoom camera alone.

    Attributes:
        next_of: gives the number of the next one; asked at every frame, and never without anybody waiting.
        look_s: how long each is looked at [s].
    """

    next_of: Callable[[SelectionState], int]
    look_s: float = LOOK_S
    _id: int | None = None
    _since: float = -math.inf
    unmet = ""

    def favours(self, track: Track) -> bool:
        """No: there is no telling whose turn it would be."""
        return False

    def select(self, candidates: Sequence[Candidate], head: Array, limits: PanTiltLimits) -> int | None:
        """The next one, as long as somebody waits."""
        candidates = _eligible(candidates)
        waiting = sorted((c for c in candidates if c.seen_s < self.look_s), key=lambda c: (c.leaves_in, c.id))
        t = max((c.track.t for c in candidates), default=-math.inf)
        if waiting:
            if self._id not in {c.id for c in waiting} or not 0 <= t - self._since < SETTLE_S:
                pan, tilt = head.tolist()
                self._turn(self.next_of(SelectionState(waiting, self._id, (pan, tilt), limits, self.look_s)), t)
        else:
            self._turn(self._least_seen(candidates, t), t)
        return self._id

    def _turn(self, number: int | None, t: float) -> None:
        """Look at somebody from a time on [s]."""
        if number != self._id:
            self._id, self._since = number, t

    def _least_seen(self, candidates: Sequence[Candidate], t: float) -> int | None:
        """Whoever was seen least; the one followed before until it is a whole look ahead, or that takes too long."""
        others = [c for c in candidates if c.id != self._id]
        current = next((c for c in candidates if c.id == self._id), None)
        if not others:
            return None if current is None else current.id
        least, kept_s = min(others, key=lambda c: (c.seen_s, c.id)), t - self._since
        if current is None or not 0 <= kept_s < LONGEST_LOOKS * self.look_s:
            return least.id
        behind = current.seen_s < least.seen_s + self.look_s
        return current.id if behind or kept_s < SETTLE_S + self.look_s else least.id


def nearest_deadline(state: SelectionState) -> int:
    """The one followed before to its end; then whoever leaves first of those that can still be seen."""
    if state.current in {c.id for c in state.waiting}:
        return state.current
    in_time = [c for c in state.waiting if done_in(c, state, state.head, 0.0) <= c.leaves_in]
    return (in_time or state.waiting)[0].id


def most_served(state: SelectionState) -> int:
    """The first of the order that serves most before they leave; the one followed before while it can still be had.

    When a target leaves is known badly: whoever made another plan at every frame would look at nobody for long enough.
    """
    current = next((c for c in state.waiting if c.id == state.current), None)
    if current is not None and done_in(current, state, state.head, 0.0) <= current.leaves_in:
        return current.id
    return plan(state).first


@dataclass
class Chosen:
    """Follow what the user chose, by its number or by a click into the wide view, and nothing else.

    A target that was out of sight for longer than its track lives comes back under another number. Whoever turns up
    soon after where it would have gone is taken for it.

    Attributes:
        number: of the track.
        pixel: of the click (u, v).
        width_px: of the wide view; a click that far from everything, as a part of it, means nothing.
    """

    number: int | None = None
    pixel: tuple[float, float] | None = None
    width_px: float = math.inf
    _found: int | None = field(default=None, init=False)
    _there: bool = field(default=False, init=False)
    _last: Candidate | None = field(default=None, init=False)  # as it was seen last
    _newest: int = field(default=0, init=False)  # of the tracks that were there beside it then

    def select(self, candidates: Sequence[Candidate], head: Array, limits: PanTiltLimits) -> int | None:
        """The chosen one while it is there."""
        if self._found is None:
            self._found = self.number if self.pixel is None else self._clicked(candidates)
        there = {candidate.id: candidate for candidate in candidates}
        if self._found not in there and (back := [c.track for c in candidates if self._is_back(c.track)]):
            self._found = min(back, key=lambda track: (self._off_course(track), track.id)).id
        self._there = self._found in there
        if self._found is None or not self._there:
            return None
        if not there[self._found].track.missed:
            self._last, self._newest = there[self._found], max(there)
        return self._found

    def favours(self, track: Track) -> bool:
        """Whether it is the chosen one, or may be."""
        if self._found is None:
            return self._means(track)
        return track.id == self._found or (not self._there and self._is_back(track))

    @property
    def unmet(self) -> str:
        """Which choice means none of the tracks."""
        if self._there:
            return ""
        if self.pixel is None:
            return f"track {self.number} is not there"
        at = f"at the click ({self.pixel[0]:g}, {self.pixel[1]:g})"
        return (
            f"no track {at}" if self._found is None else f"track {self._found}, which was {at}, is not there any more"
        )

    def _is_back(self, track: Track) -> bool:
        """Whether a track may be of the chosen one, which was lost and has not left the wide view."""
        if self._last is None or track.id <= self._newest:
            return False
        last, gone_s = self._last.track, track.t - self._last.track.t
        if not 0.0 < gone_s <= min(RETURNS_S, self._last.leaves_in):
            return False
        room = RETURN_SIZES * last.larger_side_px + RETURN_PART * gone_s * float(np.linalg.norm(last.velocity_px))
        resized = track.larger_side_px / last.larger_side_px
        return 1 / RETURN_TIMES <= resized <= RETURN_TIMES and self._off_course(track) <= room

    def _off_course(self, track: Track) -> float:
        """How far a track is from where the chosen one would be by now [px]."""
        assert self._last is not None, "who asks has looked"
        last = self._last.track
        return float(np.linalg.norm(track.center_px - last.center_px - last.velocity_px * (track.t - last.t)))

    def _clicked(self, candidates: Sequence[Candidate]) -> int | None:
        """The track under a click, or the nearest that is near."""
        near = [c.track for c in candidates if self._means(c.track)]
        inside = [track for track in near if self._inside(track)]
        return min(inside or near, key=self._away).id if near else None

    def _means(self, track: Track) -> bool:
        """Whether a choice may mean a track."""
        if self.pixel is None:
            return track.id == self.number
        return self._inside(track) or self._away(track) <= CLICK_PART * self.width_px

    def _inside(self, track: Track) -> bool:
        """Whether the click is in a track's box."""
        return bool(np.all(np.abs(self._off(track)) <= track.size_px / 2))

    def _away(self, track: Track) -> float:
        """How far a click is from a track's middle [px]."""
        return float(np.linalg.norm(self._off(track)))

    def _off(self, track: Track) -> Array:
        """From a click to a track's middle, (2,) [px]."""
        assert self.pixel is not None, "who asks has looked"
        return np.asarray(track.center_px - np.array(self.pixel))


def leaves_in(track: Track, size: tuple[int, int]) -> float:
    """How long until a track's middle leaves an image of (width, height), if it goes on like this [s]."""
    times = []
    for at, speed, side in zip(track.center_px, track.velocity_px, size, strict=True):
        if speed:
            border = side - 0.5 if speed > 0 else -0.5
            times.append((border - at) / speed)
    return float(max(min(times, default=math.inf), 0.0))


# By the names that users call them.
POLICIES: Mapping[str, Callable[[], Policy]] = {
    "first-come": FirstCome,
    "nearest-deadline": partial(Rounds, nearest_deadline),
    "most-served": partial(Rounds, most_served),
}
