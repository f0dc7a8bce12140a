"""Score tracks on a film by labelled boxes: recall, precision, false tracks, MOTA, IDF1, per target and per size.

In each labelled frame, tracks and labels are matched one to one, as the CLEAR MOT metrics have it (Bernardin and
Stiefelhagen 2008): the pairs of the frame before stay as long as they are near enough, the others are assigned by
similarity. IDF1 is that of Ristani et al. (2016). Frames without labels are not scored. Only a track that is never on a
label counts as false in them.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from cotarget.errors import ConfigError
from cotarget.files import read_table
from cotarget.geometry import Array, intersection_areas
from cotarget.metrics import BREAK_S, ROUNDING_S, false_tracks

LABELS = ("frame", "x_px", "y_px", "width_px", "height_px")
MOT_COLUMNS = ("frame", "id", "left", "top", "width", "height", "counts")
# Frames at the start that are not scored, because the background takes a second to be learnt.
LEARNING_FRAMES = 30
# Classes of size, by the larger side of a label's box: up to the first, up to the second, and above [px].
SIZES_PX = (24.0, 60.0)
SIZE_NAMES = ("small", "medium", "large")
WHOLE_IOU = 0.5  # least overlap of a box that holds the whole target and little else
INSIDE = 0.5  # a track with more than this part of its box in a label's is on that target
# Bonus of a pair of the frame before, above any similarity.
KEPT = 1000.0


@dataclass(frozen=True)
class Box:
    """A box in an image: centre (u, v), (2,), and width and height, (2,) [px]."""

    center_px: Array
    size_px: Array

    @property
    def larger_side_px(self) -> float:
        """Larger side of the box [px]."""
        return float(self.size_px.max())


@dataclass(frozen=True)
class Label(Box):
    """A labelled box.

    Attributes:
        target: id of the target.
        counts: whether it is scored; a track on a label that does not count is neither right nor wrong.
    """

    target: int = 1
    counts: bool = True


@dataclass(frozen=True)
class Tracked(Box):
    """A confirmed track in one frame: its box, frame number, time [s], and track id."""

    frame: int
    t: float
    track: int


@dataclass(frozen=True)
class Criterion:
    """When a track's box is on a label's box; the label's size alone decides which rule holds.

    Attributes:
        iou: least intersection over union with a label whose larger side is above `small_px`.
        small_px: up to this larger side of a label [px], the centres must be at most that side apart, because labels of
            specks are several times as large as the speck. 0 for overlap alone, inf for distance alone.
    """

    iou: float = 0.5
    small_px: float = 24.0

    def similarity(self, labels: Sequence[Box], tracks: Sequence[Box]) -> Array:
        """Compare every label with every track: at least `iou` where the track is on the label, (labels, tracks)."""
        overlap = compare(labels, tracks)
        side = np.array([label.larger_side_px for label in labels])[:, None]
        distance = overlap.distance_px / side
        near = np.where(distance <= 1, 1 - (1 - self.iou) * distance, -1.0)
        return np.where(side <= self.small_px, near, overlap.iou)


@dataclass(frozen=True)
class Overlap:
    """Comparison of every label with every track, (labels, tracks) each.

    Attributes:
        iou: intersection over union.
        of_label: intersection over the label's area.
        of_track: intersection over the track's area.
        distance_px: distance of the centres [px].
    """

    iou: Array
    of_label: Array
    of_track: Array
    distance_px: Array


def compare(labels: Sequence[Box], tracks: Sequence[Box]) -> Overlap:
    """Compare every label with every track."""
    at, size, center, extent = (
        np.reshape([getattr(each, name) for each in boxes], (-1, 2))
        for boxes in (labels, tracks)
        for name in ("center_px", "size_px")
    )
    # A track outside of the image has no area after it is cut to it.
    area, area_of_track = size.prod(axis=-1)[:, None], np.maximum(extent.prod(axis=-1), np.finfo(float).tiny)
    shared = intersection_areas(at, size, center, extent)
    distance_px = np.linalg.norm(at[:, None] - center, axis=-1)
    return Overlap(shared / (area + area_of_track - shared), shared / area, shared / area_of_track, distance_px)


@dataclass(frozen=True)
class TargetScore:
    """Score of one target. A value is None if the target was never found.

    Attributes:
        boxes: labelled boxes that are scored.
        recall: part of these with a track on it.
        numbers: number of different tracks on it.
        first_track_s: time from its first labelled frame, scored or not, to the first track on it [s].
    """

    boxes: int
    recall: float
    numbers: int
    first_track_s: float | None


@dataclass(frozen=True)
class TrackScore:
    """Agreement of tracks with labels. A value is None if nothing is labelled or nothing was found.

    Recall, precision, MOTA, IDF1 and identity switches are over the labelled frames after LEARNING_FRAMES, up to the
    film's last.

    Attributes:
        labelled_frames: number of these frames.
        on_target_ratio: part of these in which a track is on a label.
        numbers: number of different tracks on a label in these.
        offset_px_median: median distance of a track from its label's centre [px].
        fragmentation_per_min: gaps of more than 0.2 s without a track on a label, per minute of labelled frames.
        false_tracks: tracks that were off every label for 0.5 s without a break in labelled frames, or that lived for
            0.5 s and were never on one.
        false_tracks_per_min: false tracks per minute of the film.
        labels_beyond_end: labelled frames that the film does not have; they are not scored, and may belong to another.
        boxes: labelled boxes.
        found: labelled boxes with a track on it.
        false_boxes: boxes of tracks that are on no label.
        id_found: boxes found with the best one-to-one assignment of track numbers to targets.
        id_switches: how often another track is on a target than the one before.
        recall: `found` over `boxes`.
        precision: `found` over `found` and `false_boxes`.
        mota: multiple object tracking accuracy, 1 - (missed + false boxes + switches) / boxes.
        idf1: F1 score of `id_found`.
        sizes: scores by the larger side of the label: "small" up to 24 px, "medium" up to 60, "large" above; see
            `_size_score`.
        targets: score of each target, by id.
    """

    labelled_frames: int
    on_target_ratio: float | None
    numbers: int
    offset_px_median: float | None
    fragmentation_per_min: float | None
    false_tracks: int
    false_tracks_per_min: float | None
    labels_beyond_end: int
    boxes: int
    found: int
    false_boxes: int
    id_found: int
    id_switches: int
    recall: float | None
    precision: float | None
    mota: float | None
    idf1: float | None
    sizes: dict[str, dict[str, float | None]]
    targets: dict[int, TargetScore]


@dataclass(frozen=True)
class FrameMatch:
    """Match of one labelled frame.

    Attributes:
        frame: number of the frame.
        pairs: label and track of each match.
        missed: labels that count and have no track.
        false: tracks that are on no label.
        excused: tracks on labels that do not count, and on no other.
        near: pairs of target and right or false track that are near enough, one-to-one or not, for IDF1.
    """

    frame: int
    pairs: list[tuple[Label, Tracked]]
    missed: list[Label]
    false: list[Tracked]
    excused: list[Tracked]
    near: list[tuple[int, int]]


def match_frames(
    tracks: Iterable[Tracked], labels: Mapping[int, Sequence[Label]], criterion: Criterion = Criterion()
) -> list[FrameMatch]:
    """Match tracks and labels one to one in every labelled frame, in the order of frames."""
    by_frame = _by_frame(tracks)
    matches, before = [], dict[int, int]()
    least = criterion.iou - np.finfo(float).eps
    for frame in sorted(labels):
        counted = [label for label in labels[frame] if label.counts]
        ignored = [label for label in labels[frame] if not label.counts]
        found = by_frame.get(frame, [])
        similar = criterion.similarity(counted, found)
        enough = similar >= least
        kept = np.array([[before.get(label.target) == each.track for each in found] for label in counted])
        value = np.where(enough, similar + KEPT * kept.reshape(similar.shape), 0.0)
        rows, columns = linear_sum_assignment(-value)
        matched = [(i, j) for i, j in zip(rows.tolist(), columns.tolist(), strict=True) if enough[i, j]]
        pairs = [(counted[i], found[j]) for i, j in matched]
        before = {label.target: each.track for label, each in pairs}
        right, labels_found = {each.track for _, each in pairs}, {i for i, _ in matched}
        others = [each for each in found if each.track not in right]
        excuse: list[bool] = np.any(criterion.similarity(ignored, others) >= least, axis=0).tolist()
        wrong, excused = ([each for each, e in zip(others, excuse, strict=True) if e == of] for of in (False, True))
        judged = right | {each.track for each in wrong}
        near = [(counted[i].target, found[j].track) for i, j in np.argwhere(enough) if found[j].track in judged]
        missed = [label for i, label in enumerate(counted) if i not in labels_found]
        matches.append(FrameMatch(frame, pairs, missed, wrong, excused, near))
    return matches


def score_tracks(
    tracks: Iterable[Tracked],
    labels: Mapping[int, Sequence[Label]],
    rate_hz: float,
    frames: int,
    learning_frames: int = LEARNING_FRAMES,
    criterion: Criterion = Criterion(),
) -> TrackScore:
    """Score tracks on a film by labels.

    Args:
        tracks: confirmed tracks of every frame.
        labels: labels by frame number, from 0; those of frames beyond the film's end are left out and counted.
        rate_hz: frames per second.
        frames: number of frames of the film.
        learning_frames: frames at the start that are not scored.
        criterion: when a track is on a label.
    """
    tracks = list(tracks)
    labelled = {frame: boxes for frame, boxes in labels.items() if boxes}
    matches = match_frames(tracks, {k: boxes for k, boxes in labelled.items() if k < frames}, criterion)
    scored = [each for each in matches if each.frame >= learning_frames]
    pairs = [pair for each in scored for pair in each.pairs]
    offsets_px = [np.linalg.norm(label.center_px - track.center_px) for label, track in pairs]
    seconds = len(scored) / rate_hz
    boxes = len(pairs) + sum(len(each.missed) for each in scored)
    false_boxes = sum(len(each.false) for each in scored)
    switches, id_found = _id_switches(scored), _id_found(scored)
    false = _false_tracks(tracks, matches)
    return TrackScore(
        labelled_frames=len(scored),
        on_target_ratio=_ratio(sum(bool(each.pairs) for each in scored), len(scored)),
        numbers=len({track.track for _, track in pairs}),
        offset_px_median=float(np.median(offsets_px)) if pairs else None,
        fragmentation_per_min=60 * _gaps(scored, rate_hz) / seconds if pairs else None,
        false_tracks=false,
        false_tracks_per_min=60 * false * rate_hz / frames if frames else None,
        labels_beyond_end=sum(frame >= frames for frame in labelled),
        boxes=boxes,
        found=len(pairs),
        false_boxes=false_boxes,
        id_found=id_found,
        id_switches=switches,
        sizes=_sizes(scored),
        targets=_targets(matches, learning_frames, rate_hz),
        **_ratios(boxes, len(pairs), false_boxes, switches, id_found),
    )


def _ratios(boxes: int, found: int, false_boxes: int, switches: int, id_found: int) -> dict[str, float | None]:
    return {
        "recall": _ratio(found, boxes),
        "precision": _ratio(found, found + false_boxes),
        "mota": _ratio(found - false_boxes - switches, boxes),
        "idf1": _ratio(2 * id_found, boxes + found + false_boxes),
    }


def _ratio(part: float, whole: float) -> float | None:
    return float(part / whole) if whole else None


def _id_switches(matches: Sequence[FrameMatch]) -> int:
    """Count how often a target's track differs from the last one that was on it."""
    switches, last = 0, dict[int, int]()
    for match in matches:
        for label, track in match.pairs:
            switches += last.get(label.target, track.track) != track.track
            last[label.target] = track.track
    return switches


def _id_found(matches: Sequence[FrameMatch]) -> int:
    """Count the boxes found with the one-to-one assignment of track numbers to targets that finds most."""
    together = Counter(pair for match in matches for pair in match.near)
    targets, numbers = sorted({target for target, _ in together}), sorted({number for _, number in together})
    counts = np.zeros((len(targets), len(numbers)), dtype=int)
    for (target, number), count in together.items():
        counts[targets.index(target), numbers.index(number)] = count
    return int(counts[linear_sum_assignment(-counts)].sum())


def _false_tracks(tracks: Sequence[Tracked], matches: Sequence[FrameMatch]) -> int:
    """Count tracks that were off every label for half a second; frames without labels are a break for those once on."""
    on = {track.track for match in matches for _, track in match.pairs}
    on |= {track.track for match in matches for track in match.excused}
    off = {match.frame: {track.track for track in match.false} for match in matches}
    return false_tracks(
        (found[0].t, off.get(frame, {each.track for each in found if each.track not in on}))
        for frame, found in sorted(_by_frame(tracks).items())
    )


def _by_frame(tracks: Iterable[Tracked]) -> dict[int, list[Tracked]]:
    """Group tracks by their frame's number."""
    found: dict[int, list[Tracked]] = {}
    for each in tracks:
        found.setdefault(each.frame, []).append(each)
    return found


def _gaps(matches: Sequence[FrameMatch], rate_hz: float) -> int:
    """Count gaps of more than 0.2 s without a track on a label, within successive labelled frames."""
    breaks, lacking, last = 0, 0, -1
    for match in matches:
        if match.pairs or match.frame != last + 1:
            lacking = 0
        if not match.pairs:
            lacking += 1
            # Count a gap once, when it becomes long enough.
            breaks += lacking / rate_hz > BREAK_S + ROUNDING_S >= (lacking - 1) / rate_hz
        last = match.frame
    return breaks


def _sizes(matches: Sequence[FrameMatch]) -> dict[str, dict[str, float | None]]:
    """Score the labels of each class of size."""
    found: dict[str, list[list[float]]] = {name: [] for name in SIZE_NAMES}
    for match in matches:
        labels = [*(label for label, _ in match.pairs), *match.missed]
        overlap = compare(labels, [*(track for _, track in match.pairs), *match.false, *match.excused])
        iou = overlap.iou.max(axis=1, initial=0.0)
        covered = np.where(overlap.iou == iou[:, None], overlap.of_label, 0.0).max(axis=1, initial=0.0)
        nearest_px, tracks = overlap.distance_px.min(axis=1, initial=np.inf), (overlap.of_track > INSIDE).sum(axis=1)
        for i, label in enumerate(labels):
            area = float(label.size_px.prod())
            found[_size_name(label)].append([i < len(match.pairs), area, iou[i], covered[i], nearest_px[i], tracks[i]])
    return {name: _size_score(np.array(rows, dtype=float).reshape(-1, 6)) for name, rows in found.items()}


def _size_score(rows: Array) -> dict[str, float | None]:
    """Score labels of one class of size.

    Args:
        rows: of each label whether it was found, its area [px^2], its largest intersection over union with a track, the
            part of it that this track covers, the distance of the nearest track's centre [px], and the number of tracks
            that are inside it by more than INSIDE of their area, (labels, 6).

    Returns:
        `boxes`, `found`, `recall`; `whole`, part of the labels that a track overlaps by WHOLE_IOU; `iou` and `covered`,
        their means; `dot_distance`, mean of exp(-distance / S), where S is the root of the labels' mean area (Xu et al.
        2021), and 0 without a track; `with_tracks`, labels with a track inside, and `tracks_at_once`, the mean number
        of tracks inside these.
    """
    found, area, iou, covered, nearest_px, tracks = rows.T
    boxes, with_tracks = len(rows), int((tracks > 0).sum())
    side_px = np.sqrt(area.mean()) if boxes else 1.0
    return {
        "boxes": boxes,
        "found": int(found.sum()),
        "recall": _ratio(found.sum(), boxes),
        "whole": _ratio((iou >= WHOLE_IOU).sum(), boxes),
        "iou": _ratio(iou.sum(), boxes),
        "covered": _ratio(covered.sum(), boxes),
        "dot_distance": _ratio(np.exp(-nearest_px / side_px).sum(), boxes),
        "with_tracks": with_tracks,
        "tracks_at_once": _ratio(tracks.sum(), with_tracks),
    }


def _size_name(label: Label) -> str:
    return SIZE_NAMES[int(np.searchsorted(SIZES_PX, label.larger_side_px))]


def _targets(matches: Sequence[FrameMatch], learning_frames: int, rate_hz: float) -> dict[int, TargetScore]:
    """Score each target that is labelled in a scored frame; its first track is looked for in all frames."""
    frames: dict[int, list[tuple[int, int | None]]] = {}  # frame and track of each target
    for match in matches:
        for label, track in match.pairs:
            frames.setdefault(label.target, []).append((match.frame, track.track))
        for label in match.missed:
            frames.setdefault(label.target, []).append((match.frame, None))
    scores = {}
    for target, seen in sorted(frames.items()):
        first = next(((frame - seen[0][0]) / rate_hz for frame, track in seen if track is not None), None)
        scored = [track for frame, track in seen if frame >= learning_frames]
        found = [track for track in scored if track is not None]
        if scored:
            scores[target] = TargetScore(len(scored), len(found) / len(scored), len(set(found)), first)
    return scores


def pooled(scores: Sequence[TrackScore], minutes: float) -> dict[str, object]:
    """Pool the scores of several films: every box counts the same.

    Args:
        scores: score of each film.
        minutes: duration of all films together [min].

    Returns:
        `films`, their number; `boxes`, `recall`, `precision`, `mota`, `idf1`, `id_switches`, `false_tracks`,
        `false_tracks_per_min`, `sizes`; over the targets of all films the median of `numbers` and of `first_track_s`;
        and the median and the least `recall` over the films.
    """
    boxes, found, false_boxes, switches, id_found, false = (
        sum(getattr(each, name) for each in scores)
        for name in ("boxes", "found", "false_boxes", "id_switches", "id_found", "false_tracks")
    )
    targets = [target for each in scores for target in each.targets.values()]
    recalls = [each.recall for each in scores if each.recall is not None]
    return {
        "films": len(scores),
        "boxes": boxes,
        **_ratios(boxes, found, false_boxes, switches, id_found),
        "id_switches": switches,
        "false_tracks": false,
        "false_tracks_per_min": _ratio(false, minutes),
        "sizes": {name: pooled_sizes([each.sizes[name] for each in scores]) for name in SIZE_NAMES},
        "numbers_median": _median([each.numbers for each in targets if each.numbers]),
        "first_track_s_median": _median([each.first_track_s for each in targets if each.first_track_s is not None]),
        "recall_median": _median(recalls),
        "recall_least": min(recalls, default=None),
    }


def pooled_sizes(scores: Sequence[Mapping[str, float | None]]) -> dict[str, float | None]:
    """Pool the scores of one class of size over films; means are weighted by the labels that they are over."""
    counts = {name: int(sum(each[name] or 0 for each in scores)) for name in ("boxes", "found", "with_tracks")}
    over = dict.fromkeys(("recall", "whole", "iou", "covered", "dot_distance"), "boxes")
    over["tracks_at_once"] = "with_tracks"
    means = {
        name: _ratio(sum((each[name] or 0) * (each[of] or 0) for each in scores), counts[of])
        for name, of in over.items()
    }
    return counts | means


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


@dataclass(frozen=True)
class Mistake:
    """A run of frames in which a target was missed, or a track was on no label.

    Attributes:
        kind: "missed" or "false".
        frame: number of the frame in the middle of the run.
        box: label or track in that frame.
        frames: length of the run.
    """

    kind: str
    frame: int
    box: Box
    frames: int


def mistakes(matches: Sequence[FrameMatch]) -> list[Mistake]:
    """Find the longest run of misses of each target, and of wrong boxes of each track; the longest first."""
    runs: dict[tuple[str, int], list[list[tuple[int, Box]]]] = {}
    last: dict[tuple[str, int], int] = {}
    for i, match in enumerate(matches):
        wrong: list[tuple[str, int, Box]] = [("missed", label.target, label) for label in match.missed]
        wrong += [("false", track.track, track) for track in match.false]
        for kind, number, box in wrong:
            key = kind, number
            if last.get(key) != i - 1:
                runs.setdefault(key, []).append([])
            runs[key][-1].append((match.frame, box))
            last[key] = i
    found = []
    for (kind, _), of in runs.items():
        longest = max(of, key=len)
        found.append(Mistake(kind, *longest[len(longest) // 2], len(longest)))
    return sorted(found, key=lambda each: -each.frames)


# Files


def read_labels(path: Path) -> dict[int, list[Label]]:
    """Read labels by frame number, from 0: a csv, or ground truth of the MOT-challenge.

    The csv has the columns of `LABELS`, all from 0, of the box's top-left pixel; with a column `target`, that is the
    target's id, and otherwise the first box of every frame belongs to target 1, and so on. A file of the MOT-challenge
    has no header; its frames and pixels count from 1, and boxes marked with 0 do not count. A file without rows is of a
    film without targets.

    Raises:
        ConfigError: the file is missing, is no such table, or one target has two boxes in a frame.
    """
    labels: dict[int, list[Label]] = {}
    for frame, target, x, y, width, height, counts in _label_rows(path):
        if not (width > 0 and height > 0 and frame >= 0 and frame == int(frame)):
            first = int(_is_mot(path))
            raise ConfigError(
                f"{path}: a label wants a whole frame number from {first} on and a width and height above 0, "
                f"not frame {frame + first:g}, {width:g} x {height:g} px"
            )
        size, boxes = np.array([width, height]), labels.setdefault(int(frame), [])
        # A box of w pixels from column x covers columns x to x + w - 1.
        number = len(boxes) + 1 if target is None else int(target)
        if counts and any(each.counts and each.target == number for each in boxes):
            frame += _is_mot(path)
            raise ConfigError(
                f"{path}: frame {frame:g} has two boxes of target {number}; each wants a number of its own"
            )
        boxes.append(Label(np.array([x, y]) + (size - 1) / 2, size, number, bool(counts)))
    return labels


def _label_rows(path: Path) -> Iterable[tuple[float, float | None, float, float, float, float, float]]:
    """Rows of a file of labels: frame and target, left, top, width and height, all from 0, and whether it counts."""
    if path.is_file() and path.stat().st_size == 0:
        return
    if _is_mot(path):
        what = "ground truth of the MOT-challenge"
        for row in read_table(path, dict.fromkeys(MOT_COLUMNS, _finite) | {"id": _whole}, what, names=MOT_COLUMNS):
            frame, target, left, top, *rest = (row[name] for name in MOT_COLUMNS)
            yield frame - 1, target, left - 1, top - 1, *rest
    else:
        for row in read_table(path, dict.fromkeys(LABELS, _finite), "table of labels", optional={"target": _whole}):
            frame, *box = (row[name] for name in LABELS)
            yield frame, row.get("target"), *box, 1.0


def _is_mot(path: Path) -> bool:
    """Whether the first line of a file begins with a number."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            return math.isfinite(float(file.readline().split(",")[0]))
    except (OSError, ValueError):
        return False


def read_tracks(path: Path) -> list[Tracked]:
    """Read the table that `cotarget.detect_video.run_on_film` writes.

    Raises:
        ConfigError: the file is missing, or is no such table.
    """
    names = ("frame", "t", "track", "u_px", "v_px", "width_px", "height_px")
    return [
        Tracked(np.array([u, v]), np.array([width, height]), int(frame), t, int(track))
        for frame, t, track, u, v, width, height in (
            (row[name] for name in names) for row in read_table(path, dict.fromkeys(names, _finite), "table of tracks")
        )
    ]


def _whole(text: str) -> int:
    value = _finite(text)
    if value != int(value):
        raise ValueError(text)
    return int(value)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value
