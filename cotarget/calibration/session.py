"""A capture session: from a rig of which nothing is known to the views that calibrate it.

Known are the board, the images' sizes, the head's limits and the zoom's nominal focal length; not the fixed camera's
focal length, nor Gamma, nor T. So the session learns as it goes: the board straight ahead tells the fixed camera's
focal length; a scan with the head finds it in the zoom camera; two small turns tell how the camera sits on the head;
from then on a rough model plans every placement and every head pose, and each refines the model.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cotarget.calibration.boards import board_points, check_board, smallest_spacing
from cotarget.calibration.bundle import fit
from cotarget.calibration.handeye import motions, park_martin
from cotarget.calibration.intrinsics import board_pose, pose_candidates, rough_intrinsics
from cotarget.calibration.model import View
from cotarget.calibration.plan import Coverage, distance, facing_board, plan_placement, plan_poses, seen_at_home
from cotarget.calibration.recorder import Recorder
from cotarget.calibration.reprojection import RigModel
from cotarget.calibration.sequential import at_home
from cotarget.camera import Intrinsics
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.pantilt import base_head

Progress = Callable[[int, int, str], None]  # done, total, text

FIRST_FIELD = np.radians(50.0)  # the field of view supposed before anything was seen
FIRST_SHARES = (0.16, 0.5, -0.2, 0.8)  # of the way from near to far: 3, 4.5, 2, 6.3 m for a usual board
LEARNING = 4  # tilted placements from which the fixed camera's rough intrinsics come
SCAN_STEP = np.radians(20.0)  # less than half the smaller field of view of a usual camera
SCAN_PAN, SCAN_TILT = np.radians(80.0), np.radians(40.0)  # how far the scan looks to each side
# A board seen face-on has two poses that its corners hardly tell apart.
CLEARLY_TILTED = Rotation.from_rotvec(np.radians([20.0, 20.0, 0.0]))
SMALL_TURN = np.radians(7.0)  # tells the camera's mounting without losing a central board
ROUGH_MARGIN = 0.04  # of the image's width, that plans keep clear while the model is rough
FINE_MARGIN = 0.008
MOVED_VIEWS = 3  # zoom views with the head away from home, a placement
SHARED_SHARE = 0.75  # of the placements are to be seen by both cameras at home
REFIT_ALWAYS, REFIT_EVERY = 8, 6  # refit the rough model at each of the first placements, later now and then
ENOUGH_VIEWS = 12  # of the zoom camera, before its intrinsics and T's translation join the rough fit
MOST_MISSES = 6  # placements in a row without a view before giving up
ROUGH_RMS_PX = 3.0  # a rough fit worse than this is not believed


def capture_session(
    recorder: Recorder, placements: int, rng: np.random.Generator, progress: Progress | None = None
) -> None:
    """Fill a recorder with views.

    Args:
        recorder: of a rig that stands still.
        placements: how many placements of the board.
        rng: chooses among possible placements.
        progress: called with what is done, of how much, and in words.

    Raises:
        CalibrationError: a camera never sees the board, the cameras have no common view at home, or the head fails.
    """
    check_board(recorder.board)

    def tell(text: str) -> None:
        if progress is not None:
            progress(min(recorder.number + 1, placements), placements, text)

    try:
        recorder.start()
        tell("looking for the board with the fixed camera")
        model = _learn_fixed(recorder, rng)
        tell("looking for the board with the zoom camera")
        model = _learn_zoom(recorder, model)
        tell("planning")
        _cover(recorder, model, placements, rng, tell)
        recorder.turn(0.0, 0.0)
    finally:
        recorder.save_index()
        recorder.rig.board.present(None)
    if progress is not None:
        progress(placements, placements, "fitting")


def _learn_fixed(recorder: Recorder, rng: np.random.Generator) -> RigModel:
    """Rough intrinsics of the fixed camera, from one board straight ahead and a few tilted ones."""
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
    recorder.see_zoom(expected=False)
    coverage = {"fixed": Coverage(size)}
    for k in range(LEARNING):
        model = RigModel(boards={}, fixed=lens)
        T = plan_placement(model, board, coverage, k, rng, shared=False, margin_px=ROUGH_MARGIN * width)
        if T is None:
            continue
        recorder.present(T)
        if (view := recorder.see_fixed()) is not None:
            coverage["fixed"].add(view.corners_px)
        recorder.see_zoom(expected=False)
    views = [view for view in recorder.views if view.camera == "fixed"]
    return RigModel(boards={}, fixed=rough_intrinsics("fixed", views, points, size))


def _learn_zoom(recorder: Recorder, model: RigModel) -> RigModel:
    """Rough Gamma and T: find the board with the zoom camera, turn the head a little, and see how it moves."""
    assert model.fixed is not None
    points = board_points(recorder.board)
    focal = recorder.rig.zoom.state().focal_px
    width, height = size = recorder.rig.zoom.size
    zoom = Intrinsics(size, (focal, focal), ((width - 1) / 2, (height - 1) / 2))
    view = _find_with_zoom(recorder, model)
    number = view.board
    _turn_a_little(recorder, view)
    seen = [v for v in recorder.of_placement(number) if v.camera == "zoom"]
    heads = [base_head(v.pan, v.tilt) for v in seen]
    boards = _consistent_poses(heads, [pose_candidates(zoom, v.corners_px, points) for v in seen])
    # Small turns tell the rotation; the translation is a matter of centimetres and has to wait.
    hand = RigidTransform.from_rotation(park_martin(*motions(heads, boards)).rotation)
    fixed_view = next(v for v in recorder.of_placement(number) if v.camera == "fixed")
    T_zoom_fixed = boards[0] * board_pose(model.fixed, fixed_view.corners_px, points).inv()
    gamma = hand.inv() * heads[0] * hand * T_zoom_fixed  # Eq. 2 solved for Gamma
    return _refitted(replace(model, zoom=zoom, hand=hand, gamma=gamma), recorder)


def _consistent_poses(
    heads: Sequence[RigidTransform], candidates: Sequence[Sequence[RigidTransform]]
) -> tuple[RigidTransform, ...]:
    """Of each view's two possible poses, those between which the camera turns by the same angles as the head."""

    def mismatch(boards: tuple[RigidTransform, ...]) -> float:
        A, B = motions(heads, boards)
        return sum(abs(a.rotation.magnitude() - b.rotation.magnitude()) for a, b in zip(A, B, strict=True))

    return min(itertools.product(*candidates), key=mismatch)


def _find_with_zoom(recorder: Recorder, model: RigModel) -> View:
    """A zoom view of a placement that the fixed camera sees too, near the middle of the zoom image."""
    assert model.fixed is not None
    distances = [distance(recorder.board, model.fixed, share) for share in (0.6, 0.2)]
    limits = recorder.rig.head.limits
    steps = [
        np.arange(-round(reach / SCAN_STEP), round(reach / SCAN_STEP) + 1) * SCAN_STEP
        for reach in (SCAN_PAN, SCAN_TILT)
    ]
    grid = sorted(itertools.product(*steps), key=lambda pose: (np.hypot(*pose), pose))
    grid = [
        (pan, tilt)
        for pan, tilt in grid
        if limits.pan[0] <= pan <= limits.pan[1] and limits.tilt[0] <= tilt <= limits.tilt[1]
    ]
    for depth in distances:
        recorder.present(facing_board(recorder.board, np.array([0.0, 0.0, depth]), CLEARLY_TILTED))
        if recorder.see_fixed() is None:
            continue
        for pan, tilt in grid:
            recorder.turn(pan, tilt)
            view = recorder.see_zoom(expected=False)
            if view is not None:
                return view
    reach = " and ".join(
        f"{np.degrees(np.max(s)):.0f} degrees of {n}" for s, n in zip(steps, ("pan", "tilt"), strict=True)
    )
    raise CalibrationError(
        f"the zoom camera does not see the board that the fixed camera sees straight ahead, at "
        f"{' and '.join(f'{d:.1f}' for d in distances)} m, with the head turned up to {reach}; "
        "check where the zoom camera looks at pan = tilt = 0"
    )


def _turn_a_little(recorder: Recorder, view: View) -> None:
    """See the same board from at least one other pan and one other tilt."""
    limits = recorder.rig.head.limits
    for d_pan, d_tilt in ((SMALL_TURN, 0.0), (0.0, SMALL_TURN)):
        seen = False
        for factor in (1.0, -1.0, 0.5, -0.5):
            pan, tilt = view.pan + factor * d_pan, view.tilt + factor * d_tilt
            if not (limits.pan[0] <= pan <= limits.pan[1] and limits.tilt[0] <= tilt <= limits.tilt[1]):
                continue
            recorder.turn(pan, tilt)
            if recorder.see_zoom(expected=False) is not None:
                seen = True
                break
        if not seen:
            raise CalibrationError(
                f"the zoom camera loses the board when {'pan' if d_pan else 'tilt'} changes by "
                f"{np.degrees(SMALL_TURN) / 2:.0f} degrees; use a smaller board or hold it farther away"
            )


def _cover(
    recorder: Recorder,
    model: RigModel,
    placements: int,
    rng: np.random.Generator,
    tell: Callable[[str], None],
) -> None:
    """Present the board all over both images and turn the head at each placement."""
    rig, board, points = recorder.rig, recorder.board, board_points(recorder.board)
    coverage = {"fixed": Coverage(rig.fixed.size), "zoom": Coverage(rig.zoom.size)}
    for view in recorder.views:
        coverage[view.camera].add(view.corners_px)
    shared_count = misses = done = 0
    while recorder.number + 1 < placements:
        assert model.fixed is not None
        margin = ROUGH_MARGIN if done < REFIT_ALWAYS else FINE_MARGIN
        shared = shared_count <= SHARED_SHARE * done
        recorder.turn(0.0, 0.0)
        T = None
        for wish in (shared, False):
            T = plan_placement(
                model, board, coverage, recorder.number, rng, shared=wish, margin_px=margin * model.fixed.size[0]
            )
            if T is not None:
                break
            if not any(at_home(v) for v in recorder.views if v.camera == "zoom") and done >= MOST_MISSES:
                raise CalibrationError(
                    "the cameras have no common view at pan = tilt = 0 that would show a whole board to both; "
                    "turn the zoom camera's mounting towards what the fixed camera sees"
                )
        if T is None:
            raise CalibrationError("no placement of the board is visible to the fixed camera; use a smaller board")
        number = recorder.present(T)
        tell(f"board {number + 1} of {placements}")
        fixed_view = recorder.see_fixed()
        if fixed_view is None:
            misses += 1
            if misses > MOST_MISSES:
                raise CalibrationError(f"the fixed camera lost the board: not seen {misses} times in a row")
            continue
        misses = 0
        T = board_pose(model.fixed, fixed_view.corners_px, points)
        home = seen_at_home(model, T, board)
        poses = plan_poses(
            model, T, board, coverage["zoom"], rig.head.limits, MOVED_VIEWS + (not home), rng,
            margin * rig.zoom.size[0],
        )  # fmt: skip
        if home:
            shared_count += recorder.see_zoom() is not None
        for pan, tilt in poses:
            recorder.turn(pan, tilt)
            recorder.see_zoom()
        for view in recorder.of_placement(number):
            coverage[view.camera].add(view.corners_px)
        done += 1
        if done <= REFIT_ALWAYS or done % REFIT_EVERY == 0:
            model = _refitted(model, recorder)


def _refitted(model: RigModel, recorder: Recorder) -> RigModel:
    """Fit the rough model to all views so far: ever more of it, the more views there are."""
    assert model.fixed is not None
    assert model.zoom is not None
    points: Array = board_points(recorder.board)
    boards: dict[int, RigidTransform] = {}
    for view in recorder.views:
        if view.camera == "fixed" and view.board not in boards:
            boards[view.board] = board_pose(model.fixed, view.corners_px, points)
    views = [view for view in recorder.views if view.board in boards]
    many = sum(view.camera == "zoom" for view in views) >= ENOUGH_VIEWS
    blocks: set[str] = {"fixed", "zoom", "gamma", "hand"} if many else {"gamma"}
    result = fit(replace(model, boards=boards), views, points, blocks)  # type: ignore[arg-type]
    if result.rms_px > ROUGH_RMS_PX and many:
        return model
    return result.model
