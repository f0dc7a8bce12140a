"""The fixed camera on an Axis video server, read over HTTP.

`AxisCamera` drains the MJPEG stream on its own thread into a `FrameBuffer`. `VideoServer` speaks the server's HTTP
interface, with basic or digest authentication.

Sources: Axis' VAPIX HTTP API, versions 2 and 3, and the manual of the 241Q.
"""

import contextlib
import os
import re
import socket
import threading
from collections.abc import Generator, Iterator
from types import ModuleType
from typing import TYPE_CHECKING, Annotated
from urllib.parse import unquote, urlsplit

from annotated_types import Gt, Interval

from cotarget.drivers.frame_buffer import BufferedCamera, BusyError, FrameBuffer, LoginError, StreamRefusedError
from cotarget.drivers.mjpeg import MultipartReader, boundary_of, import_simplejpeg
from cotarget.errors import ConfigError, DeviceError, MissingPackageError, install_extra
from cotarget.rig import CameraSpec, Clock
from cotarget.schema import Check, Needed, NotNegative, Positive, Size, model

if TYPE_CHECKING:
    import httpx

# Version 2 of the interface keeps the parameters under "view" on some devices.
PARAMETER_PATHS = ("/axis-cgi/param.cgi", "/axis-cgi/view/param.cgi")
STATUS_PATH = "/axis-cgi/videostatus.cgi"
STREAM_PATH = "/axis-cgi/mjpg/video.cgi"
AXIS = "AXIS"  # the brand that an Axis reports
# On a local network a running device accepts a connection within milliseconds [s].
CONNECT_S = 2.0
# Longest text that is read [bytes]: some servers answer every path with their endless stream.
LONGEST_TEXT = 65536
# Longest quotation of a device's text in a message [characters].
LONGEST_QUOTE = 60
# A stream has stalled after this time without a byte [s], or after this many frame periods where that is longer.
SILENCE_S, SILENCE_PICTURES = 2.0, 3.0


def _web_address(url: str) -> str:
    try:
        parts = urlsplit(url)
        valid = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:  # an invalid address in brackets, or an invalid port
        valid = False
    if url and not valid:
        raise ValueError(f"'{url}' is not like http://192.168.0.90")
    return url


@model
class AxisSettings:
    """The fixed camera, on an Axis video server or network camera.

    Attributes:
        url: address of the server, such as "http://192.168.0.90".
        camera: number of the camera on the server, from 1.
        user: user name; empty where the server asks for none.
        password: password; empty where an environment variable holds it.
        password_env: name of that variable.
        size: image size that is expected [px].
        resolution: the server's name of the resolution, such as "4CIF"; empty for its default.
        rate_hz: frames per second to request.
        compression: JPEG compression; less is finer.
        latency_s: time from light to a frame's first byte, as measured [s].
    """

    url: Annotated[str, Needed("http://192.168.0.90"), Check(_web_address)] = ""
    camera: Annotated[int, Gt(0)] = 1
    user: str = ""
    password: str = ""
    password_env: str = "COTARGET_PASSWORD"
    size: Size = (704, 576)
    resolution: str = "4CIF"
    rate_hz: Positive = 25.0
    compression: Annotated[int, Interval(ge=0, le=100)] = 30
    latency_s: NotNegative = 0.1

    @property
    def spec(self) -> CameraSpec:
        """Describe the camera."""
        return CameraSpec(self.size, self.rate_hz, self.latency_s)


class VideoServer:
    """An Axis video server; a network camera counts as one with a single input. Close it after use.

    Every request has its own connection, and raises DeviceError where the server cannot be reached, does not speak
    HTTP, breaks off or stops sending.

    Args:
        config: address, input and image settings of the fixed camera.

    Raises:
        ConfigError: the address is invalid.
        DeviceError: httpx is missing.
    """

    def __init__(self, config: AxisSettings) -> None:
        self._config, parts = config, urlsplit(config.url)
        self._user = config.user or unquote(parts.username or "")
        self._password = config.password or unquote(parts.password or "") or os.environ.get(config.password_env, "")
        # Address without user and password, which is the server's name in messages.
        self.name = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}".rstrip("/")
        self.silence_s = max(SILENCE_S, SILENCE_PICTURES / config.rate_hz)
        self._socket: socket.socket | None = None  # of the response that is being read
        self._ended = False
        self._lock = threading.Lock()
        self._httpx = import_httpx()
        try:
            self._client: httpx.Client = self._httpx.Client(
                base_url=self.name,
                auth=_authentication(self._user, self._password) if self._user else None,
                timeout=self._httpx.Timeout(self.silence_s, connect=CONNECT_S),
                # Loading the machine's certificates takes longer than a connection; http needs none.
                verify=self.name.startswith("https:"),
                # Proxies and logins of the environment do not apply to a local device.
                trust_env=False,
                # A kept connection may be dead by the next request; a new one costs a millisecond.
                limits=self._httpx.Limits(max_keepalive_connections=0),
                headers={"Connection": "close", "Accept-Encoding": "identity", "User-Agent": "cotarget"},
            )
        except (self._httpx.InvalidURL, ValueError):
            raise ConfigError(f"hardware.fixed.url: '{self.name}' is not like http://192.168.0.90") from None

    def identify(self) -> dict[str, str]:
        """List the parameters of brand, properties and inputs; {} where the server lists none, or not for this user."""
        for path in PARAMETER_PATHS:
            listed = self._parameters(path, "root.Brand")
            if listed is None:
                break  # repeated wrong passwords may lock the user out
            if listed:
                for group in ("root.Properties", "root.ImageSource"):
                    listed |= self._parameters(path, group) or {}
                return listed
        return {}

    def has_video(self) -> bool | None:
        """Ask whether a camera is connected to the input; None where the server does not say."""
        camera = self._config.camera
        text = self.text(STATUS_PATH, {"status": str(camera)}) or ""
        match = re.search(rf"^\s*Video\s+{camera}\s*=\s*(no\s+)?video\b", text, re.IGNORECASE | re.MULTILINE)
        return None if match is None else match[1] is None

    def check(self) -> dict[str, str]:
        """Refuse a server that reports itself as the wrong one; return its parameters as `identify` does.

        Raises:
            DeviceError: the server is no Axis, has no such input, or has no video there.
        """
        listed, camera = self.identify(), self._config.camera
        brand, inputs = listed.get("Brand.Brand") or AXIS, listed.get("ImageSource.NbrOfSources", "")
        if brand.upper() != AXIS:
            raise DeviceError(f"{self.name} is a '{brand}', no Axis: check hardware.fixed.url")
        if re.fullmatch("[0-9]{1,4}", inputs) and camera > int(inputs):
            valid = f"1 to {inputs}" if int(inputs) > 1 else "1"
            raise DeviceError(f"{self.name} has no camera {camera}: set hardware.fixed.camera to {valid}")
        if self.has_video() is False:
            check = "check its cable, or hardware.fixed.camera"
            raise DeviceError(f"{self.name} has no video on input {camera}: {check}")
        return listed

    def describe(self) -> str:
        """Describe the server in one line.

        Raises:
            StreamRefusedError: the server reports nothing about itself and has no stream either; the message says why.
            DeviceError: as `check`.
        """
        listed, video = self.check(), self.has_video()
        if not listed and video is None:
            with self.stream():
                return "does not say what it is, but sends pictures"
        parts = [f"{listed.get('Brand.Brand', '')} {listed.get('Brand.ProdNbr', '')}".strip()] if listed else []
        if firmware := listed.get("Properties.Firmware.Version"):
            parts.append(f"firmware {firmware}")
        if video:
            parts.append(f"input {self._config.camera} has video")
        return ", ".join(parts)

    @contextlib.contextmanager
    def stream(self, api: str = "") -> Iterator[tuple[str | None, Iterator[bytes]]]:
        """Open the image stream for the length of a with block: its header's boundary, and its bytes as they arrive.

        Args:
            api: version of the HTTP interface, where the server reports it.

        Raises:
            BusyError: the server has no place for another viewer now.
            StreamRefusedError: the server has no such stream for this user.
            DeviceError: the stream breaks off; also while it is read.
        """
        config = self._config
        rate = f"{max(round(config.rate_hz), 1)}"
        query = {"camera": str(config.camera), "compression": str(config.compression), "fps": rate}
        if config.resolution:
            query["resolution"] = config.resolution
        if api.startswith("2"):
            query["des_fps"] = rate  # the name of fps in version 2
        with self.ask(STREAM_PATH, query) as response:
            kind = response.headers.get("content-type", "")
            if response.status_code != 200 or not kind.lower().strip().startswith("multipart/"):
                raise self._refusal(response)
            yield boundary_of(kind), self.pieces(response)

    def _parameters(self, path: str, group: str) -> dict[str, str] | None:
        """List a group of parameters, names without "root."; {} where there are none, None where access is refused."""
        text = self.text(path, {"action": "list", "group": group})
        if text is None:
            return None
        lines = (line.strip().removeprefix("root.").partition("=") for line in text.splitlines())
        return {name: self.quote(value) for name, equals, value in lines if equals and re.fullmatch(r"[\w.]+", name)}

    def _refusal(self, response: "httpx.Response") -> DeviceError:
        """Make the error for a response that is no stream, with what would be right."""
        status, config, name = response.status_code, self._config, self.name
        if status == 401 and not (self._user and self._password):
            missing = f"the environment variable {config.password_env}"
            missing = missing if self._user else f"hardware.fixed.user and {missing}"
            return LoginError(f"{name} asks for user and password: set {missing}")
        if status in (401, 403):
            check = f"check hardware.fixed.user and the password, which may be in {config.password_env}"
            return LoginError(f"{name} refuses the user '{self._user}' ({status}): {check}")
        if status == 503:
            return BusyError(f"{name} is busy (503), perhaps with too many viewers: close some")
        if status >= 500:
            return BusyError(f"{name} fails with status {status}: restart it if that lasts")
        if 300 <= status < 400:
            target = self.quote(response.headers.get("location", "another address"))
            return StreamRefusedError(
                f"{name} sends on to {target}: set hardware.fixed.url to where the server really is"
            )
        if status == 404:
            check = "check hardware.fixed.url and hardware.fixed.camera"
            return StreamRefusedError(f"{name} has no {STREAM_PATH} for camera {config.camera} (404): {check}")
        if status != 200:
            asked = f"camera {config.camera}, resolution '{config.resolution}', compression {config.compression}"
            return StreamRefusedError(f"{name} refuses {asked} ({status}): check them in hardware.fixed")
        kind = self.quote(response.headers.get("content-type", "")) or "something"
        said = self.quote(self.read(response)) if kind.lower().startswith("text/plain") else ""
        said = f" '{said}'" if said else ""
        return StreamRefusedError(
            f"{name} sends {kind}{said}, no stream of pictures: check hardware.fixed.url and camera"
        )

    # HTTP

    def end(self) -> None:
        """Break off a request that another thread reads, and refuse further requests."""
        with self._lock:
            self._ended = True
            if self._socket is not None:
                # The device may have closed it already.
                with contextlib.suppress(OSError):
                    self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Release the HTTP client."""
        self._client.close()

    @contextlib.contextmanager
    def ask(self, path: str, query: dict[str, str]) -> Iterator["httpx.Response"]:
        """Send a GET request, authenticated as the server demands, and hold the response for a with block."""
        with self._one_line_errors():
            response = self._client.send(self._client.build_request("GET", path, params=query), stream=True)
        with contextlib.closing(response), self._registered(response):
            yield response

    def text(self, path: str, query: dict[str, str]) -> str | None:
        """Request a short text; empty where the server has none, None where access is refused."""
        with self.ask(path, query) as response:
            if response.status_code in (401, 403):
                return None
            return self.read(response) if response.status_code == 200 else ""

    def read(self, response: "httpx.Response") -> str:
        """Read the text of a response, up to `LONGEST_TEXT`."""
        text = bytearray()
        for piece in self.pieces(response):
            text += piece
            if len(text) >= LONGEST_TEXT:
                break
        return text.decode("latin-1")

    def pieces(self, response: "httpx.Response") -> Iterator[bytes]:
        """Yield the bytes of a response as they arrive."""
        with self._one_line_errors():
            yield from response.iter_raw()

    def quote(self, text: str) -> str:
        """Quote a device's text in one printable line; a password that the device repeats is masked."""
        if self._password:
            text = text.replace(self._password, "***")
        text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
        return text if len(text) <= LONGEST_QUOTE else f"{text[:LONGEST_QUOTE]}..."

    @contextlib.contextmanager
    def _registered(self, response: "httpx.Response") -> Iterator[None]:
        """Register a response so that `end` can break it off."""
        with self._lock:
            if self._ended:
                raise DeviceError(f"{self.name} is closed")
            self._socket = response.extensions["network_stream"].get_extra_info("socket")
        try:
            yield
        finally:
            with self._lock:
                self._socket = None

    @contextlib.contextmanager
    def _one_line_errors(self) -> Iterator[None]:
        """Turn httpx's exceptions into a DeviceError of one line."""
        httpx = self._httpx
        # httpx raises the last three for authentication challenges that it cannot parse.
        wrong = (httpx.HTTPError, httpx.StreamError, httpx.InvalidURL, LookupError, ValueError, NotImplementedError)
        try:
            yield
        except wrong as error:
            raise DeviceError(f"{self.name} {self._reason(error)}") from None

    def _reason(self, error: Exception) -> str:
        httpx = self._httpx
        check = "check the address, its power and the network"
        match error:
            case httpx.ConnectTimeout():
                return f"does not answer within {CONNECT_S:g} s: {check}"
            case httpx.ConnectError():
                return f"cannot be reached ({self.quote(str(error))}): {check}"
            case httpx.TimeoutException():
                return "has stopped sending"
            case httpx.NetworkError():
                return f"broke off ({self.quote(str(error))})"
            case _:
                return f"does not speak HTTP as it should ({self.quote(str(error))}): {check}"


def _authentication(user: str, password: str) -> "httpx.Auth":
    """Make the authentication by the scheme that the device demands, digest before basic."""
    import httpx

    class DemandedAuth(httpx.Auth):
        def auth_flow(self, request: httpx.Request) -> Generator[httpx.Request, httpx.Response, None]:
            response = yield request
            lines = response.headers.get_list("www-authenticate") if response.status_code == 401 else []
            demanded = {line.split(" ")[0].lower() for line in lines}
            if "digest" in demanded:
                yield from httpx.DigestAuth(user, password).auth_flow(request)
            elif "basic" in demanded:
                yield from httpx.BasicAuth(user, password).auth_flow(request)

    return DemandedAuth()


def import_httpx() -> ModuleType:
    """Import httpx.

    Raises:
        MissingPackageError: it is missing.
    """
    try:
        import httpx
    except ImportError:
        raise MissingPackageError(
            f"devices on HTTP need httpx, of the extra hardware: {install_extra('hardware')}"
        ) from None
    return httpx


# The fixed camera

# Time limit for the first image; a busy server is asked again until then [s].
OPEN_S = 5.0
# Images of a live camera differ by their noise; a stream that repeats one image for this time is frozen [s].
FROZEN_S = 1.0
# A stream that brings bytes but no whole image is opened again after this multiple of `silence_s`.
FRUITLESS_SILENCES = 2.0


class AxisCamera(BufferedCamera):
    """The fixed camera on an Axis video server; close it after use.

    A frame's time is the arrival of its first byte, less the configured latency.

    Args:
        config: address of the server, and the expected image size, rate and latency.
        clock: the rig's clock.

    Raises:
        ConfigError: the config has no address, or another image size than the stream.
        DeviceError: the server cannot be reached, refuses the stream, or sends no images.
    """

    Settings = AxisSettings

    @staticmethod
    def probe(settings: AxisSettings) -> str:
        """Describe the video server in one line, by queries that change nothing.

        Raises:
            ConfigError: the settings have no address.
            DeviceError: the server cannot be reached, reports nothing, is no Axis, or has no such input or no video.
        """
        server = VideoServer(settings)
        with contextlib.closing(server):
            return server.describe()

    def __init__(self, config: AxisSettings, clock: Clock) -> None:
        self._config, self._clock = config, clock
        self._server = VideoServer(config)
        self._api = ""
        self._open = False
        self._asked: int | None = None  # number of frames when the server was asked for its video signal
        name = f"the fixed camera at {self._server.name}"
        self._frames = FrameBuffer(name, clock, config.size, config.latency_s, self._server.silence_s)
        import_simplejpeg()
        try:
            self._api = self._server.check().get("Properties.API.HTTP.Version", "")
            self._frames.start(lambda: self._frames.keep_open(self._stream, self._ask_for_video), "axis")
            width, height = self._frames.first(OPEN_S)
            if (width, height) != config.size:
                raise ConfigError(
                    f"hardware.fixed.size: {list(config.size)} is not what {self._server.name} sends: write size = "
                    f"[{width}, {height}], or ask for another hardware.fixed.resolution than '{config.resolution}'"
                )
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the stream and the thread; may be called again."""
        self._frames.close()
        self._server.end()
        if self._frames.join():
            self._server.close()

    def _stream(self) -> None:
        """Open the stream and take its images until it ends."""
        self._open = False
        with self._server.stream(self._api) as (boundary, pieces):
            self._open = True
            self._frames.opened()
            self._drain(MultipartReader(boundary), pieces)

    def _drain(self, reader: MultipartReader, pieces: Iterator[bytes]) -> None:
        broken = 0
        fruitful = self._clock.now()
        try:
            for piece in pieces:
                now = self._clock.now()
                self._frames.heard()
                pictures = reader.feed(piece, now)
                for picture in pictures:
                    self._frames.put(picture.jpeg, picture.t)
                self._frames.refuse(reader.broken - broken)
                broken = reader.broken
                fruitful = now if pictures else fruitful
                if now - fruitful > FRUITLESS_SILENCES * self._server.silence_s:
                    raise DeviceError(f"{self._server.name} sends no whole pictures")
                if self._frames.frozen_s > FROZEN_S and self._asked != self.counts.frames:
                    # The server is asked for its signal after this stream is closed: a stream that is not drained
                    # meanwhile would give the next image a wrong time.
                    raise DeviceError(f"{self._server.name} repeats the same picture")
        finally:
            self._frames.refuse(reader.broken - broken + reader.unfinished)

    def _ask_for_video(self) -> None:
        """Ask once, where a stream has ended and images have not come for a while, whether the input has a signal."""
        frames = self.counts.frames
        if not self._open or self._frames.waited_s <= FROZEN_S or self._asked == frames:
            return
        video = None
        with contextlib.suppress(DeviceError):  # the stream's own error is reported already
            video = self._server.has_video()
        self._asked = frames
        if video is False:
            self._frames.remark(f"its input {self._config.camera} has no video")
