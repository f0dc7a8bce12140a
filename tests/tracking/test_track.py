"""Sizes and travel of a track, from boxes that walk, drift, grow, jump, or enter the image."""

import numpy as np
import pytest

from cotarget.tracking.track import SizeHistory, Trail

DT = 0.04
IMAGE = (640, 480)


def filled(history, boxes, clipped=()):
    """A history of boxes (left, top, right, bottom), one a frame."""
    for i, (left, top, right, bottom) in enumerate(boxes):
        history.add(i * DT, ((left + right) / 2, (top + bottom) / 2), (right - left, bottom - top), i in clipped)
    return history


def travel(boxes, image_size=None, clipped=()):
    return filled(Trail(2.0, image_size), boxes, clipped).travel()


def moving(n, start, end):
    return np.linspace(start, end, n)


HERE = [0, 0, 30, 30]
BESIDE = [40, 0, 70, 30]


@pytest.mark.parametrize(("boxes", "way_px"), [
    # The medians of three boxes at either end lie one step inside: 28 of 30 steps.
    (moving(31, [10, 20, 40, 80], [40, 60, 70, 120]), 50 * 28 / 30),
    ([[0, 0, 8, 8]], 0.0),
    (moving(3, [0, 0, 8, 8], [6, 8, 14, 16]), 10.0),
    (moving(2, [0, 0, 8, 8], [6, 8, 14, 16]), 0.0),  # one step is a jump
    # It grows all around, or to one side, which moves its centre by 42 px.
    (moving(40, [100, 100, 120, 130], [60, 90, 160, 140]), 0.0),
    (moving(40, [100, 100, 120, 130], [100, 100, 180, 190]), 0.0),
    (moving(3, [0, 0, 30, 60], [20, 0, 60, 60]), 20.0),  # it grows while it moves: the slower edge counts
    ([HERE] * 20 + [BESIDE] * 20, 0.0),  # a jump
    (moving(40, HERE, BESIDE), 40 * 37 / 39),
    # 10 px/s over 10 s, of which the last two count, less one step at either end
    (moving(251, HERE, [100, 0, 130, 30]), 10 * (2.0 - 2 * DT)),
])  # fmt: skip
def test_travel_is_the_common_motion_of_both_edges(boxes, way_px):
    assert travel(boxes) == pytest.approx(way_px, rel=0.03)  # a box more or less


def test_target_that_enters_the_image_travels_by_the_edge_that_is_seen():
    boxes = [[-0.5, 10, right, 70] for right in moving(20, 5, 43)]
    assert travel(boxes, IMAGE, range(20)) == pytest.approx(36.0, abs=3)
    assert travel(boxes) == 0.0  # without the image's size the cut edge counts
    lower_edge_alone = [[-0.5, 10, 639.5, 10 + i] for i in range(20)]
    assert travel(lower_edge_alone, IMAGE, range(20)) == 0.0


def test_sizes_are_those_that_the_border_does_not_cut():
    boxes = [[-0.5, 0, 20, 60], [-0.5, 0, 25, 62], [5, 0, 35, 60], [6, 0, 38, 64]]
    np.testing.assert_allclose(filled(SizeHistory(0.5), boxes[:2], {0, 1}).size, [25.5, 62])
    whole = filled(SizeHistory(0.5), boxes, {0, 1})
    np.testing.assert_allclose(whole.size, [31, 62])
    assert whole.larger_side == pytest.approx(60 + 0.9 * 4)


def test_the_size_of_a_target_that_drives_away_follows_it():
    """A car becomes smaller by a third in 0.3 s; a person's stride or a bird's wings change one side, to and fro."""
    car = [[0, 0, 160 * 0.96**i, 120 * 0.96**i] for i in range(30)]
    size = np.array([160, 120]) * 0.96**29
    np.testing.assert_allclose(filled(SizeHistory(0.6, trend=True), car).size, size, rtol=0.1)
    assert filled(SizeHistory(0.6), car).size[0] > 1.3 * size[0]
    stride = [[0, 0, 40 + 15 * np.sin(2 * np.pi * 1.0 * i * DT), 120] for i in range(30)]
    assert filled(SizeHistory(0.6, trend=True), stride).size == pytest.approx(filled(SizeHistory(0.6), stride).size)


@pytest.mark.parametrize("beat_hz", [2.5, 4.0])
def test_the_larger_side_of_a_bird_that_flies_off_is_its_wingspan_of_the_last_beat(beat_hz):
    """It becomes smaller by a third in a second; between two beats its wings look half as wide."""
    spans = 60 * 0.985 ** np.arange(50)
    wings = [span * (0.75 + 0.25 * np.cos(2 * np.pi * beat_hz * i * DT)) for i, span in enumerate(spans)]
    history, errors = SizeHistory(0.6), []
    for i, (wing, span) in enumerate(zip(wings, spans, strict=True)):
        history.add(i * DT, (100.0, 100.0), (wing, 10.0), False)
        errors.append(history.larger_side / span - 1)
    assert np.mean(errors[15:]) == pytest.approx(0.0, abs=0.085)
    assert max(errors[15:]) < 0.145
