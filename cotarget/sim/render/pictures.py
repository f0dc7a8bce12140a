"""Pictures beside the cameras' streams: both cameras at another size, and the rig itself.

Pictures of another size are rendered at that size, for users of many small ones. Their field of view is that of the
streams, whatever the aspect ratio. The configured effects apply: exposure blur, sensor noise and JPEG.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cotarget.config import SimConfig
from cotarget.geometry import Array
from cotarget.rig import Image
from cotarget.sim.model import BOARD_GROUP, FRAME_GROUP, PORTRAIT_SIZE, RIG, RIG_GROUP
from cotarget.sim.render.opengl import make_renderer, mujoco
from cotarget.sim.render.optics import TrueLens, covering_size
from cotarget.sim.render.sensor import Sensor
from cotarget.sim.render.views import Views
from cotarget.sim.state import WorldState
from cotarget.sim.truth import CameraName

NOISE = {"fixed": 6, "zoom": 7}  # random streams, separate from the world's others


class SizedPictures:
    """Renderer of both cameras at one size; use it on the thread that makes it."""

    def __init__(
        self,
        sim: SimConfig,
        model: "mujoco.MjModel",
        state: WorldState,
        lens_at: Callable[[CameraName, float], TrueLens],
        lenses: Sequence[TrueLens],
        size: tuple[int, int],
    ) -> None:
        """Open OpenGL.

        Args:
            sim: the world's configuration.
            model: the compiled world; its offscreen buffer's size is changed.
            state: moves the world to a time.
            lens_at: gives a camera's true optics at a time, for its stream's size.
            lenses: all lenses that may occur.
            size: (width, height) of the pictures [px].

        Raises:
            DeviceError: the machine cannot render.
        """
        self._lens_at, self._size = lens_at, size
        self._cameras, self._blurs = {"fixed": sim.fixed, "zoom": sim.zoom}, sim.effects.blur
        largest = covering_size([_resized(lens, size) for lens in lenses], size)
        model.vis.global_.offwidth, model.vis.global_.offheight = largest
        self._views = Views(model, state, largest, sim.effects.shadows, soft=False)
        self._sensors = {
            name: Sensor(replace(camera, size=size), sim.effects, (sim.seed, NOISE[name]))
            for name, camera in self._cameras.items()
        }

    def take(self, name: CameraName, t: float) -> Image:
        """Render a camera's picture at time t [s], BGR, (height, width, 3)."""
        camera = self._cameras[name]
        exposure = camera.exposure_s if self._blurs else 0.0
        image = self._views.exposed(name, lambda when: _resized(self._lens_at(name, when), self._size), t, exposure)
        return self._sensors[name].expose(image, round(t * camera.rate_hz))

    def close(self) -> None:
        """Release OpenGL; safe to call more than once."""
        self._views.canvas.close()


def _resized(lens: TrueLens, size: tuple[int, int]) -> TrueLens:
    """Scale a lens to a picture of another size (width, height) with the same field of view."""
    across, down = (new / old for new, old in zip(size, lens.size, strict=True))
    (fx, fy), (cx, cy) = lens.focal_px, lens.center_px
    # The first pixel's centre is (0, 0), so that the image begins half a pixel before it.
    center = (cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5
    return TrueLens(size, (fx * across, fy * down), center, lens.distortion, lens.pupil)


# Pictures of the rig itself

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
