"""MuJoCo models of the targets: those of the kinds, and a user's own from a mesh or an MJCF file with one body."""

from pathlib import Path

import numpy as np

from cotarget.errors import ConfigError, choices
from cotarget.files import assets_dir
from cotarget.sim.render.opengl import mujoco
from cotarget.sim.targets.target import Target, marker_of

GREY = (0.55, 0.55, 0.55, 1.0)  # colour of a mesh without a texture
LARGEST_M = 200.0  # of a target's part; a larger one is a model in millimetres
SHAPES = ("box", "capsule", "cylinder", "ellipsoid", "mesh", "sphere")  # geom types with a known outline


def kind_model(kind: str) -> "mujoco.MjSpec":
    """Read the model of a kind of target, in its nominal size and with the marker of the first of its kind."""
    return mujoco.MjSpec.from_file(str(assets_dir() / "targets" / f"{kind}.xml"))


def target_model(target: Target, hidden: int) -> "mujoco.MjSpec":
    """Read a target's model, in its true size and with its own marker.

    Args:
        target: the target.
        hidden: first group of geoms that are not drawn; a user's model keeps collision geoms there.

    Raises:
        ConfigError: a user's file is no target's model.
    """
    kind = target.kind
    if kind.own is not None:
        return own_model(kind.own, kind.name, hidden)
    spec = kind_model(kind.name)
    scale_spec(spec, target.size)
    if (marker := marker_of(target.name)) != kind.marker:
        spec.texture(f"{kind.name}_marker").file = f"{kind.name}_marker_{marker}.png"
    return spec


def scale_spec(spec: "mujoco.MjSpec", factor: float) -> None:
    """Scale all lengths of a target's model by ``factor``."""
    for mesh in spec.meshes:
        mesh.scale = np.asarray(mesh.scale) * factor
    for geom in spec.geoms:
        geom.size = np.asarray(geom.size) * factor
        geom.pos = np.asarray(geom.pos) * factor
        geom.fromto = np.asarray(geom.fromto) * factor  # nan where the geom has none
    for element in [*spec.bodies[1:], *spec.sites, *spec.joints]:
        element.pos = np.asarray(element.pos) * factor


def own_model(path: Path, kind: str, hidden: int) -> "mujoco.MjSpec":
    """Read a user's target model: lengths in metres, x forward, y left, z up, origin on the path.

    The target is rigid. Only bodies and the geoms that are drawn are used.

    Args:
        path: a mesh (.obj, .stl) with an optional texture, the .png of the same name beside it; or an MJCF file (.xml)
            with one body in its worldbody.
        kind: the target's name without a number, which becomes the name of the body.
        hidden: first group of geoms that are not drawn.

    Raises:
        ConfigError: the file cannot be read, or is not such a model, or is in millimetres.
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
        largest = 2 * float(spec.compile().geom_rbound.max())
    except ValueError as error:
        raise ConfigError(f"{path}: is not a target's model: {' '.join(str(error).split())}") from None
    if largest > LARGEST_M:
        raise ConfigError(
            f"{path}: a part is {largest:.4g} m large; models are in metres, and this one seems to be in mm"
        )
    return spec


def _stiffen(spec: "mujoco.MjSpec") -> None:
    """Delete the joints, after everything that may refer to a joint or to what it moves."""
    for parts in ("keys", "actuators", "sensors", "tendons", "equalities", "excludes", "pairs", "tuples", "joints"):
        for part in list(getattr(spec, parts)):
            spec.delete(part)


def _keep_drawn(spec: "mujoco.MjSpec", path: Path, hidden: int) -> None:
    """Delete the geoms that are not drawn, and switch off the collisions of the others.

    Raises:
        ConfigError: no geom is left, or one has no known outline.
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
    """Make a model with one body from a mesh."""
    spec = mujoco.MjSpec()
    # A mesh may be open, so that it has no volume.
    spec.add_mesh(name="mesh", file=str(path), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    geom = spec.worldbody.add_body().add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh", rgba=np.array(GREY))
    if (picture := path.with_suffix(".png")).is_file():
        spec.add_texture(name="picture", type=mujoco.mjtTexture.mjTEXTURE_2D, file=str(picture))
        material = spec.add_material(name="picture", specular=0.1)
        material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "picture"
        geom.material, geom.rgba = "picture", np.ones(4)
    return spec
