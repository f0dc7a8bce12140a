"""Real stereo photos of a chessboard: rms of each camera and of the pair, the baseline, and each pair left out.

For each pair, both cameras and Gamma are calibrated from all others; then they are held, and only the board's pose is
fitted to the corners of both photos of the pair. All corners count. The photos are OpenCV's samples, looked for in
../shared/data/opencv_stereo beside the project, or one's own.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge

from cotarget.board import board_points
from cotarget.calibration import Calibration, Options, calibrate_photos, calibrate_views
from cotarget.calibration.bundle import fit
from cotarget.calibration.initialization import place_boards
from cotarget.calibration.uncertainty import model_of
from cotarget.config import FEWEST_CORNERS, BoardConfig
from cotarget.schema import Positive
from experiments.engine import Row, Settings

NOT_HELD_OUT = Options(folds=0)
PHOTOS = Path(__file__).resolve().parents[3] / "shared" / "data" / "opencv_stereo"


@dataclass(frozen=True)
class PhotosSettings(Settings):
    """Settings: the photos, their board, and the number of pairs to leave out in turn (at most all)."""

    directory: str = str(PHOTOS)
    left: str = "left*.jpg"
    right: str = "right*.jpg"
    columns: Annotated[int, Ge(FEWEST_CORNERS)] = 9
    rows: Annotated[int, Ge(FEWEST_CORNERS)] = 6
    square: Positive = 0.025


def needs(settings: PhotosSettings) -> str:
    """Describe what is missing to run; empty if nothing."""
    there = Path(settings.directory)
    return "" if there.is_dir() else f"needs photos in {there}, which are not part of the project"


@functools.cache
def whole(settings: PhotosSettings) -> Calibration:
    """Calibrate from all pairs, once in a process."""
    board = BoardConfig(corners=(settings.columns, settings.rows), square=settings.square)
    return calibrate_photos(Path(settings.directory), settings.left, settings.right, board, options=NOT_HELD_OUT)


def jobs(settings: PhotosSettings) -> Sequence[int]:
    """Give the numbers of the pairs to leave out; one without a board has a number and no row."""
    pairs = len(list(Path(settings.directory).glob(settings.left)))
    return range(min(settings.seeds, max(pairs, 1)))


def one(settings: PhotosSettings, number: int) -> list[Row]:
    """Give the row of a left-out pair, and with the first one the row of all pairs."""
    calibration = whole(settings)
    pairs = sorted({view.board for view in calibration.views})
    rows = [_all(calibration)] if number == 0 else []
    return rows + [_without(calibration, pair) for pair in pairs[number : number + 1]]


def _all(whole: Calibration) -> Row:
    residuals, gamma = whole.residuals, whole.zoom_head.T_zoom0_fixed
    assert residuals is not None
    return {
        "pair": "all",
        "left_rms_px": residuals.fixed_rms_px,
        "right_rms_px": residuals.zoom_rms_px,
        "stereo_rms_px": residuals.stereo_rms_px,
        "baseline_mm": float(1e3 * np.linalg.norm(gamma.translation)),
        "baseline_sigma_mm": 1e3 * _baseline_sigma(whole),
        "pairs": residuals.pairs,
        "corners": int(sum(view.seen.sum() for view in whole.views)),
        "outliers": residuals.outliers,
        "rejected": len(residuals.rejected),
    }


def _without(whole: Calibration, pair: int) -> Row:
    """Calibrate without a pair, then fit the pose of its board alone."""
    assert whole.board is not None
    points = board_points(whole.board)
    sizes = {"fixed": whole.fixed.size, "zoom": whole.zoom_head.lens.size}
    others = [view for view in whole.views if view.board != pair]
    calibration = calibrate_views(others, whole.board, sizes, options=NOT_HELD_OUT)  # type: ignore[arg-type]
    mine = [view for view in whole.views if view.board == pair]
    left = fit(place_boards(model_of(calibration), mine, points), mine, points, ())
    name = ", ".join(str(view.source) for view in mine)
    baseline = float(1e3 * np.linalg.norm(calibration.zoom_head.T_zoom0_fixed.translation))
    corners = int(sum(view.seen.sum() for view in mine))
    return {"pair": name, "left_out_rms_px": left.rms_px, "baseline_mm": baseline, "corners": corners}


def _baseline_sigma(calibration: Calibration) -> float:
    """Give the standard deviation of the baseline [m]; nan without a covariance."""
    covariance = calibration.covariance
    if covariance is None:
        return float("nan")
    rows = [covariance.parameters.index(f"T_zoom0_fixed.{name}") for name in ("tx", "ty", "tz")]
    t = calibration.zoom_head.T_zoom0_fixed.translation
    along = t / np.linalg.norm(t)
    return float(np.sqrt(along @ covariance.matrix[np.ix_(rows, rows)] @ along))


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Give the figures of all pairs, and of the pairs left out."""
    whole, pairs = rows[0], rows[1:]
    squares = sum(row["left_out_rms_px"] ** 2 * row["corners"] for row in pairs)
    return {
        **{key: value for key, value in whole.items() if key not in ("pair", "left_out_rms_px")},
        "left_out_rms_px": float(np.sqrt(squares / sum(row["corners"] for row in pairs))),
        "left_out_worst_px": max(row["left_out_rms_px"] for row in pairs),
        "left_out_baseline_spread_mm": float(np.ptp([row["baseline_mm"] for row in pairs])),
        "left_out": {row["pair"]: row["left_out_rms_px"] for row in pairs},
    }


SETTINGS = PhotosSettings()
QUICK = replace(SETTINGS, seeds=2)
