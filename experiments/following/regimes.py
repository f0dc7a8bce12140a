"""Regime of depth and baseline in which the full model is clearly better than a simpler one."""

import math
from collections.abc import Sequence

import numpy as np

from cotarget.geometry import Array
from experiments.engine import Row
from experiments.following.simpler import FULL, IGNORED

FACTOR = 5.0  # factor by which the full model has to be better than "offset ignored" somewhere


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
