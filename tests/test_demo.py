"""The demo: results that appear together or not at all, and (slow) the figures that it must reach."""

import json
from pathlib import Path

import cv2
import pytest

from cotarget.demo import finished_together, run_demo, sim_config, summary
from cotarget.errors import ConfigError

METRICS = {
    "calibration": {
        "fixed_rms_px": 0.1,
        "zoom_rms_px": 0.1,
        "stereo_rms_px": 0.1,
        "pointing_error_deg": {"median": 0.0123, "p95": 0.0456},
    },
    "targets": {
        "book": {
            "frames": 150,
            "time_to_acquire_s": 0.444,
            "closeup_yield": 0.876,
            "in_frame_ratio": 1.0,
            "tpo_px_median": 6.4,
            "tpo_width_median": 0.01,
            "tpo_deg_median": 0.05,
            "size_ratio_median": 1.02,
            "wanted_px": 160.0,
            "range_m": 9.96,
            "tpe_px_median": 0.1,
            "fragmentation_per_min": 0.0,
        },
        "bird": {
            "frames": 150,
            "time_to_acquire_s": None,
            "closeup_yield": 0.0,
            "in_frame_ratio": None,
            "tpo_px_median": None,
            "tpo_width_median": None,
            "tpo_deg_median": None,
            "size_ratio_median": None,
            "wanted_px": 160.0,
            "range_m": 22.0,
            "tpe_px_median": None,
            "fragmentation_per_min": None,
        },
    },
    "seed": 0,
    "wall_s": 60.0,
}


def test_files_appear_together(tmp_path):
    out = tmp_path / "deep" / "demo"
    with finished_together(out) as work:
        (work / "a.txt").write_text("new a")
        (work / "b.txt").write_text("new b")
        assert not (out / "a.txt").exists()
    assert {path.name: path.read_text() for path in out.iterdir()} == {"a.txt": "new a", "b.txt": "new b"}


def fail_half_way(out, error):
    with finished_together(out) as work:
        (work / "metrics.json").write_text("half")
        (work / "new.png").write_text("new")
        raise error


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ConfigError("no"), ValueError("bug")])
def test_a_run_that_fails_leaves_the_old_files_and_no_rubbish(tmp_path, error):
    (tmp_path / "metrics.json").write_text("old")
    (tmp_path / "mine.txt").write_text("somebody's own")
    with pytest.raises(type(error)):
        fail_half_way(tmp_path, error)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {
        "metrics.json": "old",
        "mine.txt": "somebody's own",
    }


def test_a_finished_run_replaces_its_own_files_only(tmp_path):
    (tmp_path / "metrics.json").write_text("old")
    (tmp_path / "mine.txt").write_text("somebody's own")
    with finished_together(tmp_path) as work:
        (work / "metrics.json").write_text("new")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {
        "metrics.json": "new",
        "mine.txt": "somebody's own",
    }


def test_a_folder_that_cannot_be_is_named(tmp_path):
    (tmp_path / "file").write_text("x")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(ConfigError, match="name a folder that can") as caught, finished_together(out):
            pass
        assert str(out) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_the_summary_tells_every_target_and_a_dash_for_what_was_not_measured():
    lines = summary(METRICS).splitlines()
    assert lines[0] == "pointing error of the calibration: median 0.0123, p95 0.0456 degrees"
    assert lines[1].split() == ["target", "acquired", "in", "frame", "yield", "offset", "size", "range"]
    assert lines[2].split() == ["book", "0.44", "s", "1.00", "0.88", "1.0%", "1.02", "10.0", "m"]
    assert lines[3].split() == ["bird", "-", "s", "-", "0.00", "-", "-", "22.0", "m"]
    assert len(lines) == 4


def test_the_demo_uses_the_published_rig_with_every_effect_that_is_on_by_default():
    config = sim_config("indoor", ("book",), 7)
    assert (config.sim.scene, config.sim.targets, config.sim.seed) == ("indoor", ("book",), 7)
    assert config == sim_config("indoor", ("book",), 7)
    effects = config.sim.effects
    assert all((effects.noise, effects.jpeg, effects.distortion, effects.latency, effects.command_delay,
                effects.profile, effects.steps, effects.axes, effects.lens, effects.scatter))  # fmt: skip


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
    told = []
    metrics = run_demo(tmp_path, 0, lambda *what: told.append(what))
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
    assert all(0 <= done <= total for _, done, total in told)
