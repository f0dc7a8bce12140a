"""The exact range beside the paper's shortcut over the wide view: where a depth in the range's place fails.

Rigs are mounted by eye (`experiments.mounted`) at a baseline of 0.4 m, as the default one, on a head whose axes cross
at a right angle, with the zoom camera's axis in the middle of its image: the shortcut takes both for granted. They are
known exactly. Targets stand on a grid over the wide
image at several depths. Each is aimed at by `cotarget.targeting.aim` with the exact range and with both readings of the
shortcut; the error is the angle between the line of sight and the target, and what that is in pixels at the focal
length at which the paper's book of 0.234 m is 160 px wide, within the lens's range: 7155 px at 10.5 m and beyond. Off
the axis means off the zoom camera's at home.

    python -m experiments.shortcut [--seeds 20] [--seed-base 0] [--processes P] [--quick] [--out DIR]
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cotarget.config import DEFAULT_TARGETS
from cotarget.errors import UnreachableError
from cotarget.geometry import Array
from cotarget.targeting import METHODS, Method, Reach, aim
from experiments.harness import Experiment, Row, Settings, rms, seeds_of, table
from experiments.mounted import at, check_above, exact_calibration, idealised, mounted, off_px, wanted_focal_px
from experiments.synthetic import LONGEST_PX, NOMINAL_PX, SIZE, looking_off

BOOK = DEFAULT_TARGETS["book"]
ANYWHERE = (-np.pi, np.pi)  # both axes: what a head's limits forbid is no matter of the range
EXACT, TABLE, EXAMPLE = METHODS
NAMES: Mapping[Method, str] = {EXACT: "exact range", TABLE: "depth of Table 1", EXAMPLE: "depth of Section 4.2"}
NEAR_DEG, AT_DEG, AROUND_DEG = 4.0, 20.0, 2.0  # off the axis: near it; at 20 degrees, within these
REGIONS = ("near the axis", "at 20 degrees", "whole view")
# What paper.md estimates of a rig of that kind: degrees near the axis by reading, degrees at 20 degrees, px over all.
ESTIMATES = {"near the axis": {TABLE: "0.3", EXAMPLE: "0.02"}, "at 20 degrees": {TABLE: "> 1", EXAMPLE: "> 1"}}
ROUNDING_DEG = 1e-6  # arctan2 tells no smaller angles from zero


@dataclass(frozen=True)
class ShortcutSettings(Settings):
    """Which rigs, and where targets stand.

    Attributes:
        baseline: of the rigs [m].
        depths: of the targets [m].
        grid: columns and rows of their pixels in the wide image, from edge to edge.
    """

    seeds: int = 20
    baseline: float = 0.4
    depths: tuple[float, ...] = (5.0, 10.0, 20.0, 50.0)
    grid: tuple[int, int] = (13, 9)

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        super().__post_init__()
        check_above(0, self, "baseline", "depths")
        check_above(1, self, "grid")


def one(_: None, settings: ShortcutSettings, seed: int) -> list[Row]:
    """A rig; a row for each target, with the error of each method."""
    truth = idealised(mounted(np.random.default_rng((seed, 22)), settings.baseline))
    calibration = exact_calibration(truth)
    reach = Reach(ANYWHERE, ANYWHERE, (NOMINAL_PX, LONGEST_PX))
    columns, rows_px = (np.linspace(0.0, side - 1.0, count) for side, count in zip(SIZE, settings.grid, strict=True))
    pixels = np.stack(np.meshgrid(columns, rows_px), axis=-1).reshape(-1, 2)
    rows: list[Row] = []
    for depth in settings.depths:
        x_fixed = at(truth, pixels, depth)
        x_zoom0 = truth.gamma.apply(x_fixed)
        off_axis = np.degrees(np.arctan2(np.linalg.norm(x_zoom0[:, :2], axis=1), x_zoom0[:, 2]))
        focal_px = wanted_focal_px(truth, x_fixed, BOOK.size, BOOK.wanted_px)
        errors = {}
        for method in METHODS:
            q = np.array([_aimed(calibration, x, reach, method) for x in x_fixed])
            errors[method] = looking_off(truth, x_fixed, q)
        rows += [
            {
                "seed": seed,
                "depth_m": depth,
                "u_px": float(pixels[i, 0]),
                "v_px": float(pixels[i, 1]),
                "off_axis_deg": float(off_axis[i]),
                "focal_px": float(focal_px[i]),
                **{f"{method}_deg": float(np.degrees(errors[method][i])) for method in METHODS},
            }
            for i in range(len(pixels))
        ]
    return rows


def _aimed(calibration: Any, x_fixed: Array, reach: Reach, method: Method) -> tuple[float, float]:
    """Pan and tilt [rad]; nan where the method has no solution."""
    try:
        found = aim(calibration, x_fixed, reach, method=method)
    except UnreachableError:
        return np.nan, np.nan
    return found.pan, found.tilt


def region(row: Row, name: str) -> bool:
    """Whether a target is in one of REGIONS."""
    off: float = row["off_axis_deg"]
    return {REGIONS[0]: off <= NEAR_DEG, REGIONS[1]: abs(off - AT_DEG) <= AROUND_DEG, REGIONS[2]: True}[name]


def px(row: Row, method: Method) -> float:
    """A target's error at the wanted focal length [px]."""
    return float(off_px(np.radians(row[f"{method}_deg"]), row["focal_px"]))


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """By method, region and depth: rms over the targets of a seed, median and quartiles of that over the seeds."""
    summary: dict[str, Any] = {}
    for method in METHODS:
        summary[method] = {}
        for name in REGIONS:
            mine = [row for row in rows if region(row, name)]
            depths = {f"{depth:g} m": [r for r in mine if r["depth_m"] == depth] for depth in _depths(rows)}
            summary[method][name] = {key: _figures(found, method) for key, found in ({"all": mine} | depths).items()}
        unsolved = [not np.isfinite(row[f"{method}_deg"]) for row in rows]
        summary[method]["unsolved"] = float(np.mean(unsolved))
    return summary


def _depths(rows: Sequence[Row]) -> list[float]:
    return list(dict.fromkeys(row["depth_m"] for row in rows))


def _figures(rows: Sequence[Row], method: Method) -> dict[str, float]:
    seeds: dict[int, list[Row]] = {}
    for row in rows:
        seeds.setdefault(row["seed"], []).append(row)
    degrees = [rms(row[f"{method}_deg"] for row in mine) for mine in seeds.values()]
    pixels = [rms(px(row, method) for row in mine) for mine in seeds.values()]
    low, middle, high = np.nanpercentile(degrees, [25, 50, 75])
    return {
        "deg": float(middle),
        "deg_low": float(low),
        "deg_high": float(high),
        "worst_deg": float(np.nanmax([row[f"{method}_deg"] for row in rows])),
        "px": float(np.nanmedian(pixels)),
    }


def missed(summary: Mapping[str, Any]) -> list[str]:
    """Whether the exact range is not exact, or has no solution somewhere."""
    exact = summary[EXACT]
    return [
        text
        for text, bad in (
            (f"exact range: {exact['whole view']['all']['worst_deg']:g} degrees", _worst(summary) > ROUNDING_DEG),
            ("exact range: no solution somewhere", exact["unsolved"] > 0),
        )
        if bad
    ]


def _worst(summary: Mapping[str, Any]) -> float:
    return float(summary[EXACT]["whole view"]["all"]["worst_deg"])


def bounded(summary: Mapping[str, Any]) -> dict[str, Any]:
    """What each reading of the shortcut errs by [degrees]; the exact range's rounding is nobody's bound."""
    readings = (TABLE, EXAMPLE)
    return {method: {name: summary[method][name]["all"]["deg"] for name in REGIONS} for method in readings}


def describe(settings: ShortcutSettings, summary: Mapping[str, Any]) -> str:
    """A line for each region and depth."""
    head = ["where", *(text for name in NAMES.values() for text in (f"{name} [deg]", "px")), "paper.md, Table 1 / 4.2"]
    lines = []
    for name in REGIONS:
        for depth in summary[EXACT][name]:
            cells = [
                value
                for m in METHODS
                for value in (f"{summary[m][name][depth]['deg']:.2g}", summary[m][name][depth]["px"])
            ]
            told = ESTIMATES.get(name) if depth == "all" else None
            lines.append([f"{name}, {depth}", *cells, f"{told[TABLE]} / {told[EXAMPLE]}" if told else ""])
    unsolved = ", ".join(f"{NAMES[m]} {100 * summary[m]['unsolved']:.2g} %" for m in METHODS)
    return "\n".join(
        [
            f"rms pointing error, medians over {seeds_of(settings)}; px at the wanted focal length",
            table(head, lines),
            f"without a solution: {unsolved}; the exact range's worst error: {_worst(summary):.1e} degrees",
        ]
    )


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Maps of both readings' errors over the wide image, the median over the seeds, a column a depth."""
    depths = _depths(rows)
    figure.set_size_inches(3.2 * len(depths) + 1, 5)
    readings = (TABLE, EXAMPLE)
    axes = figure.subplots(len(readings), len(depths), squeeze=False, sharex=True, sharey=True)
    maps = {(m, d): _map(rows, m, d) for m in readings for d in depths}
    levels = np.geomspace(0.01, 10.0, 13)
    for line, method in zip(axes, readings, strict=True):
        for ax, depth in zip(line, depths, strict=True):
            u, v, values = maps[method, depth]
            filled = ax.contourf(u, v, np.clip(values, levels[0], levels[-1]), levels, norm="log", cmap="viridis")
            lines = ax.contour(u, v, values, [0.1, 0.3, 1.0, 3.0], colors="w", linewidths=0.8)
            ax.clabel(lines, fmt="%g", fontsize="small")
            ax.set(aspect="equal", title=f"{NAMES[method]}, {depth:g} m")
            ax.title.set_fontsize("medium")
        line[0].set(ylabel="v [px]", ylim=(SIZE[1], 0))
    for ax in axes[-1]:
        ax.set_xlabel("u [px]")
    bar = figure.colorbar(filled, ax=axes, ticks=[0.01, 0.1, 1.0, 10.0], format="%g")
    bar.set_label("pointing error [degrees]")


def _map(rows: Sequence[Row], method: Method, depth: float) -> tuple[Array, Array, Array]:
    """Columns and rows [px], and the median over the seeds of the error there [degrees]."""
    cells: dict[tuple[float, float], list[float]] = {}
    for row in rows:
        if row["depth_m"] == depth:
            cells.setdefault((row["v_px"], row["u_px"]), []).append(row[f"{method}_deg"])
    v, u = (np.array(sorted({cell[i] for cell in cells})) for i in (0, 1))
    return u, v, np.array([[np.nanmedian(cells[y, x]) for x in u] for y in v])


SETTINGS = ShortcutSettings()
EXPERIMENT = Experiment(
    "shortcut",
    "The exact range beside the paper's shortcut over the wide view.",
    SETTINGS,
    replace(SETTINGS, seeds=2, depths=(5.0, 20.0), grid=(9, 7)),
    one,
    summarise,
    describe,
    plot,
    missed,
    cost_s=1.0,
    bounded=bounded,
)

if __name__ == "__main__":
    sys.exit(EXPERIMENT.main())
