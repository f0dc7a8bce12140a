"""A dome in simulated time that looks at a textured sphere, and says of itself what it likes."""

import functools
import math
from dataclasses import dataclass

import cv2
import numpy as np

from cotarget.drivers.axes import AxisFacts
from cotarget.drivers.velocity import SteeredAxis
from cotarget.rig import Frame, PanTiltState, ZoomState
from cotarget.sim.motion import Axis
from tests.support.rigs import alike
from tests.support.simulated_clock import RigClock

SIZE, WIDE_PX, LONGEST = (320, 240), 300.0, 5.0
TEXTURE = (4096, 2048)  # of the whole sphere
LATENCY_S = 0.15  # from light to arrival; the rig's spec says less
RATE_HZ = 12.5
SWING_S = 1.2  # period
FIRST_STEP, PAUSE_S = 0.8, 0.9  # part of a way, and the time until the rest of it
STEERED_S = 0.04  # between its positions, by which it is steered
DEGREES = AxisFacts(
    unit=math.radians(1), lowest=-170, highest=170, fastest=100, step=0.0, slack=0.1, loses_steps=False
)  # fmt: skip


@functools.cache
def texture(seed):
    """A sphere's picture with structure of all sizes, (H, W)."""
    random = np.random.default_rng(seed)
    width, height = TEXTURE
    levels = np.zeros((height, width), np.float32)
    for scale in (4, 8, 16, 32, 64):
        noise = random.standard_normal((height // scale, width // scale)).astype(np.float32)
        levels += cv2.resize(noise, TEXTURE, interpolation=cv2.INTER_CUBIC) * scale**0.5
    return np.clip(128 + 40 * levels / levels.std(), 0, 255).astype(np.uint8)


def tiled(structure):
    """Make a picture one of equal tiles, 12 degrees wide, of which each is a little different."""
    width = round(12.0 / 360.0 * TEXTURE[0])
    tiles = np.tile(structure[:, :width], (1, TEXTURE[0] // width + 1))[:, : TEXTURE[0]]
    return cv2.addWeighted(tiles, 0.8, structure, 0.2, 0.0)


@dataclass
class TexturedDome:
    """All devices are views of one object whose time moves only when somebody waits for a frame.

    Attributes:
        seed: of the scene.
        scale: true angles over those that it is sent to and reports, of pan and tilt; negative for the other way.
        upside_down: whether its picture is; the fixed camera's is upright.
        mirrored: whether its picture is.
        delay_s: from a command to motion.
        late_s: by which its reported positions are late.
        stop_s: from a halt to braking.
        round_deg: to which its goals are rounded.
        curve: of the magnification in the logarithm of the nominal focal length.
        turns_at_zoom: whether a zoom sends the head to 0, 0.
        obeys: whether it goes where it is sent.
        cap_deg_s: highest speed beyond half of the zoom's range.
        swing_deg: by which it swings about its goal until it is halted.
        steered: whether it takes velocities, with which a driver leads it to its goal that does not know `late_s`.
        known_s: `stop_s`, as that driver knows it.
        tiles: whether what it sees is made of tiles.
        steps: whether it goes a part of a way, and after a pause the rest, as by relative moves.
    """

    seed: int = 0
    scale: tuple[float, float] = (1.0, 1.0)
    upside_down: bool = False
    mirrored: bool = False
    delay_s: float = 0.06
    late_s: float = 0.0
    stop_s: float = 0.0
    round_deg: float = 0.0
    curve: float = 0.0
    turns_at_zoom: bool = False
    obeys: bool = True
    cap_deg_s: float = 100.0
    swing_deg: float = 0.0
    swings: bool = False
    steered: bool = False
    known_s: float = 0.0
    tiles: bool = False
    steps: bool = False
    t: float = 10.0

    def __post_init__(self):
        self._texture = tiled(texture(self.seed)) if self.tiles else texture(self.seed)
        self.axes = [Axis(math.radians(100), math.radians(800)) for _ in range(2)]
        self.steering = [SteeredAxis(DEGREES, self.delay_s, self.known_s) for _ in range(2)]
        self.steered_t = self.t
        self.next_step = None  # its time, and goals with speeds
        self.zooms = [(0.0, WIDE_PX)]
        self.sent = (0.0, 0.0)
        self.fixed, self.zoom, self.head, self.clock = _Fixed(self), _Zoom(self), _Head(self), RigClock(self, 1e-3)

    def focal(self, t):
        """True focal length at a time."""
        share = math.log(next(f for at, f in reversed(self.zooms) if at <= t) / WIDE_PX) / math.log(LONGEST)
        return WIDE_PX * LONGEST ** (share + self.curve * share * (1 - share))

    def steer(self, t):
        """Send velocities, or the next step, until a time."""
        if self.next_step and self.next_step[0] <= t:
            for axis, goal in zip(self.axes, self.next_step[1], strict=True):
                axis.command(self.next_step[0], *goal)
            self.next_step = None
        while self.steered and self.steered_t <= t:
            now, self.steered_t = self.steered_t, self.steered_t + STEERED_S
            for axis, steering, k in zip(self.axes, self.steering, self.scale, strict=True):
                before = steering.velocity
                velocity = steering.wanted(math.degrees(axis.motor(now - self.late_s)[0]) / k, now, now)
                if velocity == before:
                    continue
                steering.send(velocity, now)
                if velocity:
                    end = math.copysign(math.pi, velocity * k)
                    axis.command(now + self.delay_s, end, abs(k) * math.radians(abs(velocity)))
                else:
                    axis.halt(now + self.delay_s + self.stop_s)

    def angles(self, t):
        self.steer(t)
        swing = math.radians(self.swing_deg) * math.sin(2 * math.pi * t / SWING_S) if self.swings else 0.0
        return [axis.motor(t)[0] + swing for axis in self.axes]

    def picture(self, pan, tilt, focal):
        """What a camera sees."""
        (width, height), (columns, rows) = SIZE, TEXTURE
        u = (np.arange(width, dtype=np.float32) - (width - 1) / 2) / focal
        v = ((np.arange(height, dtype=np.float32) - (height - 1) / 2) / focal)[:, None]
        down, ahead = v * math.cos(tilt) - math.sin(tilt), v * math.sin(tilt) + math.cos(tilt)
        x = ((np.arctan2(u, ahead) + pan) / (2 * math.pi) + 0.5) * columns
        y = (np.arctan2(down, np.hypot(u, ahead)) / math.pi + 0.5) * rows
        grey = cv2.remap(self._texture, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
        return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)


@dataclass
class _Fixed:
    rig: TexturedDome
    size: tuple[int, int] = SIZE

    def read(self, newer_than=None, timeout=1.0):
        return Frame(self.rig.picture(0.05, -0.02, WIDE_PX), self.rig.t)


@dataclass
class _Zoom:
    rig: TexturedDome
    size: tuple[int, int] = SIZE
    still_size: tuple[int, int] = SIZE
    focal_range: tuple[float, float] = (WIDE_PX, WIDE_PX * LONGEST)
    stated_s: float = 0.06  # latency, of tests.support.rigs

    def read(self, newer_than=None, timeout=1.0):
        rig, early = self.rig, LATENCY_S - self.stated_s  # dated so much too late
        index = math.floor((rig.t - LATENCY_S) * RATE_HZ + 1e-6)
        if newer_than is not None:
            index = max(index, math.floor((newer_than - early) * RATE_HZ + 1e-6) + 1)
        exposed = index / RATE_HZ
        rig.t = max(rig.t, exposed + LATENCY_S)
        image = rig.picture(*rig.angles(exposed), rig.focal(exposed))
        if rig.upside_down:
            image = image[::-1, ::-1]
        return Frame(np.ascontiguousarray(image[:, ::-1] if rig.mirrored else image), exposed + early)

    def zoom(self, focal_px):
        rig = self.rig
        rig.zooms.append((rig.t + rig.delay_s, focal_px))
        if rig.turns_at_zoom:
            rig.head.move(0.0, 0.0)
        return focal_px

    def state(self):
        arrives, focal_px = self.rig.zooms[-1]
        return ZoomState(focal_px, self.rig.t < arrives, self.rig.t)


@dataclass
class _Head:
    rig: TexturedDome
    limits: object = alike((-2.9, 2.9), (-0.6, 1.4), math.radians(100), None, 0.0)

    def state(self):
        rig = self.rig
        seen = rig.angles(rig.t - rig.late_s) if rig.obeys else rig.sent
        moving = bool(rig.next_step) or any(axis.motor(rig.t)[1] != 0 for axis in rig.axes)
        return PanTiltState(*(at / k for at, k in zip(seen, rig.scale, strict=True)), moving, rig.t)

    def move(self, pan, tilt, speed=None, wait=False):
        rig, step = self.rig, math.radians(self.rig.round_deg)
        rig.sent, rig.swings = (pan, tilt), True
        rig.steer(rig.t)
        if rig.steered:
            for steering, goal, rate in zip(rig.steering, (pan, tilt), self.limits.capped(speed), strict=True):
                steering.aim(math.degrees(goal), math.degrees(rate), rig.t)
            rig.steered_t = rig.t
            return pan, tilt
        rest = []
        for axis, goal, k, rate in zip(rig.axes, (pan, tilt), rig.scale, self.limits.capped(speed), strict=True):
            goal = round(goal / step) * step if step else goal
            if rig.obeys:
                zoomed = rig.zooms[-1][1] > WIDE_PX * LONGEST**0.5
                fastest = math.radians(rig.cap_deg_s if zoomed else 100.0)
                rate = min(abs(k) * rate, fastest)
                here = axis.motor(rig.t)[0] if rig.steps else k * goal
                stands = axis.command(rig.t + rig.delay_s, here + FIRST_STEP * (k * goal - here), rate)
                rest.append((stands, k * goal, rate))
        rig.next_step = (max(rest)[0] + PAUSE_S, [goal for _, *goal in rest]) if rig.steps else None
        return pan, tilt

    def halt(self):
        self.rig.swings = False
        self.rig.steer(self.rig.t)
        self.rig.next_step = None
        for steering in self.rig.steering:
            steering.stop(self.rig.t)
        for axis in self.rig.axes:
            axis.halt(self.rig.t + self.rig.delay_s + self.rig.stop_s)
