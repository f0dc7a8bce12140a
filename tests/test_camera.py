"""Intrinsics against cv2.projectPoints and the numbers of the paper's Section 4.2."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cotarget.camera import Intrinsics, ZoomLens, depth_from_size
from cotarget.errors import ConfigError

# Table 2 as (u, v); the paper lists rows as [v, u].
FIXED = Intrinsics(size=(640, 480), focal_px=(686.0, 684.0), center_px=(325.0, 239.0))
ZOOM = Intrinsics(size=(640, 480), focal_px=(692.0, 693.0), center_px=(326.0, 235.0))
DISTORTED = Intrinsics((640, 480), (690.0, 700.0), (325.0, 231.0), (-0.25, 0.07, 0.002, -0.001, -0.004))
PROJECTION_PX = 1e-9  # both are double precision
TANGENT = 1e-12
ROUND_TRIP_PX = 1e-8
MIDDLE = np.array(FIXED.center_px)
BOX_TILT = 5e-3  # distortion bends the stick a little out of the box's middle line


def test_projection_is_opencvs():
    rng = np.random.default_rng(0)
    x = np.column_stack([rng.uniform(-0.45, 0.45, (500, 2)), np.ones(500)]) * rng.uniform(1, 30, (500, 1))
    expected = cv2.projectPoints(x, np.zeros(3), np.zeros(3), DISTORTED.matrix, np.array(DISTORTED.distortion))[0]
    np.testing.assert_allclose(DISTORTED.project(x), expected.reshape(-1, 2), atol=PROJECTION_PX)


def test_ray_undoes_projection_all_over_the_image():
    u, v = np.meshgrid(np.linspace(0, 639, 33), np.linspace(0, 479, 25))
    pixels = np.stack([u, v], axis=-1)
    rays = DISTORTED.ray(pixels)
    assert (rays[..., 2] == 1).all()
    np.testing.assert_allclose(DISTORTED.project(rays * 7.0), pixels, atol=ROUND_TRIP_PX)


def test_points_behind_or_beyond_the_fold_are_nan():
    assert np.isnan(DISTORTED.project(np.array([0.0, 0.0, -1.0]))).all()
    assert np.isnan(DISTORTED.project(np.array([0.1, 0.0, 0.0]))).all()
    folded = Intrinsics((640, 480), (690.0, 690.0), (320.0, 240.0), (-0.3, 0, 0, 0, 0))
    assert np.isnan(folded.project(np.array([1.5, 0.0, 1.0]))).all()  # folds at r = 1 / sqrt(0.9)
    assert np.isnan(folded.ray(np.array([5000.0, 240.0]))).all()


def test_tangents_of_one_pixel_equal_rays_and_their_differences():
    pixels = np.random.default_rng(1).uniform((0, 0), (639, 479), (50, 2))
    for pixel, ray in zip(pixels, DISTORTED.ray(pixels), strict=True):
        tangent, slope = DISTORTED.tangents(pixel)
        np.testing.assert_allclose(tangent, ray[:2], atol=TANGENT)
        np.testing.assert_allclose(DISTORTED.ray(pixel), ray, atol=TANGENT)
        apart = DISTORTED.ray(pixel + 0.1 * np.vstack([np.eye(2), -np.eye(2)]))[:, :2]
        np.testing.assert_allclose(slope, (apart[:2] - apart[2:]).T / 0.2, atol=1e-8)
    assert DISTORTED.tangents(np.array([5e4, 240.0])) is None
    assert DISTORTED.tangents(np.array([np.nan, 0.0])) is None
    assert replace(DISTORTED, distortion=(-0.6, 0, 0, 0, 0)).tangents(np.array([-400.0, -300.0])) is None


@pytest.mark.parametrize(
    ("k1", "k2", "k3"), [(-0.3, 0, 0), (-0.3, 0.05, 0), (-0.9, 0.6, -0.12), (0.2, -0.4, 0.1), (-0.3, 0.2, 0)]
)
def test_the_fold_is_where_the_polynomial_turns(k1, k2, k3):
    """Where r (1 + k1 r^2 + k2 r^4 + k3 r^6) stops growing, by stepping outwards."""
    camera = Intrinsics((640, 480), (500.0, 500.0), (320.0, 240.0), (k1, k2, 0, 0, k3))
    r = np.linspace(1e-4, 3, 30001)
    grown = r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6)
    falls = np.flatnonzero(np.diff(grown) <= 0)
    first = falls[0] if len(falls) else len(r)
    seen = np.isfinite(camera.project(np.column_stack([r, 0 * r, 0 * r + 1]))[:, 0])
    assert seen[: first - 1].all()
    assert not seen[first + 2 :].any()


def test_the_papers_worked_example():
    """Pixel (529, 275) at 10 m; printed (2973, 519, 10000) mm: the first is cut, the second needs a centre of 239.5."""
    x = FIXED.ray(np.array([529.0, 275.0])) * 10000
    assert np.floor(x[0]) == 2973
    assert round(x[0], 1) == 2973.8
    assert round(x[1], 1) == 526.3
    with_half = Intrinsics((640, 480), (686.0, 684.0), (325.0, 239.5)).ray(np.array([529.0, 275.0])) * 10000
    assert round(with_half[1]) == 519


def test_depth_from_size_is_the_inverse_of_projection():
    assert depth_from_size(FIXED, 0.234, 686 * 0.234 / 10, MIDDLE, vertical=False) == pytest.approx(10)
    assert depth_from_size(FIXED, 1.75, 684 * 1.75 / 12, MIDDLE, vertical=True) == pytest.approx(12)
    assert np.isnan(depth_from_size(FIXED, 1.0, 0.0, MIDDLE, vertical=False))


@pytest.mark.parametrize("vertical", [False, True])
@pytest.mark.parametrize("middle", [(0.0, 0.0), (3.0, -1.5), (-4.2, 2.0), (3.9, 2.9)])
def test_depth_from_size_knows_distortion(middle, vertical):
    """A stick of 0.5 m at 10 m, its ends projected by OpenCV: f size / u alone would be off by up to 14 percent."""
    lens = Intrinsics((640, 480), (690.0, 700.0), (325.0, 231.0), (-0.2, 0, 0, 0, 0))
    stick = np.array([[0.0, 0.25, 0.0] if vertical else [0.25, 0.0, 0.0]])
    ends = np.array([*middle, 10.0]) + np.vstack([-stick, stick])
    px = cv2.projectPoints(ends, np.zeros(3), np.zeros(3), lens.matrix, np.array(lens.distortion))[0].reshape(2, 2)
    size_px = np.ptp(px[:, 1 if vertical else 0])
    depth = depth_from_size(lens, 0.5, size_px, px.mean(axis=0), vertical=vertical)
    assert depth == pytest.approx(10.0, rel=BOX_TILT)


def test_zoom_lens_keeps_its_ratio_beyond_one_stop():
    lens = ZoomLens((667.0,), (ZOOM,))
    assert lens.at(667.0).focal_px == pytest.approx(ZOOM.focal_px)
    assert lens.at(6670.0).focal_px == pytest.approx((6920.0, 6930.0))
    assert lens.at(lens.nominal_for(5000.0)).focal_px[0] == pytest.approx(5000.0)


def test_zoom_lens_interpolates_between_stops():
    far = Intrinsics((640, 480), (2800.0, 2804.0), (330.0, 239.0), (-0.3, 0, 0, 0, 0))
    lens = ZoomLens((700.0, 2800.0), (Intrinsics((640, 480), (700.0, 701.0), (326.0, 235.0)), far))
    middle = lens.at(1400.0)  # half way in the logarithm
    assert middle.center_px == pytest.approx((328.0, 237.0))
    # In the image the far stop's distortion is that of k1 = -0.3 / 4^2 at the near one; half of it, twice magnified.
    assert middle.distortion[0] == pytest.approx(-0.3 / 4**2 / 2 * 2**2)
    assert lens.at(350.0).center_px == (326.0, 235.0)  # beyond the stops, the last one holds
    assert lens.at(350.0).focal_px == pytest.approx((350.0, 350.5))
    assert lens.at(lens.nominal_for(1234.0)).focal_px[0] == pytest.approx(1234.0)


def test_a_spline_through_eight_stops_follows_a_smooth_lens():
    """Twelvefold zoom: a sine's period of 3 % in focal length, 10 px in the centre, 5 cm in the pupil."""
    nominal = 667 * 12 ** (np.arange(8) / 7)

    def true(n):
        s = np.log(n / 667) / np.log(12)
        wave = np.sin(2 * np.pi * s)
        f, k = n * (1 + 0.03 * wave), -0.1 * (1 - wave) * (n / 667) ** 2
        return Intrinsics((640, 480), (f, f), (320 + 10 * wave, 240.0), (k, 0, 0, 0, 0)), 0.05 * (np.cos(3 * s) - 1)

    lenses, pupils = zip(*(true(n) for n in nominal), strict=True)
    zoom = ZoomLens(tuple(nominal), lenses, pupils)
    for n in np.geomspace(667, 8004, 50):
        lens, pupil = true(n)
        found = zoom.at(n)
        # A cubic through points h = 1/7 apart misses sin(2 pi s) by up to (2 pi h)^4 / 384 inside, ten times that at
        # the ends, where it has no slope to go by.
        assert found.focal_px[0] == pytest.approx(lens.focal_px[0], rel=0.03 * 0.02)
        assert found.center_px[0] == pytest.approx(lens.center_px[0], abs=10 * 0.02)
        assert zoom.pupil_at(n) == pytest.approx(pupil, abs=0.05 * 0.02)
        corner = np.array([600.0, 400.0])
        assert found.project(lens.ray(corner)) == pytest.approx(corner, abs=1.0)


def test_the_nominal_focal_length_is_the_inverse_of_the_true_one_within_the_stops_and_beyond():
    lens = ZoomLens(
        (700.0, 1500.0, 3000.0, 8000.0), tuple(replace(ZOOM, focal_px=(f, f)) for f in (730.0, 1450.0, 3200.0, 7900.0))
    )
    for nominal in (300.0, 700.0, 705.0, 1500.0, 2222.0, 7999.0, 8000.0, 12000.0):
        assert lens.nominal_for(lens.at(nominal).focal_px[0]) == pytest.approx(nominal, rel=1e-13)


def test_zoom_lens_refuses_stops_out_of_order():
    with pytest.raises(ConfigError, match="pupil"):
        ZoomLens((700.0, 1400.0), (ZOOM, ZOOM), (0.1, 0.2))
    with pytest.raises(ConfigError, match="increase"):
        ZoomLens((700.0, 700.0), (ZOOM, ZOOM))
