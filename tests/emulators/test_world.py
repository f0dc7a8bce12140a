"""The emulated world: axes and lens in simulated time, and once the whole in real time."""

import math
import socket
import threading
import time

import numpy as np
import pytest

from cotarget.config import RigConfig, SimConfig, parse_config
from cotarget.emulators.serve import JsonLines
from cotarget.emulators.world import FIXED_HZ, ZOOM_HZ, EmulatedAxis, LiveWorld, paced
from cotarget.errors import ConfigError, DeviceError
from cotarget.geometry import pose
from cotarget.sim.motion import Axis, HeadDrive, LensDrive
from tests.support.emulated_camera import DEADLINE_S
from tests.support.plants import fails
from tests.support.simulated_clock import SimClock

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
