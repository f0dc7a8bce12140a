"""Following under disturbances: nudges, wrong stamps, an approach to 6 m, two seconds behind a wall, and 10 Hz.

The rig is that of `experiments.following.field`. `CASES` lists the disturbances of each target, with their goals. A
nudge turns the fixed camera at 6 s, for good; its images are turned about the lens. Stamps of its frames are late
(above 0) or early by a constant time.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics
from cotarget.config import RigConfig
from cotarget.detection import make_detector
from cotarget.evaluation import add_row
from cotarget.geometry import Array, Rotation
from cotarget.metrics import Row as Judged
from cotarget.metrics import out_of_frame_s, score
from cotarget.pipeline import FollowSettings
from cotarget.rig import Camera, Frame
from cotarget.sim.world import SimWorld
from experiments.engine import Count, Row
from experiments.following.field import FieldSettings, calibrated, field_config, hold_config, watched_in
from experiments.following.tight_paths import STYLES, Style, open_path, tight_course
from experiments.tables import Range, grouped, outside, spread

NUDGED_S = 6.0
AFTER_S = 2.0  # time after a nudge at which the range is judged [s]
OFFSET_S = 10.0  # time after the first estimate at which the clocks' offset is judged [s]
FIGURES = ("closeup_yield", "centred_yield", "out_s", "range_error", "offset_error_ms")


@dataclass(frozen=True)
class Case:
    """A target under one disturbance.

    Attributes:
        target: person or bird.
        wanted: least and largest median of the figures that have a goal.
        nudge_deg: angle by which the fixed camera is turned [degrees].
        late_s: what the fixed camera's stamps have too much [s].
        rate_hz: frame rate of both cameras.
        style: how the target moves; by default as in `hold`.
        walled: whether a wall hides it for two seconds; needs a style.
    """

    target: str
    wanted: Mapping[str, Range] = field(default_factory=dict)
    nudge_deg: float = 0.0
    late_s: float = 0.0
    rate_hz: float = 25.0
    style: Style | None = None
    walled: bool = False

    def config(self, seed: int, seconds: float, folder: Path) -> RigConfig:
        """Configure the rig with the target on its course; a scene with a wall is written into a folder."""
        if self.style is None:
            config = hold_config(self.target, seed)
        elif self.walled:
            course = tight_course(self.target, seed, seconds, self.style)
            config = field_config({self.target: course.path}, seed, str(course.wall.scene(folder)))
        else:
            config = field_config({self.target: open_path(self.target, seed, seconds, self.style)}, seed)
        cameras = {
            key: dataclasses.replace(getattr(config.sim, key), rate_hz=self.rate_hz) for key in ("fixed", "zoom")
        }
        return dataclasses.replace(config, sim=dataclasses.replace(config.sim, **cameras))


APPROACH = dataclasses.replace(STYLES["bird"], depths=(60.0, 6.0))
# They pass the wall without a turn, at an even speed.
PASSING = {
    "person": Style((12.0, 12.0), STYLES["person"].heights, (1.5,), (3.0, 6.0), 0.0, 0.25, 0.0, 0.9, 0.3),
    "bird": dataclasses.replace(STYLES["bird"], depths=(45.0, 45.0), speeds=(5.0,), leg_s=(5.0, 8.0), gust=0.5),
}
YIELDS = {"person": 0.90, "bird": 0.85}
CASES: Mapping[str, Case] = {
    **{
        f"{name}, nudged by {nudge:g} degrees": Case(
            name, {"closeup_yield": (least, 1.0), "range_error": (0.0, 0.05)}, nudge_deg=nudge
        )
        for name, least in YIELDS.items()
        for nudge in (0.1, 0.3, 1.0)
    },
    **{
        f"{name}, stamps {1e3 * late:+.0f} ms": Case(
            name, {"closeup_yield": (0.85, 1.0), "offset_error_ms": (0.0, 15.0)}, late_s=late
        )
        for name in YIELDS
        for late in (-0.1, -0.06, 0.06, 0.1)
    },
    "bird, 60 m to 6 m": Case("bird", {"closeup_yield": (0.80, 1.0)}, style=APPROACH),
    **{
        f"{name}, hidden for 2 s": Case(name, {"out_s": (0.0, 0.4)}, style=style, walled=True)
        for name, style in PASSING.items()
    },
    "person, 10 Hz": Case("person", rate_hz=10.0),
    "bird, 10 Hz": Case("bird", {"closeup_yield": (0.75, 1.0), "centred_yield": (0.35, 1.0)}, rate_hz=10.0),
}


@dataclass(frozen=True)
class DisturbedSettings(FieldSettings):
    """Settings: names of the cases."""

    seeds: Count = 2
    cases: tuple[str, ...] = tuple(CASES)


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
    """Follow each case's target; give a row per run."""
    return [
        {"seed": seed, "case": name} | _followed(calibrated(settings), settings, CASES[name], seed)
        for name in settings.cases
    ]


def _followed(calibration: Calibration, settings: DisturbedSettings, case: Case, seed: int) -> Row:
    """Follow a target; give the figures of a run."""
    with TemporaryDirectory(prefix="cotarget-") as folder:
        config = case.config(seed, settings.seconds, Path(folder))
        world, target = SimWorld(config), config.target(case.target)
    way = np.random.default_rng(seed).uniform(0, 2 * math.pi)  # the nudge's direction
    turn = Rotation.from_rotvec(math.radians(case.nudge_deg) * np.array([math.cos(way), math.sin(way), 0.0]))
    lens = calibration.fixed.lens.resized(config.sim.fixed.size)
    if case.nudge_deg or case.late_s:
        world.rig = dataclasses.replace(world.rig, fixed=DisturbedCamera(world.rig.fixed, lens, turn, case.late_s))
    detector, judged = make_detector(target, config.sim.fixed.rate_hz), list[Judged]()
    range_error = offset_error_ms = first_t = math.nan
    for step, truth in watched_in(world, detector, calibration, target, settings.seconds, FollowSettings()):
        add_row(judged, step, truth, case.target, target)
        t = step.fixed.t - case.late_s
        if math.isnan(range_error) and step.t >= NUDGED_S + AFTER_S:
            x = truth.T_world_fixed.inv().apply(truth.center(case.target, t))
            range_error = math.inf if step.estimate is None else abs(step.estimate.depth / float(x[2]) - 1)
        if step.estimate is not None:
            first_t = step.t if math.isnan(first_t) else first_t
            if step.t <= first_t + OFFSET_S:  # the estimate's time is the stamp as it is corrected
                offset_error_ms = 1e3 * abs(step.estimate.t - t)
    found = score(judged)
    figures = (found.closeup_yield, found.centred_yield, out_of_frame_s(judged), range_error, offset_error_ms)
    return dict(zip(FIGURES, figures, strict=True))


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Give the spread of each figure over the seeds, by case."""
    return {
        name: {key: spread(row[key] for row in mine) for key in FIGURES} for name, mine in grouped(rows, "case").items()
    }


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the figures that miss their goal."""
    return [text for name, found in summary.items() for text in outside(found, CASES[name].wanted, name)]


SETTINGS = DisturbedSettings()
QUICK = dataclasses.replace(SETTINGS, seeds=1, seconds=10.0, calibrated=False, cases=("bird, nudged by 0.3 degrees",))
COST_S = 800.0
