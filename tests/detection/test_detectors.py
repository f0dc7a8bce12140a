"""Detectors on drawn pictures: accuracy by colour, what motion must not see, and boxes of a function of one's own."""

import dataclasses
import re

import cv2
import numpy as np
import pytest

from cotarget.config import DEFAULT_TARGETS, TargetProfile
from cotarget.detection import (
    AutoDetector,
    ColorTemplateDetector,
    ExternalDetector,
    Mog2Detector,
    color_template,
    make_detector,
)
from cotarget.detection.color_template import LARGEST_FITTED_PX, MARGIN_PX, MOST_FITTED, fit_template
from cotarget.errors import ConfigError, CotargetError
from cotarget.rig import Frame
from cotarget.tracking.track import AUTO
from tests.support.noise import noisy

RATE = 25.0
NOISE = 2.0  # grey levels, as the simulated sensor's
JPEG = 90
SUPERSAMPLING = 16
WIDTH, HEIGHT = 96, 72  # of the small pictures that the colour detector is tried on
BOOK_PX = (16.0, 12.0)  # as in the wide view at 10 m
ACCURACY_PX = 0.3  # rms of centre and size: 2 % of the book's width, that is 0.2 m of 10


def cover():
    """A red cover with a white panel off its middle, so that its colour's centroid is not its centre."""
    image = np.full((120, 160, 3), (35, 25, 190), np.uint8)
    image[60:110, 90:150] = 235
    image[70:100, 100:140] = 20
    return image


def photograph(image, rng):
    """Sensor noise and JPEG."""
    coded = cv2.imencode(".jpg", noisy(image, rng, NOISE), [cv2.IMWRITE_JPEG_QUALITY, JPEG])[1]
    return cv2.imdecode(coded, cv2.IMREAD_COLOR)


def book_picture(center, size, turn, rng):
    """The cover at a sub-pixel place on a wall with a gradient: pasted 16 times too large, then averaged."""
    s = SUPERSAMPLING
    ramp = np.linspace(100, 170, WIDTH * s)[None, :, None] * np.array([0.8, 0.9, 1.0])
    wall = np.broadcast_to(ramp, (HEIGHT * s, WIDTH * s, 3)).astype(np.uint8)
    template = cover()
    h, w = template.shape[:2]
    A = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ np.diag(np.array(size) * s / (w, h))
    shift = (np.array(center) + 0.5) * s - 0.5 - A @ [(w - 1) / 2, (h - 1) / 2]
    M = np.column_stack([A, shift])
    big = cv2.warpAffine(template, M, (WIDTH * s, HEIGHT * s), flags=cv2.INTER_NEAREST)
    there = cv2.warpAffine(np.ones((h, w), np.uint8), M, (WIDTH * s, HEIGHT * s), flags=cv2.INTER_NEAREST)
    big = np.where(there[..., None] > 0, big, wall)
    small = cv2.resize(big, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    return photograph(cv2.GaussianBlur(small, (0, 0), 0.5), rng)


@pytest.mark.parametrize("turn_deg", [pytest.param(0.0, marks=pytest.mark.slow), 6.0])
def test_colour_is_located_to_a_fraction_of_a_pixel(turn_deg):
    rng = np.random.default_rng(0)
    detector = ColorTemplateDetector(cover())
    errors = []
    for _ in range(60):
        center, size = rng.uniform((30, 25), (65, 45)), np.array(BOOK_PX) * rng.uniform(0.9, 1.2)
        found = detector.detect(Frame(book_picture(center, size, np.radians(turn_deg), rng), 0.0)).boxes
        assert len(found) == 1
        assert found[0].score > 0.8
        errors.append([*(found[0].center_px - center), *(found[0].size_px - size)])
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    print(f"turned {turn_deg:g} degrees: rms of u, v, width, height: {np.round(rms, 3)} px")
    assert rms.max() < ACCURACY_PX


def on_a_wall(*things):
    """A picture of 640x480 with pictures (h, w, 3) at their (left, top), as a camera has it."""
    image = np.full((480, 640, 3), (120, 130, 140), np.uint8)
    for thing, left, top in things:
        image[top : top + thing.shape[0], left : left + thing.shape[1]] = thing
    return photograph(cv2.GaussianBlur(image, (0, 0), 0.5), np.random.default_rng(1))


def book_of(width):
    return cv2.resize(cover(), (width, width * 3 // 4), interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize("width", [40, 60, 120, 200, 310])
def test_a_large_book_is_located_as_well_and_by_no_more_pixels(width, monkeypatch):
    fitted = []

    def fit(template, patch, center, size):
        fitted.append(patch.shape)
        return fit_template(template, patch, center, size)

    monkeypatch.setattr(color_template, "fit_template", fit)
    (found,) = ColorTemplateDetector(cover()).detect(Frame(on_a_wall((book_of(width), 107, 63)), 0.0)).boxes
    height = width * 3 // 4
    np.testing.assert_allclose(found.center_px, (107 + (width - 1) / 2, 63 + (height - 1) / 2), atol=ACCURACY_PX)
    np.testing.assert_allclose(found.size_px, (width, height), atol=ACCURACY_PX)
    ((rows, columns),) = fitted
    assert max(rows, columns) <= LARGEST_FITTED_PX + 2 * MARGIN_PX + 3  # and a pixel for each rounding


def test_a_large_book_at_the_border_is_located():
    (found,) = ColorTemplateDetector(cover()).detect(Frame(on_a_wall((book_of(200), 440, 330)), 0.0)).boxes
    assert found.clipped
    np.testing.assert_allclose(found.center_px, (440 + 199 / 2, 330 + 149 / 2), atol=1.0)


@pytest.mark.parametrize("size", [10, 24, 40])
def test_among_a_hundred_red_things_the_book_is_found_by_a_few_fits(size, monkeypatch):
    fits = []
    monkeypatch.setattr(color_template, "fit_template", lambda *args: fits.append(1) or fit_template(*args))
    red = np.full((size * 3 // 4, size, 3), (35, 25, 190), np.uint8)
    red[:, : size // 4] = (60, 40, 150)
    things = [(red, 20 + 60 * (k % 10), 10 + 47 * (k // 10)) for k in range(100)]
    things[37] = (book_of(16), *things[37][1:])
    best = ColorTemplateDetector(cover()).detect(Frame(on_a_wall(*things), 0.0)).boxes[0]
    np.testing.assert_allclose(best.center_px, np.add(things[37][1:], (15 / 2, 11 / 2)), atol=ACCURACY_PX)
    assert len(fits) == MOST_FITTED


def test_another_colour_is_not_taken_for_the_target():
    rng = np.random.default_rng(1)
    image = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    for k, other in enumerate([(190, 25, 35), (25, 190, 35), (20, 120, 160), (250, 250, 250), (0, 0, 0)]):
        image[30:42, 5 + 18 * k : 18 + 18 * k] = other
    assert ColorTemplateDetector(cover()).detect(Frame(photograph(image, rng), 0.0)).boxes == []


def test_a_grey_or_missing_template_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="grey"):
        ColorTemplateDetector(np.full((10, 10, 3), 128, np.uint8))
    badge = np.full((10, 10, 3), 128, np.uint8)
    badge[3:7, 3:7] = (25, 35, 230)  # 16 % of it strongly red
    with pytest.raises(ConfigError, match="cut it to the coloured part"):
        ColorTemplateDetector(badge)
    book = dataclasses.replace(DEFAULT_TARGETS["book"], template=None)
    with pytest.raises(ConfigError, match="template"):
        make_detector(book, RATE)
    (tmp_path / "text.png").write_text("no picture")
    for name, said in (("nothing", "no such file"), ("text", "is not a picture"), ("", "is not a picture")):
        path = tmp_path / f"{name}.png" if name else tmp_path
        with pytest.raises(ConfigError, match=re.escape(f"{path}: {said}; a target's template is a PNG or JPEG of it")):
            make_detector(dataclasses.replace(book, template=path), RATE)


def sky(rng, shape=(240, 320)):
    """A bright, slightly noisy sky."""
    return np.clip(rng.normal((210, 180, 150), NOISE, (*shape, 3)), 0, 255).astype(np.uint8)


def ground(rng, shape=(240, 320)):
    """Grass or asphalt, of which no two places are alike."""
    return cv2.resize(rng.uniform(70, 120, (shape[0] // 4, shape[1] // 4, 3)), shape[::-1])


def watch(detector, pictures, rate=RATE):
    """The boxes of each picture that could begin a track."""
    found = [detector.detect(Frame(picture, i / rate)).boxes for i, picture in enumerate(pictures)]
    return [[box for box in boxes if box.score >= AUTO["start_score"]] for boxes in found]


def highest(boxes):
    return max(boxes, key=lambda box: box.size_px[1])


def usual(name):
    return make_detector(DEFAULT_TARGETS[name], RATE)


def test_a_small_dark_bird_is_boxed():
    rng = np.random.default_rng(3)
    pictures, truth = [], []
    for i in range(50):
        picture = sky(rng)
        u, v = 20 + 5 * i, 60 + 2 * i
        picture[v - 2 : v + 3, u - 6 : u + 7] = 40
        pictures.append(picture)
        truth.append((u, v))
    found = watch(usual("bird"), pictures)
    for (u, v), boxes in list(zip(truth, found, strict=True))[25:]:
        assert len(boxes) == 1
        np.testing.assert_allclose(boxes[0].center_px, (u, v), atol=0.5)
        np.testing.assert_allclose(boxes[0].size_px, (13, 5), atol=1.0)  # whole pixels; noise may add one
        assert not boxes[0].clipped


def test_a_box_at_the_border_is_marked():
    rng = np.random.default_rng(4)
    pictures = [sky(rng) for _ in range(30)]
    pictures[-1][100:110, :8] = 40
    (box,) = watch(usual("bird"), pictures)[-1]
    assert box.clipped
    np.testing.assert_allclose(box.center_px, (3.5, 104.5), atol=0.5)


def test_a_shadow_is_not_part_of_a_person():
    rng = np.random.default_rng(6)
    pictures, grass = [], ground(rng)
    for i in range(60):
        picture = np.clip(grass + rng.normal(0, NOISE, grass.shape), 0, 255)
        u = 30 + 3 * (i - 20)
        if i < 20:  # the ground alone, to be learnt
            pictures.append(picture.astype(np.uint8))
            continue
        picture[170:182, u + 12 : u + 60] *= 0.7
        picture[100:180, u - 12 : u + 13] = (150, 60, 30)
        pictures.append(picture.astype(np.uint8))
    found = watch(usual("person"), pictures)
    for i, boxes in list(enumerate(found))[25:]:
        box = highest(boxes)
        np.testing.assert_allclose(box.center_px, (30 + 3 * (i - 20), 139.5), atol=2.0)
        np.testing.assert_allclose(box.size_px, (25, 80), atol=3.0)


def with_a_shadows_edge(length):
    """Pictures of a person and of something thin behind."""
    rng = np.random.default_rng(17)
    pictures, grass = [], ground(rng)
    for i in range(60):
        picture = grass + rng.normal(0, NOISE, grass.shape)
        if i >= 20:
            u = 30 + 2 * (i - 20)
            picture[100:180, u - 12 : u + 13] = (150, 60, 30)
            picture[160:165, u : u + length] = (125, 150, 140)
        pictures.append(np.clip(picture, 0, 255).astype(np.uint8))
    return pictures


@pytest.mark.parametrize("length", [60, 120])
def test_what_lies_flat_is_no_part_of_a_person(length):
    """The edge of a shadow that drifts by behind, as far as the knees are high."""
    for i, boxes in list(enumerate(watch(usual("person"), with_a_shadows_edge(length))))[25:]:
        box = highest(boxes)
        np.testing.assert_allclose(box.center_px, (30 + 2 * (i - 20), 139.5), atol=3.0)
        np.testing.assert_allclose(box.size_px, (25, 80), atol=6.0)


@pytest.mark.parametrize(("kind", "width"), [("mog2", 72), ("motion", 25)])
def test_the_papers_detector_is_the_mixture_alone(kind, width):
    """It takes what lies flat for a part of the person, where both are new."""
    target = dataclasses.replace(DEFAULT_TARGETS["person"], detector=kind)
    (box,) = watch(make_detector(target, RATE), with_a_shadows_edge(60)[:21])[-1]
    np.testing.assert_allclose(box.size_px, (width, 80), atol=3.0)


def test_two_side_by_side_are_in_one_box():
    rng = np.random.default_rng(18)
    picture = rng.normal((90, 110, 100), NOISE, (240, 320, 3)).clip(0, 255).astype(np.uint8)
    there = picture.copy()
    there[100:180, 100:125] = there[104:180, 123:150] = (150, 60, 30)
    (box,) = watch(usual("person"), [picture] * 20 + [there])[-1]
    np.testing.assert_allclose(box.size_px, (50, 80), atol=2.0)


@pytest.mark.parametrize("part", [1.0, 0.4])
def test_a_person_is_seen_while_the_sun_comes_out(part):
    """Over the whole picture or a part of its width, by a quarter within half a second."""
    rng = np.random.default_rng(16)
    pictures, grass = [], ground(rng)
    for i in range(120):
        picture = grass.copy()
        picture[100:180, 18 + 2 * (i - 20) : 43 + 2 * (i - 20)] = (150, 60, 30)
        picture[:, : round(part * 320)] *= 1 + 0.25 * np.clip((i - 60) / 12, 0, 1)
        pictures.append(noisy(picture, rng, NOISE))
    for i, boxes in list(enumerate(watch(usual("person"), pictures)))[25:]:
        box = highest(boxes)
        np.testing.assert_allclose(box.center_px, (30 + 2 * (i - 20), 139.5), atol=2.0)
        np.testing.assert_allclose(box.size_px, (25, 80), atol=4.0)


def test_light_that_changes_everywhere_is_no_target():
    rng = np.random.default_rng(7)
    pictures = [sky(rng) for _ in range(30)] + [np.clip(sky(rng) * 0.6, 0, 255).astype(np.uint8)]
    assert watch(usual("bird"), pictures)[-1] == []


@pytest.mark.parametrize("name", ["mog2", "motion", "speck", "auto"])
def test_an_image_of_one_pixel_is_no_error(name):
    detector = make_detector(dataclasses.replace(DEFAULT_TARGETS["bird"], detector=name), 25.0)
    for i in range(20):
        assert detector.detect(Frame(np.full((1, 1, 3), 12 * i, np.uint8), i / 25)).boxes == []


def test_times_that_repeat_or_jump_back_do_no_harm():
    rng = np.random.default_rng(8)
    detector = usual("bird")
    for t in (0.0, 0.0, 5.0, 1.0, 1.0, 1.04):
        assert detector.detect(Frame(sky(rng), t)).boxes == []


@pytest.mark.parametrize("name", ["bird", "person"])
def test_another_image_size_is_an_error(name):
    rng = np.random.default_rng(9)
    detector = usual(name)
    detector.detect(Frame(sky(rng), 0.0))
    with pytest.raises(CotargetError, match="320x240 to 200x100"):
        detector.detect(Frame(sky(rng, (100, 200)), 0.1))


@pytest.mark.parametrize("what", ["the camera is nudged", "a light goes on"])
def test_who_walks_is_seen_again_soon_after_the_whole_picture_has_changed(what):
    """By itself the mixture would take as long as a colour takes to become background: six of its twenty seconds."""
    rng, at_s, seen = np.random.default_rng(4), 3.0, []
    grass = np.clip(cv2.GaussianBlur(rng.normal(0, 1, (260, 340, 3)), (0, 0), 2) * 180 + 72, 0, 153)
    detector = usual("person")
    for i in range(round(5 * RATE)):
        t, nudge, light = i / RATE, 0, 1.0
        if t >= at_s:
            nudge, light = (6, 1.0) if "nudged" in what else (0, 1.6)
        picture = grass[nudge : nudge + 240, nudge : nudge + 320] * light
        u = 20 + 2 * i
        picture[100:180, u : u + 26] = 20.0
        found = detector.detect(Frame(photograph(picture, rng), t))
        there = [
            each for each in found.boxes if abs(each.center_px[0] - u - 12.5) < 6 and abs(each.center_px[1] - 139.5) < 6
        ]
        seen.append(bool(there))
    changed = round(at_s * RATE)
    assert all(seen[changed - 20 : changed])
    assert all(
        seen[changed + round(1.0 * RATE) :]
    )  # after half a second to learn, and to be clear of where he was then


def test_the_kind_of_detector_follows_the_target(tmp_path):
    kinds = {"auto": AutoDetector, "motion": AutoDetector, "speck": AutoDetector, "mog2": Mog2Detector}
    for name, kind in kinds.items():
        assert isinstance(make_detector(dataclasses.replace(DEFAULT_TARGETS["bird"], detector=name), RATE), kind)
    cv2.imwrite(str(tmp_path / "cover.png"), cover())
    red = TargetProfile(0.2, "width", 160.0, "colour", template=tmp_path / "cover.png")
    assert isinstance(make_detector(red, RATE), ColorTemplateDetector)


@pytest.mark.parametrize(("name", "height", "seen"), [("motion", 14, False), ("motion", 40, True), ("auto", 14, True)])
def test_motion_lists_nothing_small(name, height, seen):
    rng, found = np.random.default_rng(11), []
    detector, grass = (
        make_detector(dataclasses.replace(DEFAULT_TARGETS["person"], detector=name), RATE),
        ground(rng, (480, 640)),
    )
    for i in range(60):
        picture = grass.copy()
        picture[300 : 300 + height, 40 + 3 * i : 40 + 3 * i + height // 3] = (150, 60, 30)
        boxes = detector.detect(Frame(noisy(picture, rng, NOISE), i / RATE)).boxes
        found.append(any(abs(box.center_px[0] - 40 - 3 * i) < 20 for box in boxes))
    assert np.mean(found[20:]) > 0.9 if seen else np.mean(found[20:]) < 0.1


FRAME = Frame(np.zeros((50, 80, 3), np.uint8), 0.0)


def found(*boxes):
    return ExternalDetector(lambda image: boxes).detect(FRAME).boxes


def test_boxes_become_detections_the_surest_first():
    """A lit pixel at column 3 and row 5 is the box (3, 5, 1, 1) with its centre there."""
    sure, unsure = found((3, 5, 1, 1, 0.2), (10, 20, 5, 4, 0.9))
    np.testing.assert_array_equal(sure.center_px, (12.0, 21.5))
    np.testing.assert_array_equal(sure.size_px, (5, 4))
    assert (sure.score, sure.clipped) == (0.9, False)
    np.testing.assert_array_equal(unsure.center_px, (3, 5))
    assert found((10, 20, 5, 4))[0].score == 0.5


def test_boxes_are_cut_to_the_image():
    (box,) = found((-4, 10, 10, 8, 1.0), (100, 10, 5, 5, 1.0))
    np.testing.assert_array_equal(box.size_px, (6, 8))
    np.testing.assert_array_equal(box.center_px, (2.5, 13.5))
    assert box.clipped


NO_LISTS = [None, 5, "boxes", (1, 2, 3, 4), np.ones(4), {"boxes": [(1, 2, 3, 4)]}]
NO_BOXES = [(1, 2, 3), (1, 2, 0, 4), (1, 2, 3, float("nan")), (1, 2, 3, 4, 1.5), "box", None, [1, [2, 3]]]
NO_ARRAYS = [np.full((2, 4), np.nan), np.ones((2, 3)), np.ones((2, 30, 4)), [[1, 2, 3, np.inf]]]


@pytest.mark.parametrize("returned", [*NO_LISTS, *([box] for box in NO_BOXES), *NO_ARRAYS])
def test_what_is_no_list_of_boxes_is_refused_in_one_line(returned):
    with pytest.raises(CotargetError, match=r"has to return a list of boxes, empty where|a box is") as caught:
        ExternalDetector(lambda image: returned).detect(FRAME)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("nothing", [[], (), np.zeros(0), np.zeros((0, 4)), iter(())])
def test_nothing_found(nothing):
    assert ExternalDetector(lambda image: nothing).detect(FRAME).boxes == []


def test_the_function_gets_the_picture():
    pictures = []
    ExternalDetector(lambda image: pictures.append(image) or []).detect(FRAME)
    assert pictures[0] is FRAME.image
