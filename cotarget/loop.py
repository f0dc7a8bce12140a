"""The one pipeline: look, detect, track, aim, command; yields one Step a frame and knows no backend.

Everything that records, draws, scores or prints consumes Steps.
"""

import enum
import math
from collections.abc import Iterator
from dataclasses import dataclass

from cotarget.calibration import Calibration
from cotarget.config import TargetConfig
from cotarget.detection import Detection, Detector
from cotarget.errors import CotargetError
from cotarget.rig import Frame, Image, PanTiltLimits, PanTiltState, Rig, ZoomState
from cotarget.targeting import Aim, Closeup, Reach, aim, depth_of, point_at
from cotarget.tracking import FirstCome, Track, Tracker, size_for

# The prediction is refined by the travel that it itself causes; a second round changes less than a step.
LEAD_ROUNDS = 2


class State(enum.StrEnum):
    """What the loop is doing."""

    SEARCHING = "searching"  # nothing to follow; the lens is at its shortest
    FOLLOWING = "following"  # the head follows the target
    COASTING = "coasting"  # the target is out of sight for a moment; the head follows its prediction
    LOST = "lost"  # out of sight for longer: the lens zooms out, the head waits
    UNREACHABLE = "unreachable"  # the target is seen but cannot be aimed at


@dataclass(frozen=True)
class FollowSettings:
    """How the loop follows.

    Attributes:
        command_delay_s: from a command to the start of motion [s]; the aim leads the target by it.
        zoom_out_after_s: how long a target may be out of sight before the lens zooms out [s].
        focal_deadband: the lens is not moved for a smaller relative change of focal length.
    """

    command_delay_s: float = 0.0
    zoom_out_after_s: float = 0.4
    focal_deadband: float = 0.04


@dataclass(frozen=True)
class Step:
    """One turn of the loop.

    Attributes:
        index: from 0.
        t: when it was done, on the rig's clock [s].
        state: what the loop was doing, and
        reason: why, where that needs words.
        fixed: the frame that it acted on.
        zoom: the newest zoom frame at that time.
        mask: the detector's foreground, (H, W), or None.
        detections: in the fixed frame.
        tracks: after them.
        target: the track that is followed.
        aim: what was solved; None when nothing was aimed at.
        commanded: pan, tilt [rad] and nominal focal length [px] as really commanded last.
        head: the head's state.
        lens: the lens's state.
    """

    index: int
    t: float
    state: State
    reason: str
    fixed: Frame
    zoom: Frame
    mask: Image | None
    detections: tuple[Detection, ...]
    tracks: tuple[Track, ...]
    target: Track | None
    aim: Aim | None
    commanded: tuple[float, float, float]
    head: PanTiltState
    lens: ZoomState


def follow(
    rig: Rig,
    calibration: Calibration,
    target: TargetConfig,
    detector: Detector,
    *,
    seconds: float,
    settings: FollowSettings = FollowSettings(),
) -> Iterator[Step]:
    """Follow a target and yield one Step for each frame of the fixed camera.

    Args:
        rig: any rig; the caller closes it.
        calibration: of that rig.
        target: what to follow.
        detector: finds it in the fixed view.
        seconds: for how long on the rig's clock [s].
        settings: delays and habits.

    Raises:
        CalibrationError: the calibration is of another aspect ratio than the rig's streams.
        StaleFrameError: frames stopped coming, or came too late to act on.
    """
    tracker, policy = Tracker(), FirstCome()
    shortest = rig.zoom.focal_range[0]
    state = rig.head.state()
    commanded = (state.pan, state.tilt, rig.zoom.zoom(shortest))
    frame_t: float | None = None
    last_seen = -math.inf
    end, index = rig.clock.now() + seconds, 0
    while rig.clock.now() < end:
        frame = rig.fixed.read(newer_than=frame_t)
        frame_t = frame.t
        detections = detector.detect(frame)
        tracks = tracker.update(detections, frame.t)
        chosen = policy.select(tracks)
        aimed: Aim | None = None
        mode, reason = State.SEARCHING, ""
        if chosen is not None:
            if chosen.missed == 0:
                last_seen = frame.t
            mode = State.FOLLOWING if chosen.missed == 0 else State.COASTING
            if frame.t - last_seen > settings.zoom_out_after_s:
                mode, reason = State.LOST, f"out of sight for {frame.t - last_seen:.1f} s"
            else:
                try:
                    aimed = lead(rig, calibration, target, chosen, settings.command_delay_s)
                except CotargetError as error:
                    mode, reason = State.UNREACHABLE, str(error)
        if aimed is not None:
            pan, tilt = rig.head.move(aimed.pan, aimed.tilt)
            focal = _command_lens(rig, aimed.nominal_px, commanded[2], settings.focal_deadband)
            commanded = (pan, tilt, focal)
        elif mode is not State.UNREACHABLE and commanded[2] > shortest:
            commanded = (*commanded[:2], rig.zoom.zoom(shortest))
        yield Step(
            index=index,
            t=rig.clock.now(),
            state=mode,
            reason=reason,
            fixed=frame,
            zoom=rig.zoom.read(),
            mask=detector.mask,
            detections=tuple(detections),
            tracks=tuple(tracks),
            target=chosen,
            aim=aimed,
            commanded=commanded,
            head=rig.head.state(),
            lens=rig.zoom.state(),
        )
        index += 1


def lead(rig: Rig, calibration: Calibration, target: TargetConfig, track: Track, command_delay_s: float) -> Aim:
    """Aim at where a track will be when the head has got there.

    Args:
        rig: gives the time, the limits and where the head is.
        calibration: of that rig.
        target: the target's known size and the size wanted.
        track: in the fixed view.
        command_delay_s: from command to motion [s].

    Raises:
        UnreachableError: no pan and tilt within the limits do it.
    """
    limits, head = rig.head.limits, rig.head.state()
    reach = Reach(limits.pan, limits.tilt, rig.zoom.focal_range, (head.pan, head.tilt), limits.step)
    depth = depth_of(calibration, target, size_for(track, target.dimension))
    start, travel = rig.clock.now() + command_delay_s, 0.0
    for _ in range(LEAD_ROUNDS):
        x_fixed = point_at(calibration, track.predict(start + travel), depth)
        found = aim(calibration, x_fixed, reach, closeup=Closeup(target.size, target.wanted_px))
        travel = travel_time(max(abs(found.pan - head.pan), abs(found.tilt - head.tilt)), limits)
    return found


def travel_time(angle: float, limits: PanTiltLimits) -> float:
    """How long a head takes from rest to rest over an angle [rad], by the trapezoidal profile [s]."""
    if math.isinf(limits.speed) or math.isinf(limits.acceleration):
        return 0.0
    if angle * limits.acceleration < limits.speed**2:
        return 2 * math.sqrt(angle / limits.acceleration)
    return angle / limits.speed + limits.speed / limits.acceleration


def _command_lens(rig: Rig, nominal_px: float, commanded_px: float, deadband: float) -> float:
    """Move the lens unless the change is too small to matter; return what it is commanded to."""
    if abs(math.log(nominal_px / commanded_px)) < deadband:
        return commanded_px
    return rig.zoom.zoom(nominal_px)
