"""The RTSP server: packets by hand against RFC 6184 and RFC 3550, requests by a raw client, and the driver `stream`."""

import contextlib
import re
import socket
import struct
import threading
import time
from email.message import Message

import av
import cv2
import numpy as np
import pytest

from cotarget.drivers import stream as driver
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.stream import StreamCamera, StreamSettings
from cotarget.emulators import rtsp
from cotarget.emulators.authentication import Authenticator
from cotarget.emulators.rtsp import (
    RTSP_FAULTS,
    AccessUnit,
    EncodedStream,
    Encoder,
    RtpSender,
    RtspError,
    RtspServer,
    parse_head,
    payloads,
    split_nals,
)
from cotarget.emulators.serve import Faults
from cotarget.errors import StaleFrameError
from tests.support.emulated_camera import DEADLINE_S, Film
from tests.support.plants import fails, wait_for

wire = pytest.mark.wire
SIZE, RATE_HZ = (320, 240), 25.0
PATIENCE_S = 10.0
KEY = bytes([0x65]) + b"key"
SETS = (bytes([0x67, 0x42, 0xC0, 0x1E]), bytes([0x68, 1]))


def unit(index, is_key=False, size=10):
    slices = (*SETS, KEY) if is_key else (bytes([0x41]) + bytes(size),)
    return AccessUnit(index, index / RATE_HZ, slices)


# Packets


def test_a_small_nal_unit_is_a_payload_and_a_large_one_is_fragmented():
    """RFC 6184, 5.8: the indicator keeps the first three bits with type 28; the header has start, end and type."""
    assert list(payloads(b"\x65abc", 4)) == [b"\x65abc"]
    assert list(payloads(b"\x65abcd", 4)) == [b"\x7c\x85ab", b"\x7c\x45cd"]
    assert list(payloads(b"\x41abcde", 4)) == [b"\x5c\x81ab", b"\x5c\x01cd", b"\x5c\x41e"]


def test_a_byte_stream_is_split_at_its_start_codes():
    assert split_nals(b"\0\0\0\1gab\0\0\1hc\0\0\0\1ed\0\0e") == (b"gab", b"hc", b"ed\0\0e")


def test_packets_of_a_picture_share_a_time_and_the_last_has_the_marker():
    sender = RtpSender()
    first = sender.sequence
    packets = list(sender.packets((b"\x67set", b"\x65" + bytes(1500)), 2.0))
    heads = [struct.unpack("!BBHII", packet[:12]) for packet in packets]
    assert [head[1] for head in heads] == [96, 96, 0x80 | 96]
    assert [head[2] for head in heads] == [(first + i) & 0xFFFF for i in range(3)]
    assert {head[3] for head in heads} == {sender.timestamp(2.0)}
    assert (sender.timestamp(2.5) - sender.timestamp(2.0)) & 0xFFFFFFFF == 45000


def test_a_report_has_the_time_of_day_of_a_time_stamp_and_counts():
    """0 on the Unix clock is 2,208,988,800 s on NTP's; half a second is 2^31."""
    sender = RtpSender()
    packets = list(sender.packets((b"\x41abc", b"\x41de"), 1.0))
    said = sender.report(7.0, 100.5)
    version, kind, length, ssrc, seconds, fraction, stamp, count, octets = struct.unpack("!BBHIIIIII", said[:28])
    assert (version, kind, length) == (0x80, 200, 6)
    assert ssrc == struct.unpack("!I", packets[0][8:12])[0]
    assert (seconds, fraction) == (2_208_988_900, 2**31)
    assert (stamp, count, octets) == (sender.timestamp(7.0), 2, 7)
    assert said[28:30] == b"\x81\xca"
    assert len(said) == 28 + 4 * (1 + int.from_bytes(said[30:32]))


# The newest pictures


def test_a_client_gets_picture_after_picture_and_one_that_is_late_the_newest_key_frame():
    stream = EncodedStream()
    assert stream.after(-1, 0.0) is None
    for index in range(5):
        stream.publish(unit(index, index % 2 == 0))
    assert stream.parameter_sets(0.0) == SETS
    assert stream.after(-1, 0.0).index == 4
    assert [stream.after(index, 0.0).index for index in range(4)] == [1, 2, 3, 4]
    assert stream.after(4, 0.0) is None
    for index in range(5, 100):
        stream.publish(unit(index, index == 90))
    assert stream.after(3, 0.0).index == 90
    for index in range(100, 200):
        stream.publish(unit(index))
    assert stream.after(3, 0.0) is None  # until the next key frame
    assert stream.after(150, 0.0).index == 151


# Requests


@pytest.mark.parametrize(("lines", "status"), [
    ([b"nonsense"], 400), ([b"OPTIONS * HTTP/1.1"], 400), ([b"OPTIONS * RTSP/2.0"], 505),
    ([b"OPTIONS * RTSP/1.0", b"no colon"], 400), ([b"\xff\xfe\x00"], 400),
])  # fmt: skip
def test_what_is_no_request_is_refused(lines, status):
    with pytest.raises(RtspError) as caught:
        parse_head(lines)
    assert caught.value.status == status


def test_digest_authentication_without_a_quality_of_protection():
    """The example of RFC 2069, 2.4, as its erratum has it."""
    nonce = "dcd98b7102dd2f0e8b11d0f600bfb0c093"
    guard = Authenticator("Mufasa", "CircleOfLife", "digest", "testrealm@host.com", nonce, qop=False)
    headers = Message()
    headers["Authorization"] = (
        f'Digest username="Mufasa", realm="testrealm@host.com", nonce="{nonce}", uri="/dir/index.html", '
        'response="1949323746fe6a43ef61f9606e7febea"'
    )
    assert guard.allows("GET", "/dir/index.html", headers)
    assert not guard.allows("SETUP", "/dir/index.html", headers)
    assert guard.challenge == f'WWW-Authenticate: Digest realm="testrealm@host.com", nonce="{nonce}"'


class Client:
    """A client that writes requests as the RFC has them."""

    def __init__(self, server):
        self.server, self.count = server, 0
        self.connection = socket.create_connection((server.host, server.port), DEADLINE_S)
        self.received = self.connection.makefile("rb")

    def ask(self, method, *headers, url=None):
        """Send a request; return status, headers by lower-case name, and body."""
        self.count += 1
        lines = [f"{method} {url or self.server.url} RTSP/1.0", f"CSeq: {self.count}", *headers, "", ""]
        self.connection.sendall("\r\n".join(lines).encode())
        return self.answer()

    def answer(self):
        while (first := self.received.read(1)) == b"$":  # pictures come between answers
            self.packet()
        status = (first + self.received.readline()).decode()
        found = {}
        while line := self.received.readline().decode().strip():
            name, _, value = line.partition(": ")
            found[name.lower()] = value
        return int(status.split()[1]), found, self.received.read(int(found.get("content-length", 0)))

    def packet(self):
        channel, length = struct.unpack("!BH", self.received.read(3))
        return channel, self.received.read(length)

    def set_up(self):
        track = f"{self.server.url}/track1"
        return self.ask("SETUP", "Transport: RTP/AVP/TCP;unicast;interleaved=2-3", url=track)[1]["session"].split(";")[
            0
        ]

    def close(self):
        self.received.close()
        self.connection.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


@pytest.fixture
def served():
    """A server of pictures that are published at once."""
    stream = EncodedStream()
    stream.publish(unit(0, True))
    before = set(threading.enumerate())
    with RtspServer(stream) as server:
        yield server
    assert set(threading.enumerate()) <= before


@wire
def test_a_session_by_the_letter(served):
    with Client(served) as client:
        status, headers, _ = client.ask("OPTIONS")
        assert (status, headers["cseq"]) == (200, "1")
        assert "GET_PARAMETER" in headers["public"].split(", ")
        status, headers, body = client.ask("DESCRIBE", "Accept: application/sdp")
        assert (status, headers["content-type"]) == (200, "application/sdp")
        assert headers["content-base"] == f"{served.url}/"
        assert b"a=rtpmap:96 H264/90000\r\n" in body
        assert b"profile-level-id=42c01e;sprop-parameter-sets=Z0LAHg==,aAE=\r\n" in body
        assert client.ask("PLAY")[0] == 455
        assert client.ask("SETUP", "Transport: RTP/AVP;unicast;client_port=9-10")[0] == 461
        session = client.set_up()
        assert client.ask("PLAY", "Session: other")[0] == 454
        status, headers, _ = client.ask("PLAY", f"Session: {session}")
        assert status == 200
        assert re.search(r"track1;seq=\d+;rtptime=\d+$", headers["rtp-info"])
        served.stream.publish(unit(1))
        assert client.ask("GET_PARAMETER", f"Session: {session}")[0] == 200
        assert client.ask("RECORD", f"Session: {session}")[0] == 501
        assert client.ask("TEARDOWN", f"Session: {session}")[0] == 200
        assert client.ask("PLAY", f"Session: {session}")[0] == 455
        assert client.ask("DESCRIBE", url=served.url.replace("stream1", "other"))[0] == 404


@wire
def test_pictures_and_a_report_come_in_their_channels(served):
    with Client(served) as client:
        session = client.set_up()
        client.ask("PLAY", f"Session: {session}")
        seen = {}
        while len(seen) < 2:
            assert client.received.read(1) == b"$"
            channel, packet = client.packet()
            seen[channel] = packet
    assert seen[2][12:] == KEY
    assert seen[3][1] == 200


GARBAGE = {
    "nothing": b"",
    "half a line": b"DESCRI",
    "nonsense": b"\0\1\2\3" * 100 + b"\r\n\r\n",
    "a long line": b"A" * 20000,
    "many headers": b"OPTIONS * RTSP/1.0\r\n" + b"A: b\r\n" * 1000 + b"\r\n",
    "a body without end": b"OPTIONS * RTSP/1.0\r\nContent-Length: 99999999999\r\n\r\n",
    "no length": b"OPTIONS * RTSP/1.0\r\nContent-Length: x\r\n\r\n",
    "an unfinished packet": b"$\0\xff\xff",
    "a wrong address": b"DESCRIBE rtsp://[ RTSP/1.0\r\n\r\n",
    "another protocol": b"GET / HTTP/1.1\r\n\r\n",
}


@wire
@pytest.mark.parametrize("data", GARBAGE.values(), ids=GARBAGE)
def test_garbage_ends_its_own_connection_only(served, data):
    with Client(served) as other:
        with socket.create_connection((served.host, served.port), DEADLINE_S) as line:
            line.sendall(data)
            line.shutdown(socket.SHUT_WR)
            with contextlib.suppress(ConnectionResetError):
                while answered := line.recv(4096):
                    assert answered.startswith(b"RTSP/1.0 4")
        assert other.ask("OPTIONS")[0] == 200


# With the driver


DRAWN = {}  # when a picture was drawn, by its square's place [s]
SPREAD_S = 0.02  # a busy machine delays what draws


def draw(index):
    """A square that moves on noise, which no two pictures share."""
    image = np.random.default_rng(index).integers(60, 70, (SIZE[1], SIZE[0], 3), np.uint8)
    left = 10 + index % 250
    DRAWN[index % 250] = time.monotonic()
    image[100:140, left : left + 40] = 200
    return image


@contextlib.contextmanager
def filmed(profiles=(), **options):
    faults = Faults(RTSP_FAULTS)
    for name in profiles:
        faults.set(name)
    with (
        Film(draw, 1 / RATE_HZ) as film,
        contextlib.closing(Encoder(film.feed, stream := EncodedStream(), RATE_HZ, faults=faults)),
        RtspServer(stream, faults=faults, **options) as server,
    ):
        yield server


def opened(server, **changes):
    keys = {"url": server.url, "size": SIZE, "rate_hz": RATE_HZ, "latency_s": 0.0} | changes
    return contextlib.closing(StreamCamera(StreamSettings(**keys), MonotonicClock()))


@pytest.fixture(autouse=True)
def tidy(monkeypatch):
    monkeypatch.setattr(driver, "SILENCE_S", 0.5)
    monkeypatch.setenv("COTARGET_PASSWORD", "pass word")


@wire
def test_the_driver_reads_pictures_with_their_times_and_the_time_of_day():
    with filmed(user="viewer", password="pass word") as server, opened(server, user="viewer") as camera:
        frames = [camera.read(timeout=PATIENCE_S)]
        while len(frames) < 30:
            frames.append(camera.read(frames[-1].t, PATIENCE_S))
        wait_for(lambda: "late by the camera's time of day" in camera.describe())
    lefts = [np.argmax(frame.image[120, :, 1] > 130) - 10 for frame in frames[10:]]  # the first pictures have waited
    delays = [frame.t - DRAWN[left] for left, frame in zip(lefts, frames[10:], strict=True)]
    assert np.ptp(delays) < SPREAD_S
    assert frames[0].image[5, 5].mean() == pytest.approx(64.5, abs=6)


@wire
def test_a_wrong_password_is_refused():
    with filmed(user="viewer", password="other") as server, opened_fails(server, user="viewer") as why:
        assert "refuses the user 'viewer'" in why


@contextlib.contextmanager
def opened_fails(server, **changes):
    yield fails(lambda: opened(server, **changes).__enter__())


@wire
@pytest.mark.parametrize(("fault", "said"), [
    ("unauthorized", "refuses the user"), ("not-found", r"no such stream \(404\)"), ("busy", "refuses the stream"),
    ("refuse", "cannot be re"), ("no-key", "no key frame"),
])  # fmt: skip
def test_a_camera_that_brings_no_pictures_is_an_error_of_one_line(fault, said, monkeypatch):
    monkeypatch.setattr(driver, "FIRST_S", 2.0)
    with filmed() as server:
        wait_for(lambda: server.stream.after(-1, 0.0))
        server.faults.set(fault)
        wait_for(lambda: not server.stream.after(-1, 0.0).is_key)
        with opened_fails(server) as why:
            assert re.search(said, why)
            assert len(why.splitlines()) == 1


@wire
@pytest.mark.parametrize(("fault", "said"), [
    ("stall", "has sent nothing|no frame"), ("cut", ""), ("corrupt", "broken"), ("refuse", "cannot be re"),
])  # fmt: skip
def test_a_stream_with_a_fault_is_named_and_comes_back(fault, said, caplog):
    with filmed() as server, opened(server) as camera:
        t = camera.read(timeout=PATIENCE_S).t
        server.faults.set(fault)
        clock = MonotonicClock()
        end, whys = clock.now() + 4.0, []
        while clock.now() < end and not (whys and re.search(said, whys[-1])):
            try:
                t = camera.read(t, 1.0).t
            except StaleFrameError as error:
                whys.append(str(error))
        assert whys
        assert re.search(said, whys[-1])
        server.faults.set(fault, on=False)
        wait_for(lambda: comes(camera, clock.now()))


def comes(camera, t):
    try:
        return camera.read(t, 1.0).t > t
    except StaleFrameError:
        return False


@wire
def test_a_frozen_picture_is_reported(caplog):
    with filmed() as server, opened(server) as camera:
        camera.read(timeout=PATIENCE_S)
        server.faults.set("frozen")
        wait_for(lambda: "has sent the same picture" in caplog.text)
        assert "the same picture" in camera.describe()


@wire
@pytest.mark.parametrize(("fault", "turned"), [("upside-down", np.s_[::-1, ::-1]), ("mirrored", np.s_[:, ::-1])])
def test_a_picture_is_turned_as_on_a_ceiling(fault, turned):
    image = np.zeros((*SIZE[::-1], 3), np.uint8)
    image[:60, :80] = 200
    faults = Faults(RTSP_FAULTS)
    faults.set(fault)
    with (
        Film(lambda index: image, 1 / RATE_HZ) as film,
        contextlib.closing(Encoder(film.feed, stream := EncodedStream(), RATE_HZ, faults=faults)),
        RtspServer(stream) as server,
        opened(server) as camera,
    ):
        assert np.abs(camera.read(timeout=PATIENCE_S).image.astype(float) - image[turned]).mean() < 2.0  # of 200


@wire
def test_long_groups_have_a_key_frame_every_10_s():
    faults = Faults(RTSP_FAULTS)
    faults.set("long-groups")
    with (
        Film(draw, 1 / RATE_HZ) as film,
        contextlib.closing(Encoder(film.feed, stream := EncodedStream(), RATE_HZ, faults=faults)),
    ):
        units = [stream.after(-1, PATIENCE_S)]
        while len(units) < 2 * RATE_HZ:
            units.append(stream.after(units[-1].index, PATIENCE_S))
    assert sum(unit.is_key for unit in units) <= 1


@wire
def test_another_size_is_named():
    with filmed() as server, opened(server) as camera:
        t = camera.read(timeout=PATIENCE_S).t
        server.faults.set("resolution")
        wait_for(lambda: "now sends 160x120 where it sent 320x240" in (fails(lambda: camera.read(t)) or ""))


@wire
def test_a_pulled_cable_is_noticed_and_the_stream_comes_back():
    """The server ends and another one begins at its port."""
    with Film(draw, 1 / RATE_HZ) as film:
        faults, stream = Faults(RTSP_FAULTS), EncodedStream()
        with contextlib.closing(Encoder(film.feed, stream, RATE_HZ, faults=faults)):
            with RtspServer(stream) as server:
                camera = opened(server).__enter__()
                t = camera.read(timeout=PATIENCE_S).t
            with contextlib.closing(camera):
                wait_for(lambda: not comes(camera, t))
                with RtspServer(stream, port=server.port):
                    wait_for(lambda: comes(camera, t))


@wire
def test_a_client_that_reads_nothing_delays_no_other_one_and_is_disconnected(monkeypatch):
    monkeypatch.setattr(rtsp, "SEND_S", 1)
    with filmed() as server, Client(server) as lazy, opened(server) as camera:
        lazy.connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        lazy.ask("PLAY", f"Session: {lazy.set_up()}")
        times = [camera.read(timeout=PATIENCE_S).t]
        while times[-1] < times[0] + 2.0:
            times.append(camera.read(times[-1], PATIENCE_S).t)
        assert np.percentile(np.diff(times), 90) < 2.5 / RATE_HZ


@wire
def test_pictures_with_b_frames_arrive_in_order():
    with filmed(("b-frames",)) as server, opened(server) as camera:
        times = [camera.read(timeout=PATIENCE_S).t]
        while len(times) < 20:
            times.append(camera.read(times[-1], PATIENCE_S).t)
    assert np.median(np.diff(times)) == pytest.approx(1 / RATE_HZ, rel=0.5)


@wire
def test_a_networks_jitter_moves_no_time_of_a_picture():
    """Pictures come up to 0.14 s late, three times their period."""
    with filmed(("jitter",)) as server, opened(server) as camera:
        frames = [camera.read(timeout=PATIENCE_S)]
        while len(frames) < 40:
            frames.append(camera.read(frames[-1].t, PATIENCE_S))
    lefts = [np.argmax(frame.image[120, :, 1] > 130) - 10 for frame in frames[20:]]
    delays = [frame.t - DRAWN[left] for left, frame in zip(lefts, frames[20:], strict=True)]
    assert np.std(delays) < SPREAD_S


@wire
def test_a_stream_that_ends_again_and_again_goes_on(monkeypatch):
    monkeypatch.setattr(rtsp, "SHORT_SESSION_S", 0.5)
    with filmed(("sessions-end",)) as server, opened(server) as camera:
        begin = camera.read(timeout=PATIENCE_S).t
        for passed in (1.5, 3.0):
            wait_for(lambda passed=passed: comes(camera, begin + passed))


@wire
def test_a_picture_out_of_focus_has_no_edges():
    with filmed() as server, opened(server) as camera:
        sharp = camera.read(timeout=PATIENCE_S)
        server.faults.set("blurred")
        frame = camera.read(sharp.t + 1.0, PATIENCE_S)
    steepest = [np.abs(np.diff(each.image[120, :, 1].astype(int))).max() for each in (sharp, frame)]
    assert steepest[1] < steepest[0] / 4


@wire
def test_the_age_of_the_newest_frame_is_that_of_the_network():
    """Packets encoded beforehand; a parser gives a picture when the next begins."""
    context = av.CodecContext.create("libx264", "w")
    context.width, context.height, context.pix_fmt = *SIZE, "yuv420p"
    context.options = {"preset": "ultrafast", "tune": "zerolatency", "g": "25"}
    nals = []
    for index in range(100):
        frame = av.VideoFrame.from_ndarray(cv2.resize(draw(index), SIZE), format="bgr24").reformat(format="yuv420p")
        nals += [split_nals(bytes(packet)) for packet in context.encode(frame)]
    stream, end, published = EncodedStream(), threading.Event(), []

    def publish():
        begin = time.monotonic()
        for index in range(10**6):
            if end.wait(max(begin + index / RATE_HZ - time.monotonic(), 0.0)):
                return
            published.append(time.monotonic())
            stream.publish(AccessUnit(index, begin + index / RATE_HZ, nals[index % 100]))

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        with RtspServer(stream) as server, opened(server) as camera:
            clock, ages, t = MonotonicClock(), [], camera.read(timeout=PATIENCE_S).t
            while len(ages) < 15:
                clock.sleep_until(clock.now() + 0.2)  # a slow consumer
                frame, now = camera.read(t), time.monotonic()
                t, count = frame.t, int(np.argmax(frame.image[120, :, 1] > 130)) - 10
                shown = max(i for i in range(len(published)) if i % 100 == count)
                ages.append(now - published[shown])
        assert np.median(ages) < 2 / RATE_HZ + 0.025
    finally:
        end.set()
        thread.join()
