"""Detectors compared in the field: targets found and false tracks, with a static and with a shaking camera.

Scenes have five persons, five birds or no target in the field of `experiments.following.field`, where foliage,
clouds and shadows move about as strongly as the targets. Each frame is rendered once, searched by every detector and
tracked. Ground truth judges the tracks: the fraction of time that a wholly visible target has a confirmed track, false
tracks a minute, and switches of a track to another target. The shaking camera's frames are those of the static one,
shifted by random offsets with a correlation time of a tenth of a second; its tracks are judged after the shift is
removed. Without targets, the camera is static.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import cv2
import numpy as np
from annotated_types import Gt, Le

from cotarget.config import DetectorName, RigConfig, TargetProfile
from cotarget.detection import Detector, make_detector
from cotarget.evaluation import off_target, on_target
from cotarget.geometry import Array
from cotarget.metrics import BACKGROUND_S, WHOLLY_VISIBLE, false_tracks, id_switches
from cotarget.pipeline import CameraRun
from cotarget.rig import Frame
from cotarget.schema import NotNegative
from cotarget.sim.targets.random_paths import GROUPED, SECONDS
from cotarget.sim.truth import Silhouette
from cotarget.sim.world import SimWorld
from cotarget.tracking.track import tracking_settings
from cotarget.tracking.tracker import Tracker
from experiments.engine import Count, Row, Settings
from experiments.following.field import field_config, five_targets_config
from experiments.following.wide_view import WIDE
from experiments.tables import grouped, spread

DETECTORS: tuple[DetectorName, ...] = ("mog2", "motion", "speck", "auto")
STANDS, SHAKES = "stands", "shakes"
MEMORY_S = 0.1  # correlation time of the shake
COME_S = 3.0  # by then the first of five is in view with any seed, and the background was learnt [s]
STREAM = 11  # random stream, separate from the world's
FIGURES = {
    "found": "targets in view with a track on them",
    "false_per_min": "false tracks a minute",
    "switches_per_min": "tracks that go over to another target, a minute",
}


@dataclass(frozen=True)
class DetectorsSettings(Settings):
    """Settings: scenes, detectors and camera shake."""

    seeds: Count = 2
    seconds: Annotated[float, Gt(COME_S), Le(SECONDS)] = SECONDS  # length of each run [s]
    kinds: tuple[str, ...] = GROUPED  # kinds of target, person or bird; each is run with five targets and with none
    detectors: tuple[DetectorName, ...] = DETECTORS  # detectors to compare
    shake_px: NotNegative = 1.0  # standard deviation of the image's shift along each axis [px]


@dataclass
class Watch:
    """Detector and tracker behind one camera, with the results of each frame."""

    kind: str  # kind of target that is searched
    name: str  # name of the detector
    camera: str  # STANDS or SHAKES
    target: TargetProfile  # configuration of the target
    config: RigConfig  # configuration of the rig
    detector: Detector | None = None  # searches the frames; by default one of that name
    on: list[list[tuple[int, str]]] = field(default_factory=list)  # pairs of track and target that match, per frame
    off: list[tuple[float, list[int]]] = field(default_factory=list)  # time [s] and tracks on no target, per frame
    # For each wholly visible target in each frame, whether a track was on it.
    found: list[bool] = field(default_factory=list)

    def __post_init__(self) -> None:
        detector = self.detector or make_detector(self.target, self.config.sim.fixed.rate_hz)
        self._camera = CameraRun(detector, Tracker(tracking_settings(self.target), self.config.sim.fixed.size))

    def see(self, frame: Frame, shift: Array, outlines: Mapping[str, Silhouette | None]) -> None:
        """Search a frame with a shift (du, dv) [px], and judge the tracks."""
        self._camera.track(frame)
        held = [dataclasses.replace(track, center_px=track.center_px - shift) for track in self._camera.tracks]
        if frame.t < BACKGROUND_S:
            return
        self.on.append(on_target(held, outlines))
        self.off.append((frame.t, off_target(held, outlines.values())))
        with_track = {name for _, name in self.on[-1]}
        in_view = (name for name, each in outlines.items() if each is not None and each.visible >= WHOLLY_VISIBLE)
        self.found += [name in with_track for name in in_view]

    def row(self, seed: int) -> Row:
        """Give the figures as a row; None for those that need targets where there were none."""
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


def one(settings: DetectorsSettings, seed: int) -> list[Row]:
    """Run each scene once with all detectors; give a row per detector and camera."""
    rows = [row for kind in settings.kinds for row in watched(five_targets_config(seed, kind), (kind,), settings, seed)]
    return [*rows, *watched(field_config({}, seed), settings.kinds, settings, seed)]


def watched(config: RigConfig, kinds: Sequence[str], settings: DetectorsSettings, seed: int) -> Iterator[Row]:
    """Run all detectors on a scene, for targets of some kinds."""
    watches = [
        Watch(kind, name, camera, dataclasses.replace(config.target(kind), detector=name), config)
        for kind in kinds
        for name in settings.detectors
        for camera in ((STANDS, SHAKES) if config.sim.targets else (STANDS,))
    ]
    world = SimWorld(config, rendered=WIDE)
    truth, shake = world.truth(), Shake(settings.shake_px, np.random.default_rng((seed, STREAM)))
    with world.rig as rig:
        t: float | None = None
        while t is None or t < settings.seconds:
            frame = rig.fixed.read(newer_than=t)
            shift = shake.at(frame.t)
            shaken = Frame(shifted(frame.image, shift), frame.t)
            outlines = {name: truth.silhouette(name, "fixed", frame.t) for name in truth.targets}
            for watch in watches:
                stands = watch.camera == STANDS
                watch.see(frame if stands else shaken, np.zeros(2) if stands else shift, outlines)
            t = frame.t
    return (watch.row(seed) for watch in watches)


class Shake:
    """Random shift of an image: Gaussian, with an exponential correlation."""

    def __init__(self, sigma_px: float, rng: np.random.Generator) -> None:
        self._sigma, self._rng = sigma_px, rng
        self._t, self._at = -np.inf, np.zeros(2)

    def at(self, t: float) -> Array:
        """Give the shift (du, dv) [px] at a time no earlier than the last [s]."""
        kept = float(np.exp((self._t - t) / MEMORY_S))
        self._at = kept * self._at + np.sqrt(1 - kept**2) * self._rng.normal(0.0, self._sigma, 2)
        self._t = t
        return self._at


def shifted(image: Any, shift: Array) -> Any:
    """Shift an image by (du, dv) [px]."""
    M = np.column_stack([np.eye(2), shift])
    return cv2.warpAffine(image, M, image.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, dict[str, float]]]]:
    """Give median, least and largest over the seeds for each scene, detector with camera, and figure."""
    return {
        scene: {
            way: {key: spread(row[key] for row in mine) for key in FIGURES if mine[0][key] is not None}
            for way, mine in _ways(of_scene).items()
        }
        for scene, of_scene in grouped(rows, "scene").items()
    }


def _ways(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Group rows by detector and camera."""
    return {", ".join(way): mine for way, mine in grouped(rows, "detector", "camera").items()}


SETTINGS = DetectorsSettings()
QUICK = dataclasses.replace(SETTINGS, seeds=1, seconds=5.0, kinds=("bird",), detectors=("speck",))
COST_S = 240.0
