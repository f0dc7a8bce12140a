"""Kinematics against independent truths: MuJoCo-free matrices, hand-worked cases, the paper's numbers."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from cotarget.errors import UnreachableError
from cotarget.geometry import angle_between, pose
from cotarget.pantilt import HeadGeometry, base_head, nearest, shortcut, solve, towards

RIGS, TARGETS = 100, 200  # 20,000 targets
MISS_DEG = 1e-9  # the figure to reach
ROUNDING = 1e-12
SAME_ANGLES = 1e-7  # [rad]; near the pan axis the angles are ill-conditioned though the aim is not
RAY = (0.1, -0.05, 1.0)
MADE_FROM_FOUND = 0.9998  # the rest lie where both branches meet, and either may be given


def matrix_head(pan, tilt, dz, eps):
    """T_base_head, (..., 4, 4), from matrices written out, independent of scipy's rotations."""

    def about(axis, angle):
        x, y, z = axis
        K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        angle = np.asarray(angle)[..., None, None]
        M = np.zeros((*angle.shape[:-2], 4, 4)) + np.eye(4)
        M[..., :3, :3] += np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
        return M

    def shift(z):
        M = np.eye(4)
        M[2, 3] = z
        return M

    return about((0, 1, 0), pan) @ shift(dz) @ about((np.cos(eps), np.sin(eps), 0), tilt) @ shift(-dz)


def miss(pan, tilt, x_base, T, head, ray=(0.0, 0.0, 1.0)):
    """The angle between the zoom camera's ray and the target [rad]."""
    M = np.linalg.inv(matrix_head(pan, tilt, head.axis_offset, head.squareness))
    x_zoom = T.inv().apply(np.einsum("...ij,...j->...i", M[..., :3, :3], x_base) + M[..., :3, 3])
    return angle_between(x_zoom, np.broadcast_to(ray, x_zoom.shape))


def test_forward_is_equation_8():
    pan, tilt = 0.7, -0.4
    (c1, s1), (c2, s2) = ((np.cos(a), np.sin(a)) for a in (pan, tilt))
    expected = [[c1, s1 * s2, s1 * c2], [0, c2, -s2], [-s1, c1 * s2, c1 * c2]]
    np.testing.assert_allclose(base_head(pan, tilt).as_matrix()[:3, :3], expected, atol=ROUNDING)


def test_forward_of_a_real_head():
    rng = np.random.default_rng(1)
    for pan, tilt, dz, eps in rng.uniform(-1, 1, (50, 4)):
        got = base_head(pan, tilt, HeadGeometry(dz, eps)).as_matrix()
        np.testing.assert_allclose(got, matrix_head(pan, tilt, dz, eps), atol=ROUNDING)


def random_rig(rng):
    T = RigidTransform.from_components(rng.uniform(-0.3, 0.3, 3), Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3)))
    head = HeadGeometry(*(rng.uniform(-1, 1, 2) * (0.02, 0.02) * rng.integers(0, 2)))
    return T, head


def test_inverse_hits_random_targets_in_both_branches():
    """Targets made by the forward matrices from known angles are hit, and the known angles are found."""
    rng = np.random.default_rng(2)
    worst, found = 0.0, 0
    for _ in range(RIGS):
        T, head = random_rig(rng)
        pan, tilt, r = (rng.uniform(lo, hi, TARGETS) for lo, hi in ((-np.pi, np.pi), (-1.4, 1.4), (2, 50)))
        ray = np.append(rng.uniform(-0.4, 0.4, 2), 1.0)
        ray /= np.linalg.norm(ray)
        H = matrix_head(pan, tilt, head.axis_offset, head.squareness)
        x_head = T.apply(r[:, None] * ray)
        x_base = np.einsum("nij,nj->ni", H[:, :3, :3], x_head) + H[:, :3, 3]
        solutions = solve(x_base, T, head, ray)
        assert np.isfinite(solutions.pan).any(axis=1).all()
        for branch in range(2):
            ok = np.isfinite(solutions.pan[:, branch])
            p, q = solutions.pan[ok, branch], solutions.tilt[ok, branch]
            worst = max(worst, np.degrees(miss(p, q, x_base[ok], T, head, ray)).max())
        turned = np.abs(np.exp(1j * solutions.pan) - np.exp(1j * pan[:, None]))
        turned += np.abs(np.exp(1j * solutions.tilt) - np.exp(1j * tilt[:, None]))
        found += np.count_nonzero(np.min(np.nan_to_num(turned, nan=9.0), axis=1) < SAME_ANGLES)
    assert worst < MISS_DEG
    assert found >= MADE_FROM_FOUND * RIGS * TARGETS


def test_a_pupil_that_has_moved_is_a_camera_that_has():
    """Of one target and of many: too near to be reached, on the pan axis and anywhere else."""
    rng = np.random.default_rng(3)
    for _ in range(100):
        T, head = random_rig(rng)
        pupil = rng.uniform(0.0, 0.1)
        targets = np.vstack([rng.uniform(-5, 5, (5, 3)), rng.uniform(-0.2, 0.2, (3, 3)), [0.0, 2.0, 0.0]])
        moved = T * RigidTransform.from_translation([0.0, 0.0, pupil])
        many = solve(targets, moved, head, RAY)
        for i, target in enumerate(targets[:-1]):
            one = solve(target, T, head, RAY, pupil=pupil)
            for name in ("pan", "tilt", "range"):
                np.testing.assert_allclose(getattr(one, name), getattr(many, name)[i], rtol=1e-6, atol=SAME_ANGLES)
        on_axis = solve(targets[-1], T, head, RAY, pupil=pupil)
        reached = np.isfinite(on_axis.pan)
        assert np.all(miss(on_axis.pan[reached], on_axis.tilt[reached], targets[-1], moved, head, RAY) < SAME_ANGLES)


def test_hand_worked_target():
    """Camera on the axes, target 45 degrees right and as high as far: pan 45, tilt atan(1 / sqrt 2)."""
    solution = nearest(solve(np.array([1.0, -1.0, 1.0]), RigidTransform.identity()), (-2, 2), (-1.5, 1.5))
    assert np.degrees(solution.pan) == pytest.approx(45)
    assert np.degrees(solution.tilt) == pytest.approx(35.264389682754654)
    assert solution.range == pytest.approx(np.sqrt(3))
    assert towards(np.array([1.0, -1.0, 1.0])) == pytest.approx((solution.pan, solution.tilt))


WIDE = (-np.pi, np.pi)


@pytest.mark.parametrize(("target", "pan_limits", "tilt_limits", "now", "expected"), [
    ((0.0, 0.0, 5.0), WIDE, WIDE, (0.0, 0.0), (0.0, 0.0)),
    ((0.0, 0.0, 5.0), WIDE, WIDE, (3.1, 3.1), (np.pi, np.pi)),  # the other branch, over the top
    # To (0, 0) pan turns by 2.0 and tilt not at all; over the top pan turns by 1.1, and tilt by half a turn.
    ((0.0, 0.0, 5.0), WIDE, WIDE, (2.0, 0.0), (0.0, 0.0)),
    ((-0.1, 0.0, -5.0), (-4, 4), (-1, 1), (3.0, 0.0), (np.pi + np.arctan(0.1 / 5), 0.0)),  # a whole turn on
])  # fmt: skip
def test_nearest_minimises_the_larger_travel_of_both_axes(target, pan_limits, tilt_limits, now, expected):
    found = nearest(solve(np.array(target), RigidTransform.identity()), pan_limits, tilt_limits, now)
    assert np.abs((found.pan, found.tilt)) == pytest.approx(np.abs(expected), abs=ROUNDING)


def test_target_beyond_the_limits_is_refused_with_its_angles():
    with pytest.raises(UnreachableError, match=r"needs pan 90\.00, tilt 0\.00.*limits pan -45 to 45, tilt -30 to 30"):
        nearest(solve(np.array([5.0, 0, 0]), RigidTransform.identity()), np.radians((-45, 45)), np.radians((-30, 30)))


def test_a_target_inside_the_lever_arm_has_no_solution():
    T = RigidTransform.from_translation([0.0, 0.3, 0.0])
    solutions = solve(np.array([0.05, 0.0, 0.05]), T)
    assert np.isnan(solutions.pan).all()
    with pytest.raises(UnreachableError, match="too close"):
        nearest(solutions, (-2, 2), (-2, 2))


def test_shortcut_is_exact_only_where_depth_is_range():
    """Straight ahead of a camera at the axes both readings agree with the exact solution; off axis they miss."""
    gamma, T = pose([-0.4, 0.0, 0.0], [0, 0, 0]), pose([0.0, -0.1, 0.05], [0, 0, 0])
    x_fixed = np.array([0.4, 0.0, 10.0])
    exact = nearest(solve(T.apply(gamma.apply(x_fixed)), T), (-2, 2), (-1, 1))
    for reading in ("table", "example"):
        near = shortcut(x_fixed, gamma, T, reading)
        assert near.pan == pytest.approx(exact.pan, abs=1e-9)
        assert near.tilt == pytest.approx(exact.tilt, abs=1e-9)
    off_axis = np.array([3.6, -2.5, 10.0])
    x_base = T.apply(gamma.apply(off_axis))
    near = shortcut(off_axis, gamma, T, "table")
    assert np.degrees(miss(near.pan, near.tilt, x_base, T, HeadGeometry())) > 0.01
    assert np.isnan(shortcut(np.array([30.0, 0.0, 1.0]), gamma, T, "table").pan)  # |a| > r2
