"""Dead reckoning and steering of axes, in simulated time."""

import math

import pytest

from cotarget.drivers.axes import AxisFacts
from cotarget.drivers.velocity import ReckonedAxis, SteeredAxis

FACTS = AxisFacts(unit=1.0, lowest=-100.0, highest=100.0, fastest=50.0, step=0.0, slack=0.1, loses_steps=False)
DELAY_S = 0.1


def test_an_axis_of_unknown_position_arrives_when_it_must_have():
    """From the far end, 150 away, at 50/s: 3 s and the delay, also where the command is repeated meanwhile."""
    for repeated in (1, 58):
        axis = ReckonedAxis(FACTS, DELAY_S)
        assert axis.at(0.0)[1] >= 100.0  # it may be anywhere
        for i in range(repeated):
            axis.command(50.0, 50.0, i * 0.05)
        position, sigma = axis.at(2.9)
        # Of 40, from the far end, and 50; and a tenth of what is left, since the speed is not known well.
        assert position == pytest.approx(45.0)
        assert sigma == pytest.approx(5.5)
        assert axis.at(3.11) == (50.0, 0.0)


def test_a_known_axis_is_where_its_speed_takes_it():
    axis = ReckonedAxis(FACTS, DELAY_S)
    axis.correct(0.0, 0.0)
    axis.command(20.0, 10.0, 0.0)
    assert axis.at(1.1) == (pytest.approx(10.0), pytest.approx(1.0))
    axis.halt(1.1)
    assert axis.at(9.0) == (pytest.approx(10.0), 0.0)
    axis.correct(11.0, 9.0)
    assert axis.at(9.5) == (11.0, 0.0)


def test_an_axis_that_was_halted_stays_where_it_says_it_is():
    """Halted at 0 by reckoning; it says 3, of a time before the halt, and nothing more."""
    axis = ReckonedAxis(FACTS, 0.0)
    axis.correct(0.0, 0.0)
    axis.halt(1.0)
    axis.correct(3.0, 0.9)
    assert axis.at(9.0) == (3.0, 0.0)
    assert axis.arrives <= 1.0


def steered(goals, seconds, late=0.05, dated=None, start=0.0, stops_late=0.0, known=0.0, slowest=0.0):
    """Positions of an axis that turns at the velocities it gets, ``DELAY_S`` later, and is asked 20 times a second.

    Args:
        goals: goal at a time, or None.
        seconds: duration.
        late: age of reported positions.
        dated: that age, as the axis is told; the true one by default.
        start: position.
        stops_late: time for which it goes on after a stop, if no other velocity comes meanwhile.
        known: that time, as the axis is told.
        slowest: its lowest speed.
    """
    axis, position, sent, places = SteeredAxis(FACTS, DELAY_S, known), start, [], []
    history = [(-1.0, start)]
    for i in range(round(seconds * 100)):
        now = i / 100
        known_to_it = [(t + DELAY_S, v) for t, v in sent if t <= now - DELAY_S]
        changes = [(t, v) for i, (t, v) in enumerate(known_to_it) if i == 0 or v != known_to_it[i - 1][1]]
        while changes and changes[-1][1] == 0 and changes[-1][0] > now - stops_late:
            changes.pop()
        velocity = changes[-1][1] if changes else 0.0
        if velocity:
            velocity = math.copysign(max(abs(velocity), slowest), velocity)
        position += velocity / 100
        history.append((now, position))
        if i % 10 == 0 and (goal := goals(now)) is not None:
            axis.aim(goal, 50.0, now)
        if i % 5 == 0:
            seen = next(p for when, p in reversed(history) if when <= now - late)
            velocity = axis.wanted(seen, now - (late if dated is None else dated), now)
            axis.send(velocity, now)
            sent.append((now, velocity))
        places.append(position)
    return places


def test_an_axis_is_steered_to_its_goal_without_going_beyond():
    places = steered(lambda now: 30.0 if now == 0 else None, 3.0)
    assert max(places) < 30.0 + 2 * FACTS.slack
    assert places[-1] == pytest.approx(30.0, abs=FACTS.slack)


def test_an_axis_keeps_up_with_a_goal_that_moves():
    """As late as the delay, over which who sets the goals predicts."""
    places = steered(lambda now: 8.0 * now, 4.0)
    assert places[-1] == pytest.approx(8.0 * (4.0 - DELAY_S), abs=0.3)


def test_an_axis_does_not_go_beyond_its_range_with_its_goals():
    """They come at 40/s and stay at its end."""
    places = steered(lambda now: min(40.0 * now, FACTS.highest), 5.0)
    assert max(places) <= FACTS.highest
    assert places[-1] == pytest.approx(FACTS.highest, abs=FACTS.slack)


@pytest.mark.parametrize(("stops_late", "slowest", "off"), [(0.4, 0.0, 0.1), (1.1, 0.0, 0.1), (1.1, 1.5, 1.0)])
def test_an_axis_that_turns_on_after_a_stop_comes_to_rest_at_its_goal(stops_late, slowest, off):
    """Within the slack, or, by its lowest speed of 1.5/s, within less than the 1.65 that it goes on."""
    places = steered(lambda now: 30.0, 20.0, stops_late=stops_late, known=stops_late, slowest=slowest)
    assert max(places[-200:]) == min(places[-200:]) == pytest.approx(30.0, abs=off)


@pytest.mark.parametrize(("stops_late", "slowest", "off"), [(0.4, 1.5, 0.6), (1.1, 0.0, 0.2)])
def test_an_axis_of_which_nobody_knows_that_it_turns_on_comes_to_rest_too(stops_late, slowest, off):
    places = steered(lambda now: 30.0, 20.0, stops_late=stops_late, slowest=slowest)
    assert max(places[-200:]) == min(places[-200:]) == pytest.approx(30.0, abs=off)


@pytest.mark.parametrize("stops_late", [0.4, 1.1])
def test_an_axis_goes_to_its_goal_in_one_go_beside_another_one_that_stops_late_too(stops_late):
    """The device turns on where both velocities are 0, and halts one axis at once where the other turns."""
    axes, goals = [SteeredAxis(FACTS, DELAY_S, stops_late) for _ in range(2)], (20.0, 5.0)
    places, velocities, starts = [0.0, 0.0], [0.0, 0.0], [0, 0]
    orders = []  # (time, velocities)
    for axis, goal in zip(axes, goals, strict=True):
        axis.aim(goal, 50.0, 0.0)
    for i in range(1500):
        now = i / 100
        if i % 5 == 0:
            pan = axes[0].wanted(places[0], now, now, alone=not axes[1].velocity)
            tilt = axes[1].wanted(places[1], now, now, alone=not pan)
            if (pan, tilt) != (axes[0].velocity, axes[1].velocity):
                for axis, velocity in zip(axes, (pan, tilt), strict=True):
                    axis.send(velocity, now, alone=not (pan or tilt))
                if pan or tilt:
                    orders = [order for order in orders if any(order[1])]  # a stop that has not begun
                orders.append((now + DELAY_S + (0.0 if pan or tilt else stops_late), (pan, tilt)))
        while orders and orders[0][0] <= now:
            before, velocities = velocities, orders.pop(0)[1]
            starts = [n + (a == 0 != b) for n, a, b in zip(starts, before, velocities, strict=True)]
        places = [at + velocity / 100 for at, velocity in zip(places, velocities, strict=True)]
    assert starts == [1, 1]
    assert places == pytest.approx(goals, abs=FACTS.slack)


@pytest.mark.parametrize("stops_late", [0.0, 0.4])
def test_an_axis_of_which_nobody_knows_that_its_positions_are_late_comes_to_rest_near_its_goal(stops_late):
    """By half a second; it is sent on once it stands. It went to and fro by 20 without end."""
    places = steered(lambda now: 30.0 if now < 20 else 60.0, 40.0, late=0.5, dated=0.0, stops_late=stops_late)
    for goal, at in ((30.0, places[1800:2000]), (60.0, places[-200:])):
        assert max(at) == min(at) == pytest.approx(goal, abs=1.0)


@pytest.mark.parametrize(("answer", "obeyed", "read"), [
    (answer, obeyed, read) for answer in (0.2, 0.3, 0.5) for obeyed in (0.0, 1.0) for read in (0.0, 1.0)
])  # fmt: skip
def test_an_axis_of_a_device_that_answers_late_comes_to_rest_at_its_goal(answer, obeyed, read):
    """Whatever part of the time for an answer has passed when it obeys, and when it reads its position."""
    axis, places, orders, free = SteeredAxis(FACTS, DELAY_S, answer=answer), [0.0], [(-1.0, 0.0)], 0.0
    axis.aim(60.0, 50.0, 0.0)
    for i in range(2000):
        now = i / 100
        velocity = next(v for t, v in reversed(orders) if t <= now)
        places.append(places[-1] + velocity / 100)
        if now >= free:  # each command and each position is one exchange
            t = now - (1.0 - read) * answer
            wanted = axis.wanted(places[max(round(100 * t), 0)], now, now)
            if wanted != axis.velocity:
                axis.send(wanted, now)
                orders.append((now + obeyed * answer + DELAY_S, wanted))
            free = now + answer
    assert max(places[-300:]) == min(places[-300:]) == pytest.approx(60.0, abs=2 * FACTS.slack)


def test_a_goal_that_is_given_again_moves_no_more():
    """As at a soft limit."""
    axis = SteeredAxis(FACTS, 0.0)
    for i in range(10):
        axis.aim(4.0 * i, 50.0, i * 0.1)
        axis.send(0.0, i * 0.1)
    assert axis.wanted(36.0, 0.9, 0.9) > 20.0
    axis.aim(36.0, 50.0, 1.0)
    assert axis.wanted(36.0, 1.0, 1.0) == 0.0


def test_goals_that_end_at_the_range_lead_not_beyond_it():
    """The last goal, 2 before the end, has 0.4 s of flow at 40/s."""
    axis = SteeredAxis(FACTS, 0.0)
    for i in range(20):
        axis.aim(98.0 - 40.0 * (19 - i) * 0.1, 50.0, i * 0.1)
        axis.send(0.0, i * 0.1)
    assert axis.wanted(98.0, 2.3, 2.3) == pytest.approx(4.0 * 2.0)
    assert axis.wanted(100.0, 2.3, 2.3) == 0.0


def test_no_velocity_is_above_the_limit():
    axis = SteeredAxis(FACTS, DELAY_S)
    axis.aim(90.0, 20.0, 0.0)
    assert axis.wanted(0.0, 0.0, 0.0) == 20.0
    axis.stop(0.1)
    assert axis.wanted(0.0, 0.1, 0.1) == 0.0
    assert math.isclose(axis.velocity, 0.0)
