"""The driver of the PTU-D46 against the emulated unit, in real time over a paced pseudo-terminal and TCP."""

import contextlib
import math
import os
import select
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import serial

from cotarget.config import SafetyConfig
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.interlock import PositionLostMarker
from cotarget.drivers.link_errors import InUseError, LostError
from cotarget.drivers.ptu_d46 import D46Head
from cotarget.drivers.serial_line import SerialLine, open_port
from cotarget.emulators.ptu_d46.unit import D46_STOCK
from cotarget.errors import DeviceError
from tests.support.emulated_camera import DEADLINE_S
from tests.support.plants import D46Unit, fails, wait_for

pytestmark = pytest.mark.wire
STEP = math.radians(D46_STOCK.step / 3600)
# Issue 4's figure.
FROM_FAULT_TO_HALT = 0.5
LOADED_S = 2.0  # the same on a machine that does something else meanwhile: it did not hang


@contextlib.contextmanager
def opened(unit):
    with contextlib.closing(D46Head(unit.config, MonotonicClock())) as head:
        yield head


@pytest.fixture(autouse=True)
def state_home(monkeypatch, tmp_path):
    """What is remembered of units is forgotten after the test."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path


@pytest.fixture
def stock():
    with D46Unit() as unit:
        yield unit


def test_a_program_that_ends_stops_it(stock):
    program = (
        "from cotarget.drivers.clock import MonotonicClock; from cotarget.drivers.ptu_d46 import D46Head\n"
        "from cotarget.drivers.ptu_d46 import D46Settings\n"
        f"D46Head(D46Settings(port='{stock.config.port}'), MonotonicClock()).move(2.5, 0.0, speed=0.5)"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=DEADLINE_S)
    wait_for(lambda: not stock.turning())
    assert stock.pan.position() * STEP < 2.0


# Fault of the emulated unit, and a text of the error that it ends in; None where it is got over.
FAULTS = {
    "silence": "does not answer",
    "error-replies": "refused",
    "garbage": "",
    "late-replies": "",
    "limit-hit": "pan hit its limit",
    "unplugged": "is lost",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_halts_the_head_and_is_named(stock, fault):
    with opened(stock) as head:
        head.move(2.5, 0.0, speed=0.5)
        wait_for(stock.turning)
        stock.faults.set(fault)
        said = fails(head.state)
        assert FAULTS[fault] in said
        assert "\n" not in said
        assert stock.config.port in said
        if fault == "unplugged":  # no halt reaches it
            assert fails(head.halt) == fails(lambda: head.move(0.0, 0.0)) == said
            return
        wait_for(lambda: not stock.turning(), FROM_FAULT_TO_HALT + LOADED_S)
        assert stock.pan.position() * STEP < 2.0
        assert FAULTS[fault] in fails(lambda: head.move(0.0, 0.0))


def test_a_lost_tcp_line_is_an_error_and_cannot_be_opened_again():
    with D46Unit(tcp=True) as unit:
        with opened(unit) as head:
            unit.faults.set("unplugged")
            assert "is lost" in fails(head.state)
        assert unit.config.port in fails(lambda: D46Head(unit.config, MonotonicClock()))


@pytest.mark.slow
def test_a_power_cycle_ends_it_and_a_reset_mends_it(tmp_path):
    """The unit seeks its limits in a second or two."""
    with D46Unit(replace(D46_STOCK, reset_speed=30000, acceleration=100000, boot_s=0.2)) as unit:
        with opened(unit) as head:
            unit.faults.set("power-cycle")
            said = fails(head.state)
            assert "was switched off and on" in said or "does not answer any more" in said
        lost = PositionLostMarker(unit.config.port, None)
        lost.forget()
        again = lambda: D46Head(unit.config, MonotonicClock())  # noqa: E731
        wait_for(lambda: "is not calibrated" in fails(again))  # once it has started up
        lost.note(said)
        done = D46Head.reset(unit.config, MonotonicClock(), SafetyConfig(), lambda: None)
        assert "pan {} to {}".format(*D46_STOCK.pan) in done
        with opened(unit) as head:
            assert head.move(50 * STEP, 0.0, wait=True)[0] == pytest.approx(50 * STEP)


SIGNALS = (signal.SIGQUIT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP)


@pytest.mark.parametrize(
    ("how", "status"),
    [
        ("stop", 1),
        (signal.SIGINT, 130),
        *(pytest.param(number, 128 + number, marks=pytest.mark.slow) for number in SIGNALS),
    ],
)
def test_a_stop_or_signal_ends_a_reset(stock, state_home, how, status):
    """The emulated unit takes no command during its reset; the error says so at once."""
    rig = state_home / "rig.toml"
    rig.write_text(
        f"backend = 'hardware'\n[hardware.head]\nport = '{stock.config.port}'\n[safety]\nstop_file = 'stop'\n"
    )
    path = {"PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, "-m", "cotarget.cli", "reset-head", "--rig", rig, "--yes"]
    process = subprocess.Popen(command, env=os.environ | path, stderr=subprocess.PIPE, text=True)
    try:
        wait_for(stock.turning)
        if how == "stop":
            (state_home / "stop").touch()
        else:
            process.send_signal(how)
        _, said = process.communicate(timeout=DEADLINE_S)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == status
    assert "switch it off" in said
    assert "Traceback" not in said
    assert len(said.splitlines()) == 1 + (how == signal.SIGINT)
    assert ("emergency stop" in said) == (how == "stop")
    lost = PositionLostMarker(stock.config.port, state_home / "stop")
    with pytest.raises(DeviceError, match="has begun a reset that did not come to its end"):
        lost.refuse()


def test_two_programs_on_one_port(stock):
    with opened(stock), pytest.raises(InUseError):
        D46Head(stock.config, MonotonicClock())


@pytest.mark.parametrize("stuck", [False, True])
def test_a_write_that_was_suspended_does_not_lose_the_line_but_one_that_is_stuck_does(stuck):
    """Pyserial's time for a write goes on while the program is suspended, and runs out after the bytes are sent."""
    leader, follower = os.openpty()
    port = open_port(os.ttyname(follower), 9600)
    line, write = SerialLine(port, "LINE", 9600, MonotonicClock()), port.write

    def late(data):
        write(data)
        raise serial.SerialTimeoutException("Write timeout")

    if stuck:
        while select.select([], [port.fd], [], 0.3)[1]:  # until the line's buffer stays full
            with contextlib.suppress(BlockingIOError):
                os.write(port.fd, 4096 * b"x")
        with pytest.raises(LostError):
            line.write(b"x")
    else:
        port.write = late
        line.write(b"PP ")
        assert os.read(leader, 10) == b"PP "
    line.close()
    os.close(leader)
    os.close(follower)
