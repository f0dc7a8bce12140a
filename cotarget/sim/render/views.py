"""Images of the simulated lenses: renders of the world, resampled with the lens's distortion, with exposure blur.

An exposure is the mean of four renders, but only where something moves by more than a fraction of a pixel during it. If
the camera turns or zooms, that is the whole image: four renders without multisampling, shifted by parts of a pixel, so
that their mean is antialiased. If only a target moves, it is a window around the target. At rest it is one render.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.geometry import Array
from cotarget.rig import Image
from cotarget.sim.model import BOARD_GROUP, RIG
from cotarget.sim.render.opengl import Canvas, mujoco
from cotarget.sim.render.optics import Pinhole, TrueLens, bend, covering_view
from cotarget.sim.state import WorldState

# A blurred image is the mean of this many renders, spread over the exposure.
BLUR_RENDERS = 4
# Motion below this during an exposure counts as rest [px].
SHARP_PX = 0.3
# Shifts of these renders from the pixel's centre [px]: the rotated grid of multisampling.
JITTER = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))
SOFT_MARGIN_PX = 3  # margin of a render that is resampled half a pixel aside
WINDOW_MARGIN_PX = 4  # margin of a window around a moving geom
LARGEST_WINDOWS = 0.3  # largest part of the image that windows may cover; above it, all of it is rendered four times
NEAREST = 3.0  # least distance of any geom from a camera, which bounds the image motion of the camera's own shift [m]
LAYERS = mujoco.mjNGROUP - 1  # groups of geoms, drawn from the nearest to the farthest; the last group is not drawn
PROBES = 3  # directions per side of the image that measure the camera's rotation


@dataclass(frozen=True)
class Window:
    """Rectangle in an image: top-left pixel and size [px]."""

    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True)
class Moment:
    """Poses of the camera and of every geom at one time.

    Attributes:
        eye: the camera's optical centre in the world [m], (3,).
        axes: world coordinates of the camera's x (right), y (down) and z (forward) as columns, (3, 3).
        positions: positions of the geoms in the world [m], (n, 3).
        turns: rotation matrices of the geoms, (n, 3, 3).
        view: the camera's pinhole view.
    """

    eye: Array
    axes: Array
    positions: Array
    turns: Array
    view: Pinhole

    def pixels(self, x_world: Array) -> Array:
        """Project points of the world (..., 3) into the view, (..., 2) [px]; nan behind the camera."""
        return self.toward(x_world - self.eye)

    def toward(self, way_world: Array) -> Array:
        """Project directions in the world (..., 3) into the view, (..., 2) [px]; nan behind the camera."""
        way = way_world @ self.axes
        depth = np.where(way[..., 2:] > 0, way[..., 2:], np.nan)
        return way[..., :2] / depth * self.view.focal_px + self.view.center_px


class Views:
    """Renderer of both cameras of a world; its ``canvas`` draws."""

    def __init__(
        self,
        model: "mujoco.MjModel",
        state: WorldState,
        size: tuple[int, int],
        shadows: bool,
        multisampling: bool,
        canvas: Canvas | None = None,
        soft: bool = True,
    ) -> None:
        """Open OpenGL.

        Args:
            model: the compiled world.
            state: moves the world to a time.
            size: (width, height) of the largest render [px].
            shadows: whether lights cast shadows.
            multisampling: whether a single render is antialiased.
            canvas: canvas that draws this model; opened here by default.
            soft: whether a lens without distortion is resampled like any other, and so gets the same softness.

        Raises:
            DeviceError: the machine cannot render.
        """
        self._model, self._state, self._size, self._shadows = model, state, size, shadows
        self.canvas = canvas or Canvas(model, size, shadows)
        self._multisampling, self._soft = multisampling, soft
        corners = np.stack(np.meshgrid(*([-1, 1],) * 3), axis=-1).reshape(-1, 3)
        self._corners = model.geom_aabb[:, None, :3] + corners * model.geom_aabb[:, None, 3:]
        self._endless = model.geom_rbound == 0  # planes
        self._groups = np.array(model.geom_group)
        self._shown = self._groups < BOARD_GROUP
        self._blurs = self._shown & ~np.isin(np.arange(model.ngeom), state.faint)

    def close(self) -> None:
        """Release OpenGL; safe to call more than once."""
        self.canvas.close()

    def sharp(self, camera: str, lens: TrueLens, t: float) -> Image:
        """Render a lens's image at one instant, BGR."""
        view = self._view(lens)
        return self._through(lens, view, self._render(camera, lens, view, t))

    def exposed(self, camera: str, lens_at: Callable[[float], TrueLens], t: float, exposure: float) -> Image:
        """Render a lens's image over an exposure, BGR.

        Args:
            camera: the camera's name.
            lens_at: gives the lens's optics at a time [s].
            t: middle of the exposure [s].
            exposure: length of the exposure [s].
        """
        lens = lens_at(t)
        if exposure == 0.0:
            return self.sharp(camera, lens, t)
        view = self._view(lens)
        times = (t - exposure / 2, t + exposure / 2)
        ends = [self._moment(camera, now, when, _as_if(view, lens, now)) for when in times for now in [lens_at(when)]]
        moments = (t + exposure * ((np.arange(BLUR_RENDERS) + 0.5) / BLUR_RENDERS - 0.5)).tolist()
        windows = self._moving(ends, t) if _camera_moved(*ends) < SHARP_PX else None
        if windows is None:
            jitters = JITTER if self._multisampling else ((0.0, 0.0),) * BLUR_RENDERS
            total = np.zeros((*view.size[::-1], 3), dtype=np.float32)
            for moment, jitter in zip(moments, jitters, strict=True):
                now = lens_at(moment)
                aside = _shifted(_as_if(view, lens, now), jitter)
                cv2.accumulate(self._render(camera, now, aside, moment, plain=True), total)
            return self._through(lens, view, cv2.convertScaleAbs(total, alpha=1 / BLUR_RENDERS))
        image = np.ascontiguousarray(self._render(camera, lens, view, t))
        parts = [np.zeros((window.height, window.width, 3), dtype=np.float32) for window in windows]
        for moment in moments:  # placing the bodies takes as long as drawing a small window
            for window, part in zip(windows, parts, strict=True):
                cv2.accumulate(self._render(camera, lens, view, moment, window), part)
        for window, part in zip(windows, parts, strict=True):
            rows, columns = window.top + np.arange(2) * window.height, window.left + np.arange(2) * window.width
            image[slice(*rows), slice(*columns)] = cv2.convertScaleAbs(part, alpha=1 / BLUR_RENDERS)
        return self._through(lens, view, image)

    def _view(self, lens: TrueLens) -> Pinhole:
        """Choose the pinhole view that a lens's image is resampled from.

        With ``soft``, a lens without distortion gets a larger view, so that it is resampled too.
        """
        if not any(lens.distortion):
            (w, h), (cx, cy), margin = lens.size, lens.center_px, SOFT_MARGIN_PX * self._soft
            return Pinhole((w + margin, h + margin), lens.focal_px, (cx + margin / 2, cy + margin / 2))
        return covering_view(lens, self._size)

    def _through(self, lens: TrueLens, view: Pinhole, image: Image) -> Image:
        """Resample a render, RGB, into a lens's image, BGR."""
        if view != Pinhole(lens.size, lens.focal_px, lens.center_px):
            image = bend(np.ascontiguousarray(image), view, lens)
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR), dtype=np.uint8)

    def _render(
        self, camera: str, lens: TrueLens, view: Pinhole, t: float, window: Window | None = None, plain: bool = False
    ) -> Image:
        """Render a view, or a window of it, RGB."""
        moment = self._moment(camera, lens, t, view)
        data = self._state.lit(t)
        shown = window or Window(0, 0, *view.size)
        self._model.geom_group[:] = self._layers(moment, shown, self._visible(t))
        try:
            self.canvas.look(data, self._model.camera(RIG + camera).id, LAYERS)
        finally:
            self._model.geom_group[:] = self._groups
        (fx, fy), (cx, cy) = view.focal_px, view.center_px
        left, top = shown.left - 0.5 - cx, shown.top - 0.5 - cy
        tangents = (left / fx, (left + shown.width) / fx, -(top + shown.height) / fy, -top / fy)
        size = (shown.width, shown.height)
        part = math.prod(size) / math.prod(view.size)
        return self.canvas.draw(moment.eye, moment.axes, tangents, size, part, multisampled=not plain)

    def _moment(self, camera: str, lens: TrueLens, t: float, view: Pinhole) -> Moment:
        data = self._state.at(t)
        body = self._model.body(RIG + camera).id
        axes = np.array(data.xmat[body].reshape(3, 3))
        eye = data.xpos[body] + axes[:, 2] * lens.pupil
        turns = np.array(data.geom_xmat.reshape(-1, 3, 3))
        return Moment(eye, axes, np.array(data.geom_xpos), turns, view)

    def _visible(self, t: float) -> npt.NDArray[np.bool_]:
        """Select the geoms that are shown, (n,) bool; the board's only while there is a board."""
        return self._shown if self._state.board_at(t) is None else self._shown | (self._groups == BOARD_GROUP)

    def _layers(self, moment: Moment, window: Window, visible: npt.NDArray[np.bool_]) -> npt.NDArray[np.intp]:
        """Assign each geom its drawing layer, (n,) int, the nearest first, so that occluded pixels are not shaded.

        A geom whose bounding sphere is outside the window is left out.
        """
        (fx, fy), (cx, cy) = moment.view.focal_px, moment.view.center_px
        x, y, z = ((moment.positions - moment.eye) @ moment.axes).T
        radius = np.where(self._endless, np.inf, self._model.geom_rbound)
        inside = visible & (z >= -radius)
        # Signed distance to each side of the frustum, whose planes contain the optical centre.
        for along, tangent, sign in (
            (x, (window.left - 0.5 - cx) / fx, -1),
            (x, (window.left + window.width - 0.5 - cx) / fx, 1),
            (y, (window.top - 0.5 - cy) / fy, -1),
            (y, (window.top + window.height - 0.5 - cy) / fy, 1),
        ):
            inside &= sign * (along - tangent * z) <= radius * np.hypot(1.0, tangent)
        drawn = np.flatnonzero(inside)
        layers = np.full(len(z), LAYERS)
        layers[drawn[np.argsort((z + radius)[drawn])]] = np.arange(len(drawn)) * LAYERS // max(len(drawn), 1)
        return layers

    def _moving(self, ends: list[Moment], t: float) -> list[Window] | None:
        """Find windows around geoms that move during an exposure of a camera at rest; None if too large."""
        before, after = ends
        moved = (before.positions != after.positions).any(axis=1) | (before.turns != after.turns).any(axis=(1, 2))
        moved &= self._blurs | ((self._groups == BOARD_GROUP) & self._visible(t))
        if not moved.any():
            return []
        seen = [
            end.pixels(end.positions[moved, None] + np.einsum("gij,gkj->gki", end.turns[moved], self._corners[moved]))
            for end in ends
        ]
        far = np.linalg.norm(seen[1] - seen[0], axis=-1).max(axis=1)
        if not np.isfinite(far).all():
            return None
        both = np.concatenate(seen, axis=1)[far >= SHARP_PX]
        size = np.array(before.view.size)
        low = np.floor(both.min(axis=1) - WINDOW_MARGIN_PX).clip(0, size)
        high = np.ceil(both.max(axis=1) + WINDOW_MARGIN_PX + 1).clip(0, size)
        boxes = _merged([(a, b) for a, b in zip(low, high, strict=True) if (b > a).all()])
        if sum(float(np.prod(b - a)) for a, b in boxes) > LARGEST_WINDOWS * float(np.prod(size)):
            return None
        return [Window(*map(int, (*a, *(b - a)))) for a, b in boxes]


def _camera_moved(before: Moment, after: Moment) -> float:
    """Bound the image motion of static points between two moments [px]."""
    u, v = (np.linspace(-0.5, n - 0.5, PROBES) for n in before.view.size)
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays = np.append((pixels - before.view.center_px) / before.view.focal_px, np.ones((len(pixels), 1)), axis=1)
    turned = float(np.linalg.norm(after.toward(rays @ before.axes.T) - pixels, axis=1).max())
    shifted = float(np.linalg.norm(after.eye - before.eye)) / NEAREST * max(before.view.focal_px)
    return turned + shifted if np.isfinite(turned) else np.inf


def _merged(boxes: list[tuple[Array, Array]]) -> list[tuple[Array, Array]]:
    """Merge overlapping boxes into disjoint ones that cover the same area."""
    found: list[tuple[Array, Array]] = []
    for low, high in boxes:
        while hit := next((b for b in found if (b[0] < high).all() and (low < b[1]).all()), None):
            found = [b for b in found if b is not hit]
            low, high = np.minimum(low, hit[0]), np.maximum(high, hit[1])
        found.append((low, high))
    return found


def _as_if(view: Pinhole, lens: TrueLens, now: TrueLens) -> Pinhole:
    """Give the view that, resampled as for ``lens``, shows the image of the lens ``now``.

    Focal length and principal point of a zoom lens change while it travels during an exposure. The change of its
    distortion is neglected: at most 0.3 px in the corners, at 129 positions a second and 1/100 s, where zooming moves
    them by 5 px.
    """
    if now is lens or now == lens:
        return view
    gain = np.divide(now.focal_px, lens.focal_px)
    aside = np.subtract(now.center_px, lens.center_px) * np.divide(view.focal_px, lens.focal_px)
    (fx, fy), (cx, cy) = (gain * view.focal_px).tolist(), (aside + view.center_px).tolist()
    return replace(view, focal_px=(fx, fy), center_px=(cx, cy))


def _shifted(view: Pinhole, by_px: tuple[float, float]) -> Pinhole:
    """Shift the sampling points of a view by a part of a pixel."""
    return replace(view, center_px=(view.center_px[0] - by_px[0], view.center_px[1] - by_px[1]))
