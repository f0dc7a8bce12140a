"""Where a rig's model puts the corners of every view, and how that changes with its parameters.

Boards are placed in the fixed camera's frame, so that a corner X of placement b is seen

    by the fixed camera at      x_fixed = T_fixed_board X
    by the zoom camera at       x_zoom = T_head_zoom^-1 T_base_head^-1 T_head_zoom T_zoom0_fixed x_fixed       (Eq. 2)

less the way that its entrance pupil has moved forward at the focal length in use. A board that is not flat bulges
towards its z by a parabola along each side. Poses are stepped as R <- exp(w) R, t <- t + d. The derivatives are
analytic; OpenCV's cv2.projectPoints gives those of the lens.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.calibration.model import View
from cotarget.calibration.parameters import (
    LENS_PARAMETERS,
    POSE_PARAMETERS,
    Block,
    RigModel,
    columns_of,
    stop_of,
)
from cotarget.camera import Intrinsics
from cotarget.geometry import Array, Rotation
from cotarget.pantilt import HeadGeometry

E3 = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Batch:
    """Views through one lens, as arrays.

    Attributes:
        rows: which of all views these v are, (v,).
        stop: of the zoom lens; None for the fixed camera.
        pan: as the head reported it [rad], (v,).
        tilt: likewise.
        owners: index of each view's board among the model's, (v,).
        observed: corners [px], (v, N, 2); 0 where they are not seen.
        seen: which are, (v, N).
    """

    rows: npt.NDArray[np.intp]
    stop: int | None
    pan: Array
    tilt: Array
    owners: npt.NDArray[np.intp]
    observed: Array
    seen: npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a model says of a batch.

    Attributes:
        pixels: of all corners, (v, N, 2) [px].
        by_shared: derivatives by the free parameters that matter to it, (v, N, 2, k).
        columns: where these stand among all free parameters, (k,).
        by_board: derivatives by the pose of each view's own board, (v, N, 2, 6).
        by_turn: derivatives by the true pan and tilt of each view, (v, N, 2, 2); None for the fixed camera.
    """

    pixels: Array
    by_shared: Array
    columns: npt.NDArray[np.intp]
    by_board: Array
    by_turn: Array | None


def batches_of(model: RigModel, views: Sequence[View]) -> list[Batch]:
    """Sort views by lens; their placements must be among the model's boards.

    Raises:
        CalibrationError: there are views of a camera without a model.
    """
    order = {number: i for i, number in enumerate(model.boards)}
    lenses: dict[int | None, list[int]] = {}
    for row, view in enumerate(views):
        model.lens_of(view)
        stop = None if view.camera == "fixed" or model.zoom is None else stop_of(model.zoom.nominal_px, view)
        lenses.setdefault(stop, []).append(row)
    found = []
    for stop, rows in lenses.items():
        same = [views[row] for row in rows]
        corners = np.stack([view.corners_px for view in same])
        seen = np.isfinite(corners[..., 0])
        found.append(
            Batch(
                rows=np.array(rows, dtype=np.intp),
                stop=stop,
                pan=np.array([view.pan for view in same], dtype=float),
                tilt=np.array([view.tilt for view in same], dtype=float),
                owners=np.array([order[view.board] for view in same], dtype=np.intp),
                observed=np.where(seen[..., None], corners, 0.0),
                seen=seen,
            )
        )
    return found


def predict(model: RigModel, batch: Batch, points: Array, free: Collection[Block]) -> Prediction:
    """Predict every corner of a batch, and its derivatives; nan behind a camera."""
    if batch.stop is None:
        assert model.fixed is not None
        lens, own = model.fixed, "fixed"
    else:
        assert model.zoom is not None
        lens, own = model.zoom.stops[batch.stop], "zoom"
    x, moved = _points_in_camera(model, batch, points)
    pixels, by_x, by_lens, by_k3 = _project(lens, x)
    columns = columns_of(free, model.stops)
    parts, where = [], []
    if own in columns:
        first = columns[own].start + LENS_PARAMETERS * (batch.stop or 0)
        parts.append(by_lens)
        where.append(np.arange(first, first + LENS_PARAMETERS))
    if batch.stop is None and "k3" in columns:
        parts.append(by_k3)
        where.append(np.array([columns["k3"].start]))
    if batch.stop and "pupil" in columns:
        parts.append(-by_x[..., 2:])  # the camera moves forward along its own z
        where.append(np.array([columns["pupil"].start + batch.stop - 1]))
    for name, dx in moved.items():  # (v, N, 3, parameters)
        if name in columns:
            parts.append(by_x @ dx)
            where.append(np.arange(columns[name].start, columns[name].stop))
    return Prediction(
        pixels=pixels,
        by_shared=np.concatenate(parts, axis=-1) if parts else np.zeros((*pixels.shape, 0)),
        columns=np.concatenate(where) if where else np.zeros(0, dtype=np.intp),
        by_board=by_x @ moved["board"],
        by_turn=by_x @ moved["turn"] if "turn" in moved else None,
    )


def predict_pixels(model: RigModel, views: Sequence[View], points: Array) -> Array:
    """Predict every corner of all views, (V, N, 2) [px]; nan behind a camera."""
    pixels = np.empty((len(views), len(points), 2))
    for batch in batches_of(model, views):
        pixels[batch.rows] = predict(model, batch, points, ()).pixels
    return pixels


def _points_in_camera(model: RigModel, batch: Batch, points: Array) -> tuple[Array, dict[str, Array]]:
    """Map the board's points into the camera of each view, (v, N, 3), with derivatives (v, N, 3, parameters)."""
    M = np.stack([T.as_matrix() for T in model.boards.values()])[batch.owners]
    bulge = _bulge(points)
    turned = (points + np.outer(bulge @ model.warp, E3)) @ M[:, :3, :3].swapaxes(1, 2)
    y = turned + M[:, None, :3, 3]  # x_fixed
    d_board = _pose_derivative(turned)
    d_warp = M[:, None, :3, 2:3] * bulge[:, None]  # dy/dwarp, (v, N, 3, 2)
    if batch.stop is None:
        return y, {"board": d_board, "warp": d_warp}
    assert model.zoom is not None
    R_g, R_h = model.gamma.rotation.as_matrix(), model.hand.rotation.as_matrix()
    t_h = model.hand.translation
    R_p, t_p, A = base_heads(model.head, batch.pan, batch.tilt)
    turned_g = y @ R_g.T
    w = turned_g + model.gamma.translation  # x_zoom0
    turned_h = w @ R_h.T
    v = turned_h + t_h  # x_base
    p = (v - t_p[:, None]) @ R_p  # x_head = R_p^T (x_base - t_p)
    x = (p - t_h) @ R_h - model.zoom.pupil[batch.stop] * E3  # x_zoom, from the pupil
    R_xp = R_h.T  # dx/dp
    R_xv = R_xp @ R_p.swapaxes(1, 2)  # dx/dv
    R_xw = R_xv @ R_h  # dx/dw
    d_hand = R_xv[:, None] @ _pose_derivative(turned_h) - R_xp @ _pose_derivative(p - t_h)
    d_turn = R_xp @ _by_turn(model.head, A, p)
    return x, {
        "board": (R_xw @ R_g)[:, None] @ d_board,
        "warp": (R_xw @ R_g)[:, None] @ d_warp,
        "gamma": R_xw[:, None] @ _pose_derivative(turned_g),
        "hand": d_hand,
        "head": R_xp @ _by_head(model.head, A, p),
        "scale": d_turn * np.stack([batch.pan, batch.tilt], axis=-1)[:, None, None],
        "zero": d_turn,
        "turn": d_turn,
    }


def _bulge(points: Array) -> Array:
    """How far each corner of a board stands out for a unit of warp along x and along y, (N, 2): 1 in the middle."""
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    half = np.maximum((high - low) / 2, np.finfo(float).tiny)
    return np.asarray(1 - ((points[:, :2] - (low + high) / 2) / half) ** 2)


def base_heads(head: HeadGeometry, pan: Array, tilt: Array) -> tuple[Array, Array, Array]:
    """T_base_head of many poses at once (Eq. 8 with dz and eps).

    Args:
        head: the unit's geometry.
        pan: as the head reports it [rad], (v,).
        tilt: likewise.

    Returns:
        Rotations (v, 3, 3), translations (v, 3), and the tilts' own rotations (v, 3, 3).
    """
    pan, tilt = head.true_angles(pan, tilt)
    turns = Rotation.from_rotvec(pan[:, None] * np.array([0.0, 1.0, 0.0])).as_matrix()
    A = Rotation.from_rotvec(tilt[:, None] * head.tilt_axis).as_matrix()
    offset = head.axis_offset * (E3 - A @ E3)  # Trans(dz) A Trans(-dz) is A with this translation
    return turns @ A, np.einsum("vij,vj->vi", turns, offset), A


def _by_head(head: HeadGeometry, A: Array, x_head: Array) -> Array:
    """How x_head changes with dz and with eps, (v, N, 3, 2).

    With A the tilt's rotation, x_head = A^T (q - dz e3) + dz e3 where q = Rot(Y, -pan) x_base.
    """
    by_dz = np.broadcast_to((E3 - A[:, 2])[:, None], x_head.shape)  # A^T e3 is A's third row
    # A = Rot(Z, eps) Rot(X, tilt) Rot(Z, -eps), so dA^T/deps = [e3]x A^T - A^T [e3]x
    a = x_head - head.axis_offset * E3
    u = a @ A.swapaxes(1, 2)
    by_eps = np.cross(E3, a) - np.cross(E3, u) @ A
    return np.stack([by_dz, by_eps], axis=-1)


def _by_turn(head: HeadGeometry, A: Array, x_head: Array) -> Array:
    """How x_head changes with true pan and tilt, (v, N, 3, 2), in the terms of `_by_head`."""
    a = x_head - head.axis_offset * E3
    q = a @ A.swapaxes(1, 2) + head.axis_offset * E3
    by_pan = -np.cross(np.array([0.0, 1.0, 0.0]), q) @ A  # dq/dpan = -e2 x q, then A^T
    by_tilt = -np.cross(head.tilt_axis, a)
    return np.stack([by_pan, by_tilt], axis=-1)


def _pose_derivative(turned: Array) -> Array:
    """Derivative of R x + t by a step (w, d), given R x: [-[R x]x, I], (..., 3, 6)."""
    x, y, z = np.moveaxis(turned, -1, 0)
    o, i = np.zeros_like(x), np.ones_like(x)
    rows = [[o, z, -y, i, o, o], [-z, o, x, o, i, o], [y, -x, o, o, o, i]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _project(lens: Intrinsics, x_camera: Array) -> tuple[Array, Array, Array, Array]:
    """Project points (v, N, 3): pixels, derivatives by the point (v, N, 2, 3), the lens (..., 8) and k3 (..., 1)."""
    v, n = x_camera.shape[:2]
    x = np.ascontiguousarray(x_camera.reshape(-1, 1, 3))
    x = np.where(x[..., 2:] > 0, x, np.nan)
    px, J = cv2.projectPoints(x, np.zeros(3), np.zeros(3), lens.matrix, np.array(lens.distortion))
    J = np.asarray(J).reshape(v, n, 2, -1)
    last = POSE_PARAMETERS + LENS_PARAMETERS
    by_point = J[..., 3:POSE_PARAMETERS]  # by t, which is the same
    return np.asarray(px).reshape(v, n, 2), by_point, J[..., POSE_PARAMETERS:last], J[..., last : last + 1]
