"""Signals that are deferred, and handlers that stay; whole programs are ended in tests/cli/test_signals_at_exit.py."""

import signal
import threading

import pytest

from cotarget.config import SafetyConfig
from cotarget.safety.signals import DeferredSignals, end_politely, guard_head
from tests.support.rigs import guarded
from tests.support.safety_rigs import RealDevices, SimulatedDevices


class Ended(BaseException):
    """What the handler of these tests raises."""


@pytest.fixture(autouse=True)
def handler():
    """A handler of SIGTERM for the length of a test."""

    def end(number, frame):
        raise Ended

    before = signal.signal(signal.SIGTERM, end)
    yield end
    signal.signal(signal.SIGTERM, before)


def test_other_threads_leave_signals_alone(handler):
    before = signal.getsignal(signal.SIGHUP)
    found = []

    def work():
        undo, deferred = end_politely(), DeferredSignals()
        deferred.defer()
        found.extend(signal.getsignal(number) for number in (signal.SIGHUP, signal.SIGTERM))
        deferred.restore()
        undo()

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [before, handler]


def test_a_handler_that_is_set_during_the_deferral_stays():
    deferred = DeferredSignals()
    deferred.defer()
    deferred.defer()  # once more changes nothing
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    deferred.restore()
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN


def test_handlers_of_the_program_stay(handler):
    undo = end_politely()
    assert signal.getsignal(signal.SIGTERM) is handler
    ours = signal.getsignal(signal.SIGHUP)
    assert ours is not signal.SIG_DFL
    signal.signal(signal.SIGHUP, handler)
    undo()
    assert signal.getsignal(signal.SIGHUP) is handler
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.mark.parametrize("halts", [True, False])
def test_a_signal_that_comes_while_the_rig_closes_is_delivered_when_it_is_closed(halts, caplog):
    """It ends the program, so an error of the device is logged."""
    devices = SimulatedDevices()
    devices.head.broken = 0 if halts else 100
    halt = devices.head.halt

    def interrupted_halt():
        signal.raise_signal(signal.SIGTERM)
        halt()

    devices.head.halt = interrupted_halt
    with pytest.raises(Ended), guarded(devices, SafetyConfig()):
        pass
    assert devices.closed
    assert ("the cable is out" in caplog.text) != halts


class Head:
    """A guarded head that logs its calls; a halt shows which heads refuse moves by then."""

    def __init__(self, log, in_main_thread):
        self.log, self.in_main_thread, self.refuses = log, in_main_thread, False

    def refuse(self, reason):
        self.refuses = True

    def stop(self, reason):
        self.log.append([head.refuses for head in HEADS])


HEADS = []


@pytest.mark.parametrize(("number", "refuse"), [
    (signal.SIGHUP, [True, True, True]),  # the program ends for certain: the heads of the main thread too
    (signal.SIGINT, [False, True, True]),
])  # fmt: skip
def test_all_heads_refuse_moves_before_one_is_halted(number, refuse):
    log = []
    HEADS[:] = [Head(log, True), Head(log, False), Head(log, False)]
    undo = [guard_head(head) for head in HEADS]
    try:
        with pytest.raises((SystemExit, KeyboardInterrupt)):
            signal.raise_signal(number)
    finally:
        for each in undo:
            each()
    assert log == [refuse, refuse]


def test_a_closed_rig_leaves_no_handler():
    before = signal.getsignal(signal.SIGINT)
    with guarded(RealDevices(), SafetyConfig()):
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before
