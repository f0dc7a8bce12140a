"""Whether `auto` keeps up with today's cameras: 1920x1080 at 25 frames a second from a server, 3840x2160 from a file.

A film is made beforehand. Another process sends it in real time as an emulated Axis server does, each picture encoded
once, and emulates the head. This one receives and decodes it with the driver, detects, tracks and aims, and commands
the head. A frame that arrives while others are worked on is missed. The age of a frame is the time from when it was
sent until its command. The film of 3840x2160 is read from a file as fast as it goes, decoding included.
"""

import contextlib
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.frame_sizes import BIRD_PX, RATE_HZ, film
from benchmarks.pipeline_speed import Pipeline
from cotarget.drivers.axis import AxisCamera, AxisSettings
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.ptu_d46 import D46Head, D46Settings
from cotarget.emulators import axis_241q
from cotarget.emulators.plant import Feed, Picture, encode_jpeg
from cotarget.emulators.ptu_d46.firmware import D46, D46_FAULTS
from cotarget.emulators.ptu_d46.ports import UnitPorts
from cotarget.emulators.ptu_d46.unit import D46_STOCK
from cotarget.emulators.serve import Faults
from cotarget.emulators.world import EmulatedAxis, WallClock
from cotarget.errors import DeviceError
from cotarget.geometry import Array
from cotarget.rig import Image
from cotarget.sim.motion import Axis
from cotarget.video import Film, FilmWriter
from experiments.engine import Count, Row, Settings
from experiments.wire.rig import beside

STREAM, FILE = (1920, 1080), (3840, 2160)
PERCENTILES = (50, 95, 99)
LENGTH = 75  # frames of the film, which goes forth and back
ORDER = [*range(LENGTH), *range(LENGTH - 2, 0, -1)]  # frame of the film that each frame sent shows, again and again
QUALITY = 70  # of JPEG
STEPS_S = 1e6  # speed of the emulated head, which need not be waited for
WAIT_S = 0.01  # between two looks whether the other side has connected
ALL_SENT_S = 1.0  # after the last frame is due, none comes any more
# Goals: one frame missed of this number, age of a frame at its command [ms], frames of the file a second.
MISSED_OF, MOST_AGE_MS, LEAST_HZ = 1500, 100.0, 12.0


@dataclass(frozen=True)
class RealTimeSettings(Settings):
    """Settings: detector, frames sent, of which the first are not judged, and frames in the file."""

    seeds: Count = 1
    detector: str = "auto"
    frames: Count = 1525
    untimed: Count = 25
    in_file: Count = 75


def serve(pipe: Connection, frames: int, sent: Any, size: tuple[int, int] = STREAM, carried: Any = None) -> None:
    """Send the film, as both cameras of the server, and emulate the head.

    Args:
        pipe: to the other process; gets the addresses of camera and head.
        frames: number of frames to send.
        sent: gets the time at which each frame from 1 on was published [s], infinite before; the first value is set
            when to begin.
        size: width and height of its frames [px].
        carried: gets the time at which the sending of each frame to the fixed camera's reader began, if given; a server
            that is late leaves frames out.
    """
    sys.setswitchinterval(5e-4)  # as in `cotarget emulate`
    images = [frame.image for frame, _ in film(size, LENGTH, 0)]
    encoded: dict[int, bytes] = {}

    def once(image: Image, quality: int, size: tuple[int, int] | None = None) -> bytes:
        if id(image) not in encoded:
            encoded[id(image)] = encode_jpeg(image, quality, size)
        return encoded[id(image)]

    def publish(index: int, t: float) -> None:
        image = images[ORDER[index % len(ORDER)]]
        feed.publish(Picture(image, index, t))
        zoom_feed.publish(Picture(image, index + frames + 1, t))

    pan, tilt = (EmulatedAxis(Axis(STEPS_S, 1.0), WallClock(), 1.0, 0.0) for _ in range(2))

    def note(index: int, t: float) -> None:
        if carried is not None and index <= frames:
            carried[index] = t

    feed, zoom_feed, ports = Feed(), Feed(), UnitPorts(D46(pan, tilt, D46_STOCK, Faults(D46_FAULTS), time.monotonic))
    try:
        with (
            mock.patch.object(axis_241q, "encode_jpeg", once),
            axis_241q.AxisServer({1: feed, 2: zoom_feed}, quality=QUALITY, sent=note) as server,
        ):
            for image in images:
                once(image, QUALITY)
            publish(0, time.monotonic())
            pipe.send((server.url, ports.port))
            while not sent[0]:  # the other side has not connected yet
                if pipe.poll(WAIT_S):
                    return
            begun = time.monotonic()
            for index in range(1, frames + 1):
                if pipe.poll(max(begun + index / RATE_HZ - time.monotonic(), 0.0)):
                    return
                sent[index] = time.monotonic()
                publish(index, sent[index])
            pipe.recv()
    finally:
        ports.close()


def one(settings: RealTimeSettings, seed: int) -> list[Row]:
    """Work on the film as it is sent, then on that in the file; give a row for each frame sent and one for the file."""
    return [*_stream(settings, seed), _file(settings, seed)]


def _stream(settings: RealTimeSettings, seed: int) -> list[Row]:
    times = [0.0, *[np.inf] * settings.frames]
    sent = multiprocessing.get_context("spawn").Array("d", times, lock=False)
    ages: dict[int, float] = {}
    birds = [bird for _, bird in film(STREAM, LENGTH, 0)]
    clock, pipeline = MonotonicClock(), Pipeline(settings.detector, STREAM, RATE_HZ)
    with beside(serve, settings.frames, sent) as (url, port):
        camera = AxisCamera(AxisSettings(url=url, size=STREAM, resolution="", latency_s=0.0), clock)
        with contextlib.closing(camera), contextlib.closing(D46Head(D46Settings(port=port), clock)) as head:
            t = camera.read().t
            sent[0] = clock.now()
            end = sent[0] + settings.frames / RATE_HZ + ALL_SENT_S
            while clock.now() < end:
                with contextlib.suppress(DeviceError):  # no frame comes after the last one
                    frame = camera.read(newer_than=t, timeout=ALL_SENT_S)
                    t = frame.t
                    if pipeline(frame)["aimed"] and pipeline.aim is not None:
                        head.move(pipeline.aim.pan, pipeline.aim.tilt)
                    index = frame_sent(frame.image, int(np.searchsorted(np.array(sent), t, side="right")) - 1, birds)
                    ages[index] = clock.now() - sent[index]
    return [
        {"seed": seed, "part": "stream", "frame": index, "age_ms": 1e3 * ages[index] if index in ages else None}
        for index in range(settings.untimed + 1, settings.frames + 1)
    ]


def frame_sent(image: Image, latest: int, birds: Sequence[Array]) -> int:
    """Find which frame sent an image is, by the place of the bird in it.

    Args:
        image: image of the stream, (H, W, 3).
        latest: number of the latest frame sent.
        birds: centre of the bird in each frame of the film, (2,) [px].
    """
    corners = (np.rint(bird - (BIRD_PX - 1) / 2).astype(int) for bird in birds)
    shown = int(np.argmin([image[v : v + BIRD_PX, u : u + BIRD_PX].mean() for u, v in corners]))
    return next(index for index in range(latest, latest - len(ORDER), -1) if ORDER[index % len(ORDER)] == shown)


def _file(settings: RealTimeSettings, seed: int) -> Row:
    pipeline = Pipeline(settings.detector, FILE, RATE_HZ)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        with FilmWriter(path, RATE_HZ) as written:
            for frame, _ in film(FILE, settings.in_file, seed):
                written.write(frame.image, frame.t)
        with Film(path) as read:
            began, count = time.perf_counter(), 0
            for frame in read:
                pipeline(frame)
                count += 1
            return {"seed": seed, "part": "file", "hz": count / (time.perf_counter() - began)}


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give frames sent and missed, percentiles of the age [ms], and frames of the file a second."""
    stream = [row["age_ms"] for row in rows if row["part"] == "stream"]
    ages = [age for age in stream if age is not None]
    percentiles = np.percentile(ages, PERCENTILES) if ages else [np.nan] * len(PERCENTILES)
    return {
        "stream": {"frames": len(stream), "missed": len(stream) - len(ages)}
        | {f"age_p{p}_ms": float(age) for p, age in zip(PERCENTILES, percentiles, strict=True)},
        "file": {"hz": float(np.median([row["hz"] for row in rows if row["part"] == "file"]))},
    }


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the goals that are not reached."""
    stream = summary["stream"]
    reached = {
        "missed frames": stream["missed"] <= max(1.0, stream["frames"] / MISSED_OF),
        "age": stream["age_p95_ms"] <= MOST_AGE_MS,
        "file": summary["file"]["hz"] >= LEAST_HZ,
    }
    return [name for name, well in reached.items() if not well]


SETTINGS = RealTimeSettings()
QUICK = replace(SETTINGS, frames=75, in_file=10)
ALONE = True
COST_S = 90.0
