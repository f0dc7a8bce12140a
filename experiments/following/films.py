"""Real films with labels: the detector beside OpenCV's MOG2 and KNN, in one half of the films.

`film_division.csv` divides the films by place and size of their labels into a half for development and one for the
report, which nothing is chosen on. `film_labels/` has labels in place of published ones that are plainly wrong, and of
films that have none. The films are those of the Drone-detection-dataset and three others, looked for in ../shared/data
beside the project, or one's own.

Published boxes up to 60 px are up to three times as long as the flyer, so that up to this size the centre decides. In
the other films the overlap decides from 24 px on; most of their frames have no label, so that they have no false
tracks. Scores are those of `cotarget.track_metrics`.

The mixtures' foreground is grouped with gaps of 3 px, and tracked by the same tracker. Figures are of each way's usual
setting, and of the best one at a given rate of false tracks: the detector is swept over the score from which a track is
confirmed, the mixtures over threshold and smallest area. SuBSENSE (St-Charles et al. 2015) may take their place; it is
that of bgslibrary, a source package on PyPI for Debian's OpenCV, and computes three frames a second.
"""

import contextlib
import importlib.util
import itertools
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import cv2
import numpy as np

from cotarget.config import DEFAULT_TARGETS, DetectorName, TargetProfile
from cotarget.detect_video import FILMS, labelled_films
from cotarget.detection import Detector, make_detector
from cotarget.detection.base import box_detection, moved, pieces
from cotarget.files import read_table
from cotarget.geometry import within_image
from cotarget.pipeline import CameraRun
from cotarget.rig import Detection, Frame, Image
from cotarget.track_metrics import (
    INSIDE,
    SIZE_NAMES,
    Box,
    Criterion,
    Label,
    Tracked,
    compare,
    pooled_sizes,
    read_labels,
    score_tracks,
)
from cotarget.tracking.track import tracking_settings
from cotarget.tracking.tracker import Tracker
from cotarget.video import Film
from experiments.engine import Count, Row, Settings
from experiments.tables import grouped

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
FLYERS = ("flyers", "birds")  # folders there whose films are all of flyers
DIVISION, LABELS = Path(__file__).with_name("film_division.csv"), Path(__file__).with_name("film_labels")
# Flyers of these films that have no label, found by looking at every false track: a box about every fifth frame. One is
# listed while it is seen to fly, in the film or in its difference from the median of the frames around, not where it is
# lost among twigs.
UNLABELLED = Path(__file__).with_name("unlabelled_flyers.csv")
VTEST = Path(__file__).resolve().parents[2] / "tests" / "data" / "vtest.txt"
# The films without flyers, and their targets.
PERSON, CAR = DEFAULT_TARGETS["person"], TargetProfile(4.0, "width", 160.0)
OTHERS = {"car": CAR, "persons": PERSON, "vtest": PERSON}
FLYER = DEFAULT_TARGETS["bird"]
OF_FLYERS = Criterion(small_px=60.0)
MIXTURES = {"MOG2": cv2.createBackgroundSubtractorMOG2, "KNN": cv2.createBackgroundSubtractorKNN}
# The usual setting of the mixtures: threshold of MOG2 [variances] and smallest area of a component [px].
THRESHOLD, AREA_PX = 16.0, 16
# False tracks a minute at which the ways are compared, and by how much the detector must be ahead.
FALSE_PER_MIN = (0.5, 5.0)
AHEAD = 0.05
BRIDGE_PX = (3, 3)  # gaps that are closed in the mixtures' foreground
SIZE_KEYS = ("boxes", "found", "recall", "whole", "iou", "covered", "dot_distance", "with_tracks", "tracks_at_once")
SHAKE_PX, DROPPED, QUALITY = 1.0, 0.3, 25
B = TypeVar("B", bound=Box)


@dataclass(frozen=True)
class FolderSettings(Settings):
    """Settings of all experiments on flyers: where the folders of films and labels are, and most films, as seeds."""

    seeds: Count = 1000
    data: str = str(DATA)


@dataclass(frozen=True)
class FilmsSettings(FolderSettings):
    """Settings: the half of the films, how they are altered, the ways, and what is swept."""

    half: Literal["development", "report"] = "development"
    altered: Literal["no", "half", "a third", "twice", "shaken", "dropped", "compressed"] = "no"
    detector: DetectorName = "auto"
    beside: Literal["mixtures", "SuBSENSE", "nothing"] = "mixtures"
    scores: tuple[float, ...] = (0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99)  # from which a track is confirmed
    thresholds: tuple[float, ...] = (THRESHOLD, 100.0, 400.0)  # of MOG2, in variances
    areas_px: tuple[int, ...] = (AREA_PX, 64, 256)  # smallest of a component


# Films


def needs(settings: FolderSettings) -> str:
    """Describe what is missing to run; empty if nothing."""
    if isinstance(settings, FilmsSettings) and settings.beside == "SuBSENSE" and not importlib.util.find_spec("pybgs"):
        return "needs bgslibrary, in an environment of its own"
    lacking = [folder for folder in FLYERS if not Path(settings.data, folder).is_dir()]
    return f"needs films in {settings.data}/{lacking[0]}, which are not part of the project" if lacking else ""


def films(settings: FolderSettings) -> list[tuple[Path, Path]]:
    """List all films of flyers and their labels."""
    folders = [Path(settings.data, name) for name in FLYERS]
    return [pair for folder in folders for pair in labelled_films(folder, folder)]


def films_of_half(settings: FilmsSettings) -> list[Path]:
    """List the films of a half."""
    rows = read_table(DIVISION, {"film": str, "half": str}, "division of films")
    there = {path.stem: path for path in Path(settings.data).glob("*/*") if path.suffix in FILMS}
    return [there[row["film"]] for row in rows if row["half"] == settings.half and row["film"] in there]


def jobs(settings: FolderSettings) -> Sequence[int]:
    """Give the films' numbers; one where there is no film."""
    if needs(settings):
        return range(1)
    found = films_of_half(settings) if isinstance(settings, FilmsSettings) else films(settings)
    return range(min(settings.seeds, len(found)))


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
        target: profile of its targets.
        published: labels as they were published, where they are redrawn.
    """

    name: str
    frames: list[Frame]
    rate_hz: float
    labels: dict[int, list[Label]]
    flyers: dict[int, list[Box]]
    criterion: Criterion = OF_FLYERS
    target: TargetProfile = FLYER
    published: dict[int, list[Label]] = field(default_factory=dict)

    def row(self, way: str, threshold: float, area: int, tracks: Iterable[Tracked]) -> Row:
        """Score the tracks of a way with a threshold and a smallest area [px]."""
        tracks = list(tracks)
        others = off_boxes(tracks, self.flyers, self.criterion)
        score, no_flyer, no_part = (
            score_tracks(found, self.labels, self.rate_hz, len(self.frames), criterion=self.criterion)
            for found in (tracks, others, no_parts(others, self.labels, self.criterion))
        )
        numbers = [each.numbers for each in score.targets.values() if each.numbers]
        delays_s = [each.first_track_s for each in score.targets.values() if each.first_track_s is not None]
        return {
            "film": self.name,
            "way": way,
            "threshold": threshold,
            "smallest_px": area,
            **{name: getattr(score, name) for name in ("boxes", "found", "false_boxes", "id_found", "false_tracks")},
            "no_flyer": no_flyer.false_tracks,
            "no_part": no_part.false_tracks,
            "minutes": len(self.frames) / self.rate_hz / 60,
            "numbers": float(np.median(numbers)) if numbers else None,
            "first_track_s": float(np.median(delays_s)) if delays_s else None,
            **{f"{size} {key}": score.sizes[size][key] for size in SIZE_NAMES for key in SIZE_KEYS},
        }


def labelled_film(video: Path, labels: Path, most: int | None = None) -> LabelledFilm:
    """Read a film of flyers, or as many frames of it, and its labels as published."""
    with Film(video) as film:
        frames = list(itertools.islice(film, most))
        return LabelledFilm(video.stem, frames, film.rate_hz, labels_of(labels), unlabelled_flyers(video.stem))


def film_to_score(video: Path, most: int | None = None) -> LabelledFilm:
    """Read a film, or as many frames of it, and its labels, redrawn ones where there are any."""
    own = LABELS / f"{video.stem}.csv"
    if video.stem not in OTHERS:
        film = labelled_film(video, video.with_suffix(".csv"), most)
        return replace(film, labels=read_labels(own), published=film.labels) if own.is_file() else film
    labels = read_labels(VTEST if video.stem == "vtest" else own)
    with Film(video) as opened:
        frames = list(itertools.islice(opened, most))
        return LabelledFilm(video.stem, frames, opened.rate_hz, labels, {}, Criterion(), OTHERS[video.stem])


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


def off_boxes(tracks: Iterable[Tracked], boxes: Mapping[int, Sequence[Box]], criterion: Criterion) -> list[Tracked]:
    """Leave out what lies on boxes that must not count, by frame number: flyers that have no label."""
    kept = []
    for frame, group in itertools.groupby(sorted(tracks, key=lambda each: each.frame), key=lambda each: each.frame):
        found = list(group)
        near = criterion.similarity(boxes.get(frame, []), found) >= criterion.iou - np.finfo(float).eps
        excused: list[bool] = np.any(near, axis=0).tolist()
        kept += [each for each, excuse in zip(found, excused, strict=True) if not excuse]
    return kept


def no_parts(tracks: Iterable[Tracked], labels: Mapping[int, Sequence[Label]], criterion: Criterion) -> list[Tracked]:
    """Leave out what is mostly inside a label and yet not on it: parts of its target."""

    def is_part(track: Tracked) -> bool:
        boxes = labels.get(track.frame, ())
        inside, similar = compare(boxes, [track]).of_track > INSIDE, criterion.similarity(boxes, [track])
        return bool((inside & (similar < criterion.iou)).any())

    return [each for each in tracks if not is_part(each)]


# Altered films


def scaled(film: LabelledFilm, times: float) -> LabelledFilm:
    """Scale a film; the labels of a larger one are as loose as before, so its small boxes are larger too."""
    height, width = film.frames[0].image.shape[:2]
    size, way = (round(times * width), round(times * height)), cv2.INTER_AREA if times < 1 else cv2.INTER_CUBIC

    def move(box: B, _: int) -> B:
        return replace(box, center_px=(box.center_px + 0.5) * times - 0.5, size_px=box.size_px * times)

    return replace(
        _moved(film, move),
        frames=[_with(frame, cv2.resize(frame.image, size, interpolation=way)) for frame in film.frames],
        criterion=replace(film.criterion, small_px=film.criterion.small_px * max(1.0, times)),
    )


def shaken(film: LabelledFilm) -> LabelledFilm:
    """Shift every frame at random, by a standard deviation of SHAKE_PX along each axis."""
    shifts = np.random.default_rng(1).normal(0, SHAKE_PX, (len(film.frames), 2))
    frames = [_with(frame, moved(frame.image, shift)) for frame, shift in zip(film.frames, shifts, strict=True)]
    return replace(_moved(film, lambda box, at: replace(box, center_px=box.center_px + shifts[at])), frames=frames)


def dropped(film: LabelledFilm) -> LabelledFilm:
    """Leave out frames at random, a part of DROPPED; the others keep their times."""
    kept = np.flatnonzero(np.random.default_rng(1).random(len(film.frames)) >= DROPPED).tolist()
    new = {at: number for number, at in enumerate(kept)}
    some = _with_boxes(film, lambda of: {new[at]: boxes for at, boxes in of.items() if at in new})
    return replace(some, frames=[film.frames[at] for at in kept])


def compressed(film: LabelledFilm) -> LabelledFilm:
    """Code every frame as JPEG of a quality of QUALITY."""
    coded = [cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1] for frame in film.frames]
    images = [cv2.imdecode(each, cv2.IMREAD_COLOR) for each in coded]
    return replace(film, frames=[_with(*pair) for pair in zip(film.frames, images, strict=True)])


def _moved(film: LabelledFilm, move: Callable[[Any, int], Any]) -> LabelledFilm:
    """Move the boxes of a film; `move` takes a box and its frame's number."""
    last = len(film.frames) - 1
    return _with_boxes(
        film, lambda of: {at: [move(box, at) for box in boxes] for at, boxes in of.items() if at <= last}
    )


def _with_boxes(film: LabelledFilm, change: Callable[[Any], Any]) -> LabelledFilm:
    return replace(film, labels=change(film.labels), flyers=change(film.flyers), published=change(film.published))


def _with(frame: Frame, image: Any) -> Frame:
    picture: Image = np.asarray(image, dtype=np.uint8)
    return replace(frame, image=picture)


ALTERATIONS: Mapping[str, Callable[[LabelledFilm], LabelledFilm]] = {
    "no": lambda film: film,
    "half": lambda film: scaled(film, 1 / 2),
    "a third": lambda film: scaled(film, 1 / 3),
    "twice": lambda film: scaled(film, 2),
    "shaken": shaken,
    "dropped": dropped,
    "compressed": compressed,
}


# Ways


def one(settings: FilmsSettings, number: int) -> list[Row]:
    """Search a film in every way; give a row for each setting, and the detector's usual one by published labels too."""
    film = ALTERATIONS[settings.altered](film_to_score(films_of_half(settings)[number]))
    target = replace(film.target, detector=settings.detector)
    usual = tracking_settings(target).confirm_score
    found = tracks_of(make_detector(target, film.rate_hz), target, sorted({usual, *settings.scores}), film.frames)
    ways = {(settings.detector, least, 0): tracks for least, tracks in found.items()}
    others: Mapping[str, Sequence[str]] = {"mixtures": list(MIXTURES), "SuBSENSE": ["SuBSENSE"], "nothing": []}
    for way, threshold in itertools.product(others[settings.beside], settings.thresholds):
        subtract = subtractor(way, threshold)
        for area, tracks in foreground_tracks(subtract, settings.areas_px, film.frames, film.target).items():
            ways[way, threshold, area] = tracks
    usuals = [(settings.detector, usual, 0), *((way, THRESHOLD, AREA_PX) for way in others[settings.beside])]
    more = {"seed": number, "labels": "redrawn" if film.published else "all"}
    rows = [film.row(*way, tracks) | more | {"usual": way in usuals} for way, tracks in ways.items()]
    if film.published:
        row = replace(film, labels=film.published).row(*usuals[0], found[usual])
        rows.append(row | more | {"usual": True, "labels": "published"})
    return rows


def detector_tracks(
    name: DetectorName, scores: Sequence[float], frames: Sequence[Frame], rate_hz: float
) -> dict[float, list[Tracked]]:
    """Track what a detector of flyers finds, for each score from which a track is confirmed; the usual one holds."""
    target = replace(FLYER, detector=name)
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
    """Track the flyers that a mixture finds at a threshold of MOG2 [variances], for each smallest area [px]."""
    return foreground_tracks(subtractor(way, threshold), areas_px, frames)


def subtractor(way: str, threshold: float) -> Callable[[Image], Image]:
    """Make what finds an image's foreground, 255, at a threshold of MOG2 [variances].

    KNN's threshold is 25 times as large. At MOG2's usual one, SuBSENSE has its own, a difference of 30 grey levels.
    """
    if way == "SuBSENSE":
        return _subsense(30 * threshold / THRESHOLD)
    cv2.setRNGSeed(0)  # KNN draws at random
    model = MIXTURES[way](500, threshold if way == "MOG2" else 25 * threshold, False)
    return lambda image: np.asarray(model.apply(image), dtype=np.uint8)


def _subsense(threshold: float) -> Callable[[Image], Image]:
    """Make SuBSENSE with a least difference of colour [grey levels]; it reads settings in the working directory."""
    import pybgs

    settings = {
        "fRelLBSPThreshold": 0.333, "nDescDistThresholdOffset": 3, "nMinColorDistThreshold": threshold,
        "nBGSamples": 50, "nRequiredBGSamples": 2, "nSamplesForMovingAvgs": 100, "showOutput": 0,
    }  # fmt: skip
    text = "".join(f"<{key}>{value:g}</{key}>" for key, value in settings.items())
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        Path("config").mkdir()
        Path("config", "SuBSENSE.xml").write_text(f'<?xml version="1.0"?><opencv_storage>{text}</opencv_storage>')
        model = pybgs.SuBSENSE()
    return lambda image: np.asarray(model.apply(image), dtype=np.uint8)


def foreground_tracks(
    subtract: Callable[[Image], Image],
    areas_px: Sequence[int],
    frames: Sequence[Frame],
    target: TargetProfile = FLYER,
) -> dict[int, list[Tracked]]:
    """Track the components of what a function makes of each image, 255 for foreground, for each smallest area [px]."""
    settings = tracking_settings(replace(target, detector="mog2"))
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
    """Give the reported tracks of a frame as boxes, which end at the image's border as labels do."""
    height, width = frame.image.shape[:2]
    return [
        Tracked(*within_image(track.center_px, track.whole_px, (width, height)), index, frame.t, track.id)
        for track in tracker.tracks
        if track.reported
    ]


# Figures


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Give the figures of each way over all flyers, by labels as redrawn, and those of the detector in each film."""
    ours, flyers = rows[0]["way"], [row for row in rows if row["film"] not in OTHERS]
    ways = grouped([row for row in flyers if row["labels"] != "published"], "way")
    found: dict[str, dict[str, Any]] = {}
    for way, mine in ways.items():
        found[way] = figures([row for row in mine if row["usual"]]) | recall_at(curve(mine))
    usual = [row for row in rows if row["way"] == ours and row["usual"]]
    found[f"{ours}, as published"] = figures([r for r in usual if r in flyers and r["labels"] != "redrawn"])
    found["films"] = {row["film"]: of_film(row) for row in usual if row["labels"] != "published"}
    return found


def figures(rows: Sequence[Row]) -> dict[str, float]:
    """Pool the figures of films of flyers."""
    small, medium, large = (pooled_sizes([_size(row, name) for row in rows]) for name in SIZE_NAMES)
    boxes, found, false_boxes, id_found, false, no_flyer, no_part, minutes = (
        sum(row[name] for row in rows)
        for name in ("boxes", "found", "false_boxes", "id_found", "false_tracks", "no_flyer", "no_part", "minutes")
    )
    pooled = {
        "films": len(rows),
        "recall to 24 px, by centre": small["recall"],
        "recall 24-60 px, by centre": medium["recall"],
        "recall above 60 px, by overlap": large["recall"],
        "the same, median film": _median([row["large recall"] for row in rows]),
        "whole 24-60 px": medium["whole"],
        "covered above 60 px": large["covered"],
        "tracks at once above 60 px": large["tracks_at_once"],
        "dot distance to 24 px": small["dot_distance"],
        "overlap to 24 px": small["iou"],
        "false tracks a minute": _part(false, minutes),
        "the same, no flyer": _part(no_flyer, minutes),
        "the same, no part of a target": _part(no_part, minutes),
        "precision": _part(found, found + false_boxes),
        "IDF1": _part(2 * id_found, boxes + found + false_boxes),
        "numbers a target": _median([row["numbers"] for row in rows]),
        "first track [s]": _median([row["first_track_s"] for row in rows]),
    }
    return {name: float("nan") if value is None else value for name, value in pooled.items()}


def of_film(row: Row) -> dict[str, float]:
    """Give the figures of one film; false tracks where every frame has a label."""
    above = pooled_sizes([_size(row, name) for name in SIZE_NAMES[1:]])
    shown = {
        "boxes": row["boxes"],
        **{name: row[f"{size} recall"] for name, size in zip(("to 24", "24-60", "above 60"), SIZE_NAMES, strict=True)},
        "covered": above["covered"],
        "at once": above["tracks_at_once"],
        "false": None if row["film"] in OTHERS else row["no_flyer"],
        "precision": _part(row["found"], row["found"] + row["false_boxes"]),
        "IDF1": _part(2 * row["id_found"], row["boxes"] + row["found"] + row["false_boxes"]),
        "first [s]": row["first_track_s"],
    }
    return {name: float("nan") if value is None else value for name, value in shown.items()}


def _size(row: Row, name: str) -> dict[str, float | None]:
    """Give the scores of a class of size."""
    return {key: row[f"{name} {key}"] for key in SIZE_KEYS}


def _part(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def _median(values: Iterable[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return float(np.median(there)) if there else None


def curve(rows: Sequence[Row]) -> list[tuple[float, float]]:
    """Give false tracks a minute, without those on flyers that have no label, and recall, for each setting of a way."""
    names, settings = ("boxes", "found", "no_flyer", "minutes"), grouped(rows, "threshold", "smallest_px")
    sums = [[sum(row[name] for row in mine) for name in names] for mine in settings.values()]
    return sorted((false / minutes, hit / boxes) for boxes, hit, false, minutes in sums)


def recall_at(points: Sequence[tuple[float, float]]) -> dict[str, float]:
    """Give the best recall at each of FALSE_PER_MIN or fewer false tracks; 0 if there are always more."""
    return {
        f"recall at {most:g} a minute": max((hit for false, hit in points if false <= most), default=0.0)
        for most in FALSE_PER_MIN
    }


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the numbers of false tracks at which the detector, the first way, is not ahead of the others."""
    ours, *others = (found for found in summary.values() if set(recall_at([])) <= set(found))
    return [name for name in recall_at([]) if not ours[name] >= max((way[name] for way in others), default=0.0) + AHEAD]


def plot(rows: Sequence[Row], figure: "Figure") -> None:
    """Recall against false tracks a minute, for each threshold and smallest area."""
    axes = figure.subplots()
    swept = [row for row in rows if row["film"] not in OTHERS and row["labels"] != "published"]
    for way, mine in grouped(swept, "way").items():
        axes.plot(*zip(*curve(mine), strict=True), "o-" if way == rows[0]["way"] else ".", label=way)
    axes.set(xscale="symlog", xlabel="false tracks a minute", ylabel="recall", ylim=(0, 1))
    axes.legend()


SETTINGS = FilmsSettings()
QUICK = replace(SETTINGS, seeds=1, thresholds=(THRESHOLD,))
COST_S = 30.0
