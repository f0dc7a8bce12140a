"""Taking captures from a rig: everything stands still first, and every image goes to disk with how it was taken."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from cotarget.calibration.boards import find_corners
from cotarget.calibration.captures import INDEX, NO_IMAGE, CaptureIndex, file_name, write_image, write_index
from cotarget.calibration.model import Capture, Rejected, View, unseen
from cotarget.calibration.sessionlog import write_command, write_session
from cotarget.calibration.standing import POLL, wait_for_head, wait_for_lens
from cotarget.config import BoardConfig, RigConfig
from cotarget.errors import CalibrationError, HaltedError, StaleFrameError
from cotarget.geometry import Array, RigidTransform, Rotation, pose_dict
from cotarget.rig import Frame, Image, PanTiltState, Rig, ZoomState

log = logging.getLogger(__name__)

# Wishes are rounded to 0.1 mm and 0.1 mrad. Nobody holds a board better; and the fits behind a plan sum in an order
# that varies with the threads: their last digits would otherwise make two runs with the same seed drift apart.
WISH_DECIMALS = 4
# After a stop, for vibrations and for an exposure that had begun before [s]; and where nobody has measured yet by how
# much frames are dated too late.
SETTLE, SETTLE_LONG = 0.05, 0.5
FRAME_TIMEOUT = 5.0  # a slow network camera's latency, several times [s]
# A board in somebody's hands counts as held when its corners move less than this between two looks so far apart, and
# have moved at least so far since the wish (mean over the corners).
HELD_PX, HELD_FOR, LEFT_PX = 0.3, 0.4, 8.0
# Of a turn, and of an image: on a machine that is busy for a while the watchdog halts the head on its way, and frames
# are too old when they are read.
TRIES = 3
LENS_TOLERANCE = 0.03  # of the focal length; a step of a usual lens is 0.02


# Finds a board's corners in an image, given the view that it will be but for its corners.
Finder = Callable[[Image, View], Array | None]
Seen = TypeVar("Seen")


def view_of(capture: Capture, corners_px: Array) -> View:
    """The view that a capture becomes."""
    return View(
        capture.camera,
        corners_px,
        capture.board,
        capture.pan,
        capture.tilt,
        capture.focal_px,
        capture.t,
        capture.source,
    )


@dataclass(eq=False)
class Recorder:
    """A capture session's hands: it moves the head, presents the board, takes images and keeps what was seen.

    Attributes:
        rig: the rig.
        board: the board in use.
        directory: where captures go; None to keep the corners only.
        pitch_mm: size of a pixel of the zoom camera [mm], for the index.
        settle: how long after a stop an image is still taken for one of before [s].
        config: of the rig, to be kept beside the captures; None where a program made the rig otherwise.
        views: found so far.
        rejected: images in which a board was expected and not found.
        number: of the board's placement now.
    """

    rig: Rig
    board: BoardConfig
    directory: Path | None = None
    pitch_mm: float | None = None
    settle: float = SETTLE
    config: RigConfig | None = None
    views: list[View] = field(default_factory=list)
    rejected: list[Rejected] = field(default_factory=list)
    number: int = -1
    _captures: list[Capture] = field(default_factory=list)
    _still_since: float = 0.0
    _wish: tuple[float, float] | None = None

    def start(self) -> None:
        """Make the captures' folder, send the lens to its shortest focal length and the head home.

        Raises:
            CalibrationError: the folder holds captures already, or lens or head do not move.
        """
        if self.directory is not None:
            try:
                self.directory.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise CalibrationError(f"{self.directory}: cannot be made: {error.strerror}") from None
            if (self.directory / INDEX).exists():
                raise CalibrationError(f"{self.directory}: already holds captures; give another folder")
            write_session(self.directory, self.config)
        self.zoom(self.rig.zoom.focal_range[0])
        self.turn(0.0, 0.0)

    def zoom(self, nominal_px: float) -> float:
        """Send the lens to a focal length and wait until it stands; the one that it reached, by its own account [px].

        Raises:
            CalibrationError: the lens goes on moving, or does not reach what it said it would.
        """
        lens, clock = self.rig.zoom, self.rig.clock
        begin, wanted = clock.now(), lens.zoom(nominal_px)
        self._note(begin, "zoom", nominal_px, wanted)
        clock.sleep_until(clock.now() + POLL)
        state = wait_for_lens(self.rig)
        if abs(np.log(state.focal_px / wanted)) > LENS_TOLERANCE:
            raise CalibrationError(
                f"the zoom lens stands at {state.focal_px:.0f} px where {wanted:.0f} px was commanded"
            )
        self._still_since = max(self._still_since, state.t + self.settle)
        return state.focal_px

    def present(self, T_fixed_board: RigidTransform) -> int:
        """Ask for the board at a pose, as a new placement; its number."""
        wish = RigidTransform.from_components(
            np.round(T_fixed_board.translation, WISH_DECIMALS),
            Rotation.from_rotvec(np.round(T_fixed_board.rotation.as_rotvec(), WISH_DECIMALS)),
        )
        before = self._fixed_corners() if self.rig.board.patience else None
        self._note(self.rig.clock.now(), "present", pose_dict(wish))
        self.rig.board.present(wish)
        if self.rig.board.patience:
            self._wait_until_held(before)
        self._still_since = max(self._still_since, self.rig.clock.now() + self.settle)
        self.number += 1
        return self.number

    def _fixed_corners(self) -> Array | None:
        """Where the fixed camera sees the board now, in a frame that was exposed after now."""
        self._still_since = max(self._still_since, self.rig.clock.now())
        frame = self._look(self._read_fixed)
        return find_corners(frame.image, self.board, thorough=False)

    def _wait_until_held(self, before: Array | None) -> None:
        """Wait until the board has left where it was and stands still, at most for the holder's patience.

        Args:
            before: its corners in the fixed view before the wish, (N, 2) [px]; None where it was not seen.
        """
        clock = self.rig.clock
        deadline = clock.now() + self.rig.board.patience
        last = None
        while clock.now() < deadline:
            corners = self._fixed_corners()
            has_left = corners is not None and (before is None or _apart(corners, before) > LEFT_PX)
            if has_left and last is not None and corners is not None and _apart(corners, last) < HELD_PX:
                return
            last = corners
            clock.sleep_until(clock.now() + HELD_FOR)

    def turn(self, pan: float, tilt: float) -> None:
        """Turn the head and wait until it stands.

        One that was halted on its way is sent again, a few times; after an emergency stop the head refuses that.

        Raises:
            CalibrationError: it does not reach the pose that it said it would.
            HaltedError: it was halted each time.
        """
        wish = self._wish = round(pan, WISH_DECIMALS), round(tilt, WISH_DECIMALS)
        for left in reversed(range(TRIES)):
            before = self.rig.head.state()
            begin = self.rig.clock.now()
            try:
                wanted = self.rig.head.move(*wish, wait=True)
            except HaltedError as error:
                self._note(begin, "turn", wish)
                if not left:
                    raise
                log.warning("%s; the head is sent again", error)
                continue
            self._note(begin, "turn", wish, wanted)
            way = max(abs(wanted[0] - before.pan), abs(wanted[1] - before.tilt))
            state, arrived = wait_for_head(self.rig, wanted, way)
            if arrived:
                self._still_since = max(self._still_since, state.t + self.settle)
                return
        raise CalibrationError(
            f"the head stands at pan {np.degrees(state.pan):z.2f}, tilt {np.degrees(state.tilt):z.2f} degrees "
            f"where pan {np.degrees(wanted[0]):z.2f}, tilt {np.degrees(wanted[1]):z.2f} was commanded"
        )

    def see_fixed(self, *, expected: bool = True) -> View | None:
        """Take an image with the fixed camera and find the board in it."""
        frame = self._look(self._read_fixed)
        return self._keep(Capture(frame.image, "fixed", self.number, t=frame.t), expected)

    def see_zoom(self, *, expected: bool = True, find: Finder | None = None) -> View | None:
        """Take an image with the zoom camera where the head now stands and find the board in it.

        Args:
            expected: whether the board should be there, so that it is worth looking thoroughly.
            find: how to look for it: given the image, and the view that it will be but for its corners.
        """
        frame, pose, lens = self._look(self._read_zoom)
        capture = Capture(frame.image, "zoom", self.number, pose.pan, pose.tilt, lens.focal_px, frame.t)
        return self._keep(capture, expected, find)

    def _look(self, look: Callable[[float], Seen]) -> Seen:
        """Look, and look again, a few times, where what is seen comes too late.

        Each time the head is sent again to where it should stand; it stays there if nothing happened, and refuses after
        an emergency stop.

        Args:
            look: given the time [s] after which a frame must have been exposed.

        Raises:
            StaleFrameError: it came too late each time.
            EmergencyStopError: the head was stopped meanwhile.
        """
        for _ in range(TRIES - 1):
            try:
                return look(self._still_since)
            except StaleFrameError as error:
                log.warning("%s; looking again", error)
            if self._wish is not None:
                self.turn(*self._wish)
            self._still_since = max(self._still_since, self.rig.clock.now())
        return look(self._still_since)

    def _read_fixed(self, newer_than: float) -> Frame:
        return self.rig.fixed.read(newer_than=newer_than, timeout=FRAME_TIMEOUT)

    def _read_zoom(self, newer_than: float) -> tuple[Frame, PanTiltState, ZoomState]:
        """A frame of the zoom camera, and how head and lens stand."""
        frame = self.rig.zoom.read(newer_than=newer_than, timeout=FRAME_TIMEOUT)
        pose, lens = self.rig.head.state(), self.rig.zoom.state()
        if pose.moving or lens.moving:
            raise StaleFrameError("head or lens moved while the zoom camera took a calibration image")
        return frame, pose, lens

    def of_placement(self, number: int) -> Sequence[View]:
        """The views of one placement."""
        return [view for view in self.views if view.board == number]

    def save_index(self) -> None:
        """Bring index.json up to date."""
        if self.directory is not None and self._captures:
            write_index(self.directory, CaptureIndex(self.board, self.pitch_mm, tuple(self._captures)))

    def _note(self, t: float, do: str, asked: object, got: object = None) -> None:
        """Note a command, where captures are kept."""
        if self.directory is not None:
            write_command(self.directory, t, do, asked, got)

    def _keep(self, capture: Capture, expected: bool, find: Finder | None = None) -> View | None:
        """Find the board; keep the image where it was found, or should have been."""
        if find is None:
            corners = find_corners(capture.image, self.board, thorough=expected)
        else:
            corners = find(capture.image, view_of(capture, unseen(self.board.corners[0] * self.board.corners[1])))
        if corners is None and not expected:
            return None
        capture = replace(capture, source=file_name(capture, len(self._captures)))
        if self.directory is not None:
            assert capture.source is not None
            write_image(self.directory / capture.source, capture.image)
        capture = replace(capture, image=NO_IMAGE)
        self._captures.append(capture)
        self.save_index()
        if corners is None:
            self.rejected.append(Rejected(str(capture.source), "the board was expected but not found"))
            return None
        view = view_of(capture, corners)
        if self.directory is None:
            view = replace(view, source=None)
        self.views.append(view)
        return view


def _apart(a: Array, b: Array) -> float:
    """Mean distance between two findings of the same corners [px]."""
    return float(np.mean(np.linalg.norm(a - b, axis=-1)))
