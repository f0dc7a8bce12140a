"""The PTU-D46 as a rig's head, with its thread; the unit and the time are simulated. Over the wire: test_ptu_wire."""

import math
import signal
import threading
import time
from dataclasses import replace

import pytest
import serial

from cotarget.config import SafetyConfig
from cotarget.drivers.interlock import PositionLostMarker
from cotarget.drivers.polled_head import PolledHead
from cotarget.drivers.ptu_d46 import D46Head, D46Link, D46Settings
from cotarget.drivers.ptu_protocol import Line
from cotarget.errors import ConfigError, DeviceError, HaltedError
from tests.support.d46_bench import CONFIG, Bench

STEP = math.radians(185.1428 / 3600)
LIMITS_DEG = ((-158.91, 158.91), (-46.65, 31.06))  # 3090 and -907..604 steps of 185.1428 seconds of arc
DEADLINE_S = 20.0  # for a thread that should end at once; a machine may be busy


def fails(call):
    """What a call says when it fails at last."""
    end = time.monotonic() + DEADLINE_S
    while time.monotonic() < end:
        try:
            call()
        except DeviceError as error:
            return str(error)
    raise AssertionError("it goes on and on")


@pytest.fixture
def bench():
    return Bench()


@pytest.fixture
def opened(bench, monkeypatch, tmp_path):
    """Open heads on the bench through pyserial's own function; what is remembered is forgotten after the test."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: bench.port)
    heads = []

    def open_head(config=CONFIG, **safety):
        bench.port.closed = False
        heads.append(D46Head(config, bench.clock, SafetyConfig(**safety)))
        return heads[-1]

    yield open_head
    for head in heads:
        head.close()
    assert not any(thread.name.startswith("head at") for thread in threading.enumerate())


@pytest.fixture
def watched(bench):
    """A head, and its link, which tells whether somebody's halt waits."""
    link = D46Link(Line(bench.port, "PORT", 9600, bench.clock))
    head = PolledHead(lambda: link, CONFIG, bench.clock)
    yield head, link
    head.close()


def until_a_halt_waits(link):
    """Hold the thread that talks to the unit until somebody's halt is in its queue."""
    deadline = time.monotonic() + DEADLINE_S
    while not link.hurry():
        assert time.monotonic() < deadline
        time.sleep(0)


def test_limits_are_the_units_in_the_sense_of_the_file(opened):
    limits = opened().limits
    for own, expected in zip((limits.pan, limits.tilt), LIMITS_DEG, strict=True):
        assert [math.degrees(v) for v in own] == pytest.approx(expected, abs=0.01)
    assert limits.step == pytest.approx(STEP)
    assert math.degrees(limits.speed) == pytest.approx(149.0)
    assert limits.acceleration == pytest.approx(2000 * STEP)


@pytest.mark.parametrize(
    ("config", "goals"),
    [
        # Positive pan of a PTU-D46 turns left, says its manual; that of a rig turns right. Tilt goes up for both.
        (D46Settings(port="PORT"), (-10, 20)),
        (D46Settings(port="PORT", pan_sign=1), (10, 20)),
        (D46Settings(port="PORT", tilt_sign=-1, tilt_deg=(-31.1, 46.6)), (-10, -20)),
    ],
)
def test_signs_turn_axes_round(opened, bench, config, goals):
    head = opened(config)
    assert head.move(10 * STEP, 19.6 * STEP, wait=True) == (pytest.approx(10 * STEP), pytest.approx(20 * STEP))
    assert bench.unit.goals() == goals
    assert head.state().tilt == pytest.approx(20 * STEP)


@pytest.mark.parametrize(
    ("asked", "set_to"),
    [(None, 2897), (0.1, 111), (111.6 * STEP, 111), (58 * STEP, 58), (1e-9, 31), (1e9, 2897)],
)
def test_speeds_are_within_the_units_and_the_files_bounds(opened, bench, asked, set_to):
    # 149 degrees a second are 2897 steps; 0.1 rad/s is 111; 58 steps are 57.99... after the conversion.
    opened().move(STEP, STEP, speed=asked, wait=True)
    assert bench.unit.speed == {"P": set_to, "T": set_to}


def test_a_speed_cap_that_the_unit_cannot_keep_is_refused(opened, bench):
    for key, config, safety in (
        ("hardware.head", replace(CONFIG, speed_deg_s=0.5), {}),
        ("safety", CONFIG, {"speed_deg_s": 0.5}),
    ):
        with pytest.raises(ConfigError, match=rf"^{key}\.speed_deg_s: .* 1\.6 at least"):  # 31 steps/s
            opened(config, **safety)
        assert bench.port.closed
    opened(CONFIG, speed_deg_s=1.6)


def test_a_moves_error_is_raised_by_its_wait_or_by_the_next_call(opened, bench):
    head = opened()
    bench.unit.scripted = {f"PP{n}": [b"! Maximum allowable Pan position is 90\r\n"] for n in (100, 101)}
    with pytest.raises(DeviceError, match="PP100"):
        head.move(100 * STEP, 0.0, wait=True)
    head.state()
    head.move(101 * STEP, 0.0)
    assert "PP101" in fails(head.state)
    head.move(5 * STEP, 0.0, wait=True)


def test_halts_from_many_threads(opened, bench):
    head = opened()
    head.move(3000 * STEP, 0.0)
    threads = [threading.Thread(target=head.halt) for _ in range(5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(DEADLINE_S)
        assert not thread.is_alive()
    head.halt()
    assert not bench.unit.turning()


def test_a_signal_handler_may_halt_whatever_it_interrupts(watched, bench):
    head, link = watched
    halted = []

    def handler(*_):
        head.halt()
        halted.append(not bench.unit.turning())

    def interrupted_meanwhile():
        signal.pthread_kill(threading.main_thread().ident, signal.SIGUSR1)
        until_a_halt_waits(link)
        return b"* 0\r\n"

    before = signal.signal(signal.SIGUSR1, handler)
    try:
        bench.unit.scripted = {"TP": [interrupted_meanwhile]}
        bench.unit.stuck = True
        with pytest.raises(HaltedError):
            head.move(2000 * STEP, 0.0, wait=True)
        for _ in range(50):
            signal.raise_signal(signal.SIGUSR1)
            head.state()
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert all(halted)
    assert len(halted) >= 51


def test_a_halted_move_may_be_commanded_again(watched, bench):
    head, link = watched
    halts = threading.Thread(target=head.halt)

    def halted_meanwhile():
        halts.start()
        until_a_halt_waits(link)
        return b"*\r\n"

    bench.unit.scripted = {"PP2000": [halted_meanwhile]}
    with pytest.raises(HaltedError):
        head.move(2000 * STEP, 0.0, wait=True)
    halts.join(DEADLINE_S)
    head.move(2000 * STEP, 0.0, wait=True)
    assert head.state().pan == pytest.approx(2000 * STEP)


def test_a_closed_head_is_halted(opened, bench):
    head = opened()
    head.move(3000 * STEP, 0.0)
    head.close()
    assert bench.unit.heard[-1] == "H"
    assert bench.port.closed
    head.halt()


def test_closing_raises_in_a_move_that_waits(opened, bench):
    head = opened()
    bench.unit.stuck = True
    said = []
    thread = threading.Thread(target=lambda: said.append(fails(lambda: head.move(1.0, 0.0, wait=True))))
    thread.start()
    while not head.state().moving:
        pass
    head.close()
    thread.join(DEADLINE_S)
    assert said


def test_after_an_unplug_every_call_fails_and_the_position_is_not_lost(opened, bench):
    head = opened()
    head.move(3000 * STEP, 0.0)
    bench.port.broken = OSError(5, "Input/output error")
    for call in (lambda: head.move(0.0, 0.0, wait=True), head.state, head.halt, head.state):
        assert "is lost" in fails(call)
    head.close()
    bench.port.broken = None
    opened().move(STEP, 0.0, wait=True)


def limit_hit(bench):
    bench.unit.says_first = b"!P"


def stall(bench):
    bench.unit.stuck = True


def power_cycle(bench):
    bench.unit.echo = bench.unit.verbose = True


@pytest.mark.parametrize("event", [limit_hit, stall, power_cycle])
@pytest.mark.parametrize("stop_file", [False, True])
def test_a_lost_position_is_remembered_until_the_unit_was_reset(opened, bench, tmp_path, event, stop_file):
    """By every later program, which does not even open the port; beside the stop file, if there is one."""
    safety = {"stop_file": tmp_path / "run" / "stop" if stop_file else None}
    head = opened(CONFIG, **safety)
    head.move(1000 * STEP, 0.0)
    event(bench)
    said = fails(head.state)
    assert fails(head.state) == said
    head.halt()
    assert bench.unit.heard[-1] == "H"
    head.close()
    bench.unit.stuck = bench.unit.echo = bench.unit.verbose = False
    file = tmp_path / ("run/stop.PORT.position-lost" if stop_file else "cotarget/head.PORT.position-lost")
    assert file.read_text() == f"{said}\n"
    bench.unit.heard.clear()
    for port in ("PORT", "ANOTHER"):  # as an adapter that was replugged may have
        again = fails(lambda port=port: opened(replace(CONFIG, port=port), **safety))
        assert again.startswith(said)
        assert str(file) in again
    assert bench.unit.heard == []
    PositionLostMarker("PORT", safety["stop_file"]).forget()
    opened(CONFIG, **safety).state()


@pytest.mark.parametrize("when", ["PU", "TP"])
def test_a_position_that_is_lost_while_it_is_opened_is_remembered_too(opened, bench, when):
    bench.unit.scripted = {when: [b"!P* 2902\r\n" if when == "PU" else b"!P* 0\r\n"]}
    said = fails(opened)
    bench.unit.scripted = {}
    assert fails(opened).startswith(said)
