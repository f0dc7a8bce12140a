"""A PTP/IP responder: one TCP port, one initiator at a time, an emulated device behind it.

The session is packets in, packets out; around it stand the sockets and threads, and those faults that happen on the
line: "hung" answers nothing, "slow" answers a second late, "cut" breaks the connection once in the middle of data, and
for as long as the device is ``absent`` nobody listens.

PTP without a transport: values and datasets as bytes, response codes, and what a device is; source: ISO 15740.

PTP/IP as bytes: the packets that an initiator and a responder exchange over TCP; source: CIPA DC-005.

A packet is its length (of itself, 4 bytes), its kind (4 bytes), and a body; all of it little-endian.
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

PARAMETERS = 5  # an operation or a response has no more
LONGEST_STRING = 255  # UTF-16 units, the closing zero among them
ARRAY = 0x4000  # set in the data type of an array
INT8, UINT8, INT16, UINT16, INT32, UINT32, INT64, UINT64 = range(1, 9)
STRING = 0xFFFF
SIGNED = (INT8, INT16, INT32, INT64)
WIDTHS = {INT8: 1, UINT8: 1, INT16: 2, UINT16: 2, INT32: 4, UINT32: 4, INT64: 8, UINT64: 8}  # bytes
JPEG = 0x3801  # the object format: EXIF
Value = int | str | tuple[int, ...]


class Code(IntEnum):
    """Response codes."""

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
    """Bytes that are no PTP, or that come at the wrong time."""


@dataclass(frozen=True)
class Answer:
    """What a device answers to an operation; ``data`` where the operation is one that gives data, even if empty."""

    code: int = Code.OK
    parameters: tuple[int, ...] = ()
    data: bytes | None = None


class PtpDevice(Protocol):
    """What a responder stands in front of."""

    def operate(self, code: int, parameters: tuple[int, ...], data: bytes) -> Answer:
        """Do an operation: five parameters, those that were not sent 0, and the data that came along."""

    def disconnected(self) -> None:
        """The initiator is gone."""


def array(values: Iterable[int], kind: int) -> bytes:
    """An array of integers of a data type, after its length."""
    items = tuple(values)
    return struct.pack("<I", len(items)) + b"".join(encode(kind, item) for item in items)


def string(text: str) -> bytes:
    """A string after its length; an empty one is a length of 0."""
    if not text:
        return b"\0"
    units = text.encode("utf-16-le")[: 2 * (LONGEST_STRING - 1)] + b"\0\0"
    return bytes([len(units) // 2]) + units


def encode(kind: int, value: Value) -> bytes:
    """A value as its data type has it."""
    if isinstance(value, str):
        return string(value)
    if isinstance(value, tuple):
        return array(value, kind & ~ARRAY)
    return value.to_bytes(WIDTHS[kind], "little", signed=kind in SIGNED)


def decode(kind: int, data: bytes) -> Value:
    """The value of a data type that is all of some bytes.

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
    """Values from ``low`` to ``high`` by ``step``."""

    low: int
    high: int
    step: int = 1


@dataclass(frozen=True)
class Property:
    """A property of a device.

    Attributes:
        code: its number.
        kind: data type.
        default: its value at first.
        writable: whether the initiator may set it.
        form: what may be set: a range, a list of values, or None for anything of that type.
    """

    code: int
    kind: int
    default: Value
    writable: bool = False
    form: Range | tuple[Value, ...] | None = None

    def allows(self, value: Value) -> bool:
        """Whether a value of the right type is one that may be set."""
        match self.form:
            case None:
                return True
            case Range(low, high, step):
                return isinstance(value, int) and low <= value <= high and (value - low) % step == 0
            case values:
                return value in values

    def describe(self, current: Value) -> bytes:
        """The dataset that describes it, with its value now."""
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
    """What a device is and can do; lists of codes, and names."""

    extension: int  # the vendor's, as registered
    operations: tuple[int, ...]
    events: tuple[int, ...]
    properties: tuple[int, ...]
    formats: tuple[int, ...]  # of objects that it shows
    maker: str
    model: str
    version: str
    serial: str

    def pack(self) -> bytes:
        """The dataset, of PTP 1.0, of a camera that captures JPEG."""
        head = struct.pack("<HIH", 100, self.extension, 100) + string("") + struct.pack("<H", 0)
        lists = (self.operations, self.events, self.properties, (JPEG,), self.formats)
        names = (self.maker, self.model, self.version, self.serial)
        return head + b"".join(array(codes, UINT16) for codes in lists) + b"".join(string(name) for name in names)


def storage_info(label: str) -> bytes:
    """The dataset of a camera's memory: fixed RAM, a file system of its own, read and write, sizes unknown."""
    return struct.pack("<HHHQQI", 3, 0x8001, 0, 0, 0, 0xFFFFFFFF) + string("") + string(label)


@dataclass(frozen=True)
class ObjectInfo:
    """What a camera tells of an image in its memory; sizes in bytes and pixels."""

    storage: int
    length: int
    size: tuple[int, int]
    thumb_length: int
    thumb_size: tuple[int, int]
    name: str
    date: str  # of the capture, as "20080721T095816"

    def pack(self) -> bytes:
        """The dataset, of a JPEG (EXIF) image in no folder."""
        plain = 0
        head = struct.pack("<IHHI", self.storage, JPEG, plain, self.length)
        thumb = struct.pack("<HIII", JPEG, self.thumb_length, *self.thumb_size)
        rest = struct.pack("<IIIIHII", *self.size, 24, 0, 0, 0, 0)  # bits a pixel; parent, kind of folder, ..., number
        return head + thumb + rest + string(self.name) + string(self.date) * 2 + string("")


# --- ptpip ---

HEADER = struct.Struct("<II")
LONGEST_PACKET = 1 << 20  # bytes; initiators send data in pieces of 64 KiB or less
PIECE = 1 << 16  # bytes of data in one packet of ours
GUID_LENGTH = 16
VERSION = 0x00010000  # of PTP/IP: 1.0


class Kind(IntEnum):
    """Packets of PTP/IP."""

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
    """The first packet of a command connection: who calls."""

    guid: bytes
    name: str


@dataclass(frozen=True)
class InitEvent:
    """The first packet of an event connection: the number of the command connection that it belongs to."""

    connection: int


@dataclass(frozen=True)
class OperationRequest:
    """An operation to do; ``sends_data`` where its data follows."""

    code: int
    transaction: int
    parameters: tuple[int, ...]
    sends_data: bool = False


@dataclass(frozen=True)
class StartData:
    """Data of ``total`` bytes follows."""

    transaction: int
    total: int


@dataclass(frozen=True)
class Data:
    """A piece of data; ``last`` for the last one."""

    transaction: int
    data: bytes
    last: bool


@dataclass(frozen=True)
class Cancel:
    """The transaction is wanted no more."""

    transaction: int


@dataclass(frozen=True)
class Probe:
    """A question, or the ``answer``, whether the other side is still there."""

    answer: bool = False


Packet = InitCommand | InitEvent | OperationRequest | StartData | Data | Cancel | Probe


class PacketReader:
    """Cuts a stream of bytes into the packets that an initiator may send."""

    def __init__(self) -> None:
        self._pending = bytearray()

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Add bytes, and give each packet that they complete.

        Raises:
            PtpError: these are no packets of an initiator.
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
    """Tell what a packet of an initiator says.

    Raises:
        PtpError: it says nothing that an initiator may say.
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
    """The bytes of a packet."""
    return HEADER.pack(HEADER.size + len(body), kind) + body


def init_command_ack(connection: int, guid: bytes, name: str) -> bytes:
    """The responder's welcome on a command connection, with its number, GUID and name."""
    body = struct.pack("<I", connection) + guid + name.encode("utf-16-le") + b"\0\0"
    return packet(Kind.INIT_COMMAND_ACK, body + struct.pack("<I", VERSION))


def init_fail(reason: int) -> bytes:
    """The responder's refusal of a connection: 1 rejected, 2 busy, 3 unspecified."""
    return packet(Kind.INIT_FAIL, struct.pack("<I", reason))


def response(code: int, transaction: int, parameters: Iterable[int] = ()) -> bytes:
    """The end of a transaction."""
    words = tuple(parameters)
    return packet(Kind.RESPONSE, struct.pack(f"<HI{len(words)}I", code, transaction, *words))


def event(code: int, parameters: Iterable[int] = ()) -> bytes:
    """An event on the event connection, of no transaction."""
    words = tuple(parameters)
    return packet(Kind.EVENT, struct.pack(f"<HI{len(words)}I", code, 0xFFFFFFFF, *words))


def data_phase(transaction: int, data: bytes) -> Iterator[bytes]:
    """The packets that bring data; an end packet there is even for none."""
    yield packet(Kind.START_DATA, struct.pack("<IQ", transaction, len(data)))
    number = struct.pack("<I", transaction)
    last = max(len(data) - 1, 0) // PIECE * PIECE
    for at in range(0, last, PIECE):
        yield packet(Kind.DATA, number + data[at : at + PIECE])
    yield packet(Kind.END_DATA, number + data[last:])


LINE_FAULTS = ("hung", "slow", "cut")
LOOK_S = 0.05  # between looks at whether the device is absent
SLOW_S = 1.0  # that a slow answer takes; libgphoto2 waits for 2.5 s
SUCCESSION_S = 1.0  # that a caller waits for the one before to be gone
RECEIVE = 1 << 16  # bytes
LONGEST_DATA = 1 << 20  # bytes that an operation may bring along; a property's value takes a few
# libgphoto2 sends a request and its data apart and without TCP_NODELAY: unless the first is acknowledged at once, which
# is an option of Linux, the second leaves 40 ms late.
QUICK_ACK: int | None = getattr(socket, "TCP_QUICKACK", None)
HIGHEST_PORT = 65535
REJECTED, BUSY = 1, 2  # reasons of a refusal


class CommandSession:
    """The transactions of one command connection.

    Args:
        device: does the operations.
        deaf: whether to do and answer nothing now.
    """

    def __init__(self, device: PtpDevice, deaf: Callable[[], bool] = lambda: False) -> None:
        self._device, self._deaf = device, deaf
        self._request: OperationRequest | None = None  # whose data is not all there
        self._total = -1  # bytes of that data, as announced; -1 before it is
        self._data = bytearray()

    def receive(self, received: Packet) -> list[bytes]:
        """Take a packet of the initiator; the packets to send back, if any.

        Raises:
            PtpError: the packet makes no sense now.
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
    """Listens on one port for command and event connections of one initiator at a time.

    Args:
        device: the device.
        guid: its 16 bytes.
        name: how it calls itself.
        faults: knows those of `LINE_FAULTS`.
        absent: whether the device is unplugged or off now; asked every `LOOK_S`.
        host: where to listen.
        port: where to listen; 0 for any.

    Raises:
        DeviceError: nobody can listen there.
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
        self._changed = threading.Condition()  # guards what follows
        self._open: set[socket.socket] = set()
        self._caller: int | None = None  # number of the command connection
        self._ears: dict[int, socket.socket] = {}  # event connections by the number of their command connection
        self._threads: list[threading.Thread] = []
        self._acceptor = threading.Thread(target=self._accept, daemon=True)
        self._acceptor.start()

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._address[1]

    def send_event(self, code: int, parameters: Iterable[int]) -> None:
        """Send an event to the initiator, if there is one that listens."""
        with self._changed:
            ear = None if self._caller is None else self._ears.get(self._caller)
        if ear is not None and "hung" not in self._faults:
            with contextlib.suppress(OSError):
                ear.sendall(event(code, parameters))

    def close(self) -> None:
        """Stop listening, break the connections, and wait for the threads."""
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
                except OSError:  # somebody else has the port for now
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
            # A client that leaves and comes back at once is faster than the end of its first connection is noticed.
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
    """A socket that listens and whose accept() takes `LOOK_S` at most."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.create_server((host, port), family=family)
    listener.settimeout(LOOK_S)
    return listener
