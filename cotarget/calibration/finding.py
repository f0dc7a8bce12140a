"""From images on disk to views: whole boards first, then the parts of boards that long focal lengths show.

Parts of a plain chessboard are told apart by where they should be, so that the images at longer focal lengths wait
until those at the shortest have told the rig, and each zoom stop until the one before it is known; see `stops`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from cotarget.calibration.boards import another_board, board_points, find_corners, guess_corners
from cotarget.calibration.captures import CaptureIndex, read_images
from cotarget.calibration.joint import NO_PLACE, joint
from cotarget.calibration.model import DEFAULT_OPTIONS, CameraName, Capture, Options, Progress, Rejected, View, unseen
from cotarget.calibration.parameters import RigModel
from cotarget.calibration.recorder import view_of
from cotarget.calibration.stops import (
    SAME_FOCAL,
    expected_corners,
    find_expected,
    fit_stop,
    same_focal,
    stops_of,
    with_stop,
)
from cotarget.config import BoardConfig
from cotarget.errors import CalibrationError
from cotarget.geometry import Array

NO_BOARD = "no whole board of {}x{} corners is seen"
TWO_BOARDS = "two boards are in this picture; show one"
GUESSES = 10  # pictures in which another board is looked for when the one configured is in none
NOT_EXPECTED = "no part of the board is seen where it should be"
TEACHING_VIEWS = 4  # of a stop, after each of which it is fitted again


@dataclass(frozen=True, eq=False)
class Found:
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
) -> Found:
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
    return Found(tuple(views), tuple(rejected), sizes)


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
