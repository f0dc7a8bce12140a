"""Run the pipeline: detect, track, estimate, aim and command, and yield one `Step` per frame.

The pipeline sees only a `Rig`, so it is the same on every backend. Whatever records, draws, scores or prints consumes
Steps. `FrameSource` reads both cameras. The fixed camera sets the pace, and without it the run ends. The zoom camera
may fail for a moment, because its lens moves, its line is slow or it reconnects; the run goes on without it.
"""

import enum
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from numbers import Real
from types import MappingProxyType

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.calibration import Calibration
from cotarget.calibration.plausibility import check_plausible
from cotarget.config import Polygon, TargetProfile
from cotarget.control.controller import Controller, Predict
from cotarget.control.head import HeadSettings
from cotarget.control.orders import HOME, MANUAL_S, Order
from cotarget.control.policy import OnnxPolicy
from cotarget.control.selection import Chosen, FirstCome, TargetSelector, candidates_of
from cotarget.control.zoom import ZoomSettings, is_seen_well
from cotarget.detection import Detections, Detector, make_detector
from cotarget.detection.base import flood
from cotarget.errors import (
    ConfigError,
    DeviceError,
    EmergencyStopError,
    StaleFrameError,
    UnreachableError,
    choices,
    naming,
)
from cotarget.estimation import Appearance, Estimate, FilterSettings, filter_settings
from cotarget.estimation.zoom_matching import MatchingSettings, ZoomMeasurement
from cotarget.fusion import FusionSettings, MakeFinder, TargetFusion, ZoomSearch
from cotarget.rig import (
    FUTURE_S,
    READ_TIMEOUT_S,
    Camera,
    Clock,
    Detection,
    Frame,
    Image,
    PanTiltState,
    Rig,
    RigSpec,
    ZoomState,
    check_shown,
    opened_from,
)
from cotarget.targeting import Aim, target_implausibility
from cotarget.targets import Target
from cotarget.tracking.track import Track, TrackingSettings, tracking_settings
from cotarget.tracking.tracker import Expected, Tracker

# Longest wait for a zoom frame, except for the first, and pause after a fixed frame that repeats or jumps in time [s].
WAIT_S = 2e-3
# A fixed camera whose frames repeat or jump in time ends the run after this long, and a zoom camera that shows nothing
# new is reported [s]. Such frames are not acted on, and the watchdog halts a moving head meanwhile.
STALE_S = 0.5
# Time without a new zoom frame after which the run ends [s]: longer than the 5 s for which a driver tries to reconnect.
GONE_S = 10.0
# Colour of ignored regions in the image that the detector gets; see docs/design-notes.md.
MID_GREY = (128, 128, 128)
# Longest interval that counts as the period of commands [s]; a longer one was a gap between frames.
LONGEST_INTERVAL_S = 0.2
# Time for which the lens stays after a target's track has ended [s]: who comes out from behind something is mostly as
# far as before, and the lens takes a second each way.
LENS_WAITS_S = 2.0
HEAD = "head"  # name of the only head
MOVED = math.radians(0.2)  # least angle by which a standing head was moved by something else [rad]
Orders = Callable[[], Sequence[Order]]  # gives the orders of an operator that have come since the frame before


class FrameSource:
    """Read the newest frames of both cameras and report what is wrong with them.

    Args:
        fixed: the fixed camera.
        zoom: the zoom camera.
        clock: clock of the rig.

    Attributes:
        interval: time from the previous fixed frame to the newest [s]; inf for the first.
        zoom_is_new: whether the newest zoom frame has a new time and is not repeated; a repeated one counts as new
            while the fixed frames have been repeated too since it first came.
    """

    def __init__(self, fixed: Camera, zoom: Camera, clock: Clock) -> None:
        self._fixed, self._zoom, self._clock = fixed, zoom, clock
        self._fixed_frame: Frame | None = None
        self._zoom_frame: Frame | None = None
        # Times of fixed frames [s]: of the newest and of the first with its image; of those when the newest zoom frame
        # came and when the first with its image did.
        self._fixed_t = self._fixed_changed_t = self._zoom_t = self._zoom_changed_t = -math.inf
        self._zoom_fault = self._fixed_fault = ""
        self._read_t = -math.inf  # when it came, on the rig's clock [s]
        self._passed: int | None = None
        self.interval, self.zoom_is_new = math.inf, False

    def read_fixed(self) -> Frame:
        """Wait for the next frame of the fixed camera; skip repeated or impossible ones for `STALE_S`.

        Raises:
            StaleFrameError: no frame came, or none that is newer and not from the future for too long.
            DeviceError: the frame has another size.
        """
        self._fixed_fault, until, timeout = "", math.inf, READ_TIMEOUT_S
        while True:
            try:
                return self._next_fixed(timeout, until)
            except StaleFrameError as error:
                now = self._clock.now()
                if not self._fixed_fault:
                    until = now + STALE_S
                if self._fixed_frame is None or now - self._read_t >= READ_TIMEOUT_S or not now < until:
                    raise
                self._fixed_fault = str(error)
                self._clock.sleep_until(now + WAIT_S)
                timeout = until - now

    def _next_fixed(self, timeout: float, until: float) -> Frame:
        """Read the next fixed frame by a given time. Raises as `read_fixed` does, but at once."""
        before = self._fixed_frame
        frame = self._fixed.read(None if before is None else before.t, timeout)
        _check_size(frame, self._fixed, "fixed")
        if not frame.t > self._fixed_t:
            after = "" if before is None else f" after one of {before.t:.3f} s"
            raise StaleFrameError(
                f"the fixed camera gave a frame of {frame.t:.3f} s{after}: its frames repeat, or its clock has jumped"
            )
        now = self._clock.now()
        if (ahead := frame.t - now) > FUTURE_S:
            raise StaleFrameError(f"the fixed camera's frame is from {ahead:.2f} s in the future; mind the clock")
        if now > until:  # its times jumped back and have now reached the last one
            raise StaleFrameError(self._fixed_fault)
        if before is None or not frame.repeated:
            self._fixed_changed_t = frame.t
        self.interval = frame.t - self._fixed_t
        if before is None or before.number is None or frame.number is None:
            self._passed = None
        else:
            self._passed = frame.number - before.number - 1
        self._fixed_frame, self._fixed_t, self._read_t = frame, frame.t, now
        return frame

    def read_zoom(self) -> Frame:
        """Return the newest zoom frame, which may be an old one; wait for the first.

        Raises:
            StaleFrameError: no frame came at all, or no new one for `GONE_S`.
            DeviceError: the frame has another size.
        """
        before, self._zoom_fault = self._zoom_frame, ""
        try:
            frame = self._zoom.read() if before is None else self._zoom.read(timeout=WAIT_S)
        except StaleFrameError as error:
            if before is None:
                raise
            frame, self._zoom_fault = before, str(error)
        is_later = before is None or frame.t > before.t
        if is_later:
            _check_size(frame, self._zoom, "zoom")
            self._zoom_frame, self._zoom_t = frame, self._fixed_t
            if before is None or not frame.repeated:
                self._zoom_changed_t = self._fixed_t
        self.zoom_is_new = is_later and not self._fixed_changed_t > self._zoom_changed_t
        if before is None or is_later:
            return frame
        if self._fixed_t - self._zoom_t > GONE_S:
            raise StaleFrameError(self._describe_stale_zoom())
        return before

    def skipped(self, rate_hz: float) -> int:
        """Count the fixed frames between the last two that were read: by their numbers, or else by the rate."""
        if self._passed is not None:
            return self._passed
        return 0 if math.isinf(self.interval) else max(round(self.interval * rate_hz) - 1, 0)

    def faults(self) -> list[str]:
        """Describe what is wrong with the newest frames, one message each.

        Frames that are repeated for `READ_TIMEOUT_S` are reported.
        """
        found = []
        if self._fixed_fault:
            found.append(f"{self._fixed_fault}; this one is {self.interval:.2f} s after the last")
        if (same := self._fixed_t - self._fixed_changed_t) > READ_TIMEOUT_S:
            found.append(f"the fixed camera has shown the same picture for {same:.1f} s")
        if self._zoom_fault or self._fixed_t - self._zoom_t > STALE_S:
            found.append(self._describe_stale_zoom())
        elif (same := self._fixed_changed_t - self._zoom_changed_t) > READ_TIMEOUT_S:
            found.append(f"the zoom camera has shown the same picture for {same:.1f} s")
        return found

    def _describe_stale_zoom(self) -> str:
        """Describe for how long the zoom camera has shown nothing new, and why if that is known."""
        why = self._zoom_fault and f": {self._zoom_fault}"
        return f"the zoom camera has shown nothing new for {self._fixed_t - self._zoom_t:.1f} s{why}"


def _check_size(frame: Frame, camera: Camera, name: str) -> None:
    """Refuse a frame of another size, for which the calibration would be wrong.

    Raises:
        DeviceError: the frame has another size than the camera.
    """
    height, width = frame.image.shape[:2]
    if (width, height) != camera.size:
        was_width, was_height = camera.size
        raise DeviceError(
            f"the {name} camera gave a frame of {width}x{height}, and not of {was_width}x{was_height}: set it back, or "
            "open the rig again"
        )


class CameraRun:
    """Detect and track in one camera's frames.

    Attributes:
        ignored: regions in which nothing is detected, see `cotarget.config.FollowConfig`.
        tracks: tracks after the last frame; confirmed ones first, then by age.
    """

    def __init__(self, detector: Detector, tracker: Tracker, ignored: Sequence[Polygon] = ()) -> None:
        """Start without tracks."""
        self._detector, self._tracker, self.ignored = detector, tracker, ignored
        self.tracks: list[Track] = []

    def track(self, frame: Frame, expected: Expected = MappingProxyType({})) -> Detections:
        """Detect the targets of a frame, given the tracks after the last one, and update the tracks.

        Args:
            frame: frame of the camera.
            expected: where tracks are expected in it.
        """
        if self.ignored:
            image = frame.image.copy()
            for each in self.ignored:  # in one call, what two share would stay
                cv2.fillPoly(image, [outline_px(each, image)], MID_GREY)
            frame = replace(frame, image=image)
        found = self._detector.detect(frame, self.tracks)
        self.tracks = self._tracker.update(found.boxes, frame.t, found.shift, cut=found.cut, expected=expected)
        return found


def outline_px(polygon: Polygon, image: Image) -> npt.NDArray[np.int32]:
    """Corners of a polygon in parts of an image [px], (n, 2); 0 and 1 are the outer edges of its border's pixels."""
    height, width = image.shape[:2]
    return np.rint(np.array(polygon) * (width, height) - 0.5).astype(np.int32)


class State(enum.StrEnum):
    """State of the pipeline."""

    SEARCHING = "searching"  # nothing to follow; the lens zooms out, but not at once after a target was lost
    FOLLOWING = "following"  # the head follows the target
    UNCONFIRMED = "unconfirmed"  # following, but the zoom camera should have shown the target for seconds and has not
    COASTING = "coasting"  # the target is out of sight for a moment; the head follows its prediction
    LOST = "lost"  # out of sight for longer: the head goes on while the prediction is certain
    UNREACHABLE = "unreachable"  # the target is seen but cannot be aimed at
    STANDING = "standing"  # an operator lets head and lens stand; detection and tracks go on
    MANUAL = "manual"  # an operator moves the head or the lens by hand
    MOVED = "moved by others"  # the head should stand, and something else moves it


OPERATED = (State.STANDING, State.MANUAL, State.MOVED)  # states that only a run with an operator has


class Mode(enum.StrEnum):
    """What one head does: each is an operator's choice; a run without an operator follows."""

    FOLLOWING = "following"
    STANDING = "standing"
    MANUAL = "manual"


@dataclass(frozen=True)
class FollowSettings:
    """Settings of a run; each group belongs to one step of the method.

    Attributes:
        predict: whether to predict the target's motion; without it the head goes to where the target was seen.
        lost_after_s: how long a target may be out of sight before it is lost [s].
        closed_loop: whether the target is also registered in the zoom image.
        finder: makes the finder for the zoom image; by default `CloseupFinder` with `matching`.
        tracking: image filter, association and life cycle of tracks; by default those of the target profile.
        filter: motion and measurement noise of the target in 3D; by default those of the target profile.
        fusion: which tracks have a filter, and when the zoom image contradicts it.
        matching: registration in the zoom image.
        head: deadband and speed of the head.
        zoom: choice of the focal length.
        policy: a learnt policy, which drives head and lens while the target is seen; `head` and `zoom` then count while
            it is not.
    """

    predict: bool = True
    lost_after_s: float = 0.4
    closed_loop: bool = True
    finder: MakeFinder | None = None
    tracking: TrackingSettings | None = None
    filter: FilterSettings | None = None
    fusion: FusionSettings = field(default_factory=FusionSettings)
    matching: MatchingSettings = field(default_factory=MatchingSettings)
    head: HeadSettings = field(default_factory=HeadSettings)
    zoom: ZoomSettings = field(default_factory=ZoomSettings)
    policy: OnnxPolicy | None = None


@dataclass(frozen=True)
class Step:
    """Result of one frame.

    Attributes:
        index: number of the step, from 0.
        t: time at which it was done, on the rig's clock [s].
        state: state of the pipeline.
        reason: reason for that state, and warnings about what it acts on; may be empty.
        fixed: frame of the fixed camera.
        zoom: newest zoom frame at that time; an old one while the zoom camera gives none, see `reason`.
        mask: foreground of the detector, (H, W), or None.
        detections: detections in the fixed frame.
        tracks: tracks after these detections.
        target: the followed track.
        aim: the solved aim; None if nothing was aimed at.
        commanded: last command: pan, tilt [rad] and nominal focal length [px], after clipping and rounding.
        head: state of the head.
        lens: state of the lens.
        estimate: 3D estimate of the target at the time of the fixed frame.
        found: the target in the zoom image, if it was found. It belongs to this zoom frame, or to an earlier one whose
            time it has, if the fixed camera is later.
        expected: the target as it should appear in the zoom frame, at that frame's time; None if that is not known.
        head_commands: commands sent to the head since the run began.
        lens_commands: commands sent to the lens since the run began.
        skipped: frames of the fixed camera that were not worked on since the previous step, refused ones too; by its
            rate where nobody counts them.
        ignored: regions of the fixed frame in which nothing is detected.
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
    estimate: Estimate | None = None
    found: ZoomMeasurement | None = None
    expected: Appearance | None = None
    head_commands: int = 0
    lens_commands: int = 0
    skipped: int = 0
    ignored: Sequence[Polygon] = ()

    def __str__(self) -> str:
        """Say the time, the state with its reason, and the aim."""
        reason = f" ({self.reason})" if self.reason else ""
        return f"{self.t:.2f} s: {self.state}{reason}" + (f": {self.aim}" if self.aim is not None else "")


def follow(
    rig: Rig,
    calibration: Calibration,
    target: TargetProfile | str,
    detector: Detector | None = None,
    *,
    selector: TargetSelector | None = None,
    seconds: float = math.inf,
    settings: FollowSettings | None = None,
    insist: bool = False,
) -> Iterator[Step]:
    """Follow a target and yield one Step for each frame of the fixed camera.

    Missing arguments come from the configuration that the rig was opened from. This is a generator: errors are raised
    with the first step.

    Args:
        rig: any rig; the caller closes it.
        calibration: calibration of that rig.
        target: target profile, or its name in the rig's configuration.
        detector: detector for the fixed camera's images; by default the one that the target profile names.
        selector: selects the track to follow; by default the first that comes.
        seconds: duration on the rig's clock [s]; without an end by default.
        settings: settings of the run.
        insist: whether to accept an implausible calibration or target profile, see `check_run`.

    Raises:
        CalibrationError: see `check_run`.
        ConfigError: see `check_run`; or the target is unknown, the rig has no configuration to take it from, or an
            argument has the wrong type.
        StaleFrameError: frames of the fixed camera stopped coming, came too late to act on, or repeated; or the zoom
            camera showed nothing new for 10 s. Until then the run goes on without it, and every Step says so.
        DeviceError: a device failed, or its frames changed their size.
    """
    _check_seconds(seconds)
    name, profile = _profile(rig, target)
    check_run(calibration, rig.spec, profile, name, insist=insist)
    yield from Run(rig, calibration, profile, detector, selector=selector, settings=settings).follow(seconds)


def check_run(
    calibration: Calibration,
    spec: RigSpec,
    target: TargetProfile,
    name: str = "",
    *,
    insist: bool = False,
    files: tuple[object, object] = ("calibration", ""),
) -> None:
    """Refuse to follow with a calibration or a target that cannot be meant on a rig.

    Args:
        calibration: calibration of the rig.
        spec: the rig, open or as its configuration describes it.
        target: target profile.
        name: its name in the rig's configuration; empty where it has none.
        insist: whether to accept an implausible calibration or target profile.
        files: what messages call the calibration and the configuration.

    Raises:
        CalibrationError: the calibration has no T, or is implausible or another rig's.
        ConfigError: the calibration has another aspect ratio than the rig's streams, the simulated scene lacks the
            target, or its profile is implausible.
    """
    file, rig = files
    with naming(file):
        calibration.zoom_head.hand_eye()
        calibration.for_streams(spec.fixed.size, spec.zoom.size)
    check_plausible(calibration, spec, insist=insist, where=file)
    with naming(rig):
        if name:
            check_shown(spec, name)
        if not insist and (text := target_implausibility(target, calibration, spec, name)):
            raise ConfigError(f"{text}; insist=True follows it all the same")


def _check_seconds(seconds: object) -> None:
    if not (isinstance(seconds, Real) and float(seconds) > 0):
        raise ConfigError(f"follow: seconds is {seconds!r}; give a number greater than zero")


def _profile(rig: Rig, target: TargetProfile | str) -> tuple[str, TargetProfile]:
    """Return the name, empty where it has none, and the profile of a target.

    Raises:
        ConfigError: it is none, or is unknown.
    """
    if isinstance(target, TargetProfile):
        return "", target
    config = opened_from(rig)
    if not isinstance(target, str):
        raise ConfigError(
            f"follow: target is {target!r}; give a TargetProfile or one name, of: {choices(config.targets)}"
        )
    return target, config.target(target)


def _joined(reasons: Iterable[str]) -> str:
    """Join reasons by semicolons, which none then has in itself: tables and counts are split there."""
    return "; ".join(reason.replace("; ", ", ") for reason in reasons if reason)


Outcome = tuple[State, tuple[str, ...], Aim | None]  # state after a frame, the reasons for it, and the aim, if any


class HeadRun:
    """Select a target for one head, search it in the zoom image, and follow it.

    Attributes:
        head: newest state of the head.
        lens: newest state of the lens.
        controller: commands head and lens.
        search: search for the followed target in the zoom image.
        selector: selects the track to follow.
        mode: what the head does.
    """

    def __init__(
        self,
        rig: Rig,
        calibration: Calibration,
        profile: TargetProfile,
        selector: TargetSelector,
        settings: FollowSettings,
    ) -> None:
        """Start without a target."""
        self._rig, self._settings = rig, settings
        self.selector, self.policy, self.mode = selector, selector, Mode.FOLLOWING
        self._why, self._goes_home = "", False
        self._lost_t = -math.inf  # when the track of a followed target ended [s]
        self._rest: tuple[float, float] | None = None  # pan and tilt at which the head stands [rad]
        self._T_base_fixed = calibration.zoom_head.T_base_fixed
        self.search = ZoomSearch(
            calibration,
            profile,
            closed_loop=settings.closed_loop,
            finder=settings.finder,
            filter=settings.filter,
            matching=settings.matching,
            settings=settings.fusion,
        )
        self.controller = Controller(
            rig,
            calibration,
            head=settings.head,
            zoom=settings.zoom,
            predict=settings.predict,
            policy=settings.policy,
        )
        selector.start(rig.fixed.size)

    def read_states(self) -> None:
        """Read the states of head and lens."""
        self.head, self.lens = self._rig.head.state(), self._rig.zoom.state()
        self.search.states.add(self.head, self.lens)

    def select(self, targets: Iterable[Target]) -> Target | None:
        """Select the target to follow, and search it in the zoom image from the next frame on."""
        now, targets = self._rig.clock.now(), list(targets)
        for target in targets:
            if target.unreachable:  # it may have become reachable
                estimate = target.estimate(now)
                target.unreachable = estimate is not None and not self.controller.can_reach(estimate)
        head = np.array([self.head.pan, self.head.tilt])
        candidates = candidates_of(targets, now, self._T_base_fixed, self._rig.fixed.size)
        number = self.selector.select(candidates, head, self._rig.head.limits)
        found = next((target for target in targets if target.id == number), None)
        before = self.search.target
        if found is None and before is not None and before not in targets:
            self._lost_t = now
        self.search.search_for(found)
        return found

    def wait(self, found: Detections, tracks: Sequence[Track]) -> Outcome:
        """Zoom out while no target is followed, but not at once after one was lost; explain why none is."""
        if self._rig.clock.now() - self._lost_t >= LENS_WAITS_S:
            self.controller.zoom_out()
        if unmet := self.selector.unmet:
            return State.SEARCHING, (unmet,), None
        if tracks:
            return State.SEARCHING, ("what is detected is not confirmed yet",), None
        part = flood(found.mask)
        why = part and f": {part:.0%} of the fixed image changed at once, as when the light does or the camera moves"
        return State.SEARCHING, (f"nothing is detected{why or ''}",), None

    def aim_at(self, target: Target, t: float, interval: float) -> Outcome:
        """Aim at a target and command head and lens.

        Args:
            target: the followed target.
            t: time of the newest fixed frame [s].
            interval: time from one command to the next [s].
        """
        track = target.track
        self.count_seen_well(target, interval)
        if t - track.seen_t > self._settings.lost_after_s:
            reason, aim = self._follow_unseen(target.estimate, track.seen_t, interval)
            return State.LOST, (f"out of sight for {t - track.seen_t:.1f} s", reason), aim
        try:
            aim, zoom_reason = self.controller.drive(
                target.estimate, track.seen_t, interval, shape=track.shape, missed=track.missed > 0
            )
        except UnreachableError as error:
            target.unreachable = True
            return State.UNREACHABLE, (str(error),), None
        reasons = () if zoom_reason == "wanted" else (f"zoom: {zoom_reason}",)
        if track.missed:
            return State.COASTING, reasons, aim
        state = State.UNCONFIRMED if self.search.is_unconfirmed else State.FOLLOWING
        return state, reasons, aim

    def obey(self, order: Order) -> None:
        """Carry out an operator's order to this head.

        Raises:
            EmergencyStopError: the head is stopped, so it does not move.
        """
        self._why, self._goes_home = "", self._goes_home and order.kind == "zoom"
        match order.kind:
            case "follow":
                self._choose(order)
                self.mode = Mode.FOLLOWING
            case "stand":
                self.stand()
            case "manual":
                self.mode = Mode.MANUAL
                self.controller.turn(order.rates, MANUAL_S)
            case "zoom":
                if self.mode is not Mode.FOLLOWING:
                    self.controller.zoom_by(order.factor)
            case "home":
                self.mode, self._goes_home, self._why = Mode.MANUAL, True, "goes home"
                self.controller.go_to(*self._rig.head.limits.clip(*HOME))

    def _choose(self, order: Order) -> None:
        """Select what an order names; without a name, by the run's own policy."""
        if order.track is None and order.click is None:
            self.selector = self.policy
        else:
            self.selector = Chosen(number=order.track, pixel=order.click)
        self.selector.start(self._rig.fixed.size)

    def stand(self, why: str = "") -> None:
        """Halt the head, and let head and lens stand from now on."""
        self.mode, self._why, self._goes_home, self._rest = Mode.STANDING, why, False, None
        self.controller.stand()

    def rest(self) -> Outcome:
        """Leave a head alone that stands or is moved by hand; follow no target."""
        self.search.search_for(None)
        at = (self.head.pan, self.head.tilt)
        if self._goes_home and not self.head.moving and self._is_at(at, self.controller.commanded[:2]):
            self.mode, self._why, self._goes_home, self._rest = Mode.STANDING, "is at home", False, at
        if self.mode is Mode.MANUAL:
            return State.MANUAL, (self._why,), None
        moved = self._rest is not None and not self._is_at(at, self._rest)
        if not self.head.moving:
            self._rest = at
        return State.MOVED if moved else State.STANDING, (self._why,), None

    def _is_at(self, a: Sequence[float], b: Sequence[float]) -> bool:
        """Whether both axes are at the same angles, but for their tolerance."""
        axes = self._rig.head.limits.axes
        return all(abs(x - y) <= axis.tolerance + MOVED for x, y, axis in zip(a, b, axes, strict=True))

    def count_seen_well(self, target: Target, seconds: float) -> None:
        """Count a time [s] if the close-up shows a target well, by the states at the newest fixed frame's time."""
        track = target.track
        pose, estimate = self.search.states.interpolate(track.t), target.estimate(track.t)
        if pose is None or estimate is None or track.t - estimate.measured_t > self._settings.fusion.just_seen_s:
            return
        longest_px = self._rig.zoom.focal_range[1]
        if is_seen_well(estimate, pose.pan, pose.tilt, pose.nominal_px, longest_px, shape=track.shape):
            target.seen_well_s += seconds

    def _follow_unseen(self, predict: Predict, seen_t: float, interval: float) -> tuple[str, Aim | None]:
        """Point where a target out of sight should be; return what the head does, and the aim."""
        try:
            aim = self.controller.search(predict, seen_t, interval)
        except UnreachableError as error:
            return f"the head waits: {error}", None
        if aim is None:
            return "the head waits: where it is by now is not known well enough", None
        return "looked for where it should be", aim


class Run:
    """One run of the pipeline on a rig: a camera, the fusion, and a head.

    Attributes:
        camera: detects and tracks in the fixed camera's frames.
        fusion: keeps the targets with their 3D filters.
        head: follows one of the targets.
    """

    def __init__(
        self,
        rig: Rig,
        calibration: Calibration,
        target: TargetProfile,
        detector: Detector | None = None,
        *,
        selector: TargetSelector | None = None,
        settings: FollowSettings | None = None,
    ) -> None:
        """Start a run that `check_run` has let pass, and send the lens to its shortest focal length.

        The arguments are those of `cotarget.follow`.
        """
        detector = make_detector(target, rig.spec.fixed.rate_hz) if detector is None else detector
        calibration = calibration.for_streams(rig.fixed.size, rig.zoom.size)
        selector, settings = selector or FirstCome(), settings or FollowSettings()
        settings = replace(settings, filter=settings.filter or filter_settings(target, calibration))
        self._rig = rig
        self._orders: Orders | None = None
        self._frames = FrameSource(rig.fixed, rig.zoom, rig.clock)
        tracker = Tracker(settings.tracking or tracking_settings(target), rig.fixed.size)
        self.camera = CameraRun(detector, tracker, () if rig.config is None else rig.config.follow.ignored)
        self.fusion = TargetFusion(calibration, target, settings.filter, settings.fusion)
        self.head = HeadRun(rig, calibration, target, selector, settings)
        self._index = 0

    def follow(self, seconds: float = math.inf, orders: Orders | None = None) -> Iterator[Step]:
        """Yield one Step for each frame of the fixed camera.

        Args:
            seconds: duration on the rig's clock [s].
            orders: gives an operator's orders. With them an emergency stop lets the heads stand and the run goes on.
        """
        self._orders = orders
        end = self._rig.clock.now() + seconds
        while self._rig.clock.now() < end:
            yield self.step()

    def step(self) -> Step:
        """Process one frame of the fixed camera, in the order of the paper's Table 1."""
        frames, head = self._frames, self.head
        shown = frames.read_fixed()
        frame = replace(shown, t=shown.t - head.search.correct_clock())
        detections = self.camera.track(frame, self.fusion.expected(head.search.target, frame.t))
        tracks = self.camera.tracks
        favoured = {track.id for track in tracks if head.selector.favours(track)}
        self.fusion.add_shift(detections.shift, cut=detections.cut)
        self.fusion.add_tracks(frame, tracks, detections.mask, [head.search], favoured)
        head.read_states()
        zoom = frames.read_zoom()
        found = head.search.add_frame(zoom if frames.zoom_is_new else None, frame.t)
        target, (state, reasons, aim) = self._act(frame, detections)
        head.read_states()
        estimate = None if target is None else target.estimate(frame.t)
        self._index += 1
        return Step(
            index=self._index - 1,
            t=self._rig.clock.now(),
            state=state,
            reason=_joined([*reasons, *head.search.warnings(estimate), *self.fusion.warnings(), *frames.faults()]),
            fixed=shown,
            zoom=zoom,
            mask=detections.mask,
            detections=tuple(detections.boxes),
            tracks=tuple(tracks),
            target=None if target is None else target.track,
            aim=aim,
            commanded=head.controller.commanded,
            head=head.head,
            lens=head.lens,
            estimate=estimate,
            found=found,
            expected=None if target is None else head.search.expect(zoom.t),
            head_commands=head.controller.head_commands,
            lens_commands=head.controller.lens_commands,
            skipped=frames.skipped(self._rig.spec.fixed.rate_hz),
            ignored=self.camera.ignored,
        )

    def _act(self, frame: Frame, detections: Detections) -> tuple[Target | None, Outcome]:
        """Obey the orders, then follow, stand or move by hand; return the followed target too."""
        head = self.head
        try:
            for order in () if self._orders is None else self._orders():
                self._obey(order)
            if head.mode is not Mode.FOLLOWING:
                return None, head.rest()
            target = head.select(self.fusion.targets.values())
            if target is None:
                return None, head.wait(detections, self.camera.tracks)
            return target, head.aim_at(target, frame.t, min(self._frames.interval, LONGEST_INTERVAL_S))
        except EmergencyStopError as error:
            if self._orders is None:
                raise
            head.stand(str(error))
            return None, head.rest()

    def _obey(self, order: Order) -> None:
        """Carry out an order to the rig or to a head."""
        if order.kind == "stop":
            if self._rig.stopped is None:
                self._rig.stop(order.reason)
            self.head.stand(order.reason)
        elif order.kind == "clear":
            self.head.stand("the stop was cleared")
            self._rig.clear()
        elif order.of in ("", HEAD):
            self.head.obey(order)
