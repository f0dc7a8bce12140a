"""Pictures of the simulated rig itself, with the pixels of its frames' origins."""

from dataclasses import dataclass

import numpy as np

from cotarget.geometry import Array
from cotarget.rig import Image
from cotarget.sim.model import BOARD_GROUP, FRAME_GROUP, PORTRAIT_SIZE, RIG, RIG_GROUP
from cotarget.sim.render.opengl import make_renderer, mujoco

FIELD_DEG = 40.0
ELEVATION_DEG = -18.0
CLOSEST = 1.25  # [m]
FILL = 2.2  # ratio of the viewing distance to the rig's extent
FRAMES = ("fixed", "zoom", "base")


@dataclass(frozen=True)
class Portrait:
    """Picture of the rig, (H, W, 3) BGR, and the pixels of its frames' origins, (2,) each."""

    image: Image
    origins_px: dict[str, Array]


def portrait(model: "mujoco.MjModel", data: "mujoco.MjData", azimuth_deg: float, axes: bool) -> Portrait:
    """Render the rig in its current state.

    Args:
        model: the compiled world.
        data: state of the world.
        azimuth_deg: direction of view; 90 is the world's +y [degrees].
        axes: whether the frames' axes are drawn (x red, y green, z blue).
    """
    origins = {name: np.array(data.body(RIG + name).xpos) for name in FRAMES}
    points = np.array(list(origins.values()))
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat = points.mean(axis=0) - [0.0, 0.0, 0.12]  # the body of the pan-tilt unit is below the frames
    camera.distance = max(CLOSEST, FILL * float(np.linalg.norm(np.ptp(points, axis=0))))
    camera.azimuth, camera.elevation = azimuth_deg, ELEVATION_DEG
    option = mujoco.MjvOption()
    option.geomgroup[RIG_GROUP], option.geomgroup[FRAME_GROUP], option.geomgroup[BOARD_GROUP] = 1, axes, 0
    option.sitegroup[:] = 0
    before = float(model.vis.global_.fovy)
    renderer = make_renderer(model, *PORTRAIT_SIZE)
    try:
        model.vis.global_.fovy = FIELD_DEG
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        renderer.update_scene(data, camera, option)
        image = np.ascontiguousarray(renderer.render()[..., ::-1])
        pixels = {name: _project(renderer.scene, x) for name, x in origins.items()}
    finally:
        model.vis.global_.fovy = before
        renderer.close()
    return Portrait(image, pixels)


def _project(scene: "mujoco.MjvScene", x_world: Array) -> Array:
    """Project a point of the world into a free camera's render, (2,) [px]."""
    left, right = scene.camera[0], scene.camera[1]  # MuJoCo keeps two for stereo; their mean is the view
    forward, up = np.array(left.forward), np.array(left.up)
    offset = x_world - (np.array(left.pos) + np.array(right.pos)) / 2
    focal = PORTRAIT_SIZE[1] / 2 / np.tan(np.radians(FIELD_DEG) / 2)
    across = np.array([offset @ np.cross(forward, up), -(offset @ up)])
    return (np.array(PORTRAIT_SIZE) - 1) / 2 + focal * across / (offset @ forward)
