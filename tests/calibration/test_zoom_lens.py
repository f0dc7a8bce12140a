"""A session on a rig whose lens zooms, against its true optics over the range."""

import weakref
from dataclasses import replace

import cv2
import numpy as np
import pytest

from cotarget.calibration import Options, captures, predicted_pointing
from cotarget.calibration.calibrate import calibrate, find_views
from cotarget.calibration.zoom_samples import with_stop
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import BoardConfig
from cotarget.geometry import RigidTransform
from experiments.calibration.synthetic.aims import draw_targets, misses
from experiments.calibration.synthetic.rig import NOMINAL_PX, SIZE, Truth, undistorted
from tests.support.rigs import with_zoom_head
from tests.support.synthetic_rig import FOURFOLD, SyntheticRig, fourfold, zoomed

BOARD = BoardConfig()
QUICK = Options(folds=0)
STOPS = 4
BEYOND = 6  # images beyond the shortest focal length, of a test that takes few
# Every stop, and the middle between any two.
FOCAL_LENGTHS = np.geomspace(NOMINAL_PX, FOURFOLD * NOMINAL_PX, 2 * STOPS - 1)
TARGETS = 40
# A cubic through four points h apart misses sin(pi s / 2) by up to (pi / 2)^4 h^4 / 24 = 0.003: a hundredth of a
# percent of the focal length. Corners of 0.05 px on parts of boards of 300 px give two or three hundredths more.
FOCAL_TOLERANCE = 0.003
# A dozen placements leave the principal point 0.2 px uncertain (0.017 degrees) and so T, which is correlated with it.
BORESIGHT_TOLERANCE = np.radians(0.04)
# One seed's error is one draw of some thirty parameters, of which two or three matter: thrice the prediction is beyond
# chance. The prediction itself is 0.002 to 0.005 degrees, most of it at the wide image's corners, where a dozen
# placements hardly reach.
POINTING_FACTOR = 3.0
PREDICTED_TOLERANCE = np.radians(0.01)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A calibration from a dozen placements and three far ones, the folder of its captures, and the rig afterwards."""
    directory = tmp_path_factory.mktemp("captures")
    rig, asked = SyntheticRig(optics=fourfold), {"placements": 12, "stops": STOPS, "far_placements": 3}
    return calibrate(rig, BOARD, captures_dir=directory, options=QUICK, **asked), directory, rig


def at(calibration, nominal_px):
    """The calibration at one focal length, as if that were the only one."""
    to_pupil = RigidTransform.from_translation([0.0, 0.0, calibration.zoom_head.lens.pupil_at(nominal_px)])
    return with_zoom_head(
        calibration,
        lens=ZoomLens((nominal_px,), (calibration.zoom_head.lens.at(nominal_px),)),
        T_zoom0_fixed=to_pupil.inv() * calibration.zoom_head.T_zoom0_fixed,
        T_head_zoom=calibration.zoom_head.T_head_zoom * to_pupil,
    )


def test_session_finds_every_zoom_sample(session):
    calibration, _, rig = session
    assert (rig.focal_px, rig.pose) == (NOMINAL_PX, (0.0, 0.0))
    assert calibration.zoom_head.lens.nominal_px == pytest.approx(FOCAL_LENGTHS[::2])
    assert {view.focal_px for view in calibration.views if view.camera == "zoom"} == set(
        calibration.zoom_head.lens.nominal_px
    )
    assert calibration.residuals.rejected == ()
    in_part = [view for view in calibration.views if not view.seen.all()]
    assert in_part, "at four times the focal length a board fills more than the image"


def test_saved_images_are_in_memory_one_at_a_time(session, monkeypatch):
    """Of 8 MP stills each takes 24 MB."""
    _, directory, _ = session
    alive, most, decode = 0, 0, cv2.imdecode

    def decoded(*args):
        nonlocal alive, most
        image, alive = decode(*args), alive + 1
        most = max(most, alive)
        weakref.finalize(image, gone)
        return image

    def gone():
        nonlocal alive
        alive -= 1

    index = captures.read_index(directory)
    beyond = [one for one in index.captures if one.focal_px is not None and one.focal_px > 1.1 * NOMINAL_PX]
    few = [one for one in index.captures if (one not in beyond and one.board % 2 == 0) or one in beyond[:BEYOND]]
    monkeypatch.setattr(cv2, "imdecode", decoded)
    views, *_ = find_views(directory, replace(index, captures=tuple(few)), lambda *_: None, QUICK)
    assert {view.source for view in views} >= {one.source for one in beyond[:BEYOND]}
    assert 0 < most <= 2  # the last one is gone once the next is read


@pytest.mark.parametrize("nominal", FOCAL_LENGTHS, ids=lambda n: f"{n:.0f}px")
def test_calibration_points_over_the_whole_focal_range(session, nominal):
    calibration, *_ = session
    stop = fourfold(nominal)
    found, true = at(calibration, nominal), zoomed(Truth(), stop)
    lens = found.zoom_head.lens.stops[0]
    assert lens.focal_px == pytest.approx((stop.lens.fx, stop.lens.fy), rel=FOCAL_TOLERANCE)
    look = np.append(undistorted((np.array(SIZE) - 1) / 2, stop.lens), 1.0)
    there = true.hand.rotation.apply(look)
    here = found.zoom_head.T_head_zoom.rotation.apply(lens.ray(lens.image_center_px))
    assert np.linalg.norm(np.cross(here, there)) < BORESIGHT_TOLERANCE * np.linalg.norm(here) * np.linalg.norm(there)
    targets = draw_targets(np.random.default_rng(5), TARGETS)
    measured = rms(misses(found, true, *targets))
    predicted = rms(predicted_pointing(calibration, *targets, nominal_px=nominal))
    assert measured < POINTING_FACTOR * predicted
    assert predicted < PREDICTED_TOLERANCE


def rms(errors):
    return float(np.sqrt(np.mean(np.square(errors))))


# With centres 0, d, d, 0 one step apart, half a step in: the cubic through them is the parabola d (3 x - x^2) / 2, at
# 0.625 d; the spline with straight ends, whose inner curvatures are -1.2 d, at 1.2 d / 2 - 0.2 d / 8 = 0.575 d.
DOUBT_SHARE = 0.625 - 0.575
WANDER_PX = 5.0  # a doubling; what is said of a lens beyond its stops
ROUNDING = 1e-9


def lens_of(centers, step=2.0):
    """A zoom lens with stops at these centres, each that many times the focal length before."""
    nominal = NOMINAL_PX * step ** np.arange(len(centers))
    stops = [Intrinsics(SIZE, (f, f), center) for f, center in zip(nominal, centers, strict=True)]
    return ZoomLens(tuple(nominal), tuple(stops))


def test_principal_point_uncertainty_between_and_beyond_zoom_samples():
    lens = lens_of([(320.0, 240.0), (328.0, 236.0), (328.0, 236.0), (320.0, 240.0)])
    for nominal in lens.nominal_px:
        assert np.allclose(lens.center_doubt_px(nominal), 0.0, atol=ROUNDING)
    for factor in (2**0.5, 2**2.5):
        assert np.allclose(lens.center_doubt_px(factor * NOMINAL_PX), DOUBT_SHARE * np.array([8.0, 4.0]))
    for few in (2, 3):  # a bridge: half an octave from either stop is a quarter of one
        bridge = lens_of([(320.0, 240.0 + i) for i in range(few)])
        assert np.allclose(bridge.center_doubt_px(2**0.5 * NOMINAL_PX), WANDER_PX / 4)
        assert np.allclose(bridge.center_doubt_px(2 * NOMINAL_PX), 0.0, atol=ROUNDING)
    straight = lens_of([(320.0, 240.0), (324.0, 240.0), (328.0, 240.0), (332.0, 240.0)])
    assert np.allclose(straight.center_doubt_px(1.3 * NOMINAL_PX), 0.0, atol=ROUNDING)  # a line is a line
    for lens in (straight, lens_of([(320.0, 240.0)])):
        for beyond in (lens.nominal_px[-1] * 2**1.5, NOMINAL_PX / 2**1.5):
            assert np.allclose(lens.center_doubt_px(beyond), 1.5 * WANDER_PX)


def test_next_zoom_sample_continues_the_trend_of_the_last_two():
    """From one octave to the next the axis moves by (8, -4) px, and the true focal length grows by 1 % more."""
    first = Intrinsics(SIZE, (NOMINAL_PX, NOMINAL_PX), (320.0, 240.0), (-0.1, 0.0, 0.0, 0.0, 0.0))
    second = replace(first.scaled(2 * 1.01), center_px=(328.0, 236.0), distortion=(-0.4, 0.0, 0.0, 0.0, 0.0))
    lens = ZoomLens((NOMINAL_PX, 2 * NOMINAL_PX), (first, second), (0.0, -0.02))
    guessed = with_stop(lens, 4 * NOMINAL_PX)
    assert guessed.nominal_px == (NOMINAL_PX, 2 * NOMINAL_PX, 4 * NOMINAL_PX)
    assert guessed.stops[:2] == lens.stops
    assert guessed.stops[2].focal_px == pytest.approx((4 * 1.01**2 * NOMINAL_PX,) * 2)
    assert guessed.stops[2].center_px == pytest.approx((336.0, 232.0))
    assert guessed.stops[2].distortion == pytest.approx((-1.6, 0.0, 0.0, 0.0, 0.0))  # the image is bent as before
    assert guessed.pupil == (0.0, -0.02, -0.02)


def test_principal_point_uncertainty_covers_the_interpolation_error():
    """The axis of the fourfold lens, known at four stops exactly."""
    nominal = FOCAL_LENGTHS[::2]
    true = [fourfold(n).lens for n in nominal]
    stops = tuple(Intrinsics(SIZE, (lens.fx, lens.fy), (lens.cx, lens.cy)) for lens in true)
    zoom = ZoomLens(tuple(nominal), stops)
    for n in np.geomspace(nominal[0], nominal[-1], 30)[1:-1]:
        lens = fourfold(n).lens
        off = np.abs(np.subtract(zoom.at(n).center_px, (lens.cx, lens.cy)))
        assert (off <= zoom.center_doubt_px(n) + ROUNDING).all()
