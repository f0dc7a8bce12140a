"""Altered films: their labels move with them, and specks are counted apart."""

import numpy as np
import pytest

from cotarget.rig import Frame
from cotarget.track_metrics import Box, Label
from experiments.following.altered_films import compressed, dropped, missed, scaled, shaken, summarise
from experiments.following.films import LabelledFilm

RATE = 25.0


def film(frames=60, width=80, height=60):
    """A dark square of 8 px at (20, 30) that moves by a quarter of a pixel a frame."""
    pictures, boxes = [], []
    for i in range(frames):
        picture = np.full((height, width, 3), 200, np.uint8)
        left = 16 + i // 4
        picture[26:34, left : left + 8] = 20
        pictures.append(Frame(picture, i / RATE))
        boxes.append(Box(np.array([left + 3.5, 29.5]), np.array([8.0, 8.0])))
    labels = {i: [Label(box.center_px, box.size_px)] for i, box in enumerate(boxes)}
    return LabelledFilm("made", pictures, RATE, labels, {i: [box] for i, box in enumerate(boxes)})


def dark(frame):
    """Centre of what is dark."""
    weight = 200.0 - frame.image[..., 0]
    v, u = np.mgrid[: weight.shape[0], : weight.shape[1]]
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


@pytest.mark.parametrize("alter", [lambda made: scaled(made, 0.5), lambda made: scaled(made, 2.0), shaken, dropped])
def test_labels_stay_on_their_target(alter):
    altered = alter(film())
    for i, frame in enumerate(altered.frames):
        for boxes in (altered.labels, altered.flyers):
            assert boxes[i][0].center_px == pytest.approx(dark(frame), abs=0.15)


def test_scaled_films_have_boxes_of_that_size():
    half = scaled(film(), 0.5)
    assert half.frames[0].image.shape == (30, 40, 3)
    assert half.labels[0][0].size_px.tolist() == [4, 4]


@pytest.mark.parametrize(("times", "small_px"), [(0.5, 24.0), (2.0, 48.0)])
def test_small_boxes_of_a_larger_film_are_larger(times, small_px):
    assert scaled(film(2), times).criterion.small_px == small_px


def test_dropped_frames_leave_the_others_at_their_times():
    times = [frame.t for frame in dropped(film(1000)).frames]
    assert len(times) == pytest.approx(700, abs=50)
    assert times[-1] == pytest.approx(1000 / RATE, abs=10 / RATE)


def test_compressed_films_are_coarser():
    before, after = film().frames[0].image, compressed(film()).frames[0].image
    assert 1 < np.abs(before.astype(int) - after).max() < 40


def test_specks_of_both_smaller_films_count_together():
    """By hand: 10 of 10 and 70 of 90 are 80 of 100."""
    row = {"boxes": 100, "found": 90, "false_tracks": 3, "no_flyer": 1, "minutes": 2.0}
    rows = [
        {**row, "way": "as it is", "specks": 0, "specks_found": 0},
        {**row, "way": "half", "specks": 10, "specks_found": 10},
        {**row, "way": "a third", "specks": 90, "specks_found": 70},
    ]
    summary = summarise(rows)
    assert summary["half and a third"] == {"recall up to 12 px": 0.8}
    assert summary["half"]["false tracks a minute"] == 1.5
    assert summary["half"]["the same, no flyer"] == 0.5
    assert missed(summary) == ["half and a third: recall up to 12 px: 0.800, not 0.9 or more"]
