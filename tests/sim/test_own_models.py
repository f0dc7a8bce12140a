"""Targets and scenes of a user's own: they stand in the world as their files say, or are refused in one line."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from cotarget.backends import load_config
from cotarget.errors import ConfigError
from cotarget.geometry import pose
from cotarget.sim.model import BOARD
from cotarget.sim.world import SimWorld
from tests.support.target_models import BOX, CORNERS, FACES, mesh

ASIDE = np.array([0.2, 0.0, 0.3])  # a mesh's origin need not be its middle
BOX_XML = """<mujoco><worldbody><body><freejoint/><geom type="box" pos="0 0 -.2" size=".5 .2 .1"/>
  <body pos="0 0 .1"><joint name="lid"/><geom type="box" size=".5 .2 .2"/></body></body></worldbody></mujoco>"""
# The same as models of robots are: it moves by itself, and collides as what is larger than what is seen.
ROBOT_XML = """<mujoco><worldbody><body name="trunk" pos="5 5 5"><freejoint name="free"/>
    <geom type="box" pos="0 0 -.2" size=".5 .2 .1"/><geom name="hull" type="box" size="2 2 2" group="3"/>
    <body name="head" pos="0 0 .1"><joint name="lid"/><joint name="lock"/><site name="eye"/>
      <geom type="mesh" mesh="box"/><geom name="shell" type="plane" size="2 2 2" group="4"/></body></body></worldbody>
  <asset><mesh name="box" vertex="-.5 -.2 -.2 .5 -.2 -.2 -.5 .2 -.2 .5 .2 -.2
    -.5 -.2 .2 .5 -.2 .2 -.5 .2 .2 .5 .2 .2"/></asset>
  <contact><exclude body1="trunk" body2="head"/><pair geom1="hull" geom2="shell"/></contact>
  <tendon><fixed name="string"><joint joint="lid" coef="1"/></fixed></tendon>
  <equality><joint joint1="lid" joint2="lock"/><tendon tendon1="string"/></equality>
  <actuator><motor joint="lid"/><position tendon="string"/></actuator>
  <sensor><jointpos joint="lid"/><framepos objtype="site" objname="eye"/><tendonpos tendon="string"/></sensor>
  <custom><tuple name="all"><element objtype="joint" objname="lid"/></tuple></custom>
  <keyframe><key qpos="5 5 5 1 0 0 0 1 1" ctrl="1 1"/></keyframe></mujoco>"""
# Upright and without a thickness, its faces both ways round.
SHEET = mesh([(-0.5, 0, -0.3), (0.5, 0, -0.3), (0.5, 0, 0.3), (-0.5, 0, 0.3)], [(1, 2, 3, 4), (4, 3, 2, 1)])
SCENE = """<mujoco><worldbody><light pos="0 0 9"/><geom type="plane" size="50 50 1"/>
  <site name="fixed_mount" pos="3 0 2" xyaxes="0 -1 0 0 0 1"/></worldbody></mujoco>"""  # looks along +x
RIG = """
[sim]
scene = "yard.xml"
targets = ["dog", "dog2"]
effects = { all = false }
[sim.models]
dog = "dog.obj"
[sim.paths]
dog = [[0, 13, 0, 2], [10, 13, 5, 2]]
dog2 = [[0, 23, 5, 2], [10, 23, 10, 2]]
[targets.dog]
size = 0.6
dimension = "height"
wanted_px = 200
detector = "motion"
"""
NEAR_PX, NEAR_M = 1e-6, 1e-9  # rounding


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG)
    (tmp_path / "dog.obj").write_text(BOX)
    (tmp_path / "aside.obj").write_text(mesh(CORNERS + ASIDE, FACES))
    (tmp_path / "dog.xml").write_text(BOX_XML)
    (tmp_path / "robot.xml").write_text(ROBOT_XML)
    (tmp_path / "sheet.obj").write_text(SHEET)
    (tmp_path / "yard.xml").write_text(SCENE)
    return tmp_path


def changed(folder, old, new):
    assert old in RIG
    (folder / "rig.toml").write_text(RIG.replace(old, new))


@pytest.mark.parametrize(("model", "near"), [
    ("dog.obj", 9.8), ("aside.obj", 9.8), ("dog.xml", 9.8), ("robot.xml", 9.8), ("sheet.obj", 10.0)
])  # fmt: skip
def test_a_target_of_ones_own_is_where_its_path_leads_and_as_large_as_its_file_says(folder, model, near):
    changed(folder, "dog.obj", model)
    config = load_config(folder / "rig.toml")
    world = SimWorld(config, rendered=())
    try:
        truth = world.truth()
        outline, lens = truth.silhouette("dog", "fixed", 0.0), truth.fixed_lens
        # 10 m ahead and walking to the left: it is seen from its side, whose nearer face is so far away.
        middle = np.array(lens.center_px)
        if model == "aside.obj":
            middle -= ASIDE[[0, 2]] * lens.focal_px / near
        sides = np.array([1.0, 0.6]) * lens.focal_px / near
        np.testing.assert_allclose(outline.low_px, middle - sides / 2, atol=NEAR_PX)
        np.testing.assert_allclose(outline.high_px, middle + sides / 2, atol=NEAR_PX)
        assert outline.visible == 1.0
        np.testing.assert_allclose(truth.center("dog2", 0.0), [23, 5, 2])
        assert config.target("dog2") == config.target("dog")
    finally:
        world.close()


@pytest.mark.render
def test_it_wears_the_picture_that_lies_beside_it(folder):
    cv2.imwrite(str(folder / "dog.png"), np.full((16, 16, 3), (0, 0, 255), np.uint8))
    world = SimWorld(load_config(folder / "rig.toml"))
    with world.rig as rig:
        image = rig.fixed.read().image.astype(int)
    blue, green, red = image[240, 320]
    assert red > 60
    assert red > 3 * max(blue, green)


def test_the_scene_may_have_a_board_of_its_own(folder):
    (folder / "yard.xml").write_text(SCENE.replace("<site", '<body name="board"><geom size=".1"/></body><site'))
    world = SimWorld(load_config(folder / "rig.toml"), rendered=())
    with world.rig as rig:
        rig.board.present(pose([0, 0, 4], [0, 0, 0]))
        data = world.truth().set_bodies(0.0)
        np.testing.assert_array_equal(data.body("board").xpos, 0.0)
        np.testing.assert_allclose(data.body(BOARD).xpos, [7, 0, 2], atol=NEAR_M)  # 4 m before the camera


@pytest.mark.parametrize(("old", "new", "named"), [
    ("dog.obj", "cat.obj", "sim.models.dog: cat.obj: "),
    ("dog.obj", "dog.gltf", "rig.toml: sim.models.dog: dog.gltf "),
    ("dog.obj", "yard.xml", "yard.xml: has 0 bodies"),
    ("dog.obj", "bad.obj", "bad.obj: "),
    ("dog.obj", "plane.xml", "plane.xml: has a geom of type plane"),
    ("dog.obj", "hidden.xml", "hidden.xml: shows nothing"),
    ("dog.obj", "nothing.xml", "nothing.xml: shows nothing"),
    ("dog.obj", "mm.obj", "mm.obj: a part is 1233 m large"),
    ("dog = \"", "bird = \"", "rig.toml: sim.models.bird: "),
    ("dog = \"", "dog2 = \"", "rig.toml: sim.models.dog2: "),
    ("dog2 = [[", "dog3 = [[", "rig.toml: sim.targets: a dog2 of your own needs a path"),
    ('[sim.models]\ndog = "dog.obj"', "", "rig.toml: sim.targets: unknown target 'dog'"),
])  # fmt: skip
def test_what_cannot_be_is_refused_in_one_line(folder, monkeypatch, old, new, named):
    monkeypatch.chdir(folder)
    (folder / "bad.obj").write_text("v 1 2\n")
    (folder / "mm.obj").write_text(mesh(1000 * CORNERS, FACES))
    for name, inside in (
        ("plane", '<geom type="plane" size="1 1 1"/>'),
        ("hidden", '<geom size="1" group="3"/>'),
        ("nothing", '<site name="a"/>'),
    ):
        (folder / f"{name}.xml").write_text(f"<mujoco><worldbody><body>{inside}</body></worldbody></mujoco>")
    changed(folder, old, new)
    with pytest.raises(ConfigError) as error:
        SimWorld(load_config(Path("rig.toml")), rendered=())
    assert str(error.value).startswith(named)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("path", "unseen"), [
    ("[[0, 13, 0, 2], [10, 13, 5, 2]]", False),
    ("[[0, 13, -90, 2], [10, 13, 90, 2]]", False),  # it comes through
    ("[[0, 13000, 0, 2000], [10, 13000, 5000, 2000]]", True),  # in millimetres
    ("[[0, -13, 0, 2], [10, -13, 5, 2]]", True),  # behind the camera
])  # fmt: skip
def test_a_path_that_is_never_in_view_is_told(folder, caplog, path, unseen):
    changed(folder, "[[0, 13, 0, 2], [10, 13, 5, 2]]", path)
    SimWorld(load_config(folder / "rig.toml"), rendered=()).close()
    told = [record.getMessage() for record in caplog.records]
    assert [line.partition(": ")[0] for line in told if "dog:" in line] == ["sim.paths.dog"] * unseen
