"""Simple controllers and an oracle beside the project's: each is given a Task and gives the Steps of `follow`.

    sixty lines     largest blob of MOG2, or the best box of the given detector, near the last one; constant-velocity
                    Kalman filter in 3D on the depth from the size; exact aim at where it predicts the target to be
    proportional    the same box without filter and prediction; a part of the head's error is commanded in each frame
    move and wait   the same box; the next command comes when head and lens stand
    oracle          true states of the target up to now, extrapolated with constant acceleration to when a command takes
                    effect; true calibration; the head's and the lens's own limits

None but the project looks at the close-up.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from scipy.stats import t as student

from cotarget.calibration import Calibration
from cotarget.config import RigConfig, TargetProfile
from cotarget.control.controller import reach_of
from cotarget.control.head import HeadController, HeadSettings
from cotarget.detection import Detector
from cotarget.errors import UnreachableError
from cotarget.evaluation import TruthDetector, add_row, closeup_of, true_calibration
from cotarget.geometry import Array
from cotarget.metrics import Row as Judged
from cotarget.metrics import Score, score
from cotarget.pipeline import FollowSettings, FrameSource, State, Step
from cotarget.rig import Frame, Rig
from cotarget.sim.world import SimWorld
from cotarget.targeting import Aim, WantedSize, aim, depth_of, point_at
from experiments.engine import Row
from experiments.following.field import FieldSettings, calibrated, held, watched_in
from experiments.following.wide_view import open_on, record
from experiments.paper.paper_loop import Follow, Task
from experiments.tables import SPREAD, grouped, spread

OURS, ORACLE = "this project", "oracle"
SIXTY, PROPORTIONAL, WAIT = "sixty lines", "proportional", "move and wait"
FEWEST_FRAMES = 8  # frames with a box from which a target is followed
GIVEN_UP_S, NEW_GIVEN_UP_S = 1.0, 0.2  # time without a box after which a target, and one not yet followed, is dropped
DEPTHS_M = (3.0, 90.0)  # range of depths from sizes
LEARNT_FRAMES = 25  # of the background
LENS_CHANGE = 0.06  # least change of the logarithm of the focal length that is commanded
Box = tuple[Array, Array]  # centre and (width, height) [px]


@dataclass(frozen=True)
class Gains:
    """Gains of the simple controllers for one kind of target.

    Attributes:
        acceleration: standard deviation of the target's acceleration [m/s^2].
        size_noise: relative standard deviation of the measured size.
        gate_px: radius around the prediction in which the next box is taken [px].
        gate_px_s: growth of that radius without a box [px/s].
        lead_s: time added to that from light to the head's motion, for its travel [s].
        part: part of the head's error that is commanded in a frame, without prediction.
        fading: part of the largest size that is left in the next frame; 0 takes each size as it is.
        blobs: whether boxes are the blobs of MOG2 and not the given detector's.
    """

    acceleration: float
    size_noise: float
    gate_px: float
    gate_px_s: float
    lead_s: float = 0.08
    part: float = 0.6
    fading: float = 0.0
    blobs: bool = False


GAINS: Mapping[str, Gains] = {
    "standing": Gains(1.0, 0.05, 25.0, 80.0),
    "walking": Gains(2.0, 0.05, 25.0, 80.0, blobs=True),
    "flying": Gains(48.0, 0.15, 12.0, 60.0, fading=0.97),
}


class Blobs:
    """Boxes of what moves, by MOG2, the largest first."""

    LEAST_PX, WIDEST, LEAST_AREA_PX = 24, 1.2, 200  # height, width over height, and area of a person

    def __init__(self) -> None:
        """Start without a background."""
        self._model = cv2.createBackgroundSubtractorMOG2(history=300, varThreshold=25, detectShadows=True)
        self._frames = 0

    def __call__(self, frame: Frame) -> list[Box]:
        """Find the boxes of a frame; none while the background is learnt."""
        self._frames += 1
        found = self._model.apply(frame.image, learningRate=-1 if self._frames > 1 else 1)
        mask = cv2.threshold(found, 200, 255, cv2.THRESH_BINARY)[1]  # without shadows
        mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((15, 5), np.uint8))
        if self._frames < LEARNT_FRAMES:
            return []
        boxes = []
        for contour in cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]:
            (x, y, width, height), area = cv2.boundingRect(contour), cv2.contourArea(contour)
            if height > self.LEAST_PX and width < self.WIDEST * height and area > self.LEAST_AREA_PX:
                boxes.append((area, np.array([x + (width - 1) / 2, y + (height - 1) / 2]), np.array([width, height])))
        return [(center, size.astype(float)) for _, center, size in sorted(boxes, key=lambda box: -box[0])]


def detected(detector: Detector, frame: Frame) -> list[Box]:
    """List the whole boxes of a detector that are more likely than not."""
    return [(d.center_px, d.size_px) for d in detector.detect(frame).boxes if d.score >= 0.5 and not d.clipped]


class Filter:
    """Constant-velocity Kalman filter of one target in 3D, with its box and how long it was seen."""

    def __init__(self, calibration: Calibration, target: TargetProfile, gains: Gains) -> None:
        """Start without a target."""
        self._calibration, self._target, self._gains = calibration, target, gains
        self.x: Array | None = None  # position [m] and velocity [m/s] in the fixed frame, (6,)
        self.P = np.eye(6)
        self.seen: Array | None = None  # position by the newest box alone [m], (3,)
        self._seen_frames, self._missed_s, self._size_px = 0, 0.0, 0.0

    @property
    def followed(self) -> bool:
        """Whether the target was seen often enough."""
        return self.x is not None and self._seen_frames > FEWEST_FRAMES

    def add(self, boxes: Sequence[Box], dt: float) -> None:
        """Predict to the next frame, dt [s] later, and correct by the box that is the target's."""
        self._predict(dt)
        measured = self._measure(self._own(boxes))
        if measured is None:
            self._missed_s += dt
            if self._missed_s > (GIVEN_UP_S if self.followed else NEW_GIVEN_UP_S):
                self.x, self._seen_frames, self._size_px = None, 0, 0.0
            return
        self._missed_s, self._seen_frames, self.seen = 0.0, self._seen_frames + 1, measured
        if self.x is None:
            self.x, self.P, self._seen_frames = np.r_[measured, 0, 0, 0], np.diag([1.0, 1, 9, 9, 9, 9]), 1
            return
        depth = measured[2]
        ray = measured / np.linalg.norm(measured)
        across, along = depth / self._calibration.fixed.lens.focal_px[0], self._gains.size_noise * depth
        R = np.eye(3) * across**2 + np.outer(ray, ray) * along**2
        K = self.P[:, :3] @ np.linalg.inv(self.P[:3, :3] + R)
        self.x = self.x + K @ (measured - self.x[:3])
        self.P = self.P - K @ self.P[:3]

    def _predict(self, dt: float) -> None:
        if self.x is None:
            return
        F = np.eye(6)
        F[:3, 3:] = dt * np.eye(3)
        G = np.vstack([dt * dt / 2 * np.eye(3), dt * np.eye(3)])
        self.x, self.P = F @ self.x, F @ self.P @ F.T + self._gains.acceleration**2 * G @ G.T
        if self.x[2] < 1:  # too near to be one
            self.x = None

    def _own(self, boxes: Sequence[Box]) -> Box | None:
        """Take the box nearest to the prediction within the gate; of blobs the largest there."""
        if self.x is None:
            return boxes[0] if boxes else None
        gains, at = self._gains, self._calibration.fixed.project(self.x[:3])
        off = [float(np.linalg.norm(center - at)) for center, _ in boxes]
        near = [i for i, px in enumerate(off) if px < gains.gate_px + gains.gate_px_s * self._missed_s]
        if not near:
            return None
        return boxes[near[0] if gains.blobs else min(near, key=lambda i: off[i])]

    def _measure(self, box: Box | None) -> Array | None:
        """Compute the position of a box from its size [m], (3,)."""
        if box is None:
            return None
        center, (width, height) = box
        self._size_px = max(self._target.length(float(width), float(height)), self._gains.fading * self._size_px)
        try:
            depth = depth_of(self._calibration, self._target, self._size_px, center)
            return point_at(self._calibration, center, min(max(depth, DEPTHS_M[0]), DEPTHS_M[1]))
        except UnreachableError:
            return None


def _simple(way: str, task: Task) -> Iterator[Step]:
    """Follow a target by one of the simple controllers."""
    rig, target = task.rig, task.target
    calibration = task.calibration.for_streams(rig.fixed.size, rig.zoom.size)
    gains = GAINS[target.motion]
    find = Blobs() if gains.blobs else partial(detected, task.detector)
    state, command = Filter(calibration, target, gains), _Commands(rig)
    moves_at = -math.inf  # time at which the last command has begun to move the head [s]
    for frame, interval in command.frames(task.seconds):
        state.add(find(frame), interval)
        now, found = rig.clock.now(), None
        if not state.followed or state.x is None or state.seen is None:
            command.zoom_out()
        elif way != WAIT or (now >= moves_at and not rig.head.state().moving and not rig.zoom.state().moving):
            lead_s = now - frame.t + rig.spec.head.delay_s + gains.lead_s
            at = state.x[:3] + lead_s * state.x[3:] if way == SIXTY else state.seen
            try:
                wanted_size = WantedSize(target.size, target.wanted_px, target.is_vertical())
                found = aim(calibration, at, reach_of(rig), wanted_size=wanted_size)
            except UnreachableError:
                pass
            else:
                pan, tilt, head = found.pan, found.tilt, rig.head.state()
                if way == PROPORTIONAL:
                    pan, tilt = (q + gains.part * (goal - q) for q, goal in ((head.pan, pan), (head.tilt, tilt)))
                command.move(pan, tilt)
                command.zoom(found.nominal_px)
                moves_at = now + rig.spec.head.delay_s + interval
        yield command.step(frame, found)


class _Commands:
    """Commands of a run so far, and its Steps."""

    def __init__(self, rig: Rig) -> None:
        self._rig, self._source = rig, FrameSource(rig.fixed, rig.zoom, rig.clock)
        head = rig.head.state()
        self._at = (head.pan, head.tilt, rig.zoom.zoom(rig.zoom.focal_range[0]))
        self._index, self._sent, self._lens = 0, 0, 1

    def frames(self, seconds: float) -> Iterator[tuple[Frame, float]]:
        """Read the fixed camera's frames for some seconds; give each with the time since the one before [s]."""
        end, usual = self._rig.clock.now() + seconds, 1 / self._rig.spec.fixed.rate_hz
        while self._rig.clock.now() < end:
            frame = self._source.read_fixed()
            yield frame, usual if math.isinf(self._source.interval) else self._source.interval

    def move(self, pan: float, tilt: float, speed: Any = None) -> None:
        """Send the head."""
        self._at = (*self._rig.head.move(pan, tilt, speed), self._at[2])
        self._sent += 1

    def zoom(self, nominal_px: float, least: float = LENS_CHANGE) -> None:
        """Send the lens if the logarithm of the focal length changes by more than a least value."""
        if abs(math.log(nominal_px / self._at[2])) > least:
            self._at = (*self._at[:2], self._rig.zoom.zoom(nominal_px))
            self._lens += 1

    def zoom_out(self) -> None:
        """Send the lens to its shortest focal length."""
        self.zoom(self._rig.zoom.focal_range[0])

    @property
    def nominal_px(self) -> float:
        """Focal length commanded last [px]."""
        return self._at[2]

    def step(self, frame: Frame, found: Aim | None) -> Step:
        """Make the Step of a frame."""
        self._index += 1
        return Step(
            index=self._index - 1,
            t=self._rig.clock.now(),
            state=State.SEARCHING if found is None else State.FOLLOWING,
            reason="",
            fixed=frame,
            zoom=self._source.read_zoom(),
            mask=None,
            detections=(),
            tracks=(),
            target=None,
            aim=found,
            commanded=self._at,
            head=self._rig.head.state(),
            lens=self._rig.zoom.state(),
            head_commands=self._sent,
            lens_commands=self._lens,
        )


# The oracle

PAST_S = 0.02  # spacing of the past positions from which velocity and acceleration come [s]
# The head follows at the target's own rates, without deadband, and makes up an error within two frames.
ORACLE_HEAD = HeadSettings(deadband=False, slow=0.0, catch_s=0.08, hurry_s=0.08)
ORACLE_LENS_CHANGE = 0.02


def _oracle(world: SimWorld, name: str, task: Task) -> Iterator[Step]:
    """Follow a target of a world by its true states up to now; calibration, detector and settings are not used."""
    rig, target = task.rig, task.target
    truth, exact = world.truth(), true_calibration(world, stops=world.config.sim.zoom.lens_steps)
    controller, command = HeadController(rig.head.limits, ORACLE_HEAD), _Commands(rig)
    T_fixed_world, lens = truth.T_world_fixed.inv(), exact.zoom_head.lens
    for frame, interval in command.frames(task.seconds):
        now = rig.clock.now()
        before, last, x = (T_fixed_world.apply(truth.center(name, max(now - k * PAST_S, 0.0))) for k in (2, 1, 0))
        velocity, acceleration = (1.5 * x - 2 * last + 0.5 * before) / PAST_S, (x - 2 * last + before) / PAST_S**2

        def ahead(seconds: float) -> Array:
            return np.asarray(x + seconds * velocity + seconds**2 / 2 * acceleration)  # noqa: B023  used at once

        lead_s = rig.spec.head.delay_s
        state, seen = rig.head.state(), closeup_of(truth, name, target, now)
        controller.head.add_report(state)
        wanted = WantedSize(target.size, target.wanted_px, target.is_vertical())
        found = None
        try:
            found, then = (
                aim(exact, ahead(at), reach_of(rig, state), wanted_size=wanted) for at in (lead_s, lead_s + interval)
            )
        except UnreachableError:
            pass
        else:
            rates = (then.pan - found.pan) / interval, (then.tilt - found.tilt) / interval
            width = rig.zoom.size[0] / lens.at(command.nominal_px).focal_px[0]
            sent = controller.decide(now + lead_s, interval, (found.pan, found.tilt), rates, width)
            if sent is not None:
                command.move(sent.pan, sent.tilt, sent.speed)
            nominal = then.nominal_px
            if not math.isnan(seen.size_px):  # the true size, and not the nominal one
                focal = truth.lens("zoom", now).focal_px[0] / seen.size_px * target.wanted_px
                nominal = lens.nominal_for(focal * then.range / float(np.linalg.norm(_from_zoom(world, x, now))))
            shortest, longest = rig.zoom.focal_range
            command.zoom(min(max(nominal, shortest), longest), ORACLE_LENS_CHANGE)
        yield command.step(frame, found)


def _from_zoom(world: SimWorld, x_fixed: Array, t: float) -> Array:
    """Give the way from the zoom camera to a point at time t [s], in the world [m], (3,)."""
    truth = world.truth()
    return np.asarray(truth.T_world_fixed.apply(x_fixed) - truth.T_world_camera("zoom", t).translation)


SIMPLE = (SIXTY, PROPORTIONAL, WAIT)
WAYS = (OURS, *SIMPLE, ORACLE)
YIELDS = ("closeup_yield", "centred_yield")
SURE = 0.95  # probability of the interval of a paired difference


def scores(settings: FieldSettings, config: RigConfig, name: str, ways: Sequence[str]) -> Iterator[tuple[str, Score]]:
    """Follow a target in each of some ways, and score the runs.

    The simple controllers share one recorded view of the fixed camera; their close-ups are not rendered.
    """
    calibration, target, seconds = calibrated(settings), config.target(name), settings.seconds
    view = record(config, target, seconds) if set(ways) & set(SIMPLE) else None
    for way in ways:
        if way == OURS:
            yield way, score(held(calibration, config, name, seconds))
            continue
        detector: Detector
        how: Follow
        if way == ORACLE or view is None:
            world = SimWorld(config, rendered=())
            detector, how = TruthDetector(world.truth(), 0), partial(_oracle, world, name)
        else:
            world, detector = open_on(view, config, closed_loop=False)
            how = partial(_simple, way)
        rows: list[Judged] = []
        for step, truth in watched_in(world, detector, calibration, target, seconds, FollowSettings(), how):
            add_row(rows, step, truth, name, target)
        yield way, replace(score(rows), identification=None, identification_wide=None)


def comparison(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Give both yields by way, and how far the project is ahead of each other way.

    That is the paired difference over the seeds: its mean, and the ends of its 95 % interval as least and largest. The
    project is ahead where the whole interval is above 0.
    """
    ways = grouped(rows, "way")
    ours = {row["seed"]: row for row in ways[OURS]}
    found: dict[str, dict[str, Any]] = {}
    for way, theirs in ways.items():
        found[way] = {key: spread(row[key] for row in theirs) for key in YIELDS}
        for key in YIELDS if way != OURS else ():
            pairs = [(ours[row["seed"]][key], row[key]) for row in theirs if row["seed"] in ours]
            ahead = interval([a - b for a, b in pairs if a is not None and b is not None])
            found[way] |= {f"{key}, difference": ahead, f"{key}, ahead": "yes" if ahead["least"] > 0 else "no"}
    return found


def interval(differences: Sequence[float]) -> dict[str, float]:
    """Give the mean of differences and its 95 % interval by Student's t; nan of fewer than two."""
    count = len(differences)
    if count < 2:
        return dict.fromkeys(SPREAD, math.nan)
    mean, error = float(np.mean(differences)), float(np.std(differences, ddof=1)) / math.sqrt(count)
    half = float(student.ppf((1 + SURE) / 2, count - 1)) * error
    return dict(zip(SPREAD, (mean, mean - half, mean + half), strict=True))
