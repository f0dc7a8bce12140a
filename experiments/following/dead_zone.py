"""Value of the head's deadband: commands and reversals a minute with and without it, and the offset that it costs.

A book that is moved once and a person who walks are followed in the field of `experiments.following.field_scenes` by
the whole pipeline. Only the deadband differs between the runs.

    python -m experiments.following.dead_zone [--seeds 2] [--seed-base 0] [--processes P] [--quick] [--out DIR]
"""

import dataclasses
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

from cotarget.calibration import Calibration
from cotarget.control.head import HeadSettings
from cotarget.metrics import score
from cotarget.pipeline import FollowSettings
from experiments.engine.harness import Experiment, Row, seeds_of
from experiments.engine.spread import in_words, spread_of
from experiments.engine.texts import table
from experiments.following.field import FieldSettings, calibrated, held, target_of
from experiments.following.field_scenes import hold_config
from experiments.following.wide_view import record

WAYS = {"with": HeadSettings(), "without": HeadSettings(deadband=False)}
FIGURES = ("commands_per_min", "reversals_per_min", "tpo_width_median")
# Goals: largest ratio of the figure with the deadband to that without.
WANTED = {"commands_per_min": 0.5, "reversals_per_min": 0.5, "tpo_width_median": 1.1}


@dataclass(frozen=True)
class DeadZoneSettings(FieldSettings):
    """Settings: targets of the runs.

    Attributes:
        targets: book or person.
        closed_loop: whether the zoom view corrects the aim.
    """

    seeds: int = 2
    targets: tuple[str, ...] = ("book", "person")
    closed_loop: bool = True


def one(calibration: Calibration, settings: DeadZoneSettings, seed: int) -> list[Row]:
    """Follow each target with and without the deadband; give a row per run."""
    rows: list[Row] = []
    for name in settings.targets:
        config = hold_config(name, seed)
        view = record(config, target_of(config, name), settings.seconds)
        for way, head in WAYS.items():
            how = FollowSettings(head=head, closed_loop=settings.closed_loop)
            found = score(held(calibration, config, name, settings.seconds, how, view))
            rows.append({"seed": seed, "target": name, "way": way} | {key: getattr(found, key) for key in FIGURES})
    return rows


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, Any]]]:
    """Give median, least and largest by target and figure over the seeds, and the ratio of the medians."""
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for name in dict.fromkeys(row["target"] for row in rows):
        found[name] = {}
        for key in FIGURES:
            ways = {way: _spread([r[key] for r in rows if (r["target"], r["way"]) == (name, way)]) for way in WAYS}
            found[name][key] = ways | {"over": _over(ways["with"]["median"], ways["without"]["median"])}
    return found


def _spread(values: Sequence[float | None]) -> dict[str, float]:
    """Summarise values over the seeds; nan where a run never acquired its target."""
    return spread_of([] if None in values else [float(value) for value in values if value is not None])


def _over(value: float, other: float) -> float:
    """Give a ratio; 1 for zero over zero."""
    return 1.0 if value == other == 0 else value / other if other else math.inf


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the figures that miss their goal."""
    return [
        f"{name}: {key}"
        for name, figures in summary.items()
        for key, found in figures.items()
        if not found["over"] <= WANTED[key]
    ]


def describe(settings: DeadZoneSettings, summary: Mapping[str, Any]) -> str:
    """Format a line per target and figure."""
    lines = [
        [f"{name}, {key}", *(in_words(found[way]) for way in WAYS), found["over"], f"<= {WANTED[key]:g}"]
        for name, figures in summary.items()
        for key, found in figures.items()
    ]
    return f"the head with a deadband and without, median (least to largest) of {seeds_of(settings)}\n" + table(
        ("", "with", "without", "with / without", "wanted"), lines
    )


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """With against without: each seed that has both a point, its median a cross with arms from least to largest."""
    for ax, key in zip(figure.subplots(1, len(FIGURES)), FIGURES, strict=True):
        highest = 0.0
        for name in dict.fromkeys(row["target"] for row in rows):
            with_it, without = ([r[key] for r in rows if (r["target"], r["way"]) == (name, way)] for way in WAYS)
            # A run that never acquired its target has no figure; it must not count as zero, the best value.
            both = [pair for pair in zip(without, with_it, strict=True) if None not in pair]
            of_way = [[pair[i] for pair in both] for i in range(len(WAYS))]
            (dots,) = ax.plot(*of_way, ".", alpha=0.6)
            told = [spread_of(each) for each in of_way]
            x, y = (each["median"] for each in told)
            arms = [[[each["median"] - each["least"]], [each["largest"] - each["median"]]] for each in told]
            ax.errorbar([x], [y], xerr=arms[0], yerr=arms[1], fmt="o", color=dots.get_color(), label=name)
            highest = max([highest, *of_way[0], *of_way[1]])
        ax.plot([0, highest], [0, WANTED[key] * highest], "k:", label="wanted: below")
        ax.set(title=key, xlabel="without", ylabel="with")
    ax.legend(frameon=False, loc="lower right")


SETTINGS = DeadZoneSettings()
EXPERIMENT = Experiment(
    "dead_zone",
    "Commands and reversals a minute with the deadband and without, and the offset it costs.",
    SETTINGS,
    # Without correction from the zoom view, which takes a third of the time.
    dataclasses.replace(SETTINGS, seeds=1, targets=("person",), seconds=10.0, calibrated=False, closed_loop=False),
    one,
    summarise,
    describe,
    plot,
    missed,
    prepare=calibrated,
    cost_s=180.0,
)
if __name__ == "__main__":
    sys.exit(EXPERIMENT.main())
