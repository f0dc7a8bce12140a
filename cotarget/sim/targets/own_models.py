"""Targets of a user's own: a mesh, or an MJCF file with one body, as the model of what flies or walks by."""

from pathlib import Path

import numpy as np

from cotarget.errors import ConfigError, choices
from cotarget.sim.render.opengl import mujoco

GREY = (0.55, 0.55, 0.55, 1.0)  # of a mesh without a picture beside it
SHAPES = ("box", "capsule", "cylinder", "ellipsoid", "mesh", "sphere")  # whose outline is known


def own_model(path: Path, kind: str, hidden: int) -> "mujoco.MjSpec":
    """Read a target's model: lengths in metres, x forward, y left, z up, the origin where its path leads.

    It goes where its path leads and is rigid: of the file, bodies and what they look like count.

    Args:
        path: a mesh (.obj, .stl), whose texture is the .png of the same name beside it, if there is one; or an MJCF
            file (.xml) with one body in its worldbody.
        kind: the target's name without a number, which becomes the body's.
        hidden: the first of the groups of geoms that are not drawn, where models keep what collides.

    Raises:
        ConfigError: it cannot be read, or is no such model.
    """
    if not path.is_file():
        raise ConfigError(f"sim.models.{kind}: {path}: no such file; give the path of a mesh or an MJCF file")
    try:
        spec = mujoco.MjSpec.from_file(str(path.absolute())) if path.suffix == ".xml" else _of_mesh(path.absolute())
        bodies = list(spec.worldbody.bodies)
        if len(bodies) != 1:
            raise ConfigError(
                f"{path}: has {len(bodies)} bodies in its worldbody; a target is one, with its parts in it"
            )
        _stiffen(spec)
        _keep_drawn(spec, path, hidden)
        body = bodies[0]
        body.name, body.mocap = kind, True
        body.pos, body.quat = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
        spec.compile()
    except ValueError as error:
        raise ConfigError(f"{path}: is not a target's model: {' '.join(str(error).split())}") from None
    return spec


def _stiffen(spec: "mujoco.MjSpec") -> None:
    """Delete the joints, and before them all that may refer to one or to what it moves."""
    for parts in ("keys", "actuators", "sensors", "tendons", "equalities", "excludes", "pairs", "tuples", "joints"):
        for part in list(getattr(spec, parts)):
            spec.delete(part)


def _keep_drawn(spec: "mujoco.MjSpec", path: Path, hidden: int) -> None:
    """Delete the geoms that nobody sees; the others touch nothing.

    Raises:
        ConfigError: there are no others, or one has no outline.
    """
    for geom in list(spec.geoms):
        geom.contype = geom.conaffinity = 0
        shape = mujoco.mjtGeom(geom.type).name.removeprefix("mjGEOM_").lower()
        if geom.group >= hidden:
            spec.delete(geom)
        elif shape not in SHAPES:
            raise ConfigError(f"{path}: has a geom of type {shape}; what a target is made of is: {choices(SHAPES)}")
    if not list(spec.geoms):
        raise ConfigError(f"{path}: shows nothing: it has no geom of the groups 0 to {hidden - 1}")


def _of_mesh(path: Path) -> "mujoco.MjSpec":
    """A body that is a mesh."""
    spec = mujoco.MjSpec()
    # A surface need not enclose anything.
    spec.add_mesh(name="mesh", file=str(path), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    geom = spec.worldbody.add_body().add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh", rgba=np.array(GREY))
    if (picture := path.with_suffix(".png")).is_file():
        spec.add_texture(name="picture", type=mujoco.mjtTexture.mjTEXTURE_2D, file=str(picture))
        material = spec.add_material(name="picture", specular=0.1)
        material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "picture"
        geom.material, geom.rgba = "picture", np.ones(4)
    return spec
