"""Parts that all windows share: a snapshot of a world, the cameras' frusta, and a copy of the model."""

import copy
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from cotarget.geometry import Array, RigidTransform
from cotarget.rig import Image
from cotarget.sim.model import RIG_GROUP
from cotarget.sim.render.opengl import mujoco
from cotarget.sim.render.optics import TrueLens
from cotarget.sim.truth import CameraName, Truth

# Default length of a frustum along the axis [m]; the fixed camera's ends before it meets the floor.
FAR: Mapping[CameraName, float] = {"fixed": 4.0, "zoom": 8.0}
SIDE_POINTS = 8  # segments per side of a frustum's end, which distortion bends


@dataclass(frozen=True)
class Snapshot:
    """One moment of a world, as a window shows it.

    Attributes:
        t: time on the rig's clock [s].
        caption: description of the moment.
        pictures: image of each camera, (H, W, 3) BGR.
        lines: frustum of each camera, start and end of each line in the world, (n, 2, 3) [m].
    """

    t: float
    caption: str
    pictures: Mapping[CameraName, Image]
    lines: Mapping[CameraName, Array]


def frustum_rim(T_world_camera: RigidTransform, lens: TrueLens, depth: float) -> Array:
    """Compute the border of a camera's image in the world at a depth: the end of its frustum.

    Args:
        T_world_camera: pose of the optical centre, in OpenCV's axes.
        lens: true optics of the camera.
        depth: distance along the camera's axis [m].

    Returns:
        Points around the border, (4 n, 3) [m]; each n-th is a corner, the first the top-left one.
    """
    width, height = lens.size
    # The image's border is half a pixel outside the outermost pixels' centres.
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    along = np.linspace(0.0, 1.0, SIDE_POINTS, endpoint=False)[:, None]
    border = np.concatenate([a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    x_camera = np.column_stack([lens.directions(border), np.ones(len(border))]) * depth
    return T_world_camera.apply(x_camera)


def frustum_lines(T_world_camera: RigidTransform, lens: TrueLens, depth: float) -> Array:
    """Compute a camera's frustum as lines in the world, (n, 2, 3) [m]: its end, then its four edges."""
    rim = frustum_rim(T_world_camera, lens, depth)
    corners = rim[::SIDE_POINTS]
    edges = np.stack([np.broadcast_to(T_world_camera.translation, corners.shape), corners], axis=1)
    return np.concatenate([np.stack([rim, np.roll(rim, -1, axis=0)], axis=1), edges])


def frusta_of(truth: Truth, t: float, depths: Mapping[CameraName, float] | None = None) -> dict[CameraName, Array]:
    """Compute the true frusta of both cameras at a time; the zoom camera's follows pan, tilt and focal length.

    Args:
        truth: ground truth of the world.
        t: time, up to now [s].
        depths: lengths of the frusta along each camera's axis [m].
    """
    ends = {**FAR, **(depths or {})}
    return {name: frustum_lines(truth.T_world_camera(name, t), truth.lens(name, t), end) for name, end in ends.items()}


COLOURS = {"fixed": (0.1, 0.45, 1.0, 1.0), "zoom": (1.0, 0.55, 0.05, 1.0)}  # colours of the frusta
LINE_PX = 2.0
SHOWN_GROUPS = (0, 1, 2, RIG_GROUP)
# First view: from behind the rig, along its cameras' direction.
AHEAD, DISTANCE, ASIDE_DEG, ELEVATION_DEG = 3.0, 7.0, 25.0, -22.0  # [m], [m], [degrees]


class WorldCopy:
    """Copy of a world's model and state, which stays as it is when the world's own state moves to another time."""

    def __init__(self, truth: Truth) -> None:
        """Copy the model.

        Args:
            truth: ground truth of the world that is shown.
        """
        self._truth = truth
        self.model = copy.copy(truth.model)
        self.data = mujoco.MjData(self.model)
        self.move_to(0.0)
        mujoco.mj_forward(self.model, self.data)

    def move_to(self, t: float) -> None:
        """Copy the world's poses at a time up to now [s]."""
        state = self._truth.set_bodies(t)
        self.data.time = t
        self.data.qpos[:] = state.qpos
        self.data.mocap_pos[:], self.data.mocap_quat[:] = state.mocap_pos, state.mocap_quat

    def aim(self, camera: "mujoco.MjvCamera", option: "mujoco.MjvOption") -> None:
        """Put a free camera behind the rig, and show the rig's geoms."""
        T = self._truth.T_world_fixed
        ahead = T.rotation.apply([0.0, 0.0, 1.0])
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = T.translation + AHEAD * ahead
        camera.distance, camera.elevation = DISTANCE, ELEVATION_DEG
        camera.azimuth = float(np.degrees(np.arctan2(ahead[1], ahead[0]))) + ASIDE_DEG
        option.geomgroup[:] = np.isin(np.arange(mujoco.mjNGROUP), SHOWN_GROUPS)
        option.sitegroup[:] = 0


def line_geoms(sight: Snapshot, geoms: "Iterator[mujoco.MjvGeom]") -> int:
    """Set geoms to the lines of a snapshot's frusta.

    Args:
        sight: snapshot that is shown.
        geoms: geoms to change, one for each line.

    Returns:
        Number of lines.
    """
    drawn = 0
    kind = int(mujoco.mjtGeom.mjGEOM_LINE)
    for name, lines in sight.lines.items():
        colour = np.array(COLOURS[name], dtype=np.float32)
        for (begin, end), geom in zip(lines, geoms, strict=False):
            mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), colour)
            geom.emission = 1.0  # visible in the shade too
            mujoco.mjv_connector(geom, kind, LINE_PX, begin, end)
            drawn += 1
    return drawn
