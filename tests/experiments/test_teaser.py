"""The README's animated picture: both cameras side by side, with a box around the target, small enough for a page."""

import io
from types import SimpleNamespace

import numpy as np
import PIL.Image
import pytest

from cotarget.rig import Detection, Frame
from experiments.paper.teaser import BOX_COLOR, WIDTH_PX, animated_webp, side_by_side

RATE_HZ = 12.5
LINE_PX = 2  # width of the box's line, which lies on its edge


def step(target):
    black = np.zeros((480, 640, 3), np.uint8)
    return SimpleNamespace(fixed=Frame(black, 0.0), zoom=Frame(black, 0.0), target=target)


def test_the_box_stands_around_the_target_in_the_fixed_cameras_image_alone():
    target = SimpleNamespace(box=Detection(np.array([319.5, 239.5]), np.array([32.0, 16.0]), 1.0))
    image, plain = side_by_side(step(target)), side_by_side(step(None))
    assert image.shape == plain.shape == (300, 2 * WIDTH_PX, 3)
    v, u = np.nonzero((image == BOX_COLOR).all(axis=2))
    edges = [199.5 - 15, 199.5 + 15, 149.5 - 10, 149.5 + 10]  # 32 x 16 px at 400 / 640, and 5 px around
    assert [u.min(), u.max(), v.min(), v.max()] == pytest.approx(edges, abs=LINE_PX)
    assert not (plain == BOX_COLOR).all(axis=2).any()


def test_the_picture_has_all_frames_at_their_rate_and_repeats():
    images = [np.full((30, 80, 3), 20 * i, np.uint8) for i in range(6)]
    picture = PIL.Image.open(io.BytesIO(animated_webp(images, RATE_HZ)))
    assert (picture.n_frames, picture.size, picture.info["loop"]) == (6, (80, 30), 0)
    picture.seek(1)
    picture.load()
    assert picture.info["duration"] == 1000 / RATE_HZ
