"""The emulated world in simulated and real time, and `cotarget emulate` with the rig.toml that it writes."""

import contextlib
import json
import math
import socket
import sys
import threading
import time
import tomllib

import numpy as np
import pytest

from cotarget.backends import load_config
from cotarget.config import RigConfig, SimConfig, parse_config
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.rig import device_of
from cotarget.emulators.emulation import Emulation
from cotarget.emulators.serve import JsonLines
from cotarget.emulators.world import FIXED_HZ, ZOOM_HZ, EmulatedAxis, LiveWorld, paced
from cotarget.errors import ConfigError, DeviceError
from cotarget.geometry import pose
from cotarget.sim.motion import Axis, HeadDrive, LensDrive
from tests.support.commands import call
from tests.support.emulated_camera import DEADLINE_S
from tests.support.plants import fails
from tests.support.simulated_clock import SimClock

TIME_S = 0.02  # of the median time of a picture, whose encoding takes longer on a busy machine
STEP = math.radians(0.05)  # [rad]
DELAY = 0.04  # from a command to motion [s]


@pytest.fixture
def clock():
    clock = SimClock()
    clock.t = 0.0
    return clock


@pytest.mark.parametrize("step", [STEP, -STEP])
def test_an_axis_starts_after_the_delay_and_follows_its_trapezoid(clock, step):
    """1000 steps at 500/s and 1000/s^2: 0.5 s and 125 steps on either ramp, 750 steps in 1.5 s between them.

    A unit may count the other way than the simulated axis turns.
    """
    inner = Axis(1000 * STEP, 2000 * STEP)
    plant = EmulatedAxis(inner, clock, step, DELAY)
    plant.command(1000, 500, 1000)
    for t, position, speed, moving in [
        (0.0, 0, 0, True),
        (0.04, 0, 0, True),
        (0.29, 31, 250, True),  # 1000 / 2 * 0.25^2
        (0.54, 125, 500, True),
        (1.54, 625, 500, True),
        (2.29, 969, 250, True),
        (2.539, 1000, 1, True),
        (2.541, 1000, 0, False),
    ]:
        clock.t = t
        assert plant.position() == position, t
        assert plant.speed() == pytest.approx(speed, abs=1.1)
        assert plant.moving() is moving, t
    assert inner.motor(5.0)[0] == pytest.approx(1000 * step)


def test_a_halt_takes_the_braking_distance_after_the_delay(clock):
    """From 500 steps/s, 20 steps in the delay, then 125 of braking at 1000/s^2."""
    plant = EmulatedAxis(Axis(1000 * STEP, 2000 * STEP), clock, STEP, DELAY)
    plant.command(1000, 500, 1000)
    clock.t = 1.04
    assert plant.position() == 375
    plant.halt(1000)
    clock.t = 1.6
    assert not plant.moving()
    assert plant.position() == 375 + 20 + 125


def test_real_time_has_lower_rates_and_fewer_effects():
    config = RigConfig()
    sim = paced(config).sim
    assert (sim.fixed.rate_hz, sim.zoom.rate_hz) == (FIXED_HZ, ZOOM_HZ)
    assert not any((sim.effects.shadows, sim.effects.multisampling, sim.effects.jpeg))
    slow = paced(
        parse_config({"sim": {"fixed": {"rate_hz": 3.0}, "zoom": {"rate_hz": 2.0}}, "safety": {"watchdog_s": 1.0}})
    )
    assert (slow.sim.fixed.rate_hz, slow.sim.zoom.rate_hz) == (3.0, 2.0)


@pytest.mark.wire
@pytest.mark.render
def test_the_world_runs_in_real_time():
    """One world, because it takes seconds to make: its pictures, its board, its stills, its head, its end."""
    config = paced(parse_config({"sim": {"scene": "indoor", "zoom": {"latency_s": 0.2}}}))
    threads = threading.active_count()
    world = LiveWorld(config, pan_sign=-1)
    with world:
        seen = {}
        for name, camera in (("fixed", config.sim.fixed), ("zoom", config.sim.zoom)):
            first = world.feeds[name].newest(timeout=DEADLINE_S)
            second = world.feeds[name].newest(after=first.index, timeout=DEADLINE_S)
            assert second.index > first.index
            assert second.t - first.t == pytest.approx((second.index - first.index) / camera.rate_hz)
            assert time.monotonic() - second.t >= camera.latency_s
            assert second.image.shape == (480, 640, 3)
            seen[name] = second
        assert world.still().shape == (480, 640, 3)

        world.present(pose([-0.4, -0.25, 2.5], [0, 0, 0]))
        now = time.monotonic()
        deadline = now + DEADLINE_S
        shown = seen["fixed"]
        while shown.t <= now and time.monotonic() < deadline:
            shown = world.feeds["fixed"].newest(after=shown.index, timeout=DEADLINE_S)
        # A board of 1 m at 2.5 m fills a sixth of the view: far more than noise changes.
        assert np.mean(np.abs(shown.image.astype(int) - seen["fixed"].image) > 30) > 0.05
        world.present(None)

        world.pan.command(100, 3000, 4000)
        while world.pan.moving():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert world.pan.position() == 100
        assert world.head_truth()[0] == pytest.approx(-100 * math.radians(config.sim.head.step_deg))
    world.close()
    assert threading.active_count() == threads


@pytest.mark.wire
def test_a_world_that_cannot_be_made_says_why():
    threads = threading.active_count()
    with pytest.raises(ConfigError, match="unknown scene 'nowhere'"):
        LiveWorld(RigConfig(sim=SimConfig(scene="nowhere")))
    assert threading.active_count() == threads


class FakeWorld:
    """In the place of the simulated one: it shows black until its memory is full."""

    full = closed = False

    def __init__(self, config, clock):
        self.head_drive = HeadDrive(Axis(1.0, 1.0), Axis(1.0, 1.0))
        self.lens_drive = LensDrive(667.0, 8000.0, 128, True, Axis(129.0, math.inf))

    def expose(self, name, index, t):
        if FakeWorld.full:
            raise MemoryError("no more")
        return np.zeros((4, 4, 3), np.uint8)

    def close(self):
        FakeWorld.closed = True


@pytest.mark.wire
def test_a_later_failure_of_the_world_is_raised_by_its_methods(monkeypatch):
    monkeypatch.setattr("cotarget.emulators.world.SimWorld", FakeWorld)
    monkeypatch.setattr(FakeWorld, "closed", False)
    with LiveWorld(RigConfig()) as world:
        world.check()
        assert world.still().shape == (4, 4, 3)
        monkeypatch.setattr(FakeWorld, "full", True)
        for call in (world.check, world.still):
            assert fails(call) == "the simulated world failed: MemoryError('no more')"
    assert FakeWorld.closed


@pytest.mark.wire
def test_a_server_of_json_lines_closes_its_connections_and_its_port():
    with JsonLines(lambda said: said) as server:
        client = socket.create_connection(("127.0.0.1", server.port), DEADLINE_S)
        with pytest.raises(DeviceError, match=f"cannot listen at 127.0.0.1:{server.port}: Address already in use"):
            JsonLines(lambda said: said, port=server.port)
        with client, client.makefile("rwb") as lines:
            lines.write(b'{"a": 1}\n')
            lines.flush()
            assert lines.readline() == b'{"a": 1}\n'
            for wrong in (b"nonsense\n", b"[" * 60000 + b"\n"):
                lines.write(wrong)
                lines.flush()
                assert lines.readline().startswith(b'{"error": "not understood: ')
            server.close()
            assert lines.readline() == b""
    with JsonLines(lambda said: said, port=server.port):
        pass


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


@pytest.mark.wire
@pytest.mark.render
def test_the_fixed_camera_behind_rtsp_has_the_pictures_times(monkeypatch):
    monkeypatch.setenv("COTARGET_PASSWORD", "pass word")
    config = paced(parse_config({"sim": {"scene": "indoor"}}))
    with Emulation(config, user="viewer", password="pass word", fixed="rtsp") as emulation:
        table = tomllib.loads(emulation.rig_toml(tcp=True))["hardware"]["fixed"]
        assert (table["driver"], table["url"], table["user"]) == ("stream", emulation.fixed.url, "viewer")
        clock = MonotonicClock()
        with contextlib.closing(device_of("fixed", table).open(clock)) as camera:
            frames = [camera.read(timeout=DEADLINE_S)]
            while len(frames) < 20:
                frames.append(camera.read(frames[-1].t, DEADLINE_S))
            begin = emulation.world.clock.monotonic(0.0) + clock.now() - time.monotonic()
    periods = (np.array([frame.t for frame in frames[10:]]) - begin) * config.sim.fixed.rate_hz
    assert np.median(np.abs(periods - np.round(periods))) < TIME_S * config.sim.fixed.rate_hz
    with pytest.raises(ConfigError, match=r"unknown fault 'fixed\.dashed-boundary'"):
        emulation.switch("fixed.dashed-boundary")


@pytest.mark.parametrize(
    "sim", [{"zoom": {"size": [641, 480]}}, {"head": {"step_deg": 1e-5}}, {"fixed": {"size": [641, 480]}}]
)
def test_a_rig_that_these_devices_cannot_have_is_refused(sim):
    with pytest.raises(ConfigError):
        Emulation(parse_config({"sim": sim}), fixed="rtsp")
