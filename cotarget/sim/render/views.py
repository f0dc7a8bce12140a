"""Images of the simulated lenses: renders of the world, resampled with the lens's distortion, with exposure blur.

A picture is rendered at the middle of the exposure; of a stationary camera's, only the tiles that differ from the last,
unless everything may differ. Where something moves in the world by more than a fraction of a pixel, a window is
rendered at four instants. If the camera turns or zooms, the image is the mean of what the lens makes of the picture at
each instant; the windows are then shifted by parts of a pixel and not multisampled, so that their mean is antialiased.
A picture of which too much moves is rendered at all four.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.geometry import Array
from cotarget.rig import Image
from cotarget.sim.model import BOARD_GROUP, RIG
from cotarget.sim.render.opengl import Canvas, mujoco
from cotarget.sim.render.optics import TURN_MARGIN, Pinhole, TrueLens, bend, covering_view
from cotarget.sim.state import WorldState

# A blurred image is the mean of these instants: parts of the exposure, from its middle.
SPREAD = (-0.375, -0.125, 0.125, 0.375)
# Motion below this during an exposure counts as rest [px].
SHARP_PX = 0.3
# Shifts of renders from the pixel's centre [px]: the rotated grid of multisampling.
JITTER = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))
SOFT_MARGIN_PX = 3  # margin of a render that is resampled half a pixel aside
WINDOW_MARGIN_PX = 4  # margin of a window around a moving geom
LARGEST_WINDOWS = 0.5  # largest part of the image that windows may cover; above it, all of it is rendered four times
NEAREST = 3.0  # least distance of any geom from a camera, which bounds the image motion of the camera's own shift [m]
TILES = 3  # parts of each side of a stationary camera's picture that may be kept from the last one
DRAWN, HIDDEN = 0, mujoco.mjNGROUP - 1  # groups of geoms in a render and out of it
PROBES = 3  # directions per side of the image that measure the camera's rotation


@dataclass(frozen=True)
class Window:
    """Rectangle in an image: top-left pixel and size [px]."""

    left: int
    top: int
    width: int
    height: int

    def of(self, image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Give this part of an image, which shares its memory."""
        return image[self.top : self.top + self.height, self.left : self.left + self.width]

    def meets(self, other: "Window") -> bool:
        """Check whether two windows overlap."""
        beside = other.left - self.width < self.left < other.left + other.width
        return beside and other.top - self.height < self.top < other.top + other.height


@dataclass(frozen=True)
class Moment:
    """Poses of the camera, of every geom and of the lights at one time.

    Attributes:
        t: the time [s].
        eye: the camera's optical centre in the world [m], (3,).
        axes: world coordinates of the camera's x (right), y (down) and z (forward) as columns, (3, 3).
        positions: positions of the geoms in the world [m], (n, 3).
        turns: rotation matrices of the geoms, (n, 3, 3).
        shown: whether each geom is shown, (n,).
        sight: the camera's pose and the lights; where it is the same, pictures differ only by geoms that have moved.
        view: the camera's pinhole view.
    """

    t: float
    eye: Array
    axes: Array
    positions: Array
    turns: Array
    shown: npt.NDArray[np.bool_]
    sight: bytes
    view: Pinhole

    def before(self, camera: "Moment") -> "Moment":
        """Give this moment's world before the camera of another moment."""
        return replace(self, eye=camera.eye, axes=camera.axes, sight=camera.sight, view=camera.view)

    def pixels(self, x_world: Array) -> Array:
        """Project points of the world (..., 3) into the view, (..., 2) [px]; nan behind the camera."""
        way = (x_world - self.eye) @ self.axes
        return (
            way[..., :2] / np.where(way[..., 2:] > 0, way[..., 2:], np.nan) * self.view.focal_px + self.view.center_px
        )

    def homography(self, other: "Moment") -> Array:
        """Map this view's pixels to those of another view that show the same direction, (3, 3)."""
        K, K_other = (np.diag([*view.focal_px, 1.0]) for view in (self.view, other.view))
        K[:2, 2], K_other[:2, 2] = self.view.center_px, other.view.center_px
        return K_other @ other.axes.T @ self.axes @ np.linalg.inv(K)


class Views:
    """Renderer of both cameras of a world; its ``canvas`` draws."""

    def __init__(
        self,
        model: "mujoco.MjModel",
        state: WorldState,
        size: tuple[int, int],
        shadows: bool,
        soft: bool = True,
    ) -> None:
        """Open OpenGL.

        Args:
            model: the compiled world.
            state: moves the world to a time.
            size: (width, height) of the largest render [px].
            shadows: whether lights cast shadows.
            soft: whether a lens without distortion is resampled like any other, and so gets the same softness.

        Raises:
            DeviceError: the machine cannot render.
        """
        self._model, self._state, self._size, self._soft = model, state, size, soft
        self.canvas = Canvas(model, size, shadows)
        corners = np.stack(np.meshgrid(*([-1, 1],) * 3), axis=-1).reshape(-1, 3)
        self._corners = model.geom_aabb[:, None, :3] + corners * model.geom_aabb[:, None, 3:]
        self._planes = model.geom_rbound == 0
        self._groups = np.array(model.geom_group)
        self._shown = self._groups < BOARD_GROUP
        self._crisp = ~np.isin(np.arange(model.ngeom), state.faint)
        # Without shadows, mirrors and skins, a geom changes the picture only where it is; clutter changes all of it.
        self._local = not (shadows or model.mat_reflectance.any() or model.nskin or model.nflex or len(state.faint))
        self._kept: dict[str, tuple[Moment, Image]] = {}

    def exposed(self, camera: str, lens_at: Callable[[float], TrueLens], t: float, exposure: float) -> Image:
        """Render a lens's image, BGR, around time t [s]: over an exposure [s], or at one instant if that is 0."""
        lens = lens_at(t)
        view = self._view(lens)

        def moment(part: float) -> Moment:
            now = lens_at(t + part * exposure)
            return self._moment(camera, now, t + part * exposure, _as_if(view, lens, now))

        middle = moment(0.0)
        if exposure == 0.0:
            return _bgr(bend(self._picture(camera, middle), view, lens))
        ends = moment(-0.5), moment(0.5)
        margin = max(_camera_moved(middle, end) for end in ends)
        moves = 2 * margin >= SHARP_PX
        fast = margin > min(TURN_MARGIN * view.size[0], (np.subtract(self._size, view.size).min() - 2) / 2)
        padded = replace(middle, view=_framed(view, math.ceil(margin))) if moves and not fast else middle
        windows = self._changed(ends[0].before(padded), ends[1].before(padded), SHARP_PX)
        if fast or sum(w.width * w.height for w in windows) > LARGEST_WINDOWS * math.prod(view.size):
            moves, windows = True, [Window(0, 0, *padded.view.size)]
            picture = np.empty((*padded.view.size[::-1], 4), dtype=np.uint8)
        else:
            picture = self._picture(camera, padded)
        if not (moves or windows):
            return _bgr(bend(picture, view, lens))
        total = np.zeros((*(lens.size if moves else view.size)[::-1], 4), dtype=np.float32)
        for instant, aside in zip(SPREAD, JITTER, strict=True):
            now = moment(instant)  # placing the bodies takes as long as drawing a small window
            seen = now if fast else now.before(padded)
            jittered = replace(seen, view=_framed(seen.view, aside=aside)) if moves and self.canvas.samples else seen
            for window in windows:
                patch = window.of(picture)
                patch[:] = self._render(camera, jittered, window, multisampled=not moves)
                if not moves:
                    cv2.accumulate(patch, window.of(total))
            if moves:
                cv2.accumulate(bend(picture, view, lens, now.homography(seen)), total)
        if moves:
            return _bgr(_mean(total))
        for window in windows:
            window.of(picture)[:] = _mean(window.of(total))
        return _bgr(bend(picture, view, lens))

    def _picture(self, camera: str, now: Moment) -> Image:
        """Render a view at one instant, BGRA; a tile without changes is the last picture's.

        A tile is rendered by itself, so that its pixels do not depend on what was rendered before.
        """
        if not self._local or self._model.body(RIG + camera).weldid[0]:  # where it turns, nothing is worth keeping
            return self._render(camera, now)
        (w, h), (last, image) = now.view.size, self._kept.pop(camera, (None, None))
        x, y = (np.linspace(0, n, TILES + 1).astype(int).tolist() for n in (w, h))
        windows = [Window(a, b, c - a, d - b) for a, c in pairwise(x) for b, d in pairwise(y)]
        if last is not None and (last.sight, last.view) == (now.sight, now.view):
            changed = self._changed(last, now, 0.0)
            windows = [each for each in windows if any(each.meets(other) for other in changed)]
        if image is None or image.shape[1::-1] != (w, h):
            image = np.empty((h, w, 4), dtype=np.uint8)
        for window in windows:
            window.of(image)[:] = self._render(camera, now, window)
        self._kept[camera] = now, image
        return image.copy()

    def _view(self, lens: TrueLens) -> Pinhole:
        """Choose the pinhole view that a lens's image is resampled from.

        With ``soft``, a lens without distortion gets a larger view, so that it is resampled too.
        """
        if not any(lens.distortion):
            (w, h), (cx, cy), margin = lens.size, lens.center_px, SOFT_MARGIN_PX * self._soft
            return Pinhole((w + margin, h + margin), lens.focal_px, (cx + margin / 2, cy + margin / 2))
        return covering_view(lens, self._size)

    def _render(self, camera: str, moment: Moment, window: Window | None = None, multisampled: bool = True) -> Image:
        """Render a view or a window of it, BGRA, which OpenCV resamples five times as fast as three channels."""
        data, view = self._state.lit(moment.t), moment.view
        window = window or Window(0, 0, *view.size)
        self._model.geom_group[:] = np.where(self._inside(moment, window), DRAWN, HIDDEN)
        try:
            self.canvas.look(data, self._model.camera(RIG + camera).id)
        finally:
            self._model.geom_group[:] = self._groups
        (fx, fy), (cx, cy) = view.focal_px, view.center_px
        left, top = window.left - 0.5 - cx, window.top - 0.5 - cy
        tangents = (left / fx, (left + window.width) / fx, -(top + window.height) / fy, -top / fy)
        size = (window.width, window.height)
        part = math.prod(size) / math.prod(view.size)
        image = self.canvas.draw(moment.eye, moment.axes, tangents, size, part, multisampled=multisampled)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2BGRA), dtype=np.uint8)

    def _moment(self, camera: str, lens: TrueLens, t: float, view: Pinhole) -> Moment:
        model, data = self._model, self._state.lit(t)
        body = model.body(RIG + camera).id
        axes = np.array(data.xmat[body].reshape(3, 3))
        eye = data.xpos[body] + axes[:, 2] * lens.pupil
        turns = np.array(data.geom_xmat.reshape(-1, 3, 3))
        shown = self._shown if self._state.board_at(t) is None else self._shown | (self._groups == BOARD_GROUP)
        sight = np.concatenate([eye[None], axes, model.light_diffuse, data.light_xpos, data.light_xdir]).tobytes()
        return Moment(t, eye, axes, np.array(data.geom_xpos), turns, shown, sight, view)

    def _inside(self, moment: Moment, window: Window) -> npt.NDArray[np.bool_]:
        """Select the shown geoms whose bounding sphere is partly inside a window, (n,)."""
        (fx, fy), (cx, cy) = moment.view.focal_px, moment.view.center_px
        x, y, z = ((moment.positions - moment.eye) @ moment.axes).T
        radius = np.where(self._planes, np.inf, self._model.geom_rbound)
        inside = moment.shown & (z >= -radius)
        # Signed distance to each side of the frustum, whose planes contain the optical centre.
        for along, f, c, first, count in (
            (x, fx, cx, window.left, window.width),
            (y, fy, cy, window.top, window.height),
        ):
            for sign, border in ((-1, first), (1, first + count)):
                tangent = (border - 0.5 - c) / f
                inside &= sign * (along - tangent * z) <= radius * np.hypot(1.0, tangent)
        return inside

    def _changed(self, before: Moment, after: Moment, least_px: float) -> list[Window]:
        """Find windows around the geoms that move by some pixels at least before one camera at rest."""
        whole = Window(0, 0, *before.view.size)
        moved = (before.positions != after.positions).any(axis=1) | (before.turns != after.turns).any(axis=(1, 2))
        moved |= before.shown != after.shown
        moved &= self._inside(before, whole) | self._inside(after, whole)
        if least_px > 0:
            moved &= self._crisp
        boxes = [each.positions[moved, None] + self._corners[moved] @ each.turns[moved].mT for each in (before, after)]
        seen = np.array([after.pixels(box) for box in boxes])
        if not np.isfinite(seen).all():
            return [whole]
        both = np.concatenate(list(seen), axis=1)[np.linalg.norm(seen[1] - seen[0], axis=-1).max(axis=1) >= least_px]
        size = np.array(before.view.size)
        low = np.floor(both.min(axis=1) - WINDOW_MARGIN_PX).clip(0, size)
        high = np.ceil(both.max(axis=1) + WINDOW_MARGIN_PX + 1).clip(0, size)
        disjoint = _merged([(a, b) for a, b in zip(low, high, strict=True) if (b > a).all()])
        return [Window(*map(int, (*a, *(b - a)))) for a, b in disjoint]


def _bgr(image: cv2.typing.MatLike) -> Image:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGRA2BGR), dtype=np.uint8)


def _mean(total: npt.NDArray[np.float32]) -> Image:
    return np.asarray(cv2.convertScaleAbs(total, alpha=1 / len(SPREAD)), dtype=np.uint8)


def _camera_moved(before: Moment, after: Moment) -> float:
    """Bound the image motion of static points between two moments [px]."""
    u, v = (np.linspace(-0.5, n - 0.5, PROBES) for n in before.view.size)
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    turned = float(np.linalg.norm(cv2.perspectiveTransform(pixels, before.homography(after)) - pixels, axis=-1).max())
    shifted = float(np.linalg.norm(after.eye - before.eye)) / NEAREST * max(before.view.focal_px)
    return turned + shifted


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


def _framed(view: Pinhole, margin: int = 0, aside: tuple[float, float] = (0.0, 0.0)) -> Pinhole:
    """Add a margin on all sides of a view, and shift its sampling points [px]."""
    (w, h), (cx, cy) = view.size, view.center_px
    center = cx + margin - aside[0], cy + margin - aside[1]
    return replace(view, size=(w + 2 * margin, h + 2 * margin), center_px=center)
