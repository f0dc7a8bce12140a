"""A capture session: from a rig of which nothing is known to the views that calibrate it.

Known are the board, the images' sizes, the head's limits and the zoom's nominal focal length; not the fixed camera's
focal length, nor Gamma, nor T. So the session learns as it goes: the board straight ahead tells the fixed camera's
focal length; a scan with the head finds it in the zoom camera; two small turns tell how the camera sits on the head;
from then on a rough model plans every placement and every head pose, and each refines the model.

The first look through a rig of which nothing is known: from the first board to a rough model.

The board straight ahead tells the fixed camera's focal length, and some tilted ones its rough intrinsics; a scan with
the head finds it in the zoom camera; two small turns tell how the camera sits on the head, and so Gamma, up to the
mirror image that any single flat board allows; a second board decides.

Taking captures from a rig: everything stands still first, and every image goes to disk with how it was taken.

Waiting until head and lens of a rig stand where they were sent.

The part of a capture session that sees boards at the zoom lens's other stops.

Boards are held far away, where the fixed camera still sees them whole; at each the lens goes through all stops, and the
head brings parts of the board all over the zoom image. The first board teaches each stop before the next one is tried.

A rig whose zoom camera looks by full stills: what calibration wants where the stream is a small preview.
"""

import contextlib
import functools
import itertools
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import TypeVar

import numpy as np

from cotarget.board import board_points, check_board
from cotarget.calibration.bundle import Block, Fit, base_heads, fit
from cotarget.calibration.captures import (
    INDEX,
    NO_IMAGE,
    CaptureIndex,
    file_name,
    write_command,
    write_image,
    write_index,
    write_session,
)
from cotarget.calibration.corners import find_corners, smallest_spacing
from cotarget.calibration.handeye import motions, park_martin
from cotarget.calibration.initialization import board_pose, place_boards, pose_candidates, rough_intrinsics
from cotarget.calibration.joint import (
    FEWEST_CORNERS,
    SAME_FOCAL,
    expected_corners,
    expected_inside,
    find_expected,
    fit_stop,
    same_focal,
    spread_stops,
    with_stop,
)
from cotarget.calibration.model import Capture, Progress, Rejected, RigModel, View, unseen
from cotarget.calibration.planning import (
    Coverage,
    PredictedAccuracy,
    distance,
    facing_board,
    plan_placements,
    plan_poses,
    planned_views,
    predict_accuracy,
    preferred_share,
    seen_at_home,
    where_in,
)
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import BoardConfig, RigConfig
from cotarget.errors import CalibrationError, CotargetError, HaltedError, StaleFrameError
from cotarget.geometry import Array, RigidTransform, Rotation, pose_dict
from cotarget.pantilt import base_head, solve
from cotarget.rig import (
    Board,
    Camera,
    Clock,
    Frame,
    Image,
    PanTilt,
    PanTiltLimits,
    PanTiltState,
    Rig,
    ZoomCamera,
    ZoomState,
)

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
class CaptureRecorder:
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

    def update_zoom(self, *, expected: bool = True, find: Finder | None = None) -> View | None:
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


# --- bootstrap ---

FIRST_FIELD = np.radians(50.0)  # the field of view supposed before anything was seen
FIRST_SHARES = (0.16, 0.5, -0.2, 0.8)  # of the way from near to far: 3, 4.5, 2, 6.3 m for a usual board
LEARNING = 4  # tilted placements from which the fixed camera's rough intrinsics come
SCAN_STEP = np.radians(20.0)  # less than half the smaller field of view of a usual camera
SCAN_PAN, SCAN_TILT = np.radians(160.0), np.radians(60.0)  # how far the scan looks to each side, limits allowing
# A board seen face-on has two poses that its corners hardly tell apart.
CLEARLY_TILTED = Rotation.from_rotvec(np.radians([20.0, 20.0, 0.0]))
# How the board is shown while the zoom camera looks for it: as far away as this share, turned so [degrees]. A camera
# far to one side sees it only where it is turned towards that side, and farther away.
SHOWN = (
    (0.6, (20.0, 20.0)),
    (0.2, (20.0, 20.0)),
    (1.0, (10.0, 35.0)),
    (1.0, (10.0, -35.0)),
    (1.0, (35.0, 10.0)),
    (1.0, (-35.0, 10.0)),
)
SMALL_TURN = np.radians(7.0)  # tells the camera's mounting without losing a central board
ROUGH_MARGIN = 0.04  # of the image's width, that plans keep clear while the model is rough
ENOUGH_VIEWS = 12  # of the zoom camera, before its intrinsics and T's translation join the rough fit
ROUGH_RMS_PX = 3.0  # a rough fit worse than this is not believed
CENTRAL = 0.12  # of the image's width: nearer to the middle a board is central


def learn_fixed(recorder: CaptureRecorder, rng: np.random.Generator) -> RigModel:
    """Rough intrinsics of the fixed camera, from one board straight ahead and a few tilted ones.

    Raises:
        CalibrationError: it does not see the board.
    """
    board, points = recorder.board, board_points(recorder.board)
    width, height = size = recorder.rig.fixed.size
    supposed = width / 2 / np.tan(FIRST_FIELD / 2)
    lens = Intrinsics(size, (supposed, supposed), ((width - 1) / 2, (height - 1) / 2))
    tried = []
    for share in FIRST_SHARES:
        depth = distance(board, lens, share)
        tried.append(f"{depth:.1f}")
        recorder.present(facing_board(board, np.array([0.0, 0.0, depth]), Rotation.identity()))
        view = recorder.see_fixed(expected=False)
        if view is not None:
            break
    else:
        raise CalibrationError(
            f"the fixed camera does not see the {board.corners[0]}x{board.corners[1]} board, which was held straight "
            f"ahead at {', '.join(tried)} m; check the board's corners and square, the light, and the focus"
        )
    focal = smallest_spacing(view.corners_px, board.corners) * depth / board.square
    lens = replace(lens, focal_px=(focal, focal))
    recorder.update_zoom(expected=False)
    coverage = {"fixed": Coverage(size)}
    for k in range(LEARNING):
        model = RigModel(boards={}, fixed=lens)
        shares = [preferred_share(k)]
        wishes = plan_placements(model, board, coverage, shares, rng, shared=False, margin_px=ROUGH_MARGIN * width)
        if not wishes:
            continue
        recorder.present(wishes[0])
        if (view := recorder.see_fixed()) is not None:
            coverage["fixed"].add(view.corners_px[view.seen])
        recorder.update_zoom(expected=False)
    views = [view for view in recorder.views if view.camera == "fixed"]
    return RigModel(boards={}, fixed=rough_intrinsics("fixed", views, points, size))


def learn_zoom(recorder: CaptureRecorder, model: RigModel) -> RigModel:
    """Rough Gamma and T: find the board with the zoom camera, turn the head a little, and see how it moves."""
    assert model.fixed is not None
    focal = recorder.rig.zoom.state().focal_px
    width, height = size = recorder.rig.zoom.size
    zoom = Intrinsics(size, (focal, focal), ((width - 1) / 2, (height - 1) / 2))
    view = _find_with_zoom(recorder, model)
    by_pan, by_tilt = _turn_a_little(recorder, view)
    centred = _centred(recorder, view, by_pan, by_tilt)
    if centred is not view:
        by_pan, by_tilt = _turn_a_little(recorder, centred)
    _present_otherwise_tilted(recorder, model, centred)
    model = _likeliest(replace(model, zoom=ZoomLens((focal,), (zoom,))), recorder, [centred, by_pan, by_tilt])
    return refitted(model, recorder).model


def _present_otherwise_tilted(recorder: CaptureRecorder, model: RigModel, view: View) -> None:
    """Show both cameras another board in the same place: of Gamma's mirror images only the true one fits both."""
    assert model.fixed is not None
    points = board_points(recorder.board)
    fixed_view = next(v for v in recorder.of_placement(view.board) if v.camera == "fixed")
    middle = board_pose(model.fixed, fixed_view.corners_px, points).apply(points.mean(axis=0))
    recorder.turn(view.pan, view.tilt)
    recorder.present(facing_board(recorder.board, middle, CLEARLY_TILTED.inv()))
    recorder.see_fixed()
    recorder.update_zoom(expected=False)


def _likeliest(model: RigModel, recorder: CaptureRecorder, seen: Sequence[View]) -> RigModel:
    """Rough Gamma and T from one placement seen from three head poses.

    Each view has two possible poses of the board; every combination of them makes a model, and all views so far
    judge between these.
    """
    assert model.fixed is not None
    assert model.zoom is not None
    points, zoom = board_points(recorder.board), model.zoom.stops[0]
    heads = [base_head(view.pan, view.tilt) for view in seen]
    fixed_view = next(v for v in recorder.of_placement(seen[0].board) if v.camera == "fixed")
    T_fixed_board = board_pose(model.fixed, fixed_view.corners_px, points)
    both = {v.board for v in recorder.views if v.camera == "fixed"} & {
        v.board for v in recorder.views if v.camera == "zoom"
    }
    views = [view for view in recorder.views if view.board in both]
    results: list[tuple[float, RigModel]] = []
    refused = None
    for boards in itertools.product(*(pose_candidates(zoom, view.corners_px, points) for view in seen)):
        try:
            # Small turns tell the rotation; the translation is a matter of centimetres and has to wait.
            hand = RigidTransform.from_rotation(park_martin(*motions(heads, boards)).rotation)
            gamma = hand.inv() * heads[0] * hand * boards[0] * T_fixed_board.inv()  # Eq. 2 solved for Gamma
            start = place_boards(replace(model, hand=hand, gamma=gamma), views, points)
            result = fit(start, views, points, {"gamma", "hand"})
        except CalibrationError as error:
            refused = refused or error
            continue
        # The fit's T is only good for judging: so few views do not yet determine its translation.
        results.append((result.rms_px, replace(model, hand=hand, gamma=gamma)))
    if not results:
        raise refused or CalibrationError("hand-eye: no motion of the head was seen")
    return min(results, key=lambda one: one[0])[1]


def _find_with_zoom(recorder: CaptureRecorder, model: RigModel) -> View:
    """A zoom view of a placement that the fixed camera sees too, near the middle of the zoom image."""
    assert model.fixed is not None
    limits = recorder.rig.head.limits
    steps = [
        np.arange(-round(reach / SCAN_STEP), round(reach / SCAN_STEP) + 1) * SCAN_STEP
        for reach in (SCAN_PAN, SCAN_TILT)
    ]
    grid = sorted(itertools.product(*steps), key=lambda pose: (np.hypot(*pose), pose))
    grid = [(pan, tilt) for pan, tilt in grid if limits.allow(pan, tilt)]
    tried = []
    for share, turned in SHOWN:
        depth = distance(recorder.board, model.fixed, share)
        turn = Rotation.from_rotvec(np.radians([*turned, 0.0]))
        recorder.present(facing_board(recorder.board, np.array([0.0, 0.0, depth]), turn))
        if recorder.see_fixed() is None:
            continue
        tried.append(f"{depth:.1f}")
        for pan, tilt in grid:
            recorder.turn(pan, tilt)
            view = recorder.update_zoom(expected=False)
            if view is not None:
                return view
    reach = " and ".join(f"{np.degrees(max(abs(q) for q in axis)):.0f} degrees" for axis in zip(*grid, strict=True))
    raise CalibrationError(
        f"the zoom camera does not see the board that the fixed camera sees straight ahead, at "
        f"{', '.join(dict.fromkeys(tried))} m, turned either way, with pan and tilt up to {reach}; "
        "check where the zoom camera looks at pan = tilt = 0, or use a larger board farther away"
    )


def _turn_a_little(recorder: CaptureRecorder, view: View) -> tuple[View, View]:
    """See the same board from another pan and from another tilt."""
    limits = recorder.rig.head.limits
    seen: list[View] = []
    for name, d_pan, d_tilt in (("pan", SMALL_TURN, 0.0), ("tilt", 0.0, SMALL_TURN)):
        for factor in (1.0, -1.0, 0.5, -0.5):
            pan, tilt = view.pan + factor * d_pan, view.tilt + factor * d_tilt
            if not limits.allow(pan, tilt):
                continue
            recorder.turn(pan, tilt)
            turned = recorder.update_zoom(expected=False)
            if turned is not None:
                seen.append(turned)
                break
        else:
            raise CalibrationError(
                f"the zoom camera loses the board when {name} changes by {np.degrees(SMALL_TURN) / 2:.1f} degrees; "
                "use a smaller board or hold it farther away"
            )
    return seen[0], seen[1]


def _centred(recorder: CaptureRecorder, view: View, by_pan: View, by_tilt: View) -> View:
    """Bring the board to the middle of the zoom image, where the unknown distortion bends no pose.

    The two turns tell how pan and tilt move the board in the image, whatever the camera's roll.
    """
    common = view.seen & by_pan.seen & by_tilt.seen
    if not common.any():
        return view
    middle, at_pan, at_tilt = (v.corners_px[common].mean(axis=0) for v in (view, by_pan, by_tilt))
    off = (np.array(recorder.rig.zoom.size) - 1) / 2 - middle
    if np.linalg.norm(off) <= CENTRAL * recorder.rig.zoom.size[0]:
        return view
    J = np.stack([(at_pan - middle) / (by_pan.pan - view.pan), (at_tilt - middle) / (by_tilt.tilt - view.tilt)], axis=1)
    d_pan, d_tilt = np.linalg.lstsq(J, off, rcond=None)[0]
    limits = recorder.rig.head.limits
    recorder.turn(
        float(np.clip(view.pan + d_pan, *limits.pan)),
        float(np.clip(view.tilt + d_tilt, *limits.tilt)),
    )
    return recorder.update_zoom(expected=False) or view


def refitted(model: RigModel, recorder: CaptureRecorder) -> Fit:
    """Fit the rough model to all views so far: at first Gamma alone, with more views everything."""
    points: Array = board_points(recorder.board)
    views = recorder.views
    if sum(view.camera == "zoom" for view in views) < ENOUGH_VIEWS:
        only_gamma: tuple[Block, ...] = ("gamma",)
        return fit(place_boards(model, views, points), views, points, only_gamma)
    blocks: tuple[Block, ...] = ("fixed", "zoom", "gamma", "hand", "head")
    result = fit(place_boards(model, views, points), views, points, blocks)
    if result.rms_px <= ROUGH_RMS_PX:
        return result
    # The first views misled the intrinsics too far: start those afresh from all views.
    by_camera = {name: [view for view in views if view.camera == name] for name in ("fixed", "zoom")}
    fixed = rough_intrinsics("fixed", by_camera["fixed"], points, recorder.rig.fixed.size)
    zoom = rough_intrinsics("zoom", by_camera["zoom"], points, recorder.rig.zoom.size)
    assert model.zoom is not None
    lens = ZoomLens(model.zoom.nominal_px, (zoom,))
    afresh = place_boards(replace(model, fixed=fixed, zoom=lens), views, points)
    again = fit(fit(afresh, views, points, {"gamma"}).model, views, points, blocks)
    return min((result, again), key=lambda one: one.rms_px)


# --- standing ---

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


# --- zooming ---

# Shares of the way from near to far at which boards are held: far, because the fixed camera must see a board whole that
# fills the zoom image many times over; not all as far, or the entrance pupil could not be told from the focal length.
NEAREST_SHARE, FARTHEST_SHARE = 0.6, 1.0
VIEWS_A_STOP = 2  # of each placement
FIRST_VIEWS = 3  # of the first placement, from which a stop is learnt
ATTEMPTS = 3  # times as many placements are tried, where some are not seen
CANDIDATES = 60  # ways to bring a part of the board into the image that are tried for each view
BORDER_PX = 12.0  # a point of the board is brought anywhere but this near to the image's border


def see_stops(
    recorder: CaptureRecorder,
    model: RigModel,
    stops: Sequence[float],
    placements: int,
    rng: np.random.Generator,
    tell: Callable[[str], None],
) -> RigModel:
    """Take views at all stops but the first, and learn them; the model with these stops.

    Args:
        recorder: with the views at the shortest focal length.
        model: fitted to these.
        stops: nominal focal lengths [px], increasing, the shortest first.
        placements: how many placements of the board.
        rng: random numbers.
        tell: told what is done.
    """
    assert model.fixed is not None
    assert model.zoom is not None
    points = board_points(recorder.board)
    size = recorder.rig.zoom.size
    coverage = {"fixed": Coverage(recorder.rig.fixed.size)}
    for view in recorder.views:
        if view.camera == "fixed":
            coverage["fixed"].add(view.corners_px[view.seen])
    reachable = functools.partial(_reachable, model, recorder.rig.head.limits, points)
    at_stop: dict[int, Coverage] = {}
    only_fixed = replace(model, zoom=None)
    done = 0
    for _ in range(ATTEMPTS * placements):
        if done == placements:
            break
        share = FARTHEST_SHARE - (FARTHEST_SHARE - NEAREST_SHARE) * done / max(placements - 1, 1)
        wishes = plan_placements(
            only_fixed, recorder.board, coverage, [share], rng, shared=False, margin_px=BORDER_PX, accept=reachable
        )
        if not wishes:
            continue
        recorder.present(wishes[0])
        fixed_view = recorder.see_fixed()
        if fixed_view is None:
            coverage["fixed"].misses.append(where_in(model.fixed, recorder.board, wishes[0]))
            continue
        done += 1
        coverage["fixed"].add(fixed_view.corners_px[fixed_view.seen])
        for i, stop in enumerate(stops[1:], start=2):
            tell(f"zoom stop {i} of {len(stops)}, board {done} of {placements}")
            nominal = recorder.zoom(stop)
            number, guessed = _stop_at(model, nominal)
            if not number:  # a lens with few positions offers the first one again
                continue
            cover = at_stop.setdefault(number, Coverage(size))
            learnt = _see_stop(recorder, guessed, number, fixed_view, cover, rng, points)
            if learnt is None:
                break  # a guess of the next stop would be one of a guess
            model = learnt
        recorder.zoom(stops[0])
    return model


def _reachable(model: RigModel, limits: PanTiltLimits, points: Array, wish: RigidTransform) -> bool:
    """Whether the head can look at all of a board held there."""
    assert model.zoom is not None
    lens = model.zoom.stops[0]
    corners = (model.hand * model.gamma * wish).apply(points)
    found = solve(corners, model.hand, model.head, lens.ray(lens.image_center_px))
    return bool(limits.allow(found.pan[:, 0], found.tilt[:, 0]).all())


def _stop_at(model: RigModel, nominal: float) -> tuple[int, RigModel]:
    """The number of the stop at a focal length, and the model with it: a new one only beyond the last."""
    assert model.zoom is not None
    away = np.abs(np.log(np.array(model.zoom.nominal_px) / nominal))
    if nominal <= model.zoom.nominal_px[-1] or away.min() <= SAME_FOCAL:
        return int(np.argmin(away)), model
    return model.stops, replace(model, zoom=with_stop(model.zoom, nominal))


def _see_stop(
    recorder: CaptureRecorder,
    model: RigModel,
    number: int,
    fixed_view: View,
    coverage: Coverage,
    rng: np.random.Generator,
    points: Array,
) -> RigModel | None:
    """Take views of the present placement at a stop; the model, which learns the stop when it is first seen.

    None where a stop that is not yet known was not seen.
    """
    assert model.zoom is not None
    nominal = model.zoom.nominal_px[number]
    known = any(view.camera == "zoom" and same_focal(view, nominal) for view in recorder.views)
    placed = place_boards(model, [fixed_view], points)
    here: list[View] = []
    for _ in range(VIEWS_A_STOP if known else FIRST_VIEWS):
        seen = _see_part(recorder, placed, nominal, coverage, rng, points)
        if seen is not None and not known:
            here.append(seen)
            placed = fit_stop(placed, number, [fixed_view, *here], points)
    return replace(model, zoom=placed.zoom) if known or here else None


def _see_part(
    recorder: CaptureRecorder,
    model: RigModel,
    nominal: float,
    coverage: Coverage,
    rng: np.random.Generator,
    points: Array,
) -> View | None:
    """Turn the head so that the board, or a part of it, fills what was not yet covered, and look."""
    turn = plan_part(model, recorder.number, nominal, coverage, recorder.rig.head.limits, rng, points)
    if turn is None:
        return None
    recorder.turn(*turn)
    view = recorder.update_zoom(
        find=lambda image, view: find_expected(image, recorder.board, expected_corners(model, view, points))
    )
    if view is not None:
        coverage.add(view.corners_px[view.seen])
    return view


def plan_part(
    model: RigModel,
    board: int,
    nominal: float,
    coverage: Coverage,
    limits: PanTiltLimits,
    rng: np.random.Generator,
    points: Array,
) -> tuple[float, float] | None:
    """Choose a head pose that brings some point of a board to some pixel, so that its corners gain most.

    Returns:
        Pan and tilt [rad]; None where none within the limits shows enough of the board.
    """
    assert model.zoom is not None
    lens = model.zoom.at(nominal)
    hand = model.hand * model.zoom.to_pupil(nominal)
    T_base_board = model.hand * model.gamma * model.boards[board]
    chosen = points[rng.integers(len(points), size=CANDIDATES)]
    pixels = rng.uniform(BORDER_PX, np.array(lens.size) - 1 - BORDER_PX, size=(CANDIDATES, 2))
    found = solve(T_base_board.apply(chosen), hand, model.head, lens.ray(pixels))
    pan, tilt = found.pan[:, 0], found.tilt[:, 0]
    allowed = limits.allow(pan, tilt)
    best, most = None, 0.0
    R, t, _ = base_heads(model.head, np.nan_to_num(pan), np.nan_to_num(tilt))
    x_zoom = hand.inv().apply(((T_base_board.apply(points) - t[:, None]) @ R).reshape(-1, 3)).reshape(CANDIDATES, -1, 3)
    for k in np.flatnonzero(allowed):
        seen = _seen(lens, x_zoom[k])
        if len(seen) >= FEWEST_CORNERS and (gain := coverage.gain(seen)) > most:
            best, most = k, gain
    return None if best is None else (float(pan[best]), float(tilt[best]))


def _seen(lens: Intrinsics, x_zoom: Array) -> Array:
    """The pixels of those points (N, 3) that are in the image, (n, 2)."""
    pixels = lens.project(x_zoom)
    return pixels[expected_inside(pixels, lens.size)]


# --- stills ---


def with_stills(rig: Rig) -> Rig:
    """The same rig, seen by full stills; itself, where its stills are no larger than its stream."""
    return rig if rig.zoom.still_size == rig.zoom.size else _StillsRig(rig)


class StillCamera:
    """A zoom camera whose every frame is a full still; its focal lengths are in the still's pixels."""

    def __init__(self, camera: ZoomCamera, clock: Clock) -> None:
        self._camera, self._clock = camera, clock
        self._factor = camera.still_size[0] / camera.size[0]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of a still [px]."""
        return self._camera.still_size

    @property
    def still_size(self) -> tuple[int, int]:
        """The same."""
        return self._camera.still_size

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest focal length [px]."""
        shortest, longest = self._camera.focal_range
        return shortest * self._factor, longest * self._factor

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Take a still, after ``newer_than`` [s] if that is still to come, however long the camera needs for it.

        Raises:
            StaleFrameError: that is farther away than ``timeout`` [s].
        """
        if newer_than is not None:
            if (ahead := newer_than - self._clock.now()) > timeout:
                raise StaleFrameError(f"a still is wanted of {ahead:.2f} s from now, and within {timeout:g} s")
            self._clock.sleep_until(newer_than)
        return self._camera.capture()

    def zoom(self, focal_px: float) -> float:
        """Start the lens moving; the focal length [px] that it will reach."""
        return self._camera.zoom(focal_px / self._factor) * self._factor

    def state(self) -> ZoomState:
        """The lens's state now."""
        state = self._camera.state()
        return ZoomState(state.focal_px * self._factor, state.moving, state.t)

    def capture(self) -> Frame:
        """Take a still."""
        return self._camera.capture()


class _StillsRig:
    """A rig with another zoom camera in front of its own."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self.config: RigConfig | None = getattr(rig, "config", None)
        self.fixed: Camera = rig.fixed
        self.zoom: ZoomCamera = StillCamera(rig.zoom, rig.clock)
        self.head: PanTilt = rig.head
        self.clock: Clock = rig.clock
        self.board: Board = rig.board

    def close(self) -> None:
        """Close the rig."""
        self._rig.close()

    def __enter__(self) -> "_StillsRig":
        """Give the rig itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()


FINE_MARGIN = 0.008  # of the image's width, that plans keep clear once the model is fine
MARGIN_GROWTH, WIDEST_MARGIN = 3.0, 0.15  # at every miss, and at most
MOVED_VIEWS = 3  # zoom views with the head away from home, a placement
CHOICES = 6  # places among which the next is chosen, half of them seen by both cameras at home where there are such
REFIT_ALWAYS, REFIT_EVERY = 8, 6  # refit the rough model at each of the first placements, later now and then
MOST_MISSES = 4  # placements in a row without a view before giving up


def capture_session(
    recorder: CaptureRecorder,
    placements: int,
    rng: np.random.Generator,
    progress: Progress | None = None,
    *,
    stops: int = 1,
    far_placements: int = 0,
) -> None:
    """Fill a recorder with views.

    Args:
        recorder: of a rig that stands still.
        placements: how many placements of the board, those included that a first rough model comes from, which no
            session does without.
        stops: how many stops of the zoom lens.
        far_placements: how many more placements of the board, for the stops beyond the first.
        rng: chooses among possible placements.
        progress: called with what is done, of how much, and in words.

    Raises:
        CalibrationError: a camera never sees the board, or the head or the lens fails.
    """
    check_board(recorder.board)
    nominal = spread_stops(*recorder.rig.zoom.focal_range, stops)
    total = placements + (far_placements if len(nominal) > 1 else 0)

    def tell(text: str) -> None:
        if progress is not None:
            progress(min(recorder.number + 1, total), total, text)

    try:
        recorder.start()
        tell("looking for the board with the fixed camera")
        model = learn_fixed(recorder, rng)
        tell("looking for the board with the zoom camera")
        model = learn_zoom(recorder, model)
        tell("planning")
        model = _cover(recorder, model, placements, rng, tell)
        if len(nominal) > 1:
            see_stops(recorder, model, nominal, far_placements, rng, tell)
            recorder.rejected += _stops_without_views(recorder, nominal)
        recorder.turn(0.0, 0.0)
    except BaseException:
        _break_off(recorder)
        raise
    recorder.save_index()
    recorder.rig.board.present(None)
    if progress is not None:
        progress(total, total, "fitting")


def _break_off(recorder: CaptureRecorder) -> None:
    """End a session that failed or was interrupted: the head first of all; what fails now hides no earlier error."""
    with contextlib.suppress(CotargetError):  # whoever closes the rig halts it again, and tells where that fails
        recorder.rig.head.halt()
    for act in (recorder.save_index, lambda: recorder.rig.board.present(None)):
        try:
            act()
        except (CotargetError, OSError) as error:
            log.warning("while the session was broken off: %s", error)


def _stops_without_views(recorder: CaptureRecorder, stops: Sequence[float]) -> list[Rejected]:
    """The stops that were asked for and not seen, each by the nearest views [px]."""
    half = np.log(stops[1] / stops[0]) / 2
    seen = np.log([view.focal_px for view in recorder.views if view.camera == "zoom" and view.focal_px is not None])
    return [
        Rejected(f"zoom stop at {stop:.0f} px", "no part of a board was seen there; hold boards where the head reaches")
        for stop in stops[1:]
        if not (np.abs(seen - np.log(stop)) < half).any()
    ]


def _cover(
    recorder: CaptureRecorder,
    model: RigModel,
    placements: int,
    rng: np.random.Generator,
    tell: Callable[[str], None],
) -> RigModel:
    """Present the board all over both images and turn the head at each placement."""
    rig, points = recorder.rig, board_points(recorder.board)
    coverage = {"fixed": Coverage(rig.fixed.size), "zoom": Coverage(rig.zoom.size)}
    for view in recorder.views:
        coverage[view.camera].add(view.corners_px[view.seen])
    predicted: PredictedAccuracy | None = None
    misses = done = 0
    while recorder.number + 1 < placements:
        # A miss means that the rough model bends the image wrongly where nothing was seen yet: keep farther inside.
        margin = min((ROUGH_MARGIN if done < REFIT_ALWAYS else FINE_MARGIN) * MARGIN_GROWTH**misses, WIDEST_MARGIN)
        recorder.turn(0.0, 0.0)
        wish = _next_placement(recorder, model, coverage, rng, margin, predicted)
        recorder.present(wish)
        error = "" if predicted is None else f", predicted error {np.degrees(predicted.error()):.4f} degrees"
        tell(f"board {recorder.number + 1} of {placements}{error}")
        missed = misses > 0
        fixed_view = recorder.see_fixed()
        misses = 0 if fixed_view is not None else misses + 1
        if misses > MOST_MISSES:
            raise CalibrationError(f"the fixed camera lost the board: not seen {misses} times in a row")
        if fixed_view is None:
            assert model.fixed is not None
            coverage["fixed"].misses.append(where_in(model.fixed, recorder.board, wish))
            continue
        T = _see_from_everywhere(recorder, model, wish, fixed_view, coverage, margin, rng)
        done += 1
        if done <= REFIT_ALWAYS or done % REFIT_EVERY == 0 or missed:
            found = refitted(model, recorder)
            model = found.model
            predicted = predict_accuracy(found, recorder.board.square) if "hand" in found.free else None
        elif predicted is not None:
            seen = recorder.of_placement(recorder.number)
            predicted = predicted.with_views(seen, {recorder.number: T}, points)
    return refitted(model, recorder).model


def _next_placement(
    recorder: CaptureRecorder,
    model: RigModel,
    coverage: dict[str, Coverage],
    rng: np.random.Generator,
    margin: float,
    predicted: PredictedAccuracy | None,
) -> RigidTransform:
    """Where to hold the board next: of several places, near and far, the one that makes the predicted error smallest.

    While nothing is predicted yet, the one from which most head poses show the board.
    """
    assert model.fixed is not None
    assert model.zoom is not None
    board, limits, points = recorder.board, recorder.rig.head.limits, board_points(recorder.board)
    margin_px = margin * model.fixed.size[0]
    shares = [preferred_share(recorder.number), *rng.uniform(size=CHOICES - 1)]
    wishes = plan_placements(model, board, coverage, shares[: CHOICES // 2], rng, shared=True, margin_px=margin_px)
    wishes += plan_placements(model, board, coverage, shares[len(wishes) :], rng, shared=False, margin_px=margin_px)
    best, least = None, (np.inf, np.inf)
    for wish in wishes:
        turns = plan_poses(model, wish, board, coverage["zoom"], limits, MOVED_VIEWS, rng, margin * model.zoom.size[0])
        if seen_at_home(model, wish, board):
            turns = [(0.0, 0.0), *turns]
        error = np.inf
        if predicted is not None and turns:
            views = planned_views(recorder.number + 1, turns, len(points))
            error = predicted.error(predicted.worth(views, {recorder.number + 1: wish}, points))
        if (error, -len(turns)) < least:
            best, least = wish, (error, -len(turns))
    if best is None:
        raise CalibrationError("no placement of the board is visible to the fixed camera; use a smaller board")
    return best


def _see_from_everywhere(
    recorder: CaptureRecorder,
    model: RigModel,
    wish: RigidTransform,
    fixed_view: View,
    coverage: dict[str, Coverage],
    margin: float,
    rng: np.random.Generator,
) -> RigidTransform:
    """Take the zoom views of a placement, home first; where the board really is, T_fixed_board."""
    assert model.fixed is not None
    rig, board = recorder.rig, recorder.board
    # In that of its two possible poses which is nearer to the wish.
    poses = pose_candidates(model.fixed, fixed_view.corners_px, board_points(board))
    T = min(poses, key=lambda pose: float((pose.rotation * wish.rotation.inv()).magnitude()))
    home = seen_at_home(model, T, board)
    turns = plan_poses(
        model, T, board, coverage["zoom"], rig.head.limits, MOVED_VIEWS + (not home), rng, margin * rig.zoom.size[0]
    )
    if home:
        recorder.update_zoom()
    for pan, tilt in turns:
        recorder.turn(pan, tilt)
        recorder.update_zoom()
    for view in recorder.of_placement(recorder.number):
        coverage[view.camera].add(view.corners_px[view.seen])
    return T
