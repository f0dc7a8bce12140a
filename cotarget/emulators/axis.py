"""An Axis 241Q video server on HTTP: VAPIX 2 as its manuals tell it, in front of feeds of pictures.

Snapshots, MJPEG streams, parameters, the state of the inputs, authentication; and what can go wrong with each. A thread
serves a connection: a viewer that is slow holds up no other, and gets the newest picture when it is ready for one.
"""

import contextlib
import re
import selectors
import socket
import struct
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from types import TracebackType

from cotarget.emulators.axis_answers import fixed_ptz, image_size, list_parameters, parameters, video_status
from cotarget.emulators.axis_auth import Guard, Scheme
from cotarget.emulators.axis_http import (
    LINE_BYTES,
    HttpError,
    Request,
    error_reply,
    read_request,
    reply_head,
    text_reply,
)
from cotarget.emulators.axis_pictures import INPUTS, Order, Pictures, Standard, named_sizes, parse_order
from cotarget.emulators.axis_stream import Sender
from cotarget.emulators.faults import Faults
from cotarget.emulators.plant import Feed
from cotarget.errors import DeviceError

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
        self._guard = Guard(user, password, auth, f"AXIS_{self._unit.serial}")
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

    def _answer(self, connection: socket.socket, kind: str, request: Request, camera: str | None) -> None:
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
