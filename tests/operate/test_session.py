"""The session: what each order does to head and lens, who has control, stop and clear, and the replay of all that."""

import itertools
import math
import threading
from functools import partial

import cv2
import numpy as np
import pytest

from cotarget.backends import open_recording
from cotarget.calibration import Calibration
from cotarget.config import FollowConfig
from cotarget.control.orders import Order, order_row, parse_order
from cotarget.errors import ConfigError, DeviceError, EmergencyStopError
from cotarget.operate.session import ControlError
from cotarget.pipeline import Mode, Run, State
from cotarget.recording.replay import Replay, until_end
from cotarget.safety.safe_rig import guard
from cotarget.safety.stop_file import clear_stop_file, write_stop_file
from tests.support.operated_run import HandDevices, operate
from tests.support.recorded_run import (
    CONFIG,
    FOCALS,
    RATE_HZ,
    SETTINGS,
    SIZE,
    STEP,
    Bright,
    ToyDevices,
    calibration_file,
)
from tests.support.rigs import rig_of

FRAMES = 60
PART = 0.5  # of the field of view a second
FOLLOWED = {State.FOLLOWING, State.COASTING}


@pytest.fixture
def path(tmp_path):
    return calibration_file(tmp_path)


def states(steps):
    return [state for state, _ in itertools.groupby(step.state for step in steps)]


def nothing(i, session, wall, rig):
    pass


def test_a_session_begins_standing_and_moves_nothing(path):
    devices = ToyDevices()
    steps = operate(path, FRAMES, nothing, devices=devices)
    assert {step.state for step in steps} == {State.STANDING}
    assert devices.calls["head.move"] == 0
    assert {step.commanded for step in steps} == {(0.0, 0.0, FOCALS[0])}
    assert any(track.confirmed for track in steps[-1].tracks)  # detection and tracks go on


def test_follow_and_stand(path):
    def act(i, session, wall, rig):
        if i == 20:
            session.follow("head")
        if i == 45:
            session.stand("head")

    steps = operate(path, 70, act)
    assert {step.state for step in steps[:21]} == {State.STANDING}
    assert {step.state for step in steps[21:46]} <= FOLLOWED
    assert {step.state for step in steps[46:]} == {State.STANDING}
    after = steps[46:]
    assert len({step.commanded for step in after}) == 1  # the lens stands too
    assert after[0].commanded[2] > FOCALS[0]
    assert {(step.head.pan, step.head.tilt) for step in after[2:]} == {(after[-1].head.pan, after[-1].head.tilt)}


@pytest.mark.parametrize(("target", "followed"), [((55.0, 45.0), True), ((5.0, 5.0), False), (1, True), (99, False)])
def test_follow_a_place_or_a_track(path, target, followed):
    def act(i, session, wall, rig):
        if i == 10:
            session.follow("head", target)

    devices = ToyDevices()
    steps = operate(path, 20, act, devices=devices)
    assert (steps[-1].state in FOLLOWED) == followed
    assert (devices.calls["head.move"] > 0) == followed
    if not followed:
        assert "track" in steps[-1].reason  # it says which is not there


def test_a_click_beside_the_picture_is_refused(path):
    def act(i, session, wall, rig):
        with pytest.raises(ConfigError, match="picture"):
            session.follow("head", (96.0, 10.0))

    assert {step.state for step in operate(path, 5, act)} == {State.STANDING}


def test_by_hand_a_head_turns_by_parts_of_its_field_until_the_orders_end(path):
    def act(i, session, wall, rig):
        if 10 <= i < 30:
            session.manual("head", (PART, 0.0))

    steps = operate(path, FRAMES, act, devices=HandDevices())
    hand = [step for step in steps if step.state is State.MANUAL]
    # 20 orders in 0.8 s and 0.3 s after the last one.
    assert 1.0 <= hand[-1].t - hand[0].t <= 1.2
    assert steps[-1].state is State.STANDING
    field = 96 / FOCALS[0]
    rate = (hand[-1].head.pan - hand[5].head.pan) / (hand[-1].t - hand[5].t)
    assert rate == pytest.approx(PART * field, rel=0.05)
    assert steps[-1].head.tilt == pytest.approx(0.0, abs=STEP)
    assert steps[-1].head.pan == steps[-5].head.pan


def test_an_order_by_hand_alone_ends_by_its_goal(path):
    """A run that hangs after it sends nothing more: the head must rest all the same."""
    goals = []

    def act(i, session, wall, rig):
        if i == 10:
            session.manual("head", (PART, 0.0))
        if i == 11:
            goals.append(rig.head.state().pan)

    steps = operate(path, 13, act)
    ahead = steps[11].commanded[0] - goals[0]
    assert 0 < ahead <= 0.3 * PART * 96 / FOCALS[0] + 0.05  # 0.3 s, and the way to brake


def test_home_and_zoom(path):
    def act(i, session, wall, rig):
        if i < 5:
            session.manual("head", (1.0, 0.5))
        if i == 20:
            session.zoom("head", 2.0)
        if i == 25:
            session.home("head")

    steps = operate(path, FRAMES, act)
    assert steps[22].commanded[2] == pytest.approx(2 * FOCALS[0])
    assert steps[22].head.pan > 0.1
    assert (steps[-1].head.pan, steps[-1].head.tilt, steps[-1].commanded[2]) == (0.0, 0.0, FOCALS[0])
    assert steps[-1].state is State.STANDING
    assert steps[-1].reason == "is at home"


def test_a_zoom_that_had_to_wait_moves_nothing(path):
    def act(i, session, wall, rig):
        if i in (20, 40):
            session.zoom("head", 2.0)
            wall.t += 0.25 if i == 20 else 0.35  # until the next frame

    steps = operate(path, FRAMES, act)
    assert [steps[i].commanded[2] for i in (20, 21, 40, 41)] == [FOCALS[0], 2 * FOCALS[0], 2 * FOCALS[0], 2 * FOCALS[0]]


def test_the_lens_of_a_head_that_follows_is_not_zoomed_by_hand(path):
    def act(i, session, wall, rig):
        if i == 0:
            session.follow("head")
        if i == 20:
            with pytest.raises(ConfigError, match="follows"):
                session.zoom("head", 2.0)

    operate(path, 22, act)


def test_others_that_move_a_standing_head_are_reported(path):
    devices = ToyDevices()

    def act(i, session, wall, rig):
        if i == 10:
            devices.start, devices.since, devices.goal = devices.pose(), devices.t, devices.pose() + 0.5

    steps = operate(path, 40, act, devices=devices)
    assert states(steps) == [State.STANDING, State.MOVED, State.STANDING]


def test_only_who_has_control_gives_orders(path):
    def act(i, session, wall, rig):
        if i == 0:
            with pytest.raises(ControlError):
                session.follow("head", by="a")
            session.take("a")
            session.follow("head", by="a")
            for order in (session.stand, session.home, session.follow):
                with pytest.raises(ControlError):
                    order("head", by="b")
            for order in (
                partial(session.manual, "head", (1.0, 0.0)),
                partial(session.zoom, "head", 2.0),
                partial(session.record, True),
                session.clear,
            ):
                with pytest.raises(ControlError):
                    order(by="b")
        if i == 10:
            session.take("b")  # the heads of whoever had it stand
        if i == 12:
            assert session.mode("head") is Mode.STANDING

    steps = operate(path, 20, act)
    assert states(steps)[-1] is State.STANDING
    assert State.FOLLOWING in states(steps)


def test_lost_control_ends_moving_by_hand_and_not_following(path):
    def act(i, session, wall, rig):
        if i == 0:
            session.take("a")
        if i < 10:
            session.manual("head", (PART, 0.0), by="a")
        if i == 9:
            session.leave("a")
            with pytest.raises(ControlError):
                session.home("head", by="a")
        if i == 12:
            assert session.mode("head") is Mode.STANDING
            session.take("a")
            session.follow("head", by="a")
        if i == 20:
            session.leave("a")
            session.left_alone()

    steps = operate(path, 30, act)
    assert steps[11].state is State.STANDING
    assert steps[-1].state in FOLLOWED


def test_unattended_heads_stand_where_they_are_told_to(path):
    def act(i, session, wall, rig):
        if i == 0:
            session.follow("head")
        if i == 20:
            session.left_alone()

    steps = operate(path, 30, act, config=FollowConfig(unattended="stand"))
    assert states(steps)[-1] is State.STANDING


@pytest.mark.parametrize("idle", ["wait", "stand", "home"])
def test_what_a_head_does_when_nothing_is_followed(path, idle):
    def act(i, session, wall, rig):
        if i < 5:
            session.manual("head", (1.0, 0.0))
        if i == 20:
            session.follow("head", 99)  # a track that never comes

    config = FollowConfig(when_idle=idle, idle_s=1.0)
    steps = operate(path, 70, act, config=config)
    state = State.SEARCHING if idle == "wait" else State.STANDING
    assert steps[-1].state is state
    assert {step.state for step in steps[21:40]} == {State.SEARCHING}
    assert (steps[-1].head.pan == 0.0) == (idle == "home")


def stop_and_clear(i, session, wall, rig):
    if i == 0:
        session.follow("head")
    if i == 30:  # from the page's thread
        thread = threading.Thread(target=session.stop, args=("a hand in the gears",))
        thread.start()
        thread.join()
    if i == 40:
        with pytest.raises(ConfigError, match="Clear"):
            session.follow("head")
        with pytest.raises(ConfigError, match="Clear"):
            session.record(True)
        session.manual("head", (1.0, 0.0))
    if i == 50:
        session.clear()
        session.manual("head", (1.0, 0.0))  # before the next frame, with which the stop ends
    if i == 70:
        session.follow("head")


@pytest.mark.parametrize("real_time", [False, True], ids=["simulated", "real time"])
def test_a_stop_lasts_until_clear_and_then_the_head_stands(path, tmp_path, real_time):
    file = tmp_path / "rig.stop"
    devices, said, calls = ToyDevices(real_time=real_time), {}, {}

    def act(i, session, wall, rig):
        stop_and_clear(i, session, wall, rig)
        said[i], calls[i] = (session.stopped, file.exists()), devices.calls["head.move"]

    guard_file = file if real_time else None
    steps = operate(path, 90, act, stop_file=file, guard_file=guard_file, devices=devices)
    assert said[49] == ("a hand in the gears", True)
    assert said[52] == (None, False)
    assert {step.state for step in steps[31:71]} == {State.STANDING}
    assert calls[30] == calls[69]
    assert steps[-1].state in FOLLOWED


def test_a_stop_by_another_program_stops_a_simulation_too(path, tmp_path):
    file = tmp_path / "rig.stop"

    def act(i, session, wall, rig):
        if i == 0:
            session.follow("head")
        if i == 30:
            write_stop_file(file, "from a shell")
        if i == 35:
            assert session.stopped == "from a shell"
            with pytest.raises(ConfigError):
                session.follow("head")
        if i == 40:
            file.unlink()

    steps = operate(path, 50, act, stop_file=file)
    assert {step.state for step in steps[32:]} == {State.STANDING}


def test_a_stop_in_real_time_waits_for_no_frame(path, tmp_path):
    """The head is halted while the run works on a frame."""
    devices, sessions, halts = ToyDevices(real_time=True), [], []
    detect = Bright.detect

    def act(i, session, wall, rig):
        sessions[:] = [session]

    def stopping(self, frame, held=()):
        if sessions and not halts:
            before = devices.calls["head.halt"]
            sessions[0].stop("a hand in the gears")
            halts.append(devices.calls["head.halt"] - before)
        return detect(self, frame, held)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Bright, "detect", stopping)
        operate(path, 5, act, devices=devices)
    assert halts == [1]


@pytest.mark.parametrize("real_time", [False, True], ids=["simulated", "real time"])
def test_another_program_clears_a_stop_and_then_the_head_stands(path, tmp_path, real_time):
    file, said = tmp_path / "rig.stop", {}

    def act(i, session, wall, rig):
        if i in (0, 60):
            session.follow("head")
        if i == 20:
            session.stop("a hand in the gears")
        if i == 30:
            assert clear_stop_file(file) == "a hand in the gears"
        if i == 40:  # the next stop is another one
            session.stop("once more")
        if i in (50, 55):
            session.clear()
        if i == 51:  # that its file is not there yet is no Clear
            session.stop("again")
            file.unlink()
        said[i] = session.stopped

    guard_file = file if real_time else None
    steps = operate(path, 70, act, stop_file=file, guard_file=guard_file, devices=ToyDevices(real_time=real_time))
    assert [said[i] for i in (29, 32, 49, 54, 57)] == ["a hand in the gears", None, "once more", "again", None]
    assert {step.state for step in steps[21:61]} == {State.STANDING}
    assert steps[-1].state in FOLLOWED


def test_a_stop_without_its_file_lasts(path, tmp_path):
    """No file of a stop is no Clear: that of this one cannot be written."""

    def act(i, session, wall, rig):
        if i == 10:
            with pytest.raises(DeviceError, match=r"this run is stopped.*NOT stopped"):
                session.stop("the disk is gone")

    steps = operate(path, 20, act, stop_file=tmp_path / "gone" / "rig.stop")
    assert steps[-1].reason == "the disk is gone"


# Recordings


@pytest.mark.parametrize("target", [None, 1], ids=["by the policy", "by its number"])
def test_a_target_that_is_followed_fast_is_followed_in_the_new_run_of_a_recording_too(path, target):
    devices = ToyDevices()
    first = round(devices.t * RATE_HZ)

    def expose(index):  # 87 px/s in an image of 96 px
        image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
        return cv2.circle(image, (round(4 + 3.5 * (index - first)), 36), 4, (250, 250, 250), -1)

    devices.fixed.expose = expose

    def act(i, session, wall, rig):
        if i == 6:
            session.follow("head", target)
        if i == 12:
            assert session.mode("head") is Mode.FOLLOWING
            session.record(True)

    steps = operate(path, 24, act, devices=devices)
    assert steps[12].state in FOLLOWED
    assert steps[14].target is None  # tracks begin again
    assert steps[-1].state in FOLLOWED


def everything(i, session, wall, rig):
    """Every order once, and a stop."""
    stop_and_clear(i, session, wall, rig)
    if i == 20:
        session.follow("head", (55.0, 45.0))
    if 80 <= i < 90:
        session.manual("head", (0.4, -0.2))
    if i == 100:
        session.zoom("head", 3.0)
    if i == 105:
        session.home("head")
    if i == 125:
        session.follow("head", 1)


def replayed(folder, orders=True):
    recording = open_recording(folder)
    played = Replay(recording)
    with guard(played.rig, CONFIG.safety) as rig:
        calibration = Calibration.load(recording.calibration)
        again = Run(rig, calibration, CONFIG.target("bird"), Bright(), settings=SETTINGS)
        steps = list(until_end(again.follow(orders=played.orders if orders else None)))
    return steps, played.differences


@pytest.mark.parametrize("real_time", [False, True], ids=["simulated", "real time"])
def test_a_run_by_hand_replays_command_by_command(path, tmp_path, real_time):
    folder, file = tmp_path / "recording", tmp_path / "rig.stop"
    options = {"stop_file": file, "guard_file": file if real_time else None}
    then = operate(path, 150, everything, folder=folder, devices=ToyDevices(real_time=real_time), **options)
    now, differences = replayed(folder)
    assert differences.same, str(differences)
    assert differences.moves > 20
    assert [(s.state, s.commanded, s.head) for s in now] == [(s.state, s.commanded, s.head) for s in then]
    assert not replayed(folder, orders=False)[1].same


def test_a_move_refused_in_the_middle_of_a_frame_replays(path, tmp_path):
    folder, devices, sessions = tmp_path / "recording", ToyDevices(), []
    detect, stopped = Bright.detect, []

    def act(i, session, wall, rig):
        sessions[:] = [rig]
        if i == 0:
            session.follow("head")

    def stopping(self, frame, held=()):
        if frame.t > 1001.2 and sessions and not stopped:
            stopped.append(sessions[0].stop("while a frame is worked on"))
        return detect(self, frame, held)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Bright, "detect", stopping)
        then = operate(path, 50, act, folder=folder, devices=devices)
    assert then[-1].state is State.STANDING
    now, differences = replayed(folder)
    assert [step.state for step in now] == [step.state for step in then]
    assert not differences.moves_differing
    assert not differences.extra


def test_orders_are_kept_to_the_last_bit_and_checked():
    orders = [
        Order("follow", "head", click=(1 / 3, 2.0)),
        Order("follow", "head", track=7),
        Order("follow", "head"),
        Order("manual", "head", rates=(0.1, -1 / 3)),
        Order("zoom", "head", factor=1.1),
        Order("stand", "head"),
        Order("home", "head"),
        Order("stop", reason="why"),
        Order("clear"),
    ]
    assert [parse_order(order_row(order)) for order in orders] == orders
    for wrong in ({"order": "dance"}, {"order": "zoom", "factor": math.inf}, {"order": "manual", "rates": [1]}):
        with pytest.raises((ValueError, TypeError)):
            parse_order(wrong)


def test_a_run_without_an_operator_still_ends_by_a_stop(path):
    """`follow()` is as it was: only a run with orders goes on after a stop."""
    with guard(rig_of(ToyDevices()), CONFIG.safety) as safe:
        made = Run(safe, Calibration.load(path), CONFIG.target("bird"), Bright(), settings=SETTINGS)
        steps = made.follow()
        for _ in range(20):
            next(steps)
        safe.stop("enough")
        with pytest.raises(EmergencyStopError, match="enough"):
            list(itertools.islice(steps, 100))
