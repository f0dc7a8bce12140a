"""Bundle adjustment: fit a rig's parameters and the boards' poses to the corners of all views.

Every step of a calibration is one `fit`; the steps differ in which parameter blocks are free. The last one solves what
is saved: T (T_head_zoom), Gamma (T_zoom0_fixed), the lenses and the head's axes. With X a corner in the
board's frame, it is seen

    by the fixed camera at      x_fixed = T_fixed_board X
    by the zoom camera at       x_zoom = T_head_zoom^-1 T_base_head^-1 T_head_zoom T_zoom0_fixed x_fixed       (Eq. 2)

less the entrance pupil's shift along z at the focal length in use. A bent board bulges towards its z by a parabola
along each side. Poses step by R <- exp(w) R, t <- t + d. Derivatives are analytic; those of the lens are OpenCV's.

The solver is Levenberg-Marquardt with Huber's loss, because some corners are found wrongly. Each view depends on one
board's pose, so the boards' poses are eliminated (Schur complement), which leaves the normal matrix of the shared
parameters. A head that does not stand quite where it reports shifts all corners of a view together: this jitter is two
more unknowns per view, its true pan and tilt, with a prior at the reported ones, and they are eliminated too.
Measurements: docs/design-notes.md.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.calibration.model import BundleModel, View
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.pantilt import E3, base_heads, by_axes, by_turn
from cotarget.rig_geometry import FixedCamera, ZoomHead

Block = Literal["fixed", "zoom", "pupil", "gamma", "hand", "head", "warp", "k3", "scale", "zero"]
# Blocks that a calibration fits by default, in the parameters' order. "k3" is the fixed camera's; "scale" and "zero"
# are the encoders'.
ALL_BLOCKS: tuple[Block, ...] = ("fixed", "zoom", "pupil", "gamma", "hand", "head", "warp")
EVERY_BLOCK: tuple[Block, ...] = (*ALL_BLOCKS, "k3", "scale", "zero")
# The order of OpenCV's Jacobian after the pose. k3, the next, is a block by itself: most lenses do not need it, and it
# would bend the image where no board was seen.
LENS_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
LENS_PARAMETERS = len(LENS_NAMES)
POSE_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")
POSE_PARAMETERS = len(POSE_NAMES)
HEAD_NAMES = {
    "head": ("axis_offset", "squareness"),
    "scale": ("pan_scale", "tilt_scale"),
    "zero": ("pan_zero", "tilt_zero"),
}


@lru_cache
def block_names(stops: int) -> dict[Block, list[str]]:
    """Name the parameters of every block, in their order, for a lens of ``stops`` zoom samples; see `Covariance`."""
    return {
        "fixed": [f"fixed.{name}" for name in LENS_NAMES],
        "zoom": [f"zoom[{i}].{name}" for i in range(stops) for name in LENS_NAMES],
        "pupil": [f"zoom[{i}].pupil" for i in range(1, stops)],
        "gamma": [f"T_zoom0_fixed.{name}" for name in POSE_NAMES],
        "hand": [f"T_head_zoom.{name}" for name in POSE_NAMES],
        "head": [f"head.{name}" for name in HEAD_NAMES["head"]],
        "warp": ["board.warp_x", "board.warp_y"],
        "k3": ["fixed.k3"],
        "scale": [f"head.{name}" for name in HEAD_NAMES["scale"]],
        "zero": [f"head.{name}" for name in HEAD_NAMES["zero"]],
    }


def parameter_names(free: Collection[Block], stops: int = 1) -> tuple[str, ...]:
    """Name the parameters of the free blocks in their order."""
    return tuple(name for block, names in block_names(stops).items() if block in free for name in names)


def columns_of(free: Collection[Block], stops: int) -> dict[str, slice]:
    """Map each free block to its slice of the shared parameters."""
    columns: dict[str, slice] = {}
    width = 0
    for block, names in block_names(stops).items():
        if block in free:
            columns[block] = slice(width, width + len(names))
            width += len(names)
    return columns


def nudged(model: BundleModel, name: str, step: float) -> BundleModel:
    """Return a model without boards in which one parameter differs by a step."""
    block, names = next((block, names) for block, names in block_names(model.stops).items() if name in names)
    steps = step * np.array([name == other for other in names], dtype=float)
    return stepped(replace(model, boards={}), steps, np.empty((0, POSE_PARAMETERS)), (block,))


def stepped(model: BundleModel, shared: Array, boards: Array, free: Collection[Block]) -> BundleModel:
    """Apply a step of the shared parameters (n,) and of the boards' poses (B, 6) to a model."""
    steps = {name: shared[columns] for name, columns in columns_of(free, model.stops).items()}
    bend = steps.get("warp", np.zeros(2)).tolist()
    return BundleModel(
        boards=_all_moved(model.boards, boards),
        fixed=_stepped_camera(model.fixed, steps),
        zoom_head=None if model.zoom_head is None else _stepped_head(model.zoom_head, steps),
        warp=(model.warp[0] + bend[0], model.warp[1] + bend[1]),
    )


def _stepped_camera(camera: FixedCamera, steps: Mapping[str, Array]) -> FixedCamera:
    """Apply the steps of the fixed camera's blocks; without any it is the same object."""
    lens = camera.lens
    if "fixed" in steps:
        lens = _bent(lens, steps["fixed"])
    if "k3" in steps:
        lens = replace(lens, distortion=(*lens.distortion[:4], lens.distortion[4] + float(steps["k3"][0])))
    return camera if lens is camera.lens else replace(camera, lens=lens)


def _stepped_head(head: ZoomHead, steps: Mapping[str, Array]) -> ZoomHead:
    """Apply the steps of the blocks of the zoom camera and its head."""
    axes = head.axes
    for block, names in HEAD_NAMES.items():
        if block in steps:
            changed = {name: getattr(axes, name) + float(d) for name, d in zip(names, steps[block], strict=True)}
            axes = replace(axes, **changed)
    lens, stops = head.lens, len(head.lens.stops)
    if "zoom" in steps or "pupil" in steps:
        lenses = steps.get("zoom", np.zeros(LENS_PARAMETERS * stops)).reshape(stops, LENS_PARAMETERS)
        pupils = np.append(0.0, steps.get("pupil", np.zeros(stops - 1)))
        lens = ZoomLens(
            lens.nominal_px,
            tuple(_bent(stop, step) for stop, step in zip(lens.stops, lenses, strict=True)),
            tuple(float(old + step) for old, step in zip(lens.pupil, pupils, strict=True)),
        )
    return ZoomHead(
        lens, _moved(head.T_zoom0_fixed, steps.get("gamma")), _moved(head.hand_eye(), steps.get("hand")), axes
    )


def difference(model: BundleModel, reference: BundleModel, free: Collection[Block]) -> Array:
    """Compute the step of the shared parameters from the reference to the model, (n,), the inverse of `stepped`."""
    return np.concatenate([np.zeros(0), *(_difference(model, reference, b) for b in columns_of(free, model.stops))])


def _difference(model: BundleModel, reference: BundleModel, block: str) -> Array:
    """Compute the step of one block from the reference to the model."""
    lens, known_lens, head, known = model.fixed.lens, reference.fixed.lens, model.head, reference.head
    match block:
        case "fixed":
            return _numbers(lens) - _numbers(known_lens)
        case "k3":
            return np.array([lens.distortion[4] - known_lens.distortion[4]])
        case "warp":
            return np.subtract(model.warp, reference.warp)
        case "zoom":
            pairs = zip(head.lens.stops, known.lens.stops, strict=True)
            return np.concatenate([_numbers(a) - _numbers(b) for a, b in pairs])
        case "pupil":
            return np.subtract(head.lens.pupil, known.lens.pupil)[1:]
        case "gamma":
            return _pose_difference(head.T_zoom0_fixed, known.T_zoom0_fixed)
        case "hand":
            return _pose_difference(head.hand_eye(), known.hand_eye())
        case _:
            return np.array([getattr(head.axes, k) - getattr(known.axes, k) for k in HEAD_NAMES[block]])


def _pose_difference(T: RigidTransform, reference: RigidTransform) -> Array:
    """Compute the step (w, d) from the reference to T, (6,), the inverse of `_moved`."""
    turn = (T.rotation * reference.rotation.inv()).as_rotvec()
    return np.concatenate([turn, T.translation - reference.translation])


def _all_moved(boards: Mapping[int, RigidTransform], steps: Array) -> dict[int, RigidTransform]:
    """Apply pose steps (B, 6) to all boards at once: scipy takes as long for one transform as for a hundred."""
    if not boards:
        return {}
    M = np.stack([T.as_matrix() for T in boards.values()])
    M[:, :3, :3] = Rotation.from_rotvec(steps[:, :3]).as_matrix() @ M[:, :3, :3]
    M[:, :3, 3] += steps[:, 3:]
    moved = RigidTransform.from_matrix(M)  # orthonormal again
    return {number: moved[i] for i, number in enumerate(boards)}


def _moved(T: RigidTransform, step: Array | None) -> RigidTransform:
    """Apply a pose step (6,), if there is one."""
    return T if step is None else _all_moved({0: T}, step[None])[0]


def _numbers(lens: Intrinsics) -> Array:
    return np.array([*lens.focal_px, *lens.center_px, *lens.distortion])[:LENS_PARAMETERS]


def _bent(lens: Intrinsics, step: Array) -> Intrinsics:
    fx, fy, cx, cy, k1, k2, p1, p2 = (float(value) for value in _numbers(lens) + step)
    return Intrinsics(lens.size, (fx, fy), (cx, cy), (k1, k2, p1, p2, lens.distortion[4]))


# Reprojection of the corners


@dataclass(frozen=True, eq=False)
class Batch:
    """Views through one lens, as arrays."""

    rows: npt.NDArray[np.intp]  # indices of these v views among all, (v,)
    stop: int | None  # index of the zoom sample; None for the fixed camera
    pan: Array  # reported pan [rad], (v,)
    tilt: Array  # reported tilt [rad], (v,)
    owners: npt.NDArray[np.intp]  # index of each view's board among the model's boards, (v,)
    observed: Array  # corners [px], (v, N, 2); 0 for corners that are not seen
    seen: npt.NDArray[np.bool_]  # True for corners that are seen, (v, N)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Corners of a batch as a model predicts them, with derivatives."""

    pixels: Array  # all corners, (v, N, 2) [px]
    by_shared: Array  # derivatives by the free shared parameters on which the batch depends, (v, N, 2, k)
    columns: npt.NDArray[np.intp]  # indices of these among all free shared parameters, (k,)
    by_board: Array  # derivatives by the pose of each view's board, (v, N, 2, 6)
    by_turn: Array | None  # derivatives by the true pan and tilt of each view, (v, N, 2, 2); None for the fixed camera


def batches_of(model: BundleModel, views: Sequence[View]) -> list[Batch]:
    """Group views by lens; their placements must be among the model's boards."""
    order = {number: i for i, number in enumerate(model.boards)}
    lenses: dict[int | None, list[int]] = {}
    for row, view in enumerate(views):
        lenses.setdefault(model.stop_of(view), []).append(row)
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


def predict(model: BundleModel, batch: Batch, points: Array, free: Collection[Block]) -> Prediction:
    """Predict every corner of a batch with its derivatives; nan behind a camera."""
    own = "fixed" if batch.stop is None else "zoom"
    lens = model.fixed.lens if batch.stop is None else model.head.lens.stops[batch.stop]
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


def predict_pixels(model: BundleModel, views: Sequence[View], points: Array) -> Array:
    """Predict every corner of all views, (V, N, 2) [px]; nan behind a camera."""
    pixels = np.empty((len(views), len(points), 2))
    for batch in batches_of(model, views):
        pixels[batch.rows] = predict(model, batch, points, ()).pixels
    return pixels


def _points_in_camera(model: BundleModel, batch: Batch, points: Array) -> tuple[Array, dict[str, Array]]:
    """Map the board's points into the camera of each view, (v, N, 3), with derivatives (v, N, 3, parameters)."""
    M = np.stack([T.as_matrix() for T in model.boards.values()])[batch.owners]
    bulge = _bulge(points)
    turned = (points + np.outer(bulge @ model.warp, E3)) @ M[:, :3, :3].swapaxes(1, 2)
    y = turned + M[:, None, :3, 3]  # x_fixed
    d_board = _pose_derivative(turned)
    d_warp = M[:, None, :3, 2:3] * bulge[:, None]  # dy/dwarp, (v, N, 3, 2)
    if batch.stop is None:
        return y, {"board": d_board, "warp": d_warp}
    head, hand = model.head, model.head.hand_eye()
    R_g, R_h = (T.as_matrix()[:3, :3] for T in (head.T_zoom0_fixed, hand))
    t_h = hand.translation
    R_p, t_p, A = base_heads(head.axes, batch.pan, batch.tilt)
    turned_g = y @ R_g.T
    w = turned_g + head.T_zoom0_fixed.translation  # x_zoom0
    turned_h = w @ R_h.T
    v = turned_h + t_h  # x_base
    p = (v - t_p[:, None]) @ R_p  # x_head = R_p^T (x_base - t_p)
    x = (p - t_h) @ R_h - head.lens.pupil[batch.stop] * E3  # x_zoom, from the pupil
    R_xp = R_h.T  # dx/dp
    R_xv = R_xp @ R_p.swapaxes(1, 2)  # dx/dv
    R_xw = R_xv @ R_h  # dx/dw
    d_hand = R_xv[:, None] @ _pose_derivative(turned_h) - R_xp @ _pose_derivative(p - t_h)
    d_turn = R_xp @ by_turn(head.axes, A, p)
    return x, {
        "board": (R_xw @ R_g)[:, None] @ d_board,
        "warp": (R_xw @ R_g)[:, None] @ d_warp,
        "gamma": R_xw[:, None] @ _pose_derivative(turned_g),
        "hand": d_hand,
        "head": R_xp @ by_axes(head.axes, A, p),
        "scale": d_turn * np.stack([batch.pan, batch.tilt], axis=-1)[:, None, None],
        "zero": d_turn,
        "turn": d_turn,
    }


def _bulge(points: Array) -> Array:
    """Compute how far each corner stands out for a unit of warp along x and along y, (N, 2): 1 in the middle."""
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    half = np.maximum((high - low) / 2, np.finfo(float).tiny)
    return np.asarray(1 - ((points[:, :2] - (low + high) / 2) / half) ** 2)


def _pose_derivative(turned: Array) -> Array:
    """Compute the derivative of R x + t by a step (w, d), given R x: [-[R x]x, I], (..., 3, 6)."""
    x, y, z = np.moveaxis(turned, -1, 0)
    d = np.zeros((*turned.shape, POSE_PARAMETERS))
    d[..., 0, 1], d[..., 0, 2] = z, -y
    d[..., 1, 0], d[..., 1, 2] = -z, x
    d[..., 2, 0], d[..., 2, 1] = y, -x
    d[..., 3:] = np.eye(3)
    return d


def _project(lens: Intrinsics, x_camera: Array) -> tuple[Array, Array, Array, Array]:
    """Project points (v, N, 3): pixels, derivatives by the point (v, N, 2, 3), the lens (..., 8) and k3 (..., 1)."""
    v, n = x_camera.shape[:2]
    x = np.ascontiguousarray(x_camera.reshape(-1, 1, 3))
    x = np.where(x[..., 2:] > 0, x, np.nan)
    px, J = cv2.projectPoints(x, np.zeros(3), np.zeros(3), lens.matrix, np.array(lens.distortion))
    J = np.asarray(J).reshape(v, n, 2, -1)
    last = POSE_PARAMETERS + LENS_PARAMETERS
    by_point = J[..., 3:POSE_PARAMETERS]  # the derivative by t equals that by the point
    return np.asarray(px).reshape(v, n, 2), by_point, J[..., POSE_PARAMETERS:last], J[..., last : last + 1]


# Normal equations

SMALLEST_DAMPING = 1e-12
TURNS = 2  # pan and tilt


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian prior of the shared parameters."""

    reference: BundleModel  # model with the means
    sigmas: Mapping[str, float]  # standard deviations by parameter name; a parameter without one has no prior


# Indices of the shared parameters on which a batch depends (k,), and J^T W J of each of its views (v, m, m).
Gram = tuple[npt.NDArray[np.intp], Array]


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations in blocks: the n shared parameters, and the poses of B boards."""

    shared: Array  # (n, n)
    mixed: Array  # shared parameters by each board's pose, (B, n, 6)
    boards: Array  # (B, 6, 6)
    shared_gradient: Array  # (n,)
    board_gradient: Array  # (B, 6)
    squares: float  # weighted sum of squared residuals [px^2]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A model's residuals, batch by batch."""

    model: BundleModel
    predictions: list[Prediction]
    residuals: list[Array]  # predicted minus observed, (v, N, 2) [px]; 0 for corners that are not seen
    adjusted: list[Array]  # residuals after each view's pan and tilt are fitted within the jitter, (v, N, 2) [px]
    squared_turns: float  # sum of the squared changes of pan and tilt [rad^2]
    finite: bool  # False where a board is behind a camera
    sigma: float  # robust standard deviation of a coordinate of ``adjusted`` [px]


@dataclass(frozen=True, eq=False)
class Problem:
    """Least-squares problem of one fit."""

    batches: list[Batch]
    points: Array  # the board's corners in its frame [m], (N, 3)
    free: tuple[Block, ...]
    prior: Prior | None
    jitter: float  # standard deviation of the head's true angles about the reported ones [rad]

    def at(self, model: BundleModel) -> Evaluation:
        """Evaluate a model: predict every view and compute the residuals."""
        predictions = [predict(model, batch, self.points, self.free) for batch in self.batches]
        residuals = [
            np.where(batch.seen[..., None], p.pixels - batch.observed, 0.0)
            for batch, p in zip(self.batches, predictions, strict=True)
        ]
        finite = all(np.isfinite(r).all() for r in residuals)
        sigma = robust_sigma(self._seen(residuals)) if finite else np.nan
        adjusted, squared_turns = residuals, 0.0
        if self.jitter and finite:
            penalty = (sigma / self.jitter) ** 2
            adjusted = []
            for batch, p, r in zip(self.batches, predictions, residuals, strict=True):
                if p.by_turn is None:
                    adjusted.append(r)
                    continue
                Q = by_turns(p, batch)
                QT = Q.swapaxes(1, 2)
                turned = -np.linalg.solve(QT @ Q + penalty * np.eye(TURNS), QT @ r.reshape(len(r), -1, 1))
                adjusted.append(r + (Q @ turned).reshape(r.shape))
                squared_turns += float(np.sum(turned**2))
            sigma = robust_sigma(self._seen(adjusted))
        return Evaluation(model, predictions, residuals, adjusted, squared_turns, finite, sigma)

    def cost(self, here: Evaluation, scale: float) -> float:
        """Compute Huber's cost of the residuals plus the cost of jitter and prior [px^2]."""
        if not here.finite:
            return np.inf
        cost = sum(huber_cost(r, scale) for r in here.adjusted)
        variance = (scale / HUBER_SIGMAS) ** 2
        if self.jitter:
            cost += variance / self.jitter**2 * here.squared_turns
        if self.prior is not None:
            off, information = self._known(here.model, variance)
            cost += float(off @ (information * off))
        return cost

    def variance(self, here: Evaluation) -> float | None:
        """Estimate the variance of a corner coordinate [px^2]; see `coordinate_variance`."""
        n = len(parameter_names(self.free, here.model.stops))
        parameters = float(n + POSE_PARAMETERS * len(here.model.boards))
        if self.jitter:
            prior = (here.sigma / self.jitter) ** 2 * np.eye(TURNS)
            for batch, p in zip(self.batches, here.predictions, strict=True):
                if p.by_turn is not None:
                    Q = by_turns(p, batch)
                    QTQ = Q.swapaxes(1, 2) @ Q
                    parameters += float(np.trace(np.linalg.solve(QTQ + prior, QTQ), axis1=1, axis2=2).sum())
        return coordinate_variance(self._seen(here.adjusted), parameters)

    def equations(self, here: Evaluation, scale: float | None) -> Equations:
        """Form the normal equations with Huber's weights; with ``scale`` None, those of plain least squares."""
        penalty = (here.sigma / self.jitter) ** 2 if self.jitter else np.inf
        return self.assembled(here, self.grams(here, scale), penalty)

    def grams(self, here: Evaluation, scale: float | None) -> list[Gram]:
        """Compute J^T W J with J = (shared, board, turn, residual) for each view, batch by batch."""
        found = []
        for batch, p, r, adjusted in zip(self.batches, here.predictions, here.residuals, here.adjusted, strict=True):
            turn = [p.by_turn] if p.by_turn is not None else []
            J = np.concatenate([p.by_shared, p.by_board, *turn, r[..., None]], axis=-1)
            J = masked(J, batch)
            if scale is not None:
                J = J * np.sqrt(huber_weights(adjusted, scale))[..., None, None]
            J = J.reshape(len(J), -1, J.shape[-1])
            found.append((p.columns, J.swapaxes(1, 2) @ J))
        return found

    def assembled(self, here: Evaluation, grams: list[Gram], penalty: float) -> Equations:
        """Add up all views and the prior, with each view's own pan and tilt eliminated.

        The penalty is the variance of a coordinate over the squared jitter [px^2/rad^2], infinite for an exact head.
        """
        boards = len(here.model.boards)
        n = len(parameter_names(self.free, here.model.stops))
        shared, shared_gradient, squares = np.zeros((n, n)), np.zeros(n), 0.0
        mixed = np.zeros((boards, n, POSE_PARAMETERS))
        board = np.zeros((boards, POSE_PARAMETERS, POSE_PARAMETERS))
        board_gradient = np.zeros((boards, POSE_PARAMETERS))
        for batch, (columns, full) in zip(self.batches, grams, strict=True):
            gram = full if batch.stop is None else without_turns(full, penalty)
            k = len(columns)
            b = slice(k, k + POSE_PARAMETERS)
            shared[np.ix_(columns, columns)] += gram[:, :k, :k].sum(0)
            shared_gradient[columns] += gram[:, :k, -1].sum(0)
            mine = np.zeros((boards, k, POSE_PARAMETERS))
            np.add.at(mine, batch.owners, gram[:, :k, b])
            mixed[:, columns] += mine
            np.add.at(board, batch.owners, gram[:, b, b])
            np.add.at(board_gradient, batch.owners, gram[:, b, -1])
            squares += float(gram[:, -1, -1].sum())
        if self.prior is not None:
            off, information = self._known(here.model, here.sigma**2)
            shared += np.diag(information)
            shared_gradient += information * off
            squares += float(off @ (information * off))
        return Equations(shared, mixed, board, shared_gradient, board_gradient, squares)

    def _known(self, model: BundleModel, variance: float) -> tuple[Array, Array]:
        """Compute the free parameters' deviations from the prior's means, (n,), and their weights [px^2], (n,).

        Blocks without a prior, whose weights are 0, are left at 0.
        """
        assert self.prior is not None
        names = parameter_names(self.free, model.stops)
        sigmas = np.array([self.prior.sigmas.get(name, np.inf) for name in names])
        off, columns = np.zeros(len(names)), columns_of(self.free, model.stops)
        for block in self.free:
            if np.isfinite(sigmas[columns[block]]).any():
                off[columns[block]] = difference(model, self.prior.reference, (block,))
        return off, variance / sigmas**2

    def _seen(self, residuals: list[Array]) -> Array:
        """Select the residuals of the corners that are seen, (n, 2)."""
        return np.concatenate([r[batch.seen] for batch, r in zip(self.batches, residuals, strict=True)])


def masked(J: Array, batch: Batch) -> Array:
    """Set the derivatives (v, N, 2, k) of corners that are not seen to 0."""
    return np.where(batch.seen[..., None, None], J, 0.0)


def by_turns(prediction: Prediction, batch: Batch) -> Array:
    """Stack the derivatives by each view's true pan and tilt over its corners, (v, 2 N, 2)."""
    assert prediction.by_turn is not None
    return masked(prediction.by_turn, batch).reshape(len(batch.rows), -1, TURNS)


def without_turns(gram: Array, penalty: float) -> Array:
    """Eliminate each view's own pan and tilt, the two columns before the last (Schur complement)."""
    k = gram.shape[-1] - 1 - TURNS
    kept = [*range(k), gram.shape[-1] - 1]
    rest = gram[:, kept][:, :, kept]
    if np.isinf(penalty):
        return rest
    through = gram[:, kept][:, :, k : k + TURNS]
    own = gram[:, k : k + TURNS, k : k + TURNS] + penalty * np.eye(TURNS)
    return rest - through @ np.linalg.solve(own, through.swapaxes(1, 2))


def reduced(equations: Equations, damping: float) -> tuple[Array, Array, Array]:
    """Eliminate the boards' poses (Schur complement).

    Returns the normal matrix (n, n) and gradient (n,) of the shared parameters, and the boards' inverses (B, 6, 6).
    """
    e = equations
    inverse = np.asarray(np.linalg.inv(e.boards + damped(e.boards, damping)), dtype=float)
    through = e.mixed @ inverse
    matrix = e.shared + damped(e.shared, damping) - (through @ e.mixed.swapaxes(1, 2)).sum(0)
    return matrix, e.shared_gradient - np.einsum("bij,bj->i", through, e.board_gradient), inverse


def solved_step(equations: Equations, damping: float) -> tuple[Array, Array]:
    """Solve a damped step of the shared parameters (n,) and of the boards' poses (B, 6)."""
    matrix, gradient, inverse = reduced(equations, damping)
    shared = np.asarray(np.linalg.solve(matrix, -gradient), dtype=float)
    right = equations.board_gradient + np.einsum("bij,i->bj", equations.mixed, shared)
    return shared, -np.einsum("bij,bj->bi", inverse, right)


def damped(blocks: Array, damping: float) -> Array:
    """Compute the damping diagonal of square blocks; it is never zero, so that undetermined directions do not move."""
    diagonal = np.diagonal(blocks, axis1=-2, axis2=-1)
    return np.eye(blocks.shape[-1]) * (diagonal * damping + SMALLEST_DAMPING)[..., None]


def robust_scale(here: Evaluation) -> float:
    """Compute the residual beyond which a corner counts linearly in Huber's loss [px]."""
    return HUBER_SIGMAS * here.sigma


# Robust statistics of the residuals

# A point farther off than this many standard deviations counts linearly and not squared (Huber).
HUBER_SIGMAS = 3.0
MEDIAN_TO_SIGMA = 1 / 1.1774  # the median length of a 2D Gaussian vector is sigma sqrt(2 ln 2)
SMALLEST_SIGMA_PX = 1e-4  # rounding of corners, and so the smallest scale of exact data


def rms(residuals: Array) -> float:
    """Compute OpenCV's rms, the root mean square distance per point of residuals (..., 2) [px]; nan does not count."""
    squared = np.sum(residuals**2, axis=-1)
    seen = np.isfinite(squared)
    return float(np.sqrt(squared[seen].mean())) if seen.any() else 0.0


def robust_sigma(residuals: Array) -> float:
    """Estimate the standard deviation of a coordinate of residuals (n, 2) from their median length [px]."""
    return max(float(np.median(np.linalg.norm(residuals, axis=-1))) * MEDIAN_TO_SIGMA, SMALLEST_SIGMA_PX)


def coordinate_variance(residuals: Array, parameters: float) -> float | None:
    """Estimate the variance of one corner coordinate, robust against wrong corners.

    Times the inverse normal matrix, it gives the parameters' covariance. It is that of Huber's estimate (Huber 1981,
    Eq. 7.6.10): mean |psi|^2 / 2 over the squared mean slope of psi, with psi a residual cut to the robust scale. For
    Gaussian noise it is 1 % above the noise's variance.

    Args:
        residuals: residuals at the optimum, (n, 2) [px].
        parameters: number of fitted parameters, the boards' poses included.

    Returns:
        Variance [px^2]; None where there are no more coordinates than parameters.
    """
    freedom = residuals.size - parameters
    if freedom <= 0:
        return None
    scale = HUBER_SIGMAS * robust_sigma(residuals)
    weights = huber_weights(residuals, scale)
    psi2 = np.sum((weights[..., None] * residuals) ** 2, axis=-1)
    slope = np.where(weights < 1, weights / 2, 1.0)  # beyond the scale, psi changes in one of its two directions only
    return float(np.mean(psi2) / 2 / np.mean(slope) ** 2 * residuals.size / freedom)


def huber_weights(residuals: Array, scale: float) -> Array:
    """Compute Huber's weight of every point, (...), from residuals (..., 2) and the scale [px]."""
    return scale / np.maximum(np.linalg.norm(residuals, axis=-1), scale)


def huber_cost(residuals: Array, scale: float) -> float:
    """Compute Huber's cost of residuals (..., 2), summed over the points [px^2]."""
    lengths = np.linalg.norm(residuals, axis=-1)
    return float(np.sum(np.where(lengths <= scale, lengths**2, scale * (2 * lengths - scale))))


# The fit

STEPS = 60
CONVERGED = 1e-10  # relative decrease of the cost at which the solver stops
DAMPING = 1e-4  # of the first step, relative to the diagonal of the normal equations
DAMPING_LIMIT = 1e10


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit."""

    model: BundleModel
    free: tuple[Block, ...]  # blocks that were free
    residuals: Array  # predicted minus observed corners, (V, N, 2) [px]; nan for corners that are not seen
    adjusted: Array  # residuals after each view's pan and tilt are fitted within the jitter, (V, N, 2) [px]
    # normal matrix of the free blocks, with the boards' poses and any jitter eliminated; its inverse times
    # ``variance`` is the parameters' covariance
    normal: Array
    variance: float | None  # variance of a coordinate [px^2]; None where there are not more coordinates than parameters
    jitter: float  # standard deviation of the head's angles that the fit assumed [rad]
    views: tuple[View, ...]  # views that were fitted

    @property
    def rms_px(self) -> float:
        """Root mean square distance per point [px]."""
        return rms(self.residuals)


def fit(
    model: BundleModel,
    views: Sequence[View],
    points: Array,
    free: Collection[Block],
    *,
    prior: Prior | None = None,
    jitter: float = 0.0,
) -> Fit:
    """Fit the free blocks and the boards' poses to the corners of all views (Levenberg-Marquardt).

    The model is the start, with a pose for every board. The jitter is the standard deviation of the head's true angles
    about the reported ones, independent for each view [rad].

    Raises:
        CalibrationError: there are no views, or a board begins or ends behind a camera.
    """
    if not views:
        raise CalibrationError("no views of the board to fit")
    model = replace(model, boards={number: model.boards[number] for number in sorted({v.board for v in views})})
    problem = Problem(batches_of(model, views), points, tuple(free), prior, jitter)
    here = problem.at(model)
    damping = DAMPING
    for _ in range(STEPS if here.finite else 0):
        scale = robust_scale(here)
        equations = problem.equations(here, scale)
        cost = problem.cost(here, scale)
        while damping < DAMPING_LIMIT:
            trial = problem.at(stepped(here.model, *solved_step(equations, damping), free))
            trial_cost = problem.cost(trial, scale)
            if np.isfinite(trial_cost) and trial_cost <= cost:
                break
            damping *= 10
        else:
            break
        here, damping = trial, damping / 10
        if cost - trial_cost <= CONVERGED * cost:
            break
    if not here.finite:
        raise CalibrationError("the corners cannot be explained by this rig: a board comes out behind a camera")
    residuals, adjusted = (np.full((len(views), len(points), 2), np.nan) for _ in range(2))
    for batch, r, r_adjusted in zip(problem.batches, here.residuals, here.adjusted, strict=True):
        residuals[batch.rows] = np.where(batch.seen[..., None], r, np.nan)
        adjusted[batch.rows] = np.where(batch.seen[..., None], r_adjusted, np.nan)
    variance = problem.variance(here)
    normal = reduced(problem.equations(here, None), 0.0)[0]
    return Fit(here.model, problem.free, residuals, adjusted, normal, variance, jitter, tuple(views))


def information(model: BundleModel, views: Sequence[View], points: Array, free: Collection[Block]) -> Array:
    """Compute the normal matrix (n, n) [1/px^2] that views would add, with the boards' poses eliminated.

    Only which corners the views see matters.
    """
    model = replace(model, boards={number: model.boards[number] for number in sorted({v.board for v in views})})
    problem = Problem(batches_of(model, views), points, tuple(free), None, 0.0)
    return reduced(problem.equations(problem.at(model), None), 0.0)[0]
