"""Simulated world: poses and images as functions of time, the rig's devices, and ground truth."""

import logging
from collections.abc import Collection
from contextlib import ExitStack
from dataclasses import replace
from functools import partial

import numpy as np

from cotarget.config import RigConfig, SimCamera, split_name
from cotarget.rig import Clock, Image, Rig
from cotarget.sim.devices import (
    SimBoard,
    SimClock,
    SimPanTilt,
    SimStream,
    SimZoomStream,
    head_drive,
    lens_drive,
    rig_spec,
)
from cotarget.sim.model import build_model, has_clutter, mount_pose
from cotarget.sim.render.optics import TrueLens, covering_size
from cotarget.sim.render.pictures import Portrait, SizedPictures, portrait
from cotarget.sim.render.sensor import Sensor
from cotarget.sim.render.views import Views
from cotarget.sim.state import WorldState
from cotarget.sim.targets.target import Target, make_target, target_rng
from cotarget.sim.truth import NO_DISTORTION, CameraName, Truth
from cotarget.sim.weather import Clutter
from cotarget.sim.zoom_lens import optics_at

CAMERAS: tuple[CameraName, ...] = ("fixed", "zoom")
# Random streams of the sensors' noise, so that the draws of one effect never shift those of another.
NOISE = {"fixed": 1, "zoom": 2}
# The render's size is computed from this many focal lengths of the zoom lens; its optics vary smoothly between them.
SIZED_FOCALS = 17
# Check of a given path: times at which it is looked for in the fixed camera's view, and the distance beyond which a
# target is less than a pixel [m].
PATH_SAMPLES, FARTHEST = 200, 1000.0

log = logging.getLogger(__name__)


class SimWorld:
    """Simulated world with a rig. The pipeline gets `rig`; tests and experiments also get `truth()`."""

    def __init__(
        self,
        config: RigConfig,
        clock: Clock | None = None,
        *,
        rendered: Collection[CameraName] = CAMERAS,
    ) -> None:
        """Build and compile the world.

        Args:
            config: the rig's configuration.
            clock: source of time; by default a simulated clock, which only blocking calls advance.
            rendered: cameras whose frames are rendered; the frames of others are black. Times, latencies, head, lens
                and truth do not change. With none, no OpenGL is needed.

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
        width, height = np.max([sim.fixed.size, sim.zoom.size], axis=0).tolist()
        self._render_size = covering_size(self._lenses(), (width, height))
        self._model = build_model(config, tuple(self.targets.values()), self._render_size)
        self._T_world_fixed = mount_pose(self._model)
        clutter = Clutter(self._model, sim.seed) if has_clutter(sim) else None
        self._state = WorldState(self._model, self.targets, self.head_drive, self._T_world_fixed, clutter)
        self._rendered = frozenset(rendered)
        self._opened: Views | None = None
        if self._rendered:
            self._views()
        self._black = {name: np.zeros((*self._camera(name).size[::-1], 3), dtype=np.uint8) for name in CAMERAS}
        self._sensors = {name: Sensor(self._camera(name), effects, (sim.seed, NOISE[name])) for name in self._rendered}
        spec = rig_spec(config)
        fixed = SimStream(sim.fixed, effects, self._clock, partial(self.expose, "fixed"))
        zoom = SimZoomStream(
            sim.zoom, effects, self._clock, partial(self.expose, "zoom"), self.lens_drive, spec.zoom.delay_s
        )
        head = SimPanTilt(spec.head, self._clock, self.head_drive)
        board = SimBoard(lambda T, swings: self._state.place_board(self._clock.now(), T, swings))
        self._of_world = (fixed, zoom, board)
        self._release = ExitStack()
        self._release.callback(self.close)
        self._release.callback(head.halt)
        self.rig = Rig(fixed, zoom, head, self._clock, board, spec, self._release.close, config)
        self._warn_of_unseen_paths()

    def truth(self) -> Truth:
        """Give the ground truth, for tests and experiments only."""
        return Truth(
            model=self._model,
            set_state=self._state.at,
            set_bodies=self._state.bodies_at,
            fixed_lens=self._fixed_lens,
            nominal_at=self.lens_drive.focal_at,
            zoom_lens_for=self.zoom_lens_for,
            T_world_fixed=self._T_world_fixed,
            head_at=self.head_drive.angles_at,
            focal_range=self.rig.zoom.focal_range,
            targets=self.targets,
        )

    def zoom_lens_for(self, nominal_px: float) -> TrueLens:
        """Give the zoom camera's true optics at a nominal focal length [px]."""
        factor = nominal_px / self.lens_drive.shortest_px
        if self.config.sim.effects.optics:
            optics = optics_at(self.config.sim.zoom, factor)
            distortion = optics.distortion if self.config.sim.effects.distortion else NO_DISTORTION
            return TrueLens(self._zoom_lens.size, optics.focal_px, optics.center_px, distortion, optics.pupil)
        fx, fy = self._zoom_lens.focal_px
        return replace(self._zoom_lens, focal_px=(fx * factor, fy * factor))

    def render(self, camera: str, lens: TrueLens, t: float) -> Image:
        """Render the image of a lens at time t [s] without sensor effects, BGR."""
        return self._views().exposed(camera, lambda _: lens, t, exposure=0.0)

    def pictures(self, size: tuple[int, int]) -> SizedPictures:
        """Open a renderer of both cameras at another size; the caller closes it.

        Args:
            size: (width, height) of each picture [px].
        """
        return SizedPictures(self.config.sim, self._model, self._state, self._lens_at, self._lenses(), size)

    def portrait(self, azimuth_deg: float, axes: bool) -> Portrait:
        """Render the rig itself as it is now.

        Args:
            azimuth_deg: direction of view [degrees].
            axes: whether the axes of the rig's frames are drawn.
        """
        return portrait(self._model, self._state.lit(self._clock.now()), azimuth_deg, axes)

    def close(self) -> None:
        """Release the renderers and the rig's access to the world; safe to call more than once."""
        if self._opened is not None:
            self._opened.canvas.close()
        # Breaks reference cycles that would keep the model's memory until a garbage collection.
        for device in self._of_world:
            device.leave()
        self._release.pop_all()

    def _views(self) -> Views:
        """Give the renderer of both cameras, opened on first use."""
        if self._opened is None:
            self._opened = Views(self._model, self._state, self._render_size, self.config.sim.effects.shadows)
        return self._opened

    def _camera(self, name: CameraName) -> SimCamera:
        return self.config.sim.fixed if name == "fixed" else self.config.sim.zoom

    def _lens(self, camera: SimCamera) -> TrueLens:
        distortion = camera.distortion if self.config.sim.effects.distortion else NO_DISTORTION
        return TrueLens(camera.size, camera.focal_px, camera.center_px, distortion)

    def _make_target(self, name: str) -> Target:
        sim = self.config.sim
        rng = target_rng(sim.seed, name)
        own = sim.models.get(split_name(name)[0])
        return make_target(name, sim.scene, rng, sim.effects.scatter, sim.paths.get(name), own)

    def _lenses(self) -> list[TrueLens]:
        """Give the true lenses of both cameras, over all focal lengths."""
        drive, count = self.lens_drive, SIZED_FOCALS if self.config.sim.effects.optics else 1
        zooms = [self.zoom_lens_for(float(f)) for f in np.geomspace(drive.shortest_px, drive.longest_px, count)]
        return [self._fixed_lens, *zooms]

    def _lens_at(self, name: CameraName, t: float) -> TrueLens:
        return self.zoom_lens_for(self.lens_drive.focal_at(t)) if name == "zoom" else self._fixed_lens

    def expose(self, name: CameraName, index: int, t: float) -> Image:
        """Render the exposure around time t [s], up to now, and add the sensor's effects of frame number ``index``."""
        if name not in self._rendered:
            return self._black[name]
        exposure = self._camera(name).exposure_s if self.config.sim.effects.blur else 0.0
        seen = self._views().exposed(name, partial(self._lens_at, name), t, exposure)
        return self._sensors[name].expose(seen, index)

    def _warn_of_unseen_paths(self) -> None:
        """Say which given paths never lead through the fixed camera's view, as those in millimetres do not."""
        size = np.array(self._fixed_lens.size)
        for name in (each for each in self.targets if each in self.config.sim.paths):
            spline = self.targets[name].path.spline
            x_fixed = self._T_world_fixed.inv().apply(spline(np.linspace(spline.x[0], spline.x[-1], PATH_SAMPLES)))
            pixels = self._fixed_lens.project(x_fixed)
            inside = ((pixels >= -0.5) & (pixels <= size - 0.5)).all(axis=1)  # nan is not
            if not (inside & (x_fixed[:, 2] <= FARTHEST)).any():
                log.warning(
                    "sim.paths.%s: is never in the fixed camera's view up to %g m away; a path is [[t, x, y, z], ...] "
                    "in seconds and metres, in the scene's world",
                    name,
                    FARTHEST,
                )
