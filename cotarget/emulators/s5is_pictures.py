"""The S5 IS's eyes: a viewfinder that gives each picture once, and a shutter that goes some time after its request."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2

from cotarget.emulators.plant import Feed
from cotarget.errors import CotargetError
from cotarget.rig import Image

THUMB_SIZE = (160, 120)  # px
PICTURE_WAIT_S = 1.0  # at most, for the viewfinder's next picture
SLICE_S = 0.1  # between looks at whether waiting is still wanted

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Exposure:
    """A still as JPEG, its size [px], and a small one."""

    jpeg: bytes
    size: tuple[int, int]
    thumb: bytes


class Viewfinder:
    """Scaled pictures of a feed, as JPEG, each once.

    Args:
        feed: the pictures.
        size: to scale them to [px].
        quality: of JPEG, 1 to 100.
        closing: set where nobody needs to wait any more.
    """

    def __init__(self, feed: Feed, size: tuple[int, int], quality: int, closing: threading.Event) -> None:
        self._feed, self._size, self._quality, self._closing = feed, size, quality, closing
        self._seen = -1  # index of the last picture given
        self._since: float | None = None

    @property
    def on(self) -> bool:
        """Whether it is on."""
        return self._since is not None

    def switch(self, on: bool) -> None:
        """Turn it on, if it is not, or off."""
        self._since = (time.monotonic() if self._since is None else self._since) if on else None

    def image(self) -> bytes | None:
        """Wait for a picture that was exposed since it is on and was not given yet; None if there is none."""
        deadline = time.monotonic() + PICTURE_WAIT_S
        while (since := self._since) is not None and time.monotonic() < deadline and not self._closing.is_set():
            picture = self._feed.newest(self._seen, SLICE_S)
            if picture is not None:
                self._seen = picture.index
                if picture.t >= since:
                    scaled = cv2.resize(picture.image, self._size, interpolation=cv2.INTER_AREA)
                    return jpeg(scaled, self._quality)
        return None


class Shutter:
    """Takes stills, each on a thread of its own.

    Args:
        source: takes a picture at full size now, or a feed of such pictures.
        quality: of JPEG, 1 to 100.
        delay_s: from the request to the exposure [s].
        closing: set where nobody needs the stills any more.
    """

    def __init__(
        self, source: Callable[[], Image] | Feed, quality: int, delay_s: float, closing: threading.Event
    ) -> None:
        self._source, self._quality, self._delay_s, self._closing = source, quality, delay_s, closing
        self._threads: list[threading.Thread] = []

    def release(self, done: Callable[[Exposure | None], None]) -> None:
        """Take a still, and hand it over when it is there; None where none could be taken."""
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        self._threads.append(threading.Thread(target=self._run, args=(done,), daemon=True))
        self._threads[-1].start()

    def join(self) -> None:
        """Wait for the threads, after ``closing`` was set."""
        for thread in self._threads:
            thread.join()

    def _run(self, done: Callable[[Exposure | None], None]) -> None:
        if self._closing.wait(self._delay_s):
            return
        try:
            image = self._wait(self._source) if isinstance(self._source, Feed) else self._source()
        except CotargetError as error:
            log.warning("no still: %s", error)
            image = None
        if image is None:
            done(None)
            return
        thumb = cv2.resize(image, THUMB_SIZE, interpolation=cv2.INTER_AREA)
        size = (image.shape[1], image.shape[0])
        done(Exposure(jpeg(image, self._quality), size, jpeg(thumb, self._quality)))

    def _wait(self, feed: Feed) -> Image | None:
        opened, seen = time.monotonic(), -1
        while not self._closing.is_set():
            picture = feed.newest(seen, SLICE_S)
            if picture is not None:
                if picture.t >= opened:
                    return picture.image
                seen = picture.index
        return None


def jpeg(image: Image, quality: int) -> bytes:
    """An image as JPEG."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
