"""Both cameras rendered at another size than their streams, for users of many small pictures.

The field of view is that of the streams, whatever the aspect ratio. The configured effects apply: exposure blur, sensor
noise and JPEG. The pictures are rendered at the requested size and not scaled down to it.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

from cotarget.config import SimConfig
from cotarget.rig import Image
from cotarget.sim.render.opengl import Canvas, mujoco
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
        before: "SizedPictures | None" = None,
    ) -> None:
        """Open OpenGL.

        Args:
            sim: the world's configuration.
            model: the compiled world; its offscreen buffer's size is changed.
            state: moves the world to a time.
            lens_at: gives a camera's true optics at a time, for its stream's size.
            lenses: all lenses that may occur.
            size: (width, height) of the pictures [px].
            before: renderer of another world, with the same size. It ends, and its OpenGL context is used again where
                possible.

        Raises:
            DeviceError: the machine cannot render.
        """
        self._lens_at, self._size = lens_at, size
        self._cameras, self._blurs = {"fixed": sim.fixed, "zoom": sim.zoom}, sim.effects.blur
        largest = covering_size([_resized(lens, size) for lens in lenses], size)
        model.vis.global_.offwidth, model.vis.global_.offheight = largest
        canvas = None if before is None else before.hand_over(model)
        self._views = Views(model, state, largest, sim.effects.shadows, sim.effects.multisampling, canvas, soft=False)
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

    def hand_over(self, model: "mujoco.MjModel") -> Canvas | None:
        """Hand the canvas to another model, and end this renderer; None where the canvas cannot draw the model."""
        if self._views.canvas.turn_to(model):
            return self._views.canvas
        self.close()
        return None

    def close(self) -> None:
        """Release OpenGL; safe to call more than once."""
        self._views.close()


def _resized(lens: TrueLens, size: tuple[int, int]) -> TrueLens:
    """Scale a lens to a picture of another size (width, height) with the same field of view."""
    across, down = (new / old for new, old in zip(size, lens.size, strict=True))
    (fx, fy), (cx, cy) = lens.focal_px, lens.center_px
    # The first pixel's centre is (0, 0), so that the image begins half a pixel before it.
    center = (cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5
    return TrueLens(size, (fx * across, fy * down), center, lens.distortion, lens.pupil)
