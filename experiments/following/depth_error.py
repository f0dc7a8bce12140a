"""Pointing error from an error of the depth, over depth and baseline: first order against Monte Carlo.

The depth comes from a size known beforehand, z = f x_size / u_measured, so that its relative error is that of either
size:

    wrong size      all targets are believed to be 10 % larger than they are
    scatter         true sizes scatter by 10 % about the believed one
    pixels          the measured size has 0.5 px of noise
    together        scatter and pixels

A target at x [m] from the fixed camera, and x_zoom from the rotated zoom camera, is then estimated at x (1 + e). To
first order that rotates the line of sight by e |x_zoom x x| / |x_zoom|^2, about e b / z for a baseline b across the
view. With e = u_noise z / (f x_size) for pixels, their part does not depend on the depth. Monte Carlo has no
approximation: a bar of the target's true size is projected, measured, and aimed at through
`cotarget.camera.depth_from_size`, on rigs mounted by eye (`experiments.following.mounted`) that are known exactly. The
fraction of the close-up's width is at the focal length that shows a bird of 0.8 m 160 px wide, within the lens's range.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Gt

from cotarget.calibration import Calibration
from cotarget.camera import depth_from_size
from cotarget.geometry import Array
from cotarget.schema import Positive
from experiments.calibration.synthetic.aims import aim, looking_off
from experiments.calibration.synthetic.rig import SIZE, Truth
from experiments.engine import Count, Row, Settings
from experiments.following.mounted import TARGET, at, cell_name, exact_calibration, mounted, off_px, wanted_focal_px
from experiments.tables import grouped, rms

CAUSES = ("wrong size", "scatter", "pixels", "together")
# Limits of Monte Carlo over first order, median over all. A size 10 % too large rotates by 1 / 1.1 of first order.
AGREES = (0.88, 1.12)
# Nearer, a bird at the image's edge, half outside, is where the lens model gives no depth.
NEAREST_M = 2.0


@dataclass(frozen=True)
class DepthSettings(Settings):
    """Settings: rigs, targets and errors."""

    seeds: Count = 20
    baselines: tuple[Positive, ...] = (0.1, 0.4, 1.5, 3.0)  # baselines of the rigs of each seed [m]
    depths: tuple[Annotated[float, Ge(NEAREST_M)], ...] = (5.0, 10.0, 20.0, 50.0, 100.0)  # depths of the targets [m]
    targets: Count = 100  # number of targets at each depth
    wrong: Annotated[float, Gt(-1)] = 0.1  # relative excess of the known size
    scatter: Positive = 0.1  # relative standard deviation of true sizes
    noise_px: Positive = 0.5  # noise of the measured size [px]


def one(settings: DepthSettings, seed: int) -> list[Row]:
    """Draw a rig of each baseline; give a row per depth and cause."""
    return [row for i in range(len(settings.baselines)) for row in _of_rig(settings, seed, i)]


def _of_rig(settings: DepthSettings, seed: int, number: int) -> list[Row]:
    rng = np.random.default_rng((seed, 23, number))
    baseline = settings.baselines[number]
    truth = mounted(rng, baseline)
    calibration = exact_calibration(truth)
    rows: list[Row] = []
    for depth in settings.depths:
        pixels = rng.uniform(0, np.array(SIZE) - 1.0, (settings.targets, 2))
        scattered, noise_px = rng.normal(0, settings.scatter, settings.targets), rng.normal(0, 1, settings.targets)
        x_fixed = at(truth, pixels, depth)
        focal_px, arm = wanted_focal_px(truth, x_fixed), turned_by(calibration, truth, x_fixed)
        by_pixels = settings.noise_px * depth / (truth.fixed.fx * TARGET.size)
        # For each cause: true sizes [m], noise of measured sizes [px], and relative error to first order.
        still, right = np.zeros(settings.targets), np.full(settings.targets, TARGET.size)
        causes = {
            "wrong size": (right / (1 + settings.wrong), still, settings.wrong),
            "scatter": (right * (1 + scattered), still, settings.scatter),
            "pixels": (right, settings.noise_px * noise_px, by_pixels),
            "together": (right * (1 + scattered), settings.noise_px * noise_px, np.hypot(settings.scatter, by_pixels)),
        }
        for cause, (sizes, noise, relative) in causes.items():
            depths = measured_depths(calibration, truth, pixels, x_fixed, sizes, noise)
            off = looking_off(truth, x_fixed, aim(calibration, x_fixed * (depths / depth)[:, None]))
            rows.append(
                {
                    "seed": seed,
                    "baseline_m": baseline,
                    "depth_m": depth,
                    "cause": cause,
                    "relative": float(rms(depths / depth - 1)),
                    "reached_deg": float(np.degrees(rms(off))),
                    "first_order_deg": float(np.degrees(rms(relative * arm))),
                    "width": float(np.median(off_px(off, focal_px)) / SIZE[0]),
                }
            )
    return rows


def turned_by(calibration: Calibration, truth: Truth, x_fixed: Array) -> Array:
    """Compute the rotation of the line of sight per relative error of the depth, to first order, (n,) [rad]."""
    q = aim(calibration, x_fixed)
    looking = truth.zoom_fixed(q[:, 0], q[:, 1])
    x_zoom = truth.in_zoom(x_fixed, q[:, 0], q[:, 1])
    along = np.einsum("nij,nj->ni", looking[:, :3, :3], x_fixed)
    return np.asarray(np.linalg.norm(np.cross(x_zoom, along), axis=1) / np.sum(x_zoom**2, axis=1))


def measured_depths(
    calibration: Calibration, truth: Truth, pixels: Array, x_fixed: Array, sizes: Array, noise_px: Array
) -> Array:
    """Compute depths from the apparent widths of bars as wide as the targets, (n,) [m].

    Centres are at pixels (n, 2) and x_fixed (n, 3) [m]; sizes (n,) are true ones [m].
    """
    half = np.c_[sizes / 2, np.zeros((len(sizes), 2))]
    wide = truth.fixed.project(x_fixed + half)[:, 0] - truth.fixed.project(x_fixed - half)[:, 0] + noise_px
    return np.array(
        [
            depth_from_size(calibration.fixed.lens, TARGET.size, size_px, pixel, vertical=False)
            for size_px, pixel in zip(wide, pixels, strict=True)
        ]
    )


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Give medians over the seeds by cause, depth and baseline, and the agreement with first order."""
    summary: dict[str, Any] = {}
    for cause, mine in grouped(rows, "cause").items():
        cells: dict[str, dict[str, float]] = {}
        for (depth, baseline), found in grouped(mine, "depth_m", "baseline_m").items():
            keys = ("relative", "reached_deg", "first_order_deg", "width")
            cells[cell_name(depth, baseline)] = {key: float(np.median([row[key] for row in found])) for key in keys}
        ratio = [row["reached_deg"] / row["first_order_deg"] for row in mine]
        summary[cause] = {
            "cells": cells,
            "over_first_order": dict(zip(("low", "median", "high"), np.percentile(ratio, [5, 50, 95]), strict=True)),
        }
    return summary


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the causes for which first order and Monte Carlo disagree."""
    low, high = AGREES
    return [
        f"{cause}: {median:.2f} times first order"
        for cause, found in summary.items()
        if not low <= (median := found["over_first_order"]["median"]) <= high
    ]


SETTINGS = DepthSettings()
QUICK = replace(SETTINGS, seeds=2, baselines=(0.4, 1.5), depths=(5.0, 20.0, 50.0), targets=50)
COST_S = 3.0
