"""Real films with labels: the detector beside OpenCV's MOG2 and KNN, with one tracker and every threshold.

The mixtures' foreground is grouped with gaps of 3 px, and swept over its threshold and its smallest area; the detector
is swept over the score from which a track is confirmed. Tracks and labels are matched one to one, from frame 30 on, see
`cotarget.track_metrics`. Of each way, the best recall at a given rate of false tracks counts. The films are the
labelled ones of the Drone-detection-dataset, looked for in ../shared/data beside the project, or one's own.
"""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from cotarget.config import DEFAULT_TARGETS, DetectorName, TargetProfile
from cotarget.detect_video import labelled_films
from cotarget.detection import Detector, make_detector
from cotarget.detection.background import pieces
from cotarget.detection.base import box_detection
from cotarget.files import read_table
from cotarget.pipeline import CameraRun
from cotarget.rig import Detection, Frame, Image
from cotarget.track_metrics import Box, Criterion, Label, Tracked, read_labels, score_tracks
from cotarget.tracking.track import tracking_settings
from cotarget.tracking.tracker import Tracker
from cotarget.video import Film
from experiments.engine import Count, Row, Settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
MIXTURES = {"MOG2": cv2.createBackgroundSubtractorMOG2, "KNN": cv2.createBackgroundSubtractorKNN}
# Flyers of these films that have no label, found by looking at every false track: a box about every fifth frame. One is
# listed while it is seen to fly, not where it is lost among twigs.
UNLABELLED = Path(__file__).with_name("unlabelled_flyers.csv")
# False tracks a minute at which the ways are compared, and by how much the detector must be ahead at the first two.
FALSE_PER_MIN = (0.5, 5.0, 50.0)
AHEAD = 0.05
# Gaps that are closed in the mixtures' foreground [px].
BRIDGE_PX = (3, 3)


def off_boxes(tracks: Iterable[Tracked], boxes: Mapping[int, Sequence[Box]], criterion: Criterion) -> list[Tracked]:
    """Leave out what lies on boxes that must not count, by frame number: flyers that have no label."""
    kept = []
    for frame, group in itertools.groupby(sorted(tracks, key=lambda each: each.frame), key=lambda each: each.frame):
        found = list(group)
        near = criterion.similarity(boxes.get(frame, []), found) >= criterion.iou - np.finfo(float).eps
        excused: list[bool] = np.any(near, axis=0).tolist()
        kept += [each for each, excuse in zip(found, excused, strict=True) if not excuse]
    return kept


@dataclass(frozen=True)
class FolderSettings(Settings):
    """Settings of all experiments on films: folders of films with their labels, and most films, as seeds."""

    seeds: Count = 1000
    folders: tuple[str, ...] = (str(DATA / "flyers"), str(DATA / "birds"))


@dataclass(frozen=True)
class FilmsSettings(FolderSettings):
    """Settings: the detector, and what is swept."""

    detector: DetectorName = "auto"
    scores: tuple[float, ...] = (0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99)  # from which a track is confirmed
    thresholds: tuple[float, ...] = (9.0, 16.0, 36.0, 100.0, 400.0)  # of MOG2, in variances; KNN's is 25 times as large
    areas_px: tuple[int, ...] = (4, 16, 64, 256)  # smallest of a component


def needs(settings: FolderSettings) -> str:
    """Describe what is missing to run; empty if nothing."""
    lacking = [folder for folder in settings.folders if not Path(folder).is_dir()]
    return f"needs films in {lacking[0]}, which are not part of the project" if lacking else ""


def films(settings: FolderSettings) -> list[tuple[Path, Path]]:
    """List the films and their labels."""
    return [pair for folder in settings.folders for pair in labelled_films(Path(folder), Path(folder))]


def jobs(settings: FolderSettings) -> Sequence[int]:
    """Give the films' numbers; one where there is no film."""
    return range(1 if needs(settings) else min(settings.seeds, len(films(settings))))


def one(settings: FilmsSettings, number: int) -> list[Row]:
    """Search a film in every way; give a row for each."""
    film = labelled_film(*films(settings)[number])
    found = detector_tracks(settings.detector, settings.scores, film.frames, film.rate_hz)
    rows = [film.row(settings.detector, least, 0, tracks) for least, tracks in found.items()]
    for way, threshold in itertools.product(MIXTURES, settings.thresholds):
        for area, tracks in mixture_tracks(way, threshold, settings.areas_px, film.frames).items():
            rows.append(film.row(way, threshold, area, tracks))
    return [{"seed": number, **row} for row in rows]


@dataclass(frozen=True)
class LabelledFilm:
    """A film with its labels.

    Attributes:
        name: name of its file.
        frames: all frames.
        rate_hz: frame rate [Hz].
        labels: labels by frame number.
        flyers: boxes of flyers without a label, by frame number.
        criterion: when a track is on a label.
    """

    name: str
    frames: list[Frame]
    rate_hz: float
    labels: dict[int, list[Label]]
    flyers: dict[int, list[Box]]
    criterion: Criterion = field(default_factory=Criterion)

    def row(self, way: str, threshold: float, area: int, tracks: Iterable[Tracked]) -> Row:
        """Score the tracks of a way with a threshold and a smallest area [px]."""
        score, others = (
            score_tracks(found, self.labels, self.rate_hz, len(self.frames), criterion=self.criterion)
            for found in (tracks, off_boxes(tracks, self.flyers, self.criterion))
        )
        return {
            "film": self.name,
            "way": way,
            "threshold": threshold,
            "smallest_px": area,
            "boxes": score.boxes,
            "found": score.found,
            "false_tracks": score.false_tracks,
            "no_flyer": others.false_tracks,
            "minutes": len(self.frames) / self.rate_hz / 60,
        }


def labelled_film(video: Path, labels: Path) -> LabelledFilm:
    """Read a film and its labels."""
    with Film(video) as film:
        return LabelledFilm(video.stem, list(film), film.rate_hz, labels_of(labels), unlabelled_flyers(video.stem))


def labels_of(path: Path) -> dict[int, list[Label]]:
    """Read the labels of a film of the collection, whose pixels count from 1."""
    return {
        frame: [replace(label, center_px=label.center_px - 1) for label in labels]
        for frame, labels in read_labels(path).items()
    }


def unlabelled_flyers(film: str) -> dict[int, list[Box]]:
    """Give the boxes of a film's flyers without a label, by frame number; between those listed on a straight line."""
    columns = {"film": str, "flyer": int} | dict.fromkeys(("frame", "x_px", "y_px", "width_px", "height_px"), float)
    rows = [row for row in read_table(UNLABELLED, columns, "flyers without a label") if row["film"] == film]
    found: dict[int, list[Box]] = {}
    for flyer in {row["flyer"] for row in rows}:
        path = [[row[name] for name in list(columns)[2:]] for row in rows if row["flyer"] == flyer]
        at, *sides = np.array(path).T
        for frame in range(int(at[0]), int(at[-1]) + 1):
            x, y, width, height = (np.interp(frame, at, side) for side in sides)
            center = np.array([x + (width - 1) / 2, y + (height - 1) / 2])
            found.setdefault(frame, []).append(Box(center, np.array([width, height])))
    return found


def detector_tracks(
    name: DetectorName, scores: Sequence[float], frames: Sequence[Frame], rate_hz: float
) -> dict[float, list[Tracked]]:
    """Track what a detector finds, for each score from which a track is confirmed; the usual one holds."""
    target = replace(DEFAULT_TARGETS["bird"], detector=name)
    return tracks_of(make_detector(target, rate_hz), target, scores, frames)


def tracks_of(
    detector: Detector, target: TargetProfile, scores: Sequence[float], frames: Sequence[Frame]
) -> dict[float, list[Tracked]]:
    """Track what a detector of a target finds, as `detector_tracks` does."""
    usual = tracking_settings(target)
    size = frames[0].image.shape[1], frames[0].image.shape[0]
    own = Tracker(usual, size)
    trackers = {least: Tracker(replace(usual, confirm_score=least), size) for least in scores}
    tracks: dict[float, list[Tracked]] = {least: [] for least in scores}
    camera = CameraRun(detector, own)
    for index, frame in enumerate(frames):
        found = camera.track(frame)
        for least, tracker in trackers.items():
            tracker.update(found.boxes, frame.t, found.shift, cut=found.cut)
            tracks[least] += _confirmed(tracker, index, frame)
    return tracks


def mixture_tracks(
    way: str, threshold: float, areas_px: Sequence[int], frames: Sequence[Frame]
) -> dict[int, list[Tracked]]:
    """Track what a mixture finds at a threshold of MOG2 [variances], for each smallest area [px].

    KNN's threshold is 25 times as large.
    """
    model = MIXTURES[way](500, threshold if way == "MOG2" else 25 * threshold, False)
    return foreground_tracks(lambda image: np.asarray(model.apply(image), dtype=np.uint8), areas_px, frames)


def foreground_tracks(
    subtract: Callable[[Image], Image], areas_px: Sequence[int], frames: Sequence[Frame]
) -> dict[int, list[Tracked]]:
    """Track the components of what a function makes of each image, 255 for foreground, for each smallest area [px]."""
    settings = tracking_settings(replace(DEFAULT_TARGETS["bird"], detector="mog2"))
    size = frames[0].image.shape[1], frames[0].image.shape[0]
    trackers = {area: Tracker(settings, size) for area in areas_px}
    tracks: dict[int, list[Tracked]] = {area: [] for area in areas_px}
    for index, frame in enumerate(frames):
        found = _components(subtract(frame.image))
        for area, tracker in trackers.items():
            tracker.update([each for pixels, each in found if pixels >= area], frame.t)
            tracks[area] += _confirmed(tracker, index, frame)
    return tracks


def _components(mask: Image) -> list[tuple[int, Detection]]:
    """Find the components of a mask, with their numbers of pixels, the largest first."""
    found = []
    for x, y, w, h in pieces(mask, BRIDGE_PX):
        inside = mask[y : y + h, x : x + w]
        dx, dy, width, height = cv2.boundingRect(inside)
        found.append((cv2.countNonZero(inside), box_detection(x + dx, y + dy, width, height, 0.5, mask.shape)))
    return sorted(found, key=lambda pair: -pair[0])


def _confirmed(tracker: Tracker, index: int, frame: Frame) -> list[Tracked]:
    """Give the confirmed tracks of a frame as boxes."""
    return [
        Tracked(track.center_px, track.size_px, index, frame.t, track.id) for track in tracker.tracks if track.confirmed
    ]


def curves(rows: Sequence[Row], counted: str = "false_tracks") -> dict[str, list[tuple[float, float]]]:
    """Give false tracks a minute and recall over all films, for each setting of each way.

    Args:
        rows: results.
        counted: column of the false tracks; "no_flyer" leaves out those on flyers without a label.
    """
    found: dict[str, list[tuple[float, float]]] = {}
    for way, threshold, area in dict.fromkeys((row["way"], row["threshold"], row["smallest_px"]) for row in rows):
        mine = [r for r in rows if (r["way"], r["threshold"], r["smallest_px"]) == (way, threshold, area)]
        boxes, hit, false, minutes = (sum(row[name] for row in mine) for name in ("boxes", "found", counted, "minutes"))
        found.setdefault(way, []).append((false / minutes, hit / boxes))
    return found


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give the best recall of each way at each of FALSE_PER_MIN or fewer false tracks; 0 if it always has more.

    Both ways: with all false tracks, and without those on flyers that have no label.
    """
    counts = {"": curves(rows), ", no flyer": curves(rows, "no_flyer")}
    return {
        way: {
            f"recall at {most:g} a minute{name}": max((hit for false, hit in points[way] if false <= most), default=0.0)
            for name, points in counts.items()
            for most in FALSE_PER_MIN
        }
        for way in counts[""]
    }


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the numbers of false tracks at which the detector, the first way, is not ahead of the others."""
    ours, *others = summary
    return [
        name
        for name in summary[ours]
        if f" {FALSE_PER_MIN[-1]:g} " not in name
        if not summary[ours][name] >= max((summary[way][name] for way in others), default=0.0) + AHEAD
    ]


def plot(rows: Sequence[Row], figure: "Figure") -> None:
    """Recall against false tracks a minute, for each threshold and smallest area."""
    axes = figure.subplots()
    for way, points in curves(rows).items():
        axes.plot(*zip(*sorted(points), strict=True), "o-" if way == rows[0]["way"] else ".", label=way)
    axes.set(xscale="symlog", xlabel="false tracks a minute", ylabel="recall", ylim=(0, 1))
    axes.legend()


SETTINGS = FilmsSettings()
QUICK = replace(SETTINGS, seeds=1, thresholds=(16.0,))
COST_S = 25.0
