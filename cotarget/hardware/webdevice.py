"""Asks a device over HTTP: basic or digest authentication as it wants, and every failure in one line."""

import contextlib
import socket
import threading
from collections.abc import Iterator
from types import ModuleType
from typing import TYPE_CHECKING

from cotarget.errors import ConfigError, DeviceError, MissingPackageError

if TYPE_CHECKING:
    import httpx

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
