"""Fig. 4 of the paper: indoors, a book about 10 m away, found by its colours: before, centred, and close up.

Each seed puts the book somewhere, and after a while elsewhere (`cotarget.sim.fieldpaths.lone_path`). At either place
the zoom camera begins where pan = tilt = 0; the pipeline turns it to the book with the lens kept at its shortest, as in
the paper's Fig. 4(c), and then goes on as always, to the close-up. What each zoom view shows is judged by the
simulation's truth: the target point offset (a view without the book counts half the diagonal), the size over the one
wanted, and whether the book's marker decodes.

    python -m experiments.fig4_book [--seeds 3] [--seed-base 0] [--processes P] [--quick] [--out DIR]
"""

import dataclasses
import sys
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cotarget.calibration import Calibration
from cotarget.demo import sim_config
from cotarget.detection import make_detector
from cotarget.drawing import draw_wide, draw_zoom
from cotarget.errors import ConfigError
from cotarget.judging import observe
from cotarget.loop import FollowSettings, Step, follow
from cotarget.metrics import Row as Judged
from cotarget.safety import SafeRig
from cotarget.sim.fieldpaths import BOOK_MOVED_AT, BOOK_TAKES, lone_path
from cotarget.sim.world import SimWorld
from experiments.harness import Experiment, Row, seeds_of, table
from experiments.hold import FieldSettings, calibrated
from experiments.panels import laid_out
from experiments.pictured import Pictured

NAME = "book"
TURN_S = 1.2  # that the head is given to turn to the book, all latencies included [s]
ARRIVES_S = (0.0, BOOK_MOVED_AT[1] + BOOK_TAKES[1])  # the book is at either place from then on, at the latest [s]
LEAST_S = 0.2  # of a run, in which both cameras give several frames [s]
# So small that the lens never leaves its shortest focal length for it [px].
SPECK_PX = 1.0
STAGES = ("before", "centred", "close up")
WANTED: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "centred": {"tpo_percent": (0.0, 2.0)},
    "close up": {"tpo_percent": (0.0, 2.0), "size_ratio": (0.9, 1.1), "decoded": (0.9, 1.0)},
}


@dataclass(frozen=True)
class BookSettings(FieldSettings):
    """How many seeds, and how long head and lens are given.

    Attributes:
        seconds: from centred to close up [s].
        places: one or two of the book.

    Raises:
        ConfigError: more places, or no time to see anything.
    """

    seeds: int = 3
    seconds: float = 2.0
    places: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.places <= len(ARRIVES_S):
            raise ConfigError(f"places = {self.places}: the book is at 1 or {len(ARRIVES_S)}")
        if self.seconds < LEAST_S:
            raise ConfigError(
                f"seconds = {self.seconds:g}: at least {LEAST_S:g} are needed for a frame of both cameras"
            )


def one(calibration: Calibration, settings: BookSettings, seed: int) -> Pictured:
    """Show the book at each place; a row a place, and of the first seed its last place in pictures."""
    config = sim_config("indoor", (NAME,), seed)
    config = dataclasses.replace(config, sim=dataclasses.replace(config.sim, paths=lone_path(NAME, seed)))
    target, how = config.target(NAME), FollowSettings(command_delay_s=config.command_delay_s)
    speck = dataclasses.replace(target, wanted_px=SPECK_PX)
    world = SimWorld(config)
    truth = world.truth()
    rows: list[Row] = []
    with SafeRig(world.rig, config.safety) as rig:
        for place, arrives in enumerate(ARRIVES_S[: settings.places]):
            rig.head.move(0.0, 0.0, wait=True)
            rig.zoom.zoom(rig.zoom.focal_range[0])
            rig.clock.sleep_until(arrives)
            ends: list[Step] = []
            for wanted, seconds in ((speck, TURN_S), (target, settings.seconds)):
                detector = make_detector(target, config.rate_hz)
                run = follow(rig, calibration, wanted, detector, seconds=seconds, settings=how)
                ends += _ends(run)
            shown = dict(zip(STAGES, (ends[0], ends[1], ends[3]), strict=True))
            row = {"seed": seed, "place": place}
            for stage, step in shown.items():
                row |= {f"{stage} {key}": value for key, value in _told(observe(step, truth, NAME, target)).items()}
            rows.append(row)
    return Pictured(rows, {"fig4": _picture(shown)} if seed == settings.seed_base else {})


def _ends(steps: Iterator[Step]) -> tuple[Step, Step]:
    """The first and the last of a run; the frames between are not kept."""
    first = next(steps)
    return first, deque(steps, maxlen=1).pop()


def _told(judged: Judged) -> dict[str, Any]:
    return {
        "tpo_px": judged.tpo_px,
        "tpo_percent": 100 * judged.tpo_px / judged.width_px,
        "size_ratio": judged.size_ratio,
        "focal_px": judged.focal_px,
        "decoded": judged.decoded,
    }


def _picture(shown: Mapping[str, Step]) -> bytes:
    """As Fig. 4 of the paper: (a), (b) above (c), (d)."""
    before, centred, close = (shown[stage] for stage in STAGES)
    return laid_out(
        [
            [(draw_wide(centred), "(a) stationary camera, the book found"), (before.zoom.image, "(b) moving camera")],
            [
                (draw_zoom(centred), f"(c) turned to the book, at {centred.lens.focal_px:.0f} px"),
                (draw_zoom(close), f"(d) close-up, at {close.lens.focal_px:.0f} px"),
            ],
        ]
    )


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Of each stage medians over all places, the largest offset, and the share of markers that decode."""
    found = {}
    for stage in STAGES:
        values = {key: [row[f"{stage} {key}"] for row in rows] for key in ("tpo_px", "tpo_percent", "size_ratio")}
        found[stage] = {key: float(np.median(each)) for key, each in values.items()}
        found[stage]["worst_tpo_percent"] = max(values["tpo_percent"])
        found[stage]["focal_px"] = float(np.median([row[f"{stage} focal_px"] for row in rows]))
        found[stage]["decoded"] = float(np.mean([row[f"{stage} decoded"] for row in rows]))
    return found


def missed(summary: Mapping[str, Any]) -> list[str]:
    """The figures that are not what is wanted."""
    return [
        f"{stage}: {key}"
        for stage, wanted in WANTED.items()
        for key, (low, high) in wanted.items()
        if not low <= summary[stage][key] <= high
    ]


def describe(settings: BookSettings, summary: Mapping[str, Any]) -> str:
    """A line a stage."""
    head = ("zoom view", "offset, px", "% of width", "worst, %", "size / wanted", "focal length, px", "decoded")
    keys = ("tpo_px", "tpo_percent", "worst_tpo_percent", "size_ratio", "focal_px", "decoded")
    lines = [[stage, *(float(found[key]) for key in keys)] for stage, found in summary.items()]
    return f"a book at 10 m, {settings.places} places a seed, medians of {seeds_of(settings)}\n" + table(head, lines)


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Offset from the middle of the zoom view and size over the one wanted; each place is a line."""
    axes = figure.subplots(1, 2)
    for ax, key, label in zip(
        axes, ("tpo_percent", "size_ratio"), ("offset [% of the width]", "size / wanted size"), strict=True
    ):
        for row in rows:
            ax.semilogy(STAGES, [row[f"{stage} {key}"] for stage in STAGES], "o-", alpha=0.5)
        ax.set(ylabel=label)


SETTINGS = BookSettings()
EXPERIMENT = Experiment(
    "fig4_book",
    "Fig. 4: a book about 10 m away, found by its colours: before, centred, close up.",
    SETTINGS,
    dataclasses.replace(SETTINGS, seeds=1, places=1, calibrated=False),
    one,
    summarise,
    describe,
    plot,
    missed,
    prepare=calibrated,
    cost_s=20.0,
)

if __name__ == "__main__":
    sys.exit(EXPERIMENT.main())
