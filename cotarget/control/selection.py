"""Select which of several tracks to follow: first come, nearest deadline, most served, or the user's choice.

A `TargetSelector` sees the confirmed tracks of the fixed camera, the travel time of the head to each, and how long each
was seen well so far. The two scheduling policies look at every target for a while and go on to the next. They differ
when not all can be reached: `nearest-deadline` (after Costello et al. 2004, "Scheduling an active camera to observe
people") turns to the target that leaves first; `most-served` plans the order that serves most targets.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple, Protocol

import numpy as np

from cotarget.errors import ConfigError, choices
from cotarget.estimation import TargetFilter
from cotarget.geometry import Array, RigidTransform
from cotarget.pantilt import towards
from cotarget.rig import Angles, PanTiltLimits
from cotarget.targets import Target
from cotarget.tracking.track import Track

# Most targets whose orders are all searched, which takes some 3 ms; of more, those that leave first are taken.
MOST_PLANNED = 7
# Time over which a target's angular rate is computed [s].
RATE_S = 0.1


@dataclass(frozen=True)
class Candidate:
    """A confirmed track that may be selected; its direction is computed on demand.

    Attributes:
        track: track in the fixed camera.
        where: gives pan and tilt that point at the target a number of seconds from now, (2,) [rad].
        leaves_in: time until it leaves the fixed image [s]; inf if it does not.
        seen_s: how long it was well in the close-up so far [s].
        reachable: whether the head can point at it.
        likely: whether both cameras agree with its nominal size; true until the zoom camera has looked at it.
    """

    track: Track
    where: Callable[[float], Array]
    leaves_in: float = math.inf
    seen_s: float = 0.0
    reachable: bool = True
    likely: bool = True

    @property
    def id(self) -> int:
        """Id of the track."""
        return self.track.id

    @cached_property
    def at(self) -> Array:
        """Pan and tilt that point at the target now, (2,) [rad]."""
        return self.where(0.0)

    @cached_property
    def rate(self) -> Array:
        """Rates of pan and tilt, (2,) [rad/s]."""
        return (self.where(RATE_S) - self.at) / RATE_S

    def after(self, seconds: float) -> Angles:
        """Extrapolate pan and tilt a number of seconds from now [rad]."""
        (pan, tilt), (pan_rate, tilt_rate) = self._line
        return pan + pan_rate * seconds, tilt + tilt_rate * seconds

    @cached_property
    def _line(self) -> tuple[Angles, Angles]:
        """Angles and rates as floats, which a plan needs thousands of times."""
        (pan, tilt), (pan_rate, tilt_rate) = self.at.tolist(), self.rate.tolist()
        return (pan, tilt), (pan_rate, tilt_rate)


@dataclass(frozen=True)
class SelectionState:
    """Input of a plan.

    Attributes:
        waiting: targets not seen for long enough yet, in the order in which they leave.
        current: id of the track followed so far.
        head: pan and tilt now [rad].
        limits: limits of the head.
        look_s: time for which each target is looked at [s].
        settle_s: time from the head's arrival to a good close-up [s].
    """

    waiting: Sequence[Candidate]
    current: int | None
    head: Angles
    limits: PanTiltLimits
    look_s: float
    settle_s: float


class Plan(NamedTuple):
    """Best order: number of targets served, end of the order [s from now], and id of the first target."""

    served: int
    end: float
    first: int


def plan(state: SelectionState) -> Plan:
    """Plan the order that serves most targets before they leave, and of these the one that ends first.

    If no target can be served, the plan names the one that would be done first. Of orders of the same targets with the
    same last one, only the one that ends first is continued, because an earlier start from the same target never
    arrives later (dynamic programming after Held and Karp 1962).
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
                if end > candidate.leaves_in:  # it cannot be served
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
    """Sort key of orders, the best one largest."""
    return order.served, -order.end, -order.first


def travel_s(way: Angles, limits: PanTiltLimits) -> float:
    """Travel time of the head from rest to rest, over an angle of pan and tilt [rad] with both axes at once [s]."""
    return max(axis.travel_s(each) for each, axis in zip(way, limits.axes, strict=True))


def done_in(candidate: Candidate, state: SelectionState, head: Angles, now: float) -> float:
    """Time until a target has been seen for long enough if it comes next, with its motion meanwhile [s from now].

    Args:
        candidate: the target.
        state: limits of the head, and the target followed so far.
        head: pan and tilt at the start [rad].
        now: time of the start [s from now].
    """
    arrival = now
    if now > 0 or candidate.id != state.current:  # the head is not there already
        for _ in range(2):  # the way depends on the arrival; two rounds agree to a few hundredths
            pan, tilt = candidate.after(arrival)
            arrival = now + travel_s((pan - head[0], tilt - head[1]), state.limits)
        arrival += state.settle_s
    return arrival + max(state.look_s - candidate.seen_s, 0.0)


class TargetSelector(Protocol):
    """Selects the track to follow, in every frame of a run."""

    def start(self, image_size: tuple[int, int]) -> None:
        """Begin a run, and forget the run before.

        Args:
            image_size: (width, height) of the fixed image [px].
        """

    def select(self, candidates: Sequence[Candidate], head: Array, limits: PanTiltLimits) -> int | None:
        """Return the id of the track to follow; None for no track.

        Args:
            candidates: all confirmed tracks.
            head: pan and tilt now, (2,) [rad].
            limits: limits of the head.
        """

    def favours(self, track: Track) -> bool:
        """Whether a track must become a candidate, even if there are more tracks than candidates."""

    @property
    def unmet(self) -> str:
        """What was chosen and is not there, as a message; empty if it is there or any target will do."""


def _eligible(candidates: Sequence[Candidate]) -> Sequence[Candidate]:
    """Filter candidates to those that the head can reach and that are likely targets.

    If none can be reached, all stay, so that the run can report why. If none is likely, all reachable ones stay, since
    nominal size or calibration may be wrong. An unlikely one is for example a cloud taken for a person. One that has
    been hidden for long is waited for while nothing else in sight is surely a target.
    """
    reachable = [candidate for candidate in candidates if candidate.reachable] or candidates
    likely = [candidate for candidate in reachable if candidate.likely] or reachable
    if not any(candidate.track.hidden for candidate in likely):
        return likely
    return [candidate for candidate in likely if candidate.track.sure and not candidate.track.hidden] or likely


@dataclass
class FirstCome:
    """Follow the first target until it disappears, then the next: the paper's policy."""

    unmet = ""
    _id: int | None = field(default=None, init=False)

    def start(self, image_size: tuple[int, int]) -> None:
        """Begin a run, with no target."""
        self._id = None

    def favours(self, track: Track) -> bool:
        """Favour no track: the first has the lowest id and stays a candidate anyway."""
        return False

    def select(self, candidates: Sequence[Candidate], head: Array, limits: PanTiltLimits) -> int | None:
        """Keep the target followed so far while it is eligible, or else take the oldest eligible one."""
        ids = [candidate.id for candidate in _eligible(candidates)]
        if self._id not in ids:
            self._id = min(ids, default=None)
        return self._id


@dataclass
class Rounds:
    """Look at every target for a while and go on to the next; after all were seen, at the one seen least.

    Turning away costs the way and the time until the lens has settled. So each target is kept for `settle_s` at least,
    unless it is gone or was seen for long enough. After all were seen, each is kept for one look more, and until it is
    a whole look ahead of another or that takes too long, because it may be hidden from the zoom camera alone.

    Attributes:
        policy: rule for the next target, one of `NEXT`.
        look_s: time for which each target is looked at: a second of good close-up, and reserve for the plan's errors
            [s].
        settle_s: time from the head's arrival to a good close-up: the lens's travel and a frame [s].
        longest_looks: longest time for a target that is not seen, in looks.
    """

    policy: str
    look_s: float = 1.2
    settle_s: float = 0.6
    longest_looks: float = 2.5
    unmet = ""
    _id: int | None = field(default=None, init=False)
    _since: float = field(default=-math.inf, init=False)

    def start(self, image_size: tuple[int, int]) -> None:
        """Begin a run, with no target."""
        self._id, self._since = None, -math.inf

    def favours(self, track: Track) -> bool:
        """Favour no track: whose turn comes next is unknown."""
        return False

    def select(self, candidates: Sequence[Candidate], head: Array, limits: PanTiltLimits) -> int | None:
        """Return the next target that waits, or the one seen least if none waits."""
        candidates = _eligible(candidates)
        waiting = sorted((c for c in candidates if c.seen_s < self.look_s), key=lambda c: (c.leaves_in, c.id))
        t = max((c.track.t for c in candidates), default=-math.inf)
        if waiting:
            if self._id not in {c.id for c in waiting} or not 0 <= t - self._since < self.settle_s:
                pan, tilt = head.tolist()
                state = SelectionState(waiting, self._id, (pan, tilt), limits, self.look_s, self.settle_s)
                self._turn(NEXT[self.policy](state), t)
        else:
            self._turn(self._least_seen(candidates, t), t)
        return self._id

    def _turn(self, number: int | None, t: float) -> None:
        """Look at a target from time t on [s]."""
        if number != self._id:
            self._id, self._since = number, t

    def _least_seen(self, candidates: Sequence[Candidate], t: float) -> int | None:
        """The target seen least; the current one until it is a whole look ahead or that takes too long."""
        others = [c for c in candidates if c.id != self._id]
        current = next((c for c in candidates if c.id == self._id), None)
        if not others:
            return None if current is None else current.id
        least, kept_s = min(others, key=lambda c: (c.seen_s, c.id)), t - self._since
        if current is None or not 0 <= kept_s < self.longest_looks * self.look_s:
            return least.id
        behind = current.seen_s < least.seen_s + self.look_s
        return current.id if behind or kept_s < self.settle_s + self.look_s else least.id


def nearest_deadline(state: SelectionState) -> int:
    """Keep the current target until it is served; then take the first to leave of those that can still be served."""
    if state.current in {c.id for c in state.waiting}:
        return state.current
    in_time = [c for c in state.waiting if done_in(c, state, state.head, 0.0) <= c.leaves_in]
    return (in_time or state.waiting)[0].id


def most_served(state: SelectionState) -> int:
    """Keep the current target while it can be served; then take the first of the order that serves most.

    When a target leaves is known badly, and a new plan in every frame would look at no target for long enough.
    """
    current = next((c for c in state.waiting if c.id == state.current), None)
    if current is not None and done_in(current, state, state.head, 0.0) <= current.leaves_in:
        return current.id
    return plan(state).first


# Rule for the next target while targets wait, by the policy's name.
NEXT: Mapping[str, Callable[[SelectionState], int]] = {
    "nearest-deadline": nearest_deadline,
    "most-served": most_served,
}


@dataclass
class Chosen:
    """Follow the target that the user chose by id or by a click into the fixed image, and no other.

    A target out of sight for longer than its track lives comes back under a new id. A track that begins soon after,
    near where the target would have gone, is taken for it.

    A chosen target that was lost is searched for a while: a person behind a tree or car, a bird behind a roof.

    Attributes:
        number: id of the track.
        pixel: pixel of the click (u, v).
        click_part: a click selects the target whose box holds it, or one whose centre is within this part of the
            image's width.
        returns_s: time for which a lost target is searched [s].
        return_times: largest ratio of the sizes of the new track and of the lost one.
        return_sizes: largest distance of the new track from the extrapolated place, in sizes of the target ...
        return_part: ... plus this part of the way gone meanwhile.
    """

    number: int | None = None
    pixel: tuple[float, float] | None = None
    click_part: float = 0.08
    returns_s: float = 3.0
    return_times: float = 2.0
    return_sizes: float = 2.0
    return_part: float = 0.5
    _width_px: float = field(default=math.inf, init=False)
    _found: int | None = field(default=None, init=False)
    _there: bool = field(default=False, init=False)
    _last: Candidate | None = field(default=None, init=False)  # when it was last seen
    _newest: int = field(default=0, init=False)  # largest id of the tracks at that time

    def start(self, image_size: tuple[int, int]) -> None:
        """Begin a run on images of that size."""
        self._width_px = image_size[0]
        self._found, self._there, self._last, self._newest = None, False, None, 0

    def select(self, candidates: Sequence[Candidate], head: Array, limits: PanTiltLimits) -> int | None:
        """Return the chosen target while it is there; None otherwise."""
        if self._found is None:
            self._found = self.number if self.pixel is None else self._clicked(candidates)
        there = {candidate.id: candidate for candidate in candidates}
        gone = self._found not in there or there[self._found].track.hidden
        if gone and (back := [c.track for c in candidates if self._is_back(c.track)]):
            self._found = min(back, key=lambda track: (self._off_course(track), track.id)).id
        self._there = self._found in there
        if self._found is None or not self._there:
            return None
        if not there[self._found].track.missed:
            self._last, self._newest = there[self._found], max(there)
        return self._found

    def favours(self, track: Track) -> bool:
        """Whether a track is the chosen target, or may be."""
        if self._found is None:
            return self._means(track)
        return track.id == self._found or (not self._there and self._is_back(track))

    @property
    def unmet(self) -> str:
        """The choice that no track meets, as a message; empty if a track meets it."""
        if self._there:
            return ""
        if self.pixel is None:
            return f"track {self.number} is not there"
        at = f"at the click ({self.pixel[0]:g}, {self.pixel[1]:g})"
        return (
            f"no track {at}" if self._found is None else f"track {self._found}, which was {at}, is not there any more"
        )

    def _is_back(self, track: Track) -> bool:
        """Whether a track may continue the chosen target, which was lost inside the fixed image."""
        if self._last is None or track.id <= self._newest:
            return False
        last, gone_s = self._last.track, track.t - self._last.track.t
        if not 0.0 < gone_s <= min(self.returns_s, self._last.leaves_in):
            return False
        speed_px = float(np.linalg.norm(last.velocity_px))
        room = self.return_sizes * last.larger_side_px + self.return_part * gone_s * speed_px
        resized = track.larger_side_px / last.larger_side_px
        return 1 / self.return_times <= resized <= self.return_times and self._off_course(track) <= room

    def _off_course(self, track: Track) -> float:
        """Distance of a track from the extrapolated place of the chosen target [px]."""
        assert self._last is not None, "who asks has looked"
        last = self._last.track
        return float(np.linalg.norm(track.center_px - last.center_px - last.velocity_px * (track.t - last.t)))

    def _clicked(self, candidates: Sequence[Candidate]) -> int | None:
        """Find the track under the click, or the nearest within reach."""
        near = [c.track for c in candidates if self._means(c.track)]
        inside = [track for track in near if self._inside(track)]
        return min(inside or near, key=self._away).id if near else None

    def _means(self, track: Track) -> bool:
        """Whether a track can be the one chosen, by id or by click."""
        if self.pixel is None:
            return track.id == self.number
        return self._inside(track) or self._away(track) <= self.click_part * self._width_px

    def _inside(self, track: Track) -> bool:
        """Whether the click is in a track's box."""
        return bool(np.all(np.abs(self._off(track)) <= track.size_px / 2))

    def _away(self, track: Track) -> float:
        """Distance of the click from a track's centre [px]."""
        return float(np.linalg.norm(self._off(track)))

    def _off(self, track: Track) -> Array:
        """Vector from the click to a track's centre, (2,) [px]."""
        assert self.pixel is not None, "who asks has looked"
        return np.asarray(track.center_px - np.array(self.pixel))


def candidates_of(
    targets: Iterable[Target], t: float, T_base_fixed: RigidTransform, size: tuple[int, int]
) -> list[Candidate]:
    """List the targets that may be selected at time t [s]: confirmed ones whose place is known.

    Args:
        targets: all targets.
        t: time [s].
        T_base_fixed: pose of the fixed camera in the head's base.
        size: (width, height) of the fixed image [px].
    """
    return [
        Candidate(
            target.track,
            partial(_direction, target.filter, T_base_fixed, t),
            leaves_in(target.track, size),
            target.seen_well_s,
            reachable=not target.unreachable,
            likely=not target.unlikely,
        )
        for target in targets
        if target.track.confirmed and target.filter is not None and target.filter.knows(t)
    ]


def _direction(filter: TargetFilter, T_base_fixed: RigidTransform, t: float, later: float) -> Array:
    """Pan and tilt of a target from the head, (2,) [rad]; the zoom camera's offset on the head is neglected."""
    estimate = filter.estimate(t + later)
    assert estimate is not None, "what is known at a time is known later"
    return np.array(towards(T_base_fixed.apply(estimate.x_fixed)))


def leaves_in(track: Track, size: tuple[int, int]) -> float:
    """Time until a track's centre leaves an image of (width, height) at its present velocity [s]."""
    times = []
    for at, speed, side in zip(track.center_px, track.velocity_px, size, strict=True):
        if speed:
            border = side - 0.5 if speed > 0 else -0.5
            times.append((border - at) / speed)
    return float(max(min(times, default=math.inf), 0.0))


# Selectors by the names of policies that users give.
POLICIES: Mapping[str, Callable[[], TargetSelector]] = {
    "first-come": FirstCome,
    **{name: partial(Rounds, name) for name in NEXT},
}


def selector_table(selector: TargetSelector | None) -> dict[str, Any]:
    """Convert a selector to the table that a recording keeps; empty for None and for a selector of the user's own."""
    match selector:
        case FirstCome():
            return {"policy": "first-come"}
        case Rounds():
            return {"policy": selector.policy}
        case Chosen(pixel=None):
            return {"track": selector.number}
        case Chosen(pixel=(u, v)):
            return {"click": [u, v]}
    return {}


def check_selector_table(table: Any) -> None:
    """Refuse what is no table of a selector.

    Raises:
        ValueError: the table is none.
    """
    if not isinstance(table, dict) or len(table) > 1 or not table.keys() <= {"policy", "click", "track"}:
        raise ValueError(f"{table!r} is not one of policy, click and track")
    policy, click, track = (table.get(name) for name in ("policy", "click", "track"))
    if not isinstance(policy, str | None) or not (track is None or (type(track) is int and track > 0)):
        raise ValueError(f"{table!r} is no policy's name or track's number")
    if click is not None:
        if not (isinstance(click, list) and len(click) == 2 and all(type(x) in (int, float) for x in click)):
            raise ValueError(f"click {click!r} is no pixel")
        list(map(float, click))  # an integer may be too large for it


def make_selector(table: Mapping[str, Any]) -> TargetSelector:
    """Make the selector of a checked table; that of the first target that comes for an empty one.

    Raises:
        ConfigError: there is no such policy.
    """
    if "click" in table:
        u, v = table["click"]
        return Chosen(pixel=(float(u), float(v)))
    if "track" in table:
        return Chosen(number=table["track"])
    name = table.get("policy", "first-come")
    if name not in POLICIES:
        raise ConfigError(f"policy '{name}' is unknown; give one of: {choices(POLICIES)}")
    return POLICIES[name]()
