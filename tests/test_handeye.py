"""Park and Martin on exact motions, and motions that must be refused."""

import numpy as np
import pytest

from cotarget.calibration.handeye import motions, park_martin
from cotarget.errors import CalibrationError
from cotarget.geometry import RigidTransform, pose
from experiments.synthetic import Truth

EXACT = 1e-10  # m and rad: noise-free motions leave only rounding


def exact_motions(hand, angles, truth=None):
    """Motions of a head with crossing or real axes, and of a camera that watches one board."""
    truth = truth or Truth(hand=hand, dz=0.0, eps=0.0)
    heads = [RigidTransform.from_matrix(truth.base_head(pan, tilt)) for pan, tilt in angles]
    board = pose([0.3, -0.2, 4.0], [10.0, 20.0, 30.0])  # in the base's frame
    return motions(heads, [hand.inv() * head.inv() * board for head in heads])


@pytest.mark.parametrize("angles", [
    [(0.0, 0.0), (0.2, 0.0), (0.0, 0.2)],
    [(0.1, -0.3), (0.4, 0.2), (-0.5, 0.1), (0.3, 0.3)],
])  # fmt: skip
def test_exact_motions_give_t_exactly(angles):
    rng = np.random.default_rng(1)
    for _ in range(20):
        hand = pose(rng.uniform(-0.3, 0.3, 3), rng.uniform(-90, 90, 3))
        A, B = exact_motions(hand, angles)
        error = park_martin(A, B).inv() * hand
        assert error.rotation.magnitude() < EXACT
        assert np.linalg.norm(error.translation) < EXACT


@pytest.mark.parametrize(("angles", "message"), [
    ([(0.0, 0.1), (0.2, 0.1), (-0.3, 0.1)], "only pan moved.*add views with other tilt"),
    ([(0.1, 0.0), (0.1, 0.2), (0.1, -0.3)], "only tilt moved.*add views with other pan"),
    ([(0.1, 0.1), (0.1, 0.1)], "did not move"),
])  # fmt: skip
def test_motions_about_one_axis_are_refused_in_words(angles, message):
    with pytest.raises(CalibrationError, match=message):
        park_martin(*exact_motions(pose([0.1, 0.0, 0.0], [1.0, 2.0, 3.0]), angles))


HAND = pose([0.02, -0.08, 0.05], [0.7, -1.4, 0.5])
ANGLES = [(0.0, 0.0), (0.3, 0.1), (-0.2, 0.3), (0.4, -0.3), (-0.4, -0.2)]


def test_a_head_that_counts_the_other_way_is_the_same_head_turned_round():
    _, B = exact_motions(HAND, ANGLES)
    A, _ = exact_motions(HAND, [(-pan, tilt) for pan, tilt in ANGLES])
    turned = pose([0, 0, 0], [180, 0, 0]) * HAND  # Rot(X, pi) Rot(Y, pan) = Rot(Y, -pan) Rot(X, pi)
    assert (park_martin(A, B).inv() * turned).rotation.magnitude() < EXACT


def test_motions_the_wrong_way_round_are_a_reflection():
    A, B = exact_motions(HAND, ANGLES)
    with pytest.raises(CalibrationError, match="determinant -1"):
        park_martin(A, [b.inv() for b in B])


def test_exchanged_pan_and_tilt_are_noticed():
    angles = [(0.0, 0.0), (0.9, 0.3), (-0.8, 0.5), (0.7, -0.6), (-0.9, -0.2)]
    _, B = exact_motions(HAND, angles)
    A, _ = exact_motions(HAND, [(tilt, pan) for pan, tilt in angles])
    with pytest.raises(CalibrationError, match="pan and tilt are not exchanged"):
        park_martin(A, B)


def test_a_camera_that_does_not_turn_with_the_head_is_noticed():
    A, _ = exact_motions(HAND, ANGLES)
    with pytest.raises(CalibrationError, match=r"turned by 0\.0"):
        park_martin(A, [RigidTransform.identity()] * len(A))
