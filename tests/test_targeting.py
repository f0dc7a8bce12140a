"""Targeting against cv2.projectPoints through written-out matrices, the paper's worked point, errors worked by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import DEFAULT_TARGETS
from cotarget.errors import CalibrationError, ConfigError, UnreachableError
from cotarget.geometry import RigidTransform, Rotation
from cotarget.pantilt import HeadGeometry
from cotarget.rig import CameraSpec, HeadSpec, RigSpec, ZoomSpec
from cotarget.rig_geometry import FixedCamera, ZoomHead
from cotarget.targeting import METHODS, Reach, WantedSize, aim, depth_of, error_budget, point_at, target_implausibility
from experiments.calibration.synthetic.rig import SIZE, Lens, Truth
from tests.support.moving_targets import calibration_of
from tests.support.rigs import with_zoom_head

# The solver accepts a miss of 1e-11 rad, which is 1e-7 px at the longest focal length of 8000 px.
PIXEL = 1e-6
# Where focal length and ray are found in turn: the wanted pixel, 300 px from the principal point at the most, moves
# against it by that times the focal length's last relative change, which is said to be 1e-7.
IN_TURN_PX = 1e-4
# That relative change, read back as a size of 160 px.
SIZE_PX = 2e-5
# The worked point is printed in whole millimetres, one of which is 160 / 234 px of focal length.
WHOLE_MM_PX = 160 / 234
RELATIVE = 1e-9  # double precision through a few square roots
# The error budget differentiates by finite differences of 0.29 px, whose curvature is of the order 0.29 / 686.
CURVATURE = 1e-3
ANYWHERE = Reach((-math.pi, math.pi), (-math.pi / 2, math.pi / 2), (667.0, 8000.0))
CENTRED = Intrinsics(SIZE, (686.0, 684.0), (319.5, 239.5))
HOME = Calibration(
    fixed=FixedCamera(CENTRED),
    zoom_head=ZoomHead(ZoomLens((667.0,), (CENTRED,)), RigidTransform.identity(), RigidTransform.identity()),
)


def shifted(x, y=0.0, z=0.0):
    """A rig without any rotation whose zoom camera sees a point shifted by (x, y, z) [m]."""
    return with_zoom_head(HOME, T_zoom0_fixed=RigidTransform.from_translation([x, y, z]))


def random_truth(rng, real_head):
    """A rig with everything off: cameras up to 2 m apart and 20 degrees askew, a lever arm, principal points."""
    gamma = RigidTransform.from_components(
        rng.uniform(-1.2, 1.2, 3), Rotation.from_rotvec(np.radians(rng.uniform(-12, 12, 3)))
    )
    hand = RigidTransform.from_components(
        rng.uniform(-0.15, 0.15, 3), Rotation.from_rotvec(np.radians(rng.uniform(-5, 5, 3)))
    )
    lens = Lens(rng.uniform(680, 700), rng.uniform(680, 700), *rng.uniform([305, 225], [335, 255]), (-0.1, 0.02, 0.001))
    lens = replace(lens, distortion=(-0.1, 0.02, 0.001, -0.001, 0.0))
    dz, eps = (rng.uniform(-0.01, 0.01), np.radians(rng.uniform(-0.5, 0.5))) if real_head else (0.0, 0.0)
    return Truth(zoom=lens, gamma=gamma, hand=hand, dz=dz, eps=eps)


def seen_by_zoom(truth, found, x_fixed):
    """Pixel of a point by OpenCV, through 4x4 matrices, with the lens at the focal length that the aim tells."""
    factor = found.nominal_px / 667.0
    lens = replace(truth.zoom, fx=truth.zoom.fx * factor, fy=truth.zoom.fy * factor)
    assert found.focal_px == pytest.approx(lens.fx, rel=RELATIVE)
    x_zoom = truth.in_zoom(np.atleast_2d(x_fixed), found.pan, found.tilt)
    assert (x_zoom[:, 2] > 0).all()  # looked at, not away from
    return lens.project(x_zoom)


@pytest.mark.parametrize("real_head", [False, True])
@pytest.mark.parametrize("pixel", [None, (100.0, 420.0)])
def test_the_exact_aim_brings_the_target_to_the_wanted_pixel(real_head, pixel):
    rng = np.random.default_rng(3)
    wanted = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2) if pixel is None else pixel
    for _ in range(25):
        truth = random_truth(rng, real_head)
        assert np.hypot(truth.zoom.cx - 319.5, truth.zoom.cy - 239.5) > 0  # else a mixed-up centre could hide
        x_fixed = np.array([*rng.uniform(-0.4, 0.4, 2), 1.0]) * rng.uniform(4, 40)
        wanted_size = WantedSize(0.3, rng.uniform(20, 300))
        for how in ({}, {"nominal_px": rng.uniform(667, 8000)}, {"wanted_size": wanted_size}):
            found = aim(calibration_of(truth), x_fixed, ANYWHERE, zoom_pixel=pixel, **how)
            tolerance = IN_TURN_PX if "wanted_size" in how else PIXEL
            np.testing.assert_allclose(seen_by_zoom(truth, found, x_fixed)[0], wanted, rtol=0, atol=tolerance)
            x_zoom = truth.in_zoom(x_fixed[None], found.pan, found.tilt)[0]
            assert found.range == pytest.approx(np.linalg.norm(x_zoom), rel=RELATIVE)
            assert found.depth == x_fixed[2]


def test_the_closeup_is_as_large_as_wanted():
    """Two points, a target's width apart, square to pan axis and line of sight, appear the wanted size apart."""
    rng = np.random.default_rng(4)
    for _ in range(10):
        truth = replace(random_truth(rng, True), zoom=Lens(692.0, 693.0, 326.0, 235.0))
        x_fixed = np.array([*rng.uniform(-0.4, 0.4, 2), 1.0]) * rng.uniform(4, 10)
        found = aim(calibration_of(truth), x_fixed, ANYWHERE, wanted_size=WantedSize(0.234, 160.0))
        assert not found.limited
        M = truth.zoom_fixed(found.pan, found.tilt)
        right, down, _ = truth.hand.rotation.inv().apply([0, 1, 0])  # the pan axis as the zoom camera shows it
        half = M[:3, :3].T @ (0.117 / np.hypot(right, down) * np.array([down, -right, 0]))
        ends = seen_by_zoom(truth, found, np.stack([x_fixed - half, x_fixed + half]))
        assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(160.0, abs=SIZE_PX)


def test_a_height_is_magnified_by_the_vertical_focal_length():
    """300 px for 1.75 m at 12 m take fy = 300 x 12 / 1.75; fx is 686 / 684 of that, the lens calls it 667 / 684."""
    found = aim(HOME, np.array([0.0, 0.0, 12.0]), ANYWHERE, wanted_size=WantedSize(1.75, 300.0, vertical=True))
    fy = 300 * 12 / 1.75
    assert found.focal_px == pytest.approx(fy * 686 / 684, rel=RELATIVE)
    assert found.nominal_px == pytest.approx(fy * 667 / 684, rel=RELATIVE)


def test_an_aim_uses_the_lens_as_it_was_calibrated_at_that_focal_length():
    """Between two stops the principal point drifts: half way in the logarithm it is half way between."""
    stops = (Intrinsics(SIZE, (700.0, 700.0), (326.0, 235.0)), Intrinsics(SIZE, (2828.0, 2828.0), (336.0, 245.0)))
    calibration = with_zoom_head(HOME, lens=ZoomLens((700.0, 2800.0), stops))
    found = aim(calibration, np.array([0.0, 0.0, 10.0]), ANYWHERE, nominal_px=1400.0)
    focal = 1400 * 1.01**0.5  # the ratio to the nominal one is half way between 1 and 1.01 in the logarithm
    assert found.focal_px == pytest.approx(focal, rel=RELATIVE)
    # What lies straight ahead must come to the image's centre, 11.5 px left of and 0.5 px above (331, 240).
    assert math.tan(found.pan) == pytest.approx(11.5 / focal, rel=CURVATURE)
    assert math.tan(found.tilt) == pytest.approx(-0.5 / focal, rel=CURVATURE)


def test_the_papers_worked_point():
    """x_zoom0 = (811, 563, 10464) mm: range 10510 and 7186 px; the paper takes the depth for the range: 7155 px."""
    x_fixed = np.array([2.9738, 0.5263, 10.0])
    calibration = shifted(*(np.array([0.811, 0.563, 10.464]) - x_fixed))
    book = WantedSize(0.234, 160.0)
    exact = aim(calibration, x_fixed, ANYWHERE, wanted_size=book)
    assert round(1000 * exact.range) == 10510
    assert exact.focal_px == pytest.approx(7186, abs=WHOLE_MM_PX)
    example = aim(calibration, x_fixed, ANYWHERE, wanted_size=book, method="paper-example")
    assert round(example.focal_px) == 7155
    assert round(math.degrees(-example.tilt), 2) == 3.08  # the one angle that the paper prints; down is negative
    table = aim(calibration, x_fixed, ANYWHERE, wanted_size=book, method="paper-table")
    assert table.focal_px == pytest.approx(160 * 10 / 0.234, rel=RELATIVE)  # that reading takes the depth in x_fixed
    assert METHODS == ("exact", "paper-table", "paper-example")


@pytest.mark.parametrize("method", ["paper-table", "paper-example"])
def test_the_shortcut_too_is_told_as_the_head_reports(method):
    """An encoder that counts 1 for every 1.01 turned, and 0 where the axis is at 0.02 rad."""
    x_fixed = np.array([1.0, -0.7, 10.0])
    true = aim(shifted(0.3), x_fixed, ANYWHERE, method=method)
    off = with_zoom_head(shifted(0.3), axes=HeadGeometry(0.0, 0.0, 1.01, 1.01, 0.02, 0.02))
    told = aim(off, x_fixed, ANYWHERE, method=method)
    assert told.pan == pytest.approx((true.pan - 0.02) / 1.01, rel=RELATIVE)
    assert told.tilt == pytest.approx((true.tilt - 0.02) / 1.01, rel=RELATIVE)
    assert told.range == true.range
    # A whole turn further is reported as 1 / 1.01 of one.
    beyond = replace(ANYWHERE, pan=(3.2, 7.0), now=(6.0, 0.0))
    around = aim(with_zoom_head(shifted(0.3), axes=HeadGeometry(pan_scale=1.01)), x_fixed, beyond, method=method)
    assert around.pan == pytest.approx((true.pan + 2 * math.pi) / 1.01, rel=RELATIVE)


@pytest.mark.parametrize(("how", "nominal", "limited"), [
    ({}, 667.0, False),
    ({"nominal_px": 1000.0}, 1000.0, False),
    ({"nominal_px": 9000.0}, 8000.0, True),
    ({"wanted_size": WantedSize(0.234, 10.0)}, 667.0, True),  # 10 x 10 / 0.234 = 427 px
    # The true focal length is 686 where the device says 667.
    ({"wanted_size": WantedSize(0.234, 160.0)}, 160 * 10 / 0.234 * 667 / 686, False),
    ({"wanted_size": WantedSize(0.234, 1000.0)}, 8000.0, True),
])  # fmt: skip
def test_the_focal_length_is_limited_to_the_lens(how, nominal, limited):
    found = aim(HOME, np.array([0.0, 0.0, 10.0]), ANYWHERE, **how)
    assert (found.nominal_px, found.limited) == (pytest.approx(nominal, rel=RELATIVE), limited)


@pytest.mark.parametrize(("name", "size_px", "depth"), [
    ("book", 686 * 0.234 / 10, 10.0),  # a width: along u
    ("person", 684 * 1.75 / 12, 12.0),  # a height: along v
    ("bird", 686 * 0.8 / 25, 25.0),
])  # fmt: skip
def test_depth_from_the_known_size(name, size_px, depth):
    assert depth_of(HOME, DEFAULT_TARGETS[name], size_px, HOME.fixed.lens.center_px) == pytest.approx(
        depth, rel=RELATIVE
    )


def test_a_pixel_and_a_depth_are_a_point():
    """Depth is along the axis, not along the ray."""
    x = point_at(HOME, np.array([319.5 + 68.6, 239.5 - 136.8]), 10.0)
    np.testing.assert_allclose(x, [1.0, -2.0, 10.0], rtol=RELATIVE)


# The zoom camera 0.3 m beside the axes: it cannot look at a point 0.1 m from them.
LONG_LEVER = with_zoom_head(HOME, T_head_zoom=RigidTransform.from_translation([0.3, 0.0, 0.0]))
FOLDING = replace(HOME, fixed=FixedCamera(replace(CENTRED, distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))))


@pytest.mark.parametrize(("act", "kind"), [
    *((lambda z=z: point_at(HOME, (320, 240), z), UnreachableError) for z in (-1.0, 0.0, math.nan, math.inf)),
    (lambda: point_at(HOME, (320, 240), depth_of(HOME, DEFAULT_TARGETS["book"], 0.0, (320, 240))), UnreachableError),
    (lambda: point_at(HOME, (math.nan, 240), 5.0), UnreachableError),
    (lambda: point_at(FOLDING, (5000, 240), 5.0), UnreachableError),
    (lambda: aim(HOME, np.array([10.0, 0, 1]), replace(ANYWHERE, pan=(-1, 1))), UnreachableError),
    (lambda: aim(HOME, np.array([0, -10.0, 1]), replace(ANYWHERE, pan=(-1, 1), tilt=(-1, 1))), UnreachableError),
    (lambda: aim(LONG_LEVER, np.array([-0.2, 0.0, 0.0]), ANYWHERE), UnreachableError),
    (lambda: aim(shifted(0.0, 3.0, 5.0), np.array([0, 0, 1.0]), ANYWHERE, method="paper-table"), UnreachableError),
    (lambda: aim(with_zoom_head(HOME, T_head_zoom=None), np.array([0, 0, 5.0]), ANYWHERE), CalibrationError),
])  # fmt: skip
def test_what_cannot_be_aimed_at_is_refused_in_one_line(act, kind):
    with pytest.raises(kind) as caught:
        act()
    assert "\n" not in str(caught.value)


# One rounded whole is uniform over one unit: its standard deviation is 1 / sqrt(12).
SIGMA = 1 / math.sqrt(12)


def test_error_budget_straight_ahead():
    """No offset: steps of both axes, the pixel as an angle in u and in v, and a depth that does not matter."""
    reach, pixel = replace(ANYWHERE, steps=(math.radians(0.05),) * 2), np.array([319.5, 239.5])
    found = aim(HOME, point_at(HOME, pixel, 10.0), reach)
    budget = error_budget(HOME, pixel, found, reach, size_px=16.0)
    assert set(budget) == {"steps", "pixel", "size", "total"}
    assert budget["steps"] == pytest.approx(math.radians(0.05) * SIGMA * math.sqrt(2), rel=RELATIVE)
    assert budget["pixel"] == pytest.approx(math.hypot(SIGMA / 686, SIGMA / 684), rel=CURVATURE)
    assert budget["size"] == pytest.approx(0.0, abs=1e-12)
    assert budget["total"] == pytest.approx(math.hypot(budget["steps"], budget["pixel"]), rel=RELATIVE)


def test_error_budget_high_up():
    """At 45 degrees the ray (0, -1, 1) is sqrt(2) long: along u a pixel turns it by 1 / sqrt(2), along v by 1 / 2."""
    pixel = np.array([319.5, 239.5 - 684])
    found = aim(HOME, point_at(HOME, pixel, 10.0), ANYWHERE)
    budget = error_budget(HOME, pixel, found, ANYWHERE)
    assert budget["pixel"] == pytest.approx(math.hypot(SIGMA / 686 / math.sqrt(2), SIGMA / 684 / 2), rel=CURVATURE)


def test_error_budget_off_to_the_side():
    """The zoom camera 1 m beside: a depth error is a parallax. High up, a step of pan is a shorter way."""
    calibration, pixel, size_px = shifted(1.0), np.array([319.5, 239.5]), 16.0
    found = aim(calibration, point_at(calibration, pixel, 10.0), ANYWHERE)
    budget = error_budget(calibration, pixel, found, ANYWHERE, size_px=size_px)
    assert budget["steps"] == 0.0
    assert budget["size"] == pytest.approx(
        math.atan(1 / 10) - math.atan(1 / (10 * (1 + SIGMA / size_px))), rel=RELATIVE
    )
    assert "size" not in error_budget(calibration, pixel, found, ANYWHERE)
    high = replace(aim(HOME, np.array([0.0, 0.0, 10.0]), ANYWHERE), tilt=math.radians(60))
    steps = error_budget(HOME, pixel, high, replace(ANYWHERE, steps=(0.001, 0.001)))["steps"]
    assert steps == pytest.approx(0.001 * SIGMA * math.sqrt(1 + 0.25), rel=RELATIVE)


def test_a_pixel_is_not_aimed_at_by_a_calibration_in_millimetres_unless_insisted_on():
    gamma = HOME.zoom_head.T_zoom0_fixed
    apart = with_zoom_head(HOME, T_zoom0_fixed=RigidTransform.from_components([400.0, 0.0, 0.0], gamma.rotation))
    with pytest.raises(CalibrationError, match=r"T_zoom0_fixed: the cameras are 400 m apart; .* insist=True"):
        aim(apart, pixel=(400, 100), depth=9.0)
    assert aim(apart, pixel=(400, 100), depth=9.0, insist=True).range > 300


@pytest.mark.parametrize("given", [
    {}, {"pixel": (400, 100)}, {"pixel": 3, "depth": 9.0}, {"pixel": (900, 100), "depth": 9.0},
    {"pixel": (400, 100), "depth": 9.0, "x_fixed": np.array([0.0, 0.0, 9.0])},
    {"pixel": (400, 100), "depth": 9.0, "method": "foo"},
])  # fmt: skip
def test_a_target_given_in_no_way_or_in_two_is_refused(given):
    with pytest.raises(ConfigError):
        aim(HOME, **given)


def spec(zoom_size=(640, 480), longest_px=8000.0):
    return RigSpec(
        CameraSpec(SIZE, 25.0, 0.06),
        ZoomSpec(zoom_size, 25.0, 0.06, (667.0, longest_px), 0.009, zoom_size, 0.04),
        HeadSpec(None, 0.04),
    )


BOOK, PERSON, BIRD = (DEFAULT_TARGETS[name] for name in ("book", "person", "bird"))


@pytest.mark.parametrize(("target", "name", "rig", "key"), [
    (BOOK, "book", spec(), None),
    (PERSON, "person", spec(), None),
    (BIRD, "bird", spec(), None),
    (replace(BIRD, size=0.2), "bird2", spec(), None),  # a sparrow
    (replace(BOOK, size=23.4), "book", spec(), "targets.book.size"),
    (replace(BIRD, size=80.0), "bird2", spec(), "targets.bird2.size"),
    (replace(BOOK, size=23.4), "house", spec(), None),
    (replace(BOOK, size=600.0), "dog", spec(), "targets.dog.size"),
    (replace(BOOK, size=84.0), "aircraft", spec(), None),
    (replace(BOOK, size=175.0), "visitor", spec(), "targets.visitor.size"),
    (replace(BOOK, size=600.0), "", spec(), "target.size"),
    (replace(BOOK, wanted_px=5000.0), "book", spec(), "targets.book.wanted_px"),
    (PERSON, "person", spec((320, 240)), "targets.person.wanted_px"),
    (replace(BIRD, wanted_px=500.0), "bird", spec(), None),  # along the width
    # 686 px show a target that fills the 640 px wide fixed image; 300 px show it 280 px wide.
    (replace(BOOK, wanted_px=300.0), "book", spec(longest_px=667.0), None),
    (replace(BOOK, wanted_px=281.0), "book", spec(longest_px=300.0 * 667 / 686), "targets.book.wanted_px"),
    (replace(BOOK, wanted_px=279.0), "book", spec(longest_px=300.0 * 667 / 686), None),
])  # fmt: skip
def test_target_that_is_none_or_that_no_lens_shows_is_implausible(target, name, rig, key):
    found = target_implausibility(target, HOME, rig, name)
    assert found.startswith(f"{key}: ") if key else not found


def rolled_home(fixed_deg, zoom_deg):
    """The plain rig with cameras rolled clockwise, on a head that stays upright."""
    fixed, zoom = (
        RigidTransform.from_rotation(Rotation.from_euler("z", deg, degrees=True)) for deg in (fixed_deg, zoom_deg)
    )
    head = HOME.zoom_head
    return with_zoom_head(
        HOME, T_zoom0_fixed=zoom.inv() * head.T_zoom0_fixed * fixed, T_head_zoom=head.T_head_zoom * zoom
    )


@pytest.mark.parametrize(("roll_deg", "shown_deg"), [(0, 0), (30, 30), (90, 90), (-90, 90), (135, -45), (180, 0)])
def test_a_cameras_roll_is_that_of_the_pan_axis_in_its_image(roll_deg, shown_deg):
    """A line has no direction, so that 135 degrees look as -45."""
    fixed, zoom = rolled_home(roll_deg, 0).zoom_head, rolled_home(0, roll_deg).zoom_head
    assert abs(math.remainder(fixed.fixed_roll(0.0, 0.0) - math.radians(shown_deg), math.pi)) < RELATIVE
    assert abs(math.remainder(zoom.zoom_roll - math.radians(shown_deg), math.pi)) < RELATIVE
    assert (zoom.fixed_roll(0.0, 0.0), fixed.zoom_roll) == pytest.approx((0.0, 0.0), abs=RELATIVE)  # the other camera's


def test_a_height_has_the_rows_for_room_in_a_zoom_camera_on_its_side():
    sideways = rolled_home(0, 90)
    for target, wanted_px, fits in ((PERSON, 600.0, True), (BOOK, 600.0, False), (BOOK, 470.0, True)):
        found = target_implausibility(replace(target, wanted_px=wanted_px), sideways, spec(), "it")
        assert bool(found) != fits


@pytest.mark.parametrize("zoom_deg", [0, 30, 90, 180, -90])
def test_the_closeup_is_as_large_as_wanted_at_any_roll_of_a_camera_with_oblong_pixels(zoom_deg):
    """A person's two ends, one above the other before the rig, are 300 px apart by a lens with fy = 1.2 fx."""
    rig = rolled_home(0, zoom_deg)
    oblong = Intrinsics(SIZE, (700.0, 840.0), (319.5, 239.5))
    rig = with_zoom_head(rig, lens=ZoomLens((700.0, 7000.0), (oblong, replace(oblong, focal_px=(7000.0, 8400.0)))))
    x_fixed = np.array([0.0, 0.0, 20.0])
    found = aim(rig, x_fixed, wanted_size=WantedSize(1.75, 300.0, vertical=True))
    ends = x_fixed + np.array([[0, -0.875, 0], [0, 0.875, 0]])
    shown = rig.zoom_head.project(ends, found.pan, found.tilt, found.nominal_px)
    assert np.linalg.norm(shown[1] - shown[0]) == pytest.approx(300.0, rel=0.01)  # the range is along the ray
