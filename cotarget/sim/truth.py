"""What is really so in a simulated world: for tests and experiments, never for the pipeline.

Poses come from MuJoCo's own kinematics and pixels from the true lenses, so that nothing here can share a mistake
with the pipeline's geometry.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.sim.appearances import CameraName, Silhouette
from cotarget.sim.lens import TrueLens
from cotarget.sim.model import BOARD_GROUP, FRAME_GROUP, RIG, RIG_GROUP
from cotarget.sim.opengl import mujoco
from cotarget.sim.targets import Target

SURFACE_POINTS = 64  # samples on a round geom: its outline is then good to about 1 %
SILHOUETTE_GRID = 96  # a silhouette is painted this large to compare areas [px]
BEAT_PHASES = 8  # samples of one wing beat


@dataclass(frozen=True)
class Surface:
    """Points on a target's geoms: the outline is the union of what they span.

    Attributes:
        geoms: numbers of the target's geoms, (g,).
        owner: for each point the index of its geom among those, (n,).
        starts: for each geom the index of its first point, (g,).
        points: in their geom's own frame [m], (n, 3).
    """

    geoms: npt.NDArray[np.intp]
    owner: npt.NDArray[np.intp]
    starts: npt.NDArray[np.intp]
    points: Array


@dataclass(frozen=True)
class Truth:
    """True poses, pixels and silhouettes at any time up to now.

    Attributes:
        model: the compiled world.
        set_state: brings the world to a time.
        set_bodies: brings rig and targets there, and not what may hide them.
        fixed_lens: the wide camera's optics.
        nominal_at: what the zoom camera's device calls its focal length at a time [px].
        zoom_lens_for: the zoom camera's optics at what its device calls a focal length [px].
        T_world_fixed: the fixed camera.
        T_world_base: the pan-tilt unit.
        head_at: the platform's pan and tilt [rad] at a time.
        focal_range: what the zoom camera's device calls its shortest and longest focal length [px].
        targets: by name.
    """

    model: "mujoco.MjModel"
    set_state: Callable[[float], "mujoco.MjData"]
    set_bodies: Callable[[float], "mujoco.MjData"]
    fixed_lens: TrueLens
    nominal_at: Callable[[float], float]
    zoom_lens_for: Callable[[float], TrueLens]
    T_world_fixed: RigidTransform
    T_world_base: RigidTransform
    head_at: Callable[[float], tuple[float, float]]
    focal_range: tuple[float, float]
    targets: Mapping[str, Target]
    _surfaces: dict[str, "Surface"] = field(default_factory=dict)
    _bodies: dict[str, int] = field(default_factory=dict)
    _scratch: list["mujoco.MjData"] = field(default_factory=list)

    def lens(self, camera: CameraName, t: float) -> TrueLens:
        """A camera's optics at time t."""
        return self.fixed_lens if camera == "fixed" else self.zoom_lens_for(self.nominal_at(t))

    @property
    def longest_px(self) -> float:
        """The zoom camera's true focal length at its longest, in pixels along the rows."""
        return self.zoom_lens_for(self.focal_range[1]).focal_px[0]

    def T_world_camera(self, camera: CameraName, t: float) -> RigidTransform:
        """Pose of a camera's optical centre at time t, in OpenCV's axes."""
        eye, axes = self._camera(self.set_bodies(t), camera, self.lens(camera, t))
        return RigidTransform.from_components(eye, Rotation.from_matrix(axes, assume_valid=True))

    def center(self, name: str, t: float) -> Array:
        """A target's body centre in the world [m], (3,)."""
        return self.targets[name].pose(t).position

    def pixel(self, camera: CameraName, x_world: Array, t: float) -> Array:
        """Where a point of the world appears, (..., 2) [px]; nan behind the camera."""
        lens = self.lens(camera, t)
        eye, axes = self._camera(self.set_bodies(t), camera, lens)
        return lens.project((np.asarray(x_world, dtype=float) - eye) @ axes)

    def center_px(self, name: str, camera: CameraName, t: float) -> Array:
        """A target's body centre in a camera at time t, (2,) [px]; nan behind it."""
        return self.pixel(camera, self.center(name, t), t)

    def line_of_sight_miss(self, pan: float, tilt: float, nominal_px: float, x_world: Array) -> float:
        """Angle between the ray through the middle of the zoom image and a point, with the head at pan, tilt [rad].

        Args:
            pan: of the platform, not rounded to steps [rad].
            tilt: likewise.
            nominal_px: what the device calls the focal length [px].
            x_world: the point [m], (3,).
        """
        data = self._copy(self.set_bodies(0.0))
        data.joint(RIG + "pan").qpos[0], data.joint(RIG + "tilt").qpos[0] = pan, tilt
        mujoco.mj_kinematics(self.model, data)
        lens = self.zoom_lens_for(nominal_px)
        eye, axes = self._camera(data, "zoom", lens)
        x_zoom = (np.asarray(x_world) - eye) @ axes
        xy = lens.directions((np.array(lens.size) - 1) / 2)
        ray = np.append(xy, 1.0)
        return float(np.arctan2(np.linalg.norm(np.cross(ray, x_zoom)), ray @ x_zoom))

    def silhouette(self, name: str, camera: CameraName, t: float) -> Silhouette | None:
        """A target's outline in a camera at time t; None if any of it is behind the camera, or beyond its lens."""
        data, lens = self.set_state(t), self.lens(camera, t)
        view = self._camera(data, camera, lens)
        pixels = self._outline(name, data, view, lens)
        if not np.isfinite(pixels).all():
            return None
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        inside = 1.0
        if (low < -0.5).any() or (high > np.array(lens.size) - 0.5).any():
            parts = np.split(pixels, self._surface(name).starts[1:])
            inside = _fraction_inside(parts, low, high, lens.size)
        return Silhouette(low, high, inside * self._unhidden(name, data, view[0]))

    def unhidden(self, name: str, camera: CameraName, t: float) -> float:
        """The fraction of a target's parts that nothing but the target itself hides from a camera at time t."""
        data = self.set_state(t)
        return self._unhidden(name, data, self._camera(data, camera, self.lens(camera, t))[0])

    def box(self, name: str, camera: CameraName, t: float) -> tuple[Array, Array] | None:
        """Top-left and bottom-right corner of a target's outline, (2,) [px] each, whatever hides it.

        Quicker than its silhouette, whose corners they are; None if any of it is behind the camera.
        """
        data, lens = self.set_bodies(t), self.lens(camera, t)
        pixels = self._outline(name, data, self._camera(data, camera, lens), lens)
        return (pixels.min(axis=0), pixels.max(axis=0)) if np.isfinite(pixels).all() else None

    def largest_side_px(self, name: str, camera: CameraName, t: float) -> float:
        """The larger side of the box, the maximum over one wing beat at the pose of time t [px]; nan behind."""
        target = self.targets[name]
        phases = np.arange(BEAT_PHASES) / BEAT_PHASES * target.beat_s if target.beat_s else [0.0]
        data = self._copy(self.set_bodies(t))
        lens = self.lens(camera, t)
        view = self._camera(data, camera, lens)
        joints = [int(self.model.joint(f"{name}/{joint}").qposadr[0]) for joint in target.pose(t).joints]
        sides = []
        for phase in phases:
            if joints:
                data.qpos[joints] = list(target.pose(t + phase).joints.values())
                mujoco.mj_kinematics(self.model, data)
            pixels = self._outline(name, data, view, lens)
            sides.append(np.max(pixels.max(axis=0) - pixels.min(axis=0)))
        return float(np.max(sides))

    def _copy(self, data: "mujoco.MjData") -> "mujoco.MjData":
        """A state that may be changed: the world's own is kept while nobody asks for another time."""
        if not self._scratch:
            self._scratch.append(mujoco.MjData(self.model))
        copy = self._scratch[0]
        copy.qpos[:], copy.mocap_pos[:], copy.mocap_quat[:] = data.qpos, data.mocap_pos, data.mocap_quat
        mujoco.mj_kinematics(self.model, copy)
        return copy

    def _outline(self, name: str, data: "mujoco.MjData", view: tuple[Array, Array], lens: TrueLens) -> Array:
        """Pixels of the points on a target's geoms, one after the other, (n, 2); nan where the camera has none."""
        surface = self._surface(name)
        axes = data.geom_xmat[surface.geoms].reshape(-1, 3, 3)
        x_world = np.einsum("nij,nj->ni", axes[surface.owner], surface.points)
        eye, camera_axes = view
        return lens.project((x_world + (data.geom_xpos[surface.geoms] - eye)[surface.owner]) @ camera_axes)

    def _camera(self, data: "mujoco.MjData", camera: CameraName, lens: TrueLens) -> tuple[Array, Array]:
        """A camera's pupil in the world [m], (3,), and its axes as columns, (3, 3)."""
        if camera not in self._bodies:
            self._bodies[camera] = self.model.body(RIG + camera).id
        body = self._bodies[camera]
        axes = np.array(data.xmat[body].reshape(3, 3))
        return data.xpos[body] + axes[:, 2] * lens.pupil, axes

    def _surface(self, name: str) -> "Surface":
        """What a target's outline is made of."""
        if name not in self._surfaces:
            root = self.model.body(self.targets[name].body).id
            geoms = np.flatnonzero(self.model.body_rootid[self.model.geom_bodyid] == root)
            points = [surface_points(self.model, int(geom)) for geom in geoms]
            counts = [len(each) for each in points]
            self._surfaces[name] = Surface(
                geoms, np.repeat(np.arange(len(geoms)), counts), np.cumsum([0, *counts[:-1]]), np.concatenate(points)
            )
        return self._surfaces[name]

    def _unhidden(self, name: str, data: "mujoco.MjData", eye: Array) -> float:
        """Fraction of the target's parts whose middle a ray from the eye reaches, through nothing but the target.

        Parts inside or outside the image count alike. A mesh's middle is its centre of mass.
        """
        own = self._surface(name).geoms
        groups = np.ones(mujoco.mjNGROUP, dtype=np.uint8)
        groups[[BOARD_GROUP, RIG_GROUP, FRAME_GROUP]] = 0
        hit, distance = np.zeros(len(own), dtype=np.int32), np.zeros(len(own))
        ways = (data.geom_xpos[own] - eye).ravel()
        mujoco.mj_multiRay(
            self.model, data, eye, ways, groups, True, -1, hit, distance, None, len(own), float(mujoco.mjMAXVAL)
        )
        return float(np.isin(hit, own).mean())


def _fraction_inside(outlines: list[Array], low: Array, high: Array, size: tuple[int, int]) -> float:
    """Fraction of the area of a union of convex outlines that lies within the image."""
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
    """Points on a geom's surface in its own frame, (n, 3)."""
    size, kind = model.geom_size[geom], mujoco.mjtGeom(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return np.array(np.meshgrid(*([-s, s] for s in size))).reshape(3, -1).T
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        vertices = np.asarray(model.mesh_vert[start : start + count], dtype=float)
        try:
            return vertices[np.unique(ConvexHull(vertices).simplices)]  # the others cannot be on an outline
        except QhullError:  # it is flat
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
    """Evenly spread points on the unit sphere (Fibonacci's lattice), (count, 3)."""
    i = np.arange(count) + 0.5
    z, around = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z * z)
    return np.column_stack([r * np.cos(around), r * np.sin(around), z])
