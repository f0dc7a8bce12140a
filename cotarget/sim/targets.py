"""The simulated targets: where a book, a person or a bird is at a time, how its joints stand, and how large it is.

Paths are in the scene's world: z up, the fixed camera 1.6 m above the origin, looking along +y. Moving targets stay out
of the wide view while the background is learnt, then come in and stay in. The models are in sim_assets/targets.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from cotarget.errors import ConfigError, choices
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.simconfig import Waypoint

if TYPE_CHECKING:
    import mujoco

TARGETS = ("book", "person", "bird")

MOUNT = np.array([0.0, 0.0, 1.6])  # where the fixed camera is in every scene of sim_assets [m]
VIEW_EDGE = np.tan(np.radians(25.0))  # half the wide view's width at unit distance
PERSON_HEIGHT = 1.75  # of the model [m]
SCATTER = {"book": 0.0, "person": 0.04, "bird": 0.15}  # of the true sizes, relative; all within twice this
SCATTER_SIGMA = 0.5  # the range above is two standard deviations
PATH_SECONDS = 600.0  # paths loop for this long, then the target stands still
GRAVITY = 9.81  # [m/s^2]

STRIDE = 1.44  # length of two steps of a walking person 1.75 m tall [m]
WALK_SPEED = 1.5  # [m/s]
WING_BEAT_HZ = 4.0
WING_SWING = np.radians(35.0)  # amplitude of the inner wing
OUTER_SWING, OUTER_LAG = np.radians(24.0), np.radians(70.0)  # of the outer wing against the inner one


@dataclass(frozen=True)
class TargetPose:
    """Where a target is: its body's pose in the world, and each joint's angle [rad] by name."""

    T_world_target: RigidTransform
    joints: Mapping[str, float]


@dataclass(frozen=True)
class Path:
    """A smooth way through the world.

    Attributes:
        spline: position [m] as a function of time [s].
        length: distance travelled [m] as a function of time [s].
    """

    spline: CubicSpline
    length: CubicSpline

    def clip(self, t: float) -> float:
        """Hold the first and the last position outside the path's time."""
        return float(np.clip(t, self.spline.x[0], self.spline.x[-1]))

    def position(self, t: float) -> Array:
        """Position [m], (3,)."""
        return self.spline(self.clip(t))

    def velocity(self, t: float) -> Array:
        """Direction and speed of travel [m/s], (3,); while the target is held, a trace of how it moves just inside."""
        first, last = self.spline.x[0], self.spline.x[-1]
        inside = 1e-3 * (last - first)
        return self.spline(np.clip(t, first + inside, last - inside), 1)

    def acceleration(self, t: float) -> Array:
        """Acceleration [m/s^2], (3,)."""
        return self.spline(self.clip(t), 2)

    def travelled(self, t: float) -> float:
        """Distance since the path's start [m]."""
        return float(self.length(self.clip(t)))


@dataclass(frozen=True)
class Target:
    """One target of the simulated world.

    Attributes:
        name: also the name of the model's body.
        asset: file in sim_assets/targets.
        beat_s: period of its limbs' motion [s]; 0 for a rigid target.
        size: true size over the model's.
        path: where it goes.
        phase: where in its limbs' motion it starts [rad].
        grounded: whether its height follows from its size, because it stands on the ground.
    """

    name: str
    asset: str
    beat_s: float
    size: float
    path: Path = field(repr=False)
    phase: float = 0.0
    grounded: bool = False

    def pose(self, t: float) -> TargetPose:
        """Tell pose and joints at time ``t`` [s]."""
        if self.name == "book":
            return TargetPose(self._place(t, _face_mount(self.path.position(t), t, self.phase)), {})
        if self.name == "person":
            step = self.phase + 2 * np.pi * self.path.travelled(t) / (STRIDE * self.size)
            pace = float(np.linalg.norm(self.path.velocity(t))) / WALK_SPEED
            joints, bob = _walk(step, min(pace, 1.0))
            return TargetPose(self._place(t, _heading(self.path, t, flat=True), bob * self.size), joints)
        return TargetPose(self._place(t, _bank(self.path, t)), _flap(self.phase + 2 * np.pi * WING_BEAT_HZ * t))

    def _place(self, t: float, rotation: Rotation, lift: float = 0.0) -> RigidTransform:
        position = self.path.position(t) + np.array([0.0, 0.0, lift])
        if self.grounded:
            position[2] += 0.5 * PERSON_HEIGHT * self.size
        return RigidTransform.from_components(position, rotation)


def make_target(
    name: str, scene: str, rng: np.random.Generator, scatter: bool, waypoints: Sequence[Waypoint] | None = None
) -> Target:
    """Make one target.

    Args:
        name: one of TARGETS.
        scene: name or path of the scene; any but the built-in ones has the book and the person as indoors and the
            bird as outdoors.
        rng: source of the small differences between one run and the next; same seed, same path.
        scatter: whether the true size differs from what the pipeline is told.
        waypoints: [t, x, y, z] of the body's centre in the world [s, m] to go through instead.

    Raises:
        ConfigError: no such target, or waypoints that do not advance in time.
    """
    if name not in TARGETS:
        raise ConfigError(f"unknown target '{name}'; the simulation has: {choices(TARGETS)}")
    # Drawn whether used or not, so that no switch changes the path.
    size = 1.0 + SCATTER[name] * SCATTER_SIGMA * float(np.clip(rng.standard_normal(), -2.0, 2.0)) * scatter
    phase = float(rng.uniform(0.0, 2 * np.pi))
    make = {"book": _book_path, "person": _person_path, "bird": _bird_path}[name]
    path = make(scene, rng) if waypoints is None else waypoint_path(waypoints, f"sim.paths.{name}")
    beat_s = {"book": 0.0, "person": STRIDE / WALK_SPEED, "bird": 1 / WING_BEAT_HZ}[name]
    grounded = name == "person" and waypoints is None
    return Target(name, f"{name}.xml", beat_s, size, path, phase, grounded)


def scale_spec(spec: "mujoco.MjSpec", factor: float) -> None:
    """Make every length of a target's model ``factor`` times as large; do it before attaching."""
    for mesh in spec.meshes:
        mesh.scale = np.asarray(mesh.scale) * factor
    for geom in spec.geoms:
        geom.size = np.asarray(geom.size) * factor
        geom.pos = np.asarray(geom.pos) * factor
        geom.fromto = np.asarray(geom.fromto) * factor  # nan where it is not used
    for element in [*spec.bodies[1:], *spec.sites, *spec.joints]:
        element.pos = np.asarray(element.pos) * factor


# ---------------------------------------------------------------- paths


def waypoint_path(waypoints: Sequence[Waypoint], where: str = "waypoints") -> Path:
    """Lay a smooth path through [t, x, y, z], at rest at both ends.

    Raises:
        ConfigError: no waypoint, or times that do not increase.
    """
    table = np.asarray(waypoints, dtype=float)
    if table.ndim != 2 or table.shape[1] != 4 or not np.all(np.isfinite(table)):
        raise ConfigError(f"{where}: needs at least one waypoint [t, x, y, z]")
    if np.any(np.diff(table[:, 0]) <= 0):
        raise ConfigError(f"{where}: the waypoints' times must increase")
    if len(table) == 1:
        table = np.vstack([table, table + np.array([1.0, 0.0, 0.0, 0.0])])
    return _measured(CubicSpline(table[:, 0], table[:, 1:], bc_type="clamped"))


def _measured(spline: CubicSpline) -> Path:
    """Add the distance travelled to a path."""
    first, last = spline.x[0], spline.x[-1]
    t = np.linspace(first, last, max(int((last - first) / 0.05), 50))
    speed = np.linalg.norm(spline(t, 1), axis=1)
    return Path(spline, CubicSpline(t, speed).antiderivative())


def _loop_path(
    loop: Array,
    speed: float,
    spacing: float,
    soften: float,
    lead_in: float = 0.0,
    edge: tuple[float, float] | None = None,
) -> Path:
    """Go round a closed line for ever at constant speed, where wanted after a straight way in.

    Args:
        loop: closed line, first point not repeated, [m], (N, 3).
        speed: [m/s].
        spacing: between the path's knots [m].
        soften: scale over which curvature is evened out [m].
        lead_in: length of the straight way in, tangent to the loop at its first point [m].
        edge: time [s] at which the target shall pass the coordinate x [m] of its way in.
    """
    count = int(PATH_SECONDS * speed / spacing)
    line = _even(np.vstack([loop, loop[:1]]), spacing)[:-1]
    start = line[1] - line[-1]
    start = start / np.linalg.norm(start)
    laps = np.tile(line, (count // len(line) + 2, 1))
    straight = line[0] - start * np.arange(int(lead_in / spacing), 0, -1)[:, None] * spacing
    points = gaussian_filter1d(np.vstack([straight, laps]), soften / spacing, axis=0, mode="nearest")[:count]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    t = s / speed
    if edge is not None:
        time, x = edge
        way_in = points[: len(straight) + 1, 0]
        inward = np.sign(way_in[-1] - way_in[0])
        t = t + time - np.interp(inward * x, inward * way_in, t[: len(straight) + 1])
    return _measured(CubicSpline(t, points))


def _even(points: Array, spacing: float) -> Array:
    """Sample a line evenly, about ``spacing`` apart, both ends kept."""
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0.0, s[-1], round(s[-1] / spacing) + 1)
    return np.stack([np.interp(at, s, points[:, k]) for k in range(3)], axis=1)


def _angles(count: int = 720) -> Array:
    return np.linspace(0.0, 2 * np.pi, count, endpoint=False)


def _book_path(scene: str, rng: np.random.Generator) -> Path:
    """Carry the book slowly round an ellipse about 10 m away, in view from the start."""
    a, phase = _angles(), rng.uniform(0, 2 * np.pi)
    wide, deep, high = rng.uniform(1.2, 1.6), rng.uniform(0.3, 0.5), rng.uniform(0.25, 0.4)
    center = np.array([rng.uniform(-0.3, 0.3), rng.uniform(9.8, 10.2), rng.uniform(1.5, 1.7)])
    tilt = rng.uniform(0, 2 * np.pi)
    shape = [wide * np.cos(a + phase), deep * np.sin(a + phase), high * np.sin(a + phase + tilt)]
    return _loop_path(center + np.stack(shape, axis=1), rng.uniform(0.22, 0.28), 0.05, 0.1)


def _person_path(scene: str, rng: np.random.Generator) -> Path:
    """Walk in from one side at about 1.5 m/s, then weave a figure of eight; z is the ground's."""
    # Outdoors the camera looks up: nearer than 13 m it does not see the feet.
    near, reach, deep = (13.4, 4.4, 2.2) if scene == "outdoor" else (8.95, 2.65, 1.0)
    side = rng.choice([-1.0, 1.0])
    a = _angles() - np.pi / 4  # starts at the nearest point of the figure's first half, heading inwards
    reach, deep = reach * rng.uniform(0.94, 1.0), deep * rng.uniform(0.9, 1.05)
    figure = np.stack([-side * reach * np.sin(a), near + deep + deep * np.sin(2 * a), np.zeros_like(a)], axis=1)
    edge = (rng.uniform(2.7, 3.0), side * VIEW_EDGE * near)
    return _loop_path(figure, rng.uniform(1.42, 1.55), 0.15, 0.25, 14.0, edge)


def _bird_path(scene: str, rng: np.random.Generator) -> Path:
    """Fly in from one side at about 5 m/s, then round after round; indoors a smaller and slower round.

    Rounds are two half circles and two straights across the view, so that the bird shows its side most of the time.
    """
    a = _angles()
    side = rng.choice([-1.0, 1.0])
    if scene == "indoor":
        radius, across, near, height, rise, speed, soften = rng.uniform(2.0, 2.2), 0.8, 7.4, 2.3, 0.25, 2.9, 0.5
    else:
        radius, across, near, height, rise, speed, soften = rng.uniform(2.5, 2.8), 4.4, 19.4, 7.8, 1.6, 5.0, 0.6
    height += 0.3 * rise * rng.uniform(-1, 1)
    start, lift = rng.uniform(0, 2 * np.pi), rise * rng.uniform(0.7, 1.0)
    x = side * (radius * np.sin(a) + across * np.where(a < np.pi, 1.0, -1.0))
    y = near + radius * (1 - np.cos(a))
    flat = _even(np.stack([[*x, x[0]], [*y, y[0]], np.zeros(len(a) + 1)], axis=1), 0.02)[:-1]
    flat[:, 2] = height + lift * np.sin(start + _angles(len(flat)))
    speed *= rng.uniform(0.96, 1.04)
    edge = (rng.uniform(2.4, 2.8), -side * VIEW_EDGE * near)
    return _loop_path(flat, speed, 0.1 * speed, soften, 8.0 * speed, edge)


# ---------------------------------------------------------------- attitude and gait


def _heading(path: Path, t: float, flat: bool) -> Rotation:
    """Turn x along the way, z as far up as that allows; whoever stands still faces the camera."""
    to_mount = MOUNT - path.position(t)
    forward = path.velocity(t)
    forward = forward / max(float(np.linalg.norm(forward)), 1e-9) if np.linalg.norm(forward) > 1e-9 else to_mount
    if flat:
        forward = forward * np.array([1.0, 1.0, 0.0])
    if np.hypot(forward[0], forward[1]) < 1e-9:
        forward = forward + np.array([0.0, -1e-6, 0.0])
    forward = forward / np.linalg.norm(forward)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left = left / np.linalg.norm(left)
    return Rotation.from_matrix(np.stack([forward, left, np.cross(forward, left)], axis=1))


def _face_mount(position: Array, t: float, phase: float) -> Rotation:
    """Turn the book's cover to the camera, swinging a few degrees."""
    x, y, z = MOUNT - position
    yaw = np.arctan2(y, x) + np.radians(7.0) * np.sin(0.55 * t + phase)
    pitch = -np.arctan2(z, np.hypot(x, y)) + np.radians(4.0) * np.sin(0.40 * t + 2.0 * phase)
    roll = np.radians(4.0) * np.sin(0.31 * t + 3.0 * phase)
    return Rotation.from_euler("ZYX", [yaw, pitch, roll])


def _bank(path: Path, t: float) -> Rotation:
    """Lean the bird into its turn, as far as the turn's acceleration asks for."""
    upright = _heading(path, t, flat=False)
    lateral = float(upright.inv().apply(path.acceleration(t))[1])
    return upright * Rotation.from_euler("x", -np.arctan2(lateral, GRAVITY))


def _walk(step: float, pace: float) -> tuple[dict[str, float], float]:
    """Swing limbs at a phase of the stride; ``pace`` from 0, standing, to 1.

    Returns:
        Joint angles [rad], and how far the hips rise or sink [m].
    """
    joints = {}
    for side, phase in (("left", step), ("right", step + np.pi)):
        swing = 0.5 - 0.5 * np.cos(phase + 0.5 * np.pi)  # 1 while the leg comes forward
        joints[f"hip_{side}"] = pace * (0.06 + 0.42 * np.sin(phase))
        joints[f"knee_{side}"] = pace * (0.08 + 0.85 * swing**2 * (0.5 + 0.5 * np.cos(phase + 0.2)))
        joints[f"shoulder_{side}"] = pace * -0.40 * np.sin(phase) + 0.02
        joints[f"elbow_{side}"] = 0.15 + pace * (0.25 - 0.18 * np.sin(phase))
    return joints, pace * (-0.028 + 0.018 * np.cos(2 * step))


def _flap(beat: float) -> dict[str, float]:
    """Beat the wings; the outer part follows late."""
    inner = 0.10 + WING_SWING * np.sin(beat)
    outer = -0.06 + OUTER_SWING * np.sin(beat - OUTER_LAG)
    return {
        "wing_inner_left": inner,
        "wing_inner_right": inner,
        "wing_outer_left": outer,
        "wing_outer_right": outer,
    }
