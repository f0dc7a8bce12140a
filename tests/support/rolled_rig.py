"""Simulated rigs with cameras that are rolled about their axes, on a head that stays upright."""

from dataclasses import replace

from cotarget.config import RigConfig, SimConfig
from cotarget.geometry import RigidTransform, Rotation
from cotarget.sim.targets.random_paths import lone_path

SCENE = """<mujoco><statistic extent="10" center="0 5 1"/><worldbody><light pos="0 0 5"/>
<geom type="plane" size="100 100 1"/><site name="fixed_mount" pos="0 0 1.6" quat="{} {} {} {}"/></worldbody></mujoco>"""
PITCH_DEG = 99.0  # of the outdoor scene's mount, for which the paths are made
WIDE = (500.0, 500.0)  # focal lengths with which a fixed camera on its side sees the paths too [px]


def rolled(degrees):
    """A rotation about a camera's axis, clockwise as seen from behind it [degrees]."""
    return RigidTransform.from_rotation(Rotation.from_euler("z", degrees, degrees=True))


def rolled_config(folder, name, seed, *, fixed_deg=0.0, zoom_deg=0.0, **sim):
    """The default rig with rolled cameras and one target on a random path, in a scene of its own in a folder."""
    turned = Rotation.from_euler("x", PITCH_DEG, degrees=True) * Rotation.from_euler("z", -fixed_deg, degrees=True)
    scene = folder / "rolled.xml"
    scene.write_text(SCENE.format(*turned.as_quat(scalar_first=True)))
    usual = SimConfig()
    return RigConfig(
        sim=replace(
            usual,
            scene=str(scene),
            seed=seed,
            targets=(name,),
            paths=lone_path(name, seed),
            fixed=replace(usual.fixed, focal_px=WIDE),
            T_zoom0_fixed=rolled(-zoom_deg) * usual.T_zoom0_fixed * rolled(fixed_deg),
            T_head_zoom=usual.T_head_zoom * rolled(zoom_deg),
            **sim,
        )
    )
