"""What the page gets: the newest picture after it has drawn the last, with everything that is said of it."""

import dataclasses
import json
import math
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from cotarget.page.messages import BadMessageError, pack, parse
from cotarget.pipeline import State
from cotarget.rig import Frame
from tests.support.page_client import SPEC, browser, picture, say, served, status, step, until

QUIET_S = 0.5  # time in which a picture would come
GREY = 3  # of a JPEG


@pytest.fixture
def at():
    with served() as made:
        yield made


@pytest.mark.wire
def test_the_next_picture_comes_only_after_the_last_was_drawn_and_is_the_newest(at):
    with browser(at) as mine:
        status(mine)
        at.page.show(step(1), SPEC)
        assert picture(mine)[0]["n"] == 1
        for n in range(2, 30):
            at.page.show(step(n), SPEC)
        assert picture(mine, QUIET_S) is None
        say(mine, do="drawn", n=1)
        table, jpegs = picture(mine)
        assert table["n"] == 29
        shown = cv2.imdecode(np.frombuffer(jpegs["fixed"], np.uint8), cv2.IMREAD_COLOR)
        assert shown.shape == (480, 640, 3)
        assert abs(float(shown.mean()) - 29) < GREY
        say(mine, do="drawn", n=29)
        assert picture(mine, QUIET_S) is None  # there is no newer one


@pytest.mark.wire
def test_a_browser_that_reads_nothing_delays_nobody(at):
    with browser(at, who="asleep"), browser(at, who="b") as mine:
        for n in range(1, 40):
            at.page.show(step(n), SPEC)
            until(lambda: picture(mine)[0]["n"] >= n)  # noqa: B023
            say(mine, do="drawn", n=n)


def test_a_picture_says_what_is_shown():
    tracks = (
        SimpleNamespace(id=7, center_px=np.array([100.0, 50.04]), whole_px=np.array([9.0, 8.0]), reported=True),
        SimpleNamespace(id=8, center_px=np.array([10.0, 5.0]), whole_px=np.array([9.0, 8.0]), reported=False),
    )
    covariance = np.array([[25.0, 0.0], [0.0, 4.0]])
    seen = SimpleNamespace(covariance=covariance, offset_px=np.array([10.0, -5.0]), size_px=80.0)
    found = SimpleNamespace(center_px=np.array([330.04, 235.0]), t=3 / 25)
    shown = step(
        3, tracks=tracks, target=tracks[0], expected=seen, found=found, state=State.FOLLOWING, reason="<b>why</b>"
    )
    data = pack(shown, 3, SPEC, 5, 1.5)
    size = int.from_bytes(data[:4], "big")
    table = json.loads(data[4 : 4 + size])
    assert table["tracks"] == [[7, 100.0, 50.0, 9.0, 8.0]]
    head = table["heads"]["head"]
    assert (head["state"], head["reason"], head["track"]) == ("following", "<b>why</b>", 7)
    assert head["predicted"]["at"] == [329.5, 234.5]
    assert head["predicted"]["axes"] == pytest.approx([15.0, 6.0])  # three standard deviations
    assert head["predicted"]["error_px"] == pytest.approx(5.0)
    assert head["predicted"]["size_px"] == 80.0
    assert head["found"] == [330.0, 235.0]
    assert head["commanded"] == [0.0, 0.0, 700.0]
    assert math.sin(head["predicted"]["turn"]) == pytest.approx(0.0)
    assert head["pan_deg"] == pytest.approx(math.degrees(0.1))
    assert table["cameras"]["fixed"]["age_s"] == pytest.approx(0.06)
    assert (table["skipped"], table["steps"], table["made"]) == (5, 4, 1.5)


def test_a_large_picture_is_made_smaller_and_keeps_its_coordinates():
    image = np.zeros((1080, 1920, 3), np.uint8)
    large = dataclasses.replace(step(0), fixed=Frame(image, 0.0))
    data = pack(large, 0, SPEC, 0, 0.0)
    size = int.from_bytes(data[:4], "big")
    camera = json.loads(data[4 : 4 + size])["cameras"]["fixed"]
    assert camera["size"] == [1920, 1080]
    jpeg = np.frombuffer(data, np.uint8)[4 + size :][: camera["bytes"]]
    assert cv2.imdecode(jpeg, cv2.IMREAD_COLOR).shape == (540, 960, 3)


def test_messages_are_read_strictly():
    assert parse('{"do": "manual", "of": "head", "rates": [1, -0.5], "tick": 3}').rates == (1.0, -0.5)
    for do in ("stop", "clear", "take"):
        assert parse(f'{{"do": "{do}"}}').do == do
    with pytest.raises(BadMessageError):
        parse('{"do": "stop", "really": true}')
