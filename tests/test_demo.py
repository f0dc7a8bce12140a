"""The demo: results that appear together or not at all, and (slow) the figures that it reaches."""

import json
import re
from pathlib import Path

import cv2
import pytest

from cotarget.demo import SUMMARY, finished_together, run_demo, summary
from cotarget.errors import ConfigError

FIGURES = dict.fromkeys(SUMMARY)
METRICS = {
    "calibration": {"pointing_error_deg": {"median": 0.0123, "p95": 0.0456}},
    "targets": {
        "book": FIGURES | {"time_to_acquire_s": 0.444, "in_frame_ratio": 1.0, "closeup_yield": 0.876,
                           "centred_yield": 0.654,
                           "tpo_width_median": 0.01, "size_ratio_median": 1.02, "range_m": 9.96},
        "bird": FIGURES | {"closeup_yield": 0.0, "range_m": 22.0},
    },
}  # fmt: skip


def contents(folder):
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_a_finished_run_replaces_its_own_files_alone(tmp_path):
    out = tmp_path / "deep" / "demo"
    for text in ("old", "new"):
        with finished_together(out) as work:
            (work / "metrics.json").write_text(text)
            assert (out / "metrics.json").exists() == (text == "new")
        (out / "mine.txt").write_text("somebody's own")
    assert contents(out) == {"metrics.json": "new", "mine.txt": "somebody's own"}


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ConfigError("no"), ValueError("bug")])
def test_a_failed_run_leaves_the_old_files_and_no_others(tmp_path, error):
    def fail_half_way():
        with finished_together(tmp_path) as work:
            (work / "metrics.json").write_text("half")
            raise error

    (tmp_path / "metrics.json").write_text("old")
    with pytest.raises(type(error)):
        fail_half_way()
    assert contents(tmp_path) == {"metrics.json": "old"}


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("x")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(ConfigError, match=re.escape(str(out))) as caught, finished_together(out):
            pass
        assert "\n" not in str(caught.value)


def test_the_summary_has_a_line_a_target_and_a_dash_for_a_missing_figure():
    lines = [line.split() for line in summary(METRICS).splitlines()]
    assert lines[0][-5:] == ["median", "0.0123,", "p95", "0.0456", "degrees"]
    assert lines[1:] == [
        ["target", "acquired", "in", "frame", "yield", "centred", "offset", "size", "range"],
        ["book", "0.44", "s", "1.00", "0.88", "0.65", "1.0%", "1.02", "10.0", "m"],
        ["bird", "-", "s", "-", "0.00", "-", "-", "-", "22.0", "m"],
    ]


# What the demo must reach, book, person and bird: frames in frame after acquisition, target point offset over the
# image's width, size ratio, close-up yield; and the pointing error of its calibration [degrees].
IN_FRAME = {"book": 1.00, "person": 0.97, "bird": 0.85}
OFFSET = {"book": 0.03, "person": 0.06, "bird": 0.15}
SIZE = {"book": (0.9, 1.1), "person": (0.8, 1.25), "bird": (0.7, 1.3)}
YIELD = {"book": 0.70, "person": 0.60, "bird": 0.40}
POINTING_MEDIAN_DEG, POINTING_P95_DEG = 0.05, 0.10


@pytest.mark.slow
@pytest.mark.render
def test_the_demo_reaches_its_figures(tmp_path):
    reported = []
    metrics = run_demo(tmp_path, 0, lambda *what: reported.append(what))
    print(summary(metrics))
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    pointing = metrics["calibration"]["pointing_error_deg"]
    assert pointing["median"] < POINTING_MEDIAN_DEG
    assert pointing["p95"] < POINTING_P95_DEG
    for name in ("book", "person", "bird"):
        score = metrics["targets"][name]
        assert score["in_frame_ratio"] >= IN_FRAME[name], name
        assert score["tpo_width_median"] <= OFFSET[name], name
        assert SIZE[name][0] <= score["size_ratio_median"] <= SIZE[name][1], name
        assert score["closeup_yield"] >= YIELD[name], name
        assert cv2.imread(str(tmp_path / f"{name}.png")) is not None
    assert cv2.imread(str(tmp_path / "rig.png")) is not None
    assert cv2.imread(str(tmp_path / "aim_error.png")) is not None
    film = cv2.VideoCapture(str(tmp_path / "demo.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) > 25 * 25  # all three runs, 30 s together
    film.release()
    assert (tmp_path / "calibration.json").is_file()
    assert not [path for path in Path(tmp_path).iterdir() if path.name.startswith(".")]
    assert reported
    assert all(total is None or 0 <= done <= total for done, total, _ in reported)
