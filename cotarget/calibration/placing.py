"""Where each placement's board is, told by all of its views together.

One view of a flat board has two poses that explain it about equally, mirrored at the line of sight. Another view, by
the other camera or from another pose of the head, tells them apart.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cotarget.calibration.intrinsics import pose_candidates
from cotarget.calibration.model import View
from cotarget.calibration.parameters import RigModel, stop_of
from cotarget.calibration.reprojection import predict_pixels
from cotarget.geometry import Array, RigidTransform
from cotarget.pantilt import zoom_fixed

ASKED_VIEWS = 2  # of a placement, whose candidates are tried on all of its views


def place_boards(model: RigModel, views: Sequence[View], points: Array) -> RigModel:
    """Give every placement the pose, of those that its views suggest, at which all of its views fit best.

    Args:
        model: with the intrinsics of the cameras that took the views, Gamma and T, at least roughly.
        views: of any placements.
        points: the board's corners in its frame [m], (N, 3).

    Returns:
        The model with these placements' boards and no others.
    """
    placements: dict[int, list[View]] = defaultdict(list)
    for view in views:
        placements[view.board].append(view)
    boards = {}
    for number, same in placements.items():
        # One view of each camera, where there are two cameras: their candidates differ. The one that shows most.
        by_camera = {view.camera: view for view in sorted(same, key=lambda view: int(view.seen.sum()))}
        candidates = [T for view in list(by_camera.values())[:ASKED_VIEWS] for T in _suggested(model, view, points)]
        errors = [_misfit(model, number, T, same, points) for T in candidates]
        boards[number] = candidates[int(np.argmin(errors))]
    return replace(model, boards=boards)


def _suggested(model: RigModel, view: View, points: Array) -> list[RigidTransform]:
    """T_fixed_board as one view may mean it."""
    poses = pose_candidates(model.lens_of(view), view.corners_px, points)
    if view.camera == "fixed":
        return poses
    assert model.zoom is not None
    pupil = RigidTransform.from_translation([0.0, 0.0, model.zoom.pupil[stop_of(model.zoom.nominal_px, view)]])
    T_fixed_zoom = zoom_fixed(view.pan, view.tilt, model.hand, model.gamma, model.head).inv() * pupil
    return [T_fixed_zoom * T for T in poses]


def _misfit(model: RigModel, number: int, T: RigidTransform, views: Sequence[View], points: Array) -> float:
    """Mean distance between predicted and seen corners [px]; infinite behind a camera."""
    pixels = predict_pixels(replace(model, boards={number: T}), views, points)
    off = np.concatenate([
        np.linalg.norm(predicted[view.seen] - view.corners_px[view.seen], axis=-1)
        for predicted, view in zip(pixels, views, strict=True)
    ])  # fmt: skip
    return float(np.mean(off)) if np.isfinite(off).all() else np.inf
