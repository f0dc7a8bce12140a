"""Outlines by tables against the truth, which projects every corner of every body."""

import dataclasses
import math

import numpy as np
import pytest

from cotarget.config import parse_config
from cotarget.sim.targets.random_paths import lone_path
from cotarget.sim.truth import PHASES, Outlines, outermost
from cotarget.sim.world import SimWorld

# Parts of a target's larger side: a wing between two phases, and what lies between the directions looked in.
EDGE = 0.025
# The truth looks at eight phases of a beat from its own time on; one between them may be so much larger.
BEAT = 0.04
WALL = """
<mujoco>
  <worldbody>
    <site name="fixed_mount" pos="0 0 1.6" euler="90 0 0"/>
    <geom type="plane" size="50 50 1" pos="0 0 {ground}"/>
    <geom type="box" size="1 0.05 2" pos="{x} 5 2"/>
  </worldbody>
</mujoco>
"""


def world(name, seed, **effects):
    config = parse_config({"sim": {"seed": seed, "targets": [name], "effects": effects}})
    sim = dataclasses.replace(config.sim, paths=lone_path(name, seed))
    return SimWorld(dataclasses.replace(config, sim=sim), rendered=())


@pytest.mark.parametrize("effects", [{}, {"distortion": False}], ids=["distorted", "plain"])
@pytest.mark.parametrize("name", ["book", "person", "bird"])
def test_boxes_agree_with_the_truth_within_tolerance(name, effects):
    w = world(name, 3, **effects)
    truth, outlines = w.truth(), Outlines(w.truth())
    compared = 0
    with w.rig as rig:
        for k in range(20):
            t = 4.0 + 0.45 * k
            u, v, z = w.truth().T_world_fixed.inv().apply(truth.center(name, t + 0.45))
            rig.head.move(math.atan2(u, z), math.atan2(-v, math.hypot(u, z)))
            rig.zoom.zoom(rig.zoom.focal_range[0] * (1 + 0.3 * k))
            rig.clock.sleep_until(t + 0.45)
            for camera in ("fixed", "zoom"):
                true, found = truth.box(name, camera, t), outlines.box(name, camera, t)
                assert (true is None) == (found is None)
                if true is None:
                    continue
                size = np.max(true[1] - true[0])
                assert np.abs(np.subtract(found, true)).max() < EDGE * size
                assert outlines.center_px(name, camera, t) == pytest.approx(truth.center_px(name, camera, t), abs=1e-6)
                side = truth.largest_side_px(name, camera, t)
                assert -EDGE < outlines.largest_side_px(name, camera, t) / side - 1 < BEAT
                compared += 1
    assert compared > 25
    assert outlines.longest_px == truth.longest_px
    assert outlines.lens("zoom", t) == truth.lens("zoom", t)


def test_behind_a_camera_there_is_no_outline():
    w = world("book", 0)
    outlines = Outlines(w.truth())
    with w.rig as rig:
        rig.head.move(2.7, 0.0, wait=True)
        t = rig.clock.now()
        assert outlines.box("book", "zoom", t) is None
        assert outlines.silhouette("book", "zoom", t) is None
        assert np.isnan(outlines.center_px("book", "zoom", t)).all()
        assert math.isnan(outlines.largest_side_px("book", "zoom", t))
        assert outlines.box("book", "fixed", t) is not None


def test_a_box_that_is_cut_shows_in_part():
    """A book of 0.234 m, 3.5 m aside of the axis and 10 m ahead: its middle is 240 px from that of 640, and so on."""
    paths = {"book": [[0, 4.66, 10, 1.6], [9, 4.66, 10, 1.6]]}
    sim = {"scene": "indoor", "targets": ["book"], "effects": {"all": False}, "paths": paths}
    w = SimWorld(parse_config({"sim": sim}), rendered=())
    truth, outlines = w.truth(), Outlines(w.truth())
    true, found = truth.silhouette("book", "fixed", 0.0), outlines.silhouette("book", "fixed", 0.0)
    assert found.low_px[0] < 639.5 < found.high_px[0]
    inside = (639.5 - found.low_px[0]) / (found.high_px[0] - found.low_px[0])
    assert found.visible == pytest.approx(inside)
    assert true.visible == pytest.approx(inside, abs=0.05)  # the book is no rectangle in the picture


@pytest.mark.parametrize(("x", "ground", "hidden"), [(-3.0, 0.0, False), (0.0, 0.0, True), (-3.0, 1.5, True)])
def test_an_occluder_lowers_visibility(tmp_path, x, ground, hidden):
    """A wall aside, a wall before, and a floor above the book."""
    scene = tmp_path / "wall.xml"
    scene.write_text(WALL.format(x=x, ground=ground))
    paths = {"book": [[0, 0, 10, 1.3], [9, 0, 10, 1.3]]}
    sim = {"scene": str(scene), "targets": ["book"], "effects": {"all": False}, "paths": paths}
    truth = SimWorld(parse_config({"sim": sim}), rendered=()).truth()
    visible = Outlines(truth).silhouette("book", "fixed", 0.0).visible
    assert visible == truth.silhouette("book", "fixed", 0.0).visible
    assert (visible < 1.0) == hidden


def test_a_table_has_a_phase_in_each_row():
    """The wings of 0.8 m span reach farthest aside when they are level, and up and down by turns."""
    table = outermost("bird")
    assert table.shape[:2] == (PHASES, 3)
    spans = np.ptp(table[:, 1], axis=1)
    assert spans.max() == pytest.approx(0.8, abs=0.03)
    assert spans.min() < 0.9 * spans.max()
    highest = table[:, 2].max(axis=1)
    assert np.argmax(highest) in range(
        PHASES // 8, 3 * PHASES // 8 + 4
    )  # the inner wing's sine is highest at a quarter
    assert not table[:, :, -1].any()  # the middle
