"""What the models of the related work lose beside the full one, over depth and baseline.

Rigs are mounted by eye (`experiments.mounted`), their baselines given; each is calibrated from synthetic corners, and
that calibration is the full model. The others (`experiments.simpler`) know less. Targets lie all over the wide view.
The pointing error is the angle between the line of sight and the true target; in the close-up it is a part of the
image's width at the focal length at which a bird of 0.8 m is 160 px wide, within the lens's range.

Twice: `exact`, pixel and depth given as they are, the head without steps: what the models alone lose; and `seen`, the
pixel with 0.5 px of noise, the depth with 5 %, the head in steps of 0.0514 degrees, the same for all models.

    python -m experiments.models [--seeds 20] [--seed-base 0] [--processes P] [--quick] [--out DIR]
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cotarget.calibration import Options, calibrate_views
from cotarget.calibration.boards import board_points
from cotarget.config import BoardConfig
from cotarget.geometry import Array
from cotarget.simconfig import SimHead
from experiments.harness import Experiment, Row, Settings, rms, seeds_of, table
from experiments.mounted import MOUNTED_DEG, at, check_above, mounted, off_px, wanted_focal_px
from experiments.simpler import FULL, IGNORED, MODELS, models_of
from experiments.synthetic import SIZE, SIZES, Placing, looking_off, spread_views

BOARD = BoardConfig()
STEP = np.radians(SimHead().step_deg)
CONDITIONS = ("exact", "seen")
FACTOR = 5.0  # by which the full model is to beat "offset ignored" somewhere
SHOWN = ((10.0, 0.4), (20.0, 1.5), (50.0, 0.4))  # depth and baseline [m] of the printed table


@dataclass(frozen=True)
class ModelsSettings(Settings):
    """What is mounted, how it is calibrated, and what is looked at.

    Attributes:
        baselines: of the rigs of each seed [m].
        depths: of the targets [m].
        targets: at each depth.
        mounted_deg: standard deviation of each angle of a mounting that should be zero [degrees].
        boards: placements of the calibration's board, each looked at from `looks` head poses.
        looks: head poses.
        corner_px: noise of corners [px].
        pixel_px: noise of the target's pixel [px].
        depth_error: relative error of its depth.
    """

    seeds: int = 20
    baselines: tuple[float, ...] = (0.1, 0.2, 0.4, 0.8, 1.5, 3.0)
    depths: tuple[float, ...] = (5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
    targets: int = 60
    mounted_deg: float = MOUNTED_DEG
    boards: int = 12
    looks: int = 4
    corner_px: float = 0.2
    pixel_px: float = 0.5
    depth_error: float = 0.05

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        super().__post_init__()
        check_above(0, self, "baselines", "depths", "targets", "boards", "looks")
        check_above(0, self, "mounted_deg", "corner_px", "pixel_px", "depth_error")


def one(_: None, settings: ModelsSettings, seed: int) -> list[Row]:
    """A rig of each baseline; a row for each depth and model."""
    return [row for i in range(len(settings.baselines)) for row in _of_rig(settings, seed, i)]


def _of_rig(settings: ModelsSettings, seed: int, number: int) -> list[Row]:
    rng = np.random.default_rng((seed, 21, number))
    baseline = settings.baselines[number]
    truth = mounted(rng, baseline, settings.mounted_deg)
    placing = Placing(boards=settings.boards, looks=settings.looks)
    views = spread_views(truth, board_points(BOARD), rng, settings.corner_px, placing)
    models = models_of(truth, calibrate_views(views, BOARD, SIZES, options=Options(folds=0)), rng)
    rows: list[Row] = []
    for depth in settings.depths:
        pixels, depths = rng.uniform(0, np.array(SIZE) - 1.0, (settings.targets, 2)), np.full(settings.targets, depth)
        x_fixed = at(truth, pixels, depths)
        seen_px = pixels + rng.normal(0, settings.pixel_px, pixels.shape)
        seen_depths = depths * np.exp(rng.normal(0, settings.depth_error, depths.shape))
        focal_px = wanted_focal_px(truth, x_fixed)
        for name, model in models.items():
            exact = looking_off(truth, x_fixed, model(pixels, depths))
            seen = looking_off(truth, x_fixed, np.round(model(seen_px, seen_depths) / STEP) * STEP)
            row = {"seed": seed, "baseline_m": baseline, "depth_m": depth, "model": name}
            rows.append(row | _figures("exact", exact, focal_px) | _figures("seen", seen, focal_px))
    return rows


def _figures(condition: str, angles: Array, focal_px: Array) -> Row:
    """Of the errors at one depth; a model that finds no pose has lost its target."""
    lost = np.isnan(angles)
    angles = np.where(lost, np.pi / 2, angles)
    return {
        f"{condition}_deg": float(np.degrees(rms(angles))),
        f"{condition}_width": float(np.median(off_px(angles, focal_px)) / SIZE[0]),
    }


def ratios(rows: Sequence[Row], condition: str, model: str = IGNORED) -> dict[tuple[float, float], Array]:
    """By how much a model's rms error is larger than the full model's: of each seed, by (depth, baseline) [m]."""
    errors = {(r["seed"], r["depth_m"], r["baseline_m"], r["model"]): r[f"{condition}_deg"] for r in rows}
    found: dict[tuple[float, float], list[float]] = {}
    for (seed, depth, baseline, name), error in errors.items():
        if name == model:
            found.setdefault((depth, baseline), []).append(error / errors[seed, depth, baseline, FULL])
    return {cell: np.array(values) for cell, values in found.items()}


def regime(rows: Sequence[Row], condition: str) -> tuple[float, float]:
    """The depths over baselines up to which the full model's error is FACTOR times smaller than "offset ignored".

    Returns:
        The smallest depth over baseline measured, and the largest up to which the median over the seeds of every
        depth and baseline says so; both nan where even the smallest does not.
    """
    by_cell = ratios(rows, condition)
    by_reach = [(_reach(cell), float(np.median(by_cell[cell]))) for cell in sorted(by_cell, key=_reach)]
    within: list[float] = []
    for reach, ratio in by_reach:
        if ratio < FACTOR:
            break
        within.append(reach)
    return (within[0], within[-1]) if within else (float("nan"), float("nan"))


def _reach(cell: tuple[float, float]) -> float:
    """Depth over baseline."""
    depth, baseline = cell
    return depth / baseline


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Medians over the seeds of each model's error by condition, depth and baseline, and the regime."""
    summary: dict[str, Any] = {}
    for condition in CONDITIONS:
        cells: dict[str, dict[str, dict[str, float]]] = {}
        for depth, baseline in dict.fromkeys((row["depth_m"], row["baseline_m"]) for row in rows):
            mine = [row for row in rows if (row["depth_m"], row["baseline_m"]) == (depth, baseline)]
            cells[_cell(depth, baseline)] = {
                name: {key: float(np.median(_of(mine, name, f"{condition}_{key}"))) for key in ("deg", "width")}
                for name in MODELS
            }
        low, high = regime(rows, condition)
        summary[condition] = {
            "errors": cells,
            "regime": {"depth_over_baseline_from": low, "depth_over_baseline_to": high},
            "smallest_ratio": min(float(np.median(v)) for v in ratios(rows, condition).values()),
        }
    summary["of"] = {"seeds": len({row["seed"] for row in rows})}
    return summary


def _of(rows: Sequence[Row], model: str, key: str) -> list[float]:
    return [row[key] for row in rows if row["model"] == model]


def _cell(depth: float, baseline: float) -> str:
    return f"depth {depth:g} m, baseline {baseline:g} m"


def missed(summary: Mapping[str, Any]) -> list[str]:
    """The conditions in which no regime was found where the full model beats "offset ignored" as wanted."""
    lacking = [c for c in CONDITIONS if not np.isfinite(summary[c]["regime"]["depth_over_baseline_to"])]
    return [f"{condition}: full model {FACTOR:g} times better than {IGNORED}" for condition in lacking]


def bounded(summary: Mapping[str, Any]) -> dict[str, Any]:
    """The full model's errors, and the regimes."""
    return {
        condition: {
            "full_deg": {cell: found[FULL]["deg"] for cell, found in summary[condition]["errors"].items()},
            "regime_to": summary[condition]["regime"]["depth_over_baseline_to"],
        }
        for condition in CONDITIONS
    }


def describe(settings: ModelsSettings, summary: Mapping[str, Any]) -> str:
    """A line a model, a column for each depth and baseline, in degrees and in % of the close-up's width."""
    texts = []
    for condition in CONDITIONS:
        errors = summary[condition]["errors"]
        cells = [cell for pair in SHOWN if (cell := _cell(*pair)) in errors] or list(errors)[:3]
        lines = [
            [name, *(value for c in cells for value in (errors[c][name]["deg"], 100 * errors[c][name]["width"]))]
            for name in MODELS
        ]
        head = [
            "model",
            *(text for cell in cells for text in (cell.replace("depth ", "").replace("baseline ", ""), "% width")),
        ]
        found = summary[condition]["regime"]
        texts += [
            f"{condition}: rms pointing error [degrees] and median offset in the close-up [% of its width]",
            table(head, lines),
            f"at least {FACTOR:g} times better than with the offset ignored: depth over baseline "
            f"{found['depth_over_baseline_from']:.3g} to {found['depth_over_baseline_to']:.4g}",
        ]
    return "\n".join([f"medians over {seeds_of(settings)}", *texts])


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Each model's error over depth at one baseline, and the ratio over depth / baseline, quartiles over the seeds."""
    figure.set_size_inches(14, 5.5)
    baselines = sorted({row["baseline_m"] for row in rows})
    near = min(baselines, key=lambda b: abs(b - SHOWN[0][1]))
    left, middle, right = figure.subplots(1, 3)
    for ax, condition in ((left, "exact"), (middle, "seen")):
        for model in MODELS:
            mine = [row for row in rows if row["model"] == model and row["baseline_m"] == near]
            depths = sorted({row["depth_m"] for row in mine})
            values = [[row[f"{condition}_deg"] for row in mine if row["depth_m"] == depth] for depth in depths]
            low, mid, high = np.array([np.percentile(v, [25, 50, 75]) for v in values]).T
            style = {"color": "k", "lw": 2} if model == FULL else {}
            ax.errorbar(depths, mid, [mid - low, high - mid], capsize=2, label=model, **style)
        ax.set(xscale="log", yscale="log", xlabel="depth [m]", title=f"{condition}, baseline {near:g} m")
    left.set_ylabel("rms pointing error [degrees]")
    middle.sharey(left)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=len(MODELS), frameon=False)
    for condition, colour in zip(CONDITIONS, ("C0", "C1"), strict=True):
        by_cell = ratios(rows, condition)
        cells = sorted(by_cell, key=_reach)
        reach = [_reach(cell) for cell in cells]
        low, mid, high = np.array([np.percentile(by_cell[cell], [25, 50, 75]) for cell in cells]).T
        right.errorbar(reach, mid, [mid - low, high - mid], fmt="o", ms=4, capsize=2, color=colour, label=condition)
        begin, end = regime(rows, condition)
        if np.isfinite(end):
            right.axvspan(begin, end, color=colour, alpha=0.12, label=f"{condition}: 5 x and more up to {end:.4g}")
    right.axhline(FACTOR, color="k", lw=0.8)
    right.set(
        xscale="log", yscale="log", xlabel="depth / baseline", ylabel=f"error with the {IGNORED} / of the full model"
    )
    right.legend(frameon=False, fontsize="small")


SETTINGS = ModelsSettings()
EXPERIMENT = Experiment(
    "models",
    "What the models of the related work lose beside the full one, over depth and baseline.",
    SETTINGS,
    replace(SETTINGS, seeds=2, baselines=(0.4, 1.5), depths=(10.0, 50.0, 200.0), targets=20, boards=10),
    one,
    summarise,
    describe,
    plot,
    missed,
    cost_s=6.0,
    bounded=bounded,
)

if __name__ == "__main__":
    sys.exit(EXPERIMENT.main())
