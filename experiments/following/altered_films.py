"""The films of `films`, altered: smaller, larger, shaken, compressed, with frames left out.

Labels are altered with the films. Recall is given for all boxes and for those up to 12 px, with the detector's and the
tracker's usual settings.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import cv2
import numpy as np

from cotarget.config import DEFAULT_TARGETS, DetectorName
from cotarget.detection.base import moved
from cotarget.rig import Frame, Image
from cotarget.track_metrics import Box, Label, score_tracks
from cotarget.tracking.track import tracking_settings
from experiments.engine import Row
from experiments.following import films
from experiments.following.films import FolderSettings, LabelledFilm, detector_tracks, jobs, labelled_film, needs
from experiments.tables import grouped

__all__ = ["jobs", "needs"]
B = TypeVar("B", bound=Box)
# Largest side of a speck [px], and the part of the specks in smaller films that is wanted.
SPECK_PX, WANTED = 12.0, 0.9
SMALLER = ("half", "a third")
SHAKE_PX, DROPPED, QUALITY = 1.0, 0.3, 25


@dataclass(frozen=True)
class AlteredFilmsSettings(FolderSettings):
    """Settings: the detector."""

    detector: DetectorName = "auto"


def one(settings: AlteredFilmsSettings, number: int) -> list[Row]:
    """Search a film in every alteration; give a row for each."""
    film = labelled_film(*films.films(settings)[number])
    least = tracking_settings(replace(DEFAULT_TARGETS["bird"], detector=settings.detector)).confirm_score
    rows = []
    for name, alter in ALTERATIONS.items():
        altered = alter(film)
        tracks = detector_tracks(settings.detector, (least,), altered.frames, altered.rate_hz)[least]
        specks = score_tracks(
            tracks, _only_specks(altered), altered.rate_hz, len(altered.frames), criterion=altered.criterion
        )
        row = {**altered.row(name, least, 0, tracks), "specks": specks.boxes, "specks_found": specks.found}
        rows.append({"seed": number, **row, "minutes": len(film.frames) / film.rate_hz / 60})
    return rows


def _only_specks(film: LabelledFilm) -> dict[int, list[Label]]:
    """Give the labels, of which the larger ones do not count."""
    return {
        frame: [replace(label, counts=label.counts and label.larger_side_px <= SPECK_PX) for label in labels]
        for frame, labels in film.labels.items()
    }


# Alterations


def scaled(film: LabelledFilm, times: float) -> LabelledFilm:
    """Scale a film; the labels of a larger one are as loose as before, so its small boxes are larger too."""
    height, width = film.frames[0].image.shape[:2]
    size = round(times * width), round(times * height)
    way = cv2.INTER_AREA if times < 1 else cv2.INTER_CUBIC

    def move(box: B) -> B:
        return replace(box, center_px=(box.center_px + 0.5) * times - 0.5, size_px=box.size_px * times)

    return replace(
        film,
        frames=[_with(frame, cv2.resize(frame.image, size, interpolation=way)) for frame in film.frames],
        labels={frame: [move(label) for label in labels] for frame, labels in film.labels.items()},
        flyers={frame: [move(flyer) for flyer in flyers] for frame, flyers in film.flyers.items()},
        criterion=replace(film.criterion, small_px=film.criterion.small_px * max(1.0, times)),
    )


def shaken(film: LabelledFilm) -> LabelledFilm:
    """Shift every frame at random, by a standard deviation of SHAKE_PX along each axis."""
    shifts = np.random.default_rng(1).normal(0, SHAKE_PX, (len(film.frames), 2))
    frames = [_with(frame, moved(frame.image, shift)) for frame, shift in zip(film.frames, shifts, strict=True)]

    def move(boxes: Mapping[int, Sequence[B]]) -> dict[int, list[B]]:
        return {
            at: [replace(box, center_px=box.center_px + shifts[at]) for box in found]
            for at, found in boxes.items()
            if at < len(shifts)
        }

    return replace(film, frames=frames, labels=move(film.labels), flyers=move(film.flyers))


def dropped(film: LabelledFilm) -> LabelledFilm:
    """Leave out frames at random, a part of DROPPED; the others keep their times."""
    kept = np.flatnonzero(np.random.default_rng(1).random(len(film.frames)) >= DROPPED).tolist()
    return replace(
        film,
        frames=[film.frames[at] for at in kept],
        labels={new: film.labels[at] for new, at in enumerate(kept) if at in film.labels},
        flyers={new: film.flyers[at] for new, at in enumerate(kept) if at in film.flyers},
    )


def compressed(film: LabelledFilm) -> LabelledFilm:
    """Code every frame as JPEG of a quality of QUALITY."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    coded = [cv2.imencode(".jpg", frame.image, quality)[1] for frame in film.frames]
    images = [cv2.imdecode(each, cv2.IMREAD_COLOR) for each in coded]
    return replace(film, frames=[_with(*pair) for pair in zip(film.frames, images, strict=True)])


def _with(frame: Frame, image: Any) -> Frame:
    picture: Image = np.asarray(image, dtype=np.uint8)
    return replace(frame, image=picture)


ALTERATIONS: Mapping[str, Callable[[LabelledFilm], LabelledFilm]] = {
    "as it is": lambda film: film,
    "half": lambda film: scaled(film, 1 / 2),
    "a third": lambda film: scaled(film, 1 / 3),
    "twice as large": lambda film: scaled(film, 2),
    "shaken": shaken,
    "frames dropped": dropped,
    "compressed": compressed,
}


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give recall and false tracks a minute of each alteration, and the specks of the smaller films together."""
    found = {name: _figures(mine) for name, mine in grouped(rows, "way").items()}
    specks = [row for row in rows if row["way"] in SMALLER]
    found["half and a third"] = {"recall up to 12 px": _part(specks, "specks_found", "specks")}
    return found


def _figures(rows: Sequence[Row]) -> dict[str, float]:
    return {
        "recall": _part(rows, "found", "boxes"),
        "recall up to 12 px": _part(rows, "specks_found", "specks"),
        "false tracks a minute": _part(rows, "false_tracks", "minutes"),
        "the same, no flyer": _part(rows, "no_flyer", "minutes"),
    }


def _part(rows: Sequence[Row], part: str, whole: str) -> float:
    """Sum of a column over that of another; nan where there is none."""
    of = sum(row[whole] for row in rows)
    return float(sum(row[part] for row in rows) / of) if of else float("nan")


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the figures that are not as wanted."""
    recall = summary["half and a third"]["recall up to 12 px"]
    return [] if recall >= WANTED else [f"half and a third: recall up to 12 px: {recall:.3f}, not {WANTED:g} or more"]


SETTINGS = AlteredFilmsSettings()
QUICK = replace(SETTINGS, seeds=1)
COST_S = 40.0
