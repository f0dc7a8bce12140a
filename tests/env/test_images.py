"""The environments' pictures: what they show, that they come again, and that they leave nothing behind."""

import dataclasses
import threading
import weakref

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cotarget.config import SimCamera
from cotarget.env import FOLLOW, Follow, Schedule
from cotarget.env.common import DEFAULT_RIG
from cotarget.errors import DeviceError
from cotarget.sim.render import opengl
from tests.support.env_episodes import run, uncollected

pytestmark = pytest.mark.render
STILL = np.zeros(3, np.float32)


@pytest.mark.parametrize("make", [Follow, pytest.param(Schedule, marks=pytest.mark.slow)])
def test_images_pass_the_checker(field, make):
    env = make("bird", "images", rig=field, seconds=2.0, image_size=(48, 32))
    check_env(env, skip_render_check=True)
    observation, _ = env.reset(seed=0)
    assert observation["wide"].shape == observation["closeup"].shape == (32, 48, 3)
    env.close()


def test_render_shows_both_views():
    env = gymnasium.make(FOLLOW, target="book", seconds=1.0, render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (240, 640, 3)
    assert all(picture[:, side].std() > 10 for side in (slice(0, 320), slice(320, 640)))
    assert env.metadata["render_fps"] == 25
    env.close()
    assert Follow(seconds=1.0).render() is None


def test_pictures_are_the_same_for_the_same_seed_whatever_was_drawn_before(field):
    """The second episode is drawn by what the first had open, the third after a close by a new one."""
    env = Follow("bird", "images", rig=field, seconds=1.0)
    pictures = []
    for seed in (5, 6, 5, None):
        if seed is None:
            env.close()
        observation = run(env, lambda _: STILL, 5 if seed is None else seed, seconds=0.2)[-1][0]
        pictures.append(np.stack([observation["wide"], observation["closeup"]]))
    assert np.abs(pictures[0].astype(int) - pictures[1]).max() > 10
    np.testing.assert_array_equal(pictures[0], pictures[2])
    np.testing.assert_array_equal(pictures[0], pictures[3])
    env.close()


@pytest.mark.slow
def test_pictures_show_what_the_streams_show():
    """A picture of the streams' own size is what the stream shows, but for the resampling of the latter."""
    env = Follow("book", "images", seconds=1.0, image_size=SimCamera().size)
    told = run(env, lambda _: STILL, seed=1, seconds=0.1)
    episode = env.episode
    for name, camera in (("wide", "fixed"), ("closeup", "zoom")):
        t = told[-1][2]["t"]
        stream = episode.world.render(camera, episode.truth.lens(camera, t), t)[:, :, ::-1]
        off = np.abs(told[-1][0][name].astype(int) - stream)
        assert np.median(off) <= 3  # grey levels; edges are softer in the stream
        assert np.abs(off.mean(axis=(0, 1))).max() < 6
    env.close()


def test_effects_of_the_rig_show_in_the_pictures():
    """Noise of 2 grey levels, rounded to whole ones; at black and white it is cut."""
    seen = []
    for noise in (False, True):
        sim = dataclasses.replace(DEFAULT_RIG.sim, effects=dataclasses.replace(DEFAULT_RIG.sim.effects, noise=noise))
        env = Follow("book", "images", rig=dataclasses.replace(DEFAULT_RIG, sim=sim), seconds=1.0)
        told = run(env, lambda _: STILL, seed=2, seconds=0.1)
        seen.append([np.stack([o["wide"], o["closeup"]]).astype(float) for o, *_ in told[:2]])
        env.close()
    noises = [noisy - plain for plain, noisy in zip(*seen, strict=True)]
    assert [noise.std() for noise in noises] == pytest.approx([2.0, 2.0], rel=0.1)
    assert np.corrcoef(noises[0].ravel(), noises[1].ravel())[0, 1] < 0.1  # another one in each frame


def test_close_leaves_nothing_behind(monkeypatch, field):
    opened, closed, open_one = [], [], opengl.make_renderer

    def noting(*args):
        opened.append(renderer := open_one(*args))
        end = renderer.close
        renderer.close = lambda: (closed.append(renderer), end())
        return renderer

    monkeypatch.setattr(opengl, "make_renderer", noting)
    threads = threading.active_count()
    env = Follow("bird", "images", rig=field, seconds=1.0, render_mode="rgb_array")
    with uncollected():
        for seed in (0, 1):
            env.reset(seed=seed)
            env.step(STILL)
            env.render()
        last = weakref.ref(env.episode.world)
        env.reset(seed=2)  # though nobody renders now
        assert last() is None
    assert len(opened) <= 2  # one a size, and the second episode opened none
    assert threading.active_count() == threads
    before = list(opened)
    env.close()
    env.close()
    again = Follow("bird", "images", rig=field, seconds=1.0, render_mode="rgb_array")
    again.reset(seed=3)
    again.render()
    assert opened == before  # goes on with what was opened
    again.close()
    for side in (96, 104, 112):  # of other sizes: what is kept does not grow
        other = Follow("bird", "images", rig=field, seconds=1.0, image_size=(side, side))
        other.reset(seed=0)
        other.close()
    assert len(opened) == len(before) + 3
    assert len(closed) >= len(opened) - opengl.KEPT


def test_a_process_that_inherits_an_opengl_is_told_so(monkeypatch, field):
    """Forked ones would wait for ever."""
    env = Follow("book", "images", rig=field, seconds=1.0)
    env.reset(seed=0)
    monkeypatch.setattr(opengl.os, "getpid", lambda: -1)
    monkeypatch.setattr(opengl, "BACKEND", "egl")
    with pytest.raises(DeviceError, match="start it with the method 'spawn'"):
        Follow("book", "images", rig=field, seconds=1.0).reset(seed=0)
    env.close()
