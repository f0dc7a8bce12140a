"""The commands: a mistake ends in one line that names it, and leaves results as they were; JSON on stdout."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import cotarget
from cotarget import cli
from cotarget.calibration import Calibration, draw_board, save_calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import BoardConfig, RigConfig
from cotarget.geometry import RigidTransform, pose
from cotarget.pantilt import HeadGeometry
from cotarget.rig_geometry import FixedCamera, ZoomHead
from experiments.calibration.synthetic.rig import NOMINAL_PX, Truth, undistorted
from tests.support.rigs import with_zoom_head
from tests.support.synthetic_rig import draw, fourfold, pixel_rays, zoomed

OLD = "what was there before\n"
PIXEL = 1e-5  # an angle of 1e-11 rad, printed in full, at 692 px; and a text's rounding
CLOSE = 1e-9


def true_calibration(config, zoom_size=None, with_head=True):
    """The exact calibration of a configured rig."""
    sim = config.sim
    zoom = Intrinsics(zoom_size or sim.zoom.size, sim.zoom.focal_px, sim.zoom.center_px, sim.zoom.distortion)
    return Calibration(
        fixed=FixedCamera(Intrinsics(sim.fixed.size, sim.fixed.focal_px, sim.fixed.center_px, sim.fixed.distortion)),
        zoom_head=ZoomHead(
            ZoomLens((sim.zoom.focal_mm[0] / sim.zoom.pitch_mm,), (zoom,)),
            sim.T_zoom0_fixed,
            sim.T_head_zoom if with_head else None,
            HeadGeometry(sim.head.axis_offset_mm / 1000, math.radians(sim.head.squareness_deg)),
        ),
        pitch_mm=sim.zoom.pitch_mm,
    )


CAPTURE = {"board": 0, "pan": 0.0, "tilt": 0.0, "focal_px": None, "t": 0.0}


def write_index(folder, rows):
    table = {"schema": 1, "board": {"kind": "chessboard", "corners": [9, 6], "square": 0.1}, "pitch_mm": None}
    (folder / "index.json").write_text(json.dumps(table | {"captures": rows}))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a good rig, good calibrations, old results, and much that is no good."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text('[sim]\nscene = "indoor"\ntargets = ["book"]\n')
    (tmp_path / "narrow.toml").write_text("[safety]\npan_deg = [-5, 5]\n")
    (tmp_path / "other_shape.toml").write_text("[sim.fixed]\nsize = [640, 360]\n")
    (tmp_path / "typo.toml").write_text("[sim]\nscenery = 1\n")
    (tmp_path / "moon.toml").write_text('[sim]\nscene = "moon"\n')
    (tmp_path / "broken.toml").write_text("[sim\n")
    (tmp_path / "whale.toml").write_text('[sim]\ntargets = ["whale"]\n')
    save_calibration(tmp_path / "good.json", true_calibration(RigConfig()))
    save_calibration(tmp_path / "wide.json", true_calibration(RigConfig(), zoom_size=(640, 360)))
    save_calibration(tmp_path / "headless.json", true_calibration(RigConfig(), with_head=False))
    good = true_calibration(RigConfig())
    wide_apart = RigidTransform.from_components(
        1000 * good.zoom_head.T_zoom0_fixed.translation, good.zoom_head.T_zoom0_fixed.rotation
    )
    save_calibration(tmp_path / "millimetres.json", with_zoom_head(good, T_zoom0_fixed=wide_apart))
    (tmp_path / "broken.json").write_text('{"schema": 2, "fixed": {')
    (tmp_path / "empty.json").write_text('{"schema": 2}')
    for name in ("out.json", "out.csv", "out.mp4"):
        (tmp_path / name).write_text(OLD)
    (tmp_path / "text.mp4").write_text("no film")
    (tmp_path / "nothing").mkdir()
    (tmp_path / "index").mkdir()
    (tmp_path / "index" / "index.json").write_text('{"schema": 1, "board": 5, "pitch_mm": null, "captures": [1]}')
    for camera, other in (("zoom", "fixed"), ("fixed", "zoom")):
        folder = tmp_path / f"no_{other}"
        folder.mkdir()
        cv2.imwrite(str(folder / "a.png"), draw_photo())
        write_index(folder, [CAPTURE | {"file": "a.png", "camera": camera}])
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "index.json").write_text('{"schema": 1, "boa')
    grey = np.full((120, 160, 3), 128, np.uint8)
    for number in range(4):
        (tmp_path / "grey").mkdir(exist_ok=True)
        for side in ("left", "right"):
            cv2.imwrite(str(tmp_path / "grey" / f"{side}{number}.png"), grey)
    board = draw_photo()
    (tmp_path / "single").mkdir()
    for side in ("left", "right"):
        cv2.imwrite(str(tmp_path / "single" / f"{side}1.png"), board)
    return tmp_path


def draw_photo():
    """A 9x6 board seen straight on, with a white margin."""
    rows, columns = np.mgrid[:7, :10]
    squares = np.kron((rows + columns) % 2 * 255, np.ones((24, 24))).astype(np.uint8)
    return cv2.cvtColor(cv2.copyMakeBorder(squares, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255), cv2.COLOR_GRAY2BGR)


def call(capsys, *arguments):
    """Exit status, stdout and stderr of a command."""
    try:
        status = cli.main([str(a) for a in arguments])
    except SystemExit as left:
        status = left.code
    said = capsys.readouterr()
    return status, said.out, said.err


AIM = ("aim", "--calibration", "good.json", "--pixel", "320", "240")
FOLLOW = ("follow", "--rig", "rig.toml", "--calibration", "good.json", "--target", "book",
          "--csv", "out.csv", "--video", "out.mp4")  # fmt: skip
PHOTOS = ("--fixed", "left*.png", "--zoom", "right*.png", "--board", "9x6", "--square", "0.1", "--out", "out.json")
FROM_RIG = ("calibrate", "--out", "out.json", "--rig")
FROM = ("calibrate", "--out", "out.json", "--from")
DETECT = ("detect", "--target", "bird", "--csv", "out.csv", "--video", "out.mp4")


def changed(command, *changes):
    """A command with the values of some options replaced."""
    command = list(command)
    for option, value in zip(changes[::2], changes[1::2], strict=True):
        command[command.index(option) + 1] = value
    return command


MISTAKES = {
    # results that would overwrite what they come from
    "a rig as result": (changed([*FROM_RIG, "rig.toml"], "--out", "rig.toml"), ["rig.toml: is read or written"]),
    "a calibration as table": ([*FOLLOW, "--csv", "good.json"], ["good.json: is read or written"]),
    "one file for two results": ([*FOLLOW, "--csv", "out.csv", "--video", "out.csv"], ["out.csv: is read or written"]),
    # rig.toml
    "no rig": ([*FROM_RIG, "none.toml"], ["none.toml: no such file", "rig.toml"]),
    "a folder as rig": ([*FROM_RIG, "nothing"], ["nothing: is a directory"]),
    "no TOML": ([*FROM_RIG, "broken.toml"], ["broken.toml: is not TOML"]),
    "an unknown key": ([*FROM_RIG, "typo.toml"], ["typo.toml", "sim.scenery", "scene"]),
    "an unknown scene": ([*FROM_RIG, "moon.toml"], ["unknown scene 'moon'", "indoor, outdoor"]),
    "an unknown target in the scene": ([*FROM_RIG, "whale.toml"], ["unknown target 'whale'", "bird, book, person"]),
    "follow without a rig": (changed(FOLLOW, "--rig", "none.toml"), ["none.toml: no such file"]),
    "follow an unknown target": (changed(FOLLOW, "--target", "dog"), ["unknown target 'dog'", "bird, book, person"]),
    "detect an unknown target": ([*changed(DETECT, "--target", "dog"), "text.mp4"], ["unknown target 'dog'"]),
    "a size that nothing has": ([*AIM, "--size-px", "5000", "--target", "book"],
                                ["--size-px: 5000 px is no size that a book of 0.234 m has", "640x480"]),
    "a size that vanishes": ([*AIM, "--size-px", "1e-320", "--target", "book"], ["--size-px: ", "is no size"]),
    "a depth beyond the sky": ([*AIM, "--depth", "1e300"], ["farther than anything on earth"]),
    "aim with an unknown target": ([*AIM, "--size-px", "9", "--target", "dog"], ["unknown target 'dog'", "book"]),
    # calibration.json
    "no calibration": (changed([*AIM, "--depth", "5"], "--calibration", "none.json"), ["none.json: no such file"]),
    "half a calibration": (changed([*AIM, "--depth", "5"], "--calibration", "broken.json"),
                           ["broken.json: is not JSON"]),
    "an empty calibration": (changed(FOLLOW, "--calibration", "empty.json"), ["empty.json: is no calibration"]),
    "another aspect ratio": (changed(FOLLOW, "--calibration", "wide.json"), ["640x480", "640x360", "aspect ratio"]),
    "another aspect ratio in aim": ([*AIM, "--depth", "5", "--rig", "other_shape.toml"], ["640x360", "640x480"]),
    "no hand-eye part": (changed([*AIM, "--depth", "5"], "--calibration", "headless.json"),
                          ["T_head_zoom", "on a rig"]),
    "aim in millimetres": (changed([*AIM, "--depth", "5"], "--calibration", "millimetres.json"),
                           ["millimetres.json: T_zoom0_fixed", "metres", "--insist"]),
    "a report of millimetres": (["report", "millimetres.json", "--out", "page.html"],
                                ["millimetres.json: T_zoom0_fixed", "metres", "--insist"]),
    "follow in millimetres": (changed(FOLLOW, "--calibration", "millimetres.json"),
                              ["millimetres.json: T_zoom0_fixed", "metres", "--insist"]),
    "latency in millimetres": (["latency", "--rig", "rig.toml", "--calibration", "millimetres.json"],
                               ["millimetres.json: T_zoom0_fixed", "metres", "--insist"]),
    # photos and captures
    "photos without a board": ([*FROM, "grey", *PHOTOS], ["grey: no picture shows", "9x6 inner corners"]),
    "a single photo of each": ([*FROM, "single", *PHOTOS], ["1 usable views of the board; at least 3"]),
    "no photos": ([*FROM, "nothing", *PHOTOS], ["nothing: no file matches 'left*.png'"]),
    "no folder": ([*FROM, "none", *PHOTOS], ["none: no such folder"]),
    "no captures": ([*FROM, "nothing"], ["holds no index.json of captures"]),
    "no folder of captures": ([*FROM, "none"], ["none: no such folder; --from takes one of captures or photos"]),
    "a malformed index": ([*FROM, "index"], ["index.json: ", "board"]),
    "captures without the fixed camera": ([*FROM, "no_fixed"], ["no_fixed: has no capture of the fixed camera"]),
    "captures without the zoom camera": ([*FROM, "no_zoom"], ["no_zoom: has no capture of the zoom camera"]),
    "half an index": ([*FROM, "cut"], ["index.json: is not JSON"]),
    "a board that is no board": (changed([*FROM, "single", *PHOTOS], "--board", "9by6"), ["--board", "9by6", "9x6"]),
    "a board too small": (changed([*FROM, "single", *PHOTOS], "--board", "2x6"), ["--board", "2x6", "3 at least"]),
    "another board": (changed([*FROM, "single", *PHOTOS], "--board", "7x6"),
                      ["single: no picture shows", "7x6 inner corners"]),
    "a symmetric board": (changed([*FROM, "single", *PHOTOS], "--board", "7x7"), ["7x7"]),
    "a square in millimetres": (changed([*FROM, "single", *PHOTOS], "--square", "25"), ["25 mm are 0.025"]),
    "a device for a result": (["board", "--out", "/dev/null"], ["/dev/null: is a device"]),
    "a square without a side": (changed([*FROM, "single", *PHOTOS], "--square", "0"),
                              ["--square", "0 is not greater"]),
    "half the options for photos": ([*FROM, "single", "--fixed", "left*.png"], ["--zoom", "--board", "--square"]),
    "photos with a rig": ([*FROM_RIG, "rig.toml", "--board", "9x6"], ["--board goes with --from"]),
    "a kind of board with a rig": ([*FROM_RIG, "rig.toml", "--kind", "charuco"], ["--kind goes with --from"]),
    "a kind of board with captures": ([*FROM, "index", "--kind", "charuco"], ["--fixed, --zoom, --board and --square"]),
    "an unknown kind of board": ([*FROM, "single", *PHOTOS, "--kind", "circles"], ["--kind", "circles", "charuco"]),
    "another kind of board": ([*FROM, "single", *PHOTOS, "--kind", "charuco"],
                              ["single: no picture shows", "charuco of 9x6"]),
    "encoders step by step": ([*FROM, "index", "--encoders", "--method", "sequential"],
                              ["--encoders goes with --method joint"]),
    "insisting step by step": ([*FROM_RIG, "rig.toml", "--insist", "--method", "sequential"],
                               ["--insist goes with --method joint"]),
    "encoders on photos": ([*FROM, "single", *PHOTOS, "--encoders"], ["--encoders goes with --rig or saved captures"]),
    "captures without a rig": ([*FROM, "index", "--captures", "x"], ["--captures goes with --rig"]),
    "neither rig nor captures": (["calibrate"], ["--rig", "--from"]),
    # films
    "no film": ([*DETECT, "none.mp4"], ["none.mp4: no such file"]),
    "a text as film": ([*DETECT, "text.mp4"], ["text.mp4: cannot be read as a film"]),
    "a folder as film": ([*DETECT, "nothing"], ["nothing: is a directory"]),
    # aim
    "behind the camera": ([*AIM, "--depth", "-3"], ["--depth", "-3", "greater than zero"]),
    "at no distance": ([*AIM, "--depth", "nan"], ["--depth", "nan"]),
    "a word for a depth": ([*AIM, "--depth", "far"], ["--depth", "'far' is not a number"]),
    "beyond the limits": ([*AIM, "--depth", "0.5", "--rig", "narrow.toml"], ["beyond the limits", "pan -5 to 5"]),
    "outside of the image": (["aim", "--calibration", "good.json", "--pixel", "640", "240", "--depth", "5"],
                             ["--pixel", "(640, 240)", "640x480"]),
    "a pixel that is no number": (["aim", "--calibration", "good.json", "--pixel", "nan", "240", "--depth", "5"],
                                  ["--pixel", "(nan, 240)"]),
    "one coordinate": (["aim", "--calibration", "good.json", "--pixel", "5", "--depth", "5"], ["--pixel"]),
    "a size without a target": ([*AIM, "--size-px", "16"], ["--size-px needs --target"]),
    "a close-up without a target": ([*AIM, "--depth", "5", "--wanted-px", "16"], ["--wanted-px needs --target"]),
    "no size": ([*AIM, "--size-px", "0", "--target", "book"], ["--size-px", "greater than zero"]),
    "beyond the lens": ([*AIM, "--depth", "5", "--focal-mm", "100"], ["--focal-mm", "100", "6 to 72 mm"]),
    "short of the lens": ([*AIM, "--depth", "5", "--focal-mm", "5.9"], ["--focal-mm", "6 to 72 mm"]),
    "depth and size": ([*AIM, "--depth", "5", "--size-px", "16"], ["--size-px", "--depth"]),
    "neither depth nor size": ([*AIM], ["--depth", "--size-px"]),
    "an unknown inverse": ([*AIM, "--depth", "5", "--ik", "magic"], ["--ik", "magic", "exact", "paper-table"]),
    # others
    "a negative seed": (["demo", "--seed", "-1"], ["--seed", "-1", "whole number"]),
    "a seed that is no number": (["demo", "--seed", "lucky"], ["--seed", "lucky"]),
    "a superscript seed": (["demo", "--seed", "²"], ["--seed"]),
    "no time": ([*FOLLOW, "--seconds", "0"], ["--seconds", "greater than zero"]),
    "no command": ([], ["COMMAND"]),
    "an unknown command": (["dance"], ["dance", "calibrate"]),
    "an unknown option": ([*AIM, "--depth", "5", "--fast"], ["--fast"]),
    # where to write
    "a demo in a file": (["demo", "--out", "out.json/x"], ["out.json/x", "name a folder"]),
    "a demo over a file": (["demo", "--out", "out.json"], ["out.json", "name a folder"]),
    "a calibration in no folder": (changed([*FROM_RIG, "rig.toml"], "--out", "none/c.json"), ["none/c.json", "folder"]),
    "a calibration over a folder": (changed([*FROM_RIG, "rig.toml"], "--out", "nothing"), ["nothing: is a folder"]),
    "a table in no folder": (changed(FOLLOW, "--csv", "none/out.csv"), ["none/out.csv", "folder"]),
    "a film in no folder": (changed(FOLLOW, "--video", "none/out.mp4"), ["none/out.mp4", "folder"]),
    "a table of a film in no folder": ([*changed(DETECT, "--csv", "none/out.csv"), "text.mp4"], ["none/out.csv"]),
}  # fmt: skip
RENDERED = {
    "a film of no kind": (changed(FOLLOW, "--video", "out.xyz"), ["out.xyz: cannot be written", ".mp4"]),
    "captures in a file": ([*FROM_RIG, "rig.toml", "--captures", "out.csv/x"], ["out.csv/x: cannot be made"]),
    "captures over captures": ([*FROM_RIG, "rig.toml", "--captures", "index"], ["index: already holds captures"]),
}


def check_mistake(folder, capsys, arguments, parts):
    before = sorted(path.relative_to(folder) for path in folder.rglob("*"))
    status, out, err = call(capsys, *arguments)
    assert status not in (0, None)
    assert out == ""
    assert err.endswith("\n")
    assert len(err.splitlines()) == 1, err
    assert err.startswith("cotarget")
    assert "Traceback" not in err
    for part in parts:
        assert part in err
    assert sorted(path.relative_to(folder) for path in folder.rglob("*")) == before  # no rubbish
    for name in ("out.json", "out.csv", "out.mp4"):
        assert (folder / name).read_text() == OLD


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_ends_in_one_line_that_names_it(folder, capsys, mistake):
    check_mistake(folder, capsys, *MISTAKES[mistake])


@pytest.mark.render
@pytest.mark.parametrize("mistake", RENDERED)
def test_a_mistake_that_shows_with_the_rig_open(folder, capsys, mistake):
    check_mistake(folder, capsys, *RENDERED[mistake])


# Stands in for a machine without any OpenGL: neither found nor loaded.
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


def test_a_machine_without_opengl(folder):
    path = os.pathsep.join([str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_OPENGL, *FOLLOW],
        capture_output=True, text=True, check=False, cwd=folder,
        env={**os.environ, "PYTHONPATH": path, "MUJOCO_GL": "egl"},
    )  # fmt: skip
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1, done.stderr
    for part in ("cotarget follow: ", "no OpenGL library", "(egl)", "apt-get install -y libegl1"):
        assert part in done.stderr
    assert done.stdout == ""
    assert (folder / "out.csv").read_text() == OLD


def aim_json(capsys, *arguments):
    status, out, err = call(capsys, *arguments)
    assert status == 0
    beyond = json.loads(out)["focal_calibrated"] is False
    assert ("beyond the focal lengths calibrated" in err) is beyond
    assert len(err.splitlines()) == beyond
    return json.loads(out)


def test_aim_tells_json_with_the_documented_keys(folder, capsys):
    told = aim_json(capsys, *changed([*AIM, "--depth", "10"], "--pixel", "500"))
    assert set(told) >= {"pan_deg", "tilt_deg", "focal_px", "focal_mm", "depth_m", "predicted_error_deg"}
    assert told["depth_m"] == pytest.approx(10.0)
    assert told["focal_mm"] == pytest.approx(6.0)  # the shortest, where nothing says otherwise
    assert told["focal_px"] == pytest.approx(692.0)
    budget = told["predicted_error_deg"]
    assert budget["total"] == pytest.approx(math.hypot(budget["steps"], budget["pixel"]))
    assert told["predicted_error_px"] == pytest.approx(math.tan(math.radians(budget["total"])) * 692)
    # By written-out matrices and OpenCV: the point is then in the middle of the zoom image.
    truth = Truth()
    xy = undistorted((500.0, 240.0), truth.fixed)
    pan, tilt = math.radians(told["pan_deg"]), math.radians(told["tilt_deg"])
    x_zoom = truth.in_zoom(10 * np.array([[*xy, 1.0]]), pan, tilt)
    np.testing.assert_allclose(truth.zoom.project(x_zoom)[0], [319.5, 239.5], rtol=0, atol=PIXEL)
    assert told["range_m"] == pytest.approx(np.linalg.norm(x_zoom), rel=CLOSE)


@pytest.mark.parametrize(
    ("depth", "more", "doubted"),
    [
        ("0.01", [], "no target, not even the book, fits into the fixed view nearer than 0.25 m"),  # 640 px at 0.251 m
        ("0.24", [], "no target, not even the book, fits into the fixed view nearer than 0.25 m"),
        ("0.26", [], None),
        (
            "2",
            ["--target", "person"],
            "the person does not fit into the fixed view nearer than 2.5 m",  # 1.75 m at 684 px are 480 px at 2.49 m
        ),
        ("2.6", ["--target", "person"], None),
    ],
)
def test_a_depth_at_which_no_target_fits_into_the_view_is_doubted(folder, capsys, depth, more, doubted):
    status, out, err = call(capsys, *AIM, "--depth", depth, *more)
    assert status == 0
    assert json.loads(out)["depth_plausible"] is (doubted is None)
    assert len(err.splitlines()) == (doubted is not None)
    if doubted is not None:
        assert err == f"cotarget aim: {doubted}: is a depth of {depth} m meant?\n"


def test_aim_takes_depth_from_a_size_and_focal_length_from_a_close_up(folder, capsys):
    size = str(686 * 0.234 / 12)
    told = aim_json(capsys, *AIM, "--size-px", size, "--target", "book", "--wanted-px", "100", "--rig", "rig.toml")
    assert told["depth_m"] == pytest.approx(12.0, rel=1e-3)  # the pixel is not quite in the middle of the distortion
    assert told["focal_limited"] is False
    assert told["focal_px"] == pytest.approx(100 * told["range_m"] / 0.234, rel=1e-4)  # the principal point is 7 px off
    assert told["focal_mm"] == pytest.approx(6.0 * told["focal_px"] / 692)
    assert told["predicted_error_deg"]["size"] > 0
    status, out, err = call(capsys, *AIM, "--depth", "30", "--target", "book", "--wanted-px", "160")
    limited = json.loads(out)
    assert (status, limited["focal_limited"]) == (0, True)
    shown = 72.0 * 692 / 6.0 * 0.234 / limited["range_m"]
    assert f"cotarget aim: the lens shows the book {shown:.0f} px large there, and not 160\n" in err
    assert limited["focal_mm"] == pytest.approx(72.0)


def test_a_close_up_that_the_lens_cannot_make_is_told_in_the_pixels_along_the_known_dimension(folder, capsys):
    """Of a person along v, whose focal length is another; thousands without an exponent; and what is as wanted, not."""

    def told(*arguments):
        status, out, err = call(capsys, *AIM, *arguments)
        assert status == 0
        return json.loads(out), [line for line in err.splitlines() if "the lens shows" in line]

    near, lines = told("--depth", "1", "--target", "person", "--wanted-px", "160")
    shown = 1.75 * near["focal_px"] * 693 / 692 / near["range_m"]
    assert lines == [f"cotarget aim: the lens shows the person {shown:.0f} px large there, and not 160"]
    assert shown > 1000
    far, lines = told("--depth", "3000", "--target", "book", "--wanted-px", "160")
    shown = 0.234 * far["focal_px"] / far["range_m"]
    assert lines == [f"cotarget aim: the lens shows the book {shown:.2g} px large there, and not 160"]
    limit = 72.0 * 692 / 6.0 * 0.234 / 160  # range from which on the lens is too short [m]
    depth = 2 * limit - told("--depth", f"{limit}", "--target", "book", "--wanted-px", "160")[0]["range_m"]
    for beyond, limited, told_of in ((0.998, False, False), (1.002, True, False), (1.008, True, True)):
        book, lines = told("--depth", f"{depth * beyond}", "--target", "book", "--wanted-px", "160")
        assert (book["focal_limited"], bool(lines)) == (limited, told_of)


def test_the_shortcut_is_told_without_a_prediction_that_is_of_the_exact_inverse(folder, capsys):
    told = aim_json(capsys, *AIM, "--depth", "9", "--ik", "paper-table")
    assert told["predicted_error_deg"] is None
    assert told["predicted_error_px"] is None


@pytest.mark.parametrize("focal_mm", ["6", "50", "72"])
def test_aim_takes_a_focal_length(folder, capsys, focal_mm):
    assert aim_json(capsys, *AIM, "--depth", "9", "--focal-mm", focal_mm)["focal_mm"] == pytest.approx(float(focal_mm))


@pytest.mark.parametrize("method", ["exact", "paper-table", "paper-example"])
def test_the_inverse_can_be_chosen(folder, capsys, method):
    """The paper's readings differ from the exact one by less than a degree near the axis, and not by nothing."""
    exact = aim_json(capsys, *AIM, "--depth", "10")
    told = aim_json(capsys, *AIM, "--depth", "10", "--ik", method)
    apart = math.hypot(told["pan_deg"] - exact["pan_deg"], told["tilt_deg"] - exact["tilt_deg"])
    assert apart == 0 if method == "exact" else 1e-4 < apart < 1


def test_photos_are_calibrated(folder, capsys):
    """Boards drawn by a homography: the intrinsics come back, and JSON tells the residuals."""
    (folder / "photos").mkdir()
    truth, board = Truth(), BoardConfig(square=0.1)
    rng = np.random.default_rng(0)
    rays = {lens: pixel_rays(lens) for lens in (truth.fixed, truth.zoom)}
    number = 0
    while number < 8:
        T = pose([*rng.uniform([-1.0, -0.8], [0.5, 0.4]), rng.uniform(1.8, 3.0)], rng.uniform(-28, 28, 3)).as_matrix()
        pictures = [draw(truth.fixed, T, board, rays[truth.fixed]),
                    draw(truth.zoom, truth.gamma.as_matrix() @ T, board, rays[truth.zoom])]  # fmt: skip
        for side, picture in zip(("left", "right"), pictures, strict=True):
            cv2.imwrite(str(folder / "photos" / f"{side}{number}.png"), np.round(picture).astype(np.uint8))
        number += 1
    (folder / "photos" / "left99.png").write_bytes((folder / "photos" / "left0.png").read_bytes())
    status, out, err = call(capsys, *FROM, "photos", *PHOTOS)
    assert status == 0
    assert err.splitlines()[-1] == "not used: 2 of 17 images; out.json has the reasons (residuals.rejected)"
    told = json.loads(out)
    assert told["calibration"] == "out.json"
    assert told["baseline_m"] == pytest.approx(np.linalg.norm(truth.gamma.translation), abs=0.01)
    assert max(told["fixed_rms_px"], told["zoom_rms_px"], told["stereo_rms_px"]) < 0.1
    saved = json.loads((folder / "out.json").read_text())
    assert saved["T_head_zoom"] is None
    alone = {"name": "left99.png", "reason": "has no partner with the same number"}
    assert alone in saved["residuals"]["rejected"]


def test_photos_of_a_board_with_markers_are_calibrated(folder, capsys):
    """8x6 corners, which no plain chessboard may have, seen by two cameras without any distortion."""
    (folder / "photos").mkdir()
    (folder / "out.json").unlink()
    truth, rng, square_px = Truth(), np.random.default_rng(0), 40
    picture = draw_board(BoardConfig("charuco", (8, 6), 0.1), square_px)
    first = 2 * square_px - 0.5  # where the first inner corner is drawn
    to_board = np.diag([0.1 / square_px, 0.1 / square_px, 1.0]) @ [[1, 0, -first], [0, 1, -first], [0, 0, 1]]
    for number in range(8):
        T = pose([*rng.uniform([-0.8, -0.5], [0.0, 0.0]), rng.uniform(1.6, 2.0)], rng.uniform(-25, 25, 3)).as_matrix()
        for side, lens, M in (("left", truth.fixed, T), ("right", truth.zoom, truth.gamma.as_matrix() @ T)):
            photo = cv2.warpPerspective(
                picture, lens.K @ M[:3, [0, 1, 3]] @ to_board, (640, 480), borderValue=(160,) * 3
            )
            cv2.imwrite(str(folder / "photos" / f"{side}{number}.png"), photo)
    status, out, err = call(capsys, *FROM, "photos", *changed(PHOTOS, "--board", "8x6"), "--kind", "charuco")
    assert (status, err) == (0, "")
    told = json.loads(out)
    assert told["fixed_views"] == told["zoom_views"] == 8
    assert told["baseline_m"] == pytest.approx(np.linalg.norm(truth.gamma.translation), abs=0.01)
    assert json.loads((folder / "out.json").read_text())["board"]["kind"] == "charuco"


@pytest.fixture(scope="module")
def zooming(tmp_path_factory):
    """A folder of captures of a head that pans and tilts, most at the shortest focal length and some at twice that."""
    directory = tmp_path_factory.mktemp("zooming")
    truth, board, rng, rows = Truth(), BoardConfig(), np.random.default_rng(1), []
    far = zoomed(truth, fourfold(2 * NOMINAL_PX))
    rays = {lens: pixel_rays(lens) for lens in (truth.fixed, truth.zoom, far.zoom)}

    def take(camera, number, T_camera_board, lens, turn=(0.0, 0.0), focal_px=None):
        name = f"{len(rows):02d}.png"
        cv2.imwrite(str(directory / name), np.round(draw(lens, T_camera_board, board, rays[lens])).astype(np.uint8))
        rows.append({"file": name, "camera": camera, "board": number, "pan": turn[0], "tilt": turn[1],
                     "focal_px": focal_px, "t": float(len(rows))})  # fmt: skip

    for number in range(8):
        turned = pose([0.0, 0.0, 0.0], rng.uniform(-25, 25, 3))
        middle = np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(2.8, 4.0)])
        T = turned.as_matrix()
        T[:3, 3] = middle - turned.apply([0.4, 0.25, 0.0])
        take("fixed", number, T, truth.fixed)
        ahead = truth.gamma.apply(middle)
        pan, tilt = math.atan2(ahead[0], ahead[2]), math.atan2(-ahead[1], ahead[2])
        for turn in ((0.0, 0.0), (pan, 0.0), (pan + 0.1, 0.0), (pan, tilt), (pan, tilt - 0.1)):
            take("zoom", number, truth.zoom_fixed(*turn) @ T, truth.zoom, turn, NOMINAL_PX)
        if number < 4:
            take("zoom", number, far.zoom_fixed(pan, 0.0) @ T, far.zoom, (pan, 0.0), 2 * NOMINAL_PX)
    write_index(directory, rows)
    return directory, rows


@pytest.mark.slow
def test_who_insists_is_heard_at_every_focal_length(folder, capsys, zooming):
    """With pan alone the first fit, of the shortest focal length, is refused already."""
    directory, rows = zooming
    (folder / "out.json").unlink()
    write_index(directory, [row for row in rows if row["tilt"] == 0])
    status, out, err = call(capsys, *FROM, directory)
    assert (status, out) == (1, "")
    assert "only pan moved" in err
    status, out, err = call(capsys, *FROM, directory, "--insist")
    assert (status, err) == (0, "")
    assert len(json.loads((folder / "out.json").read_text())["zoom"]["stops"]) == 2


@pytest.mark.slow
def test_the_sequential_method_leaves_other_focal_lengths_alone(folder, capsys, zooming, monkeypatch):
    def never(*_):
        raise AssertionError("the joint method was asked")

    monkeypatch.setattr("cotarget.calibration.calibrate.joint", never)
    directory, rows = zooming
    (folder / "out.json").unlink()
    write_index(directory, rows)
    status, out, err = call(capsys, *FROM, directory, "--method", "sequential")
    assert status == 0, err
    assert json.loads(out)["rejected"] == 4
    assert f"not used: 4 of {len(rows)} images" in err
    far = [row["file"] for row in rows if row["focal_px"] == 2 * NOMINAL_PX]
    told = json.loads((folder / "out.json").read_text())["residuals"]["rejected"]
    assert told == [
        {"name": name, "reason": "taken at 1334 px, not at the shortest focal length, 667 px"} for name in far
    ]


@pytest.mark.render
def test_follow_writes_a_table_and_a_film(folder, capsys):
    status, out, err = call(capsys, *FOLLOW, "--seconds", "0.3")
    assert (status, err) == (0, "")
    told = json.loads(out)
    lines = (folder / "out.csv").read_text().splitlines()
    assert told["steps"] == len(lines) - 1 == sum(told["states"].values())
    assert told["steps"] >= 6
    capture = cv2.VideoCapture(str(folder / "out.mp4"))
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == told["steps"]
    capture.release()


def test_detect_writes_a_table(folder, capsys):
    """A white square flies over a grey sky."""
    writer = cv2.VideoWriter(str(folder / "sky.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (320, 240))
    for index in range(60):
        image = np.full((240, 320, 3), 90, np.uint8)
        if index > 25:
            cv2.rectangle(image, (4 * index - 60, 100), (4 * index - 48, 112), (250, 250, 250), -1)
        writer.write(image)
    writer.release()
    (folder / "out.mp4").unlink()
    status, out, err = call(capsys, *DETECT, "sky.avi")
    assert (status, err) == (0, "")
    told = json.loads(out)
    assert (told["frames"], told["tracks"]) == (60, 1)
    assert told["frames_with_target"] > 20
    assert (folder / "out.csv").read_text().startswith("frame,t,track,u_px,v_px,width_px,height_px,score\n")


def test_ctrl_c_is_no_traceback(folder, capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("cotarget.calibration.load_calibration", interrupted)
    status, out, err = call(capsys, *AIM, "--depth", "5")
    assert (status, out, err) == (130, "", "cotarget aim: interrupted\n")


def test_help_and_version(capsys):
    for command in ("demo", "calibrate", "aim", "follow", "detect", "doctor"):
        status, out, err = call(capsys, command, "--help")
        assert (status, err) == (0, "")
        assert out.startswith(f"usage: cotarget {command}")
    assert call(capsys, "--version")[:2] == (0, f"cotarget {cotarget.__version__}\n")
