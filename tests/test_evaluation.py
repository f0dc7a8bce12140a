"""Steps and calibrations against the truth of a rendered world, whose answers are known by construction."""

import dataclasses
import math

import numpy as np
import pytest

from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import parse_config
from cotarget.evaluation import add_row, closeup_of, decodes, observe, pointing_errors, true_calibration
from cotarget.geometry import pose
from cotarget.pipeline import State, Step
from cotarget.rig import Detection, Frame
from cotarget.rig_geometry import FixedCamera
from cotarget.sim.world import SimWorld
from cotarget.targeting import Aim, Reach
from cotarget.tracking.track import Track
from tests.support.rigs import with_zoom_head

pytestmark = pytest.mark.render
EXACT_DEG = 1e-6  # the inverse is exact to 1e-9; the rays of both lens models agree to 1e-12
SIZE_PX = 1.0  # the book swings by some ten degrees and shows 0.03 m of its spine: 0.4 px, and it stands 0.015 m nearer
DENSE_PX = 0.01  # 200 phases of a beat miss its maximum by 1 - cos 1.8 degrees of an amplitude of 7 px at most


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


def reach_of(world):
    limits = world.rig.head.limits
    return Reach(limits.pan.range, limits.tilt.range, world.rig.zoom.focal_range)


def test_the_true_calibration_points_exactly(book):
    errors = pointing_errors(
        true_calibration(book, stops=1), book.truth(), reach_of(book), np.random.default_rng(0), 50
    )
    assert len(errors) == 50
    assert np.degrees(errors).max() < EXACT_DEG


def test_a_boresight_off_by_a_tenth_of_a_degree_has_that_pointing_error(book):
    """Gamma turned about y by 0.1 degree: the line of sight misses by 0.1 degree in the middle, at most that aside."""
    true = true_calibration(book, stops=1)
    off = with_zoom_head(true, T_zoom0_fixed=pose([0, 0, 0], [0, 0.1, 0]) * true.zoom_head.T_zoom0_fixed)
    errors = np.degrees(pointing_errors(off, book.truth(), reach_of(book), np.random.default_rng(0), 50))
    assert errors.max() < 0.1 + EXACT_DEG
    assert np.median(errors) > 0.09


def test_the_true_calibration_at_a_focal_length_points_exactly_with_it():
    """Of a lens whose pupil moves, and with it both T and Gamma."""
    world = SimWorld(parse_config({"sim": {"scene": "indoor", "effects": {"optics": True}}}))
    nominal = 4000.0
    lens = world.truth().zoom_lens_for(nominal)
    assert abs(lens.pupil) > 0.05
    to_pupil = pose([0, 0, lens.pupil], [0, 0, 0])
    true, sim = true_calibration(world, stops=1), world.config.sim
    at_nominal = dataclasses.replace(
        with_zoom_head(
            true,
            lens=ZoomLens((nominal,), (Intrinsics(lens.size, lens.focal_px, lens.center_px, lens.distortion),)),
            T_zoom0_fixed=to_pupil.inv() * sim.T_zoom0_fixed,
            T_head_zoom=sim.T_head_zoom * to_pupil,
        ),
        fixed=FixedCamera(dataclasses.replace(true.fixed.lens, distortion=sim.fixed.distortion)),
    )
    judged = (world.truth(), reach_of(world))
    at, elsewhere = (
        pointing_errors(at_nominal, *judged, np.random.default_rng(0), 30, nominal_px=px) for px in (nominal, None)
    )
    world.close()
    assert np.degrees(at).max() < EXACT_DEG
    assert np.degrees(np.median(elsewhere)) > 0.1  # the same calibration is wrong at the shortest


def step_of(world, **changes):
    """A Step as the loop would yield it now, with nothing found."""
    rig = world.rig
    step = Step(
        index=0, t=rig.clock.now(), state=State.SEARCHING, reason="", fixed=rig.fixed.read(), zoom=rig.zoom.read(),
        mask=None, detections=(), tracks=(), target=None, aim=None, commanded=(0.0, 0.0, rig.zoom.focal_range[0]),
        head=rig.head.state(), lens=rig.zoom.state(),
    )  # fmt: skip
    return dataclasses.replace(step, **changes)


def track(number, center_px, t=0.0, box_px=None, confirmed=True, missed=0, shared=False):
    """A track whose filtered middle need not be where its last detection is."""
    center, size = np.array(center_px, dtype=float), np.array([16.0, 12.0])
    box = Detection(center if box_px is None else np.array(box_px, dtype=float), size, 1.0)
    found = Track(number, t, confirmed, missed, center, np.zeros(2), size, size, 16.0, np.eye(4), 1.0, box)
    return dataclasses.replace(found, shared=shared)


def row_of(world, **changes):
    return observe(step_of(world, **changes), world.truth(), "book", world.config.target("book"))


def test_a_row_holds_the_truth_and_the_commands(book):
    """The book, 0.234 m at 10 m and 0.4 m to the left of the zoom camera: u = 326 - 692 * 0.4 / 10, v = 235."""
    aim = Aim(0.1, 0.2, 692.0, 692.0, False, np.array([3.0, 0.0, 4.0]), 5.0)
    row = row_of(book, head_commands=3, lens_commands=2, aim=aim, commanded=(0.1, -0.2, 700.0))
    assert (row.head_commands, row.lens_commands) == (3, 2)
    assert (row.pan_commanded_deg, row.tilt_commanded_deg) == pytest.approx(np.degrees([0.1, -0.2]))
    assert (row.focal_commanded_px, row.depth_m) == (700.0, 4.0)
    assert (row.u_px, row.v_px) == pytest.approx((326 - 692 * 0.04, 235), abs=1e-6)
    assert (row.u_wide_px, row.v_wide_px) == pytest.approx((325, 239), abs=1e-6)
    assert row.range_m == pytest.approx(math.hypot(10, 0.4))
    assert row.size_px == pytest.approx(692 * 0.234 / 10, abs=SIZE_PX)
    assert row.wanted_px == 160  # the longest focal length would give 194
    assert row.visible == 1.0
    assert row.in_wide
    assert row.track == -1
    assert row.focal_px == pytest.approx(692)
    assert not row.closeup.in_frame  # it is a tenth as large as wanted
    assert math.isnan(row.tpe_px)
    assert (row.decoded, row.decoded_wide) == (False, False)  # its marker is 5 px large
    assert row.off_target == ""


def test_the_point_error_is_that_of_a_detection_of_the_tracks_own(book):
    """The filter's centre is not the detection; a coasting track has no detection."""
    seen = row_of(book, target=track(4, (300, 200), box_px=(325 + 3, 239 - 4)))
    assert seen.track == 4
    assert seen.tpe_px == pytest.approx(5.0, abs=1e-6)
    shared = track(4, (325, 239), box_px=(340, 239), shared=True)
    for nothing in (track(4, (325, 239), missed=1), shared):  # a box of two targets is the detection of neither
        row = row_of(book, target=nothing)
        assert row.track == 4
        assert math.isnan(row.tpe_px)


@pytest.mark.parametrize(("tracks", "on", "off"), [
    # The larger side is the book's width, 16 to 17 px, about (325, 239).
    ([track(2, (325 + 15, 239)), track(3, (325 + 18, 239)), track(5, (325, 239 - 15)), track(7, (325, 239 + 18)),
      track(6, (100, 100), confirmed=False)], "2:book 5:book", "3 7"),
    # A track is on a target only while it is seen, alone.
    ([track(2, (325, 239), missed=1), track(3, (325, 239), shared=True), track(4, (325, 239), confirmed=False),
      track(5, (325, 239))], "5:book", ""),
])  # fmt: skip
def test_tracks_are_on_target_or_off_it(book, tracks, on, off):
    row = row_of(book, tracks=tuple(tracks))
    assert (row.on_target, row.off_target) == (on, off)


def test_a_zoom_frame_has_one_row(book):
    """A zoom camera at half the rate of the fixed one: two Steps share each of its frames."""
    rows, (truth, target) = [], (book.truth(), book.config.target("book"))
    step = step_of(book)
    for t_fixed, t_zoom in ((0.00, 0.00), (0.04, 0.00), (0.08, 0.08), (0.12, 0.08), (0.16, 0.16)):
        book.rig.clock.sleep_until(t_fixed)
        frames = {"fixed": Frame(step.fixed.image, t_fixed), "zoom": Frame(step.zoom.image, t_zoom)}
        add_row(rows, dataclasses.replace(step, **frames), truth, "book", target)
    assert [(row.t_s, row.t_fixed_s) for row in rows] == [(0.00, 0.00), (0.08, 0.08), (0.16, 0.16)]


@pytest.fixture(params=[4])
def moving(request):
    """A book that goes to the right at about 0.5 m/s, 4 m ahead of both cameras, which stand in one place."""
    paths = {"book": [[0, -0.5, request.param, 1.6], [2, 0.5, request.param, 1.6]]}
    home = {"translation": [0, 0, 0], "rotvec_deg": [0, 0, 0]}
    effects = {"all": False, "multisampling": True}
    sim = {"scene": "indoor", "targets": ["book"], "effects": effects, "paths": paths, "T_zoom0_fixed": home}
    world = SimWorld(parse_config({"sim": sim}))
    yield world
    world.close()


def test_each_frame_is_compared_with_the_truth_at_its_own_time(moving):
    """The clamped cubic is at -0.5, 0 and 0.5 m after 0, 1 and 2 s: u = 325 + f x / 4 in the wide view."""
    focal = moving.config.sim.fixed.focal_px[0]
    moving.rig.clock.sleep_until(2.0)
    step = step_of(moving)
    frames = {"fixed": Frame(step.fixed.image, 1.0), "zoom": Frame(step.zoom.image, 2.0)}
    found = row_of(moving, **frames, target=track(1, (325, 239), t=1.0))
    assert (found.t_fixed_s, found.t_s) == (1.0, 2.0)
    assert found.u_wide_px == pytest.approx(325, abs=1e-6)
    assert found.tpe_px == pytest.approx(0.0, abs=1e-6)
    assert found.u_px == pytest.approx(326 + 692 * 0.5 / 4, abs=1e-6)
    later = row_of(moving, target=track(1, (325, 239), t=2.0))
    assert later.tpe_px == pytest.approx(focal * 0.5 / 4, abs=1e-6)


def test_a_row_holds_the_true_angles_of_the_head(moving):
    pan, tilt = moving.rig.head.move(0.1, -0.2, wait=True)
    assert (pan, tilt) == pytest.approx((0.1, -0.2), abs=moving.rig.head.limits.pan.step)
    row = row_of(moving)
    assert (row.pan_deg, row.tilt_deg) == pytest.approx((math.degrees(pan), math.degrees(tilt)))


@pytest.mark.parametrize(("dimension", "axis"), [("width", 0), ("height", 1)])
def test_the_size_is_that_of_the_targets_dimension(book, dimension, axis):
    target = dataclasses.replace(book.config.target("book"), dimension=dimension)
    sides = book.truth().silhouette("book", "zoom", 0.0).upright_px
    assert sides[0] != sides[1]
    assert closeup_of(book.truth(), "book", target, 0.0).size_px == sides[axis]


@pytest.mark.parametrize("moving", [8], indirect=True)
def test_the_marker_is_read_in_the_closeup_and_not_in_the_wide_view(moving):
    """At 1 s the book is dead ahead: 0.234 m at 8 m are 202 px at 6920 px of focal length."""
    rig = moving.rig
    rig.zoom.zoom(6920.0)
    rig.clock.sleep_until(1.0)
    row = row_of(moving)
    assert row.t_s == row.t_fixed_s
    assert (row.decoded, row.decoded_wide) == (True, False)
    truth, outline = moving.truth(), moving.truth().silhouette("book", "zoom", row.t_s)
    assert decodes(rig.zoom.read(), outline, 1)  # as drawn by sim_assets/make_assets.py
    assert not decodes(rig.zoom.read(), outline, 2)
    assert not decodes(rig.zoom.read(), dataclasses.replace(outline, visible=0.0), 1)
    assert not decodes(rig.zoom.read(), None, 1)
    assert truth.targets.keys() == {"book"}


WALL = """<mujoco><statistic extent="10" center="0 5 1"/>
<worldbody><light pos="0 0 5"/><geom type="plane" size="20 20 1"/>
<geom type="box" pos="{x} 5 1.6" size="2 .05 3"/>
<site name="fixed_mount" pos="0 0 1.6" euler="90 0 0"/></worldbody></mujoco>"""
# Parts of sim_assets/targets/person.xml: an ear, three of an arm, three of a leg and a panel on either side; torso,
# neck, head, hair, nose, bag and two panels in the middle.
SIDE_PARTS, MIDDLE_PARTS = 8, 8


@pytest.mark.parametrize(("edge", "hidden"), [
    (-1.0, 0),
    (-0.02, SIDE_PARTS),  # 4 cm short of the middle, twice as far away
    (0.02, SIDE_PARTS + MIDDLE_PARTS),
    (1.0, 2 * SIDE_PARTS + MIDDLE_PARTS),
])  # fmt: skip
def test_visibility_counts_the_parts_that_a_wall_hides(tmp_path, edge, hidden):
    """A person 10 m ahead faces the camera; a wall at 5 m reaches from the left to ``edge`` [m]."""
    scene = tmp_path / "wall.xml"
    scene.write_text(WALL.format(x=edge - 2))
    paths = {"person": [[0, 0, 10, 0.9], [9, 0, 10, 0.9]]}
    sim = {"scene": str(scene), "targets": ["person"], "effects": {"all": False}, "paths": paths}
    world = SimWorld(parse_config({"sim": sim}))
    outline = world.truth().silhouette("person", "fixed", 0.0)
    world.close()
    assert outline.visible == pytest.approx(1 - hidden / (2 * SIDE_PARTS + MIDDLE_PARTS))


def test_a_birds_larger_side_is_the_maximum_over_a_beat():
    """Against 200 silhouettes of a bird that flies on the spot, at any phase to begin with.

    The span is widest twice a beat, with level wings. Of eight phases the nearest is a 16th of a beat away at most,
    45 degrees of the span's own cosine: it misses 1 - cos 45 degrees of its amplitude.
    """
    paths = {"bird": [[0, 0, 10, 1.6], [9, 0, 10, 1.6]]}
    sim = {"scene": "outdoor", "targets": ["bird"], "effects": {"all": False}, "paths": paths}
    world = SimWorld(parse_config({"sim": sim}))
    world.rig.clock.sleep_until(1.0)
    truth = world.truth()
    beat = truth.targets["bird"].kind.beat_s
    sides = [truth.silhouette("bird", "fixed", t).size_px.max() for t in np.linspace(0, beat, 200, endpoint=False)]
    found = [truth.largest_side_px("bird", "fixed", t) for t in (0.0, 0.03, 0.1, 0.7)]
    world.close()
    swing = max(sides) - min(sides)
    assert swing > 0.2 * max(sides)  # the beat shows: any one phase would be wrong by up to this
    assert max(found) <= max(sides) + DENSE_PX
    assert min(found) >= max(sides) - (1 - math.cos(math.pi / 4)) * swing / 2
