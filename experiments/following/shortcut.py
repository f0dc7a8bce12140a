"""Exact inverse kinematics against the paper's shortcut over the fixed view: where depth in place of range fails.

Two kinds of rigs, both known exactly, whose head axes cross at a right angle and whose zoom camera has its principal
point at the image's centre, as the shortcut assumes. `mounted` rigs (`experiments.following.mounted`) have a baseline
of 0.4 m, as the default rig. `Section 4.2` rigs have the zoom camera of the paper's worked example, 2.2 m aside and
0.46 m ahead, with the example's T (`experiments.paper.worked_example`) and lenses drawn as for the others.

Targets are at several depths, on a grid over the fixed image and in a disc about the zoom camera's axis at home.
`cotarget.targeting.aim` aims at each with the exact range and with both readings of the shortcut. The error is the
angle between line of sight and target, also in pixels at the focal length that shows the paper's book of 0.234 m 160 px
wide, within the lens's range: 7155 px at 10.5 m and beyond. Angles off the axis are from the zoom camera's axis at
home.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, cast

import numpy as np
from annotated_types import Ge
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from cotarget.config import DEFAULT_TARGETS
from cotarget.errors import UnreachableError
from cotarget.geometry import Array, RigidTransform
from cotarget.schema import Positive
from cotarget.targeting import METHODS, Method, Reach, aim
from experiments.calibration.synthetic.aims import looking_off
from experiments.calibration.synthetic.rig import LONGEST_PX, NOMINAL_PX, SIZE, Truth
from experiments.engine import Count, Row, Settings
from experiments.following.mounted import at, exact_calibration, idealised, mounted, off_px, wanted_focal_px
from experiments.paper.worked_example import X_FIXED_MM, X_ZOOM0_MM, stand_in
from experiments.tables import grouped, rms

BOOK = DEFAULT_TARGETS["book"]
ANYWHERE = (-np.pi, np.pi)  # limits of both axes; the head's own limits are not studied here
EXACT, TABLE, EXAMPLE = METHODS
READINGS = (TABLE, EXAMPLE)
NAMES: Mapping[Method, str] = {EXACT: "exact range", TABLE: "depth of Table 1", EXAMPLE: "depth of Section 4.2"}
NEAR_DEG, AT_DEG, AROUND_DEG = 4.0, 20.0, 2.0  # limit of "near", middle and half width of "20 degrees"
REGIONS = ("near the axis", "at 20 degrees", "whole view")
RIGS = MOUNTED, PAPERS = "mounted", "Section 4.2"
GAMMA_MM = np.subtract(X_ZOOM0_MM, X_FIXED_MM)  # Gamma's translation in the worked example, for parallel cameras
ROUNDING_DEG = 1e-6  # arctan2 does not resolve smaller angles


@dataclass(frozen=True)
class ShortcutSettings(Settings):
    """Settings: rigs and positions of the targets."""

    seeds: Count = 20
    baseline: Positive = 0.4  # baseline of the mounted rigs [m]
    depths: tuple[Positive, ...] = (5.0, 10.0, 20.0, 50.0)  # depths of the targets [m]
    # Columns and rows of target pixels in the fixed image, from edge to edge.
    grid: tuple[Annotated[int, Ge(2)], Annotated[int, Ge(2)]] = (13, 9)
    near: Count = 60  # number of additional targets near the zoom camera's axis
    rigs: tuple[Literal["mounted", "Section 4.2"], ...] = ("mounted", "Section 4.2")  # kinds of rig, from RIGS


def one(settings: ShortcutSettings, seed: int) -> list[Row]:
    """Draw a rig of each kind; give a row per target with the error of each method."""
    return [row for rig in settings.rigs for depth in settings.depths for row in _at_depth(settings, seed, rig, depth)]


def rig_of(name: str, seed: int, baseline: float) -> Truth:
    """Draw one of RIGS: `mounted` with a baseline [m], or with the offsets of the worked example."""
    truth = idealised(mounted(np.random.default_rng((seed, 22)), baseline))
    if name == MOUNTED:
        return truth
    T = stand_in()
    hand = RigidTransform.from_components(T.translation / 1000, T.rotation)
    return replace(truth, gamma=RigidTransform.from_translation(GAMMA_MM / 1000), hand=hand)


def _at_depth(settings: ShortcutSettings, seed: int, rig: str, depth: float) -> list[Row]:
    truth = rig_of(rig, seed, settings.baseline)
    calibration = exact_calibration(truth)
    reach = Reach(ANYWHERE, ANYWHERE, (NOMINAL_PX, LONGEST_PX))
    columns, rows_px = (np.linspace(0.0, side - 1.0, count) for side, count in zip(SIZE, settings.grid, strict=True))
    pixels = np.stack(np.meshgrid(columns, rows_px), axis=-1).reshape(-1, 2)
    x_fixed = np.r_[at(truth, pixels, depth), near_axis(truth, depth, settings.near, np.random.default_rng(seed))]
    pixels = np.r_[pixels, np.full((settings.near, 2), np.nan)]
    x_zoom0 = truth.gamma.apply(x_fixed)
    off_axis = np.degrees(np.arctan2(np.linalg.norm(x_zoom0[:, :2], axis=1), x_zoom0[:, 2]))
    focal_px = wanted_focal_px(truth, x_fixed, BOOK.size, BOOK.wanted_px)
    errors = {}
    for method in METHODS:
        q = np.array([aimed(calibration, x, reach, method) for x in x_fixed])
        errors[method] = looking_off(truth, x_fixed, q)
    return [
        {
            "seed": seed,
            "rig": rig,
            "depth_m": depth,
            "u_px": float(pixels[i, 0]),
            "v_px": float(pixels[i, 1]),
            "off_axis_deg": float(off_axis[i]),
            "focal_px": float(focal_px[i]),
            **{f"{method}_deg": float(np.degrees(errors[method][i])) for method in METHODS},
        }
        for i in range(len(pixels))
    ]


def near_axis(truth: Truth, depth: float, count: int, rng: np.random.Generator) -> Array:
    """Draw targets at a depth [m] in the disc of NEAR_DEG about the zoom camera's axis, (count, 3) [m]."""
    radius, angle = np.tan(np.radians(NEAR_DEG)) * np.sqrt(rng.uniform(size=count)), rng.uniform(0, 2 * np.pi, count)
    home = truth.gamma.inv()
    rays = home.rotation.apply(np.c_[radius * np.cos(angle), radius * np.sin(angle), np.ones(count)])
    return np.asarray(home.translation + rays * ((depth - home.translation[2]) / rays[:, 2])[:, None])


def aimed(calibration: Any, x_fixed: Array, reach: Reach, method: Method) -> tuple[float, float]:
    """Give pan and tilt [rad]; nan where the method has no solution."""
    try:
        found = aim(calibration, x_fixed, reach, method=method)
    except UnreachableError:
        return np.nan, np.nan
    return found.pan, found.tilt


def region(row: Row, name: str) -> bool:
    """Check whether a target is in one of REGIONS; targets drawn near the axis are in that region only."""
    off: float = row["off_axis_deg"]
    on_grid = math.isfinite(row["u_px"])
    return {REGIONS[0]: not on_grid, REGIONS[1]: on_grid and abs(off - AT_DEG) <= AROUND_DEG, REGIONS[2]: on_grid}[name]


def px(row: Row, method: Method) -> float:
    """Convert a target's error to pixels at its wanted focal length."""
    return float(off_px(np.radians(row[f"{method}_deg"]), row["focal_px"]))


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Summarise by rig, method, region and depth: rms over a seed's targets, then median and quartiles."""
    summary: dict[str, Any] = {}
    for rig, of_rig in grouped(rows, "rig").items():
        found = summary.setdefault(rig, {})
        for method in METHODS:
            unsolved = [not np.isfinite(row[f"{method}_deg"]) for row in of_rig]
            found[method] = {"unsolved": float(np.mean(unsolved))}
            for name in REGIONS:
                mine = [row for row in of_rig if region(row, name)]
                depths = {f"{depth:g} m": [r for r in mine if r["depth_m"] == depth] for depth in _depths(rows)}
                found[method][name] = {key: _figures(each, method) for key, each in ({"all": mine} | depths).items()}
    return summary


def _depths(rows: Sequence[Row]) -> list[float]:
    return list(dict.fromkeys(row["depth_m"] for row in rows))


def _figures(rows: Sequence[Row], method: Method) -> dict[str, float]:
    """Compute the figures of a region; nan without targets, as on a coarse grid at 20 degrees."""
    if not rows:
        return dict.fromkeys(("deg", "deg_low", "deg_high", "worst_deg", "px"), math.nan)
    seeds = grouped(rows, "seed")
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
    """List where the exact range has an error or no solution."""
    unsolved = any(found[EXACT]["unsolved"] > 0 for found in summary.values())
    lost = [] if _worst(summary) <= ROUNDING_DEG else [f"exact range: {_worst(summary):g} degrees"]
    return [*lost, "exact range: no solution somewhere"] if unsolved else lost


def _worst(summary: Mapping[str, Any]) -> float:
    """Give the largest error of the exact range [degrees]."""
    return float(np.nanmax([found[EXACT][name]["all"]["worst_deg"] for found in summary.values() for name in REGIONS]))


def bounded(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Give the errors of the shortcut's readings [degrees]; the exact range's rounding error needs no bound."""
    return {
        rig: {method: {name: found[method][name]["all"]["deg"] for name in REGIONS} for method in READINGS}
        for rig, found in summary.items()
    }


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Maps of both readings' errors over the fixed image of mounted rigs, medians over the seeds; then all regions."""
    depths, rigs = _depths(rows), list(dict.fromkeys(row["rig"] for row in rows))
    figure.set_size_inches(3.2 * len(depths) + 5, 5)
    maps, regions = cast(list[SubFigure], figure.subfigures(1, 2, width_ratios=(3.2 * len(depths) + 1, 4)))
    axes = maps.subplots(len(READINGS), len(depths), squeeze=False, sharex=True, sharey=True)
    levels = np.geomspace(0.01, 10.0, 13)
    for line, method in zip(axes, READINGS, strict=True):
        for ax, depth in zip(line, depths, strict=True):
            u, v, values = _map([row for row in rows if row["rig"] == rigs[0]], method, depth)
            filled = ax.contourf(u, v, np.clip(values, levels[0], levels[-1]), levels, norm="log", cmap="viridis")
            lines = ax.contour(u, v, values, [0.1, 0.3, 1.0, 3.0], colors="w", linewidths=0.8)
            ax.clabel(lines, fmt="%g", fontsize="small")
            ax.set(aspect="equal", title=f"{NAMES[method]}, {depth:g} m")
            ax.title.set_fontsize("medium")
        line[0].set(ylabel="v [px]", ylim=(SIZE[1], 0))
    for ax in axes[-1]:
        ax.set_xlabel("u [px]")
    bar = maps.colorbar(filled, ax=axes, ticks=[0.01, 0.1, 1.0, 10.0], format="%g")
    bar.set_label(f"pointing error [degrees], {rigs[0]}")
    _by_region(regions.subplots(), summarise(rows))


def _by_region(ax: Axes, summary: Mapping[str, Any]) -> None:
    """Plot the error in each region over all depths, with quartiles over the seeds."""
    for i, (rig, found) in enumerate(summary.items()):
        for j, method in enumerate(READINGS):
            figures = [found[method][name]["all"] for name in REGIONS]
            low, mid, high = (np.array([each[key] for each in figures]) for key in ("deg_low", "deg", "deg_high"))
            x = np.arange(len(REGIONS)) + 0.1 * (2 * i + j - 1.5)
            style: dict[str, Any] = {"fmt": "os"[i], "mfc": f"C{j}" if i == 0 else "w", "color": f"C{j}", "capsize": 2}
            ax.errorbar(x, mid, [mid - low, high - mid], label=f"{NAMES[method]}; rig: {rig}", **style)
    ax.set_xticks(range(len(REGIONS)), [name.replace(" ", "\n", 1) for name in REGIONS])
    ax.set(yscale="log", ylabel="rms pointing error, all depths [degrees]")
    ax.legend(frameon=False, fontsize="small")


def _map(rows: Sequence[Row], method: Method, depth: float) -> tuple[Array, Array, Array]:
    """Give columns and rows [px], and the median error over the seeds at each [degrees]."""
    cells: dict[tuple[float, float], list[float]] = {}
    for row in rows:
        if row["depth_m"] == depth and math.isfinite(row["u_px"]):
            cells.setdefault((row["v_px"], row["u_px"]), []).append(row[f"{method}_deg"])
    v, u = (np.array(sorted({cell[i] for cell in cells})) for i in (0, 1))
    return u, v, np.array([[np.nanmedian(cells[y, x]) for x in u] for y in v])


SETTINGS = ShortcutSettings()
QUICK = replace(SETTINGS, seeds=2, depths=(5.0, 20.0), grid=(9, 7), near=20)
COST_S = 3.0
