"""The driver of streams that FFmpeg reads: in simulated time on packets that are encoded here, and over loopback."""

import contextlib
import itertools
import logging
import threading

import av
import cv2
import numpy as np
import pytest

from cotarget.backends import load_config
from cotarget.config import config_table
from cotarget.drivers import stream
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.frame_buffer import FrameBuffer, LoginError, StreamRefusedError
from cotarget.drivers.rig import device_of
from cotarget.drivers.stream import StreamCamera, StreamClock, StreamReader, StreamSettings
from cotarget.errors import ConfigError, DeviceError, StaleFrameError
from tests.support.http_server import HttpServer
from tests.support.plants import wait_for
from tests.support.rtsp_server import PASSWORD, USER, Feed, RtspServer
from tests.support.simulated_clock import SimClock

SIZE, LATENCY_S, RATE_HZ = (320, 240), 0.1, 25.0
PATIENCE_S = 10.0  # for what should come at once, on a machine that has much else to do
DELAY_S, JITTER_S = 0.2, 0.05  # of a simulated network
SETTLED_S = 5.0  # after it, the smallest delay seen is nearly the line's own
JITTER_LEFT_S = 0.005  # rms, of mapped times: a tenth of the network's
DECODED = 20  # largest mean difference of a decoded picture, coarsely coded [grey levels]


def draw(index, size=SIZE):
    """A bar that is one pixel further right in each picture."""
    image = np.full((size[1], size[0], 3), 60, np.uint8)
    image[:, 10 + index % 250 : 30 + index % 250] = (40, 200, 90)
    return image


# The stream's clock


def mapped(delays, owns=None, waited=True):
    """Times that pictures get which arrive with these delays; less their own times."""
    times = StreamClock()
    owns = np.arange(len(delays)) / RATE_HZ if owns is None else owns
    return times, np.array(
        [times.map(own, own + delay, waited) for own, delay in zip(owns, delays, strict=True)]
    ) - owns


@pytest.mark.parametrize("shape", ["standard_normal", "standard_exponential"])
def test_the_networks_jitter_does_not_move_a_frames_time(shape):
    """A packet that need not queue has the line's own delay, and none is faster."""
    delays = DELAY_S + JITTER_S * np.abs(getattr(np.random.default_rng(0), shape)(3000))
    owns = np.arange(len(delays)) / RATE_HZ
    delays = np.maximum.accumulate(owns + delays) - owns  # in one connection nothing overtakes
    _, offsets = mapped(delays)
    settled = offsets[round(SETTLED_S * RATE_HZ) :]
    assert np.std(delays) > JITTER_S / 2
    assert np.std(settled) < JITTER_LEFT_S


def test_clocks_that_run_apart_are_followed():
    """A camera's crystal that is 50 ppm slow is 180 ms off after an hour."""
    owns = np.arange(90_000) / RATE_HZ
    _, offsets = mapped(DELAY_S + 50e-6 * owns, owns)
    np.testing.assert_allclose(offsets, DELAY_S + 50e-6 * owns, atol=1e-6)


JUMP_S = 10.0


def test_a_jump_of_the_streams_clock_restarts_the_mapping():
    owns = np.arange(100) / RATE_HZ
    arrivals = owns + DELAY_S
    for jump_s in (JUMP_S, -JUMP_S, -0.1):
        jumped = owns + np.where(np.arange(100) < 50, 0.0, jump_s)
        _, offsets = mapped(arrivals - jumped, jumped)
        np.testing.assert_allclose(jumped + offsets, arrivals, atol=1e-3)


def test_a_clock_that_jumped_while_nothing_came_is_noticed_after_seconds():
    """The stream stands for ten seconds, and its clock with it."""
    owns = np.arange(300) / RATE_HZ
    times, offsets = mapped(np.where(owns < 4, DELAY_S, DELAY_S + JUMP_S), owns)
    assert times.jumps == 1
    assert offsets[-1] == pytest.approx(DELAY_S + JUMP_S)


def test_a_backlog_of_this_machine_is_no_jump():
    """A program that was suspended reads old pictures, and must not take them for new ones."""
    owns = np.arange(300) / RATE_HZ
    times, offsets = mapped(np.where(owns < 4, DELAY_S, DELAY_S + JUMP_S), owns, waited=False)
    assert times.jumps == 0
    assert offsets[-1] == pytest.approx(DELAY_S, abs=2e-3)


# The reader


class Bench:
    """A reader of packets that are encoded here, in simulated time."""

    def __init__(self, feed=None, codec="h264", has_times=True):
        self.clock = SimClock()
        self.frames = FrameBuffer("the camera", self.clock, SIZE, LATENCY_S, 2.0)
        self.frames.decode = stream.to_bgr
        self.frames.opened()
        self.reader = StreamReader(self.frames, av.CodecContext.create(codec, "r"), self.clock, has_times)
        self.packets = (feed or Feed(draw)).packets()
        self.begin = self.clock.t

    def send(self, count=1, change=lambda packet: packet, **more):
        """Give the reader the next packets, each a frame period after the one before."""
        for index, packet in itertools.islice(self.packets, count):
            self.clock.t = self.begin + index / RATE_HZ + DELAY_S
            changed = change(packet)
            if changed is not None:
                self.reader.take(changed, self.clock.t, **more)

    def why(self):
        with pytest.raises(StaleFrameError) as error:
            self.frames.read(np.inf, 0.0)
        return str(error.value)


@pytest.mark.parametrize(("codec", "name"), [("H264", "h264"), ("H265", "hevc"), ("JPEG", "mjpeg")])
def test_the_newest_picture_is_read_with_its_mapped_time(codec, name):
    bench = Bench(Feed(draw, codec=codec), name)
    bench.send(8)
    frame = bench.frames.read()
    assert frame.image.shape == (240, 320, 3)
    assert np.abs(frame.image.astype(int) - draw(7)).mean() < DECODED
    assert frame.t == pytest.approx(bench.clock.t - LATENCY_S)
    assert (bench.frames.counts.frames, bench.frames.counts.skipped) == (8, 7)


def test_a_stream_begins_at_a_key_frame_and_says_what_to_change(caplog):
    bench = Bench(Feed(draw, group=100))
    bench.send(1, lambda packet: None)  # joined within a group of pictures
    bench.send(99)
    assert "no key frame for 4.2 s" in bench.why()
    assert "key frame interval" in bench.why()
    bench.send(1)
    assert bench.frames.read().image.shape == (240, 320, 3)
    assert ["has sent no key frame for 4.2 s" in line for line in caplog.messages] == [True]


def cut(packet):
    """A packet of which the end is missing."""
    short = av.Packet(bytes(packet)[: packet.size // 2])
    short.pts, short.dts, short.time_base, short.is_keyframe = (
        packet.pts,
        packet.dts,
        packet.time_base,
        packet.is_keyframe,
    )
    return short


def test_no_picture_after_a_broken_one_is_shown_before_the_next_key_frame():
    bench = Bench(Feed(lambda index: cv2.randu(np.empty((240, 320, 3), np.uint8), 0, 255), group=10))
    bench.send(3)
    t = bench.frames.read().t
    bench.send(1, cut)
    assert bench.frames.counts.refused == 1
    bench.send(6)
    assert bench.frames.read().t == t
    assert "broken" in bench.why()
    bench.send(1)
    assert bench.frames.read(t).t == pytest.approx(t + 8 / RATE_HZ)


def test_a_stream_whose_time_stands_is_frozen():
    bench = Bench()

    def stopped(packet):
        packet.pts = packet.dts = 0
        return packet

    bench.send(20, stopped)
    assert (bench.frames.counts.frames, bench.frames.counts.repeated) == (1, 19)
    assert "repeats the same picture" in bench.why()


def test_bytes_that_repeat_without_a_clock_are_a_frozen_picture():
    bench = Bench(Feed(lambda index: draw(min(index, 2)), codec="JPEG"), "mjpeg", has_times=False)
    bench.send(40)
    assert bench.frames.counts.repeated > 10  # after its first pictures, the encoder repeats itself
    assert "repeats the same picture" in bench.why()


SCENE = cv2.resize(np.random.default_rng(1).integers(0, 255, (12, 16, 3), dtype=np.uint8), SIZE).astype(float)
QUIET = 0.5  # noise of a quiet scene [grey levels]
NOISE = np.random.default_rng(2).normal(0.0, QUIET, SCENE.size)


def noisy(index):
    noise = np.roll(NOISE, 7919 * index).reshape(SCENE.shape)
    return np.clip(SCENE + noise, 0, 255).round().astype(np.uint8)


@pytest.mark.parametrize(("scene", "warned"), [(noisy, 0), (lambda index: SCENE.astype(np.uint8), 1)])
@pytest.mark.parametrize(("codec", "name"), [("H264", "h264"), ("JPEG", "mjpeg")])
def test_a_frozen_picture_is_reported_and_a_quiet_one_is_not(caplog, scene, warned, codec, name):
    bench = Bench(Feed(scene, codec=codec, group=15), name)
    bench.send(200)
    assert len(caplog.messages) == warned
    assert ("the same picture for" in bench.reader.describe()) == bool(warned)
    assert bench.frames.counts.frames == 200  # none is held back


def test_pictures_in_another_order_keep_their_times():
    bench = Bench(Feed(draw, b_frames=2, group=12))
    times = []
    for _ in range(40):
        bench.send(1)
        with contextlib.suppress(StaleFrameError):
            times.append(bench.frames.read(times[-1] if times else None, 0.0).t)
    steps = np.diff(times[5:])
    assert len(steps) > 20
    np.testing.assert_allclose(steps * RATE_HZ, np.round(steps * RATE_HZ), atol=0.01)


BACKLOG_S = 3.0


def test_a_machine_that_decodes_too_slowly_skips_to_the_next_key_frame():
    bench = Bench(Feed(draw, group=10))
    bench.send(5)
    bench.begin += BACKLOG_S  # from here on
    bench.send(1, waited=False)
    t = bench.frames.read().t
    assert bench.clock.t - t == pytest.approx(BACKLOG_S + LATENCY_S, abs=0.01)  # its time tells how old it is
    bench.send(4, waited=False)
    assert bench.frames.read().t == t
    assert "this machine skips pictures of the camera" in bench.why()


def test_a_stream_is_described_in_one_line():
    bench = Bench(Feed(draw, group=10))
    bench.send(31)
    assert bench.reader.groups == 3
    said = bench.reader.describe()
    for part in (
        "320x240 h264",
        "25.0 frames a second",
        "a key frame every 10 frames (0.4 s)",
        "unknown delay",
        "0 ms",
    ):
        assert part in said


# Settings

# An address, and what its refusal says.
WRONG = {
    "rtsp://admin:hunter2@192.0.2.1/s": "COTARGET_PASSWORD",
    "rtsp://admin@192.0.2.1/s": "COTARGET_PASSWORD",
    "udp://192.0.2.1:5000": "'udp://' is not like rtsp://",
    "concat:a.ts|b.ts://": "is not like rtsp://",
    "rtsp://": "is not like rtsp://",
    "rtsp://192.0.2.1:99999/s": "is not like rtsp://",
}


@pytest.mark.parametrize("url", WRONG)
def test_a_wrong_address_is_refused_without_its_password(url):
    with pytest.raises(ConfigError) as error:
        device_of("fixed", {"driver": "stream", "url": url})
    assert str(error.value).startswith("hardware.fixed.url: ")
    assert WRONG[url] in str(error.value)
    assert "hunter2" not in str(error.value)


def test_a_recording_has_no_password(tmp_path):
    path = tmp_path / "rig.toml"
    table = 'backend = "hardware"\n[hardware.fixed]\ndriver = "stream"\npassword = "hunter2"\n'
    path.write_text(f'{table}url = "http://192.0.2.1/mjpg?usr=a&pwd=hunter2&camera=1"\n')
    text = str(config_table(load_config(path)))
    assert "hunter2" not in text
    assert "camera=1" in text


# On the wire

wire = pytest.mark.wire


def settings(url, **changes):
    return StreamSettings(**{"url": url, "size": SIZE, "latency_s": LATENCY_S} | changes)


@contextlib.contextmanager
def opened(url, **changes):
    with contextlib.closing(StreamCamera(settings(url, **changes), MonotonicClock())) as camera:
        yield camera


def refused(url, kind=DeviceError, **changes):
    """What the driver says when it cannot be opened."""
    with pytest.raises(kind) as error, opened(url, **changes):
        pass
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.fixture(autouse=True)
def tidy(monkeypatch):
    """No test leaves a thread, finds a password, or reaches its server if the driver used the environment's proxy."""
    for name in ("COTARGET_PASSWORD", "no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:1")
    yield
    assert not [thread for thread in threading.enumerate() if thread.name == "stream"]


@wire
@pytest.mark.parametrize("codec", ["H264", "H265", "JPEG"])
def test_rtsp_brings_pictures_whose_times_are_evenly_spaced(codec):
    random = np.random.default_rng(0)
    late = np.abs(random.normal(0.0, JITTER_S, 1000))
    with RtspServer(Feed(draw, codec=codec, late=lambda index: late[index])) as server, opened(server.url) as camera:
        times = [camera.read(timeout=PATIENCE_S).t]
        while len(times) < 50:
            times.append(camera.read(times[-1], PATIENCE_S).t)
    steps = RATE_HZ * np.diff(times[25:])
    assert np.abs(steps - np.round(steps)).max() < 0.25
    assert [method for method, *_ in server.requests].count("SETUP") == 1  # not of the sound


@wire
def test_a_password_comes_from_the_environment(monkeypatch, caplog):
    caplog.set_level(logging.DEBUG)
    monkeypatch.setenv("COTARGET_PASSWORD", PASSWORD)
    with RtspServer(Feed(draw, login=True)) as camera, HttpServer() as server:
        for url in (camera.url, server.url("login")):
            with opened(url, user=USER) as opened_camera:
                assert opened_camera.read(timeout=PATIENCE_S).image.shape == (240, 320, 3)
    assert "hunter2" not in caplog.text


@wire
def test_pictures_come_by_udp_where_that_is_wanted():
    with RtspServer(Feed(draw)) as server, opened(server.url, transport="udp") as camera:
        t = camera.read().t
        assert camera.read(t, PATIENCE_S).image.shape == (240, 320, 3)
    assert ["client_port" in headers["transport"] for method, _, headers in server.requests if method == "SETUP"] == [1]


@wire
def test_a_wrong_password_is_an_error_that_does_not_show_it(caplog):
    caplog.set_level(logging.DEBUG)
    with RtspServer(Feed(draw, login=True)) as server:
        for given, remedy in (
            ({}, "set user and the password"),
            ({"user": USER}, "set the password"),
            ({"user": USER, "password": "hunter1"}, "check the password"),
        ):
            said = refused(server.url, LoginError, **given)
            assert f"{remedy}, which may be in the environment variable COTARGET_PASSWORD" in said
            assert "hunter" not in said + caplog.text


# What an RTSP camera answers, by method, and what the error says.
ANSWERS = {
    "elsewhere": ({"DESCRIBE": ("302 Moved", ["Location: rtsp://a:b@192.0.2.9/x"])}, "sends on to 192.0.2.9:"),
    "no such stream": ({"DESCRIBE": ("404 Not Found", [])}, "404"),
    "forbidden": ({"SETUP": ("403 Forbidden", [])}, "refuses the user"),
    "another transport": ({"SETUP": ("461 Unsupported Transport", [])}, "check url, transport"),
    "busy": ({"PLAY": ("503 Service Unavailable", [])}, "viewers"),
}


@wire
@pytest.mark.parametrize("name", ANSWERS)
def test_a_refusal_of_a_camera_is_an_error_of_one_line(name, monkeypatch):
    monkeypatch.setattr(stream, "FIRST_S", 0.5)
    answers, said = ANSWERS[name]
    with RtspServer(Feed(draw, answers=answers)) as server:
        assert said in refused(server.url)


@wire
def test_an_address_where_nobody_answers_is_an_error_of_one_line():
    assert "cannot be reached" in refused("rtsp://127.0.0.1:1/s")
    assert "cannot be reached" in refused("rtsp://camera.invalid/s")
    assert "Connection refused" in refused("http://127.0.0.1:1/s")
    assert "No such file" in refused("no_film.mp4")


@wire
def test_a_probe_looks_until_it_has_seen_the_groups_of_pictures(monkeypatch):
    monkeypatch.setattr(stream, "PROBE_S", 0.2)
    with RtspServer(Feed(draw)) as server:
        said = device_of("fixed", {"driver": "stream", "url": server.url, "size": [320, 240]}).probe()
    for part in ("320x240 h264", "frames a second", "a key frame every 10 frames", "late by the camera's time of day"):
        assert part in said


@wire
def test_a_camera_that_sends_no_key_frame_is_named(monkeypatch):
    monkeypatch.setattr(stream, "OPEN_S", 0.5)
    monkeypatch.setattr(stream, "FIRST_S", 2.0)
    with RtspServer(Feed(draw, skip=1, group=1000)) as server:
        said = refused(server.url)
    assert "has sent no key frame for" in said
    assert "key frame interval" in said


@wire
def test_another_size_is_named():
    with RtspServer(Feed(draw)) as server:
        assert "write size = [320, 240]" in refused(server.url, ConfigError, size=(640, 480))


@wire
def test_a_stream_that_ends_or_breaks_off_is_opened_again():
    with RtspServer(Feed(draw, end=30)) as server, opened(server.url) as camera:
        t = camera.read().t
        wait_for(lambda: camera.counts.reconnects)
        t = camera.read(t, PATIENCE_S).t
        server.cut()
        wait_for(lambda: camera.counts.reconnects > 1)
        assert camera.read(t, PATIENCE_S).t > t


@wire
def test_a_camera_that_falls_silent_is_named(monkeypatch):
    monkeypatch.setattr(stream, "SILENCE_S", 0.4)
    with RtspServer(Feed(draw, silent=20)) as server, opened(server.url) as camera:
        wait_for(lambda: camera.counts.frames == 19)  # a parser gives a picture when the next begins
        server.feed = Feed(draw, silent=0)
        t = camera.read().t
        with pytest.raises(StaleFrameError, match="has sent nothing"):
            camera.read(t, 0.9)


@wire
def test_the_age_of_the_newest_frame_is_that_of_the_network(monkeypatch):
    """A parser gives a picture when the next begins."""
    with RtspServer(Feed(draw)) as server, opened(server.url, latency_s=0.0) as camera:
        clock, ages = MonotonicClock(), []
        t = camera.read().t
        while len(ages) < 10:
            clock.sleep_until(clock.now() + 0.2)  # a slow consumer
            frame = camera.read(t)
            t = frame.t
            left = np.argmax(frame.image[120, :, 1] > 130) - 10
            ages.append(clock.now() - server.sent[int(left) + 250 * (max(server.sent) // 250)])
        assert np.median(ages) < 2 / RATE_HZ + 0.025


@wire
@pytest.mark.parametrize("page", ["mjpeg", "mpegts"])
def test_http_brings_pictures(page):
    with HttpServer() as server, opened(server.url(page)) as camera:
        t = camera.read().t
        for _ in range(5):
            frame = camera.read(t, PATIENCE_S)
            assert frame.image.shape == (240, 320, 3)
            t = frame.t
        assert ("no times of its own" in camera.describe()) == (page == "mjpeg")
    assert server.asked[-1]["User-Agent"] == "cotarget"


# What an HTTP server answers, and what the error says.
PAGES = {
    "login": "refuses the user",
    "403": "refuses the user",
    "404": "404",
    "503": "busy",
    "redirect": "a redirection",
    "m3u8": "playlist",
    "ffconcat": "playlist",
    "sdp": "playlist",
    "html": "a page",
    "endless": "a page",
}


@wire
@pytest.mark.parametrize("page", PAGES)
def test_what_is_no_stream_is_an_error_of_one_line(page, monkeypatch):
    monkeypatch.setattr(stream, "FIRST_S", 0.5)
    with HttpServer() as server:
        assert PAGES[page] in refused(server.url(page))
        assert not server.visited  # nothing that an answer names is opened


@wire
@pytest.mark.parametrize("kind", ["m3u8", "ffconcat"])
def test_a_playlist_in_a_file_is_refused(tmp_path, kind):
    path = tmp_path / f"film.{kind}"
    path.write_bytes(HttpServer.LISTS[kind])
    assert "playlist" in refused(str(path), StreamRefusedError)


@wire
def test_a_film_is_played_in_real_time_and_begins_again(tmp_path):
    path = tmp_path / "film.mp4"
    with av.open(str(path), "w") as film:
        track = film.add_stream("libx264", rate=25)
        track.width, track.height = SIZE
        for index in range(30):
            film.mux(track.encode(av.VideoFrame.from_ndarray(draw(index), format="bgr24")))
        film.mux(track.encode(None))
    with opened(str(path)) as camera:
        times = [camera.read(None, PATIENCE_S).t]
        while len(times) < 45:
            times.append(camera.read(times[-1], PATIENCE_S).t)
        assert camera.counts.reconnects == 1
    assert 44 / RATE_HZ < times[-1] - times[0] < 44 / RATE_HZ + PATIENCE_S
