"""The newest frame, handed from a camera's thread to its callers; mostly in simulated time."""

import math
import threading

import cv2
import numpy as np
import pytest

from cotarget.drivers import frame_buffer
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.frame_buffer import BusyError, FrameBuffer, StreamRefusedError
from cotarget.errors import DeviceError, StaleFrameError
from tests.support.simulated_clock import SimClock

SIZE, LATENCY_S, FRESH_S = (32, 24), 0.1, 0.5
PATIENCE_S = 10.0  # for what should happen at once


def image(grey, size=SIZE):
    return np.full((size[1], size[0], 3), grey, np.uint8)


def jpeg(grey, size=SIZE):
    return cv2.imencode(".jpg", image(grey, size))[1].tobytes()


class Bench:
    def __init__(self, clock=None, fresh_s=FRESH_S):
        self.clock = clock or SimClock()
        self.frames = FrameBuffer("the camera", self.clock, SIZE, LATENCY_S, fresh_s)

    def put(self, data, later=0.04, **more):
        self.clock.t += later
        return self.frames.put(data, self.clock.t, **more)

    def read(self, newer_than=None):
        return self.frames.read(newer_than, 0.0)

    def why(self, newer_than=math.inf):
        with pytest.raises(StaleFrameError) as error:
            self.read(newer_than)
        return str(error.value)


@pytest.fixture
def bench():
    return Bench()


@pytest.mark.parametrize("encode", [image, jpeg])
def test_the_newest_frame_is_read_with_the_time_of_its_exposure(bench, encode):
    for grey in (10, 20, 30):
        assert bench.put(encode(grey))
    frame = bench.read()
    np.testing.assert_array_equal(frame.image, image(30))
    assert frame.t == pytest.approx(bench.clock.t - LATENCY_S)
    assert bench.read().t == frame.t
    assert "no newer picture" in bench.why(frame.t)
    assert (bench.frames.counts.frames, bench.frames.counts.skipped) == (3, 2)


def test_a_frames_number_counts_all_that_came(bench):
    """One that is read, one that nobody reads, and four that are refused; a repeated one is not counted again."""
    bench.put(jpeg(10))
    assert bench.read().number == 1
    bench.put(jpeg(20))
    bench.put(jpeg(20))
    bench.frames.refuse(2)
    bench.put(jpeg(30), took=2 * FRESH_S)
    bench.put(b"no JPEG")
    assert "broken" in bench.why(None)
    bench.put(jpeg(40))
    assert bench.read().number == 7


@pytest.mark.parametrize(
    ("encode", "own", "again"),
    [(jpeg, {}, {}), (image, {"t": 99.5}, {"t": 99.5}), (jpeg, {"serial": 7, "t": 99.5}, {"serial": 7, "t": 99.6})],
)
def test_a_repeated_frame_is_no_new_one(bench, encode, own, again):
    bench.put(encode(10), **own)
    t = bench.read().t
    for _ in range(20):
        assert not bench.put(encode(10), **again)
    assert bench.frames.counts.repeated == 20
    assert bench.frames.frozen_s == pytest.approx(20 * 0.04)
    assert "repeats the same picture" in bench.why(t)
    bench.put(encode(11))
    assert bench.read(t).t > t
    assert bench.frames.frozen_s == 0.0


@pytest.mark.parametrize(
    ("encode", "own"),
    [
        (image, lambda i: {}),
        (image, lambda i: {"t": 99 + i / 15}),
        (jpeg, lambda i: {"t": 99 + i / 15}),
        (jpeg, lambda i: {"serial": i}),
    ],
)
def test_a_picture_that_a_live_stream_repeats_is_a_new_frame(bench, encode, own):
    """A video codec repeats the picture of a quiet scene to the last bit."""
    t = -math.inf
    for i in range(20):
        assert bench.put(encode(10), **own(i))
        expected = own(i).get("t", bench.clock.t - LATENCY_S)
        t = bench.read(t).t
        assert t == expected
    assert bench.frames.counts.repeated == bench.frames.frozen_s == 0


def test_an_old_frame_is_none():
    bench = Bench(fresh_s=0.3)
    bench.put(image(10))
    bench.clock.t += 0.29
    bench.read()
    bench.clock.t += 0.02
    assert "nothing for 0.3 s" in bench.why(None)


# What happens after a frame, the reason why no newer one can be read, and how many frames are refused for that.
REASONS = {
    "damaged": (lambda bench: bench.put(jpeg(20)[:-20]), "broken", 1),
    "cut short": (lambda bench: bench.frames.refuse(2), "broken", 2),
    "late": (lambda bench: bench.put(image(20), took=2 * FRESH_S), "take 1 s to come", 1),
    "late, and again in time": (
        lambda bench: (bench.put(jpeg(20), took=2 * FRESH_S), bench.put(jpeg(20))),
        "take 1 s to come",
        1,
    ),
    "remarked": (lambda bench: bench.frames.remark("its input has no video"), "its input has no video", 0),
    "lost": (lambda bench: bench.frames.lose(DeviceError("its cable is unplugged")), "unplugged; reconnecting", 0),
    "nothing": (lambda bench: None, "no newer picture", 0),
}


@pytest.mark.parametrize("name", REASONS)
def test_reading_says_why_no_newer_frame_comes_until_the_next_one(bench, name):
    act, reason, refused = REASONS[name]
    bench.frames.opened()
    bench.put(image(10))
    t = bench.read().t
    act(bench)
    assert reason in bench.why(t)
    assert bench.frames.counts.refused == refused
    bench.put(jpeg(30))
    np.testing.assert_array_equal(bench.read(t).image, image(30))
    assert "no newer picture" in bench.why()
    bench.frames.opened()
    assert bench.frames.counts.reconnects == 1


def test_an_error_names_silence_and_remark(bench):
    bench.put(image(10))
    bench.frames.remark("its input has no video")
    bench.clock.t += 0.3
    said = bench.why()
    assert "nothing for 0.3 s" in said
    assert said.endswith("; its input has no video")
    bench.frames.heard()
    assert "nothing" not in bench.why()


def test_another_size_is_an_error_until_it_is_set_back(bench):
    bench.put(image(10, (64, 48)))
    for _ in range(2):
        with pytest.raises(DeviceError, match="64x48 where it sent 32x24"):
            bench.read()
    bench.put(image(10))
    assert bench.read().image.shape == (24, 32, 3)


def test_the_first_frame_is_waited_for(bench):
    with pytest.raises(DeviceError, match="no whole picture"):
        bench.frames.first(0.0)
    bench.put(jpeg(10)[:-20])
    with pytest.raises(DeviceError, match="broken"):
        bench.frames.first(0.0)
    bench.put(jpeg(10, (64, 48)))
    assert bench.frames.first(0.0) == (64, 48)  # its owner says what to write


# On a thread.
def test_a_stream_is_opened_again_until_the_buffer_is_closed(monkeypatch):
    monkeypatch.setattr(frame_buffer, "LONGEST_PAUSE_S", 0.01)
    frames, tries, after = FrameBuffer("the camera", MonotonicClock(), SIZE, 0.0, PATIENCE_S), [], threading.Event()

    def stream():
        tries.append(0)
        if len(tries) < 3:
            raise BusyError("it is busy")
        frames.opened()
        frames.put(image(len(tries)), MonotonicClock().now())
        if len(tries) > 5:
            raise DeviceError("it is unplugged")

    frames.start(lambda: frames.keep_open(stream, after.set), "camera")
    assert frames.first(PATIENCE_S) == SIZE
    t = frames.read(timeout=PATIENCE_S).t
    for _ in range(4):
        t = frames.read(t, PATIENCE_S).t
    assert after.wait(PATIENCE_S)
    frames.close()
    assert frames.join()
    assert frames.counts.reconnects >= 4
    with pytest.raises(DeviceError, match="the camera is closed"):
        frames.read()


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (StreamRefusedError("there is no such stream"), "there is no such stream"),
        (DeviceError("it is unplugged"), "it is unplugged"),
        (ValueError("a mistake"), r"the driver of the camera failed: ValueError\('a mistake'\) \(.*\.py:\d+\)$"),
    ],
)
def test_a_stream_that_cannot_be_opened_is_an_error_at_once(error, said):
    frames = FrameBuffer("the camera", MonotonicClock(), SIZE, 0.0, PATIENCE_S)

    def stream():
        raise error

    frames.start(lambda: frames.keep_open(stream), "camera")
    with pytest.raises(DeviceError, match=said):
        frames.first(PATIENCE_S)
    frames.close()
    assert frames.join()
