"""How well a rig points after it was calibrated from rendered boards, and what simpler models lose.

Two rigs, of which the software is told nothing: the default one, and one with a wide baseline, toed in and rolled,
with a long lever arm. Each is calibrated from rendered boards with all effects on, once a seed. The pointing error is
the angle between the zoom camera's line of sight and the true target, for targets all over the wide view at 4 to 30 m,
pixel and depth given exactly, at the shortest focal length. Beside the full model stand the paper's shortcut in its
two readings and a model that ignores the offsets between fixed camera, head and zoom camera.

    python -m experiments.pointing [--seeds 5] [--seed-base 0] [--processes P] [--quick] [--out DIR]
"""

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cotarget.calibration import Calibration, calibrate_rig
from cotarget.config import RigConfig, SimConfig
from cotarget.geometry import RigidTransform, pose
from cotarget.judging import pointing_errors
from cotarget.safety import SafeRig
from cotarget.servo import reach_of
from cotarget.sim.world import SimWorld
from cotarget.targeting import Method
from experiments import harness
from experiments.harness import Experiment, Row, seeds_of

RIGS = {
    "default": SimConfig(scene="indoor"),
    "toed in": SimConfig(
        scene="indoor",
        # 1.5 m beside the fixed camera, turned 12 degrees towards its axis, rolled by 5
        T_zoom0_fixed=pose([-1.46, 0.05, 0.31], [0.0, 12.0, 5.0]),
        T_head_zoom=pose([0.08, -0.15, 0.105], [1.0, -2.0, 1.5]),  # a lever arm of 0.2 m
    ),
}
MODELS: dict[str, tuple[Method, bool]] = {
    "full model": ("exact", False),
    "offsets ignored": ("exact", True),
    "paper's shortcut, depth of Table 1": ("paper-table", False),
    "paper's shortcut, depth of Section 4.2": ("paper-example", False),
}
STREAM = 5  # of random numbers, apart from the world's own


@dataclass(frozen=True)
class Settings(harness.Settings):
    """How many seeds, how many targets for each, and which rigs."""

    seeds: int = 5
    targets: int = 400
    rigs: tuple[str, ...] = tuple(RIGS)


def one(_: None, settings: Settings, seed: int) -> list[Row]:
    """Calibrate every rig once; one row for each model's error then [degrees]."""
    rows: list[Row] = []
    for rig in settings.rigs:
        config = RigConfig(sim=dataclasses.replace(RIGS[rig], seed=seed))
        world = SimWorld(config)
        with SafeRig(world.rig, config.safety) as opened:
            calibration = calibrate_rig(opened, config.board, seed=seed)
            reach = reach_of(opened)
            for model, (method, ignoring) in MODELS.items():
                judged = without_offsets(calibration) if ignoring else calibration
                rng = np.random.default_rng((seed, STREAM))
                errors = np.degrees(pointing_errors(judged, world.truth(), reach, rng, settings.targets, method))
                rows.append(
                    {
                        "rig": rig,
                        "seed": seed,
                        "model": model,
                        "targets": len(errors),
                        "median_deg": float(np.median(errors)),
                        "p95_deg": float(np.percentile(errors, 95)),
                    }
                )
    return rows


def without_offsets(calibration: Calibration) -> Calibration:
    """The model of those who ignore where the cameras are: the same rotations, everything in one place."""
    return dataclasses.replace(
        calibration,
        T_zoom0_fixed=RigidTransform.from_rotation(calibration.T_zoom0_fixed.rotation),
        T_head_zoom=RigidTransform.from_rotation(calibration.hand_eye().rotation),
    )


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """Median over the seeds of each rig's and model's median and 95th percentile [degrees]."""
    return {
        rig: {
            model: {
                key: float(np.median([r[key] for r in rows if r["rig"] == rig and r["model"] == model]))
                for key in ("median_deg", "p95_deg")
            }
            for model in MODELS
        }
        for rig in dict.fromkeys(row["rig"] for row in rows)
    }


def describe(settings: Settings, summary: Mapping[str, Any]) -> str:
    """A line for each rig and model."""
    lines = [
        f"{rig:8} {model:40} median {found['median_deg']:.4f}   p95 {found['p95_deg']:.4f}"
        for rig, models in summary.items()
        for model, found in models.items()
    ]
    return "\n".join([f"pointing error, median over {seeds_of(settings)} [degrees]", *lines])


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Median errors of each seed, by model."""
    rigs = tuple(dict.fromkeys(row["rig"] for row in rows))
    for ax, rig in zip(figure.subplots(1, len(rigs), sharey=True, squeeze=False)[0], rigs, strict=True):
        for i, model in enumerate(MODELS):
            errors = [row["median_deg"] for row in rows if row["rig"] == rig and row["model"] == model]
            ax.semilogy([i] * len(errors), errors, "o", label=model)
        ax.set(title=rig, ylabel="median pointing error [degrees]", xticks=[])
    ax.legend(frameon=False)


SETTINGS = Settings()
EXPERIMENT = Experiment(
    "pointing",
    "How well a rig points after it was calibrated from rendered boards, and what simpler models lose.",
    SETTINGS,
    dataclasses.replace(SETTINGS, seeds=1, targets=50, rigs=("default",)),
    one,
    summarise,
    describe,
    plot,
    cost_s=90.0,
)

if __name__ == "__main__":
    sys.exit(EXPERIMENT.main())
