"""Films without targets: false tracks a minute in foliage, clouds, rain, night, and sun and shade, beside the mixture.

The films are drawn: foliage is a texture that a smooth random field of shifts moves, as gusts do; clouds are such a
texture that drifts and boils; rain is streaks before foliage that stands; the night has much noise, one lamp that
flickers and one that is switched; sun and shade is foliage whose light changes as clouds pass. Each frame has a
sensor's noise and is coded as JPEG. All frames but those of the first second are judged: every track is false.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import cv2
import numpy as np
from annotated_types import Gt

from cotarget.config import DEFAULT_TARGETS, DetectorName
from cotarget.detection import make_detector
from cotarget.geometry import Array
from cotarget.metrics import BACKGROUND_S, false_tracks
from cotarget.pipeline import CameraRun
from cotarget.rig import Frame, Image
from cotarget.tracking.track import tracking_settings
from cotarget.tracking.tracker import Tracker
from experiments.engine import Count, Row, Settings
from experiments.tables import grouped

SIZE = (640, 480)
NOISE, NIGHT_NOISE, QUALITY = 2.0, 8.0, 85  # standard deviation of a sensor's noise [grey levels], and quality of JPEG
LEAF_PX, SWAY_PX, GUST_PX = 5, 1.5, 80  # size of leaves, deviation of their sway, and its width [px]
SWAY_HZ, GUST_S = 0.8, 3.0  # frequency of the sway, and time in which its strength changes
DRIFT_PX_S, BOIL_S, SKY = 8.0, 20.0, 4  # speed of clouds, time in which their shape changes, and widths of the sky
WANTED = 0.5  # false tracks a minute


@dataclass(frozen=True)
class EmptySettings(Settings):
    """Settings: films, and who searches them."""

    seeds: Count = 6
    seconds: Annotated[float, Gt(BACKGROUND_S)] = 60.0  # length of each film [s]
    rate_hz: float = 25.0
    scenes: tuple[str, ...] = ("foliage", "clouds", "rain", "night", "sun and shade")
    targets: tuple[str, ...] = ("bird", "person")  # profiles of targets
    beside: DetectorName = "mog2"  # the detector that each profile's own is compared with


def smooth(rng: np.random.Generator, shape: tuple[int, ...], width_px: float) -> Array:
    """Draw a random field of unit deviation that varies over a width, (H, W) or (H, W, C)."""
    small = rng.normal(size=(max(2, round(shape[0] / width_px)), max(2, round(shape[1] / width_px)), *shape[2:]))
    field = cv2.resize(small, shape[1::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray(field / field.std())


def leaves(rng: np.random.Generator) -> Image:
    """Draw trees under a sky: leaves of every brightness, and gaps between them."""
    height, width = SIZE[1], SIZE[0]
    bright = 90 + 25 * smooth(rng, (height, width), LEAF_PX) + 20 * smooth(rng, (height, width), GUST_PX)
    trees = bright[:, :, None] * np.array([0.5, 1.0, 0.7])
    crowns = np.arange(height)[:, None] > height * (0.35 + 0.06 * smooth(rng, (1, width), GUST_PX))
    gaps = smooth(rng, (height, width), 3 * LEAF_PX) > 1.5
    trees[~crowns | gaps] = (220, 190, 150)
    return np.clip(trees, 0, 255).astype(np.uint8)


class Sway:
    """Shifts of a texture that sways in gusts."""

    def __init__(self, rng: np.random.Generator) -> None:
        """Draw the places' phases and the gusts."""
        shape = (SIZE[1], SIZE[0], 2)
        self._quarters = smooth(rng, shape, GUST_PX), smooth(rng, shape, GUST_PX)
        self._gusts = rng.uniform(0, 2 * np.pi, 3)
        self._at = np.dstack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))).astype(np.float32)

    def __call__(self, image: Image, t: float) -> Image:
        """Move an image as it is at a time [s]."""
        strength = np.mean([1 + np.sin(t / GUST_S * (1 + i) + phase) for i, phase in enumerate(self._gusts)])
        turn = 2 * np.pi * SWAY_HZ * t
        shift = SWAY_PX * strength * (np.cos(turn) * self._quarters[0] + np.sin(turn) * self._quarters[1])
        return np.asarray(
            cv2.remap(image, (self._at + shift).astype(np.float32), None, cv2.INTER_LINEAR, None, cv2.BORDER_REFLECT),
            np.uint8,
        )


Draw = Callable[[float], Any]


def foliage(rng: np.random.Generator) -> Draw:
    """Trees that sway in gusts."""
    trees, sway = leaves(rng), Sway(rng)
    return lambda t: sway(trees, t)


def clouds(rng: np.random.Generator) -> Draw:
    """Clouds that drift and change before a blue sky."""
    layers = [smooth(rng, (SIZE[1], SKY * SIZE[0]), width) for width in (160, 60, 20)]

    def draw(t: float) -> Array:
        left = round(DRIFT_PX_S * t) % ((SKY - 1) * SIZE[0])
        boiling = [np.cos(t / BOIL_S + i) * each[:, left : left + SIZE[0]] for i, each in enumerate(layers)]
        white = np.clip(0.5 + boiling[0] + 0.5 * boiling[1] + 0.25 * boiling[2], 0, 1)[:, :, None]
        return (1 - white) * np.array([190.0, 140.0, 90.0]) + white * 225.0

    return draw


def rain(rng: np.random.Generator) -> Draw:
    """Streaks of rain before trees that stand."""
    trees = leaves(rng)

    def draw(_: float) -> Image:
        image = trees.copy()
        for u, v in rng.uniform(0, SIZE, (60, 2)).astype(int).tolist():
            cv2.line(image, (u, v), (u + 2, v + 14), (200, 200, 200), 1, cv2.LINE_AA)
        return np.asarray(cv2.addWeighted(image, 0.6, trees, 0.4, 0))

    return draw


def night(rng: np.random.Generator) -> Draw:
    """Much noise in the dark, a lamp that flickers, and one that is switched every five seconds."""
    scene = 0.15 * leaves(rng) + rng.normal(0, NIGHT_NOISE, (SIZE[1], SIZE[0], 1))
    lamps = []
    for u, v in rng.uniform((60, 60), (SIZE[0] - 60, SIZE[1] - 60), (2, 2)):
        off = np.hypot(*np.meshgrid(np.arange(SIZE[0]) - u, np.arange(SIZE[1]) - v))
        lamps.append(160 * np.exp(-((off / 6) ** 2)) + 60 * np.exp(-off / 40))

    def draw(t: float) -> Array:
        lights = lamps[0] * (1 + 0.2 * np.sin(2 * np.pi * 3 * t)) + lamps[1] * (t % 10 < 5)
        return np.asarray(scene + lights[:, :, None] + rng.normal(0, NIGHT_NOISE, scene.shape))

    return draw


def shade(rng: np.random.Generator) -> Draw:
    """Trees and a meadow whose light changes as clouds pass the sun, with the edge of a shadow that crosses."""
    trees, place = leaves(rng).astype(float), np.arange(SIZE[0])

    def draw(t: float) -> Array:
        edge = (40 * t) % (3 * SIZE[0]) - SIZE[0]
        lit = 1.0 + 0.15 * np.sin(t / 4) - 0.35 / (1 + np.exp((place - edge) / 25))
        return np.asarray(trees * lit[:, None])

    return draw


SCENES: Mapping[str, Callable[[np.random.Generator], Draw]] = {
    "foliage": foliage, "clouds": clouds, "rain": rain, "night": night, "sun and shade": shade,
}  # fmt: skip


def film(scene: str, settings: EmptySettings, seed: int) -> Iterator[Frame]:
    """Draw the frames of a scene."""
    rng = np.random.default_rng((seed, list(SCENES).index(scene)))
    draw = SCENES[scene](rng)
    for number in range(round(settings.seconds * settings.rate_hz)):
        t = number / settings.rate_hz
        noisy = draw(t) + rng.normal(0, NOISE, (SIZE[1], SIZE[0], 1))
        coded = cv2.imencode(".jpg", np.clip(noisy, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
        yield Frame(np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), dtype=np.uint8), t)


def one(settings: EmptySettings, seed: int) -> list[Row]:
    """Search a film of each scene in every way; give a row for each."""
    ways = [
        (kind, replace(DEFAULT_TARGETS[kind], detector=name))
        for kind in settings.targets
        for name in (DEFAULT_TARGETS[kind].detector, settings.beside)
    ]
    rows: list[Row] = []
    for scene in settings.scenes:
        cameras = [
            CameraRun(make_detector(target, settings.rate_hz), Tracker(tracking_settings(target), SIZE))
            for _, target in ways
        ]
        off: list[list[tuple[float, list[int]]]] = [[] for _ in ways]
        for frame in film(scene, settings, seed):
            for camera, mine in zip(cameras, off, strict=True):
                camera.track(frame)
                if frame.t >= BACKGROUND_S:
                    mine.append((frame.t, [track.id for track in camera.tracks if track.reported]))
        minutes = (settings.seconds - BACKGROUND_S) / 60
        rows += [
            {
                "seed": seed,
                "scene": scene,
                "way": f"{kind}, {target.detector}",
                "minutes": minutes,
                "false": false_tracks(mine),
                "false_in_10_s": false_tracks(pair for pair in mine if pair[0] < 10.0),
            }
            for (kind, target), mine in zip(ways, off, strict=True)
        ]
    return rows


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give false tracks a minute of each way in each scene and in all, and how many a film's first ten seconds have."""
    found: dict[str, dict[str, float]] = {}
    for way, mine in grouped(rows, "way").items():
        scenes = {**grouped(mine, "scene"), "all": mine}
        found[way] = {
            scene: sum(row["false"] for row in each) / sum(row["minutes"] for row in each)
            for scene, each in scenes.items()
        } | {"in the first 10 s": float(np.mean([row["false_in_10_s"] for row in mine]))}
    return found


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the ways of the profiles' own detectors with more false tracks than wanted."""
    return [f"{way}: {each['all']:.2f} a minute" for way, each in summary.items() if each["all"] > WANTED]


SETTINGS = EmptySettings()
QUICK = replace(SETTINGS, seeds=1, seconds=6.0, scenes=("rain",))
COST_S = 800.0
