"""The part of a capture session that sees boards at the zoom lens's other stops.

Boards are held far away, where the fixed camera still sees them whole; at each the lens goes through all stops, and the
head brings parts of the board all over the zoom image. The first board teaches each stop before the next one is tried.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cotarget.calibration.boards import board_points
from cotarget.calibration.model import View
from cotarget.calibration.parameters import RigModel
from cotarget.calibration.placing import place_boards
from cotarget.calibration.plan import Coverage, plan_placements, where_in
from cotarget.calibration.recorder import Recorder
from cotarget.calibration.reprojection import base_heads
from cotarget.calibration.stops import (
    FEWEST_CORNERS,
    SAME_FOCAL,
    expected_corners,
    expected_inside,
    find_expected,
    fit_stop,
    same_focal,
    with_stop,
)
from cotarget.camera import Intrinsics
from cotarget.geometry import Array, RigidTransform
from cotarget.pantilt import solve
from cotarget.rig import PanTiltLimits

# Shares of the way from near to far at which boards are held: far, because the fixed camera must see a board whole that
# fills the zoom image many times over; not all as far, or the entrance pupil could not be told from the focal length.
NEAREST_SHARE, FARTHEST_SHARE = 0.6, 1.0
VIEWS_A_STOP = 2  # of each placement
FIRST_VIEWS = 3  # of the first placement, from which a stop is learnt
ATTEMPTS = 3  # times as many placements are tried, where some are not seen
CANDIDATES = 60  # ways to bring a part of the board into the image that are tried for each view
BORDER_PX = 12.0  # a point of the board is brought anywhere but this near to the image's border


def see_stops(
    recorder: Recorder,
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
    recorder: Recorder,
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
    recorder: Recorder,
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
    view = recorder.see_zoom(
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
