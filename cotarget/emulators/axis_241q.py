"""An Axis 241Q video server on HTTP: VAPIX 2 as its manuals tell it, in front of feeds of pictures.

Snapshots, MJPEG streams, parameters, the state of the inputs, authentication; and what can go wrong with each. A thread
serves a connection: a viewer that is slow holds up no other, and gets the newest picture when it is ready for one.

What an Axis 241Q answers in plain text: its parameters, its inputs, the size of a picture, and a head it has not.

Who may look: basic and digest authentication of RFC 2617 with qop=auth, from the server's side.

Requests read and replies written: as much HTTP/1.0 as an Axis video server speaks. Bytes in, bytes out.

Pictures as an Axis video server gives them: asked for by VAPIX's arguments, scaled, and encoded once for all.

Sending pictures to one viewer: single, or as the parts of a stream, with whatever is to be wrong with them.
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

# Longest request line, largest body [bytes] and most arguments; beyond them a client is not one that we serve.
LINE_BYTES = 8192
BODY_BYTES = 65536
MAX_ARGUMENTS = 64
# How clients call a form that they send; PyPI's axis calls it plain text, and real units take it.
FORMS = ("application/x-www-form-urlencoded", "text/plain")


class HttpError(Exception):
    """A request that is answered by a status instead of what it asks for.

    Attributes:
        status: of the answer.
        headers: its further header lines.
    """

    def __init__(self, status: HTTPStatus, headers: Iterable[str] = ()) -> None:
        super().__init__(status.phrase)
        self.status = status
        self.headers = tuple(headers)


@dataclass(frozen=True)
class HttpRequest:
    """One request.

    Attributes:
        method: such as "GET".
        target: as it stands in the request line, with the arguments.
        path: of the target, without the arguments.
        arguments: of the target and of a form in the body; the last of a name counts.
        headers: case does not matter in their names.
    """

    method: str
    target: str
    path: str
    arguments: Mapping[str, str]
    headers: Message


def read_request(stream: BinaryIO) -> HttpRequest | None:
    """Read one request; None where the client closed without one.

    Raises:
        HttpError: it is no request that can be understood.
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
    # The body is read even where it is not used: closing a socket with bytes unread may lose the answer on its way.
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
    """Status line, headers and the empty line."""
    lines = [f"HTTP/1.0 {status.value} {status.phrase}", *headers, "", ""]
    return "\r\n".join(lines).encode("latin-1")


def text_reply(text: str) -> bytes:
    """An answer in plain text; as in the manual its end is the connection's."""
    return reply_head(HTTPStatus.OK, ["Content-Type: text/plain"]) + text.encode("latin-1", "replace")


def error_reply(error: HttpError) -> bytes:
    """The answer to a request that is refused: a page that says its status."""
    body = f"<HTML><BODY><H1>{error.status.value} {error.status.phrase}</H1></BODY></HTML>\r\n".encode("latin-1")
    headers = [*error.headers, "Content-Type: text/html", f"Content-Length: {len(body)}"]
    return reply_head(error.status, headers) + body


# --- axis_auth ---

Scheme = Literal["digest", "basic"]
# How long a nonce is good [s], and how many are remembered; an older one is answered by a new one and "stale".
NONCE_LIFE_S = 300.0
MAX_NONCES = 1000


def _md5(*words: str) -> str:
    return hashlib.md5(":".join(words).encode(), usedforsecurity=False).hexdigest()


def _same(a: str, b: str) -> bool:
    return hmac.compare_digest(a.encode(), b.encode())


class Authenticator:
    """Checks the authorization of requests; safe to use from any thread.

    Args:
        user: who may look; empty where everybody may.
        password: of that user.
        scheme: of authentication.
        realm: that the client is told.
        now: the time [s].
    """

    def __init__(
        self, user: str, password: str, scheme: Scheme, realm: str, now: Callable[[], float] = time.monotonic
    ) -> None:
        self._user, self._password, self._scheme, self._realm, self._now = user, password, scheme, realm, now
        self._issued: dict[str, float] = {}
        self._used: dict[str, set[str]] = {}
        self._lock = threading.Lock()

    def refuse(self, request: HttpRequest) -> str | None:
        """The challenge that a request must be answered with; None where it is allowed."""
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
        """The line that asks a client to authenticate itself; ``stale`` where only its nonce is too old."""
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
        # A nonce of ours, not too old, and not used with this count before: a request overheard is of no use.
        with self._lock:
            issued = self._issued.get(nonce)
            if issued is None or self._now() - issued > NONCE_LIFE_S or count in self._used[nonce]:
                return False
            self._used[nonce].add(count)
            return True


# --- axis_pictures ---

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


# --- axis_answers ---

# The 241Q's last firmware; VAPIX 2 goes with it.
FIRMWARE = "4.48"
# Arguments of ptz.cgi that ask for motion.
PTZ_MOTIONS = ("move", "pan", "tilt", "rpan", "rtilt", "zoom", "rzoom", "center", "areazoom")


def parameters(serial: str, standard: str, sizes: Iterable[str], resolutions: Iterable[str]) -> dict[str, str]:
    """The parameters that `param.cgi` lists, in its order.

    Args:
        serial: number of the unit.
        standard: of the television signal.
        sizes: the names of those that it has.
        resolutions: what each input gives to a client that asks for no size.
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
    """Answer `param.cgi?action=list`, with ``group`` for some only; an unknown group is told of in the text."""
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
        HttpError: the server has no such input (400).
    """
    asked = arguments.get("status", ",".join(map(str, INPUTS))).split(",")
    if not set(asked) <= set(map(str, INPUTS)):
        raise HttpError(HTTPStatus.BAD_REQUEST)
    return "".join(f"Video {number} = {'video' if video(int(number)) else 'no video'}\n" for number in asked)


def image_size(size: Size) -> str:
    """Answer `imagesize.cgi`."""
    return f"image width = {size[0]}\nimage height = {size[1]}\n"


def fixed_ptz(arguments: Mapping[str, str]) -> str | None:
    """Answer `com/ptz.cgi` for a camera that stands still; None where there is nothing to say (204).

    It is at zero and can go nowhere else, and an order to move is refused. The real server's words are not known.
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


# --- axis_stream ---

BOUNDARY = "--myboundary"
# How often a sender that waits for something looks whether its server closes or its client has gone [s].
LOOK_S = 0.1
# How long the first picture of a camera is waited for [s].
FIRST_PICTURE_S = 2.0
# What is missing, or too much, of a length that is wrong [bytes].
LENGTH_ERROR = 777
# Faults that end streams which are under way.
ENDING = ("unauthorized", "busy", "refuse")


class Sender:
    """Sends pictures over one connection.

    Args:
        connection: to the client.
        pictures: of the server.
        faults: of the server.
        closing: set when the server closes.
        early_boundary: whether a boundary is sent at once after its picture, instead of just before the next.
        sent: told each part's picture index, and when its first byte is sent [s].
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
        """The newest picture of a camera.

        Raises:
            HttpError: it has none (503), or not of the size that is asked for (400).
        """
        deadline = time.monotonic() + FIRST_PICTURE_S
        while not self._closing.is_set() and time.monotonic() < deadline:
            if picture := self._pictures.wait(order.camera, -1, LOOK_S):
                self._pictures.check(order, picture)
                return picture
        raise HttpError(HTTPStatus.SERVICE_UNAVAILABLE)

    def snapshot(self, order: Order) -> None:
        """Send a single picture."""
        index, data = self._pictures.jpeg(order, self.first(order))
        headers, data = self._spoil(index, data)
        if not order.show_length:
            headers = headers[:1]
        self._send(reply_head(HTTPStatus.OK, headers), data, b"")

    def stream(self, order: Order) -> None:
        """Send pictures, always the newest next, until the order is fulfilled or nobody listens any more."""
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
        """The headers and bytes of a picture, with the faults that are on."""
        length = len(data)
        if "wrong-length" in self._faults:  # by turns too long and too short
            length += LENGTH_ERROR if index % 2 else -LENGTH_ERROR
        if "corrupt" in self._faults:
            data = damaged(data, index)
        headers = ["Content-Type: image/jpeg", f"Content-Length: {max(length, 0)}"]
        return headers[:1] if "no-length" in self._faults else headers, data

    def _send(self, head: bytes, data: bytes, tail: bytes) -> bool:
        """Send a picture; whether the connection is still good for another."""
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
        """Whether the client has closed its side; it is not expected to say anything."""
        readable, _, _ = select.select([self._connection], [], [], 0)
        return bool(readable) and not self._connection.recv(1, socket.MSG_PEEK)


# What can be wrong with the server. Those that refuse a client (unauthorized, busy, refuse) also end the streams under
# way, as a server does that starts anew with other settings.
AXIS_FAULTS = (
    "stall",  # a picture stops half way, and goes on when the fault is off
    "cut",  # the connection closes half way
    "corrupt",  # bytes of the JPEG are destroyed, by turns at its start, at its end and amid its data
    "wrong-length",  # Content-Length, by turns too short and too long
    "no-length",  # no Content-Length
    "dashed-boundary",  # a stream's header tells its boundary with the dashes
    "unauthorized",  # 401 whatever the password
    "busy",  # 503
    "no-video",  # the inputs have no signal, and their pictures say so
    "frozen",  # the same JPEG again and again
    "resolution",  # half the size that was asked for
    "refuse",  # connections are closed at once
)
# How long a client may take to say what it wants, or to take a picture [s].
PATIENCE_S = 30.0
# Connections at a time, viewers and others.
MAX_CONNECTIONS = 64
# How long, and how often, a refused client is listened to until it closes [s].
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
    """What differs from one unit to another.

    Attributes:
        serial: number of the unit, which is its MAC address.
        standard: of the television signal.
        viewers: streams at a time.
        early_boundary: whether a stream's boundary is sent at once after a picture, instead of just before the next;
            the bytes are the same, but the first of a part then come a picture too early.
        parameters: besides those of a 241Q, or in their place; by full names such as "root.Brand.ProdNbr".
    """

    serial: str = "00408C000241"
    standard: Standard = "PAL"
    viewers: int = 20
    early_boundary: bool = False
    parameters: Mapping[str, str] = field(default_factory=dict)


class AxisServer:
    """The server, from its construction until it is closed; a context manager.

    Args:
        feeds: of pictures, by the number of the input, from 1 to 4.
        host: address to listen at.
        port: to listen at; 0 for any that is free.
        user: who may look; empty where everybody may.
        password: of that user.
        auth: scheme of authentication.
        quality: of JPEG, 0 to 100, at Axis' default compression of 30.
        faults: of `AXIS_FAULTS`; to be switched on and off at any time.
        sent: told, for each part of each stream, the index of its picture and when its first byte is sent, on the
            machine's monotonic clock [s].
        unit: which unit it is.

    Raises:
        DeviceError: the address cannot be listened at.
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
        """How many streams are under way."""
        with self._lock:
            return self._viewers

    def close(self) -> None:
        """End every connection and every thread; once more does no harm."""
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
            with contextlib.suppress(OSError):  # the client has gone, or is too slow; nobody is left to be told
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
        """One of the places for viewers.

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
    """Take what a refused client still sends: closing with bytes unread may lose the answer on its way."""
    connection.shutdown(socket.SHUT_WR)
    connection.settimeout(DRAIN_S)
    for _ in range(DRAIN_READS):
        if not connection.recv(LINE_BYTES):
            return
