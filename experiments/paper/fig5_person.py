"""Fig. 5 of the paper: indoors, a walking person, found by an adaptive Gaussian mixture and connected components.

This project's pipeline and the paper's method (`experiments.paper.paper_loop`) use the same calibration and the paper's
plain detector, `mog2`; `--set fig5_person.detector=motion` gives this project's pipeline its own. The person walks in
after the background was learnt for about two seconds, then goes to and fro about 10 m away. Figures are medians over
the seeds with the least and the largest, as defined in `cotarget.metrics`, by ground truth.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt

from cotarget.calibration import Calibration
from cotarget.config import DetectorName
from cotarget.drawing import draw_wide, draw_zoom
from cotarget.evaluation import add_row
from cotarget.metrics import Row as Judged
from cotarget.metrics import score
from cotarget.pipeline import FollowSettings, Step
from experiments.engine import Count, Pictured, Row
from experiments.following.field import OwnRigInField, calibrated, watched_in
from experiments.following.wide_view import WideView, open_on, record
from experiments.paper.paper_loop import OURS, WAYS, laid_out, picture_name
from experiments.tables import grouped, outside, spread

NAME = "person"
MOMENTS, FIRST_S = 3, 4.4  # moments in the picture; time of the first [s], after the person's entry at 3 s
FIGURES = (
    "tpe_px_median",
    "tpo_px_median",
    "tpo_percent_median",
    "size_ratio_median",
    "in_frame_ratio",
    "time_to_acquire_s",
    "closeup_yield",
    "centred_yield",
    "identification",
    "identification_wide",
    "false_tracks_per_min",
)
WANTED: Mapping[str, tuple[float, float]] = {
    "tpo_percent_median": (0.0, 4.0),
    "size_ratio_median": (0.85, 1.15),
    "in_frame_ratio": (0.99, 1.0),
    "time_to_acquire_s": (0.0, 2.0),
}


@dataclass(frozen=True)
class PersonSettings(OwnRigInField):
    """Settings: length of the runs, and detector."""

    seeds: Count = 2
    # Length of a run; the person's path does not end (`cotarget.sim.targets.paths`) [s].
    seconds: Annotated[float, Gt(FIRST_S)] = 7.0
    detector: DetectorName = "mog2"  # detector of this project's pipeline, mog2 or motion


def one(settings: PersonSettings, seed: int) -> Pictured:
    """Follow a person by each method; give a row per method, and pictures of the first seed."""
    rows: list[Row] = []
    pictures: dict[str, bytes] = {}
    views: dict[str, WideView] = {}  # by detector: both methods see the same frames, which are rendered once
    for way in WAYS:
        row, moments = _followed(calibrated(settings), settings, seed, way, views)
        rows.append(row)
        if seed == settings.seed_base:
            pictures[picture_name("fig5", way)] = _picture(moments)
    return Pictured(rows, pictures)


def _followed(
    calibration: Calibration, settings: PersonSettings, seed: int, way: str, views: dict[str, WideView]
) -> tuple[Row, list[Step]]:
    """Follow a person; give the figures and some moments."""
    config = settings.config("indoor", (NAME,), seed)
    found_by = settings.detector if way == OURS else "mog2"
    target = dataclasses.replace(config.target(NAME), detector=found_by)
    how = FollowSettings()
    judged: list[Judged] = []
    moments: list[Step] = []
    # The last step comes a frame before the end, or later.
    due = np.linspace(FIRST_S, settings.seconds - 1 / config.sim.fixed.rate_hz, MOMENTS).tolist()
    if found_by not in views:
        views[found_by] = record(config, target, settings.seconds)
    world, detector = open_on(views[found_by], config, closed_loop=True)
    for step, truth in watched_in(world, detector, calibration, target, settings.seconds, how, WAYS[way]):
        add_row(judged, step, truth, NAME, target)
        if due and step.t >= due[0]:
            moments.append(step)
            due.pop(0)
    found = dataclasses.asdict(score(judged))
    offset = found["tpo_width_median"]
    found["tpo_percent_median"] = None if offset is None else 100 * offset
    return {"seed": seed, "way": way, "detector": found_by, **{key: found[key] for key in FIGURES}}, moments


def _picture(moments: Sequence[Step]) -> bytes:
    """Arrange pictures of some moments as in Fig. 5 of the paper: (a) above (b)."""
    return laid_out(
        [
            [(draw_wide(step), f"(a) stationary camera, t = {step.fixed.t:.1f} s") for step in moments],
            [(draw_zoom(step), f"(b) moving camera, at {step.lens.focal_px:.0f} px") for step in moments],
        ]
    )


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """Give median, least and largest of each method's figures over the seeds, and mark runs without a figure."""
    return {
        way: {
            key: spread(row[key] for row in mine) | {"not measured": float(sum(row[key] is None for row in mine))}
            for key in FIGURES
            if key in mine[0]
        }
        for way, mine in grouped(rows, "way").items()
    }


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List this project's figures that miss their goal, or were not measured in some run."""
    ours = summary[OURS]
    return [f"{key}: not measured in some run" for key in WANTED if ours[key]["not measured"]] + outside(ours, WANTED)


SETTINGS = PersonSettings()
# As long as the full run: the offset of one seed over 5 s changes by a third with what changes nothing over 12 s.
QUICK = dataclasses.replace(SETTINGS, seeds=1, calibrated=False)
COST_S = 30.0
