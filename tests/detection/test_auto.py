"""The default detector on drawn films: any size, any shape, standing, growing, in large images, after a nudge."""

import cv2
import numpy as np
import pytest

from cotarget.config import DEFAULT_TARGETS, TargetProfile
from cotarget.detection import AutoDetector, make_detector
from cotarget.detection.background import LargeTargetFinder
from cotarget.pipeline import CameraRun
from cotarget.rig import Frame
from cotarget.tracking.track import tracking_settings
from cotarget.tracking.tracker import Tracker
from tests.support.noise import noisy

NOISE = 2.0  # grey levels, as the simulated sensor's
TARGET = TargetProfile(1.0, "width", 100.0, "auto")
FOUND = 0.95


def scenery(size, rng):
    """A sky above a rough ground, (H, W, 3)."""
    width, height = size
    picture = np.full((height, width, 3), 170.0, np.float32)
    ground = cv2.GaussianBlur(rng.normal(0, 1, (height - height // 3, width)), (0, 0), 2.0)
    picture[height // 3 :] = 90 + 25 * (ground / ground.std())[..., None]
    return picture


def texture(width, height, rng):
    """The surface of a target: clothes or paint of several colours, (H, W, 3)."""
    coarse = rng.uniform(20, 235, (4, 3, 3)).astype(np.float32)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_NEAREST)


def follow(pictures, rate, rng, detector=None):
    """Detect and track in pictures, with noise; the confirmed tracks of each frame."""
    detector = detector or make_detector(TARGET, rate)
    assert isinstance(detector, AutoDetector)
    camera, found = None, []
    for i, picture in enumerate(pictures):
        image = noisy(picture, rng, NOISE)
        camera = camera or CameraRun(detector, Tracker(tracking_settings(TARGET), image.shape[1::-1]))
        camera.track(Frame(image, i / rate))
        found.append([track for track in camera.tracks if track.confirmed])
    return found


def on(tracks, center, within):
    return [track for track in tracks if np.linalg.norm(track.center_px - center) <= within]


def moved(background, surface, places):
    """The background with a target at each place, top-left (u, v); None for none."""
    height, width = surface.shape[:2]
    for place in places:
        picture = background.copy()
        if place is not None:
            u, v = (round(x) for x in place)
            picture[v : v + height, u : u + width] = surface
        yield picture


def test_an_aeroplane_before_the_sky_is_one_target_as_a_whole():
    """It moves by a 160th of its length a frame; parts of it are as bright as the sky."""
    rng = np.random.default_rng(4)
    sky = np.broadcast_to(np.linspace(190, 160, 480)[:, None, None], (480, 640, 3)).astype(np.float32)
    pictures = []
    for i in range(75):
        picture, x = sky.copy(), 120 + 1.5 * i
        corners = np.array(
            [
                [0, 0],
                [95, -10],
                [120, -100],
                [140, -100],
                [130, -12],
                [215, -12],
                [232, -40],
                [245, -40],
                [240, 12],
                [130, 12],
                [150, 90],
                [130, 90],
                [95, 10],
            ]
        )  # nose, wings, fin
        cv2.fillPoly(picture, [np.int32(np.rint(np.add(corners, (x, 210)) * 16))], [130.0] * 3, cv2.LINE_AA, 4)
        cv2.rectangle(picture, (round(x) + 60, 202), (round(x) + 200, 206), [185.0] * 3, cv2.FILLED)
        pictures.append(cv2.GaussianBlur(picture, (0, 0), 1.0))
    for i, tracks in enumerate(follow(pictures, 25.0, rng)):
        if i >= 25:
            (track,) = tracks
            assert track.center_px == pytest.approx([242 + 1.5 * i, 205], abs=10)
            assert track.size_px == pytest.approx([245, 190], abs=15)


def test_a_person_who_stands_is_held_for_half_a_minute():
    """He walks in for 4 s, stands, and is one track; the background alone would have learnt him in 20 s."""
    rng, rate = np.random.default_rng(1), 5.0
    background, surface = scenery((320, 240), rng), texture(16, 44, rng)
    walk = [(20 + 6 * i, 150) for i in range(20)]
    places = [None] * 10 + walk + [walk[-1]] * round(30 * rate)
    tracks = follow(moved(background, surface, places), rate, rng)
    middle = np.add(walk[-1], [7.5, 21.5])
    standing = [on(each, middle, 8) for each in tracks[30:]]
    assert np.mean([bool(each) for each in standing]) >= FOUND
    assert {track.id for each in standing for track in each} == {standing[0][0].id}
    assert standing[-1][0].size_px == pytest.approx([16, 44], abs=6)


@pytest.mark.parametrize("size", [(30, 30), (90, 20)], ids=["dog", "boat"])
def test_an_own_target_of_any_shape_is_found(size):
    rng, rate = np.random.default_rng(2), 25.0
    background, surface = scenery((640, 480), rng), texture(*size, rng)
    places = [None] * 10 + [(40 + 4 * i, 300) for i in range(60)]
    tracks = follow(moved(background, surface, places), rate, rng)
    right = [
        on(each, np.array(place) + np.array(size) / 2, 6) for each, place in zip(tracks, places, strict=True) if place
    ]
    assert np.mean([bool(each) for each in right[10:]]) >= FOUND
    assert right[40][0].size_px == pytest.approx(size, rel=0.3)
    assert len({track.id for each in right for track in each}) == 1


def test_a_target_that_covers_two_fifths_of_the_image_is_found():
    rng, rate, size = np.random.default_rng(2), 25.0, (320, 400)
    background = scenery((640, 480), rng)
    street = np.concatenate(
        [np.fliplr(background), background, np.fliplr(background)], axis=1
    )  # it comes in and leaves
    places = [None] * 15 + [(320 + 8 * i, 40) for i in range(80)]
    pictures = (picture[:, 640:1280] for picture in moved(street, texture(*size, rng), places))
    right = [
        bool(on(each, np.array(place) - (640, 0) + np.array(size) / 2, 40))
        for each, place in zip(follow(pictures, rate, rng), places, strict=True)
        if place and 640 <= place[0] <= 960
    ]
    assert np.mean(right) >= FOUND


@pytest.mark.parametrize("width", [959, 961])
def test_images_about_as_wide_as_those_that_are_halved(width):
    rng, rate = np.random.default_rng(4), 25.0
    background, surface = scenery((width, 479), rng), texture(8, 8, rng) // 4
    places = [None] * 10 + [(200 + 4 * i, 80) for i in range(30)]
    tracks = follow(moved(background, surface, places), rate, rng)
    assert on(tracks[-1], np.add(places[-1], 3.5), 3)


@pytest.mark.parametrize(("size", "rough"), [((60, 150), 0.0), ((250, 100), 3.0)])
def test_a_large_target_before_a_plain_wall_is_not_taken_for_the_cameras_motion(size, rough):
    """Most corners in the image are the target's; the wall has none, or faint ones (grey levels)."""
    rng, rate, width = np.random.default_rng(2), 25.0, size[0]
    spots = cv2.GaussianBlur(rng.normal(0, 1, (480, 640 + width)), (0, 0), 2.0)
    wall = np.repeat((150 + rough * spots / spots.std()).astype(np.float32)[..., None], 3, axis=2)
    places = [None] * 10 + [(5 * i, 150) for i in range(90)]  # it comes in from the left
    detector = make_detector(TARGET, rate)
    pictures = (picture[:, width:] for picture in moved(wall, texture(*size, rng), places))
    tracks = follow(pictures, rate, rng, detector)
    right = [
        on(each, np.array(place) - (width, 0) + np.array(size) / 2, 8)
        for each, place in zip(tracks, places, strict=True)
        if place and place[0] > width
    ]
    assert np.mean([bool(each) for each in right]) >= FOUND
    assert np.abs(detector.detect(Frame(wall[:, width:].astype(np.uint8), 100 / rate)).shift).max() < 1


def test_a_target_that_grows_from_a_speck_keeps_its_number():
    rng, rate = np.random.default_rng(3), 25.0
    background, lengths = scenery((640, 480), rng), np.geomspace(4, 320, 120)
    pictures = []
    for i, length in enumerate(lengths):
        picture = background.copy()
        center = 150 + i, 100 + 0.6 * i
        axes = round(length / 2 * 16), round(length / 5 * 16)
        cv2.ellipse(picture, [round(16 * x) for x in center], axes, 0, 0, 360, (40, 50, 60), -1, cv2.LINE_AA, 4)
        pictures.append(picture)
    tracks = follow(pictures, rate, rng)
    right = [on(each, (150 + i, 100 + 0.6 * i), max(4, lengths[i] / 4)) for i, each in enumerate(tracks)]
    assert np.mean([bool(each) for each in right[12:]]) >= FOUND
    assert len({track.id for each in right for track in each}) == 1
    assert right[-1][0].larger_side_px == pytest.approx(320, rel=0.2)


def test_a_bird_of_four_pixels_is_found_in_an_image_of_3840x2160():
    """20 grey levels over a noise of 2; frames of the sensor's noise are made of a few, shifted."""
    rng, rate, frames = np.random.default_rng(4), 25.0, 25
    noise = [rng.normal(0, NOISE, (2160, 3840)).astype(np.float32) for _ in range(2)]
    detector, found = AutoDetector(rate), []
    for i in range(frames):
        picture = 150 + np.roll(noise[i % 2], 37 * i, axis=1)
        u, v = 800 + 11 * i, 700 + 5 * i
        picture[v : v + 4, u : u + 4] -= 20
        image = cv2.merge([np.clip(picture, 0, 255).astype(np.uint8)] * 3)
        boxes = detector.detect(Frame(image, i / rate)).boxes
        found.append([each for each in boxes if np.linalg.norm(each.center_px - [u + 1.5, v + 1.5]) < 3])
    scored = found[8:]
    assert np.mean([bool(each) and each[0].score > 0.5 for each in scored]) >= 0.9
    assert np.median([each[0].size_px.max() for each in scored if each]) <= 8


def test_a_nudge_of_the_camera_costs_three_tenths_of_a_second():
    rng, rate = np.random.default_rng(5), 25.0
    background, surface = scenery((680, 480), rng), texture(24, 60, rng)
    pictures = []
    for i, picture in enumerate(moved(background, surface, [(60 + 3 * i, 250) for i in range(100)])):
        pictures.append(picture[:, :640] if i < 60 else picture[:, 12:652])
    tracks = follow(pictures, rate, rng)
    lost = [not on(each, (60 + 3 * i + 11.5 - 12 * (i >= 60), 279.5), 8) for i, each in enumerate(tracks)]
    assert not any(lost[30:60])
    assert sum(lost[60:]) <= 0.3 * rate


def test_the_foreground_of_a_large_target_has_its_outline_and_no_boxes_of_its_parts():
    """Where a body is in its box, for the close-up, is measured by the foreground. It walks by, thin as a diamond."""
    rng, rate = np.random.default_rng(4), 25.0
    background, surface = scenery((640, 480), rng), texture(60, 140, rng)
    body = cv2.fillConvexPoly(np.zeros((140, 60), np.uint8), np.array([[30, 0], [59, 70], [30, 139], [0, 70]]), 1)
    near = cv2.dilate(cv2.copyMakeBorder(body, 20, 20, 20, 20, cv2.BORDER_CONSTANT), np.ones((11, 11), np.uint8))
    detector, beside, on_body = AutoDetector(rate), [], []
    for i in range(40):
        picture, u = background.copy(), 100 + 4 * i
        if i >= 10:
            picture[250:390, u : u + 60][body > 0] = surface[body > 0]
        mask = detector.detect(Frame(noisy(picture, rng, NOISE), i / rate)).mask
        if i >= 20:
            beside.append(cv2.countNonZero(mask[230:410, u - 20 : u + 80] * (1 - near)))
            on_body.append(cv2.countNonZero(mask[250:390, u : u + 60] * body))
    assert max(beside) < 0.01 * body.sum()
    assert np.mean(on_body) > 0.8 * body.sum()


def test_frames_that_come_twice_hide_no_clutter():
    """A leaf that turns at its place scores as in the same film with every frame once."""
    background = scenery((480, 360), np.random.default_rng(8))

    def scores(times):
        detector, found = AutoDetector(25.0 * times), []
        for i in range(100):
            picture = background.astype(np.uint8)
            picture[100:106, 200:208] = (40, 220)[i // 3 % 2]
            first, *_ = [detector.detect(Frame(picture, (i + k / times) / 25)).boxes for k in range(times)]
            found.append(first)
        return [max((each.score for each in boxes), default=0.0) for boxes in found[50:]]

    once = scores(1)
    assert max(once) < 0.4
    assert scores(2) == pytest.approx(once, abs=0.02)


def test_a_person_is_found_as_soon_where_frames_come_twice():
    background, surface = scenery((640, 480), np.random.default_rng(1)), texture(60, 150, np.random.default_rng(1))
    places = [None] * 15 + [(20 + 4 * i, 200) for i in range(30)]

    def first(times):
        """Time of the first confirmed track [s]."""
        rng, found = np.random.default_rng(2), []
        camera = CameraRun(make_detector(TARGET, 25.0 * times), Tracker(tracking_settings(TARGET), (640, 480)))
        for i, picture in enumerate(moved(background, surface, places)):
            image = noisy(picture, rng, NOISE)
            for t in [(i + k / times) / 25 for k in range(times)]:
                camera.track(Frame(image, t))
                found += [t] * any(each.confirmed for each in camera.tracks)
        return found[0]

    assert first(2) == pytest.approx(first(1), abs=0.1)


def test_a_camera_that_darkens_its_picture_for_a_white_car_shows_one_target_and_no_stones():
    """Its exposure halves while the car drives by, and a codec that follows draws the stones anew."""
    rng, rate, size = np.random.default_rng(8), 12.5, (180, 120)
    road = np.full((480, 640, 3), 105.0, np.float32)
    for u, v in rng.uniform((10, 10), (630, 470), (60, 2)):
        cv2.ellipse(road, ((u, v), (4, 3), 0), (130.0, 130.0, 130.0), cv2.FILLED)
    car = np.clip(texture(*size, rng) * 0.3 + 170, 0, 235)
    places = [None] * 20 + [(20 + 8 * i, 200) for i in range(55)]
    pictures = []
    for i, picture in enumerate(moved(road, car, places)):
        stones = rng.normal(1.0, 0.35, road.shape[:2])[..., None]  # how a codec draws them while the exposure changes
        ramp = np.clip(min(i - 25, 70 - i) / 20, 0, 1)
        drawn = (
            np.where((picture > 120) & (picture < 150), 105 + (picture - 105) * stones, picture) if ramp else picture
        )
        pictures.append(drawn * (1 - 0.5 * ramp))
    tracks = follow(pictures, rate, rng)
    middles = [np.add(place, np.array(size) / 2 - 0.5) for place in places[35:]]
    assert np.mean([bool(on(each, middle, 20)) for each, middle in zip(tracks[35:], middles, strict=True)]) >= FOUND
    assert len({track.id for each in tracks for track in each}) == 1


@pytest.mark.parametrize("light", [lambda t: 1 + 0.1 * np.sin(np.pi * t), lambda t: 1 + 0.6 * (t == 0)])
def test_a_white_bird_is_found_while_the_light_changes(light):
    """Waves of a tenth in two seconds, and a first image that is over-exposed."""
    rng, rate = np.random.default_rng(9), 25.0
    bird = np.full((5, 9, 3), 215.0)
    places = [None] * 10 + [(40 + 3 * i, 60) for i in range(70)]
    pictures = [
        np.clip(picture * light(i / rate), 0, 255)
        for i, picture in enumerate(moved(scenery((640, 480), rng), bird, places))
    ]
    tracks = follow(pictures, rate, rng)
    right = [on(each, np.add(place, (4, 2)), 4) for each, place in zip(tracks, places, strict=True) if place]
    assert np.mean([bool(each) for each in right[25:]]) >= FOUND


@pytest.mark.parametrize("rate", [30.0, pytest.param(5.0, marks=pytest.mark.slow)])
def test_a_bird_is_found_under_a_lamp_that_flickers(rate):
    """By a tenth from frame to frame, as 50 Hz do at 30 frames a second."""
    rng = np.random.default_rng(9)
    bird = np.full((5, 9, 3), 40.0)
    places = [None] * 10 + [(40 + 3 * i, 60) for i in range(80)]
    pictures = [
        picture * (0.95 if i % 3 else 1.05) for i, picture in enumerate(moved(scenery((640, 480), rng), bird, places))
    ]
    tracks = follow(pictures, rate, rng)
    right = [on(each, np.add(place, (4, 2)), 4) for each, place in zip(tracks, places, strict=True) if place]
    assert np.mean([bool(each) for each in right[20:]]) >= FOUND


def test_a_bird_is_found_soon_after_a_sky_of_another_brightness_is_shown():
    """A film of the sky is cut: no corner shows it, and the new part is darker by a third."""
    rng, rate = np.random.default_rng(10), 30.0
    sky = np.repeat(np.linspace(220, 200, 240)[:, None, None], 320, axis=1) * np.ones(3)
    bird = np.full((5, 9, 3), 60.0)
    places = [(20 + 3 * i, 40) for i in range(40)] + [(20 + 3 * i, 120) for i in range(20)]
    detector = make_detector(DEFAULT_TARGETS["bird"], rate)
    found = []
    for i, picture in enumerate(moved(sky, bird, places)):
        shown = np.clip(picture * (1.0 if i < 40 else 0.66) + rng.normal(0, 1, picture.shape), 0, 255).astype(np.uint8)
        boxes = detector.detect(Frame(shown, i / rate)).boxes
        found.append(any(np.abs(box.center_px - places[i] - (4, 2)).max() < 4 for box in boxes))
    assert np.mean(found[10:40]) == 1.0
    assert np.mean(found[50:]) == 1.0  # after a third of a second


def test_a_lamp_that_is_switched_on_over_rough_ground_makes_no_target():
    """Everything is 40 grey levels brighter for two seconds, as far as the sensor goes."""
    rng, rate = np.random.default_rng(0), 25.0
    ground = np.clip(cv2.GaussianBlur(rng.normal(95, 90, (240, 320)), (0, 0), 1.8), 0, 255)
    ground[:100] = 150
    ground = np.repeat(ground[..., None], 3, axis=2)
    tracks = follow([np.clip(ground + (40 if 40 <= i < 90 else 0), 0, 255) for i in range(130)], rate, rng)
    assert not any(tracks)


def test_a_wall_that_is_lit_beside_someone_who_stands_does_not_hide_him():
    rng, rate = np.random.default_rng(10), 5.0
    background, surface = scenery((640, 480), rng), texture(80, 220, rng)
    walk = [(40 + 12 * i, 220) for i in range(20)]
    places = [None] * 10 + walk + [walk[-1]] * 130
    pictures = []
    for i, place in enumerate(places):
        lit = background.copy()
        if i >= 60:
            lit[180:, 120:480] *= 1.2
        pictures.extend(moved(lit, surface, [place]))
    tracks, middle = follow(pictures, rate, rng), np.add(walk[-1], (39.5, 109.5))
    standing = [on(each, middle, 15) for each in tracks[35:]]
    assert np.mean([bool(each) for each in standing]) >= FOUND
    assert {track.id for each in standing for track in each} == {standing[0][0].id}
    assert standing[-1][0].size_px == pytest.approx([80, 220], abs=8)


def test_the_place_that_a_target_has_left_is_no_target():
    """A car stood there when the background was learnt; it drives off, and leaves a ghost in the background model."""
    rng, rate = np.random.default_rng(6), 25.0
    background, surface = scenery((640, 480), rng), texture(60, 24, rng)
    places = [(100, 300)] * 50 + [(100 + 6 * i, 300) for i in range(50)]
    tracks = follow(moved(background, surface, places), rate, rng)
    assert all(on(each, np.add(place, [29.5, 11.5]), 6) for each, place in zip(tracks[75:], places[75:], strict=True))
    assert not any(on(each, (129.5, 311.5), 20) for each in tracks[75:])


def test_sunlight_on_the_ground_beside_a_large_target_is_no_part_of_it():
    """The lit strip is smaller than the car that drives along it."""
    rng, rate, size = np.random.default_rng(2), 25.0, (220, 140)
    background, surface = scenery((640, 480), rng), texture(*size, rng)
    places = [None] * 10 + [(40 + 3 * i, 300) for i in range(90)]
    pictures = []
    for i, place in enumerate(places):
        lit = background.copy()
        lit[380:430] *= 1 + 0.3 * np.clip((i - 60) / 20, 0, 1)
        pictures.extend(moved(lit, surface, [place]))
    tracks = follow(pictures, rate, rng)[60:]
    right = [on(each, np.add(place, [109.5, 69.5]), 10) for each, place in zip(tracks, places[60:], strict=True)]
    assert np.mean([bool(each) for each in right]) >= FOUND
    assert np.ptp([each[0].size_px for each in right if each], axis=0).max() < 20


def test_a_patch_of_sunlight_that_grows_is_no_target_even_if_it_was_one_while_small():
    rng, rate = np.random.default_rng(2), 25.0
    background, pictures = scenery((640, 480), rng), []
    for i in range(110):
        picture, k = background.copy(), i - 10
        if k >= 0:
            picture[300 : 328 + 4 * k // 5, 60 + 3 * k : 100 + 4 * k] *= 1.3
        pictures.append(picture)
    tracks = follow(pictures, rate, rng)
    assert any(tracks[:50])  # else nothing is shown
    assert not any(tracks[100:])


@pytest.mark.parametrize("soft", [True, False], ids=["cloud", "balloon"])
def test_a_cloud_that_drifts_is_no_target(soft):
    """Both are some 50 px large and 30 grey levels brighter than the sky."""
    rng, rate = np.random.default_rng(7), 25.0
    background, (v, u) = scenery((640, 480), rng), np.mgrid[:480, :640]
    pictures = []
    for i in range(80):
        square = ((u - 150 - 2 * i) / 16) ** 2 + ((v - 90) / 13) ** 2
        shape = np.exp(-square / 2) if soft else square < 2
        pictures.append(background + 30.0 * min(1.0, i / 10) * shape[..., None])
    tracks = follow(pictures, rate, rng)
    assert any(tracks) != soft


@pytest.mark.parametrize("step", [3, 14])
def test_a_bird_that_passes_before_a_balloon_is_not_taken_for_a_part_of_it(step):
    """A fast bird moves by more than its size from image to image."""
    rng, rate, frames = np.random.default_rng(7), 25.0, 420 // step
    background, pictures, birds = scenery((640, 480), rng), [], []
    for i in range(frames):
        picture, bird = background.copy(), np.array([150 + i * step, 100])
        if i * step > 100:
            cv2.ellipse(picture, (440 - i * 100 // frames, 80), (60, 50), 0, 0, 360, (60, 120, 220), -1)
        picture[bird[1] : bird[1] + 7, bird[0] : bird[0] + 12] = 40.0
        pictures.append(picture)
        birds.append(np.add(bird, (5.5, 3.0)))
    tracks = follow(pictures, rate, rng)
    right = [on(each, bird, 6) for each, bird in zip(tracks, birds, strict=True)][frames // 3 :]
    assert np.mean([any(not track.missed for track in each) for each in right]) >= FOUND
    assert len({track.id for each in right for track in each}) == 1


@pytest.mark.parametrize("size", [(60, 24), (24, 60), (80, 160)])
def test_a_dark_target_of_one_colour_is_found_before_a_textured_wall(size):
    """The rim of a dark target is as dark as a shadow of the wall."""
    rng, rate, found = np.random.default_rng(11), 25.0, []
    spots = cv2.GaussianBlur(rng.normal(0, 1, (480, 640, 1)), (0, 0), 2.0)
    wall = np.repeat((120 + 20 * spots / spots.std()).astype(np.float32)[..., None], 3, axis=2)
    finder = LargeTargetFinder(rate)
    places = [None] * 20 + [(100 + 4 * i, 200) for i in range(50)]
    for i, picture in enumerate(moved(wall, np.full((*size[::-1], 3), 30.0), places)):
        image = noisy(cv2.GaussianBlur(picture, (0, 0), 0.7), rng, NOISE)
        boxes = finder.find(Frame(image, i / rate)).boxes
        if i >= 26:
            middle = np.add(places[i], np.array(size) / 2 - 0.5)
            found.append(any(np.abs(each.center_px - middle).max() < 6 for each in boxes))
    assert np.mean(found) >= FOUND


@pytest.mark.parametrize("shift", [0.0, 6.0, -6.0])
def test_a_box_at_the_images_border_is_clipped_wherever_the_camera_points(shift):
    rng, rate = np.random.default_rng(12), 25.0
    finder = LargeTargetFinder(rate)
    background = scenery((480, 360), rng)
    for i in range(12):
        by = np.array([0.0 if i < 10 else shift, 0.0])
        picture = np.roll(background, round(by[0]), axis=1)
        if i >= 10:
            picture[200:260, 440:] = texture(40, 60, rng)
        boxes = finder.find(Frame(noisy(picture, rng, NOISE), i / rate), shift_px=by).boxes
    assert [each.clipped for each in boxes if on([each], (459.5, 229.5), 12)] == [True]


def test_the_foreground_of_a_camera_that_pans_is_not_that_of_before():
    rng, rate = np.random.default_rng(13), 25.0
    detector, background = AutoDetector(rate), scenery((900, 480), rng)
    for i, picture in enumerate(moved(background, texture(60, 80, rng), [None] * 10 + [(200, 200)] * 30)):
        left = max(0, 8 * (i - 20))
        mask = detector.detect(Frame(noisy(picture[:, left : left + 640], rng, NOISE), i / rate)).mask
        if i == 19:
            assert mask[240, 230] == 255
    # The target is at another place now.
    assert cv2.countNonZero(mask[200:280, 200:260]) < 0.1 * 60 * 80


def test_what_the_image_shows_is_learnt_beside_places_that_are_held_outside_of_it():
    """A track near the border, and a camera that has been nudged: what the image shows is learnt."""
    rng, rate = np.random.default_rng(8), 5.0
    finder = LargeTargetFinder(rate)
    places = [(np.array([u, 130.0]), np.array([10.0, 60.0])) for u in (-300.0, 700.0)]
    pictures = list(moved(scenery((640, 480), rng), texture(40, 60, rng), [None] * 10 + [(320, 100)] * 200))
    found = [finder.find(Frame(each.astype(np.uint8), i / rate), places) for i, each in enumerate(pictures)]
    assert len(found[12].boxes) == 1
    assert not found[-1].boxes
    assert not found[-1].mask.any()


def test_an_upright_target_is_boxed_with_its_legs():
    """Legs of 4 px, which are two in the image of half the size, under a body of 18x36 px."""
    rng, rate = np.random.default_rng(24), 25.0
    finder, background, surface = LargeTargetFinder(rate, upright=True), scenery((640, 480), rng), texture(18, 72, rng)
    heights = []
    for i in range(40):
        picture, u = background.copy(), 60 + 6 * i
        if i >= 15:
            picture[300:336, u : u + 18] = surface[:36]
            for leg in (u + 2, u + 12):
                picture[336:372, leg : leg + 4] = surface[36:, :4]
        found = finder.find(Frame(noisy(picture, rng, NOISE), i / rate)).boxes
        heights += [float(each.size_px[1]) for each in found if abs(each.center_px[0] - u - 8.5) < 10]
    assert len(heights) > 20
    assert np.median(heights) == pytest.approx(72, abs=4)  # two pixels of the image of half the size


@pytest.mark.parametrize(("shape", "width"), [(0.4, (25, 42)), (None, (60, 130))])
def test_an_upright_target_is_boxed_without_the_dark_shadow_at_its_feet(shape, width):
    rng, rate = np.random.default_rng(22), 25.0
    background, surface = scenery((640, 480), rng), texture(32, 90, rng)
    detector = make_detector(TargetProfile(1.75, "height", 300.0, shape=shape), rate)

    def pictures():
        for i in range(60):
            picture = background.copy()
            if i >= 15:
                u = 60 + 5 * (i - 15)
                picture[382:390, u + 30 : u + 100] *= 0.3
                picture[300:390, u : u + 32] = surface
            yield picture

    highest = max(follow(pictures(), rate, rng, detector)[-1], key=lambda track: float(track.size_px[1]))
    assert width[0] < highest.size_px[0] < width[1]


def test_the_expected_shape_lowers_the_score_of_others_but_not_of_clipped_ones():
    """A thing of 60x20 px goes to the image's border."""
    rate, scores = 25.0, {}
    for shape in (None, 0.4):
        rng = np.random.default_rng(23)
        background, surface = np.full((240, 320, 3), 170.0), texture(60, 20, rng)
        detector = make_detector(TargetProfile(1.75, "height", 300.0, shape=shape), rate)
        places = [None] * 10 + [(20 + 8 * i, 100) for i in range(36)]
        for i, picture in enumerate(moved(background, surface, [each and (min(each[0], 260), 100) for each in places])):
            found = detector.detect(Frame(noisy(picture, rng, NOISE), i / rate)).boxes
            if i in (30, 45):
                scores[shape, i] = max(((each.score, each.clipped) for each in found), default=None)
    assert not scores[None, 30][1]
    usual, lowered = (score / (1 - score) for score, _ in (scores[None, 30], scores[0.4, 30]))
    assert lowered < 0.1 * usual
    assert scores[None, 45][1]
    assert scores[0.4, 45] == scores[None, 45]
