"""The simulated world: time -> poses -> images, with the rig's devices in front and the truth behind."""

import math
import zlib
from dataclasses import replace
from functools import partial

import numpy as np

from cotarget.config import RigConfig, SimCamera
from cotarget.geometry import RigidTransform
from cotarget.rig import Clock, Image
from cotarget.sim.devices import (
    SimBoard,
    SimClock,
    SimPanTilt,
    SimRig,
    SimStream,
    SimZoomStream,
    head_drive,
    lens_drive,
)
from cotarget.sim.lens import TrueLens, bend, covering_half_field
from cotarget.sim.model import (
    BOARD_GROUP,
    FRAME_GROUP,
    RENDER_PITCH,
    RIG,
    RIG_GROUP,
    base_pose,
    build_model,
    mount_pose,
    quaternion,
)
from cotarget.sim.opengl import make_renderer, mujoco
from cotarget.sim.portrait import Portrait, portrait
from cotarget.sim.sensor import Sensor
from cotarget.sim.targets import Target, make_target
from cotarget.sim.truth import CameraName, Truth

NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)
# Streams of random numbers, so that one effect's draws never shift another's.
FIXED_NOISE, ZOOM_NOISE, TARGETS = 1, 2, 3
# The render's size is worked out for this many focal lengths of the zoom lens; between them its optics are smooth.
SIZED_FOCALS = 17
# A blurred image is the mean of this many renders spread over the exposure.
BLUR_RENDERS = 4
SWING, SWING_PERIOD = 0.15, 1.7  # of a board that swings, to each side [m], and there and back [s]


class SimWorld:
    """A world with a rig in it. The pipeline gets `rig`; tests and experiments also get `truth()`."""

    def __init__(self, config: RigConfig, clock: Clock | None = None) -> None:
        """Build and compile the world.

        Args:
            config: the rig.
            clock: what its time goes by; by default its own, which only moves when somebody waits.

        Raises:
            ConfigError: an unknown scene or target.
            DeviceError: the machine cannot render.
        """
        sim, effects = config.sim, config.sim.effects
        self.config = config
        self._clock = SimClock() if clock is None else clock
        self.targets = {name: self._make_target(name) for name in sim.targets}
        self._fixed_lens = self._lens(sim.fixed)
        self._zoom_lens = self._lens(sim.zoom)
        self.head_drive, self.lens_drive = head_drive(sim.head, effects), lens_drive(sim.zoom, effects)
        self._render_size = self._common_render_size()
        self._model = build_model(config, tuple(self.targets.values()), self._render_size)
        self._data = mujoco.MjData(self._model)
        self._T_world_fixed = mount_pose(self._model)
        self._boards: list[tuple[float, RigidTransform | None, bool]] = [(-math.inf, None, False)]
        self._renderer = make_renderer(self._model, *self._render_size)
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = effects.shadows
        # The lens obeys as late as the head does.
        delay = sim.head.command_delay_s if effects.command_delay else 0.0
        self._sensors = {
            "fixed": Sensor(sim.fixed, effects, (sim.seed, FIXED_NOISE)),
            "zoom": Sensor(sim.zoom, effects, (sim.seed, ZOOM_NOISE)),
        }
        self.rig = SimRig(
            SimStream(sim.fixed, effects, self._clock, partial(self.expose, "fixed")),
            SimZoomStream(sim.zoom, effects, self._clock, partial(self.expose, "zoom"), self.lens_drive, delay),
            SimPanTilt(sim.head, effects, self._clock, self.head_drive),
            self._clock,
            SimBoard(self._place_board),
            self.close,
        )

    def truth(self) -> Truth:
        """What is really so; for tests and experiments only."""
        return Truth(
            model=self._model,
            set_state=self._set_state,
            fixed_lens=self._fixed_lens,
            nominal_at=self.lens_drive.focal_at,
            zoom_lens_for=self.zoom_lens_for,
            T_world_fixed=self._T_world_fixed,
            T_world_base=base_pose(self._T_world_fixed, self.config.sim),
            head_at=self.head_drive.angles_at,
            focal_range=self.rig.zoom.focal_range,
            targets=self.targets,
        )

    def zoom_lens_at(self, t: float) -> TrueLens:
        """The zoom camera's true optics at a time up to now."""
        return self.zoom_lens_for(self.lens_drive.focal_at(t))

    def zoom_lens_for(self, nominal_px: float) -> TrueLens:
        """The zoom camera's true optics at what its device calls a focal length [px]."""
        factor = nominal_px / self.lens_drive.shortest_px
        if self.config.sim.effects.optics:
            optics = self.config.sim.zoom.optics_at(factor)
            distortion = optics.distortion if self.config.sim.effects.distortion else NO_DISTORTION
            return TrueLens(self._zoom_lens.size, optics.focal_px, optics.center_px, distortion, optics.pupil)
        fx, fy = self._zoom_lens.focal_px
        return replace(self._zoom_lens, focal_px=(fx * factor, fy * factor))

    def render(self, camera: str, lens: TrueLens, t: float) -> Image:
        """The perfect image that a lens sees at time t, without sensor effects, BGR."""
        cam_id = self._model.camera(RIG + camera).id
        self._model.cam_pos[cam_id] = (0.0, 0.0, lens.pupil)  # in the body's frame, whose z is the optical axis
        data = self._set_state(t)
        half_width, half_height = covering_half_field(lens)
        width, height = self._render_size
        focal = min((width / 2 - 1) / half_width, (height / 2 - 1) / half_height)
        self._model.cam_intrinsic[cam_id] = (focal * RENDER_PITCH, focal * RENDER_PITCH, 0.0, 0.0)
        option = mujoco.MjvOption()
        option.geomgroup[RIG_GROUP] = option.geomgroup[FRAME_GROUP] = 0
        option.geomgroup[BOARD_GROUP] = self._board_at(t) is not None
        option.sitegroup[:] = 0
        self._renderer.update_scene(data, cam_id, option)
        pinhole = self._renderer.render()[..., ::-1]
        return bend(np.ascontiguousarray(pinhole), focal, lens)

    def portrait(self, azimuth_deg: float, axes: bool) -> Portrait:
        """A picture of the rig as it is now, seen in a direction [degrees], with or without its frames' axes."""
        return portrait(self._model, self._set_state(self._clock.now()), azimuth_deg, axes)

    def close(self) -> None:
        """Release the renderer; more than once does no harm."""
        self._renderer.close()

    def _lens(self, camera: SimCamera) -> TrueLens:
        distortion = camera.distortion if self.config.sim.effects.distortion else NO_DISTORTION
        return TrueLens(camera.size, camera.focal_px, camera.center_px, distortion)

    def _make_target(self, name: str) -> Target:
        sim = self.config.sim
        rng = np.random.default_rng((sim.seed, TARGETS, zlib.crc32(name.encode())))  # whatever else is in the scene
        return make_target(name, sim.scene, rng, sim.effects.scatter, sim.paths.get(name))

    def _common_render_size(self) -> tuple[int, int]:
        """A size at which the render of either camera is as fine as its image, over all of its focal lengths."""
        drive, count = self.lens_drive, SIZED_FOCALS if self.config.sim.effects.optics else 1
        zooms = [self.zoom_lens_for(float(f)) for f in np.geomspace(drive.shortest_px, drive.longest_px, count)]
        sizes = [
            tuple(2 * half * focal + 2 for half, focal in zip(covering_half_field(lens), lens.focal_px, strict=True))
            for lens in (self._fixed_lens, *zooms)
        ]
        return math.ceil(max(s[0] for s in sizes)), math.ceil(max(s[1] for s in sizes))

    def expose(self, name: CameraName, index: int, t: float) -> Image:
        """Gather light around time t, up to now, then add the sensor's effects to frame number ``index``."""
        camera: SimCamera = self.config.sim.fixed if name == "fixed" else self.config.sim.zoom
        exposure = camera.exposure_s if self.config.sim.effects.blur else 0.0
        moments = t + exposure * ((np.arange(BLUR_RENDERS) + 0.5) / BLUR_RENDERS - 0.5) if exposure else [t]
        images = [
            self.render(name, self._fixed_lens if name == "fixed" else self.zoom_lens_at(moment), moment)
            for moment in moments
        ]
        light = images[0] if len(images) == 1 else np.rint(np.mean(images, axis=0)).astype(np.uint8)
        return self._sensors[name].expose(light, index)

    def _place_board(self, T_fixed_board: RigidTransform | None, swings: bool) -> None:
        self._boards.append((self._clock.now(), T_fixed_board, swings))

    def _board_at(self, t: float) -> RigidTransform | None:
        since, T, swings = next(placed for placed in reversed(self._boards) if placed[0] <= t)
        if T is None or not swings:
            return T
        return T * RigidTransform.from_translation([SWING * math.sin(2 * math.pi * (t - since) / SWING_PERIOD), 0, 0])

    def _set_state(self, t: float) -> "mujoco.MjData":
        """Everything's pose at time t."""
        data = self._data
        pan, tilt = self.head_drive.angles_at(t)
        data.joint(RIG + "pan").qpos[0], data.joint(RIG + "tilt").qpos[0] = pan, tilt
        for name, target in self.targets.items():
            pose = target.pose(t)
            self._set_mocap(f"{name}/{name}", pose.T_world_target)
            for joint, angle in pose.joints.items():
                data.joint(f"{name}/{joint}").qpos[0] = angle
        if (T_fixed_board := self._board_at(t)) is not None:
            self._set_mocap("board", self._T_world_fixed * T_fixed_board)
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_camlight(self._model, data)
        return data

    def _set_mocap(self, body: str, T_world_body: RigidTransform) -> None:
        index = self._model.body(body).mocapid[0]
        self._data.mocap_pos[index] = T_world_body.translation
        self._data.mocap_quat[index] = quaternion(T_world_body)
