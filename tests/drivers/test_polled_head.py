"""`PolledHead` on a unit of another protocol than the D46's: both axes report at once, and a move is one message."""

import math
import threading
from dataclasses import replace

import pytest

from cotarget.config import SafetyConfig
from cotarget.drivers.interlock import PositionLostError
from cotarget.drivers.polled_head import AxisFacts, CutError, Poll, PolledHead, PolledHeadSettings
from cotarget.drivers.serial_line import LostError, RefusedError, SilentError
from cotarget.errors import ConfigError, DeviceError, HaltedError
from tests.support.simulated_clock import SimClock

STEP = math.radians(0.1)
FACTS = AxisFacts(STEP, -900, 900, slowest=10, fastest=500, acceleration=1000, still_s=0.11)
SETTINGS = {"port": "COUNTER", "step_deg": 0.1, "pan_deg": (-90, 90), "tilt_deg": (-90, 90), "tilt_sign": -1}
SETTINGS |= {"speed_deg_s": 40.0, "command_delay_s": 0.0}
EXCHANGE_S = 0.01


class CounterLink:
    """Exchange messages with a unit whose axes arrive at once."""

    name = "COUNTER"
    axes = (FACTS, FACTS)

    def __init__(self, clock):
        self.clock, self.hurry = clock, lambda: False
        self.at, self.sent = [0, 0], []
        self.fails = []  # errors of the next moves
        self.polls_fail = []  # errors of the next polls; the last one for ever before an Ellipsis
        self.stuck = self.restless = False

    def poll(self):
        self.clock.sleep_until(self.clock.now() + EXCHANGE_S)
        if self.polls_fail:
            error = self.polls_fail[0]
            if self.polls_fail[1:] != [...]:
                self.polls_fail.pop(0)
            if error is not None:
                raise error
        if self.restless:
            self.at[0] += 1
        return [Poll(axis, position, self.clock.now()) for axis, position in enumerate(self.at)]

    def move(self, goals, speeds, proceed):
        proceed()
        self.clock.sleep_until(self.clock.now() + EXCHANGE_S)
        self.sent.append((goals, speeds))
        if self.fails:
            raise self.fails.pop(0)
        if not self.stuck:
            self.at = list(goals)

    def halt(self, patience):
        self.sent.append("halt")

    def halt_last(self, patience):
        self.sent.append("last halt")

    def send_halt(self):
        self.sent.append("halt without an answer")

    def check(self):
        pass

    def close(self):
        self.sent.append("closed")


def ask_again_and_again(head, times=100_000):
    for _ in range(times):
        head.state()


@pytest.fixture
def link():
    return CounterLink(SimClock())


@pytest.fixture
def opened(link, tmp_path):
    heads = []

    def open_head(**settings):
        config = PolledHeadSettings(**{**SETTINGS, **settings})
        heads.append(PolledHead(lambda: link, config, link.clock, SafetyConfig(stop_file=tmp_path / "stop")))
        return heads[-1]

    yield open_head
    for head in heads:
        head.close()


def test_it_moves_in_its_units_with_its_signs(opened, link):
    head = opened()
    assert math.degrees(head.limits.speed) == pytest.approx(40.0)
    pan, tilt = head.move(math.radians(10.04), math.radians(-120.0), wait=True)
    assert (math.degrees(pan), math.degrees(tilt)) == (pytest.approx(10.0), pytest.approx(-90.0))
    head.move(0.0, 0.0, speed=(math.radians(10.0), math.radians(20.0)), wait=True)
    assert link.sent == [((100, 900), (400, 400)), ((0, 0), (100, 200))]


def test_limits_and_braking_are_those_of_the_weaker_axis(opened, link):
    """Tilt turns at 30 degrees/s, where 40 are configured, and brakes from that in 3 s."""
    link.axes = (FACTS, replace(FACTS, fastest=300, acceleration=100))
    patience = []
    link.halt = patience.append
    head = opened()
    assert (head.limits.speed, head.limits.acceleration) == (pytest.approx(300 * STEP), pytest.approx(100 * STEP))
    head.halt()
    assert patience[0] >= 3.0


def test_closing_sends_a_last_halt_before_the_port_is_closed(opened, link):
    head = opened()
    head.halt()
    head.close()
    assert link.sent == ["halt", "last halt", "closed"]
    for call in (head.state, lambda: head.move(0.0, 0.0)):
        with pytest.raises(DeviceError, match="COUNTER is closed"):
            call()


def test_a_refused_move_is_halted_and_raises(opened, link):
    head = opened()
    link.fails = [RefusedError("no")]
    with pytest.raises(DeviceError, match=r"^no$"):
        head.move(0.1, 0.1, wait=True)
    assert link.sent[-1] == "halt"
    head.move(0.2, 0.2, wait=True)


def test_a_move_cut_by_a_silence_is_sent_again_to_a_caller_that_waits(opened, link):
    head = opened()
    link.fails = [CutError("silent for a while")]
    head.move(STEP, STEP, wait=True)
    assert [goals for goals, _ in link.sent] == [(1, -1), (1, -1)]


@pytest.mark.parametrize("between", [True, False])
def test_repeated_silence_without_a_position_ends_the_head(opened, link, between):
    head = opened()
    cut = CutError("silent for a while")
    link.polls_fail = [cut, cut, None] * 10 if between else [cut, ...]
    if between:
        while link.polls_fail:
            head.state()
        head.move(STEP, 0.0, wait=True)
    else:
        with pytest.raises(DeviceError, match="silent for a while"):
            ask_again_and_again(head)
        head.close()
        assert link.sent == ["last halt", "closed"]


@pytest.mark.parametrize(
    ("error", "halted"),
    [(SilentError("it is silent"), True), (DeviceError("no"), True), (LostError("COUNTER", OSError("gone")), False)],
)
def test_an_error_ends_in_a_last_halt_unless_the_port_is_lost(opened, link, error, halted):
    head = opened()
    link.polls_fail = [error, ...]
    with pytest.raises(DeviceError, match=str(error).split("(")[0]):
        ask_again_and_again(head)
    head.close()
    assert link.sent == ["last halt", "closed"] if halted else ["closed"]


def test_a_head_that_does_not_arrive_is_not_opened_again(opened, link):
    head = opened()
    link.stuck = True
    with pytest.raises(DeviceError, match="pan 0, tilt 0 steps, where 1, 0 were commanded"):
        head.move(STEP, 0.0, wait=True)
    head.close()
    with pytest.raises(DeviceError, match="cotarget reset-head"):
        opened()


def silent(*_):
    raise SilentError("it is silent")


def test_a_halt_of_a_dead_unit_is_sent_and_raises(opened, link):
    head = opened()
    link.polls_fail, link.halt_last = [SilentError("it is silent"), ...], silent
    for call in (lambda: ask_again_and_again(head), head.halt):
        with pytest.raises(DeviceError, match="silent"):
            call()
    assert link.sent == ["halt without an answer"]


def test_a_link_that_hangs_holds_up_neither_a_halt_nor_the_end(opened, link, monkeypatch, caplog):
    for limit in ("HALT_S", "CLOSE_S"):
        monkeypatch.setattr(f"cotarget.drivers.polled_head.{limit}", 0.01)
    hangs, release = threading.Event(), threading.Event()

    def poll():
        hangs.set()
        release.wait(20.0)
        return CounterLink.poll(link)

    head = opened()
    link.poll = poll
    assert hangs.wait(20.0)
    with pytest.raises(DeviceError, match="COUNTER did not acknowledge a halt"):
        head.halt()
    head.close()
    assert "does not end" in caplog.text
    release.set()


def test_an_exception_in_the_last_halt_keeps_the_marker(opened, link):
    def halt_last(patience):
        raise ValueError("a mistake")

    head = opened()
    link.polls_fail = [PositionLostError("COUNTER", "hit its limit"), ...]
    link.halt_last = halt_last
    with pytest.raises(DeviceError, match="hit its limit"):
        ask_again_and_again(head)
    head.close()
    with pytest.raises(DeviceError, match="cotarget reset-head"):
        opened()


# What ends a start, the key or text of the error, and what the unit is sent.
STARTS = {
    "other limits": ({"pan_deg": (-180.0, 180.0)}, {}, ConfigError, "hardware.head.pan_deg: "),
    "other steps": ({"step_deg": 0.2}, {}, ConfigError, "hardware.head.step_deg: "),
    "too slow": ({"speed_deg_s": 0.5}, {}, ConfigError, "hardware.head.speed_deg_s: "),
    "an error": ({}, {"polls_fail": [ValueError("a mistake"), ...]}, ValueError, "a mistake"),
    "no rest": ({}, {"restless": True}, DeviceError, "goes on turning"),
}


@pytest.mark.parametrize("name", STARTS)
def test_a_start_that_fails_ends_in_a_halt_and_closes_the_port(opened, link, name):
    settings, changes, kind, said = STARTS[name]
    for attribute, value in changes.items():
        setattr(link, attribute, value)
    with pytest.raises(kind, match=said):
        opened(**settings)
    assert link.sent == ["last halt", "closed"]


@pytest.mark.parametrize("missing", ["poll", "halt_last", "axes", "name", "close"])
def test_a_link_without_a_required_part_is_refused_and_closed(opened, link, missing):
    class Lacking:
        def __getattr__(self, name):
            if name == missing:
                raise AttributeError(name)
            return getattr(link, name)

    with pytest.raises(ConfigError, match=f"^hardware.head.driver: Lacking has no {missing}"):
        PolledHead(Lacking, PolledHeadSettings(**SETTINGS), link.clock)
    assert link.sent == ([] if missing == "close" else ["closed"])


def test_a_newer_move_takes_the_place_of_one_that_waits(opened, link):
    head = opened()
    link.stuck = True
    send = link.move

    def newer(goals, speeds, proceed):
        link.move, link.stuck = send, False
        head.move(5 * STEP, 0.0)
        proceed()

    link.move = newer
    with pytest.raises(HaltedError):
        head.move(STEP, 0.0, wait=True)


def test_an_exception_in_a_link_halts_and_names_file_and_line(opened, link):
    head = opened()
    link.polls_fail = [ValueError("a mistake"), ...]
    with pytest.raises(DeviceError, match=r"ValueError\('a mistake'\) \(.*test_polled_head\.py:\d+\)$"):
        ask_again_and_again(head)
    head.halt()
    assert link.sent == ["last halt"]
