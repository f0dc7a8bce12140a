"""Boxes from a function of the user's: what is taken over, and what is refused."""

import numpy as np
import pytest

from cotarget.detection import ExternalDetector
from cotarget.errors import CotargetError
from cotarget.rig import Frame

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
