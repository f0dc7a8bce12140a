"""Frames rendered before they are asked for: the same pictures, and nothing left behind."""

import gc
import math
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from cotarget.config import parse_config
from cotarget.errors import DeviceError
from cotarget.sim.render.opengl import Canvas
from cotarget.sim.render.views import READ_IN_TURN, Ahead, is_allowed
from cotarget.sim.world import SimWorld

FRAMES = READ_IN_TURN + 8
SMALL = {"size": [160, 120], "exposure_s": 0.01}


def world(**more):
    sim = {"scene": "indoor", "targets": ["book"], "fixed": {"size": [160, 120]}, "zoom": SMALL}
    return SimWorld(parse_config({"sim": sim}), **more)


def workers():
    return [thread for thread in threading.enumerate() if thread.name == "render ahead"]


def watched(w):
    """Zoom frames, read in turn but for one, while the head swings and the lens travels."""
    with w.rig as rig:
        rig.clock.sleep_until(1.0)
        found, t = [], 0.5
        for i in range(FRAMES):
            t = rig.fixed.read(newer_than=t).t
            if i != FRAMES - 3:
                found.append(rig.zoom.read())
            swing = 0.2 * math.sin(4.0 * t)
            rig.head.move(swing, 0.1 * swing)
            rig.zoom.zoom((2.0 + math.sin(3.0 * t)) * rig.zoom.focal_range[0])
        return found, len(workers())


@pytest.mark.render
def test_frames_are_the_same_whether_rendered_ahead_or_not():
    before, drawn = len(workers()), Canvas.drawn
    (plain, without), (ahead, with_it) = watched(world(ahead=False)), watched(world())
    assert Canvas.drawn - drawn >= len(plain) + len(ahead)
    assert (without - before, with_it - before) == (0, 1)
    for a, b in zip(plain, ahead, strict=True):
        assert a.t == b.t
        np.testing.assert_array_equal(a.image, b.image)
    assert len(workers()) == before


def test_nothing_is_rendered_ahead_where_that_is_forbidden(monkeypatch):
    assert is_allowed()
    monkeypatch.setenv("COTARGET_AHEAD", "0")
    assert not is_allowed()
    monkeypatch.setattr("cotarget.sim.world.Ahead", lambda views: pytest.fail("another thread was asked for"))
    world(rendered=("zoom",)).rig.close()


@pytest.fixture
def closed():
    """The threads on which renderers were closed."""
    return []


@pytest.fixture
def ahead(closed):
    return Ahead(lambda: SimpleNamespace(close=lambda: closed.append(threading.current_thread().name)))


def read(ahead, indices):
    """Frames asked for in this order, each then begun anew; which of them were ready."""
    ready = []
    for index in indices:
        ready.append(ahead.take(index))
        ahead.begin(index + 1, lambda _, number=index + 1: np.full(1, number))
    return [None if image is None else int(image[0]) for image in ready]


def test_only_what_is_read_in_turn_is_begun(ahead, closed):
    turn = list(range(5, 5 + READ_IN_TURN + 1))  # the first one is not in turn
    assert read(ahead, turn) == [None] * len(turn)
    assert read(ahead, [turn[-1] + 1, turn[-1] + 2]) == [turn[-1] + 1, turn[-1] + 2]
    assert read(ahead, [turn[-1] + 4, turn[-1] + 5]) == [None, None]  # one was left out
    ahead.close()
    ahead.close()
    assert closed == ["render ahead"]


def test_the_thread_ends_also_if_nobody_closes_it(closed):
    ahead = Ahead(lambda: SimpleNamespace(close=lambda: closed.append(threading.current_thread().name)))
    read(ahead, range(READ_IN_TURN))
    assert closed == []
    del ahead
    gc.collect()
    assert closed == ["render ahead"]


def test_what_goes_wrong_there_is_told_here(ahead, closed):
    read(ahead, range(READ_IN_TURN))
    ahead.begin(READ_IN_TURN, lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        ahead.take(READ_IN_TURN)
    ahead.close()
    assert len(closed) == 1


def test_a_machine_that_cannot_open_another_says_so_each_time():
    def refuse():
        raise DeviceError("no more OpenGL")

    ahead = Ahead(refuse)
    read(ahead, range(READ_IN_TURN - 1))
    for index in (READ_IN_TURN - 1, READ_IN_TURN):
        ahead.take(index)
        with pytest.raises(DeviceError, match="no more"):
            ahead.begin(index + 1, lambda _: np.zeros(1))
    ahead.close()


def test_it_begins_anew_after_it_was_closed(ahead, closed):
    for _ in range(2):
        turn = range(READ_IN_TURN + 2)
        assert read(ahead, turn)[-1] == turn[-1]
        ahead.close()
    assert len(closed) == 2
