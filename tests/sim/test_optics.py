"""The zoom lens's optics against polynomials, matrices and projections made without the simulation."""

import math

import cv2
import numpy as np
import pytest

from cotarget.board import board_points
from cotarget.calibration.corners import find_corners
from cotarget.config import BoardConfig, SimZoomCamera, parse_config
from cotarget.geometry import pose
from cotarget.sim.render.optics import TrueLens, fold
from cotarget.sim.world import SimWorld
from cotarget.sim.zoom_lens import optics_at

BOARD = BoardConfig(square=0.04)
PROJECTION_PX = 0.1  # as for the shortest focal length: a board's mean offset
ONE_CORNER_PX = 0.5  # noise, JPEG and the finder on a single corner
EXACT = 1e-12
ROUNDING_PX = 1e-9
LONGEST = 12.0  # 72 / 6 mm
SHORTEST_PX = 6 / 0.009
SPINE = 2e-3  # the book's cover and back stand 0.03 m apart and it swings: the nearer one decides
HOME = {"translation": [0, 0, 0], "rotvec_deg": [0, 0, 0]}
STRAIGHT = {"focal_curve": [], "center_drift_px": [[], []], "distortion_drift": [], "pupil": []}


def world(**sim):
    board = {"square": BOARD.square}
    return SimWorld(parse_config({"sim": {"scene": "indoor", **sim}, "board": board}))


def along(coefficients, s):
    """The curve of these coefficients of s, s^2, ..., by numpy."""
    return np.polyval([*reversed(coefficients), 0.0], s)


def test_the_lens_follows_its_curves():
    camera = SimZoomCamera(distortion=(-0.1, 0.02, 0.001, -0.002, 0.003))
    s = 0.6
    optics = optics_at(camera, LONGEST**s)
    gain = LONGEST**s * (1 + along(camera.focal_curve, s))
    assert optics.focal_px == pytest.approx((692 * gain, 693 * gain))
    du, dv = (along(drift, s) for drift in camera.center_drift_px)
    assert optics.center_px == pytest.approx((326 + du, 235 + dv))
    assert optics.pupil == pytest.approx(along(camera.pupil, s))
    kappa1 = -0.1 + along(camera.distortion_drift, s)
    powers = gain ** np.array([2, 4, 1, 1, 6])
    assert optics.distortion == pytest.approx(np.array([kappa1, 0.02, 0.001, -0.002, 0.003]) * powers)
    first = optics_at(camera, 1.0)
    assert (first.focal_px, first.center_px) == (camera.focal_px, camera.center_px)
    assert (first.distortion, first.pupil) == (camera.distortion, 0.0)


def test_without_drift_the_image_keeps_its_distortion():
    """The same pixels stand for tangents that are smaller by the magnification."""
    camera = SimZoomCamera(
        distortion=(-0.1, 0.02, 0.001, -0.002, 0.003), focal_curve=(), center_drift_px=((), ()), distortion_drift=()
    )
    tangents = np.array([[0.45, 0.33, 1.0], [-0.3, 0.1, 1.0]])
    seen = []
    for magnification in (1.0, 7.0):
        optics = optics_at(camera, magnification)
        K = np.diag([*optics.focal_px, 1.0])
        K[:2, 2] = optics.center_px
        points = tangents / [magnification, magnification, 1.0]
        seen.append(cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(optics.distortion))[0])
    np.testing.assert_allclose(*seen, atol=1e-9)


def matrix(T):
    return np.block([[T.rotation.as_matrix(), np.array(T.translation)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def turned(pan, tilt):
    """T_base_head of a head whose axes cross at right angles: pan about y, then tilt about x."""
    (cp, sp), (ct, st) = ((math.cos(a), math.sin(a)) for a in (pan, tilt))
    about_y = np.array([[cp, 0, sp, 0], [0, 1, 0, 0], [-sp, 0, cp, 0], [0, 0, 0, 1]])
    about_x = np.array([[1, 0, 0, 0], [0, ct, -st, 0], [0, st, ct, 0], [0, 0, 0, 1]])
    return about_y @ about_x


@pytest.mark.render
def test_boards_are_where_opencv_projects_them_at_every_focal_length():
    """Noise, JPEG and distortion on; the head turned, the board aside, and once while the lens travels.

    The zoom camera's chain is inv(turned T) T Gamma, and the pupil shifts it along the axis.
    """
    worst = []
    with (w := world(effects={"optics": True, "axes": False})).rig as rig:
        truth, sim = w.truth(), w.config.sim
        T, gamma = matrix(sim.T_head_zoom), matrix(sim.T_zoom0_fixed)
        pan, tilt = rig.head.move(0.06, -0.03, wait=True)
        T_zoom_fixed = np.linalg.inv(turned(pan, tilt) @ T) @ T @ gamma
        for magnification, corner, wait in (
            (1.0, (-0.28, -0.20, 0.9), 2.0),
            (2.2, (0.0, 0.0, 1.9), 2.0),
            (5.0, (-0.31, -0.06, 3.4), 2.0),
            (12.0, (-0.17, -0.11, 7.0), 2.0),
            (1.0, (-0.22, -0.1, 4.0), 0.3),
        ):
            T_zoom_board = matrix(pose(corner, [12, -17, 3]))
            T_fixed_board = np.linalg.inv(T_zoom_fixed) @ T_zoom_board
            rotvec = np.degrees(cv2.Rodrigues(T_fixed_board[:3, :3])[0].ravel())
            rig.board.present(pose(T_fixed_board[:3, 3], rotvec))
            rig.zoom.zoom(magnification * SHORTEST_PX)
            rig.clock.sleep_until(rig.clock.now() + wait)
            frame = rig.zoom.read(newer_than=rig.clock.now())
            assert rig.zoom.state().moving == (wait < 1)
            lens = truth.lens("zoom", frame.t)
            s = math.log(truth.nominal_at(frame.t) / SHORTEST_PX) / math.log(LONGEST)
            shift = np.eye(4)
            shift[2, 3] = -along(sim.zoom.pupil, s)
            T_camera_board = shift @ T_zoom_board
            K = np.diag([*lens.focal_px, 1.0])
            K[:2, 2] = lens.center_px
            expected = cv2.projectPoints(
                board_points(BOARD),
                cv2.Rodrigues(T_camera_board[:3, :3])[0],
                T_camera_board[:3, 3],
                K,
                np.array(lens.distortion),
            )[0].reshape(-1, 2)
            assert ((expected > 8) & (expected < np.array(lens.size) - 9)).all(), "the whole board must be seen"
            found = find_corners(frame.image, BOARD)
            assert found is not None
            np.testing.assert_allclose(found, expected, atol=ONE_CORNER_PX)
            worst.append(np.abs(np.mean(found - expected, axis=0)).max())
    print("mean offsets [px]:", *(f"{x:.3f}" for x in worst))
    assert max(worst) < PROJECTION_PX


@pytest.mark.render
def test_the_pupil_moves_the_optical_centre_along_the_axis():
    """At the longest focal length it stands 0.08 m behind the head's axes; the head looks 30 degrees to the right.

    Seen from there, a point 0.1 m aside of the axis and 1 m ahead of the axes is atan(0.1 / 1.08) off.
    """
    effects = {"all": False, "optics": True}
    zoom = STRAIGHT | {"pupil": [-0.05, -0.03], "center_px": [319.5, 239.5]}
    with (w := world(effects=effects, zoom=zoom, T_zoom0_fixed=HOME, T_head_zoom=HOME)).rig as rig:
        truth, pan = w.truth(), math.radians(30)
        x_world = truth.T_world_fixed.apply(
            [math.sin(pan) + 0.1 * math.cos(pan), 0, math.cos(pan) - 0.1 * math.sin(pan)]
        )
        misses = [truth.line_of_sight_miss(pan, 0.0, nominal, x_world) for nominal in rig.zoom.focal_range]
        assert misses == pytest.approx([math.atan2(0.1, 1.0), math.atan2(0.1, 1.08)], abs=EXACT)
        rig.head.move(pan, 0.0)
        rig.zoom.zoom(LONGEST * SHORTEST_PX)
        rig.clock.sleep_until(1.0)
        centre = truth.T_world_fixed.inv() * truth.T_world_camera("zoom", 1.0)
        np.testing.assert_allclose(centre.translation, [-0.08 * math.sin(pan), 0, -0.08 * math.cos(pan)], atol=EXACT)
        np.testing.assert_allclose(truth.T_world_camera("fixed", 1.0).translation, truth.T_world_fixed.translation)
        assert truth.pixel("zoom", x_world, 1.0) == pytest.approx([319.5 + 692 * LONGEST * 0.1 / 1.08, 239.5])


WALL = """<mujoco><statistic extent="10" center="0 5 1"/>
<worldbody><light pos="0 0 5"/><geom type="box" pos="0 0.5 1.6" size="2 .05 3"/>
<site name="fixed_mount" pos="0 0 1.6" euler="90 0 0"/></worldbody></mujoco>"""


@pytest.mark.render
def test_a_pupil_looks_past_what_it_has_moved_past(tmp_path):
    """A wall at 0.5 m hides a book at 10 m, but not from a pupil 0.9 m ahead, where it looks larger by 10 / 9.1."""
    scene = tmp_path / "wall.xml"
    scene.write_text(WALL)
    paths = {"book": [[0, 0, 10, 1.6], [9, 0, 10, 1.6]]}
    sides = []
    for pupil in ([], [0.9]):
        sim = {"scene": str(scene), "targets": ["book"], "paths": paths, "T_zoom0_fixed": HOME, "T_head_zoom": HOME}
        with (w := world(effects={"all": False, "optics": True}, zoom=STRAIGHT | {"pupil": pupil}, **sim)).rig as rig:
            rig.zoom.zoom(LONGEST * SHORTEST_PX)
            outline, truth = w.truth().silhouette("book", "zoom", 0.0), w.truth()
            assert outline.visible == outline.unhidden == pytest.approx(1.0 if pupil else 0.0)
            width, height = outline.size_px
            assert truth.largest_side_px("book", "zoom", 0.0) == pytest.approx(max(width, height))
            sides.append(width)
    assert sides[1] / sides[0] == pytest.approx(10 / 9.1, rel=SPINE)


@pytest.mark.render
def test_switched_off_the_lens_only_magnifies_whatever_the_curves():
    wild = {"focal_curve": [0.5], "center_drift_px": [[30], [-30]], "distortion_drift": [0.3], "pupil": [0.5]}
    images = []
    for zoom in ({}, wild):
        with (w := world(zoom=zoom, effects={"optics": False})).rig as rig:
            rig.zoom.zoom(3000.0)
            rig.clock.sleep_until(2.0)
            frame = rig.zoom.read()
            images.append(frame.image)
            lens, factor = w.truth().lens("zoom", frame.t), w.truth().nominal_at(frame.t) / SHORTEST_PX
            assert (lens.center_px, lens.distortion, lens.pupil) == ((326, 235), (-0.1, 0, 0, 0, 0), 0)
            assert lens.focal_px == pytest.approx((692 * factor, 693 * factor))
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize("k1", [-0.2, 2.0, 5.0, 100.0])
def test_a_lens_is_undone_however_much_it_stretches(k1):
    """By OpenCV's projection; where a lens stretches by two and more, plain steps go farther off each time."""
    distortion = (k1, 0.0, 1e-3, -2e-3, 0.0)
    lens = TrueLens((640, 480), (686.0, 684.0), (325.0, 239.0), distortion)
    pixels = np.stack(np.meshgrid(np.linspace(0, 639, 9), np.linspace(0, 479, 7)), axis=-1).reshape(-1, 2)
    rays = np.column_stack([lens.directions(pixels), np.ones(len(pixels))])
    K = np.array([[686.0, 0.0, 325.0], [0.0, 684.0, 239.0], [0.0, 0.0, 1.0]])
    back = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(distortion))[0][:, 0]
    np.testing.assert_allclose(back, pixels, atol=ROUNDING_PX)


@pytest.mark.parametrize("k", [(-0.2, 0.0, 0.0), (-0.1, -0.05, 0.0), (0.2, -0.1, -0.02)], ids=str)
def test_a_lens_folds_back_where_its_radius_is_largest(k):
    k1, k2, k3 = k
    r = np.linspace(0.0, 2.0, 200_001)
    radius = r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6)
    assert fold((k1, k2, 0.0, 0.0, k3)) == pytest.approx(r[np.argmax(radius)], abs=2e-5)
    assert fold((abs(k1), abs(k2), 0.0, 0.0, abs(k3))) == math.inf
