"""Fig. 6 of the paper: outdoors, several persons, the first followed until it disappears, then the next.

Three persons cross the fixed view from either side; each enters before the one before has left, while foliage sways,
clouds drift and shadows cross the ground. This project detects them by `motion`; `--set fig6_outdoors.detector=mog2`
takes the plain mixture. The paper's method, the plain mixture and one open-loop command at a time
(`experiments.paper.paper_loop`), uses the same calibration. The policy is the paper's, first-come.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt

from cotarget.config import DetectorName, RigConfig, TargetProfile, Waypoint
from cotarget.detection import make_detector
from cotarget.drawing import draw_wide, draw_zoom
from cotarget.evaluation import closeup_of, on_target
from cotarget.metrics import Closeup
from cotarget.pipeline import FollowSettings, Step
from cotarget.sim.targets.person import PERSON_HEIGHT
from cotarget.sim.targets.target import true_size
from cotarget.sim.truth import Truth
from cotarget.sim.world import SimWorld
from experiments.engine import Count, Pictured, Row
from experiments.following.field import OwnRigInField, calibrated, watched_in
from experiments.paper.paper_loop import OURS, WAYS, laid_out, picture_name
from experiments.tables import spreads

KIND = "person"
NAMES = (KIND, f"{KIND}2", f"{KIND}3")
# Time at which the first enters, interval to each next one, and its variation [s].
ENTERS_S, LATER_S, EARLIER_S = 2.0, 2.8, 0.3
NEAREST_M, APART_M, EDGE = 9.6, 0.7, 0.52  # depth of the paths, spacing [m]; edge of the view over the depth
SPEED = (1.6, 2.0)  # [m/s]
KNOT_S = 0.5  # knot spacing of the paths; both ends are far enough outside the view
STREAM = 11  # random stream, separate from the world's
CLOSE_S = 1.0  # a target is shown this long after its acquisition [s]
MOMENTS = 3  # moments in the picture: the first target in close-up, as it leaves, and the next one in close-up
PRESENT = 0.5  # least visible fraction of a present target's outline in the fixed view
FIGURES = {  # figures of a run, with descriptions
    "followed": "targets followed for a second or more, of three",
    "tpe_px": "detection's error in the fixed view, px",
    "tpo_px": "target point offset in the close-up, px",
    "tpo_percent": "target point offset in the close-up, % of width",
    "size_ratio": "size / wanted size",
    "in_frame": "in frame, while somebody is followed",
    "handover_s": "from one's leaving to the next in frame, s",
    "too_early": "handovers while the one before is still there",
    "off_target_s": "followed is a track on nobody, s",
}
# Goals for the median over the seeds. For early handovers the largest counts: where two persons cross, a track may
# switch from one to the other, once a run.
WANTED: Mapping[str, tuple[str, float, float]] = {
    "followed": ("median", 2.0, 3.0),
    "tpo_percent": ("median", 0.0, 4.0),
    "size_ratio": ("median", 0.85, 1.15),
    "in_frame": ("median", 0.8, 1.0),
    "handover_s": ("median", 0.0, 1.5),
    "too_early": ("largest", 0.0, 1.0),
}
FOLLOWED_S = 1.0  # a target counts if it was followed for this long [s]


@dataclass(frozen=True)
class OutdoorSettings(OwnRigInField):
    """Settings: length of the runs, and detection."""

    seeds: Count = 2
    seconds: Annotated[float, Gt(ENTERS_S)] = 12.0  # length of a run; the paths end outside the view [s]
    detector: DetectorName = "motion"  # detector of this project's pipeline, motion or mog2
    ways: tuple[str, ...] = tuple(WAYS)  # methods of following, by name


@dataclass(frozen=True)
class Moment:
    """Ground truth of one Step."""

    t: float  # time of the zoom frame [s]
    followed: str | None  # target of the followed track; None where the track is on no target, or there is no track
    is_following: bool  # whether a track is followed
    present: frozenset[str]  # targets of which at least half is in the fixed view
    # Error of the followed target's detection in the fixed view; nan where it is not detected alone [px].
    tpe_px: float = math.nan
    closeup: Closeup | None = None  # the followed target in the zoom view


def figures(moments: Sequence[Moment]) -> dict[str, float | int | None]:
    """Compute the figures of a run; None where there is nothing to measure."""
    t = np.array([each.t for each in moments])
    took = np.diff(t, append=t[-1])
    names = [each.followed for each in moments]
    seconds = {name: float(sum(d for d, each in zip(took, names, strict=True) if each == name)) for name in set(names)}
    closeups = [each.closeup for each in moments if each.closeup is not None]
    # Where the followed track is on no target, no target is in frame.
    in_frame = [each.closeup is not None and each.closeup.in_frame for each in moments if each.is_following]
    handovers = [(old, new) for old, new in turns(names) if old is not None]
    gaps = [gap for old, new in handovers if (gap := _gap(moments, names, old, new)) is not None]
    lost = sum(d for d, each in zip(took, moments, strict=True) if each.is_following and each.followed is None)
    return {
        "followed": sum(seconds[name] >= FOLLOWED_S for name in seconds if name is not None),
        "tpe_px": _median(each.tpe_px for each in moments),
        "tpo_px": _median(each.tpo_px for each in closeups),
        "tpo_percent": _median(100 * each.tpo_px / each.width_px for each in closeups),
        "size_ratio": _median(each.size_ratio for each in closeups),
        "in_frame": float(np.mean(in_frame)) if in_frame else None,
        "handover_s": _median(gaps),
        "too_early": sum(names[old] in moments[new].present for old, new in handovers),
        "off_target_s": float(lost),
    }


def turns(names: Sequence[str | None]) -> list[tuple[int | None, int]]:
    """Find the handovers: last moment of the earlier target, and first moment of the next."""
    found: list[tuple[int | None, int]] = []
    last: int | None = None
    for i, name in enumerate(names):
        if name is None:
            continue
        if last is None or names[last] != name:
            found.append((last, i))
        last = i
    return found


def _gap(moments: Sequence[Moment], names: Sequence[str | None], old: int, new: int) -> float | None:
    """Give the time from the first target's leaving the fixed view to the second's being in frame [s].

    None if either is missing.
    """
    name = names[old]
    there = [i for i, each in enumerate(moments[:new]) if name in each.present]
    came = next(
        (i for i in range(new, len(moments)) if names[i] == names[new] and (c := moments[i].closeup) and c.in_frame),
        None,
    )
    return None if came is None or not there else max(0.0, moments[came].t - moments[there[-1]].t)


def _median(values: Any) -> float | None:
    finite = [value for value in values if math.isfinite(value)]
    return float(np.median(finite)) if finite else None


def one(settings: OutdoorSettings, seed: int) -> Pictured:
    """Follow the persons by each method; give a row per method, and pictures of the first seed."""
    config = outdoors(settings, seed)
    how = FollowSettings()  # its policy is first-come
    rows: list[Row] = []
    pictures: dict[str, bytes] = {}
    for way in settings.ways:
        watch, found_by = Watch(), settings.detector if way == OURS else "mog2"
        target = dataclasses.replace(config.target(KIND), detector=found_by)
        detector, world = make_detector(target, config.sim.fixed.rate_hz), SimWorld(config)
        for step, truth in watched_in(world, detector, calibrated(settings), target, settings.seconds, how, WAYS[way]):
            watch.see(step, truth, target)
        rows.append({"seed": seed, "way": way, "detector": found_by, **figures(watch.moments)})
        if seed == settings.seed_base and watch.shown:
            pictures[picture_name("fig6", way)] = _picture(watch.shown)
    return Pictured(rows, pictures)


def outdoors(settings: OutdoorSettings, seed: int) -> RigConfig:
    """Configure the rig outdoors with all motion switched on."""
    rng = np.random.default_rng((seed, STREAM))
    rows = rng.permutation(len(NAMES))
    paths = {name: _crossing(rng, i, NEAREST_M + APART_M * rows[i], name, seed) for i, name in enumerate(NAMES)}
    config = settings.config("outdoor", NAMES, seed)
    effects = dataclasses.replace(config.sim.effects, clutter=True)
    return dataclasses.replace(config, sim=dataclasses.replace(config.sim, paths=paths, effects=effects))


def _crossing(rng: np.random.Generator, number: int, away: float, name: str, seed: int) -> tuple[Waypoint, ...]:
    """Make a straight path across the view at a distance [m]; successive persons start from alternate sides."""
    side, speed = (1.0 if number % 2 else -1.0), rng.uniform(*SPEED)
    enters = ENTERS_S + LATER_S * number + rng.uniform(0.0, EARLIER_S)
    half, z = EDGE * away, PERSON_HEIGHT / 2 * true_size(name, seed)
    t = np.arange(enters - 2.0, enters + 2 * half / speed + 2.0, KNOT_S)
    return tuple((float(each), float(side * (half - speed * (each - enters))), away, z) for each in t)


@dataclass
class Watch:
    """Judges the Steps of a run, and keeps those to show."""

    moments: list[Moment] = field(default_factory=list)  # the judged moments
    shown: list[tuple[Step, str]] = field(default_factory=list)  # Steps with captions
    names: dict[int, str] = field(default_factory=dict)  # targets of the tracks, while they are on one target only
    _last: tuple[Step, str] | None = None
    _since: float = 0.0

    def see(self, step: Step, truth: Truth, target: TargetProfile) -> None:
        """Process a Step."""
        t, t_zoom = step.fixed.t, step.zoom.t
        outlines = {name: truth.silhouette(name, "fixed", t) for name in truth.targets}
        present = frozenset(name for name, each in outlines.items() if each is not None and each.visible >= PRESENT)
        name, tpe_px, closeup = None, math.nan, None
        if step.target is not None:
            self.assign(step.target.id, [each for _, each in on_target([step.target], outlines)])
            name = self.names.get(step.target.id)
        if step.target is not None and name is not None:
            closeup = closeup_of(truth, name, target, t_zoom)
            if not step.target.missed and not step.target.shared:
                away = truth.pixel("fixed", truth.center(name, t), t) - step.target.box.center_px
                tpe_px = float(np.linalg.norm(away))
        self.moments.append(Moment(t_zoom, name, step.target is not None, present, tpe_px, closeup))
        self._choose(step, name)

    def assign(self, track: int, on: Sequence[str]) -> None:
        """Assign a target to a track: the earlier one while the track is on it, else the nearest that it is on."""
        if on and self.names.get(track) not in on:
            self.names[track] = on[0]

    def _choose(self, step: Step, name: str | None) -> None:
        """Keep a Step of each target in close-up, and the last one before it leaves."""
        before = None if self._last is None else self._last[1]
        if name is not None and name != before:
            self._leave()
            self._since = step.t
        due = self._since + CLOSE_S
        if name is not None and name == before and self._last is not None and self._last[0].t < due <= step.t:
            self.shown.append((step, f"target {self._number(name)}, after {CLOSE_S:g} s"))
        if name is not None:
            self._last = step, name

    def _leave(self) -> None:
        if self._last is not None:
            step, name = self._last
            self.shown.append((step, f"target {self._number(name)} leaves"))

    def _number(self, name: str) -> int:
        return list(dict.fromkeys(each.followed for each in self.moments if each.followed)).index(name) + 1


def _picture(shown: Sequence[tuple[Step, str]]) -> bytes:
    """Arrange pictures as in Fig. 6 of the paper, a moment per row: (a) foreground, (b) fixed camera, (c) close-up."""
    rows = []
    for step, words in shown[:MOMENTS]:
        mask = np.zeros(step.fixed.image.shape[:2], np.uint8) if step.mask is None else step.mask
        rows.append(
            [
                (mask, f"(a) foreground, t = {step.fixed.t:.1f} s"),
                (draw_wide(step), f"(b) stationary camera: {words}"),
                (draw_zoom(step), f"(c) moving camera, at {step.lens.focal_px:.0f} px"),
            ]
        )
    return laid_out(rows)


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """Give median, least and largest of each method's figures over the seeds, from the runs that have them."""
    return spreads(rows, "way", FIGURES)


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List this project's figures that miss their goal."""
    mine = summary.get(OURS, {})
    return [
        f"{key}: {mine[key][which]:.3g}, not {low:g} to {high:g}"
        for key, (which, low, high) in WANTED.items()
        if mine and not low <= mine[key][which] <= high
    ]


SETTINGS = OutdoorSettings()
QUICK = dataclasses.replace(SETTINGS, seeds=1, seconds=9.0, calibrated=False, ways=(OURS,))
COST_S = 80.0
