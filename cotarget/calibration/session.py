"""A capture session: from a rig of which nothing is known to the views that calibrate it.

Known are the board, the images' sizes, the head's limits and the zoom's nominal focal length; not the fixed camera's
focal length, nor Gamma, nor T. So the session learns as it goes: the board straight ahead tells the fixed camera's
focal length; a scan with the head finds it in the zoom camera; two small turns tell how the camera sits on the head;
from then on a rough model plans every placement and every head pose, and each refines the model.
"""

from collections.abc import Callable

import numpy as np

from cotarget.calibration.boards import board_points, check_board
from cotarget.calibration.bootstrap import ROUGH_MARGIN, learn_fixed, learn_zoom, refitted
from cotarget.calibration.intrinsics import pose_candidates
from cotarget.calibration.model import View
from cotarget.calibration.plan import Coverage, plan_placement, plan_poses, seen_at_home
from cotarget.calibration.recorder import Recorder
from cotarget.calibration.reprojection import RigModel
from cotarget.calibration.start import at_home
from cotarget.calibration.stops import spread_stops
from cotarget.calibration.zooming import see_stops
from cotarget.errors import CalibrationError
from cotarget.geometry import RigidTransform

Progress = Callable[[int, int, str], None]  # done, total, text

FINE_MARGIN = 0.008  # of the image's width, that plans keep clear once the model is fine
MARGIN_GROWTH, WIDEST_MARGIN = 3.0, 0.15  # at every miss, and at most
MOVED_VIEWS = 3  # zoom views with the head away from home, a placement
SHARED_SHARE = 0.75  # of the placements are to be seen by both cameras at home
REFIT_ALWAYS, REFIT_EVERY = 8, 6  # refit the rough model at each of the first placements, later now and then
PATIENCE = 4  # placements before the lack of a common view at home is believed
MOST_MISSES = 4  # placements in a row without a view before giving up


def capture_session(
    recorder: Recorder,
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
        placements: how many placements of the board.
        stops: how many stops of the zoom lens.
        far_placements: how many more placements of the board, for the stops beyond the first.
        rng: chooses among possible placements.
        progress: called with what is done, of how much, and in words.

    Raises:
        CalibrationError: a camera never sees the board, the cameras have no common view at home, or the head fails.
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
        recorder.turn(0.0, 0.0)
    finally:
        recorder.save_index()
        recorder.rig.board.present(None)
    if progress is not None:
        progress(total, total, "fitting")


def _cover(
    recorder: Recorder,
    model: RigModel,
    placements: int,
    rng: np.random.Generator,
    tell: Callable[[str], None],
) -> RigModel:
    """Present the board all over both images and turn the head at each placement."""
    rig = recorder.rig
    coverage = {"fixed": Coverage(rig.fixed.size), "zoom": Coverage(rig.zoom.size)}
    for view in recorder.views:
        coverage[view.camera].add(view.corners_px)
    shared_count = misses = done = 0
    while recorder.number + 1 < placements:
        # A miss means that the rough model bends the image wrongly where nothing was seen yet: keep farther inside.
        margin = min((ROUGH_MARGIN if done < REFIT_ALWAYS else FINE_MARGIN) * MARGIN_GROWTH**misses, WIDEST_MARGIN)
        shared = shared_count <= SHARED_SHARE * done
        recorder.turn(0.0, 0.0)
        wish = _next_placement(recorder, model, coverage, rng, shared=shared, margin=margin, patient=done < PATIENCE)
        recorder.present(wish)
        tell(f"board {recorder.number + 1} of {placements}")
        missed = misses > 0
        fixed_view = recorder.see_fixed()
        misses = 0 if fixed_view is not None else misses + 1
        if misses > MOST_MISSES:
            raise CalibrationError(f"the fixed camera lost the board: not seen {misses} times in a row")
        if fixed_view is None:
            continue
        shared_count += _see_from_everywhere(recorder, model, wish, fixed_view, coverage, margin, rng)
        done += 1
        if done <= REFIT_ALWAYS or done % REFIT_EVERY == 0 or missed:
            model = refitted(model, recorder)
    return refitted(model, recorder)


def _next_placement(
    recorder: Recorder,
    model: RigModel,
    coverage: dict[str, Coverage],
    rng: np.random.Generator,
    *,
    shared: bool,
    margin: float,
    patient: bool,
) -> RigidTransform:
    """Where to hold the board next; for the fixed camera alone where no place is visible to both."""
    assert model.fixed is not None
    for both in (True, False) if shared else (False,):
        wish = plan_placement(
            model, recorder.board, coverage, recorder.number, rng, shared=both, margin_px=margin * model.fixed.size[0]
        )
        if wish is not None:
            return wish
        if both and not patient and not any(at_home(v) for v in recorder.views if v.camera == "zoom"):
            raise CalibrationError(
                "the cameras have no common view at pan = tilt = 0 that would show a whole board to both; "
                "turn the zoom camera's mounting towards what the fixed camera sees"
            )
    raise CalibrationError("no placement of the board is visible to the fixed camera; use a smaller board")


def _see_from_everywhere(
    recorder: Recorder,
    model: RigModel,
    wish: RigidTransform,
    fixed_view: View,
    coverage: dict[str, Coverage],
    margin: float,
    rng: np.random.Generator,
) -> bool:
    """Take the zoom views of a placement, home first; whether the zoom camera saw it at home."""
    assert model.fixed is not None
    rig, board = recorder.rig, recorder.board
    # Where the board really is, in that of its two possible poses which is nearer to the wish.
    poses = pose_candidates(model.fixed, fixed_view.corners_px, board_points(board))
    T = min(poses, key=lambda pose: float((pose.rotation * wish.rotation.inv()).magnitude()))
    home = seen_at_home(model, T, board)
    turns = plan_poses(
        model, T, board, coverage["zoom"], rig.head.limits, MOVED_VIEWS + (not home), rng, margin * rig.zoom.size[0]
    )
    seen_home = home and recorder.see_zoom() is not None
    for pan, tilt in turns:
        recorder.turn(pan, tilt)
        recorder.see_zoom()
    for view in recorder.of_placement(recorder.number):
        coverage[view.camera].add(view.corners_px)
    return seen_home
