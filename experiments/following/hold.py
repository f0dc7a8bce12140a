"""Following in the field: how long and how well a book, a person and a bird are kept in the close-up.

The rig is the default one, calibrated from rendered boards, under the field's conditions
(`experiments.following.field_scenes`): exposure blur, clutter, 120 ms from light to frame, 80 ms from command to
motion, and true sizes that differ from the nominal ones. Each seed has another path, size and noise. Figures are
medians over the seeds with the least and the largest, as defined in `cotarget.metrics`. Ground truth judges every
frame; the pipeline has no access to it.

    python -m experiments.following.hold [--seeds 2] [--seed-base 0] [--processes P] [--quick] [--out DIR]
"""

import dataclasses
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cotarget.calibration import Calibration
from cotarget.metrics import score
from experiments.engine.harness import Experiment, Row, seeds_of
from experiments.engine.spread import in_words, points, spread_of
from experiments.engine.texts import table
from experiments.following.field import FieldSettings, calibrated, held
from experiments.following.field_scenes import hold_config

# Goals for each figure's median: least and largest value.
WANTED: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "book": {
        "closeup_yield": (0.88, 1.0),
        "in_frame_ratio": (0.99, 1.0),
        "tpo_width_median": (0.0, 0.02),
        "size_ratio_median": (0.9, 1.1),
        "fragmentation_per_min": (0.0, 0.0),
        "time_to_acquire_s": (0.0, 2.0),
        "identification": (0.90, 1.0),
        "identification_wide": (0.0, 0.01),
    },
    "person": {
        "closeup_yield": (0.85, 1.0),
        "in_frame_ratio": (0.99, 1.0),
        "tpo_width_median": (0.0, 0.04),
        "size_ratio_median": (0.85, 1.15),
        "fragmentation_per_min": (0.0, 0.2),
        "time_to_acquire_s": (0.0, 2.0),
        "identification": (0.80, 1.0),
        "identification_wide": (0.0, 0.01),
    },
    "bird": {
        "closeup_yield": (0.62, 1.0),
        "in_frame_ratio": (0.90, 1.0),
        "tpo_width_median": (0.0, 0.10),
        "size_ratio_median": (0.75, 1.25),
        "fragmentation_per_min": (0.0, 2.0),
        "time_to_acquire_s": (0.0, 2.5),
        "identification": (0.40, 1.0),
        "identification_wide": (0.0, 0.01),
    },
}
# Fractions of the frames for which larger is better; they are 0 for a target that was never acquired.
SHARES = ("closeup_yield", "in_frame_ratio", "identification")
# Figures without goals.
ALSO = ("tpe_px_median", "false_tracks_per_min", "commands_per_min", "reversals_per_min", "lens_commands_per_min")


@dataclass(frozen=True)
class HoldSettings(FieldSettings):
    """Settings: targets of the runs.

    Attributes:
        targets: book, person or bird.
    """

    seeds: int = 2
    targets: tuple[str, ...] = tuple(WANTED)


def one(calibration: Calibration, settings: HoldSettings, seed: int) -> list[Row]:
    """Follow each target once; give a row per target."""
    return [
        {
            "seed": seed,
            "target": name,
            **dataclasses.asdict(score(held(calibration, hold_config(name, seed), name, settings.seconds))),
        }
        for name in settings.targets
    ]


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """Give median, least and largest of each target's figures over the seeds."""
    return {
        name: {key: _spread(key, [row[key] for row in rows if row["target"] == name]) for key in (*wanted, *ALSO)}
        for name, wanted in WANTED.items()
        if any(row["target"] == name for row in rows)
    }


def _spread(key: str, values: Sequence[float | None]) -> dict[str, float]:
    """Summarise a figure; a run without it counts as the worst in the median, and makes the others nan."""
    worst = 0.0 if key in SHARES else math.inf
    found = spread_of(worst if value is None else float(value) for value in values)
    return found if None not in values else {**dict.fromkeys(found, math.nan), "median": found["median"]}


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the figures that miss their goal."""
    return [
        f"{name}: {key}"
        for name, figures in summary.items()
        for key, (low, high) in WANTED[name].items()
        if not low <= figures[key]["median"] <= high
    ]


def describe(settings: HoldSettings, summary: Mapping[str, Any]) -> str:
    """Format a line per figure, with a column and the goal per target."""
    lines = []
    for key in (*WANTED["book"], *ALSO):
        cells: list[Any] = [key]
        for name, figures in summary.items():
            low, high = WANTED[name].get(key, (-np.inf, np.inf))
            mark = "" if low <= figures[key]["median"] <= high else " NO"
            cells += [in_words(figures[key]) + mark, f"{low:g}-{high:g}" if key in WANTED[name] else ""]
        lines.append(cells)
    head = ["median (least to largest)", *(column for name in summary for column in (name, "wanted"))]
    return f"holding a target, {seeds_of(settings)}\n" + table(head, lines)


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Close-up yield and offset by target: medians with bars from the least seed to the largest, a point a seed."""
    names = [name for name in WANTED if any(row["target"] == name for row in rows)]
    for ax, (key, label) in zip(
        figure.subplots(1, 2),
        (("closeup_yield", "close-up yield"), ("tpo_width_median", "median offset / width")),
        strict=True,
    ):
        for i, name in enumerate(names):
            points(ax, i, [row[key] for row in rows if row["target"] == name and row[key] is not None], color=f"C{i}")
        ax.set(ylabel=label, xticks=range(len(names)), xticklabels=names)


SETTINGS = HoldSettings()
EXPERIMENT = Experiment(
    "hold",
    "How long and how well a target is held in the close-up.",
    SETTINGS,
    dataclasses.replace(SETTINGS, seeds=1, seconds=5.0, calibrated=False),
    one,
    summarise,
    describe,
    plot,
    missed,
    prepare=calibrated,
    cost_s=150.0,
)
if __name__ == "__main__":
    sys.exit(EXPERIMENT.main())
