"""PTP/IP responder: an emulated device on one TCP port, for one initiator at a time.

The first part encodes PTP's values and datasets (ISO 15740). The second parses and encodes the packets of PTP/IP (CIPA
DC-005): length of the whole packet (4 bytes), kind (4 bytes) and body, all little-endian. `CommandSession` turns
packets into packets, and `PtpIpServer` holds the sockets, the threads and the faults of the line. With "hung" nothing
is answered, with "slow" answers are a second late, "cut" breaks the connection once in the middle of data. While the
device is ``absent``, the port is closed.
"""

import contextlib
import itertools
import socket
import struct
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from cotarget.emulators.faults import Faults
from cotarget.errors import CotargetError, DeviceError

# PTP: values, datasets and response codes

PARAMETERS = 5  # most parameters of an operation or a response
LONGEST_STRING = 255  # UTF-16 units, with the closing zero
ARRAY = 0x4000  # set in the data type of an array
INT8, UINT8, INT16, UINT16, INT32, UINT32, INT64, UINT64 = range(1, 9)
STRING = 0xFFFF
SIGNED = (INT8, INT16, INT32, INT64)
WIDTHS = {INT8: 1, UINT8: 1, INT16: 2, UINT16: 2, INT32: 4, UINT32: 4, INT64: 8, UINT64: 8}  # bytes
JPEG = 0x3801  # the object format: EXIF
Value = int | str | tuple[int, ...]


class Code(IntEnum):
    """Response codes of PTP."""

    OK = 0x2001
    GENERAL_ERROR = 0x2002
    SESSION_NOT_OPEN = 0x2003
    OPERATION_NOT_SUPPORTED = 0x2005
    INCOMPLETE_TRANSFER = 0x2007
    INVALID_STORAGE = 0x2008
    INVALID_HANDLE = 0x2009
    PROPERTY_NOT_SUPPORTED = 0x200A
    ACCESS_DENIED = 0x200F
    DEVICE_BUSY = 0x2019
    INVALID_PROPERTY_FORMAT = 0x201B
    INVALID_PROPERTY_VALUE = 0x201C
    INVALID_PARAMETER = 0x201D
    SESSION_ALREADY_OPEN = 0x201E


class PtpError(CotargetError):
    """The bytes are no valid PTP, or come out of turn."""


@dataclass(frozen=True)
class Answer:
    """A device's answer to an operation.

    Attributes:
        code: response code.
        parameters: of the response.
        data: of an operation that returns data, even if empty; None for any other.
    """

    code: int = Code.OK
    parameters: tuple[int, ...] = ()
    data: bytes | None = None


class PtpDevice(Protocol):
    """A device behind a responder."""

    def operate(self, code: int, parameters: tuple[int, ...], data: bytes) -> Answer:
        """Carry out an operation, with five parameters (0 where one was not sent) and its data."""

    def disconnected(self) -> None:
        """Handle the end of the initiator's connection."""


def array(values: Iterable[int], kind: int) -> bytes:
    """Encode an array of integers of a data type, after its length."""
    items = tuple(values)
    return struct.pack("<I", len(items)) + b"".join(encode(kind, item) for item in items)


def string(text: str) -> bytes:
    """Encode a string after its length; an empty one is a length of 0."""
    if not text:
        return b"\0"
    units = text.encode("utf-16-le")[: 2 * (LONGEST_STRING - 1)] + b"\0\0"
    return bytes([len(units) // 2]) + units


def encode(kind: int, value: Value) -> bytes:
    """Encode a value of a data type."""
    if isinstance(value, str):
        return string(value)
    if isinstance(value, tuple):
        return array(value, kind & ~ARRAY)
    return value.to_bytes(WIDTHS[kind], "little", signed=kind in SIGNED)


def decode(kind: int, data: bytes) -> Value:
    """Decode a value of a data type from all of the bytes.

    Raises:
        PtpError: the bytes are no such value.
    """
    if kind == STRING:
        if not data or len(data) != 1 + 2 * data[0] or (data[0] and data[-2:] != b"\0\0"):
            raise PtpError(f"PTP: {len(data)} bytes are no string")
        return data[1:].decode("utf-16-le", "replace").partition("\0")[0]
    if kind & ~ARRAY not in WIDTHS:
        raise PtpError(f"PTP: unknown data type {kind:#06x}")
    width, signed = WIDTHS[kind & ~ARRAY], kind & ~ARRAY in SIGNED
    head = 4 if kind & ARRAY else 0
    count = int.from_bytes(data[:4], "little") if head else 1
    if len(data) != head + count * width:
        raise PtpError(f"PTP: {len(data)} bytes are no value of type {kind:#06x}")
    places = range(head, len(data), width)
    found = tuple(int.from_bytes(data[at : at + width], "little", signed=signed) for at in places)
    return found if head else found[0]


@dataclass(frozen=True)
class Range:
    """Values from ``low`` to ``high`` in steps of ``step``."""

    low: int
    high: int
    step: int = 1


@dataclass(frozen=True)
class Property:
    """A property of a device.

    Attributes:
        code: number of the property.
        kind: data type.
        default: initial value.
        writable: whether the initiator may set it.
        form: valid values: a range, a list, or None for any value of the data type.
    """

    code: int
    kind: int
    default: Value
    writable: bool = False
    form: Range | tuple[Value, ...] | None = None

    def allows(self, value: Value) -> bool:
        """Return whether a value of the right type may be set."""
        match self.form:
            case None:
                return True
            case Range(low, high, step):
                return isinstance(value, int) and low <= value <= high and (value - low) % step == 0
            case values:
                return value in values

    def describe(self, current: Value) -> bytes:
        """Encode the dataset that describes the property, with its present value."""
        head = struct.pack("<HHB", self.code, self.kind, self.writable)
        head += encode(self.kind, self.default) + encode(self.kind, current)
        match self.form:
            case None:
                return head + b"\0"
            case Range(low, high, step):
                return head + b"\1" + b"".join(encode(self.kind, value) for value in (low, high, step))
            case values:
                listed = b"".join(encode(self.kind, value) for value in values)
                return head + b"\2" + struct.pack("<H", len(values)) + listed


@dataclass(frozen=True)
class DeviceInfo:
    """Identity and capabilities of a device: names, and lists of codes."""

    extension: int  # registered number of the vendor's extension
    operations: tuple[int, ...]
    events: tuple[int, ...]
    properties: tuple[int, ...]
    formats: tuple[int, ...]  # of the objects on the device
    maker: str
    model: str
    version: str
    serial: str

    def pack(self) -> bytes:
        """Encode the dataset, of PTP 1.0, of a camera that captures JPEG."""
        head = struct.pack("<HIH", 100, self.extension, 100) + string("") + struct.pack("<H", 0)
        lists = (self.operations, self.events, self.properties, (JPEG,), self.formats)
        names = (self.maker, self.model, self.version, self.serial)
        return head + b"".join(array(codes, UINT16) for codes in lists) + b"".join(string(name) for name in names)


def storage_info(label: str) -> bytes:
    """Encode the dataset of a camera's memory: fixed RAM with its own file system, read and write, sizes unknown."""
    return struct.pack("<HHHQQI", 3, 0x8001, 0, 0, 0, 0xFFFFFFFF) + string("") + string(label)


@dataclass(frozen=True)
class ObjectInfo:
    """Description of an image in a camera's memory; sizes in bytes and pixels."""

    storage: int
    length: int
    size: tuple[int, int]
    thumb_length: int
    thumb_size: tuple[int, int]
    name: str
    date: str  # of the capture, as "20080721T095816"

    def pack(self) -> bytes:
        """Encode the dataset of a JPEG (EXIF) image without a folder."""
        plain = 0
        head = struct.pack("<IHHI", self.storage, JPEG, plain, self.length)
        thumb = struct.pack("<HIII", JPEG, self.thumb_length, *self.thumb_size)
        rest = struct.pack("<IIIIHII", *self.size, 24, 0, 0, 0, 0)  # bits a pixel; parent, kind of folder, ..., number
        return head + thumb + rest + string(self.name) + string(self.date) * 2 + string("")


# PTP/IP: packets

HEADER = struct.Struct("<II")
LONGEST_PACKET = 1 << 20  # bytes; initiators send data in pieces of 64 KiB or less
PIECE = 1 << 16  # bytes of data in one packet of the responder
GUID_LENGTH = 16
VERSION = 0x00010000  # of PTP/IP: 1.0


class Kind(IntEnum):
    """Kinds of packets of PTP/IP."""

    INIT_COMMAND = 1
    INIT_COMMAND_ACK = 2
    INIT_EVENT = 3
    INIT_EVENT_ACK = 4
    INIT_FAIL = 5
    REQUEST = 6
    RESPONSE = 7
    EVENT = 8
    START_DATA = 9
    DATA = 10
    CANCEL = 11
    END_DATA = 12
    PROBE_REQUEST = 13
    PROBE_RESPONSE = 14


@dataclass(frozen=True)
class InitCommand:
    """First packet of a command connection: GUID and name of the initiator."""

    guid: bytes
    name: str


@dataclass(frozen=True)
class InitEvent:
    """First packet of an event connection: number of the command connection that it belongs to."""

    connection: int


@dataclass(frozen=True)
class OperationRequest:
    """Request of an operation; with ``sends_data`` its data follow."""

    code: int
    transaction: int
    parameters: tuple[int, ...]
    sends_data: bool = False


@dataclass(frozen=True)
class StartData:
    """Announcement of ``total`` bytes of data."""

    transaction: int
    total: int


@dataclass(frozen=True)
class Data:
    """A piece of data; ``last`` marks the last one."""

    transaction: int
    data: bytes
    last: bool


@dataclass(frozen=True)
class Cancel:
    """Cancellation of a transaction."""

    transaction: int


@dataclass(frozen=True)
class Probe:
    """Query whether the other side is still there, or with ``answer`` the answer to it."""

    answer: bool = False


Packet = InitCommand | InitEvent | OperationRequest | StartData | Data | Cancel | Probe


class PacketReader:
    """Splitter of a stream of bytes into the packets that an initiator may send."""

    def __init__(self) -> None:
        self._pending = bytearray()

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Add bytes, and yield each packet that they complete.

        Raises:
            PtpError: the bytes are no packets of an initiator.
        """
        self._pending += data
        while len(self._pending) >= HEADER.size:
            length, kind = HEADER.unpack_from(self._pending)
            if not HEADER.size <= length <= LONGEST_PACKET:
                raise PtpError(f"PTP/IP: a packet cannot be {length} bytes long")
            if len(self._pending) < length:
                return
            body = bytes(self._pending[HEADER.size : length])
            del self._pending[:length]
            yield parse_packet(kind, body)


def parse_packet(kind: int, body: bytes) -> Packet:
    """Parse a packet of an initiator.

    Raises:
        PtpError: an initiator sends no such packet.
    """
    match kind, len(body):
        case Kind.INIT_COMMAND, length if length >= GUID_LENGTH + 6 and length % 2 == 0:
            name = body[GUID_LENGTH:-4].decode("utf-16-le", "replace")
            return InitCommand(body[:GUID_LENGTH], name.partition("\0")[0])
        case Kind.INIT_EVENT, 4:
            return InitEvent(*struct.unpack("<I", body))
        case Kind.REQUEST, length if 10 <= length <= 10 + 4 * PARAMETERS and length % 4 == 2:
            phase, code, transaction, *parameters = struct.unpack(f"<IHI{(length - 10) // 4}I", body)
            return OperationRequest(code, transaction, tuple(parameters), sends_data=phase == 2)
        case Kind.START_DATA, 12:
            return StartData(*struct.unpack("<IQ", body))
        case ((Kind.DATA | Kind.END_DATA), length) if length >= 4:
            return Data(int.from_bytes(body[:4], "little"), body[4:], last=kind == Kind.END_DATA)
        case Kind.CANCEL, 4:
            return Cancel(*struct.unpack("<I", body))
        case Kind.PROBE_REQUEST, 0:
            return Probe()
        case Kind.PROBE_RESPONSE, 0:
            return Probe(answer=True)
    raise PtpError(f"PTP/IP: no initiator sends a packet of kind {kind} with {len(body)} bytes")


def packet(kind: Kind, body: bytes = b"") -> bytes:
    """Encode a packet."""
    return HEADER.pack(HEADER.size + len(body), kind) + body


def init_command_ack(connection: int, guid: bytes, name: str) -> bytes:
    """Encode the acceptance of a command connection, with its number and the responder's GUID and name."""
    body = struct.pack("<I", connection) + guid + name.encode("utf-16-le") + b"\0\0"
    return packet(Kind.INIT_COMMAND_ACK, body + struct.pack("<I", VERSION))


def init_fail(reason: int) -> bytes:
    """Encode the refusal of a connection: 1 rejected, 2 busy, 3 unspecified."""
    return packet(Kind.INIT_FAIL, struct.pack("<I", reason))


def response(code: int, transaction: int, parameters: Iterable[int] = ()) -> bytes:
    """Encode the end of a transaction."""
    words = tuple(parameters)
    return packet(Kind.RESPONSE, struct.pack(f"<HI{len(words)}I", code, transaction, *words))


def event(code: int, parameters: Iterable[int] = ()) -> bytes:
    """Encode an event of no transaction, for the event connection."""
    words = tuple(parameters)
    return packet(Kind.EVENT, struct.pack(f"<HI{len(words)}I", code, 0xFFFFFFFF, *words))


def data_phase(transaction: int, data: bytes) -> Iterator[bytes]:
    """Yield the packets that carry data; even empty data end with an end packet."""
    yield packet(Kind.START_DATA, struct.pack("<IQ", transaction, len(data)))
    number = struct.pack("<I", transaction)
    last = max(len(data) - 1, 0) // PIECE * PIECE
    for at in range(0, last, PIECE):
        yield packet(Kind.DATA, number + data[at : at + PIECE])
    yield packet(Kind.END_DATA, number + data[last:])


# The responder

LINE_FAULTS = ("hung", "slow", "cut")
LOOK_S = 0.05  # period of checking whether the device is absent [s]
SLOW_S = 1.0  # delay of a slow answer; libgphoto2 waits for 2.5 s [s]
SUCCESSION_S = 1.0  # time limit for a new initiator to wait for the end of the one before [s]
RECEIVE = 1 << 16  # bytes
LONGEST_DATA = 1 << 20  # most data of an operation; a property's value takes a few bytes [bytes]
# libgphoto2 sends a request and its data separately and without TCP_NODELAY. Unless the first is acknowledged at once,
# which is an option of Linux, the second leaves 40 ms late.
QUICK_ACK: int | None = getattr(socket, "TCP_QUICKACK", None)
HIGHEST_PORT = 65535
REJECTED, BUSY = 1, 2  # reasons of INIT_FAIL


class CommandSession:
    """The transactions of one command connection.

    Args:
        device: carries out the operations.
        deaf: returns whether to ignore operations now.
    """

    def __init__(self, device: PtpDevice, deaf: Callable[[], bool] = lambda: False) -> None:
        self._device, self._deaf = device, deaf
        self._request: OperationRequest | None = None  # the operation whose data are incomplete
        self._total = -1  # announced bytes of its data; -1 before the announcement
        self._data = bytearray()

    def receive(self, received: Packet) -> list[bytes]:
        """Process a packet of the initiator; return the packets to send back.

        Raises:
            PtpError: the packet comes out of turn.
        """
        waiting = self._request
        match received:
            case OperationRequest() if waiting is None:
                if not received.sends_data:
                    return self._operate(received, b"")
                self._request, self._total, self._data = received, -1, bytearray()
            case StartData() if waiting is not None and self._total < 0 and received.transaction == waiting.transaction:
                if received.total > LONGEST_DATA:
                    raise PtpError(f"PTP/IP: {received.total} bytes are too much data")
                self._total = received.total
            case Data() if waiting is not None and self._total >= 0 and received.transaction == waiting.transaction:
                self._data += received.data
                if len(self._data) > self._total:
                    raise PtpError(f"PTP/IP: more data came than the {self._total} bytes announced")
                if received.last:
                    return self._complete(waiting)
            case Probe(answer=False):
                return [packet(Kind.PROBE_RESPONSE)]
            case OperationRequest() | StartData() | Data() | InitCommand() | InitEvent():
                raise PtpError(f"PTP/IP: a packet out of turn: {type(received).__name__}")
        return []

    def _complete(self, request: OperationRequest) -> list[bytes]:
        self._request = None
        if len(self._data) < self._total:
            return [response(Code.INCOMPLETE_TRANSFER, request.transaction)]
        return self._operate(request, bytes(self._data))

    def _operate(self, request: OperationRequest, data: bytes) -> list[bytes]:
        if self._deaf():
            return []
        missing = PARAMETERS - len(request.parameters)
        answer = self._device.operate(request.code, request.parameters + (0,) * missing, data)
        phase: Iterable[bytes] = () if answer.data is None else data_phase(request.transaction, answer.data)
        return [*phase, response(answer.code, request.transaction, answer.parameters)]


class PtpIpServer:
    """Server of command and event connections on one port, for one initiator at a time.

    Args:
        device: the device.
        guid: 16 bytes that identify the device.
        name: name of the device.
        faults: must know `LINE_FAULTS`.
        absent: returns whether the device is unplugged or off now; called every `LOOK_S`.
        host: address to listen at.
        port: to listen at; 0 for any free port.

    Raises:
        DeviceError: the address is invalid or in use.
    """

    def __init__(
        self,
        device: PtpDevice,
        guid: bytes,
        name: str,
        faults: Faults,
        absent: Callable[[], bool],
        host: str,
        port: int,
    ) -> None:
        self._device, self._guid, self._name = device, guid, name
        self._faults, self._absent = faults, absent
        if not 0 <= port <= HIGHEST_PORT:
            raise DeviceError(f"cannot listen on {host}:{port}: a port is a number from 0 to {HIGHEST_PORT}")
        try:
            self._listener: socket.socket | None = listen(host, port)
        except OSError as error:
            raise DeviceError(f"cannot listen on {host}:{port}: {error.strerror or error}") from None
        self._address: tuple[str, int] = self._listener.getsockname()[:2]
        self._closing = threading.Event()
        self._numbers = itertools.count(1)
        self._changed = threading.Condition()  # guards the attributes below
        self._open: set[socket.socket] = set()
        self._caller: int | None = None  # number of the command connection
        self._ears: dict[int, socket.socket] = {}  # event connections by the number of their command connection
        self._threads: list[threading.Thread] = []
        self._acceptor = threading.Thread(target=self._accept, daemon=True)
        self._acceptor.start()

    @property
    def port(self) -> int:
        """TCP port of the server."""
        return self._address[1]

    def send_event(self, code: int, parameters: Iterable[int]) -> None:
        """Send an event to the initiator, if it has an event connection."""
        with self._changed:
            ear = None if self._caller is None else self._ears.get(self._caller)
        if ear is not None and "hung" not in self._faults:
            with contextlib.suppress(OSError):
                ear.sendall(event(code, parameters))

    def close(self) -> None:
        """Close the port and the connections, and wait for the threads."""
        self._closing.set()
        self._acceptor.join()
        self._hang_up()
        for thread in self._threads:
            thread.join()

    def _accept(self) -> None:
        while not self._closing.is_set():
            if self._absent():
                self._hang_up()
                self._closing.wait(LOOK_S)
            elif self._listener is None:
                try:
                    self._listener = listen(*self._address)
                except OSError:  # another program has the port for now
                    self._closing.wait(LOOK_S)
            else:
                with contextlib.suppress(TimeoutError):
                    self._welcome(self._listener.accept()[0])
        self._stop_listening()

    def _welcome(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.settimeout(None)
        with self._changed:
            self._open.add(connection)
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        self._threads.append(threading.Thread(target=self._serve, args=(connection,), daemon=True))
        self._threads[-1].start()

    def _stop_listening(self) -> None:
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def _hang_up(self) -> None:
        self._stop_listening()
        with self._changed:
            for connection in self._open:
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)

    def _serve(self, connection: socket.socket) -> None:
        try:
            with contextlib.suppress(OSError, PtpError):
                packets = self._packets(connection)
                match next(packets, None):
                    case InitCommand():
                        self._command(connection, packets)
                    case InitEvent(number):
                        self._events(connection, packets, number)
        finally:
            with self._changed:
                self._open.discard(connection)
            connection.close()

    def _packets(self, connection: socket.socket) -> Iterator[Packet]:
        reader = PacketReader()
        while True:
            if QUICK_ACK is not None:
                connection.setsockopt(socket.IPPROTO_TCP, QUICK_ACK, 1)
            received = connection.recv(RECEIVE)
            if not received:
                return
            yield from reader.feed(received)

    def _command(self, connection: socket.socket, packets: Iterator[Packet]) -> None:
        number = next(self._numbers)
        with self._changed:
            # A client may reconnect before the end of its first connection is noticed.
            if not self._changed.wait_for(lambda: self._caller is None, SUCCESSION_S):
                connection.sendall(init_fail(BUSY))
                return
            self._caller = number
        try:
            self._send(connection, [init_command_ack(number, self._guid, self._name)])
            session = CommandSession(self._device, lambda: "hung" in self._faults)
            for received in packets:
                self._send(connection, session.receive(received))
        finally:
            self._device.disconnected()
            with self._changed:
                self._caller = None
                self._changed.notify_all()

    def _events(self, connection: socket.socket, packets: Iterator[Packet], number: int) -> None:
        with self._changed:
            known = number == self._caller and number not in self._ears
            if known:
                self._ears[number] = connection
        if not known:
            connection.sendall(init_fail(REJECTED))
            return
        try:
            self._send(connection, [packet(Kind.INIT_EVENT_ACK)])
            for received in packets:
                if received == Probe():
                    self._send(connection, [packet(Kind.PROBE_RESPONSE)])
        finally:
            with self._changed:
                del self._ears[number]

    def _send(self, connection: socket.socket, packets: list[bytes]) -> None:
        if not packets or "hung" in self._faults:
            return
        if "slow" in self._faults:
            self._closing.wait(SLOW_S)
        answer = b"".join(packets)
        if len(packets) > 1 and self._faults.take("cut"):
            connection.sendall(answer[: len(answer) // 2])
            raise PtpError("PTP/IP: cut")
        connection.sendall(answer)


def listen(host: str, port: int) -> socket.socket:
    """Open a listening socket whose accept() waits `LOOK_S` at most."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.create_server((host, port), family=family)
    listener.settimeout(LOOK_S)
    return listener
