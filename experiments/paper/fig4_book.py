"""Fig. 4 of the paper: indoors, a book about 10 m away, found by its colours: before, centred, and in close-up.

Each seed puts the book at one place, and later at another (`cotarget.sim.targets.random_paths.lone_path`). At each
place the zoom camera starts at pan = tilt = 0. It is pointed at the book with the lens at its shortest focal length, as
in the paper's Fig. 4(c), and then zooms in. This project's pipeline and the paper's method
(`experiments.paper.paper_loop`) use the same calibration. Ground truth judges each zoom view: target point offset (a
view without the book counts half the diagonal), size over the wanted size, and whether the book's marker decodes.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le

from cotarget.calibration import Calibration
from cotarget.detection import make_detector
from cotarget.drawing import draw_wide, draw_zoom
from cotarget.evaluation import observe
from cotarget.metrics import Row as Judged
from cotarget.pipeline import FollowSettings, Step
from cotarget.safety.safe_rig import guard
from cotarget.sim.targets.random_paths import BOOK_MOVED_AT, BOOK_TAKES, lone_path
from cotarget.sim.world import SimWorld
from experiments.engine import Count, Pictured, Row
from experiments.following.field import OwnRigInField, calibrated
from experiments.paper.paper_loop import OURS, WAYS, Task, laid_out, picture_name
from experiments.tables import grouped, outside, spread

NAME = "book"
TURN_S = 1.2  # time for the head to turn to the book, with all latencies [s]
ARRIVES_S = (0.0, BOOK_MOVED_AT[1] + BOOK_TAKES[1])  # latest time from which the book is at each place [s]
LEAST_S = 0.2  # shortest run, in which both cameras give several frames [s]
# So small that the lens stays at its shortest focal length [px].
SPECK_PX = 1.0
KEYS = ("tpo_px", "tpo_percent", "size_ratio", "focal_px")  # figures of each stage
STAGES = ("before", "centred", "close up")
WANTED: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "centred": {"tpo_percent": (0.0, 2.0)},
    "close up": {"tpo_percent": (0.0, 2.0), "size_ratio": (0.9, 1.1), "decoded": (0.9, 1.0)},
}


@dataclass(frozen=True)
class BookSettings(OwnRigInField):
    """Settings: time for head and lens, and places."""

    seeds: Count = 2
    # Time from centred to close-up; the book leaves its first place when it is moved [s].
    seconds: Annotated[float, Ge(LEAST_S), Le(BOOK_MOVED_AT[0] - TURN_S)] = 2.0
    places: Annotated[int, Ge(1), Le(len(ARRIVES_S))] = 2  # number of places of the book, one or two


def one(settings: BookSettings, seed: int) -> Pictured:
    """Show the book at each place by each method; give a row per run, and pictures of the first seed's last place."""
    rows: list[Row] = []
    pictures: dict[str, bytes] = {}
    for way in WAYS:
        mine, shown = _shown(calibrated(settings), settings, seed, way)
        rows += mine
        if seed == settings.seed_base:
            pictures[picture_name("fig4", way)] = _picture(shown)
    return Pictured(rows, pictures)


def _shown(
    calibration: Calibration, settings: BookSettings, seed: int, way: str
) -> tuple[list[Row], Mapping[str, Step]]:
    """Give a row per place, and the Steps of the last place by stage."""
    config = settings.config("indoor", (NAME,), seed)
    config = dataclasses.replace(config, sim=dataclasses.replace(config.sim, paths=lone_path(NAME, seed)))
    target, how = config.target(NAME), FollowSettings()
    speck = dataclasses.replace(target, wanted_px=SPECK_PX)
    world = SimWorld(config)
    truth = world.truth()
    rows: list[Row] = []
    shown: dict[str, Step] = {}
    with guard(world.rig, config.safety) as rig:
        for place, arrives in enumerate(ARRIVES_S[: settings.places]):
            rig.head.move(0.0, 0.0, wait=True)
            rig.zoom.zoom(rig.zoom.focal_range[0])
            rig.clock.sleep_until(arrives)
            ends: list[Step] = []
            for wanted, seconds in ((speck, TURN_S), (target, settings.seconds)):
                detector = make_detector(target, config.sim.fixed.rate_hz)
                ends += first_and_last(WAYS[way](Task(rig, calibration, wanted, detector, seconds, how)))
            shown = dict(zip(STAGES, (ends[0], ends[1], ends[3]), strict=True))
            row = {"seed": seed, "place": place, "way": way}
            for stage, step in shown.items():
                row |= {f"{stage} {key}": value for key, value in _told(observe(step, truth, NAME, target)).items()}
            rows.append(row)
    return rows, shown


def first_and_last(steps: Iterator[Step]) -> tuple[Step, Step]:
    """Give the first Step in which the book is found, before the head has turned, and the last Step."""
    first = last = next(steps)
    for last in steps:
        if first.target is None and last.target is not None:
            first = last
    return first, last


def _told(judged: Judged) -> dict[str, Any]:
    seen = judged.closeup
    return {
        "tpo_px": seen.tpo_px,
        "tpo_percent": 100 * seen.tpo_px / seen.width_px,
        "size_ratio": seen.size_ratio,
        "focal_px": judged.focal_px,
        "decoded": judged.decoded,
    }


def _picture(shown: Mapping[str, Step]) -> bytes:
    """Arrange pictures as in Fig. 4 of the paper: (a), (b) above (c), (d)."""
    before, centred, close = (shown[stage] for stage in STAGES)
    return laid_out(
        [
            [(draw_wide(before), "(a) stationary camera, before"), (before.zoom.image, "(b) moving camera, before")],
            [
                (draw_zoom(centred), f"(c) turned to the book, at {centred.lens.focal_px:.0f} px"),
                (draw_zoom(close), f"(d) close-up, at {close.lens.focal_px:.0f} px"),
            ],
        ]
    )


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, Any]]]:
    """Give median, least and largest over all places by method and stage, and the fraction of decoded markers."""
    return {
        way: {
            stage: {key: spread(row[f"{stage} {key}"] for row in mine) for key in KEYS}
            | {"decoded": float(np.mean([row[f"{stage} decoded"] for row in mine]))}
            for stage in STAGES
        }
        for way, mine in grouped(rows, "way").items()
    }


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List this project's figures that miss their goal."""
    return [text for stage, wanted in WANTED.items() for text in outside(summary[OURS][stage], wanted, stage)]


SETTINGS = BookSettings()
QUICK = dataclasses.replace(SETTINGS, seeds=1, places=1, calibrated=False)
COST_S = 40.0
