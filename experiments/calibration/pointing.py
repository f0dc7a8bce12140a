"""Pointing after a calibration from rendered boards, for the full model and for simpler ones.

There are two rigs, about which the software knows nothing in advance: the default one, and one with a wide baseline,
toed in and rolled, with a long lever. A user's own rig is tested with `--set pointing.rig=rig.toml`. Each is calibrated
from rendered boards with all effects, once per seed. The pointing error is the angle between the zoom camera's line of
sight and the true target, for targets over the fixed view at 4 to 30 m, pixel and depth given exactly, at the shortest
focal length. The full model is compared with the paper's shortcut in its two readings, and with a model that ignores
the offsets between fixed camera, head and zoom camera.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cotarget.calibration import Calibration
from cotarget.calibration.calibrate import calibrate
from cotarget.config import RigConfig, SimConfig
from cotarget.control.controller import reach_of
from cotarget.evaluation import pointing_errors
from cotarget.geometry import RigidTransform, pose
from cotarget.safety.safe_rig import guard
from cotarget.sim.world import SimWorld
from cotarget.targeting import Method
from experiments.engine import Count, Row
from experiments.following.own_rig import OwnRig, RigText, calibrated_rig
from experiments.tables import grouped, outside, spreads

RIGS = {
    "default": SimConfig(scene="indoor"),
    "toed in": SimConfig(
        scene="indoor",
        # 1.5 m beside the fixed camera, turned 12 degrees towards its axis, rolled by 5
        T_zoom0_fixed=pose([-1.46, 0.05, 0.31], [0.0, 12.0, 5.0]),
        T_head_zoom=pose([0.08, -0.15, 0.105], [1.0, -2.0, 1.5]),  # a lever arm of 0.2 m
    ),
}
FULL = "full model"
MODELS: dict[str, tuple[Method, bool]] = {
    FULL: ("exact", False),
    "offsets ignored": ("exact", True),
    "paper's shortcut, depth of Table 1": ("paper-table", False),
    "paper's shortcut, depth of Section 4.2": ("paper-example", False),
}
OWN = "own"  # name of a user's own rig
STREAM = 5  # random stream, separate from the world's
# Goals for the full model's median over the seeds [degrees].
WANTED = {"median_deg": (0.0, 0.003), "p95_deg": (0.0, 0.006)}


@dataclass(frozen=True)
class Settings(OwnRig):
    """Settings: targets per seed, and the rigs where no own one is given."""

    seeds: Count = 3
    targets: Count = 400
    rigs: tuple[str, ...] = tuple(RIGS)


def one(settings: Settings, seed: int) -> list[Row]:
    """Calibrate every rig once; give a row with the error of each model [degrees]."""
    rows: list[Row] = []
    for rig in (OWN,) if settings.rig else settings.rigs:
        config = (
            RigConfig(sim=dataclasses.replace(RIGS[rig], seed=seed))
            if rig in RIGS
            else settings.config("indoor", (), seed)
        )
        world = SimWorld(config)
        with guard(world.rig, config.safety) as opened:
            shared = {"default": RigText(), OWN: settings.text}.get(rig)
            calibration = calibrated_rig(shared, seed) if shared else calibrate(opened, config.board, seed=seed)
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
    """Remove all offsets from a calibration: the same rotations, and the whole rig at one point."""
    head = dataclasses.replace(
        calibration.zoom_head,
        T_zoom0_fixed=RigidTransform.from_rotation(calibration.zoom_head.T_zoom0_fixed.rotation),
        T_head_zoom=RigidTransform.from_rotation(calibration.zoom_head.hand_eye().rotation),
    )
    return dataclasses.replace(calibration, zoom_head=head)


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, dict[str, float]]]]:
    """Give the spread of each rig's and model's median and 95th percentile over the seeds [degrees]."""
    return {rig: spreads(mine, "model", WANTED) for rig, mine in grouped(rows, "rig").items()}


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the figures of the full model that exceed their goal."""
    return [text for rig, models in summary.items() for text in outside(models[FULL], WANTED, rig)]


SETTINGS = Settings()
QUICK = dataclasses.replace(SETTINGS, targets=50, rigs=("default",))
COST_S = 60.0  # after `zoom_range`, which has made the default rig's calibration
