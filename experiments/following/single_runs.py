"""Runs of the pair and of a single pan-tilt-zoom camera on the same targets, judged by ground truth."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import RigConfig, TargetProfile
from cotarget.detection import Detections
from cotarget.evaluation import TruthDetector, TruthFinder, TruthNoise, closeup_of, counted, true_calibration
from cotarget.metrics import BACKGROUND_S, ROUNDING_S, WHOLLY_VISIBLE
from cotarget.metrics import Row as Judged
from cotarget.pantilt import towards
from cotarget.pipeline import FollowSettings, follow
from cotarget.rig import Frame, Rig
from cotarget.safety.safe_rig import guard
from cotarget.sim.truth import Outlines, Truth
from cotarget.sim.world import SimWorld
from experiments.following.field_scenes import hold_config
from experiments.following.lone_camera import LoneCamera, scan_of

WAYS = PAIR, LONE_CAMERA = "pair", "lone"
FAR = 1000.0  # distance at which the offset of the cameras is negligible [m]
STREAM = 25  # random stream
NOISE = TruthNoise()
APART = 1 << 32  # offset of the seed from the detectors' own
MOVED_PX, MOVED_S = 1.0, 0.02  # least shift of a moving image, within this time before and after its exposure


class Shaken:
    """Detector with true positions and noise, and more misses while the image moves."""

    def __init__(self, outlines: Outlines, truth: Truth, seed: int, miss: float) -> None:
        """Prepare the detectors at rest and in motion, where a fraction ``miss`` of the frames has no detection."""
        self._still = TruthDetector(outlines, seed, NOISE, camera="zoom")
        self._moving = TruthDetector(outlines, seed, replace(NOISE, miss=miss), camera="zoom")
        self._truth, self._miss, self._numbers_at = truth, miss, counted(seed + APART)

    def detect(self, frame: Frame, held: object = ()) -> Detections:
        """Detect the target."""
        return (self._moving if self.moves(frame.t) else self._still).detect(frame)

    def misses(self, t: float) -> bool:
        """Decide whether the target is missed at a time [s], for another detector."""
        return self._numbers_at(t).random() < (self._miss if self.moves(t) else NOISE.miss)

    def moves(self, t: float) -> bool:
        """Check whether head or lens move the image at a time [s]."""
        width = self._truth.lens("zoom", t).size[0]
        before, after = max(t - MOVED_S, 0.0), t + MOVED_S
        focal_px = self._truth.lens("zoom", t).focal_px[0]
        turned = np.subtract(self._truth.head_at(after), self._truth.head_at(before))
        grown = abs(self._truth.nominal_at(after) / self._truth.nominal_at(before) - 1)
        return bool(focal_px * np.abs(turned).max() > MOVED_PX or width / 2 * grown > MOVED_PX)


def config_of(name: str, seed: int) -> RigConfig:
    """Configure the field without clutter, which ground-truth detections ignore, and detection by appearance."""
    config = hold_config(name, seed)
    config = replace(config, sim=replace(config.sim, effects=replace(config.sim.effects, clutter=False)))
    target = config.target(name)
    # With `motion`, a target must move some way before it is confirmed, which a single camera cannot measure.
    looks = target if target.matcher == "box" else replace(target, detector="speck")
    return replace(config, targets={**config.targets, name: looks})


def held(way: str, name: str, seed: int, seconds: float, miss: float, lasts_s: float | None = None) -> list[Judged]:
    """Run one way, PAIR or LONE_CAMERA, from a start without search; judge each zoom frame.

    While the image moves, the target is missed in a fraction ``miss`` of the zoom frames. For ``lasts_s`` see `Course`.
    """
    world = SimWorld(config_of(name, seed), rendered=())
    target, calibration = world.config.target(name), true_calibration(world)
    outlines = Outlines(world.truth(), still=True)
    shaken = Shaken(outlines, world.truth(), seed, miss)
    rows: list[Judged] = []
    with guard(world.rig, world.config.safety) as rig:
        rig.head.move(*any_pose(rig, calibration, seed))
        last = None
        while not begun(rows) and rig.clock.now() < seconds:
            last = rig.zoom.read(newer_than=last).t
            rows.append(judge(outlines, name, target, last))
        left, delay_s = seconds - rig.clock.now(), rig.spec.head.delay_s
        if left <= 0:  # the target was not in view in time
            return rows
        if way == PAIR:
            times = by_pair(rig, calibration, target, outlines, name, seed, shaken, left)
        else:
            field = scan_of(rig, calibration)
            lone = (rig, world.truth(), calibration, target, shaken, delay_s, NOISE.center_px, field, lasts_s)
            times = (frame.t for frame in LoneCamera(*lone).run(left))
        for t in times:
            if t > rows[-1].t_s:
                rows.append(judge(outlines, name, target, t))
    return rows


def any_pose(rig: Rig, calibration: Calibration, seed: int) -> tuple[float, float]:
    """Draw pan and tilt at which the zoom camera looks into the fixed view [rad]."""
    rng = np.random.default_rng((seed, STREAM))
    pixel = rng.uniform(0.0, np.array(rig.fixed.size) - 1.0)
    pan, tilt = towards(calibration.zoom_head.T_base_fixed.apply(FAR * calibration.fixed.ray(pixel)))
    limits = rig.head.limits
    return float(np.clip(pan, *limits.pan)), float(np.clip(tilt, *limits.tilt))


def begun(rows: Sequence[Judged]) -> bool:
    """Check whether the clock has started, as defined in `cotarget.metrics.score`."""
    return bool(rows) and rows[-1].in_wide and rows[-1].t_s >= rows[0].t_s + BACKGROUND_S - ROUNDING_S


def by_pair(
    rig: Rig,
    calibration: Calibration,
    target: TargetProfile,
    outlines: Outlines,
    name: str,
    seed: int,
    shaken: Shaken,
    seconds: float,
) -> Iterator[float]:
    """Run the project's pipeline with both cameras; yield the times of the zoom frames, with repetitions."""

    def finder(calibration: Calibration, target: TargetProfile) -> TruthFinder:
        return TruthFinder(calibration, target, outlines, name, seed, shaken.misses)

    settings = FollowSettings(finder=finder)
    detector = TruthDetector(outlines, seed, NOISE)
    for step in follow(rig, calibration, target, detector, seconds=seconds, settings=settings):
        yield step.zoom.t


def judge(outlines: Outlines, name: str, target: TargetProfile, t: float) -> Judged:
    """Make the row of a zoom frame from ground truth; fields of commands and tracks are placeholders."""
    closeup, wide = closeup_of(outlines, name, target, t), outlines.silhouette(name, "fixed", t)
    not_known: dict[str, Any] = dict.fromkeys(
        ("u_wide_px", "v_wide_px", "u_detected_px", "v_detected_px", "range_m", "depth_m"), math.nan
    )
    nothing: dict[str, Any] = dict.fromkeys(
        ("pan_commanded_deg", "tilt_commanded_deg", "focal_commanded_px", "pan_deg", "tilt_deg"), 0.0
    )
    return Judged(
        t_s=t,
        t_fixed_s=t,
        state="",
        track=-1,
        **asdict(closeup),
        in_wide=wide is not None and wide.visible >= WHOLLY_VISIBLE,
        decoded=False,
        decoded_wide=False,
        off_target="",
        focal_px=outlines.lens("zoom", t).focal_px[0],
        **not_known,
        **nothing,
    )
