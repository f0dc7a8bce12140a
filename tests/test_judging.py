"""Steps and calibrations beside the truth of a rendered world, whose answers are known by construction."""

import dataclasses
import math

import numpy as np
import pytest

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import parse_config
from cotarget.geometry import pose
from cotarget.judging import observe, pointing_errors
from cotarget.loop import State, Step
from cotarget.pantilt import HeadGeometry
from cotarget.sim.world import SimWorld
from cotarget.targeting import Reach

pytestmark = pytest.mark.render

EXACT_DEG = 1e-6  # the inverse is exact to 1e-9; the rays of both lens models agree to 1e-12
SIZE_PX = 1.0  # the book swings by some ten degrees and shows 0.03 m of its spine: 0.4 px, and it stands 0.015 m nearer


@pytest.fixture(scope="module")
def book():
    """A still book 10 m ahead of the fixed camera, in a world without effects but the head's own geometry."""
    home = {"translation": [-0.4, 0, 0], "rotvec_deg": [0, 0, 0]}
    config = parse_config(
        {
            "sim": {
                "scene": "indoor",
                "targets": ["book"],
                "effects": {"all": False, "axes": True},
                "T_zoom0_fixed": home,
                "paths": {"book": [[0, 0, 10, 1.6], [9, 0, 10, 1.6]]},
            }
        }
    )
    world = SimWorld(config)
    yield world
    world.close()


def true_calibration(world):
    sim = world.config.sim
    plain = (0.0,) * 5
    return Calibration(
        fixed=Intrinsics(sim.fixed.size, sim.fixed.focal_px, sim.fixed.center_px, plain),
        zoom=ZoomLens(
            (world.rig.zoom.focal_range[0],),
            (Intrinsics(sim.zoom.size, sim.zoom.focal_px, sim.zoom.center_px, plain),),
        ),
        T_zoom0_fixed=sim.T_zoom0_fixed,
        T_head_zoom=sim.T_head_zoom,
        head=HeadGeometry(sim.head.axis_offset_mm / 1000, math.radians(sim.head.squareness_deg)),
    )


def reach_of(world):
    limits = world.rig.head.limits
    return Reach(limits.pan, limits.tilt, world.rig.zoom.focal_range)


def test_the_true_calibration_points_exactly(book):
    errors = pointing_errors(true_calibration(book), book.truth(), reach_of(book), np.random.default_rng(0), 50)
    assert len(errors) == 50
    assert np.degrees(errors).max() < EXACT_DEG


def test_a_boresight_that_is_off_by_a_tenth_of_a_degree_points_off_by_as_much(book):
    """Gamma turned about y by 0.1 degree: the line of sight misses by 0.1 degree in the middle, at most that aside."""
    true = true_calibration(book)
    off = dataclasses.replace(true, T_zoom0_fixed=pose([0, 0, 0], [0, 0.1, 0]) * true.T_zoom0_fixed)
    errors = np.degrees(pointing_errors(off, book.truth(), reach_of(book), np.random.default_rng(0), 50))
    assert errors.max() < 0.1 + EXACT_DEG
    assert np.median(errors) > 0.09


def test_a_row_says_what_is_so(book):
    """The book, 0.234 m at 10 m and 0.4 m to the left of the zoom camera: u = 326 - 692 * 0.4 / 10, v = 235."""
    config, rig = book.config, book.rig
    frame, zoom = rig.fixed.read(), rig.zoom.read()
    step = Step(
        index=0,
        t=rig.clock.now(),
        state=State.SEARCHING,
        reason="",
        fixed=frame,
        zoom=zoom,
        mask=None,
        detections=(),
        tracks=(),
        target=None,
        aim=None,
        commanded=(0.0, 0.0, rig.zoom.focal_range[0]),
        head=rig.head.state(),
        lens=rig.zoom.state(),
    )
    row = observe(step, book.truth(), "book", config.target("book"))
    assert (row.u_px, row.v_px) == pytest.approx((326 - 692 * 0.04, 235), abs=1e-6)
    assert (row.u_wide_px, row.v_wide_px) == pytest.approx((325, 239), abs=1e-6)
    assert row.range_m == pytest.approx(math.hypot(10, 0.4))
    assert row.size_px == pytest.approx(692 * 0.234 / 10, abs=SIZE_PX)
    assert row.wanted_px == 160  # the longest focal length would give 194
    assert row.visible == 1.0
    assert row.in_wide
    assert row.track == -1
    assert row.focal_px == pytest.approx(692)
    assert not row.in_frame  # it is a tenth as large as wanted
