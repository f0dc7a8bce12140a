"""From views, saved captures or plain photos to a `Calibration`, by a method that is named."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cotarget import __version__
from cotarget.calibration.boards import board_points, check_board
from cotarget.calibration.captures import CaptureIndex, pair_photos, read_index
from cotarget.calibration.finding import beyond_shortest, find_views
from cotarget.calibration.intrinsics import FEWEST_CORNERS
from cotarget.calibration.joint import joint
from cotarget.calibration.model import DEFAULT_OPTIONS, Calibration, CameraName, Options, Progress, Rejected, View
from cotarget.calibration.recorder import SETTLE, Recorder
from cotarget.calibration.sequential import sequential
from cotarget.calibration.session import capture_session
from cotarget.calibration.stops import SAME_FOCAL, stops_of
from cotarget.config import BoardConfig, RigConfig
from cotarget.errors import CalibrationError, choices
from cotarget.geometry import Array
from cotarget.rig import Rig

# Thirty placements point to a few thousandths of a degree; a session of them takes about 15 s on two cores.
PLACEMENTS = 30
# Eight stops follow a twelvefold zoom to some hundredths of a percent; six placements see each twelve times.
STOPS, FAR_PLACEMENTS = 8, 6
METHODS = ("joint", "sequential")
CAMERAS: tuple[CameraName, ...] = ("fixed", "zoom")
# Corners that depart from a line by less are on it: the board's by rounding [m], the image's as corners are rounded.
LINE_M, LINE_PX = 1e-9, 1e-3


def calibrate_views(
    views: Sequence[View],
    board: BoardConfig,
    sizes: Mapping[CameraName, tuple[int, int]],
    *,
    pitch_mm: float | None = None,
    options: Options = DEFAULT_OPTIONS,
    rejected: Sequence[Rejected] = (),
    provenance: Mapping[str, Any] | None = None,
) -> Calibration:
    """Calibrate from corners. The order of the views does not matter.

    Args:
        views: of both cameras. The sequential method leaves out those of the zoom camera that are not at its shortest
            focal length.
        board: what the corners are of.
        sizes: (width, height) of the images of "fixed" and "zoom" [px].
        pitch_mm: size of a pixel of the zoom camera [mm], where it is known.
        options: how to calibrate.
        rejected: images already left out, and why, for the report.
        provenance: where the views come from; versions and method are added.

    Raises:
        CalibrationError: the views do not determine the rig.
        ConfigError: the board looks the same upside down.
    """
    if options.method not in METHODS:
        raise CalibrationError(f"unknown method '{options.method}'; the methods are: {choices(METHODS)}")
    check_board(board)
    _check_views(views, board)
    views = _in_canonical_order(views)
    nominal = stops_of(views)
    points = board_points(board)
    others: list[Rejected] = []
    if options.method == "joint":
        solution = joint(views, points, sizes, nominal, options)
    else:
        shortest, others = _at_shortest(views, nominal)
        solution = sequential(shortest, points, sizes, nominal[0] if nominal else None)
    model = solution.model
    assert model.fixed is not None
    assert model.zoom is not None
    return Calibration(
        fixed=model.fixed,
        zoom=model.zoom,
        T_zoom0_fixed=model.gamma,
        T_head_zoom=model.hand if solution.has_head else None,
        head=model.head,
        pitch_mm=pitch_mm,
        residuals=replace(solution.residuals, rejected=(*rejected, *others, *solution.residuals.rejected)),
        covariance=solution.covariance,
        jitter=solution.jitter,
        held_out=solution.held_out,
        board_warp=solution.model.warp,
        board=board,
        views=solution.views,
        provenance={
            **dataclasses.asdict(options),
            "when": datetime.now(UTC).isoformat(timespec="seconds"),
            "cotarget": __version__,
            "opencv": cv2.__version__,
            "numpy": version("numpy"),
            "scipy": version("scipy"),
            **(provenance or {}),
        },
    )


def _check_views(views: Sequence[View], board: BoardConfig) -> None:
    """Refuse corners that are not of this board, or do not tell its pose."""
    columns, rows = board.corners
    points = board_points(board)
    for view in views:
        corners = view.corners_px
        if corners.shape != (columns * rows, 2) or np.isinf(corners).any() or view.seen.sum() < FEWEST_CORNERS:
            raise CalibrationError(
                f"{view.name}: has not the {columns * rows} finite corners of a {columns}x{rows} board, or the "
                f"{FEWEST_CORNERS} of them that tell its pose"
            )
        if not tells_pose(view, points):
            raise CalibrationError(
                f"{view.name}: all corners seen lie on one line, which does not tell the board's pose; leave it out"
            )


def tells_pose(view: View, points: Array) -> bool:
    """Whether the corners seen are enough for the board's pose, and not all on one line.

    Args:
        view: of a board.
        points: the board's corners in its frame [m], (N, 3).
    """
    seen = view.seen
    if np.count_nonzero(seen) < FEWEST_CORNERS:
        return False
    both = ((points[seen], LINE_M), (view.corners_px[seen], LINE_PX))
    return all(np.linalg.matrix_rank(at - at.mean(axis=0), tol=tol) > 1 for at, tol in both)


def _in_canonical_order(views: Sequence[View]) -> list[View]:
    """The same views in an order that does not depend on the one given, so that sums round alike."""

    def key(view: View) -> tuple[Any, ...]:
        return view.camera, view.board, view.focal_px or 0.0, view.pan, view.tilt, view.corners_px.tobytes()

    return sorted(views, key=key)


def _at_shortest(views: Sequence[View], nominal: Sequence[float]) -> tuple[list[View], list[Rejected]]:
    """Keep the zoom camera's views at its shortest nominal focal length."""

    def keep(view: View) -> bool:
        return view.camera == "fixed" or view.focal_px is None or view.focal_px <= nominal[0] * (1 + SAME_FOCAL)

    left_out = [
        beyond_shortest(view.name, view.focal_px, nominal[0])
        for view in views
        if view.focal_px is not None and not keep(view)
    ]
    return [view for view in views if keep(view)], left_out


def calibrate_captures(
    directory: Path, *, options: Options = DEFAULT_OPTIONS, progress: Progress | None = None
) -> Calibration:
    """Calibrate from captures that `calibrate_rig` or somebody else saved; no rig is needed.

    Args:
        directory: folder with index.json and its images.
        options: how to calibrate.
        progress: called with what is done, of how much, and in words.

    Raises:
        CalibrationError: a file is missing or malformed, or the views do not determine the rig.
    """
    index = read_index(directory)
    return _calibrate_images(directory, index, options, progress, rejected=[], what="captures")


def calibrate_photos(
    directory: Path,
    fixed_glob: str,
    zoom_glob: str,
    board: BoardConfig,
    *,
    options: Options = DEFAULT_OPTIONS,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate both cameras and Gamma from plain photos, paired by the last number in their names.

    Args:
        directory: folder of the photos.
        fixed_glob: pattern of the fixed camera's files, like 'left*.jpg'.
        zoom_glob: pattern of the zoom camera's, taken at pan = tilt = 0 or without any head.
        board: what the photos show.
        options: how to calibrate.
        progress: called with what is done, of how much, and in words.

    Raises:
        CalibrationError: there are no pairs, or they do not determine the cameras.
        ConfigError: the board looks the same upside down.
    """
    captures, unpaired = pair_photos(directory, fixed_glob, zoom_glob)
    if not captures:
        raise CalibrationError(f"{directory}: no two photos of '{fixed_glob}' and '{zoom_glob}' have the same number")
    rejected = [Rejected(name, "has no partner with the same number") for name in unpaired]
    index = CaptureIndex(board, None, tuple(captures))
    return _calibrate_images(directory, index, options, progress, rejected, what="photos")


def _calibrate_images(
    directory: Path,
    index: CaptureIndex,
    options: Options,
    progress: Progress | None,
    rejected: list[Rejected],
    what: str,
) -> Calibration:
    check_board(index.board)
    for camera in CAMERAS:
        if not any(capture.camera == camera for capture in index.captures):
            raise CalibrationError(f"{directory}: has no capture of the {camera} camera; both cameras are needed")
    found = find_views(directory, index, progress, options=options)
    if progress is not None:
        progress(len(index.captures), len(index.captures), "fitting")
    return calibrate_views(
        found.views,
        index.board,
        found.sizes,
        pitch_mm=index.pitch_mm,
        options=options,
        rejected=(*rejected, *found.rejected),
        provenance={what: str(directory), "images": len(index.captures)},
    )


def calibrate_rig(
    rig: Rig,
    board: BoardConfig,
    *,
    captures_dir: Path | None = None,
    progress: Progress | None = None,
    placements: int = PLACEMENTS,
    stops: int = STOPS,
    far_placements: int = FAR_PLACEMENTS,
    seed: int = 0,
    pitch_mm: float | None = None,
    settle: float = SETTLE,
    config: RigConfig | None = None,
    options: Options = DEFAULT_OPTIONS,
) -> Calibration:
    """Drive a rig through a capture session, then calibrate it.

    Args:
        rig: of which nothing needs to be known.
        board: the board that its holder holds.
        captures_dir: where to keep the images; None to keep none.
        progress: called with what is done, of how much, and in words.
        placements: how many placements of the board, at the shortest focal length.
        stops: how many stops of the zoom lens, evenly spread over its range; 1 for the shortest alone.
        far_placements: how many more placements, far away, for the stops beyond the first.
        seed: of the choice among possible placements.
        pitch_mm: size of a pixel of the zoom camera [mm], where it is known.
        settle: how long after a stop of head or board an image is still taken for one of before [s].
        config: of the rig, to be kept beside the captures.
        options: how to calibrate.

    Raises:
        CalibrationError: a camera never sees the board, there is no common view, or the head fails.
        ConfigError: the board looks the same upside down.
    """
    recorder = Recorder(rig, board, captures_dir, pitch_mm, settle, config)
    rng = np.random.default_rng(seed)
    capture_session(recorder, placements, rng, progress, stops=stops, far_placements=far_placements)
    provenance = {
        "rig": type(rig).__name__,
        "seed": seed,
        "placements": placements,
        "stops": stops,
        "far_placements": far_placements,
        "focal_range_px": [float(focal) for focal in rig.zoom.focal_range],
    }
    return calibrate_views(
        recorder.views,
        board,
        {"fixed": rig.fixed.size, "zoom": rig.zoom.size},
        pitch_mm=pitch_mm,
        options=options,
        rejected=recorder.rejected,
        provenance=provenance | ({} if captures_dir is None else {"captures": str(captures_dir)}),
    )
