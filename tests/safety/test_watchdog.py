"""The watchdog: exact in simulated time, and in real time by its thread, which a hung program cannot stop."""

import logging
import math
import os
import threading
import time
from types import SimpleNamespace

import pytest

from cotarget.config import SafetyConfig, SimHead
from cotarget.errors import DeviceError, EmergencyStopError, StaleFrameError
from cotarget.rig import Frame, PanTiltState
from cotarget.safety import stop_file, watchdog
from tests.support.rigs import guarded, with_axes
from tests.support.safety_rigs import DEADLINE_S, IMAGE, RealDevices, SimulatedDevices

WATCHDOG_S = 0.35  # the default
FAR = math.radians(100)
EXACT = 1e-9  # rounding of times and angles
SHORT_S = 0.1  # a watchdog for tests in real time
TIMELY_S = 1.0  # beyond the watchdog's time, for a thread of a busy machine to wake up; it takes 1 ms on an idle one
NOT_HALTED = "the head could not be halted, and may go on to the goal of its last command"


@pytest.fixture
def rig():
    return SimulatedDevices()


@pytest.fixture
def safe(rig):
    with guarded(rig, SafetyConfig()) as opened:
        yield opened


@pytest.fixture
def real():
    """A rig in real time, and its safe one with a short watchdog."""
    rig = RealDevices()
    with guarded(rig, SafetyConfig(watchdog_s=SHORT_S)) as safe:
        yield rig, safe
        rig.head.failing = 0
    assert "cotarget-watchdog" not in {thread.name for thread in threading.enumerate()}


def warnings(caplog):
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


def test_a_head_without_a_sign_of_life_is_halted_after_the_watchdogs_time(rig, safe, caplog):
    safe.head.move(FAR, 0.0)
    safe.clock.sleep_until(10.0)
    assert rig.head.halts == [pytest.approx(WATCHDOG_S, abs=EXACT)]
    # It sped up for half a second and braked as long: a t^2 in all, far from its goal.
    acceleration = math.radians(SimHead().accel_deg_s2)
    assert acceleration * WATCHDOG_S < math.radians(SimHead().speed_deg_s)
    step = rig.head.limits.pan.step
    assert safe.head.state().pan == pytest.approx(acceleration * WATCHDOG_S**2, abs=step)
    assert warnings(caplog) == ["halting the head: neither a fresh frame nor a command for 0.35 s"]
    safe.head.move(FAR, 0.0)  # obeyed and watched again
    safe.clock.sleep_until(20.0)
    assert rig.head.halts[1:] == [pytest.approx(10.0 + WATCHDOG_S, abs=EXACT)]


SIGNS_OF_LIFE = {
    "frame of the fixed camera": lambda safe: safe.fixed.read(newer_than=safe.clock.now()),
    "frame of the zoom camera": lambda safe: safe.zoom.read(newer_than=safe.clock.now()),
    "still": lambda safe: safe.zoom.capture(),
    "command": lambda safe: safe.clock.sleep_until(safe.clock.now() + 0.3) or safe.head.move(FAR, 0.0),
}


@pytest.mark.parametrize("sign", SIGNS_OF_LIFE.values(), ids=SIGNS_OF_LIFE.keys())
def test_fresh_frames_and_commands_are_signs_of_life(rig, safe, sign):
    safe.head.move(FAR, 0.0)
    while safe.clock.now() < 3.0:
        sign(safe)
    assert safe.head.state().pan == pytest.approx(FAR, abs=rig.head.limits.pan.step)
    assert not rig.head.halts


def test_a_frozen_frame_is_no_sign_of_life(rig, safe):
    rig.fixed.frozen_at = 0.0
    last = safe.fixed.read() and safe.clock.now()
    safe.head.move(FAR, 0.0)
    while safe.clock.now() < 0.6:
        safe.fixed.read()
    assert len(rig.head.halts) == 1
    assert WATCHDOG_S <= rig.head.halts[0] - last <= WATCHDOG_S + rig.fixed.period


def test_reading_the_heads_state_is_no_sign_of_life(rig, safe):
    safe.head.move(FAR, 0.0)
    while safe.clock.now() < 2.0:
        safe.head.state()
        safe.clock.sleep_until(safe.clock.now() + 0.02)
    assert rig.head.halts == [pytest.approx(WATCHDOG_S, abs=EXACT)]


@pytest.mark.parametrize("camera", ["fixed", "zoom"])
def test_a_dead_camera_halts_the_head_before_its_timeout(rig, safe, camera):
    getattr(rig, camera).dead = True
    safe.head.move(FAR, 0.0)
    with pytest.raises(StaleFrameError, match="no frame"):
        getattr(safe, camera).read(timeout=1.0)
    assert rig.head.halts == [pytest.approx(WATCHDOG_S, abs=EXACT)]
    assert safe.clock.now() == pytest.approx(1.0, abs=EXACT)


def test_a_head_that_has_arrived_is_not_watched(rig, safe, caplog):
    """As in a capture session, where a person then holds the board; the way itself takes longer than the watchdog."""
    safe.head.move(FAR, 0.0, wait=True)
    assert safe.clock.now() > 2 * WATCHDOG_S
    safe.clock.sleep_until(60.0)
    assert safe.head.state().pan == pytest.approx(FAR, abs=rig.head.limits.pan.step)
    assert not rig.head.halts
    assert not warnings(caplog)


def test_a_head_that_reports_rest_at_its_goal_is_not_watched(rig, safe, caplog):
    safe.head.move(0.01, 0.0)
    safe.head.state()  # about to move: not at rest yet
    safe.clock.sleep_until(0.3)
    assert not safe.head.state().moving
    safe.clock.sleep_until(60.0)
    assert not rig.head.halts
    assert not warnings(caplog)


@pytest.mark.parametrize("goal", [(FAR, 0.0), (0.0, math.radians(20))], ids=["pan", "tilt"])
def test_a_head_that_rests_off_its_goal_is_watched(rig, safe, goal):
    """It has not started: one axis is at its goal, the other is not."""
    rig.head.state = lambda: PanTiltState(0.0, 0.0, moving=False, t=rig.clock.now())
    safe.head.move(*goal)
    safe.head.state()
    safe.clock.sleep_until(10.0)
    assert rig.head.halts == [pytest.approx(WATCHDOG_S, abs=EXACT)]


def test_a_servo_that_rests_within_its_slack_has_arrived(rig):
    rig.head.limits = with_axes(rig.head.limits, slack=math.radians(0.3))
    rig.head.state = lambda: PanTiltState(math.radians(0.35), 0.0, moving=False, t=rig.clock.now())
    with guarded(rig, SafetyConfig()) as safe:
        safe.head.move(0.0, 0.0)
        safe.head.state()
        safe.clock.sleep_until(10.0)
        assert not rig.head.halts


def test_a_state_from_before_the_command_does_not_end_its_watch(rig, safe):
    """As of a head that is polled over a network: its last state shows rest where it is sent to again."""
    safe.clock.sleep_until(1.0)
    rig.head.state = lambda: PanTiltState(0.0, 0.0, moving=False, t=0.9)
    safe.head.move(0.0, 0.0)
    safe.head.state()
    safe.clock.sleep_until(10.0)
    assert rig.head.halts == [pytest.approx(1.0 + WATCHDOG_S, abs=EXACT)]


@pytest.mark.parametrize("by_wait", [False, True])
@pytest.mark.parametrize("outside", [(1.2, 0.0), (0.0, -0.6)])
def test_a_head_that_leaves_its_soft_limits_is_stopped(rig, outside, by_wait, caplog):
    limits = SafetyConfig(pan_deg=(-60.0, 60.0), tilt_deg=(-30.0, 30.0))
    pose = outside
    rig.head.state = lambda: PanTiltState(*pose, moving=False, t=rig.clock.now())
    with guarded(rig, limits) as safe:
        safe.head.state()  # from the start, as after the limits were narrowed: it may be led inside
        assert "stands beyond its soft limits" in caplog.text
        safe.head.move(0.0, 0.0)
        pose = (0.0, 0.0)
        if by_wait:  # a move that has arrived shows that the head is inside
            safe.head.move(0.0, 0.0, wait=True)
        else:
            safe.head.state()
        assert not rig.head.halts
        pose = outside
        safe.head.state()
        assert len(rig.head.halts) == 1
        with pytest.raises(EmergencyStopError, match="left its soft limits"):
            safe.head.move(0.0, 0.0)
        safe.clear()
        safe.head.state()
        safe.head.move(0.0, 0.0)


def test_a_state_from_before_the_arrival_shows_no_head_that_left_its_limits(rig):
    """A head polled over a network starts outside; its last state is from before the move that led it inside."""
    with guarded(rig, SafetyConfig(pan_deg=(-45.0, 45.0))) as safe:
        rig.clock.sleep_until(1.0)
        rig.head.state = lambda: PanTiltState(1.2, 0.0, moving=False, t=0.9)
        safe.head.state()
        safe.head.move(0.5, 0.0, wait=True)
        safe.head.state()
        assert safe.stopped is None


def test_a_head_that_passes_its_goal_is_watched(rig, safe):
    """A moving head is sent to where it is: it is at its goal, and overshoots."""
    safe.head.move(FAR, 0.0)
    safe.clock.sleep_until(0.3)
    safe.head.move(safe.head.state().pan, 0.0)
    assert safe.head.state().moving
    safe.clock.sleep_until(10.0)
    assert rig.head.halts == [pytest.approx(0.3 + WATCHDOG_S, abs=EXACT)]


def test_time_that_passes_outside_of_calls_counts(rig, safe):
    safe.head.move(FAR, 0.0)
    rig.clock.sleep_until(0.7)
    safe.head.state()
    assert rig.head.halts == [0.7]


def test_a_frame_that_arrives_while_the_watchdog_reads_the_clock_is_a_sign_of_life():
    """As for a thread of a busy machine that is suspended there."""
    head, clock = RealDevices().head, SimpleNamespace(now=lambda: 0.0)
    watched = watchdog.Watchdog(head, clock, SafetyConfig(), threaded=False)
    watched.begin((1.0, 0.0))

    def now():
        watched.alive(2 * WATCHDOG_S)
        return 2 * WATCHDOG_S

    clock.now = now
    watched.watch()
    assert head.log == []


def test_a_clock_that_runs_backwards_halts_the_head(caplog):
    rig = SimulatedDevices()
    now = [100.0]
    rig.clock = SimpleNamespace(now=lambda: now[0], sleep_until=lambda t: None)
    with guarded(rig, SafetyConfig()) as safe:
        safe.head.move(FAR, 0.0)
        now[0] = 40.0
        safe.head.state()
        assert len(rig.head.halts) == 1
        assert warnings(caplog) == ["halting the head: the rig's clock ran backwards by 60 s"]
        safe.head.move(FAR, 0.0)  # a fresh command by the new time is allowed
        now[0] = math.nan
        safe.head.state()
        assert len(rig.head.halts) == 2
        now[0] = 41.0


def test_a_failed_halt_is_logged_and_repeated_before_the_next_command(rig, safe, caplog):
    safe.head.move(FAR, 0.0)
    rig.head.broken = 3
    safe.clock.sleep_until(1.0)  # the first try
    errors = [r.getMessage() for r in caplog.records if r.levelno == logging.ERROR]
    assert len(errors) == 1
    assert "could not be halted" in errors[0]
    assert "the cable is out" in errors[0]
    with pytest.raises(DeviceError, match="does not move before it could be halted: the cable is out"):
        safe.head.move(FAR, 0.0)  # the second
    safe.head.state()  # the third
    assert not rig.head.halts
    said = safe.head.move(FAR, 0.0)  # the fourth is obeyed, and so is the command
    assert said[0] == pytest.approx(FAR, abs=rig.head.limits.pan.step)
    assert [what for what, _ in rig.head.log] == ["move", "halt", "move"]
    assert warnings(caplog)[-1] == "the head is halted now"


def test_a_failed_halt_of_the_program_is_repeated(rig, safe):
    safe.head.move(FAR, 0.0)
    rig.head.broken = 1
    with pytest.raises(OSError, match="cable"):
        safe.head.halt()
    safe.head.state()
    assert len(rig.head.halts) == 1


@pytest.mark.wire
@pytest.mark.parametrize("where", ["reading", "commanding", "computing"])
def test_the_head_of_a_hung_program_is_halted(where, caplog):
    """With the default watchdog; the program hangs until the head is halted."""
    rig = RealDevices()
    halted_at = []
    halt = rig.head.halt
    rig.head.halt = lambda: (halted_at.append(time.monotonic()), halt())
    with guarded(rig, SafetyConfig()) as safe:
        if where == "commanding":
            rig.head.hang = rig.head.wait_for_halt
        if where == "reading":
            rig.fixed.read = lambda *a: (rig.head.wait_for_halt(), Frame(IMAGE, rig.clock.now()))[1]
        begun = time.monotonic()
        safe.head.move(1.0, 0.0)
        if where == "reading":
            safe.fixed.read()
        rig.head.wait_for_halt()
    late = halted_at[0] - begun - WATCHDOG_S
    print(f"{where}: halted {late * 1000:.1f} ms after the watchdog's time")
    assert -0.01 < late < TIMELY_S
    assert warnings(caplog)[0].startswith("halting the head: neither")


@pytest.mark.wire
def test_frames_that_a_camera_repeats_are_no_sign_of_life(real):
    """They have new times, as of a stream whose encoder stands."""
    rig, safe = real
    rig.fixed.read = lambda *a: Frame(IMAGE, rig.clock.now(), repeated=True)
    safe.head.move(1.0, 0.0)
    deadline = time.monotonic() + DEADLINE_S
    while not rig.head.halted.is_set():
        safe.fixed.read()
        assert time.monotonic() < deadline


@pytest.mark.wire
def test_a_command_that_hung_during_a_halt_is_halted_when_it_returns(real):
    rig, safe = real
    rig.head.hang = rig.head.wait_for_halt
    safe.head.move(1.0, 0.0)
    assert rig.head.log == ["move", "halt", "moved", "halt"]
    rig.head.hang = lambda: None
    safe.head.move(1.0, 0.0)
    assert rig.head.log[4:6] == ["move", "moved"]


@pytest.mark.wire
def test_a_state_read_during_a_command_does_not_end_its_watch(real):
    """The head rests at the goal already, but the command that hangs is still to come."""
    rig, safe = real
    rig.head.hang = lambda: (safe.head.state(), rig.head.wait_for_halt())
    safe.head.move(0.0, 0.0)
    assert rig.head.log == ["move", "halt", "moved", "halt"]


TICK_S = 0.001  # between looks at a head that never arrives


@pytest.mark.parametrize(("goal", "speed", "way_s"), [
    # The head reaches 4 rad/s after 0.1 s. It may move the other way: it brakes, comes back from 0.4 rad and speeds up.
    ((1.0, 0.0), None, 1.4 / 4 + 3 * 0.1),
    ((0.2, -1.0), None, 1.4 / 4 + 3 * 0.1),  # the longer way counts
    ((1.0, 0.5), (4.0, 1.0), 0.9 / 1 + 1.0 / 40 + 2 * 0.1),  # the axis that arrives last counts
    ((0.0, 0.0), None, 0.4 / 4 + 3 * 0.1),
])  # fmt: skip
def test_a_device_may_wait_longer_than_a_driver_does(goal, speed, way_s):
    """On a clock that the waiting device itself turns."""
    now = [0.0]
    rig = RealDevices(SimpleNamespace(now=lambda: now[0], sleep_until=lambda t: None))
    rig.real_time = False  # so that calls watch, and no thread
    rig.head.state = lambda: PanTiltState(0.0, 0.0, True, now[0])
    with guarded(rig, SafetyConfig(watchdog_s=SHORT_S)) as safe:

        def wait():
            while not rig.head.halted.is_set():
                now[0] += TICK_S
                safe.head.state()

        rig.head.hang = wait
        safe.head.move(*goal, speed=speed, wait=True)
    assert now[0] == pytest.approx(1.5 * way_s + 3.5 + SHORT_S, abs=TICK_S)


@pytest.mark.wire
def test_the_thread_repeats_the_halt_until_it_succeeds(real, caplog):
    rig, safe = real
    rig.head.failing = 3
    safe.head.move(1.0, 0.0)
    rig.head.wait_for_halt()
    safe.close()
    assert rig.head.log == ["move", "moved", "failed", "failed", "failed", "halt", "halt"]
    assert [record.levelname for record in caplog.records][:2] == ["WARNING", "ERROR"]


def test_closing_does_not_log_the_error_that_ended_the_run_again(caplog):
    rig = RealDevices()
    rig.head.failing = 1000
    with pytest.raises(DeviceError, match="the cable is out"), guarded(rig, SafetyConfig()):
        raise DeviceError("the cable is out")
    assert [record.getMessage() for record in caplog.records] == [NOT_HALTED]


@pytest.mark.wire
@pytest.mark.parametrize("why", [None, ValueError])
def test_a_head_that_cannot_be_halted_is_logged_once(caplog, why):
    """When it happens, and when the rig is closed; not at each further try."""
    rig = RealDevices()
    rig.head.failing = 1000
    ends = pytest.raises(OSError, match="cable") if why is None else pytest.raises(why)
    with ends, guarded(rig, SafetyConfig(watchdog_s=SHORT_S)) as safe:
        safe.head.move(1.0, 0.0)
        deadline = time.monotonic() + DEADLINE_S
        while not any("will be halted again" in record.getMessage() for record in caplog.records):
            assert time.monotonic() < deadline
        if why is not None:
            raise why
    errors = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    assert errors[0] == "the head could not be halted and will be halted again: the cable is out"
    assert errors[1:] == ([] if why is None else [NOT_HALTED])


@pytest.mark.wire
def test_a_clock_that_fails_stops_the_head():
    def now():
        if broken:
            raise OSError("no such clock")
        return time.monotonic()

    broken = []
    rig = RealDevices(SimpleNamespace(now=now, sleep_until=lambda t: None))
    with guarded(rig, SafetyConfig()) as safe:
        safe.head.move(1.0, 0.0)
        broken.append(True)
        rig.head.wait_for_halt()
        broken.clear()
        with pytest.raises(DeviceError, match="emergency stop: the watchdog failed: no such clock"):
            safe.head.move(1.0, 0.0)


class Hung:
    """A file system that does not answer, as a network's may."""

    def __init__(self, monkeypatch):
        self._answers = threading.Event()
        self._answers.set()
        look = stop_file.stop_reason

        def stop_reason(path):
            assert self._answers.wait(DEADLINE_S)
            return look(path)

        for module in (watchdog, stop_file):
            monkeypatch.setattr(module, "stop_reason", stop_reason)

    def hang(self):
        self._answers.clear()

    def answer(self):
        self._answers.set()


@pytest.fixture
def hung(monkeypatch):
    made = Hung(monkeypatch)
    yield made
    made.answer()


@pytest.mark.wire
def test_a_stop_file_that_hangs_does_not_keep_the_watchdog_from_halting(hung, tmp_path, caplog):
    rig = RealDevices()
    with guarded(rig, SafetyConfig(watchdog_s=SHORT_S, stop_file=tmp_path / "stop")) as safe:
        safe.head.move(1.0, 0.0)
        hung.hang()
        assert rig.head.halted.wait(SHORT_S + TIMELY_S)
        assert warnings(caplog)[0].startswith("halting the head: neither")
        hung.answer()


@pytest.mark.wire
def test_a_command_trusts_a_recent_reading_of_the_stop_file(hung, tmp_path, monkeypatch):
    """Only the test calls `watch` here, and moves the clock by which a reading is recent."""
    now = 5.0
    monkeypatch.setattr(stop_file, "monotonic", lambda: now)
    head = RealDevices().head
    watched = watchdog.Watchdog(head, RealDevices().clock, SafetyConfig(stop_file=tmp_path / "stop"), threaded=True)
    watched.watch()
    hung.hang()
    now += stop_file.RECENT_S / 2
    watched.begin((1.0, 0.0))
    assert head.log == []
    now += stop_file.RECENT_S
    with pytest.raises(EmergencyStopError, match="cannot be looked at"):
        watched.begin((1.0, 0.0))
    assert head.log == ["halt"]
    hung.answer()
    watched.close()


@pytest.mark.wire
def test_a_command_after_a_stop_reads_the_file_again(tmp_path):
    """A cleared stop delays no command until the thread reads the file."""
    watched = watchdog.Watchdog(
        RealDevices().head, RealDevices().clock, SafetyConfig(stop_file=tmp_path / "stop"), threaded=True
    )
    watched.watch()
    (tmp_path / "stop").touch()
    watched.watch()
    with pytest.raises(EmergencyStopError):
        watched.begin((1.0, 0.0))
    (tmp_path / "stop").unlink()
    watched.begin((1.0, 0.0))
    watched.close()


@pytest.mark.wire
def test_a_stop_file_that_hangs_counts_as_a_stop_until_it_answers(hung, tmp_path):
    rig = RealDevices()
    with guarded(rig, SafetyConfig(watchdog_s=1000.0, stop_file=tmp_path / "stop")) as safe:
        safe.head.move(1.0, 0.0)
        hung.hang()
        assert rig.head.halted.wait(TIMELY_S)
        begun = time.monotonic()
        with pytest.raises(EmergencyStopError, match=r"cannot be looked at: no answer within 0\.3 s"):
            safe.head.move(1.0, 0.0)
        assert time.monotonic() - begun < TIMELY_S
        hung.answer()
        deadline = time.monotonic() + DEADLINE_S
        while safe.stopped:
            assert time.monotonic() < deadline
        safe.head.move(1.0, 0.0)
        hung.answer()
    assert "cotarget-stop-file" not in {thread.name for thread in threading.enumerate()}


@pytest.mark.wire
def test_a_pipe_as_stop_file_is_a_stop(tmp_path):
    rig = RealDevices()
    with guarded(rig, SafetyConfig(watchdog_s=1000.0, stop_file=tmp_path / "stop")) as safe:
        safe.head.move(1.0, 0.0)
        os.mkfifo(tmp_path / "stop")
        rig.head.wait_for_halt()
        with pytest.raises(EmergencyStopError, match="emergency stop: no reason given"):
            safe.head.move(1.0, 0.0)


@pytest.mark.wire
def test_the_thread_does_not_halt_while_frames_are_fresh(real):
    """Read as fast as they come, for several times the watchdog's time."""
    rig, safe = real
    longest, last = 0.0, time.monotonic()
    safe.head.move(1.0, 0.0)
    end = time.monotonic() + 5 * SHORT_S
    while time.monotonic() < end:
        safe.fixed.read()
        longest, last = max(longest, time.monotonic() - last), time.monotonic()
    assert "halt" not in rig.head.log or longest >= SHORT_S  # a machine that stood still is no failure


def test_a_rig_in_simulated_time_has_no_thread(safe):
    assert "cotarget-watchdog" not in {thread.name for thread in threading.enumerate()}
