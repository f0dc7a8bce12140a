"""Outdoor clutter: foliage that sways in the wind, drifting clouds, shadows on the ground, and changing light.

Everything is a function of the seed and of time alone. A scene's trees and bushes sway if their geoms' names begin with
one of SWAYING. Clouds, shadows, saplings and twigs are added to the scene. Lengths are in metres; the world's axes are
those of `cotarget.sim.targets.paths`.
"""

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

from cotarget.geometry import Array, Rotation
from cotarget.sim.render.opengl import mujoco

if TYPE_CHECKING:
    import numpy.typing as npt


INDOORS = ("indoor",)  # scenes without weather
SWAYING = ("crown_", "bush_", "clutter/crown_")
LAYOUT, MOTION = 4, 5  # random streams, separate from the world's others
TWIG, SHADE, CLOUD = "clutter/twig_", "clutter/shade_", "clutter/cloud_"
TWIGS_A_TREE = 2
TWIG_SIZE = (0.22, 0.42)  # half a side; 3 to 6 px in the fixed camera at 50 m
TWIG_SWAY, TWIG_HZ = (0.06, 0.15), (0.4, 1.0)  # amplitude, frequency
LEAF = (0.20, 0.28, 0.11, 1.0)
SAPLINGS = ((-8.6, 21.0), (-5.6, 25.0), (6.4, 23.0), (9.4, 20.0))  # x, y; beside and behind the targets' paths
SAPLING_HEIGHT = (2.4, 3.2)
HAZE_SIZE = 128  # size of the textures of clouds and shadows [px]
CLOUDS, CLOUD_ALPHA, CLOUD_SPEED = 6, 0.5, (0.6, 1.8)  # speed [m/s]; 3 to 9 px/s in the fixed camera
SHADES, SHADE_ALPHA, SHADE_SPEED, SHADE_RANGE = 6, 0.30, (1.0, 3.0), (11.0, 45.0)  # [m/s], [m]
SHADE_LIFT = 0.03  # height over the ground, so that the ground does not show through
VIEW_WIDTH = 0.62  # half the width that clouds and shadows cross, at unit distance; beyond the fixed camera's edge
SWAY = math.radians(0.5)  # amplitude of a crown 5 m high or more; lower ones sway more, ...
SWAY_HEIGHT, MOST_SWAY = 5.0, 3.0  # ... by the ratio of this to their height [m], up to this factor
SWAY_HZ = (0.2, 0.5)
GUST_S = 7.0  # period of the wind's strength
LIGHT_WAVE, LIGHT_WAVE_S = 0.05, 9.0  # slow change of the sun's brightness, relative, and its period
LIGHT_DROP, LIGHT_DROP_S, LIGHT_DROP_STEEPNESS = 0.20, 13.0, 6.0  # a cloud before the sun, within half a second


def add_clutter(spec: "mujoco.MjSpec", seed: int) -> None:
    """Add clouds, shadows, saplings and twigs to a scene's spec; they are static until `Clutter` moves them."""
    rng = np.random.default_rng((seed, LAYOUT))
    _add_saplings(spec, rng)
    _add_twigs(spec, rng)
    _add_haze(spec, rng, "clutter/shade", 0, SHADE_ALPHA)
    for i in range(SHADES):
        y = float(rng.uniform(*SHADE_RANGE))
        half = [float(rng.uniform(1.2, 4.0)), float(rng.uniform(0.8, 2.5)), 0.0]
        pos = [float(rng.uniform(-1, 1)) * VIEW_WIDTH * y, y, SHADE_LIFT + 0.005 * i]
        _add_sheet(spec, f"{SHADE}{i}", pos, half, "clutter/shade")
    _add_haze(spec, rng, "clutter/cloud", 255, CLOUD_ALPHA)
    for i in range(CLOUDS):
        y, z = float(rng.uniform(120.0, 170.0)), float(rng.uniform(0.25, 0.55))
        half = [float(rng.uniform(12.0, 24.0)), 0.0, float(rng.uniform(4.0, 8.0))]
        pos = [float(rng.uniform(-1, 1)) * VIEW_WIDTH * y, y, z * y]
        _add_sheet(spec, f"{CLOUD}{i}", pos, half, "clutter/cloud")


def _add_haze(spec: "mujoco.MjSpec", rng: np.random.Generator, name: str, grey: int, alpha: float) -> None:
    """Add a material of one grey level whose opacity is an irregular patch that fades out to its border."""
    v, u = np.mgrid[-1 : 1 : HAZE_SIZE * 1j, -1 : 1 : HAZE_SIZE * 1j]
    rough = cv2.resize(rng.random((9, 9)), (HAZE_SIZE, HAZE_SIZE), interpolation=cv2.INTER_CUBIC)
    density = np.clip(2.2 * (rough - 0.9 * np.hypot(u, v)) + 0.9, 0.0, 1.0) * np.clip(3 - 3 * np.hypot(u, v), 0.0, 1.0)
    pixels = np.full((HAZE_SIZE, HAZE_SIZE, 4), grey, dtype=np.uint8)
    pixels[..., 3] = np.rint(255 * alpha * density)
    kind = mujoco.mjtTexture.mjTEXTURE_2D
    texture = spec.add_texture(name=name, type=kind, width=HAZE_SIZE, height=HAZE_SIZE, nchannel=4)
    texture.data = pixels.tobytes()
    material = spec.add_material(name=name, rgba=(1.0, 1.0, 1.0, 0.99), emission=1.0, specular=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB.value] = name


def _add_sheet(spec: "mujoco.MjSpec", name: str, pos: list[float], half: list[float], material: str) -> None:
    """Add a rectangle with given half sides; its normal is the side that is 0, towards -y (upright) or up (flat)."""
    first, second = (np.array(half) * axis for axis in ([1, 0, 0], [0, 1, 1]))
    mesh = spec.add_mesh(name=name)
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    mesh.uservert = np.concatenate([-first - second, first - second, first + second, second - first])
    mesh.userface = [0, 1, 2, 0, 2, 3]
    mesh.usertexcoord = [0, 0, 1, 0, 1, 1, 0, 1]
    _add_mesh(spec, name, name, pos, material=material, castshadow=False)


def _add_mesh(spec: "mujoco.MjSpec", name: str, mesh: str, pos: list[float] | Array, **more: object) -> None:
    """Add a geom that is drawn and does not collide."""
    kind = mujoco.mjtGeom.mjGEOM_MESH
    spec.worldbody.add_geom(name=name, type=kind, meshname=mesh, pos=pos, contype=0, conaffinity=0, **more)


def _add_saplings(spec: "mujoco.MjSpec", rng: np.random.Generator) -> None:
    """Add young firs where the scene has the outdoor scene's materials."""
    if spec.material("outdoor_needles") is None or spec.material("outdoor_bark") is None:
        return
    for i, (x, y) in enumerate(SAPLINGS):
        height = float(rng.uniform(*SAPLING_HEIGHT))
        mesh = spec.add_mesh(name=f"clutter/crown_{i}", file="tree_conifer.obj")
        mesh.scale = [0.6 * height, 0.6 * height, 0.85 * height]
        spec.worldbody.add_geom(
            name=f"clutter/trunk_{i}",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            fromto=[x, y, 0, x, y, 0.5 * height],
            size=[0.03, 0, 0],
            material="outdoor_bark",
            contype=0,
            conaffinity=0,
        )
        name = f"clutter/crown_{i}"
        _add_mesh(spec, name, name, [x, y, 0.15 * height], material="outdoor_needles")


def _add_twigs(spec: "mujoco.MjSpec", rng: np.random.Generator) -> None:
    """Add twigs at the leaves of every crown that faces the fixed camera."""
    model = spec.copy().compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for number, geom in enumerate(_named(model, SWAYING[:1]).tolist()):
        if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH:
            continue
        mesh = model.geom_dataid[geom]
        start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        leaves = model.mesh_vert[start : start + count] @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        middle, half = _extent(model, data, geom)
        shown = leaves[(leaves[:, 2] > middle[2] - 0.4 * half[2]) & (leaves[:, 1] < middle[1])]
        for j in range(TWIGS_A_TREE if len(shown) else 0):
            at = rng.choice(shown)
            name = f"{TWIG}{number}_{j}"
            points = rng.normal(size=(12, 3)) * [1.0, 1.0, 0.7]
            points *= rng.uniform(*TWIG_SIZE) / np.abs(points).max()
            mesh = spec.add_mesh(name=name)
            mesh.uservert = points.ravel()
            _add_mesh(spec, name, name, at, rgba=LEAF)


def _named(model: "mujoco.MjModel", prefixes: tuple[str, ...]) -> "npt.NDArray[np.intp]":
    """Find the ids of the geoms whose names begin with one of the prefixes."""
    return np.array([g for g in range(model.ngeom) if model.geom(g).name.startswith(prefixes)], dtype=np.intp)


def _extent(model: "mujoco.MjModel", data: "mujoco.MjData", geom: int) -> tuple[Array, Array]:
    """Give the centre of a geom's box in the world and half its sides [m], (3,) each."""
    axes = data.geom_xmat[geom].reshape(3, 3)
    middle = data.geom_xpos[geom] + axes @ model.geom_aabb[geom, :3]
    return middle, np.abs(axes) @ model.geom_aabb[geom, 3:]


class Clutter:
    """Motion of everything that sways or drifts in a compiled world."""

    def __init__(self, model: "mujoco.MjModel", seed: int) -> None:
        """Find the moving geoms and draw the parameters of their motion.

        Args:
            model: the compiled world.
            seed: seed of the random parameters.
        """
        rng = np.random.default_rng((seed, MOTION))
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        self._crowns = _named(model, SWAYING)
        extents = [_extent(model, data, geom) for geom in self._crowns.tolist()]
        count = len(extents)
        middle = np.array([m for m, _ in extents]).reshape(count, 3)
        half = np.array([h for _, h in extents]).reshape(count, 3)
        self._pivot = middle - half * [0.0, 0.0, 1.0]
        self._arm = data.geom_xpos[self._crowns] - self._pivot
        self._axes = data.geom_xmat[self._crowns].reshape(-1, 3, 3)
        height = np.maximum(2 * half[:, 2], 1e-3)
        self._sway = SWAY * np.minimum(np.maximum(SWAY_HEIGHT / height, 1.0), MOST_SWAY)
        self._sway_rate = 2 * np.pi * rng.uniform(*SWAY_HZ, (3, count))
        self._sway_phase = rng.uniform(0, 2 * np.pi, (3, count))

        self._twigs = _named(model, (TWIG,))
        many = len(self._twigs)
        self._twig_home = np.array(data.geom_xpos[self._twigs])
        self._twig_reach = rng.uniform(*TWIG_SWAY, (many, 3))
        self._twig_rate = 2 * np.pi * rng.uniform(*TWIG_HZ, (many, 3))
        self._twig_phase = rng.uniform(0, 2 * np.pi, (many, 3))

        self._drifting = _named(model, (SHADE, CLOUD))
        self._home = np.array(data.geom_xpos[self._drifting])
        speeds = [CLOUD_SPEED if model.geom(g).name.startswith(CLOUD) else SHADE_SPEED for g in self._drifting.tolist()]
        self._speed = np.array([rng.uniform(*each) for each in speeds]) * rng.choice([-1.0, 1.0])
        self._span = VIEW_WIDTH * self._home[:, 1] + 25.0

        self._sun = int(np.argmax(model.light_diffuse.sum(axis=1))) if model.nlight else -1
        self._sunlight = np.array(model.light_diffuse[self._sun]) if model.nlight else np.zeros(3)
        self._light_phase, self._drop_phase, self._gust_phase = rng.uniform(0, 2 * np.pi, 3)
        self.faint = self._drifting  # no sharp edges, so that exposure blur does not change them

    def move(self, data: "mujoco.MjData", t: float) -> None:
        """Move everything to time t [s]; call it after the kinematics, which would undo it."""
        gust = 0.65 + 0.35 * math.sin(2 * math.pi * t / GUST_S + self._gust_phase)
        wave = np.sin(self._sway_rate * t + self._sway_phase)
        lean = self._sway * gust * (0.6 * wave[0] + 0.4 * wave[1])
        turn = np.stack([0.5 * self._sway * gust * wave[2], lean, np.zeros_like(lean)], axis=1)
        R = Rotation.from_rotvec(turn).as_matrix() if len(turn) else np.zeros((0, 3, 3))
        data.geom_xpos[self._crowns] = self._pivot + np.einsum("nij,nj->ni", R, self._arm)
        data.geom_xmat[self._crowns] = (R @ self._axes).reshape(-1, 9)
        flutter = self._twig_reach * np.sin(self._twig_rate * t + self._twig_phase)
        data.geom_xpos[self._twigs] = self._twig_home + gust * flutter
        x = self._home[:, 0] + self._speed * t
        data.geom_xpos[self._drifting, 0] = (x + self._span) % (2 * self._span) - self._span

    def light(self, model: "mujoco.MjModel", t: float) -> None:
        """Set the sun's brightness at time t [s]."""
        if self._sun < 0:
            return
        wave = LIGHT_WAVE * math.sin(2 * math.pi * t / LIGHT_WAVE_S + self._light_phase)
        cloud = math.tanh(LIGHT_DROP_STEEPNESS * math.sin(2 * math.pi * t / LIGHT_DROP_S + self._drop_phase))
        model.light_diffuse[self._sun] = self._sunlight * (1 + wave - LIGHT_DROP * (0.5 + 0.5 * cloud))
