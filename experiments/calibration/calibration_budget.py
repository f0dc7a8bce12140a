"""Pointing error over corner noise and number of placements of a calibration, against its prediction.

Boards of 9 x 6 corners at 2.5 to 8 m are spread over the fixed view, each seen from four head poses; everything is
unknown. The default rig is calibrated for each noise and each number of placements; every seed has its own boards,
poses and noise. The pointing error is the angle between line of sight and true target, for targets over the fixed view
at 4 to 30 m, pixel and depth given exactly; times 7155 it is the error in pixels at the longest focal length. In theory
the error is proportional to the noise, and to one over the root of the placements, or falls faster where few of them
leave parts of the view empty. The measured exponents are those of a plane fitted to the logarithms.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cotarget.board import board_points
from cotarget.calibration import Options, calibrate_views, predicted_pointing
from cotarget.config import BoardConfig
from cotarget.schema import Positive
from experiments.calibration.synthetic.aims import draw_targets, misses
from experiments.calibration.synthetic.rig import LONGEST_PX, SIZES, Truth
from experiments.calibration.synthetic.views import Boards, Looks, Placing, spread_views
from experiments.engine import Count, Row, Settings
from experiments.tables import grouped, outside, rms

BOARD = BoardConfig()
RIG = Truth()
# The error comes from the noise alone. More placements reduce it as one over their root, or more where few leave parts
# of the view empty: to a third from 6 to 12. The limits allow for the two seeds of a quick run.
WANTED = {"exponent_noise": (0.75, 1.25), "exponent_placements": (-1.6, -0.3), "reached_over_predicted": (0.67, 1.5)}


@dataclass(frozen=True)
class BudgetSettings(Settings):
    """Settings: what is varied, and what is constant."""

    seeds: Count = 5
    noises_px: tuple[Positive, ...] = (0.02, 0.05, 0.1, 0.2, 0.5)  # noise of corners [px]
    placements: tuple[Boards, ...] = (6, 12, 24, 48)  # numbers of board placements
    looks: Looks = 4  # head poses per placement
    targets: Count = 100  # number of targets on which the error is measured


def one(settings: BudgetSettings, seed: int) -> list[Row]:
    """Calibrate for each number of placements and each noise; give a row for each.

    Each calibration has its own random boards, poses and noise.
    """
    rows: list[Row] = []
    for boards in settings.placements:
        for number, noise_px in enumerate(settings.noises_px):
            rng = np.random.default_rng((seed, 24, boards, number))
            placing = Placing(boards=boards, looks=settings.looks)
            views = spread_views(RIG, board_points(BOARD), rng, noise_px, placing)
            calibration = calibrate_views(views, BOARD, SIZES, options=Options(folds=0))
            targets = draw_targets(rng, settings.targets)
            rows.append(
                {
                    "seed": seed,
                    "noise_px": noise_px,
                    "placements": boards,
                    "poses": boards * settings.looks,
                    "reached_px": LONGEST_PX * rms(misses(calibration, RIG, *targets)),
                    "predicted_px": LONGEST_PX * rms(predicted_pointing(calibration, *targets)),
                }
            )
    return rows


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Give rms over the seeds for each noise and number, and the exponents of the error."""
    cells = {}
    for (boards, noise_px), mine in grouped(rows, "placements", "noise_px").items():
        reached, predicted = (rms(row[f"{key}_px"] for row in mine) for key in ("reached", "predicted"))
        cells[f"corners {noise_px:g} px, {boards} placements"] = {
            "reached_px": reached,
            "predicted_px": predicted,
            "reached_deg": float(np.degrees(reached / LONGEST_PX)),
            "ratio": reached / predicted,
        }
    with_noise, with_placements = exponents(rows)
    return {
        "cells": cells,
        "exponent_noise": with_noise,
        "exponent_placements": with_placements,
        "reached_over_predicted": rms(row["reached_px"] / row["predicted_px"] for row in rows),
    }


def exponents(rows: Sequence[Row], key: str = "reached_px") -> tuple[float, float]:
    """Fit the exponents of an error over noise and number of placements; 1 and -0.5 in theory.

    Returns:
        The exponents; nan for what is constant in all rows.
    """
    terms = [[np.log(row["noise_px"]), np.log(row["placements"]), 1.0] for row in rows]
    slopes, *_ = np.linalg.lstsq(np.array(terms), np.log([row[key] for row in rows]), rcond=None)
    varied = [len({row[of] for row in rows}) > 1 for of in ("noise_px", "placements")]
    with_noise, with_placements = (float(s) if so else math.nan for s, so in zip(slopes[:2], varied, strict=True))
    return with_noise, with_placements


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List what differs from theory or from the calibrations' own predictions, among what was measured."""
    return outside(summary, {name: limits for name, limits in WANTED.items() if not math.isnan(summary[name])})


def bounded(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Give each cell's error, and its ratio to the prediction."""
    cells = {cell: found["reached_px"] for cell, found in summary["cells"].items()}
    return {"reached_px": cells, "reached_over_predicted": summary["reached_over_predicted"]}


SETTINGS = BudgetSettings()
QUICK = replace(SETTINGS, seeds=2, noises_px=(0.05, 0.2), placements=(6, 12))
COST_S = 30.0
