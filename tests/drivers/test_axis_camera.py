"""The driver of the Axis video server against a scripted server on loopback, which shares no code with it."""

import contextlib
import http.client
import logging
import queue
import re
import socket
import socketserver
import sys
import threading
import time
from types import SimpleNamespace
from urllib.parse import parse_qsl, urlsplit

import cv2
import numpy as np
import pytest

from cotarget.drivers import axis, frame_buffer
from cotarget.drivers.axis import AxisCamera, AxisSettings, LoginError
from cotarget.drivers.clock import MonotonicClock
from cotarget.errors import ConfigError, DeviceError, MissingPackageError, StaleFrameError
from tests.support.loopback import Loopback
from tests.support.plants import FEED_SIZE, PASSWORD, USER, axis_server, wait_for

pytestmark = pytest.mark.wire
PARAM, STATUS, VIDEO = "/axis-cgi/param.cgi", "/axis-cgi/videostatus.cgi", "/axis-cgi/mjpg/video.cgi"
SIZE = (64, 48)
PATIENCE_S = 10.0  # for what should come at once, on a machine that has much else to do
HANG_S = 120.0  # longer than any test takes; then a mistake is no hang, but a failure
SHORT_SILENCE_S = 0.4  # instead of the driver's two seconds
LATENCY_S = 0.06


def jpeg(index, size=SIZE):
    """A picture that no other index has."""
    image = np.random.default_rng(index).integers(0, 255, (size[1] // 8, size[0] // 8, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", cv2.resize(image, size))[1].tobytes()


def part(body):
    return b"--myboundary\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%b\r\n" % (len(body), body)


def reply(status="200 OK", body=b"", kind="text/plain", *lines):
    head = [f"HTTP/1.0 {status}", f"Content-Type: {kind}", f"Content-Length: {len(body)}", *lines, "", ""]
    return "\r\n".join(head).encode() + body


BRAND = b"root.Brand.Brand=AXIS\nroot.Brand.ProdNbr=241Q\nroot.Brand.ProdFullName=AXIS 241Q Video Server\n"
PROPERTIES = b"root.Properties.API.HTTP.Version=2\nroot.Properties.Firmware.Version=4.48\n"
SOURCES = b"root.ImageSource.NbrOfSources=4\n"
NOT_FOUND = reply("404 Not Found")
STREAM = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=myboundary\r\n\r\n"


def parameters(request):
    texts = {"root.Brand": BRAND, "root.Properties": PROPERTIES, "root.ImageSource": SOURCES}
    return reply(body=texts.get(request.query["group"], b"# Error: Error -1 getting param in group\n"))


class Viewer:
    """A stream under way, in the hands of the test."""

    def __init__(self, connection):
        self._connection, self.over, self.send = connection, threading.Event(), connection.sendall

    def cut(self):
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        self.over.set()

    def gone(self):
        """Wait until the client has closed."""
        self._connection.settimeout(PATIENCE_S)
        return self._connection.recv(1) == b""


class Handler(socketserver.StreamRequestHandler):
    timeout = HANG_S  # a client that says nothing, or takes nothing

    def handle(self):
        line = self.rfile.readline().decode("latin-1")
        if not line:
            return
        url, server = urlsplit(line.split()[1]), self.server
        request = SimpleNamespace(
            path=url.path, query=dict(parse_qsl(url.query)), headers=http.client.parse_headers(self.rfile)
        )
        server.requests.append(request)
        answer = server.pages.get(request.path, NOT_FOUND)
        answer = answer(request) if callable(answer) else answer
        if answer is None:  # hangs
            server.closing.wait(HANG_S)
            return
        with contextlib.suppress(OSError):
            self.connection.sendall(answer)
        if answer.startswith(STREAM):
            viewer = Viewer(self.connection)
            server.all.append(viewer)
            server.viewers.put(viewer)
            if server.closing.is_set():  # a client that came back while the server was ending
                viewer.cut()
            viewer.over.wait(HANG_S)


class Script(Loopback, socketserver.ThreadingTCPServer):
    """A server on loopback: what it answers by path, and the streams that were opened."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server_address[1]}"
        self.pages = {
            PARAM: parameters,
            STATUS: lambda request: reply(body=f"Video {request.query['status']} = video\n".encode()),
            VIDEO: lambda _: STREAM + part(jpeg(0)),
        }
        self.requests, self.viewers, self.all = [], queue.Queue(), []

    def viewer(self):
        return self.viewers.get(timeout=PATIENCE_S)

    def cut(self):
        for viewer in self.all:
            viewer.cut()


def ended(thread):
    """Wait until a thread has ended, as it should at once."""
    thread.join(PATIENCE_S)
    assert not thread.is_alive()


@pytest.fixture
def server():
    with Script() as script:
        yield script


@pytest.fixture(autouse=True)
def tidy(monkeypatch):
    """No test leaves a thread, finds a password, or reaches its server if the driver used the environment's proxy."""
    for name in ("COTARGET_PASSWORD", "no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:1")
    yield
    assert not [thread for thread in threading.enumerate() if thread.name == "axis"]


def config(server, **changes):
    return AxisSettings(**{"url": server.url, "size": SIZE, "latency_s": LATENCY_S} | changes)


def opened(server, **changes):
    return contextlib.closing(AxisCamera(config(server, **changes), MonotonicClock()))


def refused(server, kind=DeviceError, **changes):
    """What the driver says when it cannot be opened."""
    with pytest.raises(kind) as error, opened(server, **changes):
        pass
    assert "\n" not in str(error.value)
    return str(error.value)


def stale(camera, t, timeout=0.05):
    with pytest.raises(StaleFrameError) as error:
        camera.read(t, timeout)
    assert "\n" not in str(error.value)
    return str(error.value)


def until(camera, t, words):
    """Read until the error says so; it may take the driver a moment to know."""
    deadline = time.monotonic() + PATIENCE_S
    while words not in (said := stale(camera, t)):
        assert time.monotonic() < deadline, said
    return said


def decoded(index):
    return cv2.imdecode(np.frombuffer(jpeg(index), np.uint8), cv2.IMREAD_COLOR)


def test_frames_carry_the_time_of_their_first_byte(server):
    clock = MonotonicClock()
    with opened(server) as camera:
        viewer = server.viewer()
        first = camera.read()
        np.testing.assert_array_equal(first.image, decoded(0))
        whole = part(jpeg(1))
        before = clock.now()
        viewer.send(whole[:200])
        stale(camera, first.t, 0.2)
        between = clock.now()
        viewer.send(whole[200:])
        second = camera.read(first.t, PATIENCE_S)
        assert before <= second.t + LATENCY_S <= between
        np.testing.assert_array_equal(second.image, decoded(1))
        assert (camera.counts.frames, camera.counts.refused, camera.counts.reconnects) == (2, 0, 0)


def test_the_stream_is_asked_for_as_configured(server):
    with opened(server, camera=3, resolution="CIF", compression=10, rate_hz=12.4):
        pass
    asked = server.requests[-1]
    expected = {"camera": "3", "resolution": "CIF", "compression": "10", "fps": "12", "des_fps": "12"}
    assert (asked.path, asked.query) == (VIDEO, expected)
    assert "Authorization" not in asked.headers
    server.pages[PARAM] = reply("404 Not Found")
    with opened(server, resolution=""):
        pass
    assert server.requests[-1].query == {"camera": "1", "compression": "30", "fps": "25"}


ENDLESS = STREAM + bytes(200_000)


@pytest.mark.parametrize(
    ("path", "page"), [(PARAM, NOT_FOUND), (STATUS, NOT_FOUND), pytest.param(PARAM, ENDLESS, id="endless")]
)
def test_a_server_that_tells_nothing_of_itself_is_taken_as_it_is(server, path, page):
    server.pages[path] = page
    with opened(server) as camera:
        assert camera.read().image.shape == (48, 64, 3)


def test_parameters_that_viewers_may_not_see_are_not_asked_for_again(server):
    server.pages[PARAM] = reply("401 Unauthorized", b"", "text/html", 'WWW-Authenticate: Basic realm="AXIS_1"')
    with opened(server, user="viewer", password=PASSWORD) as camera:
        camera.read()
    assert [request.path for request in server.requests] == [PARAM, PARAM, STATUS, VIDEO]


BASIC = 'WWW-Authenticate: Basic realm="AXIS_00408C000241"'
DIGEST = 'WWW-Authenticate: Digest realm="AXIS_00408C000241", nonce="abc", algorithm=MD5, qop="auth"'


@pytest.mark.parametrize("place", ["config", "environment", "address"])
@pytest.mark.parametrize("scheme", ["basic", "digest"])
def test_authentication_is_what_the_server_asks_for(scheme, place, monkeypatch, caplog):
    caplog.set_level(logging.DEBUG)
    given = {"user": USER, "password": PASSWORD}
    if place == "environment":
        monkeypatch.setenv("COTARGET_PASSWORD", given.pop("password"))
    with axis_server(scheme) as unit:
        if place == "address":
            given = {"url": unit.url.replace("http://", "http://root:hunter2%20%26%20co@")}
        with opened(unit, size=FEED_SIZE, resolution="320x240", **given) as camera:
            t = camera.read().t
            unit.faults.set("cut")
            wait_for(lambda: camera.counts.reconnects)
            unit.faults.set("cut", False)
            assert camera.read(t, PATIENCE_S).t > t
    assert "hunter2" not in caplog.text


def test_a_wrong_password_is_an_error_that_does_not_show_it(caplog):
    caplog.set_level(logging.DEBUG)
    with axis_server() as unit:
        for given, remedy in (
            ({"user": USER, "password": "hunter1"}, "check hardware.fixed.user and the password"),
            ({"user": USER}, "set the environment variable COTARGET_PASSWORD"),
            ({}, "set hardware.fixed.user and the environment variable COTARGET_PASSWORD"),
        ):
            said = refused(unit, LoginError, **given)
            assert remedy in said
            assert "hunter" not in said + caplog.text


def test_a_password_that_the_server_repeats_is_masked(server):
    server.pages[VIDEO] = reply(body=f"{PASSWORD} is wrong".encode())
    assert "'*** is wrong'" in refused(server, user=USER, password=PASSWORD)


def test_digest_comes_before_basic(server):
    server.pages[VIDEO] = reply("401 Unauthorized", b"who are you?", "text/html", BASIC, DIGEST)
    refused(server, LoginError, user=USER, password=PASSWORD)
    assert server.requests[-1].headers["Authorization"].startswith("Digest ")


@pytest.mark.parametrize(
    "challenge",
    ["Digest realm", 'Digest realm="x", nonce="y", algorithm=ROT13', 'Digest realm="x", nonce="y", qop=z'],
)
def test_a_challenge_that_makes_no_sense_is_one_line(server, challenge):
    server.pages[PARAM] = reply("401 Unauthorized", b"", "text/html", f"WWW-Authenticate: {challenge}")
    assert refused(server, user="root", password="x").startswith(server.url)


# What the server answers, what is configured otherwise, and the key or status that the error names.
REFUSALS = {
    "nothing there": ({VIDEO: reply("404 Not Found")}, {}, "hardware.fixed.camera"),
    "wrong resolution": ({VIDEO: reply("400 Bad Request")}, {}, "resolution '4CIF'"),
    "not allowed": ({VIDEO: reply("403 Forbidden")}, {"user": "eve"}, "hardware.fixed.user"),
    "elsewhere": ({VIDEO: reply("302 Found", b"", "text/html", "Location: https://cam/x")}, {}, "https://cam/x"),
    "a page": ({VIDEO: reply(kind="text/html")}, {}, "text/html"),
    "an error in words": ({VIDEO: reply(body=b"# Error: no\nsuch")}, {}, "'# Error: no such'"),
    "another make": ({PARAM: reply(body=b"root.Brand.Brand=Acme\n")}, {}, "'Acme'"),
    "no such input": ({}, {"camera": 5}, "hardware.fixed.camera to 1 to 4"),
    "no signal": ({STATUS: reply(body=b"Video 1 = no video\n")}, {}, "no video on input 1"),
    "out of order": ({VIDEO: reply("500 Internal Server Error")}, {}, "500"),
    "no HTTP": ({PARAM: b"220 mail.example.org ESMTP\r\n"}, {}, "HTTP"),
    "half a head": ({VIDEO: STREAM[:30]}, {}, "HTTP"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_a_refusal_is_an_error_of_one_line(server, name, monkeypatch):
    monkeypatch.setattr(axis, "OPEN_S", 0.5)
    pages, changes, words = REFUSALS[name]
    server.pages |= pages
    said = refused(server, **changes)
    assert said.startswith(server.url)
    assert words in said


@pytest.mark.parametrize(
    ("url", "kind", "said"),
    [
        ("http://127.0.0.1:1", DeviceError, "^http://127.0.0.1:1 cannot be reached"),
        ("http://a\x01b", ConfigError, r"^hardware\.fixed\.url: "),
    ],
)
def test_no_server_at_the_address(url, kind, said):
    with pytest.raises(kind, match=said):
        AxisCamera(AxisSettings(url=url), MonotonicClock())


def test_httpx_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "httpx", None)
    with pytest.raises(MissingPackageError, match=r"extra hardware: .+ -m pip install .*'httpx>="):
        AxisCamera(AxisSettings(url="http://127.0.0.1"), MonotonicClock())


def test_another_size_than_configured(server):
    said = refused(server, ConfigError, size=(704, 576))
    assert said.startswith("hardware.fixed.size: ")
    assert "size = [64, 48]" in said


def test_a_busy_server_is_asked_again(server, monkeypatch):
    answers = iter([reply("503 Service Unavailable"), reply("503 Service Unavailable"), STREAM + part(jpeg(0))])
    server.pages[VIDEO] = lambda _: next(answers)
    with opened(server) as camera:
        camera.read()
    monkeypatch.setattr(axis, "OPEN_S", 0.3)
    server.pages[VIDEO] = reply("503 Service Unavailable")
    assert "busy" in refused(server)


@pytest.mark.parametrize("sent", [b"", STREAM, STREAM + b"--myboundary\r\nContent-Type: text/plain\r\n\r\nno"])
def test_a_server_that_sends_no_picture(server, sent, monkeypatch):
    monkeypatch.setattr(axis, "OPEN_S", 0.3)
    monkeypatch.setattr(axis, "SILENCE_S", SHORT_SILENCE_S)
    server.pages[VIDEO] = sent or None
    assert server.url in refused(server)


def test_a_cut_stream_is_opened_again(server):
    with opened(server) as camera:
        viewer = server.viewer()
        t = camera.read().t
        viewer.send(part(jpeg(1))[:200])
        viewer.cut()
        begun = time.monotonic()
        server.viewer().send(part(jpeg(2)))
        t = camera.read(t, PATIENCE_S).t
        assert time.monotonic() - begun < PATIENCE_S / 2
        assert (camera.counts.frames, camera.counts.refused, camera.counts.reconnects) == (2, 1, 1)


def test_a_refused_login_is_not_repeated_at_once(server, monkeypatch):
    monkeypatch.setattr(frame_buffer, "REFUSED_PAUSE_S", 10 * PATIENCE_S)
    with opened(server) as camera:
        t = camera.read().t
        server.pages[VIDEO] = reply("401 Unauthorized", b"", "text/html", BASIC)
        tried = len(server.requests)
        server.viewer().cut()
        until(camera, t, "asks for user and password")
        stale(camera, t, 0.5)
        assert len(server.requests) == tried + 1


def test_bytes_without_pictures_do_not_go_on_for_ever(server, monkeypatch):
    monkeypatch.setattr(axis, "SILENCE_S", SHORT_SILENCE_S)
    with opened(server) as camera:
        t, viewer, end = camera.read().t, server.viewer(), threading.Event()

        def babble():
            with contextlib.suppress(OSError):
                while not end.wait(0.05):
                    viewer.send(bytes(100))

        thread = threading.Thread(target=babble, daemon=True)
        thread.start()
        server.viewer().send(part(jpeg(1)))
        end.set()
        ended(thread)
        camera.read(t, PATIENCE_S)


@pytest.mark.parametrize("whole", [True, False])
def test_damaged_pictures_are_dropped_and_counted(server, whole, capfd):
    """One ends in the middle of its data, with a last marker or without it."""
    picture = jpeg(1)
    damaged = picture[: (picture.index(b"\xff\xda") + len(picture)) // 2].rstrip(b"\xff") + b"\xff\xd9" * whole
    with opened(server) as camera:
        viewer = server.viewer()
        t = camera.read().t
        viewer.send(part(damaged) + b"--myboundary\r\n")
        until(camera, t, "broken")
        assert camera.counts.refused == 1
        viewer.send(part(jpeg(2)))
        assert camera.read(t, PATIENCE_S).t > t
    assert capfd.readouterr() == ("", "")


def test_closing_frees_a_reader_at_once_and_ends_the_thread(server):
    camera = AxisCamera(config(server), MonotonicClock())
    t, said = camera.read().t, queue.Queue()

    def wait():
        try:
            camera.read(t, 10 * PATIENCE_S)
        except DeviceError as error:
            said.put(str(error))

    reader = threading.Thread(target=wait, daemon=True)
    reader.start()
    begun = time.monotonic()
    camera.close()
    assert "closed" in said.get(timeout=PATIENCE_S)
    assert time.monotonic() - begun < axis.SILENCE_S  # it did not wait for the socket
    ended(reader)
    camera.close()
    assert server.viewer().gone()


def test_closing_while_the_server_hangs(server, monkeypatch):
    monkeypatch.setattr(axis, "SILENCE_S", SHORT_SILENCE_S)
    with opened(server) as camera:
        server.pages[VIDEO] = None
        server.viewer().cut()
        until(camera, camera.read().t, "reconnecting")


def test_probe_tells_who_it_is(server):
    probe = AxisCamera.probe
    assert probe(config(server)) == "AXIS 241Q, firmware 4.48, input 1 has video"
    server.pages[STATUS] = reply(body=b"Video 2 = no video\n")
    with pytest.raises(DeviceError, match="no video on input 2"):
        probe(config(server, camera=2))
    assert not [request for request in server.requests if request.path == VIDEO]
    server.pages = {VIDEO: server.pages[VIDEO]}
    assert probe(config(server)) == "does not say what it is, but sends pictures"
    server.pages.clear()
    with pytest.raises(DeviceError, match="404"):
        probe(config(server))


# Against the emulator, which was written by others from the same manuals


@pytest.fixture
def emulated():
    with axis_server() as unit:
        yield unit


def watching(unit):
    return opened(unit, size=FEED_SIZE, resolution="320x240", user=USER, password=PASSWORD)


# Fault of the emulated server, and what reading says of it; None where frames go on as if there were none.
FAULTS = {
    "wrong-length": None,
    "no-length": None,
    "dashed-boundary": None,
    "stall": "has sent nothing for|has stopped sending",
    "cut": "has closed the stream|sent no newer picture|are broken",
    "unauthorized": r"\(401\)",
    "busy": r"\(503\)",
    "frozen": "repeats the same picture",
    "no-video": "its input 1 has no video",
    "refuse": "cannot be reached|broke off|HTTP",
    "corrupt": "are broken",
    "resolution": "160x120",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_named_and_recovered_from(emulated, fault, monkeypatch, capfd):
    monkeypatch.setattr(axis, "FROZEN_S", 0.3)
    monkeypatch.setattr(frame_buffer, "REFUSED_PAUSE_S", 0.3)
    words = FAULTS[fault]
    emulated.faults.set(fault, words is None)
    with watching(emulated) as camera:
        emulated.faults.set(fault)
        t, deadline, said = camera.read().t, time.monotonic() + PATIENCE_S, ""
        while words is not None and not re.search(words, said):
            assert time.monotonic() < deadline, said
            try:
                t = camera.read(t, 0.01 if fault == "corrupt" else 0.2).t
            except DeviceError as error:
                said = str(error)
        assert "\n" not in said
        emulated.faults.set(fault, words is None)
        end = time.monotonic() + PATIENCE_S
        while True:
            with contextlib.suppress(DeviceError):
                t, before = camera.read(t, 0.5).t, t
                break
            assert time.monotonic() < end
        assert t > before
    assert capfd.readouterr().err == ""
