"""The experiments on films: their figures of hand-made rows, altered films, drawn shapes, and folds of the score."""

import numpy as np
import pytest

from cotarget.files import read_table
from cotarget.rig import Frame
from cotarget.track_metrics import Box, Criterion, Label, Tracked, read_labels
from cotarget.video import FilmWriter
from experiments.following import films, own_shapes, score_folds
from experiments.following.films import (
    ALTERATIONS,
    DIVISION,
    LABELS,
    OTHERS,
    SIZE_NAMES,
    FilmsSettings,
    LabelledFilm,
    dropped,
    film_to_score,
    films_of_half,
    no_parts,
    off_boxes,
    unlabelled_flyers,
)
from experiments.following.own_shapes import SHAPES, draw_shape
from experiments.following.score_folds import ALL, fit, folds
from experiments.following.score_folds import OTHERS as HELD_OUT

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


def row(name, way, threshold, found, false_tracks, **more):
    """A film of a minute with 100 labels up to 24 px."""
    none = dict.fromkeys(films.SIZE_KEYS) | {"boxes": 0, "found": 0, "with_tracks": 0}
    small = none | {"boxes": 100, "found": found, "recall": found / 100}
    sizes = {"small": small, "medium": none, "large": none}
    return {
        "film": name, "way": way, "threshold": threshold, "smallest_px": 0, "boxes": 100, "found": found,
        "false_boxes": 0, "id_found": found, "false_tracks": false_tracks, "no_flyer": false_tracks,
        "no_part": false_tracks, "minutes": 1.0,
        "numbers": 1.0, "first_track_s": 0.5, "usual": True, "labels": "all",
        **{f"{size} {key}": sizes[size][key] for size in SIZE_NAMES for key in films.SIZE_KEYS},
    } | more  # fmt: skip


def test_the_table_has_pooled_figures_by_both_labels_and_one_line_a_film():
    """By hand: two films of a minute; of 0.5 false tracks a minute, the detector has 0.6, and 0.9 of four."""
    rows = [
        row("one", "auto", 0.5, 95, 8),
        row("two", "auto", 0.5, 85, 0, labels="redrawn"),
        row("two", "auto", 0.5, 25, 0, labels="published"),
        row("one", "auto", 0.9, 60, 1, usual=False),
        row("two", "auto", 0.9, 60, 0, usual=False, labels="redrawn"),
        row("vtest", "auto", 0.5, 10, 0),
        *(row(name, way, 16.0, 60, 60) for way in ("MOG2", "KNN") for name in ("one", "two")),
    ]
    summary = films.summarise(rows)
    found = summary["auto"]
    assert (found["films"], found["recall to 24 px, by centre"], found["false tracks a minute"]) == (2, 0.9, 4.0)
    assert found["IDF1"] == 2 * 180 / (200 + 180)
    assert (found["recall at 0.5 a minute"], found["recall at 5 a minute"]) == (0.6, 0.9)
    assert summary["auto, as published"]["recall to 24 px, by centre"] == 0.6
    assert {name: figures["to 24"] for name, figures in summary["films"].items()} == {
        "one": 0.95, "two": 0.85, "vtest": 0.1,
    }  # fmt: skip
    assert summary["KNN"]["recall at 5 a minute"] == 0.0
    assert films.missed(summary) == []
    rows += [row(name, way, 9.0, 57, 0, usual=False) for way in ("MOG2", "KNN") for name in ("one", "two")]
    assert films.missed(films.summarise(rows)) == ["recall at 0.5 a minute"]


def test_films_of_one_place_are_in_one_half():
    rows = read_table(DIVISION, dict.fromkeys(("film", "place", "half"), str), "division of films")
    halves = {(row["place"], row["half"]) for row in rows}
    assert len(halves) == len({place for place, _ in halves})
    assert {half for _, half in halves} == {"development", "report"}
    assert len({row["film"] for row in rows}) == len(rows) == 52
    assert set(OTHERS) <= {row["film"] for row in rows}


def test_redrawn_labels_take_the_place_of_the_published_ones(tmp_path, monkeypatch):
    """Published labels count pixels from 1, those of the project from 0."""
    monkeypatch.setattr(films, "LABELS", tmp_path / "own")
    monkeypatch.setattr(films, "DIVISION", tmp_path / "division.csv")
    (tmp_path / "own").mkdir()
    (tmp_path / "division.csv").write_text("film,half\none,report\ntwo,report\nother,development\nabsent,report\n")
    for name in ("flyers/one", "birds/two", "flyers/other"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        with FilmWriter(tmp_path / f"{name}.mp4", RATE) as out:
            out.write(film(1).frames[0].image, 0.0)
        (tmp_path / f"{name}.csv").write_text("frame,x_px,y_px,width_px,height_px\n0,11,21,5,5\n")
    (tmp_path / "own" / "two.csv").write_text("frame,x_px,y_px,width_px,height_px\n0,30,40,5,5\n")
    one, two = map(film_to_score, films_of_half(FilmsSettings(data=str(tmp_path), half="report")))
    assert (one.name, one.labels[0][0].center_px.tolist(), one.published) == ("one", [12.0, 22.0], {})
    assert (two.name, two.labels[0][0].center_px.tolist()) == ("two", [32.0, 42.0])
    assert two.published[0][0].center_px.tolist() == [12.0, 22.0]


def test_the_projects_own_labels_can_be_read():
    labels = {path.stem: read_labels(path) for path in LABELS.glob("*.csv")}
    assert {name: sum(map(len, of.values())) for name, of in labels.items()} == {
        "V_AIRPLANE_008": 320, "V_AIRPLANE_030": 320, "V_BIRD_021": 459, "V_DRONE_021": 308, "V_DRONE_080": 299,
        "V_HELICOPTER_026": 314, "car": 56, "persons": 74,
    }  # fmt: skip


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


def test_parts_of_a_target_are_told_from_other_false_tracks():
    """A square of 40 px with a track on its corner, one half inside, one beside it, and one on it."""
    label = Label(np.array([50.0, 50.0]), np.array([40.0, 40.0]))
    part, half, beside, on = (
        Tracked(np.array([u, 60.0]), np.array([side, side]), 3, 0.1, 1)
        for u, side in ((64.0, 10.0), (70.0, 10.0), (80.0, 10.0), (50.0, 36.0))
    )
    assert no_parts([part, half, beside, on], {3: [label]}, Criterion()) == [half, beside, on]
    assert no_parts([part], {4: [label]}, Criterion()) == [part]


def dark(frame):
    """Centre of what is dark."""
    weight = 200.0 - frame.image[..., 0]
    v, u = np.mgrid[: weight.shape[0], : weight.shape[1]]
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


@pytest.mark.parametrize("way", ["half", "twice", "shaken", "dropped", "compressed"])
def test_labels_stay_on_their_target(way):
    made = ALTERATIONS[way](film())
    for i, frame in enumerate(made.frames):
        for boxes in (made.labels, made.flyers):
            assert boxes[i][0].center_px == pytest.approx(dark(frame), abs=0.15)


def test_dropped_frames_leave_the_others_at_their_times():
    times = [frame.t for frame in dropped(film(1000)).frames]
    assert len(times) == pytest.approx(700, abs=50)
    assert times[-1] == pytest.approx(1000 / RATE, abs=10 / RATE)


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
    rows = [{**row, "way": way, "found": found} for way in (ALL, HELD_OUT) for found in (90, 50)]
    rows[-1] |= {"signal": 2.5}
    summary = score_folds.summarise(rows)
    assert summary[HELD_OUT]["recall"] == 0.7
    assert summary[HELD_OUT]["false tracks a minute"] == 2.0
    assert (summary[HELD_OUT]["least signal"], summary[HELD_OUT]["largest signal"]) == (2.0, 2.5)
    assert score_folds.missed(summary) == []
    rows[-1] |= {"found": 40}
    assert score_folds.missed(score_folds.summarise(rows)) == [f"recall 0.650 {HELD_OUT}, 0.700 {ALL}"]


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
