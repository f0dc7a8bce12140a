"""Fusion of both cameras: which tracks have a filter, what is selectable, what the zoom image adds to the followed one.

The fixed camera looks along z from the origin and the zoom camera from 0.4 m to the right, where pan and tilt meet.
"""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import DEFAULT_TARGETS
from cotarget.control.selection import FirstCome, candidates_of
from cotarget.estimation import TargetFilter
from cotarget.estimation.zoom_matching import CloseupFinder, MatchingSettings, ZoomMeasurement
from cotarget.fusion import REMEMBERED_S, FusionSettings, StateHistory, TargetFusion, ZoomSearch
from cotarget.geometry import pose
from cotarget.pipeline import FollowSettings, HeadRun
from cotarget.rig import Detection, Frame, PanTiltState, ZoomState
from cotarget.rig_geometry import FixedCamera, ZoomHead
from cotarget.sim.motion import trapezoid
from cotarget.tracking.track import Track, tracking_settings
from cotarget.tracking.tracker import Tracker
from tests.support.formula_rig import FormulaRig
from tests.support.moving_targets import APART, Flight, show
from tests.support.rigs import rig_of

SIZE, CENTER, FOCAL, ZOOMED = (640, 480), (319.5, 239.5), 700.0, 3000.0
BASELINE = 0.4
CALIBRATION = Calibration(
    fixed=FixedCamera(Intrinsics(SIZE, (FOCAL, FOCAL), CENTER)),
    zoom_head=ZoomHead(
        ZoomLens((FOCAL, ZOOMED), tuple(Intrinsics(SIZE, (each, each), CENTER) for each in (FOCAL, ZOOMED))),
        pose([-BASELINE, 0, 0], [0, 0, 0]),
        pose([0, 0, 0], [0, 0, 0]),
    ),
)
BOOK, BIRD, PERSON = (DEFAULT_TARGETS[name] for name in ("book", "bird", "person"))
IMAGE = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)
FRAME_S = 0.04
DEPTH = 0.02  # relative, of a book's depth: its size is taken to be known to 1 %, and two deviations
SPEED = 0.05  # relative, of a book at 2 m/s after a second of frames without noise: its filter expects it to stand
X = (BASELINE + 0.05, 0.1, 10.0)  # a place in both images


def box_at(x, y, z, size=BOOK.size, wrong=1.0):
    """The box of a target of that size, or `wrong` times as large."""
    side = wrong * FOCAL * size / z
    return Detection(np.array([CENTER[0] + FOCAL * x / z, CENTER[1] + FOCAL * y / z]), np.array([side, side]), 1.0)


def track(number, box, t=0.0, *, missed=0, confirmed=True, larger=None):
    side = float(box.size_px.max()) if larger is None else larger
    still = np.zeros(2)
    return Track(
        number, t, confirmed, missed, box.center_px, still, box.size_px, box.size_px, side, np.eye(4), 1.0, box
    )


class Pair:
    """Both cameras' measurements, of targets by their numbers; one may be followed in the zoom image."""

    def __init__(self, profile, finder=None, followed=None, **how):
        make = None if finder is None else lambda calibration, profile: finder
        self.fusion, self.search = (
            TargetFusion(CALIBRATION, profile),
            ZoomSearch(CALIBRATION, profile, finder=make, **how),
        )
        self.followed = followed

    def show(self, t, tracks, favoured=()):
        self.fusion.add_tracks(Frame(IMAGE, t), tracks, None, [self.search], favoured)
        self.search.search_for(self.fusion.targets.get(self.followed))

    def estimate(self, number, t):
        target = self.fusion.targets.get(number)
        return target and target.estimate(t)

    def candidates(self, t):
        return candidates_of(self.fusion.targets.values(), t, CALIBRATION.zoom_head.T_base_fixed, SIZE)

    def warnings(self, t):
        return self.search.warnings(self.estimate(self.followed, t))


def seen(fusion, tracks_at, frames):
    """Show some frames; return the time of the last one."""
    for i in range(frames):
        fusion.show(i * FRAME_S, tracks_at(i * FRAME_S))
    return (frames - 1) * FRAME_S


def report(fusion, t, pan=0.0, nominal=ZOOMED, sigma=0.0):
    """Head and lens report their state."""
    fusion.search.states.add(PanTiltState(pan, 0.0, False, t, sigma), ZoomState(nominal, False, t))


# ---------------------------------------------------------------- filters of tracks
def test_a_track_has_an_estimate_as_long_as_it_lives():
    fusion = Pair(BOOK)
    assert fusion.estimate(1, 0.0) is None
    both = [track(1, box_at(1.0, 0.5, 10.0)), track(2, box_at(-1.0, 0.0, 8.0))]
    t = seen(fusion, lambda t: both, 10)
    np.testing.assert_allclose(fusion.estimate(1, t).x_fixed, (1.0, 0.5, 10.0), rtol=0.02)
    np.testing.assert_allclose(fusion.estimate(2, t).x_fixed, (-1.0, 0.0, 8.0), rtol=0.02, atol=1e-6)
    fusion.show(t + FRAME_S, both[1:])
    assert fusion.estimate(1, t) is None
    assert fusion.estimate(2, t) is not None


def test_a_nudge_of_the_fixed_camera_moves_no_target():
    """It is turned to the right by 20 px: all that it shows moves to the left."""
    fusion, shift = Pair(BOOK), np.array([-20.0, 0.0])
    assert fusion.fusion.warnings() == []
    t = seen(fusion, lambda t: [track(1, box_at(0.0, 0.5, 10.0), t)], 10)
    moved = box_at(0.0, 0.5, 10.0)
    fusion.fusion.add_shift(shift, cut=False)
    fusion.show(t + FRAME_S, [track(1, replace(moved, center_px=moved.center_px + shift), t + FRAME_S)])
    np.testing.assert_allclose(fusion.estimate(1, t + FRAME_S).x_fixed, (0.0, 0.5, 10.0), rtol=0.02, atol=0.01)
    assert "turned by 2 degrees" in fusion.fusion.warnings()[0]  # 20 / 700
    fusion.fusion.add_shift(None, cut=False)
    assert "turned by 2 degrees" in fusion.fusion.warnings()[0]
    fusion.fusion.add_shift(shift, cut=True)
    assert "calibrate again" in fusion.fusion.warnings()[0]


@pytest.mark.parametrize("follows_s", [0.0, 0.15])
def test_what_was_seen_while_a_target_went_behind_a_wall_moves_no_prediction(follows_s):
    """Of a person who walks at 1.5 m/s, the part that is left before the wall's edge moves at half of that.

    In the last frames the usual size may have followed the boxes, as that of a car that drives off does.
    """
    fusion, edge, height = Pair(PERSON), 0.5, FOCAL * PERSON.size / 10.0

    def shown(t):
        left = -2.3 + 1.5 * t
        right = min(left + 0.6, edge)
        center = np.array([CENTER[0] + FOCAL * (left + right) / 2 / 10.0, CENTER[1]])
        return Detection(center, np.array([FOCAL * (right - left) / 10.0, height]), 1.0)

    covered_t = (edge + 2.3) / 1.5
    count = math.floor((covered_t - 0.05) / FRAME_S)

    def usual(t):
        return shown(t if t > count * FRAME_S - follows_s else 0.0).size_px

    seen_t = seen(fusion, lambda t: [replace(track(1, shown(t), t), size_px=usual(t))], count)
    for i in range(count, count + 40):
        lost = replace(track(1, shown(seen_t), i * FRAME_S, missed=i - count + 1), seen_t=seen_t)
        fusion.show(i * FRAME_S, [lost])
    t = (count + 39) * FRAME_S
    assert fusion.estimate(1, t).x_fixed[0] == pytest.approx(-2.0 + 1.5 * t, abs=0.3)


def test_a_person_who_set_off_before_a_wall_is_expected_behind_it():
    """No box showed a part of him, so that nothing is left out."""
    fusion, starts_t, hidden_t = Pair(PERSON), 1.0, 1.9

    def across(t):
        at_speed = starts_t + 0.5  # accelerates at 6 m/s^2 until then
        return 3.0 * np.clip(t - starts_t, 0.0, 0.5) ** 2 + 3.0 * max(t - at_speed, 0.0)

    count = math.floor(hidden_t / FRAME_S)
    seen_t = seen(fusion, lambda t: [track(1, box_at(across(t), 0.0, 10.0, size=PERSON.size), t)], count)
    for i in range(count, count + 22):
        lost = track(1, box_at(across(seen_t), 0.0, 10.0, size=PERSON.size), i * FRAME_S, missed=i - count + 1)
        fusion.show(i * FRAME_S, [replace(lost, seen_t=seen_t)])
    t = (count + 21) * FRAME_S
    assert fusion.estimate(1, t).x_fixed[0] == pytest.approx(across(t), abs=1.0)  # of 2.7 m unseen


def test_a_missed_track_measures_nothing():
    """Its box is an old one, at another place."""
    fusion = Pair(BOOK)
    t = seen(fusion, lambda t: [track(1, box_at(1.0, 0.0, 10.0), t)], 5)
    before = fusion.estimate(1, t + 1)
    fusion.show(t + 1, [track(1, box_at(3.0, 0.0, 10.0), t + 1, missed=1)])
    after = fusion.estimate(1, t + 1)
    assert (after.state == before.state).all()
    assert after.measured_t == t


def test_the_size_of_a_wingspan_is_the_largest_side_over_a_beat():
    """The same boxes with twice the largest side are of a bird at half the distance."""
    depths, box = [], Detection(np.array([320.0, 240.0]), np.array([12.0, 8.0]), 1.0)
    for larger in (20.0, 40.0):
        fusion = Pair(BIRD)
        t = seen(fusion, lambda t, larger=larger: [track(1, box, t, larger=larger)], 20)
        depths.append(fusion.estimate(1, t).depth)
    assert depths[0] == pytest.approx(2 * depths[1], rel=0.01)


def crowd(numbers, t=0.0, *, confirmed=True):
    return [track(n, box_at(0.05 * n, 0.0, 10.0), t, confirmed=confirmed) for n in numbers]


def known(fusion, t=0.0):
    return {n for n in range(1, 101) if fusion.estimate(n, t) is not None}


MOST = FusionSettings.most_filters


@pytest.mark.parametrize(
    ("first", "then", "expected"),
    [
        ([], crowd(range(1, 101), FRAME_S), range(1, 1 + MOST)),
        (crowd(range(51, 101)), crowd(range(1, 101), FRAME_S), range(51, 51 + MOST)),
        (
            crowd(range(1, 51), confirmed=False),
            crowd(range(51, 101), FRAME_S) + crowd(range(1, 51), FRAME_S, confirmed=False),
            range(51, 51 + MOST),
        ),
    ],
    ids=["first", "with a filter already", "confirmed"],
)
def test_of_a_crowd_the_most_important_have_filters(first, then, expected):
    fusion = Pair(BOOK)
    fusion.show(0.0, first)
    fusion.show(FRAME_S, then)
    assert known(fusion, FRAME_S) == set(expected)
    assert all(fusion.estimate(n, FRAME_S).measured_t == FRAME_S for n in expected)


def test_the_followed_and_the_favoured_have_filters_before_others():
    fusion = Pair(BOOK)
    fusion.show(0.0, crowd(range(1, 101)), favoured={90})
    assert known(fusion) == {*range(1, MOST), 90}
    fusion.search.search_for(fusion.fusion.targets[5])
    fusion.show(FRAME_S, crowd(range(1, 101), FRAME_S), favoured=set(range(20, 60)))
    assert known(fusion, FRAME_S) == {5, *range(20, 20 + MOST - 1)}


# ---------------------------------------------------------------- boxes of several targets
def crossing_persons(t, speed=1.5, depth=10.0):
    """Centres and common size of two persons who cross in the middle of the view at 2 s, (2, 2) and (2,) [px]."""
    way = FOCAL * speed * (t - 2.0) / depth
    return CENTER + np.array([[way, 0.0], [-way, 0.0]]), np.array([0.4, 1.75]) * FOCAL / depth


class Finder:
    """Finder that returns the true point inside a gate and logs its calls."""

    def __init__(self, x_fixed=X, body_sigma_px=1.0, gate=math.inf, bias=(0.0, 0.0)):
        self.x, self.body_sigma_px, self.gate = np.array(x_fixed), body_sigma_px, gate
        self.off_px = ZOOMED * np.array([-bias[0], bias[1]])  # of a head that points farther right and up
        self.shown, self.asked = {}, []

    def store(self, frame, detection, mask):
        self.shown[frame.t] = detection.size_px

    def fixed_view_at(self, t):
        return "a view"

    def find(self, frame, x_fixed, covariance, pose):
        self.asked.append((x_fixed, pose))
        # The head looks straight ahead.
        center, there = (np.array(CENTER) + ZOOMED * (x[:2] - (BASELINE, 0.0)) / x[2] for x in (self.x, x_fixed))
        if (center - there) @ np.linalg.solve(covariance, center - there) > self.gate:
            return None
        body_sigma_px = np.full(2, self.body_sigma_px)
        return ZoomMeasurement(center + self.off_px, 1.0, body_sigma_px, frame.t)


def test_two_targets_that_cross_are_predicted_through_their_shared_box():
    """While both are one box, the last box of each is at least 6 px and one frame old."""
    tracker, fusion = Tracker(tracking_settings(PERSON), SIZE), Pair(PERSON, Finder(), followed=1)
    merged, worst = [], 0.0
    for i in range(100):
        t = i * FRAME_S
        centers, size = crossing_persons(t)
        boxes = [Detection(center, size, 1.0) for center in centers]
        if abs(centers[0, 0] - centers[1, 0]) <= size[0]:
            merged.append(t)
            boxes = [Detection(np.array(CENTER), size + np.abs(centers[0] - centers[1]), 1.0)]
        fusion.show(t, tracker.update(boxes, t))
        for number in (1, 2) if t > 1.0 else ():
            found = fusion.estimate(number, t + 0.2)
            at = CENTER + FOCAL * found.x_fixed[:2] / found.x_fixed[2]
            worst = max(worst, np.linalg.norm(at - crossing_persons(t + 0.2)[0][number - 1]))
            assert found.measured_t == pytest.approx(t + 0.2, abs=0.2 + 1e-9)
            assert found.depth == pytest.approx(10.0, rel=DEPTH)
    assert len(merged) >= 5
    assert worst < 1.0  # stale boxes make it 50 px and more
    shown = fusion.search.finder.shown
    assert not set(merged) & set(shown)
    np.testing.assert_allclose(list(shown.values()), [size] * len(shown))


def test_a_larger_shared_box_moves_the_estimate_less():
    """Two targets stand as one box, and the track has drifted by 10 px."""

    def pulled(around):
        fusion = Pair(PERSON)
        own = Detection(np.array(CENTER), np.array([28.0, 122.5]), 1.0)
        t = seen(fusion, lambda t: [track(1, own, t)], 25) + FRAME_S
        aside = track(1, replace(own, center_px=np.add(CENTER, (10.0, 0.0))), t)
        fusion.show(t, [replace(aside, box=replace(own, size_px=np.array([around, 122.5])), shared=True)])
        return FOCAL * fusion.estimate(1, t).x_fixed[0] / 10.0

    assert 0 < pulled(100.0) < pulled(40.0) < 1.0


def test_a_box_of_a_part_of_the_target_measures_no_size():
    fusion = Pair(PERSON)
    whole = Detection(np.array(CENTER), np.array([28.0, 122.5]), 1.0)
    t = seen(fusion, lambda t: [track(1, whole, t)], 25)
    part = replace(whole, size_px=np.array([28.0, 61.0]))
    for _ in range(10):
        t += FRAME_S
        fusion.show(t, [replace(track(1, whole, t), box=part)])
    assert fusion.estimate(1, t).depth == pytest.approx(10.0, rel=DEPTH)


# ---------------------------------------------------------------- candidates for selection
def test_candidates_have_directions_and_rates_as_the_head_sees_them():
    """At 2 m/s to the right, 10 m away: seen from 0.4 m to the right, the middle of the view is to the left."""
    fusion = Pair(BOOK)
    t = seen(fusion, lambda t: [track(1, box_at(2.0 * t - 2.0, -1.0, 10.0), t)], 26)
    (found,) = fusion.candidates(t)
    now, later = (math.atan2(x - BASELINE, 10.0) for x in (0.0, 2.0))
    assert found.at[0] == pytest.approx(now, abs=2e-3)
    assert found.at[1] == pytest.approx(math.atan2(1.0, math.hypot(BASELINE, 10.0)), rel=DEPTH)  # up
    assert found.rate[0] == pytest.approx(later - now, rel=SPEED)


def looking(profile=BOOK):
    """A run of the head and its lens, which zooms to `ZOOMED`, and the fusion."""
    rig = rig_of(FormulaRig(focal_range=(FOCAL, ZOOMED)))
    fusion, run = Pair(profile), HeadRun(rig, CALIBRATION, profile, FirstCome(), FollowSettings())
    fusion.search = run.search
    return fusion, run


def test_candidates_are_confirmed_tracks_with_their_time_in_the_close_up():
    fusion, run = looking()
    tracks = [track(n, box_at(float(n), 0.0, 10.0), confirmed=n < 3) for n in (1, 2, 3)]
    fusion.show(0.0, tracks)
    report(fusion, 0.0, pan=math.atan2(2.0 - BASELINE, 10.0))
    for _ in range(3):
        run.count_seen_well(fusion.fusion.targets[2], 0.5)
    assert {each.track.id: each.seen_s for each in fusion.candidates(0.0)} == {1: 0.0, 2: 1.5}
    fusion.show(FRAME_S, tracks[:1])  # it is gone ...
    fusion.show(2 * FRAME_S, tracks)  # ... and another has its number
    assert {each.seen_s for each in fusion.candidates(2 * FRAME_S)} == {0.0}


@pytest.mark.parametrize(("pan", "nominal", "well"), [
    (0.0, ZOOMED, True),  # it is 70 px large, and 160 are wanted: the lens can do no more
    (0.0, 0.85 * ZOOMED, True),
    (0.0, 0.75 * ZOOMED, False),  # on its way
    (0.07, ZOOMED, True),
    (0.11, ZOOMED, False),  # of 0.107 to the border half the book is 0.012
])  # fmt: skip
def test_a_target_is_seen_well_inside_the_close_up_and_as_large_as_wanted(pan, nominal, well):
    fusion, run = looking()
    box = box_at(BASELINE, 0.0, 10.0)
    t = seen(fusion, lambda t: [track(1, box, t)], 20)
    target = fusion.fusion.targets[1]

    def counted(missed=0, t=t):
        before, target.track = target.seen_well_s, track(1, box, t, missed=missed)
        run.count_seen_well(target, 0.5)
        return target.seen_well_s - before

    assert counted() == 0.0  # head and lens have not reported yet
    for when in (t, t + 1.0):
        report(fusion, when, pan, nominal)
    assert counted() == 0.5 * well
    assert counted(25, t + 1.0) == 0.0  # out of sight


# ---------------------------------------------------------------- the followed target in the zoom image
def followed(finder, x_fixed=X, wrong=1.0, frames=40, shake=0.0, sigma=0.0, **how):
    """Follow a standing book, whose box is `wrong` times too large, with a given finder.

    The head points straight ahead at each frame, and `shake` [rad] to the left between two frames; it reports a
    standard deviation [rad].
    """
    fusion, found = Pair(BOOK, finder, followed=1, **how), []
    for i in range(frames):
        t = i * FRAME_S
        fusion.show(t, [track(1, box_at(*x_fixed, wrong=wrong), t)])
        report(fusion, t - FRAME_S / 2, pan=-shake)
        report(fusion, t, sigma=sigma)
        found.append(fusion.search.add_frame(Frame(IMAGE, t), t))
    return fusion, found, t


def test_the_zoom_image_triangulates_the_depth():
    """The box is 3 % too large, so the depth by size is 3 % too small."""
    alone, none, t = followed(Finder(), wrong=1.03, closed_loop=False)
    both, found, _ = followed(finder := Finder(), wrong=1.03)
    assert none == [None] * 40
    assert all(each is not None for each in found)
    assert alone.estimate(1, t).depth == pytest.approx(10.0 / 1.03, rel=0.01)
    # A book's size is taken to be known to 1 %, the head's pan to 0.03 degrees, which is 1.2 % of this depth.
    assert both.estimate(1, t).depth == pytest.approx(10.0, rel=DEPTH)
    assert finder.asked[-1][1].nominal_px == pytest.approx(ZOOMED)
    assert finder.asked[-1][0][2] == pytest.approx(10.0, rel=DEPTH)


@pytest.mark.parametrize(
    ("body_sigma_px", "shake", "sigma"),
    [(30.0, 0.0, 0.0), (1.0, 0.05, 0.0), (1.0, 0.0, 0.01)],
    ids=["moving limbs", "moving head", "coarse reports"],
)
def test_an_uncertain_centre_in_the_zoom_image_moves_the_estimate_less(body_sigma_px, shake, sigma):
    off = np.add(X, (0.02, 0.0, 0.0))
    certain, _, t = followed(Finder(off), frames=10)
    uncertain, _, _ = followed(Finder(off, body_sigma_px), frames=10, shake=shake, sigma=sigma)
    assert uncertain.estimate(1, t).x_fixed[0] - X[0] < 0.7 * (certain.estimate(1, t).x_fixed[0] - X[0])


def test_the_zoom_image_is_searched_at_the_heads_angles_plus_their_bias():
    """The size of a book and the depth that it gives are known well enough to find most of the bias."""
    bias = 1e-3, 1.5e-3
    fusion, _, t = followed(finder := Finder(bias=bias))
    asked = finder.asked[-1][1].pan, finder.asked[-1][1].tilt
    np.testing.assert_allclose(fusion.estimate(1, t).bias, bias, rtol=0.5)
    np.testing.assert_allclose(asked, bias, rtol=0.5)


def test_the_zoom_image_is_not_searched_without_a_target_and_a_pose():
    fusion = Pair(BOOK, Finder())
    fusion.show(0.0, [track(1, box_at(*X))])
    assert fusion.search.add_frame(Frame(IMAGE, 0.0), 0.0) is None  # nothing is followed, no pose is known
    report(fusion, 0.0)
    assert fusion.search.add_frame(Frame(IMAGE, 0.0), 0.0) is None
    fusion.search.search_for(fusion.fusion.targets[1])
    assert fusion.search.add_frame(Frame(IMAGE, 0.0), 0.0) is not None


def test_another_target_has_another_finder():
    fusion = Pair(BOOK)
    fusion.show(0.0, crowd((1, 2)))
    first, second = fusion.fusion.targets.values()
    fusion.search.search_for(first)
    finder = fusion.search.finder
    fusion.search.search_for(first)
    assert fusion.search.finder is finder
    fusion.search.search_for(second)
    assert fusion.search.finder is not finder


def test_the_finder_measures_the_centre_of_the_followed_body():
    """A track's box may lie beside the body."""

    class Beside(Finder):
        def store(self, frame, detection, mask):
            return type("View", (), {"body_px": detection.center_px + 5.0, "body_sigma_px": np.full(2, 0.1)})

    box = box_at(0.0, 0.0, 10.0)
    fusion = Pair(BOOK, Beside(), followed=1)
    t = seen(fusion, lambda t: [track(1, box, t), track(2, replace(box), t)], 10)
    ours, other = (fusion.estimate(n, t).x_fixed for n in (1, 2))
    assert ours[0] * FOCAL / ours[2] == pytest.approx(5.0, abs=0.05)
    assert other[0] == pytest.approx(0.0, abs=1e-6)


def test_the_depth_is_that_of_a_person_whose_hand_came_first():
    """At 10 m he is 122 px tall; his hand of 10 px alone would be a person at 122 m."""
    hand = Detection(np.array([600.0, 240.0]), np.array([10.0, 10.0]), 1.0)
    clipped = Detection(np.array([620.0, 240.0]), np.array([40.0, 122.0]), 1.0, clipped=True)
    whole = Detection(np.array([600.0, 240.0]), np.array([50.0, FOCAL * PERSON.size / 10]), 1.0)
    fusion, depths = Pair(PERSON), []
    for i, box in enumerate([hand] * 3 + [clipped] * 3 + [whole] * 3):
        fusion.show(i * FRAME_S, [track(1, box, i * FRAME_S)])
        depths.append(fusion.estimate(1, i * FRAME_S).x_fixed[2])
    assert depths[2] > 50
    assert max(depths[3:]) < 15
    assert depths[-1] == pytest.approx(10.0, rel=0.1)


def test_a_bird_that_comes_near_keeps_its_velocity():
    """From 4 px to 40 px in 2 s, across the image at 100 px a second: it was always the bird."""
    fusion, off = Pair(BIRD), []
    for i in range(51):
        t, side = i * FRAME_S, 4.0 * 10 ** (i / 50)
        fusion.show(t, [track(1, Detection(np.array([200 + 100 * t, 240.0]), np.array([side, side]), 1.0), t)])
        ahead = fusion.estimate(1, t + 0.2).x_fixed
        off.append(CENTER[0] + FOCAL * ahead[0] / ahead[2] - (220 + 100 * t))
    assert np.abs(off[10:]).max() < 2


def test_a_standing_body_without_its_feet_in_one_frame_stays_where_it_is():
    """The detector loses the lowest 12 of 120 px: the box's middle is 6 px higher, the body's is not."""
    usual = Detection(np.array(CENTER), np.array([50.0, 120.0]), 1.0)
    cut = replace(usual, center_px=usual.center_px - (0, 6), size_px=np.array([50.0, 108.0]))

    class Exact(Finder):
        def store(self, frame, detection, mask):
            return type(
                "View", (), {"body_px": detection.center_px, "body_sigma_px": np.array([1.5, 0.7]), "turn": 0.0}
            )

    fusion = Pair(PERSON, Exact(), followed=1)
    t = seen(fusion, lambda t: [track(1, usual, t)], 20) + FRAME_S
    fusion.show(t, [replace(track(1, usual, t), box=cut)])
    x = fusion.estimate(1, t).x_fixed
    assert abs(x[1] * FOCAL / x[2]) < 0.3


# ---------------------------------------------------------------- contradictions
UNFOUND = int(FusionSettings.unfound_s / FRAME_S) + 2  # frames


def test_a_target_not_found_where_expected_is_reported_and_then_searched_farther_around():
    """Its nominal size is 15 % too small: at 10 m, 0.4 m beside, that is 21 px of 3000."""
    fusion, found, t = followed(Finder(gate=9.0), wrong=1.15, frames=UNFOUND)
    assert found[:-2] == [None] * (UNFOUND - 2)
    (text,) = fusion.warnings(t)
    assert text.startswith("for 1.5 s not found where the zoom camera should show it")
    fusion, found, t = followed(Finder(gate=9.0), wrong=1.15, frames=UNFOUND + 30)
    assert all(each is not None for each in found[-20:])
    (text,) = fusion.warnings(t)
    assert text.startswith("the nominal size or the calibration seems wrong: both views make it 0.2")


@pytest.mark.parametrize(("wrong", "likely"), [(1.0, True), (1.15, False)])
def test_a_target_of_another_size_is_an_unlikely_candidate(wrong, likely):
    fusion, _, t = followed(Finder(gate=9.0), wrong=wrong, frames=UNFOUND + 30)
    for target in (fusion.fusion.targets[1], None):  # also while it is not followed
        fusion.search.search_for(target)
        (found,) = fusion.candidates(t)
        assert found.likely is likely


def test_a_target_that_the_zoom_image_cannot_show_causes_no_warning():
    """It is outside the zoom image, or hidden in the fixed image too."""
    outside = (BASELINE + 2.0, 0.0, 10.0)  # 600 px beside the middle
    fusion, _, t = followed(Finder(gate=-1.0), outside, frames=100)
    assert fusion.warnings(t) == []
    fusion, _, _ = followed(Finder(gate=-1.0), frames=5)
    for i in range(5, 60):
        t = i * FRAME_S
        fusion.show(t, [track(1, box_at(*X), t, missed=i)])
        report(fusion, t)
        fusion.search.add_frame(Frame(IMAGE, t), t)
    assert fusion.warnings(t) == []


# ---------------------------------------------------------------- cameras with different times
class Ahead(CloseupFinder):
    """Finder that returns the image centre of each zoom frame and logs its times."""

    def __init__(self):
        super().__init__(CALIBRATION, BOOK)
        self.asked = []

    def find(self, frame, x_fixed, covariance, pose):
        self.asked.append(frame.t)
        return ZoomMeasurement(np.array(CENTER), 1.0, np.ones(2), frame.t)


def apart(by, frames=60, missed=lambda i: 0):
    """Fusion whose zoom frames are newer than the fixed ones by so much [s]; the measurements and the warnings."""
    box = box_at(BASELINE, 0.0, 10.0)
    fusion, found = Pair(BOOK, Ahead(), followed=1), []
    for i in range(frames):
        t = 1.0 + i * FRAME_S
        fusion.show(t, [track(1, box, t, missed=missed(i))])
        for when in sorted((t, t + by)):
            report(fusion, when)
        found.append(fusion.search.add_frame(Frame(IMAGE, t + by), t))
    return fusion, found, fusion.warnings(t)


@pytest.mark.parametrize("by", [0.08, 0.13, 0.29, 0.97, -0.13, -0.29, -0.97])
def test_cameras_of_different_latencies_are_fused_at_equal_times(by):
    _, found, warnings = apart(by)
    assert all(each is not None for each in found[30:])
    assert np.diff([each.t for each in found[30:]]) == pytest.approx(FRAME_S)
    assert warnings == []


@pytest.mark.parametrize(("by", "later"), [(1.4, "fixed"), (-1.4, "zoom")])
def test_cameras_too_far_apart_in_time_are_reported(by, later):
    warnings = apart(by)[2]
    assert warnings == [f"the cameras are too far apart in time: the {later} one comes 1.40 s later"]


def test_late_stamps_are_named_and_corrected():
    """Both views of a simulated bird, by stamps 60 ms late, are added to the search's own estimate of the clocks."""
    flight = Flight("bird", 300)
    fusion, target_filter = Pair(BIRD, followed=1), TargetFilter(flight.calibration, BIRD)
    t = seen(fusion, lambda t: [track(1, box_at(*X), t)], 5)
    assert fusion.warnings(t) == []
    for t_true in flight.times:
        box, view = flight.wide(t_true), flight.zoom(t_true + APART)
        if box is not None:
            target_filter.add_fixed(box, t_true + 0.06)
        if view is not None:
            show(target_filter, view)
        fusion.search.clock.add(target_filter.observations)
    for _ in range(20):
        fusion.search.clock.correct()
    (warning,) = fusion.warnings(t)
    assert re.match("the fixed camera's stamps are [567]. ms late", warning)


def test_zoom_frames_without_a_fixed_frame_of_their_time_cause_no_warning():
    """The fixed camera shows the target in one frame of 25, or stops: few zoom frames wait for it."""
    fusion, _, warnings = apart(0.0, 100, lambda i: i % 25)
    assert len(fusion.search.finder.asked) <= 4 * (2 * MatchingSettings.longest_apart_s / FRAME_S + 1)
    assert warnings == []
    stopped = Pair(BOOK, Ahead(), followed=1)
    for i in range(100):
        assert stopped.search.add_frame(Frame(IMAGE, i * FRAME_S), 0.0) is None
    for each in (fusion, stopped):
        assert len(each.search.waiting) <= MatchingSettings.latest_s / FRAME_S + 1


RATE_S = 0.04
OFF_DEG = 0.024  # largest error of the cubic, where the acceleration changes between two states


def filled(pan, until=1.2, lens=lambda t: 1000.0, phase=0.0):
    history = StateHistory()
    for t in np.arange(-0.2 + phase, until, RATE_S):
        history.add(PanTiltState(pan(t), -pan(t), True, t), ZoomState(lens(t), True, t))
    return history


def profile(goal_deg):
    segments = trapezoid(0.1, 0.0, 0.0, goal_deg, 149.0, 206.0)

    def pan(t):
        begun = [s for s in segments if s[0] <= t]
        if not begun:
            return 0.0
        start, x, v, a = begun[-1]
        return math.radians(x + v * (t - start) + a * (t - start) ** 2 / 2)

    return pan


@pytest.mark.parametrize("phase", [0.0, 0.013, 0.031])
def test_pan_tilt_and_speed_are_interpolated_along_a_move(phase):
    pan = profile(20.0)
    history = filled(pan, phase=phase)
    for t in np.arange(0.0, 0.95, 0.005):
        found = history.interpolate(t)
        assert math.degrees(abs(found.pan - pan(t))) < OFF_DEG
        assert found.tilt == -found.pan
    # It is fastest half way, after sqrt(20 / 206) s: 206 times that, on both axes.
    fastest = history.interpolate(0.1 + math.sqrt(20 / 206))
    assert math.degrees(fastest.speed) == pytest.approx(math.sqrt(2) * 206 * math.sqrt(20 / 206), rel=0.1)
    assert history.interpolate(0.99).speed == pytest.approx(0.0, abs=1e-9)


def test_the_logarithm_of_the_focal_length_is_interpolated_linearly():
    history = filled(lambda t: 0.0, lens=lambda t: 1000.0 * math.exp(t))
    assert history.interpolate(0.513).nominal_px == pytest.approx(1000.0 * math.exp(0.513))


def test_only_times_between_two_kept_states_have_a_pose():
    history = StateHistory()
    assert history.interpolate(0.0) is None
    history.add(PanTiltState(0.1, 0.2, False, 5.0), ZoomState(700.0, False, 5.0))
    assert (history.interpolate(5.0).pan, history.interpolate(5.0).speed) == (0.1, 0.0)
    assert history.interpolate(5.01) is None
    history.add(PanTiltState(0.2, 0.2, False, 5.1), ZoomState(700.0, False, 5.1))
    assert history.interpolate(5.05).pan == pytest.approx(0.15)
    history.add(PanTiltState(0.9, 0.9, False, 5.1), ZoomState(900.0, False, 5.1))  # the same state once more
    assert history.interpolate(5.05).pan == pytest.approx(0.15)
    history.add(PanTiltState(0.2, 0.2, False, 5.1 + REMEMBERED_S), ZoomState(700.0, False, 5.1 + REMEMBERED_S))
    assert history.interpolate(5.05) is None


@pytest.mark.parametrize("apart", [1e-4, 1e-3, 2e-3])
def test_states_in_close_pairs_do_not_multiply_their_rounding(apart):
    step, rate = math.radians(0.0514286), math.radians(30.0)
    history = StateHistory()
    for k in range(40):
        for t in (k * RATE_S, k * RATE_S + apart):
            pan = round(rate * t / step) * step
            history.add(PanTiltState(pan, 0.0, True, t), ZoomState(1000.0, False, t))
    times = np.arange(0.5, 1.4, 0.003)
    off = [history.interpolate(t).pan - rate * t for t in times]
    assert np.sqrt(np.mean(np.square(off))) < 0.5 * step
    assert history.interpolate(39 * RATE_S + apart) is not None  # the newest state is kept
