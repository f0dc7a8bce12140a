"""Earlier results that commands keep, progress on stderr, and numbers in JSON."""

import json
import math
import os
import pty
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from cotarget.backends import OPENERS, describe
from cotarget.calibration.model import Residuals
from cotarget.cli.common import previous_kept
from cotarget.config import RigConfig
from cotarget.errors import CalibrationError, DeviceError
from cotarget.files import write_atomically
from cotarget.parallel import progress_bar
from cotarget.rig import Frame, PanTiltState, ZoomState
from tests.support.commands import OLD, call, refused, true_calibration
from tests.support.rigs import rig_of
from tests.support.safety_rigs import SimulatedDevices


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a rig."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text("[sim]\n")
    return tmp_path


def names(folder):
    return sorted(path.name for path in folder.iterdir() if path.name != "rig.toml")


@pytest.mark.parametrize("linked", [False, True])
def test_previous_results_are_kept_beside_the_new_one(folder, capsys, linked):
    """Of a link, the target is kept."""
    path = goal = folder / "c.json"
    if linked:
        path = folder / "link.json"
        path.symlink_to(goal)
    for text in ("first", "second", "third"):
        with previous_kept(path):
            write_atomically(path, text.encode())
    kept = {"c.json": "third", "c.previous-1.json": "first", "c.previous-2.json": "second"}
    assert {name: (folder / name).read_text() for name in names(folder) if name != "link.json"} == kept
    assert path.is_symlink() == linked
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[-1] for line in lines] == [str(folder / name) for name in kept if name != "c.json"]


def test_failed_result_leaves_no_second_name(folder, capsys):
    path = folder / "c.json"
    path.write_text(OLD)
    with pytest.raises(CalibrationError), previous_kept(path):
        raise CalibrationError("the disk is full")
    assert names(folder) == ["c.json"]
    assert path.read_text() == OLD
    assert capsys.readouterr().err == ""


class Session:
    """A capture session that takes an image and then may fail."""

    def __init__(self, error=None):
        self.error = error

    def __call__(self, rig, *, captures_dir, **_):
        if captures_dir is not None:
            captures_dir.mkdir(exist_ok=True)
            (captures_dir / "index.json").write_text("{}")
        if self.error is not None:
            raise self.error
        return replace(true_calibration(RigConfig()), residuals=Residuals(0.1, 0.1, 0.1, 0.1, 1, 1, 1, 0))


@pytest.fixture
def sessions(folder, monkeypatch):
    """Let `calibrate --rig` open a rig without a world, with a replaced session."""
    rig = SimulatedDevices()
    rig.zoom.still_size, rig.zoom.focal_range = rig.zoom.size, describe(RigConfig()).zoom.focal_range  # 12 x zoom
    monkeypatch.setitem(OPENERS, "sim", lambda config, *_: rig_of(rig, config=config))
    monkeypatch.setattr("cotarget.cli.calibrate.calibration_summary", lambda found, path: {"verdict": -0.0})
    return lambda error=None: monkeypatch.setattr("cotarget.calibration.calibrate.calibrate", Session(error))


CALIBRATE = ("calibrate", "--rig", "rig.toml", "--captures", "kept")


@pytest.mark.parametrize(("error", "status"), [
    (DeviceError("the camera is gone"), 1), (CalibrationError("the motions leave T open"), 1),
    (KeyboardInterrupt(), 130), (SystemExit(143), 143),
])  # fmt: skip
def test_interrupted_session_names_the_command_that_continues(capsys, sessions, error, status):
    sessions(error)
    ended, out, err = call(capsys, *CALIBRATE)
    assert (ended, out) == (status, "")
    assert "cotarget calibrate --from kept" in err.splitlines()[0]
    assert str(error) in err or status == 143


def test_refused_session_does_not_offer_earlier_captures(folder, capsys, sessions):
    (folder / "kept").mkdir()
    (folder / "kept" / "index.json").write_text("{}")
    sessions(CalibrationError("kept: already holds captures; give another folder"))
    assert "--from" not in refused(capsys, *CALIBRATE)


@pytest.mark.parametrize(("stops", "taken"), [(None, 8), (1, 1), (2, 4), (3, 4), (4, 4), (9, 9)])
def test_zoom_samples_too_far_apart_get_others_between_them(capsys, caplog, monkeypatch, sessions, stops, taken):
    """Neighbours differ by a factor of at most 2.5: from 1 to 12, three steps by 2.29."""
    asked = {}

    def session(*_, **given):
        asked.update(given)
        raise CalibrationError("enough")

    monkeypatch.setattr("cotarget.calibration.calibrate.capture_session", session)
    call(capsys, "calibrate", "--rig", "rig.toml", *([] if stops is None else ["--stops", stops]))
    assert asked["stops"] == taken
    assert [message.partition(":")[0] for message in caplog.messages] == ["stops"] * (stops in (2, 3))


@pytest.mark.parametrize("options", [["--placements", "1"], ["--placements", "6", "--stops", "1"]])
@pytest.mark.usefixtures("sessions")
def test_too_few_placements_are_refused(capsys, options):
    assert "placements: " in refused(capsys, "calibrate", "--rig", "rig.toml", *options)


def test_earlier_calibration_is_kept_and_a_terminal_gets_the_verdict(folder, capsys, sessions, monkeypatch):
    sessions()
    (folder / "calibration.json").write_text(OLD)
    status, out, err = call(capsys, "calibrate", "--rig", "rig.toml")
    assert (status, json.loads(out)) == (0, {"verdict": 0.0})
    assert err.rstrip().endswith("calibration.previous-1.json")
    assert (folder / "calibration.previous-1.json").read_text() == OLD
    assert "schema" in json.loads((folder / "calibration.json").read_text())
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    assert call(capsys, "calibrate", "--rig", "rig.toml")[1] == "calibration.json: -0.0\n"


def test_progress_without_a_terminal_is_an_occasional_line(capsys):
    time = iter([0.0, 29.0, 31.0, 45.0, 62.0])
    with progress_bar(now=lambda: next(time)) as progress:
        for done in range(4):
            progress(done, 8, f"board {done}")
    assert capsys.readouterr().err.splitlines() == ["board 1 (12 %, 31 s)", "board 3 (38 %, 62 s)"]


SHOWING = """
import logging
from cotarget.cli.main import StderrHandler
from cotarget.parallel import progress_bar
logging.basicConfig(format="%(message)s", handlers=[StderrHandler()])
with progress_bar() as progress:
    progress(1, 8, "board [1]")
    print("a result")
    logging.warning("a remark")
    progress(9, 8, "board [8]")
"""


def test_progress_on_a_terminal_is_a_bar_beside_the_results():
    ours, terminal = pty.openpty()
    made = subprocess.run([sys.executable, "-c", SHOWING], stdout=subprocess.PIPE, stderr=terminal, check=True)
    os.close(terminal)
    shown = b"".join(iter(lambda: _read(ours), b"")).decode()
    os.close(ours)
    assert made.stdout == b"a result\n"
    assert "board [8]" in shown
    assert "100%" in shown
    assert "\x1b[2Ka remark\r\n" in shown  # on a separate line
    assert shown.endswith("\x1b[2K")  # the line is cleared


def _read(terminal):
    try:
        return os.read(terminal, 1 << 16)
    except OSError:  # nothing is left, and the other side is closed
        return b""


AIM = "aim --calibration good.json --pixel 320 240 --depth 9"
WANTED = "give a calibration.json, as cotarget calibrate writes it"
ASCII = "LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0"


@pytest.mark.parametrize(("before", "line", "status", "out", "err"), [
    ("", f"{AIM} >&-", 0, "", ""),
    ("", f"{AIM} >/dev/full", 1, "", "cotarget aim: No space left on device\n"),
    ("", f"{AIM.replace('9', '0.01')} 2>&-", 0, '"depth_plausible": false', ""),  # its warning is not printed
    ("", "dance 2>/dev/full", 2, "", ""),
    ("", "stop --rig \xfc.toml >&-", 0, "", "stop now\n"),
    ("", "stop --rig \xfc.toml --reason V\udcf6gel 2>&-", 0, "stopped: ", ""),  # no UTF-8
    (ASCII, f"{AIM} --rig \xfc.toml", 1, "", "toml: sim.seed: '\\xf6' should be a valid integer\n"),
    ("", AIM.replace("good", "fr\udcfch"), 1, "", f"cotarget aim: fr\\udcfch.json: no such file; {WANTED}\n"),
])  # fmt: skip
def test_streams_that_are_closed_full_or_of_another_locale(folder, before, line, status, out, err):
    """One line says so, the exit status is not Python's own, and a stop is written whatever stdout is."""
    true_calibration(RigConfig()).save(folder / "good.json")
    (folder / "\xfc.toml").write_text('[safety]\nstop_file = "stop"\n[sim]\nseed = "\\u00f6"\n')
    shell = os.fsencode(f"{before} {sys.executable} -m cotarget {line}")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run(["sh", "-c", shell], capture_output=True, check=False, env=environment)
    assert done.returncode == status
    assert os.fsdecode(done.stderr).endswith(err)
    assert bool(done.stderr) == bool(err)
    assert out in os.fsdecode(done.stdout)
    assert bool(done.stdout) == bool(out)
    if out.startswith('"'):
        assert json.loads(done.stdout)
    assert (folder / "stop").exists() == line.startswith("stop")


@pytest.fixture
def pointed(folder, monkeypatch):
    """A rig for `point`, with pictures and a lens of 6 to 72 mm."""
    rig = SimulatedDevices()
    image = np.zeros((2, 2, 3), np.uint8)
    range_px = describe(RigConfig()).zoom.focal_range
    rig.zoom = SimpleNamespace(
        size=(2, 2),
        focal_range=range_px,
        state=lambda: ZoomState(range_px[0], moving=False, t=rig.clock.now()),
        capture=lambda: Frame(image, rig.clock.now()),
        zoom=lambda focal: rig.head.log.append(("zoom", focal)),
    )
    monkeypatch.setitem(OPENERS, "sim", lambda *_: rig_of(rig))
    return rig


@pytest.mark.parametrize(("wanted", "named", "limits"), [
    (["--pan-deg", "200"], "--pan-deg: 200", "-158.9 to 158.9"),
    (["--pan-deg", "-159"], "--pan-deg: -159", "-158.9 to 158.9"),
    (["--tilt-deg", "-80"], "--tilt-deg: -80", "-46.6 to 31.1"),
    (["--pan-deg", "5", "--tilt-deg", "85", "--focal-mm", "9"], "--tilt-deg: 85", "-46.6 to 31.1"),
    (["--pan-deg", "5", "--focal-mm", "100"], "--focal-mm: 100", "6 to 72"),
])  # fmt: skip
def test_point_beyond_the_limits_moves_nothing(pointed, capsys, wanted, named, limits):
    said = refused(capsys, "point", "--rig", "rig.toml", *wanted)
    assert said.startswith(f"cotarget point: {named}")
    assert limits in said
    assert not [what for what, _ in pointed.head.log if what != "halt"]


def test_point_keeps_the_soft_limits(pointed, capsys, folder):
    (folder / "rig.toml").write_text("[safety]\npan_deg = [-90, 90]\n")
    assert "-90 to 90" in refused(capsys, "point", "--rig", "rig.toml", "--pan-deg", "91")
    status, out, _ = call(capsys, "point", "--rig", "rig.toml", "--pan-deg", "90.04")  # limits are printed rounded
    assert status == 0
    assert json.loads(out)["pan_deg"] == pytest.approx(90, abs=math.degrees(pointed.head.limits.pan.step))


@pytest.mark.parametrize(("wanted", "moved"), [
    ([], None),  # as for its pictures alone
    (["--focal-mm", "9"], None),
    (["--tilt-deg", "5"], None),  # pan would be clipped to the limits
    (["--pan-deg", "10"], [10, 0]),
])  # fmt: skip
def test_point_moves_no_axis_that_is_not_asked_for(pointed, capsys, folder, wanted, moved):
    """The head stands at 100 degrees, as before the limits were narrowed."""
    pointed.head.move(math.radians(100), 0.0, wait=True)
    pointed.head.log.clear()
    (folder / "rig.toml").write_text("[safety]\npan_deg = [-45, 45]\n")
    step = math.degrees(pointed.head.limits.pan.step)
    if wanted[:1] == ["--tilt-deg"]:
        assert "cotarget point --rig RIG --pan-deg" in refused(capsys, "point", "--rig", "rig.toml", *wanted)
    else:
        said = json.loads(call(capsys, "point", "--rig", "rig.toml", *wanted)[1])
        assert [said["pan_deg"], said["tilt_deg"]] == pytest.approx(moved or [100, 0], abs=step)
    assert bool([what for what, _ in pointed.head.log if what == "move"]) == (moved is not None)


def test_where_says_where_a_stopped_head_stands_and_moves_nothing(pointed, capsys, folder):
    pointed.head.move(math.radians(30), 0.0, wait=True)
    pointed.head.log.clear()
    (folder / "rig.toml").write_text('[safety]\nstop_file = "stop"\n')
    (folder / "stop").write_text("smoke")
    status, out, err = call(capsys, "where")
    said = json.loads(out)
    assert (status, err, said["moving"]) == (0, "", False)
    assert [said["pan_deg"], said["tilt_deg"]] == pytest.approx([30, 0], abs=math.degrees(pointed.head.limits.pan.step))
    assert "move" not in [what for what, _ in pointed.head.log]


def test_point_fails_where_the_head_did_not_arrive(pointed, capsys):
    """Its driver returns from a move that it waited for, and the head stands elsewhere."""
    pointed.head.state = lambda: PanTiltState(0.1, 0.0, moving=False, t=pointed.clock.now())
    assert "does not stand where it was sent" in refused(capsys, "point", "--rig", "rig.toml", "--pan-deg", "-30")


def test_point_keeps_earlier_pictures(pointed, capsys, folder):
    point = ("point", "--rig", "rig.toml", "--pan-deg", "0", "--pictures", ".")
    status, out, err = call(capsys, *point)
    assert (status, err) == (0, "")
    assert "-0.0" not in out
    first = (folder / "zoom.png").read_bytes()
    assert cv2.imdecode(np.frombuffer(first, np.uint8), cv2.IMREAD_COLOR).shape == (2, 2, 3)
    status, _, err = call(capsys, *point)
    assert status == 0
    assert [line.partition(":")[0] for line in err.splitlines()] == ["fixed.png", "zoom.png"]
    assert names(folder) == ["fixed.png", "fixed.previous-1.png", "zoom.png", "zoom.previous-1.png"]
    assert (folder / "zoom.previous-1.png").read_bytes() == first
