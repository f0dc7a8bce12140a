"""How far a target has come by its boxes' edges: what walks, what drifts, grows, jumps, or enters the image."""

import numpy as np
import pytest

from cotarget.detection import Detection
from cotarget.tracking.track import LiveTrack, SizeHistory, TrackingSettings, Trail

DT = 0.04


def trail(boxes, image_size=None, clipped=()):
    """Of boxes (left, top, right, bottom), one a frame."""
    found = Trail(2.0, image_size)
    for i, (left, top, right, bottom) in enumerate(boxes):
        found.add(i * DT, ((left + right) / 2, (top + bottom) / 2), (right - left, bottom - top), i in clipped)
    return found


def sizes(boxes, clipped=()):
    """Of boxes (left, top, right, bottom), one a frame."""
    found = SizeHistory(size_s=0.6, beat_s=0.5)
    for i, (left, top, right, bottom) in enumerate(boxes):
        found.add(i * DT, right - left, bottom - top, i in clipped)
    return found


def moving(n, start, end):
    return np.linspace(start, end, n)


def test_what_moves_has_come_as_far_as_it_went():
    # The medians of three boxes at either end lie one step inside: 28 of 30 steps.
    way = trail(moving(31, [10, 20, 40, 80], [40, 60, 70, 120])).travel()
    assert way == pytest.approx(50 * 28 / 30)


def test_two_boxes_are_enough_for_a_way_without_a_jump():
    assert trail([[0, 0, 8, 8]]).travel() == 0.0
    assert trail(moving(3, [0, 0, 8, 8], [6, 8, 14, 16])).travel() == pytest.approx(10.0)
    assert trail(moving(2, [0, 0, 8, 8], [6, 8, 14, 16])).travel() == 0.0  # one step is a jump


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ([100, 100, 120, 130], [60, 90, 160, 140]),  # all around
        ([100, 100, 120, 130], [100, 100, 180, 190]),  # to one side: its middle goes 42 px
    ],
)
def test_what_grows_has_not_come(start, end):
    assert trail(moving(40, start, end)).travel() == 0.0


def test_what_grows_while_it_moves_has_come_as_far_as_its_slower_edge():
    assert trail(moving(3, [0, 0, 30, 60], [20, 0, 60, 60])).travel() == pytest.approx(20.0)


def test_a_jump_is_no_way_gone():
    there = [*([[0, 0, 30, 30]] * 20), *([[40, 0, 70, 30]] * 20)]
    assert trail(there).travel() == 0.0
    assert trail(moving(40, [0, 0, 30, 30], [40, 0, 70, 30])).travel() > 30.0


def test_only_the_last_seconds_count():
    slow = moving(251, [0, 0, 30, 30], [100, 0, 130, 30])  # 10 px/s over 10 s
    assert trail(slow).travel() == pytest.approx(10 * 2.0, rel=0.1)


def test_what_enters_tells_its_way_by_the_edge_that_is_seen():
    boxes = [[-0.5, 10, right, 70] for right in moving(20, 5, 43)]
    assert trail(boxes, (640, 480), range(20)).travel() == pytest.approx(36.0, abs=3)
    assert trail(boxes).travel() == 0.0  # nobody said where the border is
    both = [[-0.5, 10, 639.5, 10 + i] for i in range(20)]  # nothing but the lower edge is seen to move
    assert trail(both, (640, 480), range(20)).travel() == 0.0


def test_sizes_are_those_that_the_border_does_not_cut():
    boxes = [[-0.5, 0, 20, 60], [-0.5, 0, 25, 62], [5, 0, 35, 60], [6, 0, 38, 64]]
    cut = sizes(boxes[:2], {0, 1})
    np.testing.assert_allclose(cut.size, [25.5, 62])
    whole = sizes(boxes, {0, 1})
    np.testing.assert_allclose(whole.size, [31, 62])
    assert whole.larger_side == pytest.approx(60 + 0.9 * 4)


def confirmed_after(speed, size, seconds=20.0, flicker=0.1):
    """When a thing of a size [px] that moves steadily [px/s] is believed [s], its outline flickering; None if never."""
    rng = np.random.default_rng(0)
    settings = TrackingSettings(confirm_travel=0.5)
    found = None
    for i in range(round(seconds / DT)):
        low, high = np.array([100 + speed * i * DT, 100]), np.array([100 + speed * i * DT, 100]) + size
        low, high = low + flicker * size * rng.uniform(-1, 1, 2), high + flicker * size * rng.uniform(-1, 1, 2)
        seen = Detection((low + high) / 2, high - low, 1.0)
        if found is None:
            found = LiveTrack(1, seen, 0.0, settings)
        else:
            found.predict(i * DT)
            found.correct(seen)
        if found.confirmed:
            return i * DT
    return None


def test_a_cloud_that_drifts_is_never_believed_and_a_walker_soon():
    assert confirmed_after(5.0, 50.0) is None
    assert confirmed_after(75.0, 90.0) < 1.0
