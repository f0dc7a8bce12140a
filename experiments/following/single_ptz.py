"""Single pan-tilt-zoom camera that finds and follows its target by itself, against the pair.

The scene is the field of `experiments.following.field_scenes` without clutter: the same head, lens, delays, paths and
sizes, and a rig known exactly. Nothing is rendered. Detections are ground truth with a detector's noise
(`cotarget.evaluation`): in the fixed camera for the pair, in its own view for the single camera
(`experiments.following.lone_camera`). Both use the same tracker with the settings of a detector by appearance, because
the single camera has no static background. The pair finds the target in its zoom view besides. While head or lens move,
the zoom camera misses more detections: 5 %, as at rest, 50 % or 90 %, for the pair's zoom view too.

Ground truth judges both. The clock starts when the target is wholly in the fixed view, after the first 2 s. Until then
neither searches: the head points in a random direction of the fixed view, at the shortest focal length, so that the
target has to be found. The single camera also loses the overview: `watched` is the area of its view over that of the
fixed camera's, which is 1 for the pair.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt, Interval, Le
from matplotlib.figure import Figure

from cotarget.config import SimConfig
from cotarget.metrics import BACKGROUND_S, score
from cotarget.metrics import Row as Judged
from cotarget.schema import Positive
from cotarget.sim.targets.random_paths import LONE, SECONDS
from experiments.engine import Count, Row, Settings
from experiments.following.single_runs import PAIR, WAYS, held
from experiments.tables import bars, grouped, mean_of

WIDE_PX = SimConfig().fixed.focal_px[0]
LEAST_MISS = 0.05
HELD = 0.85  # least in-frame ratio of both if hardly anything is missed
FIGURES = ("closeup_yield", "in_frame_ratio", "in_frame_of_all", "tpo_width_median", "watched")


@dataclass(frozen=True)
class SingleSettings(Settings):
    """Settings: runs and detection losses."""

    seeds: Count = 6
    seconds: Annotated[float, Gt(BACKGROUND_S), Le(SECONDS)] = SECONDS  # length of each run [s]
    targets: tuple[str, ...] = LONE  # book, person or bird
    # Fractions of zoom frames in which the target is missed while the image moves.
    misses: tuple[Annotated[float, Interval(ge=0, le=1)], ...] = (0.05, 0.5, 0.9)
    # Duration of the single camera's manoeuvres [s] (see `experiments.following.lone_camera`); by default that of each
    # target.
    lasts_s: Positive | None = None


def one(settings: SingleSettings, seed: int) -> list[Row]:
    """Run each target with the pair and with the single camera; give a row per run."""
    rows: list[Row] = []
    for name in settings.targets:
        for way in WAYS:
            for miss in settings.misses:
                judged = held(way, name, seed, settings.seconds, miss, settings.lasts_s)
                rows.append({"seed": seed, "target": name, "way": case(way, miss)} | figures(judged, way))
    return rows


def case(way: str, miss: float) -> str:
    """Name a way with a fraction of missed zoom frames while the image moves."""
    return f"{way}, misses {100 * miss:g} %"


def figures(judged: Sequence[Judged], way: str) -> Row:
    """Compute the figures of one run; None for what never occurred, such as an acquisition."""
    found = score(judged)
    since = judged[-found.frames :] if found.frames else []
    return {
        "closeup_yield": found.closeup_yield,
        "in_frame_ratio": found.in_frame_ratio if found.in_frame_ratio is not None else 0.0,
        "in_frame_of_all": float(np.mean([row.in_frame for row in since])) if since else None,
        "time_to_acquire_s": found.time_to_acquire_s,
        "tpo_width_median": found.tpo_width_median,
        "watched": _watched(since, way),
    }


def _watched(since: Sequence[Judged], way: str) -> float | None:
    """Compute the mean area of the view over the fixed camera's; None without frames."""
    if way == PAIR:
        return 1.0
    return float(np.mean([min(1.0, (WIDE_PX / row.focal_px) ** 2) for row in since])) if since else None


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """Give means over the seeds with standard errors by target and way, and quartiles of the time to acquire."""
    summary: dict[str, dict[str, dict[str, float]]] = {}
    for (name, way), mine in grouped(rows, "target", "way").items():
        found: dict[str, float] = {}
        for key in FIGURES:
            found[key], found[f"{key}_error"] = mean_of(_told(mine, key))
        times = [math.inf if row["time_to_acquire_s"] is None else row["time_to_acquire_s"] for row in mine]
        at = dict(zip(("low", "median", "high"), np.quantile(times, (0.25, 0.5, 0.75), method="nearest"), strict=True))
        found |= {f"time_to_acquire_s_{part}": float(value) for part, value in at.items()}
        summary.setdefault(name, {})[way] = found | {"never_acquired": float(np.mean(np.isinf(times)))}
    return summary


def _told(rows: Sequence[Row], key: str) -> list[float]:
    """Collect a figure's values from the rows that have it."""
    return [float(row[key]) for row in rows if row[key] is not None]


def bounded(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Give every close-up yield; a bound keeps the single camera's from falling, which would favour the pair."""
    return {name: {way: v["closeup_yield"] for way, v in ways.items()} for name, ways in summary.items()}


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List where a target is not acquired and kept although hardly anything is missed.

    Then one of the two cameras is not at its best, and the comparison is not fair.
    """
    return [
        f"{name}, {way}: {what}"
        for name, ways in summary.items()
        for way, found in ways.items()
        if way in {case(each, LEAST_MISS) for each in WAYS}
        for what, bad in (
            (f"in frame {found['in_frame_ratio']:.2f}", not found["in_frame_ratio"] >= HELD),
            ("not acquired in every run", found["never_acquired"] > 0),
        )
        if bad
    ]


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Close-up yield, frames in frame and time to acquire of each way: seeds as points, means with errors as bars."""
    targets, ways = (list(dict.fromkeys(row[key] for row in rows)) for key in ("target", "way"))
    figure.set_size_inches(14, 4.8)
    labels = {
        "closeup_yield": "close-up yield",
        "in_frame_of_all": "in frame, of all frames",
        "time_to_acquire_s": "time to acquire, where it was [s]",
    }
    shades = np.linspace(0.95, 0.35, len(ways) // len(WAYS))
    styles = [{"color": f"C{i}", "alpha": float(shade)} for i in range(len(WAYS)) for shade in shades]
    for ax, (key, label) in zip(figure.subplots(1, 3), labels.items(), strict=True):
        for i, way in enumerate(ways):
            mine = [[r for r in rows if (r["target"], r["way"]) == (name, way)] for name in targets]
            x = np.arange(len(targets)) + (i - (len(ways) - 1) / 2) * 0.8 / len(ways)
            bars(ax, x.tolist(), [_told(each, key) for each in mine], 0.75 / len(ways), label=way, **styles[i])
        ax.set(ylabel=label, ylim=(0, None if key.endswith("_s") else 1.02))
        ax.set_xticks(range(len(targets)), targets)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)


SETTINGS = SingleSettings()
QUICK = replace(SETTINGS, seeds=1, seconds=8.0, targets=("person", "bird"), misses=(0.05, 0.9))
COST_S = 30.0
