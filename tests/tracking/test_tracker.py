"""The tracker on drawn detections whose motion is known in closed form, and the sizes and travel of a track."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from cotarget.config import DEFAULT_TARGETS
from cotarget.tracking.track import SizeHistory, TrackingSettings, Trail, tracking_settings
from cotarget.tracking.tracker import Tracker

RATE = 25.0
SIZE = (640, 480)
MOVING_BIRD = replace(DEFAULT_TARGETS["bird"], detector="motion")
NOISE_PX = 0.4
PLAIN = TrackingSettings(noise_px=NOISE_PX, noise_of_size=0.0)
BOOK = tracking_settings(DEFAULT_TARGETS["book"])
# The filter's own steady state for white acceleration q and noise R every dt: the variance of the velocity is
# sqrt(2) q^(3/4) (R dt)^(1/4), here (18 px/s)^2; half of it is noise where the target does not accelerate.
SPEED_TOLERANCE = 2 * 18.0 / 2**0.5


@dataclass(frozen=True)
class Seen:
    center_px: np.ndarray
    size_px: np.ndarray
    score: float = 1.0
    clipped: bool = False


def seen(u, v, w=20.0, h=20.0, score=1.0, clipped=False):
    return Seen(np.array([u, v], dtype=float), np.array([w, h], dtype=float), score, clipped)


def run(tracker, times, *paths, skip=()):
    """Feed straight paths (start, velocity); frames whose index is in ``skip`` see nothing."""
    tracks = []
    for i, t in enumerate(times):
        boxes = [] if i in skip else [seen(*(np.array(x) + np.array(v) * t)) for x, v in paths]
        tracks.append(tracker.update(boxes, t))
    return tracks


def flown(tracker, seconds=1.0, at=(100.0, 200.0), velocity=(200.0, 0.0)):
    """A target of 20 px that flew straight until now; its place then, and the time."""
    times = np.arange(0.0, seconds, 1 / RATE)
    run(tracker, times, (at, velocity))
    return np.array(at) + np.array(velocity) * times[-1], times[-1]


def numbers(tracks):
    """Numbers of all tracks of a run."""
    return {track.id for step in tracks for track in step}


def taken(tracks):
    """Number of the first track, and whether the last frame detected it."""
    return tracks[0].id, tracks[0].missed == 0


# The image filter


def test_velocity_and_prediction_under_noise_at_irregular_times():
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.02, 0.09, 60))
    start, velocity = np.array([50.0, 300.0]), np.array([180.0, -60.0])
    tracker = Tracker(PLAIN)
    for t in times:
        (track,) = tracker.update([seen(*(start + velocity * t + rng.normal(0, NOISE_PX, 2)))], t)
    assert track.confirmed
    assert np.abs(track.velocity_px - velocity).max() < SPEED_TOLERANCE
    later = times[-1] + 0.1
    expected = track.center_px + 0.1 * track.velocity_px
    assert np.linalg.norm(expected - (start + velocity * later)) < 0.1 * SPEED_TOLERANCE + 4 * NOISE_PX


def test_covariance_is_honest():
    """The squared error in units of the covariance averages 4 where acceleration and noise are as stated."""
    rng = np.random.default_rng(1)
    q, dt = PLAIN.process_noise, 1 / RATE
    spread = np.linalg.cholesky(q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]))
    squared = []
    for _ in range(40):
        tracker, x, v = Tracker(PLAIN), np.array([300.0, 200.0]), rng.normal(0, 60.0, 2)
        for i in range(40):
            kick = spread @ rng.normal(size=(2, 2))
            x, v = x + v * dt + kick[0], v + kick[1]
            (track,) = tracker.update([seen(*(x + rng.normal(0, NOISE_PX, 2)))], i * dt)
        error = np.concatenate([track.center_px - x, track.velocity_px - v])
        squared.append(error @ np.linalg.solve(track.covariance, error))
    # The mean of 40 chi-squares with 4 degrees of freedom has a standard deviation of 0.45.
    assert 4 - 3 * 0.45 < np.mean(squared) < 4 + 3 * 0.45


def test_box_cut_by_the_border_does_not_shrink_the_target():
    """A 40 px wide target enters at the left at 100 px/s: while cut, only its visible part is boxed."""
    tracker = Tracker(PLAIN, SIZE)
    for i in range(1, 40):
        right = 100.0 * i / RATE
        left = max(0.0, right - 40.0)
        (track,) = tracker.update([seen((left + right) / 2, 100, right - left, 40, clipped=left == 0)], i / RATE)
        if right > 60:
            assert track.size_px[0] == pytest.approx(40)
    assert track.velocity_px[0] == pytest.approx(100, abs=SPEED_TOLERANCE)


@pytest.mark.parametrize("speed", [200.0, 700.0])
def test_a_large_target_that_comes_into_view_is_tracked_to_its_centre_as_soon_as_it_is_whole(speed):
    """A car of 240 x 150 px at the left border, whose box is cut at first, so that its centre moves half as fast."""
    rng, tracker, off = np.random.default_rng(3), Tracker(image_size=(640, 480)), []
    for i in range(75):
        center, noise = 10 + speed * i / 30 - 120, rng.normal(0, 2, 4)
        if center > 480:
            break
        left, right = max(center - 120 + noise[0], -0.5), center + 120 + noise[1]
        box = seen((left + right) / 2, 200 + noise[2], right - left, 150 + noise[3], clipped=left < 0)
        tracks = tracker.update([box], i / 30)
        if left > 0:
            off.append(tracks[0].center_px - (center, 200.0))
    assert {track.id for track in tracks} == {1}
    assert len(off) >= 10
    assert np.abs(off).max() < 12


def test_a_target_that_was_never_whole_is_as_uncertain_as_its_last_box():
    """Whose hidden part may be as large as the other: half its side, one standard deviation."""
    tracker = Tracker(PLAIN, SIZE)
    for i in range(5):
        (track,) = tracker.update([seen(10 + i, 100, 20 + 2 * i, 40, clipped=True)], i / RATE)
    assert np.sqrt(track.covariance[[0, 1], [0, 1]]) == pytest.approx([14, 20], rel=0.01)


@pytest.mark.parametrize("twigs", [1, 2])
def test_piece_of_a_target_does_not_bend_its_way(twigs):
    """In front of a tree only a wing's tip is seen: it shows that the target is there, and not where its centre is."""
    tracker = Tracker(PLAIN)
    place, t = flown(tracker)
    for i in range(1, twigs + 1):
        middle = place + np.array([200.0, 0.0]) * i / RATE
        (track,) = tracker.update([seen(*(middle + np.array([0.0, -8.0])), 5, 4)], t + i / RATE)
    assert track.missed == 0
    assert abs(track.velocity_px[1]) < SPEED_TOLERANCE
    assert abs(track.center_px[1] - 200) < 4


def test_sizes():
    """Wings beat at 4 Hz between 10 and 30 px: the wingspan is the larger side at its largest."""
    tracker = Tracker(PLAIN)
    for i in range(50):
        t = i / RATE
        height = 20 + 10 * np.sin(2 * np.pi * 4 * t)
        (track,) = tracker.update([seen(100 + 50 * t, 100, 16, height)], t)
    assert track.larger_side_px == pytest.approx(30, abs=1.5)  # the largest of ten samples does not count
    assert track.size_px.tolist() == [16, pytest.approx(20, abs=4.0)]


def test_a_whole_flyer_is_as_large_as_its_rotor_showed_it_in_the_last_beat_and_follows_its_growth():
    """The rotor is seen in every third frame, while the aircraft comes nearer, by a half each second."""
    tracker = Tracker(tracking_settings(MOVING_BIRD), SIZE)
    for i in range(40):
        side = 60 * 1.5 ** (i / RATE)
        (track,) = tracker.update([seen(100 + 3 * i, 200, side if i % 3 == 0 else side / 2, side / 2)], i / RATE)
    np.testing.assert_allclose(track.whole_px, (side, side / 2), rtol=0.1)
    assert track.size_px[0] < 0.6 * side
    walker = Tracker(tracking_settings(DEFAULT_TARGETS["person"]), SIZE)
    for i in range(40):
        (track,) = walker.update([seen(100 + i, 200, 40 if i % 3 == 0 else 20, 60)], i / RATE)
    assert track.whole_px.tolist() == track.size_px.tolist()


def test_one_wrong_box_hardly_changes_the_size():
    tracker = Tracker(PLAIN)
    for i in range(30):
        (track,) = tracker.update([seen(100 + i, 100, *((60, 60) if i == 25 else (20, 30)))], i / RATE)
    np.testing.assert_allclose(track.size_px, (20, 30))
    assert track.larger_side_px == pytest.approx(30, abs=3)


# Life of a track


@pytest.mark.parametrize("gap", [1, 5, 15])
def test_gap_keeps_the_number(gap):
    tracks = run(Tracker(PLAIN, SIZE), np.arange(60) / RATE, ((50, 100), (100, 40)), skip=range(25, 25 + gap))
    assert numbers(tracks) == {1}
    assert [tracks[25 + i][0].missed for i in (gap - 1, gap)] == [gap, 0]
    assert tracks[25 + gap - 1][0].seen_t == 24 / RATE


def test_track_ends_after_its_time_and_its_number_is_not_used_again():
    lost = range(20, 20 + int(PLAIN.lose_s * RATE) + 2)
    tracks = run(Tracker(PLAIN), np.arange(80) / RATE, ((50, 100), (100, 40)), skip=lost)
    assert tracks[lost[-1]] == []
    assert [t.id for t in tracks[-1]] == [2]


def hidden(sigma_px, hidden_s, comes_out_at, seen_s=3.0):
    """The last frame's tracks after a target at (300, 200) was hidden, and expected there with a deviation."""
    tracker, times = Tracker(PLAIN, SIZE), np.arange(0.0, seen_s, 1 / RATE)
    run(tracker, times, ((300, 200), (0, 0)))
    expected = {1: (np.array([300.0, 200.0, 0.0, 0.0]), np.diag([sigma_px**2] * 2 + [1.0] * 2))}
    count = round(hidden_s * RATE)
    for i in range(1, count):
        tracks = tracker.update([], times[-1] + i / RATE, expected=expected)
        assert [track.hidden for track in tracks] == [i / RATE > PLAIN.lose_s]
    return tracker.update([seen(*comes_out_at)], times[-1] + count / RATE, expected=expected)


def test_a_hidden_target_that_comes_out_where_it_is_expected_keeps_its_number():
    (track,) = hidden(30.0, 2.0, (330, 215))
    assert (track.id, track.confirmed, track.missed, track.hidden) == (1, True, 0, False)
    assert np.abs(track.center_px - (330, 215)).max() < NOISE_PX
    tracks = hidden(30.0, 2.0, (430, 200))  # more than three deviations off: something else
    assert [(track.id, track.confirmed, track.hidden) for track in tracks] == [(1, True, True), (2, False, False)]


def test_what_travels_with_a_poor_score_is_confirmed_and_not_sure():
    tracker = Tracker(tracking_settings(replace(MOVING_BIRD, detector="auto")), SIZE)
    for t in np.arange(0.0, 2.0, 1 / RATE):
        found = tracker.update([seen(100 + 60 * t, 100, score=0.4), seen(100 + 60 * t, 300, score=0.8)], t)
    assert [(track.confirmed, track.sure) for track in found] == [(True, False), (True, True)]


def test_a_target_that_comes_out_piece_by_piece_has_the_number_and_size_of_before():
    """40 px wide, at 60 px/s behind 180 px: its boxes shrink to 4 px, and after 2.5 s they grow from there."""
    tracker, found = Tracker(replace(PLAIN, noise_of_size=0.04), SIZE), []
    for t in np.arange(0.0, 7.0, 1 / RATE):
        u = 120.0 + 60.0 * t
        left, right = (u - 20, min(u + 20, 300.0)) if u < 390 else (max(u - 20, 480.0), u + 20)
        boxes = [seen((left + right) / 2, 200, right - left, 100)] if right - left >= 4 else []
        expected = {1: (np.array([u + 10, 200.0, 60.0, 0.0]), np.diag([25.0**2] * 2 + [9.0] * 2))}
        found.append(tracker.update(boxes, t, expected=expected))
    assert all(step[0].id == 1 and step[0].confirmed for step in found[round(RATE) :])
    assert [track.id for track in found[-1]] == [1]
    sliver = next(step[0] for step in found[round(5 * RATE) :] if not step[0].missed)
    assert sliver.box.size_px[0] < 10
    assert sliver.size_px[0] > 0.7 * 40  # smaller boxes are pieces
    np.testing.assert_allclose(found[-1][0].size_px, (40, 100), atol=0.5)


@pytest.mark.parametrize(
    ("settings", "sigma_px", "alive"),
    [(PLAIN, 150.0, True), (PLAIN, 165.0, False), (BOOK, 475.0, True), (BOOK, 520.0, False)],
)
def test_a_hidden_target_is_kept_while_it_is_likelier_to_come_out_than_something_new(settings, sigma_px, alive):
    """One likely place of 2 pi sigma^2 against two new objects a second in 640x480: 156 px after 1 s.

    Of a template there are a tenth as many: 494 px.
    """
    tracker, times = Tracker(settings, SIZE), np.arange(0.0, 3.0, 1 / RATE)
    run(tracker, times, ((300, 200), (0, 0)))
    expected = {1: (np.array([300.0, 200.0, 0.0, 0.0]), np.diag([sigma_px**2] * 2 + [1.0] * 2))}
    for i in range(1, round(RATE) + 1):
        tracks = tracker.update([], times[-1] + i / RATE, expected=expected)
    assert bool(tracks) is alive


def test_a_target_is_not_expected_for_longer_than_it_was_seen_nor_by_another_one():
    with pytest.raises(AssertionError):
        hidden(5.0, 2.0, (300, 200), seen_s=1.2)
    tracker = Tracker(PLAIN, SIZE)
    run(tracker, np.arange(0.0, 3.0, 1 / RATE), ((300, 200), (0, 0)))
    assert tracker.update([], 2.96 + PLAIN.lose_s + 1 / RATE, expected={7: (np.zeros(4), np.eye(4))}) == []


@pytest.mark.parametrize(("side", "most"), [(4.0, 2), (20.0, 8)])
def test_a_prediction_is_reported_while_it_is_known_to_within_the_box(side, most):
    """A prediction's deviation is the square root of q t^3 / 3 at least: 2 px after 0.12 s, 10 px after 0.35 s."""
    tracker = Tracker(PLAIN, SIZE)
    for t in np.arange(30) / RATE:
        (track,) = tracker.update([seen(100 + 100 * t, 200, side, side)], t)
    assert track.reported
    reported = [tracker.update([], (30 + i) / RATE)[0].reported for i in range(18)]
    assert 0 < sum(reported) <= most
    assert reported == sorted(reported, reverse=True)
    (track,) = tracker.update([seen(100 + 100 * 48 / RATE, 200, side, side)], 48 / RATE)
    assert (track.id, track.reported) == (1, True)


def test_what_is_no_more_believed_prolongs_no_track():
    """A bird has gone behind a tree, and twigs move at its place: they are followed for a moment, as it may be."""
    tracker = Tracker(replace(PLAIN, start_score=0.05), SIZE)
    run(tracker, np.arange(30) / RATE, ((100, 200), (0, 0)))
    with_twigs = [tracker.update([seen(100, 200, score=0.03)], (30 + i) / RATE) for i in range(60)]
    alive_s = sum(map(bool, with_twigs)) / RATE
    assert alive_s == pytest.approx(PLAIN.lose_s, abs=2 / RATE)
    assert numbers(with_twigs) == {1}


@pytest.mark.parametrize("gap_s", [1.0, 2.0, 5.0, 60.0, 3600.0])
@pytest.mark.parametrize("frames", [1, 3, 50])
def test_what_appears_after_a_gap_between_frames_is_another_target(gap_s, frames):
    """Where the target may be has grown with the gap: any detection would match."""
    tracker = Tracker(PLAIN, SIZE)
    run(tracker, np.arange(frames) / RATE, ((100, 100), (10, 0)))
    before = {track.id for track in tracker.tracks}
    t = (frames - 1) / RATE + gap_s + (0.0 if frames > 1 else 1.0)  # after one frame the usual interval is unknown
    (track,) = tracker.update([seen(600, 100)], t)
    assert (before, track.id, track.confirmed) == ({1}, 2, False)


@pytest.mark.parametrize("rate_hz", [0.5, 1.0, 2.0, 7.0])
def test_slow_frames_are_no_gap(rate_hz):
    """The time between two of them is longer than a track lives without a detection."""
    tracks = run(Tracker(PLAIN, SIZE), np.arange(20) / rate_hz, ((100, 100), (10 * rate_hz, 0)))
    assert {len(step) for step in tracks} == {1}
    assert len(numbers(tracks[2:])) == 1
    assert tracks[-1][0].confirmed


def test_one_frame_that_comes_late_costs_no_target():
    times = np.arange(60) / RATE
    times[30:] += 0.7
    assert numbers(run(Tracker(PLAIN, SIZE), times, ((50, 100), (100, 40)))) == {1}


def test_track_that_leaves_the_image_ends():
    times = np.arange(40) / RATE
    tracks = run(Tracker(PLAIN, SIZE), times, ((500, 100), (180, 0)), skip=range(20, 40))
    gone = next(i for i, step in enumerate(tracks) if not step)
    assert times[gone] == pytest.approx((639.5 - 500) / 180, abs=2 / RATE)


def test_times_that_repeat_or_jump_back():
    tracker = Tracker(PLAIN)
    run(tracker, 100 + np.arange(20) / RATE, ((-9900, 100), (100, 0)))
    for t in (100 + 19 / RATE, 100.0):  # the same frame again, and a late one, are ignored
        assert [track.id for track in tracker.update([seen(500, 400)], t)] == [1]
    tracks = run(tracker, np.arange(20) / RATE, ((100, 100), (100, 0)))[-1]  # the clock starts anew
    assert [t.id for t in tracks] == [2]


def test_flash_is_never_confirmed():
    tracker = Tracker(PLAIN)
    assert not any(t.confirmed for i in range(3) for t in tracker.update([seen(100, 100)], i / RATE))
    assert tracker.update([], 1.0) == []


def test_what_trembles_on_the_spot_is_not_confirmed_by_its_motion():
    rng = np.random.default_rng(2)
    tracker = Tracker(tracking_settings(replace(MOVING_BIRD, detector="mog2")), SIZE)
    for i in range(100):
        tracks = tracker.update([seen(*(np.array([200, 200]) + rng.uniform(-2, 2, 2)), 12, 12)], i / RATE)
    assert not any(t.confirmed for t in tracks)


@pytest.mark.parametrize(("speed", "size", "confirmed"), [(5.0, 50.0, False), (75.0, 90.0, True)])
def test_cloud_that_drifts_is_never_confirmed_and_a_walker_soon(speed, size, confirmed):
    """Both have an outline that flickers by a tenth."""
    rng = np.random.default_rng(0)
    tracker, end = Tracker(replace(PLAIN, confirm_travel=0.5, noise_of_size=0.04)), 1.0 if confirmed else 20.0
    for t in np.arange(0.0, end, 1 / RATE):
        low, high = (np.array([100 + speed * t, 100]) + side + 0.1 * size * rng.uniform(-1, 1, 2) for side in (0, size))
        tracks = tracker.update([Seen((low + high) / 2, high - low)], t)
    assert any(track.confirmed for track in tracks) == confirmed


# Association


def test_two_targets_that_cross_keep_their_numbers():
    tracks = run(Tracker(PLAIN), np.arange(75) / RATE, ((50, 100), (120, 60)), ((50, 280), (120, -60)))
    first, last = ({t.id: np.sign(t.velocity_px[1]) for t in tracks[i] if t.confirmed} for i in (20, -1))
    assert set(first) == {1, 2}
    assert first == last


def test_two_targets_merged_into_one_box_both_live_on():
    tracker = Tracker(PLAIN)
    for i in range(90):
        t = i / RATE
        a, b = np.array([60 + 60 * t, 200.0]), np.array([276 - 60 * t, 200.0])
        boxes = [seen(*a, 20, 60), seen(*b, 20, 60)]
        if abs(a[0] - b[0]) < 22:
            boxes = [seen(*((a + b) / 2), abs(a[0] - b[0]) + 20, 60)]
        tracks = tracker.update(boxes, t)
    assert [t.id for t in tracks if t.confirmed] == [1, 2]
    assert [np.sign(t.velocity_px[0]) for t in tracks] == [1, -1]


@pytest.mark.parametrize("speed", [0.0, -60.0], ids=["hovers", "flies past"])
def test_a_bird_before_a_cloud_is_no_part_of_it(speed):
    tracker, times = Tracker(PLAIN, SIZE), np.arange(100) / RATE
    for t in times:
        tracks = tracker.update([seen(400 + speed * t, 200, 12, 6), seen(200 + 60 * t, 200, 150, 80)], t)
        assert not t or [track.size_px[0] for track in tracks] == [12.0, 150.0]
    assert [track.id for track in tracks] == [1, 2]


@pytest.mark.parametrize("faster", [15.0, 45.0])
@pytest.mark.parametrize("hidden", [False, True])
def test_a_person_who_overtakes_one_farther_away_does_not_take_the_track(faster, hidden):
    """Both go the same way, and the farther one may be hidden behind the other."""
    tracker = Tracker(PLAIN, SIZE)
    for i in range(200):
        far, near = 200 + 30 * i / RATE, 140 + (30 + faster) * i / RATE
        boxes = [seen(near, 250, 60, 150)]
        if not hidden or abs(far - near) > 42:
            boxes.append(seen(far, 240, 24, 60))
        tracks = tracker.update(boxes, i / RATE)
        if not hidden:
            assert sorted(track.size_px[0] for track in tracks) == [24, 60]
        if i == 20:
            first = next(track.id for track in tracks if track.size_px[0] == 60)
    assert first in [track.id for track in tracks if track.size_px[0] == 60]


def test_a_camera_that_turns_does_not_make_a_bird_part_of_the_cloud_behind_it():
    """The cloud drifts behind the bird and stops; then the camera turns, and both move alike in the image."""
    tracker = Tracker(PLAIN, SIZE)
    for i in range(75):
        shift = np.array([-4.0 * max(0, i - 25), 0.0])
        bird, cloud = seen(450 + shift[0], 200, 12, 6), seen(300 + 4 * min(i, 25) + shift[0], 200, 150, 80)
        tracks = tracker.update([bird, cloud], i / RATE, shift)
    assert [track.size_px[0] for track in tracks] == [12.0, 150.0]


@pytest.mark.parametrize("found", [True, False], ids=["parts found", "parts hidden"])
def test_a_car_whose_parts_were_followed_first_is_followed_as_soon_as_it_is_seen_as_a_whole(found):
    """As after a change of light, which hides all but bumper and window; a box that replaces them is their merger."""
    tracker = Tracker(PLAIN, SIZE)
    for i in range(40):
        parts = [seen(200 + 4 * i, 300, 8, 30), seen(380 + 4 * i, 300, 8, 30)]
        whole = [seen(290 + 4 * i, 310, 300, 110)]
        tracks = tracker.update(parts if i < 25 else [*parts, *whole] if found else whole, i / RATE)
    assert [track.size_px[0] for track in tracks if track.confirmed] == ([8, 8, 300] if found else [8, 8])


def test_a_box_around_two_birds_for_a_while_does_not_end_their_tracks():
    tracker = Tracker(PLAIN, SIZE)
    for i in range(90):
        birds = [seen(100 + 3 * i, 200, 10, 10), seen(130 + 3 * i, 200, 10, 10)]
        around = [seen(115 + 3 * i, 200, 42, 14)] if 10 < i < 45 else []
        tracks = tracker.update([*birds, *around], i / RATE)
        assert i < 4 or [track.id for track in tracks if track.confirmed][:2] == [1, 2]
    assert [track.id for track in tracks] == [1, 2]


def test_a_drone_that_is_seen_in_two_pieces_for_a_while_is_one_track():
    """As V_DRONE_067 of the Drone-detection-dataset, whose body is as bright as the sky between its arms."""
    tracker = Tracker(tracking_settings(MOVING_BIRD), SIZE)
    for i in range(80):
        u, v = 100 + 3 * i, 200 + i
        pieces = [seen(u - 5.5, v - 2, 5, 8), seen(u + 4, v + 2, 8, 6)]
        tracks = tracker.update(pieces if i % 40 >= 25 else [seen(u, v, 16, 12)], i / RATE)
    assert [track.id for track in tracks] == [1]


def test_a_person_whose_hand_alone_was_whole_when_he_came_into_view_is_one_track():
    """Then the border cut the boxes of his arm and of himself."""
    tracker = Tracker(PLAIN, SIZE)
    for i in range(60):
        front = 630 - 4 * i
        right = min(front + 60, 639.5)
        height = next((height for until, height in ((6, 24), (9, 80)) if i < until), 150)
        whole = seen((front + right) / 2, 300, right - front, height, clipped=front + 60 > 639.5)
        tracks = tracker.update([seen(front + 6, 300, 12, 11) if i < 3 else whole], i / RATE)
    (track,) = tracks
    assert track.id == 1
    assert track.size_px == pytest.approx([60, 150])
    assert track.center_px == pytest.approx(whole.center_px, abs=3)


def test_what_comes_into_view_slowly_is_confirmed_by_the_travel_since_more_than_a_tip_was_seen():
    """Its tip was whole, and the rear edge of the tip was not the target's."""
    tracker, first = Tracker(tracking_settings(replace(MOVING_BIRD, detector="auto")), SIZE), None
    for i in range(70):
        front = 630 - i
        right = min(front + 40, 639.5)
        cut = front + 40 > 639.5
        box = seen((front + right) / 2, 300, right - front, 8 if i < 10 else 30, 0.1 if cut else 0.3, clipped=cut)
        tracks = tracker.update([seen(front + 2, 300, 3, 6, 0.1) if i < 8 else box], i / RATE)
        first = i if first is None and any(track.confirmed for track in tracks) else first
    assert first is not None
    assert first < 45  # the window of the travel has the tip until 58


def test_a_box_that_is_far_larger_is_not_a_whole_target():
    """A bird is missed before a cloud, and goes on behind it."""
    tracker = Tracker(tracking_settings(MOVING_BIRD), SIZE)
    for i in range(75):
        bird, cloud = seen(100 + 5 * i, 200, 14, 16), seen(240, 190, 70, 90)
        tracks = tracker.update([bird] if i < 25 else [cloud] if i < 38 else [bird, cloud], i / RATE)
        assert tracks[0].id == 1
        assert tracks[0].size_px == pytest.approx([14, 16])
    assert tracks[0].missed == 0
    assert tracks[0].center_px == pytest.approx(bird.center_px, abs=3)


@pytest.mark.parametrize(("side", "left"), [(12, [(2, False)]), (40, [(1, True), (2, True)])], ids=["hand", "child"])
def test_what_is_far_smaller_than_the_box_around_it_is_not_found_by_it(side, left):
    """It was followed for a second before the larger target came, so that it did not come into view with it."""
    tracker = Tracker(PLAIN, SIZE)
    for i in range(90):
        small, large = seen(300, 200, side, side), seen(max(300, 500 - 8 * max(0, i - 25)), 200, 60, 150)
        tracks = tracker.update([small] if i < 25 else [small, large] if i < 45 else [large], i / RATE)
        assert i < 30 or i > 50 or [track.id for track in tracks] == [1, 2]
    assert [(track.id, track.shared) for track in tracks] == left


def test_shared_detection_is_marked_as_such():
    tracker = Tracker(PLAIN)
    for i in range(20):
        tracks = tracker.update([seen(100 + i, 200), seen(170 - i, 200)], i / RATE)
        assert [track.shared for track in tracks] == [False, False]
    both = seen(135, 200, 50, 20, score=0.7)
    for track in tracker.update([both], 20 / RATE):
        assert (track.missed, track.shared, track.score) == (0, True, 0.7)
        assert track.box is both
        assert 134 - 15 <= track.center_px[0] <= 136 + 15  # it has the room that 20 px have in 50
    assert all(track.shared for track in tracker.update([], 21 / RATE))  # the last detection was
    tracks = tracker.update([seen(122, 200), seen(148, 200)], 22 / RATE)
    assert [track.shared for track in tracks] == [False, False]


def test_of_boxes_on_each_other_one_track_is_born():
    found = [seen(100, 100), seen(102, 101, 24, 24), seen(110, 100), seen(200, 100), seen(203, 100)]
    tracks = Tracker(PLAIN).update(found, 0.0)
    assert [tuple(track.center_px) for track in tracks] == [(100, 100), (110, 100), (200, 100)]


def flashes(rng, n=1000):
    """Detections all over the lower part of the image."""
    return [Seen(rng.uniform((0, 280), SIZE), np.array([6.0, 6.0]), rng.uniform(0.6, 0.9)) for _ in range(n)]


def test_targets_are_kept_among_a_thousand_flashes():
    """Targets of a low score, at the end of the list, each where it is expected, or two in one box."""
    rng = np.random.default_rng(3)
    tracker = Tracker(PLAIN, SIZE)

    def targets(t):
        pair = [seen(300, 220, 40, 20)] if 1.0 < t < 1.2 else [seen(290, 220), seen(310, 220)]
        return [replace(each, score=0.5) for each in (seen(50 + 100 * t, 100), *pair)]

    for i in range(20):
        tracker.update(targets(i / RATE), i / RATE)
    assert [track.confirmed for track in tracker.tracks] == [True] * 3
    for i in range(20, 40):
        t = i / RATE
        tracks = tracker.update([*flashes(rng), *targets(t)], t)
        # Two may share a box.
        assert len([track for track in tracks if track.missed == 0]) <= TrackingSettings.most_detections + 3
        known = [track for track in tracks if track.id <= 3]
        assert [(track.id, track.missed) for track in known] == [(1, 0), (2, 0), (3, 0)]
        assert np.linalg.norm(known[0].center_px - (50 + 100 * t, 100)) < 5


def test_where_no_track_is_confirmed_the_best_detections_are_used():
    found = sorted(flashes(np.random.default_rng(4)), key=lambda each: -each.score)
    tracks = Tracker(PLAIN, SIZE).update(found, 0.0)
    assert min(track.score for track in tracks) >= found[TrackingSettings.most_detections - 1].score


@pytest.mark.parametrize(("size", "is_target"), [(20, True), (3, False)])
def test_after_a_gap_what_looks_like_the_target_is_taken_for_it(size, is_target):
    """A gap leaves much room: for the target, and not for a twig."""
    tracker = Tracker(PLAIN)
    place, t = flown(tracker)
    for i in range(1, 8):
        tracker.update([], t + i / RATE)
    aside = place + np.array([200.0 * 8 / RATE, 30.0])
    assert taken(tracker.update([seen(*aside, size, size)], t + 8 / RATE)) == (1, is_target)


def test_old_track_takes_its_target_over_from_a_new_one():
    """The target turned aside and was beyond the gate at first, so that a new track was begun."""
    tracker = Tracker(PLAIN)
    place, t = flown(tracker)
    for i in range(1, 20):
        place = place + np.array([200.0, 15.0]) / RATE + (np.array([0.0, 12.0]) if i == 1 else 0)
        tracks = tracker.update([seen(*place)], t + i / RATE)
    assert [(track.id, track.missed) for track in tracks if track.confirmed] == [(1, 0)]


@pytest.mark.parametrize(("off_px", "same"), [(30, True), (50, True), (110, False), (150, False)])
def test_track_of_a_target_that_vanishes_does_not_jump_to_another(off_px, same):
    """Two pass. 0.7 s later the filter knows the place of one to 35 px, and four times that are in its gate."""
    tracker, ids = Tracker(tracking_settings(DEFAULT_TARGETS["person"]), SIZE), {}
    for i in range(80):
        t = i / RATE
        stays, goes = seen(440 - 60 * t, 300, 30, 80), seen(200 + 60 * t, 200, 30, 80)
        comes = seen(*(goes.center_px - (0, off_px)), 30, 80)
        there = {"stays": stays} | ({"goes": goes} if t <= 2 else {"comes": comes} if t > 2.65 else {})
        tracks = tracker.update(list(there.values()), t)
        ids |= {name: track.id for name, box in there.items() for track in tracks if track.box is box}
    assert ids["stays"] not in (ids["goes"], ids["comes"])
    assert (ids["comes"] == ids["goes"]) == same


@pytest.mark.parametrize(("size", "is_target"), [((50, 70), False), ((8, 6), True)])
def test_box_cut_by_the_border_is_at_least_as_large_as_it_looks(size, is_target):
    """A post that rises from the lower border is no bird; a part of a bird may be one."""
    tracker = Tracker(tracking_settings(MOVING_BIRD))
    for i in range(50):
        tracker.update([seen(300 + i, 450, 9, 7)] if i < 40 else [], i / RATE)
    cut = seen(380, 479.5 - size[1] / 2, *size, clipped=True)
    assert taken(tracker.update([cut], 2.0)) == (1, is_target)


def test_target_that_enters_at_a_corner_is_one_although_the_next_box_is_far_larger():
    tracker = Tracker(tracking_settings(DEFAULT_TARGETS["person"]), SIZE)
    for i, (width, height) in enumerate([(3, 10), (38, 60), (40, 62), (40, 64)]):
        tracks = tracker.update([seen(width / 2, height / 2, width, height, clipped=True)], i / RATE)
        assert [(track.id, track.missed) for track in tracks] == [(1, 0)]


@pytest.mark.parametrize("gap_s", [0.3, 0.5, 0.7])
@pytest.mark.parametrize("turn", [-0.9, 0.9])
def test_bird_that_turns_behind_foliage_is_found_again(gap_s, turn):
    """At 25 m it flies at 10 m/s, 280 px/s, and turns by 0.9 rad/s, with 9 m/s^2: new objects are not that near."""
    tracker = Tracker(tracking_settings(MOVING_BIRD), SIZE)
    rng = np.random.default_rng(5)
    place, heading = np.array([120.0, 240.0]), 0.0
    for i in range(int((1.2 + gap_s) * RATE)):
        heading += turn / RATE * (i > 0.9 * RATE)
        place = place + 280 / RATE * np.array([np.cos(heading), np.sin(heading)])
        hidden = 0 < i / RATE - 0.9 <= gap_s
        tracks = tracker.update([] if hidden else [seen(*(place + rng.normal(0, 1.5, 2)), 17, 9)], i / RATE)
    assert [(track.id, track.missed) for track in tracks if track.confirmed] == [(1, 0)]


@pytest.mark.parametrize("name", [None, *DEFAULT_TARGETS])
def test_other_targets_far_away_change_nothing(name):
    """A lone target among random boxes, and the same with another one that stands in a corner."""
    rng = np.random.default_rng(5)
    settings = PLAIN if name is None else tracking_settings(DEFAULT_TARGETS[name])
    alone, beside = Tracker(settings, SIZE), Tracker(settings, SIZE)
    for i in range(40):
        place = np.array([100 + 6 * i, 200]) + rng.normal(0, 4, 2) * rng.choice([1, 4], p=[0.7, 0.3])
        box = Seen(place, rng.uniform(8, 30, 2), rng.uniform(0.005, 1.0), bool(rng.random() < 0.1))
        found = [] if rng.random() < 0.2 else [box]
        one, two = alone.update(found, i / RATE), beside.update([*found, seen(620, 460)], i / RATE)
        states = [[(track.missed, *track.center_px) for track in tracks if track.center_px[1] < 400]
                  for tracks in (one, two)]  # fmt: skip
        assert sorted(states[0]) == sorted(states[1])


# A camera that moves


def test_tracks_move_with_the_scene():
    """The camera turns by 4 px a frame and loses the target for 0.6 s: it is found again where it now is."""
    tracker, times, turn = Tracker(PLAIN, SIZE), np.arange(40) / RATE, np.array([4.0, -1.0])
    for i, t in enumerate(times):
        shift = np.maximum(i - 24, 0) * turn
        at = np.array([200.0, 300.0]) + shift
        tracks = tracker.update([seen(*at)] if i <= 24 else [], t, shift)
    (track,) = tracks
    assert track.center_px == pytest.approx(at, abs=1e-6)
    assert track.velocity_px == pytest.approx([0.0, 0.0], abs=1e-6)  # relative to the scene
    (same,) = tracker.update([seen(*(at + turn))], times[-1] + 1 / RATE, shift + turn)
    assert (same.id, same.missed) == (track.id, 0)


def test_what_stands_has_not_travelled_when_the_camera_turns():
    moving = replace(PLAIN, confirm_travel=0.5)
    for follows in (True, False):
        tracker = Tracker(moving, SIZE)
        for i in range(40):
            shift = np.array([3.0 * i, 0.0])
            tracks = tracker.update([seen(*(np.array([100.0, 300.0]) + shift))], i / RATE, shift if follows else None)
        assert [track.confirmed for track in tracks] == [not follows]


@pytest.mark.parametrize(("cut", "found"), [(False, False), (True, False), (True, True)])
def test_after_a_cut_a_track_that_is_not_found_again_soon_ends(cut, found):
    tracker = Tracker(PLAIN, SIZE)
    place, _ = flown(tracker, velocity=(0.0, 0.0))
    for i in range(1, 11):
        tracks = tracker.update([seen(*place)] if found and i == 1 else [], 1.0 + i / RATE, cut=cut and i == 1)
    assert len(tracks) == (0 if cut and not found else 1)


DT = 0.04
IMAGE = (640, 480)


def filled(history, boxes, clipped=()):
    """A history of boxes (left, top, right, bottom), one a frame."""
    for i, (left, top, right, bottom) in enumerate(boxes):
        history.add(i * DT, ((left + right) / 2, (top + bottom) / 2), (right - left, bottom - top), i in clipped)
    return history


def travel(boxes, image_size=None, clipped=()):
    return filled(Trail(2.0, image_size), boxes, clipped).travel()


def moving(n, start, end):
    return np.linspace(start, end, n)


HERE = [0, 0, 30, 30]
BESIDE = [40, 0, 70, 30]


@pytest.mark.parametrize(("boxes", "way_px"), [
    # The medians of three boxes at either end lie one step inside: 28 of 30 steps.
    (moving(31, [10, 20, 40, 80], [40, 60, 70, 120]), 50 * 28 / 30),
    ([[0, 0, 8, 8]], 0.0),
    (moving(3, [0, 0, 8, 8], [6, 8, 14, 16]), 10.0),
    (moving(2, [0, 0, 8, 8], [6, 8, 14, 16]), 0.0),  # one step is a jump
    # It grows all around, or to one side, which moves its centre by 42 px.
    (moving(40, [100, 100, 120, 130], [60, 90, 160, 140]), 0.0),
    (moving(40, [100, 100, 120, 130], [100, 100, 180, 190]), 0.0),
    (moving(3, [0, 0, 30, 60], [20, 0, 60, 60]), 20.0),  # it grows while it moves: the slower edge counts
    ([HERE] * 20 + [BESIDE] * 20, 0.0),  # a jump
    (moving(40, HERE, BESIDE), 40 * 37 / 39),
    # 10 px/s over 10 s, of which the last two count, less one step at either end
    (moving(251, HERE, [100, 0, 130, 30]), 10 * (2.0 - 2 * DT)),
])  # fmt: skip
def test_travel_is_the_common_motion_of_both_edges(boxes, way_px):
    assert travel(boxes) == pytest.approx(way_px, rel=0.03)  # a box more or less


def test_target_that_enters_the_image_travels_by_the_edge_that_is_seen():
    boxes = [[-0.5, 10, right, 70] for right in moving(20, 5, 43)]
    assert travel(boxes, IMAGE, range(20)) == pytest.approx(36.0, abs=3)
    assert travel(boxes) == 0.0  # without the image's size the cut edge counts
    assert travel(boxes[::-1], IMAGE, range(20)) == 0.0  # it goes back: a cloud that a tilting camera covers
    flown_out = [[max(left, -0.5), 10, left + 38, 70] for left in moving(20, 20, -20)]
    assert travel(flown_out, IMAGE, range(10, 20)) == pytest.approx(36.0, abs=3)
    lower_edge_alone = [[-0.5, 10, 639.5, 10 + i] for i in range(20)]
    assert travel(lower_edge_alone, IMAGE, range(20)) == 0.0


def test_sizes_are_those_that_the_border_does_not_cut():
    boxes = [[-0.5, 0, 20, 60], [-0.5, 0, 25, 62], [5, 0, 35, 60], [6, 0, 38, 64]]
    np.testing.assert_allclose(filled(SizeHistory(0.5), boxes[:2], {0, 1}).size, [25.5, 62])
    whole = filled(SizeHistory(0.5), boxes, {0, 1})
    np.testing.assert_allclose(whole.size, [31, 62])
    assert whole.larger_side == pytest.approx(60 + 0.9 * 4)


def test_the_size_of_a_target_that_drives_away_follows_it():
    """A car becomes smaller by a third in 0.3 s; a person's stride or a bird's wings change one side, to and fro."""
    car = [[0, 0, 160 * 0.96**i, 120 * 0.96**i] for i in range(30)]
    size = np.array([160, 120]) * 0.96**29
    np.testing.assert_allclose(filled(SizeHistory(0.6, trend=True), car).size, size, rtol=0.1)
    assert filled(SizeHistory(0.6), car).size[0] > 1.3 * size[0]
    stride = [[0, 0, 40 + 15 * np.sin(2 * np.pi * 1.0 * i * DT), 120] for i in range(30)]
    assert filled(SizeHistory(0.6, trend=True), stride).size == pytest.approx(filled(SizeHistory(0.6), stride).size)


@pytest.mark.parametrize("beat_hz", [2.5, 4.0])
def test_the_larger_side_of_a_bird_that_flies_off_is_its_wingspan_of_the_last_beat(beat_hz):
    """It becomes smaller by a third in a second; between two beats its wings look half as wide."""
    spans = 60 * 0.985 ** np.arange(50)
    wings = [span * (0.75 + 0.25 * np.cos(2 * np.pi * beat_hz * i * DT)) for i, span in enumerate(spans)]
    history, errors = SizeHistory(0.6), []
    for i, (wing, span) in enumerate(zip(wings, spans, strict=True)):
        history.add(i * DT, (100.0, 100.0), (wing, 10.0), False)
        errors.append(history.larger_side / span - 1)
    assert np.mean(errors[15:]) == pytest.approx(0.0, abs=0.085)
    assert max(errors[15:]) < 0.145
