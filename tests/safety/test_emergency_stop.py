"""The emergency stop: in one process, from any thread, and across processes by the stop file."""

import logging
import math
import threading
import time

import pytest

from cotarget.config import SafetyConfig
from cotarget.errors import DeviceError, EmergencyStopError
from cotarget.safety.stop_file import clear_stop_file, write_stop_file
from tests.support.rigs import guarded
from tests.support.safety_rigs import RealDevices, SimulatedDevices

FAR = math.radians(100)
DEADLINE_S = 10.0  # for a thread that should end at once; a machine may be busy


@pytest.fixture
def rig():
    return SimulatedDevices()


@pytest.fixture
def file(tmp_path):
    return tmp_path / "stop"


def commands(rig):
    return [what for what, _ in rig.head.log]


def test_a_stopped_head_does_not_move_until_it_is_cleared(rig):
    with guarded(rig, SafetyConfig()) as safe:
        safe.head.move(FAR, 0.0)
        safe.stop("somebody is on the roof")
        assert safe.stopped == "somebody is on the roof"
        for _ in range(3):
            with pytest.raises(EmergencyStopError, match="somebody is on the roof"):
                safe.head.move(0.1, 0.0)
            safe.clock.sleep_until(safe.clock.now() + 10.0)
        assert commands(rig) == ["move", "halt"]
        assert not safe.head.state().moving  # it can be looked at, and through
        assert safe.fixed.read().t == safe.clock.now()
        safe.head.halt()
        assert safe.clear() == "somebody is on the roof"
        assert safe.stopped is None
        safe.head.move(0.1, 0.0)
    assert commands(rig) == ["move", "halt", "halt", "move", "halt"]


def test_a_stop_outlasts_a_halt_that_fails(rig, caplog):
    rig.head.broken = 1
    with guarded(rig, SafetyConfig()) as safe:
        safe.head.move(FAR, 0.0)
        safe.stop("smoke")
        assert "the cable is out" in caplog.text
        with pytest.raises(EmergencyStopError, match="smoke"):
            safe.head.move(0.1, 0.0)
        assert commands(rig) == ["move", "halt"]


def test_a_stop_during_a_command_halts_again_after_it():
    """Another thread or a signal handler stops during the device's call."""
    rig = RealDevices()
    with guarded(rig, SafetyConfig()) as safe:
        rig.head.hang = lambda: safe.stop("smoke")
        with pytest.raises(EmergencyStopError, match="smoke"):
            safe.head.move(0.5, 0.0)
        assert rig.head.log == ["move", "halt", "moved", "halt"]


@pytest.mark.parametrize(("raised", "seen"), [
    (DeviceError, EmergencyStopError),  # a driver's, that the move was halted
    (KeyboardInterrupt, KeyboardInterrupt),
])  # fmt: skip
def test_a_command_that_a_stop_interrupts_raises_the_stop_but_hides_no_ctrl_c(raised, seen):
    rig = RealDevices()
    with guarded(rig, SafetyConfig()) as safe:

        def hang():
            safe.stop("smoke")
            raise raised("the move was halted")

        rig.head.hang = hang
        with pytest.raises(seen):
            safe.head.move(0.5, 0.0, wait=True)
        assert rig.head.log == ["move", "halt", "halt"]


def test_the_file_stops_every_command_until_it_is_removed(rig, file):
    with guarded(rig, SafetyConfig(stop_file=file)) as safe:
        safe.head.move(FAR, 0.0)
        write_stop_file(file, "somebody is on the roof")
        assert safe.stopped == "somebody is on the roof"
        for _ in range(2):
            with pytest.raises(EmergencyStopError, match="somebody is on the roof") as caught:
                safe.head.move(0.1, 0.0)
        assert str(file) in str(caught.value)
        assert "cotarget clear" in str(caught.value)
        assert "\n" not in str(caught.value)
        with pytest.raises(EmergencyStopError):
            safe.clear()
        assert commands(rig) == ["move", "halt"]
        assert clear_stop_file(file) == "somebody is on the roof"
        safe.head.move(0.1, 0.0)
    assert commands(rig) == ["move", "halt", "move", "halt"]


def test_reading_a_frame_in_simulated_time_reads_the_file(rig, file):
    with guarded(rig, SafetyConfig(stop_file=file)) as safe:
        safe.head.move(FAR, 0.0)
        file.touch()
        safe.fixed.read()
        assert commands(rig) == ["move", "halt"]


def test_a_rig_is_not_opened_while_there_is_a_stop_file(rig, file):
    write_stop_file(file, "smoke")
    with pytest.raises(EmergencyStopError, match="smoke"):
        guarded(rig, SafetyConfig(stop_file=file))
    assert rig.closed
    assert not rig.head.log


@pytest.mark.wire
def test_the_file_halts_a_moving_head_while_the_program_does_nothing(file):
    rig = RealDevices()
    with guarded(rig, SafetyConfig(stop_file=file, watchdog_s=1000.0)) as safe:
        safe.head.move(0.5, 0.0)
        begun = time.monotonic()
        write_stop_file(file, "smoke")
        rig.head.wait_for_halt()
        print(f"halted {1000 * (time.monotonic() - begun):.0f} ms after the file was made")
        with pytest.raises(EmergencyStopError, match="smoke"):
            safe.head.move(0.5, 0.0)
        assert rig.head.log == ["move", "moved", "halt"]


@pytest.mark.wire
def test_no_command_follows_a_stop_from_another_thread():
    """However commands and stops interleave, the last call on the head is a halt."""
    for _ in range(50):
        rig = RealDevices()
        with guarded(rig, SafetyConfig()) as safe:
            ready = threading.Barrier(3)

            def command(safe=safe, ready=ready):
                ready.wait(DEADLINE_S)
                for _ in range(20):
                    try:
                        safe.head.move(0.5, 0.0)
                    except EmergencyStopError:
                        return

            def stop(safe=safe, ready=ready):
                ready.wait(DEADLINE_S)
                safe.stop("smoke")

            threads = [threading.Thread(target=target) for target in (command, command, stop)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(DEADLINE_S)
                assert not thread.is_alive()
            log = list(rig.head.log)
            with pytest.raises(EmergencyStopError):
                safe.head.move(0.5, 0.0)
            assert rig.head.log == log
            assert log[-1] == "halt"


def test_a_stop_is_logged_once(rig, file, caplog):
    with guarded(rig, SafetyConfig(stop_file=file)) as safe:
        write_stop_file(file, "smoke")
        for _ in range(3):
            safe.fixed.read()
    stops = [r for r in caplog.records if r.levelno == logging.WARNING]
    assert [r.getMessage() for r in stops] == ["emergency stop: smoke"]
