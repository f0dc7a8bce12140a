"""What every window on a world needs: a copy of its model that may be shown, its state, and the lines to be drawn."""

import copy
from collections.abc import Iterator

import numpy as np

from cotarget.sim.frusta import Sight
from cotarget.sim.model import RIG_GROUP
from cotarget.sim.opengl import mujoco
from cotarget.sim.truth import Truth

COLOURS = {"fixed": (0.1, 0.45, 1.0, 1.0), "zoom": (1.0, 0.55, 0.05, 1.0)}  # of the frusta
LINE_PX = 2.0
SHOWN_GROUPS = (0, 1, 2, RIG_GROUP)
# From where the scene is looked at first: from behind the rig, its cameras' way.
AHEAD, DISTANCE, ASIDE_DEG, ELEVATION_DEG = 3.0, 7.0, 25.0, -22.0  # [m], [m], [degrees]


class Onlooker:
    """A world's model and state apart from the world's own, which move whenever somebody asks for another time."""

    def __init__(self, truth: Truth) -> None:
        """Copy the model.

        Args:
            truth: of the world that is shown.
        """
        self._truth = truth
        self.model = copy.copy(truth.model)
        self.data = mujoco.MjData(self.model)
        self.come_to(0.0)
        mujoco.mj_forward(self.model, self.data)

    def come_to(self, t: float) -> None:
        """Take over everything's pose at a time up to now [s]."""
        state = self._truth.set_bodies(t)
        self.data.time = t
        self.data.qpos[:] = state.qpos
        self.data.mocap_pos[:], self.data.mocap_quat[:] = state.mocap_pos, state.mocap_quat

    def aim(self, camera: "mujoco.MjvCamera", option: "mujoco.MjvOption") -> None:
        """Put a free camera behind the rig, and let the rig be seen."""
        T = self._truth.T_world_fixed
        ahead = T.rotation.apply([0.0, 0.0, 1.0])
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = T.translation + AHEAD * ahead
        camera.distance, camera.elevation = DISTANCE, ELEVATION_DEG
        camera.azimuth = float(np.degrees(np.arctan2(ahead[1], ahead[0]))) + ASIDE_DEG
        option.geomgroup[:] = np.isin(np.arange(mujoco.mjNGROUP), SHOWN_GROUPS)
        option.sitegroup[:] = 0


def line_geoms(sight: Sight, geoms: "Iterator[mujoco.MjvGeom]") -> int:
    """Make geoms the lines of a sight's frusta.

    Args:
        sight: what is shown.
        geoms: to be changed, one for each line.

    Returns:
        How many there are.
    """
    drawn = 0
    kind = int(mujoco.mjtGeom.mjGEOM_LINE)
    for name, lines in sight.lines.items():
        colour = np.array(COLOURS[name], dtype=np.float32)
        for (begin, end), geom in zip(lines, geoms, strict=False):
            mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), colour)
            geom.emission = 1.0  # as bright in the shade
            mujoco.mjv_connector(geom, kind, LINE_PX, begin, end)
            drawn += 1
    return drawn
