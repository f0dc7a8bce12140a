"""A target's profile alone decides how it is detected, confirmed, filtered and matched; an own target is no person."""

import math
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
    target = replace(CAR, shape=shape, motion=motion)
    detector, least = make_detector(target, RATE), tracking_settings(target).confirm_score / 2  # after travel
    rng, boxes = np.random.default_rng(0), []
    for i in range(40):
        image = rng.normal(110, 2, (120, 320, 3)).clip(0, 255).astype(np.uint8)
        if i >= 20:
            left = 8 * (i - 18)
            image[60:84, left : left + 60] = (30, 30, 200)  # 60 x 24 px, which is no person
        boxes = [box for box in detector.detect(Frame(image, i / RATE)).boxes if box.score > least]
    assert bool(boxes) == found
    assert not found or boxes[0].size_px == pytest.approx([60, 24], abs=6)


@pytest.mark.parametrize("name", DEFAULT_TARGETS)
def test_tracks_of_an_own_detector_are_confirmed_by_their_number(name):
    settings = tracking_settings(replace(DEFAULT_TARGETS[name], detector="own.py:find"))
    assert (settings.confirm_travel, settings.confirm_score) == (0.0, 0.0)


@pytest.mark.parametrize(("dimension", "box", "length", "sides"), [
    ("height", (3.0, 1.0), 1.0, (3.0, 1.0)), ("width", (1.0, 2.0), 1.0, (1.0, 2.0)),
    ("wingspan", (4.0, 1.0), 4.0, (1.0, 0.25)), ("wingspan", (1.0, 4.0), 4.0, (0.25, 1.0)),
])  # fmt: skip
def test_the_dimension_of_a_box(dimension, box, length, sides):
    profile = replace(CAR, dimension=dimension)
    assert profile.length(*box) == length
    assert profile.sides(box[0] / box[1]) == pytest.approx(sides)


@pytest.mark.parametrize("roll_deg", [0, 30, -30, 45, 90, -90])
@pytest.mark.parametrize(("dimension", "shape"), [("height", 0.4), ("width", 2.5), ("width", 0.4)])
def test_a_rolled_camera_sees_the_own_length_of_an_ellipse(dimension, shape, roll_deg):
    """A target 1 m high and `shape` m wide, whose box the camera sees turned; and one that stands upright in it."""
    profile = replace(CAR, dimension=dimension, shape=shape)
    roll = math.radians(roll_deg)
    box = math.hypot(shape * math.cos(roll), math.sin(roll)), math.hypot(shape * math.sin(roll), math.cos(roll))
    own = 1.0 if dimension == "height" else shape
    assert profile.length(*box, roll) == pytest.approx(own)
    assert profile.turn(*box, roll) == pytest.approx(roll, abs=1e-6)
    assert profile.length(shape, 1.0, roll) == pytest.approx(own)  # the head is mounted sideways, not the camera
    assert profile.turn(shape, 1.0, roll) == pytest.approx(0.0, abs=1e-6)


def test_a_stride_is_no_roll():
    """The head leans by a degree; a walker's box is half as wide again with each step."""
    assert [DEFAULT_TARGETS["person"].turn(width, 1.0, math.radians(1)) for width in (0.35, 0.4, 0.6)] == [
        0.0,
        0.0,
        0.0,
    ]


def test_without_a_usual_shape_the_nearest_side_is_the_length():
    profile = replace(CAR, dimension="height")
    assert [profile.length(3.0, 1.0, math.radians(roll)) for roll in (0, 30, 60, 90)] == [1.0, 1.0, 3.0, 3.0]
