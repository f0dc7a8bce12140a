"""The viewer: frusta, pictures, real time, and the page for a browser."""

import gc
import urllib.error
import urllib.request
import warnings
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from cotarget.cli import view
from cotarget.config import RigConfig, SimConfig
from cotarget.sim.viewer import browser, desktop
from cotarget.sim.viewer.scene import FAR, SIDE_POINTS, Snapshot, WorldCopy, frusta_of, frustum_rim
from cotarget.sim.world import SimWorld
from tests.support.commands import call

NEAR_PX = 1e-6  # rounding, and the inverse of the distortion
ANSWER_S = 5.0


@pytest.fixture(scope="module")
def world():
    made = SimWorld(RigConfig(sim=SimConfig(scene="indoor", targets=("book",))), rendered=())
    made.rig.head.move(0.3, -0.1)
    made.rig.zoom.zoom(3000.0)
    made.rig.clock.sleep_until(5.0)
    yield made
    made.close()


@pytest.mark.parametrize("depth", [2.0, 30.0])
@pytest.mark.parametrize("camera", ["fixed", "zoom"])
@pytest.mark.parametrize("t", [0.0, 5.0])
def test_a_frustum_ends_at_the_corners_of_the_image(world, camera, t, depth):
    truth = world.truth()
    lens, T = truth.lens(camera, t), truth.T_world_camera(camera, t)
    rim = frustum_rim(T, lens, depth)
    (w, h), (fx, fy), (cx, cy) = lens.size, lens.focal_px, lens.center_px
    border = truth.pixel(camera, rim, t)
    corners = [[-0.5, -0.5], [w - 0.5, -0.5], [w - 0.5, h - 0.5], [-0.5, h - 0.5]]
    np.testing.assert_allclose(border[::SIDE_POINTS], corners, atol=NEAR_PX)
    x_camera = T.inv().apply(rim)
    np.testing.assert_allclose(x_camera[:, 2], depth)
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    independent, _ = cv2.projectPoints(x_camera.copy(), np.zeros(3), np.zeros(3), K, np.array(lens.distortion))
    np.testing.assert_allclose(independent[:, 0], border, atol=NEAR_PX)


class WallClock:
    """Wall-clock time that passes only in `sleep`."""

    def __init__(self):
        self.t = 0.0

    def now(self):
        return self.t

    def sleep(self, s):
        self.t += s


class Window:
    """Notes the times of its snapshots; closes after a number of them."""

    def __init__(self, clock, closed_after=1000):
        self.clock, self.shown, self._closed_after = clock, [], closed_after

    def show(self, sight):
        self.shown.append((sight.t, self.clock.now()))

    def is_open(self):
        return len(self.shown) < self._closed_after


def moments(clock, took):
    for index, s in enumerate(took):
        clock.sleep(s)  # the machine's work
        yield Snapshot(index * 0.1, "", {}, {})


def test_snapshots_are_shown_in_real_time_without_catching_up():
    clock = WallClock()
    window = Window(clock)
    view.watch(moments(clock, [0.0, 0.02, 0.02, 0.5, 0.02]), window, clock.now, clock.sleep)
    np.testing.assert_allclose([at for _, at in window.shown], [0.0, 0.02, 0.12, 0.7, 0.72])
    np.testing.assert_allclose(clock.now(), 0.8)


# From 0.06 s, when the first frame is there, to 0.3 s, 25 a second; or for as long on a machine that takes 0.2 s each.
@pytest.mark.parametrize(("target", "takes_s", "count"), [((), 0.0, 7), (("--target", "book"), 0.0, 7), ((), 0.2, 3)])
def test_view_shows_the_rig_at_rest_or_the_pipeline(tmp_path, capsys, monkeypatch, target, takes_s, count):
    clock, shown = WallClock(), []
    (tmp_path / "rig.toml").write_text('[sim]\ntargets = ["book"]\n')

    class Shown(Window):
        where = "the test"

        def show(self, sight):
            clock.sleep(takes_s)
            shown.append(sight)

        def close(self):
            shown.append("closed")

    black = SimWorld(RigConfig(sim=SimConfig(scene="indoor", targets=("book",))), rendered=())
    monkeypatch.setattr("cotarget.sim.world.SimWorld", lambda config: black)
    monkeypatch.setattr(view, "window_opener", lambda options: lambda truth: Shown(clock))
    monkeypatch.setattr(view, "time", SimpleNamespace(monotonic=clock.now, sleep=clock.sleep))
    assert call(capsys, "view", "--rig", tmp_path / "rig.toml", "--seconds", "0.3", *target)[:2] == (0, "")
    *sights, end = shown
    assert end == "closed"
    assert len(sights) == count
    assert sights[-1].pictures["zoom"].shape == (480, 640, 3)
    assert set(sights[-1].lines) == set(FAR)
    assert sights[-1].caption.endswith("book: searching" if target else f"{sights[-1].t:.1f} s")


def test_view_refuses_a_target_that_follow_refuses(tmp_path, capsys, monkeypatch):
    (tmp_path / "rig.toml").write_text('[sim]\ntargets = ["book"]\n[targets.book]\nsize = 23.4\n')
    monkeypatch.setattr(view, "window_opener", lambda options: lambda truth: SimpleNamespace(close=int))
    status, _, said = call(capsys, "view", "--rig", tmp_path / "rig.toml", "--target", "book")
    assert (status, "rig.toml: targets.book.size: 23.4" in said, "--insist" in said) == (1, True, True)


@pytest.mark.parametrize("window", [(1200, 900), (333, 777), (90, 70)])
def test_window_pictures_fill_their_places_one_above_the_other(window):
    """MuJoCo draws as many pixels as the place has, whatever the size of the picture."""
    blue, red = np.zeros((480, 640, 3), np.uint8), np.zeros((200, 320, 3), np.uint8)
    blue[..., 0] = red[..., 2] = 255
    placed = desktop.placed_pictures([blue, red], *window)
    for (place, picture), shape, colour in zip(
        placed, ((480, 640), (200, 320)), ((0, 0, 255), (255, 0, 0)), strict=True
    ):
        assert picture.shape == (place.height, place.width, 3)
        assert place.width / place.height == pytest.approx(shape[1] / shape[0], rel=2 / place.height)  # whole pixels
        assert (picture == colour).all()  # RGB
        assert place.left + place.width <= window[0]
        assert place.bottom >= 0
    (above, _), (below, _) = placed
    assert window[1] >= above.bottom + above.height
    assert above.bottom >= below.bottom + below.height


@pytest.mark.wire
def test_page_is_served_to_this_machine_until_the_window_closes(world):
    from mujoco.studio.web import state_payload

    listener = browser.listen(0)
    assert listener.getsockname()[0] == browser.HOST
    window = browser.BrowserWindow(world.truth(), listener)
    try:
        window.show(Snapshot(5.0, "", {}, frusta_of(world.truth(), 5.0)))
        assert window.is_open()
        with urllib.request.urlopen(window.where, timeout=ANSWER_S) as page:
            assert page.headers["Content-Type"].startswith("text/html")
            assert b"web_client" in page.read()
        with urllib.request.urlopen(f"{window.where}model", timeout=ANSWER_S) as served:
            assert served.read() == state_payload.serialize_model_bundle(WorldCopy(world.truth()).model)
    finally:
        window.close()
        where = window.where
        del window
        with warnings.catch_warnings():  # MuJoCo's server leaves its own inner connection to be collected
            warnings.simplefilter("ignore", ResourceWarning)
            gc.collect()
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(where, timeout=ANSWER_S)


def test_overlay_uploads_only_new_pictures(world):
    sent = []

    def upload(texture, pixels, width, height, bytes_a_pixel):
        sent.append((texture, pixels[:4], width, height))
        assert len(pixels) == width * height * bytes_a_pixel
        return texture or len(sent)

    overlay = browser.Overlay(lambda *_: None)
    overlay.viewer = SimpleNamespace(extra_geoms=[], upload_image=upload)
    red, lines = np.full((480, 640, 3), (0, 0, 255), np.uint8), frusta_of(world.truth(), 5.0)
    overlay.sight = Snapshot(5.0, "", {"fixed": red, "zoom": red}, lines)
    for _ in range(2):
        overlay.on_update(None)
        assert len(overlay.viewer.extra_geoms) == sum(map(len, lines.values()))
    assert sent == [(0, b"\xff\0\0\xff", browser.PICTURE_PX, 300)] * 2  # RGBA
