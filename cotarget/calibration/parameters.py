"""A rig's model and its parameters: their names and order, and how a step changes them.

Poses are stepped as R <- exp(w) R, t <- t + d.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from cotarget.calibration.model import View
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.pantilt import IDEAL_HEAD, HeadGeometry

Block = Literal["fixed", "zoom", "pupil", "gamma", "hand", "head", "warp", "k3", "scale", "zero"]
# What a calibration finds by default, in the order of the parameters; "k3" is the fixed camera's, "scale" and "zero"
# are the encoders'.
ALL_BLOCKS: tuple[Block, ...] = ("fixed", "zoom", "pupil", "gamma", "hand", "head", "warp")
EVERY_BLOCK: tuple[Block, ...] = (*ALL_BLOCKS, "k3", "scale", "zero")

# fx fy cx cy k1 k2 p1 p2, the order of OpenCV's Jacobian after the pose; k3, the next, is a block by itself, for lenses
# that ask for it: elsewhere it hardly changes the residuals (0.0002 px on real photos) but bends the image where no
# board was seen.
LENS_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
LENS_PARAMETERS = len(LENS_NAMES)
POSE_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")
POSE_PARAMETERS = len(POSE_NAMES)
HEAD_NAMES = {
    "head": ("axis_offset", "squareness"),
    "scale": ("pan_scale", "tilt_scale"),
    "zero": ("pan_zero", "tilt_zero"),
}
WARP_NAMES = ("warp_x", "warp_y")
STILL = RigidTransform.identity()


@dataclass(frozen=True, eq=False)
class RigModel:
    """Everything that determines where corners appear.

    Attributes:
        fixed: the fixed camera, None while only the zoom camera is looked at.
        zoom: the zoom camera, None while only the fixed camera is looked at.
        gamma: T_zoom0_fixed, at the first stop.
        hand: T_head_zoom, at the first stop.
        head: the pan-tilt unit's geometry.
        boards: T_fixed_board by the number of the placement.
        warp: by how much the board's middle stands out towards its z from its edges along x, and along y [m].
    """

    boards: Mapping[int, RigidTransform]
    fixed: Intrinsics | None = None
    zoom: ZoomLens | None = None
    gamma: RigidTransform = STILL
    hand: RigidTransform = STILL
    head: HeadGeometry = IDEAL_HEAD
    warp: tuple[float, float] = (0.0, 0.0)

    @property
    def stops(self) -> int:
        """How many stops the zoom lens has here."""
        return 0 if self.zoom is None else len(self.zoom.stops)

    @property
    def focal_px(self) -> dict[str, float]:
        """Focal length of every lens [px], by how the names of its parameters begin."""
        found = {} if self.fixed is None else {"fixed": self.fixed.focal_px[0]}
        stops = () if self.zoom is None else self.zoom.stops
        return found | {f"zoom[{i}]": stop.focal_px[0] for i, stop in enumerate(stops)}

    def lens_of(self, view: View) -> Intrinsics:
        """The intrinsics with which a view was taken.

        Raises:
            CalibrationError: there is no model of its camera.
        """
        if view.camera == "fixed" and self.fixed is not None:
            return self.fixed
        if view.camera == "zoom" and self.zoom is not None:
            return self.zoom.stops[stop_of(self.zoom.nominal_px, view)]
        raise CalibrationError(f"there are views of the {view.camera} camera, but no model of it")


def stop_of(nominal_px: Sequence[float], view: View) -> int:
    """The stop that is nearest to a view's nominal focal length; the first where none was told."""
    if view.focal_px is None or not nominal_px:
        return 0
    return int(np.argmin(np.abs(np.log(np.array(nominal_px) / view.focal_px))))


def columns_of(free: Collection[Block], stops: int) -> dict[str, slice]:
    """Where each free block stands among the shared parameters, for a zoom lens of so many stops."""
    columns: dict[str, slice] = {}
    width = 0
    for name in EVERY_BLOCK:
        if name in free:
            size = len(_names(name, stops))
            columns[name] = slice(width, width + size)
            width += size
    return columns


def parameter_names(free: Collection[Block], stops: int = 1) -> tuple[str, ...]:
    """Name the free blocks' parameters, in their order among the shared ones; see `Covariance` for their units."""
    return tuple(name for block in columns_of(free, stops) for name in _names(block, stops))


def _names(block: str, stops: int) -> list[str]:
    match block:
        case "fixed":
            return [f"fixed.{name}" for name in LENS_NAMES]
        case "zoom":
            return [f"zoom[{i}].{name}" for i in range(stops) for name in LENS_NAMES]
        case "pupil":
            return [f"zoom[{i}].pupil" for i in range(1, stops)]
        case "gamma":
            return [f"T_zoom0_fixed.{name}" for name in POSE_NAMES]
        case "hand":
            return [f"T_head_zoom.{name}" for name in POSE_NAMES]
        case "k3":
            return ["fixed.k3"]
        case "warp":
            return [f"board.{name}" for name in WARP_NAMES]
        case _:
            return [f"head.{name}" for name in HEAD_NAMES[block]]


def stepped(model: RigModel, shared: Array, boards: Array, free: Collection[Block]) -> RigModel:
    """Add a step to the shared parameters (n,) and to the boards' poses (B, 6)."""
    steps = {name: shared[columns] for name, columns in columns_of(free, model.stops).items()}
    head = model.head
    for block, names in HEAD_NAMES.items():
        if block in steps:
            changed = {name: getattr(head, name) + float(d) for name, d in zip(names, steps[block], strict=True)}
            head = replace(head, **changed)
    zoom = model.zoom
    if zoom is not None and ("zoom" in steps or "pupil" in steps):
        lenses = steps.get("zoom", np.zeros(LENS_PARAMETERS * model.stops)).reshape(model.stops, LENS_PARAMETERS)
        pupils = np.append(0.0, steps.get("pupil", np.zeros(model.stops - 1)))
        zoom = ZoomLens(
            zoom.nominal_px,
            tuple(_bent(stop, step) for stop, step in zip(zoom.stops, lenses, strict=True)),
            tuple(float(old + step) for old, step in zip(zoom.pupil, pupils, strict=True)),
        )
    fixed = model.fixed
    if fixed is not None and "fixed" in steps:
        fixed = _bent(fixed, steps["fixed"])
    if fixed is not None and "k3" in steps:
        fixed = replace(fixed, distortion=(*fixed.distortion[:4], fixed.distortion[4] + float(steps["k3"][0])))
    return RigModel(
        boards=_all_moved(model.boards, boards),
        fixed=fixed,
        zoom=zoom,
        gamma=_moved(model.gamma, steps.get("gamma")),
        hand=_moved(model.hand, steps.get("hand")),
        head=head,
        warp=model.warp if "warp" not in steps else _pair(np.add(model.warp, steps["warp"])),
    )


def difference(model: RigModel, reference: RigModel, free: Collection[Block]) -> Array:
    """The step of the shared parameters that leads from the reference to the model, (n,): the inverse of `stepped`."""
    parts: list[Array] = []
    for block in columns_of(free, model.stops):
        match block:
            case "fixed":
                assert model.fixed is not None
                assert reference.fixed is not None
                parts.append(_numbers(model.fixed) - _numbers(reference.fixed))
            case "zoom" | "pupil":
                assert model.zoom is not None
                assert reference.zoom is not None
                if block == "pupil":
                    parts.append(np.subtract(model.zoom.pupil, reference.zoom.pupil)[1:])
                else:
                    pairs = zip(model.zoom.stops, reference.zoom.stops, strict=True)
                    parts.extend(_numbers(a) - _numbers(b) for a, b in pairs)
            case "gamma" | "hand":
                T, T_ref = getattr(model, block), getattr(reference, block)
                parts.append((T.rotation * T_ref.rotation.inv()).as_rotvec())
                parts.append(T.translation - T_ref.translation)
            case "k3":
                assert model.fixed is not None
                assert reference.fixed is not None
                parts.append(np.array([model.fixed.distortion[4] - reference.fixed.distortion[4]]))
            case "warp":
                parts.append(np.subtract(model.warp, reference.warp))
            case _:
                parts.append(np.array([getattr(model.head, k) - getattr(reference.head, k) for k in HEAD_NAMES[block]]))
    return np.concatenate(parts) if parts else np.zeros(0)


def _all_moved(boards: Mapping[int, RigidTransform], steps: Array) -> dict[int, RigidTransform]:
    """`_moved` for many at once: scipy takes as long for one transform as for a hundred."""
    if not boards:
        return {}
    M = np.stack([T.as_matrix() for T in boards.values()])
    M[:, :3, :3] = Rotation.from_rotvec(steps[:, :3]).as_matrix() @ M[:, :3, :3]
    M[:, :3, 3] += steps[:, 3:]
    moved = RigidTransform.from_matrix(M)
    return {number: moved[i] for i, number in enumerate(boards)}


def _moved(T: RigidTransform, step: Array | None) -> RigidTransform:
    if step is None:
        return T
    return RigidTransform.from_components(T.translation + step[3:], Rotation.from_rotvec(step[:3]) * T.rotation)


def _numbers(lens: Intrinsics) -> Array:
    return np.array([*lens.focal_px, *lens.center_px, *lens.distortion])[:LENS_PARAMETERS]


def _bent(lens: Intrinsics, step: Array) -> Intrinsics:
    fx, fy, cx, cy, k1, k2, p1, p2 = (float(value) for value in _numbers(lens) + step)
    return Intrinsics(lens.size, (fx, fy), (cx, cy), (k1, k2, p1, p2, lens.distortion[4]))


def _pair(values: Array) -> tuple[float, float]:
    first, second = values
    return float(first), float(second)
