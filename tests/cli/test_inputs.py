"""Outputs that would replace an input are refused in one line."""

import os
import tempfile

import cv2
import pytest

from cotarget.backends import OPENERS
from cotarget.config import RigConfig
from tests.support.commands import OLD, bird_film, board_photo, call, capture, refused, true_calibration, write_index
from tests.support.recorded_run import calibration_file, record, toy_rig

RIG = """
backend = "{backend}"
recording = "run"
[sim]
scene = "hall.xml"
targets = ["bird"]
[safety]
stop_file = "stop"
[targets.book]
template = "cover.png"
"""
INPUTS = ("rig.toml", "rig_calibration.json", "hall.xml", "stop", "cover.png", "film.mp4", "labels.csv", "link")
RECORDING = ("run/log.jsonl", "run/meta.json", "run/fixed/000000.png", "run/fixed/whatever.csv", "run/new.csv")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with everything that commands read."""
    folder = tmp_path_factory.mktemp("made")
    record(folder / "run", calibration_file(folder), seconds=0.2)
    (folder / "rig.toml").write_text(RIG.format(backend="sim"))
    (folder / "replay.toml").write_text(RIG.format(backend="replay"))
    (folder / "regions.toml").write_text("ignored = [[[0, 0], [1, 0], [1, 1]]]\n")
    (folder / "hall.xml").write_text("<mujoco/>")
    (folder / "cover.png").write_bytes(b"a cover")
    (folder / "labels.csv").write_text("frame,x_px,y_px,width_px,height_px\n")
    bird_film(folder / "film.mp4", 5)
    (folder / "films").mkdir()
    bird_film(folder / "films" / "film.mp4", 5)
    (folder / "films" / "film.csv").write_text("frame,x_px,y_px,width_px,height_px\n3,20,20,9,9\n")
    (folder / "link").symlink_to("rig.toml")
    (folder / "way").symlink_to("run")
    (folder / "captures").mkdir()
    (folder / "captures" / "a.png").write_bytes(b"a photo")
    write_index(folder / "captures", [capture("a.png")])
    true_calibration(RigConfig()).save(folder / "captures" / "calibration.json")
    return folder


@pytest.fixture
def folder(made, monkeypatch):
    """The working folder, in which the test must change nothing."""
    monkeypatch.chdir(made)
    monkeypatch.setitem(OPENERS, "sim", lambda *_: toy_rig())
    before = contents(made)
    yield made
    assert contents(made) == before


def contents(folder):
    return {path: path.readlink() if path.is_symlink() else path.is_file() and path.read_bytes()
            for path in folder.rglob("*")}  # fmt: skip


FOLLOW = ("follow", "--rig", "rig.toml", "--calibration", "rig_calibration.json", "--target", "bird", "--seconds", "1")
REPLAYED = ("follow", "--rig", "replay.toml", *FOLLOW[3:])
DETECT = ("detect", "film.mp4", "--rig", "rig.toml", "--target", "bird", "--labels", "labels.csv", "--csv")
IN_FOLDER = ("detect", "films", *DETECT[2:6], "--labels", "films", "--csv", "captures", "--sheet")
CALIBRATE = ("calibrate", "--rig", "rig.toml")
REFUSED = [
    *(((*FOLLOW, option), name) for option in ("--csv", "--video") for name in INPUTS if name not in DETECT),
    *(((*FOLLOW, "--record", "new", option), "new") for option in ("--csv", "--video")),
    *(((*REPLAYED, option), name) for option in ("--csv", "--video", "--record") for name in RECORDING),
    *(
        (("replay", "run", option), name)
        for option in ("--csv", "--video", "--html")
        for name in (*RECORDING, "way/log.jsonl")
    ),
    (("replay", "run", "--labels", "labels.csv", "--csv"), "labels.csv"),
    *((DETECT, name) for name in INPUTS if name != "rig_calibration.json"),
    *(((*DETECT, "new.csv", "--video"), name) for name in INPUTS if name != "rig_calibration.json"),
    (("detect", "film.mp4", "--ignore", "regions.toml", "--target", "bird", "--csv"), "regions.toml"),
    *((IN_FOLDER, name) for name in ("rig.toml", "hall.xml", "cover.png", "films/film.mp4", "films/film.csv")),
    *(((*CALIBRATE, "--out"), name) for name in ("rig.toml", "hall.xml", "stop", "cover.png", "link")),
    (("calibrate", "--rig", "replay.toml", "--out"), "run/log.jsonl"),
    (("calibrate", "--rig", "replay.toml", "--captures"), "run/captures"),
    ((*CALIBRATE, "--captures", "captures", "--out"), "captures/index.json"),
    (("calibrate", "--from", "captures", "--out"), "captures/index.json"),
    (("calibrate", "--from", "captures", "--out"), "captures/a.png"),
    (("report", "rig_calibration.json", "--out"), "rig_calibration.json"),
    (("emulate", "--rig", "rig.toml", "--write"), "hall.xml"),
    (("point", "--rig", "replay.toml", "--pictures"), "run"),
]


@pytest.mark.parametrize(("command", "name"), REFUSED, ids=lambda value: value if isinstance(value, str) else value[-1])
def test_output_that_is_an_input_is_refused(folder, capsys, command, name):
    line = refused(capsys, *command, name)
    assert line.startswith(f"cotarget {command[0]}: {name}")
    assert "is read or written" in line


@pytest.mark.parametrize("name", ["pipe", "/dev/null", "run"])
def test_output_that_is_no_file_is_refused(folder, capsys, name):
    if name == "pipe":
        os.mkfifo(folder / "pipe")
    try:
        for command in ((*FOLLOW, "--csv"), (*FOLLOW, "--video"), DETECT, ("board", "--out")):
            assert refused(capsys, *command, name).startswith(f"cotarget {command[0]}: {name}: ")
        assert name != "pipe" or (folder / "pipe").is_fifo()
    finally:
        (folder / "pipe").unlink(missing_ok=True)


@pytest.mark.parametrize("name", ["calibration.json", "calib", "left.txt"])
def test_calibration_may_be_written_beside_its_photos(folder, capsys, tmp_path, name):
    """The earlier calibration is no obstacle; the command fails because there are too few photos."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for photo in ("left1.png", "right1.png"):
        cv2.imwrite(str(photos / photo), board_photo())
    (photos / name).write_text(OLD)
    status, _, err = call(
        capsys, "calibrate", "--from", photos, "--fixed", "left*.png", "--zoom", "right*.png", "--board", "9x6",
        "--square", "0.1", "--out", photos / name,
    )  # fmt: skip
    assert status == 1
    assert "at least 3" in err


@pytest.mark.parametrize("name", ["left1.png", "calib"])
def test_calibration_never_replaces_a_captured_image(folder, capsys, tmp_path, name):
    """A folder of captures has the images that its index lists."""
    cv2.imwrite(str(tmp_path / "left1.png"), board_photo())
    write_index(tmp_path, [capture("left1.png")])
    (tmp_path / "calib").write_text(OLD)
    said = refused(capsys, "calibrate", "--from", tmp_path, "--out", tmp_path / name)
    assert ("is read or written" in said) == (name == "left1.png")
    assert (tmp_path / "calib").read_text() == OLD


def test_unwritable_calibration_is_refused_before_the_session(folder, capsys, tmp_path, monkeypatch):
    monkeypatch.setitem(OPENERS, "sim", lambda *_: pytest.fail("opened"))
    out = tmp_path / "c.json"

    def refuse(dir):
        raise PermissionError

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    assert str(out) in refused(capsys, *CALIBRATE, "--out", out)
