"""Real stereo photos of a chessboard: rms of each camera and of the pair, the baseline, and each pair left out.

For each pair, both cameras and Gamma are calibrated from all others; then they are held, and only the board's pose is
fitted to the corners of both photos of the pair. All corners count. The photos are OpenCV's samples, looked for in
../shared/data/opencv_stereo beside the project, or one's own.

    python -m experiments.calibration.photos [DIR] [--left 'left*.jpg'] [--right 'right*.jpg'] [--board 9x6] [--square
    0.025]
                                 [--processes P] [--quick] [--out DIR]
"""

import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cotarget.board import board_points
from cotarget.calibration import Calibration, Options, calibrate_photos, calibrate_views
from cotarget.calibration.bundle import fit
from cotarget.calibration.initialization import place_boards
from cotarget.calibration.uncertainty import model_of
from cotarget.cli.common import board_corners, positive, positive_int
from cotarget.cli.main import Parser
from cotarget.config import FEWEST_CORNERS, BoardConfig
from experiments.engine.checks import check_above, check_least
from experiments.engine.harness import Experiment, Row, Settings
from experiments.engine.texts import rms, table

NOT_HELD_OUT = Options(folds=0)
PHOTOS = Path(__file__).resolve().parents[3] / "shared" / "data" / "opencv_stereo"


@dataclass(frozen=True)
class PhotosSettings(Settings):
    """Settings: the photos, their board, and the number of pairs to leave out in turn (at most all)."""

    directory: str = str(PHOTOS)
    left: str = "left*.jpg"
    right: str = "right*.jpg"
    columns: int = 9
    rows: int = 6
    square: float = 0.025

    def __post_init__(self) -> None:
        """Refuse impossible values."""
        super().__post_init__()
        check_least(FEWEST_CORNERS, self, "columns", "rows")
        check_above(0, self, "square")


def needs(settings: PhotosSettings) -> str:
    """Describe what is missing to run; empty if nothing."""
    there = Path(settings.directory)
    return "" if there.is_dir() else f"needs photos in {there}, which are not part of the project"


def whole(settings: PhotosSettings) -> Calibration:
    """Calibrate from all pairs."""
    board = BoardConfig(corners=(settings.columns, settings.rows), square=settings.square)
    return calibrate_photos(Path(settings.directory), settings.left, settings.right, board, options=NOT_HELD_OUT)


def jobs(settings: PhotosSettings) -> Sequence[int]:
    """Give the numbers of the pairs to leave out; one without a board has a number and no row."""
    pairs = len(list(Path(settings.directory).glob(settings.left)))
    return range(min(settings.seeds, max(pairs, 1)))


def one(calibration: Calibration, _: PhotosSettings, number: int) -> list[Row]:
    """Give the row of a left-out pair, and with the first one the row of all pairs."""
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
        **{key: value for key, value in whole.items() if key not in ("pair",)},
        "left_out_rms_px": float(np.sqrt(squares / sum(row["corners"] for row in pairs))),
        "left_out_worst_px": max(row["left_out_rms_px"] for row in pairs),
        "left_out_baseline_spread_mm": float(np.ptp([row["baseline_mm"] for row in pairs])),
        "left_out": {row["pair"]: row["left_out_rms_px"] for row in pairs},
    }


def describe(_: PhotosSettings, summary: Mapping[str, Any]) -> str:
    """Format the figures as a table, then the pairs."""
    figures = [[name.replace("_", " "), value] for name, value in summary.items() if name != "left_out"]
    pairs = [[name, value] for name, value in summary["left_out"].items()]
    return table(("all photos", ""), figures) + "\n\n" + table(("pair left out", "rms [px]"), pairs)


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """The rms of each pair left out."""
    ax = figure.subplots()
    ax.bar(range(len(rows) - 1), [row["left_out_rms_px"] for row in rows[1:]])
    ax.axhline(rms(row["left_out_rms_px"] for row in rows[1:]), color="k", lw=0.8)
    ax.set(xlabel="pair left out", ylabel="rms [px]")


SETTINGS = PhotosSettings()
EXPERIMENT = Experiment(
    "photos",
    "Real stereo photos: rms, baseline, and each pair left out.",
    SETTINGS,
    replace(SETTINGS, seeds=2),
    one,
    summarise,
    describe,
    plot,
    prepare=whole,
    jobs=jobs,
    needs=needs,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = Parser(prog="python -m experiments.calibration.photos", description=EXPERIMENT.purpose)
    parser.add_argument("directory", nargs="?", default=SETTINGS.directory, metavar="DIR", help="the photos")
    parser.add_argument("--left", default=SETTINGS.left, metavar="GLOB")
    parser.add_argument("--right", default=SETTINGS.right, metavar="GLOB")
    board = (SETTINGS.columns, SETTINGS.rows)
    parser.add_argument(
        "--board", type=board_corners, default=board, metavar="CxR", help="inner corners ({}x{})".format(*board)
    )
    parser.add_argument("--square", type=positive, default=SETTINGS.square, metavar="M", help="side of a square [m]")
    parser.add_argument("--processes", type=positive_int, default=os.cpu_count() or 1, metavar="P")
    parser.add_argument("--quick", action="store_true", help="leave out two pairs only")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write result.json, rows.csv and figure.png there")
    given = parser.parse_args(arguments)
    columns, rows = given.board
    settings = replace(
        EXPERIMENT.quick if given.quick else SETTINGS,
        directory=given.directory,
        left=given.left,
        right=given.right,
        columns=columns,
        rows=rows,
        square=given.square,
        processes=given.processes,
    )
    return EXPERIMENT.report(settings, given.out, quick=given.quick)


if __name__ == "__main__":
    sys.exit(main())
