"""A target's profile alone decides how it is detected, confirmed, filtered and matched; an own target is no person."""

from dataclasses import replace

import numpy as np
import pytest

from cotarget.config import DEFAULT_TARGETS, TargetProfile, parse_config
from cotarget.detection import make_detector
from cotarget.rig import Frame
from cotarget.tracking.track import tracking_settings

RATE = 25.0
CAR = TargetProfile(4.2, "width", 200.0, "motion")


def test_an_own_target_without_further_keys_may_move_as_it_likes_and_have_any_shape():
    table = {"size": 4.2, "dimension": "width", "wanted_px": 200.0, "detector": "motion"}
    assert parse_config({"targets": {"car": table}}).target("car") == CAR
    assert (CAR.motion, CAR.shape, CAR.matcher) == ("general", None, "outline")


@pytest.mark.parametrize(
    ("shape", "motion", "found"), [(None, "general", True), (0.4, "walking", False)], ids=["unknown", "upright"]
)
def test_a_wide_target_is_detected_unless_its_profile_says_that_it_is_upright(shape, motion, found):
    detector = make_detector(replace(CAR, shape=shape, motion=motion), RATE)
    rng, boxes = np.random.default_rng(0), []
    for i in range(40):
        image = rng.normal(110, 2, (120, 320, 3)).clip(0, 255).astype(np.uint8)
        if i >= 20:
            left = 8 * (i - 18)
            image[60:84, left : left + 60] = (30, 30, 200)  # 60 x 24 px, which is no person
        boxes = [box for box in detector.detect(Frame(image, i / RATE)).boxes if box.score > 0.1]
    assert bool(boxes) == found
    assert not found or boxes[0].size_px == pytest.approx([60, 24], abs=6)


@pytest.mark.parametrize("name", DEFAULT_TARGETS)
def test_tracks_of_an_own_detector_are_confirmed_by_their_number(name):
    settings = tracking_settings(replace(DEFAULT_TARGETS[name], detector="own.py:find"))
    assert (settings.confirm_travel, settings.confirm_score) == (0.0, 0.0)


@pytest.mark.parametrize(("dimension", "box", "vertical", "sides"), [
    ("height", (3.0, 1.0), True, (3.0, 1.0)), ("width", (1.0, 2.0), False, (1.0, 2.0)),
    ("wingspan", (4.0, 1.0), False, (1.0, 0.25)), ("wingspan", (1.0, 4.0), True, (0.25, 1.0)),
])  # fmt: skip
def test_the_dimension_of_a_box(dimension, box, vertical, sides):
    profile = replace(CAR, dimension=dimension)
    assert profile.is_vertical(*box) == vertical
    assert profile.sides(box[0] / box[1]) == pytest.approx(sides)
