"""The driver of ONVIF domes on the emulated dome: moves, halts, users and clocks, and what devices do otherwise."""

import contextlib
import dataclasses
import itertools
import math
import re
import subprocess
import sys
import threading
import time

import pytest

from cotarget.config import SafetyConfig, parse_config
from cotarget.drivers import onvif
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.onvif import OnvifDevice, OnvifDome, OnvifLink
from cotarget.drivers.polled_head import OBEYED_S
from cotarget.drivers.rig import device_of, devices
from cotarget.emulators import onvif as emulator
from cotarget.emulators.onvif import ANSWERS, PAN_TILT, TPTZ, TRT, OnvifCamera, SoapFault
from cotarget.errors import ConfigError, CotargetError, DeviceError
from tests.support.onvif_dome import STEP_DEG, OnvifUnit
from tests.support.plants import PASSWORD, fails, wait_for

pytestmark = pytest.mark.wire
SAFETY = SafetyConfig(stop_file=None)
NEAR_DEG = 2 * STEP_DEG
LOST_S = 0.7  # longer than a stop waits for its answer
SLOW_S = 0.55  # for an answer, which is as long
AWAY_S = 0.25
STOPS_S = 0.3  # in which a head is at rest, beyond the latency of its device
SILENT_S = 60.0
HANGS_AT, HANGS_S = 10, 2.0  # the status of this number takes so long
NOTICED_S = 1.0  # another client's move
SETTLED_S = 0.5  # of a halt's answer and of braking from the highest speed


@contextlib.contextmanager
def opened(unit, **changes):
    settings = dataclasses.replace(unit.settings, **changes)
    with contextlib.closing(OnvifDome(settings, MonotonicClock(), SAFETY)) as dome:
        yield dome


def refused(unit, **changes):
    """The error of a dome that cannot be opened; it has one line, and nothing has moved."""
    begin = time.monotonic()
    with pytest.raises(CotargetError) as caught:
        OnvifDome(dataclasses.replace(unit.settings, **changes), MonotonicClock(), SAFETY)
    assert time.monotonic() < begin + 20.0
    assert set(unit.moves) <= {"ContinuousMove"}  # of a halt
    assert not unit.turning()
    assert len(str(caught.value).splitlines()) == 1
    assert PASSWORD not in str(caught.value)
    return str(caught.value)


def counted(monkeypatch, name, answer):
    """Let a function answer a message of the PTZ service; it is called with the number of messages so far, too."""
    usual, number = ANSWERS[TPTZ, name], itertools.count()
    monkeypatch.setitem(ANSWERS, (TPTZ, name), lambda *about: answer(next(number), usual, *about))


def test_the_head_goes_where_it_is_sent_and_the_lens_too():
    with OnvifUnit() as unit, opened(unit) as dome:
        commanded = dome.head.move(math.radians(20.0), math.radians(-10.0), wait=True)
        assert [math.degrees(angle) for angle in commanded] == pytest.approx([20.0, -10.0])
        assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((20.0, -10.0), abs=NEAR_DEG)
        state = dome.head.state()
        assert not state.moving
        assert (math.degrees(state.pan), math.degrees(state.tilt)) == pytest.approx((20.0, -10.0), abs=NEAR_DEG)
        shortest, longest = dome.zoom.focal_range
        assert longest == pytest.approx(10 * shortest)
        reached = dome.zoom.zoom(longest)
        wait_for(lambda: not dome.zoom.state().moving)
        assert dome.zoom.state().focal_px == pytest.approx(reached, rel=0.02)
        assert unit.lens.position() == unit.lens.last
        assert dome.zoom.read(timeout=10.0).image.shape == (240, 320, 3)


@pytest.mark.parametrize("profile", ["pan-reversed", "tilt-reversed"])
def test_signs_of_rig_toml_turn_an_axis_that_counts_the_other_way(profile):
    sign = {f"{profile.partition('-')[0]}_sign": -1}
    limits = {"pan_deg": (-170.0, 150.0)} if profile == "pan-reversed" else {"tilt_deg": (-90.0, 30.0)}
    with OnvifUnit(profile) as unit, opened(unit, **sign) as dome:
        dome.head.move(math.radians(20.0), math.radians(15.0), wait=True)
        assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((20.0, 15.0), abs=NEAR_DEG), limits


@pytest.mark.parametrize(
    "profile", ["wide-ranges", "degrees", "always-moving", "boolean-status", "behind-nat", "media2-only"]
)
def test_other_ranges_spaces_states_and_addresses_are_understood(profile):
    with OnvifUnit(profile) as unit, opened(unit) as dome:
        dome.head.move(math.radians(-20.0), math.radians(10.0), wait=True)
        assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((-20.0, 10.0), abs=NEAR_DEG)
        assert not dome.head.state().moving
        assert dome.zoom.read(timeout=10.0).image.shape == (240, 320, 3)


@pytest.mark.parametrize("profiles", [["relative-only"], ["relative-only", "relative-degrees", "pan-reversed"]])
def test_relative_moves_lead_to_positions_whatever_a_step_of_1_is(profiles):
    signs = {"pan_sign": -1} if "pan-reversed" in profiles else {}
    with OnvifUnit(*profiles) as unit, opened(unit, **signs) as dome:
        for goal in ((20.0, 10.0), (-40.0, -5.0), (-38.0, -5.0)):
            dome.head.move(*map(math.radians, goal), wait=True)
            assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx(goal, abs=unit.settings.slack_deg)
        assert set(unit.moves) == {"RelativeMove"}
        dome.head.move(math.radians(100.0), 0.0, speed=math.radians(20.0))
        wait_for(lambda: unit.pan.degrees() > 0.0)
        dome.head.halt()
        wait_for(lambda: not dome.head.state().moving)
        assert unit.pan.degrees() < 20.0
        assert not unit.turning()


def test_a_relative_move_that_was_obeyed_and_not_answered_is_not_sent_again(monkeypatch):
    def obey(number, usual, *about):
        usual(*about)
        raise ConnectionError

    counted(monkeypatch, "RelativeMove", obey)
    with OnvifUnit("relative-only") as unit, opened(unit) as dome:
        with pytest.raises(DeviceError, match="broke off at RelativeMove"):
            dome.head.move(math.radians(20.0), 0.0, wait=True)
        assert unit.moves == ["RelativeMove"]


def test_a_head_that_another_program_moves_is_reported_once_and_left_alone(caplog):
    with OnvifUnit() as unit, opened(unit) as dome:
        dome.head.move(math.radians(10.0), 0.0, wait=True)
        sent = list(unit.moves)
        time.sleep(OBEYED_S + SETTLED_S)
        unit.pan.command(round(40.0 / STEP_DEG), 40.0 / STEP_DEG, 1e6)
        wait_for(lambda: "turns without a command" in caplog.text, NOTICED_S)
        wait_for(lambda: unit.pan.degrees() == pytest.approx(40.0))
        time.sleep(SETTLED_S)
        dome.head.move(math.radians(-30.0), 0.0, wait=True)
        dome.head.halt()
        time.sleep(SETTLED_S)
        assert caplog.text.count("turns without a command") == 1
        assert unit.moves[: len(sent) + 1] == [*sent, "AbsoluteMove"]


def test_a_steered_dome_that_stops_late_comes_to_rest_at_its_goal():
    with OnvifUnit("continuous-only", "slow-stop") as unit, opened(unit, stop_delay_s=0.4) as dome:
        dome.head.move(math.radians(20.0), math.radians(10.0), wait=True)
        wait_for(lambda: not (dome.head.state().moving or unit.turning()))
        assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((20.0, 10.0), abs=unit.settings.slack_deg)


def test_a_device_without_options_is_known_by_its_node(monkeypatch):
    def unable(*about):
        raise SoapFault("Optional action not implemented", "ActionNotSupported", code="Receiver")

    monkeypatch.setitem(ANSWERS, (TPTZ, "GetConfigurationOptions"), unable)
    with OnvifUnit() as unit, opened(unit) as dome:
        dome.head.move(math.radians(5.0), 0.0, wait=True)
        assert unit.pan.degrees() == pytest.approx(5.0, abs=NEAR_DEG)


def test_a_speed_is_a_share_of_the_highest():
    with OnvifUnit() as unit, opened(unit) as dome:
        begin = time.monotonic()
        dome.head.move(math.radians(10.0), 0.0, speed=math.radians(10.0), wait=True)
        assert time.monotonic() - begin > 1.0


def test_a_device_that_takes_a_missing_axis_as_zero_gets_all_of_them():
    with OnvifUnit("missing-is-zero") as unit, opened(unit, all_axes=True) as dome:
        dome.head.move(math.radians(20.0), math.radians(15.0), wait=True)
        dome.zoom.zoom(dome.zoom.focal_range[1])
        wait_for(lambda: not dome.zoom.state().moving)
        dome.head.move(math.radians(25.0), math.radians(15.0), wait=True)
        assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((25.0, 15.0), abs=NEAR_DEG)
        assert unit.lens.position() == unit.lens.last


def test_a_zoom_of_all_axes_after_opening_and_after_a_halt_moves_the_lens_alone():
    with OnvifUnit("missing-is-zero") as unit:
        unit.pan.command(round(-40.0 / STEP_DEG), 1e5, 1e6)
        wait_for(lambda: unit.pan.degrees() == pytest.approx(-40.0))
        with opened(unit, all_axes=True) as dome:
            dome.zoom.zoom(dome.zoom.focal_range[1])
            wait_for(lambda: unit.lens.position() == unit.lens.last)
            time.sleep(SETTLED_S)
            assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((-40.0, 0.0), abs=NEAR_DEG)
            dome.head.move(math.radians(140.0), 0.0, speed=math.radians(40.0))
            wait_for(lambda: unit.pan.degrees() > -30.0)
            dome.head.halt()
            wait_for(lambda: not dome.head.state().moving)
            halted = unit.pan.degrees()
            dome.zoom.zoom(dome.zoom.focal_range[0])
            wait_for(lambda: unit.lens.position() == 0)
            time.sleep(SETTLED_S)
            assert unit.pan.degrees() == pytest.approx(halted, abs=NEAR_DEG)


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


# Halts


@pytest.mark.parametrize("profiles", [
    (), ("stop-fault",), ("stop-ignored",), ("slow-stop",), ("slower-stop",), ("slow-answers",), ("stale-status",),
    ("clock-10h",),
], ids=",".join)  # fmt: skip
def test_a_halt_stops_the_head_before_its_goal(profiles):
    late_s = {"slow-stop": 0.4, "slower-stop": 1.1, "slow-answers": 0.9}.get("".join(profiles), 0.0)
    with OnvifUnit(*profiles) as unit, opened(unit) as dome:
        dome.head.move(math.radians(140.0), 0.0, speed=math.radians(40.0))
        wait_for(lambda: unit.pan.degrees() > 5.0)
        dome.head.halt()
        time.sleep(late_s + SETTLED_S)
        assert not unit.turning()
        assert unit.pan.degrees() < 120.0
        wait_for(lambda: not dome.head.state().moving)


def test_closing_and_an_error_of_the_caller_leave_the_head_at_rest():
    with OnvifUnit() as unit:
        with contextlib.suppress(ZeroDivisionError), opened(unit) as dome:
            dome.head.move(math.radians(140.0), 0.0, speed=math.radians(40.0))
            wait_for(lambda: unit.pan.degrees() > 5.0)
            1 / 0  # noqa: B018
        time.sleep(SETTLED_S)
        assert not unit.turning()
        assert unit.pan.degrees() < 120.0


LEFT_TURNING = """
import contextlib, math
from cotarget.config import SafetyConfig
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.onvif import OnvifDome, OnvifSettings

dome = OnvifDome({settings!r}, MonotonicClock(), SafetyConfig(stop_file=None))
dome.head.move(math.radians(140.0), 0.0, speed=math.radians(20.0))
while dome.head.state().pan < math.radians(3.0):
    pass
{end}
"""


@pytest.mark.parametrize("end", ["", "raise ValueError"])
def test_a_program_that_ends_without_closing_leaves_the_head_at_rest(end):
    with OnvifUnit() as unit:
        script = LEFT_TURNING.format(settings=unit.settings, end=end)
        subprocess.run([sys.executable, "-c", script], capture_output=True, timeout=60.0, check=False)
        time.sleep(SETTLED_S)
        assert not unit.turning()
        assert 3.0 < unit.pan.degrees() < 120.0


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


def test_a_device_that_takes_no_connection_for_a_moment_is_stopped_all_the_same():
    with OnvifUnit() as unit, opened(unit) as dome:
        dome.head.move(math.radians(140.0), 0.0, speed=math.radians(20.0))
        wait_for(lambda: unit.pan.degrees() > 3.0)
        unit.server.close()
        back = threading.Timer(AWAY_S, unit.listen, (unit.server.port,))
        back.start()
        dome.head.halt()
        back.join()
        time.sleep(SETTLED_S)
        assert not unit.turning()
        assert unit.pan.degrees() < 120.0


def test_a_status_that_blocks_delays_no_halt():
    with OnvifUnit("blocking-status") as unit, opened(unit) as dome:
        dome.head.move(math.radians(140.0), 0.0, speed=math.radians(40.0))
        wait_for(lambda: unit.pan.degrees() > 5.0)
        begin = time.monotonic()
        dome.head.halt()
        assert time.monotonic() - begin < SETTLED_S
        wait_for(lambda: not unit.turning())
        assert unit.pan.degrees() < 120.0


def test_a_move_without_an_answer_delays_no_halt_and_cannot_outlive_it():
    with OnvifUnit() as unit, opened(unit) as dome:
        unit.faults.set("slow-answers")
        dome.head.move(math.radians(140.0), 0.0, speed=math.radians(40.0))
        time.sleep(0.05)
        dome.head.halt()
        unit.faults.set("slow-answers", False)
        time.sleep(1.0)
        assert not unit.turning()
        assert unit.pan.degrees() < 60.0


def test_a_device_that_takes_its_time_for_each_answer_is_driven_and_stopped(monkeypatch):
    monkeypatch.setattr(emulator, "SLOW_S", SLOW_S)
    with OnvifUnit("slow-answers", login=False) as unit, opened(unit) as dome:
        dome.head.move(math.radians(20.0), math.radians(10.0), wait=True)
        assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((20.0, 10.0), abs=NEAR_DEG)
        dome.head.move(math.radians(140.0), 0.0, speed=math.radians(20.0))
        wait_for(lambda: unit.pan.degrees() > 23.0)
        begin = unit.pan.degrees()
        dome.head.halt()
        wait_for(lambda: not unit.turning())
        assert unit.pan.degrees() - begin < 20.0 * (SLOW_S + STOPS_S)


@pytest.mark.parametrize(("profile", "slow_s"), [((), 1.55), (("continuous-only",), 0.52)])
def test_a_device_that_answers_too_late_to_be_moved_is_refused(profile, slow_s, monkeypatch):
    monkeypatch.setattr(emulator, "SLOW_S", slow_s)
    with OnvifUnit("slow-answers", *profile, login=False) as unit:
        assert "s for an answer" in refused(unit)
        assert unit.moves == []


def test_a_device_that_goes_away_is_an_error_of_one_line():
    with OnvifUnit() as unit, opened(unit) as dome:
        dome.head.move(math.radians(140.0), 0.0, speed=math.radians(40.0))
        unit.faults.set("refuse")
        unit.server._disconnect()
        said = fails(dome.head.state)
        assert len(said.splitlines()) == 1
        assert "check host and port" in said
        unit.faults.set("refuse", False)


def test_a_steered_device_that_starts_anew_at_another_position_is_not_driven_on():
    with OnvifUnit("continuous-only") as unit, opened(unit) as dome:
        dome.head.move(math.radians(140.0), 0.0, speed=math.radians(20.0))
        wait_for(lambda: unit.pan.degrees() > 3.0)
        unit.server.close()
        for axis in (unit.pan, unit.tilt):
            axis.command(round(-100.0 / STEP_DEG), 1e6, 1e9)
        time.sleep(AWAY_S)
        unit.listen(unit.server.port)
        begin = time.monotonic()
        assert "cannot be reached (Connection refused)" in fails(dome.head.state)
        assert time.monotonic() < begin + STOPS_S
        time.sleep(STOPS_S)
        assert unit.pan.degrees() == pytest.approx(-100.0, abs=20.0 * STOPS_S)
        assert not unit.turning()


@pytest.mark.parametrize("fault", ["silence", "garbage", "half-answers", "not-soap", "endless", "bomb", "unauthorized"])
def test_a_fault_in_mid_move_is_an_error_of_one_line(fault, monkeypatch):
    monkeypatch.setattr(onvif, "STATUS_S", 1.0)
    with OnvifUnit() as unit, opened(unit) as dome:
        dome.head.move(math.radians(30.0), 0.0, speed=math.radians(20.0))
        unit.faults.set(fault)
        said = fails(dome.head.state)
        assert len(said.splitlines()) == 1
        unit.faults.set(fault, False)


def test_a_mistake_where_positions_are_read_is_an_error_of_the_head(monkeypatch):
    begun, status = threading.Event(), OnvifDevice.status

    def read(device):
        if begun.is_set():
            raise ValueError("a mistake")
        return status(device)

    monkeypatch.setattr(OnvifDevice, "status", read)
    with OnvifUnit() as unit, opened(unit) as dome:
        begun.set()
        assert "a mistake" in fails(dome.head.state)


@pytest.mark.parametrize("lost", ["all", "pan"])
def test_a_standing_head_that_says_its_position_no_more_is_an_error(lost, monkeypatch):
    monkeypatch.setattr(onvif, "UNHEARD_S", 1.0)
    begun = threading.Event()
    with OnvifUnit() as unit:

        def answer(number, usual, *about):
            if begun.is_set() and lost == "all":
                unit.server.closing.wait(SILENT_S)
            said = usual(*about)
            return re.sub("<tt:PanTilt x.*?>", "", said) if begun.is_set() else said

        counted(monkeypatch, "GetStatus", answer)
        with opened(unit) as dome:
            begun.set()
            assert "has said no position of pan for 1 s" in fails(dome.head.state)


def test_a_status_that_has_been_late_before_may_be_late_again(monkeypatch):
    monkeypatch.setattr(onvif, "UNHEARD_S", 1.0)
    late_s = [2.0, 0.9]

    def answer(number, usual, *about):
        if begun.is_set() and late_s:
            time.sleep(late_s.pop())
        return usual(*about)

    begun = threading.Event()
    counted(monkeypatch, "GetStatus", answer)
    with OnvifUnit() as unit, opened(unit) as dome:
        begun.set()
        wait_for(lambda: not late_s)
        time.sleep(2.5)
        assert not dome.head.state().moving


def test_a_device_that_answers_commands_by_nothing_but_success_is_driven(monkeypatch):
    command = re.compile(r"<\w+:(AbsoluteMove|ContinuousMove|Stop)Response>")
    usual = emulator.envelope
    monkeypatch.setattr(emulator, "envelope", lambda body: "" if command.match(body) else usual(body))
    with OnvifUnit() as unit, opened(unit) as dome:
        dome.head.move(math.radians(20.0), 0.0, wait=True)
        assert unit.pan.degrees() == pytest.approx(20.0, abs=NEAR_DEG)


def test_tokens_may_have_any_characters(monkeypatch):
    asked = []
    monkeypatch.setattr(emulator, "_refuse_other_profile", asked.append)
    profiles = ANSWERS[TRT, "GetProfiles"]
    monkeypatch.setitem(
        ANSWERS, (TRT, "GetProfiles"), lambda *about: profiles(*about).replace('"profile_1"', '"main &amp; &lt;1>"')
    )
    with OnvifUnit() as unit, opened(unit) as dome:
        dome.head.move(math.radians(5.0), 0.0, wait=True)
    assert {message.text("ProfileToken") for message in asked} == {"main & <1>"}


# Devices that do not say where they are, or do not go where they are sent


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
        for pan, tilt in ((25.0, 10.0), (24.5, 10.0), (-5.0, 12.0)):
            dome.head.move(math.radians(pan), math.radians(tilt), speed=math.radians(60.0), wait=True)
            slack = unit.settings.slack_deg + NEAR_DEG
            assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((pan, tilt), abs=slack)
        assert "AbsoluteMove" not in unit.moves[1:]
        dome.head.move(math.radians(140.0), 0.0, speed=math.radians(40.0))
        wait_for(lambda: unit.pan.degrees() > 0.0)
        dome.head.halt()
        time.sleep(SETTLED_S + (0.4 if "slow-stop" in profiles else 0.0))
        assert not unit.turning()
        assert unit.pan.degrees() < 80.0


def test_a_lens_that_obeys_nothing_is_an_error_however_often_it_is_sent_elsewhere():
    """From end to end takes 0.5 s; it is sent to another place ten times a second, and has 2 s more to arrive."""
    with OnvifUnit("absolute-ignored") as unit, opened(unit, absolute=False, zoom_s=0.5) as dome:
        shortest, longest = dome.zoom.focal_range

        def zoom_on():
            time.sleep(0.1)
            dome.zoom.zoom((shortest + longest) / 2 * (1.0 + 0.1 * (time.monotonic() % 1.0)))

        assert "the lens at" in (said := fails(zoom_on))
        assert "did not arrive in time: it is at 0 where" in said


def test_a_steered_dome_that_loses_its_position_is_stopped_and_named():
    with OnvifUnit("continuous-only") as unit, opened(unit) as dome:
        dome.head.move(math.radians(60.0), 0.0, speed=math.radians(40.0))
        wait_for(lambda: unit.pan.degrees() > 5.0)
        unit.faults.set("position-lost")
        assert "outside of its own range from -1 to 1: its position is lost" in fails(dome.head.state)
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


def zoom_from(monkeypatch, lowest, highest):
    """Let the device's zoom have another range than from 0 to 1; its lens goes with the share of it."""
    monkeypatch.setattr(OnvifCamera, "zoom_numbers", lambda camera: (lowest, highest))
    go, position = OnvifCamera.go, OnvifCamera.position

    def scaled_go(camera, goals, zoom, speeds):
        go(camera, goals, None if zoom is None else (zoom - lowest) / (highest - lowest), speeds)

    def scaled_position(camera):
        pan, tilt, share = position(camera)
        return pan, tilt, lowest + share * (highest - lowest)

    monkeypatch.setattr(OnvifCamera, "go", scaled_go)
    monkeypatch.setattr(OnvifCamera, "position", scaled_position)


@pytest.mark.parametrize("ends", [(1.0, 41.0), (0.0, 100.0), (10.0, 100.0)])
def test_a_lens_without_a_table_has_the_devices_own_range(ends, monkeypatch):
    zoom_from(monkeypatch, *ends)
    with OnvifUnit() as unit, opened(unit, lens=()) as dome:
        shortest, longest = dome.zoom.focal_range
        assert longest == pytest.approx(20 * shortest)
        dome.zoom.zoom(longest)
        wait_for(lambda: not dome.zoom.state().moving)
        assert unit.lens.position() == unit.lens.last


@pytest.mark.parametrize(("profiles", "name", "part", "message"), [
    (("continuous-only",), "ContinuousPanTiltVelocitySpace", "Velocity", "ContinuousMove"),
    ((), "PanTiltSpeedSpace", "Speed", "AbsoluteMove"),
])  # fmt: skip
def test_speeds_have_the_numbers_and_the_name_of_their_space(profiles, name, part, message, monkeypatch):
    """To 64 at the highest: at a fifth of it, 12.8."""
    asked = []

    def options(number, usual, *about):
        block = re.compile(f"(<tt:{name}>.*?Max>)1(<.*?</tt:{name}>)")
        return block.sub(r"\g<1>64\2", usual(*about))

    def answer(number, usual, camera, faults, said):
        asked.append(said.body.find(f"{{*}}{part}/{{*}}PanTilt"))
        return usual(camera, faults, said)

    counted(monkeypatch, "GetConfigurationOptions", options)
    with OnvifUnit(*profiles) as unit, opened(unit) as dome:
        counted(monkeypatch, message, answer)
        dome.head.move(math.radians(100.0), 0.0, speed=math.radians(20.0))
        wait_for(lambda: asked)
        assert float(asked[0].get("x")) == pytest.approx(0.2 * 64.0)
        assert asked[0].get("space").startswith(PAN_TILT)


def test_a_device_that_names_its_spaces_at_the_node_alone_is_sent_to_positions(monkeypatch):
    counted(
        monkeypatch,
        "GetConfigurationOptions",
        lambda number, usual, *about: re.sub("<tt:Spaces>.*</tt:Spaces>", "<tt:Spaces/>", usual(*about)),
    )
    with OnvifUnit() as unit, opened(unit) as dome:
        dome.head.move(math.radians(20.0), math.radians(10.0), wait=True)
        assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((20.0, 10.0), abs=NEAR_DEG)
        assert "AbsoluteMove" in unit.moves


def test_a_steered_device_that_says_no_limits_has_the_ends_of_the_generic_space(monkeypatch):
    usual, limits = emulator._configuration, re.compile("<tt:PanTiltLimits>.*</tt:PanTiltLimits>")
    monkeypatch.setattr(emulator, "_configuration", lambda *about: limits.sub("", usual(*about)))
    with OnvifUnit("continuous-only") as unit, opened(unit) as dome:
        dome.head.move(math.radians(15.0), 0.0, wait=True)
        assert unit.pan.degrees() == pytest.approx(15.0, abs=unit.settings.slack_deg + NEAR_DEG)


def test_ends_that_a_device_does_not_say_are_named(monkeypatch):
    counted(
        monkeypatch,
        "GetConfigurationOptions",
        lambda number, usual, *about: re.sub("<tt:YRange>.*?</tt:YRange>", "", usual(*about)),
    )
    counted(monkeypatch, "GetNodes", lambda *about: "")
    with OnvifUnit() as unit:
        assert "does not say the ends of tilt: it is not driven" in refused(unit)


# What is wrong from the start


@pytest.mark.parametrize("ends", [(1.0, 41.0), (10.0, 100.0)])
def test_a_table_outside_of_the_devices_range_is_refused_and_nothing_stays_open(ends, monkeypatch):
    zoom_from(monkeypatch, *ends)
    before = set(threading.enumerate())
    with OnvifUnit() as unit:
        said = refused(unit)
        assert re.search(f"hardware.ptz.lens: .* from {ends[0]:g} to {ends[1]:g}; write numbers of that range", said)
    wait_for(lambda: set(threading.enumerate()) <= before)


@pytest.mark.parametrize(("profile", "said"), [
    ("no-ptz", r"has no pan-tilt-zoom service: it can be \[hardware.fixed\]"),
    ("presets-only", "has neither absolute moves nor velocities, only presets: it is not driven"),
    ("continuous-only,no-status", "can only be moved by velocities, and does not say where it is: it is not driven"),
    ("no-zoom", "says that zoom goes from 1 to 1"),
    ("position-lost", r"pan is at 1.038, outside of its own range from -1 to 1: its position is lost; switch it off"),
    ("unauthorized", "not for the user 'root': check hardware.ptz.user and the password"),
    ("silence", "did not answer GetSystemDateAndTime in time"), ("refuse", "broke off|cannot be reached"),
    ("garbage", "no SOAP"), ("half-answers", "broke off"), ("not-soap", "no SOAP"), ("bomb", "it has a document type"),
    ("endless", "without end"),
])  # fmt: skip
def test_a_dome_that_cannot_be_driven_is_named_in_one_line(profile, said, monkeypatch):
    monkeypatch.setattr(onvif, "ASK_S", 2.0)
    with OnvifUnit(*profile.split(",")) as unit:
        assert re.search(said, refused(unit))


@pytest.mark.parametrize(("position", "said"), [
    ((557.4, 0.0, 0.0), "pan is at 557.4, outside of its own range from -1 to 1"),
    ((0.0, 0.0, 30.0), "the lens is at 30, outside of its own range from 0 to 1"),
])  # fmt: skip
def test_a_position_in_other_numbers_is_refused(position, said, monkeypatch):
    monkeypatch.setattr(OnvifCamera, "position", lambda camera: position)
    with OnvifUnit() as unit:
        assert f"says that {said}: its position is lost; switch it off and on" in refused(unit)


def test_an_address_of_a_service_that_is_none_is_named(monkeypatch):
    monkeypatch.setattr(emulator, "_address", lambda *about: "http://[fe80::1/onvif/ptz")
    with OnvifUnit() as unit:
        assert "names addresses of services that are none" in refused(unit)


@pytest.mark.parametrize(("changes", "said"), [
    ({"password": "wrong"}, "not for the user 'root': check hardware.ptz.user and the password, which may be in"),
    ({"user": "", "password": ""}, "no user is given: check hardware.ptz.user"),
    ({"profile": "other"}, "hardware.ptz.profile: .* has no 'other' that moves; valid here: profile_1"),
    ({"port": 1}, r"cannot be reached \(Connection refused\): check host and port"),
    ({"host": "nowhere.invalid"}, "cannot be reached"),
    ({"size": (640, 480)}, r"hardware.fixed.size: \[640, 480\] is not what"),
])  # fmt: skip
def test_wrong_settings_are_named_in_one_line(changes, said):
    with OnvifUnit() as unit:
        assert re.search(said, refused(unit, **changes))


@pytest.mark.parametrize("address", ["rtp://10.0.0.9/a", "rtsp://[fe80::/a", "rtsp://root:hunter2 & co@x:99999/a"])
def test_an_address_of_the_stream_that_is_none_is_named_in_one_line(address, monkeypatch):
    uri = address.replace("&", "&amp;")
    usual = ANSWERS[TRT, "GetStreamUri"]
    monkeypatch.setitem(
        ANSWERS,
        (TRT, "GetStreamUri"),
        lambda *about: re.sub("<tt:Uri>.*</tt:Uri>", f"<tt:Uri>{uri}</tt:Uri>", usual(*about)),
    )
    with OnvifUnit() as unit:
        assert "hardware.ptz.url: the address that the device at" in refused(unit)
        with opened(unit, url=unit.stream.url) as dome:
            assert dome.zoom.read(timeout=10.0).image.shape == (240, 320, 3)


@pytest.mark.parametrize(("keys", "said"), [
    ({"host": "192.168.0.88:8000"}, 'hardware.ptz.host: .* write host = "192.168.0.88" and port = 8000'),
    ({"host": "http://dome/onvif/device_service"}, 'hardware.ptz.host: .* write host = "dome"$'),
    ({"host": "root:hunter2@dome"}, "hardware.ptz.host: has a user or a password in it; write user ="),
    ({"url": "rtsp://root:hunter2@dome/1"}, "hardware.ptz.url: has a user or a password in it; write user ="),
])  # fmt: skip
def test_an_address_with_more_in_it_is_refused_without_its_password(keys, said):
    with pytest.raises(ConfigError, match=said) as caught:
        devices(parse_config({"backend": "hardware", "hardware": {"ptz": {"driver": "onvif"} | keys}}).hardware)
    assert "hunter2" not in str(caught.value)
    plain = {"driver": "onvif", "host": "fe80::1"}
    devices(parse_config({"backend": "hardware", "hardware": {"ptz": plain}}).hardware)


def test_another_protocol_at_the_port_is_named():
    with OnvifUnit() as unit:
        assert re.search("did not answer|broke off|no SOAP|HTTP", refused(unit, port=unit.stream.port))


def test_usual_ports_are_tried_where_none_is_given(monkeypatch):
    with OnvifUnit() as unit:
        monkeypatch.setattr(onvif, "PORTS", (1, unit.server.port))
        with opened(unit, port=0) as dome:
            assert dome.head.state().t > 0
        monkeypatch.setattr(onvif, "PORTS", (1, 2))
        assert "ports 1, 2 were tried, and hardware.ptz.port is for another one" in refused(unit, port=0)


# Users and clocks


@pytest.mark.parametrize("profiles", [
    ("clock-20s",), ("clock-10h",), ("clock-10h", "time-needs-user"), ("http-digest",), ("http-digest", "clock-20s"),
], ids=",".join)  # fmt: skip
def test_a_user_is_let_in_whatever_the_devices_clock(profiles):
    with OnvifUnit(*profiles) as unit, contextlib.closing(OnvifLink(unit.settings, MonotonicClock())) as link:
        assert unit.server.counts.refused <= 1
        wanted = sum({"clock-20s": 20.0, "clock-10h": -36000.0}.get(name, 0.0) for name in profiles)
        assert link._device.soap.clock_off_s == pytest.approx(wanted, abs=1.0)
        assert bool(wanted) == ("its clock" in link.identity)


def test_a_clock_that_is_set_meanwhile_is_asked_again():
    with OnvifUnit() as unit, opened(unit) as dome:
        unit.faults.set("clock-10h")
        dome.head.move(math.radians(5.0), 0.0, wait=True)
        assert unit.pan.degrees() == pytest.approx(5.0, abs=NEAR_DEG)


def test_a_user_without_the_right_to_move_is_told():
    with OnvifUnit("needs-administrator") as unit:
        assert "moving takes the rights of an operator or administrator" in refused(unit)


def test_a_dome_without_a_password_is_opened_without_one():
    with OnvifUnit(login=False) as unit, opened(unit) as dome:
        dome.head.move(math.radians(3.0), 0.0, wait=True)


def test_a_probe_describes_device_and_stream_and_moves_nothing(monkeypatch):
    monkeypatch.setattr("cotarget.drivers.stream.PROBE_S", 0.5)
    monkeypatch.setattr("cotarget.drivers.stream.LONGEST_PROBE_S", 0.5)
    with OnvifUnit() as unit:
        said = OnvifDome.probe(unit.settings)
        assert said.startswith(f"cotarget Emulated dome 1.0 at 127.0.0.1:{unit.server.port}, profile profile_1, pan ")
        assert "320x240 h264" in said
        assert unit.moves == []


def test_no_thread_is_left():
    before = set(threading.enumerate())
    with OnvifUnit() as unit, opened(unit) as dome:
        dome.head.state()
    wait_for(lambda: set(threading.enumerate()) <= before)


def test_wrong_limits_are_refused():
    with OnvifUnit("degrees") as unit, pytest.raises(ConfigError, match="pan_deg"):
        OnvifDome(dataclasses.replace(unit.settings, pan_deg=(-90.0, 90.0)), MonotonicClock(), SAFETY)


def test_a_dome_that_is_slow_when_zoomed_in_is_driven_by_its_speed_there():
    """At its longest the emulated dome turns by 1.5 degrees/s at full speed: a share of 100 would take 100 s."""
    zoomed = ((1.5, 30.0), (2.5, 7.85), (4.0, 4.5), (6.4, 1.5))
    with OnvifUnit("capped-by-zoom") as unit, opened(unit, zoomed_speeds=zoomed) as dome:
        assert dome.head.limits.pan.speed == pytest.approx(math.radians(100.0))
        dome.zoom.zoom(dome.zoom.focal_range[1])
        wait_for(lambda: not dome.zoom.state().moving and unit.lens.position() == unit.lens.last)
        begin = time.monotonic()
        dome.head.move(math.radians(1.0), 0.0, math.radians(1.0), wait=True)
        assert 1.0 <= time.monotonic() - begin < 3.0


def test_speeds_that_rise_with_the_zoom_are_refused():
    with pytest.raises(ConfigError, match=r"hardware\.ptz\.zoomed_speeds"):
        device_of("ptz", {"driver": "onvif", "host": "127.0.0.1", "zoomed_speeds": [[2, 10], [4, 20]]})


def test_a_dome_that_ignores_absolute_moves_is_steered_where_the_file_says_so():
    with OnvifUnit("absolute-ignored") as unit, opened(unit, absolute=False) as dome:
        dome.head.move(math.radians(12.0), math.radians(4.0), wait=True)
        assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((12.0, 4.0), abs=0.3)
