"""Calibrate a rig: from a rig, from saved captures, from plain photos, or from views, to a `Calibration`.

Images on disk are searched for whole boards at the shortest focal length first. At longer focal lengths the zoom camera
sees a part of a board, whose corners are numbered by a prediction. So these images wait until the rig is calibrated at
the shortest focal length, and those of each zoom sample until the one before is fitted.
"""

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cotarget.board import board_points, check_board
from cotarget.calibration.captures import NO_IMAGE, CaptureIndex, pair_photos, read_image, read_images, read_index
from cotarget.calibration.corners import another_board, find_corners, guess_corners
from cotarget.calibration.file import Calibration
from cotarget.calibration.initialization import FEWEST_CORNERS, sequential
from cotarget.calibration.joint import NO_PLACE, joint
from cotarget.calibration.model import (
    CAMERAS,
    DEFAULT_OPTIONS,
    BundleModel,
    CameraName,
    Capture,
    Options,
    Rejected,
    View,
    unseen,
)
from cotarget.calibration.recorder import CaptureRecorder, with_stills
from cotarget.calibration.session import capture_session
from cotarget.calibration.zoom_samples import (
    SAME_FOCAL,
    fewest_stops,
    find_expected,
    fit_stop,
    same_focal,
    stops_of,
    with_stop,
)
from cotarget.config import BoardConfig
from cotarget.errors import CalibrationError, choices
from cotarget.geometry import Array
from cotarget.parallel import Progress, progress_bar
from cotarget.rig import Rig, opened_from

log = logging.getLogger(__name__)
NO_BOARD = "no whole board of {}x{} corners is seen"
TWO_BOARDS = "two boards are in this image; show one"
GUESSES = 10  # images searched for another size of board when none shows the configured one
NOT_EXPECTED = "no part of the board is seen where it should be"
LEARNING_VIEWS = 4  # first views of a zoom sample, after each of which it is fitted again


def beyond_shortest(name: str, focal_px: float, shortest_px: float) -> Rejected:
    """Reject an image or view beyond the shortest nominal focal length, for a method that uses only that."""
    return Rejected(name, f"taken at {focal_px:.0f} px, not at the shortest focal length, {shortest_px:.0f} px")


def find_views(
    directory: Path, index: CaptureIndex, progress: Progress, options: Options
) -> tuple[list[View], list[Rejected], dict[CameraName, tuple[int, int]]]:
    """Find the boards in all images of an index; for the sequential method, only at the shortest focal length.

    Returns the views, the images without a usable board, and each camera's image size (width, height) [px].
    """
    sizes: dict[CameraName, tuple[int, int]] = {}
    views: list[View] = []
    rejected: list[Rejected] = []
    later: list[Capture] = []
    focals = [c.focal_px for c in index.captures if c.camera == "zoom" and c.focal_px is not None]
    shortest = min(focals, default=0.0)
    for done, capture in enumerate(read_images(directory, index.captures)):
        progress(done, len(index.captures), f"looking for the board in {capture.source}")
        sizes[capture.camera] = (capture.image.shape[1], capture.image.shape[0])
        if capture.camera == "zoom" and capture.focal_px is not None and capture.focal_px > shortest * (1 + SAME_FOCAL):
            if options.method == "sequential":
                rejected.append(beyond_shortest(str(capture.source), capture.focal_px, shortest))
            else:
                later.append(replace(capture, image=NO_IMAGE))  # read again when its turn comes, to save memory
            continue
        corners = find_corners(capture.image, index.board)
        if corners is None:
            rejected.append(Rejected(str(capture.source), NO_BOARD.format(*index.board.corners)))
            if not views and len(rejected) == GUESSES and (other := _another_kind(capture, index.board)):
                raise CalibrationError(f"{directory}: {other}")  # early, before all images are searched in vain
        elif another_board(capture.image, index.board, corners):
            rejected.append(Rejected(str(capture.source), TWO_BOARDS))
        else:
            views.append(capture.view(corners))
    if not views:
        raise CalibrationError(f"{directory}: {_why_none(directory, index, rejected)}")
    if later:
        progress(len(index.captures), len(index.captures), "fitting the shortest focal length")
        more, lost = _find_parts(directory, views, later, index.board, sizes, replace(options, folds=0))
        views += more
        rejected += lost
    return views, rejected, sizes


def _why_none(directory: Path, index: CaptureIndex, rejected: Sequence[Rejected]) -> str:
    """Explain why no image gave a view, from a second search of some of them."""
    board = index.board
    name = f"{board.kind} of {board.corners[0]}x{board.corners[1]} inner corners"
    if two := [one.name for one in rejected if one.reason == TWO_BOARDS]:
        return f"no image shows one {name} alone; {TWO_BOARDS}, like {two[0]}"
    every = max(len(index.captures) // GUESSES, 1)
    for capture in read_images(directory, index.captures[::every]):
        if other := _another_kind(capture, board):
            return other
    return f"no image shows a whole {name}; check the board's corners, and that every image shows all of it"


def _another_kind(capture: Capture, board: BoardConfig) -> str:
    """Describe a chessboard of another size than the configured one in an image; empty where there is none."""
    seen = guess_corners(capture.image) if board.kind == "chessboard" else None
    if seen is None or seen == board.corners:
        return ""
    return (
        f"no image shows a whole chessboard of {board.corners[0]}x{board.corners[1]} inner corners; "
        f"a board of {seen[0]}x{seen[1]} is seen in {capture.source}"
    )


def _find_parts(
    directory: Path,
    views: Sequence[View],
    captures: Sequence[Capture],
    board: BoardConfig,
    sizes: Mapping[CameraName, tuple[int, int]],
    options: Options,
) -> tuple[list[View], list[Rejected]]:
    """Find whole or partly seen boards in images at the zoom samples beyond the first, one sample after the other."""
    points = board_points(board)
    solution = joint(views, points, sizes, stops_of(views), options)
    model, known = solution.model, list(solution.views)
    blank = [capture.view(unseen(len(points))) for capture in captures]
    rejected = [Rejected(view.name, NO_PLACE) for view in blank if view.board not in model.boards]
    found: list[View] = []
    for nominal in stops_of(blank):
        model = model.with_zoom_head(lens=with_stop(model.head.lens, nominal))
        here: list[View] = []
        waiting = [view for view in blank if same_focal(view, nominal) and view.board in model.boards]
        for learning in (True, False):  # images missed in the first round may be found once the sample is fitted
            missed = []
            for view in waiting:
                corners = find_expected(read_image(directory / view.name), view, model, board)
                if corners is None:
                    missed.append(view)
                    continue
                here.append(replace(view, corners_px=corners))
                if learning and len(here) <= LEARNING_VIEWS:
                    model = _with_last_fitted(model, known, here, points)
            if here:
                model = _with_last_fitted(model, known, here, points)
            waiting = missed
        rejected += [Rejected(view.name, NOT_EXPECTED) for view in waiting]
        found += here
    return found, rejected


def _with_last_fitted(model: BundleModel, known: Sequence[View], here: Sequence[View], points: Array) -> BundleModel:
    """Fit the last zoom sample of a model to the views at it."""
    numbers = {view.board for view in here}
    fixed = [view for view in known if view.camera == "fixed" and view.board in numbers]
    return fit_stop(model, model.stops - 1, [*fixed, *here], points)


# Calibration from views, captures, photos and rigs

# Thirty placements point to a few thousandths of a degree; a session of them takes about 15 s on two cores.
PLACEMENTS = 30
# Eight zoom samples follow a twelvefold zoom to some hundredths of a percent; six placements see each twelve times.
STOPS, FAR_PLACEMENTS = 8, 6
METHODS = ("joint", "sequential")
# Points this near to a line are on it: on the board by rounding [m], in the image because corners are rounded [px].
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
    """Calibrate a rig from views, in any order.

    Args:
        views: views of both cameras. The sequential method leaves out zoom views that are not at the shortest focal
            length.
        board: the board of the views.
        sizes: image sizes (width, height) of "fixed" and "zoom" [px].
        pitch_mm: pixel size of the zoom camera [mm]; None if unknown.
        options: options of the calibration.
        rejected: images left out before, for the report.
        provenance: origin of the views; versions and options are added.

    Raises:
        CalibrationError: the views do not determine the rig.
        ConfigError: the board looks the same upside down.
    """
    if options.method not in METHODS:
        raise CalibrationError(f"unknown method '{options.method}'; the methods are: {choices(METHODS)}")
    check_board(board)
    _check_views(views, board)
    views = sorted(views, key=_canonical_order)
    nominal = stops_of(views)
    points = board_points(board)
    others: list[Rejected] = []
    if options.method == "joint":
        solution = joint(views, points, sizes, nominal, options)
    else:
        shortest, others = _at_shortest(views, nominal)
        solution = sequential(shortest, points, sizes, nominal[0] if nominal else None)
    head = solution.model.head
    return Calibration(
        fixed=solution.model.fixed,
        zoom_head=head if solution.has_head else replace(head, T_head_zoom=None),
        pitch_mm=pitch_mm,
        residuals=replace(solution.residuals, rejected=(*rejected, *others, *solution.residuals.rejected)),
        covariance=solution.covariance,
        jitter=solution.jitter,
        held_out=solution.held_out,
        board_warp=solution.model.warp,
        board=board,
        views=solution.views,
        provenance={
            **{"insist" if key == "regularize" else key: value for key, value in dataclasses.asdict(options).items()},
            "when": datetime.now(UTC).isoformat(timespec="seconds"),
            "cotarget": version("cotarget"),
            "opencv": cv2.__version__,
            "numpy": version("numpy"),
            "scipy": version("scipy"),
            **(provenance or {}),
        },
    )


def _check_views(views: Sequence[View], board: BoardConfig) -> None:
    """Refuse views whose corners do not belong to this board, or do not determine its pose."""
    columns, rows = board.corners
    points = board_points(board)
    for view in views:
        corners = view.corners_px
        if corners.shape != (len(points), 2) or np.isinf(corners).any() or view.seen.sum() < FEWEST_CORNERS:
            raise CalibrationError(
                f"{view.name}: has not the {len(points)} finite corners of a {columns}x{rows} board, or the "
                f"{FEWEST_CORNERS} of them that determine its pose"
            )
        if not determines_pose(view, points):
            raise CalibrationError(
                f"{view.name}: all corners seen lie on one line, which leaves the board's pose open; leave it out"
            )


def determines_pose(view: View, points: Array) -> bool:
    """Check whether the corners seen determine the board's pose: enough of them, and not all on one line."""
    seen = view.seen
    if np.count_nonzero(seen) < FEWEST_CORNERS:
        return False
    both = ((points[seen], LINE_M), (view.corners_px[seen], LINE_PX))
    return all(np.linalg.matrix_rank(at - at.mean(axis=0), tol=tol) > 1 for at, tol in both)


def _canonical_order(view: View) -> tuple[Any, ...]:
    """Make a key that sorts views, so that the rounding of sums does not depend on the order given."""
    return view.camera, view.board, view.focal_px or 0.0, view.pan, view.tilt, view.corners_px.tobytes()


def _at_shortest(views: Sequence[View], nominal: Sequence[float]) -> tuple[list[View], list[Rejected]]:
    """Keep the views of the fixed camera, and those of the zoom camera at its shortest nominal focal length."""
    kept, left_out = [], []
    for view in views:
        if view.camera == "fixed" or view.focal_px is None or view.focal_px <= nominal[0] * (1 + SAME_FOCAL):
            kept.append(view)
        else:
            left_out.append(beyond_shortest(view.name, view.focal_px, nominal[0]))
    return kept, left_out


def calibrate_captures(
    directory: Path, *, options: Options = DEFAULT_OPTIONS, progress: Progress | None = None
) -> Calibration:
    """Calibrate from saved captures, by `calibrate` or by another program; no rig is needed.

    Args:
        directory: folder with index.json and its images.
        options: options of the calibration.
        progress: as in `calibrate`.

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
        zoom_glob: pattern of the zoom camera's files, taken at pan = tilt = 0 or without a head.
        board: the board in the photos.
        options: options of the calibration.
        progress: as in `calibrate`.

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
    with progress_bar(progress) as show:
        views, unusable, sizes = find_views(directory, index, show, options)
        show(len(index.captures), len(index.captures), "fitting")
        return calibrate_views(
            views,
            index.board,
            sizes,
            pitch_mm=index.pitch_mm,
            options=options,
            rejected=(*rejected, *unusable),
            provenance={what: str(directory), "images": len(index.captures)},
        )


def _enough_stops(wanted: int, focal_range_px: tuple[float, float]) -> int:
    """Choose the number of zoom samples: as requested, or as many as predicting a board across them needs."""
    needed = fewest_stops(*focal_range_px)
    if not 1 < wanted < needed:
        return wanted
    log.warning(
        "stops: %d zoom samples are too far apart to predict the next from the last; %d are taken", wanted, needed
    )
    return needed


def calibrate(
    rig: Rig,
    board: BoardConfig | None = None,
    *,
    captures_dir: Path | None = None,
    progress: Progress | None = None,
    placements: int = PLACEMENTS,
    stops: int = STOPS,
    far_placements: int = FAR_PLACEMENTS,
    seed: int = 0,
    options: Options = DEFAULT_OPTIONS,
) -> Calibration:
    """Drive a rig through a capture session, and calibrate it from the views, which takes minutes.

    The zoom camera takes full stills where it has them.

    Args:
        rig: rig to calibrate; no earlier calibration is needed.
        board: the board in use; None for that of the rig's configuration.
        captures_dir: folder for the images; None to keep none.
        progress: called with the number done, the total, and a text; by default it is shown on stderr.
        placements: number of placements of the board at the shortest focal length, at least 7.
        stops: number of zoom samples, evenly spread over the logarithm of the lens's range, and more where they would
            be too far apart; 1 for the shortest alone.
        far_placements: number of further placements, far away, for the zoom samples beyond the first.
        seed: seed of the choice among possible placements.
        options: options of the calibration.

    Raises:
        CalibrationError: a camera never sees the board, there is no common view, or the head fails.
        ConfigError: the board looks the same upside down, or the session is too short.
    """
    rig = with_stills(rig)
    board = opened_from(rig).board if board is None else board
    stops = _enough_stops(stops, rig.zoom.focal_range)
    recorder = CaptureRecorder(rig, board, captures_dir)
    rng = np.random.default_rng(seed)
    provenance = {
        "rig": type(rig).__name__,
        "seed": seed,
        "placements": placements,
        "stops": stops,
        "far_placements": far_placements,
        "focal_range_px": [float(focal) for focal in rig.zoom.focal_range],
    }
    with progress_bar(progress) as show:
        capture_session(recorder, placements, rng, show, stops=stops, far_placements=far_placements)
        return calibrate_views(
            recorder.views,
            board,
            {"fixed": rig.fixed.size, "zoom": rig.zoom.size},
            pitch_mm=rig.spec.zoom.pitch_mm,
            options=options,
            rejected=recorder.rejected,
            provenance=provenance | ({} if captures_dir is None else {"captures": str(captures_dir)}),
        )
