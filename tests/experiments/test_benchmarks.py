"""The benchmarks of a turn and in real time: their figures of hand-made times."""

import itertools
import math

from benchmarks import turn as turns
from benchmarks.frame_sizes import film
from benchmarks.real_time import LENGTH, ORDER, STREAM, frame_sent, missed, summarise


def rows(ages, hz=12.0):
    sent = [{"part": "stream", "frame": index, "age_ms": age} for index, age in enumerate(ages, 1)]
    return [*sent, {"part": "file", "hz": hz}]


def test_a_frame_that_was_not_worked_on_is_missed_and_has_no_age():
    summary = summarise(rows([None, *range(1, 102), None], hz=11.0))
    assert summary == {
        "stream": {"frames": 103, "missed": 2, "age_p50_ms": 51.0, "age_p95_ms": 96.0, "age_p99_ms": 100.0},
        "file": {"hz": 11.0},
    }
    assert missed(summary) == ["missed frames", "file"]
    assert missed(summarise(rows([None, 100.0]))) == []


def test_a_stream_of_which_nothing_was_worked_on_has_no_age():
    summary = summarise(rows([None] * 10))
    assert math.isnan(summary["stream"]["age_p95_ms"])
    assert missed(summary) == ["missed frames", "age"]


def test_a_frame_is_known_by_its_picture_even_if_others_were_sent_since():
    shown = dict(enumerate(film(STREAM, LENGTH, 0)))
    birds = [bird for _, bird in shown.values()]
    for index, late in itertools.product((3, 60, 100, len(ORDER) + 10), (0, 1, 5)):
        assert frame_sent(shown[ORDER[index % len(ORDER)]][0].image, index + late, birds) == index


def turn(ms, target="bird"):
    return {
        "target": target, "turn": ms, "mog2": 2.0, "detect": ms - 1, "track": 0.5, "position": 0.25,
        "close_up": 0.125, "control": 0.125,
    }  # fmt: skip


def test_a_turn_is_judged_over_the_median_of_the_subtraction():
    """By hand: of turns of 1 to 101 ms, the median is 51, the 95th percentile 96 and the 99th 100 ms, over 2 ms."""
    summary = turns.summarise([turn(float(ms)) for ms in range(1, 102)] + [turn(6.0, "person")])
    assert [summary["bird"][name] for name in ("p50", "p95", "p99")] == [25.5, 48.0, 50.0]
    assert [summary["bird"][f"{name}_ms"] for name in ("mog2", "turn", "detect", "control")] == [2.0, 51.0, 50.0, 0.125]
    assert turns.missed(summary) == ["bird: p50", "bird: p95"]
