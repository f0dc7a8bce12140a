"""The tracker on drawn detections whose motion is known in closed form."""

from dataclasses import dataclass

import numpy as np
import pytest

from cotarget.config import DEFAULT_TARGETS
from cotarget.tracking import Tracker, TrackerSettings, settings_for, size_for

RATE = 25.0
SIZE = (640, 480)
NOISE_PX = 0.4  # what TrackerSettings tells the filter, with boxes whose own part is switched off below
PLAIN = TrackerSettings(noise_px=NOISE_PX, noise_of_size=0.0)
# The filter's own steady state for white acceleration q and noise R every dt: the variance of the velocity is
# sqrt(2) q^(3/4) (R dt)^(1/4), here (18 px/s)^2; half of it is noise where the target does not accelerate.
SPEED_TOLERANCE = 2 * 18.0 / 2**0.5


@dataclass(frozen=True)
class Seen:
    center_px: np.ndarray
    size_px: np.ndarray
    score: float = 1.0
    clipped: bool = False


def seen(u, v, w=20.0, h=20.0, clipped=False):
    return Seen(np.array([u, v], dtype=float), np.array([w, h], dtype=float), clipped=clipped)


def run(tracker, times, *paths, skip=()):
    """Feed straight paths (start, velocity); frames whose index is in ``skip`` see nothing."""
    tracks = []
    for i, t in enumerate(times):
        boxes = [] if i in skip else [seen(*(np.array(x) + np.array(v) * t)) for x, v in paths]
        tracks.append(tracker.update(boxes, t))
    return tracks


def test_velocity_and_prediction_under_noise_at_irregular_times():
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.02, 0.09, 60))
    start, velocity = np.array([50.0, 300.0]), np.array([180.0, -60.0])
    tracker = Tracker(PLAIN)
    for t in times:
        tracks = tracker.update([seen(*(start + velocity * t + rng.normal(0, NOISE_PX, 2)))], t)
    (track,) = tracks
    assert track.confirmed
    assert np.abs(track.velocity_px - velocity).max() < SPEED_TOLERANCE
    later = times[-1] + 0.1
    assert np.linalg.norm(track.predict(later) - (start + velocity * later)) < 0.1 * SPEED_TOLERANCE + 4 * NOISE_PX
    np.testing.assert_allclose(track.at(later).center_px, track.predict(later))
    assert np.linalg.eigvalsh(track.at(later).covariance - track.covariance).max() > 0
    assert np.linalg.eigvalsh(track.at(times[-1] - 0.1).covariance).min() > 0


def test_covariance_is_honest():
    """The squared error in units of the covariance averages 4 where acceleration and noise are as stated."""
    rng = np.random.default_rng(1)
    q, dt = PLAIN.acceleration_px**2 * PLAIN.manoeuvre_s, 1 / RATE
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


@pytest.mark.parametrize("gap", [1, 5, 15])
def test_a_gap_keeps_the_number(gap):
    times = np.arange(60) / RATE
    tracks = run(Tracker(PLAIN, SIZE), times, ((50, 100), (100, 40)), skip=range(25, 25 + gap))
    assert {t.id for step in tracks for t in step} == {1}
    assert tracks[25 + gap - 1][0].missed == gap
    assert tracks[25 + gap][0].missed == 0


def test_a_track_ends_after_its_time_and_its_number_is_not_used_again():
    times = np.arange(80) / RATE
    lost = range(20, 20 + int(PLAIN.lose_s * RATE) + 2)
    tracks = run(Tracker(PLAIN), times, ((50, 100), (100, 40)), skip=lost)
    assert tracks[lost[-1]] == []
    assert [t.id for t in tracks[-1]] == [2]


def test_two_targets_that_cross_keep_their_numbers():
    times = np.arange(75) / RATE
    tracks = run(Tracker(PLAIN), times, ((50, 100), (120, 60)), ((50, 280), (120, -60)))
    first, last = ({t.id: t.velocity_px[1] for t in tracks[i] if t.confirmed} for i in (20, -1))
    assert set(first) == set(last) == {1, 2}
    assert all(np.sign(first[n]) == np.sign(last[n]) for n in first)


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


def test_a_flash_is_never_confirmed():
    tracker = Tracker(PLAIN)
    assert not any(t.confirmed for i in range(3) for t in tracker.update([seen(100, 100)], i / RATE))
    assert tracker.update([], 1.0) == []


def test_what_trembles_on_the_spot_is_no_bird():
    rng = np.random.default_rng(2)
    tracker = Tracker(settings_for(DEFAULT_TARGETS["bird"]))
    for i in range(100):
        tracks = tracker.update([seen(*(np.array([200, 200]) + rng.uniform(-2, 2, 2)), 12, 12)], i / RATE)
    assert not any(t.confirmed for t in tracks)


def test_a_box_cut_by_the_border_does_not_shrink_the_target():
    """A 40 px wide target enters at the left at 100 px/s: while cut, only its visible part is boxed."""
    tracker = Tracker(PLAIN, SIZE)
    for i in range(1, 40):
        right = 100.0 * i / RATE
        left = max(0.0, right - 40.0)
        (track,) = tracker.update([seen((left + right) / 2, 100, right - left, 40, clipped=left == 0)], i / RATE)
        if right > 60:
            assert track.size_px[0] == pytest.approx(40)
    assert track.velocity_px[0] == pytest.approx(100, abs=SPEED_TOLERANCE)


def test_a_track_that_leaves_the_image_ends():
    times = np.arange(40) / RATE
    tracks = run(Tracker(PLAIN, SIZE), times, ((500, 100), (180, 0)), skip=range(20, 40))
    assert len(tracks[19]) == 1
    assert tracks[-1] == []
    gone = next(i for i, step in enumerate(tracks) if i > 19 and not step)
    assert times[gone] == pytest.approx((639.5 - 500) / 180, abs=2 / RATE)


def test_sizes():
    """Wings beat at 4 Hz between 10 and 30 px: the wingspan is the larger side at its largest."""
    tracker = Tracker(PLAIN)
    for i in range(50):
        t = i / RATE
        height = 20 + 10 * np.sin(2 * np.pi * 4 * t)
        (track,) = tracker.update([seen(100 + 50 * t, 100, 16, height)], t)
    assert size_for(track, "wingspan") == pytest.approx(30, abs=1.0)  # the 6 samples a beat miss the peak by 5 %
    assert size_for(track, "width") == 16
    assert size_for(track, "height") == pytest.approx(20, abs=4.0)


def test_one_wrong_box_hardly_changes_the_size():
    tracker = Tracker(PLAIN)
    for i in range(30):
        (track,) = tracker.update([seen(100 + i, 100, *((60, 60) if i == 25 else (20, 30)))], i / RATE)
    np.testing.assert_allclose(track.size_px, (20, 30))
    assert track.larger_side_px == pytest.approx(30, abs=3)


def test_times_that_repeat_or_jump_back():
    tracker = Tracker(PLAIN)
    run(tracker, 100 + np.arange(20) / RATE, ((-9900, 100), (100, 0)))
    before = tracker.tracks
    assert tracker.update([seen(500, 400)], 100 + 19 / RATE)[0].id == before[0].id  # the same frame again: ignored
    assert len(tracker.update([seen(500, 400)], 100.0)) == 1  # a late one: ignored
    tracks = run(tracker, np.arange(20) / RATE, ((100, 100), (100, 0)))[-1]  # the clock starts anew
    assert [t.id for t in tracks] == [2]


def flown(tracker, seconds=1.0, at=(100.0, 200.0), velocity=(200.0, 0.0)):
    """A target of 20 px that flew straight until now; its place then, and the time."""
    times = np.arange(0.0, seconds, 1 / RATE)
    run(tracker, times, (at, velocity))
    return np.array(at) + np.array(velocity) * times[-1], times[-1]


@pytest.mark.parametrize("twigs", [1, 2])
def test_a_piece_of_a_target_does_not_bend_its_way(twigs):
    """Before a tree only a wing's tip is seen: it says that the target is there, and not where its middle is."""
    tracker = Tracker(PLAIN)
    place, t = flown(tracker)
    for i in range(1, twigs + 1):
        middle = place + np.array([200.0, 0.0]) * i / RATE
        (track,) = tracker.update([seen(*(middle + np.array([0.0, -8.0])), 5, 4)], t + i / RATE)
    assert track.missed == 0
    assert abs(track.velocity_px[1]) < SPEED_TOLERANCE
    assert abs(track.center_px[1] - 200) < 4


@pytest.mark.parametrize(("size", "score", "taken"), [(20, 1.0, True), (3, 1.0, False), (20, 0.02, False)])
def test_after_a_gap_what_looks_like_the_target_is_taken_for_it(size, score, taken):
    """A gap leaves much room: for the target, and not for a twig or for what its detector hardly believes."""
    tracker = Tracker(PLAIN)
    place, t = flown(tracker)
    for i in range(1, 8):
        tracker.update([], t + i / RATE)
    aside = place + np.array([200.0 * 8 / RATE, 30.0])
    found = Seen(aside, np.array([size, size], dtype=float), score)
    tracks = tracker.update([found], t + 8 / RATE)
    assert (tracks[0].id, tracks[0].missed == 0) == (1, taken)


def test_who_is_found_again_is_no_newcomer():
    """It turned aside and was beyond the gate at first, so that a new track was begun; the old one takes it over."""
    tracker = Tracker(PLAIN)
    place, t = flown(tracker)
    for i in range(1, 20):
        place = place + np.array([200.0, 15.0]) / RATE + (np.array([0.0, 12.0]) if i == 1 else 0)
        tracks = tracker.update([seen(*place)], t + i / RATE)
    assert [(track.id, track.missed) for track in tracks if track.confirmed] == [(1, 0)]


def test_a_lone_pair_is_matched_as_any_other():
    """A second target far away takes the shortcut for one track and one detection away, and changes nothing."""
    rng = np.random.default_rng(5)
    alone, beside = Tracker(PLAIN, SIZE), Tracker(PLAIN, SIZE)
    numbers = []
    for i in range(60):
        at = 100 + 4 * i + rng.normal(0, 8), 200 + rng.normal(0, 8)  # some jumps are too far
        box, far = seen(*at, *rng.uniform(12, 30, 2)), seen(600, 450)
        one = alone.update([box], i / RATE)
        two = [track for track in beside.update([box, far], i / RATE) if track.center_px[1] < 400]
        assert [track.center_px.tolist() for track in one] == [track.center_px.tolist() for track in two]
        assert [track.missed for track in one] == [track.missed for track in two]
        numbers.append(len(one))
    assert max(numbers) > 1  # where a jump was too far, another track began
