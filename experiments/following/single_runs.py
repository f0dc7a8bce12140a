"""Runs of the pair and of a single pan-tilt-zoom camera on the same targets, judged by ground truth."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import RigConfig, TargetProfile
from cotarget.evaluation import TruthDetector, TruthFinder, closeup_of, true_calibration
from cotarget.metrics import BACKGROUND_S, ROUNDING_S, WHOLLY_VISIBLE
from cotarget.metrics import Row as Judged
from cotarget.pantilt import towards
from cotarget.pipeline import FollowSettings, follow
from cotarget.rig import Rig
from cotarget.safety.safe_rig import guard
from cotarget.sim.truth import Outlines
from cotarget.sim.world import SimWorld
from experiments.following.field_scenes import hold_config
from experiments.following.lone_camera import LoneCamera, scan_of
from experiments.following.shaken import NOISE, Shaken

WAYS = PAIR, LONE_CAMERA = "pair", "lone"
FAR = 1000.0  # distance at which the offset of the cameras is negligible [m]
STREAM = 25  # random stream


def config_of(name: str, seed: int) -> RigConfig:
    """Configure the field without clutter, which ground-truth detections ignore, and detection by appearance."""
    config = hold_config(name, seed)
    config = replace(config, sim=replace(config.sim, effects=replace(config.sim.effects, clutter=False)))
    target = config.target(name)
    # With `motion`, a target must move some way before it is confirmed, which a single camera cannot measure.
    looks = target if target.matcher == "box" else replace(target, detector="speck")
    return replace(config, targets={**config.targets, name: looks})


def held(way: str, name: str, seed: int, seconds: float, miss: float, lasts_s: float | None = None) -> list[Judged]:
    """Run one way from a start without search; judge each zoom frame.

    Args:
        way: PAIR or LONE_CAMERA.
        name: name of the target.
        seed: seed of everything random.
        seconds: length of the run [s].
        miss: fraction of zoom frames in which the target is missed while the image moves.
        lasts_s: duration of the single camera's manoeuvres; see `Course`.
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
    closeup = closeup_of(outlines, name, target, t)
    wide = outlines.silhouette(name, "fixed", t)
    lens = outlines.lens("zoom", t)
    return Judged(
        t_s=t,
        t_fixed_s=t,
        state="",
        track=-1,
        u_px=closeup.u_px,
        v_px=closeup.v_px,
        width_px=closeup.width_px,
        height_px=closeup.height_px,
        size_px=closeup.size_px,
        wanted_px=closeup.wanted_px,
        visible=closeup.visible,
        in_wide=wide is not None and wide.visible >= WHOLLY_VISIBLE,
        u_wide_px=math.nan,
        v_wide_px=math.nan,
        u_detected_px=math.nan,
        v_detected_px=math.nan,
        decoded=False,
        decoded_wide=False,
        off_target="",
        range_m=math.nan,
        depth_m=math.nan,
        pan_commanded_deg=0.0,
        tilt_commanded_deg=0.0,
        focal_commanded_px=0.0,
        pan_deg=0.0,
        tilt_deg=0.0,
        focal_px=lens.focal_px[0],
    )
