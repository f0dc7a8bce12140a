"""The blur of an exposure against the mean of many instants; and how little is rendered where nothing moves."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cotarget.config import parse_config
from cotarget.geometry import pose
from cotarget.sim.render.opengl import Canvas
from cotarget.sim.world import SimWorld

pytestmark = pytest.mark.render
EXPOSURE = 0.01
INSTANTS = 16  # whose mean is the truth
PIXELS = 640 * 480  # of an image; its render is a little larger
FOUR = 4  # equally spaced renders, which every exposure took before
AS_GOOD = 1.25  # times the error of four full renders
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
        drawn, before = draws(monkeypatch), Canvas.drawn
        image = w.expose("fixed", 0, t)
        counted, share = list(drawn), Canvas.drawn - before
        truth, four, sharp = (mean_of(w, "fixed", t, n) for n in (INSTANTS, FOUR, 1))
    assert error(sharp[box], truth[box]) > 2 * error(four[box], truth[box])  # there is a blur
    assert error(image[box], truth[box]) < AS_GOOD * error(four[box], truth[box]) + 0.5  # half a level is rounding
    assert error(image, truth) < WHOLLY_RIGHT
    whole = sum(counted[:-FOUR])
    assert PIXELS < whole < 1.4 * PIXELS
    assert max(counted[-FOUR:]) < 0.05 * whole
    assert share == pytest.approx(sum(counted) / whole)  # a part of a picture counts as that


def turn(rig, focal_px=2000.0):
    rig.zoom.zoom(focal_px)
    rig.head.move(0.4, -0.1)
    rig.clock.sleep_until(2.0)
    rig.head.move(-0.4, -0.1)
    return 2.3


def turn_fast(rig):
    """By 21 px in half an exposure, which is more than a picture's margin."""
    return turn(rig, 12e3)


def zoom_in(rig):
    rig.zoom.zoom(rig.zoom.focal_range[1])
    return 0.5


@pytest.mark.parametrize(
    ("move", "blur", "targets"),
    [(turn, 3.0, ("bird",)), (turn_fast, 3.0, ()), (zoom_in, 1.0, ())],
)
def test_a_zoom_camera_that_turns_or_zooms_blurs_everything(move, blur, targets):
    with (w := world(targets=targets, paths={name: [[0, 7, 20, 3], [5, 10, 20, 3]] for name in targets})).rig as rig:
        t = move(rig)
        rig.clock.sleep_until(t + EXPOSURE)
        truth, four, sharp = (mean_of(w, "zoom", t, n) for n in (INSTANTS, FOUR, 1))
        image = w.expose("zoom", 0, t)
        assert all(w.truth().box(name, "zoom", t) is not None for name in targets)
    border = np.ones(truth.shape[:2], dtype=bool)
    border[8:-8, 8:-8] = False
    for part in (np.ones_like(border), border):
        one, mean, this = (error(each[part], truth[part]) for each in (sharp, four, image))
        print(f"off the mean of 16: one {one:.2f}, four {mean:.2f}, this {this:.2f} grey levels")
        assert one > blur * mean
        assert this < AS_GOOD * mean + 0.5


def test_what_stands_still_is_rendered_once(monkeypatch):
    with (w := world(targets=["book"], scene="indoor")).rig:
        drawn = draws(monkeypatch)
        image = w.expose("zoom", 0, 3.0)
        assert len(drawn) == 1
        sharp = w.render("zoom", w.truth().lens("zoom", 3.0), 3.0)
        np.testing.assert_array_equal(image, sharp)


@pytest.mark.parametrize(("scene", "targets"), [("indoor", ["book"]), ("outdoor", ["bird"])])
def test_a_picture_that_is_partly_kept_is_as_if_it_were_rendered(monkeypatch, scene, targets):
    board, drawn, pictures, share = pose([-0.1, 0.1, 2.0], [5, 10, 0]), draws(monkeypatch), [], []
    for times in ((2.0, 2.04, 3.0, 3.5), (3.5,)):
        with (w := world(targets, scene=scene, effects=EFFECTS | {"blur": False})).rig as rig:
            for t in times:
                rig.clock.sleep_until(t)
                if t >= 3.0:
                    rig.board.present(board if t == 3.0 else None)
                drawn.clear()
                pictures.append(w.expose("fixed", 0, t))
                share.append(sum(drawn))
    _, _, with_board, kept, afresh = pictures
    np.testing.assert_array_equal(kept, afresh)
    assert error(with_board, kept) > WHOLLY_RIGHT
    assert share[1] < 0.5 * share[0]


@pytest.mark.parametrize("what", ["lens", "camera", "board"])
def test_no_part_is_kept_where_all_has_changed(what):
    """The kept picture is of another lens, of a camera that has been nudged, or has a board that is gone."""
    pictures = []
    for before in (True, False):
        with (w := world(targets=(), scene="indoor")).rig as rig:
            lens, t = w.truth().fixed_lens, 1.0
            other = replace(lens, focal_px=(1.2 * lens.focal_px[0], 1.2 * lens.focal_px[1]))
            if before:
                if what == "board":
                    rig.board.present(pose([-0.1, 0.1, 2.0], [5, 10, 0]))
                w.render("fixed", other if what == "lens" else lens, t)
                rig.board.present(None)
            if what == "camera":
                w._model.body("rig/fixed").pos[0] += 0.01
                t += 0.04
            pictures.append(w.render("fixed", lens, t))
    np.testing.assert_array_equal(*pictures)


def test_a_window_is_the_part_of_the_whole_picture(monkeypatch):
    """A bird that stands: were its window rendered again, every pixel would be as before."""
    paths = {"bird": [[0, -1, 20, 6], [1, -1, 20, 6]]}
    with (w := world(paths=paths)).rig:
        drawn = draws(monkeypatch)
        lens, t = w.truth().fixed_lens, 2.0
        image = w.expose("fixed", 0, t)
        assert max(drawn[-FOUR:]) < 0.05 * PIXELS  # its wings beat
        assert PIXELS < sum(drawn) < 1.5 * PIXELS
        low, high = w.truth().box("bird", "fixed", t)
    with (other := world(paths=paths)).rig:
        sharp = other.render("fixed", lens, t)
    outside = np.ones(image.shape[:2], dtype=bool)
    outside[int(low[1]) - 8 : int(high[1]) + 9, int(low[0]) - 8 : int(high[0]) + 9] = False
    np.testing.assert_array_equal(image[outside], sharp[outside])
    inside = np.abs(image.astype(int) - sharp)[~outside]
    # Wings apart, which beat: the sky and the trunk in the window are as they were.
    assert np.median(inside) == 0
    assert math.isclose(float(np.percentile(inside, 40)), 0.0)
