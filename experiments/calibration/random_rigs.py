"""Random rigs: each is calibrated within twice its predicted error, or refused with a reason.

The baseline is 0.1 to 10 m (even in its logarithm) in a random direction, at most 30 degrees out of the fixed camera's
image plane. The zoom camera is rotated against the fixed one by up to 60 degrees about any axis, with any roll. It sits
on the head with a lever of up to 0.3 m, rotated by up to 10 degrees about any axis, with any roll. Lenses vary by a few
per cent, and corners have 0.1 to 0.2 px of noise. The head's limits are pan -158.9 to 158.9 and tilt -46.6 to 31.1
degrees. Boards are where the fixed camera sees them and the zoom camera does from some head poses within the limits,
facing halfway between both, at 2.5 to 8 m, with squares of 0.1 m; from a baseline of 3 m on, depths and squares grow
with it. A mounting from which the zoom camera cannot see a third of the fixed view is drawn again. Targets are over the
fixed view at 4 to 30 m (growing in the same way), wherever the head reaches. The number of rigs beyond twice their
predicted error is compared with the number expected by chance if every covariance is right.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cotarget.board import board_points
from cotarget.calibration import Calibration, calibrate_views, predicted_pointing
from cotarget.calibration.bundle import EVERY_BLOCK, POSE_PARAMETERS, parameter_names, stepped
from cotarget.calibration.uncertainty import model_of
from cotarget.config import BoardConfig
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform, Rotation
from experiments.calibration.synthetic.aims import TARGET_DEPTHS, aimed, draw_targets, misses
from experiments.calibration.synthetic.rig import LONGEST_PX, SIZES, Lens, Truth, truth_of, undistorted
from experiments.calibration.synthetic.views import BOARD_DEPTHS, HEAD_LIMITS, Boards, Looks, Placing, spread_views
from experiments.engine import Count, Row, Settings
from experiments.tables import rms

BASELINES = (0.1, 10.0)  # [m]
OUT_OF_PLANE = np.sin(np.radians(30.0))
TURNED, ON_HEAD, LEVER = np.radians(60.0), np.radians(10.0), 0.3  # [rad], [rad], [m]
GROWS_FROM = 3.0  # baseline from which boards and depths grow with it [m]
NOISE_PX = (0.1, 0.2)
SERVED = 1 / 3  # least fraction of the fixed view that the zoom camera reaches
WITHIN = 2.0  # largest ratio to the predicted error
CHANCE_DRAWS, CHANCE_TARGETS = 50, 50
FIGURES = ("widened", "measured_px", "predicted_px", "ratio", "beyond_by_chance", "gamma_off_m", "gamma_off_deg")


@dataclass(frozen=True)
class RigsSettings(Settings):
    """Settings: boards, head poses per board, and targets per rig."""

    seeds: Count = 50
    boards: Boards = 20
    looks: Looks = 4
    targets: Count = 200


@dataclass(frozen=True)
class Drawn:
    """Random rig, the scale of its scene, and the fraction of the fixed view that it reaches."""

    truth: Truth
    grown: float
    served: float
    redrawn: int


def one(settings: RigsSettings, seed: int) -> list[Row]:
    """Draw a rig, calibrate it, and judge it; give one row."""
    rng = np.random.default_rng((seed, 4))
    rig = draw_rig(rng)
    truth = rig.truth
    noise_px = float(rng.uniform(*NOISE_PX))
    board = BoardConfig(square=0.1 * rig.grown)
    placing = Placing(boards=settings.boards, looks=settings.looks, depths=_grown(BOARD_DEPTHS, rig.grown))
    views = spread_views(truth, board_points(board), rng, noise_px, placing)
    paired = {view.board for view in views if view.camera == "zoom" and view.pan == view.tilt == 0}
    row = {
        "seed": seed,
        "baseline_m": float(np.linalg.norm(truth.gamma.inv().translation)),
        "turned_deg": float(np.degrees(truth.gamma.rotation.magnitude())),
        "served": rig.served,
        "redrawn": rig.redrawn,
        "noise_px": noise_px,
        "pairs_at_home": len(paired),
        "refused": "",
    } | dict.fromkeys(FIGURES)
    try:
        calibration = calibrate_views(views, board, SIZES)
    except CalibrationError as error:
        return [row | {"refused": str(error)}]
    pixels, depths = draw_targets(rng, settings.targets, _grown(TARGET_DEPTHS, rig.grown))
    reached = reaches(truth, pixels, depths)
    off = misses(calibration, truth, pixels[reached], depths[reached])
    expected = predicted_pointing(calibration, pixels[reached], depths[reached])
    measured, predicted = LONGEST_PX * rms(off), LONGEST_PX * rms(expected)
    away = calibration.zoom_head.T_zoom0_fixed * truth.gamma.inv()
    held_out = calibration.held_out
    return [
        row
        | {
            "widened": None if held_out is None else held_out.widened,
            "measured_px": measured,
            "predicted_px": predicted,
            "ratio": measured / predicted,
            "beyond_by_chance": by_chance(calibration, pixels[reached], depths[reached], rng),
            "gamma_off_m": float(np.linalg.norm(away.translation)),
            "gamma_off_deg": float(np.degrees(away.rotation.magnitude())),
        }
    ]


def by_chance(calibration: Calibration, pixels: Array, depths: Array, rng: np.random.Generator) -> float:
    """Estimate how often an rms error exceeds twice the predicted one although the covariance is right.

    A rig's error has few degrees of freedom, so that its rms over many targets scatters. Calibrations are drawn from
    the covariance and judged as if the fitted one were the truth.
    """
    covariance = calibration.covariance
    assert covariance is not None
    pixels, depths = pixels[:CHANCE_TARGETS], depths[:CHANCE_TARGETS]
    predicted = rms(predicted_pointing(calibration, pixels, depths))
    truth, model = truth_of(calibration), model_of(calibration)
    names = parameter_names(EVERY_BLOCK, model.stops)
    columns = [names.index(name) for name in covariance.parameters]
    beyond = 0
    for drawn in rng.multivariate_normal(np.zeros(len(columns)), covariance.matrix, CHANCE_DRAWS):
        step = np.zeros(len(names))
        step[columns] = drawn
        other = stepped(model, step, np.empty((0, POSE_PARAMETERS)), EVERY_BLOCK)
        wrong = replace(calibration, fixed=other.fixed, zoom_head=other.head)
        beyond += rms(misses(wrong, truth, pixels, depths)) > WITHIN * predicted
    return beyond / CHANCE_DRAWS


def draw_rig(rng: np.random.Generator) -> Drawn:
    """Draw a rig that reaches enough of the fixed view."""
    redrawn = -1
    while True:
        redrawn += 1
        baseline = float(np.exp(rng.uniform(*np.log(BASELINES))))
        direction = any_direction(rng)
        if abs(direction[2]) > OUT_OF_PLANE:
            continue
        lever = any_direction(rng)
        lever *= LEVER * rng.uniform()
        T_fixed_zoom0 = RigidTransform.from_components(baseline * direction, _any_turn(rng, TURNED))
        truth = Truth(
            fixed=any_lens(rng, -0.2),
            zoom=any_lens(rng, -0.1),
            gamma=T_fixed_zoom0.inv(),
            hand=RigidTransform.from_components(lever, _any_turn(rng, ON_HEAD)),
            dz=float(rng.uniform(-0.01, 0.01)),
            eps=float(np.radians(rng.uniform(-0.2, 0.2))),
        )
        grown = max(1.0, baseline / GROWS_FROM)
        pixels, depths = draw_targets(np.random.default_rng(0), 100, _grown(TARGET_DEPTHS, grown))
        near, far = np.log(_grown(BOARD_DEPTHS, grown))
        depths_of_boards = np.exp(np.linspace(near, far, len(pixels)))
        served = float(min(reaches(truth, pixels, d).mean() for d in (depths, depths_of_boards)))
        if served >= SERVED:
            return Drawn(truth, grown, served, redrawn)


def reaches(truth: Truth, pixels: Array, depths: Array) -> Array:
    """Check for each target that the head can point at it within its limits, (n,)."""
    x_fixed = np.c_[undistorted(pixels, truth.fixed), np.ones(len(pixels))] * depths[:, None]
    q = aimed(truth, x_fixed, np.array([0.0, 0.0, 1.0]))
    limits: Array = np.array(HEAD_LIMITS)
    with np.errstate(invalid="ignore"):
        return np.asarray(((q >= limits[:, 0]) & (q <= limits[:, 1])).all(axis=1))


def _grown(depths: tuple[float, float], grown: float) -> tuple[float, float]:
    return depths[0] * grown, depths[1] * grown


def any_direction(rng: np.random.Generator) -> Array:
    """Draw a unit vector, (3,)."""
    v = rng.normal(0, 1, 3)
    return np.asarray(v / np.linalg.norm(v))


def _any_turn(rng: np.random.Generator, largest: float) -> Rotation:
    """Draw a rotation about any axis by up to the largest angle, after any roll about z."""
    turn = Rotation.from_rotvec(any_direction(rng) * rng.uniform(0, largest))
    return turn * Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])


def any_lens(rng: np.random.Generator, k1: float) -> Lens:
    """Draw a lens within a few per cent of the default one."""
    focal = rng.uniform(650, 730)
    cx, cy = rng.uniform([309, 229], [329, 249])
    return Lens(focal, focal * rng.uniform(0.995, 1.005), cx, cy, (k1 * rng.uniform(0.5, 1.5), 0.0, 0.0, 0.0, 0.0))


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Give counts and ratios, and list rigs that were refused or exceed twice their prediction."""
    found = [row for row in rows if not row["refused"]]
    ratios = np.array([row["ratio"] for row in found])
    return {
        "rigs": len(rows),
        "calibrated": len(found),
        "refused": len(rows) - len(found),
        "no_common_view_at_home": sum(row["pairs_at_home"] == 0 for row in rows),
        "widened": sum((row["widened"] or 1) > 1 for row in found),
        "beyond_twice": int((ratios > WITHIN).sum()),
        "beyond_twice_by_chance": float(sum(row["beyond_by_chance"] for row in found)),
        "ratio_median": float(np.median(ratios)) if len(ratios) else float("nan"),
        "ratio_worst": float(ratios.max()) if len(ratios) else float("nan"),
        "measured_px_median": float(np.median([row["measured_px"] for row in found])) if found else float("nan"),
        "redrawn": sum(row["redrawn"] for row in rows),
        "why_refused": {row["seed"]: row["refused"] for row in rows if row["refused"]},
        "beyond": {row["seed"]: row["ratio"] for row in found if row["ratio"] > WITHIN},
    }


SETTINGS = RigsSettings()
QUICK = replace(SETTINGS, seeds=3, boards=12, targets=50)
COST_S = 5.0
