"""Ways to make a device of each role, on which the contracts of tests/contract are run; a new driver is one entry.

A way opens its device for the length of a with block, and gives it with its clock. A replayed device is first recorded
while it keeps the promise, and then has to keep it in the replay.
"""

import atexit
import contextlib
import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from cotarget.backends import open_recording
from cotarget.config import SafetyConfig, parse_config
from cotarget.drivers.axis import AxisCamera, AxisSettings
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.gphoto_camera import GphotoCamera, GphotoSettings
from cotarget.drivers.ptu_d46 import D46Head
from cotarget.drivers.stream import StreamCamera, StreamSettings
from cotarget.errors import DeviceError
from cotarget.recording.recorder import Recorder
from cotarget.recording.replay import Replay
from cotarget.safety.safe_rig import guard
from cotarget.sim.world import SimWorld
from tests.support.gphoto_link import CONFIG as GPHOTO_CONFIG
from tests.support.gphoto_link import FakeLink
from tests.support.plants import FEED_SIZE, PASSWORD, USER, D46Unit, LiveDome, axis_server, s5is_process
from tests.support.recorded_run import calibration_file
from tests.support.rtsp_server import Feed, RtspServer

CONFIG = parse_config({"sim": {"scene": "indoor", "targets": ["book"]}})
PATIENT = SafetyConfig(watchdog_s=30.0, stop_file=None)  # a contract reads no frames while a head moves


@dataclass(frozen=True)
class Way:
    """One way to make a device.

    Attributes:
        name: of the test.
        keep: calls a promise with the device and its clock; takes the promise and a folder for files.
        marks: of the test.
    """

    name: str
    keep: Callable[[Callable, object], None]
    marks: tuple = ()


def way(name, opened, *marks):
    """A way by a context manager that gives a device of a driver and its clock, and closes it."""

    def keep(promise, folder):
        with opened() as (device, clock):
            promise(device, clock)
        device.close()  # may be called again
        with pytest.raises(DeviceError):
            device.state() if hasattr(device, "state") else device.read()

    return Way(name, keep, marks)


def of_rigs(role):
    """The ways by the simulation: plain, behind the safety layer, and recorded and replayed."""

    def keep_on(rig, promise):
        with rig:
            rig.fixed.read()  # a recording without a frame cannot be replayed
            promise(getattr(rig, role), rig.clock)
        rig.close()  # may be called again

    def simulated(promise, folder):
        keep_on(SimWorld(CONFIG, rendered=()).rig, promise)

    def guarded(promise, folder):
        keep_on(guard(SimWorld(CONFIG, rendered=()).rig, PATIENT), promise)

    def replayed(promise, folder):
        with Recorder(folder / "recording", CONFIG, calibration_file(folder), "book") as recorder:
            keep_on(recorder.wrap(SimWorld(CONFIG, rendered=()).rig), promise)
        keep_on(Replay(open_recording(folder / "recording")).rig, promise)

    return [Way("simulation", simulated), Way("guarded simulation", guarded), Way("replay", replayed)]


@contextlib.contextmanager
def axis():
    with axis_server() as server:
        settings = AxisSettings(url=server.url, user=USER, password=PASSWORD, size=FEED_SIZE, resolution="320x240")
        with contextlib.closing(AxisCamera(settings, MonotonicClock())) as camera:
            yield camera, MonotonicClock()


@contextlib.contextmanager
def rtsp():
    random = np.random.default_rng(0)
    feed = Feed(lambda index: random.integers(0, 255, (FEED_SIZE[1], FEED_SIZE[0], 3), dtype=np.uint8))
    with RtspServer(feed) as server:
        settings = StreamSettings(url=server.url, size=FEED_SIZE)
        with contextlib.closing(StreamCamera(settings, MonotonicClock())) as camera:
            yield camera, MonotonicClock()


@functools.cache
def s5is_port():
    """An emulated S5 IS for all promises, because its process takes a second to start; its port."""
    kept = contextlib.ExitStack()
    atexit.register(kept.close)
    return kept.enter_context(s5is_process()).port


@contextlib.contextmanager
def s5is():
    with contextlib.closing(GphotoCamera(GphotoSettings(port=s5is_port()), MonotonicClock())) as camera:
        yield camera, MonotonicClock()


@contextlib.contextmanager
def gphoto2():
    """The driver of gphoto2 on a camera in the place of the library."""
    clock = MonotonicClock()
    with contextlib.closing(GphotoCamera(GPHOTO_CONFIG, clock, FakeLink(clock))) as camera:
        yield camera, clock


@contextlib.contextmanager
def d46(tcp=False):
    with D46Unit(tcp=tcp) as unit, contextlib.closing(D46Head(unit.config, MonotonicClock())) as head:
        yield head, MonotonicClock()


@contextlib.contextmanager
def dome(part):
    with LiveDome() as live, contextlib.closing(live.open()) as opened:
        device = getattr(opened, part)
        if part == "zoom":
            device.close = opened.close  # of the whole
        yield device, MonotonicClock()


WIRE = pytest.mark.wire
ZOOM_CAMERAS = [*of_rigs("zoom"), way("gphoto2", gphoto2), way("emulated S5 IS", s5is, WIRE)]
ZOOM_CAMERAS += [way("emulated VISCA dome", lambda: dome("zoom"), WIRE)]
CAMERAS = [*of_rigs("fixed"), *ZOOM_CAMERAS, way("emulated 241Q", axis, WIRE), way("RTSP", rtsp, WIRE)]
HEADS = [
    *of_rigs("head"),
    way("emulated PTU-D46", d46, WIRE),
    way("emulated PTU-D46 by TCP", lambda: d46(tcp=True), WIRE),
    way("emulated VISCA dome", lambda: dome("head"), WIRE),
]


def contract(ways, promises):
    """Parametrize a test by every way and every promise."""
    cases = [
        pytest.param(way, promise, id=f"{way.name}: {promise.__name__}", marks=way.marks)
        for way in ways
        for promise in promises
    ]
    return pytest.mark.parametrize(("way", "promise"), cases)


def settle(device, clock, seconds=20.0):
    """Wait until a device does not move any more; return its state."""
    end = clock.now() + seconds
    while (state := device.state()).moving:
        assert clock.now() < end, "it goes on moving"
        clock.sleep_until(clock.now() + 0.02)
    return state
