"""The first look through a rig of which nothing is known: from the first board to a rough model.

The board straight ahead tells the fixed camera's focal length, and some tilted ones its rough intrinsics; a scan with
the head finds it in the zoom camera; two small turns tell how the camera sits on the head, and so Gamma, up to the
mirror image that any single flat board allows; a second board decides.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cotarget.calibration.boards import board_points, smallest_spacing
from cotarget.calibration.bundle import Fit, fit
from cotarget.calibration.handeye import motions, park_martin
from cotarget.calibration.intrinsics import board_pose, pose_candidates, rough_intrinsics
from cotarget.calibration.model import View
from cotarget.calibration.parameters import Block, RigModel
from cotarget.calibration.placing import place_boards
from cotarget.calibration.plan import Coverage, distance, facing_board, plan_placements, preferred_share
from cotarget.calibration.recorder import Recorder
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.pantilt import base_head

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


def learn_fixed(recorder: Recorder, rng: np.random.Generator) -> RigModel:
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
    recorder.see_zoom(expected=False)
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
        recorder.see_zoom(expected=False)
    views = [view for view in recorder.views if view.camera == "fixed"]
    return RigModel(boards={}, fixed=rough_intrinsics("fixed", views, points, size))


def learn_zoom(recorder: Recorder, model: RigModel) -> RigModel:
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


def _present_otherwise_tilted(recorder: Recorder, model: RigModel, view: View) -> None:
    """Show both cameras another board in the same place: of Gamma's mirror images only the true one fits both."""
    assert model.fixed is not None
    points = board_points(recorder.board)
    fixed_view = next(v for v in recorder.of_placement(view.board) if v.camera == "fixed")
    middle = board_pose(model.fixed, fixed_view.corners_px, points).apply(points.mean(axis=0))
    recorder.turn(view.pan, view.tilt)
    recorder.present(facing_board(recorder.board, middle, CLEARLY_TILTED.inv()))
    recorder.see_fixed()
    recorder.see_zoom(expected=False)


def _likeliest(model: RigModel, recorder: Recorder, seen: Sequence[View]) -> RigModel:
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


def _find_with_zoom(recorder: Recorder, model: RigModel) -> View:
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
            view = recorder.see_zoom(expected=False)
            if view is not None:
                return view
    reach = " and ".join(f"{np.degrees(max(abs(q) for q in axis)):.0f} degrees" for axis in zip(*grid, strict=True))
    raise CalibrationError(
        f"the zoom camera does not see the board that the fixed camera sees straight ahead, at "
        f"{', '.join(dict.fromkeys(tried))} m, turned either way, with pan and tilt up to {reach}; "
        "check where the zoom camera looks at pan = tilt = 0, or use a larger board farther away"
    )


def _turn_a_little(recorder: Recorder, view: View) -> tuple[View, View]:
    """See the same board from another pan and from another tilt."""
    limits = recorder.rig.head.limits
    seen: list[View] = []
    for name, d_pan, d_tilt in (("pan", SMALL_TURN, 0.0), ("tilt", 0.0, SMALL_TURN)):
        for factor in (1.0, -1.0, 0.5, -0.5):
            pan, tilt = view.pan + factor * d_pan, view.tilt + factor * d_tilt
            if not limits.allow(pan, tilt):
                continue
            recorder.turn(pan, tilt)
            turned = recorder.see_zoom(expected=False)
            if turned is not None:
                seen.append(turned)
                break
        else:
            raise CalibrationError(
                f"the zoom camera loses the board when {name} changes by {np.degrees(SMALL_TURN) / 2:.1f} degrees; "
                "use a smaller board or hold it farther away"
            )
    return seen[0], seen[1]


def _centred(recorder: Recorder, view: View, by_pan: View, by_tilt: View) -> View:
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
    return recorder.see_zoom(expected=False) or view


def refitted(model: RigModel, recorder: Recorder) -> Fit:
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
