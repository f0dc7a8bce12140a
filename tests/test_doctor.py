"""The doctor reports what is missing with the command that fixes it."""

import os
import socket
import subprocess
import sys
from types import SimpleNamespace

import pytest
import serial

from cotarget import cli, doctor
from cotarget.backends import load_config
from cotarget.config import parse_config
from cotarget.doctor import Finding, needed_packages
from cotarget.drivers.ptu_d46 import UncalibratedError
from cotarget.emulators.axis_241q import AxisServer
from cotarget.emulators.plant import Feed
from cotarget.errors import install_extra, pip_install


@pytest.fixture
def tried(monkeypatch):
    """The outcome of the replaced rendering process."""
    outcome = SimpleNamespace(returncode=0, stdout="egl: llvmpipe (LLVM 15)\n", stderr="", error=None)
    real = subprocess.run

    def run(command, **options):
        if command[0] != sys.executable:  # the standard library asks the system for its name
            return real(command, **options)
        if outcome.error is not None:
            raise outcome.error
        return outcome

    monkeypatch.setattr(doctor.subprocess, "run", run)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    return outcome


def finding(name):
    return next(f for f in doctor.examine() if f.name == name)


def test_complete_machine_passes(tried, capsys):
    findings = doctor.examine()
    assert all(f.ok and not f.fix for f in findings if f.name != "cotarget"), findings
    names = [f.name for f in findings]
    assert {"python", "rendering", "H.264", "sim_assets", "serial ports", "gphoto2 cameras", *needed_packages()} == set(
        names
    )
    assert finding("rendering").text == "without a screen by egl: llvmpipe (LLVM 15)"
    assert finding("sim_assets").text == "scenes indoor, outdoor"
    assert cli.main(["doctor"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert len(out) == len(findings)
    assert all(line.startswith("ok ") for line in out)


def test_a_missing_package_is_named_with_its_command(tried, monkeypatch, capsys):
    def version(name):
        if name == "pyserial":
            raise doctor.importlib.metadata.PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setattr(doctor.importlib.metadata, "version", version)
    assert finding("pyserial") == Finding("pyserial", False, "not installed", pip_install("pyserial"))
    assert cli.main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert f"MISSING  pyserial: not installed\n         fix: {pip_install('pyserial')}\n" in out


def test_the_rig_of_the_folder_is_examined(tried, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text("[targets.bird]\nsize = 80\n")
    assert cli.main(["doctor"]) == 1
    assert "MISSING  targets.bird.size: 80 m is far from the 0.8 m" in capsys.readouterr().out
    (tmp_path / "rig.toml").write_text("[targets.bird]\nsise = 0.8\n")
    assert cli.main(["doctor"]) == 1
    assert capsys.readouterr().err.startswith("cotarget doctor: rig.toml: unknown key 'targets.bird.sise'")


def test_a_package_that_reads_rig_toml_may_be_missing(tried, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").touch()
    monkeypatch.setitem(sys.modules, "cotarget.backends", None)
    assert cli.main(["doctor"]) == 0
    assert "ok       numpy" in capsys.readouterr().out


@pytest.mark.parametrize("module", ["av", "serial.tools"])
def test_broken_package_does_not_stop_the_doctor(tried, monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)
    if module != "av":
        monkeypatch.delitem(sys.modules, "serial.tools.list_ports", raising=False)
    broken = [f for f in doctor.examine() if not f.ok]
    assert [f.name for f in broken] == ["H.264" if module == "av" else "serial ports"]
    assert broken[0].fix.startswith(f"{sys.executable} -m pip install")


def findings(config):
    return {f.name: f for f in doctor.examine(config)}


@pytest.mark.parametrize(("table", "name", "said"), [
    ({"backend": "replay", "recording": "film"}, "recording", "film/recording.json: no such file"),
    ({"targets": {"book": {"template": "cover.png"}}}, "targets.book.template", "cover.png: no such file"),
    ({"sim": {"models": {"duck": "duck.obj"}}}, "sim.models.duck", "duck.obj: no such file"),
    ({"targets": {"bird": {"size": 80}}}, "targets.bird.size", "80 m is far from the 0.8 m"),
])  # fmt: skip
def test_what_a_rig_names_is_looked_for(tried, table, name, said):
    assert name not in findings(parse_config({}))
    found = findings(parse_config(table))[name]
    assert (found.ok, found.fix) == (False, "correct it in rig.toml")
    assert said in found.text


def test_only_a_real_rig_needs_gphoto2(tried, monkeypatch):
    monkeypatch.setitem(sys.modules, "gphoto2", None)
    assert finding("gphoto2 cameras").ok
    found = findings(real(zoom={"port": "usb:"}))
    missing = found["gphoto2 cameras"]
    assert (missing.ok, missing.fix) == (False, install_extra("hardware"))
    assert found["hardware.zoom"].fix == install_extra("hardware")


def test_zoom_camera_and_board_presenter_are_probed(tried):
    """Nothing listens at port 1 of this machine; a person always answers."""
    pytest.importorskip("gphoto2")
    found = findings(real(zoom={"port": "ptpip:127.0.0.1:1"}))
    assert (found["hardware.zoom"].ok, found["hardware.board"].ok) == (False, True)
    assert "'ptpip:127.0.0.1:1:1'" in found["hardware.zoom"].text
    found = findings(real(board={"presenter": "socket://127.0.0.1:1"}))
    assert (found["hardware.zoom"].ok, found["hardware.board"].ok) == (False, False)
    assert "socket://127" in found["hardware.board"].text
    assert "[hardware.board]" in found["hardware.board"].fix
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        found = findings(
            real(zoom={"port": f"ptpip:localhost:{port}"}, board={"presenter": f"socket://127.0.0.1:{port}"})
        )
    assert found["hardware.zoom"].ok
    assert found["hardware.board"].ok


@pytest.mark.parametrize(("change", "backend", "text", "fix"), [
    ({"returncode": 1, "stderr": "Traceback (most recent call last):\n  x\ncotarget.errors.DeviceError: no OpenGL\n"},
     None, "no OpenGL", "apt-get install -y libegl1"),
    ({"returncode": -11}, None, "the test ended with status -11", "apt-get install -y libegl1"),
    ({"returncode": 1, "stderr": "RuntimeError: invalid value\n"}, "vulkan", "invalid value", "unset MUJOCO_GL"),
    ({"error": subprocess.TimeoutExpired("python", 60)}, None, "no picture within 60 s", "MUJOCO_GL=osmesa"),
])  # fmt: skip
def test_failed_rendering_is_reported_with_its_fix(tried, monkeypatch, change, backend, text, fix):
    vars(tried).update(change)
    if backend:
        monkeypatch.setenv("MUJOCO_GL", backend)
    found = finding("rendering")
    assert not found.ok
    assert found.text == text
    assert fix in found.fix


@pytest.mark.parametrize(("size", "renderer", "said"), [
    ([1920, 1080], "egl: llvmpipe (LLVM 15)", "; this is software, which is slow for images of 2.1 MP"),
    ([640, 480], "egl: llvmpipe (LLVM 15)", ""),
    ([1920, 1080], "egl: NVIDIA GeForce", ""),
])  # fmt: skip
def test_large_images_rendered_in_software_are_named(tried, size, renderer, said):
    tried.stdout = f"{renderer}\n"
    found = doctor.rendering(parse_config({"sim": {"fixed": {"size": size}}}))
    assert found.ok
    assert found.text == f"without a screen by {renderer}{said}"


@pytest.mark.render
def test_rendering_is_tried():
    assert doctor.rendering().ok


def test_pyav_without_an_encoder_is_reported(tried, monkeypatch):
    monkeypatch.setattr("av.codecs_available", set())
    assert (finding("H.264").ok, "av" in finding("H.264").fix) == (False, True)


def real(**tables):
    return parse_config({"backend": "hardware", "hardware": tables})


def test_lost_position_is_reported(tried, tmp_path):
    config = parse_config(
        {"backend": "hardware", "hardware": {"head": {"port": "/dev/nobody"}},
         "safety": {"stop_file": str(tmp_path / "stop")}}
    )  # fmt: skip
    assert findings(config)["head's position"].ok
    (tmp_path / "stop.dev-nobody.position-lost").write_text("it hit a limit\n")
    lost = findings(config)["head's position"]
    assert (lost.ok, "it hit a limit" in lost.text, "reset-head" in lost.fix) == (False, True, True)


@pytest.mark.parametrize("backend", ["sim", "hardware"])
def test_emergency_stop_is_reported(tried, tmp_path, backend):
    stop = tmp_path / "run" / "stop"
    config = parse_config({"backend": backend, "safety": {"stop_file": str(stop)}})
    found = findings(config)["emergency stop"]
    assert (found.ok, found.fix) == (False, f"mkdir -p {tmp_path / 'run'}")
    stop.parent.mkdir()
    assert findings(config)["emergency stop"].ok
    stop.write_text("a bird in the gears\n")
    found = findings(config)["emergency stop"]
    assert (found.ok, found.text.startswith("a bird in the gears")) == (False, True)
    assert found.fix == "cotarget clear --rig rig.toml"
    assert findings(parse_config({"backend": backend}))["emergency stop"].ok


def test_serial_port_in_use_is_reported_with_fuser(tried):
    ends = os.openpty()
    port = os.ttyname(ends[1])
    try:
        with serial.Serial(port, exclusive=True):
            head = findings(real(head={"port": port}))["hardware.head"]
    finally:
        for end in ends:
            os.close(end)
    assert (head.ok, port in head.text, f"fuser -v {port}" in head.fix) == (False, True, True)


def denied(*_, **__):
    raise serial.SerialException(13, "could not open port")


def uncalibrated(settings):
    raise UncalibratedError(f"the pan-tilt unit at {settings.port} is not calibrated")


@pytest.mark.parametrize(("replaced", "by", "fix"), [
    ("serial.serial_for_url", denied, "dialout"),
    ("cotarget.drivers.ptu_d46.D46Head.probe", uncalibrated, "cotarget reset-head --rig rig.toml"),
])  # fmt: skip
def test_failing_head_is_reported_with_its_fix(tried, monkeypatch, replaced, by, fix):
    monkeypatch.setattr(replaced, by)
    head = findings(real(head={"port": "/dev/x"}))["hardware.head"]
    assert (head.ok, "/dev/x" in head.text, fix in head.fix) == (False, True, True)


def test_missing_square_size_is_reported(tried, tmp_path):
    path = tmp_path / "hw.toml"
    for text, ok in (("", False), ("[board]\nsquare = 25.4\n", False), ("[board]\nsquare = 0.0254\n", True)):
        path.write_text(f'backend = "hardware"\n{text}')
        (board,) = [f for f in doctor.examine(load_config(path), path) if f.name == "board"]
        assert (board.ok, str(path) in board.fix, "25.4 mm" in board.text) == (ok, not ok, ok)


@pytest.mark.wire
def test_input_without_video_is_reported(tried):
    with AxisServer({1: Feed()}) as server:
        server.faults.set("no-video", True)
        fixed = findings(real(fixed={"url": server.url}))["hardware.fixed"]
    assert not fixed.ok
    assert "input 1" in fixed.text


@pytest.mark.wire
def test_wrong_password_is_reported_with_its_fix(tried, monkeypatch):
    monkeypatch.setenv("COTARGET_PASSWORD", "guessed")
    with AxisServer({1: Feed()}, user="viewer", password="open sesame") as server:
        fixed = findings(real(fixed={"url": server.url, "user": "viewer"}))["hardware.fixed"]
    assert server.url in fixed.text
    assert "'viewer'" in fixed.text
    assert "export COTARGET_PASSWORD" in fixed.fix
    assert "cable" not in fixed.fix
