"""Emulated Axis 241Q video server: VAPIX 2 over HTTP/1.0, as its manuals describe it, in front of feeds of images.

`AxisServer` gives snapshots, MJPEG streams, parameters and the state of the inputs, with basic or digest
authentication, and has faults that can be switched on (`AXIS_FAULTS`). A thread serves each connection: a slow viewer
delays no other one, and gets the newest image when it is ready.
"""

import math
import re
import secrets
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from urllib.parse import parse_qsl, urlsplit

import numpy as np

from cotarget.emulators.authentication import Authenticator, Scheme
from cotarget.emulators.plant import Feed, Picture, encode_jpeg
from cotarget.emulators.serve import LOCAL, Faults, TcpServer

# Requests and replies


class HttpError(Exception):
    """A request is refused with an HTTP status and further header lines."""

    def __init__(self, status: HTTPStatus, *headers: str) -> None:
        super().__init__(status.phrase)
        self.status = status
        self.headers = headers


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


# Images: requested by VAPIX arguments, scaled and encoded

Size = tuple[int, int]
INPUTS = (1, 2, 3, 4)  # one without a feed has no video
# Named sizes of PAL (width, height) [px].
SIZES: Mapping[str, Size] = {
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
# Image of an input without a signal (BGR).
BLANK = np.full((SIZES["4CIF"][1], SIZES["4CIF"][0], 3), (160, 40, 20), np.uint8)


@dataclass(frozen=True)
class ImageOptions:
    """What a client requests."""

    camera: int  # number of the input
    size: Size | None  # (width, height) [px]; None for the camera's own
    compression: int  # 0 to 100, less is finer
    rate_hz: float  # highest frame rate; 0 for no limit
    count: int  # number of images in a stream; 0 for no end


def parse_options(arguments: Mapping[str, str], camera: str | None = None) -> ImageOptions:
    """Parse VAPIX's arguments for images, and a camera in the path; unknown arguments are ignored.

    Raises:
        HttpError: a value is invalid (400).
    """
    which = arguments.get("camera", camera or "1")
    if which not in map(str, INPUTS):
        raise HttpError(HTTPStatus.BAD_REQUEST)
    rates = [_number(arguments, name, 1000) for name in ("fps", "req_fps", "des_fps")]
    return ImageOptions(
        camera=int(which),
        size=_size(arguments.get("resolution", "")),
        compression=int(_number(arguments, "compression", 100, DEFAULT_COMPRESSION)),
        rate_hz=min((rate for rate in rates if rate > 0), default=0.0),
        count=int(_number(arguments, "nbrofframes", 1e9)),
    )


def _number(arguments: Mapping[str, str], name: str, highest: float, default: float = 0.0) -> float:
    try:
        value = float(arguments.get(name, default))
    except ValueError:
        raise HttpError(HTTPStatus.BAD_REQUEST) from None
    if not 0 <= value <= highest:  # refuses nan too
        raise HttpError(HTTPStatus.BAD_REQUEST)
    return value


def _size(text: str) -> Size | None:
    if not text or text.upper() in SIZES:
        return SIZES.get(text.upper())
    match = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text, re.ASCII)
    if match is None:
        raise HttpError(HTTPStatus.BAD_REQUEST)
    return int(match[1]), int(match[2])


class Pace:
    """Limiter of the frame rate that delays no image; a rate of 0 is no limit."""

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


class Pictures:
    """The server's inputs, and their images as JPEG; safe to use from any thread."""

    def __init__(self, feeds: Mapping[int, Feed], quality: int, faults: Faults) -> None:
        self._feeds, self._quality, self._faults = dict(feeds), quality, faults
        self._shown: dict[int, Picture] = {}  # by the number of the input; repeated by the fault frozen

    def video(self, camera: int) -> bool:
        """Return whether an input has a signal."""
        return camera in self._feeds and "no-video" not in self._faults

    def wait(self, options: ImageOptions, after: int, timeout: float) -> Picture | None:
        """Wait for the newest image above an index, unscaled; None if none comes within ``timeout`` [s].

        Raises:
            HttpError: the camera cannot give the requested size (400).
        """
        if options.camera in self._feeds:
            picture = self._feeds[options.camera].newest(after, timeout)
        else:
            if after >= 0:
                time.sleep(timeout)  # an input without a signal also has a frame rate
            picture = Picture(BLANK, after + 1, time.monotonic())
        if picture is not None and options.size is not None:
            largest = np.maximum(picture.image.shape[1::-1], LARGEST_SIZE)
            if min(options.size) < SMALLEST_SIDE or (options.size > largest).any():
                raise HttpError(HTTPStatus.BAD_REQUEST)
        return picture

    def own_size(self, camera: int) -> str:
        """Return the size of an input's images for a client that requests none, by VAPIX's name or as WxH."""
        picture = self._feeds[camera].newest() if camera in self._feeds else None
        size = SIZES["4CIF"] if picture is None else picture.image.shape[1::-1]
        return next((name for name, known in SIZES.items() if known == size), f"{size[0]}x{size[1]}")

    def jpeg(self, options: ImageOptions, picture: Picture) -> bytes:
        """Encode an image as requested."""
        if "frozen" in self._faults:
            picture = self._shown.setdefault(options.camera, picture)
        self._shown[options.camera] = picture
        width, height = options.size or picture.image.shape[1::-1]
        if "resolution" in self._faults:
            width, height = width // 2, height // 2
        qualities = (FINEST_QUALITY, self._quality, COARSEST_QUALITY)
        quality = round(float(np.interp(options.compression, (0, DEFAULT_COMPRESSION, 100), qualities)))
        return encode_jpeg(BLANK if "no-video" in self._faults else picture.image, quality, (width, height))


def damaged(data: bytes, index: int) -> bytes:
    """Destroy bytes of a JPEG, keeping its length: in turn at its start, at its end and in the middle."""
    quarter = len(data) // 4
    start = (0, len(data) - quarter, 2 * quarter)[index % 3]
    return data[:start] + bytes(quarter) + data[start + quarter :]


# Answers in plain text

# The 241Q's last firmware, which has VAPIX 2.
FIRMWARE = "4.48"
SERIAL = "00408C000241"  # the unit's MAC address


def parameters(sizes: Iterable[str]) -> dict[str, str]:
    """Make the parameters that known clients read, in the order of `param.cgi`, from the inputs' sizes."""
    listed = {
        "Brand.Brand": "AXIS",
        "Brand.ProdFullName": "AXIS 241Q Video Server",
        "Brand.ProdNbr": "241Q",
        "Brand.ProdShortName": "AXIS 241Q",
        "Brand.ProdType": "Video Server",
        "Brand.WebURL": "http://www.axis.com",
    }
    for i, size in enumerate(sizes):
        listed |= {
            f"Image.I{i}.Name": f"Video {i + 1}",
            f"Image.I{i}.Appearance.Resolution": size,
            f"Image.I{i}.Appearance.Compression": str(DEFAULT_COMPRESSION),
            f"Image.I{i}.Stream.NbrOfFrames": "0",
        }
    listed |= {
        "ImageSource.NbrOfSources": str(len(INPUTS)),
        "Properties.API.HTTP.Version": "2",
        "Properties.Firmware.BuildDate": "Jan 01 2009 12:00",
        "Properties.Firmware.BuildNumber": "1",
        "Properties.Firmware.Version": FIRMWARE,
        "Properties.Image.Format": "jpeg,mjpeg",
        "Properties.Image.Resolution": ",".join(SIZES),
        "Properties.PTZ.PTZ": "no",
        "Properties.System.SerialNumber": SERIAL,
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


# The server

AXIS_FAULTS = (
    "stall",  # an image stops half way, and goes on when the fault is off
    "cut",  # the connection closes half way
    "corrupt",  # bytes of the JPEG are destroyed, in turn at its start, at its end and in the middle
    "wrong-length",  # Content-Length is in turn too short and too long
    "no-length",  # no Content-Length
    "dashed-boundary",  # the boundary in a stream's header has the leading dashes
    "unauthorized",  # 401 for any password
    "busy",  # 503
    "no-video",  # the inputs have no signal, and their images have one colour
    "frozen",  # the same image is repeated
    "resolution",  # half the requested size
    "refuse",  # connections are closed at once
)
# Faults that refuse a client also end open streams, as a server does that restarts with other settings.
REFUSING = ("unauthorized", "busy", "refuse")
BOUNDARY = "--myboundary"
VIEWERS = 20  # largest number of streams
CLIENT_TIMEOUT_S = 30.0  # time limit for a client to send its request, or to receive an image [s]
FIRST_PICTURE_S = 2.0  # time limit for a camera's first image [s]
CHECK_S = 0.1  # period with which a waiting sender checks whether the server closes or the client is gone [s]
LENGTH_ERROR = 777  # of a wrong Content-Length [bytes]
RESET = struct.pack("ii", 1, 0)  # SO_LINGER on, 0 s: closing sends a reset
CGI = r"/axis-cgi/(?:(?:admin|operator|view)/)?"
CAMERA = r"(?:(?P<camera>[^/]+)/)?"
PATHS = {
    "parameters": re.compile(CGI + r"param\.cgi"),
    "status": re.compile(CGI + r"videostatus\.cgi"),
    "snapshot": re.compile(rf"/axis-cgi/jpg/image\.cgi|/jpg/{CAMERA}image\.jpg"),
    "stream": re.compile(rf"/axis-cgi/mjpg/video\.cgi|/mjpg/{CAMERA}video\.mjpg"),
}


class AxisServer(TcpServer):
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
        more: further or replaced parameters, by full names such as "root.Brand.ProdNbr".
    """

    def __init__(
        self,
        feeds: Mapping[int, Feed],
        *,
        host: str = LOCAL,
        port: int = 0,
        user: str = "",
        password: str = "",
        auth: Scheme = "digest",
        quality: int = 70,
        faults: Faults | None = None,
        sent: Callable[[int, float], None] = lambda index, t: None,
        more: Mapping[str, str] | None = None,
    ) -> None:
        self.faults = Faults(AXIS_FAULTS) if faults is None else faults
        self.pictures = Pictures(feeds, quality, self.faults)
        self.guard = Authenticator(user, password, auth, f"AXIS_{SERIAL}", secrets.token_hex(16))
        self.note_sent, self.more = sent, dict(more or {})
        self.places = threading.BoundedSemaphore(VIEWERS)
        super().__init__(self._serve_request, host, port)

    @property
    def url(self) -> str:
        """URL of the server, without a path."""
        return f"http://[{self.host}]:{self.port}" if ":" in self.host else f"http://{self.host}:{self.port}"

    def _serve_request(self, connection: socket.socket) -> None:
        if "refuse" in self.faults:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            return
        connection.settimeout(CLIENT_TIMEOUT_S)
        Request(connection, self)


class Request(BaseHTTPRequestHandler):
    """One request, parsed and answered on construction."""

    default_request_version = "HTTP/1.0"  # of a request line without one

    def __init__(self, connection: socket.socket, device: AxisServer) -> None:
        self.device, self.faults = device, device.faults
        super().__init__(connection, None, device)  # type: ignore[arg-type]

    def handle_one_request(self) -> None:
        """Parse the request and answer it."""
        try:
            self.raw_requestline = self.rfile.readline(65537)
            if self.raw_requestline and self.parse_request():
                self._answer(self._arguments())
        except HttpError as error:
            self.connection.sendall(error_reply(error))

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuse a request that cannot be parsed."""
        raise HttpError(HTTPStatus.BAD_REQUEST)

    def _arguments(self) -> dict[str, str]:
        """Parse the arguments of the target and of a form in the body; the last value of a name counts."""
        # The body is read even if it is not used: closing a socket with unread bytes may lose the reply.
        try:
            body = self.rfile.read(int(self.headers.get("Content-Length", "0")))
            pairs = parse_qsl(urlsplit(self.path).query, keep_blank_values=True)
        except ValueError:
            raise HttpError(HTTPStatus.BAD_REQUEST) from None
        # The package axis on PyPI sends plain text, which real units accept.
        if self.headers.get_content_type() in ("application/x-www-form-urlencoded", "text/plain"):
            pairs += parse_qsl(body.decode("latin-1"), keep_blank_values=True)
        return dict(pairs)

    def _answer(self, arguments: Mapping[str, str]) -> None:
        """Answer the parsed request.

        Raises:
            HttpError: it is refused.
        """
        device = self.device
        if "unauthorized" in self.faults or not device.guard.allows(self.command, self.path, self.headers):
            raise HttpError(HTTPStatus.UNAUTHORIZED, device.guard.challenge)
        if "busy" in self.faults:
            raise HttpError(HTTPStatus.SERVICE_UNAVAILABLE)
        if self.command not in ("GET", "POST"):
            raise HttpError(HTTPStatus.NOT_IMPLEMENTED)
        path = urlsplit(self.path).path
        kind, match = next(((k, m) for k, form in PATHS.items() if (m := form.fullmatch(path))), (None, None))
        match kind:
            case "parameters":
                listed = parameters(map(device.pictures.own_size, INPUTS)) | device.more
                self.connection.sendall(text_reply(list_parameters(listed, arguments)))
            case "status":
                self.connection.sendall(text_reply(video_status(device.pictures.video, arguments)))
            case "snapshot" | "stream":
                assert match is not None
                options = parse_options(arguments, match["camera"])
                (self._snapshot if kind == "snapshot" else self._stream)(options)
            case _:
                raise HttpError(HTTPStatus.NOT_FOUND)

    def _first(self, options: ImageOptions) -> Picture:
        """Wait for the newest image of a camera.

        Raises:
            HttpError: there is none (503), or not of the requested size (400).
        """
        deadline = time.monotonic() + FIRST_PICTURE_S
        while not self.device.closing.is_set() and time.monotonic() < deadline:
            if picture := self.device.pictures.wait(options, -1, CHECK_S):
                return picture
        raise HttpError(HTTPStatus.SERVICE_UNAVAILABLE)

    def _snapshot(self, options: ImageOptions) -> None:
        picture = self._first(options)
        headers, data = self._with_faults(picture.index, self.device.pictures.jpeg(options, picture))
        self._send(reply_head(HTTPStatus.OK, headers), data, b"")

    def _stream(self, options: ImageOptions) -> None:
        """Send images, always the newest next, until the request is fulfilled or the client is gone.

        Raises:
            HttpError: all places for viewers are taken, or there is no image (503).
        """
        if not self.device.places.acquire(blocking=False):
            raise HttpError(HTTPStatus.SERVICE_UNAVAILABLE)
        try:
            self._first(options)
            dashes = "--" if "dashed-boundary" in self.faults else ""
            kind = f"Content-Type: multipart/x-mixed-replace;boundary={dashes}{BOUNDARY[2:]}"
            self.connection.sendall(reply_head(HTTPStatus.OK, [kind]))
            for sent, (index, data) in enumerate(self._newest(options), 1):
                if not self._part(index, data) or sent == options.count:
                    return
        finally:
            self.device.places.release()

    def _newest(self, options: ImageOptions) -> Iterator[tuple[int, bytes]]:
        """Yield index and JPEG of the newest image, each once, at the requested rate, until the stream ends."""
        pace, last = Pace(options.rate_hz), -1
        while self._is_open():
            picture = self.device.pictures.wait(options, last, CHECK_S)
            if picture is None:
                if self._client_is_gone():
                    return
                continue
            last = picture.index
            if pace.due(time.monotonic()):
                yield picture.index, self.device.pictures.jpeg(options, picture)

    def _is_open(self) -> bool:
        return not self.device.closing.is_set() and not any(name in self.faults for name in REFUSING)

    def _part(self, index: int, data: bytes) -> bool:
        headers, data = self._with_faults(index, data)
        self.device.note_sent(index, time.monotonic())
        return self._send("\r\n".join([BOUNDARY, *headers, "", ""]).encode(), data, b"\r\n")

    def _with_faults(self, index: int, data: bytes) -> tuple[list[str], bytes]:
        """Make the headers and bytes of an image, with the faults that are on."""
        length = len(data)
        if "wrong-length" in self.faults:  # in turn too long and too short
            length += LENGTH_ERROR if index % 2 else -LENGTH_ERROR
        if "corrupt" in self.faults:
            data = damaged(data, index)
        headers = ["Content-Type: image/jpeg", f"Content-Length: {max(length, 0)}"]
        return headers[:1] if "no-length" in self.faults else headers, data

    def _send(self, head: bytes, data: bytes, tail: bytes) -> bool:
        """Send an image; return whether the connection can take another."""
        whole, middle = head + data + tail, len(head) + len(data) // 2
        if "cut" in self.faults:
            self.connection.sendall(whole[:middle])
            return False
        if "stall" in self.faults:
            self.connection.sendall(whole[:middle])
            while not self.faults.wait_while("stall", CHECK_S):
                if not self._is_open() or "cut" in self.faults or self._client_is_gone():
                    return False
            whole = whole[middle:]
        self.connection.sendall(whole)
        return True

    def _client_is_gone(self) -> bool:
        """Return whether the client has closed its side; a viewer sends nothing."""
        readable, _, _ = select.select([self.connection], [], [], 0)
        return bool(readable) and not self.connection.recv(1, socket.MSG_PEEK)
