"""Taking captures from a rig: everything stands still first, and every image goes to disk with how it was taken."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from cotarget.calibration.boards import find_corners
from cotarget.calibration.captures import INDEX, NO_IMAGE, CaptureIndex, file_name, write_image, write_index
from cotarget.calibration.model import Capture, Rejected, View
from cotarget.config import BoardConfig
from cotarget.errors import CalibrationError, DeviceError
from cotarget.geometry import RigidTransform, Rotation
from cotarget.rig import Rig

# Wishes are rounded to 0.1 mm and 0.1 mrad. Nobody holds a board better; and the fits behind a plan sum in an order
# that varies with the threads: their last digits would otherwise make two runs with the same seed drift apart.
WISH_DECIMALS = 4
SETTLE = 0.05  # after a stop, for vibrations and for an exposure that had begun before [s]
POLL = 0.02  # between looks at a state [s]
FRAME_TIMEOUT = 5.0  # a slow network camera's latency, several times [s]
HEAD_PATIENCE = 2.0  # beyond what the way takes at the head's own speed and acceleration [s]
LENS_TIMEOUT = 15.0  # the slowest zoom lenses take some ten seconds from end to end [s]
POSE_TOLERANCE = np.radians(0.2)  # between commanded and reached, above the head's own step [rad]


@dataclass(eq=False)
class Recorder:
    """A capture session's hands: it moves the head, presents the board, takes images and keeps what was seen.

    Attributes:
        rig: the rig.
        board: the board in use.
        directory: where captures go; None to keep the corners only.
        pitch_mm: size of a pixel of the zoom camera [mm], for the index.
        views: found so far.
        rejected: images in which a board was expected and not found.
        number: of the board's placement now.
    """

    rig: Rig
    board: BoardConfig
    directory: Path | None = None
    pitch_mm: float | None = None
    views: list[View] = field(default_factory=list)
    rejected: list[Rejected] = field(default_factory=list)
    number: int = -1
    _captures: list[Capture] = field(default_factory=list)
    _still_since: float = 0.0

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
        rig = self.rig
        rig.zoom.zoom(rig.zoom.focal_range[0])
        deadline = rig.clock.now() + LENS_TIMEOUT
        rig.clock.sleep_until(rig.clock.now() + POLL)
        while rig.zoom.state().moving:
            if rig.clock.now() > deadline:
                raise CalibrationError(f"the zoom lens still moves after {LENS_TIMEOUT:g} s")
            rig.clock.sleep_until(rig.clock.now() + POLL)
        self.turn(0.0, 0.0)

    def present(self, T_fixed_board: RigidTransform) -> int:
        """Ask for the board at a pose, as a new placement; its number."""
        self.save_index()
        wish = RigidTransform.from_components(
            np.round(T_fixed_board.translation, WISH_DECIMALS),
            Rotation.from_rotvec(np.round(T_fixed_board.rotation.as_rotvec(), WISH_DECIMALS)),
        )
        self.rig.board.present(wish)
        self._still_since = max(self._still_since, self.rig.clock.now() + SETTLE)
        self.number += 1
        return self.number

    def turn(self, pan: float, tilt: float) -> None:
        """Turn the head and wait until it stands.

        Raises:
            CalibrationError: it does not reach the pose that it said it would.
        """
        head, clock = self.rig.head, self.rig.clock
        before = head.state()
        wanted = head.move(round(pan, WISH_DECIMALS), round(tilt, WISH_DECIMALS), wait=True)
        way = max(abs(wanted[0] - before.pan), abs(wanted[1] - before.tilt))
        limits = head.limits
        deadline = clock.now() + way / limits.speed + limits.speed / limits.acceleration + HEAD_PATIENCE
        tolerance = limits.step + POSE_TOLERANCE
        while True:
            state = head.state()
            off = max(abs(state.pan - wanted[0]), abs(state.tilt - wanted[1]))
            if not state.moving and off <= tolerance:
                break
            if clock.now() > deadline:
                raise CalibrationError(
                    f"the head stands at pan {np.degrees(state.pan):.2f}, tilt {np.degrees(state.tilt):.2f} degrees "
                    f"where pan {np.degrees(wanted[0]):.2f}, tilt {np.degrees(wanted[1]):.2f} was commanded"
                )
            clock.sleep_until(clock.now() + POLL)
        self._still_since = max(self._still_since, state.t + SETTLE)

    def see_fixed(self, *, expected: bool = True) -> View | None:
        """Take an image with the fixed camera and find the board in it."""
        frame = self.rig.fixed.read(newer_than=self._still_since, timeout=FRAME_TIMEOUT)
        return self._keep(Capture(frame.image, "fixed", self.number, t=frame.t), expected)

    def see_zoom(self, *, expected: bool = True) -> View | None:
        """Take an image with the zoom camera where the head now stands and find the board in it."""
        frame = self.rig.zoom.read(newer_than=self._still_since, timeout=FRAME_TIMEOUT)
        pose, lens = self.rig.head.state(), self.rig.zoom.state()
        if pose.moving or lens.moving:
            raise DeviceError("head or lens moved while the zoom camera took a calibration image")
        capture = Capture(frame.image, "zoom", self.number, pose.pan, pose.tilt, lens.focal_px, frame.t)
        return self._keep(capture, expected)

    def of_placement(self, number: int) -> Sequence[View]:
        """The views of one placement."""
        return [view for view in self.views if view.board == number]

    def save_index(self) -> None:
        """Bring index.json up to date."""
        if self.directory is not None and self._captures:
            write_index(self.directory, CaptureIndex(self.board, self.pitch_mm, tuple(self._captures)))

    def _keep(self, capture: Capture, expected: bool) -> View | None:
        """Find the board; keep the image where it was found, or should have been."""
        corners = find_corners(capture.image, self.board, thorough=expected)
        if corners is None and not expected:
            return None
        capture = replace(capture, source=file_name(capture, len(self._captures)))
        if self.directory is not None:
            assert capture.source is not None
            write_image(self.directory / capture.source, capture.image)
        capture = replace(capture, image=NO_IMAGE)
        self._captures.append(capture)
        if corners is None:
            self.rejected.append(Rejected(str(capture.source), "the board was expected but not found"))
            return None
        view = View(
            capture.camera, corners, capture.board, capture.pan, capture.tilt, capture.focal_px, capture.t,
            capture.source if self.directory is not None else None,
        )  # fmt: skip
        self.views.append(view)
        return view
