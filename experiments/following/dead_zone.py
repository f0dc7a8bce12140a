"""Value of the head's deadband: commands and reversals a minute with and without it, and the offset that it costs.

A book that is moved once and a person who walks are followed in the field of `experiments.following.field` by
the whole pipeline. Only the deadband differs between the runs.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cotarget.control.head import HeadSettings
from cotarget.metrics import score
from cotarget.pipeline import FollowSettings
from experiments.engine import Count, Row
from experiments.following.field import FieldSettings, calibrated, held, hold_config
from experiments.following.wide_view import record
from experiments.tables import grouped, outside, spread

WAYS = {"with": HeadSettings(), "without": HeadSettings(deadband=False)}
FIGURES = ("commands_per_min", "reversals_per_min", "tpo_width_median", "closeup_yield", "centred_yield")
# Goals: ratio of the figure with the deadband to that without.
WANTED = {"commands_per_min": (0.0, 0.5), "reversals_per_min": (0.0, 0.5), "tpo_width_median": (0.0, 1.1)}


@dataclass(frozen=True)
class DeadZoneSettings(FieldSettings):
    """Settings: targets of the runs."""

    seeds: Count = 2
    targets: tuple[str, ...] = ("book", "person")  # book or person
    closed_loop: bool = True  # whether the zoom view corrects the aim


def one(settings: DeadZoneSettings, seed: int) -> list[Row]:
    """Follow each target with and without the deadband; give a row per run."""
    rows: list[Row] = []
    for name in settings.targets:
        config = hold_config(name, seed)
        view = record(config, config.target(name), settings.seconds)
        for way, head in WAYS.items():
            how = FollowSettings(head=head, closed_loop=settings.closed_loop)
            found = score(held(calibrated(settings), config, name, settings.seconds, how, view))
            rows.append({"seed": seed, "target": name, "way": way} | {key: getattr(found, key) for key in FIGURES})
    return rows


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, Any]]]:
    """Give median, least and largest by target and figure over the seeds, and the ratio of the medians."""
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for name, mine in grouped(rows, "target").items():
        found[name] = {}
        for key in FIGURES:
            ways = {way: _spread([row.get(key) for row in each]) for way, each in grouped(mine, "way").items()}
            found[name][key] = ways | {"over": _over(ways["with"]["median"], ways["without"]["median"])}
    return found


def _spread(values: Sequence[float | None]) -> dict[str, float]:
    """Summarise values over the seeds; nan where a run never acquired its target."""
    return spread([] if None in values else [float(value) for value in values if value is not None])


def _over(value: float, other: float) -> float:
    """Give a ratio; 1 for zero over zero."""
    return 1.0 if value == other == 0 else value / other if other else math.inf


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the figures that miss their goal."""
    over = {name: {key: found["over"] for key, found in figures.items()} for name, figures in summary.items()}
    return [text for name, figures in over.items() for text in outside(figures, WANTED, name)]


SETTINGS = DeadZoneSettings()
# Without correction from the zoom view, which takes a third of the time.
QUICK = dataclasses.replace(SETTINGS, targets=("person",), seconds=6.0, calibrated=False, closed_loop=False)
COST_S = 180.0
