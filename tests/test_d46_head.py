"""The driver of the PTU-D46 against a small unit of the tests' own, in simulated time; over the wire: test_d46_wire."""

import math
import random
import signal
import threading
import time

import pytest
import serial

from cotarget.errors import ConfigError, DeviceError
from cotarget.hardware.d46loop import Halt, Loop, Move
from cotarget.hardware.d46unit import connect, probe, reset
from cotarget.hardware.head import D46Head
from cotarget.hardware.line import Line
from cotarget.hwconfig import HardwareHead
from tests.d46_peer import BANNER, VERSION, SimClock, SimPort, Unit

STEP = math.radians(185.1428 / 3600)
CONFIG = HardwareHead(port="PORT", pan_deg=(-158.9, 158.9), tilt_deg=(-46.6, 31.1), command_delay_s=0.04)
BYTE = 10 / 9600
FROM_FAULT_TO_HALT = 0.5  # issue 4's figure [s]
LIMITS_DEG = ((-158.91, 158.91), (-46.65, 31.06))  # 3090 and -907..604 steps of 185.1428 seconds of arc
# What may be sent while nobody moves the head: nothing that moves it, or wears its memory.
HARMLESS = {"ED", "FT", "E", "F", "V", "WP", "C", "CI", "I", "H", "PP", "TP"}
HARMLESS |= {axis + what for axis in "PT" for what in "RNXLUA"}


class Bench:
    """A unit on a line in simulated time."""

    def __init__(self, echo=True, verbose=True):
        self.clock = SimClock()
        self.unit = Unit(self.clock, echo, verbose)
        self.port = SimPort(self.unit, self.clock)
        self.numbers = iter(range(1, 1000000))

    def connect(self, config=CONFIG):
        self.line = Line(self.port, "PORT", 9600, self.clock)
        return connect(self.line, config)

    def start(self, config=CONFIG):
        facts = self.connect(config)
        self.loop = Loop(self.line, facts, self.clock, config.command_delay_s)
        self.until(lambda: not self.loop.snapshot.moving)
        return self.loop

    def until(self, there, most=20.0):
        """Let the loop turn until something is so; how long that took [s]."""
        start = self.clock.now()
        while not there():
            assert self.clock.now() < start + most
            self.loop.turn()
        return self.clock.now() - start

    def run(self, seconds):
        end = self.clock.now() + seconds
        self.until(lambda: self.clock.now() >= end)

    def move(self, pan, tilt, speed=1000, wait=False):
        move = Move(next(self.numbers), (pan, tilt), (speed, speed), wait)
        self.loop.moves.append(move)
        return move

    def orders(self):
        """Commands since the last look, without polls."""
        heard = [order for order in self.unit.heard if order not in ("PP", "TP")]
        self.unit.heard.clear()
        return heard


def for_ever(call):
    """Call until it fails."""
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        call()


@pytest.fixture
def bench():
    return Bench()


@pytest.fixture
def opened(bench, monkeypatch):
    """Open heads on the bench through pyserial's own function."""
    monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: bench.port)
    heads = []

    def open_head(config=CONFIG):
        heads.append(D46Head(config, bench.clock))
        return heads[-1]

    yield open_head
    for head in heads:
        head.close()
    assert not any(thread.name.startswith("PTU-D46") for thread in threading.enumerate())


# Opening.


@pytest.mark.parametrize("echo", [True, False])
@pytest.mark.parametrize("verbose", [True, False])
def test_the_units_manner_is_learnt(echo, verbose):
    bench = Bench(echo, verbose)
    facts = bench.connect()
    assert facts.version == VERSION
    assert facts.mode == "H"
    assert (facts.pan.lowest, facts.pan.highest, facts.tilt.lowest, facts.tilt.highest) == (-3090, 3090, -907, 604)
    assert (facts.pan.slowest, facts.pan.fastest, facts.pan.acceleration) == (31, 2902, 2000)
    assert facts.pan.arcseconds == 185.1428
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
def test_another_unit_than_configured_is_refused(bench, facts, config, said):
    bench.unit.facts |= facts
    with pytest.raises(ConfigError, match=said):
        bench.connect(HardwareHead(**{**vars(CONFIG), **config}))
    assert "H" not in bench.unit.heard


def test_limits_differ_a_little_from_unit_to_unit(bench):
    bench.unit.facts |= {"PX": 3091, "TN": -903, "TX": 601}
    bench.connect()


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


# Polling.


def test_positions_are_stamped_with_the_time_at_which_the_unit_looked(bench):
    looked = []
    bench.start()
    obey = bench.unit.obey

    def watch(order):
        if order in ("PP", "TP"):
            looked.append(bench.clock.now())
        return obey(order)

    bench.unit.obey = watch
    for turn in range(10):
        bench.loop.turn()
        if turn > 0:
            assert bench.loop.snapshot.t == pytest.approx(looked[-2], abs=BYTE / 10)


def test_both_axes_are_told_for_one_time(bench):
    bench.start()
    bench.move(3000, -900, speed=1000)
    bench.until(lambda: bench.unit.position("T") < -100)
    pan, tilt = bench.unit.way["P"][0], bench.unit.way["T"][0]
    for _ in range(30):
        bench.loop.turn()
        seen = bench.loop.snapshot
        assert seen.pan == pytest.approx((seen.t - pan) * 1000, abs=1.5)  # a step of rounding, and half of one
        assert seen.tilt == pytest.approx((tilt - seen.t) * 1000, abs=1.5)


def test_the_line_is_busy_all_the_time(bench):
    bench.start()
    bench.port.sent.clear()
    start = bench.clock.now()
    bench.run(1.0)
    # "PP " and "* 0" with CR LF: eight bytes each.
    assert len(bench.port.sent) >= 0.98 * (bench.clock.now() - start) / (8 * BYTE)


# Moves.


def test_a_move_is_speeds_then_positions_and_only_what_changed(bench):
    bench.start()
    bench.orders()
    bench.until(bench.move(100, -50).done.is_set)
    assert bench.orders() == ["PS1000", "TS1000", "PP100", "TP-50"]
    bench.until(bench.move(200, -50).done.is_set)
    assert bench.orders() == ["PP200"]
    bench.until(bench.move(200, 0, speed=500).done.is_set)
    assert bench.orders() == ["PS500", "TS500", "TP0"]


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
    assert not bench.loop.snapshot.moving
    assert (bench.loop.snapshot.pan, bench.loop.snapshot.tilt) == (300.0, 0.0)


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


def test_the_newest_move_wins(bench):
    bench.start()
    bench.orders()
    moves = [bench.move(n, 0) for n in (10, 20, 30)]
    bench.until(moves[-1].done.is_set)
    assert [order for order in bench.orders() if order.startswith("PP")] == ["PP30"]
    assert str(moves[0].error) == "another move took this one's place"
    assert moves[-1].error is None
    assert not bench.loop.errors


def test_moves_without_end_leave_the_line_to_polls(bench):
    bench.start()
    bench.unit.heard.clear()
    for n in range(200):
        bench.move(n, -n)
        bench.loop.turn()
    assert bench.unit.heard.count("PP") >= 40
    assert bench.unit.heard.count("TP") >= 40


def test_a_refused_move_is_halted_and_told_once(bench):
    bench.start()
    bench.unit.scripted = {"PP100": [b"! Maximum allowable Pan position is 90\r\n"]}
    bench.move(100, 100)
    bench.run(0.2)
    assert bench.orders()[-2:] == ["PP100", "H"]
    said = "the pan-tilt unit at PORT refused PP100: Maximum allowable Pan position is 90"
    assert str(bench.loop.errors.popleft()) == said
    move = bench.move(80, 100)
    bench.until(move.done.is_set)
    assert move.error is None


def test_a_head_that_does_not_arrive_is_halted_and_told(bench):
    bench.start()
    bench.unit.stuck = True
    move = bench.move(500, 0, wait=True)
    took = bench.until(move.done.is_set)
    assert 2.5 < took < 5.0  # half a second of way, its run-up, and the patience of two seconds
    assert "did not arrive in time: pan 0, tilt 0 steps, where 500, 0 were commanded; it was halted" in str(move.error)
    assert bench.orders()[-1] == "H"


# Halts.


def halt(bench):
    wish = Halt()
    bench.loop.halted = next(bench.numbers)
    bench.loop.halts.append(wish)
    return wish


def test_a_halt_comes_first_and_older_moves_are_not_sent(bench):
    bench.start()
    bench.orders()
    move = bench.move(1000, 0)
    wish = halt(bench)
    bench.run(0.5)
    assert wish.answered
    assert bench.orders() == ["H"]
    assert str(move.error) == "the move was halted"
    later = bench.move(100, 0)
    bench.until(later.done.is_set)
    assert later.error is None


def test_a_halted_head_moves_until_it_stands(bench):
    bench.start()
    move = bench.move(3000, 0)
    bench.until(lambda: bench.unit.position("P") > 500)
    wish = halt(bench)
    took = bench.until(lambda: wish.answered)
    assert took < 0.02
    assert bench.loop.snapshot.moving
    bench.until(lambda: not bench.loop.snapshot.moving)
    assert str(move.error) == "the move was halted"
    assert bench.loop.snapshot.pan == bench.unit.position("P")
    # The same goal is sent anew after a halt.
    bench.orders()
    again = bench.move(3000, 0)
    bench.until(again.done.is_set)
    assert "PP3000" in bench.orders()


def test_a_halt_between_the_orders_of_a_move(bench):
    bench.start()
    bench.orders()
    bench.unit.scripted = {"PP1000": [lambda: halt(bench) and b"*\r\n"]}
    bench.move(1000, 500)
    bench.run(0.2)
    assert bench.orders() == ["PS1000", "TS1000", "PP1000", "H"]


def test_a_halt_does_not_wait_for_a_silent_unit(bench):
    bench.start()
    bench.unit.scripted = {"PP": [lambda: halt(bench) and None], "TP": [lambda: halt(bench) and None]}
    start = bench.clock.now()
    bench.run(0.1)
    when = next(t for t, data in bench.port.sent if t > start and b"H " in data)
    assert when - start < 0.1


# Lines that fail.

STALE = b"* 2222\r\n"


@pytest.mark.parametrize(
    "reply", [b"* 1", b"", b"*\r\n", b"\xf3\x10\x80", b"* 7 7\r\n", b"PP * 7\r\n", b"! Illegal\r\n"]
)
def test_one_bad_answer_is_asked_for_again(bench, reply):
    bench.start()
    move = bench.move(1000, 0)
    bench.run(0.1)
    bench.unit.scripted = {"PP": [reply]}
    bench.until(move.done.is_set)
    assert move.error is None
    assert "H" not in bench.orders()[20:]
    assert bench.loop.snapshot.pan == 1000


@pytest.mark.parametrize("late", [0.05, 0.2, 0.3, 0.5])
def test_a_late_answer_is_not_taken_for_another(bench, late):
    bench.start()
    bench.orders()

    def answer_late():
        bench.port.inject(STALE, late)

    bench.unit.scripted = {"PP": [answer_late]}
    for _ in range(200):
        bench.loop.turn()
        # Late by less than a poll's deadline it is the answer, to the question that it answers.
        assert bench.loop.snapshot.tilt == 0
        assert bench.loop.snapshot.pan == 0 or late < 0.1
    assert bench.loop.snapshot.pan == 0


def test_an_order_whose_answer_was_lost_is_sent_again(bench):
    bench.start()
    bench.orders()
    bench.unit.scripted = {"PP100": [b"", None]}
    move = bench.move(100, 0)
    bench.until(move.done.is_set)
    assert move.error is None
    assert bench.orders().count("PP100") == 3


def test_but_not_if_there_is_a_newer_one(bench):
    bench.start()
    bench.orders()
    bench.unit.scripted = {"PP100": [lambda: bench.move(50, 0) and None]}
    bench.move(100, 0)
    bench.run(1.0)
    assert [order for order in bench.orders() if order.startswith("PP")] == ["PP100", "PP50"]
    assert bench.unit.position("P") == 50


def test_a_silent_unit_is_halted_in_time(bench):
    bench.start()
    bench.move(3000, 0)
    bench.run(0.3)
    receive = bench.unit.receive
    bench.unit.receive = lambda data: receive(data) and b""  # it hears, but is not heard
    start = bench.clock.now()
    with pytest.raises(DeviceError, match="at PORT does not answer any more; it was told to halt"):
        bench.run(5.0)
    assert bench.clock.now() - start < 2.5
    when = next(t for t, data in bench.port.sent if t > start and b"H " in data)
    assert when - start < FROM_FAULT_TO_HALT
    assert not bench.unit.turning()


def test_a_unit_that_comes_back_was_halted_and_goes_on(bench):
    bench.start()
    move = bench.move(3000, 0, wait=True)
    bench.run(0.3)
    receive, back = bench.unit.receive, bench.clock.now() + 0.7
    bench.unit.receive = lambda data: receive(data) if bench.clock.now() > back else receive(data) and b""
    bench.until(move.done.is_set)
    assert "the line was silent and the head was halted" in str(move.error)
    again = bench.move(100, 0)
    bench.until(again.done.is_set)
    assert again.error is None


@pytest.mark.parametrize("axis", ["P", "T", "D"])
@pytest.mark.parametrize("how", ["glued", "inside", "alone"])
def test_events_end_it(bench, axis, how):
    bench.start()
    bench.move(1000, 0)
    bench.run(0.2)
    event = f"!{axis}".encode()
    if how == "glued":
        bench.unit.says_first = event
    elif how == "inside":
        bench.unit.scripted = {"TP": [b"* 1" + event + b"2\r\n"]}
    else:
        bench.port.inject(event)
    what = {"P": "pan hit its limit", "T": "tilt hit its limit", "D": "its cable came off"}[axis]
    with pytest.raises(DeviceError, match=rf"reports that {what} \(!{axis}\): it was halted, and its position may be"):
        bench.run(0.2)


def test_a_power_cycle_is_noticed(bench):
    bench.start()
    bench.unit.echo = bench.unit.verbose = True
    with pytest.raises(DeviceError, match="was switched off and on, so that its position may be lost; open it again"):
        bench.run(1.0)


def test_a_banner_is_noticed_even_if_the_unit_keeps_its_manner(bench):
    bench.start()
    bench.port.inject(BANNER)
    with pytest.raises(DeviceError, match="was switched off and on"):
        bench.run(1.0)


@pytest.mark.parametrize(
    "error", [serial.SerialException("device reports readiness"), OSError(5, "Input/output error")]
)
def test_an_unplugged_line_is_told(bench, error):
    bench.start()
    bench.port.broken = error
    with pytest.raises(DeviceError, match=r"the line to the pan-tilt unit at PORT is lost .*; plug it in and open it"):
        bench.run(1.0)


@pytest.mark.parametrize("seed", range(20))
def test_whatever_comes_it_ends_in_a_halt_or_goes_on(seed):
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
                halt(bench)
            bench.loop.turn()
    except DeviceError as error:
        ended = error
    bench.unit.answer = answer
    bench.loop.stop_for_good(ended or DeviceError("closed"))
    assert bench.unit.heard[-1] == "H"
    assert not bench.unit.turning()


# The head itself, with its thread.


def test_limits_are_the_units_in_the_sense_of_the_file(opened, bench):
    limits = opened().limits
    for own, expected in zip((limits.pan, limits.tilt), LIMITS_DEG, strict=True):
        assert [math.degrees(v) for v in own] == pytest.approx(expected, abs=0.01)
    assert limits.step == pytest.approx(STEP)
    assert math.degrees(limits.speed) == pytest.approx(149.0)
    assert limits.acceleration == pytest.approx(2000 * STEP)


def test_signs_turn_axes_round(opened, bench):
    config = HardwareHead(port="PORT", pan_sign=-1, tilt_sign=-1, tilt_deg=(-31.1, 46.6))
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


@pytest.mark.parametrize(("asked", "set_to"), [(None, 2897), (0.1, 111), (1e-9, 31), (1e9, 2897)])
def test_speeds_are_within_the_units_and_the_files_bounds(opened, bench, asked, set_to):
    # 149 degrees a second are 2897 steps; 0.1 rad/s is 111.
    opened().move(STEP, STEP, speed=asked, wait=True)
    assert bench.unit.speed == {"P": set_to, "T": set_to}


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
        thread.join()
    head.halt()
    assert not bench.unit.turning()


def test_a_signal_handler_may_halt_whatever_it_interrupts(opened, bench):
    head = opened()
    halted = []

    def handler(*_):
        head.halt()
        halted.append(not bench.unit.turning())

    before = signal.signal(signal.SIGUSR1, handler)
    main = threading.main_thread().ident
    try:
        bench.unit.scripted = {"TP": [lambda: signal.pthread_kill(main, signal.SIGUSR1) or b"* 0\r\n"]}
        bench.unit.stuck = True
        with pytest.raises(DeviceError, match=r"the move was halted|did not arrive"):
            head.move(2000 * STEP, 0.0, wait=True)
        for _ in range(50):
            signal.raise_signal(signal.SIGUSR1)
            head.state()
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert all(halted)
    assert len(halted) >= 51


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


# Beside the rig.


def test_a_look_at_a_unit_changes_nothing(opened, bench, monkeypatch):
    monkeypatch.setattr("cotarget.hardware.d46unit.MonotonicClock", lambda: bench.clock)
    assert probe("PORT", 9600) == f"{VERSION}, unit 0"
    assert bench.unit.heard == ["V", "U"]
    assert bench.unit.echo
    assert bench.port.closed
    bench.unit.receive = lambda data: b""
    with pytest.raises(DeviceError, match="nothing answers at PORT"):
        probe("PORT", 9600)


def test_a_reset_reads_its_answer_to_the_end(opened, bench):
    bench.unit.facts |= {"PN": 0, "PX": 0}

    def calibrate():
        bench.unit.facts |= {"PN": -3090, "PX": 3090}
        bench.port.inject(b"!T!T!P!P", after=20.0)
        bench.port.inject(b"*\r\n", after=25.0)

    bench.unit.scripted = {"R": [calibrate]}
    assert reset(CONFIG, bench.clock).pan.highest == 3090
    assert bench.unit.heard.count("R") == 1
    assert bench.port.closed


def test_a_reset_that_does_not_end_is_halted(opened, bench):
    bench.unit.scripted = {"R": [None]}
    with pytest.raises(DeviceError, match="did not answer in time"):
        reset(CONFIG, bench.clock)
    assert bench.unit.heard[-1] == "H"
    bench.unit.facts |= {"PN": 0, "PX": 0}
    with pytest.raises(DeviceError, match="is not calibrated"):
        reset(CONFIG, bench.clock)


def test_no_port_is_named():
    with pytest.raises(ConfigError, match=r"hardware.head.port: names no port, such as /dev/ttyUSB0 or socket://host"):
        D46Head(HardwareHead(), SimClock())


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
        D46Head(CONFIG, SimClock())
