"""Policies: hand-worked cases, the best order by trying all, and what each serves of targets that come and go."""

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from cotarget.control.selection import (
    POLICIES,
    Candidate,
    Chosen,
    FirstCome,
    Rounds,
    SelectionState,
    check_selector_table,
    leaves_in,
    make_selector,
    plan,
    selector_table,
    travel_s,
)
from cotarget.tracking.track import Track
from tests.support.rigs import alike, with_axes

LIMITS = alike((-2.8, 2.8), (-0.8, 0.5), math.radians(149), math.radians(206), math.radians(0.0514286))
STILL = np.zeros(2)
LOOK_S, SETTLE_S = Rounds.look_s, Rounds.settle_s
nearest_deadline, most_served = POLICIES["nearest-deadline"], POLICIES["most-served"]


def track(number, center=(320.0, 240.0), velocity=(0.0, 0.0), size=(20.0, 20.0), t=0.0):
    center, velocity, size = (np.array(each, float) for each in (center, velocity, size))
    return Track(number, t, True, 0, center, velocity, size, size, float(size.max()), np.eye(4), 1.0, None)


def candidate(number, pan=0.0, *, rate=0.0, leaves=math.inf, seen=0.0, **where):
    return Candidate(track(number, **where), lambda later: np.array([pan + rate * later, 0.0]), leaves, seen)


def test_a_way_takes_as_long_as_the_units_profile_says():
    # 206 degrees/s^2 reach 149 degrees/s after 0.7233 s and 53.89 degrees; with the braking, 107.77 degrees.
    assert travel_s(np.radians([20.0, 5.0]), LIMITS) == pytest.approx(2 * math.sqrt(20 / 206))
    assert travel_s(np.radians([0.0, -140.0]), LIMITS) == pytest.approx(2 * 149 / 206 + (140 - 149**2 / 206) / 149)
    assert travel_s(STILL, LIMITS) == 0.0
    at_once = with_axes(LIMITS, acceleration=math.inf)
    assert travel_s((0.0, at_once.pan.speed), at_once) == pytest.approx(1.0)
    assert travel_s(STILL, at_once) == travel_s(STILL, with_axes(at_once, speed=math.inf)) == 0.0


def test_when_a_track_leaves_the_image():
    size = (640, 480)
    assert leaves_in(track(1), size) == math.inf
    assert leaves_in(track(1, velocity=(100, 0)), size) == pytest.approx((639.5 - 320) / 100)
    assert leaves_in(track(1, velocity=(-100, 200)), size) == pytest.approx((479.5 - 240) / 200)
    assert leaves_in(track(1, center=(-5, 240), velocity=(-100, 0)), size) == 0.0


def test_first_come_stays_until_its_target_is_gone():
    selector = FirstCome()
    assert selector.select([], STILL, LIMITS) is None
    assert selector.select([candidate(4), candidate(2)], STILL, LIMITS) == 2
    assert selector.select([candidate(1), candidate(2, seen=60.0)], STILL, LIMITS) == 2
    assert selector.select([candidate(3), candidate(4)], STILL, LIMITS) == 3


@pytest.mark.parametrize("make", POLICIES.values(), ids=POLICIES)
def test_what_is_hidden_is_waited_for_only_while_nothing_else_is_in_sight(make):
    behind = replace(candidate(1, leaves=1.0), track=replace(track(1), missed=30, hidden=True))
    selector = make()
    assert selector.select([behind], STILL, LIMITS) == 1
    assert selector.select([behind, candidate(2)], STILL, LIMITS) == 2


def test_a_hidden_target_is_not_left_for_what_may_be_a_cloud():
    behind = replace(candidate(1), track=replace(track(1), missed=30, hidden=True))
    cloud = replace(candidate(2), track=replace(track(2), sure=False))
    selector = FirstCome()
    assert selector.select([candidate(1), cloud], STILL, LIMITS) == 1
    assert selector.select([behind, cloud], STILL, LIMITS) == 1
    assert selector.select([behind, cloud, candidate(3)], STILL, LIMITS) == 3
    assert selector.select([cloud], STILL, LIMITS) == 2


def test_a_chosen_target_that_comes_out_elsewhere_is_taken_while_its_track_is_hidden():
    selector = Chosen(number=1)
    selector.start((640, 480))
    assert selector.select([candidate(1)], STILL, LIMITS) == 1
    behind = replace(candidate(1), track=replace(track(1, t=1.0), missed=30, hidden=True))
    assert selector.select([behind], STILL, LIMITS) == 1
    assert selector.select([behind, candidate(2, center=(330.0, 240.0), t=1.0)], STILL, LIMITS) == 2


@pytest.mark.parametrize("make", POLICIES.values(), ids=POLICIES)
def test_what_is_unlikely_is_looked_at_only_where_nothing_else_is(make):
    cloud = replace(candidate(1, leaves=1.0), likely=False)
    selector = make()
    assert selector.select([cloud], STILL, LIMITS) == 1
    assert selector.select([cloud, candidate(2)], STILL, LIMITS) == 2
    # Where size or calibration are wrong they all turn out to be; then nobody is left for that.
    unlikely = replace(candidate(2), likely=False)
    assert selector.select([cloud, unlikely], STILL, LIMITS) is not None
    assert make().select([unlikely], STILL, LIMITS) == 2


def test_the_nearest_deadline_comes_first_and_is_seen_to_its_end():
    selector = nearest_deadline()
    there = [candidate(1, 0.2, leaves=9.0), candidate(2, -0.2, leaves=4.0), candidate(3, 0.1, leaves=6.0)]
    assert selector.select(there, STILL, LIMITS) == 2
    sooner = [*there, candidate(4, leaves=3.0)]
    assert selector.select(sooner, STILL, LIMITS) == 2  # is being looked at
    seen = [candidate(2, seen=LOOK_S, leaves=3.0), *(c for c in sooner if c.id != 2)]
    assert selector.select(seen, STILL, LIMITS) == 4


def test_the_nearest_deadline_does_not_run_after_what_it_cannot_have():
    lost, kept = candidate(1, 0.5, leaves=1.0), candidate(2, -0.5, leaves=9.0)
    assert nearest_deadline().select([lost, kept], STILL, LIMITS) == 2
    assert nearest_deadline().select([lost], STILL, LIMITS) == 1


def test_when_all_have_been_seen_whoever_was_seen_least_is_next():
    for selector in (nearest_deadline(), most_served()):
        seen = [candidate(1, seen=5.0), candidate(2, seen=2.0), candidate(3, seen=3.0)]
        assert selector.select(seen, STILL, LIMITS) == 2
        assert selector.select([], STILL, LIMITS) is None


def test_the_plan_gives_up_one_to_have_two():
    # A look takes 1.2 s and 0.6 s to settle. The first is far off on the left and leaves after 3.5 s: it can be had,
    # but the two on the right leave while the head comes back.
    far = candidate(1, -2.4, leaves=3.5)
    right = [candidate(2, 0.2, leaves=4.2), candidate(3, 0.25, leaves=5.0)]
    one = travel_s(far.at, LIMITS) + SETTLE_S + LOOK_S
    assert one < 3.5
    assert one + travel_s(right[0].at - far.at, LIMITS) + SETTLE_S + LOOK_S > 5.0
    assert nearest_deadline().select([far, *right], STILL, LIMITS) == 1
    assert most_served().select([far, *right], STILL, LIMITS) in (2, 3)


def test_a_plan_is_kept_while_the_times_to_leave_waver():
    selector, rng = most_served(), np.random.default_rng(0)
    chosen = set()
    for k in range(25):  # a second
        leaves = rng.uniform(3.0, 9.0, 3)
        there = [candidate(i, 0.2 * i, leaves=leaves[i], seen=0.04 * k * (i in chosen), t=0.04 * k) for i in range(3)]
        chosen.add(selector.select(there, STILL, LIMITS))
    assert len(chosen) == 1
    gone = [candidate(i, 0.2 * i, leaves=0.1 if i in chosen else 9.0, t=1.0) for i in range(3)]
    assert selector.select(gone, STILL, LIMITS) not in chosen


@pytest.mark.parametrize("make", [nearest_deadline, most_served])
def test_nobody_is_left_before_the_lens_has_settled(make):
    """Two that leave in turn too soon: a plan anew at every frame would go to and fro between them."""
    selector = make()
    first = selector.select([candidate(1, 0.2, leaves=1.0), candidate(2, -0.2, leaves=9.0)], STILL, LIMITS)
    turned = []
    for k in range(1, 100):
        leaves = (9.0, 1.0) if k % 2 else (1.0, 9.0)
        there = [candidate(i, 0.4 * i - 0.6, leaves=leaves[i - 1], t=0.04 * k) for i in (1, 2)]
        found = selector.select(there, STILL, LIMITS)
        if found != first:
            turned.append(0.04 * k)
            first = found
    assert all(np.diff([0.0, *turned]) >= SETTLE_S - 1e-9)
    assert selector.select([candidate(3 - first, t=4.0)], STILL, LIMITS) == 3 - first  # who is gone is not waited for


@pytest.mark.parametrize("make", [nearest_deadline, most_served])
@pytest.mark.parametrize("apart", [0.01, 0.1, 0.4])
def test_who_were_all_seen_are_looked_at_in_turn_and_for_long_enough(make, apart):
    """Three who stay: each frame at one makes another the least seen, and the head would be under way all the time."""
    selector, pans, seen, head, goal, arrives, turned = make(), apart * np.arange(3), np.zeros(3), 0.0, None, 0.0, []
    for t in np.arange(0, 20, 0.04):
        there = [candidate(i, pans[i], seen=seen[i], t=t) for i in range(3)]
        found = selector.select(there, np.array([head, 0.0]), LIMITS)
        if found != goal:
            arrives = t + travel_s((pans[found] - head, 0.0), LIMITS) + 0.3
            goal = found
            turned.append(t)
        if t >= arrives:
            head = pans[goal]
            seen[goal] += 0.04
    assert np.diff(turned).min() >= LOOK_S - 0.041
    assert seen.sum() > 20 / 2
    assert np.ptp(seen) <= LOOK_S + 0.041


@pytest.mark.parametrize("make", [nearest_deadline, most_served])
def test_who_cannot_be_seen_any_more_does_not_keep_the_head(make):
    """The zoom camera's view of it is blocked, and the wide one's is not."""
    selector, seen, hidden = make(), np.full(2, 2.0), 0
    turned = [selector.select([candidate(i, 0.1 * i, seen=seen[i], t=0.0) for i in range(2)], np.zeros(2), LIMITS)]
    for t in np.arange(0.04, 20, 0.04):
        there = [candidate(i, 0.1 * i, seen=seen[i], t=t) for i in range(2)]
        turned.append(selector.select(there, np.zeros(2), LIMITS))
        seen[turned[-1]] += 0.04 * (turned[-1] != hidden)
    assert np.mean(turned) > 0.3  # of the time number 1 is looked at


def served_by_best_order(candidates, head):
    """How many the best of all orders serves, by trying every order of every subset."""
    best = 0
    for n in range(1, len(candidates) + 1):
        for order in itertools.permutations(candidates, n):
            now, at = 0.0, head
            for each in order:
                arrival = now
                for _ in range(10):  # until the head and the target meet
                    arrival = now + travel_s(each.at + each.rate * arrival - at, LIMITS)
                now = arrival + SETTLE_S + LOOK_S
                at = each.at + each.rate * now
                if now > each.leaves_in:
                    break
            else:
                best = max(best, n)
    return best


def test_the_plan_is_the_best_of_all_orders():
    rng = np.random.default_rng(3)
    sharp = 0
    for _ in range(25):
        five = [
            candidate(i, rng.uniform(-1.5, 1.5), rate=rng.uniform(-0.1, 0.1), leaves=rng.uniform(2, 9))
            for i in range(5)
        ]
        found = plan(SelectionState(five, None, (0.0, 0.0), LIMITS, LOOK_S, SETTLE_S))
        best = served_by_best_order(five, STILL)
        assert abs(found.served - best) <= 1  # the way to a moving target is only nearly right
        sharp += found.served == best
        assert most_served().select(five, STILL, LIMITS) == found.first
    assert sharp >= 23


def test_a_plan_with_nobody_to_be_had_takes_who_is_done_first():
    lost = [candidate(1, 0.5, leaves=0.1), candidate(2, -0.2, leaves=0.2)]
    found = plan(SelectionState(lost, None, (0.0, 0.0), LIMITS, LOOK_S, SETTLE_S))
    assert (found.served, found.first) == (0, 2)


def test_a_number_is_followed_and_nothing_else():
    selector = Chosen(number=3)
    assert selector.select([candidate(1), candidate(2)], STILL, LIMITS) is None
    assert selector.select([candidate(1), candidate(3)], STILL, LIMITS) == 3
    assert selector.select([candidate(1)], STILL, LIMITS) is None
    assert selector.select([replace(candidate(3), reachable=False), candidate(2)], STILL, LIMITS) == 3


def clicked(pixel, width_px):
    """A selector of what a click into an image of that width shows."""
    selector = Chosen(pixel=pixel)
    selector.start((width_px, 480))
    return selector


def test_a_click_means_the_box_it_is_in_or_the_nearest_one_near():
    large = candidate(1, center=(100, 100), size=(80, 80))
    small = candidate(2, center=(130, 100), size=(8, 8))
    assert clicked((131, 101), 640).select([large, small], STILL, LIMITS) == 2
    assert clicked((80, 80), 640).select([large, small], STILL, LIMITS) == 1
    assert clicked((160, 100), 640).select([large, small], STILL, LIMITS) == 2
    far = clicked((400, 300), 640)
    assert far.select([large, small], STILL, LIMITS) is None
    assert far.select([candidate(7, center=(410, 310))], STILL, LIMITS) == 7
    assert far.select([candidate(7, center=(20, 20)), small], STILL, LIMITS) == 7  # it is known by its number now


def lost_at_zero(**last):
    """A selector whose chosen target, number 2, was seen last at the time 0; number 5 was there too."""
    selector = Chosen(number=2)
    assert selector.select([candidate(2, **last), candidate(5, center=(20, 20))], STILL, LIMITS) == 2
    return selector


def test_whoever_was_chosen_and_hidden_is_followed_on_under_another_number():
    selector = lost_at_zero(center=(300, 200), velocity=(50, 0))
    assert selector.select([candidate(5, center=(20, 20), t=1.0)], STILL, LIMITS) is None
    assert selector.favours(track(6, center=(370, 200), t=1.5))  # 75 px on, where it would be
    there = [candidate(6, center=(370, 200), t=1.5), candidate(7, center=(400, 200), t=1.5)]
    assert selector.select(there, STILL, LIMITS) == 6
    assert selector.unmet == ""
    assert selector.select(there[1:], STILL, LIMITS) is None  # that one was there beside it
    assert selector.select([candidate(8, center=(370, 200), t=4.0)], STILL, LIMITS) == 8


@pytest.mark.parametrize(
    ("number", "where"),
    [
        (5, {"center": (350, 200), "t": 1.0}),  # was there beside it
        (6, {"center": (450, 200), "t": 1.0}),  # 100 px from where it would be: two sizes are 40, half the way is 25
        (6, {"center": (350, 200), "t": 1.0, "size": (41, 20)}),
        (6, {"center": (350, 200), "t": 1.0, "size": (9, 9)}),
        (6, {"center": (455, 200), "t": 3.1}),
        (6, {"center": (300, 200), "t": 0.0}),
    ],
)
def test_nobody_else_is_taken_for_whoever_was_chosen(number, where):
    selector = lost_at_zero(center=(300, 200), velocity=(50, 0))
    assert not selector.favours(track(number, **where))
    assert selector.select([candidate(number, **where)], STILL, LIMITS) is None
    assert selector.unmet == "track 2 is not there"


def test_whoever_was_chosen_and_has_left_the_view_is_not_back():
    selector = lost_at_zero(center=(600, 200), velocity=(80, 0), leaves=0.5)
    assert selector.select([candidate(6, center=(639, 200), velocity=(-80, 0), t=0.6)], STILL, LIMITS) is None


@pytest.mark.parametrize("name", sorted(POLICIES))
def test_who_is_out_of_reach_keeps_nobody_waiting(name):
    selector = POLICIES[name]()
    assert selector.select([replace(candidate(1), reachable=False)], STILL, LIMITS) == 1  # so that it is said why
    assert selector.select([replace(candidate(1), reachable=False), candidate(2)], STILL, LIMITS) == 2
    assert selector.unmet == ""
    assert not selector.favours(track(1))


def test_a_choice_by_number_says_when_it_is_not_met():
    selector = Chosen(number=2)
    assert selector.unmet == "track 2 is not there"
    assert [selector.favours(track(n)) for n in (1, 2)] == [False, True]
    selector.select([candidate(1), candidate(2)], STILL, LIMITS)
    assert selector.unmet == ""
    selector.select([candidate(1)], STILL, LIMITS)
    assert selector.unmet == "track 2 is not there"


def test_a_choice_by_click_says_when_it_is_not_met():
    selector = clicked((100.0, 200.0), 500.0)  # 40 px are near
    near, far = track(1, center=(100, 239)), track(2, center=(100, 241))
    assert [selector.favours(each) for each in (near, far)] == [True, False]
    selector.select([candidate(2, center=(100, 241))], STILL, LIMITS)
    assert selector.unmet == "no track at the click (100, 200)"
    assert selector.select([candidate(1, center=(100, 239))], STILL, LIMITS) == 1
    assert selector.unmet == ""
    assert [selector.favours(track(n, center=(100, 200))) for n in (1, 3)] == [
        True,
        False,
    ]  # it is that one from now on
    selector.select([], STILL, LIMITS)
    assert selector.unmet == "track 1, which was at the click (100, 200), is not there any more"


def test_each_run_starts_a_selector_anew():
    first, rounds, chosen = FirstCome(), most_served(), Chosen(number=2)
    for selector in (first, rounds, chosen):
        assert selector.select([candidate(2)], STILL, LIMITS) == 2
        selector.start((640, 480))
    # The first would stay, the second is not looked at for long enough yet, the third has gone and come back as 3.
    assert first.select([candidate(1), candidate(2)], STILL, LIMITS) == 1
    assert rounds.select([candidate(1, leaves=5.0), candidate(2)], STILL, LIMITS) == 1
    assert chosen.select([candidate(3, t=0.5)], STILL, LIMITS) is None
    assert selector.unmet == "track 2 is not there"


@pytest.mark.parametrize(
    "selector", [FirstCome(), Rounds("most-served"), Chosen(pixel=(3.5, 7.0)), Chosen(number=4)], ids=str
)
def test_a_selector_is_recorded_and_made_again(selector):
    table = json.loads(json.dumps(selector_table(selector)))
    check_selector_table(table)
    assert make_selector(table) == selector
    assert make_selector({}) == FirstCome()
    assert selector_table(None) == {}
