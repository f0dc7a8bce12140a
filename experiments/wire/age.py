"""Age of the newest frame of an Axis stream at a slow consumer, from the first byte sent."""

import itertools
import multiprocessing
import sys
import time
from multiprocessing.connection import Connection
from typing import Any

import cv2
import numpy as np

from cotarget.drivers.axis import AxisCamera, AxisSettings
from cotarget.drivers.clock import MonotonicClock
from cotarget.emulators.axis_241q import AxisServer
from cotarget.emulators.plant import Feed, Picture
from cotarget.rig import Image
from experiments.engine import Row
from experiments.wire.rig import beside, load

SIZE = (704, 576)  # 4CIF [px]
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
    feed, images = Feed(), [picture(number) for number in range(PICTURES)]

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


def picture(number: int) -> Image:
    """Make a picture with drifting coloured clouds and its number in squares."""
    noise = np.random.default_rng(0).integers(0, 255, (COARSE[1], COARSE[0], 3), dtype=np.uint8)
    image = np.roll(cv2.resize(noise, SIZE, interpolation=cv2.INTER_CUBIC), 3 * number, axis=1)
    for bit in range(BITS):
        image[:SQUARE, bit * SQUARE : (bit + 1) * SQUARE] = 255 if number >> bit & 1 else 0
    return image


def number_of(image: Image) -> int:
    """Read a picture's number."""
    inner = slice(SQUARE // 4, SQUARE - SQUARE // 4)
    squares = (image[inner, bit * SQUARE :][:, inner] for bit in range(BITS))
    return sum(int(square.mean() > 127) << bit for bit, square in enumerate(squares))


def run(seconds: float, seed: int) -> list[Row]:
    """Measure the age of each frame that the consumer takes; give a row per frame."""
    sent = multiprocessing.get_context("spawn").Array("d", PICTURES, lock=False)
    with beside(serve, sent) as url:
        return _consume(url, sent, seconds, np.random.default_rng(seed))


def _consume(url: str, sent: Any, seconds: float, rng: np.random.Generator) -> list[Row]:
    clock, rows = MonotonicClock(), []
    camera = AxisCamera(AxisSettings(url=url, size=SIZE, latency_s=0.0), clock)
    try:
        begun = clock.now()
        while clock.now() < begun + seconds:
            clock.sleep_until(clock.now() + max(1 / CONSUMER_HZ + rng.uniform(-0.5, 0.5) * JITTER_S, LEAST))
            asked = clock.now()
            frame = camera.read()
            age = clock.now() - sent[number_of(frame.image)]
            rows.append(
                {"figure": "age", "t_s": asked - begun, "age_s": age, "read_s": clock.now() - asked, "load": load()}
            )
    finally:
        camera.close()
    return rows
