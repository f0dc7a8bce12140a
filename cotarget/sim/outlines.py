"""Where targets appear in both cameras, told in a fraction of the time that the truth takes, and a little less exact.

`Truth` brings all bodies to their poses and projects every corner of them. Here a target's outermost points are worked
out beforehand, for phases of its limbs' beat, so that a frame takes the target's own pose and one projection. Who asks
at every frame for hours, as an environment does, asks these.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple, get_args

import numpy as np

from cotarget.assets import assets_dir
from cotarget.geometry import Array
from cotarget.sim.appearances import CameraName, Silhouette
from cotarget.sim.gait import limbs
from cotarget.sim.lens import TrueLens, fold
from cotarget.sim.model import BOARD_GROUP, FRAME_GROUP, RIG, RIG_GROUP
from cotarget.sim.opengl import mujoco
from cotarget.sim.targets import Target
from cotarget.sim.truth import Truth, sphere_points, surface_points

PHASES = 48  # of a beat: from one to the next the tip of a wing moves by 2 % of the span at most
EVERY = 6  # of these counts for the larger side over a beat
ROOM = 0.5  # a target is no farther beside the knots of its way, and a lens's pupil before its camera [m]
DIRECTIONS = 160  # in which a target's outermost points are looked for, some 16 degrees apart


Outline = tuple[Array, Array, Array]  # pixels of the middle, of the top-left and of the bottom-right corner, (2,) each


class View(NamedTuple):
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

    def view(self, camera: CameraName, t: float) -> View:
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

    def _placed(self, camera: CameraName, lens: TrueLens) -> View:
        """A camera as it stands now."""
        body = self._bodies[camera]
        axes = self._turns[body].copy()
        (fx, fy), (cx, cy), bent = lens.focal_px, lens.center_px, any(lens.distortion)
        to_image = axes.T if bent else np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]) @ axes.T
        return View(self._places[body] + axes[:, 2] * lens.pupil, lens, bent, to_image)

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
