"""MuJoCo's own renderer, for comparison with the simulated rig and the environments."""

import time

import numpy as np

from cotarget.schema import Size
from cotarget.sim.model import RENDER_PITCH, RIG, build_model
from cotarget.sim.render.opengl import make_renderer, mujoco
from cotarget.sim.state import WorldState
from cotarget.sim.world import CAMERAS, SimWorld


class PlainRenderer:
    """mujoco.Renderer on the frames of a world without image effects."""

    def __init__(self, world: SimWorld, size: Size | None = None) -> None:
        """Open the renderer, for pictures of a size with the same field of view; by default as large as the streams."""
        sim, self._truth = world.config.sim, world.truth()
        drawn = sim.fixed.size if size is None else size
        self._scales = {
            "fixed": np.divide(drawn, sim.fixed.size) * RENDER_PITCH,
            "zoom": np.divide(drawn, sim.zoom.size) * RENDER_PITCH,
        }
        self.model = build_model(world.config, tuple(world.targets.values()), drawn)
        if size is not None:  # OpenGL clears and resolves the whole buffer
            self.model.vis.global_.offwidth, self.model.vis.global_.offheight = size
        self._state = WorldState(self.model, world.targets, world.head_drive, self._truth.T_world_fixed, None)
        self._renderer = make_renderer(self.model, *drawn)
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = sim.effects.shadows

    def draw(self, t: float) -> float:
        """Draw both cameras' frames of time t [s]; give the time taken without moving the world to its pose [s]."""
        data, option, took = self._state.lit(t), mujoco.MjvOption(), 0.0
        option.geomgroup[3:] = 0  # hide the board and the rig itself
        for camera in CAMERAS:
            number, focal = self.model.camera(RIG + camera).id, self._truth.lens(camera, t).focal_px
            self.model.cam_intrinsic[number] = (*(self._scales[camera] * focal), 0.0, 0.0)
            began = time.perf_counter()
            self._renderer.update_scene(data, number, option)
            self._renderer.render()
            took += time.perf_counter() - began
        return took

    def close(self) -> None:
        """Release OpenGL."""
        self._renderer.close()
