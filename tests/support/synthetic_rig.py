"""A rig behind the Protocols that draws chessboards with numpy: for sessions without OpenGL, and for breaking.

Every pixel's ray meets the board's plane; the squares' edges are blurred over one pixel, so that corners are where
they should be to a few hundredths of a pixel.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from cotarget.config import BoardConfig
from cotarget.errors import StaleFrameError
from cotarget.geometry import RigidTransform
from cotarget.rig import Frame, PanTiltLimits, PanTiltState, ZoomState
from experiments.calibration.synthetic.rig import NOMINAL_PX, SIZE, Lens, Stop, Truth
from tests.support.rigs import alike, rig_of
from tests.support.simulated_clock import RigClock

PERIOD = 0.04
LATENCY = 0.05
BLACK, WHITE, WALL = 30.0, 220.0, 120.0
ZOOM_TIME = 0.4  # the lens takes this long to any focal length [s]
FOURFOLD = 4.0
# What a fourfold lens has gone through at its end, beyond being magnified: the true focal length over the nominal one,
# the axis [px], the share of the image's distortion that is gone, and the entrance pupil [m], backwards.
RATIO, AXIS_PX, STRAIGHTER, PUPIL = 0.02, (6.0, -4.0), 0.5, -0.04


def fourfold(nominal_px: float) -> Stop:
    """A zoom lens from 667 to 2668 px nominal; at its shortest focal length it is that of the default rig."""
    m = nominal_px / NOMINAL_PX
    s = np.log(m) / np.log(FOURFOLD)
    wide, bend = Truth().zoom, np.sin(np.pi / 2 * s)  # no polynomial, so that no interpolant has it exactly
    f = m * (1 + RATIO * bend)
    (k1, *_), share = wide.distortion, 1 - STRAIGHTER * bend
    lens = Lens(
        wide.fx * f, wide.fy * f, wide.cx + AXIS_PX[0] * bend, wide.cy + AXIS_PX[1] * s, (k1 * share * m**2, 0, 0, 0, 0)
    )
    return Stop(nominal_px, lens, PUPIL * bend)


def zoomed(truth: Truth, stop: Stop) -> Truth:
    """The rig at one stop of its zoom lens, as if it had no other: Gamma and T lead to where the pupil is."""
    to_pupil = RigidTransform.from_translation([0.0, 0.0, stop.pupil])
    return replace(truth, zoom=stop.lens, gamma=to_pupil.inv() * truth.gamma, hand=truth.hand * to_pupil, stops=())


def draw(lens: Lens, T_camera_board: np.ndarray, board: BoardConfig, rays: np.ndarray) -> np.ndarray:
    """The board before a grey wall, (H, W), float; T_camera_board as a 4x4 matrix."""
    image = np.full(SIZE[::-1], WALL)
    columns, rows = board.corners
    corners = np.array([[-2, -2], [columns + 1, -2], [columns + 1, rows + 1], [-2, rows + 1]], float) * board.square
    x = np.c_[corners, np.zeros(4)] @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
    if (x[:, 2] < 0.1).any() or T_camera_board[:3, 2] @ x.mean(axis=0) <= 0:
        return image
    # The pixels to look at: those around the outline, clipped to where the distortion is sane.
    sane = min(0.9, 2 * np.abs(rays[..., :2]).max())
    xy = np.clip(x[:, :2] / x[:, 2:], -sane, sane)
    px = lens.project(np.c_[xy, np.ones(4)])
    low = np.clip(np.floor(px.min(axis=0)) - 30, 0, SIZE).astype(int)
    high = np.clip(np.ceil(px.max(axis=0)) + 30, 0, SIZE).astype(int)
    if (high - low < 2).any():
        return image
    H = np.linalg.inv(T_camera_board[:3, [0, 1, 3]])
    q = rays[low[1] : high[1], low[0] : high[0]] @ H.T
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = q[..., :2] / q[..., 2:] / board.square

    def soft(coordinate, period_edges):
        gradient = np.hypot(*np.gradient(coordinate)) + 1e-12
        return period_edges(coordinate, gradient)

    def stripes(c, g):  # +1 on even squares, -1 on odd ones, linear over one pixel at each edge
        distance = np.abs(c - np.round(c))
        sign = np.where(np.floor(c).astype(int) % 2 == 0, 1.0, -1.0)
        return sign * np.clip(2 * distance / g, 0, 1)

    def inside(first, last):
        return lambda c, g: np.clip(0.5 + (c - first) / g, 0, 1) * np.clip(0.5 + (last - c) / g, 0, 1)

    pattern = soft(uv[..., 0], stripes) * soft(uv[..., 1], stripes)
    squares = (BLACK + WHITE) / 2 - (WHITE - BLACK) / 2 * pattern
    tiled = soft(uv[..., 0], inside(-1, columns)) * soft(uv[..., 1], inside(-1, rows))
    card = soft(uv[..., 0], inside(-1.5, columns + 0.5)) * soft(uv[..., 1], inside(-1.5, rows + 0.5))
    front = q[..., 2] > 0
    picture = WALL * (1 - card) + card * (WHITE * (1 - tiled) + tiled * squares)
    image[low[1] : high[1], low[0] : high[0]] = np.where(front, picture, WALL)
    return image


def pixel_rays(lens: Lens) -> np.ndarray:
    """Rays through all pixels, (H, W, 3)."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    px = np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(float)
    xy = cv2.undistortPoints(px, lens.K, np.array(lens.distortion)).reshape(*SIZE[::-1], 2)
    return np.concatenate([xy, np.ones((*SIZE[::-1], 1))], axis=-1)


@dataclass
class SyntheticRig:
    """The whole rig is one object: its cameras, head, clock and board are views of it.

    It zooms where it is given optics, the truth at each nominal focal length; the truth's own zoom lens is theirs at
    the shortest one.
    """

    stopped = None  # no safety layer stops it

    truth: Truth = field(default_factory=Truth)
    board_config: BoardConfig = field(default_factory=BoardConfig)
    seed: int = 0
    noise: float = 2.0
    frozen_camera: bool = False
    short_of: float = 0.0
    halts: int = 0
    optics: Callable[[float], Stop] | None = None
    reported: float = 1.0  # focal length that the lens reports, over its nominal one
    limits: PanTiltLimits = field(
        default_factory=lambda: alike(
            (np.radians(-159), np.radians(159)), (np.radians(-47), np.radians(31)), 2.6, 3.6, np.radians(0.0514286)
        )
    )

    def __post_init__(self):
        self.t = 0.0
        self.rng = np.random.default_rng(self.seed)
        self.rays = {"fixed": pixel_rays(self.truth.fixed), NOMINAL_PX: pixel_rays(self.truth.zoom)}
        self.pose, self.arrives = (0.0, 0.0), 0.0
        self.focal_px, self.lens_arrives = NOMINAL_PX, 0.0
        self.placed = [(-1.0, None)]
        self.frames = 0
        self.fixed, self.zoom = _Camera(self, "fixed"), _Zoom(self, "zoom")
        self.head, self.clock, self.board = _Head(self), RigClock(self), _Board(self)
        self.spec, self.config = rig_of(self).spec, None

    def image(self, camera, t):
        self.frames += 1
        T = next(T for since, T in reversed(self.placed) if since <= t)
        grey = np.full(SIZE[::-1], WALL)
        if T is not None:
            M, lens, rays = T.as_matrix(), self.truth.fixed, self.rays["fixed"]
            if camera == "zoom":
                assert t >= self.arrives, "a calibration image was taken while the head moved"
                assert t >= self.lens_arrives, "a calibration image was taken while the lens moved"
                pan, tilt = (0.0, 0.0) if self.frozen_camera else self.pose
                now = self.true_now()
                M, lens, rays = now.zoom_fixed(pan, tilt) @ M, now.zoom, self.rays[self.focal_px]
            grey = draw(lens, M, self.board_config, rays)
        noisy = grey + self.rng.normal(0, self.noise, grey.shape)
        return cv2.cvtColor(np.clip(np.round(noisy), 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)

    def true_now(self):
        """The truth at the focal length where the lens stands."""
        return self.truth if self.optics is None else zoomed(self.truth, self.optics(self.focal_px))

    def close(self):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


@dataclass
class _Camera:
    rig: SyntheticRig
    name: str
    size: tuple[int, int] = SIZE

    def read(self, newer_than=None, timeout=1.0):
        rig = self.rig
        index = np.floor((rig.t - LATENCY) / PERIOD)
        if newer_than is not None:
            index = max(index, np.floor(newer_than / PERIOD + 1e-9) + 1)
        arrival = index * PERIOD + LATENCY
        if arrival > rig.t + timeout:
            raise StaleFrameError("no frame in time")
        rig.t = max(rig.t, arrival)
        return Frame(rig.image(self.name, index * PERIOD), index * PERIOD)


class _Zoom(_Camera):
    @property
    def still_size(self):
        return self.size

    @property
    def focal_range(self):
        shortest = NOMINAL_PX * self.rig.reported
        return shortest, shortest * (1 if self.rig.optics is None else FOURFOLD)

    def zoom(self, focal_px):
        rig = self.rig
        wanted = float(np.clip(focal_px, *self.focal_range)) / rig.reported
        if wanted != rig.focal_px:
            rig.focal_px, rig.lens_arrives = wanted, rig.t + ZOOM_TIME
            if wanted not in rig.rays:
                rig.rays[wanted] = pixel_rays(rig.true_now().zoom)
        return wanted * rig.reported

    def state(self):
        return ZoomState(self.rig.focal_px * self.rig.reported, self.rig.t < self.rig.lens_arrives, self.rig.t)

    def capture(self):
        return self.read(self.rig.t)


@dataclass
class _Head:
    rig: SyntheticRig

    @property
    def limits(self):
        return self.rig.limits

    def state(self):
        rig = self.rig
        return PanTiltState(*rig.pose, moving=rig.t < rig.arrives, t=rig.t)

    def move(self, pan, tilt, speed=None, wait=False):
        rig = self.rig
        step = rig.limits.pan.step
        wanted = tuple(
            float(np.clip(np.round(q / step) * step, *limit))
            for q, limit in ((pan, rig.limits.pan.range), (tilt, rig.limits.tilt.range))
        )
        rig.arrives = rig.t + 0.3
        rig.pose = (wanted[0] * (1 - rig.short_of), wanted[1])
        if rig.halts:
            rig.pose, rig.halts = (wanted[0] / 2, wanted[1] / 2), rig.halts - 1
        if wait:
            rig.t = max(rig.t, rig.arrives)
        return wanted

    def halt(self):
        pass


@dataclass
class _Board:
    rig: SyntheticRig
    patience: float = 0.0

    def present(self, T_fixed_board: RigidTransform | None):
        self.rig.placed.append((self.rig.t, T_fixed_board))
