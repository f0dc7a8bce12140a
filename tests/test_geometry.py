"""Geometry: poses and angles, and that of a calibrated rig by hand-worked rigs and by the simulated truth."""

import cv2
import numpy as np
import pytest

from cotarget.camera import Intrinsics, ZoomLens
from cotarget.errors import CalibrationError, ConfigError
from cotarget.geometry import RigidTransform, angle_between, intersection_areas, pose, pose_dict
from cotarget.pantilt import HeadGeometry
from cotarget.rig_geometry import FixedCamera, ZoomHead
from experiments.calibration.synthetic.rig import NOMINAL_PX, SIZE, Truth


def test_names_chain():
    T_a_b, T_b_c = pose([1, 2, 3], [0, 90, 0]), pose([0, 0, 1], [0, 0, 0])
    # c's origin lies at z = 1 of b; b's z is a's x after 90 degrees about y
    np.testing.assert_allclose((T_a_b * T_b_c).apply([0, 0, 0]), [2, 2, 3], atol=1e-15)


def test_pose_dict_is_the_inverse_of_pose():
    T = pose([0.1, -0.2, 0.3], [10, -20, 30])
    written = pose_dict(T)
    assert written["rotvec_deg"] == pytest.approx([10, -20, 30])
    np.testing.assert_allclose(pose(**written).as_matrix(), T.as_matrix(), atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.5, np.pi - 1e-9, np.pi])
def test_angle_between_is_exact_at_both_ends(angle):
    assert angle_between(np.array([2.0, 0, 0]), 3 * np.array([np.cos(angle), np.sin(angle), 0])) == pytest.approx(
        angle, abs=1e-15
    )


def test_areas_that_boxes_share():
    """By hand: 4x2 and 2x4 boxes, side by side, across and apart."""
    center, size = np.array([[0.0, 0.0], [10.0, 0.0]]), np.array([[4.0, 2.0], [4.0, 2.0]])
    others, sizes = np.array([[1.0, 0.0], [11.5, 1.0], [2.0, 9.0]]), np.array([[2.0, 4.0], [2.0, 2.0], [2.0, 2.0]])
    np.testing.assert_allclose(intersection_areas(center, size, others, sizes), [[4, 0, 0], [0, 1.5, 0]])


LENS = Intrinsics((641, 481), (500.0, 500.0), (320.0, 240.0))
STILL = RigidTransform.identity()
FORWARD = -0.1  # the pupil at twice the shortest focal length [m], backwards
TURN = np.arctan(0.5)  # x = 1 at z = 2
PIXEL = 1e-9  # double precision through a few transforms


def head_of(T_zoom0_fixed=STILL, T_head_zoom=STILL):
    lens = ZoomLens((500.0, 1000.0), (LENS, LENS.scaled(2.0)), (0.0, FORWARD))
    return ZoomHead(lens, T_zoom0_fixed, T_head_zoom)


def test_a_point_is_seen_by_the_turned_camera_through_the_pupil_at_its_focal_length():
    """Half a metre aside of the zoom camera at home, straight ahead once the head has turned."""
    head = head_of(RigidTransform.from_translation([0.5, 0.0, 0.0]))
    x_fixed = np.array([0.5, 0.0, 2.0])
    np.testing.assert_allclose(head.project(x_fixed, 0.0, 0.0, 500.0), [320 + 500 / 2, 240], atol=PIXEL)
    np.testing.assert_allclose(head.project(x_fixed, TURN, 0.0, 500.0), [320, 240], atol=PIXEL)
    np.testing.assert_allclose(head.project(x_fixed, 0.0, 0.0, 1000.0), [320 + 1000 / 2.1, 240], atol=PIXEL)
    assert np.isnan(head.project(-x_fixed, 0.0, 0.0, 500.0)).all()


def test_the_cameras_pose_and_projection_are_those_of_the_true_rig():
    truth, rng = Truth(), np.random.default_rng(0)
    lens = Intrinsics(SIZE, (truth.zoom.fx, truth.zoom.fy), (truth.zoom.cx, truth.zoom.cy), truth.zoom.distortion)
    head = ZoomHead(ZoomLens((NOMINAL_PX,), (lens,)), truth.gamma, truth.hand, HeadGeometry(truth.dz, truth.eps))
    for pan, tilt in rng.uniform(-0.3, 0.3, (5, 2)):
        M = truth.zoom_fixed(pan, tilt)
        np.testing.assert_allclose(head.T_fixed_zoom(pan, tilt).as_matrix(), np.linalg.inv(M), atol=PIXEL)
        x_zoom = rng.uniform([-0.4, -0.3, 4.0], [0.4, 0.3, 6.0], (4, 3))
        x_fixed = head.T_fixed_zoom(pan, tilt).apply(x_zoom)
        np.testing.assert_allclose(head.project(x_fixed, pan, tilt, NOMINAL_PX), truth.zoom.project(x_zoom), atol=1e-6)


def test_a_point_in_the_base_and_the_hand_eye_at_a_focal_length():
    head = head_of(pose([0.5, 0, 0], [0, 0, 0]), pose([0, 0.2, 0], [0, 0, 0]))
    np.testing.assert_allclose(head.in_base(np.array([1.0, 2.0, 3.0])), [1.5, 2.2, 3.0])
    np.testing.assert_allclose(head.T_base_fixed.apply([1.0, 2.0, 3.0]), [1.5, 2.2, 3.0])
    np.testing.assert_allclose(head.hand_eye().translation, [0, 0.2, 0])
    np.testing.assert_allclose(head.hand_eye(1000.0).translation, [0, 0.2, FORWARD], atol=PIXEL)


def test_without_a_calibrated_head_there_is_no_pose_in_the_base():
    head = head_of(T_head_zoom=None)
    for wanted in (head.hand_eye, lambda: head.in_base(np.ones(3)), lambda: head.project(np.ones(3), 0, 0, 500.0)):
        with pytest.raises(CalibrationError, match="no T_head_zoom"):
            wanted()


def test_a_turned_fixed_camera_gives_the_rays_of_before():
    """OpenCV projects points into a camera that was turned; the shift of the point ahead says by how much."""
    size, center, focal, distortion = (640, 480), (319.5, 239.5), 500.0, np.array([-0.2, 0.0, 0.0, 0.0])
    K = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1.0]])
    rotated = np.radians([0.6, -0.8, 0.0])  # from the frame before to the turned camera's
    seen = cv2.projectPoints(
        np.array([[0, 0, 1], [0.3, -0.2, 1], [0.3001, -0.2, 1]]), rotated, np.zeros(3), K, distortion
    )
    ahead, there, beside = seen[0][:, 0]
    camera = FixedCamera(Intrinsics(size, (focal, focal), center, (*distortion.tolist(), 0.0))).turned(ahead - center)
    tangent, slope = camera.tangents(there)
    np.testing.assert_allclose(tangent, [0.3, -0.2], atol=1e-4)  # 0.05 px
    np.testing.assert_allclose(slope @ (beside - there), [1e-4, 0.0], atol=1e-7)
    assert camera.resized((320, 240)).turn == camera.turn


def test_cameras_follow_the_size_of_their_streams():
    fixed, head = FixedCamera(LENS), head_of()
    with pytest.raises(ConfigError, match="another aspect ratio"):
        fixed.resized((640, 240))
    half = FixedCamera(Intrinsics(SIZE, (500.0, 500.0), (319.5, 239.5))).resized((320, 240))
    np.testing.assert_allclose(half.project(np.array([1.0, 0.0, 2.0])), [159.5 + 125, 119.5])
    np.testing.assert_allclose(half.ray(np.array([159.5 + 125, 119.5])), [0.5, 0.0, 1.0])
    assert head.resized((1282, 962)).lens.nominal_px == (1000.0, 2000.0)
    assert half.size == (320, 240)
