"""A capture session: from a rig of which nothing is known to the views that calibrate it.

Known are the board, the images' sizes, the head's limits and the zoom's nominal focal length; not the fixed camera's
focal length, nor Gamma, nor T. So the session learns as it goes: the board straight ahead tells the fixed camera's
focal length; a scan with the head finds it in the zoom camera; two small turns tell how the camera sits on the head;
from then on a rough model plans every placement and every head pose, and each refines the model.
"""

import contextlib
import logging
from collections.abc import Callable, Sequence

import numpy as np

from cotarget.calibration.boards import board_points, check_board
from cotarget.calibration.bootstrap import ROUGH_MARGIN, learn_fixed, learn_zoom, refitted
from cotarget.calibration.intrinsics import pose_candidates
from cotarget.calibration.model import Progress, Rejected, View
from cotarget.calibration.outlook import Outlook, outlook_of, planned_views
from cotarget.calibration.parameters import RigModel
from cotarget.calibration.plan import Coverage, plan_placements, plan_poses, preferred_share, seen_at_home, where_in
from cotarget.calibration.recorder import Recorder
from cotarget.calibration.stops import spread_stops
from cotarget.calibration.zooming import see_stops
from cotarget.errors import CalibrationError, CotargetError
from cotarget.geometry import RigidTransform

log = logging.getLogger(__name__)

FINE_MARGIN = 0.008  # of the image's width, that plans keep clear once the model is fine
MARGIN_GROWTH, WIDEST_MARGIN = 3.0, 0.15  # at every miss, and at most
MOVED_VIEWS = 3  # zoom views with the head away from home, a placement
CHOICES = 6  # places among which the next is chosen, half of them seen by both cameras at home where there are such
REFIT_ALWAYS, REFIT_EVERY = 8, 6  # refit the rough model at each of the first placements, later now and then
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


def _break_off(recorder: Recorder) -> None:
    """End a session that failed or was interrupted: the head first of all; what fails now hides no earlier error."""
    with contextlib.suppress(CotargetError):  # whoever closes the rig halts it again, and tells where that fails
        recorder.rig.head.halt()
    for act in (recorder.save_index, lambda: recorder.rig.board.present(None)):
        try:
            act()
        except (CotargetError, OSError) as error:
            log.warning("while the session was broken off: %s", error)


def _stops_without_views(recorder: Recorder, stops: Sequence[float]) -> list[Rejected]:
    """The stops that were asked for and not seen, each by the nearest views [px]."""
    half = np.log(stops[1] / stops[0]) / 2
    seen = np.log([view.focal_px for view in recorder.views if view.camera == "zoom" and view.focal_px is not None])
    return [
        Rejected(f"zoom stop at {stop:.0f} px", "no part of a board was seen there; hold boards where the head reaches")
        for stop in stops[1:]
        if not (np.abs(seen - np.log(stop)) < half).any()
    ]


def _cover(
    recorder: Recorder,
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
    outlook: Outlook | None = None
    misses = done = 0
    while recorder.number + 1 < placements:
        # A miss means that the rough model bends the image wrongly where nothing was seen yet: keep farther inside.
        margin = min((ROUGH_MARGIN if done < REFIT_ALWAYS else FINE_MARGIN) * MARGIN_GROWTH**misses, WIDEST_MARGIN)
        recorder.turn(0.0, 0.0)
        wish = _next_placement(recorder, model, coverage, rng, margin, outlook)
        recorder.present(wish)
        error = "" if outlook is None else f", predicted error {np.degrees(outlook.error()):.4f} degrees"
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
            outlook = outlook_of(found, recorder.board.square) if "hand" in found.free else None
        elif outlook is not None:
            seen = recorder.of_placement(recorder.number)
            outlook = outlook.with_views(seen, {recorder.number: T}, points)
    return refitted(model, recorder).model


def _next_placement(
    recorder: Recorder,
    model: RigModel,
    coverage: dict[str, Coverage],
    rng: np.random.Generator,
    margin: float,
    outlook: Outlook | None,
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
        if outlook is not None and turns:
            views = planned_views(recorder.number + 1, turns, len(points))
            error = outlook.error(outlook.worth(views, {recorder.number + 1: wish}, points))
        if (error, -len(turns)) < least:
            best, least = wish, (error, -len(turns))
    if best is None:
        raise CalibrationError("no placement of the board is visible to the fixed camera; use a smaller board")
    return best


def _see_from_everywhere(
    recorder: Recorder,
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
        recorder.see_zoom()
    for pan, tilt in turns:
        recorder.turn(pan, tilt)
        recorder.see_zoom()
    for view in recorder.of_placement(recorder.number):
        coverage[view.camera].add(view.corners_px[view.seen])
    return T
