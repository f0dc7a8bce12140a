"""`cotarget emulate`: its output, and the rig.toml that describes the emulated devices."""

import json
import socket
import sys
import time
import tomllib

import pytest

from cotarget.backends import load_config
from cotarget.config import RigConfig, parse_config
from cotarget.emulators.emulation import Emulation
from cotarget.emulators.world import paced
from cotarget.errors import ConfigError
from tests.support.commands import call
from tests.support.emulated_camera import DEADLINE_S


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LP_NUM_THREADS", "1")  # emulate sets it, and how long threads take turns, for its process
    turns = sys.getswitchinterval()
    (tmp_path / "empty.toml").write_text("[sim]\n")
    (tmp_path / "marked.toml").write_text('\ufeffsim = { targets = ["bird"] }\n')
    yield tmp_path
    sys.setswitchinterval(turns)


@pytest.mark.wire
@pytest.mark.render
@pytest.mark.parametrize(("rig", "targets"), [
    ([], "person"), (["--rig", "marked.toml"], "bird"),
    (["--rig", "empty.toml"], 'none; [sim] targets = ["person"] has one to follow'),
])  # fmt: skip
def test_it_prints_the_targets(folder, capsys, rig, targets):
    status, out, err = call(capsys, "emulate", *rig, "--write", "hw.toml", "--seconds", "0.01")
    assert (status, err) == (0, "")
    assert f"\ntargets  {targets}\n" in out


@pytest.mark.wire
@pytest.mark.render
def test_an_earlier_rig_toml_is_kept(folder, capsys):
    (folder / "mine.toml").write_text("[sim]\n")
    status, _, err = call(capsys, "emulate", "--write", "mine.toml", "--seconds", "0.01")
    assert status == 0
    assert err == "mine.toml: the earlier one is kept as mine.previous-1.toml\n"
    assert (folder / "mine.previous-1.toml").read_text() == "[sim]\n"
    written = load_config(folder / "mine.toml")
    assert (written.backend, written.board) == ("hardware", RigConfig().board)


def conversation(address, *requests):
    """Send each request as a line of JSON, and return the answers."""
    host, port = address
    with socket.create_connection((host, port), DEADLINE_S) as client, client.makefile("rw") as lines:
        answers = []
        for request in requests:
            lines.write(json.dumps(request) + "\n")
            lines.flush()
            answers.append(json.loads(lines.readline()))
    return answers


@pytest.mark.wire
@pytest.mark.render
def test_the_written_rig_describes_the_emulated_devices():
    """A head that turns 100 degrees to the left and 150 to the right: 150 / 0.0514286 = 2916.7 steps."""
    sim = {"scene": "indoor", "head": {"pan_deg": [-100.0, 150.0]}, "fixed": {"latency_s": 0.05}}
    sim["zoom"] = {"latency_s": 0.1, "focal_mm": [6.0, 9.0], "lens_steps": 25, "pitch_mm": 0.01}
    with Emulation(paced(parse_config({"sim": sim}))) as emulation:
        hardware = parse_config(tomllib.loads(emulation.rig_toml(tcp=True))).hardware
        host, port = hardware.head["port"].removeprefix("socket://").split(":")
        with socket.create_connection((host, int(port)), DEADLINE_S) as head, head.makefile("rb") as said:
            head.sendall(b"ED FT PN PX ")
            limits = [said.readline() for _ in range(4)][2:]
        truth, wrong_fault, wrong_device, switched, no_object = conversation(
            (emulation.control.host, emulation.control.port),
            {"truth": True}, {"fault": "head.stall"}, {"fault": "lens.stall"}, {"fault": "zoom.busy"}, [],
        )  # fmt: skip
        now = time.monotonic()
        wrong = conversation(
            (emulation.board.host, emulation.board.port),
            {"swing": None}, {"hold": None}, {"present": {"translation": [0, 0], "rotvec_deg": [0, 0, 0]}},
        )  # fmt: skip
        assert "busy" in emulation.faults["zoom"]
    assert limits == [b"* -2916\r\n", b"* 1944\r\n"]  # positive pan is left on the unit, and right in rig.toml
    assert (hardware.head["pan_deg"], hardware.head["pan_sign"]) == ([-100.0, 150.0], -1)
    assert (hardware.fixed["latency_s"], hardware.zoom["latency_s"]) == (0.05, 0.1)
    assert (hardware.zoom["size"], hardware.zoom["still_size"]) == ([320, 240], [640, 480])
    assert (hardware.zoom["pitch_mm"], hardware.zoom["lens"]) == (0.02, [[0, 6.0], [24, 9.0]])
    assert 0.0 < truth["world"] < truth["t"] < now
    assert (truth["pan_deg"], truth["tilt_deg"], truth["moving"], truth["lens"]) == (0.0, 0.0, False, 0)
    assert switched == {"ok": True}
    assert all("error" in answer for answer in (wrong_fault, wrong_device, no_object, *wrong))


@pytest.mark.parametrize("sim", [{"zoom": {"size": [641, 480]}}, {"head": {"step_deg": 1e-5}}])
def test_a_rig_that_these_devices_cannot_have_is_refused(sim):
    with pytest.raises(ConfigError):
        Emulation(parse_config({"sim": sim}))
