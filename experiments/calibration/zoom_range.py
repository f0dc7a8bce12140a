"""Pointing over the whole zoom range, calibrated from rendered boards, with an ideal head and with steps.

The default rig with all effects is calibrated once per seed with an ideal head and once with steps of 0.0514 degrees.
The pointing error is given at the shortest focal length and over all others: the angle between line of sight and
targets over the fixed view at 4 to 30 m, pixel and depth given exactly. The errors of focal length and boresight at and
between the zoom samples are given too. With steps, the aim is rounded to them, and the error is compared with that of a
true calibration rounded in the same way.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cotarget.calibration import Calibration, predicted_pointing
from cotarget.calibration.calibrate import calibrate
from cotarget.config import RigConfig, SimConfig, SimEffects
from cotarget.control.controller import reach_of
from cotarget.evaluation import pointing_errors, true_calibration
from cotarget.geometry import angle_between
from cotarget.safety.safe_rig import guard
from cotarget.sim.truth import Truth
from cotarget.sim.world import SimWorld
from experiments.engine import Count, Row, Settings
from experiments.following.own_rig import RigText, calibrated_rig
from experiments.tables import grouped, outside, rms, spread

# Goals for each head's figures, least and largest; with an ideal head nothing is rounded.
WANTED: Mapping[str, tuple[float, float]] = {
    "shortest_median_deg": (0.0, 0.003),
    "shortest_p95_deg": (0.0, 0.006),
    "range_median_deg": (0.0, 0.003),
    "range_p95_deg": (0.0, 0.006),
    "rms_over_predicted": (0.4, 1.5),
    "ratio": (0.0, 1.1),
}
STREAM = 6  # random stream, separate from the world's
FOCAL_LENGTHS = 15  # evenly spaced in the logarithm: every zoom sample and the middle between any two
HEADS = {"ideal": False, "steps": True}
# Grid of targets for the prediction: pixels as fractions of the image, and depths [m].
SHARES, DEPTHS = np.linspace(0.05, 0.95, 4), np.array([5.0, 10.0, 25.0])


@dataclass(frozen=True)
class ZoomRangeSettings(Settings):
    """Settings: targets per focal length, and heads."""

    seeds: Count = 3
    targets: Count = 60
    heads: tuple[str, ...] = tuple(HEADS)


def one(settings: ZoomRangeSettings, seed: int) -> list[Row]:
    """Calibrate with each head; give a row per focal length."""
    rows: list[Row] = []
    for head in settings.heads:
        sim = SimConfig(scene="indoor", seed=seed, effects=SimEffects(steps=HEADS[head]))
        config = RigConfig(sim=sim)
        world = SimWorld(config)
        with guard(world.rig, config.safety) as rig:
            # With steps it is the default rig.
            calibration = calibrated_rig(RigText(), seed) if HEADS[head] else calibrate(rig, config.board, seed=seed)
            reach, truth, exact = reach_of(rig), world.truth(), true_calibration(world, stops=FOCAL_LENGTHS)
            for i, nominal in enumerate(np.geomspace(*reach.focal_px, FOCAL_LENGTHS)):
                judged = functools.partial(
                    pointing_errors, truth=truth, reach=reach, nominal_px=float(nominal), count=settings.targets
                )
                errors = judged(calibration, rng=np.random.default_rng((seed, STREAM, i)))
                row: Row = {
                    "head": head,
                    "seed": seed,
                    "nominal_px": float(nominal),
                    "median_deg": float(np.degrees(np.median(errors))),
                    "p95_deg": float(np.degrees(np.percentile(errors, 95))),
                    "rms_deg": rms(np.degrees(errors)),
                    "predicted_deg": float(np.degrees(predicted(calibration, float(nominal)))),
                    **lens_errors(calibration, exact, truth, float(nominal)),
                }
                if HEADS[head]:
                    for name, one_calibration in (("rounded", calibration), ("rounding", exact)):
                        rng = np.random.default_rng((seed, STREAM, i))
                        rounded = judged(one_calibration, rng=rng, step=reach.steps[0])
                        row[f"{name}_rms_deg"] = rms(np.degrees(rounded))
                rows.append(row)
    return rows


def predicted(calibration: Calibration, nominal_px: float) -> float:
    """Predict the rms pointing error over fixed view and depth [rad]."""
    u, v, z = np.meshgrid(SHARES, SHARES, DEPTHS)
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1) * (np.array(calibration.fixed.size) - 1)
    return rms(predicted_pointing(calibration, pixels, z.ravel(), nominal_px=nominal_px))


def lens_errors(calibration: Calibration, exact: Calibration, truth: Truth, nominal_px: float) -> dict[str, float]:
    """Give errors of the focal length [%] and of the ray through the image's centre in the head's frame [degrees]."""
    found, true = calibration.zoom_head.lens.at(nominal_px), truth.zoom_lens_for(nominal_px)
    middle = found.image_center_px
    here = calibration.zoom_head.hand_eye().rotation.apply(found.ray(middle))
    there = exact.zoom_head.hand_eye().rotation.apply(np.append(true.directions(middle), 1.0))
    return {
        "focal_off_percent": 100 * abs(found.focal_px[0] / true.focal_px[0] - 1),
        "boresight_off_deg": float(np.degrees(angle_between(here, there))),
    }


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Give medians over the seeds, least and largest of the error over the range, and the worst error of the lens."""
    summary: dict[str, Any] = {}
    for head, mine in grouped(rows, "head").items():
        shortest = min(row["nominal_px"] for row in mine)
        at_shortest = [row for row in mine if row["nominal_px"] == shortest]
        by_seed = grouped(mine, "seed")
        found = {
            "calibrations": len(by_seed),
            "shortest_median_deg": median(row["median_deg"] for row in at_shortest),
            "shortest_p95_deg": median(row["p95_deg"] for row in at_shortest),
            **_over_range(
                "range_median_deg", [np.median([r["median_deg"] for r in same]) for same in by_seed.values()]
            ),
            **_over_range(
                "range_p95_deg", [np.percentile([r["p95_deg"] for r in same], 95) for same in by_seed.values()]
            ),
            "worst_seed_range_p95_deg": max(max(r["p95_deg"] for r in same) for same in by_seed.values()),
            "rms_over_predicted": rms(r["rms_deg"] for r in mine) / rms(r["predicted_deg"] for r in mine),
            "focal_off_percent": median(max(r["focal_off_percent"] for r in same) for same in by_seed.values()),
            "worst_focal_off_percent": max(r["focal_off_percent"] for r in mine),
            "boresight_off_deg": median(max(r["boresight_off_deg"] for r in same) for same in by_seed.values()),
            "worst_boresight_off_deg": max(r["boresight_off_deg"] for r in mine),
        }
        if "rounded_rms_deg" in mine[0]:
            found["rounded_rms_deg"] = rms(row["rounded_rms_deg"] for row in mine)
            found["rounding_alone_rms_deg"] = rms(row["rounding_rms_deg"] for row in mine)
            found["ratio"] = found["rounded_rms_deg"] / found["rounding_alone_rms_deg"]
        summary[head] = found
    return summary


def _over_range(key: str, values: Sequence[Any]) -> dict[str, float]:
    """Give a figure's median over the seeds, with least and largest."""
    found = spread(map(float, values))
    return {key: found["median"], f"{key}, least": found["least"], f"{key}, largest": found["largest"]}


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the figures that miss their goal."""
    return [
        text
        for head, found in summary.items()
        for text in outside(found, {key: limits for key, limits in WANTED.items() if key in found}, head)
    ]


def median(values: Any) -> float:
    """Give the median of an iterable."""
    return float(np.median(list(values)))


SETTINGS = ZoomRangeSettings()
QUICK = dataclasses.replace(SETTINGS, seeds=2, targets=20, heads=("steps",))
COST_S = 120.0
