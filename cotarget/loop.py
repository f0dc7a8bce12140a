"""The one pipeline: look, detect, track, aim, command; yields one Step a frame and knows no backend.

Everything that records, draws, scores or prints consumes Steps.
"""

import dataclasses
import enum
import math
from collections.abc import Iterator
from dataclasses import dataclass

from cotarget.calibration import Calibration
from cotarget.config import TargetConfig
from cotarget.detection import Detection, Detector
from cotarget.errors import UnreachableError
from cotarget.rig import Frame, Image, PanTiltLimits, PanTiltState, Rig, ZoomState
from cotarget.targeting import Aim, Closeup, Reach, aim, depth_of, point_at
from cotarget.tracking import FirstCome, Track, Tracker, settings_for, size_for

# Longest interval between frames that is taken for the rhythm of commands [s]; a longer one was a gap.
LONGEST_INTERVAL_S = 0.2


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
        centred_deg: the lens begins to zoom in when the head is this near to the target [degrees] ...
        margin: ... and goes on only as far as the way that the head has still to go fits into this part of the
            image's half height, so that the target is centred first.
    """

    command_delay_s: float = 0.0
    zoom_out_after_s: float = 0.4
    focal_deadband: float = 0.04
    centred_deg: float = 1.5
    margin: float = 0.3


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
        CalibrationError: the calibration has no T.
        ConfigError: the calibration is of another aspect ratio than the rig's streams.
        StaleFrameError: frames stopped coming, or came too late to act on.
    """
    calibration.hand_eye()  # refused now, and not when the first target is seen
    calibration = calibration.for_streams(rig.fixed.size, rig.zoom.size)
    tracker, policy = Tracker(settings_for(target), rig.fixed.size), FirstCome()
    state = rig.head.state()
    commanded = (state.pan, state.tilt, rig.zoom.zoom(rig.zoom.focal_range[0]))
    frame_t: float | None = None
    last_seen = -math.inf
    end, index = rig.clock.now() + seconds, 0
    while rig.clock.now() < end:
        frame = rig.fixed.read(newer_than=frame_t)
        interval = min(frame.t - frame_t, LONGEST_INTERVAL_S) if frame_t is not None else LONGEST_INTERVAL_S
        frame_t = frame.t
        detections = detector.detect(frame)
        tracks = tracker.update(detections, frame.t)
        chosen = policy.select(tracks)
        led: Lead | None = None
        mode, reason = State.SEARCHING, ""
        if chosen is not None:
            last_seen = frame.t if chosen.missed == 0 else last_seen
            mode = State.FOLLOWING if chosen.missed == 0 else State.COASTING
            if frame.t - last_seen > settings.zoom_out_after_s:
                mode, reason = State.LOST, f"out of sight for {frame.t - last_seen:.1f} s"
            else:
                try:
                    led = lead(rig, calibration, target, chosen, settings.command_delay_s, interval)
                except UnreachableError as error:
                    mode, reason = State.UNREACHABLE, str(error)
        if mode is not State.UNREACHABLE:
            commanded = _command(rig, led, commanded, settings)
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
            aim=None if led is None else led.aim,
            commanded=commanded,
            head=rig.head.state(),
            lens=rig.zoom.state(),
        )
        index += 1


@dataclass(frozen=True)
class Lead:
    """Where to send the head, and how far it is now from where the target is now [rad]."""

    aim: Aim
    way: float


def _command(
    rig: Rig, led: Lead | None, commanded: tuple[float, float, float], settings: FollowSettings
) -> tuple[float, float, float]:
    """Send head and lens after the target, or zoom out where there is none; return what is commanded now."""
    shortest = rig.zoom.focal_range[0]
    pan, tilt, focal = commanded
    if led is None:
        return pan, tilt, rig.zoom.zoom(shortest) if focal > shortest else focal
    pan, tilt = rig.head.move(led.aim.pan, led.aim.tilt)
    zoomed_out = focal <= shortest * (1 + settings.focal_deadband)
    if zoomed_out and led.way > math.radians(settings.centred_deg):
        nominal = shortest
    else:
        nominal = min(led.aim.nominal_px, _focal_while_turning(rig, led.way, settings.margin))
    return pan, tilt, _command_lens(rig, nominal, focal, settings.focal_deadband)


def lead(
    rig: Rig, calibration: Calibration, target: TargetConfig, track: Track, command_delay_s: float, interval_s: float
) -> Lead:
    """Aim so that the head keeps up with a track: the unit brakes to rest at every goal, so the goal lies ahead.

    At the next command's effect the head shall be where the target then is, and as fast; from there it needs
    its stopping distance, rate^2 / (2 acceleration), so that much further lies the goal.

    Args:
        rig: gives the time, the limits and where the head is.
        calibration: of that rig.
        target: the target's known size and the size wanted.
        track: in the fixed view.
        command_delay_s: from command to motion [s].
        interval_s: from one command to the next [s].

    Raises:
        UnreachableError: no pan and tilt within the limits do it.
    """
    limits, reach = rig.head.limits, reach_of(rig)
    closeup = Closeup(target.size, target.wanted_px, target.dimension == "height")
    upright = bool(track.size_px[1] > track.size_px[0])
    depth = depth_of(calibration, target, size_for(track, target.dimension), track.center_px, upright=upright)
    effect = rig.clock.now() + command_delay_s
    at_effect, after = (
        aim(calibration, point_at(calibration, track.predict(t), depth), reach, closeup=closeup)
        for t in (effect, effect + interval_s)
    )
    rates = [(after.pan - at_effect.pan) / interval_s, (after.tilt - at_effect.tilt) / interval_s]
    pan, tilt = (
        goal + stopping_distance(rate, limits) for goal, rate in zip((after.pan, after.tilt), rates, strict=True)
    )
    # Where the target is now lies one delay back from where it will be when the command takes effect.
    pan_now, tilt_now = reach.now
    way = math.hypot(
        at_effect.pan - rates[0] * command_delay_s - pan_now, at_effect.tilt - rates[1] * command_delay_s - tilt_now
    )
    return Lead(dataclasses.replace(after, pan=pan, tilt=tilt), way)


def reach_of(rig: Rig) -> Reach:
    """What a rig's head and lens can do, and where the head is."""
    limits, head = rig.head.limits, rig.head.state()
    return Reach(limits.pan, limits.tilt, rig.zoom.focal_range, (head.pan, head.tilt), limits.step)


def stopping_distance(rate: float, limits: PanTiltLimits) -> float:
    """How far an axis at that rate [rad/s] goes on while it brakes [rad], with the rate's sign."""
    rate = min(max(rate, -limits.speed), limits.speed)
    return rate * abs(rate) / (2 * limits.acceleration)


def _focal_while_turning(rig: Rig, way: float, margin: float) -> float:
    """The longest nominal focal length [px] that keeps the target well inside while the head has still to turn.

    Args:
        rig: gives the image's size and the lens's range.
        way: how far the head is from the target [rad].
        margin: part of the image's half height that the way may take.
    """
    shortest, longest = rig.zoom.focal_range
    half = margin * min(rig.zoom.size) / 2
    slope = math.tan(min(way, 1.5))  # [rad], short of a right angle
    return longest if slope * longest <= half else max(half / slope, shortest)


def _command_lens(rig: Rig, nominal_px: float, commanded_px: float, deadband: float) -> float:
    """Move the lens unless the change is too small to matter; return what it is commanded to."""
    if abs(math.log(nominal_px / commanded_px)) < deadband:
        return commanded_px
    return rig.zoom.zoom(nominal_px)
