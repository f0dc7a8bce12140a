"""Policies: hand-worked cases, the best order by trying all, and what each serves of targets that come and go."""

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from cotarget.control import selection
from cotarget.control.selection import (
    MOST_PLANNED,
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
from cotarget.rig import PanTiltLimits
from cotarget.tracking.track import Track

LIMITS = PanTiltLimits((-2.8, 2.8), (-0.8, 0.5), math.radians(149), math.radians(206), math.radians(0.0514286))
STILL = np.zeros(2)
FRAME = 0.04
LOOK_S, SETTLE_S = Rounds.look_s, Rounds.settle_s
nearest_deadline, most_served = POLICIES["nearest-deadline"], POLICIES["most-served"]
both_rounds = pytest.mark.parametrize("make", [nearest_deadline, most_served])


def track(number, center=(320.0, 240.0), velocity=(0.0, 0.0), size=(20.0, 20.0), t=0.0):
    center, velocity, size = (np.array(each, float) for each in (center, velocity, size))
    return Track(number, t, True, 0, center, velocity, size, float(size.max()), np.eye(4), 1.0, None)


def candidate(number, pan=0.0, *, rate=0.0, leaves=math.inf, seen=0.0, reachable=True, likely=True, **where):
    def at(later):
        return np.array([pan + rate * later, 0.0])

    return Candidate(track(number, **where), at, leaves, seen, reachable, likely)


def select(selector, *candidates, head=STILL):
    return selector.select(candidates, head, LIMITS)


@pytest.mark.parametrize(("way_deg", "limits", "seconds"), [
    # 206 degrees/s^2 reach 149 degrees/s after 0.7233 s and 53.89 degrees; with the braking, 107.77 degrees.
    ((20.0, 5.0), LIMITS, 2 * math.sqrt(20 / 206)),
    ((0.0, -140.0), LIMITS, 2 * 149 / 206 + (140 - 149**2 / 206) / 149),
    ((0.0, 0.0), LIMITS, 0.0),
    ((0.0, 149.0), replace(LIMITS, acceleration=math.inf), 1.0),
    ((0.0, 149.0), replace(LIMITS, acceleration=math.inf, speed=math.inf), 0.0),
])  # fmt: skip
def test_travel_time_is_that_of_the_units_profile(way_deg, limits, seconds):
    assert travel_s(np.radians(way_deg), limits) == pytest.approx(seconds)


@pytest.mark.parametrize(("center", "velocity", "seconds"), [
    ((320, 240), (0, 0), math.inf),
    ((320, 240), (100, 0), (639.5 - 320) / 100),
    ((320, 240), (-100, 200), (479.5 - 240) / 200),
    ((-5, 240), (-100, 0), 0.0),
])  # fmt: skip
def test_time_until_a_track_leaves_the_image(center, velocity, seconds):
    assert leaves_in(track(1, center, velocity), (640, 480)) == pytest.approx(seconds)


def test_first_come_stays_until_its_target_is_gone():
    selector = FirstCome()
    assert select(selector) is None
    assert select(selector, candidate(4), candidate(2)) == 2
    assert select(selector, candidate(1), candidate(2, seen=60.0)) == 2
    assert select(selector, candidate(3), candidate(4)) == 3


@pytest.mark.parametrize("make", POLICIES.values(), ids=POLICIES)
@pytest.mark.parametrize("fault", ["likely", "reachable"])
def test_target_that_is_unlikely_or_out_of_reach_comes_last(make, fault):
    selector, poor = make(), candidate(1, leaves=1.0, **{fault: False})
    assert select(selector, poor) == 1  # a nominal size may be wrong, and the run must say what is out of reach
    assert select(selector, poor, candidate(2)) == 2
    assert select(make(), poor, candidate(2, **{fault: False})) is not None
    assert selector.unmet == ""
    assert not selector.favours(track(1))


def test_nearest_deadline_comes_first_and_is_seen_to_its_end():
    selector = nearest_deadline()
    there = [candidate(1, 0.2, leaves=9.0), candidate(2, -0.2, leaves=4.0), candidate(3, 0.1, leaves=6.0)]
    assert select(selector, *there) == 2
    sooner = [*there, candidate(4, leaves=3.0)]
    assert select(selector, *sooner) == 2  # is being looked at
    assert select(selector, candidate(2, seen=LOOK_S, leaves=3.0), *(c for c in sooner if c.id != 2)) == 4


def test_nearest_deadline_passes_over_what_it_cannot_reach_in_time():
    lost, kept = candidate(1, 0.5, leaves=1.0), candidate(2, -0.5, leaves=9.0)
    assert select(nearest_deadline(), lost, kept) == 2
    assert select(nearest_deadline(), lost) == 1


@both_rounds
def test_when_all_have_been_seen_the_one_seen_least_is_next(make):
    assert select(make(), *(candidate(i, seen=seen) for i, seen in ((1, 5.0), (2, 2.0), (3, 3.0)))) == 2
    assert select(make()) is None


def test_plan_gives_up_one_to_have_two():
    """The far one on the left can be had, but the two on the right leave while the head comes back."""
    far = candidate(1, -2.4, leaves=3.5)
    right = [candidate(2, 0.2, leaves=4.2), candidate(3, 0.25, leaves=5.0)]
    one = travel_s(far.at, LIMITS) + SETTLE_S + LOOK_S
    assert one < 3.5
    assert one + travel_s(right[0].at - far.at, LIMITS) + SETTLE_S + LOOK_S > 5.0
    assert select(nearest_deadline(), far, *right) == 1
    assert select(most_served(), far, *right) in (2, 3)


def test_plan_is_kept_while_the_times_to_leave_waver():
    selector, rng, chosen = most_served(), np.random.default_rng(0), set()
    for k in range(25):  # a second
        leaves, t = rng.uniform(3.0, 9.0, 3), FRAME * k
        there = (candidate(i, 0.2 * i, leaves=leaves[i], seen=t * (i in chosen), t=t) for i in range(3))
        chosen.add(select(selector, *there))
    assert len(chosen) == 1
    gone = (candidate(i, 0.2 * i, leaves=0.1 if i in chosen else 9.0, t=1.0) for i in range(3))
    assert select(selector, *gone) not in chosen


@both_rounds
def test_no_target_is_left_before_the_lens_has_settled(make):
    """Two that leave in turn too soon: a new plan in every frame would go to and fro between them."""
    selector, found, turned = make(), [], [0.0]
    for k in range(100):
        leaves = (9.0, 1.0) if k % 2 else (1.0, 9.0)
        there = (candidate(i, 0.4 * i - 0.6, leaves=leaves[i - 1], t=FRAME * k) for i in (1, 2))
        found.append(select(selector, *there))
        turned += [FRAME * k] if k and found[-1] != found[-2] else []
    assert all(np.diff(turned) >= SETTLE_S - 1e-9)
    other = 3 - found[-1]
    assert select(selector, candidate(other, t=4.0)) == other  # the one that is gone is not waited for


@both_rounds
@pytest.mark.parametrize("apart", [0.01, 0.1, 0.4])
def test_targets_that_were_all_seen_are_looked_at_in_turn_and_for_long_enough(make, apart):
    selector, pans, seen, head, goal, arrives, turned = make(), apart * np.arange(3), np.zeros(3), 0.0, None, 0.0, []
    for t in np.arange(0, 20, FRAME):
        there = (candidate(i, pans[i], seen=seen[i], t=t) for i in range(3))
        found = select(selector, *there, head=np.array([head, 0.0]))
        if found != goal:
            arrives = t + travel_s((pans[found] - head, 0.0), LIMITS) + 0.3
            goal = found
            turned.append(t)
        if t >= arrives:
            head = pans[goal]
            seen[goal] += FRAME
    assert np.diff(turned).min() >= LOOK_S - 1.01 * FRAME
    assert seen.sum() > 20 / 2
    assert np.ptp(seen) <= LOOK_S + 1.01 * FRAME


@both_rounds
def test_target_hidden_from_the_zoom_camera_alone_does_not_keep_the_head(make):
    selector, seen, hidden, turned = make(), np.full(2, 2.0), 0, []
    for t in np.arange(0.0, 20, FRAME):
        turned.append(select(selector, *(candidate(i, 0.1 * i, seen=seen[i], t=t) for i in range(2))))
        seen[turned[-1]] += FRAME * (turned[-1] != hidden)
    assert np.mean(turned) > 0.3  # the part of the time for which the other one is looked at


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


def planned(candidates):
    return plan(SelectionState(candidates, None, (0.0, 0.0), LIMITS, LOOK_S, SETTLE_S))


def test_plan_is_the_best_of_all_orders():
    rng, sharp = np.random.default_rng(3), 0
    for _ in range(25):
        five = [
            candidate(i, rng.uniform(-1.5, 1.5), rate=rng.uniform(-0.1, 0.1), leaves=rng.uniform(2, 9))
            for i in range(5)
        ]
        found, best = planned(five), served_by_best_order(five, STILL)
        assert abs(found.served - best) <= 1  # the way to a moving target is only nearly right
        sharp += found.served == best
        assert select(most_served(), *five) == found.first
    assert sharp >= 23


def test_plan_of_many_takes_a_part_of_a_frame(monkeypatch):
    """All can be had in any order, so that nothing is left out: ways are counted, as time depends on the machine."""
    ways = []
    monkeypatch.setattr(selection, "travel_s", lambda way, limits: ways.append(way) or travel_s(way, limits))
    planned([candidate(i, 0.1 * i, leaves=1000.0) for i in range(MOST_PLANNED + 3)])
    n = MOST_PLANNED
    # Two ways for each step from a set of targets and the last of it to another target, and to each as the first.
    assert len(ways) <= 2 * (n + n * (n - 1) * 2 ** (n - 2)) < 3000  # of some microseconds each; orders there are 13699


def test_plan_that_serves_no_target_begins_with_the_one_done_first():
    found = planned([candidate(1, 0.5, leaves=0.1), candidate(2, -0.2, leaves=0.2)])
    assert (found.served, found.first) == (0, 2)


def simulated(selector, rng, seconds=20.0, targets=5):
    """How many of five targets that cross the view were seen for a second: a head by its profile, no errors."""
    begins = rng.uniform(0, 8, targets)
    speeds = rng.uniform(0.08, 0.2, targets) * rng.choice([-1, 1], targets)
    starts = -np.sign(speeds) * 0.43
    seen, head, arrives, goal = np.zeros(targets), np.zeros(2), 0.0, None
    for t in np.arange(0, seconds, FRAME):
        at = starts + speeds * (t - begins)
        leaves = (0.43 - at * np.sign(speeds)) / np.abs(speeds)
        there = np.flatnonzero((t >= begins) & (np.abs(at) < 0.43)).tolist()
        known = (candidate(i, at[i], rate=speeds[i], leaves=leaves[i], seen=seen[i], t=t) for i in there)
        if (chosen := select(selector, *known, head=head)) != goal and chosen is not None:
            arrives = t + travel_s(np.array([at[chosen], 0.0]) - head, LIMITS) + 0.5
        if (goal := chosen) is not None:
            head = np.array([at[goal], 0.0])
            seen[goal] += FRAME * (t >= arrives)
    return int(np.sum(seen >= 1.0))


def test_planning_serves_most_of_targets_that_come_and_go():
    served = {
        name: sum(simulated(make(), np.random.default_rng(seed)) for seed in range(15))
        for name, make in POLICIES.items()
    }
    print(served)
    assert served["most-served"] >= served["nearest-deadline"]
    assert served["most-served"] >= 1.5 * served["first-come"]


def clicked(pixel, width_px=640):
    selector = Chosen(pixel=pixel)
    selector.start((width_px, 480))
    return selector


def test_chosen_number_is_followed_in_reach_or_not_and_no_other():
    selector = Chosen(number=3)
    assert [selector.favours(track(n)) for n in (1, 3)] == [False, True]
    for there, found in (((1, 2), None), ((1, 3), 3), ((1,), None)):
        assert select(selector, *(candidate(n, reachable=n == 1) for n in there)) == found
        assert selector.unmet == ("" if found else "track 3 is not there")


@pytest.mark.parametrize(("pixel", "found"), [((131, 101), 2), ((80, 80), 1), ((160, 100), 2), ((400, 300), None)])
def test_click_means_the_box_that_holds_it_or_the_nearest_one_near(pixel, found):
    large, small = candidate(1, center=(100, 100), size=(80, 80)), candidate(2, center=(130, 100), size=(8, 8))
    assert select(clicked(pixel), large, small) == found


def test_clicked_target_keeps_its_number():
    selector = clicked((100.0, 200.0), 500.0)  # 40 px are near
    near, far = {"center": (100, 239)}, {"center": (100, 241)}
    assert [selector.favours(track(1, **where)) for where in (near, far)] == [True, False]
    assert select(selector, candidate(2, **far)) is None
    assert selector.unmet == "no track at the click (100, 200)"
    assert select(selector, candidate(1, **near)) == 1
    assert selector.unmet == ""
    assert [selector.favours(track(n, center=(100, 200))) for n in (1, 3)] == [True, False]
    assert select(selector, candidate(1, center=(20, 20)), candidate(2, center=(100, 200))) == 1
    assert select(selector) is None
    assert selector.unmet == "track 1, which was at the click (100, 200), is not there any more"


def lost_at_zero(**last):
    """A selector whose chosen target, number 2, was seen last at the time 0; number 5 was there too."""
    selector = Chosen(number=2)
    assert select(selector, candidate(2, **last), candidate(5, center=(20, 20))) == 2
    return selector


def test_chosen_target_that_was_hidden_is_followed_on_under_another_number():
    selector = lost_at_zero(center=(300, 200), velocity=(50, 0))
    assert select(selector, candidate(5, center=(20, 20), t=1.0)) is None
    assert selector.favours(track(6, center=(370, 200), t=1.5))  # 75 px on, where it would be
    beside = candidate(7, center=(400, 200), t=1.5)
    assert select(selector, candidate(6, center=(370, 200), t=1.5), beside) == 6
    assert selector.unmet == ""
    assert select(selector, beside) is None  # it was there at the same time
    assert select(selector, candidate(8, center=(370, 200), t=4.0)) == 8


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
def test_no_other_target_is_taken_for_the_chosen_one(number, where):
    selector = lost_at_zero(center=(300, 200), velocity=(50, 0))
    assert not selector.favours(track(number, **where))
    assert select(selector, candidate(number, **where)) is None
    assert selector.unmet == "track 2 is not there"


def test_chosen_target_that_has_left_the_view_is_not_back():
    selector = lost_at_zero(center=(600, 200), velocity=(80, 0), leaves=0.5)
    assert select(selector, candidate(6, center=(639, 200), velocity=(-80, 0), t=0.6)) is None


def test_each_run_starts_a_selector_anew():
    first, rounds, chosen = FirstCome(), most_served(), Chosen(number=2)
    for selector in (first, rounds, chosen):
        assert select(selector, candidate(2)) == 2
        selector.start((640, 480))
    # The first would stay, the second is not looked at for long enough yet, the third has gone and come back as 3.
    assert select(first, candidate(1), candidate(2)) == 1
    assert select(rounds, candidate(1, leaves=5.0), candidate(2)) == 1
    assert select(chosen, candidate(3, t=0.5)) is None


@pytest.mark.parametrize(
    "selector", [FirstCome(), Rounds("most-served"), Chosen(pixel=(3.5, 7.0)), Chosen(number=4)], ids=str
)
def test_selector_is_recorded_and_made_again(selector):
    table = json.loads(json.dumps(selector_table(selector)))
    check_selector_table(table)
    assert make_selector(table) == selector
    assert make_selector({}) == FirstCome()
    assert selector_table(None) == {}
