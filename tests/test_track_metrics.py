"""Scores of tracks by labels, on cases calculated by hand, and against trackeval in an environment of its own."""

import json
import math
import re
import shutil
import subprocess
import venv
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from cotarget.cli.main import main
from cotarget.cli.replay import TracksByImage
from cotarget.detection import make_detector
from cotarget.errors import ConfigError
from cotarget.rig import Frame
from cotarget.track_metrics import Criterion, Label, Tracked, pooled, read_labels, read_tracks, score_tracks
from cotarget.video import FilmWriter
from tests.support.recorded_run import RATE_HZ, Bright, calibration_file, record

RATE = 25.0
FRAMES = 100
HEAD = "frame,x_px,y_px,width_px,height_px"
VTEST = Path(__file__).parent / "data" / "vtest.txt"


def label(u, v, side=10.0):
    return [Label(np.array([u, v], dtype=float), np.array([side, side / 2]))]


def track(number, frames, offset=0.0):
    """On a target that flies a pixel a frame, or beside it."""
    return [Tracked(np.array([i + offset, 50.0]), np.array([10.0, 5.0]), i, i / RATE, number) for i in frames]


LABELS = {i: label(i, 50) for i in range(FRAMES)}


def test_tracks_near_a_label_are_on_target_after_the_background_is_learnt():
    found = score_tracks([*track(1, range(60), 3.0), *track(2, range(60, 93), 10.0)], LABELS, RATE, FRAMES)
    assert found.labelled_frames == 70
    assert found.on_target_ratio == pytest.approx(63 / 70)
    assert found.numbers == 2
    assert found.offset_px_median == pytest.approx(10.0)  # 33 of 63 have it, and it is just near enough
    assert (found.false_tracks, found.false_tracks_per_min) == (0, 0.0)
    # The last seven frames without a track are 0.28 s.
    assert found.fragmentation_per_min == pytest.approx(1 / (70 / RATE / 60))


def test_a_track_off_the_target_for_half_a_second_is_false():
    beside = track(3, range(40, 53), 10.1)
    blink = track(4, range(40, 52), 30.0)  # 0.44 s
    found = score_tracks([*track(1, range(FRAMES)), *beside, *blink], LABELS, RATE, FRAMES)
    assert found.false_tracks == 0  # 0.48 s
    found = score_tracks([*track(1, range(FRAMES)), *track(3, range(40, 54), 10.1), *blink], LABELS, RATE, FRAMES)
    assert found.false_tracks == 1  # 0.52 s
    assert found.false_tracks_per_min == pytest.approx(60 / (FRAMES / RATE))
    assert (found.on_target_ratio, found.numbers, found.fragmentation_per_min) == (1.0, 1, 0.0)


@pytest.mark.parametrize(("away", "false"), [(13, 0), (14, 1)])
def test_a_track_that_leaves_its_target_for_half_a_second_is_false(away, false):
    """13 frames are 0.48 s from the first to the last, 14 are 0.52."""
    other = [*track(2, range(40, 50)), *track(2, range(50, 50 + away), 30.0), *track(2, range(50 + away, 90))]
    assert score_tracks(other, LABELS, RATE, FRAMES).false_tracks == false


def test_frames_without_a_label_do_not_count_against_a_track_that_was_on_target():
    other = [*track(2, range(40, 50)), *track(2, range(50, 90), 30.0)]
    labels = {i: boxes for i, boxes in LABELS.items() if i < 62 or i % 10 == 0}  # 12 frames, and one at a time
    assert score_tracks(other, labels, RATE, FRAMES).false_tracks == 0
    never_on = track(3, range(62, 90), 30.0)
    assert score_tracks([*other, *never_on], labels, RATE, FRAMES).false_tracks == 1


@pytest.mark.parametrize(("gap", "unlabelled", "breaks"), [(5, 0, 0), (6, 0, 1), (20, 0, 1), (16, 10, 0)])
def test_a_gap_of_more_than_a_fifth_of_a_second_among_labelled_frames_is_a_break(gap, unlabelled, breaks):
    """Of a gap of 16 frames 10 have no label: three before and three after count."""
    labels = {i: boxes for i, boxes in LABELS.items() if not 50 <= i < 50 + unlabelled}
    begin = 50 - (gap - unlabelled) // 2 if unlabelled else 50
    frames = [i for i in range(FRAMES) if not begin <= i < begin + gap]
    found = score_tracks(track(1, frames), labels, RATE, FRAMES)
    assert found.fragmentation_per_min == pytest.approx(breaks / (70 / RATE / 60))
    assert found.on_target_ratio == pytest.approx((70 - gap) / (70 - unlabelled))


def test_nothing_labelled_and_nothing_found():
    found = score_tracks(track(1, range(FRAMES)), {}, RATE, FRAMES)
    assert (found.labelled_frames, found.on_target_ratio, found.false_tracks) == (0, None, 1)
    found = score_tracks([], LABELS, RATE, FRAMES)
    assert (found.on_target_ratio, found.offset_px_median, found.numbers) == (0.0, None, 0)
    assert found.fragmentation_per_min is None


def test_labels_beyond_the_end_are_counted_but_not_scored():
    found = score_tracks(track(1, range(80)), LABELS, RATE, 80)
    assert (found.labelled_frames, found.on_target_ratio, found.labels_beyond_end) == (50, 1.0, 20)
    assert found.fragmentation_per_min == 0.0
    assert score_tracks(track(1, range(FRAMES)), LABELS, RATE, FRAMES).labels_beyond_end == 0


def boxes_of(kind, rows, **more):
    """Labels or tracks of the rows (frame, id, u), 20 px wide and 40 px high."""
    size = np.array([20.0, 40.0])
    if kind is Label:
        labels = {}
        for frame, target, u in rows:
            labels.setdefault(frame, []).append(Label(np.array([u, 50.0]), size, target, **more))
        return labels
    return [Tracked(np.array([u, 50.0]), size, frame, frame / RATE, number) for frame, number, u in rows]


# Two targets: their tracks swap numbers, one is missed once, and once a third track is on nothing.
TWO = boxes_of(Label, [(0, 1, 100), (0, 2, 200), (1, 1, 100), (1, 2, 200), (2, 1, 100), (2, 2, 200)])
SWAPPED = boxes_of(Tracked, [(0, 1, 101), (0, 2, 201), (1, 2, 101), (1, 3, 300), (2, 2, 101), (2, 1, 201)])


def test_three_frames_by_hand():
    score = score_tracks(SWAPPED, TWO, RATE, 3, 0)
    assert (score.boxes, score.found, score.false_boxes, score.id_switches) == (6, 5, 1, 2)
    assert (score.recall, score.precision) == (5 / 6, 5 / 6)
    assert score.mota == pytest.approx(1 - (1 + 1 + 2) / 6)
    # Track 2 is on target 1 in two frames, and track 1 on target 2 in one.
    assert (score.id_found, score.idf1) == (3, 2 * 3 / (6 + 6))
    assert [(each.boxes, each.recall, each.numbers) for each in score.targets.values()] == [(3, 1.0, 2), (3, 2 / 3, 2)]
    sizes = score.sizes["medium"]
    assert (sizes["boxes"], sizes["found"], sizes["recall"]) == (6, 5, 5 / 6)


@pytest.mark.parametrize(("off", "iou", "small_px", "found"), [
    (9, 0.3, 0, 1),  # intersection 11 of 20 columns, over 29: 0.38
    (11, 0.3, 0, 0),  # 9 / 31 = 0.29
    (39, 0.3, 40, 1),  # the centre is within the larger side
    (41, 0.3, 40, 0),
    (39, 0.3, 39, 0),
    (100, 1.0, 40, 0),
])  # fmt: skip
def test_small_boxes_are_matched_by_distance_and_others_by_overlap(off, iou, small_px, found):
    labels, tracks = boxes_of(Label, [(0, 1, 100)]), boxes_of(Tracked, [(0, 1, 100 + off)])
    assert score_tracks(tracks, labels, RATE, 1, 0, Criterion(iou, small_px)).found == found


@pytest.mark.parametrize(("label_px", "track_px", "found"), [
    (200.0, 20.0, 0), (200.0, 60.0, 0), (200.0, 141.0, 0), (200.0, 142.0, 1), (24.0, 60.0, 1), (25.0, 60.0, 0),
])  # fmt: skip
def test_the_labels_size_alone_decides_by_which_rule_it_is_matched(label_px, track_px, found):
    """Squares with one centre: 142 of 200 px are an overlap of 0.504."""
    at = np.array([300.0, 300.0])
    tracks = [Tracked(at, np.full(2, track_px), 0, 0.0, 1)]
    assert score_tracks(tracks, {0: [Label(at, np.full(2, label_px))]}, RATE, 1, 0).found == found


def test_a_class_of_size_says_how_much_of_its_targets_the_tracks_hold():
    """By hand: boxes of 20x40; one with a whole track and a part of 10x20, one with a track 10 px off, one missed."""
    labels = boxes_of(Label, [(0, 1, 100), (1, 1, 100), (2, 1, 100)])
    tracks = boxes_of(Tracked, [(0, 1, 100), (1, 1, 110)])
    tracks.append(Tracked(np.array([104.0, 55.0]), np.array([10.0, 20.0]), 0, 0.0, 2))
    one = score_tracks(tracks, labels, RATE, 3, 0)
    expected = {
        "boxes": 3, "found": 1, "recall": 1 / 3, "whole": 1 / 3,
        "iou": (1 + 1 / 3) / 3, "covered": (1 + 1 / 2) / 3, "dot_distance": (1 + math.exp(-10 / math.sqrt(800))) / 3,
        "with_tracks": 1, "tracks_at_once": 2.0,  # just half of the track is inside in the second frame
    }  # fmt: skip
    assert one.sizes["medium"] == pytest.approx(expected)
    two = score_tracks(boxes_of(Tracked, [(0, 1, 100)]), boxes_of(Label, [(0, 1, 100)]), RATE, 1, 0)
    sizes = pooled([one, two], 1.0)["sizes"]
    assert sizes["medium"] == pytest.approx(expected | {
        "boxes": 4, "found": 2, "recall": 2 / 4, "whole": 2 / 4, "iou": (2 + 1 / 3) / 4, "covered": (2 + 1 / 2) / 4,
        "dot_distance": (2 + math.exp(-10 / math.sqrt(800))) / 4, "with_tracks": 2, "tracks_at_once": 3 / 2,
    })  # fmt: skip
    assert sizes["large"] == dict.fromkeys(expected) | {"boxes": 0, "found": 0, "with_tracks": 0}


def test_two_boxes_of_one_target_in_a_frame_are_refused(tmp_path):
    path = tmp_path / "gt.txt"
    path.write_text("1,7,10,10,20,20,1\n1,7,50,10,20,20,1\n")
    with pytest.raises(ConfigError, match="frame 1 has two boxes of target 7; each wants a number of its own"):
        read_labels(path)
    path.write_text("1,7,10,10,20,20,1\n1,7,50,10,20,20,0\n")  # the second does not count
    assert len(read_labels(path)[0]) == 2


@pytest.mark.parametrize(("labels", "tracks", "expected"), [
    # Labels of one number count each; a pair stays while it is near enough; a track finds one of two labels.
    ([(0, -1, 100), (0, -1, 300), (0, -1, 500)], [(0, 1, 100)], {"boxes": 3, "recall": 1 / 3}),
    ([(0, 1, 100), (1, 1, 100)], [(0, 1, 100), (1, 1, 105), (1, 2, 100)], {"id_switches": 0}),
    ([(0, 1, 100), (0, 2, 104)], [(0, 1, 102)], {"recall": 0.5}),
])  # fmt: skip
def test_each_box_is_matched_once(labels, tracks, expected):
    score = score_tracks(boxes_of(Tracked, tracks), boxes_of(Label, labels), RATE, 2, 0)
    assert {name: getattr(score, name) for name in expected} == expected


def test_a_track_on_a_label_that_does_not_count_is_neither_right_nor_wrong():
    """In the second case it is beside track 2 on such a label, and takes over the target in the next frame."""
    labels = boxes_of(Label, [(0, 1, 100)], counts=False)
    score = score_tracks(boxes_of(Tracked, [(0, 1, 100), (0, 2, 200)]), labels, RATE, 1, 0)
    assert (score.boxes, score.found, score.false_boxes) == (0, 0, 1)
    labels = boxes_of(Label, [(0, 1, 100), (1, 1, 100)])
    labels[0] += boxes_of(Label, [(0, 2, 110)], counts=False)[0]
    score = score_tracks(boxes_of(Tracked, [(0, 2, 100), (0, 1, 106), (1, 1, 100)]), labels, RATE, 2, 0)
    assert (score.found, score.false_boxes, score.id_found, score.idf1) == (2, 0, 1, 0.5)


def test_nor_is_it_false_in_frames_without_labels():
    labels = boxes_of(Label, [(i, 1, 100) for i in (30, 60, 90)], counts=False)
    tracks = boxes_of(Tracked, [(i, 1, 100) for i in range(FRAMES)])
    assert score_tracks(tracks, labels, RATE, FRAMES).false_tracks == 0
    beside = boxes_of(Tracked, [(i, 2, 200) for i in range(FRAMES)])
    assert score_tracks([*tracks, *beside], labels, RATE, FRAMES).false_tracks == 1


def test_the_first_track_is_timed_from_the_first_label():
    labels, tracks = boxes_of(Label, [(i, 1, 100) for i in range(9)]), boxes_of(Tracked, [(i, 1, 100) for i in (5, 6)])
    assert score_tracks(tracks, labels, RATE, 9, 0).targets[1].first_track_s == pytest.approx(5 / RATE)
    later = score_tracks(tracks, labels, RATE, 9, 7).targets[1]  # frames that are not scored count for it
    assert (later.boxes, later.first_track_s) == (2, pytest.approx(5 / RATE))


def test_films_are_pooled_by_boxes():
    one, two = (score_tracks(SWAPPED, TWO, RATE, 3, 0), score_tracks([], boxes_of(Label, [(0, 1, 9)]), RATE, 3, 0))
    found = pooled([one, two], 2.0)
    assert (found["films"], found["boxes"], found["recall"], found["precision"]) == (2, 7, 5 / 7, 5 / 6)
    assert (found["recall_median"], found["recall_least"]) == (pytest.approx(5 / 12), 0.0)
    assert found["sizes"]["medium"]["boxes"] == 7
    assert found["numbers_median"] == 2


def write_labels(path, rows, head="frame,x_px,y_px,width_px,height_px"):
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def test_targets_of_a_csv_are_numbered_by_a_column_or_by_their_order(tmp_path):
    rows = ["3,10,20,5,2", "3,0,0,1,1", "4,0,0,1,1"]
    numbered = [f"{row},{7 + i}" for i, row in enumerate(rows)]
    marked = f"\ufeff{HEAD}"  # by a byte order mark
    for given, expected in ((write_labels(tmp_path / "a.csv", rows, marked), [1, 2, 1]),
                            (write_labels(tmp_path / "b.csv", numbered, f"{HEAD},target"), [7, 8, 9])):  # fmt: skip
        found = read_labels(given)
        assert [each.target for boxes in found.values() for each in boxes] == expected
        assert [each.center_px.tolist() for each in found[3]] == [[12.0, 20.5], [0.0, 0.0]]  # by their first pixels


def test_ground_truth_of_the_mot_challenge_counts_from_one(tmp_path):
    found = read_labels(write_labels(tmp_path / "gt.txt", ["2,4,13,5,2,1,1,0.4", "2,5,1,1,3,3,0,1,0"], "2,9,1,1,1,1,1"))
    assert list(found) == [1]
    assert [(each.target, each.counts, each.center_px.tolist()) for each in found[1]] == [
        (9, True, [0.0, 0.0]),
        (4, True, [12.5, 4.0]),
        (5, False, [1.0, 1.0]),
    ]
    written = read_labels(write_labels(tmp_path / "gt.txt", ["3.0,4.0,13,5,2,1,1"], "2.0,9.0,1,1,1,1,1"))
    assert {frame: [each.target for each in boxes] for frame, boxes in written.items()} == {1: [9], 2: [4]}
    with pytest.raises(ConfigError, match=r"line 2 has '1\.5' for id"):
        read_labels(write_labels(tmp_path / "gt.txt", ["3,1.5,13,5,2,1,1"], "2,9,1,1,1,1,1"))
    boxes = [each for labels in read_labels(VTEST).values() for each in labels]
    assert (len(boxes), sum(each.counts for each in boxes)) == (382, 356)


@pytest.mark.parametrize(("rows", "head", "named"), [
    (["1,2,3,4"], "frame,x_px,y_px,width_px", "'height_px'"), (["1,2,3,4"], HEAD, "line 2"),
    (["1,2,3,4,5", "2,nan,3,4,5"], HEAD, "line 3 has 'nan' for x_px"),
    (["1,2,3,x,5"], HEAD, "line 2 has 'x' for width_px"), (["", "1,2,3,x,5"], HEAD, "line 3 has 'x' for width_px"),
    (["1,2,3,4,5,1.5"], f"{HEAD},target", "line 2 has '1.5' for target"), (["1,2,3,0,5"], HEAD, "a label"),
    (["1.5,2,3,4,5"], HEAD, "a label"), (["-1,2,3,4,5"], HEAD, "a label"),
])  # fmt: skip
def test_an_invalid_table_of_labels_is_refused(tmp_path, rows, head, named):
    with pytest.raises(ConfigError, match=rf"labels\.csv: .*{named}"):
        read_labels(write_labels(tmp_path / "labels.csv", rows, head))


def test_an_unreadable_table_is_named(tmp_path):
    for path in (tmp_path / "nothing.csv", tmp_path):
        with pytest.raises(ConfigError, match=rf"{path}: cannot be read"):
            read_labels(path)


def write_film(path, step=3):
    """A dark square that flies over a grey wall; its label in every frame."""
    rng, rows = np.random.default_rng(0), []
    with FilmWriter(path, RATE) as film:
        for i in range(80):
            image = np.full((120, 320, 3), 170, np.uint8) + rng.integers(-3, 4, (120, 320, 3)).astype(np.uint8)
            x = 20 + step * i
            image[50:60, x : x + 10] = 20
            film.write(image, i / RATE)
            rows.append(f"{i},{x},50,10,10")
    return rows


def test_the_command_scores_a_film(tmp_path, capsys):
    labels = write_labels(tmp_path / "labels.csv", write_film(tmp_path / "film.mp4"))
    arguments = ["detect", str(tmp_path / "film.mp4"), "--target", "bird", "--csv", str(tmp_path / "tracks.csv")]
    assert main([*arguments, "--labels", str(labels)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["labelled_frames"], found["on_target_ratio"], found["numbers"]) == (50, 1.0, 1)
    assert (found["recall"], found["precision"], found["mota"], found["idf1"]) == (1.0, 1.0, 1.0, 1.0)
    assert found["false_tracks"] == 0
    assert found["offset_px_median"] < 1.5
    assert len(read_tracks(tmp_path / "tracks.csv")) >= 50


def test_a_file_without_labels_is_of_a_film_without_targets(tmp_path, capsys):
    """The square that flies for 80 frames of 25 a second is then a false track."""
    write_film(tmp_path / "film.mp4")
    (tmp_path / "film.csv").write_text("")
    assert read_labels(write_labels(tmp_path / "head.csv", [])) == {}
    (tmp_path / "tables").mkdir()
    for film, labels, table in (("film.mp4", "film.csv", "tracks.csv"), ("", "", "tables")):
        given = ["--target", "bird", "--csv", str(tmp_path / table), "--labels", str(tmp_path / labels)]
        assert main(["detect", str(tmp_path / film), *given]) == 0
        out, err = capsys.readouterr()
        assert "nothing is scored" not in err
        found = json.loads(out)
        found = found.get("pooled", found)
        assert (found["recall"], found["boxes"], found["false_tracks"]) == (None, 0, 1)
        assert found["false_tracks_per_min"] == pytest.approx(60 * RATE / 80)


@pytest.mark.parametrize(("more", "used"), [((), "speck"), (("--detector", "auto"), "auto")])
def test_the_command_searches_with_the_detector_that_is_given(tmp_path, monkeypatch, more, used):
    searched = []

    def made(target, rate_hz):
        searched.append(target.detector)
        return make_detector(target, rate_hz)

    monkeypatch.setattr("cotarget.detect_video.make_detector", made)
    write_film(tmp_path / "film.mp4")
    given = ["--target", "bird", "--csv", str(tmp_path / "tracks.csv"), *more]
    assert main(["detect", str(tmp_path / "film.mp4"), *given]) == 0
    assert searched == [used]
    assert read_tracks(tmp_path / "tracks.csv")


@pytest.fixture(scope="module")
def films(tmp_path_factory):
    """Two films; the second one's labels are where nothing is."""
    made = tmp_path_factory.mktemp("films")
    for name in ("one", "two"):
        rows = write_film(made / f"{name}.mp4")
        rows = [",".join([*row.split(",")[:2], "100", "10", "10"]) for row in rows] if name == "two" else rows
        write_labels(made / f"{name}.csv", rows)
    return made


@pytest.fixture
def folder(films, tmp_path):
    """A folder of these films, and one for tables."""
    shutil.copytree(films, tmp_path / "films")
    (tmp_path / "tables").mkdir()
    return tmp_path


def detect_folder(folder, *more, labels="films"):
    given = ["--csv", str(folder / "tables"), "--labels", str(folder / labels)]
    return main(["detect", str(folder / "films"), "--target", "bird", *given, *more])


def test_the_command_scores_a_folder_of_films(folder, capsys):
    (folder / "films" / ".one.part.mp4").touch()  # a hidden file is no film
    assert detect_folder(folder, "--sheet", str(folder / "sheet.png")) == 0
    found = json.loads(capsys.readouterr().out)
    assert {name: each["recall"] for name, each in found["films"].items()} == {"one": 1.0, "two": 0.0}
    assert (found["pooled"]["films"], found["pooled"]["boxes"], found["pooled"]["recall"]) == (2, 100, 0.5)
    assert found["pooled"]["false_tracks_per_min"] == pytest.approx(60 * RATE / 160)
    assert sorted(path.name for path in (folder / "tables").iterdir()) == ["one.csv", "two.csv"]
    # A green miss and a red false track, with the square in the middle of the second.
    sheet = cv2.imread(str(folder / "sheet.png"))
    assert sheet.shape == (200, 1200, 3)
    assert sheet[100, 300].max() < 60
    assert sheet[100, 100].min() > 140
    # The square moves by 10 px of the tile a frame, so that the frame is the right one.
    dark = np.argwhere(sheet[60:140, 250:350].max(axis=2) < 60)
    assert np.median(dark[:, 1]) == pytest.approx(49.5, abs=5)


@pytest.mark.parametrize(("frame", "false", "said"), [
    (5000, 0, "1 of 1 labelled frames are beyond the last one, 79, and are not counted;"),
    (29, 1, "nothing is scored; all labels are in the first 30 frames"),
])  # fmt: skip
def test_labels_of_another_film_or_of_its_beginning_are_reported(folder, capsys, frame, false, said):
    labels = write_labels(folder / "films" / "two.csv", [f"{frame},5,5,9,9"])
    assert detect_folder(folder) == 0
    out, err = capsys.readouterr()
    assert f"{labels}: {said}" in err
    found = json.loads(out)
    assert (found["pooled"]["films"], found["pooled"]["recall"], found["pooled"]["false_tracks"]) == (
        1 + false,
        1.0,
        false,
    )
    assert found["films"]["two"]["recall"] is None


def test_labels_that_fit_no_film_of_a_folder_are_refused(folder, capsys):
    for name in ("one", "two"):
        write_labels(folder / "films" / f"{name}.csv", ["5000,5,5,9,9"])
    assert detect_folder(folder) == 1
    out, err = capsys.readouterr()
    assert (out, "films: no labelled frame is in any of the films" in err) == ("", True)


def test_wrong_labels_and_films_are_refused_before_the_search(folder, capsys):
    """Two of three boxes are outside the picture of 320x120 px; then the film is none."""
    labels, film = folder / "films" / "two.csv", folder / "films" / "two.mp4"
    write_labels(labels, ["40,600,50,9,9", "41,50,200,9,9", "42,300,100,9,9"])
    given = ["--target", "bird", "--csv", str(folder / "two.csv"), "--labels", str(labels)]
    for search in (lambda: detect_folder(folder), lambda: main(["detect", str(film), *given])):
        assert search() == 1
        err = capsys.readouterr().err
        assert err.startswith(f"cotarget detect: {labels}: 2 of 3 boxes are outside {film}'s picture of 320x120 px; ")
    film.write_text("no film")
    assert detect_folder(folder) == 1
    assert "two.mp4" in capsys.readouterr().err
    assert not list((folder / "tables").iterdir())


@pytest.mark.parametrize(("labels", "more", "named"), [
    ("tables", (), "one.mp4: has no labels; give"), ("films/one.csv", (), "--labels: .*one.csv is no folder"),
    ("films", ("--video", "drawn.mp4"), "--video: draws the tracks of one video"),
    ("films", ("--sheet", "sheet.jpg"), "--sheet: sheet.jpg: a PNG is written; name a .png"),
    ("films", ("--sheet", "/proc/sheet.png"), "/proc/sheet.png"),
    ("films", ("--csv", "none"), "--csv: none is no folder"),
])  # fmt: skip
def test_a_folder_that_cannot_be_scored_is_refused(folder, capsys, labels, more, named):
    assert detect_folder(folder, *more, labels=labels) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert re.fullmatch(rf"cotarget detect: .*{named}.*\n", err)
    assert not list((folder / "tables").glob("*.csv"))


def test_two_films_of_one_name_are_refused(folder, capsys):
    for name in ("one.avi", "one.b.mp4"):  # one in between
        (folder / "films" / name).touch()
        (folder / "films" / name).with_suffix(".csv").touch()
    assert detect_folder(folder) == 1
    assert "one.mp4: has the name of one.avi" in capsys.readouterr().err


def test_the_command_scores_a_recording(tmp_path, capsys, monkeypatch):
    """The bright bird of `tests.support.recorded_run`, labelled where it is drawn; scored by the recorded pictures."""
    monkeypatch.setattr("cotarget.detection.make_detector", lambda *_: Bright())
    steps = record(tmp_path / "run", calibration_file(tmp_path), seconds=1.6)
    rows = []
    for number, step in enumerate(steps):
        assert (tmp_path / "run" / "fixed" / f"{number:06d}.png").is_file()
        index = round(step.fixed.t * RATE_HZ)
        u, v = round(20 + 0.7 * (index % 80)), round(36 + 10 * math.sin(index / 9))
        rows.append(f"{number},{u - 4},{v - 4},9,9")
    assert main(["replay", str(tmp_path / "run")]) == 0
    assert "on_target_ratio" not in json.loads(capsys.readouterr().out)
    arguments = ["replay", str(tmp_path / "run"), "--labels"]
    assert main([*arguments, str(write_labels(tmp_path / "labels.csv", rows))]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["steps"] == len(steps)
    assert (found["labelled_frames"], found["on_target_ratio"], found["numbers"]) == (len(steps) - 30, 1.0, 1)
    assert found["false_tracks"] == 0
    assert found["offset_px_median"] < 1.5
    beside = [f"{number},60,2,9,9" for number in range(len(steps))]
    assert main([*arguments, str(write_labels(tmp_path / "beside.csv", beside))]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["on_target_ratio"], found["false_tracks"]) == (0.0, 1)
    longer = write_labels(tmp_path / "longer.csv", [*rows, f"{len(steps)},1,1,5,5"])
    assert main([*arguments, str(longer)]) == 0
    out, err = capsys.readouterr()
    assert (json.loads(out)["on_target_ratio"], json.loads(out)["labels_beyond_end"]) == (1.0, 1)
    assert f"1 of {len(steps) + 1} labelled frames are beyond the last one, {len(steps) - 1}," in err
    assert main([*arguments, str(tmp_path / "none.csv")]) == 1
    assert "none.csv" in capsys.readouterr().err


def test_a_track_of_a_replay_ends_at_the_images_border_as_labels_do():
    """Of a box of 10x6 px at the left border, 4 columns are outside."""
    frame = Frame(np.zeros((48, 64, 3), np.uint8), 1.5)
    near = SimpleNamespace(reported=True, id=3, center_px=np.array([0.5, 20.5]), whole_px=np.array([10.0, 6.0]))
    replayed = TracksByImage({1.5: 7})
    replayed.see(SimpleNamespace(fixed=frame, tracks=[near]))
    (found,) = replayed.tracks
    assert (found.frame, found.track) == (7, 3)
    np.testing.assert_allclose([found.center_px, found.size_px], [(2.5, 20.5), (6.0, 6.0)])


@pytest.mark.foreign
@pytest.mark.timeout(600)
def test_trackeval_agrees(tmp_path):
    """Both score random tracks of the people in vtest.txt by overlap; numbers are swapped, lost and invented."""
    rng, number = np.random.default_rng(4), {}
    labels = {frame: [each for each in boxes if each.counts] for frame, boxes in read_labels(VTEST).items()}
    tracks = []
    for frame, boxes in labels.items():
        found = {99: Tracked(rng.uniform(0, 700, 2), np.array([30.0, 80.0]), frame, frame / 10, 99)}
        for label in boxes:
            if rng.random() < 0.1:
                number[label.target] = int(rng.integers(1, 25))
            track = number.setdefault(label.target, label.target)
            if rng.random() < 0.85 and track not in found:
                size = label.size_px * np.exp(rng.normal(0, 0.1, 2))
                found[track] = Tracked(label.center_px + rng.normal(0, 5, 2), size, frame, frame / 10, track)
        tracks += found.values()
    score = score_tracks(tracks, labels, 10.0, 800, 0, Criterion(0.5, 0.0))

    def box(each):
        return [*(each.center_px - each.size_px / 2).tolist(), *each.size_px.tolist()]

    frames = [
        [[[a.target, box(a)] for a in boxes], [[b.track, box(b)] for b in tracks if b.frame == frame]]
        for frame, boxes in labels.items()
    ]
    (tmp_path / "frames.json").write_text(json.dumps(frames))
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "-q", "trackeval==1.3.0"], check=True, timeout=500)
    command = [python, VTEST.with_name("trackeval_scores.py"), tmp_path / "frames.json"]
    theirs = json.loads(subprocess.run(command, check=True, capture_output=True, text=True, timeout=100).stdout)
    assert theirs["id_switches"] > 10
    assert theirs == pytest.approx({name: getattr(score, name) for name in theirs}, rel=1e-12)


def test_a_track_that_was_cut_to_nothing_at_the_border_is_false():
    """Its filtered box may lie outside; filters of warnings make a division by its area an error here."""
    label = Label(np.array([20.0, 50.0]), np.array([40.0, 80.0]), 1)
    outside = Tracked(np.array([-0.5, 50.0]), np.array([0.0, 20.0]), 100, 4.0, 7)
    score = score_tracks([outside], {100: [label]}, 25.0, 101)
    assert (score.boxes, score.found, score.false_boxes) == (1, 0, 1)
