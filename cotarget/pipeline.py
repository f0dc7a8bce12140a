"""The one pipeline: look, detect, track, aim, command; yields one Step a frame and knows no backend.

Everything that records, draws, scores or prints consumes Steps.

Looking through both cameras: what can be acted on, and what is wrong with it, in words.

The wide camera sets the pace, and without it nothing can be done. The zoom camera may be blind for a moment, because
its lens moves, its line is slow or it is lost and found again: the wide view is followed all the same.
"""

import enum
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import RigConfig, TargetConfig
from cotarget.control.controller import Controller, ControllerSettings, Predict
from cotarget.control.selection import FirstCome, Policy
from cotarget.control.zoom import shape_of
from cotarget.detection import Detection, Detector, make_detector
from cotarget.detection.base import flood
from cotarget.errors import DeviceError, StaleFrameError, UnreachableError
from cotarget.estimation import Estimate
from cotarget.estimation.zoom_matching import CloseupFinder, ZoomMeasurement
from cotarget.fusion import MakeFinder, TargetFusion
from cotarget.rig import Camera, Clock, Frame, Image, PanTiltState, Rig, ZoomState, opened_from
from cotarget.safety.safe_rig import FUTURE_S
from cotarget.targeting import Aim
from cotarget.tracking.track import Track, settings_for
from cotarget.tracking.tracker import Tracker

# Longer than this nobody waits for a zoom frame that is not there yet, but for the first [s].
ZOOM_WAIT_S = 2e-3
# Frames of the wide camera that repeat, or whose times jump, may do so for that long [s]. Nobody steers by them, and
# a head that moves is halted meanwhile, by the watchdog; so often they are asked for anew [s].
REPEATED_S, AGAIN_S = 0.5, 5e-3
# So long a camera waits for a frame by itself [s]; if none has come by then, none will.
PATIENCE_S = 1.0
# A zoom camera that gives the same frame for so long shows nothing new [s] ...
BLIND_S = 0.5
# ... and after so long it is gone [s]: longer than a driver that has lost its camera looks for it, which is 5 s.
GONE_S = 10.0
# Pictures of a live camera differ by their noise; one that stays the same to the last bit for so long is old [s].
FROZEN_S = 1.0
ROWS = 16  # every so many rows of a picture are compared first; where one differs, it is another picture


class FrameSource:
    """The newest frames of both cameras.

    Args:
        fixed: the wide camera.
        zoom: the zoom camera.
        clock: the rig's.

    Attributes:
        interval: from the wide frame before to the newest [s]; inf for the first.
        zoom_is_new: whether the newest zoom frame shows what was not seen before: another time, and another picture,
            but where the wide view has not changed either since that picture came first.
    """

    def __init__(self, fixed: Camera, zoom: Camera, clock: Clock) -> None:
        self._fixed, self._zoom, self._clock = fixed, zoom, clock
        self._wide: Frame | None = None
        self._close: Frame | None = None
        # By the times of wide frames:
        self._now = self._picture_t = self._close_t = self._shown_t = -math.inf
        self._why_blind = self._why_late = ""
        self._looked_t = -math.inf  # by the rig's clock
        self.interval, self.zoom_is_new = math.inf, False

    def read_fixed(self) -> Frame:
        """Wait for the next wide frame; those that repeat or cannot be true are passed over for a while.

        Raises:
            StaleFrameError: there is none, or for too long none that is newer, and not from later than now.
            DeviceError: it is of another size.
        """
        self._why_late, until, timeout = "", math.inf, PATIENCE_S
        while True:
            try:
                return self._next_wide(timeout, until)
            except StaleFrameError as error:
                now = self._clock.now()
                if not self._why_late:
                    until = now + REPEATED_S
                if self._wide is None or now - self._looked_t >= PATIENCE_S or not now < until:
                    raise
                self._why_late = str(error)
                self._clock.sleep_until(now + AGAIN_S)
                timeout = until - now

    def _next_wide(self, timeout: float, until: float) -> Frame:
        """The next wide frame, by a time. Raises as `read_fixed` does, but at once."""
        before = self._wide
        frame = self._fixed.read(None if before is None else before.t, timeout)
        _check_size(frame, self._fixed, "fixed")
        if not frame.t > self._now:
            after = "" if before is None else f" after one of {before.t:.3f} s"
            raise StaleFrameError(
                f"the fixed camera gave a frame of {frame.t:.3f} s{after}: its frames repeat, or its clock has jumped"
            )
        now = self._clock.now()
        if (ahead := frame.t - now) > FUTURE_S:
            raise StaleFrameError(f"the fixed camera's frame is from {ahead:.2f} s in the future; mind the clock")
        if now > until:  # its times have jumped back, and have now come up with the last one
            raise StaleFrameError(self._why_late)
        if before is None or not _same(frame.image, before.image):
            self._picture_t = frame.t
        self.interval = frame.t - self._now
        self._wide, self._now, self._looked_t = frame, frame.t, now
        return frame

    def read_zoom(self) -> Frame:
        """The newest zoom frame, which may be an old one; the first is waited for.

        Raises:
            StaleFrameError: there has been none at all, or no new one for so long that there will be none.
            DeviceError: it is of another size.
        """
        before, self._why_blind = self._close, ""
        try:
            frame = self._zoom.read() if before is None else self._zoom.read(timeout=ZOOM_WAIT_S)
        except StaleFrameError as error:
            if before is None:
                raise
            frame, self._why_blind = before, str(error)
        is_later = before is None or frame.t > before.t
        if is_later:
            _check_size(frame, self._zoom, "zoom")
            self._close, self._close_t = frame, self._now
            if before is None or not _same(frame.image, before.image):
                self._shown_t = self._now
        self.zoom_is_new = is_later and not self._picture_t > self._shown_t
        if before is None or is_later:
            return frame
        if self._now - self._close_t > GONE_S:
            raise StaleFrameError(self._blindness())
        return before

    def troubles(self) -> list[str]:
        """What is wrong with the newest frames."""
        found = []
        if self._why_late:
            found.append(f"{self._why_late}; this one is {self.interval:.2f} s after the last")
        if (same := self._now - self._picture_t) > FROZEN_S:
            found.append(f"the fixed camera has shown the same picture for {same:.1f} s")
        if self._why_blind or self._now - self._close_t > BLIND_S:
            found.append(self._blindness())
        elif (same := self._picture_t - self._shown_t) > FROZEN_S:
            found.append(f"the zoom camera has shown the same picture for {same:.1f} s")
        return found

    def _blindness(self) -> str:
        """For how long the zoom camera has shown nothing new, and why, where it says so."""
        why = self._why_blind and f": {self._why_blind}"
        return f"the zoom camera has shown nothing new for {self._now - self._close_t:.1f} s{why}"


def _check_size(frame: Frame, camera: Camera, name: str) -> None:
    """Refuse a frame of another size: the calibration would put everything in it elsewhere.

    Raises:
        DeviceError: it is.
    """
    height, width = frame.image.shape[:2]
    if (width, height) != camera.size:
        was_width, was_height = camera.size
        raise DeviceError(
            f"the {name} camera gave a frame of {width}x{height}, and not of {was_width}x{was_height}: set it back, or "
            "open the rig anew"
        )


def _same(a: Image, b: Image) -> bool:
    """Whether two pictures of a camera are the same to the last bit."""
    return a is b or (np.array_equal(a[::ROWS], b[::ROWS]) and np.array_equal(a, b))


# Longest interval between frames that is taken for the rhythm of commands [s]; a longer one was a gap.
LONGEST_INTERVAL_S = 0.2


class State(enum.StrEnum):
    """What the loop is doing."""

    SEARCHING = "searching"  # nothing to follow; the lens is at its shortest
    FOLLOWING = "following"  # the head follows the target
    COASTING = "coasting"  # the target is out of sight for a moment; the head follows its prediction
    LOST = "lost"  # out of sight for longer: the lens zooms out, the head goes on as long as it is known where to
    UNREACHABLE = "unreachable"  # the target is seen but cannot be aimed at


@dataclass(frozen=True)
class FollowSettings(ControllerSettings):
    """How the loop follows, and how it drives head and lens.

    Attributes:
        zoom_out_after_s: how long a target may be out of sight before the lens zooms out [s].
        closed_loop: whether the target is looked for in the zoom view too.
        finder: makes what looks for it there.
        policy: makes, for each run, what decides which of several targets is followed; the first by default.
    """

    zoom_out_after_s: float = 0.4
    closed_loop: bool = True
    finder: MakeFinder = CloseupFinder
    policy: Callable[[], Policy] = FirstCome

    @classmethod
    def of(cls, config: RigConfig, **changes: Any) -> "FollowSettings":
        """The settings for a rig: how late its head and lens obey, and whatever else is given by name."""
        return cls(command_delay_s=config.command_delay_s, lens_delay_s=config.lens_delay_s, **changes)


@dataclass(frozen=True)
class Step:
    """One turn of the loop.

    Attributes:
        index: from 0.
        t: when it was done, on the rig's clock [s].
        state: what the loop was doing, and
        reason: why, where that needs words, and what is wrong with what it acts on.
        fixed: the frame that it acted on.
        zoom: the newest zoom frame at that time; an old one while the zoom camera is blind, which `reason` says.
        mask: the detector's foreground, (H, W), or None.
        detections: in the fixed frame.
        tracks: after them.
        target: the track that is followed.
        aim: what was solved; None when nothing was aimed at.
        commanded: pan, tilt [rad] and nominal focal length [px] as really commanded last.
        head: the head's state.
        lens: the lens's state.
        estimate: of the target in 3D, for the time of the fixed frame.
        found: the target in the zoom view, where it was looked for and found; that is in this Step's zoom frame, or in
            an earlier one, of the time that `found` says, where the wide view comes later.
        head_commands: how many the head was sent since the run began.
        lens_commands: how many the lens was sent.
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
    head_commands: int = 0
    lens_commands: int = 0


def follow(
    rig: Rig,
    calibration: Calibration,
    target: TargetConfig | str,
    detector: Detector | None = None,
    *,
    seconds: float = math.inf,
    settings: FollowSettings | None = None,
) -> Iterator[Step]:
    """Follow a target and yield one Step for each frame of the fixed camera.

    What is left out comes from the configuration that the rig was opened from.

    Args:
        rig: any rig; the caller closes it.
        calibration: of that rig.
        target: what to follow, or its name in the rig's configuration.
        detector: finds it in the fixed camera's image; by default the one that the target's configuration names.
        seconds: for how long on the rig's clock [s].
        settings: delays and habits; by default the delays of the rig's configuration.

    Raises:
        CalibrationError: the calibration has no T.
        ConfigError: the target is unknown, the rig has no configuration to take it from, or the calibration is of
            another aspect ratio than the rig's streams.
        StaleFrameError: frames of the fixed camera stopped coming, or came too late to act on, or again; or the zoom
            camera shows nothing new for 10 s. Until then the wide view alone is followed, and every Step says so.
        DeviceError: a device failed; frames have another size than before among others.
    """
    calibration.hand_eye()  # refused now, and not when the first target is seen
    wanted = opened_from(rig).target(target) if isinstance(target, str) else target
    if detector is None:
        detector = make_detector(wanted, opened_from(rig).rate_hz)
    if settings is None:
        settings = FollowSettings.of(opened_from(rig))
    fitting = calibration.for_streams(rig.fixed.size, rig.zoom.size)
    loop = _Loop(rig, fitting, wanted, detector, settings)
    end = rig.clock.now() + seconds
    while rig.clock.now() < end:
        yield loop.turn()


class _Loop:
    """One run of `follow`."""

    def __init__(
        self, rig: Rig, calibration: Calibration, target: TargetConfig, detector: Detector, settings: FollowSettings
    ) -> None:
        self._rig, self._detector, self._settings = rig, detector, settings
        self._tracker = Tracker(settings_for(target), rig.fixed.size)
        self._fusion = TargetFusion(
            calibration, target, rig.fixed.size, closed_loop=settings.closed_loop, finder=settings.finder
        )
        self._controller = Controller(rig, calibration, settings)
        self._frames = FrameSource(rig.fixed, rig.zoom, rig.clock)
        self._beyond: set[int] = set()  # tracks that could not be aimed at
        self._policy = settings.policy()
        self._seen_t: dict[int, float] = {}  # when each track was seen last
        self._index = 0

    def turn(self) -> Step:
        """One frame of the fixed camera."""
        rig, fusion = self._rig, self._fusion
        frame = self._frames.read_fixed()
        interval = min(self._frames.interval, LONGEST_INTERVAL_S)
        detections = self._detector.detect(frame)
        tracks = self._tracker.update(detections, frame.t)
        self._seen_t = {each.id: self._seen_t.get(each.id, frame.t) if each.missed else frame.t for each in tracks}
        favoured = {track.id for track in tracks if self._policy.favours(track)}
        fusion.update_fixed(frame, tracks, self._detector.mask, favoured)
        self._read_states()
        zoom = self._frames.read_zoom()
        found = fusion.update_zoom(zoom if self._frames.zoom_is_new else None, frame.t)
        chosen = self._choose(tracks)
        if chosen is None:
            self._controller.zoom_out()
            mode, reason, aim = State.SEARCHING, self._why_searching(tracks), None
        else:
            fusion.count_seen_well(chosen, interval, rig.zoom.focal_range[1])
            mode, reason, aim = self._drive(chosen, frame.t, interval)
        self._read_states()
        warnings = [] if chosen is None else fusion.warnings(chosen.id, frame.t)
        step = Step(
            index=self._index,
            t=rig.clock.now(),
            state=mode,
            reason="; ".join(filter(None, [reason, *warnings, *self._frames.troubles()])),
            fixed=frame,
            zoom=zoom,
            mask=self._detector.mask,
            detections=tuple(detections),
            tracks=tuple(tracks),
            target=chosen,
            aim=aim,
            commanded=self._controller.commanded,
            head=self._head,
            lens=self._lens,
            estimate=None if chosen is None else fusion.estimate(chosen.id, frame.t),
            found=found,
            head_commands=self._controller.head_commands,
            lens_commands=self._controller.lens_commands,
        )
        self._index += 1
        return step

    def _read_states(self) -> None:
        """Ask the devices where they are."""
        self._head, self._lens = self._rig.head.state(), self._rig.zoom.state()
        self._fusion.states.add(self._head, self._lens)

    def _why_searching(self, tracks: list[Track]) -> str:
        """Why nobody is followed."""
        if unmet := self._policy.unmet:
            return unmet
        if not tracks:
            part = flood(self._detector.mask)
            why = part and f": {part:.0%} of the wide view changed at once, as when the light does or the camera moves"
            return f"nothing is detected{why or ''}"
        return "what is detected is not believed yet"

    def _choose(self, tracks: list[Track]) -> Track | None:
        """Whom to follow."""
        now = self._rig.clock.now()
        candidates = self._fusion.candidates(tracks, now)
        if self._beyond:  # whoever could not be aimed at may have come nearer
            estimates = {number: self._fusion.estimate(number, now) for number in self._beyond}
            self._beyond = {
                n for n, each in estimates.items() if each is not None and not self._controller.can_reach(each)
            }
            candidates = [replace(each, reachable=each.id not in self._beyond) for each in candidates]
        head = np.array([self._head.pan, self._head.tilt])
        number = self._policy.select(candidates, head, self._rig.head.limits)
        self._fusion.follow(number)
        return next((track for track in tracks if track.id == number), None)

    def _drive(self, chosen: Track, t: float, interval: float) -> tuple[State, str, Aim | None]:
        """Command head and lens; what the loop is doing then, why, and what was aimed at."""
        seen_t = self._seen_t[chosen.id]
        if t - seen_t > self._settings.zoom_out_after_s:
            reason, aim = self._search(chosen, seen_t, interval)
            return State.LOST, f"out of sight for {t - seen_t:.1f} s; {reason}", aim
        try:
            drive = self._controller.drive(self._predict(chosen), seen_t, interval, shape=shape_of(chosen))
        except UnreachableError as error:
            self._beyond.add(chosen.id)
            return State.UNREACHABLE, str(error), None
        zoom = "" if drive.zoom_reason == "wanted" else f"zoom: {drive.zoom_reason}"
        return State.COASTING if chosen.missed else State.FOLLOWING, zoom, drive.aim

    def _search(self, chosen: Track, seen_t: float, interval: float) -> tuple[str, Aim | None]:
        """Look for a target that is out of sight; what the head does, and what it is aimed at."""
        try:
            aim = self._controller.search(self._predict(chosen), seen_t, interval)
        except UnreachableError as error:
            return f"the head waits: {error}", None
        if aim is None:
            return "the head waits: where it is by now is not known well enough", None
        return "looked for where it should be", aim

    def _predict(self, chosen: Track) -> Predict:
        """The target at any time."""
        return lambda t: self._fusion.estimate(chosen.id, t)
