"""A step of a run whose target is found in both views, as tests of what is drawn and counted see it."""

import dataclasses

import numpy as np

from cotarget.estimation.zoom_matching import ZoomMeasurement
from cotarget.pipeline import State, Step
from cotarget.rig import Detection, Frame, PanTiltState, ZoomState
from cotarget.targeting import Aim
from cotarget.tracking.track import Track

PICTURE = np.zeros((48, 64, 3), np.uint8)
MIDDLE = np.array([31.5, 23.5])
AIM = Aim(0.1, 0.0, 3000.0, 3000.0, False, np.array([1.0, 0.0, 10.0]), 10.0)


def step(t, side=8.0, shared=False, off_px=0.0, focal_px=3000.0, seen_s=0.0):
    """The target's box has a side; it is found off the middle of the zoom view, in that frame or so much earlier."""
    size = np.full(2, side)
    box = Detection(np.array([30.0, 20.0]), size, 1.0)
    track = Track(
        1, t, True, 0, box.center_px, np.zeros(2), np.full(2, 8.0), np.full(2, 8.0), 8.0, np.eye(4), 1.0, box, shared
    )
    frame, head, lens = Frame(PICTURE, t), PanTiltState(0.1, 0.0, False, t), ZoomState(focal_px, False, t)
    told = (0.1, 0.0, 3000.0)
    made = Step(0, t, State.FOLLOWING, "", frame, frame, None, (box,), (track,), track, AIM, told, head, lens)
    at = ZoomMeasurement(MIDDLE + np.array([off_px, 0.0]), 1.0, np.ones(2), t - seen_s)
    return dataclasses.replace(made, found=at)
