"""What both cameras see of a target over an episode, prepared for all of its frames.

The fixed camera's boxes are exact. The zoom camera's are prepared for a head that points at the target: they move with
the target's centre where it points a little aside. The target's points are those of `cotarget.sim.truth.Outlines`; what
hides a target is not considered.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cotarget.config import RigConfig, TargetProfile, Waypoint
from cotarget.evaluation import true_calibration
from cotarget.geometry import Array
from cotarget.pantilt import base_heads, closed_form
from cotarget.sim.model import base_pose
from cotarget.sim.targets.target import Target, make_target, target_rng
from cotarget.sim.truth import EVERY, PHASES, outermost
from cotarget.sim.world import SimWorld

KNOT_S = 0.2  # interval of the sizes over a wing beat, which change with the attitude alone [s]


class Appearance(NamedTuple):
    """A target in both cameras over an episode.

    Attributes:
        box: left, top, right and bottom in each fixed frame, (frames, 4) [px]; nan behind the camera.
        x_base: its centre in the base's frame at each zoom frame's time, (frames, 3) [m].
        extent: left, top, right and bottom less the centre, in tangents at the zoom camera, (frames, 4).
        size: its wanted dimension, in tangents at the zoom camera, (frames,).
    """

    box: Array
    x_base: Array
    extent: Array
    size: Array


class Stage:
    """A rig's geometry, before which targets appear.

    Attributes:
        config: the rig without targets.
        world: a world of it without targets.
    """

    def __init__(self, config: RigConfig, name: str, seconds: float, target: TargetProfile) -> None:
        """Build the world.

        Args:
            config: the rig.
            name: name of the target.
            seconds: length of an episode [s].
            target: the target's profile.
        """
        self.config = replace(config, sim=replace(config.sim, targets=(), paths={}))
        self.world = SimWorld(self.config, rendered=())
        truth = self.world.truth()
        self._name, self._target, self._head = name, target, true_calibration(self.world).zoom_head
        self._lens, self._T_world_fixed = truth.fixed_lens, truth.T_world_fixed.as_matrix()
        self._T_world_base = base_pose(truth.T_world_fixed, config.sim).as_matrix()
        rates = config.sim.fixed.rate_hz, config.sim.zoom.rate_hz
        # The first frame is that of the reset; the zoom camera may be a frame ahead of the fixed one.
        self._times, self._zoom_times = (np.arange(math.ceil(seconds * rate) + 2) / rate for rate in rates)

    def appearance(self, path: tuple[Waypoint, ...], seed: int) -> Appearance:
        """Prepare what both cameras see of a target on a path, of the size that a world of a seed gives it."""
        sim = self.config.sim
        own = sim.models.get(self._name)
        rng = target_rng(seed, self._name)
        target = make_target(self._name, sim.scene, rng, sim.effects.scatter, path, own)
        points = outermost(target.kind.name, target.kind.own) * target.size
        place, axes, phase = stances(target, self._times)
        x_world = np.einsum("nij,njk->nki", axes, points[phase]) + place[:, None]
        pixels = self._lens.project((x_world - self._T_world_fixed[:3, 3]) @ self._T_world_fixed[:3, :3])
        box = np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=1)
        if not np.array_equal(self._times, self._zoom_times):
            place, axes, phase = stances(target, self._zoom_times)
            x_world = np.einsum("nij,njk->nki", axes, points[phase]) + place[:, None]
        eye, turn, x_base = self._looking_at(place)
        tangents = _tangents(x_world, eye, turn)
        low, high, center = tangents.min(axis=1), tangents.max(axis=1), tangents[:, -1]
        extent = np.concatenate([low - center, high - center], axis=1)
        if self._target.largest_over_time:
            return Appearance(box, x_base, extent, self._over_beat(points, place, axes, eye, turn))
        sides = _upright(tangents, np.einsum("nij,nj->ni", turn, axes[:, :, 2]))
        return Appearance(box, x_base, extent, sides[:, 1 if self._target.is_vertical() else 0])

    def _over_beat(self, points: Array, place: Array, axes: Array, eye: Array, turn: Array) -> Array:
        """Larger side over a wing beat at each zoom frame, by some of them, in tangents, (n,)."""
        every = max(round(KNOT_S * self.config.sim.zoom.rate_hz), 1)
        knots = np.append(np.arange(0, len(place) - 1, every), len(place) - 1)
        up = turn[knots][:, :, 2]  # the world's vertical
        sides = []
        for phase in points[::EVERY]:
            x_world = np.einsum("nij,jk->nki", axes[knots], phase) + place[knots, None]
            sides.append(_upright(_tangents(x_world, eye[knots], turn[knots]), up).max(axis=1))
        return np.interp(np.arange(len(place)), knots, np.max(sides, axis=0))

    def _looking_at(self, x_world: Array) -> tuple[Array, Array, Array]:
        """Where the zoom camera is and how it is turned when it points at points (n, 3).

        Returns:
            Its place (n, 3) and the rotation from the world to its axes (n, 3, 3), and the points in the base's frame,
            (n, 3) [m].
        """
        R_world_base, t_world_base = self._T_world_base[:3, :3], self._T_world_base[:3, 3]
        x_base = (x_world - t_world_base) @ R_world_base
        T = self._head.hand_eye().as_matrix()
        ray, lever = np.broadcast_to(T[:3, 2:3], (3, len(x_base))), np.broadcast_to(T[:3, 3:], (3, len(x_base)))
        pan, tilt, _ = closed_form(tuple(x_base.T), ray, lever, self._head.axes)
        turns, places, _ = base_heads(self._head.axes, pan, tilt)
        R_world_zoom = R_world_base @ turns @ T[:3, :3]
        eye = (turns @ T[:3, 3] + places) @ R_world_base.T + t_world_base
        return eye, np.swapaxes(R_world_zoom, 1, 2), x_base


def stances(target: Target, times: Array) -> tuple[Array, Array, Array]:
    """Positions (n, 3), axes as columns (n, 3, 3) and nearest phases of the limb cycle (n,) of a target at times."""
    places, axes, phases = [], [], []
    for t in times.tolist():
        beat = target.kind.beat(target, t)
        place, turned, _ = target.kind.stance(target, t, beat)
        places.append(place)
        axes.append(turned)
        phases.append(round(beat / (2 * math.pi) * PHASES) % PHASES)
    return np.array(places), np.swapaxes(np.array(axes), 1, 2), np.array(phases)


def _tangents(x_world: Array, eye: Array, turn: Array) -> Array:
    """Tangents of points (n, k, 3) at cameras, (n, k, 2)."""
    x_camera = (x_world - eye[:, None]) @ np.swapaxes(turn, 1, 2)
    return np.asarray(x_camera[..., :2] / x_camera[..., 2:])


def _upright(tangents: Array, up: Array) -> Array:
    """Width and height of points (n, k, 2) across and along a direction in the camera's frame (n, 3), (n, 2)."""
    direction = up[:, :2] / np.hypot(up[:, 0], up[:, 1])[:, None]
    u, v = direction[:, 0, None], direction[:, 1, None]
    across = v * tangents[..., 0] - u * tangents[..., 1]
    along = u * tangents[..., 0] + v * tangents[..., 1]
    return np.stack([np.ptp(across, axis=1), np.ptp(along, axis=1)], axis=1)
