"""Whether a scene has room for ways that were made for another: how much of them its wide camera sees."""

import numpy as np
import numpy.typing as npt

from cotarget.errors import ConfigError
from cotarget.geometry import Array
from cotarget.sim.lens import TrueLens
from cotarget.sim.model import BOARD_GROUP, mount_pose, scene_spec
from cotarget.sim.opengl import mujoco
from cotarget.simconfig import SimConfig

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
