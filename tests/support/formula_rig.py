"""A rig of a few lines: a target that is a formula, a detector that reads it, a head with real dynamics."""

import itertools
import math
from dataclasses import dataclass, field, replace

import numpy as np

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import DEFAULT_TARGETS
from cotarget.detection import Detections
from cotarget.errors import StaleFrameError
from cotarget.pipeline import FollowSettings, follow
from cotarget.rig import Detection, Frame, PanTiltLimits, PanTiltState, ZoomState
from cotarget.rig_geometry import FixedCamera, ZoomHead
from cotarget.sim.motion import Axis
from experiments.calibration.synthetic.rig import SIZE, Lens, Truth
from tests.support.rigs import alike, rig_of
from tests.support.simulated_clock import RigClock

RATE_HZ = 24.0  # neither 0.4 s nor 0.8 s is a whole number of frames
FRAME_S = 1 / RATE_HZ
LATENCY = 0.06
DELAY = 0.04
STEP = math.radians(0.0514286)
BOOK = replace(DEFAULT_TARGETS["book"], template=None)
FIXED = Lens(686.0, 684.0, 325.0, 239.0)
TRUTH = Truth(fixed=FIXED, zoom=Lens(692.0, 693.0, 326.0, 235.0), dz=0.0, eps=0.0)
CALIBRATION = Calibration(
    fixed=FixedCamera(Intrinsics(SIZE, (686.0, 684.0), (325.0, 239.0))),
    zoom_head=ZoomHead(
        ZoomLens((667.0,), (Intrinsics(SIZE, (692.0, 693.0), (326.0, 235.0)),)), TRUTH.gamma, TRUTH.hand
    ),
)
WIDE = alike((-2.7, 2.7), (-0.8, 0.5), math.radians(149), math.radians(206), STEP)
PICTURES = [np.full((SIZE[1], SIZE[0], 3), level, np.uint8) for level in (0, 1)]  # those of a live camera differ


@dataclass
class FormulaRig:
    """All devices are views of one object whose time moves only when somebody waits for a frame."""

    limits: PanTiltLimits = WIDE
    dropped: tuple[float, float] = (math.inf, math.inf)  # no frames between these times
    t: float = 0.0
    delay_s: float = DELAY
    focal_range: tuple[float, float] = (667.0, 8000.0)
    lens_speed: float = math.inf  # of the logarithm of the focal length [1/s]
    moves: list = field(default_factory=list)  # time, pan, tilt and speed of each command
    zooms: list = field(default_factory=list)  # time and focal length of each command

    def __post_init__(self):
        self.pan, self.tilt = (Axis(self.limits.pan.speed, self.limits.pan.acceleration) for _ in range(2))
        self.focal = self.focal_before = self.focal_range[0]
        self.fixed, self.zoom, self.head, self.clock = _Camera(self), _Zoom(self), _Head(self), RigClock(self)

    def pose(self, t):
        return self.pan.motor(t)[0], self.tilt.motor(t)[0]

    def lens(self, t):
        """Focal length at a time, on its way to the commanded one."""
        if math.isinf(self.lens_speed):
            return self.focal
        way, most = math.log(self.focal / self.focal_before), self.lens_speed * (t - self.zooms[-1][0])
        return self.focal_before * math.exp(math.copysign(min(abs(way), most), way))


@dataclass
class _Camera:
    rig: FormulaRig
    size: tuple[int, int] = SIZE

    def read(self, newer_than=None, timeout=1.0):
        rig = self.rig
        index = max(math.floor((rig.t - LATENCY) * RATE_HZ + 1e-6), 0)
        if newer_than is not None:
            index = max(index, math.floor(newer_than * RATE_HZ + 1e-6) + 1)
            while rig.dropped[0] <= index / RATE_HZ < rig.dropped[1]:
                index += 1
                if index / RATE_HZ - newer_than > timeout:
                    raise StaleFrameError("no new frame")
        rig.t = max(rig.t, index / RATE_HZ + LATENCY)
        return Frame(PICTURES[index % 2], index / RATE_HZ)


@dataclass
class _Zoom(_Camera):
    @property
    def focal_range(self):
        return self.rig.focal_range

    def zoom(self, focal_px):
        if self.rig.zooms:
            self.rig.focal_before = self.rig.lens(self.rig.t)
        self.rig.zooms.append((self.rig.t, focal_px))
        self.rig.focal = focal_px
        return focal_px

    def state(self):
        return ZoomState(self.rig.lens(self.rig.t), False, self.rig.t)


@dataclass
class _Head:
    rig: FormulaRig

    @property
    def limits(self):
        return self.rig.limits

    def state(self):
        moving = any(axis.motor(self.rig.t)[1] != 0 for axis in (self.rig.pan, self.rig.tilt))
        return PanTiltState(*self.rig.pose(self.rig.t), moving, self.rig.t)

    def move(self, pan, tilt, speed=None, wait=False):
        rig, step = self.rig, self.rig.limits.pan.step
        rounded = (round(q / step) * step if step else q for q in (pan, tilt))
        ranges = [axis.range for axis in rig.limits.axes]
        goal = [min(max(q, low), high) for q, (low, high) in zip(rounded, ranges, strict=True)]
        for axis, q, fastest in zip((rig.pan, rig.tilt), goal, rig.limits.capped(speed), strict=True):
            axis.command(rig.t + rig.delay_s, q, fastest)
        rig.moves.append((rig.t, *goal, speed))
        return tuple(goal)


class Seer:
    """Detects the book where it is, at the frame's own time, whenever ``visible`` says so."""

    mask = None  # that of every frame

    def __init__(self, path, visible=lambda t: True, jitter=0.0):
        self.path, self.visible = path, visible
        self.jitter = itertools.cycle([1 + jitter, 1 - jitter])

    def detect(self, frame, held=()):
        if not self.visible(frame.t):
            return Detections([], lambda: self.mask)
        x_fixed = np.asarray(self.path(frame.t), float)
        size = 686 * 0.234 / x_fixed[2] * next(self.jitter)
        return Detections([Detection(FIXED.project(x_fixed)[0], np.array([size, 1.4 * size]), 1.0)], lambda: self.mask)


class Both:
    """Detects what each of several detectors does."""

    def __init__(self, *seers):
        self.seers = seers

    def detect(self, frame, held=()):
        return Detections([found for seer in self.seers for found in seer.detect(frame).boxes])


def still(t):
    return (1.5, 0.4, 10.0)


def crossing(t):
    """Past the rig at 10 m, at 2 m/s: some 11 degrees/s."""
    return (-3.0 + 2.0 * t, 0.3, 10.0)


def off(rig, path, t):
    """Angle between where the zoom camera looks and the target at time t [rad]."""
    x = TRUTH.in_zoom(np.array([path(t)], float), *rig.pose(t))[0]
    zoomed = rig.focal / 667.0
    middle = np.array([(319.5 - 326) / (692 * zoomed), (239.5 - 235) / (693 * zoomed), 1.0])
    return float(np.arctan2(np.linalg.norm(np.cross(middle, x)), middle @ x))


def run(rig, seer, seconds, selector=None, **settings):
    """Follow the book; the Steps."""
    settings = FollowSettings(**settings)
    return list(follow(rig_of(rig), CALIBRATION, BOOK, seer, selector=selector, seconds=seconds, settings=settings))


def spans(steps):
    """States in turn, each with the time of its first frame."""
    return [(state, next(group).fixed.t) for state, group in itertools.groupby(steps, key=lambda s: s.state)]
