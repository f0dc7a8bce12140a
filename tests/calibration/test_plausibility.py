"""What no rig is like is refused, with the key that is wrong; any rig that can be built passes."""

from dataclasses import replace

import numpy as np
import pytest

from cotarget.backends import describe
from cotarget.board import board_points
from cotarget.calibration.plausibility import check_plausible
from cotarget.camera import ZoomLens
from cotarget.config import BoardConfig, RigConfig, SimConfig
from cotarget.errors import CalibrationError
from cotarget.geometry import RigidTransform
from cotarget.pantilt import HeadGeometry
from cotarget.rig_geometry import FixedCamera
from experiments.calibration.synthetic.rig import NOMINAL_PX, Truth, other_rig
from experiments.calibration.synthetic.views import synthetic_views
from tests.support.moving_targets import calibration_of
from tests.support.rigs import with_zoom_head

SPEC = describe(RigConfig(sim=SimConfig()))
NOISE_PX = 0.1


def exact_calibration(truth, *, with_views=True):
    """The exact calibration of a synthetic rig, with corners that it was made from."""
    board = BoardConfig()
    views = synthetic_views(truth, board_points(board), np.random.default_rng(1), boards=6, noise_px=NOISE_PX)
    return calibration_of(truth, board=board, views=tuple(views) if with_views else ())


GOOD = exact_calibration(Truth())
PLAIN = exact_calibration(Truth(), with_views=False)


def in_mm(T):
    return RigidTransform.from_components(1000 * T.translation, T.rotation)


def exchanged(calibration):
    return with_zoom_head(
        calibration, T_head_zoom=calibration.zoom_head.T_zoom0_fixed, T_zoom0_fixed=calibration.zoom_head.T_head_zoom
    )


def with_lens(calibration, **changed):
    return replace(calibration, fixed=FixedCamera(replace(calibration.fixed.lens, **changed)))


IMPLAUSIBLE = {
    "a baseline in millimetres": (
        with_zoom_head(PLAIN, T_zoom0_fixed=in_mm(PLAIN.zoom_head.T_zoom0_fixed)),
        "T_zoom0_fixed: .* metres",
    ),
    "a lever in millimetres": (
        with_zoom_head(PLAIN, T_head_zoom=in_mm(PLAIN.zoom_head.T_head_zoom)),
        "T_head_zoom: .* metres",
    ),
    "an axis offset in millimetres": (with_zoom_head(PLAIN, axes=HeadGeometry(5.0)), "head.axis_offset: .* metres"),
    "a square in millimetres": (replace(PLAIN, board=BoardConfig(square=25.0)), "board.square: .* metres"),
    "T and Gamma exchanged": (exchanged(GOOD), "exchanged"),
    "T and Gamma exchanged, without views": (exchanged(PLAIN), "exchanged"),
    "a lever of 2 mm in millimetres": (
        with_zoom_head(
            GOOD, T_head_zoom=RigidTransform.from_components([0.0, 0.0, 2.0], GOOD.zoom_head.T_head_zoom.rotation)
        ),
        "miss the corners",
    ),
    "a focal length in millimetres": (with_lens(PLAIN, focal_px=(6.0, 6.0)), "fixed.fx: .* pixels"),
    "one focal length in millimetres": (with_lens(PLAIN, focal_px=(686.0, 6.0)), "fixed.fy: "),
    "a pupil in millimetres": (
        with_zoom_head(
            PLAIN,
            lens=ZoomLens((NOMINAL_PX, 2 * NOMINAL_PX), (PLAIN.fixed.lens, PLAIN.fixed.lens.scaled(2.0)), (0.0, 30.0)),
        ),
        r"zoom.stops\[1\].pupil: .* metres",
    ),
}


@pytest.mark.parametrize("name", IMPLAUSIBLE)
def test_implausible_calibration_is_refused_unless_insisted_on(name):
    calibration, wanted = IMPLAUSIBLE[name]
    with pytest.raises(CalibrationError, match=f"^calibration: .*{wanted}"):
        check_plausible(calibration)
    check_plausible(calibration, insist=True)


@pytest.mark.parametrize("with_views", [True, False])
@pytest.mark.parametrize("truth", [Truth(), other_rig()])
def test_unusual_rigs_and_smaller_streams_are_plausible(truth, with_views):
    calibration = exact_calibration(truth, with_views=with_views)
    check_plausible(calibration)
    check_plausible(calibration.for_streams((320, 240), (320, 240)))


def test_calibration_of_another_lens_is_refused():
    own = list(SPEC.zoom.focal_range)
    check_plausible(replace(GOOD, provenance={"focal_range_px": own}), SPEC)
    check_plausible(GOOD, SPEC)  # captures of another program do not say what the lens can do
    stills = GOOD.for_streams(GOOD.fixed.size, (1280, 960))  # of the same lens, in pixels half as large
    check_plausible(replace(stills, provenance={"focal_range_px": [2 * focal for focal in own]}), SPEC)
    for focal_range in ([own[0] / 2, own[1]], [own[0], own[1] / 2]):
        with pytest.raises(CalibrationError, match=r"^calibration: is of a lens .* another rig's"):
            check_plausible(replace(GOOD, provenance={"focal_range_px": focal_range}), SPEC)
    farther = with_zoom_head(GOOD, lens=ZoomLens((2 * own[1],), GOOD.zoom_head.lens.stops))
    with pytest.raises(CalibrationError, match="another rig's"):
        check_plausible(farther, SPEC)
