"""Pictures as an Axis video server gives them: asked for by VAPIX's arguments, scaled, and encoded once for all."""

import math
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Literal

import cv2
import numpy as np

from cotarget.emulators.axis_http import HttpError
from cotarget.emulators.faults import Faults
from cotarget.emulators.plant import Feed, Picture
from cotarget.rig import Image

Size = tuple[int, int]
Standard = Literal["PAL", "NTSC"]
Camera = int | Literal["quad"]

# The 241Q has four inputs; one without a feed has no video.
INPUTS = (1, 2, 3, 4)
# Sizes by VAPIX's names [px]; NTSC's pictures are 480/576 as high.
PAL_SIZES: Mapping[str, Size] = {
    "4CIF": (704, 576),
    "2CIFEXP": (704, 576),
    "2CIF": (704, 288),
    "CIF": (352, 288),
    "QCIF": (176, 144),
}
# Sides that are accepted as WxH [px]: nothing smaller, and nothing larger than this or the camera's own.
SMALLEST_SIDE, LARGEST_SIZE = 16, (768, 576)
# Axis' default compression, at which the JPEG quality is the one that the server was opened with; linear up to 0, the
# finest, and down to 100. What the ARTPEC's own scale is, nobody says.
DEFAULT_COMPRESSION = 30
FINEST_QUALITY, COARSEST_QUALITY = 100, 10
# An input without a signal is shown as a flat picture that says so (BGR).
NO_VIDEO_COLOUR = (160, 40, 20)
# Encoded variants (camera, size, compression) that are remembered.
MAX_VARIANTS = 64


def named_sizes(standard: Standard) -> dict[str, Size]:
    """The sizes that have names, in a television standard."""
    height = {"PAL": 576, "NTSC": 480}[standard]
    return {name: (size[0], size[1] * height // 576) for name, size in PAL_SIZES.items()}


@dataclass(frozen=True)
class Order:
    """What a client asks of pictures.

    Attributes:
        camera: number of the input, or all four in one.
        size: (width, height) [px]; None for the camera's own.
        compression: 0 to 100, less is finer.
        rate_hz: most pictures a second; 0 for all.
        duration: of the stream [s]; 0 for ever.
        count: of pictures in the stream; 0 for no end.
        show_length: whether a single picture tells its length.
    """

    camera: Camera
    size: Size | None
    compression: int
    rate_hz: float
    duration: float
    count: int
    show_length: bool


def parse_order(arguments: Mapping[str, str], camera: str | None, sizes: Mapping[str, Size]) -> Order:
    """Read VAPIX's arguments of pictures; unknown ones are passed over, as the server does.

    Args:
        arguments: of the request.
        camera: the one that the path names, if it does.
        sizes: that have names.

    Raises:
        HttpError: a value makes no sense (400).
    """
    which = arguments.get("camera", camera or "1")
    if which != "quad" and which not in map(str, INPUTS):
        raise HttpError(HTTPStatus.BAD_REQUEST)
    rates = [_number(arguments, name, 1000) for name in ("fps", "req_fps", "des_fps")]
    return Order(
        camera="quad" if which == "quad" else int(which),
        size=_size(arguments.get("resolution", ""), sizes),
        compression=int(_number(arguments, "compression", 100, DEFAULT_COMPRESSION)),
        rate_hz=min((rate for rate in rates if rate > 0), default=0.0),
        duration=_number(arguments, "duration", math.inf),
        count=int(_number(arguments, "nbrofframes", 1e9)),
        show_length=arguments.get("showlength", "1") != "0",
    )


def _number(arguments: Mapping[str, str], name: str, highest: float, default: float = 0.0) -> float:
    try:
        value = float(arguments.get(name, default))
    except ValueError:
        raise HttpError(HTTPStatus.BAD_REQUEST) from None
    if not 0 <= value <= highest:  # also true of nan
        raise HttpError(HTTPStatus.BAD_REQUEST)
    return value


def _size(text: str, sizes: Mapping[str, Size]) -> Size | None:
    if not text:
        return None
    if text.upper() in sizes:
        return sizes[text.upper()]
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and len(text) < 12):
        raise HttpError(HTTPStatus.BAD_REQUEST)
    return int(width), int(height)


class Pace:
    """Thins pictures out to a rate without making those that are left any older.

    Args:
        rate_hz: pictures a second; 0 lets all of them pass.
    """

    # A picture passes this part of a period early, so that a source at just this rate loses none to its jitter.
    EARLY = 0.25

    def __init__(self, rate_hz: float) -> None:
        self._period = 1 / rate_hz if rate_hz else 0.0
        self._due = -math.inf

    def due(self, now: float) -> bool:
        """Whether the picture that is there ``now`` [s] is one to send."""
        if now < self._due - self.EARLY * self._period:
            return False
        # Counted on from when it was due, so that the mean is right; a source that is too slow saves up half a period.
        self._due = max(self._due, now - self._period / 2) + self._period
        return True


class _Variant:
    """The newest JPEG of one camera at one size and compression."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.index = -1
        self.data = b""


class Pictures:
    """The server's inputs, and their newest JPEG of every size that is asked for; safe to use from any thread.

    Args:
        feeds: by the number of the input.
        quality: of JPEG, 0 to 100, at Axis' default compression.
        faults: of the server.
        blank: size of the picture of an input without feed [px].
    """

    def __init__(self, feeds: Mapping[int, Feed], quality: int, faults: Faults, blank: Size) -> None:
        self._feeds, self._quality, self._faults, self._blank = dict(feeds), quality, faults, blank
        self._variants: dict[tuple[Camera, Size, int, bool], _Variant] = {}
        self._lock = threading.Lock()

    def video(self, camera: int) -> bool:
        """Whether an input has a signal."""
        return camera in self._feeds and "no-video" not in self._faults

    def wait(self, camera: Camera, after: int, timeout: float) -> Picture | None:
        """The newest picture above an index, as the camera gives it; None if none comes within ``timeout`` [s]."""
        feed = self._feeds.get(min(self._feeds, default=1) if camera == "quad" else camera)
        if feed is not None:
            return feed.newest(after, timeout)
        if after >= 0:
            time.sleep(timeout)  # an input without signal has a rate too
        return Picture(blank_picture(self._blank), after + 1, time.monotonic())

    def own_size(self, camera: int) -> Size:
        """(width, height) of what an input gives to a client that asks for no size [px]."""
        feed = self._feeds.get(camera)
        picture = None if feed is None else feed.newest()
        return self._blank if picture is None else (picture.image.shape[1], picture.image.shape[0])

    def check(self, order: Order, picture: Picture) -> None:
        """Refuse an order for a size that a camera cannot give.

        Raises:
            HttpError: no such size (400).
        """
        if order.size is None:
            return
        largest = np.maximum(picture.image.shape[1::-1], LARGEST_SIZE)
        if min(order.size) < SMALLEST_SIDE or (order.size > largest).any():
            raise HttpError(HTTPStatus.BAD_REQUEST)

    def size(self, order: Order, picture: Picture) -> Size:
        """(width, height) of what an order gets [px]."""
        size = order.size or (picture.image.shape[1], picture.image.shape[0])
        return (size[0] // 2, size[1] // 2) if "resolution" in self._faults else size

    def jpeg(self, order: Order, picture: Picture) -> tuple[int, bytes]:
        """The JPEG of a picture, or of a newer one that somebody else had encoded already, and its index."""
        size, blank = self.size(order, picture), "no-video" in self._faults
        with self._lock:
            if len(self._variants) > MAX_VARIANTS:
                self._variants.clear()
            variant = self._variants.setdefault((order.camera, size, order.compression, blank), _Variant())
        with variant.lock:
            if variant.index < picture.index and not (variant.data and "frozen" in self._faults):
                image = self._quad(picture) if order.camera == "quad" else picture.image
                image = blank_picture(size) if blank else scaled(image, size)
                variant.index, variant.data = picture.index, encode(image, self._jpeg_quality(order.compression))
            return variant.index, variant.data

    def _jpeg_quality(self, compression: int) -> int:
        qualities = (FINEST_QUALITY, self._quality, COARSEST_QUALITY)
        return round(float(np.interp(compression, (0, DEFAULT_COMPRESSION, 100), qualities)))

    def _quad(self, picture: Picture) -> Image:
        width, height = picture.image.shape[1] // 2, picture.image.shape[0] // 2
        quarters = []
        for camera in INPUTS:
            newest = self._feeds[camera].newest() if camera in self._feeds else None
            image = blank_picture((width, height)) if newest is None else scaled(newest.image, (width, height))
            quarters.append(image)
        return np.vstack([np.hstack(quarters[:2]), np.hstack(quarters[2:])])


def scaled(image: Image, size: Size) -> Image:
    """An image in another size (width, height) [px]; its shape may change, as PAL's and NTSC's do."""
    if (image.shape[1], image.shape[0]) == size:
        return image
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def encode(image: Image, quality: int) -> bytes:
    """A JPEG, at a quality of 0 to 100."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(data)


def blank_picture(size: Size) -> Image:
    """What is shown of an input without a signal."""
    image = np.full((size[1], size[0], 3), NO_VIDEO_COLOUR, np.uint8)
    scale = size[0] / 400
    cv2.putText(image, "No video", (size[0] // 10, size[1] // 2), cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255))
    return image


def damaged(data: bytes, index: int) -> bytes:
    """A JPEG of the same length with bytes destroyed: by turns at its start, at its end and amid its data."""
    quarter = len(data) // 4
    match index % 3:
        case 0:
            return bytes(quarter) + data[quarter:]
        case 1:
            return data[:-quarter] + bytes(quarter)
        case _:
            return data[: 2 * quarter] + bytes(quarter) + data[3 * quarter :]
