"""Lens and images of an emulated camera. Nothing here imports MuJoCo, so that a program with them starts fast."""

import threading
import time

import numpy as np

from cotarget.emulators.plant import Feed, Picture

DEADLINE_S = 20.0  # of real time: a loaded machine has reached it only if something hangs


class LensModel:
    """A lens that moves at once; a `LensPlant`.

    Attributes:
        commands: positions that were commanded.
    """

    last = 128

    def __init__(self, position=0):
        self.commands, self._position = [], position

    def command(self, position):
        assert 0 <= position <= self.last
        self.commands.append(position)
        self._position = position

    def position(self):
        return self._position


class Film:
    """Publishes images at a steady rate, as a camera does; a context manager.

    Args:
        draw: makes the image of an index.
        period_s: of the images [s].

    Attributes:
        feed: of the images.
    """

    def __init__(self, draw, period_s=0.04):
        self.feed, self._draw, self._period_s = Feed(), draw, period_s
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._end.set()
        self._thread.join(DEADLINE_S)

    def _run(self):
        index = 0
        while True:
            publish(self.feed, index, self._draw(index))
            index += 1
            if self._end.wait(self._period_s):
                return


def publish(feed, index, image, t=None):
    feed.publish(Picture(image, index, time.monotonic() if t is None else t))


def plain(size, colour):
    """An image (width, height) of one colour or grey."""
    return np.full((size[1], size[0], 3), colour, np.uint8)
