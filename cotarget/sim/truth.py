"""What is really so in a simulated world: for tests and experiments, never for the pipeline.

Poses come from MuJoCo's own kinematics and pixels from the true lenses, so that nothing here can share a mistake
with the pipeline's geometry.

What may be asked about where the targets of a simulated world truly appear: `Truth` answers it, and `Outlines`.

Where targets appear in both cameras, told in a fraction of the time that the truth takes, and a little less exact.

`Truth` brings all bodies to their poses and projects every corner of them. Here a target's outermost points are worked
out beforehand, for phases of its limbs' beat, so that a frame takes the target's own pose and one projection. Who asks
at every frame for hours, as an environment does, asks these.

Whether a scene has room for ways that were made for another: how much of them its wide camera sees.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal, NamedTuple, Protocol, get_args

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from cotarget.config import SimConfig
from cotarget.errors import ConfigError
from cotarget.files import assets_dir
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.sim.model import BOARD_GROUP, FRAME_GROUP, RIG, RIG_GROUP, mount_pose, scene_spec
from cotarget.sim.render.opengl import mujoco
from cotarget.sim.render.optics import TrueLens, fold
from cotarget.sim.targets.gait import limbs
from cotarget.sim.targets.target import Target

CameraName = Literal["fixed", "zoom"]


@dataclass(frozen=True)
class Silhouette:
    """A target's true outline in one image, not clipped to it.

    Attributes:
        low_px: top-left corner of its box, (2,).
        high_px: bottom-right corner, (2,).
        visible: fraction of the target that shows: of its outline's area, the fraction inside the image, times, of
            its parts (geoms, each counting the same whatever its size), the fraction whose middle a ray from the
            camera reaches with nothing but the target itself in the way. Hence exact for a target that is cut by the
            image's border only; for one behind something it goes in steps of a part, and the two fractions are
            taken to be independent. A board shown to the cameras and the rig itself hide nothing.
    """

    low_px: Array
    high_px: Array
    visible: float

    @property
    def size_px(self) -> Array:
        """(width, height) of the box."""
        return self.high_px - self.low_px


class Appearances(Protocol):
    """Where targets appear in both cameras, at any time up to now."""

    @property
    def targets(self) -> Mapping[str, Target]:
        """By name."""

    @property
    def fixed_lens(self) -> TrueLens:
        """The wide camera's optics."""

    @property
    def longest_px(self) -> float:
        """The zoom camera's true focal length at its longest, in pixels along the rows."""

    def lens(self, camera: CameraName, t: float) -> TrueLens:
        """A camera's optics at time t."""

    def center_px(self, name: str, camera: CameraName, t: float) -> Array:
        """A target's body centre in a camera at time t, (2,) [px]; nan behind it."""

    def box(self, name: str, camera: CameraName, t: float) -> tuple[Array, Array] | None:
        """Top-left and bottom-right corner of a target's outline at time t, (2,) [px] each; None behind the camera."""

    def silhouette(self, name: str, camera: CameraName, t: float) -> Silhouette | None:
        """A target's outline in a camera at time t; None behind the camera."""

    def largest_side_px(self, name: str, camera: CameraName, t: float) -> float:
        """The larger side of the box, the maximum over one wing beat at the pose of time t [px]; nan behind."""


# --- room ---

NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)


def part_seen(sim: SimConfig, x_world: Array) -> float:
    """Which part of some places is in the wide camera's picture, and not behind what stands in the scene.

    Args:
        sim: its scene and its wide camera count.
        x_world: the places in the world [m], (n, 3).

    Raises:
        ConfigError: the scene is none.
    """
    try:
        model = scene_spec(sim.scene).compile()
    except ValueError as error:
        raise ConfigError(f"{sim.scene}: does not compile: {' '.join(str(error).split())}") from None
    T_world_fixed, camera = mount_pose(model), sim.fixed
    distortion = camera.distortion if sim.effects.distortion else NO_DISTORTION
    lens = TrueLens(camera.size, camera.focal_px, camera.center_px, distortion)
    pixels = lens.project(T_world_fixed.inv().apply(x_world))
    inside = ((pixels > -0.5) & (pixels < np.array(camera.size) - 0.5)).all(axis=1)  # nan is not
    return float((inside & _free(model, T_world_fixed.translation, x_world)).mean())


def _free(model: "mujoco.MjModel", eye: Array, x_world: Array) -> npt.NDArray[np.bool_]:
    """Whether nothing that is drawn stands between an eye (3,) and each of some places (n, 3)."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    ways = x_world - eye
    far, count = np.linalg.norm(ways, axis=1), len(ways)
    groups = (np.arange(mujoco.mjNGROUP) < BOARD_GROUP).astype(np.uint8)
    hit, distance = np.zeros(count, dtype=np.int32), np.zeros(count)
    rays = (ways / far[:, None]).ravel()
    mujoco.mj_multiRay(model, data, eye, rays, groups, True, -1, hit, distance, None, count, float(mujoco.mjMAXVAL))
    return np.asarray((hit < 0) | (distance > far))


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


# --- outlines ---

PHASES = 48  # of a beat: from one to the next the tip of a wing moves by 2 % of the span at most
EVERY = 6  # of these counts for the larger side over a beat
ROOM = 0.5  # a target is no farther beside the knots of its way, and a lens's pupil before its camera [m]
DIRECTIONS = 160  # in which a target's outermost points are looked for, some 16 degrees apart
Outline = tuple[Array, Array, Array]  # pixels of the middle, of the top-left and of the bottom-right corner, (2,) each


class TrueView(NamedTuple):
    """A camera at one time.

    Attributes:
        eye: its optical centre in the world [m], (3,).
        lens: its optics.
        bent: whether they distort.
        to_image: from directions in the world to homogeneous pixels, (3, 3); where the lens distorts, to its axes.
    """

    eye: Array
    lens: TrueLens
    bent: bool
    to_image: Array


class Outlines:
    """The outlines of a world's targets; see `Appearances`."""

    def __init__(self, truth: Truth, still: bool) -> None:
        """Prepare.

        Args:
            truth: of the world.
            still: whether nothing but its targets and its rig moves, so that what may hide a lone target is known.
        """
        self._truth, self._model, self._data = truth, truth.model, mujoco.MjData(truth.model)
        mujoco.mj_kinematics(self._model, self._data)
        data = self._data  # to ask it for its arrays takes as long as to work with them
        self._qpos, self._places, self._turns = data.qpos, data.xpos, data.xmat.reshape(-1, 3, 3)
        self._points = {name: outermost(each.kind) * each.size for name, each in truth.targets.items()}
        self._beats = {name: np.concatenate(points[::EVERY], axis=1) for name, points in self._points.items()}
        self._reach = {name: float(np.linalg.norm(points, axis=1).max()) for name, points in self._points.items()}
        self._axes = [int(self._model.joint(RIG + axis).qposadr[0]) for axis in ("pan", "tilt")]
        self._bodies = {camera: self._model.body(RIG + camera).id for camera in get_args(CameraName)}
        self._exposed = still and len(truth.targets) == 1 and self._stands_free(*truth.targets)
        self._longest_px = truth.longest_px
        self._fixed = self._placed("fixed", truth.fixed_lens)
        # What was worked out for the time asked for last, and of the zoom camera for where head and lens were then.
        self._t = self._zoom_t = math.nan
        self._zoom, self._stood = self._fixed, (math.nan, math.nan, math.nan)
        self._poses: dict[str, tuple[Array, Array, int]] = {}
        self._found: dict[tuple[str, CameraName], Outline | None] = {}

    @property
    def targets(self) -> Mapping[str, Target]:
        """By name."""
        return self._truth.targets

    @property
    def fixed_lens(self) -> TrueLens:
        """The wide camera's optics."""
        return self._truth.fixed_lens

    @property
    def longest_px(self) -> float:
        """The zoom camera's true focal length at its longest, in pixels along the rows."""
        return self._longest_px

    def lens(self, camera: CameraName, t: float) -> TrueLens:
        """A camera's optics at time t."""
        return self.view(camera, t).lens

    def center(self, name: str, t: float) -> Array:
        """A target's body centre in the world [m], (3,)."""
        return self._pose(name, t)[0]

    def center_px(self, name: str, camera: CameraName, t: float) -> Array:
        """A target's body centre in a camera at time t, (2,) [px]; nan behind it."""
        found = self._outline(name, camera, t)
        return np.full(2, np.nan) if found is None else found[0]

    def box(self, name: str, camera: CameraName, t: float) -> tuple[Array, Array] | None:
        """Top-left and bottom-right corner of a target's outline at time t, (2,) [px] each; None behind the camera."""
        found = self._outline(name, camera, t)
        return None if found is None else found[1:]

    def silhouette(self, name: str, camera: CameraName, t: float) -> Silhouette | None:
        """A target's outline in a camera at time t; None behind the camera.

        Of its area that fraction counts as inside the image that of its box is.
        """
        box = self.box(name, camera, t)
        if box is None:
            return None
        low, high = box
        (left, top), (right, bottom) = low.tolist(), high.tolist()
        width, height = self.lens(camera, t).size
        across = min(right, width - 0.5) - max(left, -0.5)
        down = min(bottom, height - 0.5) - max(top, -0.5)
        if across <= 0 or down <= 0:
            return Silhouette(low, high, 0.0)
        inside = across * down / ((right - left) * (bottom - top))
        return Silhouette(low, high, inside * self._unhidden(name, camera, t))

    def largest_side_px(self, name: str, camera: CameraName, t: float) -> float:
        """The larger side of the box, the maximum over one beat at the pose of time t [px]; nan behind."""
        pixels = self._project(name, camera, t, self._beats[name])
        if pixels is None:
            return math.nan
        low, high = _ends(pixels.reshape(2, PHASES // EVERY, -1))
        return max((high - low).ravel().tolist())

    def view(self, camera: CameraName, t: float) -> TrueView:
        """A camera at time t."""
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
        """A camera as it stands now."""
        body = self._bodies[camera]
        axes = self._turns[body].copy()
        (fx, fy), (cx, cy), bent = lens.focal_px, lens.center_px, any(lens.distortion)
        to_image = axes.T if bent else np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]) @ axes.T
        return TrueView(self._places[body] + axes[:, 2] * lens.pupil, lens, bent, to_image)

    def _at(self, t: float) -> None:
        """Forget what was worked out for another time."""
        if t != self._t:
            self._t, self._poses, self._found = t, {}, {}

    def _pose(self, name: str, t: float) -> tuple[Array, Array, int]:
        """A target's position in the world [m], (3,), its axes as columns, (3, 3), and the nearest phase's number."""
        self._at(t)
        if name not in self._poses:
            target = self.targets[name]
            beat = target.beat(t)
            position, axes, _ = target.stance(t, beat)
            phase = round(beat / (2 * math.pi) * PHASES) % PHASES
            self._poses[name] = np.array(position), np.array(axes).T, phase
        return self._poses[name]

    def _outline(self, name: str, camera: CameraName, t: float) -> Outline | None:
        """A target's outline, and where its middle is; None behind the camera."""
        self._at(t)
        if (name, camera) not in self._found:
            pixels = self._project(name, camera, t, self._points[name][self._pose(name, t)[2]])
            found = None if pixels is None else (pixels[:, -1], *_ends(pixels))
            self._found[name, camera] = found
        return self._found[name, camera]

    def _project(self, name: str, camera: CameraName, t: float, points: Array) -> Array | None:
        """Pixels of points (3, n) in a target's body's frame, (2, n); None behind the camera or beyond its lens."""
        (position, turn, _), view = self._pose(name, t), self.view(camera, t)
        center = view.to_image @ (position - view.eye)
        x, y, z = center.tolist()
        if z <= self._reach[name] or (view.bent and math.hypot(x, y) >= fold(view.lens.distortion) * z):
            return None
        x_image = (view.to_image @ turn) @ points + center[:, None]
        xy = x_image[:2] / x_image[2]
        return (view.lens.bend(xy.T) * view.lens.focal_px + view.lens.center_px).T if view.bent else xy

    def _stands_free(self, name: str) -> bool:
        """Whether nothing that stands can come between the cameras and a target, wherever it goes.

        What stands beyond the box about the cameras and all of the target's way cannot. Neither can a plane before
        which all of that is, whose middle counts: who walks on the ground is not hidden by it.
        """
        model, data, path = self._model, self._data, self.targets[name].path
        way = np.array([path.position(t) for t in path.spline.x])
        eyes = data.xpos[list(self._bodies.values())]
        reach = self._reach[name] + ROOM
        lever = float(np.linalg.norm(data.xpos[self._bodies["zoom"]] - self._truth.T_world_base.translation))
        room = ROOM + 2 * lever  # the head carries the zoom camera round
        low = np.minimum(way.min(axis=0) - reach, eyes.min(axis=0) - room)
        high = np.maximum(way.max(axis=0) + reach, eyes.max(axis=0) + room)
        root = model.body_rootid[model.geom_bodyid]
        standing = (model.body_mocapid[root] < 0) & ~np.isin(model.geom_group, (BOARD_GROUP, RIG_GROUP, FRAME_GROUP))
        for geom in np.flatnonzero(standing):
            turn, place = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
                if ((np.concatenate([way, eyes]) - place) @ turn[:, 2]).min() <= 0:
                    return False
                continue
            middle = place + turn @ model.geom_aabb[geom, :3]
            half = np.abs(turn) @ model.geom_aabb[geom, 3:]
            if (middle - half <= high).all() and (middle + half >= low).all():
                return False
        return True

    def _unhidden(self, name: str, camera: CameraName, t: float) -> float:
        """The fraction of a target's parts that nothing but the target itself hides from a camera."""
        return 1.0 if self._exposed else self._truth.unhidden(name, camera, t)


def _ends(values: Array) -> tuple[Array, Array]:
    """Lowest and highest along the last axis."""
    return np.minimum.reduce(values, axis=-1), np.maximum.reduce(values, axis=-1)


@lru_cache
def outermost(kind: str) -> Array:
    """A target's outermost points at each phase of its beat, and its body's centre as the last of each.

    Args:
        kind: of the target.

    Returns:
        In the body's frame, as large as the model is [m], (PHASES, 3, n).
    """
    model = mujoco.MjSpec.from_file(str(assets_dir() / "targets" / f"{kind}.xml")).compile()
    data, body = mujoco.MjData(model), model.body(kind).id
    surfaces = [surface_points(model, geom) for geom in range(model.ngeom)]
    directions = sphere_points(DIRECTIONS)
    found = []
    for beat in np.arange(PHASES) * 2 * math.pi / PHASES:
        for joint, angle in limbs(kind, beat).items():
            data.joint(joint).qpos[0] = angle
        mujoco.mj_kinematics(model, data)
        turns, places = data.geom_xmat.reshape(-1, 3, 3), data.geom_xpos
        x = np.concatenate([p @ turn.T + place for p, turn, place in zip(surfaces, turns, places, strict=True)])
        x = (x - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
        found.append(x[np.unique(np.argmax(x @ directions.T, axis=0))])
    most = max(map(len, found))
    # In a table all phases have as many: where there are fewer, the first is there again.
    return np.array([np.transpose([*x, *[x[0]] * (most - len(x)), np.zeros(3)]) for x in found])
