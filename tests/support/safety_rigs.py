"""Rigs for the tests of the safety layer: one with a simulated head, and one in real time that can hang."""

import threading
import time
from types import SimpleNamespace

import numpy as np

from cotarget.config import RigConfig, SimEffects, SimHead
from cotarget.errors import StaleFrameError
from cotarget.rig import Frame, PanTiltState
from cotarget.sim.devices import SimClock, SimPanTilt, head_drive, rig_spec
from tests.support.rigs import alike

IMAGE = np.zeros((2, 2, 3), np.uint8)
DEADLINE_S = 20.0  # for whatever must happen at all, on a machine that is busy with other things


class Camera:
    """25 frames a second that arrive at once, until it dies or freezes."""

    size = (2, 2)
    period = 0.04

    def __init__(self, clock):
        self.clock, self.dead, self.frozen_at = clock, False, None

    def read(self, newer_than=None, timeout=1.0):
        if self.dead:
            self.clock.sleep_until(self.clock.now() + timeout)
            raise StaleFrameError("no frame")
        if self.frozen_at is not None:
            self.clock.sleep_until(self.clock.now() + self.period)
            return Frame(IMAGE, self.frozen_at)
        if newer_than is not None:
            self.clock.sleep_until(newer_than + self.period)
        return Frame(IMAGE, self.clock.now())

    def capture(self):
        return self.read(newer_than=self.clock.now())


class NotingHead(SimPanTilt):
    """The simulation's head, which logs its commands with their times, and can fail to halt."""

    def __init__(self, clock):
        self.drive = head_drive(SimHead(), SimEffects())
        super().__init__(rig_spec(RigConfig()).head, clock, self.drive)
        self.clock, self.log, self.broken = clock, [], 0

    def move(self, pan, tilt, speed=None, wait=False):
        self.log.append(("move", self.clock.now()))
        return super().move(pan, tilt, speed, wait)

    def halt(self):
        if self.broken > 0:
            self.broken -= 1
            raise OSError("the cable is out")
        self.log.append(("halt", self.clock.now()))
        super().halt()

    @property
    def halts(self):
        return [t for what, t in self.log if what == "halt"]


class SimulatedDevices:
    """Time passes inside calls only."""

    def __init__(self):
        self.clock = SimClock()
        self.head = NotingHead(self.clock)
        self.fixed, self.zoom, self.board = Camera(self.clock), Camera(self.clock), object()
        self.closed = False

    def close(self):
        self.closed = True


class RealHead:
    """A head that does not move; `hang` is called during each move."""

    limits = alike((-2.0, 2.0), (-1.0, 1.0), 4.0, 40.0, 0.0)

    def __init__(self):
        self.log, self.failing = [], 0
        self.halted = threading.Event()
        self.hang = lambda: None
        self.pose = (0.0, 0.0)

    def state(self):
        return PanTiltState(*self.pose, moving=False, t=0.0)

    def move(self, pan, tilt, speed=None, wait=False):
        self.log.append("move")
        self.hang()
        self.log.append("moved")
        return pan, tilt

    def halt(self):
        if self.failing:
            self.failing -= 1
            self.log.append("failed")
            raise OSError("the cable is out")
        self.log.append("halt")
        self.halted.set()

    def wait_for_halt(self):
        assert self.halted.wait(DEADLINE_S)


class RealDevices:
    """Real time; the thread watches."""

    real_time = True

    def __init__(self, clock=None):
        self.clock = clock or SimpleNamespace(now=time.monotonic, sleep_until=lambda t: None)
        self.head, self.board, self.closed = RealHead(), object(), False
        self.fixed = self.zoom = SimpleNamespace(size=(2, 2), read=lambda *a: Frame(IMAGE, self.clock.now()))

    def close(self):
        self.closed = True
