"""Pictures and plots: the Steps that a target's picture shows, and legible boxes, texts and legends."""

import dataclasses

import numpy as np
import pytest

from cotarget.drawing import SIZE_KNOWN_S, TargetStages, aim_error_figure, draw_box, side_by_side
from cotarget.metrics import Row
from cotarget.rig import Frame
from tests.support.steps import PICTURE, step


def staged(steps):
    stages = TargetStages(600.0)
    for each in steps:
        stages.see(each)
    return stages


def test_the_close_up_is_of_the_largest_box_of_the_target_alone():
    sides = [(8.0, False), (10.0, False), (20.0, True), (9.0, False)]
    steps = [step(i * (SIZE_KNOWN_S + 0.1), *each) for i, each in enumerate(sides)]
    assert staged(steps).close is steps[1]


def test_centred_is_the_step_with_the_shortest_lens_of_those_near_the_middle():
    """While the head turns and the lens goes in: off, off, nearly (3 % of 64 px), in the middle, off, in the middle."""
    course = [(700, 12), (900, 5), (1200, 2), (1500, 0), (2000, -4), (2500, 0)]
    steps = [step(0.04 * i, focal_px=focal, off_px=off) for i, (focal, off) in enumerate(course)]
    assert staged(steps).centred is steps[2]


def test_a_step_whose_zoom_frame_does_not_show_the_target_is_not_centred():
    unseen = [step(0.0, seen_s=0.04), dataclasses.replace(step(0.04), found=None)]
    assert staged(unseen).centred is None
    steps = [*unseen, step(0.08)]
    assert staged(steps).centred is steps[2]


def test_centred_comes_before_the_close_up():
    steps = [step(0.0), step(SIZE_KNOWN_S + 0.1), step(SIZE_KNOWN_S + 0.2, focal_px=2900.0)]
    stages = staged(steps)
    assert stages.close is steps[1]
    assert stages.centred is steps[0]


def test_the_picture_of_a_target_enlarges_the_fixed_frame_as_much_as_the_close_up():
    """At five times the shortest focal length a square of 4 px has 25 times its area in panel (e)."""
    close = step(SIZE_KNOWN_S, focal_px=3000.0)
    image = PICTURE.copy()
    image[18:22, 28:32] = 255  # near the track's centre, (30, 20)
    close = dataclasses.replace(close, fixed=Frame(image, close.t))
    picture = staged([step(0.0), close]).picture("bird")
    height, width = PICTURE.shape[:2]
    assert picture.shape[1] == 2 * width
    top = 2 * picture.shape[0] // 3
    area = (picture[top : top + height, :width, 0] / 255).sum()
    assert area == pytest.approx(4 * 4 * 25, rel=0.1)  # the part that is enlarged has whole pixels


VISIBLE = 80  # least difference of something drawn from its background [grey levels]
BIRD_PX = np.array([6.0, 4.0])


@pytest.mark.parametrize("grey", [0, 60, 128, 200, 255])
@pytest.mark.parametrize("width", [320, 640, 1280])
@pytest.mark.parametrize("bold", [True, False])
def test_a_box_is_visible_on_any_background_and_does_not_cover_its_target(grey, width, bold):
    image = np.full((width * 3 // 4, width, 3), grey, np.uint8)
    u, v = width // 2, width // 4
    draw_box(image, np.array([u, v]), BIRD_PX, (0, 200, 255), "1", bold=bold)
    changed = np.abs(image.astype(int) - grey).max(axis=2)
    low, high = (np.array([u, v]) - BIRD_PX / 2 - 2).astype(int), (np.array([u, v]) + BIRD_PX / 2 + 3).astype(int)
    assert not changed[low[1] : high[1], low[0] : high[0]].any()
    assert changed[v, u:].max() >= VISIBLE  # its right side
    assert changed[: v - 12 * width // 640].max() >= VISIBLE  # its label


@pytest.mark.parametrize("at", [(0.0, 0.0), (639.0, 479.0), (639.0, 0.0)])
def test_the_label_of_a_box_at_the_border_is_in_the_image(at):
    """Its number takes as many pixels as in the middle of the image."""
    shown = []
    for place in (np.array([320.0, 240.0]), np.array(at)):
        with_label, without = (np.zeros((480, 640, 3), np.uint8) for _ in range(2))
        draw_box(with_label, place, BIRD_PX, (0, 200, 255), "42")
        draw_box(without, place, BIRD_PX, (0, 200, 255), "")
        shown.append(int((with_label != without).any(axis=2).sum()))
    assert shown[1] == pytest.approx(shown[0], rel=0.1)


@pytest.mark.parametrize(
    ("fixed", "zoom"), [((320, 240), (320, 240)), ((640, 480), (320, 240)), ((320, 240), (800, 600))]
)
def test_a_film_shows_both_cameras_at_one_height_of_at_least_480_px(fixed, zoom):
    made = step(0.0)
    images = (np.full((size[1], size[0], 3), 128, np.uint8) for size in (fixed, zoom))
    made = dataclasses.replace(
        made, **{name: Frame(image, 0.0) for name, image in zip(("fixed", "zoom"), images, strict=True)}
    )
    image = side_by_side(made, "bird", 12.34)
    height = max(480, fixed[1], zoom[1])
    assert image.shape[1] == sum(height * size[0] // size[1] for size in (fixed, zoom))
    assert (image[height - 1] == 128).all()  # without a reason nothing is written into the images
    assert image.shape[0] > height


def test_a_film_shows_the_reason_at_the_bottom_of_the_fixed_cameras_image():
    """In more lines for more words."""
    bright = np.full((480, 640, 3), 255, np.uint8)
    plain = dataclasses.replace(step(0.0), fixed=Frame(bright, 0.0), zoom=Frame(bright, 0.0))
    without = side_by_side(plain, "bird", 0.0).astype(int)

    def rows(reason):
        """Which rows of the fixed view show anything else."""
        changed = np.any(side_by_side(dataclasses.replace(plain, reason=reason), "bird", 0.0) != without, axis=2)
        assert not changed[:, 640:].any()
        return np.flatnonzero(changed.any(axis=1))

    short, long = rows("zoom: unsure"), rows("the head points 1.3 degrees beside " * 4)
    assert 440 < short.min() < short.max() < 480
    assert long.min() < short.min() - 10
    assert long.max() < 480


def test_the_legend_of_the_aim_error_lies_on_no_curve():
    numbers = {f.name: 0.0 if f.type is float else 0 for f in dataclasses.fields(Row)} | {
        "width_px": 64,
        "height_px": 48,
    }
    rows = [Row(**numbers | {"t_s": 0.1 * i, "focal_px": 700.0 + 90 * i, "wanted_px": 9.0}) for i in range(9)]
    figure = aim_error_figure({"book": rows, "person": rows})
    figure.canvas.draw()
    (legend,) = figure.legends
    assert len(figure.axes) == 4
    assert not any(legend.get_window_extent().overlaps(ax.get_window_extent()) for ax in figure.axes)
