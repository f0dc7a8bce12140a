"""Targets of any shape, with no setting but their size: a car, a dog and a boat, simulated and drawn into real films.

The simulated ones are MJCF models on the path of a walking person in the field of `experiments.following.field`.
The composites are drawings of several colours that cross real films. Both are searched by the default detector of a
target of one's own. Boxes are exact; tracks and boxes are matched one to one, from frame 30 on, see
`cotarget.track_metrics`.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cotarget.config import TargetProfile
from cotarget.detection import make_detector
from cotarget.geometry import Array
from cotarget.rig import Frame, Image
from cotarget.sim.targets.random_paths import lone_path
from cotarget.sim.world import SimWorld
from cotarget.track_metrics import Box, Criterion, Label, score_tracks
from cotarget.tracking.track import tracking_settings
from experiments.engine import Count, Row
from experiments.following import films
from experiments.following.field import field_config
from experiments.following.films import FolderSettings, LabelledFilm, labelled_film, needs, tracks_of
from experiments.following.sim_to_real import Clip, draw_polygons, rendered
from experiments.following.wide_view import WIDE
from experiments.tables import grouped

__all__ = ["needs"]
WANTED = 0.95
EVERY = 5  # the labelled films that are taken: every fifth
# Composites: length [px], speed [lengths per second], and number of heights of which the farthest from labels is taken.
LENGTH_PX, SPEED, HEIGHTS = (24.0, 120.0), (0.5, 2.0), 50
COME_S = 2.0  # by then the background of the simulated field was learnt, and the target is not yet in view [s]


@dataclass(frozen=True)
class Shape:
    """A target's shape.

    Attributes:
        length_m: its length.
        height_m: its height.
        geoms: its parts, as MJCF [m] around its middle; x is forward, z up.
        drawn: polygons in parts of its length around its middle (u, v), v down, each with its colour (BGR).
    """

    length_m: float
    height_m: float
    geoms: str
    drawn: tuple[tuple[tuple[tuple[float, float], ...], tuple[int, int, int]], ...]


def _round(u: float, v: float, radius: float) -> tuple[tuple[float, float], ...]:
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    return tuple((u + radius * float(np.cos(a)), v + radius * float(np.sin(a))) for a in turn)


def _block(left: float, top: float, right: float, bottom: float) -> tuple[tuple[float, float], ...]:
    return (left, top), (right, top), (right, bottom), (left, bottom)


SHAPES: Mapping[str, Shape] = {
    "car": Shape(
        4.2,
        1.4,
        """<geom type="box" pos="0 0 -.15" size="2.1 .85 .35" rgba=".55 .1 .1 1"/>
        <geom type="box" pos="-.2 0 .45" size="1.1 .75 .25" rgba=".1 .1 .15 1"/>
        <geom type="cylinder" pos="1.3 0 -.4" euler="90 0 0" size=".3 .86" rgba=".05 .05 .05 1"/>
        <geom type="cylinder" pos="-1.3 0 -.4" euler="90 0 0" size=".3 .86" rgba=".05 .05 .05 1"/>""",
        (
            (_block(-0.5, -0.05, 0.5, 0.1), (40, 40, 160)),
            (((-0.3, -0.05), (-0.2, -0.17), (0.12, -0.17), (0.24, -0.05)), (60, 50, 40)),
            (_round(-0.3, 0.1, 0.07), (20, 20, 20)),
            (_round(0.3, 0.1, 0.07), (20, 20, 20)),
        ),
    ),
    "dog": Shape(
        1.0,
        0.7,
        """<geom type="box" pos="-.08 0 .05" size=".3 .12 .13" rgba=".35 .22 .1 1"/>
        <geom type="box" pos=".36 0 .22" size=".14 .08 .1" rgba=".25 .15 .08 1"/>
        <geom type="box" pos="-.44 0 .15" size=".06 .03 .03" rgba=".35 .22 .1 1"/>
        <geom type="box" pos=".15 0 -.215" size=".04 .1 .135" rgba=".6 .5 .4 1"/>
        <geom type="box" pos="-.31 0 -.215" size=".04 .1 .135" rgba=".6 .5 .4 1"/>""",
        (
            (_block(-0.4, -0.15, 0.25, 0.1), (30, 60, 100)),
            (_block(0.2, -0.32, 0.5, -0.1), (25, 45, 70)),
            (_block(-0.5, -0.2, -0.38, -0.12), (30, 60, 100)),
            (_block(-0.35, 0.1, -0.25, 0.35), (110, 140, 170)),
            (_block(0.1, 0.1, 0.2, 0.35), (110, 140, 170)),
        ),
    ),
    "boat": Shape(
        3.0,
        1.2,
        """<geom type="box" pos="0 0 -.4" size="1.5 .6 .2" rgba=".9 .9 .85 1"/>
        <geom type="box" pos="-.5 0 0" size=".5 .45 .2" rgba=".2 .3 .5 1"/>
        <geom type="box" pos=".2 0 .2" size=".04 .04 .4" rgba=".3 .2 .1 1"/>""",
        (
            (((-0.5, 0.0), (0.5, 0.0), (0.4, 0.13), (-0.45, 0.13)), (220, 230, 230)),
            (_block(-0.33, -0.13, 0.0, 0.0), (130, 80, 50)),
            (_block(0.06, -0.27, 0.09, 0.0), (40, 60, 90)),
        ),
    ),
}


@dataclass(frozen=True)
class OwnShapesSettings(FolderSettings):
    """Settings: scenes as seeds, each simulated and a film, and most frames of each."""

    seeds: Count = 6
    frames: Count = 250


def _films(settings: OwnShapesSettings) -> list[tuple[Path, Path]]:
    """List the films that are taken, with their labels."""
    return films.films(settings)[::EVERY]


def jobs(settings: OwnShapesSettings) -> Sequence[int]:
    """Give the scenes' numbers; one where there is no film."""
    return range(1 if needs(settings) else min(settings.seeds, len(_films(settings))))


def one(settings: OwnShapesSettings, number: int) -> list[Row]:
    """Search for each shape in a simulation and in a film; give a row for each in which it comes into view."""
    rows = []
    film = labelled_film(*_films(settings)[number])
    for name, shape in SHAPES.items():
        target = TargetProfile(shape.length_m, "width", 160.0)
        least = tracking_settings(target).confirm_score
        for source, clip in {
            "simulated": simulated(name, shape, number, settings.frames),
            "composite": composite(film, shape, number, settings.frames),
        }.items():
            tracks = tracks_of(make_detector(target, clip.rate_hz), target, (least,), clip.frames)[least]
            score = score_tracks(tracks, clip.labels, clip.rate_hz, len(clip.frames), criterion=Criterion(iou=0.3))
            if not score.boxes:
                continue
            sides = [each.larger_side_px for boxes in clip.labels.values() for each in boxes]
            rows.append(
                {
                    "seed": number,
                    "film": film.name if source == "composite" else "",
                    "source": source,
                    "shape": name,
                    "boxes": score.boxes,
                    "found": score.found,
                    "side_px": float(np.median(sides)),
                }
            )
    return rows


def simulated(name: str, shape: Shape, seed: int, most: int) -> Clip:
    """Render a shape on a person's path; it has a label while it is wholly visible."""
    (path,) = lone_path("person", seed).values()
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder, f"{name}.xml")
        model.write_text(f"<mujoco><worldbody><body>{shape.geoms}</body></worldbody></mujoco>")
        config = field_config({name: tuple((t, x, y, shape.height_m / 2) for t, x, y, _ in path)}, seed)
        world = SimWorld(replace(config, sim=replace(config.sim, models={name: model})), rendered=WIDE)
    return rendered(world, COME_S, most)


def composite(film: LabelledFilm, shape: Shape, seed: int, most: int) -> Clip:
    """Draw a shape that crosses a film at a height far from its labels; it has a label while it is whole."""
    rng = np.random.default_rng(seed)
    side, speed = (float(np.exp(rng.uniform(*np.log(limits)))) for limits in (LENGTH_PX, SPEED))
    frames, way = film.frames[:most], rng.choice([-1, 1])
    width, height = frames[0].image.shape[1::-1]
    taken = np.array([label.center_px[1] for boxes in film.labels.values() for label in boxes])
    v = max(rng.uniform(side, height - side, HEIGHTS), key=lambda v: np.abs(taken - v).min())
    made, labels = list[Frame](), dict[int, list[Label]]()
    for index, frame in enumerate(frames):
        image, along = frame.image.copy(), side * speed * index / film.rate_hz - side / 2
        box = draw_shape(image, shape, np.array([along if way > 0 else width - 1 - along, v]), way * side)
        made.append(replace(frame, image=image))
        low, high = box.center_px - box.size_px / 2, box.center_px + box.size_px / 2
        if low[0] >= -0.5 and high[0] <= width - 0.5:
            labels[index] = [Label(box.center_px, box.size_px)]
    return Clip(made, labels, film.rate_hz)


def draw_shape(image: Image, shape: Shape, center_px: Array, length_px: float) -> Box:
    """Draw a shape into an image.

    Args:
        image: changed in place, (H, W, 3).
        shape: the shape.
        center_px: where its middle is (u, v), (2,).
        length_px: its length; negative if it looks to the left.

    Returns:
        Exact box before the lens blurs it.
    """
    scale = length_px, abs(length_px)
    return draw_polygons(image, [(center_px + np.array(polygon) * scale, colour) for polygon, colour in shape.drawn])


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give boxes and recall of each source and shape, and the range of the scenes' median larger sides [px]."""
    return {
        f"{source}: {shape}": {
            "boxes": sum(row["boxes"] for row in mine),
            "recall": sum(row["found"] for row in mine) / sum(row["boxes"] for row in mine),
            "least_px": min(row["side_px"] for row in mine),
            "largest_px": max(row["side_px"] for row in mine),
        }
        for (source, shape), mine in sorted(grouped(rows, "source", "shape").items())
    }


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the shapes that are found too seldom."""
    return [
        f"{name}: recall {figures['recall']:.3f}, not {WANTED:g} or more"
        for name, figures in summary.items()
        if not figures["recall"] >= WANTED
    ]


SETTINGS = OwnShapesSettings()
QUICK = replace(SETTINGS, seeds=1, frames=60)
COST_S = 60.0
