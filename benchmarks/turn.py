"""Time of a turn of `follow`, from a frame of the fixed camera to the commands, beside MOG2 alone on the same frames.

A simulated rig with exact calibration follows a person, then a bird. The time in cameras, head and lens, where the
simulation renders, is taken off. After each turn `cv2.createBackgroundSubtractorMOG2().apply` works on its frame, so
that the machine's pace counts for both. OpenCV uses one thread. Turns without a target do not count, and none of the
first frames, while the background is learnt.
"""

import contextlib
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import cv2
import numpy as np
from annotated_types import Gt

from cotarget.config import RigConfig
from cotarget.detection import AutoDetector, Mog2Detector, make_detector
from cotarget.errors import CotargetError
from cotarget.evaluation import true_calibration
from cotarget.fusion import TargetFusion, ZoomSearch
from cotarget.pipeline import follow
from cotarget.sim.world import SimWorld
from cotarget.tracking.tracker import Tracker
from experiments.engine import Count, Row, Settings

TARGETS = ("person", "bird")
UNTIMED = 60  # frames, while the background is learnt
PERCENTILES = (50, 95, 99)
# What is timed in a turn; the rest is the choice of the target and the control of head and lens.
PARTS: Mapping[str, tuple[tuple[type, str], ...]] = {
    "detect": (
        (AutoDetector, "detect"),
        (Mog2Detector, "detect"),
    ),
    "track": ((Tracker, "update"),),
    "position": ((TargetFusion, "add_tracks"),),
    "close_up": ((ZoomSearch, "add_frame"),),
}
REST = "control"
# Goals: largest ratio of a turn to the median of MOG2 alone.
MOST = {"p50": 3.0, "p95": 4.0}


@dataclass(frozen=True)
class TurnSettings(Settings):
    """Settings: targets, the detector, or "" for each target's own, and the length of each run."""

    seeds: Count = 1
    targets: tuple[str, ...] = TARGETS
    detector: str = ""
    seconds: Annotated[float, Gt(0)] = 20.0


class Clock:
    """Time spent in each part of a turn, the outermost call counting [s]."""

    def __init__(self) -> None:
        """Start without times."""
        self.spent: defaultdict[str, float] = defaultdict(float)
        self._inside = ""

    def timed(self, part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """Make a function that calls another and adds its time to a part."""

        def timed_call(*arguments: Any, **named: Any) -> Any:
            if self._inside:
                return call(*arguments, **named)
            self._inside, began = part, time.perf_counter()
            try:
                return call(*arguments, **named)
            finally:
                self.spent[part] += time.perf_counter() - began
                self._inside = ""

        return timed_call


class Timed:
    """A device whose calls are timed as part "rig"."""

    def __init__(self, device: Any, clock: Clock) -> None:
        """Wrap a device."""
        self._device, self._clock = device, clock

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._device, name)
        return self._clock.timed("rig", value) if callable(value) else value


@contextlib.contextmanager
def parts_timed(clock: Clock) -> Iterator[None]:
    """Time the methods of PARTS meanwhile."""
    originals = [(owner, name, getattr(owner, name)) for methods in PARTS.values() for owner, name in methods]
    for part, methods in PARTS.items():
        for owner, name in methods:
            setattr(owner, name, clock.timed(part, getattr(owner, name)))
    try:
        yield
    finally:
        for owner, name, method in originals:
            setattr(owner, name, method)


def one(settings: TurnSettings, seed: int) -> list[Row]:
    """Follow each target; give a row for each turn [ms]."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        rows = {name: list(_turns(settings, name, seed)) for name in settings.targets}
    finally:
        cv2.setNumThreads(threads)
    for name, mine in rows.items():
        if not mine:
            raise CotargetError(f"{name}: was followed in no turn after the first {UNTIMED}; give more seconds")
    return [row for mine in rows.values() for row in mine]


def _turns(settings: TurnSettings, name: str, seed: int) -> Iterator[Row]:
    config = RigConfig()
    config = replace(config, sim=replace(config.sim, targets=(name,), seed=seed))
    calibration, target = true_calibration(SimWorld(config, rendered=())), config.target(name)
    target = replace(target, detector=settings.detector or target.detector)
    clock, rig = Clock(), SimWorld(config).rig
    devices: dict[str, Any] = {each: Timed(getattr(rig, each), clock) for each in ("fixed", "zoom", "head", "clock")}
    subtractor = cv2.createBackgroundSubtractorMOG2()
    detector = make_detector(target, config.sim.fixed.rate_hz)
    with parts_timed(clock):
        began = time.perf_counter()
        for step in follow(replace(rig, **devices), calibration, target, detector, seconds=settings.seconds):
            whole = time.perf_counter() - began - clock.spent.pop("rig", 0.0)
            began = time.perf_counter()
            subtractor.apply(step.fixed.image)
            alone = time.perf_counter() - began
            if step.index > UNTIMED and step.target is not None:
                parts = {part: 1e3 * clock.spent[part] for part in PARTS}
                rest = 1e3 * whole - sum(parts.values())
                yield {"seed": seed, "target": name, "turn": 1e3 * whole, "mog2": 1e3 * alone, **parts, REST: rest}
            clock.spent.clear()
            began = time.perf_counter()


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give each target's percentiles of a turn over the median of MOG2, and medians of both and of the parts [ms]."""
    found = {}
    for name in dict.fromkeys(row["target"] for row in rows):
        mine = [row for row in rows if row["target"] == name]
        alone = float(np.median([row["mog2"] for row in mine]))
        ratios = np.percentile([row["turn"] for row in mine], PERCENTILES) / alone
        medians = {part: float(np.median([row[part] for row in mine])) for part in ("mog2", "turn", *PARTS, REST)}
        found[name] = {f"p{p}": float(x) for p, x in zip(PERCENTILES, ratios, strict=True)} | {
            f"{part}_ms": value for part, value in medians.items()
        }
    return found


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the goals that are not reached."""
    return [
        f"{name}: {figure}"
        for name, mine in summary.items()
        for figure, most in MOST.items()
        if not mine[figure] <= most
    ]


SETTINGS = TurnSettings()
QUICK = replace(SETTINGS, targets=("bird",), seconds=4.0)
ALONE = True
COST_S = 120.0
