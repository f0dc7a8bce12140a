"""Which of a run's Steps a picture of a target shows."""

import numpy as np

from cotarget.detection import Detection
from cotarget.drawing import SIZE_KNOWN_S, TargetStages
from cotarget.loop import State, Step
from cotarget.motionfilter import Track
from cotarget.rig import Frame, PanTiltState, ZoomState
from cotarget.targeting import Aim

PICTURE = np.zeros((48, 64, 3), np.uint8)
AIM = Aim(0.1, 0.0, 3000.0, 3000.0, False, np.array([1.0, 0.0, 10.0]), 10.0)


def step(t, side, shared=False):
    """The head stands where it should, the lens as long as it should; the target's box has a side."""
    size = np.full(2, side)
    box = Detection(np.array([30.0, 20.0]), size, 1.0)
    track = Track(1, t, True, 0, box.center_px, np.zeros(2), np.full(2, 8.0), 8.0, np.eye(4), 1.0, box, shared)
    frame, head, lens = Frame(PICTURE, t), PanTiltState(0.1, 0.0, False, t), ZoomState(3000.0, False, t)
    told = (0.1, 0.0, 3000.0)
    return Step(0, t, State.FOLLOWING, "", frame, frame, None, (box,), (track,), track, AIM, told, head, lens)


def test_the_close_up_is_of_the_largest_box_of_the_target_alone():
    stages = TargetStages(600.0)
    sides = [(8.0, False), (10.0, False), (20.0, True), (9.0, False)]
    steps = [step(i * (SIZE_KNOWN_S + 0.1), *each) for i, each in enumerate(sides)]
    for each in steps:
        stages.see(each)
    assert stages.close is steps[1]
