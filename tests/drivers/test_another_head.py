"""A pan-tilt unit of another protocol under `PolledHead`: both axes report at once, and a move is one message."""

import math
from types import SimpleNamespace

import pytest

from cotarget.config import SafetyConfig
from cotarget.drivers.interlock import PositionLostError
from cotarget.drivers.polled_head import AxisFacts, CutError, Poll, PolledHead
from cotarget.drivers.serial_line import RefusedError
from cotarget.errors import ConfigError, DeviceError, HaltedError
from tests.support.simulated_clock import SimClock

STEP = math.radians(0.1)
FACTS = AxisFacts(STEP, -900, 900, slowest=10, fastest=500, acceleration=1000, still_s=0.11)
SETTINGS = SimpleNamespace(
    port="COUNTER", step_deg=0.1, pan_deg=(-90.0, 90.0), tilt_deg=(-90.0, 90.0), pan_sign=1, tilt_sign=-1,
    speed_deg_s=40.0, command_delay_s=0.0,
)  # fmt: skip
EXCHANGE_S = 0.01


class CounterLink:
    """Exchange messages with a unit whose axes arrive at once."""

    name = "COUNTER"
    axes = (FACTS, FACTS)

    def __init__(self, clock):
        self.clock, self.hurry = clock, lambda: False
        self.at, self.sent = [0, 0], []
        self.fails = []  # errors of the next messages
        self.polls_fail = None
        self.stuck = False

    def poll(self):
        self.clock.sleep_until(self.clock.now() + EXCHANGE_S)
        if self.polls_fail:
            raise self.polls_fail
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


def ask_again_and_again(head):
    for _ in range(100_000):
        head.state()


@pytest.fixture
def link():
    return CounterLink(SimClock())


@pytest.fixture
def opened(link, tmp_path):
    heads = []

    def open_head(**settings):
        config = SimpleNamespace(**{**vars(SETTINGS), **settings})
        heads.append(PolledHead(lambda: link, config, link.clock, SafetyConfig(stop_file=tmp_path / "stop")))
        return heads[-1]

    yield open_head
    for head in heads:
        head.close()


def test_it_moves_within_its_limits_and_reports_where_it_is(opened, link):
    head = opened()
    assert math.degrees(head.limits.speed) == pytest.approx(40.0)
    pan, tilt = head.move(math.radians(10.04), math.radians(-120.0), wait=True)
    assert (math.degrees(pan), math.degrees(tilt)) == (pytest.approx(10.0), pytest.approx(-90.0))
    assert link.sent == [((100, 900), (400, 400))]
    state = head.state()
    assert (state.pan, state.tilt, state.moving) == (pan, tilt, False)


def test_a_halt_is_acknowledged_and_the_last_word_before_the_port_is_free_is_one(opened, link):
    head = opened()
    head.halt()
    head.close()
    assert link.sent == ["halt", "last halt", "closed"]
    with pytest.raises(DeviceError, match="the pan-tilt unit at COUNTER is closed"):
        head.state()


def test_a_refused_move_is_halted_and_told_to_its_caller(opened, link):
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


def test_silences_without_a_position_between_them_end_it(opened, link):
    head = opened()
    link.polls_fail = CutError("silent again and again")
    with pytest.raises(DeviceError, match="silent again and again"):
        ask_again_and_again(head)
    head.close()
    assert link.sent[-2:] == ["last halt", "closed"]


def test_a_head_that_does_not_arrive_is_not_opened_again(opened, link):
    head = opened()
    link.stuck = True
    with pytest.raises(DeviceError, match="did not arrive in time: pan 0, tilt 0 steps, where 1, 0 were commanded"):
        head.move(STEP, 0.0, wait=True)
    head.close()
    with pytest.raises(DeviceError, match="cotarget reset-head"):
        opened()


def test_a_mistake_in_the_last_halt_forgets_no_lost_position(opened, link):
    def halt_last(patience):
        raise ValueError("a mistake")

    head = opened()
    link.polls_fail = PositionLostError("COUNTER", "hit its limit")
    link.halt_last = halt_last
    with pytest.raises(DeviceError, match="hit its limit"):
        ask_again_and_again(head)
    head.close()
    with pytest.raises(DeviceError, match="cotarget reset-head"):
        opened()


def test_another_unit_than_configured_is_closed_without_a_move(opened, link):
    with pytest.raises(ConfigError, match=r"hardware.head.pan_deg: the unit at COUNTER goes from -90.0 to 90.0"):
        opened(pan_deg=(-180.0, 180.0))
    assert link.sent == ["closed"]


def test_a_newer_move_takes_the_place_of_one_that_waits(opened, link):
    head = opened()
    link.stuck = True
    send = link.move

    def newer(goals, speeds, proceed):
        link.move, link.stuck = send, False
        head.move(5 * STEP, 0.0)
        proceed()

    link.move = newer
    with pytest.raises(HaltedError, match="another move took this one's place"):
        head.move(STEP, 0.0, wait=True)


def test_a_mistake_in_a_link_is_told_with_its_file_and_line(opened, link):
    head = opened()
    link.polls_fail = ValueError("a mistake")
    with pytest.raises(DeviceError, match=r"failed: ValueError\('a mistake'\) \(.*test_another_head\.py:\d+\)$"):
        ask_again_and_again(head)
