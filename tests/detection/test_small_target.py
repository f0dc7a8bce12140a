"""Small targets on drawn pictures: what stands out and changes is found, what only does one of the two is not."""

import dataclasses

import cv2
import numpy as np
import pytest

from cotarget.config import DEFAULT_TARGETS, TargetProfile
from cotarget.detection import make_detector
from cotarget.detection.small_target import CameraMotion, find_small_targets
from cotarget.errors import CotargetError
from cotarget.rig import Frame
from cotarget.tracking.track import tracking_settings
from cotarget.tracking.tracker import Tracker
from tests.support.noise import noisy

RATE = 25.0
NOISE = 2.0  # grey levels, as the simulated sensor's
HEIGHT, WIDTH = 240, 320
PLACE_PX, OUTLINE_PX = 1.5, 3.0  # soft edges and noise move an outline, on each side, by a pixel
SIGN_PX = 7.0  # half of a bird's length: of one that flies before a sign the front is boxed alone
SPECK = dataclasses.replace(DEFAULT_TARGETS["bird"], detector="speck")


def landscape(rng):
    """A sky with a gradient above a rough ground that corners are found in."""
    rows = np.linspace(210, 150, HEIGHT)[:, None, None] * np.array([1.0, 0.85, 0.7])
    picture = np.broadcast_to(rows, (HEIGHT, WIDTH, 3)).copy()
    ground = cv2.GaussianBlur(rng.normal(0, 1, (70, WIDTH)), (0, 0), 2.0)
    picture[170:] = 80 + 40 * (ground / ground.std())[..., None]
    return picture


def draw(picture, u, v, width, height, grey=60.0):
    """A dark ellipse with soft edges at a sub-pixel place."""
    scale = 16
    x, y = (round(float(n) * scale) for n in (u, v))
    axes = (round(width / 2 * scale), round(height / 2 * scale))
    there = np.zeros(picture.shape[:2], np.uint8)
    cv2.ellipse(there, (x, y), axes, 0, 0, 360, 255, -1, cv2.LINE_AA, 4)
    part = cv2.GaussianBlur(there, (0, 0), 0.5)[..., None] / 255
    picture[:] = picture * (1 - part) + grey * part


def photograph(picture, rng):
    return noisy(picture, rng, NOISE)


def watch(pictures, detector=None):
    detector = detector or make_detector(SPECK, RATE)
    return [detector.detect(Frame(picture, i / RATE)).boxes for i, picture in enumerate(pictures)]


def follow(pictures):
    """Confirmed tracks of each frame."""
    tracker = Tracker(tracking_settings(SPECK), (WIDTH, HEIGHT))
    found = watch(pictures)
    return [[t for t in tracker.update(boxes, i / RATE) if t.confirmed] for i, boxes in enumerate(found)]


def film(frames, paint, seed=0):
    rng = np.random.default_rng(seed)
    ground = landscape(rng)
    pictures = []
    for i in range(frames):
        picture = ground.copy()
        paint(picture, i)
        pictures.append(photograph(picture, rng))
    return pictures


def test_a_bird_that_hovers_on_the_spot_is_followed_and_what_stands_is_not():
    """Wings beat at 4 Hz on a body that stays where it is; beside it a dark thing of the same size only stands."""

    def paint(picture, i):
        beat = np.sin(2 * np.pi * 4 * i / RATE)
        draw(picture, 100, 80, 4, 4)
        draw(picture, 100, 80 - 2 * beat, 10, 2)
        draw(picture, 220, 80, 8, 5)

    tracks = follow(film(60, paint))
    for confirmed in tracks[20:]:
        (track,) = confirmed
        assert track.id == tracks[20][0].id
        assert np.linalg.norm(track.center_px - (100, 80)) < 3.0


@pytest.mark.parametrize("size", [4, 16, 56])
def test_small_targets_of_all_sizes_are_found_where_they_are(size):
    speed = max(1.7, 0.1 * size)  # a tenth of itself a frame; px

    def paint(picture, i):
        draw(picture, 40.3 + speed * i, 80.6, size, 0.6 * size)

    found = watch(film(40, paint))
    for i, boxes in list(enumerate(found))[15:]:
        (box,) = [box for box in boxes if box.score > 0.5]
        # The outline at a third of the contrast lies half a pixel outside the true one on each side, at most one.
        np.testing.assert_allclose(box.center_px, (40.3 + speed * i, 80.6), atol=1.0)
        assert -0.1 * size - 1 <= box.size_px[0] - size <= 2.5


def test_a_helicopter_before_clouds_is_boxed_with_its_blurred_rotor():
    """The rotor is an eighth as dark as the body, and no darker than the sky elsewhere; a codec leaves little noise."""
    rng = np.random.default_rng(12)
    rows, columns = np.mgrid[:480, :640]
    sky = 150 + 25 * np.sin(columns / 200) * np.sin(rows / 150)
    for i in range(20):
        picture, u = sky.copy(), 200 + 4 * i
        cv2.rectangle(picture, (u - 52, 200), (u + 52, 205), -1, cv2.FILLED)
        rotor = picture == -1
        picture[rotor] = sky[rotor] - 15
        cv2.ellipse(picture, (u, 222), (30, 18), 0, 0, 360, 40, cv2.FILLED)
        shown = noisy(np.repeat(cv2.GaussianBlur(picture, (0, 0), 0.7)[..., None], 3, axis=2), rng, 1.0)
        if i == 0:
            detector = make_detector(SPECK, RATE)
        boxes = detector.detect(Frame(shown, i / RATE)).boxes
        if i >= 10:
            (box,) = [box for box in boxes if box.score > 0.5]
            np.testing.assert_allclose(box.center_px, (u, 220), atol=4.0)
            np.testing.assert_allclose(box.size_px, (105, 41), atol=8.0)


@pytest.mark.parametrize(("beside_px", "found"), [(1, False), (12, True)])
def test_what_twinkles_at_the_border_begins_no_track(beside_px, found):
    """A lamp of 3x3 px in the sky; with one pixel beside it, half of its surroundings are outside."""

    def paint(picture, i):
        picture[beside_px : beside_px + 3, 100:103] += 20 + 25 * (i % 3)

    assert any(follow(film(30, paint))) == found


def test_a_bird_of_one_pixel_before_a_plain_sky_is_found():
    """50 grey levels darker, over a noise of 2; the mean of three by three pixels shows a tenth of that."""

    def paint(picture, i):
        picture[40 + i // 2, 50 + 2 * i] -= 50

    found = watch(film(40, paint))[15:]
    near = [
        [box for box in boxes if np.abs(box.center_px - (50 + 2 * i, 40 + i // 2)).max() <= 1.5 and box.score > 0.5]
        for i, boxes in enumerate(found, start=15)
    ]
    assert np.mean([bool(each) for each in near]) >= 0.9


@pytest.mark.parametrize(("rough", "found"), [(0.0, True), (10.0, False)])
def test_a_spot_in_a_large_picture_is_found_before_a_sky_and_not_among_leaves(rough, found):
    """Leaves have such spots. Leaf and spot are 4 px large; the spot's contrast is 6 times the leaves' deviation."""
    rng = np.random.default_rng(1)
    leaves = cv2.resize(rng.normal(120, rough, (240, 320)), None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST)
    leaves[478:482, 638:642] = 120 + 60
    fine = photograph(leaves, rng)
    half = cv2.resize(fine, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    boxes = [(*each.low, *each.size) for each in find_small_targets([fine, half], 4.5, first=1)]
    assert any(x <= 639 < x + w and y <= 479 < y + h for x, y, w, h in boxes) == found


@pytest.mark.parametrize(("length", "step"), [(12, 1), (24, 4), (40, 3)])
def test_all_of_a_plain_bird_is_boxed_though_only_its_front_is_new(length, step):
    """It moves by less than its own length in the shortest time over which pictures are compared."""

    def paint(picture, i):
        draw(picture, 60 + step * i, 60, length, length / 2)

    for i, found in enumerate(watch(film(60, paint))):
        if i >= 30:  # a second after the first
            assert found[0].center_px == pytest.approx([60 + step * i, 60], abs=PLACE_PX)
            assert found[0].size_px == pytest.approx([length, length / 2], abs=OUTLINE_PX)


def test_a_bird_that_passes_a_sign_is_not_as_large_as_the_sign():
    """The sign changes too, by what the bird hides of it, but has come from nowhere."""

    def paint(picture, i):
        picture[50:90, 140:180] = 60.0
        draw(picture, 60 + 3 * i, 70, 14, 7, grey=230.0)

    for i, found in enumerate(watch(film(60, paint))):
        if i >= 30 and 145 <= 60 + 3 * i <= 175:
            assert found[0].center_px == pytest.approx([60 + 3 * i, 70], abs=SIGN_PX)
            assert (found[0].size_px <= [14 + OUTLINE_PX, 7 + OUTLINE_PX]).all()


def test_faint_targets_in_much_noise_are_found():
    """15 grey levels darker than the sky: seven standard deviations of the noise."""

    def paint(picture, i):
        v, u = 80, 60 + 2 * i
        picture[v - 2 : v + 3, u - 3 : u + 4] -= 15

    tracks = follow(film(60, paint))
    assert (
        np.mean([any(np.abs(t.center_px - (60 + 2 * i, 80)).max() < 4 for t in tracks[i]) for i in range(20, 60)]) > 0.9
    )
    assert all(len(confirmed) <= 1 for confirmed in tracks)


@pytest.mark.parametrize("shake_px", [0.0, 1.0])
def test_a_bird_in_front_of_rough_ground_is_found_by_what_it_does_to_the_picture(shake_px):
    """The ground varies by 40 grey levels around 80, the bird stands for 40 everywhere."""
    rng = np.random.default_rng(8)
    ground, pictures, at = landscape(rng), [], []
    for i in range(80):
        picture, shift = ground.copy(), rng.normal(0, shake_px, 2)
        at.append(np.add((30 + 3 * i, 205), shift))
        draw(picture, 30 + 3 * i, 205, 10, 7, grey=40.0)
        M = np.column_stack([np.eye(2), shift])
        moved = cv2.warpAffine(picture, M, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        pictures.append(photograph(moved, rng))
    tracks = follow(pictures)
    on = [any(np.linalg.norm(t.center_px - at[i]) < 5 for t in tracks[i]) for i in range(30, 80)]
    assert np.mean(on) > 0.9
    assert sum(len(confirmed) > 1 for confirmed in tracks) <= 0.1 * 80  # it may fall in two for a moment


def test_a_bird_in_front_of_rough_ground_is_found_at_a_hundred_frames_a_second():
    """What is usual at a place is learnt by the time, and not by the number of frames."""
    rng, rate = np.random.default_rng(8), 100.0
    ground, detector, on = landscape(rng), make_detector(SPECK, RATE), []
    tracker = Tracker(tracking_settings(SPECK), (WIDTH, HEIGHT))
    for i in range(180):
        picture, at = ground.copy(), (30 + 40 * i / rate, 205)
        draw(picture, *at, 10, 7, grey=40.0)
        tracks = tracker.update(detector.detect(Frame(photograph(picture, rng), i / rate)).boxes, i / rate)
        on.append(any(np.linalg.norm(t.center_px - at) < 5 for t in tracks if t.confirmed))
    assert np.mean(on[100:]) > 0.9


@pytest.mark.parametrize("times", [1, 3])
def test_a_bird_of_a_pixel_is_found_in_a_small_picture(times):
    """A film in half and a third of its size: the bird is 1.3 px long."""

    def paint(picture, i):
        draw(picture, *at(i), 4, 3, grey=110.0)

    def at(i):
        return 40 + 3 * i, 60 + i / 2

    size = WIDTH // times, HEIGHT // times
    part = np.divide(size, (WIDTH, HEIGHT))
    detector = make_detector(SPECK, RATE)
    pictures = [cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in film(80, paint)]
    found = [detector.detect(Frame(picture, i / RATE)) for i, picture in enumerate(pictures)]
    assert found[-1].mask.shape == size[::-1]
    u, v = found[-1].boxes[0].center_px
    assert found[-1].mask[round(v), round(u)] > 100
    off = []
    for i in range(30, 80):
        place = (np.array(at(i)) + 0.5) * part - 0.5
        off.append(min((np.linalg.norm(each.center_px - place) for each in found[i].boxes), default=np.inf))
    assert np.mean(np.array(off) < 0.7) > 0.9
    assert np.median(off) < 0.2


@pytest.mark.parametrize(("width", "height", "noise"), [(240, 180, 8.0), (320, 240, 4.0)])
def test_noise_alone_makes_no_track(width, height, noise):
    """Small pictures are enlarged before they are searched, and their noise with them."""
    rng = np.random.default_rng(1)
    pictures = [np.clip(128 + rng.normal(0, noise, (height, width, 3)), 0, 255).astype(np.uint8) for _ in range(60)]
    tracker = Tracker(tracking_settings(SPECK), (width, height))
    for i, found in enumerate(watch(pictures)):
        assert not any(track.confirmed for track in tracker.update(found, i / RATE))


def test_a_twig_that_sways_where_it_is_makes_no_track():
    """Above the ground's rough edge, to and fro by its own size in the wind."""
    rng = np.random.default_rng(7)
    way = 3 * np.cumsum(rng.normal(0, 0.5, 120)) % 8 - 4

    def paint(picture, i):
        draw(picture, 160 + way[i], 168, 6, 4)

    assert sum(len(confirmed) for confirmed in follow(film(120, paint))) < 0.1 * 120


def test_a_camera_that_shakes_makes_nothing_move():
    """Everything shifts by a pixel or two every frame: a sign in the sky and the rough ground stay what they are."""
    rng = np.random.default_rng(2)
    ground = landscape(rng)
    draw(ground, 220, 80, 6, 5)
    pictures = []
    for _ in range(60):
        M = np.column_stack([np.eye(2), rng.normal(0, 1.5, 2)])
        pictures.append(photograph(cv2.warpAffine(ground, M, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT), rng))
    assert not any(follow(pictures))


def test_light_that_flickers_makes_nothing_move():
    rng = np.random.default_rng(3)
    ground = landscape(rng)
    draw(ground, 220, 80, 6, 5)
    pictures = [photograph(ground * (0.9 + 0.1 * np.sin(2 * np.pi * 3 * i / RATE)), rng) for i in range(60)]
    assert not any(follow(pictures))


def test_the_cameras_shift_is_measured():
    rng = np.random.default_rng(4)
    ground = landscape(rng)
    camera, total = CameraMotion(), np.zeros(2)
    for i in range(40):
        total = total + rng.uniform(-3, 3, 2) * (i > 0)
        M = np.column_stack([np.eye(2), total])
        image = photograph(cv2.warpAffine(ground, M, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT), rng)
        shift = camera.update(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), i / RATE)
        assert not camera.jumped
    # A tenth of a pixel a frame, in 40 frames as a random walk.
    assert np.linalg.norm(shift - total) < 0.1 * np.sqrt(40)


def test_writing_in_the_corners_of_a_shaken_image_does_not_stand_for_the_scene():
    """It extends over more of the image than the scene, but has few corners."""
    rng = np.random.default_rng(14)
    scene = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH, 3)), (0, 0), 2.0)
    scene = 110 + 30 * scene / scene.std()
    writing = rng.choice([20.0, 230.0], (8, 24, 1)).repeat(2, axis=0).repeat(2, axis=1)
    camera = CameraMotion()
    for i in range(20):
        at = np.array([0.0, 0.0]) if i % 2 else np.array([2.6, -2.3])
        picture = cv2.warpAffine(
            scene, np.column_stack([np.eye(2), at]), (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT
        )
        for rows in (slice(None, 16), slice(-16, None)):
            for columns in (slice(None, 48), slice(-48, None)):
                picture[rows, columns] = writing
        shift = camera.update(cv2.cvtColor(photograph(picture, rng), cv2.COLOR_BGR2GRAY), i / RATE)
        assert not camera.jumped
        assert np.abs(shift - (at - [2.6, -2.3])).max() < 0.5


def test_clouds_that_drift_do_not_move_the_scene():
    rng = np.random.default_rng(15)
    scene = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH, 3)), (0, 0), 2.0)
    scene = 110 + 30 * scene / scene.std()
    clouds = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT // 3, WIDTH, 3)), (0, 0), 6.0)
    clouds, camera = 180 + 20 * clouds / clouds.std(), CameraMotion()
    for i in range(500):  # for 20 s
        M = np.column_stack([np.eye(2), [-0.25 * i, 0.0]])
        scene[: HEIGHT // 3] = cv2.warpAffine(clouds, M, (WIDTH, HEIGHT // 3), borderMode=cv2.BORDER_WRAP)
        shift = camera.update(cv2.cvtColor(photograph(scene, rng), cv2.COLOR_BGR2GRAY), i / RATE)
        assert np.abs(shift).max() < 0.3


def test_a_cut_is_noticed_and_a_sky_without_corners_stands():
    rng = np.random.default_rng(5)
    camera = CameraMotion()
    for i, seed in enumerate((6, 6, 6, 7)):
        picture = photograph(landscape(np.random.default_rng(seed)), rng)
        camera.update(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), i / RATE)
    assert camera.jumped
    camera = CameraMotion()
    for i in range(5):
        shift = camera.update(np.full((HEIGHT, WIDTH), 180, np.uint8), i / RATE)
    assert shift.tolist() == [0, 0]
    assert not camera.jumped
    for i, jumped in ((5, True), (6, False)):  # the film goes on elsewhere
        picture = photograph(landscape(np.random.default_rng(6)), rng)
        camera.update(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), i / RATE)
        assert camera.jumped == jumped


def test_a_large_thing_that_passes_before_plain_ground_is_no_cut():
    """As a near car does, whose front and roof move unlike: it has most of the corners, and asphalt some stones."""
    rng = np.random.default_rng(3)
    ground = np.full((HEIGHT, WIDTH, 3), 110.0)
    for u, v in rng.uniform((4, 4), (WIDTH - 4, HEIGHT - 4), (60, 2)):
        draw(ground, u, v, 5, 5, grey=40.0)
    near, far = (60 * cv2.GaussianBlur(rng.normal(0, 1, (90, 150, 3)), (0, 0), 2.0) for _ in range(2))
    camera = CameraMotion()
    for i in range(40):
        picture = ground.copy()
        for part, top, left in ((near, 120, 8 * i - 150), (far, 30, 4 * i - 100)):
            a, b = max(0, left), min(WIDTH, left + 150)
            picture[top : top + 90, a:b] = 120 + 4 * part[:, a - left : b - left]
        shift = camera.update(cv2.cvtColor(photograph(np.clip(picture, 0, 255), rng), cv2.COLOR_BGR2GRAY), i / RATE)
        assert not camera.jumped
        assert np.abs(shift).max() < 1.0


def test_birds_that_fly_apart_before_a_plain_sky_are_no_cut():
    """They have all of the corners, and no two fly the same way."""
    rng = np.random.default_rng(16)
    birds = [120 + 60 * cv2.GaussianBlur(rng.normal(0, 1, (40, 40, 3)), (0, 0), 1.5) for _ in range(9)]
    ways = np.array([(np.cos(a), np.sin(a)) for a in np.linspace(0, 2 * np.pi, 9, endpoint=False)])
    camera = CameraMotion()
    for i in range(12):
        picture = np.full((HEIGHT, WIDTH, 3), 170.0)
        for bird, way in zip(birds, ways, strict=True):
            u, v = np.rint((WIDTH / 2, HEIGHT / 2) + way * (45 + 6 * i) - 20).astype(int).tolist()
            seen = picture[max(v, 0) : v + 40, max(u, 0) : u + 40]
            seen[:] = bird[-seen.shape[0] :, -seen.shape[1] :]
        camera.update(cv2.cvtColor(photograph(np.clip(picture, 0, 255), rng), cv2.COLOR_BGR2GRAY), i / RATE)
        assert not camera.jumped


def test_a_flock_before_a_plain_sky_does_not_make_the_scene_jump():
    """A part of it flies alike from one image to the next, and not for half a second."""
    rng = np.random.default_rng(18)
    birds = [120 + 60 * cv2.GaussianBlur(rng.normal(0, 1, (12, 12, 3)), (0, 0), 1.0) for _ in range(14)]
    starts = rng.uniform((20, 20), (WIDTH - 32, HEIGHT - 32), (14, 2))
    angles, speeds = rng.uniform(0, 1.2, 14), rng.uniform(2.0, 5.0, 14)
    ways = speeds[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    camera, before = CameraMotion(), np.zeros(2)
    for i in range(30):
        picture = np.full((HEIGHT, WIDTH, 3), 170.0)
        for bird, start, way in zip(birds, starts, ways, strict=True):
            u, v = np.rint((start + i * way) % (WIDTH - 12, HEIGHT - 12)).astype(int).tolist()
            picture[v : v + 12, u : u + 12] = bird
        shift = camera.update(cv2.cvtColor(photograph(np.clip(picture, 0, 255), rng), cv2.COLOR_BGR2GRAY), i / RATE)
        assert np.abs(shift - before).max() < 5.0  # no bird flies farther in a frame
        before = shift


def test_black_bars_beside_a_picture_do_not_make_a_target_of_it():
    rng = np.random.default_rng(17)
    pictures = []
    for _ in range(round(RATE)):
        picture = np.full((HEIGHT, WIDTH, 3), 120.0)
        picture[:, :6] = picture[:, -6:] = picture[HEIGHT // 2 - 2 : HEIGHT // 2 + 2] = 20.0
        pictures.append(photograph(picture, rng))
    detector = make_detector(TargetProfile(4.0, "width", 160.0), RATE)
    for i, picture in enumerate(pictures):
        found = detector.detect(Frame(picture, i / RATE)).boxes
        assert all((each.size_px < (WIDTH, HEIGHT)).any() for each in found)


def test_a_bird_alone_in_the_sky_is_not_taken_for_the_cameras_motion():
    """Nothing but sky: the strongest corners are the bird's own and the codec's."""
    rng = np.random.default_rng(12)
    pictures = []
    for i in range(50):
        picture = np.full((HEIGHT, WIDTH, 3), 170.0)
        draw(picture, 60 + 3 * i, 80 + 2 * np.sin(i), 8, 5)
        coded = cv2.imencode(".jpg", photograph(picture, rng), [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
        pictures.append(cv2.imdecode(coded, cv2.IMREAD_COLOR))
    tracks = follow(pictures)
    for i in range(15, 50):
        (track,) = tracks[i]
        assert np.abs(track.center_px - (60 + 3 * i, 80)).max() < 5


def test_a_cut_finds_nothing_until_the_new_scene_has_been_seen_for_a_while():
    def paint(picture, i):
        draw(picture, 220, 80, 8, 5)

    found = watch(film(30, paint, seed=8) + film(30, paint, seed=9))
    assert not any(box.score > 0.5 for boxes in found[30:] for box in boxes)


def test_after_a_cut_what_stands_is_no_target_and_what_flies_is_one_soon():
    def paint(picture, i):
        draw(picture, 220, 80, 8, 5)
        draw(picture, 40 + 3 * i, 50, 8, 5)

    found = [[box for box in boxes if box.score > 0.5] for boxes in watch(film(30, paint, seed=8) + film(30, paint, 9))]
    assert not any(found[30:34])
    for i in range(4, 30):
        for box in found[30 + i]:
            assert box.center_px == pytest.approx([40 + 3 * i, 50], abs=PLACE_PX)
    assert all(found[40:])  # 0.4 s after the cut


def test_frames_that_repeat_and_times_that_jump():
    """The same picture again tells nothing; a clock that jumps makes the detector learn anew; neither ends it."""

    def paint(picture, i):
        draw(picture, 60 + 3 * i, 80, 8, 5)

    pictures = film(24, paint)
    detector = make_detector(SPECK, RATE)
    for i, picture in enumerate(pictures):
        found = detector.detect(Frame(picture, i / RATE)).boxes
    assert found
    assert detector.detect(Frame(pictures[-1], 24 / RATE)).boxes == []
    for t in (100.0, 1.0, 1.0, 1.04):
        assert (
            detector.detect(Frame(photograph(landscape(np.random.default_rng(0)), np.random.default_rng(1)), t)).boxes
            == []
        )
    with pytest.raises(CotargetError, match="320x240 to 200x100"):
        detector.detect(Frame(np.zeros((100, 200, 3), np.uint8), 2.0))


def test_pictures_too_small_dark_or_bright_are_no_error():
    for value in (0, 255):
        for shape in ((8, 8, 3), (50, 60, 3), (HEIGHT, WIDTH, 3)):
            pictures = [np.full(shape, value, np.uint8) for _ in range(40)]
            for i, picture in enumerate(pictures):
                picture[0, i % 8] ^= 1  # differs from the last one, so that it is searched
            assert watch(pictures) == [[]] * 40
