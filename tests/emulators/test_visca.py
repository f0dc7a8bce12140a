"""The emulated VISCA camera, by bytes from the makers' manuals."""

import contextlib
import socket
import time

import pytest

from cotarget.emulators.serve import Faults
from cotarget.emulators.visca import BLOCK, VISCA_FAULTS, ViscaCamera, ViscaModel, ViscaServer
from tests.formats.lists import assert_listed
from tests.support.emulated_camera import DEADLINE_S, LensModel
from tests.support.plants import AxisModel
from tests.support.simulated_clock import SimClock

SYNTAX = "90 60 02 FF"


class Camera:
    """The firmware in simulated time, whose answers are noted."""

    def __init__(self, **model):
        self.clock, self.lens, self.faults, self.said = SimClock(), LensModel(), Faults(VISCA_FAULTS), []
        self.pan, self.tilt = AxisModel(self.clock.now), AxisModel(self.clock.now)
        self.firmware = ViscaCamera(self.pan, self.tilt, self.lens, ViscaModel(**model), self.faults)

    def ask(self, text):
        """Its answers until now, also to earlier commands."""
        self.firmware.receive(bytes.fromhex(text), lambda answer: self.said.append(answer.hex(" ").upper()))
        self.firmware.tick()
        said, self.said = self.said, []
        return said

    def wait(self, seconds):
        self.clock.sleep_until(self.clock.now() + seconds)
        self.firmware.tick()
        said, self.said = self.said, []
        return said


@pytest.fixture
def camera():
    return Camera()


def test_it_goes_to_a_position_and_says_when_it_is_there(camera):
    """F726 and FE78 of the manual's example, at 60 degrees/s from index 23: 157 degrees take less than 3 s."""
    assert camera.ask("81 01 06 02 18 12 0F 07 02 06 0F 0E 07 08 FF") == ["90 41 FF"]
    assert camera.wait(1.0) == []
    assert camera.wait(3.0) == ["90 51 FF"]
    assert camera.ask("81 09 06 12 FF") == ["90 50 0F 07 02 06 0F 0E 07 08 FF"]
    assert camera.ask("81 01 06 03 18 12 00 00 00 05 00 00 00 00 FF") == ["90 41 FF"]  # five to the right
    camera.wait(1.0)
    assert camera.pan.position() == -2266 + 5


def test_limits_and_speeds(camera):
    camera.ask("81 01 06 02 0D 12 07 0F 0F 0F 00 00 00 00 FF")  # 32767 at 9 degrees/s
    camera.wait(1.0)
    before = camera.pan.position()
    camera.wait(1.0)
    assert camera.pan.position() - before == pytest.approx(9 * 14.4, abs=1)
    camera.wait(60.0)
    assert camera.pan.position() == 2448


def test_it_turns_until_a_stop(camera):
    assert camera.ask("81 01 06 01 0D 0D 01 01 FF") == ["90 41 FF"]  # left and up
    camera.wait(1.0)
    assert camera.pan.position() < 0 < camera.tilt.position()
    assert camera.ask("81 01 06 01 01 01 03 03 FF") == ["90 61 04 FF", "90 41 FF"]
    assert camera.wait(1.0) == ["90 51 FF"]
    at = camera.pan.position()
    camera.wait(1.0)
    assert camera.pan.position() == at


def test_zoom_has_a_table_and_two_sockets(camera):
    assert camera.ask("81 01 06 04 FF") == ["90 41 FF", "90 51 FF"]  # it is at home already
    camera.ask("81 01 06 01 01 01 01 03 FF")
    assert camera.ask("81 01 04 47 03 06 02 0C FF") == ["90 42 FF", "90 52 FF"]  # beside the turning head
    assert camera.ask("81 09 04 47 FF") == ["90 50 03 06 02 0C FF"]
    # 10 x of 25 x is .715 of the way in the logarithm; the lens has 128 steps.
    assert camera.lens.position() == 92
    assert camera.ask("81 21 FF") == ["90 61 04 FF"]
    assert camera.ask("81 22 FF") == ["90 62 05 FF"]


def test_inquiries(camera):
    assert camera.ask("81 09 04 00 FF") == ["90 50 02 FF"]
    assert camera.ask("81 09 04 06 FF") == ["90 50 02 FF"]
    camera.ask("81 01 04 06 03 FF")
    assert camera.ask("81 09 04 06 FF") == ["90 50 03 FF"]
    assert camera.ask("81 09 06 11 FF") == ["90 50 18 12 FF"]
    assert camera.ask("81 01 00 01 FF") == ["90 50 FF"]


@pytest.mark.parametrize("wrong", [
    "81 FF", "81 09 FF", "81 09 77 77 FF", "81 01 06 02 18 12 00 FF", "81 01 06 01 01 01 09 09 FF", "82 09 06 12 FF",
    "81 01 06 02 18 12 1F 07 02 06 0F 0E 07 08 FF", "81 01 04 47 00 FF",
])  # fmt: skip
def test_what_it_does_not_know_is_a_syntax_error(camera, wrong):
    assert camera.ask(wrong) == [SYNTAX]
    assert camera.pan.position() == camera.lens.position() == 0


@pytest.mark.parametrize(("fault", "order", "answer"), [
    ("buffer-full", "81 01 06 01 01 01 03 03 FF", "90 60 03 FF"),
    ("not-executable", "81 01 06 04 FF", "90 60 41 FF"),
    ("standby", "81 01 06 04 FF", "90 60 41 FF"),
    ("standby", "81 09 04 00 FF", "90 50 03 FF"),
    ("standby", "81 09 06 12 FF", "90 60 41 FF"),
    ("no-pan-tilt", "81 09 06 12 FF", SYNTAX),
    ("no-zoom", "81 09 04 47 FF", SYNTAX),
    ("five-nibbles", "81 09 06 12 FF", "90 50 00 00 00 00 00 00 00 00 00 FF"),
])  # fmt: skip
def test_faults_of_the_firmware(camera, fault, order, answer):
    camera.faults.set(fault)
    assert camera.ask(order) == [answer]


def test_lens_table_is_the_blocks_for_its_own_ratio():
    assert BLOCK.lens_table(25.0)[6] == [0x362C, pytest.approx(10.0)]
    assert BLOCK.lens_table(5.0)[-1] == [0x4000, pytest.approx(5.0)]


def test_its_faults_are_listed():
    assert_listed("emulation.txt", {f"visca ptz.{name}" for name in VISCA_FAULTS}, begins="visca ptz.")


# The network


@pytest.fixture
def server(camera):
    camera.clock.now = time.monotonic
    with ViscaServer(camera.firmware, camera.faults) as server:
        yield server


def udp(server, port, text):
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as client:
        client.settimeout(DEADLINE_S)
        client.connect((server.host, port))
        answers = []
        for each in text:
            client.send(bytes.fromhex(each))
            answers.append(client.recv(100).hex(" ").upper())
        return answers


@pytest.mark.wire
def test_sonys_header(server):
    assert udp(server, server.ports[0], [
        "02 00 00 01 00 00 00 00 01",  # reset
        "01 10 00 05 00 00 00 01 81 09 04 00 FF",
        "01 10 00 05 00 00 00 01 81 09 04 00 FF",  # the same number
        "01 10 00 09 00 00 00 02 81 09 04 00 FF",  # a wrong length
    ]) == [
        "02 01 00 01 00 00 00 00 01",
        "01 11 00 04 00 00 00 01 90 50 02 FF",
        "02 01 00 02 00 00 00 01 0F 01",
        "02 01 00 02 00 00 00 02 0F 02",
    ]  # fmt: skip


@pytest.mark.wire
def test_bare_by_udp_and_tcp(server):
    assert udp(server, server.ports[1], ["81 09 04 00 FF"]) == ["90 50 02 FF"]
    with socket.create_connection((server.host, server.ports[2]), DEADLINE_S) as client:
        client.sendall(bytes.fromhex("81 09"))
        client.sendall(bytes.fromhex("04 00 FF 81 09"))  # in pieces
        assert client.recv(100).hex(" ").upper() == "90 50 02 FF"
        client.sendall(bytes.fromhex("04 00 FF"))
        assert client.recv(100).hex(" ").upper() == "90 50 02 FF"
