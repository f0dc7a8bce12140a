"""The driver of the PTU-D46 in simulated time: opening a unit, moving it, and every fault of unit and line."""

import contextlib
import itertools
import math
import random
from dataclasses import replace

import pytest
import serial

from cotarget.drivers.link_errors import (
    InUseError,
    LostError,
    NoPermissionError,
    PositionLostError,
    RefusedError,
    SilentError,
)
from cotarget.drivers.ptu_d46 import D46Head, D46Settings, UncalibratedError
from cotarget.drivers.ptu_protocol import open_line
from cotarget.errors import ConfigError, DeviceError
from tests.support.d46_peer import BANNER, CONFIG, VERSION, Bench
from tests.support.simulated_clock import SimClock

BYTE = 10 / 9600
STEP = math.radians(185.1428 / 3600)
FROM_FAULT_TO_HALT = 0.5  # issue 4's figure [s]
# Commands that neither move the head nor wear its memory.
HARMLESS = {"ED", "FT", "E", "F", "V", "WP", "C", "CI", "I", "H", "PP", "TP"}
HARMLESS |= {axis + what for axis in "PT" for what in "RNXLUA"}


@pytest.fixture
def bench():
    return Bench()


@pytest.fixture
def opened(bench, monkeypatch):
    """pyserial opens the bench's port."""
    monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: bench.port)
    monkeypatch.setattr("cotarget.drivers.ptu_d46.MonotonicClock", lambda: bench.clock)
    return bench


# Ports


@pytest.mark.parametrize(("port", "exclusive"), [("/dev/ttyUSB0", True), ("socket://host:4000", None)])
def test_a_port_is_opened_with_time_limits_and_a_device_for_one_program(monkeypatch, port, exclusive):
    options = {}
    monkeypatch.setattr(serial, "serial_for_url", lambda name, **given: options.update(given))
    open_line(port, 9600, SimClock())
    assert options["exclusive"] is exclusive
    assert 0 < options["timeout"] < FROM_FAULT_TO_HALT
    assert 0 < options["write_timeout"] <= FROM_FAULT_TO_HALT


# Ports that cannot be opened: what pyserial raises, None for the real port's; the kind and a text of the error, which
# also names the port.
CANNOT_OPEN = [
    ("", None, ConfigError, r"^hardware\.head\.port: "),
    ("PORT", serial.SerialException(13, "could not open port"), NoPermissionError, "group"),
    ("PORT", serial.SerialException(11, "could not lock"), InUseError, "another program"),
    ("FOLDER", None, DeviceError, "cannot open"),
    ("FOLDER/missing", None, DeviceError, "serial ports here:"),
    ("socket://127.0.0.1:1", None, DeviceError, "cannot connect"),
    ("socket://no.such.host.invalid:4000", None, DeviceError, "cannot connect"),
    ("socket://127.0.0.1", None, DeviceError, "hardware.head.port: .*write socket://HOST:PORT"),
    ("socket://terminal:four", None, DeviceError, "hardware.head.port: .*write socket://HOST:PORT"),
    ("sockt://a:1", None, DeviceError, "invalid URL"),
]


@pytest.mark.parametrize(("port", "error", "kind", "said"), CANNOT_OPEN)
def test_ports_that_cannot_be_opened(monkeypatch, tmp_path, port, error, kind, said):
    def refuse(*_, **__):
        raise error

    if error:
        monkeypatch.setattr(serial, "serial_for_url", refuse)
    port = port.replace("FOLDER", str(tmp_path))
    with pytest.raises(kind, match=said) as caught:
        open_line(port, 9600, SimClock())
    assert port in str(caught.value)


# Opening


@pytest.mark.parametrize(("echo", "verbose"), list(itertools.product([True, False], repeat=2)))
def test_a_unit_is_identified_in_any_manner(echo, verbose):
    bench = Bench(echo, verbose)
    facts = bench.connect()
    assert (facts.version, facts.mode) == (VERSION, "H")
    assert facts.limits == (-3090, 3090, -907, 604)
    assert (facts.pan.slowest, facts.pan.fastest, facts.pan.acceleration) == (31, 2902, 2000)
    assert math.degrees(facts.pan.unit) * 3600 == pytest.approx(185.1428, rel=1e-12)
    assert (bench.unit.echo, bench.unit.verbose) == (False, False)
    assert set(bench.unit.heard) <= HARMLESS
    assert bench.unit.goals() == (0, 0)


def test_a_leading_line_feed_and_what_was_left_in_the_line_do_no_harm(bench):
    bench.port.inject(b"\n* 23\r\n* 17\r\n!P")
    answer = bench.unit.answer
    bench.unit.answer = lambda order: b"\n" + answer(order)
    bench.start()
    assert bench.loop.snapshot.positions[0] == 0


def test_velocity_mode_is_left_and_old_firmware_has_no_modes(bench):
    bench.unit.velocity = True
    bench.connect()
    assert "CI" in bench.unit.heard
    old = Bench()
    old.unit.scripted = {"C": [b"! Illegal argument\r\n"], "WP": [b"! Illegal argument\r\n"]}
    assert old.connect().mode == ""
    assert "CI" not in old.unit.heard


@pytest.mark.parametrize(
    ("facts", "config", "said"),
    [
        ({"PX": 2000}, {}, r"^hardware.head.pan_deg: .* write pan_deg = \[-158.9, 102.9\]$"),
        ({}, {"tilt_sign": -1}, r"^hardware.head.tilt_deg: .*\[-31.1, 46.6\], or tilt_sign = 1$"),
        ({"TN": -600, "TX": 907}, {}, r"^hardware.head.tilt_deg: .*\[-30.9, 46.6\], or tilt_sign = -1$"),
        (
            {"PR": "92.5714"},
            {},
            r"^hardware.head.step_deg: pan .* write step_deg = \[0.0257143, 0.0514286\], or change",
        ),
        ({"TN": 0, "TX": 0}, {}, "cotarget reset-head"),
        (
            {"TR": "46.2857"},
            {},
            r"^hardware.head.step_deg: pan .* write step_deg = \[0.0514286, 0.0128571\], or change",
        ),
    ],
)
def test_another_unit_than_configured_is_refused_with_what_to_write(opened, facts, config, said):
    opened.unit.facts |= facts
    with pytest.raises((ConfigError, UncalibratedError), match=said):
        D46Head(replace(CONFIG, **config), opened.clock)
    assert set(opened.unit.heard) <= HARMLESS
    assert opened.port.closed


def test_limits_differ_a_little_from_unit_to_unit(opened):
    opened.unit.facts |= {"PX": 3091, "TN": -903, "TX": 601}
    D46Head(CONFIG, opened.clock).close()


STRANGERS = [b"ERROR\r\n", b"\xff\x00\x13", b"*\r\n", b"!\r\n", b"* 5\r\n", b"login: "]
# What is at the port, and a text of the error, which also names the port.
NO_UNITS = {
    "nothing": (lambda bench: setattr(bench.unit, "receive", lambda data: b""), "nothing answers at PORT.* 9600 baud"),
    "one that starts up": (lambda bench: mute(bench, BANNER + b"!T!T"), "PORT is starting up"),
    "one that talks without end": (lambda bench: mute(bench, b"$GPGGA,123519,4807.038,N\r\n" * 2000), "PORT.*GPGGA"),
    **{
        f"one that says {says!r}": (
            lambda bench, says=says: setattr(bench.unit, "receive", lambda data: says),
            "PORT.*baud: it says '",
        )
        for says in STRANGERS
    },
    "one without sense": (lambda bench: bench.unit.facts.update(PU=0), "speeds from 31 to 0"),
}


def mute(bench, says):
    bench.port.inject(says)
    bench.unit.receive = lambda data: b""


@pytest.mark.parametrize("what", NO_UNITS)
def test_a_port_without_a_usable_unit_is_an_error(bench, what):
    prepare, said = NO_UNITS[what]
    prepare(bench)
    with pytest.raises(DeviceError, match=said):
        bench.connect()
    assert "R" not in bench.unit.heard


EVENTS = {"P": "pan hit its limit", "T": "tilt hit its limit", "D": "its cable came off"}


@pytest.mark.parametrize("axis", EVENTS)
@pytest.mark.parametrize("order", ["V", "PU", "H", "C"])
def test_an_event_while_the_unit_is_opened_is_an_error(bench, axis, order):
    """Inside an answer after the greeting; only what was said before that may be left from long ago."""
    bench.unit.scripted = {order: [f"!{axis}*{' 2902' if order == 'PU' else ''}\r\n".encode()]}
    with pytest.raises(PositionLostError, match=EVENTS[axis]):
        bench.connect()
    assert "H" in bench.unit.heard


# A look at a unit


def test_a_probe_changes_nothing(opened):
    assert D46Head.probe(CONFIG) == f"{VERSION}, unit 0"
    assert opened.unit.heard == ["V", "U", "PN", "PX", "TN", "TX"]
    assert opened.unit.echo
    assert opened.port.closed


NO_PROBES = [
    ({"V": [b"*\r\n"]}, DeviceError),
    ({"V": [None]}, DeviceError),
    ({"TX": [b"* -907\r\n"]}, UncalibratedError),
]


@pytest.mark.parametrize(("answers", "kind"), NO_PROBES)
def test_a_probe_refuses_a_missing_or_uncalibrated_unit(opened, answers, kind):
    opened.unit.scripted = answers
    with pytest.raises(kind, match="PORT"):
        D46Head.probe(CONFIG)


# Positions


def test_a_position_is_dated_in_the_middle_of_the_units_pause(bench):
    """Between the command's last byte and the answer's first, which comes 20 ms later."""
    bench.start()
    bench.port.latency = 0.02
    (poll,) = bench.link.poll(bench.loop.requests)
    sent, order = bench.port.sent[-1]
    assert poll.t == pytest.approx(sent + len(order) * BYTE + 0.01, abs=BYTE / 10)


def test_a_snapshot_has_both_axes_at_one_time(bench):
    bench.start()
    bench.move(3000, -900, speed=1000)
    bench.until(lambda: bench.unit.position("T") < -100)
    pan, tilt = bench.unit.way["P"][0], bench.unit.way["T"][0]
    for _ in range(30):
        bench.loop.turn()
        seen = bench.loop.snapshot
        assert seen.positions[0] == pytest.approx((seen.t - pan) * 1000, abs=1.5)  # a step of rounding, and half of one
        assert seen.positions[1] == pytest.approx((tilt - seen.t) * 1000, abs=1.5)


# Moves


def test_a_move_is_speeds_then_positions_and_only_what_changed(bench):
    bench.start()
    bench.orders()
    for goals, speed, orders in (
        ((100, -50), 1000, ["PS1000", "TS1000", "PP100", "TP-50"]),
        ((200, -50), 1000, ["PP200"]),
        ((200, 0), 500, ["PS500", "TS500", "TP0"]),
    ):
        bench.until(bench.move(*goals, speed=speed).done.is_set)
        assert bench.orders() == orders


@pytest.mark.parametrize("delay", [0.0, 0.04])
def test_it_moves_from_the_command_until_it_stands_there(bench, delay):
    bench.unit.delay = delay
    bench.start()
    move = bench.move(300, 0)
    bench.loop.turn()
    while not move.done.is_set():
        assert bench.loop.snapshot.moving
        bench.loop.turn()
    assert move.error is None
    assert bench.unit.position("P") == 300
    seen = bench.loop.snapshot
    assert (seen.positions[0], seen.positions[1], seen.moving) == (300.0, 0.0, False)


def test_passing_the_goal_is_not_arriving(bench):
    bench.start()
    bench.move(1000, 0)
    bench.until(lambda: bench.unit.position("P") > 500)
    # The unit takes its time to turn round: it goes on through 600, and comes back.
    move = bench.move(600, 0)
    bench.loop.turn()
    bench.unit.way["P"] = (bench.clock.now(), bench.unit.position("P"), 1000)
    bench.until(lambda: bench.unit.position("P") == 1000)
    assert not move.done.is_set()
    bench.unit.way["P"] = (bench.clock.now(), 1000, 600)
    bench.until(move.done.is_set)
    assert bench.unit.position("P") == 600


def test_the_newest_move_wins_and_moves_without_end_leave_the_line_to_polls(bench):
    bench.start()
    bench.orders()
    moves = [bench.move(n, 0) for n in (10, 20, 30)]
    bench.until(moves[-1].done.is_set)
    assert [order for order in bench.orders() if order.startswith("PP")] == ["PP30"]
    assert [move.error is None for move in moves] == [False, False, True]
    assert not bench.loop.errors
    for n in range(200):
        bench.move(n, -n)
        bench.loop.turn()
    assert min(bench.unit.heard.count(order) for order in ("PP", "TP")) >= 40


@pytest.mark.parametrize(
    ("config", "goals"),
    [
        # Positive pan of a PTU-D46 turns left, says its manual; that of a rig turns right. Tilt goes up for both.
        (D46Settings(port="PORT"), (-10, 20)),
        (D46Settings(port="PORT", pan_sign=1), (10, 20)),
        (D46Settings(port="PORT", tilt_sign=-1, tilt_deg=(-31.1, 46.6)), (-10, -20)),
    ],
)
def test_signs_turn_axes_round(opened, config, goals):
    with contextlib.closing(D46Head(config, opened.clock)) as head:
        head.move(10 * STEP, 19.6 * STEP, wait=True)
        assert head.state().tilt == pytest.approx(20 * STEP)
    assert opened.unit.goals() == goals


def test_a_driver_that_slept_does_not_take_a_head_that_has_arrived_for_late(bench):
    bench.start()
    move = bench.move(500, 0, wait=True)
    bench.run(0.1)
    bench.clock.t += 10.0
    bench.until(move.done.is_set)
    assert move.error is None


# Halts


def turning(bench):
    bench.start()
    move = bench.move(3000, 0)
    bench.until(lambda: bench.unit.position("P") > 500)
    return move


def test_a_halt_comes_first_and_older_moves_are_not_sent(bench):
    bench.start()
    bench.orders()
    move = bench.move(1000, 0)
    request = bench.halt()
    bench.run(0.5)
    assert request.answered
    assert bench.orders() == ["H"]
    assert str(move.error) == "the move was halted"
    later = bench.move(100, 0)
    bench.until(later.done.is_set)
    assert later.error is None


def test_a_move_from_before_a_halt_does_not_take_the_place_of_one_from_after(bench):
    bench.start()
    stale = bench.move(1000, 0)
    bench.loop.requests.moves.clear()  # its thread was interrupted before it got there
    bench.halt()
    move = bench.move(500, 0)
    bench.run(0.2)
    bench.loop.requests.moves.append(stale)
    bench.until(stale.done.is_set)
    assert str(stale.error) == "the move was halted"
    bench.until(move.done.is_set)
    assert move.error is None


def test_after_a_halt_the_same_goal_is_sent_again(bench):
    move = turning(bench)
    request = bench.halt()
    assert bench.until(lambda: request.answered) < 0.02
    assert bench.loop.snapshot.moving
    bench.until(lambda: not bench.loop.snapshot.moving)
    assert str(move.error) == "the move was halted"
    assert bench.loop.snapshot.positions[0] == bench.unit.position("P")
    bench.orders()
    bench.until(bench.move(3000, 0).done.is_set)
    assert "PP3000" in bench.orders()


def test_a_halt_between_the_orders_of_a_move(bench):
    bench.start()
    bench.orders()
    bench.unit.scripted = {"PP1000": [lambda: bench.halt() and b"*\r\n"]}
    bench.move(1000, 500)
    bench.run(0.2)
    assert bench.orders() == ["PS1000", "TS1000", "PP1000", "H"]


@pytest.mark.parametrize("when", ["opened", "halted", "closed"])
def test_a_byte_of_noise_at_the_unit_does_not_keep_it_from_a_halt(bench, when):
    """It hears "xH", or with a delimiter in front of the halt "x" and "H"."""
    bench.unit.scripted = {noise: [b"! Illegal argument\r\n"] for noise in ("x", "xH")}
    if when == "opened":
        bench.unit.way["P"] = (bench.clock.now(), 0, 3000)  # it was left turning
        obey = bench.unit.obey

        def noisy(order):
            if order == "TA":  # the last question before the halt
                bench.unit.noise = b"x"
            return obey(order)

        bench.unit.obey = noisy
        bench.connect()
    else:
        turning(bench)
        bench.unit.noise = b"x"
        if when == "halted":
            request = bench.halt()
            bench.until(lambda: request.answered)
        else:
            bench.loop.stop_for_good(DeviceError("closed"))
            assert bench.loop.rests
    assert not bench.unit.turning()
    assert "xH" not in bench.unit.heard


def test_a_halt_does_not_wait_for_a_silent_unit(bench):
    bench.start()
    bench.unit.scripted = {"PP": [lambda: bench.halt() and None], "TP": [lambda: bench.halt() and None]}
    start = bench.clock.now()
    bench.run(0.1)
    when = next(t for t, data in bench.port.sent if t > start and b"H " in data)
    assert when - start < 0.1


# Faults


@pytest.mark.parametrize(
    "reply",
    [
        *(b"* 1", b"", b"*\r\n", b"\xf3\x10\x80", b"* 7 7\r\n", b"PP * 7\r\n", b"! Illegal\r\n"),
        b"\n" * 70,  # more lines than any answer comes after
    ],
)
def test_one_bad_answer_is_asked_for_again(bench, reply):
    bench.start()
    move = bench.move(1000, 0)
    bench.run(0.1)
    bench.unit.scripted = {"PP": [reply]}
    bench.until(move.done.is_set)
    assert move.error is None
    assert "H" not in bench.orders()[20:]
    assert bench.loop.snapshot.positions[0] == 1000


@pytest.mark.parametrize("late", [0.05, 0.2, 0.3, 0.5])
def test_a_late_answer_is_not_taken_for_another(bench, late):
    bench.start()
    bench.unit.scripted = {"PP": [lambda: bench.port.inject(b"* 2222\r\n", late)]}
    for _ in range(200):
        bench.loop.turn()
        # Late by less than a poll's deadline it is the answer, to the question that it answers.
        assert bench.loop.snapshot.positions[1] == 0
        assert bench.loop.snapshot.positions[0] == 0 or late < 0.1
    assert bench.loop.snapshot.positions[0] == 0


@pytest.mark.parametrize("newer", [False, True])
def test_an_order_whose_answer_was_lost_is_sent_again_unless_there_is_a_newer_one(bench, newer):
    bench.start()
    bench.orders()
    bench.unit.scripted = {"PP100": [lambda: (newer and bench.move(50, 0), b"")[1], None]}
    bench.move(100, 0)
    bench.run(1.0)
    sent = [order for order in bench.orders() if order.startswith("PP")]
    assert sent == ["PP100", "PP50"] if newer else ["PP100"] * 3
    assert bench.unit.position("P") == (50 if newer else 100)


def silent(bench):
    receive = bench.unit.receive
    bench.unit.receive = lambda data: receive(data) and b""  # it hears, but is not heard


def says(order, reply, count=1):
    return lambda bench: bench.unit.scripted.update({order: [reply] * count})


def refuses(bench):
    """Every command but a halt, after one answer that does not come."""
    answer, bench.unit.scripted = bench.unit.answer, {"TP": [None], "PP": [None]}
    bench.unit.answer = lambda order: (
        answer(order) if order == "H" or bench.unit.scripted.get(order) else b"! Illegal command\r\n"
    )


def power_cycled(bench):
    bench.unit.echo = bench.unit.verbose = True


def stuck(bench):
    bench.unit.stuck = True


def halved(bench, event):
    """Half of it comes between two answers, and half before the next."""
    bench.port.inject(event[:1])
    bench.clock.t += 2 * BYTE
    bench.unit.says_first = event[1:]


def unplugged(error):
    return lambda bench: setattr(bench.port, "broken", error)


# Fault while the head turns: what happens, the error that it ends in, and a text of that.
ENDS = {
    "silent": (silent, SilentError, "halt"),
    "refuses everything": (refuses, RefusedError, "Illegal command"),
    "answers something else": (says("TP", b"* 1 2\r\n", 10), DeviceError, "'1 2'"),
    "unplugged": (unplugged(OSError(5, "Input/output error")), LostError, "PORT"),
    "unplugged, says pyserial": (unplugged(serial.SerialException("device reports readiness")), LostError, "PORT"),
    "switched off and on": (power_cycled, PositionLostError, "cotarget reset-head"),
    "starts up": (lambda bench: bench.port.inject(BANNER), PositionLostError, "switched off and on"),
    **{
        f"starts up after {late} s": (
            lambda bench, late=late: (silent(bench), bench.port.inject(BANNER, late)),
            PositionLostError,
            "switched off and on",
        )
        for late in (0.1, 0.2, 0.3, 0.5)  # at other places of the attempts to synchronize
    },
    "!P in two halves": (
        lambda bench: halved(bench, b"!P"),
        PositionLostError,
        "pan hit its limit",
    ),
    "does not arrive": (stuck, PositionLostError, r"pan \d+, tilt 0, where 3000, 0"),
    **{
        f"!{axis} {how}": (act, PositionLostError, EVENTS[axis])
        for axis in EVENTS
        for how, act in (
            ("before an answer", lambda bench, axis=axis: setattr(bench.unit, "says_first", f"!{axis}".encode())),
            ("inside an answer", says("TP", f"* 1!{axis}2\r\n".encode())),
            ("alone", lambda bench, axis=axis: bench.port.inject(f"!{axis}".encode())),
        )
    },
}


@pytest.mark.parametrize("fault", ENDS)
def test_a_fatal_fault_is_named_and_halts_the_head(bench, fault):
    act, kind, said = ENDS[fault]
    move = turning(bench)
    move.wait = True
    act(bench)
    start = bench.clock.now()
    with pytest.raises(kind, match=said) as caught:
        bench.run(15.0)
    if fault == "silent":
        when = next(t for t, data in bench.port.sent if t > start and b"H " in data)
        assert when - start < FROM_FAULT_TO_HALT
        assert bench.clock.now() - start < 2.5
    bench.loop.stop_for_good(caught.value)
    assert move.error is caught.value
    assert "\n" not in str(caught.value)
    if kind is not LostError:
        assert bench.orders()[-1] == "H"
        assert bench.unit.way["P"][2] < 3000


def silent_for(bench, seconds):
    receive, back = bench.unit.receive, bench.clock.now() + seconds
    bench.unit.receive = lambda data: receive(data) if bench.clock.now() > back else receive(data) and b""


@pytest.mark.parametrize("wait", [True, False])
def test_a_unit_that_comes_back_was_halted_and_goes_on(bench, wait):
    bench.start()
    move = bench.move(3000, 0, wait=wait)
    bench.run(0.3)
    silent_for(bench, 0.7)
    bench.until(move.done.is_set)
    if wait:
        assert move.error is None
        assert bench.unit.position("P") == 3000
    else:  # a caller that does not wait sends a new command; an old one is not sent again after a silence
        assert "halted" in str(move.error)
        assert bench.unit.position("P") < 1000
        bench.until(lambda: not bench.loop.snapshot.moving)
    again = bench.move(100, 0)
    bench.until(again.done.is_set)
    assert again.error is None


def test_a_move_is_not_taken_up_again_for_ever(bench):
    bench.start()
    receive = bench.unit.receive
    move = bench.move(3000, 0, wait=True)
    for silence in range(5):
        bench.run(0.3)
        bench.unit.receive = receive
        silent_for(bench, 0.7)
        bench.run(0.8)
        assert move.done.is_set() == (silence >= 3)
    assert "halted" in str(move.error)


def test_a_move_is_not_taken_up_again_after_a_halt(bench):
    bench.start()
    move = bench.move(-3000, 0, wait=True)
    bench.run(0.3)
    silent_for(bench, 0.7)
    request = bench.halt()
    bench.run(3.0)
    assert request.answered
    assert str(move.error) == "the move was halted"
    assert not bench.unit.turning()


@pytest.mark.parametrize("seed", range(20))
def test_random_answers_end_in_a_halt_or_are_survived(seed):
    rng = random.Random(seed)
    bench = Bench()
    bench.start()
    answer = bench.unit.answer

    def broken(order):
        said = answer(order)
        match rng.randrange(60):
            case 0:
                return said[: rng.randrange(len(said))]
            case 1:
                return rng.randbytes(rng.randrange(30))
            case 2:
                return b""
            case 3:
                return said[:1] + rng.randbytes(1) + said[1:]
            case 4:
                bench.port.inject(said, rng.random())
                return b""
        return said

    bench.unit.answer = broken
    ended = None
    try:
        for _ in range(300):
            if rng.random() < 0.1:
                bench.move(rng.randrange(-3000, 3000), rng.randrange(-900, 600))
            if rng.random() < 0.02:
                bench.halt()
            bench.loop.turn()
    except DeviceError as error:
        ended = error
    bench.unit.answer = answer
    bench.loop.stop_for_good(ended or DeviceError("closed"))
    assert bench.unit.heard[-1] == "H"
    assert not bench.unit.turning()
