"""The PTU-D46 as a rig's head, with its thread; the unit and the time are simulated. Over the wire: test_d46_wire."""

import math
import signal
import threading
import time

import pytest
import serial

from cotarget.config import SafetyConfig
from cotarget.drivers.interlock import PositionLostMarker
from cotarget.drivers.polled_head import Move
from cotarget.drivers.ptu_d46 import D46Head, D46Settings
from cotarget.errors import ConfigError, DeviceError, HaltedError
from tests.support.d46_bench import CONFIG, Bench

STEP = math.radians(185.1428 / 3600)
CARELESS = SafetyConfig()
LIMITS_DEG = ((-158.91, 158.91), (-46.65, 31.06))  # 3090 and -907..604 steps of 185.1428 seconds of arc
DEADLINE_S = 10.0  # for a thread that should end at once; a machine may be busy


def until_halt_is_wished(head):
    """Hold the thread that talks to the unit until somebody's halt is in its queue."""
    deadline = time.monotonic() + DEADLINE_S
    while not head._loop.halts and time.monotonic() < deadline:
        time.sleep(0)


def for_ever(call):
    """Call until it fails."""
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        call()


@pytest.fixture
def bench():
    return Bench()


@pytest.fixture
def opened(bench, monkeypatch, tmp_path):
    """Open heads on the bench through pyserial's own function; what is remembered is forgotten after the test."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: bench.port)
    heads = []

    def open_head(config=CONFIG, safety=CARELESS):
        bench.port.closed = False
        heads.append(D46Head(config, bench.clock, safety))
        return heads[-1]

    yield open_head
    for head in heads:
        head.close()
    assert not any(thread.name.startswith("head at") for thread in threading.enumerate())


def test_limits_are_the_units_in_the_sense_of_the_file(opened, bench):
    limits = opened().limits
    for own, expected in zip((limits.pan, limits.tilt), LIMITS_DEG, strict=True):
        assert [math.degrees(v) for v in own] == pytest.approx(expected, abs=0.01)
    assert limits.step == pytest.approx(STEP)
    assert math.degrees(limits.speed) == pytest.approx(149.0)
    assert limits.acceleration == pytest.approx(2000 * STEP)


def test_as_the_manual_has_it_a_unit_counts_to_the_left(opened, bench):
    """Positive pan of a PTU-D46 turns left, says its manual; that of a rig turns right. Tilt goes up for both."""
    head = opened(D46Settings(port="PORT"))
    head.move(10 * STEP, 20 * STEP, wait=True)
    assert bench.unit.goals() == (-10, 20)


def test_signs_turn_axes_round(opened, bench):
    config = D46Settings(port="PORT", pan_sign=-1, tilt_sign=-1, tilt_deg=(-31.1, 46.6))
    head = opened(config)
    assert math.degrees(head.limits.tilt[1]) == pytest.approx(46.65, abs=0.01)
    pan, tilt = head.move(10 * STEP, 20.4 * STEP, wait=True)
    assert (pan, tilt) == (pytest.approx(10 * STEP), pytest.approx(20 * STEP))
    assert bench.unit.goals() == (-10, -20)
    assert head.state().tilt == pytest.approx(20 * STEP)


def test_what_is_really_commanded_is_returned(opened, bench):
    head = opened()
    assert head.move(99.0, -99.0) == (pytest.approx(3090 * STEP), pytest.approx(-907 * STEP))
    assert head.state().moving
    assert head.move(0.51 * STEP, -1.6 * STEP, wait=True) == (pytest.approx(STEP), pytest.approx(-2 * STEP))
    state = head.state()
    assert not state.moving
    assert (state.pan, state.tilt) == (pytest.approx(STEP), pytest.approx(-2 * STEP))


@pytest.mark.parametrize(
    ("asked", "set_to"),
    [(None, 2897), (0.1, 111), (111.6 * STEP, 111), (112 * STEP, 112), (1e-9, 31), (1e9, 2897)],
)
def test_speeds_are_within_the_units_and_the_files_bounds(opened, bench, asked, set_to):
    # 149 degrees a second are 2897 steps; 0.1 rad/s is 111.
    opened().move(STEP, STEP, speed=asked, wait=True)
    assert bench.unit.speed == {"P": set_to, "T": set_to}


SLOW = "0.5 degrees/s is slower than the unit at PORT can turn; it takes 1.6 at least"  # 31 steps/s


@pytest.mark.parametrize(
    ("config", "safety", "key"),
    [
        (D46Settings(**{**vars(CONFIG), "speed_deg_s": 0.5}), SafetyConfig(), "hardware.head"),
        (CONFIG, SafetyConfig(speed_deg_s=0.5), "safety"),
    ],
)
def test_a_speed_cap_that_the_unit_cannot_keep_is_refused(opened, bench, config, safety, key):
    with pytest.raises(ConfigError) as caught:
        opened(config, safety)
    assert str(caught.value) == f"{key}.speed_deg_s: {SLOW}"
    assert bench.port.closed
    opened(CONFIG, SafetyConfig(speed_deg_s=1.6))


@pytest.mark.parametrize("values", [(math.nan, 0.0, None), (0.0, math.inf, None), (0.0, 0.0, 0.0), (0, 0, math.nan)])
def test_what_is_no_number_is_refused(opened, bench, values):
    head = opened()
    with pytest.raises(DeviceError, match="the head cannot"):
        head.move(*values)
    assert bench.unit.goals() == (0, 0)


def test_it_moves_from_the_moment_of_the_command(opened):
    head = opened()
    for n in range(1, 20):
        head.move(n * 50 * STEP, 0.0)
        assert head.state().moving


def test_the_error_of_a_move_comes_with_the_next_call(opened, bench):
    head = opened()
    bench.unit.scripted = {"PP100": [b"! Maximum allowable Pan position is 90\r\n"]}
    with pytest.raises(DeviceError, match="refused PP100"):
        head.move(100 * STEP, 0.0, wait=True)
    head.state()
    bench.unit.scripted = {"PP101": [b"! Maximum allowable Pan position is 90\r\n"]}
    head.move(101 * STEP, 0.0)
    with pytest.raises(DeviceError, match="refused PP101"):
        for_ever(head.state)
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


def test_halts_at_once_let_no_older_move_through(opened, bench):
    """One thread has taken its halt's number; before it goes on, another takes a move's and halts too."""
    head = opened()
    numbers, stale = head._numbers, []

    class Interrupted:
        def __next__(self):
            head._numbers, number = numbers, next(numbers)
            stale.append(Move(next(numbers), (3000, 0), (1000, 1000)))
            head.halt()
            return number

    head._numbers = Interrupted()
    head.halt()
    head._loop.moves.append(stale[0])
    assert stale[0].done.wait(20.0)
    assert str(stale[0].error) == "the move was halted"
    assert bench.unit.goals() == (0, 0)


def test_a_signal_handler_may_halt_whatever_it_interrupts(opened, bench):
    head = opened()
    halted = []

    def handler(*_):
        head.halt()
        halted.append(not bench.unit.turning())

    def interrupted_meanwhile():
        signal.pthread_kill(threading.main_thread().ident, signal.SIGUSR1)
        until_halt_is_wished(head)
        return b"* 0\r\n"

    before = signal.signal(signal.SIGUSR1, handler)
    try:
        bench.unit.scripted = {"TP": [interrupted_meanwhile]}
        bench.unit.stuck = True
        with pytest.raises(HaltedError, match="the move was halted"):
            head.move(2000 * STEP, 0.0, wait=True)
        for _ in range(50):
            signal.raise_signal(signal.SIGUSR1)
            head.state()
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert all(halted)
    assert len(halted) >= 51


def test_who_waits_for_a_move_that_is_halted_may_command_it_again(opened, bench):
    head = opened()
    halts = threading.Thread(target=head.halt)

    def halted_meanwhile():
        halts.start()
        until_halt_is_wished(head)
        return b"*\r\n"

    bench.unit.scripted = {"PP2000": [halted_meanwhile]}
    with pytest.raises(HaltedError, match="the move was halted"):
        head.move(2000 * STEP, 0.0, wait=True)
    halts.join(DEADLINE_S)
    head.move(2000 * STEP, 0.0, wait=True)
    assert head.state().pan == pytest.approx(2000 * STEP)


def test_a_closed_head_is_halted_and_says_so(opened, bench):
    head = opened()
    head.move(3000 * STEP, 0.0)
    head.close()
    assert bench.unit.heard[-1] == "H"
    assert bench.port.closed
    head.close()
    head.halt()
    with pytest.raises(DeviceError, match="the pan-tilt unit at PORT is closed"):
        head.state()


def test_after_an_unplug_every_call_fails(opened, bench):
    head = opened()
    head.move(3000 * STEP, 0.0)
    bench.port.broken = OSError(5, "Input/output error")
    for call in (lambda: head.move(0.0, 0.0, wait=True), head.state, head.halt, head.state):
        with pytest.raises(DeviceError, match="the line to the pan-tilt unit at PORT is lost"):
            for_ever(call)
    head.close()


def test_after_a_limit_hit_every_call_but_halt_fails(opened, bench):
    head = opened()
    bench.unit.says_first = b"!P"
    for _ in range(3):
        with pytest.raises(DeviceError, match=r"pan hit its limit \(!P\): it was halted"):
            for_ever(head.state)
    head.halt()
    assert bench.unit.heard[-1] == "H"


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
    safety = SafetyConfig(stop_file=tmp_path / "run" / "stop" if stop_file else None)
    head = opened(CONFIG, safety)
    head.move(1000 * STEP, 0.0)
    event(bench)
    with pytest.raises(DeviceError) as caught:
        for_ever(head.state)
    head.close()
    bench.unit.stuck = bench.unit.echo = bench.unit.verbose = False
    file = tmp_path / ("run/stop.PORT.position-lost" if stop_file else "cotarget/head.PORT.position-lost")
    assert file.read_text() == f"{caught.value}\n"
    bench.unit.heard.clear()
    for port in ("PORT", "ANOTHER"):  # as an adapter that was replugged may have
        with pytest.raises(DeviceError) as again:
            opened(D46Settings(**{**vars(CONFIG), "port": port}), safety)
        assert str(again.value) == f"{caught.value} (or, where no unit is at that port any more, remove {file})"
    assert bench.unit.heard == []
    PositionLostMarker("PORT", safety.stop_file).forget()
    opened(CONFIG, safety).state()


@pytest.mark.parametrize("when", ["PU", "TP"])
def test_a_position_that_is_lost_while_it_is_opened_is_remembered_too(opened, bench, when):
    bench.unit.scripted = {when: [b"!P* 2902\r\n" if when == "PU" else b"!P* 0\r\n"]}
    with pytest.raises(DeviceError, match="pan hit its limit"):
        opened()
    bench.unit.scripted = {}
    with pytest.raises(DeviceError, match=r"pan hit its limit .* remove"):
        opened()


def test_what_leaves_the_position_known_is_not_remembered(opened, bench):
    head = opened()
    bench.port.broken = OSError(5, "Input/output error")
    with pytest.raises(DeviceError, match="is lost"):
        for_ever(head.state)
    head.close()
    bench.port.broken = None
    opened().move(STEP, 0.0, wait=True)


def test_who_waits_is_told_of_the_end(opened, bench):
    head = opened()
    bench.unit.stuck = True
    failure = []

    def wait():
        try:
            head.move(1.0, 0.0, wait=True)
        except DeviceError as error:
            failure.append(str(error))

    thread = threading.Thread(target=wait)
    thread.start()
    while not head.state().moving:
        pass
    head.close()
    thread.join(10.0)
    assert failure


def test_a_failed_opening_releases_the_port(opened, bench):
    bench.unit.facts["PX"] = 100
    with pytest.raises(ConfigError):
        opened()
    assert bench.port.closed


def test_a_mistake_in_the_driver_halts_too(opened, bench):
    head = opened()
    head.move(3000 * STEP, 0.0)
    head._loop.turn = lambda: 1 / 0
    with pytest.raises(DeviceError, match="the driver of the pan-tilt unit failed: ZeroDivisionError"):
        for_ever(head.state)
    head.halt()
    assert bench.unit.heard[-1] == "H"
    assert not bench.unit.turning()
