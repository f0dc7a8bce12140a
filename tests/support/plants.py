"""Emulated devices without a simulated world: axes, and each device with axes, lenses and images behind it."""

import contextlib
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import serial

from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.ptu_d46 import D46Settings
from cotarget.drivers.visca import ViscaDome, ViscaSettings
from cotarget.emulators.axis_241q import AxisServer
from cotarget.emulators.ptu_d46.firmware import D46, D46_FAULTS
from cotarget.emulators.ptu_d46.ports import UnitPorts
from cotarget.emulators.ptu_d46.unit import D46_STOCK
from cotarget.emulators.serve import Faults
from cotarget.emulators.visca import UNITS, VISCA_FAULTS, ViscaCamera, ViscaModel, ViscaServer
from cotarget.emulators.world import EmulatedAxis
from cotarget.errors import DeviceError
from cotarget.sim.motion import Axis
from tests.support.emulated_camera import DEADLINE_S, Film

FEED_SIZE = (320, 240)
USER, PASSWORD = "root", "hunter2 & co"


class AxisModel(EmulatedAxis):
    """An axis in steps, on a clock, without delay; it notes the largest position that was commanded, without sign."""

    def __init__(self, now=time.monotonic):
        super().__init__(Axis(1e6, 1.0), SimpleNamespace(now=now), 1.0, 0.0)
        self.furthest = 0

    def command(self, goal, speed, acceleration):
        self.furthest = max(self.furthest, abs(goal))
        super().command(goal, speed, acceleration)


class LiveUnit:
    """A PTU-D46 on the machine's own clock behind its ports; a context manager."""

    def __init__(self, unit=D46_STOCK):
        self.pan, self.tilt, self.faults = AxisModel(), AxisModel(), Faults(D46_FAULTS)
        self.ports = UnitPorts(D46(self.pan, self.tilt, unit, self.faults, time.monotonic))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.ports.close()

    def turning(self):
        return self.pan.moving() or self.tilt.moving()

    def open(self, tcp=False):
        """Open a port as pyserial does."""
        return serial.serial_for_url(self.ports.url if tcp else self.ports.port, timeout=DEADLINE_S)


class D46Unit(LiveUnit):
    """An emulated unit behind a paced pseudo-terminal or TCP; a context manager.

    Attributes:
        config: settings of the driver that connects to it, with pan in the unit's own sense.
    """

    def __init__(self, profile=D46_STOCK, tcp=False):
        super().__init__(profile)
        step = profile.step / 3600
        self.config = D46Settings(
            port=self.ports.url if tcp else self.ports.port,
            step_deg=step,
            pan_deg=tuple(step * end for end in profile.pan),
            tilt_deg=tuple(step * end for end in profile.tilt),
            pan_sign=1,
        )


def decoded(jpeg):
    """The image of a JPEG; None if it is damaged."""
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)


def wait_for(condition, seconds=DEADLINE_S):
    """Wait for something that another thread does."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "hangs"
        time.sleep(1e-3)


def fails(call):
    """What a call says when it fails at last."""
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        try:
            call()
        except DeviceError as error:
            return str(error)
        time.sleep(1e-3)
    raise AssertionError("it goes on and on")


# The Axis video server


@contextlib.contextmanager
def axis_server(auth="digest"):
    """A 241Q whose input shows a new picture 25 times a second, which has noise like a camera's."""
    rng = np.random.default_rng(0)
    scene = cv2.resize(rng.integers(0, 255, (15, 20, 3), dtype=np.uint8), FEED_SIZE, interpolation=cv2.INTER_CUBIC)

    def draw(index):
        return cv2.add(scene, rng.integers(0, 5, scene.shape, dtype=np.uint8))

    with Film(draw) as film, AxisServer({1: film.feed}, user=USER, password=PASSWORD, auth=auth) as server:
        yield server


# The dome: its pictures come from the video server


class TravellingLens:
    """A lens that takes half a second for its range; a `LensPlant`."""

    last = 0x4000

    def __init__(self):
        self._axis = Axis(2.0 * self.last, 1e9)

    def command(self, position):
        self._axis.command(time.monotonic(), position)

    def position(self):
        return round(self._axis.motor(time.monotonic())[0])


class LiveDome:
    """A camera that takes VISCA, on the machine's own clock, with a stream; a context manager.

    Args:
        units: those of the camera, and of the settings that connect to it.
        protocol: how it is reached, in the settings.
        network: arguments of `ViscaServer`.
    """

    def __init__(self, units="ptzoptics", protocol="sony", **network):
        self.pan, self.tilt, self.lens, self.faults = AxisModel(), AxisModel(), TravellingLens(), Faults(VISCA_FAULTS)
        self.units, self.protocol = units, protocol
        count_deg, speeds = UNITS[units]
        pan, tilt = ((round(low / count_deg), round(high / count_deg)) for low, high in ((-170, 170), (-30, 90)))
        model = ViscaModel(count_deg, speeds, pan, tilt)
        self.camera = ViscaCamera(self.pan, self.tilt, self.lens, model, self.faults)
        self._network, self._opened = network, contextlib.ExitStack()

    def __enter__(self):
        self.server = self._opened.enter_context(ViscaServer(self.camera, self.faults, **self._network))
        self.stream = self._opened.enter_context(axis_server("basic"))
        return self

    def __exit__(self, *_):
        self._opened.close()

    def settings(self, **more):
        port = self.server.ports[("sony", "udp", "tcp").index(self.protocol)]
        own = {"host": "127.0.0.1", "port": port, "protocol": self.protocol, "units": self.units}
        own |= {"url": f"{self.stream.url}/mjpg/video.mjpg", "user": USER, "password": PASSWORD, "size": FEED_SIZE}
        return ViscaSettings(**own | {"rate_hz": 25.0, "latency_s": 0.0} | more)

    def open(self, **more):
        """Open it by the driver."""
        return ViscaDome(self.settings(**more), MonotonicClock())

    def at(self):
        """Where pan and tilt are [counts]."""
        return self.pan.position(), self.tilt.position()

    def turning(self):
        return self.pan.moving() or self.tilt.moving()


# The Canon PowerShot S5 IS: in a process of its own, because libgphoto2 would hold up its threads

S5IS = """
import sys
from cotarget.emulators.canon_s5is import S5IS_FAULTS, S5isServer
from cotarget.emulators.serve import Faults
from tests.support.emulated_camera import Film, LensModel, plain

still, lens, faults = plain((3264, 2448), 90), LensModel(), Faults(S5IS_FAULTS)
with (
    Film(lambda index: plain((640, 480), 20 + index % 200), 0.05) as film,
    S5isServer(film.feed, lambda: still, lens, faults=faults) as server,
):
    print(server.port, flush=True)
    for line in sys.stdin:
        if line.strip():
            name, on = line.split()
            faults.set(name, on == "on")
        print(lens.position(), flush=True)
"""


class S5isProcess:
    """The emulated camera's process.

    Attributes:
        port: port of the camera, as gphoto2 writes it.
    """

    def __init__(self, process):
        self._process = process
        self.port = f"ptpip:localhost:{int(process.stdout.readline())}"

    def switch(self, fault, on=True):
        """Switch a fault on or off."""
        self._ask(f"{fault} {'on' if on else 'off'}")

    def lens(self):
        """Where the lens is."""
        return int(self._ask(""))

    def _ask(self, text):
        print(text, file=self._process.stdin, flush=True)
        return self._process.stdout.readline()


@contextlib.contextmanager
def s5is_process():
    """An emulated S5 IS, whose pictures are even and never the same, and whose stills have 90 grey levels."""
    pytest.importorskip("gphoto2")
    path = {"PYTHONPATH": str(Path(__file__).parents[2])}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", S5IS], env=os.environ | path, **pipes) as process:
        try:
            yield S5isProcess(process)
            process.stdin.close()
            process.wait(DEADLINE_S)
        finally:
            process.kill()
