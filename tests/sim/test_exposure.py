"""The blur of an exposure against the mean of many instants; and how little is rendered where nothing moves."""

import math

import numpy as np
import pytest

from cotarget.config import parse_config
from cotarget.sim.render.opengl import Canvas
from cotarget.sim.world import SimWorld

pytestmark = pytest.mark.render
EXPOSURE = 0.01
INSTANTS = 16  # whose mean is the truth
FOUR = 4  # equally spaced renders, which every exposure took before
AS_GOOD = 1.25  # times the error of four full renders
# Where all is rendered again, antialiasing is another one: part of what the blur changes, and grey levels, of which the
# sensor's noise has 2.
PART, LEVELS = 0.4, 1.5
WHOLLY_RIGHT = 1.0  # mean error where the picture is at rest [grey levels]
EFFECTS = {
    "all": False,
    "multisampling": True,
    "blur": True,
    "profile": True,
    "distortion": True,
    "optics": True,
    "lens": True,
}


def world(targets=("bird",), **sim):
    cameras = {name: {"exposure_s": EXPOSURE} for name in ("fixed", "zoom")}
    head = {"speed_deg_s": 20.0, "accel_deg_s2": 1e4}
    table = {"scene": "outdoor", "targets": list(targets), "effects": EFFECTS, "head": head, **cameras, **sim}
    return SimWorld(parse_config({"sim": table}))


def mean_of(w, camera, t, count):
    """The mean of full pictures at evenly spaced instants of the exposure."""
    times = t + EXPOSURE * ((np.arange(count) + 0.5) / count - 0.5)
    truth = w.truth()
    return np.mean([w.render(camera, truth.lens(camera, s), s).astype(float) for s in times], axis=0)


def error(image, truth):
    return float(np.abs(image.astype(float) - truth).mean())


def draws(monkeypatch):
    """Counts the pixels of every render."""
    drawn, draw = [], Canvas.draw

    def counted(self, eye, axes, tangents, size, part, **more):
        drawn.append(size[0] * size[1])
        return draw(self, eye, axes, tangents, size, part, **more)

    monkeypatch.setattr(Canvas, "draw", counted)
    return drawn


def test_a_flying_bird_is_blurred_in_the_wide_view_and_only_it_is_rendered_again(monkeypatch):
    with (w := world()).rig:
        t = 5.0
        low, high = w.truth().box("bird", "fixed", t)
        box = (slice(int(low[1]) - 4, int(high[1]) + 6), slice(int(low[0]) - 6, int(high[0]) + 8))
        truth, four, sharp = (mean_of(w, "fixed", t, n) for n in (INSTANTS, FOUR, 1))
        drawn, before = draws(monkeypatch), Canvas.drawn
        image = w.expose("fixed", 0, t)
    assert error(sharp[box], truth[box]) > 2 * error(four[box], truth[box])  # there is a blur
    assert error(image[box], truth[box]) < AS_GOOD * error(four[box], truth[box]) + 0.5  # half a level is rounding
    assert error(image, truth) < WHOLLY_RIGHT
    assert len(drawn) == 1 + FOUR
    assert max(drawn[1:]) < 0.05 * drawn[0]
    assert Canvas.drawn - before == pytest.approx(sum(drawn) / drawn[0])  # a part of a picture counts as that


def turn(rig):
    rig.zoom.zoom(2000.0)
    rig.head.move(0.4, -0.1)
    rig.clock.sleep_until(2.0)
    rig.head.move(-0.4, -0.1)
    return 2.3


def zoom_in(rig):
    rig.zoom.zoom(rig.zoom.focal_range[1])
    return 0.5


@pytest.mark.slow
@pytest.mark.parametrize(("move", "blur"), [(turn, lambda four: 2 * four), (zoom_in, lambda four: 0.5)])
def test_a_zoom_camera_that_turns_or_zooms_blurs_everything(move, blur):
    with (w := world(targets=())).rig as rig:
        t = move(rig)
        rig.clock.sleep_until(t + EXPOSURE)
        truth, four, sharp = (mean_of(w, "zoom", t, n) for n in (INSTANTS, FOUR, 1))
        image = w.expose("zoom", 0, t)
    print(f"off the mean of 16: one {error(sharp, truth):.2f}, four {error(four, truth):.2f}, ", end="")
    print(f"this {error(image, truth):.2f} grey levels")
    assert error(sharp, truth) > blur(error(four, truth))
    assert error(image, truth) < min(PART * error(sharp, truth), LEVELS)


def test_what_stands_still_is_rendered_once(monkeypatch):
    with (w := world(targets=["book"], scene="indoor")).rig:
        drawn = draws(monkeypatch)
        image = w.expose("zoom", 0, 3.0)
        assert len(drawn) == 1
        sharp = w.render("zoom", w.truth().lens("zoom", 3.0), 3.0)
        np.testing.assert_array_equal(image, sharp)


def test_a_window_is_the_part_of_the_whole_picture(monkeypatch):
    """A bird that stands: were its window rendered again, every pixel would be as before."""
    paths = {"bird": [[0, -1, 20, 6], [1, -1, 20, 6]]}
    with (w := world(paths=paths)).rig:
        drawn = draws(monkeypatch)
        lens, t = w.truth().fixed_lens, 2.0
        image, sharp = w.expose("fixed", 0, t), w.render("fixed", lens, t)
        assert len(drawn) == 1 + FOUR + 1  # its wings beat
        low, high = w.truth().box("bird", "fixed", t)
    outside = np.ones(image.shape[:2], dtype=bool)
    outside[int(low[1]) - 8 : int(high[1]) + 9, int(low[0]) - 8 : int(high[0]) + 9] = False
    np.testing.assert_array_equal(image[outside], sharp[outside])
    inside = np.abs(image.astype(int) - sharp)[~outside]
    # Wings apart, which beat: the sky and the trunk in the window are as they were.
    assert np.median(inside) == 0
    assert math.isclose(float(np.percentile(inside, 40)), 0.0)
