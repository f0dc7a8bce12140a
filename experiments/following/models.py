"""Simpler models of the related work against the full model, over depth and baseline.

Rigs are mounted by eye with given baselines (`experiments.following.mounted`). Each is calibrated from synthetic
corners; that calibration is the full model. The simpler models are described in `experiments.following.simpler`. Those
that neglect or misjudge a rotation are tested twice: unchanged, and `zeroed`, with pan and tilt set on one target.
Targets are spread over the fixed view. The pointing error is the angle between line of sight and target; in the
close-up it is a fraction of the image's width at the focal length that shows a bird of 0.8 m 160 px wide, within the
lens's range.

There are two conditions. `exact`: pixel and depth without error and a head without steps, for the error of the models
alone. `seen`: 0.5 px of noise in the pixel, 5 % in the depth, and head steps of 0.0514 degrees, the same for all
models.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cotarget.board import board_points
from cotarget.calibration import Options, calibrate_views
from cotarget.config import BoardConfig, SimHead
from cotarget.geometry import Array
from cotarget.schema import Positive
from experiments.calibration.synthetic.aims import looking_off
from experiments.calibration.synthetic.rig import SIZE, SIZES
from experiments.calibration.synthetic.views import Boards, Looks, Placing, spread_views
from experiments.engine import Count, Row, Settings
from experiments.following.mounted import MOUNTED_DEG, at, cell_name, mounted, off_px, wanted_focal_px
from experiments.following.simpler import CENTRING, FULL, IGNORED, MODELS, TABLE, TURNED, ZEROED, models_of
from experiments.tables import as_text, grouped, rms

BOARD = BoardConfig()
STEP = np.radians(SimHead().step_deg)
CONDITIONS = ("exact", "seen")
OPPONENTS = (IGNORED, ZEROED[IGNORED])
SHOWN = ((10.0, 0.4), (20.0, 1.5), (50.0, 0.4))  # depth and baseline [m] in the printed table
FACTOR = 5.0  # factor by which the full model has to be better than "offset ignored" somewhere


@dataclass(frozen=True)
class ModelsSettings(Settings):
    """Settings: rigs, calibration and targets."""

    seeds: Count = 10
    baselines: tuple[Positive, ...] = (0.1, 0.2, 0.4, 0.8, 1.5, 3.0)  # baselines of the rigs of each seed [m]
    depths: tuple[Positive, ...] = (5.0, 10.0, 20.0, 50.0, 100.0, 200.0)  # depths of the targets [m]
    targets: Count = 60  # number of targets at each depth
    mounted_deg: Positive = MOUNTED_DEG  # standard deviation of each mounting angle that should be zero [degrees]
    boards: Boards = 12  # placements of the calibration board
    looks: Looks = 4  # head poses per placement
    corner_px: Positive = 0.2  # noise of corners [px]
    pixel_px: Positive = 0.5  # noise of the target's pixel [px]
    depth_error: Positive = 0.05  # relative error of the target's depth
    zero_depth: Positive = CENTRING.zero_depth  # depth of the target on which pan and tilt are set [m]


def reach(depth: float, baseline: float, zero_depth: float = math.inf) -> float:
    """Compute a target's distance in baselines, as far as an ignored offset is concerned.

    The baseline subtends an angle of 1 / this [rad] at the target, or that angle less the one at the target of the
    zeros.
    """
    angle = baseline * abs(1 / depth - 1 / zero_depth)
    return 1 / angle if angle else math.inf


def ratios(rows: Sequence[Row], condition: str, model: str = IGNORED) -> dict[float, Array]:
    """Give the ratio of a model's rms error to the full model's, by `reach`.

    Returns:
        For each reach in rising order, the ratio of each seed; of several depths and baselines with the same reach, the
        one with the least median.
    """
    errors = {(r["depth_m"], r["baseline_m"], r["seed"]): r[f"{condition}_deg"] for r in rows if r["model"] == FULL}
    cells: dict[tuple[float, float, float], list[float]] = {}
    for row in rows:
        if row["model"] == model:
            cell = row["depth_m"], row["baseline_m"]
            cells.setdefault((row["reach"], *cell), []).append(row[f"{condition}_deg"] / errors[*cell, row["seed"]])
    found: dict[float, Array] = {}
    for (far, *_), values in sorted(cells.items()):
        same = next((known for known in found if math.isclose(known, far)), far)
        found[same] = min(found.get(same, np.array(values)), np.array(values), key=np.median)
    return found


def regime(rows: Sequence[Row], condition: str, model: str = IGNORED) -> tuple[float, float]:
    """Give the range of `reach` in which the full model's error is FACTOR times smaller than another's.

    Returns:
        The smallest reach measured, and the largest up to which the median over the seeds holds for all cells; both nan
        where it does not hold at the smallest.
    """
    within: list[float] = []
    for far, values in ratios(rows, condition, model).items():
        if np.median(values) < FACTOR:
            break
        within.append(far)
    return (within[0], within[-1]) if within else (math.nan, math.nan)


def one(settings: ModelsSettings, seed: int) -> list[Row]:
    """Draw a rig of each baseline; give a row per depth and model."""
    return [row for i in range(len(settings.baselines)) for row in _of_rig(settings, seed, i)]


def _of_rig(settings: ModelsSettings, seed: int, number: int) -> list[Row]:
    rng = np.random.default_rng((seed, 21, number))
    baseline = settings.baselines[number]
    truth = mounted(rng, baseline, settings.mounted_deg)
    placing = Placing(boards=settings.boards, looks=settings.looks)
    views = spread_views(truth, board_points(BOARD), rng, settings.corner_px, placing)
    calibration = calibrate_views(views, BOARD, SIZES, options=Options(folds=0))
    models = models_of(truth, calibration, rng, centring=replace(CENTRING, zero_depth=settings.zero_depth))
    rows: list[Row] = []
    for depth in settings.depths:
        pixels, depths = rng.uniform(0, np.array(SIZE) - 1.0, (settings.targets, 2)), np.full(settings.targets, depth)
        x_fixed = at(truth, pixels, depths)
        seen_px = pixels + rng.normal(0, settings.pixel_px, pixels.shape)
        seen_depths = depths * np.exp(rng.normal(0, settings.depth_error, depths.shape))
        focal_px = wanted_focal_px(truth, x_fixed)
        exactly, as_seen = models.poses(pixels, depths), models.poses(seen_px, seen_depths)
        for name in MODELS:
            exact = looking_off(truth, x_fixed, exactly[name])
            seen = looking_off(truth, x_fixed, np.round(as_seen[name] / STEP) * STEP)
            row = {"seed": seed, "baseline_m": baseline, "depth_m": depth, "model": name}
            row["reach"] = reach(depth, baseline, settings.zero_depth if name in ZEROED.values() else math.inf)
            rows.append(row | _figures("exact", exact, focal_px) | _figures("seen", seen, focal_px))
    return rows


def _figures(condition: str, angles: Array, focal_px: Array) -> Row:
    """Compute the figures at one depth; a model without a solution counts as off by a right angle."""
    lost = np.isnan(angles)
    angles = np.where(lost, np.pi / 2, angles)
    return {
        f"{condition}_deg": float(np.degrees(rms(angles))),
        f"{condition}_width": float(np.median(off_px(angles, focal_px)) / SIZE[0]),
    }


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Give medians over the seeds of each model's error by condition, depth and baseline, and the regime."""
    summary: dict[str, Any] = {}
    for condition in CONDITIONS:
        cells: dict[str, dict[str, dict[str, float]]] = {}
        for (depth, baseline), mine in grouped(rows, "depth_m", "baseline_m").items():
            cells[cell_name(depth, baseline)] = {
                name: {key: float(np.median([row[f"{condition}_{key}"] for row in each])) for key in ("deg", "width")}
                for name, each in grouped(mine, "model").items()
            }
        summary[condition] = {
            "errors": cells,
            "regime": {
                name: dict(zip(("from", "to"), regime(rows, condition, name), strict=True)) for name in OPPONENTS
            },
        }
    summary["of"] = {"seeds": len({row["seed"] for row in rows})}
    return summary


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the conditions without a regime in which the full model is FACTOR times better than "offset ignored"."""
    return [
        f"{condition}: full model {FACTOR:g} times better than {name}"
        for condition in CONDITIONS
        for name in OPPONENTS
        if math.isnan(summary[condition]["regime"][name]["to"])
    ]


def bounded(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Give each model's errors; a bound keeps a simpler model from getting worse, which would favour the full one."""
    return {
        condition: {
            name: {cell: found[name]["deg"] for cell, found in summary[condition]["errors"].items()} for name in MODELS
        }
        for condition in CONDITIONS
    }


def _up_to(reach: float) -> str:
    return "on" if math.isinf(reach) else f"to {reach:.4g}"


def describe(settings: ModelsSettings, summary: Mapping[str, Any]) -> str:
    """Format the errors at some depths and baselines, a line a model, and the regimes."""
    found: dict[str, Any] = {"regime": {condition: summary[condition]["regime"] for condition in CONDITIONS}}
    for condition in CONDITIONS:
        errors = summary[condition]["errors"]
        for cell in [cell for pair in SHOWN if (cell := cell_name(*pair)) in errors] or list(errors)[:3]:
            for name, each in errors[cell].items():
                found.setdefault(f"{condition}, {cell}", {})[name] = each["deg"]
    return f"rms pointing error [degrees]; zeroed on a target at {settings.zero_depth:g} m\n" + as_text(found)


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Each model's error over depth at one baseline, as they are and zeroed; and the regimes."""
    figure.set_size_inches(14, 10)
    baselines = sorted({row["baseline_m"] for row in rows})
    near = min(baselines, key=lambda b: abs(b - SHOWN[0][1]))
    axes = figure.subplots(2, 3)
    colours = {name: f"C{i}" for i, name in enumerate((*TURNED, TABLE))} | {FULL: "k"}
    for line, names, words in (
        (axes[0], {name: name for name in (FULL, *TURNED, TABLE)}, ""),
        (axes[1], {FULL: FULL} | ZEROED, ", zeroed"),
    ):
        for ax, condition in zip(line, CONDITIONS, strict=False):
            for i, (name, model) in enumerate(names.items()):
                mine = [row for row in rows if row["model"] == model and row["baseline_m"] == near]
                _over_depth(ax, mine, f"{condition}_deg", i, color=colours[name], label=model)
            ax.set(xscale="log", yscale="log", xlabel="depth [m]", title=f"{condition}{words}, baseline {near:g} m")
            ax.sharey(axes[0, 0])
        line[0].set_ylabel("rms pointing error [degrees]")
        line[1].legend(loc="lower left", frameon=False, fontsize="small")
    for ax, model in zip(axes[:, 2], OPPONENTS, strict=True):
        _regimes(ax, rows, model)
    axes[0, 2].set_xlabel("depth / baseline")
    axes[1, 2].set_xlabel("1 / (baseline |1 / depth - 1 / depth of the zero|)")


def _over_depth(ax: Axes, rows: Sequence[Row], key: str, number: int, **style: Any) -> None:
    """Plot one model's medians and quartiles over the seeds, shifted and thinner by its number."""
    found = sorted(grouped(rows, "depth_m").items())
    low, mid, high = np.array([np.percentile([row[key] for row in mine], [25, 50, 75]) for _, mine in found]).T
    depths = [depth * 1.03 ** (number - 3) for depth, _ in found]
    style |= {"ls": "-" if number % 2 == 0 else "--", "lw": 3 - number / 3}
    ax.errorbar(depths, mid, [mid - low, high - mid], fmt="o", ms=4, capsize=2, **style)


def _regimes(ax: Axes, rows: Sequence[Row], model: str) -> None:
    """Plot the ratio of a model's error to the full model's, quartiles over the seeds, and the regime of FACTOR."""
    for condition, colour in zip(CONDITIONS, ("C0", "C1"), strict=True):
        by_reach = {far: values for far, values in ratios(rows, condition, model).items() if math.isfinite(far)}
        if not by_reach:  # all targets are at the depth of the zeros
            continue
        low, mid, high = np.array([np.percentile(values, [25, 50, 75]) for values in by_reach.values()]).T
        error = [mid - low, high - mid]
        ax.errorbar(list(by_reach), mid, error, fmt="o", ms=4, capsize=2, color=colour, label=condition)
        begin, end = regime(rows, condition, model)
        if end >= begin:
            label = f"{condition}: {FACTOR:g} x and more from {begin:.3g} {_up_to(end)}"
            ax.axvspan(begin, min(end, max(by_reach)), color=colour, alpha=0.12, label=label)
    ax.axhline(FACTOR, color="k", lw=0.8)
    ax.set(xscale="log", yscale="log", ylabel="times the error of the full model", title=model)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(frameon=False, fontsize="small")


SETTINGS = ModelsSettings()
QUICK = replace(SETTINGS, seeds=2, baselines=(0.4, 1.5), depths=(10.0, 50.0, 200.0), targets=20, boards=10)
COST_S = 10.0
