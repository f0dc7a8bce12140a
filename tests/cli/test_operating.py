"""What an operator does with a rig, and how it can be told wrong: one line, and the head is left alone."""

import io
import json
import os
import socket
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

from cotarget import cli, doctor
from cotarget.backends import OPENERS
from cotarget.calibration import save_calibration
from cotarget.config import BoardConfig, RigConfig, parse_config
from cotarget.doctor import Finding
from cotarget.drivers import ptu_d46
from cotarget.emulators.emulation import copied_tables
from cotarget.errors import EmergencyStopError
from cotarget.latency import Delay, HeadLatency
from cotarget.safety.stop_file import refuse_if_stopped
from tests.cli.test_commands import call, true_calibration
from tests.support.rigs import rig_of
from tests.support.safety_rigs import SimulatedDevices

NOBODY = "/dev/nobody-is-here"
HARDWARE = f"""
backend = "hardware"
[hardware.head]
port = "{NOBODY}"
[hardware.fixed]
url = "http://127.0.0.1:9"
[hardware.zoom]
port = "usb:"
"""
STOP_FILE = '\n[safety]\nstop_file = "run/stop"\n'


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with rigs of every kind, none of which is there."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("COTARGET_PASSWORD", raising=False)
    monkeypatch.setenv("LP_NUM_THREADS", "1")  # emulate sets it, and how long threads take turns, for its process
    turns = sys.getswitchinterval()
    (tmp_path / "sim.toml").write_text("[sim]\n")
    (tmp_path / "stops.toml").write_text("[sim]\n" + STOP_FILE)
    (tmp_path / "hw.toml").write_text(HARDWARE + STOP_FILE)
    (tmp_path / "nameless.toml").write_text('backend = "hardware"\n')
    (tmp_path / "replayed.toml").write_text('backend = "replay"\nrecording = "empty"\n')
    (tmp_path / "empty").mkdir()
    (tmp_path / "run").mkdir()
    (tmp_path / "file").write_text("no recording")
    save_calibration(tmp_path / "good.json", true_calibration(RigConfig()))
    save_calibration(tmp_path / "headless.json", true_calibration(RigConfig(), with_head=False))
    save_calibration(tmp_path / "wide.json", true_calibration(RigConfig(), zoom_size=(640, 360)))
    yield tmp_path
    sys.setswitchinterval(turns)


LATENCY = ("latency", "--rig", "hw.toml")
EMULATE = ("emulate", "--write", "new.toml")
MISTAKES = {
    # latency: refused before any device is opened
    "latency without a rig": (["latency", "--rig", "none.toml"], ["none.toml: no such file"]),
    "latency of no devices": (["latency", "--rig", "nameless.toml"], ["hardware.head.port: is missing", "/dev/tty"]),
    "latency of a recording": (["latency", "--rig", "replayed.toml"], ["replayed.toml: backend is 'replay'"]),
    "latency without a calibration": ([*LATENCY, "--calibration", "none.json"], ["none.json: no such file"]),
    "latency without T": (["latency", "--rig", "sim.toml", "--calibration", "headless.json"], ["T_head_zoom"]),
    "latency of other cameras": ([*LATENCY, "--calibration", "wide.json"], ["aspect ratio"]),
    "latency with nobody at the server": (["latency", "--rig", "hw.toml"], ["http://127.0.0.1:9", "cannot be reached"]),
    # replay
    "no recording": (["replay", "none"], ["none: no such folder; give the folder of a recording"]),
    "a file as recording": (["replay", "file"], ["file: is a file; give the folder of a recording"]),
    "an empty folder": (["replay", "empty"], ["empty: is no recording"]),
    # emulate
    "an emulated real rig": ([*EMULATE, "--rig", "hw.toml"], ["hw.toml: backend is 'hardware'", "a simulated rig"]),
    "a user without a password": ([*EMULATE, "--user", "root"], ["--user needs a password", "COTARGET_PASSWORD"]),
    "a fault of no device": ([*EMULATE, "--fault", "silence"], ["unknown fault 'silence'", "fixed., head., zoom."]),
    "an unknown fault": ([*EMULATE, "--fault", "head.rust"], ["unknown fault 'head.rust'", "garbage", "silence"]),
    "a port beyond the last": ([*EMULATE, "--head", "65536"], ["--head", "'65536' is not a port"]),
    "an emulation for no time": ([*EMULATE, "--seconds", "0"], ["--seconds", "greater than zero"]),
    "a rig over its own": (["emulate", "--rig", "sim.toml", "--write", "sim.toml"], ["sim.toml: is read or written"]),
    "a rig over a folder": (["emulate", "--write", "empty"], ["empty: is a folder"]),
    "a rig in no folder": (["emulate", "--write", "none/new.toml"], ["none/new.toml: its folder does not exist"]),
    "no rig to write": (["emulate"], ["--write"]),
    # stop, clear, reset-head
    "no stop file": (["stop", "--rig", "sim.toml"], ["sim.toml: has no stop file", "[safety] stop_file ="]),
    "nothing to clear": (["clear", "--rig", "sim.toml"], ["sim.toml: has no stop file", "[safety] stop_file ="]),
    "stop what": (["stop"], ["--rig"]),
    "reset a simulated head": (["reset-head", "--rig", "sim.toml", "--yes"], ["sim.toml: names no pan-tilt unit"]),
    "reset no head": (["reset-head", "--rig", "nameless.toml", "--yes"], ["nameless.toml: names no pan-tilt unit"]),
    "reset nobody": (["reset-head", "--rig", "hw.toml", "--yes"], [f"there is no port {NOBODY}"]),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_ends_in_one_line_that_names_it(folder, capsys, mistake):
    arguments, parts = MISTAKES[mistake]
    before = sorted(folder.rglob("*"))
    status, out, err = call(capsys, *arguments)
    assert status not in (0, None)
    assert out == ""
    assert err.startswith("cotarget")
    assert len(err.splitlines()) == 1, err
    for part in parts:
        assert part in err
    assert sorted(folder.rglob("*")) == before


@pytest.mark.wire
@pytest.mark.render
def test_a_port_that_is_taken_is_told(folder, capsys):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        status, out, err = call(capsys, *EMULATE, "--control", port, "--seconds", "1")
    assert (status, out, err) == (
        1,
        "",
        f"cotarget emulate: cannot listen at 127.0.0.1:{port}: Address already in use\n",
    )
    assert not (folder / "new.toml").exists()


def test_a_stop_lasts_until_it_is_cleared(folder, capsys):
    """By the file of any rig.toml that names it."""
    path = folder / "run" / "stop"
    assert call(capsys, "clear", "--rig", "stops.toml") == (0, f"{Path('run/stop')}: there was no stop\n", "")
    status, out, err = call(capsys, "stop", "--rig", "stops.toml", "--reason", "a bird in the gears")
    assert (status, out, err) == (0, "stopped: no head that watches run/stop moves until cotarget clear\n", "")
    assert path.read_text() == "a bird in the gears\n"
    with pytest.raises(EmergencyStopError, match="a bird in the gears"):
        refuse_if_stopped(path)
    status, out, err = call(capsys, "reset-head", "--rig", "hw.toml", "--yes")
    assert (status, out) == (1, "")
    assert err.startswith("cotarget reset-head: emergency stop: a bird in the gears")
    assert call(capsys, "clear", "--rig", "hw.toml") == (0, "cleared: a bird in the gears\n", "")
    assert not path.exists()
    refuse_if_stopped(path)


FOLLOW = ("follow", "--calibration", "good.json", "--target", "book", "--rig", "hw.toml")


@pytest.mark.parametrize("command", [FOLLOW, ("calibrate", "--rig", "hw.toml"), ("point", "--rig", "hw.toml"), LATENCY])
def test_a_stopped_rig_is_not_even_opened(folder, capsys, command):
    """Its devices are not there, of which nothing is said."""
    assert call(capsys, "stop", "--rig", "hw.toml")[0] == 0
    status, out, err = call(capsys, *command)
    assert (status, out) == (1, "")
    assert err == (
        f"cotarget {command[0]}: emergency stop: stopped by the operator; when it is safe to move, run 'cotarget clear "
        "--rig FILE' or remove run/stop\n"
    )
    call(capsys, "clear", "--rig", "hw.toml")
    assert "emergency stop" not in call(capsys, *command)[2]


BROKEN = {
    "an unknown key": "[hardware.head]\nbuad = 9600\n",
    "an impossible value": "[hardware.head]\nbaud = 9601\n[board]\nsquare = -1\n",
    "an unknown table": "[hardwear]\n",
    "another mistake beside it": "",
    "no TOML at all": "[sim\nscene = indoor\n",
    "no TOML after a mark of byte order": "\ufeff[sim\n",
}


@pytest.mark.parametrize("mistake", BROKEN)
def test_a_rig_is_stopped_whatever_else_is_wrong_with_its_file(folder, capsys, mistake):
    more = "" if BROKEN[mistake] else "watchdog_s = 0\npan_deg = 5\n"
    (folder / "broken.toml").write_text(BROKEN[mistake] + STOP_FILE + more)
    assert call(capsys, "point", "--rig", "broken.toml")[0] == 1
    assert call(capsys, "stop", "--rig", "broken.toml")[0] == 0
    assert (folder / "run" / "stop").exists()
    assert call(capsys, "clear", "--rig", "broken.toml")[0] == 0


@pytest.mark.parametrize(
    "named", ['safety.stop_file = "run/stop"', 'safety = { watchdog_s = 1, stop_file = "run/stop" }']
)
def test_a_stop_file_is_found_however_toml_has_it_and_where_it_is_toml_no_more(folder, capsys, named):
    for mark, rest in (("", ""), ("\ufeff", ""), ("", "[sim\n# stop_file = 'another'\n")):
        (folder / "broken.toml").write_text(f"{mark}{named}\n{rest}")
        assert call(capsys, "stop", "--rig", "broken.toml")[0] == 0
        assert (folder / "run" / "stop").exists()
        assert call(capsys, "clear", "--rig", "broken.toml")[0] == 0


def test_a_file_that_names_no_stop_file_any_more_is_told(folder, capsys):
    (folder / "broken.toml").write_text('[safety]\nstop_file = "run/stop\n')
    status, out, err = call(capsys, "stop", "--rig", "broken.toml")
    assert (status, out) == (1, "")
    assert err.startswith("cotarget stop: broken.toml: is not TOML: ")
    assert err.endswith("the rig's stop file itself can be made and removed by hand\n")
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(("delay", "configured"), [(0.02, 0.08), (-0.06, 0.0), (-0.065, 0.0), (-0.2, None)])
def test_a_latency_that_cannot_be_is_refused(folder, capsys, monkeypatch, delay, configured):
    """Frames of the default simulation are dated by 60 ms; less than zero by what is measured inaccurately is zero."""
    found = HeadLatency(Delay(delay, 0.99), command=0.04, frames=100)
    monkeypatch.setattr("cotarget.latency.measure_head", lambda rig: found)
    monkeypatch.setitem(OPENERS, "sim", lambda config: rig_of(SimulatedDevices()))
    status, out, err = call(capsys, "latency", "--rig", "sim.toml")
    if configured is None:
        assert (status, out) == (1, "")
        assert err.splitlines()[-1].startswith("cotarget latency: sim.zoom.latency_s: -140 ms was measured, which is")
    else:
        assert status == 0
        assert json.loads(out)["measured"] == {"sim.zoom.latency_s": configured, "sim.head.command_delay_s": 0.04}


def test_every_fault_is_told_of(capsys):
    with pytest.raises(SystemExit):
        cli.main(["emulate", "--help"])
    said = capsys.readouterr().out.split()
    for fault in ("head.silence", "head.limit-hit", "fixed.stall", "zoom.gone"):
        assert any(word.strip(",") == fault for word in said)


def test_a_stop_that_cannot_be_made_is_shouted(folder, capsys):
    """And nothing is opened that could not be stopped."""
    (folder / "run").rmdir()
    wrong = "there is no folder run; make it, or correct stop_file in [safety] of rig.toml\n"
    assert call(capsys, "stop", "--rig", "stops.toml") == (1, "", f"cotarget stop: run/stop: NOT stopped: {wrong}")
    told = f"cotarget point: run/stop: nobody could stop the head by this file: {wrong}"
    assert call(capsys, "point", "--rig", "stops.toml") == (1, "", told)
    assert not (folder / "run").exists()


def test_a_stop_without_a_reason_has_one(folder, capsys):
    call(capsys, "stop", "--rig", "stops.toml")
    assert call(capsys, "clear", "--rig", "stops.toml")[1] == "cleared: stopped by the operator\n"


@pytest.fixture
def resets(monkeypatch):
    """Resets that were asked for, none of which is done."""
    axis = SimpleNamespace(lowest=-3090, highest=3090)
    asked = []

    def reset(config, clock, lost, stopped):
        assert stopped() is None
        asked.append(config.port)
        return SimpleNamespace(version="v2.12.1d1", pan=axis, tilt=axis)

    monkeypatch.setattr(ptu_d46, "reset", reset)
    return asked


@pytest.mark.parametrize("answer", ["yes\n", "YES", "--yes"])
def test_the_head_is_reset_by_consent(folder, capsys, monkeypatch, resets, answer):
    monkeypatch.setattr("sys.stdin", io.StringIO(answer))
    status, out, err = call(capsys, "reset-head", "--rig", "hw.toml", *(["--yes"] if answer == "--yes" else []))
    assert (status, err, resets) == (0, "", [NOBODY])
    assert out.endswith("reset: v2.12.1d1: pan -3090 to 3090, tilt -3090 to 3090 steps\n")
    assert ("camera and cables clear" in out) == (answer != "--yes")


class Gone(io.StringIO):
    """A terminal that was closed."""

    def readline(self, size=-1, /):
        raise OSError(5, "Input/output error")


NO_TEXT = io.TextIOWrapper(io.BytesIO(b"\xff\xfe\n"), encoding="utf-8")


@pytest.mark.parametrize(
    "stdin",
    [io.StringIO(text) for text in ("", "no\n", "y\n", "yes please\n", "\n")] + [Gone(), NO_TEXT, None],
    ids=["end of file", "no", "y", "yes please", "return", "gone", "no text", "closed"],
)
def test_the_head_is_not_reset_without_consent(folder, capsys, monkeypatch, resets, stdin):
    monkeypatch.setattr("sys.stdin", stdin)
    status, _, err = call(capsys, "reset-head", "--rig", "hw.toml")
    assert (status, resets) == (1, [])
    assert err == "cotarget reset-head: not reset; it needs the answer yes, or --yes\n"


def test_the_doctor_tells_which_devices_do_not_answer(folder, capsys, monkeypatch):
    well = Finding("rendering", True, "replaced: it takes a second")
    monkeypatch.setattr(doctor, "_rendering", lambda: well)
    status, out, err = call(capsys, "doctor", "--rig", "hw.toml")
    assert (status, err) == (1, "")
    lines = out.splitlines()
    head, fixed = (next(line for line in lines if f"hardware.{name}:" in line) for name in ("head", "fixed"))
    assert head.startswith(f"MISSING  hardware.head: there is no port {NOBODY} for the pan-tilt unit")
    assert fixed.startswith("MISSING  hardware.fixed: http://127.0.0.1:9 cannot be reached")
    assert lines[lines.index(head) + 1].strip().startswith("fix: look at the device")
    status, out, _ = call(capsys, "doctor", "--rig", "nameless.toml")
    assert status == 1
    assert "MISSING  hardware.head: is not configured\n" in out


def test_the_doctor_tells_how_to_get_a_package_that_a_device_needs(folder, capsys, monkeypatch):
    monkeypatch.setattr(doctor, "_rendering", lambda: Finding("rendering", True, "replaced: it takes a second"))
    monkeypatch.setitem(sys.modules, "httpx", None)
    lines = call(capsys, "doctor", "--rig", "hw.toml")[1].splitlines()
    at = next(i for i, line in enumerate(lines) if "hardware.fixed: devices on HTTP need httpx" in line)
    assert lines[at + 1].strip() == "fix: pip install 'cotarget[hardware]'"


@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("more", ["", "[board]\ncorners = [9, 6]\n"])
@pytest.mark.parametrize("command", [("calibrate", "--rig", "hw.toml", "--out", "new.json")])
def test_real_squares_have_no_size_by_default(folder, capsys, command, more, mark):
    (folder / "hw.toml").write_text(mark + HARDWARE + more)
    status, out, err = call(capsys, *command)
    assert (status, out) == (1, "")
    assert err.startswith("cotarget calibrate: hw.toml: does not say how large the squares of your board are; ")
    assert "[board] square = 0.025" in err
    assert not (folder / "new.json").exists()
    (folder / "hw.toml").write_text(mark + HARDWARE + "[board]\nsquare = 0.025\n")
    assert "squares" not in call(capsys, *command)[2]


def test_squares_in_millimetres_are_refused_before_anybody_holds_the_board(folder, capsys, monkeypatch):
    monkeypatch.setattr(doctor, "_rendering", lambda: Finding("rendering", True, "replaced: it takes a second"))
    (folder / "hw.toml").write_text(HARDWARE + "[board]\nsquare = 25\n")
    command = ("calibrate", "--rig", "hw.toml", "--out", "new.json")
    wrong = "square: 25 m is no board's square; 25 mm are 0.025\n"
    assert call(capsys, *command) == (1, "", f"cotarget calibrate: hw.toml: board.{wrong}")
    assert f"MISSING  board: {wrong}" in call(capsys, "doctor", "--rig", "hw.toml")[1]


def test_a_printed_board_is_told_as_the_rig_wants_it(folder, capsys):
    status, out, _ = call(capsys, "board", "--out", "board.svg", "--board", "7x6", "--kind", "charuco")
    assert status == 0
    said = tomllib.loads(out[out.index("[board]") :])
    assert parse_config(said).board == BoardConfig("charuco", (7, 6), 0.025)


def test_the_doctor_asks_no_devices_of_a_simulated_rig(folder, capsys, monkeypatch):
    monkeypatch.setattr(doctor, "_rendering", lambda: Finding("rendering", True, "replaced"))
    assert "hardware." not in call(capsys, "doctor", "--rig", "sim.toml")[1]


def test_what_an_emulated_rig_takes_over_holds_in_any_folder(tmp_path):
    """Paths are relative to the rig.toml that they stand in; those of what is written elsewhere are whole."""
    table = {
        "sim": {"seed": 1},
        "board": {"square": 0.05},
        "safety": {"stop_file": "run/stop", "pan_deg": [-5, 5]},
        "targets": {"book": {"template": "covers/mine.png"}, "bird": {"size": 0.9}},
    }
    assert copied_tables(table, tmp_path) == {
        "board": {"square": 0.05},
        "safety": {"stop_file": str(tmp_path / "run/stop"), "pan_deg": [-5, 5]},
        "targets": {"book": {"template": str(tmp_path / "covers/mine.png")}, "bird": {"size": 0.9}},
    }


def test_a_stop_waits_for_no_heavy_import(folder):
    """On a machine that is busy with following, numpy and scipy alone take seconds."""
    path = {"PYTHONPATH": str(Path(__file__).parents[2])}
    program = "import sys; from cotarget import cli; cli.main(['stop', '--rig', 'stops.toml']); print(*sys.modules)"
    command = [sys.executable, "-c", program]
    said = subprocess.run(command, env=os.environ | path, capture_output=True, text=True, check=True).stdout
    assert (folder / "run" / "stop").exists()
    assert not {"numpy", "scipy", "cv2", "mujoco", "pydantic", "rich", "jinja2"} & set(said.split())
