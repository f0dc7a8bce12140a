"""A world whose frames are not rendered is in all else the same world."""

import numpy as np
import pytest

from cotarget.config import SafetyConfig, parse_config
from cotarget.errors import DeviceError
from cotarget.geometry import pose
from cotarget.sim.world import SimWorld
from tests.support.rigs import guarded


def drive(w):
    """Commands and reads as a loop gives them; everything that the rig tells."""
    told = []
    with w.rig as rig:
        for k in range(8):
            fixed, zoom = rig.fixed.read(newer_than=k * 0.04 - 0.01), rig.zoom.read()
            told.append((fixed.t, zoom.t, rig.clock.now(), rig.head.state(), rig.zoom.state()))
            told.append(rig.head.move(0.02 * k, -0.01 * k))
            told.append(rig.zoom.zoom(700 + 100 * k))
        truth = w.truth()
        outline = truth.silhouette("person", "fixed", 0.3)
        told.append((truth.center("person", 0.3).tolist(), outline.visible, outline.low_px.tolist()))
        told.append(truth.head_at(0.3))
    return told, fixed, zoom


def config(**sim):
    return parse_config({"sim": {"scene": "outdoor", "targets": ["person"], "effects": {"clutter": True}, **sim}})


@pytest.mark.render
def test_times_head_lens_and_truth_do_not_depend_on_rendering():
    (seen, *_), (blind, fixed, zoom) = drive(SimWorld(config())), drive(SimWorld(config(), rendered=()))
    assert seen == blind
    for frame in (fixed, zoom):
        assert frame.image.shape == (480, 640, 3)
        assert not frame.image.any()
        assert not frame.image.flags.writeable


def test_no_opengl_is_opened_for_no_picture(monkeypatch):
    def refuse(*_):
        raise AssertionError("nothing is to be rendered")

    monkeypatch.setattr("cotarget.sim.render.opengl.make_renderer", refuse)
    drive(SimWorld(config(), rendered=()))


def test_a_closed_rig_refuses_reads_and_can_be_closed_again():
    w = SimWorld(config(), rendered=())
    with guarded(w.rig, SafetyConfig()) as rig:
        rig.head.move(0.1, 0.0)
        seen = rig.fixed.read()
    for _ in range(2):
        rig.close()
        w.rig.close()
        w.close()
    for ask in (
        lambda: rig.fixed.read(newer_than=seen.t),
        lambda: w.rig.zoom.read(newer_than=seen.t),
        lambda: w.rig.board.present(pose([0, 0, 3], [0, 0, 0])),
    ):
        with pytest.raises(DeviceError, match="the simulated rig is closed"):
            ask()
    w.rig.clock.sleep_until(9.0)
    assert not w.rig.head.state().moving
    assert np.isfinite(w.truth().center_px("person", "fixed", seen.t)).all()


def test_the_truth_may_be_asked_anything_and_leaves_the_world_where_it_was():
    """However old the world is; and a box is that of the silhouette."""
    asked = 0.5, 0.2, 700.0, np.array([0.0, 10.0, 2.0])
    with (w := SimWorld(config(), rendered=())).rig as rig:
        truth = w.truth()
        miss, before = truth.line_of_sight_miss(*asked), truth.T_world_camera("zoom", 0.0).as_matrix()
        truth.largest_side_px("person", "zoom", 0.0)
        np.testing.assert_array_equal(truth.T_world_camera("zoom", 0.0).as_matrix(), before)
        for t in np.arange(3.0, 6.0, 0.5):
            outline = truth.silhouette("person", "fixed", t)
            np.testing.assert_array_equal(truth.box("person", "fixed", t), (outline.low_px, outline.high_px))
        rig.clock.sleep_until(200.0)
        rig.head.move(0.4, 0.0, wait=True)
        assert truth.line_of_sight_miss(*asked) == miss
