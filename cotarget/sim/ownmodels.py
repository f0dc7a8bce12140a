"""Targets of a user's own: a mesh, or an MJCF file with one body, as the model of what flies or walks by."""

from pathlib import Path

import numpy as np

from cotarget.errors import ConfigError
from cotarget.sim.opengl import mujoco

GREY = (0.55, 0.55, 0.55, 1.0)  # of a mesh without a picture beside it


def own_model(path: Path, kind: str) -> "mujoco.MjSpec":
    """Read a target's model: lengths in metres, x forward, y left, z up, the origin where its path leads.

    Args:
        path: a mesh (.obj, .stl), whose texture is the .png of the same name beside it, if there is one; or an MJCF
            file (.xml) with one body in its worldbody.
        kind: the target's name without a number, which becomes the body's.

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
        body = bodies[0]
        body.name, body.mocap = kind, True
        for joint in list(body.joints):  # it goes where its path leads
            spec.delete(joint)
        body.pos, body.quat = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = 0
        spec.compile()
    except ValueError as error:
        raise ConfigError(f"{path}: is not a target's model: {' '.join(str(error).split())}") from None
    return spec


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
