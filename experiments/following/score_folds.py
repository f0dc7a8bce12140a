"""The score of small targets on films that it was not fitted to.

The weights of `cotarget.detection.small_target.small_target_score` are fitted to four fifths of the labelled films of
`experiments.following.films`. The others are searched with these weights, with those fitted to all films, and with the
usual ones. Films of one place and day are in one fifth; `film_division.csv` lists them, by their backgrounds.

A region that the detector examines in a labelled frame is a target if it is on a label. Logistic regression takes
targets and others as equally likely in every film.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, xlogy

from cotarget.config import DEFAULT_TARGETS
from cotarget.detection import AutoDetector
from cotarget.detection.small_target import WEIGHTS, SmallTargetFinder, Weights, evidence
from cotarget.files import read_table
from cotarget.geometry import Array
from cotarget.track_metrics import LEARNING_FRAMES, Box, Criterion
from cotarget.tracking.track import tracking_settings
from experiments.engine import Count, Row
from experiments.following import films
from experiments.following.films import FolderSettings, LabelledFilm, labelled_film, needs, tracks_of
from experiments.tables import grouped

__all__ = ["needs"]
PLACES = Path(__file__).with_name("film_division.csv")
FOLDS = 5
WITHIN = 0.01  # of the recall with weights fitted to all films
USUAL, ALL, OTHERS = "usual weights", "fitted to all films", "fitted to the other films"
TARGET = replace(DEFAULT_TARGETS["bird"], detector="auto")


@dataclass(frozen=True)
class ScoreFoldsSettings(FolderSettings):
    """Settings: fifths of the films, as seeds, and which films are used."""

    seeds: Count = FOLDS
    every: Count = 1  # 2 for every second film, and so on


def jobs(settings: ScoreFoldsSettings) -> Sequence[int]:
    """Give the fifths' numbers."""
    return range(min(settings.seeds, FOLDS))


def one(settings: ScoreFoldsSettings, number: int) -> list[Row]:
    """Fit the weights with and without a fifth of the films, and search these; give a row for each film and weights."""
    found, regions = _films_and_regions(settings)
    held_out = folds([video.stem for video, _ in found])[number]
    others = [each for i, each in enumerate(regions) if i not in held_out]
    ways = {USUAL: WEIGHTS, ALL: fit(regions), OTHERS: fit(others)}
    rows = []
    for i in held_out:
        film = labelled_film(*found[i])
        rows += [{"seed": number, **_searched(film, name, weights)} for name, weights in ways.items()]
    return rows


def folds(names: Sequence[str]) -> list[list[int]]:
    """Divide films into fifths of about as many, those of one place in one; give their indices in each."""
    place = {row["film"]: row["place"] for row in read_table(PLACES, {"film": str, "place": str}, "places of films")}
    places: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        places.setdefault(place.get(name, name), []).append(i)
    found: list[list[int]] = [[] for _ in range(FOLDS)]
    for together in sorted(places.values(), key=len, reverse=True):
        min(found, key=len).extend(together)
    return found


@functools.cache
def _films_and_regions(settings: ScoreFoldsSettings) -> tuple[list[tuple[Path, Path]], list[tuple[Array, Array]]]:
    """Give the films, and the regions examined in each; they are the same for every fifth."""
    found = films.films(settings)[:: settings.every]
    return found, [examined(labelled_film(*pair)) for pair in found]


def _searched(film: LabelledFilm, name: str, weights: Weights) -> Row:
    least = tracking_settings(TARGET).confirm_score
    tracks = tracks_of(AutoDetector(film.rate_hz, weights), TARGET, (least,), film.frames)[least]
    columns = dict(zip(("signal", "change", "texture", "constant"), weights, strict=True))
    return film.row(name, least, 0, tracks) | columns


def examined(film: LabelledFilm) -> tuple[Array, Array]:
    """Give the evidence of each region examined in labelled frames, (n, 3), and whether it is on a label, (n,)."""
    finder, seen, on = SmallTargetFinder(least_score=0.0), list[Any](), list[bool]()
    for index, frame in enumerate(film.frames):
        targets, found = finder.find(frame)
        if index < LEARNING_FRAMES or not film.labels.get(index):
            continue
        for target, detection in zip(targets, found.boxes, strict=True):
            box = Box(detection.center_px, detection.size_px)
            if not target.since or detection.clipped or _is_on(box, film.flyers.get(index, ())):
                continue
            logarithms = evidence(target.signal, target.since, target.beside)
            if logarithms is not None:
                seen.append(logarithms)
                on.append(_is_on(box, film.labels[index]))
    return np.reshape(seen, (-1, 3)), np.array(on, dtype=bool)


def _is_on(box: Box, boxes: Sequence[Box]) -> bool:
    """Whether a box is on one of some boxes."""
    criterion = Criterion(iou=0.3)
    return bool((criterion.similarity(boxes, [box]) >= criterion.iou).any())


def fit(found: Sequence[tuple[Array, Array]]) -> Weights:
    """Fit the weights to regions of films by logistic regression.

    Args:
        found: for each film the logarithms of signal, change and texture, (n, 3), and which are targets, (n,).
    """
    both = [(seen, on) for seen, on in found if on.any() and not on.all()]
    x = np.column_stack([np.vstack([seen for seen, _ in both]), np.ones(sum(len(on) for _, on in both))])
    y = np.concatenate([on for _, on in both]).astype(float)
    share = np.concatenate([0.5 * np.where(on, 1 / on.sum(), 1 / (1 - on).sum()) for _, on in both]) / len(both)

    def loss(weights: Array) -> tuple[float, Array]:
        p = expit(x @ weights)
        return float(-(share * (xlogy(y, p) + xlogy(1 - y, expit(-(x @ weights))))).sum()), x.T @ (share * (p - y))

    signal, change, texture, constant = minimize(loss, np.array(WEIGHTS), jac=True, method="BFGS").x.tolist()
    return signal, change, texture, constant


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give recall and false tracks a minute with each weights, over all films, and the range of the weights."""
    figures = {}
    for way, mine in grouped(rows, "way").items():
        boxes, minutes = (sum(row[name] for row in mine) for name in ("boxes", "minutes"))
        figures[way] = {
            "recall": sum(row["found"] for row in mine) / boxes,
            "false tracks a minute": sum(row["false_tracks"] for row in mine) / minutes,
            "the same, no flyer": sum(row["no_flyer"] for row in mine) / minutes,
        }
        for name in ("signal", "change", "texture", "constant"):
            figures[way] |= {f"least {name}": min(r[name] for r in mine), f"largest {name}": max(r[name] for r in mine)}
    return figures


def missed(summary: Mapping[str, Any]) -> list[str]:
    """State the recall on films that were not fitted, if it is farther off than wanted."""
    fitted, others = (summary[way]["recall"] for way in (ALL, OTHERS))
    return [] if abs(fitted - others) <= WITHIN else [f"recall {others:.3f} {OTHERS}, {fitted:.3f} {ALL}"]


SETTINGS = ScoreFoldsSettings()
QUICK = replace(SETTINGS, seeds=1, every=23)
COST_S = 300.0
