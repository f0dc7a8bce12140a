"""A single pan-tilt-zoom camera that has to find and follow its target by itself, against the pair: time on target.

The field of `experiments.hold_scenes` without its clutter: the same unit, lens, delays, ways and sizes, the rig known
exactly. Nothing is rendered: detections are the truth with a detector's noise (`cotarget.oracle`), for the pair in its
wide camera, for the lone camera (`experiments.lone_camera`) in its own view. The pair goes by its wide view alone. What
a lone camera's detector misses while the picture moves, because head or lens do, is what its users fight with; three
cases: 5 %, as of a camera that stands, a half, and nine of ten.

Both are judged by the truth, and the clock starts when the target is wholly in the wide view, after the first 2 s.
What a lone camera costs besides is the view of all else: `watched` is how much of the wide camera's field its own view
is as large as, where the pair always sees all of it.

    python -m experiments.single_ptz [--seeds 10] [--seed-base 0] [--processes P] [--quick] [--out DIR]
"""

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cotarget.config import RigConfig, TargetConfig
from cotarget.detection import Detection
from cotarget.judging import closeup_of
from cotarget.loop import FollowSettings, follow
from cotarget.metrics import Row as Judged
from cotarget.metrics import score
from cotarget.metrics.closeup import WHOLLY_VISIBLE
from cotarget.oracle import TruthDetector, TruthNoise, counted, true_calibration
from cotarget.rig import Frame, Image
from cotarget.safety import SafeRig
from cotarget.sim.fieldpaths import LONE, SECONDS
from cotarget.sim.outlines import Outlines
from cotarget.sim.truth import Truth
from cotarget.sim.world import SimWorld
from cotarget.simconfig import SimConfig
from experiments.harness import Experiment, Row, Settings, seeds_of, table
from experiments.hold_scenes import hold_config
from experiments.lone_camera import LoneCamera, scan_of
from experiments.mounted import check_above

NOISE = TruthNoise()
PAIR = "pair"
WIDE_PX = SimConfig().fixed.focal_px[0]
MOVED_PX, MOVED_S = 1.0, 0.02  # the picture moves that shifts so far within so long before and after its exposure
STREAM = 25  # of random numbers
FIGURES = ("closeup_yield", "in_frame_ratio", "in_frame_of_all", "time_to_acquire_s", "tpo_width_median", "watched")


@dataclass(frozen=True)
class SingleSettings(Settings):
    """How many runs, of what.

    Attributes:
        seconds: of each run [s].
        targets: book, person, bird.
        misses: parts of the frames in which the lone camera's detector misses the target while the picture moves.
    """

    seeds: int = 10
    seconds: float = SECONDS
    targets: tuple[str, ...] = LONE
    misses: tuple[float, ...] = (0.05, 0.5, 0.9)

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        super().__post_init__()
        check_above(0, self, "seconds")


def one(_: None, settings: SingleSettings, seed: int) -> list[Row]:
    """Each target held by the pair and by the lone camera; a row each."""
    rows: list[Row] = []
    for name in settings.targets:
        pair = figures(by_pair(name, seed, settings.seconds)) | {"watched": 1.0}
        rows.append({"seed": seed, "target": name, "way": PAIR} | pair)
        for miss in settings.misses:
            judged = by_lone(name, seed, settings.seconds, miss)
            rows.append({"seed": seed, "target": name, "way": lone(miss)} | figures(judged))
    return rows


def lone(miss: float) -> str:
    """What a lone camera is called whose detector misses so often while the picture moves."""
    return f"lone, misses {100 * miss:g} %"


def config_of(name: str, seed: int) -> RigConfig:
    """The field without clutter, which detections from the truth do not see."""
    config = hold_config(name, seed)
    return replace(config, sim=replace(config.sim, effects=replace(config.sim.effects, clutter=False)))


def figures(judged: Sequence[Judged]) -> Row:
    """Of one run; one that never acquired its target has no time for that."""
    found = score(judged)
    return {
        "closeup_yield": found.closeup_yield,
        "in_frame_ratio": found.in_frame_ratio if found.in_frame_ratio is not None else 0.0,
        "in_frame_of_all": _in_frame(judged, found.frames),
        "time_to_acquire_s": found.time_to_acquire_s,
        "tpo_width_median": found.tpo_width_median,
        "watched": float(np.mean([min(1.0, (WIDE_PX / row.focal_px) ** 2) for row in judged])),
    }


def _in_frame(judged: Sequence[Judged], counted_frames: int) -> float:
    """In frame over all frames that the yield counts, acquisition included."""
    return float(np.mean([row.in_frame for row in judged[-counted_frames:]])) if counted_frames else math.nan


def by_pair(name: str, seed: int, seconds: float) -> list[Judged]:
    """Both cameras, by the project's own pipeline."""
    world = SimWorld(config_of(name, seed), rendered=())
    truth, target = world.truth(), world.config.target(name)
    outlines = Outlines(truth, still=True)
    detector = TruthDetector(outlines, seed, NOISE, numbers=counted)
    settings = FollowSettings(command_delay_s=world.config.command_delay_s, closed_loop=False)
    rows: list[Judged] = []
    with SafeRig(world.rig, world.config.safety) as rig:
        for step in follow(rig, true_calibration(world), target, detector, seconds=seconds, settings=settings):
            if not rows or step.zoom.t > rows[-1].t_s:
                rows.append(judge(outlines, name, target, step.zoom.t))
    return rows


def by_lone(name: str, seed: int, seconds: float, miss: float) -> list[Judged]:
    """The zoom camera alone."""
    world = SimWorld(config_of(name, seed), rendered=())
    truth, target = world.truth(), world.config.target(name)
    outlines, calibration = Outlines(truth, still=True), true_calibration(world)
    detector = Shaken(outlines, truth, seed, miss)
    rows: list[Judged] = []
    with SafeRig(world.rig, world.config.safety) as rig:
        delay_s, field = world.config.command_delay_s, scan_of(rig, calibration)
        camera = LoneCamera(rig, truth, calibration, target, detector, delay_s, NOISE.center_px, field)
        for frame in camera.run(seconds):
            rows.append(judge(outlines, name, target, frame.t))
    return rows


class Shaken:
    """The zoom camera's detector, which misses more while the picture moves."""

    mask: Image | None = None

    def __init__(self, outlines: Outlines, truth: Truth, seed: int, miss: float) -> None:
        """Begin.

        Args:
            outlines: of the world.
            truth: of its head and lens.
            seed: of the noise.
            miss: part of the frames in which it finds nothing while the picture moves.
        """
        self._still = TruthDetector(outlines, seed, NOISE, numbers=counted, camera="zoom")
        self._moving = TruthDetector(outlines, seed, replace(NOISE, miss=miss), numbers=counted, camera="zoom")
        self._truth = truth

    def detect(self, frame: Frame) -> list[Detection]:
        """Find the target."""
        return (self._moving if self.moves(frame.t) else self._still).detect(frame)

    def moves(self, t: float) -> bool:
        """Whether head or lens shift the picture at a time."""
        width = self._truth.lens("zoom", t).size[0]
        before, after = max(t - MOVED_S, 0.0), t + MOVED_S
        focal_px = self._truth.lens("zoom", t).focal_px[0]
        turned = np.subtract(self._truth.head_at(after), self._truth.head_at(before))
        grown = abs(self._truth.nominal_at(after) / self._truth.nominal_at(before) - 1)
        return bool(focal_px * np.abs(turned).max() > MOVED_PX or width / 2 * grown > MOVED_PX)


def judge(outlines: Outlines, name: str, target: TargetConfig, t: float) -> Judged:
    """What a zoom frame truly shows, as a row to be scored; what is said of commands and tracks is left out."""
    closeup = closeup_of(outlines, name, target, t)
    wide = outlines.silhouette(name, "fixed", t)
    lens = outlines.lens("zoom", t)
    return Judged(
        t_s=t,
        t_fixed_s=t,
        state="",
        track=-1,
        u_px=closeup.u_px,
        v_px=closeup.v_px,
        width_px=closeup.width_px,
        height_px=closeup.height_px,
        size_px=closeup.size_px,
        wanted_px=closeup.wanted_px,
        visible=closeup.visible,
        in_wide=wide is not None and wide.visible >= WHOLLY_VISIBLE,
        u_wide_px=math.nan,
        v_wide_px=math.nan,
        u_detected_px=math.nan,
        v_detected_px=math.nan,
        decoded=False,
        decoded_wide=False,
        off_target="",
        range_m=math.nan,
        depth_m=math.nan,
        pan_commanded_deg=0.0,
        tilt_commanded_deg=0.0,
        focal_commanded_px=0.0,
        pan_deg=0.0,
        tilt_deg=0.0,
        focal_px=lens.focal_px[0],
    )


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """Of each target and way the means over the seeds, with the scatter of the mean, and the median time to acquire."""
    summary: dict[str, dict[str, dict[str, float]]] = {}
    for name, way in dict.fromkeys((row["target"], row["way"]) for row in rows):
        mine = [row for row in rows if (row["target"], row["way"]) == (name, way)]
        found = {key: _mean(_floats(mine, key)) for key in FIGURES if key != "time_to_acquire_s"}
        yields = _floats(mine, "closeup_yield")
        times = [math.inf if row["time_to_acquire_s"] is None else row["time_to_acquire_s"] for row in mine]
        scatter = float(np.nanstd(yields, ddof=1) / np.sqrt(len(yields))) if len(yields) > 1 else math.nan
        found |= {"closeup_yield_error": scatter, "time_to_acquire_s": float(np.median(times))}
        summary.setdefault(name, {})[way] = found | {"never_acquired": float(np.mean(np.isinf(times)))}
    return summary


def _mean(values: Sequence[float]) -> float:
    """Of those there are."""
    there = [value for value in values if math.isfinite(value)]
    return float(np.mean(there)) if there else math.nan


def _floats(rows: Sequence[Row], key: str) -> list[float]:
    return [math.nan if row[key] is None else float(row[key]) for row in rows]


def bounded(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Every close-up yield."""
    return {name: {way: v["closeup_yield"] for way, v in ways.items()} for name, ways in summary.items()}


def describe(settings: SingleSettings, summary: Mapping[str, Any]) -> str:
    """A line for each target and way."""
    head = ("", "close-up yield", "+-", "in frame", "of all", "to acquire [s]", "offset / width", "watched")
    keys = ("closeup_yield", "closeup_yield_error", "in_frame_ratio", "in_frame_of_all", "time_to_acquire_s")
    lines = [
        [f"{name}, {way}", *(f"{found[key]:.2f}" for key in keys), found["tpo_width_median"], found["watched"]]
        for name, ways in summary.items()
        for way, found in ways.items()
    ]
    return f"pair and lone camera, {settings.seconds:g} s, means over {seeds_of(settings)}\n" + table(head, lines)


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Close-up yield and in-frame ratio of each way, seeds as points, the mean with its scatter as bars."""
    targets = list(dict.fromkeys(row["target"] for row in rows))
    ways = list(dict.fromkeys(row["way"] for row in rows))
    figure.set_size_inches(11, 4.8)
    labels = (("closeup_yield", "close-up yield"), ("in_frame_of_all", "in frame, of all frames"))
    axes = figure.subplots(1, 2, sharey=True)
    for ax, (key, label) in zip(axes, labels, strict=True):
        for i, way in enumerate(ways):
            values = [_floats([r for r in rows if (r["target"], r["way"]) == (name, way)], key) for name in targets]
            x = np.arange(len(targets)) + (i - (len(ways) - 1) / 2) * 0.8 / len(ways)
            errors = [np.std(v, ddof=1) / np.sqrt(len(v)) if len(v) > 1 else 0.0 for v in values]
            ax.bar(x, [np.mean(v) for v in values], 0.75 / len(ways), yerr=errors, capsize=3, alpha=0.6, label=way)
            for at, each in zip(x, values, strict=True):
                ax.plot([at] * len(each), each, ".", ms=3, color="k")
        ax.set(ylabel=label, ylim=(0, 1.02))
        ax.set_xticks(range(len(targets)), targets)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(ways), frameon=False)


SETTINGS = SingleSettings()
EXPERIMENT = Experiment(
    "single_ptz",
    "A single pan-tilt-zoom camera that finds and follows its target by itself, against the pair.",
    SETTINGS,
    replace(SETTINGS, seeds=1, seconds=8.0, targets=("person", "bird"), misses=(0.05, 0.9)),
    one,
    summarise,
    describe,
    plot,
    cost_s=25.0,
    bounded=bounded,
)

if __name__ == "__main__":
    sys.exit(EXPERIMENT.main())
