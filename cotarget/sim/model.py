"""Compiled MuJoCo model of a configuration: scene, rig, targets and board, edited through MjSpec."""

from functools import lru_cache
from pathlib import Path

import numpy as np

from cotarget.board import tiles
from cotarget.config import BoardConfig, RigConfig, SimConfig
from cotarget.errors import ConfigError, choices
from cotarget.files import assets_dir
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.sim.render.opengl import mujoco
from cotarget.sim.targets.models import target_model
from cotarget.sim.targets.target import Target
from cotarget.sim.weather import INDOORS, add_clutter

# The only conversion from MuJoCo's camera axes (x right, y up, z back) to OpenCV's (x right, y down, z forward).
T_OPENCV_MUJOCO = RigidTransform.from_rotation(Rotation.from_rotvec([np.pi, 0.0, 0.0]))
MOUNT_SITE = "fixed_mount"
RIG = "rig/"  # prefix of the rig's parts; the prefix of a target's parts is its name and a slash
BOARD = RIG + "board"
# Groups of geoms by purpose; those of scene and targets are below. MuJoCo draws what a view's options enable.
BOARD_GROUP, RIG_GROUP, FRAME_GROUP = 3, 4, 5
BOARD_THICKNESS = 0.004  # [m]
BOARD_MARGIN = 0.6  # white border around the squares, in squares
BLACK, WHITE = (0.05, 0.05, 0.05, 1.0), (0.95, 0.95, 0.95, 1.0)
ARM_RADIUS = 0.012  # bracket between the head and the zoom camera [m]
CAMERA_FOOT = (0.0, 0.038, -0.086)  # where the bracket meets the housing, in the zoom camera's frame [m]
# Size of a sensor pixel [m]; only its ratio to the focal length matters to the renderer.
RENDER_PITCH = 1e-5
PORTRAIT_SIZE = (640, 560)  # size of pictures of the rig itself [px]


def scene_path(scene: str) -> Path:
    """Find a built-in scene by its name, or a user's MJCF file by its path.

    Raises:
        ConfigError: there is no such scene or file.
    """
    if (own := assets_dir() / "scenes" / f"{scene}.xml").is_file():
        return own
    if (path := Path(scene)).is_file():
        return path
    names = (p.stem for p in (assets_dir() / "scenes").glob("*.xml"))
    raise ConfigError(
        f"unknown scene '{scene}'; the scenes are: {choices(names)}, or give the path of an MJCF file"
        " beside the rig.toml"
    )


def scene_spec(scene: str) -> "mujoco.MjSpec":
    """Read a scene, given by its name or its path.

    Raises:
        ConfigError: the file is not MJCF, or has no mount for the rig.
    """
    path = scene_path(scene)
    if path.suffix != ".xml":  # MuJoCo chooses the decoder by the extension and does not know .XML
        raise ConfigError(f"{path}: does not end in .xml, as a scene does, which is an MJCF file")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ConfigError(f"{path}: is not a valid MJCF scene: {' '.join(str(error).split())}") from None
    if all(site.name != MOUNT_SITE for site in spec.sites):
        raise ConfigError(
            f"{path}: has no site '{MOUNT_SITE}', which says where the fixed camera is (looking along -z)"
        )
    return spec


def build_model(config: RigConfig, targets: tuple[Target, ...], render_size: tuple[int, int]) -> "mujoco.MjModel":
    """Compile scene, rig, targets and board.

    Args:
        config: the rig's configuration.
        targets: targets in the scene, one mocap body each.
        render_size: (width, height) of the pinhole views [px].

    Raises:
        ConfigError: the scene is not MJCF, or has no mount for the rig.
    """
    path, spec = scene_path(config.sim.scene), scene_spec(config.sim.scene)
    rig = mujoco.MjSpec.from_file(str(assets_dir() / "rig.xml"))
    _edit_rig(rig, config.sim, _site_pose(path.absolute(), path.stat().st_mtime_ns), render_size)
    _attach(spec, rig, RIG)
    for target in targets:
        _attach(spec, target_model(target, BOARD_GROUP), f"{target.name}/")
    _add_board(spec, config.board)
    if has_clutter(config.sim):
        add_clutter(spec, config.sim.seed)
    spec.visual.quality.offsamples = 4 if config.sim.effects.multisampling else 0
    if not config.sim.effects.shadows:
        spec.visual.quality.shadowsize = 0  # no shadow map, which takes 64 MB outdoors
    visual = spec.visual.global_
    # No larger than needed: OpenGL clears and resolves the whole buffer for every picture.
    visual.offwidth = max(PORTRAIT_SIZE[0], render_size[0])
    visual.offheight = max(PORTRAIT_SIZE[1], render_size[1])
    return compiled(spec, path, " with the rig")


def compiled(spec: "mujoco.MjSpec", path: Path | str, beside: str = "") -> "mujoco.MjModel":
    """Compile a scene.

    Raises:
        ConfigError: it does not compile; the message names the file, and what is ``beside`` the scene.
    """
    try:
        return spec.compile()
    except ValueError as error:
        raise ConfigError(f"{path}: does not compile{beside}: {' '.join(str(error).split())}") from None


def has_clutter(sim: SimConfig) -> bool:
    """Check whether anything besides targets and rig moves."""
    return sim.effects.clutter and sim.scene not in INDOORS


def mount_pose(model: "mujoco.MjModel") -> RigidTransform:
    """Give T_world_fixed of a compiled model, in OpenCV's axes."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    site = data.site(MOUNT_SITE)
    return RigidTransform.from_components(site.xpos, Rotation.from_matrix(site.xmat.reshape(3, 3))) * T_OPENCV_MUJOCO


def base_pose(T_world_fixed: RigidTransform, sim: SimConfig) -> RigidTransform:
    """Compute T_world_base; at pan = tilt = 0, T_base_zoom0 = T_head_zoom."""
    return T_world_fixed * (sim.T_head_zoom * sim.T_zoom0_fixed).inv()


def quaternion(T: RigidTransform) -> Array:
    """Give a transform's rotation as a quaternion in MuJoCo's order, (w, x, y, z)."""
    return T.rotation.as_quat(scalar_first=True)


def _attach(scene: "mujoco.MjSpec", part: "mujoco.MjSpec", prefix: str) -> None:
    """Attach a part to the scene with a prefix to its names; the scene's global settings are kept."""
    part.visual.map.znear, part.visual.map.zfar = scene.visual.map.znear, scene.visual.map.zfar
    scene.attach(part, frame=scene.worldbody.add_frame(), prefix=prefix)


@lru_cache(maxsize=4)
def _site_pose(scene: Path, changed: int) -> RigidTransform:
    """Give T_world_fixed of a scene's file, cached because compiling it takes as long as building the world.

    Args:
        scene: the file.
        changed: modification time of the file, part of the cache's key; changes of included files are not noticed.

    Raises:
        ConfigError: the scene does not compile.
    """
    return mount_pose(compiled(mujoco.MjSpec.from_file(str(scene)), scene))


def _place(body: "mujoco.MjsBody", T: RigidTransform) -> None:
    body.pos, body.quat = T.translation, quaternion(T)


def _edit_rig(
    rig: "mujoco.MjSpec", sim: SimConfig, T_world_fixed: RigidTransform, render_size: tuple[int, int]
) -> None:
    """Place the rig's bodies as configured."""
    _place(rig.body("fixed"), T_world_fixed)
    _place(rig.body("base"), base_pose(T_world_fixed, sim))
    _place(rig.body("zoom"), sim.T_head_zoom)
    if sim.effects.axes:
        dz, eps = sim.head.axis_offset_mm / 1000, np.radians(sim.head.squareness_deg)
        rig.body("tilt").pos, rig.body("head").pos = (0.0, 0.0, dz), (0.0, 0.0, -dz)
        rig.joint("tilt").axis = (np.cos(eps), np.sin(eps), 0.0)
    arm = rig.geom("arm")
    arm.fromto = [0.0, 0.0, 0.0, *sim.T_head_zoom.apply(CAMERA_FOOT)]
    arm.size = [ARM_RADIUS, 0.0, 0.0]
    for name in ("fixed", "zoom"):
        camera = rig.camera(name)
        camera.resolution = render_size
        camera.sensor_size = np.array(render_size) * RENDER_PITCH
        camera.focal_length = (render_size[0] * RENDER_PITCH,) * 2  # overwritten before every render


def _add_board(spec: "mujoco.MjSpec", board: BoardConfig) -> None:
    """Add the calibration board: origin at the first inner corner, x along the columns, z away from the viewer."""
    body = spec.worldbody.add_body(name=BOARD, mocap=True)
    columns, rows = (n + 1 for n in board.corners)

    def tile(x0: float, y0: float, x1: float, y1: float, colour: tuple[float, ...]) -> None:
        low, high = np.array([x0, y0]) * board.square, np.array([x1, y1]) * board.square
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[*(low + high) / 2, BOARD_THICKNESS / 2],
            size=[*(high - low) / 2, BOARD_THICKNESS / 2],
            rgba=colour,
            group=BOARD_GROUP,
            contype=0,
            conaffinity=0,
        )

    for part in tiles(board):
        tile(part.x0 - 1, part.y0 - 1, part.x1 - 1, part.y1 - 1, BLACK if part.dark else WHITE)
    edge = BOARD_MARGIN
    tile(-1 - edge, -1 - edge, columns - 1 + edge, -1, WHITE)
    tile(-1 - edge, rows - 1, columns - 1 + edge, rows - 1 + edge, WHITE)
    tile(-1 - edge, -1, -1, rows - 1, WHITE)
    tile(columns - 1, -1, columns - 1 + edge, rows - 1, WHITE)
