"""A fixed camera that is nudged, or whose clock is off: close-up yield, and errors of range and of the clock.

The rig is that of `experiments.following.field`. A nudge turns the fixed camera at 6 s, for good; its images are turned
about the lens. Stamps of its frames are late (above 0) or early by a constant time.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics
from cotarget.detection import make_detector
from cotarget.evaluation import add_row
from cotarget.geometry import Array, Rotation
from cotarget.metrics import Row as Judged
from cotarget.metrics import score
from cotarget.pipeline import FollowSettings
from cotarget.rig import Camera, Frame
from cotarget.sim.world import SimWorld
from experiments.engine import Count, Row
from experiments.following.field import FieldSettings, calibrated, hold_config, watched_in
from experiments.tables import grouped, spread

NUDGED_S = 6.0
AFTER_S = 2.0  # time after a nudge at which the range is judged [s]
# Goals for each target's median yield.
WANTED = {"person": 0.90, "bird": 0.85}
FIGURES = ("closeup_yield", "centred_yield", "range_error")


@dataclass(frozen=True)
class DisturbedSettings(FieldSettings):
    """Settings: targets and disturbances."""

    seeds: Count = 2
    targets: tuple[str, ...] = ("person", "bird")
    nudges_deg: tuple[float, ...] = (0.1, 0.3, 1.0)  # angles by which the fixed camera is turned [degrees]
    late_s: tuple[float, ...] = (-0.1, -0.06, 0.06, 0.1)  # errors of the fixed camera's stamps [s]


class DisturbedCamera:
    """Fixed camera that is turned at a time, and whose stamps are off."""

    def __init__(self, camera: Camera, lens: Intrinsics, turn: Rotation, late_s: float) -> None:
        """Wrap a camera.

        Args:
            camera: the camera.
            lens: its lens.
            turn: rotation from the turned camera's frame to the one before.
            late_s: what its stamps have too much [s].
        """
        self._camera, self._late_s = camera, late_s
        width, height = camera.size
        v, u = np.mgrid[:height, :width].astype(float)
        self._map: Array = lens.project(lens.ray(np.stack([u, v], axis=-1)) @ turn.as_matrix().T).astype(np.float32)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self._camera.size

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Read a frame; arguments as for a camera."""
        frame = self._camera.read(None if newer_than is None else newer_than - self._late_s, timeout)
        image = frame.image
        if frame.t >= NUDGED_S:
            image = np.asarray(cv2.remap(image, self._map, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))
        return Frame(image, frame.t + self._late_s)


def one(settings: DisturbedSettings, seed: int) -> list[Row]:
    """Follow each target under each disturbance; give a row per run."""
    cases = [(nudge, 0.0) for nudge in settings.nudges_deg] + [(0.0, late) for late in settings.late_s]
    return [
        {"seed": seed, "target": name, "nudge_deg": nudge, "late_s": late}
        | _followed(calibrated(settings), settings, name, seed, nudge, late)
        for name in settings.targets
        for nudge, late in cases
    ]


def _followed(
    calibration: Calibration, settings: DisturbedSettings, name: str, seed: int, nudge_deg: float, late_s: float
) -> Row:
    """Follow a target; give the figures of a run."""
    config = hold_config(name, seed)
    target, world = config.target(name), SimWorld(config)
    way = np.random.default_rng(seed).uniform(0, 2 * math.pi)  # the nudge's direction
    turn = Rotation.from_rotvec(math.radians(nudge_deg) * np.array([math.cos(way), math.sin(way), 0.0]))
    lens = calibration.fixed.lens.resized(config.sim.fixed.size)
    world.rig = dataclasses.replace(world.rig, fixed=DisturbedCamera(world.rig.fixed, lens, turn, late_s))
    detector, judged = make_detector(target, config.sim.fixed.rate_hz), list[Judged]()
    range_error = math.nan
    for step, truth in watched_in(world, detector, calibration, target, settings.seconds, FollowSettings()):
        add_row(judged, step, truth, name, target)
        if math.isnan(range_error) and step.t >= NUDGED_S + AFTER_S:
            x = truth.T_world_fixed.inv().apply(truth.center(name, step.fixed.t - late_s))
            range_error = math.inf if step.estimate is None else abs(step.estimate.depth / float(x[2]) - 1)
    found = score(judged)
    return {"closeup_yield": found.closeup_yield, "centred_yield": found.centred_yield, "range_error": range_error}


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Give the spread of each figure over the seeds, by target and disturbance."""
    return {
        f"{name}, {f'nudged by {nudge:g} degrees' if nudge else f'stamps {1e3 * late:+.0f} ms'}": {
            key: spread(row[key] for row in mine) for key in FIGURES
        }
        for (name, nudge, late), mine in grouped(rows, "target", "nudge_deg", "late_s").items()
    }


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the cases whose median yield misses its goal."""
    reached = {case: found["closeup_yield"]["median"] for case, found in summary.items()}
    return [
        f"{case}: closeup_yield: {value:.3g}, not {WANTED[case.split(',')[0]]:g} or more"
        for case, value in reached.items()
        if not value >= WANTED[case.split(",")[0]]
    ]


SETTINGS = DisturbedSettings()
QUICK = dataclasses.replace(
    SETTINGS, seeds=1, seconds=10.0, calibrated=False, targets=("bird",), nudges_deg=(0.3,), late_s=()
)
COST_S = 600.0
