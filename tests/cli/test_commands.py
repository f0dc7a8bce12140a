"""Results of the commands: JSON on stdout, tables, films, calibrations, lines of `config`, and the selected target."""

import argparse
import json
import math
import os
import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import cotarget
from cotarget.calibration import Options
from cotarget.cli.main import main
from cotarget.cli.pipeline_run import Selection, add_selection
from cotarget.config import BoardConfig, HardwareConfig, RigConfig, parse_config
from cotarget.control.selection import Candidate
from cotarget.drivers.rig import devices
from cotarget.errors import CalibrationError
from cotarget.geometry import pose
from cotarget.tracking.track import Track
from cotarget.video import Film
from experiments.calibration.synthetic.rig import Truth, undistorted
from experiments.engine import LINEAR_ALGEBRA
from experiments.learning.onnx_policy import write_policy
from tests.support.commands import OLD, bird_film, call, refused, true_calibration, write_index
from tests.support.rigs import alike
from tests.support.synthetic_rig import draw, pixel_rays

PIXEL = 1e-5  # an angle of 1e-11 rad, printed in full, at 692 px; and a text's rounding
CLOSE = 1e-9
AIM = ("aim", "--calibration", "good.json", "--pixel", "320", "240")
FOLLOW = ("follow", "--rig", "rig.toml", "--calibration", "good.json", "--target", "book",
          "--csv", "out.csv", "--video", "out.mp4")  # fmt: skip
TABLE = '[follow]\ntarget = "book"\ncalibration = "mine.json"\n'
FROM = ("calibrate", "--out", "new.json", "--from")
PHOTOS = ("--fixed", "left*.png", "--zoom", "right*.png", "--square", "0.1", "--board")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a rig, its calibration, and old results."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text('[sim]\nscene = "indoor"\ntargets = ["book"]\n')
    true_calibration(RigConfig()).save(tmp_path / "good.json")
    for name in ("out.csv", "out.mp4"):
        (tmp_path / name).write_text(OLD)
    (tmp_path / "photos").mkdir()
    return tmp_path


# Imitates a machine whose OpenGL libraries are neither found nor loaded.
WITHOUT_OPENGL = """
import ctypes, ctypes.util, sys
load, find = ctypes.CDLL.__init__, ctypes.util.find_library
def is_gl(name):
    return any(part in str(name) for part in ("EGL", "GL.", "GLX", "GLES", "OSMesa"))
def refuse(self, name, *rest, **options):
    if name and is_gl(name):
        raise OSError(f"{name}: cannot open shared object file: No such file or directory")
    load(self, name, *rest, **options)
ctypes.CDLL.__init__ = refuse
ctypes.util.find_library = lambda name: None if is_gl(name + ".") else find(name)
from cotarget.cli import main
sys.exit(main(sys.argv[1:]))
"""


def test_follow_without_opengl_names_the_package_to_install(folder):
    path = os.pathsep.join([str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_OPENGL, *FOLLOW],
        capture_output=True, text=True, check=False, cwd=folder,
        env={**os.environ, "PYTHONPATH": path, "MUJOCO_GL": "egl"},
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (1, "")
    [line] = done.stderr.splitlines()
    assert line.startswith("cotarget follow: ")
    assert "apt-get install -y libegl1" in line
    assert (folder / "out.csv").read_text() == OLD


def aim_json(capsys, *arguments):
    """The JSON of `aim`, and its warnings."""
    status, out, err = call(capsys, *AIM, *arguments)
    assert status == 0
    return json.loads(out), err.splitlines()


def test_aim_prints_json_with_the_documented_keys(folder, capsys):
    """By written-out matrices and OpenCV, the point is then in the middle of the zoom image."""
    found, warnings = aim_json(capsys, "--pixel", "500", "240", "--depth", "10")
    assert not warnings
    assert found["depth_m"] == pytest.approx(10.0)
    assert found["focal_mm"] == pytest.approx(6.0)  # the shortest, where nothing says otherwise
    assert found["focal_px"] == pytest.approx(692.0)
    budget = found["predicted_error_deg"]
    assert budget["total"] == pytest.approx(math.hypot(budget["steps"], budget["pixel"]))
    assert found["predicted_error_px"] == pytest.approx(math.tan(math.radians(budget["total"])) * 692)
    truth = Truth()
    xy = undistorted((500.0, 240.0), truth.fixed)
    pan, tilt = math.radians(found["pan_deg"]), math.radians(found["tilt_deg"])
    x_zoom = truth.in_zoom(10 * np.array([[*xy, 1.0]]), pan, tilt)
    np.testing.assert_allclose(truth.zoom.project(x_zoom)[0], [319.5, 239.5], rtol=0, atol=PIXEL)
    assert found["range_m"] == pytest.approx(np.linalg.norm(x_zoom), rel=CLOSE)


@pytest.mark.parametrize(("depth", "more", "nearest"), [
    ("0.01", [], "0.25 m"),  # a book of 0.234 m has 640 px at 0.251 m
    ("0.24", [], "0.25 m"),
    ("0.26", [], None),
    ("2", ["--target", "person"], "2.5 m"),  # 1.75 m have 480 px at 684 px focal length at 2.49 m
    ("2.6", ["--target", "person"], None),
])  # fmt: skip
def test_aim_warns_of_a_depth_at_which_no_target_fits(folder, capsys, depth, more, nearest):
    found, warnings = aim_json(capsys, "--depth", depth, "--focal-mm", "6", *more)
    assert found["depth_plausible"] is (nearest is None)
    assert len(warnings) == (nearest is not None)
    assert nearest is None or nearest in warnings[0]


def test_aim_takes_depth_from_a_size_and_focal_length_from_a_close_up(folder, capsys):
    size = str(686 * 0.234 / 12)
    found, warnings = aim_json(capsys, "--size-px", size, "--target", "book", "--wanted-px", "100", "--rig", "rig.toml")
    assert found["depth_m"] == pytest.approx(12.0, rel=1e-3)  # the pixel is not quite in the middle of the distortion
    assert found["focal_limited"] is False
    assert found["focal_px"] == pytest.approx(100 * found["range_m"] / 0.234, rel=1e-4)  # principal point 7 px off
    assert found["focal_mm"] == pytest.approx(6.0 * found["focal_px"] / 692)
    assert found["predicted_error_deg"]["size"] > 0
    assert found["focal_calibrated"] is False  # only 6 mm is
    assert len(warnings) == 1


@pytest.mark.parametrize(("more", "wanted_px"), [
    (["--target", "book"], 160), (["--target", "book", "--wanted-px", "100"], 100),
    (["--target", "book", "--focal-mm", "20"], None), ([], None),
])  # fmt: skip
def test_aim_shows_a_target_as_large_as_follow_does(folder, capsys, more, wanted_px):
    """As large as its profile says, where neither --wanted-px nor --focal-mm says otherwise."""
    found, _ = aim_json(capsys, "--depth", "12", *more)
    shortest_or_given = (20.0 if "--focal-mm" in more else 6.0) * 692 / 6
    expected = wanted_px * found["range_m"] / 0.234 if wanted_px else shortest_or_given
    assert found["focal_px"] == pytest.approx(expected, rel=1e-4)  # principal point 7 px off


@pytest.mark.parametrize(("depth", "plausible"), [("1200", True), ("1201", False)])
def test_aim_at_a_depth_where_no_target_is_seen_has_to_be_insisted_on(folder, capsys, depth, plausible):
    """A person of 1.75 m has 1 px at 1200.5 m, by a focal length of 686 px."""
    assert aim_json(capsys, "--depth", depth, "--insist")[0]["depth_plausible"] is plausible
    status, out, err = call(capsys, *AIM, "--depth", depth)
    said = "--depth: at 1201 m the person is 1 px large in the fixed image; is 1.201 m meant? --insist" in err
    assert (status, bool(out), said) == ((0, True, False) if plausible else (1, False, True))


@pytest.mark.parametrize("focal_mm", ["6", "50", "72"])
def test_aim_takes_a_focal_length(folder, capsys, focal_mm):
    found, warnings = aim_json(capsys, "--depth", "9", "--focal-mm", focal_mm)
    assert found["focal_mm"] == pytest.approx(float(focal_mm))
    assert found["focal_calibrated"] is (not warnings) is (focal_mm == "6")


@pytest.mark.parametrize("method", ["paper-table", "paper-example"])
def test_aim_takes_the_papers_inverse_kinematics(folder, capsys, method):
    """Its readings differ from the exact one by less than a degree near the axis, and have no predicted error."""
    exact, found = (aim_json(capsys, "--depth", "10", "--ik", each)[0] for each in ("exact", method))
    apart = math.hypot(found["pan_deg"] - exact["pan_deg"], found["tilt_deg"] - exact["tilt_deg"])
    assert 1e-4 < apart < 1
    assert found["predicted_error_deg"] is found["predicted_error_px"] is None


def test_calibrate_takes_photos_of_a_chessboard(folder, capsys):
    """Boards are drawn by a homography."""
    truth, board = Truth(), BoardConfig(square=0.1)
    rng = np.random.default_rng(0)
    rays = {lens: pixel_rays(lens) for lens in (truth.fixed, truth.zoom)}
    for number in range(8):
        T = pose([*rng.uniform([-1.0, -0.8], [0.5, 0.4]), rng.uniform(1.8, 3.0)], rng.uniform(-28, 28, 3)).as_matrix()
        pictures = [draw(truth.fixed, T, board, rays[truth.fixed]),
                    draw(truth.zoom, truth.gamma.as_matrix() @ T, board, rays[truth.zoom])]  # fmt: skip
        for side, picture in zip(("left", "right"), pictures, strict=True):
            cv2.imwrite(str(folder / "photos" / f"{side}{number}.png"), np.round(picture).astype(np.uint8))
    (folder / "photos" / "left99.png").write_bytes((folder / "photos" / "left0.png").read_bytes())
    status, out, err = call(capsys, *FROM, "photos", *PHOTOS, "9x6")
    assert status == 0
    assert err.splitlines()[-1].startswith("not used: 2 of 17 images; new.json")
    printed = json.loads(out)
    assert printed["calibration"] == "new.json"
    assert printed["baseline_m"] == pytest.approx(np.linalg.norm(truth.gamma.translation), abs=0.01)
    assert max(printed["fixed_rms_px"], printed["zoom_rms_px"], printed["stereo_rms_px"]) < 0.1
    saved = json.loads((folder / "new.json").read_text())
    assert saved["T_head_zoom"] is None
    alone = {"name": "left99.png", "reason": "has no partner with the same number"}
    assert alone in saved["residuals"]["rejected"]


@pytest.mark.parametrize(("more", "options"), [
    ((), Options()), (("--encoders",), Options(encoders=True)), (("--insist",), Options(regularize=True)),
    (("--method", "sequential"), Options("sequential")),
])  # fmt: skip
def test_calibrate_passes_the_options_of_the_fit(folder, capsys, monkeypatch, more, options):
    asked = []

    def calibrate(directory, options, progress):
        asked.append(options)
        raise CalibrationError("enough")

    monkeypatch.setattr("cotarget.calibration.calibrate_captures", calibrate)
    write_index(folder / "photos", [])
    assert refused(capsys, *FROM, "photos", *more) == "cotarget calibrate: enough"
    assert asked == [options]


@pytest.mark.render
def test_follow_writes_a_table_and_a_film(folder, capsys):
    status, out, err = call(capsys, *FOLLOW, "--seconds", "0.3")
    assert (status, err) == (0, "")
    printed = json.loads(out)
    lines = (folder / "out.csv").read_text().splitlines()
    assert printed["steps"] == len(lines) - 1 == sum(printed["states"].values())
    assert printed["steps"] >= 6
    capture = cv2.VideoCapture(str(folder / "out.mp4"))
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == printed["steps"]
    capture.release()


@pytest.mark.render
@pytest.mark.parametrize(("calibration", "table"), [("calibration.json", ""), ("mine.json", TABLE)])
def test_follow_needs_no_option_in_the_folder_of_a_rig(folder, capsys, calibration, table):
    (folder / "good.json").rename(folder / calibration)
    scene = ["book", "person"] if table else ["book"]
    (folder / "rig.toml").write_text(f'[sim]\nscene = "indoor"\ntargets = {json.dumps(scene)}\n{table}')
    status, out, err = call(capsys, "follow", "--seconds", "0.3")  # without it, to Ctrl-C
    assert (status, err, json.loads(out)["steps"] >= 6) == (0, "", True)


@pytest.mark.render
def test_follow_takes_a_learnt_policy_as_a_file(folder, capsys):
    pytest.importorskip("onnxruntime", reason="runs policies")
    pytest.importorskip("onnx", reason="writes policies")
    still = np.zeros((3, 14), np.float32), np.zeros(3, np.float32)
    write_policy(folder / "still.onnx", [still], np.zeros(14), np.ones(14), 10.0, "rates")
    options = "--seconds", "0.3", "--policy", "still.onnx"
    status, out, err = call(capsys, *FOLLOW, *options, "--record", "run")
    assert (status, err, json.loads(out)["states"]["following"] > 0) == (0, "", True)
    (folder / "still.onnx").unlink()  # the recording has its own
    assert call(capsys, "replay", "run", "--check")[0] == 0
    write_policy(folder / "still.onnx", [still], np.zeros(14), np.ones(14), 10.0, "rates")
    said = refused(capsys, *FOLLOW, "--policy", "none.onnx")
    assert said == "cotarget follow: --policy: none.onnx: no such file; give a policy as an ONNX file"


def test_detect_writes_a_table(folder, capsys):
    bird_film(folder / "sky.mp4")
    detect = ("detect", "sky.mp4", "--target", "bird", "--csv")
    status, out, err = call(capsys, *detect, "out.csv")
    assert (status, err) == (0, "")
    printed, table = json.loads(out), (folder / "out.csv").read_text()
    assert (printed["frames"], printed["tracks"]) == (60, 1)
    assert printed["frames_with_target"] > 20
    assert table.startswith("frame,t,track,u_px,v_px,width_px,height_px,score\n")
    status, out, err = call(capsys, *detect, "-")  # the table goes to stdout, and the summary to stderr
    assert (status, out, json.loads(err)) == (0, table, printed)
    assert not (folder / "-").exists()


@pytest.mark.parametrize("text", ["", "[follow]\n"])
def test_detect_ignores_the_regions_of_a_file(folder, capsys, text):
    """Of the file alone, or of a rig.toml; the bird flies at 0.43 of the height, and the video outlines the region."""
    bird_film(folder / "sky.mp4")
    (folder / "regions.toml").write_text(f"{text}ignored = [[[0, 0.3], [1, 0.3], [1, 0.8], [0, 0.8]]]\n")
    detect = ("detect", "sky.mp4", "--target", "bird", "--csv", "out.csv", "--video", "out.mp4")
    assert json.loads(call(capsys, *detect)[1])["tracks"] == 1
    status, out, err = call(capsys, *detect, "--ignore", "regions.toml")
    assert (status, err, json.loads(out)["tracks"]) == (0, "", 0)
    pictures = []
    for name in ("sky.mp4", "out.mp4"):
        with Film(folder / name) as film:
            pictures.append(next(iter(film)).image.astype(int))
    off = np.abs(pictures[0] - pictures[1])[:, 20:-20].max(axis=(1, 2)) / 255  # between the region's ends
    line, height = round(0.3 * len(off)), len(off)
    assert off[line - 2 : line + 3].max() > 0.1
    assert off[round(0.5 * height) : round(0.65 * height)].max() < 0.1  # what is inside is shown


def test_version(capsys):
    assert call(capsys, "--version")[:2] == (0, f"cotarget {cotarget.__version__}\n")


COMMAND = """
import sys
from cotarget.cli import main
assert main(["board", "--out", sys.argv[1]]) == 0
from threadpoolctl import threadpool_info
print(*{pool["num_threads"] for pool in threadpool_info()})
"""


@pytest.mark.parametrize(("environment", "threads"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "2"}, "2")])
def test_command_uses_one_thread_of_linear_algebra(environment, threads, tmp_path):
    if len(os.sched_getaffinity(0)) < 2:
        pytest.skip("with one core there is never a second thread")
    clean = {name: value for name, value in os.environ.items() if name not in LINEAR_ALGEBRA}
    command = [sys.executable, "-c", COMMAND, str(tmp_path / "board.svg")]
    made = subprocess.run(command, env=clean | environment, capture_output=True, text=True, check=True)
    assert made.stdout.splitlines()[-1] == threads


def test_every_key_that_is_taken_in_has_its_default(capsys):
    assert main(["config"]) == 0
    lines, keys = [], 0
    for line in capsys.readouterr().out.splitlines():
        if re.match(r"#\w+ = ", line):
            try:
                tomllib.loads(line[1:])
            except tomllib.TOMLDecodeError:  # the form of a key without a default
                continue
            line, keys = line[1:], keys + 1
        lines.append(line)
    found, usual = parse_config(tomllib.loads("\n".join(lines))), parse_config({})
    assert keys > 100
    assert repr(replace(found, hardware=HardwareConfig())) == repr(usual)  # poses are printed to eight digits
    assert {name: device.settings for name, device in devices(found.hardware).items()} == {
        name: device.settings for name, device in devices(usual.hardware).items()
    }


SIZE = (640, 480)
LIMITS = alike((-2.8, 2.8), (-0.8, 0.5), 2.6, 3.6, 0.0)


def chosen(*arguments, recorded=None):
    parser = argparse.ArgumentParser(exit_on_error=False)
    add_selection(parser)
    return Selection(parser.parse_args(arguments), SIZE, recorded)


def track(number, center=(1, 1), confirmed=True):
    center, size = np.array(center, float), np.array([20.0, 30.0])
    return Track(number, 0.0, confirmed, 0, center, np.zeros(2), size, size, 30.0, np.eye(4), 1.0, None)


@pytest.mark.parametrize(("arguments", "recorded", "number"), [
    ((), None, 2), (("--policy", "first-come"), None, 2), (("--policy", "nearest-deadline"), None, 5),
    (("--policy", "most-served"), None, 2), (("--click", "325", "210"), None, 3),
    (("--click", "325", "400"), None, None), (("--track", "5"), None, 5), (("--track", "4"), None, None),
    ((), {"track": 5}, 5), ((), {"click": [325, 210.0]}, 3), ((), {"policy": "nearest-deadline"}, 5),
    (("--track", "3"), {"track": 5}, 3),
])  # fmt: skip
def test_options_or_recording_select_the_target(arguments, recorded, number):
    """Of three targets: one at the left stays, one in the middle leaves in 9 s, and one at the right in 5 s."""
    places = {2: (100, 200), 3: (320, 200), 5: (600, 200)}
    seen_s = (0.0, 2.0, 2.0) if "most-served" in arguments else (0.0, 0.0, 0.0)
    candidates = [
        Candidate(track(number, at), lambda _, at=at: np.array([(at[0] - 320) / 686, 0.0]), leaves, seen)
        for (number, at), leaves, seen in zip(places.items(), (np.inf, 9.0, 5.0), seen_s, strict=True)
    ]
    selector = chosen(*arguments, recorded=recorded).selector
    selector.start(SIZE)
    assert selector.select(candidates, np.zeros(2), LIMITS) == number


@pytest.mark.parametrize(("arguments", "recorded", "named"), [
    (("--track", "4"), None, "--track"), (("--click", "3", "4"), None, "--click"),
    ((), {"track": 4}, "the recorded track"), ((), {"click": [3.0, 4.0]}, "the recorded click"), ((), None, None),
])  # fmt: skip
def test_unmatched_selection_is_reported_with_the_tracks_seen(arguments, recorded, named):
    selection = chosen(*arguments, recorded=recorded)
    assert selection.warning == ""  # nothing was there at all
    selection.see(SimpleNamespace(target=None, tracks=[track(2), track(3, confirmed=False)]))
    if named is not None:
        assert selection.warning.startswith(f"{named}: ")
        assert selection.warning.endswith(": 2")
        selection.see(SimpleNamespace(target=track(4), tracks=[]))
    assert selection.warning == ""
