"""What the thread that owns the line to a PTU-D46 does, turn by turn in simulated time."""

import random

import pytest
import serial

from cotarget.drivers.interlock import PositionLostError
from cotarget.errors import DeviceError
from tests.support.d46_bench import Bench
from tests.support.d46_peer import BANNER

BYTE = 10 / 9600
FROM_FAULT_TO_HALT = 0.5  # issue 4's figure [s]


@pytest.fixture
def bench():
    return Bench()


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
    start = bench.clock.now()
    move = bench.move(500, 0, wait=True)
    with pytest.raises(PositionLostError, match="did not arrive in time: pan 0, tilt 0 steps, where 500, 0") as caught:
        bench.run(10.0)
    assert 2.5 < bench.clock.now() - start < 5.0  # half a second of way, its run-up, and the patience of two seconds
    bench.loop.stop_for_good(caught.value)
    assert move.error is caught.value
    assert bench.orders()[-1] == "H"


def test_a_driver_that_slept_does_not_take_a_head_that_has_arrived_for_late(bench):
    bench.start()
    move = bench.move(500, 0, wait=True)
    bench.run(0.1)
    bench.clock.t += 10.0
    bench.until(move.done.is_set)
    assert move.error is None


# Halts.
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


def test_a_halted_head_moves_until_it_stands(bench):
    bench.start()
    move = bench.move(3000, 0)
    bench.until(lambda: bench.unit.position("P") > 500)
    request = bench.halt()
    took = bench.until(lambda: request.answered)
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
    bench.unit.scripted = {"PP1000": [lambda: bench.halt() and b"*\r\n"]}
    bench.move(1000, 500)
    bench.run(0.2)
    assert bench.orders() == ["PS1000", "TS1000", "PP1000", "H"]


NOISE = {noise: [b"! Illegal argument\r\n"] for noise in ("x", "xH")}


def test_a_byte_of_noise_at_the_unit_does_not_keep_it_from_a_halt(bench):
    """It hears "xH", or with a delimiter in front of the halt "x" and "H"."""
    bench.start()
    bench.move(3000, 0)
    bench.until(lambda: bench.unit.position("P") > 500)
    bench.unit.scripted = {noise: list(said) for noise, said in NOISE.items()}
    bench.unit.noise = b"x"
    request = bench.halt()
    bench.until(lambda: request.answered)
    assert not bench.unit.turning()
    move = bench.move(0, 0)
    bench.until(move.done.is_set)
    assert move.error is None


def test_nor_from_the_last_one(bench):
    bench.start()
    bench.move(3000, 0)
    bench.until(lambda: bench.unit.position("P") > 500)
    bench.unit.scripted = {noise: list(said) for noise, said in NOISE.items()}
    bench.unit.noise = b"x"
    bench.loop.stop_for_good(DeviceError("closed"))
    assert bench.loop.rests
    assert not bench.unit.turning()


def test_a_halt_does_not_wait_for_a_silent_unit(bench):
    bench.start()
    bench.unit.scripted = {"PP": [lambda: bench.halt() and None], "TP": [lambda: bench.halt() and None]}
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


def test_a_unit_that_keeps_answering_something_else_is_given_up(bench):
    bench.start()
    bench.unit.scripted = {"TP": [b"* 1 2\r\n"] * 10}
    with pytest.raises(
        DeviceError, match="the pan-tilt unit at PORT answers, but not what it was asked: '1 2' is not a number"
    ):
        bench.run(5.0)


def test_a_move_from_before_a_halt_does_not_take_the_place_of_one_from_after(bench):
    bench.start()
    stale = bench.move(1000, 0)
    bench.loop.moves.clear()  # its thread was interrupted before it got there
    bench.halt()
    move = bench.move(500, 0)
    bench.run(0.2)
    bench.loop.moves.append(stale)
    bench.until(stale.done.is_set)
    assert str(stale.error) == "the move was halted"
    bench.until(move.done.is_set)
    assert move.error is None


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


@pytest.mark.parametrize("wait", [True, False])
def test_a_unit_that_comes_back_was_halted_and_goes_on(bench, wait):
    bench.start()
    move = bench.move(3000, 0, wait=wait)
    bench.run(0.3)
    receive, back = bench.unit.receive, bench.clock.now() + 0.7
    bench.unit.receive = lambda data: receive(data) if bench.clock.now() > back else receive(data) and b""
    bench.until(move.done.is_set)
    if wait:
        assert move.error is None
        assert bench.unit.position("P") == 3000
    else:  # whoever sends without waiting sends again; an old wish is not taken up after a silence
        assert "did not answer in time, and the head was halted" in str(move.error)
        assert bench.unit.position("P") < 1000
        bench.until(lambda: not bench.loop.snapshot.moving)
    again = bench.move(100, 0)
    bench.until(again.done.is_set)
    assert again.error is None


def test_a_move_is_not_taken_up_again_for_ever_nor_after_a_halt(bench):
    bench.start()
    receive = bench.unit.receive
    move = bench.move(3000, 0, wait=True)
    for silence in range(5):
        bench.run(0.3)
        back = bench.clock.now() + 0.7
        bench.unit.receive = lambda data, back=back: (
            receive(data) if bench.clock.now() > back else receive(data) and b""
        )
        bench.run(0.8)
        assert move.done.is_set() == (silence >= 3)
    assert "did not answer in time, and the head was halted" in str(move.error)
    move = bench.move(-3000, 0, wait=True)
    bench.run(0.3)
    back = bench.clock.now() + 0.7
    bench.unit.receive = lambda data: receive(data) if bench.clock.now() > back else receive(data) and b""
    request = bench.halt()
    bench.run(3.0)
    assert request.answered
    assert str(move.error) == "the move was halted"
    assert not bench.unit.turning()


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
    with pytest.raises(
        DeviceError, match=r"switched off and on, so that its position may be lost; .* run cotarget reset"
    ):
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
                bench.halt()
            bench.loop.turn()
    except DeviceError as error:
        ended = error
    bench.unit.answer = answer
    bench.loop.stop_for_good(ended or DeviceError("closed"))
    assert bench.unit.heard[-1] == "H"
    assert not bench.unit.turning()
