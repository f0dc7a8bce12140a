"""Time of the pipeline for a frame, against the background subtraction that it is built from.

The film shows a real bird (V_BIRD_036 of Svanstroem et al., doi 10.5281/zenodo.5500576, CC0-1.0, searched in
../shared/data/birds beside the project). On each frame, in turns because a machine's speed drifts, two things are
timed: `cv2.createBackgroundSubtractorMOG2().apply` alone on BGR, and the loop's work on a fixed-camera frame: detect,
track in the image and in 3D, and aim exactly at the target's predicted position. Control of head and lens and the zoom
view are left out. OpenCV uses its default number of threads.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cotarget import backends
from cotarget.calibration import Calibration
from cotarget.config import DEFAULT_TARGETS, RigConfig, TargetProfile
from cotarget.control.selection import FirstCome, candidates_of
from cotarget.detection import Detector, make_detector
from cotarget.errors import ConfigError
from cotarget.evaluation import true_calibration
from cotarget.fusion import TargetFusion, ZoomSearch
from cotarget.rig import AxisLimits, Frame, PanTiltLimits
from cotarget.rig_geometry import FixedCamera
from cotarget.sim.world import SimWorld
from cotarget.targeting import Aim, Reach, aim
from cotarget.tracking.track import Track, tracking_settings
from cotarget.tracking.tracker import Tracker
from cotarget.video import Film
from experiments.engine import Count, Row, Settings

FILM = Path(__file__).resolve().parents[2] / "shared" / "data" / "birds" / "V_BIRD_036.mp4"
MIXTURE = "MOG2 alone"
# Lead of the aim [s].
LEAD_S = 0.1
STAGES = ("detect_ms", "track_ms", "aim_ms")
WANTED = {"motion": 1.5, "speck": 2.5, "auto": 2.0}  # goal: largest ratio to the subtraction alone


@dataclass(frozen=True)
class PipelineSpeedSettings(Settings):
    """Settings: passes through the film as seeds.

    The first frames are not timed, because a learning model costs more or less.
    """

    seeds: Count = 1
    frames: Count = 300
    untimed: Count = 60

    def __post_init__(self) -> None:
        """Refuse runs without timed frames."""
        if self.untimed >= self.frames:
            raise ConfigError(f"untimed: {self.untimed} is not below frames = {self.frames}, so that none is timed")


class Pipeline:
    """Detection, tracking and aiming, as the loop does them for a frame."""

    def __init__(self, kind: str, size: tuple[int, int], rate_hz: float) -> None:
        """Start a detector of a kind without history, for images of a size [px]."""
        self.target: TargetProfile = replace(DEFAULT_TARGETS["bird"], detector=kind)
        self.detector: Detector = make_detector(self.target, rate_hz)
        self.tracks: list[Track] = []
        self.calibration = calibration_of(size)
        self.tracker, self.policy = Tracker(tracking_settings(self.target), size), FirstCome()
        self.fusion, self.size = TargetFusion(self.calibration, self.target), size
        self.search = ZoomSearch(self.calibration, self.target)
        spec = backends.describe(RigConfig())
        pan, tilt = (axis.range for axis in spec.head.limits.axes)
        self.reach = Reach(pan, tilt, spec.zoom.focal_range)
        self.limits = PanTiltLimits(AxisLimits(pan, math.inf), AxisLimits(tilt, math.inf))
        self.aim: Aim | None = None  # the last one

    def __call__(self, frame: Frame) -> Row:
        """Process a frame; give the milliseconds of each stage, and whether there was a target to aim at."""
        began = time.perf_counter()
        found = self.detector.detect(frame, self.tracks)
        detected = time.perf_counter()
        self.tracks = self.tracker.update(found.boxes, frame.t, found.shift, cut=found.cut)
        self.fusion.add_tracks(frame, self.tracks, found.mask, [self.search])
        targets, T_base_fixed = self.fusion.targets, self.calibration.zoom_head.T_base_fixed
        candidates = candidates_of(targets.values(), frame.t, T_base_fixed, self.size)
        number = self.policy.select(candidates, np.zeros(2), self.limits)
        self.search.search_for(None if number is None else targets[number])
        estimate = None if number is None else targets[number].estimate(frame.t + LEAD_S)
        tracked = time.perf_counter()
        if estimate is not None:
            self.aim = aim(self.calibration, estimate.x_fixed, self.reach, wanted_size=estimate.wanted_size)
        ended = time.perf_counter()
        times = (began, detected, tracked, ended)
        stages = {name: 1e3 * (b - a) for name, a, b in zip(STAGES, times[:-1], times[1:], strict=True)}
        return {"ms": 1e3 * (ended - began), "aimed": estimate is not None, **stages}


def mixture() -> Callable[[Frame], Row]:
    """Make a background subtraction without history, to be timed as a `Pipeline`."""
    subtractor = cv2.createBackgroundSubtractorMOG2()

    def subtract(frame: Frame) -> Row:
        began = time.perf_counter()
        subtractor.apply(frame.image)
        return {"ms": 1e3 * (time.perf_counter() - began), "aimed": True}

    return subtract


def calibration_of(size: tuple[int, int]) -> Calibration:
    """Give the default rig's calibration, with a fixed image of that size."""
    calibration = true_calibration(SimWorld(RigConfig(), rendered=()))
    middle = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    lens = replace(calibration.fixed.lens, size=size, center_px=middle)
    return replace(calibration, fixed=FixedCamera(lens))


def needs(settings: PipelineSpeedSettings) -> str:
    """Describe what is missing to run; empty if nothing."""
    if not FILM.is_file():
        return f"needs {FILM}, which is not part of the project"
    with Film(FILM) as film:
        there = film.count
    few = there is not None and there < settings.frames
    return f"needs {settings.frames} frames, and {FILM} has {there}" if few else ""


def one(settings: PipelineSpeedSettings, seed: int) -> list[Row]:
    """Run through the film once; give a row per frame and way."""
    rows: list[Row] = []
    with Film(FILM) as film:
        ways: list[tuple[str, Callable[[Frame], Row]]] = [(MIXTURE, mixture())]
        ways += [(kind, Pipeline(kind, film.size, film.rate_hz)) for kind in ("mog2", "motion", "speck", "auto")]
        for index, frame in enumerate(film):
            if index >= settings.frames:
                break
            for k in range(len(ways)):  # the first to read a frame loads it into the cache: each is first in turn
                way, work = ways[(k + index) % len(ways)]
                done = work(frame)
                if index >= settings.untimed:
                    rows.append({"seed": seed, "frame": index, "way": way, **done})
    return rows


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give median milliseconds of the frames with a target to aim at, and the ratio to the subtraction."""
    found = {}
    alone = float(np.median([row["ms"] for row in rows if row["way"] == MIXTURE]))
    for way in dict.fromkeys(sorted((row["way"] for row in rows), key=lambda way: way != MIXTURE)):
        mine = [row for row in rows if row["way"] == way]
        aimed = [row for row in mine if row["aimed"]]
        found[way] = {"frames_aimed": len(aimed) / len(mine)}
        for name in ("ms", *STAGES):
            found[way][name] = float(np.median([row[name] for row in aimed if row.get(name) is not None] or [np.nan]))
        found[way]["ratio"] = found[way]["ms"] / alone
    return found


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the ways that take longer than their goal."""
    return [way for way, most in WANTED.items() if not summary[way]["ratio"] <= most]


SETTINGS = PipelineSpeedSettings()
QUICK = replace(SETTINGS, seeds=1, frames=120)
ALONE = True
COST_S = 60.0
