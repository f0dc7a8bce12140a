"""How far the simulation is from film: recall and centre error of detectors in both, by stratum.

"auto", MOG2 and KNN, with one tracker and one setting each, run on three kinds of film, two of them with two kinds of
boxes:

- real: the labelled films of `experiments.following.films`;
- fitted: the same, with a tight box around what contrasts in each label, because published boxes are up to seven times
  as large as the target; a label in which nothing contrasts is dropped;
- composite: the same films with made flyers drawn far from the labels, whose boxes are exact;
- simulation: five simulated birds in the field of `experiments.following.field`, with true boxes;
- simulation, fitted: the same with boxes that are fitted as those of the films, for a true box has wing tips too faint
  to be seen.

Each labelled box belongs to a stratum by its size, contrast, speed and background. Tracks and labels are matched one to
one, from frame 30 on, see `cotarget.track_metrics`.
"""

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from cotarget.config import DEFAULT_TARGETS, DetectorName
from cotarget.geometry import Array
from cotarget.metrics import WHOLLY_VISIBLE
from cotarget.rig import Frame, Image
from cotarget.sim.world import SimWorld
from cotarget.track_metrics import LEARNING_FRAMES, Box, Criterion, Label, Tracked, match_frames
from cotarget.tracking.track import tracking_settings
from cotarget.video import Film
from experiments.engine import Count, Row
from experiments.following import films
from experiments.following.detectors import COME_S
from experiments.following.field import five_targets_config
from experiments.following.films import FolderSettings, needs
from experiments.following.wide_view import WIDE
from experiments.tables import grouped

__all__ = ["needs"]
Labels = dict[int, list[Label]]  # by frame number
DETECTOR: DetectorName = "auto"
WAYS = (DETECTOR, *films.MIXTURES)
KINDS = ("real", "fitted", "composite", "simulation", "simulation, fitted")
FITTED = {"real": "fitted", "simulation": "simulation, fitted"}  # kinds of film with fitted boxes, and their names
# The usual setting of the mixtures: threshold of MOG2 [variances] and smallest area of a component [px].
THRESHOLD, AREA_PX = 16.0, 16

# Strata: limits, and names of what is below or up to them and above.
SIZES_PX, SIZES = (12.0, 24.0, 60.0), ("up to 12 px", "12-24 px", "24-60 px", "over 60 px")
CONTRAST, CONTRASTS = 5.0, ("faint", "clear")  # in standard deviations of the ring
SPEED, SPEEDS = 2.0, ("slow", "fast")  # in larger sides per second
TEXTURE, BEFORE = 8.0, ("sky", "trees")  # standard deviation of the ring [grey levels]
STRATA = [", ".join(names) for names in itertools.product(SIZES, CONTRASTS, SPEEDS, BEFORE)]
# The ring around a box: gap, which the blur of the target's edge fills, and least and largest width [px]; half the
# larger side in between.
GAP_PX, RING_PX = 2, (4, 24)
LEAST_SPREAD = 1.0  # standard deviation that a ring has at least; coding smooths a sky below it [grey levels]
SPEED_FRAMES = 3  # frames before and after one from which its speed is measured

# Fitted boxes. On made flyers of clear contrast they are 0.4 to 1 px too small, and 0.3 px off.
SEEN = 5.0  # least difference of a target from the ring [standard deviations of the ring]
REACH, ABOVE_NOISE = 0.2, 2.5  # the box ends at this part of the largest difference, or at this many deviations
CLOSED_PX, LEAST_PX = 3, 3  # kernel that closes gaps [px], and fewest pixels of a target

# Made flyers: ranges of the larger side [px], one flyer of each; ranges of the difference to the background [grey
# levels], the speed [larger sides per second] and the wing beats [Hz]; and the highest speed [px/s].
SIDES_PX = ((4.0, 12.0), (12.0, 24.0), (24.0, 60.0), (60.0, 120.0))
DIFFERENCE, FLIGHT, FASTEST_PX_S, BEAT_HZ = (8.0, 100.0), (0.1, 6.0), 400.0, (3.0, 8.0)
BEAT_RAD = 0.7  # largest angle of a wing
PATHS = 50  # random paths, of which the one farthest from all labels is taken
BLUR_PX, FINER = 0.7, 8  # blur of the lens; and by how much finer a flyer is drawn

# Goals, and the fewest boxes of a stratum, in simulation and in fitted films each, for which they hold.
LEAST_BOXES = 200
RECALL_WITHIN = {"auto": 0.03, "MOG2": 0.08, "KNN": 0.08}
ERROR_WITHIN_PX = 0.3


@dataclass(frozen=True)
class SimToRealSettings(FolderSettings):
    """Settings: most films of each kind, as seeds, and most frames of each."""

    seeds: Count = 20
    frames: Count = 300


@dataclass(frozen=True)
class Clip:
    """Frames with labels by frame number, and the frame rate [Hz]."""

    frames: list[Frame]
    labels: Labels
    rate_hz: float


def jobs(settings: SimToRealSettings) -> Sequence[int]:
    """Give a number for each film and source; one film where there is none."""
    return range(len(SOURCES) * len(films.jobs(settings)))


def one(settings: SimToRealSettings, number: int) -> list[Row]:
    """Search one film of a source; give a row for each kind, detector and stratum."""
    film, source = divmod(number, len(SOURCES))
    kind, made = list(SOURCES.items())[source]
    clip = made(settings, film)
    tracks = _tracks(clip)
    greys = [np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY), dtype=np.uint8) for frame in clip.frames]
    labels = {kind: clip.labels}
    if kind in FITTED:
        labels[FITTED[kind]] = fitted_labels(greys, clip.labels)
    return [
        {"seed": number, "film": film, "kind": kind, "detector": way, **row}
        for kind, boxes in labels.items()
        for way, found in tracks.items()
        for row in scores(found, boxes, strata(greys, boxes, clip.rate_hz))
    ]


def _tracks(clip: Clip) -> dict[str, list[Tracked]]:
    """Track what each detector finds."""
    least = tracking_settings(replace(DEFAULT_TARGETS["bird"], detector=DETECTOR)).confirm_score
    ours = films.detector_tracks(DETECTOR, (least,), clip.frames, clip.rate_hz)[least]
    mixtures = {way: films.mixture_tracks(way, THRESHOLD, (AREA_PX,), clip.frames)[AREA_PX] for way in films.MIXTURES}
    return {DETECTOR: ours, **mixtures}


def scores(tracks: Sequence[Tracked], labels: Labels, where: Mapping[tuple[int, int], str]) -> list[Row]:
    """Count labelled boxes and those found in each stratum, and measure the median centre error [px].

    Args:
        tracks: confirmed tracks of every frame.
        labels: labels by frame number.
        where: stratum by frame number and target.
    """
    boxes, errors = Counter[str](), dict[str, list[float]]()
    for match in match_frames(tracks, labels, Criterion(iou=0.3)):
        if match.frame < LEARNING_FRAMES:
            continue
        boxes.update(where[match.frame, label.target] for label in [*match.missed, *(pair[0] for pair in match.pairs)])
        for label, track in match.pairs:
            off = float(np.linalg.norm(label.center_px - track.center_px))
            errors.setdefault(where[match.frame, label.target], []).append(off)
    return [
        {
            "stratum": name,
            "boxes": boxes[name],
            "found": len(errors.get(name, ())),
            "error_px": float(np.median(errors[name])) if name in errors else None,
        }
        for name in STRATA
        if boxes[name]
    ]


# Strata


def strata(greys: Sequence[Image], labels: Labels, rate_hz: float) -> dict[tuple[int, int], str]:
    """Give the stratum of each labelled box by frame number and target.

    Args:
        greys: grey image of each frame, (H, W).
        labels: labels by frame number.
        rate_hz: frames per second.
    """
    return {
        (frame, label.target): stratum(
            label.larger_side_px, *appearance(greys[frame], label), speed(labels, frame, label.target, rate_hz)
        )
        for frame, boxes in labels.items()
        for label in boxes
    }


def stratum(side_px: float, contrast: float, texture: float, speed_px_s: float) -> str:
    """Name the stratum of a larger side [px], contrast, standard deviation of the ring [grey levels] and speed."""
    return ", ".join(
        (
            SIZES[int(np.searchsorted(SIZES_PX, side_px))],
            CONTRASTS[contrast >= CONTRAST],
            SPEEDS[speed_px_s / side_px >= SPEED],
            BEFORE[texture > TEXTURE],
        )
    )


def appearance(grey: Image, box: Box) -> tuple[float, float]:
    """Measure the contrast of a box's inside to its ring, and the ring's standard deviation [grey levels].

    The contrast is the difference of the means over the standard deviation.
    """
    ring = _ring(grey, box)
    difference = abs(float(grey[_pixels(box, 0, grey.shape)].mean()) - float(ring.mean()))
    return difference / max(float(ring.std()), LEAST_SPREAD), float(ring.std())


def speed(labels: Labels, frame: int, target: int, rate_hz: float) -> float:
    """Measure the speed of a target at a frame [px/s]; 0 if it is labelled in no other frame nearby."""
    near = [
        (k, label.center_px)
        for k in range(frame - SPEED_FRAMES, frame + SPEED_FRAMES + 1)
        for label in labels.get(k, ())
        if label.target == target
    ]
    (first, start), (last, end) = near[0], near[-1]
    return float(np.linalg.norm(end - start)) * rate_hz / (last - first) if last > first else 0.0


def _pixels(box: Box, margin_px: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Give rows and columns of a box with a margin in an image, one of each at least."""
    limit = np.array(shape[1::-1])
    low = np.rint(box.center_px - box.size_px / 2 + 0.5 - margin_px).astype(int).clip(0, limit - 1)
    high = np.rint(box.center_px + box.size_px / 2 + 0.5 + margin_px).astype(int).clip(low + 1, limit)
    return slice(low[1], high[1]), slice(low[0], high[0])


def _ring(grey: Image, box: Box) -> Array:
    """Give the grey levels in the ring around a box, (n,)."""
    outer = np.zeros(grey.shape, dtype=bool)
    outer[_pixels(box, GAP_PX + float(np.clip(box.larger_side_px / 2, *RING_PX)), grey.shape)] = True
    outer[_pixels(box, GAP_PX, grey.shape)] = False
    return grey[outer].astype(float)


# Fitted boxes


def fitted_labels(greys: Sequence[Image], labels: Labels) -> Labels:
    """Replace each label by the tight box around what contrasts in it; drop those in which nothing does."""
    return {
        frame: [each for label in boxes if (each := fitted(greys[frame], label)) is not None]
        for frame, boxes in labels.items()
    }


def fitted(grey: Image, label: Label) -> Label | None:
    """Fit a tight box to what contrasts with the ring inside a label; None if nothing does.

    The box is that of the connected pixels that together differ most from the ring's median.
    """
    ring = _ring(grey, label)
    rows, columns = _pixels(label, 0, grey.shape)
    difference = np.abs(grey[rows, columns] - np.median(ring))
    noise, largest = max(float(ring.std()), LEAST_SPREAD), float(difference.max())
    if largest < SEEN * noise:
        return None
    mask = difference >= max(REACH * largest, ABOVE_NOISE * noise)
    padded = np.pad(mask.astype(np.uint8), CLOSED_PX)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((CLOSED_PX, CLOSED_PX), dtype=np.uint8))
    _, parts, stats, _ = cv2.connectedComponentsWithStats(closed[CLOSED_PX:-CLOSED_PX, CLOSED_PX:-CLOSED_PX])
    best = 1 + int(np.argmax(np.bincount(parts.ravel(), (difference * mask).ravel())[1:]))
    x, y, width, height, area = stats[best].tolist()
    if area < LEAST_PX:
        return None
    size = np.array([width, height], dtype=float)
    return replace(label, center_px=np.array([columns.start + x, rows.start + y]) + (size - 1) / 2, size_px=size)


# Sources


def _real(settings: SimToRealSettings, number: int) -> Clip:
    """Read a film and its labels; any first films are a random sample of all."""
    found = films.films(settings)
    video, file = found[np.random.default_rng(0).permutation(len(found))[number]]
    with Film(video) as film:
        frames, rate = list(itertools.islice(film, settings.frames)), film.rate_hz
    labels = {frame: boxes for frame, boxes in films.labels_of(file).items() if frame < len(frames)}
    return Clip(frames, labels, rate)


def _composite(settings: SimToRealSettings, number: int) -> Clip:
    """Draw made flyers of each size into a film, far from its labels and from each other."""
    clip, rng = _real(settings, number), np.random.default_rng(number)
    images = [frame.image.copy() for frame in clip.frames]
    taken = [(frame, *box.center_px, *box.size_px) for frame, boxes in clip.labels.items() for box in boxes]
    labels: Labels = {frame: [] for frame in range(len(images))}
    for target, sides in enumerate(SIDES_PX, 1):
        side = _log_uniform(rng, sides)
        path = max((_path(rng, images, side, clip.rate_hz) for _ in range(PATHS)), key=lambda p: _gap(p, side, taken))
        taken += [(frame, *center, side, side) for frame, center in enumerate(path)]
        colour = np.median(images[0][_pixels(Box(path[0], np.full(2, side)), GAP_PX, images[0].shape)], axis=(0, 1))
        colour = colour + rng.choice([-1.0, 1.0], p=[0.7, 0.3]) * _log_uniform(rng, DIFFERENCE)
        beat_hz = rng.choice([0.0, rng.uniform(*BEAT_HZ)])
        for frame, center in enumerate(path):
            beat = BEAT_RAD * np.sin(2 * np.pi * beat_hz * frame / clip.rate_hz)
            box = draw_flyer(images[frame], center, side, beat, colour.clip(0, 255))
            labels[frame].append(Label(box.center_px, box.size_px, target))
    frames = [replace(frame, image=image) for frame, image in zip(clip.frames, images, strict=True)]
    return Clip(frames, labels, clip.rate_hz)


def _log_uniform(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(limits))))


def _path(rng: np.random.Generator, images: Sequence[Image], side_px: float, rate_hz: float) -> Array:
    """Draw a random straight path that turns round at the image's border: centre in each frame, (n, 2) [px]."""
    room = np.array(images[0].shape[1::-1]) - side_px
    way, px_s = rng.uniform(0, 2 * np.pi), min(side_px * _log_uniform(rng, FLIGHT), FASTEST_PX_S)
    steps = np.outer(np.arange(len(images)) / rate_hz, px_s * np.array([np.cos(way), np.sin(way)]))
    unfolded = (rng.uniform(0, 1, 2) * room + steps) % (2 * room)
    return side_px / 2 + np.minimum(unfolded, 2 * room - unfolded)


def _gap(path: Array, side_px: float, taken: Sequence[tuple[float, ...]]) -> float:
    """Give the least gap between a path's boxes and those of the same frames, (frame, centre, size) [px]."""
    frame, x, y, width, height = np.reshape(taken, (-1, 5)).T
    apart = np.abs(path[frame.astype(int)] - np.column_stack([x, y])) - np.column_stack([width, height]) / 2
    return float((apart - side_px / 2).max(axis=1).min(initial=np.inf))


def draw_flyer(image: Image, center_px: Array, side_px: float, beat_rad: float, colour: Array) -> Box:
    """Draw a body with two wings into an image.

    Args:
        image: changed in place, (H, W, 3).
        center_px: middle of the body (u, v), (2,) [px].
        side_px: wingspan [px].
        beat_rad: angle of both wings above the horizontal.
        colour: of the flyer, (3,) [grey levels].

    Returns:
        Exact box of the flyer before the lens blurs it.
    """
    turn = np.linspace(0, 2 * np.pi, 40)
    body = side_px * np.column_stack([0.2 * np.cos(turn), 0.15 * np.sin(turn)])
    tip = side_px / 2 * np.array([np.cos(beat_rad), -np.sin(beat_rad)])
    wings = [np.array([[0, -0.15 * side_px], tip * (way, 1), [0, 0.15 * side_px]]) for way in (-1, 1)]
    return draw_polygons(image, [(center_px + part, colour) for part in (body, *wings)])


def draw_polygons(image: Image, parts: Sequence[tuple[Array, Sequence[float] | Array]]) -> Box:
    """Draw polygons into an image, the later ones over the others, seen through a lens.

    Args:
        image: changed in place, (H, W, 3).
        parts: corners (u, v), (n, 2) [px], and colour, (3,) [grey levels], of each.

    Returns:
        Exact box before the lens blurs it.
    """
    low, high = (limit(np.vstack([corners for corners, _ in parts]), axis=0) for limit in (np.min, np.max))
    box = Box((low + high) / 2, high - low)
    rows, columns = _pixels(box, np.ceil(3 * BLUR_PX), image.shape)
    size = columns.stop - columns.start, rows.stop - rows.start
    fine = np.zeros((size[1] * FINER, size[0] * FINER, 4), dtype=np.float32)  # the last channel is what is covered
    corner = np.array([columns.start, rows.start]) - 0.5
    for corners, colour in parts:
        cv2.fillPoly(fine, [np.rint((corners - corner) * FINER - 0.5).astype(np.int32)], (*colour, 1.0))
    seen = cv2.resize(cv2.GaussianBlur(fine, None, BLUR_PX * FINER), size, interpolation=cv2.INTER_AREA)
    image[rows, columns] = np.rint((1 - seen[..., 3:]) * image[rows, columns] + seen[..., :3])
    return box


def _simulation(settings: SimToRealSettings, number: int) -> Clip:
    """Render five birds in the field, from when the first comes."""
    return rendered(SimWorld(five_targets_config(number, "bird"), rendered=WIDE), COME_S, settings.frames)


def rendered(world: SimWorld, come_s: float, most: int) -> Clip:
    """Render the fixed camera's frames; a target that is not wholly visible has no label.

    Args:
        world: world whose fixed camera is rendered.
        come_s: when the first target comes; the background is learnt before [s].
        most: number of frames.
    """
    truth, frames, labels = world.truth(), list[Frame](), Labels()
    rate_hz = world.config.sim.fixed.rate_hz
    t = come_s - LEARNING_FRAMES / rate_hz
    with world.rig as rig:
        rig.clock.sleep_until(t)
        for index in range(most):
            frame = rig.fixed.read(newer_than=t)
            t = frame.t
            outlines = [truth.silhouette(name, "fixed", frame.t) for name in truth.targets]
            labels[index] = [
                Label((each.low_px + each.high_px) / 2, each.size_px, target)
                for target, each in enumerate(outlines, 1)
                if each is not None and each.visible >= WHOLLY_VISIBLE
            ]
            frames.append(frame)
    return Clip(frames, labels, rate_hz)


SOURCES: dict[str, Callable[[SimToRealSettings, int], Clip]] = {
    "real": _real,
    "composite": _composite,
    "simulation": _simulation,
}


# Figures


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """Give boxes, recall, and median of the films' centre errors weighted by boxes found, by stratum and kind."""
    found = grouped(rows, "stratum", "kind")
    return {
        stratum: {
            kind: _figures(grouped(found[stratum, kind], "detector")) for kind in KINDS if (stratum, kind) in found
        }
        for stratum in STRATA
        if any((stratum, kind) in found for kind in KINDS)
    }


def _figures(ways: Mapping[str, Sequence[Row]]) -> dict[str, float]:
    boxes = {way: sum(row["boxes"] for row in rows) for way, rows in ways.items()}
    recall = {f"recall {way}": sum(row["found"] for row in rows) / boxes[way] for way, rows in ways.items()}
    error = {f"error_px {way}": _error(rows) for way, rows in ways.items()}
    return {"frames": next(iter(boxes.values())), **recall, **error}


def _error(rows: Sequence[Row]) -> float:
    found = [row for row in rows if row["found"]]
    each = np.repeat([row["error_px"] for row in found], [row["found"] for row in found])
    return float(np.median(each)) if found else np.nan


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the strata in which simulation and fitted films are too far apart."""
    far = []
    for name, kinds in summary.items():
        pair = [kinds[kind] for kind in ("simulation", "fitted") if kind in kinds]
        if len(pair) < 2 or min(each["frames"] for each in pair) < LEAST_BOXES:
            continue
        for way, most in RECALL_WITHIN.items():
            for figure, within in ((f"recall {way}", most), (f"error_px {way}", ERROR_WITHIN_PX)):
                simulated, real = (each[figure] for each in pair)
                if abs(simulated - real) > within:
                    far.append(f"{name}: {figure} {simulated:.3g} simulated, {real:.3g} in film, not within {within:g}")
    return far


SETTINGS = SimToRealSettings()
QUICK = replace(SETTINGS, seeds=1, frames=45)
COST_S = 40.0
