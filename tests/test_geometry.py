"""Conventions, by hand-worked cases."""

import numpy as np
import pytest

from cotarget.geometry import angle_between, intersection_areas, pose, pose_dict


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
