"""A rig of a few lines that makes real pictures, and a run on it that is recorded: for tests, and to be killed.

As a program: `python -m tests.support.recorded_run FOLDER` records without end and prints a line after every step.
"""

import itertools
import math
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import DEFAULT_TARGETS, RigConfig
from cotarget.detection import Detections
from cotarget.geometry import pose
from cotarget.pipeline import FollowSettings, follow
from cotarget.recording.recorder import Recorder
from cotarget.rig import Detection, Frame, PanTiltState, ZoomState
from cotarget.rig_geometry import FixedCamera, ZoomHead
from tests.support.rigs import alike, guarded, rig_of
from tests.support.simulated_clock import RigClock

SIZE = (96, 72)
RATE_HZ, ZOOM_RATE_HZ = 25.0, 10.0
LATENCY = 0.06
TICK = 1e-4  # each look at the clock takes so long, so that an answer given in another order is another answer [s]
STEP = math.radians(0.0514286)
SPEED = math.radians(149)
LIMITS = alike((-2.7, 2.7), (-0.8, 0.5), SPEED, math.radians(206), STEP)
FOCALS = (100.0, 1200.0)
CONFIG = RigConfig(targets={"bird": replace(DEFAULT_TARGETS["bird"], wanted_px=30.0)})
SETTINGS = FollowSettings()


class ToyDevices:
    """A bright bird on a noisy sky; a head and a lens that go straight to where they are sent."""

    def __init__(self, failing=None, real_time=False):
        self.real_time = real_time
        self.t, self.goal, self.start, self.since = 1000.0, np.zeros(2), np.zeros(2), 0.0
        self.failing = failing or {}  # the exception to raise at the n-th call of a device's method
        self.calls = dict.fromkeys(("fixed.read", "zoom.read", "head.move", "head.halt"), 0)
        self.closed = False
        self.fixed = ToyCamera(self, "fixed", RATE_HZ)
        self.zoom = ToyZoomCamera(self, "zoom", ZOOM_RATE_HZ)
        self.head = ToyHead(self)
        self.clock = RigClock(self, TICK)
        self.board = ToyBoard()

    def count(self, call):
        self.calls[call] += 1
        if (call, self.calls[call]) in self.failing:
            raise self.failing[call, self.calls[call]]

    def pose(self):
        way = self.goal - self.start
        return self.start + np.clip(way, -SPEED * (self.t - self.since), SPEED * (self.t - self.since))

    def close(self):
        self.closed = True


def toy_rig(failing=None, real_time=False):
    """The rig of such devices."""
    return rig_of(ToyDevices(failing, real_time))


class ToyCamera:
    def __init__(self, rig, name, rate_hz):
        self.rig, self.name, self.rate_hz, self.size, self.kept = rig, name, rate_hz, SIZE, None

    def read(self, newer_than=None, timeout=1.0):
        self.rig.count(f"{self.name}.read")
        index = math.floor((self.rig.t - LATENCY) * self.rate_hz)
        if newer_than is not None:
            index = max(index, math.floor(newer_than * self.rate_hz + 1e-6) + 1)
        self.rig.t = max(self.rig.t, index / self.rate_hz + LATENCY)
        if self.kept is None or self.kept[0] != index:
            self.kept = index, Frame(self.expose(index), index / self.rate_hz)
        return self.kept[1]

    def expose(self, index):
        image = np.random.default_rng(index).integers(0, 60, (SIZE[1], SIZE[0], 3), np.uint8)
        u, v = 20 + 0.7 * (index % 80), 36 + 10 * math.sin(index / 9)
        cv2.circle(image, (round(u), round(v)), 4, (250, 250, 250), -1)
        return image


class ToyZoomCamera(ToyCamera):
    focal_range = FOCALS
    still_size = SIZE
    focal = FOCALS[0]

    def zoom(self, focal_px):
        self.focal = min(max(focal_px, FOCALS[0]), FOCALS[1])
        return self.focal

    def state(self):
        return ZoomState(self.focal, False, self.rig.t)

    def capture(self):
        return self.read()


class ToyHead:
    limits = LIMITS

    def __init__(self, rig):
        self.rig = rig

    def state(self):
        pan, tilt = np.round(self.rig.pose() / STEP) * STEP
        return PanTiltState(float(pan), float(tilt), bool(np.any(self.rig.pose() != self.rig.goal)), self.rig.t)

    def move(self, pan, tilt, speed=None, wait=False):
        self.rig.count("head.move")
        self.rig.start, self.rig.since = self.rig.pose(), self.rig.t
        low, high = np.array([axis.range for axis in LIMITS.axes]).T
        self.rig.goal = np.clip(np.round(np.array([pan, tilt]) / STEP) * STEP, low, high)
        return float(self.rig.goal[0]), float(self.rig.goal[1])

    def halt(self):
        self.rig.count("head.halt")
        self.rig.goal = self.rig.pose()


class ToyBoard:
    patience = 0.0

    def present(self, T_fixed_board):
        pass

    swing = present


class Bright:
    """Sees what is bright, to a fraction of a pixel that depends on every one of them."""

    def detect(self, frame, held=()):
        grey = frame.image.mean(axis=2)
        mask = ((grey > 150) * 255).astype(np.uint8)
        rows, columns = np.nonzero(mask)
        if not len(rows):
            return Detections([], lambda: mask)
        weights = grey[rows, columns] + 1e-3 * frame.image.sum()
        center = np.array([np.average(columns, weights=weights), np.average(rows, weights=weights)])
        return Detections([Detection(center, np.array([9.0, 9.0]), 1.0)], lambda: mask)


def calibration():
    focal, middle = (100.0, 100.0), ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    plain = Intrinsics(SIZE, focal, middle)
    return Calibration(
        fixed=FixedCamera(plain),
        zoom_head=ZoomHead(ZoomLens((100.0,), (plain,)), pose([0, 0.1, 0], [0, 0, 0]), pose([0, 0, 0.05], [0, 0, 0])),
    )


def calibration_file(folder: Path) -> Path:
    path = folder / "rig_calibration.json"
    calibration().save(path)
    return path


def run(rig, calibration, seconds=2.0, settings=SETTINGS, selector=None):
    """The pipeline as the commands run it."""
    with guarded(rig, CONFIG.safety) as safe:
        target = CONFIG.target("bird")
        yield from follow(safe, calibration, target, Bright(), selector=selector, seconds=seconds, settings=settings)


def record(folder: Path, calibration: Path, rig=None, **options):
    """Record a run; its steps."""
    with Recorder(folder, CONFIG, calibration, "bird") as recorder:
        return list(run(recorder.wrap(rig_of(rig or ToyDevices())), Calibration.load(calibration), **options))


def main():
    folder = Path(sys.argv[1])
    path = calibration_file(folder)
    with Recorder(folder / "recording", CONFIG, path, "bird") as recorder:
        for index, _ in zip(itertools.count(), run(recorder.wrap(toy_rig()), Calibration.load(path), math.inf)):
            while recorder.waiting:  # this rig is faster than any real one, and than the disk
                time.sleep(0.001)
            print(index, flush=True)


if __name__ == "__main__":
    main()
