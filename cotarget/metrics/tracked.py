"""How well the wide view's tracks keep to a target that somebody labelled: scores of a table of tracks beside labels.

The table is the one that `cotarget.film.run_on_film` writes, and a label a box around the target in one frame; a frame
may have several, and frames without any say nothing of what is found in them, but that a track which is never on a
label is false. Where there are labels a track is false as it is beside the truth: off all of them for half a second on
end.
"""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cotarget.errors import ConfigError
from cotarget.geometry import Array
from cotarget.metrics.held import BREAK_S, FALSE_S, ROUNDING_S

LABELS = ("frame", "x_px", "y_px", "width_px", "height_px")
# Frames that no detector is judged by: the background has a second to be learnt.
LEARNING_FRAMES = 30


@dataclass(frozen=True)
class Label:
    """A box around a target: its middle (u, v), (2,), and width and height, (2,) [px]."""

    center_px: Array
    size_px: Array

    @property
    def larger_side_px(self) -> float:
        """The larger of its sides."""
        return float(self.size_px.max())


@dataclass(frozen=True)
class Tracked:
    """A confirmed track in one frame: the frame's number and time, the track's number, and its middle (u, v) [px]."""

    frame: int
    t: float
    track: int
    center_px: Array


@dataclass(frozen=True)
class TrackScore:
    """How well tracks keep to what is labelled. Each is None where nothing is labelled, or nothing was found.

    A track is on a target when it is no farther from the label's middle than the label's larger side.

    Attributes:
        labelled_frames: that are judged: those after LEARNING_FRAMES, up to the film's last.
        on_target_ratio: of these, in how many a track is on a label.
        numbers: how many different tracks were on a label in them.
        offset_px_median: of the track on it, from the label's middle [px].
        fragmentation_per_min: how often no track was on a label for longer than 0.2 s, a minute of labelled frames.
        false_tracks: tracks that were off every label for 0.5 s on end in frames that have labels, or that lived for
            0.5 s and were never on one.
        false_tracks_per_min: the same, a minute of the film.
        labels_beyond_end: labelled frames that the film does not have; they are not judged, and of another film maybe.
    """

    labelled_frames: int
    on_target_ratio: float | None
    numbers: int
    offset_px_median: float | None
    fragmentation_per_min: float | None
    false_tracks: int
    false_tracks_per_min: float | None
    labels_beyond_end: int = 0


def score_tracks(
    tracks: Iterable[Tracked],
    labels: Mapping[int, Sequence[Label]],
    rate_hz: float,
    frames: int,
    learning_frames: int = LEARNING_FRAMES,
) -> TrackScore:
    """Score tracks.

    Args:
        tracks: the confirmed ones of every frame.
        labels: by the frame's number, from 0; those of frames that the film does not have are left out, and counted.
        rate_hz: frames a second.
        frames: how many the film has.
        learning_frames: so many at its beginning are not judged.
    """
    offsets: dict[int, dict[int, float]] = {}  # by frame and track, of those on a label
    lives: dict[int, list[Tracked]] = {}
    for each in tracks:
        lives.setdefault(each.track, []).append(each)
        for label in labels.get(each.frame, ()):
            offset = float(np.linalg.norm(each.center_px - label.center_px))
            if offset <= label.larger_side_px:
                on = offsets.setdefault(each.frame, {})
                on[each.track] = min(offset, on.get(each.track, math.inf))
    false = sum(_is_false(life, labels, offsets) for life in lives.values())
    labelled = sorted(frame for frame, boxes in labels.items() if boxes)
    judged = [frame for frame in labelled if learning_frames <= frame < frames]
    hits = [offsets[frame] for frame in judged if frame in offsets]
    minutes, labelled_minutes = frames / rate_hz / 60, len(judged) / rate_hz / 60
    breaks = _breaks([frame in offsets for frame in judged], judged, rate_hz)
    return TrackScore(
        labelled_frames=len(judged),
        on_target_ratio=len(hits) / len(judged) if judged else None,
        numbers=len({track for on in hits for track in on}),
        offset_px_median=float(np.median([min(on.values()) for on in hits])) if hits else None,
        fragmentation_per_min=breaks / labelled_minutes if hits else None,
        false_tracks=false,
        false_tracks_per_min=false / minutes if frames else None,
        labels_beyond_end=sum(frame >= frames for frame in labelled),
    )


def _is_false(
    life: Sequence[Tracked], labels: Mapping[int, Sequence[Label]], offsets: Mapping[int, Mapping[int, float]]
) -> bool:
    """Whether a track was off every label for half a second on end; a frame without labels ends what was before it."""
    if not any(each.track in offsets.get(each.frame, ()) for each in life):
        return life[-1].t - life[0].t >= FALSE_S - ROUNDING_S
    since: Tracked | None = None
    last = -1
    for each in life:
        if not labels.get(each.frame) or each.track in offsets.get(each.frame, ()):
            since = None
        elif since is None or each.frame != last + 1:
            since = each
        elif each.t - since.t >= FALSE_S - ROUNDING_S:
            return True
        last = each.frame
    return False


def _breaks(on: Sequence[bool], frames: Sequence[int], rate_hz: float) -> int:
    """How often there was no track for longer than 0.2 s, in frames that are labelled one after the other."""
    breaks, lacking = 0, 0
    for i, is_on in enumerate(on):
        if is_on or (i and frames[i] != frames[i - 1] + 1):
            lacking = 0
        if not is_on:
            lacking += 1
            # Counted once, when it has lasted for long enough.
            breaks += lacking / rate_hz > BREAK_S + ROUNDING_S >= (lacking - 1) / rate_hz
    return breaks


def read_labels(path: Path) -> dict[int, list[Label]]:
    """Read labels: a csv with frame (from 0), x_px, y_px (of the top-left pixel, from 0), width_px and height_px.

    Raises:
        ConfigError: the file is missing, is no such table, or has no row.
    """
    labels: dict[int, list[Label]] = {}
    for row in _table(path, LABELS, "labels"):
        frame, x, y, width, height = (row[name] for name in LABELS)
        if not (width > 0 and height > 0 and frame >= 0 and frame == int(frame)):
            raise ConfigError(f"{path}: a label wants a whole frame from 0 and a width and height above 0, not {row}")
        size = np.array([width, height])
        # A box of w pixels from column x covers columns x to x + w - 1.
        labels.setdefault(int(frame), []).append(Label(np.array([x, y]) + (size - 1) / 2, size))
    if not labels:
        raise ConfigError(f"{path}: holds no label, but for the names of its columns; it wants a row for each box")
    return labels


def read_tracks(path: Path) -> list[Tracked]:
    """Read the table that `cotarget.film.run_on_film` writes.

    Raises:
        ConfigError: the file is missing, or is no such table.
    """
    names = ("frame", "t", "track", "u_px", "v_px")
    return [
        Tracked(int(row["frame"]), row["t"], int(row["track"]), np.array([row["u_px"], row["v_px"]]))
        for row in _table(path, names, "tracks")
    ]


def _table(path: Path, names: Sequence[str], what: str) -> list[dict[str, float]]:
    """The numbers of a csv's columns.

    Raises:
        ConfigError: the file is missing, lacks a column, or holds something else.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # as spreadsheets write it
            reader = csv.DictReader(file)
            if missing := [name for name in names if name not in (reader.fieldnames or ())]:
                raise ValueError(f"it has no column '{missing[0]}'; it wants {', '.join(names)}")
            rows = [{name: float(row[name] or "nan") for name in names} for row in reader]
        for line, row in enumerate(rows, start=2):
            if odd := [name for name, value in row.items() if not math.isfinite(value)]:
                raise ValueError(f"line {line} has no number for {odd[0]}")
        return rows
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; give a csv with {','.join(names)}") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except (csv.Error, ValueError, TypeError) as error:
        raise ConfigError(f"{path}: is no table of {what}: {error}") from None
