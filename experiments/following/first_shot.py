"""Single shots from the fixed view alone: how well they hit, what one correction adds, and the error budget.

A book, a person and a bird in the field of `experiments.following.field_scenes` are shot at repeatedly
(`experiments.following.shots`). Each shot is one command from the fixed view, judged in the next zoom frame at the
solved focal length, followed by a correction from that zoom frame. The measured error is compared with the root sum
square of the errors that each cause leaves alone: detection, size, calibration, delay, the head's steps and the lens's
positions. A shot at something else than the target counts as a miss and is left out of the budget. A shot that is
skipped, because the target is not detected or out of reach, is counted separately; a correction that could not be fired
counts as a miss.

    python -m experiments.following.first_shot [--seeds 2] [--seed-base 0] [--processes P] [--quick] [--out DIR]
"""

import dataclasses
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cotarget.calibration import Calibration
from experiments.engine.harness import Experiment, Row, seeds_of
from experiments.engine.spread import BESIDE, in_words, spread_of
from experiments.engine.texts import rms, table
from experiments.following.field import FieldSettings, calibrated, target_of
from experiments.following.field_scenes import LATENCY_S, hold_config
from experiments.following.shots import BEGIN_S, CAUSES, Fired, fire

# Goals for each target: least and largest value.
WANTED: Mapping[str, tuple[float, float]] = {
    "in_frame": (0.98, 1.0),
    "tpo_width": (0.0, 0.08),
    "corrected_width": (0.0, 0.02),
    "sum over measured": (0.85, 1.15),
}
SEEDS = "each seed"  # key of the figures of each seed's shots alone


@dataclass(frozen=True)
class FirstShotSettings(FieldSettings):
    """Settings: targets, with a shot every 0.8 s from the third second on.

    Attributes:
        targets: book, person or bird.
    """

    seeds: int = 2
    targets: tuple[str, ...] = ("book", "person", "bird")

    @property
    def lasting_s(self) -> tuple[float, float]:
        """Limits of a run's length [s].

        The first shot uses the fixed-camera frame of BEGIN_S, which arrives LATENCY_S later.
        """
        return BEGIN_S + LATENCY_S, super().lasting_s[1]


def one(calibration: Calibration, settings: FirstShotSettings, seed: int) -> list[Row]:
    """Shoot at each target; give a row per due shot."""
    rows: list[Row] = []
    for name in settings.targets:
        config = hold_config(name, seed)
        fired = fire(calibration, config, name, target_of(config, name), settings.seconds)
        rows += [{"seed": seed, "target": name, "fired": each is not None} | _row(each) for each in fired]
    return rows


def _row(fired: Fired | None) -> Row:
    """Make the row of one shot, with angles as fractions of the image's width; empty for a skipped shot."""
    if fired is None:
        return {}
    row = fired.row

    def of_width(angle: float) -> float:
        return math.tan(min(angle, 1.5)) * row.focal_px / row.width_px  # keep below a right angle

    return {
        "t_s": fired.shot.exposed_t,
        "on_target": fired.on_target,
        "in_frame": row.in_frame,
        "tpo_width": row.tpo_px / row.width_px,
        "size_ratio": row.size_ratio,
        "found": fired.found,
        "corrected_width": None if fired.corrected is None else fired.corrected.tpo_px / row.width_px,
        "measured": of_width(fired.missed),
        **{cause: of_width(part) for cause, part in fired.parts.items()},
    }


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Give the figures of all shots by target, with the budget: rms of each cause, their sum, and the measured error.

    The figures of each seed's shots alone are added, from least to largest.
    """
    found: dict[str, dict[str, Any]] = {}
    for name in dict.fromkeys(row["target"] for row in rows):
        mine = [row for row in rows if row["target"] == name]
        seeds = [
            _figures([row for row in mine if row["seed"] == seed])
            for seed in dict.fromkeys(row["seed"] for row in mine)
        ]
        by_seed = {key: spread_of(seed[key] for seed in seeds if not math.isnan(seed[key])) for key in seeds[0]}
        found[name] = {**_figures(mine), SEEDS: by_seed}
    return found


def _figures(rows: Sequence[Row]) -> dict[str, float]:
    shots = [row for row in rows if row["fired"]]
    hits = [row for row in shots if row["on_target"]]
    causes = {cause: rms(row[cause] for row in hits) for cause in CAUSES}
    total, measured = math.hypot(*causes.values()), rms(row["measured"] for row in hits)
    corrected = [math.inf if row["corrected_width"] is None else row["corrected_width"] for row in shots]
    return {
        "shots": len(shots),
        "not fired": len(rows) - len(shots),
        "in_frame": _of(np.mean, [row["in_frame"] for row in shots]),
        "tpo_width": _of(np.median, [row["tpo_width"] for row in shots]),
        "found": _of(np.mean, [row["found"] for row in shots]),
        "corrected_width": _of(np.median, corrected),
        **causes,
        "sum": total,
        "measured": measured,
        "sum over measured": total / measured,
    }


def _of(mean: Callable[[Sequence[float]], Any], values: Sequence[float]) -> float:
    """Apply a mean or median; nan of no values."""
    return float(mean(values)) if values else math.nan


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the figures that miss their goal."""
    return [
        f"{name}: {key}"
        for name, figures in summary.items()
        for key, (low, high) in WANTED.items()
        if not low <= figures[key] <= high
    ]


def describe(settings: FirstShotSettings, summary: Mapping[str, Any]) -> str:
    """Format a line per figure, a column per target."""
    keys = [key for key in next(iter(summary.values()), {}) if key != SEEDS]
    lines = [
        [
            f"{key}, rms" if key in (*CAUSES, "sum", "measured") else key,
            *(in_words(figures[SEEDS][key] | {"median": figures[key]}) for figures in summary.values()),
            "{:g}-{:g}".format(*WANTED[key]) if key in WANTED else "",
        ]
        for key in keys
    ]
    what = f"single shots, offsets over the width, of all (least to largest of one seed's), {seeds_of(settings)}"
    return f"{what}\n{table(('', *summary, 'wanted'), lines)}"


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Offsets of first shots and corrected ones, each seed's first shots thin; the budgets, least to largest seed."""
    left, right = figure.subplots(1, 2)
    shown = (*CAUSES, "sum", "measured")
    for i, (name, figures) in enumerate(summarise(rows).items()):
        mine, how = [row for row in rows if row["target"] == name and row["fired"]], {"color": f"C{i}"}
        for seed in dict.fromkeys(row["seed"] for row in mine):
            _draw(left, [row for row in mine if row["seed"] == seed], "tpo_width", lw=0.4, alpha=0.6, **how)
        _draw(left, mine, "tpo_width", label=name, **how)
        _draw(left, mine, "corrected_width", ls="--", label=f"{name}, corrected", **how)
        middle = [figures[key] for key in shown]
        low, high = ([figures[SEEDS][key][which] for key in shown] for which in ("least", "largest"))
        right.errorbar(
            np.arange(len(shown)) + BESIDE * i, middle, yerr=np.abs(np.subtract([low, high], middle)), fmt="o", **how
        )
    right.set_xticks(range(len(shown)), shown)
    left.set(xlabel="offset / width", ylabel="part of the shots", xlim=(0, 0.65))
    right.set(yscale="log", ylabel="rms / width")
    right.tick_params(axis="x", labelrotation=60)
    left.legend(frameon=False)


def _draw(ax: Axes, shots: Sequence[Row], key: str, **how: Any) -> None:
    """Plot the cumulative distribution of the shots' offsets."""
    offsets = np.sort([row[key] for row in shots if row[key] is not None])
    ax.plot(offsets, (np.arange(len(offsets)) + 1) / len(shots), **how)


SETTINGS = FirstShotSettings()
EXPERIMENT = Experiment(
    "first_shot",
    "How well a single shot from the fixed camera alone hits, and what a miss consists of.",
    SETTINGS,
    # Nine shots each. A bird's correction is bounded by the value reached, which misses the goal in the full run too.
    dataclasses.replace(SETTINGS, seeds=1, targets=("book", "bird"), seconds=10.0, calibrated=False),
    one,
    summarise,
    describe,
    plot,
    missed,
    prepare=calibrated,
    cost_s=120.0,
)
if __name__ == "__main__":
    sys.exit(EXPERIMENT.main())
