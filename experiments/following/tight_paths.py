"""Hard courses for one target: stops dead, sharp turns, gusts, an approach, and a wall that hides it for two seconds.

A book is carried from 12 m to 5 m, a person runs from 30 m to 16 m, because nearer the view cuts off the feet, and a
bird comes from 80 m to 6 m. Of random courses one is taken that stays in the fixed camera's view and that the head can
follow with four fifths of its own speed and acceleration. The world's axes are those of `cotarget.sim.targets.paths`.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from cotarget.config import SimHead, Waypoint
from cotarget.files import assets_dir
from cotarget.geometry import Array
from cotarget.sim.targets.paths import MOUNT
from cotarget.sim.targets.person import PERSON_HEIGHT
from cotarget.sim.targets.random_paths import in_view
from cotarget.sim.targets.target import true_size

COURSES = 11  # random stream of the courses, separate from the world's others
BEGIN, AFTER, STEP_S, KNOTS = -2.0, 3.0, 0.02, 5  # start and end beyond a run [s], sampling, samples a waypoint
ENTERED_S = 2.6  # time from which a target stays in view [s]
HEAD_PART = 0.8  # part of the head's speed and acceleration that a course may need
HIDDEN_S, MOST_TOUCHED_S = 2.0, 2.8  # time behind the wall, and longest with the times when a part sticks out [s]
LEAST_HIDDEN_S = 1.2  # shortest time wholly behind it [s]
WALL_AT = 0.85  # distance of the wall, in parts of the target's least distance behind it
WALL_THICKNESS = 0.2  # [m]
REACH = 0.28  # farthest aside, in parts of the least depth; farther out saplings hide a person
TRIES, PLACES = 3000, 8  # limit on the courses drawn, and on the places of a wall for each


@dataclass(frozen=True)
class Style:
    """How a kind of target moves.

    Attributes:
        depths: distances along the view at the start and at the end [m].
        heights: least and largest height of the body's centre [m]; of a bird above the camera, in parts of the depth,
            so that it is before the sky.
        speeds: speeds across, of which one is drawn for each leg [m/s].
        leg_s: least and longest duration of a leg [s].
        stops: part of the legs at whose end it stands for a while.
        soften_s: time over which turns and stops are spread [s].
        gust: rms acceleration of gusts [m/s^2].
        half: half of the size that has to be in view, and that the wall is higher [m].
        half_width: half of the width that the wall hides [m].
    """

    depths: tuple[float, float]
    heights: tuple[float, float]
    speeds: tuple[float, ...]
    leg_s: tuple[float, float]
    stops: float
    soften_s: float
    gust: float
    half: float
    half_width: float


STYLES = {
    "book": Style((12.0, 5.0), (1.4, 2.0), (0.5, 1.0, 2.0), (0.6, 1.6), 0.5, 0.15, 0.0, 0.14, 0.14),
    "person": Style((30.0, 16.0), (PERSON_HEIGHT / 2,) * 2, (1.5, 3.0, 5.0, 6.0), (0.8, 2.2), 0.3, 0.25, 0.0, 0.9, 0.9),
    "bird": Style((80.0, 6.0), (0.2, 0.32), (3.0, 6.0, 9.0), (1.0, 2.5), 0.0, 0.4, 3.0, 0.5, 0.5),
}
STAND_S = (0.6, 1.2)  # duration of a stop [s]
GUST_S = 0.4  # correlation time of gusts [s]


@dataclass(frozen=True)
class Wall:
    """An upright wall, square to the fixed camera's line of sight: its foot [m], size [m] and yaw [rad]."""

    x: float
    y: float
    width: float
    height: float
    yaw: float

    def scene(self, folder: Path) -> Path:
        """Write the outdoor scene with this wall into a folder."""
        source = assets_dir() / "scenes" / "outdoor.xml"
        half = f"{self.width / 2:.4f} {WALL_THICKNESS / 2} {self.height / 2:.4f}"
        place = f'pos="{self.x:.4f} {self.y:.4f} {self.height / 2:.4f}" euler="0 0 {math.degrees(self.yaw):.4f}"'
        wall = f'<geom class="outdoor" name="wall" type="box" size="{half}" {place} rgba="0.5 0.46 0.42 1"/>'
        text = source.read_text(encoding="utf-8").replace("<worldbody>", f"<worldbody>{wall}", 1)
        path = folder / "hold_tight.xml"
        path.write_text(text.replace('dir="../', f'dir="{assets_dir().as_posix()}/'), encoding="utf-8")
        return path


@dataclass(frozen=True)
class Course:
    """Path of a target, and the wall behind which it goes."""

    path: tuple[Waypoint, ...]
    wall: Wall


def tight_course(name: str, seed: int, seconds: float, style: Style | None = None) -> Course:
    """Draw the course of a book, person or bird for a run of some seconds, by default in its own style."""
    rng, style = _rng(name, seed), style or STYLES[name]
    for t, x in _drawn_paths(rng, name, seed, seconds, style):
        counted = _counted(t, seconds)
        walls = (_wall(rng, style, t[counted], x[counted]) for _ in range(PLACES))
        wall = next((each for each in walls if each is not None), None)
        if wall is not None:
            return Course(_waypoints(t, x), wall)
    raise RuntimeError(f"no course of a {name} was drawn in {TRIES} tries; the ranges above do not fit together")


def open_path(name: str, seed: int, seconds: float, style: Style) -> tuple[Waypoint, ...]:
    """Draw the path of a target in a style, for a run of some seconds without a wall."""
    for t, x in _drawn_paths(_rng(name, seed), name, seed, seconds, style):
        return _waypoints(t, x)
    raise RuntimeError(f"no path of a {name} was drawn in {TRIES} tries; the style's ranges do not fit together")


def _rng(name: str, seed: int) -> np.random.Generator:
    return np.random.default_rng((seed, COURSES, *name.encode()))


def _counted(t: Array, seconds: float) -> npt.NDArray[np.bool_]:
    """Tell the times at which a target has to be in view."""
    return np.asarray((t >= ENTERED_S) & (t <= seconds))


def _waypoints(t: Array, x: Array) -> tuple[Waypoint, ...]:
    knots = zip(t[::KNOTS], x[::KNOTS], strict=True)
    return tuple((float(a), *map(float, b)) for a, b in knots)  # type: ignore[misc]


def _drawn_paths(
    rng: np.random.Generator, name: str, seed: int, seconds: float, style: Style
) -> Iterator[tuple[Array, Array]]:
    """Draw times (n,) and positions (n, 3) of a target that stays in view and that the head can follow."""
    size, t = true_size(name, seed), np.arange(BEGIN, seconds + AFTER + STEP_S / 2, STEP_S)
    for _ in range(TRIES):
        x = _drawn(rng, style, t, enters=name == "person")
        if name == "person":
            x[:, 2] *= size
        counted = _counted(t, seconds)
        if in_view(x[counted], style.half).all() and _can_be_followed(x[counted]):
            yield t, x


def _drawn(rng: np.random.Generator, style: Style, t: Array, enters: bool) -> Array:
    """Draw positions at times (n,), (n, 3) [m]; one that enters comes into view from the side after a second."""
    approach = np.clip((t - 1.0) / (t[-1] - AFTER - 1.0), 0.0, 1.0)
    depth = style.depths[0] + (style.depths[1] - style.depths[0]) * approach
    reach = REACH * depth.min()  # where it turns round [m]
    begin = rng.choice([-1.0, 1.0]) * 0.56 * style.depths[0] if enters else rng.uniform(-0.5, 0.5) * reach
    across, at = np.empty_like(t), float(begin)
    for speed, now in zip(_speeds(rng, style, t), range(len(t)), strict=True):
        if enters and (t[now] < 1.0 or abs(at) > reach):  # it waits outside, then runs straight in
            speed = -math.copysign(max(style.speeds), at) * (t[now] >= 1.0)
        elif abs(at) > reach:
            speed = -math.copysign(abs(speed), at)
        at += speed * STEP_S
        across[now] = at
    heights = np.interp(t, np.linspace(t[0], t[-1], 8), rng.uniform(*style.heights, 8))
    x = np.stack([across, depth, MOUNT[2] + heights * depth if style.gust else heights], axis=1)
    x = gaussian_filter1d(x, style.soften_s / STEP_S, axis=0, mode="nearest")
    if style.gust:
        accelerations = gaussian_filter1d(rng.normal(size=(len(t), 3)), GUST_S / STEP_S, axis=0)
        accelerations *= style.gust / accelerations.std(axis=0)
        drift = np.cumsum(np.cumsum(accelerations, axis=0), axis=0) * STEP_S**2
        x += drift - gaussian_filter1d(drift, 1.5 / STEP_S, axis=0, mode="nearest")  # gusts move it to and fro
    return np.asarray(x)


def _speeds(rng: np.random.Generator, style: Style, t: Array) -> Iterator[float]:
    """Draw the speed across at each time: legs to either side, some of which end in a stop [m/s]."""
    count = 0
    while count < len(t):
        leg = round(rng.uniform(*style.leg_s) / STEP_S)
        stand = round(rng.uniform(*STAND_S) / STEP_S) if rng.random() < style.stops else 0
        speed = float(rng.choice(style.speeds) * rng.choice([-1.0, 1.0]))
        for k in range(min(leg + stand, len(t) - count)):
            yield speed if k < leg else 0.0
        count += leg + stand


def _angles(x: Array) -> tuple[Array, Array]:
    """Compute pan to the right and tilt upwards from the mount of positions (n, 3), (n,) [rad]."""
    right, ahead, up = (x - MOUNT).T
    return np.arctan2(right, ahead), np.arctan2(up, np.hypot(right, ahead))


def _can_be_followed(x: Array) -> bool:
    """Check that the head can follow positions (n, 3) with a part of its speed and acceleration."""
    head = SimHead()
    for angle in _angles(x):
        rate = np.gradient(np.degrees(angle), STEP_S)
        if np.abs(rate).max() > HEAD_PART * head.speed_deg_s:
            return False
        if np.abs(np.gradient(rate, STEP_S)).max() > HEAD_PART * head.accel_deg_s2:
            return False
    return True


def _wall(rng: np.random.Generator, style: Style, t: Array, x: Array) -> Wall | None:
    """Place a wall that hides a target for two seconds in the first half of its course; None if it would not."""
    begin = rng.uniform(0.2, 0.5) * (t[-1] - t[0]) + t[0]
    behind = (t >= begin) & (t <= begin + HIDDEN_S)
    (pan, tilt), distance = _angles(x), np.hypot(*(x - MOUNT)[:, :2].T)
    least = float(distance[behind].min())
    margin = style.half_width / least
    low, high = float(pan[behind].min()), float(pan[behind].max())
    hidden: npt.NDArray[np.bool_] = (pan > low + margin) & (pan < high - margin) & (distance > WALL_AT * least)
    touched = (pan > low - margin) & (pan < high + margin) & (distance > WALL_AT * least)
    hidden_s, touched_s = np.count_nonzero(hidden) * STEP_S, np.count_nonzero(touched) * STEP_S
    if hidden_s < LEAST_HIDDEN_S or touched_s > MOST_TOUCHED_S:
        return None
    middle, away = (low + high) / 2, WALL_AT * least
    top = MOUNT[2] + away * math.tan(float(tilt[behind].max()) + style.half / least)
    return Wall(away * math.sin(middle), away * math.cos(middle), 2 * away * math.tan((high - low) / 2), top, -middle)
