"""Writes the log and the images of a recording on a thread of its own, so that the run is not held up."""

import collections
import json
import logging
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cotarget.recordformat import FIXED, LOG, ZOOM, Event, event_line
from cotarget.rig import Image

log = logging.getLogger(__name__)

# Images that may wait for the disk [bytes]; 640x480 takes 0.92 MB. Frames of the zoom camera, from which nothing is
# decided, go without their image when there is no more room; the fixed camera's never do: the run waits instead.
ZOOM_ROOM = 64_000_000
ROOM = 128_000_000
# Without search for repetitions, which noise has none of, and with the one filter that pays: a noisy 640x480 image
# takes 6 ms and 375 kB where zlib's level 1 with every filter takes 13 ms and 370 kB, and raw 922 kB.
PNG_OPTIONS = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
if hasattr(cv2, "IMWRITE_PNG_FILTER"):  # older versions of OpenCV use that filter anyway
    PNG_OPTIONS += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]


@dataclass(eq=False)
class _Picture:
    """An image on its way to the disk; ``image`` is None once it is there, or if it will never be."""

    name: str
    image: Image | None
    size_bytes: int = 0
    dropped: bool = False


class RecordWriter:
    """Takes events in order and writes them in that order, each image before the line that names it.

    Attributes:
        dropped: images of the zoom camera that were not kept, because the disk was too slow.
        failure: why nothing is written any more; empty as long as all is well.
    """

    def __init__(self, directory: Path) -> None:
        """Begin the log in a folder.

        Raises:
            OSError: it cannot be written.
        """
        self.dropped = 0
        self.failure = ""
        self._directory = directory
        for name in (FIXED, ZOOM):
            (directory / name).mkdir()
        self._log = (directory / LOG).open("xb", buffering=0)  # a line is with the system as soon as it is written
        self._queue: collections.deque[tuple[Event | dict[str, Any], _Picture | None]] = collections.deque()
        self._changed = threading.Condition()
        self._waiting = 0
        self._closing = False
        self._last: dict[str, tuple[float, Image, _Picture]] = {}
        self._numbers = {FIXED: 0, ZOOM: 0}
        self._thread = threading.Thread(target=self._work, name="recording", daemon=True)
        self._thread.start()

    def put(self, event: Event | dict[str, Any], camera: str = "", image: Image | None = None) -> None:
        """Take an event, or another object for a line; with an image, that of a frame exposed at its result.

        Args:
            event: what to log.
            camera: the image's folder.
            image: (H, W, 3) BGR, which nobody may change any more.
        """
        with self._changed:
            picture = None
            if image is not None and not self.failure:
                assert isinstance(event, Event)
                picture = self._picture(camera, image, float(event.result[0] or 0.0))
            if not self.failure:  # which may have come about while there was no room
                self._queue.append((event, picture))
                self._changed.notify_all()

    @property
    def waiting(self) -> int:
        """How many events are still on their way to the disk."""
        return len(self._queue)

    def close(self) -> None:
        """Write what still waits, and end."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join()
        self._log.close()

    def _picture(self, camera: str, image: Image, t: float) -> _Picture:
        """The image's place on disk: that of the last one, if it is the same frame again."""
        if camera in self._last:
            last_t, last_image, last = self._last[camera]
            if last_t == t and (last_image is image or np.array_equal(last_image, image)):
                return last
        picture = _Picture(f"{camera}/{self._numbers[camera]:06d}.png", image)
        self._numbers[camera] += 1
        if camera == ZOOM and self._waiting + image.nbytes > ZOOM_ROOM:
            picture = replace(picture, image=None, dropped=True)
            if self.dropped == 0:
                log.warning("the disk is too slow for the recording: images of the zoom camera are left out")
            self.dropped += 1
        else:
            self._changed.wait_for(lambda: not self._waiting or self._waiting + image.nbytes <= ROOM or self.failure)
            self._waiting += image.nbytes
        self._last[camera] = (t, image, picture)
        return picture

    def _work(self) -> None:
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._queue or self._closing)
                    if not self._queue:
                        return
                    event, picture = self._queue[0]
                self._write(event, picture)
                self._queue.popleft()  # only now, so that the queue holds whatever is not written yet
        except (OSError, cv2.error) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error).strip()
            log.warning("the recording ends here; it cannot be written: %s", reason)
            self._fail(reason)
        except BaseException as error:
            self._fail(f"{type(error).__name__}: {error}")  # nobody may wait for a thread that is gone
            raise

    def _fail(self, reason: str) -> None:
        with self._changed:
            self.failure = reason
            self._queue.clear()
            self._changed.notify_all()

    def _write(self, event: Event | dict[str, Any], picture: _Picture | None) -> None:
        if picture is not None:
            if picture.image is not None:
                picture.size_bytes = self._write_image(picture.name, picture.image)
                with self._changed:
                    self._waiting -= picture.image.nbytes
                    picture.image = None
                    self._changed.notify_all()
            if not picture.dropped:
                assert isinstance(event, Event)
                event = replace(event, image=picture.name, size_bytes=picture.size_bytes)
        text = event_line(event) if isinstance(event, Event) else json.dumps(event, allow_nan=False)
        self._log.write(text.encode() + b"\n")

    def _write_image(self, name: str, image: Image) -> int:
        """Write an image under its name only when it is complete; its size on disk [bytes]."""
        data = cv2.imencode(".png", image, PNG_OPTIONS)[1].tobytes()
        path = self._directory / name
        part = path.with_suffix(".part")
        part.write_bytes(data)
        part.replace(path)
        return len(data)
