"""The benchmark of a turn: its figures of hand-made times."""

import dataclasses

import pytest

from benchmarks.turn import SETTINGS, Clock, missed, one, summarise
from cotarget.errors import CotargetError


def turn(ms, target="bird"):
    return {
        "target": target,
        "turn": ms,
        "mog2": 2.0,
        "detect": ms - 1,
        "track": 0.5,
        "position": 0.25,
        "close_up": 0.125,
        "control": 0.125,
    }


def test_a_turn_is_judged_over_the_median_of_the_subtraction():
    """By hand: of turns of 1 to 101 ms, the median is 51, the 95th percentile 96 and the 99th 100 ms, over 2 ms."""
    summary = summarise([turn(float(ms)) for ms in range(1, 102)] + [turn(6.0, "person")])
    assert [summary["bird"][name] for name in ("p50", "p95", "p99")] == [25.5, 48.0, 50.0]
    assert [summary["bird"][f"{name}_ms"] for name in ("mog2", "turn", "detect", "control")] == [2.0, 51.0, 50.0, 0.125]
    assert missed(summary) == ["bird: p50", "bird: p95"]


def test_a_part_counts_but_not_what_it_calls_in_others():
    """A close-up that asks the rig is a close-up, once."""
    clock = Clock()
    inner = clock.timed("rig", lambda: sum(range(1000)))
    clock.timed("close_up", inner)()
    assert set(clock.spent) == {"close_up"}
    inner()
    assert clock.spent["rig"] > 0


def test_a_target_that_is_never_followed_is_an_error():
    with pytest.raises(CotargetError, match="bird: was followed in no turn"):
        one(dataclasses.replace(SETTINGS, targets=("bird",), seconds=0.2), 0)
