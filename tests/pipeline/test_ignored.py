"""Ignored regions of the fixed camera's image: what moves there is no target, and what passes them keeps its track."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cotarget.backends import open_recording
from cotarget.config import DEFAULT_TARGETS, FollowConfig, parse_config
from cotarget.detection import Detections, make_detector
from cotarget.drawing import draw_wide
from cotarget.evaluation import true_calibration
from cotarget.pipeline import CameraRun, Run
from cotarget.recording.recorder import Recorder
from cotarget.recording.replay import Replay, until_end
from cotarget.rig import Frame
from cotarget.sim.world import SimWorld
from cotarget.tracking.track import tracking_settings
from cotarget.tracking.tracker import Tracker
from tests.support.noise import noisy
from tests.support.recorded_run import CONFIG, Bright, ToyDevices, calibration, calibration_file
from tests.support.rigs import guarded, rig_of

WIDTH, HEIGHT, RATE_HZ, NOISE = 320, 240, 25.0, 2.0
BIRD = DEFAULT_TARGETS["bird"]
OFF_PX = 3.0  # of a box's centre, for a bird of 8 px that flies 2 to 3 px a frame
LEARNT = 25  # frames after which a bird must be found


def rectangle(left, top, right, bottom):
    """A polygon in parts of the image, from pixels."""
    return tuple((u / WIDTH, v / HEIGHT) for u, v in ((left, top), (right, top), (right, bottom), (left, bottom)))


def sky():
    return np.full((HEIGHT, WIDTH, 3), 150, np.uint8)


def camera_of(detector, ignored):
    target = replace(BIRD, detector=detector)
    tracker = Tracker(tracking_settings(target), (WIDTH, HEIGHT))
    return CameraRun(make_detector(target, RATE_HZ), tracker, ignored)


def tracked(pictures, detector, ignored=()):
    """The confirmed tracks of each picture, with noise."""
    rng, camera, found = np.random.default_rng(5), camera_of(detector, ignored), []
    for i, picture in enumerate(pictures):
        camera.track(Frame(noisy(picture.astype(np.float32), rng, NOISE), i / RATE_HZ))
        found.append([track for track in camera.tracks if track.confirmed])
    return found


def on(tracks, center):
    """The numbers of the tracks at a place."""
    return {track.id for track in tracks if np.abs(track.center_px - center).max() <= OFF_PX}


def timers(frames):
    """A timer's changing digits in a corner."""
    for i in range(frames):
        picture = sky()
        cv2.putText(picture, f"{7919 * i % 10**6:06d}", (190, 40), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255,) * 3, 1)
        yield picture


def test_a_timer_in_an_ignored_region_is_no_target():
    assert any(tracked(timers(75), "auto"))
    assert not any(tracked(timers(75), "auto", [rectangle(180, 15, 300, 50)]))


def flights(frames, place, ground=None):
    """A dark bird of 8 px by 6 before the sky, and below it a ground of which each picture has another one."""
    rng = np.random.default_rng(2)
    for i in range(frames):
        picture = sky()
        if ground is not None:
            waves = rng.normal(120, 60, ((HEIGHT - ground) // 4, WIDTH // 8)).astype(np.float32)
            waves = np.clip(cv2.resize(waves, (WIDTH, HEIGHT - ground)), 0, 255)
            picture[ground:] = waves[..., None].astype(np.uint8)
        u, v = place(i)
        picture[round(v) - 3 : round(v) + 3, round(u) - 4 : round(u) + 4] = 40
        yield picture


def test_water_that_fills_half_the_image_hides_no_bird_where_it_is_ignored():
    """Otherwise everything that the detector knows of the image is changed by it."""

    def place(i):
        return 40 + 2.5 * i, 50 + 8 * np.sin(i / 7)

    ground = 100
    water = [((0.0, ground / HEIGHT), (1.0, ground / HEIGHT), (1.0, 1.0), (0.0, 1.0))]
    parts = []
    for ignored in ((), water):
        found = tracked(flights(90, place, ground), "auto", ignored)
        parts.append(np.mean([bool(on(tracks, place(i))) for i, tracks in enumerate(found)][LEARNT:]))
    assert parts[0] < 0.5
    assert parts[1] > 0.95
    assert all(on(tracks, place(i)) == {track.id for track in tracks} for i, tracks in enumerate(found) if i > LEARNT)


@pytest.mark.parametrize("detector", ["auto", "speck"])
def test_a_bird_that_flies_through_an_ignored_region_is_found_on_both_sides_as_one(detector):
    """It needs 0.4 s for the region's 30 px, less than the 0.8 s for which a track is kept."""

    def place(i):
        return 20 + 3 * i, 120

    pole = rectangle(145, 0, 175, HEIGHT)
    found = tracked(flights(90, place), detector, [pole])
    before = [on(found[i], place(i)) for i in range(LEARNT, 40)]  # up to column 137
    after = [on(found[i], place(i)) for i in range(58, 90)]  # from column 194 on
    assert all(before)
    assert all(after)
    assert len(set.union(*before, *after)) == 1
    assert max(len(tracks) for tracks in found) == 1


def test_a_detector_gets_the_image_without_the_regions_and_the_frame_is_as_it_was():
    image = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    seen = []

    class Own:
        def detect(self, frame, held=()):
            seen.append(frame.image)
            return Detections([])

    regions = [rectangle(130, 100, 190, 140), rectangle(180, 120, 320, 240)]  # they overlap
    camera = CameraRun(Own(), Tracker(tracking_settings(BIRD), (WIDTH, HEIGHT)), regions)
    frame = Frame(image.copy(), 0.0)
    camera.track(frame)
    assert np.array_equal(frame.image, image)
    changed = (seen[0] != image).any(axis=2)
    inside = np.zeros((HEIGHT, WIDTH), bool)
    inside[100:140, 130:190] = inside[120:, 180:] = True
    assert len(np.unique(seen[0][inside], axis=0)) == 1
    around = cv2.dilate(inside.astype(np.uint8), np.ones((3, 3))) != 0  # the edge may be a pixel outside
    assert not changed[~around].any()


TOY = replace(CONFIG, follow=FollowConfig(ignored=(((0.45, 0.0), (0.6, 0.0), (0.6, 1.0), (0.45, 1.0)),)))


def toy_steps(rig):
    """The pipeline on a toy rig whose bird flies through the region."""
    with guarded(rig, TOY.safety) as safe:
        yield from Run(safe, calibration(), TOY.target("bird"), Bright()).follow(2.0)


def test_a_replay_ignores_what_the_run_did(tmp_path):
    with Recorder(tmp_path / "run", TOY, calibration_file(tmp_path), "bird") as recorder:
        then = list(toy_steps(recorder.wrap(rig_of(ToyDevices(), config=TOY))))
    assert {len(step.detections) for step in then} == {0, 1}
    recording = open_recording(tmp_path / "run")
    assert recording.config.follow.ignored == TOY.follow.ignored
    played = Replay(recording)
    now = list(until_end(toy_steps(played.rig), played))
    assert played.differences.same
    assert [len(step.detections) for step in now] == [len(step.detections) for step in then]
    assert now[0].ignored == then[0].ignored == TOY.follow.ignored


def test_the_picture_of_a_step_outlines_the_regions_and_shows_what_is_inside():
    step = next(toy_steps(rig_of(ToyDevices(), config=TOY)))
    plain, drawn = draw_wide(replace(step, ignored=())), draw_wide(step)
    height, width = plain.shape[:2]
    changed = np.flatnonzero((plain != drawn).any(axis=(0, 2)))
    assert changed.min() == pytest.approx(0.45 * width, abs=4)
    assert changed.max() == pytest.approx(0.6 * width, abs=4)
    inside = slice(round(0.5 * width), round(0.55 * width))
    assert np.array_equal(plain[5 : height - 5, inside], drawn[5 : height - 5, inside])


@pytest.mark.render
def test_following_in_the_simulation_sees_no_target_in_a_region():
    """The book is found by its colours, at 0.38 of the width and 0.53 of the height."""
    sim = {"scene": "indoor", "targets": ["book"], "fixed": {"size": [320, 240]}, "zoom": {"size": [160, 120]}}
    around, elsewhere = ([[[u, 0.3], [u + 0.4, 0.3], [u + 0.4, 0.7], [u, 0.7]]] for u in (0.2, 0.6))
    followed = []
    for ignored in ([], around, elsewhere):
        config = parse_config({"sim": sim, "follow": {"ignored": ignored}})
        world = SimWorld(config)
        with world.rig as rig:
            steps = list(Run(rig, true_calibration(world), config.target("book")).follow(0.6))
        followed.append([step.target is not None for step in steps])
    assert any(followed[0])
    assert not any(followed[1])
    assert followed[2] == followed[0]
