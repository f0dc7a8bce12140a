"""Whole calibration from synthetic corners: pointing error against its prediction and the Cramer-Rao bound.

15 boards of 0.88 x 0.68 m (14 x 11 corners) at 2.5 to 8 m are spread over the fixed view, each seen from six head
poses, with corners of 0.2 px. Everything is unknown: both cameras' intrinsics, Gamma, T and the head's geometry. The
pointing error is the angle between line of sight and true target at the shortest focal length, for targets over the
fixed view at 4 to 30 m, pixel and depth given exactly; times 7155 it is the error in pixels at the longest focal
length. The joint fit is compared with its own prediction, the Cramer-Rao bound for the true noise, that bound with
known intrinsics, and the sequential method. The rigs are the default one; one with a wide baseline, toed in and rolled,
with a long lever; and the default one with the usual board of 9 x 6 corners.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cotarget.board import board_points
from cotarget.calibration import Calibration, Covariance, Options, calibrate_views, predicted_pointing
from cotarget.calibration.bundle import ALL_BLOCKS, Block, fit, parameter_names
from cotarget.calibration.initialization import place_boards
from cotarget.calibration.uncertainty import model_of
from cotarget.config import BoardConfig
from cotarget.geometry import Array
from cotarget.schema import Positive
from experiments.calibration.synthetic.aims import draw_targets, misses
from experiments.calibration.synthetic.rig import LONGEST_PX, SIZES, Truth, other_rig
from experiments.calibration.synthetic.views import Boards, Looks, Placing, spread_views
from experiments.engine import Count, Row, Settings
from experiments.tables import grouped, rms

FINE_BOARD = BoardConfig(corners=(14, 11), square=0.068)
CASES = {
    "default rig": (Truth(), FINE_BOARD),
    "toed-in rig": (other_rig(), FINE_BOARD),
    "default rig, 9x6 board": (Truth(), BoardConfig()),
}
KNOWN_INTRINSICS: tuple[Block, ...] = ("gamma", "hand", "head")
FIGURES = ("joint", "predicted", "bound", "bound_intrinsics_known", "sequential")


@dataclass(frozen=True)
class ChainSettings(Settings):
    """Settings: noise of corners [px], boards, head poses per board, targets per seed, and cases."""

    seeds: Count = 20
    noise_px: Positive = 0.2
    boards: Boards = 15
    looks: Looks = 6
    targets: Count = 100
    cases: tuple[str, ...] = tuple(CASES)


def one(settings: ChainSettings, seed: int) -> list[Row]:
    """Calibrate every case once; give a row per case."""
    return [_row(settings, seed, case) for case in settings.cases]


def _row(settings: ChainSettings, seed: int, case: str) -> Row:
    truth, board = CASES[case]
    placing = Placing(boards=settings.boards, looks=settings.looks)
    views = spread_views(truth, board_points(board), np.random.default_rng((seed, 2)), settings.noise_px, placing)
    joint = calibrate_views(views, board, SIZES, options=Options(folds=0))
    sequential = calibrate_views(views, board, SIZES, options=Options("sequential"))
    targets = draw_targets(np.random.default_rng((seed, 3)), settings.targets)
    errors = {
        "joint": misses(joint, truth, *targets),
        "predicted": predicted_pointing(joint, *targets),
        "bound": bound(joint, settings.noise_px, ALL_BLOCKS, *targets),
        "bound_intrinsics_known": bound(joint, settings.noise_px, KNOWN_INTRINSICS, *targets),
        "sequential": misses(sequential, truth, *targets),
    }
    return {
        "seed": seed,
        "case": case,
        **{f"{name}_px": LONGEST_PX * rms(values) for name, values in errors.items()},
    }


def bound(calibration: Calibration, noise_px: float, blocks: tuple[Block, ...], pixels: Array, depths: Array) -> Array:
    """Compute the Cramer-Rao bound of the pointing error towards pixels (n, 2) at depths (n,) [m], (n,) [rad].

    The calibration is from views with this noise of the corners and no other; the blocks' parameters are unknown.
    """
    assert calibration.board is not None
    points = board_points(calibration.board)
    model = place_boards(model_of(calibration), calibration.views, points)
    found = fit(model, calibration.views, points, blocks)
    covariance = Covariance(parameter_names(blocks), np.asarray(np.linalg.inv(found.normal) * noise_px**2, float))
    return predicted_pointing(replace(calibration, covariance=covariance, jitter=0.0), pixels, depths)


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give rms over the seeds [px at f = 7155 px]."""
    return {
        case: {f"{name}_px": rms(row[f"{name}_px"] for row in mine) for name in FIGURES}
        for case, mine in grouped(rows, "case").items()
    }


SETTINGS = ChainSettings()
QUICK = replace(SETTINGS, seeds=2, boards=10, looks=4, cases=("toed-in rig", "default rig, 9x6 board"))
COST_S = 15.0
