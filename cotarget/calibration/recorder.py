"""Capture recorder: move head, lens and board, wait until they stand, and take the images of a calibration.

A rig whose zoom camera streams only a small preview records full stills instead (`with_stills`).
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from cotarget.board import board_points
from cotarget.calibration.captures import (
    INDEX,
    NO_IMAGE,
    CaptureIndex,
    write_command,
    write_image,
    write_index,
    write_session,
)
from cotarget.calibration.corners import find_corners
from cotarget.calibration.model import CameraName, Capture, Rejected, View, unseen
from cotarget.calibration.planning import Coverage
from cotarget.calibration.zoom_samples import same_focal
from cotarget.config import BoardConfig
from cotarget.errors import CalibrationError, EmergencyStopError, HaltedError, StaleFrameError
from cotarget.geometry import Array, RigidTransform, Rotation, pose_dict
from cotarget.rig import Clock, Frame, Image, PanTiltState, Rig, ZoomCamera, ZoomState

log = logging.getLogger(__name__)
# Requested poses are rounded to 0.1 mm and 0.1 mrad. The fits behind a plan sum in an order that varies with the
# threads; unrounded, their last digits would make two runs with the same seed diverge.
POSE_DECIMALS = 4
# Time after everything stands until an image counts [s], for vibrations and for an exposure that began before. The long
# one is for real cameras, whose latency is not measured yet, so that frames may be dated too late.
SETTLE, SETTLE_LONG = 0.05, 0.5
FRAME_TIMEOUT = 5.0  # several times the latency of a slow network camera [s]
# A board that a person holds is settled when its corners move by less than HELD_PX between two images HELD_FOR seconds
# apart, and by at least LEFT_PX since the request (mean over the corners). Both lengths grow with images wider than
# these, in which hands shake by more pixels.
HELD_PX, HELD_FOR, LEFT_PX, HELD_WIDTH = 0.3, 0.4, 8.0, 640
TRIES = 3  # of a turn or image: on a busy machine the watchdog may halt the head, and frames may be too old
LENS_TOLERANCE = 0.03  # relative to the focal length; a step of a usual lens is 0.02
# Finds a board's corners in an image, given the view to be filled, whose corners are still nan.
CornerFinder = Callable[[Image, View], Array | None]
Seen = TypeVar("Seen")


@dataclass(eq=False)
class CaptureRecorder:
    """Move head, lens and board, take images, and keep captures and views."""

    rig: Rig
    board: BoardConfig
    directory: Path | None = None  # folder for the captures; None to keep the corners only
    views: list[View] = field(default_factory=list)
    rejected: list[Rejected] = field(default_factory=list)  # images in which a board was expected but not found
    number: int = -1  # number of the present placement
    _captures: list[Capture] = field(default_factory=list)
    _still_since: float = 0.0
    _goal: tuple[float, float] | None = None

    @property
    def points(self) -> Array:
        """The board's corners in its frame [m], (N, 3)."""
        return board_points(self.board)

    def _wait_for(self, t: float) -> None:
        """Let images count only from a time on [s]."""
        self._still_since = max(self._still_since, t)

    def _settle(self, t: float) -> None:
        """Let images count from some time after everything stands [s]."""
        self._wait_for(t + (SETTLE_LONG if self.rig.spec.real_time else SETTLE))

    def start(self) -> None:
        """Make the folder for captures, send the lens to its shortest focal length and the head home."""
        if self.directory is not None:
            try:
                self.directory.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise CalibrationError(f"{self.directory}: cannot be made: {error.strerror}") from None
            if (self.directory / INDEX).exists():
                raise CalibrationError(f"{self.directory}: already holds captures; give another folder")
            write_session(self.directory, self.rig.config)
        self.zoom(self.rig.zoom.focal_range[0])
        self.turn(0.0, 0.0)

    def zoom(self, nominal_px: float) -> float:
        """Send the lens to a nominal focal length, wait until it stands, and return what it reports [px]."""
        clock = self.rig.clock
        begin, wanted = clock.now(), self.rig.zoom.zoom(nominal_px)
        self._log(begin, "zoom", nominal_px, wanted)
        clock.sleep_until(clock.now() + POLL)
        state = wait_for_lens(self.rig)
        if abs(np.log(state.focal_px / wanted)) > LENS_TOLERANCE:
            raise CalibrationError(
                f"the zoom lens stands at {state.focal_px:.0f} px where {wanted:.0f} px was commanded"
            )
        self._settle(state.t)
        return state.focal_px

    def present(self, T_fixed_board: RigidTransform) -> None:
        """Request the board at a pose as a new placement."""
        requested = RigidTransform.from_components(
            np.round(T_fixed_board.translation, POSE_DECIMALS),
            Rotation.from_rotvec(np.round(T_fixed_board.rotation.as_rotvec(), POSE_DECIMALS)),
        )
        before = self._fixed_corners() if self.rig.board.patience else None
        self._log(self.rig.clock.now(), "present", pose_dict(requested))
        self.rig.board.present(requested)
        if self.rig.board.patience:
            self._wait_until_held(before)
        self._settle(self.rig.clock.now())
        self.number += 1

    def _fixed_corners(self) -> Array | None:
        """Find the board's corners in a frame of the fixed camera exposed after now, (N, 2) [px], or None."""
        self._wait_for(self.rig.clock.now())
        frame = self._look(self._read_fixed)
        return find_corners(frame.image, self.board, thorough=False)

    def _wait_until_held(self, before: Array | None) -> None:
        """Wait until the board has moved from where it was seen ``before`` and is still, at most `Board.patience`."""
        clock, times = self.rig.clock, max(self.rig.fixed.size[0] / HELD_WIDTH, 1.0)
        deadline = clock.now() + self.rig.board.patience
        last = None
        while clock.now() < deadline:
            corners = self._fixed_corners()
            has_left = corners is not None and (before is None or _apart(corners, before) > LEFT_PX * times)
            if has_left and last is not None and corners is not None and _apart(corners, last) < HELD_PX * times:
                return
            last = corners
            clock.sleep_until(clock.now() + HELD_FOR)

    def turn(self, pan: float, tilt: float) -> None:
        """Turn the head and wait until it stands; send one that is halted on its way again, up to `TRIES` times in all.

        Raises:
            CalibrationError: the head stands elsewhere than commanded.
            HaltedError: the head was halted each time.
        """
        goal = self._goal = round(pan, POSE_DECIMALS), round(tilt, POSE_DECIMALS)
        for left in reversed(range(TRIES)):
            before = self.rig.head.state()
            begin = self.rig.clock.now()
            try:
                wanted = self.rig.head.move(*goal, wait=True)
            except HaltedError as error:
                self._log(begin, "turn", goal)
                if not left:
                    raise
                log.warning("%s; the head is sent again", error)
                continue
            self._log(begin, "turn", goal, wanted)
            way = max(abs(wanted[0] - before.pan), abs(wanted[1] - before.tilt))
            state, arrived = wait_for_head(self.rig, wanted, way)
            if arrived:
                self._settle(state.t)
                return
        raise CalibrationError(
            f"the head stands at pan {np.degrees(state.pan):z.2f}, tilt {np.degrees(state.tilt):z.2f} degrees "
            f"where pan {np.degrees(wanted[0]):z.2f}, tilt {np.degrees(wanted[1]):z.2f} was commanded"
        )

    def see_fixed(self, *, expected: bool = True) -> View | None:
        """Take an image with the fixed camera and find the board in it."""
        frame = self._look(self._read_fixed)
        return self._keep(Capture(frame.image, "fixed", self.number, t=frame.t), expected)

    def see_zoom(self, *, expected: bool = True, find: CornerFinder | None = None) -> View | None:
        """Take an image with the zoom camera and find the board in it.

        Where the board is ``expected``, the search is thorough, and an image without it is rejected.
        """
        frame, pose, lens = self._look(self._read_zoom)
        capture = Capture(frame.image, "zoom", self.number, pose.pan, pose.tilt, lens.focal_px, frame.t)
        return self._keep(capture, expected, find)

    def _look(self, look: Callable[[float], Seen]) -> Seen:
        """Read a frame; retry where it comes too late, with the head sent to its goal again, `TRIES` times in all."""
        for _ in range(TRIES - 1):
            try:
                return look(self._still_since)
            except StaleFrameError as error:
                log.warning("%s; looking again", error)
            if self._goal is not None:
                self.turn(*self._goal)
            self._wait_for(self.rig.clock.now())
        return look(self._still_since)

    def _read_fixed(self, newer_than: float) -> Frame:
        return self.rig.fixed.read(newer_than=newer_than, timeout=FRAME_TIMEOUT)

    def _read_zoom(self, newer_than: float) -> tuple[Frame, PanTiltState, ZoomState]:
        """Read a frame of the zoom camera, and the states of head and lens, which must stand."""
        frame = self.rig.zoom.read(newer_than=newer_than, timeout=FRAME_TIMEOUT)
        pose, lens = self.rig.head.state(), self.rig.zoom.state()
        if pose.moving or lens.moving:
            raise StaleFrameError("head or lens moved while the zoom camera took a calibration image")
        return frame, pose, lens

    def of_placement(self, number: int) -> Sequence[View]:
        """Select the views of one placement."""
        return [view for view in self.views if view.board == number]

    def save_index(self) -> None:
        """Write index.json with the captures so far."""
        if self.directory is not None and self._captures:
            write_index(self.directory, CaptureIndex(self.board, self.rig.spec.zoom.pitch_mm, tuple(self._captures)))

    def coverage(self, camera: CameraName, nominal_px: float | None = None) -> Coverage:
        """Count the corners that a camera has seen so far, at one nominal focal length [px] or at any."""
        found = Coverage((self.rig.fixed if camera == "fixed" else self.rig.zoom).size)
        for view in self.views:
            if view.camera == camera and (nominal_px is None or same_focal(view, nominal_px)):
                found.add(view.corners_px)
        return found

    def _log(self, t: float, do: str, asked: object, got: object = None) -> None:
        """Log a command, where captures are kept."""
        if self.directory is not None:
            write_command(self.directory, t, do, asked, got)

    def _keep(self, capture: Capture, expected: bool, find: CornerFinder | None = None) -> View | None:
        """Find the board in a capture; keep the image if the board was found or expected."""
        if find is None:
            corners = find_corners(capture.image, self.board, thorough=expected)
        else:
            corners = find(capture.image, capture.view(unseen(len(self.points))))
        if corners is None and not expected:
            return None
        name = f"{len(self._captures):04d}_{capture.camera}_board{capture.board:02d}.png"
        if self.directory is not None:
            write_image(self.directory / name, capture.image)
        self._captures.append(replace(capture, image=NO_IMAGE, source=name))
        self.save_index()
        if corners is None:
            self.rejected.append(Rejected(name, "the board was expected but not found"))
            return None
        view = replace(capture.view(corners), source=None if self.directory is None else name)
        self.views.append(view)
        return view


def _apart(a: Array, b: Array) -> float:
    """Compute the mean distance of the corners that both sets show [px]; infinite where there are none."""
    off = np.linalg.norm(a - b, axis=-1)
    shown = np.isfinite(off)
    return float(np.mean(off[shown])) if shown.any() else np.inf


# Waiting until head and lens stand

POLL = 0.02  # time between reads of a state [s]
HEAD_PATIENCE = 2.0  # timeout beyond what the way takes at the head's speed and acceleration [s]
POSE_TOLERANCE = np.radians(0.2)  # between commanded and reached angle, beyond the head's own tolerance [rad]
LENS_TIMEOUT = 15.0  # the slowest zoom lenses take some ten seconds from end to end [s]


def wait_for_lens(rig: Rig) -> ZoomState:
    """Wait until the zoom lens stands, and return its state."""
    clock = rig.clock
    deadline = clock.now() + LENS_TIMEOUT
    while (state := rig.zoom.state()).moving:
        if clock.now() > deadline:
            raise CalibrationError(f"the zoom lens still moves after {LENS_TIMEOUT:g} s")
        clock.sleep_until(clock.now() + POLL)
    return state


def wait_for_head(rig: Rig, wanted: tuple[float, float], way: float) -> tuple[PanTiltState, bool]:
    """Wait until the head stands where it was commanded [rad], or the timeout for its way there [rad] is over.

    Returns the head's state, and True if it has arrived.
    """
    head, clock = rig.head, rig.clock
    axes = head.limits.axes
    deadline = clock.now() + max(way / axis.speed + axis.braking_s for axis in axes) + HEAD_PATIENCE
    while True:
        state = head.state()
        arrived = not state.moving and all(
            abs(angle - goal) <= axis.tolerance + POSE_TOLERANCE
            for angle, goal, axis in zip((state.pan, state.tilt), wanted, axes, strict=True)
        )
        if arrived or clock.now() > deadline:
            return state, arrived
        if (reason := rig.stopped) is not None:
            raise EmergencyStopError(f"emergency stop: {reason}")
        clock.sleep_until(clock.now() + POLL)


# Full stills, for a zoom camera whose stream is only a small preview


def with_stills(rig: Rig) -> Rig:
    """Return a rig whose zoom camera takes full stills; the rig itself where stills have the stream's size."""
    if rig.zoom.still_size == rig.zoom.size:
        return rig
    zoom, factor = StillCamera(rig.zoom, rig.clock), rig.zoom.still_size[0] / rig.zoom.size[0]
    pitch_mm = rig.spec.zoom.pitch_mm and rig.spec.zoom.pitch_mm / factor
    spec = replace(rig.spec.zoom, size=zoom.size, focal_range=zoom.focal_range, pitch_mm=pitch_mm)
    return replace(rig, zoom=zoom, spec=replace(rig.spec, zoom=spec))


class StillCamera:
    """Zoom camera whose frames are full stills, with focal lengths in pixels of the still."""

    def __init__(self, camera: ZoomCamera, clock: Clock) -> None:
        self._camera, self._clock = camera, clock
        self._factor = camera.still_size[0] / camera.size[0]

    @property
    def size(self) -> tuple[int, int]:
        """Size of a frame, which is a still, (width, height) [px]."""
        return self._camera.still_size

    @property
    def still_size(self) -> tuple[int, int]:
        """Size of a still (width, height) [px]."""
        return self._camera.still_size

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest nominal focal length [px of a still]."""
        shortest, longest = self._camera.focal_range
        return shortest * self._factor, longest * self._factor

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Take a still, not before the time ``newer_than`` [s]. The camera may need any time for it.

        Raises:
            StaleFrameError: ``newer_than`` is more than ``timeout`` [s] from now.
        """
        if newer_than is not None:
            if (ahead := newer_than - self._clock.now()) > timeout:
                raise StaleFrameError(f"a still is wanted of {ahead:.2f} s from now, and within {timeout:g} s")
            self._clock.sleep_until(newer_than)
        return self._camera.capture()

    def zoom(self, focal_px: float) -> float:
        """Command the lens, and return the focal length that it will reach [px of a still]."""
        return self._camera.zoom(focal_px / self._factor) * self._factor

    def state(self) -> ZoomState:
        """Read the state of the lens, with the focal length in pixels of a still."""
        state = self._camera.state()
        return ZoomState(state.focal_px * self._factor, state.moving, state.t)

    def capture(self) -> Frame:
        """Take a still."""
        return self._camera.capture()
