"""The wide camera on an Axis video server: a thread that drains its stream and keeps the newest picture.

A consumer that read the stream itself would fall behind it: what it has not read yet waits in buffers, and grows old.

What a camera needs of an Axis video server: who it is, whether its input has video, and the stream of pictures.

Sources: Axis' VAPIX HTTP API, versions 2 and 3, and the manual of the 241Q.

Asks a device over HTTP: basic or digest authentication as it wants, and every failure in one line.
"""

import contextlib
import logging
import os
import re
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import ModuleType
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

from cotarget.config import HardwareFixed
from cotarget.drivers.mjpeg import JpegDecoder, JpegPicture, MultipartReader, boundary_of
from cotarget.errors import ConfigError, DeviceError, MissingPackageError, StaleFrameError
from cotarget.rig import Clock, Frame, Image

if TYPE_CHECKING:
    import httpx


# Where the password is, if not in rig.toml.
PASSWORD_VARIABLE = "COTARGET_PASSWORD"
# Version 2 of the interface keeps the parameters under "view" on some devices.
PARAMETER_PATHS = ("/axis-cgi/param.cgi", "/axis-cgi/view/param.cgi")
STATUS_PATH = "/axis-cgi/videostatus.cgi"
STREAM_PATH = "/axis-cgi/mjpg/video.cgi"
# A stream without a byte for so long has stalled [s]; or for so many pictures, where they are rare.
SILENCE_S, SILENCE_PICTURES = 2.0, 3.0


class BusyError(DeviceError):
    """The server is there, but has no time now."""


class RefusedError(DeviceError):
    """The server has no such stream for us."""


class LoginError(RefusedError):
    """The server wants another user or password."""


@dataclass(frozen=True)
class Identity:
    """What a server says of itself; empty, and None, where it does not say.

    Attributes:
        brand: its maker.
        product: its number, such as "241Q".
        firmware: version of its firmware.
        api: version of its HTTP interface.
        inputs: how many cameras it has.
    """

    brand: str
    product: str
    firmware: str
    api: str
    inputs: int | None


@dataclass(frozen=True)
class Stream:
    """A stream under way: the boundary that it announces, and its bytes as they arrive."""

    boundary: str | None
    pieces: Iterator[bytes]


class VideoServer:
    """An Axis video server, or a network camera, which is one with a single input.

    Args:
        config: where it is, and what is wanted of it.

    Attributes:
        name: how messages call it.
        silence_s: a stream without a byte for so long has stalled [s].

    Raises:
        ConfigError: the config does not say where it is.
        DeviceError: httpx is missing.
    """

    def __init__(self, config: HardwareFixed) -> None:
        self._config = config
        self.name, self._user, self._password = _access(config)
        self.silence_s = max(SILENCE_S, SILENCE_PICTURES / config.rate_hz)
        try:
            self._web = WebDevice(self.name, self._user, self._password, self.silence_s)
        except ConfigError as error:
            raise ConfigError(f"hardware.fixed.url: {error}") from None

    def end(self) -> None:
        """Break off what another thread reads; nothing can be asked from now on."""
        self._web.end()

    def close(self) -> None:
        """Give up what is held for asking."""
        self._web.close()

    def identify(self) -> Identity | None:
        """What the server says of itself; None where it has no parameters to list, or does not show them.

        Raises:
            DeviceError: it cannot be reached.
        """
        for path in PARAMETER_PATHS:
            told = self._parameters(path, "root.Brand")
            if told is None:
                return None  # asking on with a wrong password might lock the user out
            if told:
                for group in ("root.Properties", "root.ImageSource"):
                    told |= self._parameters(path, group) or {}
                inputs = told.get("ImageSource.NbrOfSources", "")
                return Identity(
                    brand=told.get("Brand.Brand", ""),
                    product=told.get("Brand.ProdNbr", ""),
                    firmware=told.get("Properties.Firmware.Version", ""),
                    api=told.get("Properties.API.HTTP.Version", ""),
                    inputs=int(inputs) if re.fullmatch("[0-9]{1,4}", inputs) else None,
                )
        return None

    def has_video(self) -> bool | None:
        """Whether a camera is connected to the input; None where the server does not say.

        Raises:
            DeviceError: it cannot be reached.
        """
        camera = self._config.camera
        text = self._web.text(STATUS_PATH, {"status": str(camera)}) or ""
        match = re.search(rf"^\s*Video\s+{camera}\s*=\s*(no\s+)?video\b", text, re.IGNORECASE | re.MULTILINE)
        return None if match is None else match[1] is None

    def check(self) -> str:
        """Refuse a server that says that it cannot be the right one; the version of its interface, where it says so.

        Raises:
            DeviceError: it cannot be reached, or is no Axis, or has no such input or no video there.
        """
        identity, camera = self.identify(), self._config.camera
        if identity is not None:
            if identity.brand and identity.brand.upper() != "AXIS":
                raise DeviceError(f"{self.name} is a '{identity.brand}', no Axis: check hardware.fixed.url")
            if identity.inputs is not None and camera > identity.inputs:
                valid = f"1 to {identity.inputs}" if identity.inputs > 1 else "1"
                raise DeviceError(f"{self.name} has no camera {camera}: set hardware.fixed.camera to {valid}")
        if self.has_video() is False:
            check = "check its cable, or hardware.fixed.camera"
            raise DeviceError(f"{self.name} has no video on input {camera}: {check}")
        return "" if identity is None else identity.api

    def describe(self) -> str:
        """Who the server is, in a line.

        Raises:
            RefusedError: it tells nothing, and has no stream for us either, which says why.
            DeviceError: it cannot be reached.
        """
        identity, video = self.identify(), self.has_video()
        if identity is None and video is None:
            with self.stream():
                return "tells nothing of itself, but sends pictures"
        told = [] if identity is None else [f"{identity.brand} {identity.product}".strip()]
        if identity is not None and identity.firmware:
            told.append(f"firmware {identity.firmware}")
        if video is not None:
            told.append(f"input {self._config.camera} has {'' if video else 'no '}video")
        return ", ".join(told)

    @contextlib.contextmanager
    def stream(self, api: str = "") -> Iterator[Stream]:
        """Open the stream of pictures.

        Args:
            api: version of the HTTP interface, as `identify` told it.

        Raises:
            BusyError: the server has no place for another viewer now.
            RefusedError: it has no such stream for us.
            DeviceError: it cannot be reached, or breaks the stream off; also while it is read.
        """
        config = self._config
        rate = f"{max(round(config.rate_hz), 1)}"
        query = {"camera": str(config.camera), "compression": str(config.compression), "fps": rate}
        if config.resolution:
            query["resolution"] = config.resolution
        if api.startswith("2"):
            query["des_fps"] = rate  # what version 2 calls it
        with self._web.ask(STREAM_PATH, query) as response:
            kind = response.headers.get("content-type", "")
            if response.status_code != 200 or not kind.lower().strip().startswith("multipart/"):
                raise self._refusal(response)
            yield Stream(boundary_of(kind), self._web.pieces(response))

    def _parameters(self, path: str, group: str) -> dict[str, str] | None:
        """Parameters by their names without "root."; none where there are none, None where they are not for us."""
        text = self._web.text(path, {"action": "list", "group": group})
        if text is None:
            return None
        lines = (line.strip().removeprefix("root.").partition("=") for line in text.splitlines())
        return {
            name: self._web.quote(value) for name, equals, value in lines if equals and re.fullmatch(r"[\w.]+", name)
        }

    def _refusal(self, response: "httpx.Response") -> DeviceError:
        """Why there is no stream, and what would be right."""
        status, config, name = response.status_code, self._config, self.name
        if status == 401 and not (self._user and self._password):
            missing = f"the environment variable {PASSWORD_VARIABLE}"
            missing = missing if self._user else f"hardware.fixed.user and {missing}"
            return LoginError(f"{name} asks for user and password: set {missing}")
        if status in (401, 403):
            check = f"check hardware.fixed.user and the password, which may be in {PASSWORD_VARIABLE}"
            return LoginError(f"{name} refuses the user '{self._user}' ({status}): {check}")
        if status == 503:
            return BusyError(f"{name} is busy (503), perhaps with too many viewers: close some")
        if status >= 500:
            return BusyError(f"{name} fails with status {status}: restart it if that lasts")
        if 300 <= status < 400:
            target = self._web.quote(response.headers.get("location", "another address"))
            return RefusedError(f"{name} sends on to {target}: set hardware.fixed.url to where the server really is")
        if status == 404:
            check = "check hardware.fixed.url and hardware.fixed.camera"
            return RefusedError(f"{name} has no {STREAM_PATH} for camera {config.camera} (404): {check}")
        if status != 200:
            asked = f"camera {config.camera}, resolution '{config.resolution}', compression {config.compression}"
            return RefusedError(f"{name} refuses {asked} ({status}): check them in hardware.fixed")
        kind = self._web.quote(response.headers.get("content-type", "")) or "something"
        said = self._web.quote(self._web.read(response)) if kind.lower().startswith("text/plain") else ""
        said = f" '{said}'" if said else ""
        return RefusedError(f"{name} sends {kind}{said}, no stream of pictures: check hardware.fixed.url and camera")


def _access(config: HardwareFixed) -> tuple[str, str, str]:
    """The address without a login, the user and the password."""
    if not config.url:
        raise ConfigError("hardware.fixed.url: missing; give the video server's address, such as http://192.168.0.90")
    try:
        parts = urlsplit(config.url)
    except ValueError:
        raise ConfigError("hardware.fixed.url: is not like http://192.168.0.90") from None
    user = config.user or unquote(parts.username or "")
    password = config.password or unquote(parts.password or "") or os.environ.get(PASSWORD_VARIABLE, "")
    host = parts.netloc.rpartition("@")[2]
    return f"{parts.scheme}://{host}{parts.path}".rstrip("/"), user, password


# --- webdevice ---

# On a local network a device that lives takes a connection within milliseconds [s].
CONNECT_S = 2.0
# No text that we ask for is longer [bytes], nor in more pieces, which might come one by one for ever.
LONGEST_TEXT, MOST_PIECES = 65536, 64
# What is quoted of a device's own words [characters].
LONGEST_QUOTE = 60


class WebDevice:
    """A device that speaks HTTP; a connection lasts as long as a question.

    Args:
        url: its address, without user and password; messages call it so.
        user: empty where there is none.
        password: never shown.
        silence_s: a device that has not sent a byte for so long has stopped [s].

    Raises:
        ConfigError: the address is none.
        DeviceError: httpx is missing.
    """

    def __init__(self, url: str, user: str, password: str, silence_s: float) -> None:
        self.url = url
        self._user, self._password = user, password
        self._scheme = ""
        self._asked: socket.socket | None = None  # of the answer that is being read
        self._ended = False
        self._lock = threading.Lock()
        self._httpx = _import_httpx()
        try:
            self._client: httpx.Client = self._httpx.Client(
                base_url=url,
                timeout=self._httpx.Timeout(silence_s, connect=CONNECT_S),
                # Reading all certificates of the machine takes longer than a connection.
                verify=url.startswith("https:"),
                # Proxies and logins of the environment are not meant for a device.
                trust_env=False,
                # A connection that was kept may have died meanwhile; a new one costs a millisecond.
                limits=self._httpx.Limits(max_keepalive_connections=0),
                headers={"Connection": "close", "Accept-Encoding": "identity", "User-Agent": "cotarget"},
            )
        except (self._httpx.InvalidURL, ValueError):
            raise ConfigError(f"'{url}' is not like http://192.168.0.90") from None

    def end(self) -> None:
        """Break off what another thread reads; nothing can be asked from now on."""
        with self._lock:
            self._ended = True
            if self._asked is not None:
                # The device may have closed it already.
                with contextlib.suppress(OSError):
                    self._asked.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Give up what the client holds."""
        self._client.close()

    @contextlib.contextmanager
    def ask(self, path: str, query: dict[str, str]) -> Iterator["httpx.Response"]:
        """Ask, with the authentication that the device wants, and hold its answer while it is read.

        Raises:
            DeviceError: it cannot be reached, or does not speak HTTP.
        """
        response = self._send(path, query)
        if self._challenged(response):
            response.close()
            response = self._send(path, query)
        with contextlib.closing(response), self._held(response):
            yield response

    def text(self, path: str, query: dict[str, str]) -> str | None:
        """A short text; empty where the device has none, None where it is not for us.

        Raises:
            DeviceError: as `ask`.
        """
        with self.ask(path, query) as response:
            if response.status_code in (401, 403):
                return None
            return self.read(response) if response.status_code == 200 else ""

    def read(self, response: "httpx.Response") -> str:
        """The text of an answer; only its beginning if it is long."""
        text = bytearray()
        for piece, _ in zip(self.pieces(response), range(MOST_PIECES), strict=False):
            text += piece
            if len(text) > LONGEST_TEXT:
                break
        return text[:LONGEST_TEXT].decode("latin-1")

    def pieces(self, response: "httpx.Response") -> Iterator[bytes]:
        """The bytes of an answer as they arrive.

        Raises:
            DeviceError: the device broke it off, or has stopped sending.
        """
        with self._understood():
            yield from response.iter_raw()

    def quote(self, text: str) -> str:
        """A device's own words, fit for a line; it might even send the password back."""
        if self._password:
            text = text.replace(self._password, "***")
        text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
        return text if len(text) <= LONGEST_QUOTE else f"{text[:LONGEST_QUOTE]}..."

    def _send(self, path: str, query: dict[str, str]) -> "httpx.Response":
        with self._understood():
            return self._client.send(self._client.build_request("GET", path, params=query), stream=True)

    def _challenged(self, response: "httpx.Response") -> bool:
        """Whether to ask again because the device wants a kind of authentication that was not tried."""
        if response.status_code != 401 or not self._user:
            return False
        schemes = [line.split(" ")[0].lower() for line in response.headers.get_list("www-authenticate")]
        scheme = next((known for known in ("digest", "basic") if known in schemes), "")
        if scheme in ("", self._scheme):
            return False
        self._scheme = scheme
        auth = self._httpx.DigestAuth if scheme == "digest" else self._httpx.BasicAuth
        self._client.auth = auth(self._user, self._password)
        return True

    @contextlib.contextmanager
    def _held(self, response: "httpx.Response") -> Iterator[None]:
        """Let `end` break off this answer."""
        with self._lock:
            if self._ended:
                raise DeviceError(f"{self.url} is closed")
            self._asked = response.extensions["network_stream"].get_extra_info("socket")
        try:
            yield
        finally:
            with self._lock:
                self._asked = None

    @contextlib.contextmanager
    def _understood(self) -> Iterator[None]:
        """Say in a line what went wrong in httpx."""
        httpx = self._httpx
        # The last three are what httpx makes of challenges that it does not understand.
        wrong = (httpx.HTTPError, httpx.StreamError, httpx.InvalidURL, LookupError, ValueError, NotImplementedError)
        try:
            yield
        except wrong as error:
            raise DeviceError(f"{self.url} {self._reason(error)}") from None

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


def _import_httpx() -> ModuleType:
    try:
        import httpx
    except ImportError:
        raise MissingPackageError("devices on HTTP need httpx: pip install 'cotarget[hardware]'") from None
    return httpx


log = logging.getLogger(__name__)
# How long the first picture may take; a server that is busy is asked again until then [s].
OPEN_S = 5.0
# Before the stream is opened again: after it worked, and at most; after a refusal, which might lock the user out [s].
SHORTEST_PAUSE_S, LONGEST_PAUSE_S, REFUSED_PAUSE_S = 0.05, 0.4, 2.0
# Pictures of a live camera differ by their noise; a stream that repeats one for so long is frozen [s].
FROZEN_S = 1.0
# A stream that has been silent for so long is said to have stalled, should somebody ask for a picture [s].
QUIET_S = 0.2
# A stream that brings bytes, but no whole picture for so many times the silence of a stalled one, is opened anew.
FRUITLESS_SILENCES = 2.0
# The thread ends at once, but for a connection that is just being made, or a server that is slow to answer [s].
JOIN_S = 10.0


@dataclass(frozen=True)
class Counters:
    """What came of a stream.

    Attributes:
        frames: new whole pictures.
        repeated: pictures that were the same, byte for byte, as the one before.
        broken: pictures that were cut short or could not be decoded; of those that nobody read the latter is not known.
        reconnects: how often the stream was opened again.
    """

    frames: int = 0
    repeated: int = 0
    broken: int = 0
    reconnects: int = 0


class AxisCamera:
    """A camera of an Axis video server; close it after use.

    A frame's time is that of its first byte's arrival, less the latency of the config. A picture is decoded when it is
    read: a consumer that is slower than the stream saves the time of the others, and none holds up the stream.

    Args:
        config: where it is, and what is expected of it.
        clock: the rig's.

    Raises:
        ConfigError: the config does not say where it is, or expects another size.
        DeviceError: the server cannot be reached, refuses us, or has no pictures.
    """

    def __init__(self, config: HardwareFixed, clock: Clock) -> None:
        self._config, self._clock = config, clock
        self._server = VideoServer(config)
        self._api = ""
        self._closing = threading.Event()
        self._decoder, self._decoding = JpegDecoder(), threading.Lock()
        self._decoded: tuple[JpegPicture, Image] | None = None
        # All that follows is shared with the thread, and guarded by this.
        self._new = threading.Condition()
        self._counters = Counters()
        self._picture: JpegPicture | None = None  # the newest
        self._last = b""  # its bytes, kept where it could not be decoded too
        self._fresh = self._heard = clock.now()  # when the newest came, and the last byte
        self._spoilt = self._frozen = False  # what came since the newest: broken ones, or the same
        self._trouble = ""  # why there is no stream; empty while there is one
        self._refused: DeviceError | None = None  # why there never was one
        self._failed = ""  # why there will be none any more
        self._asked = False  # whether the server was asked why there are no new ones
        self._video: bool | None = None  # what it said: whether the input has a signal
        self._thread = threading.Thread(target=self._run, name="axis", daemon=True)
        try:
            self._api = self._server.check()
            self._thread.start()
            self._await_first()
        except BaseException:
            self.close()
            raise

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self._config.size

    @property
    def counters(self) -> Counters:
        """What came of the stream so far."""
        with self._new:
            return self._counters

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Wait for the newest frame; with ``newer_than`` [s] for one exposed after that time.

        Raises:
            StaleFrameError: no such frame arrived within ``timeout`` [s], and why.
            DeviceError: the pictures have another size than at the start, the camera is closed, or its driver failed.
        """
        deadline = self._clock.now() + timeout
        # What came before a stall is no answer to somebody who wants to see what is.
        oldest = deadline - timeout - self._config.latency_s - self._server.silence_s
        after = oldest if newer_than is None else max(oldest, newer_than)
        while True:
            with self._new:
                self._new.wait_for(lambda: self._ready(after), max(deadline - self._clock.now(), 0.0))
                if self._closing.is_set():
                    raise DeviceError("the fixed camera is closed")
                if self._failed:
                    raise DeviceError(self._failed)
                picture = self._picture
                if picture is not None and picture.size != self.size:
                    raise DeviceError(self._other_size(picture.size))
                if picture is None or not self._ready(after):
                    raise StaleFrameError(self._why(timeout))
            image = self._decode(picture)
            if image is not None:
                return Frame(image, self._time(picture))

    def close(self) -> None:
        """End the stream and the thread; once more does no harm."""
        self._closing.set()
        self._server.end()
        with self._new:
            self._new.notify_all()
        if self._thread.is_alive():
            self._thread.join(JOIN_S)
        if not self._thread.is_alive():
            self._server.close()

    def _await_first(self) -> None:
        with self._new:
            self._new.wait_for(lambda: self._picture is not None or self._refused is not None, OPEN_S)
            if self._refused is not None:
                raise self._refused
            if self._picture is None:
                raise DeviceError(self._trouble or f"{self._server.name} has sent no whole picture in {OPEN_S:g} s")
            width, height = self._picture.size
        if (width, height) != self.size:
            raise ConfigError(
                f"hardware.fixed.size: {list(self.size)} is not what {self._server.name} sends: write size = "
                f"[{width}, {height}], or ask for another hardware.fixed.resolution than '{self._config.resolution}'"
            )

    def _time(self, picture: JpegPicture) -> float:
        return picture.t - self._config.latency_s

    def _ready(self, after: float) -> bool:
        """Whether there is something to tell: a picture from after then, one of another size, or the end."""
        picture = self._picture
        told = picture is not None and (self._time(picture) > after or picture.size != self.size)
        return told or bool(self._failed) or self._closing.is_set()

    def _decode(self, picture: JpegPicture) -> Image | None:
        """The picture's image, read-only; None, and counted, if it has none."""
        with self._decoding:
            if self._decoded is not None and self._decoded[0] is picture:
                return self._decoded[1]
            image = self._decoder.decode(picture.jpeg)
            if image is not None:
                self._decoded = (picture, image)
                return image
        with self._new:
            if self._picture is picture:
                self._picture, self._spoilt = None, True
            self._counters = replace(self._counters, broken=self._counters.broken + 1)
        return None

    def _other_size(self, size: tuple[int, int]) -> str:
        was, now = (f"{width}x{height}" for width, height in (self.size, size))
        return f"{self._server.name} now sends {now} where it sent {was}: set its resolution back, or open it anew"

    def _why(self, timeout: float) -> str:
        """Why there is no newer picture."""
        now, name = self._clock.now(), self._server.name
        if self._trouble:
            reason = f"{self._trouble}; reconnecting"
        elif now - self._heard > QUIET_S:
            reason = f"{name} has sent nothing for {now - self._heard:.1f} s"
        elif self._frozen:
            reason = f"{name} repeats the same picture"
        elif self._spoilt:
            return f"the pictures of {name} are broken, {self._counters.broken} so far"
        else:
            return f"{name} sent no newer picture within {timeout:g} s"
        video = f"; its input {self._config.camera} has no video" if self._video is False else ""
        return f"no new picture for {now - self._fresh:.1f} s: {reason}{video}"

    def _run(self) -> None:
        """What the thread does."""
        try:
            self._keep_open()
        except Exception as error:  # a thread must not die in silence
            log.debug("the driver of the fixed camera failed", exc_info=True)
            with self._new:
                self._failed = f"the driver of the fixed camera failed: {error!r}"
                self._refused = DeviceError(self._failed)
                self._new.notify_all()

    def _keep_open(self) -> None:
        """Keep a stream open until the end."""
        pause = 0.0
        while not self._closing.wait(pause):
            frames = self._counters.frames
            error, opened = self._stream()
            with self._new:
                self._trouble = str(error)
                worked, lost = self._counters.frames > frames, self._clock.now() - self._fresh > FROZEN_S
                ask = opened and lost and not self._asked
                if not (worked or opened or self._counters.frames or isinstance(error, BusyError)):
                    self._refused = error
                self._new.notify_all()
            pause = SHORTEST_PAUSE_S if worked else min(max(2 * pause, SHORTEST_PAUSE_S), LONGEST_PAUSE_S)
            if isinstance(error, RefusedError):
                pause = REFUSED_PAUSE_S
            if ask and not self._closing.is_set():
                self._ask_for_video()

    def _stream(self) -> tuple[DeviceError, bool]:
        """Open the stream and take its pictures until it ends; why it did, and whether it was open."""
        opened = False
        try:
            with self._server.stream(self._api) as stream:
                opened = True
                self._drain(stream)
        except DeviceError as error:
            return error, opened
        return DeviceError(f"{self._server.name} has closed the stream"), opened

    def _drain(self, stream: Stream) -> None:
        reader, broken = MultipartReader(stream.boundary), 0
        fruitful = self._clock.now()
        with self._new:
            again = 1 if self._trouble else 0
            self._counters = replace(self._counters, reconnects=self._counters.reconnects + again)
            self._heard, self._trouble = fruitful, ""
        try:
            for piece in stream.pieces:
                now = self._clock.now()
                pictures = reader.feed(piece, now)
                frozen = self._take(pictures, reader.broken - broken, now)
                broken = reader.broken
                fruitful = now if pictures else fruitful
                if now - fruitful > FRUITLESS_SILENCES * self._server.silence_s:
                    raise DeviceError(f"{self._server.name} sends no whole pictures")
                if frozen and not self._asked:
                    # Asked while this stream is not drained, the time of the next picture would be wrong.
                    raise DeviceError(f"{self._server.name} repeats the same picture")
        finally:
            self._take([], reader.broken - broken + reader.unfinished, None)

    def _take(self, pictures: list[JpegPicture], broken: int, now: float | None) -> bool:
        """Note what came; whether the pictures have been the same for too long."""
        with self._new:
            self._heard = self._heard if now is None else now
            counters = replace(self._counters, broken=self._counters.broken + broken)
            self._spoilt = self._spoilt or broken > 0
            for picture in pictures:
                if picture.jpeg == self._last:
                    counters = replace(counters, repeated=counters.repeated + 1)
                    self._frozen = True
                    continue
                counters = replace(counters, frames=counters.frames + 1)
                self._picture, self._last, self._fresh = picture, picture.jpeg, picture.t
                self._frozen = self._spoilt = self._asked = False
                self._video = None
                self._new.notify_all()
            self._counters = counters
            return self._frozen and now is not None and now - self._fresh > FROZEN_S

    def _ask_for_video(self) -> None:
        video = None
        with contextlib.suppress(DeviceError):  # it is just one more thing that fails
            video = self._server.has_video()
        with self._new:
            self._asked, self._video = True, video


def probe(config: HardwareFixed) -> str:
    """Say in a line who the video server is, by harmless questions.

    Raises:
        ConfigError: the config does not say where it is.
        DeviceError: it cannot be reached, or tells nothing.
    """
    with contextlib.closing(VideoServer(config)) as server:
        return server.describe()
