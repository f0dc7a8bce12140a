"""The simulated world against means outside of it: OpenCV's projection, hand-made matrices, the pipeline's geometry."""

import re

import cv2
import numpy as np
import pytest

from cotarget.camera import Intrinsics
from cotarget.config import parse_config
from cotarget.errors import ConfigError
from cotarget.geometry import pose
from cotarget.pantilt import HeadGeometry, nearest, solve, zoom_fixed
from cotarget.sim.world import SimWorld

pytestmark = pytest.mark.render
CORNERS = (9, 6)
SQUARE = 0.1
PROJECTION_PX = 0.1  # the figure to reach; a board's mean offset, because one corner has the finder's own noise too
ONE_CORNER_PX = 0.5  # noise, JPEG and the finder on a single corner
EXACT = 1e-9
ODD_RIG = {
    "T_zoom0_fixed": {"translation": [-1.5, 0.1, 0.2], "rotvec_deg": [1, -12, 5]},
    "T_head_zoom": {"translation": [0.1, -0.15, 0.1], "rotvec_deg": [3, -4, 5]},
}


def world(**sim):
    return SimWorld(parse_config({"sim": {"scene": "indoor", **sim}}))


def corners_of(image):
    found, corners = cv2.findChessboardCornersSB(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), CORNERS)
    assert found
    return corners.reshape(-1, 2)


def opencv_projection(lens, T_camera_board, points):
    K = np.array([[lens.focal_px[0], 0, lens.center_px[0]], [0, lens.focal_px[1], lens.center_px[1]], [0, 0, 1]])
    rotvec, translation = T_camera_board.rotation.as_rotvec(), np.array(T_camera_board.translation)
    return cv2.projectPoints(points, rotvec, translation, K, np.array(lens.distortion))[0].reshape(-1, 2)


def matched(found, expected):
    """Order the found corners like the expected ones, whichever end the finder began at."""
    return found if np.linalg.norm(found[0] - expected[0]) < np.linalg.norm(found[-1] - expected[0]) else found[::-1]


@pytest.mark.parametrize("sim", [{}, ODD_RIG])
def test_rendered_boards_are_where_opencv_and_the_pipeline_project_them(sim):
    """Noise, JPEG and distortion on; the board near the corners of the image too."""
    columns, rows = CORNERS
    points = np.zeros((columns * rows, 3))
    points[:, :2] = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2) * SQUARE
    worst, views = 0.0, 0
    with (w := world(**sim)).rig as rig:
        truth, T = w.truth(), w.config.sim
        head = HeadGeometry(T.head.axis_offset_mm / 1000, np.radians(T.head.squareness_deg))
        for x, y, z, aside in (
            (-0.4, -0.25, 3.0, (0, 0)),
            (-1.6, -1.1, 3.5, (0.2, 0.1)),
            (0.7, 0.4, 3.5, (-0.2, 0.15)),
        ):
            T_fixed_board = pose([x, y, z], [15, -20, 4])
            rig.board.present(T_fixed_board)
            # Turn the zoom camera so that the board appears aside of its middle.
            middle = T.T_head_zoom.apply(T.T_zoom0_fixed.apply(T_fixed_board.apply(points.mean(axis=0))))
            turned = nearest(solve(middle, T.T_head_zoom, head, (*aside, 1.0)), (-2, 2), (-0.8, 0.5))
            rig.head.move(float(turned.pan), float(turned.tilt), wait=True)
            since = rig.clock.now()
            for camera in ("fixed", "zoom"):
                frame = getattr(rig, camera).read(newer_than=since)
                lens = truth.lens(camera, frame.t)
                intrinsics = Intrinsics(lens.size, lens.focal_px, lens.center_px, lens.distortion)
                T_camera_board = truth.T_world_camera(camera, frame.t).inv() * truth.T_world_fixed * T_fixed_board
                expected = opencv_projection(lens, T_camera_board, points)
                assert ((expected > 8) & (expected < np.array(lens.size) - 9)).all(), "the whole board must be seen"
                if camera == "zoom":  # the pipeline's own chain, with the head where its counters say
                    state = rig.head.state()
                    chain = zoom_fixed(state.pan, state.tilt, T.T_head_zoom, T.T_zoom0_fixed, head) * T_fixed_board
                    np.testing.assert_allclose(chain.as_matrix(), T_camera_board.as_matrix(), atol=EXACT)
                np.testing.assert_allclose(intrinsics.project(T_camera_board.apply(points)), expected, atol=1e-6)
                found = matched(corners_of(frame.image), expected)
                worst = max(worst, np.abs(np.mean(found - expected, axis=0)).max())
                np.testing.assert_allclose(found, expected, atol=ONE_CORNER_PX)
                views += 1
    print(f"largest mean offset of {views} rendered boards: {worst:.3f} px")
    assert worst < PROJECTION_PX
    assert views == 6


def test_the_same_seed_gives_the_same_pixels_whatever_was_read_before_and_another_does_not():
    def frames(seed, before=0):
        with world(targets=["person", "book"], seed=seed).rig as rig:
            for _ in range(before):
                rig.fixed.read()
            rig.clock.sleep_until(0.1)
            rig.head.move(0.1, 0.05)
            rig.zoom.zoom(3000.0)
            rig.clock.sleep_until(3.0)
            return rig.fixed.read().image, rig.zoom.read().image

    first, again, other = frames(5), frames(5, before=1), frames(6)
    for a, b, c in zip(first, again, other, strict=True):
        np.testing.assert_array_equal(a, b)
        assert (a != c).mean() > 0.1


def test_all_effects_off_is_the_textbook():
    with (w := world(effects={"all": False})).rig as rig:
        lens = w.truth().lens("fixed", 0.0)
        assert lens.distortion == (0, 0, 0, 0, 0)
        before = rig.fixed.read()
        assert before.t == rig.clock.now() == 0  # no latency
        assert rig.head.move(0.123456789, -0.1) == (0.123456789, -0.1)  # no steps
        rig.clock.sleep_until(0.01)
        assert rig.head.state().pan == 0.123456789  # no profile
        np.testing.assert_array_equal(rig.fixed.read(newer_than=0.0).image, before.image)  # no noise


NO_MESH = """<mujoco><asset><mesh file="none.stl"/></asset>
<worldbody><site name="fixed_mount"/></worldbody></mujoco>"""


@pytest.mark.parametrize(("name", "text"), [
    ("own.xml", "<mujoco><worldbody/></mujoco>"),  # no site for the fixed camera
    ("own.xml", "<mujoco><world/></mujoco>"),
    ("own.xml", NO_MESH),
    ("yard", "<mujoco/>"),
    ("yard.XML", "<mujoco/>"),
    ("moon", None),
])  # fmt: skip
def test_a_scene_that_cannot_serve_is_named_and_mujoco_writes_nothing(tmp_path, monkeypatch, capfd, name, text):
    monkeypatch.chdir(tmp_path)
    if text is not None:
        (tmp_path / name).write_text(text)
    before = [*tmp_path.iterdir()]
    with pytest.raises(ConfigError, match=re.escape(name)) as caught:
        world(scene=name)
    assert "\n" not in str(caught.value)
    assert (*capfd.readouterr(), [*tmp_path.iterdir()]) == ("", "", before)


def test_truth_sees_the_target_where_it_is_drawn():
    """The book is the only saturated red thing; its blob's middle is where the truth projects the body's centre."""
    with (w := world(targets=["book"], effects={"all": False, "multisampling": True})).rig as rig:
        rig.clock.sleep_until(3.0)
        frame = rig.fixed.read()
        truth = w.truth()
        expected = truth.pixel("fixed", truth.center("book", frame.t), frame.t)
        outline = truth.silhouette("book", "fixed", frame.t)
        b, g, r = (frame.image[..., i].astype(float) for i in range(3))
        v, u = np.nonzero((r > 90) & (r > 2 * g) & (r > 2 * b))
        assert np.hypot(*(np.mean([w_.min(), w_.max()]) - e for w_, e in zip((u, v), expected, strict=True))) < 1.5
        assert outline.visible == 1.0
        assert outline.size_px[0] == pytest.approx(np.ptp(u) + 1, abs=2)
