"""Poses of a compiled world at a time: head, targets, board and clutter, as functions of time alone."""

import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from cotarget.geometry import RigidTransform
from cotarget.sim.model import BOARD, RIG, quaternion
from cotarget.sim.motion import HeadDrive
from cotarget.sim.render.opengl import mujoco
from cotarget.sim.targets.target import Target
from cotarget.sim.weather import Clutter

SWING, SWING_PERIOD = 0.15, 1.7  # of a swinging board: amplitude [m] and period [s]


class WorldState:
    """Poses of everything in the world at any time up to now."""

    def __init__(
        self,
        model: "mujoco.MjModel",
        targets: Mapping[str, Target],
        head: HeadDrive,
        T_world_fixed: RigidTransform,
        clutter: Clutter | None,
    ) -> None:
        """Look up the addresses of joints and bodies in the model.

        Args:
            model: the compiled world.
            targets: targets by name.
            head: axes of the pan-tilt unit.
            T_world_fixed: pose of the fixed camera.
            clutter: moving foliage, clouds and light; None for none.
        """
        self._model, self._data = model, mujoco.MjData(model)
        self._head, self._T_world_fixed, self._clutter = head, T_world_fixed, clutter
        self._axes = [self._address(RIG + "pan"), self._address(RIG + "tilt")]
        self._targets = [
            (target, self._mocap(target.body), [self._address(f"{name}/{joint}") for joint in target.pose(0.0).joints])
            for name, target in targets.items()
        ]
        self._board = self._mocap(BOARD)
        self._boards: list[tuple[float, RigidTransform | None, bool]] = [(-math.inf, None, False)]
        self._shown: tuple[float, float, float, int] | None = None
        self._cluttered = False

    @property
    def faint(self) -> npt.NDArray[np.intp]:
        """Ids of the geoms without sharp edges, which exposure blur does not change."""
        return np.zeros(0, dtype=np.intp) if self._clutter is None else self._clutter.faint

    def at(self, t: float) -> "mujoco.MjData":
        """Move everything to its pose at time t [s]; the data is the world's own and changes with the next call."""
        data = self.bodies_at(t)
        if self._clutter is not None and not self._cluttered:
            self._clutter.move(data, t)
            self._cluttered = True
        return data

    def bodies_at(self, t: float) -> "mujoco.MjData":
        """Move rig, targets and board to time t [s], and leave foliage and clouds at their last pose."""
        pan, tilt = self._head.angles_at(t)
        wanted = (t, pan, tilt, len(self._boards))
        if wanted == self._shown:
            return self._data
        data = self._data
        data.qpos[self._axes] = pan, tilt
        for target, index, joints in self._targets:
            pose = target.pose(t)
            self._data.mocap_pos[index] = pose.position
            self._data.mocap_quat[index] = pose.rotation.as_quat(scalar_first=True)
            if joints:
                data.qpos[joints] = list(pose.joints.values())
        if (T_fixed_board := self.board_at(t)) is not None:
            T_world_board = self._T_world_fixed * T_fixed_board
            data.mocap_pos[self._board], data.mocap_quat[self._board] = (
                T_world_board.translation,
                quaternion(T_world_board),
            )
        mujoco.mj_kinematics(self._model, data)
        self._shown, self._cluttered = wanted, False
        return data

    def lit(self, t: float) -> "mujoco.MjData":
        """Move everything to time t [s], with cameras and lights as rendering needs them."""
        data = self.at(t)
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_camlight(self._model, data)
        if self._clutter is not None:
            self._clutter.light(self._model, t)
        return data

    def place_board(self, since: float, T_fixed_board: RigidTransform | None, swings: bool) -> None:
        """Put the board at a pose from a time on [s]; None removes it."""
        self._boards.append((since, T_fixed_board, swings))

    def board_at(self, t: float) -> RigidTransform | None:
        """Give T_fixed_board at a time [s]; None while there is no board."""
        since, T, swings = next(placed for placed in reversed(self._boards) if placed[0] <= t)
        if T is None or not swings:
            return T
        return T * RigidTransform.from_translation([SWING * math.sin(2 * math.pi * (t - since) / SWING_PERIOD), 0, 0])

    def _address(self, joint: str) -> int:
        return int(self._model.joint(joint).qposadr[0])

    def _mocap(self, body: str) -> int:
        return int(self._model.body(body).mocapid[0])
