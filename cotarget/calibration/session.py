"""Capture session: drive an uncalibrated rig through board placements and head poses to views that calibrate it.

The fixed camera's focal length, Gamma and T are unknown at first. The session estimates a rough model as it goes:

1. A board straight ahead gives the fixed camera's focal length, and tilted ones its rough intrinsics.
2. A scan with the head finds the board in the zoom image. Two small turns give the rotation of T, and with it Gamma, up
   to the mirror image that a single view of a flat board allows; a second board decides between the two.
3. The rough model plans every further placement and head pose, and is fitted again as views come in.
4. For further zoom samples (`see_stops`), boards stand far away, where the fixed camera still sees them whole. At each
   board the lens goes through all zoom samples, and the head brings parts of the board all over the zoom image.

Reasons for the numbers: docs/design-notes.md.
"""

import contextlib
import functools
import itertools
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cotarget.board import check_board
from cotarget.calibration.bundle import Block, Fit, fit
from cotarget.calibration.corners import smallest_spacing
from cotarget.calibration.handeye import motions, park_martin
from cotarget.calibration.initialization import board_pose, of_both, place_boards, pose_candidates, rough_intrinsics
from cotarget.calibration.model import BundleModel, CameraName, Rejected, View
from cotarget.calibration.observability import FARTHER
from cotarget.calibration.planning import (
    Coverage,
    Missed,
    PredictedAccuracy,
    distance,
    facing_board,
    in_zoom,
    plan_placements,
    plan_poses,
    planned_views,
    predict_accuracy,
    preferred_share,
    seen_at_home,
    where_in,
)
from cotarget.calibration.recorder import CaptureRecorder
from cotarget.calibration.zoom_samples import (
    FEWEST_CORNERS,
    FEWEST_STOP_PLACEMENTS,
    SAME_FOCAL,
    expected_inside,
    find_expected,
    fit_stop,
    same_focal,
    spread_stops,
    with_stop,
)
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.errors import CalibrationError, ConfigError, CotargetError
from cotarget.geometry import RigidTransform, Rotation
from cotarget.pantilt import base_head, solve
from cotarget.parallel import Progress
from cotarget.rig_geometry import FixedCamera, ZoomHead

log = logging.getLogger(__name__)

# From the first board to a rough model of the rig

FIRST_FIELD = np.radians(50.0)  # field of view assumed before the first board is seen
FIRST_SHARES = (0.16, 0.5, -0.2, 0.8)  # of the way from near to far: 3, 4.5, 2, 6.3 m for a usual board
LEARNING = 4  # tilted placements for the fixed camera's rough intrinsics
SCAN_STEP = np.radians(20.0)  # less than half the smaller field of view of a usual camera
SCAN_PAN, SCAN_TILT = np.radians(160.0), np.radians(60.0)  # reach of the scan to each side, within the limits
# The corners of a board seen face-on hardly separate its two possible poses, so boards are tilted.
CLEARLY_TILTED = Rotation.from_rotvec(np.radians([20.0, 20.0, 0.0]))
# Placements while the zoom camera searches for the board: share of the way from near to far, and turn [degrees]. A zoom
# camera far to one side sees the board only when it is turned towards that side and farther away.
SHOWN = (
    (0.6, (20.0, 20.0)),
    (0.2, (20.0, 20.0)),
    (1.0, (10.0, 35.0)),
    (1.0, (10.0, -35.0)),
    (1.0, (35.0, 10.0)),
    (1.0, (-35.0, 10.0)),
)
SMALL_TURN = np.radians(7.0)  # enough for T's rotation, and keeps a central board in the image
ROUGH_MARGIN = 0.04  # border that plans keep clear while the model is rough, over the image's width
ENOUGH_VIEWS = 12  # zoom views from which the zoom intrinsics and T's translation join the rough fit
ROUGH_RMS_PX = 3.0  # a rough fit with a larger rms starts again
OTHER_LENS = 1.25  # ratio of focal lengths above which the lens is wrong and not the head; boards give it to a tenth
CENTRAL = 0.12  # a board is central within this distance of the image's centre, over the image's width
GAMMA_ALONE: tuple[Block, ...] = ("gamma",)
ROUGH_BLOCKS: tuple[Block, ...] = ("fixed", "zoom", "gamma", "hand", "head")


def learn_fixed(recorder: CaptureRecorder, rng: np.random.Generator) -> BundleModel:
    """Estimate rough intrinsics of the fixed camera, from one board straight ahead and a few tilted ones."""
    board, size = recorder.board, recorder.rig.fixed.size
    lens = _pinhole(size, size[0] / 2 / np.tan(FIRST_FIELD / 2))
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
        model, shares, margin_px = BundleModel({}, FixedCamera(lens)), [preferred_share(k)], ROUGH_MARGIN * size[0]
        planned = plan_placements(model, board, coverage, shares, rng, shared=False, margin_px=margin_px)
        if not planned:
            continue
        recorder.present(planned[0])
        if (view := recorder.see_fixed()) is not None:
            coverage["fixed"].add(view.corners_px)
        recorder.see_zoom(expected=False)
    return BundleModel({}, FixedCamera(_rough_lens(recorder, "fixed")))


def _pinhole(size: tuple[int, int], focal_px: float) -> Intrinsics:
    """Make intrinsics without distortion, with the principal point in the middle of the image."""
    return Intrinsics(size, (focal_px, focal_px), ((size[0] - 1) / 2, (size[1] - 1) / 2))


def _rough_lens(recorder: CaptureRecorder, camera: CameraName) -> Intrinsics:
    """Estimate rough intrinsics of a camera from all its views so far."""
    views = [view for view in recorder.views if view.camera == camera]
    size = (recorder.rig.fixed if camera == "fixed" else recorder.rig.zoom).size
    return rough_intrinsics(camera, views, recorder.points, size)


def learn_zoom(recorder: CaptureRecorder, model: BundleModel) -> BundleModel:
    """Estimate rough Gamma and T: find the board in the zoom image, and turn the head a little."""
    view = _find_with_zoom(recorder, model)
    by_pan, by_tilt = _turn_a_little(recorder, view)
    centred = _centred(recorder, view, by_pan, by_tilt)
    if centred is not view:
        by_pan, by_tilt = _turn_a_little(recorder, centred)
    # The board in the same place with another tilt: only the true one of Gamma's mirror images fits both.
    middle = _pose_of(recorder, model, centred.board).apply(recorder.points.mean(axis=0))
    recorder.turn(centred.pan, centred.tilt)
    recorder.present(facing_board(recorder.board, middle, CLEARLY_TILTED.inv()))
    recorder.see_fixed()
    recorder.see_zoom(expected=False)
    focal, still = recorder.rig.zoom.state().focal_px, RigidTransform.identity()
    lens = ZoomLens((focal,), (_pinhole(recorder.rig.zoom.size, focal),))
    model = _likeliest(replace(model, zoom_head=ZoomHead(lens, still, still)), recorder, [centred, by_pan, by_tilt])
    return refitted(model, recorder).model


def _pose_of(recorder: CaptureRecorder, model: BundleModel, number: int) -> RigidTransform:
    """Estimate T_fixed_board of a placement from the fixed camera's view."""
    view = next(v for v in recorder.of_placement(number) if v.camera == "fixed")
    return board_pose(model.fixed.lens, view.corners_px, recorder.points)


def _likeliest(model: BundleModel, recorder: CaptureRecorder, seen: Sequence[View]) -> BundleModel:
    """Choose rough Gamma and T from one placement seen from three head poses.

    Each view has two possible poses of the board. Of all combinations, the one that fits all views so far best wins.
    """
    points, zoom = recorder.points, model.head.lens.stops[0]
    heads = [base_head(view.pan, view.tilt) for view in seen]
    T_fixed_board = _pose_of(recorder, model, seen[0].board)
    views = of_both(recorder.views)
    results: list[tuple[float, BundleModel]] = []
    refused = None
    for boards in itertools.product(*(pose_candidates(zoom, view.corners_px, points) for view in seen)):
        try:
            # Small turns determine the rotation only. The translation, some centimetres, is fitted from more views.
            hand = RigidTransform.from_rotation(park_martin(*motions(heads, boards)).rotation)
            gamma = hand.inv() * heads[0] * hand * boards[0] * T_fixed_board.inv()  # Eq. 2 solved for Gamma
            start = place_boards(model.with_zoom_head(T_zoom0_fixed=gamma, T_head_zoom=hand), views, points)
            result = fit(start, views, points, {"gamma", "hand"})
        except CalibrationError as error:
            refused = refused or error
            continue
        # The fit's T serves the comparison only: these few views do not determine its translation.
        results.append((result.rms_px, model.with_zoom_head(T_zoom0_fixed=gamma, T_head_zoom=hand)))
    if not results:
        _check_lens(zoom.focal_px[0], recorder)
        raise refused or CalibrationError("hand-eye: no motion of the head was seen")
    return min(results, key=lambda one: one[0])[1]


def _check_lens(reported_px: float, recorder: CaptureRecorder) -> None:
    """Refuse a zoom lens whose focal length is far from what the boards in its images show."""
    seen_px = _rough_lens(recorder, "zoom").focal_px[0]
    if max(seen_px / reported_px, reported_px / seen_px) > OTHER_LENS:
        raise CalibrationError(
            f"the zoom lens reports a focal length of {reported_px:.0f} px, but the boards in its images show about "
            f"{seen_px:.0f} px; check its focal lengths and pitch_mm"
        )


def _find_with_zoom(recorder: CaptureRecorder, model: BundleModel) -> View:
    """Scan with the head until the zoom camera sees a placement that the fixed camera sees too."""
    limits = recorder.rig.head.limits
    steps = [
        np.arange(-round(reach / SCAN_STEP), round(reach / SCAN_STEP) + 1) * SCAN_STEP
        for reach in (SCAN_PAN, SCAN_TILT)
    ]
    grid = sorted(itertools.product(*steps), key=lambda pose: (np.hypot(*pose), pose))
    grid = [(pan, tilt) for pan, tilt in grid if limits.allow(pan, tilt)]
    tried = []
    for share, turned in SHOWN:
        depth = distance(recorder.board, model.fixed.lens, share)
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


def _turn_a_little(recorder: CaptureRecorder, view: View) -> tuple[View, View]:
    """Take a zoom view of the same board at another pan, and one at another tilt."""
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


def _centred(recorder: CaptureRecorder, view: View, by_pan: View, by_tilt: View) -> View:
    """Bring the board to the middle of the zoom image, where the unknown distortion does not bias its pose.

    The views after the two turns give the image Jacobian by pan and tilt. Returns the view given, where the board is
    central already or is lost on the way.
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
    pan, tilt = np.clip(view.pan + d_pan, *limits.pan.range), np.clip(view.tilt + d_tilt, *limits.tilt.range)
    recorder.turn(float(pan), float(tilt))
    return recorder.see_zoom(expected=False) or view


def refitted(model: BundleModel, recorder: CaptureRecorder) -> Fit:
    """Fit the rough model to all views so far: Gamma alone at first, everything with `ENOUGH_VIEWS` zoom views."""
    points, views = recorder.points, recorder.views
    if sum(view.camera == "zoom" for view in views) < ENOUGH_VIEWS:
        return fit(place_boards(model, views, points), views, points, GAMMA_ALONE)
    result = fit(place_boards(model, views, points), views, points, ROUGH_BLOCKS)
    if result.rms_px <= ROUGH_RMS_PX:
        return result
    # The intrinsics from the first views are too far off: start again with intrinsics from all views.
    lens = ZoomLens(model.head.lens.nominal_px, (_rough_lens(recorder, "zoom"),))
    fixed = FixedCamera(_rough_lens(recorder, "fixed"))
    start = place_boards(replace(model, fixed=fixed).with_zoom_head(lens=lens), views, points)
    again = fit(fit(start, views, points, GAMMA_ALONE).model, views, points, ROUGH_BLOCKS)
    return min((result, again), key=lambda one: one.rms_px)


# Zoom samples beyond the first

# Boards are far, as shares of the way from near to far, because the fixed camera must see a board whole that fills the
# zoom image many times over. The distances differ, or the entrance pupil could not be separated from the focal length.
NEAREST_SHARE, FARTHEST_SHARE = 0.6, 1.0
VIEWS_A_STOP = 2  # views of each placement at a zoom sample
FIRST_VIEWS = 3  # views of the first placement, from which a zoom sample is first fitted
ATTEMPTS = 3  # placements tried at most, over those wanted
CANDIDATES = 60  # head poses tried for each view
BORDER_PX = 12.0  # border of the image to which no point of the board is brought


def see_stops(
    recorder: CaptureRecorder,
    model: BundleModel,
    stops: Sequence[float],
    placements: int,
    rng: np.random.Generator,
    report: Callable[[str], None],
) -> BundleModel:
    """Take views at all zoom samples but the first, and return the model with those that were seen."""
    reachable = functools.partial(_reachable, recorder, model)
    only_fixed = replace(model, zoom_head=None)
    hidden: list[Missed] = []  # without those of near boards, missed while the model was rough
    done = 0
    for _ in range(ATTEMPTS * placements):
        if done == placements:
            break
        share = FARTHEST_SHARE - (FARTHEST_SHARE - NEAREST_SHARE) * done / max(placements - 1, 1)
        coverage = {"fixed": replace(recorder.coverage("fixed"), misses=hidden)}
        planned = plan_placements(
            only_fixed, recorder.board, coverage, [share], rng, shared=False, margin_px=BORDER_PX, accept=reachable
        )
        if not planned:
            continue
        recorder.present(planned[0])
        fixed_view = recorder.see_fixed()
        if fixed_view is None:
            hidden.append(where_in(model.fixed.lens, recorder.board, planned[0]))
            continue
        done += 1
        for i, stop in enumerate(stops[1:], start=2):
            report(f"zoom sample {i} of {len(stops)}, board {done} of {placements}")
            nominal = recorder.zoom(stop)
            number, guessed = _stop_at(model, nominal)
            if not number:  # a lens with few positions goes to the first one again
                continue
            learnt = _see_stop(recorder, guessed, number, fixed_view, rng)
            if learnt is None:
                break  # a sample that was not seen cannot predict the next one
            model = learnt
        recorder.zoom(stops[0])
    return model


def _reachable(recorder: CaptureRecorder, model: BundleModel, T_fixed_board: RigidTransform) -> bool:
    """Check whether the head can point at every corner of a board."""
    head, lens = model.head, model.head.lens.stops[0]
    corners = (head.T_base_fixed * T_fixed_board).apply(recorder.points)
    found = solve(corners, head.hand_eye(), head.axes, lens.ray(lens.image_center_px))
    return bool(recorder.rig.head.limits.allow(found.pan[:, 0], found.tilt[:, 0]).all())


def _stop_at(model: BundleModel, nominal: float) -> tuple[int, BundleModel]:
    """Find the zoom sample at a nominal focal length [px]; beyond the last one, add it to the model.

    Returns its number, and the model that contains it.
    """
    lens = model.head.lens
    away = np.abs(np.log(np.array(lens.nominal_px) / nominal))
    if nominal <= lens.nominal_px[-1] or away.min() <= SAME_FOCAL:
        return int(np.argmin(away)), model
    return model.stops, model.with_zoom_head(lens=with_stop(lens, nominal))


def _see_stop(
    recorder: CaptureRecorder, model: BundleModel, number: int, fixed_view: View, rng: np.random.Generator
) -> BundleModel | None:
    """Take views of the present placement at a zoom sample; fit the sample when it is first seen.

    Returns the model with the zoom sample; None where a sample not yet fitted was not seen.
    """
    points, nominal = recorder.points, model.head.lens.nominal_px[number]
    known = any(view.camera == "zoom" and same_focal(view, nominal) for view in recorder.views)
    placed = place_boards(model, [fixed_view], points)
    here: list[View] = []
    for _ in range(VIEWS_A_STOP if known else FIRST_VIEWS):
        seen = _see_part(recorder, placed, nominal, rng)
        if seen is not None and not known:
            here.append(seen)
            placed = fit_stop(placed, number, [fixed_view, *here], points)
    return replace(model, zoom_head=placed.zoom_head) if known or here else None


def _see_part(recorder: CaptureRecorder, model: BundleModel, nominal: float, rng: np.random.Generator) -> View | None:
    """Turn the head so that a part of the board covers new parts of the zoom image, and take a view."""
    turn = _plan_part(recorder, model, nominal, rng)
    if turn is None:
        return None
    recorder.turn(*turn)
    return recorder.see_zoom(find=lambda image, view: find_expected(image, view, model, recorder.board))


def _plan_part(
    recorder: CaptureRecorder, model: BundleModel, nominal: float, rng: np.random.Generator
) -> tuple[float, float] | None:
    """Choose the pan and tilt [rad] that add most to the coverage, of random ones that bring a corner to a pixel.

    None where no pose within the limits shows enough of the present placement.
    """
    head, points, coverage = model.head, recorder.points, recorder.coverage("zoom", nominal)
    lens, hand = head.lens.at(nominal), head.hand_eye(nominal)
    T_base_board = head.T_base_fixed * model.boards[recorder.number]
    chosen = points[rng.integers(len(points), size=CANDIDATES)]
    pixels = rng.uniform(BORDER_PX, np.array(lens.size) - 1 - BORDER_PX, size=(CANDIDATES, 2))
    found = solve(T_base_board.apply(chosen), hand, head.axes, lens.ray(pixels))
    pan, tilt = found.pan[:, 0], found.tilt[:, 0]
    best, most = None, 0.0
    x_zoom = in_zoom(head, hand, T_base_board.apply(points), np.nan_to_num(pan), np.nan_to_num(tilt))
    for k in np.flatnonzero(recorder.rig.head.limits.allow(pan, tilt)):
        seen = lens.project(x_zoom[k])
        seen = seen[expected_inside(seen, lens.size)]
        if len(seen) >= FEWEST_CORNERS and (gain := coverage.gain(seen)) > most:
            best, most = k, gain
    return None if best is None else (float(pan[best]), float(tilt[best]))


# The session

FINE_MARGIN = 0.008  # border that plans keep clear once the model is fine, over the image's width
MARGIN_GROWTH, WIDEST_MARGIN = 3.0, 0.15  # factor of the margin at every miss, and its largest value
MOVED_VIEWS = 3  # zoom views per placement with the head away from home
CHOICES = 6  # candidates for the next placement, half of them seen by both cameras at home where possible
REFIT_ALWAYS, REFIT_EVERY = 8, 6  # refit after each of the first 8 placements, then after every 6th
# Placements that the rough model takes: one straight ahead, the tilted ones, one that the zoom camera finds, and that
# one tilted otherwise.
FEWEST_PLACEMENTS = 1 + LEARNING + 2
MOST_MISSES = 4  # placements in a row that the fixed camera may miss before the session fails


def capture_session(
    recorder: CaptureRecorder,
    placements: int,
    rng: np.random.Generator,
    progress: Progress,
    *,
    stops: int = 1,
    far_placements: int = 0,
) -> None:
    """Run a capture session: fill a recorder with views that calibrate its rig; see `calibrate`."""
    check_board(recorder.board)
    _check_least("placements", placements, FEWEST_PLACEMENTS)
    _check_least("stops", stops, 1)
    if stops > 1:
        _check_least("far_placements", far_placements, FEWEST_STOP_PLACEMENTS)
    nominal = spread_stops(*recorder.rig.zoom.focal_range, stops)
    total = placements + (far_placements if len(nominal) > 1 else 0)

    def report(text: str) -> None:
        progress(min(recorder.number + 1, total), total, text)

    try:
        recorder.start()
        report("looking for the board with the fixed camera")
        model = learn_fixed(recorder, rng)
        report("looking for the board with the zoom camera")
        model = learn_zoom(recorder, model)
        report("planning")
        model = _cover(recorder, model, placements, rng, report)
        if len(nominal) > 1:
            see_stops(recorder, model, nominal, far_placements, rng, report)
            recorder.rejected += _stops_without_views(recorder, nominal)
        recorder.turn(0.0, 0.0)
    except BaseException:
        _break_off(recorder)
        raise
    recorder.save_index()
    recorder.rig.board.present(None)
    progress(total, total, "fitting")


def _check_least(name: str, value: int, least: int) -> None:
    """Refuse a session that is too short to calibrate a rig."""
    if value < least:
        raise ConfigError(f"{name}: {value} is too few for a session; it takes {least} at least")


def _break_off(recorder: CaptureRecorder) -> None:
    """Halt the head and end a session that failed or was interrupted; log errors, so that they hide no earlier one."""
    with contextlib.suppress(CotargetError):  # closing the rig halts the head again, and reports a failure
        recorder.rig.head.halt()
    for act in (recorder.save_index, lambda: recorder.rig.board.present(None)):
        try:
            act()
        except (CotargetError, OSError) as error:
            log.warning("while the session was broken off: %s", error)


def _stops_without_views(recorder: CaptureRecorder, stops: Sequence[float]) -> list[Rejected]:
    """List the requested zoom samples (nominal focal lengths [px]) near which no view was taken."""
    half = np.log(stops[1] / stops[0]) / 2
    seen = np.log([view.focal_px for view in recorder.views if view.camera == "zoom" and view.focal_px is not None])
    return [
        Rejected(f"zoom sample at {stop:.0f} px", f"no part of a board was seen there; {FARTHER}")
        for stop in stops[1:]
        if not (np.abs(seen - np.log(stop)) < half).any()
    ]


def _cover(
    recorder: CaptureRecorder,
    model: BundleModel,
    placements: int,
    rng: np.random.Generator,
    report: Callable[[str], None],
) -> BundleModel:
    """Take views of placements that cover both images, from several head poses each, and refine the rough model."""
    predicted: PredictedAccuracy | None = None
    hidden: list[Missed] = []
    misses = done = 0
    while recorder.number + 1 < placements:
        # After a miss the rough model's distortion is wrong near the border, so the next placement keeps farther away.
        margin = min((ROUGH_MARGIN if done < REFIT_ALWAYS else FINE_MARGIN) * MARGIN_GROWTH**misses, WIDEST_MARGIN)
        recorder.turn(0.0, 0.0)
        requested = _next_placement(recorder, model, hidden, rng, margin, predicted)
        recorder.present(requested)
        error = "" if predicted is None else f", predicted error {np.degrees(predicted.error()):.4f} degrees"
        report(f"board {recorder.number + 1} of {placements}{error}")
        missed = misses > 0
        fixed_view = recorder.see_fixed()
        misses = 0 if fixed_view is not None else misses + 1
        if misses > MOST_MISSES:
            raise CalibrationError(f"the fixed camera lost the board: not seen {misses} times in a row")
        if fixed_view is None:
            hidden.append(where_in(model.fixed.lens, recorder.board, requested))
            continue
        T = _see_from_everywhere(recorder, model, requested, fixed_view, margin, rng)
        done += 1
        if done <= REFIT_ALWAYS or done % REFIT_EVERY == 0 or missed:
            found = refitted(model, recorder)
            model = found.model
            predicted = predict_accuracy(found, recorder.board.square) if "hand" in found.free else None
        elif predicted is not None:
            seen = recorder.of_placement(recorder.number)
            predicted = predicted.with_views(seen, {recorder.number: T}, recorder.points)
    return refitted(model, recorder).model


def _next_placement(
    recorder: CaptureRecorder,
    model: BundleModel,
    hidden: list[Missed],
    rng: np.random.Generator,
    margin: float,
    predicted: PredictedAccuracy | None,
) -> RigidTransform:
    """Choose the next placement: of several candidates, near and far, the one with the smallest predicted error.

    Before the accuracy can be predicted, it is the one that most head poses show.
    """
    board, limits, points = recorder.board, recorder.rig.head.limits, recorder.points
    coverage = {"fixed": replace(recorder.coverage("fixed"), misses=hidden), "zoom": recorder.coverage("zoom")}
    margin_px = margin * model.fixed.size[0]
    shares = [preferred_share(recorder.number), *rng.uniform(size=CHOICES - 1)]
    candidates = plan_placements(model, board, coverage, shares[: CHOICES // 2], rng, shared=True, margin_px=margin_px)
    candidates += plan_placements(
        model, board, coverage, shares[len(candidates) :], rng, shared=False, margin_px=margin_px
    )
    best, least = None, (np.inf, np.inf)
    for candidate in candidates:
        zoom_margin_px = margin * model.head.lens.size[0]
        turns = plan_poses(model, candidate, board, coverage["zoom"], limits, MOVED_VIEWS, rng, zoom_margin_px)
        if seen_at_home(model, candidate, board):
            turns = [(0.0, 0.0), *turns]
        error = np.inf
        if predicted is not None and turns:
            views = planned_views(recorder.number + 1, turns, len(points))
            error = predicted.error(predicted.worth(views, {recorder.number + 1: candidate}, points))
        if (error, -len(turns)) < least:
            best, least = candidate, (error, -len(turns))
    if best is None:
        raise CalibrationError("no placement of the board is visible to the fixed camera; use a smaller board")
    return best


def _see_from_everywhere(
    recorder: CaptureRecorder,
    model: BundleModel,
    requested: RigidTransform,
    fixed_view: View,
    margin: float,
    rng: np.random.Generator,
) -> RigidTransform:
    """Take the zoom views of a placement, home first, and return T_fixed_board from the fixed camera's view."""
    rig, board, coverage = recorder.rig, recorder.board, recorder.coverage("zoom")
    # Of the view's two possible poses, the one nearer to the requested rotation.
    poses = pose_candidates(model.fixed.lens, fixed_view.corners_px, recorder.points)
    T = min(poses, key=lambda pose: float((pose.rotation * requested.rotation.inv()).magnitude()))
    home = seen_at_home(model, T, board)
    turns = plan_poses(
        model, T, board, coverage, rig.head.limits, MOVED_VIEWS + (not home), rng, margin * rig.zoom.size[0]
    )
    if home:
        recorder.see_zoom()
    for pan, tilt in turns:
        recorder.turn(pan, tilt)
        recorder.see_zoom()
    return T
