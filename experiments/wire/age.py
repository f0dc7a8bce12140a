"""Age of the newest frame at a slow consumer, from the first byte sent: an Axis stream of JPEGs, and H.264 by RTSP."""

import contextlib
import itertools
import multiprocessing
import sys
import time
from collections.abc import Callable
from fractions import Fraction
from multiprocessing.connection import Connection
from typing import Any

import av
import cv2
import numpy as np

from cotarget.drivers.axis import AxisCamera, AxisSettings
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.stream import StreamCamera, StreamSettings
from cotarget.emulators.axis_241q import AxisServer
from cotarget.emulators.plant import Feed, Picture
from cotarget.emulators.rtsp import TICKS_HZ, AccessUnit, EncodedStream, RtspServer, split_nals
from cotarget.rig import Image
from experiments.engine import Row
from experiments.wire.rig import beside, load

SIZE, LARGE = (704, 576), (1920, 1080)  # of the Axis stream, 4CIF, and of H.264 [px]
GROUP, CRF = 32, 23  # H.264: pictures from key frame to key frame, and quality
STREAM_HZ, CONSUMER_HZ = 25.0, 5.0
JITTER_S = 0.04  # random delay of a read, one period of the stream, so that reads fall anywhere between two frames
COARSE = (44, 36)  # size of the noise pattern before it is enlarged [px]
BITS = 8  # bits of a picture's number, as black and white squares along its upper edge
SQUARE = 32  # [px]
PICTURES = 2**BITS
LEAST = 0.05  # least pause before a read, so that the consumer has slept [s]


def serve(pipe: Connection, sent: Any) -> None:
    """Stream prepared pictures from another process; ``sent`` gets the time of the latest sending of each number."""
    sys.setswitchinterval(5e-4)  # as in `cotarget emulate`
    feed, images = Feed(), [picture(number, SIZE) for number in range(PICTURES)]

    def note(index: int, t: float) -> None:
        sent[index % PICTURES] = t

    feed.publish(Picture(images[0], 0, time.monotonic()))
    with AxisServer({1: feed}, sent=note) as server:
        pipe.send(server.url)
        begun = time.monotonic()
        for index in itertools.count(1):
            if pipe.poll(max(begun + index / STREAM_HZ - time.monotonic(), 0.0)):
                return
            feed.publish(Picture(images[index % PICTURES], index, time.monotonic()))


def serve_h264(pipe: Connection, sent: Any) -> None:
    """Stream pictures that were encoded beforehand, as `serve` does."""
    sys.setswitchinterval(5e-4)
    stream, units = EncodedStream(), encoded()

    def note(index: int, t: float) -> None:
        sent[index % PICTURES] = t

    stream.publish(AccessUnit(0, time.monotonic(), units[0]))
    with RtspServer(stream, sent=note) as server:
        pipe.send(server.url)
        begun = time.monotonic()
        for index in itertools.count(1):
            if pipe.poll(max(begun + index / STREAM_HZ - time.monotonic(), 0.0)):
                return
            stream.publish(AccessUnit(index, time.monotonic(), units[index % PICTURES]))


def encoded() -> list[tuple[bytes, ...]]:
    """Encode all pictures as H.264; give the NAL units of each."""
    context = av.CodecContext.create("libx264", "w")
    context.width, context.height, context.pix_fmt = *LARGE, "yuv420p"
    context.time_base, context.gop_size, context.thread_count = Fraction(1, TICKS_HZ), GROUP, 1
    context.options = {"preset": "ultrafast", "tune": "zerolatency", "crf": f"{CRF}"}
    units = []
    for number in range(PICTURES):
        frame = av.VideoFrame.from_ndarray(picture(number, LARGE), format="bgr24").reformat(format="yuv420p")
        frame.time_base, frame.pts = context.time_base, round(number / STREAM_HZ * TICKS_HZ)
        units += [split_nals(bytes(packet)) for packet in context.encode(frame)]
    return units


def picture(number: int, size: tuple[int, int]) -> Image:
    """Make a picture with drifting coloured clouds and its number in squares."""
    noise = np.random.default_rng(0).integers(0, 255, (COARSE[1], COARSE[0], 3), dtype=np.uint8)
    image = np.roll(cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC), 3 * number, axis=1)
    for bit in range(BITS):
        image[:SQUARE, bit * SQUARE : (bit + 1) * SQUARE] = 255 if number >> bit & 1 else 0
    return image


def number_of(image: Image) -> int:
    """Read a picture's number."""
    inner = slice(SQUARE // 4, SQUARE - SQUARE // 4)
    squares = (image[inner, bit * SQUARE :][:, inner] for bit in range(BITS))
    return sum(int(square.mean() > 127) << bit for bit, square in enumerate(squares))


def run(seconds: float, seed: int) -> list[Row]:
    """Measure the age of each frame of the Axis stream that the consumer takes; give a row per frame."""
    return _run("age", serve, lambda url: AxisSettings(url=url, size=SIZE, latency_s=0.0), AxisCamera, seconds, seed)


def run_h264(seconds: float, seed: int) -> list[Row]:
    """Measure the age of each frame of the H.264 stream that the consumer takes; give a row per frame."""

    def settings(url: str) -> StreamSettings:
        return StreamSettings(url=url, size=LARGE, rate_hz=STREAM_HZ, latency_s=0.0)

    return _run("stream_age", serve_h264, settings, StreamCamera, seconds, seed)


def _run(
    figure: str,
    server: Callable[..., None],
    settings: Callable[[str], Any],
    driver: Callable[..., Any],
    seconds: float,
    seed: int,
) -> list[Row]:
    """Read a stream from another process."""
    sent = multiprocessing.get_context("spawn").Array("d", PICTURES, lock=False)
    rng, clock, rows = np.random.default_rng(seed), MonotonicClock(), []
    with beside(server, sent) as url, contextlib.closing(driver(settings(url), clock)) as camera:
        begun = clock.now()
        while clock.now() < begun + seconds:
            clock.sleep_until(clock.now() + max(1 / CONSUMER_HZ + rng.uniform(-0.5, 0.5) * JITTER_S, LEAST))
            asked = clock.now()
            frame = camera.read()
            done = clock.now()
            age = done - sent[number_of(frame.image)]
            rows.append({"figure": figure, "t_s": asked - begun, "age_s": age, "read_s": done - asked, "load": load()})
    return rows
