"""Ground truth of a simulated world: poses, pixels and silhouettes, for tests and experiments only.

Poses come from MuJoCo's kinematics and pixels from the true lenses. The pipeline's geometry is not used, so that a
mistake in it cannot hide here.

`Truth` moves all bodies to their poses and projects all of their corners. `Outlines` tells the same of the targets'
outlines faster and a little less exactly: it prepares each target's outermost points for phases of the limb cycle.
Environments use it, because they ask at every frame. Measurements: docs/design-notes.md.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from cotarget.config import SimConfig
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.sim.model import BOARD_GROUP, RIG, compiled, mount_pose, scene_spec
from cotarget.sim.render.opengl import mujoco
from cotarget.sim.render.optics import TrueLens, fold
from cotarget.sim.targets.models import kind_model, own_model
from cotarget.sim.targets.target import Target, kind_of

CameraName = Literal["fixed", "zoom"]


@dataclass(frozen=True)
class Silhouette:
    """True outline of a target in one image, not clipped to the image.

    Attributes:
        low_px: top-left corner of the bounding box [px], (2,).
        high_px: bottom-right corner of the bounding box [px], (2,).
        visible: visible fraction of the target, 0 to 1. It is the product of two fractions that are assumed to be
            independent: the part of the outline's area inside the image, and the part of the geoms (each counts the
            same, whatever its size) whose centre a ray from the camera reaches with only the target in the way. So it
            is exact for a target that only the image's border cuts, and has steps of one geom for an occluded target.
            The board and the rig occlude nothing.
        upright_px: width and height along the target's own axes: across and along its body's upward axis as the image
            shows that, however the camera is rolled [px], (2,).
        unhidden: the second of those fractions.
    """

    low_px: Array
    high_px: Array
    visible: float
    upright_px: Array
    unhidden: float

    @property
    def size_px(self) -> Array:
        """(width, height) of the box."""
        return self.high_px - self.low_px


NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)


def part_seen(sim: SimConfig, x_world: Array) -> float:
    """Compute the fraction of points that the fixed camera sees: inside its image and not occluded by the scene.

    Args:
        sim: the simulation's configuration; its scene and fixed camera are used.
        x_world: points in the world [m], (n, 3).

    Raises:
        ConfigError: the scene does not compile.
    """
    model, camera = compiled(scene_spec(sim.scene), sim.scene), sim.fixed
    data, T_world_fixed = mujoco.MjData(model), mount_pose(model)
    mujoco.mj_kinematics(model, data)
    distortion = camera.distortion if sim.effects.distortion else NO_DISTORTION
    lens = TrueLens(camera.size, camera.focal_px, camera.center_px, distortion)
    pixels = lens.project(T_world_fixed.inv().apply(x_world))
    inside = ((pixels > -0.5) & (pixels < np.array(camera.size) - 0.5)).all(axis=1)  # nan is not
    ways = x_world - T_world_fixed.translation
    far = np.linalg.norm(ways, axis=1)
    hit, distance = _first_hits(model, data, T_world_fixed.translation, ways / far[:, None])
    return float((inside & ((hit < 0) | (distance > far))).mean())


def _first_hits(
    model: "mujoco.MjModel", data: "mujoco.MjData", eye: Array, ways: Array
) -> tuple[npt.NDArray[np.int32], Array]:
    """Find the first drawn geom along rays from a point, (n,) ids, and its distance in lengths of ``ways``, (n,).

    The id is -1 where a ray meets none. Board and rig are left out.
    """
    groups = (np.arange(mujoco.mjNGROUP) < BOARD_GROUP).astype(np.uint8)
    count, farthest = len(ways), float(mujoco.mjMAXVAL)
    hit, distance = np.zeros(count, dtype=np.int32), np.zeros(count)
    mujoco.mj_multiRay(model, data, eye, ways.ravel(), groups, True, -1, hit, distance, None, count, farthest)
    return hit, distance


SURFACE_POINTS = 64  # samples on a round geom; the outline's error is then about 1 %
SILHOUETTE_GRID = 96  # larger side of the raster in which areas are compared [px]
BEAT_PHASES = 8  # samples of one limb cycle


@dataclass(frozen=True)
class Surface:
    """Points on a target's geoms; the target's outline is the union of the geoms' convex hulls.

    Attributes:
        geoms: MuJoCo ids of the target's geoms, (g,).
        owner: index into ``geoms`` for each point, (n,).
        starts: index of each geom's first point, (g,).
        points: coordinates in the frame of the point's geom [m], (n, 3).
    """

    geoms: npt.NDArray[np.intp]
    owner: npt.NDArray[np.intp]
    starts: npt.NDArray[np.intp]
    points: Array


@dataclass(frozen=True)
class Truth:
    """True poses, pixels and silhouettes at any time up to now.

    Attributes:
        model: compiled MuJoCo model of the world.
        set_state: moves everything to its pose at a time [s] and gives the data.
        set_bodies: moves rig, targets and board only, not foliage and clouds.
        fixed_lens: true optics of the fixed camera.
        nominal_at: nominal focal length of the zoom camera at a time [px].
        zoom_lens_for: true optics of the zoom camera at a nominal focal length [px].
        T_world_fixed: pose of the fixed camera.
        head_at: true pan and tilt of the platform at a time [rad].
        focal_range: shortest and longest nominal focal length of the zoom camera [px].
        targets: targets by name.
    """

    model: "mujoco.MjModel"
    set_state: Callable[[float], "mujoco.MjData"]
    set_bodies: Callable[[float], "mujoco.MjData"]
    fixed_lens: TrueLens
    nominal_at: Callable[[float], float]
    zoom_lens_for: Callable[[float], TrueLens]
    T_world_fixed: RigidTransform
    head_at: Callable[[float], tuple[float, float]]
    focal_range: tuple[float, float]
    targets: Mapping[str, Target]

    def lens(self, camera: CameraName, t: float) -> TrueLens:
        """Give the true optics of a camera at time t [s]."""
        return self.fixed_lens if camera == "fixed" else self.zoom_lens_for(self.nominal_at(t))

    @property
    def longest_px(self) -> float:
        """True longest focal length of the zoom camera, along the rows [px]."""
        return self.zoom_lens_for(self.focal_range[1]).focal_px[0]

    def T_world_camera(self, camera: CameraName, t: float) -> RigidTransform:
        """Give the pose of a camera's optical centre at time t [s], in OpenCV's axes."""
        eye, axes = self._camera(self.set_bodies(t), camera, self.lens(camera, t))
        return RigidTransform.from_components(eye, Rotation.from_matrix(axes, assume_valid=True))

    def center(self, name: str, t: float) -> Array:
        """Give a target's body centre in the world at time t [s], (3,) [m]."""
        return self.targets[name].pose(t).position

    def pixel(self, camera: CameraName, x_world: Array, t: float) -> Array:
        """Project points of the world (..., 3) [m] at time t [s], (..., 2) [px]; nan behind the camera."""
        lens = self.lens(camera, t)
        eye, axes = self._camera(self.set_bodies(t), camera, lens)
        return lens.project((np.asarray(x_world, dtype=float) - eye) @ axes)

    def center_px(self, name: str, camera: CameraName, t: float) -> Array:
        """Project a target's body centre at time t [s], (2,) [px]; nan behind the camera."""
        return self.pixel(camera, self.center(name, t), t)

    def line_of_sight_miss(self, pan: float, tilt: float, nominal_px: float, x_world: Array) -> float:
        """Compute the angle [rad] between the ray through the zoom image's centre and a point.

        Args:
            pan: pan of the platform, not rounded to steps [rad].
            tilt: tilt of the platform, not rounded to steps [rad].
            nominal_px: nominal focal length of the zoom lens [px].
            x_world: the point in the world [m], (3,).
        """
        data = self._spare_data
        data.joint(RIG + "pan").qpos[0], data.joint(RIG + "tilt").qpos[0] = pan, tilt
        mujoco.mj_kinematics(self.model, data)
        lens = self.zoom_lens_for(nominal_px)
        eye, axes = self._camera(data, "zoom", lens)
        x_zoom = (np.asarray(x_world) - eye) @ axes
        xy = lens.directions((np.array(lens.size) - 1) / 2)
        ray = np.append(xy, 1.0)
        return float(np.arctan2(np.linalg.norm(np.cross(ray, x_zoom)), ray @ x_zoom))

    def silhouette(self, name: str, camera: CameraName, t: float) -> Silhouette | None:
        """Give a target's outline and visible fraction at time t [s].

        None where a part of the target is behind the camera, or outside the angles that its lens images.
        """
        data, lens = self.set_state(t), self.lens(camera, t)
        view = self._camera(data, camera, lens)
        pixels = self._outline(name, data, view, lens)
        if not np.isfinite(pixels).all():
            return None
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        inside = 1.0
        if (low < -0.5).any() or (high > np.array(lens.size) - 0.5).any():
            parts = np.split(pixels, self._surfaces[name].starts[1:])
            inside = _fraction_inside(parts, low, high, lens.size)
        upright_px = _upright(pixels.T, self._up_px(name, data, view, lens))
        unhidden = self._unhidden(name, data, view[0])
        return Silhouette(low, high, inside * unhidden, upright_px, unhidden)

    def unhidden(self, name: str, camera: CameraName, t: float) -> float:
        """Compute the fraction of a target's geoms that only the target itself occludes at time t [s]."""
        data = self.set_state(t)
        return self._unhidden(name, data, self._camera(data, camera, self.lens(camera, t))[0])

    def box(self, name: str, camera: CameraName, t: float) -> tuple[Array, Array] | None:
        """Bound a target's outline at time t [s], occluded or not: top-left and bottom-right corner, (2,) [px] each.

        Faster than `silhouette`, with the same corners. None where a part of the target is behind the camera.
        """
        data, lens = self.set_bodies(t), self.lens(camera, t)
        pixels = self._outline(name, data, self._camera(data, camera, lens), lens)
        return (pixels.min(axis=0), pixels.max(axis=0)) if np.isfinite(pixels).all() else None

    def largest_side_px(self, name: str, camera: CameraName, t: float) -> float:
        """Give the larger side of the box, its maximum over one limb cycle, at the pose of time t [px]; nan behind.

        The box is across and along the vertical as the image shows it, because wings bank.
        """
        target = self.targets[name]
        phases = np.arange(BEAT_PHASES) / BEAT_PHASES * beat_s if (beat_s := target.kind.beat_s) else [0.0]
        data = self._copy(self.set_bodies(t))
        lens = self.lens(camera, t)
        view = self._camera(data, camera, lens)
        vertical = _shown((data.xpos[self.model.body(target.body).id] - view[0]) @ view[1], view[1][2], lens)
        joints = [int(self.model.joint(f"{name}/{joint}").qposadr[0]) for joint in target.pose(t).joints]
        sides = []
        for phase in phases:
            if joints:
                data.qpos[joints] = list(target.pose(t + phase).joints.values())
                mujoco.mj_kinematics(self.model, data)
            pixels = self._outline(name, data, view, lens)
            sides.append(np.max(_upright(pixels.T, vertical)))
        return float(np.max(sides))

    def _copy(self, data: "mujoco.MjData") -> "mujoco.MjData":
        """Copy a state to data that may be changed; the world caches its own until another time is requested."""
        copy = self._spare_data
        copy.qpos[:], copy.mocap_pos[:], copy.mocap_quat[:] = data.qpos, data.mocap_pos, data.mocap_quat
        mujoco.mj_kinematics(self.model, copy)
        return copy

    @cached_property
    def _spare_data(self) -> "mujoco.MjData":
        """Data that may be changed, in any state."""
        return mujoco.MjData(self.model)

    @cached_property
    def _bodies(self) -> dict[str, int]:
        """Ids of the cameras' bodies."""
        return {camera: self.model.body(RIG + camera).id for camera in get_args(CameraName)}

    @cached_property
    def _surfaces(self) -> dict[str, Surface]:
        """Points on the geoms of each target."""
        return {name: self._surface_of(target) for name, target in self.targets.items()}

    def _outline(self, name: str, data: "mujoco.MjData", view: tuple[Array, Array], lens: TrueLens) -> Array:
        """Project the points on a target's geoms, in their order, (n, 2) [px]; nan where the camera images none."""
        surface = self._surfaces[name]
        axes = data.geom_xmat[surface.geoms].reshape(-1, 3, 3)
        x_world = np.einsum("nij,nj->ni", axes[surface.owner], surface.points)
        eye, camera_axes = view
        return lens.project((x_world + (data.geom_xpos[surface.geoms] - eye)[surface.owner]) @ camera_axes)

    def _up_px(self, name: str, data: "mujoco.MjData", view: tuple[Array, Array], lens: TrueLens) -> Array:
        """Give the direction in which a camera shows a target's upward axis, a unit vector, (2,)."""
        (eye, axes), body = view, self.model.body(self.targets[name].body).id
        return _shown((data.xpos[body] - eye) @ axes, data.xmat[body].reshape(3, 3)[:, 2] @ axes, lens)

    def _camera(self, data: "mujoco.MjData", camera: CameraName, lens: TrueLens) -> tuple[Array, Array]:
        """Give a camera's entrance pupil in the world [m], (3,), and its axes as columns, (3, 3)."""
        body = self._bodies[camera]
        axes = np.array(data.xmat[body].reshape(3, 3))
        return data.xpos[body] + axes[:, 2] * lens.pupil, axes

    def _surface_of(self, target: Target) -> Surface:
        root = self.model.body(target.body).id
        geoms = np.flatnonzero(self.model.body_rootid[self.model.geom_bodyid] == root)
        points = [surface_points(self.model, int(geom)) for geom in geoms]
        counts = [len(each) for each in points]
        owner, starts = np.repeat(np.arange(len(geoms)), counts), np.cumsum([0, *counts[:-1]])
        return Surface(geoms, owner, starts, np.concatenate(points))

    def _unhidden(self, name: str, data: "mujoco.MjData", eye: Array) -> float:
        """Compute the fraction of the target's geoms whose centre a ray from the camera reaches unoccluded.

        Geoms inside and outside the image count the same. A mesh's centre is its centre of mass.
        """
        own = self._surfaces[name].geoms
        hit, _ = _first_hits(self.model, data, eye, data.geom_xpos[own] - eye)
        return float((hit[:, None] == own).any(axis=1).mean())  # np.isin takes ten times as long for so few


def _shown(x_camera: Array, direction: Array, lens: TrueLens) -> Array:
    """Give the direction in which a short line appears in an image, a unit vector, (2,); distortion is neglected.

    Args:
        x_camera: where the line is, in the camera's frame, (3,).
        direction: its direction there, (3,).
        lens: optics of the camera.
    """
    (x, y, z), (a, b, c), (fx, fy) = x_camera.tolist(), direction.tolist(), lens.focal_px
    u, v = fx * (a * z - x * c), fy * (b * z - y * c)
    length = math.hypot(u, v)
    return np.array([u / length, v / length] if length > 0 else [0.0, 1.0])


def _upright(pixels: Array, up: Array) -> Array:
    """Give width and height of pixels (2, ...) across and along a direction (2,), over the last axis, (2, ...)."""
    u, v = up.tolist()
    low, high = _ends(np.array([v * pixels[0] - u * pixels[1], u * pixels[0] + v * pixels[1]]))
    return high - low


def _fraction_inside(outlines: list[Array], low: Array, high: Array, size: tuple[int, int]) -> float:
    """Compute the fraction of the area of a union of convex outlines that lies inside the image."""
    scale = SILHOUETTE_GRID / max(float(np.max(high - low)), 1e-9)
    width, height = (np.ceil((high - low) * scale).astype(int) + 1).tolist()
    canvas = np.zeros((height, width), dtype=np.uint8)
    for outline in outlines:
        hull = cv2.convexHull(np.rint((outline - low) * scale).astype(np.int32))
        cv2.fillConvexPoly(canvas, hull, 1)
    u = low[0] + np.arange(width) / scale
    v = low[1] + np.arange(height) / scale
    within = np.outer((v >= -0.5) & (v <= size[1] - 0.5), (u >= -0.5) & (u <= size[0] - 0.5))
    return float(np.count_nonzero(canvas & within) / np.count_nonzero(canvas))


def surface_points(model: "mujoco.MjModel", geom: int) -> Array:
    """Sample points on a geom's surface in the geom's frame, (n, 3) [m]."""
    size, kind = model.geom_size[geom], mujoco.mjtGeom(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return np.array(np.meshgrid(*([-s, s] for s in size))).reshape(3, -1).T
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        vertices = np.asarray(model.mesh_vert[start : start + count], dtype=float)
        try:
            return vertices[np.unique(ConvexHull(vertices).simplices)]  # inner vertices are on no outline
        except QhullError:  # the mesh is flat
            return vertices
    ball = sphere_points(SURFACE_POINTS)
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return ball * size[0]
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return ball * size
    ends = np.where(ball[:, 2:] >= 0, 1.0, -1.0) * [0.0, 0.0, size[1]]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return ball * size[0] + ends
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        around = np.linspace(0, 2 * np.pi, SURFACE_POINTS // 2, endpoint=False)
        rim = np.column_stack([np.cos(around), np.sin(around)]) * size[0]
        return np.concatenate([np.column_stack([rim, np.full(len(rim), z)]) for z in (-size[1], size[1])])
    raise ValueError(f"a target may not contain a geom of type {kind.name}")


def sphere_points(count: int) -> Array:
    """Sample the unit sphere evenly (Fibonacci lattice), (count, 3)."""
    i = np.arange(count) + 0.5
    z, around = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z * z)
    return np.column_stack([r * np.cos(around), r * np.sin(around), z])


# Faster outlines, from points prepared for phases of the limb cycle

PHASES = 48  # of a limb cycle; from one to the next the tip of a wing moves by at most 2 % of the span
EVERY = 6  # every sixth phase is used for the larger side over a cycle
DIRECTIONS = 160  # in which outermost points are searched, about 16 degrees apart
# Pixels of the centre, the top-left and the bottom-right corner, (2,) each, and of the outermost points, (2, n).
Outline = tuple[Array, Array, Array, Array]


class TrueView(NamedTuple):
    """Pose and optics of a camera at one time.

    Attributes:
        eye: optical centre in the world [m], (3,).
        lens: true optics.
        bent: whether the lens distorts.
        to_image: maps directions in the world to homogeneous pixels, or to camera axes where the lens distorts, (3, 3).
        axes: the camera's axes in the world, as columns, (3, 3).
    """

    eye: Array
    lens: TrueLens
    bent: bool
    to_image: Array
    axes: Array


class Outlines:
    """Fast approximation of `Truth` for the targets' outlines.

    Attributes:
        targets: targets by name.
        fixed_lens: true optics of the fixed camera.
        longest_px: true longest focal length of the zoom camera, along the rows [px].
    """

    def __init__(self, truth: Truth) -> None:
        """Prepare each target's outermost points."""
        self.targets, self.fixed_lens, self.longest_px = truth.targets, truth.fixed_lens, truth.longest_px
        self._truth, self._model, self._data = truth, truth.model, mujoco.MjData(truth.model)
        mujoco.mj_kinematics(self._model, self._data)
        data = self._data  # reading an array attribute takes as long as the computation with it
        self._qpos, self._places, self._turns = data.qpos, data.xpos, data.xmat.reshape(-1, 3, 3)
        self._points = {
            name: outermost(each.kind.name, each.kind.own) * each.size for name, each in self.targets.items()
        }
        self._beats = {name: np.concatenate(points[::EVERY], axis=1) for name, points in self._points.items()}
        self._reach = {name: float(np.linalg.norm(points, axis=1).max()) for name, points in self._points.items()}
        self._axes = [int(self._model.joint(RIG + axis).qposadr[0]) for axis in ("pan", "tilt")]
        self._bodies = {camera: self._model.body(RIG + camera).id for camera in get_args(CameraName)}
        self._fixed = self._placed("fixed", self.fixed_lens)
        # Cached results for the latest time, and for the zoom camera's latest pan, tilt and focal length.
        self._t = self._zoom_t = math.nan
        self._zoom, self._stood = self._fixed, (math.nan, math.nan, math.nan)
        self._poses: dict[str, tuple[Array, Array, int]] = {}
        self._found: dict[tuple[str, CameraName], Outline | None] = {}

    def lens(self, camera: CameraName, t: float) -> TrueLens:
        """Give the true optics of a camera at time t [s]."""
        return self.view(camera, t).lens

    def center(self, name: str, t: float) -> Array:
        """Give a target's body centre in the world at time t [s], (3,) [m]."""
        return self._pose(name, t)[0]

    def center_px(self, name: str, camera: CameraName, t: float) -> Array:
        """Project a target's body centre at time t [s], (2,) [px]; nan behind the camera."""
        found = self._outline(name, camera, t)
        return np.full(2, np.nan) if found is None else found[0]

    def box(self, name: str, camera: CameraName, t: float) -> tuple[Array, Array] | None:
        """Bound a target's outline at time t [s]: top-left and bottom-right corner, (2,) [px]; None behind camera."""
        found = self._outline(name, camera, t)
        return None if found is None else found[1:3]

    def silhouette(self, name: str, camera: CameraName, t: float) -> Silhouette | None:
        """Give a target's outline and visible fraction at time t [s]; None behind the camera.

        The fraction inside the image is that of the bounding box, not of the outline.
        """
        found = self._outline(name, camera, t)
        if found is None:
            return None
        _, low, high, pixels = found
        upright_px = _upright(pixels, self._up_px(name, camera, t))
        unhidden = self._truth.unhidden(name, camera, t)
        (left, top), (right, bottom) = low.tolist(), high.tolist()
        width, height = self.lens(camera, t).size
        across = min(right, width - 0.5) - max(left, -0.5)
        down = min(bottom, height - 0.5) - max(top, -0.5)
        if across <= 0 or down <= 0:
            return Silhouette(low, high, 0.0, upright_px, unhidden)
        inside = across * down / ((right - left) * (bottom - top))
        return Silhouette(low, high, inside * unhidden, upright_px, unhidden)

    def largest_side_px(self, name: str, camera: CameraName, t: float) -> float:
        """Give the larger side of the box, its maximum over one limb cycle, at the pose of time t [px]; nan behind.

        The box is across and along the vertical as the image shows it, because wings bank.
        """
        pixels = self._project(name, camera, t, self._beats[name])
        if pixels is None:
            return math.nan
        beats = pixels.reshape(2, PHASES // EVERY, -1)
        view = self.view(camera, t)
        vertical = _shown(view.axes.T @ (self._pose(name, t)[0] - view.eye), view.axes[2], view.lens)
        return max(_upright(beats, vertical).ravel().tolist())

    def view(self, camera: CameraName, t: float) -> TrueView:
        """Give pose and optics of a camera at time t [s]."""
        if camera == "fixed":
            return self._fixed
        if t != self._zoom_t:
            stands = *self._truth.head_at(t), self._truth.nominal_at(t)
            if stands != self._stood:
                self._qpos[self._axes[0]], self._qpos[self._axes[1]], nominal_px = stands
                mujoco.mj_kinematics(self._model, self._data)
                self._zoom = self._placed(camera, self._truth.zoom_lens_for(nominal_px))
            self._zoom_t, self._stood = t, stands
        return self._zoom

    def _placed(self, camera: CameraName, lens: TrueLens) -> TrueView:
        """Read a camera's pose from the current kinematics."""
        body = self._bodies[camera]
        axes = self._turns[body].copy()
        (fx, fy), (cx, cy), bent = lens.focal_px, lens.center_px, any(lens.distortion)
        to_image = axes.T if bent else np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]) @ axes.T
        return TrueView(self._places[body] + axes[:, 2] * lens.pupil, lens, bent, to_image, axes)

    def _at(self, t: float) -> None:
        """Drop the results cached for another time."""
        if t != self._t:
            self._t, self._poses, self._found = t, {}, {}

    def _pose(self, name: str, t: float) -> tuple[Array, Array, int]:
        """Give a target's position in the world [m], (3,), axes as columns, (3, 3), and index of the nearest phase."""
        self._at(t)
        if name not in self._poses:
            target = self.targets[name]
            beat = target.kind.beat(target, t)
            position, axes, _ = target.kind.stance(target, t, beat)
            phase = round(beat / (2 * math.pi) * PHASES) % PHASES
            self._poses[name] = np.array(position), np.array(axes).T, phase
        return self._poses[name]

    def _outline(self, name: str, camera: CameraName, t: float) -> Outline | None:
        """Compute centre and bounding box of a target's outline [px]; None behind the camera."""
        self._at(t)
        if (name, camera) not in self._found:
            pixels = self._project(name, camera, t, self._points[name][self._pose(name, t)[2]])
            found = None if pixels is None else (pixels[:, -1], *_ends(pixels), pixels)
            self._found[name, camera] = found
        return self._found[name, camera]

    def _up_px(self, name: str, camera: CameraName, t: float) -> Array:
        """Give the direction in which a camera shows a target's upward axis, a unit vector, (2,)."""
        (position, turn, _), view = self._pose(name, t), self.view(camera, t)
        return _shown(view.axes.T @ (position - view.eye), view.axes.T @ turn[:, 2], view.lens)

    def _project(self, name: str, camera: CameraName, t: float, points: Array) -> Array | None:
        """Project points (3, n) of a target's body frame, (2, n) [px]; None where the camera does not image them."""
        (position, turn, _), view = self._pose(name, t), self.view(camera, t)
        center = view.to_image @ (position - view.eye)
        x, y, z = center.tolist()
        if z <= self._reach[name] or (view.bent and math.hypot(x, y) >= fold(view.lens.distortion) * z):
            return None
        x_image = (view.to_image @ turn) @ points + center[:, None]
        xy = x_image[:2] / x_image[2]
        return (view.lens.bend(xy.T) * view.lens.focal_px + view.lens.center_px).T if view.bent else xy


Appearances = Truth | Outlines  # what tells where the targets are in both images


def _ends(values: Array) -> tuple[Array, Array]:
    """Give minimum and maximum along the last axis."""
    return np.minimum.reduce(values, axis=-1), np.maximum.reduce(values, axis=-1)


@lru_cache
def outermost(kind: str, own: Path | None = None) -> Array:
    """Compute a target's outermost points at each phase of its limb cycle, with the body's centre as the last point.

    Args:
        kind: name of the target's kind.
        own: file of a user's own model, which is rigid.

    Returns:
        Points in the body's frame, at the model's own size [m], (PHASES, 3, n).
    """
    model = (kind_model(kind) if own is None else own_model(own, kind, BOARD_GROUP)).compile()
    data, body = mujoco.MjData(model), model.body(kind).id
    surfaces = [surface_points(model, geom) for geom in range(model.ngeom)]
    limbs: Callable[[float], Mapping[str, float]] = kind_of(kind).limbs if own is None else lambda beat: {}
    directions = sphere_points(DIRECTIONS)
    found = []
    for beat in np.arange(PHASES) * 2 * math.pi / PHASES:
        for joint, angle in limbs(beat).items():
            data.joint(joint).qpos[0] = angle
        mujoco.mj_kinematics(model, data)
        turns, places = data.geom_xmat.reshape(-1, 3, 3), data.geom_xpos
        x = np.concatenate([p @ turn.T + place for p, turn, place in zip(surfaces, turns, places, strict=True)])
        x = (x - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
        found.append(x[np.unique(np.argmax(x @ directions.T, axis=0))])
    most = max(map(len, found))
    # Pad each phase to the same number of points by repeating its first point.
    return np.array([np.transpose([*x, *[x[0]] * (most - len(x)), np.zeros(3)]) for x in found])
