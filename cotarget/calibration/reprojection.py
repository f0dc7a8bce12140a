"""Where a rig's model puts the corners of every view, and how that changes with its parameters.

Boards are placed in the fixed camera's frame, so that a corner X of placement b is seen

    by the fixed camera at      x_fixed = T_fixed_board X
    by the zoom camera at       x_zoom = T_head_zoom^-1 T_base_head^-1 T_head_zoom T_zoom0_fixed x_fixed       (Eq. 2)

Poses are stepped as R <- exp(w) R, t <- t + d. The derivatives are analytic; OpenCV's cv2.projectPoints gives those of
the lens.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from cotarget.calibration.model import View
from cotarget.camera import Intrinsics
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.pantilt import IDEAL_HEAD, HeadGeometry

Block = Literal["fixed", "zoom", "gamma", "hand", "head"]

# fx fy cx cy k1 k2 p1 p2, the order of OpenCV's Jacobian after the pose; k3, the next, stays as it is: it hardly
# changes the residuals of real photos (0.0002 px) but bends the image where no board was seen.
FREE_LENS_PARAMETERS = 8
POSE_PARAMETERS = 6
BLOCK_WIDTHS: dict[Block, int] = {
    "fixed": FREE_LENS_PARAMETERS,
    "zoom": FREE_LENS_PARAMETERS,
    "gamma": POSE_PARAMETERS,
    "hand": POSE_PARAMETERS,
    "head": 2,
}
LENS_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
POSE_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")
BLOCK_NAMES: dict[Block, tuple[str, ...]] = {
    "fixed": tuple(f"fixed.{name}" for name in LENS_NAMES),
    "zoom": tuple(f"zoom.{name}" for name in LENS_NAMES),
    "gamma": tuple(f"T_zoom0_fixed.{name}" for name in POSE_NAMES),
    "hand": tuple(f"T_head_zoom.{name}" for name in POSE_NAMES),
    "head": ("head.axis_offset", "head.squareness"),
}
STILL = RigidTransform.identity()
E3 = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class RigModel:
    """Everything that determines where corners appear.

    Attributes:
        fixed: the fixed camera, None while only the zoom camera is looked at.
        zoom: the zoom camera at the focal length of the views, None while only the fixed camera is looked at.
        gamma: T_zoom0_fixed.
        hand: T_head_zoom.
        head: the pan-tilt unit's geometry.
        boards: T_fixed_board of each placement.
    """

    boards: dict[int, RigidTransform]
    fixed: Intrinsics | None = None
    zoom: Intrinsics | None = None
    gamma: RigidTransform = STILL
    hand: RigidTransform = STILL
    head: HeadGeometry = IDEAL_HEAD


def predict(
    model: RigModel, views: Sequence[View], points: Array, free: Collection[Block]
) -> tuple[Array, Array, Array]:
    """Predict every corner, and its derivatives.

    Returns:
        Pixels (V, N, 2); derivatives by the free blocks, in the order of `BLOCK_WIDTHS`, (V, N, 2, n); and by the pose
        of the view's own board, (V, N, 2, 6).
    """
    columns = columns_of(free)
    shape = (len(views), len(points), 2)
    pixels = np.empty(shape)
    by_shared = np.zeros((*shape, sum(BLOCK_WIDTHS[name] for name in columns)))
    by_board = np.empty((*shape, POSE_PARAMETERS))
    for camera in ("fixed", "zoom"):
        rows = np.array([i for i, view in enumerate(views) if view.camera == camera], dtype=int)
        if not len(rows):
            continue
        lens = model.fixed if camera == "fixed" else model.zoom
        if lens is None:
            raise CalibrationError(f"there are views of the {camera} camera, but no model of it")
        x, moved = _points_in_camera(model, [views[i] for i in rows], points, zoom=camera == "zoom")
        pixels[rows], by_x, by_lens = _project(lens, x)
        by_board[rows] = by_x @ moved.pop("board")
        for name, dx in moved.items():  # (v, N, 3, parameters)
            if name in columns:
                by_shared[rows, :, :, columns[name]] = by_x @ dx
        if camera in columns:
            by_shared[rows, :, :, columns[camera]] = by_lens
    return pixels, by_shared, by_board


def columns_of(free: Collection[Block]) -> dict[Block, slice]:
    """Where each free block stands among the shared parameters."""
    columns: dict[Block, slice] = {}
    width = 0
    for name, size in BLOCK_WIDTHS.items():
        if name in free:
            columns[name] = slice(width, width + size)
            width += size
    return columns


def parameter_names(free: Collection[Block]) -> tuple[str, ...]:
    """Name the free blocks' parameters, in their order among the shared ones; see `Covariance` for their units."""
    return tuple(name for block in columns_of(free) for name in BLOCK_NAMES[block])


def stepped(model: RigModel, shared: Array, boards: Array, free: Collection[Block]) -> RigModel:
    """Add a step to the shared parameters (n,) and to the boards' poses (B, 6)."""
    steps = {name: shared[columns] for name, columns in columns_of(free).items()}
    head = model.head
    if "head" in steps:
        d_dz, d_eps = (float(d) for d in steps["head"])
        head = HeadGeometry(head.axis_offset + d_dz, head.squareness + d_eps)
    return RigModel(
        boards={number: _moved(T, d) for (number, T), d in zip(model.boards.items(), boards, strict=True)},
        fixed=_bent(model.fixed, steps.get("fixed")),
        zoom=_bent(model.zoom, steps.get("zoom")),
        gamma=_moved(model.gamma, steps.get("gamma")),
        hand=_moved(model.hand, steps.get("hand")),
        head=head,
    )


def _moved(T: RigidTransform, step: Array | None) -> RigidTransform:
    if step is None:
        return T
    return RigidTransform.from_components(T.translation + step[3:], Rotation.from_rotvec(step[:3]) * T.rotation)


def _bent(lens: Intrinsics | None, step: Array | None) -> Intrinsics | None:
    if step is None or lens is None:
        return lens
    values = np.array([*lens.focal_px, *lens.center_px, *lens.distortion])
    values[:FREE_LENS_PARAMETERS] += step
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (float(value) for value in values)
    return Intrinsics(lens.size, (fx, fy), (cx, cy), (k1, k2, p1, p2, k3))


def _points_in_camera(
    model: RigModel, views: Sequence[View], points: Array, *, zoom: bool
) -> tuple[Array, dict[str, Array]]:
    """Map the board's points into the camera of each view, (v, N, 3), with derivatives (v, N, 3, parameters)."""
    R_b = np.stack([model.boards[view.board].rotation.as_matrix() for view in views])
    t_b = np.stack([model.boards[view.board].translation for view in views])
    turned = points @ R_b.swapaxes(1, 2)
    y = turned + t_b[:, None]  # x_fixed
    d_board = _pose_derivative(turned)
    if not zoom:
        return y, {"board": d_board}
    R_g, R_h = model.gamma.rotation.as_matrix(), model.hand.rotation.as_matrix()
    t_h = model.hand.translation
    pan, tilt = (np.array([getattr(view, axis) for view in views]) for axis in ("pan", "tilt"))
    R_p, t_p, A = base_heads(model.head, pan, tilt)
    turned_g = y @ R_g.T
    w = turned_g + model.gamma.translation  # x_zoom0
    turned_h = w @ R_h.T
    v = turned_h + t_h  # x_base
    p = (v - t_p[:, None]) @ R_p  # x_head = R_p^T (x_base - t_p)
    x = (p - t_h) @ R_h  # x_zoom
    R_xp = R_h.T  # dx/dp
    R_xv = R_xp @ R_p.swapaxes(1, 2)  # dx/dv
    R_xw = R_xv @ R_h  # dx/dw
    d_hand = R_xv[:, None] @ _pose_derivative(turned_h) - R_xp @ _pose_derivative(p - t_h)
    return x, {
        "board": (R_xw @ R_g)[:, None] @ d_board,
        "gamma": R_xw[:, None] @ _pose_derivative(turned_g),
        "hand": d_hand,
        "head": R_xp @ _by_head(model.head, A, p),
    }


def base_heads(head: HeadGeometry, pan: Array, tilt: Array) -> tuple[Array, Array, Array]:
    """T_base_head of many poses at once (Eq. 8 with dz and eps).

    Args:
        head: the unit's geometry.
        pan: [rad], (v,).
        tilt: [rad], (v,).

    Returns:
        Rotations (v, 3, 3), translations (v, 3), and the tilts' own rotations (v, 3, 3).
    """
    turns = Rotation.from_rotvec(pan[:, None] * np.array([0.0, 1.0, 0.0])).as_matrix()
    axis = np.array([np.cos(head.squareness), np.sin(head.squareness), 0.0])
    A = Rotation.from_rotvec(tilt[:, None] * axis).as_matrix()
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


def _pose_derivative(turned: Array) -> Array:
    """Derivative of R x + t by a step (w, d), given R x: [-[R x]x, I], (..., 3, 6)."""
    x, y, z = np.moveaxis(turned, -1, 0)
    o, i = np.zeros_like(x), np.ones_like(x)
    rows = [[o, z, -y, i, o, o], [-z, o, x, o, i, o], [y, -x, o, o, o, i]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _project(lens: Intrinsics, x_camera: Array) -> tuple[Array, Array, Array]:
    """Project points (v, N, 3): pixels, derivatives by the point (v, N, 2, 3) and by the lens (v, N, 2, 8)."""
    v, n = x_camera.shape[:2]
    x = np.ascontiguousarray(x_camera.reshape(-1, 1, 3))
    x = np.where(x[..., 2:] > 0, x, np.nan)
    px, J = cv2.projectPoints(x, np.zeros(3), np.zeros(3), lens.matrix, np.array(lens.distortion))
    J = np.asarray(J).reshape(v, n, 2, -1)
    by_lens = J[..., POSE_PARAMETERS : POSE_PARAMETERS + FREE_LENS_PARAMETERS]
    return np.asarray(px).reshape(v, n, 2), J[..., 3:POSE_PARAMETERS], by_lens  # by t, which equals by the point
