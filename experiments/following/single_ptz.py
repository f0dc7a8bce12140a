"""Single pan-tilt-zoom camera that finds and follows its target by itself, against the pair.

The scene is the field of `experiments.following.field` without clutter: the same head, lens, delays, paths and
sizes, and a rig known exactly. Nothing is rendered. Detections are ground truth with a detector's noise
(`cotarget.evaluation`): in the fixed camera for the pair, in its own view for the single camera
(`experiments.following.lone_camera`). Both use the same tracker with the settings of a detector by appearance, because
the single camera has no static background. The pair finds the target in its zoom view besides. While head or lens move,
the zoom camera misses more detections: 5 %, as at rest, 50 % or 90 %, for the pair's zoom view too.

Ground truth judges both. The clock starts when the target is wholly in the fixed view, after the first 2 s. Until then
neither searches: the head points in a random direction of the fixed view, at the shortest focal length, so that the
target has to be found. The single camera also loses the overview: `watched` is the area of its view over that of the
fixed camera's, which is 1 for the pair.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt, Interval, Le
from matplotlib.figure import Figure

from cotarget.calibration import Calibration
from cotarget.config import RigConfig, SimConfig, TargetProfile
from cotarget.detection import Detections
from cotarget.estimation.measurement_model import Pose
from cotarget.estimation.motion_model import GATE
from cotarget.estimation.zoom_matching import CloseupFinder, ZoomMeasurement
from cotarget.evaluation import TruthDetector, TruthNoise, closeup_of, counted, true_calibration
from cotarget.geometry import Array
from cotarget.metrics import BACKGROUND_S, ROUNDING_S, WHOLLY_VISIBLE, score
from cotarget.metrics import Row as Judged
from cotarget.pantilt import towards
from cotarget.pipeline import FollowSettings, follow
from cotarget.rig import Detection, Frame, Image, Rig
from cotarget.safety.safe_rig import guard
from cotarget.sim.targets.random_paths import LONE, SECONDS
from cotarget.sim.truth import Appearances, Outlines, Truth
from cotarget.sim.world import SimWorld
from experiments.engine import Count, Row, Settings
from experiments.following.field import hold_config
from experiments.following.lone_camera import LoneCamera, scan_of
from experiments.tables import grouped, mean_of

WIDE_PX = SimConfig().fixed.focal_px[0]
LEAST_MISS = 0.05
HELD = 0.85  # least in-frame ratio of both if hardly anything is missed
FIGURES = ("closeup_yield", "centred_yield", "in_frame_ratio", "in_frame_of_all", "tpo_width_median", "watched")
WAYS = PAIR, LONE_CAMERA = "pair", "lone"
FAR = 1000.0  # distance at which the offset of the cameras is negligible [m]
STREAM = 25  # random stream
NOISE = TruthNoise()
APART = 1 << 32  # offset of the seed from the detectors' own
FINDER_SEED = 1 << 33  # offset of the seed of what finds the target in the zoom image
MOVED_PX, MOVED_S = 1.0, 0.02  # least shift of a moving image, within this time before and after its exposure


@dataclass(frozen=True)
class SingleSettings(Settings):
    """Settings: runs and detection losses."""

    seeds: Count = 6
    seconds: Annotated[float, Gt(BACKGROUND_S), Le(SECONDS)] = SECONDS  # length of each run [s]
    targets: tuple[str, ...] = LONE  # book, person or bird
    # Fractions of zoom frames in which the target is missed while the image moves.
    misses: tuple[Annotated[float, Interval(ge=0, le=1)], ...] = (0.05, 0.5, 0.9)


def one(settings: SingleSettings, seed: int) -> list[Row]:
    """Run each target with the pair and with the single camera; give a row per run."""
    rows: list[Row] = []
    for name in settings.targets:
        for way in WAYS:
            for miss in settings.misses:
                judged = held(way, name, seed, settings.seconds, miss)
                rows.append({"seed": seed, "target": name, "way": case(way, miss)} | figures(judged, way))
    return rows


def case(way: str, miss: float) -> str:
    """Name a way with a fraction of missed zoom frames while the image moves."""
    return f"{way}, misses {100 * miss:g} %"


def figures(judged: Sequence[Judged], way: str) -> Row:
    """Compute the figures of one run; None for what never occurred, such as an acquisition."""
    found = score(judged)
    since = judged[-found.frames :] if found.frames else []
    return {
        "closeup_yield": found.closeup_yield,
        "centred_yield": found.centred_yield,
        "in_frame_ratio": found.in_frame_ratio if found.in_frame_ratio is not None else 0.0,
        "in_frame_of_all": float(np.mean([row.closeup.in_frame for row in since])) if since else None,
        "time_to_acquire_s": found.time_to_acquire_s,
        "tpo_width_median": found.tpo_width_median,
        "watched": _watched(since, way),
    }


def _watched(since: Sequence[Judged], way: str) -> float | None:
    """Compute the mean area of the view over the fixed camera's; None without frames."""
    if way == PAIR:
        return 1.0
    return float(np.mean([min(1.0, (WIDE_PX / row.focal_px) ** 2) for row in since])) if since else None


# Runs


class TruthFinder:
    """Find a target in the zoom image by ground truth with noise, for `FollowSettings.finder`.

    Like the real finder it gives the body's centre, if that is where it is expected. Occlusion is not considered.
    """

    SIGMA_PX = 1.0  # of the noise; the real finder assumes as much for lens, head and frame times

    def __init__(
        self,
        calibration: Calibration,
        target: TargetProfile,
        truth: Appearances,
        name: str,
        seed: int,
        missed: Callable[[float], bool] = lambda t: False,
    ) -> None:
        """Create a finder of the target ``name``, which fails in frames whose exposure times [s] are ``missed``."""
        self._map = CloseupFinder(calibration, target).affine_map
        self._truth, self._name, self._missed = truth, name, missed
        self._numbers_at = counted(seed + FINDER_SEED)

    def store(self, frame: Frame, detection: Detection, mask: Image | None = None) -> None:
        """Do nothing: the ground truth is always known."""

    def fixed_view_at(self, t: float) -> bool:
        """Return True: the ground truth is known at any time."""
        return True

    def find(self, frame: Frame, x_fixed: Array, covariance: Array, pose: Pose) -> ZoomMeasurement | None:
        """Find the target; None if its centre is outside the frame or outside the gate."""
        A, box = self._map(x_fixed, pose), self._truth.box(self._name, "zoom", frame.t)
        if A is None or box is None or self._missed(frame.t):
            return None
        noise = self.SIGMA_PX * self._numbers_at(frame.t).normal(size=2)
        at = self._truth.center_px(self._name, "zoom", frame.t) + noise
        off = at - A[:, 2]
        inside = (at >= 0).all() and (at <= np.array(frame.image.shape[1::-1]) - 1).all()
        if not inside or off @ np.linalg.solve(covariance, off) > GATE:
            return None
        return ZoomMeasurement(at, self.SIGMA_PX, np.full(2, self.SIGMA_PX), frame.t)


class Shaken:
    """Detector with true positions and noise, and more misses while the image moves."""

    def __init__(self, outlines: Outlines, truth: Truth, seed: int, miss: float) -> None:
        """Prepare the detectors at rest and in motion, where a fraction ``miss`` of the frames has no detection."""
        self._still = TruthDetector(outlines, seed, NOISE, camera="zoom")
        self._moving = TruthDetector(outlines, seed, replace(NOISE, miss=miss), camera="zoom")
        self._truth, self._miss, self._numbers_at = truth, miss, counted(seed + APART)

    def detect(self, frame: Frame, held: object = ()) -> Detections:
        """Detect the target."""
        return (self._moving if self.moves(frame.t) else self._still).detect(frame)

    def misses(self, t: float) -> bool:
        """Decide whether the target is missed at a time [s], for another detector."""
        return self._numbers_at(t).random() < (self._miss if self.moves(t) else NOISE.miss)

    def moves(self, t: float) -> bool:
        """Check whether head or lens move the image at a time [s]."""
        width = self._truth.lens("zoom", t).size[0]
        before, after = max(t - MOVED_S, 0.0), t + MOVED_S
        focal_px = self._truth.lens("zoom", t).focal_px[0]
        turned = np.subtract(self._truth.head_at(after), self._truth.head_at(before))
        grown = abs(self._truth.nominal_at(after) / self._truth.nominal_at(before) - 1)
        return bool(focal_px * np.abs(turned).max() > MOVED_PX or width / 2 * grown > MOVED_PX)


def config_of(name: str, seed: int) -> RigConfig:
    """Configure the field without clutter, which ground-truth detections ignore."""
    config = hold_config(name, seed)
    return replace(config, sim=replace(config.sim, effects=replace(config.sim.effects, clutter=False)))


def held(way: str, name: str, seed: int, seconds: float, miss: float) -> list[Judged]:
    """Run one way, PAIR or LONE_CAMERA, from a start without search; judge each zoom frame.

    While the image moves, the target is missed in a fraction ``miss`` of the zoom frames.
    """
    world = SimWorld(config_of(name, seed), rendered=())
    target, calibration = world.config.target(name), true_calibration(world)
    outlines = Outlines(world.truth())
    shaken = Shaken(outlines, world.truth(), seed, miss)
    rows: list[Judged] = []
    with guard(world.rig, world.config.safety) as rig:
        rig.head.move(*any_pose(rig, calibration, seed))
        last = None
        while not begun(rows) and rig.clock.now() < seconds:
            last = rig.zoom.read(newer_than=last).t
            rows.append(judge(outlines, name, target, last))
        left, delay_s = seconds - rig.clock.now(), rig.spec.head.delay_s
        if left <= 0:  # the target was not in view in time
            return rows
        if way == PAIR:
            times = by_pair(rig, calibration, target, outlines, name, seed, shaken, left)
        else:
            field = scan_of(rig, calibration)
            lone = (rig, world.truth(), calibration, target, shaken, delay_s, NOISE.center_px, field)
            times = (frame.t for frame in LoneCamera(*lone).run(left))
        for t in times:
            if t > rows[-1].t_s:
                rows.append(judge(outlines, name, target, t))
    return rows


def any_pose(rig: Rig, calibration: Calibration, seed: int) -> tuple[float, float]:
    """Draw pan and tilt at which the zoom camera looks into the fixed view [rad]."""
    rng = np.random.default_rng((seed, STREAM))
    pixel = rng.uniform(0.0, np.array(rig.fixed.size) - 1.0)
    pan, tilt = towards(calibration.zoom_head.T_base_fixed.apply(FAR * calibration.fixed.ray(pixel)))
    limits = rig.head.limits
    return float(np.clip(pan, *limits.pan.range)), float(np.clip(tilt, *limits.tilt.range))


def begun(rows: Sequence[Judged]) -> bool:
    """Check whether the clock has started, as defined in `cotarget.metrics.score`."""
    return bool(rows) and rows[-1].in_wide and rows[-1].t_s >= rows[0].t_s + BACKGROUND_S - ROUNDING_S


def by_pair(
    rig: Rig,
    calibration: Calibration,
    target: TargetProfile,
    outlines: Outlines,
    name: str,
    seed: int,
    shaken: Shaken,
    seconds: float,
) -> Iterator[float]:
    """Run the project's pipeline with both cameras; yield the times of the zoom frames, with repetitions."""

    def finder(calibration: Calibration, target: TargetProfile) -> TruthFinder:
        return TruthFinder(calibration, target, outlines, name, seed, shaken.misses)

    settings = FollowSettings(finder=finder)
    detector = TruthDetector(outlines, seed, NOISE)
    for step in follow(rig, calibration, target, detector, seconds=seconds, settings=settings):
        yield step.zoom.t


def judge(outlines: Outlines, name: str, target: TargetProfile, t: float) -> Judged:
    """Make the row of a zoom frame from ground truth; fields of commands and tracks are placeholders."""
    closeup, wide = closeup_of(outlines, name, target, t), outlines.silhouette(name, "fixed", t)
    not_known: dict[str, Any] = dict.fromkeys(
        ("u_wide_px", "v_wide_px", "u_detected_px", "v_detected_px", "range_m", "depth_m"), math.nan
    )
    nothing: dict[str, Any] = dict.fromkeys(
        ("pan_commanded_deg", "tilt_commanded_deg", "focal_commanded_px", "pan_deg", "tilt_deg"), 0.0
    )
    return Judged(
        t_s=t,
        t_fixed_s=t,
        state="",
        track=-1,
        **asdict(closeup),
        in_wide=wide is not None and wide.visible >= WHOLLY_VISIBLE,
        decoded=False,
        decoded_wide=False,
        off_target="",
        focal_px=outlines.lens("zoom", t).focal_px[0],
        **not_known,
        **nothing,
    )


# Figures


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """Give means over the seeds with standard errors by target and way, and quartiles of the time to acquire."""
    summary: dict[str, dict[str, dict[str, float]]] = {}
    for (name, way), mine in grouped(rows, "target", "way").items():
        found: dict[str, float] = {}
        for key in FIGURES:
            found[key], found[f"{key}_error"] = mean_of(_told(mine, key))
        times = [math.inf if row["time_to_acquire_s"] is None else row["time_to_acquire_s"] for row in mine]
        at = dict(zip(("low", "median", "high"), np.quantile(times, (0.25, 0.5, 0.75), method="nearest"), strict=True))
        found |= {f"time_to_acquire_s_{part}": float(value) for part, value in at.items()}
        summary.setdefault(name, {})[way] = found | {"never_acquired": float(np.mean(np.isinf(times)))}
    return summary


def _told(rows: Sequence[Row], key: str) -> list[float]:
    """Collect a figure's values from the rows that have it."""
    return [float(row[key]) for row in rows if row.get(key) is not None]


def bounded(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Give every close-up yield; a bound keeps the single camera's from falling, which would favour the pair."""
    return {name: {way: v["closeup_yield"] for way, v in ways.items()} for name, ways in summary.items()}


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List where a target is not acquired and kept although hardly anything is missed.

    Then one of the two cameras is not at its best, and the comparison is not fair.
    """
    return [
        f"{name}, {way}: {what}"
        for name, ways in summary.items()
        for way, found in ways.items()
        if way in {case(each, LEAST_MISS) for each in WAYS}
        for what, bad in (
            (f"in frame {found['in_frame_ratio']:.2f}", not found["in_frame_ratio"] >= HELD),
            ("not acquired in every run", found["never_acquired"] > 0),
        )
        if bad
    ]


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Close-up yield, frames in frame and time to acquire of each way: seeds as points, means with errors as bars."""
    targets, ways = (list(dict.fromkeys(row[key] for row in rows)) for key in ("target", "way"))
    figure.set_size_inches(14, 4.8)
    labels = {
        "closeup_yield": "close-up yield",
        "in_frame_of_all": "in frame, of all frames",
        "time_to_acquire_s": "time to acquire, where it was [s]",
    }
    shades = np.linspace(0.95, 0.35, len(ways) // len(WAYS))
    styles = [{"color": f"C{i}", "alpha": float(shade)} for i in range(len(WAYS)) for shade in shades]
    for ax, (key, label) in zip(figure.subplots(1, 3), labels.items(), strict=True):
        for i, way in enumerate(ways):
            mine = [[r for r in rows if (r["target"], r["way"]) == (name, way)] for name in targets]
            x = np.arange(len(targets)) + (i - (len(ways) - 1) / 2) * 0.8 / len(ways)
            seeds = [_told(each, key) for each in mine]
            means, errors = np.array([mean_of(each) for each in seeds]).T
            ax.bar(x, means, 0.75 / len(ways), yerr=np.nan_to_num(errors), capsize=3, label=way, **styles[i])
            for place, each in zip(x, seeds, strict=True):
                ax.plot([place] * len(each), each, ".", ms=3, color="k")
        ax.set(ylabel=label, ylim=(0, None if key.endswith("_s") else 1.02))
        ax.set_xticks(range(len(targets)), targets)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)


SETTINGS = SingleSettings()
QUICK = replace(SETTINGS, seeds=1, seconds=8.0, targets=("person", "bird"), misses=(0.05, 0.9))
COST_S = 30.0
