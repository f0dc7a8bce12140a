"""The benchmark in real time: its figures of hand-made ages."""

import math

import pytest

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


@pytest.mark.parametrize("late", [0, 1, 5])
def test_a_frame_is_known_by_its_picture_even_if_others_were_sent_since(late):
    shown = dict(enumerate(film(STREAM, LENGTH, 0)))
    birds = [bird for _, bird in shown.values()]
    for index in (3, 60, 100, len(ORDER) + 10):
        assert frame_sent(shown[ORDER[index % len(ORDER)]][0].image, index + late, birds) == index
