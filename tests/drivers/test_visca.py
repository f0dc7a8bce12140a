"""The VISCA driver on an emulated camera: transports, units, faults, and what cannot be driven."""

import contextlib
import math
import re
import threading
import time

import pytest

from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.head_link import Requests
from cotarget.drivers.interlock import addresses_of, rig_lock
from cotarget.drivers.rig import device_of
from cotarget.drivers.visca import FAMILIES, ViscaDome, ViscaLink, ViscaSettings
from cotarget.drivers.visca_protocol import TRANSPORTS, open_line
from cotarget.emulators.serve import TcpServer
from cotarget.errors import ConfigError, CotargetError, DeviceError
from cotarget.schema import as_table
from tests.support.plants import FEED_SIZE, LiveDome, wait_for

pytestmark = pytest.mark.wire
GOAL_DEG = (20.0, -10.0)
SLOW = math.radians(8.0)  # turns for seconds
STOPPED_S = 0.5  # from a halt to rest: .1 s to repeat a lost stop, and braking from 8 degrees/s
ENDS_S = 10.0  # two tries of .25 s and .2 s beyond, on a busy machine
ROUNDING = 1e-9


@contextlib.contextmanager
def opened(live, **settings):
    with live, contextlib.closing(live.open(**settings)) as dome:
        yield dome


def goal(live):
    return tuple(round(angle / FAMILIES[live.units].step_deg) for angle in GOAL_DEG)


def turn(dome, wait=True):
    return dome.head.move(*map(math.radians, GOAL_DEG), wait=wait)


def halts(dome, live):
    """Halt in mid-move; the head comes to rest at once, and short of the goal."""
    dome.head.move(math.radians(-150.0), 0.0, speed=SLOW)
    wait_for(live.turning)
    dome.head.halt()
    begin = time.monotonic()
    wait_for(lambda: not live.turning())
    assert time.monotonic() - begin < STOPPED_S
    assert live.at()[0] > -100 / FAMILIES[live.units].step_deg


# Transports and units


@pytest.mark.parametrize("protocol", TRANSPORTS)
@pytest.mark.parametrize("named", [True, False], ids=["named", "found by asking"])
def test_it_turns_zooms_and_halts_by_each_transport(protocol, named):
    live = LiveDome(protocol=protocol)
    with opened(live, **({} if named else {"protocol": "auto"})) as dome:
        pan, tilt = turn(dome)
        assert live.at() == goal(live) == (288, -144)
        assert (dome.head.state().pan, dome.head.state().tilt) == (pan, tilt)
        reached = dome.zoom.zoom(1000.0)
        wait_for(lambda: not dome.zoom.state().moving)
        assert dome.zoom.state().focal_px == pytest.approx(reached, rel=ROUNDING)
        assert dome.zoom.read().image.shape == (FEED_SIZE[1], FEED_SIZE[0], 3)
        assert not live.camera.digital_zoom
        halts(dome, live)


@pytest.mark.parametrize("units", FAMILIES)
def test_angles_in_the_units_of_each_family(units):
    live = LiveDome(units)
    with opened(live) as dome:
        turn(dome)
        assert live.at() == goal(live)
        pan, tilt = dome.head.limits.axes
        step = math.radians(FAMILIES[units].step_deg)
        assert (pan.step, tilt.step) == (pytest.approx(step), pytest.approx(step))
        assert math.degrees(pan.speed) == pytest.approx(80.0)
        assert pan.acceleration is None


def test_nothing_is_sent_beyond_the_limits():
    live = LiveDome()
    with opened(live, pan_deg=(-30.0, 40.0), tilt_deg=(-5.0, 6.0)) as dome:
        commanded = dome.head.move(3.0, -3.0, wait=True)
        assert live.at() == (576, -72)  # 40 and -5 degrees, 14.4 counts each
        assert [math.degrees(angle) for angle in commanded] == pytest.approx([40.0, -5.0])
        assert live.pan.furthest == 576
        shortest, longest = dome.zoom.focal_range
        assert longest / shortest == pytest.approx(25.0)
        assert dome.zoom.zoom(1e6) == pytest.approx(longest)


@pytest.mark.parametrize(("speed_deg_s", "index"), [(0.5, 1), (1.0, 1), (2.9, 6), (44.9, 18), (45.0, 19), (80.0, 21)])
def test_the_fastest_index_that_is_not_above_the_speed(speed_deg_s, index):
    sent = []
    with LiveDome() as live, contextlib.closing(ViscaLink(live.settings(), MonotonicClock())) as link:
        link._line.order = lambda command: sent.append(command)
        pan, tilt = (math.radians(speed_deg_s) / axis.unit for axis in link.axes[:2])
        link.move((0, 0), (pan, tilt), Requests())
    assert sent[0][4] == index


# Faults


@pytest.mark.parametrize("protocol", TRANSPORTS)
@pytest.mark.parametrize("fault", ["lost-packets", "lost-stop", "lost-stop-answer", "lost-move-answer", "garbage"])
def test_it_arrives_and_halts_though_messages_get_lost(fault, protocol):
    live = LiveDome(protocol=protocol)
    live.faults.set(fault)
    with opened(live) as dome:
        turn(dome)
        assert live.at() == goal(live)
        live.faults.set(fault)  # some happen once
        halts(dome, live)


@pytest.mark.parametrize("fault", ["constant-number", "three-numbers", "wrong-number", "five-nibbles", "late-answers"])
def test_it_drives_cameras_that_number_or_answer_otherwise(fault):
    live = LiveDome()
    live.faults.set(fault)
    with opened(live) as dome:
        turn(dome)
        assert live.at() == goal(live)
        dome.head.halt()
        dome.head.move(math.radians(-30.0), 0.0, wait=True)
        assert live.at() == (-432, 0)


def test_a_late_answer_on_a_bare_transport_is_not_taken_for_the_next_one():
    """Each answer takes .4 s; positions are dated to when the camera read them."""
    live = LiveDome(protocol="tcp")
    live.faults.set("late-answers")
    with live, contextlib.closing(ViscaLink(live.settings(), MonotonicClock())) as link:
        for count in (0, 100, 200):
            live.pan.command(count, 1e6, math.inf)
            wait_for(lambda: not live.turning())
            link.poll(Requests())
            pan, *_ = link.poll(Requests())
            assert pan.position == live.at()[0]
            assert time.monotonic() - pan.t == pytest.approx(0.2, abs=0.15)


def test_a_stop_is_repeated_until_it_is_acknowledged():
    live = LiveDome()
    with opened(live) as dome:
        dome.head.move(math.radians(-150.0), 0.0, speed=SLOW)
        wait_for(live.turning)
        live.faults.set("silence")
        threading.Timer(0.6, live.faults.set, ("silence", False)).start()
        dome.head.halt()
        wait_for(lambda: not live.turning())
        assert live.at()[0] > -30 / FAMILIES["ptzoptics"].step_deg


def test_a_stop_that_nothing_acknowledges_is_an_error():
    live = LiveDome()
    with opened(live) as dome:
        live.faults.set("silence")
        with pytest.raises(DeviceError, match=r"did not acknowledge a halt|does not answer"):
            dome.head.halt()
        with pytest.raises(DeviceError, match="check its power and network"):
            wait_for(lambda: dome.head.state() is None)


@pytest.mark.parametrize(("fault", "said"), [
    ("buffer-full", "its command buffer is full"),
    ("not-executable", "cannot do that now"),
])  # fmt: skip
def test_a_refused_move_is_an_error_and_the_head_rests(fault, said):
    live = LiveDome()
    with opened(live) as dome:
        live.faults.set(fault)
        threading.Timer(1.0, live.faults.set, (fault, False)).start()  # a full buffer takes no stop either
        with pytest.raises(DeviceError, match=said):
            turn(dome)
        assert not live.turning()
        wait_for(lambda: fault not in live.faults)
        turn(dome)
        assert live.at() == goal(live)


def test_a_buffer_that_is_full_for_a_moment_delays_the_move():
    live = LiveDome()
    with opened(live) as dome:
        live.faults.set("buffer-full")
        threading.Timer(0.2, live.faults.set, ("buffer-full", False)).start()
        turn(dome)
        assert live.at() == goal(live)


def test_a_camera_without_a_free_socket_gets_the_newest_move_and_goes_on_zooming():
    live = LiveDome()
    live.faults.set("keeps-sockets")
    with opened(live) as dome:
        reached = dome.zoom.zoom(2000.0)
        for pan in (-20.0, 30.0, -30.0, 10.0):
            dome.head.move(math.radians(pan), 0.0, speed=10 * SLOW)
            time.sleep(0.1)
        dome.head.move(math.radians(20.0), 0.0, wait=True)
        assert live.at() == (288, 0)
        wait_for(lambda: not dome.zoom.state().moving)
        assert dome.zoom.state().focal_px == pytest.approx(reached, rel=ROUNDING)


def test_a_camera_that_is_switched_off_in_mid_move_is_reported():
    live = LiveDome()
    with opened(live) as dome:
        dome.head.move(math.radians(-150.0), 0.0, speed=SLOW)
        wait_for(live.turning)
        live.faults.set("standby")
        with pytest.raises(DeviceError, match="refuses: it cannot do that now"):
            wait_for(lambda: dome.head.state() is None)
        wait_for(lambda: not live.turning())


@pytest.mark.parametrize("ends", ["close", "error"])
def test_after_any_end_the_head_rests(ends):
    live = LiveDome()
    with live:
        with contextlib.suppress(RuntimeError), contextlib.closing(live.open()) as dome:
            dome.head.move(math.radians(-150.0), 0.0, speed=SLOW)
            wait_for(live.turning)
            if ends == "error":
                raise RuntimeError
        wait_for(lambda: not live.turning())
        assert live.at()[0] > -100 / FAMILIES["ptzoptics"].step_deg


# What cannot be driven


def refusal(live, **settings):
    """The error of a camera that cannot be opened; nothing has moved."""
    with pytest.raises(CotargetError) as caught:
        live.open(**settings)
    said = str(caught.value)
    assert "\n" not in said
    assert not live.turning()
    assert live.at() == (0, 0)
    return said


@pytest.mark.parametrize(("fault", "said"), [
    ("standby", r"is in standby: switch it on"),
    ("no-pan-tilt", r"speaks VISCA but does not know its pan and tilt: it is no pan-tilt-zoom camera"),
    ("no-zoom", r"speaks VISCA but does not know its zoom"),
    ("seven-nibbles", r"reports pan and tilt in 15 nibbles, where 8 or 9 are known"),
    ("silence", r"^no camera at 127\.0\.0\.1 answers VISCA \(UDP \d+ with Sony's header: no answer\): check host "),
])  # fmt: skip
def test_a_camera_that_cannot_be_driven_is_named_in_one_line(fault, said):
    with LiveDome() as live:
        live.faults.set(fault)
        assert re.search(said, refusal(live))


def test_wrong_addresses_say_what_was_tried():
    with LiveDome() as live:
        web = int(live.stream.url.rpartition(":")[2])
        said = refusal(live, port=web, protocol="auto")
        tried = [
            f"UDP {web} with Sony's header: Connection refused",
            f"UDP {web}: Connection refused",
            f"TCP {web}: no a",
        ]
        assert [each in said for each in tried] == [True] * 3
        assert "TCP 1: Connection refused" in refusal(live, port=1, protocol="tcp")
        assert "is no address that is known here" in refusal(live, host="camera.invalid")
        with TcpServer(lambda connection: (connection.sendall(b"SSH-2.0-x\r\n"), connection.recv(1))) as other:
            assert "answers 'SSH-2.0-x\\r\\n', which is no VISCA" in refusal(live, port=other.port, protocol="tcp")
        with TcpServer(lambda connection: connection.recv(100)) as busy:
            assert "closes the connection, as to a second program" in refusal(live, port=busy.port, protocol="tcp")


@pytest.mark.parametrize("said", [b"\x00\x13\x37\xff", b"\x90\x41\xff", b"x" * 1000], ids=["noise", "answers", "text"])
def test_an_endless_answer_ends_in_time(said):
    def flood(connection):
        while True:
            connection.sendall(100 * said)

    with LiveDome() as live, TcpServer(flood) as other:
        begin = time.monotonic()
        assert "no camera at 127.0.0.1 answers VISCA" in refusal(live, port=other.port, protocol="tcp")
        assert time.monotonic() - begin < 3 * ENDS_S


def test_wrong_units_are_named_with_those_that_fit():
    """7000 counts are 154 degrees of an EVI-D80, and 486 of a PTZOptics."""
    with LiveDome("evi_d80") as live:
        live.pan.command(7000, 1e6, math.inf)
        wait_for(lambda: not live.turning())
        with pytest.raises(ConfigError, match=r'^hardware\.ptz\.units: .* 486 degrees by "ptzoptics".*"evi_d80"$'):
            live.open(units="ptzoptics")
        live.open(pan_sign=-1).close()


def test_the_wrong_stream_closes_the_head_again():
    with LiveDome() as live:
        said = refusal(live, size=(1280, 720))
        assert "write size = [320, 240]" in said
        live.open().close()


def test_a_password_in_the_address_of_the_stream_is_refused():
    with pytest.raises(
        ConfigError, match=r"^hardware\.ptz\.url: has a user or a password in it; write user = and give"
    ):
        device_of("ptz", {"driver": "visca", "host": "camera", "url": "rtsp://admin:secret@camera/stream1"})


def test_a_second_program_is_refused():
    with LiveDome() as live:
        device = device_of("ptz", {"driver": "visca", **as_table(live.settings())})
        with (
            rig_lock(*addresses_of(live.settings())),
            pytest.raises(DeviceError, match=rf"at 127\.0\.0\.1:{live.server.ports[0]} is open already"),
        ):
            device.probe()


def test_doctor_describes_camera_and_stream():
    with LiveDome() as live:
        said = device_of("ptz", {"driver": "visca", **as_table(live.settings())}).probe()
        assert "pan 0.0, tilt 0.0 degrees, zoom 0; 320x240 mjpeg" in said
        assert live.camera.digital_zoom  # nothing was changed


def test_the_lock_is_of_host_and_port():
    assert addresses_of(ViscaSettings(host="192.0.2.1", url="rtsp://192.0.2.1/a"))[0] == "192.0.2.1"
    assert addresses_of(ViscaSettings(host="192.0.2.1", port=1259))[0] == "192.0.2.1:1259"
    assert addresses_of(ViscaSettings(host="2001:db8::1", port=1259))[0] == "[2001:db8::1]:1259"


def test_the_usual_ports_are_tried_in_order():
    with pytest.raises(DeviceError) as caught:  # nothing listens at this address of the machine
        open_line("127.0.0.77", 0, tuple(TRANSPORTS), MonotonicClock())
    assert [part in str(caught.value) for part in ("UDP 52381 with", "UDP 1259", "TCP 5678")] == [True] * 3


def test_the_driver_is_a_name_of_rig_toml():
    assert device_of("ptz", {"driver": "visca"}).driver is ViscaDome
    with pytest.raises(ConfigError, match=r"hardware\.ptz\.driver: is missing; give module:name or one of: .*visca"):
        device_of("ptz", {"host": "camera"})
