"""What both cameras see at another size than that of their streams, rendered at that size and not scaled down to it.

For who wants many small pictures: the field of view is the streams', whatever the size's proportions. The effects of
the configuration hold: the blur of an exposure, the sensor's noise and JPEG.
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

NOISE = {"fixed": 6, "zoom": 7}  # streams of random numbers, apart from the world's others


class SizedPictures:
    """Renders both cameras of a world, for the thread that makes it."""

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
            model: the compiled world; of its settings, the size of what is drawn changes.
            state: brings it to a time.
            lens_at: a camera's true optics at a time, for its stream's size.
            lenses: all that there may be.
            size: (width, height) of the pictures [px].
            before: of another world, as large; they are over, and what they had open is used where that can be.

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
        """What a camera's frame of time t [s] shows, BGR, (height, width, 3)."""
        camera = self._cameras[name]
        exposure = camera.exposure_s if self._blurs else 0.0
        image = self._views.exposed(name, lambda when: _resized(self._lens_at(name, when), self._size), t, exposure)
        return self._sensors[name].expose(image, round(t * camera.rate_hz))

    def hand_over(self, model: "mujoco.MjModel") -> Canvas | None:
        """What draws, for another model; None where it cannot draw that. These are over then."""
        if self._views.canvas.turn_to(model):
            return self._views.canvas
        self.close()
        return None

    def close(self) -> None:
        """Release OpenGL; more than once does no harm."""
        self._views.close()


def _resized(lens: TrueLens, size: tuple[int, int]) -> TrueLens:
    """A lens with the same field of view and a picture of another size (width, height)."""
    across, down = (new / old for new, old in zip(size, lens.size, strict=True))
    (fx, fy), (cx, cy) = lens.focal_px, lens.center_px
    # Pixels are counted from the first one's centre: the picture begins half a pixel before.
    center = (cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5
    return TrueLens(size, (fx * across, fy * down), center, lens.distortion, lens.pupil)
