"""The synthetic rig's truth against what is worked by hand."""

from dataclasses import replace

import numpy as np
import pytest

from cotarget.geometry import RigidTransform, pose
from experiments.calibration.synthetic.aims import aimed
from experiments.calibration.synthetic.rig import Lens, Truth, undistorted, with_lever_shifted

STILL = RigidTransform.identity()
PLAIN = Lens(500.0, 500.0, 320.0, 240.0)
# Everything in one place, looking along +z.
PLAIN_RIG = Truth(fixed=PLAIN, zoom=PLAIN, gamma=STILL, hand=STILL, dz=0.0, eps=0.0)
ROUNDING = 1e-9


@pytest.mark.parametrize("lens", [
    PLAIN,
    Lens(686.0, 684.0, 325.0, 239.0, (-0.2, 0.05, 0.001, -0.002, 0.01)),
    Lens(686.0, 684.0, 325.0, 239.0, (0.5, 0, 0, 0, 0, 1.0, 0.3, 0)),
    Lens(686.0, 684.0, 325.0, 239.0, (-0.2, 0, 0, 0, 0, 0, 0, 0, 0.003, 0.002, -0.002, 0.001)),
    Lens(686.0, 684.0, 325.0, 239.0, (-0.15, 0.1, 0, 0), fisheye=True),
], ids=["plain", "usual", "rational", "thin prism", "fisheye"])  # fmt: skip
def test_undistorting_is_the_inverse_of_projecting(lens):
    pixels = np.array([[0.0, 0.0], [639.0, 479.0], [320.0, 240.0], [10.0, 400.0]])
    xy = undistorted(pixels, lens)
    assert np.allclose(lens.project(np.c_[xy, np.ones(4)]), pixels, rtol=0, atol=1e-7)
    assert np.allclose(undistorted(pixels[1], lens), xy[1])


def test_where_the_head_stands():
    at, came = np.array([0.2, -0.1]), np.array([0.1, 0.3])
    assert PLAIN_RIG.stands(at, came) == (0.2, -0.1)
    assert np.allclose(replace(PLAIN_RIG, play=0.02).stands(at, came), (0.19, -0.09))  # it lags behind
    assert np.allclose(replace(PLAIN_RIG, play=0.02).stands(at, at), at)
    assert np.allclose(replace(PLAIN_RIG, sag=0.01).stands(np.array([0.0, np.pi / 3])), (0.0, np.pi / 3 + 0.005))
    assert np.allclose(replace(PLAIN_RIG, pan_scale=1.1).stands(at), (0.22, -0.1))
    jittery = replace(PLAIN_RIG, jitter=0.01)
    drawn = np.array([jittery.stands(at, None, np.random.default_rng(i)) for i in range(400)])
    assert np.allclose(drawn.std(axis=0), 0.01, rtol=0.15)  # 400 tell it to 3.5 %
    assert jittery.stands(at) == (0.2, -0.1)


def test_a_lever_that_gives_or_slips():
    x = np.array([[0.0, 0.0, 5.0]])
    giving = replace(PLAIN_RIG, give=(0.0, 0.0, 0.1))
    assert np.allclose(giving.in_zoom(x, 0.0, 0.0), x)
    # Tilted up by 0.2, the camera has moved forward by 0.02 along its own axis.
    tilted = PLAIN_RIG.in_zoom(x, 0.0, 0.2)
    assert np.allclose(giving.in_zoom(x, 0.0, 0.2), tilted - [0.0, 0.0, 0.02])
    slipped = with_lever_shifted(replace(PLAIN_RIG, gamma=pose([-0.4, 0, 0], [0, 0, 0])), (0.0, 0.1, 0.0))
    # The camera is 0.1 lower on a head that stands where it stood.
    assert np.allclose(slipped.in_zoom(x, 0.0, 0.0), [[-0.4, -0.1, 5.0]])


def test_aiming_at_points_one_each():
    x, rays = np.array([[1.0, 0.0, 1.0], [0.0, -1.0, 2.0], [0.0, 0.0, -3.0]]), np.array([0.0, 0.0, 1.0])
    assert np.allclose(np.abs(aimed(PLAIN_RIG, x, rays)[:2]), [[np.pi / 4, 0.0], [0.0, np.arctan(0.5)]])
    x_zoom = Truth().in_zoom(x[:2] * 5, *aimed(Truth(), x[:2] * 5, rays).T)
    assert np.allclose(x_zoom[:, :2] / x_zoom[:, 2:], 0.0, atol=ROUNDING)
