"""Targets and scenes of a user's own: they stand in the world as their files say, or are refused in one line."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from cotarget.config import load_config
from cotarget.errors import ConfigError
from cotarget.sim.world import SimWorld

# A box 1 m long, 0.4 m wide and 0.6 m high, as a file of triangles; x is forward.
CORNERS = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.2, 0.2) for z in (-0.3, 0.3)]
FACES = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
BOX = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "".join(f"f {a} {b} {c} {d}\n" for a, b, c, d in FACES)
BOX_XML = """<mujoco><worldbody><body><freejoint/><geom type="box" pos="0 0 -.2" size=".5 .2 .1"/>
  <body pos="0 0 .1"><joint name="lid"/><geom type="box" size=".5 .2 .2"/></body></body></worldbody></mujoco>"""
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
NEAR_PX = 1e-6


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG)
    (tmp_path / "dog.obj").write_text(BOX)
    (tmp_path / "dog.xml").write_text(BOX_XML)
    (tmp_path / "yard.xml").write_text(SCENE)
    return tmp_path


def changed(folder, old, new):
    assert old in RIG
    (folder / "rig.toml").write_text(RIG.replace(old, new))


@pytest.mark.parametrize("model", ["dog.obj", "dog.xml"])
def test_a_target_of_ones_own_is_where_its_path_leads_and_as_large_as_its_file_says(folder, model):
    changed(folder, "dog.obj", model)
    config = load_config(folder / "rig.toml")
    world = SimWorld(config, rendered=())
    try:
        truth = world.truth()
        low, high = truth.box("dog", "fixed", 0.0)
        lens = truth.fixed_lens
        # 10 m ahead and walking to the left: it is seen from its side, whose nearer face is 9.8 m away.
        sides = np.array([1.0, 0.6]) * lens.focal_px / 9.8
        np.testing.assert_allclose(low, lens.center_px - sides / 2, atol=NEAR_PX)
        np.testing.assert_allclose(high, lens.center_px + sides / 2, atol=NEAR_PX)
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


@pytest.mark.parametrize(("old", "new", "said"), [
    ("dog.obj", "cat.obj", "cat.obj: no such file; give the path of a mesh or an MJCF file"),
    ("dog.obj", "dog.gltf", "sim.models.dog: dog.gltf is not one of: .obj, .stl, .xml"),
    ("dog.obj", "yard.xml", "yard.xml: has 0 bodies in its worldbody; a target is one, with its parts in it"),
    ("dog.obj", "bad.obj", "bad.obj: is not a target's model: "),
    ("dog = \"", "bird = \"", "sim.models.bird: the simulation has a bird of its own; give yours another name"),
    ("dog = \"", "dog2 = \"", "sim.models.dog2: a model is of a kind; give its name without the number"),
    ("dog2 = [[", "dog3 = [[", "sim.targets: a dog2 of your own needs a way: [sim.paths] dog2 = [[t, x, y, z], ...]"),
    ('[sim.models]\ndog = "dog.obj"', "", "unknown target 'dog'; the simulation has: bird, book, person, and"),
])  # fmt: skip
def test_what_cannot_be_is_refused_in_one_line(folder, monkeypatch, old, new, said):
    monkeypatch.chdir(folder)
    (folder / "bad.obj").write_text("v 1 2\n")
    changed(folder, old, new)
    with pytest.raises(ConfigError) as error:
        SimWorld(load_config(Path("rig.toml")), rendered=())
    assert said in str(error.value)
    assert "\n" not in str(error.value)
