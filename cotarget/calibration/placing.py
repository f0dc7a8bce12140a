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
from cotarget.calibration.reprojection import RigModel, predict
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
        # One view of each camera, where there are two cameras: their candidates differ.
        by_camera = {view.camera: view for view in reversed(same)}
        candidates = [T for view in list(by_camera.values())[:ASKED_VIEWS] for T in _suggested(model, view, points)]
        errors = [_misfit(model, number, T, same, points) for T in candidates]
        boards[number] = candidates[int(np.argmin(errors))]
    return replace(model, boards=boards)


def _suggested(model: RigModel, view: View, points: Array) -> list[RigidTransform]:
    """T_fixed_board as one view may mean it."""
    lens = model.fixed if view.camera == "fixed" else model.zoom
    assert lens is not None
    poses = pose_candidates(lens, view.corners_px, points)
    if view.camera == "fixed":
        return poses
    T_fixed_zoom = zoom_fixed(view.pan, view.tilt, model.hand, model.gamma, model.head).inv()
    return [T_fixed_zoom * T for T in poses]


def _misfit(model: RigModel, number: int, T: RigidTransform, views: Sequence[View], points: Array) -> float:
    """Mean distance between predicted and seen corners [px]; infinite behind a camera."""
    pixels = predict(replace(model, boards={number: T}), views, points, ())[0]
    off = np.linalg.norm(pixels - np.stack([view.corners_px for view in views]), axis=-1)
    return float(np.mean(off)) if np.isfinite(off).all() else np.inf
