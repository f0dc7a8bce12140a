"""SOAP 1.2 as ONVIF devices speak it: envelopes, a user's token signed by the device's clock, faults in one line.

The clocks of cameras are wrong by hours, and a token of another time is refused. `SoapClient` therefore reads the
device's time first, which needs no user on most devices; where it does, the header `Date` of the refusal has the time.
HTTP digest authentication is answered as well. No library is used but httpx: see docs/design-notes.md.

Sources: ONVIF Core Specification, WS-Security UsernameToken Profile 1.0.
"""

import base64
import contextlib
import hashlib
import os
import socket
import struct
import time
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from email.utils import parsedate_to_datetime
from typing import TYPE_CHECKING, NamedTuple, NoReturn
from xml.etree.ElementTree import Element, ParseError, TreeBuilder, XMLParser
from xml.sax.saxutils import escape

from cotarget.drivers.axis import import_httpx
from cotarget.drivers.link_errors import AwayError, SilentError
from cotarget.errors import DeviceError

if TYPE_CHECKING:
    import httpx

ENVELOPE = "http://www.w3.org/2003/05/soap-envelope"
SECURITY = "http://docs.oasis-open.org/wss/2004/01/oasis-200401-wss"
DEVICE = "http://www.onvif.org/ver10/device/wsdl"
SCHEMA = "http://www.onvif.org/ver10/schema"
DEVICE_PATH = "/onvif/device_service"
CONNECT_S = 2.0  # on a local network a running device accepts a connection within milliseconds [s]
LONGEST_ANSWER = 1 << 20  # [bytes]; the longest list of profiles has a tenth
LONGEST_QUOTE = 100  # of a device's text in a message [characters]
CLOCK_S = 5.0  # a clock that is off by more is named in messages [s]
CLOCK_STEP_S = 1.0  # two answers of a steady clock, in whole seconds, differ by less [s]
NOT_AUTHORIZED = "NotAuthorized"
LOGIN_CODES = {NOT_AUTHORIZED, "FailedAuthentication"}  # of ONVIF, and of WS-Security as gSOAP has it
# A command that was given up is discarded with its connection; else the system repeats it, and it may follow the stop.
DISCARD = (socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


class FaultError(DeviceError):
    """The device answered with a fault.

    Attributes:
        codes: local names of its code and subcodes, such as "Sender", "NotAuthorized".
    """

    def __init__(self, name: str, what: str, codes: tuple[str, ...], reason: str) -> None:
        super().__init__(f"{name} refuses {what}: {reason or ' '.join(codes)}")
        self.codes = codes


class LoginFaultError(FaultError):
    """The device refuses the user, or that this user does this."""


class EmptyAnswerError(DeviceError):
    """The device answered with success and nothing else."""


# XML


class _Builder(TreeBuilder):
    """Refuse a document type, so that no entity is ever declared or expanded."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> NoReturn:
        raise ParseError("it has a document type")


def parse_xml(data: bytes) -> Element:
    """Parse XML without a document type.

    Raises:
        ValueError: it is none.
    """
    parser = XMLParser(target=_Builder())
    try:
        parser.feed(data)
        root: Element = parser.close()
    except (ParseError, LookupError) as error:  # an unknown encoding
        raise ValueError(str(error)) from None
    return root


def find(element: Element | None, path: str) -> Element | None:
    """Find an element by local names, such as "Position/PanTilt", in whatever namespaces."""
    return None if element is None else element.find("/".join(f"{{*}}{name}" for name in path.split("/")))


def find_all(element: Element | None, path: str) -> list[Element]:
    """Find all elements by local names; empty where there are none."""
    return [] if element is None else element.findall("/".join(f"{{*}}{name}" for name in path.split("/")))


def text_at(element: Element | None, path: str) -> str:
    """Return the text of an element; empty where there is none."""
    found = find(element, path)
    return "" if found is None or found.text is None else found.text.strip()


# Messages


def user_token(user: str, password: str, created: datetime, nonce: bytes) -> str:
    """Make the security header of a user: the password only as a digest with time and nonce."""
    stamp = created.strftime("%Y-%m-%dT%H:%M:%S.000Z")
    digest = hashlib.sha1(nonce + stamp.encode() + password.encode(), usedforsecurity=False).digest()
    return (
        f'<s:Header><Security s:mustUnderstand="1" xmlns="{SECURITY}-wssecurity-secext-1.0.xsd"><UsernameToken>'
        f"<Username>{escape(user)}</Username>"
        f'<Password Type="{SECURITY}-username-token-profile-1.0#PasswordDigest">'
        f"{base64.b64encode(digest).decode()}</Password>"
        f'<Nonce EncodingType="{SECURITY}-soap-message-security-1.0#Base64Binary">{base64.b64encode(nonce).decode()}'
        f'</Nonce><Created xmlns="{SECURITY}-wssecurity-utility-1.0.xsd">{stamp}</Created>'
        "</UsernameToken></Security></s:Header>"
    )


def fault_of(root: Element, name: str, what: str) -> FaultError | None:
    """Return the fault in an answer, if it is one."""
    fault = find(root, "Body/Fault")
    if fault is None:
        return None
    values = [value.text or "" for value in fault.iter() if value.tag.endswith("}Value")] or [
        text_at(fault, "faultcode")
    ]
    codes = tuple(value.strip().rpartition(":")[2] for value in values)
    said = text_at(fault, "Reason/Text") or next((each.text or "" for each in fault.iter("faultstring")), "")
    kind = LoginFaultError if LOGIN_CODES.intersection(codes) else FaultError
    return kind(name, what, codes, quote(said))


def quote(text: str) -> str:
    """Quote a device's text in one printable line."""
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return text if len(text) <= LONGEST_QUOTE else f"{text[:LONGEST_QUOTE]}..."


def device_time(root: Element) -> datetime | None:
    """Return the time in an answer to GetSystemDateAndTime; None where there is none."""
    utc = find(root, "Body/GetSystemDateAndTimeResponse/SystemDateAndTime/UTCDateTime")
    names = ("Date/Year", "Date/Month", "Date/Day", "Time/Hour", "Time/Minute", "Time/Second")
    try:
        year, month, day, hour, minute, second = (int(text_at(utc, name)) for name in names)
        return datetime(year, month, day, hour, minute, min(second, 59), tzinfo=UTC)
    except ValueError:
        return None


# The client


class Message(NamedTuple):
    """A message of a service.

    Attributes:
        path: of the service, such as `DEVICE_PATH`.
        namespace: of the service.
        name: local name of the request.
        inner: what the request contains, as XML; the prefix "t" is ONVIF's schema.
        once: whether it is not sent again where the connection breaks, since the device may have obeyed it.
    """

    path: str
    namespace: str
    name: str
    inner: str = ""
    once: bool = False


class SoapClient:
    """Send messages to a device, from any thread; calls that run at the same time have connections of their own.

    Args:
        address: of the device, HOST:PORT.
        user: user name; empty where the device asks for none.
        password: of that user.
        remedy: what a user can check where the login is refused.

    Raises:
        DeviceError: httpx is missing.
    """

    def __init__(
        self, address: str, user: str = "", password: str = "", remedy: str = "check user and password"
    ) -> None:
        self.name, self._user, self._password, self._remedy = f"the device at {address}", user, password, remedy
        self._httpx = import_httpx()
        scheme = "https" if address.endswith(":443") else "http"
        self._auth = self._httpx.DigestAuth(user, password) if user else self._httpx.Auth()
        # Cameras sign their certificates themselves. Proxies and logins of the environment do not apply to them.
        transport = self._httpx.HTTPTransport(verify=False, trust_env=False, socket_options=[DISCARD])
        self._client = self._httpx.Client(base_url=f"{scheme}://{address}", transport=transport, trust_env=False)
        self._offset_s: float | None = None  # of the device's clock
        self._date: datetime | None = None  # in the header of the newest answer

    @property
    def login(self) -> tuple[str, ...]:
        """User and password; empty without a user."""
        return (self._user, self._password) if self._user else ()

    def close(self) -> None:
        """Release the connections."""
        self._client.close()

    @property
    def clock_off_s(self) -> float:
        """By how much the device's clock is ahead of this machine's, as far as it was asked [s]."""
        return self._offset_s or 0.0

    def call(
        self, path: str, namespace: str, name: str, inner: str = "", timeout: float = 5.0, *, once: bool = False
    ) -> Element:
        """Send a message and return its answer.

        Args:
            path: see `Message`.
            namespace: see `Message`.
            name: see `Message`.
            inner: see `Message`.
            timeout: for the whole answer [s].
            once: see `Message`.

        Raises:
            LoginFaultError: the user is refused; the message says how far off the device's clock is.
            FaultError: the device answered with a fault.
            AwayError: nothing listens at its port.
            SilentError: the device cannot be reached, or there was no whole answer in time.
            EmptyAnswerError: the answer is empty, and its status success.
            DeviceError: the answer is none.
        """
        deadline, message = time.monotonic() + timeout, Message(path, namespace, name, inner, once)
        if self._user and self._offset_s is None:
            self._offset_s = self._ask_clock(deadline)
        try:
            return self._exchange(message, deadline)
        except LoginFaultError as error:
            if self._user:
                before, self._offset_s = self.clock_off_s, self._ask_clock(deadline)  # it may have been set since
                # Devices lock a user who is refused often.
                if abs(self._offset_s - before) > CLOCK_STEP_S:
                    with contextlib.suppress(LoginFaultError):
                        return self._exchange(message, deadline)
            raise LoginFaultError(self.name, name, error.codes, self._why_refused()) from None

    def _why_refused(self) -> str:
        if not self._user:
            return f"no user is given: {self._remedy}"
        off = self.clock_off_s
        clock = f"; its clock is {off:.0f} s ahead of this machine's" if abs(off) > CLOCK_S else ""
        return f"not for the user '{self._user}': {self._remedy}{clock}"

    def _ask_clock(self, deadline: float) -> float:
        """Ask for the device's time; return by how much it is ahead [s]."""
        found: datetime | None = None
        try:
            root, found = self._post(Message(DEVICE_PATH, DEVICE, "GetSystemDateAndTime"), "", deadline)
            found = device_time(root) or found
        except FaultError:
            found = self._date
        # Devices say whole seconds.
        return 0.0 if found is None else (found - datetime.now(UTC)).total_seconds() + 0.5

    def signed(self, path: str, namespace: str, name: str, inner: str = "") -> bytes:
        """Write a message with its HTTP header, for another connection, which is closed after the answer.

        It is signed for now: devices take it for some seconds or minutes. Arguments are those of `call`.
        """
        message = Message(path, namespace, name, inner)
        request = next(self._auth.sync_auth_flow(self._request(message, self._header())))
        headers = {**request.headers, "connection": "close"}
        lines = [f"POST {path} HTTP/1.1", *(f"{name}: {value}" for name, value in headers.items()), "", ""]
        return "\r\n".join(lines).encode() + bytes(request.content)

    def _exchange(self, message: Message, deadline: float) -> Element:
        return self._post(message, self._header(), deadline)[0]

    def _header(self) -> str:
        """Write the security header of now; empty without a user."""
        if not self._user:
            return ""
        created = datetime.now(UTC) + timedelta(seconds=self.clock_off_s)
        return user_token(self._user, self._password, created, os.urandom(16))

    def _request(self, message: Message, header: str) -> "httpx.Request":
        name, namespace = message.name, message.namespace
        data = (
            f'<?xml version="1.0" encoding="utf-8"?><s:Envelope xmlns:s="{ENVELOPE}">{header}<s:Body>'
            f'<{name} xmlns="{namespace}" xmlns:t="{SCHEMA}">{message.inner}</{name}></s:Body></s:Envelope>'
        )
        kind = f'application/soap+xml; charset=utf-8; action="{namespace}/{name}"'
        return self._client.build_request("POST", message.path, content=data.encode(), headers={"Content-Type": kind})

    def _post(self, message: Message, header: str, deadline: float) -> tuple[Element, datetime | None]:
        """Send an envelope; return the root of the answer, and the time in its header `Date`."""
        httpx, name = self._httpx, message.name
        with self._one_line_errors(name):
            request = self._request(message, header)
            steps = self._auth.sync_auth_flow(request)
            with contextlib.suppress(StopIteration):
                request = next(steps)
                while True:  # here, since the client would read the answer to a refused request without our limits
                    left_s = max(deadline - time.monotonic(), 0.05)
                    request.extensions["timeout"] = httpx.Timeout(left_s, connect=min(CONNECT_S, left_s)).as_dict()
                    response = self._send(request, message.once)
                    with contextlib.closing(response):
                        said = self._read(response, name, deadline)
                    if self._client.is_closed:  # its pool does not know a connection that was made meanwhile
                        response.extensions["network_stream"].close()
                    request = steps.send(response)
        self._date = _date(response.headers)
        if response.is_success and not said.strip():
            raise EmptyAnswerError(f"{self.name} answers {name} by nothing: check that ONVIF is on, and host and port")
        if response.has_redirect_location:
            raise DeviceError(
                f"{self.name} sends on to {quote(response.headers['location'])}: if that is the device, write its host "
                "and port"
            )
        try:
            root = parse_xml(said)
        except ValueError as error:
            if response.status_code == 401:
                raise LoginFaultError(self.name, name, (NOT_AUTHORIZED,), "HTTP status 401") from None
            what = f"HTTP status {response.status_code}" if response.status_code != 200 else f"no SOAP ({error})"
            raise DeviceError(
                f"{self.name} answers {name} by {what}: check that ONVIF is on, and host and port"
            ) from None
        if fault := fault_of(root, self.name, name):
            raise fault
        if response.status_code == 401:
            raise LoginFaultError(self.name, name, (NOT_AUTHORIZED,), "HTTP status 401")
        if find(root, "Body") is None:
            raise DeviceError(f"{self.name} answers {name} by no SOAP: check that ONVIF is on, and host and port")
        return root, self._date

    def _send(self, request: "httpx.Request", once: bool) -> "httpx.Response":
        """Send a request; again where the device has closed a connection that was kept, as some do each time."""
        httpx = self._httpx
        if not once:
            with contextlib.suppress(httpx.RemoteProtocolError, httpx.ReadError, httpx.WriteError):
                return self._client.send(request, stream=True)
        return self._client.send(request, stream=True)

    def _read(self, response: "httpx.Response", message: str, deadline: float) -> bytes:
        """Read an answer, of a limited length and in a limited time."""
        said = bytearray()
        for piece in response.iter_bytes():
            said += piece
            if len(said) > LONGEST_ANSWER:
                raise DeviceError(f"{self.name} answers {message} without end: check host and port")
            if time.monotonic() > deadline:
                raise SilentError(f"{self.name} did not answer {message} in time: check its power and the network")
        return bytes(said)

    @contextlib.contextmanager
    def _one_line_errors(self, message: str) -> Iterator[None]:
        httpx = self._httpx
        try:
            yield
        except httpx.ConnectTimeout:
            raise SilentError(f"{self.name} does not answer: check host and port, its power and the network") from None
        except httpx.ConnectError as error:
            root = _root_of(error)
            kind = AwayError if isinstance(root, ConnectionRefusedError) else SilentError
            why = getattr(root, "strerror", None) or quote(str(root)) or type(root).__name__
            raise kind(
                f"{self.name} cannot be reached ({why}): check host and port, its power and the network"
            ) from None
        except httpx.TimeoutException:
            raise SilentError(
                f"{self.name} did not answer {message} in time: check its power and the network"
            ) from None
        except (httpx.HTTPError, httpx.InvalidURL, httpx.StreamError, RuntimeError) as error:
            why = quote(str(error)) or type(error).__name__
            raise SilentError(f"{self.name} broke off at {message} ({why}): check host and port") from None


def _root_of(error: BaseException) -> BaseException:
    while (inner := error.__cause__ or error.__context__) is not None:
        error = inner
    return error


def _date(headers: Mapping[str, str]) -> datetime | None:
    try:
        found = parsedate_to_datetime(headers.get("date", ""))
    except (TypeError, ValueError):
        return None
    return found if found.tzinfo else found.replace(tzinfo=UTC)
