"""From views, saved captures or plain photos to a `Calibration`, by a method that is named.

From images on disk to views: whole boards first, then the parts of boards that long focal lengths show.

Parts of a plain chessboard are told apart by where they should be, so that the images at longer focal lengths wait
until those at the shortest have told the rig, and each zoom stop until the one before it is known; see `stops`.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cotarget.board import board_points, check_board
from cotarget.calibration.captures import CaptureIndex, pair_photos, read_images, read_index
from cotarget.calibration.corners import another_board, find_corners, guess_corners
from cotarget.calibration.file import Calibration
from cotarget.calibration.initialization import FEWEST_CORNERS
from cotarget.calibration.joint import (
    NO_PLACE,
    SAME_FOCAL,
    expected_corners,
    find_expected,
    fit_stop,
    joint,
    same_focal,
    stops_of,
    with_stop,
)
from cotarget.calibration.model import (
    DEFAULT_OPTIONS,
    CameraName,
    Capture,
    Options,
    Progress,
    Rejected,
    RigModel,
    View,
    unseen,
)
from cotarget.calibration.sequential import sequential
from cotarget.calibration.session import SETTLE, CaptureRecorder, capture_session, view_of
from cotarget.config import BoardConfig, RigConfig
from cotarget.errors import CalibrationError, choices
from cotarget.geometry import Array
from cotarget.rig import Rig, opened_from

NO_BOARD = "no whole board of {}x{} corners is seen"
TWO_BOARDS = "two boards are in this picture; show one"
GUESSES = 10  # pictures in which another board is looked for when the one configured is in none
NOT_EXPECTED = "no part of the board is seen where it should be"
TEACHING_VIEWS = 4  # of a stop, after each of which it is fitted again


@dataclass(frozen=True, eq=False)
class FoundViews:
    """What images gave: views, what was left out, and the images' sizes (width, height) [px]."""

    views: tuple[View, ...]
    rejected: tuple[Rejected, ...]
    sizes: Mapping[CameraName, tuple[int, int]]


def find_view(capture: Capture, board: BoardConfig) -> View | None:
    """Find the board in a capture; None where no whole board is seen."""
    corners = find_corners(capture.image, board)
    return None if corners is None else view_of(capture, corners)


def beyond_shortest(name: str, focal_px: float, shortest_px: float) -> Rejected:
    """What is not used of the zoom camera where only its shortest nominal focal length is."""
    return Rejected(name, f"taken at {focal_px:.0f} px, not at the shortest focal length, {shortest_px:.0f} px")


def find_views(
    directory: Path, index: CaptureIndex, progress: Progress | None = None, *, options: Options = DEFAULT_OPTIONS
) -> FoundViews:
    """Find the boards in all images of an index; the sequential method's only at the shortest focal length.

    Args:
        directory: where the images lie.
        index: what they are.
        progress: called with what is done, of how much, and in words.
        options: how the views will be calibrated.

    Raises:
        CalibrationError: an image is missing or malformed, none shows a board, or those at the shortest focal length
            do not determine the rig.
    """
    sizes: dict[CameraName, tuple[int, int]] = {}
    views: list[View] = []
    rejected: list[Rejected] = []
    later: list[Capture] = []
    focals = [c.focal_px for c in index.captures if c.camera == "zoom" and c.focal_px is not None]
    shortest = min(focals, default=0.0)
    for done, capture in enumerate(read_images(directory, index.captures)):
        if progress is not None:
            progress(done, len(index.captures), f"looking for the board in {capture.source}")
        sizes[capture.camera] = (capture.image.shape[1], capture.image.shape[0])
        if capture.camera == "zoom" and capture.focal_px is not None and capture.focal_px > shortest * (1 + SAME_FOCAL):
            if options.method == "sequential":
                rejected.append(beyond_shortest(str(capture.source), capture.focal_px, shortest))
            else:
                later.append(capture)
            continue
        view = find_view(capture, index.board)
        if view is None:
            rejected.append(Rejected(str(capture.source), NO_BOARD.format(*index.board.corners)))
            if not views and len(rejected) == GUESSES and (other := _another_kind(capture, index.board)):
                raise CalibrationError(f"{directory}: {other}")  # long before all pictures were searched in vain
        elif another_board(capture.image, index.board, view.corners_px):
            rejected.append(Rejected(str(capture.source), TWO_BOARDS))
        else:
            views.append(view)
    if not views:
        raise CalibrationError(f"{directory}: {_why_none(directory, index, rejected)}")
    if later:
        if progress is not None:
            progress(len(index.captures), len(index.captures), "fitting the shortest focal length")
        more, lost = _find_parts(views, later, index.board, sizes, replace(options, folds=0))
        views += more
        rejected += lost
    return FoundViews(tuple(views), tuple(rejected), sizes)


def _why_none(directory: Path, index: CaptureIndex, rejected: Sequence[Rejected]) -> str:
    """Why no picture has given a view, as far as a look at some of them tells."""
    board = index.board
    name = f"{board.kind} of {board.corners[0]}x{board.corners[1]} inner corners"
    if two := [one.name for one in rejected if one.reason == TWO_BOARDS]:
        return f"no picture shows one {name} alone; {TWO_BOARDS}, like {two[0]}"
    every = max(len(index.captures) // GUESSES, 1)
    for capture in read_images(directory, index.captures[::every]):
        if other := _another_kind(capture, board):
            return other
    return f"no picture shows a whole {name}; check the board's corners, and that every picture shows all of it"


def _another_kind(capture: Capture, board: BoardConfig) -> str:
    """That a picture shows a chessboard of another size than the one configured; empty where it does not."""
    seen = guess_corners(capture.image) if board.kind == "chessboard" else None
    if seen is None or seen == board.corners:
        return ""
    return (
        f"no picture shows a whole chessboard of {board.corners[0]}x{board.corners[1]} inner corners; "
        f"a board of {seen[0]}x{seen[1]} is seen in {capture.source}"
    )


def _find_parts(
    views: Sequence[View],
    captures: Sequence[Capture],
    board: BoardConfig,
    sizes: Mapping[CameraName, tuple[int, int]],
    options: Options,
) -> tuple[list[View], list[Rejected]]:
    """Find whole or partly seen boards in images at the stops beyond the first, one stop after the other."""
    points = board_points(board)
    solution = joint(views, points, sizes, stops_of(views), options)
    model, known = solution.model, list(solution.views)
    blank = [(capture.image, view_of(capture, unseen(len(points)))) for capture in captures]
    rejected = [Rejected(view.name, NO_PLACE) for _, view in blank if view.board not in model.boards]
    found: list[View] = []
    for nominal in stops_of([view for _, view in blank]):
        assert model.zoom is not None
        model = replace(model, zoom=with_stop(model.zoom, nominal))
        here: list[View] = []
        waiting = [(image, view) for image, view in blank if same_focal(view, nominal) and view.board in model.boards]
        for learning in (True, False):  # what is seen teaches the stop; what was missed before may be seen then
            missed = []
            for image, view in waiting:
                corners = find_expected(image, board, expected_corners(model, view, points))
                if corners is None:
                    missed.append((image, view))
                    continue
                here.append(replace(view, corners_px=corners))
                if learning and len(here) <= TEACHING_VIEWS:
                    model = _taught(model, known, here, points)
            if here:
                model = _taught(model, known, here, points)
            waiting = missed
        rejected += [Rejected(view.name, NOT_EXPECTED) for _, view in waiting]
        found += here
    return found, rejected


def _taught(model: RigModel, known: Sequence[View], here: Sequence[View], points: Array) -> RigModel:
    """The model with its last stop fitted to the views at it."""
    numbers = {view.board for view in here}
    fixed = [view for view in known if view.camera == "fixed" and view.board in numbers]
    return fit_stop(model, model.stops - 1, [*fixed, *here], points)


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
            **_options_table(options),
            "when": datetime.now(UTC).isoformat(timespec="seconds"),
            "cotarget": version("cotarget"),
            "opencv": cv2.__version__,
            "numpy": version("numpy"),
            "scipy": version("scipy"),
            **(provenance or {}),
        },
    )


def _options_table(options: Options) -> dict[str, Any]:
    table = dataclasses.asdict(options)
    return {"insist" if name == "regularize" else name: value for name, value in table.items()}  # the file's key


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
    """Calibrate from captures that `calibrate` or somebody else saved; no rig is needed.

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
    pitch_mm: float | None = None,
    settle: float = SETTLE,
    config: RigConfig | None = None,
    options: Options = DEFAULT_OPTIONS,
) -> Calibration:
    """Drive a rig through a capture session, then calibrate it.

    Args:
        rig: of which nothing needs to be known.
        board: the board that its holder holds; that of the rig's configuration by default, and its `pitch_mm` too.
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
    if board is None:
        opened = opened_from(rig)
        board, pitch_mm = opened.board, opened.pitch_mm if pitch_mm is None else pitch_mm
    recorder = CaptureRecorder(rig, board, captures_dir, pitch_mm, settle, config)
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
