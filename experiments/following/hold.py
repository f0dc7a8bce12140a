"""Following in the field: how long and how well a book, a person and a bird are kept in the close-up.

The rig is the default one, calibrated from rendered boards, under the field's conditions
(`experiments.following.field`): exposure blur, clutter, 120 ms from light to frame, 80 ms from command to
motion, and true sizes that differ from the nominal ones. Each seed has another path, size and noise. Figures are
medians over the seeds with the least and the largest, as defined in `cotarget.metrics`. Ground truth judges every
frame; the pipeline has no access to it. Simple controllers and an oracle run on the same courses
(`experiments.following.controllers`).
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.engine import Count, Row
from experiments.following.controllers import ORACLE, OURS, WAYS, comparison, scores
from experiments.following.field import FieldSettings, hold_config
from experiments.tables import grouped, outside, spread

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
SHARES = ("closeup_yield", "centred_yield", "in_frame_ratio", "identification")
# Figures without goals.
ALSO = (
    "centred_yield",
    "tpe_px_median",
    "false_tracks_per_min",
    "commands_per_min",
    "reversals_per_min",
    "lens_commands_per_min",
)


@dataclass(frozen=True)
class HoldSettings(FieldSettings):
    """Settings: targets of the runs."""

    seeds: Count = 2
    targets: tuple[str, ...] = tuple(WANTED)  # book, person or bird
    ways: tuple[str, ...] = WAYS  # controllers; this project's is among them


def one(settings: HoldSettings, seed: int) -> list[Row]:
    """Follow each target once in each way; give a row per run."""
    return [
        {"seed": seed, "target": name, "way": way, **dataclasses.asdict(found)}
        for name in settings.targets
        for way, found in scores(settings, hold_config(name, seed), name, settings.ways)
    ]


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Give median, least and largest of each target's figures over the seeds, then the yields of all controllers."""
    found: dict[str, dict[str, Any]] = {
        name: {key: _spread(key, [row[key] for row in mine]) for key in (*WANTED[name], *ALSO) if key in mine[0]}
        for name, mine in grouped(_ours(rows), "target").items()
    }
    if len({row.get("way") for row in rows}) > 1:
        found |= {f"{name}, by controller": comparison(mine) for name, mine in grouped(rows, "target").items()}
    return found


def _ours(rows: Sequence[Row]) -> list[Row]:
    """Select the project's own rows; there were no others before version 0.2."""
    return [row for row in rows if row.get("way", OURS) == OURS]


def _spread(key: str, values: Sequence[float | None]) -> dict[str, float]:
    """Summarise a figure; a run without it counts as the worst in the median, and makes the others nan."""
    worst = 0.0 if key in SHARES else math.inf
    found = spread(worst if value is None else float(value) for value in values)
    return found if None not in values else {**dict.fromkeys(found, math.nan), "median": found["median"]}


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the figures that miss their goal."""
    return [text for name in WANTED if name in summary for text in outside(summary[name], WANTED[name], name)]


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Close-up yield and offset by target: medians with bars from the least seed to the largest, a point a seed."""
    targets = grouped(_ours(rows), "target")
    labels = {"closeup_yield": "close-up yield", "tpo_width_median": "median offset / width"}
    for ax, (key, label) in zip(figure.subplots(1, 2), labels.items(), strict=True):
        for i, mine in enumerate(targets.values()):
            told = [row[key] for row in mine if row[key] is not None]
            if told:
                middle = np.median(told)
                reach = [[middle - min(told)], [max(told) - middle]]
                ax.errorbar([i], [middle], yerr=reach, fmt="_", markersize=12, capsize=3, color=f"C{i}")
                ax.plot([i + 0.12] * len(told), told, ".", color=f"C{i}", alpha=0.5)
        ax.set(ylabel=label, xticks=range(len(targets)), xticklabels=list(targets))


SETTINGS = HoldSettings()
# Of the book, fig4_book and first_shot have bounds.
QUICK = dataclasses.replace(SETTINGS, seconds=5.0, calibrated=False, targets=("person", "bird"), ways=(OURS, ORACLE))
COST_S = 250.0
