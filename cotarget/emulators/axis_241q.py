"""Emulated Axis 241Q video server: VAPIX 2 over HTTP/1.0, as its manuals describe it, in front of feeds of images.

`AxisServer` gives snapshots, MJPEG streams, parameters and the state of the inputs, with basic or digest
authentication, and has faults that can be switched on (`AXIS_FAULTS`). A thread serves each connection: a slow viewer
delays no other one, and gets the newest image when it is ready.
"""

import base64
import binascii
import contextlib
import hashlib
import hmac
import http.client
import math
import re
import secrets
import select
import selectors
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from email.message import Message
from http import HTTPStatus
from types import TracebackType
from typing import BinaryIO, Literal
from urllib.parse import parse_qsl, urlsplit
from urllib.request import parse_http_list, parse_keqv_list

import cv2
import numpy as np

from cotarget.emulators.faults import Faults
from cotarget.emulators.plant import Feed, Picture
from cotarget.errors import DeviceError
from cotarget.rig import Image

# HTTP requests and replies

# Limits of a request: its line [bytes], its body [bytes], its arguments. More is refused.
LINE_BYTES = 8192
BODY_BYTES = 65536
MAX_ARGUMENTS = 64
# Content types of a form; the package axis on PyPI sends plain text, which real units accept.
FORMS = ("application/x-www-form-urlencoded", "text/plain")


class HttpError(Exception):
    """A request that is refused with an HTTP status.

    Attributes:
        status: of the reply.
        headers: further header lines of the reply.
    """

    def __init__(self, status: HTTPStatus, headers: Iterable[str] = ()) -> None:
        super().__init__(status.phrase)
        self.status = status
        self.headers = tuple(headers)


@dataclass(frozen=True)
class HttpRequest:
    """A parsed HTTP request.

    Attributes:
        method: such as "GET".
        target: as in the request line, with the arguments.
        path: of the target, without the arguments.
        arguments: of the target and of a form in the body; the last value of a name counts.
        headers: names are not case-sensitive.
    """

    method: str
    target: str
    path: str
    arguments: Mapping[str, str]
    headers: Message


def read_request(stream: BinaryIO) -> HttpRequest | None:
    """Read one request; None if the client closed without one.

    Raises:
        HttpError: the request cannot be parsed.
        OSError: the connection broke.
    """
    line = stream.readline(LINE_BYTES)
    if not line:
        return None
    words = line.decode("latin-1").split()
    if len(words) != 3 or not words[2].startswith("HTTP/1.") or not line.endswith(b"\n"):
        raise HttpError(HTTPStatus.BAD_REQUEST)
    try:
        headers: Message = http.client.parse_headers(stream)
        url = urlsplit(words[1])
        pairs = parse_qsl(url.query, keep_blank_values=True, max_num_fields=MAX_ARGUMENTS)
        pairs += _form(headers, stream)
    except (http.client.HTTPException, ValueError):
        raise HttpError(HTTPStatus.BAD_REQUEST) from None
    return HttpRequest(words[0], words[1], url.path, dict(pairs), headers)


def _form(headers: Message, stream: BinaryIO) -> list[tuple[str, str]]:
    # The body is read even if it is not used: closing a socket with unread bytes may lose the reply.
    length = int(headers.get("Content-Length", "0"))
    if not 0 <= length <= BODY_BYTES:
        raise ValueError
    body = stream.read(length)
    if len(body) < length:
        raise ValueError
    if headers.get_content_type() not in FORMS:
        return []
    return parse_qsl(body.decode("latin-1"), keep_blank_values=True, max_num_fields=MAX_ARGUMENTS)


def reply_head(status: HTTPStatus, headers: Iterable[str] = ()) -> bytes:
    """Encode status line, headers and the empty line of a reply."""
    lines = [f"HTTP/1.0 {status.value} {status.phrase}", *headers, "", ""]
    return "\r\n".join(lines).encode("latin-1")


def text_reply(text: str) -> bytes:
    """Encode a reply in plain text; as in the manual, it ends with the connection."""
    return reply_head(HTTPStatus.OK, ["Content-Type: text/plain"]) + text.encode("latin-1", "replace")


def error_reply(error: HttpError) -> bytes:
    """Encode the reply to a refused request: a page with its status."""
    body = f"<HTML><BODY><H1>{error.status.value} {error.status.phrase}</H1></BODY></HTML>\r\n".encode("latin-1")
    headers = [*error.headers, "Content-Type: text/html", f"Content-Length: {len(body)}"]
    return reply_head(error.status, headers) + body


# Authentication: basic and digest of RFC 2617 with qop=auth

Scheme = Literal["digest", "basic"]
# How long a nonce is valid [s], and how many are stored; an older one gets a new nonce and "stale".
NONCE_LIFE_S = 300.0
MAX_NONCES = 1000


def _md5(*words: str) -> str:
    return hashlib.md5(":".join(words).encode(), usedforsecurity=False).hexdigest()


def _same(a: str, b: str) -> bool:
    return hmac.compare_digest(a.encode(), b.encode())


class Authenticator:
    """Check the authorization of requests; safe to use from any thread.

    Args:
        user: user name; empty if everyone may connect.
        password: of that user.
        scheme: of authentication.
        realm: in the challenge to the client.
        now: returns the time [s].
    """

    def __init__(
        self, user: str, password: str, scheme: Scheme, realm: str, now: Callable[[], float] = time.monotonic
    ) -> None:
        self._user, self._password, self._scheme, self._realm, self._now = user, password, scheme, realm, now
        self._issued: dict[str, float] = {}
        self._used: dict[str, set[str]] = {}
        self._lock = threading.Lock()

    def refuse(self, request: HttpRequest) -> str | None:
        """Return the challenge that refuses a request; None if it is allowed."""
        if not self._user:
            return None
        scheme, _, rest = request.headers.get("Authorization", "").partition(" ")
        if scheme.lower() != self._scheme:
            return self.challenge()
        if self._scheme == "basic":
            return None if self._basic(rest) else self.challenge()
        try:
            fields = parse_keqv_list(parse_http_list(rest))
        except (ValueError, IndexError):
            return self.challenge()
        if not self._digest(request, fields):
            return self.challenge()
        return None if self._fresh(fields["nonce"], fields["nc"]) else self.challenge(stale=True)

    def challenge(self, stale: bool = False) -> str:
        """Make the header line that demands authentication; ``stale`` if only the client's nonce is too old."""
        if self._scheme == "basic":
            return f'WWW-Authenticate: Basic realm="{self._realm}"'
        nonce, now = secrets.token_hex(16), self._now()
        with self._lock:
            self._issued[nonce], self._used[nonce] = now, set()
            while len(self._issued) > MAX_NONCES:
                oldest = next(iter(self._issued))
                del self._issued[oldest], self._used[oldest]
        tail = ", stale=true" if stale else ""
        return f'WWW-Authenticate: Digest realm="{self._realm}", nonce="{nonce}", algorithm=MD5, qop="auth"{tail}'

    def _basic(self, token: str) -> bool:
        try:
            told = base64.b64decode(token.strip(), validate=True).decode("utf-8")
        except (binascii.Error, ValueError):
            return False
        return _same(told, f"{self._user}:{self._password}")

    def _digest(self, request: HttpRequest, fields: dict[str, str]) -> bool:
        def field(name: str) -> str:
            return fields.get(name, "")

        count = field("nc")
        if field("qop") != "auth" or field("uri") != request.target or len(count) != 8 or not field("cnonce"):
            return False
        # RFC 2617, 3.2.2.1
        secret = _md5(self._user, self._realm, self._password)
        asked = _md5(request.method, field("uri"))
        wanted = _md5(secret, field("nonce"), count, field("cnonce"), "auth", asked)
        known = _same(field("username"), self._user) and _same(field("realm"), self._realm)
        return _same(field("response"), wanted) and known

    def _fresh(self, nonce: str, count: str) -> bool:
        # The nonce must be this server's, not too old, and new with this count: a recorded request cannot be replayed.
        with self._lock:
            issued = self._issued.get(nonce)
            if issued is None or self._now() - issued > NONCE_LIFE_S or count in self._used[nonce]:
                return False
            self._used[nonce].add(count)
            return True


# Images: requested by VAPIX arguments, scaled, and encoded once for all viewers

Size = tuple[int, int]
Standard = Literal["PAL", "NTSC"]
Camera = int | Literal["quad"]
# The 241Q has four inputs; one without a feed has no video.
INPUTS = (1, 2, 3, 4)
# Sizes by VAPIX's names [px]; NTSC images are 480/576 as high.
PAL_SIZES: Mapping[str, Size] = {
    "4CIF": (704, 576),
    "2CIFEXP": (704, 576),
    "2CIF": (704, 288),
    "CIF": (352, 288),
    "QCIF": (176, 144),
}
# Sizes accepted as WxH [px]: from the smallest side to this size, or the camera's own where that is larger.
SMALLEST_SIDE, LARGEST_SIZE = 16, (768, 576)
# Axis' default compression, at which the JPEG quality is the server's ``quality``; linear from there to 0, the finest,
# and to 100. The ARTPEC chip's own scale is not documented.
DEFAULT_COMPRESSION = 30
FINEST_QUALITY, COARSEST_QUALITY = 100, 10
# Colour (BGR) of the image of an input without a signal.
NO_VIDEO_COLOUR = (160, 40, 20)
# Number of stored variants (camera, size, compression).
MAX_VARIANTS = 64


def named_sizes(standard: Standard) -> dict[str, Size]:
    """List the named sizes of a television standard [px]."""
    height = {"PAL": 576, "NTSC": 480}[standard]
    return {name: (size[0], size[1] * height // 576) for name, size in PAL_SIZES.items()}


@dataclass(frozen=True)
class Order:
    """A client's request for images.

    Attributes:
        camera: number of the input, or all four in one image.
        size: (width, height) [px]; None for the camera's own.
        compression: 0 to 100, less is finer.
        rate_hz: highest frame rate; 0 for no limit.
        duration: of the stream [s]; 0 for no end.
        count: number of images in the stream; 0 for no end.
        show_length: whether a snapshot has a Content-Length.
    """

    camera: Camera
    size: Size | None
    compression: int
    rate_hz: float
    duration: float
    count: int
    show_length: bool


def parse_order(arguments: Mapping[str, str], camera: str | None, sizes: Mapping[str, Size]) -> Order:
    """Parse VAPIX's arguments for images; unknown ones are ignored, as by the server.

    Args:
        arguments: of the request.
        camera: camera in the path, if there is one.
        sizes: the named sizes.

    Raises:
        HttpError: a value is invalid (400).
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
    if not 0 <= value <= highest:  # refuses nan too
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
    """Limiter of the frame rate that delays no image.

    Args:
        rate_hz: images a second; 0 for no limit.
    """

    # An image may come this part of a period early, so that jitter loses none of a source at exactly this rate.
    EARLY = 0.25

    def __init__(self, rate_hz: float) -> None:
        self._period = 1 / rate_hz if rate_hz else 0.0
        self._due = -math.inf

    def due(self, now: float) -> bool:
        """Return whether the image that is there ``now`` [s] is to be sent."""
        if now < self._due - self.EARLY * self._period:
            return False
        # Counted from the due time, so that the mean rate is right; a slower source gains half a period at most.
        self._due = max(self._due, now - self._period / 2) + self._period
        return True


class _Variant:
    """The newest JPEG of one camera at one size and compression."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.index = -1
        self.data = b""


class Pictures:
    """The server's inputs, and their newest JPEG of every requested size; safe to use from any thread.

    Args:
        feeds: by the number of the input.
        quality: of JPEG, 0 to 100, at Axis' default compression.
        faults: of the server.
        blank: size of the image of an input without feed [px].
    """

    def __init__(self, feeds: Mapping[int, Feed], quality: int, faults: Faults, blank: Size) -> None:
        self._feeds, self._quality, self._faults, self._blank = dict(feeds), quality, faults, blank
        self._variants: dict[tuple[Camera, Size, int, bool], _Variant] = {}
        self._lock = threading.Lock()

    def video(self, camera: int) -> bool:
        """Return whether an input has a signal."""
        return camera in self._feeds and "no-video" not in self._faults

    def wait(self, camera: Camera, after: int, timeout: float) -> Picture | None:
        """Wait for the newest image above an index, unscaled; None if none comes within ``timeout`` [s]."""
        feed = self._feeds.get(min(self._feeds, default=1) if camera == "quad" else camera)
        if feed is not None:
            return feed.newest(after, timeout)
        if after >= 0:
            time.sleep(timeout)  # an input without a signal also has a frame rate
        return Picture(blank_picture(self._blank), after + 1, time.monotonic())

    def own_size(self, camera: int) -> Size:
        """Return (width, height) of an input's images for a client that requests no size [px]."""
        feed = self._feeds.get(camera)
        picture = None if feed is None else feed.newest()
        return self._blank if picture is None else (picture.image.shape[1], picture.image.shape[0])

    def check(self, order: Order, picture: Picture) -> None:
        """Refuse a request for a size that a camera cannot give.

        Raises:
            HttpError: the size is out of range (400).
        """
        if order.size is None:
            return
        largest = np.maximum(picture.image.shape[1::-1], LARGEST_SIZE)
        if min(order.size) < SMALLEST_SIDE or (order.size > largest).any():
            raise HttpError(HTTPStatus.BAD_REQUEST)

    def size(self, order: Order, picture: Picture) -> Size:
        """Return (width, height) of the image that a request gets [px]."""
        size = order.size or (picture.image.shape[1], picture.image.shape[0])
        return (size[0] // 2, size[1] // 2) if "resolution" in self._faults else size

    def jpeg(self, order: Order, picture: Picture) -> tuple[int, bytes]:
        """Encode an image, or take a newer one that another viewer's thread has encoded; return its index and JPEG."""
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
    """Scale an image to (width, height) [px]; the aspect ratio may change, as with PAL and NTSC."""
    if (image.shape[1], image.shape[0]) == size:
        return image
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def encode(image: Image, quality: int) -> bytes:
    """Encode a JPEG at a quality of 0 to 100."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(data)


def blank_picture(size: Size) -> Image:
    """Make the image of an input without a signal."""
    image = np.full((size[1], size[0], 3), NO_VIDEO_COLOUR, np.uint8)
    scale = size[0] / 400
    cv2.putText(image, "No video", (size[0] // 10, size[1] // 2), cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255))
    return image


def damaged(data: bytes, index: int) -> bytes:
    """Destroy bytes of a JPEG, keeping its length: in turn at its start, at its end and in the middle."""
    quarter = len(data) // 4
    match index % 3:
        case 0:
            return bytes(quarter) + data[quarter:]
        case 1:
            return data[:-quarter] + bytes(quarter)
        case _:
            return data[: 2 * quarter] + bytes(quarter) + data[3 * quarter :]


# Answers in plain text

# The 241Q's last firmware, which has VAPIX 2.
FIRMWARE = "4.48"
# Arguments of ptz.cgi that request motion.
PTZ_MOTIONS = ("move", "pan", "tilt", "rpan", "rtilt", "zoom", "rzoom", "center", "areazoom")


def parameters(serial: str, standard: str, sizes: Iterable[str], resolutions: Iterable[str]) -> dict[str, str]:
    """Make the parameters that `param.cgi` lists, in its order.

    Args:
        serial: number of the unit.
        standard: of the television signal.
        sizes: names of the sizes.
        resolutions: of each input, for a client that requests no size.
    """
    sizes = list(sizes)
    listed = {
        "Brand.Brand": "AXIS",
        "Brand.ProdFullName": "AXIS 241Q Video Server",
        "Brand.ProdNbr": "241Q",
        "Brand.ProdShortName": "AXIS 241Q",
        "Brand.ProdType": "Video Server",
        "Brand.WebURL": "http://www.axis.com",
        "Image.NbrOfConfigs": str(len(INPUTS)),
    }
    for i, resolution in enumerate(resolutions):
        listed |= {
            f"Image.I{i}.Name": f"Video {i + 1}",
            f"Image.I{i}.Source": str(i),
            f"Image.I{i}.Appearance.Resolution": resolution,
            f"Image.I{i}.Appearance.Compression": str(DEFAULT_COMPRESSION),
            f"Image.I{i}.Appearance.ColorEnabled": "yes",
            f"Image.I{i}.Appearance.MirrorEnabled": "no",
            f"Image.I{i}.Appearance.Rotation": "0",
            f"Image.I{i}.Stream.Duration": "0",
            f"Image.I{i}.Stream.FPS": "0",
            f"Image.I{i}.Stream.NbrOfFrames": "0",
        }
    listed["ImageSource.NbrOfSources"] = str(len(INPUTS))
    for i in range(len(INPUTS)):
        listed |= {f"ImageSource.I{i}.Name": f"Video {i + 1}", f"ImageSource.I{i}.Video.DetectedType": standard}
    listed |= {
        "Properties.API.HTTP.AdminPath": "/operator/basic.shtml",
        "Properties.API.HTTP.Version": "2",
        "Properties.Firmware.BuildDate": "Jan 01 2009 12:00",
        "Properties.Firmware.BuildNumber": "1",
        "Properties.Firmware.Version": FIRMWARE,
        "Properties.Image.Format": "jpeg,mjpeg",
        "Properties.Image.Resolution": ",".join(sizes),
        "Properties.PTZ.PTZ": "no",
        "Properties.System.SerialNumber": serial,
    }
    return {f"root.{name}": value for name, value in listed.items()}


def list_parameters(listed: Mapping[str, str], arguments: Mapping[str, str]) -> str:
    """Answer `param.cgi?action=list`, with ``group`` for some only; the text names an unknown group."""
    if arguments.get("action") != "list":
        return f"# Error: Unknown action '{arguments.get('action', '')}'\n"
    lines = []
    for group in arguments.get("group", "root").split(","):
        name = group if group == "root" or group.startswith("root.") else f"root.{group}"
        found = [f"{key}={value}" for key, value in listed.items() if f"{key}.".startswith(f"{name}.")]
        lines += found or [f"# Error: Error -1 getting param in group '{group}'"]
    return "".join(f"{line}\n" for line in lines)


def video_status(video: Callable[[int], bool], arguments: Mapping[str, str]) -> str:
    """Answer `videostatus.cgi?status=1,2`: which inputs have a signal.

    Raises:
        HttpError: there is no such input (400).
    """
    asked = arguments.get("status", ",".join(map(str, INPUTS))).split(",")
    if not set(asked) <= set(map(str, INPUTS)):
        raise HttpError(HTTPStatus.BAD_REQUEST)
    return "".join(f"Video {number} = {'video' if video(int(number)) else 'no video'}\n" for number in asked)


def image_size(size: Size) -> str:
    """Answer `imagesize.cgi`."""
    return f"image width = {size[0]}\nimage height = {size[1]}\n"


def fixed_ptz(arguments: Mapping[str, str]) -> str | None:
    """Answer `com/ptz.cgi` for a stationary camera; None for an empty answer (204).

    The camera is at zero, its limits are zero, and a request to move is refused. The real server's wording is unknown.
    """
    match arguments.get("query"):
        case "position":
            return "pan=0\ntilt=0\nzoom=1\n"
        case "limits":
            return "MinPan=0\nMaxPan=0\nMinTilt=0\nMaxTilt=0\nMinZoom=1\nMaxZoom=1\n"
        case None:
            moves = any(name in arguments for name in PTZ_MOTIONS)
            return "Error: this camera has no pan, tilt or zoom\n" if moves else None
        case query:
            return f"Error: unknown query '{query}'\n"


# Streams

BOUNDARY = "--myboundary"
# Period with which a waiting sender checks whether the server closes or the client is gone [s].
LOOK_S = 0.1
# Time limit for a camera's first image [s].
FIRST_PICTURE_S = 2.0
# Error of a wrong Content-Length [bytes].
LENGTH_ERROR = 777
# Faults that end open streams.
ENDING = ("unauthorized", "busy", "refuse")


class Sender:
    """Send images over one connection, with the faults that are on.

    Args:
        connection: to the client.
        pictures: of the server.
        faults: of the server.
        closing: set when the server closes.
        early_boundary: whether a boundary is sent at once after its image, instead of just before the next.
        sent: called with each part's image index and the time at which its first byte is sent [s].
    """

    def __init__(
        self,
        connection: socket.socket,
        pictures: Pictures,
        faults: Faults,
        closing: threading.Event,
        early_boundary: bool,
        sent: Callable[[int, float], None] | None,
    ) -> None:
        self._connection, self._pictures, self._faults, self._closing = connection, pictures, faults, closing
        self._early, self._sent = early_boundary, sent

    def first(self, order: Order) -> Picture:
        """Wait for the newest image of a camera.

        Raises:
            HttpError: there is none (503), or not of the requested size (400).
        """
        deadline = time.monotonic() + FIRST_PICTURE_S
        while not self._closing.is_set() and time.monotonic() < deadline:
            if picture := self._pictures.wait(order.camera, -1, LOOK_S):
                self._pictures.check(order, picture)
                return picture
        raise HttpError(HTTPStatus.SERVICE_UNAVAILABLE)

    def snapshot(self, order: Order) -> None:
        """Send a single image."""
        index, data = self._pictures.jpeg(order, self.first(order))
        headers, data = self._spoil(index, data)
        if not order.show_length:
            headers = headers[:1]
        self._send(reply_head(HTTPStatus.OK, headers), data, b"")

    def stream(self, order: Order) -> None:
        """Send images, always the newest next, until the request is fulfilled or the client is gone."""
        self.first(order)
        dashes = "--" if "dashed-boundary" in self._faults else ""
        kind = f"Content-Type: multipart/x-mixed-replace;boundary={dashes}{BOUNDARY[2:]}"
        opening = f"{BOUNDARY}\r\n" if self._early else ""
        self._connection.sendall(reply_head(HTTPStatus.OK, [kind]) + opening.encode())
        pace, last, count = Pace(order.rate_hz), -1, 0
        end = time.monotonic() + order.duration if order.duration else float("inf")
        while time.monotonic() < end and not (order.count and count == order.count) and self._goes_on():
            picture = self._pictures.wait(order.camera, last, LOOK_S)
            if picture is None:
                if self._gone():
                    return
                continue
            last = picture.index
            if not pace.due(time.monotonic()):
                continue
            index, data = self._pictures.jpeg(order, picture)
            last = max(last, index)
            if not self._part(index, data):
                return
            count += 1

    def _goes_on(self) -> bool:
        return not self._closing.is_set() and not any(name in self._faults for name in ENDING)

    def _part(self, index: int, data: bytes) -> bool:
        headers, data = self._spoil(index, data)
        head = "\r\n".join([*([] if self._early else [BOUNDARY]), *headers, "", ""])
        tail = f"\r\n{BOUNDARY}\r\n" if self._early else "\r\n"
        if self._sent is not None:
            self._sent(index, time.monotonic())
        return self._send(head.encode(), data, tail.encode())

    def _spoil(self, index: int, data: bytes) -> tuple[list[str], bytes]:
        """Make the headers and bytes of an image, with the faults that are on."""
        length = len(data)
        if "wrong-length" in self._faults:  # in turn too long and too short
            length += LENGTH_ERROR if index % 2 else -LENGTH_ERROR
        if "corrupt" in self._faults:
            data = damaged(data, index)
        headers = ["Content-Type: image/jpeg", f"Content-Length: {max(length, 0)}"]
        return headers[:1] if "no-length" in self._faults else headers, data

    def _send(self, head: bytes, data: bytes, tail: bytes) -> bool:
        """Send an image; return whether the connection can take another."""
        whole, middle = head + data + tail, len(head) + len(data) // 2
        if "cut" in self._faults:
            self._connection.sendall(whole[:middle])
            return False
        if "stall" in self._faults:
            self._connection.sendall(whole[:middle])
            while not self._faults.wait_while("stall", LOOK_S):
                if not self._goes_on() or "cut" in self._faults or self._gone():
                    return False
            whole = whole[middle:]
        self._connection.sendall(whole)
        return True

    def _gone(self) -> bool:
        """Return whether the client has closed its side; a viewer sends nothing."""
        readable, _, _ = select.select([self._connection], [], [], 0)
        return bool(readable) and not self._connection.recv(1, socket.MSG_PEEK)


# The server

# Faults. Those that refuse a client (unauthorized, busy, refuse) also end open streams, as a server does that restarts
# with other settings.
AXIS_FAULTS = (
    "stall",  # an image stops half way, and goes on when the fault is off
    "cut",  # the connection closes half way
    "corrupt",  # bytes of the JPEG are destroyed, in turn at its start, at its end and in the middle
    "wrong-length",  # Content-Length is in turn too short and too long
    "no-length",  # no Content-Length
    "dashed-boundary",  # the boundary in a stream's header has the leading dashes
    "unauthorized",  # 401 for any password
    "busy",  # 503
    "no-video",  # the inputs have no signal, and their images show that
    "frozen",  # the same JPEG is repeated
    "resolution",  # half the requested size
    "refuse",  # connections are closed at once
)
# Time limit for a client to send its request, or to receive an image [s].
PATIENCE_S = 30.0
# Largest number of connections, viewers and others.
MAX_CONNECTIONS = 64
# Time limit [s] and number of reads for a refused client to close.
DRAIN_S, DRAIN_READS = 1.0, 64
LAST_PORT = 65535
# SO_LINGER on, 0 s: closing sends a reset.
RESET = struct.pack("ii", 1, 0)
CGI = r"/axis-cgi/(?:(?:admin|operator|view)/)?"
CAMERA = r"(?:(?P<camera>[^/]+)/)?"
PATHS = {
    "parameters": re.compile(CGI + r"param\.cgi"),
    "status": re.compile(CGI + r"videostatus\.cgi"),
    "size": re.compile(CGI + r"imagesize\.cgi"),
    "ptz": re.compile(r"/axis-cgi/com/ptz\.cgi"),
    "snapshot": re.compile(rf"/axis-cgi/jpg/image\.cgi|/jpg/{CAMERA}image\.jpg"),
    "stream": re.compile(rf"/axis-cgi/mjpg/video\.cgi|/mjpg/{CAMERA}video\.mjpg"),
}


@dataclass(frozen=True)
class AxisUnit:
    """Properties that differ between units.

    Attributes:
        serial: number of the unit, which is its MAC address.
        standard: of the television signal.
        viewers: largest number of streams.
        early_boundary: whether a stream's boundary is sent at once after an image, instead of just before the next; the
            bytes are the same, but the first ones of a part come a frame period early.
        parameters: further or replaced parameters, by full names such as "root.Brand.ProdNbr".
    """

    serial: str = "00408C000241"
    standard: Standard = "PAL"
    viewers: int = 20
    early_boundary: bool = False
    parameters: Mapping[str, str] = field(default_factory=dict)


class AxisServer:
    """The emulated server, which runs from its construction until it is closed; a context manager.

    Args:
        feeds: of images, by the number of the input, from 1 to 4.
        host: address to listen at.
        port: to listen at; 0 for any free port.
        user: user name; empty if everyone may connect.
        password: of that user.
        auth: scheme of authentication.
        quality: of JPEG, 0 to 100, at Axis' default compression of 30.
        faults: of `AXIS_FAULTS`; may be switched on and off at any time.
        sent: called for each part of each stream with the index of its image and the time at which its first byte is
            sent, on the machine's monotonic clock [s].
        unit: properties of the unit.

    Raises:
        DeviceError: the address is invalid or in use.
    """

    def __init__(
        self,
        feeds: Mapping[int, Feed],
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        user: str = "",
        password: str = "",
        auth: Scheme = "digest",
        quality: int = 70,
        faults: Faults | None = None,
        sent: Callable[[int, float], None] | None = None,
        unit: AxisUnit | None = None,
    ) -> None:
        self.faults = Faults(AXIS_FAULTS) if faults is None else faults
        self._unit = AxisUnit() if unit is None else unit
        self._sizes = named_sizes(self._unit.standard)
        self._pictures = Pictures(feeds, quality, self.faults, self._sizes["4CIF"])
        self._guard = Authenticator(user, password, auth, f"AXIS_{self._unit.serial}")
        self._sent = sent
        self._viewers = 0
        self._connections: set[socket.socket] = set()
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        self._closing = threading.Event()
        if not 0 <= port <= LAST_PORT:
            raise DeviceError(f"the emulated Axis cannot listen at {host}:{port}: ports end at {LAST_PORT}")
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            self._listener = socket.create_server((host, port), family=family)
        except OSError as error:
            raise DeviceError(f"the emulated Axis cannot listen at {host}:{port}: {error}") from None
        self._listener.setblocking(False)
        self._wake, self._woken = socket.socketpair()
        address = f"[{host}]" if ":" in host else host
        self.url = f"http://{address}:{self._listener.getsockname()[1]}"
        self._acceptor = threading.Thread(target=self._accept, name="axis", daemon=True)
        self._acceptor.start()

    def __enter__(self) -> "AxisServer":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def viewers(self) -> int:
        """Number of open streams."""
        with self._lock:
            return self._viewers

    def close(self) -> None:
        """End every connection and every thread; may be called again."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._wake.close()
        self._acceptor.join()
        self._listener.close()
        self._woken.close()
        with self._lock:
            for connection in self._connections:
                with contextlib.suppress(OSError):  # the client may have gone already
                    connection.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()

    def _accept(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._listener, selectors.EVENT_READ)
            selector.register(self._woken, selectors.EVENT_READ)
            while not self._closing.is_set():
                selector.select()
                with contextlib.suppress(OSError):  # woken to close, or the client has gone already
                    self._admit(self._listener.accept()[0])

    def _admit(self, connection: socket.socket) -> None:
        with self._lock:
            if "refuse" in self.faults or len(self._connections) >= MAX_CONNECTIONS:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
                connection.close()
                return
            self._connections.add(connection)
        thread = threading.Thread(target=self._run, args=(connection,), name="axis connection", daemon=True)
        self._threads = [other for other in self._threads if other.is_alive()]
        self._threads.append(thread)
        thread.start()

    def _run(self, connection: socket.socket) -> None:
        try:
            with contextlib.suppress(OSError):  # the client is gone or too slow; no reply can reach it
                connection.settimeout(PATIENCE_S)
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                try:
                    self._converse(connection)
                except HttpError as error:
                    connection.sendall(error_reply(error))
                    _drain(connection)
        finally:
            with self._lock:
                self._connections.discard(connection)
                connection.close()

    def _converse(self, connection: socket.socket) -> None:
        with connection.makefile("rb") as stream:
            request = read_request(stream)
        if request is None:
            return
        challenge = self._guard.refuse(request)
        if "unauthorized" in self.faults:
            challenge = self._guard.challenge()
        if challenge is not None:
            raise HttpError(HTTPStatus.UNAUTHORIZED, [challenge])
        if "busy" in self.faults:
            raise HttpError(HTTPStatus.SERVICE_UNAVAILABLE)
        if request.method not in ("GET", "POST"):
            raise HttpError(HTTPStatus.NOT_IMPLEMENTED)
        for kind, pattern in PATHS.items():
            if match := pattern.fullmatch(request.path):
                self._answer(connection, kind, request, match.groupdict().get("camera"))
                return
        raise HttpError(HTTPStatus.NOT_FOUND)

    def _answer(self, connection: socket.socket, kind: str, request: HttpRequest, camera: str | None) -> None:
        arguments = request.arguments
        match kind:
            case "parameters":
                reply = text_reply(list_parameters(self._parameters(), arguments))
            case "status":
                reply = text_reply(video_status(self._pictures.video, arguments))
            case "ptz":
                told = fixed_ptz(arguments)
                reply = reply_head(HTTPStatus.NO_CONTENT) if told is None else text_reply(told)
            case _:
                self._show(connection, kind, parse_order(arguments, camera, self._sizes))
                return
        connection.sendall(reply)

    def _show(self, connection: socket.socket, kind: str, order: Order) -> None:
        unit = self._unit
        sender = Sender(connection, self._pictures, self.faults, self._closing, unit.early_boundary, self._sent)
        match kind:
            case "size":
                connection.sendall(text_reply(image_size(self._pictures.size(order, sender.first(order)))))
            case "snapshot":
                sender.snapshot(order)
            case _:
                with self._seat():
                    sender.stream(order)

    @contextlib.contextmanager
    def _seat(self) -> Iterator[None]:
        """Reserve a place for a viewer.

        Raises:
            HttpError: all are taken (503).
        """
        with self._lock:
            if self._viewers >= self._unit.viewers:
                raise HttpError(HTTPStatus.SERVICE_UNAVAILABLE)
            self._viewers += 1
        try:
            yield
        finally:
            with self._lock:
                self._viewers -= 1

    def _parameters(self) -> dict[str, str]:
        names = {size: name for name, size in reversed(self._sizes.items())}
        own = [self._pictures.own_size(camera) for camera in INPUTS]
        resolutions = [names.get(size, f"{size[0]}x{size[1]}") for size in own]
        return parameters(self._unit.serial, self._unit.standard, self._sizes, resolutions) | dict(
            self._unit.parameters
        )


def _drain(connection: socket.socket) -> None:
    """Read what a refused client still sends: closing with unread bytes may lose the reply."""
    connection.shutdown(socket.SHUT_WR)
    connection.settimeout(DRAIN_S)
    for _ in range(DRAIN_READS):
        if not connection.recv(LINE_BYTES):
            return
