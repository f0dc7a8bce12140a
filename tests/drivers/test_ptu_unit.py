"""Getting to know a PTU-D46, or what else is at the port; in simulated time."""

import math
from dataclasses import replace

import pytest
import serial

from cotarget.drivers.ptu_d46 import D46Head, UncalibratedError, probe
from cotarget.drivers.ptu_protocol import open_line
from cotarget.errors import ConfigError, DeviceError
from tests.support.d46_bench import CONFIG, Bench
from tests.support.d46_peer import BANNER, VERSION
from tests.support.simulated_clock import SimClock

# What may be sent while nobody moves the head: nothing that moves it, or wears its memory.
HARMLESS = {"ED", "FT", "E", "F", "V", "WP", "C", "CI", "I", "H", "PP", "TP"}
HARMLESS |= {axis + what for axis in "PT" for what in "RNXLUA"}


@pytest.fixture
def bench():
    return Bench()


@pytest.fixture
def opened(bench, monkeypatch):
    """pyserial opens the bench's port."""
    monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: bench.port)
    return bench


@pytest.mark.parametrize("echo", [True, False])
@pytest.mark.parametrize("verbose", [True, False])
def test_the_units_manner_is_learnt(echo, verbose):
    bench = Bench(echo, verbose)
    facts = bench.connect()
    assert facts.version == VERSION
    assert facts.mode == "H"
    assert (facts.pan.lowest, facts.pan.highest, facts.tilt.lowest, facts.tilt.highest) == (-3090, 3090, -907, 604)
    assert (facts.pan.slowest, facts.pan.fastest, facts.pan.acceleration) == (31, 2902, 2000)
    assert math.degrees(facts.pan.step) * 3600 == pytest.approx(185.1428, rel=1e-12)
    assert not bench.unit.echo
    assert not bench.unit.verbose


def test_opening_moves_nothing(bench):
    bench.start()
    assert set(bench.unit.heard) <= HARMLESS
    assert bench.unit.goals() == (0, 0)


def test_a_unit_left_turning_is_halted(bench):
    bench.unit.way["P"] = (bench.clock.now(), 0, 3000)
    bench.start()
    assert not bench.unit.turning()


def test_a_leading_line_feed_and_what_was_left_in_the_line_do_no_harm(bench):
    bench.port.inject(b"\n* 23\r\n* 17\r\n!P")
    answer = bench.unit.answer
    bench.unit.answer = lambda order: b"\n" + answer(order)
    bench.start()
    assert bench.loop.snapshot.pan == 0


def test_velocity_mode_is_left(bench):
    bench.unit.velocity = True
    bench.connect()
    assert "CI" in bench.unit.heard


def test_old_firmware_has_no_modes_and_may_not_know_its_step_mode(bench):
    bench.unit.scripted = {"C": [b"! Illegal argument\r\n"], "WP": [b"! Illegal argument\r\n"]}
    assert bench.connect().mode == ""
    assert "CI" not in bench.unit.heard


MISMATCHES = [
    ({"PX": 2000}, {}, r"hardware.head.pan_deg: the unit at PORT goes from -158.9 to 102.9 degrees, not from -158.9"),
    ({"PX": 2000}, {}, r"to 158.9; write pan_deg = \[-158.9, 102.9\]$"),
    ({}, {"tilt_sign": -1}, r"tilt_deg = \[-31.1, 46.6\], or tilt_sign = 1$"),
    ({"TN": -600, "TX": 907}, {}, r"tilt_deg = \[-30.9, 46.6\], or tilt_sign = -1$"),
    ({"PR": "92.5714"}, {}, r"hardware.head.step_deg: the pan of the unit at PORT has steps of 0.0257143 degrees, not"),
    ({"TR": "46.2857"}, {}, r"step_deg: the tilt of .* write step_deg = 0.0128571, or change the unit's step mode$"),
]


@pytest.mark.parametrize(("facts", "config", "said"), MISMATCHES)
def test_another_unit_than_configured_is_refused(opened, facts, config, said):
    opened.unit.facts |= facts
    with pytest.raises(ConfigError, match=said):
        D46Head(replace(CONFIG, **config), opened.clock)
    assert set(opened.unit.heard) <= HARMLESS
    assert opened.port.closed


def test_limits_differ_a_little_from_unit_to_unit(opened):
    opened.unit.facts |= {"PX": 3091, "TN": -903, "TX": 601}
    D46Head(CONFIG, opened.clock).close()


def test_an_uncalibrated_unit_waits_for_an_operator(bench):
    bench.unit.facts |= {"TN": 0, "TX": 0}
    with pytest.raises(
        DeviceError, match="is not calibrated: its tilt goes from 0 to 0; clear its way and run cotarget"
    ):
        bench.connect()
    assert "R" not in bench.unit.heard


def test_nothing_answers(bench):
    bench.unit.receive = lambda data: b""
    with pytest.raises(DeviceError, match=r"nothing answers at PORT: is the pan-tilt unit .* at 9600 baud\?"):
        bench.connect()


@pytest.mark.parametrize("says", [b"ERROR\r\n", b"\xff\x00\x13", b"*\r\n", b"!\r\n", b"* 5\r\n", b"login: "])
def test_something_else_answers(bench, says):
    bench.unit.receive = lambda data: says
    with pytest.raises(DeviceError, match="what answers at PORT is no PTU-D46 that speaks at 9600 baud: it says '"):
        bench.connect()


def test_something_else_talks_without_end(bench):
    bench.port.inject(b"$GPGGA,123519,4807.038,N\r\n" * 2000)
    bench.unit.receive = lambda data: b""
    with pytest.raises(DeviceError, match=r"is no PTU-D46 .*GPGGA"):
        bench.connect()


def test_a_unit_that_starts_up_is_told(bench):
    bench.port.inject(BANNER + b"!T!T")
    bench.unit.receive = lambda data: b""
    with pytest.raises(DeviceError, match="at PORT is starting up; try again when it has come to rest"):
        bench.connect()


def test_a_look_at_a_unit_changes_nothing(opened, monkeypatch):
    monkeypatch.setattr("cotarget.drivers.ptu_d46.MonotonicClock", lambda: opened.clock)
    assert probe("PORT", 9600) == f"{VERSION}, unit 0"
    assert opened.unit.heard == ["V", "U", "PN", "PX", "TN", "TX"]
    assert opened.unit.echo
    assert opened.port.closed
    opened.unit.receive = lambda data: b""
    with pytest.raises(DeviceError, match="nothing answers at PORT"):
        probe("PORT", 9600)


def test_a_look_at_a_unit_that_has_not_found_its_limits(opened, monkeypatch):
    monkeypatch.setattr("cotarget.drivers.ptu_d46.MonotonicClock", lambda: opened.clock)
    opened.unit.facts |= {"TN": 0, "TX": 0}
    with pytest.raises(UncalibratedError, match="its tilt goes from 0 to 0"):
        probe("PORT", 9600)


EVENTS = {"P": "pan hit its limit", "T": "tilt hit its limit", "D": "its cable came off"}


@pytest.mark.parametrize("axis", EVENTS)
@pytest.mark.parametrize("order", ["V", "PU", "H", "C"])
def test_what_happens_while_it_is_opened_is_not_overheard(bench, axis, order):
    """Inside an answer after the greeting; only what was said before that may be left from long ago."""
    bench.unit.scripted = {order: [f"!{axis}*{' 2902' if order == 'PU' else ''}\r\n".encode()]}
    with pytest.raises(DeviceError, match=rf"reports that {EVENTS[axis]} \(!{axis}\): it was halted, and its position"):
        bench.connect()
    assert bench.unit.heard[-1] in ("H", "I", "C", "CI")


def test_a_byte_of_noise_at_the_unit_does_not_keep_it_from_being_halted(bench):
    """It hears "xH", or with a delimiter in front of the halt "x" and "H"."""
    bench.unit.way["P"] = (bench.clock.now(), 0, 3000)
    bench.unit.scripted = {noise: [b"! Illegal argument\r\n"] for noise in ("x", "xH")}
    last = bench.unit.obey

    def obey(order):
        if order == "TA":  # the last question before the halt
            bench.unit.noise = b"x"
        return last(order)

    bench.unit.obey = obey
    bench.connect()
    assert not bench.unit.turning()


def test_no_port_is_named():
    with pytest.raises(ConfigError, match=r"hardware.head.port: names no port, such as /dev/ttyUSB0 or socket://host"):
        open_line("", 9600, SimClock())


CANNOT_OPEN = [
    (
        serial.SerialException(2, "could not open port"),
        "there is no port PORT for the pan-tilt unit; serial ports here:",
    ),
    (serial.SerialException(13, "could not open port"), "no permission to use PORT; add yourself to the group"),
    (serial.SerialException(11, "could not lock"), "PORT is in use by another program"),
    (serial.SerialException("Could not configure port"), "cannot open PORT as a serial port: Could not configure"),
    (ValueError("invalid URL"), "cannot open PORT as a serial port: invalid URL"),
]


@pytest.mark.parametrize(("error", "said"), CANNOT_OPEN)
def test_ports_that_cannot_be_opened(monkeypatch, error, said):
    def refuse(*_, **__):
        raise error

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(DeviceError, match=said):
        open_line("PORT", 9600, SimClock())
