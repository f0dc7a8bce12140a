"""The experiments on films: their figures of hand-made rows, altered films, drawn shapes, and folds of the score."""

import numpy as np
import pytest

from cotarget.rig import Frame
from cotarget.track_metrics import Box, Criterion, Label, Tracked
from experiments.following import altered_films, own_shapes, score_folds
from experiments.following.altered_films import dropped, scaled, shaken
from experiments.following.films import LabelledFilm, missed, off_boxes, summarise, unlabelled_flyers
from experiments.following.own_shapes import SHAPES, draw_shape
from experiments.following.score_folds import ALL, OTHERS, fit, folds


def row(way, threshold, found, false_tracks, no_flyer):
    return {
        "way": way, "threshold": threshold, "smallest_px": 0, "boxes": 100, "found": found,
        "false_tracks": false_tracks, "no_flyer": no_flyer, "minutes": 1.0,
    }  # fmt: skip


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


def test_dropped_frames_leave_the_others_at_their_times():
    times = [frame.t for frame in dropped(film(1000)).frames]
    assert len(times) == pytest.approx(700, abs=50)
    assert times[-1] == pytest.approx(1000 / RATE, abs=10 / RATE)


def test_specks_of_both_smaller_films_count_together():
    """By hand: 10 of 10 and 70 of 90 are 80 of 100."""
    row = {"boxes": 100, "found": 90, "false_tracks": 3, "no_flyer": 1, "minutes": 2.0}
    rows = [
        {**row, "way": "as it is", "specks": 0, "specks_found": 0},
        {**row, "way": "half", "specks": 10, "specks_found": 10},
        {**row, "way": "a third", "specks": 90, "specks_found": 70},
    ]
    summary = altered_films.summarise(rows)
    assert summary["half and a third"] == {"recall up to 12 px": 0.8}
    assert summary["half"]["false tracks a minute"] == 1.5
    assert summary["half"]["the same, no flyer"] == 0.5
    assert altered_films.missed(summary) == ["half and a third: recall up to 12 px: 0.800, not 0.9 or more"]


def test_targets_and_others_are_equally_likely_in_every_film():
    """Normal clouds around +1 and -1 with variance 1: by hand, the balanced log odds are 2 (x + y + z)."""
    rng = np.random.default_rng(1)

    def film(targets, others):
        cloud = rng.normal(0, 1, (targets + others, 3))
        on = np.arange(targets + others) < targets
        return cloud + np.where(on, 1.0, -1.0)[:, None], on

    weights = fit([film(1000, 20000), film(20000, 2000), (np.ones((5, 3)), np.ones(5, bool))])
    assert weights == pytest.approx((2, 2, 2, 0), abs=0.25)


def test_films_of_one_place_are_in_one_fold():
    names = ["V_BIRD_006", "V_BIRD_007", "V_BIRD_002", "V_DRONE_008", "V_BIRD_021", "V_BIRD_022", "one", "two"]
    found = folds(names)
    assert sorted(i for fold in found for i in fold) == list(range(8))
    assert sorted(len(fold) for fold in found) == [1, 1, 2, 2, 2]
    for one, other in ((0, 1), (2, 3), (4, 5)):
        assert any(one in fold and other in fold for fold in found)


def test_recall_on_films_that_were_not_fitted_is_near_that_on_fitted_ones():
    """By hand: 90 + 50 of 200 boxes are 0.7."""
    weights = {"signal": 2.0, "change": 3.0, "texture": -1.0, "constant": -3.0}
    row = {"boxes": 100, "false_tracks": 1, "no_flyer": 0, "minutes": 0.5} | weights
    rows = [{**row, "way": way, "found": found} for way in (ALL, OTHERS) for found in (90, 50)]
    rows[-1] |= {"signal": 2.5}
    summary = score_folds.summarise(rows)
    assert summary[OTHERS]["recall"] == 0.7
    assert summary[OTHERS]["false tracks a minute"] == 2.0
    assert (summary[OTHERS]["least signal"], summary[OTHERS]["largest signal"]) == (2.0, 2.5)
    assert score_folds.missed(summary) == []
    rows[-1] |= {"found": 40}
    assert score_folds.missed(score_folds.summarise(rows)) == [f"recall 0.650 {OTHERS}, 0.700 {ALL}"]


EDGE_PX = 0.7  # the lens blurs edges by as much


@pytest.mark.parametrize("length", [60.0, -60.0])
@pytest.mark.parametrize("name", SHAPES)
def test_a_drawing_is_where_its_box_says_and_looks_ahead(name, length):
    image = np.full((120, 160, 3), 128, np.uint8)
    box = draw_shape(image, SHAPES[name], np.array([70.4, 60.7]), length)
    v, u = np.nonzero(np.abs(image.astype(int) - 128).max(axis=2) > 40)
    low, high = np.array([u.min(), v.min()]) - 0.5, np.array([u.max(), v.max()]) + 0.5
    np.testing.assert_allclose(box.center_px, (low + high) / 2, atol=EDGE_PX)
    np.testing.assert_allclose(box.size_px, high - low, atol=2 * EDGE_PX)
    # Each is higher in front or behind: cabin, head or mast.
    higher = {"car": -1, "dog": 1, "boat": 1}[name]
    assert np.sign(u[v == v.min()].mean() - 70.4) == higher * np.sign(length)


def test_recall_is_over_the_boxes_of_all_scenes():
    """By hand: 90 of 100 and 100 of 100 are 0.95, which is enough; 18 of 20 is not."""
    row = {"source": "simulated", "shape": "car", "boxes": 100, "side_px": 50.0}
    rows = [
        {**row, "found": 90},
        {**row, "found": 100, "side_px": 80.0},
        {**row, "source": "composite", "boxes": 20, "found": 18},
    ]
    summary = own_shapes.summarise(rows)
    assert summary["simulated: car"] == {"boxes": 200, "recall": 0.95, "least_px": 50.0, "largest_px": 80.0}
    assert own_shapes.missed(summary) == ["composite: car: recall 0.900, not 0.95 or more"]
