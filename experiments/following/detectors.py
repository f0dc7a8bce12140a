"""What each detector finds in the field and what it takes for a target, by a camera that stands and by one that shakes.

Five persons, five birds, or nobody at all, in the field of `experiments.following.field_scenes`: foliage, clouds and
shadows move
about as strongly as the targets. Each frame is rendered once, searched by every detector and tracked, and judged by the
truth: how much of the time that a target is wholly in view a confirmed track is on it, false tracks a minute, and how
often a track goes over to another target. A shaken camera's frames are those of the one that stands, shifted to and fro
at random with a memory of a tenth of a second; its tracks are judged as if somebody had held it still. Where nobody is,
it stands.

    python -m experiments.following.detectors [--seeds 2] [--seed-base 0] [--processes P] [--quick] [--out DIR]
"""

import dataclasses
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import numpy as np
from matplotlib.figure import Figure

from cotarget.config import RigConfig, TargetConfig
from cotarget.detection import make_detector
from cotarget.evaluation import off_target, on_target
from cotarget.geometry import Array
from cotarget.metrics import BACKGROUND_S, WHOLLY_VISIBLE, false_tracks, id_switches
from cotarget.rig import Frame
from cotarget.sim.targets.random_paths import GROUPED, SECONDS
from cotarget.sim.truth import Silhouette
from cotarget.sim.world import SimWorld
from cotarget.tracking.track import settings_for
from cotarget.tracking.tracker import Tracker
from experiments.engine.checks import check_above, check_ways
from experiments.engine.harness import Experiment, Row, Settings, seeds_of
from experiments.engine.spread import in_words, points, spread
from experiments.engine.texts import table
from experiments.following.field_scenes import field_config, five_targets_config
from experiments.following.wide_view import WIDE

DetectorName = Literal["mog2", "motion", "speck"]
DETECTORS: tuple[DetectorName, ...] = ("mog2", "motion", "speck")
STANDS, SHAKES = "stands", "shakes"
MEMORY_S = 0.1  # of the shake
COME_S = 3.0  # by then the first of five is in view, whatever the seed, and the background was learnt [s]
STREAM = 11  # of random numbers, apart from the world's own
FIGURES = {
    "found": "targets in view with a track on them",
    "false_per_min": "false tracks a minute",
    "switches_per_min": "tracks that go over to another target, a minute",
}


@dataclass(frozen=True)
class DetectorsSettings(Settings):
    """How many seeds, which scenes, and how much the camera shakes.

    Attributes:
        seconds: of each run [s].
        kinds: person, bird; of each five, and of each nobody.
        detectors: which are compared.
        shake_px: standard deviation of the shaken picture's place, along each axis [px].
    """

    seeds: int = 2
    seconds: float = SECONDS
    kinds: tuple[str, ...] = GROUPED
    detectors: tuple[DetectorName, ...] = DETECTORS
    shake_px: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        super().__post_init__()
        check_above(COME_S, self, "seconds")
        check_ways(self, "seconds")


@dataclass
class Watch:
    """A detector and its tracker behind one camera, and what was so in each frame.

    Attributes:
        kind: of the target that is looked for.
        name: of the detector.
        camera: whether it stands.
        on: which track was on which target.
        off: the time [s], and which tracks were on none.
        found: of each target wholly in view, whether a track was on it.
    """

    kind: str
    name: str
    camera: str
    target: TargetConfig
    config: RigConfig
    on: list[list[tuple[int, str]]] = field(default_factory=list)
    off: list[tuple[float, list[int]]] = field(default_factory=list)
    found: list[bool] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._detector = make_detector(self.target, self.config.rate_hz)
        self._tracker = Tracker(settings_for(self.target), self.config.sim.fixed.size)

    def see(self, frame: Frame, shift: Array, outlines: Mapping[str, Silhouette | None]) -> None:
        """Search a frame that is shifted so far (du, dv) [px], and judge what is tracked then."""
        tracks = self._tracker.update(self._detector.detect(frame), frame.t)
        held = [dataclasses.replace(track, center_px=track.center_px - shift) for track in tracks]
        if frame.t < BACKGROUND_S:
            return
        self.on.append(on_target(held, outlines))
        self.off.append((frame.t, off_target(held, outlines.values())))
        with_track = {name for _, name in self.on[-1]}
        in_view = (name for name, each in outlines.items() if each is not None and each.visible >= WHOLLY_VISIBLE)
        self.found += [name in with_track for name in in_view]

    def row(self, seed: int) -> Row:
        """What came of it; nothing was to be found where nobody was."""
        minutes = (self.off[-1][0] - self.off[0][0]) / 60
        return {
            "seed": seed,
            "scene": f"five {self.kind}s" if self.found else f"no {self.kind}",
            "detector": self.name,
            "camera": self.camera,
            "found": float(np.mean(self.found)) if self.found else None,
            "false_per_min": false_tracks(self.off) / minutes,
            "switches_per_min": id_switches(self.on) / minutes if self.found else None,
        }


def one(_: None, settings: DetectorsSettings, seed: int) -> list[Row]:
    """Watch each scene once with all detectors; one row for each of them and either camera."""
    rows = [row for kind in settings.kinds for row in watched(five_targets_config(seed, kind), (kind,), settings, seed)]
    return [*rows, *watched(field_config({}, seed), settings.kinds, settings, seed)]


def watched(config: RigConfig, kinds: Sequence[str], settings: DetectorsSettings, seed: int) -> Iterator[Row]:
    """Watch a scene for targets of some kinds."""
    watches = [
        Watch(kind, name, camera, dataclasses.replace(config.target(kind), detector=name), config)
        for kind in kinds
        for name in settings.detectors
        for camera in ((STANDS, SHAKES) if config.sim.targets else (STANDS,))
    ]
    world = SimWorld(config, rendered=WIDE)
    truth, shake = world.truth(), _Shake(settings.shake_px, np.random.default_rng((seed, STREAM)))
    with world.rig as rig:
        t: float | None = None
        while t is None or t < settings.seconds:
            frame = rig.fixed.read(newer_than=t)
            shift = shake.at(frame.t)
            shaken = Frame(_shifted(frame.image, shift), frame.t)
            outlines = {name: truth.silhouette(name, "fixed", frame.t) for name in truth.targets}
            for watch in watches:
                stands = watch.camera == STANDS
                watch.see(frame if stands else shaken, np.zeros(2) if stands else shift, outlines)
            t = frame.t
    return (watch.row(seed) for watch in watches)


class _Shake:
    """Where a shaken picture is: normal, with a memory."""

    def __init__(self, sigma_px: float, rng: np.random.Generator) -> None:
        self._sigma, self._rng = sigma_px, rng
        self._t, self._at = -np.inf, np.zeros(2)

    def at(self, t: float) -> Array:
        """At a time that is no earlier than the last [s], (du, dv) [px]."""
        kept = float(np.exp((self._t - t) / MEMORY_S))
        self._at = kept * self._at + np.sqrt(1 - kept**2) * self._rng.normal(0.0, self._sigma, 2)
        self._t = t
        return self._at


def _shifted(image: Any, shift: Array) -> Any:
    """A picture moved by so much (du, dv) [px]."""
    M = np.column_stack([np.eye(2), shift])
    return cv2.warpAffine(image, M, image.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, dict[str, float]]]]:
    """Of each scene, detector with its camera, and figure median, least and largest over the seeds."""
    found: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    for scene, way in dict.fromkeys((row["scene"], _way(row)) for row in rows):
        mine = [row for row in rows if (row["scene"], _way(row)) == (scene, way)]
        told = [key for key in FIGURES if mine[0][key] is not None]
        found.setdefault(scene, {})[way] = {key: spread(mine, key) for key in told}
    return found


def _way(row: Row) -> str:
    return f"{row['detector']}, {row['camera']}"


def describe(settings: DetectorsSettings, summary: Mapping[str, Any]) -> str:
    """A table for each figure: a line a scene, a column a detector and camera."""
    texts = [
        f"median (least to largest) of {seeds_of(settings)}, {settings.seconds:g} s each; the camera stands, or shakes "
        f"by {settings.shake_px:g} px along each axis, one standard deviation"
    ]
    for key, words in FIGURES.items():
        scenes = {name: found for name, found in summary.items() if key in next(iter(found.values()))}
        ways = list(dict.fromkeys(way for found in scenes.values() for way in found))
        lines = (
            [name, *(in_words(found[way][key]) if way in found else "" for way in ways)]
            for name, found in scenes.items()
        )
        texts.append(table((words, *ways), lines))
    return "\n\n".join(texts)


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """A panel for each figure, a group for each scene: medians with bars from the least seed to the largest."""
    scenes, ways = (list(dict.fromkeys(map(what, rows))) for what in (lambda row: row["scene"], _way))
    figure.set_size_inches(14, 4.2)
    for ax, (key, words) in zip(figure.subplots(1, len(FIGURES)), FIGURES.items(), strict=True):
        shown = [scene for scene in scenes if any(row[key] is not None for row in rows if row["scene"] == scene)]
        for i, way in enumerate(ways):
            for k, scene in enumerate(shown):
                mine = [row[key] for row in rows if (row["scene"], _way(row)) == (scene, way)]
                points(ax, k + 0.8 * (i / len(ways) - 0.4), mine, color=f"C{i}", label=way if k == 0 else None)
        ax.set(title=words, xticks=range(len(shown)), xticklabels=shown, ylim=(0, None))
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False)


SETTINGS = DetectorsSettings()
EXPERIMENT = Experiment(
    "detectors",
    "What each detector finds in the field, and what it takes for a target, by a camera that stands or shakes.",
    SETTINGS,
    dataclasses.replace(SETTINGS, seeds=1, seconds=5.0, kinds=("bird",), detectors=("speck",)),
    one,
    summarise,
    describe,
    plot,
    cost_s=240.0,
)
if __name__ == "__main__":
    sys.exit(EXPERIMENT.main())
