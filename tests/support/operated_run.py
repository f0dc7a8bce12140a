"""A run on the toy rig with an operator, recorded or not."""

import math
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import FollowConfig
from cotarget.operate.session import Session
from cotarget.pipeline import Run
from cotarget.recording.recorder import RecordedRig, Recorder
from cotarget.safety.safe_rig import guard
from tests.support.recorded_run import CONFIG, SETTINGS, SPEED, Bright, ToyDevices, ToyHead
from tests.support.rigs import rig_of


class HandDevices(ToyDevices):
    """Toy devices whose head keeps to the commanded speed."""

    def __init__(self):
        super().__init__()
        self.head = HandHead(self)
        self.speed = np.full(2, SPEED)

    def pose(self):
        way, most = self.goal - self.start, self.speed * (self.t - self.since)
        return self.start + np.clip(way, -most, most)


class HandHead(ToyHead):
    def move(self, pan, tilt, speed=None, wait=False):
        said = super().move(pan, tilt)
        self.rig.speed = np.array(self.limits.capped(speed))
        return said


class Wall:
    """A clock on the wall that the test sets [s]."""

    t = 0.0

    def __call__(self):
        return self.t


class Unkept:
    """Records of a session that are kept nowhere."""

    def __init__(self, make_run):
        self.folder, self._make_run = "", make_run

    def add(self, order):
        pass

    def begin(self):
        self.folder = "unkept"
        return self._make_run()

    def end(self):
        self.folder = ""


# A busy machine may not look at the stop file for longer than a run allows.
@patch("cotarget.safety.stop_file.MOST_MISSED", 200)
def operate(path, steps, act, *, folder=None, stop_file=None, config=None, devices=None, guard_file=None):
    """Run some steps; `act(i, session, wall, rig)` is called after step i. The steps."""
    devices = devices or ToyDevices()
    done, wall = [], Wall()
    with Recorder(folder, CONFIG, path, "bird") if folder else nullcontext() as recorder:
        rig = rig_of(devices)
        safety = replace(CONFIG.safety, stop_file=guard_file)
        recorded = RecordedRig(rig)
        if recorder:
            recorder.begin(recorded)
        safe = guard(recorded.devices if recorder else rig, safety)
        if recorder:
            safe = recorded.with_refusals(safe)
        with safe:

            def make():
                return Run(safe, Calibration.load(path), CONFIG.target("bird"), Bright(), settings=SETTINGS)

            records = SimpleNamespace(add=recorder.add, folder=str(folder)) if recorder else Unkept(make)
            session = Session(safe, make(), stop_file, config or FollowConfig(), wall, records)
            for i, step in enumerate(session.steps(math.inf)):
                done.append(step)
                if i + 1 == steps:
                    break
                wall.t += 0.04
                act(i, session, wall, safe)
    return done
