"""`PolledHead` on a unit whose axes report both at once and take a move in one message, in simulated time."""

import itertools
import math
import signal
import threading
from dataclasses import replace

import pytest

from cotarget.config import SafetyConfig
from cotarget.drivers.axes import AxisFacts, Poll
from cotarget.drivers.head_link import HeadLink, Move, Requests
from cotarget.drivers.interlock import PositionLostMarker
from cotarget.drivers.lens import LensPositions
from cotarget.drivers.link_errors import CutError, LostError, PositionLostError, RefusedError, SilentError
from cotarget.drivers.polled_head import Loop, PolledHead, PolledHeadSettings
from cotarget.errors import ConfigError, DeviceError, HaltedError
from cotarget.schema import model
from tests.support.emulated_camera import DEADLINE_S
from tests.support.plants import fails, wait_for
from tests.support.simulated_clock import SimClock

STEP = math.radians(0.1)
STEPPER = {"step": 1, "slowest": 10, "fastest": 500, "acceleration": 1000, "still_s": 0.11, "loses_steps": True}
FACTS = AxisFacts(unit=STEP, lowest=-900, highest=900, **STEPPER)
SETTINGS = {"address": "COUNTER", "step_deg": 0.1, "pan_deg": (-90, 90), "tilt_deg": (-90, 90), "tilt_sign": -1}
SETTINGS |= {"speed_deg_s": 40.0, "command_delay_s": 0.0}
EXCHANGE_S = 0.01


@model
class Settings(PolledHeadSettings):
    """A polled head at an address."""

    address: str = ""


class CounterLink(HeadLink):
    """Exchange messages with a unit whose axes arrive at once."""

    name = "COUNTER"
    axes = (FACTS, FACTS)

    def __init__(self, clock):
        self.clock, self.requests = clock, Requests()
        self.at, self.sent = [0, 0], []
        self.fails = []  # errors of the next moves
        self.polls_fail = []  # errors of the next polls; the last one for ever before an Ellipsis
        self.stuck = self.restless = False
        self.meanwhile = lambda: None  # called once after the next move was sent, before a poll

    def poll(self, requests):
        self.requests = requests
        self.clock.sleep_until(self.clock.now() + EXCHANGE_S)
        if self.sent:
            act, self.meanwhile = self.meanwhile, lambda: None
            act()
        if self.polls_fail:
            error = self.polls_fail[0]
            if self.polls_fail[1:] != [...]:
                self.polls_fail.pop(0)
            if error is not None:
                raise error
        if self.restless:
            self.at[0] += 1
        return [Poll(axis, position, self.clock.now()) for axis, position in enumerate(self.at)]

    def move(self, goals, speeds, requests):
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

    def close(self):
        self.sent.append("closed")


@pytest.fixture
def link():
    return CounterLink(SimClock())


@pytest.fixture
def opened(link, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    heads = []

    def open_head(safety=None, **settings):
        config = Settings(**{**SETTINGS, **settings})
        safety = SafetyConfig(**{"stop_file": tmp_path / "stop", **(safety or {})})
        heads.append(PolledHead(lambda: link, config, link.clock, safety))
        return heads[-1]

    yield open_head
    for head in heads:
        head.close()
    assert not any(thread.name.startswith("head at") for thread in threading.enumerate())


def test_it_moves_in_its_units_with_its_signs(opened, link):
    head = opened()
    assert math.degrees(head.limits.pan.speed) == pytest.approx(40.0)
    pan, tilt = head.move(math.radians(10.04), math.radians(-120.0), wait=True)
    assert (math.degrees(pan), math.degrees(tilt)) == (pytest.approx(10.0), pytest.approx(-90.0))
    assert head.state().tilt == tilt
    head.move(0.0, 0.0, speed=(math.radians(10.0), math.radians(20.0)), wait=True)
    assert link.sent == [((100, 900), (400, 400)), ((0, 0), (100, 200))]


@pytest.mark.parametrize(("asked", "sent"), [(None, 400), (58.5 * STEP, 58.5), (1e-9, 10), (1e9, 400)])
def test_speeds_are_within_the_units_and_the_files_bounds(opened, link, asked, sent):
    opened().move(STEP, STEP, speed=asked, wait=True)
    assert link.sent == [((1, -1), pytest.approx((sent, sent)))]


def test_each_axis_has_its_limits_and_the_slower_one_to_brake_is_waited_for(opened, link):
    """Tilt turns at 30 degrees/s, where 40 are configured, and brakes from that in 3 s."""
    link.axes = (FACTS, replace(FACTS, fastest=300, acceleration=100))
    patience = []
    link.halt = patience.append
    head = opened()
    assert [axis.speed for axis in head.limits.axes] == pytest.approx([400 * STEP, 300 * STEP])
    assert [axis.acceleration for axis in head.limits.axes] == pytest.approx([1000 * STEP, 100 * STEP])
    head.halt()
    assert patience[0] >= 3.0


def test_closing_sends_a_last_halt_before_the_port_is_closed(opened, link):
    head = opened()
    head.halt()
    head.close()
    head.halt()
    assert link.sent == ["halt", "last halt", "closed"]
    for call in (head.state, lambda: head.move(0.0, 0.0)):
        with pytest.raises(DeviceError, match="COUNTER is closed"):
            call()


def test_closing_raises_in_a_move_that_waits(opened, link):
    head, said = opened(), []
    link.stuck, link.meanwhile = True, lambda: wait_for(link.requests.halt_waits)
    thread = threading.Thread(target=lambda: said.append(fails(lambda: head.move(STEP, 0.0, wait=True))))
    thread.start()
    wait_for(lambda: link.sent)
    head.close()
    thread.join(DEADLINE_S)
    assert said == ["the pan-tilt unit at COUNTER is closed"]


@pytest.mark.parametrize("wait", [True, False])
def test_a_refused_move_is_halted_and_raises_in_its_wait_or_the_next_call(opened, link, wait):
    head = opened()
    link.fails = [RefusedError("no")]
    if wait:
        with pytest.raises(DeviceError, match=r"^no$"):
            head.move(0.1, 0.1, wait=True)
    else:
        head.move(0.1, 0.1)
        assert fails(head.state) == "no"
    assert link.sent[-1] == "halt"
    head.move(0.2, 0.2, wait=True)


def test_a_newer_move_takes_the_place_of_one_that_waits(opened, link):
    head, said = opened(), []

    def newer():
        link.stuck = False
        head.move(5 * STEP, 0.0)

    link.stuck, link.meanwhile = True, newer
    thread = threading.Thread(target=lambda: said.append(fails(lambda: head.move(STEP, 0.0, wait=True))), daemon=True)
    thread.start()
    thread.join(DEADLINE_S)
    assert said == ["another move took this one's place"]


@pytest.mark.parametrize("between", [True, False])
def test_repeated_silence_without_a_position_ends_the_head(opened, link, between):
    head = opened()
    cut = CutError("silent for a while")
    link.polls_fail = [cut, cut, None] * 10 if between else [cut, ...]
    if between:
        wait_for(lambda: not link.polls_fail)
        head.move(STEP, 0.0, wait=True)
    else:
        assert fails(head.state) == "silent for a while"
        head.close()
        assert link.sent == ["last halt", "closed"]


@pytest.mark.parametrize(
    ("error", "said", "halted"),
    [
        (SilentError("it is silent"), "it is silent", True),
        (LostError("COUNTER", OSError("gone")), "is lost", False),
        (ValueError("a mistake"), "test_polled_head.py:", True),  # a mistake in a link is named by file and line
    ],
)
def test_an_error_ends_in_a_last_halt_unless_the_port_is_lost(opened, link, error, said, halted):
    head = opened()
    link.polls_fail = [error, ...]
    for call in (lambda: head.move(STEP, 0.0, wait=True), head.state):
        assert said in fails(call)
    if halted:
        head.halt()
    else:
        assert said in fails(head.halt)
    head.close()
    assert [each for each in link.sent if isinstance(each, str)] == ["last halt", "closed"] if halted else ["closed"]
    link.polls_fail = []
    opened().move(STEP, 0.0, wait=True)  # the position is not lost


LIMIT = [PositionLostError("COUNTER", "hit its limit"), ...]
# How a position is lost: whether while the head is opened, attributes of the link then, and a text of the error.
EVENTS = {
    "a limit while it is opened": (True, {"polls_fail": LIMIT}, "hit its limit"),
    "a limit": (False, {"polls_fail": LIMIT}, "hit its limit"),
    "a limit, and a mistake in the last halt": (False, {"polls_fail": LIMIT, "halt_last": None}, "hit its limit"),
    "a stall": (False, {"stuck": True}, "pan 0, tilt 0, where 1, 0 were commanded"),
}


@pytest.mark.parametrize("stop_file", [False, True])
@pytest.mark.parametrize("event", EVENTS)
def test_a_lost_position_is_remembered_until_the_unit_was_reset(opened, link, tmp_path, event, stop_file):
    """By every later program, which does not even open the port; beside the stop file, if there is one."""
    opening, changes, words = EVENTS[event]
    safety = {"stop_file": tmp_path / "run" / "stop" if stop_file else None}
    head = None if opening else opened(safety)
    vars(link).update(changes)
    said = fails(lambda: opened(safety) if opening else head.move(STEP, 0.0, wait=True))
    assert words in said
    if head:
        assert fails(head.state) == said
        head.close()
    file = tmp_path / ("run/stop.COUNTER.position-lost" if stop_file else "cotarget/head.COUNTER.position-lost")
    assert file.read_text() == f"{said}\n"
    link.sent.clear()
    for port in ("COUNTER", "ANOTHER"):  # as an adapter that was replugged may have
        again = fails(lambda port=port: opened(safety, address=port))
        assert again.startswith(said)
        assert str(file) in again
    assert link.sent == []
    PositionLostMarker("COUNTER", safety["stop_file"]).forget()
    vars(link).update(polls_fail=[], stuck=False, halt_last=lambda patience: None)
    opened(safety).state()


SERVO = replace(FACTS, slack=3, loses_steps=False)


class ServoLink(CounterLink):
    """A servo that ends off its goal by a few steps, and trembles by one."""

    axes = (SERVO, SERVO)
    off = 2

    def poll(self, requests):
        polls = super().poll(requests)
        tremble = round(self.clock.now() / EXCHANGE_S) % 2
        return [poll._replace(position=poll.position + self.off + tremble) for poll in polls]


def test_a_servo_arrives_within_its_slack_and_never_loses_its_position(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    link, settings = ServoLink(SimClock()), Settings(**SETTINGS)
    head = PolledHead(lambda: link, settings, link.clock)
    for goal in (10 * STEP, 0.0):
        head.move(goal, 0.0, wait=True)
        assert not head.state().moving
        assert head.state().pan == pytest.approx(goal + 2.5 * STEP, abs=0.6 * STEP)
    assert head.limits.pan.slack == pytest.approx(3 * STEP)
    link.stuck = True  # something is in its way
    said = fails(lambda: head.move(500 * STEP, 0.0, wait=True))
    assert "did not arrive in time" in said
    assert "reset-head" not in said
    link.stuck = False
    head.move(500 * STEP, 0.0, wait=True)
    link.off = 5
    assert "more slack" in fails(lambda: head.move(0.0, 0.0, wait=True))
    head.close()
    link.off = 0
    PolledHead(lambda: link, settings, link.clock).close()  # no marker keeps it from being opened again


class SaggingLink(ServoLink):
    """A servo that sags by two steps wherever it is sent, and tells its goal."""

    def poll(self, requests):
        return [poll._replace(position=poll.position + self.off) for poll in CounterLink.poll(self, requests)]

    def goals(self):
        return tuple(self.at)


def test_an_axis_that_is_sent_to_where_it_stands_keeps_its_goal(tmp_path, monkeypatch):
    """As `point` does with an axis that is not asked for, from one program to the next."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    link, settings = SaggingLink(SimClock()), Settings(**SETTINGS)
    link.at = [10, 0]
    for pan in (20, 30):
        head = PolledHead(lambda: link, settings, link.clock)
        head.move(pan * STEP, head.state().tilt, wait=True)
        head.close()
        assert link.at == [pan, 0]


def test_axes_of_two_scales(opened, link):
    """Advice that is followed is right."""
    link.axes = (FACTS, replace(FACTS, unit=STEP / 2, lowest=-1800, highest=1800, fastest=2000))
    with pytest.raises(ConfigError, match=r"^hardware\.head\.step_deg: .* write step_deg = \[0\.1, 0\.05\]"):
        opened()
    link.sent.clear()
    head = opened(step_deg=(0.1, 0.05))
    assert [axis.step for axis in head.limits.axes] == pytest.approx([STEP, STEP / 2])
    head.move(10 * STEP, 10.5 * STEP, wait=True)
    assert link.sent == [((10, -21), (400, 800))]


# Units that are no steppers

DEGREES = AxisFacts(
    unit=math.radians(1.0), lowest=-90.0, highest=90.0, fastest=60.0, step=0.0, slack=0.2, loses_steps=False
)
LENS = AxisFacts(unit=1.0, lowest=0.0, highest=1000.0, fastest=800.0, step=1.0, loses_steps=False)
RATES = (30.0, 20.0, 800.0)  # [degrees/s, degrees/s, 1/s]
SIGMA = 0.1  # [degrees]


class Turret(HeadLink):
    """Continuous pan and tilt in degrees, and a lens of 0 to 1000, which turn while polls pass the time."""

    name, axes = "TURRET", (DEGREES, DEGREES, LENS)
    says = False  # whether it says that it moves

    def __init__(self, clock):
        self.clock, self.sent = clock, []
        self.at, self.goal = [0.0] * 3, [0.0] * 3

    def poll(self, requests):
        self.clock.sleep_until(self.clock.now() + EXCHANGE_S)
        self.turn()
        moving = [at != goal if self.says else None for at, goal in zip(self.at, self.goal, strict=True)]
        return [Poll(i, at, self.clock.now(), moving[i], SIGMA) for i, at in enumerate(self.at)]

    def turn(self):
        for i, (at, goal, rate) in enumerate(zip(self.at, self.goal, RATES, strict=True)):
            way = goal - at
            self.at[i] = goal if abs(way) <= rate * EXCHANGE_S else at + math.copysign(rate * EXCHANGE_S, way)

    def move(self, goals, speeds, requests):
        self.sent.append(goals)
        self.goal[:2] = goals

    def zoom(self, position, requests):
        self.goal[2] = position

    def halt(self, patience):
        self.sent.append(patience)
        self.goal[:2] = self.at[:2]

    def close(self):
        pass


class VelocityTurret(Turret):
    """A turret that takes velocities, each until the next; the last ones are slow."""

    LASTS_S, GAIN = math.inf, 1.0
    rates, until = (0.0, 0.0), 0.0

    def turn(self):
        if self.clock.now() < self.until:
            self.at[:2] = [at + rate * EXCHANGE_S for at, rate in zip(self.at[:2], self.rates, strict=True)]

    def move(self, goals, speeds, requests):
        self.wanted = goals
        self.renew(requests)

    def renew(self, requests):
        self.rates = tuple(
            max(-rate, min(rate, self.GAIN * (goal - at)))
            for goal, at, rate in zip(self.wanted, self.at, RATES, strict=False)
        )
        self.until = self.clock.now() + self.LASTS_S
        self.sent.append(self.rates)

    def halt(self, patience):
        super().halt(patience)
        self.rates = (0.0, 0.0)


@pytest.fixture
def turret(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    heads = []

    def open_head(kind=Turret, **changes):
        link = kind(SimClock())
        vars(link).update(changes)
        heads.append(PolledHead(lambda: link, Settings(**{**SETTINGS, "step_deg": 0.0, "tilt_sign": 1}), link.clock))
        return heads[-1], link

    yield open_head
    for head in heads:
        head.close()


@pytest.mark.parametrize("kind", [Turret, VelocityTurret])
def test_a_continuous_head_arrives_within_its_slack(turret, kind):
    head, _ = turret(kind)
    assert (head.limits.pan.step, head.limits.pan.acceleration) == (0.0, None)
    wanted = math.radians(10.37), math.radians(-5.2)
    assert head.move(*wanted, wait=True) == pytest.approx(wanted)
    state = head.state()
    assert (state.pan, state.tilt) == pytest.approx(wanted, abs=math.radians(0.2))
    assert (state.moving, state.sigma) == (False, pytest.approx(math.radians(SIGMA)))


def test_velocities_are_renewed_until_the_head_arrives_or_is_halted(turret):
    head, link = turret(VelocityTurret)
    head.move(math.radians(60.0), 0.0, wait=True)
    assert len(link.sent) > 10
    at, begin = link.at[0], link.clock.now()
    wait_for(lambda: link.clock.now() > begin + 1.0)
    assert link.at[0] == at == pytest.approx(60.0, abs=DEGREES.slack)  # it does not creep on
    link.sent.clear()
    head.move(math.radians(-60.0), 0.0)
    wait_for(lambda: link.at[0] < 50.0)
    head.halt()
    after = link.sent[-1]
    begin = link.clock.now()
    wait_for(lambda: link.clock.now() > begin + 1.0)
    assert link.sent[-1] == after > 0.0  # the halt's patience, and no velocity since


def test_a_head_that_does_not_come_to_rest_at_its_goal_is_an_error(turret):
    """As one whose flag of motion stays set."""
    head, link = turret()
    link.poll = lambda requests: [poll._replace(moving=True) for poll in Turret.poll(link, requests)]
    assert "moving=None" in fails(lambda: head.move(math.radians(10.0), 0.0, wait=True))


@pytest.mark.parametrize(("poll", "said"), [
    (lambda t: [], "has reported no position"),
    (lambda t: [Poll(axis, math.nan, t) for axis in range(3)], "pan is reported to be at nan"),
    (lambda t: [Poll(axis, 1.0, t, sigma=math.nan) for axis in range(3)], "standard deviation of nan"),
    (lambda t: [Poll(axis, 1.0, 0.0) for axis in range(3)], "of pan and tilt and the lens with a later time"),
    (lambda t: [Poll(axis, 1.0, t) for axis in range(2)], "of the lens with a later time"),
    (lambda t: [Poll(axis, 1.0, t, moving=True) for axis in range(3)], "moving=None"),
])  # fmt: skip
def test_a_unit_that_reports_nothing_usable_is_refused(tmp_path, monkeypatch, poll, said):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    link = Turret(SimClock())

    def polled(requests):
        link.clock.sleep_until(link.clock.now() + EXCHANGE_S)
        return poll(link.clock.now())

    link.poll = polled
    with pytest.raises(DeviceError, match=said):
        PolledHead(lambda: link, Settings(**{**SETTINGS, "step_deg": 0.0}), link.clock)


def test_a_head_that_trembles_to_both_sides_stands(turret):
    head, link = turret()
    link.turn = lambda: setattr(link, "at", [10.0 + 0.2 * (-1) ** round(link.clock.now() / EXCHANGE_S), 0.0, 0.0])
    head.move(math.radians(10.0), 0.0, wait=True)
    assert not head.state().moving


@pytest.mark.parametrize(("says", "delay_s"), [(True, 0.0), (False, DEGREES.still_s)])
def test_a_head_that_says_whether_it_moves_is_believed(says, delay_s):
    link = Turret(SimClock())
    link.says = says
    loop, move = Loop(link, link.clock, 0.0), Move(1, (30.0, 0.0), (60.0, 60.0))
    loop.requests.add(loop.requests.moves, move)
    begin = link.clock.now()
    while not move.done.is_set():
        loop.turn()
    assert link.clock.now() - begin == pytest.approx(30.0 / RATES[0] + delay_s, abs=2 * EXCHANGE_S)


def test_the_lens_may_be_a_third_axis(turret):
    head, link = turret()
    lens = head.lens(LensPositions(((0, 100.0), (1000, 1000.0)), range(1001)))
    assert lens.focal_range == pytest.approx((100.0, 1000.0))
    head.move(math.radians(30.0), 0.0)
    lens.zoom(900.0)
    said = lens.zoom(100.0 * 10**0.8)
    assert (said, lens.state().moving) == (pytest.approx(100.0 * 10**0.8), True)
    wait_for(lambda: not lens.state().moving)
    assert (lens.state().focal_px, link.goal[2]) == (pytest.approx(said), 800)
    head.move(0.0, 0.0)
    lens.zoom(100.0)
    head.halt()  # stops pan and tilt
    wait_for(lambda: not lens.state().moving)
    assert lens.state().focal_px == pytest.approx(100.0)
    link.zoom = lambda position, requests: None  # something blocks it
    lens.zoom(500.0)
    wait_for(lambda: head._loop.lens_errors)
    assert "the lens at TURRET did not arrive" in fails(lens.state)
    assert not lens.state().moving
    for wrong in (0.0, math.nan, math.inf):
        assert "cannot go" in fails(lambda wrong=wrong: lens.zoom(wrong))


def test_moves_and_zooms_take_turns():
    """Each move comes before the poll of the one before is over, as over a slow line."""
    link, sent = Turret(SimClock()), []
    loop, numbers = Loop(link, link.clock, 0.0), itertools.count(1)
    link.move, link.zoom = lambda *_: sent.append("move"), lambda *_: sent.append("zoom")
    for _ in range(8):
        loop.requests.add(loop.requests.moves, Move(next(numbers), (30.0, 0.0), (60.0, 60.0)))
        loop.requests.add(loop.requests.zooms, 500.0)
        loop.turn()
    assert sent == ["move", "zoom", "move", "zoom"]


def test_a_lens_that_has_not_started_yet_moves(turret):
    head, link = turret(zoom=lambda position, requests: None)
    lens = head.lens(LensPositions(((0, 100.0), (1000, 1000.0)), range(1001)))
    lens.zoom(500.0)
    begin = link.clock.now()
    wait_for(lambda: link.clock.now() > begin + LENS.still_s + 0.5)
    assert lens.state().moving


@pytest.mark.parametrize("lacks", ["poll", "move", "halt", "close"])
def test_a_link_without_one_of_its_own_methods_is_refused(tmp_path, monkeypatch, lacks):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    own = {name: vars(Turret)[name] for name in vars(Turret) if name != lacks}
    link = type("Lacking", (HeadLink,), {**own, "__abstractmethods__": frozenset()})(SimClock())
    with pytest.raises(ConfigError, match=f"Lacking has no {lacks}"):
        PolledHead(lambda: link, Settings(**{**SETTINGS, "step_deg": 0.0}), link.clock)


def test_a_pause_between_polls_holds_up_no_request(turret):
    head, link = turret()
    link.pause_s = DEADLINE_S
    head.move(math.radians(80.0), 0.0)
    head.halt()
    assert link.sent[-1] >= 1.0  # the halt's patience covers the time that domes were seen to turn on
    head.close()
    assert not any(thread.name.startswith("head at") for thread in threading.enumerate())


# Halts


def test_halts_from_many_threads(opened, link):
    head = opened()
    link.stuck, link.meanwhile = True, lambda: wait_for(link.requests.halt_waits)
    head.move(STEP, 0.0)
    threads = [threading.Thread(target=head.halt) for _ in range(5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(DEADLINE_S)
        assert not thread.is_alive()
    assert link.sent[-1] == "halt"


def test_a_signal_handler_may_halt_whatever_it_interrupts(opened, link):
    head, halted = opened(), []

    def handler(*_):
        head.halt()
        halted.append(link.sent[-1] == "halt")

    def interrupt():
        signal.pthread_kill(threading.main_thread().ident, signal.SIGUSR1)
        wait_for(link.requests.halt_waits)

    link.stuck, link.meanwhile = True, interrupt
    before = signal.signal(signal.SIGUSR1, handler)
    try:
        with pytest.raises(HaltedError):
            head.move(STEP, 0.0, wait=True)
        for _ in range(50):
            signal.raise_signal(signal.SIGUSR1)
            head.state()
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert halted == [True] * 51


def test_a_halted_move_may_be_commanded_again(opened, link):
    head = opened()
    halts = threading.Thread(target=head.halt)

    def halt():
        halts.start()
        wait_for(link.requests.halt_waits)

    link.stuck, link.meanwhile = True, halt
    with pytest.raises(HaltedError):
        head.move(STEP, 0.0, wait=True)
    halts.join(DEADLINE_S)
    link.stuck = False
    head.move(STEP, 0.0, wait=True)
    assert head.state().pan == pytest.approx(STEP)


def test_a_halt_of_a_dead_unit_is_sent_and_raises(opened, link):
    def silent(*_):
        raise SilentError("it is silent")

    head = opened()
    link.polls_fail, link.halt_last = [SilentError("it is silent"), ...], silent
    for call in (head.state, head.halt):
        assert "silent" in fails(call)
    assert link.sent == ["halt without an answer"]


def test_a_link_that_hangs_holds_up_neither_a_halt_nor_the_end(opened, link, monkeypatch, caplog):
    for limit in ("HALT_S", "CLOSE_S"):
        monkeypatch.setattr(f"cotarget.drivers.polled_head.{limit}", 0.01)
    hangs, release = threading.Event(), threading.Event()

    def poll(requests):
        hangs.set()
        release.wait(DEADLINE_S)
        return CounterLink.poll(link, requests)

    head = opened()
    link.poll = poll
    assert hangs.wait(DEADLINE_S)
    with pytest.raises(DeviceError, match="COUNTER did not acknowledge a halt"):
        head.halt()
    head.close()
    assert "does not end" in caplog.text
    release.set()
    wait_for(lambda: not any(thread.name.startswith("head at") for thread in threading.enumerate()))


# What ends a start: settings, safety, the link's attributes, and the key or text of the error.
STARTS = {
    "too slow": ({"speed_deg_s": 0.5}, {}, {}, r"^hardware\.head\.speed_deg_s: .* 1 at least"),
    "too low a cap": ({}, {"speed_deg_s": 0.5}, {}, r"^safety\.speed_deg_s: .* 1 at least"),
    "a mistake": ({}, {}, {"polls_fail": [ValueError("a mistake"), ...]}, "a mistake"),
    "no rest": ({}, {}, {"restless": True}, "does not come to rest"),
}


@pytest.mark.parametrize("name", STARTS)
def test_a_start_that_fails_ends_in_a_halt_and_closes_the_port(opened, link, name):
    settings, safety, changes, said = STARTS[name]
    for attribute, value in changes.items():
        setattr(link, attribute, value)
    with pytest.raises((ConfigError, DeviceError, ValueError), match=said):
        opened(safety, **settings)
    assert link.sent == ["last halt", "closed"]


@pytest.mark.parametrize("missing", ["poll", "axes", "name", "close"])
def test_a_link_without_a_required_part_is_refused_and_closed(link, missing):
    class Lacking:
        def __getattr__(self, name):
            if name == missing:
                raise AttributeError(name)
            return getattr(link, name)

    with pytest.raises(ConfigError, match=f"^hardware.head.driver: Lacking has no {missing}"):
        PolledHead(Lacking, Settings(**SETTINGS), link.clock)
    assert link.sent == ([] if missing == "close" else ["closed"])
