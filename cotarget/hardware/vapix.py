"""What a camera needs of an Axis video server: who it is, whether its input has video, and the stream of pictures.

Sources: Axis' VAPIX HTTP API, versions 2 and 3, and the manual of the 241Q.
"""

import contextlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

from cotarget.errors import ConfigError, DeviceError
from cotarget.hardware.multipart import boundary_of
from cotarget.hardware.webdevice import WebDevice
from cotarget.hwconfig import HardwareFixed

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
