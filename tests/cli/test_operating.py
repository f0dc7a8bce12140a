"""Commands of an operator: stop, clear, reset-head, latency, board; and consent before the head moves."""

import contextlib
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from cotarget.backends import OPENERS
from cotarget.config import RigConfig, SafetyConfig
from cotarget.drivers import ptu_d46
from cotarget.drivers.interlock import PositionLostMarker, rig_lock
from cotarget.emulators.emulation import copied_tables
from cotarget.errors import EmergencyStopError, UnreachableError
from cotarget.latency import Delay, HeadLatency
from cotarget.safety.safe_rig import guard
from cotarget.safety.stop_file import refuse_if_stopped
from tests.support.commands import HARDWARE, NO_PORT, call, refused, true_calibration
from tests.support.rigs import rig_of
from tests.support.safety_rigs import SimulatedDevices

STOP_FILE = '\n[safety]\nstop_file = "run/stop"\n'


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with rigs whose devices are not there."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sim.toml").write_text("[sim]\n")
    (tmp_path / "stops.toml").write_text("[sim]\n" + STOP_FILE)
    (tmp_path / "hw.toml").write_text(HARDWARE + STOP_FILE)
    (tmp_path / "run").mkdir()
    true_calibration(RigConfig()).save(tmp_path / "good.json")
    return tmp_path


def test_stop_lasts_until_clear_with_the_same_stop_file(folder, capsys):
    path = folder / "run" / "stop"
    assert call(capsys, "clear", "--rig", "stops.toml")[0] == 0  # there is none
    assert call(capsys, "stop", "--rig", "stops.toml", "--reason", "a bird in the gears")[0] == 0
    assert path.read_text() == "a bird in the gears\n"
    with pytest.raises(EmergencyStopError, match="a bird in the gears"):
        refuse_if_stopped(path)
    said = refused(capsys, "reset-head", "--rig", "hw.toml", "--yes")
    assert "a bird in the gears" in said
    assert "cotarget clear --rig hw.toml" in said
    assert call(capsys, "clear", "--rig", "hw.toml") == (0, "cleared: a bird in the gears\n", "")
    refuse_if_stopped(path)
    call(capsys, "stop", "--rig", "stops.toml")
    assert call(capsys, "clear", "--rig", "stops.toml")[1] == "cleared: stopped by the operator\n"


OWN_HEAD = """
from cotarget.drivers.polled_head import PolledHead, PolledHeadSettings
from cotarget.schema import Limits, model

@model
class Settings(PolledHeadSettings):
    port: str = ""
    step_deg: float = 0.1
    pan_deg: Limits = (-90.0, 90.0)
    tilt_deg: Limits = (-30.0, 30.0)
    speed_deg_s: float = 40.0

class Head(PolledHead):
    Settings = Settings
"""


def test_a_unit_without_a_reset_is_trusted_after_consent(folder, capsys, monkeypatch):
    """What the marker advises works."""
    monkeypatch.setenv("XDG_STATE_HOME", str(folder))
    (folder / "own.py").write_text(OWN_HEAD)
    (folder / "own.toml").write_text(
        f'backend = "hardware"\n[hardware.head]\ndriver = "own:Head"\nport = "/dev/nobody"\n{STOP_FILE}'
    )
    assert "needs none" in refused(capsys, "reset-head", "--rig", "own.toml", "--yes")
    lost = PositionLostMarker("/dev/nobody", folder / "run" / "stop")
    lost.note("it was blocked")
    monkeypatch.setattr(sys, "stdin", io.StringIO("no\nyes\n"))
    assert call(capsys, "reset-head", "--rig", "own.toml")[0] == 1
    assert lost.files()
    assert call(capsys, "reset-head", "--rig", "own.toml")[0] == 0
    assert not lost.files()


FOLLOW = ("follow", "--calibration", "good.json", "--target", "book", "--rig", "hw.toml")
LATENCY = ("latency", "--rig", "hw.toml")


@pytest.mark.parametrize("command", [FOLLOW, ("calibrate", "--rig", "hw.toml"), ("point", "--rig", "hw.toml"), LATENCY])
def test_stopped_rig_is_not_opened(folder, capsys, command):
    """Opening it would report that its devices do not exist."""
    assert call(capsys, "stop", "--rig", "hw.toml")[0] == 0
    assert refused(capsys, *command).startswith(f"cotarget {command[0]}: emergency stop: stopped by the operator")
    call(capsys, "clear", "--rig", "hw.toml")
    assert "emergency stop" not in refused(capsys, *command)


NAMED = 'safety.stop_file = "run/stop"\n'
BROKEN = {
    "an unknown key": "[hardware.head]\nbuad = 9600\n" + STOP_FILE,
    "an impossible value": "[hardware.head]\nbaud = 9601\n[board]\nsquare = -1\n" + STOP_FILE,
    "an unknown table": "[hardwear]\n" + STOP_FILE,
    "another mistake beside it": STOP_FILE + "watchdog_s = 0\npan_deg = 5\n",
    "no TOML at all": "[sim\nscene = indoor\n" + STOP_FILE,
    "no TOML after a mark of byte order": "\ufeff[sim\n" + STOP_FILE,
    "a dotted key": NAMED + "[simm]\n",
    "a dotted key and no TOML": f"{NAMED}[sim\n# stop_file = 'another'\n",
    "a dotted key after a mark": f"\ufeff{NAMED}[simm]\n",
    "an inline table": 'safety = { watchdog_s = 0, stop_file = "run/stop" }\n',
    "an inline table and no TOML": 'safety = { watchdog_s = 0, stop_file = "run/stop" }\n[sim\n',
}


@pytest.mark.parametrize("mistake", BROKEN)
def test_stop_works_on_a_broken_rig_toml(folder, capsys, mistake):
    (folder / "broken.toml").write_text(BROKEN[mistake])
    refused(capsys, "point", "--rig", "broken.toml")
    assert call(capsys, "stop", "--rig", "broken.toml")[0] == 0
    assert (folder / "run" / "stop").exists()
    assert call(capsys, "clear", "--rig", "broken.toml")[0] == 0


def test_missing_folder_of_the_stop_file_fails_stop_and_point(folder, capsys):
    (folder / "broken.toml").write_text('[safety]\nstop_file = "run/stop\n')
    assert "broken.toml: " in refused(capsys, "stop", "--rig", "broken.toml")
    (folder / "run").rmdir()
    assert refused(capsys, "stop", "--rig", "stops.toml").startswith(
        f"cotarget stop: {folder / 'run/stop'}: NOT stopped: "
    )
    assert refused(capsys, "point", "--rig", "stops.toml").startswith(f"cotarget point: {folder / 'run/stop'}: ")
    assert not (folder / "run").exists()


def test_stop_without_options_stops_every_open_rig_whatever_the_folder_has(folder, capsys):
    (folder / "rig.toml").write_text("[sim\n")
    with guard(rig_of(SimulatedDevices()), SafetyConfig(stop_file=folder / "run" / "stop")):
        status, out, err = call(capsys, "stop", "--reason", "smoke")
        assert (status, out.count("stopped: "), "rig.toml: is not TOML" in err) == (0, 1, True)
    assert (folder / "run" / "stop").read_text() == "smoke\n"
    assert "rig.toml: is not TOML" in refused(capsys, "stop")  # no rig is open any more
    (folder / "rig.toml").unlink()
    assert "no program of this user has a rig open" in refused(capsys, "stop")


def test_stop_without_options_stops_the_folders_rig_and_says_when_no_program_watches(folder, capsys):
    (folder / "rig.toml").write_text(STOP_FILE)
    status, out, err = call(capsys, "stop")
    assert (status, str(folder / "run" / "stop") in out, "no program of this user watches" in err) == (0, True, True)
    assert (folder / "run" / "stop").exists()


def test_a_stop_that_cannot_be_written_keeps_no_other_from_being_written(folder, capsys):
    (folder / "gone").mkdir()
    with contextlib.ExitStack() as opened:
        for name in ("gone", "run"):
            opened.enter_context(guard(rig_of(SimulatedDevices()), SafetyConfig(stop_file=folder / name / "stop")))
        (folder / "gone").rmdir()
        status, _, err = call(capsys, "stop")
        assert (status, "gone/stop: NOT stopped" in err, (folder / "run" / "stop").exists()) == (1, True, True)


@pytest.mark.parametrize("command", ["stop", "--help"])
def test_stop_and_help_import_nothing_heavy(folder, command):
    """On a busy machine, importing numpy and scipy takes seconds."""
    arguments = ["stop", "--rig", "stops.toml"] if command == "stop" else [command]
    program = (
        "import contextlib, sys; from cotarget import cli\n"
        f"with contextlib.suppress(SystemExit): cli.main({arguments})\n"
        "print(*sys.modules)"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    said = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    ).stdout
    assert (folder / "run" / "stop").exists() == (command == "stop")
    heavy = {"numpy", "scipy", "cv2", "mujoco", "pydantic", "rich", "jinja2", "cotarget.config"}
    assert not heavy & set(said.splitlines()[-1].split())


@pytest.mark.parametrize(("delay", "configured"), [(0.02, 0.08), (-0.06, 0.0), (-0.065, 0.0), (-0.2, None)])
def test_latency_refuses_a_clearly_negative_delay(folder, capsys, monkeypatch, delay, configured):
    """The default simulation has 60 ms; a sum slightly below zero is zero."""
    found = HeadLatency(Delay(delay, 0.99), command=0.04, frames=100, late="too busy")
    monkeypatch.setattr("cotarget.latency.measure_head", lambda rig: found)
    monkeypatch.setitem(OPENERS, "sim", lambda *_: rig_of(SimulatedDevices()))
    status, out, err = call(capsys, "latency", "--rig", "sim.toml")
    assert "too busy" in err
    assert json.loads(out)["measured"] == {"sim.zoom.latency_s": configured, "sim.head.command_delay_s": 0.04}
    assert status == (configured is None)
    if configured is None:
        assert err.splitlines()[-1].startswith("cotarget latency: sim.zoom.latency_s: -140 ms")


def test_latency_prints_what_it_found_though_one_value_failed(folder, capsys, monkeypatch):
    def fails(*_):
        raise UnreachableError("the board is out of reach")

    monkeypatch.setattr("cotarget.latency.measure_head", lambda rig: HeadLatency(Delay(0.0, 0.99), 0.04, 100))
    monkeypatch.setattr("cotarget.latency.measure_fixed", fails)
    monkeypatch.setitem(OPENERS, "sim", lambda *_: rig_of(SimulatedDevices()))
    status, out, err = call(capsys, "latency", "--rig", "sim.toml", "--calibration", "good.json", "--insist")
    assert (status, json.loads(out)["measured"]["sim.zoom.latency_s"]) == (1, 0.06)
    assert "sim.fixed.latency_s: the board is out of reach" in err


def test_latency_describes_a_stream(folder, capsys, monkeypatch):
    devices = SimulatedDevices()
    monkeypatch.setattr(devices.fixed, "describe", lambda: "640x480 h264, 25.0 frames a second", raising=False)
    monkeypatch.setattr("cotarget.latency.measure_head", lambda rig: HeadLatency(Delay(0.0, 0.99), 0.04, 100))
    monkeypatch.setitem(OPENERS, "sim", lambda *_: rig_of(devices))
    status, _, err = call(capsys, "latency", "--rig", "sim.toml")
    assert status == 0
    assert "sim.fixed: 640x480 h264, 25.0 frames a second" in err.splitlines()
    assert "sim.zoom: " not in err


@pytest.fixture
def resets(monkeypatch):
    """Serial ports whose heads would have been reset."""
    asked = []

    def reset(settings, clock, safety, stopped):
        assert stopped() is None
        asked.append(settings.port)
        return "v2.12.1d1: pan -3090 to 3090, tilt -3090 to 3090 steps"

    monkeypatch.setattr(ptu_d46.D46Head, "reset", staticmethod(reset))
    return asked


@pytest.mark.parametrize("answer", ["yes\n", "YES", "--yes"])
def test_reset_head_with_consent_resets(folder, capsys, monkeypatch, resets, answer):
    monkeypatch.setattr("sys.stdin", io.StringIO(answer))
    status, out, err = call(capsys, "reset-head", "--rig", "hw.toml", *(["--yes"] if answer == "--yes" else []))
    assert (status, err, resets) == (0, "", [NO_PORT])
    assert out.splitlines()[-1].startswith("reset: v2.12.1d1")
    assert ("camera and cables clear" in out) == (answer != "--yes")


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the devices have to refuse a second program")
@pytest.mark.parametrize("command", [("point",), ("reset-head", "--yes")])
def test_a_rig_in_use_is_neither_moved_nor_reset(folder, capsys, resets, command):
    with rig_lock(file=folder / "hw.toml"):
        assert "the rig of hw.toml is open already" in refused(capsys, *command, "--rig", "hw.toml")
    assert resets == []


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
def test_reset_head_without_consent_does_nothing(folder, capsys, monkeypatch, resets, stdin):
    monkeypatch.setattr("sys.stdin", stdin)
    status, _, err = call(capsys, "reset-head", "--rig", "hw.toml")
    assert (status, resets) == (1, [])
    assert "--yes" in err


@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_calibrate_needs_the_size_of_a_real_board_in_metres(folder, capsys, mark):
    calibrate = ("calibrate", "--rig", "hw.toml", "--out", "new.json")
    for board in ("", "[board]\ncorners = [9, 6]\n", "[board]\nsquare = 25\n"):
        (folder / "hw.toml").write_text(mark + HARDWARE + board)
        assert "0.025" in refused(capsys, *calibrate)
    (folder / "hw.toml").write_text(mark + HARDWARE + "[board]\nsquare = 0.025\n")
    assert "square" not in refused(capsys, *calibrate)
    assert not (folder / "new.json").exists()


def test_tables_copied_for_an_emulated_rig_have_absolute_paths(tmp_path):
    """Paths are relative to their rig.toml, so in another folder they must be absolute."""
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
