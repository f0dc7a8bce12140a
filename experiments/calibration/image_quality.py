"""Consistency of a calibration's covariance where sensor noise and JPEG coding spoil the images.

The default rig is calibrated from rendered boards with all effects, for each noise and JPEG quality of both cameras. As
in `honesty`, the pointing error at the shortest focal length is compared with the predicted one, and 90 % ellipses of
the parameters are checked for the truth. Captures are held out as in every calibration; `widened` is the part of the
calibrations whose covariance they widened. There is one zoom sample, because more take as long again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval

from cotarget.calibration import predicted_pointing
from cotarget.calibration.calibrate import calibrate
from cotarget.config import RigConfig, SimConfig
from cotarget.evaluation import true_calibration
from cotarget.safety.safe_rig import guard
from cotarget.schema import NotNegative
from cotarget.sim.world import SimWorld
from experiments.calibration.honesty import GROUPS, LEVEL, inside
from experiments.calibration.synthetic.aims import draw_targets, misses
from experiments.calibration.synthetic.rig import LONGEST_PX, truth_of
from experiments.engine import Count, Row, Settings
from experiments.tables import grouped, outside, rms

WITHIN = 2.0  # largest ratio to the predicted error
WANTED = {"reached_over_predicted": (0.8, 1.25), "within_twice": (0.95, 1.0), "ellipses": (0.84, 0.96)}


@dataclass(frozen=True)
class ImageSettings(Settings):
    """Settings: sensor noise [grey levels], JPEG qualities, zoom samples, and targets per calibration."""

    seeds: Count = 5
    noises: tuple[NotNegative, ...] = (2.0, 8.0)
    qualities: tuple[Annotated[int, Interval(ge=1, le=100)], ...] = (50, 95)
    stops: Count = 1
    targets: Count = 100


def one(settings: ImageSettings, seed: int) -> list[Row]:
    """Calibrate once for each noise and quality; give a row for each."""
    return [_row(settings, seed, noise, quality) for noise in settings.noises for quality in settings.qualities]


def _row(settings: ImageSettings, seed: int, noise: float, quality: int) -> Row:
    sim = SimConfig(scene="indoor", seed=seed)
    fixed = replace(sim.fixed, noise=noise, jpeg_quality=quality)
    zoom = replace(sim.zoom, noise=noise, jpeg_quality=quality)
    config = RigConfig(sim=replace(sim, fixed=fixed, zoom=zoom))
    world = SimWorld(config)
    with guard(world.rig, config.safety) as rig:
        calibration = calibrate(rig, config.board, stops=settings.stops, seed=seed)
        truth = truth_of(true_calibration(world))
    targets = draw_targets(np.random.default_rng((seed, 10)), settings.targets)
    assert calibration.residuals is not None
    return {
        "seed": seed,
        "noise": noise,
        "quality": quality,
        "reached_px": LONGEST_PX * rms(misses(calibration, truth, *targets)),
        "predicted_px": LONGEST_PX * rms(predicted_pointing(calibration, *targets)),
        "widened": None if calibration.held_out is None else calibration.held_out.widened,
        "corners_rms_px": calibration.residuals.handeye_rms_px,
        **{name: inside(calibration, truth, parameters, LEVEL) for name, parameters in GROUPS.items()},
    }


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give rms pointing errors, their ratio, and the part of the ellipses that contain the truth."""
    return {
        f"noise {noise:g}, JPEG {quality}": {
            "reached_px": rms(row["reached_px"] for row in mine),
            "predicted_px": rms(row["predicted_px"] for row in mine),
            "reached_over_predicted": rms(r["reached_px"] for r in mine) / rms(r["predicted_px"] for r in mine),
            "within_twice": float(np.mean([row["reached_px"] < WITHIN * row["predicted_px"] for row in mine])),
            "ellipses": float(np.mean([[row[name] for name in GROUPS] for row in mine])),
            "widened": float(np.mean([(row["widened"] or 1) > 1 for row in mine])),
            "corners_rms_px": rms(row["corners_rms_px"] for row in mine),
        }
        for (noise, quality), mine in grouped(rows, "noise", "quality").items()
    }


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the figures that miss their goal."""
    return [text for name, figures in summary.items() for text in outside(figures, WANTED, name)]


SETTINGS = ImageSettings()
QUICK = replace(SETTINGS, seeds=1, noises=(8.0,), qualities=(50,))
COST_S = 50.0
