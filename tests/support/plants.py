"""Axes, lenses and images for emulated devices, without a simulated world; and a PTU-D46 with such axes."""

import math
import threading
import time

import cv2
import numpy as np
import serial

from cotarget.emulators.plant import Feed, Picture
from cotarget.emulators.ptu_d46.firmware import D46, D46_FAULTS
from cotarget.emulators.ptu_d46.ports import UnitPorts
from cotarget.emulators.ptu_d46.unit import D46_STOCK
from cotarget.emulators.serve import Faults
from cotarget.errors import DeviceError
from cotarget.sim.motion import Axis

DEADLINE_S = 20.0  # of real time: a loaded machine has reached it only if something hangs


class AxisModel:
    """An axis with the simulation's trapezoids, on a clock; an `AxisPlant`.

    Attributes:
        furthest: largest position that was commanded, without sign.
    """

    def __init__(self, now=time.monotonic):
        self.now, self.axis, self.rest, self.furthest = now, Axis(1e6, 1.0), -math.inf, 0.0
        self.lock = threading.Lock()

    def command(self, goal, speed, acceleration):
        with self.lock:
            self.axis.acceleration = acceleration
            self.rest = self.axis.command(self.now(), goal, speed)
            self.furthest = max(self.furthest, abs(goal))

    def halt(self, acceleration):
        with self.lock:
            self.axis.acceleration = acceleration
            self.rest = self.axis.halt(self.now())

    def at(self, t):
        """Position and speed at a time."""
        with self.lock:
            return self.axis.motor(t)

    def position(self):
        return round(self.at(self.now())[0])

    def speed(self):
        return self.at(self.now())[1]

    def moving(self):
        with self.lock:
            return self.now() < self.rest


class LiveUnit:
    """A PTU-D46 on the machine's own clock behind its ports, which are those of `UnitPorts`; a context manager."""

    def __init__(self, unit=D46_STOCK, **ports):
        self.pan, self.tilt, self.faults = AxisModel(), AxisModel(), Faults(D46_FAULTS)
        self.ports = UnitPorts(D46(self.pan, self.tilt, unit, self.faults, time.monotonic), **ports)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.ports.close()

    def turning(self):
        return self.pan.moving() or self.tilt.moving()

    def open(self, tcp=False):
        """Open a port as pyserial does."""
        return serial.serial_for_url(self.ports.url if tcp else self.ports.port, timeout=DEADLINE_S)


class LensModel:
    """A lens that moves at once; a `LensPlant`.

    Attributes:
        commands: positions that were commanded.
    """

    last = 128

    def __init__(self, position=0):
        self.commands, self._position = [], position

    def command(self, position):
        assert 0 <= position <= self.last
        self.commands.append(position)
        self._position = position

    def position(self):
        return self._position


class Film:
    """Publishes images at a steady rate, as a camera does; a context manager.

    Args:
        draw: makes the image of an index.
        period_s: of the images [s].

    Attributes:
        feed: of the images.
    """

    def __init__(self, draw, period_s=0.04):
        self.feed, self._draw, self._period_s = Feed(), draw, period_s
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._end.set()
        self._thread.join(DEADLINE_S)

    def _run(self):
        index = 0
        while True:
            publish(self.feed, index, self._draw(index))
            index += 1
            if self._end.wait(self._period_s):
                return


def publish(feed, index, image, t=None):
    feed.publish(Picture(image, index, time.monotonic() if t is None else t))


def plain(size, colour):
    """An image (width, height) of one colour or grey."""
    return np.full((size[1], size[0], 3), colour, np.uint8)


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
