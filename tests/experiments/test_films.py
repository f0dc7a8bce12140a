"""The comparison on films: its figures of hand-made rows, and the flyers without a label."""

import numpy as np
import pytest

from cotarget.track_metrics import Box, Criterion, Tracked
from experiments.following.films import missed, off_boxes, summarise, unlabelled_flyers


def row(way, threshold, found, false_tracks, no_flyer):
    return {
        "way": way,
        "threshold": threshold,
        "smallest_px": 0,
        "boxes": 100,
        "found": found,
        "false_tracks": false_tracks,
        "no_flyer": no_flyer,
        "minutes": 1.0,
    }


def test_recall_at_so_many_false_tracks_counts_them_both_ways():
    """By hand: two films of a minute; `auto` has 4 a minute at 0.9 and 0.5 at 0.6, of which half are on birds."""
    rows = [
        row("auto", 0.5, 95, 8, 4),
        row("auto", 0.5, 85, 0, 0),
        row("auto", 0.9, 60, 1, 0),
        row("auto", 0.9, 60, 0, 0),
    ]
    rows += [row(way, 16.0, 60, 60, 60) for way in ("MOG2", "MOG2", "KNN", "KNN")]
    summary = summarise(rows)
    assert summary["auto"] == {
        "recall at 0.5 a minute": 0.6,
        "recall at 5 a minute": 0.9,
        "recall at 50 a minute": 0.9,
        "recall at 0.5 a minute, no flyer": 0.6,
        "recall at 5 a minute, no flyer": 0.9,
        "recall at 50 a minute, no flyer": 0.9,
    }
    assert set(summary["KNN"].values()) == {0.0}
    assert missed(summary) == []
    rows += [row(way, 9.0, 57, 0, 0) for way in ("MOG2", "MOG2", "KNN", "KNN")]
    assert missed(summarise(rows)) == ["recall at 0.5 a minute", "recall at 0.5 a minute, no flyer"]


def test_flyers_without_a_label_are_between_the_boxes_listed():
    """From the list: flyer 1 of V_BIRD_007 is at (22.2, 274.3) in frame 16 and (13.9, 274.2) in frame 21, 2 x 4 px."""
    boxes = unlabelled_flyers("V_BIRD_007")
    assert sorted(boxes)[0] == 16
    (box,) = boxes[17]
    assert box.center_px == pytest.approx([22.2 - 8.3 / 5 + 0.5, 274.28 + 1.5])
    assert box.size_px == pytest.approx([2, 4])
    assert unlabelled_flyers("V_DRONE_008") == {}
    assert np.mean([len(unlabelled_flyers("V_BIRD_022")[frame]) for frame in (194, 200)]) >= 3


def test_what_lies_on_a_box_that_must_not_count_is_left_out():
    bird = Box(np.array([50.0, 50.0]), np.array([10.0, 10.0]))
    on, off, later = (
        Tracked(np.array(at), np.array([10.0, 10.0]), frame, frame / 25, 1)
        for at, frame in (([53.0, 50.0], 3), ([70.0, 50.0], 3), ([50.0, 50.0], 4))
    )
    assert off_boxes([on, off, later], {3: [bird]}, Criterion()) == [off, later]
