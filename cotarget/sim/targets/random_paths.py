"""Random paths outdoors: one book, person or bird, or five persons or birds at once.

The paths are a little longer than a run of SECONDS. The world's axes are those of `cotarget.sim.targets.paths`: the
fixed camera is at MOUNT, outdoors, looking along +y and 9 degrees up.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from cotarget.config import Waypoint
from cotarget.errors import ConfigError, choices
from cotarget.geometry import Array
from cotarget.sim.targets.paths import MOUNT
from cotarget.sim.targets.person import PERSON_HEIGHT
from cotarget.sim.targets.target import true_size

SECONDS = 20.0  # of a run
LONE, GROUPED = ("book", "person", "bird"), ("person", "bird")  # kinds with paths for one target, and for five
PATHS = 10  # random stream of the paths, separate from the world's others
# Paths begin before and end after a run, because they are at rest at both ends [s].
BEGIN, END, KNOT_S = -2.0, SECONDS + 3.0, 0.1
MOUNT_PITCH = np.radians(9.0)  # elevation of the outdoor scene's fixed camera
VIEW_TAN = (0.47, 0.35)  # tangents of half the fixed camera's view, a little less than the true 0.479 and 0.358
TRIES = 200  # limit on draws of a path that meets its constraints; most do at once
BOOK_RANGE, BOOK_ASIDE, BOOK_HEIGHT = (9.7, 10.3), 2.6, (1.2, 2.6)
BOOK_MOVED_AT, BOOK_TAKES, BOOK_GOES = (8.0, 12.0), (1.0, 1.5), (1.5, 4.0)  # start [s], duration [s], distance [m]
PERSON_MIDDLE, PERSON_SPEED, PERSON_ENTERS = (10.0, 10.3), (1.45, 1.55), (1.2, 1.6)
BIRD_RADIUS, BIRD_SPEED = 10.0, (9.0, 11.0)  # least turning radius [m], mean speed of a run [m/s]
BIRD_CENTERS, BIRD_HEIGHTS = (25.0, 26.5), (5.5, 8.0)
GROUP = 5


def lone_path(name: str, seed: int) -> dict[str, tuple[Waypoint, ...]]:
    """Draw the path of one target for a run of SECONDS.

    Args:
        name: book, person or bird.
        seed: seed of the path; the target has the true size that a world with that seed gives it.

    Raises:
        ConfigError: an unknown target.
    """
    if name not in LONE:
        raise ConfigError(f"unknown target '{name}'; the scenes to hold are: {choices(LONE)}")
    makers: dict[str, Callable[[np.random.Generator, float], list[Waypoint]]]
    makers = dict(zip(LONE, (_book, _person, _bird), strict=True))
    size = true_size(name, seed)
    return {name: tuple(makers[name](_rng(seed, name), size))}


def group_paths(kind: str, seed: int) -> dict[str, tuple[Waypoint, ...]]:
    """Draw the paths of five persons or birds that cross the fixed camera's view, all of them in it for some time.

    They are named as the kind, and kind2 to kind5 (`bird`, `bird2`, ...). Each has its own marker, whose id
    `cotarget.sim.targets.target.marker_of` gives.

    Args:
        kind: person or bird.
        seed: as in `lone_path`.

    Raises:
        ConfigError: an unknown kind.
    """
    if kind not in GROUPED:
        raise ConfigError(f"unknown kind '{kind}'; five at once there are of: {choices(GROUPED)}")
    makers = dict(zip(GROUPED, (_passing_persons, _passing_birds), strict=True))
    names = [kind, *(f"{kind}{i}" for i in range(2, GROUP + 1))]
    sizes = [true_size(name, seed) for name in names]
    paths = makers[kind](_rng(seed, f"five {kind}"), sizes)
    return {name: tuple(path) for name, path in zip(names, paths, strict=True)}


def _rng(seed: int, what: str) -> np.random.Generator:
    return np.random.default_rng((seed, PATHS, *what.encode()))


def _times() -> Array:
    return np.arange(BEGIN, END + KNOT_S / 2, KNOT_S)


def _waypoints(t: Array, x: Array) -> list[Waypoint]:
    return [(float(a), *map(float, b)) for a, b in zip(t, x, strict=True)]  # type: ignore[misc]


def _book(rng: np.random.Generator, size: float) -> list[Waypoint]:
    """Draw the path of a book that stands, is moved once to another place, and stands there."""
    while True:
        ends = np.array([_book_place(rng), _book_place(rng)])
        if BOOK_GOES[0] <= np.linalg.norm(ends[1] - ends[0]) <= BOOK_GOES[1]:
            break
    t, start, takes = _times(), rng.uniform(*BOOK_MOVED_AT), rng.uniform(*BOOK_TAKES)
    s = np.clip((t - start) / takes, 0.0, 1.0)
    done = s**3 * (10 - 15 * s + 6 * s**2)  # minimum jerk, the profile of a hand's motion
    return _waypoints(t, ends[0] + done[:, None] * (ends[1] - ends[0]))


def _book_place(rng: np.random.Generator) -> Array:
    distance, x, z = rng.uniform(*BOOK_RANGE), rng.uniform(-BOOK_ASIDE, BOOK_ASIDE), rng.uniform(*BOOK_HEIGHT)
    return np.array([x, np.sqrt(distance**2 - x**2 - (z - MOUNT[2]) ** 2), z])


def _along(line: Callable[[Array], Array], u0: float, speed: Array, t: Array) -> Array:
    """Follow a parametric line from u0 at time 0, with a speed [m/s] at each time t [s]; return positions (n, 3)."""
    u = u0 + np.linspace(-1.0, 1.0, 30001) * 30.0
    points = line(u)
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    way = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(t))])
    way += np.interp(u0, u, s) - np.interp(0.0, t, way)
    return np.stack([np.interp(way, s, points[:, k]) for k in range(3)], axis=1)


def _person(rng: np.random.Generator, size: float) -> list[Waypoint]:
    """Draw the path of a person who walks in from one side, then along a figure of eight about 10 m away."""
    t, side = _times(), float(rng.choice([-1.0, 1.0]))
    middle, deep = rng.uniform(*PERSON_MIDDLE), rng.uniform(0.65, 0.85)
    reach, phase = rng.uniform(2.4, 3.0), rng.uniform(-0.2, 0.2)
    edge = 0.52 * middle  # outside the fixed camera's view
    speed = rng.uniform(*PERSON_SPEED) * np.ones_like(t)
    enters = rng.uniform(*PERSON_ENTERS)

    def line(u: Array) -> Array:
        """Straight approach to the start of the figure, heading inwards, then the figure."""
        a = np.maximum(u, 0.0) + phase
        figure = np.stack([-side * reach * np.sin(a), middle + deep * np.sin(2 * a), np.zeros_like(a)], axis=1)
        ahead = np.array([-side * reach * np.cos(phase), 2 * deep * np.cos(2 * phase), 0.0])
        return figure + np.minimum(u, 0.0)[:, None] * ahead

    # Parameter at the view's edge, in units of the figure's first slope; it is reached at time ``enters``.
    passed = -(edge + reach * np.sin(phase)) / (reach * np.cos(phase))
    x = _along(line, passed, speed, t - enters)
    x[:, 2] = PERSON_HEIGHT / 2 * size
    return _waypoints(t, x)


def _bird(rng: np.random.Generator, size: float) -> list[Waypoint]:
    """Draw the path of a bird that circles about 25 m away, with turns of at least 10 m radius, always in view."""
    t = _times()
    for _ in range(TRIES):
        wide, deep = rng.uniform(10.2, 10.8, 2)
        distance, height = rng.uniform(*BIRD_CENTERS), rng.uniform(*BIRD_HEIGHTS)
        rise, rise_phase = rng.uniform(0.5, 2.0), rng.uniform(0, 2 * np.pi)
        turn, start = float(rng.choice([-1.0, 1.0])), rng.uniform(0, 2 * np.pi)
        drift, drift_phase = rng.uniform(-0.4, 0.4), rng.uniform(0, 2 * np.pi)
        mean, change, period = rng.uniform(*BIRD_SPEED), rng.uniform(0.0, 0.9), rng.uniform(5.0, 9.0)
        speed = mean + change * np.sin(2 * np.pi * t / period + drift_phase)

        def line(u: Array) -> Array:
            a = turn * u  # noqa: B023  used at once
            x = wide * np.cos(a) + drift * np.sin(0.3 * u + drift_phase)  # noqa: B023
            y = distance + deep * np.sin(a)  # noqa: B023
            return np.stack([x, y, height + rise * np.sin(a + rise_phase)], axis=1)  # noqa: B023

        x = _along(line, start, speed, t)
        if _turns_wide(x) and in_view(x, 0.5).all():
            return _waypoints(t, x)
    raise RuntimeError("no such path was drawn; the ranges above do not fit together")


def _turns_wide(x: Array) -> bool:
    """Check that a path sampled evenly in time keeps the least turning radius."""
    v, a = np.gradient(x, KNOT_S, axis=0), np.gradient(np.gradient(x, KNOT_S, axis=0), KNOT_S, axis=0)
    turning = np.linalg.norm(np.cross(v, a), axis=1)[3:-3]
    return bool((np.linalg.norm(v, axis=1)[3:-3] ** 3 > 1.01 * BIRD_RADIUS * turning).all())


def in_view(x: Array, half_size: float = 0.0) -> npt.NDArray[np.bool_]:
    """Check for each point (n, 3) that it is inside the fixed camera's view with a margin of ``half_size`` [m]."""
    across, ahead, up = _in_camera(x)
    inside = (np.abs(across) + half_size < VIEW_TAN[0] * ahead) & (np.abs(up) + half_size < VIEW_TAN[1] * ahead)
    return np.asarray(inside)


def _in_camera(x: Array) -> tuple[Array, Array, Array]:
    """Give coordinates to the right of, along and above the fixed camera's axis [m]."""
    right, y, z = (x - MOUNT).T
    c, s = np.cos(MOUNT_PITCH), np.sin(MOUNT_PITCH)
    return right, c * y + s * z, c * z - s * y


def _passing_persons(rng: np.random.Generator, sizes: list[float]) -> list[list[Waypoint]]:
    """Draw the paths of five persons who cross from either side at different depths, and meet in the middle."""
    return [
        _passing(rng, i, depth=9.4 + 0.9 * row, speed=rng.uniform(1.2, 1.55), z=PERSON_HEIGHT / 2 * size, bend=0.25)
        for i, (row, size) in enumerate(zip(rng.permutation(GROUP), sizes, strict=True))
    ]


def _passing_birds(rng: np.random.Generator, sizes: list[float]) -> list[list[Waypoint]]:
    """Draw the paths of five birds that cross from either side at different depths and heights."""
    return [
        _passing(rng, i, depth=21.0 + 2.0 * row, speed=rng.uniform(3.6, 4.8), z=rng.uniform(5.5, 9.5), bend=1.2)
        for i, row in enumerate(rng.permutation(GROUP))
    ]


def _passing(
    rng: np.random.Generator, number: int, depth: float, speed: float, z: float, bend: float
) -> list[Waypoint]:
    """Draw a slightly bent path across the view; successive targets start from alternate sides.

    Args:
        rng: source of the random differences.
        number: index of the target; each enters a little later than the one before.
        depth: distance along the ground [m].
        speed: speed along the path [m/s].
        z: height [m].
        bend: largest deviation from a straight line [m].
    """
    t, side = _times(), 1.0 if number % 2 else -1.0
    edge = 0.52 * (depth + bend)
    enters = 1.2 + 0.7 * number + rng.uniform(0.0, 0.4)
    phase = rng.uniform(0, 2 * np.pi)

    def line(u: Array) -> Array:
        x = side * (edge - edge * u)
        return np.stack([x, depth + bend * np.sin(2.0 * u + phase), np.full_like(u, z)], axis=1)

    return _waypoints(t, _along(line, 0.0, speed * np.ones_like(t), t - enters))
