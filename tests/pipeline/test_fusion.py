"""What is known of every track: which have a filter, what a policy is told, what the zoom view adds to one of them.

The wide camera looks along z from the origin and the zoom camera from 0.4 m to the right, where pan and tilt meet.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import DEFAULT_TARGETS
from cotarget.control.selection import RATE_S
from cotarget.detection import Detection
from cotarget.estimation.zoom_matching import CloseupFinder, MatchingSettings, ZoomMeasurement
from cotarget.fusion import MOST_WAITING, FusionSettings, TargetFusion
from cotarget.geometry import pose
from cotarget.rig import Frame, PanTiltState, ZoomState
from cotarget.rig_geometry import FixedCamera, ZoomHead
from cotarget.tracking.track import Track, tracking_settings
from cotarget.tracking.tracker import Tracker

SIZE, CENTER, FOCAL, ZOOMED = (640, 480), (319.5, 239.5), 700.0, 3000.0
BASELINE = 0.4
CALIBRATION = Calibration(
    fixed=FixedCamera(Intrinsics(SIZE, (FOCAL, FOCAL), CENTER)),
    zoom_head=ZoomHead(
        ZoomLens(
            (FOCAL, ZOOMED), (Intrinsics(SIZE, (FOCAL, FOCAL), CENTER), Intrinsics(SIZE, (ZOOMED, ZOOMED), CENTER))
        ),
        pose([-BASELINE, 0, 0], [0, 0, 0]),
        pose([0, 0, 0], [0, 0, 0]),
    ),
)
BOOK, BIRD, PERSON = (DEFAULT_TARGETS[name] for name in ("book", "bird", "person"))
PICTURE = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)
FRAME_S = 0.04
DEPTH = 0.02  # of a book: its size is taken to be known to 1 %, and two deviations
SPEED = 0.05  # of a book at 2 m/s after a second of frames without noise: its filter doubts that it moves


def box_at(x, y, z, size=BOOK.size, wrong=1.0):
    """A box as wide as a target of that size looks there, or wrongly so."""
    side = wrong * FOCAL * size / z
    return Detection(np.array([CENTER[0] + FOCAL * x / z, CENTER[1] + FOCAL * y / z]), np.array([side, side]), 1.0)


def track(number, box, t=0.0, *, missed=0, confirmed=True, larger=None):
    side = float(box.size_px.max()) if larger is None else larger
    still = np.zeros(2)
    return Track(number, t, confirmed, missed, box.center_px, still, box.size_px, side, np.eye(4), 1.0, box)


def seen(fusion, tracks_at, frames):
    """Show a pursuit so many frames; the time of the last one."""
    for i in range(frames):
        t = i * FRAME_S
        fusion.update_fixed(Frame(PICTURE, t), tracks_at(t), None)
    return t


def test_a_track_has_an_estimate_as_long_as_it_lives():
    fusion = TargetFusion(CALIBRATION, BOOK, SIZE)
    box = box_at(1.0, 0.5, 10.0)
    assert fusion.estimate(1, 0.0) is None
    t = seen(fusion, lambda t: [track(1, box, t), track(2, box_at(-1.0, 0.0, 8.0), t)], 10)
    np.testing.assert_allclose(fusion.estimate(1, t).x_fixed, (1.0, 0.5, 10.0), rtol=0.02)
    np.testing.assert_allclose(fusion.estimate(2, t).x_fixed, (-1.0, 0.0, 8.0), rtol=0.02, atol=1e-6)
    fusion.update_fixed(Frame(PICTURE, t + FRAME_S), [track(2, box_at(-1.0, 0.0, 8.0), t + FRAME_S)], None)
    assert fusion.estimate(1, t) is None
    assert fusion.estimate(2, t) is not None


def test_a_track_that_was_missed_measures_nothing():
    """Its box is an old one, and it was elsewhere."""
    fusion = TargetFusion(CALIBRATION, BOOK, SIZE)
    t = seen(fusion, lambda t: [track(1, box_at(1.0, 0.0, 10.0), t)], 5)
    before = fusion.estimate(1, t + 1)
    fusion.update_fixed(Frame(PICTURE, t + 1), [track(1, box_at(3.0, 0.0, 10.0), t + 1, missed=1)], None)
    after = fusion.estimate(1, t + 1)
    assert (after.state == before.state).all()
    assert after.measured_t == t


def test_of_a_hundred_tracks_only_the_first_have_filters():
    fusion = TargetFusion(CALIBRATION, BOOK, SIZE)
    tracks = [track(n, box_at(0.05 * n, 0.0, 10.0)) for n in range(1, 101)]
    fusion.update_fixed(Frame(PICTURE, 0.0), tracks, None)
    known = [n for n in range(1, 101) if fusion.estimate(n, 0.0) is not None]
    assert known == list(range(1, FusionSettings.most_filters + 1))


def test_a_birds_wingspan_is_the_largest_side_over_a_beat():
    """The same boxes with twice the largest side are of a bird at half the distance."""
    depths = []
    for larger in (20.0, 40.0):
        fusion = TargetFusion(CALIBRATION, BIRD, SIZE)
        box = Detection(np.array([320.0, 240.0]), np.array([12.0, 8.0]), 1.0)
        t = seen(fusion, lambda t, box=box, larger=larger: [track(1, box, t, larger=larger)], 20)
        depths.append(fusion.estimate(1, t).depth)
    assert depths[0] == pytest.approx(2 * depths[1], rel=0.01)


def test_a_policy_is_told_directions_and_speeds_as_the_head_sees_them():
    """At 2 m/s to the right, 10 m away: seen from 0.4 m to the right, the middle of the view is to the left."""
    fusion = TargetFusion(CALIBRATION, BOOK, SIZE)
    t = seen(fusion, lambda t: [track(1, box_at(2.0 * t - 2.0, -1.0, 10.0), t)], 26)
    (found,) = fusion.candidates([track(1, box_at(0.0, -1.0, 10.0), t)], t)
    assert t == pytest.approx(1.0)
    # The depth is known by the size alone, to some per cent.
    assert found.at[0] == pytest.approx(math.atan2(-BASELINE, 10.0), abs=2e-3)
    assert found.at[1] == pytest.approx(math.atan2(1.0, math.hypot(BASELINE, 10.0)), rel=DEPTH)  # up
    later = math.atan2(2.0 * RATE_S - BASELINE, 10.0)
    assert found.rate[0] == pytest.approx((later - math.atan2(-BASELINE, 10.0)) / RATE_S, rel=SPEED)


def crossing_persons(t, speed=1.5, depth=10.0):
    """Middles and common size of two persons who cross in the middle of the view at 2 s, (2, 2) and (2,) [px]."""
    way = FOCAL * speed * (t - 2.0) / depth
    return CENTER + np.array([[way, 0.0], [-way, 0.0]]), np.array([0.4, 1.75]) * FOCAL / depth


class Learner:
    """A finder that notes at what times it was shown the target, and how large."""

    def __init__(self):
        self.shown = {}

    def update_fixed(self, frame, detection, mask):
        self.shown[frame.t] = detection.size_px


def test_who_crosses_another_is_predicted_as_before():
    """While both are one box neither is where its own last box was, 6 px a frame ago and more."""
    tracker, fusion = Tracker(tracking_settings(PERSON), SIZE), TargetFusion(CALIBRATION, PERSON, SIZE)
    fusion.follow(1)
    fusion.search.finder, merged, worst = Learner(), [], 0.0
    for i in range(100):
        t = i * FRAME_S
        middles, size = crossing_persons(t)
        boxes = [Detection(middle, size, 1.0) for middle in middles]
        if abs(middles[0, 0] - middles[1, 0]) <= size[0]:
            merged.append(t)
            boxes = [Detection(np.array(CENTER), size + np.abs(middles[0] - middles[1]), 1.0)]
        fusion.update_fixed(Frame(PICTURE, t), tracker.update(boxes, t), None)
        for number in (1, 2) if t > 1.0 else ():
            found = fusion.estimate(number, t + 0.2)
            at = CENTER + FOCAL * found.x_fixed[:2] / found.x_fixed[2]
            worst = max(worst, np.linalg.norm(at - crossing_persons(t + 0.2)[0][number - 1]))
            assert found.measured_t == pytest.approx(t + 0.2, abs=0.2 + 1e-9)
            assert found.depth == pytest.approx(10.0, rel=0.01)
    assert len(merged) >= 5
    assert worst < 1.0  # stale boxes make it 50 px and more
    assert not set(merged) & set(fusion.search.finder.shown)
    np.testing.assert_allclose(list(fusion.search.finder.shown.values()), [size] * len(fusion.search.finder.shown))


def test_a_share_of_a_box_is_the_less_believed_the_more_room_there_is():
    """Two stand as one box, and the tracker has drifted 10 px aside: what it says may not carry the estimate away."""

    def pulled(around):
        fusion = TargetFusion(CALIBRATION, PERSON, SIZE)
        own = Detection(np.array(CENTER), np.array([28.0, 122.5]), 1.0)
        t = seen(fusion, lambda t: [track(1, own, t)], 25) + FRAME_S
        aside = track(1, replace(own, center_px=np.add(CENTER, (10.0, 0.0))), t)
        tracks = [replace(aside, box=replace(own, size_px=np.array([around, 122.5])), shared=True)]
        fusion.update_fixed(Frame(PICTURE, t), tracks, None)
        return FOCAL * fusion.estimate(1, t).x_fixed[0] / 10.0

    assert 0 < pulled(100.0) < pulled(40.0) < 1.0


def test_a_policy_is_told_of_confirmed_tracks_only_and_of_how_long_each_was_seen_well():
    fusion = TargetFusion(CALIBRATION, BOOK, SIZE)
    tracks = [track(n, box_at(float(n), 0.0, 10.0), confirmed=n < 3) for n in (1, 2, 3)]
    fusion.update_fixed(Frame(PICTURE, 0.0), tracks, None)
    fusion.states.add(PanTiltState(math.atan2(2.0 - BASELINE, 10.0), 0.0, False, 0.0), ZoomState(ZOOMED, False, 0.0))
    for _ in range(3):
        fusion.count_seen_well(tracks[1], 0.5, ZOOMED)
    unknown = track(4, box_at(0.0, 0.0, 10.0))
    found = {each.track.id: each.seen_s for each in fusion.candidates([*tracks, unknown], 0.0)}
    assert found == {1: 0.0, 2: 1.5}
    fusion.update_fixed(Frame(PICTURE, FRAME_S), tracks[:1], None)  # it is gone ...
    fusion.update_fixed(Frame(PICTURE, 2 * FRAME_S), tracks, None)  # ... and whoever has its number is another
    assert {each.seen_s for each in fusion.candidates(tracks, 2 * FRAME_S)} == {0.0}


@pytest.mark.parametrize(("pan", "nominal", "well"), [
    (0.0, ZOOMED, True),  # it is 70 px large, and 160 are wanted: the lens can do no more
    (0.0, 0.85 * ZOOMED, True),
    (0.0, 0.75 * ZOOMED, False),  # on its way
    (0.07, ZOOMED, True),
    (0.11, ZOOMED, False),  # of 0.107 to the border half the book is 0.012
])  # fmt: skip
def test_seen_well_is_whoever_is_as_large_as_wanted_and_in_the_image(pan, nominal, well):
    fusion = TargetFusion(CALIBRATION, BOOK, SIZE)
    box = box_at(BASELINE, 0.0, 10.0)
    t = seen(fusion, lambda t: [track(1, box, t)], 20)

    def told(number_of_frames_missed=0, t=t):
        there = track(1, box, t, missed=number_of_frames_missed)
        before = fusion.candidates([there], t)[0].seen_s
        fusion.count_seen_well(there, 0.5, ZOOMED)
        return fusion.candidates([there], t)[0].seen_s - before

    assert told() == 0.0  # nothing was heard of head and lens
    for when in (t, t + 1.0):
        fusion.states.add(PanTiltState(pan, 0.0, False, when), ZoomState(nominal, False, when))
    assert told() == 0.5 * well
    assert told(25, t + 1.0) == 0.0  # whoever is out of sight is not seen


class Finder:
    """Finds a point where the truth says, and notes what it was asked."""

    def __init__(self, x_fixed, body_sigma_px=1.0):
        self.x, self.body_sigma_px, self.asked = np.array(x_fixed), body_sigma_px, []

    def update_fixed(self, frame, detection, mask):
        return None

    def fixed_view_at(self, t):
        return "a sight"

    def find(self, frame, expected):
        self.asked.append(expected)
        tangent = (self.x[:2] - (BASELINE, 0.0)) / self.x[2]  # the head looks straight ahead
        body = np.full(2, self.body_sigma_px)
        return ZoomMeasurement(np.array(CENTER) + ZOOMED * tangent, 1.0, body, 1.0, 1.0, np.ones(2), frame.t)


def followed(x_fixed, wrong, frames, finder, **fusion):
    """A pursuit of a book at a place whose size looks wrong, whose zoom view the finder answers for."""
    fusion = TargetFusion(CALIBRATION, BOOK, SIZE, **fusion)
    fusion.follow(1)
    fusion.search.finder = finder
    found = []
    for i in range(frames):
        t = i * FRAME_S
        fusion.update_fixed(Frame(PICTURE, t), [track(1, box_at(*x_fixed, wrong=wrong), t)], None)
        fusion.states.add(PanTiltState(0.0, 0.0, False, t), ZoomState(ZOOMED, False, t))
        found.append(fusion.update_zoom(Frame(PICTURE, t), t))
    return fusion, found


def test_the_zoom_view_triangulates_the_depth():
    """The size looks 3 % too large, so that the depth seems 3 % too small: what both views see says better."""
    x = (0.45, 0.1, 10.0)
    alone, none = followed(x, 1.03, 40, Finder(x), closed_loop=False)
    both, found = followed(x, 1.03, 40, finder := Finder(x))
    t = 39 * FRAME_S
    assert none == [None] * 40
    assert all(each is not None for each in found)
    assert alone.estimate(1, t).depth == pytest.approx(10.0 / 1.03, rel=0.01)
    # A book's size is taken to be known to 1 %, the head's pan to 0.04 degrees, which is 1.7 % of this depth.
    assert both.estimate(1, t).depth == pytest.approx(10.0, rel=DEPTH)
    assert finder.asked[-1].nominal_px == pytest.approx(ZOOMED)
    assert finder.asked[-1].x_fixed[2] == pytest.approx(10.0, rel=DEPTH)


def test_a_point_that_may_not_be_the_body_moves_the_estimate_less():
    """Wings and limbs: the point that both views show may be far from the middle, and is the less believed for it."""
    x, off = (0.45, 0.1, 10.0), (0.47, 0.1, 10.0)

    def pulled(sigma_px):
        fusion, _ = followed(x, 1.0, 10, Finder(off, sigma_px))
        return fusion.estimate(1, 9 * FRAME_S).x_fixed[0] - x[0]

    assert pulled(30.0) < 0.7 * pulled(1.0)


def test_the_zoom_view_is_not_asked_before_it_is_known_where_it_looks_and_for_whom():
    x = (0.45, 0.1, 10.0)
    fusion = TargetFusion(CALIBRATION, BOOK, SIZE)
    fusion.search.finder = Finder(x)
    fusion.update_fixed(Frame(PICTURE, 0.0), [track(1, box_at(*x))], None)
    assert fusion.update_zoom(Frame(PICTURE, 0.0), 0.0) is None  # nobody is followed, and nothing was heard of the head
    fusion.states.add(PanTiltState(0.0, 0.0, False, 0.0), ZoomState(ZOOMED, False, 0.0))
    assert fusion.update_zoom(Frame(PICTURE, 0.0), 0.0) is None
    fusion.follow(1)
    fusion.search.finder = Finder(x)
    assert fusion.update_zoom(Frame(PICTURE, 0.0), 0.0) is not None


def test_another_target_is_looked_for_by_another_finder():
    fusion = TargetFusion(CALIBRATION, BOOK, SIZE)
    fusion.follow(1)
    finder = fusion.search.finder
    fusion.follow(1)
    assert fusion.search.finder is finder
    fusion.follow(2)
    assert fusion.search.finder is not finder


def test_the_middle_of_the_followed_body_is_what_both_views_show():
    """A track's box may lie beside the body; where a finder has taken it, its middle counts."""

    class Sees(Finder):
        def update_fixed(self, frame, detection, mask):
            return type("Sight", (), {"body_px": detection.center_px + 5.0, "body_sigma_px": np.full(2, 0.1)})

    box = box_at(0.0, 0.0, 10.0)
    fusion = TargetFusion(CALIBRATION, BOOK, SIZE)
    fusion.follow(1)
    fusion.search.finder = Sees((0, 0, 10))
    t = seen(fusion, lambda t: [track(1, box, t), track(2, replace(box), t)], 10)
    ours, other = (fusion.estimate(n, t).x_fixed for n in (1, 2))
    assert ours[0] * FOCAL / ours[2] == pytest.approx(5.0, abs=0.05)
    assert other[0] == pytest.approx(0.0, abs=1e-6)


def crowd(numbers, t=0.0, *, confirmed=True):
    return [track(n, box_at(0.05 * n, 0.0, 10.0), t, confirmed=confirmed) for n in numbers]


def known(fusion, t=0.0):
    return {n for n in range(1, 101) if fusion.estimate(n, t) is not None}


def test_whoever_is_known_stays_known_when_elder_ones_are_believed():
    """Tracks come with the eldest confirmed ones first, and one that was there all the time may be confirmed late."""
    fusion = TargetFusion(CALIBRATION, BOOK, SIZE)
    fusion.update_fixed(Frame(PICTURE, 0.0), crowd(range(51, 101)), None)
    before = known(fusion)
    fusion.update_fixed(Frame(PICTURE, FRAME_S), crowd(range(1, 101), FRAME_S), None)
    assert known(fusion, FRAME_S) == before
    assert all(fusion.estimate(n, FRAME_S).measured_t == FRAME_S for n in before)


def test_the_followed_and_the_favoured_are_known_before_others():
    fusion = TargetFusion(CALIBRATION, BOOK, SIZE)
    fusion.update_fixed(Frame(PICTURE, 0.0), crowd(range(1, 101)), None, favoured={90})
    assert known(fusion) == {*range(1, FusionSettings.most_filters), 90}
    fusion.follow(5)
    fusion.update_fixed(Frame(PICTURE, FRAME_S), crowd(range(1, 101), FRAME_S), None, favoured=set(range(20, 60)))
    assert known(fusion, FRAME_S) == {5, *range(20, 20 + FusionSettings.most_filters - 1)}


def test_whoever_is_believed_is_known_before_whoever_is_not():
    fusion = TargetFusion(CALIBRATION, BOOK, SIZE)
    fusion.update_fixed(Frame(PICTURE, 0.0), crowd(range(1, 51), confirmed=False), None)
    tracks = crowd(range(51, 101), FRAME_S) + crowd(range(1, 51), FRAME_S, confirmed=False)
    fusion.update_fixed(Frame(PICTURE, FRAME_S), tracks, None)
    assert known(fusion, FRAME_S) == set(range(51, 51 + FusionSettings.most_filters))


class Gated(Finder):
    """Finds the point only where it is looked for."""

    def find(self, frame, expected):
        found = super().find(frame, expected)
        off = found.center_px - CENTER - ZOOMED * (expected.x_fixed[:2] - (BASELINE, 0.0)) / expected.x_fixed[2]
        return found if off @ np.linalg.solve(expected.covariance, off) < 9.0 else None


def test_what_is_not_found_where_it_should_be_is_said_and_then_looked_for_farther_around():
    """Its size is told 15 % too small: at 10 m, 0.4 m beside, that is 21 px of 3000."""
    x = (BASELINE + 0.05, 0.0, 10.0)
    frames = int(FusionSettings.unfound_s / FRAME_S) + 2
    fusion, found = followed(x, 1.15, frames, Gated(x))
    t = (frames - 1) * FRAME_S
    assert found[:-2] == [None] * (frames - 2)
    (told,) = fusion.warnings(1, t)
    assert told.startswith("for 1.5 s not found where the zoom camera should show it")
    assert fusion.warnings(2, t) == []
    fusion, found = followed(x, 1.15, frames + 30, Gated(x))
    assert all(each is not None for each in found[-20:])
    (told,) = fusion.warnings(1, t + 30 * FRAME_S)
    assert told.startswith("the nominal size or the calibration seems wrong: both views make it 0.2")
    fusion.follow(2)
    fusion.follow(1)
    assert len(fusion.warnings(1, t)) <= 1


def test_who_is_not_what_was_told_is_an_unlikely_candidate():
    x = (BASELINE + 0.05, 0.0, 10.0)
    for wrong, likely in ((1.0, True), (1.15, False)):
        frames = int(FusionSettings.unfound_s / FRAME_S) + 32
        fusion, _ = followed(x, wrong, frames, Gated(x))
        (seen_so,) = fusion.candidates([track(1, box_at(*x, wrong=wrong))], (frames - 1) * FRAME_S)
        assert seen_so.likely is likely
        fusion.follow(2)  # what it was found to be is not forgotten meanwhile
        (seen_so,) = fusion.candidates([track(1, box_at(*x, wrong=wrong))], frames * FRAME_S)
        assert seen_so.likely is likely


def test_what_cannot_be_seen_is_not_missed():
    """Out of the zoom view, or hidden in the wide one too."""
    x = (BASELINE + 2.0, 0.0, 10.0)  # 600 px beside the middle
    fusion, _ = followed(x, 1.0, 100, Nowhere(x))
    assert fusion.warnings(1, 99 * FRAME_S) == []
    seen_last = (BASELINE + 0.05, 0.0, 10.0)
    fusion, _ = followed(seen_last, 1.0, 5, Nowhere(seen_last))
    for i in range(5, 60):
        t = i * FRAME_S
        fusion.update_fixed(Frame(PICTURE, t), [track(1, box_at(*seen_last), t, missed=i)], None)
        fusion.states.add(PanTiltState(0.0, 0.0, False, t), ZoomState(ZOOMED, False, t))
        fusion.update_zoom(Frame(PICTURE, t), t)
    assert fusion.warnings(1, t) == []


class Nowhere(Finder):
    def find(self, frame, expected):
        return None


class Compared(CloseupFinder):
    """Finds the point in each zoom frame of whose time the wide view has shown it, or at which it is looked for."""

    def find(self, frame, expected):
        self.asked = [*getattr(self, "asked", []), frame.t]
        return ZoomMeasurement(np.array(CENTER), 1.0, np.ones(2), 1.0, 1.0, np.ones(2), frame.t)


def apart(by, frames=60):
    """Views of which the zoom camera's newest frame is newer by so much [s] than the wide one's; the finds."""
    x = (BASELINE, 0.0, 10.0)
    fusion = TargetFusion(CALIBRATION, BOOK, SIZE)
    fusion.follow(1)
    fusion.search.finder = Compared(CALIBRATION, BOOK)
    found = []
    for i in range(frames):
        t = 1.0 + i * FRAME_S
        fusion.update_fixed(Frame(PICTURE, t), [track(1, box_at(*x), t)], None)
        for when in (t, t + by):
            fusion.states.add(PanTiltState(0.0, 0.0, False, when), ZoomState(ZOOMED, False, when))
        found.append(fusion.update_zoom(Frame(PICTURE, t + by), t))
        if found[-1] is not None:
            assert abs(found[-1].t - t) <= max(MatchingSettings.longest_apart_s, -by) + 1e-9
            assert fusion.estimate(1, t).measured_t == pytest.approx(max(t, found[-1].t) if found[-1].t <= t else t)
    return found, fusion.warnings(1, t)


@pytest.mark.parametrize("by", [0.08, 0.13, 0.29, 0.49, -0.13, -0.29, -0.49])
def test_views_of_other_latencies_are_compared(by):
    found, warnings = apart(by)
    assert all(each is not None for each in found[15:])
    assert np.diff([each.t for each in found[15:]]) == pytest.approx(FRAME_S)
    assert warnings == []


@pytest.mark.parametrize(("by", "later"), [(0.7, "fixed"), (-0.7, "zoom")])
def test_views_that_are_too_far_apart_in_time_are_told(by, later):
    warnings = apart(by)[1]
    assert warnings == [f"the cameras are too far apart in time: the {later} one comes 0.70 s later"]


def test_a_zoom_frame_without_a_wide_view_of_its_time_is_not_one_without_the_target():
    """The wide view shows the target now and then only; the calibration is not to blame."""
    x = (BASELINE, 0.0, 10.0)
    fusion = TargetFusion(CALIBRATION, BOOK, SIZE)
    fusion.follow(1)
    fusion.search.finder = Sparse(CALIBRATION, BOOK)
    for i in range(100):
        t = i * FRAME_S
        fusion.update_fixed(Frame(PICTURE, t), [track(1, box_at(*x), t, missed=i % 25)], None)
        fusion.states.add(PanTiltState(0.0, 0.0, False, t), ZoomState(ZOOMED, False, t))
        fusion.update_zoom(Frame(PICTURE, t), t)
    assert len(fusion.search.finder.asked) <= 4 * 2 * MatchingSettings.longest_apart_s / FRAME_S + 1
    assert len(fusion.search.waiting) <= MOST_WAITING
    assert fusion.warnings(1, t) == []


class Sparse(Compared):
    def find(self, frame, expected):
        super().find(frame, expected)
