"""Single shots at a target in the simulated field, each followed by one correction, with an error budget.

A shot is one command to head and lens, computed from the fixed camera alone: direction from the detections, depth from
the size, motion over the delay from the track. Head and lens reach it as soon as the delay is over; their travel time
is left out, as in the definition of the delay. Ground truth judges the zoom frame exposed then. The target is searched
in that frame, and a second shot uses the result.
"""

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import RigConfig, TargetProfile
from cotarget.control.controller import reach_of
from cotarget.control.selection import FirstCome
from cotarget.detection import make_detector
from cotarget.errors import UnreachableError
from cotarget.estimation import Estimate
from cotarget.evaluation import observe, true_calibration
from cotarget.fusion import TargetFusion
from cotarget.geometry import Array
from cotarget.metrics import Row as Judged
from cotarget.pipeline import State, Step
from cotarget.rig import Frame, Rig, to_step
from cotarget.safety.safe_rig import guard
from cotarget.sim.truth import Truth
from cotarget.sim.world import SimWorld
from cotarget.targeting import Aim, Reach, aim
from cotarget.tracking.track import Track, tracking_settings
from cotarget.tracking.tracker import Tracker

# Head and lens that reach any pose within a millisecond.
QUICK_DEG_S, QUICK_DEG_S2, QUICK_STEPS_S = 1e6, 1e9, 1e6
BEGIN_S = 3.0  # time of the first shot, one second after the background was learnt
EVERY_S = 0.8  # interval of the shots; a shot and its correction take 0.7 s
ROUNDING = 1e-6  # tolerance of frame times, in seconds and in periods
CAUSES = ("detection", "size", "calibration", "delay", "steps", "lens")


@dataclass(frozen=True)
class Shot:
    """One command, and what it was computed from.

    Attributes:
        seen_t: time of the fixed camera's frame [s].
        exposed_t: time of the zoom frame that it was computed for [s].
        pixel: estimated target position in the fixed camera's frame [px], (2,).
        depth: estimated depth of the target in that frame [m].
        moved: predicted motion from ``seen_t`` to ``exposed_t``, in the fixed frame [m], (3,).
        wished_px: solved nominal focal length [px].
        pan: commanded pan, rounded to steps [rad].
        tilt: commanded tilt, rounded to steps [rad].
        nominal_px: nominal focal length of the lens's position [px].
    """

    seen_t: float
    exposed_t: float
    pixel: Array
    depth: float
    moved: Array
    wished_px: float
    pan: float
    tilt: float
    nominal_px: float


@dataclass(frozen=True)
class Fired:
    """A shot and its result.

    Attributes:
        shot: first shot.
        on_target: whether its estimate was on the target, no farther off than the target's larger side.
        row: scores of its zoom frame.
        parts: error of each cause alone [rad]; see `budget`.
        missed: angle between the line of sight and the target when the zoom frame was exposed [rad].
        found: whether the target was found in that frame.
        corrected: scores of the second shot's zoom frame; None without a second shot.
    """

    shot: Shot
    on_target: bool
    row: Judged
    parts: dict[str, float]
    missed: float
    found: bool
    corrected: Judged | None


def quick(config: RigConfig) -> RigConfig:
    """Give the same rig with a head and a lens that need no travel time."""
    head = replace(config.sim.head, speed_deg_s=QUICK_DEG_S, accel_deg_s2=QUICK_DEG_S2)
    zoom = replace(config.sim.zoom, lens_speed=QUICK_STEPS_S)
    return replace(config, sim=replace(config.sim, head=head, zoom=zoom))


def fire(
    calibration: Calibration, config: RigConfig, name: str, target: TargetProfile, seconds: float
) -> list[Fired | None]:
    """Shoot at a target repeatedly, each time from the fixed camera alone.

    A shot is due every EVERY_S. It is skipped where the target is not detected at that time or is out of reach.

    Args:
        calibration: calibration that the shots use.
        config: configuration of the rig and its world.
        name: name of the target.
        target: configuration of the target.
        seconds: length of the run [s].

    Returns:
        Result of each due shot; None where it was skipped.
    """
    config = quick(config)
    world = SimWorld(config)
    truth, exact = world.truth(), true_calibration(world, stops=config.sim.zoom.lens_steps)
    fired: list[Fired | None] = []
    with guard(world.rig, config.safety) as rig:
        lookout = _Lookout(rig, calibration, config, target)
        begin = BEGIN_S
        while rig.clock.now() < seconds:
            lookout.look()
            if lookout.frame.t < begin - ROUNDING:
                continue
            begin = lookout.frame.t + EVERY_S
            if lookout.track is None or lookout.track.missed or (shot := lookout.shoot()) is None:
                fired.append(None)
                continue
            row = observe(lookout.judged(shot), truth, name, target)
            t = shot.exposed_t
            miss = truth.line_of_sight_miss(*truth.head_at(t), truth.nominal_at(t), truth.center(name, t))
            parts = budget(truth, exact, calibration, reach_of(rig), name, shot)
            found = lookout.find_in_zoom()
            second = lookout.shoot()
            corrected = None if second is None else observe(lookout.judged(second), truth, name, target)
            lookout.forget()
            fired.append(Fired(shot, _on_target(truth, name, shot), row, parts, miss, found, corrected))
    return fired


def _on_target(truth: Truth, name: str, shot: Shot) -> bool:
    box, at = truth.box(name, "fixed", shot.seen_t), truth.pixel("fixed", truth.center(name, shot.seen_t), shot.seen_t)
    return box is not None and bool(np.linalg.norm(shot.pixel - at) <= np.max(box[1] - box[0]))


class _Lookout:
    """Fixed-camera pipeline that shoots at the target that first-come selection picks.

    Attributes:
        frame: newest frame of the fixed camera.
        track: selected track; None without one.
    """

    frame: Frame

    def __init__(self, rig: Rig, calibration: Calibration, config: RigConfig, target: TargetProfile) -> None:
        self._rig, self._config, self._calibration = rig, config, calibration
        self._detector = make_detector(target, config.sim.fixed.rate_hz)
        self._tracker = Tracker(tracking_settings(target), rig.fixed.size)
        self._wide = TargetFusion(calibration, target, rig.fixed.size)  # never updated from the zoom camera
        self._both: TargetFusion | None = None
        self._policy = FirstCome()
        self._tracks: list[Track] = []
        self._t: float | None = None
        self.track: Track | None = None

    def look(self) -> None:
        """Process the next frame of the fixed camera."""
        self.frame = self._rig.fixed.read(newer_than=self._t)
        self._t = self.frame.t
        self._tracks = self._tracker.update(self._detector.detect(self.frame), self.frame.t)
        state = self._rig.head.state()
        for fusion in self._fusions():
            fusion.update_fixed(self.frame, self._tracks, self._detector.mask)
            fusion.states.add(state, self._rig.zoom.state())
        candidates = self._wide.candidates(self._tracks, self._rig.clock.now())
        number = self._policy.select(candidates, np.array([state.pan, state.tilt]), self._rig.head.limits)
        self.track = next((track for track in self._tracks if track.id == number), None)
        for fusion in self._fusions():
            fusion.follow(number)

    def _fusions(self) -> Iterator[TargetFusion]:
        yield self._wide
        if self._both is not None:
            yield self._both

    def shoot(self) -> Shot | None:
        """Aim at the track for the first zoom frame that can be exposed then, and wait for it; None if out of reach."""
        fusion = self._wide if self._both is None else self._both
        rate, now = self._config.sim.fixed.rate_hz, self._rig.clock.now()
        still = now + self._rig.spec.head.delay_s + self._config.sim.zoom.exposure_s / 2
        t = (math.floor(still * rate + ROUNDING) + 1) / rate
        if self.track is None:
            return None
        at, then = (fusion.estimate(self.track.id, each) for each in (self.frame.t, t))
        if at is None or then is None:
            return None
        try:
            found = aim(self._calibration, then.x_fixed, reach_of(self._rig), wanted_size=then.wanted_size)
        except UnreachableError:
            return None
        shot = self._command(at, then, found, t)
        if self._both is None:
            self._both = copy.deepcopy(self._wide)
        while self._rig.clock.now() < t + self._config.sim.zoom.latency_s - ROUNDING:
            self.look()
        self._zoom = self._rig.zoom.read()
        assert abs(self._zoom.t - t) * rate < ROUNDING, "the zoom frame is the one that was aimed for"
        return shot

    def _command(self, at: Estimate, then: Estimate, found: Aim, t: float) -> Shot:
        bias = then.bias
        pan, tilt = self._rig.head.move(found.pan - bias[0], found.tilt - bias[1])
        nominal = self._rig.zoom.zoom(found.nominal_px)
        pixel = self._calibration.fixed.project(at.x_fixed)
        moved = then.x_fixed - at.x_fixed
        return Shot(self.frame.t, t, pixel, at.depth, moved, found.nominal_px, pan, tilt, nominal)

    def find_in_zoom(self) -> bool:
        """Search the target in the shot's zoom frame, for the next shot; give whether it was found."""
        assert self._both is not None, "a shot was taken"
        return self._both.update_zoom(self._zoom, self.frame.t) is not None

    def forget(self) -> None:
        """Drop what the zoom camera has shown."""
        self._both = None

    def judged(self, shot: Shot) -> Step:
        """Give the shot as a Step, for comparison with the ground truth."""
        return Step(
            index=0,
            t=self._rig.clock.now(),
            state=State.FOLLOWING,
            reason="",
            fixed=self.frame,
            zoom=self._zoom,
            mask=None,
            detections=(),
            tracks=tuple(self._tracks),
            target=self.track,
            aim=None,
            commanded=(shot.pan, shot.tilt, shot.nominal_px),
            head=self._rig.head.state(),
            lens=self._rig.zoom.state(),
        )


def budget(
    truth: Truth, exact: Calibration, calibration: Calibration, reach: Reach, name: str, shot: Shot
) -> dict[str, float]:
    """Compute the error that each cause alone leaves between line of sight and target, with all else true [rad].

    Args:
        truth: ground truth of the world.
        exact: calibration of the world without error.
        calibration: calibration that the shots use.
        reach: limits of head and lens.
        name: name of the target.
        shot: the command and what it was computed from.

    Returns:
        "detection": error of the pixel; "size": of the depth; "calibration": of the whole calibration; "delay": of the
        predicted motion until the exposure; "steps": rounding of the head; "lens": the lens's position beside the
        solved focal length.
    """
    seen, then = (truth.center(name, t) for t in (shot.seen_t, shot.exposed_t))
    x_seen, x_then = truth.T_world_fixed.inv().apply(np.array([seen, then]))
    depth, pixel = float(x_seen[2]), truth.pixel("fixed", seen, shot.seen_t)
    free = replace(reach, pan=(-np.inf, np.inf), tilt=(-np.inf, np.inf), now=(shot.pan, shot.tilt))

    def miss(
        model: Calibration, x_fixed: Array, x_world: Array, step: float = 0.0, nominal: float | None = None
    ) -> float:
        found = aim(model, x_fixed, free, nominal_px=shot.wished_px)
        pan, tilt = (to_step(angle, step) for angle in (found.pan, found.tilt))
        return truth.line_of_sight_miss(pan, tilt, found.nominal_px if nominal is None else nominal, x_world)

    return {
        "detection": miss(exact, exact.fixed.ray(shot.pixel) * depth, seen),
        "size": miss(exact, exact.fixed.ray(pixel) * shot.depth, seen),
        "calibration": miss(calibration, calibration.fixed.ray(pixel) * depth, seen),
        # A wrong depth scales the motion as it scales the distance, so that the angle is right.
        "delay": miss(exact, x_seen + shot.moved * depth / shot.depth, then),
        "steps": miss(exact, x_then, then, step=reach.step),
        "lens": miss(exact, x_then, then, nominal=shot.nominal_px),
    }
