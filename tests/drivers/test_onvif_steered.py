"""The driver of ONVIF domes that are steered by velocities, or whose positions are reckoned, on the emulated dome."""

import math
import re
import time

import pytest

from cotarget.drivers.onvif import OnvifLink
from cotarget.emulators import onvif as emulator
from cotarget.emulators.onvif import ANSWERS, TPTZ, SoapFault
from cotarget.errors import DeviceError
from tests.support.onvif_dome import STEP_DEG, OnvifUnit, counted, opened
from tests.support.plants import fails, wait_for

pytestmark = pytest.mark.wire
NEAR_DEG = 2 * STEP_DEG
LOST_S = 0.7  # longer than a stop waits for its answer
HANGS_AT, HANGS_S = 10, 2.0  # the status of this number takes so long
SETTLED_S = 0.5  # of a halt's answer and of braking from the highest speed


def test_a_steered_dome_that_stops_late_comes_to_rest_at_its_goal():
    with OnvifUnit("continuous-only", "slow-stop") as unit, opened(unit, stop_delay_s=0.4) as dome:
        dome.head.move(math.radians(20.0), math.radians(10.0), wait=True)
        wait_for(lambda: not (dome.head.state().moving or unit.turning()))
        assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((20.0, 10.0), abs=unit.settings.slack_deg)


def test_velocities_leave_the_lens_alone_and_a_zoom_leaves_a_steered_head_alone(monkeypatch):
    with OnvifUnit("continuous-only") as unit, opened(unit, all_axes=True) as dome:
        asked = []
        answer = ANSWERS[TPTZ, "ContinuousMove"]
        monkeypatch.setitem(
            ANSWERS,
            (TPTZ, "ContinuousMove"),
            lambda *about: (asked.append(about[2].vector("Velocity")), answer(*about))[1],
        )
        dome.head.move(math.radians(10.0), 0.0)
        dome.zoom.zoom(dome.zoom.focal_range[1])
        wait_for(lambda: unit.lens.position() == unit.lens.last)
        dome.head.move(math.radians(10.0), 0.0, wait=True)
        dome.head.halt()
        assert asked
        assert all(zoom is None for _, _, zoom in asked)
        wait_for(lambda: not dome.zoom.state().moving)


def test_a_stop_is_repeated_until_the_zero_velocity_is_answered_too(monkeypatch):
    """The first one is lost, at a device that ignores the order named Stop."""
    with OnvifUnit("continuous-only", "stop-ignored", "timeout-ignored") as unit, opened(unit) as dome:
        answer, lost = ANSWERS[TPTZ, "ContinuousMove"], []

        def lose_first(camera, faults, message):
            if message.vector("Velocity")[:2] == (0.0, 0.0) and not lost:
                lost.append(message)
                time.sleep(LOST_S)
                return ""
            return answer(camera, faults, message)

        dome.head.move(math.radians(140.0), 0.0, speed=math.radians(20.0))
        wait_for(lambda: unit.pan.degrees() > 3.0)
        monkeypatch.setitem(ANSWERS, (TPTZ, "ContinuousMove"), lose_first)
        dome.head.halt()
        time.sleep(SETTLED_S)
        assert lost
        assert not unit.turning()


@pytest.mark.parametrize("profile", ["no-status", "zoom-status", "blocking-status"])
def test_positions_that_are_not_said_are_reckoned(profile):
    with OnvifUnit(profile) as unit, opened(unit, zoom_s=1.0) as dome:
        assert (math.degrees(dome.head.state().sigma) > 50.0) == (profile != "blocking-status")
        dome.head.move(math.radians(-20.0), math.radians(10.0), wait=True)
        assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((-20.0, 10.0), abs=NEAR_DEG)
        state = dome.head.state()
        assert (math.degrees(state.pan), math.degrees(state.tilt)) == pytest.approx((-20.0, 10.0), abs=NEAR_DEG)
        assert state.sigma == 0.0
        dome.head.move(math.radians(10.0), math.radians(10.0), speed=math.radians(20.0))
        wait_for(lambda: unit.pan.degrees() > -5.0)
        state = dome.head.state()
        assert math.degrees(state.pan) == pytest.approx(unit.pan.degrees(), abs=15.0)
        dome.zoom.zoom(dome.zoom.focal_range[1])
        wait_for(lambda: not dome.zoom.state().moving)
        assert dome.zoom.state().focal_px == pytest.approx(dome.zoom.focal_range[1], rel=0.02)


def nan_on_its_way(unit, monkeypatch):
    """Let the device say no position of pan and tilt while it turns."""

    def answer(number, usual, *about):
        said = usual(*about)
        return re.sub("<tt:PanTilt x.*?>", '<tt:PanTilt x="nan" y="nan"/>', said) if unit.turning() else said

    counted(monkeypatch, "GetStatus", answer)


def test_a_head_that_says_its_position_only_at_rest_has_arrived_when_it_says_so(monkeypatch):
    """It turns at half of the speed that rig.toml has."""
    with OnvifUnit() as unit:
        nan_on_its_way(unit, monkeypatch)
        with opened(unit, speed_deg_s=2 * unit.settings.speed_deg_s) as dome:
            dome.head.move(math.radians(30.0), 0.0, wait=True)
            assert not unit.turning()
            assert math.degrees(dome.head.state().pan) == pytest.approx(30.0, abs=NEAR_DEG)
            assert unit.pan.degrees() == pytest.approx(30.0, abs=NEAR_DEG)


def test_a_steered_head_that_says_its_position_only_at_rest_goes_by_and_by_and_can_be_halted(monkeypatch):
    with OnvifUnit("continuous-only") as unit:
        nan_on_its_way(unit, monkeypatch)
        with opened(unit) as dome:
            dome.head.move(math.radians(60.0), 0.0, speed=math.radians(20.0))
            wait_for(lambda: unit.pan.degrees() > 5.0)
            assert dome.head.state().moving
            dome.head.halt()
            wait_for(lambda: not unit.turning())


def test_a_device_without_a_status_is_reckoned_too(monkeypatch):
    def answer(number, usual, *about):
        raise SoapFault("Optional action not implemented", "ActionNotSupported", code="Receiver")

    counted(monkeypatch, "GetStatus", answer)
    with OnvifUnit() as unit, opened(unit, zoom_s=1.0) as dome:
        dome.head.move(math.radians(-20.0), math.radians(10.0), wait=True)
        assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((-20.0, 10.0), abs=NEAR_DEG)


@pytest.mark.parametrize("profiles", [
    ("no-absolute",), ("continuous-only",), ("continuous-only", "timeout-fault"), ("continuous-only", "slow-stop"),
    ("continuous-only", "stop-ignored"), ("continuous-only", "timeout-clamped"), ("continuous-only", "wide-ranges"),
], ids=",".join)  # fmt: skip
def test_a_device_that_takes_velocities_is_steered_to_its_goal(profiles):
    with OnvifUnit(*profiles) as unit, opened(unit) as dome:
        for pan, tilt in ((25.0, 10.0), (24.5, 10.0), (-30.0, 12.0)):
            dome.head.move(math.radians(pan), math.radians(tilt), speed=math.radians(60.0), wait=True)
            slack = unit.settings.slack_deg + NEAR_DEG
            assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((pan, tilt), abs=slack)
        assert "AbsoluteMove" not in unit.moves[1:]
        dome.head.move(math.radians(140.0), 0.0, speed=math.radians(40.0))
        wait_for(lambda: unit.pan.degrees() > 0.0)
        dome.head.halt()
        time.sleep(SETTLED_S + 0.4)
        assert not unit.turning()
        assert unit.pan.degrees() < 80.0


def test_a_steered_dome_that_loses_its_position_is_stopped_and_named():
    with OnvifUnit("continuous-only") as unit, opened(unit) as dome:
        dome.head.move(math.radians(60.0), 0.0, speed=math.radians(40.0))
        wait_for(lambda: unit.pan.degrees() > 5.0)
        unit.faults.set("position-lost")
        assert "outside of its own range from -150 to 170: its position is lost" in fails(dome.head.state)
        time.sleep(SETTLED_S)
        assert not unit.turning()
        assert 5.0 < unit.pan.degrees() < 60.0


@pytest.mark.parametrize("profile", ["endless-pan", "continuous-only,endless-pan"])
def test_a_dome_without_an_end_of_pan_goes_across_the_end_of_its_numbers(profile):
    """They end at 210 degrees, which are -150: from 200 to -145 is 15 degrees or 345."""
    with OnvifUnit(*profile.split(",")) as unit, opened(unit, pan_deg=(-150.0, 210.0)) as dome:
        unit.pan.command(round(200.0 / STEP_DEG), 1e6, 1e9)
        wait_for(lambda: math.degrees(dome.head.state().pan) == pytest.approx(200.0, abs=NEAR_DEG))
        dome.head.move(math.radians(-145.0), 0.0, wait=True)
        wait_for(lambda: not unit.turning())
        assert unit.pan.degrees() % 360.0 == pytest.approx(215.0, abs=unit.settings.slack_deg + NEAR_DEG)


def test_a_steered_device_goes_on_beyond_its_default_timeout(monkeypatch):
    """At 10 degrees/s, 15 degrees take longer than the timeout of one second."""
    with OnvifUnit("continuous-only") as unit, opened(unit) as dome:
        dome.head.move(math.radians(25.0), 0.0, speed=math.radians(10.0), wait=True)
        assert unit.pan.degrees() == pytest.approx(25.0, abs=unit.settings.slack_deg + NEAR_DEG)


def test_a_steered_device_stops_by_itself_where_the_program_dies(monkeypatch):
    with OnvifUnit("continuous-only") as unit, opened(unit) as dome:
        dome.head.move(math.radians(140.0), 0.0, speed=math.radians(10.0))
        wait_for(lambda: unit.turning())
        monkeypatch.setattr(OnvifLink, "poll", lambda link, requests: [])  # as if it hung
        wait_for(lambda: not unit.turning())
        assert unit.pan.degrees() < 30.0


def test_a_steered_head_follows_a_goal_that_moves():
    """At 8 degrees/s and ten goals a second; without the goals' own speed it would lag by 2 degrees."""
    with OnvifUnit("continuous-only") as unit, opened(unit) as dome:
        begin, lags = time.monotonic(), []
        while (passed := time.monotonic() - begin) < 4.0:
            dome.head.move(math.radians(8.0 * passed), 0.0)
            time.sleep(0.1)
            lags.append(8.0 * (time.monotonic() - begin) - unit.pan.degrees())
        assert abs(sorted(lags[20:])[len(lags[20:]) // 2]) < 1.5


@pytest.mark.parametrize("refused", [{3, 4}, set(range(3, 1000))], ids=["once", "from then on"])
def test_a_refused_velocity_ends_the_move_and_not_the_head(monkeypatch, refused):
    """With a timeout and without it; a move whose end is waited for is sent again, with its timeout."""
    timeouts = []

    def answer(number, usual, camera, faults, message):
        timeouts.append(message.text("Timeout"))
        if number in refused and message.vector("Velocity")[:2] != (0.0, 0.0):
            raise SoapFault("Busy", code="Receiver")
        return usual(camera, faults, message)

    with OnvifUnit("continuous-only") as unit, opened(unit) as dome:
        counted(monkeypatch, "ContinuousMove", answer)
        if len(refused) == 2:
            dome.head.move(math.radians(30.0), 0.0, speed=math.radians(20.0), wait=True)
            assert unit.pan.degrees() == pytest.approx(30.0, abs=unit.settings.slack_deg + NEAR_DEG)
            assert "PT1S" in timeouts[6:]
        else:
            with pytest.raises(DeviceError, match="Busy"):
                dome.head.move(math.radians(30.0), 0.0, speed=math.radians(20.0), wait=True)
            wait_for(lambda: not unit.turning())
        wait_for(lambda: not dome.head.state().moving)


def test_a_steered_head_stands_while_it_does_not_say_where_it_is_and_then_goes_on(monkeypatch):
    with OnvifUnit("continuous-only") as unit, opened(unit) as dome:
        stood = []

        def answer(number, usual, *about):
            if number == HANGS_AT:
                time.sleep(HANGS_S)
                stood.append(not unit.turning())
            return usual(*about)

        counted(monkeypatch, "GetStatus", answer)
        dome.head.move(math.radians(40.0), 0.0, speed=math.radians(20.0), wait=True)
        assert stood == [True]
        assert unit.pan.degrees() == pytest.approx(40.0, abs=unit.settings.slack_deg + NEAR_DEG)


def test_a_steered_device_that_says_no_limits_has_the_ends_of_the_generic_space(monkeypatch):
    usual, limits = emulator._configuration, re.compile("<tt:PanTiltLimits>.*</tt:PanTiltLimits>")
    monkeypatch.setattr(emulator, "_configuration", lambda *about: limits.sub("", usual(*about)))
    with OnvifUnit("continuous-only") as unit, opened(unit) as dome:
        dome.head.move(math.radians(15.0), 0.0, wait=True)
        assert unit.pan.degrees() == pytest.approx(15.0, abs=unit.settings.slack_deg + NEAR_DEG)


def test_a_dome_that_ignores_absolute_moves_is_steered_where_the_file_says_so():
    with OnvifUnit("absolute-ignored") as unit, opened(unit, absolute=False) as dome:
        dome.head.move(math.radians(12.0), math.radians(4.0), wait=True)
        assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((12.0, 4.0), abs=0.3)
