"""Waiting until head and lens of a rig stand where they were sent."""

import numpy as np

from cotarget.errors import CalibrationError
from cotarget.rig import PanTiltState, Rig, ZoomState

POLL = 0.02  # between looks at a state [s]
HEAD_PATIENCE = 2.0  # beyond what the way takes at the head's own speed and acceleration [s]
POSE_TOLERANCE = np.radians(0.2)  # between commanded and reached, above the head's own step [rad]
LENS_TIMEOUT = 15.0  # the slowest zoom lenses take some ten seconds from end to end [s]


def wait_for_lens(rig: Rig) -> ZoomState:
    """Wait until the zoom lens stands; its state then.

    Raises:
        CalibrationError: it goes on moving.
    """
    clock = rig.clock
    deadline = clock.now() + LENS_TIMEOUT
    while (state := rig.zoom.state()).moving:
        if clock.now() > deadline:
            raise CalibrationError(f"the zoom lens still moves after {LENS_TIMEOUT:g} s")
        clock.sleep_until(clock.now() + POLL)
    return state


def wait_for_head(rig: Rig, wanted: tuple[float, float], way: float) -> tuple[PanTiltState, bool]:
    """Wait until the head stands where it is wanted, or should have for long.

    Args:
        rig: whose head it is.
        wanted: pan and tilt [rad].
        way: from where it was, the longer of both axes' [rad].

    Returns:
        Its state, and whether it has arrived.
    """
    head, clock = rig.head, rig.clock
    limits = head.limits
    deadline = clock.now() + way / limits.speed + limits.speed / limits.acceleration + HEAD_PATIENCE
    while True:
        state = head.state()
        off = max(abs(state.pan - wanted[0]), abs(state.tilt - wanted[1]))
        arrived = not state.moving and off <= limits.step + POSE_TOLERANCE
        if arrived or clock.now() > deadline:
            return state, arrived
        clock.sleep_until(clock.now() + POLL)
